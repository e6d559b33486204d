"""Tracking in the virtual laboratory: scatterers moved by a known field, imaged anew, tracked, compared."""

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
from scipy.io import loadmat
from skimage.registration import optical_flow_ilk

from echospline.errors import InputError
from echospline.laboratory import LinearArray, NeedleField, Phantom, delay_and_sum
from echospline.laboratory.beamform import demodulate, rigid_motion
from echospline.scene import Cine, Echo, EchoCine, NeedlePose, RegularGrid, UltrasoundImage
from echospline.scene.transducer import CONVEX, LINEAR
from echospline.tracking import BlockMatching, CarrierPhase, FlowTracker, track
from echospline.tracking.carrier_phase import taken_back
from echospline.tracking.tracker import Motion, Neighbours, regrid

SIZES = {"linear": (LINEAR, 0.1), "convex": (CONVEX, 0.17)}


def rmse(error):
    """(axial, lateral) in um."""
    lateral, axial = 1e3 * np.sqrt(np.mean(error**2, axis=0))
    return axial, lateral


def laboratory(name, peak, seed, pixels=400, **probe):
    """Phantom, its true field and points 4 mm or more inside."""
    device, h = SIZES[name]
    grid = RegularGrid((pixels, pixels), (h, h))
    x0, x1, y0, y1 = grid.extent
    entry = (x0 + 0.35 * (x1 - x0), y1)
    field = NeedleField(grid, NeedlePose(entry, (x0 + 0.5 * (x1 - x0), y0 + 0.5 * (y1 - y0))), peak)
    inner = RegularGrid((33, 33), ((x1 - x0 - 8) / 32, (y1 - y0 - 8) / 32), (x0 + 4, y0 + 4))
    return Phantom(replace(device, **probe), grid, seed), field, inner.nodes


@pytest.fixture(scope="module", params=["linear", "convex"])
def pair(request):
    phantom, field, points = laboratory(request.param, 0.3, seed=11)
    return (
        request.param,
        phantom,
        field,
        points,
        phantom.form(noise_seed=1),
        phantom.form(field, noise_seed=2),
    )


def test_the_field_has_its_peak_and_a_still_border():
    _, field, _ = laboratory("linear", 0.3, seed=0)
    grid = field.grid
    size = np.hypot(*field(grid.nodes).T)
    assert size.max() == pytest.approx(0.3, rel=0.02)
    assert np.abs(field(grid.nodes[grid.boundary(("top", "bottom", "left", "right"))])).max() < 1e-12
    tip = np.asarray(field.pose.tip)
    assert field(tip[None])[0] @ field.pose.axis > 0.2  # along the needle, at its tip


def test_b_mode_is_tracked_within_the_limits(pair):
    name, phantom, field, points, before, after = pair
    pictures = [echo.b_mode(grid=phantom.grid) for echo in (before, after)]
    axial, lateral = rmse(FlowTracker().motion(*pictures, points).displacement - field(points))
    assert axial <= {"linear": 4.0, "convex": 9.0}[name]
    assert lateral <= {"linear": 5.0, "convex": 14.0}[name]


def test_carrier_makes_the_axial_part_finer(pair):
    name, _, field, points, before, after = pair
    fine = rmse(FlowTracker().motion(before, after, points).displacement - field(points))
    coarse = rmse(FlowTracker(phase=None).motion(before, after, points).displacement - field(points))
    assert fine[0] <= {"linear": 1.5, "convex": 3.0}[name]
    assert fine[1] <= {"linear": 4.0, "convex": 14.0}[name]
    assert fine[0] < 0.6 * coarse[0]


def test_an_independent_flow_agrees(pair):
    # scikit-image's iterative Lucas-Kanade shares no code with the tracker
    name, phantom, _, points, before, after = pair
    a, b = (echo.b_mode(grid=phantom.grid) for echo in (before, after))
    v, u = optical_flow_ilk(
        a.pixels.astype(np.float32), b.pixels.astype(np.float32), radius=15, num_warp=5, dtype=np.float32
    )
    ij = np.rint(phantom.grid.to_index(points)).astype(int)
    other = np.stack([u, v], axis=-1)[ij[:, 1], ij[:, 0]] * phantom.grid.spacing
    ours = FlowTracker().motion(a, b, phantom.grid.to_mm(ij)).displacement
    assert max(rmse(ours - other)) < {"linear": 10.0, "convex": 25.0}[name]


