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

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import sqrt
from statistics import median

from gz_onboard.constants import GRAVITY
from gz_onboard.estimator.road import STANDS, accelerated
from gz_onboard.estimator.signals import Signals
from gz_onboard.physics.battery import Battery

GUILTY_AFTER = 3.0  # s of contradiction: wheels spin and lock for a second or two
FORGIVEN_AFTER = 60.0  # s of agreement
SETTLED = 30.0  # s: a signal that has held so long is not replaced by what contradicts it
MOVING = 2.0  # m/s: below, wheel sensors lose their teeth, and a dead sensor is as right as any
REVERSE = 4.0  # m/s: no road vehicle goes back faster; slower, wheels and GPS do not tell the direction
SPEED_APART, SPEED_APART_RELATIVE = 1.0, 0.12  # m/s and 1: two speeds that differ by more contradict each other
BRAKING = 5.0  # m/s²: how fast a speed can have changed since its sensor last spoke
DRIFT_TIME = 20.0  # s, low pass
DRIFT_APART, DRIFT_APART_RELATIVE = 0.2, 0.08  # the same for the low-passed: tyres and scales err by a few percent
STILL = 1.0  # s of one and the same value while others move: stuck
NOBODY: frozenset[str] = frozenset()
AXLE = frozenset({"motor_speed", "wheel_speed_rear"})  # what turns on a roller bench or spins while the ground stands
GROUND = "wheel_speed_front", "gps_speed"
ODOMETRY = frozenset({"motor_speed", "wheel_speed_rear", "wheel_speed_front"})  # what a vehicle speed is made from

# Grades are sines of the road's angle. The commissioning rides' greatest differences of accelerometer and altitude are
# 0.026 over 300 m and 0.010 over 1000 m; those of the energy 0.05, most of it wind that stays for the ride.
NEAR, FAR, USUAL = 300.0, 1000.0, 3000.0  # m
APART_NEAR, APART_FAR, APART_UNKNOWN = 0.05, 0.022, 0.08
ALONE_NEAR, ALONE_FAR, ALONE_UNKNOWN = 0.09, 0.06, 0.10  # of one witness against the energy
MOST_USUAL = 0.05  # 3 degrees of mounting
DECIDES = 0.4  # of what two are apart: by so much one must be nearer to the energy than the other
DOWNHILL = -0.02
FREE = 0.4  # of what the usual riding takes: neither wind nor a light rider saves so much over a kilometre
STEEPEST = 0.3
JUMP, WEATHER = 6.0, 1.0  # m, m/s: how far and how fast an altitude wanders by the receiver alone
STANDING_TIME, STANDING_RATE = 20.0, 0.6  # s, m/s: a standing vehicle does not climb
GAIN = 0.6, 1.5  # of the accelerometer over the wheels' acceleration, over `GAIN_TIME` if there is enough of it
HARDEST = 10.0  # m/s²
GAIN_TIME, GAIN_MEAN, GAIN_LEAST = 60.0, 20.0, 10.0  # s, s, m²/s³

# Currents in those that empty the pack in an hour; the voltages are a cell's.
FAST_TIME, SKEW_TIME, CURRENT_TIME = 0.5, 2.0, 10.0  # s: low passes; the sensors do not sample at the same time
CURRENT_APART, CURRENT_APART_RELATIVE = 0.10, 0.10  # 1/h and 1: two currents that differ by more contradict each other
GROSS_CURRENT, GROSS_RELATIVE = 0.5, 0.3  # the same over `FAST_TIME`
VOLTAGE_TIME, VOLTS_APART, GROSS_VOLTS = 10.0, 0.07, 0.3  # s, V
LINK_TIME = 1.0  # s: an inverter that is being charged or discharges moves by more in it than half of
VOLTS_USUAL = 0.02  # V: sensors that do not sample at the same time, on the rides
AGREED_BEFORE = 30.0  # s: two voltages that agreed so long knew the state of charge, and one of them left it
ERROR_TIME, ERROR_LEAST, GROSS_ERROR = 10.0, 0.04, 0.4  # s, V: what the cell model leaves, low-passed; at once
ROAD_TIME, OFF_ROAD, OFF_ROAD_RELATIVE = 30.0, 0.15, 0.7  # s, 1/h, 1: by the road load a current is known to half
PLAIN = 2.5  # of two mean squares: the greater one's reading lies
STUCK_VOLTAGE = 5.0  # s
LOWEST_CELL, HIGHEST_CELL = 0.6, 1.12  # of the cut-off, of full at rest
# Both currents scaled alike: the cells' voltage sags by more (less) than they explain, and a kilometre takes less
# (more) than the road does. The recorded rides show a sag of 0.6 to 1.3 of the predicted one, an aged pack's up to
# twice; a kilometre takes 0.7 of the usual by a frugal rider, and 2.5 of it up a hill against the wind. Neither alone
# says that a sensor lies; both do.
SAG_FAST, SAG_TIME, SAG_LEAST = 0.5, 30.0, 0.003  # s, s, V²·s of a cell
SAGS_MORE, TAKES_LESS, SAGS_LESS, TAKES_MORE = 1.45, 0.67, 0.5, 1.5
SAG_EXPLAINED, SAG_SHARE = (
    (0.55, 1.45),
    0.6,
)  # a current that explains the sag so well is no lie, whatever the road is said to take
SAG_AGREES = 1.3  # by no more than this factor: the currents explain the voltage again

