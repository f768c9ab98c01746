"""Road load of a coasting vehicle by the effects of its own model, and its speed rolling to rest against it.

    (m + J/r²)·dV/dt = -m·g·(c0·cos θ + c1·V + sin θ) - ½·ρ·CdA·(V + w)·|V + w| - P_motor(V/r)/V

w: headwind. The motor turns with the wheel: what it takes without current is taken off by the vehicle's own motor
model. Air density is that of the measured temperature and altitude.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from gz_onboard.arrays import Array
from gz_onboard.calibration.coastdown_run import Coast
from gz_onboard.model.effect import ROAD_LOAD, Port
from gz_onboard.model.effects.inertia import rotating_mass
from gz_onboard.model.model import Bound, air_density
from gz_onboard.model.series import all_quantities, total
from gz_onboard.recording.sensors import road_speed
from gz_onboard.vehicle import Vehicle

STRONGEST = 8.0  # m/s: a wind in which nobody coasts down
NAMES = ("rolling_resistance_constant", "rolling_resistance_speed", "drag_area")


class RoadLoad:
    """What holds a coasting vehicle back, by the effects of its own model."""

    def __init__(self, vehicle: Vehicle, values: Mapping[str, float] | None = None) -> None:
        p = dict(vehicle.parameters) | dict(values or {})
        self.p = p
        effects = [Bound(effect, p) for effect in vehicle.model.effects]
        self._road = [e for e in effects if e.effect.port in ROAD_LOAD and "acceleration" not in e.effect.reads]
        self._motor = [e for e in effects if e.effect.port is Port.MOTOR_LOSS]
        self._vibration = vehicle.riding.vibration  # a coast-down shows no road that is rougher than others
        self.rotating = rotating_mass(p)

    def __call__(self, speed: Any, run: Coast, slope: float, wind: float, density: float = 1.0) -> Any:
        """Force [N] at `speed` [m/s] (above zero). slope: sine, uphill in direction +1. wind [m/s]: against it.

        density: factor on the air's density.
        """
        grade = run.direction * slope
        q = all_quantities(  # straight on, no current
            speed=speed,
            grade=grade,
            mass=run.mass + self.p.get("_mass", 0.0),
            air_density=density * air_density(run.temperature, run.altitude),
            headwind=wind,
            motor_speed=speed / road_speed(1.0, self.p),
            motor_temperature=run.temperature,
            ambient_temperature=run.temperature,
            vibration=self._vibration,
        )
        return total(self._road, q) + total(self._motor, q) / speed

    def slowing(self, speed: Any, run: Coast, slope: float, wind: float, density: float = 1.0) -> Any:
        """Deceleration [m/s²]."""
        return self(speed, run, slope, wind, density) / (run.mass + self.p.get("_mass", 0.0) + self.rotating)


def roll(force: RoadLoad, run: Coast, slope: float, wind: float, time: Array) -> Array:
    """Speed [m/s] at `time` [s] from the run's first speed on: Runge-Kutta of fourth order; zero after standstill."""
    speed = np.empty(len(time))
    v = float(run.speed[0])
    speed[0] = v
    for i, dt in enumerate(np.diff(time).tolist()):
        if v > 0.05:
            k1 = force.slowing(v, run, slope, wind)
            k2 = force.slowing(max(v - dt / 2 * k1, 1e-3), run, slope, wind)
            k3 = force.slowing(max(v - dt / 2 * k2, 1e-3), run, slope, wind)
            k4 = force.slowing(max(v - dt * k3, 1e-3), run, slope, wind)
            v = max(v - dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4), 0.0)
        speed[i + 1] = v
    return speed


def own_wind(force: RoadLoad, run: Coast, slope: float) -> float:
    """The constant headwind [m/s] with which `run` is followed best."""
    best = minimize_scalar(
        lambda wind: float(np.sum((roll(force, run, slope, wind, run.time) - run.speed) ** 2)),
        bounds=(-STRONGEST, STRONGEST),
        method="bounded",
        options={"xatol": 0.01},
    )
    return float(best.x)
