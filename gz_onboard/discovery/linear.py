"""The linear mixed model of all channels, and the small matrices that every question is asked of.

About the present parameters θ the residuals of ride r are y = A·(θ_r − θ) + noise, θ_r = μ + u_r: μ common to all
(Laird & Ware 1982), u_r the ride's own with covariance T, learned from healthy rides: that the parameters of a healthy
vehicle seem to differ from ride to ride is the model's discrepancy (Brynjarsdóttir & O'Hagan 2014), and nothing
smaller than it is taken for a cause. Noise is white and exponentially correlated. Of each ride there remain N = AᵀC⁻¹A
and b = AᵀC⁻¹y. All parameters are in units of their scale.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from gz_onboard.arrays import Array, Mask
from gz_onboard.discovery.blocks import blocks, depends, roughness, support, usable
from gz_onboard.discovery.channels import CHANNELS, Channel, ChannelNoise
from gz_onboard.discovery.grid import Ride
from gz_onboard.discovery.prior import stepped
from gz_onboard.discovery.system import System

LEAST_BLOCKS = 10  # of a channel in a ride, to say anything
WHITE = 1e-9  # of the white noise: correlated noise of less is none
TRIMS = 3  # rounds of fitting a ride and trimming it
OUTLYING, KEPT, MOST_TRIMMED = 5.0, 0.95, 0.2
"""Standard deviations of a block that is trimmed; share of a channel that is never; where more would be, nothing is."""
NORMAL = 1.4826  # standard deviation over median absolute deviation of the normal distribution
CLIPPED = 6.0  # robust standard deviations, beyond which a residual counts no more for its noise
RATIOS = (0.0, 0.1, 0.25, 0.5, 1.0, 2.0, 5.0)  # of correlated over white noise, of which the likeliest is taken
BLOCKS, TIMES = (3, 10), (60.0, 200.0, 600.0)  # correlation times likewise, in blocks and in s
SLOW_RATIO = 0.5  # the least of a channel whose noise is known to be slow
Index = NDArray[np.intp] | slice
LEAST, MOST = 0.02, 9.0  # of the variance before, within which the scatter between rides is learned
Noise = dict[str, ChannelNoise]  # by channel


@dataclass(frozen=True)
class LinearChannel:
    """One channel of one ride, linearised: y (m,) [unit], a (m, parameters) [unit per scale], time (m,) [s].

    Both are divided by the blocks' `channels.roughness`.
    """

    channel: Channel
    y: Array
    a: Array
    time: Array
    used: Mask  # of the channel's blocks, which are in y
    factor: float = 1.0  # what y and a were divided by beside
    roughness: Array = field(default_factory=lambda: np.ones(0))  # of all blocks

    @property
    def unit(self) -> Array:
        """What y is to be multiplied with to be in the channel's unit, (m,)."""
        return self.factor * self.roughness[self.used]

    @property
    def touched(self) -> NDArray[np.intp]:
        """Which parameters move it."""
        return np.flatnonzero(np.any(self.a != 0, axis=0))


@dataclass
class LinearRide:
    """A ride, linearised."""

    ride: Ride
    tables: dict[str, LinearChannel]

    def seen_from(self, offset: Array) -> LinearRide:
        """The same, with residuals as they would be at parameters `offset` (p,) before these, were the model linear."""
        return LinearRide(self.ride, {n: replace(t, y=t.y + t.a @ offset) for n, t in self.tables.items()})


def linearise(
    ride: Ride, values: Mapping[str, float], names: Sequence[str], scale: Array, system: System
) -> LinearRide:
    """The residuals of `ride` at `values`, and their columns over `names`, each by a forward difference of `scale`."""
    tables = {}
    for channel in CHANNELS:
        if not usable(channel, ride, system):
            continue
        used = support(channel, ride)
        if used.sum() < LEAST_BLOCKS:
            continue
        mine = depends(channel, system.effects)
        y = blocks(channel, ride, values, system)[used]
        a = np.zeros((len(y), len(names)))
        for i, name in enumerate(names):
            if name in mine:
                moved = {**values, name: stepped(name, values[name], float(scale[i]))}
                a[:, i] = y - blocks(channel, ride, moved, system)[used]
        every = roughness(channel, ride, system)
        y, a = y / every[used], a / every[used][:, None]
        good = np.isfinite(y) & np.isfinite(a).all(axis=1)
        index = np.flatnonzero(used)
        used = used.copy()
        used[index[~good]] = False
        tables[channel.name] = LinearChannel(
            channel, y[good], a[good], np.asarray((index[good] + 0.5) * channel.block), used, 1.0, every
        )
    return LinearRide(ride, tables)


