"""The SOC filter: its two backends, against a textbook filter, and its consistency over seeds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.estimator.ekf import Noise, ScalarFilter
from gz_onboard.estimator.ekf_filterpy import FilterpyFilter
from gz_onboard.pipeline import filter_maker
from gz_onboard.vehicle import read_vehicle

BATTERY = read_vehicle("reference").pack

steps = st.tuples(
    st.floats(0.02, 2.0),  # dt
    st.floats(-4, 9),  # cell current
    st.floats(-10, 45),  # temperature
    st.floats(-0.05, 0.05),  # voltage off the prediction
    st.floats(1e-5, 1.0),  # variance
)


@settings(max_examples=200)
@given(st.floats(0.05, 0.95), st.lists(steps, min_size=1, max_size=40))
def test_both_backends_are_equal(soc, ride):
    start = (0.01, -1e-4, 1e-4)
    a, b = ScalarFilter(BATTERY, soc, 0.01, start), FilterpyFilter(BATTERY, soc, 0.01, start)
    for dt, current, temperature, off, variance in ride:
        noise = Noise(1e-10 * dt, 4e-5, 300.0)
        a.predict(dt, current, temperature, noise)
        b.predict(dt, current, temperature, noise)
        voltage = BATTERY.ocv(a.soc)[0] - BATTERY.r0.at(a.soc, temperature)[0] * current - a.v1 + off
        assert a.innovation(voltage, current, temperature) == pytest.approx(
            b.innovation(voltage, current, temperature), abs=1e-9
        )
        a.update(voltage, current, temperature, variance)
        b.update(voltage, current, temperature, variance)
        assert (a.soc, a.v1, a.error) == pytest.approx((b.soc, b.v1, b.error), abs=1e-9)
        assert a.covariance == pytest.approx(b.covariance, abs=1e-9)


@given(st.floats(0.05, 0.95), st.lists(steps, min_size=1, max_size=60))
def test_covariance_stays_symmetric_and_positive(soc, ride):
    a = ScalarFilter(BATTERY, soc, 0.0, (0.25, 0.0, 1e-4))
    for dt, current, temperature, off, variance in ride:
        a.predict(dt, current, temperature, Noise(1e-10 * dt, 4e-5, 300.0))
        voltage = BATTERY.ocv(a.soc)[0] - BATTERY.r0.at(a.soc, temperature)[0] * current - a.v1 + off
        a.update(voltage, current, temperature, variance * 1e-4)
        p00, p01, p11 = a.covariance
        assert p00 > 0
        assert p11 > 0
        assert p00 * p11 - p01 * p01 >= -1e-12 * p00 * p11


@given(st.floats(0.05, 0.95), st.floats(-4, 9), st.floats(-10, 45))
def test_jacobian_against_differences(soc, current, temperature):
    if any(abs(soc - knot) < 1e-5 for knot in (*BATTERY.ocv_curve.x, *BATTERY.r0.soc)):
        return
    h = 1e-7
    one, other = (ScalarFilter(BATTERY, soc + d, 0.0, (1.0, 0.0, 0.0)) for d in (-h, h))
    derivative = (one.innovation(0, current, temperature)[0] - other.innovation(0, current, temperature)[0]) / (2 * h)
    middle = ScalarFilter(BATTERY, soc, 0.0, (1.0, 0.0, 0.0))
    assert middle.innovation(0, current, temperature)[1] == pytest.approx(derivative**2, rel=1e-3, abs=1e-5)


def test_update_against_the_textbook():
    """Simon 2006, eqs. 13.30-13.32, written out with matrices."""
    covariance = np.array([[0.02, -1e-4], [-1e-4, 3e-4]])
    f = ScalarFilter(BATTERY, 0.62, 0.02, (0.02, -1e-4, 3e-4))
    current, temperature, voltage, variance = 2.0, 18.0, 3.71, 4e-4
    ocv, slope = BATTERY.ocv(0.62)
    r0, r0_slope = BATTERY.r0.at(0.62, temperature)
    h = np.array([[slope - current * r0_slope, -1.0]])
    s = h @ covariance @ h.T + variance
    k = covariance @ h.T / s
    x = np.array([[0.62], [0.02]]) + k * (voltage - (ocv - r0 * current - 0.02))
    p = (np.eye(2) - k @ h) @ covariance
    f.update(voltage, current, temperature, variance)
    assert (f.soc, f.v1 + f.error) == pytest.approx(x.ravel(), rel=1e-12)
    assert f.covariance == pytest.approx((p[0, 0], p[0, 1], p[1, 1]), rel=1e-9)


def simulate(seed, seconds=1500, dt=1.0, white=2e-3):
    """A cell of the filter's own circuit with the filter's own noise: what consistency is defined on."""
    rng = np.random.default_rng(seed)
    soc0, sd0, temperature = 0.8, 0.05, 25.0
    noise = Noise(1e-9 * dt, 6e-3**2, 300.0)
    left = np.exp(-dt / noise.time)
    true_soc, true_v1, true_e = soc0 + sd0 * rng.standard_normal(), 0.0, np.sqrt(noise.error) * rng.standard_normal()
    f = ScalarFilter(BATTERY, soc0, 0.0, (sd0**2, 0.0, noise.error))
    nis = nees = 0.0
    for step in range(int(seconds / dt)):
        current = 2.5 + 2.5 * np.sin(step / 40) + (step % 90 < 20) * 3.0
        r1, c1 = (mesh.at(true_soc, temperature)[0] for mesh in (BATTERY.r1, BATTERY.c1))
        true_v1, _ = BATTERY.relax(dt, true_v1, current, r1, c1)
        true_e = left * true_e + np.sqrt(noise.error * (1 - left**2)) * rng.standard_normal()
        true_soc += (
            -current * dt / 3600 / BATTERY.cell_capacity(temperature) + np.sqrt(noise.soc) * rng.standard_normal()
        )
        voltage = BATTERY.ocv(true_soc)[0] - BATTERY.r0.at(true_soc, temperature)[0] * current - true_v1 - true_e
        voltage += white * rng.standard_normal()
        f.predict(dt, current, temperature, noise)
        error, own = f.innovation(voltage, current, temperature)
        nis += (error + f.error) ** 2 / (own + white**2)
        f.update(voltage, current, temperature, white**2)
        p = np.array([[f.covariance[0], f.covariance[1]], [f.covariance[1], f.covariance[2]]])
        e = np.array([f.soc - true_soc, f.error - true_e])
        nees += float(e @ np.linalg.solve(p, e))
    n = int(seconds / dt)
    return nis / n, nees / n


def test_consistent_over_seeds():
    """Bar-Shalom 2001, sec. 5.4: the mean NIS is 1 and the mean NEES is 2 for a consistent filter of this size."""
    results = np.array([simulate(seed) for seed in range(24)])
    assert 0.95 < results[:, 0].mean() < 1.05
    assert 1.5 < results[:, 1].mean() < 3.0  # the slope of the curve is not that of the true state of charge


def test_filter_maker():
    assert filter_maker("scalar") is ScalarFilter
    assert filter_maker("filterpy") is FilterpyFilter


def test_a_wrong_start_is_left_at_once_and_the_same_error_is_not_counted_twice():
    """20 % off: one voltage tells as much as the circuit is good for, and a hundred of the same error no more."""
    noise, temperature, truth = Noise(0.0, 0.01**2, 600.0), 25.0, 0.6
    volts, slope = BATTERY.ocv(truth)
    for backend in (ScalarFilter, FilterpyFilter):
        f = backend(BATTERY, truth - 0.2, 0.0, (0.2**2, 0.0, noise.error))
        knows = []
        for _ in range(100):
            f.predict(1.0, 0.0, temperature, noise)
            f.update(volts, 0.0, temperature, 0.003**2)
            knows.append(f.covariance[0] ** 0.5)
        assert f.soc == pytest.approx(truth, abs=0.02)
        assert knows[0] < 2 * noise.error**0.5 / slope
        assert knows[-1] > 0.75 * noise.error**0.5 / slope


def test_a_polarisation_from_before_fades_as_the_pair_does():
    noise, temperature = Noise(0.0, 0.005**2, 600.0), 25.0
    f = ScalarFilter(BATTERY, 0.6, 0.0, (0.2**2, 0.0, 0.05**2))
    tau = BATTERY.r1.at(0.6, temperature)[0] * BATTERY.c1.at(0.6, temperature)[0]
    for _ in range(int(4 * tau)):
        f.predict(1.0, 0.0, temperature, noise)
    assert f.covariance[2] ** 0.5 == pytest.approx(0.005, rel=0.05)
