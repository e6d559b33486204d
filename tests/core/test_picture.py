"""The picture of the core: deformation and its inverse, folding, sampling, and the needle's echo, against independent readings."""

from __future__ import annotations

import ctypes as c
from typing import Any

import cv2
import native
import numpy as np
import pytest
from native import AUTO, BEVEL, EXACT, PULL, SHADOW, SHAFT, TAIL, Picture, library, needle
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import map_coordinates

pytestmark = pytest.mark.skipif(native.library_path() is None, reason="the core is not built")

RNG = np.random.default_rng(0)
COLUMNS, ROWS, MM = 203, 161, 0.2  # neither a multiple of the lattice nor of a vector
X, Y = np.meshgrid(np.arange(COLUMNS, dtype=float), np.arange(ROWS, dtype=float))
LEVELS = native.levels() if native.library_path() else []


def ramps() -> tuple[np.ndarray, np.ndarray]:
    """Images that show, as grey level, where each pixel comes from."""
    return X.astype(np.float32), Y.astype(np.float32)


def speckle(dtype: Any = np.uint8, colour: bool = False, top: int = 200) -> np.ndarray:
    """Noise of a type."""
    values = RNG.random((ROWS, COLUMNS, 3) if colour else (ROWS, COLUMNS)) * top
    return (values if np.dtype(dtype).kind == "f" else np.rint(values)).astype(dtype)


def bump(
    picture: Picture, amplitude: float, width: float = 4.0, at: tuple[float, float] = (20.0, 16.0)
) -> np.ndarray:
    """A push; its steepest gradient is 0.86 amplitude / width."""
    r2 = ((picture.nodes - at) ** 2).sum(axis=1)
    return amplitude * np.exp(-r2 / width**2)[:, None] * [1.0, 0.4]


def forward(picture: Picture, u: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """SciPy's reading of the forward map, in pixels; NaN outside the mesh."""
    o = picture.options
    nx, ny = o.mesh_shape
    node_x = o.mesh_origin[0] + np.arange(nx) * o.mesh_spacing[0]
    node_y = o.mesh_origin[1] + np.arange(ny) * o.mesh_spacing[1]
    at = np.stack([o.origin[1] + y * o.spacing[1], o.origin[0] + x * o.spacing[0]], axis=-1)
    field = RegularGridInterpolator((node_y, node_x), u.reshape(ny, nx, 2), bounds_error=False)(at)
    return x + field[..., 0] / o.spacing[0], y + field[..., 1] / o.spacing[1]


def positions(
    u: np.ndarray, mesh: tuple[int, int], method: int, **values: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Where a method's pixels come from, read from drawn ramps."""
    return tuple(
        Picture(ramp, mesh, method=method, border_value=-1e6, **values).deform(u).draw() for ramp in ramps()
    )  # type: ignore[return-value]


# ---- Inverse -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("mesh", [(21, 17), (2, 2), (5, 40), (COLUMNS, ROWS), (300, 7)])
@pytest.mark.parametrize("amplitude", [0.0, 0.5, 3.5])
def test_inverse_composed_with_forward_is_the_identity(level, mesh, amplitude):
    picture = Picture(speckle(), mesh, level=level, method=EXACT)
    u = bump(picture, amplitude)
    x, y = picture.deform(u).inverse()
    again_x, again_y = forward(picture, u, x.astype(float), y.astype(float))
    off = np.hypot(again_x - X, again_y - Y)
    assert np.nanmax(off) < 1e-3
    assert np.isfinite(off).mean() > 0.95  # all but the rim
    assert picture.check().residual < 1e-3
    if amplitude == 0:
        np.testing.assert_allclose(x, X, atol=1e-4)
        np.testing.assert_allclose(y, Y, atol=1e-4)


@pytest.mark.parametrize("method", [EXACT, PULL])
@pytest.mark.parametrize("mesh", [(21, 17), (2, 2), (5, 40), (60, 50), (COLUMNS, ROWS)])
@pytest.mark.parametrize("amplitude", [0.0, 0.5, 3.5])
def test_drawn_positions_are_the_exact_ones_to_a_tenth_of_a_pixel(method, mesh, amplitude):
    picture = Picture(speckle(), mesh, method=method)
    u = bump(picture, amplitude)
    x, y = picture.deform(u).inverse()
    outside = np.isnan(x)
    drawn_x, drawn_y = positions(u, mesh, method)
    np.testing.assert_array_equal(drawn_x < -1e5, outside)
    off = np.hypot(drawn_x - np.clip(x, 0, COLUMNS - 1), drawn_y - np.clip(y, 0, ROWS - 1))[~outside]
    report = picture.check()
    assert off.max() < (0.1 if method == PULL else 1e-4)
    if method == PULL and min(mesh) > 2:
        assert off.max() <= report.difference + 1e-3
        assert report.residual < 0.3
        assert report.exact_share < 0.7
    assert report.method == method


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("method", [EXACT, PULL])
def test_any_one_to_one_field_is_inverted(seed, method):
    rng = np.random.default_rng(seed)
    mesh = (rng.integers(2, 30), rng.integers(2, 30))
    spacing = rng.uniform(0.1, 0.4, 2)
    picture = Picture(speckle(), mesh, method=method, spacing=spacing)
    u = rng.uniform(-0.2, 0.2, (len(picture.nodes), 2)) * picture.options.mesh_spacing
    picture.deform(u)
    assert picture.check().folded_cells == 0
    x, y = picture.inverse()
    again_x, again_y = forward(picture, u, x.astype(float), y.astype(float))
    assert np.nanmax(np.hypot(again_x - X, again_y - Y)) < 2e-3
    drawn_x, _ = positions(u, mesh, method, spacing=spacing)
    inside = ~np.isnan(x)
    np.testing.assert_array_equal(drawn_x > -1e5, inside)
    assert np.abs(drawn_x - np.clip(x, 0, COLUMNS - 1))[inside].max() < 0.1


def test_no_pixel_is_lost_between_cells():
    # nodes on pixel centres: cell edges run through every pixel
    picture = Picture(speckle(), (COLUMNS, ROWS))
    for shift in (0.0, 0.05, 0.1, MM / 3):
        u = np.full((COLUMNS * ROWS, 2), shift)
        x, _ = picture.deform(u).inverse()
        assert not np.isnan(x[2:-2, 2:-2]).any()


def test_inverse_holds_where_a_fixed_point_diverges():
    picture = Picture(speckle(), (21, 17), method=EXACT)
    y = picture.nodes[:, 1]
    picture.deform(np.column_stack([1.5 * np.abs(y - 16), np.zeros_like(y)]))
    assert picture.check().folded_cells == 0
    x, _ = picture.inverse()
    assert picture.check().residual < 1e-3
    assert 0.2 < np.isnan(x).mean() < 0.9


@pytest.mark.parametrize("method", [EXACT, PULL])
def test_translation_uncovers_exactly_what_it_leaves(method):
    image = speckle()
    picture = Picture(image, (11, 9), border_value=7, method=method)
    moved = picture.deform(np.tile([20 * MM, 0.0], (99, 1))).draw()
    np.testing.assert_array_equal(moved[:, 20:], image[:, :-20])
    assert (moved[:, :20] == 7).all()


@pytest.mark.parametrize("method", [EXACT, PULL])
def test_the_black_wedge_has_no_steps(method):
    picture = Picture(np.full((ROWS, COLUMNS), 200, np.uint8), (11, 9), method=method)
    x, _ = picture.nodes.T
    picture.deform(np.column_stack([np.zeros_like(x), 1.0 + 0.1 * x]))  # the top edge is tilted
    first = (picture.draw() > 0).argmax(axis=0)
    expected = np.ceil((1.0 + 0.1 * np.arange(COLUMNS) * MM) / MM - 0.5 - 1e-3)
    np.testing.assert_array_equal(first, expected)


def test_single_precision_displacement_is_the_same():
    picture = Picture(speckle(), (21, 17))
    u = bump(picture, 1.5)
    x, _ = picture.deform(u).inverse()
    single, _ = picture.deform(u.astype(np.float32)).inverse()
    np.testing.assert_allclose(single, x, atol=1e-4)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (9, 1), (4, 5), (3, 64), (513, 18)])
