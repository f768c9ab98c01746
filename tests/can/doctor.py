"""What the doctor of the `mcap` command line asks of a file, asked with the `mcap` library."""

from __future__ import annotations

import json
import zlib
from collections import Counter
from pathlib import Path

import zstandard
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, ChunkIndex, DataEnd, Footer, Header, Message, MessageIndex, Schema, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk


def complaints(path: Path) -> list[str]:
    """Of a finished file: records missing, twice, or of unknown ones; order of messages, indexes, counts, checksums."""
    found: list[str] = []
    records = list(StreamReader(path.open("rb"), emit_chunks=True, validate_crcs=True).records)
    inner: list[tuple[Schema | Channel | Message, ...]] = []
    indexes: list[list[MessageIndex]] = []
    chunks: list[Chunk] = []
    for record in records:
        if isinstance(record, Chunk):
            chunks.append(record)
            indexes.append([])
            inner.append(tuple(r for r in breakup_chunk(record) if isinstance(r, Schema | Channel | Message)))
            found += _of_chunk(record, [r for r in inner[-1] if isinstance(r, Message)])
        elif isinstance(record, MessageIndex):
            indexes[-1].append(record)
        elif isinstance(record, Message):
            found.append("a message outside of a chunk")
    header, last = records[0], records[-1]
    if not isinstance(header, Header) or not header.library or header.profile:
        found.append("the header")
    if not isinstance(last, Footer) or not any(isinstance(r, DataEnd) for r in records):
        found.append("no end")
    content = [r for chunk in inner for r in chunk]
    found += _of_content(content)
    for number, (messages, told) in enumerate(zip(inner, indexes, strict=True)):
        counted = Counter(m.channel_id for m in messages if isinstance(m, Message))
        if {i.channel_id: len(i.records) for i in told if i.records} != counted:
            found.append(f"the message indexes of chunk {number}")
    (statistics,) = [r for r in records if isinstance(r, Statistics)]
    counts = Counter(m.channel_id for m in content if isinstance(m, Message))
    times = [m.log_time for m in content if isinstance(m, Message)]
    if {k: v for k, v in statistics.channel_message_counts.items() if v} != counts:
        found.append("the statistics' counts of messages")
    if (statistics.message_start_time, statistics.message_end_time) != (min(times), max(times)):
        found.append("the statistics' times")
    if statistics.chunk_count != len(chunks) or len(chunks) != sum(isinstance(r, ChunkIndex) for r in records):
        found.append("the number of chunks")
    with path.open("rb") as stream:
        read = sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages())
    return found if read == len(times) else [*found, "the index does not lead to all messages"]


def _of_chunk(chunk: Chunk, messages: list[Message]) -> list[str]:
    data = zstandard.decompress(chunk.data, chunk.uncompressed_size)
    times = [message.log_time for message in messages]
    wrong = []
    if chunk.uncompressed_crc == 0 or zlib.crc32(data) != chunk.uncompressed_crc:
        wrong.append("the checksum of a chunk")
    if times and (chunk.message_start_time, chunk.message_end_time) != (min(times), max(times)):
        wrong.append("the times of a chunk")
    return wrong


def _of_content(content: list[Schema | Channel | Message]) -> list[str]:
    """Of what is in chunks, in order."""
    found: list[str] = []
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    latest = 0
    for record in content:
        if isinstance(record, Schema):
            if record.id in schemas or not record.id or not record.encoding or not record.data:
                found.append(f"schema {record.name}")
            schemas[record.id] = record
        elif isinstance(record, Channel):
            if record.id in channels or record.schema_id not in schemas:
                found.append(f"channel {record.topic}")
            channels[record.id] = record
        elif (channel := channels.get(record.channel_id)) is None:
            found.append("a message of an unknown channel")
        else:
            if record.log_time < latest:
                found.append(f"{channel.topic}: {latest - record.log_time} ns before the message before it")
            latest = max(latest, record.log_time)
            if channel.message_encoding == "json" and not isinstance(json.loads(record.data), dict):
                found.append(f"{channel.topic}: no object")
    return found
