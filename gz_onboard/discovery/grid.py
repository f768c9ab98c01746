"""A ride on one grid of time: what the channels of the discovery read.

Signals come at rates of their own; here each is averaged over every tenth of a second. Where a signal was missing for
longer than three of its periods (and 0.3 s), the grid says so: nothing is made up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.constants import GRAVITY, MILD
from gz_onboard.discovery.stand_ins import PACK, delays, stand_ins
from gz_onboard.errors import InputError
from gz_onboard.events import LOADS
from gz_onboard.lab.sizes import sizes_of
from gz_onboard.model.effect import MOVING, Port
from gz_onboard.model.model import air_density
from gz_onboard.model.sensors import grade_shown, true_current, true_voltage
from gz_onboard.offline.arrays import running_mean
from gz_onboard.offline.samples import Samples
from gz_onboard.offline.sensors import Vibration, road_speed
from gz_onboard.offline.series import total
from gz_onboard.vehicle import Vehicle

STEP = 0.1  # s
BRAKE_PRESSURE = 0.8e5  # Pa: above what the sensors show at rest
STANDSTILL, STANDING = 0.05, 30  # m/s, grid steps: below it, for more of them the median of a rate is its bias
LEAST_GAP, GAP = 0.3, 3.0  # s, periods of a signal: it is missing for more than both
SHORTEST, LEAST_SAMPLES = 60.0, 20  # s of a ride; samples of a role
SWITCHED, REGENERATING = 0.01, -1.0  # of the brake switch; A of a motor of size 1: a brake is touched
TOUCHED = 11  # grid steps: half a second to either side
ACCELERATING, YAWING, CLIMBING = 0.4, 0.5, 2.0  # s: running means that take noise off acceleration, yaw rate, grade
STEEPEST_LEAN, STEEPEST = 0.85, 0.5  # sine of the lean, and of the slope: beyond, the sensors err
SUSPENSION = ("suspension_front", "suspension_rear")
CRAWL, MOST_STEERING = 1.0, 0.6  # m/s, rad: of slower riding the angle is noise
ROUGH_PERIOD = 0.034  # s: samples further apart do not show what a road does to a wheel
SHAKING = 2.0  # s, over which the suspension is as fast as the road is rough
JUMP, WITHIN = 10.0, 0.5  # A within s: the motor current has changed
HALVINGS = 20  # of the span of motor currents
BRAKED = -0.6  # m/s²: what slows a vehicle more, its road load apart, may be more than its motor
CLIMB, FEWEST = 60.0, 5.0  # m of way that an altitude's steps average out over; m from one point of it to the next
MADE_OF: Mapping[str, tuple[str, ...]] = {
    "grade": ("accel_x", "gps_altitude"),
    "heading": ("gps_course",),
    "lateral_acceleration": ("rate_z",),
    "steering": ("rate_z",),
    "motor_current": ("motor_current",),
    "current_change": ("motor_current",),
    "since_change": ("motor_current",),
    "motor_temperature": ("motor_temperature",),
    "ambient_temperature": ("ambient_temperature",),
    "cell_temperature": ("cell_temperature",),
}
"""Of what every ride has a quantity of, the roles without any of which it is made up."""
LONGEST = 60.0  # s since a brake was touched, or a current changed: what was longer ago is as good as never


@dataclass
class Ride:
    """A ride on the grid.

    time: shape (n,) [s from the start]. signals: by role, shape (n,); valid: likewise, where it was measured.
    quantities: what effects read (names of `physics.effect.QUANTITIES`) and residuals are looked at over, shape (n,),
    with the vehicle's nominal mass and radius. energy: see `energy_drawn`. have: the roles that are there. periods: of
    their samples [s]. stand_ins: what was taken for a role that is not there, and for another why it is lacking.
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
    current_size: float = 1.0

    @property
    def have(self) -> set[str]:
        """The roles that are there."""
        return set(self.signals)

    def shows(self, quantity: str) -> bool:
        """Whether the ride has `quantity`, and measured it."""
        return any(role in self.signals for role in MADE_OF.get(quantity, self.signals))

    def mask(self, *roles: str) -> Mask:
        """Where all of `roles` were measured, shape (n,)."""
        result = np.ones(len(self.time), dtype=bool)
        for role in roles:
            result &= self.valid[role]
        return result

    @property
    def loads(self) -> Array | float:
        """What heater and air conditioner take [W], where they are measured, shape (n,); else 0."""
        return sum((self.signals[role] for role in LOADS if role in self.signals), 0.0)

    @property
    def standing(self) -> Mask:
        """Where the vehicle does not move, shape (n,)."""
        return np.asarray(np.abs(self.quantities["speed"]) < STANDSTILL)

    @property
    def distance(self) -> float:
        """The distance ridden [m]."""
        return float(np.sum(np.abs(self.quantities["speed"])) * STEP)

    @property
    def braking(self) -> Mask:
        """Where a brake is touched, or was within 0.5 s, shape (n,)."""
        result = np.zeros(len(self.time), dtype=bool)
        if "brake_switch" in self.signals:
            result |= self.signals["brake_switch"] > SWITCHED
        for role in ("brake_pressure_front", "brake_pressure_rear"):
            if role in self.signals:
                result |= self.signals[role] > BRAKE_PRESSURE
        if not {"brake_switch", "brake_pressure_rear"} & self.have:  # only regeneration shows it
            if "motor_current" in self.signals:
                result |= self.signals["motor_current"] < REGENERATING * self.current_size
            else:
                result |= self.quantities["acceleration"] + GRAVITY * self.quantities["grade"] < BRAKED
        wide = np.convolve(result, np.ones(TOUCHED), mode="same") > 0
        return np.asarray(wide, dtype=bool)


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
    limit = max(LEAST_GAP, GAP * float(np.median(np.diff(times))))
    i = np.clip(np.searchsorted(times, grid), 1, len(times) - 1)
    gap = times[i] - times[i - 1]
    return np.asarray((gap < limit) & (grid > times[0] - limit) & (grid < times[-1] + limit))


