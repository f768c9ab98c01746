"""``gz-onboard simulate``: the scooter along a drive cycle, a route or a recorded ride, without the scooter.

It tells what the ride takes, how far a charge goes at that, where the energy went and where the ride asked more than
the vehicle has; and writes time series and pictures.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import json
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gz_onboard.bus.publisher import WH, WH_PER_KM
from gz_onboard.errors import InputError, nearest
from gz_onboard.simulation.cycles import find_cycle
from gz_onboard.simulation.frames import Losses, check_output, simulate_frames, write_frames
from gz_onboard.simulation.parts.chassis import MODELS, chassis
from gz_onboard.simulation.recorded import Recorded, fit_dynamometer, read_recorded, rest_soc
from gz_onboard.simulation.route import read_route, speed_profile
from gz_onboard.simulation.run import (
    COLUMNS,
    Command,
    Progress,
    Run,
    along,
    at_steps,
    drive,
    follow,
    range_by_energy,
    replay,
    road_table,
)
from gz_onboard.simulation.scooter import STEP, Dynamometer, Road, Scooter, straight
from gz_onboard.simulation.sensors import Trace
from gz_onboard.simulation.style import save
from gz_onboard.simulation.sweep import Sweep, grid, read_sweep, redesigned
from gz_onboard.vehicle import Vehicle, read_vehicle

SUMMARY_VERSION = 1
KEYS = {
    "what": "the cycle, route or ride, as given",
    "kind": "cycle, route, ride (open loop) or ride (predictive)",
    "vehicle": "name of the vehicle",
    "payload_kg": "mass of rider and luggage",
    "step_s": "step of the simulation",
    "duration_s": "ridden",
    "distance_km": "ridden",
    "speed_max_km_h": "greatest speed",
    "repetitions": "times that the cycle was ridden; the last may be unfinished",
    "energy_wh": "delivered by the pack, less what was recovered",
    "energy_recovered_wh": "charged into the pack",
    "energy_cells_wh": "that left the cells' chemistry: energy_wh and the heat of the battery",
    "consumption_wh_km": "energy_wh over distance; null below 0.1 km",
    "soc_start": "state of charge, 0 to 1",
    "soc_end": "at the end",
    "range_km": "on this riding from soc_start, or null",
    "range_by": "repetition: ridden until empty; energy: energy left at the start over the consumption",
    "shortfalls": "where the profile asked more than was ridden, worst first: time_s, distance_km, duration_s, "
    "missing_km_h at most, wanted_km_h there, beyond_vehicle (the throttle was open)",
    "shortfall_s": "their time in all",
    "ledger_wh": "where the energy of the cells went, by name; negative: gave",
    "closure": "energy_cells_wh less the sum of the ledger, over all that was turned over",
    "chassis": "straight, planar or leaning",
    "turning_beyond_s": "time in which the road turned harder than the chassis' model goes; its edge was taken",
    "measured": "of a recorded ride: distance_km, energy_wh, consumption_wh_km, and RMS of simulated less measured: "
    "rms_speed_km_h, rms_pack_voltage_v, rms_pack_current_a, rms_motor_torque_nm; else null",
    "files": "written",
    "wall_s": "time taken by the simulation",
    "sweep": "a list of {values, consumption_wh_km, range_km, shortfall_s}, or null",
}
"""What ``--json`` writes."""

FORMATS = ("mcap", "parquet", "csv")
_LOGS = (".mcap", ".blf", ".log", ".asc", ".trc", ".mf4", ".gz")
_MOST_HOURS = 48.0  # of riding until empty
_TOPIC = "simulation"
TOP_SPEED = 50 / 3.6
"""m/s: what a rider wants to ride on a route without limits."""


@dataclass(frozen=True)
class Plan:
    """What is to be ridden: commands, the road under them, and what is known of the start."""

    name: str
    kind: str
    seconds: float  # of one repetition, as planned
    road: Road | Dynamometer
    command: Callable[[], Command]
    length: float | None = None  # m, of one repetition; None if it ends by time
    recorded: Recorded | None = None
    heading: float | Callable[[float], float] = 0.0  # rad clockwise from north, where it begins or over distance


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard simulate``."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    keys = "\n".join(f"  {key:20} {meaning.replace('%', '%%')}" for key, meaning in KEYS.items())
    parser.epilog = f"keys of the JSON summary, version {SUMMARY_VERSION}:\n{keys}"
    add = parser.add_argument
    add("what", metavar="WHAT", help="a built-in drive cycle by name, a CSV file of a cycle or of a route, or the log "
        "of a recorded ride, whose throttle and brake are replayed")  # fmt: skip
    add(
        "--vehicle", default="reference", metavar="NAME|TOML", help="vehicle file or one of the package's (%(default)s)"
    )
    add("--payload", type=float, metavar="KG", help="mass of rider and luggage")
    add("--soc", type=float, metavar="0..1", help="state of charge at the start (1; of a recorded ride, as there)")
    add("--ambient", type=float, metavar="C", help="temperature of air and vehicle at the start (20)")
    add("--grade", type=float, default=0.0, metavar="%", help="of the road, uphill positive, for cycles (%(default)g)")
    add("--wind", type=float, default=0.0, metavar="M/S", help="headwind (%(default)g)")
    often = parser.add_mutually_exclusive_group()
    often.add_argument("--repeat", type=int, default=1, metavar="N", help="ride it N times (%(default)s)")
    often.add_argument("--until-empty", action="store_true", help="repeat it until the pack is empty")
    add("--dyno", metavar="KG[,A,B,C]", help="on a chassis dynamometer: inertia of its roller and absorber force "
        "A + B·V + C·V² in N, V in m/s")  # fmt: skip
    add("--chassis", choices=tuple(MODELS), default="straight", help="what bends do to it: nothing, or what "
        "this turning model says (%(default)s)")  # fmt: skip
    add("--predictive", action="store_true", help="of a recorded ride: the rider follows its speed, by own throttle")
    add("--sweep", action="append", default=[], metavar="NAME=LO..HI[:STEPS]",
        help="ride it with other values of a parameter, or of battery.cells_parallel or battery.cells_series; at most "
        "twice")  # fmt: skip
    add("--json", nargs="?", const="-", metavar="FILE|-", help="write the summary as JSON, to standard output or FILE")
    add("--output", type=Path, default=Path(), metavar="DIR", help="where to write (the current directory)")
    add("--format", choices=FORMATS, default="parquet", help="of the time series (%(default)s)")
    add("--no-series", action="store_true", help="write no time series")
    add("--no-plot", action="store_true", help="draw nothing")
    add("--frames", type=Path, metavar="FILE", help="write the ride as the CAN frames of the vehicle's sensors, in the "
        "format of the suffix: .blf .log .asc .trc .csv .mf4")  # fmt: skip
    add("--seed", type=int, default=0, metavar="N", help="of the noise and losses of --frames (%(default)s)")
    add("--frame-loss", type=float, default=Losses.frames, metavar="SHARE", help="of the frames that the bus loses "
        "(%(default)g)")  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard simulate``."""
    vehicle = read_vehicle(arguments.vehicle, arguments.payload)
    _check(arguments)
    sweeps = [read_sweep(text, vehicle) for text in arguments.sweep]
    if len({sweep.name for sweep in sweeps}) < len(sweeps):
        raise InputError(f"--sweep {sweeps[0].name}: given twice")
    if arguments.frames:
        check_output(arguments.frames)
    plan = find_plan(arguments, vehicle)
    if arguments.chassis != "straight" and (plan.kind == "cycle" or isinstance(plan.road, Dynamometer)):
        where = "on a dynamometer" if isinstance(plan.road, Dynamometer) else "in a drive cycle"
        raise InputError(f"--chassis {arguments.chassis}: there are no bends {where}; it is for routes and rides")
    trace = Trace() if arguments.frames else None
    begin = time.perf_counter()
    with _bar(_expected_seconds(arguments, plan, sweeps), "s ridden") as progress:
        result, scooter = ride(vehicle, plan, arguments, progress, trace)
        wall = time.perf_counter() - begin
        variants = [_variant(vehicle, values, plan, arguments, progress) for values in grid(sweeps)] if sweeps else None
    summary = summarise(vehicle, plan, arguments, result, scooter) | {"wall_s": wall, "sweep": variants}
    summary["files"] = write(arguments, plan, result, summary, sweeps)
    if trace:
        summary["files"].append(_put_out(arguments, vehicle, trace, scooter))
    if arguments.json:
        _write_json(arguments.json, {"version": SUMMARY_VERSION, **summary})
    if arguments.json != "-":
        print(summary_text(summary))
    return 0


