"""``echospline track``: speckle tracking of a recorded or synthetic cine."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from dataclasses import asdict
from math import isfinite
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import typer

from echospline import io as io_room
from echospline import scenario as scenario_room
from echospline import tracking
from echospline.cli.options import say
from echospline.errors import InputError
from echospline.io import LIMIT, MIB
from echospline.scene import Cine, Echo, EchoCine, Floats, NeedlePose, RegularGrid, UltrasoundImage

if TYPE_CHECKING:
    from echospline.cli.track_frames import FileFrames


def track(
    cine: Annotated[
        str,
        typer.Argument(
            metavar="CINE",
            help="echoes.npz of a phantom, a cine of any readable format, or RF lines in a Matlab or HDF5 file",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="FIELD: .npz or .mha")] = Path("out/track.npz"),
    spacing: Annotated[
        str | None, typer.Option(metavar="LAT,DEPTH", help="mm per pixel, where the file does not say")
    ] = None,
    fps: Annotated[
        float | None, typer.Option(metavar="N", help="frames per second, where the file does not say")
    ] = None,
    crop: Annotated[
        str | None, typer.Option(metavar="L,T,R,B", help="pixels to keep: rulers and letters are not tissue")
    ] = None,
    rf: Annotated[
        float | None,
        typer.Option("--rf", metavar="MHZ", help="the cine holds RF lines of this centre frequency"),
    ] = None,
    sound_speed: Annotated[float, typer.Option(metavar="MM_US", help="with --rf: mm/us")] = 1.54,
    variable: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="with --rf: the array in a Matlab or HDF5 file, NAME{1} for a cell"
        ),
    ] = None,
    axes: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,C",
            help="with --rf: its axes; depth,line,frame in Matlab files and frame,depth,line in HDF5 where not given",
        ),
    ] = None,
    channels: Annotated[
        float | None,
        typer.Option(
            metavar="MM",
            help="with --rf: it holds channel data of plane waves sent straight ahead, elements so far apart",
        ),
    ] = None,
    sampling: Annotated[
        float | None, typer.Option(metavar="MHZ", help="with --rf: samples per us, where the file has no fs")
    ] = None,
    start: Annotated[
        float, typer.Option(metavar="US", help="with --channels: time of the first sample after transmission")
    ] = 0.0,
    grid: Annotated[float, typer.Option(metavar="MM", help="distance of the tracked points")] = 0.5,
    roi: Annotated[
        str | None, typer.Option(metavar="X0,Y0,X1,Y1", help="track inside this box only, mm")
    ] = None,
    needle: Annotated[
        Path | None,
        typer.Option(
            help="path of the needle, which is masked: CSV (time_s,entry_x_mm,...) or displacement.npz"
        ),
    ] = None,
    ahead: Annotated[
        float | None,
        typer.Option(
            metavar="MM", help="with --needle: a region of 2 x 3 mm whose centre is so far ahead of the tip"
        ),
    ] = None,
    mask: Annotated[float, typer.Option(metavar="MM", help="half width of the masked needle")] = 1.0,
    method: Annotated[
        str, typer.Option(help="flow (dense flow, carrier phase with echoes) or block")
    ] = "flow",
    reference: Annotated[
        str, typer.Option(help="keyframe (few links, little drift), first or previous")
    ] = "keyframe",
    step: Annotated[float, typer.Option(metavar="MM", help="largest motion per link of keyframe")] = 0.6,
    preview: Annotated[
        Path | None, typer.Option(metavar="PNG", help="picture with arrows; beside FIELD where not given")
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(
            metavar="NPZ",
            help="displacement.npz of the simulation that made the cine: says how far the track is off",
        ),
    ] = None,
    limit: Annotated[
        float, typer.Option(min=1, metavar="MIB", help="most memory for frames and track, MiB")
    ] = LIMIT,
    json_: Annotated[bool, typer.Option("--json", help="print the report as JSON, nothing else")] = False,
) -> None:
    """Track the motion of tissue through a cine.

    Writes points, displacement against the first frame (lateral and axial, mm), the needle and a confidence per point
    and frame (0 to 1); `identify` reads it. Points that lost their speckle take their neighbours' motion, and their
    confidence says so.
    """
    from rich.console import Console
    from rich.progress import track as counted

    from echospline.cli.track_frames import Lines, open_frames

    began = perf_counter()
    given = {"--variable": variable, "--axes": axes, "--channels": channels, "--sampling": sampling}
    if rf is None and (extra := next((flag for flag, value in given.items() if value is not None), None)):
        raise InputError(f"{extra} describes RF lines: give --rf MHZ, their centre frequency, too")
    lines = None if rf is None else Lines(
        positive(rf, "--rf"), positive(sound_speed, "--sound-speed"), variable,
        None if axes is None else tuple(part.strip() for part in axes.split(",")),
        None if channels is None else positive(channels, "--channels"),
        None if sampling is None else positive(sampling, "--sampling"), start,
    )  # fmt: skip
    known = (
        None if truth is None else tracking.read_track(truth)
    )  # read first: a mistake is said before the work
    frames = open_frames(
        cine,
        spacing=None if spacing is None else numbers(spacing, 2, "--spacing"),
        fps=None if fps is None else positive(fps, "--fps"),
        crop=None if crop is None else [int(v) for v in numbers(crop, 4, "--crop")],
        lines=lines,
        limit=limit,
    )
    say(frames.notes, "note")
    say(scenario_room.size_doubts(frames.grid, "--spacing"))
    path = None if needle is None else io_room.read_needle(needle)
    if path is not None:
        say(scenario_room.needle_doubts(path, frames.grid))
    poses = None if path is None else [path.pose(t) for t in frames.times]
    if ahead is not None and poses is None:
        raise InputError("--ahead needs --needle: the region travels before its tip")
    if ahead is not None and out.suffix.lower() == ".mha":
        raise InputError("--ahead tracks scattered points, which .mha cannot hold: write .npz")
    box = None if roi is None else numbers(roi, 4, "--roi")
    chosen = (
        tracking.grid_over(frames.grid.extent, grid, box)
        if ahead is None
        else swept(poses or [], ahead, frames.grid)
    )
    # a grid knows how many points it has before they are laid out
    count = chosen.size if isinstance(chosen, RegularGrid) else len(chosen)
    need = frames.mib(count)
    if need > limit:
        raise InputError(
            f"tracking {count:,} points in {len(frames)} frames needs about {need:,.0f} MiB, more than the limit of "
            f"{limit:,.0f} MiB: choose a wider --grid, a smaller --roi, or raise --limit"
        )
    if not json_:
        say([f"{count:,} points in {len(frames)} frames: about {need:,.0f} MiB"], "note")
    points = chosen.nodes if isinstance(chosen, RegularGrid) else chosen
    wrap: Any = (
        iter
        if json_
        else lambda it: counted(list(it), "tracking", console=Console(stderr=True), transient=True)
    )
    found = tracking.track(
        frames,
        points,
        tracker(method),
        reference=named_reference(reference),
        step=step,
        needle=poses,
        needle_radius=mask,
        progress=wrap,
    )
    if ahead is not None and poses is not None:
        # a point outside the region of its frame is not needed
        here = np.stack([tracking.inside_ahead(points, pose, ahead) for pose in poses])
        found = tracking.Track(
            found.points, found.times, found.displacement, found.confidence * here, found.keyframes
        )
    tracking.write_track(out, found, poses)
    report = summary(found, perf_counter() - began)
    if known is not None:
        say(tracking.truth_doubts(found, known))
        report["against_truth"] = {
            k: round(v, 4) if isfinite(v) else None for k, v in asdict(tracking.score(found, known)).items()
        }
    picture = preview or out.with_suffix(".png")
    draw(frames, found, poses, picture)
    if json_:
        json.dump(report | {"files": [str(out), str(picture)]}, sys.stdout, indent=1)
        print()
        return
    Console().print(
        f"{report['points']} points in {report['frames']} frames in {report['seconds']:.1f} s, {report['keyframes']} keyframes; "
        f"largest trusted motion {report['largest_mm']:.3f} mm, {report['trusted']:.0%} trusted, {report['trusted_last_frame']:.0%} in the last frame; wrote {out} and {picture}"
    )
    if known is not None:
        Console().print(_against_truth(report["against_truth"]))


def _against_truth(score: dict[str, Any]) -> str:
    """Return in one sentence how far a track is from the truth."""
    if not score["points"]:
        return "no trusted point has a truth: tissue left the picture, or the track is of another part of it"
    gone = (
        ""
        if score["gone_trusted"] is None
        else f"; of what left the slice or the picture {score['gone_trusted']:.0%} is trusted all the same"
    )
    return (
        f"against the truth: {score['axial_um']:.1f} um axial, {score['lateral_um']:.1f} um lateral (root mean square; the motion {score['motion_um']:.0f} um), "
        f"{score['outliers']:.1%} miss by 0.1 mm or more, {score['followed']:.0%} of what can be followed is trusted{gone}"
    )


def load(
    cine: str,
    *,
    spacing: str | None = None,
    fps: float | None = None,
    crop: str | None = None,
    rf: float | None = None,
    sound_speed: float = 1.54,
) -> Cine | EchoCine:
    """Read a whole cine of pictures or of echoes; echoes in units of the first frame's root mean square."""
    from echospline.cli.track_frames import Lines, open_frames

    frames = open_frames(
        cine,
        spacing=None if spacing is None else numbers(spacing, 2, "--spacing"),
        fps=fps,
        crop=None if crop is None else [int(v) for v in numbers(crop, 4, "--crop")],
        lines=None if rf is None else Lines(rf, sound_speed),
    )
    if (size := frames.grid.size * len(frames) * 8 / MIB) > LIMIT:
        raise InputError(f"{cine} needs about {size:,.0f} MiB at once, more than {LIMIT:,.0f} MiB: cut it")
    kept = list(frames)
    echoes = [frame for frame in kept if isinstance(frame, Echo)]
    if not echoes:
        pictures = [frame for frame in kept if isinstance(frame, UltrasoundImage)]
        stack = np.stack([picture.pixels for picture in pictures])
        return Cine(stack, frames.times, frames.grid, pictures[0].source, frames.notes)
    iq = np.stack([echo.iq for echo in echoes])
    level = float(np.sqrt(np.mean(np.abs(iq[0]).astype(np.float64) ** 2))) if rf is not None else 1.0
    return EchoCine(iq / level if level > 0 else iq, frames.times, frames.grid, echoes[0].carrier)


