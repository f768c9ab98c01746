"""The linear mixed model of all channels, and the small matrices that every question is asked of.

About the present parameters θ the residuals of ride r are y = A·(θ_r − θ) + noise with θ_r = μ + u_r: μ is common to
all rides (Laird & Ware 1982), u_r is the ride's own, of a scatter learned from healthy rides. That the parameters of a
healthy vehicle seem to differ from ride to ride is the discrepancy of the model (Brynjarsdóttir & O'Hagan 2014); no
smaller change is taken for a cause. Noise is white plus exponentially correlated. All parameters are in units of their
scale. For each ride N = AᵀC⁻¹A and b = AᵀC⁻¹y remain: its sufficient statistics.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.stats import f as fisher
from scipy.stats import t as student

from gz_onboard.arrays import Array, Mask
from gz_onboard.discovery.channels import CHANNELS, Channel, ChannelNoise
from gz_onboard.discovery.grid import Ride, read_ride
from gz_onboard.discovery.parameters import (
    GIVEN_SCATTER,
    LOG_SCALED,
    NUISANCES,
    VEHICLE,
    Candidate,
    candidates,
    prior_covariance,
    prior_of,
    stepped,
)
from gz_onboard.discovery.residuals import System, counted_soc, start_soc
from gz_onboard.model.effect import Effect, Port
from gz_onboard.model.parameters import declared_parameters
from gz_onboard.model.series import relaxation
from gz_onboard.priors import correlations, sizes_of
from gz_onboard.processes import worker_pool
from gz_onboard.recording.recording import Recording
from gz_onboard.vehicle import Vehicle

Noise = Mapping[str, ChannelNoise]  # by channel


@dataclass(frozen=True)
class MixedConfig:
    """How rides are linearised, and how noise and scatter are learned."""

    least_blocks: int = 10  # of a channel in a ride
    outlying: float = 5.0  # standard deviations of a block that is trimmed
    kept: float = 0.95  # share of a channel that is never trimmed
    most_trimmed: float = 0.2  # share beyond which nothing is trimmed: it is no outlier then
    clipped: float = 6.0  # robust standard deviations beyond which a residual counts no more for the noise
    noise_ratios: tuple[float, ...] = (0.0, 0.1, 0.25, 0.5, 1.0, 2.0, 5.0)  # correlated over white, to choose from
    noise_blocks: tuple[float, ...] = (3, 10)  # correlation times to choose from, in blocks
    noise_times: tuple[float, ...] = (60.0, 200.0, 600.0)  # and in s
    least_slow_ratio: float = 0.5  # of a channel whose noise is known to be slow
    scatter_range: tuple[float, float] = (0.02, 9.0)  # of the variance before, within which the scatter is learned
    freed: float = 1e6  # variance in scales of an unknown parameter
    widened: float = 25.0  # variance in scales: five times a usual change
    prior_rides: int = 3  # that prior knowledge counts as
    least_freedom: int = 4  # degrees of freedom; no scatter is known worse
    circuit_time: float = 300.0  # s over which the errors of an RC circuit persist
    absent: float = 1e-3  # sd in scales of an effect that the model does not have
    make_spread: float = 0.05  # sd of losses between motors and inverters of one make, as a share


MIXED = MixedConfig()


@dataclass(frozen=True)
class LinearChannel:
    """One channel of one ride, linearised: y (m,) [unit], a (m, p) [unit per scale], time (m,) [s].

    used: which of all blocks are in y. roughness: of all blocks. factor: further noise of this ride. y and a are
    divided by both.
    """

    channel: Channel
    y: Array
    a: Array
    time: Array
    used: Mask
    factor: float = 1.0
    roughness: Array = field(default_factory=lambda: np.ones(0))

    @property
    def unit(self) -> Array:
        """The factor from y to the channel's unit, (m,)."""
        return self.factor * self.roughness[self.used]

    def over(self, values: Array) -> Array:
        """A quantity on the grid, averaged over the blocks of y, (m,)."""
        return self.channel.mean(values)[self.used]


Tables = Mapping[str, LinearChannel]  # by channel


