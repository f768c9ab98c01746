"""Our own logs, see docs/log-format.md.

Records are u8 opcode, u64 length, content (https://mcap.dev/spec). They are read here rather than by the mcap
library, which gives nothing of a file whose end is missing when it seeks, and stops at the first bad chunk when it
streams.
"""

from __future__ import annotations

import contextlib
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

from mcap.opcode import Opcode

from gz_onboard.bus import framelog
from gz_onboard.bus.readers.common import TIME_LIMIT_NS, Contents, Damage
from gz_onboard.errors import InputError
from gz_onboard.events import Frame

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")
CHUNK = struct.Struct("<QQQLL")  # start, end, size and CRC of the unpacked records, length of the compression's name
_FOOTER = struct.Struct("<BQQQL")  # opcode, length, start of the summary and of its offsets, CRC
_CHUNK_COUNT = 22  # where it stands in the statistics
_MESSAGE = struct.Struct("<HLQQ")  # channel, sequence, log time, publish time
_U16 = struct.Struct("<H")
_U32 = struct.Struct("<L")
_U64 = struct.Struct("<Q")
_ZSTD_CHUNK = b"\x04\x00\x00\x00zstd"
BROKEN = (ValueError, struct.error)  # what reading a broken record raises
_LARGEST_CHUNK = 64 << 20  # bytes, unpacked; ours have 300 kB
_MARGIN_NS = 1_000_000_000  # a block is stamped with its first frame and holds at most this much time


def read(path: Path, data: Contents, damage: Damage, start: int | None, end: int | None) -> Iterator[list[Frame]]:
    """The raw frames of one of our logs; what cannot be read, or is missing at its end, is noted as damage."""
    channels: set[int] = set()
    topics: set[str] = set()
    promised, chunks = 0, 0
    for opcode, position, _ in _declared(data):
        with contextlib.suppress(*BROKEN):
            if opcode == Opcode.CHANNEL:
                _channel(data, position, channels, topics)
            elif opcode == Opcode.STATISTICS:
                promised = _U32.unpack_from(data, position + _CHUNK_COUNT)[0]
    for opcode, position, limit in records(path, data, damage):
        blocks = []
        try:
            if opcode == Opcode.CHANNEL:
                _channel(data, position, channels, topics)
            elif opcode == Opcode.CHUNK:
                first, last, _, _, _ = CHUNK.unpack_from(data, position)
                # Where there is no summary, the first chunk declares the channels.
                wanted = (start is None or last + _MARGIN_NS >= start) and (end is None or first - _MARGIN_NS < end)
                chunks += 1
                if not wanted and channels and first <= last:
                    continue
                content = unpack_chunk(data, position, limit)
                for inner, at, until in records_in(content):
                    if inner == Opcode.MESSAGE:
                        if _U16.unpack_from(content, at)[0] in channels:
                            blocks.append(content[at + _MESSAGE.size : until])
                    elif inner == Opcode.CHANNEL:
                        _channel(content, at, channels, topics)
        except BROKEN as error:
            damage.add(f"byte {position}", f"a {'chunk' if opcode == Opcode.CHUNK else 'record'} is broken ({error})")
        for block in blocks:
            try:
                yield framelog.decode_block(block)
            except ValueError as error:
                damage.add(f"byte {position}", f"a block of frames is broken ({error})")
    if chunks < promised and not damage.count:
        damage.add("in the middle", f"{promised - chunks} of {promised} chunks are missing", promised - chunks)
    if not channels and topics:
        raise InputError(
            f"{path}: no raw frames in this MCAP file: it has no topic {framelog.TOPIC} in the encoding"
            f" {framelog.ENCODING}, but {', '.join(sorted(topics)[:5])}"
        )


def attachments(path: Path, data: Contents) -> dict[str, bytes]:
    """The attached files by name."""
    found = {}
    for opcode, start, end in records(path, data, Damage()):
        if opcode == Opcode.ATTACHMENT:
            with contextlib.suppress(*BROKEN):
                name, position = _string(data, start + 16)
                _, position = _string(data, position)
                (size,) = _U64.unpack_from(data, position)
                if position + 8 + size <= end:
                    found[name] = bytes(data[position + 8 : position + 8 + size])
    return found


