"""Our own logs, see docs/reference/log-format.md.

A file is a sequence of records (https://mcap.dev/spec). They are found here rather than by the mcap library, which
gives nothing of a file whose end is missing when it seeks, and stops at the first bad chunk when it streams.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema, Statistics
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from gz_onboard.can import logfile
from gz_onboard.errors import InputError
from gz_onboard.recording.frames import TIME_LIMIT_NS, FrameColumns
from gz_onboard.recording.readers.contents import Contents, LogDamage

_RECORD = struct.Struct("<BQ")  # opcode, length
_COMPRESSION_AT = 28  # bytes from the beginning of a chunk
_MESSAGE = struct.Struct("<HLQQ")  # channel, sequence, log time, publish time
_ZSTD_CHUNK = b"\x04\x00\x00\x00zstd"
_BROKEN = (ValueError, OverflowError, struct.error, McapError, zstandard.ZstdError)  # raised for a broken record
_LARGEST_CHUNK = 64 << 20  # bytes, unpacked; ours have 300 kB

_BLOCK_HEAD = struct.Struct("<BBHIqI")  # version, bytes of a step, kinds, frames, time of the first, unit of a step
_KIND = np.dtype([("identifier", "<u4"), ("channel", "u1"), ("length", "u1")])
_PARSERS: dict[int, Any] = {
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.METADATA: Metadata.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.STATISTICS: Statistics.read,
}
"""Of the records that are read whole when a log is opened."""


class Message(NamedTuple):
    """One entry of a topic. times: [ns]; place: the byte at which the chunk that holds it begins."""

    channel: Channel
    logged_ns: int
    published_ns: int
    data: bytes
    place: int


class LogContents:
    """One of our logs: its declarations and attachments; `messages` reads the rest. Broken records are damage.

    Raises InputError for a file that is no MCAP.
    """

    def __init__(self, data: Contents, damage: LogDamage) -> None:
        self.attachments: dict[str, bytes] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.schemas: dict[int, bytes] = {}
        self.channels: dict[int, Channel] = {}
        self._promised_chunks = 0
        self._data, self._damage = data, damage
        self._records = list(_records(data, damage))
        # The summary declares channels and schemas once more: they are known even where the first chunk is broken.
        for opcode, start, end in self._records:
            self._take(opcode, data, start, end)
        missing = self._promised_chunks - sum(opcode == Opcode.CHUNK for opcode, _, _ in self._records)
        if missing > 0 and not damage.count:
            damage.add("in the middle", f"{missing} of {self._promised_chunks} chunks are missing", missing)

    def messages(self) -> Iterator[Message]:
        """The messages of all topics, in their order."""
        for opcode, start, end in self._records:
            if opcode != Opcode.CHUNK:
                continue
            try:
                content = _unpack_chunk(self._data[start:end])
                for inner, at, until in _split(content, 0, len(content)):
                    if inner != Opcode.MESSAGE:
                        self._take(inner, content, at, until)
                        continue
                    number, _, logged_ns, published_ns = _MESSAGE.unpack_from(content, at)
                    if channel := self.channels.get(number):
                        yield Message(channel, logged_ns, published_ns, content[at + _MESSAGE.size : until], start)
            except _BROKEN as error:
                self._damage.add(f"byte {start}", f"a chunk is broken ({error})")

    def _take(self, opcode: int, data: Contents, start: int, end: int) -> None:
        """Store a record that is neither a chunk nor a message."""
        if opcode not in _PARSERS:
            return
        try:
            record = _PARSERS[opcode](ReadDataStream(BytesIO(data[start:end])))
        except _BROKEN as error:
            self._damage.add(f"byte {start}", f"a record is broken ({error})")
            return
        if isinstance(record, Attachment):
            self.attachments[record.name] = record.data
        elif isinstance(record, Metadata):
            self.metadata[record.name] = record.metadata
        elif isinstance(record, Schema):
            self.schemas[record.id] = record.data
        elif isinstance(record, Channel):
            self.channels[record.id] = record
        else:
            self._promised_chunks = record.chunk_count


def read(data: Contents, damage: LogDamage) -> FrameColumns:
    """Read the frames of one of our logs; what cannot be read, or is missing at its end, is noted as damage."""
    contents = LogContents(data, damage)
    parts = []
    for message in contents.messages():
        if message.channel.message_encoding == logfile.BLOCK_ENCODING:
            try:
                parts.append(decode_block(message.data))
            except ValueError as error:
                damage.add(f"byte {message.place}", f"a block of frames is broken ({error})")
    channels = contents.channels.values()
    if channels and logfile.BLOCK_ENCODING not in {channel.message_encoding for channel in channels}:
        raise InputError(
            f"{damage.path}: no raw frames in this MCAP file: it has no topic {logfile.FRAMES_TOPIC} in the encoding"
            f" {logfile.BLOCK_ENCODING}, but {', '.join(sorted(channel.topic for channel in channels)[:5])}"
        )
    return FrameColumns.concatenate(parts)


def decode_block(block: bytes) -> FrameColumns:
    """Decode the frames of one block, as `logfile.encode_block` made it. Raises ValueError for any other bytes."""
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
    times = first + np.cumsum(steps.astype(np.int64) * unit)
    exact = first + np.cumsum(steps.astype(float)) * unit
    frames.time_ns[0] = first
    frames.time_ns[1:] = np.where(np.abs(exact - times) < TIME_LIMIT_NS, times, -1)  # none where they leave 64 bits
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


def _records(data: Contents, damage: LogDamage) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of the content of all records; after damage those from the next chunk on."""
    if data[: len(MCAP0_MAGIC)] != MCAP0_MAGIC:
        raise InputError(f"{damage.path}: not an MCAP file: it does not begin with the format's magic bytes")
    position = len(MCAP0_MAGIC)
    while position >= 0:
        try:
            for opcode, start, end in _split(data, position, len(data)):
                if opcode == Opcode.FOOTER:
                    return
                yield opcode, start, end
                position = end
            damage.add(f"byte {len(data)}", "the file was cut off: it has no end record")
            return
        except ValueError as error:
            following = _next_chunk(data, position + 1)
            lost = f"{following - position} bytes are not records" if following > 0 else str(error)
            damage.add(f"byte {position}", lost)
            position = following


