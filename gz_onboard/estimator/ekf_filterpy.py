"""The reference backend: filterpy's ExtendedKalmanFilter. Imports numpy and scipy: 1.5 s and 70 MB."""

from __future__ import annotations

from math import exp

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from numpy.typing import NDArray

from gz_onboard.estimator.ekf import NEAR, TURNS, Covariance, Noise
from gz_onboard.physics.battery import Battery


class _Ekf(ExtendedKalmanFilter):  # type: ignore[misc]
    """filterpy's, with a state that the battery's own equations predict instead of F·x + B·u."""

    advanced: NDArray[np.float64]  # (2, 1): the next state

    def predict_x(self, u: float = 0) -> None:
        self.x = self.advanced


class FilterpyFilter:
    """`SocFilter` by filterpy."""

    def __init__(self, battery: Battery, soc: float, v1: float, covariance: Covariance) -> None:
        self.battery = battery
        self.v1 = v1
        self._ekf = _Ekf(dim_x=2, dim_z=1)
        self._ekf.x = np.array([[soc], [0.0]])
        self.covariance = covariance

    @property
    def soc(self) -> float:
        """State of charge, 0..1."""
        return float(self._ekf.x[0, 0])

    @soc.setter
    def soc(self, value: float) -> None:
        self._ekf.x[0, 0] = value

    @property
    def error(self) -> float:
        """What the circuit errs by [V]."""
        return float(self._ekf.x[1, 0])

    @error.setter
    def error(self, value: float) -> None:
        self._ekf.x[1, 0] = value

    @property
    def covariance(self) -> Covariance:
        """var(SOC), cov(SOC, e) [V], var(e) [V²]."""
        p = self._ekf.P
        return float(p[0, 0]), float(p[0, 1]), float(p[1, 1])

    @covariance.setter
    def covariance(self, value: Covariance) -> None:
        self._ekf.P = np.array([[value[0], value[1]], [value[1], value[2]]])

    def predict(self, dt: float, current: float, temperature: float, noise: Noise) -> None:
        """See `SocFilter`."""
        soc, self.v1, fading = self.battery.advanced(dt, self.soc, self.v1, current, temperature)
        left = fading if self.covariance[2] > noise.error else exp(-dt / noise.time)
        self._ekf.F, self._ekf.Q = np.diag([1.0, left]), np.diag([noise.soc, noise.error * (1 - left**2)])
        self._ekf.advanced = np.array([[soc], [left * self.error]])
        self._ekf.predict()

    def _predicted(self, x: NDArray[np.float64], current: float, temperature: float) -> NDArray[np.float64]:
        voltage, _ = self.battery.terminal_voltage(float(x[0, 0]), self.v1, current, temperature)
        return np.array([[voltage - float(x[1, 0])]])  # (1, 1): a scalar would turn x into 2×2

    def _jacobian(self, x: NDArray[np.float64], current: float, temperature: float) -> NDArray[np.float64]:
        _, slope = self.battery.terminal_voltage(float(x[0, 0]), self.v1, current, temperature)
        return np.array([[slope, -1.0]])

    def innovation(self, voltage: float, current: float, temperature: float) -> tuple[float, float]:
        """See `SocFilter`."""
        h = self._jacobian(self._ekf.x, current, temperature)
        predicted = float(self._predicted(self._ekf.x, current, temperature)[0, 0]) + self.error
        return voltage - predicted, float((h @ self._ekf.P @ h.T)[0, 0])

    def update(self, voltage: float, current: float, temperature: float, variance: float) -> None:
        """See `SocFilter`."""
        z, r, before, p = np.array([[voltage]]), np.array([[variance]]), self._ekf.x, self._ekf.P
        at = before
        for _ in range(TURNS):
            h = self._jacobian(at, current, temperature)
            line = self._predicted(at, current, temperature) + h @ (before - at)
            after = before + p @ h.T @ np.linalg.inv(h @ p @ h.T + r) @ (z - line)
            last, at = at, after
            if abs(after[0, 0] - last[0, 0]) < NEAR:
                break
        self._ekf.update(z, lambda x: h, lambda x: line, R=r)
