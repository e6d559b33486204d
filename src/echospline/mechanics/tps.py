"""The tissue model of the paper: landmarks moved by the needle, a spline that carries them to the whole mesh.

One step (Algorithm 2): which nodes the shaft touches (13), how friction, rest and tilt move them (14)-(16), how the
tip pushes (12), and the spline through anchors, contacts and tip (2)-(9). Read in plain NumPy, refitting at each step;
`echospline.mechanics.response` reaches the same numbers faster.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import inf, isfinite
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from echospline.errors import InputError
from echospline.mechanics.anchored_kernel import AnchoredKernel
from echospline.mechanics.compiled import forget_stale_code
from echospline.mechanics.fused import FusedState, FusedStep, Setting
from echospline.mechanics.kernels import Kernel, ThinPlate
from echospline.mechanics.landmarks import Clamps, contact_lattice
from echospline.mechanics.parameters import TPSParameters
from echospline.mechanics.pixel_field import FINE, PixelField
from echospline.mechanics.reference import Nodes, Reference, TPSState
from echospline.mechanics.response import Precision, Response
from echospline.mechanics.spline import Spline, factor
from echospline.scene import Floats, NeedlePose, RegularGrid

Solver = Literal["response", "refit"]


State = TPSState | FusedState


class TPSModel:
    """Tissue as a landmark spline.

    Parameters
    ----------
    grid : RegularGrid
        The mesh, 2 x 2 nodes or more.
    clamped : iterable of {"top", "bottom", "left", "right"}
        Edges that anchors hold: the same that finite elements clamp.
    parameters : TPSParameters
        Of the interaction.
    kernel : Kernel
        `ThinPlate` (the paper) or `Elastic`.
    clamped_points : array_like, shape (k, 2), optional
        Further anchors, mm.
    stiffness : array_like, shape (n,), optional
        Per mesh node: how firmly a landmark there holds its displacement (see `spline.factor`); infinite when
        not given.
    solver : {"response", "refit"}
        How a step reaches its numbers: the mesh's response kept and updated (`fused`), or a spline fitted anew at
        each step, as Algorithm 1 is printed. The states of the two are not interchangeable.
    precision : {"single", "double"}
        Of the product that moves the mesh, with the solver "response". The single one stays within 1e-4 mm.

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
        self.clamps = Clamps.of(grid, clamped, clamped_points)
        self.anchors = self.clamps.anchors(self.parameters.anchor_spacing)
        factor(self.kernel, self.anchors)  # refuses anchors that hold nothing, before any step is made
        self.lattice = contact_lattice(self.clamps, self.parameters.contact_spacing)
        self.gap = 0.25 * _spacing(grid, self.lattice)
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
        self.pixels: PixelField | None = None
        self.fast = self._fused(precision) if solver == "response" else None

    def rest(self) -> State:
        """State of tissue that no needle has touched."""
        return TPSState() if self.fast is None else self.fast.rest()

    def displacement(self, state: State) -> Floats:
        """Displacement of the mesh nodes, shape (n, 2), mm."""
        if isinstance(state, FusedState):
            return state.mesh if self.pixels is None else self._fast().fine(state, self.pixels)
        return self.displacement_at(state, self.grid.nodes)

    def displacement_at(self, state: State, points: ArrayLike) -> Floats:
        """Displacement of any reference points (n, 2) mm, shape (n, 2), mm."""
        points = np.asarray(points, dtype=np.float64)
        field = self.spline(state)
        return np.zeros(points.shape) if field is None else field(points)

    def spline(self, state: State) -> Spline | None:
        """Return the displacement field as a spline (it can be evaluated elsewhere); None where nothing is displaced."""
        return self._fast().spline(state) if isinstance(state, FusedState) else state.field

    def advance(self, state: State, pose: NeedlePose, dt: float) -> State:
        """State after the needle has moved to ``pose`` in ``dt`` seconds, Algorithm 2.

        Raises
        ------
        InputError
            If dt is negative or not finite.
        """
        if not (isfinite(dt) and dt >= 0):
            raise InputError(f"dt must be zero or a positive number of seconds; got {dt}")
        if isinstance(state, FusedState):
            return self._fast().advance(state, pose, dt)
        if self.fast is not None:
            raise InputError('this state belongs to a model with the solver "refit"; this one has "response"')
        return self.reference.advance(state, pose, dt)

    def _fused(self, precision: Precision) -> FusedStep:
        """Build the fast solver of this scene."""
        forget_stale_code()
        p, nodes = self.parameters, self.grid.nodes
        sources, at, points = nodes[self.lattice], self.lattice, nodes
        if self.grid.size > FINE:
            points = PixelField.points(self.grid, sources)
            at = len(points) - len(sources) + np.arange(len(sources))
        scene = AnchoredKernel.factor(self.kernel, self.anchors, points, sources=sources)
        if self.grid.size > FINE:
            self.pixels = PixelField(self.grid, scene)
        softness = None if self.stiffness is None else scene.compliance(self.stiffness[self.lattice])
        x0, x1, y0, y1 = self.grid.extent
        edges = {"left": x0, "right": x1, "top": y0, "bottom": y1}
        free = {"left": -inf, "right": inf, "top": -inf, "bottom": inf}
        numbers = (p.sigma, p.delta, p.alpha1, p.alpha2, p.alpha3, p.length, p.drag, self.gap)
        setting = Setting(
            np.array([*numbers, p.loading == "immediate", p.tip == "node"]),
            np.ascontiguousarray(nodes[self.lattice].T),
            np.array([edges[e] if e in self.clamps.edges else free[e] for e in edges]),
            self.clamps.points,
            self._node_place if p.tip == "node" else None,
            None if self.stiffness is None else lambda point: self._softness(scene, point),
        )
        return FusedStep(Response(scene, at, precision, softness), setting)

    def _fast(self) -> FusedStep:
        if self.fast is None:
            raise InputError('this state belongs to a model with the solver "response"; this one has "refit"')
        return self.fast

    def _node_place(self, tip: tuple[float, float]) -> tuple[float, float, bool]:
        """Node nearest to the tip (mm), and whether it can move."""
        node = self.grid.nearest(tip)
        x, y = self.grid.nodes[node]
        return float(x), float(y), node not in self.clamps.nodes

    def _softness(self, scene: AnchoredKernel, point: tuple[float, float]) -> float:
        k = np.full(1, inf) if self.stiffness is None else self.stiffness[[self.grid.nearest(point)]]
        return float(scene.compliance(k)[0])


def _spacing(grid: RegularGrid, lattice: Nodes) -> float:
    """Smallest distance between neighbouring lines of the lattice, mm."""
    gaps = [float(np.diff(np.unique(np.round(grid.nodes[lattice, i], 9))).min(initial=inf)) for i in (0, 1)]
    least = min(gaps)
    return least if isfinite(least) else min(grid.spacing)
