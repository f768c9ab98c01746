from __future__ import annotations

import numpy as np
import pytest

from gz_onboard.calibration.motor import torque_constant, voltage_constant
from gz_onboard.calibration.table import read_table
from gz_onboard.errors import InputError

from .bench import MOTOR, bench_file, changed, dyno, needs_data, table, without

SEEDS = 200


def ramp(seed, noise=0.04, constant=0.53):
    speed = np.linspace(1, 40, 70)
    return table(motor_speed=speed, emf_line=constant * speed + noise * np.random.default_rng(seed).normal(size=70))


def test_voltage_constant_comes_back_within_its_own_interval():
    held = 0
    for seed in range(SEEDS):
        found = voltage_constant(ramp(seed)).parameters["voltage_constant"]
        held += abs(found.value - 0.53) < 1.96 * found.sd
    assert 0.90 <= held / SEEDS <= 0.99


def test_torque_constant_comes_back_within_its_own_interval():
    held = 0
    for seed in range(SEEDS):
        found = torque_constant(dyno(seed)).parameters["torque_constant"]
        held += abs(found.value - MOTOR["torque_constant"]) < 1.96 * found.sd
    assert 0.90 <= held / SEEDS <= 0.99


def test_saturation_is_told_and_held_by_the_sd():
    straight, bent = torque_constant(dyno(0)), torque_constant(dyno(0, saturation=5e-7))
    assert not any("falls with current" in note for note in straight.notes)
    assert any("falls with current" in note for note in bent.notes)
    assert bent.parameters["torque_constant"].sd > 3 * straight.parameters["torque_constant"].sd
    beyond = [fit for fit in bent.fits if fit.held_out and "all currents" in fit.data]
    within = [fit for fit in bent.fits if fit.held_out and "up to" in fit.data]
    assert beyond[0].rms > 2 * within[0].rms  # the range stated is the range that holds


def test_what_is_held_out_is_not_in_the_fit():
    run = dyno(0, noise=0.0)
    assert all(fit.rms < 1e-6 for fit in torque_constant(run).fits)


@pytest.mark.parametrize(
    ("spoilt", "message"),
    [
        (lambda t: without(t, "shaft_torque"), "no column for 'shaft_torque', in N·m"),
        (lambda t: changed(t, motor_current=-t["motor_current"]), "a sign is wrong"),
        (lambda t: changed(t, motor_speed=t["motor_speed"] / 9.55), "mechanical_power is 9.5"),
        (lambda t: changed(t, ac_power=t["ac_power"] - 2000), r"planted.csv:\d+: ac_power is below the mechanical"),
        (lambda t: table(**{name: column[:7] for name, column in t.columns.items()}), "7 points are too few"),
        (lambda t: changed(t, motor_current=2 * t["motor_current"] + 400), "points up to 120 A are too few"),
    ],
)
def test_bad_dynamometer_data_are_refused(spoilt, message):
    with pytest.raises(InputError, match=message):
        torque_constant(spoilt(dyno(0)))


def test_bad_ramps_are_refused():
    with pytest.raises(InputError, match="4 points are too few"):
        voltage_constant(table(motor_speed=[1, 2, 3, 4], emf_line=[1, 2, 3, 4]))
    with pytest.raises(InputError, match="too narrow a range"):
        voltage_constant(table(motor_speed=[30, 31, 32, 33, 34], emf_line=[1, 2, 3, 4, 5]))
    with pytest.raises(InputError, match="falls where motor_speed rises"):
        voltage_constant(table(motor_speed=[1, 2, 3, 4, 5], emf_line=[5, 4, 3, 2, 1]))


@needs_data
def test_reference_motor_against_the_thesis():
    emf = voltage_constant(read_table(bench_file("motor_emf_ramp.csv")))
    assert min(fit.r2 or 0.0 for fit in emf.fits if fit.held_out) > 0.9993
    assert emf.parameters["voltage_constant"].value == pytest.approx(0.531, abs=0.002)
    result = torque_constant(read_table(bench_file("motor_dyno.csv")))
    assert min(fit.r2 or 0.0 for fit in result.fits if fit.held_out) > 0.9804
    assert result.parameters["torque_constant"].value == pytest.approx(0.4527, abs=0.003)
