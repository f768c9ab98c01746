"""A picture as text, for a terminal."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from gz_onboard.dashboard.picture import NEARLY_EMPTY, Charge, Picture, Range
from gz_onboard.events import KEEPING, NO_SENSOR, Reason, cause_words, words


@dataclass(frozen=True)
class Style:
    """Capabilities of the terminal; without colour the texts themselves say everything."""

    colour: bool
    unicode: bool

    def paint(self, text: str, codes: str) -> str:
        """Colour `text` by ANSI codes, in ASCII where the terminal has no more."""
        text = text if self.unicode else text.translate(_ASCII)
        return f"\x1b[{codes}m{text}\x1b[0m" if self.colour and codes and text else text


_ASCII = str.maketrans({"–": "-", "±": "+-", "·": "|", "●": "O", "━": "=", "─": "-", "█": "#", "░": ".", "…": "~"})
_BOLD, _DIM, _RED, _YELLOW = "1", "2", "31", "33"
_STATES = {  # colour, and the words of the screen
    "starting": ("36", "starting: no estimate yet"),
    "valid": ("32", "valid"),
    "degraded": (_YELLOW, "degraded: an input is missing or doubtful, wider interval"),
    "invalid": (_RED, "invalid: range unavailable"),
}
_UNKNOWN = _DIM, "unknown"
_WAITING = "waiting for the scooter"
_NONE_YET = "Is the daemon on this bus? Is --dbc its range_dbc?"
_KEEPING, _SENSORS = (frozenset(str(r.name).lower() for r in Reason if r in group) for group in (KEEPING, NO_SENSOR))

Span = tuple[str, str]
"""(text, ANSI codes or nothing)"""
Line = list[Span]


def screen(shown: Picture, source: str, width: int, comments: Mapping[str, str]) -> list[Line]:
    """Lay out the whole picture, at most `width` columns wide. comments: explanations of reasons, by name."""
    room, width = width, max(min(width, 78), 24)
    colour, state = _STATES.get(shown.state or "", _UNKNOWN)
    waiting = "waiting" in shown.alerts

    def number(value: float | None, form: str, unit: str, message: str, codes: str = _BOLD) -> Span:
        return _text(value, form, unit), _DIM if message in shown.late else codes

    energy, level, ranges = "RANGE_Energy", shown.battery, shown.range
    p10, p90 = (number(value, ".1f", "km", "RANGE_Estimate") for value in (ranges.p10_km, ranges.p90_km))
    expected = number(shown.consumption.expected_wh_per_km, ".1f", "Wh/km", energy)
    recent = number(shown.consumption.recent_wh_per_km, ".1f", "Wh/km", energy)
    remaining = number(ranges.km, ".1f", "km", "RANGE_Estimate", f"{_BOLD};{colour}")
    lines: list[Line] = [
        [(" gz-onboard", _BOLD), (f" · {source}{'' if shown.bus_up else ' is down'}", _DIM)],
        [],
        _row("Range", remaining, ("     80 %: ", _DIM), p10, (" to ", _DIM), p90),
        *_band(ranges, width, _DIM if "RANGE_Estimate" in shown.late else colour),
        [],
        _state_of_charge(shown, width),
        _row("Energy left", number(level.energy_left_wh, ".0f", "Wh", energy)),
        _row("Consumption", expected, (" expected, ", ""), recent, (" over the last km", "")),
    ]
    if causes := _causes(shown):
        lines.append(_row("Why", (causes, _DIM if "RANGE_Why" in shown.late else "")))
        lines.append(_row("", (f"besides the charge; rated {_text(shown.rated_km, '.1f', 'km')}", _DIM)))
    lines += [[], _row("State", (_WAITING, _BOLD) if waiting else (state, f"{_BOLD};{colour}"))]
    if shown.activity:
        lines.append(_row("Activity", (shown.activity, "")))
    if shown.charge:
        lines.append(_row("Charge", (_charge(shown.charge), "")))
    kept, others = _reasons(shown)
    for label, reasons in ("Wider interval" if shown.state == "valid" else "Because", others), ("Note", kept):
        for i, reason in enumerate(reasons):
            name, comment = words(reason), comments.get(reason, "").rstrip(".")
            fits = len(name) + len(comment) + 24 <= width
            lines.append(_row("" if i else label, (name, _YELLOW), (f": {comment}" if comment and fits else "", _DIM)))
    left_out = ", ".join(words(role) for role in shown.distrusted)
    for i, text in enumerate(textwrap.wrap(left_out, max(width - 20, 20))):
        lines.append(_row("" if i else "Sensors left out", (text, _YELLOW)))
    if not shown.heard:
        lines += [_row("No frame of", (shown.file, _RED)), [(f"{'':20}{_NONE_YET}", _DIM)]]
    elif shown.stale:
        lines += [_row("" if i else "Stale", (name, _RED)) for i, name in enumerate(shown.stale)]
    lines += [[], *_counts(shown)]
    return [_cropped(line, min(room, width)) for line in lines]


def _row(label: str, *spans: Span, codes: str = "") -> Line:
    return [(f"  {label:18}", codes), *spans]


def _text(value: float | None, form: str, unit: str) -> str:
    return "–" if value is None else f"{value:{form}} {unit}"


def _causes(shown: Picture) -> str:
    """The largest causes in words, such as ``temperature -3.4 km, stops +1.2 km``."""
    return ", ".join(f"{cause_words(cause.cause)} {cause.km:+.1f} km" for cause in shown.causes)


def _charge(charge: Charge) -> str:
    if charge.time_to_full_min is None:
        return _text(charge.power_w, ".0f", "W")
    hours, minutes = divmod(round(charge.time_to_full_min), 60)
    time = f"{hours} h {minutes:02d} min" if hours else f"{minutes} min"
    full = _text(charge.range_full_km, ".1f", "km")
    return f"{_text(charge.power_w, '.0f', 'W')}, full in {time}, {full} then"


def _reasons(shown: Picture) -> tuple[Sequence[str], Sequence[str]]:
    """(reasons that only concern logs and saved states, others); silent sensors go without saying while waiting."""
    hidden = _SENSORS if "waiting" in shown.alerts else frozenset()
    others = [reason for reason in shown.reasons if reason not in hidden | _KEEPING]
    return [reason for reason in shown.reasons if reason in _KEEPING], others


def _band(ranges: Range, width: int, colour: str) -> list[Line]:
    """Draw a bar from P10 to P90 on a scale from 0 km, with the range as a dot."""
    cells = width - 4
    if ranges.p10_km is None or ranges.km is None or ranges.p90_km is None:
        return [[("  " + "─" * cells, _DIM)], []]
    top = _scale_end(ranges.p90_km)
    values = ranges.p10_km, ranges.km, ranges.p90_km
    first, dot, last = (min(round(value / top * (cells - 1)), cells - 1) for value in values)
    bar: Line = [
        ("  " + "─" * first, _DIM),
        ("━" * (dot - first), colour),
        ("●", f"{_BOLD};{colour}"),
        ("━" * (last - dot), colour),
        ("─" * (cells - 1 - last), _DIM),
    ]
    return [bar, [("  0" + f"{top:g} km".rjust(cells - 1), _DIM)]]


def _scale_end(value: float) -> float:
    """The next round number from `value` on."""
    if value <= 1:
        return 1.0
    size = 10.0 ** math.floor(math.log10(value))
    return next(step * size for step in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if step * size >= value)


def _state_of_charge(shown: Picture, width: int) -> Line:
    late = "RANGE_Status" in shown.late
    soc, sigma = shown.battery.soc_percent, shown.battery.soc_sigma_percent
    text = "–" if soc is None else f"{soc:.1f} %" if sigma is None else f"{soc:.1f} ± {sigma:.1f} %"
    line = _row("State of charge", (f"{text:16}", _DIM if late else _BOLD))
    cells = min(width - 38, 36)
    if soc is not None and cells >= 10:
        full = min(max(round(soc / 100 * cells), 0), cells)
        line += [("█" * full, _DIM if late else "32" if soc > NEARLY_EMPTY else _RED), ("░" * (cells - full), _DIM)]
    return line


def _counts(shown: Picture) -> list[Line]:
    age, counts, vehicle = shown.age_s, shown.counts, shown.vehicle_counts
    last = "none yet" if age is None else f"{age:.1f} s old" if age < 100 else f"{age / 60:.0f} min old"
    own = f"{last}, {counts.received} received, {counts.lost} lost"
    named = {"dropped": vehicle.dropped, "implausible": vehicle.implausible, "lost": vehicle.lost}
    named["unknown identifiers"] = vehicle.unknown
    known = [f"{value:.0f} {name}" for name, value in named.items() if value is not None]
    return [
        _row("Range frames", (own, _DIM), (f", {counts.bad} bad", _RED if counts.bad else _DIM), codes=_DIM),
        _row("Vehicle's frames", (", ".join(known) or "–", _DIM), codes=_DIM),
    ]


def _cropped(line: Line, width: int) -> Line:
    cropped: Line = []
    room = width
    for text, codes in line:
        if len(text) > room:
            return [*cropped, (text[: max(room - 1, 0)] + "…"[: max(room, 0)], codes)]
        cropped.append((text, codes))
        room -= len(text)
    return cropped


def rendered(line: Line, style: Style) -> str:
    """Turn a line into the text for the terminal."""
    return "".join(style.paint(text, codes) for text, codes in line)
