"""Vector's binary logging format. Layouts as in python-can's can/io/blf.py and Tobias Lorenz' vector_blf.

A file holds containers, mostly packed by zlib. Their contents, one after the other, are a sequence of objects, of which
some are frames; an object may begin in one container and end in the next.
"""

from __future__ import annotations

import struct
import zlib
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gz_onboard.errors import InputError
from gz_onboard.events import EFF_FLAG, ERR_FLAG, MOST_EXTENDED, RTR_FLAG, TRANSMITTED
from gz_onboard.recording.frames import LATEST_NS, FrameColumns
from gz_onboard.recording.readers.contents import Contents, LogDamage

_FILE = struct.Struct("<4sL8B2Q2L8H8H")
_HEAD = struct.Struct("<4sHHLL")  # signature, header size, header version, object size, object type
_SIGNATURE = b"LOBJ"
_CONTAINER = 10
_CONTAINER_HEAD = 32  # bytes
_LARGEST_CONTAINER = 64 << 20  # bytes, unpacked; usual are 128 kB
_MOST_PADDING = 4  # bytes before an object
_TEN_MICROSECONDS = 1  # unit of an object's time; all others are nanoseconds
_LAST_YEAR = 2261  # whose times in ns fit into 64 bits
_REMOTE, _REMOTE_64 = 0x80, 0x10  # flags


def _layout(itemsize: int, **fields: tuple[str, int]) -> np.dtype[Any]:
    """A record of `itemsize` bytes with fields of (type, offset)."""
    formats, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": itemsize})


_OBJECT = _layout(
    32, header=("<u2", 4), version=("<u2", 6), size=("<u4", 8), kind=("<u4", 12), unit=("<u4", 16), time=("<u8", 24)
)
_BODY_AT = np.array([0, 32, 40])  # bytes from an object's beginning, by the version of its header
_CAN = _layout(16, channel=("<u2", 0), flags=("u1", 2), length=("u1", 3), identifier=("<u4", 4), data=("8u1", 8))
_ERROR = _layout(32, channel=("<u2", 0), length=("u1", 10), identifier=("<u4", 16), data=("8u1", 24))
_FD = _layout(84, channel=("<u2", 0), flags=("u1", 2), identifier=("<u4", 4), length=("u1", 14), data=("64u1", 20))
_FD_64 = _layout(
    104,
    channel=("u1", 0),
    length=("u1", 2),
    identifier=("<u4", 4),
    flags=("<u4", 12),
    sent=("u1", 34),
    extension=("u1", 35),
    data=("64u1", 40),
)
_ERROR_FRAME, _FD_MESSAGE, _FD_MESSAGE_64 = 73, 100, 101
_FRAMES = {1: _CAN, 86: _CAN, _ERROR_FRAME: _ERROR, _FD_MESSAGE: _FD, _FD_MESSAGE_64: _FD_64}
"""Layouts of the objects that are frames, behind their header, by type."""
_IDENTIFIER = EFF_FLAG | MOST_EXTENDED
_AFTER = bytes(256)  # so that a record may be read where the content ends


def read(data: Contents, damage: LogDamage) -> FrameColumns:
    """Read the frames of a BLF file; note as damage what cannot be read."""
    if len(data) < _FILE.size or data[:4] != b"LOGG":
        raise InputError(f"{damage.path}: not a BLF file: it does not begin with LOGG and a header")
    header = _FILE.unpack_from(data)
    start_ns, position, promised = _file_start(header[14:22]), header[1], header[12]
    objects, tail, parts = 0, b"", []
    while 0 <= position < len(data):
        signature, _, _, size, kind = _HEAD.unpack(data[position : position + _HEAD.size].ljust(_HEAD.size, b"\0"))
        if signature != _SIGNATURE:
            size = kind = 0
        following = position + size + size % 4
        if kind == _CONTAINER:
            content, whole = _unpack(data, position, min(position + size, len(data)))
            if not whole:
                damage.add(f"byte {position}", "a container is cut off or broken")
            content = tail + content
            starts, tail = _starts(content, damage, f"byte {position}")
            objects += len(starts)
            parts.append(_frames(content + _AFTER, starts, start_ns, damage, f"byte {position}"))
        else:  # nothing that holds frames, if it is an object at all
            another = data[following : following + 4] == _SIGNATURE or len(data) <= following < len(data) + 4
            whole = size >= _HEAD.size and another
            if not whole:
                damage.add(f"byte {position}", "no object begins here")
            tail = b""
        if not whole:  # its size cannot be trusted either
            tail = b""
            following = data.find(_SIGNATURE, position + 4)
        position = following
    if len(tail) > _MOST_PADDING:
        damage.add(f"byte {len(data)}", "the last object is cut off")
    if objects < promised and not damage.count:
        damage.add("in the middle", f"{promised - objects} of {promised} objects are missing")
    return FrameColumns.concatenate(parts)


