"""A curve is offered only over what the rides measured and differ in; what is the same everywhere is a constant."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gz_onboard.discovery.curve_forms import CurveForm, columns_of, curve_forms
from gz_onboard.discovery.curves import supported_knots
from gz_onboard.discovery.extension import curve_text
from gz_onboard.discovery.linear import LinearRide
from gz_onboard.discovery.mixed_model import MixedModel, initial, linearise_all
from gz_onboard.discovery.result import CONSTANT, Gain, Isolability, Report, Unknown
from gz_onboard.discovery.unexplained import in_words
from gz_onboard.discovery.verdict import Discovery
from gz_onboard.model.effect import load_effect
from gz_onboard.offline.samples import Samples, read_samples
from gz_onboard.vehicle import read_vehicle
from tests.support import LOGS

POOR = ("pack_voltage", "pack_current", "vehicle_speed")


@pytest.fixture(scope="module")
def mixed() -> MixedModel:
    return initial(read_vehicle("reference"))


@pytest.fixture(scope="module")
def ride(mixed: MixedModel) -> Samples:
    return read_samples(LOGS / "city_14C.blf", mixed.vehicle)


def linear(mixed: MixedModel, ride: Samples, **columns: tuple[np.ndarray, np.ndarray]) -> LinearRide:
    """`ride` as one shows it that measured no more than pack and speed, and `columns`."""
    speed = ride.columns["motor_speed"]
    poor = {role: ride.columns[role] for role in ("pack_voltage", "pack_current")} | {"motor_speed": speed} | columns
    (line,) = linearise_all([mixed.ride(replace(ride, columns=poor))], mixed)
    return line


def test_no_curve_over_what_was_not_measured(mixed: MixedModel, ride: Samples):
    line = linear(mixed, ride)
    had = {form.quantity for form in curve_forms() if columns_of(line, form) is not None}
    assert had == {"speed", "acceleration", "time", "pack_current", "soc", CONSTANT}
    whole = linear(mixed, ride, **ride.columns)
    had = {f.quantity for f in curve_forms() if columns_of(whole, f) is not None}
    assert {"heading", "lateral_acceleration", "grade", "motor_temperature", "current_change"} <= had


def test_no_curve_over_what_hardly_varies(mixed: MixedModel, ride: Samples):
    """Also between two knots, where both would count as visited, and of what is in proportion."""
    times = ride.columns["gps_course"][0]
    turns = linear(mixed, ride, gps_course=ride.columns["gps_course"])
    assert supported_knots(CurveForm("pack_power", "heading"), [turns, turns]).shape[1] > 2
    wobble = 0.01 * np.sin(times)
    for stuck in (0.1, 0.45, 3.0):
        line = linear(mixed, ride, gps_course=(times, stuck + wobble))
        assert supported_knots(CurveForm("pack_power", "heading"), [line, line]).shape[1] == 0
    smooth = linear(mixed, ride, gps_course=(times, 0.0 * times))
    smooth.ride.quantities["vibration"] = np.ones_like(smooth.ride.time)
    assert supported_knots(CurveForm("pack_power", "vibration", straight=True), [smooth, smooth]).shape[1] == 0


def test_a_constant_is_called_one_and_can_be_modelled(mixed: MixedModel, ride: Samples, tmp_path: Path):
    line = linear(mixed, ride)
    assert supported_knots(CurveForm("pack_power", CONSTANT), [line, line]).tolist() == [[1.0]]
    unknown = Unknown("pack_power", CONSTANT, False, "1", 80.0, 80.0, ((0.0, -129.1, 14.9),))
    assert in_words(unknown).startswith("a constant pack power, -129.1 ± 15 W")
    report = Report("unknown", [], [], unknown, [], {}, Gain(), [], [], Isolability({}, [], []), 15.0)
    text = curve_text(Discovery(report, mixed, np.zeros(len(mixed.names)), [line], []))
    assert text is not None
    (tmp_path / f"{text[0]}.py").write_text(text[1])
    effect, scale = load_effect(text[0], tmp_path), {f"{text[0]}_scale": 1.0}
    assert [effect.term.function(v, **scale) for v in (0.0, 0.5, 20.0)] == pytest.approx([-129.1] * 3)
