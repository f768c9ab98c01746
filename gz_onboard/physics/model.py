"""The forward model: a list of effects between road and battery, and the ledger of what each takes.

Backward in the sense of simulation (speed in, power out), light enough for on board; floats and numpy arrays alike.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, MutableMapping, Sequence
from functools import cache, partial
from pathlib import Path
from types import FunctionType
from typing import TYPE_CHECKING, Any

from gz_onboard.constants import KELVIN
from gz_onboard.errors import InputError, shown
from gz_onboard.physics.battery import HALF_FULL, QUICK, Battery, Overpotential
from gz_onboard.physics.effect import QUANTITIES, Effect, Port, effect_file, load_effect
from gz_onboard.physics.elementary import STANDSTILL, sqrt
from gz_onboard.physics.parameters import Parameters
from gz_onboard.physics.relaxation import mean_response, relaxation, relaxed
from gz_onboard.physics.sensors import road_speed
from gz_onboard.physics.trust import changeable, trusted_users

if TYPE_CHECKING:
    from gz_onboard.toml import Table

BASE_EFFECTS = (
    "aerodynamic_drag",
    "rolling_resistance",
    "grade_force",
    "inertia",
    "motor_copper_loss",
    "motor_iron_loss",
    "inverter_loss",
    "auxiliary_load",
)
"""What a vehicle file gets that lists none: what every vehicle has."""

GAS_CONSTANT_AIR = 287.05  # J/(kg·K)


def air_density(temperature: float, altitude: float = 0.0) -> float:
    """Density of dry air [kg/m³] at `temperature` [degC] and `altitude` [m] (ISO 2533: pressure)."""
    pressure = 101325 * (1 - 2.25577e-5 * altitude) ** 5.25588
    return float(pressure / (GAS_CONSTANT_AIR * (temperature + KELVIN)))


class Bound:
    """An effect with the values of its parameters.

    term: its value at quantities by name, floats or arrays; of an effect with memory, what it settles at.
    """

    def __init__(self, effect: Effect, parameters: Mapping[str, float]) -> None:
        self.effect = effect
        self._values = {name: parameters[name] for name in (*effect.keywords, *effect.decay_keywords)}
        self.bare_term = _valued(effect.term, {name: parameters[name] for name in effect.keywords})
        self.bare_decay = effect.decay and _valued(
            effect.decay, {name: parameters[name] for name in effect.decay_keywords}
        )
        self.term = _reader(effect.quantities)(self.bare_term)

    def __reduce__(self) -> tuple[type[Bound], tuple[Effect, dict[str, float]]]:
        """Pickled as effect and values: another process does not know the functions of a user's own file."""
        return Bound, (self.effect, self._values)

    def __call__(self, quantities: Mapping[str, Any]) -> Any:
        """See `term`."""
        return self.term(quantities)

    def decay(self, dt: Any, quantities: Mapping[str, Any]) -> Any:
        """The factor that its state keeps over `dt` [s]; of an effect without memory 0."""
        if self.bare_decay is None:
            return 0.0
        return self.bare_decay(dt, *[quantities[name] for name in self.effect.decay_quantities])

    def step(self, state: float, dt: float, quantities: Mapping[str, Any]) -> float:
        """Its value after `dt` [s] from `state`."""
        return float(relaxed(state, self(quantities), self.decay(dt, quantities)))

    def series(self, dt: Any, quantities: Mapping[str, Any], before: bool = False) -> Any:
        """Its values at the ends of steps of `dt` [s], with the quantities in them: scalars, or arrays of shape (n,).

        Shape (n,); n = 1 if all are scalars. From nothing remembered. before: at the beginnings instead.
        """
        import numpy as np

        target, decay = np.broadcast_arrays(
            np.asarray(self(quantities), dtype=float), np.asarray(self.decay(dt, quantities), dtype=float), np.ones(1)
        )[:2]
        if self.effect.decay is None or not target.any():
            return target.copy()
        return relaxation(target, decay, before=before)


def _valued(function: Callable[..., Any], values: Mapping[str, float]) -> Callable[..., Any]:
    """`function` with these keyword arguments.

    A simulation calls it a hundred times for each second ridden: values as the defaults of a copy take half the time
    that a `partial` takes.
    """
    f = function
    if isinstance(f, FunctionType) and f.__code__.co_kwonlyargcount == len(values):
        copy = FunctionType(f.__code__, f.__globals__, f.__name__, f.__defaults__, f.__closure__)
        copy.__kwdefaults__ = dict(values)
        return copy
    return partial(function, **values)


