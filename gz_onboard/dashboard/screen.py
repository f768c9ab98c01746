"""The dashboard as text: a screen, or one line."""

from __future__ import annotations

import math
import textwrap
from dataclasses import dataclass
from functools import partial

from gz_onboard.bus.publisher import reason_signal
from gz_onboard.dashboard.view import NEARLY_EMPTY, View
from gz_onboard.events import KEEPING, NO_SENSOR, Reason, State, cause_words, words


@dataclass(frozen=True)
class Style:
    """How texts are drawn; without colour the texts themselves say everything."""

    colour: bool
    unicode: bool

    def paint(self, text: str, codes: str) -> str:
        """`text` in the colours of the ANSI codes."""
        return f"\x1b[{codes}m{text}\x1b[0m" if self.colour and codes and text else text

    def plain(self, text: str) -> str:
        """`text` in ASCII, where the terminal has no more."""
        return text if self.unicode else text.translate(_ASCII)


_ASCII = str.maketrans({"–": "-", "±": "+-", "·": "|", "●": "O", "━": "=", "─": "-", "█": "#", "░": ".", "…": "~"})
_BOLD, _DIM = "1", "2"
_STATE_COLOURS = {State.STARTING: "36", State.VALID: "32", State.DEGRADED: "33", State.INVALID: "31"}
_STATE_WORDS = {
    State.STARTING: "starting: no estimate yet",
    State.VALID: "valid",
    State.DEGRADED: "degraded: an input is missing or doubtful, wider interval",
    State.INVALID: "invalid: range unavailable",
}

_WAITING = "waiting for the scooter"
_NONE_YET = "Is the daemon on this bus? Is --dbc its range_dbc?"

Span = tuple[str, str]
"""(text, ANSI codes or nothing)"""
Line = list[Span]


def screen(view: View, now: float, source: str, width: int) -> list[Line]:
    """The whole picture, at most `width` columns wide."""
    room, width = width, max(min(width, 78), 24)
    number = partial(_number, view, now)
    state = view.state(now)
    colour = _STATE_COLOURS[state] if state is not None else _DIM
    if view.messages["RANGE_Estimate"].late(now):
        colour = _DIM
    interval = number("RANGE_RemainingP10"), (" to ", _DIM), number("RANGE_RemainingP90")
    recent = number("RANGE_ConsumptionRecent"), (" over the last km", "")
    trust = (_STATE_WORDS[state], f"{_BOLD};{_STATE_COLOURS[state]}") if state is not None else ("unknown", _DIM)
    lines: list[Line] = [
        [(" gz-onboard", _BOLD), (f" · {source}", _DIM)],
        [],
        _row("Range", number("RANGE_Remaining", f"{_BOLD};{colour}"), ("     80 %: ", _DIM), *interval),
        *_band(view, now, width, colour),
        [],
        _soc(view, now, width),
        _row("Energy left", number("RANGE_EnergyLeft")),
        _row("Consumption", number("RANGE_ConsumptionExpected"), (" expected, ", ""), *recent),
        *_why(view, now),
        [],
        _row("State", (_WAITING, _BOLD) if view.waiting(now) else trust),
    ]
    if activity := view.activity(now):
        lines.append(_row("Activity", (activity, "")))
    if charge := view.charge(now):
        lines.append(_row("Charge", (charge, "")))
    last = ""
    for reason in sorted(_reasons(view, now), key=KEEPING.__contains__):
        name, comment = words(str(reason.name)), view.comments[reason_signal(reason)]
        label = "Note" if reason in KEEPING else "Wider interval" if state is State.VALID else "Because"
        lines.append(_row("" if label == last else label, (name, "33")))
        last = label
        if len(name) + len(comment) + 24 <= width:
            lines[-1].append((f": {comment.rstrip('.')}", _DIM))
    left_out = ", ".join(words(role) for role in view.distrusted(now))
    for i, text in enumerate(textwrap.wrap(left_out, max(width - 20, 20))):
        lines.append(_row("" if i else "Sensors left out", (text, "33")))
    if math.isinf(view.age(now)):
        lines += [_row("No frame of", (view.file.name, "31")), [(f"{'':20}{_NONE_YET}", _DIM)]]
    else:
        for i, (name, age) in enumerate(view.stale(now).items()):
            how = "never came" if math.isinf(age) else f"last came {_duration(age)} ago"
            lines.append(_row("" if i else "Stale", (f"{name}: {how}", "31")))
    lines += [[], *_counts(view, now)]
    return [_cropped(line, min(room, width)) for line in lines]


def _row(label: str, *spans: Span, codes: str = "") -> Line:
    return [(f"  {label:18}", codes), *spans]


def _why(view: View, now: float) -> list[Line]:
    """The largest causes; nothing where none is known."""
    causes = causes_text(view, now)
    if not causes:
        return []
    codes = _DIM if view.messages["RANGE_Why"].late(now) else ""
    rated = f"besides the charge; rated {view.text('RANGE_WhyRated', now)}"
    return [_row("Why", (causes, codes)), _row("", (rated, _DIM))]


def causes_text(view: View, now: float) -> str:
    """The largest causes in words, such as ``temperature -3.4 km, stops +1.2 km``."""
    return ", ".join(f"{cause_words(cause.name)} {size:+.1f} km" for cause, size in view.why(now))


