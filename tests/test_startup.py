"""What is loaded when: counted in modules, never in milliseconds."""

from __future__ import annotations

import ast
import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest
import typer

import echospline
from echospline.cli.app import COMMANDS, loaded
from echospline.cli.options import OPTIONS
from echospline.scenario import Scenario, describe

HEAVY = {
    "SimpleITK", "av", "cv2", "distributed", "kvxopt", "matplotlib", "pydicom", "scipy", "skfem", "starlette",
    "tomlkit", "uvicorn", "websockets", "zarr",
}  # fmt: skip
"""Libraries that take long to load or much memory."""
PACKAGE = Path(echospline.__file__).parent
ROOMS = [path.parent.name for path in sorted(PACKAGE.glob("*/__init__.py"))]


def modules_after(code: str, folder: Path | None = None) -> set[str]:
    """Run code in a new interpreter and return the names of the packages it has loaded."""
    tail = "import json, sys; print(); print(json.dumps(sorted({m.partition('.')[0] for m in sys.modules})))"
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\n{tail}"], capture_output=True, text=True, check=True, cwd=folder
    )
    return set(json.loads(done.stdout.splitlines()[-1]))


def modules_of(*words: str, folder: Path | None = None) -> set[str]:
    """Run a command and return the names of the packages it has loaded."""
    return modules_after(
        f"import sys; sys.argv[1:] = {list(words)!r}\n"
        "from echospline.cli import main\n"
        "try: main()\nexcept SystemExit: pass",
        folder,
    )


def test_importing_the_package_loads_nothing_else():
    found = modules_after("import echospline")
    assert not found & {*HEAVY, "numpy", "pydantic", "PIL", "rich", "typer"}


def test_the_general_help_and_the_version_load_no_numbers():
    for word in ("--help", "--version"):
        assert not modules_of(word) & {*HEAVY, "numpy", "PIL"}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_mistyped_option_loads_nothing_heavy(command):
    assert not modules_of(command, "--mistyped") & HEAVY


@pytest.mark.parametrize(
    "words",
    [
        ["simulat"],
        ["simulate"],
        ["simulate", "missing.png"],
        ["simulate", "missing.toml"],
        ["simulate", "sample:calf", "--angle", "steep"],
        ["simulate", "sample:calf", "--angle", "1000"],
        ["simulate", "sample:calf", "--mesh", "40"],
        ["info", "missing.png"],
        ["track", "missing.mp4"],
        ["live", "missing.png", "--no-browser"],
        ["live", "--port", "99999"],
        ["page", "missing.png"],
        ["page", "missing.toml", "--out", "trainer.html"],
        ["link", "missing.png"],
        ["identify", "missing"],
        ["phantom", "missing.toml"],
        ["recorded", "missing.igs.mha"],
        ["dataset", "missing.toml"],
        ["study", "exvivo", "missing.npz"],
        ["sessions", "list", "--sessions", "missing.sqlite"],
        ["sessions", "import", "missing.json"],
        ["simulate", "--help"],
        ["live", "--help"],
    ],
    ids=" ".join,
)
def test_a_mistake_loads_nothing_heavy(words, tmp_path):
    assert not modules_of(*words, folder=tmp_path) & HEAVY


def test_a_picture_is_described_without_anything_heavy(tmp_path):
    assert not modules_of("info", "sample:calf") & HEAVY
    assert not modules_of("info", str(PACKAGE / "data" / "calf.png")) & HEAVY


def test_no_thread_starts_and_nothing_is_written_at_import(tmp_path):
    code = "import threading, echospline; [getattr(echospline, n) for n in echospline.__all__]; assert threading.active_count() == 1"
    modules_after(code, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("room", ["", *ROOMS])
def test_every_name_of_a_menu_can_be_had(room):
    module = importlib.import_module(f"echospline.{room}" if room else "echospline")
    for name in getattr(module, "__all__", []):
        assert getattr(module, name) is not None
        assert name in dir(module)
    with pytest.raises(AttributeError, match="no attribute 'misspelt'"):
        module.misspelt  # noqa: B018


def test_a_function_named_as_its_file_stays_the_function_whatever_is_imported_first():
    for order in (
        "import echospline.study.identify, echospline.picture.simulate, echospline.laboratory.rescatter",
        "from echospline.study import identify; import echospline.study.identify; from echospline.picture import simulate",
    ):
        code = (
            f"{order}\n"
            "from echospline.study import identify\n"
            "from echospline.picture import simulate\n"
            "from echospline.laboratory import rescatter\n"
            "assert callable(identify) and callable(simulate) and callable(rescatter)"
        )
        modules_after(code)


def test_every_menu_lists_what_it_imports():
    for room in ROOMS:
        text = (PACKAGE / room / "__init__.py").read_text(encoding="utf-8")
        named = {
            alias.asname or alias.name
            for line in ast.walk(ast.parse(text))
            if isinstance(line, ast.ImportFrom) and str(line.module).startswith(f"echospline.{room}.")
            for alias in line.names
        }
        assert named == set(getattr(importlib.import_module(f"echospline.{room}"), "__all__", named)), room


@pytest.mark.parametrize("name", COMMANDS)
def test_the_list_of_commands_says_what_the_command_says_itself(name):
    command = loaded(name)
    assert " ".join(command.help.split()).startswith(COMMANDS[name])
    assert command.name == name


def test_every_default_is_printed_as_it_is_typed():
    for option in OPTIONS:
        printed = describe(option.key).rpartition("default ")[2]
        if option.read is None or "default " not in describe(option.key) or printed == "none":
            continue
        value = Scenario.model_validate({"space": {}})
        for name in option.key.split("."):
            value = getattr(value, name)
        typed = option.read(printed)
        assert (tuple(typed) if isinstance(value, tuple) else typed) == value, option.flag


def test_the_version_is_printed():
    done = subprocess.run(
        [sys.executable, "-m", "echospline", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout.split()[0] == "echospline"
    assert done.stdout.split()[1][0].isdigit()


@pytest.mark.parametrize("words", [["--help"], ["simulate", "--help"], ["info", "sample:calf", "--json"]])
def test_a_reader_that_closes_the_pipe_early_ends_the_command_with_0_and_no_word(words):
    running = subprocess.Popen(
        [sys.executable, "-m", "echospline", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    running.stdout.close()  # as head does, before anything is written
    said = running.stderr.read()
    running.stderr.close()
    assert (running.wait(), said) == (0, b"")


def test_mistakes_of_the_command_line_are_one_sentence_with_2():
    done = subprocess.run(
        [sys.executable, "-m", "echospline", "simulate", "--angl", "3"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("echospline: No such option: --angl")
    assert len(done.stderr.splitlines()) == 1
    assert typer.BadParameter.__base__.__name__ == "UsageError"