# Temperatures [degC] that vehicles have, and how fast [K/s] they rise and fall at most. Cells heat themselves, but cool
# through their pack.
TEMPERATURES = {
    "cell_temperature": (-40.0, 85.0, 0.05, 0.01),
    "ambient_temperature": (-50.0, 65.0, 0.5, 0.5),
    "motor_temperature": (-50.0, 220.0, 3.0, 3.0),
    "inverter_temperature": (-50.0, 180.0, 3.0, 3.0),
}
LEAP = 6.0  # K: beside the rate; sensors of 1 K and what two messages in a row are apart
COLDER = 45.0  # K: cells were never so much colder than the air
# Means over `AXIS_TIME` [s] that a vehicle can have, leaning, on a side stand or on a hill; m/s² and rad/s.
AXES = {
    "accel_y": (-5.0, 5.0),
    "accel_z": (6.5, 13.0),
    "rate_x": (-0.15, 0.15),
    "rate_y": (-0.15, 0.15),
    "rate_z": (-0.8, 0.8),
}
AXIS_TIME = 30.0


def part(dt: float, time: float) -> float:
    """The share of a new value in a mean over `time` [s], of which `dt` [s] are new."""
    return min(dt / time, 1.0) if time > 0 else 1.0


class Anchor:
    """What a slow signal can be by now: it follows the signal no faster than that can change.

    The first value is no better than any other: until the signal has held for `SETTLED` seconds, one that holds for
    longer takes its place.
    """

    __slots__ = ("_fall", "_other", "_rise", "_seconds", "_value")

    def __init__(self) -> None:
        self._value: float | None = None
        self._rise = self._fall = 0.0  # how far the signal can have gone since
        self._seconds = 0.0  # for how long it has held
        self._other: Anchor | None = None  # of the values that could not follow it

    def hear(self, dt: float, value: float | None, rise: float, jump: float, fall: float | None = None) -> bool:
        """Whether `value` can be, `dt` [s] in which the signal rises by `rise` or falls by `fall`; None: silent.

        jump: by how much it may be off what it can be. fall: as `rise` if it is not given.
        """
        fall = rise if fall is None else fall
        self._rise, self._fall = self._rise + rise, self._fall + fall
        if value is None:
            return True
        if self._value is None:
            self._value = value
        near = min(max(value, self._value - self._fall), self._value + self._rise)
        if abs(value - near) <= jump:
            self._value, self._rise, self._fall, self._other = near, 0.0, 0.0, None
            self._seconds += dt
            return True
        if self._seconds >= SETTLED:
            return False
        if self._other is None or not self._other.hear(dt, value, rise, jump, fall):
            self._other = Anchor()
            self._other.hear(0.0, value, rise, jump, fall)
        other = self._other
        if other._seconds <= self._seconds:
            return False
        self._value, self._rise, self._fall, self._other = other._value, 0.0, 0.0, None
        self._seconds = other._seconds
        return True


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


def lost(now: float, signals: Signals) -> bool:
    """Whether the GPS says that it knows nothing."""
    return signals.gps_fix.fresh(now) and signals.gps_fix.value < 2


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
        self.middle: float | None = None  # m/s, median
        self.acceleration = 0.0  # m/s², of the median
        self._slow = 0.0  # m/s
        self.on_road = False  # the ground goes by as fast as the driven wheel turns: another sensor has seen it
        self.unsettled = False  # two contradict each other, and it is not known which of them is right

    def step(self, now: float, dt: float, signals: Signals) -> None:
        """Hear all that speak at `now` [s], `dt` [s] after the last step, and trust them or not."""
        speeds: dict[str, float] = {}
        apart: dict[str, float] = {}
        for role in self.ROLES:
            signal = signals[role]
            said = signal.told(now)
            if role == "gps_speed":
                signal.trusted = signals.gps_course.trusted = not lost(now, signals)
            if said is None or (role == "gps_speed" and not signal.trusted):
                continue
            speed = said * self._scale.get(role, 1.0)
            speeds[role] = speed if speed < -REVERSE else abs(speed)
            apart[role] = SPEED_APART + SPEED_APART_RELATIVE * abs(speed) + BRAKING * max(now - signal.time, 0.0)
            self._still[role] = 0.0 if speed != self._said[role] else self._still[role] + dt
            self._said[role] = speed
        self.unsettled = self.on_road = False
        if not speeds:
            self.middle = None
            return
        middle = median([v for role, v in speeds.items() if not self.trials[role].guilty] or speeds.values())
        if dt > 0:
            before = middle if self.middle is None else self._slow
            self._slow, self.acceleration = accelerated(before, middle, dt)
        self.middle = middle
        if len(speeds) < 2:
            for role in speeds:
                signals[role].trusted = not self.trials[role].guilty
            return
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
        doubted = tied | {role for role in outvoted if not self.trials[role].guilty}
        self.on_road = not doubted and any(
            role in speeds and role not in outvoted and abs(speeds[role] - middle) <= apart[role] for role in GROUND
        )
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


