"""``gz-onboard simulate``: the simulated scooter along a drive cycle, a route or a recorded ride.

It prints the energy used, the range at that consumption, where the energy went and where the profile was beyond the
vehicle; and writes time series and pictures.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from gz_onboard.constants import HOUR, WH_PER_KM
from gz_onboard.errors import OK, InputError, not_an_input
from gz_onboard.imports import require
from gz_onboard.options import PICTURE_FORMATS, add_shared, number
from gz_onboard.progress import Progress, progress_bar
from gz_onboard.reports.results import times, write_json
from gz_onboard.simulation.frames import Dropouts, check_output, messages_sent
from gz_onboard.simulation.output import FORMATS, PICTURES, output_file, write, write_ride
from gz_onboard.simulation.plan import RANGES, Plan, SimulationOptions, find_plan, vehicle_on
from gz_onboard.simulation.recorded import rest_soc, scooter_at_start
from gz_onboard.simulation.run import Run, drive
from gz_onboard.simulation.scooter import Scooter
from gz_onboard.simulation.summary import SUMMARY_VERSION, Variant, cycle_range, summarise, summary_text
from gz_onboard.simulation.sweep import Sweep, grid, read_sweep, redesigned
from gz_onboard.simulation.turning import MODELS, chassis
from gz_onboard.vehicle import Vehicle, find_vehicle

_MOST_HOURS = 48.0  # of riding until empty


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard simulate``."""
    add = parser.add_argument
    what = "name of a built-in drive cycle, CSV of a cycle, CSV or GPX of a route, or log of a ride to be replayed"
    add("what", metavar="WHAT", help=what)
    add_shared(parser, "--vehicle", "--payload")
    charge = "state of charge at the start (default: 1; of a recorded ride, as recorded)"
    _number(parser, "--soc", *RANGES["soc"], help=charge)
    air = "temperature of air and vehicle at the start (default: 20)"
    _number(parser, "--ambient", *RANGES["ambient"], metavar="C", help=air)
    hill = "of the road, uphill positive (default: %(default)g)"
    _number(parser, "--grade", *RANGES["grade"], default=0.0, metavar="PERCENT", help=hill)
    _number(parser, "--wind", *RANGES["wind"], default=0.0, help="headwind (default: %(default)g)")
    often = parser.add_mutually_exclusive_group()
    repeat = number("--repeat", *RANGES["repeat"], kind=int)
    often.add_argument("--repeat", type=repeat, default=1, metavar="N", help="ride it N times (default: %(default)s)")
    often.add_argument("--until-empty", action="store_true", help="repeat it until the pack is empty")
    dyno = "on a chassis dynamometer: inertia of the roller [kg], force A + B·V + C·V² [N] at a speed V [m/s]"
    add("--dyno", metavar="KG[,A,B,C]", help=dyno)
    bends = f"chassis model: {', '.join(MODELS)}; straight loses nothing in bends (default: %(default)s)"
    add("--chassis", choices=tuple(MODELS), default="straight", metavar="MODEL", help=bends)
    predictive = "follow the speed of a recorded ride instead of replaying its throttle and brake"
    add("--predictive", action="store_true", help=predictive)
    sweep = "vary a parameter, battery.cells_parallel or battery.cells_series; at most twice"
    add("--sweep", action="append", default=[], metavar="NAME=LO..HI[:N]", help=sweep)
    add_shared(parser, "--output", "--json")
    kinds = (
        f"time series: {', '.join(FORMATS)} (default: parquet); pictures: {', '.join(PICTURE_FORMATS)} (default: png)"
    )
    add("--format", action=_Format, choices=(*FORMATS, *PICTURE_FORMATS), default="parquet", metavar="NAME", help=kinds)
    parser.set_defaults(picture_format=PICTURE_FORMATS[0])
    add("--no-series", action="store_true", help="write no time series")
    add_shared(parser, "--no-plot")
    frames = "write the ride as CAN frames of the vehicle's sensors: .blf .log .asc .trc .csv .mf4"
    add("--frames", type=Path, metavar="FILE", help=frames)
    add_shared(parser, "--seed", help="seed of the noise and losses of --frames (default: %(default)s)")
    lost = f"share of the --frames that the bus loses (default: {Dropouts.frames:g})"
    _number(parser, "--frame-loss", 0.0, 1.0, metavar="SHARE", help=lost)
    add_shared(parser, "--quiet")


class _Format(argparse.Action):
    """A format of the time series, or of the pictures."""

    def __call__(self, parser: object, namespace: argparse.Namespace, values: object, option: object = None) -> None:
        setattr(namespace, "picture_format" if values in PICTURE_FORMATS else "format", values)