def metadata(path: Path, data: Contents, record: str) -> dict[str, str]:
    """The entries of the metadata record that is called so."""
    entries: dict[str, str] = {}
    for opcode, start, _ in records(path, data, Damage()):
        if opcode == Opcode.METADATA:
            with contextlib.suppress(*BROKEN):
                name, position = _string(data, start)
                if name == record:
                    entries = _string_map(data, position)
    return entries


def json_channels(path: Path, data: Contents) -> dict[str, tuple[bytes, dict[str, str]]]:
    """Schema (a JSON text) and metadata of each topic of JSON objects."""
    schemas: dict[int, bytes] = {}
    found = {}
    for opcode, content in _unpacked_records(path, data, Damage()):
        with contextlib.suppress(*BROKEN):
            if opcode == Opcode.SCHEMA:
                _, position = _string(content, 2)
                _, position = _string(content, position)
                schemas[_U16.unpack_from(content)[0]] = content[position + 4 :]
            elif opcode == Opcode.CHANNEL:
                topic, position = _string(content, 4)
                encoding, position = _string(content, position)
                schema = schemas.get(_U16.unpack_from(content, 2)[0], b"{}")
                if encoding == "json":
                    found[topic] = (schema, _string_map(content, position))
    return found


def samples(
    path: Path, data: Contents, damage: Damage, start: int | None, end: int | None
) -> Iterator[tuple[str, int, bytes]]:
    """Topic, time of publishing [ns] and JSON text of the messages of the JSON topics."""
    topics: dict[int, str] = {}
    for opcode, content in _unpacked_records(path, data, damage):
        try:
            if opcode == Opcode.MESSAGE:
                channel, _, logged_ns, time_ns = _MESSAGE.unpack_from(content)
            elif opcode == Opcode.CHANNEL:
                topic, position = _string(content, 4)
                encoding, _ = _string(content, position)
                if encoding == "json":
                    topics[_U16.unpack_from(content)[0]] = topic
        except BROKEN as error:
            damage.add("a record", str(error))
            continue
        if opcode == Opcode.MESSAGE and channel in topics:
            if (latest := max(logged_ns, time_ns)) >= TIME_LIMIT_NS:
                damage.add(f"a sample of {topics[channel]}", f"{latest} ns is no time")
            elif (start is None or time_ns >= start) and (end is None or time_ns < end):
                yield topics[channel], time_ns, content[_MESSAGE.size :]


def _unpacked_records(path: Path, data: Contents, damage: Damage) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of all records, those in chunks among them; first what the summary declares."""
    for opcode, start, end in _declared(data):
        yield opcode, data[start:end]
    for opcode, start, end in records(path, data, damage):
        if opcode != Opcode.CHUNK:
            yield opcode, data[start:end]
            continue
        try:
            content = unpack_chunk(data, start, end)
            for inner, at, until in records_in(content):
                yield inner, content[at:until]
        except BROKEN as error:
            damage.add(f"byte {start}", f"a chunk is broken ({error})")


def records(path: Path, data: Contents, damage: Damage) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of the records of the data section; after damage it goes on with the next chunk."""
    if data[: len(MAGIC)] != MAGIC:
        raise InputError(f"{path}: not an MCAP file: it does not begin with the format's magic bytes")
    position = len(MAGIC)
    while position + RECORD.size <= len(data):
        opcode, length = RECORD.unpack_from(data, position)
        content = position + RECORD.size
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            return
        if 0 < opcode <= Opcode.DATA_END and content + length <= len(data):
            yield opcode, content, content + length
            position = content + length
            continue
        following = _next_chunk(data, position + 1)
        if following < 0:
            damage.add(
                f"byte {position}", "the file ends within a record" if opcode <= Opcode.DATA_END else "no record here"
            )
            return
        damage.add(f"byte {position}", f"{following - position} bytes are not records")
        position = following
    damage.add(f"byte {len(data)}", "the file was cut off: it has no end record")


