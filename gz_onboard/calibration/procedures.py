"""The procedures of ``gz-onboard calibrate``: which data each takes, and how its pure function is called."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.calibration import cell, coastdown, cooling, motor, pulse, sensors
from gz_onboard.calibration.result import Curve, Found, Result
from gz_onboard.calibration.table import Measurements
from gz_onboard.errors import InputError
from gz_onboard.recording.recording import Recording, ride_name
from gz_onboard.recording.sensors import true_columns
from gz_onboard.vehicle import Vehicle

Option = float | str | Mapping[str, float | str]
"""A number; of ``airflow`` also one of `cooling.AIRFLOWS`, or by the name of a file either of both."""


@dataclass(frozen=True)
class Slot:
    """The files of one kind that a procedure takes.

    kind: "table", "ride", or "any": CSV and Parquet are tables then. min_files: 0 for a slot that may be left out.
    max_files: None for any number.
    """

    kind: str
    what: str
    min_files: int = 0
    max_files: int | None = None

    def is_table(self, file: Path) -> bool:
        """Whether `file` is read as a table, not as a ride."""
        if self.kind != "any":
            return self.kind == "table"
        return file.name.endswith((".csv", ".csv.gz", ".parquet", ".pq"))


@dataclass
class Given:
    """The data of one step, read, and the results before it."""

    vehicle: Vehicle  # with the results of earlier steps
    earlier: list[Result]
    tables: dict[str, list[Measurements]] = field(default_factory=dict)  # by slot
    rides: dict[str, list[Recording]] = field(default_factory=dict)
    options: dict[str, Option] = field(default_factory=dict)

    def number(self, name: str) -> float:
        """The option `name`, a number."""
        value = self.options[name]
        assert isinstance(value, float | int)
        return float(value)


@dataclass(frozen=True)
class Procedure:
    """A procedure: its purpose, the files it takes by slot, how it is run, and its options with their defaults."""

    what: str
    slots: Mapping[str, Slot]
    run: Callable[[Given], Result]
    options: Mapping[str, Option] = field(default_factory=dict)


def _ocv(given: Given) -> Result:
    return cell.open_circuit(given.tables["data"][0], given.vehicle.parameters["cell_cutoff_voltage"])


def _motor(given: Given) -> Result:
    (dyno,), ramp = given.tables["data"], given.tables.get("emf")
    result = motor.voltage_constant(ramp[0]) if ramp else Result("motor")
    result.add(motor.torque_constant(dyno, given.number("largest_current")))
    return result


def _losses(given: Given) -> Result:
    (dyno,) = given.tables["data"]
    result = motor.motor_losses(dyno, given.number("largest_current"))
    result.add(motor.inverter_losses(dyno, given.number("largest_current")))
    return result


def _pulse(given: Given) -> Result:
    loads = [_load(ride) for ride in _true(given, "load")]
    tables, held_out = given.tables["data"], given.tables.get("held_out", [])
    return pulse.calibrate_cell(tables, *_open_circuit(given), loads=loads or None, held_out=held_out)


def _open_circuit(given: Given) -> tuple[Curve, Found]:
    """The open-circuit voltage and capacity: as just calibrated, else the vehicle file's."""
    for result in reversed(given.earlier):
        if "battery.ocv" in result.curves and "cell_capacity" in result.parameters:
            return result.curves["battery.ocv"], result.parameters["cell_capacity"]
    battery, known = given.vehicle.pack, given.vehicle.parameters.known["cell_capacity"]
    value = np.array(battery.ocv_curve.y)
    curve = Curve(
        {"soc": np.array(battery.ocv_curve.x)}, value, np.full(len(value), battery.ocv_sd), "V", given.vehicle.file.name
    )
    return curve, Found(known.value, known.sd, known.unit, known.source)


def _true(given: Given, data: str) -> list[Recording]:
    """The rides, corrected for known errors of the vehicle's sensors."""
    parameters = given.vehicle.parameters
    return [replace(ride, columns=true_columns(ride.columns, parameters)) for ride in given.rides.get(data, [])]


