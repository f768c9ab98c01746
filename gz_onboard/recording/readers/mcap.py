"""Our own logs, see docs/log-format.md.

A file is a sequence of records (https://mcap.dev/spec). They are found here rather than by the mcap library, which
gives nothing of a file whose end is missing when it seeks, and stops at the first bad chunk when it streams.
"""

from __future__ import annotations

import contextlib
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema, Statistics
from mcap.writer import MCAP0_MAGIC

from gz_onboard.bus import framelog
from gz_onboard.errors import InputError
from gz_onboard.recording.frames import TIME_LIMIT_NS, FrameColumns
from gz_onboard.recording.readers.contents import Contents, Damage

_RECORD = struct.Struct("<BQ")  # opcode, length
_CHUNK = struct.Struct("<QQQLL")  # start, end, size and CRC of the unpacked records, length of the compression's name
_FOOTER = struct.Struct("<BQQQL")  # opcode, length, start of the summary and of its offsets, CRC
_MESSAGE = struct.Struct("<HLQQ")  # channel, sequence, log time, publish time
_ZSTD_CHUNK = b"\x04\x00\x00\x00zstd"
_BROKEN = (ValueError, struct.error, EndOfFile)  # what reading a broken record raises
_LARGEST_CHUNK = 64 << 20  # bytes, unpacked; ours have 300 kB

_BLOCK_HEAD = struct.Struct("<BBHIqI")  # version, bytes of a step, kinds, frames, time of the first, unit of a step
_KIND = np.dtype([("identifier", "<u4"), ("channel", "u1"), ("length", "u1")])

_Record = tuple[int, Contents, int]
"""Opcode, content, and the byte at which the record, or the chunk that holds it, begins in the file."""


def read(path: Path, data: Contents, damage: Damage) -> FrameColumns:
    """Read the frames of one of our logs; what cannot be read, or is missing at its end, is noted as damage."""
    channels: set[int] = set()
    topics: set[str] = set()
    promised = chunks = 0
    parts = []
    for opcode, content, place in _unpacked(path, data, damage):
        try:
            if opcode == Opcode.MESSAGE:
                if _MESSAGE.unpack_from(content)[0] in channels:
                    parts.append(decode_block(content[_MESSAGE.size :]))
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(_stream(content))
                topics.add(channel.topic)
                if channel.message_encoding == framelog.ENCODING:
                    channels.add(channel.id)
            elif opcode == Opcode.STATISTICS:
                promised = Statistics.read(_stream(content)).chunk_count
            elif opcode == Opcode.CHUNK:
                chunks += 1
        except _BROKEN as error:
            what = "block of frames" if opcode == Opcode.MESSAGE else "record"
            damage.add(f"byte {place}", f"a {what} is broken ({error})")
    if chunks < promised and not damage.count:
        damage.add("in the middle", f"{promised - chunks} of {promised} chunks are missing", promised - chunks)
    if not channels and topics:
        raise InputError(
            f"{path}: no raw frames in this MCAP file: it has no topic {framelog.TOPIC} in the encoding"
            f" {framelog.ENCODING}, but {', '.join(sorted(topics)[:5])}"
        )
    return FrameColumns.concatenate(parts)


