"""Every recorded ride through the whole pipeline, against its golden results."""

from __future__ import annotations

import itertools
from dataclasses import fields

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.events import Estimate
from gz_onboard.log_rows import estimate_row
from gz_onboard.pipeline import Pipeline
from gz_onboard.recording.logs import read_log
from gz_onboard.vehicle import read_vehicle
from tests.replay import golden, regenerate

LOGS = golden.logs()
SHORTEST = min(LOGS, key=lambda log: log.stat().st_size)


def test_there_are_rides_and_each_has_a_golden_file():
    assert len(LOGS) >= 3
    assert {golden.golden_file(log) for log in LOGS} == set(golden.GOLDEN.glob("*.csv"))


def test_every_field_of_an_estimate_has_a_tolerance():
    assert set(golden.TOLERANCE) == {field.name for field in fields(Estimate)}


@pytest.mark.parametrize("log", LOGS, ids=lambda log: log.stem)
def test_golden(log):
    before, now = golden.read(golden.golden_file(log)), golden.run(log)
    found = golden.differences(before, now, golden.TOLERANCE)
    if found:
        pytest.fail(
            f"{log.stem} is not what it was. If the change is wanted: python -m tests.replay.regenerate\n"
            + golden.told(found, len(now)),
            pytrace=False,
        )


def test_both_filters_agree_over_a_whole_ride():
    frames = read_log(SHORTEST)
    scalar, filterpy = golden.estimates(frames), golden.estimates(frames, "filterpy")
    assert len(scalar) == len(filterpy) > 100
    for ours, reference in zip(scalar, filterpy, strict=True):
        row, expected = estimate_row(ours), estimate_row(reference)
        for name, value in expected.items():
            if isinstance(value, float) and value:
                assert row[name] == pytest.approx(value, rel=1e-9, abs=1e-9), f"{name} at {ours.time}"
            else:
                assert row[name] == value, f"{name} at {ours.time}"


def test_the_portions_in_which_frames_arrive_do_not_matter():
    whole = read_log(SHORTEST)[:8000].tuples()

    def estimates(cuts):
        made: list[Estimate] = []
        pipeline = Pipeline(read_vehicle("reference"), observer=made.append)
        for begin, end in itertools.pairwise(sorted({*range(0, len(whole) + 1, 500), *cuts})):
            pipeline.advance(whole[begin:end], whole[end - 1][0])
        return made

    expected = estimates([])

    @settings(max_examples=8, deadline=None)
    @given(cuts=st.sets(st.integers(1, len(whole) - 1), max_size=300))
    def check(cuts):
        assert estimates(cuts) == expected

    assert len(expected) > 20
    check()


# --- the tools themselves -----------------------------------------------------------------------------------------


def test_regenerate_writes_what_then_agrees_and_tells_what_moved(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(golden, "GOLDEN", tmp_path)
    monkeypatch.setattr(golden, "logs", lambda: [SHORTEST])
    assert regenerate.main([]) == 1  # nothing there before
    assert regenerate.main(["--check"]) == 0
    file = golden.golden_file(SHORTEST)
    rows = [dict(each) for each in golden.read(file)]
    rows[2]["soc"] = "0.123"
    golden.write(file, rows)
    capsys.readouterr()
    assert regenerate.main(["--check"]) == 1
    assert "0.123 before" in capsys.readouterr().out
    assert golden.read(file)[2]["soc"] == "0.123"  # --check writes nothing
