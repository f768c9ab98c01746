"""Sweeps of design parameters: consumption and range of the same ride with other values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

from gz_onboard.errors import InputError, closest
from gz_onboard.model.parameters import declared_parameters
from gz_onboard.vehicle import Vehicle

CELLS = ("battery.cells_parallel", "battery.cells_series")
_SHORT = {"battery.parallel": CELLS[0], "battery.series": CELLS[1]}
_STEPS = 5
_MOST_STEPS = 50


@dataclass(frozen=True)
class Sweep:
    """The values that one design parameter takes."""

    name: str
    unit: str
    values: tuple[float, ...]

    @property
    def label(self) -> str:
        """For a table or an axis."""
        return self.name if self.unit == "1" else f"{self.name} [{self.unit}]"


def read_sweep(text: str, vehicle: Vehicle) -> Sweep:
    """``NAME=LO..HI[:STEPS]``: a parameter of `vehicle` by name, or a number of cells.

    Without STEPS five values; of cells every number, up to nine. InputError for an unknown name (with the nearest),
    a value out of the parameter's bounds (with its unit), and any other form.
    """
    name, _, rest = text.partition("=")
    span, _, steps = rest.partition(":")
    try:
        low, high = map(float, span.split("..", 1))
        wanted = int(steps) if steps else None
    except ValueError:
        form = "must be NAME=LOW..HIGH or NAME=LOW..HIGH:STEPS, as in drag_area=0.4..0.6:5"
        raise InputError(f"--sweep {text}: {form}") from None
    found = sweep_of(name.strip(), (low, high), vehicle, f"--sweep {text}")
    if not low < high:
        raise InputError(f"--sweep {text}: {low:g} is not below {high:g}")
    of_cells = found.name in CELLS
    count = wanted if wanted is not None else min(round(high - low) + 1, 9) if of_cells else _STEPS
    if not 2 <= count <= _MOST_STEPS:
        raise InputError(f"--sweep {text}: {count} steps; must be 2 to {_MOST_STEPS}")
    values = [low + (high - low) * i / (count - 1) for i in range(count)]
    if of_cells:
        values = sorted({float(round(value)) for value in values})
    return replace(found, values=tuple(values))


def sweep_of(name: str, values: Sequence[float], vehicle: Vehicle, place: str) -> Sweep:
    """`values` of a parameter of `vehicle` by name, or of a number of cells; place: what an error begins with.

    InputError for an unknown name (with the nearest) and a value out of the parameter's bounds (with its unit).
    """
    name = _SHORT.get(name, name)
    declared = declared_parameters(vehicle.model.effects)
    if name not in (*declared, *CELLS):
        known = {each.rpartition(".")[2]: each for each in (*declared, *CELLS)}
        near = closest(name.rpartition(".")[2].lower(), known)
        hint = f" (did you mean {known[near]!r}?)" if near else ""
        raise InputError(f"{place}: no parameter is called {name!r}{hint}")
    low, high, unit = (1.0, 1000.0, "1")
    if name in declared:
        low, high, unit = declared[name].low, declared[name].high, declared[name].unit
    for value in values:
        if not low <= value <= high:
            raise InputError(f"{place}: {name} of {value:g} {unit} is outside {low:g} to {high:g} {unit}")
        if name in CELLS and value != round(value):
            raise InputError(f"{place}: {name} counts cells; {value:g} is not a whole number")
    return Sweep(name, unit, tuple(map(float, values)))


def redesigned(vehicle: Vehicle, values: Mapping[str, float]) -> Vehicle:
    """`vehicle` with other values of parameters and numbers of cells.

    More or fewer cells change the mass of the vehicle and the heat capacity of its pack in proportion.
    """
    battery = vehicle.battery
    changed = {name: value for name, value in values.items() if name not in CELLS}
    parameters = vehicle.parameters
    if battery and set(values) & set(CELLS):
        cells = battery.cells_series * battery.cells_parallel
        battery = replace(
            battery,
            cells_parallel=round(values.get(CELLS[0], battery.cells_parallel)),
            cells_series=round(values.get(CELLS[1], battery.cells_series)),
        )
        added = battery.cells_series * battery.cells_parallel - cells
        parameters = parameters.replaced(
            vehicle_mass=parameters["vehicle_mass"] + added * parameters["cell_mass"],
            pack_heat_capacity=parameters["pack_heat_capacity"] * (1 + added / cells),
        )
    parameters = parameters.replaced(**changed)
    return replace(vehicle, battery=battery).changed(parameters)


def grid(sweeps: Sequence[Sweep]) -> list[dict[str, float]]:
    """The values of each variant; the last sweep changes fastest."""
    return [dict(zip((s.name for s in sweeps), values, strict=True)) for values in product(*(s.values for s in sweeps))]
