"""Residuals: in each channel, what was measured less what the model says of it, given the other measurements.

The equations are those of `physics`; here each is fed with what was measured, and widened by the nuisances under which
a healthy vehicle differs from its file. Every function takes the ride and a mapping of parameters, so that a column of
the linear model is its difference.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.constants import GRAVITY
from gz_onboard.discovery.grid import STEP, Ride
from gz_onboard.discovery.system import System, Values, summed
from gz_onboard.model.battery import discharged
from gz_onboard.model.effect import ROAD_LOAD, Port
from gz_onboard.model.effects.inertia import rotating_mass
from gz_onboard.model.model import drag_torque, standing_load
from gz_onboard.model.sensors import grade_shown, true_current, true_voltage
from gz_onboard.offline.arrays import block_means, running_mean
from gz_onboard.offline.cooling import InverterCooling, LumpedCooling, MotorCooling, Network, temperatures
from gz_onboard.offline.series import (
    curve_over,
    first_soc,
    heat,
    mesh_over,
    ocv_over,
    relaxation,
    reversible_heat_over,
    terminal_voltage,
)

SLOW = 5  # grid steps to one of the battery and cooling models: 0.5 s
DT = SLOW * STEP
MID = 200.0  # s: between the pair of the vehicle file and slow relaxation
LAGGED = 3  # grid steps that the slope of what comes later is a mean of
FIRST = 20  # steps: what a ride begins with
BRAKING = 0.5  # of the switch: between open and closed
LEAST_COOLING = 0.05  # of the conductance at standstill: moving air does not heat
# Scales of the nuisances, so that all are of order one. Those of currents, forces and speeds of the motor are of a
# vehicle of size 1, and grow with `Sizes`; air, time and charge are the same in every vehicle.
WARM, COLDER = 20.0, 20.0  # degC, K below it: from a mild day to frost
SPIN = 50.0  # rad/s of the motor, near its highest
AMPERES = 50.0  # of the motor: half of a usual acceleration
MAGNETS = 40.0  # degC of the motor, at which its torque constant is the vehicle file's: of a motor at work
SATURATING = 100.0  # A of the motor: half of its limit
SLIPPING = 100.0  # N at the wheel: a steep hill
DRIFT_TIME = 600.0  # s: a short ride
EMPTIER = 0.4  # of SOC below full: what a usual ride takes
BENT = 5.0  # A of a cell, some 2 C
MIDDLE = 0.7  # SOC about which the rest voltage tilts: of most rides
WIND = 10.0  # m/s of air past the vehicle
WARMER = 10.0  # K of the stator above the air


def colder(temperature: Array) -> Array:
    """How much colder than a warm day, in the nuisances' scale."""
    return (WARM - temperature) / COLDER


def moving(ride: Ride, p: Values, system: System) -> dict[str, Array]:
    """The quantities with the parameters' own radius, sensor scale and mass."""
    q = dict(ride.quantities)
    scale = 1 / p.get("speed_sensor_scale", 1.0)
    radius = p["wheel_radius"] * p["gear_ratio"] * scale / ride.radius
    q["motor_speed"] = q["motor_speed"] * scale
    q["speed"] = q["speed"] * radius
    q["acceleration"] = q["acceleration"] * radius
    q["lateral_acceleration"] = q["lateral_acceleration"] * radius
    q["mass"] = np.full(len(ride.time), mass(ride, p, system))
    if "current_per_watt" in q:  # the rest of the pack's power
        more = auxiliary_power(ride, p, system) - auxiliary_power(ride, {**p, **system.healthy}, system)
        q["motor_current"] = q["motor_current"] - q["current_per_watt"] * more
    q["torque"] = torque_constant(ride, p, system) * q["motor_current"]
    return q


def mass(ride: Ride, p: Values, system: System) -> float:
    """Vehicle and payload [kg]: the payload entered, and by how much it is wrong."""
    usual = system.healthy["payload_mass"]
    entered = ride.payload if ride.payload is not None else usual
    return p["vehicle_mass"] + entered + (p["payload_mass"] - usual) + p["payload_error"]


