"""State of charge of a real cell: the on-board filter on a Panasonic NCR18650PF, -20 to 25 degC.

    OMP_NUM_THREADS=1 python benchmarks/real_cell.py DATA_FOLDER [--only Cycle_1] [--board]
        [--write docs/results/real-cell.md]

Data: Kollmeyer, "Panasonic 18650PF Li-ion Battery Data", Mendeley Data 2018, doi:10.17632/wykht8y7tg.1, as Parquet and
1 Hz CSV. The tables come from the pulse (HPPC) tests and the C/20 discharge alone, by `gz_onboard.calibration`; the
filter is that of the on-board estimator, fed with events once a second; the drive cycles are used for nothing else.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from math import nan
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.calibration import pulse
from gz_onboard.calibration.cell import open_circuit
from gz_onboard.calibration.circuit import Circuit, voltage
from gz_onboard.calibration.result import Found, Result
from gz_onboard.calibration.table import Measurements, Named, read_table
from gz_onboard.estimator.battery_filter import with_soc
from gz_onboard.estimator.battery_priors import PRIOR
from gz_onboard.events import Group
from gz_onboard.model.battery import Battery
from gz_onboard.model.effects import charge_transfer, slow_relaxation
from gz_onboard.model.functions import Mesh, PiecewiseLinear
from gz_onboard.model.model import Model
from gz_onboard.model.parameters import Parameters
from gz_onboard.vehicle import read_vehicle
from tests.events import EventEstimator

TEMPERATURES = (25, 10, 0, -10, -20)
OFFSET = 0.05  # A of the cell: error of the current sensor
TESTER_OFFSET = 0.005  # A: sd of the tester's own current, of which the reference is made
WRONG = -0.2  # of SOC
AS_NEW = 0.99  # the cell is the one that the tables were measured on
RIGHT_SD = 0.01  # of SOC: how far the right one is believed
CONVERGED = 0.025  # of SOC: from here on the error counts
NEAR = 0.03  # of SOC: a wrong start is left when it is first as near as this
INTERVAL = 1.96  # sd: of 95 %
NOMINAL = 2.9  # A·h, for C-rates
SEED = 1  # of the drawn cases
SENSOR = {"pack_current_gain": (1.0, 0.005), "pack_voltage_offset": (0.0, 0.002)}
COLUMNS = {
    "time": Named("t_s", "s"),
    "current": Named("i_A", "A", -1),
    "voltage": Named("v_V", "V"),
    "cell_temperature": Named("t_cell_C", "degC"),
    "charge": Named("q_Ah", "Ah", -1),
}


class Case(NamedTuple):
    """Errors given to the filter: SOC, offset [A] and relative error of the current; and the declared sd."""

    wrong: float = 0.0
    offset: float = 0.0
    gain: float = 0.0
    sd: float = RIGHT_SD
    declared: float = TESTER_OFFSET  # A: sd of the offset


OFF = {"offset": OFFSET, "declared": OFFSET}
RIGHT, WORST = Case(), Case(WRONG, sd=-WRONG, **OFF)
CASES = {RIGHT: "right", Case(**OFF): "right, offset", Case(WRONG, sd=-WRONG): "wrong", WORST: "wrong, offset"}
DRAWN = {"right": RIGHT_SD, "wrong": -WRONG}


def drawn(work: Sequence[Cycle], capacity: Found) -> dict[tuple[str, Cycle], Case]:
    """Cases with errors drawn from the declared uncertainty; a full cell never starts fuller.

    In the others the start, the count and the capacity are right, which no interval can know.
    """
    rng = np.random.default_rng(SEED)
    unchecked = PRIOR.unchecked_rate_sd * capacity.value
    share = float(np.hypot(capacity.sd / capacity.value, SENSOR["pack_current_gain"][1]))
    found = {}
    for name, sd in DRAWN.items():
        for c in work:
            start, offset, gain = rng.standard_normal(3)
            error = (-abs(start) * sd, offset * float(np.hypot(TESTER_OFFSET, unchecked)), gain * share)
            found[name, c] = Case(*error, sd=sd)
    return found


def pulse_test(folder: Path, temperature: int) -> Measurements:
    """Return the pulses with the discharge and rest between them, which are in a separate file.

    That file has a separate clock: its first rest ends where the pulses continue.
    """
    main = read_table(folder / f"{temperature}C_hppc.parquet", COLUMNS)
    between = read_table(folder / f"{temperature}C_hppc_between_pulses.parquet", COLUMNS)
    time = main["time"]
    gaps = np.flatnonzero(np.diff(time) > 1000)
    flows = np.abs(between["current"]) > 0.1
    start = int(np.argmin(flows))  # the first rest
    end = start + int(np.argmax(flows[start:])) - 1
    shift = time[gaps[0] + 1] - between["time"][end]
    inside = np.zeros(len(between["time"]), dtype=bool)
    for g in gaps:
        inside |= (between["time"] + shift > time[g] + 1) & (between["time"] + shift < time[g + 1] - 1)
    inside &= between["voltage"] > 1.0  # a glitch
    order = np.argsort(np.concatenate([time, between["time"][inside] + shift]), kind="stable")
    columns = {}
    for name in COLUMNS:
        extra = between[name][inside] + (shift if name == "time" else 0.0)
        columns[name] = np.concatenate([main[name], extra])[order]
    # The counter of one file never leads that of the other by more than its resolution.
    columns["charge"] = np.maximum.accumulate(columns["charge"])
    return Measurements(main.file, columns)


@dataclass(frozen=True, eq=False)
class Cycle:
    temperature: int
    name: str
    current: Array  # A, discharging positive, means of 1 s
    voltage: Array
    cell: Array  # degC
    drawn: Array  # A·h


def cycles(folder: Path) -> list[Cycle]:
    """Return the drive cycles, cut where the cell is emptiest: some continue with a charge."""
    found = []
    for temperature in TEMPERATURES:
        for file in sorted(folder.glob(f"drive1hz_{temperature}C_*.csv.gz")):
            rows = np.genfromtxt(file, delimiter=",", skip_header=1)
            rows = rows[np.all(np.isfinite(rows), axis=1)]
            rows = rows[: int(np.argmin(rows[:, 4])) + 1]
            name = file.name.removeprefix(f"drive1hz_{temperature}C_").removesuffix(".csv.gz")
            found.append(Cycle(temperature, name, -rows[:, 2], rows[:, 1], rows[:, 3], -rows[:, 4] + rows[0, 4]))
    return found


def battery_of(cell: Circuit, result: Result, capacity_25: float) -> Battery:
    """The cell as the on-board battery, 1s1p."""
    rows = [tuple(map(float, x)) for x in (cell.soc, cell.temperature, cell.capacity / capacity_25)]
    soc, temperature, share = rows

    def mesh(table: Array) -> Mesh:
        return Mesh(soc, temperature, tuple(tuple(map(float, row)) for row in table), geometric=True)

    sd = result.curves["battery.ocv"].sd[(cell.ocv_soc > 0.1) & (cell.ocv_soc < 0.95)]
    ocv = PiecewiseLinear(tuple(map(float, cell.ocv_soc)), tuple(map(float, cell.ocv)))
    ocv_table = ocv, float(np.median(sd))
    circuit = mesh(cell.r0), mesh(cell.r1), mesh(cell.c1)
    battery = Battery(1, 1, capacity_25, PiecewiseLinear(temperature, share), 2.5, 0.0, *ocv_table, *circuit)
    error, time = (
        PiecewiseLinear(tuple(map(float, found.axes["temperature"])), tuple(map(float, found.value)))
        for found in (result.curves["battery.voltage_error"], result.curves["voltage_error_time"])
    )
    battery = replace(
        battery,
        voltage_error_curve=error,
        voltage_error_time_curve=time,
        as_new=AS_NEW,
        capacity_sd=result.parameters["cell_capacity"].sd / capacity_25,
    )
    if (shift := result.curves.get("battery.rest_shift")) is None:
        return battery
    return replace(
        battery,
        rest_shift_curve=PiecewiseLinear(temperature, tuple(map(float, shift.value))),
        rest_shift_sd=float(np.median(shift.sd)),
    )


@dataclass(frozen=True)
class Setting:
    """A filter with its numbers."""

    name: str
    battery: Battery
    result: Result


@dataclass(frozen=True)
class Score:
    """Errors of SOC, once converged, and of all samples how well the filter's own sd tells them."""

    rms: float
    largest: float
    start: float  # s until converged, nan if never
    near: float  # s until within `NEAR`, nan if never
    inside: float  # share of all samples within the interval of 95 %
    nees: float  # mean of the squared error over its variance
    sd: float  # mean


