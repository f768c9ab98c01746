"""Processes on a vcan, and an ear on the bus."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import can
import pytest

from gz_onboard.events import EFF_FLAG, TRANSMITTED, Frame, State
from gz_onboard.recording.logs import read_frames, read_samples
from tests.support import LOGS, range_database

COASTDOWN = LOGS / "coastdown.blf"
Sample = dict[str, Any]


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


def is_up(name: str) -> bool:
    flags = Path(f"/sys/class/net/{name}/flags")
    return flags.exists() and bool(int(flags.read_text(), 16) & 1)


def wait_for(condition: Callable[[], object], seconds: float, what: str) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail(f"not within {seconds:g} s: {what}")
        time.sleep(0.05)


class Daemon:
    """``gz-onboard run`` as a process of its own."""

    def __init__(self, process: subprocess.Popen[str], log_dir: Path, state_dir: Path, errors: Path) -> None:
        self.process = process
        self.log_dir = log_dir
        self.state_dir = state_dir
        self._errors = errors

    @property
    def journal(self) -> str:
        """What it has written to stderr so far."""
        return self._errors.read_text()

    @property
    def logs(self) -> list[Path]:
        return sorted(self.log_dir.glob("*.mcap"), key=lambda path: path.stat().st_mtime)

    def stop(self, seconds: float = 15.0) -> str:
        """End it as systemd does; gives the summary that it writes."""
        self.process.send_signal(signal.SIGTERM)
        out, _ = self.process.communicate(timeout=seconds)
        assert self.process.returncode == 0, self.journal
        assert "Traceback" not in self.journal
        return out

    def estimates(self, log: Path | None = None) -> list[Sample]:
        """The estimates in a log, one a second; of the last log if none is given."""
        return samples(log or self.logs[-1], "/estimate")

    def statuses(self, log: Path | None = None) -> list[Sample]:
        return samples(log or self.logs[-1], "/status")


def samples(log: Path, topic: str) -> list[Sample]:
    """The values of a topic, each with the time [ns] at which it was logged."""
    return [{"time_ns": time_ns, **values} for name, time_ns, values in read_samples(log) if name == topic]


def raw_frames(log: Path, sent: bool = False) -> list[Frame]:
    """The frames in a log that the daemon received, or those that it sent."""
    return [frame for batch in read_frames(log) for frame in batch if bool(frame[3] & TRANSMITTED) == sent]


class Running:
    """The processes of a test."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._processes: list[subprocess.Popen[Any]] = []

    def folder(self, name: str) -> Path:
        """Where the daemon `name` has its logs and its state."""
        folder = self._folder / name
        folder.mkdir(exist_ok=True)
        return folder

    def daemon(
        self,
        *options: str,
        channels: tuple[str, ...] = ("vcan0",),
        name: str = "a",
        program: Sequence[str] = ("gz_onboard",),
        files: Sequence[int] = (),
    ) -> Daemon:
        """A daemon that is ready. The same `name` means the same directory for logs and state.

        program: the module that is run, and what stands before its command; files: those open that it is given.
        """
        folder = self.folder(name)
        errors = folder / "stderr"
        address = folder / f"notify{len(self._processes)}"
        command = [sys.executable, "-m", *program, "run", "--log-dir", str(folder), "--state-dir", str(folder)]
        for channel in channels:
            command += ["--channel", channel]
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server, errors.open("a") as stream:
            server.bind(str(address))
            server.settimeout(30)
            process = subprocess.Popen(
                [*command, *options],
                stdout=subprocess.PIPE,
                stderr=stream,
                text=True,
                env={**os.environ, "NOTIFY_SOCKET": str(address)},
                pass_fds=files,
            )
            self._processes.append(process)
            assert server.recv(4096).startswith(b"READY=1"), errors.read_text()
        return Daemon(process, folder, folder, errors)

    def replay(self, log: Path = COASTDOWN, *options: str, channel: str = "vcan0") -> subprocess.Popen[Any]:
        """A replay in the ride's own timing."""
        return self.start("replay", str(log), "--channel", channel, *options)

    def start(self, *arguments: str, **options: Any) -> subprocess.Popen[Any]:
        """Any command of gz-onboard."""
        process = subprocess.Popen(
            [sys.executable, "-m", "gz_onboard", *arguments], **{"stdout": subprocess.DEVNULL, **options}
        )
        self._processes.append(process)
        return process

    def kill(self) -> None:
        for process in self._processes:
            if process.poll() is None:
                process.kill()
            process.wait()
            if process.stdout:
                process.stdout.close()


class Listener:
    """Every range frame on a vcan, as anyone on the bus sees it, with the kernel's time."""

    def __init__(self, channel: str = "vcan0") -> None:
        self.channel = channel
        self.messages: list[can.Message] = []
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._listen)

    def __enter__(self) -> Listener:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join()

    def _listen(self) -> None:
        identifiers = [m.frame_id for m in range_database().messages]
        filters = [can.typechecking.CanFilter(can_id=i, can_mask=0x7FF) for i in identifiers]
        while not self._stopping.is_set():
            try:
                with can.Bus(interface="socketcan", channel=self.channel, can_filters=filters) as bus:
                    while not self._stopping.is_set():
                        message = bus.recv(0.2)
                        if message is not None:
                            self.messages.append(message)
            except (OSError, can.CanError):  # the interface is down or gone
                time.sleep(0.2)

    @property
    def frames(self) -> list[Frame]:
        """All that was heard."""
        return [
            (round(m.timestamp * 1e9), m.arbitration_id | (EFF_FLAG if m.is_extended_id else 0), bytes(m.data), 0)
            for m in self.messages
        ]

    def decoded(self, name: str) -> list[dict[str, Any]]:
        """The values of every frame of one message, with its time [s]."""
        wanted = range_database().get_message_by_name(name)
        return [
            {"time": m.timestamp, **wanted.decode(bytes(m.data), decode_choices=False)}  # type: ignore[dict-item]
            for m in self.messages
            if m.arbitration_id == wanted.frame_id
        ]

    def wait_for_valid(self, count: float, seconds: float = 60.0) -> None:
        """Until it has heard this many valid estimates; those before the first frame of a ride hold no range."""

        def enough() -> bool:
            told = [row["RANGE_EstimateState"] for row in self.decoded("RANGE_Estimate")]
            return told.count(State.VALID) >= count

        wait_for(enough, seconds, f"{count:g} valid estimates on {self.channel}")

    def wait_for_new(
        self, name: str, seconds: float = 10.0, since: int | None = None, **values: float
    ) -> dict[str, Any]:
        """The next frame of a message that has these values, from now on or `since` so many messages were heard."""
        begin = len(self.messages) if since is None else since
        wanted = range_database().get_message_by_name(name)
        deadline = time.monotonic() + seconds
        at = begin
        while time.monotonic() < deadline:
            while at < len(self.messages):
                m = self.messages[at]
                at += 1
                if m.arbitration_id == wanted.frame_id:
                    found: Any = wanted.decode(bytes(m.data), decode_choices=False)
                    if all(found[key] == value for key, value in values.items()):
                        return {"time": m.timestamp, **found}
            time.sleep(0.05)
        pytest.fail(f"no {name} {values} on {self.channel} within {seconds:g} s")


def number(text: str, pattern: str) -> float:
    """The number at the group of `pattern` in `text`."""
    found = re.search(pattern, text)
    assert found, f"{pattern!r} is not in {text!r}"
    return float(found[1])
