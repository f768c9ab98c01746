"""Read recorded frames: our own MCAP, the formats of python-can, and SavvyCAN's, each also gzipped.

The content tells the format; the name only where the content does not. A damaged log is read as far as possible: what
is lost is counted and reported once (`LogDamage`), never silently and never by giving up. Times that are not since 1970
are said in a warning.

A frame has the kernel's identifier flags. The data of a remote frame are as many zero bytes as it asked for. A
CAN FD frame of up to 8 bytes cannot be distinguished from a classic one.
"""

from __future__ import annotations

import hashlib
import json
import logging
import mmap
import re
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import MCAP0_MAGIC

from gz_onboard.errors import CLOSE_FILE, InputError, nearest, shown, unreadable
from gz_onboard.events import MOST_EXTENDED, Frame
from gz_onboard.recording.frames import FD_LENGTHS, TIME_LIMIT_NS, FrameColumns
from gz_onboard.recording.readers import blf, mcap, text
from gz_onboard.recording.readers.contents import Contents, LogDamage, Reader, unpacked

_LOG = logging.getLogger(__name__)

_SAVVYCAN, _TABLE = "SavvyCAN's CSV", "a table"


def _refuse_table(_data: Contents, damage: LogDamage) -> FrameColumns:
    raise InputError(
        f"{damage.path}: is a table of signals, not a log of frames; estimate, validate, calibrate and discover read it"
    )


def _python_can(suffix: str) -> Reader:
    """A reader that imports python-can on first use, which takes 0.1 s."""

    def read(data: Contents, damage: LogDamage) -> FrameColumns:
        from gz_onboard.recording.readers import python_can

        return python_can.read(suffix, data, damage)

    return read


_READERS: dict[str, Reader] = {
    ".mcap": mcap.read,
    ".blf": blf.read,
    ".log": text.read_candump,
    **{suffix: _python_can(suffix) for suffix in (".asc", ".csv", ".trc", ".mf4")},
    _SAVVYCAN: text.read_savvycan,
    _TABLE: _refuse_table,
}
_MAGIC = {b"LOGG": ".blf", MCAP0_MAGIC: ".mcap", b"MDF ": ".mf4", b"PAR1": _TABLE}
_FOREIGN_FORMATS = {
    rb"\xd4\xc3\xb2\xa1|\xa1\xb2\xc3\xd4|\x4d\x3c\xb2\xa1|\xa1\xb2\x3c\x4d|\n\r\r\n": (
        "Wireshark's captures are not read; record with candump -L"
    ),
    rb"SQLite format 3\0": "SQLite databases are not read; python-can's can_logconvert makes a .blf of its own",
    rb"Generic File\0": "CANedge's packed logs are not read; CSS Electronics' mdf2finalized makes an .mf4 of one",
    rb"\*\*\*BUSMASTER": "BUSMASTER's logs are not read; it converts them to .asc",
    rb"time,addr,bus,data": "cabana's logs are not read; save it as SavvyCAN's CSV",
    rb"(?:#[^\n]*\n)*Timestamp;Type;": "logs of the CL2000 and CLX000 are not read; their converter makes a .trc",
}
"""Logs of other tools, by what they begin with, and what to do with them."""
_FIRST_LINES = {
    _SAVVYCAN: text.SAVVYCAN_HEADER,
    ".csv": re.compile(r"timestamp,arbitration_id,"),
    ".asc": re.compile(
        r"\s*base\s+(?:hex|dec)|begin triggerblock|\s*\d+\.\d+\s+(CANFD|\d+)\s+(\d+\s+)?\w+\s+([RT]x|ErrorFrame)\b",
        re.I,
    ),
    ".trc": re.compile(r";\$(FILEVERSION|STARTTIME|COLUMNS)\b"),
    ".log": re.compile(rf"(?:{text.CANDUMP_LINE.pattern})\s*$|\([\d.]+\)\s+\S+\s+[0-9A-Fa-f]+#"),
}
"""What a line of a text log looks like, by format: of its header or its frames."""
_TABLE_HEADER = re.compile(r"(?:.*[,;\t])?\s*\"?(?:time|timestamp|t)(?:\b|_m?s\b)[^,;\t]*[,;\t]", re.I)
ESTIMATED = ".estimate.mcap"
"""The end of the name of what ``gz-onboard estimate`` writes."""
_HEAD = 8192  # bytes within which a text log shows what it is


