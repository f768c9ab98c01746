"""The vehicle files that discovery writes: the baseline with what healthy rides taught, and the extended model."""

from __future__ import annotations

import tomllib
import zlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from scipy.stats import t as student

from gz_onboard.arrays import Array
from gz_onboard.errors import InputError
from gz_onboard.lab.calibrate.result import Found, Result
from gz_onboard.lab.calibrate.vehicle_file import copied_effects, merged, number, string, with_keys
from gz_onboard.lab.discover.detectability import amount
from gz_onboard.lab.discover.energy import energy, pack_power, share_of_time
from gz_onboard.lab.discover.mixed_model import HealthyCurve, MixedModel
from gz_onboard.lab.discover.result import Report
from gz_onboard.physics.effect import QUANTITIES, Effect
from gz_onboard.vehicle import Vehicle

PORTS = {
    "road_force": ("WHEEL_FORCE", "N", 1.0),
    "inverter_power": ("INVERTER_LOSS", "W", 1.0),
    "auxiliary": ("DC_POWER", "W", 1.0),
    "cell_voltage": ("CELL_VOLTAGE", "V", -1.0),
}
READS = {"time": "time_moving", "pack_current": "cell_current"}
MODELLED = ("road_force", "inverter_power", "auxiliary")
"""The channels whose residual is energy that the model lacks; elsewhere it is a sensor's."""


def write_baseline(vehicle: Vehicle, base: Path, out: Path) -> None:
    """Write `vehicle`, as `discovery.baseline` gave it, to `out` after the file `base`, its statistics beside it."""
    mixed = vehicle.healthy
    assert isinstance(mixed, MixedModel)
    found = {
        name: Found(value.value, value.sd, value.unit, value.source)
        for name, value in vehicle.parameters.known.items()
        if "refitted on" in value.source
    }
    text = merged(base.read_text(encoding="utf-8"), [Result("baseline", parameters=found)], base, out)
    beside = out.with_suffix(".healthy.npz")
    save(mixed, beside)
    keys = copied_effects(vehicle.model.effects, out) | {
        ("healthy", "file"): string(beside.name),
        ("healthy", "rides"): str(mixed.healthy),
    }
    _write(out, with_keys(text, keys, out))


def _write(out: Path, text: str) -> None:
    """Write the file whole or not at all."""
    temporary = out.with_name(out.name + ".new")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(out)


def save(mixed: MixedModel, file: Path) -> None:
    """Write what healthy rides taught to an npz file."""
    shapes = {
        f"shape_{i}_{key}": getattr(shape, key)
        for i, shape in enumerate(mixed.shapes.values())
        for key in ("mean", "covariance", "inflation")
    }
    with file.open("wb") as stream:
        np.savez_compressed(
            stream,
            names=np.array(mixed.names),
            scale=mixed.scale,
            mean=mixed.mean,
            prior=mixed.prior,
            scatter=mixed.scatter,
            healthy=mixed.healthy,
            value_names=np.array(list(mixed.values)),
            values=np.array(list(mixed.values.values())),
            noise_names=np.array(list(mixed.noise)),
            noise=np.array(list(mixed.noise.values())),
            inflation_names=np.array(list(mixed.inflation)),
            inflation=np.array(list(mixed.inflation.values())),
            shape_names=np.array(list(mixed.shapes)),
            **shapes,
        )


def load(mixed: MixedModel, file: Path) -> MixedModel:
    """`mixed` of a vehicle with what the npz `file` holds; InputError for one of another model."""
    try:
        with np.load(file) as data:
            names = [str(name) for name in data["names"]]
            mine = [n for n in names if n in mixed.names]
            if sorted(mine) != sorted(names):
                raise InputError(f"{file}: was learned for another model list; run discover --baseline again")
            # candidates that came after it, such as a user's own, keep what is known before any ride
            at, take = mixed.index(names), list(range(len(names)))
            mean, prior, scatter, scale = (
                mixed.mean.copy(),
                mixed.prior.copy(),
                mixed.scatter.copy(),
                mixed.scale.copy(),
            )
            mean[at], scatter[at], scale[at] = data["mean"], data["scatter"], data["scale"]
            prior[at, :] = 0.0
            prior[:, at] = 0.0
            prior[np.ix_(at, at)] = data["prior"][np.ix_(take, take)]
            pairs = [str(name) for name in data["shape_names"]]
            return replace(
                mixed,
                mean=mean,
                prior=prior,
                scatter=scatter,
                scale=scale,
                healthy=int(data["healthy"]),
                values=mixed.values | _mapping(data["value_names"], data["values"]),
                noise=mixed.noise
                | {
                    str(n): (float(a), float(b), float(c))
                    for n, (a, b, c) in zip(data["noise_names"], data["noise"], strict=True)
                },
                inflation=_mapping(data["inflation_names"], data["inflation"]),
                shapes={
                    pair: HealthyCurve(
                        data[f"shape_{i}_mean"], data[f"shape_{i}_covariance"], float(data[f"shape_{i}_inflation"])
                    )
                    for i, pair in enumerate(pairs)
                },
            )
    except (OSError, ValueError, KeyError, EOFError, BadZipFile, zlib.error) as error:
        raise InputError(f"{file}: cannot be read as what healthy rides taught: {error}") from error


