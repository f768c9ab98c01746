"""The search for causes: forward selection with exchange, and tests on rides held out and between rides.

All questions about a set of causes are asked of one pair of matrices, so that trying a set costs microseconds. Large
changes are not linear: the search is repeated about the changes found, until they settle.

A cause is accepted within its bounds, beyond the scatter of these rides, and if it predicts rides held out: the scatter
of a few healthy rides is not that of all, and the next rides may vary a quantity for the first time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.stats import t as student

from gz_onboard.arrays import Array
from gz_onboard.discovery.curves import CurveForm, bordered, columns_of, curve_forms, extended
from gz_onboard.discovery.mixed_model import (
    LinearChannel,
    LinearRide,
    MixedModel,
    Statistics,
    linearised_about,
    one_degree,
)
from gz_onboard.discovery.parameters import EACH_RIDES_OWN, LOG_SCALED, Candidate
from gz_onboard.model.effect import MOVING


@dataclass(frozen=True)
class SearchConfig:
    """How sure a cause must be."""

    false_alarms: float = 0.05  # of sets of healthy rides, all candidates and curves together
    visible: float = 1e-4  # information per scale squared, from which on rides say something of a parameter
    most_causes: int = 3  # that are named together
    exchanges: int = 3  # rounds of exchanging each cause for one that explains more
    alike: float = 0.6  # cosine of two columns
    form_error: float = 0.02  # of a cause's evidence: no effect has exactly its real form, and others take up the rest
    rounds: int = 5  # of linearisation
    settled: float = 0.03  # of a change: no further round for less
    most_fall: float = 3.0  # factor by which a parameter falls at once
    beyond_bounds: float = 2.0  # standard deviations beyond a bound, from which on a value is impossible
    scatter_rounds: int = 25  # of expectation and maximisation
    worse: float = 0.1  # ln of a mean square on rides held out: scatter
    least_share: float = 0.1  # of the evidence: a channel with less does not count
    ratio_sd: float = 0.15  # by which the effect of a real cause differs between halves, on all rides
    ratio_ride_sd: float = 0.25  # and from ride to ride
    ratio: float = 0.5  # beyond which half of a cause is missing in one of the halves
    ratio_chi2: float = 9.0  # three standard deviations
    bend_acceleration: float = 0.3  # m/s² of lateral acceleration: a bend
    side_wind: float = 0.5  # of (wind over speed)²: added to drag by side wind and gusts, mean over all directions


SEARCH = SearchConfig()
RIDE_PREFIX = "ride "  # before a ride's name, where a split is that ride against the others
IMPOSSIBLE = "would be beyond its bounds"


@dataclass(frozen=True)
class Rejected:
    """A candidate that was chosen and is no cause: why, and the change of its parameters, (k,) [scales]."""

    name: str
    why: str
    change: Array

    def __str__(self) -> str:
        return f"{self.name} {self.why}: not named"


@dataclass(frozen=True)
class Winds:
    """Each ride's own wind: its score against healthy rides, in words, and as changes (rides, p) in scales."""

    cause: Candidate
    score: float
    words: str
    changes: Array


