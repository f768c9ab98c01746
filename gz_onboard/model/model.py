"""The forward model: effects between road and battery, and the ledger of the power that each takes.

Backward in the sense of simulation (speed in, power out); of floats and numpy arrays alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, MutableMapping
from math import sqrt
from typing import Any

from gz_onboard.constants import KELVIN
from gz_onboard.model.battery import QUICK, Battery, Overpotential
from gz_onboard.model.effect import QUANTITIES, ROAD_LOAD, Effect, Port
from gz_onboard.model.functions import STANDSTILL, mean_response
from gz_onboard.model.parameters import Parameters

GAS_CONSTANT_AIR = 287.05  # J/(kg·K)


def air_density(temperature: float, altitude: float = 0.0) -> float:
    """Density of dry air [kg/m³] at `temperature` [degC] and `altitude` [m] (ISO 2533: pressure)."""
    pressure = 101325 * (1 - 2.25577e-5 * altitude) ** 5.25588
    return float(pressure / (GAS_CONSTANT_AIR * (temperature + KELVIN)))


class Bound:
    """An effect with the values of its parameters.

    has_fixed_time: nothing but its parameters decides how fast it settles.
    """

    def __init__(self, effect: Effect, parameters: Mapping[str, float]) -> None:
        self.effect = effect
        self.values = {name: parameters[name] for name in effect.takes}
        self._term = effect.term.bound(self.values)
        self._decay = effect.decay and effect.decay.bound(self.values)
        self.has_fixed_time = effect.decay is None or effect.decay.quantities == ("dt",)

    def __reduce__(self) -> tuple[type[Bound], tuple[Effect, dict[str, float]]]:
        """Pickle effect and values: another process does not know the functions of a user's file."""
        return Bound, (self.effect, self.values)

    def __call__(self, quantities: Mapping[str, Any], recall: Recall | None = None) -> Any:
        """Its value at `quantities` by name, floats or arrays; with memory as `recall` gives it, by default settled."""
        return recall(self, quantities) if recall and self._decay else self._term(quantities)

    def decay(self, dt: Any, quantities: Mapping[str, Any]) -> Any:
        """The factor by which its state decays over `dt` [s]; 0 for an effect without memory."""
        return self._decay(quantities, dt) if self._decay else 0.0

    def step(self, state: float, dt: float, quantities: Mapping[str, Any]) -> float:
        """Its value `dt` [s] after `state`."""
        decay = self.decay(dt, quantities)
        return float(decay * state + (1 - decay) * self._term(quantities))


Recall = Callable[[Bound, Mapping[str, Any]], Any]
"""The value of an effect with memory at these quantities."""


def stepping(states: MutableMapping[str, float], dt: float) -> Recall:
    """One step of `dt` [s] from `states`, by the names of the effects, which it updates; 0 for a missing one."""

    def recall(effect: Bound, quantities: Mapping[str, Any]) -> float:
        name = effect.effect.name
        states[name] = x = effect.step(states.get(name, 0.0), dt, quantities)
        return x

    return recall


def drag_torque(power: Any, motor_speed: Any) -> Any:
    """Torque [N·m] against the motion by which `power` [W] of loss at no current slows the motor; 0 at standstill."""
    return power * motor_speed / (motor_speed * motor_speed + STANDSTILL * STANDSTILL)


