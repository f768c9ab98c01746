"""Text logs with a frame on each line: SavvyCAN's CSV and the CRTD of OVMS."""

from __future__ import annotations

import re
from pathlib import Path

from gz_onboard.events import EFF_FLAG, MOST_EXTENDED, MOST_STANDARD, TRANSMITTED, Frame
from gz_onboard.recording.frames import FD_LENGTHS, FrameColumns
from gz_onboard.recording.readers.contents import Contents, Damage, Parser, read_lines, stamp_ns

SAVVYCAN_HEADER = re.compile(r"\s*\"?time ?stamp[^,]*,\s*id,\s*extended,(?P<direction>\s*dir,)?\s*bus,\s*len\b", re.I)
CRTD_LINE = re.compile(
    r"(?P<stamp>-?\d+(?:\.\d+)?)\s+(?P<bus>\d)?(?:(?P<direction>[RT])(?P<bits>11|29)\s+(?P<id>[0-9A-Fa-f]{1,8})"
    r"(?P<data>(?:\s+[0-9A-Fa-f]{2})*)|C[A-Z]{2}\b.*)"
)
_GREATEST = {False: MOST_STANDARD, True: MOST_EXTENDED}  # identifier, by whether it is extended
_MICROSECOND_NS = 1000  # unit of stamps without a decimal point


def read_savvycan(path: Path, data: Contents, damage: Damage) -> FrameColumns:
    """Read SavvyCAN's CSV; lines that are none are noted as damage."""
    header = SAVVYCAN_HEADER.search(str(data[:_BEGINNING], "latin-1"))
    return read_lines(path, data, damage, _savvycan(bool(header and header["direction"])), "SavvyCAN's CSV")


_BEGINNING = 200  # bytes that hold the header


def _savvycan(has_direction: bool) -> Parser:
    """Columns: time stamp, identifier, extended, direction (not in the older form), bus, length, bytes."""
    later = 1 if has_direction else 0

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
        return stamp_ns(cells[0], _MICROSECOND_NS), _identifier(identifier, extended), data, channel

    return parse


def read_crtd(path: Path, data: Contents, damage: Damage) -> FrameColumns:
    """Read a log of OVMS; lines that are none are noted as damage."""
    return read_lines(path, data, damage, _crtd, "a CRTD log")


def _crtd(line: str) -> Frame | None:
    if line.startswith("#"):
        return None
    if not (match := CRTD_LINE.fullmatch(line.strip())):
        raise ValueError("neither a frame nor a comment")
    if match["direction"] is None:
        return None
    cells = match["data"].split()
    channel = max(int(match["bus"] or 1) - 1, 0) | (TRANSMITTED if match["direction"] == "T" else 0)
    identifier = _identifier(int(match["id"], 16), match["bits"] == "29")
    return stamp_ns(match["stamp"], _MICROSECOND_NS), identifier, _bytes(cells, len(cells)), channel


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