def innovations(times: Array, values: Iterable[Any], ratio: Any, time: Any) -> Iterator[tuple[Any, Any]]:
    """Of `values` at `times` (m,) [s], the innovations of a Kalman filter of white and exponentially correlated noise,
    and their variances over that of the white noise (Anderson & Moore 1979, ch. 9).

    values: numbers or rows. ratio, time [s]: of the correlated noise, its standard deviation over that of the white
    one; floats, or arrays (k,) of as many filters of one series of numbers: each step costs a few operations.
    """
    decays = np.exp(np.divide.outer(-np.diff(times, prepend=times[0]), time))
    power, state = ratio**2, 0.0
    variance = power
    for decay, value in zip(decays if decays.ndim > 1 else decays.tolist(), values, strict=True):
        state = decay * state
        variance = decay * decay * (variance - power) + power
        total = variance + 1
        innovation = value - state
        yield innovation, total
        gain = variance / total
        state = state + gain * innovation
        variance = variance * (1 - gain)


def whitened(table: LinearChannel, noise: ChannelNoise, values: Array) -> Array:
    """`values` (m,) or (m, k) in units of their noise: innovations over their standard deviations."""
    white, slow, time = noise
    if not table.channel.correlated or slow < WHITE * white:
        return np.asarray(values / white)
    every = innovations(table.time, values / white, slow / white, time)
    return np.array([innovation / variance**0.5 for innovation, variance in every]).reshape(values.shape)


def likelihoods(times: Array, rest: Array, ratio: Array, time: Array) -> tuple[Array, Array]:
    """For each pair of `ratio` and `time`, shape (k,), see `innovations`: the sum of squares of `rest` (m,) in units of
    the white noise, and the sum of the logarithms of the innovations' variances.
    """
    quadratic, logarithm = np.zeros(len(ratio)), np.zeros(len(ratio))
    for innovation, variance in innovations(times, rest.tolist(), ratio, time):
        quadratic += innovation * innovation / variance
        logarithm += np.log(variance)
    return quadratic, logarithm


def trimmed(line: LinearRide, noise: Noise, mean: Array, spread: Array) -> LinearRide:
    """`line` without the blocks that no likely parameters of the ride make fit: a wheel that lets go, a current limit
    that cuts in, a gap. mean, spread (p,): of the ride's parameters before, in scales.

    Those beyond five standard deviations, or robust ones where these are larger, three times over (Rousseeuw & Leroy
    1987), with their neighbours; a tenth of a channel at most.
    """
    tables = line.tables
    for _ in range(TRIMS):
        own = likeliest(LinearRide(line.ride, tables), noise, mean, spread)
        tables = {name: _trim(table, noise[name], own) for name, table in line.tables.items()}
    return LinearRide(line.ride, tables)


def likeliest(line: LinearRide, noise: Noise, mean: Array, spread: Array) -> Array:
    """The ride's parameters (p,) in scales, before of `mean` and standard deviations `spread` (p,)."""
    ride = normal(line, noise)
    return np.asarray(mean + np.linalg.solve(np.diag(1 / spread**2) + ride.n, ride.b - ride.n @ mean))


def spread_out(line: LinearRide, noise: Noise, mean: Array, spread: Array) -> LinearRide:
    """`line` with the noise of each channel raised to what this ride shows, where that is more: a ride that no
    parameters make fit counts for less.
    """
    own = likeliest(line, noise, mean, spread)
    tables = {}
    for name, table in line.tables.items():
        rest = whitened(table, noise[name], table.y - table.a @ own)
        factor = max(1.0, float(np.sqrt(np.mean(rest**2))))
        tables[name] = replace(table, y=table.y / factor, a=table.a / factor, factor=factor)
    return LinearRide(line.ride, tables)


def _trim(table: LinearChannel, noise: ChannelNoise, own: Array) -> LinearChannel:
    rest = table.y - table.a @ own
    rest = rest - np.median(rest)
    limit = OUTLYING * max(noise.sd, NORMAL * float(np.median(np.abs(rest))))
    bad = np.abs(rest) > max(limit, float(np.quantile(np.abs(rest), KEPT)))
    bad = bad | np.append(bad[1:], False) | np.insert(bad[:-1], 0, False)
    if not bad.any() or bad.mean() > MOST_TRIMMED:
        return table
    used = table.used.copy()
    used[np.flatnonzero(used)[bad]] = False
    return replace(table, y=table.y[~bad], a=table.a[~bad], time=table.time[~bad], used=used)


@dataclass(frozen=True)
class Normal:
    """N (p, p) and b (p,) of one ride."""

    n: Array
    b: Array

    def padded(self, k: int) -> Normal:
        """The same of `k` parameters more, of which nothing is known yet."""
        return Normal(np.pad(self.n, (0, k)), np.pad(self.b, (0, k)))

    def with_columns(self, table: LinearChannel, noise: ChannelNoise, columns: Array, own: Index) -> Normal:
        """The same with `columns` (m, k) of a channel for the last k parameters; own: where its others are."""
        k = columns.shape[1]
        both = whitened(table, noise, np.column_stack([columns, table.a[:, own], table.y]))
        new, a, y = both[:, :k], both[:, k:-1], both[:, -1]
        n, b = self.n.copy(), self.b.copy()
        n[-k:, -k:] += new.T @ new
        n[-k:, own] += new.T @ a
        n[:-k, -k:] = n[-k:, :-k].T
        b[-k:] += new.T @ y
        return Normal(n, b)