@dataclass(frozen=True)
class Search:
    """A search for causes in rides: the candidates that these show, and the causes chosen so far.

    lines: linearised at `offset` (p,) in scales and seen from the values of `mixed`. causes: candidates. shares: of
    each cause, by channel, its share of the signal. limit: the score that a cause must have. ride_changes: of single
    rides, which stay, (p,) or (rides, p). chosen: causes, the surest first. winds: if they are no common cause.
    """

    mixed: MixedModel
    lines: Sequence[LinearRide]
    causes: Mapping[str, Candidate]
    shares: Mapping[str, Mapping[str, float]]
    limit: float
    offset: Array
    ride_changes: Array
    workers: int = 1
    chosen: tuple[str, ...] = ()
    rejected: tuple[Rejected, ...] = ()
    winds: Winds | None = None

    @cached_property
    def evidence(self) -> Statistics:
        """Statistics of changes by causes."""
        return self.mixed.evidence(self.lines)

    @cached_property
    def place(self) -> dict[str, list[int]]:
        """The places of the parameters of each candidate."""
        return {name: self.mixed.index(cause.names) for name, cause in self.causes.items()}

    def index(self, names: Iterable[str]) -> list[int]:
        """The places of the parameters of the causes `names`."""
        return [i for name in names for i in self.place[name]]

    @property
    def change(self) -> Array:
        """The change of the parameters by the causes chosen, (p,) in scales."""
        change = np.zeros(len(self.mixed.mean))
        index = self.index(self.chosen)
        change[index] = self.evidence.estimate(index)
        return change

    def fitted(self, names: Sequence[str]) -> dict[str, tuple[Array, Array]]:
        """(changes (k,), variances (k,)) of the parameters of each of `names`, all fitted together, in scales."""
        index = self.index(names)
        if not index:
            return {}
        ends = np.cumsum([len(self.place[name]) for name in names])[:-1]
        change, variance = self.evidence.estimate(index), np.diag(self.evidence.covariance(index))
        return dict(zip(names, zip(np.split(change, ends), np.split(variance, ends), strict=True), strict=True))

    def gain(self, names: Sequence[str]) -> float:
        """The evidence for a set of causes; 0 for one with an impossible sign or with causes that hide each other."""
        index = self.index(names)
        if not index:
            return 0.0
        change = self.evidence.estimate(index)
        firsts = np.cumsum([0, *(len(self.place[name]) for name in names[:-1])])
        signs = np.array([self.causes[name].sign for name in names])
        if np.any(change[firsts] * signs < 0):
            return 0.0
        # two that look alike and work against each other are less likely than one that is neither
        inner = self.evidence.information[np.ix_(index, index)]
        size = np.sqrt(np.maximum(np.diag(inner), 1e-12))
        cosines = inner / np.outer(size, size) * np.sign(np.outer(change, change))
        np.fill_diagonal(cosines, 1.0)
        return 0.0 if np.min(cosines) < -SEARCH.alike else float(self.evidence.score[index] @ change)

    def added_evidence(self, base: Sequence[str], name: str) -> float:
        """The evidence that `name` adds to `base`, as chi-squared of one degree of freedom of healthy rides."""
        more = self.gain([*base, name]) - self.evidence.gain(self.index(base))
        more /= self.mixed.inflation.get(name, 1.0)
        k = len(self.place[name])
        return one_degree(more, k, self.mixed.freedom) if k > 1 else more

    def contribution(self, chosen: Iterable[str], name: str) -> float:
        """The evidence that `name` adds to the others of `chosen`: see `added_evidence`."""
        return self.added_evidence([other for other in chosen if other != name], name)

    def required_score(self, base: Sequence[str], name: str) -> float:
        """The score that `name` must have on top of `base`: more than a correction of the form of a large effect."""
        mine = self.shares.get(name, {})
        error = 0.0
        for other in base:
            theirs = self.shares.get(other, {})
            common = sum(min(share, theirs.get(channel, 0.0)) for channel, share in mine.items())
            error += self.contribution(base, other) * common
        return max(self.limit, SEARCH.form_error * error)

    def choose(self) -> tuple[str, ...]:
        """Causes one after the other, each exchanged for the one that explains more together with the rest."""
        chosen: list[str] = []

        def best(base: Sequence[str]) -> tuple[str, dict[str, float]]:
            steps = {name: self.added_evidence(base, name) for name in self.causes if name not in base}
            return max(steps, key=lambda name: steps[name]), steps

        while len(chosen) < SEARCH.most_causes:
            new, steps = best(chosen)
            if steps[new] < self.required_score(chosen, new):
                break
            chosen.append(new)
            for _ in range(SEARCH.exchanges):
                before = list(chosen)
                for old in before:
                    new, steps = best([name for name in chosen if name != old])
                    if steps[new] > steps[old] + 1e-9:
                        chosen[chosen.index(old)] = new
                if chosen == before:
                    break
        for old in list(chosen):
            rest = [name for name in chosen if name != old]
            if rest and self.added_evidence(rest, old) < self.required_score(rest, old):
                chosen.remove(old)
        return tuple(sorted(chosen, key=lambda name: -self.contribution(chosen, name)))

    def moved(self, offset: Array) -> Search:
        """The same search, linearised at another offset (p,)."""
        rides = [line.ride for line in self.lines]
        lines = linearised_about(rides, self.mixed, offset + self.ride_changes, self.workers)
        return replace(self, lines=lines, offset=offset)

    def selected(self) -> Search:
        """The search with the causes that explain the rides, linearised about their changes."""
        now = replace(self, chosen=self.choose())
        for _ in range(SEARCH.rounds):
            if not now.chosen:
                break
            offset, change = self.offset.copy(), now.change  # of parameters without a cause, such as a delay, it stays
            for i in now.index(now.chosen):
                offset[i] = now.limited_step(i, float(change[i]))
            before, now = now.offset, now.moved(offset)
            now = replace(now, chosen=now.choose())
            if np.all(np.abs(offset - before) < SEARCH.settled * np.abs(offset) + 1e-9):
                break
        return now

    def limited_step(self, i: int, x: float) -> float:
        """A change `x` in scales of the parameter at `i`, kept within its bounds and two thirds of its value."""
        name, scale = self.mixed.names[i], float(self.mixed.scale[i])
        bounds = next((p for c in self.mixed.causes for p in c.parameters if p.name == name), None)
        if name in LOG_SCALED or bounds is None:
            return x
        value = self.mixed.values[name]
        low = max(bounds.low, value / SEARCH.most_fall) if bounds.low > 0 else bounds.low
        return (float(np.clip(value + x * scale, low, bounds.high)) - value) / scale