def positive(value: float, option: str) -> float:
    """Refuse a number that is not positive."""
    if not (np.isfinite(value) and value > 0):
        raise InputError(f"{option} takes a positive number; got {value}")
    return value


def tracker(method: str) -> tracking.Tracker:
    """Return the method of that name."""
    known: dict[str, tracking.Tracker] = {"flow": tracking.FlowTracker(), "block": tracking.BlockMatching()}
    if method not in known:
        raise InputError(f"--method is flow or block; got {method!r}")
    return known[method]


def named_reference(reference: str) -> tracking.Reference:
    """Check the name of a reference."""
    names: dict[str, Literal["keyframe", "first", "previous"]] = {
        "keyframe": "keyframe",
        "first": "first",
        "previous": "previous",
    }
    if reference not in names:
        raise InputError(f"--reference is keyframe, first or previous; got {reference!r}")
    return names[reference]


def numbers(text: str, count: int, option: str) -> list[float]:
    """Read numbers between commas."""
    try:
        values = [float(v) for v in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count:
        raise InputError(f"{option} takes {count} numbers with commas between them; got {text!r}")
    return values


def swept(poses: Iterable[NeedlePose], distance: float, grid: RegularGrid) -> Floats:
    """Return the points of the region ahead of the tip over all frames, on one lattice of 0.2 mm, inside the picture."""
    found = [tracking.region_ahead(pose, distance) for pose in poses if pose.depth > 0]
    points = np.concatenate(found) if found else np.empty((0, 2))
    lattice = np.unique(np.rint(points / 0.2).astype(int), axis=0) * 0.2
    lattice = lattice[grid.contains(lattice)]
    if len(lattice) == 0:
        raise InputError(f"the region {distance:g} mm ahead of the tip never lies inside the picture")
    return np.asarray(lattice, dtype=np.float64)


def summary(found: tracking.Track, seconds: float) -> dict[str, Any]:
    """Summarise the motion; frame 0, which is not measured, does not count as trusted."""
    trusted = found.confidence >= 0.3
    size = np.hypot(found.displacement[..., 0], found.displacement[..., 1])
    return {
        "frames": len(found.times),
        "points": len(found.points),
        "keyframes": len(found.keyframes),
        "trusted": float(trusted[1:].mean()) if len(trusted) > 1 else 0.0,
        "trusted_last_frame": float(trusted[-1].mean()),
        "largest_mm": float(size[trusted].max(initial=0.0)),
        "seconds": round(seconds, 3),
    }


def draw(frames: FileFrames, found: tracking.Track, poses: list[NeedlePose] | None, path: Path) -> None:
    """Draw the arrows of the frame that moved most over the first picture."""
    # matplotlib is slow to load
    from echospline.picture.summary import tracking_figure

    first = next(iter(frames))
    grey, _, grid = tracking.grey_pair(*tracking.levelled(first, first))
    size = np.hypot(found.displacement[..., 0], found.displacement[..., 1]) * (found.confidence >= 0.3)
    k = int(size.max(axis=1).argmax())
    tracking_figure(
        grey, grid, found.points, found.displacement[k], found.confidence[k], path,
        pose=None if poses is None else poses[k], title=f"{found.times[k]:.2f} s",
    )  # fmt: skip
