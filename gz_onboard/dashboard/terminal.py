"""``gz-onboard dashboard``: the range in a terminal, from nothing but the range frames on the bus.

What is shown is always of now: a message that has not come for ten of its periods is shown as stale, and its
numbers as dashes. On a terminal a screen that is drawn anew five times a second; anywhere else a line a second.
"""

from __future__ import annotations

import argparse
import errno
import math
import os
import shutil
import signal
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, TextIO

from gz_onboard.bus.channel import CanChannel
from gz_onboard.bus.checksum import crc8_sae_j1850
from gz_onboard.bus.codec import raw_range
from gz_onboard.bus.mapping import find_dbc
from gz_onboard.bus.publisher import KNOWN, RANGE_DBC, range_messages, reason_signal, sensor_signal
from gz_onboard.errors import FAILED, InputError
from gz_onboard.events import EFF_FLAG, ROLES, STALE_PERIODS, Activity, Frame, Reason, State

if TYPE_CHECKING:
    from cantools.database.can import Message

LATE_PERIODS = 3  # after so many the numbers are shown in grey, after STALE_PERIODS not at all
POLL = 0.05  # s
REDRAW = 0.2  # s
PERIODS = {"RANGE_Status": 100}  # ms, where the DBC does not say; of the others 1000
ONCE_WITHIN = 5.0  # s: how long --once waits for every message
_NUMBERS = {  # how each is written: format, unit
    "RANGE_Remaining": (".1f", "km"),
    "RANGE_RemainingP10": (".1f", "km"),
    "RANGE_RemainingP90": (".1f", "km"),
    "RANGE_EnergyLeft": (".0f", "Wh"),
    "RANGE_ConsumptionRecent": (".1f", "Wh/km"),
    "RANGE_ConsumptionExpected": (".1f", "Wh/km"),
    "RANGE_StateOfCharge": (".1f", "%"),
    "RANGE_StateOfChargeSigma": (".1f", "%"),
}


@dataclass
class Received:
    """What is known of one message."""

    definition: Message
    period: float  # s
    limits: dict[str, tuple[float, float]]  # raw
    values: dict[str, float | None] = field(default_factory=dict)
    time: float = -math.inf  # s, when it last came whole
    counter: int | None = None
    received: int = 0
    lost: int = 0  # by its counter
    bad: int = 0  # length, checksum, or a counter that stands still

    def late(self, now: float) -> bool:
        """Whether a newer one should have come by `now` [s]."""
        return now - self.time > LATE_PERIODS * self.period

    def stale(self, now: float) -> bool:
        """Whether its values are too old to be shown at `now` [s]."""
        return now - self.time > STALE_PERIODS * self.period


