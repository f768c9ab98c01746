"""Picture of a validated ride: each channel measured and simulated, and the errors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.reports.style import BLUE, GREEN, INK, ORANGE, ChartPanel, Line, chart, save, time_unit
from gz_onboard.validation.comparison import CHANNELS, FORMS, Comparison, ValidatedRide

COLOURS = {"open_loop": ORANGE, "predictive": BLUE, "components": GREEN}
AVERAGED_S = 30
"""Averages gears and gusts out of an error."""
_DPI = 90  # of a wide picture


def draw_ride(file: Path, ride: ValidatedRide, comparisons: Mapping[str, Mapping[str, Comparison]]) -> None:
    """Draw each quantity measured and simulated on the left, the errors on the right. Raises OSError."""
    found: dict[str, dict[str, Comparison]] = {channel.label: {} for channel in CHANNELS.values()}
    for form, by_name in comparisons.items():
        for name, comparison in by_name.items():
            if name != "pack_power":
                found.setdefault(comparison.quantity.label, {})[form] = comparison
    unit, x_name = time_unit(ride.duration_s)
    rows = [_row(forms, unit) for forms in found.values() if forms]
    x = np.array([0.0, ride.duration_s / unit])
    air = "" if ride.ambient_c is None else f", air {ride.ambient_c:.0f} °C"
    title = f"{ride.name} · {ride.vehicle}, {ride.payload_kg:g} kg{air}, {ride.distance_km:.1f} km"
    about = f"left: measured and simulated; right: simulated less measured, each second and the mean of {AVERAGED_S} s"
    save(chart(rows, x, x_name, title, about, left=0.055), file, _DPI)


def _row(forms: Mapping[str, Comparison], unit: float) -> tuple[ChartPanel, ChartPanel]:
    """Values and errors of one quantity, over time in `unit` [s]."""
    values: list[Line] = []
    errors: list[Line] = []
    for form, comparison in forms.items():
        time, colour, name = np.arange(len(comparison.valid)) / unit, COLOURS[form], FORMS[form]
        measured, modelled, error = (
            np.where(comparison.valid, y, np.nan) for y in (comparison.measured, comparison.modelled, comparison.error)
        )
        values += [] if values else [Line(measured, INK, "measured", x=time)]
        values.append(Line(modelled, colour, name, 0.9, x=time))
        errors.append(Line(error, colour, f"_{name}", 0.2, x=time))
        errors.append(Line(_mean(comparison), colour, name, 1.5, x=time))
    quantity = next(iter(forms.values())).quantity
    name = f"{quantity.label}\n[{quantity.unit.replace('degC', '°C')}]"
    return ChartPanel(name, values, 1.25), ChartPanel("", errors, 1.25, zero=True)


def _mean(comparison: Comparison) -> Array:
    """The error, averaged over `AVERAGED_S` where most of it is known."""
    n = len(comparison.valid)
    wide = np.ones(min(AVERAGED_S, max(n // 4, 1)))
    count = np.convolve(comparison.valid, wide, "same")
    total = np.convolve(np.where(comparison.valid, comparison.error, 0.0), wide, "same")
    return np.where(count > len(wide) / 4, total / np.maximum(count, 1), np.nan)
