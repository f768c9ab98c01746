"""The residual of the pack's power: what stands in where currents behind the pack were not measured."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.constants import GRAVITY
from gz_onboard.discovery.grid import STEP, Ride
from gz_onboard.discovery.residuals import auxiliary_power, electric_power, motor_losses, moving
from gz_onboard.discovery.system import System, Values, summed
from gz_onboard.model.effect import ROAD_LOAD
from gz_onboard.model.effects.inertia import rotating_mass
from gz_onboard.model.sensors import true_current, true_voltage

AS_IN_FILE = (
    "pack_current_gain",
    "wheel_radius",
    "speed_sensor_scale",
    "torque_constant",
    "torque_constant_slope",
    "torque_saturation",
)


def road_power(ride: Ride, q: Mapping[str, Array], p: Values, system: System) -> Array:
    """The air-gap power [W] of a motor that moves the vehicle as it moves: against road load and its own drag."""
    if "accel_x" in ride.signals:
        specific = ride.signals["accel_x"] - p["accel_bias"] - p["pitch_gain"] * q["acceleration"]
    else:
        specific = q["acceleration"] + GRAVITY * q["grade"]
    force = q["mass"] * specific + rotating_mass(p) * q["acceleration"]
    force = force + summed(system.terms(q, p, STEP, *ROAD_LOAD))
    return np.asarray(force * q["speed"] + motor_losses(ride, q, p, system)[1])


def pack_power(ride: Ride, p: Values, system: System) -> Array:
    """The pack's power [W] less the drive's and the auxiliaries', each as measured, or by its model where it was not.

    Without the motor's current the drive is that of the road load, its losses at the current that the pack's power
    points to. So the noise of acceleration stands alone: losses that grow with it could be sought to take it off. For
    the same reason the residual is that of the mass entered, as in `road_force`. And what the whole drive is in
    proportion to is the file's (`AS_IN_FILE`): hills that nothing shows would be taken off by it.
    """
    s = ride.signals
    if "motor_current" not in s:
        p = {**p, **{name: system.healthy.get(name, 0.0) for name in AS_IN_FILE}}
    volts = true_voltage(s["pack_voltage"], p)
    power = volts * true_current(s["pack_current"], p) - ride.loads
    if "auxiliary_current" in s:
        power = power - volts * (s["auxiliary_current"] + p["idle_current"])
    else:
        power = power - auxiliary_power(ride, p, system)
    q = moving(ride, p, system)
    if "motor_current" not in s:
        drive = electric_power(ride, q, road_power(ride, q, p, system), p, system)
        return np.asarray((power - drive) * (ride.quantities["mass"] / q["mass"] if "accel_x" in s else 1.0))
    if "inverter_voltage" in s and "inverter_current" in s:
        inverter = (s["inverter_current"] - p["inverter_current_offset"]) / p["inverter_current_gain"]
        return np.asarray(power - volts * p["idle_current"] - s["inverter_voltage"] * inverter)
    return np.asarray(power - electric_power(ride, q, q["torque"] * q["motor_speed"], p, system))
