"""The four cooling networks from warming up and cooling down (Lord 2016, eqs. 2.25-2.31, figs. 2.22-2.27).

The networks are those of the simulation, stepped at 1 s with the heat measured on a bench, or on rides with the heat
that the vehicle's own losses give. Nonlinear least squares fit all runs of a network together. Bench and rides differ
only in the air that moves past the vehicle, which each run states.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from gz_onboard.arrays import Array, held_integral
from gz_onboard.calibration.fit import Solution, nonlinear, score
from gz_onboard.calibration.result import Curve, Panel, PlotLine, Result
from gz_onboard.calibration.table import Measurements
from gz_onboard.constants import BENCH_TEMPERATURE
from gz_onboard.errors import InputError
from gz_onboard.model.battery import reversible_heat
from gz_onboard.model.cooling import PERIOD, InverterCooling, LumpedCooling, MotorCooling, temperatures
from gz_onboard.model.effect import Port
from gz_onboard.model.model import STOOD, stepping
from gz_onboard.model.parameters import declared_parameters
from gz_onboard.model.series import advanced, all_quantities, first_soc, idle_loss, total
from gz_onboard.recording.recording import Recording
from gz_onboard.recording.sensors import road_speed, true_columns
from gz_onboard.vehicle import Vehicle


@dataclass(frozen=True)
class CoolingConfig:
    """Which runs count, how the noise of temperatures is taken, and when a value is refused."""

    shortest: float = 300.0  # s: less says nothing of time constants of minutes
    first: float = 1.0  # s: mean voltage and current over it give the first SOC, before the load has grown
    rise: float = 3.0  # K that a sensor must change by
    cell_rise: float = 1.0  # K: the same for the cells, whose capacity is large
    fine_sd: float = 0.2  # K: of a sensor that resolves tenths of a kelvin
    coarse_sd: float = 0.5  # K: of a sensor in whole degrees
    start_sd: float = 0.15  # K: of the temperature at the start
    block: float = 300.0  # s: errors within it depend on each other
    many: int = 6  # runs, from which on whole runs are the independent pieces
    known_share: float = 0.5  # of its prior's sd: a value less sure than this leans on the prior
    entropy_sd: float = 5e-4  # V/K: lithium-ion cells are within ±0.5 mV/K unless empty (Viswanathan 2010)
    board_min_share: float = 0.25  # of the resistance of bars, fuse and BMS that is in the BMS: transistors and shunt


CONFIG = CoolingConfig()
AIRFLOWS = {"none": 0.0, "wheel": 1.0}  # air over the wheel's speed: a closed room; riding, or a fan that follows
SENSORS = tuple(f"{part}_temperature" for part in ("motor", "inverter", "inverter_box", "cell", "bms"))
ENTROPY_SOC = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 1.0)  # nodes as fine as rides of a tenth of the charge can tell
ENTROPY = tuple(f"entropy_{soc:g}" for soc in ENTROPY_SOC)  # change of a cell's voltage with temperature there
_UNITS = {"capacity": "J/K", "speed": "W·s/(K·m)", "share": "1", "resistance": "ohm"}  # others: W/K


# --- runs ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CoolingRun:
    """One run at `PERIOD` spacing, every array of shape (n,); powers in W, temperatures in degC.

    bench: a table with measured heat. iron: the part of the motor's heat that comes without current. pack_heat:
    without the reversible part, for which series_current is the pack's current times its cells in series. measured:
    the temperatures there are, by the names in `SENSORS`.
    """

    name: str
    bench: bool
    time: Array
    ambient: Array
    air: Array  # m/s past the vehicle
    motor_heat: Array
    iron: Array
    inverter_heat: Array
    pack_heat: Array
    pack_square: Array  # A²: mean square of the pack's current
    series_current: Array  # A
    soc: Array
    measured: dict[str, Array]


def bench_run(table: Measurements, vehicle: Vehicle, airflow: float | str = "none") -> CoolingRun:
    """Read a run of motor and inverter with measured losses, in a closed room unless `airflow` says otherwise.

    InputError naming a missing column.
    """
    time = table["time"]
    grid = _grid(time, table.file.name)
    ac, dc, speed = (_means(time, table[name], grid) for name in ("ac_power", "dc_power", "motor_speed"))
    motor_heat = ac - _means(time, table["shaft_torque"] * table["motor_speed"], grid)
    if motor_heat.sum() <= 0 or (dc - ac).sum() <= 0:
        raise table.error(
            "ac_power less shaft_torque times motor_speed, or dc_power less ac_power, is no heat but cold"
        )
    turning = speed * (np.abs(_means(time, table["motor_current"], grid)) > 1.0)  # the bench's drive stops with it
    nothing = np.zeros_like(grid)
    return CoolingRun(
        name=table.file.name,
        bench=True,
        time=grid,
        ambient=np.interp(grid, time, table["ambient_temperature"]),
        air=_air(airflow, turning, vehicle),
        motor_heat=motor_heat,
        iron=nothing + idle_loss(vehicle.model, {"motor_speed": turning, "motor_temperature": BENCH_TEMPERATURE}),
        inverter_heat=dc - ac,
        pack_heat=nothing,
        pack_square=nothing,
        series_current=nothing,
        soc=nothing,
        measured={name: np.interp(grid, time, table[name]) for name in SENSORS if name in table},
    )


def ride_run(ride: Recording, vehicle: Vehicle, airflow: float | str = "wheel") -> CoolingRun:
    """Take a ride or dynamometer run with the heat of the vehicle's own losses. InputError for missing signals."""
    for role in ("motor_speed", "motor_current", "motor_temperature", "ambient_temperature", "pack_current"):
        if role not in ride.columns:
            raise InputError(f"{ride.name}: no {role}, without which no heat is known")
    columns = true_columns(ride.columns, vehicle.parameters)
    span = np.array([max(t[0] for t, _ in columns.values()), min(t[-1] for t, _ in columns.values())])
    grid = _grid(span, ride.name)
    time, current = columns["motor_current"]
    quantities = {"motor_current": current}
    quantities |= {role: np.interp(time, *columns[role]) for role in ("motor_speed", "motor_temperature")}
    motor_heat, inverter_heat = (
        np.zeros_like(time) + total(vehicle.model.at(port), quantities)
        for port in (Port.MOTOR_LOSS, Port.INVERTER_LOSS)
    )
    measured = {name: np.interp(grid, *columns[name]) for name in SENSORS if name in columns}
    if inside := [np.interp(grid, *columns[role]) for role in columns if role.startswith("pack_temperature_")]:
        measured["cell_temperature"] = np.mean(inside, axis=0)  # thermocouples are finer than the BMS's whole degrees
    pack_time, amperes = columns["pack_current"]
    mean, square = _means(pack_time, amperes, grid), _means(pack_time, amperes**2, grid)
    pack_heat = soc = np.zeros_like(grid)
    if vehicle.battery and "cell_temperature" in measured and "pack_voltage" in columns:
        first = [
            float(v[t < t[0] + CONFIG.first].mean()) for t, v in (columns["pack_voltage"], columns["pack_current"])
        ]
        pack_heat, soc = _pack_heat(vehicle, mean, square, measured["cell_temperature"], (first[0], first[1]))
    return CoolingRun(
        name=ride.name,
        bench=False,
        time=grid,
        ambient=np.interp(grid, *columns["ambient_temperature"]),
        air=_air(airflow, _means(*columns["motor_speed"], grid), vehicle),
        motor_heat=_means(time, motor_heat, grid),
        iron=_means(time, np.zeros_like(time) + idle_loss(vehicle.model, quantities), grid),
        inverter_heat=_means(time, inverter_heat, grid),
        pack_heat=pack_heat,
        pack_square=square,
        series_current=(vehicle.battery.cells_series if vehicle.battery else 0) * mean,
        soc=soc,
        measured=measured,
    )


