"""The cells: their model at one state of charge, the effects in them with their memory, and their temperature."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import exp
from typing import NamedTuple

from gz_onboard.constants import BENCH_TEMPERATURE, MILD
from gz_onboard.estimator.signals import Signals
from gz_onboard.events import WINDOW
from gz_onboard.model.battery import Battery
from gz_onboard.model.drawable import pack_constants
from gz_onboard.model.effect import QUANTITIES, Port
from gz_onboard.model.model import Model, share_that_ages
from gz_onboard.model.parameters import Parameters

LARGEST = 1.0  # V of a cell, of a saved state
FOREVER = 1e9  # s: a rest of unknown length
FORGOTTEN = 10.0  # s: a current that was not asked for in this time is followed from the start again
CELL_SENSOR_SD_K, CELL_MODEL_SD_K = 1.0, 8.0


class Cell(NamedTuple):
    """The cell model at one state of charge and temperature."""

    ocv: float  # V
    slope: float  # V, of the open-circuit voltage over SOC
    r0: float  # ohm
    r0_slope: float  # ohm
    r1: float  # ohm
    time: float  # s, of the RC pair

    @classmethod
    def of(cls, battery: Battery, soc: float, temperature: float) -> Cell:
        """The cell of `battery` at `soc` and `temperature` [degC]."""
        r1 = battery.r1.at(soc, temperature)[0]
        time = r1 * battery.c1.at(soc, temperature)[0]
        return cls(*battery.ocv(soc, temperature), *battery.r0.at(soc, temperature), r1, time)


class CellEffects:
    """The states of the effects."""

    def __init__(self, model: Model, battery: Battery) -> None:
        self._health = battery.health  # at the last step
        self._effects = [(x.effect.name, x, share_that_ages(x)) for x in model.at(Port.CELL_VOLTAGE)]
        self._quantities = dict.fromkeys(QUANTITIES, 0.0)
        self._quantities["cell_capacity"] = battery.cell_capacity(MILD)  # until the first step
        self.states = {name: 0.0 for name, _, _ in self._effects}  # V of a cell
        self.overpotential = 0.0  # V of a cell: their sum
        self.mean_overpotential = 0.0  # V of a cell, over the last window
        self._supposed: dict[str, tuple[float, dict[str, float]]] = {}  # by sensor: when [s], states of the effects

    def step(
        self,
        battery: Battery,
        dt: float,
        current: float,
        soc: float,
        temperature: float,
        others: Mapping[str, float] | None = None,
    ) -> None:
        """Advance by `dt` [s] at a mean cell `current` [A] and `temperature` [degC]; others: quantities by name."""
        q, self._health = self._quantities, battery.health
        q.update(others or {})
        q["soc"], q["cell_temperature"] = soc, temperature
        q["cell_capacity"] = battery.cell_capacity(temperature)
        self.states = self._after(self.states, dt, current, q)
        before, self.overpotential = self.overpotential, sum(self.states.values())
        self.mean_overpotential = (before + self.overpotential) / 2 if dt <= 2 * WINDOW else self.overpotential

    def supposed(self, sensor: str, now: float, current: float) -> float:
        """`mean_overpotential` [V] at `now` [s] if the cell's `current` [A] by `sensor` flows.

        Each sensor has its memory, from when it is first asked for: the effects of a current that has just
        changed have not built up yet, those of an old one have settled.
        """
        then, states = self._supposed.get(sensor, (now, self.states))
        if not 0 <= now - then < FORGOTTEN:
            then, states = now, self.states
        after = self._after(states, now - then, current, self._quantities)
        self._supposed[sensor] = now, after
        return (sum(states.values()) + sum(after.values())) / 2

    def _after(
        self, states: Mapping[str, float], dt: float, current: float, quantities: dict[str, float]
    ) -> dict[str, float]:
        after = {}
        for name, effect, ages in self._effects:
            quantities["cell_current"] = self._health.carried(current, ages)
            after[name] = effect.step(states[name], dt, quantities)
        return after

    def restore(self, battery: Battery, saved: Mapping[str, float], age: float | None, soc: float) -> None:
        """Continue from the `saved` states after a rest of `age` [s], None: long. ValueError for other effects."""
        if saved.keys() != self.states.keys():
            raise ValueError("is damaged: state.cell_effects has not the effects of this vehicle")
        self.states = dict(saved)
        self.rest(battery, FOREVER if age is None else age, soc)

    def rest(self, battery: Battery, seconds: float, soc: float) -> None:
        """Advance by `seconds` [s] without a load, at an unknown temperature."""
        self.step(battery, seconds, 0.0, soc, MILD)


class Temperatures:
    """Remembers the cells' temperature, and how much warmer than the air their heat has made them.

    A temperature that is not measured follows the pack's cooling network (`model.drawable.pack_constants`), which is
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

    def step(self, now: float, dt: float, heat: Callable[[float], float] | None) -> float:
        """The cells' temperature [degC]: measured; else it follows from the last one, or the air's, by their heat.

        heat: of the pack [W] over `dt` [s] by its temperature [degC]; None: it had no load.
        """
        measured, air, ambient = self._cell.get(now), self._air.get(now), self.ambient(now)
        unknown = self.cells is None
        before = measured if measured is not None else ambient + self._above_air if self.cells is None else self.cells
        above = self._above_air if measured is not None else before - ambient
        watts = heat(before) if heat else 0.0
        decay = exp(-dt / self._cooling_time)
        above = decay * above + (1 - decay) * (watts / self._conductance)
        if measured is not None:
            self.cells, self._above_air = measured, above if air is None else measured - air
            return measured
        if unknown:  # the heat is all that is known of them
            self._above_air = above
        else:
            self.cells = ambient + above
        return ambient + above