def _split(data: Contents, position: int, limit: int) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of the content of the records from `position` on. Raises ValueError where one is broken."""
    while position < limit:
        start = position + _RECORD.size
        if start > limit:
            raise ValueError("it ends within a record")
        opcode, length = _RECORD.unpack_from(data, position)
        position = start + length
        if not 0 < opcode <= Opcode.DATA_END or position > limit:
            raise ValueError("it ends within a record" if opcode else "no record here")
        yield opcode, start, position


def _next_chunk(data: Contents, position: int) -> int:
    """Where the next chunk record that fits into the file begins, or -1: found by the name of its compression."""
    offset = _RECORD.size + _COMPRESSION_AT
    found = data.find(_ZSTD_CHUNK, position + offset)
    while found >= 0:
        opcode, length = _RECORD.unpack_from(data, found - offset)
        if opcode == Opcode.CHUNK and found - offset + _RECORD.size + length <= len(data):
            return found - offset
        found = data.find(_ZSTD_CHUNK, found + 1)
    return -1


def _unpack_chunk(content: bytes) -> bytes:
    """The records in a chunk. Raises one of `_BROKEN`."""
    chunk = Chunk.read(ReadDataStream(BytesIO(content)))
    size = chunk.uncompressed_size
    if size > _LARGEST_CHUNK:
        raise ValueError(f"it says that it unpacks to {size} bytes")
    # The decompressor would make room for whatever the packed data say of themselves.
    if chunk.compression == "zstd" and (inside := zstandard.frame_content_size(chunk.data)) not in (size, -1):
        raise ValueError(f"it unpacks to {inside} bytes, not {size}")
    stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    if length != size:
        raise ValueError(f"it unpacks to {length} bytes, not {size}")
    return stream.read(size)
