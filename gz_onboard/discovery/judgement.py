"""From the causes of a search to a report: certainty, replacements, differences without a name."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.constants import WH_PER_KM
from gz_onboard.discovery.channels import CHANNEL, CHANNELS, ROLLING, Channel
from gz_onboard.discovery.curves import (
    CONSTANT,
    KNOTS,
    CurveFit,
    CurveForm,
    columns_of,
    curve_form,
    curve_forms,
    fit_curve,
)
from gz_onboard.discovery.grid import STEP
from gz_onboard.discovery.mixed_model import LinearRide, MixedModel, Posterior
from gz_onboard.discovery.parameters import EACH_RIDES_OWN, LOG_SCALED, NUISANCE, Candidate, stepped
from gz_onboard.discovery.search import (
    IMPOSSIBLE,
    Search,
    Split,
    carries_over,
    held_out,
    improves,
    splits,
    with_observed_scatter,
    within_bounds,
)
from gz_onboard.errors import brief
from gz_onboard.reports.results import OPTIONAL

VERSION = 4  # of the keys
VERDICTS = {
    "cause": "Fault identified",
    "none": "No fault found that these rides could show",
    "ambiguous": "Fault found, but these rides cannot tell which of several causes it is",
    "unknown": "Fault found that no candidate explains",
    "inconclusive": "The model misses rides held out by more than healthy rides, and no cause explains it",
}
METRICS = {
    "power": ("power, rms", 1.0, "W"),
    "consumption": ("consumption", 1 / WH_PER_KM, "Wh/km"),
    "range": ("range", 100.0, "%"),
    "voltage": ("voltage of a cell", 1e3, "mV"),
}
"""Of the gain: label, factor and unit."""
POWER_CHANNELS = ("road_force", "inverter_power", "pack_power", "auxiliary", "pack_balance")
"""Channels whose residual is a power at the terminals of the pack."""
LUMPED = dict.fromkeys(("motor_temperature", "inverter_temperature", "cell_temperature"), 3) | dict.fromkeys(
    ("cell_voltage", "voltage_timing"), 1
)
"""Channels whose model is a network of lumps or a circuit: how much more than others they err, in shares."""
Interval = tuple[float, float]


@dataclass(frozen=True)
class JudgementConfig:
    """What counts as sure, as alike, as much."""

    discrepancy: float = 0.05  # sd of a change, as a share: no effect has exactly its real form
    least_alternative: float = 0.4  # of the threshold, that a replacement must explain by itself
    margin: float = 6.0  # of chi-squared: a likelihood ratio of 20
    look_alike: float = 0.8  # cosine of two candidates
    bend: float = 0.1  # of the evidence for the causes: a further curve with less corrects the form of a large effect
    curve: float = 1.5  # evidence for a curve over that for a cause: its knots were chosen by eye
    own_share: float = 0.3  # of the evidence for a cause: a channel with more names it
    far_beyond: float = 10.0  # times the threshold: the score of an impossible candidate that is no chance
    most_refitted: float = 0.25  # of the energy: healthy rides refit a tenth against the file alone
    least_refitted: float = 0.02  # of the energy, for one parameter to be named
    bootstrap: int = 400  # draws over rides
    missed: float = 0.05  # of the range or the energy
    healthy_most: float = 0.08  # of it: of 40 healthy sets none misses more than 5.4 %, against its file 7.1 %
    outstanding: float = 3.5  # standard deviations of a ride from healthy ones


JUDGE = JudgementConfig()


# --- the report -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ParameterEstimate:
    """A parameter's value once accepted, with its 95 % interval."""

    value: float
    ci95: Interval
    unit: str = "1"


@dataclass(frozen=True)
class FoundCause:
    """A cause that was named, with the value of its first parameter and its change over the healthy one.

    evidence: chi-squared of one degree of freedom. varies: from ride to ride, by itself or as rides held out show; no
    model is extended with it. parameters: all of them.
    """

    name: str
    parameter: str
    value: float
    unit: str
    ci95: Interval
    change: float
    energy_share: float
    evidence: float
    varies: bool = False
    parameters: dict[str, ParameterEstimate] = field(default_factory=dict)


@dataclass(frozen=True)
class Unknown:
    """A difference without a name: a curve that a `channel` leaves over a `quantity`, or a `CONSTANT`.

    straight: in proportion. curve: rows (at [unit], value [the channel's unit], sd). denies: causes that it refutes.
    share: of the energy.
    """

    channel: str
    quantity: str
    straight: bool
    unit: str
    score: float
    chi2: float
    curve: tuple[tuple[float, float, float], ...]
    denies: tuple[str, ...] = ()
    share: float = 0.0

    def __str__(self) -> str:
        if self.quantity != CONSTANT:
            return f"{readable(self.channel)} over {readable(self.quantity)}"
        ((_, value, sd),) = self.curve
        return f"a constant {readable(self.channel)}, {value:+.4g} ± {sd:.2g} {CHANNEL[self.channel].unit} everywhere"


