"""How large a vehicle is over the one that the absolute numbers of calibration and discovery are for."""

from __future__ import annotations

from dataclasses import dataclass
from math import log

from gz_onboard.model.parameters import USUAL_CELLS, declared_parameters
from gz_onboard.model.riding import PriorRiding
from gz_onboard.vehicle import Vehicle


@dataclass(frozen=True)
class Sizes:
    """Of a vehicle, over what the declared priors of its parameters are of; to the nearest step, for such numbers are
    known to a factor only.

    power: and forces, by mass. current: of the motor and the pack. voltage: of the pack. auxiliary: power of it. speed:
    the highest of the usual riding; spin: of the motor at it. resistance: of a cell, which falls as its capacity grows.
    """

    power: float = 1.0
    current: float = 1.0
    voltage: float = 1.0
    auxiliary: float = 1.0
    speed: float = 1.0
    spin: float = 1.0
    resistance: float = 1.0

    def of(self, name: str) -> float:
        """The size called `name`; 1 for none."""
        return float(getattr(self, name)) if name else 1.0


USUAL_SIZES = Sizes()


def nearest_step(ratio: float, step: float = 2**0.5) -> float:
    """`ratio` as the nearest power of `step`; 1 for what has no sign or no size."""
    return float(step ** round(log(ratio) / log(step))) if ratio > 0 else 1.0


def sizes_of(vehicle: Vehicle) -> Sizes:
    """Of `vehicle`, by its file."""
    p, declared = vehicle.parameters, declared_parameters()

    def over(name: str) -> float:
        return p[name] / declared[name].prior

    fastest, usual = (max(speed for _, speed, _ in riding.points) for riding in (vehicle.riding, PriorRiding()))
    cells = vehicle.battery.cells_series if vehicle.battery else USUAL_CELLS["cells_series"]
    return Sizes(
        power=nearest_step(over("vehicle_mass")),
        current=nearest_step(over("motor_current_limit")),
        voltage=nearest_step(cells / USUAL_CELLS["cells_series"]),
        auxiliary=nearest_step(over("auxiliary_power")),
        speed=nearest_step(fastest / usual),
        spin=nearest_step(fastest / usual / (over("wheel_radius") * over("gear_ratio"))),
        resistance=nearest_step(1 / over("cell_capacity")),
    )