def estimator_of(setting: Setting, offset: float) -> EventEstimator:
    """The estimator on board of the cell, with a current sensor whose offset has the sd `offset` [A]."""
    battery, result = setting.battery, setting.result
    vehicle = read_vehicle("reference")
    known = dict(vehicle.parameters.known)
    rests = [f.rms for f in result.fits if f.what.startswith("rest voltage")]
    values = {
        **SENSOR,
        "pack_current_offset": (0.0, offset),
        "cell_capacity": (battery.capacity, result.parameters["cell_capacity"].sd),
        "cell_voltage_error": (0.0, result.parameters["cell_voltage_error"].sd),
        "cell_voltage_error_empty": (0.0, result.parameters["cell_voltage_error_empty"].sd),
        "cell_voltage_error_time": (result.parameters["cell_voltage_error_time"].value, 0.0),
        "rest_voltage_error": (0.0, float(np.mean(rests))),
    }
    for parameter in (*charge_transfer.PARAMETERS, *slow_relaxation.PARAMETERS):
        if found := result.parameters.get(parameter.name):
            values[parameter.name] = found.value, found.sd
    for name, (value, sd) in values.items():
        known[name] = replace(known[name], value=value, sd=sd)
    effects = tuple(e for e in vehicle.model.effects if result.effects.get(e.name, True))
    model = Model(effects, Parameters(known))
    groups = [Group("Cells", ("cell_temperature",), 1.0), Group("Pack", ("pack_voltage", "pack_current"), 1.0)]
    estimator = EventEstimator(groups, battery, model, vehicle.riding)
    estimator.forecaster._time = float("inf")  # no range is asked for
    # A scooter's riding, of which the first state of charge expects a polarisation, is one cell's share of it here.
    cells, load = vehicle.pack.cells_series * vehicle.pack.cells_parallel, estimator.load
    power_of_prior = load.power_of_prior
    load.power_of_prior = lambda now: power_of_prior(now) / cells  # type: ignore[method-assign]
    return estimator


