"""What a pack gave, what riding gave back, and what a charger gave."""

import pytest

from gz_onboard.estimator.drawn import Drawn
from gz_onboard.events import Activity, Estimate


def test_a_charger_is_not_riding():
    drawn = Drawn()
    rides = [(50.0, 8.0, Activity.RIDING)] * 100 + [(52.0, -5.0, Activity.RIDING)] * 10
    rides += [(53.0, -10.0, Activity.CHARGING)] * 200 + [(50.0, 8.0, Activity.RIDING)] * 100
    for i, (voltage, current, activity) in enumerate(rides):
        speed = 0.0 if activity is Activity.CHARGING else 10.0
        drawn.take(Estimate(float(i), speed=speed, pack_voltage=voltage, pack_current=current, activity=activity))
    assert drawn.recovered == pytest.approx(10 * 52 * 5)
    assert drawn.charged == pytest.approx(200 * 53 * 10)
    assert drawn.net == pytest.approx(199 * 50 * 8 - drawn.recovered)
    assert drawn.missing == 0
