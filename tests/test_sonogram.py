"""Planes imaged from scatterers in space: speckle statistics, places, attenuation, faces and motion against closed forms."""

from __future__ import annotations

from dataclasses import replace
from math import pi, sqrt

import numpy as np
import pytest
from scipy.special import ellipe, ellipk

from echospline.errors import InputError
from echospline.laboratory.beam_lattice import LINE, SAMPLE
from echospline.laboratory.scattering import BRICK, CELL, Faces, Scattering
from echospline.laboratory.sonogram import ABDOMINAL, CUT, SpatialPhantom
from echospline.scene import Floats, ImagingPlane, Probe, Volume, probe_plane

RAYLEIGH = sqrt(pi / (4.0 - pi))
CELLS = (96, 208, 32)  # x, y, z: 52.8 x 41.6 x 32 mm
LOW = (-26.4, 0.0, -16.0)
SLICE = {"elevation": 0.9, "elevation_depth": 20.0, "element_height": 0.0}
PROBE = Probe(width=30.0, depth=38.0, pixel=0.1, **SLICE)
QUIET = -np.inf


def attenuation(value: float) -> Volume:
    return Volume(np.full((2, 2, 2), value, np.float32), (200.0, 200.0, 200.0), (-100.0, 0.0, -100.0))


def phantom(levels: Floats, loss: float = 0.0, faces: Faces | None = None, seed: int = 3) -> SpatialPhantom:
    return SpatialPhantom(
        Scattering.of_levels(levels, LOW, seed), faces or Faces.none(), attenuation(loss), np.zeros(2), 100.0
    )


@pytest.fixture(scope="module")
def homogeneous() -> SpatialPhantom:
    return phantom(np.zeros(CELLS[::-1], np.float32))


def single(
    block: SpatialPhantom, plane: ImagingPlane, probe: Probe = PROBE, look: float = 0.0, **more
) -> Floats:  # type: ignore[no-untyped-def]
    envelope, _ = block.envelope(plane, probe, looks=(look,), floor=QUIET, **more)
    return envelope.astype(np.float64)


def inner(envelope: Floats) -> Floats:
    return envelope[round(3 / SAMPLE) : -round(3 / SAMPLE), round(2 / LINE) : -round(2 / LINE)]


@pytest.mark.parametrize("look", [0.0, 8.0])
@pytest.mark.parametrize(("yaw", "pitch", "width"), [(0, 0, 30), (35, 0, 30), (90, 0, 24), (10, 12, 30)])
def test_speckle_is_rayleighs_in_every_plane(
    homogeneous: SpatialPhantom, yaw: float, pitch: float, width: float, look: float
) -> None:
    probe = replace(PROBE, width=float(width))
    turned = probe_plane((0, 0, 0), yaw, pitch).matrix[:3, 2]
    pieces = np.concatenate(
        [
            inner(
                single(homogeneous, probe_plane(s * turned - (0, s * turned[1], 0), yaw, pitch), probe, look)
            )
            for s in (-6.0, -3.0, 0.0, 3.0, 6.0)
        ]
    )
    assert pieces.mean() / pieces.std() == pytest.approx(RAYLEIGH, rel=0.02)
    assert np.sqrt((pieces**2).mean()) == pytest.approx(1.0, abs=0.04)


def test_level_of_tissue_is_the_level_of_its_speckle(homogeneous: SpatialPhantom) -> None:
    louder = phantom(np.full(CELLS[::-1], 6.0, np.float32))
    plane = probe_plane((0, 0, 0))
    np.testing.assert_allclose(
        single(louder, plane), single(homogeneous, plane) * 10**0.3, rtol=1e-3, atol=1e-4
    )


def test_looks_differ_and_their_mean_is_smoother(homogeneous: SpatialPhantom) -> None:
    plane = probe_plane((0, 0, 0))
    looks = [inner(single(homogeneous, plane, look=a)) for a in (-8.0, 0.0, 8.0)]
    assert np.corrcoef(looks[0].ravel(), looks[1].ravel())[0, 1] < 0.35
    assert np.corrcoef(looks[0].ravel(), looks[2].ravel())[0, 1] < 0.1
    mean, _ = homogeneous.envelope(plane, PROBE, floor=QUIET)
    np.testing.assert_allclose(inner(mean), np.mean(looks, axis=0), rtol=1e-4, atol=1e-5)
    assert inner(mean).mean() / inner(mean).std() > 1.4 * RAYLEIGH


