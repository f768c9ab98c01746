"""``gz-onboard route``: give the running daemon a route, take it away, or ask how it stands."""

from __future__ import annotations

import argparse
import json
import socket
from collections.abc import Iterator, Mapping
from pathlib import Path

from gz_onboard.constants import WH
from gz_onboard.errors import OK, InputError
from gz_onboard.routes.route import read_route_columns, route_name, route_of

SOCKET = Path("/run/gz-onboard/control")
SECONDS = 30.0  # for an answer: a long route is made ready first
MOST_ANSWER = 100_000  # bytes
WHERE = {"ON": "on it", "OFF": "not on it"}  # by `RouteState`


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard route``."""
    one = parser.add_mutually_exclusive_group()
    about = "route: GPX, or CSV as for `simulate`, altitudes not needed (default: ask how the present one stands)"
    one.add_argument("file", nargs="?", type=Path, metavar="FILE", help=about)
    one.add_argument("--clear", action="store_true", help="have no route from now on")
    text = "of the daemon (default: %(default)s)"
    parser.add_argument("--socket", type=Path, default=SOCKET, metavar="PATH", help=text)


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard route``: `OK` if the daemon did it."""
    request: dict[str, object] = {"status": True}
    if arguments.clear:
        request = {"route": None}
    elif arguments.file:
        columns = read_route_columns(arguments.file)
        route_of(columns, "")  # what is wrong with it is said here, with the file's lines
        request = {"route": {"name": route_name(arguments.file)[:100], **columns.values}}
    answer = ask(arguments.socket, request)
    if "error" in answer:
        raise InputError(f"{arguments.socket}: the daemon refused it: {answer['error']}")
    print(route_text(answer))
    return OK


def route_text(answer: Mapping[str, object]) -> str:
    """The daemon's answer, for a terminal."""
    name, length = answer.get("route"), _times(answer, "length_m", 1e-3, ".2f", "km")
    lines = [f"route  {'none' if name is None else name}{f', {length}' if length else ''}"]
    if name is not None and "state" in answer:
        lines += [f"  {WHERE.get(str(answer['state']), 'not yet looked for')}{_way(answer)}", *_at_its_end(answer)]
    if range_left := _times(answer, "range_m", 1e-3, ".1f", "km"):
        lines += [f"range  {range_left}"]
    if answer.get("grade_known") is False:
        lines += ["without altitudes hills are not counted"]
    return "\n".join(lines)


def _way(answer: Mapping[str, object]) -> str:
    ridden, left = (_times(answer, key, 1e-3, ".1f", "km") for key in ("along_m", "left_m"))
    energy = _times(answer, "energy_j", 1 / WH, ".0f", "Wh")
    parts = [ridden and f"{ridden} ridden", left and f"{left}{f' and {energy}' if energy else ''} to its end"]
    return "".join(f", {part}" for part in parts if part)


def _at_its_end(answer: Mapping[str, object]) -> Iterator[str]:
    """What is left there, or where the battery ends before."""
    soc, low, high = (_times(answer, f"arrival_soc{part}", 100, ".0f", "%") for part in ("", "_p10", "_p90"))
    low = low.removesuffix(" %")
    if after := _times(answer, "battery_ends_after_m", 1e-3, ".1f", "km"):
        places = (_times(answer, f"battery_ends_{axis}", 1, ".5f", "°") for axis in ("latitude", "longitude"))
        place = ", ".join(filter(None, places))
        yield f"  battery empty in {after}{f', at {place}' if place else ''}"
    elif soc:
        yield f"  {soc} of charge at its end{f' ({low} to {high}, 80 % interval)' if low and high else ''}"


def _times(answer: Mapping[str, object], key: str, factor: float, digits: str, unit: str) -> str:
    """A number of the answer in its unit, or nothing if it has none."""
    value = answer.get(key)
    return f"{factor * value:{digits}}{'' if unit == '°' else ' '}{unit}" if isinstance(value, int | float) else ""


def ask(path: Path, request: dict[str, object]) -> dict[str, object]:
    """The daemon's answer to a request. InputError if there is none."""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as s:
            s.settimeout(SECONDS)
            s.connect(str(path))
            s.sendall(json.dumps(request).encode() + b"\n")
            got = bytearray()
            while not got.endswith(b"\n") and len(got) < MOST_ANSWER and (part := s.recv(65536)):
                got += part
        answer = json.loads(got)
    except OSError as error:
        hint = "it must run with --control-socket, and --socket must name the same file"
        raise InputError(f"{path}: no daemon answers: {error.strerror or error}; {hint}") from error
    except ValueError as error:
        raise InputError(f"{path}: what answers there is not gz-onboard: {error}") from error
    return dict(answer) if isinstance(answer, dict) else {"error": str(answer)}
