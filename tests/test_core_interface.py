"""The core's C interface and everything that mirrors it: header, library, binding, JavaScript, C#, versions."""

from __future__ import annotations

import ctypes
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tomllib
import zlib
from pathlib import Path
from types import ModuleType

import pytest

from echospline import _native
from echospline._native import green, space
from node_here import NODE, STEADY

ROOT = Path(__file__).resolve().parent.parent
CORE = ROOT / "core"
sys.path.insert(0, str(CORE))
import build  # noqa: E402


def plain(*headers: str) -> str:
    """Headers of the C interface without comments."""
    texts = [(CORE / "include" / "echospline" / name).read_text(encoding="utf-8") for name in headers]
    return "".join(re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL) for text in texts)


HEADER = (CORE / "include" / "echospline" / "echospline.h").read_text(encoding="utf-8")
PLAIN = plain("echospline.h")
BINDINGS = {"echospline.h": _native, "green.h": green, "space.h": space}
ALL = plain("echospline.h", "green.h", "space.h")  # what JavaScript has
WASM = ROOT / "src" / "echospline" / "_native" / "echospline.wasm"
JAVASCRIPT = WASM.with_suffix(".js").read_text(encoding="utf-8")
CC = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")

needs_compiler = pytest.mark.skipif(CC is None, reason="no C compiler here: nothing compiles the header")
needs_elf = pytest.mark.skipif(
    not sys.platform.startswith("linux") or not shutil.which("nm") or not shutil.which("readelf"),
    reason="nm and readelf of a Linux system are not here: the library's symbols are not read",
)


def declared(text: str = PLAIN) -> dict[str, int]:
    """Functions of the header with their number of arguments."""
    found = re.findall(r"ECHOSPLINE_API\s+[\w\s*]*?\b(echospline_\w+)\(([^)]*)\)", text)
    return {name: 0 if arguments.strip() == "void" else arguments.count(",") + 1 for name, arguments in found}


def header_enums(text: str = PLAIN) -> dict[str, int]:
    return {name: int(value) for name, value in re.findall(r"\bECHOSPLINE_([A-Z0-9_]+) = (\d+)", text)}


def header_structs(text: str = PLAIN) -> dict[str, list[str]]:
    """Structs of the header with the names of their members."""
    structs = {}
    for name, body in re.findall(r"typedef struct (echospline_\w+) \{(.*?)\} \1;", text, flags=re.DOTALL):
        members = re.sub(r"\[\d+\]", "", body)
        lines = [line.strip() for line in members.split(";") if line.strip()]
        structs[name] = [
            word
            for line in lines
            for word in re.sub(r"^(const )?\w+", "", line.replace("*", " ")).replace(",", " ").split()
        ]
    return structs


def binding_structs(binding: ModuleType) -> dict[str, type[ctypes.Structure]]:
    mirrors = (value for value in vars(binding).values() if isinstance(value, type))
    return {
        str(mirror.__doc__).rstrip("."): mirror for mirror in mirrors if issubclass(mirror, ctypes.Structure)
    }


def layout_program(header: str) -> str:
    """C that prints {struct: {size, offsets}} as JSON."""
    lines = []
    for name, members in header_structs(plain(header)).items():
        lines.append(
            f'printf("%s\\"{name}\\": {{\\"size\\": %zu, \\"offsets\\": {{", comma, sizeof({name}));'
        )
        lines += [
            f'printf("{", " if k else ""}\\"{member}\\": %zu", offsetof({name}, {member}));'
            for k, member in enumerate(members)
        ]
        lines.append('printf("}}"); comma = ", ";')
    body = "\n  ".join(lines)
    return (
        f'#include "echospline/{header}"\n#include <stddef.h>\n#include <stdio.h>\n'
        f'int main(void) {{\n  const char* comma = "";\n  printf("{{");\n  {body}\n  printf("}}");\n  return 0;\n}}\n'
    )


@pytest.mark.parametrize("header", BINDINGS)
def test_the_binding_declares_every_function_of_the_header(header):
    functions = BINDINGS[header].FUNCTIONS
    assert {name: len(arguments) for name, (_, arguments) in functions.items()} == declared(plain(header))


@pytest.mark.parametrize("header", BINDINGS)
def test_the_binding_has_every_enum_value_of_the_header(header):
    binding = BINDINGS[header]
    enums = [value for value in vars(binding).values() if isinstance(value, type) and issubclass(value, int)]
    values = {
        member.name: int(member) for enum in enums for member in enum if enum.__module__ == binding.__name__
    }
    assert values == header_enums(plain(header))


