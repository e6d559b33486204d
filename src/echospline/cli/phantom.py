"""``echospline phantom``: a synthetic ultrasound cine of scatterers moved by a tissue model, with its true motion."""

from __future__ import annotations

import json
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import typer

from echospline import io as io_room
from echospline import laboratory
from echospline import picture as picture_room
from echospline import scenario as scenario_room
from echospline import scene as scene_room
from echospline.atomic import claimed
from echospline.cli.options import say, scenario_from, with_scenario_options
from echospline.errors import InputError


@with_scenario_options
def phantom(
    source: Annotated[
        str, typer.Argument(metavar="SCENARIO", help="a scenario (.toml); its image is not used")
    ],
    out: Annotated[Path, typer.Option("--out", help="folder for the results")] = Path("out/phantom"),
    echoes: Annotated[
        bool, typer.Option("--echoes/--no-echoes", help="write echoes.npz: complex baseband of every frame")
    ] = True,
    rf: Annotated[
        bool, typer.Option("--rf", help="write rf.mha too: real lines at the probe's sampling")
    ] = False,
    json_: Annotated[bool, typer.Option("--json", help="print the report as JSON, nothing else")] = False,
    changes: dict[str, Any] | None = None,
) -> None:
    """Image a phantom of point scatterers while a needle deforms it.

    The tissue model of the scenario moves the scatterers, and every frame is formed from them: speckle decorrelates as in
    tissue. Writes the cine, `displacement.npz` (the true motion), `echoes.npz` (for `track`), `summary.png`,
    `scenario.toml` and `run.json`. The tables [probe] and [phantom] describe probe and phantom.
    """
    from rich.console import Console

    if not source.lower().endswith(".toml"):
        raise InputError(
            f"phantom takes a scenario (.toml) with tables [probe] and [phantom]; got {source!r}"
        )
    scenario, folder = scenario_from(source, changes or {})
    report = phantom_into(scenario, out, folder, echoes=echoes, rf=rf, quiet=json_)
    if json_:
        json.dump(report, sys.stdout, indent=2)
        print()
        return
    Console().print(
        f"{report['frames']} frames of {report['phantom']['scatterers']} scatterers in {report['seconds']:.1f} s, largest "
        f"displacement {report['largest_displacement_mm']:.2f} mm; results in {out}"
    )


def phantom_into(
    scenario: scenario_room.Scenario,
    out: Path,
    folder: Path,
    *,
    echoes: bool,
    rf: bool = False,
    quiet: bool = True,
) -> dict[str, Any]:
    """Run a scenario on its phantom; returns the report of `run` with a table ``phantom``."""
    import numpy as np
    from rich.console import Console
    from rich.progress import track as counted

    # the resolved scenario names its own picture, so that simulate and identify use the same mesh
    scenario = scenario.with_values(
        {
            "image.file": scenario_room.PHANTOM,
            "image.region": None,
            "image.spacing": None,
            "image.window": None,
        }
    )
    section, probe = scenario.phantom, scenario.probe.probe()
    scattered = section.phantom(probe)
    display = section.display()
    still = scattered.form(noise_seed=scattered.seed)
    image = scene_room.UltrasoundImage(
        still.b_mode(display, scattered.grid).pixels, scattered.grid, "speckle phantom"
    )
    doubts = scenario_room.check(scenario, image, out)
    say(doubts)
    model = scenario_room.build_model(scenario, scenario.grid(image), folder=folder)
    count = picture_room.frame_count(scenario.insertion(), scenario.output.fps)
    fps = scenario.output.fps
    with ExitStack() as stack:
        stack.enter_context(claimed(out))
        writer = (
            stack.enter_context(
                io_room.EchoWriter(out / "echoes.npz", count, scattered.samples, probe.carrier)
            )
            if echoes
            else None
        )
        lines = None
        if rf:
            grid = still.rf(probe.sampling, probe.sound_speed)[1]
            lines = stack.enter_context(io_room.open_writer(out / "rf.mha", grid, fps))
        bar = iter(
            counted(range(count), "imaging", console=Console(stderr=True), disable=quiet, transient=True)
        )

        def record(index: int, echo: scene_room.Echo) -> None:
            next(bar, None)
            if writer is not None:
                writer.add(echo, index / fps)
            if lines is not None:
                lines.add(echo.rf(probe.sampling, probe.sound_speed)[0].astype(np.float32), index / fps)

        former = laboratory.phantom_pictures(
            scattered, display=display, fps=fps, out_of_plane=section.out_of_plane, record=record
        )
        report = scenario_room.run(scenario, image, model, out, folder, form_image=former, doubts=doubts)
    report["phantom"] = described(scattered, still)
    report["files"] += [name for name, made in (("echoes.npz", echoes), ("rf.mha", rf)) if made]
    return report


def described(phantom: laboratory.Phantom, still: scene_room.Echo) -> dict[str, Any]:
    """Describe the phantom, and the statistics of its speckle at rest."""
    found = laboratory.speckle_statistics(still.envelope(), still.grid.spacing)
    return {
        "scatterers": len(phantom.scatterers.amplitudes),
        "carrier_per_mm": phantom.probe.carrier,
        "wavelength_mm": phantom.probe.wavelength,
        "point_spread_mm": {
            "axial": 2.355 * phantom.probe.sigma_axial,
            "lateral": 2.355 * phantom.probe.sigma_lateral,
        },
        "speckle": {
            "envelope_snr": found.snr,
            "rayleigh_distance": found.distance,
            "width_axial_mm": found.axial,
            "width_lateral_mm": found.lateral,
        },
    }
