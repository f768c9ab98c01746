"""Rides with planted resistances and sensor errors, of bursts, braking and rest."""

from __future__ import annotations

import numpy as np

from gz_onboard.recording.recording import Recording
from gz_onboard.vehicle import read_vehicle

VEHICLE = read_vehicle("reference")
UNLIT, LIT = 44.0, 48.0  # W
GAIN, OFFSET, CURRENT_NOISE, VOLTAGE_NOISE = 1.01, 0.05, 0.06, 0.01
CABLE, SERIES = 0.009, 0.006  # ohm
VOLTS_APART = 0.03
CELL_STEP = 0.04  # ohm of a cell, at once


def ride(
    seed: int,
    *,
    drop=(),
    auxiliary_sign=1.0,
    seconds=400,
    temperature=25.0,
    cell=CELL_STEP,
    calm=False,
    inverter_gain=1.0,
    own_loss=1.0,
    series=SERIES,
    voltage_gains=(1.0, 1.0),
    drift=0.0,
) -> Recording:
    """10 Hz: current in steps of 5 s, every third at rest with the brake on; all sensors noisy.

    inverter_gain, auxiliary_sign: what those current sensors make of a current. own_loss: of the inverter at rest, as a
    share of what the vehicle file says. voltage_gains: what the sensors of pack and inverter make of a volt.
    drift: of the zero of the pack's current sensor [A].
    """
    rng = np.random.default_rng(seed)
    time = np.arange(0, seconds, 0.1)
    steps = seconds // 5
    level = rng.uniform(-10, 80, steps) * (0.02 if calm else 1.0)
    rest = np.arange(steps) % 3 == 0
    load = np.repeat(np.where(rest, 0.0, level), 50)
    brake = np.repeat((rest & (rng.random(steps) < 0.8)).astype(float), 50)
    source, power = 54.0, np.where(brake > 0, LIT, UNLIT)
    own = own_loss * VEHICLE.parameters["inverter_loss_constant"] / source
    current = load + power / source + own
    inside = 14 / 12 * cell + series
    voltage = source - inside * current
    columns = {
        "pack_current": GAIN * current + OFFSET + drift + CURRENT_NOISE * rng.normal(size=len(time)),
        "pack_voltage": voltage_gains[0] * voltage + VOLTS_APART + VOLTAGE_NOISE * rng.normal(size=len(time)),
        "inverter_current": inverter_gain * load + 0.3 * rng.normal(size=len(time)),
        "inverter_voltage": voltage_gains[1] * (voltage - CABLE * load) + 0.04 * rng.normal(size=len(time)),
        "auxiliary_current": auxiliary_sign * power / voltage + 0.01 * rng.normal(size=len(time)),
        "motor_speed": np.where(load == 0, 0.0, 30.0),
        "motor_current": 1.5 * load,
        "brake_switch": brake,
        "cell_temperature": np.full(len(time), temperature),
    }
    return Recording(f"ride_{seed}", {role: (time, values) for role, values in columns.items() if role not in drop})


def gps_ride(
    radius: float, seed: int, lag: float = 0.4, minutes: float = 10, top: float = 12.0, bias: float = 0.0
) -> Recording:
    """Stop and go with cruising between; the receiver reports `lag` [s] late, with noise."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, 60 * minutes, 0.05)
    target = np.repeat(rng.choice([0.0, 0.6, 0.8, 1.0], size=int(minutes * 2) + 1) * top, 600)[: len(time)]
    speed = np.empty_like(time)
    v = 0.0
    for k, wanted in enumerate(target):
        v += float(np.clip((wanted - v) / 1.0, -1.5, 1.2)) * 0.05
        speed[k] = v
    fixes = np.arange(2.0, time[-1], 0.2)
    gps = np.interp(fixes - lag, time, speed) * (1 + bias) + rng.normal(0, 0.05, len(fixes))
    return Recording(f"ride_{seed}", {"motor_speed": (time, speed / radius), "gps_speed": (fixes, gps)})
