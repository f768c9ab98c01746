"""R0, R1 and C1 over state of charge and temperature from pulse tests of one cell (Lord 2016, sec. 2.2).

One table per temperature. Each test begins at full and rests before its pulses; what it rests at shows how much charge
there is between full and empty at its temperature. Many RC pairs of fixed time constants are fitted, linear in every
table. Of these the slow ones become an effect (`pulse_slow`), and the one pair that is nearest to the rest under a load
like riding the tables; beside it the two that are nearest to all (see `cell_fit`).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.calibration.cell_circuit import FOUND, NO_REACTION, Circuit, Reaction, riding_current, voltage
from gz_onboard.calibration.cell_data import CellTest
from gz_onboard.calibration.cell_fit import TIMES, Reduction, fit_branches
from gz_onboard.calibration.fit import score
from gz_onboard.calibration.ocv import TESTER
from gz_onboard.calibration.pulse_error import Residual, voltage_errors
from gz_onboard.calibration.pulse_mesh import direct, mesh_quality, meshes
from gz_onboard.calibration.pulse_reaction import charge_transfer, linear
from gz_onboard.calibration.pulse_rests import rest_shift, rests_over_soc, shift_of_rests
from gz_onboard.calibration.pulse_slow import RESISTANCE, TIME, slow_relaxation
from gz_onboard.calibration.pulse_slow import found as found_slow
from gz_onboard.calibration.pulse_test import APART, Tested, moved_pieces, nearest_to_bench, tested
from gz_onboard.calibration.result import Curve, Found, Panel, PlotLine, Result, compared
from gz_onboard.calibration.table import Measurements
from gz_onboard.constants import HOUR
from gz_onboard.errors import InputError, nearest
from gz_onboard.model.effects import charge_transfer as effect

SOC = np.array([0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0])
METHODS = ("reduced", "direct")
EFFECT = effect.__name__.rpartition(".")[2]


def calibrate(
    tables: Sequence[Measurements],
    ocv: Curve,
    capacity: Found,
    *,
    loads: Sequence[Array] | None = None,
    method: str = "reduced",
    soc: Array = SOC,
) -> Result:
    """``battery.r0``, ``r1``, ``c1``, ``capacity``, ``ocv``, and beside them a slow pair.

    Also what they err by (see `pulse_error`), and ``battery.rest_shift``, if the rests show one (see `pulse_rests`).

    tables: one for each temperature. ocv, capacity: from `ocv.calibrate`. loads: currents [any unit, one value a
    second, each from rest] that the pair is to follow; synthetic rides if None. Raises InputError for tables that are
    no pulse tests (see `cell_data.cell_test`), too few pulses, too narrow a range, or two tests at one temperature.
    method: ``reduced``, the pair that follows a load best; or ``direct``, the pair that is nearest to the pulses
    themselves, which gives back the numbers of a cell that has but one pair, and follows a ride worse.
    """
    if method not in METHODS:
        raise InputError(f"method {method!r} is not known{nearest(method, METHODS)}: {' or '.join(METHODS)}")
    result = Result("pulse")
    tests = _tests(tables, ocv, capacity, result)
    nodes, volts = ocv.axes["soc"], ocv.value
    reaction = charge_transfer(tests, nodes, volts, soc, result)
    measured, tests = tests, [linear(t, reaction) for t in tests]
    split, activation = moved_pieces(tests, nodes, volts, soc)
    fitted = [fit_branches(x, leave_out=True) for x in split]
    rides = [riding_current(seed=k) for k in range(1, 4)] if loads is None else loads
    two, sd_two = meshes(fitted, Reduction(rides, count=2))
    covered = np.array([f.covered for f in fitted])
    slow = slow_relaxation(fitted, capacity.value, result) if method == "reduced" else None
    reduction = Reduction(rides, beside=(slow.resistance, slow.time) if slow else None)
    one, sd_one = meshes(fitted, reduction)
    names = ", ".join(t.test.name for t in tests)
    how = f"{names}: {len(TIMES)} RC pairs, reduced over {'synthetic rides' if loads is None else 'the loads given'}"
    if method == "direct":
        one, sd_one = direct(tests, fitted, activation, nodes, volts, one)
        how = f"{names}: least squares of one RC pair"
    shift, ocv_sd = rest_shift(fitted, tests, nodes, ocv)
    result.curves["rest_shift"] = rests_over_soc(fitted, tests, names)
    shift_of_rests(result.curves["rest_shift"], tests, names, result)
    result.curves["battery.ocv"] = Curve(
        {"soc": nodes}, volts + shift, ocv_sd, "V", f"{ocv.source}; moved to the rests"
    )
    temperature, amount, amount_sd = np.array([(t.temperature, t.capacity, t.capacity_sd) for t in tests]).T
    source = f"{names}: charge that lays the rest voltages on the OCV"
    result.curves["battery.capacity"] = Curve({"temperature": temperature}, amount, amount_sd, "A·h", source)
    axes = {"soc": soc, "temperature": temperature}
    _tables(result, axes, covered, how, (one, sd_one), (two, sd_two))
    for t, there in zip(tests, covered, strict=True):
        if not np.all(there):
            result.refusals.append(
                f"{t.test.name}: no pulses near SOC {', '.join(f'{s:g}' for s in soc[~there])} at "
                f"{t.temperature:g} degC; the table there only continues its neighbours (no sd)"
            )
    _reaction(result, reaction, names)
    if method == "reduced":
        found_slow(slow, names, result)
    _voltages(result, measured, names)
    if method == "reduced":  # the halves are
        mesh_quality(result, tests, fitted, split, reduction, one)
    return result


def _reaction(result: Result, reaction: Reaction, names: str) -> None:
    """The effect and its parameters; without them if there is none."""
    result.effects[EFFECT] = bool(reaction.resistance)
    if reaction.resistance:
        values = (reaction.resistance, reaction.activation, reaction.time)
        for parameter, value, sd in zip(FOUND, values, reaction.sd, strict=True):
            result.parameters[parameter.name] = Found(value, sd, parameter.unit, f"{names}: pulses of several currents")


def _tables(
    result: Result,
    axes: dict[str, Array],
    covered: Mask,
    how: str,
    one: tuple[list[Array], list[Array]],
    two: tuple[list[Array], list[Array]],
) -> None:
    """The tables of one pair and of two, each (values, relative sd) as of `meshes`, without an sd where not covered."""
    (r0, r1, time), sd = one
    (slow_r0, fast, slow, fast_time, slow_time), slow_sd = two
    for name, value, share, unit, what in (
        ("battery.r0", r0, sd[0], "ohm", "R0"),
        ("battery.r1", r1, sd[1], "ohm", "R1"),
        ("battery.c1", time / r1, sd[3], "F", "τ1/R1"),
        ("slow_r0", slow_r0, slow_sd[0], "ohm", "R0 beside two pairs"),
        ("slow_r1", fast, slow_sd[1], "ohm", "R1 beside a slow pair"),
        ("slow_c1", fast_time / fast, slow_sd[5], "F", "C1 beside a slow pair"),
        ("slow_resistance", slow, slow_sd[2], "ohm", "slow pair"),
        ("slow_time", slow_time, slow_sd[4], "s", "slow pair"),
    ):
        sds = np.where(covered, value * np.hypot(share, TESTER), np.nan)
        result.curves[name] = Curve(axes, value, sds, unit, f"{how}; {what}")


def _tests(tables: Sequence[Measurements], ocv: Curve, capacity: Found, result: Result) -> list[Tested]:
    """The tests by temperature; InputError for none, or two at one temperature."""
    if not tables:
        raise InputError("no pulse test is given")
    tests = sorted((tested(t, ocv, capacity, result) for t in tables), key=lambda t: t.temperature)
    for cold, warm in pairwise(tests):
        if warm.temperature - cold.temperature < 2:
            raise InputError(
                f"{cold.test.table.file} and {warm.test.table.file} are both at {warm.temperature:g} degC: one of them"
            )
    rated = tests[nearest_to_bench(tests)]
    if abs(rated.capacity / capacity.value - 1) > APART:
        result.notes.append(
            f"{rated.test.name}: the rests ask for a capacity of {rated.capacity:.3f} A·h at {rated.temperature:g} "
            f"degC, cell_capacity is {capacity.value:.3f}: another cell, an aged one, or tests between other ends. "
            "cell_capacity stays; battery.capacity only says how it depends on temperature"
        )
    return tests


def circuit(result: Result, slow: bool = False) -> Circuit:
    """The cell that `calibrate` found, as on board; with `slow`, of two RC pairs, each in tables."""
    c = result.curves
    ocv, axes = c["battery.ocv"], c["battery.r0"].axes
    prefix = "slow_" if slow else "battery."
    tables = {name: c[prefix + name].value for name in ("r0", "r1", "c1")}
    for parameter in (RESISTANCE, TIME):
        if slow:
            tables[parameter.name] = c[parameter.name].value
        elif parameter.name in result.parameters:
            tables[parameter.name] = np.full_like(tables["r0"], result.parameters[parameter.name].value)
    if "battery.rest_shift" in c:
        tables["rest_shift"] = c["battery.rest_shift"].value
    capacity = c["battery.capacity"].value
    found = [result.parameters[p.name].value for p in FOUND if p.name in result.parameters]
    reaction = Reaction(found[0], found[1], found[2]) if found else NO_REACTION
    return Circuit(ocv.axes["soc"], ocv.value, axes["soc"], axes["temperature"], capacity, **tables, reaction=reaction)


def follow_profile(cell: Circuit, test: CellTest) -> tuple[Array, Array]:
    """(model, measured) voltage (m,) [V]: from the SOC of the first voltage, at rest, on by the current alone."""
    slope = np.interp(test.temperature, cell.temperature, cell.capacity)
    order = np.argsort(cell.ocv)
    rest = test.voltage[0] - cell.ocv_shift(test.temperature[:1])[0]
    start = float(np.interp(rest, cell.ocv[order], cell.ocv_soc[order]))
    level = start - np.cumsum(np.diff(test.drawn, prepend=0.0) / slope)
    return voltage(cell, test.flowed, test.current, test.dt, level, test.temperature), test.voltage


def _voltages(result: Result, tests: Sequence[Tested], names: str) -> None:
    """How well the tables follow the tests that they came from: voltage, and what is left over time."""
    pairs = {"on board": circuit(result), "two pairs": circuit(result, slow=True)}
    rms: dict[str, list[float]] = {"above": [], "below": []}  # 0.1 of SOC, of the circuit on board
    left = []
    for t in tests:
        test, at = t.test, f"{t.temperature:g}"
        models = {
            what: voltage(c, test.flowed, test.current, test.dt, t.level, test.temperature) for what, c in pairs.items()
        }
        for what, model in models.items():
            for name, part in (("above", t.level > 0.1), ("below", t.level <= 0.1)):
                if np.count_nonzero(part) > 20:
                    about, data = f"voltage, {what}, {at} degC, SOC {name} 0.1", test.voltage[part]
                    fit = score(about, "V", data, model[part], held_out=False, source=test.name)
                    result.fits.append(fit)
                    if what == "on board":
                        rms[name].append(fit.rms)
        left.append(Residual(t.temperature, test.time, test.voltage - models["on board"], t.level, test.rest))
        hours, model, title = test.time / HOUR, models["on board"], f"Pulse test at {at} °C"
        result.panels += compared(title, "time [h]", "voltage [V]", hours, test.voltage, model)
    voltage_errors(left, names, result)
    for key, unit, factor in (("r0", "mΩ", 1e3), ("r1", "mΩ", 1e3), ("c1", "F", 1.0)):
        mesh = result.curves[f"battery.{key}"]
        rows = zip(mesh.axes["temperature"], mesh.value, strict=True)
        over_soc = tuple(PlotLine(f"{degrees:g} °C", mesh.axes["soc"], factor * row) for degrees, row in rows)
        result.panels.append(Panel(key.upper(), "state of charge", unit, over_soc))
    for parameter, where in (("cell_voltage_error", "above"), ("cell_voltage_error_empty", "below")):
        if rms[where] or where == "above":
            sd, source = float(np.sqrt(np.mean(np.square(rms[where])))), f"rms of the circuit {where} 10 % SOC"
            result.parameters[parameter] = Found(0.0, sd, "V", f"{names}: {source}")