class Running:
    """A mean over distance that forgets over `length` [m]; with `whole`, the plain mean until so much was ridden."""

    __slots__ = ("length", "value", "way", "whole")

    def __init__(self, length: float, whole: bool = False) -> None:
        self.length, self.whole = length, whole
        self.value = self.way = 0.0

    def add(self, way: float, total: float) -> None:
        """`total` over the next `way` [m]."""
        self.way += way
        self.value += (total - self.value * way) / (min(self.way, self.length) if self.whole else self.length)


class Gap:
    """How far two witnesses of the grade are apart, over some hundred metres and over a kilometre."""

    def __init__(self) -> None:
        self.near, self.far = Running(NEAR), Running(FAR)
        self._usual = Running(USUAL, whole=True)
        self._waiting: deque[tuple[float, float]] = deque()  # what is not yet usual: (way, climb)
        self._way = 0.0  # m of it

    @property
    def usual(self) -> float:
        """What it usually is: how the accelerometer is mounted, what the model and the wind make."""
        return min(max(self._usual.value, -MOST_USUAL), MOST_USUAL) if self.known else 0.0

    @property
    def known(self) -> bool:
        """Whether it is known what is usual."""
        return self._usual.way >= FAR

    def add(self, way: float, climb: float) -> None:
        """`climb` [m]: of the one less that of the other over `way` [m]."""
        self.near.add(way, climb)
        self.far.add(way, climb)

    def learn(self, way: float, climb: float) -> None:
        """Take this for usual, once `FAR` more was ridden and nothing was wrong with it."""
        self._waiting.append((way, climb))
        self._way += way
        while self._way > FAR:
            old = self._waiting.popleft()
            self._way -= old[0]
            self._usual.add(*old)

    def doubt(self) -> None:
        """What was to become usual is doubted."""
        self._waiting.clear()
        self._way = 0.0

    def beyond(self, near: float, far: float, unknown: float) -> float:
        """By how much it is beyond what is allowed [grade], else 0; `unknown`: allowed over `NEAR` at first."""
        if abs(self.near.value - self.usual) > (near if self.known else unknown):
            return self.near.value - self.usual
        far = far if self.known else MOST_USUAL
        return self.far.value - self.usual if abs(self.far.value - self.usual) > far else 0.0


