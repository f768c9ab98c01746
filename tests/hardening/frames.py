"""Hostile frames: strangers, damage, forgeries and odd time stamps, mixed into rides.

Each session is a new pipeline on a piece of a ride, live as the daemon drives it or offline as an estimate does, with
its own mixture of spoilers. Frames are forged with the right counter and checksum, so that their values get through.
What holds after every portion: nothing raised, numbers finite and in their bounds and order, range frames that
every receiver takes, memory bounded, and every frame either used or counted as dropped.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from itertools import pairwise
from math import isfinite
from operator import itemgetter
from random import Random

from gz_onboard.can.codec import DROPPING, TIME, Codec
from gz_onboard.can.layout import raw_range
from gz_onboard.daemon.loop import CLOCK_STEP_NS
from gz_onboard.events import EFF_FLAG, ERR_FLAG, RTR_FLAG, TRANSMITTED, Frame
from gz_onboard.pipeline import TICK_NS
from gz_onboard.recording.decode import feed
from gz_onboard.recording.frames import FrameColumns, stray
from gz_onboard.vehicle import Vehicle
from tests.events import events_of
from tests.hardening import Report
from tests.support import EPOCH, MS, Run, S, check_sound, recorded, reference, sealed
from tests.vehicles.test_other_vehicles import tlmoto_frames
from tests.vehicles.test_other_vehicles import vehicle as other_vehicle

TITLE = "Frames: strangers, damage, forgeries and odd time stamps, mixed into rides"
COUNT = 300_000
FULL_COUNT = 20_000_000
PORTION = 2000  # frames between two checks
KEPT = 4096  # identifiers that a codec remembers, known ones not counted
STAMPS = (0, 1, -1, -(2**31), 2**31, 2**62, 2**63 - 1, 2**63, 2**64, -(2**63), -(2**80))  # ns
STEPS = (0, 1, -1, -51 * MS, -S, -86_400 * S, 29 * S, 31 * S, 3600 * S, 86_400 * S)  # ns

Spoiler = Callable[[Random, Frame], Sequence[Frame]]
"""What comes instead of a frame."""


class Layout:
    """Places of one message's signals, as integers of its data: little-endian, as bytes stand in a frame."""

    def __init__(self, vehicle: Vehicle, identifier: int) -> None:
        mapping = vehicle.mapping
        message = mapping.database.get_message_by_frame_id(identifier & ~EFF_FLAG)
        protection = mapping.protection.get(message.name)
        self.length = message.length
        self.crc = bool(protection and protection.crc)
        self.counter = 0
        self.extremes: list[tuple[int, int]] = []  # (mask of a signal, its bits)
        zero = {signal.name: 0 for signal in message.signals}

        def bits(name: str, raw: float) -> int:
            return int.from_bytes(message.encode(zero | {name: raw}, scaling=False, strict=False), "little")

        for signal in message.signals:
            low, high = (-(2 ** (signal.length - 1)),) * 2 if signal.is_signed else (0, 2**signal.length - 1)
            if signal.is_signed:
                high = -low - 1
            mask = bits(signal.name, -1 if signal.is_signed else high)
            if protection and signal.name == protection.counter:
                self.counter = mask
            else:
                least, most = raw_range(signal, mapping.not_available)
                raws = {0, 1, low, high, low + 1, high - 1, least, most, least - 1, most + 1}
                self.extremes += [(mask, bits(signal.name, raw)) for raw in sorted(raws) if low <= raw <= high]

    def put(self, data: bytes, mask: int, value: int) -> bytes:
        """`data` with other bits where `mask` is, and with the right checksum."""
        changed = (int.from_bytes(data, "little") & ~mask | value & mask).to_bytes(self.length, "little")
        return sealed(changed) if self.crc else changed


def layouts(vehicle: Vehicle) -> dict[int, Layout]:
    """Of every message that the vehicle knows, by identifier."""
    messages = vehicle.mapping.database.messages
    identifiers = [m.frame_id | (EFF_FLAG if m.is_extended_frame else 0) for m in messages]
    return {identifier: Layout(vehicle, identifier) for identifier in identifiers}


# --- spoilers ---------------------------------------------------------------------------------------------------------


