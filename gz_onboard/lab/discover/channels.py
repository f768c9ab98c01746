"""Residuals: in each channel, what was measured less what the model says of it, given the other measurements.

Each channel is an analytical redundancy relation (Gertler 1998; Krysander & Frisk 2008): a balance of one part of the
vehicle that takes its inputs from sensors, not from the model of another part. So a fault in one part shows in few
channels, and causes that look alike in the energy drawn (a heavier rider, a weaker magnet) do not in all of them.

    road_force           N      torque at the wheel, less road load; mass times the accelerometer is grade and inertia
    altitude             m      GPS altitude, less the way times the grade that the accelerometer shows
    inverter_power       W      DC power of the inverter, less air-gap power and losses
    pack_balance         A      pack current less auxiliary current, less inverter current
    auxiliary            W      what the auxiliary current sensor shows
    voltage_balance      V      pack voltage, less inverter voltage and cable drop
    cell_voltage         V      of a mean cell, less the equivalent circuit at the current measured
    voltage_timing       V      its step in 0.1 s, less that of the current
    gps_speed            m/s    less motor speed times wheel radius
    rear_speed, front_speed   m/s    wheel-speed sensors, less motor speed
    motor_temperature, inverter_temperature, cell_temperature   K   less the cooling networks at the modelled heat

Every function takes the ride and a mapping of parameters, so that a column of the linear model is its difference.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.constants import GRAVITY
from gz_onboard.errors import InputError
from gz_onboard.lab.discover.grid import MOVING, STEP, Ride
from gz_onboard.physics.battery import Battery
from gz_onboard.physics.effect import Effect
from gz_onboard.physics.relaxation import relaxation, relaxed
from gz_onboard.physics.riding import VIBRATION
from gz_onboard.physics.tables import Mesh

Values = Mapping[str, float]
SLOW = 5  # grid steps to one of the battery and cooling models: 0.5 s
DT = SLOW * STEP
MID = 200.0  # s: between the pair of the vehicle file and slow relaxation
NOT_ROAD = ("grade_force", "inertia")  # what the accelerometer measures


@dataclass(frozen=True)
class System:
    """What the channels are predicted with: the effects (of the model and the candidates) and the battery."""

    effects: tuple[Effect, ...]
    battery: Battery | None
    payload: float  # kg, of the vehicle file: what a ride without an entry carries
    copper: float = 0.0  # ohm, of the healthy motor
    vibration: float = VIBRATION  # m/s², of the vehicle file's prior riding: for rides that did not measure it

    def at(self, *ports: str) -> list[Effect]:
        """The effects at these ports."""
        return [e for e in self.effects if e.port.name in ports and e.name not in NOT_ROAD]

    def term(self, effect: Effect, q: Mapping[str, Any], p: Values, dt: float) -> Any:
        """The term of `effect` over time; the state's, if it has memory."""
        read = [q[name] if name in q else typical(q, name, self.vibration) for name in effect.quantities]
        term = effect.term(*read, **{name: p[name] for name in effect.keywords})
        if effect.decay is None:
            return term
        n = len(next(iter(q.values())))
        if not np.any(term):
            return np.zeros(n)
        keywords = {name: p[name] for name in effect.decay_keywords}
        read = [q[name] if name in q else typical(q, name, self.vibration) for name in effect.decay_quantities]
        factor = effect.decay(dt, *read, **keywords)
        return recursion(np.broadcast_to(factor, n), np.broadcast_to(term, n))


def typical(q: Mapping[str, Array], name: str, vibration: float) -> Array:
    """A quantity that a ride did not measure, shape of its others; InputError for one that nothing stands in for.

    vibration: of the vehicle while it moves [m/s²].
    """
    if name != "vibration":
        raise InputError(f"no ride measures {name}, which an effect reads")
    return np.where(np.abs(q["speed"]) > MOVING, vibration, 0.0)


def recursion(decay: Array, target: Array, start: float = 0.0) -> Array:
    """`relaxation` at the beginnings of the steps, x[0] = start; shape of `decay`."""
    return np.array([start, *relaxation(target.tolist(), decay.tolist(), start)[:-1]])


