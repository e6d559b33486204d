"""What is made of a scene in space: sequences with the pose of every picture, the motion that a picture shows, and what follows from both."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from echospline import simulate
from echospline.errors import InputError
from echospline.io import is_spatial_record, read_displacement, read_spatial_displacement
from echospline.io.displacement_space import SpatialDisplacementWriter
from echospline.io.sequence import SequenceWriter, read_sequence
from echospline.laboratory.reconstruct import reconstruct
from echospline.mechanics import NeedleForces
from echospline.mechanics.spatial_force_model import SpatialForceModel
from echospline.picture.slices import lattice_of
from echospline.scene import (
    Cine,
    ImagingPlane,
    PlanePath,
    Probe,
    SpatialInsertion,
    SpatialPose,
    Volume,
    probe_plane,
    seen_motion,
    transform_between,
)
from echospline.tracking import FlowTracker, Track, read_track, score, track
from echospline.tracking.score import true_motion

PROBE = Probe(width=20.0, depth=20.0, pixel=0.25, elevation=0.0)


def cloudy(seed: int = 0, sigma: float = 3.0) -> Volume:
    """Smooth brightness, 0.5 mm voxels, 24 x 24 x 24 mm."""
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=(49, 49, 49)), sigma)
    grey = 128 + 40 * noise / noise.std()
    return Volume(grey.clip(1, 255).astype(np.uint8), (0.5, 0.5, 0.5), (-12.0, 0.0, -12.0))


@pytest.fixture(scope="module")
def block():
    volume = cloudy()
    return volume, SpatialForceModel.green(volume.mesh((9, 9, 9)), forces=NeedleForces(tip=0.2))


def resting() -> SpatialInsertion:
    """A needle that only touches the skin."""
    return SpatialInsertion(
        np.array([0.0, 1.0]), np.array([-5.0, 0, 0]), np.array([[-5.0, 0, 0], [-5.0, 0, 0]])
    )


@pytest.mark.parametrize("ending", [".igs.mha", ".seq.nrrd"])
@pytest.mark.parametrize(
    ("first", "last"),
    [
        (((0, 0, -8.0), 0.0), ((0, 0, 8.0), 0.0)),
        (((-8.0, 0, 1.0), 90.0), ((8.0, 0, 1.0), 90.0)),
        (((-4.0, 0, -6.0), 30.0, 5.0), ((4.0, 0, 6.0), 30.0, -5.0)),
    ],
    ids=["along z", "along x", "oblique and fanned"],
)
def test_a_simulated_sweep_reconstructed_is_the_volume(block, tmp_path: Path, ending, first, last):
    """Simulated, written, read and reconstructed by four separate pieces: poses, origin and spacing must all agree."""
    # so smooth that linear insertion, which blurs by a voxel, changes little
    volume, model = cloudy(sigma=5.0), block[1]
    path = PlanePath(np.array([0.0, 1.0]), (probe_plane(*first), probe_plane(*last)))
    file = tmp_path / f"run{ending}"
    with SequenceWriter(file, PROBE.grid) as writer:
        for frame in simulate(volume, resting(), model, probe=PROBE, plane=path, fps=48):
            writer.add(frame.image.pixels, frame.time, frame.pose, frame.plane)
    sweep = read_sequence(file)
    matrices = np.stack([transform_between(sweep.known(i), "Image", "Reference") for i in range(len(sweep))])
    again = reconstruct(sweep.frames, matrices, 0.5)
    iz, iy, ix = np.nonzero(again.filled)
    places = np.array(again.origin) + 0.5 * np.stack([ix, iy, iz], axis=1)
    inside = volume.contains(places - 1.0) & volume.contains(
        places + 1.0
    )  # beyond its edge pictures are black
    truth = volume.sample(places[inside])
    difference = again.voxels[iz, iy, ix][inside] - truth
    assert len(truth) > 20_000
    assert np.abs(difference).mean() < 1.0
    assert np.corrcoef(again.voxels[iz, iy, ix][inside], truth)[0, 1] > 0.998


def test_every_picture_of_a_sequence_says_where_plane_and_needle_are(block, tmp_path: Path):
    volume, model = block
    needle = SpatialInsertion.straight((-6.0, 0, -1.0), (1.0, 1.0, 0.2), 10.0, 10.0)
    path = PlanePath(np.array([0.0, 1.0]), (probe_plane((0, 0, -3), 10.0), probe_plane((1, 0, 3), 80.0, 5.0)))
    file = tmp_path / "run.igs.mha"
    with SequenceWriter(file, PROBE.grid) as writer:
        for frame in simulate(volume, needle, model, probe=PROBE, plane=path, fps=4):
            writer.add(frame.image.pixels, frame.time, frame.pose, frame.plane)
    sequence = read_sequence(file)
    for i, t in enumerate(sequence.times):
        plane, pose = path.at(float(t)), needle.pose(float(t))
        image, tip = (sequence.transforms[f"{name}ToReference"][i] for name in ("Image", "NeedleTip"))
        pixel = np.array([17.0, 31.0, 0.0, 1.0])  # column 17, row 31
        at = PROBE.grid.x[17], PROBE.grid.y[31]
        np.testing.assert_allclose((image @ pixel)[:3], plane.lift(np.array([at]))[0], atol=1e-9)
        np.testing.assert_allclose(tip[:3, 3], pose.tip, atol=1e-9)
        np.testing.assert_allclose(sequence.transforms["NeedleEntryToReference"][i, :3, 3], pose.entry)
        if pose.depth > 0:
            np.testing.assert_allclose(tip[:3, 2], pose.axis, atol=1e-9)
        assert ImagingPlane(tip)  # a rotation, right-handed


@pytest.mark.parametrize(
    "axis", [(0, 0, 1.0), (0, 0, -1.0), (1, 0, 0), (0, 1.0, 0), (0.3, 0.9, -0.3), (0, 0, 0)]
)
def test_the_frame_at_a_tip_is_a_rotation_whose_z_inserts(axis):
    pose = SpatialPose((1.0, 2.0, 3.0), tuple(np.add((1.0, 2.0, 3.0), np.multiply(axis, 7.0))))
    matrix = pose.tip_matrix()
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(matrix[:3, 2], pose.axis if pose.depth else (0, 1, 0), atol=1e-12)


def test_still_tissue_moves_against_the_probe():
    """A probe that shifts by s shows still tissue shifted by -s; what it turns away from is out of its plane by that much."""
    probe = Probe(width=20.0, depth=20.0, pixel=0.5, elevation=1.0, elevation_depth=10.0, element_height=0.0)
    first = np.array([[x, y] for x in (-5.0, 0.0, 5.0) for y in (4.0, 8.0)])
    before = probe_plane((1.0, 0.0, 2.0), 25.0, 10.0)
    turn = before.matrix[:3, :3]
    shift = turn @ np.array([1.0, -2.0, 0.7])
    after = np.eye(4)
    after[:3, :3], after[:3, 3] = turn, before.matrix[:3, 3] + shift
    seen = seen_motion(first, before.lift(first), ImagingPlane(after), probe, np.ones(6, bool))
    np.testing.assert_allclose(seen.displacement, np.tile((-1.0, 2.0), (6, 1)), atol=1e-12)
    np.testing.assert_allclose(seen.out_of_plane, -0.7, atol=1e-12)
    assert seen.valid.all()
    thin = seen_motion(first, before.lift(first), ImagingPlane(after), Probe(elevation=0.0), np.ones(6, bool))
    assert not thin.valid.any()


def test_a_turned_probe_shows_the_inverse_turn():
    first = np.array([[3.0, 6.0], [-4.0, 10.0]])
    turn = Rotation.from_euler("z", 7.0, degrees=True).as_matrix()
    after = np.eye(4)
    after[:3, :3] = turn
    seen = seen_motion(first, np.c_[first, np.zeros(2)], ImagingPlane(after), PROBE, np.ones(2, bool))
    np.testing.assert_allclose(first + seen.displacement, first @ turn[:2, :2], atol=1e-12)


def test_tissue_beyond_the_picture_or_never_seen_is_not_valid():
    first = np.array([[9.0, 5.0], [0.0, 5.0], [0.0, 6.0]])
    plane = probe_plane((-3.0, 0.0, 0.0))  # tissue moves right by 3 mm in the picture: the first leaves it
    seen = seen_motion(first, np.c_[first, np.zeros(3)], plane, PROBE, np.array([True, True, False]))
    assert seen.valid.tolist() == [False, True, False]
    with pytest.raises(InputError, match="shapes"):
        seen_motion(first, first, plane, PROBE, np.ones(3, bool))


SCORED = Probe(width=20.0, depth=20.0, pixel=0.1, elevation=1.0, elevation_depth=10.0, element_height=0.0)


@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    """A cine of fine speckle by a probe that shifts in its plane and drifts out of it, tracked, and the record of its truth.

    Across the slice speckle is as long as a beam of sigma 1 mm makes it: a correlation of exp(-d^2 / 2), of noise smoothed over 1 mm / sqrt(2).
    """
    noise = gaussian_filter(np.random.default_rng(5).normal(size=(81, 81, 81)), (2.36, 1.0, 1.0))
    grey = (128 + 45 * noise / noise.std()).clip(1, 255).astype(np.uint8)
    volume = Volume(grey, (0.3, 0.3, 0.3), (-12.0, 0.0, -12.0))
    model = SpatialForceModel.green(volume.mesh((9, 9, 9)), forces=NeedleForces(tip=0.1))
    needle = SpatialInsertion.straight((-8.0, 0, 0), (1.0, 1.0, 0.0), 8.0, 8.0)
    path = PlanePath(np.array([0.0, 1.0]), (probe_plane((0, 0, 0)), probe_plane((0.6, 0.0, 1.5))))
    frames = list(simulate(volume, needle, model, probe=SCORED, plane=path, fps=10))
    lattice = lattice_of(SCORED)
    file = tmp_path_factory.mktemp("tracked") / "displacement.npz"
    writer = SpatialDisplacementWriter(file, model.grid.nodes, lattice.nodes.reshape(*lattice.shape[::-1], 2))
    for f in frames:
        writer.add(f.displacement, f.time, f.pose, f.plane, f.places, f.seen_from(frames[0], SCORED, volume))
    truth = read_track(writer.close())
    first = frames[0].image.grid
    pixels = np.stack([f.image.pixels for f in frames])
    cine = Cine(pixels, truth.motion.times, type(first)(first.shape, first.spacing), "speckle")
    x, y = np.meshgrid(np.arange(3.0, 17.1, 1.0), np.arange(3.0, 17.1, 1.0))
    return track(cine, np.stack([x.ravel(), y.ravel()], axis=1), FlowTracker()), truth


def test_a_track_is_near_the_truth_of_its_picture_while_the_tissue_is_in_the_slice(tracked):
    found, truth = tracked
    told = score(found, truth)
    assert told.points > 500
    assert told.followed > 0.6
    assert told.axial_um < 60
    assert told.lateral_um < 60
    assert told.motion_um > 150
    # the probe drifts 1.5 mm out of the first plane, the slice keeps 1 mm: the last frames have no truth left
    _, known = true_motion(truth, found.points, found.times)
    assert known[:7].any(axis=1).all()
    assert not known[-2:].any()
    assert np.isfinite(told.gone_trusted)


def test_a_score_is_the_error_that_was_made(tracked):
    _, truth = tracked
    times = truth.motion.times[:6]
    points = np.array([[5.03, 6.0], [9.0, 11.11]])
    motion, known = true_motion(truth, points, times)
    assert known.all()
    confidence = np.ones((6, 2))
    exact = score(Track(points, times, motion, confidence), truth)
    assert (exact.axial_um, exact.lateral_um, exact.outliers, exact.points) == (0.0, 0.0, 0.0, 10)
    off = motion + np.array([0.03, -0.04])
    off[2, 0] += (0.2, 0.0)
    confidence[3, 1] = 0.0
    told = score(Track(points, times, off, confidence), truth)
    assert told.points == 9
    assert told.axial_um == pytest.approx(40.0)
    assert told.lateral_um == pytest.approx(1e3 * np.sqrt((8 * 0.03**2 + 0.23**2) / 9))
    assert told.outliers == pytest.approx(1 / 9)
    assert told.followed == pytest.approx(0.9)
    assert np.isnan(told.gone_trusted)


def test_the_truth_between_its_points_and_times_is_linear(tracked):
    record = tracked[1].motion
    nx = record.grid().shape[0]
    i = 5 * nx + 6
    middle = (record.points[i] + record.points[i + nx]) / 2
    t = (record.times[2] + record.times[3]) / 2
    found, known = true_motion(tracked[1], middle[None], np.array([t]))
    assert known.all()
    np.testing.assert_allclose(
        found[0, 0], record.displacement[2:4, [i, i + nx]].mean(axis=(0, 1)), atol=1e-9
    )
    with pytest.raises(InputError, match="are both of one run"):
        true_motion(tracked[1], middle[None], np.array([0.0, 9.0]))


@pytest.fixture(scope="module")
def run(block):
    """Needle in the plane, while the probe shifts along its own face and down, and drifts 0.2 mm out of its plane."""
    volume, model = block
    needle = SpatialInsertion.straight((-8.0, 0, 0), (1.0, 1.0, 0.0), 12.0, 12.0)
    path = PlanePath(np.array([0.0, 1.0]), (probe_plane((0, 0, 0)), probe_plane((1.2, 0.0, 0.2), roll=2.0)))
    return list(simulate(volume, needle, model, probe=PROBE, plane=path, fps=5))


def test_pictures_agree_with_the_motion_that_they_are_said_to_show(block, run):
    """Brightness goes with the tissue: picture k at p + d is picture 0 at p, where no more than the slice's own tissue is looked at."""
    volume, _ = block
    first, grid = run[0], PROBE.grid
    at = lattice_of(PROBE).nodes

    def brightness(frame, points):
        index = (points - grid.origin) / grid.spacing
        return map_coordinates(frame.image.pixels.astype(float), index.T[::-1], order=1)

    for frame in run[
        1:4
    ]:  # later ones are further out of the first plane than half a pixel, of which an infinitely thin slice keeps nothing
        seen = frame.seen_from(first, PROBE, volume)
        good = seen.valid & (np.abs(at[:, 0]) < 8.0) & (at[:, 1] > 1.0) & (at[:, 1] < 18.0)
        assert good.sum() > 15
        moved = brightness(frame, at[good] + seen.displacement[good])
        still = brightness(frame, at[good])
        before = brightness(first, at[good])
        assert np.abs(moved - before).mean() < 2.0
        assert np.abs(moved - before).mean() < 0.5 * np.abs(still - before).mean()