def spoilers(known: dict[int, Layout]) -> dict[str, Spoiler]:
    """The ways to spoil a frame of a vehicle that knows these messages, by name."""
    identifiers = sorted(known)
    stuck: dict[int, tuple[int, int]] = {}  # an extreme value that a message keeps for a while
    old: dict[int, Frame] = {}

    def any_data(rng: Random) -> bytes:
        return rng.randbytes(rng.choice((0, 1, 2, 4, 5, 6, 7, 8, 8, 8, 8, 12, 16, 32, 64)))

    def stranger(rng: Random, frame: Frame) -> Sequence[Frame]:
        identifiers = (
            rng.choice((rng.getrandbits(11), rng.getrandbits(29) | EFF_FLAG, rng.getrandbits(32)))
            for _ in range(rng.choice((1, 1, 10)))
        )
        return frame, *((frame[0], identifier, any_data(rng), rng.choice((0, 1))) for identifier in identifiers)

    def random_data(rng: Random, frame: Frame) -> Sequence[Frame]:
        return frame, (frame[0], rng.choice(identifiers), any_data(rng), frame[3])

    def flagged(rng: Random, frame: Frame) -> Sequence[Frame]:
        return frame, (frame[0], frame[1] ^ rng.choice((EFF_FLAG, RTR_FLAG, ERR_FLAG, 1 << 30 | 1)), *frame[2:])

    def damaged(rng: Random, frame: Frame) -> Sequence[Frame]:
        data = bytearray(frame[2])
        for _ in range(rng.choice((1, 1, 2, 3))):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        return ((frame[0], frame[1], bytes(data), frame[3]),)

    def resized(rng: Random, frame: Frame) -> Sequence[Frame]:
        data = frame[2][: rng.randrange(len(frame[2]))] if rng.random() < 0.5 else frame[2] + rng.randbytes(4)
        return ((frame[0], frame[1], data, frame[3]),)

    def lost(_rng: Random, _frame: Frame) -> Sequence[Frame]:
        return ()

    def repeated(rng: Random, frame: Frame) -> Sequence[Frame]:
        before = old.get(frame[1], frame)
        if rng.random() < 0.1:
            old[frame[1]] = frame
        return frame, (frame[0], *before[1:])

    def forged(rng: Random, frame: Frame) -> Sequence[Frame]:
        layout = known[frame[1]]
        everything = (1 << 8 * layout.length) - 1
        data = layout.put(frame[2], everything & ~layout.counter, rng.getrandbits(8 * layout.length))
        return ((frame[0], frame[1], data, frame[3]),)

    def extreme(rng: Random, frame: Frame) -> Sequence[Frame]:
        layout = known[frame[1]]
        if frame[1] not in stuck or rng.random() < 0.01:
            stuck[frame[1]] = rng.choice(layout.extremes)
        return ((frame[0], frame[1], layout.put(frame[2], *stuck[frame[1]]), frame[3]),)

    return {f.__name__: f for f in (stranger, random_data, flagged, damaged, resized, lost, repeated, forged, extreme)}


def hostile(rng: Random, known: dict[int, Layout], ride: Sequence[Frame]) -> Iterator[tuple[int, Frame]]:
    """(when it arrives [ns], frame): the ride with some of its frames spoilt; a few have odd time stamps."""
    ways = spoilers(known)
    chosen = [ways[name] for name in rng.sample(sorted(ways), rng.randrange(1, 5))]
    share = rng.random() ** 3
    odd_every = rng.choice((2000, 20_000, 1 << 60))
    odd_left, shift, stamp = 0, 0, 0
    for frame in ride:
        spoilt = rng.choice(chosen)(rng, frame) if rng.random() < share else (frame,)
        if not odd_left and not rng.randrange(odd_every):  # one odd stamp, or enough of them to be believed
            odd_left = rng.choice((1, 2, 3, 8))
            shift, stamp = (rng.choice(STEPS), 0) if rng.random() < 0.7 else (0, rng.choice(STAMPS))
        for _, identifier, data, channel in spoilt:
            if odd_left:
                odd_left -= 1
                yield frame[0], (stamp or frame[0] + shift, identifier, data, channel)
            else:
                yield frame[0], (frame[0], identifier, data, channel)


# --- a session --------------------------------------------------------------------------------------------------------


@cache
def rides() -> list[tuple[Vehicle, dict[int, Layout], tuple[Frame, ...]]]:
    """Rides of a vehicle with counters and checksums, and of one without."""
    motorcycle = other_vehicle("tlmoto")
    steady = [
        tlmoto_frames(EPOCH + i * 200 * MS, 2500 + 20 * (i % 50), 114.0 - i * 1e-3, 40.0 + i % 30) for i in range(2000)
    ]
    known = layouts(motorcycle)
    frames = tuple(frame for four in steady for frame in four if frame[1] in known)
    return [(reference(), layouts(reference()), recorded("city_14C")), (motorcycle, known, frames)]