def mesh_at(mesh: Mesh, soc: Array, temperature: Array) -> Array:
    """A table at arrays of SOC and temperature, shape of `soc`; edges hold beyond the table."""
    rows = np.array(mesh.value)
    xs, ts = np.array(mesh.soc), np.array(mesh.temperature)
    i = np.clip(np.searchsorted(xs, soc, side="right") - 1, 0, len(xs) - 2)
    u = np.clip((soc - xs[i]) / (xs[i + 1] - xs[i]), 0, 1)
    if len(ts) == 1:
        return np.asarray(rows[0][i] * (1 - u) + rows[0][i + 1] * u)
    j = np.clip(np.searchsorted(ts, temperature, side="right") - 1, 0, len(ts) - 2)
    w = np.clip((temperature - ts[j]) / (ts[j + 1] - ts[j]), 0, 1)
    low = rows[j, i] * (1 - u) + rows[j, i + 1] * u
    high = rows[j + 1, i] * (1 - u) + rows[j + 1, i + 1] * u
    return np.asarray(low * (1 - w) + high * w)


def rest_at(battery: Battery, soc: Array, temperature: Array) -> Array:
    """Rest voltage of a cell, shape of `soc`: `Battery.ocv` for a whole ride."""
    rest = ocv_at(battery, soc)
    if battery.rest_shift_value:
        rest = rest + np.interp(temperature, battery.rest_shift_temperature, battery.rest_shift_value)
    return rest


def ocv_at(battery: Battery, soc: Array) -> Array:
    """Open-circuit voltage of a cell, going on along its last slopes."""
    xs, ys = np.array(battery.ocv_soc), np.array(battery.ocv_value)
    i = np.clip(np.searchsorted(xs, soc, side="right") - 1, 0, len(xs) - 2)
    return np.asarray(ys[i] + (ys[i + 1] - ys[i]) / (xs[i + 1] - xs[i]) * (soc - xs[i]))


def mean_over(values: Array, n: int) -> Array:
    """Means over blocks of `n`, the rest at the end left out."""
    blocks = len(values) // n
    return np.asarray(values[: blocks * n].reshape(blocks, n).mean(axis=1))


# --- what several channels share -----------------------------------------------------------------------------------


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
    q["torque"] = torque_constant(ride, p) * q["motor_current"]
    return q


def mass(ride: Ride, p: Values, system: System) -> float:
    """Vehicle and payload [kg]: the payload entered, and by how much it is wrong."""
    entered = ride.payload if ride.payload is not None else system.payload
    return p["vehicle_mass"] + entered + (p["payload_mass"] - system.payload) + p["payload_error"]


def torque_constant(ride: Ride, p: Values) -> Array:
    """The true one [N·m/A], over motor temperature and current."""
    q = ride.quantities
    return np.asarray(
        p["torque_constant"]
        * (1 + p["torque_constant_slope"] * (q["motor_temperature"] - 40))
        * (1 - p["torque_saturation"] * np.abs(q["motor_current"]) / 100)
    )


def motor_losses(ride: Ride, q: Mapping[str, Array], p: Values, system: System) -> tuple[Any, Any]:
    """(losses fed electrically, losses that drag) [W]. Loss that does not depend on current drags the shaft."""
    electric: Any = 0.0
    drag: Any = 0.0
    for effect in system.at("MOTOR_LOSS"):
        term = system.term(effect, q, p, STEP)
        if "motor_current" not in effect.quantities:
            drag = drag + term
        elif effect.name == "motor_copper_loss":
            own = system.copper / p["motor_copper_resistance"]  # what a cause adds does not grow with frequency
            electric = electric + term * (1 + own * p["copper_speed"] * np.abs(q["motor_speed"]) / 50)
        else:
            electric = electric + term
    return electric, drag


def current(ride: Ride, p: Values) -> Array:
    """The pack's true current [A]."""
    return np.asarray((ride.signals["pack_current"] - p["pack_current_offset"]) / p["pack_current_gain"])


# --- the channels --------------------------------------------------------------------------------------------------


