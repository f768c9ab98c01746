"""The ride that the other tests spoil: it is sound itself, fed as an offline estimate and as the daemon does it."""

from __future__ import annotations

from itertools import pairwise

import pytest

from gz_onboard.events import WINDOW, Reason, State
from tests.faults.support import RIDE, USUAL, check_all, check_no_jump, ride, unspoilt
from tests.support import check_sound, reasons_in, received


def test_the_ride_itself_is_sound():
    run = unspoilt()
    check_sound(run)
    check_no_jump(run)
    after = run.between(5.0, RIDE)
    assert {e.state for e in after} == {State.VALID}
    assert reasons_in(after) & ~USUAL == Reason(0)
    assert run.pipeline.counts().dropped == 0
    assert all(b.time - a.time == pytest.approx(WINDOW, abs=1e-6) for a, b in pairwise(run.estimates))


def test_in_rounds_like_the_daemon_it_is_the_same():
    live = received((frame[0], frame) for frame in ride())
    check_all(live)
    for a, b in zip(live.estimates, unspoilt().estimates, strict=False):
        assert a == b
