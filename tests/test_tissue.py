"""Moduli per region: which region a point lies in, and what a mesh cell is made of."""

import numpy as np
import pytest
from matplotlib.path import Path

from echospline.errors import InputError
from echospline.scene import Circle, Label, Layer, Polygon, Region, RegularGrid, Tissue

GRID = RegularGrid((41, 31), (1.0, 1.0))


def test_background_is_everywhere_without_regions():
    young, poisson = Tissue(12.0, 0.4).at([(0, 0), (5, 100)])
    assert young.tolist() == [12.0, 12.0]
    assert poisson.tolist() == [0.4, 0.4]


def test_later_regions_lie_on_top():
    tissue = Tissue(
        10.0, 0.45, [Region(Layer(0, 5), 50.0, 0.4, "skin"), Region(Circle((10, 4), 3), 90.0, 0.3, "lesion")]
    )
    young, poisson = tissue.at([(30, 1), (10, 4), (10, 6.5), (30, 5.0)])
    assert young.tolist() == [50.0, 90.0, 90.0, 10.0]
    assert poisson.tolist() == [0.4, 0.3, 0.3, 0.45]


@pytest.mark.parametrize("seed", range(5))
def test_polygon_agrees_with_winding_numbers_and_with_matplotlib(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 11, (1000, 2))
    star = rng.uniform(0, 10, (7, 2))  # crosses itself: inside where the outline winds an odd number of times
    inside = [_winds_oddly(star, p) for p in points]
    np.testing.assert_array_equal(Polygon(tuple(map(tuple, star))).contains(points), inside)
    triangle = star[:3]
    np.testing.assert_array_equal(
        Polygon(tuple(map(tuple, triangle))).contains(points), Path(triangle).contains_points(points)
    )


def _winds_oddly(vertices, p):
    angle = 0
    for a, b in zip(vertices, np.roll(vertices, -1, axis=0), strict=True):
        t = (a - p)[0] + 1j * (a - p)[1], (b - p)[0] + 1j * (b - p)[1]
        angle += np.angle(t[1] / t[0])
    return round(angle / (2 * np.pi)) % 2 == 1


def test_labels_image_gives_regions_in_mm():
    pixels = np.zeros((20, 10), dtype=np.uint8)
    pixels[5:8, 2:4] = 7
    label = Label(pixels, RegularGrid((10, 20), (2.0, 0.5)), 7)
    points = np.array([(4.0, 2.5), (6.0, 3.5), (7.1, 3.5), (4.0, 2.2), (-50.0, 2.5), (500.0, 2.5)])
    assert label.contains(points).tolist() == [True, True, False, False, False, False]


def test_compliance_of_cells_shares_a_lesion_by_area():
    tissue = Tissue(10.0, 0.45, [Region(Circle((20, 15), 6.3), 110.0, 0.3)])
    young, poisson = tissue.in_cells(GRID, samples=16)
    for compliance, outside, inside in (
        (1 / young, 1 / 10.0, 1 / 110.0),
        (poisson / young, 0.45 / 10.0, 0.3 / 110.0),
    ):
        area = ((compliance - outside) / (inside - outside)).sum()
        assert area == pytest.approx(np.pi * 6.3**2, rel=2e-3)


def test_samples_of_a_cell_lie_in_it_x_fastest():
    tissue = Tissue(10.0, 0.45, [Region(Layer(0, 0.5), 20.0), Region(Circle((0.25, 0.75), 0.1), 30.0)])
    young, _ = tissue.sampled(GRID, np.array([0, 41]), 2)
    assert young.tolist() == [[20, 20, 30, 10], [10, 10, 10, 10]]


def test_cells_run_x_fastest():
    tissue = Tissue(10.0, 0.45, [Region(Layer(0, 1.0), 20.0)])
    young, _ = tissue.in_cells(GRID)
    assert young.shape == (40 * 30,)
    assert (young[:40] == 20).all()
    assert (young[40:] == 10).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Tissue(0.0), "Young's modulus of the tissue must be a positive number in kPa; got 0.0"),
        (lambda: Tissue(1.0, 0.6), r"must lie in \(-1, 0.5\]; got 0.6"),
        (lambda: Region(Layer(0, 1), float("nan"), name="fat"), "region 'fat'"),
        (lambda: Layer(3, 3), "deeper"),
        (lambda: Circle((0, 0), -1), "radius"),
        (lambda: Polygon(((0, 0), (1, 1))), "three or more"),
        (lambda: Label(np.zeros((2, 3)), RegularGrid((3, 2), (1, 1)), 1), "integers"),
        (lambda: Tissue(thickness=0), "thickness"),
        (lambda: Tissue(plane="curved"), "plane"),
    ],
)
def test_bad_input_is_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
