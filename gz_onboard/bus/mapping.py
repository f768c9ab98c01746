"""Which signal of which message plays which role: the bus part of a vehicle file.

dbc = ["vehicle.dbc", "hbm.dbc"]

[bus]
not_available = "all-ones"        # or "none"
channel = 0                       # of all messages; a log counts from 0, the daemon in the order of --channel
identifiers = "exact"             # or "j1939": 29-bit identifiers are matched by their PGN

[bus.messages.INV_Motion]         # only what the DBC does not say
crc = "INV_MotionCRC"             # CRC-8 SAE J1850 over the bytes before it
counter = "INV_MotionCounter"
period = 0.01                     # s, where the DBC has no GenMsgCycleTime
channel = 1                       # where other messages have this identifier on another channel
sender = 0xF2                     # address of a J1939 sender, where several send this parameter group

[roles]
pack_voltage = "BMS_PackVoltage"
pack_current = { signal = "BMS_Current", scale = -1, unit = "A" }
motor_speed = { message = "INV_Motion", signal = "INV_MotorSpeed" }

[table]                           # where a ride is a table of signals and its times have another name or form
time = { column = "epoch time", unit = "s" }  # or format = "%m/%d/%Y %H:%M:%S", as of strptime, in UTC

[instruments]                     # of the bench and of measuring rides, not needed on board
roller_speed = "DYNO_RollerSpeed"
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from gz_onboard.bus.dbc import LARGEST, SMALLEST, LeftOut, empty_database, find_dbc, load_database
from gz_onboard.bus.requests import Request, read_requests
from gz_onboard.bus.units import UNITS, known_units, to_si
from gz_onboard.errors import InputError, nearest, shown
from gz_onboard.events import CURRENTS, EFF_FLAG, INSTRUMENTS, ROLES, SPEEDS, VOLTAGES

if TYPE_CHECKING:
    from cantools.database.can import Database, Message
    from cantools.database.can.signal import Signal

    from gz_onboard.toml import Table

MOST_FILES = 20
LONGEST_DELAY = 10.0  # s, of a message
MOST_CHANNELS = 127


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

    @property
    def reads_frames(self) -> bool:
        """Whether anything on a bus is known: messages of DBC files, or answers."""
        return bool(self.dbc_files or self.requests)


def read_mapping(vehicle: Table) -> BusMapping:
    """The bus part of the vehicle file `vehicle`; InputError for whatever does not fit its DBC files.

    Of a vehicle without DBC files and requests only tables of signals can be read; it has a mapping without sources.
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

    bus = vehicle.table("bus")
    bus.only(["not_available", "identifiers", "channel", "messages"])
    protection, periods, delays = _options(database, bus.table("messages"))
    j1939 = bus.text("identifiers", "exact", ["exact", "j1939"]) == "j1939"
    if j1939:
        _check_groups(database, bus)
    origins = _origins(database, bus, j1939)
    named = _with_answers(database, requests, vehicle)
    sources = _sources(named, left_out, vehicle.table("roles"), ROLES)
    _check_witnesses(sources, vehicle.table("roles"))
    return BusMapping(
        database=database,
        dbc_files=tuple(files),
        sources=sources,
        instruments=_sources(named, left_out, vehicle.table("instruments"), INSTRUMENTS),
        protection=protection,
        periods=periods | {request.name: request.period for request in requests},
        not_available=bus.text("not_available", "all-ones", ["all-ones", "none"]) == "all-ones",
        j1939=j1939,
        origins=origins,
        delays=delays,
        requests=requests,
        time=time,
    )


def _time_column(table: Table) -> TimeColumn | None:
    table.only(["time"])
    if not table.values:
        return None
    time = table.table("time")
    time.only(["column", "unit", "format"])
    if ("unit" in time.values) == ("format" in time.values):
        raise time.error("needs either a unit, s or ms, or a format of dates, as of strptime")
    return TimeColumn(
        time.text("column"),
        time.text("unit", "", ["s", "ms"] if "unit" in time.values else []),
        time.text("format", ""),
    )


