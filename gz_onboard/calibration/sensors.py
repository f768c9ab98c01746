"""Wheel radius, auxiliary power, errors of the pack's sensors and resistances beside the cells, out of rides.

Two sensors show where they differ, not which one errs: without a third the gain found is that of the pack against the
inverter's, and its sd is that of a sensor's class. Absolute numbers are of a vehicle of size 1 (see `sizes_of`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gz_onboard.arrays import Array, Mask, block_means, held_at, held_integral
from gz_onboard.calibration.fit import as_groups, every_second, line, linear, score
from gz_onboard.calibration.result import Fit, Found, LackingError, Panel, PlotLine, Result, compared
from gz_onboard.calibration.table import Measurements
from gz_onboard.errors import InputError
from gz_onboard.events import LOADS
from gz_onboard.model.battery import discharged
from gz_onboard.model.effect import Port
from gz_onboard.model.model import standing_load
from gz_onboard.model.series import first_soc
from gz_onboard.priors import sizes_of
from gz_onboard.recording.recording import Recording
from gz_onboard.recording.sensors import speed_role, true_columns
from gz_onboard.vehicle import Vehicle


@dataclass(frozen=True)
class RideConfig:
    """Which samples of a ride count, and what a sensor's class adds to the scatter."""

    # wheel radius
    slowest: float = 5.0  # m/s: below, a receiver's speed is poor
    steady: float = 0.15  # m/s²
    steady_for: float = 2.0  # s either side, over which it must be steady
    fewest_fixes: int = 60  # of a ride
    receiver_sd: float = 0.002  # relative: Doppler speed of a receiver in the open
    # standstill
    standing: float = 0.05  # m/s
    moving: float = 0.3  # rad/s of the motor: below is rest
    driving: float = 3.0  # A of the motor: below is rest
    fed: float = 2.0  # A of the inverter: below is rest
    fewest_rest: int = 20  # samples
    # current and voltage sensors
    window: float = 2.0  # s: means over that separate gains from timing
    gain_span: float = 5.0  # A, for a gain
    gain_sd: float = 0.007  # of a current sensor of 1 % class
    shunt_sd: float = 0.01  # of a current, relative: a shunt's calibration
    auxiliary: float = 0.85  # A of lamps and control, by which the auxiliary sensor's class counts
    drift_sd: float = 0.02  # A of a current sensor's zero from day to day: the least believed
    first_spread: float = 0.05  # A: the same of one ride
    least_apart: float = 0.01  # V that two voltage sensors of a pack may differ by, however alike they read
    # resistances
    cable_window: float = 1.0  # s
    cable_span: float = 10.0  # A, for a line
    voltage_gain_sd: float = 1e-3  # of each sensor: a gain over the sag of the pack looks like resistance
    step_time: float = 0.2  # s
    least_step: float = 15.0  # A
    fewest_steps: int = 20
    warm: float = 20.0  # degC: below the cells' resistance is many times that of bars and fuse
    cells_sd: float = 0.05  # of the cells' resistance, from cell to cell and from table to step


RIDE = RideConfig()
TURNING = ("motor_speed", "wheel_speed_rear")  # what turns with the driven wheel, the first that there is
PAIRED = ["pack_current", "pack_voltage", "inverter_current", "inverter_voltage", "motor_speed", "motor_current"]
PACK = ("pack_voltage", "pack_current")
AUXILIARY = ("auxiliary_current", "pack_voltage")
LAGS = np.arange(-0.3, 0.31, 0.05)  # s: how far one set of sensors may lag the other


# --- wheel radius --------------------------------------------------------------------------------------------------


