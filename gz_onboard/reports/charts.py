"""The charts of an estimated ride: the picture of ``gz-onboard estimate`` and the page of ``gz-onboard report``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import cos, degrees, radians
from typing import TYPE_CHECKING, Any

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.constants import METRES_PER_DEGREE, WH_PER_KM
from gz_onboard.events import Activity, Reason, State, words
from gz_onboard.reports.style import (
    BLUE,
    GREEN,
    MUTED,
    ORANGE,
    PURPLE,
    RED,
    close,
    headline,
    legend,
    new_figure,
    ordinate,
    rule,
    second,
    stack,
    time_unit,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Row = Mapping[str, Any]
"""One estimate, as `log_rows.ESTIMATE_UNITS` names its fields."""
Series = tuple[Sequence[float], Sequence[float]]
"""Times [s] and values."""

GAUGE_WINDOW_M, GAUGE_FROM_M = 25_000.0, 1_000.0
"""Usual range gauges average the consumption over the last 25 km, once there is one kilometre."""
HOLE_S = 3.0
"""Estimates come at least once a second: no line is drawn through a longer hole."""
LONGEST_HELD_S = 10.0
"""The power drawn in a longer hole is unknown."""
STATE_COLOURS = {State.STARTING: "#9fb3c8", State.VALID: "#3f9d6b", State.DEGRADED: "#e8a33d", State.INVALID: "#c53030"}
TEMPERATURE_COLOURS = {"motor_temperature": RED, "inverter_temperature": PURPLE, "ambient_temperature": BLUE}


class EstimateColumns:
    """The estimates of a ride as columns, NaN where unknown, with an empty row in each hole."""

    def __init__(self, rows: Sequence[Row]) -> None:
        self.rows = rows
        self.holes = np.flatnonzero(np.diff([row["time"] for row in rows]) > HOLE_S) + 1
        self.time, self.distance = (
            np.insert(column, self.holes, column[self.holes - 1])
            for column in (np.array([row[name] for row in rows], dtype=float) for name in ("time", "distance"))
        )

    def __call__(self, name: str, factor: float = 1.0) -> Array:
        """A field of the estimates times `factor`."""
        return np.insert(np.array([row.get(name) for row in self.rows], dtype=float) * factor, self.holes, np.nan)

    def where(self, field: str, name: str) -> Mask:
        """Where a field of names holds `name`."""
        found = np.array([name in (row.get(field) or "").split() for row in self.rows], dtype=bool)
        return np.insert(found, self.holes, False)


def usual_gauge(columns: EstimateColumns) -> Array:
    """Return the range [m] that a usual gauge shows: energy left over the mean consumption of the last 25 km.

    Source of the rule: OVMS' vehicle modules. The energy left is that of the estimate.
    """
    power = columns("pack_voltage") * columns("pack_current")
    power[columns.where("activity", Activity.CHARGING.name)] = 0.0  # a charger's energy is not recovered
    step = np.diff(columns.time, prepend=columns.time[0])
    drawn = np.cumsum(np.where(np.isfinite(power) & (step <= LONGEST_HELD_S), power * step, 0.0))
    distance = columns.distance
    begin = np.maximum(distance - GAUGE_WINDOW_M, distance[0])
    energy, length = drawn - np.interp(begin, distance, drawn), distance - begin
    known = (length >= GAUGE_FROM_M) & (energy > 0)
    shown: Array = np.where(known, columns("energy_left") * length / np.where(known, energy, 1.0), np.nan)
    return shown


def overview(
    rows: Sequence[Row], title: str = "", about: str = "", temperatures: Mapping[str, Series] | None = None
) -> Figure:
    """Draw range, state of charge, pack, innovation, motion, consumption, temperatures and state over time.

    temperatures: measured ones by role [degC], times since the first frame.
    """
    columns = EstimateColumns(rows)
    reasons = [str(reason.name) for reason in Reason if columns.where("reasons", str(reason.name)).any()]
    panels = [(2.0, _range), (1.3, _soc), (1.3, _electric), (1.0, _innovation), (1.3, _motion), (1.3, _consumption)]
    heights = [height for height, _ in panels] + [1.0, 0.34 + 0.17 * len(reasons)]
    top = 0.95 if title else 0.35
    height = top + 1.15 + 1.12 * sum(heights)
    figure = new_figure(12, height)
    axes = stack(figure, heights, left=0.125, hspace=0.26, top=top, bottom=0.5)
    unit, name = time_unit(columns.time[-1] - columns.time[0])
    x = (columns.time - columns.time[0]) / unit
    for axis, (_, panel) in zip(axes, panels, strict=False):
        panel(axis, x, columns)
    _temperatures(axes[-2], x, columns, temperatures or {}, unit)
    _states(axes[-1], x, columns, reasons)
    close(axes, x, f"time [{name}]")
    if title:
        headline(figure, 0.125, 1 - 0.32 / height, title, 14)
        figure.text(0.125, 1 - 0.60 / height, about, fontsize=9.5, color=MUTED, va="center")
    return figure


def _range(axis: Axes, x: Array, columns: EstimateColumns) -> None:
    p90 = columns("range_p90", 1e-3)
    axis.fill_between(x, columns("range_p10", 1e-3), p90, color=BLUE, alpha=0.18, linewidth=0, label="P10 to P90")
    gauge = usual_gauge(columns) * 1e-3
    axis.plot(x, gauge, color=MUTED, linewidth=0.9, linestyle=(0, (4, 2)), label="by the last 25 km's Wh/km alone")
    axis.plot(x, columns("range", 1e-3), color=BLUE, linewidth=1.8, label="range")
    top = np.max(p90, initial=0.0, where=np.isfinite(p90)) or 1.0
    axis.set_ylim(0, top * 1.12)  # the gauge may show anything: it does not set the scale
    ordinate(axis, "range [km]", BLUE)
    legend(axis)


def _with_band(axis: Axes, x: Array, middle: Array, sd: Array, colour: str, label: str) -> None:
    axis.fill_between(x, middle - sd, middle + sd, color=colour, alpha=0.2, linewidth=0, label="± σ")
    axis.plot(x, middle, color=colour, linewidth=1.6, label=label)


def _soc(axis: Axes, x: Array, columns: EstimateColumns) -> None:
    _with_band(axis, x, columns("soc", 100), columns("soc_sd", 100), GREEN, "state of charge")
    ordinate(axis, "SOC [%]", GREEN)
    legend(axis)


def _electric(axis: Axes, x: Array, columns: EstimateColumns) -> None:
    other = second(axis, "current [A]", ORANGE)
    other.plot(x, columns("pack_current"), color=ORANGE, linewidth=0.7, alpha=0.8, label="pack current")
    axis.plot(x, columns("pack_voltage"), color=PURPLE, linewidth=1.0, label="pack voltage")
    ordinate(axis, "voltage [V]", PURPLE)
    legend(axis, other)


def _innovation(axis: Axes, x: Array, columns: EstimateColumns) -> None:
    rms = columns("innovation_rms", 1000)
    axis.fill_between(x, -rms, rms, color=PURPLE, alpha=0.2, linewidth=0, label="± RMS of 10 s")
    axis.plot(x, columns("innovation", 1000), color=PURPLE, linewidth=0.8, label="innovation")
    axis.axhline(0, color=MUTED, linewidth=0.6, zorder=1)
    ordinate(axis, "innovation\n[mV of a cell]", PURPLE)
    legend(axis)


def _motion(axis: Axes, x: Array, columns: EstimateColumns) -> None:
    other = second(axis, "grade [%], lean [°]", MUTED)
    other.plot(x, columns("lean", degrees(1.0)), color=ORANGE, linewidth=0.6, alpha=0.75, label="lean")
    other.plot(x, columns("grade", 100), color=GREEN, linewidth=1.0, label="grade")
    other.axhline(0, color=MUTED, linewidth=0.6, zorder=1)
    axis.plot(x, columns("speed", 3.6), color=BLUE, linewidth=1.1, label="speed")
    ordinate(axis, "speed [km/h]", BLUE)
    legend(axis, other)


def _consumption(axis: Axes, x: Array, columns: EstimateColumns) -> None:
    expected, sd = (columns(f"consumption_expected{part}", 1 / WH_PER_KM) for part in ("", "_sd"))
    _with_band(axis, x, expected, sd, BLUE, "expected")
    recent = columns("consumption_recent", 1 / WH_PER_KM)
    axis.plot(x, recent, color=ORANGE, linewidth=1.0, label="recent (last km)")
    ordinate(axis, "consumption\n[Wh/km]")
    legend(axis)


def _temperatures(axis: Axes, x: Array, columns: EstimateColumns, measured: Mapping[str, Series], unit: float) -> None:
    axis.plot(x, columns("cell_temperature"), color=ORANGE, linewidth=1.2, label="cells")
    for role, (times, values) in measured.items():
        at = (np.asarray(times) - columns.time[0]) / unit
        axis.plot(at, values, color=TEMPERATURE_COLOURS[role], linewidth=1.0, label=words(role).split()[0])
    ordinate(axis, "temperature\n[°C]")
    legend(axis)


def _states(axis: Axes, x: Array, columns: EstimateColumns, reasons: Sequence[str]) -> None:
    """State and reasons over the ride, one line each; an estimate holds until the next."""
    axis.grid(visible=False)

    def bars(place: float, height: float, where: Mask, colour: str, label: str | None = None) -> None:
        edges = np.flatnonzero(np.diff(np.concatenate(([0], where.astype(int), [0]))))
        spans = [(x[a], x[min(b, len(x) - 1)] - x[a]) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        axis.broken_barh(spans, (place - height / 2, height), facecolors=colour, linewidth=0, label=label)

    for state, colour in STATE_COLOURS.items():
        where = columns.where("state", state.name)
        if where.any():
            bars(0, 0.84, where, colour, state.name.lower())
    for place, reason in enumerate(reasons, 1):
        bars(place, 0.6, columns.where("reasons", reason), MUTED)
    axis.set_ylim(len(reasons) + 0.6, -0.6)
    axis.set_yticks(range(len(reasons) + 1), ["state", *map(words, reasons)], fontsize=7)
    legend(axis)


def range_over_distance(rows: Sequence[Row]) -> Figure:
    """Draw the range over the distance, and against it the distance ridden until the last range, plus that range."""
    columns = EstimateColumns(rows)
    ridden, left = columns.distance * 1e-3, columns("range", 1e-3)
    figure = new_figure(12, 3.4)
    (axis,) = stack(figure, [1.0], left=0.06, hspace=0.0, top=0.35, bottom=0.5)
    low, high = columns("range_p10", 1e-3), columns("range_p90", 1e-3)
    axis.fill_between(ridden, low, high, color=BLUE, alpha=0.18, linewidth=0, label="P10 to P90")
    axis.plot(ridden, left, color=BLUE, linewidth=1.8, label="forecast")
    known = np.flatnonzero(np.isfinite(left))
    charged = columns.where("activity", Activity.CHARGING.name).any()
    if len(known) and ridden[known[-1]] > ridden[known[0]] and not charged:
        end = ridden[known[-1]]
        axis.plot([0.0, end], [left[known[-1]] + end, left[known[-1]]], "--", color=MUTED, label="what it came to")
    axis.set_ylim(bottom=0)
    ordinate(axis, "range [km]", BLUE)
    legend(axis)
    close([axis], ridden, "distance [km]")
    return figure


def path_map(runs: Sequence[Sequence[tuple[float, float]]]) -> Figure:
    """Draw the way through `runs` of positions (latitude, longitude) [deg], north up, in km from its start.

    Around the middle the earth is taken to be flat, which is right to a per mille over 100 km.
    """
    north, west = runs[0][0]
    cosine = cos(radians(float(np.mean([run[0][0] for run in runs]))))
    figure = new_figure(12, 6)
    axis = figure.add_axes((0.06, 0.1, 0.92, 0.86))
    rule(axis)
    ways = []
    for run in runs:
        latitude, longitude = np.array(run).T
        east = (longitude - west + 180) % 360 - 180
        ways.append((east * cosine * METRES_PER_DEGREE * 1e-3, (latitude - north) * METRES_PER_DEGREE * 1e-3))
        axis.plot(*ways[-1], color=BLUE, linewidth=2)
    axis.plot(ways[0][0][0], ways[0][1][0], "o", color=GREEN, label="start")
    axis.plot(ways[-1][0][-1], ways[-1][1][-1], "o", color=RED, label="end")
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel("east [km]", fontsize=8.5)
    ordinate(axis, "north [km]")
    legend(axis)
    return figure
