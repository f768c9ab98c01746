"""A vehicle: what its TOML file says of its bus, its parameters, its battery and its model."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

from gz_onboard.bus.dbc import find_dbc
from gz_onboard.bus.mapping import BusMapping, read_mapping
from gz_onboard.bus.publisher import GROUP_STEP, MESSAGES, RANGE_DBC, Publisher
from gz_onboard.errors import InputError, brief, nearest, shown
from gz_onboard.events import MOST_EXTENDED, MOST_STANDARD
from gz_onboard.physics.battery import Battery
from gz_onboard.physics.battery_file import read_battery
from gz_onboard.physics.derating import Derating, read_derating
from gz_onboard.physics.effect import Effect, read_effects
from gz_onboard.physics.model import Model
from gz_onboard.physics.parameters import Parameters, read_parameters
from gz_onboard.physics.riding import PriorRiding, check_riding, read_riding
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
    """Everything that is known of one vehicle before it moves."""

    name: str
    file: Path
    mapping: BusMapping
    parameters: Parameters
    battery: Battery | None
    model: Model
    riding: PriorRiding
    range_dbc: Path  # of the range frames
    derating: Derating = field(default_factory=Derating)
    range_identifier: int | None = None  # of the first range frame, in place of that in `range_dbc`
    healthy: object = None  # what the discovery learned of it on healthy rides
    vehicle_id: str = ""  # which it is of several with one file; then the end of its name

    __repr__ = brief

    def __str__(self) -> str:
        """In a few lines: what somebody wants to see who has read it."""
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
        """What a saved state must agree with to be of use: the vehicle, its cells and its model list."""
        pack = f"{self.battery.cells_series}s{self.battery.cells_parallel}p" if self.battery else "no battery"
        return "|".join([self.name, pack, *(effect.name for effect in self.model.effects)])

    def identified(self, vehicle_id: str, where: str) -> Vehicle:
        """The one that has this id, of several with this file. InputError, which begins with `where`, for no id."""
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
        """The same with a rider and luggage of `payload` [kg]. InputError if that cannot be."""
        parameters = self.parameters.replaced(payload_mass=payload)
        return replace(self, parameters=parameters, model=Model(self.model.effects, parameters))

    @property
    def pack(self) -> Battery:
        """The battery; InputError if the file has none."""
        if self.battery is None:
            raise self.error("has no [battery]: without one there is no range and nothing to simulate")
        return self.battery

    def publisher(self) -> Publisher:
        """What sends the vehicle's range frames; InputError if their DBC file does not do."""
        identifier = self.range_identifier
        groups = self.mapping.j1939 and identifier is not None and identifier > MOST_STANDARD
        try:
            return Publisher(self.range_dbc, identifier, GROUP_STEP if groups else 1)
        except InputError as error:
            raise self.error(f"range_dbc: {error}") from error

    def changed(self, parameters: Parameters, effects: Iterable[Effect] | None = None) -> Vehicle:
        """The same vehicle with other parameters, and other effects if they are given."""
        effects = self.model.effects if effects is None else tuple(effects)
        return replace(
            self,
            parameters=parameters,
            battery=self.battery and self.battery.with_parameters(parameters),
            model=Model(effects, parameters),
        )

    def error(self, message: str) -> InputError:
        """The error to raise about this vehicle's file."""
        return InputError(f"{self.file}: {message}")


def find_vehicle(name: str | Path, beside: Path | None = None) -> Path:
    """The vehicle file `name`: one of the package's own, or a path, which has a slash or ends in ``.toml``.

    beside: the folder from which a path is; the working directory if not given. InputError if there is none.
    """
    own = sorted(file.stem for file in OWN.glob("*.toml"))
    there_are = f"the package's own are {', '.join(own)}"
    path = (beside or Path()) / name
    if isinstance(name, Path) or "/" in name or name.endswith(".toml"):
        if is_file(path):
            return path
        _check_no_folder(path)
        raise InputError(f"{path if beside else name}: no such vehicle file; {there_are}{nearest(str(name), own)}")
    if name in own:
        return OWN / f"{name}.toml"
    meant = f" (did you mean './{name}'?)" if is_file(path) else nearest(name, own)
    if not meant:
        _check_no_folder(path)
    raise InputError(f"{name}: no such vehicle file; {there_are}{meant}")


def _check_no_folder(path: Path) -> None:
    if path.is_dir():
        one = next((f"the vehicle file in it, such as {file}" for file in sorted(path.glob("*.toml"))), None)
        raise InputError(f"{path}: is a folder; give {one or 'a vehicle file, which ends in .toml'}")


def read_vehicle(
    name: str | Path,
    payload: float | None = None,
    effects_folder: Path | None = None,
    users: Collection[int] | None = None,
    vehicle_id: str | None = None,
) -> Vehicle:
    """The vehicle `name` (file or one of the package's own), with the rider's mass [kg] if it is known.

    effects_folder: where effects of the user's own are, beside the file's own ``effects_folder``, of which only those
    run that nobody but `users` can change (see `read_effects`). vehicle_id: which it is of several with this file.
    """
    table = Table.read(find_vehicle(name))
    if "poll" in table.values:
        raise table.error("was removed: requests are not sent, only answers to another tester are read", "poll")
    table.only(KEYS.split())
    if table.number("schema") != 1:
        raise table.error(f"is {table.values['schema']}; this version reads 1", "schema")
    effects = read_effects(table, effects_folder, users)
    parameters = read_parameters(table, effects)
    model, derating = Model(effects, parameters), read_derating(table)
    spin = derating.top_spin
    top_speed = spin and spin * parameters["wheel_radius"] / parameters["gear_ratio"]
    riding = read_riding(table, model, top_speed)
    check_riding(table, riding, model)
    vehicle = Vehicle(
        name=_name(table),
        file=table.file,
        mapping=read_mapping(table),
        parameters=parameters,
        battery=read_battery(table, parameters) if "battery" in table.values else None,
        model=model,
        riding=riding,
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
    """The DBC file of the range frames, found as those of the bus are."""
    name = table.check_path("range_dbc", table.text("range_dbc", RANGE_DBC))
    try:
        return find_dbc(name, table.file.parent)
    except InputError as error:
        raise table.error(str(error), "range_dbc") from error


def _range_identifier(table: Table) -> int | None:
    """The identifier of the first range frame, if the file gives one."""
    if "range_identifier" not in table.values:
        return None
    first = table.integer("range_identifier", 0, MOST_EXTENDED - MESSAGES * GROUP_STEP)
    if first <= MOST_STANDARD < first + MESSAGES - 1:
        raise table.error(
            f"the {MESSAGES} frames from {first:#x} on end beyond {MOST_STANDARD:#x}, the last of 11 bits",
            "range_identifier",
        )
    return first


def _name(table: Table) -> str:
    """The vehicle's name, which becomes part of the names of files: no path, nothing that a shell would take apart."""
    name = table.text("name")
    if not re.fullmatch(NAME, name):
        raise table.error(f"must be {NAME_TEXT}, is {shown(name)}", "name")
    return name


def _healthy(table: Table) -> Path | None:
    """The file of what the discovery learned on healthy rides, beside the vehicle file."""
    table.only(["file", "rides"])
    if "file" not in table.values:
        return None
    file = table.file.parent / table.check_path("file", table.text("file"))
    if not is_file(file):
        raise table.error(f"no file {file}", "file")
    return file
