"""``gz-onboard simulate``: the scooter along a drive cycle, a route or a recorded ride, without the scooter.

It tells what the ride takes, how far a charge goes at that, where the energy went and where the ride asked more than
the vehicle has; and writes time series and pictures.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from gz_onboard.bus.publisher import WH_PER_KM
from gz_onboard.errors import InputError
from gz_onboard.simulation.frames import Losses, check_output
from gz_onboard.simulation.output import FORMATS, write, write_trace
from gz_onboard.simulation.parts.chassis import MODELS, chassis
from gz_onboard.simulation.parts.road import Dynamometer
from gz_onboard.simulation.plan import Plan, find_plan, noted_payload
from gz_onboard.simulation.recorded import rest_soc
from gz_onboard.simulation.run import Progress, Run, drive
from gz_onboard.simulation.scooter import Scooter
from gz_onboard.simulation.sensors import Trace
from gz_onboard.simulation.summary import KEYS, SUMMARY_VERSION, cycle_range, summarise, summary_text
from gz_onboard.simulation.sweep import Sweep, grid, read_sweep, redesigned
from gz_onboard.simulation.telling import explain_keys, times, write_json
from gz_onboard.vehicle import Vehicle, read_vehicle

_MOST_HOURS = 48.0  # of riding until empty


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard simulate``."""
    explain_keys(parser, "the", SUMMARY_VERSION, KEYS)
    add = parser.add_argument
    add(
        "what",
        metavar="WHAT",
        help="a built-in drive cycle by name, a CSV file of a cycle or of a route, or the log "
        "of a recorded ride, whose throttle and brake are replayed",
    )
    add(
        "--vehicle", default="reference", metavar="NAME|TOML", help="vehicle file or one of the package's (%(default)s)"
    )
    add(
        "--payload",
        type=float,
        metavar="KG",
        help="mass of rider and luggage (of a recorded ride as noted in "
        "rides.json beside the log, else the vehicle file's)",
    )
    add("--soc", type=float, metavar="0..1", help="state of charge at the start (1; of a recorded ride, as there)")
    add("--ambient", type=float, metavar="C", help="temperature of air and vehicle at the start (20)")
    add("--grade", type=float, default=0.0, metavar="%", help="of the road, uphill positive, for cycles (%(default)g)")
    add("--wind", type=float, default=0.0, metavar="M/S", help="headwind (%(default)g)")
    often = parser.add_mutually_exclusive_group()
    often.add_argument("--repeat", type=int, default=1, metavar="N", help="ride it N times (%(default)s)")
    often.add_argument("--until-empty", action="store_true", help="repeat it until the pack is empty")
    add(
        "--dyno",
        metavar="KG[,A,B,C]",
        help="on a chassis dynamometer: inertia of its roller and absorber force A + B·V + C·V² in N, V in m/s",
    )
    add(
        "--chassis",
        choices=tuple(MODELS),
        default="straight",
        help="what bends do to it: nothing, or what this turning model says (%(default)s)",
    )
    add("--predictive", action="store_true", help="of a recorded ride: the rider follows its speed, by own throttle")
    add(
        "--sweep",
        action="append",
        default=[],
        metavar="NAME=LO..HI[:STEPS]",
        help="ride it with other values of a parameter, or of battery.parallel or battery.series (cells); at "
        "most twice",
    )
    add("--json", nargs="?", const="-", metavar="FILE|-", help="write the summary as JSON, to standard output or FILE")
    add("--output", type=Path, default=Path(), metavar="DIR", help="where to write (the current directory)")
    add("--format", choices=FORMATS, default="parquet", help="of the time series (%(default)s)")
    add("--no-series", action="store_true", help="write no time series")
    add("--no-plot", action="store_true", help="draw nothing")
    add(
        "--frames",
        type=Path,
        metavar="FILE",
        help="write the ride as the CAN frames of the vehicle's sensors, in the "
        "format of the suffix: .blf .log .asc .trc .csv .mf4",
    )
    add("--seed", type=int, default=0, metavar="N", help="of the noise and losses of --frames (%(default)s)")
    add(
        "--frame-loss",
        type=float,
        default=Losses.frames,
        metavar="SHARE",
        help="of the frames that the bus loses (%(default)g)",
    )


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard simulate``."""
    payload, payload_from = arguments.payload, "--payload"
    if payload is None:
        payload = noted_payload(Path(arguments.what))
        payload_from = "the vehicle file" if payload is None else "rides.json"
    vehicle = read_vehicle(arguments.vehicle, payload)
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
    summary = summarise(vehicle, plan, arguments, result, scooter)
    summary |= {"payload_from": payload_from, "wall_s": wall, "sweep": variants}
    summary["files"] = write(arguments, plan, result, summary, sweeps)
    if trace:
        summary["files"].append(write_trace(arguments, vehicle, trace, scooter))
    if arguments.json:
        write_json(arguments.json, {"version": SUMMARY_VERSION, **summary})
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
        vehicle,
        plan.road,
        soc=soc,
        ambient=ambient,
        cell_temperature=measured("cell_temperature", ambient),
        speed=measured("speed", 0.0),
        heading=plan.heading,
        vibration=plan.vibration,
        chassis=chassis(arguments.chassis, vehicle.parameters),
    )
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
        "consumption_wh_km": times(result.consumption, 1 / WH_PER_KM),
        "range_km": times(metres, 1e-3),
        "shortfall_s": sum(s.duration for s in result.shortfalls),
    }


@contextlib.contextmanager
def _bar(seconds: float | None, unit: str) -> Iterator[Progress | None]:
    """What counts the seconds ridden; a progress bar where standard error is a terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from tqdm import tqdm

    with tqdm(total=seconds, unit=f" {unit}", file=sys.stderr, leave=False, mininterval=0.2) as bar:
        yield bar.update
