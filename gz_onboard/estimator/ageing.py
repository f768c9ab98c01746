"""How the pack has aged: its capacity and its resistance, as factors on what its file says.

**Capacity.** The inverse of the factor, ψ, is a third state beside SOC and e of the filter: SOC' = SOC - ψ·dq with the
charge dq over the file's capacity. What a voltage or a rest says of SOC says of ψ what the covariance of the two has
gathered, dq·var(ψ) with the charge that has passed (joint estimation: Plett 2004, part 3). Two rests with charge
between them are a fit through two points with errors in both (total least squares: Plett 2011), by the variances of
the two and of the count. Filter and ψ are kept apart: given SOC and e, what is expected of ψ is a plane over them, and
an update of the filter moves ψ along it, however the filter makes it.

**Resistance.** Least squares with forgetting of the voltage's quick changes over what the circuit makes of the
current. The tables err by `RESISTANCE_SD` at their place for minutes, whatever the number of samples. It is used once
it has stood for `PROVEN` of load: a current that is doubled looks like half the resistance, and the voltages that would
refute that current must not have been explained by then.

A pack of unknown age holds anything from all of what its file says down to little more than half. A share of the packs
(`Battery.as_new`, half if the file does not say) is taken to be as new. Resistance tells the two apart within minutes:
one that has grown makes less capacity likely, long before any charge has shown it. A healthy pack's voltages confirm
that it is as new soon, so that it is not made wrong; those of an aged one refute it within some tens of per cent of
charge. The interval of the range is wider on the lower side only: no pack is better than new. Nothing is learned while
a sensor is doubted, or where SOC is not known by itself to `TRUSTED`: an age would explain what is none. With one
current sensor its gain and the capacity cannot be told apart, and the factor is that of what the sensor counts; with
two that differ nothing is learned.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from math import inf, isfinite, sqrt

from gz_onboard.constants import BENCH_TEMPERATURE, DECILE
from gz_onboard.estimator.ageing_fit import COMPARED, RESISTANCE, RESISTANCE_MEMORY, Fit, believed
from gz_onboard.estimator.ageing_kinds import RESISTANCE_AGED_SD, Belief, Kinds
from gz_onboard.estimator.ekf import Covariance, SocFilter
from gz_onboard.estimator.saved_fields import FINITE
from gz_onboard.estimator.signals import Signals
from gz_onboard.estimator.sources import CurrentSource, PackReading
from gz_onboard.estimator.uncertainty import RESISTANCE_SD
from gz_onboard.physics.battery import MOST_SOC_SD, QUICK, Battery

CAPACITY = 0.5, 1.1  # factors that a pack at work has
CAPACITY_SD = 0.16  # of ψ, of packs that are not as new
NEW_SD = 0.003, CAPACITY_SD / 2  # of a pack that is as new: whatever the file says, no capacity is known more closely
LEAST_VARIANCE = 0.01**2  # of ψ: the curve's place, and what of an ageing cell is not capacity
KNOWN_VARIANCE = 1e-6  # of ψ, in a saved state: no pack was ever known so closely
LEAST_SPAN, NOTHING = 1e-3, (2.0, -1.0)  # of SOC
CAPACITY_DRIFT = 0.02**2  # of ψ: variance that it gains over as much charge as a pack holds a hundred times
CYCLES = 100.0  # see above
LEAST_SOC = 0.001**2  # variance
MOST_COUNTED = 1.0  # of SOC in one step: a pause of years is no charge
DOUBTED_FROM = 0.05  # of SOC that was counted: over less, no capacity makes a voltage wrong
TRUSTED = 0.03  # of SOC: sd by itself from which the charge that passes tells of the capacity
PLACE_TIME = 600.0  # s for which the tables' place errs the same way
EXCITED = 0.01  # V of a cell: a load that changes its voltage by less shows no resistance
PROVEN, KEPT = 150.0, 5  # s of load; so many times in it what was learned is kept
TOLD = 2 * PROVEN  # s of load before the resistance tells an old pack as well as it can: the range shall not leap
FIRST = 10.0  # s of load before the resistance is more than a guess
AGREEING_RATE = 0.01  # 1/h: two currents that differ by more in the mean, over capacity, show no capacity
APPLIED_EVERY = 10.0  # s
SAME = 1e-6  # relative: the vehicle file says the same as when it was learned

Numbers = list[float] | None


@dataclass(frozen=True)
class Learned:
    """A factor on what the vehicle file says."""

    value: float
    sd: float
    share: float  # 0 nothing is learned, 1 as much as can be


class Ageing:
    """Learns the factors of one pack, and gives them to its `Battery`."""

    def __init__(self, battery: Battery) -> None:
        self._battery = battery
        self._new_sd = min(max(battery.capacity_sd, NEW_SD[0]), NEW_SD[1])  # of ψ, of a pack that is as new
        self._unknown = Kinds(battery.as_new, self._new_sd, CAPACITY_SD).variance
        self.inverse, self.variance = 1.0, self._unknown  # ψ
        self._with_soc = self._with_error = 0.0  # covariances of ψ with SOC and e
        self._learning, self._seen = False, NOTHING
        self._agreeing = AGREEING_RATE * battery.pack_capacity(BENCH_TEMPERATURE)  # A
        self._unknown_resistance = RESISTANCE_AGED_SD * sqrt(1 - battery.as_new)  # sd of it before anything is learned
        self._fit = Fit()
        self._proven = deque([self._fit], KEPT + 1)  # the first is used
        self.belief = self._believe()
        self._unproven = 0.0  # s of load since it was kept
        self._before, self._ride = Fit(), Fit()  # of the rides before this, and of this one until the two are compared
        self._slow = 0.0, 0.0  # V: low-passed drop at a factor of 1, and measured
        self._since = 0.0  # s

    # --- what others ask --------------------------------------------------------------------------------------

    @property
    def capacity(self) -> Learned:
        """What the pack holds over what its file says."""
        factor, sd = 1 / self.belief.inverse, sqrt(self.belief.variance)
        left = min(self.belief.variance, self.variance, self._unknown)
        return Learned(factor, sd * factor * factor, 1 - sqrt(left / self._unknown))

    def energy_sd(self, energy: float, slope: float, soc_sd: float) -> tuple[float, float]:
        """(sd of the energy that is left [J] downwards, upwards), by SOC and capacity, which err together.

        slope: how much more `energy` [J] there would be for more SOC [J].
        """
        belief = self.belief
        by_capacity = energy / belief.inverse
        together = self._with_soc / self.variance  # of SOC, for ψ
        by_itself = max(soc_sd * soc_sd - together * together * belief.variance, 0.0)
        down, up = (
            max(x, self._new_sd * DECILE) / DECILE for x in (belief.high - belief.inverse, belief.inverse - belief.low)
        )
        found = []
        for age_sd in (down, min(up, max(belief.inverse - 1, 0.0) + self._new_sd)):
            found.append(sqrt(slope * slope * by_itself + (age_sd * (by_capacity - slope * together)) ** 2))
        return found[0], found[1]

    @property
    def resistance(self) -> Learned:
        """Of R0, R1 and what effects in the cells take within `QUICK`."""
        sd, unproven = self._resistance_sd(self._fit.time), believed(self._fit.factor) - self._resistance_factor
        share = 1 - self._resistance_sd(self._proven[0].time) / self._unknown_resistance  # of what is used and kept
        return Learned(self._resistance_factor, sqrt(sd * sd + unproven * unproven), share)

    def _resistance_sd(self, time: float) -> float:
        """After so much `time` of load [s]."""
        places = time / (time + FIRST) * (1 + time / PLACE_TIME)
        return 1 / sqrt(1 / self._unknown_resistance**2 + places / RESISTANCE_SD**2)

    @property
    def _resistance_factor(self) -> float:
        return believed(self._proven[0].factor)

    def learned(self) -> dict[str, Learned]:
        """Both, by the names of `snapshot`."""
        return {"capacity": self.capacity, "resistance": self.resistance}

    def state_of_charge(self, filter_: SocFilter) -> tuple[float, float]:
        """(SOC, its sd) with what is believed of the capacity."""
        belief = self.belief
        sd = sqrt(max(filter_.covariance[0] + belief.soc_variance, LEAST_SOC))
        return filter_.soc + belief.soc_shift, min(sd, MOST_SOC_SD)

    def as_believed(self, error: float, own: float, slope: float) -> tuple[float, float]:
        """A voltage's error [V] and the variance of what the filter expects [V²], as the capacity is believed to be.

        slope: of the voltage over SOC [V].
        """
        return error - slope * self.belief.soc_shift, max(own + slope * slope * self.belief.soc_variance, 0.0)

    # --- learning ---------------------------------------------------------------------------------------------

    def part(self, filter_: SocFilter | None = None) -> None:
        """What SOC errs by is no longer that of the charge counted: begin anew, with what is believed of SOC now."""
        if filter_:
            soc, sd = self.state_of_charge(filter_)
            filter_.soc, filter_.covariance = soc, (sd * sd, *filter_.covariance[1:])
        self._with_soc = self._with_error = 0.0
        self._seen = NOTHING
        self.belief = self._believe()

    def resume(self, filter_: SocFilter, counted: tuple[float, float] | None) -> None:
        """A filter was begun after a pause; counted: (SOC, its variance) from before, if that is in it and fits.

        What a rest tells beside it is of the charge until then: a pair of trusted points and the charge between them.
        """
        if counted is None or counted[1] - self._with_soc**2 / self.variance > TRUSTED**2:
            self.part()
            return
        soc, variance = counted
        self._with_error, self._learning = 0.0, True
        self.corrected(filter_, (soc, filter_.error, (variance, 0.0, filter_.covariance[2])))
        self.belief = self._believe()

    def count(self, filter_: SocFilter, before: Covariance, flowed: float) -> None:
        """The filter has counted a share `flowed` of the capacity; `before`: its covariance before."""
        p00, p01, p11 = filter_.covariance
        share = min(max(flowed * self._battery.health.capacity, -MOST_COUNTED), MOST_COUNTED)
        filter_.soc -= (self.inverse - 1 / self._battery.health.capacity) * share
        fade = min(max(p01 / before[1], 0.0), 1.0) if before[1] else 1.0
        with_soc = self._with_soc
        self._with_soc = with_soc - share * self.variance
        self._with_error *= fade
        p00 = max(p00 + share * (share * self.variance - 2 * with_soc), LEAST_SOC)
        filter_.covariance = p00, p01 - share * self._with_error, p11
        self.variance = min(self.variance + CAPACITY_DRIFT / CYCLES * abs(share), self._unknown)

    def corrected(self, filter_: SocFilter, before: tuple[float, float, Covariance]) -> None:
        """The filter has taken in a voltage; `before`: its SOC, e and covariance until then."""
        soc, error, (p00, p01, p11) = before
        n00, n01, n11 = filter_.covariance
        determinant = p00 * p11 - p01 * p01
        if determinant <= 0:
            return
        c0, c1 = self._with_soc, self._with_error
        g0, g1 = (p11 * c0 - p01 * c1) / determinant, (p00 * c1 - p01 * c0) / determinant
        counted, self._with_soc, self._with_error = abs(c0), n00 * g0 + n01 * g1, n01 * g0 + n11 * g1
        if not self._learning:
            return
        less = g0 * g0 * (p00 - n00) + 2 * g0 * g1 * (p01 - n01) + g1 * g1 * (p11 - n11)
        share = self._admitted(less, filter_.soc, counted / self.variance)
        inverse = self.inverse + share * (g0 * (filter_.soc - soc) + g1 * (filter_.error - error))
        self.inverse = min(max(inverse, 1 / CAPACITY[1]), 1 / CAPACITY[0])
        self.variance = max(self.variance - share * less, LEAST_VARIANCE)

    def _admitted(self, less: float, soc: float, counted: float) -> float:
        """The share of what a voltage at `soc` tells that is believed, where it would take `less` off ψ's variance.

        counted: the charge [SOC] that SOC is known by.
        The curve errs the same way each time: between two places of it no number of cycles tells more than that.
        """
        self._seen = min(self._seen[0], soc), max(self._seen[1], soc)
        span = max(self._seen[1] - self._seen[0], counted, LEAST_SPAN)
        curve = self._battery.ocv_sd / self._battery.ocv(soc)[1]
        least = LEAST_VARIANCE + 2 * (curve / span) ** 2
        return min(max(self.variance - least, 0.0) / less, 1.0) if less > 0 else 1.0

    def permit(self, now: float, reading: PackReading, signals: Signals, filter_: SocFilter) -> bool:
        """Learn only if all that it depends on is beyond doubt at `now` [s]; else a sensor's fault may be learned.

        What was counted before is not gone on from. Gives whether the pack has shown to be another one.
        """
        another = self._ride.time >= COMPARED and self._compare_packs(filter_)
        by_itself = filter_.covariance[0] - self._with_soc**2 / self.variance
        if by_itself <= 0:  # SOC was made known from elsewhere
            self.part()
            by_itself = filter_.covariance[0]
        sound = reading.source is CurrentSource.PACK and not reading.voltage_doubted
        known = signals.cell_temperature.fresh(now) and signals.pack_voltage.fresh(now)
        agree = reading.current_apart is None or abs(reading.current_apart) < self._agreeing
        permitted = sound and known and agree and by_itself < TRUSTED**2
        if permitted != self._learning:
            self._learning = permitted
            self.part(filter_)
        return another

    def load(self, dt: float, drop: float, error: float) -> None:
        """A cell's voltage [V] over `dt` [s]: `drop` by the load as predicted, `error` measured less predicted."""
        unit, measured = drop / self._battery.health.resistance, drop - error
        share = min(dt / QUICK, 1.0)
        slow, slow_measured = self._slow
        self._slow = slow + share * (unit - slow), slow_measured + share * (measured - slow_measured)
        quick, quick_measured = unit - slow, measured - slow_measured
        if not self._learning or abs(quick) < EXCITED:
            return
        self._fit = self._fit.after(dt, quick, quick_measured)
        if self._ride.time < COMPARED <= self._before.time:
            self._ride = self._ride.after(dt, quick, quick_measured)
        self._unproven += dt
        if self._unproven >= PROVEN / KEPT:
            self._unproven = 0.0
            self._proven.append(self._fit)

    def _compare_packs(self, filter_: SocFilter) -> bool:
        """Once: if the pack was replaced, its resistance is that of this ride, and of its capacity nothing is known.

        One with more resistance than before is no newer: what was learned counts as much as the prior does. So an aged
        pack that shows more of it on a colder day, or at another place of the curve, is not taken for half a new one.
        """
        before, ride = self._before, self._ride
        self._before, self._ride = Fit(), Fit()
        if not ride.of_another_pack(before):
            return False
        self.part(filter_)
        if ride.factor > before.factor:
            self.variance = max(self.variance, self._unknown / 2)
        else:
            self.inverse, self.variance = 1.0, self._unknown
        self._fit, self._unproven = ride, 0.0
        self._proven = deque([ride], KEPT + 1)
        self.belief = self._believe()
        return True

    def doubt(self, filter_: SocFilter) -> bool:
        """The voltage has contradicted what was counted: the pack may hold another charge than was learned.

        Then SOC errs, too, by ψ's error over the charge that was counted. Gives whether there was anything to doubt.
        """
        counted = -self._with_soc / self.variance
        if not self._learning or abs(counted) < DOUBTED_FROM or self.variance >= self._unknown / 2:
            return False
        p00, p01, p11 = filter_.covariance
        filter_.covariance = p00 + counted**2 * (self._unknown - self.variance), p01, p11
        self._with_soc, self.variance = -counted * self._unknown, self._unknown
        self.belief = self._believe()
        return True

    def unlearn(self) -> None:
        """A sensor was found faulty: the resistance is what it was before, unless that was confirmed."""
        self._ride = Fit()
        if abs(self._fit.factor - self._proven[0].factor) < RESISTANCE_SD:
            return
        self._fit, self._unproven = self._proven[0], 0.0
        self._proven = deque([self._fit], KEPT + 1)

    def apply(self, dt: float) -> bool:
        """Give the battery what was learned, every now and then; gives whether it did."""
        self._since += dt
        if self._since < APPLIED_EVERY:
            return False
        self._since = 0.0
        self.belief = self._believe()
        self._battery.age(1 / self.belief.inverse, self._resistance_factor)
        return True

    def _believe(self) -> Belief:
        kinds = Kinds(self._battery.as_new, self._new_sd, CAPACITY_SD)
        used = self._proven[0]
        told = max(RESISTANCE_SD, self._battery.resistance_sd) * sqrt(1 + TOLD / used.time) if used.time > 0 else inf
        return kinds.belief(self.inverse, self.variance, self._with_soc, (used.factor, told))

    # --- saving -----------------------------------------------------------------------------------------------

    def snapshot(self) -> dict[str, dict[str, float]]:
        """What is to be kept over a restart, by the name of what was learned; of: what the vehicle file says."""
        return {
            "capacity": {
                "of": self._battery.capacity,
                "inverse": self.inverse,
                "variance": self.variance,
                "with_soc": self._with_soc,
            },
            "resistance": {
                "of": self._battery.resistance_factor,
                "factor": self._proven[0].factor,
                "weight": self._proven[0].weight,
                "time": self._proven[0].time,
            },
        }

    def read(self, saved: Mapping[str, Mapping[str, float]]) -> tuple[Numbers, Numbers]:
        """The numbers of a snapshot, of capacity and resistance; None for what it lacks, or is of another pack.

        KeyError, TypeError or ValueError if it holds what cannot be.
        """
        capacity = _numbers(saved.get("capacity"), "inverse", "variance", "with_soc", of=self._battery.capacity)
        resistance = _numbers(saved.get("resistance"), "factor", "weight", "time", of=self._battery.resistance_factor)
        if capacity:
            inverse, variance, with_soc = capacity
            possible = 1 / CAPACITY[1] <= inverse <= 1 / CAPACITY[0] and KNOWN_VARIANCE <= variance <= CAPACITY_SD**2
            if not (possible and with_soc**2 < variance):
                raise ValueError("holds an implausible capacity")
        if resistance:
            factor, weight, time = resistance
            possible = RESISTANCE[0] <= factor <= RESISTANCE[1] and 0 < weight <= RESISTANCE_MEMORY  # of less than 1 V
            if not (possible and 0 <= time <= RESISTANCE_MEMORY):
                raise ValueError("holds an implausible resistance")
        return capacity, resistance

    def restore(self, saved: Mapping[str, Mapping[str, float]]) -> None:
        """Go on from a snapshot; what `read` gives no numbers of is as new. Raises as `read` does, all or nothing."""
        capacity, resistance = self.read(saved)
        if capacity:
            self.inverse, self.variance, self._with_soc = capacity
        if resistance:
            self._fit = self._before = Fit(*resistance)
            self._proven = deque([self._fit], KEPT + 1)
        self.belief = self._believe()
        self._battery.age(1 / self.belief.inverse, self._resistance_factor)


FIELDS = {
    "capacity": dict.fromkeys(("of", "inverse", "variance", "with_soc"), FINITE),
    "resistance": dict.fromkeys(("of", "factor", "weight", "time"), FINITE),
}
"""Of the saved state; `Ageing.read` knows their bounds."""


def _numbers(saved: Mapping[str, float] | None, *names: str, of: float) -> Numbers:
    """The saved numbers `names`; None if there are none, or if they are factors on something else than `of`."""
    if saved is None or not abs(float(saved["of"]) / of - 1) <= SAME:
        return None
    found = [float(saved[name]) for name in names]
    if not all(isfinite(x) for x in found):
        raise ValueError("holds values that are not numbers")
    return found
