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
    faulty,
    isolate,
    share_of_new,
)
from gz_onboard.estimator.signals import TIMING, Signal, Signals
from gz_onboard.estimator.sources import CurrentSource, PackReading
from gz_onboard.events import CURRENTS, VOLTAGES
from gz_onboard.physics.battery import HALF_FULL, Battery
from gz_onboard.physics.parameters import Parameters
from gz_onboard.physics.sensors import true_current, true_voltage

PACK, INVERTER, AUXILIARY = (frozenset({role}) for role in CURRENTS)
BOTH, ROAD = PACK | INVERTER, "road"
SOURCES = dict(zip(CURRENTS, (CurrentSource.PACK, CurrentSource.INVERTER), strict=False))

CellError = Callable[[float, float, str], float | None]
"""Measured minus predicted voltage of a cell [V], for a voltage [V] and a current [A] of the pack; whose current."""


class CellEvidence(NamedTuple):
    """Evidence of the cell model and the road load about the pack's current and voltage."""

    error: CellError
    road_power: Callable[[], float | None]  # W of the pack; None while the motion is unknown
    innovation_rms: float  # V per cell, of the last ten seconds


class VoltageSag:
    """Regression of the changes of a cell's voltage on those that the current explains by the resistance."""

    def __init__(self) -> None:
        self._voltage: float | None = None  # V of a cell, low-passed
        self._drop = 0.0  # V, low-passed
        self._product = self._square = self._volts = 0.0  # V²·s

    def update(self, dt: float, voltage: float, drop: float) -> None:
        """Add the voltage of a cell and the drop that the current explains [V], `dt` [s] after the last."""
        if self._voltage is None or dt > 2 * CONFIG.sag_fast_s:  # after a gap
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


