"""What a vehicle file says of parameters before rides are seen, for calibration and discovery.

Correlations of parameters that were found together stand in the file so:

[correlation.coastdown]
parameters = ["drag_area", "rolling_resistance_constant"]
value = [[1.0, -0.86], [-0.86, 1.0]]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product
from math import log

from gz_onboard.errors import InputError, nearest, shown
from gz_onboard.model.parameters import USUAL_CELLS, Value, declared_parameters
from gz_onboard.model.riding import PriorRiding
from gz_onboard.vehicle import Vehicle

ENTERED = "as entered"
"""The status of a parameter entered with the rides, which replaces the file's."""
FAR = 4.0  # standard deviations between file and rides, beyond which they contradict each other


def correlations(vehicle: Vehicle) -> dict[frozenset[str], float]:
    """The correlations in the file of `vehicle`, by the pair of names; InputError for impossible ones."""
    import numpy as np

    found: dict[frozenset[str], float] = {}
    known, every = vehicle.parameters, vehicle.correlations  # of a calibration under way, not of its base file
    for group in every.values:
        table = every.table(group)
        table.only(["parameters", "value", "source"])
        names = table.texts("parameters", "names of parameters")
        for name in names:
            if name not in known:
                raise table.error(f"no parameter is called {shown(name)}{nearest(name, known)}", "parameters")
            if names.count(name) > 1:
                raise table.error(f"names {name!r} twice", "parameters")
        n = len(names)
        rows = table.rows("value", n, "as many as parameters", -1, 1)
        if len(rows) != n:
            raise table.error(f"must be {n} rows of {n} numbers, as many as parameters", "value")
        for (i, row), (j, column) in product(enumerate(rows), enumerate(rows)):
            if row[j] != column[i]:
                raise table.error(f"row {i + 1}, column {j + 1}: {row[j]:g} is not symmetric", "value")
        for i, row in enumerate(rows):
            if row[i] != 1:
                raise table.error(f"the diagonal must be 1, is {row[i]:g}", "value")
        found |= {frozenset((names[i], names[j])): rows[i][j] for i, j in combinations(range(n), 2)}
        if np.linalg.eigvalsh(rows)[0] < -0.0015 * (n - 1):  # rounding to two digits errs by less
            raise table.error("no parameters can have these correlations together: a variance is negative", "value")
    return found


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


def overrun(name: str, known: Value, found: tuple[float, float], far: float, pulled: str) -> str:
    """What is told of one parameter: `known` by the file, `found` (value, sd) by rides, `far` [sd] apart.

    pulled: which signals lead it there.
    """
    value, sd = found
    origin = known.status if known.status == ENTERED else f"({known.status}) by the file"
    return (
        f"{name} is {known.value:.4g} ± {known.sd:.2g} {known.unit} {origin} and {value:.4g} ± "
        f"{sd:.2g} {known.unit} by these rides, {far:.0f} standard deviations apart; {pulled}"
    )


def stop_at(overruns: Sequence[str]) -> None:
    """InputError with all of them; nothing without any."""
    if overruns:
        raise InputError(
            "; ".join(overruns) + ". Nothing is written. If these signals are poor, leave them out of [roles]; if the "
            "file only guesses, give it a larger sd"
        )
