"""The speeds of motor, wheels, vehicle and GPS, by majority."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import fmean, median

from gz_onboard.estimator.motion import MOTION, accelerated
from gz_onboard.estimator.redundancy.checks import MOVING, NO_SENSOR, STUCK_AFTER, StepInputs, counters
from gz_onboard.estimator.signals import FIX_2D, Signals
from gz_onboard.events import SPEEDS
from gz_onboard.physics.sensors import speed_factors

REVERSE = 4.0  # m/s: no road vehicle goes back faster; slower, wheels and GPS do not show the direction
SPEED_APART, SPEED_APART_RELATIVE = 1.0, 0.12  # m/s and 1: two speeds that differ by more contradict each other
BRAKING = 5.0  # m/s²: how fast a speed can have changed since its sensor last reported
HELD_TIME = 10.0  # s: after this a message that came late no longer says that its value is held
DRIFT_TIME = 20.0  # s, low pass
DRIFT_APART, DRIFT_APART_RELATIVE = 0.2, 0.08  # the same for the low-passed: tyres and scales err by a few percent
# What turns on a roller bench or spins while the vehicle does not move.
AXLE = frozenset({"motor_speed", "wheel_speed_rear"})
GROUND = "wheel_speed_front", "gps_speed"
# s: wheels hold no ratio to the ground they spin on for so long; most that is counted
SPIN_TIME, SPIN_MOST = 20.0, 30.0
RATIO_APART = 0.15  # ratios that differ by less are the same: speeds are late by a second while the vehicle accelerates
ODOMETRY = frozenset({"motor_speed", "wheel_speed_rear", "wheel_speed_front"})  # what a vehicle speed is made from


def weight(group: frozenset[str]) -> int:
    """How many independent witnesses of the speed these are: a vehicle speed repeats the wheel it is made from."""
    return len(group - {"vehicle_speed"} if group & ODOMETRY else group)


def agree(speeds: Mapping[str, float], apart: Mapping[str, float]) -> bool:
    """Whether none of them contradicts the others: `vote`."""
    return not any(vote(speeds, apart, spins=False))


class AxleRatio:
    """The driven axle over the moving ground. Spinning wheels hold no ratio; on a roller bench the ground stands."""

    def __init__(self) -> None:
        self._ratio = 1.0
        self._time = 0.0  # s of this ratio, less those of another
        self.moving = False  # both

    def wrong(self, dt: float, speeds: Mapping[str, float]) -> bool:
        """Whether the ratio is another than 1 and is none of wheelspin, after `dt` [s] at `speeds` [m/s] by role."""
        axle, ground = ([speeds[role] for role in side if role in speeds] for side in (AXLE, GROUND))
        self.moving = bool(axle and ground) and min(axle + ground) > MOVING
        if self.moving:
            ratio = fmean(axle) / fmean(ground)
            same = abs(ratio - 1) > RATIO_APART > abs(ratio / self._ratio - 1)
            self._time = min(max(self._time + (dt if same else -dt), 0.0), SPIN_MOST)
            self._ratio = self._ratio if self._time else ratio
        return self._time >= SPIN_TIME


def vote(
    speeds: Mapping[str, float], apart: Mapping[str, float], spins: bool = True
) -> tuple[frozenset[str], frozenset[str]]:
    """(roles that are outvoted, roles that contradict each other with nothing to decide by).

    speeds [m/s] by role; apart: how far [m/s] the speed of each role may be from another; spins: a driven axle that
    contradicts the ground may be wheelspin; else it is one witness, for one wheel radius scales it.
    """
    groups = {
        frozenset(b for b, w in speeds.items() if abs(v - w) <= max(apart[a], apart[b])) for a, v in speeds.items()
    }
    everyone = frozenset(speeds)
    if everyone in groups:
        return NO_SENSOR, NO_SENSOR
    weights = {group: weight(group) - (not spins and group >= AXLE) for group in groups}
    best = max(groups, key=lambda group: (weights[group], sorted(group)))
    others = everyone - best
    # Two sensors of the driven axle agree and the ground does not: wheelspin or a roller bench, and no fault.
    if spins and any(side - {"vehicle_speed"} == AXLE for side in (best, others)):
        return NO_SENSOR, NO_SENSOR
    if any(weights[group] >= weights[best] for group in groups if not group & best):
        return NO_SENSOR, everyone
    return others, NO_SENSOR


class SpeedCheck:
    """See `SensorCheck`."""

    ROLES = SPEEDS

    def __init__(self, radius: float, gear: float) -> None:
        self._scale = speed_factors(radius, gear)
        self.counters = counters(self.ROLES)
        self._last = dict.fromkeys(self.ROLES, 0.0)  # m/s
        self.still = dict.fromkeys(self.ROLES, 0.0)  # s without a change
        self._apart = dict.fromkeys(self.ROLES, 0.0)  # m/s, low-passed, from the median
        self._median = 0.0  # m/s, low-passed
        self._axle = AxleRatio()
        self.reporting: tuple[str, ...] = ()  # roles
        self._held = dict.fromkeys(self.ROLES, 0.0)  # s: for how long a value stands, at most of late
        self.middle: float | None = None  # m/s, median of those that are of one age
        self.acceleration = 0.0  # m/s², of `middle`
        self.in_steps = False  # even the newest are held so long that `middle` goes in steps: no acceleration
        self._slow = 0.0  # m/s
        self.on_road = False  # the ground goes by as fast as the driven wheel turns: another sensor has seen it
        self.unsettled = False  # two contradict each other, and it is not known which of them is right

    def step(self, step: StepInputs) -> None:
        """See `SensorCheck`."""
        dt, signals = step.observed, step.signals
        speeds, apart = self._speeds(step)
        self.unsettled = self.on_road = False
        self.reporting = tuple(speeds)
        if not speeds:
            self.middle = None
            return
        believed = {role: speed for role, speed in speeds.items() if not self.counters[role].faulty}
        middle = median((believed or speeds).values())
        self.unsettled = not believed
        self._follow(dt, self._newest(step, believed or speeds))
        if len(speeds) < 2:
            for role in speeds:
                signals[role].trusted = not self.counters[role].faulty
            return
        outvoted, tied = NO_SENSOR, NO_SENSOR
        spins = not self._axle.wrong(dt, speeds)
        if max(speeds.values()) - min(speeds.values()) > min(apart.values()):
            outvoted, tied = vote(speeds, apart, spins)
            if not (outvoted or tied) and self._axle.moving:
                self.unsettled |= not agree(speeds, apart)
        elif len(speeds) > 2:
            outvoted = self._drifted(dt, speeds, middle)
        if tied:
            if believed and believed != speeds and agree(believed, apart):  # nothing new: found out before
                outvoted, tied = tied - believed.keys(), NO_SENSOR
            stuck = frozenset(role for role in tied if self.still[role] >= STUCK_AFTER)
            if stuck and stuck != tied:
                outvoted, tied = stuck, NO_SENSOR
        self.unsettled |= bool(tied)
        doubted = tied | {role for role in outvoted if not self.counters[role].faulty}
        self.on_road = not doubted and any(
            role in speeds and role not in outvoted and abs(speeds[role] - middle) <= apart[role] for role in GROUND
        )
        moving = middle > MOVING
        for role in speeds:
            counter = self.counters[role]
            against = role in outvoted or role in tied
            counter.update(dt, against if against or (moving and self.still[role] < STUCK_AFTER) else None)
            signals[role].trusted = not (counter.faulty or role in outvoted)

    def judge(self, role: str, time: float, contradicted: bool, signals: Signals) -> None:
        """What another witness says, over `time` [s], of a speed that is all there is."""
        counter = self.counters[role]
        counter.update(time, contradicted)
        signals[role].trusted = not counter.faulty
        self.unsettled |= counter.faulty

    def _speeds(self, step: StepInputs) -> tuple[dict[str, float], dict[str, float]]:
        """(speeds [m/s], how far each may be from another [m/s]) by role, of those that report."""
        speeds: dict[str, float] = {}
        apart: dict[str, float] = {}
        for role in self.ROLES:
            signal = step.signals[role]
            reported = signal.reported(step.now)
            if role == "gps_speed":
                signal.trusted = step.signals.gps_course.trusted = not step.signals.fix_below(step.now, FIX_2D)
            if reported is None or (role == "gps_speed" and not signal.trusted):
                continue
            speed = reported * self._scale[role]
            speeds[role] = speed if speed < -REVERSE else abs(speed)
            apart[role] = SPEED_APART + SPEED_APART_RELATIVE * abs(speed) + BRAKING * max(step.now - signal.time, 0.0)
            self.still[role] = 0.0 if speed != self._last[role] else self.still[role] + step.observed
            self._last[role] = speed
        return speeds, apart

    def _newest(self, step: StepInputs, speeds: Mapping[str, float]) -> float:
        """The median of those whose values are of one age.

        The mean of a new value and a held one gains half of what the vehicle does, and the rest of it in one step. What
        is held for little longer than the newest is evened out with the acceleration.
        """
        keep = 1 - min(step.observed / HELD_TIME, 1.0)
        for role in self.reporting:
            self._held[role] = max(step.now - step.signals[role].time, keep * self._held[role])
        longest = min(self._held[role] for role in speeds) + MOTION.speed_time
        self.in_steps = longest > 2 * MOTION.speed_time
        return median(speed for role, speed in speeds.items() if self._held[role] <= longest)

    def _follow(self, dt: float, speed: float) -> None:
        if self.middle is None:
            self._slow = speed
        if dt > 0:
            self._slow, self.acceleration = accelerated(self._slow, speed, dt)
        self.middle = speed

    def _drifted(self, dt: float, speeds: Mapping[str, float], middle: float) -> frozenset[str]:
        share = min(dt / DRIFT_TIME, 1.0)
        self._median += share * (middle - self._median)
        for role, speed in speeds.items():
            self._apart[role] += share * (speed - middle - self._apart[role])
        most = DRIFT_APART + DRIFT_APART_RELATIVE * self._median
        return frozenset(role for role in speeds if abs(self._apart[role]) > most)