@dataclass(frozen=True)
class Implausible:
    """An explanation of the rides that is hard to believe: the `value` that a parameter would need, and why."""

    parameter: str
    value: float
    unit: str
    energy_share: float
    why: str

    def __str__(self) -> str:
        value = with_unit(self.value, self.unit)
        return f"{self.parameter} = {value} ({self.energy_share:+.1%} of the energy): {self.why}"


@dataclass(frozen=True)
class Score:
    """Score of a candidate in addition to the causes named."""

    name: str
    score: float


@dataclass(frozen=True)
class ResidualSize:
    """Size of a channel's residual, in its unit. autocorrelation: of neighbouring blocks."""

    mean: float
    rms: float
    autocorrelation: float
    blocks: int
    energy_share: float


@dataclass(frozen=True)
class Errors:
    """Errors on rides held out: before, with the present parameters refitted, after.

    ci95: of control minus after; None for one ride.
    """

    before: float
    control: float
    after: float
    ci95: Interval | None


@dataclass(frozen=True)
class Gain:
    """Errors on rides held out of the fit. apart: these rides had no part in the choice either.

    voltage: of a cell [V]; power: rms [W]; consumption: [J/m]; range: [1].
    """

    holdout: tuple[str, ...] = ()
    note: Annotated[str | None, OPTIONAL] = None
    apart: Annotated[bool | None, OPTIONAL] = None
    voltage: Annotated[Errors | None, OPTIONAL] = None
    power: Annotated[Errors | None, OPTIONAL] = None
    consumption: Annotated[Errors | None, OPTIONAL] = None
    range: Annotated[Errors | None, OPTIONAL] = None

    @property
    def errors(self) -> dict[str, Errors]:
        """The metrics that were measured, in the order of `METRICS`."""
        return {name: found for name in METRICS if (found := getattr(self, name)) is not None}


@dataclass(frozen=True)
class Isolability:
    """Which causes could be told apart. signatures: channels that depend on each candidate (Krysander & Frisk 2008).

    look_alikes: pairs that these rides can hardly separate, and the cosine of their effects on the residuals.
    """

    signatures: dict[str, list[str]]
    look_alikes: list[tuple[str, str, float]]


@dataclass(frozen=True)
class Limit:
    """The smallest change of a cause's first parameter that these rides would show half the time, were it alone.

    energy_share: as a magnitude. Both None if it is not identifiable. needs: roles that show it, any set of them.
    """

    parameter: str
    unit: str
    change: float | None
    energy_share: float | None
    needs: tuple[str, ...] = ()


@dataclass(frozen=True)
class Report:
    """The result of a discovery."""

    version: int = field(default=VERSION, init=False)
    verdict: Annotated[str, "cause, none, ambiguous, unknown or inconclusive"]
    causes: Annotated[
        list[FoundCause],
        "name, parameter, value, unit, ci95, change (over the healthy value), energy_share, evidence (chi-squared of "
        "one degree of freedom), varies (from ride to ride: no model is extended with it), parameters (all of them: "
        "value, ci95, unit)",
    ]
    ambiguous: Annotated[list[list[str]], "sets of names that these rides cannot tell apart, the likeliest first"]
    unknown: Annotated[
        Unknown | None,
        "a difference without a name: channel, quantity, unit, straight (in proportion), share of the energy, curve "
        "[[at, value, sd], ...], denies (causes that it refutes); or null",
    ]
    ranking: Annotated[list[Score], "name, score of every candidate in addition to the causes named"]
    residuals: Annotated[dict[str, ResidualSize], "per channel: mean, rms, autocorrelation, blocks, energy_share"]
    gain: Annotated[
        Gain,
        "on rides held out: holdout, and per metric before, control (present parameters refitted), after, ci95 (of "
        "control minus after, over rides); apart: whether these rides had no part in the choice either",
    ]
    advice: Annotated[list[str], "what to ride next"] = field(default_factory=list)
    notes: Annotated[list[str], "unusable rides, causes left out, outliers, missing sensors"] = field(
        default_factory=list
    )
    isolability: Annotated[
        Isolability,
        "signatures: channels of each candidate; look_alikes: pairs and the cosine of their effects on the residuals",
    ] = field(default_factory=lambda: Isolability({}, []))
    threshold: Annotated[float, "score that one in twenty such searches of healthy rides exceeds"] = math.nan
    constancy: Annotated[
        list[Split],
        "whether a cause acts alike everywhere: cause, quantity, ratio (half the difference of the halves of the "
        "quantity over the mean), chi2",
    ] = field(default_factory=list)
    implausible: Annotated[
        list[Implausible],
        "parameters that explain the rides away: parameter, value, unit, energy_share, why (a candidate beyond its "
        "bounds, or a refit without a cause that takes much of the energy)",
    ] = field(default_factory=list)
    limits: Annotated[
        dict[str, Limit],
        "per candidate: parameter, change, unit, energy_share: the least that would be found half the time; needs: the "
        "roles that show it, any set of them",
    ] = field(default_factory=dict)

    __repr__ = brief


