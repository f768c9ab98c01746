"""The temperatures of the model's own cooling networks over a run, stepped at its period.

Parameters go by their names in the vehicle file, and ``room`` for the conductance of a closed room.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.lab.calibrate.cooling_run import CoolingRun
from gz_onboard.physics.cooling import PERIOD, InverterCooling, LumpedCooling, MotorCooling, temperatures

Values = Mapping[str, float]
Model = Callable[[Values, CoolingRun], dict[str, Array]]
"""The temperatures [degC] of a network over a run, by sensor, each of shape (n,)."""


def motor_temperatures(p: Values, run: CoolingRun) -> dict[str, Array]:
    """Of the stator. The rotor has no sensor and starts as warm as the stator.

    ``iron_share``: of the iron loss in the stator, if it has one of its own.
    """
    stator = _first(p, run, "motor_temperature")
    share, iron_share = p["motor_stator_share"], p.get("iron_share")
    network = MotorCooling.of({**p, "motor_rotor_to_ambient": 1.0}, stator)
    shares = np.full_like(run.time, share)
    if iron_share is not None:
        fraction = run.iron / np.where(np.abs(run.motor_heat) > 1.0, run.motor_heat, np.inf)
        shares = share + (iron_share - share) * fraction
    outside = _outside(p, run, "motor_rotor_to_ambient")
    result = np.empty_like(run.time)
    rows = zip(run.motor_heat.tolist(), run.ambient.tolist(), shares.tolist(), outside.tolist(), strict=True)
    for k, (heat, ambient, network.stator_share, conductance) in enumerate(rows):
        result[k] = network.stator
        network.step(PERIOD, heat, ambient, conductance)
    return {"motor_temperature": result}


def inverter_temperatures(p: Values, run: CoolingRun) -> dict[str, Array]:
    """Of board and box; without a sensor on it the box starts as warm as the board."""
    board = _first(p, run, "inverter_temperature")
    box = _first(
        p, run, "inverter_box_temperature" if "inverter_box_temperature" in run.measured else "inverter_temperature"
    )
    network = InverterCooling.of({**p, "inverter_box_to_ambient": 1.0}, board, box)
    outside = _outside(p, run, "inverter_box_to_ambient")
    result = np.empty((2, len(run.time)))
    rows = zip(run.inverter_heat.tolist(), run.ambient.tolist(), outside.tolist(), strict=True)
    for k, (heat, ambient, conductance) in enumerate(rows):
        result[:, k] = network.board, network.box
        network.step(PERIOD, heat, ambient, conductance)
    return {"inverter_temperature": result[0], "inverter_box_temperature": result[1]}


def pack_temperatures(p: Values, run: CoolingRun) -> dict[str, Array]:
    """Of the cells."""
    start = _first(p, run, "cell_temperature")
    return {"cell_temperature": _lumped(LumpedCooling.of(p, "pack", start), run.pack_heat, run.ambient)}


def bms_temperatures(p: Values, run: CoolingRun) -> dict[str, Array]:
    """Of the BMS, over the pack's temperature as measured."""
    start = _first(p, run, "bms_temperature")
    heat, cells = p["bms_resistance"] * run.pack_square, run.measured["cell_temperature"]
    return {"bms_temperature": _lumped(LumpedCooling.of(p, "bms", start), heat, cells)}


def _first(p: Values, run: CoolingRun, sensor: str) -> float:
    """Where the node of `sensor` starts [degC]: on a line through the sensor's first ten seconds, as a board warms
    fast. ``start:RUN:SENSOR`` is what is added to that."""
    first = run.measured[sensor][:10]
    line = np.polyfit(np.arange(len(first)) * PERIOD, first, 1)
    return float(line[1]) + p.get(f"start:{run.name}:{sensor}", 0.0)


def _lumped(network: LumpedCooling, heat: Array, ambient: Array) -> Array:
    return np.array(temperatures(network, PERIOD, heat.tolist(), ambient.tolist()))


def _outside(p: Values, run: CoolingRun, name: str) -> Array:
    """The conductance to the ambient [W/K], shape (n,)."""
    if run.still and "room" in p:
        return np.full_like(run.time, p["room"])
    return np.asarray(np.full_like(run.time, p[name]) + p.get("per_speed", 0.0) * run.speed)
