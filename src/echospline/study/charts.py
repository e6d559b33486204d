"""Figures of studies and identifications, on the canvas of `picture.summary`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from echospline.picture.summary import MAP, NEEDLE, save
from echospline.scene import Floats, NeedlePose, RegularGrid, UltrasoundImage, distance

COLOURS = {"fem": "#000000", "tps": "#0072B2", "green": "#009E73"}
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "h")
BARS = ("#0072B2", "#56B4E9", "#E69F00", "#F0E442", "#009E73", "#CC79A7")


def save_both(figure: Figure, stem: Path) -> None:
    """Write ``stem.png`` and ``stem.svg``."""
    for suffix in (".png", ".svg"):
        save(figure, stem.with_suffix(suffix))


def error_map(points: Floats, error: Floats, stem: Path, title: str) -> None:
    """Draw the mean error of an identified field at the observed points (n, 2) in mm; untracked points (nan) are left out."""
    figure = Figure(figsize=(6.4, 4.8), layout="constrained")
    axes = figure.subplots()
    known = np.isfinite(error)
    dots = axes.scatter(
        points[known, 0], points[known, 1], c=error[known], cmap=MAP, s=14, marker="s", rasterized=True
    )
    _in_mm(axes, title)
    axes.invert_yaxis()
    figure.colorbar(dots, ax=axes, label="mean error over frames, mm")
    save_both(figure, stem)


def fields_and_images(
    grid: RegularGrid,
    fields: Mapping[str, Floats],
    reference: str,
    images: Mapping[str, UltrasoundImage],
    pose: NeedlePose,
    stem: Path,
) -> None:
    """Draw the paper's Fig. 2: the field of each model, its distance to the reference, and the deformed images.

    Parameters
    ----------
    grid : RegularGrid
        The mesh.
    fields : mapping of str to ndarray, shape (n, 2)
        Displacement by model, mm; ``reference`` among them.
    reference : str
        Name of the field to compare with.
    images : mapping of str to UltrasoundImage
        The image at rest and deformed by each model.
    pose : NeedlePose
        Of the needle.
    stem : Path
        Without suffix.
    """
    others = [name for name in fields if name != reference]
    columns = max(len(fields), len(images))
    figure = Figure(figsize=(4.4 * columns, 10.4), layout="constrained")
    axes = figure.subplots(3, columns, squeeze=False)
    truth = fields[reference]
    largest = max(float(distance(u, 0 * u).max()) for u in fields.values())
    errors = {name: distance(fields[name], truth) for name in others}
    worst = max(float(e.max()) for e in errors.values())
    for place, (name, u) in zip(axes[0], fields.items(), strict=False):
        colours = _map(place, grid, distance(u, 0 * u), largest, f"{name}: displacement")
        _mesh(place, grid, u)
        _needle(place, pose)
    figure.colorbar(colours, ax=axes[0], label="mm", shrink=0.8)
    for place, (name, e) in zip(axes[1], errors.items(), strict=False):
        shown = e[distance(truth, 0 * truth) > 0]
        colours = _map(place, grid, e, worst, f"{name} less {reference}: mean {shown.mean():.3f} mm")
        _needle(place, pose)
    figure.colorbar(colours, ax=axes[1], label="distance of nodes, mm", shrink=0.8)
    for place, (name, image) in zip(axes[2], images.items(), strict=False):
        x0, x1, y0, y1 = image.grid.extent
        place.imshow(image.pixels, cmap="gray", extent=(x0, x1, y1, y0), interpolation="antialiased")
        _needle(place, pose)
        _in_mm(place, name)
    for row, used in zip(axes, (len(fields), len(errors), len(images)), strict=True):
        for place in row[used:]:
            place.set_visible(False)
    save_both(figure, stem)


def accuracy_bars(groups: Sequence[tuple[str, Sequence[Mapping[str, Any]]]], stem: Path) -> None:
    """Draw the paper's Fig. 3a: MAE (solid) and RMSE (outline) per modulus, one panel per reading of the moduli.

    Parameters
    ----------
    groups : sequence of (title, rows)
        Rows carry ``label`` (the modulus), ``method``, ``mae_mm`` and ``rmse_mm``.
    stem : Path
        Without suffix.
    """
    figure = Figure(figsize=(6.4 * len(groups), 4.8), layout="constrained")
    panels = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
    for axes, (title, rows) in zip(panels, groups, strict=True):
        labels = list(dict.fromkeys(row["label"] for row in rows))
        methods = list(dict.fromkeys(row["method"] for row in rows))
        width = 0.8 / len(methods)
        for i, method in enumerate(methods):
            own = {row["label"]: row for row in rows if row["method"] == method}
            x = np.arange(len(labels)) + (i - (len(methods) - 1) / 2) * width
            colour = BARS[i % len(BARS)]
            axes.bar(x, [own[n]["mae_mm"] for n in labels], width * 0.9, color=colour, label=method)
            axes.bar(x, [own[n]["rmse_mm"] for n in labels], width * 0.9, fill=False, edgecolor=colour)
        axes.set_xticks(range(len(labels)), labels)
        axes.set_yscale("log")
        axes.set_title(title, fontsize=11)
        axes.set_xlabel("Young's modulus")
        axes.grid(axis="y", alpha=0.3)
    panels[0].set_ylabel("error on held-out insertions, mm\nsolid MAE, outline RMSE")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    save_both(figure, stem)


def speed_lines(rows: Sequence[Mapping[str, Any]], stem: Path) -> None:
    """Draw the paper's Fig. 3b: median time per step against nodes, one line per method."""
    figure = Figure(figsize=(10.5, 5.6), layout="constrained")
    axes = figure.subplots()
    for i, method in enumerate(dict.fromkeys(row["method"] for row in rows)):
        own = [row for row in rows if row["method"] == method]
        family = own[0]["family"]
        axes.loglog(
            [row["nodes"] for row in own],
            [row["cpu_median_ms"] for row in own],
            marker=MARKERS[i % len(MARKERS)],
            linestyle={"fem": "-", "tps": "--", "green": ":"}[family],
            color=COLOURS[family],
            label=method,
        )
    axes.axvspan(500, 4500, color="#000000", alpha=0.05, label="the paper's range")
    axes.axhline(1000 / 30, color=NEEDLE, linewidth=1, label="33 ms: 30 frames per second")
    axes.set_xlabel("mesh nodes")
    axes.set_ylabel("median time per step, ms of one processor")
    axes.grid(which="both", alpha=0.2)
    figure.legend(loc="outside right upper", fontsize=8)
    save_both(figure, stem)


