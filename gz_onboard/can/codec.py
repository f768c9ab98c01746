"""Decode CAN frames into windows of the roles that their signals play.

A frame costs a look-up and an append: the frames of each message are kept until the window ends, about twice a second,
and are then checked and decoded together.

Whole frame or nothing: a frame that fails a check is dropped, counted by message and reason, and never becomes a
number. Nothing here raises on whatever the bus brings.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from math import isnan
from operator import itemgetter
from typing import TYPE_CHECKING

from gz_onboard.can.layout import (
    Column,
    Layout,
    MessageSignals,
    Values,
    crc_differences,
    is_not_available,
    plausible_range,
    raw_range,
)
from gz_onboard.can.mapping import BusMapping, Protection, Source
from gz_onboard.can.origins import Origin, Origins
from gz_onboard.can.requests import FUNCTIONAL, INTERRUPTED, MALFORMED, SEQUENCE, answer_readers
from gz_onboard.events import (
    ERR_FLAG,
    RTR_FLAG,
    SQUARED,
    STALE_PERIODS,
    TRANSMITTED,
    Frame,
    Group,
    MessageWindow,
    RoleWindow,
)

if TYPE_CHECKING:
    from cantools.database.can import Message

# Why a frame or a signal was dropped
LENGTH = "wrong length"
CRC = "wrong checksum"
COUNTER = "counter jump"
NOT_AVAILABLE = "not available"
RANGE = "out of range"
TIME = "implausible time"
CONFLICT = "different data from two channels or senders"
DROPPING = (LENGTH, CRC, COUNTER, TIME, CONFLICT, SEQUENCE, INTERRUPTED, MALFORMED)  # that drop a frame or an answer

BACK_NS = 50_000_000  # frames of two channels may overtake each other by a little
AHEAD_NS = 30_000_000_000
LONGEST_PAUSE_NS = 30 * 86_400 * 1_000_000_000
"""Of a log: a leap ahead by more is a clock that was set. A live bus may be silent for as long as it likes."""
PAUSE = 1.0  # s: after it any counter goes, where the period of a message is not known
CONFIRM = 3  # so many frames in a row agree on a new time before it is believed
MOST_IDENTIFIERS = 4096  # that are remembered: a babbling node must not fill the memory
_MOST_LEAPS = 100  # of the clock, that are remembered
_IDENTIFIER = itemgetter(1)


class MessageDecoder:
    """Checks and decodes the frames of one message, or the answers to one request, a batch at a time.

    origin: chooses among the places that frames come from; None for answers. not_available: whether all ones mean that.
    limits: the least and the greatest raw value of each of `signals` that is taken for real.
    """

    def __init__(
        self, codec: Codec, message: Message, sources: list[Source], origin: Origin | None, not_available: bool
    ) -> None:
        self.inbox: list[Frame] = []
        self.is_sole = True  # whether all frames come from the message's own place
        self.message, self.name, self.sources, self.origin = message, message.name, sources, origin
        self.not_available, self._codec = not_available, codec
        self.group = len(codec.groups) if sources else None
        self.protection = codec.mapping.protection.get(self.name, Protection()) if sources else Protection()
        period = codec.mapping.periods.get(self.name)
        if sources:
            codec.groups.append(Group(self.name, tuple(source.role for source in sources), period))
        self.signals = [message.get_signal_by_name(source.signal) for source in sources]
        self.limits = [
            plausible_range(source, *raw_range(signal, not_available))
            for source, signal in zip(sources, self.signals, strict=True)
        ]
        self._layout = Layout(message, self.signals)
        self._roles = [
            (*limits, source.factor, source.offset, source.role in SQUARED)
            for source, limits in zip(sources, self.limits, strict=True)
        ]
        counter = [message.get_signal_by_name(self.protection.counter)] if self.protection.counter else []
        self._counter = Layout(message, counter)
        self.counts = tuple(map(int, raw_range(counter[0], not_available))) if counter else (0, 0)
        self._following: float = self.counts[0]
        self._seen_ns = -1 << 80
        self.pause_ns = round((STALE_PERIODS * period if period else PAUSE) * 1e9)  # after it any counter goes

    def window(self, origin_ns: int) -> MessageWindow | None:
        """The samples of the frames in the inbox, which is emptied. origin_ns: where the timeline begins."""
        frames = self.inbox.copy()
        self.inbox.clear()
        if not self.is_sole:
            frames = self._from_own_place(frames, origin_ns)
        elif self.origin:
            self.origin.last = frames[-1], origin_ns
        if frames:
            frames, data = self._intact(frames, origin_ns)
        if not frames:
            return None
        self._codec.latest[self.name] = frames[-1]
        return self._decode(frames, data, origin_ns) if self._roles else None

    def _from_own_place(self, frames: Sequence[Frame], origin_ns: int) -> list[Frame]:
        kept, origin = [], self.origin
        assert origin
        for frame in frames:
            time_ns, identifier, data, channel = frame
            is_own = origin.takes(time_ns - origin_ns, channel, identifier, data)
            if origin.conflict:
                self._codec.faults[self.name, CONFLICT] += 1
            elif is_own:
                kept.append(frame)
            else:
                self._codec.copies += 1
        return kept

    def _intact(self, frames: list[Frame], origin_ns: int) -> tuple[list[Frame], bytes]:
        """Drop frames with a wrong length, checksum or counter; return the others, and their data in one piece."""
        length, protection, faults = self.message.length, self.protection, self._codec.faults
        wrong = [len(frame[2]) for frame in frames if len(frame[2]) != length]
        if wrong:
            faults[self.name, LENGTH] += len(wrong)
            if self.origin is None:
                self._codec.wrong_lengths[self.name] = wrong[-1]
            frames = [frame for frame in frames if len(frame[2]) == length]
        data = b"".join([frame[2] for frame in frames])
        if protection.crc:
            differences = crc_differences(data, length)
            if any(differences):
                frames = [frame for frame, difference in zip(frames, differences, strict=True) if not difference]
                faults[self.name, CRC] += len(differences) - len(frames)
                data = b"".join([frame[2] for frame in frames])
        if protection.counter and frames:
            right = self._follow_counter(frames, data, origin_ns)
            if len(right) < len(frames):
                faults[self.name, COUNTER] += len(frames) - len(right)
                frames, data = right, b"".join([frame[2] for frame in right])
        return frames, data

    def _follow_counter(self, frames: list[Frame], data: bytes, origin_ns: int) -> list[Frame]:
        """Those of `frames` whose counter is right, as of AUTOSAR's E2E.

        A repeated or far-off counter is wrong, a small step shows lost frames; after a pause any value is taken.
        """
        (low, high), right, lost = self.counts, [], 0
        counts = self._counter.columns(data, len(frames))[0]
        expected = [self._following, *(count + 1 if count < high else low for count in counts)]
        if list(counts) == expected[:-1]:
            self._following, self._seen_ns = expected[-1], frames[-1][0] - origin_ns
            return frames
        for frame, count in zip(frames, counts, strict=True):
            missing, time_ns = 0, frame[0] - origin_ns
            if count != self._following:
                if not low <= count <= high:
                    continue
                if time_ns - self._seen_ns < self.pause_ns:
                    missing = int(count - self._following) % (high - low + 1)
            self._following, self._seen_ns = count + 1 if count < high else low, time_ns
            if not missing or missing < (high - low + 1) // 2:
                right.append(frame)
                lost += missing
        if lost:
            self._codec.lost[self.name] += lost
        return right

    def _decode(self, frames: Sequence[Frame], data: bytes, origin_ns: int) -> MessageWindow | None:
        columns, count = self._layout.columns(data, len(frames)), len(frames)
        last_ns = frames[-1][0] - origin_ns
        all_rows = (
            [self._layout.rows(place, columns) for place in range(len(self._roles))] if self._layout.is_paged else ()
        )
        if all_rows and None not in all_rows:  # a frame of another page counts for nothing
            seen = sorted({row for rows in all_rows for row in rows or ()})
            if not seen:
                return None
            last_ns, count = frames[seen[-1]][0] - origin_ns, len(seen)
        roles: list[RoleWindow | None] = []
        for place, (low, high, scale, offset, is_squared) in enumerate(self._roles):
            values, time_ns, rows = columns[place], last_ns, all_rows[place] if all_rows else None
            if rows is not None:
                values = [values[row] for row in rows]
            total = sum(values)
            if values and not (low <= min(values) and max(values) <= high and not isnan(total)):
                rows = self._physical(place, columns[place], range(len(frames)) if rows is None else rows)
                values = [columns[place][row] for row in rows]
                total = sum(values)
            if not values:
                roles.append(None)
                continue
            if rows is not None:
                time_ns = frames[rows[-1]][0] - origin_ns
            samples, mean_square = len(values), None
            mean = total / samples
            if is_squared:
                square = sum([value * value for value in values])
                mean_square = scale * scale * square / samples + offset * (2 * scale * mean + offset)
            value = values[-1] * scale + offset
            roles.append(RoleWindow(time_ns * 1e-9, value, samples, mean * scale + offset, mean_square))
        return MessageWindow(self.group or 0, last_ns * 1e-9, count, tuple(roles))

    def _physical(self, place: int, column: Column, rows: Sequence[int]) -> list[int]:
        """Keep the `rows` whose value is within its limits, and count the others."""
        signal, (low, high) = self.signals[place], self.limits[place]
        kept = [row for row in rows if low <= column[row] <= high]  # not NaN
        for row in rows:
            if not low <= column[row] <= high:
                absent = self.not_available and is_not_available(signal, column[row])
                self._codec.faults[f"{self.name}.{signal.name}", NOT_AVAILABLE if absent else RANGE] += 1
        return kept

    @cached_property
    def all_signals(self) -> MessageSignals:
        """Decodes every signal of the message."""
        return MessageSignals(self.message, self.not_available)


class Codec:
    """Decodes frames of one vehicle. Its state serves the checks: counters, the last time, the counts.

    All counts but `received` are those at the last call of `windows`.
    """

    def __init__(self, mapping: BusMapping, longest_pause_ns: int | None = None) -> None:
        self.mapping = mapping
        self.longest_pause_ns = longest_pause_ns  # None: any leap ahead is a pause
        self.leaps: list[tuple[float, float]] = []  # of the clock: when [s on our timeline], by how much [s]
        self.groups: list[Group] = list(mapping.groups)
        self.faults: Counter[tuple[str, str]] = Counter()  # (message, reason) -> frames or signals dropped
        self.lost: Counter[str] = Counter()  # message -> frames that its counter shows as missing
        self.unknown: Counter[int] = Counter()  # identifier -> frames, of the first few thousand identifiers
        self.unknown_others = 0  # frames of further identifiers
        self.copies = 0  # frames of known messages from another channel or sender than they are taken from
        self.error_frames = 0
        self.received = 0
        self.latest: dict[str, Frame] = {}  # message or request -> the last good frame, or answer
        self.wrong_lengths: dict[str, int] = {}  # request -> bytes of the last answer that has another length
        self.origin_ns: int | None = None  # where the timeline begins, by the clock of the frames as it is set now
        self.last_ns = 0  # the time of the last frame by that clock
        self._suspects = 0
        self._suspect_ns = 0  # the time of the last suspect
        self._before_ns = 0  # `last_ns` when it came: a good frame in between clears the suspicion
        self._ready: list[MessageWindow] = []  # from before the clock was set
        self._inboxes: dict[int, dict[int, list[Frame]]] = {}  # by channel and identifier, of what was heard
        self._room = MOST_IDENTIFIERS  # for more of them
        self._errors: list[Frame] = []
        self._strangers: list[Frame] = []  # that no DBC file has
        self._copies: list[Frame] = []  # of answers
        self._questions: list[Frame] = []
        sources: dict[str, list[Source]] = {}
        for source in mapping.sources:
            sources.setdefault(source.message, []).append(source)
        self.origins = Origins(mapping, sources)
        self.decoders = {
            origin.message.name: MessageDecoder(
                self, origin.message, sources.get(origin.message.name, []), origin, mapping.not_available
            )
            for origin in self.origins
        }
        self._answers = answer_readers(mapping.requests, self.faults)
        self._answering: dict[int, int] = {}  # channel by identifier of an answer: the first, as a gateway may copy it
        for request in mapping.requests:
            # All ones are a value: what limits are for.
            decoder = MessageDecoder(self, request.message, sources.get(request.name, []), None, False)
            self.decoders[request.name] = decoder
        self.asked = {*FUNCTIONAL, *(request.request for request in mapping.requests)} if mapping.requests else set()

    # --- frames ---------------------------------------------------------------------------------------------

    def decode(self, frames: Sequence[Frame]) -> None:
        """Take `frames` in for the window. Times are since the first frame ever decoded."""
        self.received += len(frames)
        if self.origin_ns is None and frames:
            self.origin_ns = self.last_ns = frames[0][0]
        heard, last = -1, self.last_ns
        inboxes: dict[int, list[Frame]] = {}  # of the channel that is heard
        for frame in frames:
            step = frame[0] - last
            if 0 <= step <= AHEAD_NS:
                last = frame[0]
            elif not -BACK_NS <= step < 0:
                self.last_ns = last
                if not self.retime(frame[0]):
                    continue
                last = self.last_ns
            if frame[3] != heard:
                heard = frame[3]
                inboxes = self._inboxes.setdefault(heard, {})
            try:
                inboxes[frame[1]].append(frame)
            except KeyError:
                self.inbox(heard, frame[1]).append(frame)
        self.last_ns = last

    def begin_at(self, origin_ns: int | None) -> None:
        """Let the timeline begin at this time of the frames' clock, as it is set now."""
        if origin_ns != self.origin_ns:
            self._ready += self._settle()
            self.origin_ns = origin_ns

    def windows(self) -> list[MessageWindow]:
        """The values of each message since the last call, of those that came."""
        windows, self._ready = self._ready + self._settle(), []
        return windows

    def _settle(self) -> list[MessageWindow]:
        """Check, decode and count the frames that wait."""
        self.error_frames += len(self._errors)
        self.copies += len(self._copies)
        for identifier, count in Counter(map(_IDENTIFIER, self._strangers)).items():
            if identifier in self.unknown or len(self.unknown) < MOST_IDENTIFIERS:
                self.unknown[identifier] += count
            else:
                self.unknown_others += count
        for waiting in (self._errors, self._copies, self._strangers, self._questions):
            waiting.clear()
        origin_ns = self.origin_ns or 0
        for reader in self._answers.values():
            for time_ns, identifier, data, channel in reader.inbox:
                for request, answer in reader.take((time_ns - origin_ns) * 1e-9, data):
                    self.decoders[request.name].inbox.append((time_ns, identifier, answer, channel))
            reader.inbox.clear()
        decoders = self.decoders.values()
        return [window for decoder in decoders if decoder.inbox and (window := decoder.window(origin_ns))]

    def seconds(self, time_ns: int) -> float:
        """`time_ns` on the timeline [s]."""
        return 0.0 if self.origin_ns is None else (time_ns - self.origin_ns) * 1e-9

    def time_ns(self, seconds: float) -> int:
        """`seconds` of the timeline by the clock of the frames, as it is set now [ns]; 0 before the first frame."""
        return 0 if self.origin_ns is None else max(self.origin_ns + round(seconds * 1e9), 0)

    def clock_set(self, delta_ns: int) -> None:
        """The clock that stamps the frames was set by `delta_ns`; the timeline continues."""
        if self.origin_ns is not None:
            self.begin_at(self.origin_ns + delta_ns)
            self.last_ns += delta_ns

    def retime(self, time_ns: int) -> bool:
        """Take a time that does not follow the last one: True if the frame is to be used.

        One odd stamp is dropped. Several in a row that follow each other mean that the clock was set: back, or ahead by
        more than the longest pause, and the timeline continues; else ahead, and it is taken as a gap in
        the recording.
        """
        assert self.origin_ns is not None
        follows = self._before_ns == self.last_ns and -BACK_NS <= time_ns - self._suspect_ns <= AHEAD_NS
        self._suspects = self._suspects + 1 if follows and self._suspects else 1
        self._suspect_ns, self._before_ns = time_ns, self.last_ns
        if self._suspects < CONFIRM:
            self.faults["", TIME] += 1
            return False
        self._suspects = 0
        leap = time_ns - self.last_ns
        if leap < 0 or (self.longest_pause_ns is not None and leap > self.longest_pause_ns):
            if len(self.leaps) < _MOST_LEAPS:
                self.leaps.append((self.seconds(self.last_ns), leap * 1e-9))
            self.begin_at(self.origin_ns + leap)
        self.last_ns = time_ns
        return True

    # --- where frames go --------------------------------------------------------------------------------------

    def inbox(self, channel: int, identifier: int) -> list[Frame]:
        """Where frames with this identifier on this channel wait; remembered while there is room."""
        place = channel & ~TRANSMITTED
        origin = None if identifier & (ERR_FLAG | RTR_FLAG) else self.origins.find(identifier)
        if identifier & ERR_FLAG:
            inbox = self._errors
        elif identifier in self._answers:
            is_first = self._answering.setdefault(identifier, place) == place
            inbox = self._answers[identifier].inbox if is_first else self._copies
        elif identifier in self.asked:
            inbox = self._questions
        elif origin:
            decoder = self.decoders[origin.message.name]
            decoder.is_sole, inbox = origin.hear(place, identifier), decoder.inbox
        else:
            inbox = self._strangers
        inboxes = self._inboxes.setdefault(channel, {})
        if self._room:
            self._room -= 1
            inboxes[identifier] = inbox
        return inbox

    def heard(self, name: str) -> list[tuple[int, int]]:
        """(channel, identifier) of all frames of a message that were heard, also where it is not taken from."""
        inbox = self.decoders[name].inbox
        found = [(c & ~TRANSMITTED, i) for c, known in self._inboxes.items() for i in known if known[i] is inbox]
        return sorted(set(found))

    def values(self, name: str, data: bytes) -> Values:
        """Every signal of a message or an answer in the units of the DBC, see `MessageSignals.values`."""
        return self.decoders[name].all_signals.values(data) or {}
