"""``gz-onboard validate``: measured rides against their simulation, by the thesis' gate (Lord 2016, ch. 3).

Each ride is simulated twice from its measured start: open loop, with the measured throttle and brake, and with the
rider model following the measured speed. Each component is also fed alone with its measured inputs. Battery current and
voltage, motor torque and speed must be within 20 % (temperatures too), components within 10 %; `validate_score` says of
what. The grade is that of the place where the scooter really was at that time, so that a speed that drifts does not
also move the hills; so is the vibration.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.bus.logs import logs_among
from gz_onboard.constants import GRAVITY
from gz_onboard.errors import BAD_INPUT, FAILED, InputError
from gz_onboard.lab.processes import Progress, over_rides, progress_bar
from gz_onboard.lab.validate_components import Component, components
from gz_onboard.lab.validate_score import CHANNELS, COMPONENT_GATE, GATE, conditions, errors, pooled, seconds, split
from gz_onboard.simulation.parts.road import Dynamometer, Place, RoadProfile
from gz_onboard.simulation.recorded import Recorded, fit_dynamometer, read_recorded, rest_soc
from gz_onboard.simulation.route import read_route
from gz_onboard.simulation.run import Command, Run, drive, follow, replay, road_table
from gz_onboard.simulation.samples import read_facts, rider_mass
from gz_onboard.simulation.scooter import STEP, Scooter
from gz_onboard.simulation.telling import check_json, explain_keys, output_names, write_json
from gz_onboard.vehicle import Vehicle, read_vehicle

SUMMARY_VERSION = 1
KEYS = {
    "file": "the log",
    "name": "of the ride",
    "kind": "as noted in rides.json beside the log, or null",
    "vehicle": "name of the vehicle",
    "payload_kg": "mass of rider and luggage: --payload, or as noted in rides.json, or of the vehicle file",
    "on_dynamometer": "whether a roller was under the wheel",
    "duration_s": "of the ride",
    "distance_km": "of the ride",
    "ambient_c": "air, mean",
    "energy_wh": "measured at the pack's terminals, sensor's known gain and offset taken off",
    "open_loop": "simulated with the measured throttle and brake, or null: channels, energy_percent, passed",
    "predictive": "simulated with the rider model following the measured speed: the same",
    "components": "each alone with measured inputs: channels, passed",
    "channels": "by name: unit, rms, max, mean_error, percent, of_spread, limit_percent, passed",
    "energy_percent": "energy at the pack's terminals, simulated less measured, in percent of measured",
    "splits": "by form, channel, sorting and condition: seconds, mean_measured, mean_error, mean_abs_error, "
    "mean_abs_measured",
    "missing": "what could not be judged, or not as well, and why",
    "passed": "whether open loop, predictive and components passed",
    "plot": "file, or null",
}
"""What ``--json`` holds of a ride: {"version", "rides", "pooled": splits of all rides, "failed": [{file, error}]}."""

FORMS = {
    "open_loop": ("open loop", "the same throttle gives another ride; small errors of force add up to another speed"),
    "predictive": (
        "rider model",
        "the same speed takes another current or torque: road load, losses, or the way of opening the throttle",
    ),
    "components": ("components", "fed with what was measured, this part alone is off: its parameters or its equation"),
}
"""By entry of a ride: what people call it, and what it means if it does not pass."""
AVERAGED = 0.5  # s: over which the measured speed is averaged: its noise is no ride for a rider model to follow
STANDING = 0.3  # m/s: less is noise of a wheel that stands
_READ, _RIDE = 0.4, 0.3  # shares of the work


@dataclass(frozen=True)
class Task:
    """One ride and what to do with it."""

    path: Path
    name: str
    vehicle: str
    payload: float | None
    picture: Path | None  # to be drawn

    @property
    def size(self) -> int:
        """Of the log [bytes], as a measure of the work."""
        try:
            return self.path.stat().st_size
        except OSError:
            return 1


# --- one ride -----------------------------------------------------------------------------------------------------


def validate_ride(task: Task, progress: Progress = lambda _: None) -> dict[str, Any]:
    """The entry of one ride: see `KEYS`; `progress` is told bytes of the log. Raises InputError."""
    facts = read_facts(task.path.parent / "rides.json").get(task.name, {})
    payload = task.payload if task.payload is not None else rider_mass(facts)
    vehicle = read_vehicle(task.vehicle, payload)
    told = 0.0

    def frames(count: int) -> None:  # a frame takes some 13 bytes of a compressed log
        nonlocal told
        part = min(13.0 * count, _READ * task.size - told)
        told += part
        progress(part)

    recorded = read_recorded(task.path, vehicle, frames)
    progress(_READ * task.size - told)
    measured = per_second(recorded, vehicle)
    if len(measured["speed"]) < 30:
        raise InputError(f"{task.path}: {len(measured['speed'])} s are too short a ride to judge; at least 30 s")
    road, place = _road(recorded, task.path)
    if place is not None:
        measured["grade"] = place
    soc = rest_soc(recorded, vehicle)
    found, missing = conditions(measured)
    missing += [
        f"{channel.label} not judged: not measured" for name, channel in CHANNELS.items() if name not in measured
    ]
    if place is not None and not _route_file(recorded, task.path).is_file():
        newtons = 0.005 * GRAVITY * vehicle.model.mass
        missing.append(
            "grade is the on-board filter's, by accelerometer and altitude: wrong by some 0.5 % in the first minutes, "
            f"{newtons:.0f} N of road load; a {recorded.name}.route.csv beside the log would tell it"
        )
    commands: dict[str, Command] = {}
    if {"throttle", "brake"} <= recorded.signals.keys():
        throttle, brake = (recorded.signals[name].tolist() for name in ("throttle", "brake"))
        commands["open_loop"] = replay(throttle, brake, STEP)
    else:
        gone = [name for name in ("throttle", "brake") if name not in recorded.signals]
        missing.append(f"not simulated open loop: the ride has no {' and no '.join(gone)}")
        progress(_RIDE * task.size)
    profile = _averaged_speed(recorded)
    profile[profile < STANDING] = 0.0  # or the rider would hold a hill by throttle, not by brake
    commands["predictive"] = follow(profile.tolist(), STEP)
    entry: dict[str, Any] = {
        "file": str(task.path),
        "name": task.name,
        "kind": facts.get("kind"),
        "vehicle": vehicle.name,
        "payload_kg": vehicle.parameters["payload_mass"],
        "on_dynamometer": recorded.on_dynamometer,
        "duration_s": recorded.duration,
        "distance_km": recorded.distance * 1e-3,
        "ambient_c": float(measured["ambient_temperature"].mean()) if "ambient_temperature" in measured else None,
        "energy_wh": _energy(measured),
        "open_loop": None,
    }
    simulated: dict[str, dict[str, Array]] = {}
    splits: dict[str, Any] = {}
    for form, command in commands.items():
        run = _ride(recorded, vehicle, road, command, soc, lambda share: progress(share * _RIDE * task.size))
        simulated[form] = series = _series(run)
        channels = {
            name: errors(*_even(measured[name], series[name]), channel, GATE)
            for name, channel in CHANNELS.items()
            if name in measured
        }
        energy = entry["energy_wh"]
        entry[form] = {
            "channels": channels,
            "energy_percent": None if not energy else 100 * (_energy(series) or 0.0) / energy - 100,
            "passed": all(channel["passed"] for channel in channels.values()),
        }
        both = [name for name in (*CHANNELS, "pack_power") if name in measured and name in series]
        splits[form] = {name: split(measured[name], series[name], found) for name in both}
    ambient = recorded.first("ambient_temperature", 20.0)
    alone = components(vehicle, measured, soc, ambient, road if isinstance(road, Dynamometer) else None)
    entry["components"] = _judge(alone)
    splits["components"] = {name: split(c.measured, c.modelled, found, c.valid) for name, c in alone.items()}
    forms = [entry[form] for form in ("open_loop", "predictive", "components") if entry[form]]
    entry |= {"splits": splits, "missing": missing, "passed": all(form["passed"] for form in forms), "plot": None}
    if task.picture:
        from gz_onboard.lab.validate_report import draw_ride

        entry["plot"] = str(task.picture)
        try:
            draw_ride(task.picture, entry, measured, simulated, alone)
        except OSError as error:
            raise InputError(f"{task.picture}: cannot be written: {error.strerror or error}") from error
    return entry


def per_second(recorded: Recorded, vehicle: Vehicle) -> dict[str, Array]:
    """What was measured, as means over seconds, by role; and acceleration, yaw_rate, braking, pack_power.

    The pack's current is that which flows: the sensor's known gain and offset are taken off.
    """
    rate = round(1 / recorded.dt)
    measured = {role: seconds(values, rate) for role, values in recorded.signals.items()}
    smooth = _averaged_speed(recorded)
    n = len(measured["speed"])
    ends = np.minimum(np.arange(n + 1) * rate, len(smooth) - 1)
    measured["acceleration"] = np.diff(smooth[ends])  # over one second
    if "rate_z" in measured and not recorded.on_dynamometer:
        measured["yaw_rate"] = measured["rate_z"]
    if "brake" in measured:
        measured["braking"] = (measured["brake"] > 0).astype(float)
    if "pack_current" in measured:
        p = vehicle.parameters
        measured["pack_current"] = (measured["pack_current"] - p["pack_current_offset"]) / p["pack_current_gain"]
        if "pack_voltage" in measured:
            measured["pack_power"] = measured["pack_voltage"] * measured["pack_current"]
    return measured


def _averaged_speed(recorded: Recorded) -> Array:
    """The measured speed [m/s], each sample the mean over `AVERAGED` about it."""
    reach = round(AVERAGED / recorded.dt / 2)
    width = 2 * reach + 1
    return np.convolve(np.pad(recorded.signals["speed"], reach, mode="edge"), np.ones(width) / width, "valid")


def _road(recorded: Recorded, log: Path) -> tuple[RoadProfile | Dynamometer, Array | None]:
    """(the road by place, or the roller; the grade of each second, None on a roller)."""
    if recorded.on_dynamometer:
        return fit_dynamometer(recorded), None
    beside = _route_file(recorded, log)
    if beside.is_file():
        route = read_route(beside)
        road = road_table(route.distance, route.grade, route.curvature)
    else:
        road = recorded.road()
    distance = recorded.signals["distance"]
    at = seconds(distance, round(1 / recorded.dt))
    return road, np.array([road(place)[0] for place in at.tolist()])


def _route_file(recorded: Recorded, log: Path) -> Path:
    return log.with_name(f"{recorded.name}.route.csv")


def _ride(
    recorded: Recorded,
    vehicle: Vehicle,
    road: RoadProfile | Dynamometer,
    command: Command,
    soc: float | None,
    progress: Progress,
) -> Run:
    """The simulated ride; `progress` is told its shares."""
    here: Place = (0.0, 0.0, 0.0)
    distance = recorded.signals["distance"].tolist()
    rough = recorded.signals["vibration"].tolist() if "vibration" in recorded.signals else None
    told = step = 0

    def where(scooter: Scooter) -> tuple[float, float, float]:
        nonlocal here, told, step
        step = min(round(scooter.time / STEP), len(distance) - 1)
        if not isinstance(road, Dynamometer):
            here = road(distance[step])
        if step - told >= 1000:
            progress((step - told) / len(distance))
            told = step
        return command(scooter)

    ambient = recorded.first("ambient_temperature", 20.0)
    scooter = Scooter(
        vehicle,
        road if isinstance(road, Dynamometer) else lambda _: here,
        soc=0.5 if soc is None else soc,
        ambient=ambient,
        cell_temperature=recorded.first("cell_temperature", ambient),
        speed=recorded.first("speed", 0.0),
        vibration=(lambda _: rough[step]) if rough else None,
    )
    motor, inverter = scooter.motor_cooling, scooter.inverter_cooling
    motor.stator = motor.rotor = recorded.first("motor_temperature", ambient)
    inverter.board = inverter.box = recorded.first("inverter_temperature", ambient)
    run = drive(scooter, where, recorded.duration)
    progress((len(distance) - told) / len(distance))
    return run


def _series(run: Run) -> dict[str, Array]:
    """A run as means over seconds."""
    rate = round(1 / float(run.series["time"][1] - run.series["time"][0]))
    series = {name: seconds(values, rate) for name, values in run.series.items()}
    series["pack_power"] = seconds(run.series["pack_voltage"] * run.series["pack_current"], rate)
    return series


def _even(a: Array, b: Array) -> tuple[Array, Array]:
    n = min(len(a), len(b))
    return a[:n], b[:n]


def _energy(series: dict[str, Array]) -> float | None:
    """[Wh] at the pack's terminals."""
    return float(series["pack_power"].sum()) / 3600 if "pack_power" in series else None


