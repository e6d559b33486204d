"""Samples of a dataset in space: a needle drawn around the base's, a probe that is held along or across it and drifts, and the truth of its picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import atan2, cos, degrees, hypot, radians, sin
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.picture import OUTER_DIAMETER
from echospline.picture.simulate_space import SpatialFrame, simulate_space
from echospline.picture.slices import lattice_of
from echospline.scenario import Scenario, open_spatial
from echospline.scenario.space_models import build_spatial_model
from echospline.scenario.space_section import SpaceSection, view_of
from echospline.scene import Floats, ImagingPlane, Probe, RegularGrid, SpatialPose

Range = tuple[float, float]
Row = tuple[float, float, float, float, float, float, float]


@dataclass(frozen=True)
class SpatialVariation:
    """Ranges of a drawn scenario in space around its base; pairs are (least, most), drawn evenly.

    Parameters
    ----------
    young, tip_force, friction : (float, float)
        Factors on the base's value, drawn evenly in the logarithm. Tissue is homogeneous or layered as the base's [tissue] says; a base with
        ``space.tissue = "own"`` keeps the moduli of its volume, and ``young`` does nothing.
    entry : (float, float)
        mm added to the needle's entry, along x and along z.
    turn : (float, float)
        Degrees added to the needle's angle with the skin, and to its direction along the skin.
    depth : (float, float)
        Factor on the base's insertion depth.
    speed : (float, float)
        mm/s.
    across : float
        Share of the samples whose probe is held across the needle, through its tip at its deepest, in place of along it; of bases with a ``view``.
    offset, shift : (float, float)
        mm that the probe is off the base's place at the start, and that it moves over the sample, along its slice's normal and along its face.
    yaw, pitch, roll : (float, float)
        Degrees that the probe is turned from the base's pose at the start, and by half of that again over the sample.
    """

    young: Range = (0.5, 2.0)
    tip_force: Range = (0.5, 1.3)
    friction: Range = (0.5, 2.0)
    entry: Range = (-3.0, 3.0)
    turn: Range = (-15.0, 15.0)
    depth: Range = (0.6, 1.1)
    speed: Range = (1.0, 10.0)
    across: float = 0.3
    offset: Range = (-1.5, 1.5)
    shift: Range = (-2.0, 2.0)
    yaw: Range = (-8.0, 8.0)
    pitch: Range = (-5.0, 5.0)
    roll: Range = (-4.0, 4.0)


def drawn_space(
    base: Scenario, index: int, seed: int, frames: int, variation: SpatialVariation | None = None
) -> Scenario:
    """Draw sample ``index`` of a base in space: it depends on base, index and seed alone.

    Raises
    ------
    InputError
        If the base's needle has a path of its own, or a drawn value is not allowed in a scenario.
    """
    space = base.space or SpaceSection()
    if space.needle.path is not None:
        raise InputError(
            "a base of a dataset in space has a straight needle (entry, direction, depth), which is varied; this one has a path"
        )
    v = variation or SpatialVariation()
    rng = np.random.default_rng((seed, index))

    def factor(limits: Range) -> float:
        return float(np.exp(rng.uniform(*np.log(limits))))

    x, y, z = space.needle.direction
    steep = degrees(atan2(y, hypot(x, z))) + rng.uniform(*v.turn)
    heading = degrees(atan2(z, x)) + rng.uniform(*v.turn)
    depth, speed = space.needle.depth * rng.uniform(*v.depth), float(rng.uniform(*v.speed))
    forces = base.model.forces
    values: dict[str, Any] = {
        "title": f"sample {index}, seed {seed}",
        "tissue.young": base.tissue.young * factor(v.young),
        "model.forces.tip": forces.tip * factor(v.tip_force),
        "model.forces.friction_limit": forces.friction_limit * factor(v.friction),
        "space.needle.entry": [
            space.needle.entry[0] + rng.uniform(*v.entry),
            space.needle.entry[1],
            space.needle.entry[2] + rng.uniform(*v.entry),
        ],
        "space.needle.direction": [
            cos(radians(steep)) * cos(radians(heading)),
            sin(radians(steep)),
            cos(radians(steep)) * sin(radians(heading)),
        ],
        "space.needle.depth": float(depth),
        "space.needle.speed": speed,
        "space.needle.dwell": 0.0,
        "space.needle.retract": False,
        # the last frame is the end of the insertion
        "output.fps": (frames - 1) / (float(depth) / speed) * (1.0 + 1e-9),
    }
    if space.tissue == "own":
        del values["tissue.young"]
    if base.output.image_model == "rescatter":  # every sample has speckle of its own
        values["phantom.seed"] = int(rng.integers(2**31))
    scenario = base.with_values(values, f"sample {index}")
    assert scenario.space is not None
    across = rng.random() < v.across
    rows = _rows(scenario.space, across)
    path = _held(rows, float(depth) / speed, v, rng)
    return scenario.with_values(
        {"space.probe.path": [list(row) for row in path], "space.probe.view": None}, f"sample {index}"
    )


def _rows(space: SpaceSection, across: bool) -> list[Row]:
    """Return where the base's probe is: share of the sample's duration, x, y, z, yaw, pitch, roll."""
    probe = space.probe
    if probe.path is not None:
        first, last = probe.path[0][0], probe.path[-1][0]
        return [((row[0] - first) / (last - first), *row[1:]) for row in probe.path]
    place = (*probe.position, probe.yaw, probe.pitch, probe.roll)
    if probe.view is not None:
        m = view_of(space.needle.insertion(), "transverse" if across else probe.view).matrix
        place = (float(m[0, 3]), float(m[1, 3]), float(m[2, 3]), degrees(atan2(-m[2, 0], m[0, 0])), 0.0, 0.0)
    return [(0.0, *place), (1.0, *place)]


def _held(rows: list[Row], duration: float, v: SpatialVariation, rng: np.random.Generator) -> list[Row]:
    """Return the path of a hand that starts off the base's pose and drifts."""
    off, drift = (np.array([rng.uniform(*limits) for _ in range(2)]) for limits in (v.offset, v.shift))
    turns = np.array([rng.uniform(*limits) for limits in (v.yaw, v.pitch, v.roll)])
    turning = np.array([0.5 * rng.uniform(*limits) for limits in (v.yaw, v.pitch, v.roll)])
    held = []
    for share, x, y, z, yaw, pitch, roll in rows:
        across, along = off + share * drift
        a = radians(yaw)  # the face points along (cos, 0, -sin), the slice's normal along (sin, 0, cos)
        angles = np.array([yaw, pitch, roll]) + turns + share * turning
        held.append((
            share * duration, x + across * sin(a) + along * cos(a), y, z + across * cos(a) - along * sin(a),
            float((angles[0] + 180.0) % 360.0 - 180.0), float(angles[1]), float(angles[2]),
        ))  # fmt: skip
    return held


