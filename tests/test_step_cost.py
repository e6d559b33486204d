"""What one step costs, counted, not timed: rows read, calls made, blocks allocated."""

from __future__ import annotations

import gc
from dataclasses import replace

import numpy as np
import pytest
from numba.core.runtime import _nrt_python, rtsys

from echospline.mechanics import TPSModel, fused, tps
from echospline.mechanics.tip_patch import NODES
from echospline.scene import NeedlePose, RegularGrid

BLOCKS = 13
"""Blocks of memory that the compiled part of a plain step asks for: one to refer to each of the nine arrays that it is
handed, the pose, and the new state's three."""


def pose(i):
    return NeedlePose((13.3, 0.0), (13.3 + 0.004 * i, 0.01 * i), 10.8)


def settled(shape=(30, 24), steps=1200):
    """A model in the middle of a push, its contacts and its patch complete: the next step is a plain one."""
    grid = RegularGrid(shape, (40 / (shape[0] - 1), 30 / (shape[1] - 1)))
    model = TPSModel(grid)
    state, i, work = model.rest(), 0, model.fast.response.statistics
    while True:
        before, after = replace(work), model.advance(state, pose(i + 1), 1e-3)
        if i >= steps and work == before:
            return model, state, i
        state, i = after, i + 1


@pytest.fixture(scope="module")
def middle():
    return settled()


def step(model, state, i):
    return model.advance(state, pose(i + 1), 1e-3)


def test_a_plain_step_reads_one_row_per_contact_and_those_of_the_patch(middle):
    model, state, i = middle
    r = model.fast.response
    clean = step(model, state, i).mesh
    patch = int(r.met[0]) * len(NODES)
    used = [*range(patch, patch + len(NODES)), *range(r.head, r.head + r.count)]
    kept = r.single.copy()
    try:
        for row in range(len(r.single)):
            r.single[row] = np.nan
            dirty = step(model, state, i).mesh
            r.single[row] = kept[row]
            assert np.isnan(dirty).all() == (row in used), row
            assert np.isnan(dirty).any() == (row in used), row
        r.rows[:], double = np.nan, r.rows.copy()  # the double rows are not read at all
        assert np.array_equal(step(model, state, i).mesh, clean)
        r.rows[:] = double
    finally:
        r.single[:] = kept
    assert len(used) == 10 + len(state.landmarks)


def test_a_plain_step_is_one_compiled_call_and_no_fit(middle, monkeypatch):
    model, state, i = middle
    calls = []
    compiled = fused.step
    monkeypatch.setattr(fused, "step", lambda *a: calls.append("step") or compiled(*a))
    for owner, name in ((fused, "move"), (fused, "needle"), (tps, "factor")):
        monkeypatch.setattr(owner, name, lambda *_, name=name: calls.append(name))
    for name in ("prepare", "set_contacts", "field", "rebuild", "before"):
        monkeypatch.setattr(model.fast.response, name, lambda *_, name=name: calls.append(name))
    step(model, state, i)
    assert calls == ["step"]


def test_a_step_that_changes_contacts_updates_once_and_calls_twice(monkeypatch):
    model, state, i = settled()
    calls = []
    compiled, r = fused.step, model.fast.response
    monkeypatch.setattr(fused, "step", lambda *a: calls.append("step") or compiled(*a))
    change = r.set_contacts
    monkeypatch.setattr(r, "set_contacts", lambda s: calls.append("change") or change(s))
    joined = r.statistics.joined
    while r.statistics.joined == joined:
        calls.clear()
        i += 1
        state = model.advance(state, pose(i), 1e-3)
    assert calls == ["step", "change", "step"]


def test_the_blocks_that_a_step_allocates_do_not_depend_on_mesh_or_contacts():
    _nrt_python.memsys_enable_stats()
    counts = set()
    for shape, steps in (((30, 24), 600), ((30, 24), 1500), ((60, 50), 900)):
        model, state, i = settled(shape, steps)
        step(model, state, i)
        gc.collect()
        before = rtsys.get_allocation_stats()
        after = step(model, state, i)
        now = rtsys.get_allocation_stats()
        counts.add(now.mi_alloc - before.mi_alloc)
        assert len(after.mesh) == model.grid.size
    assert counts == {BLOCKS}