def wheel_radius(rides: Sequence[Recording], vehicle: Vehicle) -> Result:
    """wheel_radius [m] of the rides that have GPS and steady riding; each ride held out once shows how it differs.

    At steady speed the wheel's slip is small and a lag of the receiver does no harm. What slip there is belongs to the
    radius: it is the one that turns motor speed into the vehicle's speed. By motor_speed, of rides without it by
    wheel_speed_rear. Raises LackingError if no ride has both.
    """
    result = Result("wheel")
    radii: list[float] = []
    lines, count, turning = [], 0, set()
    for ride in rides:
        role = next((role for role in TURNING if role in ride.columns), None)
        if "gps_speed" not in ride.columns or role is None:
            result.refusals.append(f"{ride.name}: has no gps_speed or no motor_speed, nor a {TURNING[1]} instead")
            continue
        if role != TURNING[0]:
            result.notes.append(f"{ride.name}: no {TURNING[0]}, taken by {role} instead")
        gear = vehicle.parameters["gear_ratio"] if role == TURNING[0] else 1.0
        over_ground, wheel = _steady(true_columns(ride.columns, vehicle.parameters), role, gear)
        if len(wheel) < RIDE.fewest_fixes:
            result.refusals.append(
                f"{ride.name}: {len(wheel)} fixes at steady speed above {RIDE.slowest:g} m/s; {RIDE.fewest_fixes} "
                "needed"
            )
            continue
        ratio = over_ground / wheel
        radii.append(float(np.median(ratio)))
        turning.add(role)
        count += len(wheel)
        lines.append(PlotLine(ride.name, wheel, ratio, "."))
    if not radii:
        raise LackingError(f"no ride tells the wheel's radius: {'; '.join(result.refusals) or 'none given'}")
    each, n, names = np.array(radii), len(radii), ", ".join(trace.label for trace in lines)
    radius = float(np.mean(each))
    spread = float(np.std(each, ddof=1)) if n > 1 else 3 * RIDE.receiver_sd * radius
    sd = float(np.hypot(spread / np.sqrt(n), RIDE.receiver_sd * radius))
    channel = f"gps_speed over {' and '.join(sorted(turning))}"
    source = (
        f"{names}: {channel}, {count} fixes at steady speed, {each.min():.4f} to "
        f"{each.max():.4f} m; slip of the driven wheel included"
    )
    result.parameters["wheel_radius"] = Found(radius, sd, "m", source, channel)
    if n > 1:
        left = n / (n - 1) * (each - radius)  # each by the mean of the others
        rms, largest = float(np.sqrt(np.mean(left**2))), float(np.abs(left).max())
        result.fits.append(Fit("wheel radius", "m", rms, largest, None, n, True, f"each of {names} left out"))
    ends = np.array([RIDE.slowest, max(float(t.x.max()) * radius for t in lines)]) / radius
    lines.append(PlotLine("radius", ends, np.full(2, radius)))
    x_label = "speed of the driven wheel [rad/s]"
    result.panels.append(Panel("Speed over ground by wheel speed", x_label, "m", tuple(lines)))
    return result


def _steady(columns: Mapping[str, tuple[Array, Array]], role: str, gear: float) -> tuple[Array, Array]:
    """(GPS speed [m/s], speed of the driven wheel [rad/s]) at fixes within steady riding, by `gear` times `role`."""
    (time, speed), (at, motor), c = columns["gps_speed"], columns[role], RIDE
    good = (speed > c.slowest) & (time > at[0] + c.steady_for) & (time < at[-1] - c.steady_for)
    if "gps_fix" in columns:
        good &= np.interp(time, *columns["gps_fix"]) > 1.5
    if not good.any():
        return np.empty(0), np.empty(0)
    time, speed = time[good], speed[good]
    # The wheel's mean over the second before: a receiver reports late, and smoothed.
    turned = np.concatenate([[0.0], np.cumsum(np.diff(at) * (motor[1:] + motor[:-1]) / 2)])
    wheel = np.interp(time, at, turned) - np.interp(time - 1.0, at, turned)
    shifts = np.array([-1.0, -0.5, 0.0, 1.0])[:, None] * c.steady_for
    around, quick = np.interp(time + shifts[[0, 2, 3]], time, speed), np.interp(time + shifts, at, motor)
    slow = np.ptp(quick, axis=0) / np.mean(quick, axis=0) * speed / (2 * c.steady_for) < c.steady
    steady = slow & (np.ptp(around, axis=0) / (2 * c.steady_for) < c.steady)
    return speed[steady], wheel[steady] * gear


# --- auxiliary power -----------------------------------------------------------------------------------------------


