"""The vehicle file extended by the causes that a discovery named."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np

from gz_onboard.calibration.result import Found, Result
from gz_onboard.calibration.vehicle_file import copied_effects, write_vehicle
from gz_onboard.discovery.baseline import accepted_into, restore, saved_beside
from gz_onboard.discovery.curves import CONSTANT
from gz_onboard.discovery.judgement import Discovery, FoundCause, Unknown, energy_share, with_unit
from gz_onboard.discovery.mixed_model import MixedModel
from gz_onboard.errors import writing
from gz_onboard.model.effect import QUANTITIES, Effect
from gz_onboard.vehicle import Vehicle

PORTS = {
    "road_force": ("WHEEL_FORCE", "N", 1.0),
    "inverter_power": ("INVERTER_LOSS", "W", 1.0),
    "pack_power": ("DC_POWER", "W", 1.0),
    "auxiliary": ("DC_POWER", "W", 1.0),
    "cell_voltage": ("CELL_VOLTAGE", "V", -1.0),
}
"""Where a residual of a channel acts: port, unit, sign."""
READS = {CONSTANT: "speed", "time": "time_moving", "pack_current": "cell_current"}
MODELLED = ("road_force", "inverter_power", "pack_power", "auxiliary")
"""The channels whose residual is energy that the model does not have; elsewhere it is a sensor's."""
CURVE_EFFECT = '''"""Residual of {rides} rides in {channel}, {over}, without a cause.

Straight pieces between {low:g} and {high:g}, constant beyond; {share:.1%} of the energy.
"""

from gz_onboard.model.effect import Parameter, Port

PORT = Port.{port}
PARAMETERS = (Parameter("{name}_scale", "1", 1.0, {sd:.2g}, -5.0, 5.0, "the curve as discovered"),)


def term({arguments}, *, {name}_scale):
    """[{unit}]."""
    x = ({low:.6g} + {high:.6g} + abs({reads} - {low:.6g}) - abs({reads} - {high:.6g})) / 2
    curve = (
        {constant:.6g} + {middle:.6g} * x{pieces}
    )
    return {name}_scale * curve{fade}
'''


def write_model(found: Discovery, vehicle: Vehicle, out: Path) -> list[str]:
    """Write `vehicle` extended by the causes, or by a curve for a difference without a name, to `out`.

    Gives sentences on the changes; no file is written without anything to add. The statistics of healthy rides go
    along. Effects that are not the package's are copied into a folder next to the file. A cause that the vehicle file
    alone does not know is part of its ``[forecast] factor``, measured over modelled energy, and leaves it; a change
    since healthy rides is not. Raises InputError.
    """
    report, base, mixed = found.report, vehicle.file, found.search.mixed
    causes, unknown = [cause for cause in report.causes if not cause.varies], report.unknown
    if not causes and unknown is None:
        return ["not written: there is nothing to extend it with"]
    parameters, added = extension(found, causes)
    words = [f"{name} = {f.value:.4g} ± {with_unit(f.sd, f.unit, '.2g')}" for name, f in parameters.items()]
    folder, effects = out.with_name(f"{out.stem}_effects"), (*vehicle.model.effects, *added)
    names, curve = [effect.name for effect in effects], None
    if unknown is not None:
        curve = curve_effect(unknown, mixed, len(found.search.lines))
        if curve is None:
            words.append(f"nothing for the curve: no effect can read {unknown.quantity} at {unknown.channel}")
        else:
            words.append(f"an empirical effect, {folder.name}/{curve[0]}.py")
            names.append(curve[0])
    if not parameters and curve is None:
        return ["not written", *words]
    with writing(f"--write-model {out}"):
        keys = copied_effects(effects, out)
        keys["model", "effects"] = names
        if curve:
            folder.mkdir(exist_ok=True)
            (folder / f"{curve[0]}.py").write_text(curve[1], encoding="utf-8")
            keys["model", "effects_folder"] = folder.name
        if not mixed.healthy and (lower := lowered_factor(found, causes, vehicle, curve is not None)):
            value, reason = lower
            before = tomllib.loads(base.read_text(encoding="utf-8")).get("forecast", {}).get("source")
            source = f"{reason}; before: {before}" if before else reason
            keys |= {("forecast", "factor"): float(f"{value:.6g}"), ("forecast", "source"): source}
            words.append(f"forecast factor {vehicle.riding.factor:g} to {value:.3g}: it included these causes")
        if vehicle.healthy is not None:
            keys |= saved_beside(accepted_into(restore(vehicle), parameters), out)
        maker = f"gz-onboard discover --write-model, from {base.name}"
        write_vehicle(base, [Result("discover", parameters=parameters)], out, maker, keys)
    if report.ambiguous:
        words.append("of causes that cannot be told apart it has the likeliest, which other rides may refute")
    return [str(out), *words]


