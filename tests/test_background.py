"""Calls on a thread of their own: in order, bounded, and whatever they raise."""

from __future__ import annotations

import logging
import threading

import pytest

from gz_onboard.background import Background


def test_calls_are_made_in_their_order_and_elsewhere():
    made: list[object] = []
    background = Background("test", limit=1000)
    for number in range(100):
        assert background.call(lambda n: made.append((n, threading.current_thread().name)), number)
    assert background.close(30)
    assert made == [(number, "test") for number in range(100)]


def test_what_a_call_raises_is_told_and_the_next_is_made(caplog: pytest.LogCaptureFixture):
    caplog.set_level(logging.ERROR)
    made: list[int] = []
    background = Background("test", limit=10)
    background.call(divmod, 1, 0)
    background.call(made.append, 1)
    assert background.close(30)
    assert made == [1]
    assert "ZeroDivisionError" in caplog.text


def test_closing_does_not_wait_for_ever():
    going = threading.Event()
    background = Background("test")
    background.call(going.wait, 30)
    assert not background.close(0.05)
    going.set()
    assert background.close(30)
