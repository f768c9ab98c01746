"""Text logs with a frame on each line: SavvyCAN's CSV and the CRTD of OVMS."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

from gz_onboard.bus.readers.common import FD_LENGTHS, Clock, Contents, Damage, Reader, stamp_ns, text_pieces
from gz_onboard.errors import InputError, shown
from gz_onboard.events import EFF_FLAG, MOST_EXTENDED, MOST_STANDARD, TRANSMITTED, Frame

SAVVYCAN_HEADER = re.compile(r"\s*\"?time ?stamp[^,]*,\s*id,\s*extended,(?P<direction>\s*dir,)?\s*bus,\s*len\b", re.I)
CRTD_LINE = re.compile(
    r"(?P<stamp>-?\d+(?:\.\d+)?)\s+(?P<bus>\d)?(?:(?P<direction>[RT])(?P<bits>11|29)\s+(?P<id>[0-9A-Fa-f]{1,8})"
    r"(?P<data>(?:\s+[0-9A-Fa-f]{2})*)|C[A-Z]{2}\b.*)"
)
_GREATEST = {False: MOST_STANDARD, True: MOST_EXTENDED}  # identifier, by whether it is extended

Parser = Callable[[str], Frame | None]
"""A line -> its frame; None for a comment. ValueError for a line that is neither."""


def _reader(parser: Callable[[str], Parser], name: str) -> Reader:
    """The reader of a format by the parser of its lines, which is made from the first line; `name` is for messages."""

    def read(path: Path, data: Contents, damage: Damage, _start: int | None, _end: int | None) -> Iterator[list[Frame]]:
        clock, number, parse, any_frame = Clock(damage), 0, None, False
        for text in text_pieces(data):
            batch = []
            parse = parse or parser(text[: text.find("\n")])
            lines = text.splitlines()
            for at, line in enumerate(map(str.strip, lines), number + 1):
                try:
                    if line and (frame := parse(line)):
                        batch.append(frame)
                except ValueError as error:
                    damage.add(f"line {at}", f"{error}: {shown(line[:60])}")
            number += len(lines)
            if damage.count and not (batch or any_frame):
                raise InputError(f"{path}, {damage.place}: not a line of {name}: {damage.reason}")
            if batch:
                any_frame = True
                yield clock.timed(batch)

    return read


def _savvycan(first: str) -> Parser:
    """Columns: time stamp, identifier, extended, direction (not in the older form), bus, length, bytes."""
    header = SAVVYCAN_HEADER.match(first)
    later = 1 if header and header["direction"] else 0

    def parse(line: str) -> Frame | None:
        if SAVVYCAN_HEADER.match(line):
            return None
        cells = [cell.strip() for cell in line.split(",")]
        if len(cells) < 5 + later:
            raise ValueError(f"{len(cells)} columns where there should be {5 + later} or more")
        identifier, length = int(cells[1], 16), int(cells[4 + later])
        extended = cells[2].lower() in ("true", "1") or identifier > _GREATEST[False]
        data = _bytes(cells[5 + later : 5 + later + length], length)
        channel = int(cells[3 + later]) & ~TRANSMITTED | (TRANSMITTED if later and cells[3][:1] in "Tt" else 0)
        return stamp_ns(cells[0], 1000), _identifier(identifier, extended), data, channel

    return parse


def _crtd(_first: str) -> Parser:
    def parse(line: str) -> Frame | None:
        if line.startswith("#"):
            return None
        if not (match := CRTD_LINE.fullmatch(line)):
            raise ValueError("neither a frame nor a comment")
        if match["direction"] is None:
            return None
        cells = match["data"].split()
        channel = max(int(match["bus"] or 1) - 1, 0) | (TRANSMITTED if match["direction"] == "T" else 0)
        identifier = _identifier(int(match["id"], 16), match["bits"] == "29")
        return stamp_ns(match["stamp"], 1000), identifier, _bytes(cells, len(cells)), channel

    return parse


def _identifier(value: int, extended: bool) -> int:
    if not 0 <= value <= _GREATEST[extended]:
        raise ValueError(f"identifier {value:X} has more than {29 if extended else 11} bits")
    return value | EFF_FLAG if extended else value


def _bytes(cells: list[str], length: int) -> bytes:
    if length not in FD_LENGTHS:
        raise ValueError(f"no frame has {length} bytes")
    if len(cells) != length or not all(len(cell) == 2 for cell in cells):
        raise ValueError(f"not {length} bytes of two digits")
    return bytes.fromhex("".join(cells))


read_savvycan = _reader(_savvycan, "SavvyCAN's CSV")
read_crtd = _reader(_crtd, "a CRTD log")
