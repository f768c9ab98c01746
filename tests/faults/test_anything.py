"""Everything at once, drawn by chance: never an exception, never a wrong number."""

from __future__ import annotations

import random
from collections.abc import Sequence

from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from gz_onboard.can.codec import DROPPING
from gz_onboard.events import Frame
from tests.support import check_sound, received, recorded, ridden, sealed

BYTE = st.integers(0, 255)
CORRUPTION = st.one_of(
    st.tuples(st.just("drop")),
    st.tuples(st.just("flip"), BYTE, BYTE),
    st.tuples(st.just("cut"), st.integers(0, 8)),
    st.tuples(st.just("data"), st.binary(max_size=64)),
    st.tuples(st.just("sealed"), st.binary(min_size=8, max_size=8)),
    st.tuples(st.just("identifier"), st.integers(0, 0xFFFF_FFFF)),
    st.tuples(st.just("twice")),
    st.tuples(st.just("stamp"), st.integers(-(10**11), 10**11)),
    st.tuples(st.just("far"), st.integers(-(2**62), 2**62)),
    st.tuples(st.just("shift"), st.integers(-(10**12), 10**12)),
)


@st.composite
def corruptions(draw: st.DrawFn) -> tuple[int, list[tuple[float, tuple[object, ...]]]]:
    """(a seed, [share of the frames, what is done to them])."""
    kinds = draw(st.lists(st.tuples(st.floats(1e-4, 0.6), CORRUPTION), min_size=1, max_size=5))
    return draw(st.integers(0, 2**32)), kinds


def corrupted(frames: Sequence[Frame], seed: int, kinds: Sequence[tuple[float, tuple[object, ...]]]) -> list[Frame]:
    rng = random.Random(seed)
    out: list[Frame] = []
    shift = 0
    for original in frames:
        frame: Frame | None = (original[0] + shift, *original[1:])
        for share, (kind, *arguments) in kinds:
            if frame is None or rng.random() >= (share if kind != "shift" else share / 1000):
                continue
            time_ns, can_id, data, channel = frame
            a: int = arguments[0] if arguments and isinstance(arguments[0], int) else 0
            if kind == "drop":
                frame = None
            elif kind == "flip" and data:
                at = a % len(data)
                frame = (
                    time_ns,
                    can_id,
                    data[:at] + bytes([data[at] ^ int(str(arguments[1]))]) + data[at + 1 :],
                    channel,
                )
            elif kind == "cut":
                frame = time_ns, can_id, data[:a], channel
            elif kind in ("data", "sealed") and isinstance(arguments[0], bytes):
                frame = time_ns, can_id, arguments[0] if kind == "data" else sealed(arguments[0]), channel
            elif kind == "identifier":
                frame = time_ns, a, data, channel
            elif kind == "twice":
                out.append(frame)
            elif kind == "stamp":
                frame = time_ns + a, can_id, data, channel
            elif kind == "far":
                frame = a, can_id, data, channel
            elif kind == "shift":
                shift += a
        if frame is not None:
            out.append(frame)
    return out


# Each was an exception once: a stamp far ahead before the first estimate; a road that climbed to where there is no air.
FAR_AHEAD = [(0.5, ("cut", 0)), (0.25, ("drop",)), (0.5, ("cut", 0)), (0.5, ("far", 0)), (0.5, ("drop",))]
CLIMB = [
    (0.1516552217479034, ("shift", 29533646151)),
    (0.5, ("sealed", b"R0%\xb3b\xcb\xfe\xae")),
    (0.24450555112371256, ("far", 1311428602)),
    (0.5, ("far", 441096517)),
]


@settings(max_examples=24, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(corruptions(), st.booleans())
@example((1, FAR_AHEAD), False)
@example((1556953994, CLIMB), False)
def test_whatever_is_on_the_bus(what: tuple[int, list[tuple[float, tuple[object, ...]]]], live: bool):
    frames = recorded("city_14C", 0.0, 25.0)
    spoilt_frames = corrupted(frames, *what)
    if live:
        step = (frames[-1][0] - frames[0][0]) // max(len(spoilt_frames), 1)
        run = received((frames[0][0] + i * step, frame) for i, frame in enumerate(spoilt_frames))
    else:
        run = ridden(spoilt_frames)
    check_sound(run)
    counts = run.pipeline.counts()
    assert run.pipeline.codec.received == len(spoilt_frames)
    assert counts.dropped == sum(n for (_, reason), n in run.faults.items() if reason in DROPPING)
    if live:
        assert len(run.estimates) >= 48  # whatever comes in, the status goes out