def _check(arguments: argparse.Namespace) -> None:
    """InputError for options that make no sense."""
    limits = (
        ("soc", arguments.soc, 0.0, 1.0, ""),
        ("ambient", arguments.ambient, -40.0, 60.0, " degC"),
        ("grade", arguments.grade, -30.0, 30.0, " %"),
        ("wind", arguments.wind, -40.0, 40.0, " m/s"),
        ("repeat", arguments.repeat, 1, 1000, ""),
        ("payload", arguments.payload, 0.0, 300.0, " kg"),
        ("seed", arguments.seed, 0, 2**32 - 1, ""),
        ("frame-loss", arguments.frame_loss, 0.0, 1.0, ""),
    )
    for name, value, low, high, unit in limits:
        if value is not None and not low <= value <= high:
            raise InputError(f"--{name} {value:g}{unit} is outside {low:g} to {high:g}{unit}")
    if len(arguments.sweep) > 2:
        raise InputError(f"--sweep {arguments.sweep[2]}: at most two parameters can be swept")


def dynamometer(text: str) -> Dynamometer:
    """``KG[,A[,B[,C]]]`` as a dynamometer; InputError for anything else."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not 1 <= len(numbers) <= 4 or not all(map(math.isfinite, numbers)):
        raise InputError(f"--dyno {text}: must be KG or KG,A,B,C: inertia in kg, force in N, N·s/m, N·s²/m²")
    if not 1 <= numbers[0] <= 5000:
        raise InputError(f"--dyno {text}: an inertia of {numbers[0]:g} kg is outside 1 to 5000 kg")
    return Dynamometer(*numbers)


# --- what is to be ridden -----------------------------------------------------------------------------------------


def find_plan(arguments: argparse.Namespace, vehicle: Vehicle) -> Plan:
    """The plan that WHAT asks for; InputError for what is neither a file that can be ridden nor a built-in cycle."""
    path = Path(arguments.what)
    kind = _kind(path)
    if kind == "ride":
        return _ride_plan(path, arguments, vehicle)
    if arguments.predictive:
        raise InputError(f"--predictive: {path} is a {kind}, whose speed is followed anyway; it is for recorded rides")
    roller = dynamometer(arguments.dyno) if arguments.dyno else None
    if kind == "route":
        return _route_plan(path, arguments, roller)
    cycle = find_cycle(arguments.what)
    if arguments.repeat > 1 or arguments.until_empty:
        cycle.repeated(2)  # its error if it ends at another speed than it begins with
    speeds = at_steps(cycle.time, cycle.speed, STEP)
    road = roller or straight(math.sin(math.atan(arguments.grade / 100)), arguments.wind)
    return Plan(cycle.name, "cycle", cycle.duration, road, lambda: follow(speeds, STEP))


def _kind(path: Path) -> str:
    """``ride``, ``route``, ``cycle``: of a CSV file by its first line, else by its name."""
    if path.suffix.lower() in _LOGS:
        return "ride"
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
        f"{path}:1: the columns {', '.join(header[:6])} are neither those of a cycle (time_s and speed_mps, "
        "speed_kmh or speed_mph) nor of a route (distance_m or latitude_deg and longitude_deg; altitude_m)"
        f"{nearest(header[0], known)}"
    )


def _route_plan(path: Path, arguments: argparse.Namespace, roller: Dynamometer | None) -> Plan:
    if arguments.repeat > 1 or arguments.until_empty:
        raise InputError(f"{path}: a route is ridden once: its end is not its begin; --repeat is for cycles")
    route = read_route(path)
    profile = speed_profile(route, top_speed=TOP_SPEED)
    metres = [profile.speed_at(float(i)) for i in range(int(route.length) + 1)]
    road = roller or road_table(route.distance, route.grade, route.curvature, arguments.wind)
    return Plan(
        route.name, "route", profile.time[-1], road, lambda: along(metres), route.length, heading=route.heading[0]
    )


def _ride_plan(path: Path, arguments: argparse.Namespace, vehicle: Vehicle) -> Plan:
    if arguments.repeat > 1 or arguments.until_empty:
        raise InputError(f"{path}: a recorded ride is ridden once; --repeat and --until-empty are for cycles")
    recorded = read_recorded(path, vehicle)
    signals = recorded.signals
    beside = path.with_name(f"{recorded.name}.route.csv")
    heading: float | Callable[[float], float] = recorded.heading_at
    if arguments.dyno:
        road: Road | Dynamometer = dynamometer(arguments.dyno)
    elif recorded.on_dynamometer:
        road = fit_dynamometer(recorded)
    elif beside.is_file():
        route = read_route(beside)
        heading = route.heading[0]
        road = road_table(route.distance, route.grade, route.curvature, arguments.wind)
    else:
        road = recorded.road(arguments.wind)
    if arguments.predictive:
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
    return Plan(recorded.name, kind, recorded.duration, road, command, recorded=recorded, heading=heading)


def ride(
    vehicle: Vehicle, plan: Plan, arguments: argparse.Namespace, progress: Progress | None, trace: Trace | None = None
) -> tuple[Run, Scooter]:
    """Ride `plan` with the options of the command line; what these do not say of the start is as it was recorded."""
    recorded = plan.recorded
    measured = recorded.first if recorded else lambda _, default: default
    ambient = measured("ambient_temperature", 20.0) if arguments.ambient is None else arguments.ambient
    soc = arguments.soc
    if soc is None:
        soc = (rest_soc(recorded, vehicle) if recorded else None) or 1.0
    scooter = Scooter(
        vehicle, plan.road, soc=soc, ambient=ambient, cell_temperature=measured("cell_temperature", ambient),
        speed=measured("speed", 0.0), heading=plan.heading, chassis=chassis(arguments.chassis, vehicle.parameters),
    )  # fmt: skip
    scooter.motor_cooling.stator = scooter.motor_cooling.rotor = measured("motor_temperature", ambient)
    scooter.inverter_cooling.board = scooter.inverter_cooling.box = measured("inverter_temperature", ambient)
    seconds = _MOST_HOURS * 3600 if arguments.until_empty else plan.seconds * arguments.repeat
    if plan.length is not None:
        seconds = 3 * plan.seconds + 600  # a weak vehicle takes longer
    command = trace.watch(plan.command()) if trace else plan.command()
    result = drive(scooter, command, seconds, until_empty=arguments.until_empty, finish=plan.length, progress=progress)
    return result, scooter


def _expected_seconds(arguments: argparse.Namespace, plan: Plan, sweeps: Sequence[Sweep]) -> float | None:
    if arguments.until_empty:
        return None
    rides = 1 + (len(grid(sweeps)) if sweeps else 0)
    return plan.seconds * float(arguments.repeat) * rides


def _variant(
    vehicle: Vehicle, values: dict[str, float], plan: Plan, arguments: argparse.Namespace, progress: Progress | None
) -> dict[str, Any]:
    result, scooter = ride(redesigned(vehicle, values), plan, arguments, progress)
    metres, _ = cycle_range(result, scooter, arguments)
    return {
        "values": values,
        "consumption_wh_km": _times(result.consumption, 1 / WH_PER_KM),
        "range_km": _times(metres, 1e-3),
        "shortfall_s": sum(s.duration for s in result.shortfalls),
    }


def cycle_range(result: Run, scooter: Scooter, arguments: argparse.Namespace) -> tuple[float | None, str | None]:
    """(range [m], how it was found)."""
    if result.empty:
        return result.distance, "repetition"
    temperature = float(result.series["cell_temperature"].mean())
    metres = range_by_energy(scooter, result, result.soc_start, temperature)
    return metres, None if metres is None else "energy"


def summarise(
    vehicle: Vehicle, plan: Plan, arguments: argparse.Namespace, result: Run, scooter: Scooter
) -> dict[str, Any]:
    """The summary without what is written and swept: see `KEYS`."""
    metres, by = cycle_range(result, scooter, arguments)
    return {
        "what": str(arguments.what),
        "kind": plan.kind,
        "vehicle": vehicle.name,
        "payload_kg": vehicle.parameters["payload_mass"],
        "step_s": scooter.dt,
        "duration_s": result.duration,
        "distance_km": result.distance * 1e-3,
        "speed_max_km_h": float(result.series["speed"].max()) * 3.6,
        "repetitions": result.duration / plan.seconds if plan.kind == "cycle" else 1.0,
        "energy_wh": result.energy / WH,
        "energy_recovered_wh": result.recovered / WH,
        "energy_cells_wh": result.chemical / WH,
        "consumption_wh_km": _times(result.consumption, 1 / WH_PER_KM),
        "soc_start": result.soc_start,
        "soc_end": result.soc_end,
        "range_km": _times(metres, 1e-3),
        "range_by": by,
        "shortfalls": [
            {
                "time_s": s.time,
                "distance_km": s.distance * 1e-3,
                "duration_s": s.duration,
                "missing_km_h": s.missing * 3.6,
                "wanted_km_h": s.wanted * 3.6,
                "beyond_vehicle": s.beyond_vehicle,
            }
            for s in result.shortfalls
        ],
        "shortfall_s": sum(s.duration for s in result.shortfalls),
        "ledger_wh": {name: energy / WH for name, energy in result.ledger.items()},
        "closure": result.closure,
        "chassis": scooter.chassis.name,
        "turning_beyond_s": scooter.chassis.beyond,
        "measured": compare(plan.recorded, result) if plan.recorded else None,
    }


def measured_columns(recorded: Recorded, result: Run) -> dict[str, Any]:
    """What was recorded of the columns of a run, at the times of its series."""
    import numpy as np

    at = np.minimum(np.round(result.series["time"] / recorded.dt).astype(int), len(recorded.signals["speed"]) - 1)
    columns = {name: values[at] for name, values in recorded.signals.items() if name in COLUMNS}
    if "soc" in recorded.signals:
        columns["soc"] = recorded.signals["soc"][at]
    return columns


def compare(recorded: Recorded, result: Run) -> dict[str, Any]:
    """The entry ``measured`` of the summary."""
    import numpy as np

    columns = measured_columns(recorded, result)
    energy = recorded.energy()

    def rms(name: str, factor: float) -> float | None:
        if name not in columns:
            return None
        return float(np.sqrt(np.mean((result.series[name] - columns[name]) ** 2))) * factor

    return {
        "distance_km": recorded.distance * 1e-3,
        "energy_wh": _times(energy, 1 / WH),
        "consumption_wh_km": None if energy is None else energy / recorded.distance / WH_PER_KM,
        "rms_speed_km_h": rms("speed", 3.6),
        "rms_pack_voltage_v": rms("pack_voltage", 1.0),
        "rms_pack_current_a": rms("pack_current", 1.0),
        "rms_motor_torque_nm": rms("motor_torque", 1.0),
    }


def _times(value: float | None, factor: float) -> float | None:
    return None if value is None else float(value * factor)


# --- what is written ----------------------------------------------------------------------------------------------


def write(
    arguments: argparse.Namespace, plan: Plan, result: Run, summary: dict[str, Any], sweeps: Sequence[Sweep]
) -> list[str]:
    """The time series and the pictures; gives their names. Raises InputError if they cannot be written."""
    mode = ".predictive" if arguments.predictive else ""
    name = f"{plan.name}{mode}.simulation"
    files: list[Path] = []

    def file(ending: str) -> Path:
        files.append(arguments.output / f"{name}{ending}")
        return files[-1]

    try:
        arguments.output.mkdir(parents=True, exist_ok=True)
        if not arguments.no_series:
            metadata = {"vehicle": str(summary["vehicle"]), "source": str(summary["what"])}
            write_series(result, file(f".{arguments.format}"), metadata)
        if not arguments.no_plot:
            _draw(file, plan, result, summary, sweeps)
    except OSError as error:
        raise InputError(
            f"{error.filename or arguments.output}: cannot be written: {error.strerror or error}"
        ) from error
    return [str(file) for file in files]


def _put_out(arguments: argparse.Namespace, vehicle: Vehicle, trace: Trace, scooter: Scooter) -> str:
    """Write the ride's frames; gives the file's name. InputError if it cannot be written."""
    sent = simulate_frames(vehicle, trace.truth(scooter), arguments.seed, losses=Losses(frames=arguments.frame_loss))
    try:
        arguments.frames.parent.mkdir(parents=True, exist_ok=True)
        write_frames(arguments.frames, sent)
    except OSError as error:
        raise InputError(f"{arguments.frames}: cannot be written: {error.strerror or error}") from error
    return str(arguments.frames)


def _draw(
    file: Callable[[str], Path], plan: Plan, result: Run, summary: dict[str, Any], sweeps: Sequence[Sweep]
) -> None:
    from gz_onboard.simulation import figures

    title = f"{plan.name}, {summary['kind']} · {summary['vehicle']}, payload {summary['payload_kg']:g} kg"
    drawn = [("", figures.overview(result, title)), (".ledger", figures.sankey(result.ledger, f"{title}: energy"))]
    if plan.recorded:
        columns = measured_columns(plan.recorded, result)
        drawn.append((".measured", figures.comparison(result, columns, title)))
    variants = summary["sweep"]
    if len(sweeps) == 1:
        drawn.append((".sweep", figures.sweep_lines(sweeps[0].label, sweeps[0].values, variants, title)))
    elif sweeps:
        one, two = sweeps
        names, values = (one.label, two.label), (one.values, two.values)
        drawn.append((".sweep", figures.sweep_map(names, values, variants, title)))
    for ending, figure in drawn:
        save(figure, file(f"{ending}.png"))
    figures.page(file(".html"), title, summary_text(summary | {"files": []}), [figure for _, figure in drawn])


def write_series(result: Run, file: Path, metadata: dict[str, str]) -> None:
    """The time series as MCAP, Parquet or CSV by the file's name; columns as ``name[unit]``, not a number as null."""
    names = [f"{name}[{unit}]" for name, unit in COLUMNS.items()]
    if file.suffix == ".parquet":
        import pyarrow as pa
        import pyarrow.parquet as pq

        columns = [pa.array(column, from_pandas=True) for column in result.series.values()]
        table = pa.table(columns, names=names)
        pq.write_table(table.replace_schema_metadata(metadata), file)
        return
    rows = zip(*(column.tolist() for column in result.series.values()), strict=True)
    if file.suffix == ".csv":
        with file.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(names)
            writer.writerows(["" if math.isnan(value) else f"{value:.9g}" for value in row] for row in rows)
        return
    from gz_onboard.bus.recorder import LogFile

    log = LogFile(file.open("wb"), 0, metadata)
    try:
        properties = {name: {"type": ["number", "null"], "description": unit} for name, unit in COLUMNS.items()}
        log.channel(_TOPIC, {"title": "Simulation", "type": "object", "properties": properties})
        for row in rows:
            log.sample(_TOPIC, round(row[0] * 1e9), dict(zip(COLUMNS, row, strict=True)))
        log.close()
    finally:
        log.abandon()


