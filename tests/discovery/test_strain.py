"""Nothing is wrong is not said where the refit takes most of the energy, or the evidence asks for what cannot be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gz_onboard.discovery.acceptance import BEYOND, Rejected
from gz_onboard.discovery.mixed_model import initial, linearise_all
from gz_onboard.discovery.page import body
from gz_onboard.discovery.search import Search, evidence
from gz_onboard.discovery.selection import Selection, search_problem
from gz_onboard.discovery.strain import advice, in_words, strain_of
from gz_onboard.discovery.summary import summary
from gz_onboard.discovery.verdict import Discovery, conclude, verdict_of
from gz_onboard.model.parameters import Parameters
from gz_onboard.offline.samples import Samples, read_samples
from gz_onboard.vehicle import Vehicle, read_vehicle
from tests.support import LOGS

LONG = 250.0  # s
HARMLESS = ("cooling_blocked", "regen_loss", "sensor_latency")
INSIDE = {"inverter_current", "inverter_voltage", "auxiliary_current", "accel_x", "rate_z", "gps_altitude"}
VAGUE = {"torque_constant": 0.5, "motor_copper_resistance": 0.3, "cell_capacity": 5.0, "auxiliary_power": 200.0}


def vague(scooter: Vehicle) -> Vehicle:
    """The scooter by a file that says next to nothing of its motor and its pack, and nothing of its torque."""
    own = scooter.parameters
    known = {name: replace(value, sd=VAGUE.get(name, value.sd)) for name, value in own.known.items()}
    known["torque_constant"] = replace(known["torque_constant"], source="prior: of another vehicle")
    return replace(scooter, parameters=Parameters(known, own.declared))


def rides(scooter: Vehicle, current: float) -> list[Samples]:
    """Rides of pack, motor and thermometers alone, of a pack current that is `current` times what it was."""
    found = []
    for name in ("city_14C", "city_34C"):
        ride = read_samples(LOGS / f"{name}.blf", scooter)
        known = {
            role: (times[times < LONG], values[times < LONG])
            for role, (times, values) in ride.columns.items()
            if role not in INSIDE
        }
        times, values = known["pack_current"]
        found.append(replace(ride, columns=known | {"pack_current": (times, current * values)}))
    return found


@pytest.fixture(scope="module")
def wrong() -> Discovery:
    """A current of three times what it is, against a file that leaves the motor open, and candidates that are none."""
    scooter = read_vehicle("reference")
    mixed = initial(vague(scooter))
    found = [mixed.ride(ride) for ride in rides(scooter, 3.0)]
    problem = search_problem(mixed, np.zeros(len(mixed.names)), lambda at: linearise_all(found, at))
    beside = [cause for cause in problem.causes if cause.name in HARMLESS]
    return conclude(replace(problem, causes=beside), [], lambda _: None)


def test_what_the_refit_took_is_not_nothing(wrong: Discovery):
    report = wrong.report
    assert (report.verdict, report.causes) == ("unknown", [])
    assert report.strain is not None and report.strain.energy_share > 0.5
    most = report.strain.refitted[0]
    assert most.parameter == "torque_constant" and most.value > 2 * most.known and not most.stated
    text = " ".join(summary(wrong).split())
    assert "No fault" not in text
    assert "in the refit, which is implausible: torque_constant 0.4523 to 1." in text
    assert "Give what the file does not say (torque_constant)." in text and "cannot tell which is wrong" in text
    assert "Implausible:" in body(wrong, lambda figure, _: "")


def test_a_score_far_beyond_the_threshold_is_not_nothing_even_if_its_cause_cannot_be(wrong: Discovery):
    mixed = wrong.mixed
    search = Search(mixed, evidence(mixed, wrong.normals), mixed.usable_causes)
    still = [replace(normal, b=normal.n @ mixed.mean) for normal in wrong.normals]  # rides that move nothing
    now = Selection(mixed, wrong.lines, still, search, (), np.zeros(len(mixed.names)))
    (i,) = mixed.index(["pack_current_gain"])
    value = (3.0 - mixed.values["pack_current_gain"]) / mixed.scale[i]
    gain = Rejected("current_sensor_gain", BEYOND, np.array([value]))
    assert str(gain) == "current_sensor_gain would be beyond what it can be: not named"
    assert strain_of(now, (), [gain], {"current_sensor_gain": 150.0}, 17.0) is None
    elsewhere = replace(gain, why="does not foretell rides held out")
    assert strain_of(now, (), [elsewhere], {"current_sensor_gain": 267.0}, 17.0) is None
    strain = strain_of(now, (), [gain], {"current_sensor_gain": 267.0}, 17.0)
    assert strain is not None and not strain.refitted
    (words,) = in_words(strain)
    assert words.startswith("current_sensor_gain (score 267, ") and "pack_current_gain = 3," in words
    assert "cannot tell" in advice(strain)
    assert verdict_of([], [], strain is not None) == "unknown" and verdict_of([], [], False) == "none"
