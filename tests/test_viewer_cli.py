"""`echospline live` and `echospline sessions` as a person runs them."""

from __future__ import annotations

import csv
import json
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from echospline.cli.app import app
from echospline.cli.live import opener_for, scene_of
from echospline.cli.options import scenario_from
from echospline.cli.sessions import keyframes
from echospline.errors import InputError
from echospline.io import read_displacement, read_image
from echospline.live import Trace
from echospline.openigtlink import Message, Transform
from echospline.openigtlink.message import encode
from echospline.page import Pack, score
from echospline.scene import AXIAL, ImagingPlane, Insertion, NeedlePose
from echospline.viewer import Sessions
from live_scene import get, listening, post, recorded, running

PERIOD = 1 / 120
EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


def small_scene(**changes):
    scenario, folder = scenario_from("sample:calf", {"mesh.nodes": "12x9", **changes})
    return scene_of(scenario, scenario.read_image(folder), folder), scenario


def invoke(*arguments):
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


@pytest.fixture
def kept(tmp_path):
    """A file with one session of a needle that goes 6 mm into the calf."""
    scene, _ = small_scene(**{"output.formats": "mha", "output.figure": False, "output.fps": "20"})
    exercise = scene.pack.manifest.exercises[0]
    path = Insertion.straight((10.0, 0.0), 50.0, 6.0, 20.0)
    poses = [path.pose(PERIOD * k) for k in range(1, round(path.duration / PERIOD) + 1)]
    rows = np.array([(*p.entry, *p.tip, p.speed) for p in poses])
    trace = Trace(PERIOD, rows, np.repeat(np.array([exercise.landmarks]), len(rows), axis=0))
    sessions = Sessions(tmp_path / "kept.sqlite")
    sessions.add(
        exercise,
        trace,
        score(trace, exercise),
        trainee="Cy",
        scene=scene.title,
        model="fem",
        source=scene.source,
    )
    return sessions.path, trace


def test_live_serves_its_scene_takes_a_session_and_ends_when_told(tmp_path):
    command = [sys.executable, "-m", "echospline", "live", "--no-browser", "--port", "0", "--mesh", "12x9", "--language", "de",
               "--rate", "60", "--sessions", str(tmp_path / "deep" / "kept.sqlite")]  # fmt: skip
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            said = next(line for line in process.stderr if "http://" in line)  # after a first compilation
            address = re.search(r"http://\S+", said).group().rstrip("/")
            pack = Pack.from_bytes(get(address, "/pack")[2])
            assert (pack.manifest.language, pack.manifest.rate) == ("de", 60.0)
            assert {"tps", "elastic"} < {model.name for model in pack.manifest.models}
            assert pack.manifest.models[0].name == "green"
            assert 'lang="de"' in get(address, "/")[2].decode()
            x, y = pack.manifest.needle.entry
            rows = np.array([(x, y, x, y + 0.1 * k, 6.0) for k in range(1, 100)])
            exercise = pack.manifest.exercises[0].model_dump(mode="json")
            told = recorded(pack, rows=rows, exercise=exercise, model="tps")
            status, answer = post(address, "/api/sessions", told)
            assert (status, answer["verified"]) == (200, True), answer
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
        assert "Traceback" not in process.stderr.read()
    (kept,) = Sessions(tmp_path / "deep" / "kept.sqlite").newest()
    assert kept.verified is True


def test_a_tracker_that_is_lost_is_said_on_the_page_of_live_with_its_link(tmp_path):
    command = [sys.executable, "-m", "echospline", "live", "--no-browser", "--port", "0", "--mesh", "12x9", "--link",
               "--link-port", "0", "--link-silence", "1.5", "--sessions", str(tmp_path / "kept.sqlite")]  # fmt: skip
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            said = ""
            while "sessions are kept" not in said:
                said += process.stderr.readline()
            address = re.search(r"http://\S+", said).group().rstrip("/")
            port = int(re.search(r"OpenIGTLink on 127\.0\.0\.1:(\d+)", said).group(1))
            tip = ImagingPlane(AXIAL).tip_matrix(NeedlePose((20.0, 0.0), (20.0, 8.0)))
            with listening(address) as page, socket.create_connection(("127.0.0.1", port)) as tracker:
                tracker.sendall(encode(Message(Transform(tip), "NeedleTipToReference")))
                assert page.hear("tip", timeout=30)["tip"] == pytest.approx([20.0, 8.0])
                bad = Message(
                    Transform(np.eye(4)), "NeedleTipToReference", 0.0, 2, {"TransformStatus": "MISSING"}
                )
                tracker.sendall(encode(bad))
                assert "NeedleTipToReference is MISSING" in page.hear("tracker")["tracker"]
                tracker.sendall(encode(Message(Transform(tip), "NeedleTipToReference")))
                assert page.hear("tracker")["tracker"] == ""
                assert re.search(r"silent for 1\.\d s", page.hear("tracker")["tracker"])
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
        assert "Traceback" not in process.stderr.read()


def test_finite_elements_of_a_scene_are_on_its_packs_mesh():
    scene, _ = small_scene()
    model = scene.fem()
    state = model.rest()
    for k in range(1, 5):
        state = model.advance(state, Insertion.straight((10.0, 0.0), 50.0, 4.0, 20.0).pose(k / 20), 1 / 20)
    moved = model.displacement(state)
    assert moved.shape == (scene.pack.mesh.size, 2)
    assert np.abs(moved).max() > 0.05