def innovations(times: Array, values: Array, ratio: Any, time: Any) -> tuple[Array, Array]:
    """Innovations of a Kalman filter of white and correlated noise, and their variances over that of the white noise.

    values (m,) or (m, k) at `times` (m,) [s]. ratio, time [s]: of the correlated noise, its standard deviation over
    the white one's; floats, or arrays (k,) of as many filters of one series. Anderson & Moore 1979, ch. 9.
    """
    decays = np.exp(np.divide.outer(-np.diff(times, prepend=times[0]), time))
    power = ratio**2
    variance, variances = power, []
    for decay in decays if decays.ndim > 1 else decays.tolist():
        variance = decay * decay * (variance - power) + power
        variances.append(variance + 1)
        variance = variance / (variance + 1)
    total = np.array(variances)
    if values.ndim > decays.ndim:
        decays, total = decays[:, None], total[:, None]
    # the prediction s is a first-order lag: s_k+1 = d·(s_k + g·(v_k − s_k)) with the gain g = 1 − 1/variance
    keeps = decays[1:] / total[:-1]
    enters = decays[1:] * (1 - 1 / total[:-1]) / (1 - keeps)
    predicted = relaxation(enters * (values[:-1] if values.ndim == enters.ndim else values[:-1, None]), keeps)
    values = values if values.ndim == predicted.ndim else values[:, None]
    return values - np.concatenate([np.zeros_like(predicted[:1]), predicted]), total


def whitened(table: LinearChannel, noise: ChannelNoise, values: Array) -> Array:
    """`values` (m, k) in units of their noise: innovations over their standard deviations."""
    white, slow, time = noise
    if not table.channel.correlated or slow < 1e-9 * white:
        return np.asarray(values / white)
    innovation, variance = innovations(table.time, values / white, slow / white, time)
    return innovation / np.sqrt(variance)


@dataclass(frozen=True)
class Statistics:
    """Information (p, p) and score (p,) of the parameters: their log likelihood is x·score − x·information·x/2.

    Of one ride these are its sufficient statistics, N and b. Those of several rides add up once the part that is each
    ride's own is integrated out (`marginal`).
    """

    information: Array
    score: Array

    @classmethod
    def of(cls, tables: Tables, noise: Noise, channels: Iterable[str] | None = None) -> Statistics:
        """The statistics of the channels in `tables`, or of those in `channels`."""
        size = next(iter(tables.values())).a.shape[1]
        n, b = np.zeros((size, size)), np.zeros(size)
        for name in tables if channels is None else channels:
            table = tables[name]
            touched = np.flatnonzero(np.any(table.a != 0, axis=0))
            both = whitened(table, noise[name], np.column_stack([table.a[:, touched], table.y]))
            product = both[:, :-1].T @ both
            n[np.ix_(touched, touched)] += product[:, :-1]
            b[touched] += product[:, -1]
        return cls(n, b)

    def padded(self, k: int) -> Statistics:
        """With `k` more parameters that nothing is known of."""
        return Statistics(np.pad(self.information, (0, k)), np.pad(self.score, (0, k)))

    def with_columns(self, table: LinearChannel, noise: ChannelNoise, columns: Array) -> Statistics:
        """With `columns` (m, k) of a channel for the last k parameters."""
        k, p = columns.shape[1], table.a.shape[1]
        both = whitened(table, noise, np.column_stack([table.a, columns, table.y]))
        product = both[:, p : p + k].T @ both
        n, b = self.information.copy(), self.score.copy()
        n[-k:, :p] += product[:, :p]
        n[:p, -k:] = n[-k:, :p].T
        n[-k:, -k:] += product[:, p:-1]
        b[-k:] += product[:, -1]
        return Statistics(n, b)

    def marginal(self, scatter: Array) -> Statistics:
        """With the ride's own part, of variances `scatter` (p,), integrated out."""
        both = np.column_stack([self.information, self.score])
        solved = np.linalg.solve(np.eye(len(scatter)) + self.information * scatter, both)
        n = solved[:, :-1]
        return Statistics(np.asarray((n + n.T) / 2), np.asarray(solved[:, -1]))

    def _inner(self, index: Sequence[int]) -> Array:
        """The information of the parameters at `index`; no change is without bounds."""
        i = list(index)
        return np.asarray(self.information[np.ix_(i, i)] + 1e-6 * np.eye(len(i)))

    def estimate(self, index: Sequence[int]) -> Array:
        """The likeliest changes of the parameters at `index`, in scales; the others do not change."""
        return np.asarray(np.linalg.solve(self._inner(index), self.score[list(index)]))

    def covariance(self, index: Sequence[int]) -> Array:
        """The covariance of `estimate`."""
        return np.asarray(np.linalg.inv(self._inner(index)))

    def profiled(self, index: Sequence[int], fitted: Sequence[int]) -> Statistics:
        """The statistics of the parameters at `index` with those at `fitted` refitted."""
        i, f = list(index), list(fitted)
        inner, score = self.information[np.ix_(i, i)], self.score[i]
        if not f:
            return Statistics(inner, score)
        across = self.information[np.ix_(i, f)]
        cross = np.linalg.solve(self._inner(f), np.column_stack([across.T, self.score[f]]))
        return Statistics(inner - across @ cross[:, :-1], score - across @ cross[:, -1])

    def gain(self, index: Sequence[int]) -> float:
        """Twice the rise of the log likelihood by free changes of the parameters at `index`."""
        return float(self.score[list(index)] @ self.estimate(index)) if len(index) else 0.0


