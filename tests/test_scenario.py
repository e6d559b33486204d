"""Scenarios: complete, checked with one clear sentence, and the same after a round trip."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from echospline.errors import InputError
from echospline.mechanics import NeedleForces, TPSParameters, ViscousForces
from echospline.picture import NeedleEcho
from echospline.scenario import MODELS, Scenario, build_model, describe, load, validated
from echospline.scenario.sections import LandmarkSection
from echospline.scene import RegularGrid

FULL = """
format = 1
title = "everything"
[image]
file = "scan.png"
spacing = [0.2, "0.25 mm"]
[tissue]
young = 8.0
[[tissue.region]]
name = "skin"
young = 50.0
layer = [0.0, 2.0]
[[tissue.region]]
name = "lesion"
young = 60.0
circle = { centre = [10.0, 8.0], radius = 2.0 }
[[tissue.region]]
young = 3.0
labels = { file = "labels.png", value = 7 }
[mesh]
nodes = [21, 17]
clamped = ["left", "right"]
clamped_points = [[10.0, 15.0]]
[needle]
entry = [4.0, 0.0]
angle = 60.0
depth = 10.0
speed = [[4.0, 2.0], [10.0, 5.0]]
dwell = 0.5
retract = true
retract_speed = 20.0
[model]
kind = "tps"
landmarks = { sigma = 0.8 }
[output]
fps = 10.0
formats = ["gif"]
"""


@pytest.fixture
def full(tmp_path):
    Image.fromarray(np.zeros((64, 100), np.uint8)).save(tmp_path / "scan.png")
    Image.fromarray(np.full((17, 21), 7, np.uint8)).save(tmp_path / "labels.png")
    (tmp_path / "run.toml").write_text(FULL)
    return tmp_path / "run.toml"


def test_every_part_reaches_its_object(full):
    scenario = load(full)
    image = scenario.read_image(full.parent)
    assert image.spacing == (0.2, 0.25)
    mesh = scenario.grid(image)
    assert mesh.shape == (21, 17)
    tissue = scenario.make_tissue(full.parent, mesh)
    assert tissue.at([(10.0, 8.0)])[0] == 3.0  # the labels, given last, cover everything
    path = scenario.insertion()
    np.testing.assert_allclose(path.times, [0, 2, 3.2, 3.7, 4.2])
    assert path.pose(1.0).speed == pytest.approx(2.0)
    assert path.pose(3.0).speed == pytest.approx(5.0)
    assert path.pose(4.0).speed == pytest.approx(-20.0)
    model = build_model(scenario, mesh, folder=full.parent)
    assert model.parameters.sigma == 0.8
    assert model.clamps.edges == ("left", "right")


def test_the_needles_looks_are_the_cores_unless_the_file_says_otherwise(full):
    assert load(full).needle_echo() == NeedleEcho()
    given = load(full).with_values(
        {
            "needle.gauge": 22,
            "needle.echo.lateral": 0.4,
            "needle.echo.tail": False,
            "needle.echo.apex": [25.0, -40.0],
        }
    )
    assert given.needle_echo() == NeedleEcho(22, lateral=0.4, tail=False, apex=(25.0, -40.0))
    assert given.with_values({"output.needle": False}).needle_echo() is None


def test_the_core_is_loaded_when_a_scenario_is_made_and_not_before():
    code = "import echospline.scenario, echospline.picture, echospline._native as n; print(n.library.cache_info().currsize)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "0"


def test_saved_and_loaded_again_it_is_the_same(full, tmp_path):
    scenario = load(full)
    elsewhere = tmp_path / "results" / "scenario.toml"
    elsewhere.parent.mkdir()
    scenario.save(elsewhere, full.parent)
    again = load(elsewhere)
    assert again.read_image(elsewhere.parent).pixels.shape == (64, 100)
    same = again.model_copy(update={"image": scenario.image})
    assert same == scenario
    assert "# push of the tip (12), mm" in elsewhere.read_text()
    assert "[needle.echo]" in elsewhere.read_text()
    assert "# level of the tip, dB" in elsewhere.read_text()


@pytest.mark.parametrize(
    ("tree", "words"),
    [
        ({"needle": {"dept": 3}}, ["needle.dept", "did you mean depth"]),
        ({"needel": {}}, ["needel", "did you mean needle"]),
        ({"needle": {"depth": -3}}, ["needle.depth = -3", "greater than 0", "mm"]),
        ({"needle": {"depth": "3 cm"}}, ["needle.depth = '3 cm'", "in mm, not in cm"]),
        ({"needle": {"depth": float("nan")}}, ["needle.depth", "finite"]),
        ({"needle": {"entry": [1]}}, ["needle.entry", "missing"]),
        ({"needle": {"gauge": 99}}, ["needle.gauge = 99", "25"]),
        ({"mesh": {"clamped": ["lef"]}}, ["mesh.clamped", "'lef'", "'left'"]),
        ({"mesh": {"nodes": [1, 30]}}, ["mesh.nodes", "greater than or equal to 2"]),
        ({"tissue": {"region": [{"young": -1}]}}, ["tissue.region.0.young = -1"]),
        ({"model": {"kind": "spring"}}, ["model.kind = 'spring'", "'fem'"]),
        ({"needle": {"echo": {"latral": 1}}}, ["needle.echo.latral", "did you mean lateral"]),
        ({"needle": {"echo": {"opacity": 2.0}}}, ["needle.echo", "opacity of a needle must be from 0 to 1"]),
        ({"output": {"inverse": "fast"}}, ["output.inverse = 'fast'", "'exact'"]),
        ({"format": 3}, ["format = 3", "2"]),
        ({"image": 3}, ["image = 3"]),
    ],
)
def test_faults_name_key_value_and_expectation(tree, words):
    with pytest.raises(InputError) as caught:
        validated(tree, "run.toml")
    message = str(caught.value)
    assert message.startswith("run.toml: ")
    assert "\n" not in message
    assert all(word in message for word in words), message


@pytest.mark.parametrize(
    ("text", "words"),
    [("this is not toml", "not a TOML file"), ("a" * 2_000_000, "at most"), ("\0\1", "not a TOML file")],
)
def test_files_of_another_kind_are_refused(tmp_path, text, words):
    (tmp_path / "x.toml").write_text(text)
    with pytest.raises(InputError, match=words):
        load(tmp_path / "x.toml")


def test_missing_files_are_named(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.toml"):
        load(tmp_path / "nowhere.toml")
    scenario = validated({"image": {"file": "gone.png"}}, "x")
    with pytest.raises(InputError, match=r"gone\.png"):
        scenario.read_image(tmp_path)


def test_profiles_and_regions_that_make_no_sense_are_refused(tmp_path):
    mesh = RegularGrid((5, 5), (10, 10))
    with pytest.raises(InputError, match="ascending depths"):
        validated({"needle": {"speed": [[5, 2], [3, 2]], "depth": 3}}, "x").insertion()
    with pytest.raises(InputError, match="exactly one of layer"):
        validated({"tissue": {"region": [{"young": 3.0}]}}, "x").make_tissue(tmp_path, mesh)


def test_defaults_are_those_of_the_model():
    said = LandmarkSection().model_dump()
    assert said.pop("anchor_spacing") is None
    assert said == {name: value for name, value in vars(TPSParameters()).items() if name != "anchor_spacing"}


def test_a_file_of_format_1_means_what_it_meant(tmp_path):
    old = validated(
        {"format": 1, "mesh": {"nodes": [9, 9]}, "model": {"landmarks": {"sigma": 0.5}}}, "old.toml"
    )
    assert old.format == 2
    assert (old.mesh.sliding, old.model.kind) == ([], "tps")
    assert (old.model.landmarks.loading, old.model.landmarks.sigma, old.model.forces.law) == (
        "follow",
        0.5,
        "viscous",
    )
    chosen = validated({"format": 1, "model": {"kind": "fem", "forces": {"law": "stick-slip"}}}, "old.toml")
    assert (chosen.model.kind, chosen.model.forces.law) == ("fem", "stick-slip")
    old.save(tmp_path / "again.toml", tmp_path)
    assert load(tmp_path / "again.toml") == old
    with pytest.raises(InputError, match="mesh = 3"):
        validated({"format": 1, "mesh": 3}, "old.toml")


def test_the_skin_slides_under_the_probe_unless_the_top_is_clamped_or_free():
    assert validated({}, "x").mesh.sliding == ["top"]
    assert validated({"mesh": {"clamped": ["top", "bottom"]}}, "x").mesh.sliding == []
    assert validated({"mesh": {"clamped": ["bottom"]}}, "x").mesh.sliding == ["top"]
    assert validated({"mesh": {"sliding": []}}, "x").mesh.sliding == []
    assert validated({}, "x").with_values({"mesh.clamped": ["top", "left"]}).mesh.sliding == []
    grid = RegularGrid((12, 9), (3, 3))
    beside = validated({}, "x")
    assert build_model(beside, grid, kind="elastic").parameters.anchor_spacing == 1.0
    assert build_model(beside, grid, kind="tps").parameters.anchor_spacing == 1.5
    free = beside.with_values({"mesh.sliding": []})
    assert build_model(free, grid, kind="elastic").parameters.anchor_spacing == 1.5


@pytest.mark.parametrize("kind", MODELS)
def test_every_model_can_be_named(kind):
    model = build_model(Scenario(), RegularGrid((21, 16), (2.0, 2.0)), kind=kind)
    assert not model.displacement(model.rest()).any()


def test_help_texts_hold_unit_range_and_default():
    assert describe("needle.depth") == "length inserted, mm; range 0 to 500; default 28"


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9),
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(
                st.sampled_from(["needle", "depth", "image", "mesh", "nodes", "speed", "x"]),
                inner,
                max_size=3,
            )
        ),
        max_leaves=8,
    )
)
def test_any_tree_is_a_scenario_or_an_input_error(tree):
    try:
        scenario = validated(tree if isinstance(tree, dict) else {"needle": tree}, "any")
    except InputError:
        return
    assert isinstance(scenario, Scenario)


def test_the_law_of_forces_is_the_one_named_or_that_of_an_old_files_numbers():
    grid = RegularGrid((6, 5), (8.0, 8.0))

    def law(**table):
        scene = validated({"model": {"kind": "fem", "forces": table}}, "test")
        return build_model(scene, grid).forces

    assert law() == NeedleForces()
    assert law(friction_limit="0.02 N/mm", dead_band=0.15) == NeedleForces(
        friction_limit=0.02, dead_band=0.15
    )
    assert law(law="viscous") == ViscousForces(friction=1e-3)
    assert law(tip=0.3, friction=2e-3, ramp=0.0) == ViscousForces(0.3, 2e-3, ramp=0.0)


def test_a_number_of_the_viscous_law_is_refused_by_the_other():
    scene = validated({"model": {"kind": "fem"}}, "test")
    with pytest.raises(InputError, match=r'model\.forces\.ramp belongs to the viscous law .* "viscous" too'):
        scene.with_values({"model.forces.ramp": 0.0})
    changed = scene.with_values({"model.forces.ramp": 0.0, "model.forces.law": "viscous"})
    assert changed.model.forces.ramp == 0.0
