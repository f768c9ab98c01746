"""Some cases of every kind; ``make hardening`` runs many more."""

from dataclasses import replace

import pytest

from gz_onboard.events import State
from tests.hardening import liars
from tests.hardening.__main__ import KINDS


@pytest.mark.parametrize("name", KINDS)
def test_keeps_its_promises(name):
    kind = KINDS[name]
    report = kind.run(kind.COUNT, seed=1)
    assert report.rows
    assert not report.failures, "\n".join(report.failures)


@pytest.fixture(scope="module")
def unspoilt():
    return liars.ridden(None)


def between(rows, begin, end, change):
    return [replace(e, **change(e)) if begin <= e.time < end else e for e in rows]


def doubled(e):
    return {"range": 2 * e.range, "range_p10": 2 * e.range_p10, "range_p90": 2 * e.range_p90, "state": State.VALID}


def silent(e):
    return {"state": State.INVALID}


@pytest.mark.parametrize(
    ("made", "promise"),
    [
        (lambda rows: between(rows, 300, 361, doubled), "the interval fails for 61 s"),
        (lambda rows: between(rows, 732, 733, doubled), "the interval fails at the end"),
        (lambda rows: between(rows, 300, 301, doubled), "not named though it spoils the range"),
        (lambda rows: between(rows, 300, 301, lambda e: {"soc": e.soc + 4 * e.soc_sd}), "SOC off by 4.0 sd"),
        (lambda rows: between(rows, 300, 301, lambda e: {"distrusted": ("accel_x",)}), "accel_x accused"),
        (lambda rows: between(rows, 300, 361, silent), "no range for 61 s and nobody named"),
    ],
)
def test_a_lie_is_judged_at_every_second(unspoilt, made, promise):
    assert promise in liars.judged(made(unspoilt), unspoilt).broken(["gps_speed"])


@pytest.mark.parametrize(
    "made",
    [
        lambda rows: rows,
        lambda rows: between(rows, 60, 120, doubled),  # before the lie
        lambda rows: between(rows, 300, 360, lambda e: {**doubled(e), "distrusted": ("gps_speed",)}),
        lambda rows: between(rows, 300, 500, lambda e: {**silent(e), "distrusted": ("gps_speed",)}),
    ],
)
def test_what_is_promised_breaks_no_promise(unspoilt, made):
    assert liars.judged(made(unspoilt), unspoilt).broken(["gps_speed"]) == []
