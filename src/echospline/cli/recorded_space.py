"""``echospline recorded --volume``: a tracked procedure replayed in a volume, and compared with its pictures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from echospline import openigtlink
from echospline import scenario as scenario_room
from echospline.atomic import claimed
from echospline.cli.link import axis_of
from echospline.cli.link_space import place_of
from echospline.cli.options import say, scenario_from
from echospline.cli.recorded import correlation, write_table
from echospline.errors import InputError
from echospline.scene import Floats, Pixels, Probe, RegularGrid, probe_angles

if TYPE_CHECKING:  # they load SimpleITK and the core
    from echospline.io.sequence_space import SpatialRecording
    from echospline.picture.simulate_space import SpatialFrame

MOVED = "the recording moves probe and needle: leave it out"


def recorded_in_volume(
    file: Path,
    volume: str,
    out: Path,
    changes: dict[str, Any],
    *,
    place: str,
    reference: str,
    face: str | None,
    needle_frame: str,
    needle_axis: str,
    config: Path | None,
    as_json: bool,
) -> None:
    """Replay a recording in a volume; see the options of `recorded`.

    Raises
    ------
    InputError
        If the volume is none, the recording does not lead to it, or an option says what the recording says.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    # they load SimpleITK
    from echospline.io.sequence import read_sequence
    from echospline.io.sequence_space import face_grid, paths_in_scene
    from echospline.scenario.run_space import run_space
    from echospline.scenario.space_models import build_spatial_model

    spacing = changes.pop("image.spacing", None)
    for key in changes:
        if key == "output.fps" or key.startswith(("space.probe", "space.needle", "needle.")):
            raise InputError(f"{key} has no meaning here, because {MOVED}")
    scenario, folder = scenario_from(volume, changes)
    image = scenario.image.file
    if image.startswith("sample:") and not scenario_room.is_spatial(scenario):
        raise InputError(
            f"--volume takes a volume (MetaImage, NRRD, NIfTI, sample:kidney, sample:spine) or a scenario with [space]; {image} is a picture"
        )
    opened = scenario_room.open_spatial(scenario, folder)
    scenario, space = opened.scenario, opened.scenario.space
    assert space is not None  # opened scenes have it
    calibration = openigtlink.read_calibration(config) if config else {}
    sequence = read_sequence(file)
    if sequence.frames.ndim == 4:
        raise InputError(f"{file} is in colour; a volume gives grey pictures: convert it to grey")
    grid = face_grid(sequence, _pair(face, "--face"), _pair(spacing, "--spacing"), calibration)
    low = np.array(opened.volume.origin)
    paths = paths_in_scene(
        sequence,
        grid,
        place_of(scenario, folder, opened.volume, place),
        (low, low + np.array(opened.volume.size)),
        needle=needle_frame,
        reference=reference,
        axis=axis_of(needle_axis),
        calibration=calibration,
    )
    say([*opened.notes, *scenario_room.unused_doubts(scenario), *paths.notes], "note")
    probe = space.probe
    fields = type(probe).model_fields
    if all(getattr(probe, name) == fields[name].default for name in ("shape", "width", "depth", "pixel")):
        probe = probe.model_copy(update=picture_of(grid))
    rows = [
        (float(t), *(float(v) for v in plane.matrix[:3, 3]), *probe_angles(plane))
        for t, plane in zip(paths.planes.times, paths.planes.planes, strict=True)
    ]
    i = paths.insertion
    needle = [tuple(float(v) for v in row) for row in np.column_stack((i.times, i.entry, i.tip))]
    space = space.model_copy(
        update={
            "probe": probe.model_copy(update={"path": rows, "view": None}),
            "needle": space.needle.model_copy(update={"path": needle}),
        }
    )
    output = scenario.output.model_copy(update={"fps": paths.fps})
    scenario = scenario.model_copy(update={"space": space, "output": output})
    model = build_spatial_model(scenario, space.grid(opened.volume), opened.tissue)
    comparison = Comparison(sequence.frames, grid, paths, space.probe.probe())
    console = Console(stderr=True)
    columns = (TextColumn("simulating"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    quiet = as_json or not console.is_terminal
    with claimed(out), Progress(*columns, console=console, transient=True, disable=quiet) as bar:
        task = bar.add_task("simulating", total=None)
        report = run_space(
            scenario, opened.volume, model, out, folder, watch=comparison.add, doubts=paths.notes,
            progress=lambda done, count: bar.update(task, completed=done, total=count),
        )  # fmt: skip
        write_table(out / "comparison.csv", comparison.rows)
    say(doubt for doubt in report["doubts"] if doubt not in paths.notes)
    told = {"recording": file.name, **comparison.medians(), "results": str(out)}
    if as_json:
        print(json.dumps(told, indent=2))
        return
    print(f"{comparison}\nresults in {out}: {', '.join(report['files'])}, comparison.csv")


class Comparison:
    """Recorded pictures beside simulated ones, frame by frame.

    Parameters
    ----------
    frames : ndarray, shape (n, rows, columns)
        All pictures of the recording.
    grid : RegularGrid
        Their pixels in the frame of the probe's picture.
    paths : SpatialRecording
        Which of them are played, and when.
    probe : Probe
        Of the simulated pictures.
    """

    def __init__(self, frames: Pixels, grid: RegularGrid, paths: SpatialRecording, probe: Probe) -> None:
        self._frames, self._paths, self._probe = frames, paths, probe
        middle = -np.array(grid.origin) / np.array(grid.spacing)
        self._index = probe.grid.nodes @ np.linalg.inv(paths.pixels).T + middle
        self._first = self._recorded(0)
        self.rows: list[dict[str, float]] = []

    def _recorded(self, k: int) -> Floats:
        """Interpolate the recorded picture at the pixels of the probe, shape (rows, columns); 0 beyond it."""
        from scipy.ndimage import map_coordinates

        columns, rows = self._index.T
        pixels = self._frames[self._paths.pictures[k]].astype(np.float64)
        found: Floats = map_coordinates(pixels, [rows, columns], order=1, cval=0.0)
        return found.reshape(self._probe.grid.shape[::-1])

    def add(self, frame: SpatialFrame) -> None:
        """Compare a frame with the picture recorded then, where both show something."""
        seen, drawn = self._recorded(frame.index), np.asarray(frame.image.pixels, dtype=np.float64)
        mask = self._probe.mask
        both = (seen > 0) & (drawn > 0) & mask
        x, y, z = frame.plane.matrix[:3, 3]
        self.rows.append(
            {
                "time_s": float(self._paths.times[frame.index]),
                "probe_x_mm": float(x), "probe_y_mm": float(y), "probe_z_mm": float(z),
                "tip_x_mm": frame.pose.tip[0], "tip_y_mm": frame.pose.tip[1], "tip_z_mm": frame.pose.tip[2],
                "depth_mm": frame.pose.depth,
                "tip_from_plane_mm": frame.pose.seen_from(frame.plane)[1][2],
                "outside_share": frame.outside,
                "compared_share": float(both.sum() / mask.sum()),
                "correlation_simulated": correlation(drawn[both], seen[both]) if both.any() else float("nan"),
                "correlation_still": correlation(self._first[both], seen[both]) if both.any() else float("nan"),
            }
        )  # fmt: skip

    def medians(self) -> dict[str, Any]:
        """Return number of frames, duration, deepest insertion and median correlations; None where nothing was compared."""
        compared = [row for row in self.rows if row["compared_share"] > 0]
        told: dict[str, Any] = {
            "frames": len(self.rows),
            "duration_s": float(self._paths.times[-1]),
            "deepest_mm": max(row["depth_mm"] for row in self.rows),
            "frames_compared": len(compared),
        }
        for name in ("correlation_simulated", "correlation_still"):
            told[f"median_{name}"] = float(np.median([row[name] for row in compared])) if compared else None
        return told

    def __str__(self) -> str:
        m = self.medians()
        what = "nothing to compare: where one picture shows something, the other is black"
        if m["frames_compared"]:
            what = (
                "median correlation with what was seen, where both show something: simulated "
                f"{m['median_correlation_simulated']:.3f}, first frame {m['median_correlation_still']:.3f}"
            )
        return f"{m['frames']} frames in {m['duration_s']:.1f} s, needle down to {m['deepest_mm']:.1f} mm; {what}"


def picture_of(grid: RegularGrid) -> dict[str, Any]:
    """Return shape and size of a linear probe whose picture covers a recorded one from the probe's face down, as keys of [space.probe]."""
    x0, x1, _, bottom = grid.extent
    return {
        "shape": "linear",
        "width": 2.0 * max(-x0, x1),
        "depth": bottom,
        "pixel": min(grid.spacing),
    }


def _pair(text: str | None, flag: str) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"{flag} expects two numbers A,B; got {text!r}") from None
    return first, second
