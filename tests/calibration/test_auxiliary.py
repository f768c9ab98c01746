from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gz_onboard.calibration.sensors import auxiliary_power
from gz_onboard.errors import InputError
from gz_onboard.vehicle import read_vehicle

from .rides import LIT, OFFSET, UNLIT, ride

VEHICLE = read_vehicle("reference")


def test_power_with_and_without_brake_light_is_found():
    result = auxiliary_power([ride(seed) for seed in range(4)], VEHICLE)
    found = result.parameters["auxiliary_power"]
    assert UNLIT < found.value < LIT and 0 < found.sd < 3
    assert any(f"{UNLIT:.1f} W without, {LIT:.1f} W with" in note for note in result.notes)


def test_the_interval_holds_for_the_rides_not_used():
    found = auxiliary_power([ride(seed) for seed in range(5)], VEHICLE).parameters["auxiliary_power"]
    held = 0
    for seed in range(100, 120):
        other = auxiliary_power([ride(seed)], VEHICLE).parameters["auxiliary_power"].value
        held += abs(other - found.value) < 1.96 * found.sd
    assert held >= 17


def test_a_ride_without_the_sensor_is_left_out_and_none_at_all_refused():
    without = ride(0, drop=["auxiliary_current"])
    assert any("no auxiliary_current" in note for note in auxiliary_power([ride(1), without], VEHICLE).notes)
    with pytest.raises(InputError, match="no ride has auxiliary_current"):
        auxiliary_power([ride(0, drop=["auxiliary_current", "pack_current"])], VEHICLE)
    with pytest.raises(InputError, match="must be positive when consuming"):
        auxiliary_power([ride(0, auxiliary_sign=-1)], VEHICLE)
    assert auxiliary_power([ride(0, drop=["brake_switch"])], VEHICLE).refusals


def test_without_its_sensor_it_is_what_the_pack_gives_at_standstill():
    rides = [ride(seed, drop=["auxiliary_current", "inverter_current", "inverter_voltage"]) for seed in range(4)]
    result = auxiliary_power(rides, VEHICLE)
    found = result.parameters["auxiliary_power"]
    assert found.value == pytest.approx(LIT, abs=OFFSET * 54 + 2)  # most of the rest is with the brake on
    assert "standstill of 4 rides" in found.source and "no ride has auxiliary_current" in result.notes[0]
    (plain,) = rides[:1]
    time, _ = plain.columns["pack_current"]
    heated = replace(plain, columns={**plain.columns, "heater_power": (time, np.full(len(time), 10.0))})
    less = auxiliary_power([heated], VEHICLE).parameters["auxiliary_power"].value
    assert less == pytest.approx(auxiliary_power([plain], VEHICLE).parameters["auxiliary_power"].value - 10.0)
