"""Figure of a run in space: the plane at rest and at its deepest, three cuts through the volume, and where probe and needle are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from echospline.picture.simulate_space import SpatialFrame
from echospline.picture.summary import NEEDLE, save
from echospline.scene import Floats, Probe, Volume

PLANE = "#56B4E9"


def summary_figure_space(
    volume: Volume,
    probe: Probe,
    first: SpatialFrame,
    shown: SpatialFrame,
    path: str | Path,
    *,
    title: str = "",
) -> None:
    """Draw one run into a file.

    Parameters
    ----------
    volume : Volume
        Undeformed tissue.
    probe : Probe
        Shape of the picture.
    first, shown : SpatialFrame
        The first frame, and the one at the needle's deepest.
    path : path
        ``.png``, ``.svg`` or ``.pdf``.
    title : str
        One line above all.

    Raises
    ------
    InputError
        If the suffix is another or the file cannot be written.
    """
    figure = Figure(figsize=(15.0, 9.0), layout="constrained")
    if title:
        figure.suptitle(title, fontsize=13)
    rest, deformed, place = (figure.add_subplot(2, 3, k) for k in (1, 2, 3))
    grid = probe.grid
    x0, x1, y0, y1 = grid.extent
    for axes, frame, name in (
        (rest, first, "The plane at rest"),
        (deformed, shown, f"Needle {shown.pose.depth:.1f} mm deep, {shown.time:.2f} s"),
    ):
        axes.imshow(frame.image.pixels, cmap="gray", vmin=0, vmax=255, extent=(x0, x1, y1, y0))
        axes.set_title(name)
        axes.set_xlabel("lateral in the plane, mm")
        axes.set_ylabel("depth, mm")
    entry, tip = shown.pose.seen_from(shown.plane)
    deformed.set_xlabel(
        f"lateral in the plane, mm\nneedle's tip {abs(tip[2]):.1f} mm {'in front of' if tip[2] < 0 else 'behind'} the plane, entry {abs(entry[2]):.1f} mm"
    )
    _draw_place(place, volume, probe, shown)
    for k, axis in enumerate((2, 1, 0)):
        _draw_cut(figure.add_subplot(2, 3, 4 + k), volume, shown, axis)
    save(figure, path)


def _draw_cut(axes: Any, volume: Volume, frame: SpatialFrame, axis: int) -> None:
    """Draw the layer of voxels through the tip across an axis, with the needle."""
    names = "xyz"
    across, down = {2: (0, 1), 1: (0, 2), 0: (2, 1)}[axis]
    low, size = np.array(volume.origin), np.array(volume.size)
    at = float(np.clip(frame.pose.tip[axis], low[axis], low[axis] + size[axis]))
    k = round((at - low[axis]) / volume.spacing[axis])
    layer = volume.voxels.take(k, axis=2 - axis)
    if axis == 0:  # (z, y): z across, y down
        layer = layer.T
    half = np.array(volume.spacing) / 2
    axes.imshow(
        layer,
        cmap="gray",
        vmin=0,
        vmax=255,
        extent=(
            low[across] - half[across],
            low[across] + size[across] + half[across],
            low[down] + size[down] + half[down],
            low[down] - half[down],
        ),
    )
    ends = np.array([frame.pose.entry, frame.pose.tip])
    axes.plot(ends[:, across], ends[:, down], color=NEEDLE, lw=1.5)
    axes.set_title(f"Tissue at rest, {names[axis]} = {at:.1f} mm")
    axes.set_xlabel(f"{names[across]}, mm")
    axes.set_ylabel(f"{names[down]}, mm")


def _draw_place(axes: Any, volume: Volume, probe: Probe, frame: SpatialFrame) -> None:
    """Draw block, plane and needle from above and aside, by an oblique projection."""
    low = np.array(volume.origin)
    high = low + np.array(volume.size)

    def flat(p: Floats) -> Floats:
        q = np.atleast_2d(p)
        drawn: Floats = np.stack([q[:, 0] + 0.45 * q[:, 2], q[:, 1] - 0.3 * q[:, 2]], axis=1)
        return drawn

    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    for a in range(8):
        for b in range(a + 1, 8):
            if np.abs(corners[a] - corners[b]).sum() == 1:
                edge = flat(low + corners[[a, b]] * (high - low))
                axes.plot(*edge.T, color="#999999", lw=0.8)
    half, top, depth = probe.half_width, probe.top, probe.depth
    face = (
        probe.width / 2 if probe.shape == "linear" else probe.radius * np.sin(np.radians(probe.opening) / 2)
    )
    outline = np.array([[-face, top], [face, top], [half, depth], [-half, depth], [-face, top]])
    axes.plot(*flat(frame.plane.lift(outline)).T, color=PLANE, lw=1.8, label="plane of the picture")
    ends = np.array([frame.pose.entry, frame.pose.tip])
    axes.plot(*flat(ends).T, color=NEEDLE, lw=2.2, label="needle")
    axes.set_aspect("equal")
    axes.invert_yaxis()
    axes.set_title("Probe and needle over the tissue")
    axes.legend(loc="lower right", fontsize=8)
    axes.set_axis_off()
