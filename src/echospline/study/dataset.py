"""Datasets for learning: drawn scenarios, imaged phantoms or volumes, true motion, needle masks; one chunk per sample."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from echospline.atomic import appearing, writing
from echospline.errors import InputError, MissingExtraError
from echospline.laboratory import phantom_pictures
from echospline.picture import OUTER_DIAMETER, simulate
from echospline.scenario import PHANTOM, Scenario, build_model, is_spatial, load
from echospline.scenario.space_section import SpaceSection
from echospline.scene import RegularGrid, UltrasoundImage
from echospline.study.dataset_space import (
    SpatialVariation,
    drawn_space,
    imaged_space,
    near_segment,
    spatial_arrays,
)

LAYOUT = 1


@dataclass(frozen=True)
class Variation:
    """Ranges of a drawn scenario around its base; pairs are (least, most), drawn evenly.

    Parameters
    ----------
    young, tip_force, friction, frequency : (float, float)
        Factors on the base's value, drawn evenly in the logarithm.
    snr : (float, float)
        dB.
    attenuation : (float, float)
        dB/(cm MHz).
    entry : (float, float)
        Share of the picture's width at which the needle enters.
    turn : (float, float)
        Degrees added to the base's angle.
    depth : (float, float)
        Factor on the base's insertion depth.
    speed : (float, float)
        mm/s.
    inclusions : (int, int)
        Number of cysts and lesions.
    """

    young: tuple[float, float] = (0.5, 2.0)
    tip_force: tuple[float, float] = (0.5, 1.3)
    friction: tuple[float, float] = (0.5, 2.0)
    frequency: tuple[float, float] = (0.7, 1.4)
    snr: tuple[float, float] = (10.0, 35.0)
    attenuation: tuple[float, float] = (0.0, 0.7)
    entry: tuple[float, float] = (0.2, 0.8)
    turn: tuple[float, float] = (-25.0, 25.0)
    depth: tuple[float, float] = (0.6, 1.1)
    speed: tuple[float, float] = (1.0, 10.0)
    inclusions: tuple[int, int] = (0, 3)


def drawn(base: Scenario, index: int, seed: int, frames: int, variation: Variation | None = None) -> Scenario:
    """Draw sample ``index``: it depends on base, index and seed alone.

    Parameters
    ----------
    base : Scenario
        The scenario to vary.
    index, seed : int
    frames : int
        Frames of the sample, evenly over the insertion.
    variation : Variation, optional

    Raises
    ------
    InputError
        If a drawn value is not allowed in a scenario.
    """
    v = variation or Variation()
    rng = np.random.default_rng((seed, index))

    def factor(limits: tuple[float, float]) -> float:
        return float(np.exp(rng.uniform(*np.log(limits))))

    width, height = base.phantom.size
    depth = min(base.needle.depth * rng.uniform(*v.depth), 0.9 * height)
    speed = float(rng.uniform(*v.speed))
    regions = []
    for _ in range(int(rng.integers(v.inclusions[0], v.inclusions[1] + 1))):
        half = rng.uniform(1.0, 5.0, 2)
        centre = rng.uniform((0.1 * width, 0.1 * height), (0.9 * width, 0.9 * height))
        level = -100.0 if rng.random() < 0.3 else float(rng.uniform(-12.0, 9.0))
        regions.append({"level": level, "ellipse": {"centre": centre.tolist(), "half_axes": half.tolist()}})
    limit = "friction" if base.model.forces.law == "viscous" else "friction_limit"
    values: dict[str, Any] = {
        "title": f"sample {index}, seed {seed}",
        "image.file": PHANTOM,
        "tissue.young": base.tissue.young * factor(v.young),
        "model.forces.tip": base.model.forces.tip * factor(v.tip_force),
        f"model.forces.{limit}": getattr(base.model.forces, limit) * factor(v.friction),
        "probe.frequency": base.probe.frequency * factor(v.frequency),
        "probe.snr": float(rng.uniform(*v.snr)),
        "probe.attenuation": float(rng.uniform(*v.attenuation)),
        "needle.entry": [float(width * rng.uniform(*v.entry)), base.needle.entry[1]],
        "needle.angle": base.needle.angle + float(rng.uniform(*v.turn)),
        "needle.depth": float(depth),
        "needle.speed": speed,
        "needle.dwell": 0.0,
        "needle.retract": False,
        "needle.path": None,
        "phantom.seed": int(rng.integers(2**31)),
        "phantom.region": regions,
        # the last frame is the end of the insertion
        "output.fps": (frames - 1) / (float(depth) / speed) * (1.0 + 1e-9),
    }
    return base.with_values(values, f"sample {index}")


def sample_arrays(base: Scenario, frames: int) -> dict[str, tuple[tuple[int, ...], str]]:
    """Return shape of a sample and type of every array of a dataset, in the plane or in space as the base is."""
    if is_spatial(base):
        return spatial_arrays(base, frames)
    nx, ny = base.phantom.grid().shape
    mx, my = base.mesh.nodes
    return {
        "image": ((frames, ny, nx), "uint8"),
        "needle_mask": ((frames, ny, nx), "bool"),
        "displacement": ((frames, my, mx, 2), "float32"),
        "tip": ((frames, 2), "float64"),
        "entry": ((frames, 2), "float64"),
        "speed": ((frames,), "float64"),
        "times": ((frames,), "float64"),
    }


def sample_bytes(base: Scenario, frames: int) -> int:
    """Return the size of a sample before it is compressed, bytes."""
    return sum(
        int(np.prod(shape)) * np.dtype(kind).itemsize for shape, kind in sample_arrays(base, frames).values()
    )


def create_store(path: Path, base: Scenario, n: int, frames: int, seed: int, sources: Sequence[str]) -> None:
    """Create the arrays, or check that existing ones have the same layout; more samples enlarge them.

    Raises
    ------
    InputError
        If the folder holds a dataset of another layout.
    MissingExtraError
        If zarr is not installed.
    """
    zarr = _zarr()
    arrays, units = (
        sample_arrays(base, frames),
        "mm, s, mm/s; points (lateral, depth); displacement deformed minus rest",
    )
    pixel, variation = list(base.phantom.pixel), asdict(Variation())
    if is_spatial(base):
        side = (base.space or SpaceSection()).probe.pixel
        pixel, variation = [side, side], asdict(SpatialVariation())
        units = (
            "mm, s, mm/s; displacement (lateral, depth) and out_of_plane of the first picture's tissue on every eighth pixel, against the first frame; "
            "tip and entry (x, y, z) in the scene; plane: picture's frame, its origin the middle of the probe's face, to scene"
        )
    meaning = {
        "layout": LAYOUT, "seed": seed, "frames": frames, "bases": list(sources), "pixel_mm": pixel, "variation": variation, "units": units,
    }  # fmt: skip
    if (path / "zarr.json").exists():
        group = zarr.open_group(str(path), mode="r+")
        known = json.loads(json.dumps(meaning))
        differ = [k for k, v in known.items() if group.attrs.get(k) != v]
        if differ or group["image"].shape[1:] != arrays["image"][0]:
            raise InputError(
                f"{path} holds a dataset with other {', '.join(differ) or 'image size'}: choose another --out, or the same options"
            )
        for name, (shape, _) in arrays.items():
            if group[name].shape[0] < n:
                group[name].resize((n, *shape))
        return
    with writing(path):
        group = zarr.create_group(store=str(path), attributes=meaning)
        for name, (shape, dtype) in arrays.items():
            group.create_array(name, shape=(n, *shape), chunks=(1, *shape), dtype=dtype)


def make_sample(*, store: str, bases: Sequence[str], index: int, seed: int, frames: int) -> dict[str, Any]:
    """Make one sample and write its chunks and its scenario; the task of a sweep.

    Returns
    -------
    dict
        Time, largest motion, folds.
    """
    began = perf_counter()
    path = Path(store)
    source = Path(bases[index % len(bases)])
    base = load(source)
    if is_spatial(base):
        scenario = drawn_space(base, index, seed, frames)
        sample = imaged_space(scenario, source.parent)
    else:
        scenario = drawn(base, index, seed, frames)
        sample = imaged(scenario, source.parent)
    if len(sample["times"]) != frames:
        raise InputError(f"sample {index} has {len(sample['times'])} frames; expected {frames}")
    group = _zarr().open_group(str(path), mode="r+")
    for name, value in sample.items():
        group[name][index] = value
    folder = path / "scenarios"
    with writing(folder):
        folder.mkdir(exist_ok=True)
        scenario.save(folder / f"{index:07d}.toml", source.parent)
    return {
        "seconds": perf_counter() - began,
        "largest_mm": float(np.hypot(sample["displacement"][..., 0], sample["displacement"][..., 1]).max()),
    }


def imaged(scenario: Scenario, folder: Path) -> dict[str, np.ndarray[Any, Any]]:
    """Run a scenario on its phantom and return the arrays of a sample."""
    phantom = scenario.phantom.phantom(scenario.probe.probe())
    display = scenario.phantom.display()
    blank = UltrasoundImage(np.zeros(phantom.grid.shape[::-1], np.uint8), phantom.grid, "speckle phantom")
    mesh = scenario.grid(blank)
    model = build_model(scenario, mesh, folder=folder)
    fps = scenario.output.fps
    former = phantom_pictures(phantom, display=display, fps=fps, out_of_plane=scenario.phantom.out_of_plane)
    rows: dict[str, list[Any]] = {
        k: [] for k in ("image", "needle_mask", "displacement", "tip", "entry", "speed", "times")
    }
    radius = OUTER_DIAMETER[scenario.needle.gauge] / 2.0
    for frame in simulate(
        blank, scenario.insertion(), model, fps=fps, longest_step=scenario.output.longest_step,
        needle=scenario.needle_echo(), form_image=former,
    ):  # fmt: skip
        rows["image"].append(frame.image.pixels)
        rows["needle_mask"].append(needle_mask(phantom.grid, frame.pose.entry, frame.pose.tip, radius))
        rows["displacement"].append(frame.displacement.reshape(*mesh.shape[::-1], 2).astype(np.float32))
        for name, value in (
            ("tip", frame.pose.tip),
            ("entry", frame.pose.entry),
            ("speed", frame.pose.speed),
        ):
            rows[name].append(value)
        rows["times"].append(frame.time)
    return {name: np.array(values) for name, values in rows.items()}


def needle_mask(
    grid: RegularGrid, entry: tuple[float, float], tip: tuple[float, float], radius: float
) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Return the pixels that the needle covers, shape (rows, columns): nearer than ``radius`` mm to the shaft."""
    if tuple(tip) == tuple(entry):  # not in the tissue yet
        return np.zeros(grid.shape[::-1], dtype=np.bool_)
    return near_segment(grid, np.array(entry), np.array(tip), radius)


def write_summary(path: Path, summary: Mapping[str, Any]) -> None:
    """Write ``dataset.json`` beside the arrays."""
    file = path / "dataset.json"
    with appearing(file) as part:
        part.write_text(json.dumps(summary, indent=1), encoding="utf-8")


def _zarr() -> Any:
    try:
        return import_module("zarr")
    except ImportError as missing:
        raise MissingExtraError("zarr", "dataset", "writing a dataset") from missing
