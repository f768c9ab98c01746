"""DBC files: where they are, and one cantools database out of several."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import TYPE_CHECKING

from gz_onboard.errors import InputError, nearest, shown
from gz_onboard.toml import is_file, read_text

if TYPE_CHECKING:
    from cantools.database.can import Database, Message

LARGEST_DBC = 8_000_000  # bytes; those of whole cars have one or two million
LONGEST_FRAME = 64  # bytes, of CAN FD
FARTHEST = 1e30  # a limit of a signal; those of 64 bits are written out by some editors
LONGEST_PROBLEM = 400  # letters of what cantools says, which may quote a whole line
SMALLEST, LARGEST = 1e-12, 1e12  # a scale or an offset
_END = '\nCM_ "";\n'  # an empty comment: a last statement that is cut off is none to cantools, one in between is wrong
_MESSAGE_SIZE = re.compile(r"^[ \t]*BO_[ \t]+\d+[ \t]+(\w+)[ \t]*:[ \t]*(\d+)", re.M)
_SIGNAL_SIZE = re.compile(r"^[ \t]*SG_[ \t]+(\w+)[^:\n\"]*:[ \t]*(\d+)[ \t]*\|[ \t]*(\d+)", re.M)

_PACKAGE = Path(__file__).resolve().parent.parent


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
