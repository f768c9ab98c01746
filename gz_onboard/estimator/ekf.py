"""Extended Kalman filter over the first-order equivalent circuit: x = (SOC, V1), with V1 as V1(I) + e.

Prediction (Lord 2016, eqs. 2.21 and 2.22, exact for a current that is constant over the step), all for one cell:

    SOC' = SOC - I·dt/(3600·Ah)         V1' = a·V1 + R1·(1 - a)·I,  a = exp(-dt/(R1·C1))         e' = b·e

V1(I) follows the current alone; x holds SOC and e. What the circuit errs by, e, is a Gauss-Markov process, b =
exp(-dt/τ_e), of a variance that e returns to (Gelb 1974, sec. 3.8): the first voltage tells as much as the circuit is
good for, the next ones only what is new since, so that a wrong start is left at once and a right one is not lost to
an error that stays. What e is uncertain by beyond that is a polarisation of before, and fades as V1 does, b = a.

Measurement (eq. 2.23): V = V_oc(SOC, T) - R0·I - V1 - e, so H = [dV_oc/dSOC - I·dR0/dSOC, -1].

Where an update moves SOC far, H is that of where it leads to (iterated: Bell & Cathey 1993): the slope at a wrong state
of charge is not that at the right one.

The covariance is updated in Joseph's form (Bucy & Joseph 1968), which is symmetric and positive by construction.
The prediction is `Battery.advanced`, the measurement and its derivative `Battery.terminal_voltage`, for both backends:
`ScalarFilter`, plain floats, for on board; and `FilterpyFilter` around filterpy's ExtendedKalmanFilter, the
reference. A test holds them equal to 1e-9.
"""

from __future__ import annotations

from collections.abc import Callable
from math import exp
from typing import NamedTuple, Protocol

from gz_onboard.physics.battery import Battery

NEAR, TURNS = 0.01, 5  # of SOC: over so little the curve is straight; how often a further update is made out anew

Covariance = tuple[float, float, float]
"""var(SOC), cov(SOC, e) [V], var(e) [V²]"""


class Noise(NamedTuple):
    """What a step adds to the filter's uncertainty."""

    soc: float  # variance that the count gains
    error: float  # V²: variance that e returns to
    time: float  # s: time constant of e


class SocFilter(Protocol):
    """What both backends offer. Currents, voltages and resistances are a cell's."""

    soc: float
    v1: float  # V
    error: float  # V: e
    covariance: Covariance

    def predict(self, dt: float, current: float, temperature: float, noise: Noise) -> None:
        """Go `dt` [s] ahead at a mean `current` [A]."""

    def innovation(self, voltage: float, current: float, temperature: float) -> tuple[float, float]:
        """(measured voltage less that of the circuit [V], what SOC and e make uncertain of it [V²]).

        e is not in the prediction: so this shows how far the voltage is off what SOC and tables say.
        """

    def update(self, voltage: float, current: float, temperature: float, variance: float) -> None:
        """Take in a `voltage` [V] measured at `current` [A] with `variance` [V²]."""


class ScalarFilter:
    """The filter in plain floats: 30 times cheaper than 2×2 matrices, and no import."""

    def __init__(self, battery: Battery, soc: float, v1: float, covariance: Covariance) -> None:
        self.battery = battery
        self.soc = soc
        self.v1 = v1
        self.error = 0.0
        self.covariance = covariance

    def predict(self, dt: float, current: float, temperature: float, noise: Noise) -> None:
        """See `SocFilter`."""
        self.soc, self.v1, a = self.battery.advanced(dt, self.soc, self.v1, current, temperature)
        p00, p01, p11 = self.covariance
        b = a if p11 > noise.error else exp(-dt / noise.time)
        self.error *= b
        self.covariance = p00 + noise.soc, b * p01, noise.error + b * b * (p11 - noise.error)

    def innovation(self, voltage: float, current: float, temperature: float) -> tuple[float, float]:
        """See `SocFilter`."""
        predicted, h = self.battery.terminal_voltage(self.soc, self.v1, current, temperature)
        p00, p01, p11 = self.covariance
        return voltage - predicted, h * h * p00 - 2 * h * p01 + p11

    def update(self, voltage: float, current: float, temperature: float, variance: float) -> None:
        """See `SocFilter`."""
        p00, p01, p11 = self.covariance
        at = self.soc
        for _ in range(TURNS):
            predicted, h = self.battery.terminal_voltage(at, self.v1, current, temperature)
            ph0 = h * p00 - p01  # P·Hᵀ
            ph1 = h * p01 - p11
            s = h * ph0 - ph1 + variance
            k0, k1 = ph0 / s, ph1 / s
            apart = voltage - predicted - h * (self.soc - at) + self.error
            before, at = at, self.soc + k0 * apart
            if abs(at - before) < NEAR:
                break
        self.soc += k0 * apart
        self.error += k1 * apart
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
