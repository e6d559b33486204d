"""Fields per unit of each parameter: the linear part of the tissue models, for identification in closed form.

Under the printed laws (loading at once, no sideways drag) the field of a needle step is linear in alpha1, alpha2 and,
but for the fading of the tip's push near surfaces, in sigma (spline); in the tip's force and the friction
coefficient (finite elements, Green's function). The nonlinear parameters (delta, length, alpha3, radius) are searched.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import exp
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lu_factor, lu_solve

from echospline.errors import InputError
from echospline.mechanics import AnchoredKernel, FEMModel, GreenModel, TPSModel
from echospline.mechanics.finite_elements import interpolate
from echospline.mechanics.interaction import friction, tip_push
from echospline.scene import ZERO_LENGTH, Floats, NeedlePose


@dataclass(frozen=True)
class Observation:
    """Displacements observed while a needle moved.

    Parameters
    ----------
    points : ndarray, shape (n, 2)
        Reference positions, mm.
    displacement : ndarray, shape (frames, n, 2)
        Deformed minus reference, mm; nan where a point could not be tracked.
    times : ndarray, shape (frames,)
        s, ascending.
    poses : sequence of NeedlePose
        One per frame.

    Raises
    ------
    InputError
        If shapes do not fit, or nothing was displaced.
    """

    points: Floats
    displacement: Floats
    times: Floats
    poses: Sequence[NeedlePose]

    def __post_init__(self) -> None:
        frames, n = len(self.poses), len(self.points)
        if self.displacement.shape != (frames, n, 2) or len(self.times) != frames:
            raise InputError(
                f"an observation of {frames} poses and {n} points needs displacements of shape ({frames}, {n}, 2) "
                f"and {frames} times; got {self.displacement.shape} and {len(self.times)}"
            )
        if not (np.nan_to_num(self.displacement) != 0).any():
            raise InputError("the observation displaces no point, so there is nothing to identify")

    def frames(self, chosen: NDArray[np.intp]) -> Observation:
        """Return some of the frames, in ascending order of time."""
        order = np.sort(np.asarray(chosen, dtype=np.intp))
        return Observation(
            self.points, self.displacement[order], self.times[order], [self.poses[i] for i in order]
        )

    def effective_speed(self, alpha3: float) -> Floats:
        """Return the effective speed of friction: v while the needle moves, then relaxing, equation (16); (frames,)."""
        speed = np.zeros(len(self.poses))
        last, stopped = 0.0, float(self.times[0])
        for k, (pose, t) in enumerate(zip(self.poses, self.times, strict=True)):
            if pose.speed != 0:
                last, stopped = pose.speed, float(t)
            speed[k] = last * exp(-alpha3 * (float(t) - stopped))
        return speed

    @property
    def rests(self) -> bool:
        """Whether a frame shows the needle at rest after it has moved, so that relaxation can be seen."""
        moved = np.cumsum([pose.speed != 0 for pose in self.poses]) > 0
        return bool(any(m and pose.speed == 0 for m, pose in zip(moved, self.poses, strict=True)))


class UnitFields(Protocol):
    """Interface of a tissue model for identification."""

    @property
    def observation(self) -> Observation:
        """The observation to fit."""
        ...

    @property
    def linear(self) -> Sequence[str]:
        """Parameters in which the field is linear, p names."""
        ...

    @property
    def least(self) -> tuple[Floats, Floats]:
        """Combinations of the linear parameters that have lower bounds, an invertible (p, p), and those bounds, (p,)."""
        ...

    @property
    def most(self) -> Mapping[str, float]:
        """Upper bounds of linear parameters that have one; such a parameter has a row of its own in ``least``."""
        ...

    @property
    def search(self) -> Mapping[str, tuple[float, float]]:
        """Further continuous parameters with their bounds."""
        ...

    @property
    def levels(self) -> Mapping[str, Sequence[float]]:
        """Further parameters, each with a few values to try."""
        ...

    def fields(self, values: Mapping[str, float]) -> Floats:
        """Return the field per unit of each linear parameter, shape (frames, n, 2, p), mm per unit."""
        ...


@dataclass(frozen=True)
class _Tip:
    """Contribution of one frame's tip: its response at the points, at the candidates for contact, and at itself."""

    rows: Floats
    coupling: Floats
    own: Floats


@dataclass(frozen=True)
class _Frame:
    """One frame for one delta: landmarks, their distance to the shaft, their factored coupling."""

    pose: NeedlePose
    contacts: NDArray[np.intp]
    distance: Floats
    tip: Floats | None
    factors: object