def read_ride(samples: Samples, vehicle: Vehicle) -> Ride:
    """`samples` on the grid, of `vehicle`.

    Raises InputError for a ride without any speed, without motor current, torque, or voltage and current of the pack,
    or shorter than a minute.
    """
    seen = {role: column for role, column in samples.columns.items() if len(column[0]) >= LEAST_SAMPLES}
    samples, words = stand_ins(replace(samples, columns=seen), vehicle)
    needed = ("motor_speed", *(("motor_current",) if "motor_current" in samples.columns else PACK))
    start = max(samples.columns[role][0][0] for role in needed)
    end = min(samples.columns[role][0][-1] for role in needed)
    if end - start < SHORTEST:
        raise InputError(
            f"ride {samples.name}: {end - start:.0f} s of {', '.join(needed)} together; a minute is the least"
        )
    grid = np.arange(start, end, STEP)
    late = delays(vehicle)
    signals: dict[str, Array] = {}
    valid: dict[str, Mask] = {}
    for role, (times, values) in samples.columns.items():
        at = grid + late.get(role, 0.0)
        turned = np.unwrap(values) if role == "gps_course" else values
        signals[role] = averaged(times, turned, at)
        valid[role] = measured(times, at)
    p = vehicle.parameters
    ride = Ride(samples.name, grid - start, signals, valid, road_speed(1.0, p), samples.rider_mass)
    ride.periods = {role: float(np.median(np.diff(times))) for role, (times, _) in samples.columns.items()}
    ride.stand_ins, ride.current_size = words, sizes_of(vehicle).current
    ride.quantities = _quantities(ride, p)
    if "motor_current" not in signals:
        ride.quantities |= driven_by_pack(ride, vehicle)
    ride.energy = energy_drawn(ride, p)
    if "pack_current" in signals:
        ride.quantities["pack_current"] = true_current(signals["pack_current"], p)
    ride.quantities["since_braking"] = since(ride.braking)
    ride.quantities["since_change"] = since_change(ride.quantities["motor_current"] / ride.current_size)
    wheels = [samples.columns[role] for role in SUSPENSION if role in samples.columns]
    if wheels and all(np.median(np.diff(times)) < ROUGH_PERIOD for times, _ in wheels):
        ride.quantities["suspension_speed"] = suspension_speed(wheels, grid)
    if "accel_z" in samples.columns and np.median(np.diff(samples.columns["accel_z"][0])) < ROUGH_PERIOD:
        ride.quantities["vibration"] = vibration(*samples.columns["accel_z"], grid)
    return ride


