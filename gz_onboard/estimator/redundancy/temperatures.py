"""Temperatures against what can be, and against what they were: heat flows slowly."""

from __future__ import annotations

from gz_onboard.estimator.redundancy.checks import LONGEST_EVIDENCE, RateLimit, StepInputs, counters

# Temperatures [degC] that vehicles have, and how fast [K/s] they rise and fall at most. Cells heat themselves, but cool
# through their pack.
TEMPERATURES = {
    "cell_temperature": (-40.0, 85.0, 0.05, 0.01),
    "ambient_temperature": (-50.0, 65.0, 0.5, 0.5),
    "motor_temperature": (-50.0, 220.0, 3.0, 3.0),
    "inverter_temperature": (-50.0, 180.0, 3.0, 3.0),
}
JUMP = 6.0  # K: beside the rate; sensors of 1 K and what two messages in a row are apart
COLDER = 45.0  # K: cells were never so much colder than the air


class TemperatureCheck:
    """See `SensorCheck`."""

    def __init__(self) -> None:
        self.counters = counters(tuple(TEMPERATURES))
        self._limits = {role: RateLimit() for role in TEMPERATURES}

    def step(self, step: StepInputs) -> None:
        """See `SensorCheck`."""
        signals, dt = step.signals, step.dt
        evidence = min(dt, LONGEST_EVIDENCE)
        ambient = signals.ambient_temperature.reported(step.now)
        for role, (low, high, rise, fall) in TEMPERATURES.items():
            signal = signals[role]
            value = signal.reported(step.now)
            coldest = ambient - COLDER if role == "cell_temperature" and ambient is not None else low
            can_be = value is not None and max(low, coldest) < value < high
            follows = self._limits[role].update(evidence, value if can_be else None, rise * dt, JUMP, fall * dt)
            if value is None:
                continue
            counter, possible = self.counters[role], can_be and follows
            counter.update(evidence, not possible)
            signal.trusted = possible and not counter.faulty
