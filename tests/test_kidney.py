"""The synthetic kidney: what its picture must show, its labels and stiffness, its seed, and the file that keeps it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from hashlib import sha256
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from echospline.errors import InputError
from echospline.laboratory import Kidney, sample_volume
from echospline.laboratory.anatomy import KidneyAnatomy, lattice
from echospline.laboratory.beam_lattice import LINE, SAMPLE
from echospline.laboratory.kidney_recipe import (
    CELL,
    CELLS,
    CURVED,
    LOW,
    PROBE,
    TISSUES,
)
from echospline.scenario import Scenario, open_spatial
from echospline.scenario.run_space import run_space
from echospline.scenario.space_models import build_spatial_model
from echospline.scene import Floats, probe_plane

SAMPLE_MODULE = import_module("echospline.laboratory.kidney")
NAMES = [k.name for k in TISSUES]
PLANES = (-12.0, -2.0, 6.0)


@pytest.fixture(scope="module")
def patient(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Kidney]:
    """``sample:kidney``, made once for this file in a cache folder of its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield SAMPLE_MODULE.kidney()


def digest(*arrays: NDArray[np.generic]) -> str:
    return sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()


def labels_of_plane(
    patient: Kidney, z: float, shape: tuple[int, int]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return labels on the samples of the plane's echoes, and where all cells within 1.5 mm have the same."""
    rows, lines = shape
    first = -((lines - 1) / 2) * LINE
    k = int((z - LOW[2]) / CELL[2])
    y = np.minimum((np.arange(rows) * SAMPLE / CELL[1]).astype(int), CELLS[1] - 1)
    x = ((first + np.arange(lines) * LINE - LOW[0]) / CELL[0]).astype(int)
    labels = patient.built.labels[k - 2 : k + 3]
    low, high = (f(labels, size=(5, 15, 7)) for f in (ndimage.minimum_filter, ndimage.maximum_filter))
    return labels[2][np.ix_(y, x)], (low == high)[2][np.ix_(y, x)]


def levels_by_tissue(patient: Kidney) -> dict[str, float]:
    """Return the mean power inside every tissue, where neither bone nor stone lies above, dB."""
    powers: dict[str, list[Floats]] = {}
    for z in PLANES:
        envelope, _ = patient.phantom.envelope(probe_plane((0, 0, z)), PROBE)
        labels, interior = labels_of_plane(patient, z, envelope.shape)
        solid = np.isin(labels, [NAMES.index("bone"), NAMES.index("stone")])
        # beams slant by 8 degrees: a shadow widens to both sides
        shadow = ndimage.binary_dilation(np.cumsum(solid, axis=0) > 0, np.ones((1, 61)))
        for index, name in enumerate(NAMES):
            powers.setdefault(name, []).append(
                envelope[interior & ~shadow & (labels == index)].astype(float) ** 2
            )
    joined = {name: np.concatenate(p) for name, p in powers.items()}
    return {name: float(10 * np.log10(p.mean())) for name, p in joined.items() if p.size > 300}


@pytest.fixture(scope="module")
def levels(patient: Kidney) -> dict[str, float]:
    return levels_by_tissue(patient)


def test_tissues_are_as_bright_as_the_table_orders_them(levels: dict[str, float]) -> None:
    order = ("urine", "pyramid", "cortex", "perirenal fat", "sinus")
    found = [levels[name] for name in order]
    assert found == sorted(found)
    assert levels["cortex"] - levels["pyramid"] == pytest.approx(8.5, abs=2.5)
    assert levels["sinus"] - levels["cortex"] == pytest.approx(12.0, abs=3.5)


def test_urine_is_anechoic(levels: dict[str, float]) -> None:
    assert levels["urine"] < levels["cortex"] - 15.0
    assert levels["urine"] < levels["sinus"] - 25.0


@pytest.mark.parametrize("solid", ["bone", "stone"])
def test_bone_and_stone_shine_and_throw_a_shadow(patient: Kidney, solid: str) -> None:
    labels = patient.built.labels == NAMES.index(solid)
    thick = labels.sum(axis=1) * CELL[1]
    if solid == "bone":  # a rib that crosses the picture away from its edge
        thick[:, (np.arange(CELLS[0]) * CELL[0] + LOW[0]) < -35.0] = 0.0
    k, i = np.unravel_index(int(np.argmax(thick)), thick.shape)
    column = np.flatnonzero(labels[k, :, i]) * CELL[1]
    x, z = LOW[0] + (i + 0.5) * CELL[0], LOW[2] + (k + 0.5) * CELL[2]
    envelope, beams = patient.phantom.envelope(probe_plane((0, 0, z)), PROBE)
    line = round((x - beams.origin[0]) / LINE)
    face = envelope[round(column[0] / SAMPLE) - 8 : round(column[0] / SAMPLE) + 9, line - 2 : line + 3]
    assert 20 * np.log10(face.max()) > 30.0
    rows = slice(round((column[-1] + 2.0) / SAMPLE), round((column[-1] + 10.0) / SAMPLE))
    below = envelope[rows, line - 4 : line + 5]
    sides = [envelope[rows, line + off : line + off + 16] for off in (-60, 44)]
    beside = np.concatenate(sides, axis=1)
    fall = 10 * np.log10((beside.astype(float) ** 2).mean() / (below.astype(float) ** 2).mean())
    assert fall > 10.0


def test_attenuation_inside_a_tissue_is_that_of_the_table(patient: Kidney) -> None:
    labels = patient.built.labels[:, ::2]
    low, high = (f(labels, size=(7, 3, 13)) for f in (ndimage.minimum_filter, ndimage.maximum_filter))
    found = patient.built.attenuation.astype(float)
    checked = 0
    for index, kind in enumerate(TISSUES):
        inside = (low == high) & (labels == index)
        if kind.name in ("skin", "fat", "muscle", "perirenal fat", "cortex", "sinus", "liver"):
            assert np.median(found[inside]) == pytest.approx(kind.attenuation, rel=0.02), kind.name
            checked += 1
    assert checked == 7


def test_gain_undoes_the_median_loss(patient: Kidney) -> None:
    """Cortex is as bright near the surface of the kidney as deep in it, within the tissue's own unevenness."""
    near, far = [], []
    for z in PLANES:
        envelope, _ = patient.phantom.envelope(probe_plane((0, 0, z)), PROBE)
        labels, interior = labels_of_plane(patient, z, envelope.shape)
        depth = np.arange(len(envelope))[:, None] * SAMPLE + np.zeros(envelope.shape[1])
        lines = np.arange(envelope.shape[1])[None, :] * LINE - PROBE.width / 2
        inside = interior & (labels == NAMES.index("cortex")) & (lines > -15) & (lines < 8)
        near.append(envelope[inside & (depth < 50)])
        far.append(envelope[inside & (depth > 65)])
    ratio = 20 * np.log10(np.concatenate(near).mean() / np.concatenate(far).mean())
    assert abs(ratio) < 4.0


def test_labels_and_volume_agree(patient: Kidney) -> None:
    volume, tissue = patient.volume, patient.tissue
    assert tissue.labels.shape == volume.shape
    assert tissue.labels.spacing == volume.spacing
    assert tissue.labels.origin == volume.origin
    assert volume.voxels.dtype == np.uint8
    assert volume.origin[1] == 0.0
    grey = {}
    for name in ("urine", "pyramid", "cortex", "sinus"):
        core = ndimage.binary_erosion(tissue.mask(name), np.ones((3, 7, 5)))
        grey[name] = float(np.median(volume.voxels[core]))
    assert grey["urine"] < grey["pyramid"] < grey["cortex"] < grey["sinus"]
    # where bone faces the beam, its first voxels down a column outshine nearly all of the picture
    bone = tissue.mask("bone")
    slope = np.abs(np.gradient(np.argmax(bone, axis=1).astype(float), axis=1))
    top = bone & ~np.roll(bone, 1, axis=1) & (np.cumsum(bone, axis=1) == 1) & (slope < 1.0)[:, None, :]
    near = ndimage.maximum_filter(volume.voxels, size=(1, 7, 1))
    assert top.sum() > 500
    assert np.percentile(near[top], 5) > np.percentile(volume.voxels, 99)
    # every voxel has the label of the cell that it lies in
    rng = np.random.default_rng(0)
    points = rng.uniform((-55, 0, -29), (55, 89, 29), (2000, 3))
    nearest = np.rint((points - volume.origin) / np.array(volume.spacing)) * volume.spacing + volume.origin
    x, y, z = np.floor((nearest - LOW) / np.array(CELL) + 1e-6).astype(int).T
    np.testing.assert_array_equal(tissue.label_at(points), patient.built.labels[z, y, x])


def test_volume_is_the_stack_of_planes_imaged_anew(patient: Kidney) -> None:
    volume = patient.volume
    k = 33
    z = volume.origin[2] + k * volume.spacing[2]
    picture = patient.phantom.image_plane(probe_plane((0, 0, z)), PROBE)
    points = np.insert(picture.grid.nodes, 2, z, axis=1)
    slice_ = volume.sample(points).reshape(picture.pixels.shape)
    assert np.corrcoef(slice_.ravel(), picture.pixels.ravel().astype(float))[0, 1] > 0.97


def test_stiffness_follows_the_labels(patient: Kidney) -> None:
    tissue = patient.tissue
    for kind in TISSUES:
        found = np.unique(tissue.young[tissue.mask(kind.name)])
        np.testing.assert_allclose(found, kind.young)
    k, j, i = np.argwhere(tissue.mask("stone"))[50]
    place = np.array(tissue.labels.origin) + np.array((i, j, k)) * tissue.labels.spacing
    assert tissue.young_at(place[None]) == 1e6
    with pytest.raises(InputError, match="there is no tissue 'spleen'"):
        tissue.mask("spleen")


def test_stone_lies_in_a_calyx_and_every_tissue_is_there(patient: Kidney) -> None:
    labels = patient.built.labels
    assert set(np.unique(labels)) == set(range(len(TISSUES)))
    stone = labels == NAMES.index("stone")
    shell = ndimage.binary_dilation(stone, np.ones((3, 7, 3))) & ~stone
    assert (labels[shell] == NAMES.index("urine")).mean() > 0.5
    volume = stone.sum() * np.prod(CELL)
    assert 4 / 3 * np.pi * 4.4 * 3.0 * 3.6 == pytest.approx(volume, rel=0.15)


def test_a_needle_meets_skin_fat_muscle_fat_cortex_and_urine_before_the_stone(patient: Kidney) -> None:
    stone = np.argwhere(patient.built.labels == NAMES.index("stone")).mean(axis=0)
    k, _, i = np.rint(stone).astype(int)
    column = patient.built.labels[k, :, i]
    path = [NAMES[a] for n, a in enumerate(column) if n == 0 or column[n - 1] != a]
    before = path[: path.index("stone")]
    for name in ("skin", "fat", "muscle", "perirenal fat", "cortex", "urine"):
        assert name in before
    assert before.index("skin") < before.index("muscle") < before.index("cortex") < before.index("urine")
    assert "bone" not in before


def test_the_curved_array_sees_the_same_patient(patient: Kidney) -> None:
    plane = probe_plane((0, 0, -2.0))
    linear, curved = (patient.phantom.image_plane(plane, probe) for probe in (PROBE, CURVED))
    points = np.stack(np.meshgrid(np.arange(-25.0, 25.0, 0.5), np.arange(30.0, 80.0, 0.5)), -1).reshape(-1, 2)

    def smooth(picture) -> Floats:  # type: ignore[no-untyped-def]
        coarse = ndimage.gaussian_filter(picture.pixels.astype(float), 1.2 / picture.spacing[0])
        index = picture.grid.to_index(points).T[::-1]
        return np.asarray(ndimage.map_coordinates(coarse, index, order=1))

    assert np.corrcoef(smooth(linear), smooth(curved))[0, 1] > 0.8


def test_the_same_seed_gives_the_same_bytes_in_another_process(patient: Kidney) -> None:
    code = """
from hashlib import sha256
from echospline.laboratory.kidney_recipe import PROBE, build_tissue
from echospline.scene import probe_plane
built = build_tissue(1)
picture = built.phantom(1).image_plane(probe_plane((3.0, 0.0, -2.0), 20.0), PROBE).pixels
print(sha256(built.labels.tobytes() + built.levels.tobytes() + picture.tobytes()).hexdigest())
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env=dict(os.environ),
        timeout=300,
    )
    picture = patient.phantom.image_plane(probe_plane((3.0, 0.0, -2.0), 20.0), PROBE).pixels
    built = patient.built
    assert done.stdout.strip() == digest(built.labels, built.levels, picture)


def test_another_seed_is_another_patient() -> None:
    axes = (np.arange(low, high, 1.5, dtype=np.float32) for low, high in ((-40, 40), (2, 88), (-24, 24)))
    p = lattice(*axes)
    capsules = [KidneyAnatomy(seed).distances(p)["capsule"] < 0 for seed in (1, 1, 2)]
    np.testing.assert_array_equal(capsules[0], capsules[1])
    assert 0.85 < (capsules[0] == capsules[2]).mean() < 0.995


def test_the_kept_file_is_read_back_whole(patient: Kidney) -> None:
    path = SAMPLE_MODULE.cache_path()
    assert path.is_file()
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    kept = SAMPLE_MODULE.kidney()
    assert kept is not patient
    np.testing.assert_array_equal(kept.volume.voxels, patient.volume.voxels)
    assert kept.volume.origin == patient.volume.origin
    plane = probe_plane((0, 0, 4.0), 30.0)
    np.testing.assert_array_equal(
        kept.phantom.image_plane(plane, PROBE).pixels, patient.phantom.image_plane(plane, PROBE).pixels
    )


@pytest.fixture
def builds(patient: Kidney, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Replace the recipe by its result; the list counts how often it was asked for."""
    asked: list[int] = []

    def build(seed: int) -> object:
        asked.append(seed)
        return patient.built

    monkeypatch.setattr(SAMPLE_MODULE, "build_tissue", build)
    monkeypatch.setattr(SAMPLE_MODULE, "build_volume", lambda phantom: patient.volume)
    return asked


def test_a_damaged_file_is_made_anew(
    builds: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    path = SAMPLE_MODULE.cache_path()
    path.parent.mkdir(parents=True)
    stale = path.with_name("kidney-1-000000000000.npz")
    stale.write_bytes(b"an older recipe")
    SAMPLE_MODULE.kidney()
    whole = path.read_bytes()
    assert not stale.exists()
    assert len(builds) == 1
    SAMPLE_MODULE.kidney()
    assert len(builds) == 1
    hit = bytearray(whole)
    hit[len(hit) // 2] ^= 1
    for damaged in (whole[: len(whole) // 2], b"", b"\x80\x04K\x01.", bytes(hit)):
        path.write_bytes(damaged)
        SAMPLE_MODULE.kidney()
        assert path.read_bytes() == whole
    assert len(builds) == 5


def test_without_a_folder_to_write_to_it_is_made_anew(
    builds: list[int], patient: Kidney, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    for _ in range(2):
        assert SAMPLE_MODULE.kidney().volume is patient.volume
    assert len(builds) == 2
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("no home")))
    assert SAMPLE_MODULE.kidney().volume is patient.volume
    assert len(builds) == 3


def test_sample_kidney_by_its_name(patient: Kidney) -> None:
    volume, tissue = sample_volume("kidney")
    assert tissue is not None
    assert volume.source == "sample:kidney"
    assert digest(volume.voxels, tissue.labels.voxels) == digest(
        patient.volume.voxels, patient.tissue.labels.voxels
    )


def test_a_sample_with_another_name_gets_one_sentence() -> None:
    with pytest.raises(InputError, match="no sample volume 'lung'; expected one of: kidney, spine"):
        sample_volume("lung")


def test_a_scene_takes_the_moduli_that_the_kidney_knows(patient: Kidney, tmp_path: Path) -> None:
    plain = Scenario().with_values({"image.file": "sample:kidney"})
    opened = open_spatial(plain, tmp_path)
    points = np.random.default_rng(2).uniform((-50, 1, -28), (50, 88, 28), (4000, 3))
    np.testing.assert_array_equal(opened.tissue.at(points)[0], patient.tissue.young_at(points))
    assert opened.scenario.space is not None
    assert opened.scenario.space.tissue == "own"
    assert any("cortex 14" in note and "0.9 GB" in note for note in opened.notes)
    for said in ({"space.tissue": "homogeneous"}, {"tissue.young": 7.0}):
        even = open_spatial(plain.with_values(said), tmp_path)
        assert even.tissue.homogeneous
        assert even.scenario.space is not None
        assert even.scenario.space.tissue == "homogeneous"
    layered = {"tissue.region": [{"young": 30.0, "layer": [10, 20]}]}
    assert len(open_spatial(plain.with_values(layered), tmp_path).tissue.regions) == 1
    with pytest.raises(InputError, match="leave one of them out"):
        open_spatial(plain.with_values({**layered, "space.tissue": "own"}), tmp_path)
    with pytest.raises(InputError, match="sample:spine does not know the stiffness"):
        open_spatial(Scenario().with_values({"image.file": "sample:spine", "space.tissue": "own"}), tmp_path)


def test_the_kidney_is_imaged_anew_from_its_own_scatterers(patient: Kidney, tmp_path: Path) -> None:
    said = {"image.file": "sample:kidney", "output.image_model": "rescatter", "space.probe.depth": 50.0}
    opened = open_spatial(Scenario().with_values(said), tmp_path)
    assert opened.form_image is not None
    assert opened.scenario.space is not None
    probe, plane = opened.scenario.space.probe.probe(), probe_plane((3.0, 0.0, 4.0), 20.0)
    np.testing.assert_array_equal(
        opened.form_image(plane, probe, None, 5).pixels,
        patient.phantom.image_plane(plane, probe, noise_seed=5).pixels,
    )


def test_a_run_says_which_moduli_were_used(patient: Kidney, tmp_path: Path) -> None:
    said = {
        "image.file": "sample:kidney", "space.needle.depth": 6.0, "space.needle.dwell": 0.0, "output.fps": 2.0,
        "output.figure": False,
    }  # fmt: skip
    for tissue, expected in (("own", "cortex 14"), ("homogeneous", "10 kPa everywhere")):
        opened = open_spatial(Scenario().with_values({**said, "space.tissue": tissue}), tmp_path)
        assert opened.scenario.space is not None
        model = build_spatial_model(opened.scenario, opened.scenario.space.grid(opened.volume), opened.tissue)
        report = run_space(opened.scenario, opened.volume, model, tmp_path / tissue, tmp_path)
        assert expected in report["moduli"]
        assert "closed form" in report["solved_by"]
