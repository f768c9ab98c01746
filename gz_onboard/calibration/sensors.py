"""Wheel radius, auxiliary power, errors of the pack's sensors and resistances outside the cells, out of rides.

Two sensors show where they differ, not which one errs: without a third the gain found is that of the pack against the
inverter's, and its sd is that of a sensor's class. Absolute numbers are of a vehicle of size 1 (see `sizes_of`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gz_onboard.arrays import Array, Mask, block_means, held_integral
from gz_onboard.calibration.fit import as_groups, line, linear, score
from gz_onboard.calibration.result import Found, LackingError, Panel, PlotLine, Result, compared
from gz_onboard.calibration.table import Measurements
from gz_onboard.errors import InputError
from gz_onboard.events import LOADS
from gz_onboard.priors import sizes_of
from gz_onboard.recording.recording import Recording
from gz_onboard.recording.sensors import speed_role, true_columns
from gz_onboard.vehicle import Vehicle


@dataclass(frozen=True)
class RideConfig:
    """Which samples of a ride count, and standard deviations of sensors by their class."""

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
    min_voltage_offset_sd: float = 0.01  # V that two voltage sensors of a pack may differ by, however alike they read
    # resistances
    cable_window: float = 1.0  # s
    cable_span: float = 10.0  # A, for a line
    voltage_gain_sd: float = 1e-3  # of each sensor: a gain over the sag of the pack looks like resistance
    step_time: float = 0.2  # s
    min_step: float = 15.0  # A
    fewest_steps: int = 20
    warm: float = 20.0  # degC: below the cells' resistance is many times that of bars and fuse
    cells_sd: float = 0.05  # of the cells' resistance, from cell to cell and from table to step


RIDE = RideConfig()
TURNING = ("motor_speed", "wheel_speed_rear")  # what turns with the driven wheel, the first that there is
PACK = {"pack_current", "pack_voltage"}
PAIRED = PACK | {"inverter_current", "inverter_voltage", "motor_speed", "motor_current"}
AUXILIARY = {"auxiliary_current", "pack_voltage"}
LAGS = np.arange(-0.3, 0.31, 0.05)  # s: how far one set of sensors may lag the other


# --- wheel radius --------------------------------------------------------------------------------------------------


def wheel_radius(rides: Sequence[Recording], vehicle: Vehicle) -> Result:
    """wheel_radius [m], the mean over the rides that have GPS and steady riding.

    At steady speed the wheel's slip is small and a lag of the receiver does no harm. What slip there is belongs to the
    radius: it is the one that turns motor speed into the vehicle's speed. By motor_speed, of rides without it by
    wheel_speed_rear. Raises LackingError if no ride has both.
    """
    result = Result("wheel")
    lines, turning = [], set()
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
        turning.add(role)
        lines.append(PlotLine(ride.name, wheel, over_ground / wheel, "."))
    if not lines:
        raise LackingError(f"no ride tells the wheel's radius: {'; '.join(result.refusals) or 'none given'}")
    each, n = np.array([np.median(line.y) for line in lines]), len(lines)
    radius = float(np.mean(each))
    spread = float(np.std(each, ddof=1)) if n > 1 else 3 * RIDE.receiver_sd * radius
    sd = float(np.hypot(spread / np.sqrt(n), RIDE.receiver_sd * radius))
    channel = f"gps_speed over {' and '.join(sorted(turning))}"
    source = (
        f"{', '.join(line.label for line in lines)}: {channel}, {sum(len(line.x) for line in lines)} fixes at steady "
        f"speed, {each.min():.4f} to {each.max():.4f} m; slip of the driven wheel included"
    )
    result.parameters["wheel_radius"] = Found(radius, sd, "m", source, channel)
    ends = np.array([RIDE.slowest / radius, max(float(line.x.max()) for line in lines)])
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


# --- readings of pack and inverter ---------------------------------------------------------------------------------


class PackReadings(NamedTuple):
    """Readings of one ride at the times of the pack's current, each (n,) in s, A or V.

    inverter, inverter_voltage: with the lag taken off; without the inverter's sensors no current and the pack's
    voltage. others: currents of lamps and control, heater and air conditioner. rest: whether the vehicle stands without
    load. lag: of the pack's sensors behind the inverter's [s].
    """

    name: str
    time: Array
    pack: Array
    pack_voltage: Array
    inverter: Array
    inverter_voltage: Array
    others: Array
    rest: Mask
    lag: float

    def means(self, values: Array, seconds: float) -> Array:
        """Means of `values` over windows of that length: timing counts less."""
        return block_means(values, max(round(seconds / max(float(np.median(np.diff(self.time))), 1e-3)), 1))

    def mean_at_rest(self, values: Array) -> float:
        """The mean of `values` (n,) while the vehicle rests."""
        return float(values[self.rest].mean())

    def noise(self, values: Array) -> float:
        """The sd of a sample, out of differences of neighbours that both are at rest."""
        both = self.rest[1:] & self.rest[:-1]
        return float(np.std(np.diff(values)[both]) / np.sqrt(2)) if both.sum() > 5 else float("nan")


def read_pack(ride: Recording, vehicle: Vehicle, auxiliary: float | None = None) -> PackReadings:
    """The readings of a ride with `PACK`.

    auxiliary: power [W] of lamps and control of a ride without auxiliary_current; the vehicle file's if None. Pack
    current less the others is the inverter's DC current; the inverter's own small consumption at rest does not show in
    its reading, but is in the pack's. InputError for a ride with neither the inverter's sensors nor a speed.
    """
    p, size = vehicle.parameters, sizes_of(vehicle).current
    time, pack = ride.columns["pack_current"]

    def at(role: str, lag: float = 0.0) -> Array:
        return np.interp(time - lag, *ride.columns[role])

    voltage = at("pack_voltage")
    if "auxiliary_current" in ride.columns:
        others = at("auxiliary_current")
    else:
        others = (p["auxiliary_power"] if auxiliary is None else auxiliary) / np.maximum(voltage, 1.0)
    for load in LOADS:
        if load in ride.columns:
            others = others + at(load) / np.maximum(voltage, 1.0)
    if not ride.columns.keys() >= PAIRED:
        role, factor = speed_role(ride.name, ride.columns, p)
        still = np.abs(at(role)) * factor < RIDE.standing
        return PackReadings(ride.name, time, pack, voltage, np.zeros_like(pack), voltage, others, still, 0.0)
    lag = float(min(LAGS, key=lambda x: float(np.std(pack - others - at("inverter_current", x)))))
    inverter = at("inverter_current", lag)
    rest = (np.abs(at("motor_speed")) < RIDE.moving) & (np.abs(at("motor_current")) < RIDE.driving * size)
    rest &= np.abs(inverter) < RIDE.fed * size
    return PackReadings(ride.name, time, pack, voltage, inverter, at("inverter_voltage", lag), others, rest, lag)


def _missing_sensors(rides: Sequence[Recording]) -> str:
    """Which of `PAIRED` no ride has."""
    return ", ".join(sorted(PAIRED.difference(*(ride.columns for ride in rides))))


# --- auxiliary power -----------------------------------------------------------------------------------------------


def auxiliary_power(rides: Sequence[Recording], vehicle: Vehicle) -> Result:
    """auxiliary_power [W]: lamps, dashboard and control, the mean over the rides, each counting once (eq. 2.19).

    By the auxiliary current; if no ride has it, by the pack's power at standstill less the inverter's own and what
    heating and cooling take. The brake light is in it as often as these riders braked. The sd is that of a ride to
    come, and of the sensor or the inverter's own. LackingError if no ride has either.
    """
    result, p, means = Result("auxiliary"), vehicle.parameters, []
    by_current = any(ride.columns.keys() >= AUXILIARY for ride in rides)
    if not by_current:
        result.notes.append("no ride has auxiliary_current: taken from the pack's power at standstill instead")
    for ride in rides:
        if missing := sorted((AUXILIARY if by_current else PACK) - ride.columns.keys()):
            result.notes.append(f"{ride.name}: no {missing[0]}, left out")
        elif by_current:
            time, current = ride.columns["auxiliary_current"]
            means.append(float(np.mean(current * np.interp(time, *ride.columns["pack_voltage"]))))
        else:
            reading = read_pack(ride, vehicle, auxiliary=0.0)
            power = reading.pack_voltage * (reading.pack - reading.inverter - reading.others)
            if reading.rest.sum() >= RIDE.fewest_rest:
                means.append(float(np.median(power[reading.rest])) - p["inverter_loss_constant"])
    if not means:
        raise LackingError("no ride has auxiliary_current, and none stands still with pack_voltage and pack_current")
    value = float(np.mean(means))
    if value <= 0:
        sign = "auxiliary_current must be positive when consuming, pack_current when discharging"
        raise InputError(f"auxiliary power is {value:.3g} W: {sign}")
    spread = float(np.std(means, ddof=1)) if len(means) > 1 else (0.05 if by_current else 0.2) * value
    sensor = RIDE.shunt_sd * value if by_current else p.sd("inverter_loss_constant")
    source = f"{len(means)} rides, {min(means):.1f} to {max(means):.1f} W"
    source += "" if by_current else ": pack power at standstill less the inverter's own"
    channel = f"{'auxiliary_current' if by_current else 'pack_current'} times pack_voltage"
    result.parameters["auxiliary_power"] = Found(value, float(np.hypot(spread, sensor)), "W", source, channel)
    return result


# --- sensors of the pack -------------------------------------------------------------------------------------------


def offsets(rides: Sequence[Recording], vehicle: Vehicle) -> Result:
    """pack_current_offset, pack_current_gain, both noises and pack_voltage_offset of the pack's sensors.

    If no ride has the inverter's sensors: both noises, and of rides with auxiliary_current the offset, at standstill.
    LackingError if no ride stands still long enough.
    """
    sizes, result = sizes_of(vehicle), Result("offsets")
    paired = [ride for ride in rides if ride.columns.keys() >= PAIRED]
    used = paired or [ride for ride in rides if ride.columns.keys() >= PACK]
    if not paired:
        result.notes.append(f"no ride has {_missing_sensors(rides)}: taken from the pack's sensors at standstill")
    elif left_out := [ride.name for ride in rides if not ride.columns.keys() >= PAIRED]:
        result.notes.append(f"{', '.join(left_out)}: left out; needed are {', '.join(sorted(PAIRED))}")
    readings = [read_pack(ride, vehicle) for ride in used]
    resting = [reading for reading in readings if reading.rest.sum() >= RIDE.fewest_rest]
    if not resting:
        raise LackingError(
            f"no ride with {' and '.join(sorted(PACK))} stands without load for {RIDE.fewest_rest} samples; offsets "
            "show at rest"
        )
    named = {ride.name for ride in used if paired or "auxiliary_current" in ride.columns}
    _offset(result, [reading for reading in resting if reading.name in named], vehicle, bool(paired))
    for name, unit, noises in (
        ("pack_current_noise", "A", [reading.noise(reading.pack) for reading in resting]),
        ("pack_voltage_noise", "V", [reading.noise(reading.pack_voltage) for reading in resting]),
    ):
        sd = float(np.std(noises, ddof=1)) if len(noises) > 1 else 0.2 * noises[0]
        source = f"first differences at rest, {len(noises)} rides, white"
        result.parameters[name] = Found(float(np.median(noises)), max(sd, 1e-4), unit, source)
    if not paired:
        result.refusals.append(
            "pack_current_gain, pack_voltage_offset: need inverter_current and inverter_voltage; what the file says "
            "stays"
        )
        return result
    _gain(result, readings, RIDE.gain_span * sizes.current)
    volts = float(np.mean([x.mean_at_rest(x.pack_voltage - x.inverter_voltage) for x in resting]))
    result.parameters["pack_voltage_offset"] = Found(
        0.0,
        max(abs(volts), RIDE.min_voltage_offset_sd * sizes.voltage),
        "V",
        f"reads {volts:+.3f} V over the inverter's at rest, {len(resting)} rides; which one errs is unknown",
    )
    result.refusals.append(
        f"pack_voltage_offset: {volts:+.3f} V between two sensors is all that the data tell, not which one "
        "errs; left at zero with that sd"
    )
    lags = [reading.lag for reading in readings]
    result.notes.append(
        f"pack's sensors lag the inverter's by {np.median(lags):.2f} s ({min(lags):.2f} to {max(lags):.2f})"
    )
    return result


def _offset(result: Result, resting: Sequence[PackReadings], vehicle: Vehicle, paired: bool) -> None:
    """pack_current_offset of rides at rest. The sd is that of a ride to come.

    Besides the scatter from ride to ride, the inverter's own loss and the auxiliary sensor's class are in it.
    """
    if not resting:
        result.refusals.append(
            "pack_current_offset: needs inverter_current, or auxiliary_current at standstill; what the file says stays"
        )
        return
    p, sizes = vehicle.parameters, sizes_of(vehicle)
    loss, loss_sd = p["inverter_loss_constant"], p.sd("inverter_loss_constant")
    differences = np.array([x.mean_at_rest(x.pack - x.inverter - x.others) for x in resting])
    inverter_own = np.array([loss / x.mean_at_rest(x.pack_voltage) for x in resting])
    spread = (
        float(np.std(differences - inverter_own, ddof=1)) if len(differences) > 1 else RIDE.first_spread * sizes.current
    )
    scatter = max(spread, RIDE.drift_sd * sizes.current)
    auxiliary = RIDE.shunt_sd * RIDE.auxiliary * sizes.auxiliary / sizes.voltage
    sd = float(np.hypot(scatter, loss_sd / resting[0].pack_voltage.mean()) + auxiliary)
    source = (
        f"{len(resting)} rides at rest: pack less {'inverter less ' if paired else ''}auxiliary is "
        f"{differences.mean():+.3f} ± {spread:.3f} A, {inverter_own.mean():.3f} A of it the inverter's own {loss:.1f} W"
    )
    channel = f"pack_current less {'inverter_current and ' if paired else ''}auxiliary_current at rest"
    result.parameters["pack_current_offset"] = Found(
        float(np.mean(differences - inverter_own)), sd, "A", source, channel
    )


def _gain(result: Result, readings: Sequence[PackReadings], min_span: float) -> None:
    """The pack's current over inverter's and auxiliary together, by ride, if they span `min_span` [A]."""
    name = "pack_current_gain"
    rows = [[x.means(column, RIDE.window) for column in (x.inverter + x.others, x.pack)] for x in readings]
    (x, y), labels = (np.concatenate(c) for c in zip(*rows, strict=True)), _labels([row[0] for row in rows])
    if np.ptp(x) < min_span:
        result.refusals.append(f"{name}: currents of {x.min():.1f} to {x.max():.1f} A only tell no gain")
        return
    found, model = line(name, x, y, as_groups(labels))
    source = f"{len(readings)} rides, {len(x)} means of {RIDE.window:g} s, against inverter and auxiliary current"
    result.parameters[name] = found.found(name, "1", source, RIDE.gain_sd, "pack_current over inverter_current")
    result.refusals.append(
        f"{name}: {found[name]:.4f} ± {found.sd(name):.4f} is the ratio of "
        f"two sensors; which one errs is unknown, so that its sd holds a sensor's class of {100 * RIDE.gain_sd:.1f} %"
    )
    result.fits.append(score("pack current", "A", y, model, held_out=False, source=source))
    title, x_label = "Pack current against inverter and auxiliary", "inverter and auxiliary current [A]"
    residual = PlotLine("means of 2 s", x, y - model, ".")
    result.panels.append(Panel(title, x_label, "pack current less line [A]", (residual,)))


def _labels(columns: Sequence[Array]) -> Array:
    """The number of the ride of each sample."""
    return np.repeat(np.arange(len(columns)), [len(column) for column in columns])


# --- resistances outside the cells ---------------------------------------------------------------------------------


def resistances(rides: Sequence[Recording], vehicle: Vehicle, pulses: Sequence[Measurements] = ()) -> Result:
    """cable_resistance, of the rides with the inverter's sensors, and with `pulses` pack_series_resistance of all."""
    result = Result("resistance")
    if with_inverter := [ride for ride in rides if ride.columns.keys() >= PAIRED]:
        result.add(cable_resistance(with_inverter, vehicle))
    else:
        result.refusals.append(
            f"cable_resistance: needs {_missing_sensors(rides)}, which no ride has; the value of the file stays"
        )
    if pulses:
        result.add(pack_series_resistance(rides, vehicle, pulses))
    else:
        result.refusals.append(
            "pack_series_resistance: needs pulse tests of a cell (pulses), which tell the cells' part; the value of "
            "the file stays"
        )
    return result


