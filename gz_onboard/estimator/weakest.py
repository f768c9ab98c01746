"""The weakest group of cells: how it differs from the mean cell, out of the lowest cell's voltage.

The mean cell is that of the battery filter; this slow filter follows the difference to it (bar-delta filtering: Plett
2009, EVS24). Both carry the same current, so that errors of the cell model cancel in their difference,

    V_low - V_mean = U(z - Δ) - U(z) - ρ·drop + b,      Δ = charge + capacity·(1 - z)

with z the mean cell's state of charge, U the open-circuit voltage, and `drop` the mean cell's voltage drop under
load. The state is `charge`, a difference in charge when full, `capacity`, one in capacity, ρ, one in resistance, and
b, the difference of the two sensors. It does not change between measurements: each block of some charge gives one of ρ,
out of how the difference moves with the load within the block, and one of all four, out of its mean.

A block that no group can have had is left out: above the mean, too far below, jumping, or not moving with the load. So
is one that contradicts the belief, which then becomes less certain, for packs are balanced and mended. After many
blocks that no group can have had, or where the pack still delivers though the group would long be empty, the signal is
refused until it makes sense again. The lowest voltage is that of whichever group has it, so a small difference is
mostly the spread of healthy groups: little of it is used.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import hypot, inf, sqrt
from typing import Any

from gz_onboard.estimator.pack_age import SAME, LearnedFactor
from gz_onboard.estimator.plausibility.electrical import CurrentSource, PackReading
from gz_onboard.estimator.saved_state import FINITE, Each, Number
from gz_onboard.estimator.signals import Signals
from gz_onboard.model.battery import Battery, WeakGroup
from gz_onboard.model.parameters import Parameters

NAMES = "weak_charge", "weak_capacity", "weak_resistance"


@dataclass(frozen=True)
class WeakestConfig:
    """Constants of the weakest group; differences of SOC or relative, of four: charge, capacity, resistance, offset."""

    prior_sd: tuple[float, float, float] = (0.03, 0.08, 0.4)  # of packs of which nothing is known; no offset
    lowest: tuple[float, float, float, float] = (-0.05, -0.1, -0.4, -0.2)  # that a pack at work has
    highest: tuple[float, float, float, float] = (0.25, 0.6, 3.0, 0.2)
    channel_sd: float = 0.004  # V: by which channels of one monitor differ
    block: float = 0.0025  # of SOC, that flows in a block at least
    min_samples: int = 5  # in a block
    steady: float = 0.008  # V of a cell: a mean voltage that has moved by less for `steady_s`; monitors are slow
    steady_s: float = 0.9
    max_soc_sd: float = 0.04  # from which the mean cell's place on the curve is known
    level_sd: float = 0.002  # V: of the mean of a block
    slope_sd: float = 0.12  # relative: of the curve's slope at its place
    place: float = 0.03  # of SOC: over which the curve errs the same way
    place_sd: float = 0.005  # of SOC: of the mean cell's place on it
    sample_sd: float = 0.018  # V: of a sample against the load that is seen
    resistance_sd: float = 0.04  # of ρ: resistance in the pack beside the cells, and what one RC pair leaves
    above: float = 0.015  # V: the lowest is not above the mean by more
    jump: float = 0.012  # V: sd within a block beyond what the load explains
    jump_relative: float = 0.1  # of the difference: where it falls fast
    gate: float = 5.0  # sd: a block that is further off is left out
    misfit_sd: float = 0.0007  # of SOC: what such a block adds to what is not known
    walk_sd: float = 0.0005  # of SOC: change of the charge over a block, by leaks, balancing and errors of the curve
    past_empty: float = 0.02  # of SOC, and two sd: a group believed to be emptier while charge flows is no group
    doubt_gain: float = 0.15  # share of the next block in the doubt
    refused_from: float = 0.5  # doubt
    trusted_below: float = 0.02  # doubt
    proven: int = 12  # blocks, before anything is used
    spread: float = 0.008  # of SOC at the end: sd of healthy packs' weakest group
    spread_resistance: float = 0.06  # relative, likewise
    seen_sd: float = 2.0  # of which half is used


CONFIG = WeakestConfig()
CHARGE, CAPACITY, RESISTANCE, OFFSET = range(4)


@dataclass(slots=True)
class VoltageBlock:
    """Sums over the samples of a block: difference d to the mean cell and drop u [V]."""

    began: float = inf  # SOC of the mean cell
    count: int = 0
    d: float = 0.0
    u: float = 0.0
    dd: float = 0.0
    du: float = 0.0
    uu: float = 0.0

    def add(self, lowest: float, mean: float, drop: float) -> None:
        """Take in a sample of voltages [V]."""
        d = lowest - mean
        self.count += 1
        self.d, self.u = self.d + d, self.u + drop
        self.dd, self.du, self.uu = self.dd + d * d, self.du + d * drop, self.uu + drop * drop


@dataclass(frozen=True, slots=True)
class GroupBelief:
    """Means and covariance of charge, capacity, resistance and offset, out of so many blocks."""

    means: tuple[float, ...]
    rows: tuple[tuple[float, ...], ...]
    blocks: int = 0

    def variance(self, slopes: Sequence[float]) -> float:
        """Variance of the state's sum with these `slopes`."""
        return sum(
            p * g * h for row, g in zip(self.rows, slopes, strict=True) for p, h in zip(row, slopes, strict=True)
        )

    def conditioned(self, slopes: Sequence[float], residual: float, noise: float) -> GroupBelief:
        """After a measurement: a Kalman update. slopes: of it over the state; noise: its variance."""
        gains = [sum(p * h for p, h in zip(row, slopes, strict=True)) for row in self.rows]
        total = noise + self.variance(slopes)
        means = (mean + gain / total * residual for mean, gain in zip(self.means, gains, strict=True))
        rows = (
            tuple(p - gain / total * g for p, g in zip(row, gains, strict=True))
            for row, gain in zip(self.rows, gains, strict=True)
        )
        return GroupBelief(tuple(means), tuple(rows), self.blocks + 1)

    def with_wider_charge(self, sd: float) -> GroupBelief:
        """Less certain of the charge by a change of `sd`, but never less than before the first block."""
        (own, *others), *rows = self.rows
        wider = max(min(own + sd**2, CONFIG.prior_sd[CHARGE] ** 2), own)
        return replace(self, rows=((wider, *others), *rows))

    def within_limits(self) -> GroupBelief:
        """With each mean as a pack at work can have it."""
        return replace(self, means=tuple(map(max, CONFIG.lowest, map(min, CONFIG.highest, self.means))))

    def behind(self, gone: float) -> tuple[float, float]:
        """SOC by which the group is behind when `gone` of the mean cell's is drawn, and its standard deviation."""
        variance = self.variance((1.0, gone, 0.0, 0.0))
        return self.means[CHARGE] + self.means[CAPACITY] * gone, sqrt(max(variance, 0.0))

    def sd(self, i: int) -> float:
        """Standard deviation of one quantity."""
        floor = CONFIG.resistance_sd if i == RESISTANCE and self.blocks else 0.0
        return hypot(sqrt(self.rows[i][i]), floor)


