"""One ride as columns, the form in which every offline tool takes it, from a log or from a table of signals."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

from gz_onboard.arguments import check, within
from gz_onboard.can.codec import LONGEST_PAUSE_NS, TIME, Codec
from gz_onboard.can.mapping import BusMapping
from gz_onboard.errors import InputError, brief, nearest, shown
from gz_onboard.events import EFF_FLAG, INSTRUMENTS, ROLES, hexadecimal
from gz_onboard.options import MOST_PAYLOAD
from gz_onboard.recording.decode import decode_columns
from gz_onboard.recording.frames import BATCH, FrameColumns, SignalColumns, stray
from gz_onboard.recording.logs import is_table, log_stem, read_log
from gz_onboard.recording.readers.contents import LogDamage
from gz_onboard.recording.tables import SignalTable, read_table, table_signals
from gz_onboard.vehicle import Vehicle

if TYPE_CHECKING:
    from gz_onboard.arrays import Array

_MOST_BACK = 3  # times a clock may be set back; more, and more often than once a second, is none that was set
NUMBERS = {
    "rider_mass_kg": (0.0, MOST_PAYLOAD, "kg"),  # and luggage
    "total_mass_kg": (1.0, 100_000.0, "kg"),  # of vehicle, rider and luggage
    "ambient_C": (-60.0, 70.0, "degC"),
}
TEXTS = ("kind", "rider", "direction", "note", "vehicle_id")
"""What can be written down of a ride: numbers with their range and unit, and texts."""


@dataclass(frozen=True)
class Recording:
    """One ride as measured.

    columns: by role (names and units of `events.ROLES`, and `events.INSTRUMENTS`) the times [s, of one clock for the
    whole ride, never decreasing] and values (SI) of every sample that passed the codec, no two roles at the same times.
    facts: what was written down about the ride: of `NUMBERS` and `TEXTS`.

    Raises InputError for what is none of these.
    """

    name: str
    columns: dict[str, tuple[Array, Array]]
    facts: dict[str, object] = field(default_factory=dict)

    __repr__ = brief

    def __post_init__(self) -> None:
        check("name", self.name, str)
        check("columns", self.columns, Mapping[str, object])
        columns = {role: _column(f"{self.name}: {role}", role, column) for role, column in self.columns.items()}
        object.__setattr__(self, "columns", columns)
        object.__setattr__(self, "facts", checked_facts(self.name, self.facts))

    @property
    def rider_mass(self) -> float | None:
        """The mass of rider and luggage as entered [kg], or None."""
        return rider_mass(self.facts)


def read_recording(source: Path | SignalTable, vehicle: Vehicle) -> Recording:
    """Read the ride of `vehicle` in a log or a table, with what a ``rides.json`` next to the log says about it.

    InputError for a log that cannot be read or is not of the vehicle.
    """
    mapping, frames = open_ride(source, vehicle)
    file = source.name if isinstance(source, SignalTable) else source
    columns = read_roles(file, vehicle, Codec(extended(mapping), LONGEST_PAUSE_NS), frames)
    return Recording(ride_name(file), columns, {} if isinstance(source, SignalTable) else facts_of(source))


def open_ride(
    source: Path | SignalTable, vehicle: Vehicle, on_damage: Callable[[LogDamage], None] | None = None
) -> tuple[BusMapping, FrameColumns | SignalColumns]:
    """Return the mapping that decodes the ride in `source`, and its frames, or the values of a table of signals.

    on_damage: see `read_log`. InputError for a file that is neither, for frames without times, and for a log of a
    vehicle without DBC files.
    """
    time = vehicle.mapping.time.name if vehicle.mapping.time else ""
    if isinstance(source, SignalTable) or is_table(source, time):
        return table_signals(source if isinstance(source, SignalTable) else read_table(source), vehicle.mapping)
    if not vehicle.mapping.reads_frames:
        raise vehicle.error(
            f"dbc is missing: without it a table of signals can be read, but no frames as in {source}; of a "
            "table say which column is the time: [table] time = { column = ..., unit = ... }"
        )
    frames = read_log(source, on_damage=on_damage)
    if len(frames) > 1 and not frames.time_ns[:BATCH].any():
        raise InputError(f"{source}: its frames have no times, which a ride needs; candump -L writes them")
    return vehicle.mapping, frames


def read_roles(
    log: Path, vehicle: Vehicle, codec: Codec, frames: FrameColumns | SignalColumns
) -> dict[str, tuple[Array, Array]]:
    """Decode a ride: (times [s], values) by role, of all that came more than once.

    codec: a new one, which is left as if it had decoded the frames. InputError for a log that is not of the vehicle.
    """
    columns = decode_columns(frames, codec, stray(frames.time_ns))
    check_ridden(log, vehicle, codec)
    return {role: column for role, column in columns.items() if len(column[0]) > 1}


def check_ridden(log: Path, vehicle: Vehicle, codec: Codec) -> None:
    """InputError if none of the frames in a log is the vehicle's, or their times make no ride; codec: has seen all."""
    if not codec.latest and not codec.mapping.groups:
        raise _of_another(log, vehicle, codec)
    for conflict in codec.origins.conflicts.values():
        raise vehicle.error(f"{log}: {conflict}")
    passed = codec.seconds(codec.last_ns)
    if codec.received > 1 and not passed and not codec.leaps and not codec.faults.get(("", TIME)):
        raise InputError(f"{log}: all its {codec.received} frames have one and the same time; that is not a ride")
    back = sum(leap < 0 for _, leap in codec.leaps)
    if back > _MOST_BACK and back > passed:
        raise InputError(
            f"{log}: its time runs back again and again, at least {back} times within {max(passed, 0.0):.0f} s; "
            "sort its frames by time, or record it again"
        )
    if passed < 0 or (back and not passed):
        raise InputError(f"{log}: its last frame is not after its first; sort its frames by time, or record it again")