@dataclass(frozen=True)
class Discovery:
    """A report, and the search that it was reached on."""

    report: Report
    search: Search

    __repr__ = brief


def with_unit(value: float, unit: str, form: str = ".4g") -> str:
    """A value with its unit; that of a pure number is left out."""
    return f"{value:{form}}" if unit == "1" else f"{value:{form}} {unit}"


def readable(name: str) -> str:
    """A name of the code in words."""
    return name.replace("_", " ").replace("gps", "GPS")


# --- energy ---------------------------------------------------------------------------------------------------------


def power_per_residual(line: LinearRide, name: str) -> Array | None:
    """The factor (m,) from a channel's residual to power at the pack's terminals [W]; None if it is no power."""
    table = line.tables[name]
    if name == "road_force":
        return np.asarray(table.unit * table.over(line.ride.quantities["speed"]))
    if name == "pack_balance":
        volts = line.ride.signals.get("pack_voltage")
        return None if volts is None else np.asarray(table.unit * table.over(volts))
    return table.unit if name in POWER_CHANNELS else None


def channel_energy(line: LinearRide, name: str, values: Array) -> Array:
    """Residuals (m,) or (m, k) of a channel as energy at the pack's terminals over the ride [J]; 0 if no power."""
    factor = power_per_residual(line, name)
    if factor is None or not len(factor):
        return np.zeros(values.shape[1:])
    time = len(line.ride.time) * STEP
    if name == "road_force":  # the residual holds where the wheel rolls
        time *= float(np.mean(np.abs(line.ride.quantities["speed"]) > ROLLING))
    return np.asarray(factor @ values / len(factor) * time)


def energy_per_change(line: LinearRide, channels: Sequence[str] = POWER_CHANNELS) -> Array:
    """Energy at the pack's terminals [J] for a change of each parameter by its scale, (p,)."""
    found = (channel_energy(line, name, line.tables[name].a) for name in channels if name in line.tables)
    return np.asarray(sum(found, np.zeros(line.statistics.score.shape)))


def energy_share(lines: Sequence[LinearRide], change: Array, channels: Sequence[str] = POWER_CHANNELS) -> float:
    """The share of the energy drawn that `change` (p,) of the parameters makes over these rides."""
    drawn = sum(line.ride.energy for line in lines)
    return float(sum(energy_per_change(line, channels) @ change for line in lines)) / drawn if drawn else 0.0


def residual_sizes(lines: Sequence[LinearRide]) -> dict[str, ResidualSize]:
    """The size of each channel's residual."""
    result, drawn = {}, sum(line.ride.energy for line in lines)
    for name in sorted({name for line in lines for name in line.tables}):
        rows = [(line, line.tables[name].y) for line in lines if name in line.tables]
        y = np.concatenate([y for _, y in rows])
        late, early = (np.concatenate([y[part] for _, y in rows]) for part in (slice(1, None), slice(None, -1)))
        correlation = float(np.corrcoef(late, early)[0, 1]) if np.std(late) > 0 and np.std(early) > 0 else 0.0
        share = float(sum(channel_energy(line, name, y) for line, y in rows)) / drawn if drawn else 0.0
        result[name] = ResidualSize(float(y.mean()), float(np.sqrt(np.mean(y**2))), correlation, len(y), share)
    return result


def errors(line: LinearRide, theta: Array) -> dict[str, float]:
    """The metrics of `Gain` of one ride with parameters `theta` (p,), no range without a positive modelled energy."""
    more, square = 0.0, 0.0
    found: dict[str, float] = {}
    for name, table in line.tables.items():
        rest = table.y - table.a @ theta
        factor = power_per_residual(line, name)
        if factor is not None and len(factor):
            more += float(channel_energy(line, name, rest))
            square += float(np.mean((factor * rest) ** 2))
        if name == "cell_voltage":
            found["voltage"] = float(np.sqrt(np.mean(rest**2)))
    found["power"] = float(np.sqrt(square))
    found["consumption"] = abs(more) / max(line.ride.distance, 1.0)
    model = line.ride.energy - more
    if line.ride.have >= {"pack_voltage", "pack_current"} and model > 0:
        found["range"] = abs(more) / model
    return found