def test_a_needle_outside_the_image_is_refused():
    with pytest.raises(InputError, match=r"needle\.entry must lie in the image"):
        small_scene(**{"needle.entry": "500,0"})


def test_an_uploaded_picture_becomes_a_scene(tmp_path):
    _, scenario = small_scene()
    picture = tmp_path / "a.png"
    Image.fromarray(np.full((50, 80), 90, np.uint8)).save(picture)
    opened = opener_for(scenario)(picture, (0.5, 0.5))
    assert opened.pack.mesh.extent == pytest.approx((0.0, 39.5, 0.0, 24.5))
    assert opened.pack.mesh.contains(tuple(opened.pack.manifest.needle.entry)).all()
    with pytest.raises(InputError, match="spacing"):
        opener_for(scenario)(picture, None)


def test_sessions_are_listed_exported_and_scored_again(kept, tmp_path):
    path, trace = kept
    assert "Cy" in invoke("sessions", "list", "--sessions", path).output
    (listed,) = json.loads(invoke("sessions", "list", "--sessions", path, "--json").output)
    assert listed["model"] == "fem"
    out = tmp_path / "all.csv"
    invoke("sessions", "export", out, "--sessions", path)
    assert len(list(csv.reader(out.open()))) == 2
    invoke("sessions", "export", out, "--session", 1, "--sessions", path)
    assert len(list(csv.reader(out.open()))) == 1 + len(trace)
    both = json.loads(invoke("sessions", "rescore", 1, "--sessions", path).output)
    assert both["stored"] == both["now"]


def test_a_session_becomes_a_cine_with_its_true_motion(kept, tmp_path):
    path, trace = kept
    invoke("sessions", "cine", 1, "--out", tmp_path / "out", "--sessions", path)
    record = read_displacement(tmp_path / "out" / "displacement.npz")
    assert (tmp_path / "out" / "cine.mha").exists()
    assert record.times[-1] > 0.7 * trace.times[-1]
    for axis in (0, 1):
        exact = np.interp(record.times + trace.times[0], trace.times, trace.tip[:, axis])
        np.testing.assert_allclose(record.tip[:, axis], exact, atol=1e-6)
    assert np.abs(record.displacement[-1]).max() > 0.1


@pytest.mark.parametrize("moved", [False, True])
def test_a_session_in_an_uploaded_picture_becomes_a_cine_when_the_server_is_gone(tmp_path, moved):
    """Also after its file and the folder beside it were moved."""
    picture = tmp_path / "mine.png"
    pixels = np.random.default_rng(1).integers(0, 200, (120, 160), dtype=np.uint8)
    Image.fromarray(pixels).save(picture)
    _, scenario = small_scene(**{"output.formats": "mha", "output.figure": False, "output.fps": "20"})
    path = tmp_path / "served" / "sessions.sqlite"
    with running(tmp_path / "served", opener=opener_for(scenario)) as (address, _, _):
        status, _, said = get(address, "/api/open?name=mine.png&spacing=0.25", "POST", picture.read_bytes())
        assert status == 200
        pack = Pack.from_bytes(said)
        x, y = pack.manifest.needle.entry
        rows = np.array([(x, y, x, y + 0.1 * k, 12.0) for k in range(1, 60)])
        told = recorded(pack, rows=rows, exercise=pack.manifest.exercises[0].model_dump(mode="json"))
        number = post(address, "/api/sessions", told)[1]["number"]
    picture.unlink()
    if moved:
        path = (tmp_path / "served").rename(tmp_path / "elsewhere") / path.name
    both = json.loads(invoke("sessions", "rescore", number, "--sessions", path).output)
    assert both["stored"] == both["now"]
    invoke("sessions", "cine", number, "--out", tmp_path / "out", "--sessions", path)
    first = read_image(tmp_path / "out" / "cine.mha")
    assert first.grid.shape == (160, 120)
    assert first.grid.spacing == pytest.approx((0.25, 0.25))
    assert np.abs(read_displacement(tmp_path / "out" / "displacement.npz").displacement[-1]).max() > 0.05


def test_keyframes_keep_the_path(kept):
    _, trace = kept
    rows = np.array(keyframes(trace))
    assert len(rows) < 0.6 * len(trace)
    for column, exact in ((3, trace.tip[:, 0]), (4, trace.tip[:, 1])):
        np.testing.assert_allclose(
            np.interp(trace.times - trace.times[0], rows[:, 0], rows[:, column]), exact, atol=1e-9
        )


def test_without_sessions_it_says_so(tmp_path):
    with pytest.raises(InputError, match="no sessions"):
        invoke("sessions", "list", "--sessions", tmp_path / "none.sqlite")


def test_the_example_course_opens_with_its_exercises():
    scenario, folder = scenario_from(str(EXAMPLES / "training.toml"), {"mesh.nodes": "12x9"})
    opened = scene_of(scenario, scenario.read_image(folder), folder)
    assert opened.title == "Calf: biopsy course"
    assert [len(exercise.vessels) for exercise in opened.pack.manifest.exercises] == [0, 0, 2, 2]
