"""The study on a reduced setting, end to end: files, keys, honesty of the claims, and resuming."""

import csv
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from echospline.errors import InputError
from echospline.mechanics import Elastic, FEMModel, ThinPlate, TPSModel, landmark_stiffness
from echospline.mechanics.spline import factor
from echospline.scenario import build_model, validated
from echospline.scene import Circle, Insertion, Region, RegularGrid, Tissue, field_error
from echospline.study import study, table, write_report
from echospline.study.accuracy import CLAMPED, HELD_OUT, Case, brute_force, observe, oracle
from echospline.study.claims import claims
from echospline.study.paper import Extent
from echospline.study.plane_space import SPACE_SCENES
from echospline.study.scenes import MODELS, SCENES
from echospline.study.speed import mesh_of, savings

TINY = Extent(
    nodes=(17, 13),
    steps=4,
    node_counts=(120, 500),
    seconds=0.02,
    literal_nodes=200,
    runs=8,
    frames=2,
    radii=(1.0,),
    cell=9.0,
)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    out = tmp_path_factory.mktemp("study")
    said = []
    result = study(out, TINY, seed=1, command="echospline study (test)", report=said.append)
    return out, result, said


def test_every_file_is_there_and_whole(done):
    out, _, _ = done
    for name in ("fig2", "fig3a", "fig3b"):
        with Image.open(out / f"{name}.png") as picture:
            picture.verify()
        assert "</svg>" in (out / f"{name}.svg").read_text()[-20:]
    for name in ("accuracy", "scenes", "linearity", "plane_space", "speed", "savings"):
        rows = json.loads((out / f"{name}.json").read_text())
        with (out / f"{name}.csv").open(newline="") as file:
            assert len(list(csv.DictReader(file))) == len(rows) > 0
    assert not list(out.rglob("*.part"))


def test_accuracy_rows_carry_the_agreed_keys_for_four_moduli_in_both_readings(done):
    rows = done[1]["accuracy"]
    keys = {"model", "kernel", "mae_mm", "rmse_mm", "mae_percent_of_mean", "held_out"}
    assert all(keys <= set(row) for row in rows)
    moduli = {(row["reading"], row["young_kpa"]) for row in rows if row["reading"]}
    assert moduli == {
        *(("read as 10, 8, 5, 1 kPa", e) for e in (10.0, 8.0, 5.0, 1.0)),
        *(("as printed", e) for e in (10.0, 4.096, 0.625, 1.0)),
    }
    both = {(row["model"], row["kernel"], row["held_out"]) for row in rows}
    assert {("tps", "thin plate", True), ("tps", "elastic", True), ("green", "half-plane", True)} <= both
    assert all(row["mae_mm"] <= row["rmse_mm"] <= row["worst_mm"] for row in rows)


def test_every_model_answers_or_refuses_every_scene(done):
    rows = done[1]["scenes"]
    assert {(row["scene"], row["model"]) for row in rows} == {(s.name, m) for s in SCENES for m in MODELS}
    for row in rows:
        if row["refused"] is None:
            assert 0 < row["mae_percent_of_mean"] <= row["worst_pose_percent"], row
        else:
            assert len(row["refused"]) > 20
            assert "mae_mm" not in row
    answered = {(row["scene"], row["model"]) for row in rows if row["refused"] is None}
    assert {(SCENES[0].name, m) for m in MODELS} <= answered
    assert (SCENES[2].name, "tps") in answered  # a soft lesion
    mesh = [row["mae_percent_of_mean"] for row in rows if row["model"] == "fem" and row["refused"] is None]
    assert 0 < max(mesh) < 12  # what the coarse mesh of this test costs


def test_the_distance_of_linear_elasticity_grows_with_the_motion(done):
    for plane in ("stress", "strain"):
        rows = [row for row in done[1]["linearity"] if row["plane"] == plane]
        assert [row["peak_mm"] for row in rows] == [0.2, 1.0, 3.0]
        shares = [row["difference_percent_of_mean"] for row in rows]
        assert 0 < shares[0] < 1.5
        assert 4 < shares[1] / shares[0] < 7  # five times the motion: nearly linear
        assert shares[2] > 2 * shares[1]
        assert f"{shares[1]:.1f} % at 1 mm" in (done[0] / "report.html").read_text()


