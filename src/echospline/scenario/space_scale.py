"""What is looked at before a scene in space is computed: its scale, whether needle and tissue meet, and what of the scenario it cannot use."""

from __future__ import annotations

from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from echospline.errors import InputError
from echospline.scenario.scale import (
    ABSURD,
    LEAST,
    LONG_SECONDS,
    MOST,
    MOST_FRAMES,
    MOST_STEPS,
    TOUCH,
    free_bytes,
    said_bytes,
    said_time,
)
from echospline.scenario.scenario import Scenario
from echospline.scenario.space_section import SpaceSection
from echospline.scene import Floats, SpatialInsertion, Volume

FRAME = 0.013
"""s per frame, an order of magnitude: 201 frames of sample:spine took 2.7 s."""
UNUSED: dict[str, str] = {
    "image.spacing": "a volume's file says its spacing",
    "image.frame": "the whole volume is taken",
    "image.region": "the whole volume is taken",
    "mesh.nodes": "give space.mesh.nodes (--space-mesh)",
    "mesh.clamped": "give space.mesh.clamped",
    "mesh.sliding": "give space.mesh.sliding",
    "mesh.clamped_points": "give space.mesh.clamped",
    "mesh.sides": "give space.mesh.clamped and space.mesh.sliding",
    "needle.entry": "give space.needle.entry (--needle-entry)",
    "needle.angle": "give space.needle.direction (--needle-direction)",
    "needle.depth": "give space.needle.depth (--needle-depth)",
    "needle.speed": "give space.needle.speed",
    "needle.dwell": "give space.needle.dwell",
    "needle.retract": "give space.needle.retract",
    "needle.retract_speed": "give space.needle.retract_speed",
    "needle.path": "give space.needle.path",
    "tissue.thickness": "the volume is as thick as it is",
    "output.border": "outside the volume the picture is black",
}
"""Keys of scenes in the plane that a scene in space does not read, and what is said instead of them."""


def unused_doubts(scenario: Scenario) -> list[str]:
    """Return one sentence for every value that is set for a scene in the plane and that a scene in space does not read.

    Parameters
    ----------
    scenario : Scenario
        A scene in space.

    Raises
    ------
    InputError
        If the material is one of the plane.
    """
    if scenario.tissue.material != "linear":
        raise InputError(
            f'tissue.material = "{scenario.tissue.material}" is computed in the plane alone; expected "linear" in a scene in space'
        )
    plain = Scenario()
    return [
        f"{key} is of scenes in the plane, and this scene in space does not read it: {remedy}"
        for key, remedy in UNUSED.items()
        if _value(scenario, key) != _value(plain, key)
    ]


def check_space(scenario: Scenario, volume: Volume, out: Path | None = None) -> list[str]:
    """Check the scale of a run in space and return the doubts about it, one sentence each.

    Parameters
    ----------
    scenario : Scenario
        A scene in space.
    volume : Volume
        Its volume, in the scene's frame.
    out : Path, optional
        Folder that it will write into.

    Raises
    ------
    InputError
        If the volume has a size that no tissue has, the material is one of the plane, or the run needs more frames, steps or disk than there are.
    """
    space = scenario.space or SpaceSection()
    doubts = _size_doubts(volume) + unused_doubts(scenario)
    insertion = space.needle.insertion()
    doubts += needle_doubts_in_space(insertion, volume)
    doubts += _view_doubts(space, insertion)
    output, probe = scenario.output, space.probe.probe()
    planes = space.probe.planes(insertion)
    duration = max(insertion.duration, float(planes.times[-1] - insertion.times[0]))
    frames = int(duration * output.fps + 1e-9) + 1
    why = f"{duration:,.6g} s of insertion (space.needle, space.probe.path) at output.fps = {output.fps:g}"
    if frames > MOST_FRAMES:
        raise InputError(f"{why} are {frames:,} frames; expected {MOST_FRAMES:,} at most")
    steps = (frames - 1) * max(1, ceil(1.0 / output.fps / output.longest_step - 1e-9))
    if steps > MOST_STEPS:
        raise InputError(
            f"{why} in steps of output.longest_step = {output.longest_step:g} s are {steps:,} steps; expected {MOST_STEPS:,} at most"
        )
    # compressed pictures take a tenth of their pixels at least; the motion of a node in space was measured at 12 bytes and more
    needed = frames * (
        0.1 * float(np.prod(probe.grid.shape)) + 12.0 * float(np.prod(space.mesh.nodes)) * output.displacement
    )
    if out is not None and needed > (free := free_bytes(out)):
        raise InputError(
            f"the run needs {said_bytes(needed)} or more in {out}, where {said_bytes(free)} are free; {why}"
        )
    if (seconds := FRAME * frames) > LONG_SECONDS:
        doubts.append(f"a long run: {frames:,} frames, about {said_time(seconds)}; {why}")
    return doubts