def road_force(ride: Ride, p: Values, system: System) -> Array:
    """[N] at the wheel."""
    q = moving(ride, p, system)
    drag = motor_losses(ride, q, p, system)[1]
    speed = q["motor_speed"]
    direction = speed / np.hypot(speed, 0.5)
    shaft = q["torque"] - drag / np.hypot(speed, 0.5) * direction
    entered, m = float(ride.quantities["mass"][0]), mass(ride, p, system)
    rotating = (p["wheel_inertia_front"] + p["wheel_inertia_rear"]) / p["wheel_radius"] ** 2
    specific = ride.signals["accel_x"] - p["accel_bias"] - p["pitch_gain"] * q["acceleration"]
    force = rotating * q["acceleration"]
    for effect in system.at("WHEEL_FORCE", "TYRE"):
        term = system.term(effect, q, p, STEP)
        if effect.name == "rolling_resistance":
            term = term * (1 + p["rolling_cold"] * (20 - q["ambient_temperature"]) / 20)
        force = force + term
    push = shaft / (p["wheel_radius"] * p["gear_ratio"]) - force
    # what is noisy stands alone: were the accelerometer multiplied with the mass that is sought, the least noise would
    # be had with the least mass, and all that it is weighed with would shrink along
    return np.asarray(entered * (push / m - specific))


def altitude(ride: Ride, p: Values, system: System) -> Array:
    """[m]"""
    q = moving(ride, p, system)
    acceleration = q["acceleration"]
    sine = (ride.signals["accel_x"] - p["accel_bias"] - (1 + p["pitch_gain"]) * acceleration) / GRAVITY
    height = np.cumsum(sine * q["speed"]) * STEP
    return np.asarray(ride.signals["gps_altitude"] - height - ride.signals["gps_altitude"][0] - p["altitude_start"])


def inverter_power(ride: Ride, p: Values, system: System) -> Array:
    """[W] on the DC side."""
    q = moving(ride, p, system)
    electric, _ = motor_losses(ride, q, p, system)
    power = q["torque"] * q["motor_speed"] + electric
    for effect in system.at("INVERTER_LOSS"):
        power = power + system.term(effect, q, p, STEP)
    spin = np.abs(q["motor_speed"]) / 50
    power = power + (p["loss_speed"] + p["loss_cross"] * np.abs(q["motor_current"]) / 50) * spin
    power = power - p["torque_lag"] * np.gradient(smooth3(np.broadcast_to(power, len(ride.time))), STEP)
    volts = ride.signals["inverter_voltage"]
    shown = p["inverter_current_gain"] * power + p["inverter_current_offset"] * volts
    return np.asarray(ride.signals["inverter_current"] * volts - shown)


def pack_balance(ride: Ride, p: Values, system: System) -> Array:
    """[A]"""
    s = ride.signals
    true = (s["pack_current"] - p["pack_current_offset"]) / p["pack_current_gain"]
    true = true + p["pack_inverter_lag"] * np.gradient(smooth3(true), STEP)
    # beside the auxiliary load there is what is drawn when nothing is: the inverter's own supply
    inverter = true - s["auxiliary_current"] - p["idle_current"]
    shown = p["inverter_current_offset"] + p["inverter_current_gain"] * inverter
    return np.asarray(shown - s["inverter_current"])


def smooth3(x: Array) -> Array:
    """A running mean of three."""
    return np.asarray(np.convolve(np.pad(x, 1, "edge"), np.ones(3) / 3, "valid"))


def auxiliary(ride: Ride, p: Values, system: System) -> Array:
    """[W]"""
    s = ride.signals
    q = ride.quantities
    power: Any = 0.0
    for effect in system.at("DC_POWER"):
        power = power + system.term(effect, q, p, STEP)
    if "brake_switch" in s:
        power = power + p["brake_light"] * (s["brake_switch"] > 0.5)
    return np.asarray(s["auxiliary_current"] * s["pack_voltage"] - power)


def voltage_balance(ride: Ride, p: Values, system: System) -> Array:
    """[V]"""
    s = ride.signals
    inverter = s["inverter_voltage"] + p["cable_resistance"] * s["inverter_current"] - p["inverter_voltage_offset"]
    return np.asarray(s["pack_voltage"] - p["pack_voltage_offset"] - inverter)


