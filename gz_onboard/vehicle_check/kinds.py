"""Kinds of vehicles: what to guess of one that is not measured."""

from __future__ import annotations

from dataclasses import dataclass

from gz_onboard.model.riding import ANYWHERE, PriorRiding

Guess = tuple[float, float]
"""A value and its standard deviation."""


@dataclass(frozen=True)
class Kind:
    """What vehicles of a kind have in common."""

    about: str
    payload: Guess  # kg
    drag_area: Guess  # m²
    rolling: Guess  # rolling resistance over load
    range_dbc: str  # of the range frames: their scale
    power: float  # W, peak at the motor's shaft
    top_speed: float  # km/h
    pull: float  # m/s², as it pulls off with its rider
    drift: float  # between rides, relative: that of the reference scooter in its town, or of a car


TOWN = PriorRiding().drift
SMALL, LARGE = "range.dbc", "range_large.dbc"
KINDS = {
    "kick-scooter": Kind("stood on", (75.0, 12.0), (0.55, 0.08), (0.015, 0.004), SMALL, 800.0, 25.0, 1.5, TOWN),
    "scooter": Kind("to 45 km/h or so", (80.0, 12.0), (0.52, 0.08), (0.012, 0.003), SMALL, 4000.0, 48.0, 2.5, TOWN),
    "motorcycle": Kind(
        "faster than a scooter", (85.0, 15.0), (0.5, 0.1), (0.014, 0.003), LARGE, 20e3, 120.0, 4.0, ANYWHERE
    ),
    "car": Kind("to 2.5 t", (90.0, 30.0), (0.65, 0.08), (0.01, 0.002), LARGE, 100e3, 150.0, 3.5, ANYWHERE),
    "van": Kind("to 3.5 t", (300.0, 300.0), (1.7, 0.3), (0.01, 0.002), LARGE, 100e3, 120.0, 2.5, ANYWHERE),
}
