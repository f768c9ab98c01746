"""Reading recorded frames: our own MCAP and the formats of python-can, each also gzipped.

BLF, candump and our own files have a reader of their own, five to ten times as fast as one that builds a message
object for each frame; the rest is read by python-can. A damaged log is read as far as it can be: what is lost is
counted and told once (`LogDamage`), never silently and never by giving up.

A frame has the kernel's identifier flags. The data of a remote frame are as many zero bytes as it asked for. A
CAN FD frame of up to 8 bytes is not told from a classic one.
"""

from __future__ import annotations

import logging
import mmap
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, cast

from gz_onboard.bus import framelog
from gz_onboard.errors import InputError, nearest
from gz_onboard.events import EFF_FLAG, ERR_FLAG, RTR_FLAG, TRANSMITTED, Frame

if TYPE_CHECKING:
    import can

_LOG = logging.getLogger(__name__)
_BATCH = 1000

_Bytes = bytes | mmap.mmap


@dataclass(frozen=True)
class LogDamage:
    """What could not be read of a log: how many pieces (lines, objects, chunks), and the first of them."""

    path: Path
    count: int
    place: str
    reason: str

    def __str__(self) -> str:
        more = f" and {self.count - 1} more" if self.count > 1 else ""
        return f"{self.path}: {self.place}: {self.reason}{more}: skipped"


class _Damage:
    """Collects the damage of one log while it is read."""

    def __init__(self) -> None:
        self.count = 0
        self.place = ""
        self.reason = ""

    def add(self, place: str, reason: str) -> None:
        if not self.count:
            self.place, self.reason = place, reason
        self.count += 1


def read_frames(
    path: str | Path,
    start_ns: int | None = None,
    end_ns: int | None = None,
    on_damage: Callable[[LogDamage], None] | None = None,
) -> Iterator[list[Frame]]:
    """The frames of a log in the order in which they stand in it, in lists of up to about a thousand.

    start_ns, end_ns: only frames with start_ns <= time < end_ns [ns since the epoch, as in the log].
    on_damage is called once, after the last frame, if something could not be read; without it a warning is logged.
    Raises InputError for a file that is missing or not of the format that its suffix says; a missing file or
    unknown suffix at once, the rest when the first frames are asked for.
    """
    path = Path(path)
    suffix = log_suffix(path)
    data = _load(path)
    return _filtered(path, _READERS[suffix], data, start_ns, end_ns, on_damage or _warn)


