"""``gz-onboard calibrate``: measurements in, a vehicle file out, with a report of how well each number is known."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.errors import InputError, nearest
from gz_onboard.lab.calibrate import (
    auxiliary,
    cooling,
    cooling_run,
    losses,
    manifest,
    motor,
    ocv,
    offsets,
    pulse,
    report,
    resistance,
    wheel,
)
from gz_onboard.lab.calibrate import coastdown as coasting
from gz_onboard.lab.calibrate.cell_data import cell_test
from gz_onboard.lab.calibrate.coastdown_run import samples as coastdown_samples
from gz_onboard.lab.calibrate.fit import score
from gz_onboard.lab.calibrate.manifest import Option, Slot, Step, check_count
from gz_onboard.lab.calibrate.result import Curve, Found, Panel, PlotLine, Result
from gz_onboard.lab.calibrate.table import Measurements, read_table
from gz_onboard.lab.calibrate.vehicle_file import write_vehicle
from gz_onboard.simulation.samples import Samples, read_samples
from gz_onboard.vehicle import Vehicle, find_vehicle, read_vehicle

# --- what a procedure is given ------------------------------------------------------------------------------------


@dataclass
class Given:
    """The data of one step, read, and what is known by then."""

    vehicle: Vehicle  # with the results of earlier steps
    earlier: list[Result]
    tables: dict[str, list[Measurements]] = field(default_factory=dict)  # by slot
    rides: dict[str, list[Samples]] = field(default_factory=dict)
    options: dict[str, Option] = field(default_factory=dict)

    def number(self, name: str) -> float:
        """The option `name`, a number."""
        return float(self.options[name])

    def one(self, slot: str) -> Measurements | None:
        """The one table of a slot that may be left out."""
        tables = self.tables.get(slot)
        return tables[0] if tables else None


@dataclass(frozen=True)
class Procedure:
    """A row of the registry: what it takes and how its pure function is called."""

    what: str
    slots: Mapping[str, Slot]
    run: Callable[[Given], Result]
    options: Mapping[str, Option] = field(default_factory=dict)


def _wheel(given: Given) -> Result:
    return wheel.calibrate(given.rides["data"], given.vehicle)


def _motor(given: Given) -> Result:
    result = Result("motor")
    if ramp := given.one("emf"):
        _add(result, motor.voltage_constant(ramp))
    (dyno,) = given.tables["data"]
    _add(result, motor.torque_constant(dyno, given.one("warming"), given.number("largest_current")))
    return result


def _losses(given: Given) -> Result:
    (dyno,) = given.tables["data"]
    result = Result("losses")
    _add(result, losses.motor_losses(dyno, given.number("largest_current")))
    _add(result, losses.inverter_losses(dyno, given.number("largest_current")))
    copper = "motor_copper_temperature_coefficient"
    if any(refusal.startswith(copper) for refusal in result.refusals):
        del result.parameters[copper]  # not measured: what the base file says stays
    return result


def _ocv(given: Given) -> Result:
    return ocv.calibrate(given.tables["data"][0])


THESIS_VOLTS = 0.02  # V: what Lord 2016 gives for a cell on a road profile


def _pulse(given: Given) -> Result:
    curve, capacity = _open_circuit(given)
    loads = [_load(ride) for ride in given.rides.get("load", [])]
    method = str(given.options["method"])
    result = pulse.calibrate(given.tables["data"], curve, capacity, loads=loads or None, method=method)
    cell = pulse.circuit(result)
    for table in given.tables.get("held_out", []):
        test = cell_test(table)
        model, measured = pulse.follow_profile(cell, test)
        result.fits.append(score("cell voltage", "V", measured, model, held_out=True, source=table.file.name))
        near = float(np.mean(np.abs(model - measured) <= THESIS_VOLTS))
        result.notes.append(f"{table.file.name}: {100 * near:.0f} % of the samples within ±{THESIS_VOLTS:g} V")
        minutes = test.time / 60
        result.panels += [
            Panel(
                f"{table.file.name}, held out",
                "time [min]",
                "cell voltage [V]",
                (PlotLine("measured", minutes, measured), PlotLine("model", minutes, model)),
            ),
            Panel(
                f"{table.file.name}: residual",
                "time [min]",
                "model less measured [mV]",
                (PlotLine("", minutes, 1000 * (model - measured)),),
            ),
        ]
    return result


def _open_circuit(given: Given) -> tuple[Curve, Found]:
    """The open-circuit voltage and capacity: as just calibrated, else the vehicle file's."""
    for result in reversed(given.earlier):
        if "battery.ocv" in result.curves and "cell_capacity" in result.parameters:
            return result.curves["battery.ocv"], result.parameters["cell_capacity"]
    battery, known = given.vehicle.pack, given.vehicle.parameters.known["cell_capacity"]
    value = np.array(battery.ocv_value)
    curve = Curve(
        {"soc": np.array(battery.ocv_soc)}, value, np.full(len(value), battery.ocv_sd), "V", given.vehicle.file.name
    )
    return curve, Found(known.value, known.sd, known.unit, known.source)


