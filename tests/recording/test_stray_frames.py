"""A few frames of a log that are stamped ahead of all others do not move time; a gap is a gap."""

from __future__ import annotations

from collections.abc import Sequence

from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.can.codec import CONFIRM
from gz_onboard.events import Frame
from gz_onboard.recording.frames import FrameColumns, stray
from tests.support import EPOCH, MS, S


def stamped(times: Sequence[int]) -> list[Frame]:
    """A frame for each time [ms]."""
    return [(EPOCH + time * MS, 0x100, bytes([number % 256]), 0) for number, time in enumerate(times)]


def told_apart(frames: list[Frame]) -> tuple[list[Frame], list[Frame]]:
    """(those kept, those that are odd)."""
    odd = stray(FrameColumns.of(frames).time_ns).tolist()
    both = list(zip(frames, odd, strict=True))
    return [frame for frame, is_odd in both if not is_odd], [frame for frame, is_odd in both if is_odd]


@settings(max_examples=60, deadline=None)
@given(places=st.sets(st.integers(1, 58)), ahead=st.integers(700, 29_900), in_row=st.integers(1, CONFIRM - 1))
def test_lone_frames_are_odd_wherever_they_are(places, ahead, in_row):
    frames = stamped([10 * i for i in range(100)])
    apart = sorted(place for place in places if place % 4 == 0)
    wrong = [(EPOCH + (10 * i + ahead) * MS, 0x200, bytes([k]), 1) for i in apart for k in range(in_row)]
    mixed = list(frames)
    for number, place in reversed(list(enumerate(apart))):
        mixed[place:place] = wrong[number * in_row : (number + 1) * in_row]
    assert told_apart(mixed) == (frames, wrong)


@given(gaps=st.lists(st.tuples(st.integers(501, 200_000), st.integers(CONFIRM, 30)), max_size=8))
def test_a_gap_loses_nothing(gaps):
    times = list(range(0, 300, 10))
    for gap, count in gaps:
        times += [times[-1] + gap + 10 * i for i in range(count)]
    frames = stamped(times)
    assert told_apart(frames) == (frames, [])


def test_frames_of_two_channels_may_overtake_each_other():
    frames = stamped([t - 40 * (i % 3 == 2) for i, t in enumerate(range(0, 3000, 15))])
    assert told_apart(frames) == (frames, [])
    after = [(time + 9 * S, identifier, data, channel) for time, identifier, data, channel in frames]
    assert told_apart([*frames, *after]) == ([*frames, *after], [])