@pytest.mark.parametrize("method", [AUTO, EXACT, PULL])
@pytest.mark.parametrize("level", LEVELS)
def test_pictures_of_any_size_come_back_unmoved(shape, method, level):
    image = RNG.integers(0, 256, shape, dtype=np.uint8)
    picture = Picture(image, (3, 3), method=method, level=level)
    np.testing.assert_array_equal(picture.draw(), image)
    assert not np.isnan(picture.inverse()[0]).any()
    assert picture.check().exact_share <= 1


def test_a_mesh_off_the_picture_leaves_the_border():
    picture = Picture(speckle(), (4, 4), mesh_origin=(500.0, 500.0), border_value=9)
    assert (picture.draw() == 9).all()
    assert np.isnan(picture.inverse()[0]).all()


def test_a_mesh_larger_than_the_picture_repeats_its_edge():
    image = speckle()
    picture = Picture(image, (4, 4), mesh_origin=(-10.0, -10.0), mesh_spacing=(25.0, 25.0))
    moved = picture.deform(np.tile([2.0, 0.0], (16, 1))).draw()
    np.testing.assert_array_equal(moved[:, 10:], image[:, :-10])
    np.testing.assert_array_equal(moved[:, :10], np.repeat(image[:, :1], 10, axis=1))


def test_automatic_is_pull_unless_the_mesh_is_finer_than_the_lattice():
    assert Picture(speckle(), (21, 17)).check().method == PULL
    assert Picture(speckle(), (COLUMNS, ROWS)).check().method == EXACT


# ---- Folds ---------------------------------------------------------------------------------------------------------


def jacobian(picture: Picture, u: np.ndarray) -> np.ndarray:
    """NumPy's reading: determinants at the corners of every cell."""
    (nx, ny), (dx, dy) = picture.options.mesh_shape, picture.options.mesh_spacing
    p = (picture.nodes + u).reshape(ny, nx, 2)
    across, down = np.diff(p, axis=1) / dx, np.diff(p, axis=0) / dy
    top, bottom, left, right = across[:-1], across[1:], down[:, :-1], down[:, 1:]
    pairs = ((top, left), (top, right), (bottom, left), (bottom, right))
    return np.stack([a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0] for a, b in pairs], axis=-1)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("amplitude", [1.0, 6.0, 8.0])
