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


def test_a_log_of_charging_alone_has_drawn_nothing():
    """And not something that is not known."""
    drawn = Drawn()
    for i in range(11):
        drawn.add(float(i), 53.0, -10.0, charging=True)
    assert (drawn.net, drawn.recovered) == (0.0, 0.0)
    assert drawn.charged == pytest.approx(5300)
