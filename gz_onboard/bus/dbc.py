"""DBC files: where they are, and one cantools database out of several."""

from __future__ import annotations

import logging
import math
import re
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from gz_onboard.errors import InputError, nearest, shown
from gz_onboard.events import EFF_FLAG, MOST_EXTENDED, MOST_STANDARD
from gz_onboard.toml import is_file, read_text

if TYPE_CHECKING:
    from cantools.database.can import Database, Message
    from cantools.database.can.signal import Signal

FARTHEST = 1e30  # of a limit of a signal; some editors write out those of its type
LARGEST_DBC = 8_000_000  # bytes; those of whole cars have one or two million
LONGEST_FRAME = 64  # bytes, of CAN FD
_WIDE = re.compile(r"\b(BO_|SG_|VAL_|SIG_VALTYPE_|SG_MUL_VAL_|BO_TX_BU_|SIG_GROUP_)(\s+)(\d{4,9})\b")
_BUS_LINE = re.compile(r"^[ \t]*BS_[ \t]*:", re.M)
_BELOW_BUS_LINE = re.compile(r"^[ \t]*(?:BU_[ \t]*:|BO_[ \t]+\d+[ \t]+\w+[ \t]*:)", re.M)
LONGEST_PROBLEM = 400  # letters of what cantools says, which may quote a whole line
SMALLEST, LARGEST = 1e-12, 1e12  # a scale or an offset
_END = '\nCM_ "";\n'  # an empty comment: a last statement that is cut off is none to cantools, one in between is wrong
_MESSAGE_SIZE = re.compile(r"^[ \t]*BO_[ \t]+\d+[ \t]+(\w+)[ \t]*:[ \t]*(\d+)", re.M)
_SIGNAL_SIZE = re.compile(r"^[ \t]*SG_[ \t]+(\w+)[^:\n\"]*:[ \t]*(\d+)[ \t]*\|[ \t]*(\d+)", re.M)

_MESSAGE_NAME = re.compile(r"\s*BO_\s+\d+\s+(\w+)")
_SIGNAL_NAME = re.compile(r"\s*SG_\s+([^\s:]+)")
_DECIDES_OTHERS = re.compile(r"\s*(SIG_VALTYPE_|SG_MUL_VAL_|BO_TX_BU_)")  # without it another signal is read otherwise
_UNENDED = re.compile(r"\s*(CM_|VAL_|BA_)\s.*[^;\s]\s*")  # a statement on one line whose end is missing
MOST_BROKEN = 20  # lines: what has more is another kind of file
MOST_SAID = 5  # of what is left out

_LOG = logging.getLogger(__name__)
_PACKAGE = Path(__file__).resolve().parent.parent


def find_dbc(name: str, beside: Path | None = None) -> Path:
    """The DBC file `name`: a path, or one beside the vehicle file, or one of the project's own."""
    places = [_PACKAGE / "dbc", _PACKAGE.parent / "dbc"]
    if beside:
        places.insert(0, beside)
    for place in places:
        if is_file(place / name):
            return place / name
    if Path(name).is_dir():
        raise InputError(f"{name}: is a folder; give the DBC file in it")
    own = [file.name for place in places if place.is_dir() for file in place.glob("*.dbc")]
    raise InputError(f"{name}: no such DBC file beside {beside or 'the vehicle file'} or in dbc/{nearest(name, own)}")


def empty_database(strict: bool = True) -> Database:
    """A cantools database, to which DBC files are added; `strict`: signals must fit and may not overlap."""
    logging.getLogger("cantools").setLevel(logging.ERROR)  # its warnings are of what is an error here
    hidden = {"cantools.tester": ModuleType("cantools.tester")} if "cantools" not in sys.modules else {}
    sys.modules.update(hidden)  # it imports python-can: 9 MB, and a fifth of the daemon's start
    try:
        from cantools.database.can import Database
    finally:
        for name in hidden:
            del sys.modules[name]
    return Database(strict=strict)


LeftOut = dict[tuple[str, str], str]
"""(message, signal) -> why it was left out, with its file and line."""


def load_database(files: list[Path], left_out: LeftOut | None = None) -> Database:
    """One cantools database out of several DBC files.

    left_out: leave out the signals, messages and lines that cantools refuses; they are added to it, and a warning says
    so once. InputError naming file and line for what is not a valid DBC file (without `left_out`, for all of them),
    and for messages that cannot be told apart.
    """
    return database_of([(file, read_dbc(file)) for file in files], left_out)


def database_of(texts: Sequence[tuple[Path, str]], left_out: LeftOut | None = None) -> Database:
    """`load_database` of files that are read already: their names and texts."""
    database = empty_database()
    origin: dict[str, tuple[Path, str, str]] = {}  # by name and by identifier
    for file, original in texts:
        text = _completed(file, original)
        before = len(database.messages)
        try:
            _add(database, file, text)
        except InputError as error:
            if left_out is None:
                raise
            database.messages[before:] = _Lenient(file, text, left_out, error).messages()
            database.refresh()
        if len(database.messages) == before:
            raise InputError(f"{file}:1: not a valid DBC file: it has no message")
        for message in database.messages[before:]:
            identifier = f"identifier {message.frame_id:#x}{' (29 bits)' if message.is_extended_frame else ''}"
            for key in (f"name {message.name!r}", identifier):
                if key in origin:
                    other, its_text, name = origin[key]
                    where = f"{other}:{_message_line(its_text, name)}"
                    raise _invalid(file, text, f"{key} of message {message.name} is also that of {name} in {where}")
                origin[key] = file, text, message.name
    return database


