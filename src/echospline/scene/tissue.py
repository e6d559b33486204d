"""Material of the tissue, in the plane and in space: Young's modulus and Poisson's ratio, region by region."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from echospline.errors import InputError
from echospline.scene.grid import Floats, RegularGrid, as_points
from echospline.scene.space import SpatialGrid

Mask = NDArray[np.bool_]


class Shape(Protocol):
    """Place of a region, in the plane (D = 2), in space (D = 3) or, as a layer, in both."""

    def contains(self, points: Floats) -> Mask:
        """Test which points (n, D) in mm belong to the region, shape (n,)."""
        ...


@dataclass(frozen=True)
class Layer:
    """Everything between two depths, ``top`` included and ``bottom`` not, mm."""

    top: float
    bottom: float

    def __post_init__(self) -> None:
        if not self.top < self.bottom:  # also refuses nan
            raise InputError(
                f"a layer's bottom must lie deeper than its top; got {self.top} to {self.bottom} mm"
            )

    def contains(self, points: Floats) -> Mask:
        """Test which points lie between the depths."""
        inside: Mask = (points[:, 1] >= self.top) & (points[:, 1] < self.bottom)
        return inside


@dataclass(frozen=True)
class Circle:
    """A round lesion: ``centre`` (x, y) and ``radius`` in mm."""

    centre: tuple[float, float]
    radius: float

    def __post_init__(self) -> None:
        as_points(self.centre, "centre of a circle")
        if not (np.isfinite(self.radius) and self.radius > 0):
            raise InputError(f"radius of a circle must be a positive number in mm; got {self.radius}")

    def contains(self, points: Floats) -> Mask:
        """Test which points lie within the radius."""
        _refuse_other(points, 2, "a circle", "a sphere")
        inside: Mask = np.hypot(*(points - self.centre).T) <= self.radius
        return inside


@dataclass(frozen=True)
class Polygon:
    """The inside of a closed outline: ``vertices`` (k, 2) in mm, three or more, in order."""

    vertices: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        if len(as_points(self.vertices, "vertices of a polygon")) < 3:
            raise InputError(f"a polygon needs three or more vertices; got {len(self.vertices)}")

    def contains(self, points: Floats) -> Mask:
        """Test which points lie inside, by the parity of edges that a ray along +x crosses."""
        _refuse_other(points, 2, "a polygon", "a box or labels of a volume")
        a = np.asarray(self.vertices, dtype=np.float64)
        b = np.roll(a, -1, axis=0)
        x, y = points[:, 0, None], points[:, 1, None]
        spans = (a[:, 1] > y) != (b[:, 1] > y)
        rise = np.where(b[:, 1] == a[:, 1], 1.0, b[:, 1] - a[:, 1])
        crossing = a[:, 0] + (y - a[:, 1]) * (b[:, 0] - a[:, 0]) / rise
        inside: Mask = (spans & (x < crossing)).sum(axis=1) % 2 == 1
        return inside


@dataclass(frozen=True)
class Label:
    """Pixels of a labels image that hold one value: ``labels`` [depth, lateral] of integers on ``grid`` (nearest pixel)."""

    labels: NDArray[np.integer] = field(repr=False)
    grid: RegularGrid
    value: int

    def __post_init__(self) -> None:
        if self.labels.shape != self.grid.shape[::-1] or not np.issubdtype(self.labels.dtype, np.integer):
            raise InputError(
                f"labels must be integers of shape {self.grid.shape[::-1]} (rows, columns); "
                f"got {self.labels.dtype} of {self.labels.shape}"
            )

    def contains(self, points: Floats) -> Mask:
        """Test which points have this label; none outside the image."""
        _refuse_other(points, 2, "a labels image", "labels of a volume")
        ix, iy = np.rint(self.grid.to_index(points)).astype(np.intp).T
        nx, ny = self.grid.shape
        within = (ix >= 0) & (ix < nx) & (iy >= 0) & (iy < ny)
        inside: Mask = within & (self.labels[np.clip(iy, 0, ny - 1), np.clip(ix, 0, nx - 1)] == self.value)
        return inside


@dataclass(frozen=True)
class Sphere:
    """A round lesion in space: ``centre`` (x, y, z) and ``radius`` in mm."""

    centre: tuple[float, float, float]
    radius: float

    def __post_init__(self) -> None:
        as_points(self.centre, "centre of a sphere", 3)
        if not (np.isfinite(self.radius) and self.radius > 0):
            raise InputError(f"radius of a sphere must be a positive number in mm; got {self.radius}")

    def contains(self, points: Floats) -> Mask:
        """Test which points lie within the radius."""
        _refuse_other(points, 3, "a sphere", "a circle")
        inside: Mask = np.linalg.norm(points - self.centre, axis=1) <= self.radius
        return inside


@dataclass(frozen=True)
class Box:
    """Everything between two corners in space: ``low`` and ``high`` (x, y, z) in mm, faces included."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __post_init__(self) -> None:
        low, high = as_points(self.low, "low corner", 3)[0], as_points(self.high, "high corner", 3)[0]
        if not (low < high).all():
            raise InputError(f"a box spans from a lower to a higher corner; got {self.low} to {self.high} mm")

    def contains(self, points: Floats) -> Mask:
        """Test which points lie between the corners."""
        _refuse_other(points, 3, "a box", "a polygon")
        inside: Mask = np.logical_and.reduce((points >= self.low) & (points <= self.high), axis=1)
        return inside


