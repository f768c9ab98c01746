"""Extended Kalman filter for state of charge over the first-order equivalent circuit: x = (SOC, V1).

Prediction (Lord 2016, eqs. 2.21 and 2.22, exact for a current that is constant over the step), all for one cell:

    SOC' = SOC - I·dt/(3600·Ah)         V1' = a·V1 + R1·(1 - a)·I,  a = exp(-dt/(R1·C1))

Measurement (eq. 2.23): V = V_oc(SOC, T) - R0·I - V1, so H = [dV_oc/dSOC - I·dR0/dSOC, -1].

The covariance is updated in Joseph's form (Bucy & Joseph 1968), which is symmetric and positive by construction.
Two backends do the same: `ScalarFilter`, plain floats, for on board; and `FilterpyFilter` around filterpy's
ExtendedKalmanFilter, the reference. A test holds them equal to 1e-9.
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
        battery = self.battery
        r1, c1 = battery.r1.at(self.soc, temperature)[0], battery.c1.at(self.soc, temperature)[0]
        self.soc -= current * dt / (3600 * battery.cell_capacity(temperature))
        self.v1, a = battery.relax(dt, self.v1, current, r1, c1)
        p00, p01, p11 = self.covariance
        self.covariance = p00 + noise[0], a * p01, a * a * p11 + noise[1]

    def _observe(self, current: float, temperature: float) -> tuple[float, float]:
        """(predicted voltage, its derivative over SOC)."""
        ocv, slope = self.battery.ocv(self.soc, temperature)
        r0, r0_slope = self.battery.r0.at(self.soc, temperature)
        return ocv - r0 * current - self.v1, slope - current * r0_slope

    def innovation(self, voltage: float, current: float, temperature: float) -> tuple[float, float]:
        """See `SocFilter`."""
        predicted, h = self._observe(current, temperature)
        p00, p01, p11 = self.covariance
        return voltage - predicted, h * h * p00 - 2 * h * p01 + p11

    def update(self, voltage: float, current: float, temperature: float, variance: float) -> None:
        """See `SocFilter`."""
        predicted, h = self._observe(current, temperature)
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


def filter_maker(name: str) -> FilterMaker:
    """The backend called `name`: ``scalar`` or ``filterpy``; the second imports numpy and scipy."""
    if name == "filterpy":
        from gz_onboard.estimator.ekf_filterpy import FilterpyFilter

        return FilterpyFilter
    return ScalarFilter
