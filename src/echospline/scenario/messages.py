"""Messages: the fault of a scenario in one sentence, and the meaning of a key for help texts."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import Any

from pydantic import BaseModel
from pydantic_core import ErrorDetails, PydanticUndefined


def describe(root: type[BaseModel], key: str) -> str:
    """Describe a key of the tables below ``root``: ``"needle.depth"`` -> its description with range and default."""
    *tables, last = key.split(".")
    section = _section_of(root, tables)
    if section is None:
        raise KeyError(key)
    field = section.model_fields[last]
    limits = {type(m).__name__: m for m in field.metadata}
    words = [field.description or ""]
    low = limits.get("Ge") or limits.get("Gt")
    high = limits.get("Le") or limits.get("Lt")
    if low is not None or high is not None:
        least = "" if low is None else f"{getattr(low, 'ge', getattr(low, 'gt', None)):g}"
        most = "" if high is None else f"{getattr(high, 'le', getattr(high, 'lt', None)):g}"
        words.append(f"range {least} to {most}" if most else f"from {least}")
    if not (field.default in (None, PydanticUndefined) or isinstance(field.default, BaseModel)):
        extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
        words.append(f"default {_plain(field.default, str(extra.get('between', ',')))}")
    return "; ".join(w for w in words if w)


def _plain(value: object, between: str) -> str:
    if isinstance(value, tuple | list):
        return between.join(f"{v:g}" if isinstance(v, float) else str(v) for v in value) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def sentence(root: type[BaseModel], fault: ErrorDetails) -> str:
    """Name the key, the value and the expectation in one sentence."""
    names = [n for n in fault["loc"] if isinstance(n, int) or not _is_branch(str(n))]
    key = ".".join(str(n) for n in names)
    value = fault["input"]
    if fault["type"] == "extra_forbidden":
        known = _keys_beside(root, names)
        near = difflib.get_close_matches(str(names[-1]), known, 1)
        hint = f"did you mean {near[0]}?" if near else f"known here: {', '.join(known)}"
        return f"{key} is not a known key; {hint}"
    if fault["type"] == "missing":
        return f"{key} is missing"
    words = fault["msg"].removeprefix("Value error, ").removeprefix("Input ")
    words = words[0].lower() + words[1:]
    meaning = _meaning(root, names)
    return f"{key} = {shown(value)}: {words}" + (f" ({meaning})" if meaning else "")


def _is_branch(name: str) -> bool:
    """Distinguish pydantic's names of union members ("constrained-float") from keys."""
    return not name.isidentifier() or name in ("float", "list", "tuple")


def shown(value: object) -> str:
    """Return a value as text, cut where it is long."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _section_of(root: type[BaseModel], names: Sequence[Any]) -> type[BaseModel] | None:
    section: Any = root
    for name in names:
        if isinstance(name, int):
            continue
        field = section.model_fields.get(name) if section is not None else None
        inner = getattr(field, "annotation", None)
        for candidate in (inner, *getattr(inner, "__args__", ())):
            if isinstance(candidate, type) and issubclass(candidate, BaseModel):
                section = candidate
                break
        else:
            return None
    return section if isinstance(section, type) else None


def _keys_beside(root: type[BaseModel], names: Sequence[Any]) -> list[str]:
    section = _section_of(root, names[:-1])
    return [] if section is None else list(section.model_fields)


def _meaning(root: type[BaseModel], names: Sequence[Any]) -> str:
    while names and isinstance(names[-1], int):
        names = names[:-1]
    section = _section_of(root, names[:-1])
    field = None if section is None or not names else section.model_fields.get(str(names[-1]))
    return "" if field is None else field.description or ""