def _number(
    parser: argparse.ArgumentParser, option: str, low: float, high: float, unit: str = "", **about: Any
) -> None:
    about = {"metavar": unit.upper() or f"{low:g}..{high:g}", **about}
    parser.add_argument(option, type=number(option, low, high, unit), **about)


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard simulate``."""
    require("matplotlib", not arguments.no_plot)
    require("pyarrow", not arguments.no_series)
    vehicle, payload_from = vehicle_on(arguments.what, arguments.vehicle, arguments.payload)
    options = SimulationOptions(**{field.name: getattr(arguments, field.name) for field in fields(SimulationOptions)})
    sweeps = [read_sweep(text, vehicle) for text in arguments.sweep]
    if len(sweeps) > 2:
        raise InputError(f"--sweep {arguments.sweep[2]}: at most two parameters can be swept")
    if len({sweep.name for sweep in sweeps}) < len(sweeps):
        raise InputError(f"--sweep {sweeps[0].name}: given twice")
    if arguments.frames:
        check_output(arguments.frames)
        messages_sent(vehicle)
    elif arguments.frame_loss is not None:
        raise InputError(f"--frame-loss {arguments.frame_loss:g}: is for --frames FILE")
    plan = find_plan(arguments.what, options, vehicle)
    pictures = [".html", *(f"{name}.{arguments.picture_format}" for name in PICTURES)]
    endings = [*(() if arguments.no_series else [f".{arguments.format}"]), *(() if arguments.no_plot else pictures)]
    written = [arguments.frames, arguments.json, *(output_file(arguments, plan, ending) for ending in endings)]
    not_an_input(written, [Path(arguments.what), find_vehicle(arguments.vehicle)])
    begin = time.perf_counter()
    expected = _expected_seconds(options, plan, sweeps)
    with progress_bar(lambda: expected, "s ridden", quiet=arguments.quiet) as display:
        result, scooter = ride(vehicle, plan, options, display.update, bool(arguments.frames))
        wall = time.perf_counter() - begin
        variants = (
            [variant(vehicle, values, plan, options, display.update) for values in grid(sweeps)] if sweeps else None
        )
    found = summarise(vehicle, plan, arguments.what, result, scooter)
    found = replace(found, payload_from=payload_from, wall_s=wall, sweep=variants)
    files = write(arguments, vehicle, plan, result, found, sweeps)
    if arguments.frames:
        files.append(write_ride(arguments, vehicle, result, scooter))
    summary = replace(found, files=files)
    write_json(arguments.json, SUMMARY_VERSION, summary)
    if arguments.json != "-":
        print(summary_text(summary))
    return OK


def ride(
    vehicle: Vehicle, plan: Plan, options: SimulationOptions, progress: Progress | None, keep_steps: bool = False
) -> tuple[Run, Scooter]:
    """Ride `plan` with `options`; where these leave the start open, it is as recorded."""
    recorded, soc = plan.recorded, options.soc
    if soc is None:
        measured = rest_soc(recorded, vehicle) if recorded else None
        soc = 1.0 if measured is None else measured
    scooter = scooter_at_start(
        recorded,
        vehicle,
        plan.road,
        options.ambient,
        soc=soc,
        heading=plan.heading,
        vibration=plan.vibration,
        chassis=chassis(options.chassis, vehicle.parameters),
    )
    seconds = _MOST_HOURS * HOUR if options.until_empty else plan.seconds * options.repeat
    if plan.length is not None:
        seconds = 3 * plan.seconds + 600  # a weak vehicle takes longer
    result = drive(
        scooter,
        plan.command(),
        seconds,
        until_empty=options.until_empty,
        finish=plan.length,
        progress=progress,
        keep_steps=keep_steps,
    )
    return result, scooter


def _expected_seconds(options: SimulationOptions, plan: Plan, sweeps: Sequence[Sweep]) -> float | None:
    if options.until_empty:
        return None
    rides = 1 + (len(grid(sweeps)) if sweeps else 0)
    return plan.seconds * float(options.repeat) * rides


def variant(
    vehicle: Vehicle, values: dict[str, float], plan: Plan, options: SimulationOptions, progress: Progress | None
) -> Variant:
    """The ride with other `values` of the swept parameters."""
    result, scooter = ride(redesigned(vehicle, values), plan, options, progress)
    range_km, _ = cycle_range(result, scooter)
    shortfall = sum(s.duration_s for s in result.shortfalls)
    return Variant(values, times(result.consumption, 1 / WH_PER_KM), range_km, shortfall)
