"""Figures of a simulation (the only importer of matplotlib). Colours tell apart for every eye (Okabe and Ito; cividis)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patheffects import Normal, Stroke
from numpy.typing import NDArray

from echospline.atomic import appearing
from echospline.errors import InputError
from echospline.scene import Floats, NeedlePose, RegularGrid, UltrasoundImage

NEEDLE = "#E69F00"
MESH = "#56B4E9"
MAP = "cividis"
FORMATS = (".png", ".svg", ".pdf")
_DATE = {"svg": "Date", "pdf": "CreationDate"}
_MOST_LINES = 41
"""Mesh lines drawn each way; of a finer mesh every k-th line is shown, and the figure says so."""
_MOST_ARROWS = 18
_MOST_CELLS = 20_000_000
_MOVED = 1e-6
"""mm; below this nothing is called displaced."""


def summary_figure(
    first: UltrasoundImage,
    last: UltrasoundImage,
    mesh: RegularGrid,
    displacement: Floats,
    pose: NeedlePose,
    path: str | Path,
    *,
    title: str = "",
) -> None:
    """Draw one run into a file: `draw_summary`, then `save`.

    Parameters
    ----------
    first, last, mesh, displacement, pose, title
        As for `draw_summary`.
    path : str or Path
        ``.png``, ``.svg`` or ``.pdf``.

    Raises
    ------
    InputError
        If something does not fit, the suffix is another, or the file cannot be written.
    """
    save(draw_summary(first, last, mesh, displacement, pose, title=title), path)


def draw_summary(
    first: UltrasoundImage,
    last: UltrasoundImage,
    mesh: RegularGrid,
    displacement: Floats,
    pose: NeedlePose,
    *,
    title: str = "",
) -> Figure:
    """Draw the image at rest, the last image with the deformed mesh, and the displacement, side by side in mm.

    Parameters
    ----------
    first, last : UltrasoundImage
        First and last frame, on one grid.
    mesh : RegularGrid
        Nodes at rest, mm.
    displacement : ndarray, shape (n, 2)
        Of the nodes in the last frame, mm.
    pose : NeedlePose
        The needle in the last frame.
    title : str
        One line above all.

    Returns
    -------
    Figure
        Needs no display.

    Raises
    ------
    InputError
        If the displacement does not fit the mesh or the images differ in grid.
    """
    displacement = np.asarray(displacement, dtype=np.float64)
    if displacement.shape != (mesh.size, 2) or not np.isfinite(displacement).all():
        raise InputError(
            f"displacement must be finite, of shape {(mesh.size, 2)} in mm; got {displacement.shape}"
        )
    if first.grid != last.grid:
        raise InputError("first and last frame must lie on one grid; got two")
    left, right, top, bottom = _edges(first.grid)
    height = 4.4 * min(max((bottom - top) / (right - left), 0.4), 1.6)
    figure = Figure(figsize=(15.0, height + (1.35 if title else 1.0)), layout="constrained")
    if title:
        figure.suptitle(title, fontsize=13)
    rest, deformed, field = figure.subplots(1, 3, sharex=True, sharey=True)
    shades = float(first.pixels.min()), float(first.pixels.max())
    _draw_image(rest, first, "At rest", shades)
    _draw_image(deformed, last, f"Needle {pose.depth:.1f} mm deep", shades)
    step = _draw_mesh(deformed, mesh, displacement)
    _draw_needle(deformed, pose, 1.2)
    _draw_displacement(figure, field, mesh, displacement, pose)
    every = f", every {step}th line drawn" if step > 1 else ""
    deformed.set_xlabel(f"lateral, mm\nmesh {mesh.shape[0]} x {mesh.shape[1]}{every}")
    rest.set_ylabel("depth, mm")
    rest.set_xlim(left, right)
    rest.set_ylim(bottom, top)
    return figure


def tracking_figure(
    grey: NDArray[np.uint8],
    grid: RegularGrid,
    points: Floats,
    displacement: Floats,
    confidence: Floats,
    path: str | Path,
    *,
    pose: NeedlePose | None = None,
    title: str = "",
) -> None:
    """Draw tracked motion: arrows over the first picture, the axial displacement, the confidence.

    Parameters
    ----------
    grey : ndarray, shape (rows, columns)
        The first frame.
    grid : RegularGrid
        Its pixel centres, mm.
    points, displacement, confidence : ndarray, shapes (n, 2), (n, 2), (n,)
        Tracked points, mm; arrows are drawn where the confidence is 0.3 or more.
    path : str or Path
        ``.png``, ``.svg`` or ``.pdf``.
    pose : NeedlePose, optional
        The needle.
    title : str
        One line above all.
    """
    left, right, top, bottom = _edges(grid)
    height = 4.4 * min(max((bottom - top) / (right - left), 0.4), 1.6)
    figure = Figure(figsize=(15.0, height + 1.35), layout="constrained")
    figure.suptitle(title, fontsize=13)
    arrows, axial, trust = figure.subplots(1, 3, sharex=True, sharey=True)
    _draw_image(arrows, UltrasoundImage(grey, grid), "Tracked displacement", (0.0, 255.0))
    trusted = confidence >= 0.3
    thin = np.zeros(len(points), dtype=bool)
    thin[_spread(points, (right - left) / 24.0)] = True
    p, u = points[thin & trusted], displacement[thin & trusted]
    largest = float(np.hypot(*displacement[trusted].T).max(initial=0.0))
    # the longest arrow takes a tenth of the width
    scale = 0.1 * (right - left) / largest if largest > _MOVED else 1.0
    arrows.quiver(
        p[:, 0], p[:, 1], scale * u[:, 0], scale * u[:, 1],
        angles="xy", scale_units="xy", scale=1.0, color="gold", width=0.003,
    )  # fmt: skip
    arrows.set_xlabel(f"lateral, mm; arrows {scale:.1f} times as long as the motion")
    arrows.set_ylabel("depth, mm")
    bound = max(float(np.abs(displacement[trusted, 1]).max(initial=0.0)), _MOVED)
    for axes, values, name, colours, low, high in (
        (
            axial,
            np.where(trusted, displacement[:, 1], np.nan),
            "axial displacement, mm",
            "RdBu_r",
            -bound,
            bound,
        ),
        (trust, confidence, "confidence", "viridis", 0.0, 1.0),
    ):
        drawn = _draw_cells(axes, points, values, colours, (low, high))
        figure.colorbar(drawn, ax=axes, label=name)
        axes.set(aspect="equal", title=name.split(",", maxsplit=1)[0].capitalize(), xlabel="lateral, mm")
    if pose is not None and pose.depth > 0:
        for axes in (arrows, axial, trust):
            _draw_needle(axes, pose, 1.2)
    arrows.set_xlim(left, right)
    arrows.set_ylim(bottom, top)
    save(figure, path)


def _draw_cells(axes: Axes, points: Floats, values: Floats, colours: str, limits: tuple[float, float]) -> Any:
    """Colour the cell around every point, cell touching cell; points that are on no lattice become dots."""
    low, high = limits
    sides = [np.unique(np.round(points[:, i], 9)) for i in (0, 1)]
    pitch = [float(np.diff(side).min()) if len(side) > 1 else 1.0 for side in sides]
    origin = np.array([side[0] for side in sides])
    index = np.rint((points - origin) / pitch).astype(int)
    columns, rows = index.max(axis=0) + 1
    off = np.abs(points - origin - index * pitch).max(initial=0.0)
    if off > 0.05 * min(pitch) or columns * rows > _MOST_CELLS:
        return axes.scatter(
            points[:, 0], points[:, 1], c=values, s=6, marker="s", cmap=colours, vmin=low, vmax=high, linewidths=0
        )  # fmt: skip
    cells = np.full((rows, columns), np.nan)
    cells[index[:, 1], index[:, 0]] = values
    (x0, y0), (dx, dy) = origin, pitch
    return axes.imshow(
        cells, cmap=colours, vmin=low, vmax=high, interpolation="nearest",
        extent=(x0 - dx / 2, x0 + (columns - 0.5) * dx, y0 + (rows - 0.5) * dy, y0 - dy / 2),
    )  # fmt: skip


def _spread(points: Floats, step: float) -> NDArray[np.intp]:
    """Indices of points of which one lies in every square of side ``step``."""
    cells = np.floor(points / step).astype(int)
    return np.unique(cells, axis=0, return_index=True)[1]


def save(figure: Figure, path: str | Path, *, dpi: int = 130) -> None:
    """Write a figure under a temporary name, then give it its own.

    Parameters
    ----------
    figure : Figure
        Needs no display.
    path : str or Path
        ``.png``, ``.svg`` or ``.pdf``.
    dpi : int
        Dots per inch of the PNG and of pictures inside of SVG and PDF.

    Raises
    ------
    InputError
        If the suffix is another or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"a figure is written as {', '.join(FORMATS)}; got {path.name!r}")
    FigureCanvasAgg(figure)
    with appearing(path) as part:
        kind = path.suffix.lower()[1:]
        # Without a date in it, the same run gives the same file.
        figure.savefig(part, format=kind, dpi=dpi, metadata={_DATE[kind]: None} if kind in _DATE else None)