def torque_constant(ride: Ride, p: Values, system: System) -> Array:
    """The true one [N·m/A], over motor temperature and current."""
    q = ride.quantities
    return np.asarray(
        p["torque_constant"]
        * (1 + p["torque_constant_slope"] * (q["motor_temperature"] - MAGNETS))
        * (1 - p["torque_saturation"] * np.abs(q["motor_current"]) / (SATURATING * system.sizes.current))
    )


def motor_losses(ride: Ride, q: Mapping[str, Array], p: Values, system: System) -> tuple[Any, Any]:
    """(losses fed electrically, losses that drag) [W]. Loss that does not depend on current drags the shaft."""
    terms = system.terms(q, p, STEP, Port.MOTOR_LOSS)
    fed = [(effect, term) for effect, term in terms if "motor_current" in effect.term.quantities]
    drags = [(effect, term) for effect, term in terms if "motor_current" not in effect.term.quantities]
    return summed(fed), summed(drags)


def road_force(ride: Ride, p: Values, system: System) -> Array:
    """Force [N] at the wheel: of the motor less the road load, less what the accelerometer shows."""
    q = moving(ride, p, system)
    shaft = q["torque"] - drag_torque(motor_losses(ride, q, p, system)[1], q["motor_speed"])
    entered, m = float(ride.quantities["mass"][0]), mass(ride, p, system)
    specific = ride.signals["accel_x"] - p["accel_bias"] - p["pitch_gain"] * q["acceleration"]
    force = rotating_mass(p) * q["acceleration"] + summed(system.terms(q, p, STEP, *ROAD_LOAD))
    push = shaft / (p["wheel_radius"] * p["gear_ratio"]) - force
    # what is noisy stands alone: were the accelerometer multiplied with the mass that is sought, the least noise would
    # be had with the least mass, and all that it is weighed with would shrink along
    return np.asarray(entered * (push / m - specific))


def altitude(ride: Ride, p: Values, system: System) -> Array:
    """GPS altitude [m] above the start, less the way times the grade that the accelerometer shows."""
    q = moving(ride, p, system)
    acceleration = q["acceleration"]
    sine = grade_shown(ride.signals["accel_x"] - p["accel_bias"], (1 + p["pitch_gain"]) * acceleration)
    height = np.cumsum(sine * q["speed"]) * STEP
    return np.asarray(ride.signals["gps_altitude"] - height - ride.signals["gps_altitude"][0] - p["altitude_start"])


def electric_power(ride: Ride, q: Mapping[str, Array], shaft: Array, p: Values, system: System) -> Array:
    """What motor and inverter take [W] on the DC side for the power of the air gap `shaft` [W], (n,)."""
    electric, _ = motor_losses(ride, q, p, system)
    power = shaft + electric
    power = power + summed(system.terms(q, p, STEP, Port.INVERTER_LOSS))
    spin = np.abs(q["motor_speed"]) / (SPIN * system.sizes.spin)
    cross = p["loss_cross"] * np.abs(q["motor_current"]) / (AMPERES * system.sizes.current)
    power = power + (p["loss_speed"] + cross) * spin
    return np.asarray(
        power - p["torque_lag"] * np.gradient(running_mean(np.broadcast_to(power, len(ride.time)), LAGGED), STEP)
    )


def inverter_power(ride: Ride, p: Values, system: System) -> Array:
    """The inverter's power [W] on the DC side, less air-gap power and losses."""
    q = moving(ride, p, system)
    power = electric_power(ride, q, q["torque"] * q["motor_speed"], p, system)
    volts = ride.signals["inverter_voltage"]
    shown = p["inverter_current_gain"] * power + p["inverter_current_offset"] * volts
    return np.asarray(ride.signals["inverter_current"] * volts - shown)


