"""``echospline reconstruct``: a volume from a tracked sweep."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Annotated, cast

import numpy as np
import typer
from rich.progress import Progress

from echospline.cli.options import integers
from echospline.errors import InputError
from echospline.io.sequence import read_sequence
from echospline.io.volume_writing import write_volume
from echospline.laboratory.reconstruct import Insertion, reconstruct
from echospline.openigtlink import read_calibration
from echospline.scene import transform_between


def reconstruct_command(
    sweep: Annotated[
        Path, typer.Argument(metavar="SWEEP", help="NAME.igs.mha of PLUS, or NAME.seq.nrrd of PLUS or Slicer")
    ],
    out: Annotated[Path, typer.Option("--out", help="the volume, NAME.mha")] = Path("volume.mha"),
    config: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.xml",
            help="PLUS device set file with the calibration that the sweep lacks (ImageToProbe)",
        ),
    ] = None,
    frame: Annotated[
        str, typer.Option(metavar="FRAME", help="frame whose axes the volume has, as the tracker names it")
    ] = "Reference",
    spacing: Annotated[float, typer.Option(metavar="MM", help="of the voxels, mm")] = 0.5,
    insertion: Annotated[
        str,
        typer.Option(
            metavar="linear|nearest", help="a pixel is shared by eight voxels, or belongs to the nearest"
        ),
    ] = "linear",
    region: Annotated[
        str | None, typer.Option(metavar="L,T,R,B", help="pixels that hold tissue, the last two just outside")
    ] = None,
    fill: Annotated[
        int,
        typer.Option(metavar="N", help="longest line of voxels with measured ends that is filled; 0: none"),
    ] = 9,
    as_json: Annotated[
        bool, typer.Option("--json", help="print what was made as JSON, nothing else")
    ] = False,
) -> None:
    """Make a volume from a tracked sweep: every picture is put where the probe was, and small gaps are filled."""
    began = perf_counter()
    sequence = read_sequence(sweep)
    calibration = read_calibration(config) if config else {}
    kept, matrices = [], []
    for i in np.flatnonzero(sequence.valid):
        matrix = transform_between({**calibration, **sequence.known(int(i))}, "Image", frame)
        if matrix is not None:
            kept.append(int(i))
            matrices.append(matrix)
    if not kept:
        raise InputError(
            f"no chain of transforms leads from Image to {frame} in {sweep}; it has "
            f"{', '.join(sorted(sequence.transforms)) or 'no transforms'}"
            + (f", {config} adds {', '.join(sorted(calibration)) or 'none'}" if config else "")
            + ": give --config FILE.xml with ImageToProbe, or another --frame"
        )
    frames = sequence.frames[kept]
    if frames.ndim == 4:
        raise InputError(f"{sweep} is in colour; a volume is made from grey pictures")
    with Progress(transient=True, disable=as_json) as bar:
        task = bar.add_task("frames", total=len(kept))
        volume = reconstruct(
            frames,
            np.array(matrices),
            spacing,
            insertion=cast(Insertion, insertion),
            region=_region(region),
            fill=fill,
            progress=lambda done, _: bar.update(task, completed=done),
        )
    volume = replace(volume, frame=frame, source=sweep.name)
    write_volume(out, volume)
    share = 1.0 if volume.filled is None else float(volume.filled.mean())
    told = {
        "frames": len(kept),
        "frames_left_out": len(sequence) - len(kept),
        "voxels": list(volume.shape),
        "spacing_mm": spacing,
        "origin_mm": list(volume.origin),
        "filled_share": share,
        "seconds": perf_counter() - began,
        "volume": str(out),
    }
    if as_json:
        print(json.dumps(told, indent=2))
        return
    left_out = (
        f" ({told['frames_left_out']} without a picture or a transform left out)"
        if told["frames_left_out"]
        else ""
    )
    print(
        f"{len(kept)} frames{left_out} into {' x '.join(str(n) for n in volume.shape)} voxels of {spacing:g} mm in {told['seconds']:.1f} s; "
        f"{100 * share:.0f} % of them hold a value\nvolume in {out}, in the frame {frame}, mm"
    )


def _region(text: str | None) -> tuple[int, int, int, int] | None:
    if text is None:
        return None
    try:
        left, top, right, bottom = integers(text)
    except ValueError:
        raise InputError(f"--region expects four whole numbers L,T,R,B; got {text!r}") from None
    return left, top, right, bottom