def needle_doubts_in_space(insertion: SpatialInsertion, volume: Volume) -> list[str]:
    """Return the doubts about a needle's path in space: whether it meets the tissue, and whether its tip stays in it."""
    low = np.array(volume.origin)
    high = low + volume.size
    lengths = np.linalg.norm(insertion.tip - insertion.entry, axis=1)
    inside = [_inside(a, b, low, high) for a, b in zip(insertion.entry, insertion.tip, strict=True)]
    k = int(np.argmax(lengths))
    place = "the tissue, " + ", ".join(
        f"{axis} {a:.4g} to {b:.4g}" for axis, a, b in zip("xyz", low, high, strict=True)
    )
    if max(inside) < TOUCH:
        return [
            f"no more than {max(inside):.2g} mm of the needle come to lie in {place} mm, so that nothing moves: from {_point(insertion.entry[k])} "
            f"to {_point(insertion.tip[k])} mm (space.needle.entry, direction and depth)"
        ]
    if lengths[k] - inside[k] >= TOUCH and not ((low <= insertion.tip[k]) & (insertion.tip[k] <= high)).all():
        return [
            f"the needle's tip goes through {place} mm, and out of it to {_point(insertion.tip[k])} mm, where nothing is computed: give a smaller "
            "depth (space.needle.depth) or another direction"
        ]
    return []


def _view_doubts(space: SpaceSection, insertion: SpatialInsertion) -> list[str]:
    """Say where a view that was asked for does not show the needle's deepest point."""
    if space.probe.view is None or space.probe.path is not None:
        return []
    tip = insertion.tip[int(np.argmax(np.linalg.norm(insertion.tip - insertion.entry, axis=1)))]
    plane = space.probe.planes(insertion).planes[0]
    lateral, depth = plane.lower(np.array([tip]))[0][:2]
    x0, x1, y0, y1 = space.probe.probe().grid.extent
    if x0 <= lateral <= x1 and y0 <= depth <= y1:
        return []
    return [
        f"the needle's deepest point, {lateral:.4g} mm lateral and {depth:.4g} mm deep in the {space.probe.view} view, is not in the picture, which "
        f"goes from {x0:.4g} to {x1:.4g} mm and to {y1:.4g} mm: give a larger space.probe.depth or width, or a shorter needle"
    ]


def _size_doubts(volume: Volume) -> list[str]:
    if volume.spacing == (1.0, 1.0, 1.0):
        doubt = "the volume's voxels are 1 x 1 x 1 mm, which is also put where nothing is known: check the spacing in its file"
        return [doubt, *_side_doubts(volume)]
    return _side_doubts(volume)


def _side_doubts(volume: Volume) -> list[str]:
    sides = [n * h for n, h in zip(volume.shape, volume.spacing, strict=True)]
    if all(LEAST <= side <= MOST for side in sides):
        return []
    told = (
        f"the volume is {' x '.join(f'{s:,.4g}' for s in sides)} mm (x, y, z) with voxels of {' x '.join(f'{h:.4g}' for h in volume.spacing)} mm; "
        f"expected {LEAST:g} to {MOST:g} mm a side: check the spacing in its file, whose unit is mm"
    )
    if min(sides) < LEAST / ABSURD or max(sides) > MOST * ABSURD:
        raise InputError(told)
    return [told]


def _inside(entry: Floats, tip: Floats, low: Floats, high: Floats) -> float:
    """Return the length of a segment that lies inside a box, mm; its faces are not inside."""
    along = tip - entry
    first, last = 0.0, 1.0
    for a, d, least, most in zip(entry, along, low, high, strict=True):
        if abs(d) < 1e-12:
            if not least < a < most:
                return 0.0
            continue
        near, far = sorted(((least - a) / d, (most - a) / d))
        first, last = max(first, near), min(last, far)
    return max(0.0, last - first) * float(np.linalg.norm(along))


def _point(p: Floats) -> str:
    return "(" + ", ".join(f"{x:.4g}" for x in p) + ")"


def _value(scenario: Scenario, key: str) -> Any:
    value: Any = scenario
    for name in key.split("."):
        value = getattr(value, name, None)
    return value
