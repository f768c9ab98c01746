"""Encode raw CAN frames as the binary blocks of our log (layout: docs/log-format.md).

Within a block the data bytes stand by kind of frame (same identifier, channel and length) and there by byte
position, because a byte resembles the same byte of the frame before it far more than its neighbour: the same
frames compress to two thirds of the size that a row for each frame would take. Nothing is lost: times are kept
to the nanosecond and the order of the frames is kept.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from math import gcd
from operator import sub

from gz_onboard.events import Frame

TOPIC = "/can/frames"
ENCODING = "gz-can-block"
SCHEMA_NAME = "gz_onboard.CanFrameBlock"
SCHEMA_TEXT = """\
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


def encode_block(frames: Sequence[Frame]) -> bytes:
    """Frames (at least one, in any order of time) as one block.

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
