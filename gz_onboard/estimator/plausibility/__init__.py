"""Checks sensors against each other: finds the one that contradicts the others, names it and leaves it out.

Each group (speeds; currents and voltages; inertial unit and altitude; temperatures) predicts a member from the others,
from a model or from the member's own past. The normalised residual goes into a fault counter per sensor. A sensor that
explains the contradiction is left out at once, and is faulty after `faulty_after_s` until it has agreed for
`recovered_after_s`. Two members that contradict each other with nothing to decide are disputed: neither is
believed alone, and the uncertainty grows.

A sensor that is left out counts as silent (`Signal.trusted`). Import from the modules of this package.
"""

from __future__ import annotations

from gz_onboard.constants import BENCH_TEMPERATURE
from gz_onboard.estimator.plausibility.electrical import PackSensors
from gz_onboard.estimator.plausibility.inertial import GradeCheck, InertialCheck
from gz_onboard.estimator.plausibility.residual import StepInputs
from gz_onboard.estimator.plausibility.speeds import SpeedCheck
from gz_onboard.estimator.plausibility.temperatures import TemperatureCheck
from gz_onboard.estimator.signals import Signals
from gz_onboard.physics.battery import Battery
from gz_onboard.physics.parameters import Parameters


class Plausibility:
    """All sensor checks of one vehicle; mass with payload [kg].

    `step` runs the checks before the values are used. `pack` and `grades` compare what depends on the motion, after it.
    """

    def __init__(self, signals: Signals, battery: Battery, parameters: Parameters, mass: float) -> None:
        gear = parameters["gear_ratio"] / parameters["speed_sensor_scale"]
        self.speeds = SpeedCheck(parameters["wheel_radius"], gear, battery.pack_capacity(BENCH_TEMPERATURE))
        self.grades = GradeCheck(mass)
        self.pack = PackSensors(signals, battery, parameters)
        self._checks = TemperatureCheck(), self.speeds, self.grades, InertialCheck()
        self._counters = dict(self.pack.counters)
        for check in self._checks:
            self._counters |= check.counters

    def step(self, step: StepInputs) -> None:
        """Check the values of this step before any of them is used."""
        for check in self._checks:
            check.step(step)

    @property
    def distrusted(self) -> tuple[str, ...]:
        """Roles that are left out, in a fixed order."""
        return tuple(role for role, counter in self._counters.items() if counter.faulty)
