"""Two at once, full disks, closed doors: every file appears whole or not at all, and one sentence says why."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from echospline.atomic import LOCK, appearing, claimed, part_of
from echospline.errors import InputError
from echospline.io import open_writer, read, read_displacement
from echospline.scene import RegularGrid

SMALL = ["--mesh", "12x10", "--depth", "6", "--speed", "12", "--dwell", "0.2", "--fps", "10"]
GRID = RegularGrid((33, 21), (0.1, 0.1))
HOLD = """
import sys, time
from pathlib import Path
from echospline.atomic import claimed
with claimed(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.readline()
"""


def start(*words: str, **settings):
    return subprocess.Popen(
        [sys.executable, "-m", "echospline", *words],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **settings,
    )  # fmt: skip


def test_temporary_names_are_nobody_elses():
    assert len({part_of(Path("a/b.mp4")) for _ in range(1000)}) == 1000
    assert {part_of(Path("a/b.mp4")).parent for _ in range(3)} == {Path("a")}


def test_of_two_runs_into_one_folder_one_is_refused_and_the_other_is_whole(tmp_path):
    runs = [
        start("simulate", "sample:calf", "--out", str(tmp_path), *SMALL, "--fps", "60", "--json")
        for _ in "ab"
    ]
    said = [run.communicate(timeout=120) for run in runs]
    codes = [run.returncode for run in runs]
    assert sorted(codes) == [0, 2], said
    refused, whole = codes.index(2), codes.index(0)
    assert said[refused][1].startswith(f"echospline: another run is writing into {tmp_path}")
    assert len(said[refused][1].splitlines()) == 1
    report = json.loads(said[whole][0])
    assert json.loads((tmp_path / "run.json").read_text()) == report
    assert (
        len(read(tmp_path / "cine.mp4"))
        == report["frames"]
        == len(read_displacement(tmp_path / "displacement.npz"))
    )
    assert sorted(f.name for f in tmp_path.iterdir()) == sorted(report["files"])


def test_a_run_after_a_killed_one_is_not_refused(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(InputError, match="another run is writing"), claimed(tmp_path):
            pass
        holder.kill()
    assert (tmp_path / LOCK).exists()
    with claimed(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_two_writers_of_one_name_in_one_process_do_not_meet(tmp_path):
    first, second = (open_writer(tmp_path / "a.mha", GRID, 10) for _ in "ab")
    for i in range(3):
        first.add(np.full((21, 33), 1, np.uint8), i / 10)
        second.add(np.full((21, 33), 2, np.uint8), i / 10)
    second.add(np.full((21, 33), 2, np.uint8), 1.0)
    first.close()
    assert read(tmp_path / "a.mha").frames.tolist() == np.full((3, 21, 33), 1).tolist()
    second.close()
    assert len(read(tmp_path / "a.mha")) == 4
    assert [f.name for f in tmp_path.iterdir()] == ["a.mha"]


def test_many_threads_write_one_name_and_it_is_always_whole(tmp_path):
    def write(letter: str) -> None:
        for _ in range(30):
            with appearing(tmp_path / "a.txt") as part:
                part.write_text(letter * 5000)

    threads = [threading.Thread(target=write, args=(letter,)) for letter in "abc"]
    for thread in threads:
        thread.start()
    for _ in range(100):
        if (tmp_path / "a.txt").exists():
            text = (tmp_path / "a.txt").read_text()
            assert len(text) == 5000
            assert len(set(text)) == 1
    for thread in threads:
        thread.join()
    assert [f.name for f in tmp_path.iterdir()] == ["a.txt"]


def test_a_block_that_fails_leaves_nothing_of_its_file(tmp_path):
    (tmp_path / "a.txt").write_text("earlier")

    def fail() -> None:
        with appearing(tmp_path / "a.txt") as part:
            part.write_text("half")
            raise OSError(28, "No space left on device")

    with pytest.raises(InputError, match=r"cannot write .*a\.txt: No space left"):
        fail()
    assert [(f.name, f.read_text()) for f in tmp_path.iterdir()] == [("a.txt", "earlier")]


@pytest.mark.skipif(sys.platform == "win32", reason="limits of POSIX stand for a full disk")
@pytest.mark.parametrize("formats", ["mp4", "gif", "png", "mha", "igs.mha", "seq.nrrd"])
@pytest.mark.parametrize("room", [3_000, 60_000])
def test_a_full_disk_ends_in_one_sentence_and_leaves_no_half_file(tmp_path, formats, room):
    """No file may grow beyond some bytes: every write beyond fails, as on a full disk."""
    import resource  # noqa: PLC0415

    run = start(
        "simulate", "sample:calf", "--out", str(tmp_path), *SMALL, "--formats", formats,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (room, room)),
    )  # fmt: skip
    said = run.communicate(timeout=120)[1]
    assert run.returncode == 2, said
    assert said.startswith("echospline: cannot write")
    assert len(said.splitlines()) == 1, said
    named = {f.name for f in tmp_path.iterdir() if f.suffix != ".part"}
    assert named <= {"displacement.npz"}
    for name in named:
        assert len(read_displacement(tmp_path / name)) > 5


@pytest.mark.skipif(
    sys.platform == "win32" or os.geteuid() == 0, reason="the system's administrator may write everywhere"
)
def test_a_folder_that_may_not_be_written_is_one_sentence(tmp_path):
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o555)
    for out in (closed, closed / "new"):
        run = start("simulate", "sample:calf", "--out", str(out), *SMALL)
        said = run.communicate(timeout=60)[1]
        assert run.returncode == 2
        assert said.startswith(f"echospline: cannot write {out}: Permission denied")
        assert len(said.splitlines()) == 1


@pytest.mark.parametrize("words", [["--help"], ["info", "sample:calf"], ["demo"]])
def test_nothing_needs_a_home(tmp_path, words):
    plain = {
        k: v
        for k, v in os.environ.items()
        if k not in ("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "MPLCONFIGDIR")
    }
    out = ["--out", str(tmp_path)] if words == ["demo"] else []
    for home in ({}, {"HOME": "/nonexistent"}):
        run = start(*words, *out, env=plain | home)
        said = run.communicate(timeout=120)[1]
        assert run.returncode == 0, said
        assert "Traceback" not in said


def test_training_without_a_home_says_that_sessions_do_not_last(tmp_path):
    plain = {k: v for k, v in os.environ.items() if k not in ("HOME", "XDG_DATA_HOME")}
    run = start("live", "--no-browser", "--port", "0", env=plain | {"XDG_DATA_HOME": "/proc/nowhere"})
    lines = []
    for line in run.stderr:
        lines.append(line)
        if "Ctrl+C" in line:
            break
    run.terminate()
    run.communicate(timeout=30)
    assert any("sessions" in line and "/proc/nowhere" in line for line in lines), lines
    assert any("--sessions" in line for line in lines), lines