@pytest.mark.parametrize("loss", [0.3, 0.75])
def test_level_falls_with_depth_by_the_attenuation_of_the_table(loss: float) -> None:
    lossy = phantom(np.zeros(CELLS[::-1], np.float32), loss)
    planes = [probe_plane((0, 0, z)) for z in np.arange(-12.0, 12.1, 3.0)]
    power = np.mean([inner(single(lossy, plane)) ** 2 for plane in planes], axis=(0, 2))
    depth = (np.arange(len(power)) + round(3 / SAMPLE)) * SAMPLE
    slope = np.polyfit(depth, 10 * np.log10(power), 1)[0]
    assert slope == pytest.approx(-2 * loss * ABDOMINAL.frequency / 10, rel=0.03)


def one_scatterer() -> tuple[SpatialPhantom, Floats]:
    levels = np.full(CELLS[::-1], -300.0, np.float32)
    levels[17, 120, 60] = 40.0
    block = phantom(levels)
    brightest = int(np.argmax(np.abs(block.scattering.amplitudes)))
    return block, block.scattering.points.reshape(3, -1)[:, brightest].astype(float)


@pytest.mark.parametrize(
    "probe", [PROBE, Probe("curved", radius=40.0, opening=50.0, depth=36.0, pixel=0.1, **SLICE)]
)
@pytest.mark.parametrize(("yaw", "pitch", "roll"), [(0, 0, 0), (90, 0, 0), (25, -10, 15)])
def test_a_scatterer_shines_where_it_lies(probe: Probe, yaw: float, pitch: float, roll: float) -> None:
    block, place = one_scatterer()
    turn = probe_plane((0, 0, 0), yaw, pitch, roll).matrix[:3, :3]
    wanted = np.array((4.1, 21.7, 0.2))  # in the picture, and across it
    plane = probe_plane(place - turn @ wanted, yaw, pitch, roll)
    picture = block.image_plane(plane, probe, noise_seed=1)
    row, column = np.unravel_index(np.argmax(picture.pixels), picture.pixels.shape)
    brightest = probe.grid.nodes.reshape(*picture.pixels.shape, 2)[
        np.nonzero(picture.pixels == picture.pixels[row, column])
    ]
    np.testing.assert_allclose(brightest.mean(axis=0), wanted[:2], atol=0.15)


def test_the_beam_across_the_slice_weighs_a_scatterer() -> None:
    block, place = one_scatterer()

    def brightness(off: float) -> float:
        return float(single(block, probe_plane((place[0], 0, place[2] + off))).max())

    for off in (0.4, 0.9, 1.5):
        assert brightness(off) / brightness(0.0) == pytest.approx(np.exp(-0.5 * (off / 0.9) ** 2), rel=1e-3)
    assert brightness(CUT * 0.9 + 0.05) == pytest.approx(0.0, abs=1e-6)


def test_shifted_tissue_shifts_its_picture(homogeneous: SpatialPhantom) -> None:
    lines, samples = 6, 18
    shift = np.array((lines * LINE, samples * SAMPLE, 0.0))
    plane = probe_plane((0, 0, 0))
    before = inner(single(homogeneous, plane))
    after = inner(single(homogeneous, plane, displacement=lambda p: np.tile(shift, (len(p), 1))))
    same = after[samples:, lines:] - before[:-samples, :-lines]
    assert np.sqrt((same**2).mean()) < 2e-3


def test_tissue_moved_across_the_plane_is_the_plane_moved_the_other_way(homogeneous: SpatialPhantom) -> None:
    moved = single(
        homogeneous, probe_plane((0, 0, 0)), displacement=lambda p: np.tile((0.0, 0.0, 1.3), (len(p), 1))
    )
    np.testing.assert_allclose(moved, single(homogeneous, probe_plane((0, 0, -1.3))), atol=2e-3)


def test_speckle_decorrelates_across_the_plane_as_the_beam_does(homogeneous: SpatialPhantom) -> None:
    """The fields correlate by exp(-e^2 / 4 sigma^2); Rayleigh envelopes then by Middleton's elliptic integrals."""
    for distance in (0.6, 1.2):
        pairs = [
            [inner(single(homogeneous, probe_plane((0, 0, z + off)))) for off in (0.0, distance)]
            for z in np.arange(-12.0, 11.0, 2.5)
        ]
        found = np.mean([np.corrcoef(a.ravel(), b.ravel())[0, 1] for a, b in pairs])
        m = np.exp(-(distance**2) / (2 * 0.9**2))  # square of the fields' correlation
        wanted = (2 * ellipe(m) - (1 - m) * ellipk(m) - pi / 2) / (2 - pi / 2)
        assert found == pytest.approx(wanted, abs=0.03)


