"""``displacement.npz`` of a scene in space: the motion of the mesh, needle and plane of every frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from echospline.atomic import appearing, writing
from echospline.errors import InputError
from echospline.scene import Floats, ImagingPlane, SpatialPose

KIND = "space"


class SpatialDisplacementWriter:
    """Collects the frames of a run and writes them at the end; the file gets its name when it is whole.

    Arrays of the file: ``points`` (n, 3) mm, ``displacement`` (f, n, 3) mm in single precision, ``times`` (f,) s, ``entry`` and ``tip`` (f, 3) mm,
    ``speed`` (f,) mm/s, ``plane`` (f, 4, 4) picture's frame to scene, and per frame the lattice of the picture's pixels: ``picture_points``
    (rows, columns, 2) mm in the plane, ``picture_origins`` (f, rows, columns, 3) mm, where their tissue lay at rest.

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
        self._frames: list[tuple[Floats, float, SpatialPose, ImagingPlane, Floats]] = []

    def add(
        self, displacement: Floats, time: float, pose: SpatialPose, plane: ImagingPlane, origins: Floats
    ) -> None:
        """Keep one frame.

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
        self._frames.append(
            (displacement.astype(np.float32), float(time), pose, plane, origins.astype(np.float32))
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
        u, times, poses, planes, origins = zip(*self._frames, strict=True)
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
            )
        return self.path
