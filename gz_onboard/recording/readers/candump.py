"""candump text logs: those of ``candump -L``, and what candump shows on the screen, with a time or without."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta
from pathlib import Path

from gz_onboard.events import EFF_FLAG, ERR_FLAG, MOST_EXTENDED, MOST_STANDARD, RTR_FLAG, TRANSMITTED, Frame
from gz_onboard.recording.frames import FrameColumns
from gz_onboard.recording.readers.contents import ChannelNumbers, Contents, Damage, read_lines, stamp_ns

LINE = re.compile(
    r"(?:\((?P<stamp>[^)]+)\)\s+)?(?P<channel>[^\s(]\S*)\s+(?:(?P<screen>[RT])X\s+\S\s+\S\s+)?"
    r"(?P<id>[0-9A-Fa-f]{1,8})(?:"
    r"#(?:#[0-9A-Fa-f](?P<fd>(?:[0-9A-Fa-f]{2}){0,64})|[Rr](?P<asked>[0-8]?)|(?P<data>(?:[0-9A-Fa-f]{2}){0,8}))"
    r"(?:\s+(?P<log>[RrTt]))?|"
    r"\s+\[(?P<length>\d{1,2})\](?:\s+(?P<remote>remote request)|(?P<spaced>(?:\s*[0-9A-Fa-f]{2})*))"
    r"\s*(?:'.*'|ERRORFRAME)?)"
)
_SCALE = {digits + 1: 10 ** (9 - digits) for digits in range(1, 10)}
"""Length of the fraction with the closing bracket -> ns in a unit of its last digit."""
_EIGHT_BYTES = 16  # digits


class _Identifiers(dict[str, int]):
    """Text of an identifier in a candump -> identifier with flags: more than 3 digits mean 29 bits."""

    def __missing__(self, text: str) -> int:
        value = int(text, 16)
        if len(text) > 3:
            value = value if value & ERR_FLAG else (value & MOST_EXTENDED) | EFF_FLAG
        elif value > MOST_STANDARD:
            raise ValueError(f"identifier {text} has more than 11 bits")
        self[text] = value
        return value


class _Parser:
    """Parses lines of one log."""

    def __init__(self) -> None:
        self._identifiers = _Identifiers()
        self._channels = ChannelNumbers()

    def many(self, text: str) -> list[Frame] | None:
        """The frames of whole lines of ``candump -L``; None if any line is out of the ordinary."""
        if text.endswith(" R\n"):  # "received": the ordinary case of the logs that tell the direction
            text = text.replace(" R\n", "\n")
        tokens = text.split()
        lines = len(tokens) // 3
        # As many brackets, line ends and triples of words: every line is of the ordinary form, or int() below fails.
        if 3 * lines != len(tokens) or not lines == text.count("(") == text.count(")") == text.count("\n"):
            return None
        frames: list[Frame] = []
        append, scale, unhex = frames.append, _SCALE, bytes.fromhex
        identifiers, channels = self._identifiers, self._channels
        try:
            for stamp, name, frame in zip(tokens[0::3], tokens[1::3], tokens[2::3], strict=True):
                seconds, _, fraction = stamp.partition(".")
                identifier, _, digits = frame.partition("#")
                if len(digits) > _EIGHT_BYTES:
                    return None
                time_ns = int(seconds[1:]) * 1_000_000_000 + int(fraction[:-1]) * scale[len(fraction)]
                append((time_ns, identifiers[identifier], unhex(digits), channels[name]))
        except (ValueError, LookupError):
            return None
        return frames

    def one(self, line: str) -> Frame | None:
        """The frame of a line of any form; a date is taken as UTC."""
        if line.startswith("\t"):  # explains the error frame above it
            return None
        if not (match := LINE.fullmatch(line.strip())):
            raise ValueError("not a line of a candump log")
        if not line.endswith("\n") and match["length"] is None and len(match["data"] or "") < _EIGHT_BYTES:
            raise ValueError("the last line has no end, so data may be missing")
        identifier, data = (
            self._identifiers[match["id"]],
            bytes.fromhex(match["fd"] or match["data"] or match["spaced"] or ""),
        )
        length = int(match["length"] or match["asked"] or len(data))
        if match["remote"] or match["asked"] is not None:
            identifier |= RTR_FLAG
            data = bytes(min(length, 8))
        elif len(data) != length:
            raise ValueError(f"{len(data)} bytes where there should be {length}")
        sent = (match["screen"] or match["log"] or "R").upper() == "T"
        return (
            _time_ns(match["stamp"]),
            identifier,
            data,
            self._channels[match["channel"]] | (TRANSMITTED if sent else 0),
        )


def _time_ns(stamp: str | None) -> int:
    """The time of a line [ns]; 0 if it has none."""
    if stamp and "-" in stamp[1:]:
        since = datetime.fromisoformat(stamp).replace(tzinfo=UTC) - datetime(1970, 1, 1, tzinfo=UTC)
        return since // timedelta(microseconds=1) * 1000
    return stamp_ns(stamp) if stamp else 0


def read(path: Path, data: Contents, damage: Damage) -> FrameColumns:
    """Read the frames of a candump log; lines that are none are noted as damage."""
    parser = _Parser()
    return read_lines(path, data, damage, parser.one, "a candump log", parser.many)