def pack_balance(ride: Ride, p: Values, system: System) -> Array:
    """Pack current [A] less the auxiliaries', less the inverter's."""
    s = ride.signals
    true = true_current(s["pack_current"], p)
    true = true + p["pack_inverter_lag"] * np.gradient(running_mean(true, LAGGED), STEP)
    # beside the auxiliary load there is what is drawn when nothing is: the inverter's own supply
    inverter = true - s["auxiliary_current"] - p["idle_current"] - ride.loads / s["pack_voltage"]
    shown = p["inverter_current_offset"] + p["inverter_current_gain"] * inverter
    return np.asarray(shown - s["inverter_current"])


def auxiliary(ride: Ride, p: Values, system: System) -> Array:
    """The auxiliaries' power [W] less that of the vehicle file and the brake light."""
    s = ride.signals
    return np.asarray(s["auxiliary_current"] * s["pack_voltage"] - auxiliary_power(ride, p, system))


def auxiliary_power(ride: Ride, p: Values, system: System) -> Any:
    """That of the vehicle file and the brake light [W]."""
    power = summed(system.terms(ride.quantities, p, STEP, Port.DC_POWER))
    if "brake_switch" in ride.signals:
        power = power + p["brake_light"] * (ride.signals["brake_switch"] > BRAKING)
    return power


def voltage_balance(ride: Ride, p: Values, system: System) -> Array:
    """Pack voltage [V] less the inverter's and the drop of the cable."""
    s = ride.signals
    inverter = s["inverter_voltage"] + p["cable_resistance"] * s["inverter_current"] - p["inverter_voltage_offset"]
    return np.asarray(true_voltage(s["pack_voltage"], p) - inverter)


class CellCircuit(NamedTuple):
    """What the circuit says of a mean cell, at steps of `DT`."""

    voltage: Array  # V, at its terminals
    rest: Array  # V, without a current
    current: Array  # A, of the pack
    soc: Array


def cell_circuit(ride: Ride, p: Values, system: System) -> CellCircuit:
    """The circuit of a mean cell at the current measured."""
    battery = system.pack
    cell = block_means(true_current(ride.signals["pack_current"], p), SLOW) / battery.cells_parallel
    temperature = block_means(ride.quantities["cell_temperature"], SLOW)
    cold = colder(temperature)
    capacity = p["cell_capacity"] * curve_over(battery.capacity_share, temperature)
    taken = discharged(cell, DT, capacity)
    soc = p["soc_start"] + start_soc(ride, system) - (np.cumsum(taken) - taken / 2)  # at the middle of each step
    factor = p.get("cell_resistance_factor", 1.0) * (1 + p["resistance_level"] + p["resistance_cold"] * cold)
    bent = p["resistance_current"] + p["resistance_current_cold"] * cold
    empty = p["resistance_empty"] + p["resistance_empty_cold"] * cold
    factor = factor * (1 + empty * (1 - soc) / EMPTIER - bent * np.abs(cell) * system.sizes.resistance / BENT)
    r0 = mesh_over(battery.r0, soc, temperature) * factor
    r1 = mesh_over(battery.r1, soc, temperature)
    decay = np.exp(-DT / (r1 * mesh_over(battery.c1, soc, temperature) * np.exp(p["pair_time"])))
    settled = r1 * (1 + p["pair_resistance"]) * factor * cell
    v1 = relaxation(settled, decay, p["v1_start"], before=True)
    v1 = (v1 + decay * v1 + (1 - decay) * settled) / 2  # the mean of the step's ends
    extra: Any = p["drift"] * np.arange(len(cell)) * DT / DRIFT_TIME
    mid = relaxation(cell, np.full(len(cell), np.exp(-DT / MID)), before=True)
    extra = extra + p["mid_resistance"] * mid
    q = {name: block_means(value, SLOW) for name, value in ride.quantities.items()}
    q |= {"cell_current": cell, "soc": soc, "cell_temperature": temperature, "cell_capacity": capacity}
    extra = extra + summed(system.terms(q, p, DT, Port.CELL_VOLTAGE))
    rest = ocv_over(battery, soc, temperature) + p["ocv_offset"] + p["ocv_tilt"] * (soc - MIDDLE) + p["ocv_cold"] * cold
    return CellCircuit(terminal_voltage(rest, r0, cell, v1 + extra), rest, cell * battery.cells_parallel, soc)