def decode_block(block: bytes) -> FrameColumns:
    """Decode the frames of one block, as `framelog.encode_block` made it. Raises ValueError for any other bytes."""
    if len(block) < _BLOCK_HEAD.size:
        raise ValueError(f"a block of {len(block)} bytes is too short")
    version, width, kinds, count, first, unit = _BLOCK_HEAD.unpack_from(block)
    if version != 1 or width not in (2, 4, 8) or not kinds or not count:
        raise ValueError("not a block of frames of version 1")
    kind_bytes = 1 if kinds <= 256 else 2
    order_at = _BLOCK_HEAD.size + kinds * _KIND.itemsize
    steps_at = order_at + count * kind_bytes
    data_at = steps_at + (count - 1) * width
    if len(block) < data_at:
        raise ValueError(f"a block of {count} frames is cut off")
    table = np.frombuffer(block, _KIND, kinds, _BLOCK_HEAD.size)
    kind = np.frombuffer(block, f"<u{kind_bytes}", count, order_at)
    if kind.max() >= kinds:
        raise ValueError("a frame of a kind that the block does not have")
    planes = np.frombuffer(block, np.uint8, (count - 1) * width, steps_at).reshape(width, count - 1)
    steps = np.ascontiguousarray(planes.T).view(f"<i{width}").ravel()
    frames = FrameColumns.empty(count, int(table["length"].max()))
    frames.time_ns[:] = _times(first, steps, unit)
    for name in ("identifier", "channel", "length"):
        getattr(frames, name)[:] = table[name][kind]
    numbers = np.bincount(kind, minlength=kinds)
    if data_at + int(numbers @ table["length"].astype(np.int64)) != len(block):
        raise ValueError(f"not the data of a block of {count} frames")
    rows, position, start = np.argsort(kind, kind="stable"), data_at, 0
    for number, length in zip(numbers.tolist(), table["length"].tolist(), strict=True):
        data = np.frombuffer(block, np.uint8, number * length, position).reshape(length, number)
        frames.data[rows[start : start + number], :length] = data.T
        position, start = position + number * length, start + number
    return frames


def _times(first: int, steps: np.ndarray[Any, Any], unit: int) -> np.ndarray[Any, Any]:
    """Times [ns] from the first and the steps after it; -1 where one leaves 64 bits."""
    times = np.zeros(len(steps) + 1, np.int64)
    np.cumsum(steps.astype(np.int64) * unit, out=times[1:])
    times += first
    if abs(first) + (len(steps) * unit << 8 * steps.itemsize - 1) < TIME_LIMIT_NS:
        return times
    exact = np.concatenate(([0.0], np.cumsum(steps.astype(float)) * unit)) + float(first)
    return np.where(np.abs(exact - times) < TIME_LIMIT_NS, times, -1)


def attachments(path: Path, data: Contents) -> dict[str, bytes]:
    """The attached files by name."""
    found = {}
    for opcode, content, _ in _records(path, data, Damage()):
        if opcode == Opcode.ATTACHMENT:
            with contextlib.suppress(*_BROKEN):
                attachment = Attachment.read(_stream(content))
                found[attachment.name] = attachment.data
    return found


def metadata(path: Path, data: Contents, record: str) -> dict[str, str]:
    """The entries of the metadata record that is called so."""
    entries: dict[str, str] = {}
    for opcode, content, _ in _records(path, data, Damage()):
        if opcode == Opcode.METADATA:
            with contextlib.suppress(*_BROKEN):
                found = Metadata.read(_stream(content))
                entries = found.metadata if found.name == record else entries
    return entries


def json_channels(path: Path, data: Contents) -> dict[str, tuple[bytes, dict[str, str]]]:
    """Schema (a JSON text) and metadata of each topic of JSON objects."""
    schemas: dict[int, bytes] = {}
    found = {}
    for opcode, content, _ in _unpacked(path, data, Damage()):
        with contextlib.suppress(*_BROKEN):
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(_stream(content))
                schemas[schema.id] = schema.data
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(_stream(content))
                if channel.message_encoding == "json":
                    found[channel.topic] = (schemas.get(channel.schema_id, b"{}"), channel.metadata)
    return found


def samples(path: Path, data: Contents, damage: Damage) -> Iterator[tuple[str, int, bytes]]:
    """Topic, time of publishing [ns] and JSON text of the messages of the JSON topics."""
    topics: dict[int, str] = {}
    for opcode, content, place in _unpacked(path, data, damage):
        try:
            if opcode == Opcode.CHANNEL:
                channel = Channel.read(_stream(content))
                if channel.message_encoding == "json":
                    topics[channel.id] = channel.topic
            elif opcode == Opcode.MESSAGE:
                number, _, logged_ns, time_ns = _MESSAGE.unpack_from(content)
                if number not in topics:
                    continue
                if (latest := max(logged_ns, time_ns)) >= TIME_LIMIT_NS:
                    damage.add(f"a sample of {topics[number]}", f"{latest} ns is no time")
                else:
                    yield topics[number], time_ns, bytes(content[_MESSAGE.size :])
        except _BROKEN as error:
            damage.add(f"byte {place}", f"a record is broken ({error})")


