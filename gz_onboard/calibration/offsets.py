"""Sensors of the pack: offset, gain and noise of current and voltage, at rest and against the inverter's.

Pack current less auxiliary current is the inverter's DC current; the inverter's own small consumption at rest does not
show in its reading, but is in the pack's. Two sensors show where they differ, not which one errs: without a third the
gain found is that of the pack against the inverter's, and its sd is that of a sensor's class.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gz_onboard.arrays import Array, Mask, block_means
from gz_onboard.calibration.auxiliary import CURRENT_SD, PACK, standing
from gz_onboard.calibration.fit import as_groups, every_second, line, score
from gz_onboard.calibration.result import Found, LackingError, Panel, PlotLine, Result
from gz_onboard.errors import InputError
from gz_onboard.priors import sizes_of
from gz_onboard.recording.recording import Recording
from gz_onboard.vehicle import Vehicle

NEEDED = "pack_current pack_voltage inverter_current inverter_voltage motor_speed motor_current"
LAGS = np.arange(-0.3, 0.31, 0.05)  # s: what one set of sensors may lag the other
# Of a vehicle of size 1, as all currents here:
MOVING, DRIVING, FED = 0.3, 3.0, 2.0  # rad/s and A of the motor, A of the inverter: below is rest
LEAST_SPAN = 5.0  # A, for a gain
LEAST_REST = 20  # samples
LEAST_APART = 0.01  # V, that two voltage sensors of a pack may differ by, however alike they read
WINDOW = 2.0  # s: means over that separate gains from timing
DRIFT_SD, FIRST_SPREAD = 0.02, 0.05  # A of a current sensor's zero from day to day: the least believed; of one ride
AUXILIARY = 0.85  # A of lamps and control, by which the auxiliary sensor's class counts
GAIN_SD = 0.007  # of a current sensor of 1 % class


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


def read_pair(ride: Recording, vehicle: Vehicle) -> Pair:
    """The readings of pack and inverter at the same times, their lag taken off. InputError for what is missing."""
    for role in NEEDED.split():
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
    speed, current = np.abs(at("motor_speed")), np.abs(at("motor_current"))
    inverter, inverter_voltage = at("inverter_current", lag), at("inverter_voltage", lag)
    size = sizes_of(vehicle).current
    rest = (speed < MOVING) & (current < DRIVING * size) & (np.abs(inverter) < FED * size)
    return Pair(ride.name, time, pack, inverter, auxiliary, at("pack_voltage"), inverter_voltage, rest, lag)


def offsets(rides: Sequence[Recording], vehicle: Vehicle) -> Result:
    """pack_current_offset, pack_current_gain, both noises and pack_voltage_offset of the pack's sensors.

    Of rides that all lack the inverter's, see `at_standstill`. Raises InputError if none stands still for `LEAST_REST`
    samples.
    """
    if not rides:
        raise InputError("no ride, which sensor offsets come from")
    pairs = [read_pair(ride, vehicle) for ride in rides if set(NEEDED.split()) <= ride.columns.keys()]
    if not pairs:
        return at_standstill(rides, vehicle)
    resting = [pair for pair in pairs if pair.rest.sum() >= LEAST_REST]
    if not resting:
        raise InputError(f"{pairs[0].name}: no ride stands without load for {LEAST_REST} samples; offsets show at rest")
    p, sizes, result = vehicle.parameters, sizes_of(vehicle), Result("offsets")
    if left_out := [ride.name for ride in rides if ride.name not in {pair.name for pair in pairs}]:
        result.notes.append(f"{', '.join(left_out)}: left out; needed are {NEEDED.replace(' ', ', ')}")
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
    _gain(result, pairs, LEAST_SPAN * sizes.current)
    _noises(result, [(_noise(pair.pack, pair.rest), _noise(pair.pack_voltage, pair.rest)) for pair in resting])
    volts = np.array([(pair.pack_voltage - pair.inverter_voltage)[pair.rest].mean() for pair in resting])
    result.parameters["pack_voltage_offset"] = Found(
        0.0,
        float(max(abs(volts.mean()), LEAST_APART * sizes.voltage)),
        "V",
        f"reads {volts.mean():+.3f} V over the inverter's at rest, {len(resting)} rides; which one errs is unknown",
    )
    result.refusals.append(
        f"pack_voltage_offset: {volts.mean():+.3f} V between two sensors is all that the data tell, not which one "
        "errs; left at zero with that sd"
    )
    lags = [pair.lag for pair in pairs]
    result.notes.append(
        f"pack's sensors lag the inverter's by {np.median(lags):.2f} s ({min(lags):.2f} to {max(lags):.2f})"
    )
    return result


def at_standstill(rides: Sequence[Recording], vehicle: Vehicle) -> Result:
    """Both noises and, of rides with auxiliary_current, pack_current_offset, while the vehicle stands.

    Raises LackingError if no ride has pack_voltage and pack_current and stands for `LEAST_REST` samples.
    """
    result, p = Result("offsets"), vehicle.parameters
    lacking = sorted(set(NEEDED.split()).difference(*(ride.columns for ride in rides)))
    missing = f"no ride has all of {', '.join(NEEDED.split())}" + (
        f" (none has {', '.join(lacking)})" if lacking else ""
    )
    noises, apart, volts = [], [], 1.0
    for ride in rides:
        if not set(PACK) <= ride.columns.keys():
            continue
        (still, power), (time, current) = standing(ride, p), ride.columns["pack_current"]
        if still.sum() < LEAST_REST:
            continue
        voltage = np.interp(time, *ride.columns["pack_voltage"])
        noises.append((_noise(current, still), _noise(voltage, still)))
        if "auxiliary_current" in ride.columns:
            volts = float(voltage[still].mean())
            over = power / voltage - np.interp(time, *ride.columns["auxiliary_current"])
            apart.append(float(over[still].mean()))
    if not noises:
        raise LackingError(f"{missing}, nor stands for {LEAST_REST} samples with {' and '.join(PACK)}")
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
    spread = float(np.std(offsets, ddof=1)) if len(offsets) > 1 else FIRST_SPREAD * sizes.current
    own = vehicle.parameters.sd("inverter_loss_constant") / volts
    auxiliary = AUXILIARY * sizes.auxiliary / sizes.voltage
    return spread, float(np.hypot(max(spread, DRIFT_SD * sizes.current), own) + CURRENT_SD * auxiliary)


def _noises(result: Result, noises: Sequence[tuple[float, float]]) -> None:
    """pack_current_noise [A] and pack_voltage_noise [V] out of those of each ride."""
    columns = np.array(noises).T
    for (name, unit), column in zip((("pack_current_noise", "A"), ("pack_voltage_noise", "V")), columns, strict=True):
        sd = float(column.std(ddof=1)) if len(column) > 1 else 0.2 * float(column.mean())
        result.parameters[name] = Found(
            float(np.median(column)), max(sd, 1e-4), unit, f"first differences at rest, {len(column)} rides, white"
        )


def window_means(pair: Pair, values: Array, seconds: float) -> Array:
    """Means of `values` over windows of that length: timing counts less."""
    count = max(round(seconds / max(float(np.median(np.diff(pair.time))), 1e-3)), 1)
    return block_means(values, count)


def _gain(result: Result, pairs: Sequence[Pair], least: float) -> None:
    """The pack's current over inverter's and auxiliary together, by ride, if they span `least` [A]."""
    total = [window_means(pair, pair.inverter + pair.auxiliary, WINDOW) for pair in pairs]
    pack = [window_means(pair, pair.pack, WINDOW) for pair in pairs]
    x, y = np.concatenate(total), np.concatenate(pack)
    labels = np.concatenate([np.full(len(column), k) for k, column in enumerate(total)])
    if np.ptp(x) < least:
        result.refusals.append(f"pack_current_gain: currents of {x.min():.1f} to {x.max():.1f} A only tell no gain")
        return
    fitted = every_second(labels)
    found, model, outside = line("pack_current_gain", x, y, fitted, as_groups(labels))
    source = f"{len(pairs)} rides, {len(x)} means of {WINDOW:g} s, against inverter and auxiliary current"
    result.parameters["pack_current_gain"] = found.found(
        "pack_current_gain", "1", source, GAIN_SD, "pack_current over inverter_current"
    )
    result.refusals.append(
        f"pack_current_gain: {found['pack_current_gain']:.4f} ± {found.sd('pack_current_gain'):.4f} is the ratio of "
        f"two sensors; which one errs is unknown, so that its sd holds a sensor's class of {100 * GAIN_SD:.1f} %"
    )
    result.fits += [
        score("pack current", "A", y, model, held_out=False, source=source),
        score("pack current", "A", y[~fitted], outside[~fitted], held_out=True, source="every second ride"),
    ]
    left, title = PlotLine("means of 2 s", x, y - model, "."), "Pack current against inverter and auxiliary"
    panel = Panel(title, "inverter and auxiliary current [A]", "pack current less line [A]", (left,))
    result.panels.append(panel)


def _noise(values: Array, rest: Mask) -> float:
    """The sd of a sample, out of differences of neighbours that both are at rest."""
    both = rest[1:] & rest[:-1]
    return float(np.std(np.diff(values)[both]) / np.sqrt(2)) if both.sum() > 5 else float("nan")
