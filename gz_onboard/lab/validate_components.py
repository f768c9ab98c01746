"""Each component by itself, with what was measured at its inputs, so that an error of the whole can be traced.

    battery voltage     from measured current and cell temperature
    inverter DC power   from measured motor current (torque), motor speed and motor temperature
    motor torque        from measured motor current
    road load           the motor's force at the wheel, from measured speed, its change and grade, no brake pressed
    temperatures        of motor, inverter and cells, from their measured currents, voltage and speed

Current that the motor's drag takes without load (iron loss) is the wheel's: torque at the shaft is the torque constant
times current less that, and the electric power of the rest is what the inverter draws.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.lab.validate_score import CHANNELS, ROLLING, Quantity
from gz_onboard.model.battery import discharged
from gz_onboard.model.effect import MOVING, ROAD_LOAD, Port
from gz_onboard.model.model import air_density, drag_torque
from gz_onboard.offline.cooling import InverterCooling, LumpedCooling, MotorCooling, Network, temperatures
from gz_onboard.offline.sensors import road_speed
from gz_onboard.offline.series import (
    all_quantities,
    heat,
    idle_loss,
    ocv_over,
    over,
    reversible_heat_over,
    stepper,
    terminal_voltage,
    total,
)
from gz_onboard.simulation.parts import Dynamometer
from gz_onboard.vehicle import Vehicle


@dataclass(frozen=True)
class Component:
    """Measured and modelled, per second, shape (n,); `valid` where they can be compared."""

    quantity: Quantity
    measured: Array
    modelled: Array
    valid: Mask


def components(
    vehicle: Vehicle, measured: Mapping[str, Array], soc: float | None, ambient: float, roller: Dynamometer | None
) -> dict[str, Component]:
    """Those whose inputs were measured.

    measured: by role, per second, all of one length, and ``acceleration``, ``grade``, ``yaw_rate``, ``braking``,
    ``pack_power`` and the heats of `validate_ride.losses_per_second` where known. soc, ambient: at the start.
    """
    found: dict[str, Component] = {}
    has = measured.keys()
    every = np.ones(len(measured["speed"]), dtype=bool)
    if has >= {"pack_current", "pack_voltage", "cell_temperature"} and soc is not None:
        voltage = battery_voltage(vehicle, measured, soc)
        found["battery_voltage"] = Component(CHANNELS["pack_voltage"], measured["pack_voltage"], voltage, every)
    if has >= {"motor_current", "motor_speed"}:
        current, speed = measured["motor_current"], measured["motor_speed"]
        motor_temperature = measured.get("motor_temperature", np.full(len(speed), ambient))
        copper, idle, inverter = losses(vehicle, current, speed, motor_temperature)
        constant = vehicle.parameters["torque_constant"]
        if has >= {"inverter_voltage", "inverter_current"}:
            power = measured["inverter_voltage"] * measured["inverter_current"]
            modelled = constant * current * speed + copper + inverter
            found["inverter_power"] = Component(Quantity("W", "inverter DC power"), power, modelled, every)
        if "motor_torque" in has:
            found["motor_torque"] = Component(
                CHANNELS["motor_torque"], measured["motor_torque"], constant * current, every
            )
        moving = (measured["speed"] > ROLLING) & (measured.get("braking", np.zeros(len(speed))) <= 0)
        if "acceleration" in has and ("grade" in has or roller):
            force = (constant * current - drag_torque(idle, speed)) / road_speed(1.0, vehicle.parameters)
            needed = road_load(vehicle, measured, ambient, roller)
            found["road_load"] = Component(Quantity("N", "road load"), force, needed, moving)
        warm = {"motor_heat": copper + idle, "idle_heat": idle, "inverter_heat": inverter} | dict(measured)
        found |= _temperatures(vehicle, warm, soc, ambient)
    return found


def vibration(vehicle: Vehicle, measured: Mapping[str, Array]) -> Array:
    """[m/s²] per second; where it was not measured, the vehicle file's value while moving."""
    typical = np.where(measured["speed"] > MOVING, vehicle.riding.vibration, 0.0)
    return measured.get("vibration", typical)


def time_moving(measured: Mapping[str, Array]) -> Array:
    """[s] since the start, per second."""
    return np.asarray(np.cumsum(measured["speed"] > MOVING), dtype=float)


