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
    ChartPanel,
    Line,
    chart,
    legend,
    new_figure,
    ordinate,
    rule,
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
    c = EstimateColumns(rows)
    unit, x_name = time_unit(c.time[-1] - c.time[0])
    x = (c.time - c.time[0]) / unit
    reasons = [str(reason.name) for reason in Reason if c.where("reasons", str(reason.name)).any()]
    p90 = c("range_p90", 1e-3)
    farthest = np.max(p90, initial=0.0, where=np.isfinite(p90)) or 1.0
    distance = [_range(c), Line(usual_gauge(c) * 1e-3, MUTED, "by the last 25 km's Wh/km alone", 0.9, "--")]
    pack = [
        Line(c("pack_voltage"), PURPLE, "pack voltage", 1.0),
        Line(c("pack_current"), ORANGE, "pack current", 0.7, right=True),
    ]
    rms = c("innovation_rms", 1000)
    innovation = Line(c("innovation", 1000), PURPLE, "innovation", 0.8, band=(-rms, rms), band_label="± RMS of 10 s")
    motion = [
        Line(c("speed", 3.6), BLUE, "speed"),
        Line(c("lean", degrees(1.0)), ORANGE, "lean", 0.6, right=True),
        Line(c("grade", 100), GREEN, "grade", 1.0, right=True),
    ]
    consumption = [
        _with_sd(c, "consumption_expected", 1 / WH_PER_KM, BLUE, "expected"),
        Line(c("consumption_recent", 1 / WH_PER_KM), ORANGE, "recent (last km)", 1.0),
    ]
    warmth = [Line(c("cell_temperature"), ORANGE, "cells", 1.2)]
    for role, (times, values) in (temperatures or {}).items():
        at, name = (np.asarray(times) - c.time[0]) / unit, words(role).split()[0]
        warmth.append(Line(np.asarray(values), TEMPERATURE_COLOURS[role], name, 1.0, x=at))
    panels = [
        ChartPanel("range [km]", distance, 2.0, BLUE, limits=(0.0, farthest * 1.12)),  # whatever the gauge shows
        ChartPanel("SOC [%]", [_with_sd(c, "soc", 100, GREEN, "state of charge")], 1.3, GREEN),
        ChartPanel("voltage [V]", pack, 1.3, PURPLE, "current [A]", ORANGE),
        ChartPanel("innovation\n[mV of a cell]", [innovation], 1.0, PURPLE, zero=True),
        ChartPanel("speed [km/h]", motion, 1.3, BLUE, "grade [%], lean [°]", zero=True),
        ChartPanel("consumption\n[Wh/km]", consumption, 1.3),
        ChartPanel("temperature\n[°C]", warmth),
        ChartPanel("", height=0.34 + 0.17 * len(reasons)),
    ]
    figure = chart([[panel] for panel in panels], x, x_name, title, about, left=0.125)
    _states(figure.axes[len(panels) - 1], x, c, reasons)
    return figure


def _range(c: EstimateColumns) -> Line:
    edges = c("range_p10", 1e-3), c("range_p90", 1e-3)
    return Line(c("range", 1e-3), BLUE, "range", 1.8, band=edges, band_label="P10 to P90")


def _with_sd(c: EstimateColumns, name: str, factor: float, colour: str, label: str) -> Line:
    middle, sd = c(name, factor), c(f"{name}_sd", factor)
    return Line(middle, colour, label, 1.6, band=(middle - sd, middle + sd))


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
    c = EstimateColumns(rows)
    ridden, forecast = c.distance * 1e-3, _range(c)
    lines, known = [forecast], np.flatnonzero(np.isfinite(forecast.y))
    if len(known) and not c.where("activity", Activity.CHARGING.name).any():
        end = np.array([0.0, ridden[known[-1]]])
        lines.append(Line(forecast.y[known[-1]] + end[::-1], MUTED, "as it came", style="--", x=end))
    figure = chart([[ChartPanel("range [km]", lines, 2.2, BLUE)]], ridden, "distance [km]", left=0.06)
    figure.axes[0].set_ylim(bottom=0)
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
