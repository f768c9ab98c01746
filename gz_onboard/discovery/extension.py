"""The vehicle file extended by what a discovery found."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.calibration.result import Found, Result
from gz_onboard.calibration.toml_text import number, string, with_keys
from gz_onboard.calibration.vehicle_file import copied_effects, merged, write_whole
from gz_onboard.discovery.baseline_file import accepted, restore, saved_beside
from gz_onboard.discovery.energy import energy_share
from gz_onboard.discovery.result import CONSTANT, Unknown
from gz_onboard.discovery.verdict import Discovery
from gz_onboard.discovery.wording import with_unit
from gz_onboard.model.effect import QUANTITIES, Effect
from gz_onboard.vehicle import Vehicle

PORTS = {
    "road_force": ("WHEEL_FORCE", "N", 1.0),
    "inverter_power": ("INVERTER_LOSS", "W", 1.0),
    "pack_power": ("DC_POWER", "W", 1.0),
    "auxiliary": ("DC_POWER", "W", 1.0),
    "cell_voltage": ("CELL_VOLTAGE", "V", -1.0),
}
READS = {CONSTANT: "speed", "time": "time_moving", "pack_current": "cell_current"}
MODELLED = ("road_force", "inverter_power", "pack_power", "auxiliary")
"""The channels whose residual is energy that the model lacks; elsewhere it is a sensor's."""


FACTORS = (0.3, 3.0)  # within which a forecast's factor is believed
NEGLIGIBLE = 1e-4  # of the energy
LONGEST = 150  # characters of the rides' names, beyond which they are counted only


def write_model(found: Discovery, vehicle: Vehicle, base: Path, out: Path) -> list[str]:
    """Write the vehicle extended by what was `found`, or by a curve for what has no name; what was done, in words.

    The file is that of `base` with the added effects and parameters, their standard deviation from the interval, and
    what healthy rides taught, now about these. Effects that are not the package's are copied into a folder beside it.
    The report's `extended_model` stays None if nothing could be added.

    What the vehicle file alone lacks is part of its ``[forecast] factor``, measured over modelled energy, and leaves
    it (`lowered`); what came on top of healthy rides is not.
    """
    report = found.report
    parameters, added = extension(found)
    words = [f"{name} = {f.value:.4g} ± {with_unit(f.sd, f.unit, '.2g')}" for name, f in parameters.items()]
    folder = out.with_name(f"{out.stem}_effects")
    names = [effect.name for effect in (*vehicle.model.effects, *added)]
    curve = None
    if report.unknown is not None:
        curve = curve_text(found)
        if curve is None:
            words.append(
                f"nothing for the curve: no effect can read {report.unknown.quantity} at {report.unknown.channel}"
            )
        else:
            words.append(f"an empirical effect, {folder.name}/{curve[0]}.py")
            names.append(curve[0])
    if not parameters and not added and curve is None:
        return words
    keys = copied_effects((*vehicle.model.effects, *added), out)
    keys["model", "effects"] = "[" + ", ".join(map(string, names)) + "]"
    if curve:
        folder.mkdir(exist_ok=True)
        (folder / f"{curve[0]}.py").write_text(curve[1], encoding="utf-8")
        keys["model", "effects_folder"] = string(folder.name)
    if not found.mixed.healthy and (factor := lowered(found, vehicle, curve is not None)):
        value, reason = factor
        before = tomllib.loads(base.read_text(encoding="utf-8")).get("forecast", {}).get("source")
        source = f"{reason}; before: {before}" if before else reason
        keys |= {("forecast", "factor"): number(value), ("forecast", "source"): string(source)}
        words.append(f"forecast factor {vehicle.riding.factor:g} to {value:.3g}: what was found leaves it")
    text = merged(base.read_text(encoding="utf-8"), [Result("discover", parameters=parameters)], base, out)
    if vehicle.healthy is not None:
        keys |= saved_beside(accepted(restore(vehicle), parameters), out)
    write_whole(out, with_keys(text, keys, out), f"gz-onboard discover --write-model, from {base.name}")
    report.extended_model = str(out)
    return words


def extension(found: Discovery) -> tuple[dict[str, Found], list[Effect]]:
    """The parameters of the causes that `found` named, and the effects that the model lacks for them."""
    mixed = found.mixed
    names = ", ".join(line.ride.name for line in found.lines)
    rides = f"{len(found.lines)} rides ({names})" if len(names) < LONGEST else f"{len(found.lines)} rides"
    parameters, added = {}, []
    for cause in (c for c in found.report.causes if not c.varies):
        candidate = next(c for c in mixed.causes if c.name == cause.name)
        source = f"discovered on {rides} as {cause.name}, score {cause.evidence:.0f}"
        for parameter in candidate.parameters:
            estimate = cause.parameters[parameter.name]
            low, high = estimate.ci95
            inside = min(max(estimate.value, parameter.low), parameter.high)
            parameters[parameter.name] = Found(inside, (high - low) / 2 / mixed.quantile, parameter.unit, source)
        if candidate.effect and candidate in mixed.lacking:
            added.append(candidate.effect)
    return parameters, added


