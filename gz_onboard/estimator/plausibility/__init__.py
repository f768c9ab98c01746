"""Checks sensors against each other: finds the one that contradicts the others, names it and leaves it out.

Each group (speeds; currents and voltages; accelerometer and altitude; slow signals and axes) predicts a member from the
others, from a model or from the member's own past. The normalised residual goes into a fault counter per sensor. A
sensor that explains the contradiction is left out at once, and is faulty after `faulty_after_s` until it has agreed for
`recovered_after_s`. Two members that contradict each other with nothing to decide are disputed: neither is
believed alone, and the uncertainty grows.

A sensor that is left out counts as silent (`Signal.trusted`). Import from the modules of this package.
"""

from __future__ import annotations

from collections.abc import Callable

from gz_onboard.constants import BENCH_TEMPERATURE
from gz_onboard.estimator.plausibility.electrical import CellError, PackSensors
from gz_onboard.estimator.plausibility.grades import GradeCheck, LevelPower
from gz_onboard.estimator.plausibility.limits import LimitCheck
from gz_onboard.estimator.plausibility.speeds import SpeedCheck
from gz_onboard.estimator.signals import Signals
from gz_onboard.physics.battery import Battery
from gz_onboard.physics.parameters import Parameters


class Plausibility:
    """All sensor checks of one vehicle; mass with payload [kg].

    `limits` and `speeds` are checked before the values of a step are used, `pack` and `grades`, which depend on the
    motion, after it.
    """

    def __init__(
        self,
        signals: Signals,
        battery: Battery,
        parameters: Parameters,
        mass: float,
        cell_error: CellError,
        road_power: Callable[[], float | None],
        level_power: LevelPower,
    ) -> None:
        gear = parameters["gear_ratio"] / parameters["speed_sensor_scale"]
        capacity = battery.pack_capacity(BENCH_TEMPERATURE)
        self.pack = PackSensors(signals, battery, parameters, cell_error, road_power)
        self.limits = LimitCheck(signals)
        self.speeds = SpeedCheck(signals, parameters["wheel_radius"], gear, capacity)
        self.grades = GradeCheck(signals, self.speeds, self.limits.altitude, mass, level_power)
        sensors = (self.pack.sensors, self.limits.sensors, self.speeds.sensors)
        self._sensors = [sensor for group in sensors for sensor in group.values()] + [self.grades.accelerometer]

    @property
    def distrusted(self) -> tuple[str, ...]:
        """Roles that are left out, in a fixed order."""
        return tuple([sensor.role for sensor in self._sensors if sensor.faulty])
