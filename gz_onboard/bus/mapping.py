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

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from gz_onboard.bus.units import known_units, to_si
from gz_onboard.errors import InputError, nearest
from gz_onboard.events import ROLES

if TYPE_CHECKING:
    from cantools.database.can import Database, Message
    from cantools.database.can.signal import Signal

    from gz_onboard.toml import Table

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
class Mapping:
    """The bus of one vehicle: its database, and the roles that its signals play."""

    database: Database
    dbc_files: tuple[Path, ...]
    sources: tuple[Source, ...]
    protection: dict[str, Protection]
    periods: dict[str, float]  # s, by message; only where known
    not_available: bool = True
    j1939: bool = False
    roles: tuple[str, ...] = field(default=())


def find_dbc(name: str, beside: Path | None = None) -> Path:
    """The DBC file `name`: a path, or one beside the vehicle file, or one of the project's own."""
    places = [_PACKAGE / "dbc", _PACKAGE.parent / "dbc"]
    if beside:
        places.insert(0, beside)
    for place in places:
        if (place / name).is_file():
            return place / name
    own = [file.name for place in places if place.is_dir() for file in place.glob("*.dbc")]
    raise InputError(f"{name}: no such DBC file beside {beside or 'the vehicle file'} or in dbc/{nearest(name, own)}")


def load_database(files: list[Path]) -> Database:
    """One cantools database out of several DBC files; InputError naming the file that is not a valid one."""
    from cantools.database.can import Database
    from cantools.database.errors import Error

    database = Database()
    for file in files:
        try:
            database.add_dbc_file(str(file))
        except (Error, ValueError, KeyError, OSError, UnicodeDecodeError) as error:
            raise InputError(f"{file}: not a valid DBC file: {error}") from error
        except Exception as error:  # textparser's own; it names line and column
            if type(error).__module__.startswith("textparser"):
                raise InputError(f"{file}: not a valid DBC file: {error}") from error
            raise
    return database


def read_mapping(vehicle: Table) -> Mapping:
    """The bus part of the vehicle file `vehicle`; InputError for whatever does not fit its DBC files."""
    names = vehicle.values.get("dbc")
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise vehicle.error("must be a list of DBC file names", "dbc")
    try:
        files = [find_dbc(name, vehicle.file.parent) for name in names]
    except InputError as error:
        raise vehicle.error(str(error), "dbc") from error
    database = load_database(files)

    bus = vehicle.table("bus")
    bus.only(["not_available", "identifiers", "messages"])
    messages = bus.table("messages")
    protection: dict[str, Protection] = {}
    periods = {message.name: message.cycle_time / 1000 for message in database.messages if message.cycle_time}
    for name in messages.values:
        message = _message(database, messages, name, name)
        options = messages.table(name)
        options.only(["crc", "counter", "period"])
        for key in options.values.keys() & {"crc", "counter"}:
            _signal(message, options, key, options.text(key))
        crc = options.text("crc", "") or None
        if crc:
            _check_crc(message, options, crc)
        protection[name] = Protection(crc, options.text("counter", "") or None)
        if "period" in options.values:
            periods[name] = options.number("period", low=1e-4, high=3600)

    roles = vehicle.table("roles")
    roles.only(ROLES)
    sources = tuple(_source(database, roles, role) for role in roles.values)
    return Mapping(
        database=database,
        dbc_files=tuple(files),
        sources=sources,
        protection=protection,
        periods=periods,
        not_available=bus.text("not_available", "all-ones", ["all-ones", "none"]) == "all-ones",
        j1939=bus.text("identifiers", "exact", ["exact", "j1939"]) == "j1939",
        roles=tuple(source.role for source in sources),
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
            raise where.error(f"no message has a signal {name!r}{nearest(name, known)}", key)
        if len(found) > 1:
            among = ", ".join(m.name for m, _ in found)
            raise where.error(f"signal {name!r} stands in several messages ({among}): say which, by message = ...", key)
        message, signal = found[0]
    unit = options.text("unit", signal.unit or "") if options else signal.unit or ""
    si = to_si(unit, role)
    if si is None:
        raise where.error(
            f"{name!r} has unit {unit!r}, from which {role} [{ROLES[role]}] cannot be had; "
            f"give unit = one of {', '.join(known_units(role))}",
            key,
        )
    scale = options.number("scale", 1.0) if options else 1.0
    shift = options.number("offset", 0.0) if options else 0.0
    conversion = signal.conversion
    factor = float(conversion.scale) * si[0] * scale
    return Source(role, message.name, signal.name, factor, (float(conversion.offset) * si[0] + si[1]) * scale + shift)


def _message(database: Database, where: Table, key: str, name: str) -> Message:
    known = [message.name for message in database.messages]
    if name not in known:
        raise where.error(f"the DBC files have no message {name!r}{nearest(name, known)}", key)
    return database.get_message_by_name(name)


def _signal(message: Message, where: Table, key: str, name: str) -> Signal:
    known = [signal.name for signal in message.signals]
    if name not in known:
        raise where.error(f"message {message.name} has no signal {name!r}{nearest(name, known)}", key)
    return message.get_signal_by_name(name)


def _check_crc(message: Message, where: Table, name: str) -> None:
    signal = message.get_signal_by_name(name)
    if signal.length != 8 or signal.start // 8 != message.length - 1:
        raise where.error(f"{name!r} must be the last byte of {message.name}", "crc")