def auxiliary_power(rides: Sequence[Recording], vehicle: Vehicle) -> Result:
    """auxiliary_power [W]: lamps, dashboard and control, the mean over the rides, each counting once (eq. 2.19).

    By the auxiliary current, else by the pack's power at standstill. Raises InputError if no ride has either.
    """
    if any(set(AUXILIARY) <= ride.columns.keys() for ride in rides):
        return _by_auxiliary_current(rides)
    return _by_standstill(rides, vehicle)


def _by_auxiliary_current(rides: Sequence[Recording]) -> Result:
    """The brake light makes it one of two values; the mean holds it as often as these riders braked.

    The sd is that of one ride's mean, and of the sensor.
    """
    result = Result("auxiliary")
    rows = []  # mean, without and with light, share of the light, samples

    def mean_of(values: Array) -> float:
        return float(values.mean()) if len(values) > 9 else float("nan")

    for ride in rides:
        if missing := [role for role in AUXILIARY if role not in ride.columns]:
            result.notes.append(f"{ride.name}: no {missing[0]}, left out")
            continue
        time, current = ride.columns["auxiliary_current"]
        power = current * np.interp(time, *ride.columns["pack_voltage"])
        brake = ride.columns.get("brake_switch")
        light = held_at(time, *brake) > 0.5 if brake else np.zeros(len(time), dtype=bool)
        rows.append((power.mean(), mean_of(power[~light]), mean_of(power[light]), light.mean(), len(power)))
    mean, without, lit, share, points = np.array(rows).T
    value, n = float(mean.mean()), len(mean)
    if value <= 0:
        raise InputError(f"auxiliary power is {value:.3g} W: auxiliary_current must be positive when consuming")
    spread = float(mean.std(ddof=1)) if n > 1 else 0.05 * value
    source = f"{n} rides, {int(points.sum())} samples"
    if np.isfinite(lit).any():
        off, on = float(np.nanmean(without)) if np.isfinite(without).any() else np.nan, float(np.nanmean(lit))
        result.notes.append(
            f"{off:.1f} W without, {on:.1f} W with brake light, which shone {100 * share.mean():.0f} % of the time"
        )
        source += f"; {off:.1f} W, {on:.1f} W with brake light"
    else:
        result.refusals.append("auxiliary power of the brake light: no ride has brake_switch with the brake on")
    sd = float(np.hypot(spread, RIDE.shunt_sd * value))
    result.parameters["auxiliary_power"] = Found(value, sd, "W", source, "auxiliary_current times pack_voltage")
    if n > 1:
        others, by = (mean.sum() - mean) / (n - 1), f"each of {n} rides by the others"
        result.fits.append(score("auxiliary power, mean of a ride", "W", mean, others, held_out=True, source=by))
    x = np.arange(n, dtype=float)
    lines = (
        PlotLine("without brake light", x, without, "."),
        PlotLine("with brake light", x, lit, "."),
        PlotLine("mean", x, np.full(n, value)),
    )
    result.panels.append(Panel("Auxiliary power", "ride", "power [W]", lines))
    return result


def _by_standstill(rides: Sequence[Recording], vehicle: Vehicle) -> Result:
    """The pack's power while the vehicle stands, less the inverter's own and what heating and cooling take.

    Its sd is of a ride to come, with that of the inverter's own. LackingError for rides without standstill.
    """
    result, p = Result("auxiliary"), vehicle.parameters
    result.notes.append("no ride has auxiliary_current: taken from the pack's power at standstill instead")
    means = []
    for ride in rides:
        if missing := [role for role in PACK if role not in ride.columns]:
            result.notes.append(f"{ride.name}: no {missing[0]}, left out")
            continue
        still, power = _standing(ride, p)
        if still.sum() >= RIDE.fewest_rest:
            means.append(float(np.median(power[still])))
    if not means:
        raise LackingError("no ride has auxiliary_current, and none stands still with pack_voltage and pack_current")
    mean = float(np.mean(means))
    if mean <= 0:
        raise InputError(f"the pack gives {mean:.3g} W at standstill: its current must be positive when discharging")
    spread = float(np.std(means, ddof=1)) if len(means) > 1 else 0.2 * mean
    sd = float(np.hypot(spread, p.sd("inverter_loss_constant")))
    span = f"{min(means):.0f} to {max(means):.0f} W"
    source = f"pack power at standstill of {len(means)} rides, {span}, less the inverter's own"
    result.parameters["auxiliary_power"] = Found(mean, sd, "W", source, "pack_voltage times pack_current")
    return result


