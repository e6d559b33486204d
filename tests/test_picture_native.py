"""`NativePicture` over the core's handle, pictures that follow a tissue, and `Drawing` over both ways to a picture."""

from __future__ import annotations

import ctypes
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from echospline import _native as core
from echospline.errors import FoldingError, InputError
from echospline.picture import Deformation, Drawing, NeedleEcho, warp
from echospline.picture.native import NativePicture
from echospline.scene import NeedlePose, RegularGrid, UltrasoundImage

IMAGE = UltrasoundImage.from_array(
    np.random.default_rng(0).integers(0, 200, (91, 121)).astype(np.uint8), (0.25, 0.25)
)
MESH = RegularGrid((16, 13), (2.0, 1.9), (0.0, 0.0))
POSE = NeedlePose((8.0, 0.0), (16.0, 12.0), 8.0)


def picture(image=IMAGE, mesh=MESH, **changed):
    options = {"interpolation": "linear", "border": 0.0, "inverse": "exact", "white": 0.0}
    return NativePicture(image.pixels, image.grid, mesh, **{**options, **changed})


def bump(amplitude, mesh=MESH):
    r2 = ((mesh.nodes - (15.0, 11.0)) ** 2).sum(axis=1)
    return amplitude * np.exp(-r2 / 16)[:, None] * [0.6, 0.8]


class Tissue:
    """A tissue in the core that a needle has entered."""

    def __init__(self, mesh=MESH, dimension=2, precision=core.Precision.SINGLE, level=0):
        self.lib = core.library()
        o = core.SceneOptions(struct_size=ctypes.sizeof(core.SceneOptions))
        self.lib.echospline_scene_defaults(ctypes.byref(o))
        o.dimension, o.precision, o.level = dimension, precision, level
        for d in range(dimension):
            o.shape[d], o.spacing[d] = (*mesh.shape, 5)[d], (*mesh.spacing, 2.0)[d]
            o.origin[d] = (*mesh.origin, -4.0)[d]
        self.scene, self.handle = ctypes.c_void_p(), ctypes.c_void_p()
        assert self.lib.echospline_scene_create(ctypes.byref(o), ctypes.byref(self.scene)) == 0
        assert self.lib.echospline_tissue_create(self.scene, ctypes.byref(self.handle)) == 0
        for k in range(1, 31):
            tip = 1 / 30 * k * np.subtract(POSE.tip, POSE.entry) + POSE.entry
            pose = core.Pose((*POSE.entry, 0.0), (*tip, 0.0), POSE.speed, 0.05)
            assert self.lib.echospline_advance(self.handle, ctypes.byref(pose)) == 0

    def __del__(self):
        self.lib.echospline_tissue_destroy(self.handle)
        self.lib.echospline_scene_destroy(self.scene)

    @property
    def displacement(self):
        u = np.empty((MESH.size, 2))
        assert self.lib.echospline_displacement(self.handle, u.ctypes.data, u.size) == 0
        return u


def follow(native, tissue):
    return core.library().echospline_picture_follow(native._picture, tissue)


@pytest.mark.parametrize("precision", list(core.Precision))
@pytest.mark.parametrize("level", [core.Level.LEVEL_BEST, core.Level.LEVEL_BASELINE])
def test_a_picture_follows_a_tissue_of_any_precision_and_level(precision, level):
    tissue = Tissue(precision=precision, level=level)
    ours, other = picture(), picture()
    other.deform(tissue.displacement)
    assert np.abs(tissue.displacement).max() > 0.2
    assert follow(ours, tissue.handle) == core.Status.OK
    for a, b in zip(ours.inverse(), other.inverse(), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)


def test_a_mesh_too_fine_to_keep_is_followed_too():
    mesh = RegularGrid((181, 151), (30.0 / 180, 22.5 / 150))
    tissue = Tissue(mesh)
    u = np.empty((mesh.size, 2))
    assert core.library().echospline_displacement(tissue.handle, u.ctypes.data, u.size) == 0
    ours, other = picture(mesh=mesh), picture(mesh=mesh)
    other.deform(u)
    assert follow(ours, tissue.handle) == core.Status.OK
    np.testing.assert_allclose(ours.inverse()[1], other.inverse()[1], atol=1e-4)


