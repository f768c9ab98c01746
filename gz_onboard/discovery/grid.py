"""One ride on an even time grid: the signals and quantities that residuals are formed from.

Signals arrive at different rates; each is averaged over every tenth of a second. Where a signal was missing for longer
than three of its periods, the grid marks it as not measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from gz_onboard.arrays import Array, Mask, block_means, running_mean
from gz_onboard.constants import GRAVITY, MILD
from gz_onboard.errors import InputError
from gz_onboard.events import LOADS
from gz_onboard.model.effect import MOVING, Port
from gz_onboard.model.model import air_density
from gz_onboard.model.sensors import VIBRATION_MEMORY_S, VIBRATION_PERIOD_S, grade_shown, true_current, true_voltage
from gz_onboard.model.series import relaxation, total
from gz_onboard.priors import sizes_of
from gz_onboard.recording.recording import Recording
from gz_onboard.recording.sensors import road_speed, speed_role
from gz_onboard.vehicle import Vehicle

STEP = 0.1  # s
COARSE = 5  # grid steps to one of the model of the cells: 0.5 s


@dataclass(frozen=True)
class GridConfig:
    """Limits of the sensors."""

    least_gap: float = 0.3  # s; a signal is missing after this and after three of its periods
    shortest: float = 60.0  # s of a ride
    least_samples: int = 20  # of a role
    standstill: float = 0.05  # m/s
    crawl: float = 1.0  # m/s: below, a steering angle or a motor torque is noise
    brake_pressure: float = 0.8e5  # Pa: above the noise at rest
    regenerating: float = -1.0  # A of a motor of size 1: the brake is in use
    braked: float = -0.6  # m/s²: stronger deceleration than road load explains
    braking_margin: float = 0.5  # s to either side of braking
    acceleration_mean: float = 0.4  # s: running means that reduce noise
    yaw_mean: float = 0.5  # s
    grade_mean: float = 2.0  # s
    climb: float = 60.0  # m of way over which GPS altitude is averaged
    steepest: float = 0.5  # sine of a slope: beyond, the sensor errs
    steepest_lean: float = 0.85  # sine of the lean
    most_steering: float = 0.6  # rad
    rough_period: float = 0.034  # s: samples further apart do not show how rough a road is
    longest_memory: float = 60.0  # s since an event: longer ago is as good as never


GRID = GridConfig()
PACK = ("pack_voltage", "pack_current")
MEASURED_BY: Mapping[str, tuple[str, ...]] = {
    "grade": ("accel_x", "gps_altitude"),
    "heading": ("gps_course",),
    "lateral_acceleration": ("rate_z",),
    "steering": ("rate_z",),
    "motor_current": ("motor_current",),
    "current_change": ("motor_current",),
    "motor_temperature": ("motor_temperature",),
    "ambient_temperature": ("ambient_temperature",),
    "cell_temperature": ("cell_temperature",),
}
"""Quantities that every ride has a value for, and the roles of which one at least is needed to measure them."""
USUAL_DELAYS = {"gps_speed": 0.4, "gps_course": 0.4, "gps_altitude": 0.4, "pack_voltage": 0.1, "pack_current": 0.1}
"""Usual age [s] of a value against the inverter's, where its message states no `delay`; the rest of it is fitted."""


