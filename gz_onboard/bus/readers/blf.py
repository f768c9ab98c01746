"""Vector's binary logging format. Layouts as in python-can's can/io/blf.py and Tobias Lorenz' vector_blf."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from gz_onboard.bus.readers.common import BATCH, Contents, Damage
from gz_onboard.errors import InputError
from gz_onboard.events import EFF_FLAG, ERR_FLAG, RTR_FLAG, TRANSMITTED, Frame

_FILE = struct.Struct("<4sL8B2Q2L8H8H")
_OBJECT = struct.Struct("<4sHHLL")  # signature, header size, header version, object size, object type
_TIME_1 = struct.Struct("<LHHQ")  # flags, client, object version, time
_TIME_2 = struct.Struct("<LBxHQ8x")
CAN = struct.Struct("<HBBL8s")  # channel, flags, length, identifier, data
FD = struct.Struct("<HBBLLBBB5x64s")
_FD_64 = struct.Struct("<BBBBLLLLLLLHBBL")
ERROR = struct.Struct("<HHLBBBxLLH2x8s")
_CONTAINER, _CAN_1, _ERROR_EXT, _CAN_2, _FD_1, _FD_2 = 10, 1, 73, 86, 100, 101
_TEN_MICROSECONDS = 1
_LARGEST_CONTAINER = 64 << 20  # bytes, unpacked; usual are 128 kB
_ID_MASK = EFF_FLAG | 0x1FFF_FFFF


def read(path: Path, data: Contents, damage: Damage, _start: int | None, _end: int | None) -> Iterator[list[Frame]]:
    """The frames of a BLF file; what cannot be read is noted as damage."""
    if len(data) < _FILE.size or data[:4] != b"LOGG":
        raise InputError(f"{path}: not a BLF file: it does not begin with LOGG and a header")
    header = _FILE.unpack_from(data)
    start_ns = _file_start(header[14:22])
    position = header[1]
    promised = header[12]
    objects = 0
    tail = b""
    while 0 <= position < len(data):
        signature, size, kind = _container(data, position)
        following = position + size + size % 4
        if kind == _CONTAINER:
            content, whole = _unpack(data, position, min(position + size, len(data)))
            if not whole:
                damage.add(f"byte {position}", "a container is cut off or broken")
            frames, tail, count = _objects(tail + content, start_ns, damage, position)
            objects += count
            for i in range(0, len(frames), BATCH):
                yield frames[i : i + BATCH]
        else:  # nothing that holds frames, if it is an object at all
            another = data[following : following + 4] == b"LOBJ" or len(data) <= following < len(data) + 4
            whole = signature == b"LOBJ" and size >= _OBJECT.size and another
            if not whole:
                damage.add(f"byte {position}", "no object begins here")
            tail = b""
        if not whole:  # nor is its size to be trusted
            tail = b""
            following = data.find(b"LOBJ", position + 4)
        position = following
    if tail:
        damage.add(f"byte {len(data)}", "the last object is cut off")
    if objects < promised and not damage.count:
        damage.add("in the middle", f"{promised - objects} of {promised} objects are missing")


def _container(data: Contents, position: int) -> tuple[bytes, int, int]:
    """Signature, size and type of the object at the position; an empty signature and no type if there is none."""
    if position + _OBJECT.size > len(data) or data[position : position + 4] != b"LOBJ":
        return b"", 0, 0
    signature, _, _, size, kind = _OBJECT.unpack_from(data, position)
    return signature, size, kind


def _file_start(fields: tuple[int, ...]) -> int:
    """Windows' SYSTEMTIME (UTC) -> ns since the epoch; 0 if there is none."""
    year, month, _, day, hour, minute, second, millisecond = fields
    try:
        start = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return 0
    return int(start.timestamp()) * 1_000_000_000 + millisecond * 1_000_000


def _unpack(data: Contents, position: int, end: int) -> tuple[bytes, bool]:
    """The content of a container as far as it can be had, and whether that is all of it."""
    if end < position + 32:
        return b"", False
    method, size = struct.unpack_from("<H6xL", data, position + 16)
    packed = data[position + 32 : end]
    if method == 0:
        return packed, len(packed) >= size
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(packed, _LARGEST_CONTAINER)
    except zlib.error:  # what was unpacked before the error was found may be wrong
        return b"", False
    return content, unpacker.eof and len(unpacker.unused_data) < 4


