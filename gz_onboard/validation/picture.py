"""Picture of a validated ride: each channel measured and simulated, and the errors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gz_onboard.reports.style import BLUE, GREEN, INK, MUTED, ORANGE, headline, new_figure, rule, save, time_unit
from gz_onboard.validation.comparison import CHANNELS, FORMS, Comparison, ValidatedRide

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = {"open_loop": ORANGE, "predictive": BLUE, "components": GREEN}
AVERAGED_S = 30
"""Averages gears and gusts out of an error."""
_DPI = 90  # of a wide picture


def draw_ride(file: Path, ride: ValidatedRide, comparisons: Mapping[str, Mapping[str, Comparison]]) -> None:
    """A picture: each channel measured and simulated on the left, the errors on the right. Raises OSError."""
    panels = _panels(comparisons)
    height = 1.0 + 1.45 * len(panels)
    figure = new_figure(15, height)
    grid = figure.add_gridspec(
        len(panels), 2, left=0.055, right=0.99, top=1 - 0.75 / height, bottom=0.45 / height, hspace=0.35, wspace=0.11
    )
    unit, name = time_unit(ride.duration_s)
    first: Axes | None = None
    for i, panel in enumerate(panels):
        left = figure.add_subplot(grid[i, 0], sharex=first)
        first = first or left
        right = figure.add_subplot(grid[i, 1], sharex=first)
        _draw_panel(left, right, panel, unit)
        for axis in (left, right):
            rule(axis)
            axis.tick_params(labelsize=7.5, labelbottom=i == len(panels) - 1)
        if not i:
            left.set_title("measured and simulated", fontsize=9, loc="left", color=INK)
            heading = f"simulated less measured: each second, and the mean of {AVERAGED_S} s"
            right.set_title(heading, fontsize=9, loc="left", color=INK)
        if i == len(panels) - 1:
            for axis in (left, right):
                axis.set_xlabel(f"time [{name}]", fontsize=8.5, loc="left", color=INK)
    assert first
    first.set_xlim(0, max(ride.duration_s / unit, 1e-3))
    _legend(figure)
    air = "" if ride.ambient_c is None else f", air {ride.ambient_c:.0f} °C"
    title = f"{ride.name} · {ride.vehicle}, {ride.payload_kg:g} kg{air}, {ride.distance_km:.1f} km"
    headline(figure, 0.055, 1 - 0.3 / height, title, 12)
    save(figure, file, _DPI)


def _panels(comparisons: Mapping[str, Mapping[str, Comparison]]) -> list[dict[str, Comparison]]:
    """Comparisons of each quantity, by form; that of a component is drawn with the channel of the same quantity."""
    found: dict[str, dict[str, Comparison]] = {channel.label: {} for channel in CHANNELS.values()}
    for form, by_name in comparisons.items():
        for name, comparison in by_name.items():
            if name != "pack_power":
                found.setdefault(comparison.quantity.label, {})[form] = comparison
    return [panel for panel in found.values() if panel]


def _draw_panel(left: Axes, right: Axes, panel: Mapping[str, Comparison], unit: float) -> None:
    """Values on the left, errors on the right, over time in `unit` [s]."""
    right.axhline(0, color=MUTED, linewidth=0.8)
    for i, (form, comparison) in enumerate(panel.items()):
        hide = np.where(comparison.valid, 1.0, np.nan)
        n = len(hide)
        time, colour = np.arange(n) / unit, COLOURS[form]
        if not i:
            quantity = comparison.quantity
            left.plot(time, comparison.measured * hide, color=INK, linewidth=1.1, label="measured")
            left.set_ylabel(f"{quantity.label}\n[{quantity.unit.replace('degC', '°C')}]", fontsize=8, color=INK)
        left.plot(time, comparison.modelled * hide, color=colour, linewidth=0.9, alpha=0.85, label=FORMS[form])
        right.plot(time, comparison.error * hide, color=colour, linewidth=0.35 if n > 60 else 1.0, alpha=0.45)
        wide = min(AVERAGED_S, max(n // 4, 1))
        weight = np.convolve(comparison.valid, np.ones(wide), "same")
        mean = np.convolve(np.where(comparison.valid, comparison.error, 0.0), np.ones(wide), "same")
        mean = np.where(weight > wide / 4, mean / np.maximum(weight, 1), np.nan)
        right.plot(time, mean, color=colour, linewidth=1.5, label=FORMS[form])


def _legend(figure: Figure) -> None:
    named = {label: line for axis in figure.axes for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    order = [label for label in ("measured", *FORMS.values()) if label in named]
    figure.legend(
        handles=[named[label] for label in order],
        labels=order,
        loc="upper right",
        ncols=4,
        frameon=False,
        fontsize=9,
        bbox_to_anchor=(0.99, 1.0),
    )
