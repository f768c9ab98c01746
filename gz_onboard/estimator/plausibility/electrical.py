"""Currents and voltages of pack and inverter against each other, the cells' voltage and the road.

Chooses the voltage and current that the battery filter receives.
"""

from __future__ import annotations

from collections.abc import Callable
from math import hypot, inf, isinf, sqrt
from typing import NamedTuple

from gz_onboard.constants import BENCH_TEMPERATURE
from gz_onboard.estimator.plausibility.residual import (
    CONFIG,
    NO_SENSOR,
    FaultCounter,
    ResidualTest,
    UnchangedTimer,
    faulty,
    isolate,
    share_of_new,
)
from gz_onboard.estimator.signals import Signal, Signals
from gz_onboard.estimator.sources import CurrentSource, PackReading
from gz_onboard.events import CURRENTS, VOLTAGES
from gz_onboard.physics.battery import HALF_FULL, Battery
from gz_onboard.physics.parameters import Parameters
from gz_onboard.physics.sensors import true_current, true_voltage

PACK, INVERTER, AUXILIARY = (frozenset({role}) for role in CURRENTS)
BOTH = PACK | INVERTER

CellError = Callable[[float, float, str], float | None]
"""Measured minus predicted voltage of a cell [V], for a voltage [V] and a current [A] of the pack; whose current."""


class CellEvidence(NamedTuple):
    """What the models know of the pack's current and voltage."""

    error: CellError
    road_power: Callable[[], float | None]  # W of the pack; None while the motion is unknown
    innovation_rms: float  # V per cell, of the last ten seconds


class Currents(NamedTuple):
    """Currents of one step [A], None where silent; currents are positive when discharging."""

    pack: float | None
    inverter: float | None  # alone
    auxiliary: float | None
    usual_auxiliary: float
    standing: bool

    @property
    def through_inverter(self) -> float | None:
        """Current of the pack by the inverter's and the auxiliary one [A]."""
        auxiliary = self.usual_auxiliary if self.auxiliary is None else self.auxiliary
        return None if self.inverter is None else self.inverter + auxiliary

    @property
    def charging(self) -> bool:
        """Whether a charger may supply current, which does not pass the inverter."""
        return self.standing and self.pack is not None and self.pack < 0


class VoltageSag:
    """Regression of the changes of a cell's voltage on those that the current explains by the resistance."""

    def __init__(self) -> None:
        self._voltage: float | None = None  # V of a cell, low-passed
        self._drop = 0.0  # V, low-passed
        self._product = self._square = self._volts = 0.0  # V²·s

    def update(self, dt: float, voltage: float, drop: float) -> None:
        """Add the voltage of a cell and the drop that the current explains [V], `dt` [s] after the last."""
        if self._voltage is None or dt > CONFIG.sag_fast_s:  # what came between is unknown
            self._voltage, self._drop = voltage, drop
            return
        change, explained = voltage - self._voltage, drop - self._drop
        share, keep = share_of_new(dt, CONFIG.sag_fast_s), 1 - share_of_new(dt, CONFIG.sag_time_s)
        self._voltage += change * share
        self._drop += explained * share
        self._product = keep * self._product - change * explained * dt
        self._square = keep * self._square + explained * explained * dt
        self._volts = keep * self._volts + change * change * dt

    @property
    def ratio(self) -> float | None:
        """Measured over predicted sag; None while the current has hardly changed."""
        return self._product / self._square if self._square > CONFIG.sag_least_v2s else None

    @property
    def explained(self) -> bool:
        """Whether the current is the cause of the changes of the voltage, and of about their size."""
        if self.ratio is None or not CONFIG.sag_low < self.ratio < CONFIG.sag_high:
            return False
        return self._product * self.ratio > CONFIG.sag_explained_share * self._volts

    def contradicts(self, consumption: float) -> bool:
        """Whether all currents are scaled. `consumption`: by them, over that of the model.

        Neither an aged pack nor a frugal rider is a fault; only both together are.
        """
        if self.ratio is None:
            return False
        low, high = 1 / CONFIG.scaled_consumption, CONFIG.scaled_consumption
        too_small, too_large = self.ratio > CONFIG.sag_high, self.ratio < CONFIG.sag_low
        return (too_small and consumption < low) or (too_large and consumption > high)


