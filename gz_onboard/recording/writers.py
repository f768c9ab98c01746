"""Writers of frames that keep times exactly: candump to the µs, BLF to the ns.

python-can's writers go through floats of seconds, which since 1970 have no more than 0.24 µs.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import IO

from gz_onboard.events import EFF_FLAG, ERR_FLAG, RTR_FLAG, TRANSMITTED, Frame


def write_candump(stream: IO[str], batches: Iterable[Iterable[Frame]]) -> int:
    """Write frames as ``candump -L`` does, times cut to µs; returns how many. Sent ones are marked by `` T``."""
    count = 0
    for batch in batches:
        lines = []
        for time_ns, identifier, data, channel in batch:
            seconds, rest = divmod(time_ns, 1_000_000_000)
            if identifier & ERR_FLAG:
                name = f"{identifier & 0x3FFF_FFFF:08X}"
            elif identifier & EFF_FLAG:
                name = f"{identifier & 0x1FFF_FFFF:08X}"
            else:
                name = f"{identifier & 0x7FF:03X}"
            if identifier & RTR_FLAG:
                payload = f"R{len(data) or ''}"
            else:
                payload = ("#0" if len(data) > 8 else "") + data.hex().upper()
            sent = " T" if channel & TRANSMITTED else ""
            lines.append(f"({seconds}.{rest // 1000:06d}) can{channel & ~TRANSMITTED} {name}#{payload}{sent}\n")
        stream.write("".join(lines))
        count += len(lines)
    return count


_BLF_CAN = struct.Struct("<HBBL8s")  # channel, flags, length, identifier, data
_BLF_FD = struct.Struct("<HBBLLBBB5x64s")
_BLF_ERROR = struct.Struct("<HHLBBBxLLH2x8s")
_BLF_FILE = struct.Struct("<4sL8B2Q2L8H8H72x")
_BLF_OBJECT = struct.Struct("<4sHHLLLHHQ")  # signature, header, version, size, type, time unit, client, version, time
_BLF_CONTAINER = struct.Struct("<4sHHLLH6xL4x")
_BLF_CONTENT = 128 * 1024
_BLF_NANOSECONDS = 2
_BLF_FD_CODES = {12: 9, 16: 10, 20: 11, 24: 12, 32: 13, 48: 14, 64: 15}
_FIRST_DATE_NS = 631_152_000 * 1_000_000_000  # before 1990 a time is not a date but counts from zero


def write_blf(stream: IO[bytes], batches: Iterable[list[Frame]]) -> int:
    """Write frames as Vector's BLF into a seekable stream; returns how many.

    Frames from before the earliest of the first batch, which BLF has no way to express, are given that one's time.
    """
    stream.write(bytes(_BLF_FILE.size))
    start_ns: int | None = None
    last_ns = 0
    count = 0
    total = _BLF_FILE.size
    content = bytearray()
    for batch in batches:
        if start_ns is None:
            first = min(frame[0] for frame in batch)
            start_ns = first // 1_000_000 * 1_000_000 if first >= _FIRST_DATE_NS else 0
        for frame in batch:
            content += _blf_object(frame, start_ns)
        last_ns = batch[-1][0]
        count += len(batch)
        while len(content) >= _BLF_CONTENT:
            total += _blf_container(stream, content[:_BLF_CONTENT])
            del content[:_BLF_CONTENT]
    if content:
        total += _blf_container(stream, content)
    size = stream.tell()
    stream.seek(0)
    times = (*_system_time(start_ns or 0), *_system_time(last_ns))
    stream.write(_BLF_FILE.pack(b"LOGG", _BLF_FILE.size, 5, 0, 0, 0, 2, 6, 8, 1, size, total, count, 0, *times))
    return count


def _blf_object(frame: Frame, start_ns: int) -> bytes:
    time_ns, identifier, data, channel = frame
    number = (channel & ~TRANSMITTED) + 1
    flags = (0x80 if identifier & RTR_FLAG else 0) | (0x01 if channel & TRANSMITTED else 0)
    bare = identifier & (EFF_FLAG | 0x1FFF_FFFF)
    if identifier & ERR_FLAG:
        kind, body = 73, _BLF_ERROR.pack(number, 0, 0, 0, 0, min(len(data), 8), 0, bare, 0, data[:8])
    elif len(data) > 8:
        code = _BLF_FD_CODES.get(len(data), 15)
        kind, body = 100, _BLF_FD.pack(number, flags, code, bare, 0, 0, 1, len(data), data)
    else:
        kind, body = 1, _BLF_CAN.pack(number, flags, len(data), bare, data)
    size = _BLF_OBJECT.size + len(body)
    return (
        _BLF_OBJECT.pack(b"LOBJ", _BLF_OBJECT.size, 1, size, kind, _BLF_NANOSECONDS, 0, 0, max(time_ns - start_ns, 0))
        + body
    )


def _blf_container(stream: IO[bytes], content: bytearray) -> int:
    """Write one container; returns its size as it would be unpacked."""
    packed = zlib.compress(content)
    size = _BLF_CONTAINER.size + len(packed)
    stream.write(_BLF_CONTAINER.pack(b"LOBJ", 16, 1, size, 10, 2, len(content)))
    stream.write(packed)
    stream.write(bytes(size % 4))
    return _BLF_CONTAINER.size + len(content)


def _system_time(time_ns: int) -> tuple[int, ...]:
    """Windows' SYSTEMTIME in UTC, to the ms; zeros for a time that is not a date."""
    if time_ns < _FIRST_DATE_NS:
        return (0,) * 8
    t = datetime.fromtimestamp(time_ns // 1_000_000_000, UTC)
    return (t.year, t.month, t.isoweekday() % 7, t.day, t.hour, t.minute, t.second, time_ns // 1_000_000 % 1000)
