"""All checks of one vehicle's sensors."""

from __future__ import annotations

from gz_onboard.constants import BENCH_TEMPERATURE
from gz_onboard.estimator.redundancy.checks import SensorCheck, StepInputs
from gz_onboard.estimator.redundancy.currents import CurrentCheck
from gz_onboard.estimator.redundancy.grades import GradeCheck
from gz_onboard.estimator.redundancy.inertial import InertialCheck
from gz_onboard.estimator.redundancy.motion import CarriedCheck, MotionCheck
from gz_onboard.estimator.redundancy.odometer import OdometerCheck
from gz_onboard.estimator.redundancy.speeds import SpeedCheck
from gz_onboard.estimator.redundancy.temperatures import TemperatureCheck
from gz_onboard.estimator.redundancy.voltages import VoltageCheck
from gz_onboard.physics.battery import Battery


class Redundancy:
    """All that sensors are checked for.

    `step` makes the checks before the values are used. The others compare what was made of the values, where that is
    made: currents and voltages, then grades. mass [kg]; level: the force [N] that the pack gives in the mean of the
    usual riding.
    """

    def __init__(self, radius: float, gear: float, mass: float, level: float, battery: Battery) -> None:
        capacity = battery.pack_capacity(BENCH_TEMPERATURE)
        self.speeds = SpeedCheck(radius, gear)
        self.odometer = OdometerCheck(self.speeds)
        self.grades = GradeCheck(mass, level)
        self.currents, self.voltages = CurrentCheck(capacity), VoltageCheck(battery, capacity)
        self._checks: tuple[SensorCheck, ...] = (
            TemperatureCheck(),
            CarriedCheck(capacity),
            self.speeds,
            self.odometer,
            MotionCheck(self.speeds, capacity),
            self.grades,
            InertialCheck(),
        )
        counters = [self.voltages.counters, self.currents.counters, *(check.counters for check in self._checks)]
        self._counters = {role: counter for part in counters for role, counter in part.items()}

    def step(self, step: StepInputs) -> None:
        """Check the values of this step before any of them is used."""
        for check in self._checks:
            check.step(step)

    @property
    def distrusted(self) -> tuple[str, ...]:
        """The roles that are left out."""
        return tuple(role for role, counter in self._counters.items() if counter.faulty)
