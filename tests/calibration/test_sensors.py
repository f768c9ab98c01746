"""Wheel radius, auxiliary power, errors of the pack's sensors and resistances out of rides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.calibration.result import LackingError
from gz_onboard.calibration.sensors import (
    RIDE,
    auxiliary_power,
    cable_resistance,
    cell_steps,
    offsets,
    pack_series_resistance,
    resistances,
    wheel_radius,
)
from gz_onboard.errors import InputError
from gz_onboard.recording.recording import Recording

from .bench import table
from .rides import (
    CABLE,
    CELL_STEP,
    CURRENT_NOISE,
    GAIN,
    LIT,
    OFFSET,
    SERIES,
    UNLIT,
    VEHICLE,
    VOLTS_APART,
    gps_ride,
    ride,
)


@settings(max_examples=10, deadline=None)
@given(st.floats(0.2, 0.35), st.integers(0, 1000), st.floats(0, 0.6))
def test_a_planted_radius_comes_back(radius, seed, lag):
    found = wheel_radius([gps_ride(radius, seed, lag, top=14.0), gps_ride(radius, seed + 1, lag, top=14.0)], VEHICLE)
    assert found.parameters["wheel_radius"].value == pytest.approx(radius, rel=0.002)


def test_what_does_not_tell_is_refused():
    good = gps_ride(0.24, 1)
    blind = Recording("blind", {"motor_speed": good.columns["motor_speed"]})
    slow = gps_ride(0.24, 2, top=4.0)
    result = wheel_radius([good, blind, slow], VEHICLE)
    assert result.refusals[0] == "blind: has no gps_speed or no motor_speed, nor a wheel_speed_rear instead"
    assert "ride_2: 0 fixes at steady speed" in result.refusals[1]
    assert "ride_1" in result.parameters["wheel_radius"].source
    with pytest.raises(InputError, match="no ride tells the wheel's radius: blind"):
        wheel_radius([blind], VEHICLE)


def test_without_a_motor_speed_it_is_that_of_the_rear_wheel_and_says_so():
    with_motor = gps_ride(0.24, 1)
    time, turned = with_motor.columns["motor_speed"]
    columns = {"gps_speed": with_motor.columns["gps_speed"], "wheel_speed_rear": (time, turned)}
    geared = VEHICLE.changed(VEHICLE.parameters.replaced(gear_ratio=0.2))
    result = wheel_radius([Recording("car", columns)], geared)
    assert result.parameters["wheel_radius"].value == pytest.approx(0.24, rel=0.003)
    assert "car: no motor_speed, taken by wheel_speed_rear instead" in result.notes
    assert "gps_speed over wheel_speed_rear" in result.parameters["wheel_radius"].source


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
    moving = ride(0)
    moving.columns["motor_speed"][1][:] = 30.0
    for useless in (moving, ride(0, drop=["inverter_current", "pack_current"])):
        with pytest.raises(LackingError, match="no ride with pack_current and pack_voltage stands without load"):
            offsets([useless], VEHICLE)


INVERTER = ["inverter_current", "inverter_voltage", "motor_current"]


def test_without_the_inverters_sensors_the_pack_at_standstill_tells_and_it_is_said():
    result = offsets([ride(seed, drop=INVERTER) for seed in range(3)], VEHICLE)
    found = result.parameters
    assert set(found) == {"pack_current_offset", "pack_current_noise", "pack_voltage_noise"}
    assert abs(found["pack_current_offset"].value - OFFSET) < 2 * found["pack_current_offset"].sd
    assert found["pack_current_noise"].value == pytest.approx(CURRENT_NOISE, rel=0.1)
    assert "no ride has inverter_current, inverter_voltage, motor_current: taken from the pack's" in result.notes[0]
    assert "pack_current_gain, pack_voltage_offset: need inverter_current" in result.refusals[-1]


def test_without_any_other_current_there_is_no_offset():
    result = offsets([ride(0, drop=[*INVERTER, "auxiliary_current"])], VEHICLE)
    assert set(result.parameters) == {"pack_current_noise", "pack_voltage_noise"}
    assert "pack_current_offset: needs inverter_current, or auxiliary_current" in result.refusals[0]


def test_a_ride_without_the_sensor_is_left_out_and_none_at_all_refused():
    result = auxiliary_power([*(ride(seed) for seed in range(1, 5)), ride(0, drop=["auxiliary_current"])], VEHICLE)
    assert "ride_0: no auxiliary_current, left out" in result.notes
    found = result.parameters["auxiliary_power"]
    assert UNLIT < found.value < LIT and 0 < found.sd < 3
    with pytest.raises(InputError, match="no ride has auxiliary_current"):
        auxiliary_power([ride(0, drop=["auxiliary_current", "pack_current"])], VEHICLE)
    with pytest.raises(InputError, match="must be positive when consuming"):
        auxiliary_power([ride(0, auxiliary_sign=-1)], VEHICLE)


def test_without_its_sensor_it_is_what_the_pack_gives_at_standstill():
    rides = [ride(seed, drop=["auxiliary_current", "inverter_current", "inverter_voltage"]) for seed in range(4)]
    result = auxiliary_power(rides, VEHICLE)
    found = result.parameters["auxiliary_power"]
    assert found.value == pytest.approx(LIT, abs=OFFSET * 54 + 2)  # most of the rest is with the brake on
    assert "at standstill" in found.source and "no ride has auxiliary_current" in result.notes[0]
    (plain,) = rides[:1]
    time, _ = plain.columns["pack_current"]
    heated = replace(plain, columns={**plain.columns, "heater_power": (time, np.full(len(time), 10.0))})
    less = auxiliary_power([heated], VEHICLE).parameters["auxiliary_power"].value
    assert less == pytest.approx(auxiliary_power([plain], VEHICLE).parameters["auxiliary_power"].value - 10.0)


def pulse(temperature, ohm, sign=1):
    """Pulses of a cell that is a resistance only, 0.1 s after a change, 2 s before."""
    time, current, now = [], [], 0.0
    for k in range(24):
        for dt in [0.1] * 20 + [2.0] * 10:
            time.append(now)
            current.append(sign * (5.0 if k % 2 else 0.0))
            now += dt
    amperes = np.array(current)
    return table(
        time=time, current=amperes, voltage=3.7 - ohm * amperes, cell_temperature=np.full(len(time), temperature)
    )


def test_cell_steps_are_the_resistance_at_once():
    temperature, logarithm = cell_steps([pulse(40.0, 0.03), pulse(10.0, 0.06)])
    assert np.allclose(temperature, [10, 40]) and np.allclose(np.exp(logarithm), [0.06, 0.03])
    with pytest.raises(InputError, match="0 steps of current"):
        cell_steps([table(time=[0, 1, 2], current=[1, 1, 1], voltage=[3, 3, 3], cell_temperature=[9, 9, 9])])


def test_series_resistance_is_what_the_cells_do_not_explain():
    pulses = [pulse(10.0, CELL_STEP), pulse(40.0, CELL_STEP)]
    # the vehicle's gain and offset of the current are not those of the planted sensor: within 1 %
    found = pack_series_resistance([ride(seed) for seed in range(4)], VEHICLE, pulses)
    series = found.parameters["pack_series_resistance"]
    assert abs(series.value - SERIES) < 1.96 * series.sd and "pulse tests" in series.source


def test_a_vehicle_of_small_currents_needs_small_steps():
    p = VEHICLE.parameters
    small = VEHICLE.changed(p.replaced(motor_current_limit=p["motor_current_limit"] / 8))
    rides = [ride(seed) for seed in range(4)]
    for columns in (one.columns for one in rides):
        columns |= {role: (t, x / 8) for role, (t, x) in columns.items() if role.endswith("current")}
    cable = cable_resistance(rides, small).parameters["cable_resistance"]
    assert abs(cable.value - 8 * CABLE) < 1.96 * cable.sd


def test_no_number_where_the_cells_own_doubt_is_greater():
    strong = [pulse(10.0, 0.046), pulse(40.0, 0.046)]
    result = pack_series_resistance([ride(seed) for seed in range(4)], VEHICLE, strong)
    assert not result.parameters and any("the value of the vehicle file stays" in r for r in result.refusals)


def test_rides_without_steps_are_refused():
    with pytest.raises(InputError, match="spans too little for a resistance"):
        cable_resistance([ride(0, calm=True)], VEHICLE)
    pulses = [pulse(40.0, CELL_STEP), pulse(30.0, CELL_STEP)]
    with pytest.raises(InputError, match="0 steps of more than 15 A"):  # no extrapolation to colder cells
        pack_series_resistance([ride(0)], VEHICLE, pulses)
    with pytest.raises(InputError, match="no cell_temperature"):
        pack_series_resistance([ride(0, drop=["cell_temperature"])], VEHICLE, pulses)
    without = resistances([ride(0)], VEHICLE)
    assert "cable_resistance" in without.parameters
    assert "pack_series_resistance: needs pulse tests" in without.refusals[0]


def receivers(seed, rng):
    """wheel_radius of receivers that err, each one on all its rides."""
    bias = rng.normal(0, RIDE.receiver_sd)
    return wheel_radius([gps_ride(0.24, 10 * seed + k, minutes=3, bias=bias) for k in range(3)], VEHICLE), 0.24


def instruments(seed, rng):
    """Offset on a ride to come, of scooters whose sensors and inverter's own loss err as their class and file say."""
    known = VEHICLE.parameters
    own_sd = known.sd("inverter_loss_constant") / known["inverter_loss_constant"]
    errs = {"own_loss": 1 + own_sd * rng.normal(), "auxiliary_sign": 1 + RIDE.shunt_sd * rng.normal()}
    *drifts, to_come = RIDE.drift_sd * rng.normal(size=4)
    rides = [ride(3 * seed + k, seconds=200, drift=drift, **errs) for k, drift in enumerate(drifts)]
    return offsets(rides, VEHICLE), OFFSET + to_come