# --- differences without a name -------------------------------------------------------------------------------------


def unexplained(now: Search, constancy: Sequence[Split]) -> Unknown | None:
    """The curve that explains most next to the causes chosen, or in place of one of them; None without one.

    A cause that `constancy` finds unequal is refuted as well. Other causes must then be significant without the refuted
    ones.
    """
    best = best_curve(now)
    uneven = [split for split in constancy if split.unequal and not split.of_ride]
    if uneven and (best is None or not best.denies):
        worst = max(uneven, key=lambda split: split.chi2)
        forms = [f for f in curve_forms(now.mixed.system.sizes) if f.quantity == worst.quantity and not f.straight]
        curves = [curve for form in forms if (curve := curve_with(now, form, [])) is not None]
        if curves:
            best = described(now, max(curves, key=lambda curve: curve.score), [worst.cause])
    if best is None or not best.denies:
        return best
    denied = dict.fromkeys([*best.denies, *(split.cause for split in uneven)])
    rest = [name for name in now.chosen if name not in denied]
    threshold = max(now.limit, JUDGE.bend * best.chi2)
    denied |= dict.fromkeys(name for name in rest if now.contribution(rest, name) < threshold)
    return replace(best, denies=tuple(denied))


def best_curve(now: Search) -> Unknown | None:
    """The curve that explains most next to the causes chosen; one that refutes causes goes first.

    With more than twice the error of an effect's form, a curve is no correction of it, and refutes the causes that have
    their evidence in its channel.
    """
    total, best, most = now.evidence.gain(now.index(now.chosen)), None, (False, 0.0)
    for form in curve_forms(now.mixed.system.sizes):
        curve = curve_with(now, form, now.chosen)
        if curve is None or not is_significant(now, curve):
            continue
        refuted = [name for name in now.chosen if now.shares[name].get(form.channel, 0.0) > JUDGE.own_share]
        if refuted and relative_size(now, curve) < 2 * form_error({form.channel: 1.0}):
            refuted = []
        rank = bool(refuted), curve.score
        if rank <= most or (not refuted and curve.chi2 < JUDGE.bend * total):
            continue
        if is_accepted(now, form, [name for name in now.chosen if name not in refuted]):
            best, most = described(now, curve, refuted), rank
    return best


def relative_size(now: Search, curve: CurveFit) -> float:
    """The rms of a curve over that of the effect of the causes chosen in its channel."""
    change, squares = now.change, np.zeros(2)
    for line in now.lines:
        knots = columns_of(line, curve.form)
        if knots is not None:
            table = line.tables[curve.form.channel]
            squares += np.sum((knots @ curve.values / table.unit) ** 2), np.sum((table.a @ change) ** 2)
    return float(np.sqrt(squares[0] / max(squares[1], 1e-12)))


def curve_with(now: Search, form: CurveForm, chosen: Sequence[str]) -> CurveFit | None:
    """The curve of `form` fitted with the causes `chosen`; None if the rides do not show it."""
    return fit_curve(now.mixed, now.lines, form, now.index(chosen))


def is_significant(now: Search, curve: CurveFit) -> bool:
    """Whether a curve has the score that it must have; a straight line counts as a try instead."""
    return curve.score >= now.limit * (1.0 if curve.form.straight else JUDGE.curve)


def is_accepted(now: Search, form: CurveForm, rest: Sequence[str]) -> bool:
    """Whether a curve with the causes `rest` is more than these rides differ, and improves rides held out."""
    wide = with_observed_scatter(now.mixed, now.lines)
    curve = fit_curve(wide, now.lines, form, now.index(rest), own=True)
    if curve is None or not is_significant(now, curve):
        return False
    causes = [now.causes[name] for name in rest]
    return len(now.lines) < 2 or improves(held_out(now.mixed, now.lines, causes, causes, form), {form.channel: 1.0})


def described(now: Search, curve: CurveFit, denies: Sequence[str]) -> Unknown:
    """The curve for the report."""
    form = curve.form
    sd = np.sqrt(np.abs(np.diag(curve.covariance)))
    rows = tuple(zip(form.knots, curve.values.tolist(), sd.tolist(), strict=True))
    more, drawn = 0.0, sum(line.ride.energy for line in now.lines)
    for line in now.lines:
        knots = columns_of(line, form)
        if knots is not None:
            values = knots @ curve.values / line.tables[form.channel].unit
            more += float(channel_energy(line, form.channel, values))
    share, unit = more / drawn if drawn else 0.0, KNOTS[form.quantity][1]
    shape = (form.channel, form.quantity, form.straight, unit)
    return Unknown(*shape, curve.score, curve.chi2, rows, tuple(denies), share)