def driven_by_pack(ride: Ride, vehicle: Vehicle) -> dict[str, Array]:
    """Current [A] and torque [N·m] of the motor, (n,), that the pack's power points to by the vehicle file, none at
    standstill; and how much less of the current a watt more of another load leaves (``current_per_watt`` [A/W]).
    """
    p, model, q, s = vehicle.parameters, vehicle.model, ride.quantities, ride.signals
    power = true_voltage(s["pack_voltage"], p) * true_current(s["pack_current"], p) - ride.loads
    power = power - total(model.at(Port.DC_POWER), q)
    constant, spin = p["torque_constant"], np.maximum(np.abs(q["motor_speed"]), CRAWL / ride.radius)

    def drive(current: Array) -> Array:
        """What the drive takes at this current [W]."""
        now = {**q, "motor_current": current, "torque": constant * current}
        return np.asarray(now["torque"] * q["motor_speed"] + total(model.at(Port.MOTOR_LOSS, Port.INVERTER_LOSS), now))

    low, high = np.zeros_like(power), np.full_like(power, 2 * p["motor_current_limit"])
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        over = drive(middle) > power
        low, high = np.where(over, low, middle), np.where(over, middle, high)
    # recovering, losses are small beside what the shaft gives
    recovered = np.minimum((power - drive(np.zeros_like(power))) / (constant * spin), 0.0)
    current = np.where(ride.standing, 0.0, np.where(recovered < 0, recovered, (low + high) / 2))
    steep = np.maximum(drive(current + 1.0) - drive(current), constant * spin)  # W/A
    return {
        "motor_current": current,
        "torque": constant * current,
        "current_per_watt": np.where(ride.standing, 0.0, 1 / steep),
    }


def grade_by_altitude(altitude: Array, speed: Array) -> Array:
    """Sine of the slope (n,) from `altitude` (n,) [m] at `speed` (n,) [m/s], a mean over `CLIMB` of the way."""
    way = np.cumsum(np.abs(speed)) * STEP
    if way[-1] < CLIMB:
        return np.zeros_like(way)
    points = np.arange(way[0], way[-1], FEWEST)
    first = np.flatnonzero(np.diff(way, prepend=-1.0) > 0)  # standing, there are many at one place
    height = running_mean(np.interp(points, way[first], altitude[first]), round(CLIMB / FEWEST / 2) * 2 + 1)
    return np.clip(np.interp(way, points, np.gradient(height, FEWEST)), -STEEPEST, STEEPEST)


def energy_drawn(ride: Ride, p: Mapping[str, float]) -> float:
    """What the pack gave over the ride [J], its sensors' errors taken off; the motor's work where that is not known."""
    s, q = ride.signals, ride.quantities
    if {"pack_voltage", "pack_current"} <= ride.have:
        power = true_voltage(s["pack_voltage"], p) * true_current(s["pack_current"], p)
    elif {"inverter_voltage", "inverter_current"} <= ride.have:
        power = s["inverter_voltage"] * s["inverter_current"]
    else:
        power = np.abs(q["torque"] * q["motor_speed"])
    return float(np.sum(power)) * STEP


def since(happens: Mask) -> Array:
    """Time [s] since `happens` (n,) was last True, at most `LONGEST`, (n,)."""
    steps = np.arange(len(happens))
    last = np.maximum.accumulate(np.where(happens, steps, -round(LONGEST / STEP)))
    return np.asarray(np.minimum((steps - last) * STEP, LONGEST))


def since_change(current: Array) -> Array:
    """Time [s] since `current` (n,), in a vehicle of size 1, changed by `JUMP` within `WITHIN`; at most `LONGEST`."""
    n = round(WITHIN / STEP)
    return since(np.abs(current - np.concatenate([np.full(n, current[0]), current[:-n]])) > JUMP)