class Watch:
    """A run, and a second codec that is given its frames one at a time: both must count the same."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.run = Run(vehicle)
        self.second = Codec(vehicle.mapping)
        self.used = 0  # frames that were dropped by no check
        self.told: Counter[str] = Counter()
        self.states: Counter[str] = Counter()
        self._time = -1e300  # s, of the last estimate

    def check(self) -> None:
        """Hold all that came since the last check against the promises; AssertionError if one is broken."""
        run, codec, second = self.run, self.run.pipeline.codec, self.second
        check_sound(run)
        codec.windows()  # counts the frames of the window under way
        times = [self._time, *(e.time for e in run.estimates)]
        assert all(isfinite(b) and b >= a for a, b in pairwise(times)), "the time of the estimates goes back"
        latest = second.latest
        for frame in run.logged:
            if not frame[3] & TRANSMITTED:
                origin = second.origins.find(frame[1])
                name = origin.message.name if origin else ""
                before = latest.get(name)
                events_of(second, (frame,))
                self.used += latest.get(name) is not before
        counted = sum(n for (_, reason), n in codec.faults.items() if reason in DROPPING)
        counted += sum(codec.unknown.values()) + codec.unknown_others + codec.error_frames + codec.copies
        assert codec.received == self.used + counted, f"{codec.received} frames, {self.used} used, {counted} counted"
        for what in ("faults", "lost", "unknown", "unknown_others", "error_frames", "copies", "received"):
            assert getattr(codec, what) == getattr(second, what), f"{what}: not the same in other portions"
        assert run.pipeline.counts().dropped == sum(n for (_, r), n in codec.faults.items() if r in DROPPING)
        messages = len(codec.mapping.database.messages)
        assert len(codec.unknown) <= KEPT
        assert sum(map(len, codec._inboxes.values())) <= KEPT + messages
        assert len(codec.latest) <= messages
        self._time = times[-1]
        self.told["estimates"] += len(run.estimates)
        self.states.update(e.state.name.lower() for e in run.estimates)
        self.told["range frames"] += len(run.sent)
        for kept in (run.estimates, run.logged, run.samples):
            kept.clear()


def live(watch: Watch, frames: Iterator[tuple[int, Frame]]) -> None:
    """As the daemon does it: a round each tick, sorted by stamp, what is a little ahead of its time waits."""
    waiting: list[Frame] = []
    due: int | None = None
    since = 0
    for arrival, frame in frames:
        due = arrival if due is None else due
        while arrival >= due:
            waiting.sort(key=itemgetter(0))
            end, beyond = bisect_left(waiting, (due,)), bisect_left(waiting, (due + CLOCK_STEP_NS,))
            now, waiting = waiting[:end] + waiting[beyond:], waiting[end:beyond]
            watch.run.pipeline.advance(now, due)
            due += TICK_NS
        waiting.append(frame)
        since += 1
        if since >= PORTION:
            since = 0
            watch.check()
    watch.check()


def offline(watch: Watch, frames: Iterator[tuple[int, Frame]]) -> None:
    """As an estimate of a log does it."""
    taken = [frame for _, frame in frames]
    columns = FrameColumns.of(taken)
    odd = int(stray(columns.time_ns).sum())  # dropped before a codec sees them
    watch.second.received += odd
    if odd:
        watch.second.faults["", TIME] = odd
    feed(watch.run.pipeline, columns)
    watch.check()


def session(rng: Random, most: int) -> Watch:
    """One pipeline on a piece of a ride, of at most `most` frames before they are spoilt. Raises what goes wrong."""
    vehicle, known, ride = rng.choice(rides())
    length = min(most, rng.choice((300, 1000, 3000, 10_000, 50_000)), len(ride))
    begin = rng.randrange(len(ride) - length + 1)
    watch = Watch(vehicle)
    rng.choice((live, offline))(watch, hostile(rng, known, ride[begin : begin + length]))
    return watch


def run(count: int, seed: int) -> Report:
    """Sessions of `count` frames altogether, drawn from `seed`."""
    report = Report()
    done = number = 0
    faults: Counter[str] = Counter()
    told: Counter[str] = Counter()
    states: Counter[str] = Counter()
    used = unknown = errors = most = 0
    while done < count:
        number += 1
        try:
            watch = session(Random(f"{seed}/{number}"), count - done)
        except Exception as error:
            report.failures.append(f"session {seed}/{number}: {type(error).__name__}: {error}")
            done += 1000
            continue
        codec = watch.run.pipeline.codec
        done += max(codec.received, 1)
        used += watch.used
        unknown += sum(codec.unknown.values()) + codec.unknown_others
        errors += codec.error_frames
        most = max(most, sum(map(len, codec._inboxes.values())))
        told += watch.told
        states += watch.states
        for (_, reason), n in codec.faults.items():
            faults[reason] += n
    report.rows = {
        "frames": f"{done:,} in {number:,} sessions",
        "used": f"{used:,}",
        "of identifiers that nobody knows; error frames": f"{unknown:,}; {errors:,}",
        "most identifiers remembered": f"{most:,}",
        **{f"frames dropped: {reason}": f"{faults[reason]:,}" for reason in DROPPING},
        **{f"values left out: {reason}": f"{n:,}" for reason, n in sorted(faults.items()) if reason not in DROPPING},
        "estimates checked": f"{told['estimates']:,} ("
        + ", ".join(f"{n:,} {s}" for s, n in states.most_common())
        + ")",
        "range frames checked": f"{told['range frames']:,}",
    }
    return report
