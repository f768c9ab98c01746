"""Pack current against inverter and auxiliary current; both against the cells' voltage and the road."""

from __future__ import annotations

from math import sqrt

from gz_onboard.estimator.motion import MOTION
from gz_onboard.estimator.redundancy.checks import AGREES, NO_SENSOR, counters, faulty, share_of_new
from gz_onboard.estimator.redundancy.electric import ERROR_LEAST, CellError, CellEvidence, Readings, ResidualComparison
from gz_onboard.estimator.redundancy.sag import VoltageSag
from gz_onboard.events import CURRENTS

FAST_TIME, SKEW_TIME, MEAN_TIME = 0.5, 2.0, 10.0  # s: low passes; the sensors do not sample at the same time
APART, APART_RELATIVE = 0.10, 0.10  # 1/h and 1: two currents that differ by more contradict each other
GROSS, GROSS_RELATIVE = 0.5, 0.3  # the same over `FAST_TIME`
GROSS_ERROR = 0.4  # V of a cell that the cell model leaves, at once
ROAD_TIME, OFF_ROAD, OFF_ROAD_RELATIVE = 30.0, 0.15, 0.7  # s, 1/h, 1: by the road load a current is known to half
TWICE = 2.0  # a current that is off by so many times as much as another is the worse of the two
EXPLAINS = 1 / 4  # of the mean square: a sensor without which so little remains is the one that is wrong
PACK, INVERTER, AUXILIARY = (frozenset({f"{name}_current"}) for name in ("pack", "inverter", "auxiliary"))


