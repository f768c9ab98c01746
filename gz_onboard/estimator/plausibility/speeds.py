"""Speeds of motor, wheels, vehicle and GPS by majority; the only one of a vehicle against its odometer."""

from __future__ import annotations

from collections.abc import Mapping

from gz_onboard.estimator.plausibility.residual import CONFIG, NO_SENSOR, Sensor, share_of_new
from gz_onboard.estimator.signals import FIX_2D, Signals
from gz_onboard.events import SPEEDS
from gz_onboard.physics.effect import MOVING
from gz_onboard.physics.sensors import speed_factors

AXLE = frozenset({"motor_speed", "wheel_speed_rear"})  # turn on a roller bench and in wheelspin
GROUND = ("wheel_speed_front", "gps_speed")
WHEELS = AXLE | {"wheel_speed_front"}  # from one of which a vehicle speed is made


def vote(
    speeds: Mapping[str, float], apart: Mapping[str, float], spins: bool = True
) -> tuple[frozenset[str], frozenset[str]]:
    """Find the majority: (outvoted roles, roles that contradict each other with nothing to decide).

    speeds [m/s] by role; apart: the most [m/s] by which each may differ from another. spins: a driven axle that
    contradicts the ground may be wheelspin, no fault; otherwise it counts as one witness, scaled by one wheel radius.
    """
    if max(speeds.values()) - min(speeds.values()) <= min(apart.values()):
        return NO_SENSOR, NO_SENSOR
    groups = {
        frozenset(b for b, w in speeds.items() if abs(v - w) <= max(apart[a], apart[b])) for a, v in speeds.items()
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
        apart: dict[str, float] = {}  # m/s, the most by which each may differ from another
        for sensor in self._speeds:
            role, reported = sensor.role, sensor.signal.reported
            if reported is None or (role == "gps_speed" and not fix):
                continue
            speed = reported * self._scale[role]
            sensor.time_unchanged(dt, speed)
            speeds[role] = speed if speed < -CONFIG.reverse_m_s else abs(speed)
            usual = CONFIG.speed_sd_m_s + CONFIG.speed_sd_relative * abs(speed)
            apart[role] = usual + CONFIG.hardest_m_s2 * max(now - sensor.signal.time, 0.0)
        self.disputed = self.on_road = False
        believed = {role: speed for role, speed in speeds.items() if not self.sensors[role].faulty}
        self.roles = tuple(believed or speeds)
        ordered = sorted((believed or speeds).values())  # importing `statistics` would cost 6 ms at each start
        self.median = (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2 if ordered else None
        if len(speeds) == 1:
            self._test_alone(dt, speeds, gap)
        else:
            self.odometer.restart(None)
            if speeds:
                self._test_group(dt, speeds, apart, believed)
        self.disputed |= bool(speeds) and not believed

    def _test_group(
        self, dt: float, speeds: dict[str, float], apart: dict[str, float], believed: dict[str, float]
    ) -> None:
        middle, stuck_s = self.median or 0.0, CONFIG.brief_s
        moving = middle > CONFIG.moving_m_s
        outvoted, tied = vote(speeds, apart, spins=False)
        if not outvoted | tied:
            if moving:
                self._spinning = max(self._spinning - dt, 0.0)
                outvoted = self._drifting(dt, speeds, middle)
        elif not any(vote(speeds, apart)):  # the driven axle against the ground
            moving = min(speeds.values()) > CONFIG.moving_m_s  # else on a roller bench
            self._spinning = min(self._spinning + dt, 1.5 * CONFIG.wheelspin_s) if moving else self._spinning
            if self._spinning < CONFIG.wheelspin_s:
                outvoted, tied, self.disputed = NO_SENSOR, NO_SENSOR, moving
        if tied:
            stuck = frozenset(role for role in tied if self.sensors[role].unchanged >= stuck_s)
            if believed and believed != speeds and not any(vote(believed, apart, spins=False)):
                outvoted, tied = tied - believed.keys(), NO_SENSOR  # the sensors found out before explain it
            elif stuck and stuck != tied:
                outvoted, tied = stuck, NO_SENSOR
        self.disputed |= bool(tied)
        ground = [abs(speeds[role] - middle) <= apart[role] for role in GROUND if role in speeds.keys() - outvoted]
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

    def _test_alone(self, dt: float, speeds: Mapping[str, float], gap: bool) -> None:
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
