"""Each component by itself, with what was measured at its inputs: it shows which part makes the whole wrong.

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
from typing import Any

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.lab.validate_score import CHANNELS, Quantity
from gz_onboard.physics.effect import MOVING, QUANTITIES, Effect, Port
from gz_onboard.physics.model import air_density
from gz_onboard.physics.relaxation import relaxed
from gz_onboard.simulation.scooter import Dynamometer, Scooter
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
    """Those whose inputs were measured. measured: by role, per second, all of one length, and ``acceleration``,
    ``grade``, ``yaw_rate``, ``braking`` where known. soc, ambient: at the start.
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
        moving = (measured["speed"] > 2.0) & (measured.get("braking", np.zeros(len(speed))) <= 0)
        if "acceleration" in has and ("grade" in has or roller):
            radius = vehicle.parameters["wheel_radius"] * vehicle.parameters["gear_ratio"]
            with np.errstate(divide="ignore", invalid="ignore"):
                drag = np.where(moving, idle / np.where(moving, speed, 1.0), 0.0)
            force = (constant * current - drag) / radius
            needed = road_load(vehicle, measured, ambient, roller)
            found["road_load"] = Component(Quantity("N", "road load"), force, needed, moving)
        found |= _temperatures(vehicle, measured, soc, ambient, copper + idle, inverter, every)
    return found


def vibration(vehicle: Vehicle, measured: Mapping[str, Array]) -> Array:
    """[m/s²] per second; where it was not measured, the vehicle file's value while moving."""
    typical = np.where(measured["speed"] > MOVING, vehicle.riding.vibration, 0.0)
    return measured.get("vibration", typical)


def time_moving(measured: Mapping[str, Array]) -> Array:
    """[s] since the start, per second."""
    return np.asarray(np.cumsum(measured["speed"] > 1.0), dtype=float)


def battery_voltage(vehicle: Vehicle, measured: Mapping[str, Array], soc: float) -> Array:
    """Pack voltage [V] per second by the circuit of `physics.battery`, at rest before the first; sensor's offset in."""
    battery = vehicle.pack
    n, m = battery.cells_series, battery.cells_parallel
    columns = (
        measured["pack_current"],
        measured["cell_temperature"],
        vibration(vehicle, measured),
        time_moving(measured),
    )
    v1, result = 0.0, np.empty(len(columns[0]))
    states = {name: 0.0 for name, _ in vehicle.model.cell_voltage}  # V of a cell, of effects in it
    q: dict[str, Any] = dict.fromkeys(QUANTITIES, 0.0)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    for i, (amperes, celsius, shaken, moving) in enumerate(rows):
        cell = amperes / m
        r0, r1, c1 = (mesh.at(soc, celsius)[0] for mesh in (battery.r0, battery.r1, battery.c1))
        v1, decay = battery.relax(0.5, v1, cell, r1, c1)  # to its middle: what is measured is the second's mean
        soc -= 0.5 * amperes / (3600 * battery.pack_capacity(celsius))
        lacking = v1 + sum(states.values())
        result[i] = n * (battery.ocv(soc, celsius)[0] - r0 * cell - lacking) - battery.series_resistance * amperes
        v1 = relaxed(v1, r1 * cell, decay)
        soc -= 0.5 * amperes / (3600 * battery.pack_capacity(celsius))
        if states:
            q |= {"cell_current": cell, "soc": soc, "cell_temperature": celsius, "vibration": shaken}
            q |= {"cell_capacity": battery.cell_capacity(celsius), "time_moving": moving}
            states = {name: effect.step(states[name], 1.0, q) for name, effect in vehicle.model.cell_voltage}
    return result + vehicle.parameters["pack_voltage_offset"]


def losses(vehicle: Vehicle, current: Array, speed: Array, temperature: Array) -> tuple[Array, Array, Array]:
    """(motor loss that comes with current, motor loss without current, inverter loss), all W of shape (n,)."""
    q: dict[str, Any] = dict.fromkeys(QUANTITIES, 0.0)
    q |= {"motor_current": current, "motor_speed": speed, "motor_temperature": temperature}
    q["torque"] = vehicle.parameters["torque_constant"] * current
    motor, inverter = _sum(vehicle, Port.MOTOR_LOSS, q), _sum(vehicle, Port.INVERTER_LOSS, q)
    idle = _sum(vehicle, Port.MOTOR_LOSS, q | dict.fromkeys(("motor_current", "torque"), 0.0 * current))
    return motor - idle, idle, inverter