def test_folds_are_those_of_numpy(level, amplitude):
    picture = Picture(speckle(), (21, 17), level=level)
    u = bump(picture, amplitude)
    report = picture.deform(u).check()
    theirs = jacobian(picture, u)
    assert report.folded_cells == (theirs.min(axis=-1) <= 0).sum()
    assert report.smallest_jacobian == pytest.approx(theirs.min(), abs=1e-5)
    j, i, corner = np.unravel_index(theirs.argmin(), theirs.shape)
    place = picture.nodes.reshape(17, 21, 2)[j + corner // 2, i + corner % 2]
    np.testing.assert_allclose(report.place, place, atol=1e-9)


@pytest.mark.parametrize("mesh", [(21, 17), (90, 80)])
def test_folded_tissue_is_the_same_by_both_methods_and_has_no_holes(mesh):
    picture = Picture(speckle(), mesh)
    u = bump(picture, 8.0)
    x, y = picture.deform(u).inverse()
    assert picture.check().folded_cells > 0
    pulled_x, pulled_y = positions(u, mesh, PULL)
    exact_x, exact_y = positions(u, mesh, EXACT)
    assert np.hypot(pulled_x - exact_x, pulled_y - exact_y).max() < 0.1
    assert not np.isnan(x[5:-5, 5:-5]).any()
    again_x, again_y = forward(picture, u, x.astype(float), y.astype(float))
    assert np.nanmax(np.hypot(again_x - X, again_y - Y)) < 0.02


def test_a_mirrored_mesh_is_all_folded_and_still_drawn():
    image = speckle()
    picture = Picture(image, (5, 5))
    x = picture.nodes[:, 0]
    u = np.column_stack([(COLUMNS - 1) * MM - 2 * x, np.zeros_like(x)])
    np.testing.assert_array_equal(picture.deform(u).draw()[:, 1:-1], image[:, ::-1][:, 1:-1])
    assert picture.check().folded_cells == 16


# ---- Sampling ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("method", [EXACT, PULL])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int16, np.float32])
@pytest.mark.parametrize("colour", [False, True])
def test_no_motion_gives_back_the_same_pixels(level, method, dtype, colour):
    image = speckle(dtype, colour)
    if dtype == np.int16:
        image -= 100
    out = Picture(image, (11, 9), level=level, method=method).draw()
    assert out.dtype == dtype
    if dtype == np.float32:
        np.testing.assert_allclose(out, image, atol=2e-2)  # 200 grey levels between neighbours
    else:
        np.testing.assert_array_equal(out, image)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int16, np.float32])
@pytest.mark.parametrize("colour", [False, True])
def test_values_are_scipys_at_the_inverse_map(level, dtype, colour):
    image = speckle(dtype, colour) - (100 if dtype == np.int16 else 0)
    image = image.astype(dtype)
    picture = Picture(image, (21, 17), level=level, method=EXACT, border_value=3)
    out = picture.deform(bump(picture, 2.0) + np.array([0.7, 0.3])).draw()
    x, y = picture.inverse()
    planes = image.reshape(ROWS, COLUMNS, -1).astype(float)
    at = np.nan_to_num([y.astype(float), x.astype(float)])
    theirs = np.stack(
        [map_coordinates(p, at, order=1, mode="nearest") for p in np.moveaxis(planes, 2, 0)], axis=-1
    )
    theirs[np.isnan(x)] = 3
    assert np.isnan(x).any()
    tolerance = 0.01 if dtype == np.float32 else 0.51
    assert np.abs(out.reshape(theirs.shape) - theirs).max() < tolerance


def test_grey_levels_are_those_of_remap_within_one():
    image = cv2.GaussianBlur(speckle(top=255), (0, 0), 1.0)
    picture = Picture(image, (21, 17), method=EXACT)
    out = picture.deform(bump(picture, 2.0)).draw()
    x, y = picture.inverse()
    theirs = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside = ~np.isnan(x)
    assert np.abs(out.astype(int) - theirs)[inside].max() <= 1


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
@pytest.mark.parametrize("method", [EXACT, PULL])
def test_nearest_takes_the_pixel_at_the_rounded_position(dtype, method):
    image = speckle(dtype)
    picture = Picture(image, (21, 17), interpolation=1, method=EXACT)
    u = bump(picture, 1.5)
    out = Picture(image, (21, 17), interpolation=1, method=method).deform(u).draw()
    x, y = picture.deform(u).inverse()
    theirs = image[
        np.clip(np.rint(y), 0, ROWS - 1).astype(int), np.clip(np.rint(x), 0, COLUMNS - 1).astype(int)
    ]
    if method == EXACT:
        np.testing.assert_array_equal(out, theirs)
    else:
        assert (out != theirs).mean() < 0.02
    assert set(np.unique(out)) <= set(np.unique(image))


