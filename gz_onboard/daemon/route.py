"""``gz-onboard route``: give the running daemon a route, take it away, or ask how it stands."""

from __future__ import annotations

import argparse
import json
import socket
from pathlib import Path

from gz_onboard.errors import OK, InputError
from gz_onboard.routes.ahead import read_ahead

SOCKET = Path("/run/gz-onboard/control")
SECONDS = 30.0  # for an answer: a long route is made ready first
MOST_ANSWER = 100_000  # bytes


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
        columns, route = read_ahead(arguments.file)
        request = {"route": {"name": route.name[:100], **columns.values}}
    answer = ask(arguments.socket, request)
    if "error" in answer:
        raise InputError(f"{arguments.socket}: the daemon refused it: {answer['error']}")
    for name, value in answer.items():
        if name != "ok" and value is not None:
            print(f"{name} {value}")
    if answer.get("grade_known") is False:
        print("without altitudes hills are not counted")
    return OK


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
        raise InputError(f"{path}: no daemon answers: {error.strerror or error}") from error
    except ValueError as error:
        raise InputError(f"{path}: what answers is no gz-onboard: {error}") from error
    return dict(answer) if isinstance(answer, dict) else {"error": str(answer)}