def search_problem(mixed: MixedModel, lines: Sequence[LinearRide], start: Array, workers: int = 1) -> Search:
    """The search for the candidates of `mixed` in rides linearised at `start` (p,), in scales."""
    evidence = mixed.evidence(lines)
    visible = np.diag(evidence.information) >= SEARCH.visible
    causes = {c.name: c for c in mixed.usable_causes if np.all(visible[mixed.index(c.names)])}
    # look-alikes are one try (Li & Ji 2005, eq. 5), each straight line is one
    index = mixed.index_of(causes.values())
    inner = evidence.information[np.ix_(index, index)]
    size = np.sqrt(np.maximum(np.diag(inner), 1e-12))
    values = np.abs(np.linalg.eigvalsh(inner / np.outer(size, size)))
    tries = float(np.sum((values >= 1) + (values - np.floor(values))))
    channels = {name for line in lines for name in line.tables}
    tries += sum(form.straight and form.channel in channels for form in curve_forms(mixed.system.sizes))
    # Šidák over the tries; Student's t, for the scatter between rides is known from the healthy rides alone
    one = 1 - (1 - SEARCH.false_alarms) ** (1 / tries)
    limit = float(student.ppf(1 - one / 2, mixed.freedom) ** 2)
    return Search(mixed, lines, causes, _shares(mixed, lines, causes), limit, start, np.zeros_like(start), workers)


def _shares(
    mixed: MixedModel, lines: Sequence[LinearRide], causes: Mapping[str, Candidate]
) -> dict[str, dict[str, float]]:
    """The share of the signal of each cause that is in each channel."""
    signal = dict.fromkeys((name for line in lines for name in line.tables), np.zeros(len(mixed.names)))
    for line in lines:
        for name, table in line.tables.items():
            signal[name] = signal[name] + np.sum((table.a / mixed.noise[name].sd) ** 2, axis=0)
    found = {}
    for cause in causes.values():
        seen = {name: float(np.sum(of[mixed.index(cause.names)])) for name, of in signal.items()}
        whole = sum(seen.values()) or 1.0
        found[cause.name] = {name: value / whole for name, value in seen.items()}
    return found


# --- rides held out -------------------------------------------------------------------------------------------------

Prediction = tuple[LinearRide, Array]  # a ride, less a curve, and its parameters (p,)
ThreeModels = tuple[Prediction, Prediction, Prediction]  # before, with the control refitted, after


def held_out(
    mixed: MixedModel,
    lines: Sequence[LinearRide],
    after: Sequence[Candidate],
    control: Sequence[Candidate] = (),
    form: CurveForm | None = None,
    folds: Iterable[Sequence[int]] | None = None,
) -> Iterator[ThreeModels]:
    """Of each ride in turn, held out of the fit: the model before, with `control` refitted, with `after` and `form`.

    Before: the causes of `control` alone are moved. Each ride has its own start. folds: the rides that are held out
    together; each alone if not given.
    """
    for fold in [[i] for i in range(len(lines))] if folds is None else folds:
        rest = [line for i, line in enumerate(lines) if i not in fold]
        plain = mixed.freed(mixed.index_of(control)).fit(rest).mean
        before, index = mixed.mean.copy(), mixed.index_of(control)
        before[index] = plain[index]
        free = mixed.freed(mixed.index_of(after))
        if form is None:
            full, curve = free.fit(rest).mean, np.zeros(0)
        else:
            k = form.basis.shape[1]
            rides = [extended(mixed, line, form) or line.statistics.padded(k) for line in rest]
            both = bordered(free, form, 100.0 * np.eye(k)).fit(rides).mean
            full, curve = both[:-k], both[-k:]
        for line in (lines[i] for i in fold):
            shown = line if form is None else without_curve(line, form, curve)
            models = ((line, before), (line, plain), (shown, full))
            first, second, third = ((x, with_own_start(mixed, x, theta)) for x, theta in models)
            yield first, second, third


