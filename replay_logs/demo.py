"""Show a full discharge with range and truth, then a hidden loss found in three rides (`make run`).

All but the last seconds go through the daemon's pipeline as fast as possible. From its saved state the daemon continues
on a CAN bus, where the last seconds are replayed in real time. `discover` runs in parallel. Where the kernel has
no CAN, the part on the bus runs in a guest, which calls this file again with ``--live``.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from itertools import pairwise
from math import inf
from pathlib import Path
from typing import Any, NamedTuple, TextIO, cast

from cantools.database.can import Message

from gz_onboard import cli, state
from gz_onboard.can.channel import CanChannel
from gz_onboard.display.view import View
from gz_onboard.estimation.ride import OpenRide, RideOptions, run_ride
from gz_onboard.events import Frame
from gz_onboard.log_rows import ESTIMATE_TOPIC
from gz_onboard.recording.logs import read_frames, read_log
from gz_onboard.reports.style import BLUE, INK, ORANGE, legend, new_figure, ordinate, rule, save
from gz_onboard.state import state_file
from gz_onboard.vehicle import read_vehicle

ROOT = Path(__file__).resolve().parents[1]
LOGS = ROOT / "replay_logs"
RIDES = LOGS / "city_14C.blf", LOGS / "turning" / "city_11C.mcap", LOGS / "turning" / "oval_2C.blf"
VEHICLE = read_vehicle("reference")
ODOMETER, PACK = (VEHICLE.mapping.database.get_message_by_name(name) for name in ("VCU_Odometer", "BMS_Pack"))
CHANNEL = "vcan0"
GUEST = Path("/run/vcan-guest")
PORT = 8000  # of the page, if it is free
READY_WITHIN = 30.0  # s
KEPT = 80, 50, 20, 10  # %: of which charge a copy of the line stays
REDRAW = 0.1  # s
LEAST = 3.0  # km ridden, before which the usual gauge shows nothing
MEANING = {"cornering_drag": "drag of the tyres in bends (cornering_drag)"}
HEAD = "    battery    ridden    range, 80 % interval       true left    usual gauge"


class Row(NamedTuple):
    """One moment of the ride: battery in %, everything else in km. usual: the usual gauge."""

    battery: float
    ridden: float
    range: float
    p10: float
    p90: float
    left: float
    usual: float

    def __str__(self) -> str:
        interval = f"{self.range:4.1f} km ({self.p10:.1f} to {self.p90:.1f})"
        numbers = f"{self.battery:9.0f} %{self.ridden:7.1f} km    {interval:<24}{self.left:8.1f} km"
        return numbers + (f"{self.usual:12.1f} km" if self.ridden > LEAST else "")


class Line:
    """A line that is redrawn, with copies that stay; without a terminal only these are written."""

    def __init__(self, ride: Path, out: TextIO, terminal: bool, kept: Sequence[int] = KEPT) -> None:
        self.rows: list[Row] = []
        self.now: dict[str, float] = {}  # the signals of `ODOMETER` and `PACK`
        self._out, self._terminal, self._kept, self._drawn = out, terminal, list(kept), 0.0
        frames = [frame for batch in read_frames(ride) for frame in batch]
        first, last = (
            [next(f for f in way if f[1] == m.frame_id) for m in (ODOMETER, PACK)] for way in (frames, frames[::-1])
        )
        self.begin_ns, self.end_ns = frames[0][0], frames[-1][0]
        self.first, self.last = (decoded(ODOMETER, of[0])["VCU_Odometer"] for of in (first, last))
        self._full = decoded(PACK, first[1])["BMS_StateOfCharge"]

    def take(self, frame: Frame) -> None:
        """Take in a frame of the vehicle's."""
        for message in (ODOMETER, PACK):
            if frame[1] == message.frame_id:
                self.now |= decoded(message, frame)

    def show(self, *km: float | None) -> None:
        """Show range, P10 and P90."""
        known = [value for value in km if value is not None]
        if len(known) < 3 or not self.now.keys() >= {"VCU_Odometer", "BMS_StateOfCharge"}:
            return
        battery, odometer = self.now["BMS_StateOfCharge"], self.now["VCU_Odometer"]
        ridden = odometer - self.first
        usual = battery * ridden / max(self._full - battery, 0.5)
        self.rows.append(Row(battery, ridden, *known, self.last - odometer, usual))
        if self._kept and battery <= self._kept[0]:
            self._kept = [percent for percent in self._kept if percent < battery]
            self.keep()
        elif self._terminal and time.monotonic() - self._drawn > REDRAW:
            self._drawn = time.monotonic()
            print(f"\r\x1b[K{self.rows[-1]}", end="", file=self._out, flush=True)

    def keep(self) -> None:
        """Let the line stay as it is."""
        print("\r\x1b[K" * self._terminal + str(self.rows[-1]), file=self._out, flush=True)

    def channel(self, topic: str, json_schema: Mapping[str, Any], metadata: Mapping[str, str] | None = None) -> None:
        """See `log_rows.Log`: not needed."""

    def frames(self, batch: Sequence[Frame]) -> None:
        """Likewise."""

    def sample(self, topic: str, time_ns: int, values: Mapping[str, Any], seen_ns: int | None = None) -> None:
        """Draw the estimate and the vehicle's own figures once a second."""
        if topic == ESTIMATE_TOPIC:
            self.show(*(None if values[n] is None else values[n] * 1e-3 for n in ("range", "range_p10", "range_p90")))
        elif topic.removeprefix("/can/") in (ODOMETER.name, PACK.name):
            self.now |= values


