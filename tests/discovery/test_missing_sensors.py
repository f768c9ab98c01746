"""Rides without some sensors: fewer residuals, fewer causes, and the report says so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from gz_onboard.discovery.channels import CHANNEL, CHANNELS
from gz_onboard.discovery.judgement import needs
from gz_onboard.discovery.mixed_model import MixedModel
from gz_onboard.discovery.residuals import pack_power
from gz_onboard.discovery.run import discover
from gz_onboard.errors import InputError
from gz_onboard.recording.recording import Recording
from gz_onboard.vehicle import Vehicle
from tests.plant.cases import draw_many

INSIDE = {"motor_current", "motor_torque", "inverter_current", "inverter_voltage", "auxiliary_current"}


def without(ride: Recording, *roles: str) -> Recording:
    """The ride as a vehicle without these sensors shows it."""
    return replace(ride, columns={n: c for n, c in ride.columns.items() if n not in roles})


@pytest.fixture(scope="module")
def loaded() -> tuple[Sequence[Recording], float]:
    """Rides with a hidden load, and its power [W]: to a scooter what 1 kW is to a car."""
    (case,) = draw_many([500_003], "one", ("auxiliary_load",), truths=False)
    return case.rides, case.truths[0].change[0]


def test_a_load_is_named_by_the_packs_power_alone(scooter: Vehicle, loaded):
    rides, more = loaded
    report = discover(scooter, [without(ride, *INSIDE) for ride in rides]).report
    cause = report.causes[0]
    assert cause.name == "auxiliary_load" and not report.ambiguous
    assert cause.value == pytest.approx(scooter.parameters["auxiliary_power"] + more, rel=0.15)
    assert report.isolability.signatures["auxiliary_load"] == ["pack_power"]
    assert any("no ride has motor_current" in note for note in report.notes)


@pytest.mark.parametrize(
    ("lacking", "channels"),
    [
        ((), {"road_force", "inverter_power", "pack_balance", "auxiliary"}),
        (("auxiliary_current",), {"road_force", "inverter_power", "pack_power"}),
        (("inverter_current",), {"road_force", "pack_power", "auxiliary"}),
        (("motor_current",), {"road_force", "inverter_power", "pack_balance", "auxiliary"}),
        (("motor_current", "motor_torque"), {"pack_balance", "pack_power", "auxiliary"}),
        (INSIDE, {"pack_power"}),
    ],
)
def test_missing_sensors_narrow_the_residuals(mixed: MixedModel, loaded, lacking, channels: set[str]):
    ride = mixed.ride(without(loaded[0][0], *lacking))
    powers = {"road_force", "inverter_power", "pack_balance", "pack_power", "auxiliary"}
    assert {c.name for c in CHANNELS if c.usable(ride, mixed.system)} & powers == channels
    if "pack_power" in channels:
        left = pack_power(ride, mixed.values, mixed.system)[ride.standing]
        expected = 0.0 if "auxiliary" in channels else loaded[1]
        assert left.mean() == pytest.approx(expected, abs=15.0)  # W: the DC link's sensor is off by 0.1 A, 6 W


def test_a_measured_heater_is_no_cause(mixed: MixedModel, loaded):
    plain = without(loaded[0][0], *INSIDE)
    times, _ = plain.columns["pack_voltage"]
    heater = (times + 0.01, np.full(len(times), loaded[1]))
    measured = replace(plain, columns={**plain.columns, "heater_power": heater})
    left = [pack_power(r, mixed.values, mixed.system)[r.standing].mean() for r in map(mixed.ride, (plain, measured))]
    assert left == pytest.approx([loaded[1], 0.0], abs=10.0)


def test_another_speed_and_torque_replace_missing_ones(mixed: MixedModel, loaded):
    plain = loaded[0][0]
    ride = mixed.ride(plain)
    time, speed = plain.columns["motor_speed"]
    columns = without(plain, "motor_speed", "motor_current", "wheel_speed_rear").columns
    other = mixed.ride(replace(plain, columns={**columns, "vehicle_speed": (time, speed * ride.radius)}))
    assert len(other.stand_ins) == 2 and "vehicle_speed" in other.stand_ins[0] and "motor_torque" in other.stand_ins[1]
    n = min(len(ride.time), len(other.time))
    assert other.quantities["speed"][:n] == pytest.approx(ride.quantities["speed"][:n], abs=0.1)
    rear = mixed.ride(without(plain, "motor_speed", "vehicle_speed"))
    assert "wheel_speed_rear" not in rear.have  # not compared with itself


def test_a_ride_without_any_measure_of_its_drive_is_refused(mixed: MixedModel, loaded):
    with pytest.raises(InputError, match="no motor_current, no motor_torque and not both of pack_voltage and pack_cur"):
        mixed.ride(without(loaded[0][0], *INSIDE, "pack_current"))


def test_voltage_steps_are_not_sought_between_slow_samples(mixed: MixedModel, loaded):
    slow = {role: (t[::5], v[::5]) for role, (t, v) in loaded[0][0].columns.items() if role.startswith("pack_")}
    ride = mixed.ride(replace(loaded[0][0], columns={**loaded[0][0].columns, **slow}))
    assert not CHANNEL["voltage_timing"].usable(ride, mixed.system)
    assert CHANNEL["cell_voltage"].usable(ride, mixed.system)


def test_every_candidate_says_what_it_needs(mixed: MixedModel):
    by_name = {cause.name: needs(mixed, cause) for cause in mixed.causes}
    assert all(by_name.values())
    assert "pack_voltage and pack_current" in by_name["auxiliary_load"]
