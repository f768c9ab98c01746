"""Everything at once, drawn by chance: never an exception, never a wrong number."""

from __future__ import annotations

import random
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from gz_onboard.can.codec import DROPPING
from gz_onboard.events import Frame
from gz_onboard.vehicle import OWN, Vehicle, read_vehicle
from tests.faults.support import check_all, shortened, spoilt
from tests.support import ROOT, changed, check_sound, identifier, received, recorded, reference, ridden, sealed

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


@cache
def without_limits() -> Vehicle:
    """The reference scooter, if its DBC files gave no limits, as those of most vehicles do."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        for file in ("vehicle.dbc", "hbm.dbc"):
            text = (ROOT / "dbc" / file).read_text()
            (folder / file).write_text(re.sub(r"\[[-\d.e+]+\|[-\d.e+]+\]", "[0|0]", text))
        (folder / "v.toml").write_text((OWN / "reference.toml").read_text())
        return read_vehicle(str(folder / "v.toml"))


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.integers(0, 2**32), st.floats(0.0, 0.5), st.floats(0.0, 1.0))
def test_any_values_in_sound_frames(seed: int, share: float, extreme: float):
    """Checksum, counter and length are right; the signals hold anything, extremes among it, once or for a while."""
    rng = random.Random(seed)
    stuck: dict[int, dict[str, int]] = {}

    def anything(can_id: int) -> dict[str, int]:
        definition = reference().mapping.database.get_message_by_frame_id(can_id)
        protection = reference().mapping.protection.get(definition.name)
        own = {protection.crc, protection.counter} if protection else set()
        raw = {}
        for signal in definition.signals:
            if signal.name in own or rng.random() < 0.5:
                continue
            low, high = (
                (-(1 << signal.length - 1), (1 << signal.length - 1) - 1)
                if signal.is_signed
                else (0, (1 << signal.length) - 1)
            )
            raw[signal.name] = (
                rng.choice((low, low + 1, high - 1, high, 0)) if rng.random() < extreme else rng.randint(low, high)
            )
        return raw

    frames = []
    for frame in recorded("city_14C", 0.0, 25.0):
        if rng.random() < 0.02:
            stuck.pop(frame[1], None)
        if rng.random() < share:
            stuck[frame[1]] = anything(frame[1]) if rng.random() < 0.5 else {}
        frames.append(changed(frame, **stuck[frame[1]]) if stuck.get(frame[1]) else frame)
    run = ridden(frames, without_limits())
    check_sound(run)
    assert run.pipeline.codec.received == len(frames)


@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.integers(0, 2**32), st.floats(0.0, 0.3))
def test_random_frames_among_the_good_ones_change_nothing_much(seed: int, share: float):
    """Corruption that a checksum, a counter, a length or a physical range can see: the estimate stays."""
    rng = random.Random(seed)
    protected = {identifier("BMS_Pack"), identifier("INV_Motion")}

    def spoil(frame: Frame) -> Frame | None:
        if rng.random() >= share:
            return frame
        if frame[1] in protected:
            at = rng.randrange(8)
            damaged = frame[2][:at] + bytes([frame[2][at] ^ (1 << rng.randrange(8))]) + frame[2][at + 1 :]
            return frame[0], frame[1], damaged, frame[3]
        return shortened(frame) if rng.random() < 0.5 else None

    run = ridden(spoilt(spoil))
    check_all(run, soc=0.003, range_=0.03 if share <= 0.25 else 0.035)  # a quarter of all frames is gone by then