def one_degree(chi2: float, k: int, freedom: float) -> float:
    """The square of Student's t that is as unlikely as `chi2` of `k` coefficients.

    Their common scatter is known with `freedom` degrees of freedom, so that this is a quantile of F.
    """
    if chi2 <= 0:
        return 0.0
    near = chi2
    while (log_p := float(fisher.logsf(near / k, k, freedom))) < -500:
        near /= 2  # as far out as this both grow in proportion
    return float(student.isf(np.exp(log_p) / 2, freedom)) ** 2 * chi2 / near


@dataclass(frozen=True)
class LinearRide:
    """A ride, linearised, with its sufficient statistics. whole: its channels before outliers were trimmed."""

    ride: Ride
    tables: Tables
    statistics: Statistics
    whole: Tables = field(default_factory=dict)

    def seen_from(self, offset: Array) -> LinearRide:
        """The same, with residuals as they would be at parameters `offset` (p,) before these, were the model linear."""
        tables = {name: replace(table, y=table.y + table.a @ offset) for name, table in self.tables.items()}
        n = self.statistics.information
        return LinearRide(self.ride, tables, Statistics(n, self.statistics.score + n @ offset))

    def weighed(self, mixed: MixedModel) -> LinearRide:
        """Without outliers by another model at the same values; with a baseline, more noise where the ride has more."""
        tables = self.whole
        wide = np.sqrt(np.diag(mixed.prior)) + 3 * np.sqrt(mixed.scatter)
        for parameter in [parameter for cause in mixed.usable_causes for parameter in cause.parameters]:
            (i,) = mixed.index([parameter.name])
            wide[i] += max(10 * float(np.sqrt(mixed.scatter[i])), 3 * parameter.prior_sd / float(mixed.scale[i]))

        def likeliest(tables: Tables) -> Array:
            shown = Statistics.of(tables, mixed.noise)
            rest = shown.score - shown.information @ mixed.mean
            return np.asarray(mixed.mean + np.linalg.solve(np.diag(1 / wide**2) + shown.information, rest))

        for _ in range(3):  # least trimmed squares (Rousseeuw & Leroy 1987): fit, trim, fit again
            own = likeliest(tables)
            tables = {name: _trimmed(table, mixed.noise[name], own) for name, table in self.whole.items()}
        if mixed.healthy:
            own = likeliest(tables)
            tables = {name: _spread_out(table, mixed.noise[name], own) for name, table in tables.items()}
        return replace(self, tables=tables, statistics=Statistics.of(tables, mixed.noise))

    def at_noise(self, noise: Noise) -> LinearRide:
        """The same at another noise."""
        return replace(self, statistics=Statistics.of(self.tables, noise))