def _standing(ride: Recording, p: Mapping[str, float]) -> tuple[Mask, Array]:
    """(whether the vehicle stands; the pack's power [W] less the inverter's own, a heater's and an air conditioner's).

    At the times of the pack's current, (n,). InputError for a ride without a speed.
    """
    role, factor = speed_role(ride.name, ride.columns, p)
    time, current = ride.columns["pack_current"]
    power = current * np.interp(time, *ride.columns["pack_voltage"]) - p["inverter_loss_constant"]
    for load in LOADS:
        if load in ride.columns:
            power = power - np.interp(time, *ride.columns[load])
    return np.abs(np.interp(time, *ride.columns[role])) * factor < RIDE.standing, power


# --- sensors of the pack -------------------------------------------------------------------------------------------


class Pair(NamedTuple):
    """Two readings of one ride at the times of the pack's current [s], and whether the vehicle stood without load."""

    name: str
    time: Array
    pack: Array
    inverter: Array
    auxiliary: Array
    pack_voltage: Array
    inverter_voltage: Array
    rest: Mask
    lag: float  # s: of the pack's sensors behind the inverter's

    def means(self, values: Array, seconds: float) -> Array:
        """Means of `values` over windows of that length: timing counts less."""
        return block_means(values, max(round(seconds / max(float(np.median(np.diff(self.time))), 1e-3)), 1))


def read_pair(ride: Recording, vehicle: Vehicle) -> Pair:
    """The readings of pack and inverter at the same times, their lag taken off. LackingError for missing signals.

    Pack current less auxiliary current is the inverter's DC current; the inverter's own small consumption at rest does
    not show in its reading, but is in the pack's.
    """
    for role in PAIRED:
        if role not in ride.columns:
            raise LackingError(f"{ride.name}: no {role}, which sensor offsets and resistances need")
    time, pack = ride.columns["pack_current"]

    def at(role: str, lag: float = 0.0) -> Array:
        return np.interp(time - lag, *ride.columns[role])

    if "auxiliary_current" in ride.columns:
        auxiliary = at("auxiliary_current")
    else:
        auxiliary = vehicle.parameters["auxiliary_power"] / np.maximum(at("pack_voltage"), 1.0)
    lag = float(min(LAGS, key=lambda x: float(np.std(pack - auxiliary - at("inverter_current", x)))))
    inverter, size = at("inverter_current", lag), sizes_of(vehicle).current
    rest = (np.abs(at("motor_speed")) < RIDE.moving) & (np.abs(at("motor_current")) < RIDE.driving * size)
    rest &= np.abs(inverter) < RIDE.fed * size
    volts = at("pack_voltage"), at("inverter_voltage", lag)
    return Pair(ride.name, time, pack, inverter, auxiliary, *volts, rest, lag)