def spatial_arrays(base: Scenario, frames: int) -> dict[str, tuple[tuple[int, ...], str]]:
    """Return shape of a sample and type of every array of a dataset in space."""
    probe = (base.space or SpaceSection()).probe.probe()
    picture, lattice = (frames, *probe.grid.shape[::-1]), (frames, *lattice_of(probe).shape[::-1])
    return {
        "image": (picture, "uint8"),
        "needle_mask": (picture, "bool"),
        "displacement": ((*lattice, 2), "float32"),
        "out_of_plane": (lattice, "float32"),
        "valid": (lattice, "bool"),
        "plane": ((frames, 4, 4), "float64"),
        "tip": ((frames, 3), "float64"),
        "entry": ((frames, 3), "float64"),
        "tip_seen": ((frames, 3), "float64"),
        "speed": ((frames,), "float64"),
        "times": ((frames,), "float64"),
    }


def imaged_space(scenario: Scenario, folder: Path) -> dict[str, NDArray[Any]]:
    """Run a scenario in space and return the arrays of a sample.

    Returns
    -------
    dict
        ``image``, ``needle_mask`` (frames, rows, columns); on every eighth pixel ``displacement`` (in the picture, mm), ``out_of_plane`` (mm) and
        ``valid`` of the first picture's tissue; ``plane`` (picture's frame to scene), ``tip`` and ``entry`` in the scene, ``tip_seen`` (lateral,
        depth, distance from the plane, mm), ``speed``, ``times``.
    """
    opened = open_spatial(scenario, folder)
    space = opened.scenario.space or SpaceSection()
    probe, insertion = space.probe.probe(), space.needle.insertion()
    model = build_spatial_model(opened.scenario, space.grid(opened.volume), opened.tissue)
    lattice = lattice_of(probe).shape[::-1]
    radius = OUTER_DIAMETER[scenario.needle.gauge] / 2.0
    rows: dict[str, list[Any]] = {name: [] for name in spatial_arrays(scenario, 0)}
    first: SpatialFrame | None = None
    for frame in simulate_space(
        opened.volume, probe, space.probe.planes(insertion), insertion, model, fps=scenario.output.fps,
        longest_step=scenario.output.longest_step, needle=scenario.needle_echo(), form_image=opened.form_image,
    ):  # fmt: skip
        first = first or frame
        seen = frame.seen_from(first, probe, opened.volume)
        found: Mapping[str, Any] = {
            "image": frame.image.pixels,
            "needle_mask": mask_in_slice(probe, frame.plane, frame.pose, radius),
            "displacement": seen.displacement.reshape(*lattice, 2).astype(np.float32),
            "out_of_plane": seen.out_of_plane.reshape(lattice).astype(np.float32),
            "valid": seen.valid.reshape(lattice),
            "plane": frame.plane.matrix,
            "tip": frame.pose.tip,
            "entry": frame.pose.entry,
            "tip_seen": frame.pose.seen_from(frame.plane)[1],
            "speed": frame.pose.speed,
            "times": frame.time,
        }
        for name, value in found.items():
            rows[name].append(value)
    return {name: np.array(values) for name, values in rows.items()}


