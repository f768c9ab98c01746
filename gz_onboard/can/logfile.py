"""Write a log: MCAP with raw frames in blocks and JSON channels for the rest (docs/reference/log-format.md)."""

from __future__ import annotations

import contextlib
import json
import math
import os
import struct
from collections.abc import Mapping, Sequence
from math import gcd
from operator import itemgetter, sub
from typing import IO, Any, TypeAlias

from gz_onboard import __version__
from gz_onboard.errors import writable
from gz_onboard.events import Frame
from gz_onboard.imports import without

with without("importlib.metadata", "lz4", "lz4.frame"):  # the first costs more than all the rest of mcap
    from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

BLOCK_FRAMES = 512
BLOCK_NS = 1_000_000_000
"""A block holds at most this many frames and this much time: a reader that looks for a time relies on it."""

MAGIC = MCAP0_MAGIC
_CHUNK_BYTES = 256 * 1024
_encode = json.JSONEncoder(allow_nan=False, separators=(",", ":")).encode  # `dumps` would make one for each sample
_Sample: TypeAlias = tuple[int, int, bytes, int]  # channel, log time [ns], data, time of publishing [ns]

FRAMES_TOPIC = "/can/frames"
BLOCK_ENCODING = "gz-can-block"
BLOCK_SCHEMA_NAME = "gz_onboard.CanFrameBlock"
BLOCK_SCHEMA = """\
Raw CAN frames in one block, version 1, little-endian:
  u8  version = 1
  u8  width of a time step in bytes: 2, 4 or 8
  u16 number of kinds K
  u32 number of frames N
  i64 time of the first frame [ns since 1970-01-01 UTC]
  u32 unit of a time step [ns]
  K times: u32 identifier with the flags of Linux' struct can_frame (0x80000000 29 bit, 0x40000000 remote,
           0x20000000 error), u8 channel (+ 0x80: transmitted by the recorder's host), u8 length of the data
  N times: kind of the frame, u8 where K <= 256, else u16
  N - 1 times: step from the frame before [units], signed, of the given width, as byte planes (the lowest bytes of all
           steps first)
  for each kind, in order: its frames' data as byte planes (byte 0 of all its frames in order, then byte 1, ...)
"""

_HEAD = struct.Struct("<BBHIqI")
_KIND = struct.Struct("<IBB")
_VERSION = 1
_WIDTHS = {2: "h", 4: "i", 8: "q"}
_MAX_KINDS = 0xFFFF


class LogFile:
    """One MCAP file of frames and samples. An I/O error is raised as OSError.

    stream: opened for binary writing; closed by `close`. start_ns: the time of the first entry.
    metadata: text by key, kept in the file's metadata record ``gz_onboard``; attachments: files by name, such as
    the DBC files that the frames can be decoded by.
    """

    def __init__(
        self,
        stream: IO[bytes],
        start_ns: int,
        metadata: Mapping[str, str] | None = None,
        attachments: Mapping[str, bytes] | None = None,
    ) -> None:
        self.start_ns = start_ns
        self.unsynced_frames = 0
        self.flushed = False
        self.stream = stream
        self._pending: list[Frame] = []
        self._later: list[_Sample] = []  # younger than the first of the pending frames
        self._channels: dict[str, int] = {}
        self._writer = Writer(stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library=f"gz-onboard {__version__}")
        named = {key: writable(text) for key, text in (metadata or {}).items()}
        self._writer.add_metadata("gz_onboard", {"version": __version__, **named})
        for name, data in (attachments or {}).items():
            self._writer.add_attachment(start_ns, start_ns, name, "text/plain", data)
        schema = self._writer.register_schema(BLOCK_SCHEMA_NAME, BLOCK_ENCODING, BLOCK_SCHEMA.encode())
        self._frames_channel = self._writer.register_channel(FRAMES_TOPIC, BLOCK_ENCODING, schema)
        stream.flush()  # a file cut off before the first chunk is a valid beginning

    def channel(self, topic: str, json_schema: Mapping[str, Any], metadata: Mapping[str, str] | None = None) -> None:
        """Declare a topic of JSON objects; its schema is named by the JSON schema's ``title``, or the topic."""
        schema = self._writer.register_schema(
            str(json_schema.get("title", topic)), "jsonschema", json.dumps(json_schema, separators=(",", ":")).encode()
        )
        self._channels[topic] = self._writer.register_channel(topic, "json", schema, dict(metadata or {}))

    def frames(self, batch: Sequence[Frame]) -> None:
        """Log raw frames; they are written once there is a block of them, or at the next `flush`."""
        pending = self._pending
        pending += batch
        self.unsynced_frames += len(batch)
        while pending and (len(pending) >= BLOCK_FRAMES or abs(pending[-1][0] - pending[0][0]) >= BLOCK_NS):
            self._write_block(_block_length(pending))

    def sample(self, topic: str, time_ns: int, values: Mapping[str, object], seen_ns: int | None = None) -> None:
        """Log one JSON object on a declared topic; not-a-number and infinities become null.

        seen_ns: when it was so, if not at `time_ns`: the time of publishing, which may go back within a log. The time
        of the log does not, as long as the clock is not set: a sample younger than the first of the pending frames
        waits for them.
        """
        try:
            text = _encode(values)
        except ValueError:
            text = _encode(_without_nan(values))
        sample = self._channels[topic], time_ns, text.encode(), time_ns if seen_ns is None else seen_ns
        if self._pending and time_ns > self._pending[0][0]:
            self._later.append(sample)
        else:
            self._writer.add_message(*sample)

    def note(self, name: str, entries: Mapping[str, str]) -> None:
        """Write another metadata record; the one at the beginning is called ``gz_onboard``."""
        self._writer.add_metadata(name, {key: writable(text) for key, text in entries.items()})

    def flush(self, *, to_disk: bool = False) -> None:
        """Write all that there is, so that it can be read though the file is cut off; to_disk: fsync as well."""
        while self._pending:
            self._write_block(_block_length(self._pending))
        self._writer.flush()  # type: ignore[no-untyped-call]
        if to_disk:
            os.fdatasync(self.stream.fileno())
        self.unsynced_frames = 0
        self.flushed = True

    def close(self) -> None:
        """Write the rest and the summary that lets readers jump to a time."""
        try:
            self.flush()
            self._writer.finish()  # type: ignore[no-untyped-call]
            self.stream.flush()
            os.fsync(self.stream.fileno())
        finally:
            self.stream.close()

    def abandon(self) -> None:
        """Close without writing anything more, after an error."""
        with contextlib.suppress(OSError):
            self.stream.close()

    def _write_block(self, count: int) -> None:
        block = self._pending[:count]
        self._writer.add_message(self._frames_channel, block[0][0], encode_block(block), publish_time=block[-1][0])
        del self._pending[:count]
        later, self._later = sorted(self._later, key=itemgetter(1)), []
        for sample in later:
            if self._pending and sample[1] > self._pending[0][0]:
                self._later.append(sample)
            else:
                self._writer.add_message(*sample)


