"""Read a vehicle file: bus, parameters, battery and model of one vehicle."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

from gz_onboard.can.dbc import find_dbc
from gz_onboard.can.mapping import BusMapping, read_mapping
from gz_onboard.can.publisher import GROUP_STEP, MESSAGES, RANGE_DBC, Publisher
from gz_onboard.errors import InputError, brief, nearest, shown
from gz_onboard.events import MOST_EXTENDED, MOST_STANDARD
from gz_onboard.model.battery import Battery
from gz_onboard.model.effect import Effect, read_effects
from gz_onboard.model.model import Model
from gz_onboard.model.parameters import Parameters, read_parameters
from gz_onboard.model.riding import PriorRiding, read_riding
from gz_onboard.model.tables import Derating, read_battery, read_derating
from gz_onboard.toml import Table, is_file

OWN = Path(__file__).resolve().parent / "vehicles"
NAME = r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}"
NAME_TEXT = "1 to 64 letters, digits and - _ . with a letter or digit first"
KEYS = (
    "schema name vehicle_id dbc range_dbc range_identifier bus request roles table instruments model parameters "
    "correlation battery forecast controller healthy"
)


@dataclass(frozen=True)
class Vehicle:
    """The contents of a vehicle file."""

    name: str
    file: Path
    mapping: BusMapping
    parameters: Parameters
    battery: Battery | None
    model: Model
    riding: PriorRiding
    correlations: Table  # of parameters, which offline tools read
    range_dbc: Path  # of the range frames
    derating: Derating = field(default_factory=Derating)
    range_identifier: int | None = None  # of the first range frame, in place of that in `range_dbc`
    healthy: object = None  # file that the discovery made on healthy rides
    vehicle_id: str = ""  # of one of several vehicles with this file; the end of its name

    __repr__ = brief

    def __str__(self) -> str:
        """Summarise it in a few lines."""
        cells = (
            self.battery and f"{self.battery.cells_series} cells in series, {self.battery.cells_parallel} in parallel"
        )
        columns = self.mapping.columns
        roles = columns.values if columns else [source.role for source in self.mapping.sources]
        lines = [
            f"{self.name} ({self.file})",
            f"  battery  {cells or 'none'}",
            f"  effects  {', '.join(effect.name for effect in self.model.effects)}",
            f"  roles    {', '.join(roles) or 'none'}",
        ]
        return "\n".join(lines)

    @property
    def key(self) -> str:
        """Name, cells and effects, in which a saved state must agree with the vehicle."""
        pack = f"{self.battery.cells_series}s{self.battery.cells_parallel}p" if self.battery else "no battery"
        return "|".join([self.name, pack, *(effect.name for effect in self.model.effects)])

    def identified(self, vehicle_id: str, where: str) -> Vehicle:
        """Return the vehicle with this ID. InputError, which begins with `where`, for a bad ID or a second one."""
        if vehicle_id == self.vehicle_id:
            return self
        if self.vehicle_id:
            raise InputError(
                f"{where}: vehicle_id is {shown(vehicle_id)}, and that of the vehicle is {self.vehicle_id!r}"
            )
        if not re.fullmatch(NAME, vehicle_id):
            raise InputError(f"{where}: vehicle_id must be {NAME_TEXT}, is {shown(vehicle_id)}")
        return replace(self, name=f"{self.name}-{vehicle_id}", vehicle_id=vehicle_id)

    def loaded(self, payload: float) -> Vehicle:
        """Return the vehicle with a rider and luggage of `payload` [kg]. InputError if out of range."""
        return self.changed(self.parameters.replaced(payload_mass=payload))

    @property
    def pack(self) -> Battery:
        """The battery. InputError if the file has none."""
        if self.battery is None:
            raise self.error("has no [battery]: without one there is no range and nothing to simulate")
        return self.battery

    def publisher(self) -> Publisher:
        """Return the publisher of the vehicle's range frames. InputError if their DBC file is unsuitable."""
        identifier = self.range_identifier
        groups = self.mapping.j1939 and identifier is not None and identifier > MOST_STANDARD
        try:
            return Publisher(self.range_dbc, identifier, GROUP_STEP if groups else 1)
        except InputError as error:
            raise self.error(f"range_dbc: {error}") from error

    def changed(self, parameters: Parameters, effects: Iterable[Effect] | None = None) -> Vehicle:
        """Return the vehicle with other parameters, and other effects if any are given."""
        effects = self.model.effects if effects is None else tuple(effects)
        return replace(
            self,
            parameters=parameters,
            battery=self.battery and self.battery.with_parameters(parameters),
            model=Model(effects, parameters),
        )

    def error(self, message: str) -> InputError:
        """Return the error to raise about this vehicle's file."""
        return InputError(f"{self.file}: {message}")


