"""Which signal of which message plays which role: the bus part of a vehicle file.

dbc = ["vehicle.dbc", "hbm.dbc"]

[bus]
not_available = "all-ones"        # or "none"
identifiers = "exact"             # or "j1939": 29-bit identifiers are matched by their PGN

[bus.messages.INV_Motion]         # only what the DBC does not say
crc = "INV_MotionCRC"             # CRC-8 SAE J1850 over the bytes before it
counter = "INV_MotionCounter"
period = 0.01                     # s, where the DBC has no GenMsgCycleTime

[roles]
pack_voltage = "BMS_PackVoltage"
pack_current = { signal = "BMS_Current", scale = -1, unit = "A" }
motor_speed = { message = "INV_Motion", signal = "INV_MotorSpeed" }
"""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from gz_onboard.bus.units import known_units, to_si
from gz_onboard.errors import InputError, nearest, shown
from gz_onboard.events import CURRENTS, ROLES, SPEEDS, VOLTAGES
from gz_onboard.toml import is_file, read_text

if TYPE_CHECKING:
    from cantools.database.can import Database, Message
    from cantools.database.can.signal import Signal

    from gz_onboard.toml import Table

LARGEST_DBC = 8_000_000  # bytes; those of whole cars have one or two million
MOST_FILES = 20
LONGEST_FRAME = 64  # bytes, of CAN FD
SMALLEST, LARGEST = 1e-12, 1e12  # a scale or an offset
FARTHEST = 1e30  # a limit of a signal; those of 64 bits are written out by some editors
LONGEST_DELAY = 10.0  # s, of a message
LONGEST_PROBLEM = 400  # letters of what cantools says, which may quote a whole line
_END = '\nCM_ "";\n'  # an empty comment: a last statement that is cut off is none to cantools, one in between is wrong
_MESSAGE_SIZE = re.compile(r"^[ \t]*BO_[ \t]+\d+[ \t]+(\w+)[ \t]*:[ \t]*(\d+)", re.M)
_SIGNAL_SIZE = re.compile(r"^[ \t]*SG_[ \t]+(\w+)[^:\n\"]*:[ \t]*(\d+)[ \t]*\|[ \t]*(\d+)", re.M)

_PACKAGE = Path(__file__).resolve().parent.parent


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
class BusMapping:
    """The bus of one vehicle: its database, and the roles that its signals play."""

    database: Database
    dbc_files: tuple[Path, ...]
    sources: tuple[Source, ...]
    protection: dict[str, Protection]
    periods: dict[str, float]  # s, by message; only where known
    not_available: bool = True
    j1939: bool = False
    delays: dict[str, float] = field(default_factory=dict)  # s, by message: its values are so much older; where stated


def find_dbc(name: str, beside: Path | None = None) -> Path:
    """The DBC file `name`: a path, or one beside the vehicle file, or one of the project's own."""
    places = [_PACKAGE / "dbc", _PACKAGE.parent / "dbc"]
    if beside:
        places.insert(0, beside)
    for place in places:
        if is_file(place / name):
            return place / name
    own = [file.name for place in places if place.is_dir() for file in place.glob("*.dbc")]
    raise InputError(f"{name}: no such DBC file beside {beside or 'the vehicle file'} or in dbc/{nearest(name, own)}")


def empty_database() -> Database:
    """A cantools database, to which DBC files are added."""
    from gz_onboard.bus import _can  # noqa: F401 - before cantools, which would import it with asammdf and pandas

    logging.getLogger("cantools").setLevel(logging.ERROR)  # its warnings are of what is an error here
    from cantools.database.can import Database

    return Database()


def load_database(files: list[Path]) -> Database:
    """One cantools database out of several DBC files.

    InputError naming file and line for what is not a valid DBC file, and for messages that cannot be told apart.
    """
    database = empty_database()
    origin: dict[str, tuple[Path, str]] = {}  # by name and by identifier
    for file in files:
        text = _read_text(file)
        _check_sizes(file, text)
        before = len(database.messages)
        try:
            database.add_dbc_string(text + _END)
        except LookupError as error:  # of cantools' own code, which has not met such a file
            raise _invalid(file, text, f"cantools cannot read it ({type(error).__name__}: {error})") from error
        except Exception as error:  # cantools and textparser raise a dozen types on what is not valid
            raise _invalid(file, text, str(error) or type(error).__name__) from error
        if len(database.messages) == before:
            raise InputError(f"{file}:1: not a valid DBC file: it has no message")
        for message in database.messages[before:]:
            identifier = f"identifier {message.frame_id:#x}{' (29 bits)' if message.is_extended_frame else ''}"
            for key in (f"name {message.name!r}", identifier):
                if key in origin:
                    other, name = origin[key]
                    where = f"{other}:{_message_line(_read_text(other), name)}"
                    raise _invalid(file, text, f"{key} of message {message.name} is also that of {name} in {where}")
                origin[key] = file, message.name
            if problem := _problem(message):
                raise _invalid(file, text, f"{problem} in message {message.name}")
    return database


def _read_text(file: Path) -> str:
    return read_text(file, LARGEST_DBC, ("utf-8-sig", "cp1252", "latin-1"))  # most DBC editors write the second


