"""What the commands have in common in telling what came out: as JSON, and as text."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from gz_onboard.bus.logs import log_suffix
from gz_onboard.errors import InputError


def explain_keys(parser: argparse.ArgumentParser, of: str, version: int, keys: Mapping[str, str]) -> None:
    """The keys of a JSON summary and their meaning, below the options in the help."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    rows = "\n".join(f"  {key:20} {meaning}" for key, meaning in keys.items())
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


def check_json(file: str | None) -> None:
    """InputError if what ``--json`` is to write is named like a log, as in ``validate --json ride.blf``."""
    try:
        log = file is not None and not file.endswith(".csv") and bool(log_suffix(Path(file)))
    except InputError:
        return
    if log:
        raise InputError(f"--json {file}: that is the name of a log; write --json=- or put --json last")


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