def normal(linear: LinearRide, noise: Noise, only: Sequence[str] | None = None) -> Normal:
    """The normal equations of a ride, over all channels or `only` some."""
    size = next(iter(linear.tables.values())).a.shape[1]
    n, b = np.zeros((size, size)), np.zeros(size)
    for name, table in linear.tables.items():
        if only is not None and name not in only:
            continue
        touched = table.touched
        both = whitened(table, noise[name], np.column_stack([table.a[:, touched], table.y]))
        a, y = both[:, :-1], both[:, -1]
        n[np.ix_(touched, touched)] += a.T @ a
        b[touched] += a.T @ y
    return Normal(n, b)


def marginal(ride: Normal, scatter: Array) -> Normal:
    """The same once the ride's own part, of variances `scatter` (p,), is integrated out."""
    solve = np.linalg.solve(np.eye(len(scatter)) + ride.n * scatter, np.column_stack([ride.n, ride.b]))
    n = solve[:, :-1]
    return Normal(np.asarray((n + n.T) / 2), np.asarray(solve[:, -1]))


@dataclass(frozen=True)
class Population:
    """What is known of all rides, in scales: mean (p,), covariance `prior` (p, p) of what is common to them, variances
    `scatter` (p,) of what is each one's own.
    """

    mean: Array
    prior: Array
    scatter: Array

    def bordered(self, mean: Array, prior: Array, scatter: Array) -> Population:
        """With k more parameters, of which these (k,), (k, k), (k,) are known."""
        both = block_diag(self.prior, prior)
        return Population(np.append(self.mean, mean), both, np.append(self.scatter, scatter))


@dataclass(frozen=True)
class Posterior:
    """mean (p,), covariance (p, p) of the common part; scatter (p,) variances of the rides' own; own (rides, p)."""

    mean: Array
    covariance: Array
    scatter: Array
    own: Array


def fit_mixed(
    rides: Sequence[Normal], known: Population, weight: Array | float = 0.0, free: Mask | None = None, rounds: int = 0
) -> Posterior:
    """Common part, and the scatter between rides in `rounds` of expectation and maximisation (Dempster, Laird & Rubin
    1977); none: it stays.

    known: before, its scatter worth `weight` (p,) rides; only that of `free` (p,) is learned, from `LEAST` to `MOST` of
    what it was.
    """
    before = known.scatter.copy()
    now = known.scatter.copy()
    information = np.linalg.inv(known.prior)
    for _ in range(max(rounds, 1)):
        parts = [marginal(ride, now) for ride in rides]
        after = np.linalg.inv(information + sum(part.n for part in parts))
        common = after @ (information @ known.mean + sum(part.b for part in parts))
        total = weight * before
        own = []
        for ride in rides:
            v = np.linalg.inv(np.diag(1 / now) + ride.n)
            u = v @ (ride.b - ride.n @ common)
            vn = v @ ride.n
            total = total + u**2 + np.diag(v) + np.einsum("ij,jk,ik->i", vn, after, vn)
            own.append(u)
        if free is not None:
            now = np.where(free, np.clip(total / (weight + len(rides)), LEAST * before, MOST * before), before)
    return Posterior(common, after, now, np.array(own))


def learn_noise(rides: Sequence[LinearRide], shifts: Array, start: Noise) -> Noise:
    """White and correlated noise of each channel by maximum likelihood on a grid, all rides together.

    shifts: (rides, p), what each ride's parameters are.
    """
    result = dict(start)
    every = [ride.seen_from(-shift).tables for ride, shift in zip(rides, shifts, strict=True)]
    for channel in CHANNELS:
        rows = [(table, table.y) for tables in every if (table := tables.get(channel.name)) is not None]
        if not rows:
            continue
        pooled = np.concatenate([rest for _, rest in rows])
        spread = float(NORMAL * np.median(np.abs(pooled - np.median(pooled)))) or float(np.std(pooled)) or 1e-9
        rows = [(t, np.clip(rest, -CLIPPED * spread, CLIPPED * spread)) for t, rest in rows]
        if not channel.correlated:
            white = float(np.sqrt(np.mean(np.concatenate([rest for _, rest in rows]) ** 2)))
            result[channel.name] = ChannelNoise(white, 0.0, channel.noise.time)
            continue
        grid = [
            (q, t)
            for t in (*(n * channel.block for n in BLOCKS), *TIMES)
            for q in RATIOS
            if not channel.slow or (t >= channel.slow and q >= SLOW_RATIO)
        ]
        ratio, time = (np.array(column) for column in zip(*grid, strict=True))
        parts = [likelihoods(table.time, rest, ratio, time) for table, rest in rows]
        count = sum(len(rest) for _, rest in rows)
        quadratic = sum((q for q, _ in parts), np.zeros(len(ratio)))
        i = int(np.argmin(count * np.log(quadratic / count) + sum(part[1] for part in parts)))
        sd = float(np.sqrt(quadratic[i] / count))
        result[channel.name] = ChannelNoise(sd, float(ratio[i]) * sd, float(time[i]))
    return result
