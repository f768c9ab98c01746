"""Speeds, distance and grade: by majority, by the odometer, and by the energy that a grade costs.

Speeds of motor, wheels, vehicle and GPS vote; the only one of a vehicle is held against its odometer. Forward
accelerometer and GPS altitude are held against each other. Grades are sines of the road's angle. Where the two
contradict each other, the energy from the pack beyond that for a level road tells which of them is wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import hypot, sqrt

from gz_onboard.constants import GRAVITY
from gz_onboard.estimator.plausibility.residual import (
    CONFIG,
    NO_SENSOR,
    ResidualTest,
    ResponseGain,
    Sensor,
    SlowSensor,
    explain,
    share_of_new,
)
from gz_onboard.estimator.signals import FIX_2D, FIX_3D, Signals
from gz_onboard.events import SPEEDS
from gz_onboard.model.effect import MOVING
from gz_onboard.model.sensors import grade_shown, speed_factors

AXLE = frozenset({"motor_speed", "wheel_speed_rear"})  # turn on a roller bench and in wheelspin
GROUND = ("wheel_speed_front", "gps_speed")
WHEELS = AXLE | {"wheel_speed_front"}  # from one of which a vehicle speed is made

LevelPower = Callable[[float, float], float]
"""Power of the pack [W] by the model for a speed [m/s] and an acceleration [m/s²] on a level road."""


def vote(
    speeds: Mapping[str, float], tolerance: Mapping[str, float], spins: bool = True
) -> tuple[frozenset[str], frozenset[str]]:
    """Find the majority: (outvoted roles, roles that contradict each other with nothing to decide).

    speeds [m/s] by role; tolerance: the most [m/s] by which each may differ from another. spins: a driven axle that
    contradicts the ground may be wheelspin, no fault; otherwise it counts as one witness, scaled by one wheel radius.
    """
    if max(speeds.values()) - min(speeds.values()) <= min(tolerance.values()):
        return NO_SENSOR, NO_SENSOR
    groups = {
        frozenset(b for b, w in speeds.items() if abs(v - w) <= max(tolerance[a], tolerance[b]))
        for a, v in speeds.items()
    }
    everyone = frozenset(speeds)
    if everyone in groups:
        return NO_SENSOR, NO_SENSOR
    # Independent witnesses: a vehicle speed repeats the wheel from which it is made.
    weights = {
        group: len(group - {"vehicle_speed"} if group & WHEELS else group) - (not spins and group >= AXLE)
        for group in groups
    }
    best = max(groups, key=lambda group: (weights[group], sorted(group)))
    others = everyone - best
    if spins and any(side - {"vehicle_speed"} == AXLE for side in (best, others)):
        return NO_SENSOR, NO_SENSOR
    if any(weights[group] >= weights[best] for group in groups if not group & best):
        return NO_SENSOR, everyone
    return others, NO_SENSOR


class SpeedCheck:
    """Leaves out speeds that the majority contradicts, and tells whether the vehicle is carried.

    radius of the wheel [m]; gear: wheel over motor speed; capacity of the pack [Ah].
    """

    def __init__(self, signals: Signals, radius: float, gear: float, capacity: float) -> None:
        self._signals, self._scale = signals, speed_factors(radius, gear)
        self._idle_current = CONFIG.idle_rate * capacity  # A
        self.sensors = {role: Sensor(role, signals[role]) for role in signals.mapped((*SPEEDS, "odometer"))}
        self._speeds = [self.sensors[role] for role in signals.mapped(SPEEDS)]
        self.odometer = OdometerTest(signals)
        self._drift = dict.fromkeys(SPEEDS, 0.0)  # m/s, mean difference from the median
        self._spinning = 0.0  # s in which driven axle and moving ground contradict each other
        self._rest = CONFIG.short_s  # s, the last of it before the GPS began to move
        self.median: float | None = None  # m/s, of the sensors of
        self.roles: tuple[str, ...] = ()  # these roles, which are not faulty
        self.on_road = False  # the ground moves as fast as the driven wheel: no roller bench
        self.disputed = False  # sensors contradict each other and nothing decides

    def step(self, now: float, dt: float, gap: bool) -> None:
        """Check the speeds of a step of `dt` [s] in which messages came; gap: it is only part of the time."""
        signals = self._signals
        signals.carried = self._is_carried(dt)
        fix = not signals.fix_below(now, FIX_2D)
        signals.gps_speed.trusted = signals.gps_course.trusted = fix
        speeds: dict[str, float] = {}  # m/s
        tolerance: dict[str, float] = {}  # m/s, the most by which each may differ from another
        for sensor in self._speeds:
            role, reported = sensor.role, sensor.signal.reported
            if reported is None or (role == "gps_speed" and not fix):
                continue
            speed = reported * self._scale[role]
            sensor.time_unchanged(dt, speed)
            speeds[role] = speed if speed < -CONFIG.reverse_m_s else abs(speed)
            usual = CONFIG.speed_sd_m_s + CONFIG.speed_sd_relative * abs(speed)
            tolerance[role] = usual + CONFIG.hardest_m_s2 * max(now - sensor.signal.time, 0.0)
        self.disputed = self.on_road = False
        believed = {role: speed for role, speed in speeds.items() if not self.sensors[role].faulty}
        self.roles = tuple(believed or speeds)
        ordered = sorted((believed or speeds).values())  # importing `statistics` would cost 6 ms at each start
        self.median = (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2 if ordered else None
        if len(speeds) == 1:
            self._test_single(dt, speeds, gap)
        else:
            self.odometer.restart(None)
            if speeds:
                self._test_group(dt, speeds, tolerance, believed)
        self.disputed |= bool(speeds) and not believed

    def _test_group(
        self, dt: float, speeds: dict[str, float], tolerance: dict[str, float], believed: dict[str, float]
    ) -> None:
        middle, stuck_s = self.median or 0.0, CONFIG.brief_s
        moving = middle > CONFIG.moving_m_s
        outvoted, tied = vote(speeds, tolerance, spins=False)
        if not outvoted | tied:
            if moving:
                self._spinning = max(self._spinning - dt, 0.0)
                outvoted = self._drifting(dt, speeds, middle)
        elif not any(vote(speeds, tolerance)):  # the driven axle against the ground
            moving = min(speeds.values()) > CONFIG.moving_m_s  # else on a roller bench
            self._spinning = min(self._spinning + dt, 1.5 * CONFIG.wheelspin_s) if moving else self._spinning
            if self._spinning < CONFIG.wheelspin_s:
                outvoted, tied, self.disputed = NO_SENSOR, NO_SENSOR, moving
        if tied:
            stuck = frozenset(role for role in tied if self.sensors[role].unchanged >= stuck_s)
            if believed and believed != speeds and not any(vote(believed, tolerance, spins=False)):
                outvoted, tied = tied - believed.keys(), NO_SENSOR  # the sensors found out before explain it
            elif stuck and stuck != tied:
                outvoted, tied = stuck, NO_SENSOR
        self.disputed |= bool(tied)
        ground = [abs(speeds[role] - middle) <= tolerance[role] for role in GROUND if role in speeds.keys() - outvoted]
        self.on_road = not tied and any(ground) and all(self.sensors[role].faulty for role in outvoted)
        for role in speeds:
            sensor = self.sensors[role]
            comparable = middle > CONFIG.moving_m_s and sensor.unchanged < stuck_s
            against = role in outvoted or role in tied
            sensor.judge(dt, True if against else False if comparable else None, role in tied)

    def _drifting(self, dt: float, speeds: Mapping[str, float], middle: float) -> frozenset[str]:
        """Roles that differ from the median in the mean; it takes three speeds to say which."""
        if len(speeds) < 3:
            return NO_SENSOR
        drift, share = self._drift, share_of_new(dt, CONFIG.settled_s)
        for role, speed in speeds.items():
            drift[role] += share * (speed - middle - drift[role])
        usual = CONFIG.agreeing_residual * (CONFIG.speed_sd_m_s + CONFIG.speed_sd_relative * middle)
        return frozenset([role for role in speeds if abs(drift[role]) > usual])

    def _test_single(self, dt: float, speeds: Mapping[str, float], gap: bool) -> None:
        """Compare the only speed with the odometer, which is no witness among others: it is often made from one."""
        ((role, speed),) = speeds.items()
        sensor = self.sensors[role]
        stuck = sensor.unchanged > CONFIG.short_s
        contradicts = self.odometer.step(dt, abs(speed), stuck, gap)
        if contradicts is not None:
            # A speed that is stuck is wrong; of two that differ by a factor neither is known to be right.
            seconds = CONFIG.faulty_after_s if contradicts else CONFIG.recovered_after_s
            for blamed in (sensor,) if stuck and contradicts else (sensor, self.sensors["odometer"]):
                blamed.judge(seconds, contradicts)
        sensor.signal.trusted = not sensor.faulty

    def _is_carried(self, dt: float) -> bool:
        """Whether only the GPS moves, as in a van: motor and wheels rest, and no current drives."""
        signals = self._signals
        current = signals.inverter_current.reported
        current = signals.pack_current.reported if current is None else current
        rests = current is not None and abs(current) <= self._idle_current
        if rests:
            own = [signals[role].reported for role in self.sensors if role in WHEELS or role == "vehicle_speed"]
            shown = [abs(speed) for speed in own if speed is not None]
            rests = bool(shown) and max(shown) <= MOVING
        moves = (signals.gps_speed.reported or 0.0) >= CONFIG.speed_sd_m_s
        # A sensor that dies on the road has shown no rest before.
        self._rest = self._rest + dt if rests and (not moves or self._rest >= CONFIG.short_s) else 0.0
        return self._rest >= CONFIG.short_s and (moves or signals.carried)


class OdometerTest:
    """Compares the distance by the only speed with that of the odometer.

    Odometers count in steps of up to a kilometre. One that does not count, was set or stalls proves nothing.
    """

    def __init__(self, signals: Signals) -> None:
        self._signal = signals.odometer
        self.compared = 0.0  # m over which the two last contradicted each other
        self._heard = float("-inf")  # s, the last message of the odometer
        self.restart(None)

    def restart(self, value: float | None, counts: int = -1) -> None:
        """Start a comparison at an odometer reading [m]; None: not all of the way is known by a single speed."""
        self._value, self._counts = value, counts  # m, at the last count; the first count has begun before
        self._counted = self._ridden = 0.0  # m by odometer and by speed, up to the last count
        self._since = self._waited = 0.0  # m by speed and s since then

    def step(self, dt: float, speed: float, stuck: bool, gap: bool) -> bool | None:
        """Whether the two contradict each other, where a comparison at a speed [m/s] ends; otherwise None."""
        signal = self._signal
        silence, self._heard = signal.time - self._heard, signal.time
        self._since += speed * dt
        self._waited += dt
        if self._value is None or silence > CONFIG.short_s or gap:
            self.restart(signal.value)
        count, late = signal.value - (self._value or 0.0), CONFIG.odometer_late_m
        stalled = self._counted and self._since > CONFIG.odometer_unit_ratio * self._counted / self._counts + late
        if stalled or not 0 <= count <= CONFIG.fastest_m_s * self._waited + late:
            self.restart(signal.value)
            return None
        if not count:
            return None
        self._counts += 1
        if self._counts > 0:
            self._counted += count
            self._ridden += self._since
        self._value, self._since, self._waited = signal.value, 0.0, 0.0
        if self._counted < CONFIG.stretch_m or self._counts < 3:
            return None
        more, less = max(self._counted, self._ridden), min(self._counted, self._ridden)
        contradicts = more - less > max(CONFIG.odometer_sd * more, self._counted / self._counts)
        self.compared = self._ridden if contradicts else self.compared
        self.restart(signal.value, counts=0)
        return contradicts if stuck or more < CONFIG.odometer_unit_ratio * less else None


class GradeDifference:
    """Difference of two witnesses of the grade over `stretch_m`, beyond the usual one.

    The usual one is learned: mounting of the accelerometer, errors of the model, wind. sd: of the rest.
    """

    def __init__(self, sd: float) -> None:
        self._sd = sd
        self._difference, self._usual = ResidualTest(CONFIG.stretch_m), ResidualTest(CONFIG.usual_m)
        self._usual.seen = CONFIG.usual_prior_m
        self.usual = 0.0  # as far as a mounting angle explains it
        self.unusual = 0.0  # difference beyond the usual one
        self.residual = 0.0  # the same over its sd

    def add(self, distance: float, climb: float) -> None:
        """Add `climb` [m] of the one witness beyond that of the other over `distance` [m]."""
        self._difference.update(distance, climb / distance)
        self.usual = min(max(self._usual.difference, -CONFIG.usual_most), CONFIG.usual_most)
        self.unusual = self._difference.difference - self.usual
        # The sd is larger over a short distance and before the usual difference is known.
        learned = self._usual.seen - CONFIG.usual_prior_m
        unknown = CONFIG.usual_most * max(1 - learned / CONFIG.usual_known_m, 0.0)
        short = CONFIG.stretch_m / max(min(self._difference.seen, CONFIG.stretch_m), 1.0)
        self.residual = abs(self.unusual) / hypot(self._sd * sqrt(short), unknown)

    def learn(self, distance: float) -> None:
        """Learn the usual difference from another `distance` [m] without a doubt."""
        self._usual.update(distance, self._difference.difference)


class GradeCheck:
    """Leaves out accelerometer or altitude; mass of vehicle and payload [kg]."""

    def __init__(
        self, signals: Signals, speeds: SpeedCheck, altitude: SlowSensor, mass: float, level_power: LevelPower
    ) -> None:
        self._signals, self._speeds, self._level_power = signals, speeds, level_power
        self._weight = mass * GRAVITY
        self.accelerometer, self.altitude = Sensor("accel_x", signals.accel_x), altitude
        self._gain = ResponseGain(CONFIG.gain_mean_s, CONFIG.recovered_after_s, CONFIG.gain_least_m2_s3)
        self._inertial = GradeDifference(CONFIG.grade_sd)  # accelerometer less altitude
        self._energy_inertial, self._energy_altitude = (GradeDifference(CONFIG.energy_sd) for _ in range(2))
        self._before: float | None = None  # m, altitude at the end of the last interval
        self._begin(0.0, None)

    def _begin(self, now: float, speed: float | None) -> None:
        """Begin an interval at `now` [s] and a speed [m/s] by the sensors that are believed."""
        self._begun, self._speed, self._roles = now, speed, self._speeds.roles
        self._seconds = self._distance = 0.0
        self._impulse: float | None = 0.0  # m/s, by the accelerometer
        self._work: float | None = 0.0  # J, from the pack

    def compare(self, now: float, dt: float, gap: bool, power: float | None) -> None:
        """Compare the witnesses over `dt` [s].

        gap: messages were missing before, and changes are no rates. power: of the pack [W], None where it is unknown.
        """
        signals, speeds = self._signals, self._speeds
        speed = None if speeds.disputed else speeds.median
        if gap:
            self._before = None
        if gap or speed is None or self._speed is None or speeds.roles != self._roles:
            self._begin(now, speed)
            return
        forward = signals.accel_x.reported
        self._seconds += dt
        self._distance += abs(speed) * dt
        self._impulse = None if self._impulse is None or forward is None else self._impulse + forward * dt
        self._work = None if self._work is None or power is None else self._work + power * dt
        # A speed that is held between messages has no acceleration: wait for the next ones.
        if self._seconds >= CONFIG.brief_s and all(signals[role].time > self._begun for role in speeds.roles):
            acceleration = (speed - self._speed) / self._seconds
            if abs(acceleration) < CONFIG.hardest_m_s2:
                self._end_interval(now, acceleration)
                self.accelerometer.signal.trusted = not self.accelerometer.faulty
                self.altitude.signal.trusted = self.altitude.possible and not self.altitude.faulty
            self._begin(now, speed)

    def _end_interval(self, now: float, acceleration: float) -> None:
        distance, seconds, accelerometer = self._distance, self._seconds, self.accelerometer
        known = self.altitude.possible and not self._signals.fix_below(now, FIX_3D)
        before, self._before = self._before, self.altitude.signal.reported if known else None
        rise = None if self._before is None or before is None else self._before - before
        climb, wrong_gain = None, False
        if self._impulse is not None:
            forward = self._impulse / seconds
            climb = grade_shown(forward, acceleration) * distance
            if self._speeds.on_road:
                self._gain.update(seconds, acceleration, forward)
                gain = self._gain.ratio
                wrong_gain = gain is not None and not 1 / CONFIG.gain_high < gain < CONFIG.gain_high
            if wrong_gain:
                accelerometer.judge(seconds, True)
        if distance / seconds < CONFIG.moving_m_s:
            return
        energy = None
        if self._work is not None and self._work > 0:  # brakes take what a descent gives: energy does not show it
            level = self._level_power(distance / seconds, acceleration) * seconds
            energy = (self._work - level) / self._weight
        witnesses = (
            (self._inertial, climb, rise),
            (self._energy_inertial, energy, climb),
            (self._energy_altitude, energy, rise),
        )
        pairs = [
            (pair, first - second) for pair, first, second in witnesses if first is not None and second is not None
        ]
        if not pairs:
            return
        for pair, difference in pairs:
            pair.add(distance, difference)
        residual = pairs[0][0].residual  # accelerometer against altitude, or a single one of them against the energy
        if CONFIG.agreeing_residual < residual <= 1:
            return  # nothing is proven
        compared = [sensor for sensor, shown in ((accelerometer, climb), (self.altitude, rise)) if shown is not None]
        against: Sequence[Sensor] = ()
        if residual > 1 and wrong_gain:
            against = (accelerometer,)
        elif residual > 1:
            by_energy = (self._energy_inertial.unusual, self._energy_altitude.unusual)
            first, second = ((off / CONFIG.energy_decides_sd) ** 2 for off in by_energy)
            against = compared if len(compared) == 1 else explain(compared, (first, second))
        for sensor in compared:
            sensor.judge(seconds, sensor in against, disputed=len(against) > 1)
        if not (against or accelerometer.faulty or self.altitude.faulty):
            for pair, _ in pairs:
                pair.learn(distance)

    @property
    def offset(self) -> float:
        """Add this to the grade by the accelerometer: its mounting, learned before any sensor was doubted."""
        return 0.0 if self.accelerometer.faulty else -self._inertial.usual
