"""Planes of a volume imaged anew while tissue moves: what stays, what decorrelates, and how bright it is."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest
from scipy.special import ellipe, ellipk

from echospline.errors import InputError
from echospline.laboratory.rescatter_space import rescattered_slices, rescattered_volume
from echospline.mechanics import NeedleForces, SpatialForceModel
from echospline.picture.simulate_space import simulate_space
from echospline.picture.slices import SliceDrawing
from echospline.scenario import Scenario, open_spatial
from echospline.scene import PlanePath, Probe, SpatialGrid, SpatialInsertion, Volume, probe_plane

PROBE = Probe(width=24.0, depth=26.0, pixel=0.2, elevation=0.9, elevation_depth=20.0, element_height=0.0)
ONE = {"looks": (0.0,)}


def evenly(grey=120, size=(30.0, 28.0, 24.0), spacing=0.5):
    nx, ny, nz = (int(s / spacing) + 1 for s in size)
    voxels = np.full((nz, ny, nx), grey, np.uint8)
    return Volume(voxels, (spacing,) * 3, (-size[0] / 2, 0.0, -size[2] / 2))


@pytest.fixture(scope="module")
def plain():
    volume = evenly()
    return volume, *rescattered_volume(volume, PROBE)


class Shifted:
    """Tissue that moves across the plane as a whole with the needle's depth, 0.1 mm for 1 mm."""

    grid = SpatialGrid((2, 2, 2), (30.0, 28.0, 24.0), (-15.0, 0.0, -12.0))

    def rest(self):
        return 0.0

    def advance(self, state, pose, dt):
        return 0.1 * pose.depth

    def field(self, state):
        return lambda p: np.tile((0.0, 0.0, state), (len(p), 1))


def amplitude(image, display):
    """Envelope of the picture's inside, at places about a sample apart."""
    return display.envelope(image.pixels)[15:-10, 10:-10]


def envelopes_correlate(distance, sigma):
    """Correlation of Rayleigh envelopes whose fields correlate by exp(-d^2 / 4 sigma^2): D. Middleton, Statistical Communication Theory, 9.1."""
    m = np.exp(-(distance**2) / (2.0 * sigma**2))
    return (2 * ellipe(m) - (1 - m) * ellipk(m) - pi / 2) / (2 - pi / 2)


@pytest.mark.parametrize("sigma", [0.6, 0.9])
def test_speckle_of_a_cine_decorrelates_across_the_plane_as_the_beam_does(plain, sigma):
    volume, phantom, display = plain
    probe = replace(PROBE, elevation=sigma)
    form = rescattered_slices(phantom, volume, display=display, **ONE)
    insertion = SpatialInsertion.straight((0, 0, 0), (0, 1, 0), 16.0, 4.0, dwell=0.0, retract=False)
    found = []
    for z in (-8.0, -4.0, 0.0, 4.0, 8.0):
        path = PlanePath.still(probe_plane((0.0, 0.0, z)))
        frames = list(simulate_space(volume, probe, path, insertion, Shifted(), fps=1.0, form_image=form))
        first = amplitude(frames[0].image, display).ravel()
        found.append([np.corrcoef(first, amplitude(f.image, display).ravel())[0, 1] for f in frames])
    distances = 0.1 * np.array([0.0, 4.0, 8.0, 12.0, 16.0])
    np.testing.assert_allclose(
        np.mean(found, axis=0)[1:], envelopes_correlate(distances[1:], sigma), atol=0.05
    )


def test_a_sliced_volume_does_not_decorrelate_so(plain):
    """What rescatter is for: the warp of an even volume has no speckle to lose, and the truth does."""
    volume, phantom, display = plain
    form = rescattered_slices(phantom, volume, display=display, **ONE)
    plane, moved = probe_plane((0, 0, 0)), lambda p: np.tile((0.0, 0.0, 1.5), (len(p), 1))
    sliced = SliceDrawing(volume, PROBE)
    a, b = (sliced.draw(plane, f).image.pixels.astype(float) for f in (None, moved))
    assert np.abs(a - b)[15:-10].max() == 0.0
    imaged = SliceDrawing(volume, PROBE, form)
    a, b = (amplitude(imaged.draw(plane, f).image, display).ravel() for f in (None, moved))
    assert np.corrcoef(a, b)[0, 1] < 0.6


def test_tissue_that_moves_far_from_the_plane_leaves_the_picture_as_at_rest(plain):
    volume, phantom, display = plain
    form = rescattered_slices(phantom, volume, display=display)
    drawing = SliceDrawing(volume, PROBE, form)

    def far(p):
        near = np.maximum(1.0 - (((p - (2.0, 14.0, -8.0)) / 4.0) ** 2).sum(axis=1), 0.0)
        return np.outer(near, (0.5, 1.0, 1.0))

    at_rest = drawing.draw(probe_plane((0, 0, 6.0)), None, index=3)
    np.testing.assert_array_equal(
        drawing.draw(probe_plane((0, 0, 6.0)), far, index=3).image.pixels, at_rest.image.pixels
    )
    through = drawing.draw(probe_plane((0, 0, -8.0)), far, index=3).image.pixels.astype(float)
    before = drawing.draw(probe_plane((0, 0, -8.0)), None, index=3).image.pixels.astype(float)
    assert np.abs(through - before).max() > 20


