"""Residual test, fault counter and configuration of the sensor checks.

A residual is a measured value minus its prediction from other sensors, from a model or from its own past. It is divided
by the standard deviation that a healthy pair of sensors may show, so that 1 is the limit for all quantities alike
(Isermann 2006, *Fault-Diagnosis Systems*, ch. 10; Gertler 1998). Checks depend on elapsed seconds or metres, never on
a number of steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from gz_onboard.estimator.signals import Signals

NO_SENSOR: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class PlausibilityConfig:
    """Constants of the sensor checks. A rate [1/h] is a current over the capacity of the pack in ampere-hours."""

    # Residual test and fault counter.
    faulty_after_s: float = 3.0  # of contradiction; wheels spin or lock for a second or two
    recovered_after_s: float = 60.0  # of agreement
    agreement_weight: float = 0.5  # seconds of contradiction that one second of agreement cancels
    dispute_weight: float = 0.2  # of contradiction, against each of two members while nothing decides
    residual_clip: float = 5.0  # sd; one spike must not outlast the averaging time
    agreeing_residual: float = 0.5  # sd; between this and 1 nothing is proven
    isolating_ratio: float = 2.5  # of mean squares: the member with the larger one is wrong
    settled_after_s: float = 30.0  # a signal or model that has held for so long is a reference
    evidence_s: float = 1.0  # one value after a silence is no more evidence than this
    stuck_s: float = 1.0  # a fast sensor that does not change to the last bit while others do
    slowly_stuck_s: float = 10.0  # a single speed, which may be steady
    moving_m_s: float = 2.0  # slower, wheel sensors lose their teeth and agreement proves little
    standstill_m_s: float = 0.05

    # Speeds: healthy ones differ by tyres, scales and delays.
    speed_sd_m_s: float = 1.0
    speed_sd_relative: float = 0.12
    speed_change_m_s2: float = 5.0  # possible since the last message, in full braking
    drift_time_s: float = 20.0  # averaged over this, they differ by `agreeing_residual` at most
    reverse_m_s: float = 4.0  # no road vehicle reverses faster; below, most sensors show no direction
    wheelspin_s: float = 20.0  # wheels do not spin against moving ground for longer
    wheelspin_sd: float = 0.15  # of the speed of the driven axle over that of the ground
    carried_rest_s: float = 10.0  # of rest before only the GPS moves; a sensor that dies on the road has none
    idle_rate: float = 0.05  # 1/h; lights and electronics take less, driving takes more
    rest_noise: float = 0.5  # m/s or rad/s of a wheel or motor at rest

    # Odometer against the only speed.
    odometer_stretch_m: float = 1000.0  # the shortest comparison, and three counts
    odometer_sd: float = 0.15  # relative; tyres, scales and the times of the counts
    odometer_unit_ratio: float = 5.0  # beyond, it counts in another unit or has stalled
    odometer_late_m: float = 100.0  # by how much a count may come too late
    odometer_silence_s: float = 10.0  # after which the time of a count is unknown
    fastest_m_s: float = 70.0

    # Currents.
    current_skew_s: float = 2.0  # the two sensors do not sample at the same time
    electrical_time_s: float = 10.0
    current_sd_rate: float = 0.10  # 1/h
    current_sd_relative: float = 0.10
    current_offset_time_s: float = 300.0  # over which a lasting difference of the two is measured
    road_sd_relative: float = 0.7  # of the current by the road load; wind, payload and slip
    cell_sd_v: float = 0.031  # per cell, of the cell model
    gross_cell_error_v: float = 0.4  # per cell; no healthy current makes such an error

    # Voltages per cell.
    voltage_sd_v: float = 0.07
    voltage_skew_s: float = 0.3  # for so long a change of one may be missing in the other
    cell_model_time_s: float = 300.0  # over which the usual error of the cell model is learned
    lowest_voltage_ratio: float = 0.6  # of the cut-off voltage
    highest_voltage_ratio: float = 1.12  # of the voltage of a full cell at rest

    # Voltage sag over the predicted one: 0.6 to 1.3 on recorded rides, up to 2 on an aged pack.
    sag_fast_s: float = 0.5  # high pass
    sag_time_s: float = 30.0
    sag_least_v2s: float = 0.003  # per cell; smaller changes of the current prove nothing
    sag_low: float = 0.55
    sag_high: float = 1.45
    sag_explained_share: float = 0.6  # of the variance of the voltage

    # Inertial unit and grade (sine of the road's angle).
    axis_time_s: float = 30.0
    interval_s: float = 1.0  # over which accelerometer, altitude and energy are compared
    gain_time_s: float = 60.0
    gain_mean_time_s: float = 20.0  # of gravity and mounting, which are no acceleration
    gain_least_m2_s3: float = 10.0  # smaller changes of speed prove nothing
    gain_factor: float = 1.6  # of the accelerometer over the wheels, or the inverse
    hardest_m_s2: float = 10.0  # no wheel grips more
    grade_m: float = 1000.0  # length of the comparison
    usual_m: float = 5000.0  # over which the mounting angle and the model's usual error are learned
    usual_known_m: float = 1500.0  # after which a larger mounting angle is no longer expected
    usual_prior_m: float = 350.0  # weight of the expectation that there is none
    usual_most: float = 0.05  # three degrees of mounting
    grade_sd: float = 0.016  # accelerometer against altitude; 0.010 at most on the commissioning rides
    energy_sd: float = 0.06  # against the energy, most of it wind
    energy_decides_sd: float = 0.01  # wind is common to both comparisons with the energy
    steepest: float = 0.3
    altitude_jump_m: float = 6.0  # of a receiver
    altitude_wander_m_s: float = 1.0

    temperature_jump_k: float = 6.0  # resolution, and what two messages in a row differ by


CONFIG = PlausibilityConfig()


class StepInputs(NamedTuple):
    """One step of the estimator, before any of its signals is used."""

    now: float  # s, its end
    dt: float  # s since the last step
    observed: float  # s of `dt` in which messages came; physical quantities may change over all of it
    signals: Signals
    speed: float | None  # m/s, of the last step


def share_of_new(dt: float, time: float) -> float:
    """Weight of a value that represents `dt` in a mean over `time`; both in seconds or in metres."""
    return min(dt / time, 1.0) if time > 0 else 1.0


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
        normalised = min(abs(self.difference) / sd, CONFIG.residual_clip)
        self.square += (normalised * normalised - self.square) * share_of_new(dt, self._time)

    @property
    def contradicts(self) -> bool:
        """Whether the residual is larger than healthy sensors explain."""
        return self.square > 1.0

    @property
    def agrees(self) -> bool:
        """Whether it is so small that it proves agreement."""
        return self.square < CONFIG.agreeing_residual**2


def isolate(first: float, second: float) -> int:
    """1 or 2: which of two members a third one contradicts, by the mean squares of their residuals; 0: undecided."""
    if abs(first - second) < 1.0 or max(first, second) < CONFIG.isolating_ratio * min(first, second):
        return 0
    return 1 if first > second else 2


class FaultCounter:
    """Evidence against one sensor."""

    def __init__(self) -> None:
        self.contradicted = 0.0  # s, less `agreement_weight` of the time of agreement
        self.agreed = 0.0  # s of agreement since the last contradiction
        self.faulty = False

    def update(self, dt: float, contradicts: bool | None, disputed: bool = False) -> None:
        """Add `dt` [s] of contradiction or agreement; None: there was nothing to compare the sensor with.

        disputed: another sensor is as likely to be the cause. Waiting for what decides costs less than losing both.
        """
        if contradicts:
            dt = CONFIG.dispute_weight * dt if disputed else dt
            self.agreed = 0.0
            self.contradicted = min(self.contradicted + dt, CONFIG.faulty_after_s)
            self.faulty |= self.contradicted >= CONFIG.faulty_after_s
        elif contradicts is not None:
            self.contradicted = max(self.contradicted - CONFIG.agreement_weight * dt, 0.0)
            self.agreed += dt
            self.faulty &= self.agreed < CONFIG.recovered_after_s


def faulty(counters: Mapping[str, FaultCounter]) -> frozenset[str]:
    """Roles whose sensors are faulty."""
    return frozenset(role for role, counter in counters.items() if counter.faulty)


class UnchangedTimer:
    """Measures for how long a value has been the same to the last bit."""

    def __init__(self) -> None:
        self._value: float | None = None
        self.seconds = 0.0

    def update(self, dt: float, value: float) -> float:
        """Seconds without a change, `dt` [s] after the last value."""
        self.seconds = self.seconds + dt if value == self._value else 0.0
        self._value = value
        return self.seconds


class RateLimit:
    """Predicts a slow signal from its own past: it cannot change faster than physics lets it.

    Until the signal has held for `settled_after_s`, a jump is taken for the end of a start-up value.
    """

    def __init__(self) -> None:
        self._value: float | None = None
        self._held = self._rise = self._fall = 0.0  # s; how far it can have gone since the last value

    def allows(self, dt: float, value: float | None, rise: float, fall: float, jump: float) -> bool:
        """Whether `value` is possible `dt` [s] after the last one; None: the sensor is silent.

        rise, fall: most change since the last call. jump: by how much a value may be off.
        """
        self._rise, self._fall = self._rise + rise, self._fall + fall
        if value is None:
            return True
        before = value if self._value is None else self._value
        near = min(max(value, before - self._fall), before + self._rise)
        follows = abs(value - near) <= jump
        if not follows and self._held >= CONFIG.settled_after_s:
            return False
        self._held = self._held + dt if follows else 0.0
        self._value, self._rise, self._fall = near if follows else value, 0.0, 0.0
        return True
