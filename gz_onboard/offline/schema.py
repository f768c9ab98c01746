"""JSON from dataclasses, and what its keys mean: what a command reports stands once, as types.

A field's description stands in its type, `Annotated[float, "of the energy"]`. One that is `Annotated[..., OPTIONAL]` is
left out of the JSON where it is None.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from math import isfinite
from typing import Any, get_args, get_type_hints

OPTIONAL = object()


def to_json(value: Any) -> Any:
    """`value` in the types that a JSON file has; dataclasses as objects, in the order of their fields.

    Arrays become lists, numbers that are not finite None.
    """
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return float(value) if isfinite(value) else None
    if is_dataclass(value) and not isinstance(value, type):
        omitted = _optional(type(value)) if any(getattr(value, f.name) is None for f in fields(value)) else ()
        pairs = [(f.name, getattr(value, f.name)) for f in fields(value)]
        return {name: to_json(x) for name, x in pairs if x is not None or name not in omitted}
    if isinstance(value, Mapping):
        return {str(key): to_json(x) for key, x in value.items()}
    if isinstance(value, Sequence):
        return [to_json(x) for x in value]
    if hasattr(value, "tolist"):  # of numpy
        return to_json(value.tolist())
    return str(value)


def descriptions(kind: Any) -> dict[str, str]:
    """Of each field of a dataclass that has one, in their order."""
    hints = get_type_hints(kind, include_extras=True)
    texts = {f.name: [x for x in get_args(hints[f.name])[1:] if isinstance(x, str)] for f in fields(kind)}
    return {name: text[0] for name, text in texts.items() if text}


def _optional(kind: Any) -> frozenset[str]:
    """The fields of a dataclass that are left out where they are None."""
    hints = get_type_hints(kind, include_extras=True)
    return frozenset(f.name for f in fields(kind) if OPTIONAL in getattr(hints[f.name], "__metadata__", ()))