@pytest.mark.parametrize(
    ("dtype", "full"), [(np.uint8, 255), (np.uint16, 65535), (np.int16, 32767), (np.float32, 1)]
)
@pytest.mark.parametrize("colour", [False, True])
def test_transparent_outside(dtype, full, colour):
    image = speckle(dtype, colour)
    picture = Picture(image, (11, 9), border=1)
    out = picture.deform(np.tile([20 * MM, 0.0], (99, 1))).draw(needle((-5, 5, 0), (30, 10, 0)))
    assert out.shape == (ROWS, COLUMNS, 4)
    assert (out[:, :20] == 0).all()  # no tissue, no needle
    assert (out[:, 20:, 3] == full).all()
    plain = picture.draw()
    still = image if colour else np.repeat(image[..., None], 3, axis=2)
    np.testing.assert_allclose(plain[:, 20:, :3], still[:, :-20], atol=2e-2)


def test_values_saturate_at_the_types_limits():
    for value in (0, 255):
        image = np.full((ROWS, COLUMNS), value, np.uint8)
        picture = Picture(image, (11, 9), border_value=1e5 if value else -1e5)
        out = picture.deform(np.tile([4.0, 0.0], (99, 1))).draw()
        assert (out == value).all()


def test_the_reference_can_be_replaced():
    picture = Picture(speckle(), (21, 17))
    u = bump(picture, 1.0)
    picture.deform(u).draw()
    other = speckle()
    assert library().echospline_picture_reference(picture.handle, other.ctypes.data, other.nbytes) == 0
    np.testing.assert_array_equal(picture.draw(), Picture(other, (21, 17)).deform(u).draw())


def test_levels_agree():
    image, u = cv2.GaussianBlur(speckle(), (0, 0), 1.5), None
    pictures = []
    for level in LEVELS:
        picture = Picture(image, (21, 17), level=level)
        u = bump(picture, 2.0) if u is None else u
        assert library().echospline_picture_level(picture.handle) == level
        pictures.append(picture.deform(u).draw(needle((3, 2, 0), (30, 18, 0))).astype(int))
    for other in pictures[1:]:
        assert np.abs(other - pictures[0]).max() <= 1


# ---- Needle --------------------------------------------------------------------------------------------------------

FINE = 0.09


def dark(value: int = 0, size: tuple[int, int] = (440, 500), **values: Any) -> Picture:
    """Even tissue, 45 x 40 mm."""
    return Picture(np.full(size, value, np.uint8), (4, 4), spacing=(FINE, FINE), **values)


def direction(tilt: float) -> np.ndarray:
    """Unit vector in the plane, degrees from the perpendicular to the beam."""
    return np.array([np.cos(np.radians(tilt)), np.sin(np.radians(tilt)), 0.0])


def tilted(
    tilt: float, length: float = 30.0, middle: tuple[float, float] = (22.0, 18.0), **values: Any
) -> Any:
    """Needle in the plane around a middle."""
    m = np.array([*middle, 0.0])
    u = direction(tilt)
    return needle(m - u * length / 2, m + u * length / 2, **values)


def peaks_across(picture: Picture, n: Any, part: tuple[float, float] = (0.2, 0.75)) -> np.ndarray:
    """Largest power across the shaft at places along it."""
    entry, tip = np.array(n.entry[:2]), np.array(n.tip[:2])
    u = (tip - entry) / np.linalg.norm(tip - entry)
    s = np.arange(*np.multiply(part, np.linalg.norm(tip - entry)), 0.1)
    d = np.arange(-2, 2, 0.03)
    points = (entry + s[:, None, None] * u + d[None, :, None] * np.array([u[1], -u[0]])).reshape(-1, 2)
    return picture.echo(n, points)[0].reshape(len(s), len(d)).max(axis=1)


def contrast(tilt: float, seed: int, tissue: int = 90) -> float:
    """Grey level of the shaft over the tissue's, mean along it; as a display shows it."""
    p = peaks_across(dark(), tilted(tilt, parts=SHAFT, seed=seed))
    grey = 255 * (1 + np.log10(10 ** ((tissue / 255 - 1) * 6) + p) * 10 / 60)
    return float(np.minimum(grey, 255).mean() - tissue)


@pytest.mark.parametrize(
    ("tilt", "low", "high"),
    [
        (10, 0.9, 1.1),
        (15, 0.85, 1.05),
        (20, 0.6, 0.9),
        (35, 0.15, 0.35),
        (50, 0.15, 0.35),
        (60, 0.1, 0.3),
        (75, 0.05, 0.2),
        (88, 0.02, 0.16),
    ],
)
def test_contrast_against_tilt_is_the_one_measured(tilt, low, high):
    # gel: 0.27 to 0.32 of the peak at 35 to 60 degrees, 0.11 to 0.13 at 60 to 90 (van de Berg et al. 2018); the fall between 10 and 20
    shares = [contrast(tilt, seed) / contrast(0, seed) for seed in range(5)]
    assert low < np.mean(shares) < high


def test_near_perpendicular_the_line_is_continuous_and_beyond_it_is_grainy():
    level = lambda tilt: 10 * np.log10(peaks_across(dark(), tilted(tilt, parts=SHAFT)))  # noqa: E731
    assert level(10).std() * 255 / 60 < 14  # measured: 8 to 11 grey levels
    assert level(60).std() > 3.0


