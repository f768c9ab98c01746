"""Results of a command: dataclasses as JSON by one writer, with keys that explain themselves, and as text.

A field's description is in its type, ``Annotated[float, "of the energy"]``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from decimal import Decimal
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, get_args, get_type_hints

from gz_onboard.errors import InputError, writing

FIRST_DATE_NS = 946_684_800_000_000_000
"""A log before 2000 has no date [ns since the epoch]: its clock was not set."""

# --- JSON ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Failure:
    """A log that could not be used."""

    file: Annotated[str, "the log"]
    error: Annotated[str, "why"]


def write_json(file: str | None, version: int | None, result: object) -> None:
    """What ``--json FILE`` asks for: `result`, a dataclass or mapping, after the `version` of its keys.

    version: None if the result has it. file: ``-`` is standard output, None nothing. Raises InputError.
    """
    if file is None:
        return
    head = {} if version is None else {"version": version}
    text = json.dumps(head | to_json(result), indent=1, ensure_ascii=False)
    if file == "-":
        print(text)
        return
    with writing(file):
        Path(file).write_text(text + "\n", encoding="utf-8", errors="replace")


OPTIONAL = object()
"""``Annotated[..., OPTIONAL]``: a field that is left out of the JSON where it is None."""


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


# --- names of files -----------------------------------------------------------------------------------------------


def distinct_names(logs: Sequence[Path], names: Sequence[str]) -> list[str]:
    """Distinct names for the rides of logs: with the name of the folder or the file where several are the same.

    InputError if that leaves two alike.
    """
    folders, files = [log.resolve().parent.name for log in logs], [log.name for log in logs]
    forms = [form for known in (names, files) for form in (known, list(map("{}-{}".format, folders, known)))]
    found = [next((form[i] for form in forms if form.count(form[i]) == 1), files[i]) for i in range(len(logs))]
    if twice := [name for name in found if found.count(name) > 1][:1]:
        both = " and ".join(str(log) for log, name in zip(logs, found, strict=True) if name == twice[0])
        raise InputError(f"{both} would both be called {twice[0]}; give them one at a time")
    return found


# --- text ---------------------------------------------------------------------------------------------------------


def text_rows(head: str, rows: Sequence[tuple[str, str]]) -> str:
    """A line and below it named values, one in each line."""
    return "\n".join([head, *(f"  {name:17} {text}" for name, text in rows)])


def clock(seconds: float) -> str:
    """A duration [s] as hours, minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{f'{hours} h ' if hours else ''}{minutes} min {rest:02} s"


def leap_text(when: float, leap: float) -> str:
    """That the clock of a log leaps by `leap` [s], `when` [s] into the ride."""
    days = abs(leap) / 86_400
    size = f"{days:.1f} days" if days >= 2 else f"{abs(leap):.1f} s"
    way = "ahead" if leap > 0 else "back"
    return f"the log's clock leaps {way} by {size} after {clock(when)}: taken as set then, and the ride continues"


def number(value: float | None, form: str, unit: str = "", factor: float = 1.0) -> str:
    """A value times `factor` with its unit; a dash for None."""
    return "–" if value is None else f"{value * factor:{form}} {unit}".rstrip()


def plain(value: float) -> str:
    """With one digit that counts, and no exponent: 0.00005."""
    return f"{Decimal(f'{value:.1g}'):f}"


def times(value: float | None, factor: float) -> float | None:
    """A value in another unit; None stays None."""
    return None if value is None else float(value * factor)