class Slopes:
    """The grade by accelerometer, by GPS altitude, and by the energy that riding takes more than on the level."""

    ROLES = ("accel_x", "gps_altitude")

    def __init__(self, mass: float, level: float) -> None:
        self._weight = mass * GRAVITY
        self._free = -FREE * level / self._weight
        self.trials = {role: Trial() for role in self.ROLES}
        self._inertial, self._energy, self._energy_altitude = Gap(), Gap(), Gap()  # accelerometer less altitude, ...
        self._by_energy = Running(NEAR)
        self._anew()
        self._heard: float | None = None  # m, the altitude of this step
        self._altitudes = Anchor()
        self._before: float | None = None  # m, at the end of the last second
        self._standing_rate = 0.0  # m/s, low-passed
        self._said = 0.0
        self._still = 0.0
        self._speed_before: float | None = None  # m/s, at the last step
        self._means: tuple[float, float, float] | None = None  # m/s²: accelerometer, acceleration; s of both
        self._product = self._square = 0.0
        self._deaf = False  # it does not show what the wheels gain

    def _anew(self) -> None:
        """Begin a second."""
        self._seconds = self._way = 0.0
        self._climb: float | None = 0.0  # m, by accelerometer
        self._work: float | None = 0.0  # J, out of the pack
        self._speed: float | None = None  # m/s, at its begin

    def step(
        self,
        now: float,
        dt: float,
        signals: Signals,
        speeds: Speeds,
        power: float | None,
        level: Callable[[float, float], float],
    ) -> None:
        """Hear the witnesses of `dt` [s].

        speeds: where they are not unsettled, their median is the speed; one of them may be late or noisy. power: of
        the pack [W], None if that is not known. level: what the model says for a speed and an acceleration on a level
        road [W].
        """
        forward, speed = signals.accel_x.told(now), speeds.middle
        if speed is None or speeds.unsettled:
            self._anew()
            return
        way = abs(speed) * dt
        if self._speed is None:
            self._speed = speed
        self._seconds += dt
        self._way += way
        if forward is None:
            self._climb = None
        elif self._climb is not None:
            self._climb += (forward - speeds.acceleration) / GRAVITY * way
            self._hear_accelerometer(dt, forward, speed, speeds)
        self._work = None if self._work is None or power is None else self._work + power * dt
        if self._seconds >= 1.0:
            self._second(speed, self._heard, level)
            self._anew()
            self._speed = speed
        signals.accel_x.trusted = not self.trials["accel_x"].guilty

    def pause(self) -> None:
        """Nothing was heard for a while: what changed meanwhile is no rate."""
        self._anew()
        self._before = self._speed_before = self._means = None

    def hear_altitude(self, now: float, dt: float, signals: Signals, speed: float | None) -> None:
        """Before the altitude is used: whether a road and a receiver could have come to it since the last one."""
        altitude = signals.gps_altitude.told(now)
        if signals.gps_fix.fresh(now) and signals.gps_fix.value < 3:
            altitude = None
        possible = self._altitudes.hear(min(dt, 1.0), altitude, (STEEPEST * abs(speed or 0.0) + WEATHER) * dt, JUMP)
        if not possible:
            self.trials["gps_altitude"].hear(min(dt, 1.0), True)
        self._heard = altitude if possible else None
        jumped = not possible
        signals.gps_altitude.trusted = not (jumped or self.trials["gps_altitude"].guilty)

    def _hear_accelerometer(self, dt: float, forward: float, speed: float, speeds: Speeds) -> None:
        """An accelerometer that moves trembles, and shows what the wheels gain."""
        acceleration, on_road = speeds.acceleration, speeds.on_road
        self._still = self._still + dt if forward == self._said != 0.0 else 0.0  # a plain zero: a simulation's
        self._said = forward
        keep = 1 - min(dt / GAIN_TIME, 1.0)
        if not on_road:  # which speed is right is not yet known, or the wheels turn on a bench
            self._product = self._square = 0.0
            self._deaf = False
        gained = 0.0 if self._speed_before is None else speed - self._speed_before
        self._speed_before = speed
        if max(abs(acceleration), abs(gained) / max(dt, 1e-3)) > HARDEST:  # another sensor took over
            return
        # Less their means: a slope is in the one and not in the other.
        slow, wheels, time = self._means or (forward, acceleration, 0.0)
        time = min(time + dt, GAIN_MEAN)  # plain means at first: nobody knows what was before
        share = part(dt, time)
        self._means = slow + (forward - slow) * share, wheels + (acceleration - wheels) * share, time
        self._product = keep * self._product + (forward - slow) * (acceleration - wheels) * dt
        self._square = keep * self._square + (acceleration - wheels) * (gained - wheels * dt)
        self._deaf = self._square > GAIN_LEAST and not GAIN[0] < self._product / self._square < GAIN[1]
        if on_road and abs(speed) > MOVING and (self._still > STILL or self._deaf):
            self.trials["accel_x"].hear(dt, True)

    def _second(self, speed: float, altitude: float | None, level: Callable[[float, float], float]) -> None:
        way, seconds = self._way, self._seconds
        rise = None if altitude is None or self._before is None else altitude - self._before
        self._before = altitude
        if way / seconds < MOVING:
            if rise is not None and way / seconds < 0.1:
                self._standing_rate += (rise / seconds - self._standing_rate) * min(seconds / STANDING_TIME, 1.0)
                if abs(self._standing_rate) > STANDING_RATE:
                    self.trials["gps_altitude"].hear(seconds, True)
            return
        energy = None
        if self._work is not None and self._speed is not None:
            gained = (speed - self._speed) / seconds
            energy = (self._work - level(way / seconds, gained) * seconds) / self._weight
            self._by_energy.add(way, energy)
        climb = self._climb
        pairs: list[tuple[Gap, float]] = []
        if climb is not None and rise is not None:
            pairs.append((self._inertial, climb - rise))
        if energy is not None and climb is not None:
            pairs.append((self._energy, energy - climb))
        if energy is not None and rise is not None:
            pairs.append((self._energy_altitude, energy - rise))
        for gap, difference in pairs:
            gap.add(way, difference)
        accused = self._judge(climb is not None, rise is not None, energy is not None)
        if accused is None:
            return
        for role in self.ROLES:
            self.trials[role].hear(seconds, role in accused)
        if not accused and not any(trial.guilty for trial in self.trials.values()):
            for gap, difference in pairs:
                gap.learn(way, difference)
        elif accused:
            for gap, _ in pairs:
                gap.doubt()

    def _judge(self, inertial: bool, altitude: bool, energy: bool) -> frozenset[str] | None:
        """Who lies; None if that cannot be told now. The arguments: which of the witnesses speak."""
        everyone = frozenset(self.ROLES)
        if inertial and altitude:
            apart = self._inertial.beyond(APART_NEAR, APART_FAR, APART_UNKNOWN)
            if not apart and self._energy_altitude.far.value < self._free:  # riding takes less than it ever can
                return frozenset({"gps_altitude"})
            if not apart:
                half = self._inertial.beyond(APART_NEAR / 2, APART_FAR / 2, APART_UNKNOWN / 2)
                return None if half else NOBODY
            if not energy:
                return everyone
            by_inertial = abs(self._energy.near.value - self._energy.usual)
            by_altitude = abs(self._energy_altitude.near.value - self._energy_altitude.usual)
            if self._deaf:
                return frozenset({"accel_x"})
            if abs(by_inertial - by_altitude) < DECIDES * abs(apart):
                return everyone
            return frozenset({"accel_x" if by_inertial > by_altitude else "gps_altitude"})
        if not energy or not (inertial or altitude):
            return None
        apart = (self._energy if inertial else self._energy_altitude).beyond(ALONE_NEAR, ALONE_FAR, ALONE_UNKNOWN)
        if apart > 0 and self._by_energy.value < DOWNHILL:  # brakes take what a descent gives: energy does not see it
            return None
        return frozenset({"accel_x" if inertial else "gps_altitude"}) if apart else NOBODY

    @property
    def guilty(self) -> frozenset[str]:
        """Who is left out."""
        return frozenset(role for role, trial in self.trials.items() if trial.guilty)

    @property
    def offset(self) -> float:
        """What to add to the accelerometer's grade, as it was before anything was distrusted."""
        return 0.0 if self.trials["accel_x"].guilty else -self._inertial.usual