def cell_circuit(ride: Ride, p: Values, system: System) -> tuple[Array, Array, Array]:
    """(terminal voltage of a cell by the circuit [V], the pack's current [A], SOC) at steps of `DT`."""
    battery = system.battery
    assert battery is not None
    cell = mean_over(current(ride, p), SLOW) / battery.cells_parallel
    temperature = mean_over(ride.quantities["cell_temperature"], SLOW)
    share = np.interp(temperature, battery.capacity_temperature, battery.capacity_share)
    capacity = p["cell_capacity"] * share
    charge = np.cumsum(cell / (3600 * capacity)) * DT
    soc = p["soc_start"] + start_soc(ride, system) - (charge - cell / (3600 * capacity) * DT / 2)
    grown = p.get("cell_resistance_factor", 1.0)
    factor = grown * (1 + p["resistance_level"] + p["resistance_cold"] * (20 - temperature) / 20)
    bent = p["resistance_current"] + p["resistance_current_cold"] * (20 - temperature) / 20
    empty = p["resistance_empty"] + p["resistance_empty_cold"] * (20 - temperature) / 20
    factor = factor * (1 + empty * (1 - soc) / 0.4 - bent * np.abs(cell) / 5)
    r0 = mesh_at(battery.r0, soc, temperature) * factor
    r1 = mesh_at(battery.r1, soc, temperature)
    decay = np.exp(-DT / (r1 * mesh_at(battery.c1, soc, temperature) * np.exp(p["pair_time"])))
    r1 = r1 * (1 + p["pair_resistance"])
    v1 = recursion(decay, r1 * factor * cell, p["v1_start"])
    v1 = (v1 + relaxed(v1, r1 * factor * cell, decay)) / 2  # the mean of the step's ends
    extra: Any = p["drift"] * np.arange(len(cell)) * DT / 600
    extra = extra + p["mid_resistance"] * recursion(np.full(len(cell), np.exp(-DT / MID)), cell)
    q = {name: mean_over(value, SLOW) for name, value in ride.quantities.items()}
    q |= {"cell_current": cell, "soc": soc, "cell_temperature": temperature, "cell_capacity": capacity}
    for effect in system.at("CELL_VOLTAGE"):
        extra = extra + system.term(effect, q, p, DT)
    rest = rest_at(battery, soc, temperature) + p["ocv_offset"] + p["ocv_tilt"] * (soc - 0.7)
    rest = rest + p["ocv_cold"] * (20 - temperature) / 20
    return rest - r0 * cell - v1 - extra, cell * battery.cells_parallel, soc


def start_soc(ride: Ride, system: System) -> float:
    """The SOC that the first voltages point to, with the current taken off by the ohmic resistance."""
    battery = system.battery
    assert battery is not None
    first = slice(0, 20)
    amperes = float(np.mean(ride.signals["pack_current"][first])) / battery.cells_parallel
    volts = float(np.mean(ride.signals["pack_voltage"][first])) / battery.cells_series
    temperature = float(ride.quantities["cell_temperature"][0])
    return battery.soc_at(volts + amperes * battery.r0.at(0.6, temperature)[0], temperature)


def counted_soc(ride: Ride, system: System) -> Array:
    """SOC by counting the current from where the first voltages point to, shape (n,)."""
    battery = system.battery
    assert battery is not None
    charge = np.cumsum(ride.signals["pack_current"]) * STEP
    return np.asarray(start_soc(ride, system) - charge / (3600 * battery.pack_capacity(25.0)))


def cell_voltage(ride: Ride, p: Values, system: System) -> Array:
    """[V] of a mean cell, at steps of `DT`."""
    battery = system.battery
    assert battery is not None
    volts, amperes, _ = cell_circuit(ride, p, system)
    measured = mean_over(ride.signals["pack_voltage"], SLOW) - p["pack_voltage_offset"]
    return np.asarray((measured + p["pack_series_resistance"] * amperes) / battery.cells_series - volts)


def voltage_timing(ride: Ride, p: Values, system: System) -> Array:
    """[V] of a mean cell, at the grid's steps but the last."""
    battery = system.battery
    assert battery is not None
    late = p.get("pack_voltage_latency", 0.0)
    amperes = current(ride, p)
    if late:
        amperes = np.interp(ride.time - late, ride.time, amperes)
    soc = np.full(len(ride.time), start_soc(ride, system))
    r0 = mesh_at(battery.r0, soc, ride.quantities["cell_temperature"])
    resistance = r0 * p.get("cell_resistance_factor", 1.0) / battery.cells_parallel
    resistance = resistance + p["pack_series_resistance"] / battery.cells_series
    colder = (20 - ride.quantities["cell_temperature"]) / 20
    resistance = resistance * (1 + p["fast_resistance"] + p["fast_cold"] * colder)
    step = np.diff(ride.signals["pack_voltage"]) / battery.cells_series + resistance[1:] * np.diff(amperes)
    return np.append(step, 0.0)


