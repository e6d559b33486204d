"""Work that one step takes, counted, not timed: calls of the core, its allocations, blocks of the heap."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from echospline import _native
from echospline.mechanics import Elastic, ThinPlate, TPSModel
from echospline.scene import NeedlePose, RegularGrid
from paths import wandering

ROOT = Path(__file__).resolve().parent.parent
CC = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
KERNELS = [ThinPlate(), Elastic()]
OF_A_STEP = [
    "echospline_advance",
    "echospline_state_size",
    "echospline_state_save",
    "echospline_tissue_statistics",
    "echospline_displacement",
]
"""The step, its state as a value, and the displacement of the mesh."""


class Counted:
    """The core's library, every call noted."""

    def __init__(self, library):
        self.library, self.calls = library, []

    def __getattr__(self, name):
        function = getattr(self.library, name)

        def call(*arguments):
            self.calls.append(name)
            return function(*arguments)

        return call


def grid_of(nx, ny):
    return RegularGrid((nx, ny), (40 / (nx - 1), 30 / (ny - 1)))


def pose(i):
    return NeedlePose((13.3, 0.0), (13.3 + 0.004 * i, 0.01 * i), 10.8)


def counted_model(grid, **kw):
    model = TPSModel(grid, **kw)
    model.native._core = Counted(model.native._core)
    return model, model.native._core.calls


@pytest.mark.parametrize("kernel", KERNELS, ids=["thin plate", "elastic"])
@pytest.mark.parametrize("shape", [(30, 24), (160, 140)], ids=["mesh", "node per pixel"])
def test_a_step_is_one_call_of_the_core_whatever_it_changes(kernel, shape):
    model, calls = counted_model(grid_of(*shape), kernel=kernel)
    fine = shape[0] * shape[1] > 20_000
    state, changed = model.rest(), 0
    for i in range(0, 1500, 20):
        before = model.native.statistics
        calls.clear()
        state = model.advance(state, pose(i), 0.02)
        # the displacement of a fine mesh is computed when it is asked for
        assert calls == OF_A_STEP[: 4 if fine else 5]
        after = model.native.statistics
        changed += after.joined > before.joined
    assert changed > 10


def test_going_back_to_an_older_state_loads_its_bytes_once():
    model, calls = counted_model(grid_of(30, 24))
    first = model.advance(model.rest(), pose(300), 0.1)
    model.advance(first, pose(320), 0.1)
    calls.clear()
    second = model.advance(first, pose(310), 0.1)
    assert calls == ["echospline_state_load", *OF_A_STEP]
    calls.clear()
    model.displacement(second)
    assert calls == []


@pytest.mark.parametrize("kernel", KERNELS, ids=["thin plate", "elastic"])
@pytest.mark.parametrize("period", [1e-3, 1 / 60], ids=["1 kHz", "60 Hz"])
@pytest.mark.parametrize("precision", ["single", "double"])
def test_steps_allocate_nothing_while_contacts_join_and_leave(kernel, period, precision):
    model = TPSModel(grid_of(40, 30), kernel=kernel, precision=precision)
    for seed in (1, 3, 4):  # fewer contacts than the core has room for before it is told their number
        state = model.rest()
        for p in wandering(seed, period, 8.0):
            state = model.advance(state, p, period)
    done = model.native.statistics
    assert done.joined > 40
    assert done.left > 20
    assert done.allocations == 0


PROGRAM = r"""
#include <stdio.h>
#include <stdlib.h>
#include "echospline/echospline.h"

/* These stand before the system's: everything that the core asks for passes here. */
extern void* __libc_malloc(size_t);
extern void* __libc_calloc(size_t, size_t);
extern void* __libc_realloc(void*, size_t);
extern void* __libc_memalign(size_t, size_t);
static long asked;
void* malloc(size_t n) { ++asked; return __libc_malloc(n); }
void* calloc(size_t n, size_t m) { ++asked; return __libc_calloc(n, m); }
void* realloc(void* p, size_t n) { ++asked; return __libc_realloc(p, n); }
void* memalign(size_t a, size_t n) { ++asked; return __libc_memalign(a, n); }
void* aligned_alloc(size_t a, size_t n) { ++asked; return __libc_memalign(a, n); }
int posix_memalign(void** p, size_t a, size_t n) { ++asked; *p = __libc_memalign(a, n); return *p ? 0 : 12; }

static float field[2 * 200 * 200];
static unsigned char state[1 << 20];

static int push(int kernel, int width, int depth) {
  echospline_scene_options options = {.struct_size = sizeof options};
  echospline_scene_defaults(&options);
  options.kernel = kernel, options.shape[0] = width, options.shape[1] = depth;
  options.spacing[0] = 40.0 / (width - 1), options.spacing[1] = 30.0 / (depth - 1);
  echospline_scene* scene;
  echospline_tissue* tissue;
  if (echospline_scene_create(&options, &scene) || echospline_tissue_create(scene, &tissue)) return 1;
  const long built = asked;
  echospline_statistics statistics = {.struct_size = sizeof statistics};
  for (int i = 0; i < 3000; ++i) {
    const double d = i < 1500 ? 0.018 * i : 0.018 * (3000 - i), v = i < 1500 ? 18 : -18;
    const echospline_pose pose = {.entry = {12.3, 0}, .tip = {12.3 + 0.4 * d, 0.9165 * d}, .speed = v, .dt = 1e-3};
    if (echospline_advance(tissue, &pose) || echospline_displacement_single(tissue, field, 2L * width * depth)) return 1;
    if (i % 100 == 0 && echospline_state_save(tissue, state, sizeof state)) return 1;
  }
  if (echospline_tissue_statistics(tissue, &statistics)) return 1;
  printf("%ld %ld %ld %ld\n", built, asked - built, (long)statistics.joined, (long)statistics.left);
  echospline_tissue_destroy(tissue);
  echospline_scene_destroy(scene);
  asked = 0;
  return 0;
}

int main(void) {
  return push(ECHOSPLINE_THIN_PLATE, 40, 30) || push(ECHOSPLINE_ELASTIC, 40, 30) || push(ECHOSPLINE_THIN_PLATE, 200, 200);
}
"""


@pytest.mark.skipif(
    CC is None or not sys.platform.startswith("linux") or os.confstr("CS_GNU_LIBC_VERSION") is None,
    reason="no C compiler or no GNU C library here: the heap's blocks are not counted",
)
def test_steps_ask_the_heap_for_nothing(tmp_path):
    source, program = tmp_path / "heap.c", tmp_path / "heap"
    source.write_text(PROGRAM)
    library = Path(_native.__file__).parent / _native.FILE
    command = [CC, "-std=c17", "-I", ROOT / "core" / "include", source, library, "-o", program]
    subprocess.run(command, check=True)
    environment = {**os.environ, "LD_LIBRARY_PATH": str(library.parent)}
    run = subprocess.run([program], capture_output=True, text=True, env=environment, check=True)
    pushes = [tuple(map(int, line.split())) for line in run.stdout.splitlines()]
    assert len(pushes) == 3
    for built, during, joined, left in pushes:
        assert built > 10  # the count works
        assert joined > 20
        assert left > 20
        assert during == 0