def _air(airflow: float | str, motor_speed: Array, vehicle: Vehicle) -> Array:
    """Speed of the air [m/s], (n,): `airflow` as a number [m/s], or as one of `AIRFLOWS`."""
    if isinstance(airflow, str):
        return np.asarray(AIRFLOWS[airflow] * road_speed(np.abs(motor_speed), vehicle.parameters))
    return np.full_like(motor_speed, airflow)


def _grid(time: Array, name: str) -> Array:
    if (seconds := time[-1] - time[0]) < CONFIG.shortest:
        raise InputError(
            f"{name}: {seconds:.0f} s are too short for a cooling network; {CONFIG.shortest:.0f} s are needed"
        )
    return np.arange(np.ceil(time[0]), np.floor(time[-1]), PERIOD)


def _means(time: Array, value: Array, grid: Array) -> Array:
    """The mean of `value`, held from each of its times to the next, over each period of `grid`."""
    edges = np.append(grid, grid[-1] + PERIOD)
    result: Array = np.diff(np.interp(edges, time, held_integral(time, value))) / PERIOD
    if edges[-1] > time[-1]:
        result[-1] = value[-1]
    return result


def dissipation(r0: Any, r1: Any, current_squared: Any, v1: Any) -> Any:
    """Heat [W] of a cell's resistors alone; current_squared: mean square of its current [A²].

    It is `battery.heat` without the energy that the RC pair's capacitor takes in and gives back; over a ride both have
    the same sum. The mean square includes bursts faster than the steps.
    """
    return r0 * current_squared + v1 * v1 / r1


