"""Whether what a log says of the motion fits together: speeds, odometer, positions, accelerations, turning."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.constants import EARTH_RADIUS, GRAVITY
from gz_onboard.estimator.plausibility.motion import AXLE, GROUND, vote
from gz_onboard.estimator.plausibility.residual import CONFIG
from gz_onboard.events import SPEEDS
from gz_onboard.model.sensors import speed_factors
from gz_onboard.vehicle import Vehicle
from gz_onboard.vehicle_check.finding import Finding, right, unknown, wrong
from gz_onboard.vehicle_check.seconds import FEWEST, SECOND, Seconds, rate, relation, too_little, unit_of

ROLLING = AXLE | {"wheel_speed_front"}  # their speed is by the radius
BENCH = "a roller bench"
SIGN = "speed's sign"
SHORTEST = 300.0  # m, over which two distances are compared
STRETCH = 10  # s, over which positions are compared with a speed
FEW = 5  # stretches at least
UNLIKE = 0.05  # relative: on 17 recorded rides the way of a stretch was 1 to 3 % off, exchanged 6 to 97 %
POLE = 90.0  # deg
COUNTS = 5  # steps of the odometer, likewise
ODOMETER_ERRS = 0.05  # relative: so far it may be off the way by what it counts, and more by a wrong radius
EXACT = 0.01  # of its way: an odometer of no greater steps tells a few percent
LEVEL = 2.5  # m/s²: by so much the gravity that an axis shows may be off, by bias, mounting and hills
SWINGS = 0.25  # m/s²: an acceleration that moves by less, as a standard deviation, shows nothing
CLOSE = 0.4  # a correlation from here on is one: hills, bends and shaking are in an accelerometer too
FACTORS = (0.6, 1.7)  # of an acceleration, likewise
ROUGH = 0.2  # relative: of a factor of accelerations
TURNING = 0.03  # rad/s
TURN_FACTORS = (0.6, 1.6)


def speeds_of(ride: Seconds, vehicle: Vehicle) -> dict[str, Array]:
    """Every speed of the ride [m/s] by role, (n,)."""
    p = vehicle.parameters
    factors = speed_factors(p["wheel_radius"], p["gear_ratio"])
    return {role: factors[role] * ride[role] for role in ride.any_of(*SPEEDS)}


def check_speeds(ride: Seconds, speeds: dict[str, Array]) -> Iterator[Finding]:
    """The speeds by majority, as on board, in their mean over what was ridden."""
    check = "speeds against each other"
    for role, speed in speeds.items():
        top = float(np.nanmax(np.abs(speed)))
        if top > CONFIG.fastest_m_s:
            yield wrong("speed", (role,), f"reaches {3.6 * top:.0f} km/h by the radius and gear ratio of the file")
        if float(np.nanmean(speed)) < -CONFIG.speed_sd_m_s:
            yield wrong(SIGN, (role,), "is negative while riding: give scale = -1")
    known = np.all(np.isfinite(list(speeds.values())), axis=0) if speeds else np.zeros(0, dtype=bool)
    moving = (
        known & (np.max(np.abs(list(speeds.values())), axis=0, initial=0.0) > CONFIG.moving_m_s) if speeds else known
    )
    roles = tuple(speeds)
    if moving.sum() < FEWEST:
        if roles:
            fastest = np.max(np.abs(np.nan_to_num(list(speeds.values()))), axis=0)
            yield unknown(check, roles, too_little(fastest, " and ".join(roles)))
        return
    means = {role: float(np.mean(np.abs(speed[moving]))) for role, speed in speeds.items()}
    if len(roles) < 2:
        yield unknown(check, roles, "there is no other speed to compare it with")
        return
    if _on_bench(means):
        yield unknown(check, roles, f"the driven axle turns and the ground stands: {BENCH}")
        return
    apart = {role: CONFIG.speed_sd_m_s / 2 + CONFIG.speed_sd_relative * mean for role, mean in means.items()}
    outvoted, tied = vote(means, apart, spins=False)
    yield from _speed_verdicts(check, means, outvoted, tied)


def _on_bench(means: dict[str, float]) -> bool:
    """Whether the driven axle turns and all else stands; means: of each speed [m/s]."""
    ground = [role for role in means if role in GROUND]
    stands = all(means[role] < CONFIG.speed_sd_m_s for role in ground) and bool(AXLE & means.keys())
    return stands and (len(ground) > 1 or not means.keys() - AXLE - set(ground))


def _speed_verdicts(
    check: str, means: dict[str, float], outvoted: frozenset[str], tied: frozenset[str]
) -> Iterator[Finding]:
    others = {role: mean for role, mean in means.items() if role not in outvoted}
    if tied:
        shown = ", ".join(f"{role} {3.6 * mean:.1f} km/h" for role, mean in means.items())
        a, b = min(means, key=lambda role: means[role]), max(means, key=lambda role: means[role])
        like = unit_of(b, means[b] / means[a]) if means[a] > 0 else ""
        yield wrong(
            check, tuple(sorted(tied)), f"they contradict each other, and none decides: {shown} in the mean{like}"
        )
        return
    middle = float(np.median(list(others.values())))
    for role in sorted(outvoted):
        ratio = means[role] / middle
        yield wrong(check, (role,), f"shows {ratio:.3g} times what {', '.join(others)} show{unit_of(role, ratio)}")
    if len(others) > 1:
        spread = max(others.values()) / min(others.values()) - 1
        yield right(check, tuple(others), f"{' and '.join(others)} agree within {spread:.1%}")


def _steps(latitude: Array, longitude: Array, moving: Mask) -> Array:
    """The way [m] (n - 1,) from each position [deg] to the next, 0 where it is not `moving` (n,)."""
    north = np.radians(np.diff(latitude)) * EARTH_RADIUS
    east = np.radians(np.diff(longitude)) * EARTH_RADIUS * np.cos(np.radians(latitude[:-1]))
    return np.where(moving[:-1] & moving[1:], np.hypot(north, east), 0.0)


def _misfit(steps: Array, ridden: Array) -> float:
    """How far the way by positions is off that by the speed (n,) [m], stretch by stretch, in the mean, relative.

    Of both as long in all: a wrong scale of the speed makes none. To the north and to the east the way is in degrees of
    unlike lengths, so exchanged positions have one wherever the ride turns. 0 of fewer than `FEW` stretches.
    """
    count = len(steps) // STRETCH
    way, by_speed = (x[: count * STRETCH].reshape(count, STRETCH).sum(axis=1) for x in (steps, ridden))
    if np.count_nonzero(by_speed) < FEW or not way.sum():
        return 0.0
    return float(np.abs(way * by_speed.sum() / way.sum() - by_speed).sum() / by_speed.sum())


def check_distances(
    ride: Seconds, speeds: dict[str, Array], doubted: frozenset[str], radius: float | None = None
) -> Iterator[Finding]:
    """The way by the best speed against that of the odometer and of the positions; radius: of the driven wheel [m]."""
    best = next((role for role in speeds if role not in doubted), next(iter(speeds), None))
    if {"latitude", "longitude"} <= ride.columns.keys():
        yield from _poles(ride["latitude"], ride["longitude"])
    if best is None:
        return
    speed = np.abs(speeds[best])
    if "odometer" in ride:
        alone = best in ROLLING and not {"gps_speed", "latitude"} & ride.columns.keys()
        yield from _odometer(ride["odometer"], best, speed, radius if alone else None)
    if {"latitude", "longitude"} <= ride.columns.keys() and float(np.nanmax(np.abs(ride["latitude"]))) <= POLE:
        yield from _positions(ride, best, speed)


def _counts(odometer: Array, speed: Array) -> tuple[Array, float, bool]:
    """(steps forward of the odometer [m], way by the speed [m], whether both are enough to compare); both (n,)."""
    known = np.isfinite(odometer) & np.isfinite(speed)
    steps = np.diff(odometer[known])
    counts = steps[steps > 0]
    counted, ridden = float(counts.sum()), float(speed[known].sum()) * SECOND
    largest = float(counts.max()) if len(counts) else 0.0
    few = max(counted, ridden) < max(SHORTEST, COUNTS * largest) or (not len(counts) and ridden < 2500)
    return counts, ridden, not few


def way_over_odometer(ride: Seconds, speed: Array) -> float | None:
    """The way by the speed (n,) [m/s] over that of the odometer; None if too little of it was seen, or it is faulty."""
    if "odometer" not in ride or (np.diff(ride["odometer"]) < -1.0).any():
        return None
    counts, ridden, enough = _counts(ride["odometer"], np.abs(speed))
    exact = len(counts) and float(counts.max()) < EXACT * float(counts.sum())
    return ridden / float(counts.sum()) if enough and exact else None


def _odometer(odometer: Array, best: str, speed: Array, radius: float | None) -> Iterator[Finding]:
    """radius: of the wheel [m], if nothing but the odometer tells whether it is right."""
    check, roles = "speed against odometer", (best, "odometer")
    if (np.diff(odometer[np.isfinite(odometer) & np.isfinite(speed)]) < -1.0).any():
        yield wrong("odometer", ("odometer",), "counts back")
        return
    counts, ridden, enough = _counts(odometer, speed)
    counted, largest = float(counts.sum()), float(counts.max()) if len(counts) else 0.0
    if not enough:
        yield unknown(check, roles, f"{ridden:.0f} m are too few for its steps")
        return
    if not counted:
        yield wrong(check, ("odometer",), f"stands while {best} goes {ridden / 1e3:.1f} km")
        return
    ratio = ridden / counted
    text = f"{best} goes {ridden / 1e3:.2f} km, the odometer {counted / 1e3:.2f} km"
    off = abs(ridden - counted)
    if off <= max(CONFIG.odometer_sd * max(ridden, counted), 2 * largest):
        if radius is None or off <= max(ODOMETER_ERRS * max(ridden, counted), 2 * largest):
            yield right(check, roles, text)
            return
        name = "gear_ratio" if best == "motor_speed" else f"the scale of {best}"
        fits = f"wheel_radius {radius / ratio:.4g} m would fit in place of {radius:.4g} m; or {name}"
        yield unknown(check, roles, f"{text}: {fits} or the odometer is wrong, and no GPS tells which")
    else:
        yield wrong(check, roles, f"{text}, {ratio:.3g} times{unit_of(best, ratio) or unit_of('odometer', 1 / ratio)}")


def _poles(latitude: Array, longitude: Array) -> Iterator[Finding]:
    """There is no latitude beyond the poles."""
    most, other = (float(np.nanmax(np.abs(x))) for x in (latitude, longitude))
    if most > POLE:
        why = "swapped with the longitude" if other <= POLE else "a wrong scale in the DBC file, or unit"
        yield wrong(
            "positions", ("latitude", "longitude"), f"the latitude reaches {most:.1f}°, beyond the poles: {why}"
        )


def _where(ride: Seconds, speed: Array) -> tuple[Array, Mask]:
    """(the way [m] (n - 1,) by `speed` (n,) from each position to the next, 0 where it does not move; where it does)"""
    known = np.isfinite(ride["latitude"]) & np.isfinite(ride["longitude"]) & np.isfinite(speed)
    moving = known & (speed > CONFIG.moving_m_s)
    return np.where(moving[:-1] & moving[1:], (speed[:-1] + speed[1:]) / 2, 0.0) * SECOND, moving


def way_over_positions(ride: Seconds, speed: Array) -> float | None:
    """The way by the speed (n,) [m/s] over that of the positions; None if too little was seen, or they do not fit."""
    if not {"latitude", "longitude"} <= ride.columns.keys():
        return None
    by_speed, moving = _where(ride, np.abs(speed))
    steps = _steps(ride["latitude"], ride["longitude"], moving)
    if by_speed.sum() < SHORTEST or steps.sum() < SHORTEST or _misfit(steps, by_speed) > UNLIKE:
        return None
    return float(by_speed.sum() / steps.sum())


def _positions(ride: Seconds, best: str, speed: Array) -> Iterator[Finding]:
    check, roles = "speed against positions", (best, "latitude", "longitude")
    latitude, longitude = ride["latitude"], ride["longitude"]
    by_speed, moving = _where(ride, speed)
    ridden = float(by_speed.sum())
    if ridden < SHORTEST:
        yield unknown(check, roles, f"{ridden:.0f} m were ridden with positions")
        return
    steps, turned_steps = _steps(latitude, longitude, moving), _steps(longitude, latitude, moving)
    way, turned = float(steps.sum()), float(turned_steps.sum())
    off, turned_off = _misfit(steps, by_speed), _misfit(turned_steps, by_speed)
    text = f"{best} goes {ridden / 1e3:.2f} km, the positions {way / 1e3:.2f} km"
    if off > UNLIKE and turned_off < off / 2:
        said = f"in stretches of {STRETCH} s they are {off:.0%} off {best}, and exchanged {turned_off:.0%}"
        yield wrong("positions", ("latitude", "longitude"), f"swapped: {said}")
    elif abs(way / ridden - 1) < CONFIG.odometer_sd:
        yield right(check, roles, text)
    elif abs(turned / ridden - 1) < CONFIG.odometer_sd and turned_off < off + UNLIKE / 2:
        yield wrong("positions", ("latitude", "longitude"), f"swapped: {text}, and exchanged {turned / 1e3:.2f} km")
    elif way < SHORTEST / 10:
        yield wrong("positions", ("latitude", "longitude"), f"stuck: {text}")
    else:
        yield wrong(check, roles, f"{text}{unit_of(best, ridden / way)}")


def check_accelerations(ride: Seconds, speeds: dict[str, Array], doubted: frozenset[str]) -> Iterator[Finding]:
    """Gravity along the vertical axis alone; the forward one against the change of speed."""
    for role, gravity in (("accel_x", 0.0), ("accel_y", 0.0), ("accel_z", GRAVITY)):
        if role not in ride:
            continue
        mean, check = float(np.nanmean(ride[role])), "gravity"
        if abs(mean - gravity) < LEVEL:
            if gravity:
                yield right(check, (role,), f"shows {mean:.2f} m/s² in the mean, up")
        elif gravity and abs(mean + gravity) < LEVEL:
            yield wrong(check, (role,), f"shows {mean:.2f} m/s²: its sign, scale = -1")
        elif gravity and abs(mean - 1) < 0.2:
            yield wrong(check, (role,), f"shows {mean:.2f}{unit_of(role, mean / gravity) or ': g taken for m/s²'}")
        elif not gravity and abs(abs(mean) - GRAVITY) < LEVEL:
            yield wrong(check, (role,), f"shows {mean:.2f} m/s² in the mean: the vertical axis, swapped")
        else:
            yield wrong(check, (role,), f"shows {mean:.2f} m/s² in the mean, where {gravity:.1f} is expected")
    best = next((role for role in speeds if role not in doubted), None)
    if best and "accel_x" in ride:
        yield _forward(ride, best, speeds[best], len(speeds) - len(doubted & speeds.keys()) > 1)


def _forward(ride: Seconds, best: str, speed: Array, sure: bool) -> Finding:
    """sure: other speeds agree with `best`."""
    check, roles = "acceleration against speed", ("accel_x", best)
    change = rate(speed)
    if np.nanstd(change) < SWINGS:
        return unknown(check, roles, "the speed hardly changes")
    found = relation(change, ride["accel_x"])
    if found is None:
        return unknown(check, roles, "they are not there together")
    sideways = relation(change, ride["accel_y"]) if "accel_y" in ride else None
    if sideways and abs(sideways.correlation) > max(CLOSE, abs(found.correlation) + 0.3):
        return wrong(
            check, ("accel_x", "accel_y"), "accel_y goes with the change of speed, and accel_x does not: swapped"
        )
    text = f"goes with the change of {best}, factor {found.factor:.2f}, correlation {found.correlation:.2f}"
    if found.correlation < -CLOSE:
        return wrong(check, ("accel_x",), f"{text}: its sign, scale = -1")
    if found.correlation < CLOSE:
        return unknown(check, roles, f"{text}: hills and shaking hide it")
    if FACTORS[0] < found.factor < FACTORS[1]:
        return right(check, roles, text)
    by_speed = "" if sure else unit_of(best, 1 / found.factor, ROUGH)
    return wrong(check, roles[:1] if sure else roles, text + (by_speed or unit_of("accel_x", found.factor, ROUGH)))


def check_turning(ride: Seconds, speeds: dict[str, Array]) -> Iterator[Finding]:
    """The turning to the left against the change of course."""
    if not {"rate_z", "gps_course"} <= ride.columns.keys() or not speeds:
        return
    check, roles = "turning against course", ("rate_z", "gps_course")
    fast = np.abs(next(iter(speeds.values()))) > 2 * CONFIG.moving_m_s
    turning = -rate(ride["gps_course"])
    turning = np.where(np.abs(turning) < 1.0, turning, np.nan)
    found = relation(turning, ride["rate_z"], fast)
    if found is None or float(np.nanstd(turning[fast])) < TURNING:
        yield unknown(check, roles, "too few bends with a GPS course")
        return
    text = f"factor {found.factor:.2f}, correlation {found.correlation:.2f}"
    if found.correlation < -CLOSE:
        yield wrong(check, roles, f"{text}: the sign of one; rate_z is positive to the left, the course to the right")
    elif found.correlation < CLOSE:
        yield unknown(check, roles, f"{text}: too noisy")
    elif TURN_FACTORS[0] < found.factor < TURN_FACTORS[1]:
        yield right(check, roles, text)
    else:
        yield wrong(check, roles, text + unit_of("rate_z", found.factor))