def _sum(vehicle: Vehicle, port: Port, q: Mapping[str, Any]) -> Array:
    total: Any = 0.0 * q["motor_speed"]
    for effect in vehicle.model.effects:
        if effect.port is port:
            total = total + _term(effect, vehicle, q)
    result: Array = total
    return result


def _term(effect: Effect, vehicle: Vehicle, q: Mapping[str, Any]) -> Any:
    values = {name: vehicle.parameters[name] for name in effect.keywords}
    return effect.term(*[q[name] for name in effect.quantities], **values)


def road_load(vehicle: Vehicle, measured: Mapping[str, Array], ambient: float, roller: Dynamometer | None) -> Array:
    """The force [N] at the driven wheel that the measured motion asks for, by the vehicle's effects."""
    p, speed = vehicle.parameters, measured["speed"]
    zero = np.zeros(len(speed))
    grade = zero if roller else measured["grade"]
    q: dict[str, Any] = dict.fromkeys(QUANTITIES, 0.0)
    q |= {
        "speed": speed,
        "acceleration": measured["acceleration"],
        "grade": grade,
        "grade_cosine": np.sqrt(1 - grade**2),
        "mass": vehicle.model.mass,
        "air_density": air_density(ambient),
        "lateral_acceleration": speed * measured.get("yaw_rate", zero),
        "vibration": vibration(vehicle, measured),
        "motor_current": zero,
        "motor_temperature": ambient,
        "ambient_temperature": measured.get("ambient_temperature", zero + ambient),
        "motor_speed": measured["motor_speed"],
        "time_moving": time_moving(measured),
        "heading": measured.get("gps_course", zero),
    }
    if not roller:
        return _sum(vehicle, Port.WHEEL_FORCE, q) + _sum(vehicle, Port.TYRE, q)
    rear = 1 - p["cg_to_rear"] / p["wheelbase"]  # of the load: only the driven wheel rolls
    inertia = roller.inertia + p["wheel_inertia_rear"] / p["wheel_radius"] ** 2
    absorbed = roller.a + roller.b * speed + roller.c * speed**2
    return rear * _sum(vehicle, Port.TYRE, q) + absorbed + inertia * measured["acceleration"]


def _temperatures(
    vehicle: Vehicle,
    measured: Mapping[str, Array],
    soc: float | None,
    ambient: float,
    motor_heat: Array,
    inverter_heat: Array,
    every: Mask,
) -> dict[str, Component]:
    """The cooling networks with the heat of the measured currents and the measured ambient temperature."""
    air = measured.get("ambient_temperature", np.full(len(every), ambient))
    parts = Scooter(vehicle, soc=0.5 if soc is None else soc, ambient=ambient)
    motor, inverter, pack = parts.motor_cooling, parts.inverter_cooling, parts.pack_cooling
    found = {}

    def compare(name: str, part: Any, heat: Array, *masses: str) -> None:
        """A network whose `masses` begin at the temperature measured first."""
        for mass in masses:
            setattr(part, mass, float(measured[name][0]))
        found[name] = Component(CHANNELS[name], measured[name], _cooled(part, heat, air), every)

    if "motor_temperature" in measured:
        compare("motor_temperature", motor, motor_heat, "stator", "rotor")
    if "inverter_temperature" in measured:
        compare("inverter_temperature", inverter, inverter_heat, "board", "box")
    if measured.keys() >= {"cell_temperature", "pack_current", "pack_voltage"} and soc is not None:
        battery, celsius = vehicle.pack, measured["cell_temperature"]
        charge = np.cumsum(measured["pack_current"] / 3600) / battery.pack_capacity(float(celsius[0]))
        levels = zip((soc - charge).tolist(), celsius.tolist(), strict=True)
        source = np.array([battery.ocv(s, at)[0] for s, at in levels]) * battery.cells_series
        heat = (source - measured["pack_voltage"]) * measured["pack_current"]
        compare("cell_temperature", pack, heat, "temperature")
    return found


def _cooled(part: Any, heat: Array, air: Array) -> Array:
    result = np.empty(len(heat))
    for i, (watts, ambient) in enumerate(zip(heat.tolist(), air.tolist(), strict=True)):
        part.step(1.0, watts, ambient)
        result[i] = part.temperature
    return result