class Rival:
    """Which of two readings the cells' voltage contradicts: mean squares of what the cell model leaves of each."""

    def __init__(self) -> None:
        self._first = self._second = 0.0  # V²
        self._time = 0.0  # s

    def forget(self) -> None:
        """The two agree."""
        self._first = self._second = self._time = 0.0

    def hear(self, dt: float, first: float | None, second: float | None) -> int:
        """0 while nothing decides, 1 or 2: which lies. first, second [V of a cell]: measured less predicted."""
        if first is None or second is None:
            return 0
        self._time = min(self._time + dt, ERROR_TIME)
        share = part(dt, self._time)
        self._first += (first * first - self._first) * share
        self._second += (second * second - self._second) * share
        if max(self._first, self._second) < ERROR_LEAST**2:
            return 0
        return 1 if self._first > PLAIN * self._second else 2 if self._second > PLAIN * self._first else 0


@dataclass(frozen=True)
class Electric:
    """What the electric sensors say at one time: A of the pack, positive discharging, and V; None if nothing."""

    pack: float | None
    inverter: float | None
    auxiliary: float | None
    usual_auxiliary: float
    pack_voltage: float | None
    inverter_voltage: float | None  # with the cable's drop
    speed: float | None  # m/s

    @property
    def around(self) -> float | None:
        """The pack's current by the inverter's and the auxiliary."""
        if self.inverter is None:
            return None
        return self.inverter + (self.usual_auxiliary if self.auxiliary is None else self.auxiliary)

    def unconnected(self, least: float) -> bool:
        """Whether an idle inverter is below the pack of a standing vehicle by `least` [V]."""
        if self.pack_voltage is None or self.inverter_voltage is None or abs(self.speed or 0.0) > STANDS:
            return False
        idle = self.inverter is None or abs(self.inverter) <= self.usual_auxiliary
        return idle and self.inverter_voltage < self.pack_voltage - least

    @property
    def charging(self) -> bool:
        """A charger's current does not pass the inverter."""
        return self.pack is not None and self.pack < 0 and abs(self.speed or 0.0) < STANDS


Error = Callable[[float, float], float | None]
"""Measured less predicted voltage of a cell [V], for a voltage [V] and a current [A] of the pack."""


class Sag:
    """The drop of the cells' voltage from one moment to the next, over what a current explains of it."""

    def __init__(self) -> None:
        self._voltage: float | None = None  # V of a cell, low-passed
        self._drop = 0.0  # V, low-passed
        self._product = self._square = self._volts = 0.0  # V²·s

    def hear(self, dt: float, voltage: float, drop: float) -> None:
        """A cell's voltage and the drop over its R0 by the current [V], after `dt` [s]."""
        if self._voltage is None or dt > SAG_FAST:  # what came between is not known
            self._voltage, self._drop = voltage, drop
            return
        fast = voltage - self._voltage, drop - self._drop
        share, keep = part(dt, SAG_FAST), 1 - part(dt, SAG_TIME)
        self._voltage += fast[0] * share
        self._drop += fast[1] * share
        self._product = keep * self._product - fast[0] * fast[1] * dt
        self._square = keep * self._square + fast[1] * fast[1] * dt
        self._volts = keep * self._volts + fast[0] * fast[0] * dt

    @property
    def explained(self) -> bool:
        """Whether the current is what moves the voltage, and by about as much as it should."""
        ratio = self.ratio
        if ratio is None or not SAG_EXPLAINED[0] < ratio < SAG_EXPLAINED[1]:
            return False
        return self._product * ratio > SAG_SHARE * self._volts

    @property
    def ratio(self) -> float | None:
        """Measured over predicted; None while the current has hardly changed."""
        return self._product / self._square if self._square > SAG_LEAST else None


