"""The charts of a ride show the estimates, nothing through a hole, and the usual gauge as its rule says."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import gz_onboard as gz
from gz_onboard.events import words
from gz_onboard.reports.charts import (
    GAUGE_FROM_M,
    EstimateColumns,
    overview,
    path_map,
    range_over_distance,
    usual_gauge,
)
from tests.support import LOGS


@pytest.fixture(scope="module")
def rows() -> list[dict[str, Any]]:
    return [dict(row) for row in gz.estimate(LOGS / "coastdown.blf").estimates.rows]


def lines(figure: Any) -> dict[str, Any]:
    return {line.get_label(): line for axis in figure.axes for line in axis.get_lines()}


def test_the_panels_show_the_estimates(rows):
    figure = overview(rows, "title", "about")
    for label, name, factor in (
        ("range", "range", 1e-3),
        ("state of charge", "soc", 100),
        ("pack current", "pack_current", 1),
        ("speed", "speed", 3.6),
    ):
        expected = np.array([row[name] for row in rows], dtype=float) * factor
        np.testing.assert_allclose(lines(figure)[label].get_ydata(), expected)
    states = figure.axes[7]
    named = [label.get_text() for label in states.get_yticklabels()]
    assert named[0] == "state"
    assert set(named[1:]) == {words(name) for row in rows for name in row["reasons"].split()}


def test_no_line_is_drawn_through_a_hole():
    row = {"state": "VALID", "reasons": "", "soc": 0.5, "soc_sd": 0.1, "speed": 10.0, "range": 1.0}
    rows = [{"time": float(t), "distance": 10.0 * t, **row} for t in (*range(10), *range(20, 30))]
    figure = overview(rows)
    y = lines(figure)["speed"].get_ydata()
    assert np.flatnonzero(np.isnan(y)).tolist() == [10]
    bars: Any = figure.axes[7].collections[0].get_paths()
    assert [(b.vertices[:, 0].min(), b.vertices[:, 0].max()) for b in bars] == [(0, 9), (20, 29)]


def test_an_estimate_of_nothing_known_can_be_drawn():
    row = {"time": 0.1, "distance": 0.0, "range": None, "state": "STARTING", "reasons": "NO_IMU NO_GPS"}
    for figure in (overview([row]), range_over_distance([row])):
        figure.savefig(io.BytesIO(), format="png", dpi=30)


@given(st.floats(5, 30), st.floats(20, 200), st.floats(1e5, 1e7), st.integers(2, 400))
def test_the_usual_gauge_of_steady_riding_is_energy_over_consumption(speed, consumption, left, seconds):
    steady = {"pack_voltage": 50.0, "pack_current": speed * consumption / 50.0, "energy_left": left}
    columns = EstimateColumns([{"time": float(t), "distance": t * speed, **steady} for t in range(seconds)])
    shown = usual_gauge(columns)
    known = columns.distance >= GAUGE_FROM_M
    np.testing.assert_allclose(shown[known], left / consumption)
    assert np.isnan(shown[~known]).all()


def test_a_charge_is_not_recovered_energy():
    riding = {"pack_voltage": 50.0, "pack_current": 16.0, "energy_left": 8e6, "activity": "RIDING"}
    charging = riding | {"pack_current": -10.0, "activity": "CHARGING"}
    rows = [{"time": float(t), "distance": 10.0 * t, **riding} for t in range(900)]
    rows += [{"time": float(t), "distance": 8990.0, **charging} for t in range(900, 4500)]
    rows += [{"time": float(t), "distance": 8990.0 + 10.0 * (t - 4499), **riding} for t in range(4500, 4700)]
    shown = usual_gauge(EstimateColumns(rows))
    assert shown[[899, 4499, -1]] == pytest.approx(100_000, rel=2e-3)


def test_a_map_keeps_its_shape():
    """A square kilometre at 60 degrees north: twice as many degrees wide as high."""
    side = 1000 / 111_200
    figure = path_map([[(60.0, 10.0), (60.0, 10.0 + 2 * side), (60.0 + side, 10.0 + 2 * side)]])
    east, north = figure.axes[0].get_lines()[0].get_data()
    assert np.asarray(east) == pytest.approx([0, 1, 1], abs=0.01)
    assert np.asarray(north) == pytest.approx([0, 0, 1], abs=0.01)
