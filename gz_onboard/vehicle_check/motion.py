"""Speeds, odometer and positions against each other; accelerations and turning against the speed.

Each source of the way that was ridden is compared with one speed. The scale on which most independent sources agree is
taken as right: all wheels together are one source, for they need the file's radius. A wrong sign or size is reported
once and then corrected, so that later checks accuse nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.constants import EARTH_RADIUS, GRAVITY
from gz_onboard.estimator.plausibility.motion import AXLE, GROUND
from gz_onboard.estimator.plausibility.residual import CONFIG
from gz_onboard.events import SPEEDS
from gz_onboard.model.sensors import speed_factors
from gz_onboard.vehicle import Vehicle
from gz_onboard.vehicle_check.finding import Expected, Finding, Looks, Roles, right, unknown, wrong
from gz_onboard.vehicle_check.seconds import FEWEST, SECOND, Seconds, rate, relation, unit_of

BY_WAYS, BY_FILE = "ways against each other", "wheel radius and gear ratio"
WHEELS = ("motor_speed", "wheel_speed_rear", "wheel_speed_front")
ODOMETER, POSITIONS = "odometer", "positions"
PLACE = ("latitude", "longitude")


@dataclass(frozen=True)
class MotionCheckConfig:
    """Tolerances. Recorded rides: 29 are within 0.8 % of the GPS, three with soft tyres 1.1 %."""

    apart: float = 0.04  # relative, of two ways that agree
    odometer_apart: float = 0.05  # relative, and twice its steps
    shortest_m: float = 300.0  # way that is compared
    odometer_steps: int = 5  # at least
    stretch_s: int = 10  # over which the shape of positions is compared with the speed
    misfit: float = 0.05  # relative: 17 recorded rides have 0.01 to 0.03, exchanged positions 0.06 to 0.97
    level_m_s2: float = 2.5  # by which gravity on an axis may be off, by bias, mounting and hills
    swing_m_s2: float = 0.25  # standard deviation of an acceleration that shows something
    turning_rad_s: float = 0.03  # likewise, of a yaw rate
    close: float = 0.4  # correlation: hills, bends and shaking are in an accelerometer too
    rough: float = 0.2  # relative tolerance of a unit told by accelerations


SETTINGS = MotionCheckConfig()
FORWARD = ("accel_x",)
TURNING = Expected(
    "turning against course",
    ("rate_z", "gps_course"),
    SETTINGS.close,
    (0.6, 1.6),
    sign="the sign of one; rate_z is positive to the left, the course to the right",
    hidden="too noisy",
)


@dataclass
class Speeds:
    """Speeds [m/s] by role, (n,), without the mistakes that were found. sure: sources agree on their size."""

    speeds: dict[str, Array]
    findings: list[Finding] = field(default_factory=list)
    sure: bool = True
    bench: bool = False  # the driven axle turns, the ground stands

    @property
    def best(self) -> str | None:
        """The speed that others are compared with."""
        wrong_roles = {role for one in self.findings if one.looks is Looks.WRONG for role in one.roles}
        return min(self.speeds, key=lambda role: role in wrong_roles, default=None)


def check_speeds(ride: Seconds, vehicle: Vehicle) -> Speeds:
    """Compare all that shows the way that was ridden."""
    p = vehicle.parameters
    factors = speed_factors(p["wheel_radius"], p["gear_ratio"])
    found = Speeds({role: factors[role] * ride[role] for role in ride.any_of(*SPEEDS)})
    for role, speed in found.speeds.items():
        if float(np.nanmean(speed)) < -CONFIG.speed_sd_m_s:
            found.findings.append(wrong("speed's sign", (role,), "is negative while riding: give scale = -1"))
            found.speeds[role] = -speed
    if found.speeds:
        pivot = next(role for role in ("wheel_speed_rear", *SPEEDS) if role in found.speeds)
        _compare(ride, found, pivot, vehicle)
        for role, speed in found.speeds.items():
            if found.sure and (top := float(np.nanmax(np.abs(speed)))) > CONFIG.fastest_m_s:
                found.findings.append(wrong("speed", (role,), f"reaches {3.6 * top:.0f} km/h"))
    elif set(PLACE) <= ride.columns.keys():
        found.findings += _poles(ride)
    return found


def _compare(ride: Seconds, found: Speeds, pivot: str, vehicle: Vehicle) -> None:
    """Judge each way over that of the speed `pivot`, and correct the speeds."""
    reference, roles = np.abs(found.speeds[pivot]), tuple(found.speeds)
    ratios = {pivot: 1.0}
    for role in roles:
        ratio = _way_over(np.abs(found.speeds[role]), reference)
        if ratio is not None:
            ratios[role] = ratio
    seconds = int(np.sum(np.max(np.abs(np.nan_to_num(list(found.speeds.values()))), axis=0) > CONFIG.moving_m_s))
    if seconds < FEWEST:
        text = f"the vehicle moves for {seconds} s in this log, and {FEWEST} s are needed"
        found.findings.append(unknown(BY_WAYS, roles, text))
        found.findings += _poles(ride)
        return
    ground = [role for role in ratios if role in GROUND]
    if ground and pivot in AXLE and (len(ground) > 1 or "vehicle_speed" not in ratios):
        found.bench = all(float(np.nanmean(np.abs(found.speeds[role]))) < CONFIG.speed_sd_m_s for role in ground)
    if found.bench:
        found.findings.append(unknown(BY_WAYS, roles, "the driven axle turns and the ground stands: a roller bench"))
        return
    tolerances = dict.fromkeys(ratios, SETTINGS.apart)
    for name, way in (
        (ODOMETER, _odometer(ride, found, pivot, reference)),
        (POSITIONS, _positions(ride, found, pivot, reference)),
    ):
        if way:
            ratios[name], tolerances[name] = way
    agreeing = [
        [other for other in ratios if abs(ratios[other] / ratios[name] - 1) < tolerances[other]]
        for name in ratios
        if name != ODOMETER  # its steps are too coarse to be a reference
    ]
    if len(ratios) < 2:
        found.findings.append(unknown(BY_WAYS, roles, "there is no other way to compare it with"))
        return
    inside = max(agreeing, key=lambda names: (len(_independent(names)), len(names)))
    if len(_independent(inside)) > 1 or len(_independent(ratios)) == 1:
        _outliers(found, pivot, ratios, inside, vehicle)
    else:
        _undecided(found, pivot, ratios, vehicle)


def _independent(names: Mapping[str, float] | list[str]) -> set[str]:
    return {"wheels" if name in WHEELS else name for name in names}


def _way_over(speed: Array, reference: Array) -> float | None:
    """The way by `speed` over that by `reference`, both (n,) [m/s]; None if they are seldom there together."""
    known = np.isfinite(speed) & np.isfinite(reference)
    moving = known & (np.maximum(speed, reference) > CONFIG.moving_m_s)
    if moving.sum() < FEWEST or not reference[moving].sum():
        return None
    return float(speed[moving].sum() / reference[moving].sum())


def _roles_of(name: str) -> Roles:
    return PLACE if name == POSITIONS else (name,)


def _outliers(found: Speeds, pivot: str, ratios: dict[str, float], inside: list[str], vehicle: Vehicle) -> None:
    """Report what disagrees with the sources `inside`, and correct it."""
    p, scale = vehicle.parameters, float(np.median([ratios[name] for name in inside]))
    wheels = [name for name in WHEELS if name in ratios]
    lost = [name for name in wheels if name not in inside]
    others = " and ".join(inside)
    if len(inside) > 1:
        spread = max(ratios[name] for name in inside) / min(ratios[name] for name in inside) - 1
        roles = tuple(role for name in inside for role in _roles_of(name))
        found.findings.append(right(BY_WAYS, roles, f"{others} agree within {spread:.1%}"))
    together = len(lost) > 1 and max(ratios[name] for name in lost) / min(ratios[name] for name in lost) < 1.04
    for name in ratios.keys() - set(inside):
        off = ratios[name] / scale
        roles, unit = _roles_of(name), unit_of(name, off) if name != POSITIONS else ""
        text = f"{name} is {off:.3g} times {others}"
        if name not in wheels or (unit and not together) or (name != "motor_speed" and len(lost) < len(wheels)):
            found.findings.append(wrong(BY_WAYS, roles, text + unit))
        elif len(lost) < len(wheels):
            gear = p["gear_ratio"]
            hint = f"{gear / off:.4g} would fit, or the scale of {name} is wrong"
            found.findings.append(wrong(BY_FILE, roles, f"by the file's gear_ratio {gear:.4g} {text}; {hint}"))
        elif name == pivot or not together:
            named, length = "wheel_radius", p["wheel_radius"]
            if wheels == ["motor_speed"]:
                named, length = "wheel_radius times gear_ratio", length * p["gear_ratio"]
            hint = "" if together else f", or the scale of {name} is wrong"
            text = f"by the file's {named} {length:.4g} m {text}; {length / off:.4g} m would fit{hint}"
            found.findings.append(wrong(BY_FILE, () if together else roles, text))
    for role in found.speeds:
        if role in ratios:
            right_ratio = 1.0 if role in inside else scale / ratios[role]
            found.speeds[role] = found.speeds[role] * right_ratio


def _undecided(found: Speeds, pivot: str, ratios: dict[str, float], vehicle: Vehicle) -> None:
    """Report sources of which no two agree."""
    found.sure = False
    low, high = (f(ratios, key=lambda name: ratios[name]) for f in (min, max))
    off = ratios[high] / ratios[low]
    shown = ", ".join(f"{name} {ratio:.3g}" for name, ratio in ratios.items())
    text = f"they contradict each other, and none decides: in proportion {shown}"
    hint = "" if POSITIONS in (low, high) else unit_of(high, off)
    other = [name for name in ratios if name not in WHEELS]
    if not hint and len(other) == 1 and pivot in WHEELS:
        fits = vehicle.parameters["wheel_radius"] * ratios[other[0]]
        hint = f"; wheel_radius {fits:.4g} m would fit, or gear_ratio or a scale is wrong"
    looks = unknown if set(other) == {ODOMETER} and off < 1 + CONFIG.odometer_sd else wrong
    roles = tuple(role for name in ratios for role in _roles_of(name))
    found.findings.append(looks(BY_WAYS, roles, text + hint))


def _odometer(ride: Seconds, found: Speeds, pivot: str, speed: Array) -> tuple[float, float] | None:
    """(way of the odometer over that by `speed` (n,) [m/s], tolerance); None if it cannot be compared."""
    if ODOMETER not in ride:
        return None
    known = np.isfinite(ride[ODOMETER]) & np.isfinite(speed)
    steps = np.diff(ride[ODOMETER][known])
    counts, ridden = steps[steps > 0], float(speed[known].sum()) * SECOND
    counted, largest = float(counts.sum()), float(counts.max(initial=0.0))
    if (steps < -1.0).any():
        found.findings.append(wrong(ODOMETER, (ODOMETER,), "counts back"))
    elif max(counted, ridden) < max(SETTINGS.shortest_m, SETTINGS.odometer_steps * largest) or (
        not counted and ridden < 2500
    ):
        found.findings.append(unknown(ODOMETER, (ODOMETER,), f"{ridden:.0f} m are too few for its steps"))
    elif not counted:
        found.findings.append(wrong(ODOMETER, (ODOMETER,), f"stands while {pivot} goes {ridden / 1e3:.1f} km"))
    elif ridden:
        return counted / ridden, max(SETTINGS.odometer_apart, 2 * largest / counted)
    return None


def _positions(ride: Seconds, found: Speeds, pivot: str, speed: Array) -> tuple[float, float] | None:
    """(way of the positions over that by `speed` (n,) [m/s], tolerance); None if it cannot be compared."""
    if not set(PLACE) <= ride.columns.keys():
        return None
    if poles := _poles(ride):
        found.findings += poles
        return None
    latitude, longitude = (ride[role] for role in PLACE)
    moving = np.isfinite(latitude) & np.isfinite(longitude) & (np.nan_to_num(speed) > CONFIG.moving_m_s)
    both = moving[:-1] & moving[1:]
    by_speed = np.where(both, (speed[:-1] + speed[1:]) / 2, 0.0) * SECOND
    steps, exchanged = (_steps(a, b, both) for a, b in ((latitude, longitude), (longitude, latitude)))
    off, off_exchanged = _misfit(steps, by_speed), _misfit(exchanged, by_speed)
    ridden, way = float(by_speed.sum()), float(steps.sum())
    text = f"{pivot} goes {ridden / 1e3:.2f} km, the positions {way / 1e3:.2f} km"
    if ridden < SETTINGS.shortest_m:
        found.findings.append(unknown(POSITIONS, PLACE, f"{ridden:.0f} m were ridden with positions"))
    elif off > SETTINGS.misfit and off_exchanged < off / 2:
        said = f"in stretches of {SETTINGS.stretch_s} s they are {off:.0%} off, and exchanged {off_exchanged:.0%}"
        found.findings.append(wrong(POSITIONS, PLACE, f"swapped: {said}"))
    elif way < SETTINGS.shortest_m / 10:
        found.findings.append(wrong(POSITIONS, PLACE, f"stuck: {text}"))
    else:
        return way / ridden, SETTINGS.apart
    return None


def _poles(ride: Seconds) -> list[Finding]:
    """There is no latitude beyond the poles."""
    if not set(PLACE) <= ride.columns.keys():
        return []
    most, other = (float(np.nanmax(np.abs(ride[role]))) for role in PLACE)
    if most <= 90.0:
        return []
    why = "swapped with the longitude" if other <= 90.0 else "a wrong scale in the DBC file, or unit"
    return [wrong(POSITIONS, PLACE, f"the latitude reaches {most:.1f}°, beyond the poles: {why}")]


def _steps(latitude: Array, longitude: Array, moving: Mask) -> Array:
    """The way [m] (n - 1,) from each position [deg] to the next, 0 where it is not `moving` (n - 1,)."""
    north = np.radians(np.diff(latitude)) * EARTH_RADIUS
    east = np.radians(np.diff(longitude)) * EARTH_RADIUS * np.cos(np.radians(latitude[:-1]))
    return np.where(moving, np.hypot(north, east), 0.0)


def _misfit(steps: Array, ridden: Array) -> float:
    """Mean relative difference of two ways (n,) [m] in stretches, both scaled to one length in all.

    A wrong scale of the speed makes none, exchanged positions do wherever the ride turns: a degree to the north and one
    to the east are not of one length. 0 of fewer than five stretches.
    """
    count = len(steps) // SETTINGS.stretch_s
    ways = (x[: count * SETTINGS.stretch_s].reshape(count, SETTINGS.stretch_s).sum(axis=1) for x in (steps, ridden))
    way, by_speed = ways
    if np.count_nonzero(by_speed) < 5 or not way.sum():
        return 0.0
    return float(np.abs(way * by_speed.sum() / way.sum() - by_speed).sum() / by_speed.sum())


# --- accelerations and turning ----------------------------------------------------------------------------------------


def check_accelerations(ride: Seconds, speeds: Speeds) -> Iterator[Finding]:
    """Gravity on the vertical axis alone; the forward axis against the change of speed."""
    for role, gravity in (("accel_x", 0.0), ("accel_y", 0.0), ("accel_z", GRAVITY)):
        if role not in ride:
            continue
        mean, level = float(np.nanmean(ride[role])), SETTINGS.level_m_s2
        text = f"shows {mean:.2f} m/s² in the mean"
        if abs(mean - gravity) < level:
            if gravity:
                yield right("gravity", (role,), f"{text}, up")
        elif gravity and abs(mean + gravity) < level:
            yield wrong("gravity", (role,), f"{text}: its sign, scale = -1")
        elif gravity and abs(mean - 1) < 0.2:
            yield wrong("gravity", (role,), f"{text}: g taken for m/s²")
        elif not gravity and abs(abs(mean) - GRAVITY) < level:
            yield wrong("gravity", (role,), f"{text}: the vertical axis, swapped")
        else:
            yield wrong("gravity", (role,), f"{text}, where {gravity:.1f} is expected")
    if speeds.best and "accel_x" in ride:
        yield _forward(ride, speeds, speeds.best)


def _forward(ride: Seconds, speeds: Speeds, best: str) -> Finding:
    change, roles = rate(speeds.speeds[best]), ("accel_x", best)
    blamed = FORWARD if speeds.sure else roles
    expected = Expected(
        "acceleration against speed",
        roles,
        SETTINGS.close,
        (0.6, 1.7),
        blamed=blamed,
        hidden="hills and shaking hide it",
    )
    found = relation(change, ride["accel_x"]) if np.nanstd(change) > SETTINGS.swing_m_s2 else None
    if found is None:
        return unknown(expected.check, roles, "the speed hardly changes, or they are not there together")
    sideways = relation(change, ride["accel_y"]) if "accel_y" in ride else None
    if sideways and abs(sideways.correlation) > max(SETTINGS.close, abs(found.correlation) + 0.3):
        text = "accel_y goes with the change of speed, and accel_x does not: swapped"
        return wrong(expected.check, ("accel_x", "accel_y"), text)
    text = f"goes with the change of {best}, factor {found.factor:.2f}, correlation {found.correlation:.2f}"
    return expected.judge(found.correlation, found.factor, text, unit_of("accel_x", found.factor, SETTINGS.rough))


def check_turning(ride: Seconds, speeds: Speeds) -> Iterator[Finding]:
    """The yaw rate against the change of course."""
    if not {"rate_z", "gps_course"} <= ride.columns.keys() or not speeds.best:
        return
    fast = np.abs(speeds.speeds[speeds.best]) > 2 * CONFIG.moving_m_s
    turning = -rate(ride["gps_course"])
    turning = np.where(np.abs(turning) < 1.0, turning, np.nan)
    found = relation(turning, ride["rate_z"], fast)
    if found is None or float(np.nanstd(turning[fast])) < SETTINGS.turning_rad_s:
        yield unknown(TURNING.check, TURNING.roles, "too few bends with a GPS course")
        return
    text = f"factor {found.factor:.2f}, correlation {found.correlation:.2f}"
    yield TURNING.judge(found.correlation, found.factor, text, unit_of("rate_z", found.factor))
