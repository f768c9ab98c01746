"""Completing logs that were cut off (power lost, process killed): the summary that MCAP readers need is built again.

What was written stays as it is; only what comes after the last whole record, and cannot be read, is cut away.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from io import BytesIO
from pathlib import Path
from typing import IO
from zlib import crc32

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from gz_onboard.bus.readers import mcap
from gz_onboard.bus.readers.common import Contents, Damage

_MESSAGE = struct.Struct("<HLQ")


def is_complete(path: Path) -> bool:
    """Whether the log has its end. OSError if it cannot be read."""
    with path.open("rb") as stream:
        size = stream.seek(0, os.SEEK_END)
        stream.seek(max(size - len(mcap.MAGIC), 0))
        return size > 2 * len(mcap.MAGIC) and stream.read() == mcap.MAGIC


def complete(path: Path) -> bool:
    """Give a log the end that it lacks; False if another process writes it, or it is no MCAP file at all.

    OSError if it cannot be written: it can be read then as well as before.
    """
    with path.open("r+b") as stream:
        if not lock(stream):
            return False
        times = os.fstat(stream.fileno())
        if times.st_size <= len(mcap.MAGIC):
            return False
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            if data[: len(mcap.MAGIC)] != mcap.MAGIC:
                return False
            found = _Found(path, data)
        stream.truncate(found.end)
        stream.seek(found.end)
        stream.write(b"".join(found.rest()))
        stream.flush()
        os.fsync(stream.fileno())
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))  # still the time of what is in it
    return True


def lock(stream: IO[bytes]) -> bool:
    """Mark an open log as being written, until it is closed; False if it is by another. Without locks: True."""
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system that has none
        pass
    return True


class _Found:
    """What stands in a log without an end: all that its summary holds, and `end`, behind the last whole record."""

    def __init__(self, path: Path, data: Contents) -> None:
        self.end = len(mcap.MAGIC)
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: Counter[int] = Counter()
        self._last_index: list[MessageIndex] = []  # of the last chunk, to be written if it is not there
        chunk: ChunkIndex | None = None
        for opcode, start, end in mcap.records(path, data, Damage()):
            begin = start - mcap.RECORD.size
            try:
                if opcode == Opcode.CHUNK:
                    chunk = None
                    chunk = self._chunk(data, start, end)
                elif opcode == Opcode.MESSAGE_INDEX:
                    if chunk is None:
                        continue  # of a chunk that is broken
                    index, known = MessageIndex.read(_stream(data[start:end])), self._last_index
                    if index.records != next((i.records for i in known if i.channel_id == index.channel_id), []):
                        continue  # what a cut has left of it
                    chunk.message_index_offsets[index.channel_id] = begin
                    chunk.message_index_length += end - begin
                    if {i.channel_id for i in known} - chunk.message_index_offsets.keys():
                        continue  # cut off here, all are written again
                else:
                    self._other(opcode, data[start:end], begin, end - begin)
            except (*mcap.BROKEN, EndOfFile):
                continue
            self.end = end
        last = self._chunks[-1] if self._chunks else None
        if last and self.end == last.chunk_start_offset + last.chunk_length:
            last.message_index_offsets.clear()
        else:
            self._last_index = []

    def _chunk(self, data: Contents, start: int, end: int) -> ChunkIndex:
        content = mcap.unpack_chunk(data, start, end)
        indices: dict[int, MessageIndex] = {}
        schemas, channels = [], []
        for opcode, at, until in mcap.records_in(content):
            if opcode == Opcode.MESSAGE:
                number, _, time_ns = _MESSAGE.unpack_from(content, at)
                index = indices.setdefault(number, MessageIndex(number, []))
                index.records.append((time_ns, at - mcap.RECORD.size))
            elif opcode == Opcode.SCHEMA:
                schemas.append(Schema.read(_stream(content[at:until])))
            elif opcode == Opcode.CHANNEL:
                channels.append(Channel.read(_stream(content[at:until])))
        first, last, size, _, name = mcap.CHUNK.unpack_from(data, start)
        compression = data[start + mcap.CHUNK.size : start + mcap.CHUNK.size + name].decode("ascii", "replace")
        packed = end - start - mcap.CHUNK.size - name - 8
        self._schemas |= {schema.id: schema for schema in schemas}
        self._channels |= {channel.id: channel for channel in channels}
        self._counts.update({number: len(index.records) for number, index in indices.items()})
        self._last_index = list(indices.values())
        chunk = ChunkIndex(
            chunk_length=end - start + mcap.RECORD.size,
            chunk_start_offset=start - mcap.RECORD.size,
            compression=compression,
            compressed_size=packed,
            message_end_time=last,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=first,
            uncompressed_size=size,
        )
        self._chunks.append(chunk)
        return chunk

    def _other(self, opcode: int, content: bytes, begin: int, length: int) -> None:
        if opcode == Opcode.ATTACHMENT:
            a = Attachment.read(_stream(content))
            self._attachments.append(
                AttachmentIndex(begin, length, a.log_time, a.create_time, len(a.data), a.name, a.media_type)
            )
        elif opcode == Opcode.METADATA:
            self._metadata.append(MetadataIndex(begin, length, Metadata.read(_stream(content)).name))
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(_stream(content))
            self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(_stream(content))
            self._channels[channel.id] = channel

    def rest(self) -> Iterator[bytes]:
        """The bytes that `end` is to be followed by: as mcap's own writer ends a file."""
        indices = RecordBuilder()
        for index in self._last_index:
            self._chunks[-1].message_index_offsets[index.channel_id] = self.end + indices.count
            index.write(indices)
        if self._last_index:
            self._chunks[-1].message_index_length = indices.count
        DataEnd(0).write(indices)
        data = indices.end()  # type: ignore[no-untyped-call]
        yield data
        summary_start = self.end + len(data)
        summary = RecordBuilder()
        offsets = []
        for opcode, group in self._groups():
            begin = summary.count
            for record in group:
                record.write(summary)
            offsets.append(SummaryOffset(opcode, summary_start + begin, summary.count - begin))
        offsets_start = summary_start + summary.count
        for offset in offsets:
            offset.write(summary)
        content = summary.end()  # type: ignore[no-untyped-call]
        yield content
        head = struct.pack("<BQQQ", Opcode.FOOTER, 20, summary_start, offsets_start)
        footer = RecordBuilder()
        Footer(summary_start, offsets_start, summary_crc=crc32(head, crc32(content))).write(footer)
        yield footer.end()  # type: ignore[no-untyped-call]
        yield mcap.MAGIC

    def _groups(self) -> Iterable[tuple[int, Sequence[McapRecord]]]:
        counts = self._counts
        times = [time for c in self._chunks for time in (c.message_start_time, c.message_end_time)]
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(counts),
            chunk_count=len(self._chunks),
            message_count=counts.total(),
            message_end_time=max(times, default=0),
            message_start_time=min(times, default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        return (
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, list(self._channels.values())),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        )


def _stream(content: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(content))
