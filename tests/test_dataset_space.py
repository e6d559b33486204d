"""Datasets in space: drawn needles and hands, pictures, and the truth in the picture and out of it."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from echospline.cli.app import app
from echospline.errors import InputError
from echospline.io import read, read_spatial_displacement
from echospline.io.volume_writing import write_volume
from echospline.scenario import load
from echospline.scene import ImagingPlane, Probe, SpatialPose, Volume, probe_plane
from echospline.study.dataset import needle_mask
from echospline.study.dataset_space import SpatialVariation, drawn_space, imaged_space, mask_in_slice

zarr = pytest.importorskip("zarr")

BASE = """
[image]
file = "block.mha"
[space.mesh]
nodes = [9, 9, 9]
[space.probe]
view = "longitudinal"
width = 20.0
depth = 18.0
pixel = 0.25
[space.needle]
entry = [-7.0, 0.0, 0.0]
direction = [1.0, 1.0, 0.0]
depth = 9.0
[output]
formats = ["mha"]
figure = false
"""


def run(*arguments):
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    return result


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    folder = tmp_path_factory.mktemp("base")
    grey = np.random.default_rng(0).integers(20, 200, (31, 25, 31)).astype(np.uint8)
    write_volume(folder / "block.mha", Volume(grey, (0.8, 0.8, 0.8)))
    (folder / "base.toml").write_text(BASE)
    return folder / "base.toml"


@pytest.fixture(scope="module")
def store(base):
    out = base.parent / "set.zarr"
    done = run("dataset", base, "--n", 3, "--frames", 4, "--seed", 2, "--out", out, "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["made"] == 3
    return out


def test_a_sample_has_pictures_and_their_truth(store):
    group = zarr.open_group(str(store), mode="r")
    rows, columns = 73, 81
    assert group["image"].shape == (3, 4, rows, columns)
    assert group["displacement"].shape == (3, 4, 10, 11, 2)
    assert group["out_of_plane"].shape == group["valid"].shape == (3, 4, 10, 11)
    assert group["plane"].shape == (3, 4, 4, 4)
    assert group["image"].chunks == (1, 4, rows, columns)
    moved, away = group["displacement"][:], group["out_of_plane"][:]
    np.testing.assert_allclose(moved[:, 0], 0.0, atol=1e-5)
    np.testing.assert_allclose(away[:, 0], 0.0, atol=1e-5)
    assert (np.abs(moved[:, -1]).max(axis=(1, 2, 3)) > 0.1).all()
    assert (np.abs(away[:, -1]).max(axis=(1, 2)) > 0.1).all()
    valid = group["valid"][:]
    assert valid[:, 0].mean() > 0.7
    assert valid[:, -1].mean() < valid[:, 0].mean()
    for plane in group["plane"][:].reshape(-1, 4, 4):
        assert ImagingPlane(plane)
    assert group.attrs["pixel_mm"] == [0.25, 0.25]


def test_a_sample_in_space_is_made_again_by_its_own_scenario(store, tmp_path):
    group = zarr.open_group(str(store), mode="r")
    done = run("simulate", store / "scenarios" / "0000001.toml", "--out", tmp_path, "--json")
    assert done.exit_code == 0, done.output
    np.testing.assert_array_equal(read(tmp_path / "cine.mha").frames, group["image"][1])
    again = read_spatial_displacement(tmp_path / "displacement.npz")
    np.testing.assert_array_equal(again.picture_displacement, group["displacement"][1])
    np.testing.assert_array_equal(again.picture_out_of_plane, group["out_of_plane"][1])
    np.testing.assert_array_equal(again.picture_valid, group["valid"][1])
    np.testing.assert_allclose(again.plane, group["plane"][1], atol=1e-12)
    np.testing.assert_allclose(again.tip, group["tip"][1], atol=1e-12)


def test_draws_stay_in_their_ranges_and_depend_on_index_and_seed_alone(base):
    loaded, v = load(base), SpatialVariation()
    across = 0
    for i in range(60):
        s = drawn_space(loaded, i, 7, 5)
        assert s.model_dump() == drawn_space(loaded, i, 7, 5).model_dump()
        first, last = s.space.probe.path
        insertion = s.space.needle.insertion()
        assert insertion.duration == pytest.approx(last[0])
        assert int(insertion.duration * s.output.fps + 1e-9) + 1 == 5
        assert 0.5 * 9.9 - 1e-9 <= s.space.needle.depth <= 9.9 + 1e-9
        assert v.speed[0] <= s.space.needle.speed <= v.speed[1]
        assert max(abs(first[5]), abs(first[6])) <= 5.0
        # how far the needle turns from the picture's lateral axis along the skin: across it is held at a right angle, but for the hand
        plane = s.space.probe.planes(insertion).at(0.0)
        direction = np.array(s.space.needle.direction) * (1, 0, 1)
        turned = np.degrees(np.arccos(abs(direction @ plane.matrix[:3, 0]) / np.linalg.norm(direction)))
        assert turned < 15 or turned > 75
        across += turned > 75
    assert 0.1 < across / 60 < 0.55
    assert drawn_space(loaded, 0, 7, 5).model_dump() != drawn_space(loaded, 0, 8, 5).model_dump()


def test_bases_of_the_plane_and_of_space_do_not_mix_and_a_needle_with_a_path_is_refused(base, tmp_path):
    flat = tmp_path / "flat.toml"
    flat.write_text("[phantom]\nsize = [20.0, 20.0]\n")
    done = run("dataset", base, flat, "--n", 2, "--out", tmp_path / "x.zarr")
    assert done.exit_code != 0
    assert "all in the plane or all in space" in str(done.exception) + done.output
    moving = load(base).with_values({"space.needle.path": [[0, 0, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0, 5, 0]]})
    with pytest.raises(InputError, match="has a path"):
        drawn_space(moving, 0, 0, 4)


PROBE = Probe(width=20.0, depth=20.0, pixel=0.1, elevation=0.75)


def test_a_needle_in_the_plane_is_masked_as_in_the_plane():
    pose = SpatialPose((-5.0, 0.0, 0.0), (3.0, 9.0, 0.0))
    mask = mask_in_slice(PROBE, probe_plane((0, 0, 0)), pose, 0.6)
    np.testing.assert_array_equal(mask, needle_mask(PROBE.grid, (-5.0, 0.0), (3.0, 9.0), 0.6))


def test_a_needle_straight_across_is_a_disc_and_one_beyond_the_slice_is_not_masked():
    across = SpatialPose((1.0, 8.0, -20.0), (1.0, 8.0, 20.0))
    disc = mask_in_slice(PROBE, probe_plane((0, 0, 0)), across, 0.6)
    assert disc.sum() * 0.01 == pytest.approx(np.pi * 0.36, rel=0.03)
    aside = SpatialPose((-5.0, 0.0, 6.0), (3.0, 9.0, 6.0))
    assert not mask_in_slice(PROBE, probe_plane((0, 0, 0)), aside, 0.6).any()
    assert not mask_in_slice(PROBE, probe_plane((0, 0, 0)), SpatialPose((0, 0, 0), (0, 0, 0)), 0.6).any()


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(-8, 8), min_size=6, max_size=6), st.floats(-60, 60))
def test_the_mask_is_what_lies_near_the_shaft_inside_the_slice(numbers, yaw):
    """Point by point: every masked pixel has a place of the shaft inside the slice within the radius, and no other pixel has one."""
    entry, tip = numbers[:3], numbers[3:]
    entry[1], tip[1] = 0.0, abs(tip[1]) + 2.0
    probe = Probe(width=20.0, depth=20.0, pixel=0.5, elevation=0.75)
    plane = probe_plane((0, 0, 0), yaw)
    mask = mask_in_slice(probe, plane, SpatialPose(tuple(entry), tuple(tip)), 0.6)
    shaft = plane.lower(np.linspace(entry, tip, 4001))
    shaft = shaft[np.abs(shaft[:, 2]) <= np.maximum(probe.thickness(shaft[:, 1]), 0.6)]
    nodes = probe.grid.nodes
    nearest = np.full(len(nodes), np.inf)
    for place in shaft[:, :2]:
        nearest = np.minimum(nearest, np.hypot(*(nodes - place).T))
    seen = mask.ravel()
    assert (nearest[seen] <= 0.6 + 0.06).all()
    assert not (nearest[~seen] < 0.6 - 0.06).any()


def test_pictures_imaged_anew_have_speckle_of_their_own_and_the_volumes_moduli_stay(base):
    first = load(base)
    anew = first.with_values({"output.image_model": "rescatter", "space.tissue": "own"})
    drawn = [drawn_space(anew, i, 5, 3) for i in (0, 1)]
    assert drawn[0].phantom.seed != drawn[1].phantom.seed
    assert all(d.tissue.young == first.tissue.young for d in drawn)
    assert drawn_space(first, 0, 5, 3).tissue.young != first.tissue.young
    homogeneous = drawn[0].with_values({"space.tissue": "homogeneous"})
    new, other = (
        imaged_space(s, base.parent)["image"]
        for s in (homogeneous, drawn[0].with_values({"space.tissue": None, "output.image_model": "warp"}))
    )
    assert new.shape == other.shape
    assert np.abs(new[0].astype(float) - other[0]).mean() > 5
