"""What the tests of the service ask systemd, the bus and the interface."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import pytest
from cantools.database import Database, load_file

ROOT = Path(__file__).resolve().parents[2]
UNIT = "gz-onboard.service"
SOC = "RANGE_StateOfCharge"


def output(*command: str, check: bool = True) -> str:
    """What `command` writes, errors too."""
    run = subprocess.run(command, check=False, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if check and run.returncode:
        pytest.fail(f"{' '.join(command)}: status {run.returncode}\n{run.stdout}\n{journal()}")
    return run.stdout.strip()


def journal(unit: str = UNIT) -> str:
    return output("journalctl", "--no-pager", "-n", "50", "-u", unit, check=False)


def systemctl(*arguments: str) -> str:
    return output("systemctl", *arguments)


def show(what: str) -> str:
    return systemctl("show", UNIT, "--value", "-p", what)


def main_pid() -> int:
    return int(show("MainPID"))


def wait_for(condition: Callable[[], bool], seconds: float, what: str) -> None:
    """Ask `condition` ten times a second; a failure with the journal if it is not true after `seconds`."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail(f"not within {seconds:g} s: {what}\n{journal()}")
        time.sleep(0.1)


def wait_for_another(pid: int, seconds: float) -> None:
    """Wait until the service runs as another process than `pid`."""
    wait_for(lambda: show("ActiveState") == "active" and main_pid() not in (0, pid), seconds, "started again")


def link(name: str) -> str:
    return output("ip", "-o", "link", "show", name, check=False)


class Listener:
    """The daemon's frames as anyone on vcan0 sees them."""

    def __init__(self) -> None:
        database = load_file(ROOT / "dbc" / "range.dbc")
        assert isinstance(database, Database)
        self.database = database
        filters = [can.typechecking.CanFilter(can_id=m.frame_id, can_mask=0x7FF) for m in database.messages]
        self.bus = can.Bus(interface="socketcan", channel="vcan0", can_filters=filters)

    def next(self, signal: str, seconds: float = 10.0) -> dict[str, Any]:
        """The next frame, from now on, that has `signal`, decoded."""
        while self.bus.recv(0):
            pass
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            frame = self.bus.recv(left)
            if frame is not None:
                values = self.database.decode_message(frame.arbitration_id, bytes(frame.data), decode_choices=False)
                assert isinstance(values, dict)
                if signal in values:
                    return values
        pytest.fail(f"no frame with {signal} on vcan0 within {seconds:g} s\n{journal()}")