def log_suffix(path: Path) -> str:
    """The format of a log by its name, such as ``.blf`` for ``ride.BLF.gz``; InputError if it is none we read."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    if suffixes[-1:] == [".gz"]:
        suffixes.pop()
    suffix = suffixes[-1] if suffixes else ""
    if suffix not in _READERS:
        known = ", ".join(_READERS)
        raise InputError(
            f"{path}: {f'unknown log format {suffix!r}' if suffix else 'a log needs a suffix that tells its format'}"
            f"{nearest(suffix, _READERS) if suffix else ''}; known are {known}, each also with .gz"
        )
    return suffix


def read_attachments(path: str | Path) -> dict[str, bytes]:
    """The files attached to one of our own logs by name, such as the DBC files; of other formats none."""
    path = Path(path)
    if log_suffix(path) != ".mcap":
        return {}
    found = {}
    data = _contents(path, _load(path), _Damage())
    for opcode, start, _ in _mcap_records(path, data, _Damage()):
        if opcode == _ATTACHMENT:
            name, position = _mcap_string(data, start + 16)
            _, position = _mcap_string(data, position)
            (size,) = _U64.unpack_from(data, position)
            found[name] = bytes(data[position + 8 : position + 8 + size])
    return found


def read_metadata(path: str | Path) -> dict[str, str]:
    """The metadata of one of our own logs (vehicle, version, ...); of other formats none."""
    path = Path(path)
    if log_suffix(path) != ".mcap":
        return {}
    data = _contents(path, _load(path), _Damage())
    for opcode, start, end in _mcap_records(path, data, _Damage()):
        if opcode == _METADATA:
            name, position = _mcap_string(data, start)
            if name == "gz_onboard":
                entries = {}
                position += 4
                while position < end:
                    key, position = _mcap_string(data, position)
                    entries[key], position = _mcap_string(data, position)
                return entries
    return {}


def _warn(damage: LogDamage) -> None:
    _LOG.warning("%s", damage)


def _load(path: Path) -> _Bytes:
    try:
        with path.open("rb") as file:
            if not path.stat().st_size:
                return b""
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None


def _contents(path: Path, data: _Bytes, damage: _Damage) -> _Bytes:
    """The log itself: unpacked if gzipped, as far as that can be done."""
    if path.suffix.lower() != ".gz":
        return data
    parts = []
    position = 0
    while position < len(data):
        unpacker = zlib.decompressobj(wbits=31)
        try:
            while not unpacker.eof and position < len(data):
                piece = data[position : position + 65536]
                parts.append(unpacker.decompress(piece))
                position += len(piece) - len(unpacker.unused_data)
        except zlib.error as error:
            if not parts:
                raise InputError(f"{path}: not a gzip file ({error})") from None
            damage.add(f"byte {position}", f"the gzip stream is broken ({error}); nothing after it can be read")
            break
        if not unpacker.eof:
            damage.add(f"byte {len(data)}", "the gzip stream is cut off")
    return b"".join(parts)


def _filtered(
    path: Path,
    reader: Callable[[Path, _Bytes, _Damage, int | None, int | None], Iterator[list[Frame]]],
    data: _Bytes,
    start_ns: int | None,
    end_ns: int | None,
    on_damage: Callable[[LogDamage], None],
) -> Iterator[list[Frame]]:
    damage = _Damage()
    earliest = start_ns if start_ns is not None else -(1 << 63)
    latest = end_ns if end_ns is not None else 1 << 63
    for batch in reader(path, _contents(path, data, damage), damage, start_ns, end_ns):
        if start_ns is None and end_ns is None:
            yield batch
        elif wanted := [frame for frame in batch if earliest <= frame[0] < latest]:
            yield wanted
    if damage.count:
        on_damage(LogDamage(path, damage.count, damage.place, damage.reason))


# --- candump ---------------------------------------------------------------------------------------------------

_CANDUMP_LINE = re.compile(
    r"\((?P<s>\d+)(?:\.(?P<fraction>\d{1,9}))?\)\s+(?P<channel>\S+)\s+(?P<id>[0-9A-Fa-f]{1,8})#"
    r"(?:#(?P<fd>[0-9A-Fa-f](?:[0-9A-Fa-f]{2}){0,64})|[Rr](?P<remote>[0-8]?)|(?P<data>(?:[0-9A-Fa-f]{2}){0,8}))"
    r"(?:\s+(?P<direction>[RrTt]))?"
)
_SCALE = {digits + 1: 10 ** (9 - digits) for digits in range(1, 10)}
"""Length of the fraction with the closing bracket -> ns in a unit of its last digit."""
_TEXT_PIECE = 48 * _BATCH
_FD_LENGTHS = frozenset((*range(9), 12, 16, 20, 24, 32, 48, 64))


class _Identifiers(dict[str, int]):
    """Text of an identifier in a candump -> identifier with flags: more than 3 digits mean 29 bits."""

    def __missing__(self, text: str) -> int:
        value = int(text, 16)
        if len(text) > 3:
            value = value if value & ERR_FLAG else (value & 0x1FFF_FFFF) | EFF_FLAG
        elif value > 0x7FF:
            raise ValueError(f"identifier {text} has more than 11 bits")
        self[text] = value
        return value


class _Channels(dict[str, int]):
    """Name of an interface -> channel: the number that the name ends in, or the next that is free."""

    def __missing__(self, name: str) -> int:
        digits = re.search(r"\d+$", name)
        number = int(digits[0]) if digits else 0
        if number >= TRANSMITTED or number in self.values():
            number = next(free for free in range(TRANSMITTED) if free not in self.values())
        self[name] = number
        return number


def _read_candump(
    path: Path, data: _Bytes, damage: _Damage, _start: int | None, _end: int | None
) -> Iterator[list[Frame]]:
    identifiers = _Identifiers()
    channels = _Channels()
    line = 1
    any_frame = False
    for text in _text_pieces(data):
        batch = _candump_fast(text, identifiers, channels)
        if batch is None:
            batch = _candump_lines(text, line, identifiers, channels, damage)
            if damage.count and not batch and not any_frame:
                raise InputError(f"{path}, {damage.place}: {damage.reason}; no line before it is one either")
        if batch:
            any_frame = True
            yield batch
        line += text.count("\n")


def _text_pieces(data: _Bytes) -> Iterator[str]:
    position = 0
    while position < len(data):
        end = position + _TEXT_PIECE
        if end < len(data):
            end = data.find(b"\n", end) + 1 or len(data)
        yield str(data[position:end], "latin-1")
        position = end


def _candump_fast(text: str, identifiers: _Identifiers, channels: _Channels) -> list[Frame] | None:
    """The frames of whole lines, or None if any line is out of the ordinary."""
    tokens = text.split()
    lines = len(tokens) // 3
    # As many brackets, line ends and triples of words: every line is of the ordinary form, or int() below fails.
    if 3 * lines != len(tokens) or not lines == text.count("(") == text.count(")") == text.count("\n"):
        return None
    frames: list[Frame] = []
    append, scale, unhex = frames.append, _SCALE, bytes.fromhex
    try:
        for stamp, name, frame in zip(tokens[0::3], tokens[1::3], tokens[2::3], strict=True):
            seconds, _, fraction = stamp.partition(".")
            identifier, _, digits = frame.partition("#")
            if len(digits) > 16:
                return None
            append(
                (
                    int(seconds[1:]) * 1_000_000_000 + int(fraction[:-1]) * scale[len(fraction)],
                    identifiers[identifier],
                    unhex(digits),
                    channels[name],
                )
            )
    except (ValueError, LookupError):
        return None
    return frames


def _candump_lines(
    text: str, first: int, identifiers: _Identifiers, channels: _Channels, damage: _Damage
) -> list[Frame]:
    """The frames of lines of any form; lines that are none are noted as damage. first: number of the first line."""
    frames = []
    for number, line in enumerate(map(str.strip, text.split("\n")), first):
        if not line:
            continue
        match = _CANDUMP_LINE.fullmatch(line)
        try:
            if not match:
                raise ValueError("not a line of a candump log")
            frames.append(_candump_frame(match, identifiers, channels))
        except ValueError as error:
            damage.add(f"line {number}", f"{error}: {line[:60]!r}")
    return frames


def _candump_frame(match: re.Match[str], identifiers: _Identifiers, channels: _Channels) -> Frame:
    identifier = identifiers[match["id"]]
    if match["fd"]:
        data = bytes.fromhex(match["fd"][1:])
        if len(data) not in _FD_LENGTHS:
            raise ValueError(f"no CAN FD frame has {len(data)} bytes")
    elif match["remote"] is not None:
        identifier |= RTR_FLAG
        data = bytes(int(match["remote"] or 0))
    else:
        data = bytes.fromhex(match["data"])
    channel = channels[match["channel"]]
    if (match["direction"] or "").upper() == "T":
        channel |= TRANSMITTED
    time_ns = int(match["s"]) * 1_000_000_000 + int((match["fraction"] or "0").ljust(9, "0"))
    return time_ns, identifier, data, channel


# --- BLF -------------------------------------------------------------------------------------------------------
# Layouts as in python-can's can/io/blf.py and Tobias Lorenz' vector_blf.

_BLF_FILE = struct.Struct("<4sL8B2Q2L8H8H")
_BLF_OBJECT = struct.Struct("<4sHHLL")  # signature, header size, header version, object size, object type
_BLF_TIME_1 = struct.Struct("<LHHQ")  # flags, client, object version, time
_BLF_TIME_2 = struct.Struct("<LBxHQ8x")
_BLF_CAN = struct.Struct("<HBBL8s")  # channel, flags, length, identifier, data
_BLF_FD = struct.Struct("<HBBLLBBB5x64s")
_BLF_FD_64 = struct.Struct("<BBBBLLLLLLLHBBL")
_BLF_ERROR = struct.Struct("<HHLBBBxLLH2x8s")
_BLF_CONTAINER, _BLF_CAN_1, _BLF_ERROR_EXT, _BLF_CAN_2, _BLF_FD_1, _BLF_FD_2 = 10, 1, 73, 86, 100, 101
_BLF_TEN_MICROSECONDS = 1
_BLF_ID_MASK = EFF_FLAG | 0x1FFF_FFFF


def _read_blf(path: Path, data: _Bytes, damage: _Damage, _start: int | None, _end: int | None) -> Iterator[list[Frame]]:
    if len(data) < _BLF_FILE.size or data[:4] != b"LOGG":
        raise InputError(f"{path}: not a BLF file: it does not begin with LOGG and a header")
    header = _BLF_FILE.unpack_from(data)
    start_ns = _blf_start(header[14:22])
    position = header[1]
    tail = b""
    while position < len(data):
        signature, size, kind = _blf_container(data, position)
        if signature != b"LOBJ" or size < 32:
            damage.add(f"byte {position}", "no object begins here")
            position = data.find(b"LOBJ", position + 1)
            tail = b""
            if position < 0:
                return
            continue
        end = position + size
        if kind == _BLF_CONTAINER:
            content, whole = _blf_unpack(data, position, min(end, len(data)))
            if end > len(data) or not whole:
                damage.add(f"byte {position}", "a container is cut off or broken")
            frames, tail = _blf_objects(tail + content, start_ns, damage, position)
            if not whole:
                tail = b""
            for i in range(0, len(frames), _BATCH):
                yield frames[i : i + _BATCH]
        position = end + size % 4
    if tail:
        damage.add(f"byte {len(data)}", "the last object is cut off")


def _blf_container(data: _Bytes, position: int) -> tuple[bytes, int, int]:
    """Signature, size and type of the object at the position; an empty signature if there is not enough of it."""
    if position + _BLF_OBJECT.size > len(data):
        return b"", 0, 0
    signature, _, _, size, kind = _BLF_OBJECT.unpack_from(data, position)
    return signature, size, kind


def _blf_start(fields: tuple[int, ...]) -> int:
    """Windows' SYSTEMTIME (UTC) -> ns since the epoch; 0 if there is none."""
    year, month, _, day, hour, minute, second, millisecond = fields
    try:
        start = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return 0
    return int(start.timestamp()) * 1_000_000_000 + millisecond * 1_000_000