def _file_start(fields: tuple[int, ...]) -> int:
    """Time [ns since the epoch] of Windows' SYSTEMTIME (UTC); 0 if the fields are no date."""
    year, month, _, day, hour, minute, second, millisecond = fields
    try:
        start = datetime(min(year, _LAST_YEAR), month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return 0
    return int(start.timestamp()) * 1_000_000_000 + millisecond * 1_000_000


def _unpack(data: Contents, position: int, end: int) -> tuple[bytes, bool]:
    """Unpack a container as far as possible; also return whether it was whole."""
    if end < position + _CONTAINER_HEAD:
        return b"", False
    method, size = struct.unpack_from("<H6xL", data, position + 16)
    packed = data[position + _CONTAINER_HEAD : end]
    if method == 0:
        return packed, len(packed) >= size
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(packed, _LARGEST_CONTAINER)
    except zlib.error:  # what was unpacked before the error was found may be wrong
        return b"", False
    return content, unpacker.eof and len(unpacker.unused_data) < 4


def _starts(content: bytes, damage: LogDamage, place: str) -> tuple[NDArray[np.int64], bytes]:
    """Find where the whole objects of `content` begin; also return the rest, which the next container completes."""
    letters = np.flatnonzero(np.frombuffer(content, np.uint8) == _SIGNATURE[0])
    padded = content + _AFTER
    starts = letters[_records(padded, letters, np.dtype("S4")) == _SIGNATURE]
    sizes = _records(padded, starts, _OBJECT)["size"].astype(np.int64)
    ends = starts + sizes
    nexts = np.append(starts, len(content))
    gaps = nexts[np.searchsorted(nexts[:-1], ends)] - ends
    is_plausible = (sizes >= _HEAD.size) & (gaps >= 0)
    is_whole = is_plausible & (gaps <= _MOST_PADDING)  # data may spell the signature too
    # With damage behind; if less is behind, it may be padding and the first letters of a signature.
    before_damage = is_plausible & (gaps >= _MOST_PADDING + len(_SIGNATURE))
    if before_damage.any():  # those that overlap no whole object are whole
        begins, reach = starts[is_whole], np.append(0, np.maximum.accumulate(ends[is_whole]))
        before = np.searchsorted(begins, starts)
        is_apart = (before == np.searchsorted(begins, ends)) & (reach[before] <= starts)
        is_whole |= before_damage & is_apart
    ends = np.append(0, ends[is_whole])
    begin_of_rest = int(nexts[np.searchsorted(nexts, ends[-1])])
    if (np.append(starts[is_whole], begin_of_rest) - ends > _MOST_PADDING).any():
        damage.add(place, "no object where one should begin in this container")
    return starts[is_whole], content[max(int(ends[-1]), begin_of_rest - _MOST_PADDING) :]


def _records(content: bytes, at: NDArray[np.int64], layout: np.dtype[Any]) -> NDArray[Any]:
    """The records of one layout that begin at the bytes `at`, which may overlap; mostly at even distances."""
    size, steps = layout.itemsize, np.diff(at)
    if len(steps) and (steps == steps[0]).all():
        return np.ndarray(len(at), layout, content, int(at[0]), (int(steps[0]),))
    everywhere = np.ndarray((len(content) - size + 1,), f"V{size}", content, strides=(1,))
    return everywhere[at].view(layout)


def _frames(content: bytes, starts: NDArray[np.int64], start_ns: int, damage: LogDamage, place: str) -> FrameColumns:
    """Return the frames among the objects that begin at `starts`; an object too short for its type is damage."""
    objects = _records(content, starts, _OBJECT)
    has_fd = bool(np.isin(objects["kind"], (_FD_MESSAGE, _FD_MESSAGE_64)).any())
    columns = FrameColumns.empty(len(starts), 64 if has_fd else 8)
    unit = np.where(objects["unit"] == _TEN_MICROSECONDS, 10_000, 1).astype(np.uint64)
    columns.time_ns[:] = start_ns + (np.minimum(objects["time"], LATEST_NS // unit) * unit).astype(np.int64)
    good = np.zeros(len(starts), bool)
    for kind, layout in _FRAMES.items():
        chosen = (objects["kind"] == kind) & (objects["version"] >= 1) & (objects["version"] <= 2)
        if not chosen.any():
            continue
        at: Any = slice(None) if chosen.all() else np.flatnonzero(chosen)  # a slice is not copied
        body = _BODY_AT[objects["version"][at]]
        fields = _records(content, starts[at] + body, layout)
        data, length = fields["data"], fields["length"]
        flags = fields["flags"] if kind != _ERROR_FRAME else np.zeros_like(length)
        sent = fields["sent"] if kind == _FD_MESSAGE_64 else flags & 1
        remote = flags & (_REMOTE_64 if kind == _FD_MESSAGE_64 else _REMOTE) != 0
        end = objects["size"][at].astype(np.int64)
        if kind == _FD_MESSAGE_64:  # its data may be followed by an extension, and their last zeros be left out
            end = np.where(fields["extension"], fields["extension"], end)
        there = end - body - (layout.itemsize - data.shape[1])
        if kind in (_FD_MESSAGE, _FD_MESSAGE_64):
            length = np.where(remote, np.minimum(length, 8), length)
        else:  # a code of 9 to 15 means 8 bytes
            length = np.minimum(length, 8)
        if remote.any() or there.min() < data.shape[1]:
            data = np.where((np.arange(data.shape[1]) >= there[:, None]) | remote[:, None], 0, data)
        columns.identifier[at] = fields["identifier"] & _IDENTIFIER | np.where(
            remote, RTR_FLAG, ERR_FLAG if kind == _ERROR_FRAME else 0
        ).astype(np.uint32)
        columns.channel[at] = (fields["channel"] - 1) & 0x7F | np.where(sent, TRANSMITTED, 0)
        columns.length[at] = length
        columns.data[at, : data.shape[1]] = data
        good[at] = (there >= length) | (kind == _FD_MESSAGE_64) & (there >= 0)
        if broken := int((~good[at]).sum()):
            damage.add(place, f"a broken object of type {kind} in this container", broken)
    return columns if good.all() else columns[good]