def test_one_line_as_thick_as_the_resolution():
    # along the beam, below 0.6 mm at half amplitude: no second wall 1.27 mm below the first
    y = np.arange(10, 26, 0.01)
    p, _ = dark().echo(tilted(8, parts=SHAFT), np.column_stack([np.full_like(y, 22.0), y]))
    bright = y[p > p.max() / 4]
    assert 0.2 < bright[-1] - bright[0] < 0.6
    centre = y[p.argmax()]
    away = np.abs(y - centre) > 0.9
    assert p[away].max() < 1e-4 * p.max()
    # the near wall: a radius above the axis
    assert centre == pytest.approx(18 - 0.635 * np.cos(np.radians(8)), abs=0.05)


@pytest.mark.parametrize("tilt", [5, 30, 50, 75, 88])
def test_the_tip_stays_bright(tilt):
    n = tilted(tilt, length=20)
    picture = dark()
    tip = np.array(n.tip[:2])
    near = np.stack(np.meshgrid(*(np.arange(-0.4, 0.4, 0.05) + t for t in tip)), axis=-1).reshape(-1, 2)
    power, _ = picture.echo(n, near)
    assert 10 * np.log10(power.max()) > -6
    grey = picture.draw(n)
    row, column = np.rint(tip / FINE).astype(int)[::-1]
    assert grey[row - 4 : row + 5, column - 4 : column + 5].max() > 225


def test_across_the_plane_a_spot_follows_the_slice():
    # the needle lies in a plane parallel to the picture's, at a distance: power falls as the slice's sensitivity
    picture, n = dark(), tilted(0, parts=SHAFT)
    at = [[22.0, 18.0 - 0.635]]
    still, _ = picture.echo(n, at)
    for z in (0.4, 0.8, 1.5):
        n.entry[2] = n.tip[2] = z
        power, _ = picture.echo(n, at)
        slice_square = 0.75**2 + (0.42 * 5 * 0.635 / 45) ** 2
        assert power[0] / still[0] == pytest.approx(np.exp(-(z**2) / slice_square), rel=0.05)


def test_a_needle_square_to_the_plane_is_a_spot():
    n = needle((22, 18, -20), (22, 18, 20), parts=SHAFT)
    x, y = np.meshgrid(np.arange(18, 26, 0.05), np.arange(14, 22, 0.05))
    power, _ = dark().echo(n, np.stack([x, y], axis=-1))
    bright = power.reshape(x.shape) > power.max() / 4
    assert np.ptp(x[bright]) == pytest.approx(2 * 0.28 * np.sqrt(np.log(4)), abs=0.11)
    assert np.ptp(y[bright]) == pytest.approx(2 * 0.13 * np.sqrt(np.log(4)), abs=0.11)
    assert y.ravel()[power.argmax()] == pytest.approx(18 - 0.635, abs=0.06)
    assert 10 * np.log10(power.max()) > -10


def test_a_needle_crossing_the_plane_at_45_degrees_shows_a_dot():
    u = np.array([0, 1, 1]) / np.sqrt(2)
    hit = np.array([22, 18, 0.0])
    for seed in range(5):
        n = needle(hit - 20 * u, hit + 20 * u, seed=seed, parts=SHAFT)
        around = np.stack(np.meshgrid(np.arange(21, 23, 0.05), np.arange(16, 20, 0.05)), axis=-1)
        power, _ = dark().echo(n, around)
        assert -27 < 10 * np.log10(power.max()) < -5
    far, _ = dark().echo(n, [[22.0, 23.0], [22.0, 12.0], [25.0, 18.0]])
    assert far.max() < 1e-6


@pytest.mark.parametrize("tilt", [0, 25, 60])
def test_a_mirrored_scene_gives_a_mirrored_picture(tilt):
    image = np.full((440, 501), 90, np.uint8)
    picture = Picture(image, (4, 4), spacing=(FINE, FINE))
    width = 500 * FINE
    u = direction(tilt)
    entry, tip = np.array([8.0, 6.0, 0.2]), np.array([8.0, 6.0, 0.2]) + 25 * u
    mirror = np.array([-1, 1, 1])
    other = needle(entry * mirror + [width, 0, 0], tip * mirror + [width, 0, 0])
    here, there = picture.draw(needle(entry, tip)), picture.draw(other)
    np.testing.assert_allclose(here.astype(int), there[:, ::-1].astype(int), atol=2)
    assert (here != 90).any()


@pytest.mark.parametrize("tilt", [0, 15, 45, 88, 90])
def test_the_picture_does_not_jump(tilt):
    picture = dark(90)
    u = direction(tilt)

    def draw(length: float, turn: float = 0.0, z: float = 0.0) -> np.ndarray:
        e = np.array([12.0, 4.0, 0.0])
        return picture.draw(needle(e, e + length * direction(tilt + turn) + [0, 0, z])).astype(int)

    base = draw(25.0)
    assert np.abs(draw(25.005) - base).max() <= 8
    assert np.abs(draw(25.0, 0.02) - base).max() <= 10
    assert np.abs(draw(25.0, 0.0, 0.01) - base).max() <= 8
    assert np.abs(draw(1e-4) - draw(0.0)).max() <= 2  # it enters gradually
    assert np.abs(draw(0.02) - draw(1e-4)).max() <= 4
    assert u is not None