def implausible_explanations(now: Search, chosen: Sequence[str], scores: Mapping[str, float]) -> list[Implausible]:
    """What explains rides away next to the causes `chosen`: vehicle, its file or a signal is then wrong.

    A candidate whose evidence asks for a value that it cannot have is not named. And parameters without a cause move in
    each fit, perhaps each within its prior, but together they may take most of the energy. scores: of each candidate.
    """
    mixed = now.mixed
    found = []
    for row in now.rejected:
        if row.why != IMPOSSIBLE or scores[row.name] <= JUDGE.far_beyond * now.limit:
            continue
        (cause,) = (cause for cause in mixed.causes if cause.name == row.name)
        index, first = mixed.index(cause.names), cause.parameters[0]
        change = np.zeros(len(mixed.names))
        change[index] = row.change
        value = mixed.values_at(change)[first.name]
        why = f"{row.name} (score {scores[row.name]:.0f}) is possible from {first.low:g} to {first.high:g} only"
        found.append(Implausible(first.name, value, first.unit, energy_share(now.lines, change), why))
    causes, post = fitted(now, chosen)
    drawn = sum(line.ride.energy for line in now.lines) or 1.0
    shares = np.zeros(len(mixed.names))
    for line, own in zip(now.lines, post.own, strict=True):
        shares += energy_per_change(line) * (post.mean + own - mixed.mean) / drawn
    # of all parameters but those of causes, sensors and the start
    refitted = [i for i, name in enumerate(mixed.names) if i not in causes and name not in EACH_RIDES_OWN]
    if abs(float(np.sum(shares[refitted]))) <= JUDGE.most_refitted:
        return found
    known, before, after = mixed.vehicle.parameters.known, mixed.values_at(mixed.mean), mixed.values_at(post.mean)
    for i in sorted(refitted, key=lambda i: -abs(shares[i]))[:4]:
        name, share = mixed.names[i], float(shares[i])
        if abs(share) < JUDGE.least_refitted:
            continue
        unit = NUISANCE[name].unit if name in NUISANCE else known[name].unit if name in known else ""
        stated = name in NUISANCE or (name in known and not known[name].source.startswith("prior:"))
        why = f"refitted from {before[name]:.4g} without a cause" + (
            "" if stated else "; it is not in the vehicle file"
        )
        found.append(Implausible(name, after[name], unit, share, why))
    return found


def fitted(now: Search, causes: Sequence[str]) -> tuple[list[int], Posterior]:
    """The places of the parameters of `causes`, and all parameters as the rides show them with these free."""
    index = now.mixed.index_of(cause for cause in now.mixed.causes if cause.name in causes)
    return index, now.mixed.freed(index).fit(now.lines)


# --- causes ---------------------------------------------------------------------------------------------------------


def causes_of(search: Search, chosen: Sequence[str]) -> list[FoundCause]:
    """The chosen causes with values and intervals."""
    mixed = search.mixed
    result = []
    for name, (own, variance) in search.fitted(chosen).items():
        change = np.zeros(len(mixed.mean))
        change[search.place[name]] = own
        rows = intervals(search, name, own, np.sqrt(variance * mixed.inflation.get(name, 1.0)))
        first = search.causes[name].parameters[0].name
        value, ci95, unit = rows[first].value, rows[first].ci95, rows[first].unit
        score, share = round(search.contribution(chosen, name), 2), energy_share(search.lines, change)
        more = value - mixed.healthy_value(first)
        result.append(FoundCause(name, first, value, unit, ci95, more, share, score, parameters=rows))
    return result


def intervals(search: Search, name: str, change: Array, sd: Array) -> dict[str, ParameterEstimate]:
    """The parameters of a cause after `change` (k,) [scales], known within `sd` and the error of the effect's form."""
    mixed, rows = search.mixed, {}
    form = form_error(search.shares[name])
    for parameter, i, x, s in zip(search.causes[name].parameters, search.place[name], change, sd, strict=True):
        healthy, step = mixed.healthy_value(parameter.name), float(mixed.scale[i])
        wide = mixed.quantile * float(np.hypot(s, form * x))
        ends = [stepped(parameter.name, healthy, step * y) for y in (float(x), float(x) - wide, float(x) + wide)]
        value, low, high = (float(np.clip(y, parameter.low, parameter.high)) for y in ends)  # nothing impossible
        rows[parameter.name] = ParameterEstimate(value, (low, high), parameter.unit)
    return rows


