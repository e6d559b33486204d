"""Sweeps: every result on disk at once, resumed after an interruption, and nothing lost with a worker.

The scheduler and the workers are real processes of dask.distributed on the loopback interface.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from echospline.errors import InputError, MissingExtraError
from echospline.study import Task, sweep

sys.path.insert(0, str(Path(__file__).parent))
from sweep_tasks import refuse_odd, square, square_and_die_once

TASKS = [Task(f"x{x}", {"x": x}) for x in range(6)]


def test_results_are_files_and_come_in_the_order_of_the_tasks(tmp_path):
    outcome = sweep(square, TASKS, tmp_path)
    assert [r["y"] for r in outcome.results.values()] == [0, 1, 4, 9, 16, 25]
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"x{x}.json" for x in range(6)]
    assert json.loads((tmp_path / "x3.json").read_text())["result"] == {"y": 9}


def test_an_interrupted_sweep_resumes(tmp_path):
    log = tmp_path / "log"
    tasks = [Task(f"x{x}", {"x": x, "log": str(log)}) for x in range(6)]

    def stop(name):
        if name == "x2":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep(square, tasks, tmp_path / "out", report=stop)
    outcome = sweep(square, tasks, tmp_path / "out")
    assert outcome.resumed == 3
    assert len(outcome.results) == 6
    assert log.read_text().split() == list("012345")  # nothing was run twice


def test_other_arguments_or_a_broken_file_are_run_again(tmp_path):
    sweep(square, TASKS, tmp_path)
    (tmp_path / "x1.json").write_text('{"task": "x1", "argu')
    (tmp_path / "x2.json").write_text("[1, 2]")
    changed = [Task("x0", {"x": 10}), *TASKS[1:]]
    outcome = sweep(square, changed, tmp_path)
    assert outcome.resumed == 3
    assert outcome.results["x0"] == {"y": 100}
    assert outcome.results["x1"] == {"y": 1}


def test_a_task_that_fails_does_not_stop_the_others(tmp_path):
    outcome = sweep(refuse_odd, TASKS, tmp_path)
    assert list(outcome.results) == ["x0", "x2", "x4"]
    assert outcome.failed == {"x1": "1 is odd", "x3": "3 is odd", "x5": "5 is odd"}
    assert not (tmp_path / "x1.json").exists()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p: sweep(square, [Task("a"), Task("a")], p), "two tasks are called 'a'"),
        (lambda p: Task("../a"), "a task's name must be"),
        (lambda p: Task("a", {"x": object()}), "JSON"),
        (lambda p: sweep(square, TASKS, p, workers=2, scheduler="tcp://127.0.0.1:1"), "either"),
        (lambda p: sweep(square, TASKS, p, workers=-1), "0 or more"),
    ],
)
def test_bad_input_is_refused(call, message, tmp_path):
    with pytest.raises(InputError, match=message):
        call(tmp_path)


def test_missing_package_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'echospline\[distributed\]'"):
        sweep(square, TASKS, tmp_path, workers=2)


def test_a_scheduler_that_is_not_there_is_named(tmp_path):
    pytest.importorskip("distributed", reason="needs the extra 'distributed'")
    with pytest.raises(InputError, match=r"no dask scheduler answers at tcp://127.0.0.1:1"):
        sweep(square, TASKS, tmp_path, scheduler="tcp://127.0.0.1:1")


@pytest.fixture(scope="module")
def scheduler():
    """A scheduler and two workers as an operator would start them, each a process of its own, on loopback."""
    pytest.importorskip("distributed", reason="needs the extra 'distributed'")
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent)}
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True, "env": environment}
    processes = [subprocess.Popen([*command, "--no-dashboard", "--no-show"], **quiet)]
    try:
        address = ""
        for line in processes[0].stderr:
            if "Scheduler at:" in line:
                address = line.split()[-1]
                break
        assert address.startswith("tcp://127.0.0.1:")
        worker = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--host", "127.0.0.1"]
        more = ["--nworkers", "2", "--nthreads", "1", "--no-dashboard", "--memory-limit", "0"]
        processes.append(subprocess.Popen([*worker, *more], **(quiet | {"stderr": subprocess.DEVNULL})))
        yield address
    finally:
        for process in reversed(processes):
            process.terminate()
        for process in reversed(processes):
            process.wait(20)


def test_a_worker_killed_half_way_loses_nothing(tmp_path, scheduler):
    grave = tmp_path / "grave"
    tasks = [Task(f"x{x}", {"x": x, "grave": str(grave)}) for x in range(8)]
    outcome = sweep(square_and_die_once, tasks, tmp_path / "out", scheduler=scheduler)
    assert grave.exists()  # a worker did die
    assert outcome.failed == {}
    assert [r["y"] for r in outcome.results.values()] == [x * x for x in range(8)]
    assert str(outcome.results["x3"]["pid"]) != grave.read_text()
    assert len(list((tmp_path / "out").glob("*.json"))) == 8


def test_workers_on_this_machine_give_the_same_results(tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="needs the extra 'distributed'")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    outcome = sweep(refuse_odd, TASKS, tmp_path, workers=2)
    assert list(outcome.results) == ["x0", "x2", "x4"]
    assert outcome.failed["x1"] == "InputError: 1 is odd"