def _call(function: str, names: Iterable[str]) -> str:
    """Source of a call of `function` with the quantities `names` out of a dictionary ``q``."""
    return f"{function}({', '.join(f'q[{name!r}]' for name in names)})"


Recall = Callable[[Bound, Mapping[str, Any]], Any]
"""The value of an effect with memory at these quantities."""


def over(dt: Any, before: bool = False) -> Recall:
    """For arrays over steps of `dt` [s], in their order, from nothing remembered: see `Bound.series`."""
    return lambda effect, quantities: effect.series(dt, quantities, before)


def stepping(states: MutableMapping[str, float], dt: float) -> Recall:
    """One step of `dt` [s] from `states`, by the names of the effects, which it moves on; 0 for what is not there."""

    def recall(effect: Bound, quantities: Mapping[str, Any]) -> float:
        name = effect.effect.name
        states[name] = x = effect.step(states.get(name, 0.0), dt, quantities)
        return x

    return recall


@cache
def _reader(names: tuple[str, ...]) -> Callable[[Callable[..., Any]], Callable[[Mapping[str, Any]], Any]]:
    """Turns a function of the quantities `names` into one of a dictionary of quantities."""
    return eval(f"lambda function: lambda q: {_call('function', names)}")  # type: ignore[no-any-return]


def stepper(effects: Sequence[Bound], dt: float) -> Callable[[Mapping[str, float]], tuple[float, ...]]:
    """A function from quantities (floats) to the values of `effects`, to be called once each step of `dt` [s].

    Effects with memory start from 0. The function is written out as source, without loops and layers of calls:
    a simulation calls it a hundred times for each second ridden.
    """
    scope: dict[str, Any] = {}
    lines = []
    for i, bound in enumerate(effects):
        effect = bound.effect
        scope[f"term{i}"] = bound.bare_term
        call = _call(f"term{i}", effect.quantities)
        if bound.bare_decay:
            scope[f"state{i}"], scope[f"decay{i}"] = 0.0, partial(bound.bare_decay, dt)
            decay = _call(f"decay{i}", effect.decay_quantities)
            if not effect.decay_quantities:
                scope[f"kept{i}"], decay = bound.bare_decay(dt), f"kept{i}"
            lines += [f"k = {decay}", f"state{i} = k * state{i} + (1 - k) * {call}"]
            call = f"state{i}"
        lines.append(f"value{i} = {call}")
    states = ", ".join(name for name in scope if name.startswith("state"))
    values = "".join(f"value{i}, " for i in range(len(effects)))
    body = [f"global {states}"] if states else []
    source = "\n    ".join(["def values(q):", *body, *lines, f"return ({values})"])
    exec(source, scope)
    return scope["values"]  # type: ignore[no-any-return]


BURST = 10.0  # s: a load in traffic
UNMOVED = 0.01  # of a burst: what shows less of it sees the mean current only


def _share_of_bursts(effect: Bound) -> float | None:
    """What of a burst an effect in the cells shows in the mean over it; None if that depends on how they are."""
    return None if effect.effect.decay_quantities else mean_response(effect.decay(BURST, {}))


def share_that_ages(effect: Bound) -> float:
    """How much of an effect in the cells grows with their resistance, which is learned from changes within `QUICK`.

    What takes longer to show is not in those: diffusion, whose growth with age is another.
    """
    return 1.0 if effect.effect.decay_quantities else 1 - float(effect.decay(QUICK, {}))


STOOD = 60.0  # s: for so long the load of a ride's first voltages has flowed: lights, a heater
STANDING_LOADS = 1.5  # times the auxiliary power: the most that is believed to have flowed before it was seen


def standing_load(current: float, voltage: float, auxiliary_power: float) -> float:
    """How much of a pack's first `current` [A] at `voltage` [V] has flowed for a while already.

    More than a standing vehicle draws is a rider who pulls away, or a sensor's error, as likely as a load.
    """
    most = STANDING_LOADS * auxiliary_power / voltage if voltage > 0 else 0.0
    return min(max(current, -most), most)