def form_error(shares: Mapping[str, float]) -> float:
    """Standard deviation of an effect that shows in channels by these shares: none has exactly its real form."""
    return JUDGE.discrepancy * (1 + sum(LUMPED.get(channel, 0) * share for channel, share in shares.items()))


def alternatives(now: Search, chosen: Sequence[str]) -> list[list[str]]:
    """For each cause chosen that others could replace: itself and these, if their parameters can have the values."""
    sets, inflation = [], now.mixed.inflation
    for name in chosen:
        rest = [other for other in chosen if other != name]
        own = now.gain([*rest, name])
        near = {n: now.gain([*rest, n]) for n in now.causes if n not in chosen}
        # the margin is on the scale of the less certain of the two
        margin = {n: JUDGE.margin * max(1.0, inflation.get(n, 1.0), inflation.get(name, 1.0)) for n in near}
        least = JUDGE.least_alternative * now.limit
        others = [n for n, gain in near.items() if gain > own - margin[n] and now.added_evidence(rest, n) > least]
        if not others:
            continue
        group = []
        for n in (name, *sorted(others, key=lambda n: -near[n])):
            change, variance = now.fitted([*rest, n])[n]
            if within_bounds(now.mixed, now.causes[n], change, np.sqrt(variance)):
                group.append(n)
        if len(group) > 1:
            sets.append(group)
    return sets


def separability(search: Search) -> Isolability:
    """Which candidates that the rides show could be told apart."""
    signatures = {
        name: sorted(channel for channel, share in search.shares[name].items() if share > 0) for name in search.causes
    }
    first = [place[0] for place in search.place.values()]
    information = search.evidence.information[np.ix_(first, first)]
    scale = np.sqrt(np.abs(np.outer(np.diag(information), np.diag(information))))
    cosines = np.divide(information, scale, out=np.zeros_like(scale), where=scale > 0)
    names = list(search.causes)
    pairs = [(i, j) for i in range(len(names)) for j in range(i + 1, len(names))]
    pairs = [(i, j) for i, j in pairs if abs(cosines[i, j]) > JUDGE.look_alike]
    alike = [(names[i], names[j], round(float(cosines[i, j]), 3)) for i, j in pairs]
    return Isolability(signatures, sorted(alike, key=lambda row: -abs(row[2])))


def showing(mixed: MixedModel, cause: Candidate) -> list[Channel]:
    """The channels that depend on `cause`."""
    return [channel for channel in CHANNELS if set(cause.names) & channel.depends(mixed.system.effects)]


def needs(mixed: MixedModel, cause: Candidate) -> tuple[str, ...]:
    """The roles that show `cause`, a text for each set of them, the shortest first."""
    sets = {
        " and ".join((*channel.roles, *channel.fed_by))
        + (f" each {channel.max_gap:g} s or more often" if channel.max_gap < math.inf else "")
        for channel in showing(mixed, cause)
    }
    return tuple(sorted(sets, key=lambda text: (text.count(" and "), text)))


def limits(now: Search, order: Sequence[str]) -> dict[str, Limit]:
    """The detection limit of every candidate, in the order of their names in `order`, then those not identifiable."""
    mixed, result = now.mixed, {}
    for cause in sorted(mixed.causes, key=lambda c: order.index(c.name) if c.name in order else len(order)):
        parameter, required = cause.parameters[0], needs(mixed, cause)
        (place,) = mixed.index([parameter.name]) if cause.name in order else (0,)
        information = float(now.evidence.information[place, place])
        if cause.name not in order or information <= 0:
            result[cause.name] = Limit(parameter.name, parameter.unit, None, None, required)
            continue
        change = np.zeros(len(mixed.mean))
        change[place] = np.sqrt(now.limit * mixed.inflation.get(cause.name, 1.0) / information)
        unit = mixed.healthy_value(parameter.name) if parameter.name in LOG_SCALED else 1.0
        steps, share = float(change[place] * mixed.scale[place]) * unit, abs(energy_share(now.lines, change))
        result[cause.name] = Limit(parameter.name, parameter.unit, steps, share, required)
    return result


# --- gain on rides held out -----------------------------------------------------------------------------------------


