"""A tracked needle in a scene in space: from a frame at its tip to entry and tip, and back; x lateral, y depth, z elevation, mm."""

from __future__ import annotations

import numpy as np

from echospline.errors import InputError
from echospline.scene.grid import Floats, RegularGrid
from echospline.scene.imaging_plane import ImagingPlane, Reach, TrackedNeedle
from echospline.scene.space import SpatialPose, as_triple

RIGID = 0.02
"""Deviation of axes from length 1 and from right angles (1.1 degrees); trackers round to four digits, scales are gross."""
FARTHEST = 1e6
"""mm; no picture lies farther, nor has such pixels: beyond, squares of the numbers would overflow."""
STEEP = 0.05
"""Least share of the direction that points into depth for a needle above the skin to aim at a point of it (3 degrees)."""


def pose_in_space(
    needle: TrackedNeedle, low: Floats, high: Floats, reach: Reach, skin: float = 0.0
) -> SpatialPose | None:
    """Return entry and tip of a tracked needle: it enters where its axis crosses the skin.

    A needle above the skin has depth 0 and lies at the point that it aims at. None when the tip is farther than ``reach.contact`` from the
    volume, so that it touches nothing of it.

    Parameters
    ----------
    needle : TrackedNeedle
        Tip and direction of insertion in the scene's frame.
    low, high : ndarray, shape (3,)
        Corners of the volume, mm.
    reach : Reach
        Its contact, and the length of the shaft.
    skin : float
        Depth of the surface, mm.
    """
    tip, direction = np.array(needle.tip), np.array(needle.direction)
    near = np.array([low[0], -np.inf, low[2]]) - reach.contact
    if (tip < near).any() or (tip > high + reach.contact).any():
        return None
    if tip[1] <= skin:
        aim = tip + (skin - tip[1]) / direction[1] * direction if direction[1] > STEEP else tip
        at = np.clip(aim, low - reach.contact, high + reach.contact)
        at[1] = skin
        return SpatialPose(as_triple(at, "entry"), as_triple(at, "tip"))
    back = min((tip[1] - skin) / direction[1], reach.shaft) if direction[1] > 0 else reach.shaft
    return SpatialPose(as_triple(tip - back * direction, "entry"), as_triple(tip, "tip"))


def tip_frame(pose: SpatialPose) -> Floats:
    """Return the 4 x 4 matrix from a frame at a needle's tip to the scene: +Z inserts, +Y lies as near to the scene's z as it can.

    A needle without a direction (zero length) inserts along y.
    """
    z = np.array(pose.axis) if any(pose.axis) else np.array([0.0, 1.0, 0.0])
    up = np.array([0.0, 0.0, 1.0]) if abs(z[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    y = up - (up @ z) * z
    y /= np.linalg.norm(y)
    matrix = np.eye(4)
    matrix[:3, :3] = np.column_stack((np.cross(y, z), y, z))
    matrix[:3, 3] = pose.tip
    return matrix


def rigid_fault(matrix: Floats) -> tuple[str, str]:
    """Return kind and description of what keeps a finite 4 x 4 matrix from being a motion of a rigid tool; empty if nothing does.

    Axes count as perpendicular and of length 1 within `RIGID`.
    """
    axes = matrix[:3, :3]
    largest = np.abs(axes).max()
    lengths = np.linalg.norm(axes, axis=0) if largest < 1e6 else np.full(3, largest)
    said = ", ".join(f"{v:.4g}" for v in lengths)
    if lengths.min() < 1e-6:
        return "empty", f"expected axes of length 1; got {said}: the tool is probably not seen"
    if np.abs(lengths - 1.0).max() > RIGID:
        return "scaled", f"expected axes of length 1; got {said}: a tool's transform has no scale, send mm"
    if np.abs(axes.T @ axes - np.diag(lengths**2)).max() > RIGID:
        return "skewed", "expected perpendicular axes: a tool's transform has no skew"
    if np.linalg.det(axes) < 0:
        return "mirrored", "expected a right-handed rotation; got a mirrored one: one axis has the wrong sign"
    return "", ""


def nearest_rigid(matrix: Floats) -> Floats:
    """Return the motion nearest to a 4 x 4 matrix whose axes a tracker has rounded: same translation, nearest rotation."""
    u, _, v = np.linalg.svd(matrix[:3, :3])
    rigid = np.eye(4)
    rigid[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    rigid[:3, 3] = matrix[:3, 3]
    return rigid


def picture_plane(matrix: Floats, grid: RegularGrid, skew: float = RIGID) -> ImagingPlane:
    """Return the plane of a picture by the matrix from its pixels to the scene.

    Where its columns and rows are not quite perpendicular, the plane's axes are the perpendicular ones nearest to them. The plane's origin is
    where the matrix puts the origin of the picture's frame.

    Parameters
    ----------
    matrix : ndarray, shape (4, 4)
        Pixel (column, row, 0) to the scene, mm; its third column is not used.
    grid : RegularGrid
        The pixels in the picture's frame, mm.
    skew : float
        Largest cosine of the angle between columns and rows.

    Raises
    ------
    InputError
        If the axes have another spacing than the picture (beyond 1 %), or are skewed more, or a number is beyond `FARTHEST`.
    """
    if (largest := float(np.abs(matrix).max())) > FARTHEST:
        raise InputError(f"a picture's transform is in mm; got {largest:.4g}, farther than any tracker sees")
    lengths = np.linalg.norm(matrix[:3, :2], axis=0)
    if lengths.min() >= 1e-9 and not np.allclose(lengths, grid.spacing, rtol=0.01):
        raise InputError(
            f"expected the picture's {grid.spacing[0]:.4g} x {grid.spacing[1]:.4g} mm per pixel; got "
            f"{lengths[0]:.4g} x {lengths[1]:.4g}: calibrate for this picture, or give it that spacing"
        )
    if lengths.min() < 1e-9:
        raise InputError(
            "a picture's transform has columns and rows of a length; got 0: the probe is probably not seen"
        )
    x, y = (matrix[:3, :2] / lengths).T
    if abs(float(x @ y)) > skew:
        raise InputError(
            f"a picture's transform has perpendicular columns and rows, within {_degrees(skew):.1f} degrees; got "
            f"{_degrees(float(x @ y)):.1f} degrees of skew: calibrate again"
        )
    turned = np.eye(4)
    turned[:3, :3] = np.column_stack((x, y, np.cross(x, y)))
    origin = -np.array(grid.origin) / np.array(grid.spacing)
    turned[:3, 3] = matrix[:3, :2] @ origin + matrix[:3, 3]
    return ImagingPlane(nearest_rigid(turned))


def _degrees(cosine: float) -> float:
    """Return the deviation from a right angle, degrees."""
    return float(np.degrees(np.arcsin(min(abs(cosine), 1.0))))


def probe_angles(plane: ImagingPlane) -> tuple[float, float, float]:
    """Return yaw, pitch and roll in degrees with which `probe_plane` turns a probe as this plane's; roll is 0 where it is no other than yaw."""
    r = plane.matrix[:3, :3]
    pitch = float(np.degrees(np.arcsin(np.clip(-r[1, 2], -1.0, 1.0))))
    if abs(r[1, 2]) > 1.0 - 1e-12:  # the beam lies along z: yaw and roll turn about the same axis
        return float(np.degrees(np.arctan2(-r[2, 0], r[0, 0]))), pitch, 0.0
    yaw, roll = np.arctan2(r[0, 2], r[2, 2]), np.arctan2(r[1, 0], r[1, 1])
    return float(np.degrees(yaw)), pitch, float(np.degrees(roll))