def _check_sizes(file: Path, text: str) -> None:
    """InputError for a layout that no frame can have; cantools would take minutes and gigabytes over it."""
    for found in _MESSAGE_SIZE.finditer(text):
        if len(found[2]) > 2 or int(found[2]) > LONGEST_FRAME:
            raise _invalid(file, text, f"message {found[1]} has {shown(found[2])} bytes, the most are {LONGEST_FRAME}")
    for found in _SIGNAL_SIZE.finditer(text):
        if any(len(number) > 3 or int(number) > 8 * LONGEST_FRAME for number in (found[2], found[3])):
            line = text.count("\n", 0, found.start()) + 1
            raise _invalid(file, text, f"signal {found[1]} at line {line} reaches beyond the longest frame")


def _problem(message: Message) -> str | None:
    """What of a message's times and scales is no number that could be calculated with."""
    period = message.cycle_time
    if period and not (isinstance(period, int | float) and 0.1 <= period <= 3.6e6):
        return f"the cycle time is {shown(period)} ms, outside 0.1 to 3600000,"
    for signal in message.signals:
        if signal.start < 0 or signal.length < 1:
            return f"signal {signal.name} has {signal.length} bits from bit {signal.start} on"
        scale, offset = signal.conversion.scale, signal.conversion.offset
        if not SMALLEST <= abs(scale) <= LARGEST:
            return f"signal {signal.name} has a scale of {shown(scale)}"
        if not abs(offset) <= LARGEST:
            return f"signal {signal.name} has an offset of {shown(offset)}"
        low, high = signal.minimum, signal.maximum
        if low is not None and high is not None and not -FARTHEST <= low <= high <= FARTHEST:
            return f"signal {signal.name} has the limits {shown(low)} to {shown(high)}"
    return None


def _invalid(file: Path, text: str, problem: str) -> InputError:
    """The error about a DBC file, with the line that `problem` names, or that of the message it names."""
    numbered = re.search(r"line (\d+)", problem)
    if numbered and int(numbered[1]) > text.count("\n") + 1:  # in `_END`, behind the file
        lines = text.rstrip().split("\n")
        problem = f"it ends within a statement; its last line is {shown(lines[-1].strip())}. Is the file whole?"
        return InputError(f"{file}:{len(lines)}: not a valid DBC file: {problem}")
    named = re.search(r"message (\w+)", problem)
    line = numbered[1] if numbered else _message_line(text, named[1]) if named else None
    if wide := re.search(r"Standard frame id (0x[0-9a-f]+) is more than 11 bits", problem):
        problem += f" A DBC writes a 29-bit identifier with bit 31 set: {int(wide[1], 16) | 1 << 31}."
    if len(problem) > LONGEST_PROBLEM:
        problem = f"{problem[:LONGEST_PROBLEM]} ..."
    return InputError(f"{file}{f':{line}' if line else ''}: not a valid DBC file: {problem}")


def _message_line(text: str, name: str) -> int | None:
    """The line on which the last message of this name stands."""
    found = list(re.finditer(rf"^\s*BO_ +\d+ +{re.escape(name)}\s*:", text, re.M))
    return text.count("\n", 0, found[-1].end()) + 1 if found else None


def read_mapping(vehicle: Table) -> BusMapping:
    """The bus part of the vehicle file `vehicle`; InputError for whatever does not fit its DBC files."""
    names = vehicle.texts("dbc", "DBC file names")
    if len(names) > MOST_FILES:
        raise vehicle.error(f"names {len(names)} files, the most are {MOST_FILES}", "dbc")
    for name in names:
        vehicle.check_path("dbc", name)
    try:
        files = [find_dbc(name, vehicle.file.parent) for name in names]
    except InputError as error:
        raise vehicle.error(str(error), "dbc") from error
    database = load_database(files)

    bus = vehicle.table("bus")
    bus.only(["not_available", "identifiers", "messages"])
    messages = bus.table("messages")
    protection: dict[str, Protection] = {}
    delays: dict[str, float] = {}
    periods = {message.name: message.cycle_time / 1000 for message in database.messages if message.cycle_time}
    for name in messages.values:
        message = _message(database, messages, name, name)
        options = messages.table(name)
        options.only(["crc", "counter", "period", "delay"])
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

    j1939 = bus.text("identifiers", "exact", ["exact", "j1939"]) == "j1939"
    if j1939:
        _check_groups(database, bus)
    roles = vehicle.table("roles")
    roles.only(ROLES)
    sources = tuple(_source(database, roles, role) for role in roles.values)
    _check_witnesses(sources, roles)
    return BusMapping(
        database=database,
        dbc_files=tuple(files),
        sources=sources,
        protection=protection,
        periods=periods,
        not_available=bus.text("not_available", "all-ones", ["all-ones", "none"]) == "all-ones",
        j1939=j1939,
        delays=delays,
    )


def _source(database: Database, roles: Table, role: str) -> Source:
    value = roles.values[role]
    options = roles.table(role) if isinstance(value, dict) else None
    if options:
        options.only(["message", "signal", "unit", "scale", "offset"])
        name = options.text("signal")
    else:
        name = roles.text(role)
    where, key = (options, "signal") if options else (roles, role)
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
            f"{name!r} has unit {shown(unit)}, from which {role} [{ROLES[role]}] cannot be had; "
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
        raise where.error(f"the DBC files have no message {shown(name)}{nearest(name, known)}", key)
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
