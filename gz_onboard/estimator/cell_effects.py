"""Effects in the cells beside R0 and the RC pair, followed with their memory."""

from __future__ import annotations

from collections.abc import Mapping

from gz_onboard.constants import MILD
from gz_onboard.events import WINDOW
from gz_onboard.physics.battery import Battery
from gz_onboard.physics.effect import QUANTITIES, Port
from gz_onboard.physics.model import Model, share_that_ages

LARGEST = 1.0  # V of a cell, of a saved state
FOREVER = 1e9  # s: a rest of unknown length
FORGOTTEN = 10.0  # s: a current that nobody asked for in so long is followed anew


Supposed = tuple[float, dict[str, float]]
"""When [s], and the states of the effects then."""


class CellEffects:
    """The states of the effects. False if the model has none."""

    def __init__(self, model: Model, battery: Battery) -> None:
        self._battery = battery
        self._effects = [(x.effect.name, x, share_that_ages(x)) for x in model.at(Port.CELL_VOLTAGE)]
        self._quantities = dict.fromkeys(QUANTITIES, 0.0)
        self._quantities["cell_capacity"] = battery.cell_capacity(MILD)  # until the first step
        self.states = {name: 0.0 for name, _, _ in self._effects}  # V of a cell
        self.overpotential = 0.0  # V of a cell: their sum
        self.mean_overpotential = 0.0  # V of a cell, over the last window
        self._supposed: dict[str, Supposed] = {}  # by sensor

    def __bool__(self) -> bool:
        return bool(self._effects)

    def step(
        self, dt: float, current: float, soc: float, temperature: float, others: Mapping[str, float] | None = None
    ) -> None:
        """`dt` [s] on at a mean cell `current` [A], `temperature` in degC; others: what else has changed, by name."""
        q = self._quantities
        q.update(others or {})
        q["soc"], q["cell_temperature"] = soc, temperature
        q["cell_capacity"] = self._battery.cell_capacity(temperature)
        self.states = self._after(self.states, dt, current, q)
        before, self.overpotential = self.overpotential, sum(self.states.values())
        self.mean_overpotential = (before + self.overpotential) / 2 if dt <= 2 * WINDOW else self.overpotential

    def supposed(self, sensor: str, now: float, current: float) -> float:
        """`mean_overpotential` [V] at `now` [s] if the cell's `current` [A] by `sensor` flows.

        It has its own memory from when it is first asked for: what has just begun has not built up yet, and what has
        long been another is settled.
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
        health, after = self._battery.health, {}
        for name, effect, ages in self._effects:
            quantities["cell_current"] = health.carried(current, ages)
            after[name] = effect.step(states[name], dt, quantities)
        return after

    def restore(self, saved: Mapping[str, float], age: float | None, soc: float) -> None:
        """Continue from the `saved` states after a rest of `age` [s], None: long. ValueError for other effects."""
        if saved.keys() != self.states.keys():
            raise ValueError("is damaged: state.cell_effects has not the effects of this vehicle")
        self.states = dict(saved)
        self.rest(FOREVER if age is None else age, soc)

    def rest(self, seconds: float, soc: float) -> None:
        """So much time [s] without a load, at a temperature that is not known."""
        if self.states:
            self.step(seconds, 0.0, soc, MILD)