@dataclass
class Ride:
    """A ride on the grid; arrays have the shape (n,).

    time: s from the start. signals: by role. valid: by role, where it was measured. radius: m of wheel travel per
    radian of the motor, by the vehicle file. payload: kg as entered. quantities: what effects read and residuals are
    looked at over, with the vehicle's nominal mass and radius. energy: J drawn from the pack, corrected for known
    sensor errors. periods: s between samples, by role. stand_ins: sentences on signals that replace missing ones.
    start_soc: state of charge that the first voltages point to, by the vehicle file; NaN without them.
    current_size: of the vehicle's currents (`Sizes`).
    """

    name: str
    time: Array
    signals: dict[str, Array]
    valid: dict[str, Mask]
    radius: float
    payload: float | None
    quantities: dict[str, Array] = field(default_factory=dict)
    energy: float = 0.0
    periods: dict[str, float] = field(default_factory=dict)
    stand_ins: tuple[str, ...] = ()
    start_soc: float = float("nan")
    current_size: float = 1.0

    @property
    def have(self) -> set[str]:
        """The roles that were measured."""
        return set(self.signals)

    @cached_property
    def coarse(self) -> dict[str, Array]:
        """Signals and quantities averaged over steps of 0.5 s."""
        return {name: block_means(values, COARSE) for name, values in (self.signals | self.quantities).items()}

    def shows(self, quantity: str) -> bool:
        """Whether the ride measured `quantity`."""
        return any(role in self.signals for role in MEASURED_BY.get(quantity, self.signals))

    def mask(self, *roles: str) -> Mask:
        """Where all of `roles` were measured, shape (n,)."""
        return np.asarray(np.all([self.valid[role] for role in roles], axis=0))

    @property
    def loads(self) -> Array | float:
        """Measured power of heater and air conditioner [W], shape (n,) or 0."""
        return sum((self.signals[role] for role in LOADS if role in self.signals), 0.0)

    @property
    def standing(self) -> Mask:
        """Where the vehicle stands, shape (n,)."""
        return np.asarray(np.abs(self.quantities["speed"]) < GRID.standstill)

    @property
    def distance(self) -> float:
        """Distance ridden [m]."""
        return float(np.sum(np.abs(self.quantities["speed"])) * STEP)

    @property
    def braking(self) -> Mask:
        """Where a brake is in use, or was within half a second, shape (n,)."""
        limits = {
            "brake_switch": 0.01,
            "brake_pressure_front": GRID.brake_pressure,
            "brake_pressure_rear": GRID.brake_pressure,
        }
        result = np.zeros(len(self.time), dtype=bool)
        for role in limits.keys() & self.have:
            result |= self.signals[role] > limits[role]
        if not {"brake_switch", "brake_pressure_rear"} & self.have:  # only the deceleration shows it
            if "motor_current" in self.signals:
                result |= self.signals["motor_current"] < GRID.regenerating * self.current_size
            else:
                result |= self.quantities["acceleration"] + GRAVITY * self.quantities["grade"] < GRID.braked
        width = 2 * round(GRID.braking_margin / STEP) + 1
        return np.asarray(np.convolve(result, np.ones(width), mode="same") > 0)


def delays(vehicle: Vehicle) -> dict[str, float]:
    """Age of a value when it arrives [s], by role: as its message states, else as usual."""
    stated = vehicle.mapping
    return USUAL_DELAYS | {s.role: stated.delays[s.message] for s in stated.sources if s.message in stated.delays}


def averaged(times: Array, values: Array, grid: Array, width: float = STEP) -> Array:
    """The mean of the line through (times, values) over `width` [s] around each of `grid`, shape of `grid`."""
    whole = np.concatenate([[0.0], np.cumsum(np.diff(times) * (values[1:] + values[:-1]) / 2)])

    def integral(t: Array) -> Array:
        inside = np.clip(t, times[0], times[-1])
        i = np.clip(np.searchsorted(times, inside, side="right") - 1, 0, len(times) - 2)
        dt = inside - times[i]
        slope = (values[i + 1] - values[i]) / np.maximum(times[i + 1] - times[i], 1e-9)
        within = whole[i] + dt * (values[i] + slope * dt / 2)
        # beyond its ends a signal keeps its last value
        result: Array = within + np.where(t < times[0], (t - times[0]) * values[0], 0.0)
        return result + np.where(t > times[-1], (t - times[-1]) * values[-1], 0.0)

    return (integral(grid + width / 2) - integral(grid - width / 2)) / width


def measured(times: Array, grid: Array) -> Mask:
    """Where `grid` lies within three periods (and 0.3 s) of a sample on both sides, shape of `grid`."""
    limit = max(GRID.least_gap, 3 * float(np.median(np.diff(times))))
    i = np.clip(np.searchsorted(times, grid), 1, len(times) - 1)
    gap = times[i] - times[i - 1]
    return np.asarray((gap < limit) & (grid > times[0] - limit) & (grid < times[-1] + limit))


def with_stand_ins(samples: Recording, vehicle: Vehicle) -> tuple[Recording, tuple[str, ...]]:
    """(`samples` with replacements for a missing motor speed or current, a sentence on each).

    The replacement is in no residual by itself. Raises InputError for a ride without any speed, or without any measure
    of what drives the vehicle.
    """
    p, columns, words = vehicle.parameters, dict(samples.columns), []
    if "motor_speed" not in columns:
        role, factor = speed_role(f"ride {samples.name}", columns, p)
        times, values = columns.pop(role)
        factor /= road_speed(1.0, p)
        columns["motor_speed"] = times - delays(vehicle).get(role, 0.0), values * factor
        words.append(f"motor_speed is missing: {role} is used, by wheel radius and gear ratio of the vehicle file")
    if "motor_current" not in columns and "motor_torque" in columns:
        times, values = columns["motor_torque"]
        columns["motor_current"] = times, values / p["torque_constant"]
        words.append("motor_current is missing: motor_torque is used, by the torque constant of the vehicle file")
    if "motor_current" not in columns and not set(PACK) <= columns.keys():
        raise InputError(
            f"ride {samples.name}: has no motor_current, no motor_torque and not both of {' and '.join(PACK)}: the "
            "drive power is not known, and nothing can be compared"
        )
    return replace(samples, columns=columns), tuple(words)


