"""Temperatures of cells and ambient, and what replaces a missing sensor."""

from __future__ import annotations

from gz_onboard.constants import BENCH_TEMPERATURE, MILD
from gz_onboard.estimator.signals import Signals

COOLING_TIME = 7200.0  # s: how fast the cells' temperature drifts to the ambient's
WARMER = 3.0  # K: cells over the ambient
CELL_SD, CELL_SD_UNKNOWN = 1.0, 8.0  # K: of a sensor, of its replacement


class Temperatures:
    """Remembers the cells' temperature."""

    def __init__(self, signals: Signals) -> None:
        self._signals = signals
        self.cells: float | None = None  # degC, the last known

    @property
    def cells_or_bench(self) -> float:
        """The cells' last temperature [degC], or that of the bench."""
        return BENCH_TEMPERATURE if self.cells is None else self.cells

    def cells_sd(self, now: float) -> float:
        """[K]."""
        return CELL_SD if self._signals.cell_temperature.fresh(now) else CELL_SD_UNKNOWN

    def ambient(self, now: float) -> float:
        """The ambient temperature [degC]: measured; else by the cells'; else a mild day's."""
        ambient = self._signals.ambient_temperature.get(now)
        if ambient is not None:
            return ambient
        if self.cells is not None and self._signals.cell_temperature.fresh(now):
            return self.cells - WARMER
        return MILD

    def step(self, now: float, dt: float) -> float:
        """The cells' temperature [degC]: measured; else the last one, drifting to the ambient; else the ambient."""
        measured = self._signals.cell_temperature.get(now)
        if measured is not None:
            self.cells = measured
            return measured
        ambient = self.ambient(now)
        if self.cells is None:
            return ambient
        self.cells += (ambient - self.cells) * min(dt / COOLING_TIME, 1.0)
        return self.cells