@dataclass(frozen=True)
class VolumeLabel:
    """Voxels of a labels volume that hold one value: ``labels`` [z, y, x] of integers on ``grid`` (nearest voxel)."""

    labels: NDArray[np.integer] = field(repr=False)
    grid: SpatialGrid
    value: int

    def __post_init__(self) -> None:
        if self.labels.shape != self.grid.shape[::-1] or not np.issubdtype(self.labels.dtype, np.integer):
            raise InputError(
                f"labels of a volume must be integers of shape {self.grid.shape[::-1]} (z, y, x); "
                f"got {self.labels.dtype} of {self.labels.shape}"
            )

    def contains(self, points: Floats) -> Mask:
        """Test which points have this label; none outside the volume."""
        _refuse_other(points, 3, "labels of a volume", "a labels image")
        index = np.rint((points - self.grid.origin) / self.grid.spacing).astype(np.intp)
        within = ((index >= 0) & (index < self.grid.shape)).all(axis=1)
        x, y, z = np.clip(index, 0, np.subtract(self.grid.shape, 1)).T
        inside: Mask = within & (self.labels[z, y, x] == self.value)
        return inside


@dataclass(frozen=True)
class Extruded:
    """A shape of the plane continued along z: everything whose (x, y + ``surface``) lies in it."""

    shape: Shape
    surface: float = 0.0

    def contains(self, points: Floats) -> Mask:
        """Test which points (n, 3) belong to it."""
        _refuse_other(points, 3, "an extruded shape", "the shape itself")
        return self.shape.contains(points[:, :2] + [0.0, self.surface])


@dataclass(frozen=True)
class Region:
    """Part of the tissue that differs: its shape, Young's modulus (kPa), Poisson's ratio and name.

    A fluid (urine, blood) is as soft as its modulus says, but the needle's forces are not spread so wide that it alone would bear them.
    """

    shape: Shape
    young: float
    poisson: float = 0.45
    name: str = ""
    fluid: bool = False

    def __post_init__(self) -> None:
        _check(self.young, self.poisson, f"region {self.name!r}" if self.name else "a region")