@dataclass(frozen=True)
class Population:
    """Knowledge of all rides, in scales: mean (p,) and covariance `prior` (p, p) of the common part, variances
    `scatter` (p,) of each ride's own part.
    """

    mean: Array
    prior: Array
    scatter: Array

    def bordered(self, mean: Array, prior: Array, scatter: Array) -> Population:
        """With k more parameters, known as (k,), (k, k), (k,)."""
        both = block_diag(self.prior, prior)
        return Population(np.append(self.mean, mean), both, np.append(self.scatter, scatter))

    def evidence(self, rides: Iterable[LinearRide | Statistics]) -> Statistics:
        """Statistics of changes from this mean, all that is common or random between `rides` integrated out."""
        each = [ride.statistics if isinstance(ride, LinearRide) else ride for ride in rides]
        parts = [ride.marginal(self.scatter) for ride in each]
        m = sum((part.information for part in parts), np.zeros_like(self.prior))
        e = sum((part.score for part in parts), np.zeros(len(self.mean))) - m @ self.mean
        k = np.linalg.inv(np.linalg.inv(self.prior) + m)
        return Statistics(m - m @ k @ m, e - m @ k @ e)

    def fit(
        self,
        rides: Iterable[LinearRide | Statistics],
        weight: Array | float = 0.0,
        free: Mask | None = None,
        rounds: int = 1,
    ) -> Posterior:
        """The common part, each ride's own, and the scatter between rides.

        free (p,): whose scatter is learned, by `rounds` of expectation and maximisation (Dempster, Laird & Rubin
        1977); that before is worth `weight` rides.
        """
        each = [ride.statistics if isinstance(ride, LinearRide) else ride for ride in rides]
        now, information = self.scatter.copy(), np.linalg.inv(self.prior)
        low, high = (share * self.scatter for share in MIXED.scatter_range)
        for _ in range(rounds):
            parts = [ride.marginal(now) for ride in each]
            after = np.linalg.inv(information + sum(part.information for part in parts))
            common = after @ (information @ self.mean + sum(part.score for part in parts))
            total, own = weight * self.scatter, []
            for ride in each:
                v = np.linalg.inv(np.diag(1 / now) + ride.information)
                u = v @ (ride.score - ride.information @ common)
                vn = v @ ride.information
                total = total + u**2 + np.diag(v) + np.sum((vn @ after) * vn, axis=1)
                own.append(u)
            if free is not None:
                now = np.where(free, np.clip(total / (weight + len(each)), low, high), self.scatter)
        return Posterior(common, after, now, np.array(own))


@dataclass(frozen=True)
class Posterior:
    """mean (p,) and covariance (p, p) of the common part, scatter (p,) between rides, own (rides, p) parts."""

    mean: Array
    covariance: Array
    scatter: Array
    own: Array


@dataclass(frozen=True)
class HealthyCurve:
    """What healthy rides leave over a quantity in a channel: coefficients (k,), covariance (k, k), inflation."""

    mean: Array
    covariance: Array
    inflation: float


@dataclass(frozen=True)
class MixedModel(Population):
    """The frame of the linear model: names (p,), scale (p,), values where it is linearised, and prior knowledge as
    differences from `values`.

    causes: candidates; lacking: those whose effect is not in the vehicle's model. healthy: rides that it was learned
    on. free (p,): whose scatter between rides is learned. inflation: of a cause's score on healthy rides left out, 1 if
    right. shapes: their curves over quantities. checked: in words, how well the energy of healthy rides held out is
    predicted.
    """

    vehicle: Vehicle
    system: System
    causes: tuple[Candidate, ...]
    lacking: tuple[Candidate, ...]
    names: tuple[str, ...]
    scale: Array
    values: dict[str, float]
    noise: Noise
    healthy: int
    free: Mask
    inflation: dict[str, float] = field(default_factory=dict)
    shapes: dict[str, HealthyCurve] = field(default_factory=dict)
    checked: str = ""

    @property
    def freedom(self) -> float:
        """Degrees of freedom of the scatter between rides in a search: two for each ride."""
        return float(2 * max(self.healthy + MIXED.prior_rides, MIXED.least_freedom))

    @property
    def quantile(self) -> float:
        """Half of a 95 % interval in standard deviations, by Student's t."""
        return float(student.ppf(0.975, max(self.healthy + MIXED.prior_rides, MIXED.least_freedom)))

    @property
    def usable_causes(self) -> list[Candidate]:
        """The candidates whose parameters some channel depends on."""
        return [cause for cause in self.causes if set(cause.names) <= set(self.names)]

    def healthy_value(self, name: str) -> float:
        """A parameter's value in the vehicle file; 0 for an effect that is not in its model."""
        absent = any(name in cause.names for cause in self.lacking)
        return 0.0 if absent else float(self.vehicle.parameters[name])

    def index(self, names: Iterable[str]) -> list[int]:
        """The places of `names`."""
        return [self.names.index(name) for name in names]

    def index_of(self, causes: Iterable[Candidate]) -> list[int]:
        """The places of the parameters of `causes`."""
        return self.index(name for cause in causes for name in cause.names)

    def freed(self, index: Sequence[int]) -> MixedModel:
        """With nothing known of the common part at `index`."""
        prior = self.prior.copy()
        prior[index, index] += MIXED.freed
        return replace(self, prior=prior)

    def widened(self) -> MixedModel:
        """With little known of the common part, to learn scatter or noise."""
        return replace(self, prior=self.prior + MIXED.widened * np.eye(len(self.names)))

    def values_at(self, vector: Array) -> dict[str, float]:
        """`values` moved by `vector` (p,) in scales."""
        moved = dict(self.values)
        for name, step in zip(self.names, vector * self.scale, strict=True):
            moved[name] = stepped(name, moved[name], float(np.clip(step, -1, 1) if name in LOG_SCALED else step))
        return moved

    def about(self, offset: Array) -> MixedModel:
        """Linearised at `offset` (p,) in scales from here."""
        return replace(self, values=self.values_at(offset)) if np.any(offset) else self

    def ride(self, samples: Recording) -> Ride:
        """`samples` on the grid of this vehicle."""
        ride = read_ride(samples, self.vehicle)
        if self.system.battery is not None and {"pack_voltage", "pack_current"} <= ride.have:
            ride.start_soc = start_soc(ride, self.system)
            ride.quantities["soc"] = counted_soc(ride, self.system)
        return ride


