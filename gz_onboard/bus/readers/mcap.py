"""Our own logs, see docs/log-format.md.

Records are u8 opcode, u64 length, content (https://mcap.dev/spec). They are read here rather than by the mcap
library, which gives nothing of a file whose end is missing when it seeks, and stops at the first bad chunk when it
streams.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

from gz_onboard.bus import framelog
from gz_onboard.bus.readers.common import Contents, Damage
from gz_onboard.errors import InputError
from gz_onboard.events import Frame

_MCAP_MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQLL")  # start, end, size and CRC of the unpacked records, length of the compression's name
_MESSAGE = struct.Struct("<HLQQ")  # channel, sequence, log time, publish time
_U16 = struct.Struct("<H")
_U32 = struct.Struct("<L")
_U64 = struct.Struct("<Q")
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE_OP, _CHUNK_OP = 0x02, 0x03, 0x04, 0x05, 0x06
_ATTACHMENT, _METADATA, _DATA_END = 0x09, 0x0C, 0x0F
_ZSTD_CHUNK = b"\x04\x00\x00\x00zstd"
_MARGIN_NS = 1_000_000_000  # a block is stamped with its first frame and holds at most this much time


def read(path: Path, data: Contents, damage: Damage, start: int | None, end: int | None) -> Iterator[list[Frame]]:
    """The raw frames of one of our logs; what cannot be read, or is missing at its end, is noted as damage."""
    channels: set[int] = set()
    topics: set[str] = set()
    for opcode, position, limit in _records(path, data, damage):
        if opcode == _CHANNEL:
            _channel(data, position, channels, topics)
            continue
        if opcode != _CHUNK_OP:
            continue
        first, last, _, _, _ = _CHUNK.unpack_from(data, position)
        # The first chunk declares the channels, so it is always unpacked.
        wanted = (start is None or last + _MARGIN_NS >= start) and (end is None or first - _MARGIN_NS < end)
        if not wanted and channels:
            continue
        try:
            records = _unpack(data, position, limit)
            blocks = list(_blocks(records, channels, topics))
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


def attachments(path: Path, data: Contents) -> dict[str, bytes]:
    """The attached files by name."""
    found = {}
    for opcode, start, _ in _records(path, data, Damage()):
        if opcode == _ATTACHMENT:
            name, position = _string(data, start + 16)
            _, position = _string(data, position)
            (size,) = _U64.unpack_from(data, position)
            found[name] = bytes(data[position + 8 : position + 8 + size])
    return found


def metadata(path: Path, data: Contents) -> dict[str, str]:
    """The entries of the metadata record ``gz_onboard``."""
    entries: dict[str, str] = {}
    for opcode, start, _ in _records(path, data, Damage()):
        if opcode != _METADATA:
            continue
        name, position = _string(data, start)
        if name == "gz_onboard":
            entries = _string_map(data, position)
    return entries


def json_channels(path: Path, data: Contents) -> dict[str, tuple[bytes, dict[str, str]]]:
    """Schema (a JSON text) and metadata of each topic of JSON objects."""
    schemas: dict[int, bytes] = {}
    found = {}
    for opcode, content in _unpacked_records(path, data, Damage()):
        if opcode == _SCHEMA:
            _, position = _string(content, 2)
            _, position = _string(content, position)
            schemas[_U16.unpack_from(content)[0]] = content[position + 4 :]
        elif opcode == _CHANNEL:
            topic, position = _string(content, 4)
            encoding, position = _string(content, position)
            schema = schemas.get(_U16.unpack_from(content, 2)[0], b"{}")
            if encoding == "json":
                found[topic] = (schema, _string_map(content, position))
    return found


def samples(
    path: Path, data: Contents, damage: Damage, start: int | None, end: int | None
) -> Iterator[tuple[str, int, bytes]]:
    """Topic, time [ns] and JSON text of the messages of the JSON topics."""
    topics: dict[int, str] = {}
    for opcode, content in _unpacked_records(path, data, damage):
        if opcode == _MESSAGE_OP:
            channel, _, time_ns, _ = _MESSAGE.unpack_from(content)
            if channel in topics and (start is None or time_ns >= start) and (end is None or time_ns < end):
                yield topics[channel], time_ns, content[_MESSAGE.size :]
        elif opcode == _CHANNEL:
            topic, position = _string(content, 4)
            encoding, _ = _string(content, position)
            if encoding == "json":
                topics[_U16.unpack_from(content)[0]] = topic


def _unpacked_records(path: Path, data: Contents, damage: Damage) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of all records, those in chunks among them."""
    for opcode, start, end in _records(path, data, damage):
        if opcode != _CHUNK_OP:
            yield opcode, data[start:end]
            continue
        try:
            records = _unpack(data, start, end)
        except (ValueError, struct.error) as error:
            damage.add(f"byte {start}", f"a chunk is broken ({error})")
            continue
        position = 0
        while position < len(records):
            inner, length = _RECORD.unpack_from(records, position)
            position += _RECORD.size + length
            yield inner, records[position - length : position]


def _records(path: Path, data: Contents, damage: Damage) -> Iterator[tuple[int, int, int]]:
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


def _next_chunk(data: Contents, position: int) -> int:
    """Where the next chunk record that fits into the file begins, or -1: found by the name of its compression."""
    offset = _RECORD.size + _CHUNK.size - 4
    found = data.find(_ZSTD_CHUNK, position + offset)
    while found >= 0:
        opcode, length = _RECORD.unpack_from(data, found - offset)
        if opcode == _CHUNK_OP and found - offset + _RECORD.size + length <= len(data):
            return found - offset
        found = data.find(_ZSTD_CHUNK, found + 1)
    return -1


def _string(data: Contents, position: int) -> tuple[str, int]:
    """A string with its length before it, and where it ends."""
    (length,) = _U32.unpack_from(data, position)
    end = position + 4 + length
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


def _unpack(data: Contents, position: int, limit: int) -> bytes:
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


def _blocks(records: bytes, channels: set[int], topics: set[str]) -> Iterator[bytes]:
    position = 0
    while position < len(records):
        opcode, length = _RECORD.unpack_from(records, position)
        position += _RECORD.size
        if opcode == _MESSAGE_OP:
            if _U16.unpack_from(records, position)[0] in channels:
                yield records[position + _MESSAGE.size : position + length]
        elif opcode == _CHANNEL:
            _channel(records, position, channels, topics)
        position += length