def offsets(rides: Sequence[Recording], vehicle: Vehicle) -> Result:
    """pack_current_offset, pack_current_gain, both noises and pack_voltage_offset of the pack's sensors.

    Of rides that all lack the inverter's, see `_at_standstill`. Raises InputError if none stands still long enough.
    """
    if not rides:
        raise InputError("no ride, which sensor offsets come from")
    pairs = [read_pair(ride, vehicle) for ride in rides if set(PAIRED) <= ride.columns.keys()]
    if not pairs:
        return _at_standstill(rides, vehicle)
    resting = [pair for pair in pairs if pair.rest.sum() >= RIDE.fewest_rest]
    if not resting:
        raise InputError(
            f"{pairs[0].name}: no ride stands without load for {RIDE.fewest_rest} samples; offsets show at rest"
        )
    p, sizes, result = vehicle.parameters, sizes_of(vehicle), Result("offsets")
    if left_out := [ride.name for ride in rides if ride.name not in {pair.name for pair in pairs}]:
        result.notes.append(f"{', '.join(left_out)}: left out; needed are {', '.join(PAIRED)}")
    own = np.array([p["inverter_loss_constant"] / pair.pack_voltage[pair.rest].mean() for pair in resting])
    apart = np.array([(pair.pack - pair.inverter - pair.auxiliary)[pair.rest].mean() for pair in resting])
    spread, sd = _offset_sd(apart - own, vehicle, float(resting[0].pack_voltage.mean()))
    result.parameters["pack_current_offset"] = Found(
        float(np.mean(apart - own)),
        sd,
        "A",
        f"{len(resting)} rides at rest: pack less inverter less auxiliary is {apart.mean():+.3f} ± {spread:.3f} "
        f"A, {own.mean():.3f} A of it the inverter's own {p['inverter_loss_constant']:.1f} W",
        "pack_current less inverter_current and auxiliary_current at rest",
    )
    _gain(result, pairs, RIDE.gain_span * sizes.current)
    _noises(result, [(_noise(pair.pack, pair.rest), _noise(pair.pack_voltage, pair.rest)) for pair in resting])
    volts = float(np.mean([(pair.pack_voltage - pair.inverter_voltage)[pair.rest].mean() for pair in resting]))
    result.parameters["pack_voltage_offset"] = Found(
        0.0,
        max(abs(volts), RIDE.least_apart * sizes.voltage),
        "V",
        f"reads {volts:+.3f} V over the inverter's at rest, {len(resting)} rides; which one errs is unknown",
    )
    result.refusals.append(
        f"pack_voltage_offset: {volts:+.3f} V between two sensors is all that the data tell, not which one "
        "errs; left at zero with that sd"
    )
    lags = [pair.lag for pair in pairs]
    result.notes.append(
        f"pack's sensors lag the inverter's by {np.median(lags):.2f} s ({min(lags):.2f} to {max(lags):.2f})"
    )
    return result


def _at_standstill(rides: Sequence[Recording], vehicle: Vehicle) -> Result:
    """Both noises and, of rides with auxiliary_current, pack_current_offset, while the vehicle stands.

    Raises LackingError if no ride has pack_voltage and pack_current and stands long enough.
    """
    result = Result("offsets")
    lacking = sorted(set(PAIRED).difference(*(ride.columns for ride in rides)))
    missing = f"no ride has all of {', '.join(PAIRED)}" + (f" (none has {', '.join(lacking)})" if lacking else "")
    noises, apart, volts = [], [], 1.0
    for ride in rides:
        if not set(PACK) <= ride.columns.keys():
            continue
        (still, power), (time, current) = _standing(ride, vehicle.parameters), ride.columns["pack_current"]
        if still.sum() < RIDE.fewest_rest:
            continue
        voltage = np.interp(time, *ride.columns["pack_voltage"])
        noises.append((_noise(current, still), _noise(voltage, still)))
        if "auxiliary_current" in ride.columns:
            volts = float(voltage[still].mean())
            over = power / voltage - np.interp(time, *ride.columns["auxiliary_current"])
            apart.append(float(over[still].mean()))
    if not noises:
        raise LackingError(f"{missing}, nor stands for {RIDE.fewest_rest} samples with {' and '.join(PACK)}")
    result.notes.append(f"{missing}: taken from the pack's sensors at standstill instead")
    _noises(result, noises)
    if apart:
        sd = _offset_sd(np.array(apart), vehicle, volts)[1]
        source = f"{len(apart)} rides at standstill: pack less auxiliary current and the inverter's own"
        channel = "pack_current less auxiliary_current at standstill"
        result.parameters["pack_current_offset"] = Found(float(np.mean(apart)), sd, "A", source, channel)
    else:
        result.refusals.append(
            "pack_current_offset: needs inverter_current, or auxiliary_current at standstill; what the file says stays"
        )
    result.refusals.append(
        "pack_current_gain, pack_voltage_offset: need inverter_current and inverter_voltage; what the file says stays"
    )
    return result


def _offset_sd(offsets: Array, vehicle: Vehicle, volts: float) -> tuple[float, float]:
    """(scatter of those of the rides (n,), sd of that of a ride to come) [A], of a pack at `volts`.

    Beside the scatter from ride to ride, the inverter's own loss and the auxiliary sensor's class are in the sd.
    """
    sizes = sizes_of(vehicle)
    spread = float(np.std(offsets, ddof=1)) if len(offsets) > 1 else RIDE.first_spread * sizes.current
    own = vehicle.parameters.sd("inverter_loss_constant") / volts
    auxiliary = RIDE.shunt_sd * RIDE.auxiliary * sizes.auxiliary / sizes.voltage
    return spread, float(np.hypot(max(spread, RIDE.drift_sd * sizes.current), own) + auxiliary)


