"""Which sensor replaces which: pack voltage and current, from the best sensors that work, at one time."""

from __future__ import annotations

from collections import deque
from enum import Enum, auto
from math import hypot, inf, isinf
from typing import NamedTuple

from gz_onboard.constants import BENCH_TEMPERATURE
from gz_onboard.estimator.redundancy.electric import CellEvidence, Readings
from gz_onboard.estimator.redundancy.monitor import Redundancy
from gz_onboard.estimator.signals import Signal, Signals
from gz_onboard.estimator.timing import COARSE
from gz_onboard.events import Estimate
from gz_onboard.physics.battery import HALF_FULL, Battery
from gz_onboard.physics.parameters import Parameters
from gz_onboard.physics.sensors import true_current, true_voltage

MISMATCH = 3 / 32.8  # 1/h between the two current sensors, over ten seconds or so
MISMATCH_SHARE = 0.01  # of a step: the low pass of that
APART_TIME = 300.0  # s: over so long the two are compared for the count of charge, which adds up what stays


class CurrentSource(Enum):
    """Where the pack current comes from."""

    PACK = auto()
    INVERTER = auto()
    DISPUTED = auto()  # the mean of two that contradict each other
    MODEL = auto()
    NONE = auto()


class PackReading(NamedTuple):
    """Voltage [V] and current [A] of the pack; None where no sensor is to be believed."""

    voltage: float | None = None
    current: float | None = None
    source: CurrentSource = CurrentSource.NONE
    reported_current: float | None = None  # A, trusted or not
    voltage_sd: float = 0.0  # V of a cell
    current_apart: float | None = None  # A: by so much the two currents differ in the mean; None: only one is known
    voltage_doubted: bool = False  # the two voltages differ, or one of them is faulty

    @property
    def unmeasured(self) -> bool:
        """Whether no sensor shows anything of the pack."""
        return self.voltage is None and self.source in (CurrentSource.MODEL, CurrentSource.NONE)

    def report(self, estimate: Estimate) -> None:
        """Into an estimate."""
        estimate.pack_voltage, estimate.pack_current = self.voltage, self.current
        estimate.current_modelled = self.source is CurrentSource.MODEL


class PackState(NamedTuple):
    """What is known of the pack at one step, beside the signals."""

    reading: PackReading
    temperature: float  # degC, of the cells
    speed: float | None  # m/s