class Model:
    """The effects of one vehicle with its parameters. reads: the quantities that the effects need."""

    def __init__(self, effects: tuple[Effect, ...], parameters: Parameters) -> None:
        self.effects = effects
        self.parameters = parameters
        self.reads: frozenset[str] = frozenset().union(*(effect.reads for effect in effects))
        self.mass = parameters["vehicle_mass"] + parameters["payload_mass"]
        self._bound = [Bound(effect, parameters) for effect in effects]
        self._road, self._motor = self.at(*ROAD_LOAD), self.at(Port.MOTOR_LOSS)
        self._electric = self.at(Port.INVERTER_LOSS, Port.DC_POWER)
        self._motor_per_speed = 1 / (parameters["wheel_radius"] * parameters["gear_ratio"])
        self._regeneration_limit = parameters["regeneration_torque_limit"]
        self._torque_constant = parameters["torque_constant"]

    def at(self, *ports: Port) -> list[Bound]:
        """The effects at these ports."""
        return [bound for port in ports for bound in self._bound if bound.effect.port is port]

    def power(self, quantities: Mapping[str, Any], recall: Recall | None = None) -> dict[str, Any]:
        """The ledger [W]: the power that each effect takes out of the pack, by name, moving as `quantities` say.

        quantities: those that the model `reads`, without motor_speed, torque and motor_current, which follow from the
        road load. recall: gives the value of an effect with memory; without it they are settled. Effects in the cells
        are not included: they are behind the pack's terminals. ``brakes`` is the heat of the friction brakes where the
        motor cannot brake enough. The sum of the ledger is the power at the pack's terminals; kinetic and potential
        energy are the entries ``inertia`` and ``grade_force``.
        """
        q = dict(quantities)
        speed, road = q["speed"], [effect(q, recall) for effect in self._road]
        ledger = {bound.effect.name: force * speed for bound, force in zip(self._road, road, strict=True)}
        motor_speed = speed * self._motor_per_speed
        wanted = sum(road) / self._motor_per_speed  # torque at the motor's shaft
        limit = -self._regeneration_limit
        torque = (wanted + limit + abs(wanted - limit)) / 2  # the greater of both, for arrays too
        ledger["brakes"] = (torque - wanted) * motor_speed
        q["motor_speed"], q["torque"], q["motor_current"] = motor_speed, 0.0, 0.0
        q["torque"] = torque + drag_torque(sum([effect(q) for effect in self._motor]), motor_speed)
        q["motor_current"] = q["torque"] / self._torque_constant
        for bound in (*self._motor, *self._electric):
            ledger[bound.effect.name] = bound(q, recall)
        return ledger

    def overpotential(self, battery: Battery, others: Mapping[str, float] | None = None) -> Overpotential | None:
        """The voltage [V] that a cell of `battery` loses by all effects in it, settled; None without such effects.

        others: quantities that are not the cells' and that the effects may read; 0 if not given.
        """
        effects = []
        for effect in self.at(Port.CELL_VOLTAGE):
            share = mean_response(effect.decay(BURST, {})) if effect.has_fixed_time else None  # of a burst, in its mean
            effects.append((effect, share, share_that_ages(effect)))
        if not effects:
            return None
        q, health = dict.fromkeys(QUANTITIES, 0.0) | dict(others or {}), battery.health

        def settled(current: float, soc: float, temperature: float, form_factor_squared: float) -> float:
            q["soc"], q["cell_temperature"] = soc, temperature
            q["cell_capacity"] = battery.cell_capacity(temperature)
            aged, lost = health.resistance - 1, 0.0
            for effect, known, ages in effects:
                q["cell_current"] = load = (1 + aged * ages) * current
                share = 0.0
                if form_factor_squared > 1:
                    share = mean_response(effect.decay(BURST, q)) if known is None else known
                if share < UNMOVED:
                    lost += effect(q)
                    continue
                # The charge flows in bursts. An effect that is fast enough follows the current, not its mean. A gamma
                # distribution of currents of this form factor, weighted with the charge, has the mean and sd of two
                # currents, which tell what an effect loses that does not grow in proportion to the current.
                bursts = 1 + (form_factor_squared - 1) * share
                apart = sqrt((bursts - 1) / bursts)
                q["cell_current"] = (1 - apart) * bursts * load
                low = effect(q)
                q["cell_current"] = (1 + apart) * bursts * load
                lost += (low + effect(q)) / 2
            return lost

        return settled


# --- effects in the cells -----------------------------------------------------------------------------------------

BURST = 10.0  # s: a load in traffic
UNMOVED = 0.01  # an effect that shows less of a burst sees only the mean current
STOOD = 60.0  # s: duration of the load before a ride's first voltages: lights, a heater
STANDING_LOADS = 1.5  # times the auxiliary power: the most that is believed to have flowed before it was seen


def share_that_ages(effect: Bound) -> float:
    """How much of an effect in the cells grows with their resistance, which is learned from changes within `QUICK`.

    Slower effects, such as diffusion, do not show in those changes, and grow differently with age.
    """
    return 1 - float(effect.decay(QUICK, {})) if effect.has_fixed_time else 1.0


def standing_load(current: float, voltage: float, auxiliary_power: float) -> float:
    """How much [A] of a pack's first `current` [A] at `voltage` [V] has already flowed for a while.

    More than the load of a standing vehicle is a rider who pulls away, or a sensor's error, as likely as a load.
    """
    most = STANDING_LOADS * auxiliary_power / voltage if voltage > 0 else 0.0
    return min(max(current, -most), most)