def _noises(result: Result, noises: Sequence[tuple[float, float]]) -> None:
    """pack_current_noise [A] and pack_voltage_noise [V] out of those of each ride."""
    for (name, unit), column in zip((("pack_current", "A"), ("pack_voltage", "V")), np.array(noises).T, strict=True):
        sd = float(column.std(ddof=1)) if len(column) > 1 else 0.2 * float(column.mean())
        source = f"first differences at rest, {len(column)} rides, white"
        result.parameters[f"{name}_noise"] = Found(float(np.median(column)), max(sd, 1e-4), unit, source)


def _noise(values: Array, rest: Mask) -> float:
    """The sd of a sample, out of differences of neighbours that both are at rest."""
    both = rest[1:] & rest[:-1]
    return float(np.std(np.diff(values)[both]) / np.sqrt(2)) if both.sum() > 5 else float("nan")


def _gain(result: Result, pairs: Sequence[Pair], least: float) -> None:
    """The pack's current over inverter's and auxiliary together, by ride, if they span `least` [A]."""
    name = "pack_current_gain"
    rows = [[pair.means(x, RIDE.window) for x in (pair.inverter + pair.auxiliary, pair.pack)] for pair in pairs]
    (x, y), labels = (np.concatenate(c) for c in zip(*rows, strict=True)), _labels([row[0] for row in rows])
    if np.ptp(x) < least:
        result.refusals.append(f"{name}: currents of {x.min():.1f} to {x.max():.1f} A only tell no gain")
        return
    fitted = every_second(labels)
    found, model, outside = line(name, x, y, fitted, as_groups(labels))
    source = f"{len(pairs)} rides, {len(x)} means of {RIDE.window:g} s, against inverter and auxiliary current"
    result.parameters[name] = found.found(name, "1", source, RIDE.gain_sd, "pack_current over inverter_current")
    result.refusals.append(
        f"{name}: {found[name]:.4f} ± {found.sd(name):.4f} is the ratio of "
        f"two sensors; which one errs is unknown, so that its sd holds a sensor's class of {100 * RIDE.gain_sd:.1f} %"
    )
    result.fits += [
        score("pack current", "A", y, model, held_out=False, source=source),
        score("pack current", "A", y[~fitted], outside[~fitted], held_out=True, source="every second ride"),
    ]
    left, title = PlotLine("means of 2 s", x, y - model, "."), "Pack current against inverter and auxiliary"
    x_label = "inverter and auxiliary current [A]"
    result.panels.append(Panel(title, x_label, "pack current less line [A]", (left,)))


def _labels(columns: Sequence[Array]) -> Array:
    """The number of the ride of each sample."""
    return np.repeat(np.arange(len(columns)), [len(column) for column in columns])


# --- resistances beside the cells ----------------------------------------------------------------------------------


def resistances(rides: Sequence[Recording], vehicle: Vehicle, pulses: Sequence[Measurements] = ()) -> Result:
    """cable_resistance, of the rides with the inverter's sensors, and pack_series_resistance of all."""
    result = Result("resistance")
    if with_inverter := [ride for ride in rides if set(PAIRED) <= ride.columns.keys()]:
        result.add(cable_resistance(with_inverter, vehicle))
    else:
        lacking = sorted(set(PAIRED).difference(*(ride.columns for ride in rides)))
        result.refusals.append(
            f"cable_resistance: needs {', '.join(lacking)}, which no ride has; the value of the file stays"
        )
    result.add(pack_series_resistance(rides, vehicle, pulses))
    return result


