"""Each component alone, with its measured inputs, so that an error of the whole can be traced to one of them.

    battery voltage     from measured current and cell temperature
    inverter DC power   from measured motor current (torque), motor speed and motor temperature
    motor torque        from measured motor current
    road load           the motor's force at the wheel, from measured speed, its change and grade, no brake pressed
    temperatures        of motor, inverter and cells, from their measured currents, voltage and speed

Current that the motor's drag takes without load (iron loss) is the wheel's: torque at the shaft is the torque constant
times current less that, and the inverter draws the electric power of the rest.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.model.battery import discharged
from gz_onboard.model.cooling import InverterCooling, LumpedCooling, MotorCooling, Network, temperatures
from gz_onboard.model.effect import MOVING, ROAD_LOAD, Port
from gz_onboard.model.model import air_density, drag_torque
from gz_onboard.model.series import (
    all_quantities,
    curve_over,
    heat,
    idle_loss,
    mesh_over,
    ocv_over,
    over,
    relaxation,
    reversible_heat_over,
    terminal_voltage,
    total,
)
from gz_onboard.recording.sensors import road_speed
from gz_onboard.simulation.parts import Dynamometer
from gz_onboard.validation.comparison import CHANNELS, CONFIG, Comparison, Quantity
from gz_onboard.vehicle import Vehicle


def components(
    vehicle: Vehicle, measured: Mapping[str, Array], soc: float | None, ambient: float, roller: Dynamometer | None
) -> dict[str, Comparison]:
    """Compare each component whose inputs were measured.

    measured: by role, per second, all of one length, and ``acceleration``, ``grade``, ``yaw_rate``, ``braking``,
    ``pack_power``, ``motor_heat``, ``idle_heat`` and ``inverter_heat`` [W] where known. soc, ambient: at the start.
    """
    found: dict[str, Comparison] = {}
    has = measured.keys()
    if has >= {"pack_current", "pack_voltage", "cell_temperature"} and soc is not None:
        voltage = battery_voltage(vehicle, measured, soc)
        found["battery_voltage"] = Comparison.of(CHANNELS["pack_voltage"], measured["pack_voltage"], voltage)
    if has >= {"motor_current", "motor_speed"}:
        current, speed = measured["motor_current"], measured["motor_speed"]
        warm = measured.get("motor_temperature", np.full(len(speed), ambient))
        copper, idle, inverter = losses(vehicle, current, speed, warm)
        torque = vehicle.parameters["torque_constant"] * current
        if has >= {"inverter_voltage", "inverter_current"}:
            power = measured["inverter_voltage"] * measured["inverter_current"]
            modelled = torque * speed + copper + inverter
            found["inverter_power"] = Comparison.of(Quantity("W", "inverter DC power"), power, modelled)
        if "motor_torque" in has:
            found["motor_torque"] = Comparison.of(CHANNELS["motor_torque"], measured["motor_torque"], torque)
        if "acceleration" in has and ("grade" in has or roller):
            force = (torque - drag_torque(idle, speed)) / road_speed(1.0, vehicle.parameters)
            needed = road_load(vehicle, measured, ambient, roller)
            rolling = measured["speed"] > CONFIG.road_load_speed_m_s
            if "braking" in has:
                rolling &= measured["braking"] <= 0
            found["road_load"] = Comparison.of(Quantity("N", "road load"), force, needed, rolling)
        heats = {"motor_heat": copper + idle, "idle_heat": idle, "inverter_heat": inverter}
        found |= _temperatures(vehicle, heats | dict(measured), soc, ambient)
    return found


def vibration(vehicle: Vehicle, measured: Mapping[str, Array]) -> Array:
    """[m/s²] per second; where it was not measured, the vehicle file's value while moving."""
    typical = np.where(measured["speed"] > MOVING, vehicle.riding.vibration, 0.0)
    return measured.get("vibration", typical)


def time_moving(measured: Mapping[str, Array]) -> Array:
    """[s] since the start, per second."""
    return np.asarray(np.cumsum(measured["speed"] > MOVING), dtype=float)


def battery_voltage(vehicle: Vehicle, measured: Mapping[str, Array], soc: float) -> Array:
    """Pack voltage [V] in the middle of each second by the circuit of `model.battery`, at rest before the first.

    Resistances are those at the second's begin; RC pair and effects go in steps of half a second.
    """
    battery, amperes, celsius = vehicle.pack, measured["pack_current"], measured["cell_temperature"]
    cell = amperes / battery.cells_parallel
    capacity = battery.capacity * battery.health.capacity * curve_over(battery.capacity_share, celsius)
    drawn = discharged(cell, 1.0, capacity)
    ends = soc - np.cumsum(drawn)
    middles, starts = ends + drawn / 2, ends + drawn
    r0, r1, c1 = (mesh_over(table, starts, celsius) for table in (battery.r0, battery.r1, battery.c1))
    v1 = relaxation(np.repeat(r1 * cell, 2), np.repeat(np.exp(-0.5 / (r1 * c1)), 2))
    halves = {
        "cell_current": cell,
        "cell_temperature": celsius,
        "cell_capacity": capacity,
        "vibration": vibration(vehicle, measured),
        "time_moving": time_moving(measured),
    }
    q = all_quantities(**{name: np.repeat(values, 2) for name, values in halves.items()})
    q["soc"] = np.column_stack([middles, ends]).ravel()
    extra = v1 + total(vehicle.model.at(Port.CELL_VOLTAGE), q, over(0.5))
    volts = terminal_voltage(ocv_over(battery, middles, celsius), r0, cell, extra[::2])
    return np.asarray(battery.pack_voltage(volts, amperes))


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
) -> dict[str, Comparison]:
    """The cooling networks with the heat of the measured currents, the measured ambient temperature and speed.

    measured: with motor_heat, idle_heat (of it without current) and inverter_heat [W]. A roller's fan follows it.
    """
    p, battery, speed = vehicle.parameters, vehicle.battery, np.abs(measured["speed"])
    air = measured.get("ambient_temperature", np.full(len(speed), ambient))
    start = {name: float(measured[name][0]) for name in CHANNELS if name.endswith("_temperature") and name in measured}
    networks: dict[str, tuple[Network, Array, tuple[Array, ...]]] = {}
    if (warm := start.get("motor_temperature")) is not None:
        heats = measured["motor_heat"], (measured["idle_heat"],)
        networks["motor_temperature"] = MotorCooling(p, warm, warm), *heats
    if (warm := start.get("inverter_temperature")) is not None:
        networks["inverter_temperature"] = InverterCooling(p, warm, warm), measured["inverter_heat"], ()
    if battery and measured.keys() >= {"cell_temperature", "pack_current", "pack_voltage"} and soc is not None:
        cells, current = measured["cell_temperature"], measured["pack_current"]
        levels = soc - np.cumsum(discharged(current, 1.0, battery.pack_capacity(start["cell_temperature"])))
        rest = ocv_over(battery, levels, cells) * battery.cells_series
        delivered = measured.get("pack_power", measured["pack_voltage"] * current)
        generated = heat(rest, 0.0, current) - delivered + reversible_heat_over(battery, current, levels, cells)
        networks["cell_temperature"] = LumpedCooling(p, "pack", start["cell_temperature"]), generated, ()
    found = {}
    for name, (network, power, more) in networks.items():
        outside = air, speed, np.full(len(speed), p["cooling_factor"])
        modelled = np.array(temperatures(network, 1.0, power, *outside, *more))
        found[name] = Comparison.of(CHANNELS[name], measured[name], modelled)
    return found