def test_a_record_read_as_one_of_the_plane_is_the_picture_in_the_cines_coordinates(
    block, run, tmp_path: Path
):
    volume, model = block
    lattice = lattice_of(PROBE)
    writer = SpatialDisplacementWriter(
        tmp_path / "d.npz", model.grid.nodes, lattice.nodes.reshape(*lattice.shape[::-1], 2)
    )
    seen = [frame.seen_from(run[0], PROBE, volume) for frame in run]
    for frame, motion in zip(run, seen, strict=True):
        writer.add(frame.displacement, frame.time, frame.pose, frame.plane, frame.places, motion)
    file = writer.close()
    assert is_spatial_record(file)
    whole, flat, track = read_spatial_displacement(file), read_displacement(file), read_track(file)
    assert whole.pose(3) == run[3].pose
    assert flat.grid().origin == (0.0, 0.0)
    corner = np.array(PROBE.grid.origin)
    for k, frame in enumerate(run):
        np.testing.assert_allclose(flat.displacement[k], seen[k].displacement, atol=1e-5)
        np.testing.assert_array_equal(track.confidence[k], seen[k].valid)
        tip = frame.plane.lower(np.array([frame.pose.tip]))[0]
        np.testing.assert_allclose(flat.tip[k], tip[:2] - corner, atol=1e-9)
    assert track.confidence[2].mean() > 0.5
    assert track.confidence[-1].max() == 0.0
    np.testing.assert_allclose(flat.speed[2], 12.0, rtol=0.01)  # almost in the plane