def _declared(data: Contents) -> list[tuple[int, int, int]]:
    """Opcode, start and end of the schemas, channels and statistics in the summary; none without a summary.

    The chunk that declares them may be broken.
    """
    footer = len(data) - len(MAGIC) - _FOOTER.size
    if footer < 0 or data[footer + _FOOTER.size :] != MAGIC:
        return []
    opcode, _, start, _, crc = _FOOTER.unpack_from(data, footer)
    end = footer + _FOOTER.size - 4
    if opcode != Opcode.FOOTER or not len(MAGIC) <= start < footer or zlib.crc32(data[start:end]) != crc:
        return []
    try:
        found = [(kind, start + at, start + until) for kind, at, until in records_in(data[start:footer])]
    except BROKEN:
        return []
    return [record for record in found if record[0] in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS)]


def _next_chunk(data: Contents, position: int) -> int:
    """Where the next chunk record that fits into the file begins, or -1: found by the name of its compression."""
    offset = RECORD.size + CHUNK.size - 4
    found = data.find(_ZSTD_CHUNK, position + offset)
    while found >= 0:
        opcode, length = RECORD.unpack_from(data, found - offset)
        if opcode == Opcode.CHUNK and found - offset + RECORD.size + length <= len(data):
            return found - offset
        found = data.find(_ZSTD_CHUNK, found + 1)
    return -1


def _string(data: Contents, position: int) -> tuple[str, int]:
    """A string with its length before it, and where it ends. Raises ValueError or struct.error if it is cut off."""
    (length,) = _U32.unpack_from(data, position)
    end = position + 4 + length
    if end > len(data):
        raise ValueError("a text is cut off")
    return str(data[position + 4 : end], "utf-8", "replace"), end


def _string_map(data: Contents, position: int) -> dict[str, str]:
    """A map of strings, with its length in bytes before it."""
    end = position + 4 + _U32.unpack_from(data, position)[0]
    position += 4
    entries = {}
    while position < end:
        key, position = _string(data, position)
        entries[key], position = _string(data, position)
    return entries


def _channel(data: Contents, position: int, channels: set[int], topics: set[str]) -> None:
    topic, following = _string(data, position + 4)
    encoding, _ = _string(data, following)
    topics.add(topic)
    if encoding == framelog.ENCODING:
        channels.add(_U16.unpack_from(data, position)[0])


def unpack_chunk(data: Contents, position: int, limit: int) -> bytes:
    """The records in the chunk whose content is from `position` to `limit`. Raises ValueError if it is broken."""
    import zstandard

    if position + CHUNK.size > limit:
        raise ValueError("it is too short")
    _, _, size, crc, name_length = CHUNK.unpack_from(data, position)
    position += CHUNK.size
    if size > _LARGEST_CHUNK:
        raise ValueError(f"it says that it unpacks to {size} bytes")
    if position + name_length + 8 > limit:
        raise ValueError("the name of its compression is cut off")
    name = bytes(data[position : position + name_length])
    packed = data[position + name_length + 8 : limit]
    if name == b"zstd":
        try:
            # The decompressor would make room for whatever the packed data say of themselves.
            inside = zstandard.frame_content_size(packed)
            if inside not in (size, -1):
                raise ValueError(f"it unpacks to {inside} bytes, not {size}")
            content = zstandard.ZstdDecompressor(max_window_size=_LARGEST_CHUNK).decompress(packed, size)
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from None
    elif name == b"":
        content = packed
    else:
        raise ValueError(f"compression {name.decode('ascii', 'replace')!r} is not supported")
    if len(content) != size or (crc and zlib.crc32(content) != crc):
        raise ValueError("its checksum is wrong")
    return content


def records_in(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of the records of an unpacked chunk. Raises ValueError where one is cut off."""
    position = 0
    while position < len(content):
        if position + RECORD.size > len(content):
            raise ValueError("it ends within a record")
        opcode, length = RECORD.unpack_from(content, position)
        position += RECORD.size
        if length > len(content) - position:
            raise ValueError("it ends within a record")
        yield opcode, position, position + length
        position += length
