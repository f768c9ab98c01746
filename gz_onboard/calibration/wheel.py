"""Effective rolling radius of the driven wheel: speed over ground against motor speed, on rides.

At steady speed the wheel's slip is small and a lag of the receiver does no harm. What slip there is belongs to the
radius: it is the one that turns motor speed into the vehicle's speed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.calibration.result import Fit, Found, LackingError, Panel, PlotLine, Result
from gz_onboard.recording.recording import Recording
from gz_onboard.recording.sensors import true_columns
from gz_onboard.vehicle import Vehicle

SLOWEST = 5.0  # m/s: below, a receiver's speed is poor
STEADY = 0.15  # m/s²
LONGEST = 2.0  # s either side, over which it must be steady
FEWEST = 60  # fixes of a ride
TURNING = ("motor_speed", "wheel_speed_rear")  # rad/s: what turns with the driven wheel, the first that there is
RECEIVER = 0.002  # relative: Doppler speed of a receiver in the open


def calibrate(rides: Sequence[Recording], vehicle: Vehicle) -> Result:
    """wheel_radius [m] of the rides that have GPS and steady riding; each ride held out once shows how it differs.

    By motor_speed, of rides without it by wheel_speed_rear. Raises LackingError if no ride has both.
    """
    result = Result("wheel")
    radii: list[float] = []
    names: list[str] = []
    traces: list[PlotLine] = []
    count, turning = 0, set()
    for ride in rides:
        role = next((role for role in TURNING if role in ride.columns), None)
        if "gps_speed" not in ride.columns or role is None:
            result.refusals.append(f"{ride.name}: has no gps_speed or no motor_speed, nor a {TURNING[1]} instead")
            continue
        if role != TURNING[0]:
            result.notes.append(f"{ride.name}: no {TURNING[0]}, taken by {role} instead")
        gear = vehicle.parameters["gear_ratio"] if role == TURNING[0] else 1.0
        over_ground, wheel = _steady(true_columns(ride.columns, vehicle.parameters), role, gear)
        if len(wheel) < FEWEST:
            result.refusals.append(
                f"{ride.name}: {len(wheel)} fixes at steady speed above {SLOWEST:g} m/s; {FEWEST} needed"
            )
            continue
        ratio = over_ground / wheel
        radii.append(float(np.median(ratio)))
        names.append(ride.name)
        turning.add(role)
        count += len(wheel)
        traces.append(PlotLine(ride.name, wheel, ratio, "."))
    if not radii:
        raise LackingError(f"no ride tells the wheel's radius: {'; '.join(result.refusals) or 'none given'}")
    radius = float(np.mean(radii))
    spread = float(np.std(radii, ddof=1)) if len(radii) > 1 else 3 * RECEIVER * radius
    sd = float(np.hypot(spread / np.sqrt(len(radii)), RECEIVER * radius))
    channel = f"gps_speed over {' and '.join(sorted(turning))}"
    source = (
        f"{', '.join(names)}: {channel}, {count} fixes at steady speed, {min(radii):.4f} to "
        f"{max(radii):.4f} m; slip of the driven wheel included"
    )
    result.parameters["wheel_radius"] = Found(radius, sd, "m", source, channel)
    if len(radii) > 1:
        left = np.array([r - (radius * len(radii) - r) / (len(radii) - 1) for r in radii])
        rms, largest = float(np.sqrt(np.mean(left**2))), float(np.abs(left).max())
        data = f"each of {', '.join(names)} left out"
        result.fits.append(Fit("wheel radius", "m", rms, largest, None, len(radii), True, data))
    ends = np.array([SLOWEST, max(float(t.x.max()) * radius for t in traces)]) / radius
    lines = *traces, PlotLine("radius", ends, np.full(2, radius))
    result.panels.append(Panel("Speed over ground by wheel speed", "speed of the driven wheel [rad/s]", "m", lines))
    return result


def _steady(columns: Mapping[str, tuple[Array, Array]], role: str, gear: float) -> tuple[Array, Array]:
    """(GPS speed [m/s], speed of the driven wheel [rad/s]) at fixes within steady riding, by `gear` times `role`."""
    time, speed = columns["gps_speed"]
    at, motor = columns[role]
    good = (speed > SLOWEST) & (time > at[0] + LONGEST) & (time < at[-1] - LONGEST)
    if "gps_fix" in columns:
        good &= np.interp(time, *columns["gps_fix"]) > 1.5
    if not good.any():
        return np.empty(0), np.empty(0)
    time, speed = time[good], speed[good]
    # The wheel's mean over the second before: a receiver reports late, and smoothed.
    turned = np.concatenate([[0.0], np.cumsum(np.diff(at) * (motor[1:] + motor[:-1]) / 2)])
    wheel = np.interp(time, at, turned) - np.interp(time - 1.0, at, turned)
    around = np.array([np.interp(time + shift, time, speed) for shift in (-LONGEST, 0.0, LONGEST)])
    quick = np.array([np.interp(time + shift, at, motor) for shift in (-LONGEST, -LONGEST / 2, 0.0, LONGEST)])
    slow = np.ptp(quick, axis=0) / np.mean(quick, axis=0) * speed / (2 * LONGEST) < STEADY
    steady = slow & (np.ptp(around, axis=0) / (2 * LONGEST) < STEADY)
    return speed[steady], wheel[steady] * gear
