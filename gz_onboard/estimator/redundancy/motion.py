"""A speed that is all there is, and the motion of a receiver that nothing of the vehicle shares.

The one that does not change is compared with the pack's current and the tremor of the accelerometer. The other is that
of a van, in which the vehicle is carried: motor and wheels rest, and no current drives.
"""

from __future__ import annotations

from gz_onboard.estimator.redundancy.checks import FAULTY_AFTER, MOVING, FaultCounter, StepInputs, share_of_new
from gz_onboard.estimator.redundancy.speeds import SPEED_APART, SpeedCheck
from gz_onboard.estimator.signals import Signals
from gz_onboard.events import SPEEDS

TIME = 5.0  # s, low pass
STUCK_AFTER, CONTRADICTED = 10.0, 10.0  # s of one speed; s, in the main, in which both others contradict it
DRIVES, IDLE = 0.2, 0.05  # 1/h: of a drive, and of lights and electronics
TREMBLES, RESTS = 0.2, 0.15  # m/s², rms from step to step; riding 0.23 and more, standing 0.13, after a stop up to 0.2

RESTED = 10.0  # s of rest: a sensor that dies on the road has no such time before
UNCOUNTED = 1500.0  # m that an odometer does not count: longer than its steps
NOISE = 0.5  # rad/s or m/s
OWN = SPEEDS[:-1]  # what a receiver knows nothing of
TURNS = 1.0  # N·m of a motor that drives


class CarriedCheck:
    """See `SensorCheck`: tells the signals whether the vehicle is carried. capacity: of the pack [A·h]."""

    def __init__(self, capacity: float) -> None:
        self.counters: dict[str, FaultCounter] = {}
        self._capacity = capacity
        self._rest = RESTED  # s, the last of it before the receiver began to move
        self._way = 0.0  # m by the receiver since the odometer counted
        self._counted: float | None = None  # m

    def step(self, step: StepInputs) -> None:
        """See `SensorCheck`."""
        signals, now, odometer = step.signals, step.now, step.signals.odometer
        if not signals.gps_speed.stale_after:
            return
        before, self._counted = self._counted, odometer.last
        if self._drives(signals, now) or (before or self._counted) != self._counted:
            self._rest, self._way, signals.carried = 0.0, 0.0, False
            return
        own = [v for role in OWN if (v := signals[role].reported(now)) is not None]
        speed = signals.gps_speed.reported(now) or 0.0
        self._way += speed * step.observed
        if any(abs(v) > NOISE for v in own) or (speed >= SPEED_APART and self._rest < RESTED):
            self._rest = 0.0
        elif speed < SPEED_APART:
            self._rest += step.observed
        known = bool(own) or (odometer.fresh(now) and self._way > UNCOUNTED)
        signals.carried = known and self._rest >= RESTED and (speed >= SPEED_APART or signals.carried)

    def _drives(self, signals: Signals, now: float) -> bool:
        """Whether a motor does, or may: no sensor shows it."""
        current, torque = signals.inverter_current.reported(now), signals.motor_torque.reported(now)
        current = signals.pack_current.reported(now) if current is None else current
        return current is None or abs(current) > IDLE * self._capacity or abs(torque or 0.0) > TURNS


class MotionCheck:
    """See `SensorCheck`: the counter of a speed is that of `SpeedCheck`. capacity: of the pack [A·h]."""

    def __init__(self, speeds: SpeedCheck, capacity: float) -> None:
        self.counters: dict[str, FaultCounter] = {}
        self._speeds, self._capacity = speeds, capacity
        self._forward = 0.0  # m/s²
        self._square = self._rate = 0.0  # (m/s²)², 1/h; low-passed
        self._time = 0.0  # s of contradiction, less those without
        self._named: str | None = None

    def step(self, step: StepInputs) -> None:
        """See `SensorCheck`."""
        dt, signals, speeds = step.observed, step.signals, self._speeds
        forward, current = signals.accel_x.reported(step.now), signals.pack_current.reported(step.now)
        current = signals.inverter_current.reported(step.now) if current is None else current
        if forward is None or current is None or speeds.middle is None or len(speeds.reporting) != 1:
            self._time = 0.0
            return
        share = share_of_new(dt, TIME)
        self._square += ((forward - self._forward) ** 2 - self._square) * share
        self._rate += (current / self._capacity - self._rate) * share
        self._forward = forward
        (role,), moving = speeds.reporting, speeds.middle > MOVING
        stands = self._square < RESTS**2 and abs(self._rate) < IDLE
        drives = self._square > TREMBLES**2 and self._rate > DRIVES
        wrong = speeds.still[role] > STUCK_AFTER and (stands if moving else drives)
        self._time = min(max(self._time + (dt if wrong else -dt), 0.0), CONTRADICTED)
        if wrong and self._time >= CONTRADICTED:
            self._named = role
            speeds.judge(role, FAULTY_AFTER, True, signals)
        elif self._named == role and moving and not speeds.still[role]:
            speeds.judge(role, dt, False, signals)
            self._named = role if speeds.counters[role].faulty else None