def test_the_grain_is_fixed_to_the_needle():
    picture, u = dark(), direction(60)[:2]

    def along(shift: float) -> np.ndarray:
        n = tilted(60, parts=SHAFT)
        for k in (0, 1):
            n.entry[k] += shift * u[k]
            n.tip[k] += shift * u[k]
        s = np.arange(-10, 8, 0.07)[:, None]
        wall = 0.635 * np.cos(np.radians(60)) * np.array([u[1], -u[0]])
        return 10 * np.log10(picture.echo(n, np.array([22.0, 18.0]) + (s + shift) * u + wall)[0])

    np.testing.assert_allclose(along(1.2345), along(0.0), atol=0.6)
    assert np.abs(along(0.0)[10:] - along(0.0)[:-10]).std() > 2  # another place of the shaft looks different


def test_seeds_give_other_grain():
    a, b = (peaks_across(dark(), tilted(60, parts=SHAFT, seed=seed)) for seed in (1, 2))
    assert np.abs(np.log10(a / b)).mean() > 0.1


def test_the_shadow_lies_behind_the_shaft_and_nowhere_else():
    picture = dark(120)
    n = tilted(20, length=20, parts=SHADOW)
    shaded = picture.draw(n).astype(int)
    (x0, y0), (x1, y1) = n.entry[:2], n.tip[:2]
    x, y = np.meshgrid(np.arange(500) * FINE, np.arange(440) * FINE)
    line = y0 + (x - x0) * (y1 - y0) / (x1 - x0)
    assert (shaded[y < line - 1.0] == 120).all()
    behind = (x > x0 + 3) & (x < x1 - 3) & (y > line + 2) & (y < line + 8)
    assert (shaded[behind] < 110).all()
    assert (shaded <= 120).all()
    beside = (x < x0 - 10) | (x > x1 + 10)
    assert (shaded[beside] == 120).all()
    # edges are soft: some millimetres of penumbra 15 mm below the tip
    row = shaded[int((y1 + 12) / FINE)]
    dark_level = row.min()
    edge = (
        np.flatnonzero(row[int(x1 / FINE) - 60 :] > 120 - 0.1 * (120 - dark_level))[0]
        - np.flatnonzero(row[int(x1 / FINE) - 60 :] > dark_level + 0.1 * (120 - dark_level))[0]
    )
    assert 2.5 < edge * FINE < 9


@pytest.mark.parametrize("tilt", [30, 50])
def test_the_shadow_next_to_the_shaft_is_not_black(tilt):
    _, passed = dark().echo(tilted(tilt, parts=SHADOW), [[22.0, 18.0 + d] for d in np.arange(-1, 15, 0.1)])
    assert passed.min() > 10**-1.2
    assert np.abs(np.diff(10 * np.log10(passed))).max() < 1.2  # dB per tenth of a millimetre


def test_power_adds():
    picture = dark(150)
    n = tilted(40, parts=SHAFT | BEVEL)
    x, y = np.meshgrid(np.arange(500) * FINE, np.arange(440) * FINE)
    power, _ = picture.echo(n, np.stack([x, y], axis=-1))
    expected = 255 * (1 + 10 / 60 * np.log10(10 ** ((150 / 255 - 1) * 6) + power.reshape(x.shape)))
    drawn = picture.draw(n)
    np.testing.assert_allclose(drawn, np.clip(expected, 0, 255), atol=1.01)
    assert (drawn > 170).any()


def test_the_drawn_shadow_is_the_one_at_the_points():
    picture = dark(200)
    n = tilted(35, parts=SHADOW)
    x, y = np.meshgrid(np.arange(500) * FINE, np.arange(440) * FINE)
    _, passed = picture.echo(n, np.stack([x, y], axis=-1))
    expected = 200 + 255 / 60 * 10 * np.log10(passed.reshape(x.shape))
    off = np.abs(picture.draw(n) - np.clip(expected, 0, 255))
    assert (
        off.max() < 6
    )  # at the very end of the shaft; the shadow is interpolated between every fourth pixel
    assert np.quantile(off, 0.999) < 2
    assert passed.min() < 0.3


def test_black_stays_black_without_echo():
    assert (dark(0).draw(tilted(30, parts=SHADOW)) == 0).all()
    bright = dark(0).draw(tilted(30))
    assert (bright > 0).mean() < 0.08
    assert (bright > 0).any()


def test_each_part_changes_the_picture_and_none_nothing():
    picture = dark(100)
    plain = picture.draw()
    np.testing.assert_array_equal(picture.draw(tilted(1, parts=0)), plain)
    np.testing.assert_array_equal(picture.draw(needle((9, 9, 0), (9, 9, 0))), plain)
    whole = picture.draw(tilted(1))
    for part in (SHAFT, BEVEL, TAIL, SHADOW):
        assert (picture.draw(tilted(1, parts=part)) != plain).any()
        assert (picture.draw(tilted(1, parts=15 - part)) != whole).any()


def test_the_tail_is_there_only_near_perpendicular():
    picture = dark(60)
    below = lambda tilt: (picture.draw(tilted(tilt, parts=TAIL)).astype(int) - 60).max()  # noqa: E731
    assert below(0) > 20
    assert below(7) <= 3  # none was seen at 6 to 8 degrees
    assert below(30) == 0


