"""The plant's equations: many rides ridden at once, a step of 20 ms, one array element for each ride.

Written apart from the package: slip of the driven wheel, leaning with a crown radius, wind as a vector with gusts,
tyres that warm up, the cells of `cells.py`, a motor whose copper loss grows with frequency and whose torque falls with
temperature, a rider with delay and an unsteady hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from tests.plant.cells import KELVIN, Cells
from tests.plant.machine import PARALLEL, SERIES, G, Machine
from tests.plant.roads import (
    BRAKE_HAND,
    DECISION,
    GRID,
    GUST_ACROSS,
    GUST_ALONG,
    LOAD,
    NOISE_STEP,
    PAD,
    SPEED_WISH,
    TREMBLE,
    Plan,
)

STEP = 0.02  # s
DELAY = 10  # steps that a rider takes to react
REST = 12.0  # s of standing before the start and, at most, after the end
DERATED = 0.3  # V of a cell above where it gives up: from there on the controller takes the current away
LEFT_AT_LEAST, TOO_SLOW, PATIENCE = (
    0.1,
    0.25,
    10.0,
)  # share of the current that stays; s below a share until the rider ends
FELT_TIME = 0.3  # s, of the controller's voltage
SPEED_LIMIT = (50.5, 54.0)  # rad/s: where the controller begins to take the torque away, and where none is left
COLUMNS = (
    "speed",
    "acceleration",
    "distance",
    "altitude",
    "grade",
    "lean",
    "lean_rate",
    "yaw_rate",
    "heading",
    "north",
    "east",
    "rear",
    "front",
    "motor_current",
    "throttle",
    "brake",
    "squeeze",
    "pack_voltage",
    "pack_current",
    "inverter_voltage",
    "inverter_current",
    "auxiliary_current",
    "soc",
    "shell",
    "stator",
    "board",
    "ambient",
    "rough",
)


@dataclass(frozen=True)
class Hidden:
    """What is wrong with a scooter: zero or one, as here, where nothing is. `cases.py` says what each stands for."""

    cornering: float = 0.0  # rad
    wind_north: float = 0.0  # m/s
    wind_east: float = 0.0
    rolling_factor: float = 1.0
    drag_factor: float = 1.0
    luggage: float = 0.0  # kg that nobody entered
    pad_force: float = 0.0  # N
    radius_factor: float = 1.0
    warm_share: float = 0.0
    warm_time: float = 600.0
    wheel_viscous: float = 0.0  # N·m·s/rad
    auxiliary: float = 0.0  # W
    copper: float = 0.0  # ohm
    torque_factor: float = 1.0
    switching: float = 0.0  # W/A
    recovery_lost: float = 0.0
    capacity_factor: float = 1.0
    resistance_factor: float = 1.0
    # one group of cells in series, beside what all have
    weak_charge: float = 0.0  # of SOC: less than the others at the start
    weak_capacity: float = 1.0
    weak_resistance: float = 1.0
    slow_resistance: float = 0.0  # ohm of a cell
    slow_time: float = 1200.0
    hysteresis: float = 0.0  # V
    hysteresis_rate: float = 30.0
    cooling_factor: float = 1.0
    # sensors
    current_offset: float = 0.0
    current_factor: float = 1.0
    voltage_offset: float = 0.0
    speed_factor: float = 1.0
    voltage_late: float = 0.0
    # what has no name
    band_force: float = 0.0  # N, about band_speed
    band_speed: float = 8.0
    hot_load: float = 0.0  # W, above hot_at degC of the motor
    hot_at: float = 40.0
    surge_loss: float = 0.0  # W per (N·m/s) of torque that changes
    window_resistance: float = 0.0  # ohm of a cell, about window_soc
    window_soc: float = 0.5
    steer_drag: float = 0.0  # N per rad of steering angle
    left_drag: float = 0.0  # N, in left bends only
    late_force: float = 0.0  # N, after late_time of riding
    late_time: float = 300.0
    rough_drag: float = 0.0  # N at 10 m/s, by the square of how rough the road is: what worn dampers take

    @property
    def weak(self) -> bool:
        """Whether one group is weaker than the others."""
        return (self.weak_charge, self.weak_capacity, self.weak_resistance) != (0.0, 1.0, 1.0)


@dataclass
class Ridden:
    """What happened: columns by name of (steps,) for one ride, and what its truths are reckoned from.

    Of a pack with a weak group `weak_group` is its voltage [V].
    """

    plan: Plan
    machine: Machine
    hidden: Hidden
    columns: dict[str, NDArray[np.float32]]
    rolling: float  # mean coefficient over the way, weighted by the work
    drag_area: float  # the same
    energy_per_metre: float  # J/m at the pack's terminals


def ride(
    plans: Sequence[Plan], machines: Sequence[Machine], hiddens: Sequence[Hidden], gives_up: float = 0.0
) -> list[Ridden]:
    """Ride them all; one array element for each.

    With `gives_up` [V at the terminals] the controller takes current away above it, and a ride ends with a second below
    it, or when the rider has had enough of creeping along. Of a pack with a weak group it is a pack of such groups
    that counts.
    """
    n = len(plans)
    m = SimpleNamespace(**{f.name: np.array([getattr(x, f.name) for x in machines]) for f in fields(Machine)})
    h = SimpleNamespace(**{f.name: np.array([float(getattr(x, f.name)) for x in hiddens]) for f in fields(Hidden)})
    own = ("ambient", "pressure", "wind_north", "wind_east", "soc", "pack_warmer", "motor_warmer", "heading")
    p = SimpleNamespace(**{name: np.array([getattr(x, name) for x in plans]) for name in own})
    rider = {
        name: np.array([getattr(x.rider, name) for x in plans])
        for name in ("mass", "acceleration", "braking", "lag", "preview")
    }
    r = SimpleNamespace(**rider)
    rows = np.arange(n)

    # the way: curvature, grade and speed on one grid, padded with its last value
    length = max(len(x.speed) for x in plans)
    way = np.zeros((n * length, 4))
    for i, x in enumerate(plans):
        for j, values in enumerate((x.curvature, x.grade, x.speed, x.rough)):
            way[i * length : (i + 1) * length, j] = np.pad(values, (0, length - len(values)), mode="edge")
    base = rows * length
    stop_count = max(len(x.stops) for x in plans)
    stops = np.full((n, stop_count + 1), 1e9)
    waits, stop_braking = np.full((n, stop_count + 1), 5.0), np.ones((n, stop_count + 1))
    for i, x in enumerate(plans):
        k = len(x.stops)
        stops[i, :k], waits[i, :k], stop_braking[i, :k] = x.stops, x.waits, x.stop_braking
    duration = np.array([x.duration for x in plans])
    steps = int(duration.max() / STEP)
    noises = np.zeros((int(duration.max() / NOISE_STEP) + 5, plans[0].noise.shape[0], n))
    for i, x in enumerate(plans):
        k = min(x.noise.shape[1], len(noises))
        noises[:k, :, i] = x.noise.T[:k]
        noises[k:, :, i] = x.noise.T[k - 1]

    record = {name: np.empty((steps, n), np.float32) for name in COLUMNS}

    # constants of the ride
    rho = p.pressure / (287.05 * (p.ambient + KELVIN))
    mass = m.mass + r.mass + h.luggage
    felt_mass = m.mass + r.mass + 0.5 * h.luggage  # a rider feels part of it
    inertia = mass + m.rotating_mass
    radius, front_radius = m.wheel_radius * h.radius_factor, m.front_radius * h.radius_factor
    drag = m.drag_area * (r.mass / 80) ** 0.3 * h.drag_factor
    wind_north, wind_east = p.wind_north + h.wind_north, p.wind_east + h.wind_east
    gust = 0.25 + 0.22 * np.hypot(wind_north, wind_east)
    limit_pack = m.pack_limit
    warm = h.cooling_factor

    # state
    v = np.zeros(n)
    s, altitude, north, east = np.zeros(n), np.full(n, 255.0), np.zeros(n), np.zeros(n)
    heading, lean, lean_rate = p.heading.copy(), np.zeros(n), np.zeros(n)
    integral, hand, throttle, squeeze, motor_current = (np.zeros(n) for _ in range(5))
    braking = np.ones(n, bool)
    waiting, wait_left, next_stop = np.ones(n, bool), np.full(n, REST), np.zeros(n, int)
    tyre, moved = p.ambient.copy(), np.zeros(n)
    cells = Cells(m, h, p.soc.copy(), STEP)
    weak, is_weak = None, np.array([x.weak for x in hiddens])
    if is_weak.any():
        more = {"capacity_factor": h.weak_capacity, "resistance_factor": h.weak_resistance}
        own_faults = SimpleNamespace(**{**vars(h), **{name: getattr(h, name) * x for name, x in more.items()}})
        weak = Cells(m, own_faults, p.soc - h.weak_charge, STEP)
        record["weak_group"] = np.empty((steps, n), np.float32)
    core = shell = p.ambient + p.pack_warmer
    stator = rotor = p.ambient + p.motor_warmer
    board = box = p.ambient + 0.5 * p.motor_warmer
    pack_current, pack_voltage, torque_before = np.full(n, 1.0), np.full(n, 50.0), np.zeros(n)
    lowest = pack_voltage  # V, of a pack of the weakest groups
    targets = np.zeros((DELAY, n))
    roll_work, drag_work, load_way, drag_way = (np.zeros(n) for _ in range(4))
    energy, energy_way = np.zeros(n), np.zeros(n)

    last, low_for, creeps_for = np.array([int(x.duration / STEP) for x in plans]), np.zeros(n), np.zeros(n)
    felt, share = np.full(n, 60.0), np.ones(n)
    for step in range(steps):
        if np.all(step >= last):
            break
        time = step * STEP
        noise = noises[int(time / NOISE_STEP)]
        # --- road under the wheels, and where the rider looks
        place = s / GRID
        index = np.minimum(place.astype(int), length - 2)
        part = (place - index)[:, None]
        here = way[base + index] * (1 - part) + way[base + index + 1] * part
        curvature, grade, allowed, rough = here.T
        ahead = np.minimum(((s + v * r.preview) / GRID).astype(int), length - 1)
        allowed = np.minimum(allowed, way[base + ahead, 2])
        to_stop = stops[rows, next_stop] - s
        wish = allowed * (1 + 0.025 * noise[SPEED_WISH])
        comfort = r.braking * stop_braking[rows, next_stop]
        over = time > duration - REST - 14  # comes to rest at the end
        to_stop = np.where(over, np.minimum(to_stop, 25.0), to_stop)
        wish = np.minimum(wish, np.sqrt(2 * 0.9 * comfort * np.maximum(to_stop - 0.5, 0.02)))
        wish = np.where(over, np.minimum(wish, np.maximum(v - 1.0, 0.0)), wish)
        # --- waiting
        arrived = ~waiting & (v < 0.12) & ((to_stop < 4.0) | over)
        wait_left = np.where(arrived, np.where(over, 1e9, waits[rows, next_stop]), wait_left)
        waiting |= arrived
        leaving = waiting & (wait_left <= 0)
        next_stop = np.where(leaving & (time > REST + 1), np.minimum(next_stop + 1, stop_count), next_stop)
        waiting &= ~leaving
        wait_left = wait_left - STEP
        # --- rider: sees with delay, decides now and then, moves the hand
        slot = step % DELAY
        late = targets[slot].copy()
        targets[slot] = np.where(waiting | (to_stop < 2.0), -1.0, wish - v)
        asked = np.clip(late / 1.1, -1.15 * comfort, r.acceleration)
        braking = np.where(braking, (asked < -0.15) | waiting, (asked < -0.65) | waiting)
        riding = ~waiting & ~braking
        guess = 0.0145 * felt_mass * G + 0.35 * v * v
        force_wish = felt_mass * asked + guess + integral
        u = np.clip(force_wish * radius / (0.456 * m.current_limit), 0.0, 0.97)
        free = riding & (u > 0.0) & (np.abs(late) < 1.2)
        integral = np.clip(integral + STEP * 9.0 * np.where(free, late, 0.0), -60.0, 160.0)
        moves = (noise[DECISION] < 0.55) | (np.abs(u - hand) > 0.10)
        if step % 10 == 0:
            hand = np.where(moves, u + 0.006 * noise[TREMBLE], hand)
        hand = np.where(riding, hand, 0.0)
        throttle = throttle + STEP / r.lag * (np.clip(hand, 0, 1) - throttle)
        throttle = np.where(throttle < 0.002, 0.0, throttle)
        # --- controller and motor current
        rear = v * (1.0 + 0.0) / radius
        limit = m.current_limit * np.clip((SPEED_LIMIT[1] - rear) / (SPEED_LIMIT[1] - SPEED_LIMIT[0]), 0, 1)
        limit = np.minimum(limit, limit_pack * pack_voltage / (0.456 * rear + 6.0))
        command = np.where(braking, -m.regeneration_current * np.clip(rear / 7.5, 0, 1), throttle * m.current_limit)
        if gives_up:
            felt = felt + STEP / FELT_TIME * (lowest - felt)
            share = np.clip((felt - gives_up) / (DERATED * SERIES), LEFT_AT_LEAST, 1.0)
            limit = limit * share
        command = np.where(step < last, command, 0.0)  # a pack that gave up
        motor_current = motor_current + STEP / 0.06 * (np.minimum(command, limit) - motor_current)
        # --- brakes
        regen_brake = 0.456 * m.regeneration_current / radius / inertia * np.clip(rear / 7.5, 0, 1)
        need = np.where(braking, np.maximum(-asked - 0.25 - regen_brake, 0.0), 0.0) * (1 + 0.15 * noise[BRAKE_HAND])
        need = np.where(waiting, 1.3 + 0.2 * noise[BRAKE_HAND], need)
        squeeze = squeeze + STEP / 0.18 * (np.maximum(need, 0.0) - squeeze)
        # --- lean and turning
        lateral = v * v * curvature
        ideal = np.arctan(lateral / G)
        leaning = ideal + np.arcsin(m.crown_radius * np.sin(ideal) / (m.cg_height - m.crown_radius))
        acceleration_lean = 18.0 * (-leaning - lean) - 7.5 * lean_rate
        lean_rate = lean_rate + STEP * acceleration_lean
        lean = lean + STEP * lean_rate
        slope_cosine = np.sqrt(1 - grade * grade)
        load = mass * np.sqrt((G * slope_cosine) ** 2 + lateral * lateral)
        side = mass * lateral
        slip_angle = (side / load - m.camber_stiffness * np.tan(leaning) * 0.97) / m.cornering_stiffness
        turning = np.abs(side * slip_angle) + m.camber_rolling * load * lean * lean
        turning = turning + h.cornering * mass * lateral * lateral / G
        # --- wind on the way
        ch, sh = np.cos(heading), np.sin(heading)
        along = wind_north * ch + wind_east * sh + gust * noise[GUST_ALONG]
        across = -wind_north * sh + wind_east * ch + gust * noise[GUST_ACROSS]
        flow = v + along
        stream = np.sqrt(flow * flow + across * across)
        yaw = np.abs(across) / (stream + 0.5)
        area = drag * (1 + m.drag_yaw * yaw * yaw)
        air = 0.5 * rho * area * stream * flow
        # --- tyres
        cold = 1 + m.rolling_temperature * (25.0 - tyre)
        coefficient = m.rolling * cold * (1 + m.rolling_speed * v * v) * h.rolling_factor
        coefficient = coefficient + m.rolling * h.warm_share * np.exp(-moved / h.warm_time)
        steering = np.abs(curvature) * 1.32
        moving = v / np.sqrt(v * v + 0.01)
        rolling = coefficient * load
        extra = m.bearing_drag + h.pad_force * (1 + 0.1 * noise[PAD]) + h.wheel_viscous * v / radius**2
        extra = extra + h.band_force * np.exp(-0.5 * ((v - h.band_speed) / 1.0) ** 2)
        extra = extra + h.steer_drag * steering + h.left_drag * np.clip(curvature * 60, 0, 1)
        extra = extra + h.late_force * (moved > h.late_time) + h.rough_drag * rough * rough * v / 10
        road = (rolling + turning + extra) * moving + air
        # --- motor
        hot = 1 - m.torque_temperature * (stator - 40)
        saturation = 1 - m.torque_saturation * (motor_current / 200) ** 2
        constant = m.torque_constant * h.torque_factor * hot * saturation
        tread = constant * motor_current / radius  # before iron loss
        slip = tread / (m.slip_stiffness * 0.57 * load)
        rear = v * (1 + slip) / (radius - m.crown_radius * (1 - np.cos(lean)))
        front = v / (front_radius - m.crown_radius * (1 - np.cos(lean)))
        iron = (m.hysteresis_loss + m.eddy_loss * rear + m.excess_loss * np.sqrt(rear)) * rear
        shaft = constant * motor_current - iron / (rear + 0.05)
        heat_factor = 1 + 0.00393 * (stator - 25)
        resistance = (m.copper + h.copper) * heat_factor * (1 + m.copper_frequency * (rear / 57) ** 2)
        copper = resistance * motor_current**2
        mechanical = shaft * rear
        lost_recovery = h.recovery_lost * np.maximum(-mechanical, 0.0)
        # --- inverter and load
        amount = np.abs(motor_current)
        inverter = m.inverter_idle + (m.inverter_switching * np.sqrt(pack_voltage / 50) + h.switching) * amount
        inverter = inverter + m.inverter_conduction * (1 + 0.003 * (board - 25)) * motor_current**2 + lost_recovery
        torque = constant * motor_current
        surge = h.surge_loss * np.abs(torque - torque_before) / STEP
        torque_before = torque
        dc = mechanical + copper + iron + inverter + surge
        auxiliary = m.auxiliary + m.brake_light * braking + 1.5 * noise[LOAD] + h.auxiliary
        unseen = h.hot_load / (1 + np.exp(-(stator - h.hot_at) / 0.7))
        # --- cell
        one, instant = cells.source(core)
        emf = SERIES * one
        inside = SERIES * instant / PARALLEL + m.series_resistance
        if weak:
            other, other_instant = weak.source(core)
            emf = np.where(is_weak, (SERIES - 1) * one + other, emf)
            both = ((SERIES - 1) * instant + other_instant) / PARALLEL + m.series_resistance
            inside = np.where(is_weak, both, inside)
        inverter_now = pack_current - auxiliary / pack_voltage
        power = dc + auxiliary + unseen + m.cable * inverter_now * inverter_now
        pack_current = 2 * power / (emf + np.sqrt(np.maximum(emf * emf - 4 * inside * power, 1.0)))
        pack_voltage = emf - inside * pack_current
        cell_current = pack_current / PARALLEL
        # --- heat
        blow = 0.55 + 0.07 * v
        heat = SERIES * PARALLEL * cells.flow(cell_current, core) * cell_current
        lowest = pack_voltage
        if weak:
            group = other - other_instant * cell_current
            lowest = np.where(is_weak, np.minimum(SERIES * group, pack_voltage), pack_voltage)
            record["weak_group"][step] = group
            weak.flow(cell_current, core)
        soc = cells.soc
        heat = heat + SERIES * PARALLEL * cell_current * (core + KELVIN) * 0.00008 * np.sin(5 * soc)
        flow_heat = m.core_to_shell * (core - shell)
        core = core + STEP * (heat - flow_heat) / m.core_capacity
        shell = (
            shell
            + STEP
            * (
                flow_heat
                + m.series_resistance * 0.3 * pack_current**2
                - m.shell_to_air * warm * blow * (shell - p.ambient)
            )
            / m.shell_capacity
        )
        gap = m.stator_to_rotor * (stator - rotor)
        stator = stator + STEP * (copper + 0.85 * iron - gap) / m.stator_capacity
        rotor = rotor + STEP * (0.15 * iron + gap - m.rotor_to_air * warm * 2 * blow * (rotor - p.ambient)) / (
            m.rotor_capacity
        )
        through = m.board_to_box * (board - box)
        board = board + STEP * (inverter - through) / m.board_capacity
        box = box + STEP * (through - m.box_to_air * warm * 2 * blow * (box - p.ambient)) / m.box_capacity
        tyre = tyre + STEP / m.tyre_time * (p.ambient + m.tyre_heating * v - tyre)
        # --- motion
        friction = mass * squeeze
        force = (constant * motor_current - iron / (rear + 0.05) * moving) / radius - road - mass * G * grade
        before = v
        v = np.maximum(v + STEP * (force - friction * moving) / inertia, 0.0)
        v = np.where(waiting & (v < 0.15), 0.0, v)
        acceleration = (v - before) / STEP
        way_now = STEP * 0.5 * (v + before)
        s = s + way_now
        climb = grade * way_now
        altitude = altitude + climb
        yaw_rate = v * curvature
        heading = heading - STEP * yaw_rate
        north, east = north + way_now * ch, east + way_now * sh
        moved = moved + STEP * (v > 0.5)
        roll_work += coefficient * load * way_now
        load_way += load * way_now
        flow_way = 0.5 * rho * stream * flow * way_now
        drag_work += area * flow_way
        drag_way += flow_way
        live = time < duration
        energy += np.where(live, pack_voltage * pack_current * STEP, 0.0)
        energy_way += np.where(live, way_now, 0.0)
        # --- kept
        inverter_voltage = pack_voltage - m.cable * inverter_now
        now = (
            v,
            acceleration,
            s,
            altitude,
            grade,
            lean,
            lean_rate,
            yaw_rate,
            heading,
            north,
            east,
            rear,
            front,
            motor_current,
            throttle,
            braking,
            squeeze,
            pack_voltage,
            pack_current,
            inverter_voltage,
            dc / inverter_voltage,
            auxiliary / pack_voltage,
            soc,
            shell,
            stator,
            board,
            p.ambient,
            rough,
        )
        for name, value in zip(COLUMNS, now, strict=True):
            record[name][step] = value
        low_for = np.where(lowest < gives_up, low_for + STEP, 0.0)
        creeps_for = np.where(share < TOO_SLOW, creeps_for + STEP, 0.0)
        last = np.where((low_for >= 1.0) | (creeps_for >= PATIENCE), np.minimum(last, step + 1), last)

    out = []
    for i in range(n):
        count = int(last[i])
        kept = [name for name in record if name in COLUMNS or hiddens[i].weak]
        columns = {name: np.ascontiguousarray(record[name][:count, i]) for name in kept}
        out.append(
            Ridden(
                plans[i],
                machines[i],
                hiddens[i],
                columns,
                float(roll_work[i] / max(load_way[i], 1.0)),
                float(drag_work[i] / drag_way[i]) if abs(drag_way[i]) > 1 else float(drag[i]),
                float(energy[i] / max(energy_way[i], 1.0)),
            )
        )
    return out