def _map(axes: Axes, grid: RegularGrid, values: Floats, largest: float, title: str) -> Any:
    nx, ny = grid.shape
    colours = axes.pcolormesh(
        grid.x,
        grid.y,
        values.reshape(ny, nx),
        cmap=MAP,
        vmin=0,
        vmax=largest or 1.0,
        shading="gouraud",
        rasterized=True,
    )
    _in_mm(axes, title)
    x0, x1, y0, y1 = grid.extent
    axes.set_xlim(x0, x1)
    axes.set_ylim(y1, y0)
    return colours


def _mesh(axes: Axes, grid: RegularGrid, u: Floats) -> None:
    nx, ny = grid.shape
    nodes = (grid.nodes + u).reshape(ny, nx, 2)
    for line in (*nodes, *nodes.transpose(1, 0, 2)):
        axes.plot(line[:, 0], line[:, 1], color="white", linewidth=0.35, alpha=0.6)


def _needle(axes: Axes, pose: NeedlePose) -> None:
    (ex, ey), (tx, ty) = pose.entry, pose.tip
    axes.plot([ex, tx], [ey, ty], color=NEEDLE, linewidth=2)


def _in_mm(axes: Axes, title: str) -> None:
    axes.set_title(title, fontsize=10)
    axes.set_aspect("equal")
    axes.set_xlabel("lateral, mm")
    axes.set_ylabel("depth, mm")
