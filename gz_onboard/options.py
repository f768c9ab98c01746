"""Options that several commands share: one name, help, type, default and range for each."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gz_onboard.errors import InputError

LOG_SUFFIXES = (".mcap", ".blf", ".log", ".asc", ".csv", ".trc", ".mf4")
_LOGS = f"{' '.join(LOG_SUFFIXES)}, each also with .gz"
MOST_JOBS = 256
"""Processes: each takes some 100 MB and keeps a processor busy."""
MOST_PAYLOAD = 3000.0  # kg, of a van
MOST_SEED = 2**32 - 1
LONGEST_LOG = 1e9  # s, thirty years
PICTURE_FORMATS = ("png", "svg", "pdf")
CHANNEL = "can0"
FILTERS = ("scalar", "filterpy")


def number(
    option: str, low: float, high: float, unit: str = "", *, kind: type[float] = float, counted: str = ""
) -> Callable[[str], float]:
    """Return a type for argparse: a number from `low` to `high`, else InputError. counted: the plural it counts."""

    def parse(text: str) -> float:
        value = kind(text)
        if not low <= value <= high:
            after = f" {unit}".rstrip()
            raise InputError(
                f"{option} {value:.10g}{after}: must be {low:g} to {high:.10g}{f' {counted}'.rstrip() or after}"
            )
        return value

    parse.__name__ = kind.__name__  # what argparse calls it for a text that is no number
    return parse


def _json_file(text: str) -> str:
    """InputError for the name of a log, as in ``validate --json ride.blf``."""
    if text.lower().removesuffix(".gz").endswith(tuple(suffix for suffix in LOG_SUFFIXES if suffix != ".csv")):
        raise InputError(f"--json {text}: that is the name of a log; write --json=- or put --json last")
    return text


def _log(text: str) -> Path:
    """InputError for a name that no log has."""
    if not text:
        raise InputError("the name of a log is empty")
    if "://" in text:
        raise InputError(f"{text}: is a URL; fetch the log first, as by curl -O")
    return Path(text)


_SHARED: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "log": (f"log: {_LOGS}", {"type": _log, "metavar": "LOG"}),
    "logs": (
        f"logs of rides: {_LOGS}; or folders of them (CSV files in folders are skipped)",
        {"nargs": "+", "type": _log, "metavar": "LOG"},
    ),
    "--vehicle": (
        "name of a built-in vehicle, or a vehicle file (default: %(default)s)",
        {"default": "reference", "metavar": "NAME|TOML"},
    ),
    "--vehicle-id": (
        "ID of this vehicle if several share a file (default: from rides.json next to the log, or the vehicle file)",
        {"metavar": "ID"},
    ),
    "--payload": (
        "mass of rider and luggage (default: from rides.json next to the log, or the vehicle file)",
        {"type": number("--payload", 0.0, MOST_PAYLOAD, "kg"), "metavar": "KG"},
    ),
    "--route": (
        "the road ahead: GPX, or CSV as for `simulate`, altitudes not needed",
        {"type": Path, "metavar": "FILE"},
    ),
    "--effects": ("folder with effects of your own: Python code you trust", {"type": Path, "metavar": "DIR"}),
    "--filter": (
        "implementation of the SOC filter (default: %(default)s)",
        {"default": FILTERS[0], "choices": FILTERS},
    ),
    "--interface": ("interface of python-can (default: %(default)s)", {"default": "socketcan", "metavar": "NAME"}),
    "--channel": ("channel (default: %(default)s)", {"default": CHANNEL, "metavar": "NAME"}),
    "--from": (
        "start, seconds into the log",
        {"dest": "start", "type": number("--from", 0.0, LONGEST_LOG, "s"), "default": 0.0, "metavar": "S"},
    ),
    "--to": (
        "end, seconds into the log",
        {"dest": "end", "type": number("--to", 0.0, LONGEST_LOG, "s"), "metavar": "S"},
    ),
    "--jobs": (
        "number of parallel processes (default: one per processor)",
        {"type": number("--jobs", 1, MOST_JOBS, kind=int, counted="processes"), "metavar": "N"},
    ),
    "--json": (
        "write JSON to FILE, or to standard output instead of text",
        {"nargs": "?", "const": "-", "type": _json_file, "metavar": "FILE|-"},
    ),
    "--format": (
        "of the pictures; svg and pdf are for papers (default: %(default)s)",
        {"dest": "picture_format", "choices": PICTURE_FORMATS, "default": PICTURE_FORMATS[0]},
    ),
    "--no-plot": ("draw nothing", {"action": "store_true"}),
    "--output": ("folder to write to (default: the current one)", {"type": Path, "default": Path(), "metavar": "DIR"}),
    "--quiet": ("show no progress", {"action": "store_true"}),
    "--report": ("write a report as an HTML page", {"type": Path, "metavar": "HTML"}),
    "--seed": (
        "seed of the random numbers (default: %(default)s)",
        {"type": number("--seed", 0, MOST_SEED, kind=int), "default": 0, "metavar": "N"},
    ),
}
"""By name: help, and the other arguments for argparse."""


def add_shared(parser: argparse.ArgumentParser, *names: str, **changes: Any) -> None:
    """Give `parser` these shared options; `changes` replace arguments for argparse."""
    for name in names:
        text, about = _SHARED[name]
        parser.add_argument(name, **{"help": text, **about, **changes})


def host_and_port(text: str, port: int | None = None) -> tuple[str, int]:
    """Split ``HOST:PORT`` or ``[::1]:PORT``; with a default `port` also a host alone. InputError for anything else."""
    found = re.fullmatch(r"(\[[\w:.%]+\]|[^:\s/@]+)(?::(\d{1,5}))?", text, re.ASCII)
    number = int(found[2] or port or 0) if found and (found[2] or port) else -1
    if not found or not (0 if port is None else 1) <= number < 1 << 16:
        form = "ADDRESS:PORT" if port is None else "HOST or HOST:PORT"
        raise InputError(f"{text}: must be {form}, such as 127.0.0.1:8000 or [::1]:8000")
    return found[1].strip("[]"), number
