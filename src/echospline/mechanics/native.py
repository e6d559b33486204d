"""The step of the spline model by the native core: the same numbers as `mechanics.reference`, fast.

A state is a value: the core's bytes, with the displacement of the mesh. The core keeps a workspace of its own for the last state; going
on from that one is fast, and from any other one exact after its bytes have been loaded.
"""

from __future__ import annotations

import ctypes
import threading
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from time import perf_counter
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from echospline import _native as core
from echospline.errors import InputError
from echospline.mechanics.kernels import Elastic, Kernel
from echospline.mechanics.landmarks import Clamps
from echospline.mechanics.parameters import TPSParameters
from echospline.mechanics.reference import Tip, TPSState
from echospline.scene import Floats, NeedlePose, RegularGrid, SpatialGrid, SpatialPose

Precision = Literal["single", "double"]

FINE = 20_000
"""Nodes above which the core evaluates a mesh from a coarse one, and the displacement of a state only when it is asked for."""


@dataclass(frozen=True, slots=True, eq=False)
class NativeState:
    """A state of the tissue in the core.

    Parameters
    ----------
    saved : bytes
        The state as the core saves it.
    mesh : ndarray, shape (n, 2), or None
        Displacement of the mesh nodes, mm, read-only; None for a fine mesh and in space, where the displacement is computed
        when it is asked for.
    held_back : int
        Steps since rest in which the landmarks were slowed down so that the picture does not jump.
    """

    saved: bytes
    mesh: Floats | None
    held_back: int


@dataclass(frozen=True)
class Statistics:
    """Work that the core has done in a model so far.

    Parameters
    ----------
    steps : int
        Steps made.
    joined, left : int
        Contacts added and removed.
    rebuilt : int
        Times the contacts' inverse was made anew because rounding had grown.
    allocations : int
        Made by steps; 0 as long as the reserved room is enough.
    residual : float
        Largest misfit at the landmarks seen, mm for displacements of 1 mm.
    """

    steps: int
    joined: int
    left: int
    rebuilt: int
    allocations: int
    residual: float


def describe_core() -> dict[str, str]:
    """Return the version of the native core, and the processor level that it uses here."""
    library = core.library()
    number = library.echospline_version()
    version = f"{number >> 16}.{number >> 8 & 255}.{number & 255}"
    return {"version": version, "level": _level_name(library.echospline_level_best())}


def _level_name(level: int) -> str:
    name: bytes = core.library().echospline_level_name(level)
    return name.decode()


@dataclass(frozen=True, eq=False)
class CoreScene:
    """A scene of landmarks as every host gives it to the core.

    Parameters
    ----------
    options : mapping
        Members of `echospline_scene_options` by their names: numbers, or three of them.
    clamped_points : ndarray, shape (k, D)
        mm.
    stiffness : ndarray, shape (n,), or None
        Per mesh node; None: infinite.

    Raises
    ------
    InputError
        If a name is no option, or a value has another form than its option.
    """

    options: Mapping[str, int | float | Sequence[int] | Sequence[float]]
    clamped_points: Floats
    stiffness: Floats | None = None

    def __post_init__(self) -> None:
        _struct(self.options)  # refuses what is no option

    @classmethod
    def of(
        cls,
        grid: RegularGrid | SpatialGrid,
        clamps: Clamps,
        parameters: TPSParameters,
        kernel: Kernel,
        stiffness: Floats | None,
        precision: Precision,
    ) -> CoreScene:
        """Return the scene of a mesh.

        Parameters
        ----------
        grid : RegularGrid or SpatialGrid
            The mesh, in the plane (D = 2) or in space (D = 3).
        clamps : Clamps
            The clamped and sliding edges (faces), and clamped points.
        parameters : TPSParameters
            Of the interaction.
        kernel : Kernel
            `ThinPlate` or `Elastic`.
        stiffness : ndarray, shape (n,), or None
            Per mesh node; None: infinite.
        precision : {"single", "double"}
            Of the field.
        """
        filled = _options(grid, clamps, parameters, kernel, precision)
        read = {name: getattr(filled, name) for name in OPTION_NAMES}
        options = {n: tuple(v) if isinstance(v, ctypes.Array) else v for n, v in read.items()}
        firm = None if stiffness is None else np.ascontiguousarray(stiffness, dtype=np.float64)
        return cls(options, np.ascontiguousarray(clamps.points, dtype=np.float64), firm)


OPTION_NAMES = tuple(
    name
    for name, kind, *_ in core.SceneOptions._fields_
    if name
    not in ("struct_size", "reserved", "level", "contact_room", "clamped_point_count", "stiffness_count")
    and kind is not ctypes.c_void_p
)
"""Options that a `CoreScene` may name; level and room are the own matter of a host."""


