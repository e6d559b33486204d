"""Figure of a run in space: the plane at rest and under the needle, the motion in it, three cuts, and where probe and needle are."""

from __future__ import annotations

from math import ceil, floor
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Polygon
from matplotlib.patheffects import Normal, Stroke

from echospline.picture.simulate_space import SpatialFrame
from echospline.picture.slices import CLOSE, STEP, NativeVolume, lattice_of, origins
from echospline.picture.summary import MAP, NEEDLE, save
from echospline.scene import ZERO_LENGTH, Floats, Pixels, Probe, SpatialPose, Volume

PLANE = "#56B4E9"
TISSUE = "#CC9A7B"
BODY = "#6b7680"
WIDTH = 15.0
"""Of the figure, inches."""
FINEST = 500
"""Pixels along the longer side of a cut at most."""
ARROWS = 14
"""Across the picture."""
CUTS = ((0, 1, 2), (2, 1, 0), (0, 2, 1))
"""Axes that run across and down, and the one that a cut is perpendicular to."""
AWAY = np.array([0.42, -0.30])
"""Where z points in the drawing: to the right and up, away from who looks."""
AXIS_NAMES = {"x": np.array([0.0, 1.0]), "y": np.array([-1.0, 0.0]), "z": np.array([-0.5, -0.7])}
"""Where the name of an axis stands beside its arrow."""
RIM = [Stroke(linewidth=3.0, foreground="black"), Normal()]


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
    x, y, z = (float(v) for v in volume.size)
    drawn = x + AWAY[0] * z, y - AWAY[1] * z
    # the cuts and the drawing share one scale: their columns are as wide as what they show
    columns = [x, z, x, drawn[0]]
    scale = (WIDTH - 3.2) / sum(columns)
    left, right, top, bottom = probe.grid.extent
    upper = 4.5 * min(max((bottom - top) / (right - left), 0.5), 1.4) + 0.9
    lower = min(max(scale * max(y, z, drawn[1]), 2.0), 8.0) + 0.9
    figure = Figure(figsize=(WIDTH, upper + lower + (0.4 if title else 0.0)), layout="constrained")
    if title:
        figure.suptitle(title, fontsize=13)
    halves: Any = figure.subfigures(2, 1, height_ratios=[upper, lower])
    above, below = halves
    _draw_pictures(above, probe, first, shown)
    *cuts, place = below.subplots(1, 4, width_ratios=columns)
    voxels = NativeVolume(volume)
    for axes, (across, down, through) in zip(cuts, CUTS, strict=True):
        _draw_cut(axes, volume, voxels, probe, shown, (across, down, through))
    _draw_place(place, volume, probe, shown)
    save(figure, path)


