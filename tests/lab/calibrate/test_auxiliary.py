from __future__ import annotations

import pytest

from gz_onboard.errors import InputError
from gz_onboard.lab.calibrate.auxiliary import auxiliary_power

from .rides import LIT, UNLIT, ride


def test_power_with_and_without_brake_light_is_found():
    result = auxiliary_power([ride(seed) for seed in range(4)])
    found = result.parameters["auxiliary_power"]
    assert UNLIT < found.value < LIT and 0 < found.sd < 3
    assert any(f"{UNLIT:.1f} W without, {LIT:.1f} W with" in note for note in result.notes)


def test_the_interval_holds_for_the_rides_not_used():
    found = auxiliary_power([ride(seed) for seed in range(5)]).parameters["auxiliary_power"]
    held = 0
    for seed in range(100, 120):
        other = auxiliary_power([ride(seed)]).parameters["auxiliary_power"].value
        held += abs(other - found.value) < 1.96 * found.sd
    assert held >= 17


def test_a_ride_without_the_sensor_is_left_out_and_none_at_all_refused():
    without = ride(0, drop=["auxiliary_current"])
    assert any("no auxiliary_current" in note for note in auxiliary_power([ride(1), without]).notes)
    with pytest.raises(InputError, match="no ride has auxiliary_current"):
        auxiliary_power([without])
    with pytest.raises(InputError, match="must be positive when consuming"):
        auxiliary_power([ride(0, auxiliary_sign=-1)])
    assert auxiliary_power([ride(0, drop=["brake_switch"])]).refusals
