"""The scooters of the plant: what they are made of. Near the reference scooter, no two alike, none the model's.

A `Machine` holds numbers only; `ride.py` has the equations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

G = 9.80665
SERIES, PARALLEL = 14, 12

# Open-circuit voltage of the cell at rest: points of an NMC 18650 of 2.8 A·h, joined by a monotone cubic.
OCV_POINTS = (
    (0.0, 2.60),
    (0.004, 2.72),
    (0.012, 2.89),
    (0.022, 3.035),
    (0.036, 3.16),
    (0.055, 3.27),
    (0.08, 3.362),
    (0.12, 3.446),
    (0.17, 3.505),
    (0.23, 3.551),
    (0.31, 3.596),
    (0.4, 3.640),
    (0.47, 3.680),
    (0.54, 3.733),
    (0.61, 3.800),
    (0.68, 3.865),
    (0.76, 3.938),
    (0.84, 4.013),
    (0.92, 4.092),
    (0.965, 4.140),
    (0.985, 4.167),
    (1.0, 4.193),
)


@dataclass(frozen=True)
class Machine:
    """One scooter; SI units, temperatures in degC."""

    # chassis and tyres
    mass: float = 105.0
    cg_height: float = 0.63
    crown_radius: float = 0.052
    rotating_mass: float = 7.5  # kg, wheels and motor at the tread
    wheel_radius: float = 0.2440
    front_radius: float = 0.2441
    drag_area: float = 0.55  # of a rider of 80 kg, no cross-wind
    drag_yaw: float = 0.35  # more drag area at 90 degrees of yaw
    rolling: float = 0.0118  # at a tyre of 25 degC
    rolling_speed: float = 1.6e-4  # per (m/s)², of the constant part 1
    rolling_temperature: float = 0.010  # 1/K
    tyre_time: float = 650.0  # s
    tyre_heating: float = 0.9  # K per m/s of speed
    camber_rolling: float = 0.11  # rad: loss of a leaning tyre twisting on the road
    cornering_stiffness: float = 15.0  # 1/rad
    camber_stiffness: float = 0.84
    slip_stiffness: float = 15.5
    bearing_drag: float = 0.8  # N
    # motor and inverter
    torque_constant: float = 0.4560  # at 40 degC, small currents
    torque_temperature: float = 0.0006  # 1/K
    torque_saturation: float = 0.045  # at 200 A
    copper: float = 0.0162  # ohm at 25 degC, standing
    copper_frequency: float = 0.20  # more at 57 rad/s
    hysteresis_loss: float = 0.83  # W·s/rad
    eddy_loss: float = 0.0155
    excess_loss: float = 0.012  # W·(s/rad)^1.5
    inverter_idle: float = 5.7
    inverter_switching: float = 0.37  # W/A at 50 V
    inverter_conduction: float = 0.0024
    current_limit: float = 207.7
    regeneration_current: float = 40.5
    pack_limit: float = 92.0
    cable: float = 0.0086
    auxiliary: float = 43.6
    brake_light: float = 4.2
    # battery, of a cell
    capacity: float = 2.735
    capacity_temperature: float = 0.0018  # 1/K below 25 degC
    ohmic: float = 0.0215
    film: float = 0.0185
    diffusion_a: float = 0.0035  # 6 s
    diffusion_b: float = 0.0060  # 45 s
    depletion_a: float = 0.0120  # of SOC per A, of the particles' surface before their inside: 45 s
    depletion_b: float = 0.0055  # 300 s
    depletion_c: float = 0.0070  # 1800 s
    cathode_exchange: float = 2.0  # A at 25 degC
    anode_exchange: float = 8.0
    cathode_layer: float = 2.8  # s, until its double layer is charged
    anode_layer: float = 0.5
    hysteresis: float = 0.003  # V
    ocv_shift: float = 0.0
    ocv_wave: float = 0.0  # V, its own shape
    ocv_phase: float = 0.0
    series_resistance: float = 0.0062
    core_capacity: float = 9000.0  # J/K, of the pack
    shell_capacity: float = 3000.0
    core_to_shell: float = 14.0  # W/K
    shell_to_air: float = 0.9
    # heat of motor and inverter
    stator_capacity: float = 3100.0
    rotor_capacity: float = 4100.0
    stator_to_rotor: float = 5.2
    rotor_to_air: float = 4.0
    board_capacity: float = 700.0
    box_capacity: float = 2300.0
    board_to_box: float = 4.2
    box_to_air: float = 2.6
    # sensors
    current_gain: float = 1.011
    current_offset: float = 0.02
    voltage_offset: float = 0.015
    inverter_voltage_offset: float = -0.015
    inverter_current_gain: float = 1.0
    accel_bias_x: float = 0.0
    accel_pitch: float = -0.02  # of the acceleration: the body pitches, and the sensor's gain
    accel_bias_y: float = 0.0
    accel_bias_z: float = -0.045
    gyro_bias_x: float = 0.0022
    gyro_bias_y: float = -0.0027
    gyro_bias_z: float = -0.0007
    ambient_bias: float = 0.0
    gps_latency: float = 0.40
    bms_latency: float = 0.10
    cell_probe_bias: float = 0.0


# How much scooters of one make differ: relative standard deviations, and absolute ones.
SPREAD = {
    "wheel_radius": 0.002,
    "front_radius": 0.002,
    "drag_area": 0.03,
    "rolling": 0.05,
    "rolling_temperature": 0.15,
    "tyre_time": 0.15,
    "camber_rolling": 0.15,
    "slip_stiffness": 0.1,
    "bearing_drag": 0.3,
    "torque_constant": 0.008,
    "copper": 0.03,
    "hysteresis_loss": 0.05,
    "eddy_loss": 0.06,
    "inverter_switching": 0.04,
    "auxiliary": 0.03,
    "capacity": 0.01,
    "ohmic": 0.05,
    "film": 0.06,
    "diffusion_a": 0.08,
    "diffusion_b": 0.08,
    "depletion_a": 0.08,
    "depletion_b": 0.15,
    "depletion_c": 0.2,
    "hysteresis": 0.3,
    "series_resistance": 0.15,
    "core_capacity": 0.05,
    "shell_to_air": 0.2,
    "stator_capacity": 0.05,
    "rotor_capacity": 0.05,
    "rotor_to_air": 0.1,
    "board_capacity": 0.05,
    "box_capacity": 0.05,
    "box_to_air": 0.1,
    "core_to_shell": 0.1,
}
SPREAD_ABSOLUTE = {
    "current_gain": 0.004,
    "current_offset": 0.03,
    "voltage_offset": 0.015,
    "inverter_voltage_offset": 0.015,
    "inverter_current_gain": 0.003,
    "accel_bias_x": 0.03,
    "accel_pitch": 0.03,
    "accel_bias_y": 0.03,
    "gyro_bias_x": 0.001,
    "gyro_bias_y": 0.001,
    "gyro_bias_z": 0.0006,
    "ambient_bias": 0.3,
    "gps_latency": 0.03,
    "ocv_shift": 0.002,
    "ocv_wave": 0.0015,
    "ocv_phase": 3.0,
    "cell_probe_bias": 0.3,
    "cathode_exchange": 0.12,
    "anode_exchange": 1.2,
    "cathode_layer": 0.25,
    "anode_layer": 0.1,
}


def scooter(number: int) -> Machine:
    """The scooter `number` of the fleet."""
    rng = np.random.default_rng([number, 71])
    plain = Machine()
    changed = {name: getattr(plain, name) * float(np.exp(sd * rng.normal())) for name, sd in SPREAD.items()}
    changed |= {name: getattr(plain, name) + sd * float(rng.normal()) for name, sd in SPREAD_ABSOLUTE.items()}
    return replace(plain, **changed)