def initial(vehicle: Vehicle, folder: Path | None = None) -> MixedModel:
    """The model of `vehicle` by its file alone. folder: with effects of the user."""
    causes = candidates(folder)
    has = {effect.name for effect in vehicle.model.effects}
    missing = tuple(cause for cause in causes if cause.effect and cause.effect.name not in has)
    absent = {name for cause in missing for name in cause.names}
    added = [cause.effect for cause in missing if cause.effect]
    effects: tuple[Effect, ...] = (*vehicle.model.effects, *added)
    p, sizes, declared = vehicle.parameters, sizes_of(vehicle), declared_parameters(effects)
    cells = tuple(vehicle.model.at(Port.CELL_VOLTAGE))
    values = {name: x.prior for name, x in declared.items()} | dict(p)
    values |= {nuisance.name: nuisance.value for nuisance in NUISANCES} | dict.fromkeys(absent, 0.0)
    # fitted: all that a channel depends on, but not the parameters that only shape an absent effect
    needed = {name for channel in CHANNELS for name in channel.depends(effects)}
    fitted = set(VEHICLE) | {nuisance.name for nuisance in NUISANCES} | {x for c in causes for x in c.names}
    shaping = {x.name for e in added for x in e.parameters} - {x for c in causes for x in c.names}
    fitted |= {x.name for e in vehicle.model.effects for x in e.parameters}
    names = sorted(name for name in (needed & fitted) - shaping if name in values)
    priors = {name: prior_of(name, vehicle, declared, values[name], name in absent) for name in names}
    return MixedModel(
        vehicle=vehicle,
        system=System(effects, vehicle.battery, dict(p), cells, vehicle.riding.vibration, sizes),
        causes=causes,
        lacking=missing,
        names=tuple(names),
        scale=np.array([prior.scale for prior in priors.values()]),
        values=values,
        mean=np.zeros(len(names)),
        prior=prior_covariance(priors, correlations(vehicle)),
        scatter=np.array([prior.ride_sd for prior in priors.values()]) ** 2,
        noise={channel.name: channel.noise.scaled(sizes.of(channel.size)) for channel in CHANNELS},
        healthy=0,
        free=np.array([name not in GIVEN_SCATTER for name in names]),
    )


# --- linearisation --------------------------------------------------------------------------------------------------


def linearise_all(
    rides: Sequence[Ride], mixed: MixedModel | Sequence[MixedModel], workers: int = 1
) -> list[LinearRide]:
    """All rides at a model, or each at its own, in `workers` processes."""
    states = [mixed] * len(rides) if isinstance(mixed, MixedModel) else mixed
    jobs = list(zip(rides, states, strict=True))
    if workers < 2 or len(rides) < 2:
        return [_linearised(job) for job in jobs]
    with worker_pool(workers) as pool:
        return list(pool.map(_linearised, jobs))


