"""The range in a terminal, as a screen redrawn five times a second at most; into a pipe a line of JSON a second."""

from __future__ import annotations

import argparse
import math
import os
import shutil
import sys
import textwrap
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from typing import TextIO

from gz_onboard.bus.publisher import reason_signal
from gz_onboard.dashboard.live import live
from gz_onboard.dashboard.view import NEARLY_EMPTY, Picture, View, encoded
from gz_onboard.errors import FAILED, OK, InputError
from gz_onboard.events import KEEPING, NO_SENSOR, Reason, cause_words, words

REDRAW_S, LINE_S = 0.2, 0.95  # at least, between two screens, and two lines
ONCE_WITHIN_S = 5.0  # that --once waits for every message
LABEL, WIDEST = 20, 78  # columns: of the labels, and of the whole
ROUND = 1, 1.5, 2, 3, 4, 5, 6, 8, 10
"""First digits of the end of a scale."""

Line = list[tuple[str, str]]
"""Texts, each with ANSI codes or nothing; without colour the texts themselves say everything."""

_BOLD, _DIM, _RED, _GREEN, _YELLOW, _CYAN = "1", "2", "31", "32", "33", "36"
_STATES = {
    None: (_DIM, "unknown"),
    "starting": (_CYAN, "starting: no estimate yet"),
    "valid": (_GREEN, "valid"),
    "degraded": (_YELLOW, "degraded: an input is missing or doubtful, wider interval"),
    "invalid": (_RED, "invalid: range unavailable"),
}


def show(view: View, arguments: argparse.Namespace) -> int:
    """Show `view` of the bus of the options; return the exit status: with --once 1 if no range frame came at all."""
    out: TextIO | None = sys.stdout
    if out is None:  # closed by the caller
        raise InputError("there is no standard output to show anything on")
    in_front = threading.current_thread() is threading.main_thread()
    terminal = in_front and out.isatty() and os.environ.get("TERM", "dumb") != "dumb"
    colour, on_screen = terminal and "NO_COLOR" not in os.environ, terminal and not arguments.once
    if arguments.once:
        arguments.duration = arguments.duration or ONCE_WITHIN_S
    picture, drawn = None, -math.inf
    with live(view, arguments) as pictures, _other_screen(out) if on_screen else nullcontext():
        for picture in pictures:
            now = time.monotonic()
            if arguments.once and not picture["stale"]:
                break
            if arguments.once or now - drawn < (REDRAW_S if on_screen else LINE_S):
                continue
            drawn = now
            if not on_screen:
                print(encoded(picture).decode(), file=out, flush=True)
                continue
            size = shutil.get_terminal_size()
            lines = screen(picture, size.columns, view.comments)[: size.lines]
            # Over the old picture, not after clearing the screen: no flicker. Each line is cleared before it is
            # written; after one that is as wide as the terminal, clearing would remove its last letter.
            text = "\r\n".join(f"\x1b[K{rendered(line, size.columns, colour)}" for line in lines)
            out.write(f"\x1b[H{text}" + ("\r\n\x1b[J" if len(lines) < size.lines else ""))
            out.flush()
    if picture and (arguments.once or on_screen):  # the last picture stays
        columns = shutil.get_terminal_size().columns
        for line in screen(picture, columns, view.comments):
            print(rendered(line, columns, colour).rstrip(), file=out)
        out.flush()
    return FAILED if arguments.once and not (picture and picture["heard"]) else OK


@contextmanager
def _other_screen(out: TextIO) -> Iterator[None]:
    """Switch to the alternate screen, without a cursor, and back."""
    out.write("\x1b[?1049h\x1b[?25l")
    try:
        yield
    finally:
        out.write("\x1b[0m\x1b[?25h\x1b[?1049l")
        out.flush()


def screen(picture: Picture, width: int, comments: Mapping[str, str]) -> list[Line]:
    """Lay out the whole picture for a terminal of `width` columns. comments: of the DBC file, by signal."""
    width = max(min(width, WIDEST), LABEL + 4)
    colour, state = _STATES[picture["state"]]
    late, stale, ranges, battery = picture["late"], picture["stale"], picture["range"], picture["battery"]
    waiting = "waiting" in picture["alerts"]

    def number(value: float | None, form: str, unit: str, message: str, codes: str = _BOLD) -> tuple[str, str]:
        return _text(value, form, unit), _DIM if message in late else codes

    energy = "RANGE_Energy"
    remaining = number(ranges["km"], ".1f", "km", "RANGE_Estimate", f"{_BOLD};{colour}")
    p10, p90 = (number(ranges[key], ".1f", "km", "RANGE_Estimate") for key in ("p10_km", "p90_km"))
    expected, recent = (
        number(picture["consumption"][f"{key}_wh_per_km"], ".1f", "Wh/km", energy) for key in ("expected", "recent")
    )
    soc, sigma = battery["soc_percent"], battery["soc_sigma_percent"]
    charge = "–" if soc is None else f"{soc:.1f} %" if sigma is None else f"{soc:.1f} ± {sigma:.1f} %"
    low = soc is not None and soc <= NEARLY_EMPTY
    lines: list[Line] = [
        [(" gz-onboard", _BOLD), (f" · {picture['channel']} ({picture['interface']})", _DIM)],
        [],
        _row("Range", remaining, ("     80 %: ", _DIM), p10, (" to ", _DIM), p90),
        *_band(ranges, width, _DIM if "RANGE_Estimate" in late else colour),
        [],
        _row("State of charge", (charge, _DIM if "RANGE_Status" in late else f"{_BOLD};{_RED}" if low else _BOLD)),
        _row("Energy left", number(battery["energy_left_wh"], ".0f", "Wh", energy)),
        _row("Consumption", expected, (" expected, ", ""), recent, (" over the last km", "")),
    ]
    if not picture["bus_up"]:
        lines[0].append((" is down", _DIM))
    if picture["causes"]:
        why = ", ".join(f"{cause_words(one['cause'])} {one['km']:+.1f} km" for one in picture["causes"])
        lines.append(_row("Why", (why, _DIM if "RANGE_Why" in late else "")))
        lines.append(_row("", (f"besides the charge; rated {_text(picture['rated_km'], '.1f', 'km')}", _DIM)))
    lines.append([])
    lines.append(_row("State", ("waiting for the scooter", _BOLD) if waiting else (state, f"{_BOLD};{colour}")))
    if picture["activity"]:
        lines.append(_row("Activity", (picture["activity"], "")))
    if picture["charge"]:
        lines.append(_row("Charge", (_charge(picture["charge"]), "")))
    lines += _reasons(picture, width, comments)
    for i, text in enumerate(textwrap.wrap(", ".join(map(words, picture["distrusted"])), width - LABEL)):
        lines.append(_row("" if i else "Sensors left out", (text, _YELLOW)))
    if not picture["heard"]:
        lines.append(_row("No frame of", (picture["file"], _RED)))
        lines.append(_row("", ("Is the daemon on this bus? Is --dbc its range_dbc?", _DIM)))
    else:
        lines += [_row("" if i else "Stale", (name, _RED)) for i, name in enumerate(stale)]
    return [*lines, [], *_counts(picture)]


