"""What the Python API is given, held against the type hints of its functions and options.

A mistake is an `InputError` with the argument's name, before any work, and no TypeError from inside.
"""

from __future__ import annotations

import collections.abc
import functools
import inspect
import re
import types
from collections.abc import Callable, Collection, Mapping
from dataclasses import fields
from numbers import Integral, Real
from typing import Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

from gz_onboard.errors import InputError, naming, nearest, shown

P = ParamSpec("P")
R = TypeVar("R")
Ranges = Mapping[str, tuple[float, float, str]]
"""By name of what is a number: the least, the greatest, the unit."""

_WORDS: dict[object, str] = {float: "a number", int: "a whole number", bool: "True or False", str: "a text"}


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """`function`, which raises InputError for an argument that is not what its hint says."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        hints = get_type_hints(function)
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            if name in hints:
                check(name, value, hints[name])
        with naming():
            return function(*args, **kwargs)

    return call


def check_fields(options: object, ranges: Ranges) -> None:
    """InputError for a field of a dataclass that is not what its hint says, or out of its range.

    Numbers of numpy become those of Python.
    """
    hints = get_type_hints(type(options))
    for field in fields(options):  # type: ignore[arg-type]
        value = getattr(options, field.name)
        check(field.name, value, hints[field.name])
        if isinstance(value, Real | bool) and hasattr(value, "item"):
            object.__setattr__(options, field.name, value.item())
        if field.name in ranges and value is not None:
            within(field.name, value, ranges)


def within(name: str, value: float, ranges: Ranges, place: str = "") -> None:
    """InputError for a number out of the range of its name; place: what stands before that."""
    low, high, unit = ranges[name]
    if not low <= value <= high:
        raise InputError(f"{place}{name} {value:.10g}: must be {low:g} to {high:.10g} {unit}".rstrip())


def check(name: str, value: object, hint: Any) -> None:
    """InputError if `value` is not what the type hint says."""
    if fits(value, hint):
        return
    known = [part for part in get_args(hint) if isinstance(part, str)] if get_origin(hint) is Literal else []
    expected = " or ".join(known) or _WORDS.get(hint) or re.sub(r"[\w.]+\.", "", inspect.formatannotation(hint))
    raise InputError(f"{name} {shown(value)}: must be {expected}{nearest(str(value), known)}")


def fits(value: object, hint: Any) -> bool:
    """Whether `value` is what a type hint says; of a protocol always, as it says itself what it lacks."""
    kind, parts = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, types.UnionType):
        return any(fits(value, part) for part in parts)
    if kind is Literal:
        return isinstance(value, str) and value in parts
    if kind in (Any, object) or getattr(kind, "_is_protocol", False):
        return True
    if kind is collections.abc.Callable:
        return callable(value)
    if kind is bool:
        return isinstance(value, bool) or type(value).__name__ in ("bool", "bool_")
    if kind in (int, float):
        return isinstance(value, Integral if kind is int else Real) and not isinstance(value, bool)
    if kind is types.NoneType or not isinstance(kind, type):
        return value is None
    if not isinstance(value, kind):
        return False
    if issubclass(kind, Mapping) and isinstance(value, Mapping):
        return all(fits(key, parts[0]) and fits(one, parts[1]) for key, one in value.items())
    if kind in (collections.abc.Sequence, collections.abc.Iterable):
        if isinstance(value, str | bytes | Mapping):  # of letters or keys: not what is meant
            return False
        return all(fits(one, parts[0]) for one in value) if isinstance(value, Collection) else True
    return True