def without_curve(line: LinearRide, form: CurveForm, curve: Array) -> LinearRide:
    """`line` less the curve of these coefficients (k,)."""
    knots = columns_of(line, form)
    if knots is None:
        return line
    table = line.tables[form.channel]
    less = knots @ form.basis @ curve * form.size / table.unit
    return replace(line, tables={**line.tables, form.channel: replace(table, y=table.y - less)})


def with_own_start(mixed: MixedModel, line: LinearRide, theta: Array) -> Array:
    """`theta` (p,) with the sensor and start parameters of the ride itself, which are no merit or fault of a model."""
    # force and power are left out: their mean would be taken for a bias of the accelerometer
    channels = [name for name in line.tables if name not in ("road_force", "pack_power")]
    shown = Statistics.of(line.tables, mixed.noise, channels)
    m = [i for i, name in enumerate(mixed.names) if name in EACH_RIDES_OWN]
    variance = mixed.scatter[m] + np.diag(mixed.prior)[m]
    rest = shown.score[m] - shown.information[m] @ theta
    moved = theta.copy()
    moved[m] += np.linalg.solve(np.diag(1 / variance) + shown.information[np.ix_(m, m)], rest)
    return moved


def worsened(held: Iterable[ThreeModels], shares: Mapping[str, float]) -> dict[str, float]:
    """How much worse rides held out are predicted after than before or with the control, whichever is better.

    ln of the ratio of mean squares, negative if better, of each channel that has a share of the evidence.
    """
    squares: dict[str, list[list[float]]] = {}
    for models in held:
        for name in (name for name, share in shares.items() if share > SEARCH.least_share):
            tables = [(line.tables.get(name), theta) for line, theta in models]
            row = [float(np.mean((t.y - t.a @ theta) ** 2)) for t, theta in tables if t is not None]
            if row:
                squares.setdefault(name, []).append(row)
    sums = {name: np.sum(rows, axis=0) for name, rows in squares.items()}
    return {name: float(np.log(after / min(before, control))) for name, (before, control, after) in sums.items()}


def improves(held: Iterable[ThreeModels], shares: Mapping[str, float]) -> bool:
    """Whether rides held out are predicted better in all channels together, each by its share."""
    return sum(shares[channel] * more for channel, more in worsened(held, shares).items()) < 0


def held_out_with(now: Search, name: str) -> Iterator[ThreeModels]:
    """Rides held out with `name` among the causes chosen; the control is without it."""
    causes = [now.causes[n] for n in now.chosen]
    return held_out(now.mixed, now.lines, causes, [c for c in causes if c.name != name])


def carries_over(now: Search, name: str) -> bool:
    """Whether each channel that shows `name` is predicted at least as well with it, on rides held out."""
    if len(now.lines) < 2:
        return True
    return all(more < SEARCH.worse for more in worsened(held_out_with(now, name), now.shares[name]).values())


# --- constancy ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Split:
    """How unequal a cause is between the halves of a quantity. ratio: half the difference over the mean."""

    cause: str
    quantity: str
    ratio: float
    chi2: float

    @property
    def unequal(self) -> bool:
        """Whether it is not the same cause in both halves."""
        return abs(self.ratio) > SEARCH.ratio and self.chi2 > SEARCH.ratio_chi2

    @property
    def of_ride(self) -> bool:
        """Whether it is one ride against the others."""
        return self.quantity.startswith(RIDE_PREFIX)