def _load(ride: Recording) -> Array:
    """The pack current of a ride [A], once a second."""
    if "pack_current" not in ride.columns:
        raise InputError(f"{ride.name}: has no pack_current, so it is no load for the cell")
    at, current = ride.columns["pack_current"]
    seconds = np.arange(np.floor(at[0]), np.floor(at[-1]))
    return np.asarray(np.interp(seconds + 0.5, at, current))


def _cooling(given: Given) -> Result:
    return cooling.calibrate_cooling(_cooling_runs(given, "data"), given.vehicle, _cooling_runs(given, "held_out"))


def _cooling_runs(given: Given, slot: str) -> list[cooling.CoolingRun]:
    """Those with no airflow stated: tables from a closed room, rides and rollers with air as fast as the wheel."""
    airflow, runs = given.options.get("airflow", {}), []
    by_file = airflow if isinstance(airflow, Mapping) else {}
    by_ride = {ride_name(Path(name)): value for name, value in by_file.items()}
    every = None if isinstance(airflow, Mapping) else airflow
    for table in given.tables.get(slot, []):
        air = by_file.get(table.file.name, "none") if every is None else every
        runs.append(cooling.bench_run(table, given.vehicle, air))
    for ride in given.rides.get(slot, []):
        air = by_ride.get(ride.name, "wheel") if every is None else every
        runs.append(cooling.ride_run(ride, given.vehicle, air))
    return runs


def _coastdown(given: Given) -> Result:
    wind_sd, slope_sd = given.number("wind_sd"), given.number("slope_sd")
    return coastdown.coast_downs(given.rides["data"], given.vehicle, wind_sd=wind_sd, slope_sd=slope_sd)


_LARGEST: dict[str, Option] = {"largest_current": motor.RIDING_CURRENT}

# In the order of `calibrate all`: a procedure may use what those above it have found.
PROCEDURES: dict[str, Procedure] = {
    "wheel": Procedure(
        "rolling radius of the driven wheel from GPS speed over motor speed",
        {"data": Slot("ride", "rides with GPS", 1)},
        lambda given: sensors.wheel_radius(given.rides["data"], given.vehicle),
    ),
    "motor": Procedure(
        "constants of the motor from a dynamometer: back-EMF over speed, torque over current",
        {
            "data": Slot("table", "steady points of a motor dynamometer", 1, 1),
            "emf": Slot("table", "back-EMF over speed at no torque", 0, 1),
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
    ),
    "auxiliary": Procedure(
        "power of lamps, dashboard and control",
        {"data": Slot("ride", "rides with auxiliary current, or standing still with pack current", 1)},
        lambda given: sensors.auxiliary_power(_true(given, "data"), given.vehicle),
    ),
    "offsets": Procedure(
        "offset, gain and noise of the pack's sensors",
        {"data": Slot("ride", "rides that begin or end at rest", 1)},
        lambda given: sensors.offsets(given.rides["data"], given.vehicle),
    ),
    "resistance": Procedure(
        "resistance of cable and of pack outside the cells",
        {
            "data": Slot("ride", "rides, above 20 degC for the pack", 1),
            "pulses": Slot("table", "pulse tests of a cell, at two temperatures or more", 0),
        },
        lambda given: sensors.resistances(given.rides["data"], given.vehicle, given.tables.get("pulses", [])),
    ),
    "cooling": Procedure(
        "the four cooling networks from warming up and cooling down, on a bench (tables) and on the vehicle (rides)",
        {"data": Slot("any", "runs of 5 min or longer", 1), "held_out": Slot("any", "further runs, to validate", 0)},
        _cooling,
        {"airflow": {}},
    ),
    "coastdown": Procedure(
        "rolling resistance and drag area from coast-downs in both directions",
        {"data": Slot("ride", "coast-downs in both directions", 2)},
        _coastdown,
        {"wind_sd": coastdown.COASTDOWN.wind_sd, "slope_sd": coastdown.COASTDOWN.slope_sd},
    ),
}
