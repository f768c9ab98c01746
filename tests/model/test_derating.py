"""The controller's derating tables: what they give and what is refused of them."""

from __future__ import annotations

import re
from dataclasses import fields

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.errors import InputError
from gz_onboard.model.functions import PiecewiseLinear
from gz_onboard.model.tables import Derating
from gz_onboard.vehicle import OWN, read_vehicle

REFERENCE = (OWN / "reference.toml").read_text(encoding="utf-8")
CONTROLLER = REFERENCE[REFERENCE.index("[controller]") : REFERENCE.index("[battery]")]


@given(
    points=st.lists(st.tuples(st.floats(0.1, 50), st.sampled_from([0.0, 0.3, 0.7, 1.0])), min_size=1, max_size=7),
    x=st.floats(-100, 500),
)
def test_a_curve_is_linear_between_its_points_and_constant_beyond(points, x):
    import numpy as np

    at = np.cumsum([width for width, _ in points])
    share = [y for _, y in points]
    curve = PiecewiseLinear(tuple(at.tolist()), tuple(share))
    assert curve.at(x) == pytest.approx(float(np.interp(x, at, share)), abs=1e-9)


def test_without_a_table_nothing_is_taken_off(tmp_path):
    """The reference scooter's limits would give a geared motor no torque above 55 rad/s."""
    file = tmp_path / "v.toml"
    file.write_text(REFERENCE.replace(CONTROLLER, ""))
    derating = read_vehicle(str(file)).derating
    assert derating == Derating() != read_vehicle("reference").derating
    assert derating.regeneration_gain == 1.0
    curves = [getattr(derating, entry.name) for entry in fields(Derating) if entry.name != "regeneration_gain"]
    assert all(curve.at(x) == 1.0 for curve in curves for x in (-40.0, 0.0, 0.02, 1.0, 55.4, 150.0, 5000.0))


def test_what_the_file_says_counts_the_rest_is_default(tmp_path):
    file = tmp_path / "v.toml"
    lines = '[controller]\ncurrent_by_soc = { at = [0.0, 0.5], share = [0.2, 0.9], unit = "1" }\n'
    file.write_text(REFERENCE.replace(CONTROLLER, lines))
    derating = read_vehicle(str(file)).derating
    assert derating.current_by_soc.at(0.25) == pytest.approx(0.55)
    assert derating.current_by_motor_speed == Derating().current_by_motor_speed


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("current_by_soc", "curent_by_soc", ["curent_by_soc", "unknown key", "did you mean 'current_by_soc'"]),
        (
            "at = [2.75, 2.89, 3.04",
            "at = [2.75, 3.09, 3.04",
            ["controller.current_by_cell_voltage.at", "must increase", "3.04 V follows 3.09 V"],
        ),
        (
            "at = [0.0, 120.0, 150.0]",
            "at = [0.0, 120.0, 1500.0]",
            ["controller.current_by_motor_temperature.at", "1500 degC is outside -60 to 300 degC"],
        ),
        ("share = [0.1, 1.0]", "share = [0.1, 1.2]", ["controller.current_by_soc.share", "1.2 is outside 0 to 1"]),
        (
            "share = [0.1, 1.0]",
            "share = [0.1]",
            ["controller.current_by_soc.share", "must be 2 numbers, one for each at"],
        ),
        ('0.0], unit = "rad/s"', '0.0], unit = "rpm"', ["current_by_motor_speed.unit", "'rpm'", "rad/s"]),
        ("regeneration_gain = { value = 50.0", "regeneration_gain = { value = -1.0", ["regeneration_gain.value", "-1"]),
        ("at = [7.0, 14.5]", 'at = [7.0, "fast"]', ["regeneration_by_motor_speed.at", "'fast'"]),
        ("at = [7.0, 14.5], ", "", ["regeneration_by_motor_speed.at", "is missing"]),
    ],
)
def test_what_makes_no_sense_is_refused_by_line_and_key(tmp_path, old, new, words):
    place = REFERENCE.index(CONTROLLER) + CONTROLLER.index(old)
    file = tmp_path / "v.toml"
    file.write_text(REFERENCE[:place] + new + REFERENCE[place + len(old) :])
    with pytest.raises(InputError) as error:
        read_vehicle(str(file))
    message = str(error.value)
    line = REFERENCE.count("\n", 0, place) + 1
    assert re.match(rf"{re.escape(str(file))}:{line}: ", message), message
    for word in words:
        assert word in message


def test_the_scooter_is_held_back_by_its_files_tables(tmp_path):
    from gz_onboard.simulation.scooter import Scooter

    def current(text, speed=1.0, throttle=1.0, brake=0.0):
        file = tmp_path / "v.toml"
        file.write_text(text)
        scooter = Scooter(read_vehicle(str(file)), soc=0.8, speed=speed)
        scooter.step(throttle, brake)
        return scooter.motor_current

    full = current(REFERENCE)
    half = REFERENCE.replace("share = [1.0, 1.0, 0.2]", "share = [0.5, 0.5, 0.2]", 1)  # motor temperature
    assert current(half) == pytest.approx(full / 2)
    weak = REFERENCE.replace("at = [7.0, 14.5], share = [0.0, 1.0]", "at = [7.0, 14.5], share = [0.0, 0.25]")
    assert current(weak, 10.0, 0.0, 0.5) == pytest.approx(current(REFERENCE, 10.0, 0.0, 0.5) / 4)
    slow = REFERENCE.replace("at = [0.0, 35.3,", "at = [0.0, 10.3,").replace("0.929", "0.5")
    assert current(slow, 6.0) < 0.8 * current(REFERENCE, 6.0)