def read_log(
    path: str | Path,
    start_ns: int | None = None,
    end_ns: int | None = None,
    on_damage: Callable[[LogDamage], None] | None = None,
) -> FrameColumns:
    """Read the frames of a log, in the order of the file.

    start_ns, end_ns: only frames with start_ns <= time < end_ns [ns since the epoch, as in the log]. on_damage is
    called once if something could not be read; without it a warning is logged. Raises InputError for a file that is
    missing or not of the format that its content or name says.
    """
    path = Path(path)
    suffix, damage = log_suffix(path), LogDamage(path)
    frames = _READERS[suffix](unpacked(_load(path), damage), damage)
    impossible = frames.impossible()
    if impossible.any():
        (first,) = frames[np.flatnonzero(impossible)[:1]].tuples()
        damage.add("a frame", _problem(first), int(impossible.sum()))
        frames = frames[~impossible]
    if damage.count and on_damage:
        on_damage(damage)
    elif damage.count:
        _LOG.warning("%s", damage)
    return frames.between(start_ns, end_ns)


def read_frames(
    path: str | Path,
    start_ns: int | None = None,
    end_ns: int | None = None,
    on_damage: Callable[[LogDamage], None] | None = None,
) -> Iterator[list[Frame]]:
    """Read the frames of a log as tuples, in lists of up to a thousand; arguments and errors as of `read_log`."""
    return read_log(path, start_ns, end_ns, on_damage).batches()


def log_suffix(path: Path) -> str:
    """The format of a log, such as ``.blf``, by its content, or else by its name. InputError if it is none we read."""
    head = _head(path)
    if found := _by_content(head):
        return found
    suffixes = [suffix.lower() for suffix in path.suffixes]
    if suffixes[-1:] == [".gz"]:
        suffixes.pop()
    suffix = suffixes[-1] if suffixes else ""
    foreign = next((said for start, said in _FOREIGN_FORMATS.items() if re.match(start, head)), None)
    if foreign:
        raise InputError(f"{path}: is not a log that can be read: {foreign}")
    if suffix not in _READERS:
        if path.is_dir():
            raise InputError(f"{path}: is a folder; give the log in it")
        first = head.partition(b"\n")[0].decode("latin-1").strip()
        raise InputError(
            f"{path}: is not a log that can be read: "
            f"{f'it ends in {suffix!r}' if suffix else 'its name has no suffix that tells its format'}"
            f"{nearest(suffix, _READERS, CLOSE_FILE)}{f', and it begins with {shown(first)}' if first else ''}; "
            f"logs are {_suffixes()}, each also with .gz"
        )
    return suffix


def is_table(path: Path, time: str = "") -> bool:
    """Whether a file is a table of signals instead of a log of frames, by its content.

    time: the name of the column of times, if the vehicle file says it.
    """
    return _by_content(_head(path), time) == _TABLE


def _head(path: Path) -> bytes:
    """The first bytes of a file, unpacked; empty if the file cannot be read."""
    head = b""
    with suppress(OSError), path.open("rb") as file:
        head = file.read(_HEAD)
    if head.startswith(b"\x1f\x8b"):
        with suppress(zlib.error):
            return zlib.decompressobj(wbits=31).decompress(head, _HEAD)
    return head


def _by_content(head: bytes, time: str = "") -> str | None:
    """The format of a file that begins with `head`; None if that is of none."""
    if found := next((form for magic, form in _MAGIC.items() if head.startswith(magic)), None):
        return found
    if b"\0" in head or any(re.match(start, head) for start in _FOREIGN_FORMATS):
        return None
    lines = str(head, "latin-1").removeprefix("\xef\xbb\xbf").split("\n")
    for line in lines:
        if found := next((form for form, first in _FIRST_LINES.items() if first.match(line.strip())), None):
            return found
    first = head.partition(b"\n")[0]
    columns = [name for code in ("utf-8", "latin-1") for name in re.split(r"[,;\t]", str(first, code, "replace"))]
    named = time and time in (name.strip('\ufeff" \r') for name in columns)
    return _TABLE if named or _TABLE_HEADER.match(lines[0]) else None