@dataclass(frozen=True)
class Tissue:
    """A slab of tissue, homogeneous but for its regions.

    Parameters
    ----------
    young : float
        Young's modulus E of the background, kPa.
    poisson : float
        Poisson's ratio nu of the background.
    regions : sequence of Region
        Each lies on top of those before it.
    thickness : float
        Across the imaging plane, mm; a force in newtons is spread over it.
    plane : {"stress", "strain"}
        "stress" (equation (19)) lets the slab bulge out of the plane, "strain" does not.

    Raises
    ------
    InputError
        If a number is out of its range.
    """

    young: float = 10.0
    poisson: float = 0.45
    regions: Sequence[Region] = ()
    thickness: float = 40.0
    plane: Literal["stress", "strain"] = "stress"

    def __post_init__(self) -> None:
        _check(self.young, self.poisson, "the tissue")
        if not (np.isfinite(self.thickness) and self.thickness > 0):
            raise InputError(f"thickness of the tissue must be a positive number in mm; got {self.thickness}")
        if self.plane not in ("stress", "strain"):
            raise InputError(f'plane is "stress" or "strain"; got {self.plane!r}')
        object.__setattr__(self, "regions", tuple(self.regions))

    @property
    def homogeneous(self) -> bool:
        """Whether no region differs from the background."""
        return all((r.young, r.poisson) == (self.young, self.poisson) for r in self.regions)

    def at(self, points: ArrayLike) -> tuple[Floats, Floats]:
        """Return Young's modulus (kPa) and Poisson's ratio at points (n, 2), in space (n, 3), in mm, each of shape (n,).

        Raises
        ------
        InputError
            If a region is one of the plane and the points lie in space, or the other way round.
        """
        p = as_points(points, dimension=3 if np.shape(points)[-1:] == (3,) else 2)
        young, poisson = np.full(len(p), float(self.young)), np.full(len(p), float(self.poisson))
        for region in self.regions:
            inside = region.shape.contains(p)
            young[inside], poisson[inside] = region.young, region.poisson
        return young, poisson

    def in_cells(self, grid: RegularGrid, samples: int = 4) -> tuple[Floats, Floats]:
        """Return Young's modulus (kPa) and Poisson's ratio per mesh cell, x fastest, each of shape ((nx-1) (ny-1),).

        A cell that a boundary crosses gets the mean compliance over ``samples`` x ``samples`` points: the harmonic mean of
        the moduli, the least stiffness that the cell can have (Reuss). `mechanics.cut_cells` adds what it has beyond that.
        """
        cells = (grid.shape[0] - 1) * (grid.shape[1] - 1)
        if self.homogeneous:
            return np.full(cells, float(self.young)), np.full(cells, float(self.poisson))
        young, poisson = self.sampled(grid, np.arange(cells), samples)
        E = 1.0 / (1.0 / young).mean(axis=1)
        whole = (young == young[:, :1]).all(axis=1)
        return np.where(whole, young[:, 0], E), np.where(
            (poisson == poisson[:, :1]).all(axis=1), poisson[:, 0], E * (poisson / young).mean(axis=1)
        )

    def sampled(self, grid: RegularGrid, cells: NDArray[np.intp], samples: int) -> tuple[Floats, Floats]:
        """Return Young's modulus (kPa) and Poisson's ratio at ``samples`` x ``samples`` points of some cells.

        The points are the middles of equal parts of a cell, x fastest; each result has shape (cells, samples^2).
        """
        part = (np.arange(samples) + 0.5) / samples
        within = np.stack(np.meshgrid(part, part), axis=-1).reshape(-1, 2)
        first = np.stack(np.divmod(cells, grid.shape[0] - 1)[::-1], axis=-1)
        young, poisson = self.at(grid.to_mm((first[:, None] + within).reshape(-1, 2)))
        shape = (len(cells), samples**2)
        return young.reshape(shape), poisson.reshape(shape)


def _check(young: float, poisson: float, owner: str) -> None:
    if not (np.isfinite(young) and young > 0):
        raise InputError(f"Young's modulus of {owner} must be a positive number in kPa; got {young}")
    if not -1 < poisson <= 0.5:
        raise InputError(f"Poisson's ratio of {owner} must lie in (-1, 0.5]; got {poisson}")


def _refuse_other(points: Floats, dimension: int, shape: str, instead: str) -> None:
    """Refuse points of the other dimension."""
    if points.shape[1] != dimension:
        here, there = ("the plane", "space") if dimension == 2 else ("space", "the plane")
        raise InputError(f"{shape} lies in {here}, and this tissue in {there}: use {instead} or a layer")
