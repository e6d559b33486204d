"""One scenario in space, one folder of results: cine, motion of the tissue, figure, the resolved scenario and a report of the run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from echospline.atomic import writing
from echospline.errors import InputError
from echospline.io import open_writer
from echospline.io.displacement_space import SpatialDisplacementWriter
from echospline.io.sequence import SequenceWriter
from echospline.mechanics.protocol import SpatialTissueModel, State, described
from echospline.picture.simulate_space import SpatialFrame, simulate_space
from echospline.picture.slices import SliceFormer, lattice_of
from echospline.scenario.run import SUFFIX, write_report
from echospline.scenario.scenario import Scenario
from echospline.scenario.space_scene import moduli
from echospline.scene import RegularGrid, Volume

FAR_OUT = 0.5
"""Share of the picture outside the volume from which a run says so."""


@dataclass
class _Tally:
    """Counts over the frames of a run."""

    stages: dict[str, list[float]] = field(default_factory=dict)
    folded: list[dict[str, Any]] = field(default_factory=list)
    frames: int = 0
    residual: float = 0.0
    largest: float = 0.0
    outside: float = 0.0
    first: SpatialFrame | None = None
    shown: SpatialFrame | None = None

    def add(self, frame: SpatialFrame) -> None:
        for stage, ms in frame.milliseconds.items():
            self.stages.setdefault(stage, []).append(ms)
        self.frames += 1
        self.residual, self.outside = max(self.residual, frame.residual), max(self.outside, frame.outside)
        self.largest = max(self.largest, float(np.linalg.norm(frame.displacement, axis=1).max()))
        if frame.folds:
            self.folded.append({"time_s": round(frame.time, 6), "what": str(frame.folds)})
        self.first = self.first or frame
        # the figure shows the moment of deepest insertion, the last one before withdrawal
        if self.shown is None or (frame.pose.depth >= self.shown.pose.depth - 1e-9 and frame.pose.speed > 0):
            self.shown = frame

    def report(self) -> dict[str, Any]:
        return {
            "frames": self.frames,
            "largest_displacement_mm": self.largest,
            "inverse_map_residual_px": self.residual,
            "folded_frames": self.folded,
            "outside_share": self.outside,
            "milliseconds_per_frame": {
                name: {
                    "median": float(np.median(ms)),
                    "p99": float(np.percentile(ms, 99)),
                    "total": float(np.sum(ms)),
                }
                for name, ms in self.stages.items()
            },
        }

    def doubts(self) -> list[str]:
        if self.outside <= FAR_OUT:
            return []
        return [
            f"{100 * self.outside:.0f} % of the picture lies outside the volume at worst and is black: move the probe "
            "(space.probe.position) or lower its depth"
        ]


def _sink(
    stack: ExitStack, name: str, out: Path, grid: RegularGrid, fps: float
) -> Callable[[SpatialFrame], None]:
    """Open the writer of one format; those of PLUS and 3D Slicer hold the plane and the needle of every frame, in the scene's frame."""
    if name in ("igs.mha", "seq.nrrd"):
        recording = stack.enter_context(SequenceWriter(out / SUFFIX[name], grid))
        return lambda frame: recording.add(frame.image.pixels, frame.time, frame.pose, frame.plane)
    cine = stack.enter_context(open_writer(out / SUFFIX[name], grid, fps))
    return lambda frame: cine.add(frame.image.pixels, frame.time)


