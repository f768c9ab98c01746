"""The options that several commands have: one name, help, type, default and range for each."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gz_onboard.errors import InputError

LOG_SUFFIXES = (".mcap", ".blf", ".log", ".asc", ".csv", ".trc", ".mf4")
_LOGS = f"{' '.join(LOG_SUFFIXES)}, each also with .gz"
MOST_JOBS = 256
"""Processes: each takes some 100 MB and does nothing else than a processor's work."""
MOST_PAYLOAD = 300.0  # kg
MOST_SEED = 2**32 - 1


def number(
    option: str, low: float, high: float, unit: str = "", *, kind: type[float] = float, counted: str = ""
) -> Callable[[str], float]:
    """A type for argparse: a number from `low` to `high`, else InputError. counted: what the range is a number of."""

    def parse(text: str) -> float:
        value = kind(text)
        if not low <= value <= high:
            after = f" {unit}".rstrip()
            raise InputError(f"{option} {value:g}{after}: must be {low:g} to {high:g}{f' {counted}'.rstrip() or after}")
        return value

    parse.__name__ = kind.__name__  # what argparse calls it for a text that is no number
    return parse


def _json_file(text: str) -> str:
    """InputError for the name of a log, as in ``validate --json ride.blf``."""
    if text.removesuffix(".gz").endswith(tuple(suffix for suffix in LOG_SUFFIXES if suffix != ".csv")):
        raise InputError(f"--json {text}: that is the name of a log; write --json=- or put --json last")
    return text


def _jobs(option: str) -> Callable[[str], float]:
    return number(option, 1, MOST_JOBS, kind=int, counted="processes")


_SHARED: Mapping[str, Mapping[str, Any]] = {
    "log": {"type": Path, "metavar": "LOG", "help": f"log: {_LOGS}"},
    "logs": {
        "nargs": "+",
        "type": Path,
        "metavar": "LOG",
        "help": f"logs of rides: {_LOGS}; or folders of them, of which CSV files are not read",
    },
    "--vehicle": {
        "default": "reference",
        "metavar": "NAME|TOML",
        "help": "name of a built-in vehicle, or a vehicle file (default: %(default)s)",
    },
    "--payload": {
        "type": number("--payload", 0.0, MOST_PAYLOAD, "kg"),
        "metavar": "KG",
        "help": "mass of rider and luggage (default: from rides.json beside the log, or the vehicle file)",
    },
    "--effects": {"type": Path, "metavar": "DIR", "help": "folder with effects of your own: Python code you trust"},
    "--filter": {
        "default": "scalar",
        "choices": ("scalar", "filterpy"),
        "help": "implementation of the SOC filter (default: %(default)s)",
    },
    "--from": {"dest": "start", "type": float, "default": 0.0, "metavar": "S", "help": "start, seconds into the log"},
    "--to": {"dest": "end", "type": float, "metavar": "S", "help": "end, seconds into the log"},
    "--jobs": {
        "type": _jobs("--jobs"),
        "metavar": "N",
        "help": "number of parallel processes (default: one per processor)",
    },
    "--json": {
        "nargs": "?",
        "const": "-",
        "type": _json_file,
        "metavar": "FILE|-",
        "help": "write the result as JSON to FILE, or instead of text to standard output",
    },
    "--no-plot": {"action": "store_true", "help": "draw nothing"},
    "--output": {
        "type": Path,
        "default": Path(),
        "metavar": "DIR",
        "help": "folder to write to (default: the current one)",
    },
    "--quiet": {"action": "store_true", "help": "show no progress"},
    "--report": {"type": Path, "metavar": "HTML", "help": "write a report as an HTML page"},
    "--seed": {
        "type": number("--seed", 0, MOST_SEED, kind=int),
        "default": 0,
        "metavar": "N",
        "help": "seed of the random numbers (default: %(default)s)",
    },
}


def add_shared(parser: argparse.ArgumentParser, *names: str, **changes: Any) -> None:
    """Give `parser` these shared options; `changes` are to what argparse is told of each."""
    for name in names:
        parser.add_argument(name, **{**_SHARED[name], **changes})


def keep_old_name(parser: argparse.ArgumentParser, old: str, name: str) -> None:
    """Let `parser` take `old`, as its option `name` was called before, without listing it."""
    action = next(action for action in parser._actions if name in action.option_strings)
    kind = _jobs(old) if name == "--jobs" else action.type
    parser.add_argument(
        old,
        dest=action.dest,
        nargs=action.nargs,
        const=action.const,
        type=kind or str,
        default=argparse.SUPPRESS,
        help=argparse.SUPPRESS,
    )