def gps_speed(ride: Ride, p: Values, system: System) -> Array:
    """[m/s]"""
    q = moving(ride, p, system)
    slip = 1 - p["slip_per_force"] * q["torque"] / p["wheel_radius"] / 100
    lean = 1 - p["lean_radius"] * (q["lateral_acceleration"] / GRAVITY) ** 2 / 2
    return np.asarray(ride.signals["gps_speed"] - q["speed"] * slip * lean + p["gps_lag"] * q["acceleration"])


def rear_speed(ride: Ride, p: Values, system: System) -> Array:
    """[m/s]"""
    q = moving(ride, p, system)
    return np.asarray(
        (ride.signals["wheel_speed_rear"] * (1 - p["rear_scale"]) - q["motor_speed"] * p["gear_ratio"]) * ride.radius
        + p["wheel_lag"] * q["acceleration"]
    )


def front_speed(ride: Ride, p: Values, system: System) -> Array:
    """[m/s]"""
    q = moving(ride, p, system)
    slip = 1 - p["slip_per_force"] * q["torque"] / p["wheel_radius"] / 100
    lean = 1 - p["front_lean"] * (q["lateral_acceleration"] / GRAVITY) ** 2 / 2
    speed = q["motor_speed"] * p["gear_ratio"] * slip * lean
    front = ride.signals["wheel_speed_front"] * (1 - p["front_scale"])
    return np.asarray((front - speed) * ride.radius + p["wheel_lag"] * q["acceleration"])


def _heat(ride: Ride, p: Values, system: System) -> tuple[Array, Array]:
    """(motor's, inverter's) loss [W] at steps of `DT`."""
    q = moving(ride, p, system)
    electric, drag = motor_losses(ride, q, p, system)
    inverter: Any = 0.0
    for effect in system.at("INVERTER_LOSS"):
        inverter = inverter + system.term(effect, q, p, STEP)
    n = len(ride.time)
    return mean_over(np.broadcast_to(electric + drag, n), SLOW), mean_over(np.broadcast_to(inverter, n), SLOW)


def _air(ride: Ride, p: Values, name: str) -> list[float]:
    """How much more the moving air cools than the conductance says, at steps of `DT`."""
    flow = 1 + p[name] * np.abs(mean_over(ride.quantities["speed"], SLOW)) / 10
    return [float(x) for x in p.get("cooling_factor", 1.0) * np.maximum(flow, 0.05)]


def motor_temperature(ride: Ride, p: Values, system: System) -> Array:
    """[K] at steps of `DT`; Lord 2016, eqs. 2.27-2.28."""
    heat = _heat(ride, p, system)[0].tolist()
    measured = mean_over(ride.signals["motor_temperature"], SLOW)
    ambient = mean_over(ride.quantities["ambient_temperature"], SLOW).tolist()
    stator = float(measured[:20].mean()) + p["motor_start"]
    rotor = stator + p["rotor_start"] * (stator - ambient[0]) / 10
    share, gap = p["motor_stator_share"], p["motor_gap_conductance"]
    a, b = DT / p["motor_stator_capacity"], DT / p["motor_rotor_capacity"]
    out = []
    for h, t, air in zip(heat, ambient, _air(ride, p, "motor_airflow"), strict=True):
        out.append(stator)
        across = gap * (stator - rotor)
        stator += a * (share * h - across)
        rotor += b * ((1 - share) * h + across - p["motor_rotor_to_ambient"] * air * (rotor - t))
    return np.asarray(measured - np.array(out))