def _blf_unpack(data: _Bytes, position: int, end: int) -> tuple[bytes, bool]:
    """The content of a container as far as it can be had, and whether that is all of it."""
    if end < position + 32:
        return b"", False
    method, size = struct.unpack_from("<H6xL", data, position + 16)
    packed = data[position + 32 : end]
    if method == 0:
        return packed, len(packed) >= size
    unpacker = zlib.decompressobj()
    content = b""
    try:
        for i in range(0, len(packed), 4096):  # in pieces, so that what stands before an error is not lost
            content += unpacker.decompress(packed[i : i + 4096])
    except zlib.error:
        return content, False
    return content, unpacker.eof


def _blf_objects(data: bytes, start_ns: int, damage: _Damage, place: int) -> tuple[list[Frame], bytes]:
    """The frames of a container's content, and what is left over of an object that goes on in the next one."""
    frames = _blf_alike(data, start_ns)
    position = len(frames) * _blf_stride(data) if frames else 0
    while position + 8 <= len(data):
        found = data.find(b"LOBJ", position, position + 8)  # objects may be padded
        if found < 0:
            damage.add(f"byte {place}", "no object where one should begin in this container")
            found = data.find(b"LOBJ", position)
            if found < 0:
                return frames, b""
        position = found
        if position + _BLF_OBJECT.size > len(data):
            break
        _, header_size, version, size, kind = _BLF_OBJECT.unpack_from(data, position)
        if size < _BLF_OBJECT.size:
            damage.add(f"byte {place}", f"an object of {size} bytes in this container")
            position += 4
            continue
        if position + size > len(data):
            break
        try:
            frame = _blf_frame(data, position, header_size, version, size, kind, start_ns)
        except (struct.error, ValueError):
            damage.add(f"byte {place}", f"a broken object of type {kind} in this container")
            frame = None
        if frame:
            frames.append(frame)
        position += size
    return frames, data[position:]