def test_speed_rows_carry_the_agreed_keys_and_name_every_method(done):
    rows = done[1]["speed"]
    keys = {"method", "nodes", "median_ms", "p99_ms", "setup_ms", "threads"}
    assert all(keys <= set(row) for row in rows)
    assert all(row["median_ms"] <= row["p99_ms"] for row in rows)
    literal = {row["nodes"] for row in rows if "literal" in row["method"]}
    assert max(literal) <= 200 < max(row["nodes"] for row in rows)


def test_report_is_one_self_contained_page(done):
    page = (done[0] / "report.html").read_text()

    class Links(HTMLParser):
        def __init__(self):
            super().__init__()
            self.found = []

        def handle_starttag(self, tag, attrs):
            self.found += [value for name, value in attrs if name in ("src", "href")]
            assert tag not in ("script", "link", "iframe")

    links = Links()
    links.feed(page)
    assert len(links.found) == 3
    assert all(link.startswith("data:image/") for link in links.found)
    for claim in done[1]["claims"]:
        assert claim["verdict"] in page


def test_a_second_run_takes_the_cases_from_the_disk(done, tmp_path):
    out, result, said = done
    assert sum(line.startswith("accuracy:") for line in said) == 9 + len(SCENES) + len(SPACE_SCENES)
    again = []
    repeated = study(out, TINY, seed=1, report=again.append)
    assert not any(line.startswith("accuracy:") for line in again)
    assert repeated["accuracy"] == result["accuracy"]
    assert repeated["scenes"] == result["scenes"]
    assert repeated["plane_space"] == result["plane_space"]


def test_oracle_landmarks_bound_what_any_law_can_reach():
    """With FEM's own displacements at the landmarks, the elastic kernel is closer than the thin plate."""
    case = Case(nodes=(28, 21), steps=4)
    fem = FEMModel(case.grid, CLAMPED, case.tissue, case.forces)
    seen = observe(fem, *case.poses(HELD_OUT[0]))
    thin, elastic = (
        field_error(oracle(case.grid, seen, kernel), seen.displacement)
        for kernel in (ThinPlate(), Elastic(0.45, 1.0))
    )
    assert elastic.mae_percent < 10 < thin.mae_percent


def test_a_stiff_region_holds_a_single_landmark_back_as_its_modulus_says():
    """One tip landmark alone moves by E_min / E of what is asked."""
    grid = RegularGrid((21, 16), (2.0, 2.0))
    lesion = Tissue(10.0, regions=[Region(Circle((20.0, 14.0), 5.0), 40.0)])
    for kernel in (ThinPlate(), Elastic(0.45, 1.0)):
        anchors = TPSModel(grid, CLAMPED, kernel=kernel).anchors
        stiffness = landmark_stiffness(lesion, grid, kernel, anchors)
        inside = np.flatnonzero(np.isfinite(stiffness))
        assert set(inside) == set(np.flatnonzero(Circle((20.0, 14.0), 5.0).contains(grid.nodes)))
        node = grid.nearest((20.0, 14.0))
        landmarks = np.vstack([anchors.places, grid.nodes[node]])
        firm = np.append(np.full(len(anchors), np.inf), stiffness[node])
        asked = np.zeros((len(landmarks), 2))
        asked[-1] = (0.3, 0.4)
        moved = factor(kernel, landmarks, firm).solve(asked)(grid.nodes[[node]])[0]
        assert np.hypot(*moved) == pytest.approx(0.5 / 4, rel=0.05)


ROW = {"model": "tps", "how": "fitted", "kernel": "thin plate", "held_out": False, "reading": "as printed"}