@pytest.mark.parametrize(("dtype", "white"), [(np.uint16, 4095), (np.int16, 1000), (np.float32, 1.0)])
def test_other_types_get_the_same_needle(dtype, white):
    grey = dark(100).draw(tilted(25)).astype(float)
    image = np.full((440, 500), 100 / 255 * white).astype(dtype)
    other = Picture(image, (4, 4), spacing=(FINE, FINE), white=white).draw(tilted(25))
    assert other.dtype == dtype
    np.testing.assert_allclose(other * (255 / white), grey, atol=1.1)


def test_colour_gets_the_needle_in_every_channel():
    grey = dark(100).draw(tilted(25))
    colour = Picture(np.full((440, 500, 3), 100, np.uint8), (4, 4), spacing=(FINE, FINE)).draw(tilted(25))
    np.testing.assert_array_equal(colour, np.repeat(grey[..., None], 3, axis=2))


def test_a_curved_array_with_a_far_apex_is_a_linear_one():
    picture = dark(100)
    linear = picture.draw(tilted(30)).astype(int)
    curved = picture.draw(tilted(30, curved=1, apex=(22.0, -20000.0))).astype(int)
    assert np.abs(linear - curved).max() <= 3


def test_turning_needle_and_beam_together_turns_the_echo():
    apex = np.array([22.0, -30.0])

    def turned(points: Any, angle: float) -> np.ndarray:
        a = np.radians(angle)
        return apex + (np.asarray(points) - apex) @ np.array(
            [[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]]
        )

    entry, tip = np.array([16.0, 10.0]), np.array([30.0, 18.0])
    points = np.stack(np.meshgrid(np.arange(12, 34, 0.2), np.arange(6, 26, 0.2)), axis=-1).reshape(-1, 2)
    results = []
    for angle in (0, 12):
        n = needle((*turned(entry, angle), 0), (*turned(tip, angle), 0), curved=1, apex=apex)
        results.append(dark().echo(n, turned(points, angle)))
    decibels = [10 * np.log10(power + 1e-6) for power, _ in results]
    np.testing.assert_allclose(decibels[0], decibels[1], atol=0.5)
    np.testing.assert_allclose(results[0][1], results[1][1], atol=0.01)
    assert decibels[0].max() > -10
    # the shadow follows the beams: away from the apex, not straight down
    n = needle((30, 10, 0), (36, 10, 0), curved=1, apex=apex, parts=SHADOW)
    beam = (np.array([33.0, 10.0]) - apex) / np.linalg.norm(np.array([33.0, 10.0]) - apex)
    _, passed = dark().echo(n, [np.array([33.0, 10.0]) + 14 * beam, [33.0 - 14 * beam[0], 10 + 14 * beam[1]]])
    assert passed[0] < passed[1]


@pytest.mark.parametrize(
    ("entry", "tip"),
    [
        ((-300, -300, 0), (400, 400, 0)),
        ((1e6, 1e6, 1e6), (-1e6, -1e6, -1e6)),
        ((20, -1e6, 0), (20, 1e6, 0)),
        ((20, 10, 50), (20, 10, 60)),
        ((20, 10, 0), (20, 10 + 1e-9, 0)),
        ((20, 10, 0), (20, 5, 0)),
        ((45, 30, 0), (0, 2, 0)),
    ],
)
@pytest.mark.parametrize("curved", [0, 1])
def test_any_needle_leaves_a_picture(entry, tip, curved):
    image = np.full((440, 500), 0.4, np.float32)
    picture = Picture(image, (4, 4), spacing=(FINE, FINE))
    out = picture.draw(needle(entry, tip, curved=curved, apex=(20.0, 10.0)))
    assert np.isfinite(out).all()
    assert out.min() >= 0
    assert out.max() <= 1.001


# ---- Arguments -----------------------------------------------------------------------------------------------------


def create(options: Any, pixels: Any) -> tuple[int, str]:
    """Status and message of a create; the handle is destroyed."""
    handle = c.c_void_p()
    status = library().echospline_picture_create(options, pixels, c.byref(handle))
    message = library().echospline_picture_message(handle).decode()
    for call in ("check", "draw"):
        arguments = (None,) if call == "check" else (None, None, 0)
        again = getattr(library(), "echospline_picture_" + call)(handle, *arguments)
        assert again in ((8,) if status else (0, 1))
    library().echospline_picture_destroy(handle)
    return status, message


PIXELS = np.zeros((8, 8), np.uint8)


