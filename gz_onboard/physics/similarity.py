"""How priors grow with the vehicle: by what the file says of it against the scooter that the priors are of.

Losses, loads and limits are the same share of the power at the same acceleration and speed in any vehicle; noises and
offsets of sensors are the same share of the pack's size, and its other resistances of its cells'.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import prod

MOST_CELLS = 1000  # in series, or in parallel
USUAL_CELLS = {"cells_series": 14.0, "cells_parallel": 12.0}  # of the scooter's pack

_MASS = {"vehicle_mass": 1.0}
_LIGHT = {"vehicle_mass": 0.8}  # lights and electronics: a car's are not fifteen times a scooter's
_ROTATING = {"vehicle_mass": 1.0, "wheel_radius": 2.0}
_TORQUE = {"mass": 1.0, "wheel_radius": 1.0, "gear_ratio": 1.0}  # at the motor's shaft; W over its speed
_CURRENT_SQUARED = {"mass": -1.0, "wheel_radius": -2.0, "gear_ratio": -2.0, "torque_constant": 2.0}  # W over it
_PACK_CAPACITY = {"cells_parallel": 1.0, "cell_capacity": 1.0}
_CELLS = _PACK_CAPACITY | {"cells_series": 1.0}
_PACK_RESISTANCE = {"cells_series": 1.0, "cells_parallel": -1.0, "cell_capacity": -1.0}

_LAWS: tuple[tuple[dict[str, float], str], ...] = (
    (_MASS, "brake_drag_force motor_stator_capacity motor_rotor_capacity motor_gap_conductance motor_rotor_to_ambient"),
    (_MASS, "motor_rotor_per_speed inverter_box_per_speed"),
    (_MASS, "inverter_board_capacity inverter_box_capacity inverter_board_to_air inverter_box_to_air"),
    (_MASS, "inverter_board_to_box inverter_box_to_ambient"),
    (_LIGHT, "auxiliary_power inverter_loss_constant"),
    (_ROTATING, "wheel_inertia_front wheel_inertia_rear drivetrain_drag_torque"),
    (_TORQUE, "regeneration_torque_limit motor_iron_linear"),
    (_TORQUE | {"torque_constant": -1.0}, "motor_current_limit"),
    ({"mass": 1.0, "wheel_radius": 2.0, "gear_ratio": 2.0}, "motor_iron_quadratic"),
    ({"wheel_radius": 2.0, "gear_ratio": 2.0}, "motor_copper_frequency"),
    ({"wheel_radius": -1.0, "gear_ratio": -1.0, "torque_constant": 1.0}, "inverter_loss_linear"),
    (_CURRENT_SQUARED, "inverter_loss_quadratic motor_copper_resistance"),
    ({"torque_constant": 1.0}, "voltage_constant"),
    ({"mass": 1.0}, "brake_viscous_constant"),
    ({"mass": 1.0}, "brake_force_per_pressure"),
    ({"mass": 1.0, "wheel_radius": 1.0}, "brake_torque_limit"),
    ({"wheel_radius": 1.0}, "brake_disc_radius"),
    ({"vehicle_mass": 0.25}, "wheelbase"),
    ({"wheelbase": 1.0}, "cg_to_rear"),
    ({"mass": 1.0, "wheelbase": 2.0}, "yaw_inertia"),
    (_PACK_CAPACITY, "pack_current_offset pack_current_noise"),
    ({"cells_series": 1.0}, "pack_voltage_noise pack_voltage_offset"),
    (_PACK_RESISTANCE, "pack_series_resistance cable_resistance bms_resistance"),
    (_CELLS, "pack_heat_capacity pack_conductance bms_heat_capacity bms_conductance"),
    ({"cell_capacity": 1.0}, "cell_mass"),
    ({"cell_capacity": -1.0}, "slow_resistance charge_transfer_resistance"),
)
POWERS = {name: law for law, names in _LAWS for name in names.split()}
"""By parameter, the powers it grows with: of other parameters, of ``mass`` (with payload) and of the cells' numbers."""


def relative_size(name: str, known: Mapping[str, float], usual: Mapping[str, float]) -> float:
    """The prior of `name` where the others are `known`, over that of the scooter, whose priors are `usual`."""

    def relative(other: str) -> float:
        if other == "mass":
            return _mass(known) / _mass(usual)
        return known[other] / (USUAL_CELLS[other] if other in USUAL_CELLS else usual[other])

    return prod((relative(other) ** power for other, power in POWERS.get(name, {}).items()), start=1.0)


def _mass(values: Mapping[str, float]) -> float:
    return values["vehicle_mass"] + values["payload_mass"]
