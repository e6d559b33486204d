"""The scene in space: a mesh, a needle and its path, and the path of the imaging plane; x lateral, y depth, z elevation, mm.

The surface of the tissue, where the probe rests, is y = 0 and tissue lies below it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import cos, hypot, isfinite, radians, sin

import numpy as np
from numpy.typing import ArrayLike, NDArray

from echospline.errors import InputError
from echospline.scene.grid import Floats, as_points
from echospline.scene.imaging_plane import ImagingPlane
from echospline.scene.needle import SAME_TIME, ZERO_LENGTH

Triple = tuple[float, float, float]


def as_triple(values: Sequence[float] | Floats, name: str) -> Triple:
    """Check three finite numbers and return them as floats.

    Raises
    ------
    InputError
        If they are not three, or not finite.
    """
    numbers = tuple(float(v) for v in values)
    if len(numbers) != 3 or not all(isfinite(v) for v in numbers):
        raise InputError(f"{name} must be three finite numbers (x, y, z) in mm; got {tuple(values)}")
    return numbers[0], numbers[1], numbers[2]


@dataclass(frozen=True)
class SpatialGrid:
    """Points at constant spacing in space: ``origin + (ix dx, iy dy, iz dz)``, x fastest.

    Parameters
    ----------
    shape : (nx, ny, nz)
        Number of points, 2 or more each.
    spacing : (dx, dy, dz)
        mm, positive.
    origin : (x, y, z)
        First point, mm.

    Raises
    ------
    InputError
        If a number is out of its range.
    """

    shape: tuple[int, int, int]
    spacing: Triple
    origin: Triple = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if len(self.shape) != 3 or not all(int(n) == n and n >= 2 for n in self.shape):
            raise InputError(
                f"a mesh in space has three whole numbers of nodes, 2 or more each; got {self.shape}"
            )
        spacing = as_triple(self.spacing, "spacing of a mesh")
        if min(spacing) <= 0:
            raise InputError(f"spacing of a mesh must be positive numbers in mm; got {self.spacing}")
        object.__setattr__(self, "shape", tuple(int(n) for n in self.shape))
        object.__setattr__(self, "spacing", spacing)
        object.__setattr__(self, "origin", as_triple(self.origin, "origin of a mesh"))

    @classmethod
    def spanning(
        cls, low: Sequence[float], high: Sequence[float], shape: tuple[int, int, int]
    ) -> SpatialGrid:
        """Return the grid of ``shape`` whose first and last points are ``low`` and ``high``, mm."""
        first, last = as_triple(low, "low"), as_triple(high, "high")
        if min(np.subtract(last, first)) <= 0:
            raise InputError(f"a mesh spans from a lower to a higher corner; got {first} to {last} mm")
        x, y, z = np.subtract(last, first) / np.maximum(np.subtract(shape, 1), 1)
        return cls(shape, (float(x), float(y), float(z)), first)

    @property
    def size(self) -> int:
        """Number of points."""
        nx, ny, nz = self.shape
        return nx * ny * nz

    @property
    def corners(self) -> tuple[Floats, Floats]:
        """First and last point, mm."""
        low = np.array(self.origin)
        return low, low + np.subtract(self.shape, 1) * np.array(self.spacing)

    @cached_property
    def nodes(self) -> Floats:
        """All points in mm, shape (n, 3), x fastest."""
        x, y, z = (
            o + h * np.arange(n) for o, h, n in zip(self.origin, self.spacing, self.shape, strict=True)
        )
        Z, Y, X = np.meshgrid(z, y, x, indexing="ij")
        nodes = np.stack([X.ravel(), Y.ravel(), Z.ravel()], axis=1)
        nodes.setflags(write=False)
        return nodes

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Test which points (n, 3) in mm lie inside, faces included, shape (n,)."""
        low, high = self.corners
        p = np.atleast_2d(np.asarray(points, dtype=np.float64))
        inside: NDArray[np.bool_] = np.logical_and.reduce((p >= low) & (p <= high), axis=1)
        return inside

    def nearest(self, point: ArrayLike) -> int:
        """Return the index of the node nearest to one point in mm."""
        index = np.rint((np.asarray(point, dtype=np.float64) - self.origin) / self.spacing)
        i, j, k = np.clip(index, 0, np.subtract(self.shape, 1)).astype(int)
        return int((k * self.shape[1] + j) * self.shape[0] + i)


