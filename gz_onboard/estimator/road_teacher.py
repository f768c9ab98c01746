"""What of each step teaches the road load, and what is doubted and teaches nothing."""

from __future__ import annotations

from collections.abc import Collection

from gz_onboard.constants import BENCH_TEMPERATURE
from gz_onboard.estimator.ageing import AGREEING_RATE
from gz_onboard.estimator.present import Present
from gz_onboard.estimator.road import RoadState
from gz_onboard.estimator.road_load import RoadLoad, Surroundings
from gz_onboard.estimator.signals import Signals
from gz_onboard.estimator.sources import CurrentSource, PackReading
from gz_onboard.estimator.spans import Motion
from gz_onboard.physics.battery import Battery

TAUGHT_BY = {"pack_current", "inverter_current", "pack_voltage", "motor_speed", "accel_x", "gps_altitude"}
"""Sensors of which none may be doubted; and those of the speed that the others replace."""


class RoadTeacher:
    """Gives the steps of one vehicle to its `RoadLoad`."""

    def __init__(self, load: RoadLoad, road: RoadState, signals: Signals, present: Present, battery: Battery) -> None:
        self.load, self._road, self._signals, self._present = load, road, signals, present
        self._cable = load.cable  # ohm
        self._agreeing = AGREEING_RATE * battery.pack_capacity(BENCH_TEMPERATURE)  # A
        self._sound = True

    def step(
        self, now: float, dt: float, reading: PackReading, distrusted: Collection[str], period: float, moving: float
    ) -> None:
        """`dt` [s] until `now` [s]; period [s] of the speed; moving [s]: see `QUANTITIES`."""
        apart = reading.current_apart
        sound = (
            reading.source is CurrentSource.PACK
            and not reading.voltage_doubted
            and (apart is None or abs(apart) < self._agreeing)
            and not (distrusted and TAUGHT_BY.intersection(distrusted))
        )
        if self._sound and not sound:  # what is doubted now may have taught for a while
            self.load.unlearn()
        self._sound = sound
        road, speed, acceleration = self._road, self._road.speed, self._road.acceleration
        voltage, current = reading.voltage, reading.current
        if not sound or voltage is None or current is None or speed is None or acceleration is None:
            self.load.pause()
            return
        power = (voltage - self._cable * current) * current  # behind the cable, where the model begins
        lateral = 0.0 if road.yaw_rate is None else speed * road.yaw_rate
        braked = bool(self._signals.brake_switch.get(now))
        motion = Motion(dt, speed, acceleration, road.grade, power, braked, lateral)
        self.load.ride(motion, lambda: self._around(now, moving), period)

    def _around(self, now: float, moving: float) -> Surroundings:
        conditions = self._present.conditions(now, self._signals.motor_temperature.get(now))
        return Surroundings(conditions, self._present.effect_inputs(now), moving, self._road.heading)