class WeakestGroup:
    """Learns the differences of one pack's weakest group. `group`: as it is used; None while too little is known."""

    def __init__(self, battery: Battery, signals: Signals, parameters: Parameters) -> None:
        self._battery, self._signals, self._signal = battery, signals, signals.lowest_cell_voltage
        offset_sd = hypot(parameters.sd("pack_voltage_offset") / battery.cells_series, CONFIG.channel_sd)
        self.mapped = bool(self._signal.stale_after)  # whether the vehicle has the signal
        self._prior_sd = (*CONFIG.prior_sd, offset_sd)
        self._above = CONFIG.above + 2 * offset_sd
        self._seen_at = self._steady_since = -inf  # s
        self._steady_at = inf  # V about which the mean cell's voltage has held since
        self.forget()

    def forget(self) -> None:
        """Start again from the prior: the pack has been replaced."""
        sds = enumerate(self._prior_sd)
        rows = tuple(tuple(sd * sd if i == j else 0.0 for j in range(len(self._prior_sd))) for i, sd in sds)
        self.known = self._undoubted = GroupBelief((0.0,) * len(rows), rows)
        self._block, self._doubt, self.refused = VoltageBlock(), 0.0, False
        self.group: WeakGroup | None = None

    def learned(self) -> dict[str, LearnedFactor]:
        """Charge when full, capacity and resistance of the weakest group over the mean cell's; by `NAMES`."""
        known, holds = self.known, 1 / (1 + self.known.means[CAPACITY])
        factors = 1 - known.means[CHARGE], holds, 1 + known.means[RESISTANCE]
        sds = known.sd(CHARGE), known.sd(CAPACITY) * holds * holds, known.sd(RESISTANCE)
        shares = (max(1 - known.sd(i) / sd, 0.0) for i, sd in enumerate(CONFIG.prior_sd))
        return {name: LearnedFactor(*x) for name, *x in zip(NAMES, factors, sds, shares, strict=True)}

    def _used(self) -> WeakGroup | None:
        """The group as used; a difference that is small against its sd and healthy groups' spread counts little."""
        known = self.known
        if known.blocks < CONFIG.proven:
            return None
        full, end = known.behind(0.0), known.behind(1.0)  # it may be clear from full on, or only at the end
        share = max(_trusted(max(behind, 0.0), hypot(sd, CONFIG.spread)) for behind, sd in (full, end))
        more = max(known.means[RESISTANCE], 0.0)
        more *= _trusted(more, hypot(known.sd(RESISTANCE), CONFIG.spread_resistance))
        sd = hypot(share * end[1], (1 - share) * max(end[0], 0.0))
        return WeakGroup(share * known.means[CHARGE], share * known.means[CAPACITY], more, sd)

    # --- learning ---------------------------------------------------------------------------------------------

    def step(
        self,
        now: float,
        reading: PackReading,
        temperature: float,
        battery: Battery,
        soc: tuple[float, float],
        overpotential: float,
    ) -> None:
        """Learn from the window that ends at `now` [s]; temperature: of the cells [degC].

        battery: with its age. soc: of the mean cell, and its sd; overpotential: beyond the drop over its R0 [V].
        """
        if reading.voltage is None or reading.current is None:
            return
        signals = self._signals
        is_new, self._seen_at = self._signal.time > self._seen_at, self._signal.time
        mean = battery.cell_voltage(reading.voltage, reading.current)
        if abs(mean - self._steady_at) > CONFIG.steady:
            self._steady_at, self._steady_since = mean, now
        sound = reading.source is CurrentSource.PACK and not reading.voltage_doubted
        sound = sound and signals.cell_temperature.fresh(now) and signals.pack_voltage.fresh(now)
        if not is_new or not sound or now - self._steady_since < CONFIG.steady_s:
            return
        place, sd = soc
        current = reading.current / battery.cells_parallel
        if sd > CONFIG.max_soc_sd or current < 0:  # while charging the lowest is another group
            return
        if not -CONFIG.block < self._block.began - place < CONFIG.place:  # the first, after a charge, or a new SOC
            self._block = VoltageBlock(place)
        drop = battery.r0.at(place, temperature)[0] * current + overpotential
        self._block.add(self._signal.value, mean, drop)
        if self._block.began - place >= CONFIG.block and self._block.count >= CONFIG.min_samples:
            block, self._block = self._block, VoltageBlock(place)
            self.take(block, (block.began + place) / 2)

    def take(self, block: VoltageBlock, soc: float) -> None:
        """Learn from a whole block about this `soc` of the mean cell, if it can be true."""
        learned = self._learned_from(block, soc)
        self._doubt += CONFIG.doubt_gain * ((learned is None) - self._doubt)
        if self._doubt > CONFIG.refused_from and not self.refused:
            self.refused, self.known = True, self._undoubted
        self.refused = self.refused and self._doubt > CONFIG.trusted_below
        if learned and not self.refused:
            self.known = learned
        behind, sd = self.known.behind(1 - soc)
        if self.known.blocks >= CONFIG.proven and soc - behind + 2 * sd < -CONFIG.past_empty:
            self.forget()
            self.refused, self._doubt = True, 1.0
        if self._doubt < CONFIG.trusted_below:
            self._undoubted = self.known
        self.group = self._used()

    def _learned_from(self, block: VoltageBlock, soc: float) -> GroupBelief | None:
        """The belief after a block; None if no group can have had such voltages."""
        config, n = CONFIG, block.count
        mean, drop = block.d / n, block.u / n
        # Sums of the products of deviations from the means [V²].
        dd, du, uu = block.dd - mean * block.d, block.du - mean * block.u, block.uu - drop * block.u
        unexplained = max(dd - du * du / uu, 0.0) if uu > 0 else dd
        noise = config.sample_sd**2 * max(uu, 1e-12)  # V⁴, of the block's response to the load
        if unexplained > (config.jump + config.jump_relative * abs(mean)) ** 2 * n:
            return None
        known = self.known.conditioned((0.0, 0.0, uu, 0.0), -du - self.known.means[RESISTANCE] * uu, noise)
        alone = mean + known.means[RESISTANCE] * drop  # what the difference would be without load
        follows = config.lowest[RESISTANCE] < known.means[RESISTANCE] < config.highest[RESISTANCE]
        if not follows or not self._behind(soc, config.highest[CHARGE]) - self._above < alone < self._above:
            return None
        behind, _ = known.behind(1 - soc)
        predicted, slope = self._behind(soc, behind), self._battery.ocv(soc - behind)[1]
        curve = hypot(config.slope_sd * predicted, config.place_sd * (slope - self._battery.ocv(soc)[1]))
        noise = config.level_sd**2 + curve**2 + (config.resistance_sd * drop) ** 2
        slopes = -slope, -slope * (1 - soc), -drop, 1.0
        residual = alone - predicted - known.means[OFFSET]
        if residual**2 > config.gate**2 * (noise + known.variance(slopes)):
            return self.known.with_wider_charge(config.misfit_sd)
        known = known.with_wider_charge(config.walk_sd)
        learned = known.conditioned(slopes, residual, noise * config.place / config.block).within_limits()
        return replace(learned, blocks=self.known.blocks + 1)

    def _behind(self, soc: float, by: float) -> float:
        """By how much the open-circuit voltage is higher [V] where it is `by` behind `soc`."""
        return self._battery.ocv(soc - by)[0] - self._battery.ocv(soc)[0]

    # --- saving -----------------------------------------------------------------------------------------------

    def snapshot(self) -> dict[str, Any]:
        """The belief, to be kept over a restart; of: the capacity in the vehicle file."""
        known = self.known
        return {"of": self._battery.capacity, "means": known.means, "rows": known.rows, "blocks": known.blocks}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Continue from a snapshot, which was checked, unless it is of another pack. ValueError if it cannot be."""
        if abs(saved["of"] / self._battery.capacity - 1) > SAME:
            return
        found = GroupBelief(tuple(saved["means"]), tuple(map(tuple, saved["rows"])), int(saved["blocks"]))
        rows, most = found.rows, 1.001  # of rounding
        fits = [len(found.means), *map(len, rows)] == [4] * 5 and found.within_limits() == found
        for i, row in enumerate(rows if fits else ()):
            fits &= 0 < row[i] <= most * self.known.rows[i][i]
            fits &= all(p * p <= most * row[i] * rows[j][j] for j, p in enumerate(row))
        if not fits:
            raise ValueError("holds an implausible weakest group")
        self.known = self._undoubted = found
        self.group = self._used()


# Of the saved state; `WeakestGroup.restore` knows their bounds.
FIELDS = {"of": FINITE, "means": Each(FINITE, 4), "rows": Each(Each(FINITE, 4), 4), "blocks": Number(0.0)}


def _trusted(difference: float, sd: float) -> float:
    """The share that is used of a difference: a sixteenth of one sd, half of `seen_sd`, nearly all of many."""
    return difference**4 / (difference**4 + (CONFIG.seen_sd * sd) ** 4)