def _blf_stride(data: bytes) -> int:
    return cast("int", _BLF_OBJECT.unpack_from(data)[3])


def _blf_alike(data: bytes, start_ns: int) -> list[Frame]:
    """The frames of a content that is classic CAN frames of one form only, which most are; else none."""
    if len(data) < 48:
        return []
    signature, header_size, version, size, kind = _BLF_OBJECT.unpack_from(data)
    if (
        (signature, header_size, version) != (b"LOBJ", 32, 1)
        or kind not in (_BLF_CAN_1, _BLF_CAN_2)
        or size not in (48, 56)
    ):
        return []
    whole = len(data) // size * size
    objects = data[:whole]
    count = whole // size
    # The header up to the flags of the time must be the same everywhere: compared column by column, in C.
    if any(objects[i::size] != objects[i : i + 1] * count for i in range(20)):
        return []
    unit = 10_000 if struct.unpack_from("<L", data, 16)[0] == _BLF_TEN_MICROSECONDS else 1
    fields = struct.Struct(f"<24xQHBBL8s{size - 48}x")
    frames: list[Frame] = []
    append = frames.append
    for time, channel, flags, length, identifier, payload in fields.iter_unpack(objects):
        if flags or length > 8 or not 0 < channel <= TRANSMITTED:
            append(_blf_can(start_ns + time * unit, channel, flags, length, identifier, payload))
        else:
            append((start_ns + time * unit, identifier & _BLF_ID_MASK, payload[:length], channel - 1))
    return frames


