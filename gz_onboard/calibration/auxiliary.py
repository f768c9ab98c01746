"""Power of lamps, dashboard and control out of rides (Lord 2016, eq. 2.19): auxiliary current times pack voltage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gz_onboard.arrays import Array, Mask, held_at
from gz_onboard.calibration.fit import score
from gz_onboard.calibration.result import Found, LackingError, Panel, PlotLine, Result
from gz_onboard.errors import InputError
from gz_onboard.events import LOADS
from gz_onboard.recording.recording import Recording
from gz_onboard.recording.sensors import speed_role
from gz_onboard.vehicle import Vehicle

NEEDED = ("auxiliary_current", "pack_voltage")
PACK = ("pack_voltage", "pack_current")
STANDING, LEAST_STANDING = 0.05, 20  # m/s; samples at rest of a ride
CURRENT_SD = 0.01  # of the current, relative: a shunt's calibration


def auxiliary_power(rides: Sequence[Recording], vehicle: Vehicle) -> Result:
    """auxiliary_power [W] by the auxiliary current; of rides that lack it, by the pack's power at standstill.

    Raises InputError if no ride has either.
    """
    if any(set(NEEDED) <= ride.columns.keys() for ride in rides):
        return by_auxiliary_current(rides)
    return at_standstill(rides, vehicle)


def at_standstill(rides: Sequence[Recording], vehicle: Vehicle) -> Result:
    """auxiliary_power [W] as the pack's power while the vehicle stands, less the inverter's own and what a heater and
    an air conditioner take. Its sd is of a ride to come, with that of the inverter's own. LackingError without one.
    """
    result, p = Result("auxiliary"), vehicle.parameters
    result.notes.append("no ride has auxiliary_current: taken from the pack's power at standstill instead")
    means = []
    for ride in rides:
        columns = ride.columns
        if missing := [role for role in PACK if role not in columns]:
            result.notes.append(f"{ride.name}: no {missing[0]}, left out")
            continue
        still, power = standing(ride, p)
        if still.sum() >= LEAST_STANDING:
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


def standing(ride: Recording, p: Mapping[str, float]) -> tuple[Mask, Array]:
    """(whether the vehicle stands; the pack's power [W] less the inverter's own, a heater's and an air conditioner's).

    At the times of the pack's current, (n,). InputError for a ride without a speed.
    """
    role, factor = speed_role(ride.name, ride.columns, p)
    time, current = ride.columns["pack_current"]
    power = current * np.interp(time, *ride.columns["pack_voltage"]) - p["inverter_loss_constant"]
    for load in LOADS:
        if load in ride.columns:
            power = power - np.interp(time, *ride.columns[load])
    return np.abs(np.interp(time, *ride.columns[role])) * factor < STANDING, power


def by_auxiliary_current(rides: Sequence[Recording]) -> Result:
    """auxiliary_power [W]: its mean over the rides, each counting once.

    The brake light makes it one of two values; the mean holds it as often as these riders braked. The sd is that of one
    ride's mean, and of the sensor. Raises InputError if no ride has the auxiliary current.
    """
    result = Result("auxiliary")
    rows = []  # mean, without and with brake light, share of the light, and samples of each ride
    names = []
    for ride in rides:
        if missing := [role for role in NEEDED if role not in ride.columns]:
            result.notes.append(f"{ride.name}: no {missing[0]}, left out")
            continue
        time, current = ride.columns["auxiliary_current"]
        power = current * np.interp(time, *ride.columns["pack_voltage"])
        light = _light(ride, time)
        rows.append((power.mean(), _mean(power[~light]), _mean(power[light]), light.mean(), len(power)))
        names.append(ride.name)
    if not rows:
        raise InputError("no ride has auxiliary_current and pack_voltage, which the auxiliary power comes from")
    mean, without, lit, share, points = np.array(rows).T
    value = float(mean.mean())
    if value <= 0:
        raise InputError(f"{names[0]}: auxiliary power is {value:.3g} W: the current must be positive when consuming")
    spread = float(mean.std(ddof=1)) if len(mean) > 1 else 0.05 * value
    sd = float(np.hypot(spread, CURRENT_SD * value))
    source = f"{len(mean)} rides, {int(points.sum())} samples"
    if np.isfinite(lit).any():
        off, on = float(np.nanmean(without)) if np.isfinite(without).any() else np.nan, float(np.nanmean(lit))
        result.notes.append(
            f"{off:.1f} W without, {on:.1f} W with brake light, which shone {100 * share.mean():.0f} % of the time"
        )
        source += f"; {off:.1f} W, {on:.1f} W with brake light"
    else:
        result.refusals.append("auxiliary power of the brake light: no ride has brake_switch with the brake on")
    result.parameters["auxiliary_power"] = Found(value, sd, "W", source, "auxiliary_current times pack_voltage")
    if len(mean) > 1:
        others = np.array([np.delete(mean, k).mean() for k in range(len(mean))])
        by = f"each of {len(mean)} rides by the others"
        result.fits.append(score("auxiliary power, mean of a ride", "W", mean, others, held_out=True, source=by))
    x = np.arange(len(mean), dtype=float)
    marks = PlotLine("without brake light", x, without, "."), PlotLine("with brake light", x, lit, ".")
    mean_line = PlotLine("mean", x, np.full(len(x), value))
    result.panels.append(Panel("Auxiliary power", "ride", "power [W]", (*marks, mean_line)))
    return result


def _mean(values: Array) -> float:
    return float(values.mean()) if len(values) > 9 else float("nan")


def _light(ride: Recording, time: Array) -> Mask:
    """Whether the brake light shone at each of `time`; it did not if the ride has no brake switch."""
    if "brake_switch" not in ride.columns:
        return np.zeros(len(time), dtype=bool)
    return np.asarray(held_at(time, *ride.columns["brake_switch"]) > 0.5)