class Currents:
    """Pack current against inverter and auxiliary current; both against the cells' voltage and the road."""

    ROLES = ("pack_current", "inverter_current", "auxiliary_current")

    def __init__(self, capacity: float) -> None:
        self._capacity = capacity  # A·h of the pack: an hour's current
        self.trials = {role: Trial() for role in self.ROLES}
        self.disputed = False  # the two differ, and it is not known which of them is right
        self.sag = Sag()
        self._scaled = False  # both are
        self._rival, self._by_model, self._road = Rival(), Rival(), OffRoad(capacity)
        self._difference = self._square = self._load = self._without = 0.0  # A, A², A, A²; low-passed
        self._fast = self._extra = 0.0  # A

    def step(
        self, dt: float, said: Electric, error: Error, model: Callable[[], float | None], innovation_rms: float
    ) -> frozenset[str]:
        """Who is not to be believed now.

        error: see `Error`; model: the pack's current by the road [A]; innovation_rms [V]: of the last ten seconds.
        """
        pack, around, voltage = said.pack, said.around, said.pack_voltage
        voltage = said.inverter_voltage if voltage is None else voltage
        against: frozenset[str] = NOBODY
        agree: bool | None = None
        if pack is not None and around is not None and not said.charging:
            against, agree = self._compare(dt, pack, around, voltage, said, error)
        else:
            self.disputed = False
        if not against and voltage is not None and self._by_road(dt, said, voltage, error, model, innovation_rms):
            against, agree = frozenset({"pack_current", "inverter_current"}), None
            self.disputed = False
        if self._scaled and not against:
            ratio = self.sag.ratio
            self._scaled = ratio is None or not 1 / SAG_AGREES < ratio < SAG_AGREES
            against, agree = frozenset({"pack_current", "inverter_current"}), None
        for role in self.ROLES:
            self.trials[role].hear(dt, True if role in against else agree)
        guilty = frozenset(role for role, trial in self.trials.items() if trial.guilty)
        return (against if not self.disputed else NOBODY) | guilty

    def weigh(self, takes: float) -> None:
        """Hear what the last kilometre took by the currents, over what the road takes by the model."""
        ratio = self.sag.ratio
        if ratio is not None:
            more = ratio > SAGS_MORE and takes < TAKES_LESS
            self._scaled |= more or (ratio < SAGS_LESS and takes > TAKES_MORE)

    def _compare(
        self, dt: float, pack: float, around: float, voltage: float | None, said: Electric, error: Error
    ) -> tuple[frozenset[str], bool | None]:
        """(who lies, whether all agree; None if there is nothing to agree about)."""
        hour = self._capacity
        least = min(abs(pack), abs(around))
        self._fast += (pack - around - self._fast) * min(dt / FAST_TIME, 1.0)
        self._difference += (pack - around - self._difference) * min(dt / SKEW_TIME, 1.0)
        extra = 0.0 if said.auxiliary is None else said.auxiliary - said.usual_auxiliary
        self._extra += (extra - self._extra) * min(dt / SKEW_TIME, 1.0)
        share = min(dt / CURRENT_TIME, 1.0)
        self._square += (self._difference**2 - self._square) * share
        self._load += (least - self._load) * share
        differ = sqrt(self._square) - CURRENT_APART_RELATIVE * self._load
        gross = abs(self._fast) > GROSS_CURRENT * hour + GROSS_RELATIVE * least
        self.disputed = False
        if differ < CURRENT_APART * hour and not gross:
            self._rival.forget()
            self._without = self._square
            small = differ < CURRENT_APART * hour / 2
            return NOBODY, False if small and max(abs(pack), abs(around)) > CURRENT_APART * hour else None
        if said.auxiliary is not None:  # without it all would agree
            self._without += ((self._difference + self._extra) ** 2 - self._without) * share
            allowed = CURRENT_APART * hour + CURRENT_APART_RELATIVE * self._load
            if self._without < min(allowed**2, self._square / 4):
                return frozenset({"auxiliary_current"}), None
        liar = self._rival.hear(dt, *((error(voltage, pack), error(voltage, around)) if voltage else (None, None)))
        if not liar and said.speed is not None and abs(said.speed) < STANDS:
            off = abs(pack - said.usual_auxiliary), abs(around - said.usual_auxiliary)
            if max(off) > 2 * min(off) + CURRENT_APART * hour / 2:
                liar = 1 if off[0] > off[1] else 2
        self.disputed = not liar
        known = self.trials["pack_current"].guilty, self.trials["inverter_current"].guilty
        if self.disputed and known[0] != known[1]:  # nothing new: who was found out before is it
            self.disputed = False
            return frozenset({"pack_current" if known[0] else "inverter_current"}), None
        return frozenset((self.ROLES[:1], self.ROLES[1:2])[liar - 1] if liar else self.ROLES[:2]), None

    def _by_road(
        self,
        dt: float,
        said: Electric,
        voltage: float,
        error: Error,
        model: Callable[[], float | None],
        innovation_rms: float,
    ) -> bool:
        """Whether the cells' voltage and the road both say that the currents are not what flows."""
        pack, inverter = (self.trials[role].guilty for role in self.ROLES[:2])
        used = said.around if said.pack is None or (pack and not inverter) else said.pack
        first = None if used is None else error(voltage, used)
        if used is None or first is None:
            return False
        gross, explained = abs(first) > GROSS_ERROR, self.sag.explained
        suspicious = gross or pack or inverter or innovation_rms > ERROR_LEAST  # seldom
        if not suspicious or (explained and not gross):
            self._road.forget()
            self._by_model.forget()
            return False
        expected = model()
        second = None if expected is None else error(voltage, expected)
        if expected is None or second is None:
            return False
        far = abs(used - expected) > OFF_ROAD * self._capacity + 2 * min(abs(used), abs(expected))
        if gross and abs(first) > 2 * abs(second) and (far or not explained):
            return True
        if explained:
            return False
        return self._road.hear(dt, used, expected) & (self._by_model.hear(dt, first, second) == 1)