def _pack_heat(
    vehicle: Vehicle, mean: Array, square: Array, temperature: Array, first: tuple[float, float]
) -> tuple[Array, Array]:
    """(heat of the pack [W], its SOC) from mean and mean square of its current, all (n,).

    first: mean voltage and current of the pack in its first moments. These runs begin under way, so the whole current
    is taken to have flowed for a while, not only that of lamps and control.
    """
    battery, cells = vehicle.pack, vehicle.model.at(Port.CELL_VOLTAGE)
    n, m = battery.cells_series, battery.cells_parallel
    volts, amperes, celsius = *first, float(temperature[0])
    soc = first_soc(cells, battery, (volts, amperes), celsius, amperes)
    states: dict[str, float] = {}
    q = all_quantities(cell_current=amperes / m, soc=soc, cell_temperature=celsius)
    q["cell_capacity"] = battery.cell_capacity(celsius)
    total(cells, q, stepping(states, STOOD))  # as the first state of charge has it
    heat, socs, v1 = battery.series_resistance * square, np.empty_like(mean), 0.0
    rows = zip((mean / m).tolist(), (square / m**2).tolist(), temperature.tolist(), strict=True)
    for k, (i, i2, t) in enumerate(rows):
        r0, r1, _ = battery.circuit(soc, t)
        soc, v1 = advanced(battery, PERIOD, soc, v1, i, t)
        socs[k] = soc
        q |= {"cell_current": i, "soc": soc, "cell_temperature": t, "cell_capacity": battery.cell_capacity(t)}
        heat[k] += n * m * dissipation(r0, r1, i2, v1)
        heat[k] += n * m * i * total(cells, q, stepping(states, PERIOD))
    return heat, socs


# --- temperatures of a network over a run -------------------------------------------------------------------------

Values = Mapping[str, float]  # parameters by their names in the vehicle file, and those of `ENTROPY`
Model = Callable[[Values, CoolingRun], dict[str, Array]]  # temperatures [degC] by sensor, each (n,)


def motor_temperatures(p: Values, run: CoolingRun) -> dict[str, Array]:
    """Temperature of the stator. The rotor has no sensor and starts as warm as the stator."""
    start = _first(p, run, "motor_temperature")
    columns = run.motor_heat, run.ambient, run.air, np.ones_like(run.air), run.iron
    return {"motor_temperature": np.array(temperatures(MotorCooling(p, start, start), PERIOD, *columns))}


def inverter_temperatures(p: Values, run: CoolingRun) -> dict[str, Array]:
    """Temperatures of board and box; without a sensor the box starts as warm as the board."""
    board, box = SENSORS[1:3]
    network = InverterCooling(p, _first(p, run, board), _first(p, run, box if box in run.measured else board))
    result = np.empty((2, len(run.time)))
    rows = zip(run.inverter_heat.tolist(), run.ambient.tolist(), run.air.tolist(), strict=True)
    for k, (heat, ambient, air) in enumerate(rows):
        result[:, k] = network.temperature, network.box
        network.step(PERIOD, heat, ambient, air)
    return {board: result[0], box: result[1]}