def inverter_temperature(ride: Ride, p: Values, system: System) -> Array:
    """[K] at steps of `DT`; Lord 2016, eqs. 2.25-2.26, the air in the box without heat capacity."""
    heat = _heat(ride, p, system)[1].tolist()
    measured = mean_over(ride.signals["inverter_temperature"], SLOW)
    ambient = mean_over(ride.quantities["ambient_temperature"], SLOW).tolist()
    board = float(measured[:20].mean()) + p["inverter_start"]
    box = board + p["box_start"]
    hb, hc = p["inverter_board_to_air"], p["inverter_box_to_air"]
    across = p["inverter_board_to_box"] + hb * hc / (hb + hc)
    a, b = DT / p["inverter_board_capacity"], DT / p["inverter_box_capacity"]
    out = []
    for h, t, air in zip(heat, ambient, _air(ride, p, "inverter_airflow"), strict=True):
        out.append(board)
        flow = across * (board - box)
        board += a * (h - flow)
        box += b * (flow - p["inverter_box_to_ambient"] * air * (box - t))
    return np.asarray(measured - np.array(out))


def cell_temperature(ride: Ride, p: Values, system: System) -> Array:
    """[K] at steps of `DT`; Lord 2016, eqs. 2.24, 2.29."""
    battery = system.battery
    assert battery is not None
    volts, amperes, soc = cell_circuit(ride, p, system)
    measured = mean_over(ride.signals["cell_temperature"], SLOW)
    rest = rest_at(battery, soc, mean_over(ride.quantities["cell_temperature"], SLOW))
    heat = (battery.cells_series * (rest - volts) * amperes).tolist()
    ambient = mean_over(ride.quantities["ambient_temperature"], SLOW).tolist()
    cells = float(measured[:20].mean()) + p["cells_start"]
    a = DT / p["pack_heat_capacity"]
    out = []
    for h, t, air in zip(heat, ambient, _air(ride, p, "pack_airflow"), strict=True):
        out.append(cells)
        cells += a * (h - p["pack_conductance"] * air * (cells - t))
    return np.asarray(measured - np.array(out))


# --- what they need and where they hold ----------------------------------------------------------------------------


def _always(ride: Ride) -> Mask:
    return np.ones(len(ride.time), dtype=bool)


def _rolling(ride: Ride) -> Mask:
    return np.asarray((np.abs(ride.quantities["speed"]) > 2.0) & ~ride.braking)


def _fast(ride: Ride) -> Mask:
    fix = ride.signals["gps_fix"] > 2.5 if "gps_fix" in ride.signals else np.ones(len(ride.time), dtype=bool)
    return np.asarray((np.abs(ride.quantities["speed"]) > 4.0) & fix)


def _coasting(ride: Ride) -> Mask:
    return np.asarray((np.abs(ride.quantities["speed"]) > 3.0) & ~ride.braking)


@dataclass(frozen=True)
class Channel:
    """One residual: how long its blocks are, what it needs, where it holds, and which parameters it depends on.

    ports: those whose effects act on it. correlated: whether its noise is (if not, its blocks are independent).
    """

    name: str
    unit: str
    block: float  # s
    steps: int  # grid steps to one of the function's
    roles: tuple[str, ...]
    residual: Callable[[Ride, Values, System], Array]
    holds: Callable[[Ride], Mask]
    parameters: tuple[str, ...]
    ports: tuple[str, ...] = ()
    noise: tuple[float, float, float] = (1.0, 1.0, 60.0)  # white sd, correlated sd, s: before any healthy ride
    battery: bool = False
    correlated: bool = True
    slow: float = 0.0  # s: the shortest correlation that its noise can have; what its model lacks is slow
    rough: float = 0.0  # A of motor current within a block that double its variance; 0: none do
    shaken: float = 0.0  # m/s² of vibration that do; 0: none


_TORQUE = ("torque_constant", "torque_constant_slope", "torque_saturation")
_SPEED = ("wheel_radius", "speed_sensor_scale")
_CELL = (
    "pack_current_offset",
    "pack_current_gain",
    "cell_capacity",
    "soc_start",
    "cell_resistance_factor",
    "v1_start",
    "resistance_cold",
    "ocv_offset",
    "ocv_tilt",
    "ocv_cold",
    "pair_resistance",
    "pair_time",
    "mid_resistance",
    "drift",
    "resistance_level",
    "resistance_empty_cold",
    "resistance_empty",
    "resistance_current",
    "resistance_current_cold",
)

