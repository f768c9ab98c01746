"""The causes that have a name: each a parameter that the vehicle file has, or an effect that its model lacks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from gz_onboard.model.effect import BASE_EFFECTS, Effect, Parameter, Port, effects_in, load_effect, package_effects
from gz_onboard.model.parameters import declared_parameters
from gz_onboard.offline.traits import traits


@dataclass(frozen=True)
class Candidate:
    """A cause.

    parameters: those whose value is its strength, the first the one that is reported. effect: the file it comes with,
    None for a parameter that every vehicle file has.
    """

    name: str
    parameters: tuple[Parameter, ...]
    equation: str
    shown_by: str
    effect: Effect | None = None
    sign: int = 0  # of the change that the cause can make: 0 either

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its parameters."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def reads(self) -> tuple[str, ...]:
        """The names of those that its effect takes beside them."""
        return tuple(name for name in self.effect.term.parameters if name not in self.names) if self.effect else ()

    @property
    def varies(self) -> bool:
        """Whether it differs from ride to ride by itself."""
        return self.effect is not None and traits(self.effect).varies


# name: (where it acts, None if it is a sensor or the cooling; parameter, equation, what shows it and splits it)
VEHICLE_CAUSES: Mapping[str, tuple[Port | None, str, str, str]] = {
    "payload_mass": (
        Port.WHEEL_FORCE,
        "payload_mass",
        "F = m·(dV/dt + g·sin θ + g·c0·cos θ)",
        "Force short in acceleration and uphill, too large downhill; hills and firm starts split it from rolling "
        "resistance.",
    ),
    "tyre_radius": (
        Port.WHEEL_FORCE,
        "wheel_radius",
        "V = ω·r",
        "All wheel-speed sensors and the motor against GPS alike; a straight kilometre at steady speed.",
    ),
    "torque_constant_loss": (
        Port.MOTOR_LOSS,
        "torque_constant",
        "τ = k·i",
        "Force and DC power both short per motor current reported, acceleration most; steady climbing splits it "
        "from the payload.",
    ),
    "capacity_fade": (
        Port.CELL_VOLTAGE,
        "cell_capacity",
        "dSOC/dt = −I/(3600·Q)",
        "Rest voltage falls faster than the charge drawn says; a ride from full to nearly empty splits it from the"
        " gain of the current sensor, as the inverter's own does.",
    ),
    "resistance_growth": (
        Port.CELL_VOLTAGE,
        "cell_resistance_factor",
        "V = OCV − f·(R0·I + V1)",
        "Voltage sinks more with every load at all temperatures; starts from rest at high and at low SOC.",
    ),
    "cooling_blocked": (
        None,
        "cooling_factor",
        "Q = f·G·(T − T_ambient)",
        "Motor, inverter and cells warm more than their losses say, and cool slower at rest; a hard ride, then rest.",
    ),
    "current_sensor_offset": (
        None,
        "pack_current_offset",
        "I_shown = g·I + I0",
        "Pack current less inverter and auxiliary current is not zero at standstill.",
    ),
    "current_sensor_gain": (
        None,
        "pack_current_gain",
        "I_shown = g·I + I0",
        "Pack current less inverter and auxiliary current grows with the current; charge against rest voltages.",
    ),
    "voltage_sensor_offset": (
        None,
        "pack_voltage_offset",
        "U_shown = U + U0",
        "Pack and inverter voltage differ at no current; the rest voltage of the full pack splits which one errs.",
    ),
    "speed_scale": (
        None,
        "speed_sensor_scale",
        "ω_shown = s·ω",
        "Motor speed against both wheel-speed sensors and GPS; coasting.",
    ),
    "sensor_latency": (
        None,
        "pack_voltage_latency",
        "U_shown(t) = U(t − T)",
        "Voltage answers steps of the current late or early; switching the throttle on and off.",
    ),
}
PLACES = (Port.TYRE, Port.WHEEL_FORCE, Port.DC_POWER, Port.MOTOR_LOSS, Port.INVERTER_LOSS, Port.CELL_VOLTAGE, None)
"""The order of the causes that every vehicle can have: from the road to the cells, sensors last."""


def candidates(folder: Path | None = None) -> tuple[Candidate, ...]:
    """Every candidate: changes of what every vehicle has, the package's effects beyond `BASE_EFFECTS`, and those in
    `folder`. Raises InputError for a file in `folder` that is no effect.
    """
    declared = declared_parameters()
    own = [load_effect(name) for name in package_effects()]
    changes: list[tuple[Port | None, Candidate]] = [
        (effect.port, Candidate(known.cause[0], _strengths(effect), known.cause[1], known.shown_by))
        for effect, known in ((effect, traits(effect)) for effect in own)
        if known.cause
    ]
    for name, (place, parameter, equation, shown_by) in VEHICLE_CAUSES.items():
        changes.append((place, Candidate(name, (declared[parameter],), equation, shown_by)))
    found = [cause for _, cause in sorted(changes, key=lambda row: PLACES.index(row[0]))]
    packaged = [name for name in package_effects() if name not in BASE_EFFECTS]
    theirs = [name for name in effects_in(folder) if name not in packaged] if folder else []
    for effect in (load_effect(name, folder) for name in (*packaged, *theirs)):
        if strengths := _strengths(effect):
            known = traits(effect)
            equation = known.doc.splitlines()[0] if known.doc else effect.name
            sign = 1 if strengths[0].low >= 0 else 0
            found.append(Candidate(effect.name, strengths, equation, known.shown_by, effect, sign))
    return tuple(found)


def _strengths(effect: Effect) -> tuple[Parameter, ...]:
    return tuple(p for name in traits(effect).strengths for p in effect.parameters if p.name == name)
