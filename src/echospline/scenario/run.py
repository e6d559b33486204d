"""One scenario, one folder of results: cine, true motion, figure, the resolved scenario and a report of the run."""

from __future__ import annotations

import json
import platform
import warnings
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from echospline.atomic import appearing, writing
from echospline.io import DisplacementWriter, open_writer
from echospline.io.sequence import SequenceWriter
from echospline.mechanics import describe_core
from echospline.mechanics.protocol import NeedleLoad, State, TissueModel, described
from echospline.picture import Frame, ImageFormer, frame_count, simulate
from echospline.scenario.scenario import Scenario
from echospline.scene import UltrasoundImage

SUFFIX = {
    "mp4": "cine.mp4", "gif": "cine.gif", "png": "frames", "mha": "cine.mha",
    "igs.mha": "run.igs.mha", "seq.nrrd": "run.seq.nrrd",
}  # fmt: skip
REPORTED_PACKAGES = ("echospline", "numpy", "scipy", "opencv-python-headless", "scikit-fem", "av")
"""Packages whose versions are in a report."""


@dataclass
class _Tally:
    """Counts over the frames of a run."""

    stages: dict[str, list[float]] = field(default_factory=dict)
    largest: float = 0.0
    residual: float = 0.0
    folded: list[dict[str, Any]] = field(default_factory=list)
    forces: dict[str, float] = field(default_factory=dict)

    def add(self, frame: Frame) -> None:
        for name, ms in frame.milliseconds.items():
            self.stages.setdefault(name, []).append(ms)
        self.largest = max(self.largest, float(np.hypot(*frame.displacement.T).max(initial=0.0)))
        self.residual = max(self.residual, frame.residual)
        for name, value in _forces(frame.load).items():
            self.forces[name] = max(self.forces.get(name, 0.0), abs(value))
        if frame.folds:
            self.folded.append({"time_s": round(frame.time, 6), "what": str(frame.folds)})


def _forces(load: NeedleLoad | None) -> dict[str, float]:
    """Return the needle's forces with their units in their names, as they are recorded."""
    if load is None:
        return {}
    return {
        "tip_force_N": load.tip,
        "friction_N": load.friction,
        "side_force_N": load.side,
        "torque_N_mm": load.torque,
        "cut_mm": load.cut,
    }


def _sink(
    name: str, stack: ExitStack, out: Path, image: UltrasoundImage, fps: float
) -> Callable[[Frame], None]:
    """Open the writer of one format."""
    if name in ("igs.mha", "seq.nrrd"):  # for PLUS and 3D Slicer: pictures with the needle's transforms
        recording = stack.enter_context(SequenceWriter(out / SUFFIX[name], image.grid))
        return lambda frame: recording.add(frame.image.pixels, frame.time, frame.pose)
    cine = stack.enter_context(open_writer(out / SUFFIX[name], image.grid, fps))
    return lambda frame: cine.add(frame.image.pixels, frame.time)


