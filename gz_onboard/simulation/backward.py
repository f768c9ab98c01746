"""The energy-only form: speed in, power out, for a whole ride at once.

`physics.Model.power` with arrays in place of floats: no tyre slip, no rider, no limits of motor or pack, so it takes
any speed as ridden. What a forward simulation finds beyond it is what those parts take.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from gz_onboard.physics.effect import MOVING, QUANTITIES
from gz_onboard.physics.model import air_density, over
from gz_onboard.vehicle import Vehicle

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from gz_onboard.arrays import Array


SMOOTHING = 0.5  # s: a wheel speed sensor's steps of 0.1 r/min at 100 Hz are 0.25 m/s² of acceleration

BLOCK = 8192  # steps at once: what stays in the processor's cache takes half the time


@dataclass(frozen=True)
class Energy:
    """A ride's power at the pack's terminals and what it is made of."""

    power: Array  # W, of the length of the ride
    ledger: dict[str, float]  # J, by the names of `Model.power`
    total: float  # J
    distance: float  # m

    @property
    def consumption(self) -> float | None:
        """Energy for the distance [J/m]; None below 100 m."""
        return self.total / self.distance if self.distance >= 100 else None


def backward(
    vehicle: Vehicle,
    time: ArrayLike,
    speed: ArrayLike,
    *,
    grade: ArrayLike = 0.0,
    curvature: ArrayLike = 0.0,
    heading: ArrayLike | None = None,
    headwind: ArrayLike = 0.0,
    ambient: float = 20.0,
    altitude: float = 0.0,
    motor_temperature: ArrayLike | None = None,
    vibration: ArrayLike | None = None,
    smoothing: float = SMOOTHING,
) -> Energy:
    """The energy of riding `speed` [m/s] over `time` [s], both of shape (n,); n of 2 or more.

    grade (sine of the road's angle), curvature [1/m], headwind [m/s], heading [rad clockwise from north; if not given,
    as the curvature turns it from north], motor_temperature [degC, ambient if not given], vibration [m/s², while moving
    what the vehicle's file expects if not given]: scalars or shape (n,).
    smoothing: the acceleration is the mean one over so many seconds; 0 for a drive cycle.
    Raises ValueError for shapes that do not fit and time that does not increase.
    """
    import numpy as np

    t, v = np.asarray(time, dtype=float), np.asarray(speed, dtype=float)
    if t.ndim != 1 or t.shape != v.shape or len(t) < 2:
        raise ValueError(f"time and speed must be of one shape (n,), n of 2 or more; are {t.shape} and {v.shape}")
    dt = np.diff(t)
    if not dt.min() > 0:
        raise ValueError(f"time must increase; does not after {t[int(np.argmin(dt))]:g} s")
    acceleration = _acceleration(t, v, smoothing)
    # Power over an interval counts at its middle: there speed times acceleration is the change of kinetic energy.
    middle = (v[1:] + v[:-1]) / 2
    sine = _middle(grade)
    q: dict[str, Any] = dict.fromkeys(QUANTITIES, 0.0)
    q |= {
        "speed": middle,
        "acceleration": acceleration,
        "grade": sine,
        "grade_cosine": np.sqrt(1 - sine * sine) if np.any(sine) else 1.0,
        "mass": vehicle.model.mass,
        "air_density": air_density(ambient, altitude),
        "headwind": _middle(headwind),
        "lateral_acceleration": middle * middle * _middle(curvature) if np.any(curvature) else 0.0,
        "ambient_temperature": ambient,
        "motor_temperature": ambient if motor_temperature is None else _middle(motor_temperature),
    }
    if "heading" in vehicle.model.reads:
        turn = -np.cumsum(middle * _middle(curvature) * dt)
        q["heading"] = turn if heading is None else _middle(heading)
    if "vibration" in vehicle.model.reads:
        rough = vehicle.riding.vibration
        q["vibration"] = np.where(middle > MOVING, rough, 0.0) if vibration is None else _middle(vibration)
    if "time_moving" in vehicle.model.reads:
        q["time_moving"] = np.cumsum(np.where(middle > MOVING, dt, 0.0))
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


def _middle(values: ArrayLike) -> Any:
    """A quantity at the middle of each interval; a scalar as it is."""
    import numpy as np

    array = np.asarray(values, dtype=float)
    return (array[1:] + array[:-1]) / 2 if array.ndim else float(array)


def _acceleration(t: Array, v: Array, smoothing: float) -> Array:
    """In each interval [m/s²]: the slope of the speed over `smoothing` [s] around it, or over the interval alone."""
    import numpy as np

    half = round(smoothing / 2 / float(np.median(np.diff(t))))
    if half < 1:
        return np.diff(v) / np.diff(t)
    before = np.maximum(np.arange(len(t) - 1) - half, 0)
    after = np.minimum(np.arange(1, len(t)) + half, len(t) - 1)
    slope: Array = (v[after] - v[before]) / (t[after] - t[before])
    return slope
