"""Residuals: in each channel the measurement minus the model's prediction from the other measurements.

The equations are those of `model`. Each is fed with measurements, and widened by the nuisance parameters by which a
healthy vehicle differs from its file. Every residual takes the ride, a mapping of parameters and the `System`, so that
a column of the linear model is a difference of two residuals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from gz_onboard.arrays import Array, block_means, running_mean
from gz_onboard.constants import GRAVITY
from gz_onboard.discovery.grid import COARSE, STEP, Ride
from gz_onboard.errors import InputError
from gz_onboard.model.battery import Battery, discharged
from gz_onboard.model.cooling import InverterCooling, LumpedCooling, MotorCooling, Network, temperatures
from gz_onboard.model.effect import MOVING, ROAD_LOAD, Effect, Port
from gz_onboard.model.effects.inertia import rotating_mass
from gz_onboard.model.model import Bound, drag_torque, standing_load
from gz_onboard.model.riding import PriorRiding
from gz_onboard.model.sensors import grade_shown, true_current, true_voltage
from gz_onboard.model.series import (
    curve_over,
    first_soc,
    heat,
    mesh_over,
    ocv_over,
    relaxation,
    reversible_heat_over,
    series,
    terminal_voltage,
)
from gz_onboard.model.traits import traits
from gz_onboard.priors import USUAL_SIZES, Sizes

Values = Mapping[str, float]
"""Parameters and nuisances by name."""
DT = COARSE * STEP  # s: step of the model of the cells
WARMING = 10  # grid steps to one of the cooling networks: 1 s, as in the simulation


@dataclass(frozen=True)
class NuisanceScales:
    """The units of the nuisance parameters, chosen so that all are of order one.

    Those of current, force and motor speed are of a vehicle of size 1 and grow with `Sizes`.
    """

    warm: float = 20.0  # degC: a mild day
    colder: float = 20.0  # K below it: frost
    spin: float = 50.0  # rad/s of the motor, near its highest
    motor_current: float = 50.0  # A: half of a usual acceleration
    magnets: float = 40.0  # degC of the motor at which its torque constant is the vehicle file's
    saturation: float = 100.0  # A of the motor: half of its limit
    slip: float = 100.0  # N at the wheel: a steep hill
    drift: float = 600.0  # s: a short ride
    empty: float = 0.4  # of SOC below full: a usual ride
    cell_current: float = 5.0  # A, some 2 C
    middle: float = 0.7  # SOC about which the rest voltage tilts: of most rides
    wind: float = 10.0  # m/s of air past the vehicle
    warmer: float = 10.0  # K of the stator above the air


PER = NuisanceScales()


@dataclass(frozen=True)
class System:
    """What residuals are predicted with.

    effects: of the model and the candidates. healthy: parameters of the vehicle file. cells: the effects in its cells
    by the vehicle file. vibration: m/s² of the file's prior riding, for rides that did not measure it.
    """

    effects: tuple[Effect, ...]
    battery: Battery | None
    healthy: Values
    cells: tuple[Bound, ...] = ()
    vibration: float = PriorRiding.vibration
    sizes: Sizes = USUAL_SIZES

    @property
    def pack(self) -> Battery:
        """The battery of a system that has one."""
        assert self.battery is not None
        return self.battery

    def terms(self, q: Mapping[str, Any], p: Values, dt: float, *ports: Port) -> list[tuple[Effect, Any]]:
        """The effects at `ports` with their values over time, each the mean of both ends of a step of `dt` [s].

        Without effects that store energy: the accelerometer measures them.
        """
        steps = np.full(len(next(iter(q.values()))), dt)

        def recall(effect: Bound, quantities: Mapping[str, Any]) -> Any:
            return (series(effect, steps, quantities, before=True) + series(effect, steps, quantities)) / 2

        found = []
        for effect in self.effects:
            if effect.port not in ports or effect.stores_energy:
                continue
            known = self._known(q, effect)
            value = Bound(effect, p)(known, recall)
            if variation := traits(effect).variation:
                healthy = {f"healthy_{name}": x for name, x in self.healthy.items()}
                value = value * variation.bound({**p, **healthy})(known)
            found.append((effect, value))
        return found

    def sum(self, q: Mapping[str, Any], p: Values, dt: float, *ports: Port) -> Any:
        """The sum of `terms`; 0 without any."""
        return summed(self.terms(q, p, dt, *ports))

    def _known(self, q: Mapping[str, Any], effect: Effect) -> Mapping[str, Any]:
        """`q` with the usual vibration if it was not measured; InputError for another missing quantity."""
        for name in effect.reads - q.keys():
            if name != "vibration":
                raise InputError(f"no ride measures {name}, which an effect reads")
            q = {**q, name: np.where(np.abs(q["speed"]) > MOVING, self.vibration, 0.0)}
        return q


def summed(terms: Sequence[tuple[Effect, Any]]) -> Any:
    """The sum of the terms; 0 without any."""
    return sum((term for _, term in terms), 0.0)


def colder(temperature: Array) -> Array:
    """How much colder than a mild day, in the scale of the nuisances."""
    return (PER.warm - temperature) / PER.colder


def moving(ride: Ride, p: Values, system: System) -> dict[str, Array]:
    """The quantities with radius, sensor scale and mass by the parameters."""
    q = dict(ride.quantities)
    scale = 1 / p.get("speed_sensor_scale", 1.0)
    radius = p["wheel_radius"] * p["gear_ratio"] * scale / ride.radius
    q["motor_speed"] = q["motor_speed"] * scale
    q["speed"] = q["speed"] * radius
    q["acceleration"] = q["acceleration"] * radius
    q["lateral_acceleration"] = q["lateral_acceleration"] * radius
    q["mass"] = np.full(len(ride.time), mass(ride, p, system))
    if "current_per_watt" in q:
        more = auxiliary_power(ride, p, system) - auxiliary_power(ride, {**p, **system.healthy}, system)
        q["motor_current"] = q["motor_current"] - q["current_per_watt"] * more
    q["torque"] = torque_constant(ride, p, system) * q["motor_current"]
    return q


def mass(ride: Ride, p: Values, system: System) -> float:
    """Mass of vehicle and payload [kg]: the payload as entered plus its error."""
    usual = system.healthy["payload_mass"]
    entered = ride.payload if ride.payload is not None else usual
    return p["vehicle_mass"] + entered + (p["payload_mass"] - usual) + p["payload_error"]


def torque_constant(ride: Ride, p: Values, system: System) -> Array:
    """Torque constant [N·m/A] over motor temperature and current."""
    q = ride.quantities
    return np.asarray(
        p["torque_constant"]
        * (1 + p["torque_constant_slope"] * (q["motor_temperature"] - PER.magnets))
        * (1 - p["torque_saturation"] * np.abs(q["motor_current"]) / (PER.saturation * system.sizes.current))
    )


def motor_losses(ride: Ride, q: Mapping[str, Array], p: Values, system: System) -> tuple[Any, Any]:
    """(electrical losses, drag losses) [W]; a loss that does not depend on current drags the shaft."""
    terms = system.terms(q, p, STEP, Port.MOTOR_LOSS)
    fed = [(effect, term) for effect, term in terms if "motor_current" in effect.term.quantities]
    drags = [(effect, term) for effect, term in terms if "motor_current" not in effect.term.quantities]
    return summed(fed), summed(drags)


def road_force(ride: Ride, p: Values, system: System) -> Array:
    """Force [N] at the wheel: motor force minus road load minus inertia by the accelerometer."""
    q = moving(ride, p, system)
    shaft = q["torque"] - drag_torque(motor_losses(ride, q, p, system)[1], q["motor_speed"])
    entered, m = float(ride.quantities["mass"][0]), mass(ride, p, system)
    specific = ride.signals["accel_x"] - p["accel_bias"] - p["pitch_gain"] * q["acceleration"]
    force = rotating_mass(p) * q["acceleration"] + system.sum(q, p, STEP, *ROAD_LOAD)
    push = shaft / (p["wheel_radius"] * p["gear_ratio"]) - force
    # the noisy accelerometer is not multiplied by the mass sought: a fit would shrink the mass to reduce the noise
    return np.asarray(entered * (push / m - specific))


def altitude(ride: Ride, p: Values, system: System) -> Array:
    """GPS altitude [m] above the start minus the integral of the grade by the accelerometer."""
    q = moving(ride, p, system)
    acceleration = q["acceleration"]
    sine = grade_shown(ride.signals["accel_x"] - p["accel_bias"], (1 + p["pitch_gain"]) * acceleration)
    height = np.cumsum(sine * q["speed"]) * STEP
    return np.asarray(ride.signals["gps_altitude"] - height - ride.signals["gps_altitude"][0] - p["altitude_start"])


def electric_power(ride: Ride, q: Mapping[str, Array], shaft: Array, p: Values, system: System) -> Array:
    """DC power [W] of motor and inverter at the air-gap power `shaft` [W], (n,)."""
    electric, _ = motor_losses(ride, q, p, system)
    power = shaft + electric
    power = power + system.sum(q, p, STEP, Port.INVERTER_LOSS)
    spin = np.abs(q["motor_speed"]) / (PER.spin * system.sizes.spin)
    cross = p["loss_cross"] * np.abs(q["motor_current"]) / (PER.motor_current * system.sizes.current)
    power = power + (p["loss_speed"] + cross) * spin
    return np.asarray(
        power - p["torque_lag"] * np.gradient(running_mean(np.broadcast_to(power, len(ride.time)), 3), STEP)
    )


def inverter_power(ride: Ride, p: Values, system: System) -> Array:
    """DC power of the inverter [W] minus air-gap power and losses."""
    q = moving(ride, p, system)
    power = electric_power(ride, q, q["torque"] * q["motor_speed"], p, system)
    volts = ride.signals["inverter_voltage"]
    shown = p["inverter_current_gain"] * power + p["inverter_current_offset"] * volts
    return np.asarray(ride.signals["inverter_current"] * volts - shown)


def pack_balance(ride: Ride, p: Values, system: System) -> Array:
    """Pack current [A] minus auxiliary and inverter current."""
    s = ride.signals
    true = true_current(s["pack_current"], p)
    true = true + p["pack_inverter_lag"] * np.gradient(running_mean(true, 3), STEP)
    # the idle current is the inverter's own supply
    inverter = true - s["auxiliary_current"] - p["idle_current"] - ride.loads / s["pack_voltage"]
    shown = p["inverter_current_offset"] + p["inverter_current_gain"] * inverter
    return np.asarray(shown - s["inverter_current"])


def auxiliary(ride: Ride, p: Values, system: System) -> Array:
    """Auxiliary power [W] minus that of the vehicle file and the brake light."""
    s = ride.signals
    return np.asarray(s["auxiliary_current"] * s["pack_voltage"] - auxiliary_power(ride, p, system))


def auxiliary_power(ride: Ride, p: Values, system: System) -> Any:
    """Auxiliary power [W] by the vehicle file, with the brake light."""
    power = system.sum(ride.quantities, p, STEP, Port.DC_POWER)
    if "brake_switch" in ride.signals:
        power = power + p["brake_light"] * (ride.signals["brake_switch"] > 0.5)
    return power


def voltage_balance(ride: Ride, p: Values, system: System) -> Array:
    """Pack voltage [V] minus inverter voltage and cable drop."""
    s = ride.signals
    inverter = s["inverter_voltage"] + p["cable_resistance"] * s["inverter_current"] - p["inverter_voltage_offset"]
    return np.asarray(true_voltage(s["pack_voltage"], p) - inverter)


class CellCircuit(NamedTuple):
    """The circuit of a mean cell, at steps of `DT`."""

    voltage: Array  # V, at its terminals
    rest: Array  # V, without a current
    current: Array  # A, of the pack
    soc: Array


def cell_circuit(ride: Ride, p: Values, system: System) -> CellCircuit:
    """The circuit of a mean cell at the measured current."""
    battery = system.pack
    cell = block_means(true_current(ride.signals["pack_current"], p), COARSE) / battery.cells_parallel
    temperature = ride.coarse["cell_temperature"]
    cold = colder(temperature)
    capacity = p["cell_capacity"] * curve_over(battery.capacity_share, temperature)
    taken = discharged(cell, DT, capacity)
    soc = p["soc_start"] + ride.start_soc - (np.cumsum(taken) - taken / 2)  # at the middle of each step
    factor = p.get("cell_resistance_factor", 1.0) * (1 + p["resistance_level"] + p["resistance_cold"] * cold)
    bent = p["resistance_current"] + p["resistance_current_cold"] * cold
    empty = p["resistance_empty"] + p["resistance_empty_cold"] * cold
    steep = bent * np.abs(cell) * system.sizes.resistance / PER.cell_current
    factor = factor * (1 + empty * (1 - soc) / PER.empty - steep)
    r0 = mesh_over(battery.r0, soc, temperature) * factor
    r1 = mesh_over(battery.r1, soc, temperature)
    decay = np.exp(-DT / (r1 * mesh_over(battery.c1, soc, temperature) * np.exp(p["pair_time"])))
    settled = r1 * (1 + p["pair_resistance"]) * factor * cell
    v1 = relaxation(settled, decay, p["v1_start"], before=True)
    v1 = (v1 + decay * v1 + (1 - decay) * settled) / 2  # the mean of the step's ends
    extra: Any = p["drift"] * np.arange(len(cell)) * DT / PER.drift
    mid = relaxation(cell, np.full(len(cell), np.exp(-DT / 200.0)), before=True)
    extra = extra + p["mid_resistance"] * mid
    q = ride.coarse | {"cell_current": cell, "soc": soc, "cell_temperature": temperature, "cell_capacity": capacity}
    extra = extra + system.sum(q, p, DT, Port.CELL_VOLTAGE)
    rest = ocv_over(battery, soc, temperature) + p["ocv_offset"]
    rest = rest + p["ocv_tilt"] * (soc - PER.middle) + p["ocv_cold"] * cold
    return CellCircuit(terminal_voltage(rest, r0, cell, v1 + extra), rest, cell * battery.cells_parallel, soc)


def start_soc(ride: Ride, system: System) -> float:
    """The SOC that the first voltages point to, by the vehicle file; `soc_start` counts from there."""
    volts = true_voltage(float(np.mean(ride.signals["pack_voltage"][:20])), system.healthy)
    amperes = true_current(float(np.mean(ride.signals["pack_current"][:20])), system.healthy)
    celsius = float(ride.quantities["cell_temperature"][0])
    load = standing_load(amperes, volts, system.healthy["auxiliary_power"])
    return first_soc(system.cells, system.pack, (volts, amperes), celsius, load)


def counted_soc(ride: Ride, system: System) -> Array:
    """SOC by counting the current from where the first voltages point to, shape (n,)."""
    capacity = system.pack.pack_capacity(float(ride.quantities["cell_temperature"][0]))
    amperes = true_current(ride.signals["pack_current"], system.healthy)
    return np.asarray(ride.start_soc - np.cumsum(discharged(amperes, STEP, capacity)))


def cell_voltage(ride: Ride, p: Values, system: System) -> Array:
    """Voltage [V] of a mean cell minus that of its circuit at the measured current, at steps of `DT`."""
    battery = replace(system.pack, series_resistance=p["pack_series_resistance"])
    cell = cell_circuit(ride, p, system)
    measured = true_voltage(ride.coarse["pack_voltage"], p)
    return np.asarray(battery.cell_voltage(measured, cell.current) - cell.voltage)


def voltage_timing(ride: Ride, p: Values, system: System) -> Array:
    """Voltage steps [V] of a mean cell between grid steps, minus current steps times resistance."""
    battery = system.pack
    late = p.get("pack_voltage_latency", 0.0)
    amperes = true_current(ride.signals["pack_current"], p)
    if late:
        amperes = np.interp(ride.time - late, ride.time, amperes)
    soc = np.full(len(ride.time), ride.start_soc)
    r0 = mesh_over(battery.r0, soc, ride.quantities["cell_temperature"])
    resistance = r0 * p.get("cell_resistance_factor", 1.0) / battery.cells_parallel
    resistance = resistance + p["pack_series_resistance"] / battery.cells_series
    fast = p["fast_resistance"] + p["fast_cold"] * colder(ride.quantities["cell_temperature"])
    resistance = resistance * (1 + fast)
    step = np.diff(ride.signals["pack_voltage"]) / battery.cells_series + resistance[1:] * np.diff(amperes)
    return np.append(step, 0.0)


def gps_speed(ride: Ride, p: Values, system: System) -> Array:
    """GPS speed [m/s] minus motor speed by wheel radius, slip and lean."""
    q = moving(ride, p, system)
    slip = 1 - p["slip_per_force"] * q["torque"] / p["wheel_radius"] / (PER.slip * system.sizes.power)
    lean = 1 - p["lean_radius"] * (q["lateral_acceleration"] / GRAVITY) ** 2 / 2
    return np.asarray(ride.signals["gps_speed"] - q["speed"] * slip * lean + p["gps_lag"] * q["acceleration"])


def rear_speed(ride: Ride, p: Values, system: System) -> Array:
    """Rear-wheel speed [m/s] minus motor speed."""
    q = moving(ride, p, system)
    return np.asarray(
        (ride.signals["wheel_speed_rear"] * (1 - p["rear_scale"]) - q["motor_speed"] * p["gear_ratio"]) * ride.radius
        + p["wheel_lag"] * q["acceleration"]
    )


def front_speed(ride: Ride, p: Values, system: System) -> Array:
    """Front-wheel speed [m/s] minus motor speed by slip and lean."""
    q = moving(ride, p, system)
    slip = 1 - p["slip_per_force"] * q["torque"] / p["wheel_radius"] / (PER.slip * system.sizes.power)
    lean = 1 - p["front_lean"] * (q["lateral_acceleration"] / GRAVITY) ** 2 / 2
    speed = q["motor_speed"] * p["gear_ratio"] * slip * lean
    front = ride.signals["wheel_speed_front"] * (1 - p["front_scale"])
    return np.asarray((front - speed) * ride.radius + p["wheel_lag"] * q["acceleration"])


def _heat(ride: Ride, p: Values, system: System) -> tuple[Array, Array, Array]:
    """Losses [W] at steps of 1 s: (motor, the part of it without current, inverter)."""
    q = moving(ride, p, system)
    electric, drag = motor_losses(ride, q, p, system)
    losses = (electric + drag, drag, system.sum(q, p, STEP, Port.INVERTER_LOSS))
    motor, idle, inverter = (block_means(np.broadcast_to(x, len(ride.time)), WARMING) for x in losses)
    return motor, idle, inverter


def _warmed(ride: Ride, p: Values, channel: tuple[str, str], network: Network, watts: Array, *idle: Array) -> Array:
    """Measured temperature minus that of `network` [K], heated by `watts`, of which `idle` without current.

    channel: (sensor, parameter of how much more moving air cools than the network says).
    """
    sensor, airflow = channel
    speed, ambient = (block_means(ride.quantities[name], WARMING) for name in ("speed", "ambient_temperature"))
    speed = np.abs(speed)
    factor = p.get("cooling_factor", 1.0) * np.maximum(1 + p[airflow] * speed / PER.wind, 0.05)
    modelled: Array = np.array(temperatures(network, WARMING * STEP, watts, ambient, speed, factor, *idle))
    return block_means(ride.signals[sensor], WARMING) - modelled


def _first(ride: Ride, sensor: str) -> float:
    """The mean of the first 10 s."""
    return float(ride.signals[sensor][:100].mean())


def motor_temperature(ride: Ride, p: Values, system: System) -> Array:
    """Stator temperature [K] minus that of the cooling network at the modelled loss, at steps of 1 s."""
    stator = _first(ride, "motor_temperature") + p["motor_start"]
    ambient = float(ride.quantities["ambient_temperature"][:WARMING].mean())
    network = MotorCooling(p, stator, stator + p["rotor_start"] * (stator - ambient) / PER.warmer)
    watts, idle, _ = _heat(ride, p, system)
    return _warmed(ride, p, ("motor_temperature", "motor_airflow"), network, watts, idle)


def inverter_temperature(ride: Ride, p: Values, system: System) -> Array:
    """Board temperature [K] minus that of the cooling network at the modelled loss, at steps of 1 s."""
    board = _first(ride, "inverter_temperature") + p["inverter_start"]
    network = InverterCooling(p, board, board + p["box_start"])
    return _warmed(ride, p, ("inverter_temperature", "inverter_airflow"), network, _heat(ride, p, system)[2])


def cell_temperature(ride: Ride, p: Values, system: System) -> Array:
    """Cell temperature [K] minus that of a lump heated by the circuit, at steps of 1 s."""
    cell = cell_circuit(ride, p, system)
    watts = system.pack.cells_series * heat(cell.rest, cell.voltage, cell.current)
    watts = watts + reversible_heat_over(system.pack, cell.current, cell.soc, ride.coarse["cell_temperature"])
    network = LumpedCooling(p, "pack", _first(ride, "cell_temperature") + p["cells_start"])
    return _warmed(ride, p, ("cell_temperature", "pack_airflow"), network, block_means(watts, WARMING // COARSE))


AS_IN_FILE = (
    "pack_current_gain",
    "wheel_radius",
    "speed_sensor_scale",
    "torque_constant",
    "torque_constant_slope",
    "torque_saturation",
)


def road_power(ride: Ride, q: Mapping[str, Array], p: Values, system: System) -> Array:
    """Air-gap power [W] that the measured motion needs, against road load and the drag of the motor."""
    if "accel_x" in ride.signals:
        specific = ride.signals["accel_x"] - p["accel_bias"] - p["pitch_gain"] * q["acceleration"]
    else:
        specific = q["acceleration"] + GRAVITY * q["grade"]
    force = q["mass"] * specific + rotating_mass(p) * q["acceleration"]
    force = force + system.sum(q, p, STEP, *ROAD_LOAD)
    return np.asarray(force * q["speed"] + motor_losses(ride, q, p, system)[1])


def pack_power(ride: Ride, p: Values, system: System) -> Array:
    """Pack power [W] minus drive and auxiliary power, each as measured, else by its model.

    Without motor current the drive power is that of the road load, and its losses are those at the current that the
    pack power implies. Nothing that is fitted multiplies the noisy acceleration (as in `road_force`), and parameters
    in proportion to the whole drive power keep the file's values (`AS_IN_FILE`): they would absorb unmeasured hills.
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
