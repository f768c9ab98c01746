"""The linear mixed model: normal equations, their borders, what is free, what is fitted together."""

from __future__ import annotations

import numpy as np
import pytest

from gz_onboard.arrays import Array, Mask
from gz_onboard.discovery.candidates import Candidate
from gz_onboard.discovery.channels import CHANNEL, ChannelNoise
from gz_onboard.discovery.grid import Ride
from gz_onboard.discovery.linear import LinearChannel, LinearRide, Normal, likelihoods, normal, whitened
from gz_onboard.discovery.mixed_model import MixedModel, initial
from gz_onboard.discovery.search import Evidence, Search
from gz_onboard.vehicle import read_vehicle

NOISE = ChannelNoise(white=2.0, slow=1.5, time=30.0)
RIDE = Ride("made up", np.zeros(0), {}, {}, 0.25, None)


def table(columns: Array, y: Array) -> LinearChannel:
    m = len(y)
    used: Mask = np.ones(m, dtype=bool)
    even: Array = np.ones(m)
    time: Array = 4.0 * np.arange(m, dtype=np.float64)
    return LinearChannel(CHANNEL["road_force"], y, columns, time, used, roughness=even)


@pytest.fixture(scope="module")
def mixed() -> MixedModel:
    return initial(read_vehicle("reference"))


def test_a_border_is_what_the_wider_matrix_gives():
    rng = np.random.default_rng(2)
    a, more, y = rng.normal(size=(80, 6)), rng.normal(size=(80, 2)), rng.normal(size=80)
    a[:, 4] = 0.0
    narrow, wide = table(a, y), table(np.column_stack([a, more]), y)
    expected = normal(LinearRide(RIDE, {"road_force": wide}), {"road_force": NOISE})
    plain = normal(LinearRide(RIDE, {"road_force": narrow}), {"road_force": NOISE}).padded(2)
    assert not plain.n[6:].any() and not plain.b[6:].any()
    for own in (slice(6), narrow.touched):
        found = plain.with_columns(narrow, NOISE, more, own)
        assert found.n == pytest.approx(expected.n)
        assert found.b == pytest.approx(expected.b)
    assert narrow.touched.tolist() == [0, 1, 2, 3, 5]


def test_whitening_and_likelihood_are_those_of_the_noises_covariance():
    rng = np.random.default_rng(4)
    rows = table(np.zeros((40, 1)), rng.normal(size=40))
    apart = np.abs(np.subtract.outer(rows.time, rows.time))
    covariance = NOISE.white**2 * np.eye(40) + NOISE.slow**2 * np.exp(-apart / NOISE.time)
    white = whitened(rows, NOISE, rows.y)
    assert white @ white == pytest.approx(rows.y @ np.linalg.solve(covariance, rows.y))
    columns = whitened(rows, NOISE, np.column_stack([rows.y, 2 * rows.y]))
    assert columns == pytest.approx(np.column_stack([white, 2 * white]))
    ratio, time = np.array([0.0, NOISE.slow / NOISE.white]), np.full(2, NOISE.time)
    quadratic, logarithm = likelihoods(rows.time, rows.y, ratio, time)
    assert quadratic == pytest.approx([rows.y @ rows.y, white @ white * NOISE.white**2])
    assert logarithm == pytest.approx([0.0, np.linalg.slogdet(covariance / NOISE.white**2).logabsdet])


def test_the_spread_of_one_block():
    assert NOISE.sd == pytest.approx(2.5)


def test_what_is_free_is_what_the_rides_say(mixed: MixedModel):
    p = len(mixed.names)
    (i,) = mixed.index(["payload_mass"])
    n, b = np.zeros((p, p)), np.zeros(p)
    n[i, i], b[i] = 4.0, 12.0
    rides = [Normal(n, b)] * 3
    held, wide, free = (m.fit(rides).mean[i] for m in (mixed, mixed.widened(), mixed.freed([i])))
    assert 0 < held < wide < free
    assert free == pytest.approx(3.0, rel=1e-4)
    assert mixed.fit(rides).scatter is not mixed.scatter
    assert (mixed.fit(rides).scatter == mixed.scatter).all()
    assert mixed.index_of(mixed.usable_causes[:2]) == mixed.index(
        [name for cause in mixed.usable_causes[:2] for name in cause.names]
    )


def test_causes_are_fitted_together(mixed: MixedModel):
    causes: list[Candidate] = [c for c in mixed.usable_causes if len(c.names) == 2][:1] + mixed.usable_causes[:2]
    rng = np.random.default_rng(3)
    root = rng.normal(size=(len(mixed.names), len(mixed.names)))
    search = Search(mixed, Evidence(root @ root.T, rng.normal(size=len(mixed.names))), causes)
    names = [c.name for c in causes]
    found = search.fitted(names)
    index = search.index(names)
    assert np.concatenate([found[name][0] for name in names]) == pytest.approx(search.evidence.estimate(index))
    variance = np.diag(search.evidence.covariance(index))
    assert np.concatenate([found[name][1] for name in names]) == pytest.approx(variance)
    assert [len(found[c.name][0]) for c in causes] == [len(c.names) for c in causes]
    assert search.part(names, names[0]) == search.step(names[1:], names[0])
