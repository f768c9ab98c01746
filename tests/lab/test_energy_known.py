"""Energy and energy per kilometre are of the same way, and what they lack is said."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from gz_onboard.lab.estimate import summary_rows
from gz_onboard.lab.estimate_ride import How, Ridden
from gz_onboard.lab.estimate_summary import RideSummary, summary_of
from gz_onboard.lab.estimate_tally import Tally
from gz_onboard.lab.history.log_rides import About, moments_of, rides_of
from gz_onboard.lab.history.ride import KeptRide
from gz_onboard.lab.history.text import lacks_energy
from tests.faults.support import BEGIN, END, RIDE, Spoil, spoilt
from tests.faults.test_sensors import CURRENTS, VOLTAGES
from tests.support import Run, ridden


@cache
def of(spoil: Spoil, begin: float, end: float) -> tuple[Run, RideSummary, KeptRide]:
    """The ride spoilt from `begin` to `end` [s]: its estimates, its summary, and as the history keeps it."""
    run = ridden(spoilt(spoil, begin, end))
    tally = Tally(0)
    for estimate in run.estimates:
        tally(estimate)
    summary = summary_of(Ridden(Path("ride.blf"), run.pipeline, tally, How(), [], (1.0, 1.0)))
    about = About("scooter", "scooter|14s", Path("ride.mcap"), "0", None, None, {})
    samples = ((topic, time_ns, dict(values)) for topic, time_ns, values in run.samples)
    (kept,) = rides_of(*moments_of(samples), about)
    return run, summary, kept


def healthy() -> tuple[Run, RideSummary, KeptRide]:
    return of(lambda frame: frame, BEGIN, END)


def energy_line(summary: RideSummary) -> str:
    rows = summary_rows(summary)
    at = [name for name, _ in rows].index("energy")
    return " ".join(text for _, text in rows[at : at + 2])


def test_a_whole_ride_lacks_nothing():
    _, summary, kept = healthy()
    assert summary.energy_missing_s < 1
    assert summary.energy_distance_km == pytest.approx(summary.distance_km, rel=0.01)
    assert "not in it" not in energy_line(summary)
    assert kept.energy_wh is not None
    assert kept.consumption_wh_km == pytest.approx(kept.energy_wh / kept.distance_km, rel=0.01)
    assert not lacks_energy(kept)


def test_what_was_ridden_without_a_voltage_is_in_neither():
    run, summary, kept = of(VOLTAGES, BEGIN, END)
    whole, known = healthy()[0], [e for e in run.estimates if e.pack_voltage is None and e.time > BEGIN]
    ridden_without = known[-1].distance - known[0].distance
    assert ridden_without > 100
    assert summary.energy_missing_s == pytest.approx(END - BEGIN - 1, abs=0.5)  # it is held for a second
    assert summary.distance_km - summary.energy_distance_km == pytest.approx(ridden_without * 1e-3, abs=0.02)
    assert summary.energy_wh is not None
    assert whole.pipeline.energy.net is not None
    assert summary.energy_wh < 0.9 * whole.pipeline.energy.net / 3600
    assert summary.consumption_wh_km == pytest.approx(summary.energy_wh / summary.energy_distance_km)
    assert f"{summary.energy_missing_s:.1f} s without a credible voltage or current" in energy_line(summary)
    assert f"of {summary.energy_distance_km:.2f} km" in energy_line(summary)
    assert kept.consumption_wh_km == pytest.approx(summary.consumption_wh_km, rel=0.01)
    assert kept.metered_km == pytest.approx(summary.energy_distance_km, rel=0.01)
    assert lacks_energy(kept)


def test_a_current_that_no_sensor_showed_is_no_energy_drawn():
    run, summary, kept = of(CURRENTS, -1.0, RIDE + 1)
    assert any(e.pack_current for e in run.estimates), "the model stands in"
    assert (summary.energy_wh, summary.energy_recovered_wh, summary.consumption_wh_km) == (None, None, None)
    assert (kept.energy_wh, kept.energy_recovered_wh, kept.consumption_wh_km) == (None, None, None)
    assert " Wh" not in energy_line(summary).split("state of charge")[0]
