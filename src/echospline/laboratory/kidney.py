"""``sample:kidney``, made on first use and kept in the user's cache folder.

The kept file may be deleted at any time. It is whole or not there, carries a digest of the recipe in its name, and is made
anew when it is damaged; without a folder to write to, the sample is made anew in every process.
"""

from __future__ import annotations

import os
import sys
import zipfile
import zlib
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from importlib.resources import files
from pathlib import Path

import numpy as np

from echospline.atomic import appearing
from echospline.errors import InputError
from echospline.laboratory.kidney_recipe import (
    CELLS,
    VOXEL,
    BuiltTissue,
    LabelledTissue,
    build_tissue,
    build_volume,
)
from echospline.laboratory.scattering import Faces
from echospline.laboratory.sonogram import SpatialPhantom
from echospline.scene import Volume

SEED = 1
"""The patient of ``sample:kidney``."""
_RECIPE = ("anatomy.py", "kidney_recipe.py", "scattering.py", "beam_lattice.py", "sonogram.py")
_FACES = ("points", "amplitudes", "normals", "powers")


@dataclass(frozen=True, eq=False)
class Kidney:
    """One synthetic patient.

    Parameters
    ----------
    volume : Volume
        B-mode, 8-bit, the surface at y = 0, its axes x lateral, y depth, z elevation.
    built : BuiltTissue
        Cells, faces and attenuation.
    seed : int
    """

    volume: Volume
    built: BuiltTissue
    seed: int

    @cached_property
    def tissue(self) -> LabelledTissue:
        """Labels and stiffness on the voxels of the volume."""
        return self.built.tissue(self.volume)

    @cached_property
    def phantom(self) -> SpatialPhantom:
        """Scatterers and faces, which image any plane anew; about 120 MB."""
        return self.built.phantom(self.seed)


def kidney(seed: int = SEED, *, keep: bool = True) -> Kidney:
    """Return a synthetic patient: from the cache folder, or made anew (about 20 s) and kept there.

    Parameters
    ----------
    seed : int
        The patient.
    keep : bool
        Whether to read and write the cache folder.
    """
    path = cache_path(seed) if keep else None
    if path is not None and (found := _load(path, seed)) is not None:
        return found
    built = build_tissue(seed)
    made = Kidney(build_volume(built.phantom(seed)), built, seed)
    if path is not None:
        _save(path, made)
    return made


def cache_path(seed: int = SEED) -> Path | None:
    """Return the file that keeps a patient: in XDG_CACHE_HOME or the system's cache folder; None for a user without a home."""
    named = os.environ.get("XDG_CACHE_HOME")
    try:
        if named:
            folder = Path(named)
        elif sys.platform == "win32":
            folder = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
        elif sys.platform == "darwin":
            folder = Path.home() / "Library" / "Caches"
        else:
            folder = Path.home() / ".cache"
    except RuntimeError:
        return None
    digest = sha256()
    for name in _RECIPE:
        digest.update(files("echospline.laboratory").joinpath(name).read_bytes())
    return folder / "echospline" / f"kidney-{seed}-{digest.hexdigest()[:12]}.npz"


def _save(path: Path, made: Kidney) -> None:
    """Keep a patient, in place of those of older recipes; a folder that refuses is left alone."""
    built = made.built
    with suppress(InputError), appearing(path) as part, part.open("wb") as file:
        np.savez(
            file, voxels=made.volume.voxels, origin=np.array(made.volume.origin), labels=built.labels,
            levels=built.levels, attenuation=built.attenuation, gain=built.gain,
            **{name: getattr(built.faces, name) for name in _FACES},
        )  # fmt: skip
    for old in path.parent.glob(f"kidney-{made.seed}-*.npz"):
        if old != path:
            with suppress(OSError):
                old.unlink()


def _load(path: Path, seed: int) -> Kidney | None:
    """Read a kept patient; None where there is none, or a damaged one."""
    nx, ny, nz = CELLS
    expected = {
        "labels": (nz, ny, nx),
        "levels": (nz, ny, nx),
        "attenuation": (nz, ny // 2, nx),
        "gain": (ny // 2,),
    }
    try:
        with np.load(path, allow_pickle=False) as kept:
            found = {name: kept[name] for name in (*expected, *_FACES, "voxels", "origin")}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
        return None
    if any(found[name].shape != shape for name, shape in expected.items()):
        return None
    x, y, z = found["origin"]
    volume = Volume(found["voxels"], VOXEL, (float(x), float(y), float(z)), source="sample:kidney")
    faces = Faces(found["points"], found["amplitudes"], found["normals"], found["powers"])
    built = BuiltTissue(found["labels"], found["levels"], found["attenuation"], found["gain"], faces)
    return Kidney(volume, built, seed)