def logs_among(paths: Iterable[Path], *, estimates: bool | None = False) -> list[Path]:
    """Return `paths`, with the logs of a folder and its subfolders in place of the folder, by name, each log once.

    InputError for a folder without any.

    CSV and text files of a folder are skipped, as they are mostly something else, and so is what ``gz-onboard
    estimate`` wrote. estimates: take that in place of the logs that it is of; None: take both.
    """
    logs: list[Path] = []
    skipped = (".csv", ESTIMATED) if estimates is False else (".csv",)
    for path in paths:
        if not path.is_dir():
            logs.append(path)
            continue
        files = sorted(file for file in path.rglob("*") if file.is_file() and "/." not in f"/{file.relative_to(path)}")
        found = [f for f in files if _name(f).endswith(tuple(_READERS)) and not _name(f).endswith(skipped)]
        if estimates:
            made = {
                file.with_name(file.name.removesuffix(ESTIMATED)) for file in found if file.name.endswith(ESTIMATED)
            }
            found = [file for file in found if file.with_name(log_stem(file)) not in made]
        if not found:
            tables = (file for file in files if _name(file).endswith((".csv", ".txt", ".parquet")) and is_table(file))
            table = next((file.relative_to(path) for file in tables), None)
            hint = f"; its tables must be given one by one, such as {table}" if table else ""
            raise InputError(f"{path}: this folder holds no log ({_suffixes()}){hint}")
        logs += found
    return list(dict.fromkeys(logs))


def digest_of(file: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal. InputError if it cannot be read."""
    try:
        with file.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise unreadable(file, error) from None


def log_stem(log: Path) -> str:
    """The name of a log without its suffixes."""
    return (log.with_suffix("") if log.suffix.lower() == ".gz" else log).stem


def _suffixes() -> str:
    """The suffixes of logs, for messages."""
    return ", ".join(name for name in _READERS if name.startswith("."))


def _name(file: Path) -> str:
    """The name by which a file in a folder is a log or a table."""
    return file.name.lower().removesuffix(".gz")


def read_attachments(path: str | Path) -> dict[str, bytes]:
    """The files attached to one of our own logs by name, such as the DBC files; of other formats none."""
    own = _own(LogDamage(Path(path)))
    return own.attachments if own else {}


def read_metadata(path: str | Path, record: str = "gz_onboard") -> dict[str, str]:
    """The metadata of one of our own logs (vehicle, version, ...), or another record of it; of other formats none."""
    own = _own(LogDamage(Path(path)))
    return own.metadata.get(record, {}) if own else {}


def json_channels(path: str | Path) -> dict[str, tuple[bytes, dict[str, str]]]:
    """Schema (a JSON text) and metadata of each topic of samples in one of our own logs; of other formats none."""
    if not (own := _own(LogDamage(Path(path)))):
        return {}
    if not own.channels:  # only the chunks of a log that was cut off declare them
        deque(own.messages(), maxlen=0)
    found = (channel for channel in own.channels.values() if channel.message_encoding == "json")
    return {channel.topic: (own.schemas.get(channel.schema_id, b"{}"), channel.metadata) for channel in found}


def read_samples(
    path: str | Path,
    start_ns: int | None = None,
    end_ns: int | None = None,
    on_damage: Callable[[LogDamage], None] | None = None,
) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """Yield topic, time [ns] and values of each sample in one of our own logs, in the order of the file.

    Logs in other formats have no samples. start_ns, end_ns, on_damage: see `read_log`; without on_damage nothing is
    reported, because reading the frames of the same log reports the damage.
    """
    damage = LogDamage(Path(path))
    own = _own(damage)
    for message in own.messages() if own else ():
        topic, time_ns = message.channel.topic, message.published_ns
        if message.channel.message_encoding != "json":
            continue
        if (latest := max(message.logged_ns, time_ns)) >= TIME_LIMIT_NS:
            damage.add(f"a sample of {topic}", f"{latest} ns is no time")
        elif (start_ns or 0) <= time_ns < (TIME_LIMIT_NS if end_ns is None else end_ns):
            with suppress(ValueError, RecursionError):
                if isinstance(values := json.loads(message.data), dict):
                    yield topic, time_ns, values
    if damage.count and on_damage:
        on_damage(damage)


def _own(damage: LogDamage) -> mcap.LogContents | None:
    """Open a log in our own format; None if it has another. Raises InputError for a missing file."""
    form, data = log_suffix(damage.path), _load(damage.path)
    return mcap.LogContents(unpacked(data, damage), damage) if form == ".mcap" else None


def _load(path: Path) -> Contents:
    try:
        with path.open("rb") as file:
            if not path.stat().st_size:
                raise InputError(f"{path}: is empty, a file of 0 bytes; copy or record it again")
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise unreadable(path, error) from None


def _problem(frame: Frame) -> str:
    """The reason why no bus carries this frame."""
    time_ns, identifier, data, _ = frame
    if time_ns < 0:
        return f"{time_ns} ns is no time"
    if len(data) not in FD_LENGTHS:
        return f"no frame has {len(data)} bytes"
    return f"identifier {identifier & MOST_EXTENDED:X} has more than 11 bits"
