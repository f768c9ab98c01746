"""Time stamps that are wrong, clocks that are set, gaps, silence."""

from __future__ import annotations

import pytest

from gz_onboard.can.codec import TIME
from gz_onboard.events import Frame, Reason, State
from gz_onboard.pipeline import TICK_NS
from tests.faults.support import (
    BEGIN,
    RIDE,
    USUAL,
    check_all,
    check_no_jump,
    check_timeline,
    numbers,
    ride,
    spoilt,
    unspoilt,
)
from tests.support import Run, S, check_frames, check_sound, reasons_in, received, ridden


@pytest.mark.parametrize("step", [-86400.0, -3600.0, -30.0, -1.0])
def test_the_clock_is_set_back(step: float):
    first = ride()[0][0]
    frames = [f if f[0] - first < BEGIN * S else (f[0] + round(step * S), *f[1:]) for f in ride()]
    run = ridden(frames)
    check_all(run, range_=0.015)  # the window in which the clock is set is longer
    assert run.faults == {("", TIME): 2}
    assert run.estimates[-1].time == pytest.approx(RIDE, abs=0.5)
    assert run.at(RIDE).distance == pytest.approx(unspoilt().at(RIDE).distance, abs=6.0)  # half a window


@pytest.mark.parametrize("step", [40.0, 3600.0, 86400.0 * 365])
def test_the_clock_is_set_ahead(step: float):
    """The odometer goes on and the vehicle moves before and after it: nothing was missed."""
    first = ride()[0][0]
    frames = [f if f[0] - first < BEGIN * S else (f[0] + round(step * S), *f[1:]) for f in ride()]
    run = ridden(frames)
    check_sound(run)
    check_timeline(run)
    assert run.faults.get(("", TIME), 0) <= 2
    end, true = run.estimates[-1], unspoilt().at(RIDE)
    assert end.reasons & ~USUAL & ~Reason.SOC_UNCERTAIN == Reason(0)
    assert end.distance == pytest.approx(true.distance, abs=20.0)
    assert end.soc_sd == pytest.approx(true.soc_sd, rel=0.01)
    assert numbers(end)[0] == pytest.approx(numbers(true)[0], abs=0.001)


@pytest.mark.parametrize("step", [-86400.0, -30.0, 0.7, 3600.0])
def test_the_clock_is_set_under_the_daemon(step: float):
    """As the daemon does it: it sees its own clock jump and says so."""
    run = Run()
    first = ride()[0][0]
    waiting: list[Frame] = []
    due, set_already = first, False
    for frame in ride():
        shift = round(step * S) if set_already else 0
        while frame[0] >= due:
            run.pipeline.advance(waiting, due + shift)
            waiting = []
            due += TICK_NS
            if not set_already and due - first >= BEGIN * S:
                set_already = True
                shift = round(step * S)
                run.pipeline.clock_set(shift)
        waiting.append((frame[0] + shift, *frame[1:]))
    check_all(run)
    assert run.faults == {}
    assert len(run.estimates) == pytest.approx(len(unspoilt().estimates), abs=2)
    stamps = [frame[0] for frame in run.sent]
    assert stamps[-1] - first == pytest.approx((RIDE + step) * S, abs=0.3 * S)  # on the new clock


@pytest.mark.parametrize("seconds", [0.5, 3.0, 20.0])
@pytest.mark.parametrize("live", [False, True])
def test_a_gap(seconds: float, live: bool):
    frames = spoilt(lambda _: None, BEGIN, BEGIN + seconds)
    run = received((f[0], f) for f in frames) if live else ridden(frames)
    check_sound(run)
    check_timeline(run)
    check_no_jump(run)
    silent = run.between(BEGIN + 2.3, BEGIN + seconds)
    lost = Reason.NO_PACK_VOLTAGE | Reason.NO_PACK_CURRENT | Reason.NO_SPEED | Reason.NO_IMU
    assert bool(silent) == (seconds > 2.3)
    if seconds < 1:  # only what comes a hundred times a second is missed so soon, and for no longer
        assert reasons_in(run.between(BEGIN, BEGIN + 2.3)) & lost == Reason.NO_IMU
        assert {e.state for e in run.between(BEGIN + seconds + 0.15, BEGIN + 2.3)} == {State.VALID}
    assert all(e.reasons & lost == lost for e in silent)
    assert all(e.state is State.INVALID and e.speed is None and e.pack_current is None for e in silent)
    if seconds == 20.0 and live:
        assert len(silent) > 30  # a silent bus is told at each window
    status = check_frames(run.sent)["RANGE_Status"]
    invalid = [row for row in status if row["RANGE_StatusState"] == State.INVALID]
    assert all(row["RANGE_StateOfCharge"] > 100 for row in invalid)  # the code for not available
    # What flowed meanwhile is not known: the estimate may differ by that, and says so.
    end, true = numbers(run.at(RIDE)), numbers(unspoilt().at(RIDE))
    assert abs(end[0] - true[0]) <= end[1]
    if seconds == 20.0:
        assert end[1] > 0.97 * true[1]  # no surer, but for where each stopped at what hysteresis allows
    assert run.at(RIDE).state is State.VALID