class SplineFields:
    """Fields of a `TPSModel` (any kernel) per unit of alpha1, alpha2 (s) and sigma (mm).

    Parameters
    ----------
    model : TPSModel
        Grid, clamp, kernel, stiffness and the fixed parameters; its laws must be the printed ones.
    observation : Observation
        The observation to fit.
    delta : sequence of float
        Values of delta to try, mm.
    length : (low, high)
        Bounds of the length in equation (15), mm.
    alpha3 : (low, high)
        Bounds of the rate of relaxation, 1/s; used if the observation shows rest.

    Raises
    ------
    InputError
        If the model's laws are not the printed ones.
    """

    def __init__(
        self,
        model: TPSModel,
        observation: Observation,
        *,
        delta: Sequence[float] = (1.0, 1.5, 2.0, 3.0),
        length: tuple[float, float] = (0.2, 5.0),
        alpha3: tuple[float, float] = (0.01, 20.0),
    ) -> None:
        p = model.parameters
        if (p.loading, p.drag, p.tip) != ("immediate", 0.0, "point"):
            raise InputError(
                "the field is linear in the parameters only for loading='immediate', drag=0 and tip='point'; "
                f"got {p.loading!r}, {p.drag} and {p.tip!r}"
            )
        self.model, self.observation = model, observation
        self.linear = ("alpha1", "alpha2", "sigma")
        # friction, equation (15), lies between alpha1 far from the shaft and alpha1 + alpha2 / 2 at it: neither is negative
        self.least = (
            np.array([[1.0, 0.0, 0.0], [1.0, 0.5, 0.0], [0.0, 0.0, 1.0]]),
            np.array([0.0, 0.0, 1e-3]),
        )
        # a tip pushes tissue no further than it is deep: beyond that its push fades as fast as sigma grows, and sigma has no end
        self.most = {"sigma": max((pose.depth for pose in observation.poses), default=0.0) or np.inf}
        self.search = {"length": length} | ({"alpha3": alpha3} if observation.rests else {})
        self.levels = {"delta": tuple(delta)}
        self._scene = AnchoredKernel.factor(
            model.kernel, model.anchors.places, observation.points, held=model.anchors.held
        )
        nodes = model.grid.nodes[model.lattice]
        reach = [
            pose.closest(nodes)[1] <= max(delta) for pose in observation.poses if pose.depth >= ZERO_LENGTH
        ]
        self._nodes = nodes[np.any(reach, axis=0)] if reach else nodes[:0]
        x = self._scene.conditioned(self._nodes)
        self._rows, self._among = self._scene.rows(x), self._scene.between(x, x) + self._softness(self._nodes)
        self._tips = [self._tip(pose, x) for pose in observation.poses]
        self._frames: dict[float, list[_Frame]] = {}

    def fields(self, values: Mapping[str, float]) -> Floats:
        """Return the field per unit of alpha1, alpha2 and sigma, shape (frames, n, 2, 3)."""
        delta = values["delta"]
        if delta not in self._frames:
            pairs = zip(self.observation.poses, self._tips, strict=True)
            self._frames[delta] = [self._frame(pose, tip, delta) for pose, tip in pairs]
        speed = self.observation.effective_speed(values.get("alpha3", 0.0))
        out = np.zeros((*self.observation.displacement.shape, 3))
        for k, frame in enumerate(self._frames[delta]):
            if frame.factors is not None:
                out[k] = self._field(frame, float(speed[k]), values)
        return out

    def _field(self, frame: _Frame, speed: float, values: Mapping[str, float]) -> Floats:
        """Solve for the weights of the frame's landmarks and sum their responses."""
        c, m = self._scene.components, len(frame.contacts)
        along = np.zeros((m + (frame.tip is not None), 3))
        along[:m, 0] = friction(frame.distance, speed, 1.0, 0.0, values["length"])
        along[:m, 1] = friction(frame.distance, speed, 0.0, 1.0, values["length"])
        if frame.tip is not None:
            sigma = values.get("sigma", 1.0)
            along[m, 2] = tip_push(frame.pose, sigma, self._clearance(frame.pose)) / sigma
        axis = np.array(frame.pose.axis)
        if c == 2:
            along = np.repeat(along, 2, axis=0) * np.tile(axis, len(along))[:, None]
        weights = lu_solve(frame.factors, along, check_finite=False)
        field = self._rows[_interleaved(frame.contacts, c)].T @ weights[: m * c]
        if frame.tip is not None:
            field += frame.tip.T @ weights[m * c :]
        if c == 1:
            return np.asarray(field[:, None, :] * axis[:, None])
        return np.asarray(field.reshape(2, -1, 3).transpose(1, 0, 2))

    def _clearance(self, pose: NeedlePose) -> float:
        """Distance over which the tip can push, mm."""
        return self.model.clamps.clearance(pose.tip, pose.axis)

    def _tip(self, pose: NeedlePose, candidates: Floats) -> _Tip | None:
        """Return the tip's responses; None where it pushes nothing."""
        if pose.speed < 0 or pose.depth < ZERO_LENGTH or self._clearance(pose) <= 0:
            return None
        place = np.array([pose.tip])
        x = self._scene.conditioned(place)
        own = self._scene.between(x, x) + self._softness(place)
        return _Tip(self._scene.rows(x), self._scene.between(candidates, x), own)

    def _frame(self, pose: NeedlePose, tip: _Tip | None, delta: float) -> _Frame:
        """Choose the contacts by the model's rule, and factor their coupling."""
        distance = pose.closest(self._nodes)[1]
        along = (self._nodes - pose.entry) @ np.array(pose.axis)
        touched = (distance <= delta) & (along <= pose.depth - self.model.gap) & (pose.depth >= ZERO_LENGTH)
        if tip is not None:
            touched &= np.hypot(*(self._nodes - pose.tip).T) > 1e-6  # a tip on a node replaces it as landmark
        contacts = np.flatnonzero(touched)
        index = _interleaved(contacts, self._scene.components)
        G = self._among[np.ix_(index, index)]
        if tip is not None:
            G = np.block([[G, tip.coupling[index]], [tip.coupling[index].T, tip.own]])
        factors = lu_factor(G) if len(G) else None
        return _Frame(pose, contacts, distance[contacts], None if tip is None else tip.rows, factors)

    def _softness(self, places: Floats) -> Floats:
        """Return the diagonal that finite stiffness adds at landmarks, in conditioned units."""
        c = self._scene.components
        if self.model.stiffness is None:
            return np.zeros((c * len(places), c * len(places)))
        stiffness = self.model.stiffness[[self.model.grid.nearest(place) for place in places]]
        return np.diag(np.repeat(self._scene.compliance(stiffness), c))