def cable_resistance(rides: Sequence[Recording], vehicle: Vehicle) -> Result:
    """cable_resistance [ohm]: voltage of pack less inverter over the inverter's current, a line with a free offset.

    Raises InputError for rides without current.
    """
    result, name, pairs = Result("resistance"), "cable_resistance", [read_pair(ride, vehicle) for ride in rides]
    rows = [
        [p.means(x, RIDE.cable_window) for x in (p.inverter, p.pack_voltage - p.inverter_voltage, p.pack_voltage)]
        for p in pairs
    ]
    (i, v, pack), label = (np.concatenate(c) for c in zip(*rows, strict=True)), _labels([row[0] for row in rows])
    span = RIDE.cable_span * sizes_of(vehicle).current
    if np.ptp(i) < span:
        raise InputError(
            f"{rides[0].name}: inverter_current of {i.min():.1f} to {i.max():.1f} A spans too little for a resistance; "
            f"{span:g} A are needed"
        )
    fitted = every_second(label)
    found, model, outside = line(name, i, v, fitted, as_groups(label))
    if found[name] < -3 * found.sd(name):
        raise InputError(f"{rides[0].name}: inverter_voltage rises over pack_voltage with current: a sign is wrong")
    what = "voltage between pack and inverter"
    source = f"{len(rides)} rides, {len(i)} means of 1 s, pack less inverter voltage over inverter current"
    result.fits += [
        score(what, "V", v, model, held_out=False, source=source),
        score(what, "V", v[~fitted], outside[~fitted], held_out=True, source="every second ride"),
    ]
    gains = 2**0.5 * RIDE.voltage_gain_sd * abs(line("sag", i, pack, fitted)[0]["sag"])
    source += f"; {found['offset']:+.3f} V at no current"
    channel, sd = "pack_voltage less inverter_voltage over inverter_current", float(np.hypot(found.sd(name), gains))
    result.parameters[name] = Found(max(found[name], 0.0), sd, "ohm", source, channel)
    y_label = "pack less inverter voltage [V]"
    result.panels += compared("Voltage between pack and inverter", "current [A]", y_label, i, v, model)
    return result


def pack_series_resistance(rides: Sequence[Recording], vehicle: Vehicle, pulses: Sequence[Measurements] = ()) -> Result:
    """pack_series_resistance [ohm]: 0.2 s steps of warm rides less what the cells alone give in that time.

    pulses: pulse tests of a cell at two temperatures or more, with `time`, `current`, `voltage` and `cell_temperature`:
    their steps of the same length are the cells' part. Without them it is R0 and the RC pair of the vehicle file, which
    hold for a longer time than a step and so leave less. Raises InputError if there are too few large steps. Gives a
    refusal instead of a number where the cells' own doubt is greater than what is left.
    """
    c, result, name = RIDE, Result("resistance"), "pack_series_resistance"
    by_temperature, least = cell_steps(pulses) if pulses else None, c.least_step * sizes_of(vehicle).current
    of_rides = [_ride_steps(ride, vehicle, by_temperature, least, result) for ride in rides]
    steps = [columns for columns in of_rides if columns is not None]
    count = sum(len(di) for di, _, _ in steps)
    if count < c.fewest_steps:
        raise InputError(
            f"{count} steps of more than {least:g} A within {c.step_time:g} s above {c.warm:g} degC are "
            f"too few for {name}; {c.fewest_steps} are needed"
        )
    di, dv, cell = (np.concatenate(column) for column in zip(*steps, strict=True))
    found = linear({"series": di}, dv - cell * di, groups=as_groups(_labels([di for di, _, _ in steps])))
    value, sd = found["series"], float(np.hypot(found.sd("series"), c.cells_sd * float(cell.mean())))
    whole = linear({"whole": di}, dv)["whole"]
    origin = "the pulse tests' steps" if pulses else "the cell tables"
    source = (
        f"{len(di)} steps above {least:g} A within {c.step_time:g} s of {len(steps)} rides above {c.warm:g} degC: "
        f"{1e3 * whole:.1f} mohm, less {1e3 * cell.mean():.1f} mohm of {origin}"
    )
    model = (cell + value) * di
    result.fits.append(score("voltage step", "V", dv, model, held_out=False, source=source))
    result.panels += compared("Steps of pack voltage", "current [A]", "fall of voltage [V]", di, dv, model)
    if value < 2 * sd:
        result.refusals.append(
            f"{name}: {1e3 * value:+.1f} ± {1e3 * sd:.1f} mohm is left of {1e3 * whole:.1f} "
            f"mohm ({100 * c.cells_sd:.0f} % of the cells' own in doubt): the value of the vehicle file stays"
        )
    else:
        channel = "steps of pack_voltage over those of pack_current"
        result.parameters[name] = Found(value, sd, "ohm", source, channel)
    return result