@dataclass(frozen=True, slots=True)
class SpatialPose:
    """Position of a needle in space at one instant.

    Parameters
    ----------
    entry : (x, y, z)
        n_s, the point of entry, mm.
    tip : (x, y, z)
        n_t, the tip, mm.
    speed : float
        Signed speed of the tip along the axis, mm/s; positive inserts, negative withdraws.

    Raises
    ------
    InputError
        If a number is not finite.
    """

    entry: Triple
    tip: Triple
    speed: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "entry", as_triple(self.entry, "entry"))
        object.__setattr__(self, "tip", as_triple(self.tip, "tip"))
        if not isfinite(self.speed):
            raise InputError(f"speed of a needle must be a finite number in mm/s; got {self.speed}")

    @property
    def depth(self) -> float:
        """Length of the shaft from entry to tip, mm."""
        return hypot(*np.subtract(self.tip, self.entry))

    @property
    def axis(self) -> Triple:
        """Unit vector from entry to tip; (0, 0, 0) for a needle of zero length."""
        length = self.depth
        if length < ZERO_LENGTH:
            return (0.0, 0.0, 0.0)
        return as_triple(np.subtract(self.tip, self.entry) / length, "axis")

    def tip_matrix(self) -> Floats:
        """Return the matrix from a frame at the tip to the scene: +Z inserts, +Y is as near to the scene's z as can be."""
        z = np.array(self.axis if self.depth >= ZERO_LENGTH else (0.0, 1.0, 0.0))
        up = np.array([0.0, 0.0, 1.0]) if abs(z[2]) < 0.999 else np.array([1.0, 0.0, 0.0])
        y = up - (up @ z) * z
        y /= np.linalg.norm(y)
        matrix = np.eye(4)
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = np.cross(y, z), y, z, self.tip
        return matrix

    def seen_from(self, plane: ImagingPlane) -> tuple[Triple, Triple]:
        """Return entry and tip in the frame of an imaging plane: (lateral, depth, distance from the plane), mm."""
        ends = plane.lower(np.array([self.entry, self.tip]))
        return as_triple(ends[0], "entry"), as_triple(ends[1], "tip")


@dataclass(frozen=True, eq=False)
class SpatialInsertion:
    """A needle's path in space: keyframes of entry and tip with straight lines between them.

    Parameters
    ----------
    times : array_like, shape (k,)
        s, strictly ascending, two or more.
    entry : array_like, shape (k, 3) or (3,)
        mm.
    tip : array_like, shape (k, 3)
        mm.

    Raises
    ------
    InputError
        If the arrays do not fit or times do not ascend.
    """

    times: Floats
    entry: Floats
    tip: Floats

    def __post_init__(self) -> None:
        times = ascending(self.times, "an insertion")
        tip, entry = as_points(self.tip, "tip", 3), as_points(self.entry, "entry", 3)
        if len(entry) == 1:
            entry = np.repeat(entry, len(times), axis=0)
        if len(tip) != len(times) or len(entry) != len(times):
            raise InputError(
                f"an insertion needs one entry and tip per time: {len(times)} times, {len(entry)} entries, {len(tip)} tips"
            )
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "entry", entry)
        object.__setattr__(self, "tip", tip)

    @classmethod
    def straight(
        cls,
        entry: Sequence[float],
        direction: Sequence[float],
        depth: float,
        speed: float = 5.0,
        *,
        dwell: float = 0.0,
        retract: bool = False,
        retract_speed: float | None = None,
    ) -> SpatialInsertion:
        """Build a path that goes straight in, rests and, if asked, comes out again.

        Parameters
        ----------
        entry : (x, y, z)
            mm.
        direction : (x, y, z)
            Of the axis, of any length above zero.
        depth : float
            Length inserted, mm.
        speed, retract_speed : float
            mm/s, positive; withdrawal is as fast as insertion where not given.
        dwell : float
            Rest at full depth, s.
        retract : bool
            Whether the needle is withdrawn.
        """
        back = speed if retract_speed is None else retract_speed
        for name, value, unit in (
            ("depth", depth, "mm"),
            ("speed", speed, "mm/s"),
            ("retract_speed", back, "mm/s"),
        ):
            if not (isfinite(value) and value > 0):
                raise InputError(f"{name} must be a positive number in {unit}; got {value}")
        if not (isfinite(dwell) and dwell >= 0):
            raise InputError(f"dwell must be zero or a positive number in s; got {dwell}")
        along = np.array(as_triple(direction, "direction"))
        length = float(np.linalg.norm(along))
        if length < 1e-9:
            raise InputError(f"direction of a needle has a length; got {tuple(direction)}")
        ns = np.array(as_triple(entry, "entry"))
        nt = ns + depth * along / length
        times, tips = [0.0, depth / speed], [ns, nt]
        if dwell > 0:
            times.append(times[-1] + dwell)
            tips.append(nt)
        if retract:
            times.append(times[-1] + depth / back)
            tips.append(ns)
        return cls(np.array(times), ns, np.array(tips))

    @property
    def duration(self) -> float:
        """Time from first to last keyframe, s."""
        return float(self.times[-1] - self.times[0])

    def pose(self, t: float) -> SpatialPose:
        """Return the pose at time t (s); outside the keyframes the needle rests at the first or last one."""
        k = self.times
        i, a = between(k, t)
        entry = (1 - a) * self.entry[i - 1] + a * self.entry[i]
        tip = (1 - a) * self.tip[i - 1] + a * self.tip[i]
        growth = (self.tip[i] - self.entry[i]) - (self.tip[i - 1] - self.entry[i - 1])
        axis = _axis(tip - entry, self.tip[i] - self.entry[i], self.tip[i - 1] - self.entry[i - 1])
        moving = k[0] < t <= k[-1] + SAME_TIME
        speed = float(growth @ axis) / float(k[i] - k[i - 1]) if moving else 0.0
        return SpatialPose(as_triple(entry, "entry"), as_triple(tip, "tip"), speed)


