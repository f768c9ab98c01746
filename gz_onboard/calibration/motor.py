"""Motor and inverter from steady points of a dynamometer (Lord 2016, eqs. 2.7, 2.8, sec. 2.3, figs. 2.12 to 2.15).

Back-EMF over speed, torque over current, and losses in watts: an efficiency has no value at no torque, where a scooter
in traffic spends its time. The shaft's torque is that of the air gap less the drag of
iron and bearings, so that shaft torque is no line through zero:

    torque = torque_constant·i_m − motor_iron_linear·sign(ω) − motor_iron_quadratic·ω

Torque and loss are one fit. The losses are the effects motor_copper_loss, motor_iron_loss and inverter_loss.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.calibration.fit import Solution, line, linear, score, split
from gz_onboard.calibration.result import Fit, Found, Panel, PlotLine, Result, compared
from gz_onboard.calibration.table import Measurements
from gz_onboard.model.effects import inverter_loss, motor_copper_loss, motor_iron_loss

RIDING_CURRENT = 120.0  # A: larger ones are short, and the constant falls with them
SIGNIFICANCE = 3.0  # sd, of a copper loss that grows with speed or a constant that falls with current
TORQUE_SD = 0.02  # relative: a point's torque is not known better than to this share of the greatest torque
WARMED = 30.0  # K between points that tell a temperature coefficient
FEWEST_POINTS = 12

COPPER = next(p for p in motor_copper_loss.PARAMETERS if p.unit == "1/K")  # how its resistance grows
FREQUENCY = "motor_copper_frequency"
TIED = ("torque_constant", "motor_copper_resistance", "motor_iron_linear", "motor_iron_quadratic", FREQUENCY)
UNITS = {
    "motor_copper_resistance": "ohm",
    FREQUENCY: "s²/rad²",
    "motor_iron_linear": "W·s/rad",
    "motor_iron_quadratic": "W·s²/rad²",
    "inverter_loss_constant": "W",
    "inverter_loss_linear": "W/A",
    "inverter_loss_quadratic": "W/A²",
}
CURRENT = "motor current, RMS [A]"


def voltage_constant(ramp: Measurements) -> Result:
    """voltage_constant [V·s/rad, line to line, RMS] out of `motor_speed` and `emf_line` at no torque.

    The slope of a line with a free offset. Raises InputError for fewer than 5 points, speeds that hardly differ, or
    a voltage that falls with speed.
    """
    speed, emf, name = ramp["motor_speed"], ramp["emf_line"], ramp.file.name
    if len(speed) < 5:
        raise ramp.error(f"{len(speed)} points are too few for a line; 5 are needed")
    if np.ptp(speed) < 0.3 * np.max(np.abs(speed)):
        raise ramp.error(f"motor_speed {speed.min():.4g} to {speed.max():.4g} rad/s is too narrow a range for a slope")
    keep = split(len(speed))
    found, model = line("voltage_constant", speed, emf)
    part = line("voltage_constant", speed[keep], emf[keep])[0]
    outside = part["voltage_constant"] * speed[~keep] + part["offset"]
    if found["voltage_constant"] <= 0:
        raise ramp.error("emf_line falls where motor_speed rises: a sign is wrong")
    result = Result("motor")
    source = f"{name}: {len(speed)} points, {speed.min():.3g} to {speed.max():.3g} rad/s"
    inside = score("back-EMF", "V", emf, model, held_out=False, source=source)
    held = score("back-EMF", "V", emf[~keep], outside, held_out=True, source=f"a third of {name}")
    result.fits += [inside, held]
    source = f"{source}; rms {inside.rms:.3g} V"
    result.parameters["voltage_constant"] = found.found("voltage_constant", "V·s/rad", source)
    if abs(found["offset"]) > 3 * found.sd("offset"):
        result.notes.append(f"{name}: {found['offset']:+.3g} V at no speed, {found.sd('offset'):.2g} V sd")
    result.panels += compared("Back-EMF", "motor speed [rad/s]", "line voltage, RMS [V]", speed, emf, model)
    return result


@dataclass(frozen=True)
class Bench:
    """Steady points of a motor dynamometer with the model of motor_copper_loss and motor_iron_loss; SI units.

    Each array (n,). torque: of the shaft, the mean of torque sensor and power analyser, where there are both. loss:
    electrical less mechanical power. use: points up to `limit` [A], which are fitted.
    """

    name: str
    speed: Array
    current: Array
    torque: Array
    temperature: Array
    loss: Array
    use: Mask
    limit: float

    def copper(self, resistance: float, frequency: float = 0.0) -> Array:
        """Copper loss [W] of a `resistance` [ohm] that grows with `frequency` [s²/rad²]."""
        result: Array = motor_copper_loss.term(
            self.current,
            self.temperature,
            self.speed,
            motor_copper_resistance=resistance,
            motor_copper_temperature_coefficient=COPPER.prior,
            motor_copper_frequency=frequency,
        )
        return result

    def modelled_torque(self, s: Solution) -> Array:
        """Shaft torque [N·m] of the model."""
        drag = s["motor_iron_linear"] * np.sign(self.speed) + s["motor_iron_quadratic"] * self.speed
        return np.asarray(s["torque_constant"] * self.current - drag)

    def modelled_loss(self, s: Solution) -> Array:
        """Motor loss [W] of the model."""
        iron = {name: s[name] for name in ("motor_iron_linear", "motor_iron_quadratic")}
        copper = self.copper(s["motor_copper_resistance"], s[FREQUENCY])
        return np.asarray(copper + motor_iron_loss.term(self.speed, **iron))

    def scored(self, what: str, unit: str, data: Array, model: Array, held: Array, keep: Mask) -> list[Fit]:
        """Fits in sample, and of the model `held` on the points not in `keep`: those of the range used, and all."""
        largest = float(np.max(np.abs(self.current[self.use])))
        parts = [(self.use & ~keep, f"up to {largest:.0f} A")]
        parts += [] if self.use.all() else [(~keep, "all currents")]
        return [
            score(what, unit, data[self.use], model[self.use], held_out=False, source=self.name),
            *(
                score(what, unit, data[part], held[part], held_out=True, source=f"a third of {self.name}, {which}")
                for part, which in parts
            ),
        ]


def read_bench(dyno: Measurements, largest_current: float = RIDING_CURRENT) -> Bench:
    """The points of a dynamometer run with their motor loss; InputError where signs or units cannot be right.

    largest_current [A]: points up to it are used; too few of them are refused.
    """
    speed, current, torque = dyno["motor_speed"], dyno["motor_current"], dyno["shaft_torque"]
    ac, temperature = dyno["ac_power"], dyno["motor_temperature"]
    if len(speed) < FEWEST_POINTS:
        raise dyno.error(
            f"{len(speed)} points are too few for a loss map of four parameters; {FEWEST_POINTS} are needed"
        )
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
    _check_loss(dyno, loss, "ac_power is below the mechanical power", "a motor")
    use: Mask = np.abs(current) <= largest_current
    if use.sum() < FEWEST_POINTS:
        raise dyno.error(f"{int(use.sum())} points up to {largest_current:g} A are too few; {FEWEST_POINTS} are needed")
    return Bench(dyno.file.name, speed, current, torque, temperature, loss, use, largest_current)


def _check_loss(dyno: Measurements, loss: Array, below: str, machine: str) -> None:
    if np.median(loss) <= 0:
        row = int(np.argmin(loss))
        raise dyno.error(f"{below}, by {-loss[row]:.4g} W: {machine} would give energy", row)


def solve(bench: Bench, use: Mask) -> Solution:
    """`TIED` of the points `use`, together.

    `FREQUENCY` is held at 0 where it is not distinguishable from it; its sd is that of a free fit.
    """
    free, plain = _solve(bench, use, True), _solve(bench, use, False)
    resistance, product = free["motor_copper_resistance"], free[FREQUENCY]
    turn = np.eye(len(free.names))  # from resistance times frequency, in which the loss is linear, to the frequency
    turn[-1] /= resistance
    turn[-1, free.names.index("motor_copper_resistance")] = -product / resistance**2
    covariance = turn @ free.covariance @ turn.T
    if product > SIGNIFICANCE * free.sd(FREQUENCY):
        return replace(free, value=np.append(free.value[:-1], product / resistance), covariance=covariance)
    alone = np.zeros_like(covariance)
    alone[:-1, :-1], alone[-1, -1] = plain.covariance, covariance[-1, -1]
    return replace(plain, names=free.names, value=np.append(plain.value, 0.0), covariance=alone)


def _solve(bench: Bench, use: Mask, with_speed: bool) -> Solution:
    """The first four of `TIED`, and resistance times `FREQUENCY` as the last if `with_speed`.

    Both equations are linear in them. Errors of torque grow into the loss by the speed, so a point's loss counts
    with that sd; what its two equations share makes the covariance that of whole points.
    """
    w, i = bench.speed[use], bench.current[use]
    copper = bench.copper(1.0)[use]
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
    torque_sd, floor = TORQUE_SD * float(np.max(np.abs(bench.torque))), 2.0
    for _ in range(4):  # the sd of torque and the rest of the loss's, from the residuals
        sd = np.concatenate([np.full(len(w), torque_sd), np.hypot(floor, torque_sd * w)])
        found = linear(columns, y, sd, groups=point)
        residual = (found.residual * sd).reshape(2, -1)
        torque_sd = max(float(np.sqrt(np.mean(residual[0] ** 2))), 1e-6)
        floor = max(float(np.sqrt(max(np.mean(residual[1] ** 2 - (torque_sd * w) ** 2), 0.0))), 0.5)
    return found


def torque_constant(dyno: Measurements, largest_current: float = RIDING_CURRENT) -> Result:
    """torque_constant [N·m/A, at the air gap] of steady points up to `largest_current` [A].

    The sd holds the fall of the constant over the currents used, which one number cannot show.
    """
    bench = read_bench(dyno, largest_current)
    found, keep, use = solve(bench, bench.use), split(len(bench.use)), bench.use
    model, held = (bench.modelled_torque(s) for s in (found, solve(bench, use & keep)))
    result = Result("motor", fits=bench.scored("shaft torque", "N·m", bench.torque, model, held, keep))
    low, high = bench.temperature[use].min(), bench.temperature[use].max()
    source = (
        f"{bench.name}: {int(use.sum())} points up to {bench.limit:.0f} A at {low:.0f} to {high:.0f} degC, air-gap "
        f"torque; rms {result.fits[0].rms:.2g} N·m; sd holds its fall with current"
    )
    systematic = _fall_with_current(bench, found, model, result)
    result.parameters["torque_constant"] = found.found("torque_constant", "N·m/A", source, systematic)
    i, residual, order = bench.current, bench.torque - model, np.argsort(bench.current)
    constant = PlotLine("torque constant", i[order], found["torque_constant"] * i[order])
    used, beyond = (
        PlotLine("used", i[use], residual[use], "."),
        PlotLine("beyond the range", i[~use], residual[~use], "x"),
    )
    lines = PlotLine("measured", i, bench.torque, "."), constant
    result.panels.append(Panel("Shaft torque", CURRENT, "torque [N·m]", lines))
    result.panels.append(Panel("Shaft torque: residual", CURRENT, "measured less model [N·m]", (used, beyond)))
    return result


def _fall_with_current(bench: Bench, found: Solution, model: Array, result: Result) -> float:
    """The sd [N·m/A] of torque over current among the currents used, with a note if it falls with current."""
    i, constant = bench.current, found["torque_constant"]
    saturation = linear({"small": i, "fall": i**3}, bench.torque + constant * i - model)
    small, fall, largest = saturation["small"], saturation["fall"], float(np.max(np.abs(i)))
    if abs(fall) <= SIGNIFICANCE * saturation.sd("fall"):
        return 0.0
    result.notes.append(
        f"torque over current falls with current: {small:.4f} N·m/A at small, {small + fall * largest**2:.4f} at "
        f"{largest:.0f} A; {constant:.4f} is used up to {bench.limit:.0f} A"
    )
    return float(np.std(small + fall * i[bench.use] ** 2))


def motor_losses(dyno: Measurements, largest_current: float = RIDING_CURRENT) -> Result:
    """motor_copper_resistance [ohm], its motor_copper_frequency [s²/rad²] and both iron terms of steady points.

    They are tied to the torque_constant of `torque_constant`, which comes out of the same fit. The coefficient of
    copper's temperature is copper's own, and given only for points that span `WARMED`.
    """
    bench = read_bench(dyno, largest_current)
    found, keep, use = solve(bench, bench.use), split(len(bench.use)), bench.use
    model, held = (bench.modelled_loss(s) for s in (found, solve(bench, use & keep)))
    result = Result("losses", fits=bench.scored("motor loss", "W", bench.loss, model, held, keep))
    low, high = bench.temperature[use].min(), bench.temperature[use].max()
    source = (
        f"{bench.name}: {int(use.sum())} points up to {bench.limit:.0f} A, {np.abs(bench.speed[use]).max():.0f} rad/s, "
        f"{low:.0f} to {high:.0f} degC, loss and torque together; rms {result.fits[0].rms:.2g} W"
    )
    for parameter in TIED[1:]:
        result.parameters[parameter] = found.found(parameter, UNITS[parameter], source)
    result.covariance.append((TIED, found.part(TIED)))
    top = float(np.abs(bench.speed).max())
    share, sd = (100 * x * top**2 for x in (found[FREQUENCY], found.sd(FREQUENCY)))
    result.notes.append(
        f"copper loss grows with speed, by {share:.0f} ± {sd:.0f} % at {top:.0f} rad/s"
        if share
        else f"copper loss does not grow with speed: within {sd:.0f} % (sd) at {top:.0f} rad/s"
    )
    spread = float(np.ptp(bench.temperature))
    if spread < WARMED:
        result.refusals.append(f"{COPPER.name}: {bench.name} spans {spread:.0f} K only, copper's own is taken")
    else:
        source = f"copper, {COPPER.source}"
        result.parameters[COPPER.name] = Found(COPPER.prior, COPPER.prior_sd, COPPER.unit, source)
    result.panels += compared("Motor loss", CURRENT, "loss [W]", bench.current, bench.loss, model, "x")
    return result


def inverter_losses(dyno: Measurements, largest_current: float = RIDING_CURRENT) -> Result:
    """inverter_loss_constant [W], _linear [W/A], _quadratic [W/A²] of steady points: DC less AC power."""
    current, loss = dyno["motor_current"], dyno["dc_power"] - dyno["ac_power"]
    _check_loss(dyno, loss, "dc_power is below ac_power", "an inverter")
    use: Mask = np.abs(current) <= largest_current
    if use.sum() < 9 or np.ptp(np.abs(current[use])) < 0.3 * largest_current:
        raise dyno.error(
            f"{int(use.sum())} points up to {largest_current:g} A, from {np.abs(current).min():.3g} A on, are too few "
            "for a loss over current of three parameters"
        )
    keep, name = split(len(use)), dyno.file.name
    found, held = (_inverter(current[part], loss[part], dyno["dc_power"][part]) for part in (use, use & keep))
    model, outside = (np.asarray(inverter_loss.term(current, **{n: s[n] for n in s.names})) for s in (found, held))
    result = Result("losses")
    result.fits.append(score("inverter loss", "W", loss[use], model[use], held_out=False, source=name))
    for part, which in ((use & ~keep, f"up to {largest_current:.0f} A"), (~keep, "all currents")):
        source = f"a third of {name}, {which}"
        result.fits.append(score("inverter loss", "W", loss[part], outside[part], held_out=True, source=source))
    source = f"{name}: {int(use.sum())} points up to {largest_current:.0f} A; rms {result.fits[0].rms:.2g} W"
    for parameter in found.names:
        result.parameters[parameter] = found.found(parameter, UNITS[parameter], source)
    result.covariance.append((found.names, found.covariance))
    result.panels += compared("Inverter loss", CURRENT, "loss [W]", current, loss, model, "x")
    return result


def _inverter(current: Array, loss: Array, power: Array) -> Solution:
    """The three parameters. A point's sd grows with its power, as an analyser's does."""
    columns = {
        "inverter_loss_constant": np.ones_like(current),
        "inverter_loss_linear": np.abs(current),
        "inverter_loss_quadratic": current**2,
    }
    found, size = linear(columns, loss), np.abs(power)
    for _ in range(3):
        error = sum((found[name] * column for name, column in columns.items()), start=-loss)
        squares = linear({"constant": np.ones_like(size), "size": size**2}, error**2)
        variance = np.maximum(squares["constant"], 0) + max(squares["size"], 0.0) * size**2
        found = linear(columns, loss, np.sqrt(np.maximum(variance, 0.1 * np.mean(variance) + 1e-12)))
    return found
