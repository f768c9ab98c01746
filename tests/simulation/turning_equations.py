"""The steady turn of a leaning two-wheeler as equations for a root finder: written apart from the package.

A right turn, everything positive into the turn, z down. Unknown: yaw rate, lateral speed, handlebar, the two loads,
drive. Equations: three of force, three of moment about the centre of gravity. With `full` they have what the package's
model leaves out: the centre of gravity rides on a smaller circle than the contacts, the contacts' drag has a lever to
it, and the turning wheels are gyroscopes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import root

G = 9.80665


@dataclass
class Equilibrium:
    yaw_rate: float
    lateral: float
    handlebar: float
    load_front: float
    load_rear: float
    drive: float
    slip_front: float
    slip_rear: float
    side_front: float
    side_rear: float
    losses: float  # W: side slip and twisting


def rotation(axis: int, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


def front_wheel(handlebar: float, lean: float, caster: float) -> tuple[float, float]:
    """(steer on the ground, camber) from the wheel's axle, turned about the steering axis and rolled; z down."""
    axle = rotation(0, lean) @ rotation(1, caster) @ rotation(2, handlebar) @ np.array([0.0, 1.0, 0.0])
    return float(np.arctan2(-axle[0], axle[1])), float(np.arcsin(axle[2]))


def pacejka(p: Mapping[str, float], axle: str, slip: float, camber: float) -> float:
    stiffness, shape, peak = p[f"cornering_stiffness_{axle}"], 1.6, p["side_friction"]
    shift = p[f"camber_stiffness_{axle}"] * camber / stiffness
    return float(peak * np.sin(shape * np.arctan(stiffness / (shape * peak) * (slip + shift))))


def steady_turn(
    q: Mapping[str, float], speed: float, lean: float, *, upright: bool = False, full: bool = False
) -> Equilibrium:
    """The turn at `speed` [m/s] of a machine that leans by `lean` [rad]; `upright`: with tyres and body that do not."""
    m, p, b = q["vehicle_mass"] + q["payload_mass"], q["wheelbase"], q["cg_to_rear"]
    a, crown, spin = p - b, q["tyre_crown_radius"], q["wheel_inertia_front"] + q["wheel_inertia_rear"]
    arm = q["cg_height"] - crown
    inside, height = arm * np.sin(lean), crown + arm * np.cos(lean)
    tilt = 0.0 if upright else lean
    high = q["cg_height"] if upright else height
    radius = q["wheel_radius"] - crown * (1 - np.cos(tilt))
    drag = 0.5 * (101325 / (287.05 * 293.15)) * q["drag_area"] * speed**2

    def wheel(axle, slip, camber, along, load):
        fade = along / np.hypot(along, 0.1)
        side = load * pacejka(q, axle, slip, camber * fade)
        pressed = load * np.cos(camber) + side * np.sin(camber)
        moment = load * q["twisting_arm"] * camber * fade
        rolling = pressed * (q["rolling_resistance_constant"] * fade + q["rolling_resistance_speed"] * along)
        return side, rolling + moment * np.sin(camber) / radius, moment

    def forces(x):
        r, v, bar, front, rear, drive = x
        steer, camber = (bar, 0.0) if upright else front_wheel(bar, lean, q["caster_angle"])
        slip_f, slip_r = steer - np.arctan2(v + a * r, speed), -np.arctan2(v - b * r, speed)
        along = speed * np.cos(steer) + (v + a * r) * np.sin(steer)
        side_f, back_f, moment_f = wheel("front", slip_f, camber, along, front)
        side_r, back_r, moment_r = wheel("rear", slip_r, tilt, speed, rear)
        x_f = -side_f * np.sin(steer) - back_f * np.cos(steer)
        y_f = side_f * np.cos(steer) - back_f * np.sin(steer)
        return (x_f, y_f, moment_f), (drive - back_r, side_r, moment_r), (slip_f, slip_r, side_f, side_r, camber, along)

    def equations(x):
        r, v, _, front, rear, _ = x
        (x_f, y_f, moment_f), (x_r, y_r, moment_r), _ = forces(x)
        sideways = speed * r - full * r**2 * inside
        gyroscope = full * spin * speed / radius * r * np.cos(lean)
        return [
            (x_f + x_r - drag + m * v * r) / 100,
            (y_f + y_r - m * sideways) / 100,
            (front + rear - m * G) / 100,
            (m * G * inside - m * sideways * height - gyroscope) / 100,
            (front * a - rear * b + high * (x_f + x_r)) / 100,
            (a * y_f - b * y_r + moment_f + moment_r + full * inside * (x_f + x_r)) / 100,
        ]

    r = G * np.tan(lean) / speed
    start = [r, b * r, p * r / speed, m * G * b / p, m * G * a / p, 60.0]
    found = root(equations, start, tol=1e-13)
    assert np.max(np.abs(found.fun)) < 1e-9, found.message
    x = found.x
    front, rear, (slip_f, slip_r, side_f, side_r, camber, along) = forces(x)
    contact_f, contact_r = np.hypot(speed, x[1] + a * x[0]), np.hypot(speed, x[1] - b * x[0])
    sliding = side_f * contact_f * np.sin(slip_f) + side_r * contact_r * np.sin(slip_r)
    twisting = front[2] * (along / radius * np.sin(camber) - x[0]) + rear[2] * (speed / radius * np.sin(tilt) - x[0])
    r, v, bar, load_f, load_r, drive = map(float, x)
    return Equilibrium(r, v, bar, load_f, load_r, drive, slip_f, slip_r, side_f, side_r, sliding + twisting)
