"""Loss maps of motor and inverter in watts (Lord 2016, sec. 2.3, figs. 2.14, 2.15; losses instead of efficiencies).

The efficiency has no value at no torque, where a scooter in traffic spends its time; it is derived, to be plotted.
The maps are the package's effects motor_copper_loss, motor_iron_loss and inverter_loss.
"""

from __future__ import annotations

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.calibration import motor
from gz_onboard.calibration.fit import Solution, linear, score, split
from gz_onboard.calibration.motor import RIDING_CURRENT, Bench
from gz_onboard.calibration.result import Found, Panel, PlotLine, Result, compared
from gz_onboard.calibration.table import Measurements
from gz_onboard.model.effects import inverter_loss, motor_iron_loss

CURRENT = "motor current, RMS [A]"
TIED = ("torque_constant", "motor_copper_resistance", "motor_iron_linear", "motor_iron_quadratic", motor.FREQUENCY)
UNITS = {
    "motor_copper_resistance": "ohm",
    motor.FREQUENCY: "s²/rad²",
    "motor_iron_linear": "W·s/rad",
    "motor_iron_quadratic": "W·s²/rad²",
    "inverter_loss_constant": "W",
    "inverter_loss_linear": "W/A",
    "inverter_loss_quadratic": "W/A²",
}


def motor_losses(dyno: Measurements, largest_current: float = RIDING_CURRENT) -> Result:
    """motor_copper_resistance [ohm], its motor_copper_frequency [s²/rad²] and both iron terms of steady points.

    They are tied to the torque_constant of `motor.torque_constant`, which comes out of the same fit.
    """
    bench = motor.read_bench(dyno)
    use, name = motor.within(bench, largest_current), dyno.file.name
    found, keep = motor.solve(bench, use), split(len(use))
    held = motor.solve(bench, use & keep)
    model = motor_loss(found, bench)
    result = Result("motor_losses")
    inside = score("motor loss", "W", bench.loss[use], model[use], held_out=False, source=name)
    result.fits += [inside, *motor.scores("motor loss", "W", bench.loss, motor_loss(held, bench), use, ~keep, bench)]
    low, high = bench.temperature[use].min(), bench.temperature[use].max()
    source = (
        f"{name}: {int(use.sum())} points up to {largest_current:.0f} A, {np.abs(bench.speed[use]).max():.0f} rad/s, "
        f"{low:.0f} to {high:.0f} degC, loss and torque together; rms {inside.rms:.2g} W"
    )
    for parameter in TIED[1:]:
        result.parameters[parameter] = found.found(parameter, UNITS[parameter], source)
    copper = motor.COPPER
    result.parameters[copper.name] = Found(copper.prior, copper.prior_sd, copper.unit, f"copper, {copper.source}")
    result.covariance.append((TIED, found.part(TIED)))
    _copper_with_speed(result, found, bench)
    spread = float(np.ptp(bench.temperature))
    if spread < 30:
        result.refusals.append(
            f"motor_copper_temperature_coefficient: {name} spans {spread:.0f} K only, copper's own is taken"
        )
    result.panels += [
        *compared("Motor loss", CURRENT, "loss [W]", bench.current, bench.loss, model, "x"),
        _efficiency(
            "Motor efficiency (derived)", "torque [N·m]", bench.torque, bench.torque * bench.speed, bench.loss, model
        ),
    ]
    return result


def motor_loss(solution: Solution, bench: Bench) -> Array:
    """Motor loss [W] of the model at all points."""
    iron: Array = motor_iron_loss.term(
        bench.speed,
        motor_iron_linear=solution["motor_iron_linear"],
        motor_iron_quadratic=solution["motor_iron_quadratic"],
    )
    return motor.copper_loss(bench, solution["motor_copper_resistance"], solution[motor.FREQUENCY]) + iron


def _copper_with_speed(result: Result, found: Solution, bench: Bench) -> None:
    """A note by how much the copper loss grows with speed."""
    top = float(np.abs(bench.speed).max())
    share, sd = (100 * x * top**2 for x in (found[motor.FREQUENCY], found.sd(motor.FREQUENCY)))
    result.notes.append(
        f"copper loss grows with speed, by {share:.0f} ± {sd:.0f} % at {top:.0f} rad/s"
        if share
        else f"copper loss does not grow with speed: within {sd:.0f} % (sd) at {top:.0f} rad/s"
    )


