from __future__ import annotations

import fcntl
import json
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard import cli
from gz_onboard.can.publisher import Publisher
from gz_onboard.display import terminal
from gz_onboard.display.view import Picture, View
from gz_onboard.events import NO_SENSOR, ROLES, Estimate, Reason, State
from tests.display.served import COUNTS, ESTIMATE, Sender, seen


def at(view: View, now: float) -> Picture:
    return view.picture(now, "vcan0", "virtual", True)


def drawn(view: View, now: float, width: int = 80, *, colour: bool = False) -> str:
    lines = terminal.screen(at(view, now), width, view.comments)
    return "\n".join(terminal.rendered(line, width, colour) for line in lines)


def test_it_shows_what_the_daemon_sends():
    text = drawn(seen(), 100.0)
    for shown in (
        "34.2 km",
        "26.5 km to 44.3 km",
        "62.4 ± 1.2 %",
        "895 Wh",
        "26.2 Wh/km expected",
        "24.6 Wh/km over",
        "Why               temperature -3.4 km, stops +1.6 km\n                    besides the charge; rated 57.6 km",
        "degraded",
        "no IMU: No lean",
        "less than 3 km ridden",
        "0.0 s old, 17 received, 0 lost, 0 bad",
        "Activity          riding",
        "7 dropped, 3 implausible, 24 lost, 2 unknown",
    ):
        assert shown in text
    assert "Stale" not in text


def test_a_scooter_that_is_not_on_is_waited_for():
    view = seen(Estimate(time=0.0, state=State.INVALID, reasons=NO_SENSOR | Reason.LOG_FAILED))
    text = drawn(view, 100.0)
    assert "State             waiting for the scooter" in text
    assert "Note              log failed" in text
    assert not re.search("no IMU|Because|invalid", text)


@pytest.mark.parametrize("heard", [False, True])
def test_before_the_first_range_it_is_starting(heard):
    """The status is sent ten times as often as the range, which has not come, or still says that there is none."""
    view, publisher = View(), Publisher()
    frames = publisher.range(Estimate(time=0.0), COUNTS, 0) if heard else []
    for frame in [*frames, *publisher.status(replace(ESTIMATE, state=State.VALID), 0)]:
        view.take(frame, 1.0)
    text = drawn(view, 1.0)
    assert "State             starting" in text
    assert "Activity" not in text
    for frame in publisher.range(replace(ESTIMATE, state=State.VALID), COUNTS, 0):
        view.take(frame, 1.1)
    assert "State             valid" in drawn(view, 1.1)
    for frame in publisher.status(replace(ESTIMATE, state=State.INVALID), 0):  # bad news is shown at once
        view.take(frame, 1.2)
    text = drawn(view, 1.2)
    assert "State             invalid" in text
    assert "expected, – over the last km" in text  # the last kilometre was ridden who knows when


def test_sensors_left_out_are_named():
    reasons = Reason.SENSOR_DISTRUSTED | Reason.SIGNALS_SLOW | Reason.SOC_RESTARTED | Reason.SAVE_FAILED
    view = seen(replace(ESTIMATE, reasons=reasons, distrusted=("accel_x", "gps_altitude", "bms_state_of_charge")))
    text = drawn(view, 100.0)
    assert "Sensors left out  acceleration x, GPS altitude, BMS state of charge\n" in text
    for shown in "sensor distrusted", "signals slow", "SOC restarted", "save failed":
        assert shown in text
    assert "GPS altitude" not in drawn(view, 111.0)  # stale


# --- range frames of another file ---------------------------------------------------------------------------------


def test_a_broken_frame_is_counted_and_not_shown():
    publisher, view = Publisher(), View()
    frame = publisher.range(ESTIMATE, COUNTS, 0)[0]
    time_ns, identifier, data, channel = frame
    for broken in (bytes([data[0] ^ 1]) + data[1:], data[:7], data + b"\0", b"", data[:-1] + bytes([data[-1] ^ 0x80])):
        view.take((time_ns, identifier, broken, channel), 1.0)
    assert view.messages["RANGE_Estimate"].bad == 5
    assert at(view, 1.0)["range"]["km"] is None
    view.take(frame, 1.0)
    assert at(view, 1.0)["range"]["km"] == pytest.approx(34.21)
    assert "5 bad" in drawn(view, 1.0)


@given(st.floats(0, 1), st.floats(0, 0.3), st.floats(0, 700e3), st.integers(1, 120))
def test_every_line_fits(soc, sd, metres, width):
    estimate = Estimate(
        time=1.0,
        state=State.VALID,
        reasons=~Reason(0),
        distrusted=tuple(ROLES),
        soc=soc,
        soc_sd=sd,
        range=metres,
        range_p10=metres * 0.7,
        range_p90=metres * 1.4,
        energy_left=metres * 90,
    )
    for line in drawn(seen(estimate), 100.0, width).splitlines():
        assert len(line) <= min(width, 78)