STEP = 0.05
"""mm; places along the shaft at which it is asked whether the slice holds it. A longer step makes the mask's ends that much less exact."""


def mask_in_slice(probe: Probe, plane: ImagingPlane, pose: SpatialPose, radius: float) -> NDArray[np.bool_]:
    """Return the pixels that the needle covers, shape (rows, columns): nearer than ``radius`` mm to the part of the shaft inside the slice.

    The slice reaches one sigma of the beam's amplitude to both sides, and no less than the needle's radius.
    """
    grid = probe.grid
    covered = np.zeros(grid.shape[::-1], dtype=np.bool_)
    if pose.depth <= 0:
        return covered
    ends = plane.lower(np.array([pose.entry, pose.tip]))
    share = np.linspace(0.0, 1.0, int(pose.depth / STEP) + 2)[:, None]
    shaft = (1 - share) * ends[0] + share * ends[1]
    held = np.abs(shaft[:, 2]) <= np.maximum(probe.thickness(shaft[:, 1]), radius)
    edges = np.flatnonzero(np.diff(np.r_[False, held, False].astype(np.int8)))
    for start, stop in edges.reshape(-1, 2):
        covered |= near_segment(grid, shaft[start, :2], shaft[stop - 1, :2], radius)
    return covered & probe.mask


def near_segment(grid: RegularGrid, a: Floats, b: Floats, radius: float) -> NDArray[np.bool_]:
    """Return the pixels nearer than ``radius`` mm to a segment, which may be a point, shape (rows, columns)."""
    along = np.subtract(b, a)
    length2 = float(along @ along)
    x, y = grid.x[None, :] - a[0], grid.y[:, None] - a[1]
    t = np.clip((x * along[0] + y * along[1]) / length2, 0.0, 1.0) if length2 > 0 else np.zeros_like(x + y)
    return np.asarray((x - t * along[0]) ** 2 + (y - t * along[1]) ** 2 <= radius**2)
