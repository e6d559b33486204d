"""The scene of a page: its pack, what it was made from, and finite elements of the same tissue."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from echospline.page import Pack
from echospline.scene import Floats, NeedlePose


class Tissue(Protocol):
    """A tissue model; states are values."""

    def rest(self) -> Any:
        """State of tissue that no needle has touched."""
        ...

    def advance(self, state: Any, pose: NeedlePose, dt: float) -> Any:
        """State after the needle has moved to ``pose`` in ``dt`` seconds."""
        ...

    def displacement(self, state: Any) -> Floats:
        """Displacement of the mesh nodes (n, D) in mm."""
        ...


@dataclass(frozen=True)
class Scene:
    """One scene, the same for every page that shows it.

    Parameters
    ----------
    pack : Pack
        What a page simulates.
    source : str
        Description of the scene's origin, stored with each session so that it can be run again; not read here.
    fem : callable or None
        Builds a model of finite elements of the same tissue on the pack's mesh; None where there is none. Passed in, because it
        imports models.
    upload : str
        Name under which its uploaded picture is stored; empty for the scene that the server began with.
    """

    pack: Pack
    source: str = ""
    fem: Callable[[], Tissue] | None = None
    upload: str = ""

    @property
    def title(self) -> str:
        """For display."""
        return self.pack.manifest.title


SceneOpener = Callable[[Path, tuple[float, float] | None], Scene]
"""Builds a scene from an uploaded file and a spacing; passed in, because it imports models."""