def start_soc(ride: Ride, system: System) -> float:
    """The SOC that the first voltages point to, by the vehicle file: `soc_start` counts from there, whatever moves."""
    volts = true_voltage(float(np.mean(ride.signals["pack_voltage"][:FIRST])), system.healthy)
    amperes = true_current(float(np.mean(ride.signals["pack_current"][:FIRST])), system.healthy)
    celsius = float(ride.quantities["cell_temperature"][0])
    load = standing_load(amperes, volts, system.healthy["auxiliary_power"])
    return first_soc(system.cells, system.pack, (volts, amperes), celsius, load)


def counted_soc(ride: Ride, system: System) -> Array:
    """SOC by counting the current from where the first voltages point to, shape (n,)."""
    capacity = system.pack.pack_capacity(float(ride.quantities["cell_temperature"][0]))
    amperes = true_current(ride.signals["pack_current"], system.healthy)
    return np.asarray(start_soc(ride, system) - np.cumsum(discharged(amperes, STEP, capacity)))


def cell_voltage(ride: Ride, p: Values, system: System) -> Array:
    """Voltage [V] of a mean cell less that of its circuit at the current measured, at steps of `DT`."""
    battery = replace(system.pack, series_resistance=p["pack_series_resistance"])
    cell = cell_circuit(ride, p, system)
    measured = true_voltage(block_means(ride.signals["pack_voltage"], SLOW), p)
    return np.asarray(battery.cell_voltage(measured, cell.current) - cell.voltage)


def voltage_timing(ride: Ride, p: Values, system: System) -> Array:
    """Steps [V] of a mean cell from one grid step to the next, less those of the current by its resistance."""
    battery = system.pack
    late = p.get("pack_voltage_latency", 0.0)
    amperes = true_current(ride.signals["pack_current"], p)
    if late:
        amperes = np.interp(ride.time - late, ride.time, amperes)
    soc = np.full(len(ride.time), start_soc(ride, system))
    r0 = mesh_over(battery.r0, soc, ride.quantities["cell_temperature"])
    resistance = r0 * p.get("cell_resistance_factor", 1.0) / battery.cells_parallel
    resistance = resistance + p["pack_series_resistance"] / battery.cells_series
    fast = p["fast_resistance"] + p["fast_cold"] * colder(ride.quantities["cell_temperature"])
    resistance = resistance * (1 + fast)
    step = np.diff(ride.signals["pack_voltage"]) / battery.cells_series + resistance[1:] * np.diff(amperes)
    return np.append(step, 0.0)


def gps_speed(ride: Ride, p: Values, system: System) -> Array:
    """GPS speed [m/s] less the motor's by wheel radius, slip and lean."""
    q = moving(ride, p, system)
    slip = 1 - p["slip_per_force"] * q["torque"] / p["wheel_radius"] / (SLIPPING * system.sizes.power)
    lean = 1 - p["lean_radius"] * (q["lateral_acceleration"] / GRAVITY) ** 2 / 2
    return np.asarray(ride.signals["gps_speed"] - q["speed"] * slip * lean + p["gps_lag"] * q["acceleration"])


def rear_speed(ride: Ride, p: Values, system: System) -> Array:
    """The rear wheel's speed [m/s] less the motor's."""
    q = moving(ride, p, system)
    return np.asarray(
        (ride.signals["wheel_speed_rear"] * (1 - p["rear_scale"]) - q["motor_speed"] * p["gear_ratio"]) * ride.radius
        + p["wheel_lag"] * q["acceleration"]
    )