def test_a_needle_far_from_the_plane_leaves_the_picture_nearly_as_at_rest(plain):
    """Elastic tissue moves everywhere a little; at its held face next to nothing."""
    volume, phantom, display = plain
    grid = SpatialGrid.spanning(volume.origin, np.add(volume.origin, volume.size), (9, 9, 9))
    model = SpatialForceModel.green(grid, forces=NeedleForces(tip=0.2, friction_limit=0.005))
    insertion = SpatialInsertion.straight((-4, 0, -8), (0.5, 1, 0), 8.0, 4.0, dwell=0.0, retract=False)
    form = rescattered_slices(phantom, volume, display=display)
    alike = {}
    for z in (10.0, -8.0):
        path = PlanePath.still(probe_plane((0.0, 0.0, z)))
        *_, last = simulate_space(volume, PROBE, path, insertion, model, fps=3.0, form_image=form)
        still = form(probe_plane((0.0, 0.0, z)), PROBE, None, last.index)
        pair = [amplitude(image, display).ravel() for image in (last.image, still)]
        alike[z] = np.corrcoef(*pair)[0, 1]
    assert alike[10.0] > 0.98
    assert alike[-8.0] < 0.8


def test_a_volume_imaged_anew_is_as_bright_as_it_was():
    volume = evenly(60)
    voxels = volume.voxels.copy()
    voxels[:, :, 31:] = 150
    voxels[:, 40:, :] = 0
    volume = replace(volume, voxels=voxels)
    phantom, display = rescattered_volume(volume, PROBE)
    picture = rescattered_slices(phantom, volume, display=display)(probe_plane((0, 0, 0)), PROBE, None, 0)
    power = display.envelope(picture.pixels) ** 2
    level = display.top + display.dynamic_range * (np.array([60, 150]) / 255.0 - 1.0)
    rows = slice(round(4 / 0.2), round(17 / 0.2))
    left, right = power[rows, 10:50].mean(), power[rows, 70:110].mean()
    # three looks of one place are not quite independent, and the mean of amplitudes is less than the root of the mean power
    found = 10 * np.log10([left, right])
    assert found[1] - found[0] == pytest.approx(level[1] - level[0], abs=0.7)
    assert found == pytest.approx(level, abs=1.3)
    assert picture.pixels[round(23 / 0.2) :].max() < 30


def test_scatterers_lie_where_the_volume_lies(plain):
    volume, phantom, _ = plain
    points = phantom.scattering.points.reshape(3, -1)
    loud = np.abs(phantom.scattering.amplitudes).ravel() > 1e-6
    low = points[:, loud].min(axis=1)
    high = points[:, loud].max(axis=1)
    half = 0.5 * np.array(volume.spacing)
    np.testing.assert_allclose(low, np.maximum(volume.origin - half, [-99, 0, -99]), atol=0.6)
    np.testing.assert_allclose(high, np.add(volume.origin, volume.size) + half, atol=1.1)
    assert np.sqrt(np.mean(phantom.scattering.amplitudes.ravel()[loud] ** 2)) == pytest.approx(1.0, rel=0.02)


def test_each_frame_has_noise_of_its_own_and_the_same_frame_the_same(plain):
    volume, _, _ = plain
    quiet = replace(volume, voxels=np.full_like(volume.voxels, 1))
    dim, shown = rescattered_volume(quiet, PROBE)
    form = rescattered_slices(dim, quiet, display=replace(shown, top=shown.top - 40.0))
    plane = probe_plane((0, 0, 0))
    first, again, next_one = (form(plane, PROBE, None, k).pixels for k in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert (first != next_one).any()


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: rescattered_volume(replace(evenly(), voxels=np.zeros((49, 57, 61))), PROBE), "8-bit"),
        (lambda: rescattered_volume(evenly(0), PROBE), "black everywhere"),
        (
            lambda: rescattered_volume(Volume(np.full((9, 9, 9), 9, np.uint8), (40.0, 40.0, 40.0)), PROBE),
            "million scatterers; at most 40",
        ),
    ],
)
def test_what_cannot_be_imaged_anew_gets_a_sentence(make, said):
    with pytest.raises(InputError, match=said):
        make()


def test_a_scenario_says_what_rescatter_needs(tmp_path):
    said = {"image.file": "sample:spine", "output.image_model": "rescatter"}
    with pytest.raises(InputError, match="elevation of the probe must be above 0"):
        open_spatial(Scenario().with_values({**said, "space.probe.elevation": 0.0}), tmp_path)
    with pytest.raises(InputError, match="looks are one angle or more below"):
        open_spatial(Scenario().with_values({**said, "phantom.angles": [-30.0, 0.0]}), tmp_path)
    opened = open_spatial(Scenario().with_values(said), tmp_path)
    assert opened.form_image is not None
    assert any("scatterers as bright as the volume" in note for note in opened.notes)
    assert open_spatial(Scenario().with_values({"image.file": "sample:spine"}), tmp_path).form_image is None
