"""Asking: what is sent and what never is, and what comes of answers, silence, refusal and other testers."""

from __future__ import annotations

import logging
from dataclasses import replace
from itertools import count

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.bus.requests import SERVICES, Polling, Request
from gz_onboard.daemon.poller import LISTEN, MOST_FLOW_CONTROLS, MOST_PENDING, PAUSE, QUIET, REFUSED_S, SILENT_S, Poller
from gz_onboard.events import EFF_FLAG
from tests.polled import STEADY, carried, payload, request

BATTERY, SHOWN = request("Battery"), request("BatteryShown")
ASKED = (b"\x03\x22\x01\x01" + b"\xcc" * 4, b"\x03\x22\x01\x05" + b"\xcc" * 4)
GO_ON = b"\x30\0\0" + b"\xcc" * 5
_NUMBERS = count()


class Bus:
    """A poller, what it sends, and a clock that the test keeps."""

    def __init__(self, *requests: Request, takes: bool = True, listened: bool = True) -> None:
        self.sent: list[tuple[int, bytes]] = []
        self.now = 100.0
        self.takes = takes
        self.poller = Poller(requests or (BATTERY,), Polling(), self._send)
        if listened:
            self.step()
            self.now += LISTEN

    def _send(self, identifier: int, data: bytes) -> bool:
        self.sent.append((identifier, data))
        return self.takes

    def step(self, *received: bytes, identifier: int = BATTERY.response, after: float = 0.0, channel: int = 0) -> None:
        self.now += after
        self.poller.step([(0, identifier, data, channel) for data in received], self.now)

    def asked(self, seconds: float, *received: bytes) -> int:
        """How often it asks in so many seconds, in which these frames come ten times a second."""
        before = len(self.sent)
        for _ in range(round(seconds * 10)):
            self.step(*received, after=0.1)
        return sum(data[0] >> 4 == 0 for _, data in self.sent[before:])

    @property
    def counts(self) -> dict[str, int]:
        return dict(self.poller.counts["Battery"])


def test_asks_once_and_goes_on_with_the_whole_answer():
    bus = Bus()
    bus.step()
    first, *others = carried(payload(BATTERY, **STEADY))
    bus.step(after=0.01)
    bus.step(first, after=0.01)
    bus.step(*others[:3], after=0.01)
    assert bus.poller.waiting(bus.now)
    bus.step(*others[3:], after=0.01)
    assert bus.sent == [(0x7E4, ASKED[0]), (0x7E4, GO_ON)]
    assert not bus.poller.waiting(bus.now)
    assert bus.counts == {"asked": 1, "answered": 1}
    bus.step(after=0.1)
    assert len(bus.sent) == 2  # at its period of 0.2 s
    bus.step(after=0.1)
    assert bus.sent[2:] == [(0x7E4, ASKED[0])]


def test_what_comes_unasked_is_no_answer_and_gets_no_flow_control():
    bus, frames = Bus(), carried(payload(BATTERY, **STEADY))
    bus.step()
    bus.step(*frames, after=0.01)
    before = len(bus.sent)
    bus.step(*frames, after=0.01)
    assert len(bus.sent) == before
    bus.step(after=0.2)
    bus.step(after=0.01)
    assert bus.counts == {"asked": 2, "answered": 1}


def test_a_flood_of_beginnings_gets_no_flood_of_flow_control():
    bus = Bus()
    bus.step()
    bus.step(*carried(payload(BATTERY, **STEADY))[:1] * 50, after=0.01)
    assert bus.sent == [(0x7E4, ASKED[0])] + [(0x7E4, GO_ON)] * MOST_FLOW_CONTROLS


def test_one_at_a_time_of_an_ecu_the_one_longest_due():
    bus = Bus(BATTERY, SHOWN)
    for _ in range(20):
        bus.step(after=0.01)
    assert [data for _, data in bus.sent] == [ASKED[0]]
    bus.step(*carried(payload(BATTERY, **STEADY)))
    assert [data for _, data in bus.sent if data != GO_ON] == [*ASKED]
    assert bus.poller.counts["BatteryShown"] == {"asked": 1}


def test_the_period_is_kept_in_the_mean_whatever_the_ticks():
    bus, answers = Bus(replace(BATTERY, period=0.25)), carried(payload(BATTERY, **STEADY))
    assert bus.asked(20.0, *answers) in (79, 80, 81)


def test_a_silent_ecu_is_left_alone_for_longer_and_longer(caplog):
    bus = Bus()
    assert bus.asked(10.0) <= 6
    assert bus.asked(600.0) <= 600 / SILENT_S + 6
    assert bus.counts["no answer"] >= 10
    assert [record.message for record in caplog.records] == ["0x7ec does not answer"]
    bus.asked(60.0, *carried(payload(BATTERY, **STEADY)))
    assert bus.asked(10.0, *carried(payload(BATTERY, **STEADY))) >= 45


def test_what_is_refused_is_hardly_asked_again(caplog):
    bus = Bus()
    refused = carried(b"\x7f\x22\x31")
    assert bus.asked(REFUSED_S - 1, *refused) == 1
    assert bus.asked(3.0, *refused) == 1
    assert bus.counts == {"asked": 2, "refused 0x31": 2}
    assert caplog.text.count("request out of range, 0x31") == 1


def test_busy_is_asked_after_twice_the_time_each_time():
    bus = Bus()
    assert 6 <= bus.asked(60.0, *carried(b"\x7f\x22\x21")) <= 10
    bus.asked(120.0, *carried(payload(BATTERY, **STEADY)))
    assert bus.asked(10.0, *carried(payload(BATTERY, **STEADY))) >= 45