def run(
    scenario: Scenario,
    image: UltrasoundImage,
    model: TissueModel[State],
    out: Path,
    folder: Path,
    *,
    progress: Callable[[int, int], None] | None = None,
    form_image: ImageFormer | None = None,
    doubts: Sequence[str] = (),
) -> dict[str, Any]:
    """Simulate a scenario and write its results.

    Parameters
    ----------
    scenario : Scenario
        The scenario.
    image : UltrasoundImage
        Its image.
    model : TissueModel
        Its model.
    out : Path
        Folder for the results; created if missing. Every file gets its name when it is whole.
    folder : Path
        Start of the scenario's relative paths.
    progress : callable, optional
        Called with (frames done, number of frames).
    form_image : callable, optional
        See `simulate`.
    doubts : sequence of str
        What was said before the run (see `check`); kept in the report.

    Returns
    -------
    dict
        The content of ``run.json``.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    began = perf_counter()
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    insertion, output = scenario.insertion(), scenario.output
    count = frame_count(insertion, output.fps)
    tally, files = _Tally(), []
    first = shown = deepest = None
    with ExitStack() as stack:
        # matrices of a few hundred rows: starting a second thread costs more than it saves
        stack.enter_context(threadpool_limits(limits=1, user_api="blas"))
        heard = stack.enter_context(warnings.catch_warnings(record=True))
        warnings.simplefilter("always", UserWarning)
        sinks = []
        for name in dict.fromkeys(output.formats):
            files.append(SUFFIX[name])
            sinks.append(_sink(name, stack, out, image, output.fps))
        record = None
        if output.displacement:
            files.append("displacement.npz")
            record = stack.enter_context(DisplacementWriter(out / "displacement.npz", model.grid.nodes))
        for frame in simulate(
            image,
            insertion,
            model,
            fps=output.fps,
            longest_step=output.longest_step,
            border=output.border,
            folding=output.folding,
            inverse=output.inverse,
            needle=scenario.needle_echo(),
            form_image=form_image,
        ):
            since = perf_counter()
            for sink in sinks:
                sink(frame)
            if record is not None:
                record.add(frame.displacement, frame.time, frame.pose, _forces(frame.load))
            frame.milliseconds["write"] = 1000 * (perf_counter() - since)
            tally.add(frame)
            first = first or frame
            # the figure shows the moment of deepest insertion, the last one before withdrawal or relaxation
            if deepest is None or (frame.pose.depth >= deepest - 1e-9 and frame.pose.speed > 0):
                deepest, shown = max(deepest or 0.0, frame.pose.depth), frame
            if progress is not None:
                progress(frame.index + 1, count)
    if output.figure and first is not None and shown is not None:
        # matplotlib takes longer to load than everything else together: only when a figure is drawn
        from echospline.picture.summary import summary_figure  # noqa: PLC0415

        title = scenario.title or f"{scenario.model.kind}: needle at {shown.time:.2f} s"
        summary_figure(
            first.image,
            shown.image,
            model.grid,
            shown.displacement,
            shown.pose,
            out / "summary.png",
            title=title,
        )
        files.append("summary.png")
    scenario.save(out / "scenario.toml", folder)
    found = {
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "image": {
            "source": image.source,
            "pixels": list(image.pixels.shape),
            "spacing_mm": list(image.spacing),
            "notes": list(image.notes),
        },
        "model": scenario.model.kind,
        **({"solved_by": solved} if (solved := described(model)) else {}),
        "mesh_nodes": model.grid.size,
        "frames": count,
        "largest_displacement_mm": tally.largest,
        **({"largest_forces": tally.forces} if tally.forces else {}),
        "inverse_map_residual_px": tally.residual,
        "folded_frames": tally.folded,
        "doubts": [*doubts, *dict.fromkeys(str(w.message) for w in heard if w.category is UserWarning)],
        "milliseconds_per_frame": {
            name: {
                "median": float(np.median(ms)),
                "p99": float(np.percentile(ms, 99)),
                "total": float(np.sum(ms)),
            }
            for name, ms in tally.stages.items()
        },
        "seconds": perf_counter() - began,
        "files": [*files, "scenario.toml", "run.json"],
    }
    return write_report(out, scenario, found)


def write_report(out: Path, scenario: Scenario, found: dict[str, Any]) -> dict[str, Any]:
    """Write ``run.json``: what a run found and what made it, the same for the plane and for space.

    Parameters
    ----------
    out : Path
        The run's folder.
    scenario : Scenario
        As it was resolved.
    found : dict
        Of this run.

    Returns
    -------
    dict
        The content of ``run.json``.
    """
    report = {
        **found,
        "versions": {
            "python": platform.python_version(),
            "platform": platform.platform(),
            **package_versions(),
        },
        "core": describe_core(),
        "parameters": scenario.model_dump(mode="json"),
    }
    with appearing(out / "run.json") as part:
        part.write_text(json.dumps(report, indent=2), encoding="utf-8")
    return report


def package_versions() -> dict[str, str]:
    """Return the versions of the packages that a report names."""
    found = {}
    for name in REPORTED_PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