def test_block_matching_stands_behind_the_same_protocol(pair):
    name, phantom, field, points, before, after = pair
    a, b = (echo.b_mode(grid=phantom.grid) for echo in (before, after))
    found = BlockMatching().motion(a, b, points[::4])
    axial, lateral = rmse(found.displacement - field(points[::4]))
    assert axial < {"linear": 8.0, "convex": 25.0}[name]
    assert lateral < {"linear": 8.0, "convex": 40.0}[name]
    outside = BlockMatching().motion(a, b, np.array([[0.1, 0.1]]))
    assert outside.confidence[0] == 0.0


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.03, -0.02), (0.21, 0.37)])
def test_rigid_shift_is_found_everywhere(shift):
    phantom, _, points = laboratory("linear", 0.3, seed=2, pixels=200)
    points = points[(points > 4).all(axis=1) & (points < 16).all(axis=1)]
    a, b = phantom.form(noise_seed=1), phantom.form(lambda p: np.full_like(p, shift), noise_seed=2)
    found = FlowTracker().motion(a, b, points)
    assert np.abs(found.displacement.mean(axis=0) - shift).max() < 0.002
    assert max(rmse(found.displacement - shift)) < 5.0
    assert found.confidence.min() > 0.5


def test_echo_taken_back_by_the_true_field_is_the_echo_before():
    phantom, field, _ = laboratory("linear", 0.1, seed=3, snr=np.inf)
    a, b = phantom.form(), phantom.form(field)
    u = field(a.grid.nodes).reshape(*a.grid.shape[::-1], 2).astype(np.float32)
    back = taken_back(b, a.grid, u)
    inner = np.s_[80:-80, 40:-40]
    rho = np.vdot(a.iq[inner], back[inner]) / (np.linalg.norm(a.iq[inner]) * np.linalg.norm(back[inner]))
    assert abs(rho) > 0.97
    assert abs(np.angle(rho)) < 0.02
    refined, coherence = CarrierPhase().refine(a, b, u + np.float32([0.0, 0.02]))
    assert np.abs(refined[inner][..., 1] - u[inner][..., 1]).mean() < 0.001
    assert coherence[inner].mean() > 0.95


def test_three_millimetres_in_ten_frames_stay_within_twenty_micrometres():
    phantom, field, points = laboratory("linear", 3.0, seed=5)
    times = np.arange(11) / 10.0
    iq = np.stack([phantom.form(lambda p, t=t: field(p) * t, noise_seed=int(100 * t)).iq for t in times])
    cine = EchoCine(iq, times, phantom.samples, LINEAR.carrier)
    pictures = Cine(np.stack([echo.b_mode(grid=phantom.grid).pixels for echo in cine]), times, phantom.grid)
    for frames in (cine, pictures):
        found = track(frames, points, FlowTracker())
        assert np.sqrt(np.mean((found.displacement[-1] - field(points)) ** 2)) <= 0.020
        assert len(found.keyframes) < 7  # it did skip frames


def test_slow_motion_is_measured_against_one_keyframe():
    phantom, field, points = laboratory("linear", 0.3, seed=6, pixels=250)
    frames = [phantom.form(lambda p, s=s: field(p) * s / 6, noise_seed=s) for s in range(7)]
    times = np.arange(7.0)
    key = track(frames, points, FlowTracker(), times=times)
    first = track(frames, points, FlowTracker(), times=times, reference="first")
    chain = track(frames, points, FlowTracker(), times=times, reference="previous")
    assert key.keyframes == (0,)
    assert np.array_equal(key.displacement, first.displacement)
    drift = [max(rmse(t.displacement[-1] - field(points))) for t in (key, chain)]
    assert drift[0] < drift[1]


def test_confidence_falls_where_the_pattern_is_lost():
    phantom, field, points = laboratory("linear", 0.3, seed=7, pixels=250)
    a = phantom.form(noise_seed=1).b_mode(grid=phantom.grid)
    b = phantom.form(field, noise_seed=2).b_mode(grid=phantom.grid)
    other = Phantom(LINEAR, phantom.grid, seed=99).form(noise_seed=3).b_mode(grid=phantom.grid)
    torn = b.pixels.copy()
    torn[:, 150:] = other.pixels[:, 150:]
    found = FlowTracker().motion(a, UltrasoundImage(torn, phantom.grid), points)
    lost, kept = points[:, 0] > 17.0, points[:, 0] < 12.0
    assert np.median(found.confidence[kept]) > 0.7
    assert np.median(found.confidence[lost]) < 0.2