def _draw_pictures(figure: SubFigure, probe: Probe, first: SpatialFrame, shown: SpatialFrame) -> None:
    """Draw the picture at rest and under the needle, and how the tissue that it shows has moved."""
    rest, deformed, motion = figure.subplots(1, 3, sharex=True, sharey=True)
    grid = probe.grid
    (left, right, top, bottom), (dx, dy) = grid.extent, grid.spacing
    extent = (left - dx / 2, right + dx / 2, bottom + dy / 2, top - dy / 2)
    for axes, frame, name in (
        (rest, first, "The plane at rest" if first.pose.depth < ZERO_LENGTH else "The first picture"),
        (deformed, shown, f"Needle {shown.pose.depth:.1f} mm deep, {shown.time:.2f} s"),
    ):
        axes.imshow(frame.image.pixels, cmap="gray", vmin=0, vmax=255, extent=extent)
        axes.set_title(name, fontsize=11)
    rest.set(xlabel="lateral in the plane, mm", ylabel="depth in the plane, mm")
    deformed.set_xlabel(f"lateral in the plane, mm\n{_where(shown)}")
    lattice = lattice_of(probe)
    u = (shown.plane.lift(lattice.nodes) - shown.places.reshape(-1, 3)) @ shown.plane.matrix[:3, :3]
    seen = probe.sees(lattice.nodes)
    size = np.linalg.norm(u, axis=1)
    largest = float(size[seen].max(initial=0.0))
    cells = lattice.shape[::-1]
    (x0, x1, y0, y1), (hx, hy) = lattice.extent, (s / 2 for s in lattice.spacing)
    colours = motion.imshow(
        size.reshape(cells), cmap=MAP, vmin=0.0, vmax=largest or 1.0, extent=(x0 - hx, x1 + hx, y1 + hy, y0 - hy),
        interpolation="bilinear",
    )  # fmt: skip
    beams = Polygon(_outline(probe), transform=motion.transData)
    colours.set_clip_path(beams)
    figure.colorbar(colours, ax=motion, label="motion in space, mm", shrink=0.85, pad=0.02)
    out = float(np.abs(np.where(seen, u[:, 2], 0.0)).max(initial=0.0))
    motion.set_title(f"Motion of this tissue: up to {largest:.2f} mm", fontsize=11)
    said = f"lateral in the plane, mm\nup to {out:.2f} mm out of the plane"
    motion.set(xlim=extent[:2], ylim=extent[2:], aspect="equal")
    if largest > ZERO_LENGTH:
        each = max(1, ceil(max(cells) / ARROWS))
        pick = np.zeros(cells, dtype=bool)
        pick[each // 2 :: each, each // 2 :: each] = True
        pick &= (seen & (size > 0.03 * largest)).reshape(cells)
        longer = 1.5 * each * lattice.spacing[0] / largest
        at, moved = lattice.nodes[pick.ravel()], u[pick.ravel()]
        motion.quiver(
            at[:, 0], at[:, 1], moved[:, 0], moved[:, 1], angles="xy", scale_units="xy", scale=1 / longer,
            color="white", edgecolor="black", linewidth=0.4, width=0.005,
        )  # fmt: skip
        said += f"; arrows {longer:.1f} times as long"
    motion.set_xlabel(said)


def _where(frame: SpatialFrame) -> str:
    """Say in words where the needle is to the plane."""
    entry, tip = (float(p[2]) for p in frame.pose.seen_from(frame.plane))
    if max(abs(entry), abs(tip)) < 0.05:
        return "the needle lies in the plane"

    def side(z: float) -> str:
        return "in" if abs(z) < 0.05 else f"{abs(z):.1f} mm {'before' if z < 0 else 'behind'}"

    return f"tip {side(tip)}, entry {side(entry)} the plane"


def _draw_cut(
    axes: Axes,
    volume: Volume,
    voxels: NativeVolume,
    probe: Probe,
    frame: SpatialFrame,
    directions: tuple[int, int, int],
) -> None:
    """Draw the tissue as it lies now in a cut through the tip, with the needle and the plane of the picture."""
    across, down, through = directions
    low, size = np.array(volume.origin), np.array(volume.size)
    at = float(np.clip(frame.pose.tip[through], low[through], low[through] + size[through]))
    pixels, pixel = _cut(volume, voxels, frame, directions, at)
    rows, columns = pixels.shape
    axes.imshow(
        pixels, cmap="gray", vmin=0, vmax=255,
        extent=(
            low[across] - pixel / 2, low[across] + (columns - 0.5) * pixel,
            low[down] + (rows - 0.5) * pixel, low[down] - pixel / 2,
        ),
    )  # fmt: skip
    outline = frame.plane.lift(_outline(probe))
    for piece in _met(outline, through, at, max(probe.elevation, 0.1)):
        axes.plot(
            piece[:, across], piece[:, down], color=PLANE, lw=1.5, path_effects=RIM, solid_capstyle="butt"
        )
    ends = np.array([frame.pose.entry, frame.pose.tip])
    axes.plot(ends[:, across], ends[:, down], color=NEEDLE, lw=1.5, path_effects=RIM, solid_capstyle="round")
    axes.plot(*ends[1, [across, down]], "o", color=NEEDLE, markersize=5, markeredgecolor="black")
    axes.set_xlim(low[across] - pixel / 2, low[across] + size[across] + pixel / 2)
    axes.set_ylim(low[down] + size[down] + pixel / 2, low[down] - pixel / 2)
    names = "xyz"
    axes.set_title(f"Cut at {names[through]} = {at:.1f} mm", fontsize=11)
    axes.set(xlabel=f"{names[across]}, mm", ylabel=f"{names[down]}, mm", aspect="equal")


def _cut(
    volume: Volume, voxels: NativeVolume, frame: SpatialFrame, directions: tuple[int, int, int], at: float
) -> tuple[Pixels, float]:
    """Return the deformed tissue in a cut, and the size of its pixels in mm."""
    across, down, through = directions
    low, size = np.array(volume.origin), np.array(volume.size)
    pixel = max(min(volume.spacing), float(max(size[across], size[down])) / FINEST)
    columns, rows = (floor(size[k] / pixel + 1e-9) + 1 for k in (across, down))
    shape = ceil((rows - 1) / STEP) + 1, ceil((columns - 1) / STEP) + 1
    places = np.full((*shape, 3), at)
    places[:, :, across] = low[across] + STEP * pixel * np.arange(shape[1])
    places[:, :, down] = low[down] + STEP * pixel * np.arange(shape[0])[:, None]
    origin, _, _ = origins(places.reshape(-1, 3), frame.motion, CLOSE * pixel)
    pixels, _ = voxels.slice(origin.reshape(places.shape), (columns, rows), STEP, np.eye(3)[through])
    return pixels, pixel


def _outline(probe: Probe) -> Floats:
    """Return the closed outline (n, 2) of what a probe sees, in its plane, mm."""
    if probe.shape == "linear":
        half, depth = probe.width / 2, probe.depth
        return np.array([[-half, 0.0], [half, 0.0], [half, depth], [-half, depth], [-half, 0.0]])
    angle = np.radians(np.linspace(-probe.opening / 2, probe.opening / 2, 41))
    arc = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    face, far = probe.radius * arc, (probe.radius + probe.depth) * arc[::-1]
    return np.concatenate([face, far, face[:1]]) - [0.0, probe.radius]


def _met(outline: Floats, axis: int, at: float, thickness: float) -> list[Floats]:
    """Return the pieces (m, 3) of a flat outline (n, 3) where a coordinate has a value; all of it if it lies there within the slice's thickness."""
    off = outline[:, axis] - at
    if np.abs(off).max() < thickness:
        return [outline]
    a, b = off[:-1], off[1:]
    crosses = (a < 0) != (b < 0)
    share = (a[crosses] / (a[crosses] - b[crosses]))[:, None]
    points = outline[:-1][crosses] * (1 - share) + outline[1:][crosses] * share
    if len(points) < 2:
        return []
    furthest = points[np.linalg.norm(points - points[0], axis=1).argmax()] - points[0]
    along = points[
        np.argsort(points @ furthest)
    ]  # a sector's face is hollow: the line may leave and enter again
    return [along[k : k + 2] for k in range(0, len(along) - 1, 2)]


def _flat(points: Floats) -> Floats:
    """Project points (n, 3) for the drawing, shape (n, 2)."""
    flat: Floats = points[:, :2] + points[:, 2:] * AWAY
    return flat


def _draw_place(axes: Any, volume: Volume, probe: Probe, frame: SpatialFrame) -> None:
    """Draw tissue, probe, plane and needle, seen obliquely: what is behind the plane is drawn before it and faint."""
    low = np.array(volume.origin)
    size = np.array(volume.size)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    skin = low + np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]]) * size
    axes.add_patch(Polygon(_flat(skin), facecolor=TISSUE, alpha=0.35, edgecolor="none"))
    for a in range(8):
        for b in range(a + 1, 8):
            if np.abs(corners[a] - corners[b]).sum() == 1:
                hidden = any((corners[k] == (0, 1, 1)).all() for k in (a, b))
                edge = _flat(low + corners[[a, b]] * size)
                axes.plot(*edge.T, color="#888888", lw=0.8, ls=":" if hidden else "-")
    behind, before = _parts(frame.pose, frame)
    entry, tip = np.array(frame.pose.entry), np.array(frame.pose.tip)
    clear = bool(before) and _nearer(entry[None], frame)[0] > _thickness(probe)
    for parts, alpha, order in ((behind, 0.55, 2.1), (before, 1.0, 2.6 if clear else 2.3)):
        for part in parts:
            axes.plot(*_flat(part).T, color=NEEDLE, lw=2.2, alpha=alpha, solid_capstyle="butt", zorder=order)
    seen = _flat(frame.plane.lift(_outline(probe)))
    axes.add_patch(Polygon(seen, facecolor=PLANE, alpha=0.35, edgecolor=PLANE, lw=1.5, zorder=2.2))
    body = _flat(
        _body(probe, 0.22 * float(size.max())) @ frame.plane.matrix[:3, :3].T + frame.plane.matrix[:3, 3]
    )
    axes.add_patch(Polygon(_hull(body), facecolor=BODY, alpha=0.9, edgecolor="black", lw=0.8, zorder=2.5))
    if frame.pose.depth >= ZERO_LENGTH:  # the piece outside, up to the other hand
        hand = np.array([entry, entry - 0.3 * float(size.max()) * np.array(frame.pose.axis)])
        axes.plot(*_flat(hand).T, color=NEEDLE, lw=1.2, zorder=2.6 if clear else 2.4)
    axes.plot(*_flat(tip[None])[0], "o", color=NEEDLE, markersize=5, markeredgecolor="black", zorder=2.7)
    corner = _flat(low[None])[0]
    for name, unit in zip("xyz", np.eye(3), strict=True):
        to = _flat((low + 0.16 * float(size.max()) * unit)[None])[0]
        axes.annotate("", to, corner, arrowprops={"arrowstyle": "->", "lw": 1.2, "shrinkA": 0, "shrinkB": 0})
        axes.annotate(name, to + 0.04 * size.max() * AXIS_NAMES[name], ha="center", va="center", fontsize=9)
    axes.set_aspect("equal")
    axes.invert_yaxis()
    axes.set_title("Probe, plane and needle", fontsize=11)
    axes.set_axis_off()


