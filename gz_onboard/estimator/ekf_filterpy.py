"""The reference backend: filterpy's ExtendedKalmanFilter. Imports numpy and scipy: 1.5 s and 70 MB."""

from __future__ import annotations

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from numpy.typing import NDArray

from gz_onboard.estimator.ekf import Covariance
from gz_onboard.physics.battery import Battery


class FilterpyFilter:
    """`SocFilter` by filterpy."""

    def __init__(self, battery: Battery, soc: float, v1: float, covariance: Covariance) -> None:
        self.battery = battery
        self._ekf = ExtendedKalmanFilter(dim_x=2, dim_z=1, dim_u=1)
        self._ekf.x = np.array([[soc], [v1]])
        self.covariance = covariance

    @property
    def soc(self) -> float:
        """State of charge, 0..1."""
        return float(self._ekf.x[0, 0])

    @soc.setter
    def soc(self, value: float) -> None:
        self._ekf.x[0, 0] = value

    @property
    def v1(self) -> float:
        """Voltage over the RC pair [V]."""
        return float(self._ekf.x[1, 0])

    @v1.setter
    def v1(self, value: float) -> None:
        self._ekf.x[1, 0] = value

    @property
    def covariance(self) -> Covariance:
        """var(SOC), cov(SOC, V1) [V], var(V1) [V²]."""
        p = self._ekf.P
        return float(p[0, 0]), float(p[0, 1]), float(p[1, 1])

    @covariance.setter
    def covariance(self, value: Covariance) -> None:
        self._ekf.P = np.array([[value[0], value[1]], [value[1], value[2]]])

    def predict(self, dt: float, current: float, temperature: float, noise: tuple[float, float]) -> None:
        """See `SocFilter`. The model is linear in state and current, so filterpy's own F·x + B·u is exact."""
        battery = self.battery
        r1, c1 = battery.r1.at(self.soc, temperature)[0], battery.c1.at(self.soc, temperature)[0]
        settled, a = battery.relax(dt, 0.0, 1.0, r1, c1)  # V of an ampere that flows from rest
        self._ekf.F = np.diag([1.0, a])
        self._ekf.B = np.array([[-dt / (3600 * battery.cell_capacity(temperature))], [settled]])
        self._ekf.Q = np.diag(noise)
        self._ekf.predict(np.array([[current]]))

    def _hx(self, x: NDArray[np.float64], current: float, temperature: float) -> NDArray[np.float64]:
        soc, v1 = float(x[0, 0]), float(x[1, 0])
        predicted = self.battery.ocv(soc, temperature)[0] - self.battery.r0.at(soc, temperature)[0] * current - v1
        return np.array([[predicted]])  # (1, 1): a scalar would turn x into 2×2

    def _jacobian(self, x: NDArray[np.float64], current: float, temperature: float) -> NDArray[np.float64]:
        soc = float(x[0, 0])
        return np.array([[self.battery.ocv(soc)[1] - current * self.battery.r0.at(soc, temperature)[1], -1.0]])

    def innovation(self, voltage: float, current: float, temperature: float) -> tuple[float, float]:
        """See `SocFilter`."""
        h = self._jacobian(self._ekf.x, current, temperature)
        predicted = float(self._hx(self._ekf.x, current, temperature)[0, 0])
        return voltage - predicted, float((h @ self._ekf.P @ h.T)[0, 0])

    def update(self, voltage: float, current: float, temperature: float, variance: float) -> None:
        """See `SocFilter`."""
        arguments = (current, temperature)
        z, r = np.array([[voltage]]), np.array([[variance]])
        self._ekf.update(z, self._jacobian, self._hx, R=r, args=arguments, hx_args=arguments)
