"""A baseline is not believed against what was known of the vehicle, nor if it foretells energy worse."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from gz_onboard.arrays import Array
from gz_onboard.discovery.baseline import adopted
from gz_onboard.discovery.baseline_check import Learned, check_against_file, check_held_out, rides_apart
from gz_onboard.discovery.channels import CHANNEL
from gz_onboard.discovery.grid import Ride
from gz_onboard.discovery.linear import LinearChannel, LinearRide
from gz_onboard.discovery.mixed_model import MixedModel, initial
from gz_onboard.errors import InputError
from gz_onboard.vehicle import read_vehicle

BLOCKS, RIDES = 40, 6


@pytest.fixture(scope="module")
def mixed() -> MixedModel:
    return initial(read_vehicle("reference"))


def at(mixed: MixedModel, name: str, value: float) -> Array:
    mean = mixed.mean.copy()
    (i,) = mixed.index([name])
    mean[i] += (value - mixed.values[name]) / float(mixed.scale[i])
    return mean


def ride(mixed: MixedModel, channel: str, name: str, value: float) -> LinearRide:
    """A ride whose `channel` asks for this value of `name`."""
    (i,) = mixed.index([name])
    a = np.zeros((BLOCKS, len(mixed.names)))
    a[:, i] = 5 * mixed.noise[channel].sd
    y = a @ at(mixed, name, value)
    quantities = {"speed": np.full(4 * BLOCKS * 10, 8.0)}
    made = Ride("made up", np.linspace(0.0, 4.0 * BLOCKS, 4 * BLOCKS * 10), {}, {}, 0.25, None, quantities, 1e5)
    used = np.ones(BLOCKS, dtype=bool)
    table = LinearChannel(
        CHANNEL[channel], y, a, np.linspace(0.0, 4.0 * BLOCKS, BLOCKS), used, roughness=np.ones(BLOCKS)
    )
    return LinearRide(made, {channel: table})


def learned(mixed: MixedModel, channel: str, name: str, value: float, fold: float) -> Learned:
    """What rides that ask for `value` taught; without some of them it was `fold`."""
    after = replace(mixed, mean=at(mixed, name, value), prior=mixed.prior / 4)
    lines = [ride(mixed, channel, name, value)] * RIDES
    folds = [(replace(after, mean=at(mixed, name, fold)), [k, k + 1]) for k in range(0, RIDES, 2)]
    return Learned(mixed, after, lines, folds, mixed.scatter)


def test_a_radius_far_from_the_files_is_refused_with_the_channel_that_asks_for_it(mixed: MixedModel):
    radius = mixed.values["wheel_radius"]
    check_against_file(learned(mixed, "altitude", "wheel_radius", radius - 0.001, radius))
    with pytest.raises(
        InputError, match=r"wheel_radius is 0.2438 ± 0.0005 m \(measured\) by the file and 0.2"
    ) as error:
        check_against_file(learned(mixed, "altitude", "wheel_radius", radius - 0.03, radius))
    assert "altitude (accel_x, gps_altitude) pulls it there, without which it is 0.2438" in str(error.value)
    assert "Nothing is written" in str(error.value)


def figures(error: object) -> tuple[float, float, float, float]:
    """(value before, its sd, value found, standard deviations apart), as they are told."""
    row = re.search(r"is ([\d.]+) ± ([\d.]+) kg .* and (-?[\d.]+) ± [\d.]+ kg by these rides, (\d+) st", str(error))
    assert row is not None
    before, sd, found, far = map(float, row.groups())
    return before, sd, found, far


def test_a_payload_is_as_far_off_as_its_figures_say(mixed: MixedModel):
    """By what was entered, where that was; else by the file, whose rider may be another."""
    usual = mixed.vehicle.parameters.known["payload_mass"]
    rides = learned(mixed, "road_force", "payload_mass", usual.value - 70.0, usual.value)
    with pytest.raises(InputError, match=r"payload_mass is [\d.]+ ± [\d.]+ kg \(guess\) by the file") as error:
        check_against_file(rides)
    before, sd, found, far = figures(error.value)
    assert [before, sd, found] == pytest.approx([usual.value, usual.sd, usual.value - 70])
    assert far == pytest.approx(70 / sd, abs=1.0)
    for line in rides.lines:
        line.ride.payload = usual.value + 5.0
    with pytest.raises(InputError, match=r"payload_mass is [\d.]+ ± 2 kg as entered and") as error:
        check_against_file(rides)
    before, sd, found, far = figures(error.value)
    assert [before, found] == pytest.approx([usual.value + 5, usual.value - 65])
    assert far == pytest.approx(70 / sd, abs=1.0)
    near = learned(mixed, "road_force", "payload_mass", usual.value - 1.5 * usual.sd, usual.value)
    check_against_file(near)  # a rider of another mass than the file's, which nobody entered


def test_a_guess_that_rides_say_nothing_of_stays_one(mixed: MixedModel):
    known = mixed.vehicle.parameters.known["payload_mass"]
    assert known.status == "guess"
    (i,) = mixed.index(["payload_mass"])
    same = adopted(mixed.vehicle, mixed, mixed)
    assert same.parameters.known["payload_mass"] == known
    prior = mixed.prior.copy()
    prior[i, i] /= 4
    surer = adopted(mixed.vehicle, replace(mixed, prior=prior), mixed)
    assert surer.parameters.known["payload_mass"].status == "measured"


def test_what_foretells_rides_held_out_worse_than_the_file_is_refused(mixed: MixedModel):
    rolling = mixed.values["rolling_resistance_constant"]
    better = learned(mixed, "road_force", "rolling_resistance_constant", 1.05 * rolling, 1.05 * rolling)
    assert "missed by the file before, 0.00 by what the others taught (6 rides)" in check_held_out(better)
    worse = learned(mixed, "road_force", "rolling_resistance_constant", 1.05 * rolling, 1.4 * rolling)
    uneven = [(replace(m, mean=m.mean * (1 + 0.1 * k)), held) for k, (m, held) in enumerate(worse.folds)]
    with pytest.raises(InputError, match=r"Wh/km missed by the file before, .*worse. Nothing is written"):
        check_held_out(replace(worse, folds=uneven))


def test_too_few_rides_are_not_checked_and_it_is_said(mixed: MixedModel):
    few = learned(mixed, "road_force", "rolling_resistance_constant", 0.012, 0.012)
    assert "not checked on rides held out: 3 rides" in check_held_out(replace(few, lines=few.lines[:3]))


def test_of_many_parameters_the_farthest_are_named_and_the_others_counted(mixed: MixedModel):
    it = learned(mixed, "altitude", "wheel_radius", mixed.values["wheel_radius"] - 0.03, 0.0)
    names = ["wheel_radius", "auxiliary_power", "drag_area", "cell_capacity", "rolling_resistance_constant"]
    mean = it.before.mean + np.isin(mixed.names, names) * 100.0
    with pytest.raises(InputError, match=r"standard deviations apart.*; and 2 more") as error:
        check_against_file(replace(it, after=replace(it.after, mean=mean)))
    assert str(error.value).count("pulls it there") == 3


def test_a_ride_whose_sensor_lies_is_named(mixed: MixedModel):
    rolling = mixed.values["rolling_resistance_constant"]
    alike = learned(mixed, "road_force", "rolling_resistance_constant", rolling, rolling)
    assert rides_apart(alike) == []
    odd = ride(mixed, "road_force", "rolling_resistance_constant", 3 * rolling)
    lines = [*alike.lines[1:], replace(odd, ride=replace(odd.ride, name="ride_7"))]
    (said,) = rides_apart(replace(alike, lines=lines))
    assert said.startswith("ride_7 is an outlier: rolling_resistance_constant is ")
