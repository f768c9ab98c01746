"""Rides that contradict the vehicle file stop a calibration, and the message names the signals that do."""

from __future__ import annotations

import pytest

from gz_onboard.calibration.prior_check import check_against_file
from gz_onboard.calibration.result import Found, Result
from gz_onboard.calibration.sensors import auxiliary_power, cable_resistance, offsets
from gz_onboard.calibration.sensors import wheel_radius as wheel
from gz_onboard.errors import InputError

from .rides import VEHICLE, ride
from .test_wheel import ride as gps_ride


def test_rides_of_this_vehicle_pass():
    rides = [ride(seed) for seed in range(3)]
    for result in (offsets(rides, VEHICLE), auxiliary_power(rides, VEHICLE), cable_resistance(rides, VEHICLE)):
        check_against_file(result, VEHICLE)


def test_a_radius_by_another_wheels_gps_is_refused_with_both_values_and_the_signals():
    result = wheel([gps_ride(0.30, 0, minutes=3)], VEHICLE)
    said = (
        r"wheel_radius is 0\.2438 ± 0\.0005 m \(measured\) by the file and 0\.2999 ± .* m by these rides, \d+ standard"
    )
    with pytest.raises(InputError, match=said + r".*; gps_speed over motor_speed pulls it there"):
        check_against_file(result, VEHICLE)


def test_a_gain_in_milliamperes_names_the_two_currents():
    rides = [ride(seed, inverter_gain=0.5) for seed in range(3)]
    with pytest.raises(
        InputError, match=r"pack_current_gain is .* pack_current over inverter_current .*pulls it there"
    ):
        check_against_file(offsets(rides, VEHICLE), VEHICLE)


def test_what_a_guess_leaves_open_and_what_a_bench_measured_pass():
    p = VEHICLE.parameters
    far = p["wheel_radius"] + 5 * p.sd("wheel_radius")
    for found in (Found(far, 5e-3, "m", "unsure", "gps_speed"), Found(far, 1e-5, "m", "bench")):
        check_against_file(Result("wheel", {"wheel_radius": found}), VEHICLE)
