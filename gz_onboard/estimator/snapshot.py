"""What is kept over a restart, and whether what was kept can be gone on from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import inf
from typing import Any

from gz_onboard.estimator.ageing import Ageing
from gz_onboard.estimator.cell_effects import CellEffects
from gz_onboard.estimator.road import MOST_BIAS
from gz_onboard.estimator.road_load import RoadLoad
from gz_onboard.estimator.start import Saved
from gz_onboard.estimator.weakest import Weakest

VERSION = (
    3  # 2: the states of effects with memory; 3: odometer, own SOC and consumption, for the charge that flows uncounted
)
MOST = {"current": 1e4, "odometer": 1e10, "own_soc": 1.1, "consumption": 1e5}  # A, m, 1, J/m
SOC = -0.1, 1.1
V1 = 1.0  # V of a cell
CELLS = -50.0, 120.0  # degC
CELLS_KEEP = 3600.0  # s: for so long the cells' temperature is known


@dataclass(frozen=True)
class Restored:
    """The contents of a snapshot, checked."""

    battery: Saved
    age: float | None  # s; None: not known
    gyro_bias: tuple[float, float]  # rad/s, of roll and yaw rate
    cell_effects: dict[str, float]  # V of a cell, by name
    cell_temperature: float | None  # degC; None if it is too old


def read(
    saved: Mapping[str, Any],
    key: str,
    age: float | None,
    effects: CellEffects,
    learning: tuple[Ageing, RoadLoad, Weakest],
    restore_riding: Callable[[Mapping[str, Any]], None],
) -> Restored:
    """The snapshot `saved`, `age` [s] old, of the vehicle `key`; the riding, and what was learned of the
    pack's age and of the road load, are restored if the rest fits.

    ValueError if it does not fit, whole.
    """
    if age is not None and not 0 <= age < inf:
        age = None
    if not isinstance(saved, Mapping) or saved.get("version") != VERSION:
        raise ValueError(f"is of version {saved.get('version') if isinstance(saved, Mapping) else saved!r}")
    if saved.get("key") != key:
        raise ValueError(f"is of {saved.get('key')!r}, this is {key!r}")
    try:
        battery = _battery(saved)
        bias_x, bias_z = (float(x) for x in saved["gyro_bias"])
        if not (abs(bias_x) < MOST_BIAS and abs(bias_z) < MOST_BIAS):
            raise ValueError("holds implausible numbers")
        states = effects.read(saved["cell_effects"])
        learned = saved.get("learned", {})  # states from before there was any have none
        ageing, road_load, weakest = learning
        ageing.read(learned)
        on_road, of_group = road_load.read(learned.get("road")), weakest.read(learned.get("weakest"))
        restore_riding(saved["riding"])
        ageing.restore(learned)
        road_load.take(on_road)
        weakest.take_on(of_group)
    except (KeyError, TypeError, AttributeError, OverflowError) as error:
        raise ValueError(f"is damaged: {error!r}") from error
    cells = saved.get("cell_temperature")
    if not isinstance(cells, int | float) or not CELLS[0] < cells < CELLS[1] or age is None or age >= CELLS_KEEP:
        cells = None
    return Restored(battery, age, (bias_x, bias_z), states, None if cells is None else float(cells))


def of_learned(ageing: Ageing, road_load: RoadLoad, weakest: Weakest) -> dict[str, Any]:
    """What was learned of the vehicle, by name; of the weakest group only where its voltage is on the bus."""
    of_group = {"weakest": weakest.snapshot()} if weakest.mapped else {}
    return {**ageing.snapshot(), "road": road_load.snapshot(), **of_group}


def _battery(saved: Mapping[str, Any]) -> Saved:
    soc, v1 = float(saved["soc"]), float(saved["v1"])
    p00, p01, p11 = (float(x) for x in saved["covariance"])
    possible = SOC[0] < soc < SOC[1] and abs(v1) < V1 and 0 < p00 < 1 and 0 < p11 < 1 and p01 * p01 <= p00 * p11
    if not possible:
        raise ValueError("holds implausible numbers")
    return Saved(soc, v1, (p00, p01, p11), **{name: _optional(saved[name], most) for name, most in MOST.items()})


def _optional(value: object, most: float) -> float | None:
    """A saved number, in size at most `most`, or None. ValueError, TypeError if it is neither."""
    if value is None:
        return None
    number = float(value)  # type: ignore[arg-type]
    if not abs(number) <= most:
        raise ValueError("holds implausible numbers")
    return number