def _options(database: Database, messages: Table) -> tuple[dict[str, Protection], dict[str, float], dict[str, float]]:
    """Protection, period [s] and delay [s] by message, of all in the table `messages` and of the DBC files."""
    protection: dict[str, Protection] = {}
    delays: dict[str, float] = {}
    periods = {message.name: message.cycle_time / 1000 for message in database.messages if message.cycle_time}
    for name in messages.values:
        message = _message(database, messages, name, name)
        options = messages.table(name)
        options.only(["crc", "counter", "period", "delay", "channel", "sender"])
        for key in ("crc", "counter"):
            if key in options.values:
                _signal(message, options, key, options.text(key))
        crc = options.text("crc", "") or None
        if crc:
            _check_crc(message, options, crc)
        counter = options.text("counter", "") or None
        if counter:
            _check_counter(message, options, counter)
            if counter == crc:
                raise options.error(f"{counter!r} is the crc of {name}: it cannot be its counter too", "counter")
        protection[name] = Protection(crc, counter)
        if "period" in options.values:
            periods[name] = options.number("period", low=1e-4, high=3600)
        if "delay" in options.values:
            delays[name] = options.number("delay", low=-LONGEST_DELAY, high=LONGEST_DELAY)
    return protection, periods, delays


def _origins(database: Database, bus: Table, j1939: bool) -> dict[str, tuple[int | None, int | None]]:
    """(channel, sender) of each message for which the vehicle file says one."""
    common = bus.integer("channel", 0, MOST_CHANNELS) if "channel" in bus.values else None
    found: dict[str, tuple[int | None, int | None]] = {}
    if common is not None:
        found = {message.name: (common, None) for message in database.messages}
    messages = bus.table("messages")
    for name in messages.values:
        options = messages.table(name)
        channel = options.integer("channel", 0, MOST_CHANNELS) if "channel" in options.values else common
        sender = options.integer("sender", 0, 255) if "sender" in options.values else None
        if sender is not None and not (j1939 and database.get_message_by_name(name).is_extended_frame):
            raise options.error('is an address of J1939, which needs identifiers = "j1939" and 29 bits', "sender")
        if (channel, sender) != (None, None):
            found[name] = channel, sender
    return found


def _with_answers(database: Database, requests: tuple[Request, ...], vehicle: Table) -> Database:
    """What has the signals by name: the messages of the DBC files, and those that answers become."""
    known = {message.name for message in database.messages}
    if twice := next((request.name for request in requests if request.name in known), None):
        raise vehicle.error(f"a message of the DBC files is called {twice} too", "request")
    if not requests:
        return database
    named = empty_database(strict=False)
    named.messages[:] = [*database.messages, *(request.message for request in requests)]
    named.refresh()
    return named


def _dbc_files(vehicle: Table) -> list[Path]:
    """The DBC files that a vehicle file names."""
    names = vehicle.texts("dbc", "DBC file names")
    if len(names) > MOST_FILES:
        raise vehicle.error(f"names {len(names)} files, the most are {MOST_FILES}", "dbc")
    for name in names:
        vehicle.check_path("dbc", name)
    try:
        return [find_dbc(name, vehicle.file.parent) for name in names]
    except InputError as error:
        raise vehicle.error(str(error), "dbc") from error


def _sources(database: Database, left_out: LeftOut, roles: Table, known: Collection[str]) -> tuple[Source, ...]:
    """Of all in the table `roles`, which has `known` ones only."""
    roles.only(known)
    return tuple(_source(database, left_out, roles, role) for role in roles.values)