def _of_another(log: Path, vehicle: Vehicle, codec: Codec) -> InputError:
    """That none of the frames in a log is the vehicle's; codec: that has seen them."""
    names = ", ".join(hexadecimal(identifier) for identifier in sorted(codec.unknown)[:5])
    said = (
        f"{log}: vehicle {vehicle.name!r} knows none of its {codec.received} frames"
        f"{f' (identifiers {names}, ...)' if names else ''}; "
    )
    for message in vehicle.mapping.database.messages:
        for channel, identifier in codec.heard(message.name):
            return InputError(f"{said}{message.name} came on channel {channel} as {hexadecimal(identifier)}: see [bus]")
    for identifier in codec.unknown:
        if codec.origins.find(other := identifier ^ EFF_FLAG):
            bits, others = (29, 11) if identifier & EFF_FLAG else (11, 29)
            return InputError(
                f"{said}{hexadecimal(identifier)} has {bits} bits, the vehicle's {hexadecimal(other)} has {others}: "
                "candump writes 11 bits with three digits and 29 bits with eight"
            )
    return InputError(f"{said}give the vehicle that it is of, or begin a file for it: gz-onboard vehicle new my.toml")


def read_facts(file: Path) -> dict[str, dict[str, object]]:
    """What is written down about rides, by their names: a JSON list of objects with ``name``. Empty without a file."""
    if not file.is_file():
        return {}
    found: dict[str, dict[str, object]] = {}
    try:
        rows = json.loads(file.read_text(encoding="utf-8"))
        if not isinstance(rows, list) or not all(isinstance(r, dict) and isinstance(r.get("name"), str) for r in rows):
            raise InputError(f"{file}: must be a JSON list of objects, each with a name, that of its log")
        for row in rows:
            name = row.pop("name")
            if name in found:
                raise InputError(f"{file}: two rides are called {name!r}")
            found[name] = checked_facts(f"{file}: {name}", row)
    except (OSError, ValueError) as error:
        raise InputError(f"{file}: must be a JSON list of objects with a name: {error}") from error
    return found


def checked_facts(place: str, facts: object) -> dict[str, object]:
    """What is known of a ride, without what is None; InputError for what is not of `NUMBERS` and `TEXTS`."""
    check(f"{place}: facts", facts, Mapping[str, object])
    known = {key: value for key, value in cast("Mapping[str, object]", facts).items() if value is not None}
    for key, value in known.items():
        if key in NUMBERS:
            check(f"{place}: {key}", value, float)
            within(key, cast("float", value), NUMBERS, f"{place}: ")
        elif key in TEXTS:
            check(f"{place}: {key}", value, str)
        else:
            names = (*NUMBERS, *TEXTS)
            raise InputError(
                f"{place}: {key!r} is no fact of a ride{nearest(key, names)}; there are {', '.join(names)}"
            )
    return known


def _column(place: str, role: str, column: object) -> tuple[Array, Array]:
    """(times, values) of a role; InputError if these are not two arrays of numbers of one length, or times decrease."""
    import numpy as np

    if role not in ROLES and role not in INSTRUMENTS:
        raise InputError(f"{place}: is no role{nearest(role, (*ROLES, *INSTRUMENTS))}")
    if not isinstance(column, tuple | list) or len(column) != 2:
        raise InputError(f"{place}: must be two arrays, times [s] and values, is {shown(column)}")
    try:
        time, values = (np.asarray(one) for one in column)
    except ValueError:  # rows of unlike lengths
        time, values = np.zeros(1), np.zeros(2)
    if time.shape != values.shape or time.ndim != 1 or not {time.dtype.kind, values.dtype.kind} <= set("fiu"):
        raise InputError(f"{place}: must be two arrays of numbers of one length, times [s] and values")
    if not (np.diff(time) >= 0).all():
        raise InputError(f"{place}: its times decrease")
    return time.astype(float, copy=False), values.astype(float, copy=False)


def ride_name(log: Path) -> str:
    """The name of the ride in a log: the file's, without its suffixes."""
    return log_stem(log)


def facts_of(log: Path) -> dict[str, object]:
    """What ``rides.json`` beside a log says about its ride."""
    facts = read_facts(log.parent / "rides.json")
    return facts.get(ride_name(log)) or facts.get(log.name, {})


def of_ride(vehicle: Vehicle, source: Path | SignalTable) -> Vehicle:
    """`vehicle` as the one that ``rides.json`` beside a log says, if it says one. InputError if that is another."""
    vehicle_id = None if isinstance(source, SignalTable) else facts_of(source).get("vehicle_id")
    return vehicle if vehicle_id is None else vehicle.identified(str(vehicle_id), f"{source}: rides.json")


def rider_mass(facts: Mapping[str, object]) -> float | None:
    """The mass of rider and luggage [kg] that is written down of a ride, or None."""
    mass = facts.get("rider_mass_kg")
    return None if mass is None else float(cast("float", mass))


def extended(mapping: BusMapping) -> BusMapping:
    """`mapping` with its instruments among the sources."""
    return replace(mapping, sources=mapping.sources + mapping.instruments)