def pack_temperatures(p: Values, run: CoolingRun) -> dict[str, Array]:
    """Temperature of the cells."""
    entropy = np.interp(run.soc, ENTROPY_SOC, [p.get(name, 0.0) for name in ENTROPY])
    heat = run.pack_heat + reversible_heat(entropy, run.series_current, run.measured["cell_temperature"])
    network = LumpedCooling(p, "pack", _first(p, run, "cell_temperature"))
    return {"cell_temperature": np.array(temperatures(network, PERIOD, heat, run.ambient))}


def bms_temperatures(p: Values, run: CoolingRun) -> dict[str, Array]:
    """Temperature of the BMS, on cells of the measured temperature."""
    network = LumpedCooling(p, "bms", _first(p, run, "bms_temperature"))
    columns = p["bms_resistance"] * run.pack_square, run.measured["cell_temperature"]
    return {"bms_temperature": np.array(temperatures(network, PERIOD, *columns))}


def _first(p: Values, run: CoolingRun, sensor: str) -> float:
    """Temperature [degC] at which the node of `sensor` starts: by a line through the sensor's first ten seconds.

    A board warms fast. ``start:RUN:SENSOR`` in `p` is added to it.
    """
    first = run.measured[sensor][:10]
    line = np.polyfit(np.arange(len(first)) * PERIOD, first, 1)
    return float(line[1]) + p.get(f"start:{run.name}:{sensor}", 0.0)


# --- the fit ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CoolingNetwork:
    """A network to fit: its model, free parameters with their start, held ones, and priors as (value, sd).

    per_speed: parameter of moving air, held where no air moves in any run. further_sd: sd that no sample shows.
    """

    model: Model
    start: Values
    prior: Mapping[str, tuple[float, float]]
    held: Values = field(default_factory=dict)
    per_speed: str = ""
    further_sd: Values = field(default_factory=dict)

    def error(self, values: Values, run: CoolingRun) -> Array:
        """Model less measured [K], all sensors of the run after one another."""
        modelled = self.model(values, run)
        return np.concatenate([modelled[name] - run.measured[name] for name in modelled if name in run.measured])

    def fit(self, runs: Sequence[CoolingRun]) -> tuple[Solution, dict[str, float]]:
        """(the solution, all values including those held)."""
        start, held = dict(self.start), dict(self.held)
        if self.per_speed and not any(run.air.any() for run in runs):
            held[self.per_speed] = start.pop(self.per_speed)
        prior = {name: known for name, known in self.prior.items() if name in start}
        bounds = {name: _bounds(name, value) for name, value in start.items()}
        sensors = self.model({**held, **start}, runs[0])
        columns = [(k, run, name) for k, run in enumerate(runs) for name in sensors if name in run.measured]
        if len(runs) < CONFIG.many:  # the error of where a run starts lasts; of many runs the pieces are whole runs
            nodes = [f"start:{run.name}:{name}" for _, run, name in columns]
            start |= dict.fromkeys(nodes, 0.0)
            prior |= dict.fromkeys(nodes, (0.0, CONFIG.start_sd))
        names = tuple(start)
        sd = np.concatenate([_sensor_sd(run.measured[name]) for _, run, name in columns])
        length = np.inf if len(runs) >= CONFIG.many else CONFIG.block
        pieces = [1e6 * k + np.floor((run.time - run.time[0]) / length) for k, run, _ in columns]

        def residual(x: Array) -> Array:
            values = {**held, **dict(zip(names, x.tolist(), strict=True))}
            return np.asarray(np.concatenate([self.error(values, run) for run in runs]) / sd)

        groups = np.concatenate(pieces)
        found = nonlinear(residual, start, bounds=bounds, prior=prior, known_sd=True, groups=groups)
        return found, {**held, **dict(zip(names, found.value.tolist(), strict=True))}


def _sensor_sd(measured: Array) -> Array:
    """Standard deviation [K] of each sample; whole degrees come with others only between two messages."""
    whole = np.mean(np.abs(measured - np.round(measured)) < 1e-3) > 0.5
    return np.full(len(measured), CONFIG.coarse_sd if whole else CONFIG.fine_sd)


def _bounds(name: str, value: float) -> tuple[float, float]:
    if name in ENTROPY:
        return -np.inf, np.inf
    declared = declared_parameters()[name]
    return max(1e-4 * value, declared.low), min(1e3 * value, declared.high)


