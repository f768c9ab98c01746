"""What of each second teaches the road load, and what is doubted and teaches nothing."""

from __future__ import annotations

from collections.abc import Collection

from gz_onboard.constants import BENCH_TEMPERATURE
from gz_onboard.estimator.ageing import AGREEING_RATE
from gz_onboard.estimator.present import Present
from gz_onboard.estimator.ridden import Second as Ridden
from gz_onboard.estimator.road import RoadState
from gz_onboard.estimator.road_load import RoadLoad, Surroundings
from gz_onboard.estimator.signals import Signals
from gz_onboard.estimator.sources import CurrentSource, PackReading
from gz_onboard.estimator.spans import Second
from gz_onboard.physics.battery import Battery

TAUGHT_BY = {"pack_current", "inverter_current", "pack_voltage", "motor_speed", "accel_x", "gps_altitude"}
"""Sensors of which none may be doubted; and those of the speed that the others replace."""
CONTRADICTING = 2.0  # times by how much two currents may differ to teach: what was learned before is doubted as well


class RoadTeacher:
    """Gives the seconds of one vehicle to its `RoadLoad`."""

    def __init__(self, load: RoadLoad, road: RoadState, signals: Signals, present: Present, battery: Battery) -> None:
        self._load, self._road, self._signals, self._present = load, road, signals, present
        self._cable = load.cable  # ohm
        self._agreeing = AGREEING_RATE * battery.pack_capacity(BENCH_TEMPERATURE)  # A
        self._doubted = False

    def second(
        self, now: float, ridden: Ridden, before: float | None, reading: PackReading, distrusted: Collection[str]
    ) -> None:
        """A second until `now` [s], begun at a speed `before` [m/s]; as the forecast gathered it."""
        apart = abs(reading.current_apart or 0.0) / self._agreeing
        doubted = reading.source is not CurrentSource.PACK or reading.voltage_doubted or apart > CONTRADICTING
        doubted = doubted or bool(distrusted and TAUGHT_BY.intersection(distrusted))
        if doubted and not self._doubted:
            self._load.unlearn()
        self._doubted = doubted
        road, speed, voltage = self._road, self._road.speed, reading.voltage
        if doubted or apart > 1 or not voltage or speed is None:
            self._load.pause()
            return
        lost = self._cable * (ridden.energy / ridden.seconds / voltage) ** 2  # W, before where the model begins
        second = Second(
            ridden.seconds,
            ridden.distance,
            ridden.energy - lost * ridden.seconds,
            speed if before is None else before,
            speed,
            road.grade,
            0.0 if road.yaw_rate is None else speed * road.yaw_rate,
            bool(self._signals.brake_switch.get(now)),
        )
        self._load.ride(second, lambda: self._around(now))

    def _around(self, now: float) -> Surroundings:
        conditions = self._present.conditions(now, self._signals.motor_temperature.get(now))
        return Surroundings(conditions, self._present.effect_inputs(now), self._present.time_moving, self._road.heading)