def front_speed(ride: Ride, p: Values, system: System) -> Array:
    """The front wheel's speed [m/s] less the motor's by slip and lean."""
    q = moving(ride, p, system)
    slip = 1 - p["slip_per_force"] * q["torque"] / p["wheel_radius"] / (SLIPPING * system.sizes.power)
    lean = 1 - p["front_lean"] * (q["lateral_acceleration"] / GRAVITY) ** 2 / 2
    speed = q["motor_speed"] * p["gear_ratio"] * slip * lean
    front = ride.signals["wheel_speed_front"] * (1 - p["front_scale"])
    return np.asarray((front - speed) * ride.radius + p["wheel_lag"] * q["acceleration"])


def _heat(ride: Ride, p: Values, system: System) -> tuple[Array, Array, Array]:
    """Loss [W] at steps of `DT`: (the motor's, of it what comes without current, the inverter's)."""
    q = moving(ride, p, system)
    electric, drag = motor_losses(ride, q, p, system)
    inverter = summed(system.terms(q, p, STEP, Port.INVERTER_LOSS))
    n = len(ride.time)
    motor, idle, inverter = (block_means(np.broadcast_to(x, n), SLOW) for x in (electric + drag, drag, inverter))
    return motor, idle, inverter


def _warmed(
    ride: Ride, p: Values, channel: tuple[str, str], network: Network, watts: Array, idle: Sequence[Array] = ()
) -> Array:
    """What `network`, heated by `watts`, `idle` of it without current, leaves [K] of a sensor.

    channel: (sensor, how much more moving air cools than the network says).
    """
    sensor, airflow = channel
    speed, ambient = (block_means(ride.quantities[name], SLOW) for name in ("speed", "ambient_temperature"))
    speed = np.abs(speed)
    factor = p.get("cooling_factor", 1.0) * np.maximum(1 + p[airflow] * speed / WIND, LEAST_COOLING)
    modelled: Array = np.array(temperatures(network, DT, watts, ambient, speed, factor, *idle))
    return block_means(ride.signals[sensor], SLOW) - modelled


def _first(ride: Ride, sensor: str) -> float:
    return float(block_means(ride.signals[sensor], SLOW)[:FIRST].mean())


def motor_temperature(ride: Ride, p: Values, system: System) -> Array:
    """The stator's temperature [K] less that of the cooling network at the modelled loss, at steps of `DT`."""
    stator = _first(ride, "motor_temperature") + p["motor_start"]
    ambient = float(block_means(ride.quantities["ambient_temperature"], SLOW)[0])
    network = MotorCooling(p, stator, stator + p["rotor_start"] * (stator - ambient) / WARMER)
    watts, *idle, _ = _heat(ride, p, system)
    return _warmed(ride, p, ("motor_temperature", "motor_airflow"), network, watts, idle)


def inverter_temperature(ride: Ride, p: Values, system: System) -> Array:
    """The board's temperature [K] less that of the cooling network at the modelled loss, at steps of `DT`."""
    board = _first(ride, "inverter_temperature") + p["inverter_start"]
    network = InverterCooling(p, board, board + p["box_start"])
    return _warmed(ride, p, ("inverter_temperature", "inverter_airflow"), network, _heat(ride, p, system)[2])


def cell_temperature(ride: Ride, p: Values, system: System) -> Array:
    """The cells' temperature [K] less that of the lump at the circuit's heat, at steps of `DT`."""
    cell = cell_circuit(ride, p, system)
    celsius = block_means(ride.quantities["cell_temperature"], SLOW)
    watts = system.pack.cells_series * heat(cell.rest, cell.voltage, cell.current)
    watts = watts + reversible_heat_over(system.pack, cell.current, cell.soc, celsius)
    network = LumpedCooling(p, "pack", _first(ride, "cell_temperature") + p["cells_start"])
    return _warmed(ride, p, ("cell_temperature", "pack_airflow"), network, watts)
