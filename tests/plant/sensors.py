"""What the scooter's instruments make of a ride: rates, delays, gains, noise, steps and losses as in its recordings.

Each message has a clock of its own; the signals of one message share its times, as on a real bus.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gz_onboard.arrays import Array
from gz_onboard.recording.recording import Recording
from tests.plant.cells import curve
from tests.plant.machine import PARALLEL, SERIES, G
from tests.plant.ride import STEP, Ridden

ORIGIN = (40.307, -83.537)  # deg
DEGREE = 111_200.0  # m
TORQUE_PER_AMPERE = 0.47  # what the inverter believes
PULSES = 2.9  # rad/s: wheel sensors give nothing below
ODOMETER_RADIUS = 0.245


# How much the groups of a healthy pack differ, one standard deviation: charge when full, capacity, resistance, and the
# monitor's channels [V], which have noise too
GROUPS = 0.002, 0.004, 0.02, 0.0015
GROUP_NOISE = 0.0007


def measure(ridden: Ridden, name: str, cells: bool = False) -> Recording:
    """The ride as its log would give it; with `cells` the monitor tells lowest and highest voltage of the groups."""
    rng = np.random.default_rng([ridden.plan.seed, 83])
    c, m, h = ridden.columns, ridden.machine, ridden.hidden
    count = len(c["speed"])
    end = (count - 2) * STEP
    out: dict[str, tuple[Array, Array]] = {}

    def message(period: float, burst: float, lost: float = 0.001) -> Array:
        """Times of one message, without those that were lost: some alone, rarely a burst of `burst` seconds."""
        start = rng.uniform(0, period) + 0.01
        times = start + period * np.arange(int((end - start - 0.05) / period))
        times = times + rng.normal(0, min(0.0003, 0.03 * period), len(times))
        keep = rng.random(len(times)) > lost
        if rng.random() < 0.6:
            at = rng.uniform(0, end)
            keep &= (times < at) | (times > at + burst * rng.uniform(0.5, 1.5))
        return np.asarray(times[keep])

    def at(values: Array | NDArray[np.float32], times: Array, delay: float = 0.0) -> Array:
        x = np.clip((times - delay) / STEP, 0, count - 1.001)
        low = x.astype(np.intp)
        part = x - low
        return np.asarray(values[low] * (1 - part) + values[low + 1] * part, dtype=float)

    def put(role: str, times: Array, values: Array, step: float, noise: float = 0.0) -> None:
        if noise:
            values = values + noise * rng.normal(size=len(values))
        out[role] = (times, step * np.round(values / step))

    def block(values: NDArray[np.float32], width: int) -> Array:
        """Mean of the last `width` steps: instruments that average."""
        sums = np.cumsum(np.concatenate((np.zeros(width), np.asarray(values, float))))
        head = np.concatenate((np.full(width, values[0]), np.asarray(values, float)))
        sums = np.cumsum(head)
        return np.asarray((sums[width:] - sums[:-width]) / width)

    # inverter
    t = message(0.010, 0.15)
    put("motor_speed", t, at(c["rear"], t) * h.speed_factor, 0.1 * np.pi / 30, 0.057)
    current = at(c["motor_current"], t) + 0.9 * rng.normal(size=len(t))
    put("motor_current", t, current, 0.1)
    put("motor_torque", t, TORQUE_PER_AMPERE * current, 0.1)
    t = message(0.100, 0.25)
    put("inverter_voltage", t, at(c["inverter_voltage"], t) + m.inverter_voltage_offset, 0.05, 0.042)
    inverter_current = at(c["inverter_current"], t) * m.inverter_current_gain - 0.12
    put("inverter_current", t, inverter_current, 0.1, 0.35)
    put("inverter_temperature", t, at(c["board"], t), 1.0)
    put("motor_temperature", t, at(c["stator"], t), 1.0)
    # battery management
    t = message(0.100, 0.5)
    late = m.bms_latency
    voltage = at(block(c["pack_voltage"], 2), t, late + h.voltage_late) + m.voltage_offset + h.voltage_offset
    put("pack_voltage", t, voltage, 0.01, 0.0105)
    amperes = at(block(c["pack_current"], 2), t, late)
    amperes = amperes * m.current_gain * h.current_factor + m.current_offset + h.current_offset
    put("pack_current", t, amperes, 0.05, 0.061)
    counted = np.cumsum(np.concatenate(([0.0], amperes[:-1] * np.diff(t)))) / 3600
    start = float(c["soc"][0]) + 0.015 * rng.normal()
    put("bms_state_of_charge", t, np.clip(start - counted / (12 * 2.735), 0.0, 1.0), 0.005)
    put("contactor", t, np.ones(len(t)), 1.0)
    t = message(1.0, 1.0, 0.0)
    put("cell_temperature", t, at(c["shell"], t) + m.cell_probe_bias, 1.0, 0.05)
    put("ambient_temperature", message(1.0, 1.0, 0.0), np.zeros(0), 0.1)
    if cells:
        t = out["cell_temperature"][0]
        groups = _groups(ridden, t, lambda column, late: at(block(column, 2), t, late))
        put("lowest_cell_voltage", t, groups.min(axis=0), 0.001)
        put("highest_cell_voltage", t, groups.max(axis=0), 0.001)
    t = out["ambient_temperature"][0]
    put("ambient_temperature", t, np.full(len(t), ridden.plan.ambient + m.ambient_bias), 0.1, 0.2)
    # vehicle control unit
    t = message(0.020, 0.15)
    put("throttle", t, np.clip(at(c["throttle"], t) + 0.003 * rng.normal(size=len(t)), 0, 1), 0.005)
    put("brake_switch", t, (at(c["brake"], t) > 0.5).astype(float), 1.0)
    put("charge_plug", t, np.zeros(len(t)), 1.0)
    t = message(1.0, 1.0, 0.001)
    put("odometer", t, 1_843_200 + at(np.cumsum(c["rear"]) * STEP * ODOMETER_RADIUS, t), 1.0)
    # inertial unit, in the body that leans
    t = message(0.010, 0.4)
    speed, lean, yaw = at(c["speed"], t), at(c["lean"], t), at(c["yaw_rate"], t)
    acceleration, grade = at(c["acceleration"], t), at(c["grade"], t)
    slope = np.arcsin(grade)
    shake = 0.10 + 0.068 * speed * at(c["rough"], t)
    sideways = speed * yaw
    put("accel_x", t, (1 + m.accel_pitch) * acceleration + G * grade + m.accel_bias_x, 0.002)
    out["accel_x"] = _shaken(rng, out["accel_x"], shake, 0.002)
    put("accel_y", t, sideways * np.cos(lean) + G * np.sin(lean) + m.accel_bias_y, 0.002)
    out["accel_y"] = _shaken(rng, out["accel_y"], shake, 0.002)
    put("accel_z", t, G * np.cos(slope) * np.cos(lean) - sideways * np.sin(lean) + m.accel_bias_z, 0.002)
    out["accel_z"] = _shaken(rng, out["accel_z"], 1.7 * shake, 0.002)
    t = t + 0.0006
    tremble = 0.0062 + 0.0014 * speed
    step = np.radians(0.01)
    pitch = -np.gradient(slope, t)
    put("rate_x", t, at(c["lean_rate"], t) + m.gyro_bias_x, step)
    put("rate_y", t, pitch + yaw * np.sin(lean) + m.gyro_bias_y, step)
    put("rate_z", t, yaw * np.cos(lean) + m.gyro_bias_z, step)
    for role in ("rate_x", "rate_y", "rate_z"):
        out[role] = _shaken(rng, out[role], tremble, step)
    # chassis instruments
    t = message(0.020, 0.4)
    for role, column in (("wheel_speed_front", "front"), ("wheel_speed_rear", "rear")):
        turning = at(c[column], t)
        put(role, t, turning * (1 + 0.0022 * rng.normal(size=len(t))), 0.001 * 2 * np.pi)
        out[role] = (t, np.where(turning > PULSES, out[role][1], 0.0))
    t = t + 0.001
    squeeze = at(c["squeeze"], t) * (m.mass + ridden.plan.rider.mass)
    put("brake_pressure_front", t, np.maximum(3600 * 0.6 * squeeze + 8000 * rng.normal(size=len(t)), 0), 1000.0)
    put("brake_pressure_rear", t, np.maximum(2900 * 0.4 * squeeze + 7000 * rng.normal(size=len(t)), 0), 1000.0)
    t = message(0.100, 0.4)
    put("auxiliary_current", t, at(c["auxiliary_current"], t), 0.005, 0.0135)
    _position(rng, ridden, out, message, at, put)
    facts: dict[str, object] = {
        "kind": ridden.plan.kind,
        "rider": ridden.plan.rider.name,
        "rider_mass_kg": ridden.plan.rider.mass,
        "ambient_C": round(ridden.plan.ambient + float(rng.normal(0, 0.7)), 1),
    }
    return Recording(name, out, facts)


def _groups(ridden: Ridden, times: Array, at: Callable[[NDArray[np.float32], float], Array]) -> Array:
    """Voltages of the groups at `times`, (SERIES, times): of a healthy pack about the mean cell's, and a weak one."""
    c, m = ridden.columns, ridden.machine
    rng = np.random.default_rng([int(1e9 * m.capacity), 89])
    amperes, soc = at(c["pack_current"], m.bms_latency), at(c["soc"], m.bms_latency)
    sum_of_all = at(c["pack_voltage"], m.bms_latency) + m.series_resistance * amperes
    healthy = sum_of_all / SERIES
    weak = at(c["weak_group"], m.bms_latency) if "weak_group" in c else None
    if weak is not None:
        healthy = (sum_of_all - weak) / (SERIES - 1)
    volts, count = curve()
    slope = np.interp(soc, np.linspace(0, 1, count + 1), np.gradient(volts) * count)
    drop = (m.ohmic + m.film) * amperes / PARALLEL
    charge, capacity, resistance, channel = (sd * rng.normal(size=(SERIES, 1)) for sd in GROUPS)
    charge, capacity, resistance = (x - x.mean() for x in (charge, capacity, resistance))
    found = healthy - slope * (charge + capacity * (1 - soc)) - resistance * drop
    if weak is not None:
        found[0] = weak
    noise = np.random.default_rng([ridden.plan.seed, 97]).normal(size=found.shape)
    return np.asarray(found + channel + GROUP_NOISE * noise)


