"""The volumes that come with echospline: ``sample:kidney``, which it makes itself, and ``sample:spine``, which it ships."""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import as_file, files

from echospline.errors import InputError
from echospline.laboratory.kidney import kidney
from echospline.laboratory.kidney_recipe import LabelledTissue
from echospline.scene import Volume

SAMPLE_VOLUMES = ("kidney", "spine")


def sample_volume(name: str) -> tuple[Volume, LabelledTissue | None]:
    """Return a volume with y = 0 at the skin, 8-bit, and its tissue where it is known.

    Parameters
    ----------
    name : {"kidney", "spine"}
        kidney: a synthetic patient for percutaneous nephrolithotomy, 112 x 90 x 60 mm, with tissue; made on first use.
        spine: a spine phantom, 73 x 51.5 x 52.5 mm at 0.5 mm; black where the sweep has seen nothing, and without tissue.

    Raises
    ------
    InputError
        If there is no such volume.
    """
    if name == "kidney":
        made = kidney()
        return made.volume, made.tissue
    if name != "spine":
        raise InputError(f"there is no sample volume {name!r}; expected one of: {', '.join(SAMPLE_VOLUMES)}")
    from echospline.io.volume_reading import read_volume  # noqa: PLC0415 - SimpleITK is loaded only for a file

    with as_file(files("echospline").joinpath("data", "spine.mha")) as path:
        volume = read_volume(path, depth="z")
    source = "sample:spine: spine phantom, freehand sweep reconstructed by PLUS; PlusToolkit, PlusLibData, BSD-3-Clause"
    return replace(volume, source=source), None