def _struct(options: Mapping[str, Any]) -> core.SceneOptions:
    """Return the core's struct of options by name."""
    o = core.SceneOptions(struct_size=ctypes.sizeof(core.SceneOptions))
    for name, value in options.items():
        if name not in OPTION_NAMES:
            raise InputError(f"{name!r} is no option of a scene; expected some of {', '.join(OPTION_NAMES)}")
        try:
            if isinstance(getattr(o, name), ctypes.Array):
                getattr(o, name)[:] = tuple(value)
            else:
                setattr(o, name, value)
        except (TypeError, ValueError, OverflowError):
            raise InputError(
                f"option {name} of a scene has another form than the core's; got {value!r}"
            ) from None
    return o


class NativeStep:
    """Steps of one scene in the core, for any state, from any thread.

    Parameters
    ----------
    scene : CoreScene
        What is given.

    Raises
    ------
    InputError, SolverError
        If the core refuses the scene.
    """

    def __init__(self, scene: CoreScene) -> None:
        self.scene = scene
        self._core = core.library()
        self._lock = threading.Lock()
        options = _struct(scene.options)
        self._dimension = options.dimension
        self._size = prod(options.shape[: options.dimension])
        self._lazy = self._dimension == 3 or self._size > FINE
        self._current: NativeState | None = None
        points, firm = scene.clamped_points, scene.stiffness
        options.clamped_points, options.clamped_point_count = points.ctypes.data, len(points)
        if firm is not None:
            options.stiffness, options.stiffness_count = firm.ctypes.data, len(firm)
        self._scene, self._tissue = ctypes.c_void_p(), ctypes.c_void_p()
        status = self._core.echospline_scene_create(ctypes.byref(options), ctypes.byref(self._scene))
        weakref.finalize(self, _destroy, self._core, self._scene, self._tissue)
        core.check(status, self._core.echospline_scene_message, self._scene)
        self._check(self._core.echospline_tissue_create(self._scene, ctypes.byref(self._tissue)))
        self._pose = core.Pose()
        self._at_pose = ctypes.byref(self._pose)
        self._statistics = core.Statistics(struct_size=ctypes.sizeof(core.Statistics))
        self._at_statistics = ctypes.byref(self._statistics)
        self._rest = self._present()

    @property
    def level(self) -> str:
        """Name of the processor level in use."""
        return _level_name(self._core.echospline_scene_level(self._scene))

    @property
    def statistics(self) -> Statistics:
        """Work done so far."""
        with self._lock:
            self._ask_statistics()
            s = self._statistics
            return Statistics(s.steps, s.joined, s.left, s.rebuilt, s.allocations, s.residual)

    def rest(self) -> NativeState:
        """State of tissue that no needle has touched."""
        return self._rest

    def advance(self, state: NativeState, pose: NeedlePose | SpatialPose, dt: float) -> NativeState:
        """State after the needle has moved to ``pose`` in ``dt`` seconds, equations (12) to (17)."""
        with self._lock:
            self._go_to(state)
            self._set(pose, dt)
            status = self._core.echospline_advance(self._tissue, self._at_pose)
            if status != core.Status.OK:
                self._current = None
                self._check(status)
            return self._present()

    def displacement(self, state: NativeState) -> Floats:
        """Displacement of the mesh nodes, shape (n, D), mm."""
        if state.mesh is not None:
            if len(state.mesh) != self._size:
                raise InputError(
                    f"this state has a mesh of {len(state.mesh)} nodes; the model has {self._size}: use a state of this model"
                )
            return state.mesh
        with self._lock:
            self._go_to(state)
            return self._mesh()

    def displacement_at(self, state: NativeState, points: Floats) -> Floats:
        """Displacement of any reference points (n, D) in mm, shape (n, D), mm, in the scene's precision."""
        p = np.ascontiguousarray(points, dtype=np.float64)
        if p.ndim != 2 or p.shape[1] != self._dimension:
            raise InputError(f"points must have shape (n, {self._dimension}) in mm; got {p.shape}")
        u = np.empty_like(p)
        with self._lock:
            self._go_to(state)
            self._check(
                self._core.echospline_displacement_at(self._tissue, p.ctypes.data, len(p), u.ctypes.data)
            )
        return u

    def landmarks(self, state: NativeState) -> TPSState:
        """Return the landmarks of a state as the reference has them (without its pose and field)."""
        with self._lock:
            self._go_to(state)
            count = ctypes.c_int64()
            self._check(self._core.echospline_landmarks(self._tissue, None, 0, ctypes.byref(count)))
            marks = (core.Landmark * count.value)()
            self._check(
                self._core.echospline_landmarks(self._tissue, marks, count.value, ctypes.byref(count))
            )
        D = self._dimension
        contacts = [m for m in marks if m.node >= 0]
        last = marks[-1] if len(contacts) < len(marks) else None
        tip = (
            None
            if last is None
            else Tip(
                np.array(last.place[:D]),
                np.array(last.displacement[:D]),
                last.kind == core.LandmarkKind.TIP,
            )
        )
        return TPSState(
            contacts=np.array([m.node for m in contacts], dtype=np.intp),
            touching=np.array([m.kind == core.LandmarkKind.CONTACT for m in contacts], dtype=bool),
            q=np.array([m.displacement[:D] for m in contacts], dtype=np.float64).reshape(-1, D),
            along=np.array([m.along for m in contacts], dtype=np.float64),
            grip=np.array([m.grip[:D] for m in contacts], dtype=np.float64).reshape(-1, D),
            tip=tip,
            held_back=state.held_back,
        )

    def time_steps(self, poses: Sequence[NeedlePose], dt: float) -> tuple[Floats, NDArray[np.bool_]]:
        """Time the core alone on a path from rest: the step, and the mesh displacement in single precision.

        Returns
        -------
        seconds : ndarray, shape (k,)
            Of each step.
        changed : ndarray of bool, shape (k,)
            Whether contacts joined or left in it.
        """
        seconds, changes = np.empty(len(poses)), np.zeros(len(poses) + 1, dtype=np.int64)
        mesh = np.empty((self._size, self._dimension), dtype=np.float32)
        advance, displacement = self._core.echospline_advance, self._core.echospline_displacement_single
        tissue, at_pose, at_mesh, numbers = self._tissue, self._at_pose, mesh.ctypes.data, mesh.size
        with self._lock:
            self._current = None
            self._check(self._core.echospline_tissue_reset(tissue))
            self._ask_statistics()
            changes[0] = self._statistics.joined + self._statistics.left
            for i, pose in enumerate(poses):
                self._set(pose, dt)
                begin = perf_counter()
                status = advance(tissue, at_pose) or displacement(tissue, at_mesh, numbers)
                seconds[i] = perf_counter() - begin
                self._check(status)
                self._ask_statistics()
                changes[i + 1] = self._statistics.joined + self._statistics.left
        return seconds, np.diff(changes) > 0

    def _set(self, pose: NeedlePose | SpatialPose, dt: float) -> None:
        p, D = self._pose, self._dimension
        p.entry[:D] = pose.entry
        p.tip[:D] = pose.tip
        p.speed, p.dt = pose.speed, dt

    def _go_to(self, state: NativeState) -> None:
        if state is not self._current:  # the very object: an equal number might come from another process
            self._current = None
            self._check(self._core.echospline_state_load(self._tissue, state.saved, len(state.saved)))
            self._current = state

    def _present(self) -> NativeState:
        """State in which the core's tissue is now."""
        saved = ctypes.create_string_buffer(self._core.echospline_state_size(self._tissue))
        self._check(self._core.echospline_state_save(self._tissue, saved, len(saved)))
        self._ask_statistics()
        mesh = None if self._lazy else self._mesh()
        if mesh is not None:
            mesh.setflags(write=False)
        self._current = NativeState(saved.raw, mesh, self._statistics.held_back)
        return self._current

    def _mesh(self) -> Floats:
        mesh = np.empty((self._size, self._dimension))
        self._check(self._core.echospline_displacement(self._tissue, mesh.ctypes.data, mesh.size))
        return mesh

    def _ask_statistics(self) -> None:
        self._check(self._core.echospline_tissue_statistics(self._tissue, self._at_statistics))

    def _check(self, status: int) -> None:
        if status != core.Status.OK:
            core.check(status, self._core.echospline_tissue_message, self._tissue)