def _ride_steps(
    ride: Recording, vehicle: Vehicle, by_temperature: tuple[Array, Array] | None, least: float, result: Result
) -> tuple[Array, Array, Array] | None:
    """(steps of current [A], falls of voltage [V], the cells' part of the resistance [ohm]) of a ride, each (m,).

    None for a ride without steps above `least` [A], or at a temperature at which the cells' part is too large or not
    known.
    """
    c, battery = RIDE, vehicle.pack
    if "cell_temperature" not in ride.columns:
        raise InputError(f"{ride.name}: no cell_temperature, without which the cells' part of a step is unknown")
    temperature = float(ride.columns["cell_temperature"][1].mean())
    if temperature < c.warm:
        result.notes.append(f"{ride.name}: cells at {temperature:.0f} degC, left out: {c.warm:g} degC are needed")
        return None
    columns = true_columns(ride.columns, vehicle.parameters)
    time, current = columns["pack_current"]
    voltage = np.interp(time, *columns["pack_voltage"])
    stride = max(round(c.step_time / float(np.median(np.diff(time)))), 1)
    step, drop = current[stride:] - current[:-stride], -(voltage[stride:] - voltage[:-stride])
    big = np.abs(step) > least
    if not big.any():
        return None
    if by_temperature is None:
        volts, amperes = float(np.median(voltage[:5])), float(np.median(current[:5]))
        load = standing_load(amperes, volts, vehicle.parameters["auxiliary_power"])
        start = first_soc(vehicle.model.at(Port.CELL_VOLTAGE), battery, (volts, amperes), temperature, load)
        charge = float(np.trapezoid(current, time))  # A·s; what half of it takes is the middle of the ride
        soc = start - discharged(charge, 0.5, battery.pack_capacity(temperature))
        r0, r1, c1 = battery.circuit(soc, temperature)
        cell_ohm = r0 + r1 * (1 - np.exp(-c.step_time / 2 / (r1 * c1)))
    else:
        low, high = by_temperature[0][[0, -1]]
        if not low <= temperature <= high:
            result.notes.append(
                f"{ride.name}: cells at {temperature:.0f} degC, outside the tests' {low:.0f} to {high:.0f}, left out"
            )
            return None
        cell_ohm = float(np.exp(np.interp(temperature, *by_temperature)))
    cells = battery.cells_series / battery.cells_parallel * cell_ohm
    return step[big], drop[big], np.full(int(big.sum()), cells)


def cell_steps(pulses: Sequence[Measurements]) -> tuple[Array, Array]:
    """(temperatures [degC], logarithms of the resistance [ohm] that a cell shows 0.2 s after a step of current).

    By temperature; the median over states of charge above 0.1 of the charge passed. InputError for tests without steps.
    """
    rows = []
    for pulse in pulses:
        time, current, voltage = pulse["time"], pulse["current"], pulse["voltage"]
        charge = held_integral(time, current)
        ohm = []
        for k in np.flatnonzero(np.abs(np.diff(current)) > 0.3 * np.max(np.abs(current))):
            after = int(np.searchsorted(time, time[k + 1] + 0.5 * RIDE.step_time - 1e-6))  # mean age of a ride's steps
            if after == len(time) or time[after] > time[k + 1] + RIDE.step_time:
                continue
            steady = abs(current[after] - current[k + 1]) < 0.05 * abs(current[k + 1] - current[k])
            if steady and charge[k] < 0.9 * charge.max():
                ohm.append(-(voltage[after] - voltage[k]) / (current[after] - current[k]))
        if len(ohm) < 5:
            raise pulse.error(
                f"{len(ohm)} steps of current followed by a sample within {RIDE.step_time:g} s are too few"
            )
        rows.append((float(np.mean(pulse["cell_temperature"])), float(np.log(np.median(ohm)))))
    temperature, logarithm = np.array(sorted(rows)).T
    return temperature, logarithm