def _usable(runs: Sequence[CoolingRun], sensor: str, result: Result) -> list[CoolingRun]:
    """The runs with that sensor in which it changes enough; the others are noted. InputError for none."""
    good, min_change = [], CONFIG.cell_rise if sensor == "cell_temperature" else CONFIG.rise
    for run in runs:
        if sensor not in run.measured:
            result.notes.append(f"{run.name}: no {sensor}, left out")
        elif (rise := float(np.ptp(run.measured[sensor]))) < min_change:
            result.notes.append(f"{run.name}: {sensor} changes by {rise:.1f} K only, left out")
        else:
            good.append(run)
    if not good:
        raise InputError(
            f"no run tells anything of {sensor}: it is not measured, or changes by less than {min_change:g} K"
        )
    return good


def _solve(
    result: Result, network: CoolingNetwork, runs: Sequence[CoolingRun], validation: Sequence[CoolingRun], halves: bool
) -> Solution:
    """Fit all `runs` into `result`, with scores in sample and on `validation`.

    halves: also on every second ride, by a fit without these.
    """
    found, values = network.fit(runs)
    _score(network, values, runs, False, result)
    held = [run for run in runs if not run.bench][1::2]
    part = [run for run in runs if run.name not in {run.name for run in held}]
    if halves and held and part:
        _score(network, network.fit(part)[1], held, True, result)
    _score(network, values, validation, True, result)
    for k, run in enumerate([*runs, *validation]):
        lines, modelled = [], network.model(values, run)
        for sensor in (sensor for sensor in modelled if sensor in run.measured):
            label = sensor.removesuffix("_temperature").replace("_", " ")
            pair = ("measured", run.measured[sensor], "."), ("model", modelled[sensor], "-")
            lines += [PlotLine(f"{label}, {of}", run.time - run.time[0], y, style) for of, y, style in pair]
        title = f"{run.name}{' (held out)' if k >= len(runs) else ''}"
        result.panels.append(Panel(title, "time [s]", "temperature [degC]", tuple(lines)))
    rms = float(np.sqrt(np.mean(np.concatenate([network.error(values, run) for run in runs]) ** 2)))
    tied = tuple(name for name in network.start if name in found.names and name not in ENTROPY)
    more = [network.further_sd.get(name, 0.0) for name in tied]
    for name, further in zip(tied, more, strict=True):
        unit = _UNITS.get(name.rpartition("_")[2], "W/K")
        result.parameters[name] = found.found(name, unit, f"{_source(runs)}; rms {rms:.2g} K", further)
    result.covariance.append((tied, found.part(tied) + np.diag(more) ** 2))
    if (name := network.per_speed) and name not in found.names:
        result.refusals.append(f"{name}: no air moved in any of the runs: {values[name]:g} W·s/(K·m) of the file stays")
    return found


def _score(network: CoolingNetwork, values: Values, runs: Sequence[CoolingRun], held_out: bool, result: Result) -> None:
    """Add a fit for each sensor over the runs on a bench, and one over the rides."""
    for kind in ("bench", "riding"):
        some = [run for run in runs if run.bench == (kind == "bench")]
        modelled = [network.model(values, run) for run in some]
        for sensor in modelled[0] if some else ():
            pairs = [
                (r.measured[sensor], m[sensor]) for r, m in zip(some, modelled, strict=True) if sensor in r.measured
            ]
            if pairs:
                data, model = (np.concatenate(column) for column in zip(*pairs, strict=True))
                what, names = f"{sensor.replace('_', ' ')}, {kind}", ", ".join(run.name for run in some)
                result.fits.append(score(what, "degC", data, model, held_out=held_out, source=names))


def _source(runs: Sequence[CoolingRun]) -> str:
    names = [run.name for run in runs]
    listed = ", ".join(names if len(names) < 4 else [names[0], "...", names[-1]])
    return f"{listed}: {sum(len(run.time) for run in runs)} s"


def _with_source(result: Result, names: Sequence[str], more: str) -> None:
    for name in names:
        found = result.parameters[name]
        result.parameters[name] = replace(found, source=f"{found.source}; {more}")