def rendered(line: Line, width: int, colour: bool) -> str:
    """Turn a line into text for the terminal, at most `width` columns wide."""
    result, room = "", min(width, WIDEST)
    for text, codes in line:
        shown = text if len(text) <= room else text[: max(room - 1, 0)] + "…"[:room]
        room -= len(shown)
        result += f"\x1b[{codes}m{shown}\x1b[0m" if colour and codes and shown else shown
    return result


def _row(label: str, *texts: tuple[str, str], codes: str = "") -> Line:
    return [(f"  {label:{LABEL - 2}}", codes), *texts]


def _text(value: float | None, form: str, unit: str) -> str:
    return "–" if value is None else f"{value:{form}} {unit}"


def _charge(charge: Mapping[str, float | None]) -> str:
    power, minutes = _text(charge["power_w"], ".0f", "W"), charge["time_to_full_min"]
    if minutes is None:
        return power
    hours, rest = divmod(round(minutes), 60)
    time = f"{hours} h {rest:02d} min" if hours else f"{rest} min"
    return f"{power}, full in {time}, {_text(charge['range_full_km'], '.1f', 'km')} then"


def _reasons(picture: Picture, width: int, comments: Mapping[str, str]) -> list[Line]:
    """The reasons, with the comments of the DBC file where there is room; while waiting, not the silent sensors."""
    found = Reason(sum(Reason[name.upper()] for name in picture["reasons"]))
    label = "Wider interval" if picture["state"] == "valid" else "Because"
    hidden = NO_SENSOR if "waiting" in picture["alerts"] else Reason(0)
    lines = []
    for title, group in (label, found & ~KEEPING & ~hidden), ("Note", found & KEEPING):
        for i, reason in enumerate(group):
            name, comment = words(str(reason.name)), comments.get(reason_signal(reason), "").rstrip(".")
            fits = comment and len(name) + len(comment) + LABEL + 4 <= width
            lines.append(_row("" if i else title, (name, _YELLOW), (f": {comment}" if fits else "", _DIM)))
    return lines


def _band(ranges: Mapping[str, float | None], width: int, colour: str) -> list[Line]:
    """A bar from P10 to P90 on a scale from 0 km, with the range as a dot."""
    cells = width - 4
    p10, km, p90 = ranges["p10_km"], ranges["km"], ranges["p90_km"]
    if p10 is None or km is None or p90 is None:
        return [[("  " + "─" * cells, _DIM)], []]
    top = scale_end(p90)
    first, dot, last = (min(round(value / top * (cells - 1)), cells - 1) for value in (p10, km, p90))
    bar = [("  " + "─" * first, _DIM), ("━" * (dot - first), colour), ("●", f"{_BOLD};{colour}")]
    bar += [("━" * (last - dot), colour), ("─" * (cells - 1 - last), _DIM)]
    return [bar, [("  0" + f"{top:g} km".rjust(cells - 1), _DIM)]]


def scale_end(value: float) -> float:
    """The next round number from `value` on, at least 1."""
    size = 10.0 ** math.floor(math.log10(max(value, 1.0)))
    return next(step * size for step in ROUND if step * size >= value)


def _counts(picture: Picture) -> list[Line]:
    age, counts = picture["age_s"], picture["counts"]
    last = "none yet" if age is None else f"{age:.1f} s old" if age < 100 else f"{age / 60:.0f} min old"
    own = f"{last}, {counts['received']} received, {counts['lost']} lost"
    named = {"unknown": "unknown identifiers"}
    known = [f"{n:.0f} {named.get(key, key)}" for key, n in picture["vehicle_counts"].items() if n is not None]
    return [
        _row("Range frames", (own, _DIM), (f", {counts['bad']} bad", _RED if counts["bad"] else _DIM), codes=_DIM),
        _row("Vehicle's frames", (", ".join(known) or "–", _DIM), codes=_DIM),
    ]