class CurrentCheck:
    """Compares once a step; see `Redundancy`."""

    ROLES = CURRENTS

    def __init__(self, capacity: float) -> None:
        self._capacity = capacity  # A·h of the pack
        self.counters = counters(self.ROLES)
        self.there = frozenset(self.ROLES)  # those that the vehicle has: no other is ever faulty
        self.disputed = False  # the two differ, and it is not known which of them is right
        self.sag = VoltageSag()
        self._scaled = False  # both are
        self._residuals, self._from_model = ResidualComparison(), ResidualComparison()
        self._from_road = RoadComparison(capacity)
        self._difference = self._square = self._load = self._without = 0.0  # A, A², A, A²; low-passed
        self._fast = self._extra = 0.0  # A

    def update(self, dt: float, readings: Readings, evidence: CellEvidence) -> frozenset[str]:
        """The roles that are not to be believed now."""
        voltage = readings.inverter_voltage if readings.pack_voltage is None else readings.pack_voltage
        against, agree = NO_SENSOR, None
        self.disputed = False
        if readings.pack is not None and readings.inverter is not None and not readings.charging:
            against, agree = self._compare(dt, readings, voltage, evidence.error)
        if not against and voltage is not None and self._contradicted_by_road(dt, readings, voltage, evidence):
            against, agree = PACK | INVERTER, None
            self.disputed = False
        if self._scaled and not against:
            self._scaled = not self.sag.agrees
            against, agree = PACK | INVERTER, None
        for role in self.ROLES:
            self.counters[role].update(dt, True if role in against & self.there else agree)
        return (against if not self.disputed else NO_SENSOR) | faulty(self.counters)

    def compare_consumption(self, relative: float) -> None:
        """`relative`: the consumption of the last kilometre by the currents, over that of the model."""
        self._scaled |= self.sag.scaled(relative)

    def _compare(
        self, dt: float, readings: Readings, voltage: float | None, error: CellError
    ) -> tuple[frozenset[str], bool | None]:
        """(who is contradicted, whether all agree; None if there is nothing to agree about)."""
        pack, inverter = readings.pack, readings.through_inverter
        assert pack is not None
        assert inverter is not None
        apart, least = APART * self._capacity, min(abs(pack), abs(inverter))
        self._fast += (pack - inverter - self._fast) * min(dt / FAST_TIME, 1.0)
        self._difference += (pack - inverter - self._difference) * min(dt / SKEW_TIME, 1.0)
        extra = 0.0 if readings.auxiliary is None else readings.auxiliary - readings.usual_auxiliary
        self._extra += (extra - self._extra) * min(dt / SKEW_TIME, 1.0)
        share = min(dt / MEAN_TIME, 1.0)
        self._square += (self._difference**2 - self._square) * share
        self._load += (least - self._load) * share
        differ = sqrt(self._square) - APART_RELATIVE * self._load
        gross = abs(self._fast) > GROSS * self._capacity + GROSS_RELATIVE * least
        if differ < apart and not gross:
            self._residuals.forget()
            self._without = self._square
            agree = differ < AGREES * apart and max(abs(pack), abs(inverter)) > apart
            return NO_SENSOR, False if agree else None
        if readings.auxiliary is not None:  # without it all would agree
            self._without += ((self._difference + self._extra) ** 2 - self._without) * share
            allowed = apart + APART_RELATIVE * self._load
            if self._without < min(allowed**2, self._square * EXPLAINS):
                return AUXILIARY, None
        errors = (error(voltage, pack, "pack"), error(voltage, inverter, "inverter")) if voltage else (None, None)
        wrong = self._residuals.update(dt, *errors) or self._wrong_at_rest(readings, pack, inverter)
        if wrong:
            return (PACK, INVERTER)[wrong - 1], None
        known = [role for role in (PACK, INVERTER) if role <= faulty(self.counters)]
        if len(known) == 1:  # nothing new: the one found out before
            return known[0], None
        self.disputed = True
        return PACK | INVERTER, None

    def _wrong_at_rest(self, readings: Readings, pack: float, inverter: float) -> int:
        """1 or 2: which of pack and inverter is wrong at standstill, where only the auxiliary load flows; else 0."""
        if readings.speed is None or abs(readings.speed) >= MOTION.standstill:
            return 0
        off = abs(pack - readings.usual_auxiliary), abs(inverter - readings.usual_auxiliary)
        if max(off) <= TWICE * min(off) + AGREES * (APART * self._capacity):
            return 0
        return 1 if off[0] > off[1] else 2

    def _contradicted_by_road(self, dt: float, readings: Readings, voltage: float, evidence: CellEvidence) -> bool:
        """Whether the cells' voltage and the road both say that the currents are not what flows."""
        pack, inverter = (self.counters[role].faulty for role in self.ROLES[:2])
        instead = readings.pack is None or (pack and not inverter)
        used = readings.through_inverter if instead else readings.pack
        first = None if used is None else evidence.error(voltage, used, "inverter" if instead else "pack")
        if used is None or first is None:
            return False
        gross, explained = abs(first) > GROSS_ERROR, self.sag.explained or readings.charging  # no road charges a pack
        suspicious = gross or pack or inverter or evidence.innovation_rms > ERROR_LEAST  # seldom
        if not suspicious or (explained and not gross):
            self._from_road.forget()
            self._from_model.forget()
            return False
        shown, power = readings.pack_voltage or readings.inverter_voltage, evidence.road_power()
        expected = power / shown if shown and power is not None else None
        second = None if expected is None else evidence.error(voltage, expected, "road")
        if expected is None or second is None:
            return False
        far = abs(used - expected) > OFF_ROAD * self._capacity + TWICE * min(abs(used), abs(expected))
        if gross and abs(first) > TWICE * abs(second) and (far or not explained):
            return True
        if explained:
            return False
        return self._from_road.update(dt, used, expected) & (self._from_model.update(dt, first, second) == 1)


class RoadComparison:
    """How far a current [A] is from that of the road, in the mean and in the mean square."""

    def __init__(self, capacity: float) -> None:
        self._capacity = capacity
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self._time = 0.0
        self._used = self._expected = self._square = self._used_square = self._expected_square = 0.0

    def update(self, dt: float, used: float, expected: float) -> bool:
        """Whether it is further from it than wind, load or slip make it."""
        self._time += dt
        share, slow = (share_of_new(dt, min(self._time, time)) for time in (MEAN_TIME, ROAD_TIME))
        self._used += (used - self._used) * slow
        self._expected += (expected - self._expected) * slow
        self._square += ((used - expected) ** 2 - self._square) * share
        self._used_square += (used * used - self._used_square) * share
        self._expected_square += (expected * expected - self._expected_square) * share
        if self._time < MEAN_TIME:
            return False
        least = OFF_ROAD * self._capacity
        if sqrt(self._square) > least + sqrt(min(self._used_square, self._expected_square)):
            return True
        least += OFF_ROAD_RELATIVE * min(abs(self._used), abs(self._expected))
        return self._time > ROAD_TIME and abs(self._used - self._expected) > least