CHANNELS = (
    Channel(
        "road_force",
        "N",
        4.0,
        1,
        ("motor_speed", "motor_current", "accel_x"),
        road_force,
        _rolling,
        (*_TORQUE, *_SPEED, "payload_mass", "payload_error", "accel_bias", "pitch_gain", "rolling_cold"),
        ("WHEEL_FORCE", "TYRE", "MOTOR_LOSS"),
        (5.0, 2.0, 60.0),
        rough=60.0,
        shaken=0.85,
    ),
    Channel(
        "altitude",
        "m",
        10.0,
        1,
        ("accel_x", "gps_altitude"),
        altitude,
        _always,
        ("accel_bias", "pitch_gain", "altitude_start", "wheel_radius", "speed_sensor_scale"),
        (),
        (0.5, 2.5, 120.0),
    ),
    Channel(
        "inverter_power",
        "W",
        2.0,
        1,
        ("inverter_voltage", "inverter_current", "motor_speed", "motor_current"),
        inverter_power,
        _always,
        (
            *_TORQUE,
            "speed_sensor_scale",
            "copper_speed",
            "inverter_current_gain",
            "inverter_current_offset",
            "torque_lag",
            "loss_speed",
            "loss_cross",
        ),
        ("MOTOR_LOSS", "INVERTER_LOSS"),
        (6.0, 4.0, 60.0),
        rough=10.0,
    ),
    Channel(
        "pack_balance",
        "A",
        2.0,
        1,
        ("pack_current", "inverter_current", "auxiliary_current"),
        pack_balance,
        _always,
        (
            "pack_current_offset",
            "pack_current_gain",
            "inverter_current_offset",
            "inverter_current_gain",
            "idle_current",
            "pack_inverter_lag",
        ),
        (),
        (0.1, 0.03, 60.0),
        rough=30.0,
    ),
    Channel(
        "auxiliary",
        "W",
        4.0,
        1,
        ("auxiliary_current", "pack_voltage"),
        auxiliary,
        _always,
        ("brake_light",),
        ("DC_POWER",),
        (1.0, 1.0, 60.0),
    ),
    Channel(
        "voltage_balance",
        "V",
        2.0,
        1,
        ("pack_voltage", "inverter_voltage", "inverter_current"),
        voltage_balance,
        _always,
        ("pack_voltage_offset", "inverter_voltage_offset", "cable_resistance"),
        (),
        (0.03, 0.01, 60.0),
    ),
    Channel(
        "cell_voltage",
        "V",
        2.0,
        SLOW,
        ("pack_voltage", "pack_current"),
        cell_voltage,
        _always,
        (*_CELL, "pack_voltage_offset", "pack_series_resistance"),
        ("CELL_VOLTAGE",),
        (0.002, 0.008, 300.0),
        True,
        slow=60.0,
        rough=10.0,
    ),
    Channel(
        "voltage_timing",
        "V",
        0.1,
        1,
        ("pack_voltage", "pack_current"),
        voltage_timing,
        _always,
        (
            "pack_current_gain",
            "pack_voltage_latency",
            "fast_resistance",
            "fast_cold",
            "cell_resistance_factor",
            "pack_series_resistance",
        ),
        (),
        (0.002, 0.0, 10.0),
        True,
        False,
        rough=3.0,
    ),
    Channel(
        "gps_speed",
        "m/s",
        2.0,
        1,
        ("gps_speed", "motor_speed"),
        gps_speed,
        _fast,
        (*_SPEED, "slip_per_force", "lean_radius", "gps_lag"),
        (),
        (0.1, 0.05, 30.0),
    ),
    Channel(
        "rear_speed",
        "m/s",
        2.0,
        1,
        ("wheel_speed_rear", "motor_speed"),
        rear_speed,
        _coasting,
        ("speed_sensor_scale", "rear_scale", "wheel_lag"),
        (),
        (0.02, 0.01, 30.0),
    ),
    Channel(
        "front_speed",
        "m/s",
        2.0,
        1,
        ("wheel_speed_front", "motor_speed"),
        front_speed,
        _coasting,
        ("speed_sensor_scale", "front_scale", "front_lean", "slip_per_force", "wheel_lag"),
        (),
        (0.05, 0.02, 30.0),
    ),
    Channel(
        "motor_temperature",
        "K",
        10.0,
        SLOW,
        ("motor_temperature", "ambient_temperature"),
        motor_temperature,
        _always,
        (
            "motor_start",
            "rotor_start",
            "motor_stator_share",
            "motor_gap_conductance",
            "motor_stator_capacity",
            "motor_rotor_capacity",
            "motor_rotor_to_ambient",
            "motor_airflow",
            "cooling_factor",
            "copper_speed",
        ),
        ("MOTOR_LOSS",),
        (0.4, 0.7, 200.0),
        slow=200.0,
    ),
    Channel(
        "inverter_temperature",
        "K",
        10.0,
        SLOW,
        ("inverter_temperature", "ambient_temperature"),
        inverter_temperature,
        _always,
        (
            "inverter_start",
            "box_start",
            "inverter_board_to_box",
            "inverter_box_to_ambient",
            "inverter_board_capacity",
            "inverter_box_capacity",
            "inverter_airflow",
            "cooling_factor",
        ),
        ("INVERTER_LOSS",),
        (0.4, 0.7, 200.0),
        slow=200.0,
    ),
    Channel(
        "cell_temperature",
        "K",
        10.0,
        SLOW,
        ("cell_temperature", "ambient_temperature", "pack_voltage", "pack_current"),
        cell_temperature,
        _always,
        (
            "cells_start",
            "pack_heat_capacity",
            "pack_conductance",
            "pack_airflow",
            "cooling_factor",
            "cell_resistance_factor",
            "pack_current_gain",
        ),
        ("CELL_VOLTAGE",),
        (0.3, 0.5, 300.0),
        True,
        slow=200.0,
    ),
)
BY_NAME = {channel.name: channel for channel in CHANNELS}


