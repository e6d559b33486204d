"""Programs that embed the core: in C by CMake, by pkg-config and statically; in C# as Unity does."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from echospline import _native
from test_core_interface import declared, header_enums, plain

ROOT = Path(__file__).resolve().parent.parent
CORE = ROOT / "core"
LIBRARIES = Path(_native.__file__).parent
UNITY = CORE / "hosts" / "unity"
MIRRORED = plain("echospline.h", "green.h")  # by the Unity binding
CC = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
SEARCH = "DYLD_LIBRARY_PATH" if sys.platform == "darwin" else "LD_LIBRARY_PATH"

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="the hosts are built by POSIX tools here")


def output(*command: object, libraries: Path | None = None) -> str:
    environment = {**os.environ, SEARCH: str(libraries)} if libraries else None
    run = subprocess.run(
        [str(part) for part in command],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        env=environment,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    return run.stdout


def check_loop(text: str, steps: int) -> None:
    """The C host's report of a loop."""
    assert f"steps {steps}," in text
    assert "allocations in the loop 0" in text
    quantiles = [float(x) for x in re.findall(r"(?:p50|p99|p99\.9|max) ([0-9.]+)", text)]
    assert quantiles == sorted(quantiles)
    assert len(quantiles) == 4
    displacement = float(text.splitlines()[2].split()[3])
    assert 0.1 < displacement < 10


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Prefix with the core, installed by CMake."""
    missing = [tool for tool in ("cmake", "make", "c++") if shutil.which(tool) is None]
    if missing:
        pytest.skip(f"the CMake package is not tested: {', '.join(missing)} is missing")
    build, prefix = tmp_path_factory.mktemp("build"), tmp_path_factory.mktemp("prefix")
    options = [f"-DCMAKE_INSTALL_PREFIX={prefix}", "-DCMAKE_INSTALL_LIBDIR=lib"]
    options += ["-DCMAKE_BUILD_TYPE=Debug", "-DCMAKE_CXX_FLAGS_DEBUG=-O0"]  # compiled in a third of the time
    output("cmake", "-S", CORE, "-B", build, *options)
    output("cmake", "--build", build, "--parallel", 2)
    output("cmake", "--install", build)
    return prefix


def test_a_cmake_project_finds_and_runs_the_core(installed, tmp_path):
    output("cmake", "-S", CORE / "hosts" / "c", "-B", tmp_path, f"-DCMAKE_PREFIX_PATH={installed}")
    output("cmake", "--build", tmp_path)
    for program in ("host", "host_static"):
        check_loop(output(tmp_path / program, 0.5), 500)


@pytest.mark.skipif(shutil.which("pkg-config") is None, reason="pkg-config is not here")
def test_pkg_config_finds_the_core(installed, tmp_path, monkeypatch):
    monkeypatch.setenv("PKG_CONFIG_PATH", str(installed / "lib" / "pkgconfig"))
    flags = output("pkg-config", "--cflags", "--libs", "echospline").split()
    output(CC, "-std=c17", CORE / "hosts" / "c" / "main.c", *flags, "-lm", "-o", tmp_path / "host")
    check_loop(output(tmp_path / "host", 0.5, libraries=installed / "lib"), 500)


@pytest.mark.skipif(CC is None, reason="no C compiler here: the C host is not built")
def test_the_c_host_runs_on_the_packages_library(tmp_path):
    strict = ["-std=c17", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    include, library = ["-I", CORE / "include"], LIBRARIES / _native.FILE
    output(CC, *strict, *include, CORE / "hosts" / "c" / "main.c", library, "-lm", "-o", tmp_path / "host")
    check_loop(output(tmp_path / "host", 1, 500, 60, 45, libraries=LIBRARIES), 500)


def test_the_c_host_explains_wrong_arguments(tmp_path):
    if CC is None:
        pytest.skip("no C compiler here: the C host is not built")
    library = LIBRARIES / _native.FILE
    output(
        CC, "-I", CORE / "include", CORE / "hosts" / "c" / "main.c", library, "-lm", "-o", tmp_path / "host"
    )
    environment = {**os.environ, SEARCH: str(LIBRARIES)}
    run = subprocess.run(
        [tmp_path / "host", "0"], capture_output=True, text=True, check=False, env=environment
    )
    assert run.returncode == 2
    assert run.stderr.startswith("usage: host")


def test_the_unity_binding_declares_every_function_of_the_header():
    source = (UNITY / "Echospline.cs").read_text(encoding="utf-8")
    found = re.findall(r"static extern \w+ (echospline_\w+)\(([^)]*)\)", source)
    assert {name: arguments.count(",") + 1 if arguments else 0 for name, arguments in found} == declared(
        MIRRORED
    )


def test_the_unity_binding_has_every_enum_value_of_the_header():
    source = (UNITY / "Echospline.cs").read_text(encoding="utf-8")
    blocks = re.findall(r"public enum \w+(?: : uint)?\s*\{([^}]*)\}", source)
    values = {
        name.upper(): int(value) for block in blocks for name, value in re.findall(r"(\w+) = (\d+)", block)
    }
    assert values == {name.replace("_", ""): value for name, value in header_enums(MIRRORED).items()}


def test_the_unity_binding_has_the_headers_version():
    source = (UNITY / "Echospline.cs").read_text(encoding="utf-8")
    parts = re.search(r"Version = (\d+) << 16 \| (\d+) << 8 \| (\d+)", source)
    assert parts is not None
    assert tuple(map(int, parts.groups())) == _native.VERSION


@pytest.mark.skipif(
    not shutil.which("mcs") or not shutil.which("mono"),
    reason="mcs and mono are not here: the C# binding is not run; run tests/install-system as root",
)
def test_the_unity_binding_runs(tmp_path):
    program = tmp_path / "driver.exe"
    output("mcs", "-warnaserror+", f"-out:{program}", UNITY / "Driver.cs", UNITY / "Echospline.cs")
    text = output("mono", program, libraries=LIBRARIES)
    assert re.match(r"level .+, 1200 nodes, tip \(", text)
