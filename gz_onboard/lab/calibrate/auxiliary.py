"""Power of lamps, dashboard and control out of rides (Lord 2016, eq. 2.19): auxiliary current times pack voltage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gz_onboard.arrays import Array, Mask, held_at
from gz_onboard.errors import InputError
from gz_onboard.lab.calibrate.fit import score
from gz_onboard.lab.calibrate.result import Found, Panel, PlotLine, Result
from gz_onboard.offline.samples import Samples

NEEDED = ("auxiliary_current", "pack_voltage")
CURRENT_SD = 0.01  # of the current, relative: a shunt's calibration


def auxiliary_power(rides: Sequence[Samples]) -> Result:
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
    result.parameters["auxiliary_power"] = Found(value, sd, "W", source)
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


def _light(ride: Samples, time: Array) -> Mask:
    """Whether the brake light shone at each of `time`; it did not if the ride has no brake switch."""
    if "brake_switch" not in ride.columns:
        return np.zeros(len(time), dtype=bool)
    return np.asarray(held_at(time, *ride.columns["brake_switch"]) > 0.5)