def extension(found: Discovery, causes: list[FoundCause]) -> tuple[dict[str, Found], list[Effect]]:
    """The parameters of `causes`, and the effects that the model does not have for them."""
    mixed, lines = found.search.mixed, found.search.lines
    names = ", ".join(line.ride.name for line in lines)
    rides = f"{len(lines)} rides ({names})" if len(names) < 150 else f"{len(lines)} rides"
    parameters, added = {}, []
    for cause in causes:
        candidate = next(c for c in mixed.causes if c.name == cause.name)
        source = f"discovered on {rides} as {cause.name}, score {cause.evidence:.0f}"
        for name, estimate in cause.parameters.items():
            low, high = estimate.ci95
            parameters[name] = Found(estimate.value, (high - low) / 2 / mixed.quantile, estimate.unit, source)
        if candidate.effect and candidate in mixed.lacking:
            added.append(candidate.effect)
    return parameters, added


def lowered_factor(
    found: Discovery, causes: list[FoundCause], vehicle: Vehicle, curve: bool
) -> tuple[float, str] | None:
    """The forecast's factor without the energy of causes and curve, and its source; None if it stays.

    factor = measured / modelled; the model now gives a share s of the measured energy more, so it becomes
    factor / (1 + s·factor).
    """
    mixed, lines, unknown = found.search.mixed, found.search.lines, found.report.unknown
    change = np.zeros(len(mixed.names))
    for cause in causes:
        for name, estimate in cause.parameters.items():
            (place,) = mixed.index([name])
            healthy = cause.value - cause.change if name == cause.parameter else 0.0
            change[place] = (estimate.value - healthy) / float(mixed.scale[place])
    share = energy_share(lines, change, MODELLED)
    if curve and unknown is not None and unknown.channel in MODELLED:
        share += unknown.share
    factor = vehicle.riding.factor
    if abs(share) < 1e-4 or not 0.3 < (value := factor / (1 + share * factor)) < 3.0:  # no believable factor
        return None
    what = ", ".join([*(cause.name for cause in causes), *(["a curve without a name"] if curve else [])])
    text = f"{what}, found on {len(lines)} rides, are {share:.1%} of the energy there and left the factor: "
    return value, f"{text}{factor:g} / (1 + {share:.4f} · {factor:g})"


def curve_effect(unknown: Unknown, mixed: MixedModel, rides: int) -> tuple[str, str] | None:
    """(name, text) of the effect file of a curve. None if no effect can read its quantity at its place.

    A curve of straight pieces is a constant, a slope and one |x − knot| for each bend; over heading it is periodic.
    """
    reads, battery = READS.get(unknown.quantity, unknown.quantity), mixed.system.battery
    if unknown.channel not in PORTS or reads not in QUANTITIES:
        return None
    port, unit, sign = PORTS[unknown.channel]
    is_constant = unknown.quantity == CONSTANT
    stretch = 1 / battery.cells_parallel if reads == "cell_current" and battery else 1.0
    rows = [(at * stretch, value * sign) for at, value, _ in unknown.curve]
    if is_constant:
        rows.append((1.0, rows[0][1]))
    elif reads == "heading":
        rows.append((2 * np.pi, rows[0][1]))
    knots, values = np.array(rows).T
    slopes = np.diff(values) / np.diff(knots)
    bends, middle = np.diff(slopes) / 2, (slopes[0] + slopes[-1]) / 2
    name = f"empirical_{unknown.channel}_{CONSTANT if is_constant else reads}"
    # a road load and a loss at the motor fade at standstill, where there is no motion to hold back
    fade = " * (speed * speed / (speed * speed + 1.0))" if port == "WHEEL_FORCE" else ""
    # the uncertainty of a factor on the whole curve, its knots taken to be independent
    weight = sum((value / max(sd, 1e-12)) ** 2 for _, value, sd in unknown.curve)
    text = CURVE_EFFECT.format(
        rides=rides,
        channel=unknown.channel,
        over="a constant" if is_constant else f"a curve over {reads}",
        share=unknown.share,
        port=port,
        unit=unit,
        name=name,
        sd=float(np.clip(weight**-0.5 if weight > 0 else 1.0, 0.01, 1.0)),
        arguments=f"{reads}, speed" if fade and reads != "speed" else reads,
        reads=reads,
        low=float(knots[0]),
        high=float(knots[-1]),
        constant=values[0] - middle * knots[0] - float(np.sum(bends * np.abs(knots[0] - knots[1:-1]))),
        middle=middle,
        pieces="".join(f"\n        + {b:.6g} * abs(x - {k:.6g})" for b, k in zip(bends, knots[1:-1], strict=True)),
        fade=fade,
    )
    return name, text
