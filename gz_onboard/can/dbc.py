"""Find DBC files, and read several into one cantools database."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Collection, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from gz_onboard.errors import InputError, nearest, shown
from gz_onboard.events import EFF_FLAG, MOST_EXTENDED, MOST_STANDARD
from gz_onboard.imports import without
from gz_onboard.toml import is_file, read_text

if TYPE_CHECKING:
    from cantools.database.can import Database, Message
    from cantools.database.can.signal import Signal

FARTHEST = 1e30  # of a limit of a signal; some editors write out those of its type
LARGEST_DBC = 8_000_000  # bytes; those of whole cars have one or two million
_VALUE_NAMES = re.compile(
    r"""^[ \t]* VAL_ \s (?:
        [^;"\n] | \n (?= \s* [-\d";] )  # numbers, also on the next line
        | " (?: \\. | [^"\\\n] | \n (?! [ \t]* [A-Z_]+_\b ) )* "  # a text that ends before the next statement
    )* ;""",
    re.M | re.X,
)
"""They are of no use for reading, and cantools refuses those of signals that are not there."""
_WIDE = re.compile(r"\b((?:BO_|SG_|VAL_|SIG_VALTYPE_|SG_MUL_VAL_|BO_TX_BU_|SIG_GROUP_)\s+)(\d{4,9})\b")
_MESSAGE_NUMBER = re.compile(r"^[ \t]*BO_[ \t]+(\d{4,9})\b", re.M)
_BUS_LINE = re.compile(r"^[ \t]*BS_[ \t]*:", re.M)
_BELOW_BUS_LINE = re.compile(r"^[ \t]*(?:BU_[ \t]*:|BO_[ \t]+\d+[ \t]+\w+[ \t]*:)", re.M)
LONGEST_PROBLEM = 400  # letters of what cantools says, which may quote a whole line
SMALLEST, LARGEST = 1e-12, 1e12  # a scale or an offset
_END = '\nCM_ "";\n'  # an empty comment: a last statement that is cut off is none to cantools, one in between is wrong
_HUGE = re.compile(
    r"""^\s* (?: BO_ \s+ \d+ \s+ (\w+) \s*:\s* \d{3} | SG_ \s+ (\w+) [^:\n"]* :\s* (?:\d{4} | \d+ \s*\|\s* \d{4}))""",
    re.M | re.X,
)
"""Begins a message of 100 bytes or more, or a signal with bits of four digits, over which cantools takes gigabytes."""
_MESSAGE_NAME = re.compile(r"\s*BO_\s+\d+\s+(\w+)")
_SIGNAL_NAME = re.compile(r"\s*SG_\s+([^\s:]+)")
_DECIDES_OTHERS = re.compile(r"\s*(SIG_VALTYPE_|SG_MUL_VAL_|BO_TX_BU_)")  # without it another signal is read otherwise
MOST_BROKEN = 20  # lines: a file with more is not DBC
MOST_SAID = 5  # problems in one warning

_FORMATS = "cantools.database.can.formats"
_UNUSED = (
    "cantools.tester",  # imports python-can: 9 MB
    "cantools.logreader",
    "cantools.database.diagnostics",
    *(f"{_FORMATS}.{other}" for other in ("arxml", "arxml.node_specifics", "kcd", "sym")),
    "importlib.metadata",
)
"""Parts of cantools that DBC files do not need: half of its import."""

_LOG = logging.getLogger(__name__)
_PACKAGE = Path(__file__).resolve().parent.parent


def find_dbc(name: str, folder: Path | None = None) -> Path:
    """The path of the DBC file `name`: in `folder`, or one that comes with this package."""
    folders = [*([folder] if folder else []), _PACKAGE / "dbc", _PACKAGE.parent / "dbc"]
    if found := next((one / name for one in folders if is_file(one / name)), None):
        return found
    if Path(name).is_dir():
        raise InputError(f"{name}: is a folder; give the DBC file in it")
    known = [file.name for one in folders if one.is_dir() for file in one.glob("*.dbc")]
    raise InputError(f"{name}: no such DBC file in {folder or 'the current folder'} or in dbc/{nearest(name, known)}")


def empty_database(strict: bool = True) -> Database:
    """A cantools database, to which DBC files are added; `strict`: signals must fit and may not overlap."""
    logging.getLogger("cantools").setLevel(logging.ERROR)  # its warnings are errors here
    with without(*_UNUSED):
        from cantools.database.can import Database
    return Database(strict=strict)


LeftOut = dict[tuple[str, str], str]
"""(message, signal) -> why it was left out, with its file and line."""


def load_database(files: list[Path], left_out: LeftOut | None = None) -> Database:
    """One cantools database out of several DBC files.

    left_out: leave out the signals, messages and lines that cantools refuses; they are added to it, and a warning says
    so once. InputError naming file and line for a file that is not valid DBC (without `left_out`, at the first fault),
    and for messages that cannot be told apart.
    """
    return database_of([(file, read_dbc(file)) for file in files], left_out)


def database_of(texts: Sequence[tuple[Path, str]], left_out: LeftOut | None = None) -> Database:
    """`load_database` of files that are read already: their names and texts."""
    database = empty_database()
    origin: dict[str, tuple[_DbcFile, str]] = {}  # by name and by identifier
    for name, text in texts:
        file = _DbcFile(name, text, left_out)
        messages = file.messages()
        if not messages:
            raise InputError(f"{name}:1: not a valid DBC file: it has no message")
        for message in messages:
            identifier = f"identifier {message.frame_id:#x}{' (29 bits)' if message.is_extended_frame else ''}"
            for key in (f"name {message.name!r}", identifier):
                if key in origin:
                    other, its_name = origin[key]
                    where = f"{other.name}:{other.line_of(its_name)}"
                    raise file.invalid(f"{key} of message {message.name} is also that of {its_name} in {where}")
                origin[key] = file, message.name
        database.messages.extend(messages)
    database.refresh()
    return database


class _DbcFile:
    """Reads one DBC file. left_out: as of `load_database`."""

    def __init__(self, name: Path, text: str, left_out: LeftOut | None) -> None:
        self.name = name
        if left_out is not None:
            text = _VALUE_NAMES.sub(lambda found: "\n" * found[0].count("\n"), text)  # lines keep their numbers
        self._lines = _completed(name, text).split("\n")
        self._left_out = left_out
        self._said: dict[str, None] = {}  # each problem once, with its line

    def messages(self) -> list[Message]:
        """The usable messages. A warning lists the parts that were left out."""
        if huge := _HUGE.search(self._text):
            line = self._text.count("\n", 0, huge.end()) + 1
            raise self.invalid(f"{huge[1] or huge[2]} at line {line} goes beyond the longest frame, of 64 bytes")
        messages = [self._without_bad_signals(message) for message in self._parsed().messages]
        if said := list(self._said):
            more = f"; and {len(said) - MOST_SAID} more" if len(said) > MOST_SAID else ""
            _warn_once(f"{self.name}: what cannot be read of it is left out: {'; '.join(said[:MOST_SAID])}{more}")
        return messages

    def invalid(self, problem: str) -> InputError:
        """The error about this file, with the line that `problem` names, or that of the message it names."""
        numbered = re.search(r"line (\d+)", problem)
        if numbered and int(numbered[1]) > len(self._lines):  # in `_END`, behind the file
            lines = self._text.rstrip().split("\n")
            problem = f"it ends within a statement; its last line is {shown(lines[-1].strip())}. Is the file whole?"
            return InputError(f"{self.name}:{len(lines)}: not a valid DBC file: {problem}")
        named = re.search(r"message (\w+)", problem)
        line = numbered[1] if numbered else self.line_of(named[1]) if named else None
        return InputError(f"{self.name}{f':{line}' if line else ''}: not a valid DBC file: {_shortened(problem)}")

    def line_of(self, message: str) -> int:
        """The line on which the last message of this name stands; 0 if there is none."""
        found = list(re.finditer(rf"^\s*BO_ +\d+ +{re.escape(message)}\s*:", self._text, re.M))
        return self._text.count("\n", 0, found[-1].end()) + 1 if found else 0

    @property
    def _text(self) -> str:
        return "\n".join(self._lines)

    def _parsed(self) -> Database:
        """The file as cantools reads it, without the lines that it refuses."""
        problems: list[str] = []
        while True:
            database = empty_database(strict=False)
            try:
                database.add_dbc_string(self._text + _END)
                return database
            except Exception as error:  # cantools and textparser raise a dozen types
                kind, said = type(error).__name__, str(error)
                unforeseen = isinstance(error, LookupError)  # by cantools, which has not met such a file
                problems.append(f"cantools cannot read it ({kind}: {said})" if unforeseen else said or kind)
                if self._left_out is None or len(problems) > MOST_BROKEN or not self._leave_out(problems[-1]):
                    raise self.invalid(problems[0]) from error

    def _leave_out(self, problem: str) -> bool:
        """Blank the line that cantools' `problem` names, and behind a message its signals: the message before must not
        get them. False if the line is not known or decides how others are read.
        """
        syntax = re.search(r"line (\d+), column", problem)
        at = int(syntax[1]) - 1 if syntax else len(self._lines)
        if at >= len(self._lines) or not self._lines[at].strip() or _DECIDES_OTHERS.match(self._lines[at]):
            return False
        end = at + 1
        while self._lines[at].lstrip().startswith("BO_ ") and _SIGNAL_NAME.match("".join(self._lines[end : end + 1])):
            end += 1
        message = next(filter(None, map(_MESSAGE_NAME.match, reversed(self._lines[: at + 1]))), None)
        for i in range(at, end):
            signal = _SIGNAL_NAME.match(self._lines[i])
            self._note(message[1] if message else "", signal[1] if signal else "", at + 1, problem)
            self._lines[i] = ""
        return True

    def _without_bad_signals(self, message: Message) -> Message:
        """Take from `message` the signals that overlap, do not fit or are not finite numbers."""
        period = message.cycle_time
        if period and not (isinstance(period, int | float) and 0.1 <= period <= 3.6e6):
            problem = f"the cycle time is {shown(period)} ms, outside 0.1 to 3600000,"
            raise self.invalid(f"{problem} in message {message.name}")
        for signal in message.signals[:]:
            if fault := _signal_problem(signal):
                self._drop(message, {signal.name}, f"{fault} in message {message.name}")
        while True:
            try:
                message.refresh(strict=True)
                return message
            except Exception as error:
                named = re.search(r"signals? (\w+)(?: and (\w+))?", str(error))
                if not named or not self._drop(message, set(named.groups()), str(error)):
                    raise self.invalid(str(error)) from error

    def _drop(self, message: Message, names: Collection[str | None], problem: str) -> bool:
        """Take the signals of these names from `message`; False if there are no such signals."""
        dropped = [signal for signal in message.signals if signal.name in names]
        for signal in dropped:
            message.signals.remove(signal)
            self._note(message.name, signal.name, self.line_of(message.name), problem)
        return bool(dropped)

    def _note(self, message: str, signal: str, line: int, problem: str) -> None:
        if self._left_out is None:
            raise self.invalid(problem)
        problem = f"line {line}: {_shortened(problem)}"
        self._said[problem] = None
        if signal:
            self._left_out[message, signal] = f"{self.name}, {problem}"


def _shortened(problem: str) -> str:
    return problem if len(problem) <= LONGEST_PROBLEM else f"{problem[:LONGEST_PROBLEM]} ..."


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
    numbers = dict.fromkeys(_MESSAGE_NUMBER.findall(text))
    wide = [number for number in numbers if MOST_STANDARD < int(number) <= MOST_EXTENDED]
    if wide:
        text = _WIDE.sub(lambda at: at[1] + str(int(at[2]) | EFF_FLAG) if at[2] in wide else at[0], text)
        said = ", ".join(f"{int(number):#x}" for number in wide[:MOST_SAID])
        more = f" and {len(wide) - MOST_SAID} more" if len(wide) > MOST_SAID else ""
        _warn_once(f"{file}: identifiers above 0x7ff are read as 29 bits, though bit 31 is not set: {said}{more}")
    return text


def _signal_problem(signal: Signal) -> str | None:
    """The fault of a signal's place, scale or limits that makes it unfit for calculation, if there is one."""
    scale, offset = signal.conversion.scale, signal.conversion.offset
    low, high = signal.minimum, signal.maximum
    problems = {
        f"has {signal.length} bits from bit {signal.start} on": signal.start < 0 or signal.length < 1,
        f"is a float of {signal.length} bits": signal.conversion.is_float and signal.length not in (32, 64),
        f"has a scale of {shown(scale)}": not SMALLEST <= abs(scale) <= LARGEST,
        f"has an offset of {shown(offset)}": not abs(offset) <= LARGEST,
        f"has the limits {shown(low)} to {shown(high)}": low is not None
        and high is not None
        and not -math.inf < low <= high < math.inf,
    }
    return next((f"signal {signal.name} {problem}" for problem, is_so in problems.items() if is_so), None)
