"""Constants and losses of motor and inverter out of a simulated dynamometer."""

from __future__ import annotations

import numpy as np
import pytest

from gz_onboard.calibration.motor import TIED, inverter_losses, motor_losses, torque_constant, voltage_constant
from gz_onboard.errors import InputError

from .bench import INVERTER, MOTOR, changed, dyno, table, without

SEEDS = 200


def ramp(seed, noise=0.04, constant=0.53):
    speed = np.linspace(1, 40, 70)
    return table(motor_speed=speed, emf_line=constant * speed + noise * np.random.default_rng(seed).normal(size=70))


@pytest.mark.parametrize(
    ("procedure", "data", "truth"),
    [
        (voltage_constant, ramp, {"voltage_constant": 0.53}),
        (torque_constant, dyno, {"torque_constant": MOTOR["torque_constant"]}),
        (motor_losses, dyno, {name: MOTOR[name] for name in MOTOR if name != "torque_constant"}),
        (inverter_losses, dyno, INVERTER),
    ],
)
def test_parameters_come_back_within_their_own_intervals(procedure, data, truth):
    held = dict.fromkeys(truth, 0)
    for seed in range(SEEDS):
        found = procedure(data(seed)).parameters
        for name, value in truth.items():
            held[name] += abs(found[name].value - value) < 1.96 * found[name].sd
    assert all(0.90 <= count / SEEDS <= 0.99 for count in held.values()), held


def test_saturation_is_told_and_held_by_the_sd():
    straight, bent = torque_constant(dyno(0)), torque_constant(dyno(0, saturation=5e-7))
    assert not any("falls with current" in note for note in straight.notes)
    assert any("falls with current" in note for note in bent.notes)
    assert bent.parameters["torque_constant"].sd > 3 * straight.parameters["torque_constant"].sd
    beyond = [fit for fit in bent.fits if fit.held_out and "all currents" in fit.data]
    within = [fit for fit in bent.fits if fit.held_out and "up to" in fit.data]
    assert beyond[0].rms > 2 * within[0].rms  # the range stated is the range that holds


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


@pytest.mark.parametrize(
    ("speed", "emf", "message"),
    [
        ([1, 2, 3, 4], [1, 2, 3, 4], "4 points are too few"),
        ([30, 31, 32, 33, 34], [1, 2, 3, 4, 5], "too narrow a range"),
        ([1, 2, 3, 4, 5], [5, 4, 3, 2, 1], "falls where motor_speed rises"),
    ],
)
def test_bad_ramps_are_refused(speed, emf, message):
    with pytest.raises(InputError, match=message):
        voltage_constant(table(motor_speed=speed, emf_line=emf))


def test_without_noise_everything_is_found_exactly():
    run = dyno(0, noise=0.0)
    for result, truth in ((motor_losses(run), MOTOR), (inverter_losses(run), INVERTER)):
        for name in set(truth) & set(result.parameters):
            assert result.parameters[name].value == pytest.approx(truth[name], rel=1e-6)
        assert all(fit.rms < 1e-6 for fit in result.fits)


def test_tied_parameters_have_the_covariance_of_one_fit():
    run = dyno(3)
    result = motor_losses(run)
    ((names, covariance),) = result.covariance
    assert names == TIED
    found = [result.parameters[name].sd for name in TIED[1:]]
    assert np.allclose(np.sqrt(np.diag(covariance))[1:], found)
    assert covariance[0, 0] ** 0.5 == pytest.approx(torque_constant(run).parameters["torque_constant"].sd, rel=0.5)
    assert covariance[2, 3] < 0  # more of one iron term is less of the other


def test_copper_loss_that_grows_with_speed_is_found_and_held_at_zero_where_it_does_not():
    run = dyno(0)
    more = 0.2 * 0.017 * run["motor_current"] ** 2 * (run["motor_speed"] / 57) ** 2
    result = motor_losses(changed(run, ac_power=run["ac_power"] + more))
    found = result.parameters["motor_copper_frequency"]
    assert abs(found.value - 0.2 / 57**2 / (1 + 0.00393 * 30)) < 3 * found.sd  # of a winding at 55 degC on average
    assert found.sd < 0.15 * found.value and any("copper loss grows with speed" in note for note in result.notes)
    plain = motor_losses(run).parameters["motor_copper_frequency"]
    assert plain.value == 0.0 and 0 < plain.sd < 1e-5


def test_an_inverter_that_would_give_energy_is_refused():
    run = dyno(0)
    with pytest.raises(InputError, match=r"planted.csv:\d+: dc_power is below ac_power"):
        inverter_losses(changed(run, dc_power=run["ac_power"], ac_power=run["dc_power"]))
    with pytest.raises(InputError, match="too few for a loss over current"):
        inverter_losses(changed(run, motor_current=run["motor_current"] * 1e-3))