def run(setting: Setting, cycle: Cycle, case: Case) -> Score:
    """Run one cycle through the on-board estimator, whose SOC is set by `case` after its first step."""
    estimator = estimator_of(setting, case.declared)
    current = (1 + case.gain) * cycle.current + case.offset
    truth = 1 - cycle.drawn / setting.battery.cell_capacity(cycle.temperature)
    soc, sd = np.full(len(truth), np.nan), np.full(len(truth), np.nan)
    told = False
    for k, (v, i, t) in enumerate(zip(cycle.voltage, current, cycle.cell, strict=True)):
        estimator.handle((1.0 + k, 0, (t,)))
        estimator.handle((1.0 + k, 1, (v, i)))
        f = estimator.pack.state
        if not estimator.pack.is_started:
            continue
        if not told:
            told = True
            f = with_soc(f, float(truth[k]) + case.wrong, case.sd**2)._replace(v1=0.0, error=0.0)
            f = f._replace(covariance=(f.covariance[0], 0.0, *f.covariance[2:]))
            estimator.pack.state = f
            estimator.pack.age.apply(f)
        soc[k], sd[k] = estimator.pack.soc
    known = np.isfinite(soc)
    error, sd = (soc - truth)[known], sd[known]
    first = [np.flatnonzero(np.abs(error) < limit) for limit in (CONVERGED, NEAR)]
    start, near = (float(x[0]) if len(x) else nan for x in first)
    e = error[int(start) :] if np.isfinite(start) else np.array([nan])
    own = np.abs(error) / sd
    return Score(
        float(np.sqrt(np.mean(e**2))),
        float(np.abs(e).max()),
        start,
        near,
        float(np.mean(own < INTERVAL)),
        float(np.mean(own**2)),
        float(np.mean(sd)),
    )


