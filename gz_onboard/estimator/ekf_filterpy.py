"""The reference backend: filterpy's ExtendedKalmanFilter. Imports numpy and scipy: 1.5 s and 70 MB."""

from __future__ import annotations

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from numpy.typing import NDArray

from gz_onboard.estimator.ekf import Covariance
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
        self._ekf = _Ekf(dim_x=2, dim_z=1)
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
        """See `SocFilter`."""
        x = self._ekf.x
        soc, v1, decay = self.battery.advanced(dt, float(x[0, 0]), float(x[1, 0]), current, temperature)
        self._ekf.F, self._ekf.Q = np.diag([1.0, decay]), np.diag(noise)
        self._ekf.advanced = np.array([[soc], [v1]])
        self._ekf.predict()

    def _predicted(self, x: NDArray[np.float64], current: float, temperature: float) -> NDArray[np.float64]:
        voltage, _ = self.battery.terminal_voltage(float(x[0, 0]), float(x[1, 0]), current, temperature)
        return np.array([[voltage]])  # (1, 1): a scalar would turn x into 2×2

    def _jacobian(self, x: NDArray[np.float64], current: float, temperature: float) -> NDArray[np.float64]:
        _, slope = self.battery.terminal_voltage(float(x[0, 0]), float(x[1, 0]), current, temperature)
        return np.array([[slope, -1.0]])

    def innovation(self, voltage: float, current: float, temperature: float) -> tuple[float, float]:
        """See `SocFilter`."""
        h = self._jacobian(self._ekf.x, current, temperature)
        predicted = float(self._predicted(self._ekf.x, current, temperature)[0, 0])
        return voltage - predicted, float((h @ self._ekf.P @ h.T)[0, 0])

    def update(self, voltage: float, current: float, temperature: float, variance: float) -> None:
        """See `SocFilter`."""
        arguments = (current, temperature)
        z, r = np.array([[voltage]]), np.array([[variance]])
        self._ekf.update(z, self._jacobian, self._predicted, R=r, args=arguments, hx_args=arguments)
