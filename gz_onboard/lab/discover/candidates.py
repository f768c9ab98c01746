"""The causes that have a name: each a parameter that the vehicle file has, or an effect that its model lacks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from gz_onboard.physics.effect import Effect, Parameter, effects_in, known_effects, load_effect
from gz_onboard.physics.model import BASE_EFFECTS
from gz_onboard.physics.parameters import declared_parameters


@dataclass(frozen=True)
class Candidate:
    """A cause.

    parameters: those whose value is its strength, the first the one that is reported. low, high: how far each may
    change from its healthy value, in its unit. effect: the file it comes with, None for a parameter that every
    vehicle file has.
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
    def varies(self) -> bool:
        """Whether it differs from ride to ride by itself."""
        return self.effect is not None and self.effect.varies


# name: (parameter, sign of the change that its cause can make, equation, what shows it and splits it)
MOVABLE: Mapping[str, tuple[str, int, str, str]] = {
    "rolling_resistance": (
        "rolling_resistance_constant",
        0,
        "F = m·g·cos θ·c0",
        "Road load that is the same at all speeds and grows with weight; rides with another payload split it from a "
        "dragging brake.",
    ),
    "aero_drag_area": (
        "drag_area",
        0,
        "F = ½·ρ·CdA·V²",
        "Road load that grows with the square of speed; long stretches at 30 and at 50 km/h in both directions split "
        "it from drivetrain drag and wind.",
    ),
    "payload_mass": (
        "payload_mass",
        0,
        "F = m·(dV/dt + g·sin θ + g·c0·cos θ)",
        "Force short in acceleration and uphill, too large downhill; hills and firm starts split it from rolling "
        "resistance.",
    ),
    "tyre_radius": (
        "wheel_radius",
        0,
        "V = ω·r",
        "All wheel-speed sensors and the motor against GPS alike; a straight kilometre at steady speed.",
    ),
    "auxiliary_load": (
        "auxiliary_power",
        0,
        "P = P_aux",
        "The auxiliary current sensor, at standstill too; switching lamps one by one splits it from the sensor.",
    ),
    "winding_resistance": (
        "motor_copper_resistance",
        0,
        "P = r·(1 + a·(T − 25))·i²",
        "DC power over air-gap power grows with the square of the current, and the motor warms; full-throttle starts "
        "split it from inverter loss.",
    ),
    "torque_constant_loss": (
        "torque_constant",
        0,
        "τ = k·i",
        "Force and DC power both short per motor current reported, acceleration most; steady climbing splits it from "
        "the payload.",
    ),
    "inverter_loss": (
        "inverter_loss_linear",
        0,
        "P = c1·|i|",
        "DC power over air-gap power grows with the current itself, and the inverter warms; steady riding at low and "
        "at high torque splits it from winding resistance.",
    ),
    "capacity_fade": (
        "cell_capacity",
        0,
        "dSOC/dt = −I/(3600·Q)",
        "Rest voltage falls faster than the charge drawn says; a ride from full to nearly empty splits it from the "
        "gain of the current sensor, as the inverter's own does.",
    ),
    "resistance_growth": (
        "cell_resistance_factor",
        0,
        "V = OCV − f·(R0·I + V1)",
        "Voltage sinks more with every load at all temperatures; starts from rest at high and at low SOC.",
    ),
    "cooling_blocked": (
        "cooling_factor",
        0,
        "Q = f·G·(T − T_ambient)",
        "Motor, inverter and cells warm more than their losses say, and cool slower at rest; a hard ride, then rest.",
    ),
    "current_sensor_offset": (
        "pack_current_offset",
        0,
        "I_shown = g·I + I0",
        "Pack current less inverter and auxiliary current is not zero at standstill.",
    ),
    "current_sensor_gain": (
        "pack_current_gain",
        0,
        "I_shown = g·I + I0",
        "Pack current less inverter and auxiliary current grows with the current; charge against rest voltages.",
    ),
    "voltage_sensor_offset": (
        "pack_voltage_offset",
        0,
        "U_shown = U + U0",
        "Pack and inverter voltage differ at no current; the rest voltage of the full pack splits which one errs.",
    ),
    "speed_scale": (
        "speed_sensor_scale",
        0,
        "ω_shown = s·ω",
        "Motor speed against both wheel-speed sensors and GPS; coasting.",
    ),
    "sensor_latency": (
        "pack_voltage_latency",
        0,
        "U_shown(t) = U(t − T)",
        "Voltage answers steps of the current late or early; switching the throttle on and off.",
    ),
}


def candidates(folder: Path | None = None) -> tuple[Candidate, ...]:
    """Every candidate: the movable parameters, the package's effects beyond `BASE_EFFECTS`, and those in `folder`.

    Raises InputError for a file in `folder` that is no effect.
    """
    declared = declared_parameters()
    found = []
    for name, (parameter, sign, equation, shown_by) in MOVABLE.items():
        found.append(Candidate(name, (declared[parameter],), equation, shown_by, None, sign))
    packaged = [name for name in known_effects() if name not in BASE_EFFECTS]
    theirs = [name for name in effects_in(folder) if name not in packaged] if folder else []
    for name in (*packaged, *theirs):
        effect = load_effect(name, folder)
        own = {parameter.name: parameter for parameter in effect.parameters}
        if not effect.strengths:
            continue
        strengths = tuple(own[strength] for strength in effect.strengths)
        equation = effect.doc.splitlines()[0] if effect.doc else name
        sign = 1 if strengths[0].low >= 0 else 0
        found.append(Candidate(name, strengths, equation, effect.shown_by, effect, sign))
    return tuple(found)
