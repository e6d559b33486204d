"""Pictures of planes through a volume: against SciPy's interpolation, an analytic inverse and the needle's profile."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from echospline.errors import InputError
from echospline.mechanics.space_response import SpaceResponse, block
from echospline.picture import NeedleEcho
from echospline.picture.slices import NativeVolume, SliceDrawing, gradients, origins
from echospline.scene import Probe, SpatialPose, Tissue, Volume, probe_plane

RNG = np.random.default_rng(4)
SHAPES = [(8, 8, 8), (17, 9, 30), (33, 41, 12), (5, 3, 2), (1, 7, 9)]


def random_volume(shape, spacing=(1.0, 1.0, 1.0), origin=(0.0, 0.0, 0.0)):
    return Volume(RNG.integers(0, 255, shape[::-1]).astype(np.uint8), spacing, origin)


def smooth_volume(n=48, spacing=0.8):
    """Brightness that changes over some millimetres, with its surface at y = 0."""
    size = spacing * (n - 1)
    z, y, x = np.meshgrid(*(np.arange(n) * spacing,) * 3, indexing="ij")
    grey = 128 + 60 * np.sin(x / 3.0) * np.cos(y / 4.0) + 50 * np.sin(z / 2.5)
    return Volume(np.rint(grey).astype(np.uint8), (spacing,) * 3, (-size / 2, 0.0, -size / 2))


@pytest.mark.parametrize("shape", SHAPES)
def test_a_slice_is_scipys_interpolation(shape):
    volume = random_volume(shape, (0.5, 0.7, 0.9), (-2.0, 0.0, 3.0))
    columns, rows, step = 37, 29, 4
    corner, right, down = RNG.uniform(0.1, 0.9, 3), RNG.uniform(-0.3, 0.3, 3), RNG.uniform(-0.3, 0.3, 3)
    size = np.array(volume.size)
    i, j = np.meshgrid(np.arange(0, columns + step, step), np.arange(0, rows + step, step))
    i, j = i[:, : (columns - 2) // step + 2], j[: (rows - 2) // step + 2]
    i, j = i[: j.shape[0]], j[:, : i.shape[1]]
    places = volume.origin + size * (
        corner + np.multiply.outer(i / columns, right) + np.multiply.outer(j / rows, down)
    )
    pixels, outside = NativeVolume(volume).slice(places, (columns, rows), step, np.array([0.0, 0.0, 1.0]))
    c, r = np.meshgrid(np.arange(columns), np.arange(rows))
    exact = volume.origin + size * (
        corner + np.multiply.outer(c / columns, right) + np.multiply.outer(r / rows, down)
    )
    index = (exact - volume.origin) / volume.spacing
    expected = map_coordinates(
        volume.voxels.astype(float), index.reshape(-1, 3)[:, ::-1].T, order=1, mode="nearest"
    )
    inside = volume.contains(exact.reshape(-1, 3))
    assert np.abs(pixels.ravel()[inside] - expected[inside]).max() <= 0.6  # rounded, and single precision
    edge = np.abs(index.reshape(-1, 3) - np.clip(index.reshape(-1, 3), 0, np.subtract(volume.shape, 1))).max(
        axis=1
    )
    assert outside == pytest.approx((~inside).sum(), abs=int((edge[~inside] < 2e-3).sum()) + 1)


def test_a_thick_slice_is_the_mean_across_its_profile():
    volume = smooth_volume()
    grid = Probe(width=20, depth=20, pixel=0.5).grid
    plane = probe_plane((0.0, 5.0, 0.0), 30.0, 20.0)
    places = plane.lift(grid.nodes).reshape(*grid.shape[::-1], 3)
    sigma = np.full(grid.shape[1], 1.2)
    thick, _ = NativeVolume(volume).slice(places, grid.shape, 1, plane.matrix[:3, 2], sigma)
    offsets = np.linspace(-5, 5, 201)
    weights = np.exp(-0.5 * (offsets / 1.2) ** 2)
    many = [volume.sample(places.reshape(-1, 3) + z * plane.matrix[:3, 2]) for z in offsets]
    expected = np.tensordot(weights / weights.sum(), many, 1)
    thin, _ = NativeVolume(volume).slice(places, grid.shape, 1, plane.matrix[:3, 2])
    missed = np.abs(thick.ravel() - expected).mean(), np.abs(thin.ravel() - expected).mean()
    assert missed[0] < 0.6  # three samples stand for the profile
    assert missed[0] < missed[1] / 3


def test_outside_and_unseen_pixels_are_background():
    volume = random_volume((9, 9, 9))
    places = np.stack(np.meshgrid(np.arange(-4.0, 13.0), np.arange(-4.0, 13.0)), axis=-1)
    places = np.concatenate([places, np.full((17, 17, 1), 4.0)], axis=-1)
    mask = np.ones((17, 17), dtype=bool)
    mask[:, :6] = False
    pixels, outside = NativeVolume(volume).slice(places, (17, 17), 1, np.eye(3)[2], None, mask, 7)
    np.testing.assert_array_equal(pixels[4:13, 6:13], volume.voxels[4][:, 2:])
    shown = np.zeros((17, 17), dtype=bool)
    shown[4:13, 6:13] = True
    assert set(pixels[~shown]) == {7}
    assert outside == 17 * 11 - 9 * 7


def bump(p, height=1.5, width=4.0, centre=(0.0, 12.0, 0.0)):
    """Displacement along (1, 1, 0) that falls off as a Gaussian; its inverse is not elementary, its forward map is."""
    d = p - np.array(centre)
    fall = height * np.exp(-(d * d).sum(axis=1) / (2 * width**2))
    return np.outer(fall, np.array([1.0, 1.0, 0.3]) / 1.5)


def test_origins_are_where_the_forward_map_comes_from():
    places = RNG.uniform([-15, 0, -5], [15, 30, 5], (500, 3))
    X, missed, jacobian = origins(places, bump, 1e-4)
    assert missed.max() < 1e-4
    np.testing.assert_allclose(X + bump(X), places, atol=2e-4)
    assert jacobian.min() > 0


def test_gradients_are_those_of_the_formula():
    p = RNG.uniform([-5, 5, -5], [5, 20, 5], (50, 3))
    G = gradients(p, bump)
    u, d = bump(p), p - np.array([0.0, 12.0, 0.0])
    np.testing.assert_allclose(G, -u[:, :, None] * d[:, None, :] / 16.0, atol=1e-5)


def test_the_deformed_picture_shows_undeformed_tissue_where_it_came_from():
    volume, probe = smooth_volume(), Probe(width=30, depth=30, pixel=0.15, elevation=0.0)
    drawing = SliceDrawing(volume, probe)
    plane = probe_plane((0.0, 0.0, 1.0), 25.0, 10.0)
    drawn = drawing.draw(plane, bump)
    X = origins(plane.lift(probe.grid.nodes), bump, 1e-4)[0]
    expected, inside = volume.sample(X), volume.contains(X)
    error = np.abs(drawn.image.pixels.ravel().astype(float) - expected)[inside]
    assert error.mean() < 0.6
    assert error.max() < 6.0
    assert drawn.residual < 0.25
    assert drawn.folds is None
    moved = np.abs(drawing.draw(plane).image.pixels.astype(float) - drawn.image.pixels)
    assert moved.mean() > 1.0


def test_a_fold_is_found_and_placed():
    drawing = SliceDrawing(smooth_volume(), Probe(width=30, depth=30, pixel=0.2, elevation=0.0))
    pose = SpatialPose((-10.0, 0.0, 0.0), (0.0, 12.0, 0.0))
    drawn = drawing.draw(probe_plane((0, 0, 0)), lambda p: bump(p, height=12.0), pose)
    assert drawn.folds is not None
    assert drawn.folds.worst <= 0
    assert np.linalg.norm(np.subtract(drawn.folds.place, (0.0, 12.0, 0.0))) < 8.0
    assert "folds at" in str(drawn.folds)


def test_a_needle_fades_with_its_distance_from_the_plane_as_the_beam_s_profile_does():
    """A shaft parallel to the plane, at its depth of focus: amplitude exp(-z^2 / (2 sigma^2)), so decibels fall as z^2."""
    volume = Volume(np.zeros((40, 40, 40), np.uint8), (1.0, 1.0, 1.0), (-19.5, 0.0, -19.5))
    probe = Probe(width=30, depth=30, pixel=0.1)
    drawing = SliceDrawing(volume, probe)
    looks = NeedleEcho(
        tip=False,
        tail=False,
        shadow=False,
        wobble=0.0,
        patches=0.0,
        roughness=-300.0,
        steering=0.0,
        specular=-5.0,
    )
    pose = SpatialPose((-12.0, 18.0, 0.0), (12.0, 18.0, 0.0))
    brightest = []
    distances = np.array([0.0, 0.4, 0.8, 1.2])
    for z in distances:
        pixels = drawing.draw(probe_plane((0.0, 0.0, z)), None, pose, looks).image.pixels
        brightest.append(float(np.median(pixels[:, 100:200].max(axis=0))))
    decibels = (np.array(brightest) - brightest[0]) / 255.0 * looks.dynamic_range
    expected = -20 * np.log10(np.e) * distances**2 / (2 * probe.elevation**2)
    np.testing.assert_allclose(decibels, expected, atol=0.05 * abs(expected[-1]))


def test_a_needle_across_the_plane_is_a_spot_and_is_lost_beyond_it():
    volume = Volume(np.zeros((40, 40, 40), np.uint8), (1.0, 1.0, 1.0), (-19.5, 0.0, -19.5))
    drawing = SliceDrawing(volume, Probe(width=30, depth=30, pixel=0.1))
    pose = SpatialPose((-14.0, 4.0, 0.0), (6.0, 20.0, 0.0))
    along = drawing.draw(probe_plane((0, 0, 0)), None, pose, NeedleEcho()).image.pixels
    across = drawing.draw(probe_plane((0, 0, 0), 90.0), None, pose, NeedleEcho()).image.pixels
    lost = drawing.draw(probe_plane((12.0, 0, 0), 90.0), None, pose, NeedleEcho()).image.pixels
    row, column = np.unravel_index(across.argmax(), across.shape)
    # the shaft crosses x = 0 at y = 4 + 14 / 20 * 16 = 15.2 mm
    assert abs(row * 0.1 - 15.2) < 0.6
    assert abs(column * 0.1 - 15.0) < 0.6
    assert (across > 100).sum() < 0.2 * (along > 100).sum()
    assert lost.max() < 40


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: NativeVolume(Volume(np.zeros((4, 4, 4), np.int16), (1.0, 1.0, 1.0))), "choose a window"),
        (lambda: Probe(pixel=0.005, width=400.0), "larger pixels"),
        (lambda: Probe(opening=200.0, shape="curved"), "from 1 to 179"),
        (lambda: random_volume((4, 4, 4)).with_depth("w"), "depth runs along one of"),
        (lambda: random_volume((4, 4, 4)).windowed(3, 3), "from a lower to a higher"),
        (
            lambda: NativeVolume(random_volume((9, 9, 9))).slice(
                np.zeros((2, 2, 3)), (20, 20), 4, np.eye(3)[2]
            ),
            "lattice must hold",
        ),
        (
            lambda: NativeVolume(random_volume((9, 9, 9))).slice(
                np.full((2, 2, 3), np.nan), (4, 4), 4, np.eye(3)[2]
            ),
            "numbers in mm",
        ),
    ],
)
def test_what_makes_no_sense_gets_a_sentence(make, said):
    with pytest.raises(InputError, match=said):
        make()


@pytest.mark.parametrize("axis", ["x", "-x", "y", "-y", "z", "-z"])
def test_turning_a_volume_keeps_it_right_handed_and_its_depth_along_y(axis):
    volume = random_volume((5, 6, 7), (0.5, 0.6, 0.7))
    turned = volume.with_depth(axis)
    old = "xyz".index(axis[-1])
    first = [0, 0, 0]
    first[old] = -1 if axis.startswith("-") else 0
    along = [slice(None)] * 3
    line = volume.voxels.transpose(2, 1, 0)
    along[old] = slice(None, None, -1 if axis.startswith("-") else 1)
    depths = line[tuple(along)].mean(axis=tuple(k for k in range(3) if k != old))
    np.testing.assert_allclose(turned.voxels.mean(axis=(0, 2)), depths)
    assert turned.spacing[1] == volume.spacing[old]
    assert turned.origin[1] == 0.0
    # right-handed: the determinant of the map from new axes to old ones is 1, so a helix keeps its sense
    marks = np.zeros((7, 6, 5), np.uint8)
    marks[0, 0, 0], marks[0, 0, 4], marks[0, 5, 0], marks[6, 0, 0] = 1, 2, 3, 4
    found = Volume(marks, (0.5, 0.6, 0.7)).with_depth(axis)
    at = {int(v): np.argwhere(found.voxels == v)[0][::-1] * found.spacing for v in (1, 2, 3, 4)}
    edges = np.array([at[2] - at[1], at[3] - at[1], at[4] - at[1]])
    assert np.linalg.det(edges) > 0


def test_planes_turn_as_hands_do():
    straight = probe_plane((1.0, 0.0, 2.0))
    np.testing.assert_allclose(straight.lift(np.array([[3.0, 4.0]])), [[4.0, 4.0, 2.0]])
    np.testing.assert_allclose(
        probe_plane((0, 0, 0), yaw=90).lift(np.array([[1.0, 0.0]])), [[0, 0, -1]], atol=1e-12
    )
    np.testing.assert_allclose(
        probe_plane((0, 0, 0), pitch=90).lift(np.array([[0.0, 1.0]])), [[0, 0, 1]], atol=1e-12
    )
    np.testing.assert_allclose(
        probe_plane((0, 0, 0), roll=90).lift(np.array([[0.0, 1.0]])), [[-1, 0, 0]], atol=1e-12
    )
    plane = probe_plane((3.0, 1.0, -2.0), 40.0, 20.0, -10.0)
    p = RNG.normal(size=(10, 3))
    np.testing.assert_allclose(plane.lower(plane.lift(p[:, :2]))[:, :2], p[:, :2], atol=1e-12)


def test_the_core_traces_a_plane_back_as_numpy_does():
    """The same lattice, residual and folds from both, where tissue is moved a little and where it folds."""
    volume, probe = smooth_volume(), Probe(width=30, depth=30, pixel=0.15, elevation=0.0)
    drawing = SliceDrawing(volume, probe)
    plane = probe_plane((0.0, 0.0, 1.0), 25.0, 10.0)
    grid, clamps = block((36.0, 36.0, 36.0), {"bottom": "clamped", "left": "clamped", "right": "clamped"})
    response = SpaceResponse(grid, clamps, Tissue(10.0, 0.45), radius=0.7)
    places = np.array([[-6.0, 4.0, 0.0], [-3.0, 8.0, 0.5], [0.0, 12.0, 1.0]])
    pose = SpatialPose((-9.0, 0.0, -0.5), (0.0, 12.0, 1.0))
    for force, folded in ((0.05, False), (0.4, True)):
        field = response.field(places, force * np.array([[0.2, 0.3, 0.0], [0.2, 0.3, 0.1], [0.6, 0.8, 0.1]]))
        ours = drawing.draw(plane, field, pose)
        theirs = drawing.draw(plane, lambda p, f=field: f(p), pose)  # a callable that the core does not know
        assert (ours.folds is not None) == (theirs.folds is not None) == folded
        if not folded:
            np.testing.assert_allclose(ours.lattice, theirs.lattice, atol=2e-5)
            assert ours.residual == pytest.approx(theirs.residual, abs=1e-3)
            assert np.abs(ours.image.pixels.astype(int) - theirs.image.pixels).max() <= 1
        else:
            assert ours.folds.worst == pytest.approx(theirs.folds.worst, abs=1e-3)
            np.testing.assert_allclose(ours.folds.place, theirs.folds.place, atol=1e-3)