def _interleaved(index: NDArray[np.intp], c: int) -> NDArray[np.intp]:
    rows: NDArray[np.intp] = (index[:, None] * c + np.arange(c)).ravel()
    return rows


class ForceFields:
    """Fields of a `FEMModel` or `GreenModel` per N of tip force and per N s/mm^2 of friction.

    Displacements depend on forces over modulus only: the model's Young's modulus is taken as given.
    """

    def __init__(
        self,
        model: FEMModel | GreenModel,
        observation: Observation,
        *,
        alpha3: tuple[float, float] = (0.01, 20.0),
    ) -> None:
        self.model, self.observation = model, observation
        self.linear = ("tip", "friction")
        self.least = (np.eye(2), np.zeros(2))
        self.most: dict[str, float] = {}
        self.search = {"alpha3": alpha3} if observation.rests else {}
        self.levels: dict[str, tuple[float, ...]] = {}
        unit = [self._unit(pose) for pose in observation.poses]
        self._tip, self._friction = np.stack([u[0] for u in unit]), np.stack([u[1] for u in unit])

    def fields(self, values: Mapping[str, float]) -> Floats:
        """Return the field per unit of tip force and friction, shape (frames, n, 2, 2)."""
        speed = self.observation.effective_speed(values.get("alpha3", 0.0))
        return np.stack([self._tip, self._friction * speed[:, None, None]], axis=-1)

    def _unit(self, pose: NeedlePose) -> tuple[Floats, Floats]:
        """Return the fields of 1 N at the tip (none on withdrawal) and of 1 N/mm along the shaft."""
        points, axis = self.observation.points, np.array(pose.axis)
        zero = np.zeros((len(points), 2))
        if pose.depth < ZERO_LENGTH:
            return zero, zero
        pushes = pose.speed >= 0 and bool(self.model.grid.contains(pose.tip)[0])
        if isinstance(self.model, FEMModel):
            loads = np.stack(
                [self.model.tip_loads(pose, float(pushes)), self.model.shaft_loads(pose, 1.0)], axis=-1
            )
            u = self.model.factored.solve(loads)
            return tuple(interpolate(self.model.grid, u[..., i], points) for i in (0, 1))  # type: ignore[return-value]
        places, covered = self.model.stations(pose)
        sources = np.vstack([places, pose.tip]) if pushes else places
        unit = np.eye(len(sources))[:, None, :] * axis[:, None]
        at = self.model.response.answer(sources, unit, points)[1]
        axial = at.transpose(1, 0, 2).reshape(2 * len(points), len(sources))
        shaft = (axial[:, : len(places)] @ covered).reshape(2, -1).T
        return (axial[:, -1].reshape(2, -1).T if pushes else zero), shaft