def _blf_can(time_ns: int, channel: int, flags: int, length: int, identifier: int, payload: bytes) -> Frame:
    identifier &= _BLF_ID_MASK
    channel = (channel - 1) & 0x7F
    if flags & 0x01:
        channel |= TRANSMITTED
    if flags & 0x80:
        return time_ns, identifier | RTR_FLAG, bytes(min(length, 8)), channel
    return time_ns, identifier, payload[:length], channel


def _blf_frame(
    data: bytes, position: int, header_size: int, version: int, size: int, kind: int, start_ns: int
) -> Frame | None:
    """The frame in one object, or None if the object is not a frame. Raises struct.error if it is too short."""
    if kind not in (_BLF_CAN_1, _BLF_CAN_2, _BLF_ERROR_EXT, _BLF_FD_1, _BLF_FD_2) or version not in (1, 2):
        return None
    time_header = _BLF_TIME_1 if version == 1 else _BLF_TIME_2
    time_fields = time_header.unpack_from(data, position + _BLF_OBJECT.size)
    flags, time = time_fields[0], time_fields[-1]
    time_ns = start_ns + time * (10_000 if flags == _BLF_TEN_MICROSECONDS else 1)
    body = position + _BLF_OBJECT.size + time_header.size
    if kind in (_BLF_CAN_1, _BLF_CAN_2):
        channel, flags, length, identifier, payload = _BLF_CAN.unpack_from(data, body)
        return _blf_can(time_ns, channel, flags, length, identifier, payload)
    if kind == _BLF_ERROR_EXT:
        channel, _, _, _, _, length, _, identifier, _, payload = _BLF_ERROR.unpack_from(data, body)
        identifier = identifier & _BLF_ID_MASK | ERR_FLAG
        return time_ns, identifier, payload[:length], (channel - 1) & 0x7F
    if kind == _BLF_FD_1:
        channel, flags, length, identifier, _, _, _, valid, payload = _BLF_FD.unpack_from(data, body)
        transmitted, remote = flags & 0x01, flags & 0x80
        payload = payload[:valid]
    else:
        fields = _BLF_FD_64.unpack_from(data, body)
        channel, length, valid, _, identifier, _, flags = fields[:7]
        transmitted, extension = fields[12], fields[13]
        remote = flags & 0x0010
        there = min(valid, (extension or size) - header_size - _BLF_FD_64.size)
        payload = data[body + _BLF_FD_64.size : body + _BLF_FD_64.size + there].ljust(valid, b"\0")
    channel = (channel - 1) & 0x7F | (TRANSMITTED if transmitted else 0)
    identifier &= _BLF_ID_MASK
    if remote:
        return time_ns, identifier | RTR_FLAG, bytes(min(length, 8)), channel
    return time_ns, identifier, payload, channel


