"""Forward map, inverse map, folding: each checked against the other or against a map known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator

from echospline.errors import InputError
from echospline.picture import Deformation
from echospline.scene import RegularGrid

MESH = RegularGrid((21, 17), (2.0, 2.0))  # 40 x 32 mm
PIXELS = RegularGrid((201, 161), (0.2, 0.2))


def push(amplitude: float, width: float = 4.0, mesh: RegularGrid = MESH) -> Deformation:
    """A bump along x; its steepest gradient is 0.86 amplitude / width."""
    r2 = ((mesh.nodes - (20.0, 16.0)) ** 2).sum(axis=1)
    return Deformation(mesh, amplitude * np.exp(-r2 / width**2)[:, None] * [1.0, 0.4])


def test_forward_map_is_bilinear_interpolation():
    deformation = push(1.5)
    x = np.random.default_rng(0).uniform([0, 0], [40, 32], (300, 2))
    u = deformation.displacement.reshape(17, 21, 2)
    theirs = RegularGridInterpolator((MESH.y, MESH.x), u)(x[:, ::-1])
    np.testing.assert_allclose(deformation.forward(x) - x, theirs, atol=1e-12)


def test_outside_the_mesh_there_is_no_tissue():
    assert np.isnan(push(1.0).forward([(-0.1, 5.0), (41.0, 5.0)])).all()


def test_no_motion_maps_every_pixel_to_itself():
    inverse = push(0.0).inverse(PIXELS)
    columns, rows = np.meshgrid(np.arange(201), np.arange(161))
    np.testing.assert_allclose(inverse.x, columns, atol=1e-4)
    np.testing.assert_allclose(inverse.y, rows, atol=1e-4)
    assert not inverse.outside.any()


@pytest.mark.parametrize("amplitude", [0.5, 2.0, 4.0])
def test_inverse_composed_with_forward_is_the_identity(amplitude):
    # at 4 mm the gradient is 0.86: a fixed point barely contracts, the map is still one-to-one
    deformation = push(amplitude)
    assert deformation.folds is None
    inverse = deformation.inverse(PIXELS)
    back = PIXELS.to_mm(np.stack([inverse.x, inverse.y], axis=-1).reshape(-1, 2).astype(float))
    residual = np.abs(PIXELS.to_index(deformation.forward(back)) - PIXELS.to_index(PIXELS.nodes))
    assert np.nanmax(residual) < 1e-3
    assert np.isfinite(residual).mean() > 0.97  # all but the rim, where tissue reaches half a pixel beyond
    assert inverse.residual < 1e-3
    assert not inverse.outside.any()


def test_inverse_holds_where_a_fixed_point_diverges():
    # shear with du_x/dy = 1.5: one-to-one (determinant 1), yet x <- y - u(x) runs away
    y = MESH.nodes[:, 1]
    deformation = Deformation(MESH, np.column_stack([1.5 * np.abs(y - 16), np.zeros_like(y)]))
    assert deformation.folds is None
    inverse = deformation.inverse(PIXELS)
    assert inverse.residual < 1e-3
    assert 0.2 < inverse.outside.mean() < 0.9


def test_translation_uncovers_exactly_what_it_leaves():
    inverse = Deformation(MESH, np.tile([4.0, 0.0], (MESH.size, 1))).inverse(PIXELS)
    assert inverse.outside[:, :20].all()
    assert not inverse.outside[:, 20:].any()
    np.testing.assert_allclose(inverse.x[0, 20:], np.arange(181), atol=1e-3)


def test_jacobian_equals_the_determinant_by_differences():
    deformation = push(2.0)
    corner = deformation.jacobian[7, 9, 0]
    p, h = MESH.nodes[7 * 21 + 9], 1e-6
    dx, dy = (deformation.forward([p + h * e])[0] - deformation.forward([p])[0] for e in np.eye(2))
    assert corner == pytest.approx((dx[0] * dy[1] - dx[1] * dy[0]) / h**2, abs=1e-6)


def test_folding_is_found_where_it_is():
    deformation = push(8.0)
    folds = deformation.folds
    assert folds is not None
    assert folds.worst < 0
    # the bump pushes to the right: tissue is turned over ahead of it
    assert 20 < folds.place[0] < 28
    assert abs(folds.place[1] - 16) < 4
    assert "fold" in str(folds)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.0, 1.2))
def test_any_one_to_one_field_is_inverted(seed, amplitude):
    u = np.random.default_rng(seed).uniform(-amplitude, amplitude, (MESH.size, 2))
    deformation = Deformation(MESH, u)
    if deformation.folds is None:
        assert deformation.inverse(PIXELS).residual < 0.01
    else:
        assert deformation.jacobian.min() <= 0


@pytest.mark.parametrize("u", [np.zeros((3, 2)), np.full((MESH.size, 2), np.nan), np.zeros(MESH.size)])
def test_fields_that_do_not_fit_are_refused(u):
    with pytest.raises(InputError):
        Deformation(MESH, u)