class PackSources:
    """Corrects, compares and chooses the electric sensors."""

    def __init__(self, signals: Signals, redundancy: Redundancy, battery: Battery, parameters: Parameters) -> None:
        p = parameters
        self._signals, self._currents, self._voltages = signals, redundancy.currents, redundancy.voltages
        self._currents.there = frozenset(role for role in self._currents.ROLES if signals[role].stale_after)
        self._parameters, self._cable = dict(p), p["cable_resistance"]
        self._voltage_sd = p.sd("pack_voltage_offset") / battery.cells_series
        self._auxiliary_power = p["auxiliary_power"]
        self._usual_voltage = battery.ocv(HALF_FULL)[0] * battery.cells_series
        self._mismatch = MISMATCH * battery.pack_capacity(BENCH_TEMPERATURE)  # A
        self._difference = 0.0  # A, low-passed
        self._apart = 0.0  # A, the same over `APART_TIME`
        self._compared = -inf  # s: when they were compared last

    @property
    def currents_differ(self) -> bool:
        """Whether the two current sensors do, in the mean."""
        return abs(self._difference) > self._mismatch

    def read(self, now: float, dt: float, speed: float | None, evidence: CellEvidence) -> PackReading:
        """The best of this step of `dt` [s]; `speed` in m/s."""
        signals, voltages = self._signals, self._voltages
        voltage, inverter_voltage = signals.pack_voltage.reported(now), signals.inverter_voltage.reported(now)
        pack = signals.pack_current.reported(now)
        any_voltage = voltage if voltage is not None else inverter_voltage
        readings = Readings(
            None if pack is None else true_current(pack, self._parameters),
            signals.inverter_current.reported(now),
            signals.auxiliary_current.reported(now),
            self._auxiliary_power / (any_voltage or self._usual_voltage),
            voltage,
            inverter_voltage,
            speed,
            signals.pack_voltage.time - signals.inverter_voltage.time,
        )
        current, source = self._current(dt, readings, evidence)
        if voltage is not None:
            voltage = true_voltage(voltage, self._parameters)
        if inverter_voltage is not None:
            inverter_voltage += self._cable * (current or 0.0)
        together = _together(signals.pack_voltage, signals.inverter_voltage)
        compared = readings._replace(pack_voltage=voltage, inverter_voltage=inverter_voltage if together else None)
        distrusted = voltages.update(dt, compared, current, evidence)
        for role in voltages.ROLES:
            signals[role].trusted = role not in distrusted
        if voltages.apart and voltage is not None and inverter_voltage is not None:
            voltage = (voltage + inverter_voltage) / 2
        elif not signals.pack_voltage.trusted or voltage is None:
            voltage = inverter_voltage if signals.inverter_voltage.trusted else None
        return PackReading(
            voltage,
            current,
            source,
            readings.through_inverter if readings.pack is None else readings.pack,
            hypot(self._voltage_sd, voltages.apart, voltages.spread),
            self._apart if self._confirmed(now) else None,
            bool(voltages.apart or any(counter.faulty for counter in voltages.counters.values())),
        )

    def _confirmed(self, now: float) -> bool:
        """Whether the two currents are believed, and were compared of late."""
        both = self._signals.pack_current.fresh(now) and self._signals.inverter_current.fresh(now)
        return both and now - self._compared < APART_TIME

    def _current(self, dt: float, readings: Readings, evidence: CellEvidence) -> tuple[float | None, CurrentSource]:
        """(pack current [A], where it comes from): None if no sensor is to be believed."""
        signals, currents = self._signals, self._currents
        together = _together(signals.pack_current, signals.inverter_current)
        compared = readings if together else readings._replace(inverter=None)
        distrusted = currents.update(dt, compared, evidence)
        for role in currents.ROLES:
            signals[role].trusted = role not in distrusted
        if not signals.auxiliary_current.trusted:
            readings = readings._replace(auxiliary=None)
        pack, inverter = readings.pack, readings.through_inverter
        if pack is not None and inverter is not None:
            if together and not readings.charging:
                self._difference += MISMATCH_SHARE * (pack - inverter - self._difference)
                if not distrusted:
                    self._apart += min(dt / APART_TIME, 1.0) * (pack - inverter - self._apart)
                    self._compared = signals.pack_current.time
            if currents.disputed:
                return (pack + inverter) / 2, CurrentSource.DISPUTED
        if pack is not None and signals.pack_current.trusted:
            return pack, CurrentSource.PACK
        if inverter is not None and signals.inverter_current.trusted:
            return inverter, CurrentSource.INVERTER
        return None, CurrentSource.NONE


class Synchroniser:
    """Keeps the one that comes first, and interpolates it. `latency` [s]: of the voltage; negative: of the current."""

    def __init__(self, latency: float) -> None:
        self.latency = latency
        self._recent: deque[tuple[float, float, float]] = deque()  # s, V, A of the pack

    def pair(self, now: float, voltage: float, current: float, pause: float) -> tuple[float, float] | None:
        """(voltage [V], current [A]) of one time; None if not yet, or over a gap longer than `pause` [s]."""
        recent, then = self._recent, now - abs(self.latency)
        recent.append((now, voltage, current))
        if recent[0][0] > then:
            return None
        while recent[1][0] <= then:
            recent.popleft()
        (t0, v0, i0), (t1, v1, i1) = recent[0], recent[1]
        if t1 - t0 > pause:
            return None
        share = (then - t0) / (t1 - t0)
        if self.latency > 0:
            return voltage, i0 + share * (i1 - i0)
        return v0 + share * (v1 - v0), current


def _together(first: Signal, second: Signal) -> bool:
    """Whether two that both report do so at the same time; or one of them is silent."""
    return isinf(first.time + second.time) or abs(first.time - second.time) <= COARSE
