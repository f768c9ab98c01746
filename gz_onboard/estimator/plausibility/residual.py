"""The mechanism of all sensor checks, their configuration, and the checks of single sensors against physical limits.

A residual is a measured value minus its prediction from other sensors, from a model or from its own past. It is divided
by the standard deviation that a healthy pair of sensors may show, so that 1 is the limit for all quantities alike
(Isermann 2006, *Fault-Diagnosis Systems*, ch. 10; Gertler 1998). Checks depend on elapsed seconds or metres, never on
a number of steps.

Slow signals, as temperatures and altitude, are predicted by their own past: they cannot change faster than heat flows
or a road climbs. Inertial axes are held against the limits of a vehicle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

from gz_onboard.constants import GRAVITY
from gz_onboard.estimator.motion import MOTION
from gz_onboard.estimator.signals import FIX_3D, Signal, Signals

NO_SENSOR: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class PlausibilityConfig:
    """Constants of the sensor checks. A rate [1/h] is a current over the capacity of the pack in ampere-hours."""

    # Times over which evidence is gathered.
    brief_s: float = 1.0  # a fast sensor that shows the same to the last bit for longer is stuck; an interval of grades
    short_s: float = 10.0  # electrical residuals; rest before being carried; a single speed may be steady for so long
    settled_s: float = 30.0  # what has held for so long is a reference; means of axes, drift of speeds, voltage sag
    lasting_s: float = 300.0  # lasting errors: the difference of the two currents, the error of the cell model

    # Residual test and fault counter.
    faulty_after_s: float = 3.0  # of contradiction; wheels spin or lock for a second or two
    recovered_after_s: float = 60.0  # of agreement
    agreement_weight: float = 0.5  # seconds of contradiction that one second of agreement cancels
    dispute_weight: float = 0.2  # of contradiction, against each of two members while nothing decides
    residual_clip: float = 5.0  # sd; one spike must not outlast the averaging time
    agreeing_residual: float = 0.5  # sd; between this and 1 nothing is proven
    isolating_ratio: float = 2.5  # of mean squares: the member with the larger one is wrong
    gain_low: float = 0.55  # of a response over its prediction: 0.6 to 1.3 on recorded rides, more on an aged pack
    gain_high: float = 1.6

    # Speeds and distance.
    moving_m_s: float = 2.0  # slower, wheel sensors lose their teeth and agreement proves little
    speed_sd_m_s: float = 1.0
    speed_sd_relative: float = 0.12  # tyres, scales and delays
    hardest_m_s2: float = 5.0  # full braking
    reverse_m_s: float = 4.0  # no road vehicle reverses faster; below, most sensors show no direction
    wheelspin_s: float = 20.0  # wheels do not spin against moving ground for longer
    fastest_m_s: float = 70.0
    stretch_m: float = 1000.0  # over which odometer and speed, accelerometer and altitude are compared
    odometer_sd: float = 0.15  # relative; tyres, scales and the times of the counts
    odometer_unit_ratio: float = 5.0  # beyond, it counts in another unit or has stalled
    odometer_late_m: float = 100.0  # by how much a count may come too late

    # Currents and voltages; voltages per cell.
    idle_rate: float = 0.05  # 1/h; lights and electronics take less, driving takes more
    current_sd_rate: float = 0.10  # 1/h
    current_sd_relative: float = 0.10
    current_skew_s: float = 2.0  # the two sensors do not sample at the same time
    road_sd_relative: float = 0.7  # of the current by the road load; wind, payload and slip
    cell_sd_v: float = 0.031  # of the cell model
    gross_cell_error_v: float = 0.4  # no healthy current makes such an error
    voltage_sd_v: float = 0.07
    voltage_skew_s: float = 0.3  # for so long a change of one may be missing in the other
    lowest_voltage_ratio: float = 0.6  # of the cut-off voltage
    highest_voltage_ratio: float = 1.12  # of the voltage of a full cell at rest
    sag_mean_s: float = 0.5  # faster changes of the voltage are those of the current
    sag_least_v2s: float = 0.003  # smaller changes of the current prove nothing
    sag_explained_share: float = 0.6  # of the variance of the voltage

    # Grade (sine of the road's angle) and altitude.
    gain_mean_s: float = 20.0  # of gravity on hills and of mounting, which are no acceleration
    gain_least_m2_s3: float = 10.0  # smaller changes of speed prove nothing
    usual_m: float = 5000.0  # over which the mounting angle and the model's usual error are learned
    usual_known_m: float = 1500.0  # after which a larger mounting angle is no longer expected
    usual_prior_m: float = 350.0  # weight of the expectation that there is none
    usual_most: float = 0.05  # three degrees of mounting
    grade_sd: float = 0.016  # accelerometer against altitude; 0.010 at most on the commissioning rides
    energy_sd: float = 0.06  # against the energy, most of it wind
    energy_decides_sd: float = 0.01  # wind is common to both comparisons with the energy
    jump: float = 6.0  # m of a GPS receiver; K between two messages, and their resolution
    altitude_wander_m_s: float = 1.0


CONFIG = PlausibilityConfig()
# Lowest and highest temperature [degC] that vehicles have, fastest rise and fall [K/s]. Cells heat themselves, but cool
# through their pack.
LIMITS = {
    "cell_temperature": (-40.0, 85.0, 0.05, 0.01),
    "ambient_temperature": (-50.0, 65.0, 0.5, 0.5),
    "motor_temperature": (-50.0, 220.0, 3.0, 3.0),
    "inverter_temperature": (-50.0, 180.0, 3.0, 3.0),
}
# Mean over `settled_s` that a vehicle can have (leaning, on a side stand, on a hill) and its limit; m/s², rad/s.
AXES = {
    "accel_y": (0.0, 5.0),
    "accel_z": (GRAVITY, 3.25),
    "rate_x": (0.0, 0.15),
    "rate_y": (0.0, 0.15),
    "rate_z": (0.0, 0.8),
}


def share_of_new(dt: float, time: float) -> float:
    """Weight of a value that represents `dt` in a mean over `time`; both in seconds or in metres."""
    return dt / time if dt < time else 1.0


class Sensor:
    """One checked sensor: the evidence against it, and whether its signal is trusted."""

    def __init__(self, role: str, signal: Signal) -> None:
        self.role, self.signal = role, signal
        self.contradicted = 0.0  # s, less `agreement_weight` of the time of agreement
        self.agreed = 0.0  # s of agreement since the last contradiction
        self.faulty = False
        self.unchanged = 0.0  # s for which it has shown the same value to the last bit
        self._value: float | None = None

    def time_unchanged(self, dt: float, value: float) -> None:
        """Add `dt` [s] to `unchanged` if it shows this value again."""
        self.unchanged = self.unchanged + dt if value == self._value else 0.0
        self._value = value

    def judge(self, dt: float, contradicts: bool | None, disputed: bool = False) -> None:
        """Add `dt` [s] of contradiction or agreement; None: there was nothing to compare the sensor with.

        A sensor that is contradicted is left out at once; it is faulty after `faulty_after_s`. disputed: another sensor
        is as likely to be the cause. Waiting for what decides costs less than losing both.
        """
        if contradicts:
            self.agreed = 0.0
            self.contradicted += CONFIG.dispute_weight * dt if disputed else dt
            if self.contradicted >= CONFIG.faulty_after_s:
                self.contradicted, self.faulty = CONFIG.faulty_after_s, True
        elif contradicts is False and self.contradicted + self.faulty:
            self.contradicted = max(self.contradicted - CONFIG.agreement_weight * dt, 0.0)
            self.agreed += dt
            self.faulty = self.faulty and self.agreed < CONFIG.recovered_after_s
        self.signal.trusted = not self.faulty and (disputed or not contradicts)


class ResidualTest:
    """Tests one comparison: a low-passed difference over its standard deviation.

    smoothing: of the difference, a plain mean at first. time: of the mean square of the normalised residual, which
    starts at zero because sensors are believed until there is evidence. Both in seconds or in metres, 0 for none.
    """

    def __init__(self, smoothing: float = 0.0, time: float = 0.0) -> None:
        self._smoothing, self._time = smoothing, time
        self.restart()

    def restart(self) -> None:
        """Forget the evidence."""
        self.difference = self.square = 0.0
        self.seen = 0.0  # s or m

    def update(self, dt: float, difference: float, sd: float = 1.0) -> None:
        """Add `difference` over `dt` [s or m], with the standard deviation that is usual after smoothing."""
        self.seen += dt
        self.difference += (difference - self.difference) * share_of_new(dt, min(self.seen, self._smoothing))
        residual = min(abs(self.difference) / sd, CONFIG.residual_clip)
        self.square += (residual * residual - self.square) * share_of_new(dt, self._time)

    @property
    def contradicts(self) -> bool:
        """Whether the residual is larger than healthy sensors explain."""
        return self.square > 1.0


class ResponseGain:
    """Regression of a measured response on the predicted one, both without their means over `mean_time` [s].

    memory: [s]. least: square of the predicted one times seconds; below, nothing is proven.
    """

    def __init__(self, mean_time: float, memory: float, least: float) -> None:
        self._mean_time, self._memory, self._least = mean_time, memory, least
        self._means: tuple[float, float] | None = None  # of predicted and measured
        self._product = self._square = self._variance = 0.0  # times seconds
        self.ratio: float | None = None  # measured over predicted response; None while that has hardly changed

    def update(self, dt: float, predicted: float, measured: float) -> None:
        """Add a pair, `dt` [s] after the last."""
        if self._means is None or dt > 2 * self._mean_time:  # after a gap
            self._means = predicted, measured
            return
        x, y = predicted - self._means[0], measured - self._means[1]
        share, keep = share_of_new(dt, self._mean_time), 1 - share_of_new(dt, self._memory)
        self._means = self._means[0] + x * share, self._means[1] + y * share
        self._product = keep * self._product + x * y * dt
        self._square = keep * self._square + x * x * dt
        self._variance = keep * self._variance + y * y * dt
        self.ratio = self._product / self._square if self._square > self._least else None

    @property
    def explained(self) -> bool:
        """Whether the prediction is the cause of the changes, and of about their size."""
        known = self.ratio is not None and CONFIG.gain_low < self.ratio < CONFIG.gain_high
        return known and self._product**2 > CONFIG.sag_explained_share * self._variance * self._square


def isolate(first: float, second: float) -> int:
    """1 or 2: which of two members a third one contradicts, by the mean squares of their residuals; 0: undecided."""
    if abs(first - second) < 1.0 or max(first, second) < CONFIG.isolating_ratio * min(first, second):
        return 0
    return 1 if first > second else 2


def explain(pair: Sequence[Sensor], *witnesses: tuple[float, float]) -> Sequence[Sensor]:
    """Members that explain the contradiction of a pair: the one found faulty before, or the one that a witness shows.

    witnesses: mean squares of the residuals of the two against a third quantity, the best witness first. Where nothing
    decides, it is both.
    """
    if pair[0].faulty != pair[1].faulty:
        return pair[:1] if pair[0].faulty else pair[1:]
    wrong = next(filter(None, (isolate(*squares) for squares in witnesses)), 0)
    return pair[wrong - 1 : wrong] if wrong else pair


class SlowSensor(Sensor):
    """A sensor that its own past predicts.

    Until it has held for `settled_s`, a jump is taken for the end of a start-up value.
    """

    possible = True  # the last value

    def __init__(
        self, role: str, signal: Signal, low: float = -inf, high: float = inf, agreement: bool | None = False
    ) -> None:
        """agreement: False if a possible value agrees with all that is known; None if other checks tell."""
        super().__init__(role, signal)
        self._low, self._high, self._agreement = low, high, agreement
        self._possible: float | None = None  # the last value that was possible, as near as it can have been
        self._since = self._seen = -inf  # s: of that value, and of the last one
        self._held = 0.0  # s of values that follow from each other

    def check(self, rise: float, fall: float) -> None:
        """Check a new value, if there is one; rise, fall: the fastest since the last [1/s]."""
        signal, value = self.signal, self.signal.reported
        if not signal.count or value is None:
            return
        # One value after a silence is no more evidence than a second, or the period of its message.
        dt, self._seen = min(signal.time - self._seen, max(CONFIG.brief_s, signal.period)), signal.time
        before, age = value if self._possible is None else self._possible, signal.time - self._since
        near = before if value == before else min(max(value, before - fall * age), before + rise * age)
        follows, in_range = abs(value - near) <= CONFIG.jump, self._low < value < self._high
        self.possible = in_range and (follows or self._held < CONFIG.settled_s)
        if self.possible:
            self._held = self._held + dt if follows else 0.0
            self._possible, self._since = near if follows else value, signal.time
        self.judge(dt, self._agreement if self.possible else True)


class LimitCheck:
    """Leaves out slow signals and inertial axes that no vehicle can have."""

    def __init__(self, signals: Signals) -> None:
        self._signals = signals
        self._temperatures = {
            role: SlowSensor(role, signals[role], *LIMITS[role][:2]) for role in signals.mapped(LIMITS)
        }
        self.altitude = SlowSensor("gps_altitude", signals.gps_altitude, agreement=None)
        self._axes = {role: Sensor(role, signals[role]) for role in signals.mapped(AXES)}
        self._means = {role: ResidualTest(CONFIG.settled_s) for role in self._axes}
        self._unchecked = 0.0  # s since the axes were checked
        self.sensors: dict[str, Sensor] = {**self._temperatures, "gps_altitude": self.altitude, **self._axes}

    def step(self, now: float, dt: float, speed: float | None) -> None:
        """Check the values of this step of `dt` [s] in which messages came; speed: of the last step [m/s]."""
        for role, slow in self._temperatures.items():
            slow.check(*LIMITS[role][2:])
        if not self._signals.fix_below(now, FIX_3D):
            climb = MOTION.max_grade * abs(speed or 0.0) + CONFIG.altitude_wander_m_s
            self.altitude.check(climb, climb)
        for axis in self._axes.values():
            if axis.signal.reported is not None:
                axis.time_unchanged(dt, axis.signal.reported)
        self._unchecked += dt
        if self._unchecked < CONFIG.brief_s:
            return
        dt, self._unchecked = self._unchecked, 0.0
        moving = speed is not None and abs(speed) > CONFIG.moving_m_s
        for role, axis in self._axes.items():
            value, mean = axis.signal.reported, self._means[role]
            if value is None:
                continue
            usual, limit = AXES[role]
            mean.update(dt, value - usual, limit)
            # Means of coarse samples can agree for a moment. An axis of exactly 0 is one of a simulated unit.
            stuck = moving and axis.unchanged > CONFIG.brief_s + CONFIG.faulty_after_s and value != 0.0
            # A mean over less than a third of the time may be that of one bend.
            wrong = stuck or (mean.contradicts and mean.seen > CONFIG.settled_s / 3)
            axis.judge(dt, True if wrong else False if moving else None)
