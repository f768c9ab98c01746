from __future__ import annotations

import numpy as np
import pytest

from gz_onboard.calibration.motor import TIED, inverter_losses, motor_losses, torque_constant
from gz_onboard.calibration.table import read_table
from gz_onboard.errors import InputError

from .bench import INVERTER, MOTOR, bench_file, changed, dyno, needs_data

SEEDS = 200


@pytest.mark.parametrize(("procedure", "truth"), [(motor_losses, MOTOR), (inverter_losses, INVERTER)])
def test_losses_come_back_within_their_own_intervals(procedure, truth):
    names = [name for name in truth if name != "torque_constant"]
    held = dict.fromkeys(names, 0)
    for seed in range(SEEDS):
        result = procedure(dyno(seed))
        for name in names:
            found = result.parameters[name]
            held[name] += abs(found.value - truth[name]) < 1.96 * found.sd
    assert all(0.90 <= count / SEEDS <= 0.99 for count in held.values()), held


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


def test_a_narrow_range_of_temperature_is_told():
    run = dyno(0)
    narrow = changed(run, motor_temperature=np.full(len(run), 35.0))
    assert any("spans 0 K" in refusal for refusal in motor_losses(narrow).refusals)


def test_an_inverter_that_would_give_energy_is_refused():
    run = dyno(0)
    with pytest.raises(InputError, match=r"planted.csv:\d+: dc_power is below ac_power"):
        inverter_losses(changed(run, dc_power=run["ac_power"], ac_power=run["dc_power"]))
    with pytest.raises(InputError, match="too few for a loss over current"):
        inverter_losses(changed(run, motor_current=run["motor_current"] * 1e-3))


@needs_data
def test_reference_losses_against_the_thesis():
    run = read_table(bench_file("motor_dyno.csv"))
    motor, inverter = motor_losses(run), inverter_losses(run)
    assert min(fit.r2 or 0.0 for fit in motor.fits if fit.held_out) > 0.98 > 0.8774
    assert [(fit.r2 or 0.0) > 0.9949 for fit in inverter.fits if "all currents" in fit.data] == [True]
    assert any("grows with speed" in note for note in motor.notes)