def _add(database: Database, file: Path, text: str) -> None:
    """Add the messages of a file to `database`; InputError for what cantools, or who calculates with it, refuses."""
    before = len(database.messages)
    if size := _impossible_size(text):
        raise _invalid(file, text, size[1])
    try:
        database.add_dbc_string(text + _END)
    except LookupError as error:  # of cantools' own code, which has not met such a file
        raise _invalid(file, text, f"cantools cannot read it ({type(error).__name__}: {error})") from error
    except Exception as error:  # cantools and textparser raise a dozen types on what is not valid
        raise _invalid(file, text, str(error) or type(error).__name__) from error
    for message in database.messages[before:]:
        problem = _period_problem(message) or next(filter(None, map(_signal_problem, message.signals)), None)
        if problem:
            raise _invalid(file, text, f"{problem} in message {message.name}")


class _Lenient:
    """What can be used of a DBC file that was refused, by the error `refused`."""

    def __init__(self, file: Path, text: str, left_out: LeftOut, refused: InputError) -> None:
        self._file = file
        self._lines = text.split("\n")
        self._all = left_out
        self._refused = refused
        self._broken = 0  # lines that are no DBC
        self._said: dict[str, None] = {}  # what is wrong, with its line, once each

    def messages(self) -> list[Message]:
        """The messages without what was left out, of which a warning tells. InputError if it cannot be found out."""
        while size := _impossible_size(self._text):
            self._leave_out(*size)
        while True:
            database = empty_database(strict=False)
            try:
                database.add_dbc_string(self._text + _END)
                break
            except Exception as error:
                self._mend(str(error))
        kept = [message for message in database.messages if self._fitting(message)]
        said = list(self._said)
        more = f"; and {len(said) - MOST_SAID} more" if len(said) > MOST_SAID else ""
        _warn_once(f"{self._file}: what cannot be read of it is left out: {'; '.join(said[:MOST_SAID])}{more}")
        return kept

    @property
    def _text(self) -> str:
        return "\n".join(self._lines)

    def _mend(self, problem: str) -> None:
        """Leave out the lines that cantools' `problem` names. Raises what refused the file if they are not known."""
        if syntax := re.search(r"line (\d+), column (\d+)", problem):
            at, self._broken = int(syntax[1]) - 1, self._broken + 1
            if self._broken > MOST_BROKEN or at >= len(self._lines) or _DECIDES_OTHERS.match(self._lines[at]):
                raise self._refused  # what follows a cut end might decide how others are read
            before = next((i for i in range(at - 1, -1, -1) if self._lines[i].strip()), 0)
            if syntax[2] == "1" and _UNENDED.fullmatch(self._lines[before]):
                at = before
            self._leave_out(at, problem)
        elif wide := re.search(r"(?:Standard|Extended) frame id .* in message (\w+)", problem):
            self._leave_out((_message_line(self._text, wide[1]) or 0) - 1, problem)
        elif unused := re.findall(r"^\s*(VAL_ \d+ \w+)$", problem, re.M):
            for start in unused:
                pattern = re.compile(rf"\s*{start.replace(' ', ' +')}\b")
                at = next((i for i, line in enumerate(self._lines) if pattern.match(line)), -1)
                self._leave_out(at, f"there is no signal for {start}")
        else:
            raise self._refused

    def _leave_out(self, at: int, problem: str) -> None:
        """Blank the line of index `at`, and of a message its signals too: the message before must not get them."""
        line = self._lines[at] if at >= 0 else ""
        if not line.strip():
            raise self._refused
        end = at + 1
        if line.lstrip().startswith("BO_ "):
            while end < len(self._lines) and (not self._lines[end].strip() or _SIGNAL_NAME.match(self._lines[end])):
                end += 1
        messages = filter(None, map(_MESSAGE_NAME.match, reversed(self._lines[: at + 1])))
        message = next(messages, None) if line.lstrip().startswith(("BO_ ", "SG_ ")) else None
        for i in range(at, end):
            signal = _SIGNAL_NAME.match(self._lines[i])
            self._note(message[1] if message else "", signal[1] if signal else "", at + 1, problem)
            self._lines[i] = ""

    def _fitting(self, message: Message) -> bool:
        """Take from `message` the signals that overlap, do not fit or are no numbers; whether it can be used then."""
        line = _message_line(self._text, message.name) or 0
        if problem := _period_problem(message):
            raise _invalid(self._file, self._text, f"{problem} in message {message.name}")
        for signal in message.signals[:]:
            if problem := _signal_problem(signal):
                self._drop(message, {signal.name}, line, f"{problem} in message {message.name}")
        while True:
            try:
                message.refresh(strict=True)
            except Exception as error:
                names = set(re.search(r"signals? (\w+)(?: and (\w+))?", str(error)).groups())  # type: ignore[union-attr]
                if not any(signal.name in names for signal in message.signals):
                    for name in ("", *(signal.name for signal in message.signals)):
                        self._note(message.name, name, line, str(error))
                    return False
                self._drop(message, names, line, str(error))
            else:
                return True

    def _drop(self, message: Message, names: set[str | None], line: int, problem: str) -> None:
        for signal in [signal for signal in message.signals if signal.name in names]:
            message.signals.remove(signal)
            self._note(message.name, signal.name, line, problem)

    def _note(self, message: str, signal: str, line: int, problem: str) -> None:
        problem = f"line {line}: {problem if len(problem) <= LONGEST_PROBLEM else f'{problem[:LONGEST_PROBLEM]} ...'}"
        self._said[problem] = None
        if message:
            self._all[message, signal] = f"{self._file}, {problem}"