class View:
    """What the range frames of a DBC file say, of the package's ``range.dbc`` if none is given.

    No clock: times [s, monotonic] come with the frames. InputError if the file has not what ``range.dbc`` has.
    """

    def __init__(self, file: Path | None = None) -> None:
        self.file = file or find_dbc(RANGE_DBC)
        messages = range_messages(self.file)
        self.messages: dict[str, Received] = {}
        self.comments = {s.name: s.comment or "" for m in messages.values() for s in m.signals}
        for name, message in messages.items():
            limits = {s.name: raw_range(s, not_available=True) for s in message.signals}
            self.messages[name] = Received(message, (message.cycle_time or PERIODS.get(name, 1000)) / 1000, limits)
        self._by_identifier = {
            entry.definition.frame_id | (EFF_FLAG if entry.definition.is_extended_frame else 0): entry
            for entry in self.messages.values()
        }

    @property
    def identifiers(self) -> list[int]:
        """Of the frames that it reads: all that the kernel need let through."""
        return list(self._by_identifier)

    def take(self, frame: Frame, now: float) -> None:
        """Take in a frame that came at `now`; one that fails a check is counted and not used."""
        _, identifier, data, _ = frame
        entry = self._by_identifier.get(identifier)
        if entry is None:
            return
        message = entry.definition
        if len(data) != message.length or crc8_sae_j1850(data[:-1]) != data[-1]:
            entry.bad += 1
            return
        raw = message.decode_simple(data, decode_choices=False, scaling=False)
        counter = int(str(raw[f"{message.name}Counter"]))
        if entry.counter is not None and not entry.stale(now):
            step = (counter - entry.counter) % (int(entry.limits[f"{message.name}Counter"][1]) + 1)
            if step == 0:  # the same frame again: who sends it may hang
                entry.bad += 1
                return
            entry.lost += step - 1
        entry.counter = counter
        entry.time = now
        entry.received += 1
        for signal_ in message.signals:
            value = float(str(raw[signal_.name]))
            low, high = entry.limits[signal_.name]
            scale, offset = float(signal_.conversion.scale), float(signal_.conversion.offset)
            entry.values[signal_.name] = value * scale + offset if low <= value <= high else None

    def value(self, signal_: str, now: float) -> float | None:
        """A signal's value in the units of the DBC; None if it is stale, not available or never came."""
        for entry in self.messages.values():
            if signal_ in entry.limits:
                return None if entry.stale(now) else entry.values.get(signal_)
        raise KeyError(signal_)

    def text(self, signal_: str, now: float) -> str:
        """The value with its unit; a dash if there is none."""
        value = self.value(signal_, now)
        form, unit = _NUMBERS[signal_]
        return "–" if value is None else f"{value:{form}} {unit}"

    def state(self, now: float) -> State | None:
        """How far the numbers can be trusted; None if nothing says so.

        The status comes ten times as often as the range, and tells of one that has not come yet: until then the state
        is that of the last range, or starting.
        """
        status, estimate = (self._state(name, now) for name in ("RANGE_StatusState", "RANGE_EstimateState"))
        if status in KNOWN and self.value("RANGE_Remaining", now) is None:
            if not self.messages["RANGE_Estimate"].received:
                return State.STARTING
            status = estimate
        return estimate if status is None else status

    def _state(self, signal_: str, now: float) -> State | None:
        value = self.value(signal_, now)
        return State(int(value)) if value is not None and value in tuple(State) else None

    def reasons(self, now: float) -> list[Reason]:
        """Why the estimate is not what it could be."""
        return [reason for reason in Reason if self.value(reason_signal(reason), now)]

    def activity(self, now: float) -> str:
        """What the vehicle does, in a word; nothing if it is not known, or before there is an estimate."""
        value = None if self.state(now) is State.STARTING else self.value("RANGE_Activity", now)
        return Activity(int(value)).name.lower() if value and value in tuple(Activity) else ""

    def distrusted(self, now: float) -> list[str]:
        """The roles whose sensors contradict the others and are left out."""
        signals = self.messages["RANGE_Sensors"].limits
        return [role for role in ROLES if sensor_signal(role) in signals and self.value(sensor_signal(role), now)]

    def stale(self, now: float) -> dict[str, float]:
        """Age [s] of each message that is stale, infinite if it never came."""
        return {name: now - entry.time for name, entry in self.messages.items() if entry.stale(now)}

    def age(self, now: float) -> float:
        """[s] since the last good frame; infinite if none ever came."""
        return now - max(entry.time for entry in self.messages.values())

    def complete(self) -> bool:
        """Whether every message has come."""
        return all(entry.received for entry in self.messages.values())


def words(name: str) -> str:
    """The name of a reason or a role in words, such as ``no IMU``, ``GPS altitude``, ``acceleration x``."""
    return " ".join(_WORDS.get(word, word) for word in name.lower().split("_"))


_WORDS = {"imu": "IMU", "gps": "GPS", "soc": "SOC", "bms": "BMS", "accel": "acceleration", "rate": "rate of rotation"}


