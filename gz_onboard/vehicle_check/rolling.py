"""Whether the wheel radius and the gear ratio of the vehicle file are those of the log.

Motor and wheel speed become a speed by them alone. So a wrong one makes all of them wrong by one factor, and together
they outvote the GPS. What else has seen the way, positions or odometer, says which of the two is wrong.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.estimator.plausibility.residual import CONFIG
from gz_onboard.vehicle import Vehicle
from gz_onboard.vehicle_check.finding import Finding, Looks, wrong
from gz_onboard.vehicle_check.motion import way_over_odometer, way_over_positions
from gz_onboard.vehicle_check.seconds import FEWEST, Seconds, unit_of

APART = 0.04  # relative: 29 recorded rides are within 0.8 % of the GPS, three with soft tyres 1.1 %
ALIKE = 0.025  # relative: so near each other two ways are the same; odometers err by more than positions
STEADY, MOST_STEADY = 0.1, 0.8  # relative: a factor is one if it is so near in so many of the seconds
CHECK = "wheel radius and gear ratio"
MOTOR, WHEEL, GPS = "motor_speed", "wheel_speed_rear", "gps_speed"


@dataclass(frozen=True)
class Rolling:
    """What is wrong, and every speed [m/s] by role as the radius and gear ratio that fit have it."""

    speeds: dict[str, Array]
    findings: list[Finding] = field(default_factory=list)

    def by_what_fits(self, findings: Iterable[Finding]) -> list[Finding]:
        """Those found with `speeds`: what looks right only does so with another file says so."""
        if not any(one.check == CHECK for one in self.findings):
            return list(findings)
        said = f"; by {CHECK} as the log has them"
        return [replace(one, text=one.text + said) if one.looks is Looks.RIGHT else one for one in findings]


def rolling_of(ride: Seconds, speeds: dict[str, Array], vehicle: Vehicle) -> Rolling:
    """What motor and driven wheel, by the file, say against each other and the GPS; speeds [m/s] by role, (n,)."""
    radius, gear = (vehicle.parameters[name] for name in ("wheel_radius", "gear_ratio"))
    motor, wheel, gps = (speeds.get(role) for role in (MOTOR, WHEEL, GPS))
    slip = _factor(motor, wheel)
    driven = WHEEL if wheel is not None else MOTOR
    x = _factor(speeds.get(driven), gps)
    if slip is not None and abs(slip - 1) > APART:
        if (x is None or abs(x - 1) < APART) and not unit_of(MOTOR, slip):
            text = (
                f"by the file's gear_ratio {gear:.4g} {MOTOR} is {slip:.3g} times {WHEEL}; {gear / slip:.4g} would fit"
            )
            text += f", or the scale of {MOTOR if x else 'one of the two'} is wrong"
            finding = wrong(CHECK, (MOTOR,) if x else (MOTOR, WHEEL), text)
            return Rolling({**speeds, MOTOR: speeds[MOTOR] / slip}, [finding])
        return Rolling(speeds)
    if x is None or abs(x - 1) < APART:
        return Rolling(speeds)
    for_gps, for_wheel = _witnesses(ride, speeds[driven], x)
    named, length = ("wheel_radius", radius) if driven == WHEEL else ("wheel_radius times gear_ratio", radius * gear)
    text = f"by the file's {named} {length:.4g} m {driven} is {x:.3g} times {GPS}"
    units = unit_of(driven, x), unit_of(GPS, 1 / x)
    if "positions" in for_wheel:
        text = f"{text}, and the positions agree with {driven}"
        return Rolling(speeds, [] if units[1] else [wrong("speed against GPS", (GPS,), text)])
    if units[0] or (units[1] and not for_gps):
        return Rolling(speeds)  # a mistaken unit: the speeds against each other say so
    text += f"; {length / x:.4g} m would fit"
    roles: tuple[str, ...] = ()
    if for_gps:
        text += f", by {' and '.join(for_gps)} too"
        if slip is None:  # else two sensors would have to be wrong by one factor
            text, roles = f"{text}, or the scale of {driven} is wrong", (driven,)
    else:
        text += f", or the scale of {GPS} is wrong"
        text += f", as the odometer agrees with {driven}" if for_wheel else ": nothing else has seen the way"
        roles = (driven, GPS)
    fits = {role: speed if role in ("vehicle_speed", GPS) else speed / x for role, speed in speeds.items()}
    return Rolling(fits, [wrong(CHECK, roles, text)])


def _factor(speed: Array | None, other: Array | None) -> float | None:
    """What `speed` is times `other`, both (n,) [m/s], in the median; None if they have no one factor."""
    if speed is None or other is None:
        return None
    a, b = np.abs(speed), np.abs(other)
    moving = (a > CONFIG.moving_m_s) & (b > CONFIG.moving_m_s)
    if moving.sum() < FEWEST:
        return None
    ratios = a[moving] / b[moving]
    middle = float(np.median(ratios))
    return middle if float(np.mean(np.abs(ratios / middle - 1) < STEADY)) > MOST_STEADY else None


def _witnesses(ride: Seconds, speed: Array, x: float) -> tuple[list[str], list[str]]:
    """What has seen the way that the GPS speed has, and that of `speed` [m/s] (n,), which is `x` times the GPS'."""
    for_gps, for_wheel = [], []
    for name, ratio in ("positions", way_over_positions(ride, speed)), ("odometer", way_over_odometer(ride, speed)):
        if ratio is None:
            continue
        if abs(ratio / x - 1) < min(ALIKE, abs(ratio - 1)):
            for_gps.append(name)
        elif abs(ratio - 1) < ALIKE:
            for_wheel.append(name)
    return for_gps, for_wheel
