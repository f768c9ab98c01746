"""Sensors held against each other: which of them contradicts the others is found, named and left out.

Nothing here is learned from one sensor alone. Each quantity has witnesses that do not depend on each other: the
speeds of motor, wheels and GPS. The greater number is believed at once; whoever contradicts it for `GUILTY_AFTER`
seconds is named, and stays out until it has agreed for `FORGIVEN_AFTER` seconds in which there was something to
agree about. Where nothing decides, all those concerned are left out: what is not known is said to be not known.

All of it runs once for each step of the estimator, on the means of that step. To be left out is to be missing
(`Signal.trusted`): what then stands in, and how much less certain the estimate becomes, is the same as if the
sensor were silent.
"""

from __future__ import annotations

from collections.abc import Mapping
from statistics import median

from gz_onboard.estimator.signals import Signals

GUILTY_AFTER = 3.0  # s of contradiction: wheels spin and lock for a second or two
FORGIVEN_AFTER = 60.0  # s of agreement
MOVING = 2.0  # m/s: below, wheel sensors lose their teeth, and a dead sensor is as right as any
REVERSE = 4.0  # m/s: no road vehicle goes back faster; slower, wheels and GPS do not tell the direction
SPEED_APART, SPEED_APART_RELATIVE = 1.0, 0.12  # m/s and 1: two speeds that differ by more contradict each other
BRAKING = 5.0  # m/s²: how fast a speed can have changed since its sensor last spoke
DRIFT_TIME = 20.0  # s, low pass
DRIFT_APART, DRIFT_APART_RELATIVE = 0.2, 0.08  # the same for the low-passed: tyres and scales err by a few percent
STILL = 1.0  # s of one and the same value while others move: stuck
NOBODY: frozenset[str] = frozenset()
AXLE = frozenset({"motor_speed", "wheel_speed_rear"})  # what turns on a roller bench or spins while the ground stands
ODOMETRY = frozenset({"motor_speed", "wheel_speed_rear", "wheel_speed_front"})  # what a vehicle speed is made from


class Trial:
    """What there is against one sensor."""

    __slots__ = ("agreed", "evidence", "guilty")

    def __init__(self) -> None:
        self.evidence = 0.0  # s of contradiction, less half the time of agreement
        self.agreed = 0.0  # s of agreement since the last contradiction
        self.guilty = False

    def hear(self, dt: float, contradicts: bool | None) -> None:
        """`dt` [s] in which it contradicts, agrees, or (None) in which there is nothing to tell it by."""
        if contradicts:
            self.agreed = 0.0
            self.evidence = min(self.evidence + dt, GUILTY_AFTER)
            self.guilty |= self.evidence >= GUILTY_AFTER - 1e-9
        elif contradicts is not None:
            self.evidence = max(self.evidence - dt / 2, 0.0)
            self.agreed += dt
            if self.agreed >= FORGIVEN_AFTER:
                self.guilty = False


def weight(group: frozenset[str]) -> int:
    """How many independent witnesses of the speed these are: a vehicle speed repeats the wheel it is made from."""
    return len(group - {"vehicle_speed"} if group & ODOMETRY else group)


def vote(speeds: Mapping[str, float], apart: Mapping[str, float]) -> tuple[frozenset[str], frozenset[str]]:
    """(roles that are outvoted, roles that contradict each other with nothing to decide by).

    speeds [m/s] by role; apart: how far [m/s] the speed of each role may be from another.
    """
    groups = {
        frozenset(b for b, w in speeds.items() if abs(v - w) <= max(apart[a], apart[b])) for a, v in speeds.items()
    }
    everyone = frozenset(speeds)
    if everyone in groups:
        return NOBODY, NOBODY
    best = max(groups, key=lambda group: (weight(group), sorted(group)))
    others = everyone - best
    # Two sensors of the driven axle agree and the ground does not: wheelspin or a roller bench, and nobody lies.
    if any(everyone & AXLE == side == AXLE for side in (best - {"vehicle_speed"}, others - {"vehicle_speed"})):
        return NOBODY, NOBODY
    if any(weight(group) >= weight(best) for group in groups if not group & best):
        return NOBODY, everyone
    return others, NOBODY


class Speeds:
    """The speeds of motor, wheels, vehicle and GPS."""

    ROLES = ("motor_speed", "wheel_speed_rear", "wheel_speed_front", "vehicle_speed", "gps_speed")

    def __init__(self, radius: float, gear: float) -> None:
        self._scale = {"motor_speed": radius * gear, "wheel_speed_rear": radius, "wheel_speed_front": radius}
        self.trials = {role: Trial() for role in self.ROLES}
        self._said = dict.fromkeys(self.ROLES, 0.0)
        self._still = dict.fromkeys(self.ROLES, 0.0)  # s without a change
        self._apart = dict.fromkeys(self.ROLES, 0.0)  # m/s, low-passed, from the median
        self._median = 0.0  # m/s, low-passed
        self.unsettled = False  # two contradict each other, and it is not known which of them is right

    def step(self, now: float, dt: float, signals: Signals) -> None:
        """Hear all that speak at `now` [s], `dt` [s] after the last step, and trust them or not."""
        speeds: dict[str, float] = {}
        apart: dict[str, float] = {}
        for role in self.ROLES:
            signal = signals[role]
            said = signal.told(now)
            if said is None or (role == "gps_speed" and signals.gps_fix.fresh(now) and signals.gps_fix.value < 2):
                continue
            speed = said * self._scale.get(role, 1.0)
            speeds[role] = speed if speed < -REVERSE else abs(speed)
            apart[role] = SPEED_APART + SPEED_APART_RELATIVE * abs(speed) + BRAKING * max(now - signal.time, 0.0)
            self._still[role] = 0.0 if speed != self._said[role] else self._still[role] + dt
            self._said[role] = speed
        self.unsettled = False
        if len(speeds) < 2:
            return
        middle = median(speeds.values())
        outvoted, tied = NOBODY, NOBODY
        if max(speeds.values()) - min(speeds.values()) > min(apart.values()):
            outvoted, tied = vote(speeds, apart)
        elif len(speeds) > 2:
            outvoted = self._drifted(dt, speeds, middle)
        if tied:
            stuck = frozenset(role for role in tied if self._still[role] >= STILL)
            if stuck and stuck != tied:
                outvoted, tied = stuck, NOBODY
        self.unsettled = bool(tied)
        moving = middle > MOVING
        for role in speeds:
            trial = self.trials[role]
            against = role in outvoted or role in tied
            trial.hear(dt, against if against or (moving and self._still[role] < STILL) else None)
            signals[role].trusted = not (trial.guilty or role in outvoted)

    def _drifted(self, dt: float, speeds: Mapping[str, float], middle: float) -> frozenset[str]:
        share = min(dt / DRIFT_TIME, 1.0)
        self._median += share * (middle - self._median)
        for role, speed in speeds.items():
            self._apart[role] += share * (speed - middle - self._apart[role])
        most = DRIFT_APART + DRIFT_APART_RELATIVE * self._median
        return frozenset(role for role in speeds if abs(self._apart[role]) > most)


class Redundancy:
    """All that sensors are held against each other for."""

    def __init__(self, radius: float, gear: float) -> None:
        self.speeds = Speeds(radius, gear)

    @property
    def distrusted(self) -> tuple[str, ...]:
        """The roles that are left out."""
        return tuple(role for role, trial in self.speeds.trials.items() if trial.guilty)