def first_soc(
    effects: Iterable[Bound], battery: Battery, first: tuple[float, float], temperature: float, load: float
) -> float:
    """The SOC out of the pack's first voltage [V] and current [A] of a ride.

    effects: in the cells; temperature in degC; load: the current [A] that has flowed for `STOOD`, from rest, see
    `standing_load`. The RC pair, slower than most of them, is taken to be at rest still. It may be below 0 or above 1,
    see `Battery.soc_at_load`.
    """
    voltage, current = first
    cell, capacity = current / battery.cells_parallel, battery.cell_capacity(temperature)
    q = all_quantities(
        cell_current=load / battery.cells_parallel, soc=HALF_FULL, cell_temperature=temperature, cell_capacity=capacity
    )
    lost = float(sum(effect(q) * (1 - effect.decay(STOOD, q)) for effect in effects))
    return battery.soc_at_load(battery.cell_voltage(voltage, current) + lost, cell, temperature)


def value_of(effect: Bound, quantities: Mapping[str, Any], recall: Recall | None = None) -> Any:
    """The value of `effect`; recall: gives that of one with memory, which without it is what it settles at."""
    return recall(effect, quantities) if recall and effect.effect.decay else effect(quantities)


def total(effects: Iterable[Bound], quantities: Mapping[str, Any], recall: Recall | None = None) -> Any:
    """The sum of the values of `effects`: see `value_of`."""
    result: Any = 0.0
    for effect in effects:
        result = result + value_of(effect, quantities, recall)
    return result


def all_quantities(**known: Any) -> dict[str, Any]:
    """What effects read, floats or arrays: `known`, the cosine of its ``grade``, and 0 for everything else."""
    cosine = sqrt(1 - known["grade"] * known["grade"]) if "grade" in known else 1.0
    return dict.fromkeys(QUANTITIES, 0.0) | {"grade_cosine": cosine} | known


def drag_torque(power: Any, motor_speed: Any) -> Any:
    """Torque [N·m] against the motion by which `power` [W] of loss at no current slows the motor; 0 at standstill."""
    return power * motor_speed / (motor_speed * motor_speed + STANDSTILL * STANDSTILL)


class Model:
    """The effects of one vehicle with its parameters.

    reads: the quantities that its effects need. cell_voltage: the effects in the cells, by name.
    """

    def __init__(self, effects: tuple[Effect, ...], parameters: Parameters) -> None:
        self.effects = effects
        self.parameters = parameters
        self._at: dict[Port, list[tuple[str, Bound]]] = {port: [] for port in Port}
        for effect in effects:
            self._at[effect.port].append((effect.name, Bound(effect, parameters)))
        self.reads: frozenset[str] = frozenset(name for effect in effects for name in effect.reads)
        self.cell_voltage = self._at[Port.CELL_VOLTAGE]
        self.mass = parameters["vehicle_mass"] + parameters["payload_mass"]
        self._motor_per_speed = 1 / road_speed(1.0, parameters)

    def at(self, *ports: Port) -> list[Bound]:
        """The effects at these ports."""
        return [effect for port in ports for _, effect in self._at[port]]

    def idle_loss(self, quantities: Mapping[str, Any]) -> Any:
        """What the motor loses [W] turning without current: drag on the shaft, which its current makes up for."""
        return total(self.at(Port.MOTOR_LOSS), {**quantities, "torque": 0.0, "motor_current": 0.0})

    def power(self, quantities: Mapping[str, Any], recall: Recall | None = None) -> dict[str, Any]:
        """The ledger [W] of moving as `quantities` say: what each effect takes out of the pack, by name.

        `quantities` are those that the model `reads`, but for motor_speed, torque and motor_current, which follow
        from the road load. recall: gives the value of an effect with memory; without one, what it settles at. Effects
        in the cells are not in it: they are behind the pack's terminals.
        ``brakes`` is what the friction brakes turn to heat where the motor cannot brake enough. The sum of the ledger
        is the power at the pack's terminals; kinetic and potential energy are
        the entries ``inertia`` and ``grade_force``.
        """
        q = dict(quantities)
        speed = q["speed"]
        ledger: dict[str, Any] = {}
        force = 0.0
        for name, effect in (*self._at[Port.WHEEL_FORCE], *self._at[Port.TYRE]):
            term = value_of(effect, q, recall)
            force = force + term
            ledger[name] = term * speed
        motor_speed = speed * self._motor_per_speed
        wanted = force / self._motor_per_speed  # torque at the motor's shaft
        limit = -self.parameters["regeneration_torque_limit"]
        torque = (wanted + limit + abs(wanted - limit)) / 2  # the greater of both, for arrays too
        ledger["brakes"] = (torque - wanted) * motor_speed
        q["motor_speed"] = motor_speed
        q["torque"] = torque + drag_torque(self.idle_loss(q), motor_speed)
        q["motor_current"] = q["torque"] / self.parameters["torque_constant"]
        for port in (Port.MOTOR_LOSS, Port.INVERTER_LOSS, Port.DC_POWER):
            for name, effect in self._at[port]:
                ledger[name] = value_of(effect, q, recall)
        return ledger

    def overpotential(self, battery: Battery, beside: Mapping[str, float] | None = None) -> Overpotential | None:
        """What the terminals of `battery`'s cells lack [V] by all effects in them, settled; None without any.

        beside: other quantities than the cells' that they may read; 0 if not given.
        """
        if not self.cell_voltage:
            return None
        others = dict.fromkeys(QUANTITIES, 0.0) | dict(beside or {})
        effects = [(x, _share_of_bursts(x), share_that_ages(x)) for x in self.at(Port.CELL_VOLTAGE)]
        by_capacity = "cell_capacity" in self.reads

        def settled(current: float, soc: float, temperature: float, form_factor_squared: float) -> float:
            # A forecast calls it a hundred times: one dictionary for all effects, and no bursts where there are none.
            q = others.copy()
            q["soc"], q["cell_temperature"] = soc, temperature
            if by_capacity:
                q["cell_capacity"] = battery.cell_capacity(temperature)
            lost = 0.0
            for effect, known, ages in effects:
                q["cell_current"] = load = battery.health.carried(current, ages)
                share = mean_response(effect.decay(BURST, q)) if known is None else known
                if form_factor_squared == 1 or share < UNMOVED:
                    lost += effect(q)
                    continue
                # The charge flows in bursts, of which an effect that is fast enough sees the current, not the mean.
                bursts = 1 + (form_factor_squared - 1) * share
                # A gamma distribution of currents of this form factor, as the charge sees it: its mean and its sd are
                # those of two currents, which tell what an effect loses that does not grow with the current.
                apart = sqrt((bursts - 1) / bursts)
                for part in (1 - apart, 1 + apart):
                    q["cell_current"] = part * bursts * load
                    lost += effect(q) / 2
            return lost

        return settled


