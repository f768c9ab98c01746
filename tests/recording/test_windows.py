"""A log gives the estimator the windows of the daemon, and counts the same by the end of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from operator import itemgetter
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gz_onboard.can.mapping import BusMapping, read_mapping
from gz_onboard.events import TRANSMITTED, Frame, MessageWindow, Reason
from gz_onboard.log_rows import STATUS_TOPIC
from gz_onboard.pipeline import TICK_NS
from gz_onboard.recording.decode import feed
from gz_onboard.recording.frames import FrameColumns
from gz_onboard.toml import Table
from tests.polled import STEADY, exchange, kona, request
from tests.recording.test_decode import buses, recordings
from tests.support import EPOCH, MS, Run, S, Scooter, range_database, reference

PAUSE = 30 * S
NOISE = 0x7FF
COUNTED = ("received", "faults", "lost", "unknown", "unknown_others", "copies", "error_frames")
Windows = list[list[MessageWindow]]


class Stepped(Run):
    """A run that keeps the windows that its estimator was given."""

    def __init__(self, mapping: BusMapping) -> None:
        super().__init__(replace(reference(), mapping=mapping))
        self.windows: Windows = []
        step = self.pipeline.estimator.step

        def kept(windows: Sequence[MessageWindow]) -> None:
            self.windows.append(sorted(windows))
            step(windows)

        self.pipeline.estimator.step = kept  # type: ignore[method-assign]


def in_order(frames: list[Frame]) -> list[Frame]:
    return sorted(frames, key=itemgetter(0))


def daemon(mapping: BusMapping, frames: Sequence[tuple[int, Frame]]) -> Stepped:
    """The frames as the daemon takes them, each with its time of arrival; it sleeps through pauses."""
    run, due, waiting = Stepped(mapping), frames[0][0], list[Frame]()
    before = due
    for arrival, frame in frames:
        if arrival - before > PAUSE:
            run.pipeline.advance(in_order(waiting), before)
            waiting, due = [], arrival + (due - arrival) % TICK_NS
        while arrival >= due:
            run.pipeline.advance(in_order(waiting), due)
            waiting, due = [], due + TICK_NS
        before = arrival
        waiting.append(frame)
    run.pipeline.advance(in_order(waiting), before)
    return run


def assert_alike(mapping: BusMapping, frames: Sequence[tuple[int, Frame]]) -> Stepped:
    """Take the frames both ways; return the run of the log."""
    live, log = daemon(mapping, frames), Stepped(mapping)
    feed(log.pipeline, FrameColumns.of([frame for _, frame in frames]))
    assert len(log.windows) == len(live.windows)
    near = partial(pytest.approx, rel=1e-9, abs=1e-4)  # sums of floating-point values depend on their order
    for found, expected in zip(log.windows, live.windows, strict=True):
        assert [window[:3] for window in found] == [window[:3] for window in expected]
        for one, other in zip(found, expected, strict=True):
            for role, same in zip(one.roles, other.roles, strict=True):
                assert (role and role[:3]) == (same and same[:3])
                if role and same:
                    assert [x or 0.0 for x in role[3:]] == near([x or 0.0 for x in same[3:]])
    assert [(e.time, e.state, e.reasons) for e in log.estimates] == [
        (e.time, e.state, e.reasons) for e in live.estimates
    ]
    counted = [
        [[values[k] for k in COUNTED] for topic, _, values in run.samples if topic == STATUS_TOPIC]
        for run in (log, live)
    ]
    assert counted[0] == counted[1]
    signals = [[sample for sample in run.samples if sample[0].startswith("/can/")] for run in (log, live)]
    assert sorted(signals[0], key=str) == sorted(signals[1], key=str)
    status = range_database().get_message_by_name("RANGE_Status").frame_id  # not while the daemon sleeps
    sent = [[frame for frame in run.sent if frame[1] != status] for run in (log, live)]
    assert [frame[:2] for frame in sent[0]] == [frame[:2] for frame in sent[1]]
    diagnoses = [[frame for frame in frames if frame[1] == status + 2] for frames in sent]
    assert diagnoses[0] == diagnoses[1]
    received = [sorted(frame for frame in run.logged if not frame[3] & TRANSMITTED) for run in (log, live)]
    assert received[0] == received[1]
    live.pipeline.codec.windows()  # counts the frames of the last window, which has not ended
    for name in COUNTED:
        assert getattr(log.pipeline.codec, name) == getattr(live.pipeline.codec, name), name
    return log


@st.composite
def arrivals(draw: st.DrawFn, lengths: list[int]) -> list[tuple[int, Frame]]:
    """Frames with their times of arrival: mostly their stamps, with gaps, pauses and stamps of the past."""
    frames = [(0, NOISE, b"", 0), *(frame for frame in draw(recordings(lengths)) if frame[1] != NOISE)]
    steps = st.one_of(st.integers(0, 100 * MS), st.integers(0, S), st.integers(0, PAUSE), st.just(TICK_NS))
    long_ago = st.sampled_from([0] * 20 + [11 * S, 3600 * S])
    arrival, found = EPOCH, list[tuple[int, Frame]]()
    begun = EPOCH  # of what follows a pause: a grid begins with a right stamp
    for number, (_, identifier, data, channel) in enumerate(frames):
        if draw(st.integers(0, 30)) == 0:  # what follows a pause is believed when three frames agree
            arrival = begun = arrival + PAUSE + draw(st.integers(1, 100 * S))
            found += [(arrival, (arrival, NOISE, b"", 0))] * 3
        if arrival > begun + S and (ago := draw(long_ago)):
            found.append((arrival, (arrival - ago - 100 * number * S, NOISE, b"", 0)))
            found.append((arrival, (arrival, NOISE, b"", 0)))
        found.append((arrival, (arrival, identifier, data, channel)))
        arrival += draw(steps)
    return found + [(arrival, (arrival, NOISE, b"", 0))] * 3  # no gap stands at the end


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("any")


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(bus=buses(), data=st.data())
def test_any_frames_of_any_layout(folder: Path, bus: tuple[str, str, list[int]], data: st.DataObject) -> None:
    dbc, vehicle, lengths = bus
    (folder / "v.dbc").write_text(dbc)
    (folder / "v.toml").write_text(vehicle)
    assert_alike(read_mapping(Table.read(folder / "v.toml")), data.draw(arrivals(lengths)))


def arriving(frames: Sequence[Frame]) -> list[tuple[int, Frame]]:
    return [(frame[0], frame) for frame in frames]


def test_answers_to_requests_of_another_tester() -> None:
    frames = [frame for i in range(30) for frame in exchange(request("Battery"), EPOCH + i * S, **STEADY)]
    assert any(assert_alike(kona().mapping, arriving(frames)).windows)


def test_frames_that_are_dropped_and_lost_are_told_in_the_second_in_which_they_were() -> None:
    frames = Scooter().steady(5.0)
    frames = [f for f in frames if not EPOCH + 2 * S <= f[0] < EPOCH + 2.03 * S]
    cut = next(i for i, frame in enumerate(frames) if frame[0] >= EPOCH + 3.5 * S)
    frames[cut] = (*frames[cut][:2], b"", 0)
    run = assert_alike(reference().mapping, arriving(frames))
    told = [e.time for e in run.estimates if e.reasons & (Reason.FRAMES_LOST | Reason.FRAMES_DROPPED)]
    assert told == pytest.approx([2.1, 2.6, 3.1, 3.6, 4.1, 4.6])