# --- our own MCAP ----------------------------------------------------------------------------------------------
# Records: u8 opcode, u64 length, content; https://mcap.dev/spec. Read here rather than by the mcap library, which
# gives nothing of a file whose end is missing when seeking, and stops at the first bad chunk when streaming.

_MCAP_MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQLL")  # start, end, size and CRC of the unpacked records, length of the compression's name
_MESSAGE = struct.Struct("<HLQQ")  # channel, sequence, log time, publish time
_U32 = struct.Struct("<L")
_U64 = struct.Struct("<Q")
_FOOTER, _CHANNEL, _MESSAGE_OP, _CHUNK_OP, _ATTACHMENT, _METADATA, _DATA_END = 0x02, 0x04, 0x05, 0x06, 0x09, 0x0C, 0x0F
_ZSTD_CHUNK = b"\x04\x00\x00\x00zstd"
_MARGIN_NS = 1_000_000_000  # a block is stamped with its first frame and holds at most this much time


def _read_mcap(path: Path, data: _Bytes, damage: _Damage, start: int | None, end: int | None) -> Iterator[list[Frame]]:
    channels: set[int] = set()
    topics: set[str] = set()
    for opcode, position, limit in _mcap_records(path, data, damage):
        if opcode == _CHANNEL:
            _mcap_channel(data, position, channels, topics)
            continue
        if opcode != _CHUNK_OP:
            continue
        first, last, _, _, _ = _CHUNK.unpack_from(data, position)
        # The first chunk declares the channels, so it is always unpacked.
        wanted = (start is None or last + _MARGIN_NS >= start) and (end is None or first - _MARGIN_NS < end)
        if not wanted and channels:
            continue
        try:
            records = _mcap_unpack(data, position, limit)
            blocks = list(_mcap_blocks(records, channels, topics))
        except (ValueError, struct.error) as error:
            damage.add(f"byte {position}", f"a chunk is broken ({error})")
            continue
        for block in blocks:
            try:
                yield framelog.decode_block(block)
            except ValueError as error:
                damage.add(f"byte {position}", f"a block of frames is broken ({error})")
    if not channels and topics:
        raise InputError(
            f"{path}: no raw frames in this MCAP file: it has no topic {framelog.TOPIC} in the encoding"
            f" {framelog.ENCODING}, but {', '.join(sorted(topics)[:5])}"
        )


