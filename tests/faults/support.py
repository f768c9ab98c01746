"""A recorded ride, spoilt for a while, and what holds all the same.

Each test spoils it from 40 to 80 s and holds what comes of it against the same ride unspoilt: before and during the
fault the numbers stay, the fault is counted and named, and after it everything is as it was.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import pairwise

from gz_onboard.events import Estimate, Frame, Reason, State
from tests.support import Run, S, changed, check_sound, identifier, not_available, recorded, ridden

BEGIN, END = 40.0, 80.0  # s: when things go wrong
RIDE = 110.0  # s
USUAL = Reason.PRIOR_RIDING | Reason.FRAMES_LOST  # of this ride as it was recorded, some counters of which jump

Spoil = Callable[[Frame], Frame | None]


def ride() -> tuple[Frame, ...]:
    return recorded("city_14C", 270.0, 270.0 + RIDE)


@cache
def unspoilt() -> Run:
    return ridden(ride())


def spoilt(spoil: Spoil, begin: float = BEGIN, end: float = END) -> list[Frame]:
    """The ride with `spoil` applied to its frames from `begin` to `end` [s]; None takes a frame away."""
    first = ride()[0][0]
    low, high = first + round(begin * S), first + round(end * S)
    out = []
    for frame in ride():
        kept = spoil(frame) if low <= frame[0] < high else frame
        if kept is not None:
            out.append(kept)
    return out


def of(name: str, spoil: Spoil) -> Spoil:
    """`spoil`, of one message only."""
    wanted = identifier(name)
    return lambda frame: spoil(frame) if frame[1] == wanted else frame


def without(*names: str) -> Spoil:
    """The messages do not come."""
    gone = {identifier(name) for name in names}
    return lambda frame: None if frame[1] in gone else frame


def absent(name: str, *signals: str) -> Spoil:
    """The message comes, and says that it does not have the signals."""
    codes = {signal: not_available(signal) for signal in signals}
    return of(name, lambda frame: changed(frame, **codes))


def both(*spoils: Spoil) -> Spoil:
    def spoil(frame: Frame) -> Frame | None:
        kept: Frame | None = frame
        for one in spoils:
            kept = one(kept) if kept is not None else None
        return kept

    return spoil


def shortened(frame: Frame) -> Frame:
    return frame[0], frame[1], frame[2][:-1], frame[3]


def numbers(estimate: Estimate) -> tuple[float, float, float, float, float]:
    """(SOC, its sd, range, P10, P90); all of them must be known."""
    e = estimate
    values = e.soc, e.soc_sd, e.range, e.range_p10, e.range_p90
    assert None not in values, f"at {e.time:.1f} s not all is known: {e}"
    return values  # type: ignore[return-value]


def check_like_unspoilt(run: Run, soc: float, range_: float, begin: float = 5.0) -> None:
    """No number is wrong: never further from the unspoilt ride than stated, and far within what is said of it.

    soc: absolute; range_: relative. Beside these, the SOC must be within one of its own standard deviations.
    """
    expected = {round(10 * e.time): e for e in unspoilt().estimates}
    compared = 0
    for e in run.estimates:
        true = expected.get(round(10 * e.time))
        if e.time < begin or true is None or e.state is State.INVALID:
            continue
        compared += 1
        s, sd, r, p10, p90 = numbers(e)
        true_soc, _, true_range, _, _ = numbers(true)
        assert abs(s - true_soc) <= min(soc, sd), f"SOC {s:.4f}, unspoilt {true_soc:.4f}, at {e.time:.1f} s"
        assert abs(r / true_range - 1) <= range_, f"range {r:.0f} m, unspoilt {true_range:.0f} m, at {e.time:.1f} s"
        assert p10 <= true_range <= p90
    assert compared > 0.5 * len(unspoilt().estimates)


def check_no_jump(run: Run, range_: float = 0.04, soc: float = 0.005, begin: float = 5.0) -> None:
    """From one estimate to the next nothing that is published jumps."""
    known = [e for e in run.estimates if e.time >= begin and e.range is not None]
    for a, b in pairwise(known):
        assert abs(numbers(b)[0] - numbers(a)[0]) <= soc, f"SOC jumps at {b.time:.1f} s"
        assert abs(numbers(b)[2] / numbers(a)[2] - 1) <= range_, f"the range jumps at {b.time:.1f} s"


def check_timeline(run: Run) -> None:
    assert all(b.time > a.time for a, b in pairwise(run.estimates))


def check_all(run: Run, soc: float = 0.002, range_: float = 0.01) -> None:
    check_sound(run)
    check_timeline(run)
    check_no_jump(run)
    check_like_unspoilt(run, soc, range_)
    end = run.at(RIDE)
    assert end.state is State.VALID
    assert end.reasons & ~USUAL == Reason(0)
