"""The battery filter by filterpy's ExtendedKalmanFilter, as a reference. Imports numpy and scipy: 1.5 s and 70 MB."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from gz_onboard.estimator.battery_filter import Backend, Covariance, FilterState, Noise

UPPER = np.triu_indices(4)


def _filter_of(state: FilterState) -> Any:
    """An ExtendedKalmanFilter with this state."""
    ekf = ExtendedKalmanFilter(dim_x=4, dim_z=1)
    ekf.x = np.array(state[:4]).reshape(4, 1)
    ekf.P[UPPER] = state.covariance
    ekf.P = np.triu(ekf.P) + np.triu(ekf.P, 1).T
    return ekf


def _state_of(ekf: Any, v1: float) -> FilterState:
    """The state of an ExtendedKalmanFilter, with the overpotential `v1` [V]."""
    soc, error, inverse_capacity, resistance = ekf.x[:, 0].tolist()
    covariance = cast("Covariance", tuple(ekf.P[UPPER].tolist()))
    return FilterState(soc, error, inverse_capacity, resistance, covariance, v1)


def predict(state: FilterState, charge: float, v1: float, noise: Noise) -> FilterState:
    """See `battery_filter.predict`."""
    ekf = _filter_of(state)
    ekf.F = np.diag([1.0, noise.error_decay, 1.0, 1.0])
    ekf.F[0, 2] = -charge
    ekf.Q = np.diag([noise.soc, noise.error * (1 - noise.error_decay**2), noise.capacity, noise.resistance])
    ekf.predict()
    return _state_of(ekf, v1)


def condition(
    state: FilterState,
    slopes: tuple[float, float, float],
    residual: float,
    variance: float,
    min_capacity_variance: float,
) -> FilterState:
    """See `battery_filter.condition`."""
    ekf, h = _filter_of(state), np.array([[slopes[0], slopes[1], 0.0, slopes[2]]])
    measured = h @ ekf.x + residual
    ekf.update(measured, lambda x: h, lambda x: h @ x, R=variance)
    before, reduction = state.covariance[7], state.covariance[7] - ekf.P[2, 2]
    share = min(max(before - min_capacity_variance, 0.0) / reduction, 1.0) if reduction > 0 else 0.0
    ekf.x[2, 0] = state.inverse_capacity + share * (ekf.x[2, 0] - state.inverse_capacity)
    ekf.P[2, 2] = before - share * reduction
    return _state_of(ekf, state.v1)


FILTERPY = Backend(predict, condition)