def _edges(grid: RegularGrid) -> tuple[float, float, float, float]:
    """Outer edges (left, right, top, bottom) of the pixels in mm: half a pixel beyond their centres."""
    x0, x1, y0, y1 = grid.extent
    dx, dy = grid.spacing
    return x0 - dx / 2, x1 + dx / 2, y0 - dy / 2, y1 + dy / 2


def _draw_image(axes: Axes, image: UltrasoundImage, title: str, shades: tuple[float, float]) -> None:
    """Show an image in mm; both frames share one grey scale so that they compare."""
    left, right, top, bottom = _edges(image.grid)
    axes.imshow(
        image.pixels,
        cmap="gray",
        vmin=shades[0],
        vmax=shades[1],
        extent=(left, right, bottom, top),
        interpolation="antialiased",
    )
    axes.set_title(title, fontsize=11)
    axes.set_xlabel("lateral, mm")
    axes.set_aspect("equal")


def _draw_mesh(axes: Axes, mesh: RegularGrid, displacement: Floats) -> int:
    """Deformed mesh lines; returns k when only every k-th is drawn."""
    nx, ny = mesh.shape
    nodes = (mesh.nodes + displacement).reshape(ny, nx, 2)
    step = max(1, -(-(max(nx, ny) - 1) // (_MOST_LINES - 1)))
    rows = [nodes[i] for i in _every(ny, step)]
    columns = [nodes[:, i] for i in _every(nx, step)]
    axes.add_collection(LineCollection([*rows, *columns], colors=MESH, linewidths=0.5, alpha=0.65))
    return step


def _every(count: int, step: int) -> list[int]:
    return sorted({*range(0, count, step), count - 1})


def _draw_needle(axes: Axes, pose: NeedlePose, width: float = 2.0) -> None:
    """Shaft and tip, with a dark rim so that they show on bright tissue and on the map."""
    rim = [Stroke(linewidth=1.8 * width, foreground="black"), Normal()]
    (ex, ey), (tx, ty) = pose.entry, pose.tip
    axes.plot([ex, tx], [ey, ty], color=NEEDLE, linewidth=width, solid_capstyle="round", path_effects=rim)
    axes.plot([tx], [ty], "o", color=NEEDLE, markersize=5, markeredgecolor="black", markeredgewidth=0.8)


def _draw_displacement(
    figure: Figure, axes: Axes, mesh: RegularGrid, displacement: Floats, pose: NeedlePose
) -> None:
    nx, ny = mesh.shape
    field = displacement.reshape(ny, nx, 2)
    size = np.hypot(field[..., 0], field[..., 1])
    largest = float(size.max())
    colours = axes.pcolormesh(
        mesh.x, mesh.y, size, cmap=MAP, vmin=0.0, vmax=largest or 1.0, shading="gouraud", rasterized=True
    )
    axes.set_title(f"Displacement, largest {largest:.2f} mm", fontsize=11)
    axes.set_xlabel("lateral, mm")
    axes.set_aspect("equal")
    figure.colorbar(colours, ax=axes, label="displacement, mm", shrink=0.86, pad=0.02)
    if largest > _MOVED:
        step = max(1, -(-max(nx, ny) // _MOST_ARROWS))
        pick = np.ix_(_every(ny, step), _every(nx, step))
        x, y = np.meshgrid(mesh.x, mesh.y)
        u, v = field[..., 0][pick], field[..., 1][pick]
        shown = size[pick] > 0.03 * largest
        x0, x1, y0, y1 = mesh.extent
        spread = max(x1 - x0, y1 - y0) / _MOST_ARROWS
        magnified = 1.6 * spread / largest
        axes.quiver(
            x[pick][shown], y[pick][shown], u[shown], v[shown], angles="xy", scale_units="xy", scale=1 / magnified,
            color="white", edgecolor="black", linewidth=0.4, width=0.0045, pivot="tail", zorder=3,
        )  # fmt: skip
        axes.set_xlabel(f"lateral, mm\narrows {magnified:.1f} times as long as the motion")
    _draw_needle(axes, pose)
