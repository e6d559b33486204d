"""Numbers as they come from callers: anything may be given, and what is no number is said in the words of the others."""

from __future__ import annotations

from math import isfinite
from numbers import Real


def is_number(value: object) -> bool:
    """Return whether a value is one finite real number; text, None and arrays are none."""
    return isinstance(value, Real) and isfinite(value)
