"""candump text logs: those of ``candump -L``, and what candump shows on the screen, with a time or without."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

from gz_onboard.bus.readers.common import FD_LENGTHS, ChannelNumbers, Clock, Contents, Damage, stamp_ns, text_pieces
from gz_onboard.errors import InputError
from gz_onboard.events import EFF_FLAG, ERR_FLAG, RTR_FLAG, TRANSMITTED, Frame

CANDUMP_LINE = re.compile(
    r"\((?P<s>\d+)(?:\.(?P<fraction>\d{1,9}))?\)\s+(?P<channel>\S+)\s+(?P<id>[0-9A-Fa-f]{1,8})#"
    r"(?:#(?P<fd>[0-9A-Fa-f](?:[0-9A-Fa-f]{2}){0,64})|[Rr](?P<remote>[0-8]?)|(?P<data>(?:[0-9A-Fa-f]{2}){0,8}))"
    r"(?:\s+(?P<direction>[RrTt]))?"
)
SCREEN_LINE = re.compile(
    r"(?:\((?P<stamp>[^)]+)\)\s+)?(?P<channel>[^\s(]\S*)\s+(?:(?P<direction>[RT])X\s+\S\s+\S\s+)?"
    r"(?P<id>[0-9A-Fa-f]{1,8})\s+\[(?P<length>\d{1,2})\](?:\s+(?P<remote>remote request)|"
    r"(?P<data>(?:\s*[0-9A-Fa-f]{2})*))\s*(?:'.*'|ERRORFRAME)?"
)
_SCALE = {digits + 1: 10 ** (9 - digits) for digits in range(1, 10)}
"""Length of the fraction with the closing bracket -> ns in a unit of its last digit."""


class _Identifiers(dict[str, int]):
    """Text of an identifier in a candump -> identifier with flags: more than 3 digits mean 29 bits."""

    def __missing__(self, text: str) -> int:
        value = int(text, 16)
        if len(text) > 3:
            value = value if value & ERR_FLAG else (value & 0x1FFF_FFFF) | EFF_FLAG
        elif value > 0x7FF:
            raise ValueError(f"identifier {text} has more than 11 bits")
        self[text] = value
        return value


def read(path: Path, data: Contents, damage: Damage, _start: int | None, _end: int | None) -> Iterator[list[Frame]]:
    """The frames of a candump log; lines that are none are noted as damage."""
    identifiers = _Identifiers()
    channels = ChannelNumbers()
    clock = Clock(damage)
    line = 1
    any_frame = False
    for text in text_pieces(data):
        batch = _candump_fast(text, identifiers, channels)
        if batch is None:
            batch = _candump_lines(text, line, identifiers, channels, damage)
            if damage.count and not batch and not any_frame:
                raise InputError(f"{path}, {damage.place}: {damage.reason}; no line before it is one either")
        if batch:
            any_frame = True
            yield clock.timed(batch)
        line += text.count("\n")


def _candump_fast(text: str, identifiers: _Identifiers, channels: ChannelNumbers) -> list[Frame] | None:
    """The frames of whole lines, or None if any line is out of the ordinary."""
    if text.endswith(" R\n"):  # "received": the ordinary case of the logs that tell the direction
        text = text.replace(" R\n", "\n")
    tokens = text.split()
    lines = len(tokens) // 3
    # As many brackets, line ends and triples of words: every line is of the ordinary form, or int() below fails.
    if 3 * lines != len(tokens) or not lines == text.count("(") == text.count(")") == text.count("\n"):
        return None
    frames: list[Frame] = []
    append, scale, unhex = frames.append, _SCALE, bytes.fromhex
    try:
        for stamp, name, frame in zip(tokens[0::3], tokens[1::3], tokens[2::3], strict=True):
            seconds, _, fraction = stamp.partition(".")
            identifier, _, digits = frame.partition("#")
            if len(digits) > 16:
                return None
            append(
                (
                    int(seconds[1:]) * 1_000_000_000 + int(fraction[:-1]) * scale[len(fraction)],
                    identifiers[identifier],
                    unhex(digits),
                    channels[name],
                )
            )
    except (ValueError, LookupError):
        return None
    return frames


def _candump_lines(
    text: str, first: int, identifiers: _Identifiers, channels: ChannelNumbers, damage: Damage
) -> list[Frame]:
    """The frames of lines of any form; lines that are none are noted as damage. first: number of the first line."""
    frames = []
    lines = text.split("\n")
    for number, line in enumerate(map(str.strip, lines), first):
        if not line or lines[number - first].startswith("\t"):  # what an error frame means, under it
            continue
        try:
            if match := CANDUMP_LINE.fullmatch(line):
                if number == first + len(lines) - 1 and len(match["data"] or "") < 16:
                    raise ValueError("the last line has no end, so data may be missing")
                frames.append(_candump_frame(match, identifiers, channels))
            elif match := SCREEN_LINE.fullmatch(line):
                frames.append(_screen_frame(match, identifiers, channels))
            else:
                raise ValueError("not a line of a candump log")
        except ValueError as error:
            damage.add(f"line {number}", f"{error}: {line[:60]!r}")
    return frames


def _candump_frame(match: re.Match[str], identifiers: _Identifiers, channels: ChannelNumbers) -> Frame:
    identifier = identifiers[match["id"]]
    if match["fd"]:
        data = bytes.fromhex(match["fd"][1:])
        if len(data) not in FD_LENGTHS:
            raise ValueError(f"no CAN FD frame has {len(data)} bytes")
    elif match["remote"] is not None:
        identifier |= RTR_FLAG
        data = bytes(int(match["remote"] or 0))
    else:
        data = bytes.fromhex(match["data"])
    channel = channels[match["channel"]]
    if (match["direction"] or "").upper() == "T":
        channel |= TRANSMITTED
    time_ns = int(match["s"]) * 1_000_000_000 + int((match["fraction"] or "0").ljust(9, "0"))
    return time_ns, identifier, data, channel


def _screen_frame(match: re.Match[str], identifiers: _Identifiers, channels: ChannelNumbers) -> Frame:
    """The frame of a line as candump shows it; at 0 s if it has no time. A date is taken as UTC."""
    identifier, length, stamp = identifiers[match["id"]], int(match["length"]), match["stamp"]
    if match["remote"]:
        identifier |= RTR_FLAG
        data = bytes(min(length, 8))
    else:
        data = bytes.fromhex(match["data"])
        if len(data) != length or length not in FD_LENGTHS:
            raise ValueError(f"{len(data)} bytes where there should be {length}")
    channel = channels[match["channel"]] | (TRANSMITTED if match["direction"] == "T" else 0)
    if stamp and "-" in stamp:
        since = datetime.fromisoformat(stamp).replace(tzinfo=UTC) - datetime(1970, 1, 1, tzinfo=UTC)
        return since // timedelta(microseconds=1) * 1000, identifier, data, channel
    return stamp_ns(stamp, 1_000_000_000) if stamp else 0, identifier, data, channel
