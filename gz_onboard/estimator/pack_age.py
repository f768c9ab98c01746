"""Age of a pack: the belief of its capacity and resistance, and when the battery filter may learn them.

The filter's inverse capacity and resistance are normal; packs are not. A share of them (`Battery.as_new`, half if the
file does not say) is as new, the others have lost up to half of their capacity, those with more resistance more of it
(Schuster et al. 2016). So the belief is a mixture of two priors, each weighted by how well it explains the filter's
estimates (Bayes). A healthy pack's voltages soon confirm that it is as new; an aged one shows its resistance within
minutes.

Quick changes of the voltage over those of the predicted drop show the resistance. It is used after `proven_s` of load:
a current that is doubled looks like half the resistance, and the voltages that would refute that current must not have
been explained by then. Nothing is learned while a sensor is doubted. With one current sensor its gain and the capacity
cannot be told apart: the factor is that of the charge which the sensor counts.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from math import erf, exp, log, sqrt
from typing import Any, NamedTuple

from gz_onboard.constants import BENCH_TEMPERATURE, DECILE
from gz_onboard.estimator.battery_filter import Backend, FilterState, with_soc, with_wider_capacity
from gz_onboard.estimator.battery_priors import PRIOR, bounded
from gz_onboard.estimator.plausibility.electrical import CurrentSource, PackReading
from gz_onboard.estimator.saved_state import Number
from gz_onboard.estimator.signals import Signals
from gz_onboard.model.battery import MOST_SOC_SD, QUICK, Battery, Health


@dataclass(frozen=True)
class AgeConfig:
    """Constants of a pack's age; factors on the vehicle file's values."""

    aged_capacity_sd: float = 0.16  # of the inverse capacity, of packs that are not as new
    aged_resistance_sd: float = 0.42  # of the same packs
    aged_correlation: float = 0.8  # of the two: cells of one kind that were aged in many ways
    least_new_sd: float = 0.003  # of a pack that is as new: no capacity is known more closely
    min_capacity_variance: float = 0.01**2  # of the inverse capacity: an ageing cell differs in more than its capacity
    capacity_walk: float = 0.02**2 / 100  # variance that the inverse capacity gains over a whole charge
    resistance_walk: float = 0.03**2  # variance of the resistance over a whole charge: temperature, place on the curve
    quick_noise: float = 0.0035  # V²·s of a cell: quick changes without the load's, 10 mV that stay for 18 s
    excited: float = 0.01  # V: a load that changes the voltage by less shows no resistance
    proven_s: float = 150.0  # of load
    kept: int = 5  # times in it that the resistance is kept
    applied_every_s: float = 10.0
    replaced_pack: float = 1.4  # ratio of resistances: one pack spans up to 1.38 from frost to 43 degC
    agreeing_rate: float = 0.01  # 1/h: two currents that differ by more in the mean show no capacity
    doubted_from: float = 0.05  # of SOC: over less charge no capacity makes a voltage wrong


AGE = AgeConfig()
SAME = 1e-6  # relative: the vehicle file has the same value as when it was learned
FIELDS = {  # of the saved state
    "of": {"capacity": Number(1e-6), "resistance_factor": Number(1e-6)},  # in the vehicle file
    "inverse_capacity": Number(*PRIOR.inverse_capacity_bounds),
    "capacity_variance": Number(1e-6, AGE.aged_capacity_sd**2),
    "capacity_with_soc": Number(-1.0, 1.0),
    "resistance": Number(*PRIOR.resistance_bounds),
    "resistance_variance": Number(1e-6, AGE.aged_resistance_sd**2 + 0.1),
}


@dataclass(frozen=True)
class LearnedFactor:
    """A factor on the vehicle file's value."""

    value: float
    sd: float
    share: float  # 0 nothing is learned, 1 as much as can be


class Belief(NamedTuple):
    """Inverse capacity as it is used, and its effect on the filter's SOC."""

    inverse: float
    variance: float
    soc_shift: float
    soc_variance: float  # besides the filter's; may be negative
    low: float  # P10 of the inverse capacity
    high: float  # P90


def mixture_variance(as_new: float, new_sd: float) -> float:
    """Variance of the inverse capacity of packs of which a share is `as_new`, with their `new_sd`."""
    return as_new * new_sd**2 + (1 - as_new) * AGE.aged_capacity_sd**2