def object_schema(title: str, units: Mapping[str, str]) -> dict[str, Any]:
    """A JSON schema for an object of numbers, each with its unit; null means not available."""
    properties = {name: {"type": ["number", "null"], "description": unit} for name, unit in units.items()}
    return {"title": title, "type": "object", "properties": properties}


def _block_length(pending: Sequence[Frame]) -> int:
    """How many of the pending frames go into the next block: within a second of the first, in either direction."""
    candidates = pending[:BLOCK_FRAMES]
    first = candidates[0][0]
    if abs(candidates[-1][0] - first) < BLOCK_NS:
        return len(candidates)
    return next(i for i, frame in enumerate(candidates) if abs(frame[0] - first) >= BLOCK_NS)


def _without_nan(value: object) -> object:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    return value


def encode_block(frames: Sequence[Frame]) -> bytes:
    """Frames (at least one, in any order of time) as one block (layout: `BLOCK_SCHEMA`).

    The data bytes stand by kind of frame and there by byte position, because a byte resembles the same byte of the
    frame before it far more than its neighbour: the same frames compress to two thirds of the size that a row for each
    frame would take.

    Raises ValueError for no frames, or more than 65535 kinds of frames (identifier, channel and length).
    """
    if not frames:
        raise ValueError("a block holds at least one frame")
    times, identifiers, datas, channels = zip(*frames, strict=True)
    keys = list(zip(identifiers, channels, map(len, datas), strict=True))
    number = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    if len(number) > _MAX_KINDS:
        raise ValueError(f"{len(number)} kinds of frames in one block, at most {_MAX_KINDS}")
    order = list(map(number.__getitem__, keys))

    steps = list(map(sub, times[1:], times))
    # Most clocks tick more coarsely than in ns: a candump has µs, many loggers 50 or 100 µs.
    unit = gcd(*steps) or 1
    if unit > 0xFFFF_FFFF:
        unit = 1
    if unit > 1:
        steps = [step // unit for step in steps]
    farthest = max(map(abs, steps), default=0)
    width = 2 if farthest < 1 << 15 else 4 if farthest < 1 << 31 else 8

    head = _HEAD.pack(_VERSION, width, len(number), len(frames), times[0], unit)
    parts = [head]
    parts += [_KIND.pack(*key) for key in number]
    parts.append(struct.pack(f"<{len(order)}{'B' if len(number) <= 256 else 'H'}", *order))
    planes = struct.pack(f"<{len(steps)}{_WIDTHS[width]}", *steps)
    parts += [planes[i::width] for i in range(width)]

    by_kind: list[list[bytes]] = [[] for _ in number]
    for kind, data in zip(order, datas, strict=True):
        by_kind[kind].append(data)
    for (_, _, length), of_kind in zip(number, by_kind, strict=True):
        joined = b"".join(of_kind)
        parts += [joined[i::length] for i in range(length)]
    return b"".join(parts)