def measure_gain(
    now: Search, causes: Sequence[FoundCause], unknown: Unknown | None, seed: int, holdout: Sequence[LinearRide]
) -> Gain:
    """Errors of rides that were not fitted, with the `causes` and the curve of `unknown` and without.

    seed: of the bootstrap over rides. holdout: rides that had no part in the search. Without any, each of its rides is
    held out in turn; the choice of the causes is then shared.
    """
    mixed, lines, known = now.mixed, [*now.lines, *holdout], len(now.lines)
    if len(lines) < 2:
        return Gain(note="one ride: nothing to hold out")
    folds = [list(range(known, len(lines)))] if holdout else [[i] for i in range(known)]
    named = {cause.name for cause in causes if not cause.varies}
    after = [cause for cause in mixed.causes if cause.name in named]
    form = None
    if unknown is not None:
        form = curve_form(unknown.channel, unknown.quantity, unknown.straight, mixed.system.sizes)
    rows: dict[str, list[list[float]]] = {}
    for models in held_out(mixed, lines, after, form=form, folds=folds):
        each = [errors(line, theta) for line, theta in models]
        for metric in (name for name in each[0] if all(name in found for found in each)):
            rows.setdefault(metric, []).append([found[metric] for found in each])
    rng = np.random.default_rng(seed)
    held = tuple(lines[i].ride.name for fold in folds for i in fold)
    return Gain(
        held, None, bool(holdout), **{metric: summarised(np.array(table), rng) for metric, table in rows.items()}
    )


def summarised(table: Array, rng: np.random.Generator) -> Errors:
    """The means of (rides, 3) errors, and the interval of the gain by a bootstrap over rides."""
    before, control, after = table.mean(axis=0).tolist()
    if len(table) < 2:
        return Errors(before, control, after, None)
    draws = rng.integers(0, len(table), (JUDGE.bootstrap, len(table)))
    low, high = np.quantile((table[:, 1] - table[:, 2])[draws].mean(axis=1), [0.025, 0.975])
    return Errors(before, control, after, (float(low), float(high)))


def remaining_error(gain: Gain, lines: Sequence[LinearRide]) -> tuple[str, float]:
    """(of what, the share) that is missed on rides held out: the range, or the energy where the pack's is unknown."""
    if gain.range is not None:
        return "range", gain.range.after
    energy, distance = (sum(getattr(line.ride, name) for line in lines) for name in ("energy", "distance"))
    if gain.consumption is not None and energy > 0:
        return "energy", gain.consumption.after * distance / energy
    return "", 0.0


# --- the judgement --------------------------------------------------------------------------------------------------


def judge(
    problem: Search, now: Search, notes: Sequence[str] = (), seed: int = 0, holdout: Sequence[LinearRide] = ()
) -> Discovery:
    """The report on `now`, the accepted causes of `problem`.

    notes: so far. seed: of the bootstrap. holdout: rides, linearised where `now` is, that only the gain is measured on.
    """
    constancy = splits(now)
    unknown = unexplained(now, constancy)
    chosen = tuple(name for name in now.chosen if unknown is None or name not in unknown.denies)
    every = replace(now, causes=problem.causes)
    uneven = {split.cause for split in constancy if split.unequal and split.of_ride}
    varying = {name for name in chosen if name in uneven or not carries_over(now, name)}
    found = [replace(cause, varies=cause.name in varying) for cause in causes_of(now, chosen)]
    sets = alternatives(now, chosen)
    scores = {name: every.contribution(chosen, name) for name in every.causes}
    notes = [*notes, *not_identifiable(problem), *map(str, now.rejected)]
    if now.winds is not None:
        name = now.winds.cause.name
        scores[name] = max(scores.get(name, 0.0), now.winds.score)
        if now.winds.score > now.limit:  # the vector that they have in common is named
            (wind,) = causes_of(every, [*chosen, name])[-1:]
            found.append(replace(wind, evidence=round(now.winds.score, 2), varies=True))
            notes.append("the wind differed from ride to ride: " + now.winds.words)
    gain = measure_gain(now, found, unknown, seed, holdout)
    if unknown is not None and found and not unknown.denies:
        plain = measure_gain(now, found, None, seed, holdout)
        metric = "voltage" if unknown.channel == "cell_voltage" else "power"
        without, with_it = plain.errors.get(metric), gain.errors.get(metric)
        if without is not None and with_it is not None and without.after <= with_it.after:
            notes.append(f"{unknown} does not improve rides held out: left out")
            unknown, gain = None, plain
    implausible = implausible_explanations(now, chosen, scores)
    metric, missed = remaining_error(gain, now.lines)
    verdict = "ambiguous" if sets else "cause" if found else "none"
    if not found and (unknown is not None or implausible):
        verdict = "unknown"
    if verdict == "none" and missed > JUDGE.healthy_most:
        verdict = "inconclusive"
    if missed > JUDGE.missed:
        limit = f"(healthy rides: up to {JUDGE.healthy_most:.0%})"
        notes.append(f"{missed:.0%} of the {metric} is missed on rides held out {limit}")
    ranking = sorted((Score(name, round(score, 2)) for name, score in scores.items()), key=lambda row: -row.score)
    report = Report(
        verdict=verdict,
        causes=found,
        ambiguous=sets,
        unknown=unknown,
        ranking=ranking,
        residuals=residual_sizes(now.lines),
        gain=gain,
        advice=advice(now, sets, unknown, bool(implausible), verdict),
        notes=[*notes, *outlying_rides(now, found), *missing_residuals(now)],
        isolability=separability(every),
        threshold=now.limit,
        constancy=constancy,
        implausible=implausible,
        limits=limits(now, [row.name for row in ranking]),
    )
    return Discovery(report, now)


