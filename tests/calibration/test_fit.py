from __future__ import annotations

import numpy as np
import pytest

from gz_onboard.calibration.fit import correlation, linear, nonlinear
from gz_onboard.errors import InputError

SEEDS = 400


def inside(found, truth):
    """Whether each parameter lies within its 95 % interval."""
    return np.array([abs(found[name] - truth[name]) < 1.96 * found.sd(name) for name in found.names])


def test_linear_and_nonlinear_agree():
    rng = np.random.default_rng(0)
    x = np.linspace(0, 3, 60)
    y = 2 + 0.7 * x + rng.normal(0, 0.1, 60)
    a = linear({"a": np.ones(60), "b": x}, y, 0.1, prior={"b": (0.6, 0.05)})
    b = nonlinear(lambda p: (p[0] + p[1] * x - y) / 0.1, {"a": 1.0, "b": 1.0}, prior={"b": (0.6, 0.05)}, known_sd=True)
    assert np.allclose(a.value, b.value, rtol=1e-5)
    assert np.allclose(a.covariance, b.covariance, rtol=1e-4)


@pytest.mark.parametrize("known", [True, False])
def test_intervals_hold_95_percent(known):
    x = np.linspace(0, 1, 30)
    truth = {"a": 1.0, "b": -2.0, "c": 0.5}
    held = np.zeros(3)
    for seed in range(SEEDS):
        y = 1 - 2 * x + 0.5 * x**2 + np.random.default_rng(seed).normal(0, 0.2, 30)
        held += inside(linear({"a": np.ones(30), "b": x, "c": x**2}, y, 0.2 if known else None), truth)
    assert np.all((held / SEEDS > 0.90) & (held / SEEDS < 0.99))


def test_groups_hold_where_the_samples_of_a_run_depend_on_each_other():
    runs, each = 20, 50
    labels = np.repeat(np.arange(runs), each)
    held = {True: 0, False: 0}
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        x = np.repeat(rng.normal(size=runs), each) + 0.1 * rng.normal(size=runs * each)
        y = 3 * x + np.repeat(rng.normal(size=runs), each) + 0.1 * rng.normal(size=runs * each)
        for grouped in held:
            held[grouped] += inside(linear({"k": x}, y, groups=labels if grouped else None), {"k": 3.0})[0]
    assert held[True] / SEEDS > 0.88  # 20 groups: the sandwich is known to be a little short
    assert held[False] / SEEDS < 0.5  # what taking all samples as independent would claim


def test_a_prior_is_weighed_against_the_data_and_grows_when_they_say_nothing():
    ones = np.ones(10)
    found = linear({"a": ones, "b": ones}, 5 * ones, 1.0, prior={"a": (2.0, 0.1)})
    assert found["a"] == pytest.approx(2) and found["b"] == pytest.approx(3)
    assert found.sd("a") == pytest.approx(0.1) and found.sd("b") == pytest.approx(np.hypot(0.1, 1 / np.sqrt(10)))
    assert correlation(found.covariance)[0, 1] < 0
    with pytest.raises(InputError, match="cannot separate a and b"):
        linear({"a": ones, "b": ones}, 5 * ones)


def test_refusals():
    with pytest.raises(InputError, match="1 points are too few for 2 parameters"):
        linear({"a": np.ones(1), "b": np.ones(1)}, np.ones(1))
    with pytest.raises(InputError, match="b is not identifiable"):
        linear({"a": np.ones(5), "b": np.zeros(5)}, np.ones(5))
    with pytest.raises(InputError, match="k is not identifiable"):
        nonlinear(lambda p: p[:1] - np.ones(4), {"a": 0.0, "k": 1.0})
