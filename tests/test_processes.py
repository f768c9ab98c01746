"""Rides in processes of their own: however a command ends, they end with it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gz_onboard.processes import Task, over_rides
from tests.support import HEARS_CTRL_C, ROOT

LONG, ENOUGH = 600, 60  # s
SCRIPT = "from tests.test_processes import main; main()"


def work(task: Task) -> None:
    os.write(1, b"begun\n")  # in one piece, as two processes write
    time.sleep(LONG)


def main() -> None:
    list(over_rides(work, [Task(Path(str(i)), Path(), "reference") for i in range(4)], 2))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_processes_end_with_the_one_that_was_stopped(number: signal.Signals):
    command = [*HEARS_CTRL_C, sys.executable, "-c", SCRIPT]
    child = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=ROOT, start_new_session=True
    )
    assert child.stdout
    try:
        assert [child.stdout.readline() for _ in range(2)] == ["begun\n"] * 2
        child.send_signal(number)  # to it alone
        rest, _ = child.communicate(timeout=ENOUGH)  # its output ends with the last process that has it
        assert rest == ""  # nothing else was begun
        assert child.returncode == -number
    finally:
        if child.poll() is None or not child.stdout.closed:
            os.killpg(child.pid, signal.SIGKILL)
            child.wait()
