"""The picture of efficiency maps: motor, inverter, both; each measured point has the colour of what it says."""

from __future__ import annotations

from math import pi
from typing import TYPE_CHECKING, Any

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.offline.style import GRID, INK, MUTED, headline, new_figure, rule
from gz_onboard.vehicle_check.maps import BOTH, INVERTER, MOTOR, Maps

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LEVELS = (0, 20, 40, 50, 60, 65, 70, 75, 80, 82, 84, 86, 88, 90, 92, 94, 96, 98, 100)
_LABELLED = (40, 60, 70, 80, 84, 86, 88, 90, 92, 94, 96, 98)
_COLOURS = "viridis"  # as good for eyes that see red and green alike, and in grey
_APART = 0.1  # of the greatest torque: nearer to none, where all contours run together, none is labelled
_RPM = 30 / pi  # of a rad/s
_PERCENT = 100.0
_MARKERS = {True: ("o", 20), False: ("s", 18)}  # of a bench, of a ride: form, size


def draw_maps(maps: Maps) -> Figure:
    """Three maps beside each other, with one scale of colours."""
    from matplotlib import colormaps
    from matplotlib.colors import BoundaryNorm

    figure = new_figure(15, 5.2)
    norm = BoundaryNorm(_LEVELS, colormaps[_COLOURS].N)
    first: Axes | None = None
    for i, part in enumerate((MOTOR, INVERTER, BOTH)):
        axis = figure.add_axes((0.05 + 0.295 * i, 0.12, 0.265, 0.66), sharex=first, sharey=first)
        first = first or axis
        filled = _draw(axis, maps, part, norm)
        axis.set_title(part, fontsize=10, loc="left", color=INK, pad=24)
        axis.set_xlabel("motor speed [rad/s]", fontsize=8.5, color=INK)
        if i:
            axis.tick_params(labelleft=False)
        else:
            axis.set_ylabel("torque at the shaft [N·m]", fontsize=8.5, color=INK)
    assert first
    torques = [maps.torque, *(points.torque for points in maps.measured)]
    low, high = min(float(x.min()) for x in torques), max(float(x.max()) for x in torques)
    first.set_ylim(low - 0.05 * (high - low), high + 0.05 * (high - low))
    first.set_xlim(0, 1.03 * max(float(maps.speed[-1]), *(float(p.speed.max()) for p in maps.measured), 0.0))
    bar = figure.colorbar(filled, cax=figure.add_axes((0.935, 0.12, 0.012, 0.66)), ticks=_LEVELS, spacing="uniform")
    bar.set_label("efficiency [%]", fontsize=8.5, color=INK)
    bar.ax.tick_params(labelsize=7.5, length=0, colors=MUTED)
    bar.outline.set_edgecolor(GRID)
    headline(figure, 0.05, 0.955, f"{maps.vehicle}: efficiency, motor at {maps.temperature:.0f} °C", 12)
    figure.text(0.05, 0.905, _told(maps), fontsize=8.5, color=MUTED, va="center")
    return figure


def _told(maps: Maps) -> str:
    parts = ["map: loss models of the vehicle file, within the limits of the controller"]
    bench = ", ".join(points.source for points in maps.measured if points.on_bench)
    rides = ", ".join(points.source for points in maps.measured if not points.on_bench)
    if bench:
        parts.append(f"circles: measured, {bench}")
    if rides:
        parts.append(f"squares: steady riding, torque by current, {rides}")
    return "  ·  ".join(parts)


def _label(axis: Axes, maps: Maps, shares: Array) -> None:
    """Numbers at the contours, above and below the torques where they run together."""
    apart = _APART * float(maps.torque[-1])
    for side in (maps.torque > apart, maps.torque < -apart):
        if side.sum() > 1 and np.isfinite(shares[side]).any():
            lines = axis.contour(maps.speed, maps.torque[side], shares[side], levels=_LABELLED, linewidths=0)
            for text in axis.clabel(lines, fmt="%d", fontsize=7.5, inline=False, colors=[INK]):
                text.set_bbox({"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.8})


def _draw(axis: Axes, maps: Maps, part: str, norm: Any) -> Any:
    """One map; gives what its colours are of."""
    rule(axis)
    shares = _PERCENT * maps.efficiency.of(part)
    filled = axis.contourf(maps.speed, maps.torque, shares, levels=_LEVELS, cmap=_COLOURS, norm=norm)
    filled.set(edgecolor="face", linewidth=0.4)  # or SVG and PDF show seams between the colours
    axis.contour(maps.speed, maps.torque, shares, levels=_LABELLED, colors="white", linewidths=0.5)
    _label(axis, maps, shares)
    for edge in (maps.most, maps.least):
        axis.plot(maps.speed, edge, color=INK, linewidth=1.2)
    axis.axhline(0, color=INK, linewidth=0.6)
    for points in maps.measured:
        found = _PERCENT * points.efficiency.of(part)
        use = np.isfinite(found)
        marker, size = _MARKERS[points.on_bench]
        axis.scatter(
            points.speed[use],
            points.torque[use],
            s=size,
            c=found[use],
            marker=marker,
            cmap=_COLOURS,
            norm=norm,
            edgecolors="white",
            linewidths=0.6,
            zorder=3,
        )
    top = axis.secondary_xaxis("top", functions=(lambda x: np.multiply(x, _RPM), lambda x: np.multiply(x, 1 / _RPM)))
    top.set_xlabel("[r/min]", fontsize=7.5, color=MUTED, loc="right", labelpad=2)
    top.tick_params(labelsize=7.5, length=0, colors=MUTED)
    top.spines["top"].set_color(GRID)
    return filled
