"""The forward model: effects between road and battery, and the ledger of the power that each takes.

Backward in the sense of simulation (speed in, power out); of floats and numpy arrays alike.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, MutableMapping, Sequence
from functools import cache, partial
from typing import Any

from gz_onboard.constants import KELVIN
from gz_onboard.physics.battery import QUICK, Battery, Overpotential
from gz_onboard.physics.effect import QUANTITIES, Effect, Port
from gz_onboard.physics.functions import STANDSTILL, mean_response, relaxed, sqrt
from gz_onboard.physics.parameters import Parameters

GAS_CONSTANT_AIR = 287.05  # J/(kg·K)


def air_density(temperature: float, altitude: float = 0.0) -> float:
    """Density of dry air [kg/m³] at `temperature` [degC] and `altitude` [m] (ISO 2533: pressure)."""
    pressure = 101325 * (1 - 2.25577e-5 * altitude) ** 5.25588
    return float(pressure / (GAS_CONSTANT_AIR * (temperature + KELVIN)))


class Bound:
    """An effect with the values of its parameters.

    term: its value as a function of quantities by name, floats or arrays; of an effect with memory, the value at which
    it settles. bare_term, bare_decay: the same of quantities by position.
    """

    def __init__(self, effect: Effect, parameters: Mapping[str, float]) -> None:
        self.effect = effect
        self._values = {name: parameters[name] for name in effect.takes}
        self.bare_term = effect.term.with_parameters(parameters)
        self.bare_decay = effect.decay and effect.decay.with_parameters(parameters)
        self.term = _reader(effect.term.quantities)(self.bare_term)

    def __reduce__(self) -> tuple[type[Bound], tuple[Effect, dict[str, float]]]:
        """Pickle effect and values: another process does not know the functions of a user's file."""
        return Bound, (self.effect, self._values)

    def __call__(self, quantities: Mapping[str, Any]) -> Any:
        """See `term`."""
        return self.term(quantities)

    def decay(self, dt: Any, quantities: Mapping[str, Any]) -> Any:
        """The factor by which its state decays over `dt` [s]; 0 for an effect without memory."""
        if self.effect.decay is None or self.bare_decay is None:
            return 0.0
        return self.bare_decay(dt, *[quantities[name] for name in self.effect.decay.quantities])

    def step(self, state: float, dt: float, quantities: Mapping[str, Any]) -> float:
        """Its value `dt` [s] after `state`."""
        return float(relaxed(state, self(quantities), self.decay(dt, quantities)))


def _call(function: str, names: Iterable[str]) -> str:
    """Source of a call of `function` with the quantities `names` out of a dictionary ``q``."""
    return f"{function}({', '.join(f'q[{name!r}]' for name in names)})"


@cache
def _reader(names: tuple[str, ...]) -> Callable[[Callable[..., Any]], Callable[[Mapping[str, Any]], Any]]:
    """Turns a function of the quantities `names` into one of a dictionary of quantities."""
    return eval(f"lambda function: lambda q: {_call('function', names)}")  # type: ignore[no-any-return]


def stepper(effects: Sequence[Bound], dt: float | None) -> Callable[[Mapping[str, float]], tuple[float, ...]]:
    """A function from quantities (floats) to the values of `effects`, to be called once each step of `dt` [s].

    Effects with memory start from 0; without `dt` they are settled. The function is written out as source, without
    loops and layers of calls: a simulation calls it a hundred times for each second ridden.
    """
    scope: dict[str, Any] = {}
    lines = []
    for i, bound in enumerate(effects):
        decay = bound.effect.decay
        scope[f"term{i}"] = bound.bare_term
        call = _call(f"term{i}", bound.effect.term.quantities)
        if decay and bound.bare_decay and dt is not None:
            scope[f"value{i}"], scope[f"decay{i}"] = 0.0, partial(bound.bare_decay, dt)
            if not decay.quantities:
                scope[f"kept{i}"] = bound.bare_decay(dt)
            kept = _call(f"decay{i}", decay.quantities) if decay.quantities else f"kept{i}"
            lines += [f"global value{i}", f"k = {kept}"]
            call = f"k * value{i} + (1 - k) * {call}"
        lines.append(f"value{i} = {call}")
    values = "".join(f"value{i}, " for i in range(len(effects)))
    exec("\n    ".join(["def values(q):", *lines, f"return ({values})"]), scope)
    return scope["values"]  # type: ignore[no-any-return]


