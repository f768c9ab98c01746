"""The range in a terminal, as a screen redrawn five times a second at most; into a pipe a line of JSON a second."""

from __future__ import annotations

import os
import shutil
import sys
import textwrap
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from math import inf
from typing import TextIO

from gz_onboard.can.publisher import reason_signal
from gz_onboard.display.view import NEARLY_EMPTY, Picture, encoded
from gz_onboard.errors import FAILED, OK, InputError
from gz_onboard.events import KEEPING, NO_SENSOR, Reason, cause_words, words

REDRAW_S, LINE_S = 0.2, 0.95  # at least, between two screens, and two lines
INDENT, WIDEST = 20, 78  # columns: before the texts, and of the whole

Line = tuple[str, str, str]
"""Label, text, and ANSI codes of the text; without colour the text itself says everything."""

_EMPTY: Line = "", "", ""
_PLAIN, _BOLD, _DIM, _RED, _YELLOW = "0", "1", "2", "31", "33"
_STATES = {
    None: (_DIM, "unknown"),
    "starting": ("36", "starting: no estimate yet"),
    "valid": ("32", "valid"),
    "degraded": (_YELLOW, "degraded: an input is missing or doubtful, wider interval"),
    "invalid": (_RED, "invalid: range unavailable"),
}


def show(pictures: Iterator[Picture], comments: Mapping[str, str], once: bool) -> int:
    """Show pictures as they come, or `once` the first that is whole; return the exit status.

    comments: of the DBC file, by signal. The status is that of a failure if no range frame came for the one picture.
    """
    out: TextIO | None = sys.stdout
    if out is None:  # closed by the caller
        raise InputError("there is no standard output to show anything on")
    terminal = (
        threading.current_thread() is threading.main_thread()
        and out.isatty()
        and os.environ.get("TERM", "dumb") != "dumb"
    )
    colour, on_screen = terminal and "NO_COLOR" not in os.environ, terminal and not once
    picture, drawn = None, -inf
    with _other_screen(out) if on_screen else nullcontext():
        for picture in pictures:
            now = time.monotonic()
            if once and not picture["stale"]:
                break
            if once or now - drawn < (REDRAW_S if on_screen else LINE_S):
                continue
            drawn = now
            if not on_screen:
                print(encoded(picture).decode(), file=out, flush=True)
                continue
            size = shutil.get_terminal_size()
            lines = screen(picture, size.columns, comments)[: size.lines]
            # Over the old picture, not after clearing the screen: no flicker. Each line is cleared before it is
            # written; after one that is as wide as the terminal, clearing would remove its last letter.
            text = "\r\n".join(f"\x1b[K{rendered(line, size.columns, colour)}" for line in lines)
            out.write(f"\x1b[H{text}" + ("\r\n\x1b[J" if len(lines) < size.lines else ""))
            out.flush()
    if picture and (once or on_screen):  # the last picture stays
        columns = shutil.get_terminal_size().columns
        for line in screen(picture, columns, comments):
            print(rendered(line, columns, colour), file=out)
        out.flush()
    return FAILED if once and not (picture and picture["heard"]) else OK


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
    width = max(min(width, WIDEST), INDENT + 4)
    ranges, battery, used = picture["range"], picture["battery"], picture["consumption"]
    colour, state = _STATES[picture["state"]]
    if waiting := "waiting" in picture["alerts"]:
        state = "waiting for the scooter"
    km, p10, p90 = (_text(ranges[key], ".1f", "km") for key in ("km", "p10_km", "p90_km"))
    soc, sigma = battery["soc_percent"], battery["soc_sigma_percent"]
    charged = _text(soc, ".1f", "%") if soc is None or sigma is None else f"{soc:.1f} ± {sigma:.1f} %"
    expected, recent = (_text(used[key], ".1f", "Wh/km") for key in ("expected_wh_per_km", "recent_wh_per_km"))
    source = f"{picture['channel']} ({picture['interface']}){'' if picture['bus_up'] else ' is down'}"
    red = soc is not None and soc <= NEARLY_EMPTY

    lines = [
        ("gz-onboard", source, _DIM),
        _EMPTY,
        ("Range", f"{km}     80 %: {p10} to {p90}", f"{_BOLD};{colour}"),
        _EMPTY,
        ("State of charge", charged, f"{_BOLD};{_RED}" if red else _BOLD),
        ("Energy left", _text(battery["energy_left_wh"], ".0f", "Wh"), _BOLD),
        ("Consumption", f"{expected} expected, {recent} over the last km", _BOLD),
    ]
    if picture["causes"]:
        why = ", ".join(f"{cause_words(one['cause'])} {one['km']:+.1f} km" for one in picture["causes"])
        lines.append(("Why", why, _PLAIN))
        lines.append(("", f"besides the charge; rated {_text(picture['rated_km'], '.1f', 'km')}", _DIM))
    lines += [_EMPTY, ("State", state, f"{_BOLD};{colour}")]
    if picture["activity"]:
        lines.append(("Activity", picture["activity"], _PLAIN))
    if charge := picture["charge"]:
        power, full = _text(charge["power_w"], ".0f", "W"), _text(charge["range_full_km"], ".1f", "km")
        hours, minutes = divmod(round(charge["time_to_full_min"] or 0), 60)
        soon = "" if charge["time_to_full_min"] is None else f", full in {hours} h {minutes:02d} min, {full} then"
        lines.append(("Charge", f"{power}{soon}", _PLAIN))
    found = Reason(sum(Reason[name.upper()] for name in picture["reasons"]))
    because = found & ~KEEPING & ~(NO_SENSOR if waiting else Reason(0))  # a scooter that is off has no sensors
    for label, group in (
        ("Wider interval" if picture["state"] == "valid" else "Because", because),
        ("Note", found & KEEPING),
    ):
        said = [(words(str(reason.name)), comments[reason_signal(reason)].rstrip(".")) for reason in group]
        fits = [f"{name}: {comment}" if INDENT + 4 + len(name + comment) <= width else name for name, comment in said]
        lines += _list(label, fits, _YELLOW)
    left_out = ", ".join(map(words, picture["distrusted"]))
    lines += _list("Sensors left out", textwrap.wrap(left_out, width - INDENT), _YELLOW)
    if picture["heard"]:
        lines += _list("Stale", picture["stale"], _RED)
    else:
        lines.append(("No frame of", picture["file"], _RED))
        lines.append(("", "Is the daemon on this bus? Is --dbc its range_dbc?", _DIM))
    age, counts = picture["age_s"], picture["counts"]
    last = "none yet" if age is None else f"{age:.1f} s old" if age < 100 else f"{age / 60:.0f} min old"
    own = ", ".join(f"{count} {name}" for name, count in counts.items())
    known = [f"{count:.0f} {name}" for name, count in picture["vehicle_counts"].items() if count is not None]
    lines += [_EMPTY, ("Range frames", f"{last}, {own}", _RED if counts["bad"] else _DIM)]
    return [*lines, ("Vehicle's frames", ", ".join(known) or "–", _DIM)]


def rendered(line: Line, width: int, colour: bool) -> str:
    """Turn a line into text for the terminal, at most `width` columns wide; one that is cut ends in …."""
    label, text, codes = line
    whole, room = f"  {label:{INDENT - 2}}{text}", min(width, WIDEST)
    if len(whole) > room:
        whole = whole[: room - 1] + "…"
    return f"{whole[:INDENT]}\x1b[{codes}m{whole[INDENT:]}\x1b[0m" if colour and text else whole.rstrip()


def _text(value: float | None, form: str, unit: str) -> str:
    return "–" if value is None else f"{value:{form}} {unit}"


def _list(label: str, texts: Sequence[str], codes: str) -> list[Line]:
    return [("" if i else label, text, codes) for i, text in enumerate(texts)]
