"""The scene in space of ``echospline link`` and ``echospline recorded``: volume, tissue, probe and needle, and where they stand."""

from __future__ import annotations

from pathlib import Path

from echospline import live as live_room
from echospline import openigtlink
from echospline import scenario as scenario_room
from echospline import scene as scene_room
from echospline.cli.options import say
from echospline.errors import InputError

PLACES = ("axial", "file", "lps")


def make_spatial_stage(
    scenario: scenario_room.Scenario, folder: Path, place: str = "axial"
) -> openigtlink.SpatialStage:
    """Build the volume, tissue, probe and needle of a scenario in space, ready to run live.

    Parameters
    ----------
    scenario : Scenario
        The scenario to simulate.
    folder : Path
        Start of its relative paths.
    place : {"axial", "file", "lps"}
        Where the scene stands in the reference frame; see `place_of`.
    """
    from echospline.picture.slices import SliceDrawing
    from echospline.scenario.space_models import build_spatial_model

    opened = scenario_room.open_spatial(scenario, folder)
    say([*opened.notes, *scenario_room.unused_doubts(opened.scenario)], "note")
    kept, space = opened.scenario, opened.scenario.space
    assert space is not None  # opened scenes have it
    insertion = space.needle.insertion()
    planes = space.probe.planes(insertion)
    grid = space.grid(opened.volume)
    entry = insertion.pose(float(insertion.times[0])).entry
    engine = live_room.SpatialEngine(
        lambda kind: build_spatial_model(kept, grid, opened.tissue, kind=kind),
        kept.model.kind,
        SliceDrawing(opened.volume, space.probe.probe()),
        planes.at(float(planes.times[0])),
        scene_room.SpatialPose(entry, entry),
        echo=kept.needle_echo(),
        rate=kept.output.fps,
    )
    return openigtlink.SpatialStage(
        engine,
        scenario_room.MODELS,
        insertion,
        planes if space.probe.path is not None else None,
        place_of(kept, folder, opened.volume, place),
    )


def place_of(
    scenario: scenario_room.Scenario, folder: Path, volume: scene_room.Volume, place: str
) -> scene_room.Floats:
    """Return the motion from the scene to the reference frame, mm.

    Parameters
    ----------
    scenario : Scenario
        Its volume.
    folder : Path
        Start of its relative paths.
    volume : Volume
        As opened.
    place : {"axial", "file", "lps"}
        axial: x to the patient's left, depth to the back, elevation to the head. file: the coordinates of the file are the reference frame's, as
        in volumes that `reconstruct` and PLUS make. lps: the file's coordinates are LPS and the reference frame is RAS, as 3D Slicer loads it.

    Raises
    ------
    InputError
        If there is no such place, or the volume has no file.
    """
    from echospline.scene import AXIAL

    if place not in PLACES:
        raise InputError(f"--place is one of {', '.join(PLACES)}; got {place!r}")
    if place == "axial":
        return AXIAL
    file = scenario.image.file
    if file.startswith("sample:"):
        raise InputError(
            f"--place {place} takes the place from the volume's file; {file} has none: leave it out"
        )
    from echospline.io.volume_place import LPS_TO_RAS, scene_to_file

    space = scenario.space
    depth = (space.depth_axis if space else None) or "y"
    matrix = scene_to_file(folder / file, depth, volume)
    placed: scene_room.Floats = LPS_TO_RAS @ matrix if place == "lps" else matrix
    return placed


def refuse_options_of_the_plane(given: dict[str, tuple[object, object, str]]) -> None:
    """Refuse options that have no meaning in space.

    Parameters
    ----------
    given : dict
        For each flag its value, its default and what to do instead.

    Raises
    ------
    InputError
        If one differs from its default.
    """
    for flag, (value, default, instead) in given.items():
        if value != default:
            raise InputError(f"{flag} belongs to scenes in the plane; for a volume {instead}")


def summary_in_space(stage: openigtlink.SpatialStage) -> str:
    """Describe a stage in a line."""
    engine = stage.engine
    x, y, z = engine.drawing.volume.size
    x0, x1, y0, y1 = engine.drawing.probe.grid.extent
    newest = engine.snapshots.latest()
    name = newest.value.model if newest else ""
    return (
        f"volume {x:.0f} x {y:.0f} x {z:.0f} mm, picture {x1 - x0:.1f} x {y1 - y0:.1f} mm, "
        f"{name} on {engine.model.grid.size} nodes"
    )