def _load(ride: Samples) -> Array:
    """The pack current of a ride [A], once a second."""
    if "pack_current" not in ride.columns:
        raise InputError(f"{ride.name}: has no pack_current, so it is no load for the cell")
    at, current = ride.columns["pack_current"]
    seconds = np.arange(np.floor(at[0]), np.floor(at[-1]))
    return np.asarray(np.interp(seconds + 0.5, at, current))


def _auxiliary(given: Given) -> Result:
    return auxiliary.auxiliary_power(given.rides["data"])


def _offsets(given: Given) -> Result:
    return offsets.offsets(given.rides["data"], given.vehicle)


def _resistance(given: Given) -> Result:
    result = resistance.cable_resistance(given.rides["data"], given.vehicle)
    result.procedure = "resistance"
    _add(result, resistance.pack_series_resistance(given.rides["data"], given.vehicle, given.tables.get("pulses", [])))
    return result


def _cooling(given: Given) -> Result:
    """All four networks, of what of them the data show; what is missing is said."""
    runs, held = _cooling_runs(given, "data"), _cooling_runs(given, "held_out")
    result = Result("cooling")
    networks = {
        "motor_temperature": cooling.motor_cooling,
        "inverter_temperature": cooling.inverter_cooling,
        "cell_temperature": cooling.pack_cooling,
        "bms_temperature": cooling.bms_cooling,
    }
    for sensor, network in networks.items():
        if any(sensor in run.measured for run in runs):
            _add(result, network(runs, given.vehicle, [run for run in held if sensor in run.measured]))
        else:
            result.refusals.append(f"{network.__name__}: no run has {sensor}")
    if not result.parameters:
        raise InputError(f"none of the runs has {', '.join(networks)}")
    return result


def _cooling_runs(given: Given, slot: str) -> list[cooling_run.CoolingRun]:
    bench = [cooling_run.bench_run(table, given.vehicle) for table in given.tables.get(slot, [])]
    return bench + [cooling_run.ride_run(ride, given.vehicle) for ride in given.rides.get(slot, [])]


def _coastdown(given: Given) -> Result:
    runs = given.rides.get("data", []) + [coastdown_samples(table) for table in given.tables.get("data", [])]
    return coasting.calibrate(runs, given.vehicle, wind_sd=given.number("wind_sd"), slope_sd=given.number("slope_sd"))


_LARGEST: dict[str, Option] = {"largest_current": motor.RIDING_CURRENT}

