"""A scene has a scale: sizes, counts, memory and frames are looked at before anything is allocated or written.

The rules of every command are here. What no scene can have is refused with the number that is off; what is merely unlikely is a
doubt, one sentence, which the commands print and reports keep.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from math import atan2, ceil, degrees, hypot, inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from echospline.errors import InputError
from echospline.picture import check_border, frame_count
from echospline.scene import Floats, Insertion, RegularGrid, UltrasoundImage

if TYPE_CHECKING:
    from echospline.scenario.scenario import Scenario

PHANTOM = "sample:phantom"
"""Name of the image that is made from [phantom]."""
LEAST, MOST = 5.0, 500.0
"""mm a side: ultrasound pictures are not smaller or larger; beyond, a doubt."""
ABSURD = 10.0
"""A side that is so many times smaller or larger than that is refused: no probe makes such a picture."""
TOUCH = 0.5
"""mm of needle inside the tissue below which it moves nothing that can be seen."""
SLOW = 0.05
"""mm/s; slower insertions are unlikely, and m/s typed for mm/s."""
MOST_FRAMES, MOST_STEPS = 1_000_000, 100_000_000
"""A run of more is refused: eleven hours at 25 frames per second, hours of steps."""
LONG_SECONDS, LONG_BYTES = 60.0, 2**30
"""A run that takes longer or writes more says so before it starts."""
GIB = 2**30

_UNITS: Mapping[str, float] = {"micrometres": 1e-3, "metres": 1e3, "centimetres": 10.0}
"""Units that are typed in place of mm, and what one of them in mm is over what was meant."""
_SHARE: Mapping[str, float] = {
    "mp4": 0.1,
    "gif": 0.8,
    "png": 0.6,
    "mha": 2.0,
    "igs.mha": 2.0,
    "seq.nrrd": 2.0,
}
"""Bytes on the disk per byte of pixels: measured on B-mode; raw formats are laid out once more when they are completed."""
_FEM_BYTES = 6_500
"""Memory of finite elements per node: measured from 10 000 to 160 000 nodes, factor and assembly."""
_STEP, _FEM_STEP = 7e-4, 1e-6
"""s per step of the model, and per step and node of finite elements; measured on one core, orders of magnitude."""
_STATION_BYTES = 48.0
"""Memory of a station's columns per node: single precision, kept by the model and by the core, and once more while it is answered."""
_COLUMN, _ANSWER = 2e-9, 4e-7
"""s per step, node and station to add up columns, and per node and station to be answered; orders of magnitude."""
_PIXEL, _WRITE, _FORMED = 1e-8, 3e-8, 5e-6
"""s per pixel and frame to draw, to write one format, and to form a picture of scatterers."""


def size_doubts(grid: RegularGrid, key: str = "image.spacing (--spacing)") -> list[str]:
    """Return the doubts about the size of a picture.

    Parameters
    ----------
    grid : RegularGrid
        Pixel centres, mm.
    key : str
        Where its spacing is given.

    Raises
    ------
    InputError
        If no ultrasound picture can have this size.
    """
    sides = [round(n * h, 9) for n, h in zip(grid.shape, grid.spacing, strict=True)]
    if all(LEAST <= side <= MOST for side in sides):
        return []
    told = f"the picture is {_length(sides[0])} wide and {_length(sides[1])} deep; expected {LEAST:g} to {MOST:g} mm a side"
    given = " x ".join(f"{h:.4g}" for h in grid.spacing)
    hint = f"check {key}, mm per pixel, here {given}"
    for unit, factor in _UNITS.items():
        if all(LEAST <= side * factor <= MOST for side in sides):
            meant = ",".join(f"{h * factor:.4g}" for h in grid.spacing)
            hint = f"{given} per pixel looks like {unit}: give {key} as {meant} in mm"
            break
    if min(sides) < LEAST / ABSURD or max(sides) > MOST * ABSURD:
        raise InputError(f"{told}: {hint}")
    return [f"{told}: {hint}"]


