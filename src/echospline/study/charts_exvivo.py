"""Figures of the ex-vivo protocol: error per depth, maps of displacement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from echospline.scene import Floats
from echospline.study.charts import save_both
from echospline.study.exvivo import Regions

COLOURS = {"tps": "C0", "elastic": "C1", "fem": "C2"}


def error_per_depth(
    depth: Sequence[float],
    fitted: Mapping[str, Floats],
    held_out: Mapping[str, Mapping[int, float]],
    tracker: Floats | None,
    stem: Path,
) -> None:
    """Draw RMSE in um against insertion depth: fitted, predicted unseen, and of the tracker where it is known."""
    figure = Figure(figsize=(8.5, 4.6), layout="constrained")
    axes = figure.subplots()
    for name, rmse in fitted.items():
        colour = COLOURS.get(name, "C4")
        axes.plot(depth, 1e3 * rmse, "o-", color=colour, label=f"{name}, fitted")
        unseen = [1e3 * held_out[name][i] for i in range(len(depth))]
        axes.plot(depth, unseen, "s--", color=colour, alpha=0.6, label=f"{name}, unseen depth")
    if tracker is not None:
        axes.plot(depth, 1e3 * tracker, "k:", label="tracker against the truth")
    axes.axhline(20.0, color="grey", lw=0.8)
    axes.text(depth[0], 20.0, "paper: 0.02 mm", fontsize=8, va="bottom", color="grey")
    axes.set(xlabel="insertion depth, mm", ylabel="RMSE over the region, um", ylim=(0.0, None))
    axes.legend(fontsize=8, ncols=2)
    save_both(figure, stem)


def motion_maps(seen: Regions, fitted: Mapping[str, Floats], stem: Path) -> None:
    """Draw axial displacement over the picture at a shallow and the largest depth: tracked, then every model."""
    chosen = (0, len(seen.frames) - 1)
    columns = {"tracked": seen.map, **fitted}
    figure = Figure(figsize=(3.6 * len(columns) + 0.8, 3.5 * len(chosen)), layout="constrained")
    axes = figure.subplots(len(chosen), len(columns), sharex=True, sharey=True, squeeze=False)
    x0, x1, y0, y1 = seen.grid.extent
    for row, i in zip(axes, chosen, strict=True):
        bound = max(float(np.nanmax(np.abs(seen.map[i, :, 1]), initial=0.0)), 1e-6)
        for ax, (name, field) in zip(row, columns.items(), strict=True):
            values = field[i, :, 1].reshape(seen.grid.shape[::-1])
            drawn = ax.imshow(values, extent=(x0, x1, y1, y0), cmap="RdBu_r", vmin=-bound, vmax=bound)
            pose = seen.poses[i]
            ax.plot(*zip(pose.entry, pose.tip, strict=True), color="black", lw=1.5)
            corner, far = seen.points[i].min(axis=0), seen.points[i].max(axis=0)
            ax.plot(
                [corner[0], far[0], far[0], corner[0], corner[0]],
                [corner[1], corner[1], far[1], far[1], corner[1]],
                "k-",
                lw=0.8,
            )
            ax.set_title(f"{name}, {pose.depth:.1f} mm deep", fontsize=10)
            ax.set_xlabel("lateral, mm")
        figure.colorbar(drawn, ax=list(row), label="axial displacement, mm")
        row[0].set_ylabel("depth, mm")
    save_both(figure, stem)
