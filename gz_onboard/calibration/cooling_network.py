"""The temperatures of the model's own cooling networks over a run, stepped at its period.

Parameters go by their names in the vehicle file, and ``entropy_SOC`` for the change of a cell's open-circuit voltage
with temperature at each of `ENTROPY_SOC`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.calibration.cooling_run import CoolingRun
from gz_onboard.model.battery import reversible_heat
from gz_onboard.offline.cooling import PERIOD, InverterCooling, LumpedCooling, MotorCooling, temperatures

Values = Mapping[str, float]
Model = Callable[[Values, CoolingRun], dict[str, Array]]
"""The temperatures [degC] of a network over a run, by sensor, each of shape (n,)."""
ENTROPY_SOC = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 1.0)
"""Where the entropy is sought: as fine as rides of a tenth of the charge tell; it is held below and above."""
ENTROPY = tuple(f"entropy_{soc:g}" for soc in ENTROPY_SOC)


def motor_temperatures(p: Values, run: CoolingRun) -> dict[str, Array]:
    """Of the stator. The rotor has no sensor and starts as warm as the stator."""
    start = _first(p, run, "motor_temperature")
    network = MotorCooling(p, start, start)
    columns = run.motor_heat, run.ambient, run.air, np.ones_like(run.air), run.iron
    return {"motor_temperature": np.array(temperatures(network, PERIOD, *columns))}


def inverter_temperatures(p: Values, run: CoolingRun) -> dict[str, Array]:
    """Of board and box; without a sensor on it the box starts as warm as the board."""
    board = _first(p, run, "inverter_temperature")
    box = _first(
        p, run, "inverter_box_temperature" if "inverter_box_temperature" in run.measured else "inverter_temperature"
    )
    network = InverterCooling(p, board, box)
    result = np.empty((2, len(run.time)))
    rows = zip(run.inverter_heat.tolist(), run.ambient.tolist(), run.air.tolist(), strict=True)
    for k, (heat, ambient, air) in enumerate(rows):
        result[:, k] = network.board, network.box
        network.step(PERIOD, heat, ambient, air)
    return {"inverter_temperature": result[0], "inverter_box_temperature": result[1]}


def pack_temperatures(p: Values, run: CoolingRun) -> dict[str, Array]:
    """Of the cells."""
    entropy = np.interp(run.soc, ENTROPY_SOC, [p.get(name, 0.0) for name in ENTROPY])
    cells = run.measured["cell_temperature"]
    heat = run.pack_heat + reversible_heat(entropy, run.series_current, cells)
    network = LumpedCooling(p, "pack", _first(p, run, "cell_temperature"))
    return {"cell_temperature": np.array(temperatures(network, PERIOD, heat, run.ambient))}


def bms_temperatures(p: Values, run: CoolingRun) -> dict[str, Array]:
    """Of the BMS, over the pack's temperature as measured."""
    network = LumpedCooling(p, "bms", _first(p, run, "bms_temperature"))
    heat, cells = p["bms_resistance"] * run.pack_square, run.measured["cell_temperature"]
    return {"bms_temperature": np.array(temperatures(network, PERIOD, heat, cells))}


def _first(p: Values, run: CoolingRun, sensor: str) -> float:
    """Where the node of `sensor` starts [degC]: on a line through the sensor's first ten seconds, as a board warms
    fast. ``start:RUN:SENSOR`` is what is added to that."""
    first = run.measured[sensor][:10]
    line = np.polyfit(np.arange(len(first)) * PERIOD, first, 1)
    return float(line[1]) + p.get(f"start:{run.name}:{sensor}", 0.0)