def read_model(vehicle: Table, folder: Path | None = None, users: Collection[int] | None = None) -> tuple[Effect, ...]:
    """The effects that the vehicle file lists, `BASE_EFFECTS` if it lists none.

    An effect is looked for in `folder`, in the file's own ``effects_folder``, and among the package's. That of the file
    is code that came with data: it runs only if nobody but `users` (their ids; root and who runs us if not given) can
    change the file or the effect. InputError otherwise.
    """
    if folder and not folder.is_dir():
        raise InputError(f"{folder}: no such folder of effects")
    table = vehicle.table("model")
    table.only(["effects", "effects_folder"])
    own = _own_folder(table)
    names = table.texts("effects", "names of effects") if "effects" in table.values else BASE_EFFECTS
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise table.error(f"{shown(twice)} is there twice", "effects")
    effects = []
    for name in names:
        table.check_path("effects", name)
        try:
            given = effect_file(name, folder) if folder else None
            if own and not given and (file := effect_file(name, own)):
                _check_trust(vehicle.file, file, trusted_users() if users is None else users)
                effects.append(load_effect(name, own))
            else:
                effects.append(load_effect(name, folder or own))
        except Exception as error:
            raise table.error(str(error), "effects") from error
    return tuple(effects)


def _own_folder(model: Table) -> Path | None:
    """The file's own ``effects_folder``, which must lie in the file's."""
    if "effects_folder" not in model.values:
        return None
    name = model.check_path("effects_folder", model.text("effects_folder"))
    folder = model.file.parent / name
    if Path(name).is_absolute() or not folder.resolve().is_relative_to(model.file.parent.resolve()):
        raise model.error(f"{name!r} is not below the vehicle file's own folder", "effects_folder")
    if not folder.is_dir():
        raise model.error(f"no folder {folder}", "effects_folder")
    return folder


def _check_trust(vehicle: Path, effect: Path, users: Collection[int]) -> None:
    """InputError if `effect` leaves the vehicle file's folder by a link, or others can change it or the file."""
    if not effect.resolve().is_relative_to(vehicle.parent.resolve()):
        raise InputError(f"{effect} is a link that leads out of the vehicle file's folder")
    for file in (vehicle, effect):
        if reason := changeable(file, users):
            raise InputError(
                f"{effect.name} beside the file is code, and not run: {reason}; "
                "`run` and `discover` take a folder that you trust by --effects"
            )
