"""Temperatures against what vehicles can have, and against their own past: heat flows slowly."""

from __future__ import annotations

from gz_onboard.estimator.plausibility.residual import CONFIG, FaultCounter, RateLimit, StepInputs

# Lowest and highest temperature [degC] that vehicles have, fastest rise and fall [K/s]. Cells heat themselves, but cool
# through their pack.
LIMITS = {
    "cell_temperature": (-40.0, 85.0, 0.05, 0.01),
    "ambient_temperature": (-50.0, 65.0, 0.5, 0.5),
    "motor_temperature": (-50.0, 220.0, 3.0, 3.0),
    "inverter_temperature": (-50.0, 180.0, 3.0, 3.0),
}


class TemperatureCheck:
    """Leaves out a temperature that is impossible or changes faster than heat flows."""

    def __init__(self) -> None:
        self.counters = {role: FaultCounter() for role in LIMITS}
        self._past = {role: RateLimit() for role in LIMITS}

    def step(self, step: StepInputs) -> None:
        """Check the temperatures of this step."""
        evidence = min(step.dt, CONFIG.evidence_s)
        for role, (low, high, rise, fall) in LIMITS.items():
            signal, counter = step.signals[role], self.counters[role]
            value = signal.reported
            in_range = value is not None and low < value < high
            limits = rise * step.dt, fall * step.dt, CONFIG.temperature_jump_k
            possible = self._past[role].allows(evidence, value if in_range else None, *limits) and in_range
            if value is not None:
                counter.update(evidence, not possible)
                signal.trusted = possible and not counter.faulty