def inverter_losses(dyno: Measurements, largest_current: float = RIDING_CURRENT) -> Result:
    """inverter_loss_constant [W], _linear [W/A], _quadratic [W/A²] of steady points: DC less AC power."""
    current, loss = dyno["motor_current"], dyno["dc_power"] - dyno["ac_power"]
    name = dyno.file.name
    if np.median(loss) <= 0:
        row = int(np.argmin(loss))
        raise dyno.error(f"dc_power is below ac_power, by {-loss[row]:.4g} W: an inverter would give energy", row)
    use = np.abs(current) <= largest_current
    if use.sum() < 9 or np.ptp(np.abs(current[use])) < 0.3 * largest_current:
        raise dyno.error(
            f"{int(use.sum())} points up to {largest_current:g} A, from {np.abs(current).min():.3g} A on, are too few "
            "for a loss over current of three parameters"
        )
    keep = split(len(use))
    found, held = (_inverter(current, loss, dyno["dc_power"], points) for points in (use, use & keep))
    model = _inverter_model(found, current)
    result = Result("inverter_losses")
    inside = score("inverter loss", "W", loss[use], model[use], held_out=False, source=name)
    outside = _inverter_model(held, current)
    third, limit = f"a third of {name}", f"up to {largest_current:.0f} A"
    away = use & ~keep
    result.fits.append(inside)
    for points, source in ((away, f"{third}, {limit}"), (~keep, f"{third}, all currents")):
        result.fits.append(score("inverter loss", "W", loss[points], outside[points], held_out=True, source=source))
    source = f"{name}: {int(use.sum())} points up to {largest_current:.0f} A; rms {inside.rms:.2g} W"
    for parameter in found.names:
        result.parameters[parameter] = found.found(parameter, UNITS[parameter], source)
    result.covariance.append((found.names, found.covariance))
    speed = np.abs(dyno["motor_speed"])
    more = linear(
        {"constant": np.ones_like(loss), "linear": np.abs(current), "quadratic": current**2, "speed": speed}, loss
    )
    sure = abs(more["speed"]) > 3 * more.sd("speed")
    result.notes.append(
        f"inverter loss over speed: {more['speed']:+.3f} ± {more.sd('speed'):.3f} W·s/rad, "
        + ("which the effect does not know" if sure else "no term is asked for")
    )
    power = dyno["ac_power"]
    result.panels += [
        *compared("Inverter loss", CURRENT, "loss [W]", current, loss, model, "x"),
        _efficiency("Inverter efficiency (derived)", "AC power [W]", power, power, loss, model),
    ]
    return result


def _inverter(current: Array, loss: Array, power: Array, use: Mask) -> Solution:
    """The three parameters of the points `use`. A point's sd grows with its power, as an analyser's does."""
    i, y = current[use], loss[use]
    columns = {
        "inverter_loss_constant": np.ones_like(i),
        "inverter_loss_linear": np.abs(i),
        "inverter_loss_quadratic": i**2,
    }
    found, size = linear(columns, y), np.abs(power[use])
    for _ in range(3):
        squares = linear({"constant": np.ones_like(size), "size": size**2}, _error(columns, found, y) ** 2)
        variance = np.maximum(squares["constant"], 0) + max(squares["size"], 0.0) * size**2
        found = linear(columns, y, np.sqrt(np.maximum(variance, 0.1 * np.mean(variance) + 1e-12)))
    return found


def _error(columns: dict[str, Array], found: Solution, y: Array) -> Array:
    """Model less data, not weighted."""
    return sum((found[name] * column for name, column in columns.items()), start=-y)


def _inverter_model(found: Solution, current: Array) -> Array:
    return np.asarray(inverter_loss.term(current, **{name: found[name] for name in found.names}))


def _ratio(power: Array, loss: Array) -> Array:
    """Efficiency [%] of giving `power` [W] forward, or of taking it back where it is negative; nan near no power."""
    forward = power / np.where(power + loss > 0, power + loss, np.nan)
    back = (power + loss) / np.where(power < 0, power, np.nan)
    value: Array = 100 * np.where(power > 0, forward, np.maximum(back, 0.0))
    return np.where(np.abs(power) > 0.02 * np.max(np.abs(power)), value, np.nan)


def _efficiency(title: str, x_label: str, x: Array, power: Array, loss: Array, model: Array) -> Panel:
    lines = PlotLine("measured", x, _ratio(power, loss), "."), PlotLine("model", x, _ratio(power, model), "x")
    return Panel(title, x_label, "efficiency [%]", lines)