def test_no_scatterer_is_missed_where_tissue_moves_into_the_slice(
    homogeneous: SpatialPhantom, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A needle's push across the plane, against all scatterers of the block."""

    def push(p: Floats) -> Floats:
        near = np.exp(-(((p - (2.0, 20.0, 8.0)) / 5.0) ** 2).sum(axis=1))
        return np.outer(near, (0.5, 2.0, -8.0))

    for probe in (PROBE, Probe("curved", radius=40.0, opening=40.0, depth=36.0, pixel=0.1, **SLICE)):
        plane = probe_plane((0, 0, 0), 15.0, 8.0)
        found = single(homogeneous, plane, probe, displacement=push)
        with monkeypatch.context() as patch:
            count = homogeneous.scattering.amplitudes.shape[0]
            patch.setattr(SpatialPhantom, "_bricks_of", lambda *_, n=count: np.arange(n))
            everything = single(homogeneous, plane, probe, displacement=push)
        np.testing.assert_allclose(found, everything, atol=1e-5)
        assert np.abs(everything - single(homogeneous, plane, probe)).max() > 1.0


def test_a_strain_moves_speckle_with_the_tissue(homogeneous: SpatialPhantom) -> None:
    plane = probe_plane((0, 0, 0))
    before = single(homogeneous, plane)
    after = single(
        homogeneous, plane, displacement=lambda p: np.stack((0 * p[:, 0], 0.05 * p[:, 1], 0 * p[:, 0]), 1)
    )
    depth = np.arange(len(before)) * SAMPLE
    pulled = np.stack([np.interp(1.05 * depth, depth, column) for column in after.T], axis=1)
    rows = slice(round(3 / SAMPLE), round(33 / SAMPLE))
    moved = np.corrcoef(before[rows].ravel(), pulled[rows].ravel())[0, 1]
    unmoved = np.corrcoef(before[rows].ravel(), after[rows].ravel())[0, 1]
    assert moved > 0.9
    assert unmoved < 0.3


def flat_face(level: float, power: float, depth: float = 20.0) -> Faces:
    x, z = np.meshgrid(np.arange(-26.0, 26.0, CELL[0]), np.arange(-15.0, 15.0, CELL[2]))
    points = np.stack((x.ravel(), np.full(x.size, depth), z.ravel()), axis=1).astype(np.float32)
    normals = np.tile(np.float32((0, 1, 0)), (x.size, 1))
    strength = np.full(x.size, 10 ** (level / 20), dtype=np.complex64)
    return Faces(points, strength, normals, np.full(x.size, power, dtype=np.float32))


@pytest.mark.parametrize("yaw", [0.0, 40.0, 90.0])
def test_a_face_square_to_the_beam_has_its_level_whatever_the_plane(yaw: float) -> None:
    silent = np.full(CELLS[::-1], -300.0, np.float32)
    probe = replace(PROBE, width=20.0)
    envelope = inner(single(phantom(silent, faces=flat_face(20.0, 8.0)), probe_plane((0, 0, 0), yaw), probe))
    np.testing.assert_allclose(envelope.max(axis=0), 10.0, rtol=0.02)


@pytest.mark.parametrize(
    "probe", [PROBE, Probe("curved", radius=40.0, opening=50.0, depth=36.0, pixel=0.1, **SLICE)]
)
def test_a_rough_face_is_as_bright_in_a_steered_look(probe: Probe) -> None:
    block = phantom(np.full(CELLS[::-1], -300.0, np.float32), faces=flat_face(20.0, 0.0))
    straight, steered = (inner(single(block, probe_plane((0, 0, 0)), probe, look)) for look in (0.0, 8.0))
    middle = slice(straight.shape[1] // 2 - 8, straight.shape[1] // 2 + 9)  # square to the lines
    energy = 100.0 * sqrt(pi) * ABDOMINAL.sigma_axial / SAMPLE  # of a pulse of peak 10
    for envelope in (straight, steered):
        np.testing.assert_allclose((envelope[:, middle] ** 2).sum(axis=0), energy, rtol=0.06)
    np.testing.assert_allclose(steered[:, middle], straight[:, middle], atol=0.3)


def test_a_slanting_face_is_weaker_by_its_cosine_to_the_power() -> None:
    silent = np.full(CELLS[::-1], -300.0, np.float32)
    faces = flat_face(20.0, 8.0)
    tilted = replace(
        faces, normals=np.tile(np.float32((np.sin(0.3), np.cos(0.3), 0)), (len(faces.points), 1))
    )
    envelope = inner(single(phantom(silent, faces=tilted), probe_plane((0, 0, 0))))
    # the columns are split along the normals, which here belie the flat face: only the median is compared
    assert np.median(envelope.max(axis=0)) == pytest.approx(10.0 * np.cos(0.3) ** 8, rel=0.1)


def test_a_shadow_follows_tissue_that_moves(homogeneous: SpatialPhantom) -> None:
    loss = np.zeros((2, 40, 53), np.float32)
    loss[:, 8:12, 20:26] = 15.0
    block = replace(homogeneous, attenuation=Volume(loss, (1.0, 1.0, 200.0), (-26.0, 0.0, -100.0)))
    plane = probe_plane((0, 0, 0))
    rows = slice(round(18 / SAMPLE), round(30 / SAMPLE))

    def centre(envelope: Floats, beams_from: float) -> float:
        level = np.sqrt((envelope[rows] ** 2).mean(axis=0))
        dark = np.flatnonzero(level < 0.3)
        return float(dark.mean() * LINE + beams_from)

    still, beams = block.envelope(plane, PROBE, looks=(0.0,), floor=QUIET)
    moved, _ = block.envelope(
        plane, PROBE, lambda p: np.tile((5.0, 0.0, 0.0), (len(p), 1)), looks=(0.0,), floor=QUIET
    )
    assert centre(still, beams.origin[0]) == pytest.approx(-3.5, abs=0.5)
    assert centre(moved, beams.origin[0]) - centre(still, beams.origin[0]) == pytest.approx(5.0, abs=0.4)


def test_the_same_seed_gives_the_same_picture_and_noise_differs_by_frame(homogeneous: SpatialPhantom) -> None:
    plane = probe_plane((0, 0, 0))
    again = phantom(np.zeros(CELLS[::-1], np.float32)).image_plane(plane, PROBE).pixels
    np.testing.assert_array_equal(homogeneous.image_plane(plane, PROBE).pixels, again)
    quiet = replace(homogeneous, attenuation=attenuation(8.0))
    first, second = (quiet.envelope(plane, PROBE, noise_seed=k)[0] for k in (0, 1))
    assert np.abs(first - second).max() > 0


def test_a_plane_outside_the_tissue_is_dark(homogeneous: SpatialPhantom) -> None:
    assert single(homogeneous, probe_plane((0, 0, 100.0))).max() == 0.0
    above = single(homogeneous, probe_plane((0, -10.0, 0)))
    assert above[: round(9 / SAMPLE)].max() == pytest.approx(0.0, abs=0.01)


def test_pixels_beyond_the_beams_are_black(homogeneous: SpatialPhantom) -> None:
    probe = Probe("curved", radius=30.0, opening=50.0, depth=30.0, pixel=0.2, **SLICE)
    picture = homogeneous.image_plane(probe_plane((0, 0, 0)), probe)
    assert picture.grid == probe.grid
    assert not picture.pixels[~probe.mask].any()
    assert picture.pixels[probe.mask].mean() > 40


def test_what_makes_no_sense_gets_one_sentence(homogeneous: SpatialPhantom) -> None:
    plane = probe_plane((0, 0, 0))
    with pytest.raises(InputError, match="elevation of the probe must be above 0 mm"):
        homogeneous.envelope(plane, replace(PROBE, elevation=0.0))
    with pytest.raises(InputError, match="looks are one angle or more below"):
        homogeneous.envelope(plane, PROBE, looks=(0.0, 40.0))
    with pytest.raises(InputError, match="looks are one angle or more"):
        homogeneous.envelope(plane, PROBE, looks=())
    with pytest.raises(InputError, match="three finite numbers in mm per point"):
        homogeneous.envelope(plane, PROBE, lambda p: p[:, :2])
    with pytest.raises(InputError, match="three finite numbers in mm per point"):
        homogeneous.envelope(plane, PROBE, lambda p: p * np.nan)
    with pytest.raises(InputError, match="4 times its radius"):
        homogeneous.envelope(plane, Probe("curved", radius=5.0, depth=30.0, **SLICE))
    x, y, z = BRICK
    with pytest.raises(InputError, match="multiples of"):
        Scattering.of_levels(np.zeros((z, y, x + 1)), LOW, 0)