def _thickness(probe: Probe) -> float:
    """Return half the thickness of the drawn probe's body, mm: it is drawn a quarter as thick as the picture is wide."""
    return 0.25 * float(np.ptp(_outline(probe)[:, 0])) / 2


def _body(probe: Probe, tall: float) -> Floats:
    """Return the corners (n, 3) of the probe's body in its own frame, mm: from its face upwards, narrower towards the cable."""
    outline, thick = _outline(probe), _thickness(probe)
    face = outline[: 2 if probe.shape == "linear" else len(outline) // 2]
    half, top = float(np.abs(face[:, 0]).max()), float(face[:, 1].min())
    shoulders = np.array([[-half, top - 0.6 * tall], [half, top - 0.6 * tall]])
    cable = np.array([[-0.55 * half, top - tall], [0.55 * half, top - tall]])
    pieces = [(face, 1.0), (shoulders, 1.0), (cable, 0.55)]
    return np.concatenate(
        [
            np.column_stack([xy, np.full(len(xy), side * w * thick)])
            for xy, w in pieces
            for side in (-1.0, 1.0)
        ]
    )


def _nearer(points: Floats, frame: SpatialFrame) -> Floats:
    """Return how far points (n, 3) are from the picture's plane, mm: positive on the side from which the drawing is seen."""
    normal = frame.plane.matrix[:3, 2]
    # the projection is seen along a line on which a point nearer by one in z is shifted back by AWAY
    eye = np.array([AWAY[0], AWAY[1], -1.0])
    off: Floats = (points - frame.plane.matrix[:3, 3]) @ normal * (1.0 if normal @ eye >= 0 else -1.0)
    return off


def _parts(pose: SpatialPose, frame: SpatialFrame) -> tuple[list[Floats], list[Floats]]:
    """Return the pieces of a needle behind the plane, as the drawing is seen, and before it."""
    ends = np.array([pose.entry, pose.tip])
    off = _nearer(ends, frame)
    if (off >= -1e-6).all():
        return [], [ends]
    if (off <= 1e-6).all():
        return [ends], []
    middle = ends[0] + off[0] / (off[0] - off[1]) * (ends[1] - ends[0])
    first, second = np.array([ends[0], middle]), np.array([middle, ends[1]])
    return ([first], [second]) if off[0] < 0 else ([second], [first])


def _hull(points: Floats) -> Floats:
    """Return the convex outline of points (n, 2)."""
    order = points[np.lexsort((points[:, 1], points[:, 0]))]

    def chain(row: Floats) -> list[Floats]:
        kept: list[Floats] = []
        for p in row:
            while len(kept) > 1:
                (ax, ay), (bx, by) = kept[-1] - kept[-2], p - kept[-2]
                if ax * by - ay * bx > 0:
                    break
                kept.pop()
            kept.append(p)
        return kept[:-1]

    return np.array(chain(order) + chain(order[::-1]))
