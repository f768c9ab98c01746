"""What is known before any ride: sizes of a vehicle, and what effects declare of themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.discovery.candidates import candidates
from gz_onboard.discovery.curve_forms import KNOTS, CurveForm
from gz_onboard.discovery.grid import MOST_STEERING, steering
from gz_onboard.discovery.mixed_model import initial
from gz_onboard.discovery.prior import NUISANCE
from gz_onboard.lab.sizes import USUAL_SIZES, nearest_step, sizes_of
from gz_onboard.model.effect import load_effect, package_effects
from gz_onboard.offline.samples import read_samples
from gz_onboard.offline.traits import traits
from gz_onboard.vehicle import Vehicle, read_vehicle
from tests.support import LOGS


@given(st.floats(1e-3, 1e3), st.floats(1.1, 10.0))
def test_the_nearest_step_is_a_power_and_less_than_half_a_step_away(ratio: float, step: float):
    power = np.log(nearest_step(ratio, step)) / np.log(step)
    assert power == pytest.approx(round(power), abs=1e-6)
    assert abs(np.log(ratio) / np.log(step) - power) <= 0.5 + 1e-6


def test_what_has_no_size_is_of_the_usual():
    assert nearest_step(0.0) == nearest_step(-2.0) == nearest_step(1.0) == nearest_step(1.15) == 1.0


@pytest.fixture(scope="module")
def scooter() -> Vehicle:
    return read_vehicle("reference")


def test_absolute_numbers_grow_with_the_vehicle(scooter: Vehicle):
    assert sizes_of(scooter) == USUAL_SIZES
    p = scooter.parameters
    heavy = scooter.changed(p.replaced(vehicle_mass=4 * p["vehicle_mass"], motor_current_limit=4 * 211.0))
    sizes = sizes_of(heavy)
    assert (sizes.power, sizes.current, sizes.voltage, sizes.speed) == pytest.approx((4.0, 4.0, 1.0, 1.0))
    small, large = initial(scooter), initial(heavy)
    place = small.names.index("loss_speed")
    assert large.scale[place] == pytest.approx(4 * small.scale[place])
    geared = sizes_of(scooter.changed(p.replaced(gear_ratio=p["gear_ratio"] / 4, cell_capacity=4 * p["cell_capacity"])))
    assert (geared.spin, geared.resistance) == pytest.approx((4.0, 1 / 4))
    spun = initial(scooter.changed(p.replaced(gear_ratio=p["gear_ratio"] / 4)))
    place = small.names.index("copper_speed")
    assert spun.scale[place] == pytest.approx(small.scale[place] / 4)
    assert large.noise["road_force"].white == pytest.approx(4 * small.noise["road_force"].white)
    form = CurveForm("road_force", "motor_current", sizes=sizes)
    assert form.knots == pytest.approx(4 * np.array(KNOTS["motor_current"][0]))
    assert form.size == pytest.approx(4 * replace(form, sizes=USUAL_SIZES).size)
    assert {nuisance.size for nuisance in NUISANCE.values()} == {
        "",
        "power",
        "current",
        "voltage",
        "auxiliary",
        "resistance",
    }


def test_a_message_may_state_how_old_its_values_are(scooter: Vehicle):
    samples = read_samples(LOGS / "coastdown.blf", scooter)
    (message,) = {s.message for s in scooter.mapping.sources if s.role == "gps_speed"}
    late = replace(scooter, mapping=replace(scooter.mapping, delays={message: 0.9}))
    usual, later = (initial(vehicle).ride(samples) for vehicle in (scooter, late))
    assert later.signals["gps_speed"][:-5] == pytest.approx(usual.signals["gps_speed"][5:], abs=1e-6)
    assert (later.signals["pack_voltage"] == usual.signals["pack_voltage"]).all()


def test_steering_is_that_of_a_bicycle():
    radius = 20.0
    speed = np.array([3.0, -5.0, 8.0])
    assert steering(speed, speed**2 / radius, 1.3) == pytest.approx(1.3 / radius)
    assert steering(np.array([0.1]), np.array([9.0]), 1.3) == pytest.approx(MOST_STEERING)


def test_effects_say_of_themselves_how_a_cause_shows():
    found = {cause.name: cause for cause in candidates()}
    for effect in map(load_effect, package_effects()):
        own = {parameter.name for parameter in effect.parameters}
        known = traits(effect)
        assert set(known.strengths) <= own
        name = known.cause[0] if known.cause else effect.name
        if name in found:
            assert found[name].names == known.strengths
            assert known.shown_by
    assert found["headwind"].varies and found["headwind"].reads == ("drag_area",)
    assert found["inverter_loss"].names == ("inverter_loss_linear",)