def find_vehicle(name: str | Path, folder: Path | None = None) -> Path:
    """Find the vehicle file `name`: a built-in vehicle, or a path, which has a slash or ends in ``.toml``.

    folder: the folder to which the path is relative; default: the working directory. InputError if there is none.
    """
    built_in = sorted(file.stem for file in OWN.glob("*.toml"))
    path = (folder or Path()) / name
    if isinstance(name, Path) or "/" in name or name.endswith(".toml"):
        if is_file(path):
            return path
    elif name in built_in:
        return OWN / f"{name}.toml"
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give a vehicle file, which ends in .toml")
    meant = f" (did you mean './{name}'?)" if is_file(path) else nearest(str(name), built_in)
    shown_as = path if folder else name
    raise InputError(f"{shown_as}: no such vehicle file; built-in vehicles are {', '.join(built_in)}{meant}")


def read_vehicle(
    name: str | Path,
    payload: float | None = None,
    effects_folder: Path | None = None,
    users: Collection[int] | None = None,
    vehicle_id: str | None = None,
) -> Vehicle:
    """Read the vehicle `name` (a file or a built-in one). InputError.

    payload: mass of rider and luggage [kg]; effects_folder: the user's effects, in addition to the file's own
    ``effects_folder``, whose code runs only if nobody but `users` can change it (see `read_model`); vehicle_id: of one
    of several vehicles with this file.
    """
    table = Table.read(find_vehicle(name))
    table.only(KEYS.split())
    if table.number("schema") != 1:
        raise table.error(f"is {table.values['schema']}; this version reads 1", "schema")
    effects = read_effects(table, effects_folder, users)
    parameters = read_parameters(table, effects)
    model, derating = Model(effects, parameters), read_derating(table)
    riding = read_riding(table, model, derating.top_spin)
    own_name = table.text("name")  # becomes part of file names: no path, nothing that a shell would split
    if not re.fullmatch(NAME, own_name):
        raise table.error(f"must be {NAME_TEXT}, is {shown(own_name)}", "name")
    vehicle = Vehicle(
        name=own_name,
        file=table.file,
        mapping=read_mapping(table),
        parameters=parameters,
        battery=read_battery(table, parameters) if "battery" in table.values else None,
        model=model,
        riding=riding,
        correlations=table.table("correlation"),
        derating=derating,
        range_dbc=_range_dbc(table),
        range_identifier=_range_identifier(table),
        healthy=_healthy(table.table("healthy")),
    )
    if "vehicle_id" in table.values:
        vehicle = vehicle.identified(table.text("vehicle_id"), str(table.file))
    if vehicle_id is not None:
        vehicle = vehicle.identified(vehicle_id, "--vehicle-id")
    return vehicle if payload is None else vehicle.loaded(payload)


def _range_dbc(table: Table) -> Path:
    """Find the DBC file of the range frames."""
    name = table.check_path("range_dbc", table.text("range_dbc", RANGE_DBC))
    try:
        return find_dbc(name, table.file.parent)
    except InputError as error:
        raise table.error(str(error), "range_dbc") from error


def _range_identifier(table: Table) -> int | None:
    """Read the identifier of the first range frame, if the file gives one."""
    if "range_identifier" not in table.values:
        return None
    first = table.integer("range_identifier", 0, MOST_EXTENDED - MESSAGES * GROUP_STEP)
    if first <= MOST_STANDARD < first + MESSAGES - 1:
        raise table.error(
            f"the {MESSAGES} frames from {first:#x} on end beyond {MOST_STANDARD:#x}, the last of 11 bits",
            "range_identifier",
        )
    return first


def _healthy(table: Table) -> Path | None:
    """Find the discovery's file of healthy rides, relative to the vehicle file."""
    table.only(["file", "rides"])
    if "file" not in table.values:
        return None
    file = table.file.parent / table.check_path("file", table.text("file"))
    if not is_file(file):
        raise table.error(f"no file {file}", "file")
    return file
