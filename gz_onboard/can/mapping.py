"""Read the bus part of a vehicle file: which signal of which message plays which role, in which unit.

docs/reference/vehicle-file.md describes the keys.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from math import pi
from pathlib import Path
from typing import TYPE_CHECKING

from gz_onboard.can.dbc import LARGEST, SMALLEST, LeftOut, empty_database, find_dbc, load_database
from gz_onboard.can.requests import Request, read_requests
from gz_onboard.constants import GRAVITY, KELVIN
from gz_onboard.errors import InputError, nearest, shown
from gz_onboard.events import CURRENTS, EFF_FLAG, INSTRUMENTS, ROLES, SPEEDS, VOLTAGES, Group

if TYPE_CHECKING:
    from cantools.database.can import Database, Message

    from gz_onboard.toml import Table

LONGEST_DELAY = 10.0  # s, of a message
MOST_CHANNELS = 127
UNITS = {**ROLES, **INSTRUMENTS}  # of all roles

# (unit in a DBC, SI unit) -> factor, offset
_CONVERSIONS: dict[tuple[str, str], tuple[float, float]] = {
    ("mV", "V"): (1e-3, 0.0),
    ("mA", "A"): (1e-3, 0.0),
    ("kW", "W"): (1e3, 0.0),
    ("K", "degC"): (1.0, -KELVIN),
    ("degF", "degC"): (5 / 9, -160 / 9),
    ("rpm", "rad/s"): (2 * pi / 60, 0.0),
    ("rev/s", "rad/s"): (2 * pi, 0.0),
    ("deg/s", "rad/s"): (pi / 180, 0.0),
    ("deg", "rad"): (pi / 180, 0.0),
    ("km/h", "m/s"): (1 / 3.6, 0.0),
    ("mph", "m/s"): (0.44704, 0.0),
    ("km", "m"): (1e3, 0.0),
    ("mm", "m"): (1e-3, 0.0),
    ("mi", "m"): (1609.344, 0.0),
    ("ft", "m"): (0.3048, 0.0),
    ("bar", "Pa"): (1e5, 0.0),
    ("kPa", "Pa"): (1e3, 0.0),
    ("g", "m/s^2"): (GRAVITY, 0.0),
    ("%", "1"): (0.01, 0.0),
}

# Spellings seen in DBC files -> ours
_ALIASES = (
    "r/min=rpm 1/min=rpm RPM=rpm r/s=rev/s rps=rev/s °/s=deg/s dps=deg/s °=deg degree=deg degrees=deg °C=degC "
    "C=degC ºC=degC Celsius=degC °F=degF F=degF ºF=degF Fahrenheit=degF mile=mi miles=mi feet=ft Nm=N·m "
    "N.m=N·m N*m=N·m kph=km/h kmh=km/h m/s2=m/s^2 m/s²=m/s^2 meters=m Volt=V Volts=V Amp=A Amps=A Watts=W Percent=% "
    "km/hr=km/h mi/h=mph Km=km KM=km"
)
_SPACED = {"": "1", "-": "1", "deg C": "degC", "deg F": "degF"}
_SPELLINGS = _SPACED | dict(alias.split("=") for alias in _ALIASES.split())
_KNOWN = {*UNITS.values(), *(unit for unit, _ in _CONVERSIONS), *_SPELLINGS}
_LOWER = {unit.lower(): unit for unit in sorted(_KNOWN) if len(unit) > 2}  # of shorter ones the case tells mV from MV


@dataclass(frozen=True)
class Source:
    """Where a role comes from. SI value = raw * factor + offset."""

    role: str
    message: str
    signal: str
    factor: float
    offset: float


@dataclass(frozen=True)
class Protection:
    """What protects a message against corruption and loss."""

    crc: str | None = None
    counter: str | None = None


@dataclass(frozen=True)
class TimeColumn:
    """The column with the times of a table of signals: their unit, s or ms, or the format of dates, as of strptime."""

    name: str
    unit: str = ""
    format: str = ""


@dataclass(frozen=True)
class BusMapping:
    """The bus of one vehicle: its database, and the roles that its signals play."""

    database: Database
    dbc_files: tuple[Path, ...]
    sources: tuple[Source, ...]
    protection: dict[str, Protection]
    periods: dict[str, float]  # s, by message; only where known
    not_available: bool = True
    j1939: bool = False
    origins: dict[str, tuple[int | None, int | None]] = field(default_factory=dict)  # channel and sender, by message
    delays: dict[str, float] = field(default_factory=dict)  # s, by message: its values are so much older; where stated
    instruments: tuple[Source, ...] = ()  # of roles that no estimator needs
    columns: Table | None = None  # the roles of a vehicle without DBC files: their signals are columns of a table
    requests: tuple[Request, ...] = ()  # of other testers, whose answers are read
    time: TimeColumn | None = None  # of tables; None: the first column that is called so
    groups: tuple[Group, ...] = ()  # of a table's columns, which come without frames

    @property
    def reads_frames(self) -> bool:
        """Whether anything on a bus is known: messages of DBC files, or answers."""
        return bool(self.dbc_files or self.requests)


def read_mapping(vehicle: Table) -> BusMapping:
    """The bus part of the vehicle file `vehicle`; InputError for anything that does not fit its DBC files.

    A vehicle without DBC files and requests has a mapping without sources: only tables of signals can be read for it.
    """
    time = _time_column(vehicle.table("table"))
    if "dbc" not in vehicle.values and "request" not in vehicle.values:
        if "bus" in vehicle.values:
            raise vehicle.error("describes frames, for which dbc is missing", "bus")
        roles = vehicle.table("roles")
        roles.only(ROLES)
        return BusMapping(empty_database(), (), (), {}, {}, columns=roles if roles.values else None, time=time)
    files = _dbc_files(vehicle) if "dbc" in vehicle.values else []
    left_out: LeftOut = {}
    database = load_database(files, left_out) if files else empty_database()
    flagged = {m.frame_id | (EFF_FLAG if m.is_extended_frame else 0): m.name for m in database.messages}
    requests = read_requests(vehicle, flagged)
    if twice := {request.name for request in requests} & set(flagged.values()):
        raise vehicle.error(f"a message of the DBC files is called {min(twice)} too", "request")
    messages = [*database.messages, *(request.message for request in requests)]
    sources = _sources(messages, left_out, vehicle.table("roles"), ROLES)
    _check_witnesses(sources, vehicle.table("roles"))

    bus = vehicle.table("bus")
    bus.only(["not_available", "identifiers", "channel", "messages"])
    mapping = BusMapping(
        database=database,
        dbc_files=tuple(files),
        sources=sources,
        instruments=_sources(messages, left_out, vehicle.table("instruments"), INSTRUMENTS),
        protection={},
        periods={message.name: message.cycle_time / 1000 for message in database.messages if message.cycle_time}
        | {request.name: request.period for request in requests},
        not_available=bus.text("not_available", "all-ones", ["all-ones", "none"]) == "all-ones",
        j1939=bus.text("identifiers", "exact", ["exact", "j1939"]) == "j1939",
        requests=requests,
        time=time,
    )
    _read_messages(mapping, bus)
    return mapping


def _time_column(table: Table) -> TimeColumn | None:
    table.only(["time"])
    if not table.values:
        return None
    time = table.table("time")
    time.only(["column", "unit", "format"])
    if ("unit" in time.values) == ("format" in time.values):
        raise time.error("needs either a unit, s or ms, or a format of dates, as of strptime")
    unit = time.text("unit", "", ["s", "ms"] if "unit" in time.values else [])
    return TimeColumn(time.text("column"), unit, time.text("format", ""))


def _dbc_files(vehicle: Table) -> list[Path]:
    names = [vehicle.check_path("dbc", name) for name in vehicle.texts("dbc", "DBC file names")]
    try:
        return [find_dbc(name, vehicle.file.parent) for name in names]
    except InputError as error:
        raise vehicle.error(str(error), "dbc") from error


def _read_messages(mapping: BusMapping, bus: Table) -> None:
    """Add to `mapping` the protection, period [s], delay [s], channel and sender of its messages."""
    database = mapping.database
    if mapping.j1939:
        _check_groups(database, bus)
    common = _optional(bus, "channel", MOST_CHANNELS)
    if common is not None:
        mapping.origins.update({message.name: (common, None) for message in database.messages})
    messages = bus.table("messages")
    for name in messages.values:
        message = _message(database.messages, messages, name, name)
        options = messages.table(name)
        options.only(["crc", "counter", "period", "delay", "channel", "sender"])
        mapping.protection[name] = _protection(message, options)
        if "period" in options.values:
            mapping.periods[name] = options.number("period", low=1e-4, high=3600)
        if "delay" in options.values:
            mapping.delays[name] = options.number("delay", low=-LONGEST_DELAY, high=LONGEST_DELAY)
        channel, sender = _optional(options, "channel", MOST_CHANNELS), _optional(options, "sender", 255)
        if sender is not None and not (mapping.j1939 and message.is_extended_frame):
            raise options.error('is an address of J1939, which needs identifiers = "j1939" and 29 bits', "sender")
        mapping.origins[name] = common if channel is None else channel, sender


def _optional(table: Table, key: str, most: int) -> int | None:
    return table.integer(key, 0, most) if key in table.values else None


def _protection(message: Message, options: Table) -> Protection:
    signals = {signal.name: signal for signal in message.signals}
    crc, counter = options.text("crc", ""), options.text("counter", "")
    for key, name in (("crc", crc), ("counter", counter)):
        if name not in (*signals, *([] if key in options.values else [""])):
            raise options.error(f"message {message.name} has no signal {shown(name)}{nearest(name, signals)}", key)
    if crc and (signals[crc].length != 8 or signals[crc].start // 8 != message.length - 1):
        raise options.error(f"{crc!r} must be the last byte of {message.name}, all 8 bits of it", "crc")
    if counter and counter == crc:
        raise options.error(f"{counter!r} is the crc of {message.name}: it cannot be its counter too", "counter")
    found = signals.get(counter)
    if found and (
        found.is_signed or found.conversion.is_float or found.multiplexer_ids is not None or not 2 <= found.length <= 32
    ):
        raise options.error(
            f"{counter!r} must be an unsigned integer of 2 to 32 bits, in every {message.name}", "counter"
        )
    return Protection(crc or None, counter or None)


def _check_groups(database: Database, bus: Table) -> None:
    seen: dict[int, str] = {}
    for message in (message for message in database.messages if message.is_extended_frame):
        other = seen.setdefault(pgn(message.frame_id), message.name)
        if other != message.name:
            raise bus.error(
                f"{other} and {message.name} have the same parameter group number {pgn(message.frame_id)}: "
                'one can be told from the other only by identifiers = "exact"',
                "identifiers",
            )


def _sources(
    messages: Sequence[Message], left_out: LeftOut, roles: Table, known: Collection[str]
) -> tuple[Source, ...]:
    """The sources of all roles in the table `roles`, which may have `known` ones only."""
    roles.only(known)
    return tuple(_source(messages, left_out, roles, role) for role in roles.values)


def _source(messages: Sequence[Message], left_out: LeftOut, roles: Table, role: str) -> Source:
    table = roles.table(role, short="signal")
    table.only(["message", "signal", "unit", "scale", "offset"])
    name, of = table.text("signal"), table.text("message", "")
    key = "signal" if table.values is roles.values[role] else ""
    for (message_name, signal_name), why in left_out.items():
        if signal_name == name and of in ("", message_name):
            place = f"{shown(name)} of {message_name}"
            raise table.error(f"signal {place} is left out of the DBC file, for it cannot be read: {why}", key)
    among = [_message(messages, table, "message", of)] if of else messages
    found = [(m, s) for m in among for s in m.signals if s.name == name]
    if not found:
        known = [s.name for m in among for s in m.signals]
        where = f"message {of} has no signal" if of else "no message in dbc has a signal"
        raise table.error(f"{where} {shown(name)}{nearest(name, known)}", key)
    if len(found) > 1:
        several = ", ".join(m.name for m, _ in found)
        raise table.error(f"signal {shown(name)} is in several messages ({several}): give one by message = ...", key)
    ((message, signal),) = found
    scale, offset = float(signal.conversion.scale), float(signal.conversion.offset)
    return _scaled(table, key, role, (message.name, name), signal.unit or "", (scale, offset))


def _scaled(
    table: Table, key: str, role: str, place: tuple[str, str], default_unit: str, conversion: tuple[float, float]
) -> Source:
    """Return the source of `role` at `place` (message, signal), with the unit, scale and offset that `table` states.

    key: where errors point to; conversion: factor and offset from raw values to `default_unit`.
    """
    unit = table.text("unit", default_unit)
    si = to_si(unit, role)
    if si is None:
        raise table.error(
            f"{place[1]!r} has unit {shown(unit)}, from which {role} [{UNITS[role]}] cannot be had; "
            f"give unit = one of {', '.join(known_units(role))}{nearest(unit, known_units(role)) if unit else ''}",
            key,
        )
    scale = table.number("scale", 1.0, -LARGEST, LARGEST)
    if abs(scale) < SMALLEST:
        raise table.error(f"must not be 0, nor within {SMALLEST:g} of it, is {scale:g}", "scale")
    shift = table.number("offset", 0.0, -LARGEST, LARGEST)
    factor, offset = conversion
    return Source(role, *place, factor * si[0] * scale, (offset * si[0] + si[1]) * scale + shift)


def column_sources(units: Mapping[str, str], roles: Table, file: Path) -> tuple[Source, ...]:
    """Return the sources of `roles` among the columns of the table `file`, whose units are given by name."""
    try:
        sources = tuple(_column_source(units, roles, role) for role in roles.values)
        _check_witnesses(sources, roles)
    except InputError as error:
        raise InputError(f"{file}: its columns do not fit: {error}") from error
    return sources


def _column_source(units: Mapping[str, str], roles: Table, role: str) -> Source:
    table = roles.table(role, short="signal")
    table.only(["signal", "unit", "scale", "offset"])
    name, key = table.text("signal"), "signal" if table.values is roles.values[role] else ""
    if name not in units:
        raise table.error(f"there is no column {shown(name)}{nearest(name, units)}", key)
    return _scaled(table, key, role, (name, name), units[name], (1.0, 0.0))


def _check_witnesses(sources: tuple[Source, ...], where: Table) -> None:
    """InputError if roles that are checked against each other share a signal: it would agree with itself."""
    for group in (VOLTAGES, CURRENTS, SPEEDS):
        played: dict[tuple[str, str], str] = {}
        for source in (source for source in sources if source.role in group):
            other = played.setdefault((source.message, source.signal), source.role)
            if other != source.role:
                raise where.error(
                    f"{source.signal!r} of {source.message} is also {other}; the two are checked against each other",
                    source.role,
                )


def _message(messages: Sequence[Message], where: Table, key: str, name: str) -> Message:
    found = {message.name: message for message in messages}
    if name not in found:
        raise where.error(f"there is no message {shown(name)}{nearest(name, found)}", key)
    return found[name]


def pgn(identifier: int) -> int:
    """The parameter group number of a 29-bit identifier (SAE J1939-21): destinations do not belong to it."""
    group = identifier >> 8 & 0x3FFFF
    return group if group & 0xFF00 >= 0xF000 else group & 0x3FF00


def known_units(role: str) -> list[str]:
    """The units from which `role` can be read."""
    return [UNITS[role], *(unit for unit, si in _CONVERSIONS if si == UNITS[role])]


def to_si(unit: str, role: str) -> tuple[float, float] | None:
    """(factor, offset) from `unit` to the SI unit of `role`; None if it cannot be one of the role's units."""
    unit = unit if unit in _KNOWN else _LOWER.get(unit.lower(), unit)
    unit = _SPELLINGS.get(unit, unit)
    if unit == UNITS[role]:
        return 1.0, 0.0
    return _CONVERSIONS.get((unit, UNITS[role]))