def run_space(
    scenario: Scenario,
    volume: Volume,
    model: SpatialTissueModel[State],
    out: Path,
    folder: Path,
    *,
    progress: Callable[[int, int], None] | None = None,
    doubts: Sequence[str] = (),
    watch: Callable[[SpatialFrame], None] | None = None,
    form_image: SliceFormer | None = None,
) -> dict[str, Any]:
    """Simulate a scenario in space and write its results.

    Parameters
    ----------
    scenario : Scenario
        With a [space] table.
    volume : Volume
        Its volume, 8-bit voxels in the scene's frame.
    model : SpatialTissueModel
        Its model.
    out : Path
        Folder for the results. Every file gets its name when it is whole.
    folder : Path
        Start of the scenario's relative paths.
    progress : callable, optional
        Called with (frames done, number of frames).
    doubts : sequence of str
        What was said before the run.
    watch : callable, optional
        Called with every frame.
    form_image : callable, optional
        See `simulate_space`; `space_former.former_of` makes that of a scenario.

    Returns
    -------
    dict
        The content of ``run.json``.

    Raises
    ------
    InputError
        If the scenario has no [space], or the folder cannot be written.
    """
    space = scenario.space
    if space is None:
        raise InputError("this scenario is no scene in space: it has no [space] table")
    output = scenario.output
    began = perf_counter()
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    probe, insertion = space.probe.probe(), space.needle.insertion()
    planes = space.probe.planes(insertion)
    duration = max(insertion.duration, float(planes.times[-1] - insertion.times[0]))
    expected = int(duration * output.fps + 1e-9) + 1
    tally, lattice = _Tally(), lattice_of(probe)
    record = SpatialDisplacementWriter(
        out / "displacement.npz", model.grid.nodes, lattice.nodes.reshape(*lattice.shape[::-1], 2)
    )
    first: SpatialFrame | None = None
    with ExitStack() as stack:
        stack.enter_context(threadpool_limits(limits=1, user_api="blas"))
        sinks = [_sink(stack, name, out, probe.grid, output.fps) for name in dict.fromkeys(output.formats)]
        for frame in simulate_space(
            volume, probe, planes, insertion, model, fps=output.fps, longest_step=output.longest_step,
            folding=output.folding, needle=scenario.needle_echo(), form_image=form_image,
        ):  # fmt: skip
            since = perf_counter()
            for sink in sinks:
                sink(frame)
            first = first or frame
            if output.displacement:
                seen = frame.seen_from(first, probe, volume)
                record.add(frame.displacement, frame.time, frame.pose, frame.plane, frame.places, seen)
            frame.milliseconds["write"] = 1e3 * (perf_counter() - since)
            tally.add(frame)
            if watch is not None:
                watch(frame)
            if progress is not None:
                progress(frame.index + 1, expected)
    files = [SUFFIX[name] for name in dict.fromkeys(output.formats)]
    if output.displacement:
        record.close()
        files.append("displacement.npz")
    if output.figure and tally.first is not None and tally.shown is not None:
        # matplotlib takes longer to load than everything else together: only when a figure is drawn
        from echospline.picture.summary_space import summary_figure_space  # noqa: PLC0415

        title = scenario.title or f"{scenario.model.kind} in space: {volume.source}"
        said = moduli_of(model)
        title += f"\nYoung's modulus: {said}" if said else ""
        summary_figure_space(volume, probe, tally.first, tally.shown, out / "summary.png", title=title)
        files.append("summary.png")
    scenario.save(out / "scenario.toml", folder)
    found = {
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "image": {
            "source": volume.source,
            "voxels": list(volume.shape),
            "spacing_mm": list(volume.spacing),
        },
        "model": scenario.model.kind,
        **({"solved_by": solved} if (solved := described(model)) else {}),
        **({"moduli": said} if (said := moduli_of(model)) else {}),
        "image_model": output.image_model,
        "mesh_nodes": model.grid.size,
        **tally.report(),
        "doubts": [*doubts, *tally.doubts()],
        "seconds": perf_counter() - began,
        "files": [*files, "scenario.toml", "run.json"],
    }
    return write_report(out, scenario, found)


def moduli_of(model: object) -> str:
    """Return the moduli that a model computes with, kPa; empty where it has none (landmarks in homogeneous tissue)."""
    response = getattr(model, "response", None)
    tissue = getattr(response if response is not None else model, "tissue", None)
    if tissue is None or (response is None and tissue.homogeneous):
        return ""
    return moduli(tissue)
