"""What ``gz-onboard simulate`` is asked to ride: a cycle, a route or a recorded ride, as a `Plan`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from gz_onboard.arguments import check_fields
from gz_onboard.errors import InputError, nearest, shown
from gz_onboard.options import LOG_SUFFIXES
from gz_onboard.recording.recording import facts_of, ride_name, rider_mass
from gz_onboard.routes.route import Route, read_route, speed_profile
from gz_onboard.simulation.cycles import find_cycle
from gz_onboard.simulation.parts import Dynamometer, RoadProfile, road_table, straight
from gz_onboard.simulation.recorded import Recorded, along_road, fit_dynamometer, read_recorded
from gz_onboard.simulation.run import Command, along, at_steps, follow, replay
from gz_onboard.simulation.scooter import STEP, AlongRoad
from gz_onboard.simulation.turning import MODELS
from gz_onboard.vehicle import Vehicle, read_vehicle

_LOGS = {*LOG_SUFFIXES, ".gz"} - {".csv"}
TOP_SPEED = 50 / 3.6
"""m/s: what a rider aims for on a route without limits."""
Ground = RoadProfile | Dynamometer
Heading = float | AlongRoad


RANGES: dict[str, tuple[float, float, str]] = {
    "soc": (0.0, 1.0, ""),
    "ambient": (-40.0, 60.0, "degC"),
    "grade": (-30.0, 30.0, "%"),
    "wind": (-40.0, 40.0, "m/s"),
    "repeat": (1, 1000, ""),
}
"""What of `SimulationOptions` is a number: the least, the greatest, the unit."""


@dataclass(frozen=True)
class SimulationOptions:
    """How to ride a cycle, a route or a recorded ride; None: as recorded, or usual.

    soc: state of charge at the start, 0 to 1. ambient: of air and vehicle at the start [degC]. grade: of the road [%,
    uphill positive]. wind: against the rider [m/s]. repeat: times that a cycle is ridden, or until_empty: until the
    pack is. dyno: ``KG[,A,B,C]``, on a chassis dynamometer. chassis: straight, planar or leaning. predictive: a
    rider follows the speed of a recorded ride. Raises InputError for other values, or values out of range.
    """

    soc: float | None = None
    ambient: float | None = None
    grade: float = 0.0
    wind: float = 0.0
    repeat: int = 1
    until_empty: bool = False
    dyno: str | None = None
    chassis: str = "straight"
    predictive: bool = False

    def __post_init__(self) -> None:
        check_fields(self, RANGES)
        if self.until_empty and self.repeat != 1:
            raise InputError(f"repeat {self.repeat}: it is repeated until_empty")
        if self.dyno is not None:
            dynamometer(self.dyno)
        if self.chassis not in MODELS:
            raise InputError(f"chassis {self.chassis!r}: must be {', '.join(MODELS)}{nearest(self.chassis, MODELS)}")


@dataclass(frozen=True)
class Plan:
    """Commands of a ride, the road, and the state at the start."""

    name: str
    kind: str
    seconds: float  # of one repetition, as planned
    road: Ground
    command: Callable[[], Command]
    length: float | None = None  # m, of one repetition; None if it ends by time
    recorded: Recorded | None = None
    heading: Heading = 0.0  # rad clockwise from north, where it begins or over distance
    vibration: AlongRoad | None = None  # m/s² over distance, as it was recorded


def find_plan(what: str, options: SimulationOptions, vehicle: Vehicle) -> Plan:
    """The plan for `what`: a file that can be ridden or a built-in cycle; InputError otherwise."""
    plan = _plan(what, options, vehicle)
    if options.chassis != "straight" and (plan.kind == "cycle" or isinstance(plan.road, Dynamometer)):
        where = "on a dynamometer" if isinstance(plan.road, Dynamometer) else "in a drive cycle"
        raise InputError(f"--chassis {options.chassis}: there are no bends {where}; it is for routes and rides")
    return plan


def _plan(what: str, options: SimulationOptions, vehicle: Vehicle) -> Plan:
    path = Path(what)
    kind = _kind(path)
    roller = None if options.dyno is None else dynamometer(options.dyno)
    if options.grade and (roller or kind != "cycle"):
        raise InputError(f"--grade {options.grade:g}: {'a roller has none' if roller else f'the {kind} has its own'}")
    if options.wind and roller:
        raise InputError(f"--wind {options.wind:g}: on a roller there is none")
    if kind == "ride":
        return _ride_plan(path, options, vehicle, roller)
    if options.predictive:
        raise InputError(
            f"--predictive: {path} is a {kind}, and its speed is followed anyway; it is for recorded rides"
        )
    if kind == "route":
        return _route_plan(path, options, roller)
    cycle = find_cycle(what)
    if options.repeat > 1 or options.until_empty:
        cycle.check_closed()
    speeds = at_steps(cycle.time, cycle.speed, STEP)
    road = roller or straight(math.sin(math.atan(options.grade / 100)), options.wind)
    return Plan(cycle.name, "cycle", cycle.duration, road, lambda: follow(speeds, STEP))


def vehicle_on(what: str, vehicle: str | Path, payload: float | None = None) -> tuple[Vehicle, str]:
    """(vehicle, source of its payload): the one given [kg], or that in the ``rides.json`` of a recorded ride."""
    source = "--payload"
    if payload is None:
        payload = rider_mass(facts_of(Path(what))) if _kind(Path(what)) == "ride" else None
        source = "the vehicle file" if payload is None else "rides.json"
    return read_vehicle(vehicle, payload), source


def _kind(path: Path) -> str:
    """``ride``, ``route``, ``cycle``: of a CSV file by its first line, else by its name. InputError for a folder."""
    if path.is_dir():
        raise InputError(
            f"{path}: is a folder; give one log, route or cycle in it; `validate` simulates every ride of a folder"
        )
    if path.suffix.lower() in _LOGS:
        return "ride"
    if path.suffix.lower() == ".gpx":
        return "route"
    if path.suffix.lower() != ".csv" or not path.is_file():
        return "cycle"
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        header = [name.strip() for name in file.readline().split(",")]
    if "time_s" in header:
        return "cycle"
    if {"distance_m", "altitude_m", "latitude_deg"} & set(header):
        return "route"
    if {"timestamp", "arbitration_id"} <= set(header):
        return "ride"
    known = ("time_s", "distance_m", "latitude_deg")
    raise InputError(
        f"{path}:1: the columns {shown(header[:6])} are neither those of a cycle (time_s and speed_mps, "
        "speed_kmh or speed_mph) nor of a route (distance_m or latitude_deg and longitude_deg; altitude_m)"
        f"{nearest(header[0], known)}"
    )


def _route_plan(path: Path, options: SimulationOptions, roller: Dynamometer | None) -> Plan:
    if options.repeat > 1 or options.until_empty:
        raise InputError(f"{path}: a route is ridden once, as it does not end where it starts; --repeat is for cycles")
    route = _with_heights(path)
    import numpy as np

    distance, speed = map(np.array, speed_profile(route, top_speed=TOP_SPEED))
    duration = float(np.sum(2 * np.diff(distance) / (speed[1:] + speed[:-1])))
    metres = np.sqrt(np.interp(np.arange(int(route.length) + 1), distance, speed**2)).tolist()
    road = roller or road_table(route.distance, route.grade, route.curvature, options.wind)
    return Plan(route.name, "route", duration, road, lambda: along(metres), route.length, heading=route.heading[0])


def _ride_plan(path: Path, options: SimulationOptions, vehicle: Vehicle, roller: Dynamometer | None) -> Plan:
    if options.repeat > 1 or options.until_empty:
        raise InputError(f"{path}: a recorded ride is ridden once; --repeat and --until-empty are for cycles")
    recorded = read_recorded(path, vehicle)
    signals = recorded.signals
    road, heading = ridden_road(recorded, path, options.wind, roller)
    if options.predictive:
        speeds = signals["speed"].tolist()
        kind, command = "ride (predictive)", lambda: follow(speeds, STEP)
    else:
        missing = [role for role in ("throttle", "brake") if role not in signals]
        if missing:
            raise InputError(
                f"{path}: vehicle {vehicle.name!r} has no {missing[0]} in it to be replayed; --predictive needs none"
            )
        throttle, brake = signals["throttle"].tolist(), signals["brake"].tolist()
        kind, command = "ride (open loop)", lambda: replay(throttle, brake, STEP)
    rough = None if isinstance(road, Dynamometer) else recorded.vibration
    return Plan(
        recorded.name,
        kind,
        recorded.duration,
        road,
        command,
        recorded=recorded,
        heading=heading,
        vibration=None if rough is None else along_road(rough),
    )


def _with_heights(file: Path) -> Route:
    """The route in `file`; InputError if it has no altitudes: a hilly road must not be simulated as level."""
    route = read_route(file)
    if not route.grade_known:
        raise InputError(f"{file}: has no altitudes, which a simulation needs: column altitude_m, or ele in a GPX")
    return route


def route_file(log: Path) -> Path:
    """Where the route of the ride in `log` would be."""
    return log.with_name(f"{ride_name(log)}.route.csv")


def ridden_road(
    recorded: Recorded, log: Path, headwind: float = 0.0, roller: Dynamometer | None = None
) -> tuple[Ground, Heading]:
    """(surface of the ride, its heading): a roller, the road of the log's route file, or that of the filter."""
    heading = 0.0 if recorded.heading is None else along_road(recorded.heading)
    if roller or recorded.on_dynamometer:
        return roller or fit_dynamometer(recorded), heading
    if not route_file(log).is_file():
        return recorded.road(headwind), heading
    route = _with_heights(route_file(log))
    return road_table(route.distance, route.grade, route.curvature, headwind), route.heading[0]


def dynamometer(text: str) -> Dynamometer:
    """``KG`` or ``KG,A,B,C`` as a dynamometer; InputError for anything else, such as a decimal comma."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, 4) or not all(map(math.isfinite, numbers)):
        raise InputError(f"--dyno {text}: must be KG or KG,A,B,C: inertia in kg, force in N, N·s/m, N·s²/m²")
    if not 1 <= numbers[0] <= 5000:
        raise InputError(f"--dyno {text}: an inertia of {numbers[0]:g} kg is outside 1 to 5000 kg")
    return Dynamometer(*numbers)