# In the order of `calibrate all`: a procedure may use what those above it have found.
PROCEDURES: dict[str, Procedure] = {
    "wheel": Procedure(
        "rolling radius of the driven wheel from GPS speed over motor speed",
        {"data": Slot("ride", "rides with GPS", 1)},
        _wheel,
    ),
    "motor": Procedure(
        "constants of the motor from a dynamometer: back-EMF over speed, torque over current",
        {
            "data": Slot("table", "steady points of a motor dynamometer", 1, 1),
            "emf": Slot("table", "back-EMF over speed at no torque", 0, 1),
            "warming": Slot("table", "a run at constant current in which the motor warms up", 0, 1),
        },
        _motor,
        _LARGEST,
    ),
    "losses": Procedure(
        "loss of motor and inverter in watts, from a dynamometer with power analyser",
        {"data": Slot("table", "steady points of a motor dynamometer", 1, 1)},
        _losses,
        _LARGEST,
    ),
    "ocv": Procedure(
        "open-circuit voltage and capacity of a cell from a slow discharge and charge",
        {"data": Slot("table", "a discharge (and charge) of C/8 or slower", 1, 1)},
        _ocv,
    ),
    "pulse": Procedure(
        "R0, R1, C1 over state of charge and temperature from pulse tests of a cell",
        {
            "data": Slot("table", "pulse tests, one for each temperature", 1),
            "held_out": Slot("table", "a road profile of the cell, to validate", 0),
            "load": Slot("ride", "rides whose current the cell is to follow", 0),
        },
        _pulse,
        {"method": "reduced"},
    ),
    "auxiliary": Procedure(
        "power of lamps, dashboard and control", {"data": Slot("ride", "rides with auxiliary current", 1)}, _auxiliary
    ),
    "offsets": Procedure(
        "offset, gain and noise of the pack's sensors",
        {"data": Slot("ride", "rides that begin or end at rest", 1)},
        _offsets,
    ),
    "resistance": Procedure(
        "resistance of pack and cable beside the cells",
        {
            "data": Slot("ride", "rides, above 20 degC for the pack", 1),
            "pulses": Slot("table", "pulse tests of a cell, at two temperatures or more", 0),
        },
        _resistance,
    ),
    "cooling": Procedure(
        "the four cooling networks from warming up and cooling down, on a bench (tables) and on the vehicle (rides)",
        {"data": Slot("any", "runs of 5 min or longer", 1), "held_out": Slot("any", "further runs, to validate", 0)},
        _cooling,
    ),
    "coastdown": Procedure(
        "rolling resistance and drag area from coast-downs in both directions",
        {"data": Slot("any", "coast-downs in both directions: rides, or tables of time and speed", 2)},
        _coastdown,
        {"wind_sd": coasting.WIND_SD, "slope_sd": coasting.SLOPE_SD},
    ),
}


def _add(result: Result, other: Result) -> None:
    """Put what `other` found into `result`."""
    result.parameters |= other.parameters
    result.curves |= other.curves
    result.covariance += other.covariance
    result.fits += other.fits
    result.refusals += other.refusals
    result.notes += other.notes
    result.panels += other.panels


# --- running them -------------------------------------------------------------------------------------------------


def calibrate(
    steps: Sequence[Step], base: Path, tell: Callable[[str], None] = lambda _: None
) -> tuple[list[Result], dict[str, float]]:
    """(what the `steps` found, seconds that each took), each with what those before it found put into `base`.

    Raises InputError for data that cannot be used, naming the procedure.
    """
    read: dict[Path, Samples] = {}
    results: list[Result] = []
    seconds: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        for step in steps:
            begin = time.perf_counter()
            procedure = PROCEDURES[step.procedure]
            vehicle = _known_by_now(base, results, Path(folder) / "vehicle.toml")
            given = Given(vehicle, results, options={**procedure.options, **step.options})
            for slot, files in step.files.items():
                for file in files:
                    tell(f"{step.procedure}: {file.name}")
                    if is_table(file, procedure.slots[slot].kind):
                        given.tables.setdefault(slot, []).append(read_table(file, step.columns.get(slot)))
                        continue
                    if file not in read:
                        read[file] = read_samples(file, vehicle)
                    given.rides.setdefault(slot, []).append(read[file])
            tell(f"{step.procedure}: fitting")
            try:
                results.append(procedure.run(given))
            except InputError as error:
                raise InputError(f"{step.procedure}: {error}") from error
            seconds[step.procedure] = time.perf_counter() - begin
    return results, seconds


def is_table(file: Path, kind: str) -> bool:
    """Whether `file` is read as a table, in a slot of `kind` (see `Slot`)."""
    if kind != "any":
        return kind == "table"
    return file.name.endswith((".csv", ".csv.gz", ".parquet", ".pq"))