def _shaken(rng: np.random.Generator, column: tuple[Array, Array], sd: Array, step: float) -> tuple[Array, Array]:
    times, values = column
    return times, step * np.round((values + sd * rng.standard_normal(len(values))) / step)


def _drift(rng: np.random.Generator, count: int, period: float, time: float, sd: float) -> Array:
    """Noise that wanders with the time constant `time` [s]."""
    from scipy.signal import lfilter

    keep = np.exp(-period / time)
    white = rng.normal(size=count) * sd * np.sqrt(1 - keep * keep)
    white[0] = sd * rng.normal()
    return np.asarray(lfilter([1.0], [1.0, -keep], white))


def _position(
    rng: np.random.Generator,
    ridden: Ridden,
    out: dict[str, tuple[Array, Array]],
    message: Callable[..., Array],
    at: Callable[..., Array],
    put: Callable[..., None],
) -> None:
    """The GPS receiver: late, smooth, wandering, away under bridges."""
    c, m = ridden.columns, ridden.machine
    late = m.gps_latency
    t = message(0.200, 5.0, 0.003)
    n = len(t)
    speed = at(c["speed"], t, late)
    out_speed = np.abs(speed + _drift(rng, n, 0.2, 1.5, 0.05) + 0.05 * rng.normal(size=n))
    course = at(c["heading"], t, late) + rng.normal(size=n) * np.minimum(0.003 + 0.03 / np.maximum(speed, 0.1), 1.5)
    north = at(c["north"], t, late) + _drift(rng, n, 0.2, 60, 1.5)
    east = at(c["east"], t, late) + _drift(rng, n, 0.2, 60, 1.5)
    altitude = at(c["altitude"], t, late) + _drift(rng, n, 0.2, 120, 1.5)
    put("latitude", t, ORIGIN[0] + north / DEGREE, 1e-7)
    put("longitude", t, ORIGIN[1] + east / (DEGREE * np.cos(np.radians(ORIGIN[0]))), 1e-7)
    t = t + 0.001
    put("gps_speed", t, out_speed, 0.01)
    put("gps_course", t, np.mod(course, 2 * np.pi), np.radians(0.01))
    put("gps_altitude", t, altitude, 0.1, 0.18)
    put("gps_fix", t, np.full(n, 3.0), 1.0)