def _mapping(names: Any, values: Any) -> dict[str, float]:
    return {str(name): float(value) for name, value in zip(names, values, strict=True)}


def write_model(report: Report, vehicle: Vehicle, base: Path, out: Path) -> list[str]:
    """Write the vehicle extended by what `report` named, or by a curve for what has no name; what was done, in words.

    The file is that of `base` with the added effects and parameters, their standard deviation from the interval; not
    with the statistics of healthy rides, which were of the vehicle before. Effects that are not the package's are
    copied into a folder beside it. `report.extended_model` stays None if nothing could be added.

    What the vehicle file alone lacks is part of its ``[forecast] factor``, measured over modelled energy, and leaves
    it (`lowered`); what came on top of healthy rides is not.
    """
    mixed = report.mixed
    assert mixed is not None
    found, added = extension(report, vehicle)
    words = [f"{name} = {f.value:.4g} ± {amount(f.sd, f.unit, '.2g')}" for name, f in found.items()]
    folder = out.with_name(f"{out.stem}_effects")
    names = [effect.name for effect in (*vehicle.model.effects, *added)]
    curve = None
    if report.unknown is not None:
        curve = curve_text(report)
        if curve is None:
            words.append(
                f"nothing for the curve: no effect can read {report.unknown['quantity']} at {report.unknown['channel']}"
            )
        else:
            words.append(f"an empirical effect, {folder.name}/{curve[0]}.py")
            names.append(curve[0])
    if not found and not added and curve is None:
        return words
    keys = copied_effects((*vehicle.model.effects, *added), out)
    keys["model", "effects"] = "[" + ", ".join(map(string, names)) + "]"
    if curve:
        folder.mkdir(exist_ok=True)
        (folder / f"{curve[0]}.py").write_text(curve[1], encoding="utf-8")
        keys["model", "effects_folder"] = string(folder.name)
    if not mixed.healthy and (factor := lowered(report, vehicle, curve is not None)):
        value, reason = factor
        before = tomllib.loads(base.read_text(encoding="utf-8")).get("forecast", {}).get("source")
        source = f"{reason}; before: {before}" if before else reason
        keys |= {("forecast", "factor"): number(value), ("forecast", "source"): string(source)}
        words.append(f"forecast factor {vehicle.riding.factor:g} to {value:.3g}: what was found leaves it")
    text = merged(base.read_text(encoding="utf-8"), [Result("discover", parameters=found)], base, out)
    _write(out, with_keys(text, keys, out, [("healthy",)]))
    report.extended_model = str(out)
    return words


def extension(report: Report, vehicle: Vehicle) -> tuple[dict[str, Found], list[Effect]]:
    """The parameters of the causes that `report` named, and the effects that the model lacks for them."""
    mixed = report.mixed
    assert mixed is not None
    quantile = float(student.ppf(0.975, max(mixed.healthy + 3, 4)))  # as the intervals of `verdict.causes_of`
    names = ", ".join(line.ride.name for line in report.lines)
    rides = f"{len(report.lines)} rides ({names})" if len(names) < 150 else f"{len(report.lines)} rides"
    has = {effect.name for effect in vehicle.model.effects}
    found, added = {}, []
    for cause in (c for c in report.causes if not c.varies):
        candidate = next(c for c in mixed.causes if c.name == cause.name)
        rows = [(cause.parameter, cause.value, cause.ci95), *cause.others]
        for (name, value, ci), parameter in zip(rows, candidate.parameters, strict=True):
            source = f"discovered on {rides} as {cause.name}, score {cause.evidence:.0f}"
            inside = min(max(value, parameter.low), parameter.high)
            found[name] = Found(inside, (ci[1] - ci[0]) / 2 / quantile, parameter.unit, source)
        if candidate.effect and cause.name not in has:
            added.append(candidate.effect)
    return found, added


def lowered(report: Report, vehicle: Vehicle, curve: bool) -> tuple[float, str] | None:
    """The forecast's factor without what the causes and the curve explain, and its source; None if they take nothing.

    factor = measured / modelled; the model now gives a share s of the measured energy more, so it becomes
    factor / (1 + s·factor).
    """
    share = sum(modelled_share(report, change) for change in changes(report))
    if curve:
        share += curve_share(report)
    factor = vehicle.riding.factor
    if abs(share) < 1e-4 or not 0.3 < (value := factor / (1 + share * factor)) < 3:
        return None
    what = ", ".join(
        [*(cause.name for cause in report.causes if not cause.varies), *(["a curve without a name"] if curve else [])]
    )
    text = f"{what}, found on {len(report.lines)} rides, are {share:.1%} of the energy there and left the factor: "
    return value, f"{text}{factor:g} / (1 + {share:.4f} · {factor:g})"


