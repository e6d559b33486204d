"""The tissue model of the paper: landmarks moved by the needle, a spline that carries them to the whole mesh.

One step (Algorithm 2): which nodes the shaft touches (13), how friction, rest and tilt move them (14)-(16), how the
tip pushes (12), and the spline through anchors, contacts and tip (2)-(9). `mechanics.reference` reads it in plain NumPy, refitting at
each step; `mechanics.native` reaches the same numbers in the native core.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from echospline.errors import InputError
from echospline.mechanics.kernels import Elastic, Kernel, ThinPlate
from echospline.mechanics.landmarks import Anchors, Clamps, contact_lattice, join_gap
from echospline.mechanics.native import CoreScene, NativeState, NativeStep, Precision
from echospline.mechanics.parameters import TPSParameters
from echospline.mechanics.reference import Reference, TPSState
from echospline.mechanics.spline import Spline, condition
from echospline.scene import Floats, NeedlePose, RegularGrid, is_number

Solver = Literal["response", "refit"]

State = TPSState | NativeState


def anchors_for(clamps: Clamps, kernel: Kernel, spacing: float) -> Anchors:
    """Anchors that determine a spline of this kernel.

    Parameters
    ----------
    clamps : Clamps
        What holds the tissue.
    kernel : Kernel
        `ThinPlate`, whose slope has to be held, too, where a component is held along one edge alone, or `Elastic`.
    spacing : float
        Greatest distance between anchors along an edge, mm.

    Raises
    ------
    InputError
        If there are too many, or they leave a component free.
    """
    anchors = clamps.anchors(spacing, affine=not isinstance(kernel, Elastic))
    condition(
        kernel, anchors.places, anchors.held
    )  # refuses anchors that hold nothing, before any step is made
    return anchors


class TPSModel:
    """Tissue as a landmark spline.

    Parameters
    ----------
    grid : RegularGrid
        The mesh, 2 x 2 nodes or more.
    clamped : iterable of {"top", "bottom", "left", "right"}
        Edges that anchors hold in every direction: the same that finite elements clamp.
    parameters : TPSParameters
        Of the interaction.
    kernel : Kernel
        `ThinPlate` (the paper) or `Elastic`.
    sliding : iterable of the same names
        Edges whose anchors hold the normal component alone: tissue slides along them.
    clamped_points : array_like, shape (k, 2), optional
        Further anchors, mm.
    stiffness : array_like, shape (n,), optional
        Per mesh node: how firmly a landmark there holds its displacement (see `spline.factor`); infinite when
        not given.
    solver : {"response", "refit"}
        How a step reaches its numbers: the native core, which keeps the mesh's response and updates it, or a spline fitted
        anew at each step, as Algorithm 1 is printed. The states of the two are not interchangeable.
    precision : {"single", "double"}
        Of the field, with the solver "response". The single one stays within 1e-4 mm.

    Raises
    ------
    InputError
        If an edge has another name, the anchors do not determine a spline, or a stiffness is not positive.
    """

    def __init__(
        self,
        grid: RegularGrid,
        clamped: Iterable[str] = ("left", "right", "bottom"),
        parameters: TPSParameters | None = None,
        kernel: Kernel | None = None,
        *,
        sliding: Iterable[str] = (),
        clamped_points: ArrayLike | None = None,
        stiffness: ArrayLike | None = None,
        solver: Solver = "response",
        precision: Precision = "single",
    ) -> None:
        if solver not in get_args(Solver):
            raise InputError(f"solver is one of {', '.join(get_args(Solver))}; got {solver!r}")
        if precision not in get_args(Precision):
            raise InputError(f"precision is one of {', '.join(get_args(Precision))}; got {precision!r}")
        self.grid = grid
        self.parameters = parameters or TPSParameters()
        self.kernel = kernel or ThinPlate()
        if self.kernel.dimension != 2:
            raise InputError("a mesh in the plane takes a kernel of the plane; got one of dimension 3")
        self.clamps = Clamps.of(grid, clamped, clamped_points, sliding)
        self.anchors = anchors_for(self.clamps, self.kernel, self.parameters.anchor_spacing)
        self.lattice = contact_lattice(self.clamps, self.parameters.contact_spacing)
        self.gap = join_gap(grid, self.lattice)
        self.stiffness: Floats | None = None
        if stiffness is not None:
            k = np.array(np.broadcast_to(np.asarray(stiffness, dtype=np.float64), (grid.size,)))
            if not (k > 0).all():
                raise InputError(f"every stiffness must be positive (or infinite); got {k.min()}")
            self.stiffness = k
        self.reference = Reference(
            self.grid,
            self.parameters,
            self.kernel,
            self.clamps,
            self.anchors,
            self.lattice,
            self.gap,
            self.stiffness,
        )
        self.solver, self.precision = solver, precision
        self.native: NativeStep | None = None
        if solver == "response":
            self.native = NativeStep(
                CoreScene.of(grid, self.clamps, self.parameters, self.kernel, self.stiffness, precision)
            )

    def __reduce__(self) -> tuple[partial[TPSModel], tuple[object, ...]]:
        """Pickle what the model was made of; a copy has a workspace of its own."""
        made = partial(
            TPSModel,
            sliding=self.clamps.sliding,
            clamped_points=self.clamps.points,
            stiffness=self.stiffness,
            solver=self.solver,
            precision=self.precision,
        )
        return made, (self.grid, self.clamps.edges, self.parameters, self.kernel)

    def rest(self) -> State:
        """State of tissue that no needle has touched."""
        return self.reference.rest() if self.native is None else self.native.rest()

    def displacement(self, state: State) -> Floats:
        """Displacement of the mesh nodes, shape (n, 2), mm."""
        if isinstance(state, NativeState):
            return self._native().displacement(state)
        return self.displacement_at(state, self.grid.nodes)

    def displacement_at(self, state: State, points: ArrayLike) -> Floats:
        """Displacement of any reference points (n, 2) mm, shape (n, 2), mm."""
        points = np.asarray(points, dtype=np.float64)
        field = self.spline(state)
        return np.zeros(points.shape) if field is None else field(points)

    def spline(self, state: State) -> Spline | None:
        """Return the displacement field as a spline (it can be evaluated elsewhere); None where nothing is displaced."""
        if isinstance(state, NativeState):
            return self.reference.spline(self._native().landmarks(state))
        return state.field

    def landmarks(self, state: State) -> TPSState:
        """Return the landmarks of a state, as the reference has them."""
        return self._native().landmarks(state) if isinstance(state, NativeState) else state

    def advance(self, state: State, pose: NeedlePose, dt: float) -> State:
        """State after the needle has moved to ``pose`` in ``dt`` seconds, Algorithm 2.

        Raises
        ------
        InputError
            If dt is negative or not finite.
        """
        if not (is_number(dt) and dt >= 0):
            raise InputError(f"dt must be zero or a positive number of seconds; got {dt!r}")
        if isinstance(state, NativeState):
            return self._native().advance(state, pose, dt)
        if self.native is not None:
            raise InputError('this state belongs to a model with the solver "refit"; this one has "response"')
        return self.reference.advance(state, pose, dt)

    def _native(self) -> NativeStep:
        if self.native is None:
            raise InputError('this state belongs to a model with the solver "response"; this one has "refit"')
        return self.native