def _starts(vehicle: Vehicle, names: Sequence[str]) -> dict[str, float]:
    """The values of the file; for zero its standard deviation, as a search needs a size."""
    return {name: vehicle.parameters[name] or vehicle.parameters.sd(name) for name in names}


def _priors(vehicle: Vehicle, names: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Wide priors, three standard deviations: they only bound values that the data leave free."""
    known = vehicle.parameters.known
    return {name: (known[name].value, 3 * max(known[name].sd, 0.3 * known[name].value)) for name in names}


# --- the four networks --------------------------------------------------------------------------------------------


def motor_cooling(
    runs: Sequence[CoolingRun], vehicle: Vehicle, validation: Sequence[CoolingRun] = (), halves: bool = True
) -> Result:
    """Find capacities, conductances over the speed of the air, and the stator's share of the heat without current.

    `validation` is never fitted; halves: see `_solve`. InputError if no run changes the motor's temperature.
    """
    share, speed = "motor_iron_share", "motor_rotor_per_speed"
    names = ("motor_stator_capacity", "motor_rotor_capacity", "motor_gap_conductance", "motor_rotor_to_ambient", speed)
    result, known = Result("motor_cooling"), declared_parameters()[share]
    runs = _usable(runs, "motor_temperature", result)
    prior = _priors(vehicle, names) | {share: (known.prior, known.prior_sd)}
    network = CoolingNetwork(motor_temperatures, _starts(vehicle, (*names, share)), prior, per_speed=speed)
    found = _solve(result, network, runs, validation, halves)
    if found.sd(share) > CONFIG.known_share * known.prior_sd:
        result.refusals.append(
            f"{share}: {found[share]:.2f} ± {found.sd(share):.2f}: the data cannot separate it from the capacities and "
            f"the rotor's cooling; it leans on its prior, {known.prior:g} ± {known.prior_sd:g}"
        )
    return result


def inverter_cooling(
    runs: Sequence[CoolingRun], vehicle: Vehicle, validation: Sequence[CoolingRun] = (), halves: bool = True
) -> Result:
    """Find capacities of board and box, the conductance between them, and the box's over the speed of the air.

    Between board and box act board_to_box and, in parallel, the two to the air in series: the air has neither sensor
    nor capacity, so only the sum is determined, and the two to the air stay as they are.
    """
    p, speed, air = vehicle.parameters, "inverter_box_per_speed", ("inverter_board_to_air", "inverter_box_to_air")
    names = ("inverter_board_capacity", "inverter_box_capacity", "inverter_board_to_box", "inverter_box_to_ambient")
    result = Result("inverter_cooling")
    runs = _usable(runs, "inverter_temperature", result)
    b, c = (p[name] for name in air)
    series, sds = b * c / (b + c), [p.known[name].sd for name in air]
    series_sd = float(np.hypot(sds[0] * (c / (b + c)) ** 2, sds[1] * (b / (b + c)) ** 2))
    free, held = (*names, speed), dict(zip(air, (b, c), strict=True))
    start, prior, further = _starts(vehicle, free), _priors(vehicle, free), {names[2]: series_sd}
    network = CoolingNetwork(inverter_temperatures, start, prior, held, speed, further)
    found = _solve(result, network, runs, validation, halves)
    acts = f"only board_to_box + b·c/(b + c) = {found[names[2]] + series:.2f} ± {found.sd(names[2]):.2f} W/K acts"
    _with_source(result, names[2:3], f"{acts}, of which the air's part is held")
    result.refusals.append(f"{', '.join(air)}: {acts} between board and box; the two are held at {b:g} and {c:g} W/K")
    if not any("inverter_box_temperature" in run.measured for run in runs):
        result.refusals.append(f"{names[1]}, {names[2]}: no sensor on the box, so that both lean on their priors")
    return result


def pack_cooling(
    runs: Sequence[CoolingRun], vehicle: Vehicle, validation: Sequence[CoolingRun] = (), halves: bool = True
) -> Result:
    """Find pack_heat_capacity, pack_conductance and the cells' entropy over SOC from rides and dynamometer runs.

    The heat of a cell's reaction turns its sign with SOC and is as large as its losses, so that the three can only be
    found together. InputError without pack heat.
    """
    names, result = ("pack_heat_capacity", "pack_conductance"), Result("pack_cooling")
    runs = _usable([run for run in runs if run.pack_heat.any()], "cell_temperature", result)
    start = {name: vehicle.parameters[name] for name in names} | dict.fromkeys(ENTROPY, -CONFIG.entropy_sd)
    prior = _priors(vehicle, names[1:]) | dict.fromkeys(ENTROPY, (0.0, CONFIG.entropy_sd))
    found = _solve(result, CoolingNetwork(pack_temperatures, start, prior), runs, validation, halves)
    value, sd = (np.array([of(name) for name in ENTROPY]) for of in (found.__getitem__, found.sd))
    covered = sd < CONFIG.known_share * CONFIG.entropy_sd
    if covered.any():
        axis = np.array(ENTROPY_SOC)
        value = np.interp(axis, axis[covered], value[covered])
        curve = Curve({"soc": axis}, value, np.where(covered, sd, np.nan), "V/K", f"{_source(runs)}: heat of the cells")
        result.curves["battery.entropy"] = curve
    else:
        result.refusals.append("battery.entropy: these runs do not tell it from heat capacity and conductance")
    if found.sd(names[1]) > 0.3 * found[names[1]]:
        result.refusals.append(
            f"pack_conductance: {found[names[1]]:.2f} ± {found.sd(names[1]):.2f} W/K: these runs hardly cool the pack"
        )
    return result


def bms_cooling(
    runs: Sequence[CoolingRun], vehicle: Vehicle, validation: Sequence[CoolingRun] = (), halves: bool = True
) -> Result:
    """Find bms_resistance, bms_heat_capacity and bms_conductance: the board over the cells it sits on.

    Temperatures determine their ratios only: heat scales with all three. The scale is that of the priors, for the
    resistance `board_resistance`.
    """
    p, names = vehicle.parameters, ("bms_resistance", "bms_heat_capacity", "bms_conductance")
    result = Result("bms_cooling")
    runs = _usable([run for run in runs if "cell_temperature" in run.measured], "bms_temperature", result)
    prior = {name: (p.known[name].value, p.known[name].sd) for name in names} | {names[0]: board_resistance(vehicle)}
    network = CoolingNetwork(bms_temperatures, {name: p[name] for name in names}, prior)
    found = _solve(result, network, runs, validation, halves)
    r, c, g = (found[name] for name in names)
    known = f"resistance/conductance = {1e3 * r / g:.2f} mohm·K/W and capacity/conductance = {c / g:.0f} s only"
    value, sd = (1e3 * x for x in prior[names[0]])
    scale = f"the scale is that of the priors, {value:.1f} ± {sd:.1f} mohm for the resistance"
    _with_source(result, names, f"tells {known}; {scale}")
    result.refusals.append(f"{', '.join(names)}: the data tell {known}; {scale}")
    return result


def board_resistance(vehicle: Vehicle) -> tuple[float, float]:
    """(value, sd) of bms_resistance [ohm]: `board_min_share` to all of the measured pack_series_resistance.

    Where that is not measured, the value of the file.
    """
    known = vehicle.parameters.known
    series = known["pack_series_resistance"]
    if series.status != "measured":
        return known["bms_resistance"].value, known["bms_resistance"].sd
    share, share_sd = (1 + CONFIG.board_min_share) / 2, (1 - CONFIG.board_min_share) / 12**0.5
    return share * series.value, float(np.hypot(share_sd * series.value, share * series.sd))


def calibrate_cooling(runs: Sequence[CoolingRun], vehicle: Vehicle, validation: Sequence[CoolingRun]) -> Result:
    """Fit all four networks, as far as there are sensors. InputError if no run has any of these."""
    result = Result("cooling")
    networks = {
        "motor_temperature": motor_cooling,
        "inverter_temperature": inverter_cooling,
        "cell_temperature": pack_cooling,
        "bms_temperature": bms_cooling,
    }
    for sensor, network in networks.items():
        if any(sensor in run.measured for run in runs):
            result.add(network(runs, vehicle, [run for run in validation if sensor in run.measured]))
        else:
            result.refusals.append(f"{network.__name__}: no run has {sensor}")
    if not result.parameters:
        raise InputError(f"none of the runs has {', '.join(networks)}")
    return result