def _source(database: Database, left_out: LeftOut, roles: Table, role: str) -> Source:
    value = roles.values[role]
    options = roles.table(role) if isinstance(value, dict) else None
    if options:
        options.only(["message", "signal", "unit", "scale", "offset"])
        name = options.text("signal")
    else:
        name = roles.text(role)
    where, key = (options, "signal") if options else (roles, role)
    of = options.text("message", "") if options else ""
    for (message_name, signal_name), why in left_out.items():
        if signal_name in (name, "") and of in (message_name, "" if signal_name else None):
            what = f"signal {shown(name)} of {message_name}" if signal_name else f"message {message_name}"
            raise where.error(f"{what} is left out of the DBC file, for it cannot be read: {why}", key)
    if options and "message" in options.values:
        message = _message(database, options, "message", options.text("message"))
        signal = _signal(message, options, "signal", name)
    else:
        found = [(m, s) for m in database.messages for s in m.signals if s.name == name]
        if not found:
            known = [s.name for m in database.messages for s in m.signals]
            raise where.error(f"no message has a signal {shown(name)}{nearest(name, known)}", key)
        if len(found) > 1:
            among = ", ".join(m.name for m, _ in found)
            raise where.error(
                f"signal {shown(name)} stands in several messages ({among}): say which, by message = ...", key
            )
        message, signal = found[0]
    unit = options.text("unit", signal.unit or "") if options else signal.unit or ""
    si = to_si(unit, role)
    if si is None:
        raise where.error(
            f"{name!r} has unit {shown(unit)}, from which {role} [{UNITS[role]}] cannot be had; "
            f"give unit = one of {', '.join(known_units(role))}{nearest(unit, known_units(role)) if unit else ''}",
            key,
        )
    scale = options.number("scale", 1.0, -LARGEST, LARGEST) if options else 1.0
    shift = options.number("offset", 0.0, -LARGEST, LARGEST) if options else 0.0
    if abs(scale) < SMALLEST and options:
        raise options.error(f"must not be 0, nor within {SMALLEST:g} of it, is {scale:g}", "scale")
    conversion = signal.conversion
    factor = float(conversion.scale) * si[0] * scale
    return Source(role, message.name, signal.name, factor, (float(conversion.offset) * si[0] + si[1]) * scale + shift)


def column_sources(database: Database, roles: Table, file: Path) -> tuple[Source, ...]:
    """The sources of `roles` among the columns of the table `file`, each of which is a signal of `database`."""
    try:
        sources = tuple(_source(database, {}, roles, role) for role in roles.values)
        _check_witnesses(sources, roles)
    except InputError as error:
        raise InputError(f"{file}: its columns do not fit: {error}") from error
    return sources


def _check_witnesses(sources: tuple[Source, ...], where: Table) -> None:
    """Roles that are checked against each other have signals of their own: one signal would agree with itself."""
    for group in (VOLTAGES, CURRENTS, SPEEDS):
        played: dict[tuple[str, str], str] = {}
        for source in (source for source in sources if source.role in group):
            other = played.setdefault((source.message, source.signal), source.role)
            if other != source.role:
                raise where.error(
                    f"{source.signal!r} of {source.message} is also {other}; the two are checked against each other",
                    source.role,
                )


def _message(database: Database, where: Table, key: str, name: str) -> Message:
    known = [message.name for message in database.messages]
    if name not in known:
        raise where.error(f"there is no message {shown(name)}{nearest(name, known)}", key)
    return database.get_message_by_name(name)


def _signal(message: Message, where: Table, key: str, name: str) -> Signal:
    known = [signal.name for signal in message.signals]
    if name not in known:
        raise where.error(f"message {message.name} has no signal {shown(name)}{nearest(name, known)}", key)
    return message.get_signal_by_name(name)


def _check_crc(message: Message, where: Table, name: str) -> None:
    signal = message.get_signal_by_name(name)
    if signal.length != 8 or signal.start // 8 != message.length - 1:
        raise where.error(f"{name!r} must be the last byte of {message.name}, all 8 bits of it", "crc")


def _check_counter(message: Message, where: Table, name: str) -> None:
    signal = message.get_signal_by_name(name)
    if signal.is_signed or signal.conversion.is_float or signal.multiplexer_ids is not None or signal.length < 2:
        raise where.error(f"{name!r} must be an unsigned integer of 2 bits or more, in every {message.name}", "counter")


def _check_groups(database: Database, where: Table) -> None:
    seen: dict[int, str] = {}
    for message in database.messages:
        if message.is_extended_frame:
            other = seen.setdefault(pgn(message.frame_id), message.name)
            if other != message.name:
                raise where.error(
                    f"{other} and {message.name} have the same parameter group number {pgn(message.frame_id)}: "
                    'one can be told from the other only by identifiers = "exact"',
                    "identifiers",
                )


def pgn(identifier: int) -> int:
    """The parameter group number of a 29-bit identifier (SAE J1939-21): destinations do not belong to it."""
    group = identifier >> 8 & 0x3FFFF
    return group if group & 0xFF00 >= 0xF000 else group & 0x3FF00