class PackSensors:
    """Corrects and checks the electrical sensors and chooses the pack's voltage and current."""

    def __init__(self, signals: Signals, battery: Battery, parameters: Parameters) -> None:
        self._signals, self._parameters, self._series = signals, dict(parameters), battery.cells_series
        self._capacity = battery.pack_capacity(BENCH_TEMPERATURE)  # Ah
        self._voltage_sd = parameters.sd("pack_voltage_offset") / self._series
        self._usual_voltage = battery.ocv(HALF_FULL)[0] * self._series
        self._lowest = CONFIG.lowest_voltage_ratio * battery.cutoff_voltage
        self._highest = CONFIG.highest_voltage_ratio * battery.ocv_curve.y[-1]
        self.counters = {role: FaultCounter() for role in signals.mapped((*VOLTAGES, *CURRENTS))}
        self.sag = VoltageSag()
        time, skew = CONFIG.electrical_time_s, CONFIG.current_skew_s
        self.current_difference = ResidualTest(skew, time)  # A, pack minus inverter and auxiliary
        self._usual_auxiliary = ResidualTest(skew, time)  # A, the same with the usual auxiliary load
        self._by_cells = {source: ResidualTest(0.0, time) for source in (*VOLTAGES, *CURRENTS[:2], ROAD)}
        self._by_road = {source: ResidualTest(skew, skew) for source in CURRENTS[:2]}
        self._offset = ResidualTest(CONFIG.current_offset_time_s)  # A, pack minus inverter and auxiliary
        self._compared = -inf  # s, when the two were compared last
        self.voltage_dispute = 0.0  # V per cell by which the two differ while nothing decides
        self._voltage_difference = ResidualTest(0.0, time)  # V per cell
        self._model = ResidualTest(CONFIG.cell_model_time_s)  # mean square error of the cell model [V²]
        self._last: tuple[float, float] | None = None  # V per cell, pack and inverter
        self._moved = 0.0  # V per cell, of late

    def read(self, now: float, dt: float, speed: float | None, evidence: CellEvidence) -> PackReading:
        """Best voltage and current of this step of `dt` [s], at a `speed` [m/s]."""
        signals, parameters = self._signals, self._parameters
        voltage, inverter_voltage = signals.pack_voltage.reported, signals.inverter_voltage.reported
        pack, inverter = signals.pack_current.reported, signals.inverter_current.reported
        auxiliary = signals.auxiliary_current.reported
        any_voltage = inverter_voltage if voltage is None else voltage
        usual = parameters["auxiliary_power"] / (any_voltage or self._usual_voltage)
        extra = 0.0 if auxiliary is None else auxiliary - usual
        standing = abs(speed or 0.0) < CONFIG.standstill_m_s
        currents: dict[str, float] = {}  # of the pack [A], by sensor
        if pack is not None:
            currents["pack_current"] = true_current(pack, parameters)
        if inverter is not None:
            currents["inverter_current"] = inverter + usual + extra
        charging = standing and currents.get("pack_current", 0.0) < 0  # by a current that does not pass the inverter
        comparable = len(currents) == 2 and not charging
        comparable = comparable and together(signals.pack_current, signals.inverter_current)
        differ = comparable and self._compare_currents(dt, currents, extra)
        self._weigh_currents(dt, currents, any_voltage, differ, charging, evidence)
        current, source = self._choose_current(dt, currents, differ, comparable, extra)

        voltages = {} if voltage is None else {"pack_voltage": true_voltage(voltage, parameters)}
        if inverter_voltage is not None:
            voltages["inverter_voltage"] = inverter_voltage + parameters["cable_resistance"] * (current or 0.0)
        idle = standing and (inverter is None or abs(inverter) <= usual)
        chosen = self._choose_voltage(dt, voltages, current, idle, evidence)
        # Beyond agreement, neither voltage is known better than the residual of the two [sd].
        unproven = max(sqrt(self._voltage_difference.square) - CONFIG.agreeing_residual, 0.0)
        both = signals.pack_current.fresh(now) and signals.inverter_current.fresh(now)
        return PackReading(
            chosen,
            current,
            source,
            next(iter(currents.values()), None),
            hypot(self._voltage_sd, self.voltage_dispute, CONFIG.voltage_sd_v * unproven),
            self._offset.difference if both and now - self._compared < CONFIG.current_offset_time_s else None,
            bool(self.voltage_dispute or faulty(self.counters) & set(VOLTAGES)),
        )

    def _compare_currents(self, dt: float, currents: dict[str, float], extra: float) -> bool:
        """Whether the two currents of the pack [A] differ; extra: auxiliary current beyond the usual one [A]."""
        pack, inverter = currents.values()
        sd = CONFIG.current_sd_rate * self._capacity + CONFIG.current_sd_relative * min(abs(pack), abs(inverter))
        self.current_difference.update(dt, pack - inverter, sd)
        self._usual_auxiliary.update(dt, pack - inverter + extra, sd)
        return self.current_difference.contradicts

    def _weigh_currents(
        self,
        dt: float,
        currents: dict[str, float],
        voltage: float | None,
        differ: bool,
        charging: bool,
        evidence: CellEvidence,
    ) -> None:
        """Test the currents of the pack [A] against its cells and the road load, if there is reason to doubt them."""
        doubted, used = differ, self._used(currents)
        if voltage and used and not charging:  # no road charges a pack
            error = abs(evidence.error(voltage, currents[used], used) or 0.0)
            unexplained = not self.sag.explained and evidence.innovation_rms > CONFIG.cell_sd_v
            doubted |= unexplained or error > CONFIG.gross_cell_error_v
        if not doubted or not voltage:
            for test in (*(self._by_cells[source] for source in (*self._by_road, ROAD)), *self._by_road.values()):
                test.restart()
            return
        power = evidence.road_power()
        expected = {} if power is None else {ROAD: power / voltage}
        for source, current in (currents | expected).items():
            self._by_cells[source].update(dt, evidence.error(voltage, current, source) or 0.0, CONFIG.cell_sd_v)
            if expected and source != ROAD:
                sd = CONFIG.idle_rate * self._capacity + CONFIG.road_sd_relative * abs(expected[ROAD])
                self._by_road[source].update(dt, current - expected[ROAD], sd)

    def _used(self, currents: dict[str, float]) -> str:
        """The sensor whose current [A] is used unless it is newly contradicted; empty if there is none."""
        sound = [role for role in currents if not self.counters[role].faulty]
        return next(iter(sound or currents), "")

    def _choose_current(
        self, dt: float, currents: dict[str, float], differ: bool, comparable: bool, extra: float
    ) -> tuple[float | None, CurrentSource]:
        """(current of the pack [A], where it comes from); None if no sensor is believed."""
        against, disputed, known = NO_SENSOR, False, faulty(self.counters) & BOTH
        used = self._used(currents)
        if differ and self._usual_auxiliary.square < min(1.0, self.current_difference.square / 4):
            against = AUXILIARY
        elif differ:
            wrong = self._isolated(*CURRENTS[:2]) or isolate(*(test.square for test in self._by_road.values()))
            # A sensor that was found out before explains the contradiction.
            against = known if len(known) == 1 else (BOTH, PACK, INVERTER)[wrong]
            disputed = against == BOTH
        elif used and self._by_road[used].contradicts and self._isolated(used, ROAD) == 1:
            against = BOTH
        flows = any(abs(current) > CONFIG.current_sd_rate * self._capacity for current in currents.values())
        agree = False if comparable and not against and flows and self.current_difference.agrees else None
        for role in self._signals.mapped(CURRENTS):
            self.counters[role].update(dt, True if role in against else agree, disputed)
            self._signals[role].trusted = not self.counters[role].faulty and (disputed or role not in against)
        if disputed:
            return sum(currents.values()) / len(currents), CurrentSource.DISPUTED
        if "inverter_current" in currents and not self._signals.auxiliary_current.trusted:
            currents["inverter_current"] -= extra
        if comparable and not against | known:
            self._offset.update(dt, currents["pack_current"] - currents["inverter_current"])
            self._compared = self._signals.pack_current.time
        source = next((role for role in currents if self._signals[role].trusted), None)
        return (currents[source], SOURCES[source]) if source else (None, CurrentSource.NONE)

    def _isolated(self, first: str, second: str) -> int:
        """1 or 2: which of two sensors the cells contradict; 0 while they do not decide."""
        return isolate(self._by_cells[first].square, self._by_cells[second].square)

    def _choose_voltage(
        self, dt: float, voltages: dict[str, float], current: float | None, idle: bool, evidence: CellEvidence
    ) -> float | None:
        """Voltage of the pack [V], at its `current` [A]; idle: the inverter may be disconnected."""
        cells = {role: voltage / self._series for role, voltage in voltages.items()}
        against = frozenset(role for role, voltage in cells.items() if not self._lowest < voltage < self._highest)
        comparable = len(cells) == 2 and not against
        comparable = comparable and together(self._signals.pack_voltage, self._signals.inverter_voltage)
        self.voltage_dispute, agree = 0.0, None if against else False
        if not comparable or (idle and cells["inverter_voltage"] < cells["pack_voltage"] - CONFIG.voltage_sd_v):
            self._last = None  # an idle inverter may show its own capacitors, before or after its precharge
        elif self._compare_voltages(dt, *cells.values()):
            wrong, known = (
                self._isolate_voltage(dt, voltages, current, evidence.error),
                faulty(self.counters) & set(VOLTAGES),
            )
            against = known if len(known) == 1 else frozenset(VOLTAGES[wrong - 1 : wrong] if wrong else VOLTAGES)
            self.voltage_dispute = abs(self._voltage_difference.difference) if len(against) == 2 else 0.0
        else:
            agree = False if self._voltage_difference.agrees else None
            self._model.update(dt, evidence.innovation_rms**2)
            for role in VOLTAGES:
                self._by_cells[role].restart()
        disputed = self.voltage_dispute > 0
        for role in self._signals.mapped(VOLTAGES):
            self.counters[role].update(dt, True if role in against else agree if role in cells else None, disputed)
            self._signals[role].trusted = disputed or not (role in against or self.counters[role].faulty)
        if disputed:
            return sum(voltages.values()) / len(voltages)
        return next((voltage for role, voltage in voltages.items() if self._signals[role].trusted), None)

    def _compare_voltages(self, dt: float, pack: float, inverter: float) -> bool:
        """Whether two voltages [V per cell] differ by more than one of them moves before the other is sampled."""
        last, self._last = self._last or (pack, inverter), (pack, inverter)
        moved = max(abs(pack - last[0]), abs(inverter - last[1]))
        self._moved = max(moved, self._moved * (1 - share_of_new(dt, CONFIG.voltage_skew_s)))
        self._voltage_difference.update(dt, pack - inverter, CONFIG.voltage_sd_v + self._moved)
        return self._voltage_difference.contradicts

    def _isolate_voltage(self, dt: float, voltages: dict[str, float], current: float | None, error: CellError) -> int:
        """1 or 2: which of two voltages [V] the cells contradict; 0 while they do not decide."""
        if current is not None and self._model.seen > CONFIG.settled_after_s:
            # What the cell model could not follow while the two agreed is no evidence.
            usual = max(CONFIG.cell_sd_v, sqrt(CONFIG.isolating_ratio * self._model.difference))
            for role, voltage in voltages.items():
                self._by_cells[role].update(dt, error(voltage, current, "chosen") or 0.0, usual)
        return self._isolated(*VOLTAGES)


def together(first: Signal, second: Signal) -> bool:
    """Whether two sensors report at about the same time, or one of them never did."""
    return isinf(first.time + second.time) or abs(first.time - second.time) <= TIMING.coarse
