"""A history as a picture: consumption, temperature, capacity and resistance over months."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from typing import TYPE_CHECKING

from gz_onboard.lab.history.totals import LEARNED, Overview, local
from gz_onboard.offline.style import (
    BLUE,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    PURPLE,
    RED,
    headline,
    legend,
    new_figure,
    ordinate,
    rule,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, RED)  # of the vehicles
_SMALLEST, _LARGEST = 8.0, 80.0  # of a dot, by distance
_MARGIN = timedelta(days=1)  # before the first ride and after the last
_LONGEST = 50.0  # km, of the largest dot
_LEVELS = ("%Y", "%b %Y", "%d %b", "%H:%M", "%H:%M", "%S.%f")  # of ticks at years, months, days, hours, ...
_FIRST_OF_LEVEL = ("", "%b %Y", "%d %b", "%d %b", "%H:%M", "%H:%M")


def draw_history(vehicles: Sequence[Overview]) -> Figure:
    """Rides over time and over the air's temperature, and below them what was learned of the battery."""
    figure = new_figure(12, 9.5)
    grid = figure.add_gridspec(3, 2, width_ratios=(2, 1), left=0.075, right=0.97, top=0.9, bottom=0.06, hspace=0.28)
    over_time, over_air = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1])
    learned = [figure.add_subplot(grid[1 + i, :], sharex=over_time) for i in range(len(LEARNED))]
    for axis in (over_time, over_air, *learned):
        rule(axis)
    for i, vehicle in enumerate(vehicles):
        colour = _COLOURS[i % len(_COLOURS)]
        _consumption(over_time, over_air, vehicle, colour)
        for axis, name in zip(learned, LEARNED, strict=True):
            _learned(axis, vehicle, name, colour)
    ordinate(over_time, "consumption [Wh/km]")
    over_air.set_xlabel("air [°C]", color=INK, fontsize=9, loc="left")
    for axis, name in zip(learned, LEARNED, strict=True):
        axis.axhline(1.0, color=MUTED, linewidth=0.6, zorder=1)
        ordinate(axis, f"{name} over\nthe vehicle file's, ± σ")
    if len(vehicles) > 1:
        legend(over_time)
    for axis in (over_time, *learned):
        _dates(axis)
    if dates := [local(one.ride.start_ns) for vehicle in vehicles for one in vehicle.rides if one.ride.dated]:
        over_time.set_xlim(min(dates) - _MARGIN, max(dates) + _MARGIN)  # type: ignore[arg-type]
        for axis in (over_time, learned[-1]):
            axis.set_xlabel(_years(dates), color=INK, fontsize=9, loc="left")
    rides = sum(len(vehicle.rides) for vehicle in vehicles)
    length = sum(vehicle.total.distance_km for vehicle in vehicles)
    headline(
        figure, 0.075, 0.95, f"{', '.join(vehicle.vehicle for vehicle in vehicles)}: {rides} rides, {length:.0f} km", 14
    )
    return figure


def _consumption(over_time: Axes, over_air: Axes, of: Overview, colour: str) -> None:
    """Each ride as a dot, the larger the longer it was; each month as a line."""
    rides = [one.ride for one in of.rides if one.ride.consumption_wh_km is not None]
    dated = [ride for ride in rides if ride.dated]
    warm = [ride for ride in rides if ride.ambient_C is not None]
    for axis, shown, x in (
        (over_time, dated, [local(ride.start_ns) for ride in dated]),
        (over_air, warm, [ride.ambient_C for ride in warm]),
    ):
        sizes = [max(_SMALLEST, min(ride.distance_km / _LONGEST, 1.0) * _LARGEST) for ride in shown]
        values = [ride.consumption_wh_km for ride in shown]
        axis.scatter(x, values, s=sizes, color=colour, alpha=0.5, linewidths=0, label=of.vehicle)  # type: ignore[arg-type]
    for month in of.months:
        days = [local(ride.start_ns) for ride in dated if f"{local(ride.start_ns):%Y-%m}" == month.of]
        if days and month.consumption_wh_km is not None:
            over_time.hlines(month.consumption_wh_km, min(days), max(days), color=colour, linewidth=1.6)  # type: ignore[arg-type]


def _learned(axis: Axes, of: Overview, name: str, colour: str) -> None:
    found = [one for one in of.learned if one.name == name]
    times: list[datetime] = [local(one.start_ns) for one in found]
    values = [one.value for one in found]
    axis.errorbar(times, values, yerr=[one.sd for one in found], fmt="o", ms=3, lw=0.8, color=colour)  # type: ignore[arg-type]


def _dates(axis: Axes) -> None:
    """Dates below a panel, no more than fit. Each says its month: the formatter's own names only the last one's."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    locator = AutoDateLocator(maxticks=9)  # type: ignore[no-untyped-call]
    axis.xaxis.set_major_locator(locator)
    given = {"formats": _LEVELS, "zero_formats": _FIRST_OF_LEVEL, "show_offset": False}
    axis.xaxis.set_major_formatter(ConciseDateFormatter(locator, **given))  # type: ignore[no-untyped-call]


def _years(dates: Sequence[datetime]) -> str:
    first, last = min(dates).year, max(dates).year
    return f"{first}" if first == last else f"{first} to {last}"
