"""Speeds of motor, wheels, vehicle and GPS by majority; the only one of a vehicle against its odometer."""

from __future__ import annotations

from collections.abc import Mapping

from gz_onboard.estimator.plausibility.residual import (
    CONFIG,
    NO_SENSOR,
    FaultCounter,
    ResidualTest,
    StepInputs,
    UnchangedTimer,
)
from gz_onboard.estimator.signals import FIX_2D
from gz_onboard.events import SPEEDS
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
    weights = {group: _witnesses(group) - (not spins and group >= AXLE) for group in groups}
    best = max(groups, key=lambda group: (weights[group], sorted(group)))
    others = everyone - best
    if spins and any(side - {"vehicle_speed"} == AXLE for side in (best, others)):
        return NO_SENSOR, NO_SENSOR
    if any(weights[group] >= weights[best] for group in groups if not group & best):
        return NO_SENSOR, everyone
    return others, NO_SENSOR


def _witnesses(group: frozenset[str]) -> int:
    """Number of independent sensors: a vehicle speed repeats the wheel from which it is made."""
    return len(group - {"vehicle_speed"} if group & WHEELS else group)


class SpeedCheck:
    """Leaves out speeds that the majority contradicts, and tells whether the vehicle is carried.

    radius of the wheel [m]; gear: wheel over motor speed; capacity of the pack [Ah].
    """

    def __init__(self, radius: float, gear: float, capacity: float) -> None:
        self._scale = speed_factors(radius, gear)
        self._idle_current = CONFIG.idle_rate * capacity  # A
        self.counters = {role: FaultCounter() for role in (*SPEEDS, "odometer")}
        self.odometer = OdometerTest()
        self._unchanged = {role: UnchangedTimer() for role in SPEEDS}
        self._drift = {role: ResidualTest(CONFIG.drift_time_s, CONFIG.drift_time_s) for role in SPEEDS}
        self._spinning = 0.0  # s in which driven axle and ground move at different speeds
        self._rest = CONFIG.carried_rest_s  # s, the last of it before the GPS began to move
        self.median: float | None = None  # m/s, of the sensors of
        self.roles: tuple[str, ...] = ()  # these roles, which are not faulty
        self.on_road = False  # the ground moves as fast as the driven wheel: no roller bench
        self.disputed = False  # sensors contradict each other and nothing decides

    def step(self, step: StepInputs) -> None:
        """Check the speeds of this step."""
        step.signals.carried = self._is_carried(step)
        speeds, apart = self._read(step)
        self.disputed = self.on_road = False
        believed = {role: speed for role, speed in speeds.items() if not self.counters[role].faulty}
        self.roles = tuple(believed or speeds)
        ordered = sorted(speeds[role] for role in self.roles)  # importing `statistics` would cost 6 ms at each start
        self.median = (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2 if ordered else None
        if len(speeds) == 1:
            self._test_alone(step, *speeds.items())
        else:
            self.odometer.restart(None)
            if speeds:
                self._test_group(step, speeds, apart, believed)
        self.disputed |= bool(speeds) and not believed

    def _read(self, step: StepInputs) -> tuple[dict[str, float], dict[str, float]]:
        """(speeds, most by which each may differ from another) [m/s] by role, of the sensors that report."""
        speeds: dict[str, float] = {}
        apart: dict[str, float] = {}
        fix = not step.signals.fix_below(step.now, FIX_2D)
        step.signals.gps_speed.trusted = step.signals.gps_course.trusted = fix
        for role in SPEEDS if fix else SPEEDS[:-1]:
            signal = step.signals[role]
            reported = signal.reported
            if reported is not None:
                speed = reported * self._scale[role]
                self._unchanged[role].update(step.observed, speed)
                speeds[role] = speed if speed < -CONFIG.reverse_m_s else abs(speed)
                age = max(step.now - signal.time, 0.0)
                usual = CONFIG.speed_sd_m_s + CONFIG.speed_sd_relative * abs(speed)
                apart[role] = usual + CONFIG.speed_change_m_s2 * age
        return speeds, apart

    def _test_group(
        self, step: StepInputs, speeds: dict[str, float], apart: dict[str, float], believed: dict[str, float]
    ) -> None:
        dt, middle = step.observed, self.median or 0.0
        both_move = self._follow_wheelspin(dt, speeds)
        outvoted, tied = vote(speeds, apart, spins=self._spinning < CONFIG.wheelspin_s)
        if not any(vote(speeds, apart, spins=False)):
            outvoted = self._follow_drift(dt, speeds, middle) if middle > CONFIG.moving_m_s else NO_SENSOR
        elif not (outvoted or tied):
            self.disputed = both_move  # else on a roller bench
        elif tied:
            stuck = {role for role in tied if self._unchanged[role].seconds >= CONFIG.stuck_s}
            if believed and believed != speeds and not any(vote(believed, apart, spins=False)):
                outvoted, tied = tied - believed.keys(), NO_SENSOR  # the sensors found out before explain it
            elif stuck and stuck != tied:
                outvoted, tied = frozenset(stuck), NO_SENSOR
        self.disputed |= bool(tied)
        certain = not tied and all(self.counters[role].faulty for role in outvoted)
        ground = [abs(speeds[role] - middle) <= apart[role] for role in GROUND if role in speeds.keys() - outvoted]
        self.on_road = certain and any(ground)
        for role in speeds:
            against = role in outvoted | tied
            comparable = middle > CONFIG.moving_m_s and self._unchanged[role].seconds < CONFIG.stuck_s
            self.counters[role].update(dt, against if against or comparable else None, role in tied)
            step.signals[role].trusted = not (self.counters[role].faulty or role in outvoted)

    def _follow_wheelspin(self, dt: float, speeds: Mapping[str, float]) -> bool:
        """Time how long the driven axle turns at another speed than the moving ground; returns whether both move."""
        axle, ground = ([speeds[role] for role in side if role in speeds] for side in (AXLE, GROUND))
        both_move = bool(axle and ground) and min(axle + ground) > CONFIG.moving_m_s
        if both_move:
            differ = abs(sum(axle) / len(axle) / (sum(ground) / len(ground)) - 1) > CONFIG.wheelspin_sd
            self._spinning = min(max(self._spinning + (dt if differ else -dt), 0.0), 1.5 * CONFIG.wheelspin_s)
        return both_move

    def _follow_drift(self, dt: float, speeds: Mapping[str, float], middle: float) -> frozenset[str]:
        """Roles that differ from the median in the mean; it takes three speeds to say which."""
        for role, speed in speeds.items():
            usual = CONFIG.speed_sd_m_s + CONFIG.speed_sd_relative * middle
            self._drift[role].update(dt, speed - middle, CONFIG.agreeing_residual * usual)
        return frozenset(role for role in speeds if len(speeds) > 2 and self._drift[role].contradicts)

    def _test_alone(self, step: StepInputs, alone: tuple[str, float]) -> None:
        """Compare the only speed with the odometer, which is no witness among others: it is often made from one."""
        role, speed = alone
        stuck = self._unchanged[role].seconds > CONFIG.slowly_stuck_s
        contradicts = self.odometer.step(step, abs(speed), stuck)
        if contradicts is not None:
            # A speed that is stuck is wrong; of two that differ by a factor neither is known to be right.
            seconds = CONFIG.faulty_after_s if contradicts else CONFIG.recovered_after_s
            for blamed in (role,) if stuck and contradicts else (role, "odometer"):
                self.counters[blamed].update(seconds, contradicts)
        step.signals[role].trusted = not self.counters[role].faulty

    def _is_carried(self, step: StepInputs) -> bool:
        """Whether only the GPS moves, as in a van: motor and wheels rest, and no current drives."""
        signals = step.signals
        current = signals.inverter_current.reported
        current = signals.pack_current.reported if current is None else current
        own = [abs(value) for role in SPEEDS[:-1] if (value := signals[role].reported) is not None]
        at_rest = bool(own) and max(own) <= CONFIG.rest_noise
        if not at_rest or current is None or abs(current) > self._idle_current:
            self._rest = 0.0
            return False
        moves = (signals.gps_speed.reported or 0.0) >= CONFIG.speed_sd_m_s
        if not moves:
            self._rest += step.observed
        elif self._rest < CONFIG.carried_rest_s:
            self._rest = 0.0
        return self._rest >= CONFIG.carried_rest_s and (moves or signals.carried)


class OdometerTest:
    """Compares the distance by the only speed with that of the odometer.

    Odometers count in steps of up to a kilometre. One that does not count, was set or stalls proves nothing.
    """

    def __init__(self) -> None:
        self.compared = 0.0  # m over which the two last contradicted each other
        self._heard = float("-inf")  # s, the last message of the odometer
        self.restart(None)

    def restart(self, value: float | None, counts: int = -1) -> None:
        """Start a comparison at an odometer reading [m]; None: not all of the way is known by a single speed."""
        self._value, self._counts = value, counts  # m, at the last count; the first count has begun before
        self._counted = self._ridden = 0.0  # m by odometer and by speed, up to the last count
        self._since = self._waited = 0.0  # m by speed and s since then

    def step(self, step: StepInputs, speed: float, stuck: bool) -> bool | None:
        """Whether the two contradict each other, where a comparison at a speed [m/s] ends; otherwise None."""
        signal = step.signals.odometer
        heard, self._heard = self._heard, signal.time
        self._since += speed * step.observed
        self._waited += step.observed
        if self._value is None or step.now - heard > CONFIG.odometer_silence_s or step.observed < step.dt:
            self.restart(signal.value)
        count, late = signal.value - (self._value or 0.0), CONFIG.odometer_late_m
        usual = self._counted / max(self._counts, 1)
        stalled = usual and self._since > CONFIG.odometer_unit_ratio * usual + late
        if count < 0 or count > CONFIG.fastest_m_s * self._waited + late or stalled:
            self.restart(signal.value)
        if count <= 0 or self._value == signal.value:
            return None
        self._counts += 1
        if self._counts > 0:
            self._counted += count
            self._ridden += self._since
        self._value, self._since, self._waited = signal.value, 0.0, 0.0
        more, less = max(self._counted, self._ridden), min(self._counted, self._ridden)
        if self._counted < CONFIG.odometer_stretch_m or self._counts < 3:
            return None
        contradicts = more - less > max(CONFIG.odometer_sd * more, self._counted / self._counts)
        self.compared = self._ridden if contradicts else self.compared
        self.restart(signal.value, counts=0)
        return contradicts if stuck or more < CONFIG.odometer_unit_ratio * less else None