@needs_compiler
@pytest.mark.parametrize("header", BINDINGS)
def test_the_bindings_structs_are_laid_out_as_the_compiler_lays_them_out(header, tmp_path):
    source, program = tmp_path / "layout.c", tmp_path / "layout"
    source.write_text(layout_program(header))
    subprocess.run([CC, "-I", CORE / "include", source, "-o", program], check=True)
    layouts = json.loads(subprocess.run([program], capture_output=True, check=True).stdout)
    mirrors = binding_structs(BINDINGS[header])
    assert set(layouts) == set(mirrors)
    for name, mirror in mirrors.items():
        offsets = {field[0]: getattr(mirror, field[0]).offset for field in mirror._fields_}
        assert {"size": ctypes.sizeof(mirror), "offsets": offsets} == layouts[name]


def test_header_function_package_and_faces_have_one_version():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    header = ".".join(re.findall(r"ECHOSPLINE_VERSION_(?:MAJOR|MINOR|PATCH) (\d+)", HEADER))
    number = _native.library().echospline_version()
    function = f"{number >> 16}.{number >> 8 & 255}.{number & 255}"
    binding = ".".join(map(str, _native.VERSION))
    javascript = re.search(r'VERSION = "([^"]+)"', JAVASCRIPT)
    assert javascript is not None
    assert {header, function, binding, javascript[1]} == {project}


def test_a_library_that_is_not_there_is_named(tmp_path):
    with pytest.raises(_native.CoreError, match=r"expected the core's library at .*; run: pip install \."):
        _native.load(tmp_path / _native.FILE)


def test_a_library_that_cannot_be_loaded_is_named(tmp_path):
    path = tmp_path / _native.FILE
    path.write_bytes(b"no library")
    with pytest.raises(_native.CoreError, match=r"cannot be loaded: .*; run: pip install \."):
        _native.load(path)


@needs_compiler
def test_a_library_of_another_version_is_refused(tmp_path):
    source, path = tmp_path / "old.c", tmp_path / _native.FILE
    source.write_text("unsigned echospline_version(void) { return 9 << 16 | 8 << 8 | 7; }")
    subprocess.run([CC, "-shared", "-fPIC", source, "-o", path], check=True)
    with pytest.raises(_native.CoreError, match=r"expected version .*; got 9\.8\.7; run: pip install \."):
        _native.load(path)


def test_nothing_is_loaded_at_import():
    code = "import echospline._native as n; raise SystemExit(n.library.cache_info().currsize)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    ("status", "error"),
    [
        (_native.Status.WRONG_VALUE, "InputError"),
        (_native.Status.WRONG_STATE, "InputError"),
        (_native.Status.NOT_SOLVED, "SolverError"),
        (_native.Status.NOT_HELD, "SolverError"),
        (_native.Status.OUT_OF_MEMORY, "MemoryError"),
    ],
)
def test_a_status_becomes_the_packages_error(status, error):
    with pytest.raises(Exception, match="what came") as caught:
        _native.check(status, lambda handle: b"what came", None)
    assert type(caught.value).__name__ == error


def test_the_level_is_what_the_processor_has():
    if platform.machine() not in ("x86_64", "AMD64") or not Path("/proc/cpuinfo").exists():
        pytest.skip("this processor's features are not listed in /proc/cpuinfo")
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    flags = set(next(line for line in lines if line.startswith("flags")).split())
    avx512 = {"avx2", "fma", "bmi2", "avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"} <= flags
    avx2 = {"avx2", "fma", "bmi1", "bmi2", "f16c", "movbe"} <= flags
    expected = "LEVEL_AVX512" if avx512 else "LEVEL_AVX2" if avx2 else "LEVEL_BASELINE"
    assert _native.Level(_native.library().echospline_level_best()).name == expected


@needs_elf
def test_only_the_interface_is_exported():
    path = Path(_native.__file__).parent / _native.FILE
    lines = subprocess.run(["nm", "-D", "--defined-only", path], capture_output=True, text=True, check=True)
    assert {line.split()[-1] for line in lines.stdout.splitlines()} == set(declared(ALL))


@needs_elf
def test_only_libc_and_libm_are_needed():
    path = Path(_native.__file__).parent / _native.FILE
    text = subprocess.run(["readelf", "-d", path], capture_output=True, text=True, check=True).stdout
    needed = re.findall(r"\(NEEDED\).*\[([^\]]+)\]", text)
    assert all(re.match(r"(libc|libm|ld-linux[^.]*|libc\.musl[^.]*)\.", name) for name in needed), needed