def cable_resistance(rides: Sequence[Recording], vehicle: Vehicle) -> Result:
    """cable_resistance [ohm]: voltage of pack less inverter over the inverter's current, a line with a free offset.

    Raises InputError for rides without current.
    """
    result, name = Result("resistance"), "cable_resistance"
    rows = []
    for reading in (read_pack(ride, vehicle) for ride in rides):
        drop = reading.pack_voltage - reading.inverter_voltage
        rows.append([reading.means(x, RIDE.cable_window) for x in (reading.inverter, drop, reading.pack_voltage)])
    (i, v, pack), label = (np.concatenate(c) for c in zip(*rows, strict=True)), _labels([row[0] for row in rows])
    span = RIDE.cable_span * sizes_of(vehicle).current
    if np.ptp(i) < span:
        raise InputError(
            f"{rides[0].name}: inverter_current of {i.min():.1f} to {i.max():.1f} A spans too little for a resistance; "
            f"{span:g} A are needed"
        )
    found, model = line(name, i, v, as_groups(label))
    if found[name] < -3 * found.sd(name):
        raise InputError(f"{rides[0].name}: inverter_voltage rises over pack_voltage with current: a sign is wrong")
    source = f"{len(rides)} rides, {len(i)} means of 1 s, pack less inverter voltage over inverter current"
    fit = score("voltage between pack and inverter", "V", v, model, held_out=False, source=source)
    result.fits.append(fit)
    gains = 2**0.5 * RIDE.voltage_gain_sd * abs(line("sag", i, pack)[0]["sag"])
    source += f"; {found['offset']:+.3f} V at no current"
    channel, sd = "pack_voltage less inverter_voltage over inverter_current", float(np.hypot(found.sd(name), gains))
    result.parameters[name] = Found(max(found[name], 0.0), sd, "ohm", source, channel)
    y_label = "pack less inverter voltage [V]"
    result.panels += compared("Voltage between pack and inverter", "current [A]", y_label, i, v, model)
    return result