def advice(
    now: Search, sets: Sequence[Sequence[str]], unknown: Unknown | None, implausible: bool, verdict: str
) -> list[str]:
    """What to ride next."""
    lines = []
    if implausible:
        lines.append(
            "Vehicle, vehicle file or a signal: these rides cannot tell which is wrong. State the parameters that the "
            "file leaves open; a wrong unit, sign or scale is found by `gz-onboard vehicle check`."
        )
    for group in sets:
        shown = " ".join(now.causes[name].shown_by for name in group[:2])
        lines.append(f"To tell {', '.join(group)} apart: {shown}")
    if unknown is not None and unknown.quantity == CONSTANT:
        lines.append(
            f"Stand with the vehicle switched on, and ride at several steady speeds, for minutes each: a constant "
            f"{unknown.channel} is one at all of them. A current sensor whose zero is off would show one too."
        )
    elif unknown is not None:
        lines.append(
            f"Ride over the whole span of {unknown.quantity} with all else the same, twice: the residual of "
            f"{unknown.channel} goes with it, or with a quantity that changes along with it."
        )
    if verdict == "inconclusive":
        lines.append(
            "Ride one way there and back, on a calm day and on others: an error that differs from ride to ride, as "
            "wind does, shows in rides that have all else in common."
        )
    return lines


# --- notes ----------------------------------------------------------------------------------------------------------


def not_identifiable(problem: Search) -> list[str]:
    """A note on the candidates that these rides do not show."""
    names = [cause.name for cause in problem.mixed.causes if cause.name not in problem.causes]
    if not names:
        return []
    text = f"not identifiable from these rides: {', '.join(names)}; the report gives the data that each needs"
    return [text]


def outlying_rides(now: Search, causes: Sequence[FoundCause]) -> list[str]:
    """A sentence on each ride that differs from healthy ones by much: it may be the day, such as wind, or the ride."""
    index, post = fitted(now, [cause.name for cause in causes])
    sentences = []
    for line, own in zip(now.lines, post.own, strict=True):
        beyond = own / np.sqrt(now.mixed.scatter)
        beyond[index] = 0.0
        far = sorted(np.flatnonzero(np.abs(beyond) > JUDGE.outstanding), key=lambda i: -abs(beyond[i]))
        if far:
            most = ", ".join(f"{readable(now.mixed.names[i])} {beyond[i]:+.1f}" for i in far[:3])
            sentences.append(f"{line.ride.name} is an outlier: {most} standard deviations")
    return sentences


def missing_residuals(now: Search) -> list[str]:
    """Measurements that the rides do not have, and the residuals that this costs, a sentence for each set."""
    rides = [line.ride for line in now.lines]
    channels = [c for c in CHANNELS if now.mixed.system.battery is not None or not c.battery]
    asked = [(channel.roles, readable(channel.name)) for channel in channels]
    asked += [(("rate_z",), "residual over lateral acceleration"), (("gps_course",), "anything over heading")]
    lost: dict[tuple[str, ...], dict[str, None]] = {}
    for roles, words in asked:
        for ride in rides:
            if lacking := tuple(role for role in roles if role not in ride.have):
                lost.setdefault(lacking, {})[words] = None
    sentences = []
    for roles, names in lost.items():
        without = [ride.name for ride in rides if not set(roles) <= ride.have]
        which = "no ride has" if len(without) == len(rides) else f"{', '.join(without)}: without"
        sentences.append(f"{which} {' and '.join(roles)}: no {', no '.join(names)} there")
    sentences += dict.fromkeys(words for ride in rides for words in ride.stand_ins)
    for channel in channels:
        if any(set(channel.roles) <= ride.have and channel.too_slow(ride) for ride in rides):
            sentences.append(
                f"samples of {' and '.join(channel.roles)} are further apart than {channel.max_gap:g} s: no "
                f"{readable(channel.name)} there"
            )
    if any("pack_power" in line.tables for line in now.lines):
        sentences.append(
            "instead, the pack's power (voltage times current) is compared with drive and auxiliaries, as measured or "
            "by their models: causes that act alike in it differ by speed, acceleration and grade alone"
        )
    return sentences