def depends(channel: Channel, effects: Sequence[Effect]) -> set[str]:
    """The parameters that `channel` depends on."""
    names = set(channel.parameters)
    for effect in effects:
        if effect.port.name in channel.ports and effect.name not in NOT_ROAD:
            names |= {*effect.keywords, *effect.decay_keywords}
    return names


def usable(channel: Channel, ride: Ride, system: System) -> bool:
    """Whether the ride has what `channel` needs."""
    return set(channel.roles) <= ride.have and (system.battery is not None or not channel.battery)


def support(channel: Channel, ride: Ride) -> Mask:
    """The blocks of `channel` in which everything was measured and the channel holds, shape (blocks,)."""
    good = channel.holds(ride) & ride.mask(*channel.roles)
    n = round(channel.block / STEP)
    if channel.name == "voltage_timing":
        good = good & np.roll(good, -1)
        good[-1] = False
    return np.asarray(mean_over(good.astype(float), n) > 0.99)


def blocks(channel: Channel, ride: Ride, p: Values, system: System) -> Array:
    """The residual of `channel` averaged over its blocks, shape (blocks,); masked ones too."""
    fine = channel.residual(ride, p, system)
    count = len(ride.time) // round(channel.block / STEP)
    result = mean_over(fine, round(channel.block / STEP / channel.steps))
    return np.asarray(result[:count])


def roughness(channel: Channel, ride: Ride) -> Array:
    """By how much more a block's residual scatters, shape (blocks,): where the current changes within it, small errors
    of timing and of dynamics weigh more; on a rough road the accelerometer is noisy.
    """
    n = round(channel.block / STEP)
    shaken = np.ones(len(ride.time) // n)
    if channel.shaken > 0 and "vibration" in ride.quantities:
        shaken = shaken + mean_over(ride.quantities["vibration"] ** 2, n) / channel.shaken**2
    if channel.rough <= 0:
        return np.asarray(np.sqrt(shaken))
    amperes = ride.signals["motor_current"]
    level = mean_over(np.abs(amperes), n)
    swing = np.sqrt(np.maximum(mean_over(amperes**2, n) - mean_over(amperes, n) ** 2, 0.0))
    return np.asarray(np.sqrt(shaken * (1 + ((swing + 0.2 * level) / channel.rough) ** 2)))


def over_blocks(channel: Channel, values: Array) -> Array:
    """A quantity on the grid, averaged over the blocks of `channel`."""
    return mean_over(values, round(channel.block / STEP))


__all__ = [
    "BY_NAME",
    "CHANNELS",
    "Channel",
    "System",
    "blocks",
    "depends",
    "over_blocks",
    "roughness",
    "support",
    "usable",
]
