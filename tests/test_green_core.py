"""Green's function in the core: the numbers of NumPy and SciPy, whole sessions without the host, and what is refused."""

from __future__ import annotations

import ctypes
import json
import os
import pickle
import re
import subprocess
import zlib
from pathlib import Path

import numpy as np
import pytest

from echospline import _native
from echospline._native import green as core
from echospline.errors import InputError, SolverError
from echospline.mechanics import ForcedScene, ForceModel
from echospline.mechanics.green_tables import NativeGreen, options_of
from echospline.scene import RegularGrid
from green_scenes import GRID, SCENES, Attached, made, session
from node_here import NODE, STEADY

ROOT = Path(__file__).resolve().parent.parent
WASM = ROOT / "src" / "echospline" / "_native" / "echospline.wasm"
FINE = RegularGrid((90, 70), (40 / 89, 30 / 69))
PLACES = np.array([[20.0, 9.4], [20.3, 10.0], [20.6, 10.6], [20.9, 0.2]])
POINTS = np.vstack(
    [np.stack([np.linspace(12, 24, 50), np.linspace(0, 30, 50)], axis=1), [[0, 20], [40, 30], [40, 0]]]
)


class Oracle:
    """A response that NumPy and SciPy answer, as a ForceModel takes it."""

    def __init__(self, response):
        self.grid, self.answer, self.describe = response.grid, response.solver.answer, response.describe


class FromTables(NativeGreen):
    """Answers of the core from tables alone: it finds the factors of the least squares itself."""

    def __init__(self, response):
        self._grid, self._core, self._handle = response.grid, core.library(), ctypes.c_void_p()
        options, _kept = options_of(response.tables())
        self._check(self._core.echospline_green_create(ctypes.byref(options), ctypes.byref(self._handle)))

    def __del__(self):
        self._core.echospline_green_destroy(self._handle)


def cases(count: int) -> np.ndarray:
    return np.random.default_rng(count).normal(0.0, 1.0, (len(PLACES), 2, count))


@pytest.mark.parametrize("grid", [GRID, FINE], ids=["dense", "fine"])
@pytest.mark.parametrize("name", SCENES)
def test_the_core_answers_as_numpy_does(name, grid):
    response, forces = made(name, grid), cases(3)
    expected = response.solver.answer(PLACES, forces, POINTS)
    for answers in (response.answer, FromTables(response).answer):
        for found, true in zip(answers(PLACES, forces, POINTS), expected, strict=True):
            np.testing.assert_allclose(found, true, rtol=0, atol=1e-9 * np.abs(true).max())


@pytest.mark.parametrize("name", SCENES)
def test_a_session_without_the_host_is_the_references(name):
    response = made(name)
    reference = ForceModel(Oracle(response), solver="reference")
    attached, state = Attached(response.tables()), reference.rest()
    worst = worst_at = 0.0
    for step, (pose, dt) in enumerate(session()):
        state = reference.advance(state, pose, dt)
        attached.advance(pose, dt)
        worst = max(worst, np.abs(attached.displacement() - reference.displacement(state)).max())
        if step % 30 == 29:
            difference = attached.displacement_at(POINTS) - reference.displacement_at(state, POINTS)
            worst_at = max(worst_at, np.abs(difference).max())
    assert np.abs(state.displacement).max() > 0.05
    assert worst < 2e-6
    assert worst_at < 2e-6
    assert attached.load().tip == pytest.approx(state.load.tip, abs=1e-7)


@pytest.mark.parametrize("name", ["lesion", "polygon"])
def test_a_response_pickles_after_use(name):
    response = made(name)
    expected = response.answer(PLACES, cases(1), POINTS)
    copy = pickle.loads(pickle.dumps(response))
    for found, true in zip(copy.answer(PLACES, cases(1), POINTS), expected, strict=True):
        np.testing.assert_array_equal(found, true)


@pytest.mark.parametrize("name", ["sliding top", "polygon"])
def test_a_saved_state_goes_on_in_another_tissue(name):
    tables = made(name).tables()
    one, other, path = Attached(tables), Attached(tables), session()
    for pose, dt in path[:60]:
        one.advance(pose, dt)
    other.state = one.state
    np.testing.assert_array_equal(other.displacement_at(POINTS), one.displacement_at(POINTS))
    for pose, dt in path[60:]:
        one.advance(pose, dt)
        other.advance(pose, dt)
    np.testing.assert_array_equal(other.displacement(), one.displacement())


def test_attaching_forgets_what_the_host_answered():
    attached, path = Attached(made("sliding top").tables()), session()[:40]
    for pose, dt in path:
        attached.advance(pose, dt)
    expected = attached.displacement()
    attached.check(attached.core.echospline_forced_attach(attached.forced, None))
    status = attached.core.echospline_forced_displacement(
        attached.forced, expected.copy().ctypes.data, expected.size
    )
    assert status == _native.Status.NEEDS_STATION
    with pytest.raises(InputError, match="echospline_forced_attach"):
        attached.displacement_at(POINTS)
    attached.check(attached.core.echospline_forced_attach(attached.forced, attached.green))
    np.testing.assert_array_equal(attached.displacement(), expected)


def test_tables_of_the_default_scene_are_small():
    for name, most in (("sliding top", 12_000), ("lesion", 20_000), ("polygon", 60_000)):
        arrays = [v for v in made(name).tables().values() if isinstance(v, np.ndarray)]
        assert len(zlib.compress(b"".join(a.tobytes() for a in arrays), 9)) < most