def open_loop(cell: Circuit, cycle: Cycle, capacity: float) -> Array:
    """Voltage of the tables less measured (m,) [V], at the true state of charge."""
    dt = np.ones(len(cycle.current))
    level = 1 - cycle.drawn / capacity
    return voltage(cell, cycle.current, cycle.current, dt, level, cycle.cell) - cycle.voltage


def pulse_resistance(table: Measurements, capacity: float) -> dict[float, float]:
    """By C-rate the voltage drop of the 10 s pulses nearest to half full over their current [ohm]."""
    time, current, volts = table["time"], table["current"], table["voltage"]
    on = current > 0.1 * NOMINAL
    found: dict[float, tuple[float, float]] = {}
    for k in np.flatnonzero(on[1:] & ~on[:-1]) + 1:
        end = k + int(np.argmin(on[k:])) - 1
        rate = min((0.5, 1.0, 2.0, 4.0, 6.0), key=lambda r: abs(r - np.median(current[k : end + 1]) / NOMINAL))
        away = abs(float(table["charge"][k]) / capacity - 0.5)
        if 9 < time[end] - time[k] < 11 and away < found.get(rate, (0.1, 0.0))[0]:
            found[rate] = away, float((volts[k - 1] - volts[end]) / np.mean(current[k + 3 : end + 1]))
    return {rate: r for rate, (_, r) in sorted(found.items())}


def settings(rest: Result, result: Result) -> list[Setting]:
    """The filter on board, and the same without its rest voltage over temperature."""
    result.parameters["cell_capacity"] = rest.parameters["cell_capacity"]
    capacity = result.curves["battery.capacity"]
    at_25 = float(np.interp(25, capacity.axes["temperature"], capacity.value))
    battery = battery_of(pulse.circuit(result), result, at_25)
    return [
        Setting("on board: one RC pair and slow relaxation", battery, result),
        Setting(
            "rest voltage one for all temperatures", replace(battery, rest_shift_curve=None, rest_shift_sd=0.0), result
        ),
    ]


def jobs(work: tuple[Setting, Cycle, Case]) -> Score:
    return run(*work)


def percent(value: float | np.floating[Any], digits: int = 2) -> str:
    return "never" if np.isnan(value) else f"{100 * value:.{digits}f}"


