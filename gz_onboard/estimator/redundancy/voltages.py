"""Pack voltage against the inverter's, and both against what a cell can have."""

from __future__ import annotations

from math import sqrt

from gz_onboard.estimator.redundancy.checks import AGREES, counters, faulty, share_of_new
from gz_onboard.estimator.redundancy.electric import CellError, CellEvidence, Readings, ResidualComparison
from gz_onboard.estimator.redundancy.skew import SkewedPair
from gz_onboard.events import VOLTAGES
from gz_onboard.physics.battery import Battery

MEAN_TIME, APART, GROSS = 10.0, 0.07, 0.3  # s, V, V at once
LINK_TIME = 1.0  # s: an inverter that is being charged or discharges moves by more in it than half of `USUAL`
USUAL = 0.02  # V: sensors that do not sample at the same time, on the rides
MODEL_TIME = 300.0  # s of agreement over which it is seen how well the cell model follows both
AGREED_BEFORE = 30.0  # s: two voltages that agreed so long knew the state of charge, and one of them left it
STUCK_AFTER, STUCK_CURRENT = 5.0, 0.5  # s of one voltage; 1/h: a current that varies by more moves it
LOWEST, HIGHEST = 0.6, 1.12  # of the cut-off voltage, of that of a full cell at rest


class VoltageCheck:
    """Compares once a step; see `Redundancy`."""

    ROLES = VOLTAGES

    def __init__(self, battery: Battery, capacity: float) -> None:
        self._series = battery.cells_series
        self._lowest, self._highest = LOWEST * battery.cutoff_voltage, HIGHEST * battery.ocv_value[-1]
        self._capacity = capacity  # A·h of the pack
        self.counters = counters(self.ROLES)
        self.apart = 0.0  # V of a cell: by how much the two differ while it is not known which is right, else 0
        self._residuals = ResidualComparison()
        self._link: float | None = None  # V, of the inverter, low-passed
        self._square = self._compared = 0.0  # V² of a cell, low-passed; s of it
        self._beyond = 0.0  # V², the same of what is no difference of the times that they are of
        self._pair = SkewedPair()
        self._model = 0.0  # V²: mean square of what the cell model leaves of two that agree
        self._agreed = 0.0  # s
        self._last, self._still = 0.0, 0.0  # V; s without a change
        self._least = self._most = 0.0  # A, since the pack voltage has not changed

    def update(self, dt: float, readings: Readings, current: float | None, evidence: CellEvidence) -> frozenset[str]:
        """The roles that are not to be believed now, at this `current` [A] of the pack."""
        pack, inverter = readings.pack_voltage, readings.inverter_voltage
        if inverter is not None and self._disconnected(dt, inverter, readings):
            inverter = None
            self._square = self._beyond = self._compared = 0.0
            self._pair = SkewedPair()
        against = {
            role
            for role, voltage in zip(self.ROLES, (pack, inverter), strict=True)
            if voltage is not None and not self._lowest < voltage / self._series < self._highest
        }
        if pack is not None and current is not None and self._stuck(dt, pack, current):
            against.add("pack_voltage")
        differ: bool | None = False
        self.apart = 0.0
        usual = USUAL * self._series
        beyond = None if against else self._pair.update(dt, pack, inverter, readings.voltages_apart, usual)
        if not against and pack is not None and inverter is not None:
            differ = self._differ(dt, (pack - inverter) / self._series, beyond, evidence)
            if differ:
                against |= self._wrong(dt, pack, inverter, current, evidence.error)
                self.apart = 0.0 if against else abs(pack - inverter) / self._series
        agree = None if differ else differ
        for (role, counter), voltage in zip(self.counters.items(), (pack, inverter), strict=True):
            counter.update(dt, True if role in against or self.apart else None if voltage is None else agree)
        return frozenset(against if self.apart else against | faulty(self.counters))

    def _differ(self, dt: float, difference: float, beyond: float | None, evidence: CellEvidence) -> bool | None:
        """Whether two sensors differ, and not only the times that their values are of; None: not enough to say.

        difference: of their latest values [V of a cell]; beyond: see `SkewedPair` [V of the pack].
        """
        self._compared = min(self._compared + dt, MEAN_TIME)
        self._square += (difference * difference - self._square) * share_of_new(dt, self._compared)
        if beyond is None:
            return None
        beyond = min(beyond / self._series, GROSS)
        self._beyond += (beyond * beyond - self._beyond) * share_of_new(dt, MEAN_TIME)
        if self._beyond >= APART**2 or beyond >= GROSS:
            return True
        self._agreed += dt
        self._model += (evidence.innovation_rms**2 - self._model) * share_of_new(dt, min(self._agreed, MODEL_TIME))
        self._residuals.forget()
        return None if self._beyond > (AGREES * APART) ** 2 else False

    @property
    def spread(self) -> float:
        """By how much the two differ beyond what is usual [V of a cell]: no better is either of them known."""
        return max(sqrt(self._square) - USUAL, 0.0)

    def _disconnected(self, dt: float, voltage: float, readings: Readings) -> bool:
        """Whether the inverter's voltage is that of its own capacitors."""
        link = voltage if self._link is None else self._link
        self._link = link + (voltage - link) * share_of_new(dt, LINK_TIME)
        moves = abs(voltage - self._link) > USUAL / 2 * self._series
        off = voltage < self._lowest * self._series
        return readings.pack_voltage is not None and (moves or off) and readings.unconnected(APART * self._series)

    def _wrong(
        self, dt: float, pack: float, inverter: float, current: float | None, error: CellError
    ) -> frozenset[str]:
        """Which of two that differ is wrong; nothing while that is not known.

        A cell model that did not follow both while they agreed is no witness: what is wrong then is the model.
        """
        wrong = 0
        if current is not None and self._agreed > AGREED_BEFORE:
            errors = error(pack, current, "chosen"), error(inverter, current, "chosen")
            wrong = self._residuals.update(dt, *errors, self._model)
        known = faulty(self.counters)
        return frozenset({self.ROLES[wrong - 1]}) if wrong else known if len(known) == 1 else frozenset()

    def _stuck(self, dt: float, voltage: float, current: float) -> bool:
        """It is the same to the last bit while the current says that it must move."""
        if voltage != self._last:
            self._last, self._still = voltage, 0.0
            self._least = self._most = current
            return False
        self._still += dt
        self._least, self._most = min(self._least, current), max(self._most, current)
        return self._still > STUCK_AFTER and self._most - self._least > STUCK_CURRENT * self._capacity