def _objects(data: bytes, start_ns: int, damage: Damage, place: int) -> tuple[list[Frame], bytes, int]:
    """The frames of a container's content, what is left over of an object that goes on in the next one, and how many
    objects there were.
    """
    frames, position = _alike(data, start_ns)
    count = len(frames)
    while position + 8 <= len(data):
        found = data.find(b"LOBJ", position, position + 8)  # objects may be padded
        if found < 0:
            damage.add(f"byte {place}", "no object where one should begin in this container")
            found = data.find(b"LOBJ", position)
            if found < 0:
                return frames, b"", count
        position = found
        if position + _OBJECT.size > len(data):
            break
        _, header_size, version, size, kind = _OBJECT.unpack_from(data, position)
        if size < _OBJECT.size:
            damage.add(f"byte {place}", f"an object of {size} bytes in this container")
            position += 4
            continue
        if position + size > len(data):
            break
        try:
            frame = _frame(data, position, header_size, version, size, kind, start_ns)
        except (struct.error, ValueError):
            damage.add(f"byte {place}", f"a broken object of type {kind} in this container")
            frame = None
        if frame:
            frames.append(frame)
        position += size
        count += 1
    return frames, data[position:], count


def _alike(data: bytes, start_ns: int) -> tuple[list[Frame], int]:
    """The frames of a content that is classic CAN frames of one form only, which most are, and where they end."""
    if len(data) < 48:
        return [], 0
    signature, header_size, version, size, kind = _OBJECT.unpack_from(data)
    if (signature, header_size, version) != (b"LOBJ", 32, 1) or kind not in (_CAN_1, _CAN_2) or size not in (48, 56):
        return [], 0
    whole = len(data) // size * size
    objects = data[:whole]
    count = whole // size
    # The header up to the flags of the time must be the same everywhere: compared column by column, in C.
    if any(objects[i::size] != objects[i : i + 1] * count for i in range(20)):
        return [], 0
    unit = 10_000 if struct.unpack_from("<L", data, 16)[0] == _TEN_MICROSECONDS else 1
    fields = struct.Struct(f"<24xQHBBL8s{size - 48}x")
    frames: list[Frame] = []
    append = frames.append
    for time, channel, flags, length, identifier, payload in fields.iter_unpack(objects):
        if flags or length > 8 or not 0 < channel <= TRANSMITTED:
            append(_can(start_ns + time * unit, channel, flags, length, identifier, payload))
        else:
            append((start_ns + time * unit, identifier & _ID_MASK, payload[:length], channel - 1))
    return frames, whole


def _can(time_ns: int, channel: int, flags: int, length: int, identifier: int, payload: bytes) -> Frame:
    identifier &= _ID_MASK
    channel = (channel - 1) & 0x7F
    if flags & 0x01:
        channel |= TRANSMITTED
    if flags & 0x80:
        return time_ns, identifier | RTR_FLAG, bytes(min(length, 8)), channel
    return time_ns, identifier, payload[:length], channel


def _frame(
    data: bytes, position: int, header_size: int, version: int, size: int, kind: int, start_ns: int
) -> Frame | None:
    """The frame in one object, or None if the object is not a frame. Raises struct.error if it is too short."""
    if kind not in (_CAN_1, _CAN_2, _ERROR_EXT, _FD_1, _FD_2) or version not in (1, 2):
        return None
    time_header = _TIME_1 if version == 1 else _TIME_2
    time_fields = time_header.unpack_from(data, position + _OBJECT.size)
    flags, time = time_fields[0], time_fields[-1]
    time_ns = start_ns + time * (10_000 if flags == _TEN_MICROSECONDS else 1)
    body = position + _OBJECT.size + time_header.size
    if kind in (_CAN_1, _CAN_2):
        channel, flags, length, identifier, payload = CAN.unpack_from(data, body)
        return _can(time_ns, channel, flags, length, identifier, payload)
    if kind == _ERROR_EXT:
        channel, _, _, _, _, length, _, identifier, _, payload = ERROR.unpack_from(data, body)
        identifier = identifier & _ID_MASK | ERR_FLAG
        return time_ns, identifier, payload[:length], (channel - 1) & 0x7F
    if kind == _FD_1:
        channel, flags, length, identifier, _, _, _, valid, payload = FD.unpack_from(data, body)
        transmitted, remote = flags & 0x01, flags & 0x80
        payload = payload[:valid]
    else:
        fields = _FD_64.unpack_from(data, body)
        channel, length, valid, _, identifier, _, flags = fields[:7]
        transmitted, extension = fields[12], fields[13]
        remote = flags & 0x0010
        there = min(valid, (extension or size) - header_size - _FD_64.size)
        payload = data[body + _FD_64.size : body + _FD_64.size + there].ljust(valid, b"\0")
    channel = (channel - 1) & 0x7F | (TRANSMITTED if transmitted else 0)
    identifier &= _ID_MASK
    if remote:
        return time_ns, identifier | RTR_FLAG, bytes(min(length, 8)), channel
    return time_ns, identifier, payload, channel
