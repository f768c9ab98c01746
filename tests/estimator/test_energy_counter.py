"""What a pack gave, what riding gave back, and what a charger gave."""

import pytest

from gz_onboard.estimator.energy_counter import EnergyCounter
from gz_onboard.events import Activity, Estimate


def test_a_charger_is_not_riding():
    energy = EnergyCounter()
    rides = [(50.0, 8.0, Activity.RIDING)] * 100 + [(52.0, -5.0, Activity.RIDING)] * 10
    rides += [(53.0, -10.0, Activity.CHARGING)] * 200 + [(50.0, 8.0, Activity.RIDING)] * 100
    for i, (voltage, current, activity) in enumerate(rides):
        speed = 0.0 if activity is Activity.CHARGING else 10.0
        energy.add(Estimate(float(i), speed=speed, pack_voltage=voltage, pack_current=current, activity=activity))
    assert energy.recovered == pytest.approx(10 * 52 * 5)
    assert energy.charged == pytest.approx(200 * 53 * 10)
    assert energy.net == pytest.approx(199 * 50 * 8 - energy.recovered)
    assert energy.missing == 0