def _sides(quantity: str, line: LinearRide, table: LinearChannel, effect: Array) -> Array:
    """The half of `quantity` that each block is in, -1 to 1, (m,); of one ride, 1 there and 0 in the others.

    Either half has half of the squared `effect` (m,); in bends it is the side, and 0 on the straight.
    """
    if quantity.startswith(RIDE_PREFIX):
        return np.full(len(effect), float(quantity == f"{RIDE_PREFIX}{line.ride.name}"))
    at = table.over(line.ride.quantities[quantity])
    if quantity == "lateral_acceleration":
        return np.asarray(np.tanh(at / SEARCH.bend_acceleration))
    order = np.argsort(at)
    half = np.cumsum(effect[order] ** 2)
    return np.asarray(np.sign(at - at[order][np.searchsorted(half, half[-1] / 2)]))


def splits(now: Search) -> list[Split]:
    """Of each cause chosen, whether it acts alike in left and right bends, early and late, slow and fast, in all rides.

    Its columns are split in two, and the difference of the halves becomes a parameter, the `ratio` to their mean:
    0 for the cause itself, ±1 for what acts in one half only (constancy of a coefficient: Chow 1960; Hansen 1992).
    """
    found = []
    for name in now.chosen:
        quantities = ["lateral_acceleration", "time", "speed"]
        if len(now.lines) > 2 and not now.causes[name].varies:
            quantities += [f"{RIDE_PREFIX}{line.ride.name}" for line in now.lines]
        for quantity in quantities:
            inner, score = _split(now, now.place[name], quantity)
            if inner > 1e-6:  # else no ride shows it
                found.append(Split(name, quantity, score / inner, score * score / inner))
    return found


def _split(now: Search, index: Sequence[int], quantity: str) -> tuple[float, float]:
    """(information, score) of the ratio of the halves of the effect of the parameters at `index`."""
    mixed, change, rides = now.mixed, now.change[index], []
    for line in now.lines:
        more = line.statistics.padded(1)
        for name, table in line.tables.items():
            effect = table.a[:, index] @ change
            if not np.any(effect):
                continue
            column = effect * _sides(quantity, line, table, effect)
            if np.any(column):
                more = more.with_columns(table, mixed.noise[name], column[:, None])
        rides.append(more)
    prior, scatter = np.full((1, 1), SEARCH.ratio_sd**2), np.full(1, SEARCH.ratio_ride_sd**2)
    known = mixed.bordered(np.zeros(1), prior, scatter)
    ratio = known.evidence(rides).profiled([len(mixed.mean)], now.index(now.chosen))
    return float(ratio.information[0, 0]), float(ratio.score[0])


# --- acceptance -----------------------------------------------------------------------------------------------------


def with_observed_scatter(mixed: MixedModel, lines: Sequence[LinearRide]) -> MixedModel:
    """`mixed` with the scatter between rides that these show, where it is more than that of healthy ones."""
    if len(lines) < 2:
        return mixed
    found = mixed.widened().fit(lines, float(mixed.healthy + 1), mixed.free, SEARCH.scatter_rounds).scatter
    return replace(mixed, scatter=np.maximum(found, mixed.scatter))


def within_bounds(mixed: MixedModel, cause: Candidate, change: Iterable[float], sd: Iterable[float]) -> bool:
    """Whether the parameters of `cause` can have changed by `change` [scales], known within `sd`."""
    for parameter, x, s in zip(cause.parameters, change, sd, strict=True):
        (i,) = mixed.index([parameter.name])
        step = float(mixed.scale[i])
        value, spread = mixed.values[parameter.name] + x * step, SEARCH.beyond_bounds * s * step
        inside = parameter.low - spread <= value <= parameter.high + spread
        if not inside and parameter.name not in LOG_SCALED:
            return False
    return True


def rejection(now: Search) -> Rejected | None:
    """The least certain of the causes chosen that cannot be accepted; None if all can."""
    mixed = now.mixed
    strict = replace(now, mixed=with_observed_scatter(mixed, now.lines))
    # against a file alone, differences between rides cannot be separated from model errors
    uneven = set() if mixed.healthy else {split.cause for split in splits(now) if split.unequal and split.of_ride}
    found: list[tuple[float, str, Rejected]] = []
    for name, (change, variance) in now.fitted(now.chosen).items():
        score, why = strict.contribution(now.chosen, name), ""
        if not within_bounds(mixed, now.causes[name], change, np.sqrt(variance)):
            why = IMPOSSIBLE
        elif score < now.limit:
            why = "differs from ride to ride as much as it is"
        elif name in uneven:
            why = "acts in some rides and not in others"
        elif len(now.lines) > 1 and not improves(held_out_with(now, name), now.shares[name]):
            why = "does not foretell rides held out"
        if why:
            found.append((score, name, Rejected(name, why, change)))
    return min(found, key=lambda row: row[:2])[2] if found else None