Recall = Callable[[Bound, Mapping[str, Any]], Any]
"""The value of an effect with memory at these quantities."""


def stepping(states: MutableMapping[str, float], dt: float) -> Recall:
    """One step of `dt` [s] from `states`, by the names of the effects, which it updates; 0 for a missing one."""

    def recall(effect: Bound, quantities: Mapping[str, Any]) -> float:
        name = effect.effect.name
        states[name] = x = effect.step(states.get(name, 0.0), dt, quantities)
        return x

    return recall


def value_of(effect: Bound, quantities: Mapping[str, Any], recall: Recall | None = None) -> Any:
    """The value of `effect`; with memory, as `recall` gives it, or settled without `recall`."""
    return recall(effect, quantities) if recall and effect.effect.decay else effect(quantities)


def total(effects: Iterable[Bound], quantities: Mapping[str, Any], recall: Recall | None = None) -> Any:
    """The sum of the values of `effects`: see `value_of`."""
    return sum((value_of(effect, quantities, recall) for effect in effects), 0.0)


def all_quantities(**known: Any) -> dict[str, Any]:
    """All quantities that effects read, floats or arrays: `known`, the cosine of its ``grade``, and 0 for the rest."""
    cosine = sqrt(1 - known["grade"] * known["grade"]) if "grade" in known else 1.0
    return dict.fromkeys(QUANTITIES, 0.0) | {"grade_cosine": cosine} | known


def drag_torque(power: Any, motor_speed: Any) -> Any:
    """Torque [N·m] against the motion by which `power` [W] of loss at no current slows the motor; 0 at standstill."""
    return power * motor_speed / (motor_speed * motor_speed + STANDSTILL * STANDSTILL)