@pytest.mark.parametrize(
    ("name", "value", "status"),
    [
        ("struct_size", 0, 2),
        ("struct_size", 12, 2),
        ("pixel_type", 4, 3),
        ("pixel_type", -1, 3),
        ("interpolation", 2, 3),
        ("border", 5, 3),
        ("method", 3, 3),
        ("level", 77, 3),
        ("channels", 2, 2),
        ("columns", 0, 2),
        ("rows", -3, 2),
        ("columns", 2**31 - 1, 2),
        ("mesh_shape", (1, 5), 2),
        ("mesh_shape", (2**31 - 1, 2**31 - 1), 2),
        ("spacing", (0.0, 0.1), 3),
        ("spacing", (0.1, float("nan")), 3),
        ("spacing", (-0.1, 0.1), 3),
        ("mesh_spacing", (float("inf"), 1.0), 3),
        ("mesh_spacing", (1e-6, 1.0), 3),
        ("origin", (float("nan"), 0.0), 3),
        ("mesh_origin", (0.0, 1e300), 3),
        ("border_value", float("nan"), 3),
        ("white", -1.0, 3),
        ("white", float("nan"), 3),
    ],
)
def test_wrong_options_are_refused_by_name(name, value, status):
    o = native.options(8, 8, (3, 3))
    native.fill(o, {name: value})
    got, message = create(c.byref(o), PIXELS.ctypes.data)
    assert got == status
    assert name.split("_")[0] in message
    assert "got" in message


def test_null_is_refused():
    o = native.options(8, 8, (3, 3))
    assert library().echospline_picture_create(c.byref(o), PIXELS.ctypes.data, None) == 1
    assert create(None, PIXELS.ctypes.data)[0] == 1
    status, message = create(c.byref(o), None)
    assert status == 1
    assert "pixels" in message
    library().echospline_picture_destroy(None)
    library().echospline_picture_defaults(None)
    library().echospline_needle_defaults(None)
    for name, count in (
        ("reference", 2),
        ("deform", 2),
        ("draw", 3),
        ("inverse", 3),
        ("check", 1),
        ("echo", 5),
    ):
        arguments = [0 if k == count - 1 and name not in ("check", "echo") else None for k in range(count)]
        if name == "echo":
            arguments[2] = 0
        assert getattr(library(), f"echospline_picture_{name}")(None, *arguments) == 1
    assert library().echospline_picture_size(None) == 0
    assert b"NULL" in library().echospline_picture_message(None)


def test_wrong_arrays_are_refused_and_change_nothing():
    image = speckle()
    picture = Picture(image, (5, 4))
    lib, handle = library(), picture.handle
    u = np.zeros((20, 2))
    for bad in (
        np.zeros((19, 2)),
        np.zeros((0, 2)),
        np.full((20, 2), np.nan),
        np.full((20, 2), 1e7),
        np.full((20, 2), -np.inf),
    ):
        with pytest.raises(ValueError, match="displacement must"):
            picture.deform(bad)
        with pytest.raises(ValueError, match="displacement must"):
            picture.deform(bad.astype(np.float32))
    out = np.zeros_like(image)
    assert lib.echospline_picture_deform(handle, None, u.size) == 1
    assert lib.echospline_picture_deform(handle, u.ctypes.data, -1) == 2
    assert lib.echospline_picture_draw(handle, None, None, out.nbytes) == 1
    for size in (0, -5, out.nbytes - 1, 2**62):
        assert lib.echospline_picture_draw(handle, None, out.ctypes.data, size) == 2
        assert lib.echospline_picture_reference(handle, image.ctypes.data, size) == 2
        assert lib.echospline_picture_inverse(handle, out.ctypes.data, out.ctypes.data, size) == 2
    report = native.Report(struct_size=3)
    assert lib.echospline_picture_check(handle, c.byref(report)) == 2
    np.testing.assert_array_equal(picture.draw(), image)


def test_extreme_displacements_are_drawn_without_harm():
    image = speckle()
    for mesh in ((5, 4), (60, 50)):
        for method in (EXACT, PULL):
            picture = Picture(image, mesh, method=method)
            for scale in (1e6, 1e3, 30.0):
                u = RNG.uniform(-scale, scale, (len(picture.nodes), 2))
                picture.deform(u).draw()
                assert np.isfinite(picture.check().residual)
            picture.deform(-picture.nodes)  # everything onto one point
            picture.draw()


NEEDLE_FAULTS = [
    ("struct_size", 0),
    ("parts", 16),
    ("curved", 2),
    ("entry", (float("nan"), 0, 0)),
    ("tip", (0, 1e7, 0)),
    ("apex", (float("inf"), 0)),
    *((name, float("nan")) for name in native.NUMBERS),
    *((name, -1e9) for name in native.NUMBERS),
    *((name, 1e9) for name in native.NUMBERS),
]


@pytest.mark.parametrize(("name", "value"), NEEDLE_FAULTS)
def test_wrong_needles_are_refused_by_name(name, value):
    picture = Picture(speckle(), (5, 4))
    n = needle((0, 0, 0), (10, 10, 0))
    native.fill(n, {name: value})
    with pytest.raises(ValueError, match=name):
        picture.draw(n)
    with pytest.raises(ValueError, match=name):
        picture.echo(n, [[1.0, 2.0]])


def test_points_of_an_echo_are_checked():
    picture, n = Picture(speckle(), (5, 4)), needle((0, 0, 0), (10, 10, 0))
    with pytest.raises(ValueError, match="point 1"):
        picture.echo(n, [[1.0, 2.0], [float("nan"), 0.0]])
    assert len(picture.echo(n, np.empty((0, 2)))[0]) == 0
    status = library().echospline_picture_echo(picture.handle, c.byref(n), None, 3, None, None)
    assert status == 1
    assert library().echospline_picture_echo(picture.handle, c.byref(n), None, -3, None, None) == 2
