"""``gz-onboard route``: give the running daemon a route, clear it, or show its progress."""

from __future__ import annotations

import argparse
import json
import socket
from collections.abc import Mapping
from pathlib import Path

from gz_onboard.constants import WH
from gz_onboard.errors import OK, InputError
from gz_onboard.routes.route import read_route_columns, route_name, route_of

SOCKET = Path("/run/gz-onboard/control")
TIMEOUT_S = 30.0  # for an answer: the daemon prepares a long route first
STATES = {"ON": "on it", "OFF": "not on it"}  # by `RouteState`


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard route``."""
    one = parser.add_mutually_exclusive_group()
    about = "route: GPX, or CSV as for `simulate`, altitudes optional (default: show the present one)"
    one.add_argument("file", nargs="?", type=Path, metavar="FILE", help=about)
    one.add_argument("--clear", action="store_true", help="clear the route")
    text = "control socket of the daemon (default: %(default)s)"
    parser.add_argument("--socket", type=Path, default=SOCKET, metavar="PATH", help=text)


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard route``: `OK` if the daemon carried it out."""
    request: dict[str, object] = {"status": True}
    if arguments.clear:
        request = {"route": None}
    elif arguments.file:
        columns = read_route_columns(arguments.file)
        route_of(columns, "")  # errors are found here already, where the lines of the file are known
        request = {"route": {"name": route_name(arguments.file)[:100], **columns.values}}
    answer = ask(arguments.socket, request)
    if "error" in answer:
        raise InputError(f"{arguments.socket}: the daemon refused it: {answer['error']}")
    print(route_text(answer))
    return OK


def route_text(answer: Mapping[str, object]) -> str:
    """Describe the daemon's answer, for a terminal."""

    def number(key: str, factor: float, form: str) -> str:
        value = answer.get(key)
        return format(factor * value, form) if isinstance(value, int | float) else ""

    name, length = answer.get("route"), number("length_m", 1e-3, ".2f")
    lines = [f"route  {name or 'none'}{f', {length} km' if length else ''}"]
    if name and "state" in answer:
        line = f"  {STATES.get(str(answer['state']), 'not yet looked for')}"
        if ridden := number("along_m", 1e-3, ".1f"):
            line += f", {ridden} km ridden"
        if left := number("left_m", 1e-3, ".1f"):
            energy = number("energy_j", 1 / WH, ".0f")
            line += f", {left} km{f' and {energy} Wh' if energy else ''} to its end"
        lines.append(line)
        soc, low, high = (number(f"arrival_soc{part}", 100, ".0f") for part in ("", "_p10", "_p90"))
        latitude, longitude = (number(f"battery_ends_{axis}", 1, ".5f") for axis in ("latitude", "longitude"))
        if after := number("battery_ends_after_m", 1e-3, ".1f"):
            lines.append(f"  battery empty in {after} km{f', at {latitude}°, {longitude}°' if latitude else ''}")
        elif soc:
            lines.append(f"  {soc} % of charge at its end{f' ({low} to {high} %, 80 % interval)' if low else ''}")
    if remaining := number("range_m", 1e-3, ".1f"):
        lines.append(f"range  {remaining} km")
    if answer.get("grade_known") is False:
        lines.append("without altitudes hills are not counted")
    return "\n".join(lines)


def ask(path: Path, request: dict[str, object]) -> dict[str, object]:
    """Send a request and return the daemon's answer. InputError if there is none."""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
            connection.settimeout(TIMEOUT_S)
            connection.connect(str(path))
            connection.sendall(json.dumps(request).encode() + b"\n")
            with connection.makefile("rb") as stream:
                answer = json.loads(stream.readline())
    except OSError as error:
        hint = "it must run with --control-socket, and --socket must name the same file"
        raise InputError(f"{path}: no daemon answers: {error.strerror or error}; {hint}") from error
    except ValueError as error:
        raise InputError(f"{path}: the program listening there is not gz-onboard: {error}") from error
    return dict(answer) if isinstance(answer, dict) else {"error": str(answer)}
