"""Measure the cost of the dashboard's page: ``python -m benchmarks.dashboard``. It needs Chromium and Playwright.

The server runs with a sender of a daemon's frames in one process, as python-can's in-process bus ends there; the
sender's CPU time is counted apart. The browser is another process, at 800 x 480.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import struct
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any
from urllib.request import urlopen

from gz_onboard import cli
from gz_onboard.can.layout import crc8_sae_j1850
from gz_onboard.can.publisher import Counts, Publisher
from gz_onboard.can.python_can import can
from gz_onboard.events import Activity, Estimate, Frame, State

FIRST = 3.0  # s: start-up, which is not measured
ESTIMATE = Estimate(
    time=1.0,
    activity=Activity.RIDING,
    state=State.VALID,
    soc=0.624,
    soc_sd=0.012,
    range=34_210.0,
    range_p10=26_540.0,
    range_p90=44_340.0,
    energy_left=895 * 3600.0,
    consumption_recent=88.0,
    consumption_expected=94.0,
)
WATCH = """() => { window.drawn = []; new MutationObserver(
  () => drawn.push([energy.textContent.replaceAll("\\u00a0", " "), Date.now()])
).observe(energy, {childList: true, characterData: true, subtree: true}); }"""


def _of_the_vehicle(number: int) -> list[Frame]:
    """Pack, odometer [m] and cell temperatures, as the reference scooter sends them, each second."""
    cells = struct.pack("<HHBBBB", 3700, 3720, 40 + 22, 40 + 27, 40 + 24, 40 + 23)
    pack = struct.pack("<HhBBB", 5200, 1000, 120, 1, number // 10 % 15)
    return [
        (0, 512, pack + bytes([crc8_sae_j1850(pack)]), 0),
        (0, 769, struct.pack("<II", 1_000_000 + number, 0), 0),
        (0, 513, cells, 0),
    ]


def child(seconds: float) -> None:
    """Serve, send and measure; writes a line of JSON at the end."""
    sent: dict[str, float] = {}
    own = [0.0, 0.0]  # s of CPU of the sender, at the beginning of the measurement and now
    used = [0.0]

    def sending() -> None:
        publisher, number = Publisher(), 0
        begin = time.monotonic()
        with can.Bus(interface="virtual", channel="bench") as bus:
            while (passed := time.monotonic() - begin) < FIRST + seconds:
                estimate = replace(ESTIMATE, energy_left=(895 - number // 10) * 3600.0, soc=0.624 - 2e-5 * number)
                frames = publisher.range(estimate, Counts(), 0) if number % 10 == 0 else []
                vehicle = _of_the_vehicle(number) if frames else []
                for _, identifier, data, _ in [*vehicle, *frames, *publisher.status(estimate, 0)]:
                    bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
                if frames:
                    sent[f"{895 - number // 10} Wh left"] = time.time() * 1000
                own[1] = time.thread_time()
                if passed < FIRST:
                    own[0], used[0] = own[1], time.process_time()
                number += 1
                time.sleep(max(begin + 0.1 * number - time.monotonic(), 0.0))
        share = (time.process_time() - used[0] - own[1] + own[0]) / seconds
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000
        print(json.dumps({"share": share, "memory": memory, "sent": sent}), flush=True)

    threading.Thread(target=sending).start()
    arguments = ["--interface", "virtual", "--channel", "bench", "--listen", "127.0.0.1:0"]
    sys.exit(cli.main(["dashboard", "--web", *arguments, "--duration", str(FIRST + seconds + 1)]))


def measured(seconds: float, readers: int) -> tuple[dict[str, Any], list[float], list[float]]:
    """Return the child's figures, delays [ms] from frame to page, and load times [ms] of the page."""
    from tests.browser.support import opened_browser

    command = [sys.executable, "-m", "benchmarks.dashboard", "--child", "--seconds", str(seconds)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[1]) as process:
        assert process.stdout is not None
        address = process.stdout.readline().split()[1]
        streams = [urlopen(f"{address}api/stream") for _ in range(readers - 1)]
        for stream in streams:
            threading.Thread(target=stream.read, daemon=True).start()
        loads = []
        with opened_browser() as context:
            page = context.new_page()
            page.set_viewport_size({"width": 800, "height": 480})
            for _ in range(5):
                page.goto(address)
                page.locator("#energy", has_text="Wh").wait_for()
                loads.append(float(page.evaluate("performance.getEntriesByType('navigation')[0].loadEventEnd")))
            page.evaluate(WATCH)
            page.wait_for_timeout(seconds * 1000)
            drawn = dict(page.evaluate("drawn"))
        told: dict[str, Any] = json.loads(process.stdout.readline())
        process.wait()
    return told, [drawn[text] - time for text, time in told["sent"].items() if text in drawn], loads


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        child(arguments.seconds)
    print(f"on {os.cpu_count()} processors, {arguments.seconds:g} s each")
    for readers in 1, 8:
        told, delays, loads = measured(arguments.seconds, readers)
        delays.sort()
        print(
            f"{readers} reading: {told['share']:.2%} of a processor, {told['memory']:.1f} MB; page loaded in "
            f"{median(loads):.0f} ms (at most {max(loads):.0f}); frame to page {median(delays):.0f} ms "
            f"(90 % within {delays[int(0.9 * len(delays))]:.0f}, at most {delays[-1]:.0f})"
        )


if __name__ == "__main__":
    main()