def report(folder: Path, only: str = "", board: bool = False) -> list[str]:
    """The tables of docs/results/real-cell.md, as lines of Markdown.

    only: of cycles whose name holds this; board: of the filter on board alone.
    """
    rest = open_circuit(read_table(folder / "25C_c20_ocv.parquet", COLUMNS))
    tables = {t: pulse_test(folder, t) for t in TEMPERATURES}
    result = pulse.calibrate_cell(list(tables.values()), rest.curves["battery.ocv"], rest.parameters["cell_capacity"])
    every = settings(rest, result)[: 1 if board else None]
    work = [c for c in cycles(folder) if only in c.name]
    plain = [c for c in work if "trise" not in c.name]
    random = drawn(work, result.parameters["cell_capacity"])
    runs = [(every[0], c, case) for c in work for case in CASES]
    runs += [(every[0], c, case) for (_, c), case in random.items()]
    runs += [(s, c, case) for s in every[1:] for c in work for case in (RIGHT, WORST)]
    with ProcessPoolExecutor(2) as pool:
        keys = [(s.name, c, case) for s, c, case in runs]
        scores = dict(zip(keys, pool.map(jobs, runs, chunksize=4), strict=True))
    lines = ["## The cell", *_tables(result)]
    lines += ["", "## State of charge on the drive cycles, filter as on board", ""]
    lines += ["Means over the cycles of a temperature, without those of rising temperature:", ""]
    lines += _summary(every[:1], plain, scores, list(CASES))
    lines += ["", "The filter's 95 % interval, and the time to leave a wrong start:", ""]
    lines += _intervals(every[0], work, scores, random)
    if not board:
        lines += ["", "## What is missing", "", "### In the filter: the same with more in the model", ""]
        lines += _summary(every, plain, scores, [RIGHT, WORST])
        lines += ["", "The cycles of rising temperature, right start, no offset:", ""]
        lines += _summary(every, [c for c in work if "trise" in c.name], scores, [RIGHT])
        lines += ["", "### In the voltage", "", *_residuals(result, every[0], plain)]
        lines += ["", "### Over current: the pulses themselves", "", *_rates(tables, every[0])]
    return lines


def _tables(result: Result) -> list[str]:
    c = result.curves
    lines = [
        "",
        "| °C | capacity, A·h | rest voltage, mV | R0, R1 half full, mΩ | τ1, s | errs by, mV, for, s |",
        "|---" * 6 + "|",
    ]
    soc = c["battery.r0"].axes["soc"]
    k = int(np.argmin(np.abs(soc - 0.5)))
    written = c["battery.rest_shift"].value if "battery.rest_shift" in c else np.zeros(len(TEMPERATURES))
    for j, t in enumerate(c["battery.r0"].axes["temperature"]):
        r0, r1, c1 = (c[f"battery.{n}"].value[j, k] for n in ("r0", "r1", "c1"))
        shift = 1e3 * written[j]
        lines.append(
            f"| {t:.0f} | {c['battery.capacity'].value[j]:.3f} | {shift:+.0f} | "
            f"{1e3 * r0:.0f}, {1e3 * r1:.0f} | {r1 * c1:.0f} | {1e3 * c['battery.voltage_error'].value[j]:.0f}, "
            f"{c['voltage_error_time'].value[j]:.0f} |"
        )
    return lines


Scores = dict[tuple[str, Cycle, Case], Score]


def _intervals(setting: Setting, work: list[Cycle], scores: Scores, random: dict[tuple[str, Cycle], Case]) -> list[str]:
    lines = [
        "| °C | start | σ, % | samples within 95 %, least of a cycle | NEES | s to within 3 %, most of a cycle |",
        "|---" * 6 + "|",
    ]
    groups = {f"{t}": [c for c in work if c.temperature == t and "trise" not in c.name] for t in TEMPERATURES}
    groups["rising"] = [c for c in work if "trise" in c.name]
    for name, group in groups.items():
        found = {"wrong": [scores[setting.name, c, Case(WRONG, sd=-WRONG)] for c in group]}
        found |= {f"{text}, drawn": [scores[setting.name, c, random[text, c]] for c in group] for text in DRAWN}
        for text, mine in found.items() if group else ():
            near = np.array([s.near for s in mine])
            never = f", {np.count_nonzero(np.isnan(near))} never" if np.any(np.isnan(near)) else ""
            inside = [s.inside for s in mine]
            lines.append(
                f"| {name} | {text} | {percent(np.mean([s.sd for s in mine]))} | "
                f"{percent(np.mean(inside), 0)}, {percent(min(inside), 0)} | {np.mean([s.nees for s in mine]):.2f} | "
                f"{np.nanmean(near):.0f}, {np.nanmax(near):.0f}{never} |"
            )
    return lines