def _mcap_records(path: Path, data: _Bytes, damage: _Damage) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of the records of the data section; after damage it goes on with the next chunk."""
    if data[: len(_MCAP_MAGIC)] != _MCAP_MAGIC:
        raise InputError(f"{path}: not an MCAP file: it does not begin with the format's magic bytes")
    position = len(_MCAP_MAGIC)
    while position + _RECORD.size <= len(data):
        opcode, length = _RECORD.unpack_from(data, position)
        content = position + _RECORD.size
        if opcode in (_DATA_END, _FOOTER):
            return
        if 0 < opcode <= _DATA_END and content + length <= len(data):
            yield opcode, content, content + length
            position = content + length
            continue
        following = _next_chunk(data, position + 1)
        if following < 0:
            damage.add(f"byte {position}", "the file ends within a record" if opcode <= _DATA_END else "no record here")
            return
        damage.add(f"byte {position}", f"{following - position} bytes are not records")
        position = following
    damage.add(f"byte {len(data)}", "the file was cut off: it has no end record")


def _next_chunk(data: _Bytes, position: int) -> int:
    """Where the next chunk record that fits into the file begins, or -1: found by the name of its compression."""
    offset = _RECORD.size + _CHUNK.size - 4
    found = data.find(_ZSTD_CHUNK, position + offset)
    while found >= 0:
        opcode, length = _RECORD.unpack_from(data, found - offset)
        if opcode == _CHUNK_OP and found - offset + _RECORD.size + length <= len(data):
            return found - offset
        found = data.find(_ZSTD_CHUNK, found + 1)
    return -1


def _mcap_string(data: _Bytes, position: int) -> tuple[str, int]:
    """A string with its length before it, and where it ends."""
    (length,) = _U32.unpack_from(data, position)
    end = position + 4 + length
    return str(data[position + 4 : end], "utf-8", "replace"), end


def _mcap_channel(data: _Bytes, position: int, channels: set[int], topics: set[str]) -> None:
    topic, following = _mcap_string(data, position + 4)
    encoding, _ = _mcap_string(data, following)
    topics.add(topic)
    if encoding == framelog.ENCODING:
        channels.add(struct.unpack_from("<H", data, position)[0])


def _mcap_unpack(data: _Bytes, position: int, limit: int) -> bytes:
    """The records in a chunk. Raises ValueError if it is broken."""
    import zstandard

    _, _, size, crc, name_length = _CHUNK.unpack_from(data, position)
    position += _CHUNK.size
    name = bytes(data[position : position + name_length])
    position += name_length + 8
    packed = data[position:limit]
    if name == b"zstd":
        try:
            records = zstandard.decompress(packed, size)
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from None
    elif name == b"":
        records = packed
    else:
        raise ValueError(f"compression {name.decode('ascii', 'replace')!r} is not supported")
    if len(records) != size or (crc and zlib.crc32(records) != crc):
        raise ValueError("its checksum is wrong")
    return records


def _mcap_blocks(records: bytes, channels: set[int], topics: set[str]) -> Iterator[bytes]:
    position = 0
    while position < len(records):
        opcode, length = _RECORD.unpack_from(records, position)
        position += _RECORD.size
        if opcode == _MESSAGE_OP:
            if struct.unpack_from("<H", records, position)[0] in channels:
                yield records[position + _MESSAGE.size : position + length]
        elif opcode == _CHANNEL:
            _mcap_channel(records, position, channels, topics)
        position += length


# --- by python-can ---------------------------------------------------------------------------------------------


class _LineFeed:
    """Lines for python-can's text readers, counted; `resume` lets a reader go on after one that it choked on."""

    def __init__(self, data: _Bytes) -> None:
        self._lines = (line for piece in _text_pieces(data) for line in piece.splitlines(keepends=True))
        self._again = False
        self.number = 0
        self.line = ""
        self.name = ""

    def __iter__(self) -> _LineFeed:
        return self

    def __next__(self) -> str:
        if self._again:
            self._again = False
            return "\n"
        self.line = next(self._lines)
        self.number += 1
        return self.line

    def resume(self) -> None:
        """The reader will look for a header first: give it an empty line that it may drop."""
        self._again = True

    def close(self) -> None:
        pass


