"""Temperatures of cells and ambient air, and what replaces a missing sensor."""

from __future__ import annotations

from collections.abc import Callable

from gz_onboard.constants import BENCH_TEMPERATURE, MILD
from gz_onboard.estimator.signals import Signals
from gz_onboard.physics.drawable import pack_constants
from gz_onboard.physics.functions import decay_over, relaxed
from gz_onboard.physics.parameters import Parameters

CELL_SENSOR_SD_K, CELL_MODEL_SD_K = 1.0, 8.0


def at_rest(temperature: float) -> float:
    """The heat [W] of a pack without a load."""
    return 0.0


class Temperatures:
    """Remembers the cells' temperature, and how much warmer than the air their heat has made them.

    A temperature that is not measured follows the pack's cooling network (`physics.drawable.pack_constants`), which is
    exact over any step.
    """

    def __init__(self, signals: Signals, parameters: Parameters) -> None:
        self._cell, self._air = signals.cell_temperature, signals.ambient_temperature
        self._conductance, self._cooling_time = pack_constants(parameters)  # W/K, s
        self.cells: float | None = None  # degC, the last known
        self._above_air = 0.0  # K; parked for long they are as cold

    @property
    def cells_or_bench(self) -> float:
        """The cells' last temperature [degC], or that of the bench."""
        return BENCH_TEMPERATURE if self.cells is None else self.cells

    def cells_sd(self, now: float) -> float:
        """Standard deviation of the cells' temperature [K]."""
        return CELL_SENSOR_SD_K if self._cell.fresh(now) else CELL_MODEL_SD_K

    def ambient(self, now: float) -> float:
        """The ambient temperature [degC]: measured; else by the cells'; else a mild day's."""
        ambient = self._air.get(now)
        if ambient is not None:
            return ambient
        if self.cells is not None and self._cell.fresh(now):
            return self.cells - self._above_air
        return MILD

    def step(self, now: float, dt: float, heat: Callable[[float], float]) -> float:
        """The cells' temperature [degC]: measured; else it follows from the last one, or the air's, by their heat.

        heat: of the pack [W] over `dt` [s] by its temperature [degC].
        """
        measured, air, ambient = self._cell.get(now), self._air.get(now), self.ambient(now)
        unknown = self.cells is None
        before = measured if measured is not None else ambient + self._above_air if self.cells is None else self.cells
        above = self._above_air if measured is not None else before - ambient
        above = relaxed(above, heat(before) / self._conductance, decay_over(dt, self._cooling_time))
        if measured is not None:
            self.cells, self._above_air = measured, above if air is None else measured - air
            return measured
        if unknown:  # the heat is all that is known of them
            self._above_air = above
        else:
            self.cells = ambient + above
        return ambient + above
