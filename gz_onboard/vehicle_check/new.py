"""``gz-onboard vehicle new``: write a commented vehicle file and a DBC skeleton to start from.

`typical.toml` has what to assume of each kind of vehicle and cell chemistry; the templates have the comments.
"""

from __future__ import annotations

import argparse
import json
import os
import tomllib
from collections.abc import Iterable
from functools import cache
from math import ceil, log
from pathlib import Path
from statistics import fmean
from string import Template
from textwrap import fill
from typing import Any

from gz_onboard.errors import OK, InputError
from gz_onboard.model.parameters import MOST_CELLS, declared_parameters
from gz_onboard.options import number
from gz_onboard.pipeline import Pipeline
from gz_onboard.vehicle import read_vehicle
from gz_onboard.vehicle_check.finding import features_of, features_text

FINE_RANGE_WH = 5000.0  # the fine scale of the range frames ends at 6500 Wh
WIRES = 0.1  # of the cells' R0


@cache
def typical() -> dict[str, Any]:
    """The contents of `typical.toml`."""
    return tomllib.loads(Path(__file__).with_name("typical.toml").read_text(encoding="utf-8"))


def kinds() -> list[str]:
    """Return the kinds of vehicle that can be started from."""
    return list(typical()["kind"])


def chemistries() -> list[str]:
    """Return the cell chemistries that have typical tables."""
    return [name for name, value in typical()["cell"].items() if isinstance(value, dict)]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``gz-onboard vehicle new``."""
    add, declared = parser.add_argument, declared_parameters()

    def parameter(option: str, name: str) -> Any:
        return number(option, declared[name].low, declared[name].high, declared[name].unit)

    count = number("--series", 1, MOST_CELLS, kind=int, counted="cells")
    add("file", metavar="TOML", type=Path, help="vehicle file to write; its DBC file gets the same name")
    add("--kind", type=str.lower, choices=kinds(), required=True, metavar="KIND", help=", ".join(kinds()))
    names = chemistries()
    add("--cells", type=str.lower, choices=names, required=True, metavar="NAME", help=f"chemistry: {', '.join(names)}")
    series = "cells in series: voltage of the full pack over 4.2 V, of LFP over 3.5 V"
    add("--series", type=count, required=True, metavar="N", help=series)
    capacity = parameter("--capacity", "cell_capacity")
    add("--capacity", type=capacity, required=True, metavar="AH", help="of the pack [A·h]")
    mass = parameter("--mass", "vehicle_mass")
    add("--mass", type=mass, required=True, metavar="KG", help="of the vehicle without its rider")
    radius = parameter("--wheel-radius", "wheel_radius")
    add("--wheel-radius", type=radius, required=True, metavar="M", help="of the driven wheel")
    gear = parameter("--gear-ratio", "gear_ratio")
    add("--gear-ratio", type=gear, default=1.0, metavar="RATIO", help="wheel speed over motor speed (default: 1)")
    power, fastest = number("--power", 50.0, 1e6, "W"), number("--top-speed", 5.0, 400.0, "km/h")
    add("--power", type=power, metavar="W", help="peak of the motor, about twice its rated power (default: by kind)")
    add("--top-speed", type=fastest, metavar="KM/H", help="of the vehicle (default: by kind)")


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard vehicle new``: write both files or neither. InputError for a file that exists or bad values."""
    file: Path = arguments.file
    if file.suffix != ".toml":
        raise InputError(f"{file}: the name of a vehicle file must end in .toml")
    texts = {file: vehicle_text(arguments), file.with_suffix(".dbc"): dbc_text(arguments)}
    for each in texts:
        if os.path.lexists(each):
            raise InputError(f"{each}: exists already and is not overwritten")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        for each, text in texts.items():
            each.write_text(text, encoding="utf-8")
        vehicle = read_vehicle(file)
        Pipeline(vehicle)
    except (InputError, OSError) as error:
        for each in texts:
            each.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise InputError(f"{error.filename or file}: cannot be written: {error.strerror}") from error
        raise
    print(f"wrote {' and '.join(map(str, texts))}")
    print(features_text(features_of({source.role for source in vehicle.mapping.sources})))
    print(f"next: edit {file.with_suffix('.dbc')} to match your frames, then gz-onboard vehicle check {file} LOG")
    return OK


def dbc_text(given: argparse.Namespace) -> str:
    """Return the DBC skeleton, with the limits of the pack."""
    cell = typical()["cell"][given.cells]
    low, high = 0.7 * cell["cutoff"][0] * given.series, 1.1 * cell["ocv"][-1] * given.series
    return _filled(
        "new.dbc.template",
        volt_step="0.01" if high < 600 else "0.1",  # as 16 bits can hold
        volt_low=f"{low:.0f}",
        volt_high=f"{high:.0f}",
        amperes=f"{min(max(10 * given.capacity, 1.0), 1600.0):.0f}",  # ten capacities an hour; 16 bits hold 1638 A
        series=given.series,
    )