def test_a_tissue_that_does_not_fit_is_refused_and_changes_nothing():
    native = picture()
    native.deform(bump(1.0))
    before = native.draw(None)

    def message():
        return core.library().echospline_picture_message(native._picture).decode()

    assert follow(native, Tissue(RegularGrid((16, 13), (2.0, 1.8))).handle) == core.Status.WRONG_SIZE
    assert "16 x 13 nodes of 2 x 1.8 mm" in message()
    assert follow(native, Tissue(RegularGrid((13, 16), MESH.spacing)).handle) == core.Status.WRONG_SIZE
    assert follow(native, Tissue(dimension=3).handle) == core.Status.WRONG_VALUE
    assert "dimension 2; got 3" in message()
    assert follow(native, None) == core.Status.NULL_POINTER
    failed = ctypes.c_void_p()
    assert core.library().echospline_tissue_create(None, ctypes.byref(failed)) != core.Status.OK
    if failed:
        assert follow(native, failed) == core.Status.FAILED_HANDLE
        core.library().echospline_tissue_destroy(failed)
    assert core.library().echospline_picture_follow(None, None) == core.Status.NULL_POINTER
    np.testing.assert_array_equal(native.draw(None), before)


def test_the_cores_message_reaches_the_caller():
    with pytest.raises(InputError, match="mesh_shape must be 2 x 2"):
        picture(mesh=RegularGrid((1, 5), (1.0, 1.0)))
    with pytest.raises(InputError, match="displacement must hold 416 numbers"):
        picture().deform(np.zeros((3, 2)))


def test_the_reference_can_be_replaced():
    native = picture()
    native.reference(255 - IMAGE.pixels)
    np.testing.assert_array_equal(native.draw(None), 255 - IMAGE.pixels)
    with pytest.raises(InputError, match="bytes"):
        native.reference(IMAGE.pixels[:5])


def test_one_handle_may_be_used_by_many_threads():
    native = picture()
    native.deform(bump(1.0))
    expected = native.draw(None)
    with ThreadPoolExecutor(8) as pool:
        drawn = list(pool.map(lambda _: native.draw(None), range(64)))
        reports = set(pool.map(lambda _: native.report(), range(64)))
    assert all((d == expected).all() for d in drawn)
    assert len(reports) == 1


@pytest.mark.parametrize("amplitude", [1.0, 9.0])
def test_folds_are_those_of_the_jacobian(amplitude):
    deformation = Deformation(MESH, bump(amplitude))
    least = deformation.jacobian.min(axis=-1)
    if amplitude < 2:
        assert deformation.folds is None
        assert least.min() > 0
        return
    assert deformation.folds.cells == (least <= 0).sum()
    assert deformation.folds.worst == pytest.approx(least.min(), abs=1e-4)
    drawn = Drawing(IMAGE, MESH).draw(bump(amplitude)).folds
    assert (drawn.cells, drawn.place) == (deformation.folds.cells, deformation.folds.place)
    with pytest.raises(FoldingError, match="cells fold"):
        Drawing(IMAGE, MESH, folding="refuse").draw(bump(amplitude))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int16, np.float32, np.int32, np.float64])
@pytest.mark.parametrize("border", [7.0, "transparent"])
def test_drawings_are_warped_images(dtype, border):
    image = UltrasoundImage(IMAGE.pixels.astype(dtype), IMAGE.grid)
    u = bump(1.5) + np.array([1.0, 0.0])  # tissue leaves the left edge
    drawn = Drawing(image, MESH, border=border, inverse="exact").draw(u)
    np.testing.assert_array_equal(drawn.image.pixels, warp(image, Deformation(MESH, u), border=border).pixels)
    near = Drawing(image, MESH, border=border).draw(u)
    colour = np.s_[..., :3] if border == "transparent" else np.s_[...]
    far = np.abs(near.image.pixels[colour].astype(float) - drawn.image.pixels[colour])
    assert far.max() <= 40  # a tenth of a pixel of noise
    assert near.residual < 0.15


def test_a_drawing_shows_the_needle_and_forgets_it():
    drawing = Drawing(IMAGE, MESH)
    bare = drawing.draw(bump(1.0)).image.pixels
    assert (drawing.draw(bump(1.0), POSE, NeedleEcho()).image.pixels != bare).any()
    np.testing.assert_array_equal(drawing.draw(bump(1.0), POSE).image.pixels, bare)
    outside = NeedlePose(POSE.entry, POSE.entry)
    np.testing.assert_array_equal(drawing.draw(bump(1.0), outside, NeedleEcho()).image.pixels, bare)


@pytest.mark.parametrize("border", [1e9, -1e9])
def test_borders_beyond_the_core_are_drawn_outside_it(border):
    image = UltrasoundImage(IMAGE.pixels.astype(np.float32), IMAGE.grid)
    moved = warp(image, Deformation(MESH, bump(0.0) + np.array([2.0, 0.0])), border=border).pixels
    assert (moved[:, :7] == np.float32(border)).all()