def test_an_announced_answer_is_waited_for_but_not_for_ever():
    bus = Bus()
    bus.step()
    pending = carried(b"\x7f\x22\x78")
    for _ in range(3):
        bus.step(*pending, after=4.0)
    bus.step(*carried(payload(BATTERY, **STEADY)), after=4.0)
    assert bus.counts["answered"] == 1
    bus.step(after=0.2)
    for _ in range(MOST_PENDING + 3):
        bus.step(*pending, after=4.0)
    assert bus.counts["no answer"] == 1


def test_another_tester_has_the_ecu_for_himself(caplog):
    for identifier in (0x7E4, 0x7DF, 0x18DB33F1 | EFF_FLAG):
        caplog.clear()
        bus = Bus()
        bus.step()
        bus.step(b"\x02\x3e\x80", identifier=identifier, after=0.01)
        first, *_ = carried(payload(BATTERY, **STEADY))
        bus.step(first, after=0.01)
        assert len(bus.sent) == 1  # no flow control either
        assert bus.asked(QUIET - 2.0, first) == 0
        bus.step(b"\x02\x3e\x80", identifier=identifier)
        assert bus.asked(QUIET - 2.0) == 0
        assert bus.asked(5.0) >= 1
        assert caplog.text.count("someone else asks on") == 1
        bus.step(b"\x02\x3e\x80", identifier=identifier)
        assert caplog.text.count("someone else asks on") == 2


def test_whoever_is_there_before_is_not_disturbed():
    """Another tester, or a vehicle that has the identifier for something else."""
    bus = Bus(listened=False)
    bus.step()
    bus.step(after=0.5 * LISTEN)
    bus.step(bytes(8), identifier=0x7E4)
    assert bus.asked(QUIET - 1.0) == 0
    assert bus.sent == []


def test_a_tester_on_another_bus_is_none():
    bus = Bus()
    bus.step(b"\x02\x3e\x80", identifier=0x7E4, channel=1)
    assert len(bus.sent) == 1
    assert bus.asked(2.0) == 1


def test_a_bus_that_takes_nothing_is_tried_again_at_the_period():
    bus = Bus(takes=False)
    assert 4 <= bus.asked(1.0) <= 6
    assert set(bus.counts) == {"not sent"}


def test_a_lost_frame_ends_the_answer_and_it_is_asked_again(caplog):
    bus = Bus()
    bus.step()
    frames = carried(payload(BATTERY, **STEADY))
    bus.step(*frames[:4], *frames[5:], after=0.01)
    assert bus.counts == {"asked": 1, "answer broken": 1}
    bus.step(after=PAUSE - 0.1)
    assert len(bus.sent) == 2  # request and flow control
    bus.step(after=0.2)
    assert bus.sent[2:] == [(0x7E4, ASKED[0])]


def test_a_longer_answer_than_the_file_says_is_told_once(caplog):
    bus = Bus(BATTERY)
    bus.step()
    bus.step(*carried(payload(BATTERY, **STEADY)[:-1]), after=0.01)
    assert bus.counts["wrong length"] == 1
    assert "Battery: the answer has 58 bytes, the file says 59" in caplog.text
    bus.asked(3.0, *carried(payload(BATTERY, **STEADY) + b"\0"))
    assert bus.counts["answer broken"] >= 1  # the transport takes no more than there may be
    assert "answered" not in bus.counts


ANY = st.one_of(
    st.binary(max_size=8),
    st.sampled_from([*carried(payload(BATTERY, **STEADY)), *carried(b"\x7f\x22\x78"), *carried(b"\x7f\x22\x31")]),
    st.binary(min_size=7, max_size=7).map(lambda data: b"\x10" + data),
)


@given(st.lists(st.tuples(st.floats(0, 1), st.lists(ANY, max_size=5)), max_size=40))
@settings(max_examples=60, deadline=None)
def test_whatever_comes_nothing_is_sent_but_what_is_listed(rounds):
    bus = Bus(BATTERY, SHOWN)
    logging.disable()
    try:
        for after, frames in rounds:
            bus.step(*frames, after=after)
    finally:
        logging.disable(logging.NOTSET)
    asked = [data for _, data in bus.sent if data in ASKED]
    controls = [data for _, data in bus.sent if data[0] >> 4 == 3]
    assert {identifier for identifier, _ in bus.sent} <= {0x7E4}
    assert len(asked) + len(controls) == len(bus.sent)
    assert len(controls) <= MOST_FLOW_CONTROLS * len(asked)
    assert sum(of["asked"] for of in bus.poller.counts.values()) == len(asked)


def test_no_other_service_can_be_sent():
    """Not even by a request that no vehicle file can make."""
    for service in {*range(0xC0)} - {*SERVICES}:
        bus = Bus(replace(BATTERY, service=service))
        assert bus.asked(2.0) == 0
        assert bus.sent == []


@pytest.mark.parametrize("addresses", [None, (0x07, 0xF1)])
@pytest.mark.parametrize("flag", [0, EFF_FLAG])
def test_identifiers_of_29_bits_and_addresses_in_the_first_byte(addresses, flag):
    own = replace(BATTERY, request=0x6F1 | flag, response=0x607 | flag, addresses=addresses)
    bus = Bus(own)
    bus.step()
    before, answered = (b"", None) if addresses is None else (b"\x07", 0xF1)
    bus.step(*carried(payload(own, **STEADY), answered), identifier=0x607 | flag, after=0.01)
    pad = b"\xcc" * 8
    assert bus.sent == [
        (0x6F1 | flag, (before + b"\x03\x22\x01\x01" + pad)[:8]),
        (0x6F1 | flag, (before + b"\x30\0\0" + pad)[:8]),
    ]
    assert bus.counts["answered"] == 1
