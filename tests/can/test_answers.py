"""Answers out of frames: whole or nothing, whatever is lost, mixed or made up."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.can.codec import RANGE, Codec
from gz_onboard.can.requests import SEQUENCE, Assembler
from gz_onboard.events import Frame
from tests.events import Event, events_of
from tests.polled import STEADY, answer, carried, exchange, kona, request
from tests.support import EPOCH, MS

PAYLOADS = st.binary(min_size=1, max_size=200)
BATTERY = request("Battery")
VALUES = pytest.approx((20.0, 365.0, 20.0, 314.159), rel=1e-4)  # of the roles, as `STEADY` has them


class Taken:
    """What an assembler makes of frames a millisecond apart."""

    def __init__(self, frames: list[bytes], address: int | None = None, step: float = 0.001) -> None:
        self.faults: Counter[tuple[str, str]] = Counter()
        assembler = Assembler(address, "", self.faults)
        taken = (assembler.take(i * step, frame) for i, frame in enumerate(frames))
        self.answers = [one for one in taken if one is not None]


def decoded(frames: list[Frame]) -> tuple[Codec, list[Event]]:
    codec = Codec(kona().mapping)
    return codec, events_of(codec, frames)


@given(st.lists(PAYLOADS, max_size=5), st.sampled_from([None, 0xF1]))
def test_what_is_sent_whole_comes_whole(sent, address):
    taken = Taken([frame for one in sent for frame in carried(one, address)], address)
    assert taken.answers == sent
    assert not taken.faults


@given(PAYLOADS.filter(lambda p: len(p) > 7), st.data())
def test_a_frame_that_is_lost_repeated_or_late_leaves_no_answer(sent, data):
    frames = carried(sent)
    at = data.draw(st.integers(0, len(frames) - 1))
    lost = Taken([*carried(b"first"), *frames[:at], *frames[at + 1 :], *carried(b"last")])
    assert lost.answers == [b"first", b"last"]
    assert lost.faults.total() == 1  # INTERRUPTED where the last was lost
    if 0 < at < len(frames) - 1:
        twice = Taken([*frames[: at + 1], *frames[at:], *carried(b"last")])
        assert twice.answers == [b"last"]
        assert twice.faults == {("", SEQUENCE): 1}
    assert Taken([*frames, *carried(b"last")], step=1.1).answers == [b"last"]


@given(st.lists(PAYLOADS.filter(lambda p: len(p) > 7), min_size=2, max_size=2), st.randoms())
@settings(max_examples=200)
def test_of_answers_between_each_other_only_whole_ones_are_left(sent, random):
    left = [carried(one) for one in sent]
    mixed = []
    while any(left):
        mixed.append(random.choice([one for one in left if one]).pop(0))
    taken = Taken(mixed)
    assert all(one in sent for one in taken.answers)


def test_another_testers_answers_are_not_ours():
    assert Taken(carried(b"for another", 0xF4), 0xF1).answers == []


def test_the_answer_is_an_event_of_its_last_frame():
    codec, events = decoded(exchange(BATTERY, EPOCH, **STEADY))
    (event,) = events
    assert event[2] == VALUES
    assert event[0] == pytest.approx(0.018)  # the first frame after 10 ms, eight more
    assert not codec.faults
    assert not codec.unknown
    assert codec.values("Battery", codec.latest["Battery"][2])["BatteryVoltage"] == pytest.approx(365.0)


def test_all_ones_are_a_value_and_limits_are_checked():
    shown = request("BatteryShown")
    codec, events = decoded(answer(shown, EPOCH, BatteryCharge=100.0))
    assert events[0][2] == (1.0,)
    codec, events = decoded(answer(shown, EPOCH, BatteryCharge=127.5))
    assert events[0][2] == (None,)
    assert codec.faults == {("BatteryShown.BatteryCharge", RANGE): 1}


def test_a_gateway_that_repeats_the_answer_on_a_second_bus_does_no_harm():
    frames = exchange(BATTERY, EPOCH, **STEADY)
    both = sorted([*frames, *((time_ns + MS // 4, i, data, 1) for time_ns, i, data, _ in frames)])
    codec, events = decoded(both)
    assert [event[2] for event in events] == [VALUES]
    assert not codec.faults
    assert len(decoded([(t, i, data, 1) for t, i, data, _ in frames])[1]) == 1  # a log of that bus alone