# --- drawing ------------------------------------------------------------------------------------------------------


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
    State.DEGRADED: "degraded: an input is missing, the interval is wider",
    State.INVALID: "invalid: no range can be told",
}

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
    lines: list[Line] = [
        [(" gz-onboard", _BOLD), (f" · {source}", _DIM)],
        [],
        [
            ("  Range             ", ""),
            number("RANGE_Remaining", f"{_BOLD};{colour}"),
            ("     80 %: ", _DIM),
            number("RANGE_RemainingP10"),
            (" to ", _DIM),
            number("RANGE_RemainingP90"),
        ],
        *_band(view, now, width, colour),
        [],
        _soc(view, now, width),
        [("  Energy left       ", ""), number("RANGE_EnergyLeft")],
        [
            ("  Consumption       ", ""),
            number("RANGE_ConsumptionExpected"),
            (" expected, ", ""),
            number("RANGE_ConsumptionRecent"),
            (" over the last km", ""),
        ],
        [],
        [
            ("  State             ", ""),
            (_STATE_WORDS[state], f"{_BOLD};{_STATE_COLOURS[state]}") if state is not None else ("not known", _DIM),
        ],
    ]
    if activity := view.activity(now):
        lines.append([("  Activity          ", ""), (activity, "")])
    for i, reason in enumerate(view.reasons(now)):
        name, comment = words(str(reason.name)), view.comments[reason_signal(reason)]
        lines.append([("  Because           " if i == 0 else " " * 20, ""), (name, "33")])
        if len(name) + len(comment) + 24 <= width:
            lines[-1].append((f": {comment.rstrip('.')}", _DIM))
    left_out = ", ".join(words(role) for role in view.distrusted(now))
    for i, text in enumerate(textwrap.wrap(left_out, max(width - 20, 20))):
        lines.append([("  Sensors left out  " if i == 0 else " " * 20, ""), (text, "33")])
    if math.isinf(view.age(now)):
        lines.append([("  No frame of       ", ""), (view.file.name, "31")])
        lines.append([(f"                    {_NONE_YET}", _DIM)])
    else:
        for i, (name, age) in enumerate(view.stale(now).items()):
            how = "never came" if math.isinf(age) else f"last came {_duration(age)} ago"
            lines.append([("  Stale             " if i == 0 else " " * 20, ""), (f"{name}: {how}", "31")])
    lines += [[], *_counts(view, now)]
    return [_cropped(line, min(room, width)) for line in lines]


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
    line: Line = [("  State of charge   ", ""), (f"{text:16}", _DIM if late else _BOLD)]
    cells = min(width - 38, 36)
    if soc is not None and cells >= 10:
        full = min(max(round(soc / 100 * cells), 0), cells)
        line += [("█" * full, _DIM if late else "32" if soc > 15 else "31"), ("░" * (cells - full), _DIM)]
    return line


def _counts(view: View, now: float) -> list[Line]:
    entries = view.messages.values()
    age = view.age(now)
    last = "none yet" if math.isinf(age) else f"{age:.1f} s old" if age < 100 else f"{_duration(age)} old"
    own = f"{last}, {sum(e.received for e in entries)} received, {sum(e.lost for e in entries)} lost"
    bad = sum(e.bad for e in entries)
    names = {"Dropped": "dropped", "Implausible": "implausible", "Lost": "lost", "Unknown": "unknown identifiers"}
    counts = {word: view.value(f"RANGE_Count{name}", now) for name, word in names.items()}
    known = [f"{value:.0f} {word}" for word, value in counts.items() if value is not None]
    return [
        [("  Range frames      ", _DIM), (own, _DIM), (f", {bad} bad", "31" if bad else _DIM)],
        [("  Vehicle's frames  ", _DIM), (", ".join(known) or "–", _DIM)],
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
        bad = sum(entry.bad for entry in view.messages.values())
        return f"no frame of {view.file.name}{f' but {bad} bad ones' if bad else ''}. {_NONE_YET}"
    text = partial(view.text, now=now)
    state = view.state(now)
    parts = [
        f"range {text('RANGE_Remaining')} ({text('RANGE_RemainingP10')} to {text('RANGE_RemainingP90')})",
        f"SOC {text('RANGE_StateOfCharge')} ± {text('RANGE_StateOfChargeSigma')}",
        f"{text('RANGE_EnergyLeft')} left",
        f"{text('RANGE_ConsumptionRecent')} recent, {text('RANGE_ConsumptionExpected')} expected",
        state.name.lower() if state is not None else "state not known",
    ]
    activity = view.activity(now)
    reasons = ", ".join(words(str(reason.name)) for reason in view.reasons(now))
    left_out = ", ".join(words(role) for role in view.distrusted(now))
    stale = ", ".join(view.stale(now))
    bad = sum(entry.bad for entry in view.messages.values())
    parts += [activity] if activity else []
    parts += [f"because: {reasons}"] if reasons else []
    parts += [f"left out: {left_out}"] if left_out else []
    parts += [f"stale: {stale}"] if stale else []
    parts += [f"{bad} bad range frames"] if bad else []
    return "; ".join(parts)


# --- the command --------------------------------------------------------------------------------------------------


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard dashboard``."""
    add = parser.add_argument
    add("--interface", default="socketcan", help="python-can's interface (%(default)s)")
    add("--channel", default="can0", metavar="NAME", help="channel, as the daemon's (%(default)s)")
    add(
        "--dbc",
        default=RANGE_DBC,
        metavar="FILE",
        help="DBC file of the range frames, the vehicle's range_dbc (%(default)s)",
    )
    add("--once", action="store_true", help="print one picture as soon as every message has come, and end")
    add("--duration", type=float, metavar="S", help="end after this long")


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard dashboard``: 0, also when ended by Ctrl-C; 1 if --once found no range frames."""
    if arguments.duration is not None and not arguments.duration > 0:
        raise InputError(f"--duration {arguments.duration:g}: must be more than 0 s")
    out: TextIO | None = sys.stdout
    if out is None:  # closed by who called us
        raise InputError("there is no standard output to show anything on")
    view = View(find_dbc(arguments.dbc, Path.cwd()))
    channel = CanChannel(arguments.interface, arguments.channel, identifiers=view.identifiers)
    channel.open()
    source = f"{arguments.channel} ({arguments.interface})"
    duration = arguments.duration or (ONCE_WITHIN if arguments.once else math.inf)
    style = Style(
        colour=_is_screen(out) and "NO_COLOR" not in os.environ, unicode="utf" in (out.encoding or "").lower()
    )
    try:
        with _until_signalled() as stopped:
            if arguments.once:
                for _ in _polled(view, channel, duration, lambda: stopped() or view.complete()):
                    pass
                _print(view, source, style, out)
            elif _is_screen(out):
                _show_screen(view, channel, source, style, duration, stopped, out)
            else:
                _show_lines(view, channel, style, duration, stopped, out)
    except OSError as error:
        if error.errno == errno.EIO:  # the terminal was closed: there is nobody to tell
            return FAILED
        if isinstance(error, BrokenPipeError):
            raise
        raise InputError(f"standard output: {error.strerror}") from error
    finally:
        channel.close()
    return FAILED if arguments.once and math.isinf(view.age(time.monotonic())) else 0


def _is_screen(out: IO[str]) -> bool:
    """Whether `out` is a terminal that this process may take over."""
    in_front = threading.current_thread() is threading.main_thread()
    return in_front and out.isatty() and os.environ.get("TERM", "dumb") != "dumb"


@contextmanager
def _until_signalled() -> Iterator[Callable[[], bool]]:
    """Whether to stop: SIGINT and SIGTERM ask for it, so that the terminal is left as it was found."""
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    stopping = threading.Event()
    wanted = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, lambda *_: stopping.set()) for number in wanted}
    try:
        yield stopping.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _polled(view: View, channel: CanChannel, duration: float, stopped: Callable[[], bool]) -> Iterator[float]:
    """Drain the channel into the view until it is time to stop; yields the time [s] after each drain."""
    end = time.monotonic() + duration
    while True:
        frames = channel.drain()
        now = time.monotonic()
        for frame in frames:
            view.take(frame, now)
        yield now
        if now >= end or stopped():
            return
        time.sleep(min(POLL, max(end - now, 0)))


