"""States of the spline model are values: in another process, in another model, under a hand that writes to them."""

import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from echospline.errors import InputError
from echospline.mechanics.tps import TPSModel
from echospline.scene import NeedlePose, RegularGrid

GRID = RegularGrid((20, 15), (2.0, 2.0))


def pushed(model, x, steps):
    """State after a straight push at x mm."""
    state = model.rest()
    for i in range(steps):
        state = model.advance(state, NeedlePose((x, 0.0), (x, 0.5 * (i + 1)), 5.0), 0.1)
    return state


def test_a_state_from_another_process_is_that_state_whatever_this_process_has_done():
    code = "import pickle, sys; from test_state_values import *; sys.stdout.buffer.write(pickle.dumps(pushed(TPSModel(GRID), 10.0, 20)))"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, check=True)
    here, lone = TPSModel(GRID), TPSModel(GRID)
    pushed(here, 28.0, 20)  # as many states as there
    pose = NeedlePose((10.0, 0.0), (10.0, 10.5), 5.0)
    got = here.advance(pickle.loads(done.stdout), pose, 0.1)
    expected = lone.advance(pushed(lone, 10.0, 20), pose, 0.1)
    assert np.abs(here.displacement(got) - lone.displacement(expected)).max() < 1e-5


def test_a_states_field_cannot_be_written_to():
    model = TPSModel(GRID)
    with pytest.raises(ValueError, match="read-only"):
        model.displacement(model.rest())[:] = 7.0


def test_a_state_of_another_mesh_is_refused():
    other = TPSModel(RegularGrid((10, 8), (4.0, 4.0)))
    with pytest.raises(InputError, match="300 nodes; the model has 80"):
        other.displacement(TPSModel(GRID).rest())


@pytest.mark.parametrize("precision", ["single", "double"])
def test_a_model_is_pickled_as_what_it_was_made_of(precision):
    firm = np.random.default_rng(1).uniform(0.5, 5.0, GRID.size)
    model = TPSModel(GRID, ("left", "bottom"), stiffness=firm, precision=precision)
    twin = pickle.loads(pickle.dumps(model))
    assert twin is not model
    a, b = model.displacement(pushed(model, 12.0, 10)), twin.displacement(pushed(twin, 12.0, 10))
    assert np.abs(a).max() > 0.1
    assert np.array_equal(a, b)


def test_a_mesh_of_many_metres_is_refused_at_once():
    with pytest.raises(InputError, match="check the image's spacing"):
        TPSModel(RegularGrid((40, 30), (1e4, 1e4)))