def test_outliers_take_their_neighbours_motion_and_say_so():
    grid = RegularGrid((12, 12), (0.5, 0.5))
    smooth = 0.1 * np.sin(grid.nodes / 3.0)
    wild = smooth.copy()
    wild[[40, 77]] += 0.5
    mended = Neighbours.of(grid.nodes).mended(Motion(wild, np.ones(144)), 0.3)
    assert np.flatnonzero(mended.confidence == 0).tolist() == [40, 77]
    assert np.abs(mended.displacement - smooth).max() < 0.01
    assert np.array_equal(np.delete(mended.displacement, [40, 77], 0), np.delete(smooth, [40, 77], 0))


def test_needle_is_no_tissue():
    phantom, field, points = laboratory("linear", 0.3, seed=8, pixels=250)
    frames = [phantom.form(noise_seed=1), phantom.form(field, noise_seed=2)]
    pose = NeedlePose((12.0, 24.0), (12.0, 12.0))
    found = track(frames, points, FlowTracker(), times=np.arange(2.0), needle=[None, pose], needle_radius=0.8)
    near, far = pose.closest(points)[1] < 0.7, pose.closest(points)[1] > 1.3
    assert (found.confidence[1, near] == 0).all()
    assert found.confidence[1, far].min() > 0.3
    assert (found.confidence[0] == 1).all()


def test_points_outside_the_picture_are_not_trusted():
    phantom, field, _ = laboratory("linear", 0.1, seed=8, pixels=100)
    found = FlowTracker().motion(phantom.form(), phantom.form(field), np.array([[5.0, 5.0], [-1.0, 5.0]]))
    assert found.confidence[0] > 0.5
    assert found.confidence[1] == 0.0


def test_black_pictures_give_no_confidence_and_no_nan():
    grid = RegularGrid((64, 64), (0.1, 0.1))
    black = UltrasoundImage(np.zeros((64, 64), np.uint8), grid)
    for tracker in (FlowTracker(), BlockMatching(window=(1, 1), search=0.3)):
        found = tracker.motion(black, black, np.array([[3.0, 3.0]]))
        assert found.confidence[0] == 0.0
        assert np.isfinite(found.displacement).all()


@pytest.mark.parametrize("kind", ["rgb", "float", "uint16"])
def test_any_pixel_type_gives_the_same_motion(kind):
    phantom, field, points = laboratory("linear", 0.3, seed=8, pixels=150)
    a, b = (e.b_mode(grid=phantom.grid).pixels for e in (phantom.form(), phantom.form(field)))
    change = {
        "rgb": lambda x: np.repeat(x[..., None], 3, axis=-1),
        "float": lambda x: x / 255.0,
        "uint16": lambda x: x.astype(np.uint16) * 256,
    }[kind]
    want = FlowTracker().motion(*(UltrasoundImage(x, phantom.grid) for x in (a, b)), points)
    got = FlowTracker().motion(*(UltrasoundImage(change(x), phantom.grid) for x in (a, b)), points)
    assert max(rmse(want.displacement - got.displacement)) < (1e-9 if kind == "rgb" else 1.0)


def _two():
    grid = RegularGrid((40, 40), (0.1, 0.1))
    return [UltrasoundImage(np.zeros((40, 40), np.uint8), grid)] * 2


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: track(_two(), np.zeros((3, 2)), FlowTracker()), "needs 2 times"),
        (
            lambda: track(_two(), np.zeros((3, 2)), FlowTracker(), times=np.arange(2.0), step=0),
            "step must be",
        ),
        (
            lambda: track(_two(), np.zeros((3, 2)), FlowTracker(), times=np.arange(2.0), reference="x"),
            "reference is keyframe",
        ),
        (
            lambda: track(_two(), np.zeros((3, 2)), FlowTracker(), times=np.arange(2.0), needle=[None]),
            "one needle pose per frame",
        ),
        (lambda: track(_two(), np.zeros((3, 3)), FlowTracker(), times=np.arange(2.0)), "must have shape"),
        (lambda: FlowTracker(window=0), "positive lengths"),
        (lambda: BlockMatching(search=-1), "positive window"),
    ],
)
def test_bad_input_is_refused_with_a_reason(make, words):
    with pytest.raises(InputError, match=words):
        make()


