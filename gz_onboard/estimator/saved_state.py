"""The saved state: its vehicle, its version, and its fields, of which each part declares its own with bounds."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

from gz_onboard.errors import shown

VERSION = 7  # raised with every change of a field; a state of another version is not read


@dataclass(frozen=True)
class Number:
    """A finite number from `low` to `high`, or null if it is optional."""

    low: float = -sys.float_info.max
    high: float = sys.float_info.max
    optional: bool = False


@dataclass(frozen=True)
class Text:
    """A string of at most `longest` characters."""

    longest: int


@dataclass(frozen=True)
class Each:
    """A list, or an object with any names, of at most `most` entries of one kind, or null if it is optional."""

    of: Field
    most: int
    optional: bool = False


Field: TypeAlias = "Number | Text | Each | Mapping[str, Any]"  # a mapping: an object with exactly these names

FINITE = Number()


def check(field: Field, saved: object, name: str = "state") -> None:
    """Compare `saved`, as JSON gives it, with its declaration. ValueError names the first field that is wrong."""
    match field:
        case Number() | Each() if saved is None and field.optional:
            pass
        case Number():
            if isinstance(saved, bool) or not isinstance(saved, int | float) or not field.low <= saved <= field.high:
                raise ValueError(f"is damaged: {name} is {shown(saved)}, not from {field.low:g} to {field.high:g}")
        case Text():
            if not isinstance(saved, str) or len(saved) > field.longest:
                raise ValueError(f"is damaged: {name} is {shown(saved)}, not a text of {field.longest} characters")
        case Each():
            if not isinstance(saved, Mapping | list | tuple) or len(saved) > field.most:
                raise ValueError(f"is damaged: {name} is {shown(saved)}, not at most {field.most} values")
            for key, value in saved.items() if isinstance(saved, Mapping) else enumerate(saved):
                check(field.of, value, f"{name}.{key}")
        case _:
            if not isinstance(saved, Mapping) or saved.keys() != field.keys():
                found = list(saved) if isinstance(saved, Mapping) else saved
                raise ValueError(f"is damaged: {name} has {shown(found)}, not {', '.join(field)}")
            for key, part in field.items():
                check(part, saved[key], f"{name}.{key}")


def check_vehicle(saved: object, key: str) -> None:
    """ValueError for a snapshot of another version, or of another vehicle than that of `key` (`Vehicle.key`)."""
    version = saved.get("version") if isinstance(saved, Mapping) else saved
    if version != VERSION or not isinstance(saved, Mapping):
        raise ValueError(f"is of version {shown(version)}, not {VERSION}")
    if saved.get("key") != key:
        theirs, ours = str(saved.get("key")).split("|"), key.split("|")
        differs = [
            f"{shown([part for part in these if part not in others])} {whose}"
            for these, others, whose in ((theirs, ours, "saved"), (ours, theirs, "in this vehicle file"))
        ]
        raise ValueError(f"is of another vehicle, battery or list of effects: {', '.join(differs)}")
