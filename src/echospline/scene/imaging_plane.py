"""The imaging plane in space, and the part of a tracked needle that its beam shows.

The plane's own frame is right-handed, in mm: x lateral (the image's columns), y depth (its rows), z = x cross y out of
the plane. For an image of orientation MF, x points to the marked side of the probe and y away from it, as PLUS has it.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import asin, degrees, exp, log, sqrt

import numpy as np

from echospline.errors import InputError
from echospline.scene.grid import Floats, RegularGrid
from echospline.scene.needle import NeedlePose
from echospline.scene.transform import as_transform

AXIAL = np.array([[-1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""Plane to RAS unless a transform gives another: x to the patient's left, y to the back, z to the head.

3D Slicer's axial view, seen from the feet, then shows the picture as echospline's own page does."""

DRAWN = 0.1
"""Share of the brightness below which a piece of the shaft is not drawn."""
CROSS_SECTION = 1.0
"""mm; a needle perpendicular to the plane shows as a dot about as long as it is thick."""


@dataclass(frozen=True, eq=False)
class ImagingPlane:
    """Position of the imaging plane in space.

    Parameters
    ----------
    matrix : ndarray, shape (4, 4)
        Plane (x, y, z) mm to the reference frame (RAS) mm; a rotation and a translation.

    Raises
    ------
    InputError
        If the axes are not perpendicular, of length 1 and right-handed, within a thousandth.
    """

    matrix: Floats

    def __post_init__(self) -> None:
        matrix = as_transform(self.matrix)
        r = matrix[:3, :3]
        if np.abs(r.T @ r - np.eye(3)).max() > 1e-3 or np.linalg.det(r) < 0:
            raise InputError(
                f"an imaging plane has perpendicular, right-handed axes of length 1 mm; got {r.tolist()}"
            )
        object.__setattr__(self, "matrix", matrix)

    @classmethod
    def of_image(cls, image_to_reference: Floats, grid: RegularGrid) -> ImagingPlane:
        """Return the plane of an image whose matrix takes (column, row, slice) to the reference frame.

        The third axis is made from the first two: the third column of a 2-D image's matrix carries no information.

        Parameters
        ----------
        image_to_reference : ndarray, shape (4, 4)
            As PLUS calibrates it: mm per pixel in its columns.
        grid : RegularGrid
            The pixels of echospline's image.

        Raises
        ------
        InputError
            If the matrix has another spacing than the image (beyond 1 %), or skewed axes.
        """
        m = as_transform(image_to_reference)
        lengths = np.linalg.norm(m[:3, :2], axis=0)
        if not np.allclose(lengths, grid.spacing, rtol=0.01):
            raise InputError(
                f"ImageToReference has {lengths[0]:.4g} x {lengths[1]:.4g} mm per pixel, the image "
                f"{grid.spacing[0]:.4g} x {grid.spacing[1]:.4g}; calibrate for this image or give its --spacing"
            )
        x, y = (m[:3, :2] / lengths).T
        plane = np.eye(4)
        plane[:3, :3] = np.column_stack((x, y, np.cross(x, y)))
        plane[:3, 3] = m[:3, 3] - grid.origin[0] * x - grid.origin[1] * y  # pixel (0, 0) is at grid.origin
        return cls(plane)

    def image_matrix(self, grid: RegularGrid) -> Floats:
        """Return the matrix from (column, row, slice) to the reference frame, for an IMAGE; a slice is 1 mm thick."""
        (dx, dy), (x0, y0) = grid.spacing, grid.origin
        pixel_to_plane = np.array([[dx, 0, 0, x0], [0, dy, 0, y0], [0, 0, 1, 0], [0, 0, 0, 1]])
        matrix: Floats = self.matrix @ pixel_to_plane
        return matrix

    def lift(self, points: Floats) -> Floats:
        """Convert points of the plane (n, 2) mm to the reference frame, shape (n, 3)."""
        lifted: Floats = points @ self.matrix[:3, :2].T + self.matrix[:3, 3]
        return lifted

    def lower(self, points: Floats) -> Floats:
        """Convert points of the reference frame (n, 3) mm to the plane's, shape (n, 3): the third is the distance from it."""
        lowered: Floats = (points - self.matrix[:3, 3]) @ np.linalg.inv(self.matrix[:3, :3]).T
        return lowered

    def see(
        self, tip_to_reference: Floats, axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    ) -> TrackedNeedle:
        """Convert a needle to the frame of the plane.

        Parameters
        ----------
        tip_to_reference : ndarray, shape (4, 4)
            Frame at the needle's tip.
        axis : (x, y, z)
            Direction of insertion in that frame: the shaft lies on the other side of the tip.
        """
        m = np.linalg.inv(self.matrix) @ as_transform(tip_to_reference)
        along = m[:3, :3] @ np.asarray(axis)
        length = float(np.linalg.norm(along))
        if length < 1e-6:
            raise InputError("the needle's transform has no direction: its axes have length 0")
        tip, direction = m[:3, 3], along / length
        return TrackedNeedle(
            (float(tip[0]), float(tip[1]), float(tip[2])),
            (float(direction[0]), float(direction[1]), float(direction[2])),
        )

    def tip_matrix(self, pose: NeedlePose) -> Floats:
        """Return the matrix from a frame at the tip of a needle in the plane to the reference frame: +Z inserts, +Y is the plane's z."""
        x, y = pose.axis if pose.depth > 0 else (0.0, 1.0)
        tip = np.eye(4)
        tip[:3, 2], tip[:3, 1] = (x, y, 0.0), (0.0, 0.0, 1.0)
        tip[:3, 0] = np.cross(tip[:3, 1], tip[:3, 2])
        tip[:2, 3] = pose.tip
        matrix: Floats = self.matrix @ tip
        return matrix


