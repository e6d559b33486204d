"""Menus whose names are loaded when they are first used, so that a room costs only what is taken from it."""

from __future__ import annotations

import ast
import sys
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any


def on_demand(room: str) -> None:
    """Turn the imports that a package writes under ``if TYPE_CHECKING`` into names that are loaded on first use.

    The imports are written once, where type checkers, editors and the import contract read them; here they are read from the
    package's own source. Names are looked up as PEP 562 has it.

    Parameters
    ----------
    room : str
        ``__name__`` of the package that calls.
    """
    package = sys.modules[room]
    package.__class__ = _Room
    vars(package)["_origins"] = _origins(room)


class _Room(ModuleType):
    """A package that imports a name of its menu when it is asked for."""

    _origins: dict[str, tuple[str, str]]

    def __getattr__(self, name: str) -> Any:
        if name not in self._origins:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        file, own_name = self._origins[name]
        value = getattr(import_module(file), own_name)
        vars(self)[name] = value
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        # Python binds every file to its package under the file's name, which may be that of a function on the menu
        # (`study.identify.identify`): there the menu's name stays.
        if isinstance(value, ModuleType) and name in self._origins:
            value = getattr(value, self._origins[name][1])
        super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *self._origins})


def _origins(room: str) -> dict[str, tuple[str, str]]:
    """Return for each name of the menu the file it comes from and its name there."""
    loader: Any = getattr(find_spec(room), "loader", None)
    source = loader.get_source(room) if hasattr(loader, "get_source") else None
    if source is None:
        raise ImportError(f"the source of {room} is not there: its menu is read from it")
    return {
        alias.asname or alias.name: (line.module, alias.name)
        for block in ast.parse(source).body
        if isinstance(block, ast.If) and isinstance(block.test, ast.Name) and block.test.id == "TYPE_CHECKING"
        for line in block.body
        if isinstance(line, ast.ImportFrom) and line.module
        for alias in line.names
    }