def believe(as_new: float, new_sd: float, state: FilterState, resistance: float, resistance_variance: float) -> Belief:
    """Weigh the two kinds of pack by the filter's inverse capacity and a resistance.

    as_new: share of packs that are as new; new_sd: of their inverse capacity. Less resistance than in the vehicle file
    makes no pack better than new.
    """
    zc, cc = state.covariance[2], state.covariance[7]
    precision = max(1 / cc - 1 / mixture_variance(as_new, new_sd), 0.0)  # information beyond the prior's
    weighted, old_sd = (state.inverse_capacity - 1) / cc, AGE.aged_capacity_sd
    more, aged = max(resistance - 1, 0.0), AGE.aged_resistance_sd**2 + resistance_variance
    gain = AGE.aged_correlation * old_sd * AGE.aged_resistance_sd / aged
    odds = log(as_new / (1 - as_new)) + log(aged / resistance_variance) / 2
    odds += more * more * (1 / aged - 1 / resistance_variance) / 2
    new, new_evidence = _posterior(0.0, new_sd**2, precision, weighted)
    old, old_evidence = _posterior(gain * more, old_sd**2 - gain * gain * aged, precision, weighted)
    share = 1 / (1 + exp(min(max(old_evidence - new_evidence - odds, -50.0), 50.0)))
    kinds = (share, *new), (1 - share, *old)
    lowest, highest = PRIOR.inverse_capacity_bounds
    mean = min(max(sum(p * x for p, x, _ in kinds), lowest - 1), highest - 1)
    variance = sum(p * (sd * sd + (x - mean) ** 2) for p, x, sd in kinds)
    low, high = (1 + _quantile(p, kinds) for p in (0.1, 0.9))
    moves = zc / cc
    shift = moves * (1 + mean - state.inverse_capacity)
    return Belief(1 + mean, variance, shift, moves * moves * (variance - cc), low, high)


def _posterior(mean: float, variance: float, precision: float, weighted: float) -> tuple[tuple[float, float], float]:
    """((mean, sd), logarithm of the evidence) of a normal prior and the likelihood exp(weighted·x - precision·x²/2)."""
    wide = 1 + variance * precision
    fit = 2 * mean * weighted + variance * weighted * weighted - mean * mean * precision
    evidence = fit / (2 * wide) - log(wide) / 2
    return ((mean + variance * weighted) / wide, sqrt(variance / wide)), evidence


def _quantile(share: float, kinds: tuple[tuple[float, float, float], ...]) -> float:
    """Quantile of a mixture of normal distributions (probability, mean, sd), by halving."""
    ends = [mean + (DECILE if share > 0.5 else -DECILE) * sd for _, mean, sd in kinds]
    low, high = min(ends), max(ends)
    for _ in range(30):
        middle = (low + high) / 2
        below = sum(p * (1 + erf((middle - mean) / (sd * sqrt(2)))) / 2 for p, mean, sd in kinds)
        low, high = (middle, high) if below < share else (low, middle)
    return (low + high) / 2


