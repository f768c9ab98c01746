"""Real power cuts: a daemon in a user-mode Linux guest, log and state on ext4, and a ride on its vcan.

What was told until the cut is written down outside; the disk is mounted again, and held against that.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from gz_onboard import state
from gz_onboard.events import TRANSMITTED
from gz_onboard.recording.logs import read_frames
from tests.support import LOGS, ROOT, S, range_database, reference

GUEST = ROOT / "tests" / "vcan-guest"
POWER_CUT = 137


def is_there() -> bool:
    """Whether such a guest can be had here."""
    command = [str(GUEST), "--where", "guest", "--timeout", "60", "--", "true"]
    return subprocess.run(command, check=False, capture_output=True).returncode == 0


def cut(after_s: float) -> tuple[float, float]:
    """Cut the power `after_s` from the start: seconds of the log, and share of the charge, that are lost."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        image, told, left = folder / "card.img", folder / "told", folder / "left"
        guest = [str(GUEST), "--root", "--disk", str(image), "--timeout", "180"]
        witness = [sys.executable, "-m", "tests.hardening._ext4", str(told)]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(
            [*guest, "--power-cut-after", f"{after_s:g}", "--", *witness], env=environment, cwd=ROOT, check=False
        )
        if done.returncode != POWER_CUT:
            raise OSError(f"the guest ended with {done.returncode}, not with a power cut")
        left.mkdir()
        subprocess.run([*guest, "--", "cp", "-r", "/run/disk/log", "/run/disk/state", str(left)], check=True)
        lines = [line.split() for line in told.read_text().splitlines() if line.endswith(" .")]
        last_ns, soc = int(lines[-1][0]), float(lines[-1][1])
        times = [
            frame[0]
            for log in (left / "log").glob("*.mcap")
            for batch in read_frames(log)
            for frame in batch
            if not frame[3] & TRANSMITTED
        ]
        saved = [state.load(copy, time.time()) for copy in state.copies(left / "state" / f"{reference().name}.json")]
        newest = next(found[0] for found in saved if found)
        return (last_ns - max(times, default=int(lines[0][0]))) / S, abs(newest["soc"] - soc)


def witness(told: Path) -> None:
    """In the guest: start daemon and ride, and write down each state of charge that is told, until the power is cut."""
    import can

    run = [sys.executable, "-m", "gz_onboard"]
    subprocess.Popen(
        [*run, "run", "--channel", "vcan0", "--log-dir", "/run/disk/log", "--state-dir", "/run/disk/state"]
    )
    subprocess.Popen([*run, "replay", str(LOGS / "city_14C.blf"), "--channel", "vcan0", "--loop"])
    status = range_database().get_message_by_name("RANGE_Status")
    with can.Bus(interface="socketcan", channel="vcan0") as bus, told.open("w") as stream:
        while True:
            message = bus.recv(1)
            if message is None or message.arbitration_id != status.frame_id:
                continue
            soc = status.decode(bytes(message.data), decode_choices=False)["RANGE_StateOfCharge"]  # type: ignore[call-overload]
            if isinstance(soc, float | int) and soc <= 100:
                stream.write(f"{round(message.timestamp * 1e9)} {soc / 100} .\n")
                stream.flush()


if __name__ == "__main__":
    witness(Path(sys.argv[1]))