def battery_voltage(vehicle: Vehicle, measured: Mapping[str, Array], soc: float) -> Array:
    """Pack voltage [V] per second by the circuit of `physics.battery`, at rest before the first."""
    battery = vehicle.pack
    m = battery.cells_parallel
    columns = (
        measured["pack_current"],
        measured["cell_temperature"],
        vibration(vehicle, measured),
        time_moving(measured),
    )
    v1, result = 0.0, np.empty(len(columns[0]))
    effects, q = stepper(vehicle.model.at(Port.CELL_VOLTAGE), 0.5), all_quantities()
    rows = zip(*(column.tolist() for column in columns), strict=True)
    for i, (amperes, celsius, shaken, moving) in enumerate(rows):
        cell = amperes / m
        r0, r1, c1 = battery.circuit(soc, celsius)
        decay = np.exp(-0.5 / (r1 * c1))
        v1 = decay * v1 + (1 - decay) * r1 * cell  # to its middle: what is measured is the second's mean
        half = discharged(amperes, 0.5, battery.pack_capacity(celsius))
        soc -= half
        q |= {"cell_current": cell, "soc": soc, "cell_temperature": celsius, "vibration": shaken, "time_moving": moving}
        q["cell_capacity"] = battery.cell_capacity(celsius)
        volts = terminal_voltage(battery.ocv(soc, celsius)[0], r0, cell, v1 + sum(effects(q)))
        result[i] = battery.pack_voltage(volts, amperes)
        v1 = decay * v1 + (1 - decay) * r1 * cell
        soc -= half
        q["soc"] = soc
        effects(q)
    return result


def losses(vehicle: Vehicle, current: Array, speed: Array, temperature: Array) -> tuple[Array, Array, Array]:
    """(motor loss that comes with current, motor loss without current, inverter loss), all W of shape (n,)."""
    torque = vehicle.parameters["torque_constant"] * current
    q = all_quantities(motor_current=current, motor_speed=speed, motor_temperature=temperature, torque=torque)
    model, each = vehicle.model, over(1.0)
    motor, inverter = (0.0 * speed + total(model.at(port), q, each) for port in (Port.MOTOR_LOSS, Port.INVERTER_LOSS))
    idle = 0.0 * speed + idle_loss(model, q)
    return motor - idle, idle, inverter


def road_load(vehicle: Vehicle, measured: Mapping[str, Array], ambient: float, roller: Dynamometer | None) -> Array:
    """The force [N] at the driven wheel that the measured motion asks for, by the vehicle's effects."""
    p, speed = vehicle.parameters, measured["speed"]
    zero = np.zeros(len(speed))
    q = all_quantities(
        speed=speed,
        acceleration=measured["acceleration"],
        grade=zero if roller else measured["grade"],
        mass=vehicle.model.mass,
        air_density=air_density(ambient),
        lateral_acceleration=speed * measured.get("yaw_rate", zero),
        vibration=vibration(vehicle, measured),
        motor_current=zero,
        motor_temperature=ambient,
        ambient_temperature=measured.get("ambient_temperature", zero + ambient),
        motor_speed=measured["motor_speed"],
        time_moving=time_moving(measured),
        heading=measured.get("gps_course", zero),
    )
    model, each = vehicle.model, over(1.0)
    if not roller:
        return np.asarray(zero + total(model.at(*ROAD_LOAD), q, each))
    rear = 1 - p["cg_to_rear"] / p["wheelbase"]  # of the load: only the driven wheel rolls
    inertia = roller.inertia + p["wheel_inertia_rear"] / p["wheel_radius"] ** 2
    absorbed = roller.absorbed(speed)
    return np.asarray(rear * total(model.at(Port.TYRE), q, each) + absorbed + inertia * measured["acceleration"])


def _temperatures(
    vehicle: Vehicle, measured: Mapping[str, Array], soc: float | None, ambient: float
) -> dict[str, Component]:
    """The cooling networks with the heat of the measured currents, the measured ambient temperature and speed.

    measured: with motor_heat, idle_heat (of it without current) and inverter_heat [W]. A roller's fan follows it.
    """
    speed = np.abs(measured["speed"])
    every = np.ones(len(speed), dtype=bool)
    p, battery = vehicle.parameters, vehicle.battery
    air = measured.get("ambient_temperature", np.full(len(every), ambient))
    outside = air, speed, np.full(len(every), p["cooling_factor"])
    found: dict[str, Component] = {}

    def add(sensor: str, network: Network, heat: Array, *more: Array) -> None:
        modelled = np.array(temperatures(network, 1.0, heat, *outside, *more))
        found[sensor] = Component(CHANNELS[sensor], measured[sensor], modelled, every)

    def start(sensor: str) -> float:
        return float(measured[sensor][0])

    if "motor_temperature" in measured:
        heats = measured["motor_heat"], measured["idle_heat"]
        warm = start("motor_temperature")
        add("motor_temperature", MotorCooling(p, warm, warm), *heats)
    if "inverter_temperature" in measured:
        warm = start("inverter_temperature")
        add("inverter_temperature", InverterCooling(p, warm, warm), measured["inverter_heat"])
    if battery and measured.keys() >= {"cell_temperature", "pack_current", "pack_voltage"} and soc is not None:
        cells, current = measured["cell_temperature"], measured["pack_current"]
        levels = soc - np.cumsum(discharged(current, 1.0, battery.pack_capacity(start("cell_temperature"))))
        rest = ocv_over(battery, levels, cells) * battery.cells_series
        delivered = measured.get("pack_power", measured["pack_voltage"] * current)
        generated = heat(rest, 0.0, current) - delivered + reversible_heat_over(battery, current, levels, cells)
        pack = LumpedCooling(p, "pack", start("cell_temperature"))
        add("cell_temperature", pack, generated)
    return found