def for_file(results: Sequence[Result], vehicle: Vehicle) -> list[Result]:
    """`results` with only what a vehicle file holds: the rest is for the report."""
    kept = []
    for result in results:
        parameters = {name: f for name, f in result.parameters.items() if name in vehicle.parameters}
        curves = {name: c for name, c in result.curves.items() if name.startswith("battery.")}
        covariance = []
        for names, matrix in result.covariance:
            inside = [i for i, name in enumerate(names) if name in vehicle.parameters]
            covariance.append((tuple(names[i] for i in inside), np.asarray(matrix)[np.ix_(inside, inside)]))
        kept.append(replace(result, parameters=parameters, curves=curves, covariance=covariance))
    return kept


def _known_by_now(base: Path, results: Sequence[Result], file: Path) -> Vehicle:
    """The vehicle with what was found so far; its complaints name the base file."""
    if not results:
        return read_vehicle(base)
    write_vehicle(base, for_file(results, read_vehicle(base)), file)
    return replace(read_vehicle(file), file=base)


# --- command line -------------------------------------------------------------------------------------------------


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of ``gz-onboard calibrate``."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = "\n".join(
        ["what to calibrate, and from which data:"]
        + [f"  {'all':<12} everything that the manifest {manifest.NAME} of a folder names"]
        + [line for name, procedure in PROCEDURES.items() for line in _help(name, procedure)]
        + [
            "",
            "Tables are CSV (.csv, .csv.gz) or Parquet with the unit in the name of a column: time_s, current_A.",
            "Rides are logs in any format that `gz-onboard estimate` reads. See docs/calibration.md.",
        ]
    )
    parser.add_argument("what", metavar="WHAT", help="a procedure, or all")
    parser.add_argument(
        "data", metavar="DATA", nargs="+", type=Path, help="files; for `all` a folder with its manifest"
    )
    parser.add_argument(
        "--vehicle", metavar="V", help="vehicle file to start from (default: reference, or the manifest's)"
    )
    parser.add_argument("--out", metavar="NEW.toml", type=Path, help="write the vehicle file with what was found")
    parser.add_argument("--report", metavar="R.html", type=Path, help="write a page with data, model, residuals")
    parser.add_argument("--json", metavar="FILE", type=Path, help="write what was found as JSON; - for standard output")
    parser.add_argument(
        "--with", dest="more", metavar="NAME=FILE", action="append", default=[], help="further data of a procedure"
    )
    parser.add_argument(
        "--held-out", metavar="FILE", action="append", default=[], help="the same as --with held_out=FILE"
    )
    parser.add_argument("--set", metavar="OPTION=VALUE", action="append", default=[], help="an option of a procedure")


def _help(name: str, procedure: Procedure) -> Iterator[str]:
    yield f"  {name:<12} {procedure.what}"
    for slot, s in procedure.slots.items():
        key = "DATA" if slot == "data" else f"--with {slot}=FILE"
        yield f"  {'':<12}   {key}: {s.what}{'' if s.least else ' (may be left out)'}"
    if procedure.options:
        yield f"  {'':<12}   --set {', '.join(f'{k}={v}' for k, v in procedure.options.items())}"


def run(arguments: argparse.Namespace) -> int:
    """Run ``gz-onboard calibrate``; 0 if all was found, also where something was refused with its reason."""
    if arguments.what != "all" and arguments.what not in PROCEDURES:
        known = ["all", *PROCEDURES]
        raise InputError(
            f"no procedure is called {arguments.what!r}{nearest(arguments.what, known)}; there are {', '.join(known)}"
        )
    base, steps = _asked(arguments)
    for file in (arguments.out, arguments.report, arguments.json):
        if file is not None and str(file) != "-" and not file.parent.is_dir():
            raise InputError(f"{file}: there is no folder {file.parent}")
    quiet = str(arguments.json) == "-"
    with _Progress(sum(len(files) for s in steps for files in s.files.values()) + len(steps)) as progress:
        results, seconds = calibrate(steps, base, progress.tell)
    if not quiet:
        for result in results:
            print(f"{report.text(result)}\n  ({seconds[result.procedure]:.1f} s)")
    try:
        if arguments.out:
            write_vehicle(base, for_file(results, read_vehicle(base)), arguments.out)
            read_vehicle(arguments.out)
        if arguments.report:
            report.write_report(arguments.report, f"Calibration of {read_vehicle(base).name}", results)
        _write_json(arguments, report.document(results, str(base), str(arguments.out) if arguments.out else None))
    except OSError as error:
        raise InputError(f"{error.filename}: {error.strerror}") from error
    if not quiet:
        for file in (arguments.out, arguments.report):
            if file:
                print(f"{file} written")
    return 0