class PackAge:
    """Follows one pack's age: takes the filter's state and returns it. `health`: the age as believed now."""

    def __init__(self, battery: Battery, backend: Backend) -> None:
        self._battery, self._backend = battery, backend
        self._new_sd = min(max(battery.capacity_sd, AGE.least_new_sd), AGE.aged_capacity_sd / 2)
        self._unknown = mixture_variance(battery.as_new, self._new_sd)
        covariance = (PRIOR.unknown_soc_sd**2, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, self._unknown, 0.0)
        self.unknown = FilterState(0.5, 0.0, 1.0, 1.0, (*covariance, AGE.aged_resistance_sd**2))
        self.is_learning = False
        self.reset_voltage_span()
        self._agreeing = AGE.agreeing_rate * battery.pack_capacity(BENCH_TEMPERATURE)  # A
        self._slow = 0.0, 0.0  # V: low-passed drop at a factor of 1, and measured
        self._since = 0.0  # s, since the belief was applied
        self.restart(self.unknown)

    def restart(self, state: FilterState) -> None:
        """Continue from the resistance of a `state` that is proven, and compare that of this ride with it."""
        self._proven = deque([(state.resistance, state.covariance[9])], AGE.kept + 1)  # the first is used
        self._unproven = 0.0  # s of load since one was kept
        self._ride: tuple[float, float] | None = 0.0, 0.0  # sums of products of quick changes [V²·s]; None: compared
        self._before = state.resistance, state.covariance[9]
        self.apply(state)

    # --- the belief -------------------------------------------------------------------------------------------

    def apply(self, state: FilterState) -> None:
        """Form the belief."""
        factor, variance = self._proven[0]
        precision = max(1 / variance - 1 / AGE.aged_resistance_sd**2, 1e-9)
        by_table = max(PRIOR.resistance_sd, self._battery.resistance_sd) ** 2
        self.belief = believe(self._battery.as_new, self._new_sd, state, factor, 1 / precision + by_table)
        change = factor - 1
        # A change that is small against the tables' own error is mostly that error (a Wiener filter).
        resistance = 1 + change**3 / (change**2 + PRIOR.resistance_sd**2)
        # Of the packs that are as new, no resistance is to be learned.
        unknown = (1 - self._battery.as_new) * state.covariance[9]
        self.resistance_sd = sqrt(unknown + (state.resistance - factor) ** 2)
        self.health = Health(1 / self.belief.inverse, resistance)

    def published(self, state: FilterState) -> tuple[float, float]:
        """(SOC, its standard deviation) with the belief of the capacity."""
        sd = sqrt(max(state.covariance[0] + self.belief.soc_variance, 1e-6))
        return state.soc + self.belief.soc_shift, min(sd, MOST_SOC_SD)

    def energy_sd(self, state: FilterState, energy: float, slope: float, soc_sd: float) -> tuple[float, float]:
        """Standard deviations of the energy left [J], downwards and upwards, by SOC and capacity, which err together.

        slope: by how much the `energy` [J] rises with SOC [J]. No pack is better than new: upwards it is narrower.
        """
        belief = self.belief
        by_capacity = energy / belief.inverse
        together = state.covariance[2] / state.covariance[7]  # of SOC, for the inverse capacity
        by_itself = max(soc_sd * soc_sd - together * together * belief.variance, 0.0) * slope * slope
        by_age = by_capacity - slope * together
        down, up = (max(x / DECILE, self._new_sd) for x in (belief.high - belief.inverse, belief.inverse - belief.low))
        up = min(up, max(belief.inverse - 1, 0.0) + self._new_sd)
        return sqrt(by_itself + (down * by_age) ** 2), sqrt(by_itself + (up * by_age) ** 2)

    def learned(self, state: FilterState) -> dict[str, LearnedFactor]:
        """Capacity and resistance over the vehicle file's values, by name."""
        factor, sd = 1 / self.belief.inverse, sqrt(self.belief.variance)
        left = min(self.belief.variance, state.covariance[7], self._unknown)
        known = 1 - sqrt(self._proven[0][1]) / AGE.aged_resistance_sd
        # The filter allows for the tables' error itself; at one place and temperature no ride averages it out.
        unknown = AGE.aged_resistance_sd**2 - state.covariance[9]
        by_table = (1 - self._battery.as_new) * min(PRIOR.resistance_sd**2, max(unknown, 0.0))
        resistance_sd = sqrt(self.resistance_sd**2 + by_table)
        return {
            "capacity": LearnedFactor(factor, sd * factor * factor, 1 - sqrt(left / self._unknown)),
            "resistance": LearnedFactor(self.health.resistance, resistance_sd, max(known, 0.0)),
        }

    # --- learning ---------------------------------------------------------------------------------------------

    def reset_cross_covariance(self, state: FilterState) -> FilterState:
        """Take SOC as it is believed; its error is no longer that of the charge counted so far."""
        soc, sd = self.published(state)
        state = with_soc(state, soc, sd * sd)
        self.reset_voltage_span()
        self.apply(state)
        return state

    def reset_voltage_span(self) -> None:
        """Forget between which places on the curve charge was counted."""
        self._voltage_span = 2.0, -1.0  # lowest and highest SOC at which voltages were used

    def allow_learning(self, now: float, reading: PackReading, signals: Signals, state: FilterState) -> FilterState:
        """Learn only while all that it depends on is beyond doubt: otherwise a sensor's fault would be learned."""
        zz, _, zc, _, _, _, _, cc, _, _ = state.covariance
        by_itself = zz - zc * zc / cc
        sound = reading.source is CurrentSource.PACK and not reading.voltage_doubted
        known = signals.cell_temperature.fresh(now) and signals.pack_voltage.fresh(now)
        agree = reading.current_difference is None or abs(reading.current_difference) < self._agreeing
        permitted = sound and known and agree and by_itself < PRIOR.trusted_soc_sd**2
        if permitted == self.is_learning:
            return state
        self.is_learning = permitted
        return self.reset_cross_covariance(state)

    def min_capacity_variance(self, state: FilterState, soc: float, slope: float) -> float:
        """Variance of the inverse capacity below which a voltage at `soc` tells nothing; slope: of the curve [V].

        The curve errs the same way each time: between two places on it no number of cycles tells more than that.
        """
        if not self.is_learning:
            return float("inf")
        self._voltage_span = min(self._voltage_span[0], soc), max(self._voltage_span[1], soc)
        counted = abs(state.covariance[2]) / state.covariance[7]
        span = max(self._voltage_span[1] - self._voltage_span[0], counted, 1e-3)
        return AGE.min_capacity_variance + 2 * (self._battery.ocv_sd / slope / span) ** 2

    def load(self, state: FilterState, dt: float, drop: float, error: float) -> FilterState:
        """Learn the resistance over `dt` [s] from the `drop` predicted and the `error` measured minus predicted [V]."""
        unit, measured = drop / self.health.resistance, drop - error
        share = min(dt / QUICK, 1.0)
        slow, slow_measured = self._slow
        self._slow = slow + share * (unit - slow), slow_measured + share * (measured - slow_measured)
        quick, quick_measured = unit - slow, measured - slow_measured
        if not dt or not self.is_learning or abs(quick) < AGE.excited:
            return state
        residual = quick_measured - state.resistance * quick
        state = self._backend.condition(state, (0.0, 0.0, quick), residual, AGE.quick_noise / dt, float("inf"))
        state = bounded(state)
        if self._ride:
            square, product = self._ride
            self._ride = square + quick * quick * dt, product + quick * quick_measured * dt
        self._unproven += dt
        if self._unproven >= AGE.proven_s / AGE.kept:
            self._unproven = 0.0
            self._proven.append((state.resistance, state.covariance[9]))
        return state

    def replaced_pack(self, state: FilterState) -> FilterState | None:
        """Compare the resistance of this ride once with that of the rides before; the state of a replaced pack, if so.

        A pack with more resistance than before is no newer: its capacity is known half as well as that of any pack. So
        an aged pack that shows more of it on a colder day is not taken for half a new one.
        """
        table = PRIOR.resistance_sd**2
        if not self._ride or self._ride[0] < AGE.quick_noise / table:
            return None
        (square, product), self._ride = self._ride, None
        low, high = PRIOR.resistance_bounds
        resistance = min(max(product / square, low), high)
        ratio = resistance / self._before[0]
        if self._before[1] > table or 1 / AGE.replaced_pack < ratio < AGE.replaced_pack:
            return None
        state = self.reset_cross_covariance(state)
        inverse, variance = (1.0, self._unknown) if ratio < 1 else (state.inverse_capacity, self._unknown / 2)
        zz, ze, _, _, ee, _, _, cc, _, _ = state.covariance
        covariance = (zz, ze, 0.0, 0.0, ee, 0.0, 0.0, max(cc, variance), 0.0, AGE.quick_noise / square)
        state = state._replace(inverse_capacity=inverse, resistance=resistance, covariance=covariance)
        self.restart(state)
        self._ride = None
        return state

    def doubted(self, state: FilterState) -> FilterState | None:
        """The state with a capacity as of any pack, as the voltage contradicts the count; None if it is no cause."""
        zc, cc = state.covariance[2], state.covariance[7]
        if not self.is_learning or abs(zc) < AGE.doubted_from * cc or cc >= self._unknown / 2:
            return None
        state = with_wider_capacity(state, self._unknown - cc)
        self.apply(state)
        return state

    def unlearn(self, state: FilterState) -> FilterState:
        """Return to the proven resistance, as a sensor was found faulty; small changes may stay."""
        self._ride = None
        factor, variance = self._proven[0]
        if abs(state.resistance - factor) < PRIOR.resistance_sd:
            return state
        self._proven, self._unproven = deque([(factor, variance)], AGE.kept + 1), 0.0
        return state._replace(resistance=factor, covariance=(*state.covariance[:9], variance))

    def follow(self, state: FilterState, dt: float) -> None:
        """Apply the belief every now and then."""
        self._since += dt
        if self._since >= AGE.applied_every_s:
            self._since = 0.0
            self.apply(state)

    # --- saving -----------------------------------------------------------------------------------------------

    def snapshot(self, state: FilterState) -> dict[str, object]:
        """Capacity and resistance to be kept over a restart; of: the vehicle file's values."""
        return {
            "of": {"capacity": self._battery.capacity, "resistance_factor": self._battery.resistance_factor},
            "inverse_capacity": state.inverse_capacity,
            "capacity_variance": state.covariance[7],
            "capacity_with_soc": state.covariance[2],
            "resistance": self._proven[0][0],
            "resistance_variance": self._proven[0][1],
        }

    def restored(self, saved: Mapping[str, Any]) -> FilterState:
        """The state in a saved state, which was checked; as of any pack where the vehicle file has changed since.

        ValueError for a covariance that no filter has.
        """
        learned, unknown = saved["learned"], self.unknown.covariance
        of, inverse, cc, zc = learned["of"], 1.0, unknown[7], 0.0
        if abs(of["capacity"] / self._battery.capacity - 1) < SAME:
            inverse, cc, zc = learned["inverse_capacity"], learned["capacity_variance"], learned["capacity_with_soc"]
        factor, rr = 1.0, unknown[9]
        if abs(of["resistance_factor"] / self._battery.resistance_factor - 1) < SAME:
            factor, rr = learned["resistance"], learned["resistance_variance"]
        zz, ee = saved["soc_variance"], saved["error_variance"]
        if zc * zc > zz * cc:
            raise ValueError("is damaged: state.learned.capacity_with_soc is impossible")
        covariance = (zz, 0.0, zc, 0.0, ee, 0.0, 0.0, cc, 0.0, rr)
        state = FilterState(saved["soc"], 0.0, inverse, factor, covariance, saved["v1"])
        self.restart(state)
        return state