@dataclass(frozen=True)
class Reach:
    """Distances within which a needle counts as near the plane.

    Parameters
    ----------
    thickness : float
        Of the ultrasound beam across the plane, mm: full width at half maximum of the echo's strength.
    contact : float
        Distance of the tip from the plane, and from the image's edge, beyond which the needle no longer
        moves the tissue that the picture shows, mm.
    shaft : float
        Length of the needle, mm.

    Raises
    ------
    InputError
        If a number is not positive.
    """

    thickness: float = 4.0
    contact: float = 10.0
    shaft: float = 150.0

    def __post_init__(self) -> None:
        for name in ("thickness", "contact", "shaft"):
            if not 0 < getattr(self, name) < float("inf"):
                raise InputError(f"{name} must be a positive number of mm; got {getattr(self, name)}")


@dataclass(frozen=True)
class TrackedNeedle:
    """A needle in the plane's frame.

    Parameters
    ----------
    tip : (x, y, z)
        mm; z is the signed distance out of the plane.
    direction : (x, y, z)
        Unit vector of insertion.
    """

    tip: tuple[float, float, float]
    direction: tuple[float, float, float]

    @property
    def out_of_plane(self) -> float:
        """Signed distance of the tip from the plane, mm."""
        return self.tip[2]

    @property
    def tilt(self) -> float:
        """Angle between needle and plane, degrees; 0 lies in it."""
        return degrees(asin(min(1.0, abs(self.direction[2]))))

    def pose(self, grid: RegularGrid, reach: Reach) -> NeedlePose | None:
        """Project the needle onto the plane; it enters where it crosses the skin.

        The skin is the image's first row, continued to both sides. A needle before the skin has
        depth 0 and lies at the point that it aims at. None when the needle is too far away to move this tissue.

        Parameters
        ----------
        grid : RegularGrid
            The image's pixels.
        reach : Reach
            Distances beyond which it is too far away.
        """
        x0, x1, skin, bottom = grid.extent
        (x, y, z), (dx, dy, _) = self.tip, self.direction
        if max(x0 - x, x - x1, y - bottom, abs(z)) > reach.contact:
            return None
        if y <= skin:
            aim = x + (skin - y) * dx / dy if dy > 0.05 else x
            at = (float(np.clip(aim, x0 - reach.contact, x1 + reach.contact)), skin)
            return NeedlePose(at, at)
        back = min((y - skin) / dy, reach.shaft) if dy > 0 else reach.shaft
        return NeedlePose((x - back * dx, y - back * dy), (x, y))

    def seen(self, skin: float, reach: Reach) -> Visible | None:
        """Return the piece of the needle inside the beam; None if there is none, or the tip is not below the skin.

        A needle that crosses the plane ends in the picture where it leaves the beam: its true tip is not
        visible, as at the bedside.

        Parameters
        ----------
        skin : float
            Depth of the image's first row, mm.
        reach : Reach
            The beam's thickness.
        """
        if self.tip[1] <= skin:
            return None
        z, dz = self.tip[2], self.direction[2]
        half = reach.thickness / 2 * sqrt(log(1 / DRAWN) / log(2))
        # going back from the tip by s, the distance from the plane is z - s dz
        if abs(dz) < 1e-9:
            near, far, closest = 0.0, reach.shaft, abs(z)
            if closest > half:
                return None
        else:
            first, second = sorted(((z - half) / dz, (z + half) / dz))
            near, far = max(0.0, first), min(reach.shaft, second)
            if near >= far:
                return None
            closest = abs(z - min(max(z / dz, near), far) * dz)
        along = sqrt(max(0.0, 1.0 - dz * dz))
        brightness = exp(-4 * log(2) * (closest / reach.thickness) ** 2)
        return Visible(near * along, max(far * along, near * along + CROSS_SECTION), brightness)


@dataclass(frozen=True)
class Visible:
    """The piece of a needle inside the beam: distances back from the tip in the plane, mm, and brightness, 0 to 1."""

    near: float
    far: float
    brightness: float

    def of(self, pose: NeedlePose) -> NeedlePose:
        """Return this piece of a needle; of depth 0 if it lies above the entry."""
        (x, y), (ax, ay) = pose.tip, pose.axis if pose.depth > 0 else (0.0, 1.0)
        near = min(self.near, pose.depth)
        if self.far - self.near <= CROSS_SECTION:  # a dot, whatever the depth in the plane
            far = near + CROSS_SECTION if near == self.near else near
        else:
            far = max(near, min(self.far, pose.depth))
        return NeedlePose((x - far * ax, y - far * ay), (x - near * ax, y - near * ay), pose.speed)
