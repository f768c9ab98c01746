"""Bench data with planted parameters, and tables as they would be read from files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gz_onboard.calibration.table import Measurements


def table(**columns) -> Measurements:
    return Measurements(
        Path("planted.csv"), {name: np.asarray(column, dtype=float) for name, column in columns.items()}
    )


def changed(of: Measurements, **columns) -> Measurements:
    return Measurements(of.file, {**of.columns, **columns})


def without(of: Measurements, *names: str) -> Measurements:
    return Measurements(of.file, {name: column for name, column in of.columns.items() if name not in names})


MOTOR = {
    "torque_constant": 0.45,
    "motor_copper_resistance": 0.017,
    "motor_iron_linear": 0.9,
    "motor_iron_quadratic": 0.015,
}
INVERTER = {"inverter_loss_constant": 6.0, "inverter_loss_linear": 0.38, "inverter_loss_quadratic": 0.0024}


def dyno(seed: int, noise: float = 1.0, saturation: float = 0.0) -> Measurements:
    """A grid of speed and current on a motor dynamometer; noise: 1 is 0.3 N·m, 0.2 % and 1 W."""
    rng = np.random.default_rng(seed)
    speed, current = (a.ravel() for a in np.meshgrid(np.linspace(3, 57, 13), np.linspace(-110, 200, 14)))
    warm = rng.uniform(30, 80, len(speed))
    torque = MOTOR["torque_constant"] * current - saturation * current**3
    torque -= MOTOR["motor_iron_linear"] + MOTOR["motor_iron_quadratic"] * speed
    loss = MOTOR["motor_copper_resistance"] * (1 + 0.00393 * (warm - 25)) * current**2
    loss += MOTOR["motor_iron_linear"] * speed + MOTOR["motor_iron_quadratic"] * speed**2
    ac = torque * speed + loss
    dc = ac + 6.0 + 0.38 * np.abs(current) + 0.0024 * current**2

    def noisy(x, sd):
        return x + noise * sd * rng.normal(size=len(x))

    return table(
        motor_speed=speed,
        motor_current=current,
        shaft_torque=noisy(torque, 0.3),
        mechanical_power=noisy(torque * speed, 0.3 * speed),
        ac_power=noisy(ac, 1.0),
        dc_power=noisy(dc, 1.0 + 1e-3 * np.abs(dc)),
        motor_temperature=warm,
    )
