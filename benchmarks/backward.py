"""The energy-only form: speed in, power out, for a whole ride at once.

`physics.Model.power` with arrays in place of floats: no tyre slip, no rider, no limits of motor or pack, so it takes
any speed as ridden. A forward simulation adds the energy of those parts.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.constants import MILD
from gz_onboard.model.effect import MOVING
from gz_onboard.model.model import air_density
from gz_onboard.model.series import all_quantities, over
from gz_onboard.vehicle import Vehicle

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


SMOOTHING = 0.5  # s: a wheel speed sensor's steps of 0.1 r/min at 100 Hz are 0.25 m/s² of acceleration

BLOCK = 8192  # steps at once: what stays in the processor's cache takes half the time


@dataclass(frozen=True)
class Energy:
    """A ride's power at the pack's terminals, by effect."""

    power: Array  # W, of the length of the ride
    ledger: dict[str, float]  # J, by the names of `Model.power`
    total: float  # J
    distance: float  # m

    @property
    def consumption(self) -> float | None:
        """Energy for the distance [J/m]; None below 100 m."""
        return self.total / self.distance if self.distance >= 100 else None


@dataclass(frozen=True)
class RideConditions:
    """Where and in what a speed is ridden; quantities of the ride are scalars or of shape (n,)."""

    grade: ArrayLike = 0.0  # sine of the road's angle
    curvature: ArrayLike = 0.0  # 1/m, positive to the left
    heading: ArrayLike | None = None  # rad clockwise from north; None: as the curvature turns it from north
    headwind: ArrayLike = 0.0  # m/s
    ambient: float = MILD  # degC
    altitude: float = 0.0  # m
    motor_temperature: ArrayLike | None = None  # degC; None: ambient
    vibration: ArrayLike | None = None  # m/s²; None: while moving what the vehicle's file expects


def backward(
    vehicle: Vehicle,
    time: ArrayLike,
    speed: ArrayLike,
    conditions: RideConditions = RideConditions(),
    *,
    smoothing: float = SMOOTHING,
) -> Energy:
    """The energy of riding `speed` [m/s] over `time` [s], both of shape (n,); n of 2 or more.

    smoothing: the acceleration is the mean one over so many seconds; 0 for a drive cycle.
    Raises ValueError for shapes that do not fit and time that does not increase.
    """
    t, v = np.asarray(time, dtype=float), np.asarray(speed, dtype=float)
    if t.ndim != 1 or t.shape != v.shape or len(t) < 2:
        raise ValueError(f"time and speed must be of one shape (n,), n of 2 or more; are {t.shape} and {v.shape}")
    dt = np.diff(t)
    if not dt.min() > 0:
        raise ValueError(f"time must increase; does not after {t[int(np.argmin(dt))]:g} s")
    acceleration = _acceleration(t, v, smoothing)
    # Power over an interval counts at its middle: there speed times acceleration is the change of kinetic energy.
    middle = (v[1:] + v[:-1]) / 2
    q = _quantities(vehicle, middle, acceleration, dt, conditions)
    power, ledger = np.zeros_like(middle), defaultdict[str, float](float)
    block = len(dt) if any(effect.decay for effect in vehicle.model.effects) else BLOCK
    for first in range(0, len(dt), block):
        part = slice(first, first + block)
        some = {name: value[part] if isinstance(value, np.ndarray) else value for name, value in q.items()}
        for name, term in vehicle.model.power(some, over(dt[part])).items():
            power[part] += term
            ledger[name] += float(np.sum(term * dt[part]))
    # sums, not products of vectors: threads of the linear algebra would take longer to start than to add
    return Energy(np.append(power, power[-1]), dict(ledger), float(np.sum(power * dt)), float(np.sum(middle * dt)))


def _quantities(
    vehicle: Vehicle, middle: Array, acceleration: Array, dt: Array, conditions: RideConditions
) -> dict[str, Any]:
    """What effects read, at the middle of each interval of `dt` [s]."""
    c = conditions
    q = all_quantities(
        speed=middle,
        acceleration=acceleration,
        grade=_middle(c.grade),
        mass=vehicle.model.mass,
        air_density=air_density(c.ambient, c.altitude),
        headwind=_middle(c.headwind),
        lateral_acceleration=middle * middle * _middle(c.curvature) if np.any(c.curvature) else 0.0,
        ambient_temperature=c.ambient,
        motor_temperature=c.ambient if c.motor_temperature is None else _middle(c.motor_temperature),
    )
    if "heading" in vehicle.model.reads:
        turn = -np.cumsum(middle * _middle(c.curvature) * dt)
        q["heading"] = turn if c.heading is None else _middle(c.heading)
    if "vibration" in vehicle.model.reads:
        rough = vehicle.riding.vibration
        q["vibration"] = np.where(middle > MOVING, rough, 0.0) if c.vibration is None else _middle(c.vibration)
    if "time_moving" in vehicle.model.reads:
        q["time_moving"] = np.cumsum(np.where(middle > MOVING, dt, 0.0))
    return q


def _middle(values: ArrayLike) -> Any:
    """A quantity at the middle of each interval; a scalar as it is."""
    array = np.asarray(values, dtype=float)
    return (array[1:] + array[:-1]) / 2 if array.ndim else float(array)


def _acceleration(t: Array, v: Array, smoothing: float) -> Array:
    """In each interval [m/s²]: the slope of the speed over `smoothing` [s] around it, or over the interval alone."""
    half = round(smoothing / 2 / float(np.median(np.diff(t))))
    if half < 1:
        return np.diff(v) / np.diff(t)
    before = np.maximum(np.arange(len(t) - 1) - half, 0)
    after = np.minimum(np.arange(1, len(t)) + half, len(t) - 1)
    slope: Array = (v[after] - v[before]) / (t[after] - t[before])
    return slope
