"""Speeds, odometer and positions against each other, and wheel radius and gear ratio of the vehicle file.

Each source of the way that was ridden is compared with one speed. The scale on which most independent sources agree is
taken as right: all wheels together are one source, for they need the file's radius. A wrong sign or size is reported
once and then corrected, so that later checks accuse nothing else.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.constants import EARTH_RADIUS
from gz_onboard.estimator.plausibility.motion import AXLE, GROUND
from gz_onboard.estimator.plausibility.residual import CONFIG
from gz_onboard.events import SPEEDS
from gz_onboard.model.sensors import speed_factors
from gz_onboard.vehicle import Vehicle
from gz_onboard.vehicle_check.finding import Finding, Roles, accused, right, unknown, wrong
from gz_onboard.vehicle_check.seconds import FEWEST, SECOND, unit_of

BY_WAYS, BY_FILE = "ways against each other", "wheel radius and gear ratio"
WHEELS = ("motor_speed", "wheel_speed_rear", "wheel_speed_front")
ODOMETER, POSITIONS = "odometer", "positions"
PLACE = ("latitude", "longitude")


@dataclass(frozen=True)
class WayCheckConfig:
    """Tolerances. Recorded rides: 29 are within 0.8 % of the GPS, three with soft tyres 1.1 %."""

    apart: float = 0.04  # relative, of two ways that agree
    standing: float = 1e-5  # of the reference: rounding moves a position that stands by less, and no unit is as small
    odometer_apart: float = 0.05  # relative, and twice its steps
    shortest_m: float = 300.0  # way that is compared
    odometer_steps: int = 5  # at least
    coarsest_step_m: float = 500.0  # of an odometer that has not counted yet


WAY_CHECK = WayCheckConfig()


@dataclass
class Speeds:
    """Speeds [m/s] by role, (n,), without the mistakes that were found. sure: sources agree on their size."""

    speeds: dict[str, Array]
    findings: list[Finding] = field(default_factory=list)
    sure: bool = True
    bench: bool = False  # the driven axle turns, the ground stands

    @property
    def best(self) -> Array | None:
        """The speed that others are compared with."""
        distrusted = accused(self.findings)
        role = min(self.speeds, key=lambda role: role in distrusted, default="")
        return self.speeds.get(role)


@dataclass(frozen=True)
class Way:
    """A source of the way that was ridden: its `ratio` to that of the reference speed."""

    name: str
    ratio: float
    tolerance: float = WAY_CHECK.apart  # relative
    exchanged: float = 0.0  # the ratio if latitude and longitude were exchanged

    @property
    def roles(self) -> Roles:
        """The signals that it is made of."""
        return PLACE if self.name == POSITIONS else (self.name,)

    @property
    def stands(self) -> bool:
        """Whether it shows no way where the reference moves."""
        return self.ratio < WAY_CHECK.standing

    def explanation(self, right_ratio: float) -> str:
        """Name the mistake if the way should be `right_ratio` times that of the reference."""
        if self.name != POSITIONS:
            return unit_of(self.name, self.ratio / right_ratio)
        return ": swapped" if abs(self.exchanged / right_ratio - 1) < self.tolerance else ""

    def agrees(self, other: Way) -> bool:
        """Whether the `other` way is as long."""
        return abs(other.ratio / self.ratio - 1) < other.tolerance


def check_speeds(ride: Mapping[str, Array], vehicle: Vehicle) -> Speeds:
    """Compare all that shows the way that was ridden."""
    factors = speed_factors(vehicle.parameters["wheel_radius"], vehicle.parameters["gear_ratio"])
    found = Speeds({role: factors[role] * ride[role] for role in SPEEDS if role in ride})
    for role, speed in found.speeds.items():
        if float(np.nanmean(speed)) < -CONFIG.speed_sd_m_s:
            found.findings.append(wrong("speed's sign", (role,), "is negative while riding: give scale = -1"))
            found.speeds[role] = -speed
    if found.speeds:
        _compare(ride, found, vehicle)
    for role, speed in found.speeds.items():
        top = float(np.nanmax(np.abs(speed)))
        if found.sure and top > CONFIG.fastest_m_s:
            found.findings.append(wrong("speed", (role,), f"reaches {3.6 * top:.0f} km/h"))
    return found


def _compare(ride: Mapping[str, Array], found: Speeds, vehicle: Vehicle) -> None:
    """Judge each way over that of one speed, and correct the speeds."""
    roles = tuple(found.speeds)
    pivot = next(role for role in ("wheel_speed_rear", *SPEEDS) if role in roles)
    reference = np.abs(found.speeds[pivot])
    ways = [Way(pivot, 1.0), *_speed_ways(found.speeds, pivot)]
    fastest = np.max(np.abs(np.nan_to_num(list(found.speeds.values()))), axis=0)
    seconds = int(np.sum(fastest > CONFIG.moving_m_s))
    if seconds < FEWEST:
        text = f"the vehicle moves for {seconds} s in this log, and {FEWEST} s are needed"
        found.findings.append(unknown(BY_WAYS, roles, text))
        return
    names = {way.name for way in ways}
    ground = [role for role in GROUND if role in names]
    if ground and pivot in AXLE and (len(ground) > 1 or "vehicle_speed" not in names):
        found.bench = all(float(np.nanmean(np.abs(found.speeds[role]))) < CONFIG.speed_sd_m_s for role in ground)
    if found.bench:
        found.findings.append(unknown(BY_WAYS, roles, "the driven axle turns and the ground stands: a roller bench"))
        return
    for way in (_odometer(ride, reference), _positions(ride, reference)):
        if isinstance(way, Way):
            ways.append(way)
        elif way:
            found.findings.append(way)
    for way in ways:
        if way.stands:
            found.findings.append(wrong(BY_WAYS, way.roles, f"{way.name} stands while {pivot} moves"))
    ways = [way for way in ways if not way.stands]
    if len(ways) < 2:
        found.findings.append(unknown(BY_WAYS, roles, "there is no other way to compare it with"))
        return
    # The odometer's steps are too coarse to be a reference.
    agreeing = [[other for other in ways if way.agrees(other)] for way in ways if way.name != ODOMETER]
    inside = max(agreeing, key=lambda some: (_independent(some), len(some)))
    if _independent(inside) > 1 or _independent(ways) == 1:
        _judge_outliers(found, ways, inside, vehicle)
    else:
        found.sure = False
        found.findings.append(_contradiction(ways, vehicle))


def _independent(ways: Collection[Way]) -> int:
    return len({"wheels" if way.name in WHEELS else way.name for way in ways})


def _speed_ways(speeds: Mapping[str, Array], pivot: str) -> Iterator[Way]:
    """The ways by the speeds [m/s] that are there together with that of `pivot`."""
    reference = np.abs(speeds[pivot])
    for role, speed in speeds.items():
        moving = np.isfinite(speed) & (np.fmax(np.abs(speed), reference) > CONFIG.moving_m_s) & np.isfinite(reference)
        ridden = float(reference[moving].sum())
        if role != pivot and moving.sum() >= FEWEST and ridden:
            yield Way(role, float(np.abs(speed[moving]).sum()) / ridden)


def _odometer(ride: Mapping[str, Array], speed: Array) -> Way | Finding | None:
    """The way of the odometer over that by `speed` (n,) [m/s]."""
    if ODOMETER not in ride:
        return None
    known = np.isfinite(ride[ODOMETER]) & np.isfinite(speed)
    steps = np.diff(ride[ODOMETER][known])
    ridden, counted = float(speed[known].sum()) * SECOND, float(steps[steps > 0].sum())
    largest = float(steps.max(initial=0.0)) or WAY_CHECK.coarsest_step_m
    if (steps < -1.0).any():
        return wrong(ODOMETER, (ODOMETER,), "counts back")
    if not ridden or max(counted, ridden) < max(WAY_CHECK.shortest_m, WAY_CHECK.odometer_steps * largest):
        return unknown(ODOMETER, (ODOMETER,), f"{ridden:.0f} m are too few for its steps")
    return Way(ODOMETER, counted / ridden, max(WAY_CHECK.odometer_apart, 2 * largest / max(counted, largest)))


def _positions(ride: Mapping[str, Array], speed: Array) -> Way | Finding | None:
    """The way of the positions over that by `speed` (n,) [m/s]."""
    if not all(role in ride for role in PLACE) or float(np.nanmax(np.abs(ride["latitude"]))) > 90.0:
        return None
    latitude, longitude = (ride[role] for role in PLACE)
    moving = np.isfinite(latitude) & np.isfinite(longitude) & (np.nan_to_num(speed) > CONFIG.moving_m_s)
    both = moving[:-1] & moving[1:]
    ridden = float(((speed[:-1] + speed[1:]) / 2)[both].sum()) * SECOND
    if ridden < WAY_CHECK.shortest_m:
        return unknown(POSITIONS, PLACE, f"{ridden:.0f} m were ridden with positions")
    way, exchanged = _length(latitude, longitude, both), _length(longitude, latitude, both)
    return Way(POSITIONS, way / ridden, exchanged=exchanged / ridden)


def _length(latitude: Array, longitude: Array, moving: Mask) -> float:
    """The way [m] along the positions [deg] (n,), where `moving` (n - 1,)."""
    north = np.radians(np.diff(latitude)) * EARTH_RADIUS
    east = np.radians(np.diff(longitude)) * EARTH_RADIUS * np.cos(np.radians(latitude[:-1]))
    return float(np.hypot(north, east)[moving].sum())


def _judge_outliers(found: Speeds, ways: list[Way], inside: list[Way], vehicle: Vehicle) -> None:
    """Report the ways that disagree with those `inside`, and correct the speeds."""
    scale = float(np.median([way.ratio for way in inside]))
    others, ratios = " and ".join(way.name for way in inside), [way.ratio for way in inside]
    if len(inside) > 1:
        roles = tuple(role for way in inside for role in way.roles)
        text = f"{others} agree within {max(ratios) / min(ratios) - 1:.1%}"
        found.findings.append(right(BY_WAYS, roles, text))
    outside = [way for way in ways if way not in inside]
    wheels = [way for way in ways if way.name in WHEELS]
    lost = [way for way in wheels if way in outside]
    # Wheels that are off by one factor: their radius is.
    of_radius = lost == wheels and all(lost[0].agrees(way) for way in lost)
    for way in outside:
        off = way.ratio / scale
        text, unit = f"{way.name} is {off:.3g} times {others}", way.explanation(scale)
        if way not in lost or (unit and len(lost) == 1):
            found.findings.append(wrong(BY_WAYS, way.roles, text + unit))
        elif of_radius and way is lost[0]:
            found.findings.append(_wrong_radius(lost, off, text, vehicle))
        elif way.name == "motor_speed" and lost != wheels:
            gear = vehicle.parameters["gear_ratio"]
            hint = f"{gear / off:.4g} would fit, or the scale of {way.name} is wrong"
            found.findings.append(wrong(BY_FILE, way.roles, f"by the file's gear_ratio {gear:.4g} {text}; {hint}"))
        elif not of_radius:
            found.findings.append(wrong(BY_WAYS, way.roles, text + unit))
        if way.name in found.speeds:
            found.speeds[way.name] = found.speeds[way.name] / off


def _wrong_radius(wheels: list[Way], off: float, text: str, vehicle: Vehicle) -> Finding:
    """All wheels are `off` times too fast. Only one of them may be a wrong scale as well."""
    named, length = "wheel_radius", vehicle.parameters["wheel_radius"]
    if [way.name for way in wheels] == ["motor_speed"]:
        named, length = "wheel_radius times gear_ratio", length * vehicle.parameters["gear_ratio"]
    text = f"by the file's {named} {length:.4g} m {text}; {length / off:.4g} m would fit"
    if len(wheels) > 1:
        return wrong(BY_FILE, (), text)
    return wrong(BY_FILE, wheels[0].roles, f"{text}, or the scale of {wheels[0].name} is wrong")


def _contradiction(ways: list[Way], vehicle: Vehicle) -> Finding:
    """Report ways of which no two agree; the first is the reference."""
    ratios = [way.ratio for way in ways]
    shown = ", ".join(f"{way.name} {way.ratio:.3g}" for way in ways)
    hint = next((hint for way in ways if (hint := way.explanation(1.0))), "")
    other = [way for way in ways if way.name not in WHEELS]
    if not hint and len(other) == 1 and ways[0].name in WHEELS:
        fits = vehicle.parameters["wheel_radius"] * other[0].ratio
        hint = f"; wheel_radius {fits:.4g} m would fit, or gear_ratio or a scale is wrong"
    by_odometer = [way.name for way in other] == [ODOMETER] and max(ratios) < min(ratios) * (1 + CONFIG.odometer_sd)
    looks = unknown if by_odometer else wrong
    roles = tuple(role for way in ways for role in way.roles)
    return looks(BY_WAYS, roles, f"they contradict each other, and none decides: in proportion {shown}{hint}")