def needle_doubts(insertion: Insertion, grid: RegularGrid) -> list[str]:
    """Return the doubts about a needle's path: whether it meets the tissue at all.

    Parameters
    ----------
    insertion : Insertion
        The path.
    grid : RegularGrid
        Pixels of the picture, or its mesh.
    """
    inside = [_inside(entry, tip, grid) for entry, tip in zip(insertion.entry, insertion.tip, strict=True)]
    if max(inside) >= TOUCH:
        return []
    lengths = np.hypot(*(insertion.tip - insertion.entry).T)
    k = int(np.argmax(lengths))
    entry, tip, length = insertion.entry[k], insertion.tip[k], float(lengths[k])
    x0, x1, y0, y1 = grid.extent
    place = f"the tissue, x from {x0:.4g} to {x1:.4g} and y from {y0:.4g} to {y1:.4g} mm"
    at = f"({entry[0]:.4g}, {entry[1]:.4g}) mm"
    if max(inside) > 1e-9:
        return [
            f"only {max(inside):.2g} mm of the needle come to lie in {place}: too short to move it visibly"
        ]
    if length > 0:
        turn = degrees(atan2(tip[1] - entry[1], tip[0] - entry[0]))
        far = entry + (tip - entry) / length * 1e4
        way = _way(entry, far, grid)
        if grid.contains(entry).all():
            return [
                f"the needle never meets {place}: from {at} an angle of {turn:.4g} degrees leads out of it "
                "(0 towards +x, 90 straight down)"
            ]
        if isfinite(way):
            return [
                f"the needle never meets {place}: from {at} it is {way * 1e4:.4g} mm away, and the needle is {length:.4g} mm long"
            ]
    return [f"the needle never meets {place}: it enters at {at}"]


@dataclass(frozen=True)
class Cost:
    """What a run takes.

    Parameters
    ----------
    frames, steps : int
        Pictures drawn and steps of the model.
    bytes : float
        On the disk, while it runs: raw formats are exact, compressed ones are estimated.
    memory : float
        Bytes, estimated.
    seconds : float
        On one core, an order of magnitude.
    """

    frames: int
    steps: int
    bytes: float
    memory: float
    seconds: float

    def __str__(self) -> str:
        """Return the cost as words."""
        return (
            f"{self.frames:,} frames, about {said_bytes(self.bytes)} on the disk and {said_time(self.seconds)} on a machine like the one of "
            "docs/performance.md"
        )


def cost_of(scenario: Scenario, image: UltrasoundImage) -> Cost:
    """Count what a run of a scenario takes; nothing is allocated."""
    output = scenario.output
    frames = frame_count(scenario.insertion(), output.fps)
    steps = (frames - 1) * max(1, ceil(1.0 / output.fps / output.longest_step - 1e-9))
    pixels, nodes = image.pixels.nbytes, scenario.mesh.nodes[0] * scenario.mesh.nodes[1]
    on_disk = frames * (
        sum(_SHARE[name] * pixels for name in output.formats) + 32.0 * nodes * output.displacement
    )
    fem = scenario.model.kind == "fem"
    per_step = _STEP + _FEM_STEP * nodes * fem
    # forces that stick act at stations of the track, each with its columns: here, and in the core
    insertion = scenario.insertion()
    deepest = float(np.hypot(*(insertion.tip - insertion.entry).T).max())
    sticks = scenario.model.kind in ("fem", "green") and scenario.model.forces.law == "stick-slip"
    stations = deepest / scenario.model.forces.station_spacing * sticks
    formed = output.image_model == "rescatter" or scenario.image.file == PHANTOM
    per_frame = image.grid.size * (_PIXEL + _WRITE * len(output.formats) + _FORMED * formed)
    return Cost(
        frames,
        steps,
        on_disk,
        8.0 * pixels + nodes * ((_FEM_BYTES if fem else 400.0) + _STATION_BYTES * stations),
        steps * (per_step + _COLUMN * nodes * stations) + _ANSWER * nodes * stations + frames * per_frame,
    )