# --- what a person sees -------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _bar(seconds: float | None, unit: str) -> Iterator[Progress | None]:
    """What counts the seconds ridden; a progress bar where standard error is a terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from tqdm import tqdm

    with tqdm(total=seconds, unit=f" {unit}", file=sys.stderr, leave=False, mininterval=0.2) as bar:
        yield bar.update


def summary_text(summary: dict[str, Any]) -> str:
    """A summary for a terminal."""
    minutes, seconds = divmod(round(summary["duration_s"]), 60)
    hours, minutes = divmod(minutes, 60)
    clock = f"{f'{hours} h ' if hours else ''}{minutes} min {seconds:02} s"
    way = {"repetition": "ridden until empty", "energy": "energy left at the start over the consumption"}
    ledger = sorted(summary["ledger_wh"].items(), key=lambda item: -item[1])
    ledger = [(name, energy) for name, energy in ledger if abs(energy) >= 0.005]
    gross = sum(energy for _, energy in ledger if energy > 0) or 1.0
    rows = [
        (summary["kind"], f"{clock}, {summary['distance_km']:.2f} km, at most {summary['speed_max_km_h']:.0f} km/h, "
                          f"{summary['repetitions']:.3g} times"),
        ("energy", f"{summary['energy_wh']:.1f} Wh net, {summary['energy_recovered_wh']:.1f} Wh recovered before; "
                   f"{_number(summary['consumption_wh_km'], '.2f', 'Wh/km')}"),
        ("state of charge", f"{100 * summary['soc_start']:.1f} → {100 * summary['soc_end']:.1f} %"),
        ("range", f"{_number(summary['range_km'], '.1f', 'km')} "
                  f"({way.get(summary['range_by'], 'not to be told')})"),
        *_shortfall_rows(summary),
        *(("where it went" if not i else "",
           f"{name.replace('_', ' '):20} {energy:9.2f} Wh {100 * energy / gross:6.1f} %")
          for i, (name, energy) in enumerate(ledger)),
        *_measured_rows(summary),
        *_turning_rows(summary),
        ("closes to", f"{100 * summary['closure']:.1g} % of what was turned over"),
        ("computed in", f"{summary['wall_s']:.2f} s, step {1000 * summary['step_s']:g} ms"),
    ]  # fmt: skip
    rows += [("written", ", ".join(summary["files"]))] if summary["files"] else []
    lines = [f"{summary['what']}, {summary['vehicle']}, payload {summary['payload_kg']:g} kg"]
    lines += [f"  {name:17} {text}" for name, text in rows]
    if summary["sweep"]:
        lines += ["", *_table(summary["sweep"])]
    return "\n".join(lines)


def _shortfall_rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    found = summary["shortfalls"]
    if not found:
        return []
    rows = [("shortfall", f"{summary['shortfall_s']:.0f} s slower than wanted, in {len(found)} stretches; the worst:")]
    for s in found[:5]:
        why = "beyond the vehicle" if s["beyond_vehicle"] else "the rider's lag"
        place = f"at {s['time_s']:.0f} s, {s['distance_km']:.2f} km, for {s['duration_s']:.0f} s"
        rows.append(("", f"{place}: {s['missing_km_h']:.1f} km/h below {s['wanted_km_h']:.0f} km/h: {why}"))
    return rows


def _turning_rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    seconds = summary["turning_beyond_s"]
    if not seconds:
        return []
    return [("turning", f"{seconds:.1f} s in bends harder than the {summary['chassis']} model goes: taken at its edge")]


def _measured_rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    m = summary["measured"]
    if not m:
        return []
    return [
        ("measured", f"{m['distance_km']:.2f} km, {_number(m['energy_wh'], '.1f', 'Wh')}, "
                     f"{_number(m['consumption_wh_km'], '.2f', 'Wh/km')}"),
        ("simulated less", "RMS " + ", ".join(
            _number(m[key], form, unit) for key, form, unit in (
                ("rms_speed_km_h", ".1f", "km/h"), ("rms_pack_voltage_v", ".2f", "V"),
                ("rms_pack_current_a", ".1f", "A"), ("rms_motor_torque_nm", ".1f", "N·m")))),
    ]  # fmt: skip


def _table(sweep: Sequence[dict[str, Any]]) -> list[str]:
    names = list(sweep[0]["values"])
    heads = [*names, "Wh/km", "range km", "shortfall s"]
    width = [max(len(head), 10) for head in heads]
    lines = ["  ".join(f"{head:>{w}}" for head, w in zip(heads, width, strict=True))]
    for variant in sweep:
        cells = [f"{value:g}" for value in variant["values"].values()]
        cells += [_number(variant["consumption_wh_km"], ".2f"), _number(variant["range_km"], ".1f"),
                  f"{variant['shortfall_s']:.0f}"]  # fmt: skip
        lines.append("  ".join(f"{cell:>{w}}" for cell, w in zip(cells, width, strict=True)))
    return lines


def _number(value: float | None, form: str, unit: str = "") -> str:
    return "–" if value is None else f"{value:{form}} {unit}".rstrip()


def _write_json(file: str, document: dict[str, Any]) -> None:
    text = json.dumps(document, indent=1, ensure_ascii=False)
    if file == "-":
        print(text)
        return
    try:
        Path(file).write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(f"--json {file}: cannot be written: {error.strerror}") from error