def linearised_about(rides: Sequence[Ride], mixed: MixedModel, offset: Array, workers: int = 1) -> list[LinearRide]:
    """The rides linearised at `offset` in scales, (p,) or one for each, (rides, p); residuals as seen from `mixed`."""
    offsets = np.broadcast_to(offset, (len(rides), len(mixed.names)))
    lines = linearise_all(rides, [mixed.about(own) for own in offsets], workers)
    return [line.seen_from(own) for line, own in zip(lines, offsets, strict=True)]


def _linearised(job: tuple[Ride, MixedModel]) -> LinearRide:
    ride, mixed = job
    nothing = Statistics(np.zeros((0, 0)), np.zeros(0))
    return LinearRide(ride, {}, nothing, dict(_columns(ride, mixed))).weighed(mixed)


def _columns(ride: Ride, mixed: MixedModel) -> Iterable[tuple[str, LinearChannel]]:
    """Residuals of `ride` and their columns, by forward differences of a scale, channel by channel."""
    values, system = mixed.values, mixed.system
    for channel in (c for c in CHANNELS if c.usable(ride, system)):
        used = channel.support(ride)
        if used.sum() < MIXED.least_blocks:
            continue
        mine = channel.depends(system.effects)
        y = channel.blocks(ride, values, system)[used]
        a = np.zeros((len(y), len(mixed.names)))
        for i, name in enumerate(mixed.names):
            if name in mine:
                moved = {**values, name: stepped(name, values[name], float(mixed.scale[i]))}
                a[:, i] = y - channel.blocks(ride, moved, system)[used]
        roughness = channel.roughness(ride, system)
        y, a = y / roughness[used], a / roughness[used][:, None]
        good = np.isfinite(y) & np.isfinite(a).all(axis=1)
        index = np.flatnonzero(used)[good]
        used = np.isin(np.arange(len(used)), index)
        yield (
            channel.name,
            LinearChannel(
                channel, y[good], a[good], np.asarray((index + 0.5) * channel.block), used, roughness=roughness
            ),
        )


def _trimmed(table: LinearChannel, noise: ChannelNoise, own: Array) -> LinearChannel:
    """`table` without the blocks, and their neighbours, that no likely parameters explain: a slipping wheel, a gap."""
    rest = table.y - table.a @ own
    rest = rest - np.median(rest)
    limit = MIXED.outlying * max(noise.sd, robust_sd(rest))
    bad = np.abs(rest) > max(limit, float(np.quantile(np.abs(rest), MIXED.kept)))
    bad = bad | np.append(bad[1:], False) | np.insert(bad[:-1], 0, False)
    if not bad.any() or bad.mean() > MIXED.most_trimmed:
        return table
    used = table.used.copy()
    used[np.flatnonzero(used)[bad]] = False
    return replace(table, y=table.y[~bad], a=table.a[~bad], time=table.time[~bad], used=used)


def _spread_out(table: LinearChannel, noise: ChannelNoise, own: Array) -> LinearChannel:
    """`table` with its noise raised to that of this ride: one that no parameters explain counts for less."""
    rest = whitened(table, noise, table.y - table.a @ own)
    factor = max(1.0, float(np.sqrt(np.mean(rest**2))))
    return replace(table, y=table.y / factor, a=table.a / factor, factor=factor)


def robust_sd(values: Array) -> float:
    """Standard deviation of a normal distribution with the median absolute value of `values`."""
    return 1.4826 * float(np.median(np.abs(values)))


# --- noise ----------------------------------------------------------------------------------------------------------