def _write_json(arguments: argparse.Namespace, document: Mapping[str, Any]) -> None:
    if arguments.json is None:
        return
    text = json.dumps(document, indent=1, ensure_ascii=False) + "\n"
    if str(arguments.json) == "-":
        print(text, end="")
    else:
        arguments.json.write_text(text, encoding="utf-8")


def _asked(arguments: argparse.Namespace) -> tuple[Path, list[Step]]:
    """(vehicle file to start from, steps) of a command line."""
    if arguments.what == "all":
        if len(arguments.data) > 1:
            raise InputError("all takes one folder (or manifest); what is in it stands in its manifest")
        if arguments.more or arguments.held_out or arguments.set:
            raise InputError("all takes its data and options from the manifest, not from --with, --held-out or --set")
        slots = {name: p.slots for name, p in PROCEDURES.items()}
        base, steps = manifest.read_manifest(
            arguments.data[0], slots, {name: p.options for name, p in PROCEDURES.items()}
        )
        return (find_vehicle(arguments.vehicle) if arguments.vehicle else base), steps
    name, procedure = arguments.what, PROCEDURES[arguments.what]
    files: dict[str, list[Path]] = {"data": list(arguments.data)}
    for text in [*arguments.more, *(f"held_out={file}" for file in arguments.held_out)]:
        slot, equals, file = text.partition("=")
        if not equals or slot not in procedure.slots:
            raise InputError(
                f"--with {text}: {name} has no data {slot!r}{nearest(slot, procedure.slots)}; "
                f"there are {', '.join(procedure.slots)}"
            )
        files.setdefault(slot, []).append(Path(file))
    for slot, needed in procedure.slots.items():
        check_count(name, slot, needed, len(files.get(slot, ())))
    for file in (file for group in files.values() for file in group):
        if not file.is_file():
            there = [p.name for p in file.parent.glob("*")] if file.parent.is_dir() else []
            raise InputError(f"{file}: no such file{nearest(file.name, there)}")
    step = Step(name, {slot: tuple(group) for slot, group in files.items()}, {}, _options(arguments.set, procedure))
    return find_vehicle(arguments.vehicle or "reference"), [step]


def _options(texts: Sequence[str], procedure: Procedure) -> dict[str, Option]:
    found: dict[str, Option] = {}
    for text in texts:
        name, _, value = text.partition("=")
        if name not in procedure.options:
            known = ", ".join(procedure.options) or "none"
            raise InputError(f"--set {text}: no option {name!r}{nearest(name, procedure.options)}; there are {known}")
        if isinstance(procedure.options[name], str):
            found[name] = value
            continue
        try:
            number = float(value)
        except ValueError as error:
            raise InputError(f"--set {text}: {value!r} is not a number") from error
        if not manifest.LEAST <= number <= manifest.MOST:
            raise InputError(f"--set {text}: must be {manifest.LEAST:g} to {manifest.MOST:g}")
        found[name] = number
    return found


class _Progress:
    """A bar on a terminal, else nothing."""

    def __init__(self, total: int) -> None:
        from tqdm import tqdm

        self._bar = tqdm(total=total, unit="step", leave=False, disable=not sys.stderr.isatty())

    def __enter__(self) -> _Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def tell(self, text: str) -> None:
        """Show what is done next."""
        self._bar.set_description(text)
        self._bar.update()