def pack_series_resistance(rides: Sequence[Recording], vehicle: Vehicle, pulses: Sequence[Measurements]) -> Result:
    """pack_series_resistance [ohm]: 0.2 s steps of warm rides less those of the cells alone.

    pulses: pulse tests of a cell at two temperatures or more, with `time`, `current`, `voltage` and `cell_temperature`:
    their steps of the same length are the cells' part. Raises InputError if there are too few large steps. Gives a
    refusal instead of a number where the cells' own doubt is greater than the rest.
    """
    c, result, name = RIDE, Result("resistance"), "pack_series_resistance"
    by_temperature, min_step = cell_steps(pulses), c.min_step * sizes_of(vehicle).current
    of_rides = [_ride_steps(ride, vehicle, by_temperature, min_step, result) for ride in rides]
    steps = [columns for columns in of_rides if columns is not None]
    count = sum(len(di) for di, _, _ in steps)
    if count < c.fewest_steps:
        raise InputError(
            f"{count} steps of more than {min_step:g} A within {c.step_time:g} s above {c.warm:g} degC are "
            f"too few for {name}; {c.fewest_steps} are needed"
        )
    di, dv, cell = (np.concatenate(column) for column in zip(*steps, strict=True))
    found = linear({"series": di}, dv - cell * di, groups=as_groups(_labels([di for di, _, _ in steps])))
    value, sd = found["series"], float(np.hypot(found.sd("series"), c.cells_sd * float(cell.mean())))
    whole = linear({"whole": di}, dv)["whole"]
    source = (
        f"{len(di)} steps above {min_step:g} A within {c.step_time:g} s of {len(steps)} rides above {c.warm:g} degC: "
        f"{1e3 * whole:.1f} mohm, less {1e3 * cell.mean():.1f} mohm of the pulse tests' steps"
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
    ride: Recording, vehicle: Vehicle, by_temperature: tuple[Array, Array], min_step: float, result: Result
) -> tuple[Array, Array, Array] | None:
    """(steps of current [A], falls of voltage [V], the cells' part of the resistance [ohm]) of a ride, each (m,).

    None for a ride without steps above `min_step` [A], or at a temperature at which the cells' part is too large or not
    known.
    """
    c, battery = RIDE, vehicle.pack
    if "cell_temperature" not in ride.columns:
        raise InputError(f"{ride.name}: no cell_temperature, without which the cells' part of a step is unknown")
    temperature = float(ride.columns["cell_temperature"][1].mean())
    low, high = max(c.warm, by_temperature[0][0]), by_temperature[0][-1]
    if not low <= temperature <= high:
        result.notes.append(
            f"{ride.name}: cells at {temperature:.0f} degC, left out: {low:.0f} to {high:.0f} degC are needed"
        )
        return None
    columns = true_columns(ride.columns, vehicle.parameters)
    time, current = columns["pack_current"]
    voltage = np.interp(time, *columns["pack_voltage"])
    stride = max(round(c.step_time / float(np.median(np.diff(time)))), 1)
    step, drop = current[stride:] - current[:-stride], -(voltage[stride:] - voltage[:-stride])
    big = np.abs(step) > min_step
    if not big.any():
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