def _options(
    grid: RegularGrid | SpatialGrid, clamps: Clamps, p: TPSParameters, kernel: Kernel, precision: Precision
) -> core.SceneOptions:
    """Options of a scene."""
    D = len(grid.shape)
    o = core.SceneOptions(struct_size=ctypes.sizeof(core.SceneOptions), dimension=D)
    o.precision = core.Precision.SINGLE if precision == "single" else core.Precision.DOUBLE
    o.tip = core.Tip.TIP_NODE if p.tip == "node" else core.Tip.TIP_POINT
    o.loading = core.Loading[p.loading.upper()]
    o.clamped = int(sum(core.Edge[edge.upper()] for edge in set(clamps.edges)))
    o.sliding = int(sum(core.Edge[edge.upper()] for edge in set(clamps.sliding)))
    for d in range(D):
        o.shape[d], o.spacing[d], o.origin[d] = grid.shape[d], grid.spacing[d], grid.origin[d]
    o.sigma, o.delta, o.alpha1, o.alpha2, o.alpha3 = p.sigma, p.delta, p.alpha1, p.alpha2, p.alpha3
    o.length, o.drag, o.friction_speed = p.length, p.drag, p.friction_speed
    o.contact_spacing, o.anchor_spacing = p.contact_spacing, p.anchor_spacing
    elastic = kernel if isinstance(kernel, Elastic) else Elastic()
    o.kernel = core.Kernel.ELASTIC if elastic is kernel else core.Kernel.THIN_PLATE
    o.poisson, o.radius = elastic.nu, elastic.radius
    o.plane = core.Plane.PLANE_STRAIN if elastic.plane == "strain" else core.Plane.PLANE_STRESS
    return o


def _destroy(library: Any, scene: ctypes.c_void_p, tissue: ctypes.c_void_p) -> None:
    library.echospline_tissue_destroy(tissue)
    library.echospline_scene_destroy(scene)