def read_ride(samples: Recording, vehicle: Vehicle) -> Ride:
    """Put a ride of `vehicle` on the grid.

    Raises InputError for a ride without any speed, without motor current, torque, or voltage and current of the pack,
    or shorter than a minute.
    """
    seen = {role: column for role, column in samples.columns.items() if len(column[0]) >= GRID.least_samples}
    samples, words = with_stand_ins(replace(samples, columns=seen), vehicle)
    columns = samples.columns
    needed = ("motor_speed", *(("motor_current",) if "motor_current" in columns else PACK))
    start = max(columns[role][0][0] for role in needed)
    end = min(columns[role][0][-1] for role in needed)
    if end - start < GRID.shortest:
        raise InputError(
            f"ride {samples.name}: {end - start:.0f} s of {', '.join(needed)} together; a minute is the least"
        )
    grid = np.arange(start, end, STEP)
    late = delays(vehicle)
    signals: dict[str, Array] = {}
    valid: dict[str, Mask] = {}
    for role, (times, values) in columns.items():
        at = grid + late.get(role, 0.0)
        signals[role] = averaged(times, np.unwrap(values) if role == "gps_course" else values, at)
        valid[role] = measured(times, at)
    p, periods = vehicle.parameters, {role: float(np.median(np.diff(times))) for role, (times, _) in columns.items()}
    ride = Ride(samples.name, grid - start, signals, valid, road_speed(1.0, p), samples.rider_mass, periods=periods)
    ride.stand_ins, ride.current_size = words, sizes_of(vehicle).current
    ride.quantities = _quantities(ride, p)
    if "motor_current" not in signals:
        ride.quantities |= driven_by_pack(ride, vehicle)
    ride.energy = energy_drawn(ride, p)
    if "pack_current" in signals:
        ride.quantities["pack_current"] = true_current(signals["pack_current"], p)
    ride.quantities["since_braking"] = since(ride.braking)
    if periods.get("accel_z", np.inf) < GRID.rough_period:
        ride.quantities["vibration"] = vibration(*columns["accel_z"], grid)
    return ride


def driven_by_pack(ride: Ride, vehicle: Vehicle) -> dict[str, Array]:
    """Motor current [A] and torque [N·m] that the pack power implies by the vehicle file, (n,), 0 at standstill.

    Also ``current_per_watt`` [A/W], the loss of motor current for each watt that another load takes.
    """
    p, model, q, s = vehicle.parameters, vehicle.model, ride.quantities, ride.signals
    power = true_voltage(s["pack_voltage"], p) * true_current(s["pack_current"], p) - ride.loads
    power = power - total(model.at(Port.DC_POWER), q)
    constant, spin = p["torque_constant"], np.maximum(np.abs(q["motor_speed"]), GRID.crawl / ride.radius)

    def drive(current: Array) -> Array:
        now = {**q, "motor_current": current, "torque": constant * current}
        return np.asarray(now["torque"] * q["motor_speed"] + total(model.at(Port.MOTOR_LOSS, Port.INVERTER_LOSS), now))

    low, high = np.zeros_like(power), np.full_like(power, 2 * p["motor_current_limit"])
    for _ in range(20):  # halvings: to a millionth of the limit
        middle = (low + high) / 2
        over = drive(middle) > power
        low, high = np.where(over, low, middle), np.where(over, middle, high)
    # while recovering, losses are small against the shaft power
    recovered = np.minimum((power - drive(np.zeros_like(power))) / (constant * spin), 0.0)
    current = np.where(ride.standing, 0.0, np.where(recovered < 0, recovered, (low + high) / 2))
    steep = np.maximum(drive(current + 1.0) - drive(current), constant * spin)  # W/A
    return {
        "motor_current": current,
        "torque": constant * current,
        "current_per_watt": np.where(ride.standing, 0.0, 1 / steep),
    }


def grade_by_altitude(altitude: Array, speed: Array) -> Array:
    """Sine of the slope (n,) from `altitude` (n,) [m] at `speed` (n,) [m/s], averaged over 60 m of way."""
    way, apart = np.cumsum(np.abs(speed)) * STEP, 5.0  # m from one point to the next
    if way[-1] < GRID.climb:
        return np.zeros_like(way)
    points = np.arange(way[0], way[-1], apart)
    first = np.flatnonzero(np.diff(way, prepend=-1.0) > 0)  # at standstill many samples share one place
    height = running_mean(np.interp(points, way[first], altitude[first]), round(GRID.climb / apart / 2) * 2 + 1)
    return np.clip(np.interp(way, points, np.gradient(height, apart)), -GRID.steepest, GRID.steepest)