@cache
def _warn_once(text: str) -> None:
    _LOG.warning("%s", text)


def read_dbc(file: Path) -> str:
    """The text of a DBC file; most editors write the second of these encodings."""
    return read_text(file, LARGEST_DBC, ("utf-8-sig", "cp1252", "latin-1"))


def _completed(file: Path, text: str) -> str:
    """`text` as cantools needs it, line by line: with `BS_:`, which some editors omit, and with bit 31 of wide
    identifiers, without which no other meaning is possible; a warning tells of these.
    """
    if not _BUS_LINE.search(text) and (below := _BELOW_BUS_LINE.search(text)) and below.start():
        text = f"{text[: below.start() - 1]} BS_:{text[below.start() - 1 :]}"  # it ends the list of NS_
    wide = []

    def with_bit_31(found: re.Match[str]) -> str:
        identifier = int(found[3])
        if not MOST_STANDARD < identifier <= MOST_EXTENDED:
            return found[0]
        if found[1] == "BO_" and found.start() == text.rfind("\n", 0, found.start()) + 1:
            wide.append(identifier)
        return f"{found[1]}{found[2]}{identifier | EFF_FLAG}"

    text = _WIDE.sub(with_bit_31, text)
    if wide:
        numbers = ", ".join(f"{identifier:#x}" for identifier in wide[:MOST_SAID])
        more = f" and {len(wide) - MOST_SAID} more" if len(wide) > MOST_SAID else ""
        _warn_once(f"{file}: identifiers above 0x7ff are read as 29 bits, though bit 31 is not set: {numbers}{more}")
    return text


def _impossible_size(text: str) -> tuple[int, str] | None:
    """(index of its line, what is wrong) of a layout that no frame has; cantools would take gigabytes over it."""
    for found in _MESSAGE_SIZE.finditer(text):
        if len(found[2]) > 2 or int(found[2]) > LONGEST_FRAME:
            problem = f"message {found[1]} has {shown(found[2])} bytes, the most are {LONGEST_FRAME}"
            return text.count("\n", 0, found.start()), problem
    for found in _SIGNAL_SIZE.finditer(text):
        if any(len(number) > 3 or int(number) > 8 * LONGEST_FRAME for number in (found[2], found[3])):
            line = text.count("\n", 0, found.start())
            return line, f"signal {found[1]} at line {line + 1} reaches beyond the longest frame"
    return None


def _period_problem(message: Message) -> str | None:
    """What is wrong with a message's cycle time."""
    period = message.cycle_time
    if period and not (isinstance(period, int | float) and 0.1 <= period <= 3.6e6):
        return f"the cycle time is {shown(period)} ms, outside 0.1 to 3600000,"
    return None


def _signal_problem(signal: Signal) -> str | None:
    """What of a signal's place and scale is no number that could be calculated with."""
    if signal.start < 0 or signal.length < 1:
        return f"signal {signal.name} has {signal.length} bits from bit {signal.start} on"
    if signal.conversion.is_float and signal.length not in (32, 64):
        return f"signal {signal.name} is a float of {signal.length} bits"
    scale, offset = signal.conversion.scale, signal.conversion.offset
    if not SMALLEST <= abs(scale) <= LARGEST:
        return f"signal {signal.name} has a scale of {shown(scale)}"
    if not abs(offset) <= LARGEST:
        return f"signal {signal.name} has an offset of {shown(offset)}"
    low, high = signal.minimum, signal.maximum
    if low is not None and high is not None and not -math.inf < low <= high < math.inf:
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
    if len(problem) > LONGEST_PROBLEM:
        problem = f"{problem[:LONGEST_PROBLEM]} ..."
    return InputError(f"{file}{f':{line}' if line else ''}: not a valid DBC file: {problem}")


def _message_line(text: str, name: str) -> int | None:
    """The line on which the last message of this name stands."""
    found = list(re.finditer(rf"^\s*BO_ +\d+ +{re.escape(name)}\s*:", text, re.M))
    return text.count("\n", 0, found[-1].end()) + 1 if found else None
