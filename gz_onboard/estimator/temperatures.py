"""Temperatures of cells and ambient, and what replaces a missing sensor."""

from __future__ import annotations

from collections.abc import Callable

from gz_onboard.constants import BENCH_TEMPERATURE, MILD
from gz_onboard.estimator.signals import Signals
from gz_onboard.physics.cooling import pack_constants
from gz_onboard.physics.functions import decay_over, relaxed
from gz_onboard.physics.parameters import Parameters

CELL_SD, CELL_SD_UNKNOWN = 1.0, 8.0  # K: of a sensor, of its replacement


def at_rest(temperature: float) -> float:
    """The heat [W] of a pack without a load."""
    return 0.0


class Temperatures:
    """Remembers the cells' temperature, and by how much their heat has made them warmer than the air.

    What is not measured follows the pack's cooling network (`physics.cooling.pack_constants`, exact over any step).
    """

    def __init__(self, signals: Signals, parameters: Parameters) -> None:
        self._signals = signals
        self._conductance, self._cooling_time = pack_constants(parameters)  # W/K, s
        self.cells: float | None = None  # degC, the last known
        self._over = 0.0  # K: over the ambient; parked for long they are as cold

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
            return self.cells - self._over
        return MILD

    def step(self, now: float, dt: float, heat: Callable[[float], float]) -> float:
        """The cells' temperature [degC]: measured; else the last one; else the ambient; from there on by their heat.

        heat: of the pack [W] over `dt` [s] by its temperature [degC].
        """
        measured, air = self._signals.cell_temperature.get(now), self._signals.ambient_temperature.get(now)
        if measured is not None:
            self.cells = measured
            self._over = self._over_after(self._over, dt, heat(measured)) if air is None else measured - air
            return measured
        ambient = self.ambient(now)
        cells = ambient + self._over if self.cells is None else self.cells
        warm = self._over_after(cells - ambient, dt, heat(cells))
        if self.cells is None:
            self._over = warm
        else:
            self.cells = ambient + warm
        return ambient + warm

    def _over_after(self, over: float, dt: float, watts: float) -> float:
        """`over` [K] the ambient, after `dt` [s] with so many `watts`."""
        return relaxed(over, watts / self._conductance, decay_over(dt, self._cooling_time))