def energy_drawn(ride: Ride, p: Mapping[str, float]) -> float:
    """Energy drawn over the ride [J]: from the pack, else into the inverter, else the work of the motor."""
    s, q = ride.signals, ride.quantities
    if ride.have >= set(PACK):
        power = true_voltage(s["pack_voltage"], p) * true_current(s["pack_current"], p)
    elif {"inverter_voltage", "inverter_current"} <= ride.have:
        power = s["inverter_voltage"] * s["inverter_current"]
    else:
        power = np.abs(q["torque"] * q["motor_speed"])
    return float(np.sum(power)) * STEP


def since(happens: Mask) -> Array:
    """Time [s] since `happens` (n,) was last True, a minute at most, (n,)."""
    steps = np.arange(len(happens))
    last = np.maximum.accumulate(np.where(happens, steps, -round(GRID.longest_memory / STEP)))
    return np.asarray(np.minimum((steps - last) * STEP, GRID.longest_memory))


def vibration(times: Array, values: Array, grid: Array) -> Array:
    """Roughness of the road [m/s²] at `grid`, from vertical acceleration `values` at `times`; see `model.sensors`."""
    steps = np.diff(times)
    mean = relaxation(values[1:], np.exp(-steps / VIBRATION_PERIOD_S), float(values[0]))
    square = relaxation((values[1:] - mean) ** 2, np.exp(-steps / VIBRATION_MEMORY_S))
    return np.asarray(np.interp(grid, times[1:], np.sqrt(square)))


def smooth(values: Array, seconds: float) -> Array:
    """The running mean over about `seconds`, shape kept."""
    return running_mean(values, round(seconds / STEP / 2) * 2 + 1)


def steering(speed: Array, lateral_acceleration: Array, wheelbase: float) -> Array:
    """Steering angle [rad] of a bicycle without slip: wheelbase over the radius of the bend."""
    fast = np.maximum(np.abs(speed), GRID.crawl)
    return np.asarray(np.clip(wheelbase * lateral_acceleration / fast**2, -GRID.most_steering, GRID.most_steering))


def _quantities(ride: Ride, p: Mapping[str, float]) -> dict[str, Array]:
    s = ride.signals
    n = len(ride.time)
    motor_speed, motor_current = s["motor_speed"], s.get("motor_current", np.zeros(n))
    speed = motor_speed * ride.radius
    acceleration: Array = np.gradient(smooth(speed, GRID.acceleration_mean), STEP)
    ambient = s.get("ambient_temperature", np.full(n, MILD))
    yaw = np.zeros(n)
    if "rate_z" in s:
        still = np.abs(speed) < GRID.standstill
        bias = float(np.median(s["rate_z"][still] if still.sum() > 30 else s["rate_z"]))
        yaw = smooth(s["rate_z"] - bias, GRID.yaw_mean)
    # the body leans: its yaw rate is r·cos φ, and tan φ = v·r/g, so sin φ = v·rate/g
    sine = np.clip(speed * yaw / GRAVITY, -GRID.steepest_lean, GRID.steepest_lean)
    lateral = GRAVITY * sine / np.sqrt(1 - sine**2)
    grade = np.zeros(n)
    if "accel_x" in s:
        grade = smooth(grade_shown(s["accel_x"], acceleration), GRID.grade_mean)
    elif "gps_altitude" in s:
        grade = grade_by_altitude(s["gps_altitude"], speed)
    altitude = float(np.median(s["gps_altitude"])) if "gps_altitude" in s else 0.0
    payload = p["payload_mass"] if ride.payload is None else ride.payload
    return {
        "speed": speed,
        "acceleration": acceleration,
        "grade": grade,
        "grade_cosine": np.asarray(np.sqrt(1 - np.clip(grade, -GRID.steepest, GRID.steepest) ** 2)),
        "mass": np.full(n, p["vehicle_mass"] + payload),
        "air_density": np.full(n, air_density(float(np.median(ambient)), altitude)),
        "headwind": np.zeros(n),
        "lateral_acceleration": lateral,
        "steering": steering(speed, lateral, p["wheelbase"]),
        "motor_speed": motor_speed,
        "motor_current": motor_current,
        "motor_temperature": s.get("motor_temperature", ambient),
        "ambient_temperature": ambient,
        "cell_temperature": s.get("cell_temperature", ambient),
        "heading": np.asarray(np.mod(s.get("gps_course", np.zeros(n)), 2 * np.pi), dtype=np.float64),
        "time": ride.time,
        "time_moving": np.asarray(np.cumsum(np.abs(speed) > MOVING) * STEP, dtype=np.float64),
        "torque": p["torque_constant"] * motor_current,
    }