# --- the command, on python-can's in-process bus ------------------------------------------------------------------


def test_once(capsys):
    with Sender("once", ESTIMATE):
        status = cli.main(["dashboard", "--interface", "virtual", "--channel", "once", "--once"])
    text = capsys.readouterr().out
    assert status == 0
    assert "34.2 km" in text
    assert "\x1b" not in text


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--duration", "0"], "--duration 0"),
        (["--interface", "nonesuch"], "--interface nonesuch"),
        (["--interface", "virtual", "--onse"], "--once"),
        (["--dbc", "range_larg.dbc"], "did you mean 'range_large.dbc'"),
        (["--dbc", "vehicle.dbc"], "vehicle.dbc: has no message RANGE_Estimate"),
        (["--dbc", "."], "is a folder; give the DBC file"),
    ],
)
def test_wrong_use_is_told(arguments, told, capsys):
    try:
        status = cli.main(["dashboard", *arguments])
    except SystemExit as error:
        status = int(str(error.code))
    assert status == 2
    assert told in capsys.readouterr().err


# A process of its own with a daemon's frames on a virtual bus, which does not leave its process.
CHILD = """
import sys, threading, time
from gz_onboard import cli
from gz_onboard.can.python_can import can
from tests.display.served import second, send
from gz_onboard.can.publisher import Publisher

def sending():
    publisher = Publisher()
    with can.Bus(interface="virtual", channel="x") as bus:
        end = time.monotonic() + float(sys.argv[1])
        while time.monotonic() < end:
            bus.send(can.Message(arbitration_id=0x600, data=bytes(12), is_fd=True, is_extended_id=False))
            send(bus, [(0, 0x602, b"nonsense", 0), (0, 0x601, b"", 0), (0, 0x123, b"x", 0)])
            send(bus, second(publisher))
            time.sleep(0.1)
        time.sleep(60)

threading.Thread(target=sending, daemon=True).start()
sys.exit(cli.main(["dashboard", "--interface", "virtual", "--channel", "x", *sys.argv[2:]]))
"""


def start(*arguments, out, sending=60.0, **environment):
    inherited = {k: v for k, v in os.environ.items() if k not in ("COLUMNS", "LINES")}  # pytest's workers have these
    environment = {**inherited, "TERM": "xterm", "PYTHONPATH": str(Path(__file__).resolve().parents[2]), **environment}
    return subprocess.Popen(
        [sys.executable, "-c", CHILD, str(sending), *arguments],
        stdin=out,
        stdout=out,
        stderr=subprocess.PIPE,
        env=environment,
        start_new_session=True,
    )


class Terminal:
    """A pseudo-terminal that keeps what was written to it."""

    def __init__(self, rows=24, columns=80):
        self.master, self.slave = pty.openpty()
        fcntl.ioctl(self.slave, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
        self.before = termios.tcgetattr(self.slave)
        self.text = ""

    def read(self, seconds):
        if select.select([self.master], [], [], seconds)[0]:
            self.text += os.read(self.master, 65536).decode("utf-8", "replace")

    def until(self, pattern, within=20.0):
        end = time.monotonic() + within
        while not re.search(pattern, self.text):
            assert time.monotonic() < end, f"no {pattern} in ...{self.text[-2000:]!r}"
            self.read(0.2)

    def close(self):
        os.close(self.master)
        os.close(self.slave)


@pytest.fixture
def tty():
    opened = Terminal()
    yield opened
    opened.close()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_on_a_terminal_and_left_as_it_was(tty, number):
    child = start(out=tty.slave)
    tty.until(r"34\.2 km")
    tty.until("[1-9] bad")
    assert tty.text.startswith("\x1b[?1049h\x1b[?25l")  # the other screen, no cursor
    assert "\x1b[1;33m" in tty.text
    frames = tty.text.count("\x1b[H")
    tty.read(1.0)
    child.send_signal(number)
    tty.until(r"\x1b\[\?25h\x1b\[\?1049l")
    assert child.wait(10) == 0
    for _ in range(5):
        tty.read(0.1)
    assert frames >= 1
    rest = tty.text.split("\x1b[?1049l")[1]
    assert "34.2 km" in rest  # the last picture stays
    assert termios.tcgetattr(tty.slave) == tty.before
    assert child.stderr.read() == b""
    child.stderr.close()


def test_lines_where_there_is_no_terminal(tmp_path):
    with (tmp_path / "out").open("w+") as out:
        child = start("--duration", "3.5", out=out, PYTHONIOENCODING="ascii")
        assert child.wait(30) == 0
        assert child.stderr.read() == b""
        child.stderr.close()
        out.seek(0)
        lines = out.read().splitlines()
    assert 2 <= len(lines) <= 4
    assert json.loads(lines[-1])["range"]["km"] == 34.21