@needs_elf
def test_no_level_leaves_a_symbol_that_another_might_take():
    compiler, target = build.system_compiler(), build.this_machine()
    if compiler is None:
        pytest.skip("no system compiler here: the levels' objects are not read")
    for path in build.objects(compiler, target):
        if not path.stem.startswith("level_"):
            continue
        text = subprocess.run(["nm", "-C", path], capture_output=True, text=True, check=True).stdout
        weak = [line for line in text.splitlines() if re.match(r"^[0-9a-f]*\s+[WVu] ", line)]
        shared = [line for line in weak if f"::core_{path.stem.removeprefix('level_')}::" not in line]
        assert not shared, path.stem


@pytest.mark.skipif(not WASM.exists(), reason="echospline.wasm is not built; run make wasm")
def test_webassembly_is_small_and_needs_nothing():
    build.check_wasm(WASM)
    # as a page packs it: both precisions, Green's function and scenes in space included; in base64 a third of a page's megabyte
    assert len(zlib.compress(WASM.read_bytes(), 9)) < 240_000
    names = set(re.findall(rb"echospline_\w+", WASM.read_bytes()))
    assert {name.encode() for name in declared(ALL)} <= names


def test_javascript_calls_functions_of_the_header_alone():
    names = set(re.findall(r"\b(echospline_\w+)\(", JAVASCRIPT)) - set(header_structs(ALL))
    assert names <= set(declared(ALL))
    called_by_name = {
        f"echospline_{what}_{verb}"
        for what in ("scene", "tissue", "picture", "forced", "volume", "green", "spatial")
        for verb in ("create", "message")
    }
    called_by_name |= {"echospline_scene_destroy", "echospline_tissue_destroy"}
    not_needed = {
        "echospline_level_available",
        "echospline_picture_deform",
        "echospline_picture_deform_single",
    }
    assert set(declared(ALL)) - names - called_by_name - not_needed == set()


@pytest.mark.skipif(NODE is None or build.zig() is None, reason="Node or ziglang is not installed")
def test_javascripts_structs_are_laid_out_as_the_compiler_lays_them_out(tmp_path):
    numbers = [
        f"sizeof({name})" if member is None else f"offsetof({name}, {member})"
        for name, members in header_structs(ALL).items()
        for member in (None, *members)
    ]
    source, module, layouts = tmp_path / "layout.c", tmp_path / "layout.wasm", tmp_path / "layouts.json"
    source.write_text(
        '#include "echospline/green.h"\n#include "echospline/space.h"\n#include <stddef.h>\n'
        f"const int numbers[] = {{{', '.join(numbers)}}};\nint number(int i) {{ return numbers[i]; }}\n"
    )
    command = [
        sys.executable,
        "-m",
        "ziglang",
        "cc",
        "-target",
        "wasm32-freestanding",
        "-nostdlib",
        "-Wl,--no-entry",
    ]
    command += ["-Wl,--export=number", "-O1", "-I", str(CORE / "include"), str(source), "-o", str(module)]
    subprocess.run(command, check=True)
    code = (
        f"const m = await WebAssembly.instantiate((await import('node:fs')).readFileSync({json.dumps(str(module))}));"
        f"console.log(JSON.stringify(Array.from({{length: {len(numbers)}}}, (_, i) => m.instance.exports.number(i))))"
    )
    run = subprocess.run(
        [NODE, STEADY, "--input-type=module", "-e", code], capture_output=True, text=True, check=True
    )
    values = iter(json.loads(run.stdout))
    result = {
        name: {"size": next(values), "offsets": {member: next(values) for member in members}}
        for name, members in header_structs(ALL).items()
    }
    layouts.write_text(json.dumps(result))
    done = subprocess.run(
        [
            NODE,
            STEADY,
            "--test",
            "--test-reporter=tap",
            "--test-name-pattern=laid out",
            "tests/js/core.test.js",
        ],
        cwd=ROOT,
        env={**os.environ, "ECHOSPLINE_WASM_LAYOUTS": str(layouts)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout


def test_javascript_has_every_enum_value_of_the_header():
    blocks = re.findall(r"Object\.freeze\(\{([^{}\[\]]*)\}\)", JAVASCRIPT)
    values = {name: int(value) for block in blocks for name, value in re.findall(r"(\w+): (\d+)", block)}
    assert values == header_enums(ALL)