def _judge(alone: dict[str, Component]) -> dict[str, Any] | None:
    channels = {
        name: errors(c.measured[c.valid], c.modelled[c.valid], c.channel, COMPONENT_GATE)
        for name, c in alone.items()
        if c.valid.sum() >= 20
    }
    return {"channels": channels, "passed": all(c["passed"] for c in channels.values())} if channels else None


def pool(rides: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The splits of all rides as one, apart for road and dynamometer."""
    result: dict[str, Any] = {}
    for where in ("road", "dynamometer"):
        rows: dict[tuple[str, str, str, str], list[dict[str, float]]] = {}
        for ride in rides:
            if ride["on_dynamometer"] != (where == "dynamometer"):
                continue
            for form, channels in ride["splits"].items():
                for channel, sortings in channels.items():
                    for by, kinds in sortings.items():
                        for kind, row in kinds.items():
                            rows.setdefault((form, channel, by, kind), []).append(row)
        for (form, channel, by, kind), found in rows.items():
            place = result.setdefault(where, {}).setdefault(form, {}).setdefault(channel, {}).setdefault(by, {})
            place[kind] = pooled(found)
    return result


# --- the command --------------------------------------------------------------------------------------------------


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard validate``."""
    explain_keys(parser, "a ride in the", SUMMARY_VERSION, KEYS)
    add = parser.add_argument
    add(
        "logs",
        nargs="+",
        type=Path,
        metavar="RIDE",
        help="logs of rides: .blf .log .asc .trc .mf4 .csv .mcap, or .gz; or folders of them (but .csv)",
    )
    add(
        "--vehicle", default="reference", metavar="NAME|TOML", help="vehicle file or one of the package's (%(default)s)"
    )
    add("--payload", type=float, metavar="KG", help="mass of rider and luggage (as noted in rides.json beside the log)")
    add("--output", type=Path, default=Path(), metavar="DIR", help="where to write (the current directory)")
    add("--json", nargs="?", const="-", metavar="FILE|-", help="write the summary as JSON, to standard output or FILE")
    add("--markdown", type=Path, metavar="FILE", help="write the tables of the page as Markdown")
    add("--no-plot", action="store_true", help="draw nothing and write no page")
    add("--gate", action="store_true", help="end with status 1 if a ride does not pass")
    add("--jobs", type=int, metavar="N", help="so many rides at a time (as many as there are processors)")


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard validate``: 0; `BAD_INPUT` if a ride cannot be judged; `FAILED` if with --gate one fails."""
    tasks = _tasks(arguments)
    read_vehicle(arguments.vehicle, arguments.payload)  # its errors are none of a log's
    rides: list[dict[str, Any]] = []
    failed: list[dict[str, str]] = []
    try:
        arguments.output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--output {arguments.output}: cannot be written: {error.strerror}") from error
    form = "{percentage:3.0f}%|{bar}| {elapsed} < {remaining}"
    with progress_bar(lambda: sum(task.size for task in tasks), bar_format=form) as (progress, say):
        for task, result in over_rides(validate_ride, tasks, arguments.jobs, progress):
            if isinstance(result, InputError):
                failed.append({"file": str(task.path), "error": str(result)})
                say(f"gz-onboard validate: {result}", sys.stderr)
                continue
            rides.append(result)
            if arguments.json != "-":
                say(ride_text(result), sys.stdout)
    together = pool(rides)
    if rides:
        _write_tables(arguments, rides, together)
    if arguments.json:
        write_json(arguments.json, {"version": SUMMARY_VERSION, "rides": rides, "pooled": together, "failed": failed})
    if failed:
        return BAD_INPUT
    return FAILED if arguments.gate and not all(ride["passed"] for ride in rides) else 0


def _write_tables(arguments: argparse.Namespace, rides: list[dict[str, Any]], together: dict[str, Any]) -> None:
    from gz_onboard.lab.validate_report import markdown, write_page

    written = []
    try:
        if not arguments.no_plot:
            written.append(arguments.output / "validation.html")
            write_page(written[-1], rides, together)
        if arguments.markdown:
            written.append(arguments.markdown)
            arguments.markdown.write_text(markdown(rides, together), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{written[-1]}: cannot be written: {error.strerror}") from error
    if arguments.json != "-" and written:
        print(f"written: {', '.join(map(str, written))}")


def _tasks(arguments: argparse.Namespace) -> list[Task]:
    check_json(arguments.json)
    paths = list(dict.fromkeys(logs_among(arguments.logs)))
    names = [Path(path.name.removesuffix(".gz")).stem for path in paths]
    stems = output_names(paths, names, ".validation.png")
    return [
        Task(
            path,
            name,
            arguments.vehicle,
            arguments.payload,
            None if arguments.no_plot else arguments.output / f"{stem}.validation.png",
        )
        for path, name, stem in zip(paths, names, stems, strict=True)
    ]


def ride_text(ride: dict[str, Any]) -> str:
    """A ride's entry for a terminal."""
    where = "dynamometer" if ride["on_dynamometer"] else "road"
    air = "" if ride["ambient_c"] is None else f", {ride['ambient_c']:.0f} degC"
    lines = [
        f"{ride['file']}: {'passed' if ride['passed'] else 'not passed'}",
        f"  {where}, {ride['kind'] or 'kind not noted'}, {ride['distance_km']:.2f} km, {ride['duration_s']:.0f} s, "
        f"{ride['payload_kg']:g} kg{air}",
    ]
    for form, (name, meaning) in FORMS.items():
        entry = ride[form]
        if not entry:
            continue
        energy = entry.get("energy_percent")
        lines.append(f"  {name:12} {'' if energy is None else f'energy {energy:+.1f} %'}")
        for channel, e in entry["channels"].items():
            percent = "–" if e["percent"] is None else f"{e['percent']:5.1f} %"
            spread = "" if e["of_spread"] is None else f", {e['of_spread']:.2f} of its spread"
            verdict = "ok" if e["passed"] else f"FAIL (limit {e['limit_percent']:g} %)"
            lines.append(
                f"    {channel.replace('_', ' '):21} {percent} {verdict:17} "
                f"rms {e['rms']:7.2f}, max {e['max']:7.2f}, mean {e['mean_error']:+7.2f} {e['unit']}{spread}"
            )
        if not entry["passed"]:
            lines.append(f"    FAIL: {meaning}")
    if not ride["passed"]:
        lines.append("  what each percentage is of, and where the model is known to fail: docs/validation.md")
    return "\n".join([*lines, *(f"  {text}" for text in ride["missing"])])