def vibration(times: Array, values: Array, grid: Array) -> Array:
    """How rough the road is [m/s²]: of vertical acceleration `values` at `times`, at `grid`; see `Vibration`."""
    meter, rms = Vibration(), []
    for dt, value in zip(np.diff(times, prepend=times[0]).tolist(), values.tolist(), strict=True):
        meter.update(dt, value)
        rms.append(meter.value)
    return np.asarray(np.interp(grid, times, rms))


def suspension_speed(wheels: Sequence[tuple[Array, Array]], grid: Array) -> Array:
    """The RMS [m/s] over `SHAKING` of how fast the suspension moves, of all `wheels` together, at `grid`.

    wheels: (times [s], travel [m]) of each.
    """
    square = np.zeros_like(grid)
    for times, travel in wheels:
        speed = np.gradient(travel, times)
        square += averaged(times, speed * speed, grid, SHAKING)
    return np.asarray(np.sqrt(np.maximum(square, 0.0)))


def smooth(values: Array, seconds: float) -> Array:
    """The running mean over about `seconds`, shape kept."""
    return running_mean(values, round(seconds / STEP / 2) * 2 + 1)


def steering(speed: Array, lateral_acceleration: Array, wheelbase: float) -> Array:
    """Angle [rad] of a bicycle without slip: wheelbase over the radius of the bend."""
    fast = np.maximum(np.abs(speed), CRAWL)
    return np.asarray(np.clip(wheelbase * lateral_acceleration / fast**2, -MOST_STEERING, MOST_STEERING))


def _quantities(ride: Ride, p: Mapping[str, float]) -> dict[str, Array]:
    s = ride.signals
    n = len(ride.time)
    motor_speed = s["motor_speed"]
    motor_current = s.get("motor_current", np.zeros(n))
    speed = motor_speed * ride.radius
    acceleration: Array = np.gradient(smooth(speed, ACCELERATING), STEP)
    ambient = s.get("ambient_temperature", np.full(n, MILD))
    temperature = s.get("cell_temperature", ambient)
    still = np.abs(speed) < STANDSTILL
    yaw = np.zeros(n)
    if "rate_z" in s:
        bias = float(np.median(s["rate_z"][still])) if still.sum() > STANDING else float(np.median(s["rate_z"]))
        yaw = smooth(s["rate_z"] - bias, YAWING)
    # the body leans: its yaw rate is r·cos φ, and tan φ = v·r/g, so sin φ = v·rate/g
    sine = np.clip(speed * yaw / GRAVITY, -STEEPEST_LEAN, STEEPEST_LEAN)
    lateral = GRAVITY * sine / np.sqrt(1 - sine**2)
    grade = np.zeros(n)
    if "accel_x" in s:
        grade = smooth(grade_shown(s["accel_x"], acceleration), CLIMBING)
    elif "gps_altitude" in s:
        grade = grade_by_altitude(s["gps_altitude"], speed)
    moved = np.cumsum(np.abs(speed) > MOVING) * STEP
    course = s.get("gps_course", np.zeros(n))
    altitude = float(np.median(s["gps_altitude"])) if "gps_altitude" in s else 0.0
    density = air_density(float(np.median(ambient)), altitude)
    return {
        "speed": speed,
        "acceleration": acceleration,
        "grade": grade,
        "grade_cosine": np.asarray(np.sqrt(1 - np.clip(grade, -STEEPEST, STEEPEST) ** 2)),
        "mass": np.full(n, p["vehicle_mass"] + (p["payload_mass"] if ride.payload is None else ride.payload)),
        "air_density": np.full(n, density),
        "headwind": np.zeros(n),
        "lateral_acceleration": lateral,
        "steering": steering(speed, lateral, p["wheelbase"]),
        "motor_speed": motor_speed,
        "motor_current": motor_current,
        "motor_temperature": s.get("motor_temperature", ambient),
        "ambient_temperature": ambient,
        "cell_temperature": temperature,
        "heading": np.asarray(np.mod(course, 2 * np.pi), dtype=np.float64),
        "time": ride.time,
        "time_moving": np.asarray(moved, dtype=np.float64),
        "torque": p["torque_constant"] * motor_current,
    }
