from __future__ import annotations

import numpy as np
import pytest

from gz_onboard.calibration.result import LackingError
from gz_onboard.calibration.sensors import RIDE, offsets, read_pair
from gz_onboard.errors import InputError

from .rides import CURRENT_NOISE, GAIN, OFFSET, VEHICLE, VOLTAGE_NOISE, VOLTS_APART, ride


def test_planted_errors_come_back_within_their_intervals():
    held = {"pack_current_offset": 0, "pack_current_gain": 0}
    for seed in range(0, 60, 3):
        found = offsets([ride(seed + k) for k in range(3)], VEHICLE).parameters
        held["pack_current_gain"] += abs(found["pack_current_gain"].value - GAIN) < 1.96 * found["pack_current_gain"].sd
        held["pack_current_offset"] += (
            abs(found["pack_current_offset"].value - OFFSET) < 1.96 * found["pack_current_offset"].sd
        )
    assert all(count >= 18 for count in held.values()), held


def test_intervals_hold_what_instruments_of_their_class_do():
    """Over scooters whose inverter's current sensor and own loss err as their class and the vehicle file say."""
    rng, known = np.random.default_rng(0), VEHICLE.parameters
    own_sd = known.sd("inverter_loss_constant") / known["inverter_loss_constant"]
    away = []
    for seed in range(0, 300, 3):
        errs = {
            "inverter_gain": 1 + RIDE.gain_sd * rng.normal(),
            "own_loss": 1 + own_sd * rng.normal(),
            "auxiliary_sign": 1 + RIDE.shunt_sd * rng.normal(),
        }
        *drifts, next_one = RIDE.drift_sd * rng.normal(size=4)  # the offset's sd is of a ride to come
        rides = [ride(seed + k, seconds=200, drift=drift, **errs) for k, drift in enumerate(drifts)]
        found = offsets(rides, VEHICLE).parameters
        truths = {"pack_current_gain": GAIN, "pack_current_offset": OFFSET + next_one}
        away.append([(found[name].value - truth) / found[name].sd for name, truth in truths.items()])
    gain, offset = np.mean(np.abs(away) < 1.96, axis=0)
    assert 0.9 <= gain <= 0.99
    assert 0.9 <= offset <= 0.99


def test_noise_is_that_of_a_sample():
    found = offsets([ride(seed) for seed in range(3)], VEHICLE).parameters
    assert found["pack_current_noise"].value == pytest.approx(CURRENT_NOISE, rel=0.1)
    assert found["pack_voltage_noise"].value == pytest.approx(VOLTAGE_NOISE, rel=0.1)


def test_what_two_sensors_cannot_tell_is_said():
    result = offsets([ride(seed) for seed in range(3)], VEHICLE)
    assert result.parameters["pack_voltage_offset"].value == 0
    assert result.parameters["pack_voltage_offset"].sd == pytest.approx(VOLTS_APART, rel=0.2)
    assert any("pack_voltage_offset: +0.0" in refusal for refusal in result.refusals)
    assert any("pack_current_gain" in refusal and "ratio" in refusal for refusal in result.refusals)


def test_no_gain_without_current():
    result = offsets([ride(0, calm=True)], VEHICLE)
    assert "pack_current_gain" not in result.parameters
    assert any("tell no gain" in refusal for refusal in result.refusals)


def test_bad_rides_are_refused():
    with pytest.raises(
        LackingError, match=r"none has inverter_current, pack_current\), nor stands .* with pack_voltage"
    ):
        offsets([ride(0, drop=["inverter_current", "pack_current"])], VEHICLE)
    moving = ride(0)
    moving.columns["motor_speed"][1][:] = 30.0
    with pytest.raises(InputError, match="no ride stands without load"):
        offsets([moving], VEHICLE)
    with pytest.raises(InputError, match="no ride"):
        offsets([], VEHICLE)


def test_means_are_over_whole_windows():
    pair = read_pair(ride(0), VEHICLE)
    step = float(np.median(np.diff(pair.time)))
    count = round(2.0 / step)
    means = pair.means(np.arange(len(pair.time), dtype=float), 2.0)
    assert len(means) == len(pair.time) // count
    assert means[:2] == pytest.approx([(count - 1) / 2, (3 * count - 1) / 2])


INVERTER = ["inverter_current", "inverter_voltage", "motor_current"]


def test_without_the_inverters_sensors_the_pack_at_standstill_tells_and_it_is_said():
    result = offsets([ride(seed, drop=INVERTER) for seed in range(3)], VEHICLE)
    found = result.parameters
    assert set(found) == {"pack_current_offset", "pack_current_noise", "pack_voltage_noise"}
    assert abs(found["pack_current_offset"].value - OFFSET) < 2 * found["pack_current_offset"].sd
    assert found["pack_current_noise"].value == pytest.approx(CURRENT_NOISE, rel=0.1)
    assert "none has inverter_current, inverter_voltage, motor_current): taken from the pack's" in result.notes[0]
    assert "pack_current_gain, pack_voltage_offset: need inverter_current" in result.refusals[-1]


def test_without_any_other_current_there_is_no_offset():
    result = offsets([ride(0, drop=[*INVERTER, "auxiliary_current"])], VEHICLE)
    assert set(result.parameters) == {"pack_current_noise", "pack_voltage_noise"}
    assert "pack_current_offset: needs inverter_current, or auxiliary_current" in result.refusals[0]


def test_a_ride_without_the_inverters_sensors_beside_others_is_left_out_and_named():
    result = offsets([ride(0), ride(1), ride(2, drop=INVERTER)], VEHICLE)
    assert any(note.startswith("ride_2: left out") for note in result.notes)
