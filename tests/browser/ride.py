"""A recorded ride through the daemon, and the dashboard's server, in one process: ``python -m tests.browser.ride LOG``.

The three share python-can's in-process bus and nothing else. The range frames go to LOG as candump writes them. The
first line of standard output is the dashboard's.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from pathlib import Path

from gz_onboard import cli
from gz_onboard.can._can import can
from gz_onboard.can.publisher import Publisher
from tests.support import LOGS

BUS = ["--interface", "virtual", "--channel", "ride"]


class Flushed(can.Listener):
    """Writes each frame out at once."""

    def __init__(self, file: Path) -> None:
        self._out = file.open("w", buffering=1)
        self._wanted = Publisher().identifiers

    def on_message_received(self, msg: can.Message) -> None:
        """Of the range frames, a line each."""
        if msg.arbitration_id in self._wanted:
            print(f"{msg.arbitration_id:x}#{bytes(msg.data).hex()}", file=self._out)


def main() -> int:
    """Until a signal ends the daemon."""
    with can.Bus(interface="virtual", channel="ride") as bus:
        notifier = can.Notifier(bus, [Flushed(Path(sys.argv[1]))])
        for command in (
            ["dashboard", "--web", "--listen", "127.0.0.1:0", *BUS],
            ["replay", str(LOGS / "city_14C.blf"), *BUS, "--quiet"],
        ):
            threading.Thread(target=cli.main, args=(command,), daemon=True).start()
        status = cli.main(["run", *BUS])
        notifier.stop()
    return status


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    code = main()
    sys.stdout.flush()
    os._exit(code)  # the threads have no end of their own