class OffRoad:
    """How far a current [A] is from that of the road, in the mean and in the mean square."""

    def __init__(self, capacity: float) -> None:
        self._capacity = capacity
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self._time = 0.0
        self._used = self._expected = self._square = self._used_square = self._expected_square = 0.0

    def hear(self, dt: float, used: float, expected: float) -> bool:
        """Whether it is further from it than wind, load or slip make it."""
        self._time += dt
        share, slow = (part(dt, min(self._time, time)) for time in (CURRENT_TIME, ROAD_TIME))
        self._used += (used - self._used) * slow
        self._expected += (expected - self._expected) * slow
        self._square += ((used - expected) ** 2 - self._square) * share
        self._used_square += (used * used - self._used_square) * share
        self._expected_square += (expected * expected - self._expected_square) * share
        if self._time < CURRENT_TIME:
            return False
        least = OFF_ROAD * self._capacity
        if sqrt(self._square) > least + sqrt(min(self._used_square, self._expected_square)):
            return True
        least += OFF_ROAD_RELATIVE * min(abs(self._used), abs(self._expected))
        return self._time > ROAD_TIME and abs(self._used - self._expected) > least


class Voltages:
    """Pack voltage against the inverter's, and both against what a cell can have."""

    ROLES = ("pack_voltage", "inverter_voltage")

    def __init__(self, series: int, lowest: float, highest: float, capacity: float) -> None:
        self._series, self._lowest, self._highest, self._capacity = series, lowest, highest, capacity
        self.trials = {role: Trial() for role in self.ROLES}
        self.apart = 0.0  # V of a cell: by how much the two differ while it is not known which is right, else 0
        self._rival = Rival()
        self._link: float | None = None  # V, of the inverter, low-passed
        self._square = self._compared = 0.0  # V² of a cell, low-passed; s of it
        self._agreed = 0.0  # s
        self._said, self._still = 0.0, 0.0
        self._least = self._most = 0.0  # A, since the pack voltage stands still

    def step(self, dt: float, said: Electric, current: float | None, error: Error) -> frozenset[str]:
        """Who is not to be believed now, at this `current` [A] of the pack."""
        against = set()
        pack, inverter = said.pack_voltage, said.inverter_voltage
        if inverter is not None:
            link = inverter if self._link is None else self._link
            self._link = link + (inverter - link) * part(dt, LINK_TIME)
            moves = abs(inverter - self._link) > VOLTS_USUAL / 2 * self._series
            off = inverter < self._lowest * self._series
            if pack is not None and (moves or off) and said.unconnected(VOLTS_APART * self._series):
                inverter = None
                self._square = self._compared = 0.0
        for role, voltage in ((self.ROLES[0], pack), (self.ROLES[1], inverter)):
            if voltage is not None and not self._lowest < voltage / self._series < self._highest:
                against.add(role)
        if pack is not None and current is not None and self._stuck(dt, pack, current):
            against.add("pack_voltage")
        agree: bool | None = False
        self.apart = 0.0
        if not against and pack is not None and inverter is not None:
            difference = (pack - inverter) / self._series
            self._compared = min(self._compared + dt, VOLTAGE_TIME)
            self._square += (difference * difference - self._square) * part(dt, self._compared)
            if self._square < VOLTS_APART**2 and abs(difference) < GROSS_VOLTS:
                self._agreed += dt
                self._rival.forget()
                agree = None if self._square > (VOLTS_APART / 2) ** 2 else False
            else:
                agree = None
                liar = 0
                if current is not None and self._agreed > AGREED_BEFORE:
                    liar = self._rival.hear(dt, error(pack, current), error(inverter, current))
                known = [role for role in self.ROLES if self.trials[role].guilty]
                if liar or len(known) == 1:
                    against.add(self.ROLES[liar - 1] if liar else known[0])
                else:
                    self.apart = abs(difference)
        for (role, trial), voltage in zip(self.trials.items(), (pack, inverter), strict=True):
            trial.hear(dt, True if role in against or self.apart else None if voltage is None else agree)
        guilty = {role for role, trial in self.trials.items() if trial.guilty} if not self.apart else set()
        return frozenset(against | guilty)

    @property
    def spread(self) -> float:
        """By how much the two differ beyond what is usual [V of a cell]: no better is either of them known."""
        return max(sqrt(self._square) - VOLTS_USUAL, 0.0)

    def _stuck(self, dt: float, voltage: float, current: float) -> bool:
        """It is the same to the last bit while the current says that it must move."""
        if voltage != self._said:
            self._said, self._still = voltage, 0.0
            self._least = self._most = current
            return False
        self._still += dt
        self._least, self._most = min(self._least, current), max(self._most, current)
        return self._still > STUCK_VOLTAGE and self._most - self._least > GROSS_CURRENT * self._capacity


