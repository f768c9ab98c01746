"""Currents and voltages of pack and inverter against each other, the cells' voltage and the road.

Chooses the voltage and current that the battery filter receives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import Enum, auto
from math import hypot, inf, isinf, sqrt
from typing import NamedTuple

from gz_onboard.constants import BENCH_TEMPERATURE
from gz_onboard.estimator.plausibility.residual import (
    CONFIG,
    ResidualTest,
    ResponseGain,
    Sensor,
    explain,
    isolate,
    share_of_new,
)
from gz_onboard.estimator.signals import TIMING, Signal, Signals
from gz_onboard.events import CURRENTS, VOLTAGES
from gz_onboard.model.battery import HALF_FULL, Battery
from gz_onboard.model.effect import MOVING
from gz_onboard.model.parameters import Parameters
from gz_onboard.model.sensors import true_current, true_voltage


class CurrentSource(Enum):
    """Where the pack current comes from."""

    PACK = auto()
    INVERTER = auto()
    DISPUTED = auto()  # the mean of two that contradict each other
    MODEL = auto()
    NONE = auto()


class PackReading(NamedTuple):
    """Voltage [V] and current [A] of the pack; None where no sensor can be trusted."""

    voltage: float | None = None
    current: float | None = None
    source: CurrentSource = CurrentSource.NONE
    reported_current: float | None = None  # A, trusted or not
    voltage_sd: float = 0.0  # V of a cell
    current_difference: float | None = None  # A: mean difference of the two currents; None: only one is known
    voltage_doubted: bool = False  # the two voltages differ, or one of them is faulty

    @property
    def unmeasured(self) -> bool:
        """Whether no sensor shows anything of the pack."""
        return self.voltage is None and self.source in (CurrentSource.MODEL, CurrentSource.NONE)


ROAD = "road"
SOURCES = {CURRENTS[0]: CurrentSource.PACK, CURRENTS[1]: CurrentSource.INVERTER, None: CurrentSource.NONE}


CellError = Callable[[float, float, str], float]
"""Measured minus predicted voltage of a cell [V], for a voltage [V] and a current [A] of the pack; whose current."""


class PackSensors:
    """Corrects and checks the electrical sensors and chooses the pack's voltage and current."""

    def __init__(
        self,
        signals: Signals,
        battery: Battery,
        parameters: Parameters,
        cell_error: CellError,
        road_power: Callable[[], float | None],
    ) -> None:
        """road_power: W of the pack by the road load; None while the motion is unknown."""
        self._signals, self._parameters = signals, dict(parameters)
        self._cell_error, self._road_power = cell_error, road_power
        self._series = battery.cells_series
        self._capacity = battery.pack_capacity(BENCH_TEMPERATURE)  # Ah
        self._voltage_sd = parameters.sd("pack_voltage_offset") / self._series
        self._usual_voltage = battery.ocv(HALF_FULL)[0] * self._series
        self._lowest = CONFIG.lowest_voltage_ratio * battery.cutoff_voltage
        self._highest = CONFIG.highest_voltage_ratio * battery.ocv_curve.y[-1]
        self.sensors = {role: Sensor(role, signals[role]) for role in signals.mapped((*VOLTAGES, *CURRENTS))}
        self.sag = ResponseGain(CONFIG.sag_mean_s, CONFIG.settled_s, CONFIG.sag_least_v2s)
        time, skew = CONFIG.short_s, CONFIG.current_skew_s
        self.current_difference = ResidualTest(skew, time)  # A, pack minus inverter and auxiliary
        self._usual_auxiliary = ResidualTest(skew, time)  # A, the same with the usual auxiliary load
        self._by_cells = {source: ResidualTest(0.0, time) for source in (*VOLTAGES, *CURRENTS[:2], ROAD)}
        self._by_road = {source: ResidualTest(skew, skew) for source in CURRENTS[:2]}
        self._of_currents = [self._by_cells[source] for source in (*CURRENTS[:2], ROAD)] + [*self._by_road.values()]
        self._offset = ResidualTest(CONFIG.lasting_s)  # A, pack minus inverter and auxiliary
        self._compared = -inf  # s, when the two were compared last
        self.voltage_dispute = 0.0  # V per cell by which the two differ while nothing decides
        self._voltage_difference = ResidualTest(0.0, time)  # V per cell
        self._model = ResidualTest(CONFIG.lasting_s)  # mean square error of the cell model [V²]
        self._last: tuple[float, float] | None = None  # V per cell, pack and inverter
        self._moved = 0.0  # V per cell, of late

    def read(self, now: float, dt: float, speed: float | None, innovation_rms: float) -> PackReading:
        """Best voltage and current of this step of `dt` [s], at a `speed` [m/s].

        innovation_rms: of the battery filter over the last ten seconds [V per cell].
        """
        signals, parameters = self._signals, self._parameters
        voltage, inverter_voltage = signals.pack_voltage.reported, signals.inverter_voltage.reported
        pack, inverter = signals.pack_current.reported, signals.inverter_current.reported
        auxiliary = signals.auxiliary_current.reported
        any_voltage = inverter_voltage if voltage is None else voltage
        usual = parameters["auxiliary_power"] / (any_voltage or self._usual_voltage)
        extra = 0.0 if auxiliary is None else auxiliary - usual  # A
        standing = speed is None or abs(speed) < MOVING
        currents: dict[str, float] = {}  # of the pack [A], by sensor
        if pack is not None:
            currents["pack_current"] = true_current(pack, parameters)
        if inverter is not None:
            currents["inverter_current"] = inverter + usual + extra
        charging = standing and currents.get("pack_current", 0.0) < 0  # by a current that does not pass the inverter
        comparable = len(currents) == 2 and not charging
        comparable = comparable and together(signals.pack_current, signals.inverter_current)
        if comparable:
            own, other = currents.values()
            sd = CONFIG.current_sd_rate * self._capacity + CONFIG.current_sd_relative * min(abs(own), abs(other))
            self.current_difference.update(dt, own - other, sd)
            self._usual_auxiliary.update(dt, own - other + extra, sd)
        differ = comparable and self.current_difference.contradicts
        used = next((role for role in currents if not self.sensors[role].faulty), next(iter(currents), ""))
        self._weigh_currents(dt, currents, used, any_voltage, differ, charging, innovation_rms)
        current, source = self._choose_current(dt, currents, used, differ, comparable, extra)

        voltages = {} if voltage is None else {"pack_voltage": true_voltage(voltage, parameters)}
        if inverter_voltage is not None:
            voltages["inverter_voltage"] = inverter_voltage + parameters["cable_resistance"] * (current or 0.0)
        idle = standing and (inverter is None or abs(inverter) <= usual)
        chosen = self._choose_voltage(dt, voltages, current, idle, innovation_rms)
        # Beyond agreement, neither voltage is known better than the residual of the two [sd].
        unproven = max(sqrt(self._voltage_difference.square) - CONFIG.agreeing_residual, 0.0)
        both = signals.pack_current.fresh(now) and signals.inverter_current.fresh(now)
        return PackReading(
            chosen,
            current,
            source,
            next(iter(currents.values()), None),
            hypot(self._voltage_sd, self.voltage_dispute, CONFIG.voltage_sd_v * unproven),
            self._offset.difference if both and now - self._compared < CONFIG.lasting_s else None,
            self.voltage_dispute > 0 or any(role in self.sensors and self.sensors[role].faulty for role in VOLTAGES),
        )

    def _weigh_currents(
        self,
        dt: float,
        currents: dict[str, float],
        used: str,
        voltage: float | None,
        differ: bool,
        charging: bool,
        innovation_rms: float,
    ) -> None:
        """Test the currents of the pack [A] against its cells and the road load, if there is reason to doubt them."""
        doubted = differ
        if voltage and used and not charging:  # no road charges a pack
            unexplained = innovation_rms > CONFIG.cell_sd_v and not self.sag.explained
            gross = abs(self._cell_error(voltage, currents[used], used)) > CONFIG.gross_cell_error_v
            doubted = doubted or unexplained or gross
        if not doubted or not voltage:
            for test in self._of_currents:
                if test.seen:
                    test.restart()
            return
        power = self._road_power()
        expected = {} if power is None else {ROAD: power / voltage}
        for source, current in (currents | expected).items():
            self._by_cells[source].update(dt, self._cell_error(voltage, current, source), CONFIG.cell_sd_v)
            if expected and source != ROAD:
                sd = CONFIG.idle_rate * self._capacity + CONFIG.road_sd_relative * abs(expected[ROAD])
                self._by_road[source].update(dt, current - expected[ROAD], sd)

    def _choose_current(
        self, dt: float, currents: dict[str, float], used: str, differ: bool, comparable: bool, extra: float
    ) -> tuple[float | None, CurrentSource]:
        """(current of the pack [A], where it comes from); None if no sensor is believed."""
        own = [self.sensors[role] for role in CURRENTS[:2] if role in self.sensors]
        against: list[Sensor] = []
        disputed = False
        if differ and self._usual_auxiliary.square < min(1.0, self.current_difference.square / 4):
            against = [self.sensors["auxiliary_current"]]
        elif differ:
            by_cells, by_road = (
                [test[role].square for role in CURRENTS[:2]] for test in (self._by_cells, self._by_road)
            )
            against = list(explain(own, (by_cells[0], by_cells[1]), (by_road[0], by_road[1])))
            disputed = len(against) == 2
        elif used and self._by_road[used].contradicts:
            cells = self._by_cells
            against = own if isolate(cells[used].square, cells[ROAD].square) == 1 else []
        flows = any(abs(current) > CONFIG.current_sd_rate * self._capacity for current in currents.values())
        same = self.current_difference.square < CONFIG.agreeing_residual**2
        agree = False if comparable and not against and flows and same else None
        if auxiliary := self.sensors.get("auxiliary_current"):
            auxiliary.judge(dt, True if auxiliary in against else agree)
            if "inverter_current" in currents and not auxiliary.signal.trusted:
                currents["inverter_current"] -= extra
        current, role = self._settle(dt, currents, against, agree, disputed)
        if comparable and not (against or own[0].faulty or own[1].faulty):
            self._offset.update(dt, currents["pack_current"] - currents["inverter_current"])
            self._compared = self._signals.pack_current.time
        return current, CurrentSource.DISPUTED if disputed else SOURCES[role]

    def _settle(
        self, dt: float, values: dict[str, float], against: Sequence[Sensor], agree: bool | None, disputed: bool
    ) -> tuple[float | None, str | None]:
        """Judge the sensors of these `values`: (value to use, the role it is of).

        agree: of those that nothing is `against`. disputed: either may be right, so the mean of the two is used.
        """
        for role in values:
            sensor = self.sensors[role]
            sensor.judge(dt, True if sensor in against else agree, disputed)
            sensor.signal.trusted |= disputed
        if disputed:
            return sum(values.values()) / 2, None
        used = next((role for role in values if self._signals[role].trusted), None)
        return (values[used] if used else None), used

    def _choose_voltage(
        self, dt: float, voltages: dict[str, float], current: float | None, idle: bool, innovation_rms: float
    ) -> float | None:
        """Voltage of the pack [V], at its `current` [A]; idle: the inverter may be disconnected."""
        cells = {role: voltage / self._series for role, voltage in voltages.items()}
        against = [self.sensors[role] for role, volts in cells.items() if not self._lowest < volts < self._highest]
        comparable = len(cells) == 2 and not against
        comparable = comparable and together(self._signals.pack_voltage, self._signals.inverter_voltage)
        self.voltage_dispute, agree = 0.0, None if against else False
        if not comparable or (idle and cells["inverter_voltage"] < cells["pack_voltage"] - CONFIG.voltage_sd_v):
            self._last = None  # an idle inverter may show its own capacitors, before or after its precharge
        elif self._voltages_differ(dt, *cells.values()):
            if current is not None and self._model.seen > CONFIG.settled_s:
                # What the cell model could not follow while the two agreed is no evidence.
                usual = max(CONFIG.cell_sd_v, sqrt(CONFIG.isolating_ratio * self._model.difference))
                for role, voltage in voltages.items():
                    self._by_cells[role].update(dt, self._cell_error(voltage, current, "chosen"), usual)
            by_cells = self._by_cells["pack_voltage"].square, self._by_cells["inverter_voltage"].square
            against = list(explain([self.sensors[role] for role in VOLTAGES], by_cells))
            self.voltage_dispute = abs(self._voltage_difference.difference) if len(against) == 2 else 0.0
        else:
            agree = False if self._voltage_difference.square < CONFIG.agreeing_residual**2 else None
            self._model.update(dt, innovation_rms**2)
            for role in VOLTAGES:
                self._by_cells[role].restart()
        return self._settle(dt, voltages, against, agree, self.voltage_dispute > 0)[0]

    def _voltages_differ(self, dt: float, pack: float, inverter: float) -> bool:
        """Whether two voltages [V per cell] differ by more than one of them moves before the other is sampled."""
        last, self._last = self._last or (pack, inverter), (pack, inverter)
        moved = max(abs(pack - last[0]), abs(inverter - last[1]))
        self._moved = max(moved, self._moved * (1 - share_of_new(dt, CONFIG.voltage_skew_s)))
        self._voltage_difference.update(dt, pack - inverter, CONFIG.voltage_sd_v + self._moved)
        return self._voltage_difference.contradicts


def together(first: Signal, second: Signal) -> bool:
    """Whether two sensors report at about the same time, or one of them never did."""
    return isinf(first.time + second.time) or abs(first.time - second.time) <= TIMING.coarse
