"""The estimator's parts by themselves: what each decides on its own numbers."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gz_onboard.estimator.battery_pack import PACK, InnovationTest
from gz_onboard.estimator.battery_priors import PRIOR, VoltageNoise
from gz_onboard.estimator.plausibility.electrical import CurrentSource
from gz_onboard.estimator.signals import Signals
from gz_onboard.events import ROLES, Reason
from gz_onboard.model.parameters import Parameters
from gz_onboard.vehicle import read_vehicle
from tests.events import ShownSignals

VEHICLE = read_vehicle("reference")
SLOW = 1e-4  # V²
LOAD = 0.005**2  # V²
RESTARTED = 0.35**2  # V²


def everything(now: float = 0.0) -> Signals:
    signals = ShownSignals(*ROLES)
    signals.show(now, dict.fromkeys(ROLES, 3.0))
    return signals


def test_a_glitch_is_not_used_and_what_persists_is():
    gate = InnovationTest()
    assert gate.noise(0.1, 0.01, 0.0, SLOW, LOAD, RESTARTED) == pytest.approx(LOAD)
    used = [gate.noise(0.1, 0.3, 0.0, SLOW, LOAD, RESTARTED) is not None for _ in range(PACK.glitch_count)]
    assert used == [False] * (PACK.glitch_count - 1) + [True]
    assert gate.mismatch
    assert gate.contradicted < PACK.contradicted_s


def test_a_voltage_that_is_off_for_long_refutes_the_state():
    gate = InnovationTest()
    for _ in range(round(PACK.contradicted_s) - 1):
        gate.noise(1.0, 0.3, 0.0, SLOW, LOAD, RESTARTED)
    assert gate.contradicted < PACK.contradicted_s
    gate.noise(1.0, 0.3, 0.0, SLOW, LOAD, RESTARTED)
    assert gate.contradicted >= PACK.contradicted_s


def test_a_model_that_is_blamed_is_believed_again_only_once_it_follows():
    """However uncertain the state of charge is made by the same error."""
    gate, uncertain = InnovationTest(), 0.3**2
    for _ in range(round(PACK.contradicted_s)):
        gate.noise(1.0, 0.3, 0.0, SLOW, LOAD, RESTARTED)
    gate.blame_model(SLOW + LOAD)
    blamed = [gate.noise(1.0, 0.3, uncertain, SLOW, LOAD, RESTARTED) for _ in range(1800)]
    assert blamed[-1] == pytest.approx(0.3**2, rel=0.1)
    followed = [gate.noise(1.0, 0.01, uncertain, SLOW, LOAD, RESTARTED) for _ in range(7200)]
    assert followed[-1] == pytest.approx(LOAD)


def test_a_signal_that_is_left_out_or_stale_is_a_reason():
    signals = everything()
    missing = signals.missing
    assert missing(1.0) == Reason(0)
    signals.accel_x.trusted = False
    signals.gps_fix.value = 1.0
    signals.motor_speed.time = -10.0
    assert missing(1.0) == Reason.NO_IMU | Reason.NO_GPS
    assert missing(10.0) & Reason.NO_SPEED


def test_what_stays_for_hours_does_not_fade_with_the_error_of_the_circuit():
    """History, place on the curve and sensor stay: the better SOC is known, the more of the error does."""
    uncertainty = VoltageNoise(VEHICLE.pack, VEHICLE.parameters)
    slope = VEHICLE.pack.ocv(0.6)[1]
    times = [uncertainty.slow(0.6, slope, 25.0, sd**2)[1] for sd in (0.2, 0.05, 0.01, 0.003)]
    assert times == sorted(times)
    assert times[0] < 1.02 * uncertainty.error_time(25.0)
    assert 0.75 * PRIOR.history_s < times[-1] < PRIOR.history_s
    assert uncertainty.slow(0.6, slope, 10.0, 0.01**2)[0] > uncertainty.slow(0.6, slope, 25.0, 0.01**2)[0]


def test_resistances_that_are_guessed_make_a_loaded_voltage_worth_less():
    parameters = VEHICLE.parameters
    known = {**parameters.known}
    known["cell_resistance_factor"] = replace(known["cell_resistance_factor"], sd=0.5)
    measured, guessed = (VoltageNoise(VEHICLE.pack, p) for p in (parameters, Parameters(known)))
    fast = [noise.fast(0.04, (0.05, 0.03), CurrentSource.PACK, noise.resistance, 0.0) for noise in (measured, guessed)]
    assert fast[1] > 10 * fast[0]


def test_a_loaded_cell_errs_more_the_nearer_it_is_to_empty():
    noise, (empty, begins) = VoltageNoise(VEHICLE.pack, VEHICLE.parameters), PRIOR.empty
    near_empty, full = VEHICLE.parameters.sd("cell_voltage_error_empty"), VEHICLE.pack.voltage_error(25.0, noise.model)
    sds = [noise.loaded(soc, 25.0) for soc in (empty, (empty + begins) / 2, begins)]
    assert sds == pytest.approx([near_empty, (near_empty + full) / 2, full])
    assert full < near_empty
