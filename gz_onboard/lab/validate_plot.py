"""Picture of a validated ride: each channel measured and simulated, and the errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.lab.validate_components import Component
from gz_onboard.lab.validate_score import CHANNELS, GIVEN, NAMES, ValidatedRide
from gz_onboard.reports.style import BLUE, GREEN, INK, MUTED, ORANGE, headline, new_figure, rule, save, time_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = {"open_loop": ORANGE, "predictive": BLUE, "components": GREEN}
_ALONE = {
    "battery_voltage": "pack_voltage",
    "motor_torque": "motor_torque",
    "motor_temperature": "motor_temperature",
    "inverter_temperature": "inverter_temperature",
    "cell_temperature": "cell_temperature",
}
"""Components that are drawn beside the channel that they give."""
_MEAN = 30  # s: what is left of an error when gears and gusts are averaged out
_DPI = 90  # of a wide picture


@dataclass(frozen=True)
class _Panel:
    label: str
    unit: str
    measured: Array
    modelled: dict[str, Array]  # by form


def draw_ride(
    file: Path,
    ride: ValidatedRide,
    measured: Mapping[str, Array],
    simulated: Mapping[str, Mapping[str, Array]],
    alone: Mapping[str, Component],
) -> None:
    """A picture: each channel measured and simulated on the left, the errors on the right. Raises OSError."""
    panels = _panels(measured, simulated, alone)
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
            heading = f"simulated less measured: each second, and the mean of {_MEAN} s"
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


def _panels(
    measured: Mapping[str, Array], simulated: Mapping[str, Mapping[str, Array]], alone: Mapping[str, Component]
) -> Sequence[_Panel]:
    panels = []
    for name, channel in CHANNELS.items():
        if name in measured:
            lines = {
                form: channel.shown(series[name])
                for form, series in simulated.items()
                if name not in GIVEN.get(form, set())
            }
            for component, of in _ALONE.items():
                if of == name and component in alone:
                    lines["components"] = alone[component].modelled
            panels.append(
                _Panel(channel.label, channel.unit.replace("degC", "°C"), channel.shown(measured[name]), lines)
            )
    for name in ("inverter_power", "road_load"):
        if name in alone:
            c = alone[name]
            hide = np.where(c.valid, 1.0, np.nan)
            panels.append(
                _Panel(c.quantity.label, c.quantity.unit, c.measured * hide, {"components": c.modelled * hide})
            )
    return panels


def _draw_panel(left: Axes, right: Axes, panel: _Panel, unit: float) -> None:
    """Values on the left, errors on the right, over time in `unit` [s]."""
    time = np.arange(len(panel.measured)) / unit
    left.plot(time, panel.measured, color=INK, linewidth=1.1, label="measured")
    left.set_ylabel(f"{panel.label}\n[{panel.unit}]", fontsize=8, color=INK)
    right.axhline(0, color=MUTED, linewidth=0.8)
    for form, values in panel.modelled.items():
        n = min(len(panel.measured), len(values))
        colour = _COLOURS[form]
        left.plot(time[:n], values[:n], color=colour, linewidth=0.9, alpha=0.85, label=NAMES[form])
        error = values[:n] - panel.measured[:n]
        right.plot(time[:n], error, color=colour, linewidth=0.35 if n > 60 else 1.0, alpha=0.45)
        wide = min(_MEAN, max(n // 4, 1))
        known = np.isfinite(error)
        weight = np.convolve(known, np.ones(wide), "same")
        mean = np.convolve(np.where(known, error, 0.0), np.ones(wide), "same") / np.maximum(weight, 1)
        mean = np.where(weight > wide / 4, mean, np.nan)
        right.plot(time[:n], mean, color=colour, linewidth=1.5, label=NAMES[form])


def _legend(figure: Figure) -> None:
    named = {label: line for axis in figure.axes for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    order = [label for label in ("measured", *NAMES.values()) if label in named]
    figure.legend(
        handles=[named[label] for label in order],
        labels=order,
        loc="upper right",
        ncols=4,
        frameon=False,
        fontsize=9,
        bbox_to_anchor=(0.99, 1.0),
    )
