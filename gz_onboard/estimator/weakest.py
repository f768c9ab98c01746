"""The weakest group of cells: by how much it differs from the mean cell, out of the lowest cell's voltage.

The mean cell is that of the filter; small slow filters follow the difference to it (bar-delta filtering: Plett 2009,
EVS24). Both carry the same current, so that what the cell model errs by cancels in the difference of their voltages,

    V_low - V_mean = U(z - Δ) - U(z) - ρ·drop + b,      Δ = charge + faster·(1 - z)

with z the mean cell's state of charge, U the open-circuit voltage, and `drop` what the load takes from the mean cell's
voltage. `charge` is a difference in charge when full, `faster` one in capacity, ρ one in resistance, and b what the two
sensors differ by. As the difference follows from z alone, nothing is to be predicted between two measurements: each
block of some charge gives one. Within a block the difference moves with the load by ρ, pooled over blocks by least
squares; what there is without load goes into a filter of (charge, faster, b).

The curve's slope errs by `SLOPE_SD` at its place, however many blocks lie there. Without charge that flows no block
ends. The lowest voltage is that of whichever group has it: the difference is that of the lower edge of them all. A
small difference is mostly the spread of healthy groups: of it little is used.

A signal that no group can have is refused, and what was learned from it: above the mean, further below than
`MOST_BEHIND`, held while the pack's voltage moves, jumping; or the pack goes on when the group would long be empty. A
block that only contradicts what is known is left out, and makes what is known less certain, for packs are balanced and
mended.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import hypot, inf, isfinite, sqrt
from typing import Any

from gz_onboard.estimator.ageing import SAME, Learned
from gz_onboard.estimator.joint import Joint
from gz_onboard.estimator.saved_fields import FINITE, Each
from gz_onboard.estimator.signals import Signals
from gz_onboard.estimator.soc import StateOfCharge
from gz_onboard.estimator.sources import CurrentSource, PackReading
from gz_onboard.physics.battery import Battery, WeakGroup
from gz_onboard.physics.parameters import Parameters

CHARGE, CAPACITY, RESISTANCE = (-0.05, 0.25), (-0.1, 0.6), (-0.4, 3.0)  # differences that a pack at work has
CHARGE_SD, CAPACITY_SD, RESISTANCE_SD = 0.03, 0.08, 0.4  # of packs of which nothing is known
EDGE_SD = 0.004  # V: by how much channels of one monitor differ, and the lowest of many that are noisy from their mean
LEAST_SD = 0.002  # V: of what a block says
SLOPE_SD = 0.12  # relative: of the curve's slope at its place
PLACE, PLACE_SD = 0.03, 0.005  # of SOC: over which the curve errs the same way; of the mean cell's place on it
BLOCK, FEWEST = 0.0025, 5  # of SOC that flows in a block, at least; samples in one
STEADY, HOLDS = 0.008, 0.9  # V of a cell, s: a voltage that moves by less for so long; monitors are slow, and late
KNOWN_SD = 0.04  # of SOC: sd from which the mean cell's place on the curve is known
LOAD_WEIGHT = 0.002  # V²: what no difference in resistance counts beside the load that is seen
LOAD_MEMORY = 300.0  # blocks
LOAD_SD = 0.04  # of ρ: resistance in the pack beside the cells, and what one RC pair leaves
MOST_BEHIND = 0.25  # of SOC
ABOVE = 0.015  # V: the lowest is not above the mean by more
JUMPS, FALLS = 0.012, 0.1  # V: sd within a block beyond what the load explains; of the difference: where it falls fast
HELD = 0.03  # V: by so much the mean moves while the lowest holds one value
PAST = 0.02  # of SOC, beside two sd: a group that is believed to be emptier, while charge flows, is no group
GATE = 5.0  # sd: a block that is further off is left out
MISFIT_SD = 0.0007  # of SOC: what such a block adds to what is not known
TELLING = 0.35  # of SOC: nearer to empty a low voltage is possible, whatever it is
DOUBT, DOUBTED, TRUSTED = 0.15, 0.5, 0.02  # share of the next block; of refused blocks: from which, until which
PROVEN = 12  # blocks before anything is used
KEPT = 40  # blocks above `TELLING` without a doubt: then what is learned is kept
SEEN = 2.0  # sd
SPREAD, SPREAD_RESISTANCE = 0.008, 0.06  # sd of healthy packs' weakest group: of SOC at the end; relative
DRIFT = 0.01 / 20  # of SOC: sd that the difference in charge gains over sqrt(blocks), by leaks and balancing
ROUNDED, MOST_OFFSET = 1.001, 20.0  # of a saved state: of a variance; sd
NAMES = "weak_charge", "weak_capacity", "weak_resistance"


@dataclass(slots=True)
class Block:
    """Sums over the samples of a block: difference d and drop u [V], SOC of the mean cell."""

    began: float = inf  # SOC
    count: int = 0
    d: float = 0.0
    u: float = 0.0
    dd: float = 0.0
    du: float = 0.0
    uu: float = 0.0
    soc: float = 0.0
    lowest: tuple[float, float] = (inf, -inf)  # V: least and most of the signal
    mean: tuple[float, float] = (inf, -inf)  # V: likewise of the mean cell

    def add(self, lowest: float, mean: float, drop: float, soc: float) -> None:
        """Take in a sample."""
        d = lowest - mean
        self.count += 1
        self.d, self.u, self.soc = self.d + d, self.u + drop, self.soc + soc
        self.dd, self.du, self.uu = self.dd + d * d, self.du + d * drop, self.uu + drop * drop
        self.lowest = min(self.lowest[0], lowest), max(self.lowest[1], lowest)
        self.mean = min(self.mean[0], mean), max(self.mean[1], mean)

    @property
    def scatter(self) -> tuple[float, float, float]:
        """Sums of the squares about the means [V²]: dd, du, uu."""
        n = self.count
        return self.dd - self.d * self.d / n, self.du - self.d * self.u / n, self.uu - self.u * self.u / n


@dataclass(slots=True)
class Differences:
    """What is known: charge, capacity and offset; of the resistance, sums over the load [V²]; from how many blocks."""

    joint: Joint
    load: float = 0.0
    response: float = 0.0
    blocks: int = 0

    def copy(self) -> Differences:
        """Another of its own."""
        return Differences(self.joint.copy(), self.load, self.response, self.blocks)

    @property
    def resistance(self) -> float:
        """ρ, as seen."""
        return min(max(-self.response / (self.load + LOAD_WEIGHT), RESISTANCE[0]), RESISTANCE[1])

    @property
    def resistance_sd(self) -> float:
        """Of ρ."""
        return hypot(RESISTANCE_SD * LOAD_WEIGHT / (self.load + LOAD_WEIGHT), LOAD_SD if self.load else 0.0)


class Weakest:
    """Learns the differences of one pack's weakest group, and gives them to its `Battery`."""

    def __init__(self, battery: Battery, signals: Signals, parameters: Parameters) -> None:
        self._battery, self._signals, self._signal = battery, signals, signals.lowest_cell_voltage
        offset = hypot(parameters.sd("pack_voltage_offset") / battery.cells_series, EDGE_SD)
        self._unknown = (CHARGE_SD**2, CAPACITY_SD**2, offset**2)
        self._above = ABOVE + 2 * offset
        self.known = self._new()
        self._kept, self._sound = self._new(), 0  # what to go back to; blocks without a doubt since
        self._block = Block()
        self._held, self._since = inf, inf  # V about which the mean cell's voltage has held, s: since when
        self._then = -inf  # s: when the pack's voltage came last
        self._doubt = 0.0
        self.refused = False

    @property
    def mapped(self) -> bool:
        """Whether the vehicle has the signal."""
        return bool(self._signal.stale_after)

    def _new(self) -> Differences:
        return Differences(Joint((0.0, 0.0, 0.0), self._unknown))

    # --- what others ask --------------------------------------------------------------------------------------

    def learned(self) -> dict[str, Learned]:
        """Of the weakest group over the mean cell: charge when that is full, capacity, resistance; by `NAMES`."""
        known = self.known
        charge, faster, _ = known.joint.means
        sds = [sqrt(known.joint.variance(i)) for i in range(2)]
        shares = [max(1 - sd / sqrt(unknown), 0.0) for sd, unknown in zip(sds, self._unknown, strict=False)]
        rest = known.resistance_sd
        holds = 1 / (1 + faster)
        found = (
            Learned(1 - charge, sds[0], shares[0]),
            Learned(holds, sds[1] * holds * holds, shares[1]),
            Learned(1 + known.resistance, rest, max(1 - rest / RESISTANCE_SD, 0.0)),
        )
        return dict(zip(NAMES, found, strict=True))

    def believed(self) -> WeakGroup | None:
        """What is used: of a difference that is small beside its sd and healthy groups' spread next to nothing."""
        known = self.known
        if known.blocks < PROVEN:
            return None
        charge, faster, _ = known.joint.means
        (v00, _, _), (v10, v11, _), _ = known.joint.rows
        behind, variance = max(charge + faster, 0.0), v00 + 2 * v10 + v11  # at the end
        seen = (charge, v00), (behind, variance)  # that there is one may be clear from full on, or only at the end
        share = max(trusted(max(x, 0.0), own + SPREAD**2) for x, own in seen)
        more = max(known.resistance, 0.0)
        more *= trusted(more, known.resistance_sd**2 + SPREAD_RESISTANCE**2)
        return WeakGroup(share * charge, share * faster, more, sd=hypot(share * sqrt(variance), (1 - share) * behind))

    # --- learning ---------------------------------------------------------------------------------------------

    def step(self, now: float, reading: PackReading, temperature: float, soc: StateOfCharge) -> None:
        """Take in what came since the last step, at `now` [s]; temperature: of the cells [degC]."""
        signal = self._signal
        if soc.another_pack:
            self._begin_anew()
        if not self.mapped or not self._signals.pack_voltage.count:
            return
        new, self._then = signal.time > self._then, now  # between two of the pack's voltages
        if reading.voltage is None or reading.current is None or soc.filter is None:
            self._held = inf
            return
        battery = self._battery
        mean = battery.cell_voltage(reading.voltage, reading.current)
        if abs(mean - self._held) > STEADY:
            self._held, self._since = mean, now
        if not new or now - self._since < HOLDS or not self._permitted(now, reading):
            return
        place, sd = soc.ageing.state_of_charge(soc.filter)
        current = reading.current / battery.cells_parallel
        if sd > KNOWN_SD or current < 0:  # of a charge the lowest is another group
            return
        if not -BLOCK < self._block.began - place < PLACE:  # the first, after a charge, or of another state of charge
            self._block = Block(place)
        drop = battery.r0.at(place, temperature)[0] * current + soc.effects.overpotential + soc.filter.v1
        self._block.add(signal.value, mean, drop, place)
        block = self._block
        if block.began - place >= BLOCK and block.count >= FEWEST:
            self._block = Block(place)
            self.take(block)

    def _begin_anew(self) -> None:
        """Nothing is known: the pack is another one."""
        self.known, self._kept, self._block = self._new(), self._new(), Block()
        self._sound, self._doubt, self.refused = 0, 0.0, False
        self._battery.weaken(None)

    def _permitted(self, now: float, reading: PackReading) -> bool:
        """Whether all else that the learning depends on is beyond doubt."""
        sound = reading.source is CurrentSource.PACK and not reading.voltage_doubted
        signals = self._signals
        return sound and signals.cell_temperature.fresh(now) and signals.pack_voltage.fresh(now)

    def take(self, block: Block) -> None:
        """Learn from a whole block, if it can be true."""
        possible, telling = self._possible(block), block.began > TELLING
        if telling or not possible:
            self._doubt += DOUBT * ((not possible) - self._doubt)
        if self._doubt > DOUBTED and not self.refused:
            self.refused = True
            self.known, self._sound = self._kept.copy(), 0
        self.refused = self.refused and self._doubt > TRUSTED
        if self._past_its_end(block):
            self.refused, self._doubt, self._sound = True, 1.0, 0
            self.known, self._kept = self._new(), self._new()
        if possible and not self.refused:
            self._learn(block)
            self._sound += telling
        if self._sound >= KEPT and self._doubt < TRUSTED:
            self._kept, self._sound = self.known.copy(), 0
        self._battery.weaken(self.believed())

    def _past_its_end(self, block: Block) -> bool:
        """Whether the pack goes on where its weakest group would long be empty by what is known of it."""
        gone = 1 - block.soc / block.count
        charge, faster, _ = self.known.joint.means
        (v00, _, _), (v10, v11, _), _ = self.known.joint.rows
        sd = sqrt(max(v00 + gone * (2 * v10 + gone * v11), 0.0))
        return self.known.blocks >= PROVEN and 1 - gone - charge - faster * gone + 2 * sd < -PAST

    def _possible(self, block: Block) -> bool:
        """Whether any group can have had such voltages."""
        dd, du, uu = block.scatter
        left = max(dd - du * du / uu, 0.0) if uu > 0 else dd
        held = block.lowest[0] == block.lowest[1] and block.mean[1] - block.mean[0] > HELD
        jumps = JUMPS + FALLS * abs(block.d) / block.count
        if held or left > jumps**2 * block.count:
            return False
        slope = (self.known.response + du) / (self.known.load + uu + LOAD_WEIGHT)
        if not RESISTANCE[0] < -slope < RESISTANCE[1]:
            return False
        soc, alone = block.soc / block.count, (block.d - slope * block.u) / block.count
        lowest = self._behind(soc, MOST_BEHIND) - self._above
        return lowest < alone < self._above

    def _behind(self, soc: float, by: float) -> float:
        """By how much the open-circuit voltage is higher [V] where it is `by` behind `soc`."""
        return self._battery.ocv(soc - by)[0] - self._battery.ocv(soc)[0]

    def _learn(self, block: Block) -> None:
        known, n = self.known, block.count
        _, du, uu = block.scatter
        fade = 1 - 1 / LOAD_MEMORY
        known.load, known.response = fade * known.load + uu, fade * known.response + du
        soc, drop = block.soc / n, block.u / n
        joint = known.joint
        charge, faster, offset = joint.means
        behind = charge + faster * (1 - soc)
        predicted = self._behind(soc, behind)
        slope = self._battery.ocv(soc - behind)[1]
        residual = (block.d + known.resistance * block.u) / n - predicted - offset
        steeper = slope - self._battery.ocv(soc)[1]
        curve = (SLOPE_SD * predicted) ** 2 + (PLACE_SD * steeper) ** 2
        noise = LEAST_SD**2 + curve + (known.resistance_sd * drop) ** 2
        noise *= PLACE / BLOCK
        slopes = (-slope, -slope * (1 - soc), 1.0)
        gains = [sum(p * h for p, h in zip(row, slopes, strict=True)) for row in joint.rows]
        if residual**2 > GATE**2 * (noise * BLOCK / PLACE + sum(g * h for g, h in zip(gains, slopes, strict=True))):
            joint.widen(0, MISFIT_SD**2, CHARGE_SD**2)
            return
        joint.widen(0, DRIFT**2, CHARGE_SD**2)
        joint.update(slopes, residual, noise, GATE)
        joint.means[0] = min(max(joint.means[0], CHARGE[0]), CHARGE[1])
        joint.means[1] = min(max(joint.means[1], CAPACITY[0]), CAPACITY[1])
        known.blocks += 1

    # --- saving -----------------------------------------------------------------------------------------------

    def snapshot(self) -> dict[str, Any]:
        """What is to be kept over a restart; of: what the vehicle file says."""
        return {"of": self._battery.capacity, "known": _numbers(self.known), "kept": _numbers(self._kept)}

    def read(self, saved: Mapping[str, Any] | None) -> tuple[Differences, Differences]:
        """What a snapshot holds: nothing learned if there is none, or if it is of another pack.

        Gives what is known, and what to go back to. KeyError, TypeError or ValueError if it holds what cannot be.
        """
        if saved is None or not abs(float(saved["of"]) / self._battery.capacity - 1) <= SAME:
            return self._new(), self._new()
        return self._read(saved["known"]), self._read(saved["kept"])

    def _read(self, saved: Mapping[str, Any]) -> Differences:
        joint = self._new().joint.restored(saved["means"], saved["rows"])
        load, response, blocks = float(saved["load"]), float(saved["response"]), int(saved["blocks"])
        if not (isfinite(load + response) and load >= 0 and blocks >= 0):
            raise ValueError("holds an impossible weakest group")
        charge, faster, offset = joint.means
        known = all(0 < joint.variance(i) <= most * ROUNDED for i, most in enumerate(self._unknown))
        plausible = CHARGE[0] <= charge <= CHARGE[1] and CAPACITY[0] <= faster <= CAPACITY[1]
        if not (known and plausible and abs(offset) <= MOST_OFFSET * sqrt(self._unknown[2])):
            raise ValueError("holds an implausible weakest group")
        return Differences(joint, load, response, blocks)

    def take_on(self, saved: tuple[Differences, Differences]) -> None:
        """Go on from what `read` gave."""
        self.known, kept = saved
        # Once something was learned where a lie shows, one that begins elsewhere contradicts it and is left out.
        self._kept = self.known.copy() if kept.blocks >= PROVEN else kept
        self._battery.weaken(self.believed())


_COUNTS = dict.fromkeys(("load", "response", "blocks"), FINITE)
_DIFFERENCES = {"means": Each(FINITE, 3), "rows": Each(FINITE, 6), **_COUNTS}
FIELDS = {"of": FINITE, "known": _DIFFERENCES, "kept": _DIFFERENCES}
"""Of the saved state; `Weakest.read` knows their bounds."""


def _numbers(of: Differences) -> dict[str, Any]:
    return {**of.joint.snapshot(), "load": of.load, "response": of.response, "blocks": of.blocks}


def trusted(difference: float, variance: float) -> float:
    """The share that is used of a difference: a sixteenth of one sd, half of `SEEN` sd, nearly all of many."""
    ratio = difference**4
    return ratio / (ratio + (SEEN**2 * variance) ** 2)
