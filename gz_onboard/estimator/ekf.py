"""Extended Kalman filter for state of charge over the first-order equivalent circuit: x = (SOC, V1).

Prediction (Lord 2016, eqs. 2.21 and 2.22, exact for a current that is constant over the step), all for one cell:

    SOC' = SOC - I·dt/(3600·Ah)         V1' = a·V1 + R1·(1 - a)·I,  a = exp(-dt/(R1·C1))

Measurement (eq. 2.23): V = V_oc(SOC, T) - R0·I - V1, so H = [dV_oc/dSOC - I·dR0/dSOC, -1].

The covariance is updated in Joseph's form (Bucy & Joseph 1968), which is symmetric and positive by construction.
The prediction is `Battery.advanced`, the measurement and its derivative `Battery.terminal_voltage`, for both backends:
`ScalarFilter`, plain floats, for on board; and `FilterpyFilter` around filterpy's ExtendedKalmanFilter, the
reference. A test holds them equal to 1e-9.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from gz_onboard.physics.battery import Battery

Covariance = tuple[float, float, float]
"""var(SOC), cov(SOC, V1) [V], var(V1) [V²]"""


class SocFilter(Protocol):
    """What both backends offer. Currents, voltages and resistances are a cell's."""

    soc: float
    v1: float  # V
    covariance: Covariance

    def predict(self, dt: float, current: float, temperature: float, noise: tuple[float, float]) -> None:
        """Go `dt` [s] ahead at a mean `current` [A]; `noise`: variances added to SOC and V1 [V²]."""

    def innovation(self, voltage: float, current: float, temperature: float) -> tuple[float, float]:
        """(measured less predicted voltage [V], its variance from the state alone [V²])."""

    def update(self, voltage: float, current: float, temperature: float, variance: float) -> None:
        """Take in a `voltage` [V] measured at `current` [A] with `variance` [V²]."""


class ScalarFilter:
    """The filter in plain floats: 30 times cheaper than 2×2 matrices, and no import."""

    def __init__(self, battery: Battery, soc: float, v1: float, covariance: Covariance) -> None:
        self.battery = battery
        self.soc = soc
        self.v1 = v1
        self.covariance = covariance

    def predict(self, dt: float, current: float, temperature: float, noise: tuple[float, float]) -> None:
        """See `SocFilter`."""
        self.soc, self.v1, a = self.battery.advanced(dt, self.soc, self.v1, current, temperature)
        p00, p01, p11 = self.covariance
        self.covariance = p00 + noise[0], a * p01, a * a * p11 + noise[1]

    def innovation(self, voltage: float, current: float, temperature: float) -> tuple[float, float]:
        """See `SocFilter`."""
        predicted, h = self.battery.terminal_voltage(self.soc, self.v1, current, temperature)
        p00, p01, p11 = self.covariance
        return voltage - predicted, h * h * p00 - 2 * h * p01 + p11

    def update(self, voltage: float, current: float, temperature: float, variance: float) -> None:
        """See `SocFilter`."""
        predicted, h = self.battery.terminal_voltage(self.soc, self.v1, current, temperature)
        p00, p01, p11 = self.covariance
        ph0 = h * p00 - p01  # P·Hᵀ
        ph1 = h * p01 - p11
        s = h * ph0 - ph1 + variance
        k0, k1 = ph0 / s, ph1 / s
        error = voltage - predicted
        self.soc += k0 * error
        self.v1 += k1 * error
        # Joseph: (I - K·H)·P·(I - K·H)ᵀ + K·R·Kᵀ with I - K·H = [[a, b], [c, d]]
        a, b, c, d = 1 - k0 * h, k0, -k1 * h, 1 + k1
        m00, m01 = a * p00 + b * p01, a * p01 + b * p11
        m10, m11 = c * p00 + d * p01, c * p01 + d * p11
        self.covariance = (
            m00 * a + m01 * b + k0 * k0 * variance,
            m00 * c + m01 * d + k0 * k1 * variance,
            m10 * c + m11 * d + k1 * k1 * variance,
        )


FilterMaker = Callable[[Battery, float, float, Covariance], SocFilter]
"""Makes a filter of a battery, SOC, V1 [V] and covariance."""