def main() -> int:
    """Show it all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "ride", nargs="?", type=Path, default=LOGS / "full_discharge.mcap", help="a ride until the battery was empty"
    )
    parser.add_argument("--bus", default="vcan", choices=["vcan", "virtual"])
    parser.add_argument("--seconds", type=float, default=40.0, help="of the end of the ride, live on the bus")
    parser.add_argument("--output", type=Path, help="folder to write to (default: one in runs/)")
    parser.add_argument("--live", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--terminal", action="store_true", default=sys.stdout.isatty(), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.live:
        return live(args)
    folder = args.output = args.output or ROOT / "runs" / time.strftime("%Y%m%dT%H%M%S")
    folder.mkdir(parents=True)
    found, page, picture = folder / "discover.json", folder / "discover.html", folder / "range.png"
    words = ["discover", *map(str, RIDES), "--quiet", "--json", str(found), "--report", str(page)]
    with (
        (folder / "discover.txt").open("w") as told,
        subprocess.Popen(gz(*words), stdout=told, stderr=told) as discover,
    ):
        try:
            rows = show_range(args)
            draw(rows, picture)
            print(f"""\
    When the scooter stopped, the usual gauge promised another {rows[-1].usual:.1f} km.
    Error on average over the ride: range {off(rows, "range"):.1f} km, usual gauge {off(rows, "usual"):.1f} km.
    Picture: {shown(picture)}

2  Discovery. Three recorded rides took more energy than the model predicts. discover is given no hint.
""")
            if discover.wait():
                raise SystemExit(f"demo: discover failed: {(folder / 'discover.txt').read_text()}")
            print(f"""\
{sentence(json.loads(found.read_text()))}
    Report: {page.resolve().as_uri()}

    On a ride of your own: .venv/bin/gz-onboard estimate RIDE""")
        finally:
            discover.terminate()
    return 0


def decoded(message: Message, frame: Frame) -> dict[str, float]:
    """The signals of a frame."""
    return cast(dict[str, float], message.decode(frame[2], decode_choices=False))


def gz(*words: str) -> list[str]:
    """The command line, as its own process."""
    return [sys.executable, "-m", "gz_onboard", *words]


def shown(path: Path) -> Path:
    """The path as short as it can be from the repository."""
    return path.relative_to(ROOT) if path.is_relative_to(ROOT) else path


def off(rows: Sequence[Row], name: str) -> float:
    """How wrong a range was on average over the way [km]."""
    ridden = [(a.ridden - b.ridden, abs(getattr(a, name) - a.left)) for b, a in pairwise(rows) if b.ridden > LEAST]
    return sum(way * wrong for way, wrong in ridden) / sum(way for way, _ in ridden)


def show_range(args: argparse.Namespace) -> list[Row]:
    """Fast until the last seconds of the ride, then live; all that was shown."""
    line = Line(args.ride, sys.stdout, args.terminal)
    ridden = line.last - line.first
    print(
        f"""\