class Model:
    """The effects of one vehicle with its parameters. reads: the quantities that the effects need."""

    def __init__(self, effects: tuple[Effect, ...], parameters: Parameters) -> None:
        self.effects = effects
        self.parameters = parameters
        self._at: dict[Port, list[Bound]] = {port: [] for port in Port}
        for effect in effects:
            self._at[effect.port].append(Bound(effect, parameters))
        self.reads: frozenset[str] = frozenset().union(*(effect.reads for effect in effects))
        self.mass = parameters["vehicle_mass"] + parameters["payload_mass"]
        self._motor_per_speed = 1 / (parameters["wheel_radius"] * parameters["gear_ratio"])

    def at(self, *ports: Port) -> list[Bound]:
        """The effects at these ports."""
        return [effect for port in ports for effect in self._at[port]]

    def idle_loss(self, quantities: Mapping[str, Any]) -> Any:
        """Loss of the motor [W] turning without current: drag on the shaft, which the motor's current makes up for."""
        return total(self._at[Port.MOTOR_LOSS], {**quantities, "torque": 0.0, "motor_current": 0.0})

    def power(self, quantities: Mapping[str, Any], recall: Recall | None = None) -> dict[str, Any]:
        """The ledger [W]: the power that each effect takes out of the pack, by name, moving as `quantities` say.

        quantities: those that the model `reads`, without motor_speed, torque and motor_current, which follow from the
        road load. recall: gives the value of an effect with memory; without it they are settled. Effects in the cells
        are not included: they are behind the pack's terminals. ``brakes`` is the heat of the friction brakes where the
        motor cannot brake enough. The sum of the ledger is the power at the pack's terminals; kinetic and potential
        energy are the entries ``inertia`` and ``grade_force``.
        """
        q = dict(quantities)
        speed = q["speed"]
        ledger: dict[str, Any] = {}
        force = 0.0
        for bound in (*self._at[Port.WHEEL_FORCE], *self._at[Port.TYRE]):
            term = value_of(bound, q, recall)
            force = force + term
            ledger[bound.effect.name] = term * speed
        motor_speed = speed * self._motor_per_speed
        wanted = force / self._motor_per_speed  # torque at the motor's shaft
        limit = -self.parameters["regeneration_torque_limit"]
        torque = (wanted + limit + abs(wanted - limit)) / 2  # the greater of both, for arrays too
        ledger["brakes"] = (torque - wanted) * motor_speed
        q["motor_speed"] = motor_speed
        q["torque"] = torque + drag_torque(self.idle_loss(q), motor_speed)
        q["motor_current"] = q["torque"] / self.parameters["torque_constant"]
        for port in (Port.MOTOR_LOSS, Port.INVERTER_LOSS, Port.DC_POWER):
            for bound in self._at[port]:
                ledger[bound.effect.name] = value_of(bound, q, recall)
        return ledger

    def overpotential(self, battery: Battery, others: Mapping[str, float] | None = None) -> Overpotential | None:
        """The voltage [V] that a cell of `battery` loses by all effects in it, settled; None without such effects.

        others: quantities that are not the cells' and that the effects may read; 0 if not given.
        """
        effects = [(x, _share_of_bursts(x), share_that_ages(x)) for x in self._at[Port.CELL_VOLTAGE]]
        if not effects:
            return None
        usual = dict.fromkeys(QUANTITIES, 0.0) | dict(others or {})

        def settled(current: float, soc: float, temperature: float, form_factor_squared: float) -> float:
            q = usual.copy()
            q["soc"], q["cell_temperature"] = soc, temperature
            q["cell_capacity"] = battery.cell_capacity(temperature)
            lost = 0.0
            for effect, known, ages in effects:
                q["cell_current"] = load = battery.health.carried(current, ages)
                share = mean_response(effect.decay(BURST, q)) if known is None else known
                if form_factor_squared == 1 or share < UNMOVED:
                    lost += effect.term(q)
                    continue
                # The charge flows in bursts. An effect that is fast enough follows the current, not its mean. A gamma
                # distribution of currents of this form factor, weighted with the charge, has the mean and sd of two
                # currents, which tell what an effect loses that does not grow in proportion to the current.
                bursts = 1 + (form_factor_squared - 1) * share
                apart = sqrt((bursts - 1) / bursts)
                for part in (1 - apart, 1 + apart):
                    q["cell_current"] = part * bursts * load
                    lost += effect.term(q) / 2
            return lost

        return settled


# --- effects in the cells -----------------------------------------------------------------------------------------

BURST = 10.0  # s: a load in traffic
UNMOVED = 0.01  # an effect that shows less of a burst sees only the mean current
STOOD = 60.0  # s: duration of the load before a ride's first voltages: lights, a heater
STANDING_LOADS = 1.5  # times the auxiliary power: the most that is believed to have flowed before it was seen


def _share_of_bursts(effect: Bound) -> float | None:
    """How much of a burst an effect in the cells shows in the mean over it; None if the cells' state decides."""
    decay = effect.effect.decay
    return None if decay and decay.quantities else mean_response(effect.decay(BURST, {}))


def share_that_ages(effect: Bound) -> float:
    """How much of an effect in the cells grows with their resistance, which is learned from changes within `QUICK`.

    Slower effects, such as diffusion, do not show in those changes, and grow differently with age.
    """
    decay = effect.effect.decay
    return 1.0 if decay and decay.quantities else 1 - float(effect.decay(QUICK, {}))


def standing_load(current: float, voltage: float, auxiliary_power: float) -> float:
    """How much [A] of a pack's first `current` [A] at `voltage` [V] has already flowed for a while.

    More than the load of a standing vehicle is a rider who pulls away, or a sensor's error, as likely as a load.
    """
    most = STANDING_LOADS * auxiliary_power / voltage if voltage > 0 else 0.0
    return min(max(current, -most), most)
