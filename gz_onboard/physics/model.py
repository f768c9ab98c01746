"""The forward model: a list of effects between road and battery, and the ledger of what each takes.

Backward in the sense of simulation (speed in, power out), light enough for on board; floats and numpy arrays alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from gz_onboard.physics.effect import Effect, Port, load_effect
from gz_onboard.physics.parameters import Parameters

if TYPE_CHECKING:
    from pathlib import Path

    from gz_onboard.toml import Table

G = 9.80665  # m/s²
BASE_EFFECTS = (
    "aerodynamic_drag", "rolling_resistance", "grade_force", "inertia", "motor_copper_loss", "motor_iron_loss",
    "inverter_loss", "auxiliary_load",
)  # fmt: skip
"""What a vehicle file gets that lists none: what every vehicle has."""

GAS_CONSTANT_AIR = 287.05  # J/(kg·K)


def air_density(temperature: float, altitude: float = 0.0) -> float:
    """Density of dry air [kg/m³] at `temperature` [degC] and `altitude` [m] (ISO 2533: pressure)."""
    pressure = 101325 * (1 - 2.25577e-5 * altitude) ** 5.25588
    return float(pressure / (GAS_CONSTANT_AIR * (temperature + 273.15)))


@dataclass(frozen=True)
class Bound:
    """An effect with the values of its parameters."""

    effect: Effect
    values: dict[str, float]

    def __call__(self, quantities: Mapping[str, Any]) -> Any:
        """Its term at these quantities."""
        effect = self.effect
        return effect.term(*[quantities[name] for name in effect.quantities], **self.values)


class Model:
    """The effects of one vehicle with its parameters."""

    def __init__(self, effects: tuple[Effect, ...], parameters: Parameters) -> None:
        self.effects = effects
        self.parameters = parameters
        self._at: dict[Port, list[tuple[str, Bound]]] = {port: [] for port in Port}
        for effect in effects:
            values = {name: parameters[name] for name in effect.keywords}
            self._at[effect.port].append((effect.name, Bound(effect, values)))
        self.mass = parameters["vehicle_mass"] + parameters["payload_mass"]
        self._motor_per_speed = 1 / (parameters["wheel_radius"] * parameters["gear_ratio"])

    def power(self, quantities: Mapping[str, Any]) -> dict[str, Any]:
        """The ledger [W] of moving as `quantities` say: what each effect takes out of the pack, by name.

        `quantities` are the names of `effect.QUANTITIES` but for motor_speed and motor_current, which follow
        from the road load. ``brakes`` is what the friction brakes turn to heat where the motor cannot brake
        enough. The sum of the ledger is the power at the pack's terminals; kinetic and potential energy are
        the entries ``inertia`` and ``grade_force``.
        """
        q = dict(quantities)
        speed = q["speed"]
        ledger: dict[str, Any] = {}
        force = 0.0
        for name, effect in (*self._at[Port.WHEEL_FORCE], *self._at[Port.TYRE]):
            term = effect(q)
            force = force + term
            ledger[name] = term * speed
        motor_speed = speed * self._motor_per_speed
        wanted = force / self._motor_per_speed  # torque at the motor's shaft
        limit = -self.parameters["regeneration_torque_limit"]
        torque = (wanted + limit + abs(wanted - limit)) / 2  # the greater of both, for arrays too
        ledger["brakes"] = (torque - wanted) * motor_speed
        q["motor_speed"] = motor_speed
        q["motor_current"] = torque / self.parameters["torque_constant"]
        for port in (Port.MOTOR_LOSS, Port.INVERTER_LOSS, Port.DC_POWER):
            for name, effect in self._at[port]:
                ledger[name] = effect(q)
        return ledger


def read_model(vehicle: Table) -> tuple[Effect, ...]:
    """The effects that the vehicle file lists, `BASE_EFFECTS` if it lists none."""
    table = vehicle.table("model")
    table.only(["effects", "effects_folder"])
    folder: Path | None = None
    if "effects_folder" in table.values:
        folder = vehicle.file.parent / table.text("effects_folder")
        if not folder.is_dir():
            raise table.error(f"no folder {folder}", "effects_folder")
    names = table.values.get("effects", list(BASE_EFFECTS))
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise table.error("must be a list of names of effects", "effects")
    effects = []
    for name in names:
        try:
            effects.append(load_effect(name, folder))
        except Exception as error:
            raise table.error(str(error), "effects") from error
    return tuple(effects)