gz_onboard tells the rider of an electric scooter how much farther it can go, from its CAN bus. From
recorded rides it also finds errors of the scooter's model.

1  Range. {ridden:.1f} km recorded from full until the scooter cut out, so the true distance left is known.
    The usual gauge is the kilometres ridden per percent of battery used, times the percent left.

{HEAD}""",
        flush=True,
    )
    live_ns = line.end_ns - round(args.seconds * 1e9)
    ride = OpenRide(args.ride, VEHICLE, read_log(args.ride, None, live_ns), [])
    estimator = run_ride(ride, RideOptions(signals=True), line).pipeline.estimator
    snapshot = estimator.snapshot(VEHICLE.key)
    assert snapshot, "nothing is known before the live part"
    state.write(state_file(args.output, VEHICLE.name), state.encode(snapshot, time.time()))
    where = [] if args.bus == "virtual" else [sys.executable, str(ROOT / "tests" / "vcan-guest"), "--"]
    words = [args.ride, "--live", "--bus", args.bus, "--seconds", args.seconds, "--output", args.output]
    line.keep()
    subprocess.run([*where, sys.executable, __file__, *map(str, words), *["--terminal"] * args.terminal], check=True)
    with (args.output / "live.csv").open() as file:
        return [*line.rows, *(Row(*map(float, row)) for row in csv.reader(file))]


def live(args: argparse.Namespace) -> int:
    """The end of the ride on the bus: daemon, replay and dashboard, each as its command."""
    interface = "virtual" if args.bus == "virtual" else "socketcan"
    bus = ["--interface", interface, "--channel", CHANNEL]
    address = f"127.0.0.1:{free_port()}"
    where = (
        "python-can's virtual bus (no CAN socket)"
        if args.bus == "virtual"
        else f"{CHANNEL} of Linux {os.uname().release}"
    )
    reach = f"http://{address}/"
    if GUEST.is_dir():
        where += " in a VM"
        reach = f"not reachable from your browser (it runs in a VM); `make run BUS=virtual` serves it at http://127.0.0.1:{PORT}/"
    print(
        f"""\
    The last {args.seconds:g} s live: the log is replayed to the daemon on {where}.
    Dashboard: {reach}""",
        flush=True,
    )
    # As if it had been saved here and now: neither the drive to the guest nor the age of the recording is a pause.
    file = state_file(args.output, VEHICLE.name)
    snapshot, _ = state.load(file, inf) or ({}, None)
    state.write(file, state.encode(snapshot, time.time(), time.clock_gettime(time.CLOCK_BOOTTIME)))
    line = Line(args.ride, sys.stdout, args.terminal, kept=())
    begin = (line.end_ns - line.begin_ns) * 1e-9 - args.seconds
    replay = ["replay", str(args.ride), *bus, "--from", str(begin), "--quiet"]
    dashboard = ["dashboard", *bus, "--web", "--listen", address]
    threading.Thread(target=watch, args=(line, interface, dashboard, replay), daemon=True).start()
    with (
        (args.output / "daemon.txt").open("w") as told,
        contextlib.redirect_stdout(told),
        contextlib.redirect_stderr(told),
    ):
        status = cli.main(["run", *bus, "--log-dir", str(args.output), "--state-dir", str(args.output)])
    line.keep()
    with (args.output / "live.csv").open("w") as out:
        csv.writer(out).writerows(line.rows)
    return status


def watch(line: Line, interface: str, dashboard: list[str], replay: list[str]) -> None:
    """Wait for the daemon, replay the ride, show its range frames, and end it with the ride."""
    view = View(VEHICLE.publisher())
    identifiers = [*(view.identifiers or ()), ODOMETER.frame_id, PACK.frame_id]
    channel = CanChannel(interface, CHANNEL, identifiers=identifiers)
    channel.open()
    threads = [threading.Thread(target=cli.main, args=(words,), daemon=True) for words in (dashboard, replay)]
    started = shown_at = time.monotonic()
    while threads[-1].is_alive() or not threads[-1].ident:
        time.sleep(0.05)
        now = time.monotonic()
        for frame in channel.drain():
            view.take(frame, now)
            line.take(frame)
        if not threads[-1].ident and view.messages["RANGE_Status"].received:
            for thread in threads:
                thread.start()
        elif not threads[-1].ident and now - started > READY_WITHIN:
            break
        if now - shown_at > 1.0:
            shown_at = now
            line.show(*view.picture(now, CHANNEL, interface, channel.up)["range"].values())
    channel.close()
    os.kill(os.getpid(), signal.SIGTERM)


def free_port() -> int:
    """`PORT`, or another one if it is taken."""
    for port in PORT, 0:
        with contextlib.suppress(OSError), socket.socket() as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind(("127.0.0.1", port))
            return int(trial.getsockname()[1])
    raise OSError("no free port on 127.0.0.1")


def sentence(report: Mapping[str, Any]) -> str:
    """State cause and gain of a discovery in two sentences."""
    if not report["causes"]:
        return f"    Found: {report['verdict']}."
    cause, gain = report["causes"][0], report["gain"]["range"]
    name, share = MEANING.get(cause["name"], cause["name"].replace("_", " ")), cause["energy_share"]
    low, high = (100 * share * end / cause["value"] for end in cause["ci95"])
    before, refitted, after = (f"{100 * gain[name]:.1f} %" for name in ("before", "control", "after"))
    points = " to ".join(f"{100 * end:.1f}" for end in gain["ci95"])
    return f"""\
    Found: {name}, {100 * share:.1f} % of the energy (95 %: {low:.1f} to {high:.1f}).
    Error of the model's range on rides it was not fitted to: {before}. Refitting known parameters
    leaves {refitted}, adding the cause {after}: a gain of {points} points (95 % over three rides)."""


def draw(rows: Sequence[Row], picture: Path) -> None:
    """The ranges over the kilometres ridden."""
    figure = new_figure(8, 4.2)
    axis = figure.add_axes((0.08, 0.12, 0.89, 0.78))
    rule(axis)
    ridden = [row.ridden for row in rows]
    usual = [(row.ridden, row.usual) for row in rows if row.ridden > LEAST]
    axis.fill_between(
        ridden, [r.p10 for r in rows], [r.p90 for r in rows], color=BLUE, alpha=0.2, label="80 % interval"
    )
    axis.plot(ridden, [row.range for row in rows], color=BLUE, label="range")
    axis.plot(*zip(*usual, strict=True), color=ORANGE, label="usual gauge")
    axis.plot(ridden, [row.left for row in rows], color=INK, linestyle="--", linewidth=1, label="true distance left")
    axis.set_ylim(0, 1.2 * max(row.left for row in rows))
    axis.set_xlim(0, ridden[-1])
    axis.set_xlabel("km ridden", color=INK, fontsize=9, loc="left")
    ordinate(axis, "km left")
    legend(axis)
    save(figure, picture)


if __name__ == "__main__":
    sys.exit(main())
