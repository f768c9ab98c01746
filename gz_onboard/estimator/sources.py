"""Voltage and current of the pack as the battery filter receives them, and at one time."""

from __future__ import annotations

from collections import deque
from enum import Enum, auto
from typing import NamedTuple

from gz_onboard.events import Estimate


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