def _show_screen(
    view: View,
    channel: CanChannel,
    source: str,
    style: Style,
    duration: float,
    stopped: Callable[[], bool],
    out: IO[str],
) -> None:
    out.write("\x1b[?1049h\x1b[?25l")  # the other screen, without the cursor: what stood here comes back
    try:
        drawn = -math.inf
        for now in _polled(view, channel, duration, stopped):
            if now - drawn < REDRAW:
                continue
            drawn = now
            size = shutil.get_terminal_size()
            lines = screen(view, now, source if channel.up else f"{source} is down", size.columns)
            # Over the old picture, not after clearing it: no flicker. What is erased is erased before a line is
            # written: behind one that is as wide as the terminal, its last letter would go.
            text = "\r\n".join(f"\x1b[K{rendered(line, style)}" for line in lines[: size.lines])
            out.write(f"\x1b[H{text}" + ("\r\n\x1b[J" if len(lines) < size.lines else ""))
            out.flush()
    finally:
        out.write("\x1b[0m\x1b[?25h\x1b[?1049l")
        out.flush()
    _print(view, source, style, out)


def _show_lines(
    view: View, channel: CanChannel, style: Style, duration: float, stopped: Callable[[], bool], out: IO[str]
) -> None:
    printed = time.monotonic()
    for now in _polled(view, channel, duration, stopped):
        if now - printed < 1.0:
            continue
        printed += math.floor(now - printed)
        down = "" if channel.up else f"; {channel.name} is down"
        print(style.plain(f"{time.strftime('%H:%M:%S')} {summary_line(view, now)}{down}"), file=out, flush=True)


def _print(view: View, source: str, style: Style, out: IO[str]) -> None:
    """The picture as it is now, to stay."""
    width = shutil.get_terminal_size().columns
    for line in screen(view, time.monotonic(), source, width):
        print(rendered(line, style).rstrip(), file=out)
    out.flush()