def check(scenario: Scenario, image: UltrasoundImage, out: Path | None = None) -> list[str]:
    """Check the scale of a run and return the doubts about it, one sentence each.

    Parameters
    ----------
    scenario : Scenario
        The run.
    image : UltrasoundImage
        Its picture.
    out : Path, optional
        Folder that it will write into.

    Raises
    ------
    InputError
        If the run cannot be meant, its border is none of its pixels, or it needs more memory or disk than there is.
    """
    insertion = scenario.insertion()
    check_border(scenario.output.border, image.pixels)
    doubts = size_doubts(image.grid) + needle_doubts(insertion, image.grid)
    cost = cost_of(scenario, image)
    needle, output = scenario.needle, scenario.output
    speed = needle.speed if isinstance(needle.speed, float) else inf
    hint = ""
    if needle.path is None and speed < SLOW:
        hint = f"; needle.speed = {speed:g} mm/s is very slow"
        if 1000 * speed >= SLOW:
            hint += f": was {speed:g} m/s meant, which is {1000 * speed:g} mm/s?"
    why = f"{insertion.duration:,.6g} s of insertion (needle.depth, needle.speed, needle.dwell) at output.fps = {output.fps:g}"
    if cost.frames > MOST_FRAMES:
        raise InputError(f"{why} are {cost.frames:,} frames; expected {MOST_FRAMES:,} at most{hint}")
    if cost.steps > MOST_STEPS:
        raise InputError(
            f"{why} in steps of output.longest_step = {output.longest_step:g} s are {cost.steps:,} steps; expected "
            f"{MOST_STEPS:,} at most{hint}"
        )
    memory = _memory()
    if cost.memory > memory:
        raise InputError(
            f"{scenario.model.kind} on mesh.nodes = {list(scenario.mesh.nodes)} and a picture of {list(image.grid.shape)} pixels needs "
            f"about {said_bytes(cost.memory)} of memory; this machine has {said_bytes(memory)}: choose a coarser mesh"
        )
    if out is not None and cost.bytes > (free := free_bytes(out)):
        raise InputError(
            f"the run needs about {said_bytes(cost.bytes)} in {out}, where {said_bytes(free)} are free; {why}{hint}"
        )
    if scenario.model.kind == "fem" and find_spec("kvxopt") is None:
        doubts.append(
            "finite elements are factored by SciPy's SuperLU: the same numbers, but up to twice the time on meshes of 5000 nodes and "
            "more; for CHOLMOD run: pip install 'echospline[cholmod]'"
        )
    if cost.seconds > LONG_SECONDS or cost.bytes > LONG_BYTES:
        doubts.append(f"a long run: {cost}{hint}")
    return doubts


def check_store(samples: int, bytes_each: int, out: Path) -> list[str]:
    """Check the size of a data set before its first sample, and return a doubt when it is large.

    Raises
    ------
    InputError
        If the disk has no room for it.
    """
    size = float(samples) * bytes_each
    if size > (free := free_bytes(out)):
        raise InputError(
            f"{samples:,} samples of {said_bytes(bytes_each)} are {said_bytes(size)}; in {out} {said_bytes(free)} are free: choose a smaller --n"
        )
    return [f"{samples:,} samples, up to {said_bytes(size)} on the disk"] if size > LONG_BYTES else []


def _inside(entry: Floats, tip: Floats, grid: RegularGrid) -> float:
    """Return the length of the segment that lies inside the extent, mm; edges are not inside."""
    low, high = _clip(entry, tip, grid)
    return max(0.0, high - low) * hypot(*(tip - entry))


def _way(entry: Floats, tip: Floats, grid: RegularGrid) -> float:
    """Return the share of the segment before it meets the extent; infinite when it never does."""
    low, high = _clip(entry, tip, grid)
    return low if high - low > 1e-12 else inf


def _clip(entry: Floats, tip: Floats, grid: RegularGrid) -> tuple[float, float]:
    """Return the shares of the segment between which it lies inside the extent; the second is less when it never does."""
    x0, x1, y0, y1 = grid.extent
    low, high = 0.0, 1.0
    for a, d, first, last in (
        (entry[0], tip[0] - entry[0], x0, x1),
        (entry[1], tip[1] - entry[1], y0, y1),
    ):
        if abs(d) < 1e-12:
            if not first < a < last:
                return 1.0, 0.0
            continue
        near, far = sorted(((first - a) / d, (last - a) / d))
        low, high = max(low, near), min(high, far)
    return low, high


def _memory() -> float:
    """Return the machine's memory in bytes; infinite where the system does not say."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return inf


def free_bytes(folder: Path) -> float:
    """Return the bytes that are free where a folder is or will be; infinite where the system does not say."""
    there = next((p for p in (folder, *folder.resolve().parents) if p.exists()), Path())
    try:
        return float(shutil.disk_usage(there).free)
    except OSError:
        return inf


def _length(mm: float) -> str:
    return f"{mm:,.0f} mm" if mm >= 1000 else f"{mm:.4g} mm"


def said_bytes(count: float) -> str:
    """Say a number of bytes in words."""
    return f"{count / GIB:,.1f} GiB" if count >= GIB / 10 else f"{count / 2**20:,.1f} MiB"


def said_time(seconds: float) -> str:
    """Say a time in words."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:,.0f} h"