def test_claims_follow_the_numbers():
    """Turned numbers turn the verdicts."""
    soft = {**ROW, "young_kpa": 1.0, "mae_mm": 0.9, "mae_percent_of_mean": 2.0}
    stiff = {**ROW, "young_kpa": 10.0, "mae_mm": 0.1, "mae_percent_of_mean": 2.0}
    rows = [soft, stiff, *({**row, "held_out": True} for row in (soft, stiff))]
    saved = [
        {"method": "TPS, a", "against": "FEM, b", "mean_saving_percent": 60.0, "least_saving_percent": 10.0}
    ]
    good = {c["claim"]: c["verdict"] for c in claims(rows, saved)}
    soft["mae_mm"], stiff["mae_mm"] = 0.1, 1.4
    for row in rows:
        row["mae_percent_of_mean"] = 30.0
    saved[0].update(mean_saving_percent=-60.0, least_saving_percent=-90.0)
    bad = {c["claim"]: c["verdict"] for c in claims(rows, saved)}
    for claim, verdict in good.items():
        assert verdict.startswith("holds"), claim
        assert bad[claim].startswith("does not hold"), claim


def test_savings_are_ratios_of_the_same_mesh():
    names = ("TPS, landmarks, refitted per step", "FEM, factored once")
    rows = [
        {"method": m, "nodes": n, "cpu_median_ms": t}
        for m, n, t in (
            (names[0], 500, 1.0),
            (names[1], 500, 4.0),
            (names[0], 4500, 3.0),
            (names[1], 4500, 4.0),
        )
    ]
    (row,) = savings(rows)
    assert (row["mean_saving_percent"], row["least_saving_percent"]) == (50.0, 25.0)


@pytest.mark.parametrize("nodes", [500, 1200, 4500, 40_000])
def test_meshes_have_about_the_nodes_asked_for_and_the_scene_of_the_study(nodes):
    grid = mesh_of(nodes)
    assert grid.size == pytest.approx(nodes, rel=0.05)
    np.testing.assert_allclose(grid.extent, (0, 40, 0, 30))


def test_report_escapes_what_it_is_given(tmp_path):
    write_report(tmp_path / "r.html", "<script>", [("a & b", [table([{"x": "<b>"}], {"x": "<i>"})])])
    page = (tmp_path / "r.html").read_text()
    assert not re.search(r"<script>|<b>|<i>", page)


def test_too_small_a_grid_is_refused(tmp_path):
    with pytest.raises(InputError, match="8 runs or more"):
        brute_force(runs=3, frames=2, nodes=(9, 7))


@pytest.mark.parametrize("loading", ["stick", "follow"])
def test_a_scenario_with_a_stiff_region_holds_landmarks_back_there(loading):
    """The same needle into the middle of a lesion ten times as stiff displaces it less, by spline as by FEM."""
    # landmarks that stick are displaced as far as friction holds them, in the lesion as around it: there a spline holds back less
    most = (
        {"tps": 0.92, "elastic": 0.8, "fem": 0.6, "green": 0.6}
        if loading == "stick"
        else dict.fromkeys(("tps", "elastic", "fem", "green"), 0.8)
    )
    scene = validated({"mesh": {"nodes": [21, 16]}, "model": {"landmarks": {"loading": loading}}}, "test")
    region = {"young": 100.0, "circle": {"centre": [20.0, 12.0], "radius": 5.0}}
    with_lesion = scene.with_values({"tissue.region": [region]})
    grid = RegularGrid((21, 16), (2.0, 2.0))
    insertion = Insertion.straight((14.0, 0.0), 65.0, 13.0)
    inside = Circle((20.0, 12.0), 5.0).contains(grid.nodes)
    for kind in ("tps", "elastic", "fem", "green"):
        largest = []
        for s in (scene, with_lesion):
            model = build_model(s, grid, kind=kind)
            state = model.rest()
            for t in np.linspace(0.1, insertion.duration, 12):
                state = model.advance(state, insertion.pose(t), 0.2)
            largest.append(np.hypot(*model.displacement(state)[inside].T).max())
        assert largest[1] < most[kind] * largest[0], kind