def test_rotating_disk_is_tracked_to_a_rigid_rotation(recordings):
    # real channel data (PyMUST's PWI_disk): whatever is not the best rigid motion is error
    rf = loadmat(recordings / "pymust" / "PWI_disk.mat")["RF"]
    array = LinearArray(frequency=5.0, sampling=20.0 / 3.0, pitch=0.298, start=9.95, sound_speed=1.48)
    grid = RegularGrid((251, 501), (0.1, 0.05), (-12.5, 10.0))
    echoes = [delay_and_sum(demodulate(rf[:, :, k], array), array, grid) for k in range(3)]
    level = np.sqrt(np.mean(np.abs(echoes[0].iq) ** 2))
    echoes = [Echo(e.iq / level, grid, e.carrier) for e in echoes]
    points = RegularGrid((40, 40), (0.5, 0.5), (-11.0, 12.0)).nodes
    points = points[np.hypot(points[:, 0] + 0.8, points[:, 1] - 22.5) < 8.5]
    angles, left = [], []
    for a, b in pairwise(echoes):
        u = FlowTracker().motion(a, b, points).displacement
        rigid, angle = rigid_motion(points, u)
        left.append(u - rigid)
        angles.append(angle)
    axial, lateral = rmse(np.concatenate(left))
    assert axial < 8.0
    assert lateral < 20.0
    assert angles == pytest.approx([angles[0]] * 2, rel=0.1)  # it turns evenly
    assert angles[0] == pytest.approx(0.0064, rel=0.1)


def test_rigid_motion_is_recovered():
    points = np.random.default_rng(0).uniform(0, 10, (50, 2))
    angle = 0.3
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    u = points @ turn.T + [1.0, -2.0] - points
    field, found = rigid_motion(points, u)
    assert found == pytest.approx(angle)
    assert np.allclose(field, u)


def test_beamformer_focuses_a_point_where_it_is():
    # echoes of one point by its travel times, an independent signal model
    array = LinearArray(frequency=5.0, sampling=40.0, pitch=0.3, start=5.0, sound_speed=1.54, f_number=1.0)
    x_e = (np.arange(64) - 31.5) * 0.3
    t = 5.0 + np.arange(1200) / 40.0
    x, y = 1.3, 12.0
    arrival = (y + np.hypot(x - x_e, y)) / 1.54
    late = t[:, None] - arrival
    rf = np.exp(-0.5 * (late / 0.13) ** 2) * np.cos(2 * np.pi * 5.0 * late)
    grid = RegularGrid((81, 161), (0.05, 0.025), (-0.7, 10.0))
    echo = delay_and_sum(demodulate(rf, array, bandwidth=1.2), array, grid)
    best = np.unravel_index(echo.envelope().argmax(), echo.iq.shape)
    assert (grid.x[best[1]], grid.y[best[0]]) == pytest.approx((x, y), abs=0.05)
    # the baseband's phase is that of the definition, exp(-2 pi i k y), at the point
    phase = np.angle(echo.iq[best] * np.exp(2j * np.pi * echo.carrier * y))
    assert abs(phase) < 0.3


def test_real_muscle_is_brought_back(recordings):
    # in-vivo calf (TimTrack): the later frame taken back by the tracked field looks more like the first one
    files = [recordings / "timtrack" / f"gastroc_jumping_0{k}.png" for k in (86, 90)]
    frames = [
        UltrasoundImage.from_array(
            np.ascontiguousarray(cv2.imread(str(f), cv2.IMREAD_GRAYSCALE)[64:516, 114:686]), (0.0868, 0.0868)
        )
        for f in files
    ]
    mesh = RegularGrid.covering(frames[0].grid, (143, 113))
    found = track(frames, mesh.nodes, FlowTracker(), times=np.arange(2.0))
    trusted = found.confidence[1] > 0.3
    assert trusted.mean() > 0.5
    shape = (113, 143)
    u = regrid(
        found.displacement[1].reshape(*shape, 2).astype(np.float32), mesh, frames[0].grid
    ) / np.float32(0.0868)
    x = np.arange(572, dtype=np.float32)[None, :] + u[..., 0]
    y = np.arange(452, dtype=np.float32)[:, None] + u[..., 1]
    back = cv2.remap(frames[1].pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    area = regrid(trusted.reshape(shape).astype(np.float32), mesh, frames[0].grid) > 0.5
    before, after = (np.corrcoef(frames[0].pixels[area], z[area])[0, 1] for z in (frames[1].pixels, back))
    assert after > 0.95
    assert 1.0 - after < 0.6 * (1.0 - before)
