"""What the commands have in common in telling what came out: as JSON, and as text."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path

from gz_onboard.errors import InputError


def explain_keys(parser: argparse.ArgumentParser, of: str, version: int, keys: Mapping[str, str]) -> None:
    """The keys of a JSON summary and their meaning, below the options in the help."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    rows = "\n".join(f"  {key:20} {meaning.replace('%', '%%')}" for key, meaning in keys.items())
    parser.epilog = f"keys of {of} JSON summary, version {version}:\n{rows}"


def write_json(file: str, document: object) -> None:
    """What ``--json FILE`` asks for; ``-`` is standard output. Raises InputError if it cannot be written."""
    text = json.dumps(document, indent=1, ensure_ascii=False)
    if file == "-":
        print(text)
        return
    try:
        Path(file).write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(f"--json {file}: cannot be written: {error.strerror}") from error


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