def vehicle_text(given: argparse.Namespace) -> str:
    """Return the vehicle file."""
    known = typical()
    kind, cells, entered = known["kind"][given.kind], known["cell"], known["entered"]
    cell = cells[given.cells]
    energy = fmean(cell["ocv"]) * given.series * given.capacity
    ohm_of_cells = cell["r0"] * given.series / given.capacity
    r0, r1 = ([cell[name] / given.capacity * factor for factor in cells["resistance"]] for name in ("r0", "r1"))
    numbers = {
        "drift": kind["drift"],
        "mass": given.mass,
        "mass_sd": entered["mass_sd"] * given.mass,
        "radius": given.wheel_radius,
        "radius_sd": entered["wheel_radius_sd"] * given.wheel_radius,
        "gear": given.gear_ratio,
        "capacity": given.capacity,
        "capacity_sd": entered["capacity_sd"] * given.capacity,
        "wires": WIRES * ohm_of_cells,
        "resistance_sd": cells["resistance_sd"],
        "relaxation": cells["relaxation"],
        "error_sd": cells["error_sd"],
        "full": cell["ocv"][-1],
        **{name: cell[name] for name in ("ocv_sd", "rest_sd")},
        "capacities_sd": cell["capacity_sd"],
    }
    for name in ("payload", "drag_area", "rolling", "cutoff"):
        numbers[name], numbers[f"{name}_sd"] = kind[name] if name in kind else cell[name]
    rows = {
        "soc": cells["soc"],
        "ocv": cell["ocv"],
        "temperatures": cells["temperature"],
        "capacities": [given.capacity * share for share in cell["capacity"]],
    }
    circuit = {"r0": r0, "r1": r1, "c1": [cells["relaxation"] / r for r in r1]}
    return _filled(
        "new.toml.template",
        **{name: f"{value:.4g}" for name, value in numbers.items()},
        **{name: _row(values) for name, values in rows.items()},
        **{name: f"[{', '.join(_row([value, value]) for value in values)}]" for name, values in circuit.items()},
        **{name: cell[name] for name in ("ocv_source", "rest_source", "capacity_source")},
        **_motor(given, kind),
        name=given.file.stem,
        dbc=f"{given.file.stem}.dbc",
        kind=given.kind,
        chemistry=given.cells.upper(),
        range_dbc=kind["range_dbc"] if energy < FINE_RANGE_WH else "range_large.dbc",
        series=given.series,
        shape=fill(f"This curve {cell['ocv_shape']}.", 118, initial_indent="# ", subsequent_indent="# "),
        circuit_source=f"{cell['r_source']}; {cells['resistance_source']}",
    )


def _motor(given: argparse.Namespace, kind: dict[str, Any]) -> dict[str, str]:
    """Current limit, and the share of it over motor speed: constant torque, constant power, top speed."""
    power, top_speed = given.power or kind["power"], given.top_speed or kind["top_speed"]
    torque = (given.mass + kind["payload"][0]) * kind["pull"] * given.wheel_radius * given.gear_ratio  # N·m
    fastest = top_speed / 3.6 / given.wheel_radius / given.gear_ratio  # rad/s
    base, last = power / torque, 0.97 * fastest
    speeds, shares = [last], [1.0]
    if base < last:  # points less than 30 % apart: the line between them is close to constant power
        count = ceil(log(last / base) / log(1.3))
        speeds = [base * (last / base) ** (i / count) for i in range(count + 1)]
        shares = [base / speed for speed in speeds]
    limit = torque / declared_parameters()["torque_constant"].prior
    source = f"{power:g} W at the peak, {top_speed:g} km/h: entered, or usual for a {given.kind}"
    return {
        "current_limit": f"{limit:.4g}",
        "current_limit_sd": f"{0.3 * limit:.4g}",
        "pull": f"{kind['pull']:g}",
        "motor_speeds": _row([*speeds, 1.03 * fastest]),
        "motor_shares": _row([*shares, 0.0]),
        "motor_source": source,
        "motor_status": "data sheet" if given.power and given.top_speed else "guess",
    }


def _filled(template: str, **values: Any) -> str:
    return Template(Path(__file__).with_name(template).read_text(encoding="utf-8")).substitute(values)


def _row(values: Iterable[float]) -> str:
    return json.dumps([float(f"{value:.4g}") for value in values])