def _reasons(view: View, now: float) -> list[Reason]:
    """The reasons that are shown; without the scooter it goes without saying that its sensors are silent."""
    hidden = NO_SENSOR if view.waiting(now) else Reason(0)
    return [reason for reason in view.reasons(now) if reason not in hidden]


def _because(state: State | None) -> str:
    """What reasons are said to be the cause of: they leave a valid estimate valid."""
    known = "" if state is None else f"{state.name.lower()} "
    return "wider interval" if state is State.VALID else f"{known}because"


def _band(view: View, now: float, width: int, colour: str) -> list[Line]:
    """A bar from P10 to P90 on a scale from 0 km, with the range as a dot."""
    p10, middle, p90 = (view.value(f"RANGE_Remaining{part}", now) for part in ("P10", "", "P90"))
    cells = width - 4
    if p10 is None or middle is None or p90 is None:
        return [[("  " + "─" * cells, _DIM)], []]
    top = _scale_end(p90)
    first, dot, last = (min(round(value / top * (cells - 1)), cells - 1) for value in (p10, middle, p90))
    bar: Line = [
        ("  " + "─" * first, _DIM),
        ("━" * (dot - first), colour),
        ("●", f"{_BOLD};{colour}"),
        ("━" * (last - dot), colour),
        ("─" * (cells - 1 - last), _DIM),
    ]
    end = f"{top:g} km"
    return [bar, [("  0" + end.rjust(cells - 1), _DIM)]]


def _scale_end(value: float) -> float:
    """The next round number from `value` on."""
    if value <= 1:
        return 1.0
    size = 10.0 ** math.floor(math.log10(value))
    return next(step * size for step in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if step * size >= value)


def _number(view: View, now: float, name: str, codes: str = _BOLD) -> Span:
    late = any(name in entry.limits and entry.late(now) for entry in view.messages.values())
    return view.text(name, now), _DIM if late else codes


def _soc(view: View, now: float, width: int) -> Line:
    late = view.messages["RANGE_Status"].late(now)
    soc, sigma = view.value("RANGE_StateOfCharge", now), view.value("RANGE_StateOfChargeSigma", now)
    text = "–" if soc is None else f"{soc:.1f} %" if sigma is None else f"{soc:.1f} ± {sigma:.1f} %"
    line = _row("State of charge", (f"{text:16}", _DIM if late else _BOLD))
    cells = min(width - 38, 36)
    if soc is not None and cells >= 10:
        full = min(max(round(soc / 100 * cells), 0), cells)
        line += [("█" * full, _DIM if late else "32" if soc > NEARLY_EMPTY else "31"), ("░" * (cells - full), _DIM)]
    return line


def _counts(view: View, now: float) -> list[Line]:
    entries = view.messages.values()
    age = view.age(now)
    last = "none yet" if math.isinf(age) else f"{age:.1f} s old" if age < 100 else f"{_duration(age)} old"
    own = f"{last}, {sum(e.received for e in entries)} received, {sum(e.lost for e in entries)} lost"
    bad = view.bad()
    names = {"Dropped": "dropped", "Implausible": "implausible", "Lost": "lost", "Unknown": "unknown identifiers"}
    counts = {word: view.value(f"RANGE_Count{name}", now) for name, word in names.items()}
    known = [f"{value:.0f} {word}" for word, value in counts.items() if value is not None]
    return [
        _row("Range frames", (own, _DIM), (f", {bad} bad", "31" if bad else _DIM), codes=_DIM),
        _row("Vehicle's frames", (", ".join(known) or "–", _DIM), codes=_DIM),
    ]


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


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
    """A line as it goes to the terminal."""
    return "".join(style.paint(style.plain(text), codes) for text, codes in line)


def summary_line(view: View, now: float) -> str:
    """Everything that matters on one line, for where there is no terminal."""
    if math.isinf(view.age(now)):
        bad = view.bad()
        return f"no frame of {view.file.name}{f' but {bad} bad ones' if bad else ''}. {_NONE_YET}"
    text = partial(view.text, now=now)
    state = view.state(now)
    parts = [
        f"range {text('RANGE_Remaining')} ({text('RANGE_RemainingP10')} to {text('RANGE_RemainingP90')})",
        f"SOC {text('RANGE_StateOfCharge')} ± {text('RANGE_StateOfChargeSigma')}",
        f"{text('RANGE_EnergyLeft')} left",
        f"{text('RANGE_ConsumptionRecent')} recent, {text('RANGE_ConsumptionExpected')} expected",
        _WAITING if view.waiting(now) else state.name.lower() if state is not None else "state unknown",
    ]
    if activity := view.activity(now):
        parts.append(activity)
    if charge := view.charge(now):
        parts.append(charge)
    if causes := causes_text(view, now):
        parts.append(f"why, besides charge: {causes}")
    for what, names in (
        (_because(state), [words(str(reason.name)) for reason in _reasons(view, now) if reason not in KEEPING]),
        ("note", [words(str(reason.name)) for reason in _reasons(view, now) if reason in KEEPING]),
        ("left out", [words(role) for role in view.distrusted(now)]),
        ("stale", list(view.stale(now))),
    ):
        parts += [f"{what}: {', '.join(names)}"] if names else []
    if bad := view.bad():
        parts.append(f"{bad} bad range frames")
    return "; ".join(parts)