def gains(seed, rng):
    gain = 1 + RIDE.gain_sd * rng.normal()
    return offsets([ride(3 * seed + k, seconds=200, inverter_gain=gain) for k in range(3)], VEHICLE), GAIN


def voltmeters(seed, rng):
    """Cables of scooters whose two voltage sensors err in gain."""
    errs = tuple(1 + RIDE.voltage_gain_sd * rng.normal(size=2))
    return cable_resistance([ride(3 * seed + k, seconds=200, voltage_gains=errs) for k in range(3)], VEHICLE), CABLE


def packs(seed, rng):
    """Packs whose cells are not those of the pulse test, by what cells scatter."""
    cell = CELL_STEP * (1 + RIDE.cells_sd * rng.normal())
    rides = [ride(3 * seed + k, seconds=200, cell=cell, series=2 * SERIES) for k in range(3)]
    return pack_series_resistance(rides, VEHICLE, [pulse(10.0, CELL_STEP), pulse(40.0, CELL_STEP)]), 2 * SERIES


@pytest.mark.parametrize(
    ("name", "found", "count"),
    [
        ("wheel_radius", receivers, 60),
        ("pack_current_offset", instruments, 100),
        ("pack_current_gain", gains, 100),
        ("cable_resistance", voltmeters, 100),
        ("pack_series_resistance", packs, 60),
    ],
)
def test_intervals_hold_instruments_and_cells_that_err_as_their_class_does(name, found, count):
    rng, held = np.random.default_rng(0), 0
    for seed in range(count):
        result, truth = found(seed, rng)
        held += abs(result.parameters[name].value - truth) < 1.96 * result.parameters[name].sd
    assert 0.9 <= held / count <= 0.99
