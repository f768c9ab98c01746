"""What the electric sensors report at one time, and which of two readings the cells' voltage contradicts.

Limits of currents are C-rates (1/h: A over the pack's A·h), those of voltages are a cell's.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from gz_onboard.estimator.motion import MOTION
from gz_onboard.estimator.redundancy.checks import share_of_new

ERROR_TIME, ERROR_LEAST = 10.0, 0.04  # s, V: what the cell model leaves, low-passed
CLEARLY = 2.5  # of two mean squares: the greater one's reading is wrong,
DECIDES = 0.031  # V: where they differ by the square of so much

CellError = Callable[[float, float, str], float | None]
"""Measured less predicted voltage of a cell [V], for a voltage [V] and a current [A] of the pack; and whose current."""


class Readings(NamedTuple):
    """What the electric sensors report: A of the pack, positive discharging, and V; None if nothing."""

    pack: float | None
    inverter: float | None
    auxiliary: float | None
    usual_auxiliary: float
    pack_voltage: float | None
    inverter_voltage: float | None  # with the cable's drop
    speed: float | None  # m/s
    voltages_apart: float = 0.0  # s: the time of the pack voltage's message less that of the inverter voltage's

    @property
    def through_inverter(self) -> float | None:
        """The pack's current by the inverter's and the auxiliary."""
        if self.inverter is None:
            return None
        return self.inverter + (self.usual_auxiliary if self.auxiliary is None else self.auxiliary)

    def unconnected(self, least: float) -> bool:
        """Whether an idle inverter is below the pack of a standing vehicle by `least` [V]."""
        if self.pack_voltage is None or self.inverter_voltage is None or abs(self.speed or 0.0) > MOTION.standstill:
            return False
        idle = self.inverter is None or abs(self.inverter) <= self.usual_auxiliary
        return idle and self.inverter_voltage < self.pack_voltage - least

    @property
    def charging(self) -> bool:
        """A charger's current does not pass the inverter."""
        return self.pack is not None and self.pack < 0 and abs(self.speed or 0.0) < MOTION.standstill


class CellEvidence(NamedTuple):
    """What else is known of the pack's current and voltage."""

    error: CellError
    road_power: Callable[[], float | None]  # W of the pack, by the model; None while the motion is not known
    innovation_rms: float  # V of a cell, of the last ten seconds


class ResidualComparison:
    """Which of two readings the cells' voltage contradicts: mean squares of what the cell model leaves of each."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """The two agree."""
        self._first = self._second = 0.0  # V²
        self._time = 0.0  # s

    def update(self, dt: float, first: float | None, second: float | None, usual: float = 0.0) -> int:
        """0 while nothing decides, 1 or 2: which is wrong. first, second [V of a cell]: measured less predicted.

        usual: mean square [V²] of what the cell model leaves of what is right: no smaller difference decides.
        """
        if first is None or second is None:
            return 0
        self._time = min(self._time + dt, ERROR_TIME)
        share = share_of_new(dt, self._time)
        self._first += (first * first - self._first) * share
        self._second += (second * second - self._second) * share
        if abs(self._first - self._second) < max(DECIDES**2, CLEARLY * usual):
            return 0
        return 1 if self._first > CLEARLY * self._second else 2 if self._second > CLEARLY * self._first else 0