def lowered(found: Discovery, vehicle: Vehicle, curve: bool) -> tuple[float, str] | None:
    """The forecast's factor without what the causes and the curve explain, and its source; None if they take nothing.

    factor = measured / modelled; the model now gives a share s of the measured energy more, so it becomes
    factor / (1 + s·factor).
    """
    report, rides = found.report, len(found.lines)
    share = sum(energy_share(found.lines, change, MODELLED) for change in changes(found))
    if curve and report.unknown is not None and report.unknown.channel in MODELLED:
        share += report.unknown.share
    factor = vehicle.riding.factor
    if abs(share) < NEGLIGIBLE or not FACTORS[0] < (value := factor / (1 + share * factor)) < FACTORS[1]:
        return None
    what = ", ".join(
        [*(cause.name for cause in report.causes if not cause.varies), *(["a curve without a name"] if curve else [])]
    )
    text = f"{what}, found on {rides} rides, are {share:.1%} of the energy there and left the factor: "
    return value, f"{text}{factor:g} / (1 + {share:.4f} · {factor:g})"


def changes(found: Discovery) -> list[Array]:
    """What each cause changes in the parameters of the discovery's linear model, in scales, (p,) each."""
    result = []
    for cause in (c for c in found.report.causes if not c.varies):
        change = np.zeros(len(found.mixed.names))
        for name, estimate in cause.parameters.items():
            place = found.mixed.names.index(name)
            healthy = cause.value - cause.change if name == cause.parameter else 0.0
            change[place] = (estimate.value - healthy) / float(found.mixed.scale[place])
        result.append(change)
    return result


def curve_text(found: Discovery) -> tuple[str, str] | None:
    """(name, text) of the effect file of what has no name. None if no effect can read its quantity at its place.

    A curve of straight pieces is a constant, a slope and one |x − knot| for each bend; in heading it goes round.
    """
    unknown, battery = found.report.unknown, found.mixed.system.battery
    assert unknown is not None
    reads = READS.get(unknown.quantity, unknown.quantity)
    if unknown.channel not in PORTS or reads not in QUANTITIES:
        return None
    port, unit, sign = PORTS[unknown.channel]
    cells = battery.cells_parallel if battery else 1
    stretch = 1 / cells if reads == "cell_current" else 1.0
    if unknown.quantity == CONSTANT:
        unknown = replace(unknown, curve=(*unknown.curve, (1.0, *unknown.curve[0][1:])))
    rows = [(float(at) * stretch, float(value) * sign) for at, value, _ in unknown.curve]
    if reads == "heading":
        rows.append((2 * np.pi, rows[0][1]))
    knots, values = np.array(rows).T
    slopes = np.diff(values) / np.diff(knots)
    bends = np.diff(slopes) / 2
    middle = (slopes[0] + slopes[-1]) / 2
    constant = values[0] - middle * knots[0] - float(np.sum(bends * np.abs(knots[0] - knots[1:-1])))
    name = f"empirical_{unknown.channel}_{CONSTANT if unknown.quantity == CONSTANT else reads}"
    pieces = "".join(f"\n        + {b:.6g} * abs(x - {k:.6g})" for b, k in zip(bends, knots[1:-1], strict=True))
    over = "a constant" if unknown.quantity == CONSTANT else f"a curve over {reads}"
    low, high = float(knots[0]), float(knots[-1])
    # a road load and a loss at the motor fade at standstill, where there is no motion to hold back
    fade = " * (speed * speed / (speed * speed + 1.0))" if port == "WHEEL_FORCE" else ""
    arguments = f"{reads}, speed" if fade and reads != "speed" else reads
    return name, (
        f'"""What {len(found.lines)} rides left in {unknown.channel}, {over}: without a cause.\n\n'
        f"Straight pieces between {low:g} and {high:g}, constant beyond, as discovered; {unknown.share:.1%} of the "
        f'energy.\n"""\n\n'
        "from gz_onboard.model.effect import Parameter, Port\n\n"
        f"PORT = Port.{port}\n"
        f'PARAMETERS = (Parameter("{name}_scale", "1", 1.0, {scale_sd(unknown):.2g}, -5.0, 5.0, "the curve as '
        'discovered"),)\n\n\n'
        f"def term({arguments}, *, {name}_scale):\n"
        f'    """[{unit}]."""\n'
        f"    x = ({low:.6g} + {high:.6g} + abs({reads} - {low:.6g}) - abs({reads} - {high:.6g})) / 2\n"
        f"    curve = (\n        {constant:.6g} + {middle:.6g} * x{pieces}\n    )\n"
        f"    return {name}_scale * curve{fade}\n"
    )


def scale_sd(unknown: Unknown) -> float:
    """The standard deviation of a factor on the whole curve, its knots taken for independent."""
    values, sd = (np.array([row[i] for row in unknown.curve], dtype=float) for i in (1, 2))
    weight = float(np.sum((values / np.maximum(sd, 1e-12)) ** 2))
    return float(np.clip(weight**-0.5 if weight > 0 else 1.0, 0.01, 1.0))
