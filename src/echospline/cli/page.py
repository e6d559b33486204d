"""``echospline page``: a scene as one file that simulates in any browser, without a server."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from echospline import page as page_room
from echospline import scenario as scenario_room
from echospline.atomic import appearing
from echospline.cli.options import say, scenario_from, with_scenario_options


@with_scenario_options
def page(
    source: Annotated[
        str,
        typer.Argument(
            metavar="[IMAGE_OR_SCENARIO]",
            help="an image, cine or DICOM file, sample:calf, or a scenario (.toml) with its exercises",
        ),
    ] = "sample:calf",
    out: Annotated[Path, typer.Option(metavar="FILE.html", help="where to write")] = Path("trainer.html"),
    language: Annotated[Literal["en", "de"], typer.Option(help="of the page: en or de")] = "en",
    rate: Annotated[float, typer.Option(min=10, max=1000, help="model steps per second")] = 120.0,
    changes: dict[str, Any] | None = None,
) -> None:
    """Write a scene as one file that simulates: it opens by a double click, offline, on a laptop or a phone.

    The core, the picture, the models and the exercises are inside; nothing is loaded and nothing leaves the page. Sessions
    are exported from it as one JSON, which `echospline sessions import` reads and checks.
    """
    scenario, folder = scenario_from(source, changes or {})
    if scenario_room.is_spatial(scenario):
        opened = scenario_room.open_spatial(scenario, folder, own=False)
        say([*opened.notes, *scenario_room.unused_doubts(opened.scenario)], "note")
        pack = page_room.packed_space(opened, language=language, rate=rate)
    else:
        scenario, image = scenario.opened(folder, eight_bit=True)
        say([*image.notes, *scenario.label_notes(folder)], "note")
        say(scenario_room.size_doubts(image.grid))
        pack = page_room.packed(scenario, image, folder, language=language, rate=rate)
    say(page_room.doubts(scenario, pack), "note")
    html = page_room.bundle(pack)
    data = html.encode()
    with appearing(out) as part:
        part.write_bytes(data)
    print(f"{out}: {len(data) / 1000:.0f} kB")
