"""``displacement.npz`` of a scene in space: the motion of the mesh, needle and plane of every frame, and the motion that the picture shows.

Read as a record of the plane (`io.read_displacement`), it is the part of the motion that lies in the picture, in the cine's own coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from echospline.atomic import appearing, writing
from echospline.errors import InputError
from echospline.scene import Floats, ImagingPlane, SeenMotion, SpatialPose

KIND = "space"
RANKS = {
    "points": 2, "displacement": 3, "times": 1, "entry": 2, "tip": 2, "speed": 1, "plane": 3, "picture_points": 3, "picture_origins": 4,
    "picture_displacement": 4, "picture_out_of_plane": 3, "picture_valid": 3,
}  # fmt: skip
"""Arrays of the file and their numbers of axes."""


@dataclass(frozen=True, eq=False)
class SpatialDisplacementRecord:
    """Motion of tissue in space while needle and probe moved, and how the picture showed it.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Mesh nodes at rest, mm.
    displacement : ndarray, shape (frames, n, 3)
        Of the nodes, mm.
    times : ndarray, shape (frames,)
        s.
    entry, tip : ndarray, shape (frames, 3)
        The needle, mm.
    speed : ndarray, shape (frames,)
        Signed axial speed, mm/s.
    plane : ndarray, shape (frames, 4, 4)
        Picture's frame to scene.
    picture_points : ndarray, shape (rows, columns, 2)
        A lattice of the picture's pixels in the probe's frame, mm.
    picture_origins : ndarray, shape (frames, rows, columns, 3)
        Where the tissue that every lattice point shows lay at rest, mm.
    picture_displacement : ndarray, shape (frames, rows, columns, 2)
        Of the tissue that a lattice point showed in the first frame: its place in this frame's plane minus that in the first one's, mm.
    picture_out_of_plane : ndarray, shape (frames, rows, columns)
        The same tissue's signed distance from this frame's plane, mm.
    picture_valid : ndarray of bool, shape (frames, rows, columns)
        Whether it is still within the slice and the picture (`scene.seen_motion`).

    Raises
    ------
    InputError
        If shapes do not fit, a number is not finite or times do not ascend.
    """

    points: Floats
    displacement: Floats
    times: Floats
    entry: Floats
    tip: Floats
    speed: Floats
    plane: Floats
    picture_points: Floats
    picture_origins: Floats
    picture_displacement: Floats
    picture_out_of_plane: Floats
    picture_valid: NDArray[np.bool_]

    def __post_init__(self) -> None:
        for name, rank in RANKS.items():
            if getattr(self, name).ndim != rank:
                raise InputError(f"{name} must have {rank} axes; got shape {getattr(self, name).shape}")
        n, f = len(self.points), len(self.times)
        rows, columns = self.picture_points.shape[:2]
        shapes = {
            "points": (n, 3), "displacement": (f, n, 3), "times": (f,), "entry": (f, 3), "tip": (f, 3), "speed": (f,), "plane": (f, 4, 4),
            "picture_points": (rows, columns, 2), "picture_origins": (f, rows, columns, 3), "picture_displacement": (f, rows, columns, 2),
            "picture_out_of_plane": (f, rows, columns), "picture_valid": (f, rows, columns),
        }  # fmt: skip
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array.shape != shape:
                raise InputError(f"{name} must have shape {shape}; got {array.shape}")
            if not np.isfinite(array).all():
                raise InputError(f"{name} holds a number that is not finite")
        if (np.diff(self.times) <= 0).any():
            raise InputError("times must ascend strictly")

    def __len__(self) -> int:
        return len(self.times)

    def pose(self, frame: int) -> SpatialPose:
        """Return the needle at one frame."""
        entry, tip = (tuple(map(float, ends[frame])) for ends in (self.entry, self.tip))
        return SpatialPose(entry, tip, float(self.speed[frame]))  # type: ignore[arg-type]

    def in_plane(self) -> dict[str, Floats]:
        """Return the arrays of a record of the plane: what a cine of the run shows, its first pixel being (0, 0).

        The needle is projected onto the plane of each frame, and its speed is that of the projection.
        """
        corner = self.picture_points[0, 0]
        ends, speed = [], []
        for i, matrix in enumerate(self.plane):
            entry, tip = ImagingPlane(matrix).lower(np.stack([self.entry[i], self.tip[i]]))
            length = float(np.linalg.norm(tip - entry))
            share = float(np.hypot(*(tip - entry)[:2])) / length if length > 0 else 1.0
            ends.append((entry[:2] - corner, tip[:2] - corner))
            speed.append(share * float(self.speed[i]))
        frames = len(self)
        return {
            "points": (self.picture_points - corner).reshape(-1, 2),
            "displacement": self.picture_displacement.reshape(frames, -1, 2),
            "times": self.times,
            "tip": np.array([tip for _, tip in ends]),
            "entry": np.array([entry for entry, _ in ends]),
            "speed": np.array(speed),
        }


class SpatialDisplacementWriter:
    """Collects the frames of a run and writes them at the end; the file gets its name when it is whole.

    Arrays of the file: those of `SpatialDisplacementRecord`, fields in single precision.

    Parameters
    ----------
    path : path
        Ending in ``.npz``.
    points : ndarray, shape (n, 3)
        Mesh nodes at rest, mm.
    picture_points : ndarray, shape (rows, columns, 2)
        The lattice in the plane, mm.
    """

    def __init__(self, path: str | Path, points: Floats, picture_points: Floats) -> None:
        self.path = Path(path)
        if self.path.suffix.lower() != ".npz":
            raise InputError(f"a displacement record is written as .npz; got {self.path.name!r}")
        self._points, self._picture = points, picture_points
        self._frames: list[tuple[Floats, float, SpatialPose, ImagingPlane, Floats, SeenMotion]] = []

    def add(
        self,
        displacement: Floats,
        time: float,
        pose: SpatialPose,
        plane: ImagingPlane,
        origins: Floats,
        seen: SeenMotion,
    ) -> None:
        """Keep one frame.

        Parameters
        ----------
        displacement : ndarray, shape (n, 3)
            Of the mesh, mm.
        time : float
            s.
        pose : SpatialPose
            The needle.
        plane : ImagingPlane
            The probe.
        origins : ndarray, shape (rows, columns, 3)
            Where the tissue of the lattice lay at rest, mm.
        seen : SeenMotion
            Of the first picture's tissue on the lattice, row by row.

        Raises
        ------
        InputError
            If a field has another shape or a number is not finite.
        """
        if displacement.shape != self._points.shape or not np.isfinite(displacement).all():
            raise InputError(
                f"displacement must be finite, of shape {self._points.shape} in mm; got {displacement.shape}"
            )
        if origins.shape != (*self._picture.shape[:2], 3):
            raise InputError(f"origins must have shape {(*self._picture.shape[:2], 3)}; got {origins.shape}")
        count = self._picture[..., 0].size
        if seen.displacement.shape != (count, 2):
            raise InputError(
                f"what the picture shows has one displacement per lattice point, shape {(count, 2)}; got {seen.displacement.shape}"
            )
        kept = SeenMotion(
            seen.displacement.astype(np.float32), seen.out_of_plane.astype(np.float32), seen.valid
        )
        self._frames.append(
            (displacement.astype(np.float32), float(time), pose, plane, origins.astype(np.float32), kept)
        )

    def close(self) -> Path:
        """Write the file.

        Raises
        ------
        InputError
            If there is no frame, or the disk refuses.
        """
        if not self._frames:
            raise InputError(f"{self.path} would have no frame")
        u, times, poses, planes, origins, seen = zip(*self._frames, strict=True)
        lattice = self._picture.shape[:2]
        with writing(self.path), appearing(self.path) as part, part.open("wb") as file:
            np.savez(
                file,
                kind=np.array(KIND),
                points=self._points,
                displacement=np.stack(u),
                times=np.array(times),
                entry=np.array([p.entry for p in poses]),
                tip=np.array([p.tip for p in poses]),
                speed=np.array([p.speed for p in poses]),
                plane=np.stack([p.matrix for p in planes]),
                picture_points=self._picture,
                picture_origins=np.stack(origins),
                picture_displacement=np.stack([s.displacement.reshape(*lattice, 2) for s in seen]),
                picture_out_of_plane=np.stack([s.out_of_plane.reshape(lattice) for s in seen]),
                picture_valid=np.stack([s.valid.reshape(lattice) for s in seen]),
            )
        return self.path
