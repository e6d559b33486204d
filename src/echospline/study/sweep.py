"""A sweep: many independent tasks, in this process, on several or on a cluster; every result is written at once.

One task, one file: a result is written whole under its final name as soon as the task ends, so an interrupted sweep
resumes where it stopped, and after the death of a worker only its current task runs again.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from echospline.atomic import appearing, writing
from echospline.errors import EchosplineError, InputError, MissingExtraError

Result = dict[str, Any]
Function = Callable[..., Result]
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,120}")


@dataclass(frozen=True)
class Task:
    """One unit of work: a name, which becomes that of its file, and keyword arguments that JSON can hold.

    Raises
    ------
    InputError
        If the name is not one for a file or the arguments are not JSON.
    """

    name: str
    arguments: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise InputError(
                f"a task's name must be letters, digits, dots, dashes or underscores; got {self.name!r}"
            )
        try:
            object.__setattr__(self, "arguments", json.loads(json.dumps(dict(self.arguments))))
        except (TypeError, ValueError) as error:
            raise InputError(f"arguments of the task {self.name} must be JSON values: {error}") from error


@dataclass(frozen=True)
class Outcome:
    """Results of a sweep.

    Attributes
    ----------
    results : dict
        Result of each task by name, in the order of the tasks; failed ones are missing.
    failed : dict
        Error messages by name.
    resumed : int
        Number of results that were on disk before.
    """

    results: dict[str, Result]
    failed: dict[str, str]
    resumed: int


def sweep(
    function: Function,
    tasks: Sequence[Task],
    out: Path,
    *,
    workers: int = 0,
    scheduler: str | None = None,
    report: Callable[[str], None] | None = None,
) -> Outcome:
    """Run a function over tasks and keep every result as ``out/NAME.json``.

    Parameters
    ----------
    function : callable
        Importable (defined in a module); takes a task's arguments by keyword, returns values for JSON.
    tasks : sequence of Task
        With distinct names. A task whose file holds a result for the same arguments is not run again.
    out : Path
        Folder of the results.
    workers : int
        Worker processes on this machine; 0 runs in this process.
    scheduler : str, optional
        Address of a running dask scheduler, ``tcp://host:8786``; its workers must see the same files and have
        echospline installed.
    report : callable, optional
        Called with the name of each task that ends.

    Raises
    ------
    InputError
        If two tasks share a name, or workers and scheduler are both given.
    MissingExtraError
        If dask.distributed is needed and not installed.
    """
    names = [task.name for task in tasks]
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"two tasks are called {twice!r}; every task needs a name of its own")
    if workers < 0 or (workers and scheduler is not None):
        raise InputError(
            f"give either a number of workers (0 or more) or a scheduler; got {workers} and {scheduler}"
        )
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    known = {task.name: found for task in tasks if (found := _on_disk(task, out)) is not None}
    resumed, failed = len(known), dict[str, str]()
    open_tasks = [task for task in tasks if task.name not in known]
    if open_tasks:
        here = not workers and scheduler is None
        ended = (
            _in_process(function, open_tasks)
            if here
            else _distributed(function, open_tasks, workers, scheduler)
        )
        for task, result, fault in ended:
            if fault is not None:
                failed[task.name] = fault
            else:
                known[task.name] = _keep(task, result, out)
            if report is not None:
                report(task.name)
    return Outcome({name: known[name] for name in names if name in known}, failed, resumed)


Ended = Iterator[tuple[Task, Result, str | None]]


def _in_process(function: Function, tasks: Sequence[Task]) -> Ended:
    for task in tasks:
        try:
            yield task, function(**task.arguments), None
        except EchosplineError as error:
            yield task, {}, str(error)


def _distributed(function: Function, tasks: Sequence[Task], workers: int, scheduler: str | None) -> Ended:
    try:
        distributed: Any = import_module("distributed")
    except ImportError as missing:
        raise MissingExtraError("distributed", "distributed", "a sweep over several processes") from missing
    with _client(distributed, workers, scheduler) as client, client.as_current():
        # Names are keys: dask runs a task again elsewhere when the worker that held it dies.
        futures = {
            client.submit(function, **t.arguments, key=f"{t.name}-{id(tasks)}", pure=False): t for t in tasks
        }
        for future in distributed.as_completed(list(futures)):
            task = futures.pop(future)
            if future.status == "finished":
                yield task, future.result(), None
            else:
                error = future.exception()
                yield task, {}, f"{type(error).__name__}: {error}"
            future.release()


@contextmanager
def _client(distributed: Any, workers: int, scheduler: str | None) -> Iterator[Any]:
    if scheduler is not None:
        try:
            client = distributed.Client(scheduler, timeout="5s", set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(f"no dask scheduler answers at {scheduler}: {error}") from error
        with client:
            yield client
        return
    options = {
        "threads_per_worker": 1,
        "host": "127.0.0.1",
        "dashboard_address": "127.0.0.1:0",
        "silence_logs": 50,
    }
    with (
        distributed.LocalCluster(n_workers=workers, processes=True, **options) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client


def _keep(task: Task, result: Result, out: Path) -> Result:
    path = out / f"{task.name}.json"
    whole = {"task": task.name, "arguments": task.arguments, "result": result}
    with appearing(path) as part:
        part.write_text(json.dumps(whole, indent=1, allow_nan=False), encoding="utf-8")
    kept: Result = json.loads(json.dumps(result))
    return kept


def _on_disk(task: Task, out: Path) -> Result | None:
    """Return the result of an earlier run with the same arguments; None for any other file."""
    path = out / f"{task.name}.json"
    try:
        whole = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if (
        not isinstance(whole, dict)
        or whole.get("arguments") != task.arguments
        or whole.get("task") != task.name
    ):
        return None
    result = whole.get("result")
    return result if isinstance(result, dict) else None