WRONG = {
    "method": ("sliding top", {"method": 7}, "method must be"),
    "an edge in both": ("sliding top", {"clamped": 4}, "none in both"),
    "one node": ("sliding top", {"shape": [1, 30]}, "2 nodes or more"),
    "no spacing": ("sliding top", {"spacing": [0.0, 1.0]}, "spacing must be"),
    "no radius": ("sliding top", {"radius": float("nan")}, "radius of a force"),
    "soft as nothing": ("sliding top", {"bodies": np.array([[0.3, 0.0]])}, "positive stiffness"),
    "not finite": ("sliding top", {"sources": np.full((75, 2), np.nan)}, "sources must be finite"),
    "order twice": ("sliding top", {"order": np.array([3, 3], dtype=np.int32)}, "different unknowns"),
    "order beyond": ("sliding top", {"order": np.array([999], dtype=np.int32)}, "different unknowns"),
    "depths": ("layer and lesion", {"depths": np.array([0.0, 7.0, 7.0])}, "depths must"),
    "depths that end early": ("sliding top", {"depths": np.array([0.0, 29.0])}, "as the mesh"),
    "a point outside": ("clamped points", {"pins": np.array([[50.0, 3.0]])}, "pins must lie in the tissue"),
    "lines": ("polygon", {"lines_x": np.array([0.0, 3.0, 2.0, 40.0])}, "must ascend"),
    "fewer moduli": ("polygon", {"moduli": np.ones((4, 2))}, "triangles"),
    "more than is factored in time": (
        "layer and lesion",
        {
            "conditions": np.tile([20.0, 0.0, 0.0, -1.0], (60_000, 1)),
            "sides": np.tile([0, 0, -1], (60_000, 1)),
        },
        "for they are factored",
    ),
    "fewer sides": ("lesion", {"sides": np.zeros((4, 3), dtype=np.int32)}, "sides of green must have"),
    "fewer source counts": ("lesion", {"source_counts": np.array([9])}, "source_counts of green must have"),
    "half an entry": ("lesion", {"sources": np.ones(7)}, "2 per entry"),
    "no whole numbers": ("lesion", {"order": np.array([0.5])}, "whole numbers"),
    "a name that is none": ("lesion", {"wonder": 3}, "'wonder' is no table of green"),
    "factors": ("lesion", {"left": np.ones(4)}, "'left' is no table"),
    "another form": ("lesion", {"spacing": [1.0]}, "spacing of green has another form"),
    "more bodies than the arrays": ("lesion", {"band_count": 1 << 40}, "must have"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_tables_are_refused_in_one_sentence(case):
    name, changed, message = WRONG[case]
    with pytest.raises(InputError, match=message):
        Attached(made(name).tables() | changed)


@pytest.mark.parametrize("options", [{"node_count": 4.0}, {"tip": "1"}, {"tip": True}])
def test_a_scene_takes_parameters_of_the_law_alone(options):
    scene = ForcedScene.of(made("lesion"))
    with pytest.raises(InputError, match="of a forced tissue"):
        ForcedScene(options, scene.response, scene.arrays)


def test_tissue_that_is_not_held_is_refused():
    tables = made("polygon").tables()
    with pytest.raises(SolverError, match="cannot move as a whole"):
        Attached(tables | {"held": np.zeros_like(tables["held"]), "moduli": 0 * tables["moduli"]})


def test_a_green_of_another_mesh_is_refused():
    attached, other = Attached(made("sliding top").tables()), Attached(made("sliding top", FINE).tables())
    with pytest.raises(InputError, match="node_count, low and high"):
        attached.check(attached.core.echospline_forced_attach(attached.forced, other.green))


def test_forces_and_points_outside_the_tissue_are_refused():
    answer = made("sliding top").answer
    with pytest.raises(InputError, match="places of forces must lie in the tissue"):
        answer(np.array([[20.0, -1.0]]), np.ones((1, 2, 1)), POINTS)
    with pytest.raises(InputError, match="points must lie in the tissue"):
        answer(PLACES, cases(1), np.array([[41.0, 3.0]]))


@pytest.mark.skipif(
    NODE is None or not WASM.exists(), reason="Node or echospline.wasm is not here: make wasm"
)
def test_webassembly_runs_the_session_as_python_does(tmp_path):
    results = {}
    for name in ("sliding top", "free top", "lesion", "polygon"):
        model, states = ForceModel(Oracle(made(name))), []
        state = model.rest()
        for step, (pose, dt) in enumerate(session()):
            state = model.advance(state, pose, dt)
            if step % 15 == 14:
                at = model.displacement_at(state, POINTS)
                states.append(
                    {
                        "step": step,
                        "displacement": state.displacement.ravel().tolist(),
                        "at": at.ravel().tolist(),
                    }
                )
        plain = {
            k: v.ravel().tolist() if isinstance(v, np.ndarray) else v for k, v in made(name).tables().items()
        }
        results[name] = {"tables": plain, "states": states}
    poses = [[*p.entry, *p.tip, dt] for p, dt in session()]
    given = tmp_path / "green.json"
    given.write_text(
        json.dumps({"scenes": results, "poses": poses, "points": POINTS.ravel().tolist(), "tolerance": 1e-5})
    )
    done = subprocess.run(
        [NODE, STEADY, "--test", "--test-reporter=tap", "tests/js/green.test.js"],
        cwd=ROOT,
        env={**os.environ, "ECHOSPLINE_GREEN": str(given)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    assert int(re.findall(r"# pass (\d+)", done.stdout)[0]) == len(results) + 2, done.stdout