def _read_text(suffix: str) -> Callable[..., Iterator[list[Frame]]]:
    def read(path: Path, data: _Bytes, damage: _Damage, _start: int | None, _end: int | None) -> Iterator[list[Frame]]:
        from gz_onboard.bus._can import can

        readers: dict[str, Callable[[TextIO], can.io.generic.MessageReader]] = {
            ".asc": can.ASCReader,
            ".csv": can.CSVReader,
            ".trc": can.TRCReader,
        }
        feed = _LineFeed(data)
        reader = readers[suffix](cast("TextIO", feed))
        channels = _Channels()
        any_frame = False
        messages = iter(reader)
        batch: list[Frame] = []
        while True:
            try:
                message = next(messages, None)
                if message is None:
                    break
                batch.append(frame_of(message, channels))
            except (ValueError, LookupError, TypeError, AttributeError, NotImplementedError) as error:
                damage.add(f"line {feed.number}", f"{str(error) or type(error).__name__}: {feed.line.strip()[:60]!r}")
                if not any_frame and damage.count >= _BATCH:
                    break
                feed.resume()
                messages = iter(reader)
                continue
            any_frame = True
            if len(batch) >= _BATCH:
                yield batch
                batch = []
        if not any_frame and feed.number:
            if damage.count:
                raise InputError(f"{path}, {damage.place}: not a line of the format {suffix}: {damage.reason}")
            if not _looks_like(suffix, data):
                raise InputError(f"{path}, line 1: not a log in the format {suffix}: it has no header of that format")
        if batch:
            yield batch

    return read


def _looks_like(suffix: str, data: _Bytes) -> bool:
    """Whether a text without a frame in it has at least a header of its format."""
    head = str(data[:200], "latin-1").lstrip().lower()
    return head.startswith({".asc": ("date", "base", "//"), ".csv": ("timestamp",), ".trc": (";",)}[suffix])


def _read_mf4(path: Path, data: _Bytes, damage: _Damage, _start: int | None, _end: int | None) -> Iterator[list[Frame]]:
    import importlib
    import io

    from gz_onboard.bus._can import can

    try:
        importlib.import_module("asammdf")
    except ImportError:
        raise InputError(f"{path}: reading .mf4 needs asammdf: pip install 'gz-onboard[mf4]'") from None
    if vars(can.io.mf4)["asammdf"] is None:  # python-can was imported without it, see _can.py
        importlib.reload(can.io.mf4)
    channels = _Channels()
    batch: list[Frame] = []
    any_frame = False
    try:
        reader = can.io.mf4.MF4Reader(io.BytesIO(bytes(data)))
        for message in reader:
            batch.append(frame_of(message, channels))
            if len(batch) >= _BATCH:
                yield batch
                any_frame = True
                batch = []
    except Exception as error:  # asammdf raises all sorts of exceptions for a broken file
        if not any_frame and not batch:
            raise InputError(f"{path}: not a readable MF4 file: {error}") from None
        damage.add("after the last frame read", str(error))
    if batch:
        yield batch


def frame_of(message: can.Message, channels: dict[str, int] | None = None) -> Frame:
    """A python-can message as a frame; channels numbers the named channels (a name that it lacks raises KeyError).

    The time is rounded to a microsecond: the message's is a float of seconds, which has no more since 1970.
    """
    identifier = message.arbitration_id
    if message.is_extended_id:
        identifier |= EFF_FLAG
    if message.is_error_frame:
        identifier |= ERR_FLAG
    if message.is_remote_frame:
        identifier |= RTR_FLAG
        data = bytes(min(message.dlc, 8))
    else:
        data = bytes(message.data)
    channel: Any = message.channel
    if channel is None:
        channel = 0
    elif isinstance(channel, str):
        channel = (channels if channels is not None else {})[channel]
    return (
        round(message.timestamp * 1e6) * 1000,
        identifier,
        data,
        channel & 0x7F if message.is_rx else channel & 0x7F | TRANSMITTED,
    )


_READERS: dict[str, Callable[[Path, _Bytes, _Damage, int | None, int | None], Iterator[list[Frame]]]] = {
    ".mcap": _read_mcap,
    ".blf": _read_blf,
    ".log": _read_candump,
    ".asc": _read_text(".asc"),
    ".csv": _read_text(".csv"),
    ".trc": _read_text(".trc"),
    ".mf4": _read_mf4,
}