def _stream(content: Contents) -> ReadDataStream:
    return ReadDataStream(BytesIO(content))


def _unpacked(path: Path, data: Contents, damage: Damage) -> Iterator[_Record]:
    """The records of the summary, then those of the data section; after each chunk the records in it."""
    yield from _summary(data)
    for opcode, content, place in _records(path, data, damage):
        yield opcode, content, place
        if opcode == Opcode.CHUNK:
            try:
                yield from _split(_unpack_chunk(content), place)
            except _BROKEN as error:
                damage.add(f"byte {place}", f"a chunk is broken ({error})")


def _records(path: Path, data: Contents, damage: Damage) -> Iterator[_Record]:
    """The records of the data section; after damage the next ones are those from the next chunk on."""
    if data[: len(MCAP0_MAGIC)] != MCAP0_MAGIC:
        raise InputError(f"{path}: not an MCAP file: it does not begin with the format's magic bytes")
    position = len(MCAP0_MAGIC)
    while position + _RECORD.size <= len(data):
        opcode, length = _RECORD.unpack_from(data, position)
        start = position + _RECORD.size
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            return
        if 0 < opcode <= Opcode.DATA_END and start + length <= len(data):
            yield opcode, data[start : start + length], start
            position = start + length
            continue
        following = _next_chunk(data, position + 1)
        if following < 0:
            why = "the file ends within a record" if opcode <= Opcode.DATA_END else "no record here"
            damage.add(f"byte {position}", why)
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
        if opcode == Opcode.CHUNK and found - offset + _RECORD.size + length <= len(data):
            return found - offset
        found = data.find(_ZSTD_CHUNK, found + 1)
    return -1


def _summary(data: Contents) -> list[_Record]:
    """The records of the summary, which declares the channels even where the first chunk is broken; [] without one."""
    footer = len(data) - len(MCAP0_MAGIC) - _FOOTER.size
    if footer < 0 or data[footer + _FOOTER.size :] != MCAP0_MAGIC:
        return []
    opcode, _, start, _, crc = _FOOTER.unpack_from(data, footer)
    end = footer + _FOOTER.size - 4
    if opcode != Opcode.FOOTER or not len(MCAP0_MAGIC) <= start < footer or zlib.crc32(data[start:end]) != crc:
        return []
    try:
        records = list(_split(data[start:footer], start))
    except _BROKEN:
        return []
    return [record for record in records if record[0] in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS)]


def _split(content: bytes, place: int) -> Iterator[_Record]:
    """The records in `content`. Raises ValueError where one is cut off."""
    position = 0
    while position < len(content):
        start = position + _RECORD.size
        if start > len(content):
            raise ValueError("it ends within a record")
        opcode, length = _RECORD.unpack_from(content, position)
        position = start + length
        if position > len(content):
            raise ValueError("it ends within a record")
        yield opcode, content[start:position], place


def _unpack_chunk(content: Contents) -> bytes:
    """The records in a chunk. Raises ValueError or struct.error if it is broken."""
    _, _, size, crc, name_length = _CHUNK.unpack_from(content)
    packed_at = _CHUNK.size + name_length + 8
    if packed_at > len(content):
        raise ValueError("the name of its compression is cut off")
    if size > _LARGEST_CHUNK:
        raise ValueError(f"it says that it unpacks to {size} bytes")
    name, packed = content[_CHUNK.size : _CHUNK.size + name_length], content[packed_at:]
    if name == b"zstd":
        try:
            # The decompressor would make room for whatever the packed data say of themselves.
            inside = zstandard.frame_content_size(packed)
            if inside not in (size, -1):
                raise ValueError(f"it unpacks to {inside} bytes, not {size}")
            packed = zstandard.ZstdDecompressor(max_window_size=_LARGEST_CHUNK).decompress(packed, size)
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from None
    elif name:
        raise ValueError(f"compression {name.decode('ascii', 'replace')!r} is not supported")
    if len(packed) != size or (crc and zlib.crc32(packed) != crc):
        raise ValueError("its checksum is wrong")
    return packed
