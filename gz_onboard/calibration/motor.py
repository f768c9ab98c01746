"""Constants of the motor: back-EMF over speed, torque over current (Lord 2016, eqs. 2.7, 2.8, figs. 2.12, 2.13).

The shaft gives what the air gap does less the drag of iron and bearings, so that shaft torque is no line through zero:

    torque = torque_constant·i_m − motor_iron_linear·sign(ω) − motor_iron_quadratic·ω

The drag is that of the effect motor_iron_loss; `losses.motor_losses` gives it from the same fit, with how the copper
loss grows with speed if the points are sure of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.calibration.fit import Solution, line, linear, score, split
from gz_onboard.calibration.result import Fit, Panel, PlotLine, Result, compared
from gz_onboard.calibration.table import Measurements
from gz_onboard.constants import BENCH_TEMPERATURE
from gz_onboard.model.effects import motor_copper_loss

RIDING_CURRENT = 120.0  # A: larger ones are short, and the constant falls with them
COPPER = next(p for p in motor_copper_loss.PARAMETERS if p.unit == "1/K")  # how its resistance grows
FREQUENCY = "motor_copper_frequency"
SURE = 3.0  # sd, of a copper loss that grows with speed
ROUGH = 0.02  # a point's torque sd is not known better than to this share of the greatest torque


def voltage_constant(ramp: Measurements) -> Result:
    """voltage_constant [V·s/rad, line to line, RMS] out of `motor_speed` and `emf_line` at no torque.

    The slope of a line with a free offset. Raises InputError for fewer than 5 points, speeds that hardly differ, or
    a voltage that falls with speed.
    """
    speed, emf = ramp["motor_speed"], ramp["emf_line"]
    if len(speed) < 5:
        raise ramp.error(f"{len(speed)} points are too few for a line; 5 are needed")
    if np.ptp(speed) < 0.3 * np.max(np.abs(speed)):
        raise ramp.error(f"motor_speed {speed.min():.4g} to {speed.max():.4g} rad/s is too narrow a range for a slope")
    keep = split(len(speed))
    found, model, outside = line("voltage_constant", speed, emf, keep)
    if found["voltage_constant"] <= 0:
        raise ramp.error("emf_line falls where motor_speed rises: a sign is wrong")
    result = Result("motor_constants")
    source = f"{ramp.file.name}: {len(speed)} points, {speed.min():.3g} to {speed.max():.3g} rad/s"
    inside = score("back-EMF", "V", emf, model, held_out=False, source=source)
    result.parameters["voltage_constant"] = found.found(
        "voltage_constant", "V·s/rad", f"{source}; rms {inside.rms:.3g} V"
    )
    third = f"a third of {ramp.file.name}"
    result.fits += [inside, score("back-EMF", "V", emf[~keep], outside[~keep], held_out=True, source=third)]
    if abs(found["offset"]) > 3 * found.sd("offset"):
        result.notes.append(f"{ramp.file.name}: {found['offset']:+.3g} V at no speed, {found.sd('offset'):.2g} V sd")
    result.panels += compared("Back-EMF", "motor speed [rad/s]", "line voltage, RMS [V]", speed, emf, model)
    return result


@dataclass(frozen=True)
class Bench:
    """Steady points of a motor dynamometer, each array of shape (n,), SI units."""

    table: Measurements
    speed: Array
    current: Array
    torque: Array  # of the shaft: mean of torque sensor and power analyser, where there are both
    temperature: Array
    loss: Array  # electrical less mechanical power


def read_bench(dyno: Measurements) -> Bench:
    """The points of a dynamometer run with their motor loss; InputError where signs or units cannot be right."""
    speed, current, torque = dyno["motor_speed"], dyno["motor_current"], dyno["shaft_torque"]
    ac, temperature = dyno["ac_power"], dyno["motor_temperature"]
    if len(speed) < 12:
        raise dyno.error(f"{len(speed)} points are too few for a loss map of four parameters; 12 are needed")
    if np.corrcoef(current, torque)[0, 1] < 0.5:
        raise dyno.error("shaft_torque does not rise with motor_current: a sign is wrong, or the rows are mixed up")
    mechanical = torque * speed
    if "mechanical_power" in dyno:
        analysed = dyno["mechanical_power"]
        ratio = float(analysed @ mechanical / (mechanical @ mechanical))
        if abs(ratio - 1) > 0.1:
            raise dyno.error(
                f"mechanical_power is {ratio:.3g} times shaft_torque times motor_speed: a unit or a sign is wrong"
            )
        mechanical = (mechanical + analysed) / 2
    moving = np.abs(speed) > 0.5
    torque = np.where(moving, mechanical / np.where(moving, speed, 1.0), torque)
    loss = ac - mechanical
    if np.median(loss) <= 0:
        row = int(np.argmin(loss))
        raise dyno.error(
            f"ac_power is below the mechanical power, by {-loss[row]:.4g} W: a motor would give energy", row
        )
    return Bench(dyno, speed, current, torque, temperature, loss)


def solve(bench: Bench, use: Mask) -> Solution:
    """torque_constant, motor_copper_resistance, both iron terms and `FREQUENCY` of the points `use`, together.

    The last is held at 0 where it is not distinguishable from it; its sd is what it would have free.
    """
    free, plain = _solve(bench, use, True), _solve(bench, use, False)
    resistance, product = free["motor_copper_resistance"], free[FREQUENCY]
    turn = np.eye(len(free.names))  # from resistance times frequency, in which the loss is linear, to the frequency
    turn[-1] /= resistance
    turn[-1, free.names.index("motor_copper_resistance")] = -product / resistance**2
    covariance = turn @ free.covariance @ turn.T
    if product > SURE * free.sd(FREQUENCY):
        return replace(free, value=np.append(free.value[:-1], product / resistance), covariance=covariance)
    alone = np.zeros_like(covariance)
    alone[:-1, :-1], alone[-1, -1] = plain.covariance, covariance[-1, -1]
    return replace(plain, names=free.names, value=np.append(plain.value, 0.0), covariance=alone)


def _solve(bench: Bench, use: Mask, with_speed: bool) -> Solution:
    """The four, and resistance times `FREQUENCY` as the last if `with_speed`.

    Both equations are linear in them. Errors of torque grow into the loss by the speed, so a point's loss counts
    with that sd; what its two equations share makes the covariance that of whole points.
    """
    w, i = bench.speed[use], bench.current[use]
    copper = copper_loss(bench, 1.0)[use]
    nothing, sign = np.zeros_like(w), np.sign(w)
    columns = {
        "torque_constant": np.concatenate([i, nothing]),
        "motor_copper_resistance": np.concatenate([nothing, copper]),
        "motor_iron_linear": np.concatenate([-sign, np.abs(w)]),
        "motor_iron_quadratic": np.concatenate([-w, w**2]),
    }
    if with_speed:
        columns[FREQUENCY] = np.concatenate([nothing, copper * w**2])
    y = np.concatenate([bench.torque[use], bench.loss[use]])
    point = np.tile(np.arange(len(w)), 2)
    torque_sd, floor = ROUGH * float(np.max(np.abs(bench.torque))), 2.0
    for _ in range(4):  # the sd of torque and the rest of the loss's, from the residuals
        sd = np.concatenate([np.full(len(w), torque_sd), np.hypot(floor, torque_sd * w)])
        found = linear(columns, y, sd, groups=point)
        residual = (found.residual * sd).reshape(2, -1)
        torque_sd = max(float(np.sqrt(np.mean(residual[0] ** 2))), 1e-6)
        floor = max(float(np.sqrt(max(np.mean(residual[1] ** 2 - (torque_sd * w) ** 2), 0.0))), 0.5)
    return found


def torque(solution: Solution, bench: Bench) -> Array:
    """Shaft torque [N·m] of the model at all points."""
    drag = solution["motor_iron_linear"] * np.sign(bench.speed) + solution["motor_iron_quadratic"] * bench.speed
    return np.asarray(solution["torque_constant"] * bench.current - drag)


def torque_constant(
    dyno: Measurements, warming: Measurements | None = None, largest_current: float = RIDING_CURRENT
) -> Result:
    """torque_constant [N·m/A, at the air gap] of steady points up to `largest_current` [A].

    warming: a run at constant current in which the motor heats up: says how the torque falls with its temperature.
    The sd holds the fall of the constant over the currents used, which one number cannot show.
    """
    bench = read_bench(dyno)
    use = within(bench, largest_current)
    found, keep = solve(bench, use), split(len(use))
    held = solve(bench, use & keep)
    i, name = bench.current, dyno.file.name
    result = Result("motor_constants")
    inside = score("shaft torque", "N·m", bench.torque[use], torque(found, bench)[use], held_out=False, source=name)
    result.fits += [inside, *scores("shaft torque", "N·m", bench.torque, torque(held, bench), use, ~keep, bench)]
    through_zero = linear({"slope": i}, bench.torque)["slope"] * i
    what, source = "shaft torque, thesis' line through zero", f"{name}, all currents"
    result.fits.append(score(what, "N·m", bench.torque, through_zero, held_out=False, source=source))
    systematic = _fall_with_current(bench, found, use, largest_current, result)
    low, high = bench.temperature[use].min(), bench.temperature[use].max()
    result.parameters["torque_constant"] = found.found(
        "torque_constant",
        "N·m/A",
        f"{name}: {int(use.sum())} points up to {largest_current:.0f} A at {low:.0f} to {high:.0f} degC, air-gap "
        f"torque; rms {inside.rms:.2g} N·m; sd holds its fall with current",
        systematic,
    )
    if warming is not None:
        result.notes.append(_temperature_note(warming))
    result.panels += _torque_panels(bench, found, use)
    return result


def _fall_with_current(bench: Bench, found: Solution, use: Mask, largest_current: float, result: Result) -> float:
    """The sd [N·m/A] of torque over current among the currents used, with a note if it falls with current."""
    i = bench.current
    saturation = linear({"small": i, "fall": i**3}, bench.torque + found["torque_constant"] * i - torque(found, bench))
    small, fall, largest = saturation["small"], saturation["fall"], float(np.max(np.abs(i)))
    if abs(fall) <= 3 * saturation.sd("fall"):
        return 0.0
    result.notes.append(
        f"torque over current falls with current: {small:.4f} N·m/A at small, {small + fall * largest**2:.4f} at "
        f"{largest:.0f} A; {found['torque_constant']:.4f} stands for up to {largest_current:.0f} A"
    )
    return float(np.std(small + fall * i[use] ** 2))


def _torque_panels(bench: Bench, found: Solution, use: Mask) -> list[Panel]:
    i, x, left = bench.current, "motor current, RMS [A]", bench.torque - torque(found, bench)
    order = np.argsort(i)
    constant = PlotLine("torque constant", i[order], found["torque_constant"] * i[order])
    beyond = PlotLine("beyond the range", i[~use], left[~use], "x")
    return [
        Panel("Shaft torque", x, "torque [N·m]", (PlotLine("measured", i, bench.torque, "."), constant)),
        Panel(
            "Shaft torque: residual", x, "measured less model [N·m]", (PlotLine("used", i[use], left[use], "."), beyond)
        ),
    ]


def within(bench: Bench, largest_current: float) -> Mask:
    """Which points have a current up to `largest_current` [A]; InputError for too few."""
    use: Mask = np.abs(bench.current) <= largest_current
    if use.sum() < 12:
        raise bench.table.error(f"{int(use.sum())} points up to {largest_current:g} A are too few; 12 are needed")
    return use


def scores(what: str, unit: str, data: Array, model: Array, use: Mask, held: Mask, bench: Bench) -> list[Fit]:
    """The fit on the points `held` out: those of the range used, and all."""
    limit, name = float(np.max(np.abs(bench.current[use]))), bench.table.file.name
    parts = [(use & held, f"up to {limit:.0f} A"), *([] if use.all() else [(held, "all currents")])]
    return [
        score(what, unit, data[part], model[part], held_out=True, source=f"a third of {name}, {which}")
        for part, which in parts
    ]


def _temperature_note(warming: Measurements) -> str:
    current, hot = warming["motor_current"], warming["motor_temperature"]
    on = np.abs(current - np.median(current[np.abs(current) > 1.0])) < 0.05 * np.max(np.abs(current))
    ratio = warming["shaft_torque"][on] / current[on]
    slope = linear({"fall": hot[on] - BENCH_TEMPERATURE, "at25": np.ones(int(on.sum()))}, ratio)
    percent = 100 * slope["fall"] / slope["at25"]
    return (
        f"{warming.file.name}: torque over current changes by {percent:+.3f} %/K of the winding's temperature, "
        f"{hot[on].min():.0f} to {hot[on].max():.0f} degC (the magnets follow later): one constant leaves that out"
    )


def copper_loss(bench: Bench, resistance: float, frequency: float = 0.0) -> Array:
    """Copper loss [W] at all points, of a `resistance` [ohm] that grows with `frequency` [s²/rad²]."""
    result: Array = motor_copper_loss.term(
        bench.current,
        bench.temperature,
        bench.speed,
        motor_copper_resistance=resistance,
        motor_copper_temperature_coefficient=COPPER.prior,
        motor_copper_frequency=frequency,
    )
    return result