def accepted(search: Search) -> Search:
    """The causes of `search` that can be accepted: without each that is rejected it is searched again."""
    now = search.selected()
    while now.chosen and (bad := rejection(now)):
        rejected = (*now.rejected, bad)
        search = replace(search, causes={name: c for name, c in search.causes.items() if name != bad.name})
        now = replace(search.selected(), rejected=rejected)
    return now


# --- winds ----------------------------------------------------------------------------------------------------------


def search_causes(problem: Search) -> Search:
    """The causes that are accepted, with the wind of each ride if winds are stronger than on healthy rides."""
    now = accepted(problem)
    wind = next((cause for cause in problem.causes.values() if cause.varies), None)  # also one that was rejected
    if wind is None or wind.name in now.chosen:
        return now
    winds = own_winds(now, wind)
    if winds.score <= now.limit:
        return replace(now, winds=winds)
    causes = {name: cause for name, cause in problem.causes.items() if name != wind.name}
    windy = accepted(with_winds(replace(problem, causes=causes), winds))
    rejected = {refused.name: refused for refused in (*now.rejected, *windy.rejected)}
    refused = tuple(one for name, one in rejected.items() if name not in (wind.name, *windy.chosen))
    return replace(windy, rejected=refused, winds=winds)


def own_winds(now: Search, wind: Candidate) -> Winds:
    """The wind of each ride. It blows otherwise on another day, so that one vector common to the rides misses it."""
    mixed, w = now.mixed, now.mixed.index(wind.names)
    changes = np.zeros((len(now.lines), len(mixed.mean)))
    rest = [i for i in range(len(mixed.mean)) if i not in w]
    spread = mixed.prior + np.diag(mixed.scatter)
    inside = np.zeros_like(spread)
    inside[np.ix_(rest, rest)] = np.linalg.inv(spread[np.ix_(rest, rest)])
    mean = mixed.mean + now.change
    total, words = 0.0, []
    for i, line in enumerate(now.lines):
        shown = line.statistics
        if np.any(np.diag(shown.information)[w] < 1e-6):  # the ride says nothing of its wind
            continue
        covariance = np.linalg.inv(inside + shown.information)
        own = (covariance @ (shown.score + inside @ mean))[w] - mean[w]
        total += float(own @ np.linalg.solve(spread[np.ix_(w, w)] + covariance[np.ix_(w, w)], own))
        changes[i, w] = own
        north, east = (own * mixed.scale[w]).tolist()
        words.append(
            f"{line.ride.name} {np.hypot(north, east):.1f} m/s from {np.degrees(np.arctan2(east, north)) % 360:.0f}°"
        )
    score = one_degree(total, 2 * len(words), mixed.freedom) if words else 0.0
    return Winds(wind, score, ", ".join(words), changes)


def with_winds(problem: Search, winds: Winds) -> Search:
    """The search with each ride linearised about its own wind: its square would be taken for a load.

    Side wind and gusts, which no channel shows, widen the scatter of the drag area, the other parameter of the effect.
    """
    mixed = problem.mixed
    w = mixed.index(winds.cause.names)
    scatter = mixed.scatter.copy()
    scatter[w] = np.maximum(scatter[w], np.mean(winds.changes[:, w] ** 2, axis=0))
    speeds = [np.abs(line.ride.quantities["speed"]) for line in problem.lines]
    mean_square = np.array([np.mean(speed[speed > MOVING]) for speed in speeds]) ** 2
    square = np.sum((winds.changes[:, w] * mixed.scale[w]) ** 2, axis=1) / mean_square
    for i in mixed.index([name for name in winds.cause.reads if name in mixed.names]):
        share = SEARCH.side_wind * square * mixed.values[mixed.names[i]] / mixed.scale[i]
        scatter[i] += np.mean(share**2)
    windy = replace(problem, mixed=replace(mixed, scatter=scatter), ride_changes=winds.changes)
    return windy.moved(problem.offset)