def learn_noise(rides: Sequence[LinearRide], shifts: Array, start: Noise) -> dict[str, ChannelNoise]:
    """White and correlated noise of each channel by maximum likelihood on a grid, all rides together.

    shifts: (rides, p), the parameters of each ride.
    """
    result = dict(start)
    for channel in CHANNELS:
        tables = [(line.tables.get(channel.name), shift) for line, shift in zip(rides, shifts, strict=True)]
        rows = [(table.time, table.y - table.a @ shift) for table, shift in tables if table is not None]
        if not rows:
            continue
        pooled = np.concatenate([rest for _, rest in rows])
        most = MIXED.clipped * (robust_sd(pooled - np.median(pooled)) or float(np.std(pooled)) or 1e-9)
        rows = [(time, np.clip(rest, -most, most)) for time, rest in rows]
        if not channel.correlated:
            white = float(np.sqrt(np.mean(np.concatenate([rest for _, rest in rows]) ** 2)))
            result[channel.name] = ChannelNoise(white, 0.0, channel.noise.time)
            continue
        times = (*(n * channel.block for n in MIXED.noise_blocks), *MIXED.noise_times)
        grid = [
            (q, t)
            for t in times
            for q in MIXED.noise_ratios
            if not channel.slow or (t >= channel.slow and q >= MIXED.least_slow_ratio)
        ]
        ratio, time = (np.array(column) for column in zip(*grid, strict=True))
        count, quadratic, logarithm = len(pooled), np.zeros(len(grid)), np.zeros(len(grid))
        for at, rest in rows:
            innovation, variance = innovations(at, rest, ratio, time)
            quadratic += np.sum(innovation**2 / variance, axis=0)
            logarithm += np.sum(np.log(variance), axis=0)
        i = int(np.argmin(count * np.log(quadratic / count) + logarithm))
        sd = float(np.sqrt(quadratic[i] / count))
        result[channel.name] = ChannelNoise(sd, float(ratio[i]) * sd, float(time[i]))
    return result


# --- without a baseline ---------------------------------------------------------------------------------------------


def without_baseline(mixed: MixedModel, lines: Sequence[LinearRide]) -> MixedModel:
    """`mixed` of a vehicle file alone, to judge the rides `lines` with.

    An effect that its model does not have is taken to be absent. Noise and scatter are those of the very rides, with
    every possible cause free, so that no cause makes them look noisier than they are.
    """
    wide = mixed.widened()
    for _ in range(2):  # parameters and noise in turn
        post = wide.fit(lines)
        wide = replace(wide, noise=learn_noise(lines, post.mean + post.own, wide.noise))
        lines = [line.at_noise(wide.noise) for line in lines]
    scatter = mixed.scatter
    if len(lines) > 2:
        scatter = wide.fit(lines, 1.0, wide.free, 60).scatter
    noise = dict(wide.noise)
    if "cell_voltage_error" in mixed.vehicle.parameters:  # the circuit errs as the file says, and slowly
        white, slow, time = noise["cell_voltage"]
        stated = mixed.vehicle.parameters.sd("cell_voltage_error")
        noise["cell_voltage"] = ChannelNoise(white, max(slow, stated), max(time, MIXED.circuit_time))
    return replace(mixed, noise=noise, scatter=scatter, prior=prior_of_file(mixed))


def prior_of_file(mixed: MixedModel) -> Array:
    """The prior of `mixed` for a vehicle of which no healthy ride is known, (p, p)."""
    known, prior = mixed.vehicle.parameters, mixed.prior.copy()
    for effect in mixed.vehicle.model.effects:
        for parameter in (p for p in effect.parameters if p.bench and p.name in mixed.names):
            (i,) = mixed.index([parameter.name])
            # losses are alike within a make; how a cell's reaction slows is not, and another cell was on the bench
            reaction = effect.port is Port.CELL_VOLTAGE
            own = parameter.prior_sd if reaction else MIXED.make_spread * known[parameter.name]
            prior[i, i] += (own / float(mixed.scale[i])) ** 2
    for name in {"cell_resistance_factor", "cooling_factor"} & set(mixed.names):
        (i,) = mixed.index([name])  # of one cell and one motor on the bench: as sure as declared
        prior[i, i] = (known.sd(name) / float(mixed.scale[i])) ** 2
    for cause in mixed.lacking:
        for parameter in (p for p in cause.parameters if p.name in mixed.names):
            (i,) = mixed.index([parameter.name])
            prior[i, :] = prior[:, i] = 0.0
            prior[i, i] = MIXED.absent**2
            if cause.effect and cause.effect.port is Port.CELL_VOLTAGE:  # every cell has some
                usual = float(np.hypot(parameter.prior, parameter.prior_sd))
                prior[i, i] = (usual / float(mixed.scale[i])) ** 2
    return prior
