"""``gz-onboard plot``: an overview of an estimated ride as a picture, from the estimates in its MCAP log."""

from __future__ import annotations

import argparse
import sys
from collections import deque
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import partial
from itertools import pairwise
from math import degrees, isfinite
from pathlib import Path
from typing import TYPE_CHECKING

from gz_onboard.can.codec import DROPPING
from gz_onboard.constants import WH_PER_KM
from gz_onboard.errors import BAD_INPUT, OK, InputError, writing
from gz_onboard.events import Activity, Reason, State, words
from gz_onboard.lab.logged import Logged, read_ride
from gz_onboard.lab.why import plot_why
from gz_onboard.options import PICTURE_FORMATS, add_shared
from gz_onboard.recording.logs import logs_among, read_metadata
from gz_onboard.recording.readers.contents import LogDamage
from gz_onboard.reports.style import (
    BLUE,
    GREEN,
    MUTED,
    ORANGE,
    PURPLE,
    close,
    headline,
    legend,
    new_figure,
    ordinate,
    picture_format,
    save,
    second,
    stack,
    time_unit,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NAIVE_LENGTH = 25_000.0  # m: what usual displays average the consumption over
NAIVE_FROM = 1_000.0  # m
STATES = {State.STARTING: "#9fb3c8", State.VALID: "#3f9d6b", State.DEGRADED: "#e8a33d", State.INVALID: "#c53030"}
_NAN = float("nan")
_HOLE = 3.0  # s: estimates further apart than this have a hole between them; they come at least once a second


def naive_range(rows: Sequence[Logged]) -> list[float | None]:
    """What a usual display would show [m]: energy left over the consumption of the last 25 km, from the first on.

    Source of the rule: OVMS' vehicle modules; the energy left is taken from the estimate.
    """
    ridden: deque[tuple[float, float]] = deque([(0.0, 0.0)])  # (distance [m], energy drawn until there [J])
    result: list[float | None] = []
    drawn, before = 0.0, None
    for row in rows:
        voltage, current, time = row.get("pack_voltage"), row.get("pack_current"), row["time"]
        if row.get("activity") == Activity.CHARGING.name:  # what a charger gives was not recovered
            current = None
        if voltage is not None and current is not None and before is not None and 0 < time - before <= 10:
            drawn += voltage * current * (time - before)
        distance = row.get("distance") or 0.0
        if before is not None and time - before > 10:  # a hole, whose energy is not known
            ridden = deque([(distance, drawn)])
        before = time
        if distance > ridden[-1][0]:
            ridden.append((distance, drawn))
        while len(ridden) > 1 and distance - ridden[1][0] >= NAIVE_LENGTH:
            ridden.popleft()
        length, energy = distance - ridden[0][0], drawn - ridden[0][1]
        left = row.get("energy_left")
        result.append(left * length / energy if left is not None and length >= NAIVE_FROM and energy > 0 else None)
    return result


def plot_log(log: Path, picture: Path, over: str = "time") -> list[LogDamage]:
    """Draw the ride in `log` into `picture`, over ``time`` or ``distance``; gives what could not be read.

    Raises InputError, OSError.
    """
    damages: list[LogDamage] = []
    rows, times, status = read_ride(log, damages.append)
    title, about = _title(log, rows, times)
    note = "damaged log  ·  " if damages else ""
    save(draw(rows, times, status, (title, note + about), over), picture)
    return damages


def with_holes(rows: Sequence[Logged]) -> list[Logged]:
    """`rows` with an empty one in each hole of the log, through which no line is drawn."""
    shown = list(rows[:1])
    for before, row in pairwise(rows):
        if row["time"] - before["time"] > _HOLE:
            kept = {"time": before["time"], "distance": before["distance"], "state": "", "reasons": ""}
            shown.append(dict.fromkeys(before) | kept)
        shown.append(row)
    return shown


def draw(
    rows: Sequence[Logged], times: Sequence[int], status: Logged, title: tuple[str, str], over: str = "time"
) -> Figure:
    """The overview of a ride as a figure, over ``time`` or ``distance``."""
    rows = with_holes(rows)
    reasons = [reason for reason in Reason if any(str(reason.name) in row["reasons"].split() for row in rows)]
    strip = 0.34 + 0.17 * len(reasons)
    heights = [2.0, 1.3, 1.3, 1.0, 1.3, 1.3, strip]
    height = 2.1 + 1.12 * sum(heights)
    figure = new_figure(12, height)
    axes = stack(figure, heights, left=0.125, hspace=0.26, top=0.95, bottom=0.5)
    x, text = _abscissa(rows, times, over)
    for axis, panel in zip(axes, (_range, _soc, _electric, _innovation, _motion, _consumption), strict=False):
        panel(axis, x, rows)
    _strip(axes[-1], x, rows, reasons, status)
    close(axes, x, text)
    headline(figure, 0.125, 1 - 0.32 / height, title[0], 14)
    figure.text(0.125, 1 - 0.60 / height, title[1], fontsize=9.5, color=MUTED, va="center")
    return figure


def _title(log: Path, rows: Sequence[Logged], times: Sequence[int]) -> tuple[str, str]:
    metadata = read_metadata(log)
    last = rows[-1]
    start = datetime.fromtimestamp(times[0] / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    parts = [start, f"{(times[-1] - times[0]) / 60e9:.1f} min", f"{last['distance'] / 1000:.2f} km"]
    known = [row for row in rows if row["soc"] is not None]
    if known:
        parts.append(f"state of charge {100 * known[0]['soc']:.1f} → {100 * known[-1]['soc']:.1f} %")
    ranged = [row for row in rows if row["range"] is not None]
    if ranged:
        end, p10, p90 = (ranged[-1][name] / 1000 for name in ("range", "range_p10", "range_p90"))
        parts.append(f"range at the end {end:.1f} km ({p10:.1f}–{p90:.1f})")
    return " · ".join(filter(None, (metadata.get("source", log.name), metadata.get("vehicle")))), "  ·  ".join(parts)


def _abscissa(rows: Sequence[Logged], times: Sequence[int], over: str) -> tuple[list[float], str]:
    if over == "distance":
        return [row["distance"] / 1000 for row in rows], "distance [km]"
    # The time within the estimates goes on evenly when the clock is set; that of the log does not.
    start, end = rows[0]["time"], rows[-1]["time"]
    seconds, unit = time_unit(end - start)
    return [(row["time"] - start) / seconds for row in rows], f"time [{unit}]"


def column(rows: Sequence[Logged], name: str, factor: float = 1.0) -> list[float]:
    """A field of the estimates; what is not known leaves a gap in the line."""
    return [_NAN if (value := row.get(name)) is None else value * factor for row in rows]


def _band(axis: Axes, x: Sequence[float], middle: Sequence[float], sd: Sequence[float], colour: str, text: str) -> None:
    low = [m - s for m, s in zip(middle, sd, strict=True)]
    high = [m + s for m, s in zip(middle, sd, strict=True)]
    axis.fill_between(x, low, high, color=colour, alpha=0.2, linewidth=0, label=text)


def _range(axis: Axes, x: Sequence[float], rows: Sequence[Logged]) -> None:
    p10, p90 = column(rows, "range_p10", 1e-3), column(rows, "range_p90", 1e-3)
    naive = [_NAN if value is None else value / 1000 for value in naive_range(rows)]
    axis.fill_between(x, p10, p90, color=BLUE, alpha=0.18, linewidth=0, label="P10 to P90")
    axis.plot(x, naive, color=MUTED, linewidth=0.9, linestyle=(0, (4, 2)), label="by the last 25 km's Wh/km alone")
    axis.plot(x, column(rows, "range", 1e-3), color=BLUE, linewidth=1.8, label="range")
    top = max(filter(isfinite, p90), default=1.0)
    axis.set_ylim(0, top * 1.12)  # the naive one may be anything: it does not set the scale
    ordinate(axis, "range [km]", BLUE)
    legend(axis)


def _soc(axis: Axes, x: Sequence[float], rows: Sequence[Logged]) -> None:
    soc = column(rows, "soc", 100)
    _band(axis, x, soc, column(rows, "soc_sd", 100), GREEN, "± σ")
    axis.plot(x, soc, color=GREEN, linewidth=1.6, label="state of charge")
    ordinate(axis, "SOC [%]", GREEN)
    legend(axis)


def _electric(axis: Axes, x: Sequence[float], rows: Sequence[Logged]) -> None:
    other = second(axis, "current [A]", ORANGE)
    other.plot(x, column(rows, "pack_current"), color=ORANGE, linewidth=0.7, alpha=0.8, label="pack current")
    axis.plot(x, column(rows, "pack_voltage"), color=PURPLE, linewidth=1.0, label="pack voltage")
    ordinate(axis, "voltage [V]", PURPLE)
    legend(axis, other)


def _innovation(axis: Axes, x: Sequence[float], rows: Sequence[Logged]) -> None:
    rms = column(rows, "innovation_rms", 1000)
    axis.fill_between(x, [-v for v in rms], rms, color=PURPLE, alpha=0.2, linewidth=0, label="± RMS of 10 s")
    axis.plot(x, column(rows, "innovation", 1000), color=PURPLE, linewidth=0.8, label="innovation")
    axis.axhline(0, color=MUTED, linewidth=0.6, zorder=1)
    ordinate(axis, "innovation\n[mV of a cell]", PURPLE)
    legend(axis)


def _motion(axis: Axes, x: Sequence[float], rows: Sequence[Logged]) -> None:
    other = second(axis, "grade [%], lean [°]", MUTED)
    other.plot(x, column(rows, "lean", degrees(1.0)), color=ORANGE, linewidth=0.6, alpha=0.75, label="lean")
    other.plot(x, column(rows, "grade", 100), color=GREEN, linewidth=1.0, label="grade")
    other.axhline(0, color=MUTED, linewidth=0.6, zorder=1)
    axis.plot(x, column(rows, "speed", 3.6), color=BLUE, linewidth=1.1, label="speed")
    ordinate(axis, "speed [km/h]", BLUE)
    legend(axis, other)


def _consumption(axis: Axes, x: Sequence[float], rows: Sequence[Logged]) -> None:
    expected = column(rows, "consumption_expected", 1 / WH_PER_KM)
    _band(axis, x, expected, column(rows, "consumption_expected_sd", 1 / WH_PER_KM), BLUE, "± σ")
    axis.plot(x, expected, color=BLUE, linewidth=1.6, label="expected")
    recent = column(rows, "consumption_recent", 1 / WH_PER_KM)
    axis.plot(x, recent, color=ORANGE, linewidth=1.0, label="recent (last km)")
    ordinate(axis, "consumption\n[Wh/km]")
    legend(axis)


def _strip(axis: Axes, x: Sequence[float], rows: Sequence[Logged], reasons: Sequence[Reason], status: Logged) -> None:
    """State and reasons over the ride, one line each."""
    axis.grid(visible=False)
    for state, colour in STATES.items():
        where = spans(x, [row["state"] == state.name for row in rows])
        axis.broken_barh(
            where, (-0.42, 0.84), facecolors=colour, linewidth=0, label=state.name.lower() if where else None
        )
    labels = ["state"]
    for place, reason in enumerate(reasons, 1):
        where = spans(x, [reason.name in row["reasons"].split() for row in rows])
        axis.broken_barh(where, (place - 0.3, 0.6), facecolors=MUTED, linewidth=0)
        labels.append(words(str(reason.name)))
    axis.set_ylim(len(labels) - 0.4, -0.6)
    axis.set_yticks(range(len(labels)), labels, fontsize=7)
    legend(axis)
    if status:
        faults = {reason: sum(places.values()) for reason, places in status.get("faults", {}).items()}
        dropped = sum(count for reason, count in faults.items() if reason in DROPPING)
        text = (
            f"{status.get('received', 0)} frames received, {sum(status.get('lost', {}).values())} lost, "
            f"{dropped} dropped, {len(status.get('unknown', {}))} unknown identifiers; "
            f"{sum(faults.values()) - dropped} signals not available or implausible"
        )
        axis.annotate(
            text,
            (1, 0),
            (0, -27),
            xycoords="axes fraction",
            textcoords="offset points",
            ha="right",
            fontsize=8,
            color=MUTED,
        )


def spans(x: Sequence[float], true: Sequence[bool]) -> list[tuple[float, float]]:
    """(begin, length) of the stretches in which something is true; each estimate holds until the next."""
    from gz_onboard.offline.arrays import stretches

    return [(x[i], x[min(j, len(x) - 1)] - x[i]) for i, j in stretches(true)]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard plot``."""
    add_shared(parser, "log", help="MCAP log of gz-onboard run or gz-onboard estimate, or a folder of them")
    ends = "file to write, .png, .svg or .pdf (default: the name of the log, ending as --format says)"
    parser.add_argument("picture", type=Path, nargs="?", metavar="PICTURE", help=ends)
    add_shared(parser, "--format", default=None, help="of the picture: for papers svg or pdf (default: png)")
    parser.add_argument("--why", action="store_true", help="instead, why the range at the end is not the rated one")
    parser.add_argument("--over", choices=("time", "distance"), default="time", help="abscissa (default: %(default)s)")


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard plot``: `OK` if every log could be drawn, else `BAD_INPUT`."""
    if not arguments.log.is_dir():
        _plot_one(arguments.log, arguments)
        return OK
    if arguments.picture:
        raise InputError(f"{arguments.picture}: of a folder, each picture has the name of its log; leave it out")
    status = OK
    logs = [log for log in logs_among([arguments.log], estimates=True) if log.suffix.lower() == ".mcap"]
    if not logs:
        raise InputError(
            f"{arguments.log}: its logs hold no estimates; `gz-onboard estimate {arguments.log}` makes them"
        )
    for log in logs:
        try:
            _plot_one(log, arguments)
        except InputError as error:
            print(f"gz-onboard plot: {error}", file=sys.stderr)
            status = BAD_INPUT
    return status


def _plot_one(log: Path, arguments: argparse.Namespace) -> None:
    kind = arguments.picture_format
    ending = f"{'.why' if arguments.why else ''}.{kind or PICTURE_FORMATS[0]}"
    picture = arguments.picture or log.with_suffix(ending)
    if picture_format(picture) != (kind or picture_format(picture)):
        raise InputError(f"{picture}: the picture's name does not end in .{kind}, as --format says")
    with writing(picture):
        plot = plot_why if arguments.why else partial(plot_log, over=arguments.over)
        for damage in plot(log, picture):
            print(f"gz-onboard plot: {damage}", file=sys.stderr)
    print(picture)
