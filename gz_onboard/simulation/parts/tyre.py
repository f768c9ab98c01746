"""The driven tyre: magic formula over longitudinal slip (Lord 2016, eqs. 3.10-3.12; Pacejka 2012, sec. 4.3).

Two forms of slip. ``steady`` is the printed one, κ = (V_t - V)/max(V, V_t, ε). ``transient``, the default, lets the
carcass take up the slip over a relaxation length, σ·dκ/dt = V_t - V - |V|·κ (Pacejka 2012, eq. 7.9): the same at
speed, and at standstill a spring instead of a singularity, so that a braked scooter holds on a hill.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan, cos, sin


@dataclass
class Tyre:
    """The longitudinal force of one tyre; `slip` is its state."""

    b: float
    c: float
    d: float
    e: float
    relaxation_length: float = 0.12  # m
    epsilon: float = 0.5  # m/s, of the printed form
    form: str = "transient"
    slip: float = 0.0

    def friction(self, slip: float) -> tuple[float, float]:
        """(µ, dµ/dκ): eq. 3.12."""
        x = self.b * slip
        t = atan(x)
        y = x - self.e * (x - t)
        angle = self.c * atan(y)
        inner = 1 - self.e * (1 - 1 / (1 + x * x))
        return self.d * sin(angle), self.d * cos(angle) * self.c / (1 + y * y) * inner * self.b

    def linear(self, rim: float, speed: float, dt: float) -> tuple[float, float]:
        """The slip at the end of the step as base + gain·(rim speed - vehicle speed at the end) [m/s].

        Gives (base, gain), with the vehicle's speed taken from the start: implicit where it is stiff.
        """
        if self.form == "steady":
            scale = max(abs(speed), abs(rim), self.epsilon)
            return 0.0, 1 / scale
        decay = 1 / (1 + dt * abs(speed) / self.relaxation_length)
        return self.slip * decay, dt / self.relaxation_length * decay

    def grip(self, rim: float, speed: float, dt: float) -> tuple[float, float, float, float]:
        """(base, gain) of `linear`, and (µ, dµ/dκ) of `friction` at the slip of unchanged speeds [m/s]."""
        base, gain = self.linear(rim, speed, dt)
        mu, slope = self.friction(base + gain * (rim - speed))
        return base, gain, mu, slope
