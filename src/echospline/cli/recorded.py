"""``echospline recorded``: a tracked procedure, simulated again and compared with its pictures."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Annotated, Any

import typer

from echospline import openigtlink
from echospline import picture as picture_room
from echospline import scenario as scenario_room
from echospline import scene as scene_room
from echospline.atomic import appearing, claimed
from echospline.cli.link import axis_of
from echospline.cli.options import say, scenario_from, with_scenario_options
from echospline.errors import InputError


@with_scenario_options
def recorded(
    file: Annotated[
        Path,
        typer.Argument(metavar="RECORDING", help="NAME.igs.mha of PLUS, or NAME.seq.nrrd of PLUS or Slicer"),
    ],
    out: Annotated[
        Path, typer.Option("--out", help="folder for the results, made where it is not there")
    ] = Path("out"),
    needle_frame: Annotated[
        str, typer.Option(metavar="FRAME", help="frame at the needle's tip")
    ] = "NeedleTip",
    needle_axis: Annotated[
        str, typer.Option(metavar="AXIS", help="direction of insertion in that frame: x, -x, y, -y, z, -z")
    ] = "z",
    config: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.xml", help="PLUS device set file with the calibration that the recording lacks"
        ),
    ] = None,
    volume: Annotated[
        str | None,
        typer.Option(
            metavar="VOLUME",
            help="replay probe and needle in this volume (a file, sample:kidney, sample:spine or a scenario with [space])",
        ),
    ] = None,
    place: Annotated[
        str,
        typer.Option(
            metavar="axial|file|lps",
            help="where the volume stands in the reference frame: in Slicer's axial view, at its file's coordinates (as "
            "reconstruct and PLUS write them), or at those read as LPS",
        ),
    ] = "axial",
    reference: Annotated[
        str, typer.Option(metavar="FRAME", help="frame in which the volume stands")
    ] = "Reference",
    face: Annotated[
        str | None,
        typer.Option(
            metavar="COLUMN,ROW",
            help="pixel in the middle of the probe's face, for a volume  [default: middle of the first row]",
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="print the comparison as JSON, nothing else")
    ] = False,
    changes: dict[str, Any] | None = None,
) -> None:
    """Simulate a recorded procedure again and compare every picture with the recorded one.

    The first good frame is the tissue at rest, the tracked transforms are the needle's path; model and mesh come from the
    options. Writes `resimulated.igs.mha` and `comparison.csv`: for each frame the correlation of the recorded picture with
    the simulated one, and with the first frame (the result without a simulation).

    With --volume the tracked probe moves through the volume as well, and the files are those of `simulate` (cine,
    `displacement.npz` with the plane of every frame, `scenario.toml` ...) and `comparison.csv`. The picture is as large as the
    recorded one, unless the scenario has a probe.
    """
    if volume is not None:
        from echospline.cli.recorded_space import recorded_in_volume

        recorded_in_volume(
            file, volume, out, changes or {}, place=place, reference=reference, face=face, needle_frame=needle_frame,
            needle_axis=needle_axis, config=config, as_json=as_json,
        )  # fmt: skip
        return
    if place != "axial" or face is not None or reference != "Reference":
        raise InputError(
            "--place, --face and --reference belong to a volume: give --volume, or leave them out"
        )
    import numpy as np
    from threadpoolctl import threadpool_limits

    # SimpleITK is slow to load
    from echospline.io.sequence import SequenceWriter, read_sequence

    scenario, folder = scenario_from(str(file), changes or {})
    sequence = read_sequence(file)
    spacing = scenario.image.spacing
    cine, image = sequence.cine(spacing), sequence.image(spacing)
    insertion = sequence.insertion(
        needle_frame,
        spacing=spacing,
        axis=axis_of(needle_axis),
        calibration=openigtlink.read_calibration(config) if config else None,
    )
    say(scenario_room.size_doubts(image.grid) + scenario_room.needle_doubts(insertion, image.grid))
    model = scenario_room.build_model(scenario, scenario.grid(image), folder=folder)
    span = float(insertion.times[-1] - insertion.times[0])
    fps = max(1.0, (len(insertion.times) - 1) / span)
    rows: list[dict[str, float]] = []
    with claimed(out):
        with threadpool_limits(limits=1), SequenceWriter(out / "resimulated.igs.mha", image.grid) as writer:
            for frame in picture_room.simulate(
                image, insertion, model, fps=fps, needle=scenario.needle_echo()
            ):
                time = float(insertion.times[0]) + frame.time
                seen = cine.frames[int(np.argmin(np.abs(cine.times - time)))]
                writer.add(frame.image.pixels, time, frame.pose)
                rows.append(
                    {
                        "time_s": time,
                        "tip_x_mm": frame.pose.tip[0],
                        "tip_y_mm": frame.pose.tip[1],
                        "depth_mm": frame.pose.depth,
                        "correlation_simulated": correlation(frame.image.pixels, seen),
                        "correlation_still": correlation(image.pixels, seen),
                    }
                )
        write_table(out / "comparison.csv", rows)
    told = {
        "recording": file.name,
        "frames": len(rows),
        "duration_s": span,
        "deepest_mm": max(row["depth_mm"] for row in rows),
        "median_correlation_simulated": float(np.median([row["correlation_simulated"] for row in rows])),
        "median_correlation_still": float(np.median([row["correlation_still"] for row in rows])),
        "results": str(out),
    }
    if as_json:
        print(json.dumps(told, indent=2))
        return
    print(
        f"{told['frames']} frames in {span:.1f} s, needle down to {told['deepest_mm']:.1f} mm; median correlation with what was "
        f"seen: simulated {told['median_correlation_simulated']:.3f}, first frame "
        f"{told['median_correlation_still']:.3f}\nresults in {out}: resimulated.igs.mha, comparison.csv"
    )


def correlation(first: scene_room.Pixels, second: scene_room.Pixels) -> float:
    """Compute the normalised cross-correlation of two pictures, -1 to 1; 0 where one is uniform."""
    import numpy as np

    a, b = first.astype(np.float64), second.astype(np.float64)
    a, b = a - a.mean(), b - b.mean()
    scale = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum() / scale) if scale > 0 else 0.0


def write_table(path: Path, rows: list[dict[str, float]]) -> None:
    """Write rows as CSV.

    Raises
    ------
    InputError
        If there are none.
    """
    if not rows:
        raise InputError("nothing was simulated")
    text = io.StringIO()
    table = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    with appearing(path) as part:
        part.write_text(text.getvalue(), encoding="ascii")
