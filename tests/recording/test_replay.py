from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from gz_onboard.can.logfile import LogFile
from gz_onboard.events import EFF_FLAG, RTR_FLAG, TRANSMITTED, Frame
from gz_onboard.recording import replay as command
from gz_onboard.recording.readers.python_can import frame_of
from gz_onboard.recording.replay import bus_sender, replay
from tests.support import HEARS_CTRL_C, write_log

START = 1_750_000_000_000_000_000


def frames(count: int, step_ns: int = 5_000_000) -> list[Frame]:
    return [(START + i * step_ns, 0x100 + i % 20, i.to_bytes(4, "little"), 0) for i in range(count)]


def log(tmp_path: Path, content: list[Frame]) -> Path:
    path = tmp_path / "a.log"
    write_log(path, content)
    return path


def run(*arguments: str | Path) -> int:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command.run(parser.parse_args([str(argument) for argument in arguments]))


class Listener:
    """Collects what is sent on one of python-can's in-process buses."""

    def __init__(self, channel: str) -> None:
        self.bus = can.Bus(interface="virtual", channel=channel)
        self.received: list[Frame] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def _listen(self) -> None:
        while not self._stop.is_set():
            message = self.bus.recv(0.05)
            if message:
                self.received.append(frame_of(message, {str(message.channel): 0}))

    def close(self) -> list[Frame]:
        time.sleep(0.1)
        self._stop.set()
        self._thread.join()
        self.bus.shutdown()
        return self.received


@pytest.fixture
def listener(request: pytest.FixtureRequest) -> Iterator[Listener]:
    made = Listener(request.node.name)
    yield made
    made.close()


def payload(received: list[Frame]) -> list[tuple[int, bytes]]:
    return [(identifier, data) for _, identifier, data, _ in received]


def test_every_frame_arrives_in_order(tmp_path: Path, listener: Listener, request: pytest.FixtureRequest) -> None:
    sent: list[Frame] = [
        *frames(500),
        (START + 3 * 10**9, 0x18F00400 | EFF_FLAG, bytes(8), 0),
        (START + 3 * 10**9, 0x123 | RTR_FLAG, bytes(4), 0),
    ]
    path = log(tmp_path, sent)
    assert run(path, "--interface", "virtual", "--channel", request.node.name, "--speed", "0") == 0
    assert payload(listener.close()) == payload(sent)


def test_frames_keep_their_timing_and_delays_do_not_add_up() -> None:
    content = frames(100)

    def late() -> int:
        """How late [ns] the frames of the last half second are, after a bus that was busy for a while."""
        arrived: list[int] = []

        def send(_frame: Frame) -> bool:
            arrived.append(time.monotonic_ns())
            if len(arrived) == 20:
                time.sleep(0.05)
            return True

        summary = replay([content[:50], content[50:]], send)
        assert summary.sent == 100
        errors = [(a - arrived[0]) - (f[0] - START) for a, f in zip(arrived, content, strict=True)]
        assert min(errors) > -10_000_000
        assert summary.worst_lateness_s > 0.03  # the frames behind the delay, sent at once
        assert summary.duration_s > 0.49
        return sorted(errors[60:])[20]

    assert any(late() < 20_000_000 for _ in range(8))  # on time again, if the machine lets it


@pytest.mark.parametrize(("speed", "seconds"), [(4.0, 0.25), (0.0, 0.0)])
def test_speed_divides_the_time_and_zero_means_no_waiting(speed: float, seconds: float) -> None:
    begin = time.monotonic()
    replay([frames(201)], lambda _: True, speed)
    assert seconds * 0.99 <= time.monotonic() - begin < seconds + 5


def test_what_we_sent_ourselves_is_replayed_only_when_asked_for(
    tmp_path: Path, listener: Listener, request: pytest.FixtureRequest, capsys: pytest.CaptureFixture[str]
) -> None:
    content = [(t, i, d, TRANSMITTED if n % 4 == 0 else 0) for n, (t, i, d, _) in enumerate(frames(100))]
    path = tmp_path / "a.mcap"
    file = LogFile(path.open("wb"), START)
    file.frames(content)
    file.close()
    arguments = ["--interface", "virtual", "--channel", request.node.name, "--speed", "0"]
    assert run(path, *arguments) == 0
    assert "75 frames" in capsys.readouterr().out
    assert run(path, *arguments, "--all") == 0
    assert payload(listener.close()) == [*payload([f for f in content if not f[3]]), *payload(content)]


def test_channels_of_the_log_go_to_channels_of_the_bus(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    content = [(t, i, d, n % 3) for n, (t, i, d, _) in enumerate(frames(90))]
    path = log(tmp_path, content)
    name = request.node.name
    listeners = [Listener(f"{name}{i}") for i in range(2)]
    arguments = ["--interface", "virtual", "--speed", "0", "--channel", f"{name}0,{name}1"]
    assert run(path, *arguments) == 0
    for i, one in enumerate(listeners):
        assert payload(one.close()) == payload([frame for frame in content if frame[3] == i])


def test_looping_ends_cleanly_on_an_interrupt(tmp_path: Path) -> None:
    path = log(tmp_path, frames(20))
    code = (
        "import sys, threading, can; from gz_onboard.cli import main; bus = can.Bus(interface='virtual', channel='x');"
        " threading.Thread(target=lambda: [print(m, flush=True) for m in bus], daemon=True).start();"
        " sys.exit(main(['replay', *sys.argv[1:]]))"
    )
    arguments = [str(path), "--interface", "virtual", "--channel", "x", "--loop", "--speed", "2"]
    command = [*HEARS_CTRL_C, sys.executable, "-c", code, *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout and all(process.stdout.readline() for _ in range(21))  # it sends, in the second round
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert int(out.partition("replayed ")[2].partition(": ")[2].split()[0]) > 20
    assert "Traceback" not in err


def test_a_bus_that_is_down_loses_frames_and_they_are_counted() -> None:
    class Down:
        def send(self, _message: can.Message) -> None:
            raise can.CanOperationError("down", error_code=100)

    summary = replay([frames(10)], bus_sender(Down()), 0)  # type: ignore[arg-type]
    assert (summary.sent, summary.failed) == (0, 10)
    assert "10 could not be sent" in str(summary)