def _summary(every: list[Setting], work: list[Cycle], scores: Scores, cases: list[Case]) -> list[str]:
    lines = ["| model | start | " + " | ".join(f"{t} °C" for t in TEMPERATURES) + " |", "|---" * 7 + "|"]
    for setting in every:
        for case in cases:
            cells = []
            for t in TEMPERATURES:
                mine = [scores[setting.name, c, case] for c in work if c.temperature == t]
                if mine:
                    good = [s for s in mine if np.isfinite(s.rms)]
                    rms = np.mean([s.rms for s in good])
                    worst, most = (max((getattr(s, name) for s in good), default=nan) for name in ("rms", "largest"))
                    lost = f", {len(mine) - len(good)} never" if len(good) < len(mine) else ""
                    cells.append(f"{percent(rms)} ({percent(worst)}; {percent(most, 1)}){lost}")
                else:
                    cells.append("–")
            lines.append(f"| {setting.name} | {CASES[case]} | {' | '.join(cells)} |")
    return lines


def _residuals(result: Result, setting: Setting, work: list[Cycle]) -> list[str]:
    cell = pulse.circuit(result)
    bins = ((-99, -1), (-1, 0.3), (0.3, 1.5), (1.5, 4), (4, 8), (8, 99))
    heads = ["below -1 A", "-1 to 0.3 A", "0.3 to 1.5 A", "1.5 to 4 A", "4 to 8 A", "above 8 A"]
    lines = ["| °C | RMS (mean) | " + " | ".join(heads) + " |", "|---" * (2 + len(bins)) + "|"]
    for t in TEMPERATURES:
        mine = [c for c in work if c.temperature == t]
        capacity = setting.battery.cell_capacity(t)
        use = [1 - c.drawn / capacity > 0.15 for c in mine]
        error = np.concatenate([1e3 * open_loop(cell, c, capacity)[u] for c, u in zip(mine, use, strict=True)])
        i = np.concatenate([c.current[u] for c, u in zip(mine, use, strict=True)])
        cells = []
        for low, high in bins:
            part = (i >= low) & (i < high)
            cells.append(f"{error[part].mean():+.0f}" if np.count_nonzero(part) > 30 else "–")
        lines.append(f"| {t} | {np.sqrt(np.mean(error**2)):.0f} ({error.mean():+.0f}) | {' | '.join(cells)} |")
    return lines


def _rates(tables: dict[int, Measurements], setting: Setting) -> list[str]:
    lines = ["| °C | C/2 | 1 C | 2 C | 4 C | 6 C |", "|---" * 6 + "|"]
    for t, table in tables.items():
        found = pulse_resistance(table, setting.battery.cell_capacity(t))
        cells = [f"{1e3 * found[r]:.0f}" if r in found else "–" for r in (0.5, 1.0, 2.0, 4.0, 6.0)]
        lines.append(f"| {t} | {' | '.join(cells)} |")
    return lines


MARK = "<!-- made by benchmarks/real_cell.py from here on -->"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("data", type=Path, help="folder of the cell's files")
    parser.add_argument("--write", type=Path, help="replace everything after the mark in this file")
    parser.add_argument("--only", default="", help="cycles whose name holds this")
    parser.add_argument("--board", action="store_true", help="the filter on board alone")
    arguments = parser.parse_args()
    lines = report(arguments.data, arguments.only, arguments.board)
    if arguments.write:
        head = arguments.write.read_text(encoding="utf-8").partition(MARK)[0]
        arguments.write.write_text("\n".join([head + MARK, "", *lines]) + "\n", encoding="utf-8")
    else:
        print(*lines, sep="\n")


if __name__ == "__main__":
    main()