def changes(report: Report) -> list[Array]:
    """What each cause changes in the parameters of the discovery's linear model, in scales, (p,) each."""
    mixed = report.mixed
    assert mixed is not None
    result = []
    for cause in (c for c in report.causes if not c.varies):
        change = np.zeros(len(mixed.names))
        for name, value in ((cause.parameter, cause.value), *((n, v) for n, v, _ in cause.others)):
            place = mixed.names.index(name)
            healthy = cause.value - cause.change if name == cause.parameter else 0.0
            change[place] = (value - healthy) / float(mixed.scale[place])
        result.append(change)
    return result


def modelled_share(report: Report, change: Array) -> float:
    """The part of the energy drawn that `change` (p,) of the parameters makes in the channels `MODELLED`."""
    more = drawn = 0.0
    for line in report.lines:
        drawn += energy(line)
        for name in MODELLED:
            if name in line.tables:
                power = pack_power(name, line, line.tables[name].a @ change)
                more += float(np.mean(power)) * share_of_time(line, name) if power is not None and len(power) else 0.0
    return more / drawn if drawn > 0 else 0.0


def curve_share(report: Report) -> float:
    """The same of the curve of what has no name."""
    unknown = report.unknown
    if unknown is None or unknown["channel"] not in MODELLED:
        return 0.0
    return float(unknown["share"])


def curve_text(report: Report) -> tuple[str, str] | None:
    """(name, text) of the effect file of what has no name. None if no effect can read its quantity at its place.

    A curve of straight pieces is a constant, a slope and one |x − knot| for each bend; in heading it goes round.
    """
    unknown = report.unknown
    assert unknown is not None
    reads = READS.get(unknown["quantity"], unknown["quantity"])
    if unknown["channel"] not in PORTS or reads not in QUANTITIES:
        return None
    port, unit, sign = PORTS[unknown["channel"]]
    cells = report.mixed.system.battery.cells_parallel if report.mixed and report.mixed.system.battery else 1
    stretch = 1 / cells if reads == "cell_current" else 1.0
    rows = [(float(at) * stretch, float(value) * sign) for at, value, _ in unknown["curve"]]
    if reads == "heading":
        rows.append((2 * np.pi, rows[0][1]))
    knots, values = np.array(rows).T
    slopes = np.diff(values) / np.diff(knots)
    bends = np.diff(slopes) / 2
    middle = (slopes[0] + slopes[-1]) / 2
    constant = values[0] - middle * knots[0] - float(np.sum(bends * np.abs(knots[0] - knots[1:-1])))
    name = f"empirical_{unknown['channel']}_{reads}"
    pieces = "".join(f"\n        + {b:.6g} * abs(x - {k:.6g})" for b, k in zip(bends, knots[1:-1], strict=True))
    low, high = float(knots[0]), float(knots[-1])
    # a road load and a loss at the motor fade at standstill, where there is no motion to hold back
    fade = " * (speed * speed / (speed * speed + 1.0))" if port == "WHEEL_FORCE" else ""
    arguments = f"{reads}, speed" if fade and reads != "speed" else reads
    return name, (
        f'"""What {len(report.lines)} rides left over {reads} in {unknown["channel"]}: a curve without a cause.\n\n'
        f"Straight pieces between {low:g} and {high:g}, constant beyond, as discovered; {unknown['share']:.1%} of the "
        f'energy.\n"""\n\n'
        "from gz_onboard.physics.effect import Parameter, Port\n\n"
        f"PORT = Port.{port}\n"
        f'PARAMETERS = (Parameter("{name}_scale", "1", 1.0, {scale_sd(unknown):.2g}, -5.0, 5.0, "the curve as '
        'discovered"),)\n\n\n'
        f"def term({arguments}, *, {name}_scale):\n"
        f'    """[{unit}]."""\n'
        f"    x = ({low:.6g} + {high:.6g} + abs({reads} - {low:.6g}) - abs({reads} - {high:.6g})) / 2\n"
        f"    curve = (\n        {constant:.6g} + {middle:.6g} * x{pieces}\n    )\n"
        f"    return {name}_scale * curve{fade}\n"
    )


def scale_sd(unknown: Mapping[str, Any]) -> float:
    """The standard deviation of a factor on the whole curve, its knots taken for independent."""
    values, sd = (np.array([row[i] for row in unknown["curve"]], dtype=float) for i in (1, 2))
    weight = float(np.sum((values / np.maximum(sd, 1e-12)) ** 2))
    return float(np.clip(weight**-0.5 if weight > 0 else 1.0, 0.01, 1.0))
