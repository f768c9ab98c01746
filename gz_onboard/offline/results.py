"""Results of a command: as JSON by one writer, with keys that explain themselves, and as text."""

from __future__ import annotations

import argparse
import json
import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, get_type_hints

from gz_onboard.errors import InputError, writing

_WIDTH = 110  # of a line in a terminal

# --- JSON ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Failure:
    """A log that could not be used."""

    file: Annotated[str, "the log"]
    error: Annotated[str, "why"]


def keys_of(result: type) -> dict[str, str]:
    """The keys that a dataclass has as JSON, and what they mean: its fields with the text of their Annotated types."""
    hints = get_type_hints(result, include_extras=True)
    return {field.name: " ".join(getattr(hints[field.name], "__metadata__", ())) for field in fields(result)}


def explain_keys(parser: argparse.ArgumentParser, of: str, version: int, keys: Mapping[str, str]) -> None:
    """The keys of a JSON result and their meaning, below the options in the help."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    wrap = textwrap.TextWrapper(_WIDTH, subsequent_indent=" " * 23)
    rows = "\n".join(wrap.fill(f"  {key:20} {meaning}") for key, meaning in keys.items())
    before = f"{parser.epilog}\n\n" if parser.epilog else ""
    parser.epilog = f"{before}JSON keys of {of}, version {version}:\n{rows}"


def plain(value: object) -> Any:
    """`value` as JSON has it: dataclasses as objects, arrays as lists, numbers that are not finite as null."""
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, Sequence):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):  # of numpy
        return plain(value.tolist())
    return str(value)


def write_json(file: str | None, version: int | None, result: object) -> None:
    """What ``--json FILE`` asks for: `result`, a dataclass or mapping, after the `version` of its keys.

    version: None if the result has it. file: ``-`` is standard output, None nothing. Raises InputError.
    """
    if file is None:
        return
    head = {} if version is None else {"version": version}
    text = json.dumps(head | plain(result), indent=1, ensure_ascii=False)
    if file == "-":
        print(text)
        return
    with writing(file):
        Path(file).write_text(text + "\n", encoding="utf-8")


# --- names of files -----------------------------------------------------------------------------------------------


def output_names(logs: Sequence[Path], names: Sequence[str], suffix: str) -> list[str]:
    """What the files of each log are called, without `suffix`: its name, with its folder's where several have the same.

    InputError if that leaves two alike.
    """
    full = [
        name if names.count(name) == 1 else "-".join([*log.resolve().parent.parts[-1:], name])
        for log, name in zip(logs, names, strict=True)
    ]
    if twice := [name for name in full if full.count(name) > 1][:1]:
        both = " and ".join(str(log) for log, name in zip(logs, full, strict=True) if name == twice[0])
        raise InputError(f"{both} would both be written as {twice[0]}{suffix}; give them one at a time")
    return full


# --- text ---------------------------------------------------------------------------------------------------------


def text_rows(head: str, rows: Sequence[tuple[str, str]]) -> str:
    """A line and below it named values, one in each line."""
    return "\n".join([head, *(f"  {name:17} {text}" for name, text in rows)])


def clock(seconds: float) -> str:
    """A duration [s] as hours, minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{f'{hours} h ' if hours else ''}{minutes} min {rest:02} s"


def number(value: float | None, form: str, unit: str = "", factor: float = 1.0) -> str:
    """A value times `factor` with its unit; a dash for None."""
    return "–" if value is None else f"{value * factor:{form}} {unit}".rstrip()


def times(value: float | None, factor: float) -> float | None:
    """A value in another unit; None stays None."""
    return None if value is None else float(value * factor)