class Temperatures:
    """Temperatures against what can be, and against what they were: heat takes time."""

    def __init__(self) -> None:
        self.trials = {role: Trial() for role in TEMPERATURES}
        self._anchors = {role: Anchor() for role in TEMPERATURES}

    def step(self, now: float, dt: float, signals: Signals) -> None:
        """Trust each of them or not."""
        ambient = signals.ambient_temperature.told(now)
        for role, (low, high, rise, fall) in TEMPERATURES.items():
            signal = signals[role]
            value = signal.told(now)
            coldest = ambient - COLDER if role == "cell_temperature" and ambient is not None else low
            can_be = value is not None and max(low, coldest) < value < high
            follows = self._anchors[role].hear(min(dt, 1.0), value if can_be else None, rise * dt, LEAP, fall * dt)
            if value is None:
                continue
            trial, possible = self.trials[role], can_be and follows
            trial.hear(min(dt, 1.0), not possible)
            signal.trusted = possible and not trial.guilty


class Inertial:
    """Axes of the inertial unit against gravity and against what a vehicle can do for half a minute."""

    def __init__(self) -> None:
        self.trials = {role: Trial() for role in AXES}
        self._mean = dict.fromkeys(AXES, 0.0)  # low-passed
        self._said = dict.fromkeys(AXES, 0.0)
        self._still = dict.fromkeys(AXES, 0.0)  # s without a change
        self._time = 0.0  # s

    def step(self, now: float, dt: float, signals: Signals, speed: float | None) -> None:
        """Trust each of them or not, at `speed` [m/s]."""
        self._time += dt
        share = part(dt, min(self._time, AXIS_TIME))
        for role, (low, high) in AXES.items():
            signal = signals[role]
            value = signal.told(now)
            if value is None:
                continue
            self._mean[role] += (value - self._mean[role]) * share
            self._still[role] = self._still[role] + dt if value == self._said[role] != 0.0 else 0.0
            self._said[role] = value
            moving = speed is not None and abs(speed) > MOVING
            wrong = self._time > AXIS_TIME / 3 and not low < self._mean[role] < high
            trial = self.trials[role]
            trial.hear(dt, True if wrong or (moving and self._still[role] > STILL) else False if moving else None)
            signal.trusted = not trial.guilty


class Redundancy:
    """All that sensors are held against each other for.

    mass [kg]; level: the force [N] that the pack gives in the mean of the usual riding.
    """

    def __init__(self, radius: float, gear: float, mass: float, level: float, battery: Battery) -> None:
        capacity = battery.pack_capacity(25.0)
        self.speeds = Speeds(radius, gear)
        self.slopes = Slopes(mass, level)
        self.currents = Currents(capacity)
        lowest, highest = LOWEST_CELL * battery.cutoff_voltage, HIGHEST_CELL * battery.ocv_value[-1]
        self.voltages = Voltages(battery.cells_series, lowest, highest, capacity)
        self.temperatures, self.inertial = Temperatures(), Inertial()
        parts = (self.voltages, self.currents, self.temperatures, self.speeds, self.slopes, self.inertial)
        self._trials = {role: trial for part in parts for role, trial in part.trials.items()}

    def step(self, now: float, dt: float, heard: float, signals: Signals, speed: float | None) -> None:
        """What is told of `dt` [s] up to `now` [s], before any of it is used; `speed` [m/s] of the last step.

        heard: of `dt`, the seconds in which something was heard; what can have changed has all of it.
        """
        if heard < dt:
            self.slopes.pause()
        self.speeds.step(now, heard, signals)
        self.slopes.hear_altitude(now, dt, signals, speed)
        self.temperatures.step(now, dt, signals)
        self.inertial.step(now, heard, signals, speed)

    @property
    def distrusted(self) -> tuple[str, ...]:
        """The roles that are left out."""
        return tuple(role for role, trial in self._trials.items() if trial.guilty)