class PackSensors:
    """Corrects and checks the electrical sensors and chooses the pack's voltage and current."""

    def __init__(self, signals: Signals, battery: Battery, parameters: Parameters) -> None:
        self._signals, self._parameters, self._series = signals, dict(parameters), battery.cells_series
        self._capacity = battery.pack_capacity(BENCH_TEMPERATURE)  # Ah
        self._voltage_sd = parameters.sd("pack_voltage_offset") / self._series
        self._usual_voltage = battery.ocv(HALF_FULL)[0] * self._series
        self._lowest = CONFIG.lowest_voltage_ratio * battery.cutoff_voltage
        self._highest = CONFIG.highest_voltage_ratio * battery.ocv_value[-1]
        self.counters = {role: FaultCounter() for role in signals.mapped((*VOLTAGES, *CURRENTS))}
        time, skew = CONFIG.electrical_time_s, CONFIG.current_skew_s
        # Currents [A]
        self.sag = VoltageSag()
        self._are_scaled = self._currents_disputed = False
        self.current_difference = ResidualTest(skew, time)  # pack less inverter and auxiliary
        self._usual_auxiliary = ResidualTest(skew, time)  # the same with the usual auxiliary load
        self._load = ResidualTest(skew)
        self._by_cells = {source: ResidualTest(0.0, time) for source in ("pack", "inverter", "road")}
        self._by_road = {source: ResidualTest(skew, skew) for source in ("pack", "inverter")}
        self._offset = ResidualTest(CONFIG.current_offset_time_s)  # pack less inverter and auxiliary
        self._compared = -inf  # s, when the two were compared last
        # Voltages [V per cell]
        self.voltage_dispute = 0.0  # difference of the two while nothing decides
        self._voltage_difference = ResidualTest(0.0, time)
        self._voltages_by_cells = ResidualTest(0.0, time), ResidualTest(0.0, time)
        self._model = ResidualTest(CONFIG.cell_model_time_s)  # mean square error of the cell model
        self._last: tuple[float, float] | None = None
        self._moved = 0.0
        self._unchanged = UnchangedTimer()
        self._current_range = (inf, -inf)  # A, since the pack voltage has changed

    def compare_consumption(self, relative: float) -> None:
        """Take in the consumption of the last kilometre by the currents, over that of the model."""
        self._are_scaled |= self.sag.contradicts(relative)

    def read(self, now: float, dt: float, speed: float | None, evidence: CellEvidence) -> PackReading:
        """Best voltage and current of this step of `dt` [s], at a `speed` [m/s]."""
        signals, parameters = self._signals, self._parameters
        voltage, inverter = signals.pack_voltage.reported(now), signals.inverter_voltage.reported(now)
        pack = signals.pack_current.reported(now)
        any_voltage = voltage if voltage is not None else inverter
        readings = Currents(
            None if pack is None else true_current(pack, parameters),
            signals.inverter_current.reported(now),
            signals.auxiliary_current.reported(now),
            parameters["auxiliary_power"] / (any_voltage or self._usual_voltage),
            abs(speed or 0.0) < CONFIG.standstill_m_s,
        )
        current, source = self._choose_current(dt, readings, any_voltage, evidence)
        if voltage is not None:
            voltage = true_voltage(voltage, parameters)
        if inverter is not None:
            inverter += parameters["cable_resistance"] * (current or 0.0)
        distrusted = self._check_voltages(dt, voltage, inverter, current, readings, evidence)
        for role in VOLTAGES:
            signals[role].trusted = role not in distrusted
        if self.voltage_dispute and voltage is not None and inverter is not None:
            voltage = (voltage + inverter) / 2
        elif voltage is None or not signals.pack_voltage.trusted:
            voltage = inverter if signals.inverter_voltage.trusted else None
        unproven = max(sqrt(self._voltage_difference.square) - CONFIG.agreeing_residual, 0.0)
        both = signals.pack_current.fresh(now) and signals.inverter_current.fresh(now)
        return PackReading(
            voltage,
            current,
            source,
            readings.through_inverter if readings.pack is None else readings.pack,
            hypot(self._voltage_sd, self.voltage_dispute, CONFIG.voltage_sd_v * unproven),
            self._offset.difference if both and now - self._compared < CONFIG.current_offset_time_s else None,
            bool(self.voltage_dispute or faulty(self.counters) & set(VOLTAGES)),
        )

    def _choose_current(
        self, dt: float, readings: Currents, voltage: float | None, evidence: CellEvidence
    ) -> tuple[float | None, CurrentSource]:
        """(current of the pack [A], where it comes from); None if no sensor is believed."""
        signals = self._signals
        comparable = not readings.charging and together(signals.pack_current, signals.inverter_current)
        distrusted = self._check_currents(dt, readings, voltage, evidence, comparable)
        for role in CURRENTS:
            signals[role].trusted = role not in distrusted
        if not signals.auxiliary_current.trusted:
            readings = readings._replace(auxiliary=None)
        pack, inverter = readings.pack, readings.through_inverter
        if pack is not None and inverter is not None:
            if self._currents_disputed:
                return (pack + inverter) / 2, CurrentSource.DISPUTED
            if comparable and not distrusted:
                self._offset.update(dt, pack - inverter)
                self._compared = signals.pack_current.time
        if pack is not None and signals.pack_current.trusted:
            return pack, CurrentSource.PACK
        if inverter is not None and signals.inverter_current.trusted:
            return inverter, CurrentSource.INVERTER
        return None, CurrentSource.NONE

    def _check_currents(
        self, dt: float, readings: Currents, voltage: float | None, evidence: CellEvidence, comparable: bool
    ) -> frozenset[str]:
        """Roles of currents to leave out now."""
        pack, inverter = readings.pack, readings.through_inverter
        bad = faulty(self.counters) & BOTH
        differ, agree, against = False, None, NO_SENSOR
        if comparable and pack is not None and inverter is not None and readings.inverter is not None:
            least = CONFIG.current_sd_rate * self._capacity
            self._load.update(dt, min(abs(pack), abs(inverter)))
            sd = least + CONFIG.current_sd_relative * self._load.difference
            self.current_difference.update(dt, pack - inverter, sd)
            self._usual_auxiliary.update(dt, pack - readings.inverter - readings.usual_auxiliary, sd)
            differ = self.current_difference.contradicts
            flows = max(abs(pack), abs(inverter)) > least
            agree = False if flows and self.current_difference.agrees else None
        used = "inverter" if pack is None or bad == PACK else "pack"
        self._weigh(dt, used, {"pack": pack, "inverter": inverter}, voltage, readings, differ, evidence)
        by_cells, by_road = ({s: test.square for s, test in tests.items()} for tests in (self._by_cells, self._by_road))
        self._currents_disputed = False
        if differ and self._usual_auxiliary.square < min(1.0, self.current_difference.square / 4):
            against = AUXILIARY
        elif differ:
            wrong = isolate(by_cells["pack"], by_cells["inverter"]) or isolate(by_road["pack"], by_road["inverter"])
            self._currents_disputed = not wrong and len(bad) != 1  # else the sensor found out before explains it
            against = (PACK, INVERTER)[wrong - 1] if wrong else BOTH if self._currents_disputed else bad
        elif self._by_road[used].contradicts and isolate(by_cells[used], by_cells["road"]) == 1:
            against = BOTH
        elif self._are_scaled:
            self._are_scaled = not self.sag.explained
            against = BOTH
        weight = CONFIG.dispute_weight if self._currents_disputed else 1.0
        for role in self.counters.keys() & set(CURRENTS):
            self.counters[role].update(weight * dt, True if role in against else None if against else agree)
        return (NO_SENSOR if self._currents_disputed else against) | faulty(self.counters)

    def _weigh(
        self,
        dt: float,
        used: str,
        currents: dict[str, float | None],
        voltage: float | None,
        readings: Currents,
        differ: bool,
        evidence: CellEvidence,
    ) -> None:
        """Test the currents [A] by source against the cells and the road load, if there is reason to doubt them."""
        current = currents[used]
        error = evidence.error(voltage, current, used) if voltage and current is not None else None
        doubted = differ
        if error is not None and not readings.charging:  # no road charges a pack
            unexplained = not self.sag.explained and evidence.innovation_rms > CONFIG.cell_sd_v
            doubted |= unexplained or abs(error) > CONFIG.gross_cell_error_v
        if not doubted or not voltage:
            for test in (*self._by_cells.values(), *self._by_road.values()):
                test.restart()
            return
        power = evidence.road_power()
        expected = None if power is None else power / voltage
        for source, current in (*currents.items(), ("road", expected)):
            error = None if current is None else evidence.error(voltage, current, source)
            if error is not None:
                self._by_cells[source].update(dt, error, CONFIG.cell_sd_v)
            if current is not None and expected is not None and source != "road":
                sd = CONFIG.idle_rate * self._capacity + CONFIG.road_sd_relative * abs(expected)
                self._by_road[source].update(dt, current - expected, sd)

    def _check_voltages(
        self,
        dt: float,
        pack: float | None,
        inverter: float | None,
        current: float | None,
        readings: Currents,
        evidence: CellEvidence,
    ) -> frozenset[str]:
        """Roles of voltages [V] to leave out now, at this current [A] of the pack."""
        measured = {r: v / self._series for r, v in zip(VOLTAGES, (pack, inverter), strict=True) if v is not None}
        against = {role for role, voltage in measured.items() if not self._lowest < voltage < self._highest}
        if pack is not None and current is not None and self._is_stuck(dt, pack, current):
            against.add("pack_voltage")
        self.voltage_dispute, agree = 0.0, None if against else False
        if len(measured) == 2 and not against and self._comparable_voltages(readings, *measured.values()):
            differ = self._follow_voltages(dt, *measured.values())
            agree = False if self._voltage_difference.agrees else None
            if differ:
                against |= self._isolate_voltage(dt, (pack or 0.0, inverter or 0.0), current, evidence.error)
                self.voltage_dispute = 0.0 if against else abs(self._voltage_difference.difference)
            else:
                self._model.update(dt, evidence.innovation_rms**2)
                for test in self._voltages_by_cells:
                    test.restart()
        else:
            self._last = None
        for role in self.counters.keys() & set(VOLTAGES):
            if self.voltage_dispute:
                self.counters[role].update(CONFIG.dispute_weight * dt, True)
            else:
                self.counters[role].update(dt, True if role in against else agree if role in measured else None)
        return frozenset(against) if self.voltage_dispute else faulty(self.counters) | against

    def _comparable_voltages(self, readings: Currents, pack: float, inverter: float) -> bool:
        """Whether voltages [V per cell] come together, of an inverter that is connected and not in its precharge."""
        idle = readings.inverter is None or abs(readings.inverter) <= readings.usual_auxiliary
        disconnected = readings.standing and idle and inverter < pack - CONFIG.voltage_sd_v
        return not disconnected and together(self._signals.pack_voltage, self._signals.inverter_voltage)

    def _follow_voltages(self, dt: float, pack: float, inverter: float) -> bool:
        """Whether two voltages [V per cell] differ by more than one of them moves before the other is sampled."""
        last, self._last = self._last or (pack, inverter), (pack, inverter)
        moved = max(abs(pack - last[0]), abs(inverter - last[1]))
        self._moved = max(moved, self._moved * (1 - share_of_new(dt, CONFIG.voltage_skew_s)))
        self._voltage_difference.update(dt, pack - inverter, CONFIG.voltage_sd_v + self._moved)
        return self._voltage_difference.contradicts

    def _isolate_voltage(
        self, dt: float, voltages: tuple[float, float], current: float | None, error: CellError
    ) -> frozenset[str]:
        """Which of two voltages [V] the cells contradict, or was found out before; none while nothing decides."""
        # What the cell model could not follow while the two agreed is no evidence.
        usual = sqrt(CONFIG.isolating_ratio * self._model.difference)
        if current is not None and self._model.seen > CONFIG.settled_after_s:
            for test, voltage in zip(self._voltages_by_cells, voltages, strict=True):
                test.update(dt, error(voltage, current, "chosen") or 0.0, max(CONFIG.cell_sd_v, usual))
        wrong, known = (
            isolate(*(test.square for test in self._voltages_by_cells)),
            faulty(self.counters) & set(VOLTAGES),
        )
        return frozenset({VOLTAGES[wrong - 1]}) if wrong else known if len(known) == 1 else NO_SENSOR

    def _is_stuck(self, dt: float, voltage: float, current: float) -> bool:
        """Whether the pack voltage [V] is the same to the last bit while the current [A] must move it."""
        still = self._unchanged.update(dt, voltage)
        low, high = self._current_range if still else (current, current)
        self._current_range = min(low, current), max(high, current)
        return still > CONFIG.slowly_stuck_s and high - low > CONFIG.stuck_voltage_rate * self._capacity


def together(first: Signal, second: Signal) -> bool:
    """Whether two sensors report at about the same time, or one of them never did."""
    return isinf(first.time + second.time) or abs(first.time - second.time) <= CONFIG.coarse_s
