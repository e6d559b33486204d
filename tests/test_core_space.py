"""The C interface for scenes in space and its binding: functions, values and layouts are the header's."""

from __future__ import annotations

import ctypes
import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from echospline._native import Status, space

CORE = Path(__file__).resolve().parent.parent / "core"
PLAIN = re.sub(r"/\*.*?\*/", "", (CORE / "include" / "echospline" / "space.h").read_text(), flags=re.DOTALL)
CC = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
STRUCTS = {
    "echospline_volume_options": space.VolumeOptions,
    "echospline_slice": space.Slice,
    "echospline_force_field": space.ForceField,
    "echospline_trace_report": space.TraceReport,
}


def test_the_binding_declares_every_function_of_the_header():
    found = re.findall(r"ECHOSPLINE_API\s+[\w\s*]*?\b(echospline_\w+)\(([^)]*)\)", PLAIN)
    expected = {name: arguments.count(",") + 1 for name, arguments in found}
    assert {name: len(arguments) for name, (_, arguments) in space.FUNCTIONS.items()} == expected
    assert len(expected) >= 7


def test_the_binding_has_every_value_of_the_header():
    values = {name: int(value) for name, value in re.findall(r"\bECHOSPLINE_([A-Z0-9_]+) = (\d+)", PLAIN)}
    assert {member.name: int(member) for member in space.SpaceTop} == values


@pytest.mark.skipif(CC is None, reason="no C compiler here: nothing compiles the header")
def test_structs_are_laid_out_as_the_compiler_lays_them_out(tmp_path):
    lines = []
    for name, mirror in STRUCTS.items():
        lines.append(f'printf("\\"{name}\\": [%zu", sizeof({name}));')
        lines += [f'printf(", %zu", offsetof({name}, {field[0]}));' for field in mirror._fields_]
        lines.append('printf("],");')
    source, program = tmp_path / "layout.c", tmp_path / "layout"
    body = "\n  ".join(lines)
    source.write_text(
        '#include "echospline/space.h"\n#include <stddef.h>\n#include <stdio.h>\n'
        f'int main(void) {{\n  printf("{{");\n  {body}\n  printf("\\"end\\": 0}}");\n  return 0;\n}}\n'
    )
    subprocess.run([CC, "-Wall", "-Werror", "-I", CORE / "include", source, "-o", program], check=True)
    layouts = json.loads(subprocess.run([program], capture_output=True, check=True).stdout)
    for name, mirror in STRUCTS.items():
        offsets = [getattr(mirror, field[0]).offset for field in mirror._fields_]
        assert layouts[name] == [ctypes.sizeof(mirror), *offsets]


def test_misuse_ends_in_a_status():
    library = space.library()
    handle, options = ctypes.c_void_p(), space.VolumeOptions(struct_size=ctypes.sizeof(space.VolumeOptions))
    voxels = (ctypes.c_uint8 * 8)()
    assert library.echospline_volume_create(None, None, ctypes.byref(handle)) == Status.NULL_POINTER
    assert (
        library.echospline_volume_create(ctypes.byref(options), voxels, ctypes.byref(handle))
        == Status.WRONG_SIZE
    )
    assert b"shape of a volume" in library.echospline_volume_message(handle)
    cut = space.Slice(struct_size=ctypes.sizeof(space.Slice), columns=2, rows=2, step=1)
    out = (ctypes.c_uint8 * 4)()
    lattice = (ctypes.c_double * 12)()
    assert (
        library.echospline_volume_slice(handle, ctypes.byref(cut), lattice, 12, out, 4, None)
        == Status.FAILED_HANDLE
    )
    library.echospline_volume_destroy(handle)
    library.echospline_volume_destroy(None)
    options.shape[:], options.spacing[:] = (2, 2, 2), (1.0, 1.0, 1.0)
    assert library.echospline_volume_create(ctypes.byref(options), voxels, ctypes.byref(handle)) == Status.OK
    for change in ({"struct_size": 3}, {"columns": 0}, {"step": 0}, {"background": 300}, {"columns": 5}):
        wrong = space.Slice(struct_size=ctypes.sizeof(space.Slice), columns=2, rows=2, step=1)
        for name, value in change.items():
            setattr(wrong, name, value)
        status = library.echospline_volume_slice(handle, ctypes.byref(wrong), lattice, 12, out, 4, None)
        assert status in (Status.WRONG_SIZE, Status.WRONG_VALUE)
        assert library.echospline_volume_message(handle)
    library.echospline_volume_destroy(handle)
    field = space.ForceField(struct_size=ctypes.sizeof(space.ForceField), poisson=0.7, shear_modulus=1.0)
    assert library.echospline_force_field_at(ctypes.byref(field), lattice, 4, lattice) == Status.WRONG_VALUE