@dataclass(frozen=True, eq=False)
class PlanePath:
    """How the imaging plane moves: keyframes of planes; between them it shifts evenly and turns about one axis.

    Parameters
    ----------
    times : array_like, shape (k,)
        s, strictly ascending; one is enough for a plane that stands still.
    planes : sequence of ImagingPlane
        One per time.

    Raises
    ------
    InputError
        If there is not one plane per time, or times do not ascend.
    """

    times: Floats
    planes: tuple[ImagingPlane, ...]

    def __post_init__(self) -> None:
        planes = tuple(self.planes)
        times = np.atleast_1d(np.asarray(self.times, dtype=np.float64))
        if len(planes) > 1:
            times = ascending(times, "a path of the probe")
        if len(times) != len(planes) or not planes:
            raise InputError(
                f"a path of the probe needs one plane per time; got {len(times)} times, {len(planes)} planes"
            )
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "planes", planes)

    @classmethod
    def still(cls, plane: ImagingPlane) -> PlanePath:
        """Return the path of a plane that stands still."""
        return cls(np.zeros(1), (plane,))

    @property
    def duration(self) -> float:
        """Time from first to last keyframe, s."""
        return float(self.times[-1] - self.times[0])

    def at(self, t: float) -> ImagingPlane:
        """Return the plane at time t (s); outside the keyframes it rests at the first or last one."""
        if len(self.planes) == 1:
            return self.planes[0]
        i, a = between(self.times, t)
        first, last = self.planes[i - 1].matrix, self.planes[i].matrix
        matrix = np.eye(4)
        turn = first[:3, :3].T @ last[:3, :3]
        matrix[:3, :3] = first[:3, :3] @ _part_of_turn(turn, a)
        matrix[:3, 3] = (1 - a) * first[:3, 3] + a * last[:3, 3]
        return ImagingPlane(matrix)


def probe_plane(
    position: Sequence[float], yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0
) -> ImagingPlane:
    """Place a probe: the plane whose origin, the middle of the probe's face, lies at a position.

    At zero angles the plane is z = 0: x lateral, y depth. What a hand does, in this order:

    Parameters
    ----------
    position : (x, y, z)
        Middle of the probe's face, mm.
    yaw : float
        Turns the probe about its own beam (y), degrees: 90 makes a longitudinal view transverse.
    pitch : float
        Tilts (fans) it about its lateral axis (x), degrees: the beam points towards growing z.
    roll : float
        Rocks it in its own plane (about z), degrees: the beam points towards falling x.

    Raises
    ------
    InputError
        If a number is not finite.
    """
    angles = (yaw, pitch, roll)
    if not all(isfinite(a) for a in angles):
        raise InputError(f"yaw, pitch and roll of a probe are finite numbers in degrees; got {angles}")
    matrix = np.eye(4)
    matrix[:3, :3] = _about(1, yaw) @ _about(0, pitch) @ _about(2, roll)
    matrix[:3, 3] = as_triple(position, "position of the probe")
    return ImagingPlane(matrix)


def ascending(times: ArrayLike, owner: str) -> Floats:
    """Check two or more strictly ascending times in s."""
    t = np.atleast_1d(np.asarray(times, dtype=np.float64))
    if t.ndim != 1 or len(t) < 2 or not np.isfinite(t).all() or (np.diff(t) <= 0).any():
        raise InputError(f"{owner} needs two or more strictly ascending times in s")
    return t


def between(times: Floats, t: float) -> tuple[int, float]:
    """Return the keyframe i that ends the segment of time t, and t's share of that segment, 0 to 1."""
    i = int(np.clip(np.searchsorted(times, t - SAME_TIME, side="left"), 1, len(times) - 1))
    return i, float(np.clip((t - times[i - 1]) / (times[i] - times[i - 1]), 0.0, 1.0))


def _axis(*candidates: Floats) -> Floats:
    """Direction of the first vector that has a length."""
    for along in candidates:
        length = float(np.linalg.norm(along))
        if length > ZERO_LENGTH:
            axis: Floats = along / length
            return axis
    return np.zeros(3)


def _about(axis: int, degrees: float) -> Floats:
    """Rotation about an axis, right-handed."""
    c, s = cos(radians(degrees)), sin(radians(degrees))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turn = np.eye(3)
    turn[i, i] = turn[j, j] = c
    turn[i, j], turn[j, i] = -s, s
    return turn


def _part_of_turn(turn: Floats, share: float) -> Floats:
    """Turn by a share of a rotation's angle about its axis."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - SciPy is loaded only where a probe turns

    part: Floats = Rotation.from_rotvec(share * Rotation.from_matrix(turn).as_rotvec()).as_matrix()
    return part
