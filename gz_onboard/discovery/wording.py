"""Names and values as they are written for people."""

from __future__ import annotations

from collections.abc import Callable

Say = Callable[[str], None]
"""Takes the step that begins, in words."""


def with_unit(value: float, unit: str, form: str = ".4g") -> str:
    """A value with its unit; that of a pure number is not said."""
    return f"{value:{form}}" if unit == "1" else f"{value:{form}} {unit}"


def readable(name: str) -> str:
    """A name of the code in words."""
    return name.replace("_", " ").replace("gps", "GPS")