def test_a_damaged_record_in_space_is_refused(block, run, tmp_path: Path):
    volume, model = block
    lattice = lattice_of(PROBE)
    points = lattice.nodes.reshape(*lattice.shape[::-1], 2)
    writer = SpatialDisplacementWriter(tmp_path / "d.npz", model.grid.nodes, points)
    f, seen = run[0], run[0].seen_from(run[0], PROBE, volume)
    with pytest.raises(InputError, match="origins must have shape"):
        writer.add(f.displacement, f.time, f.pose, f.plane, f.places[:-1], seen)
    writer.add(f.displacement, f.time, f.pose, f.plane, f.places, seen)
    file = writer.close()
    with np.load(file) as archive:
        arrays = dict(archive)
    for name, value, said in (
        ("plane", np.zeros((2, 4, 4)), "plane must have shape"),
        ("picture_valid", np.zeros(arrays["picture_valid"].shape), "true or false"),
        ("picture_origins", arrays["picture_origins"] * np.nan, "not finite"),
    ):
        np.savez(tmp_path / "bad.npz", **{**arrays, name: value})
        with pytest.raises(InputError, match=said):
            read_spatial_displacement(tmp_path / "bad.npz")
    with pytest.raises(InputError, match="more than the limit"):
        read_spatial_displacement(file, limit=0.001)
