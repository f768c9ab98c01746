"""The battery filter: its two backends, against a textbook filter, and its consistency over seeds."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.estimator.battery_filter import SCALAR, FilterState, Noise, condition, predict, with_soc
from gz_onboard.estimator.filterpy_reference import FILTERPY
from gz_onboard.pipeline import filter_backend

UPPER = np.triu_indices(4)
START = FilterState(0.6, 0.002, 1.02, 1.1, (0.01, -1e-4, -4e-4, 0.0, 1e-4, 1e-6, 0.0, 0.012, 0.0, 0.17))

steps = st.tuples(
    st.floats(-0.01, 0.05),  # charge
    st.floats(0.5, 1.0),  # decay of the error
    st.tuples(st.floats(0.1, 8.0), st.sampled_from([-1.0, 0.0, 0.1]), st.sampled_from([0.0, 0.03, -0.1])),  # slopes
    st.floats(-0.05, 0.05),  # residual
    st.floats(1e-5, 1.0),  # variance
    st.sampled_from([0.0, 1e-4, 0.011, inf]),  # least variance of the inverse capacity
)


def matrix(state: FilterState) -> np.ndarray:
    full = np.zeros((4, 4))
    full[UPPER] = state.covariance
    return full + np.triu(full, 1).T


@settings(max_examples=100, deadline=None)
@given(st.lists(steps, min_size=1, max_size=30))
def test_both_backends_are_equal(ride):
    a = b = START
    for charge, decay, slopes, residual, variance, least in ride:
        noise = Noise(1e-8, 4e-5, decay, 1e-7, 1e-6)
        a, b = SCALAR.predict(a, charge, 0.01, noise), FILTERPY.predict(b, charge, 0.01, noise)
        a = SCALAR.condition(a, slopes, residual, variance, least)
        b = FILTERPY.condition(b, slopes, residual, variance, least)
        assert a[:4] == pytest.approx(b[:4], abs=1e-9)
        assert a.v1 == b.v1 == 0.01
        assert a.covariance == pytest.approx(b.covariance, abs=1e-9)


@given(st.lists(steps, min_size=1, max_size=60))
def test_covariance_stays_positive(ride):
    state = START
    for charge, decay, slopes, residual, variance, least in ride:
        state = predict(state, charge, 0.0, Noise(1e-9, 4e-5, decay, 1e-7, 1e-6))
        state = condition(state, slopes, residual, variance * 1e-2, least)
        sds = np.sqrt(np.diag(matrix(state)))
        assert np.linalg.eigvalsh(matrix(state) / np.outer(sds, sds)).min() > -1e-9


def test_condition_against_the_textbook():
    """Simon 2006, eqs. 13.30-13.32, written out with matrices."""
    h, residual, variance = np.array([[0.8, -1.0, 0.0, -0.05]]), 0.03, 4e-4
    p = matrix(START)
    s = float((h @ p @ h.T)[0, 0] + variance)
    k = p @ h.T / s
    found = condition(START, (0.8, -1.0, -0.05), residual, variance, 0.0)
    assert found[:4] == pytest.approx(np.array(START[:4]) + k[:, 0] * residual, rel=1e-12)
    assert found.covariance == pytest.approx(((np.eye(4) - k @ h) @ p)[UPPER], rel=1e-9, abs=1e-15)


def test_two_rests_and_the_charge_between_show_the_capacity():
    """40 % of the file's charge out of a pack that holds 0.8: SOC falls by half."""
    state = with_soc(START, 0.9, 0.005**2)._replace(inverse_capacity=1.0)
    state = predict(state, 0.4, 0.0, Noise(4e-7, 4e-5, 0.9))
    state = condition(state, (1.0, 0.0, 0.0), 0.9 - 0.4 / 0.8 - state.soc, 0.006**2, 0.0)
    assert 1 / state.inverse_capacity == pytest.approx(0.8, abs=0.02)


def simulate(seed, seconds=1500, white=2e-3, slope=0.7):
    """A cell of the filter's own equations with its own noise: consistency is defined on that."""
    rng = np.random.default_rng(seed)
    noise = Noise(1e-9, 6e-3**2, np.exp(-1 / 300.0))
    error_sd = np.sqrt(noise.error * (1 - noise.error_decay**2))
    sds = np.array([0.05, 6e-3, 0.1, 0.2])
    state = FilterState(0.8, 0.0, 1.0, 1.0, tuple(np.diag(sds**2)[UPPER].tolist()))
    truth = np.array(state[:4]) + sds * rng.standard_normal(4)
    nis = nees = 0.0
    for step in range(seconds):
        drop = 0.05 + 0.05 * np.sin(step / 40)
        truth[0] += 3e-5 * rng.standard_normal() - truth[2] * 2.8e-4
        truth[1] = noise.error_decay * truth[1] + error_sd * rng.standard_normal()
        state = predict(state, 2.8e-4, 0.0, noise)
        h = np.array([slope, -1.0, 0.0, -drop])
        residual = float(h @ (truth - np.array(state[:4]))) + white * rng.standard_normal()
        nis += residual**2 / float(h @ matrix(state) @ h + white**2)
        state = condition(state, (slope, -1.0, -drop), residual, white**2, 0.0)
        error = np.array(state[:4]) - truth
        nees += float(error @ np.linalg.solve(matrix(state), error))
    return nis / seconds, nees / seconds


def test_consistent_over_seeds():
    """Bar-Shalom 2001, sec. 5.4: the mean NIS is 1 and the mean NEES is 4 for a consistent filter of this size."""
    results = np.array([simulate(seed) for seed in range(24)])
    assert 0.95 < results[:, 0].mean() < 1.05
    assert 3.0 < results[:, 1].mean() < 5.0


def test_filter_backend():
    assert filter_backend("scalar") is SCALAR
    assert filter_backend("filterpy") is FILTERPY


def test_a_wrong_start_is_left_at_once_and_the_same_error_is_not_counted_twice():
    """20 % off: one voltage tells as much as the circuit is good for, and a hundred of the same error no more."""
    slope, truth, error = 0.7, 0.6, 0.01**2
    for backend in (SCALAR, FILTERPY):
        state = FilterState(truth - 0.2, 0.0, 1.0, 1.0, (0.04, 0.0, 0.0, 0.0, error, 0.0, 0.0, 0.01, 0.0, 0.1))
        known = []
        for _ in range(100):
            state = backend.predict(state, 0.0, 0.0, Noise(0.0, error, np.exp(-1 / 600)))
            residual = slope * (truth - state.soc) + state.error
            state = backend.condition(state, (slope, -1.0, 0.0), residual, 0.003**2, inf)
            known.append(state.covariance[0] ** 0.5)
        assert state.soc == pytest.approx(truth, abs=0.02)
        assert known[0] < 2 * error**0.5 / slope
        assert known[-1] > 0.75 * error**0.5 / slope
