"""Which signals are missing, or never were there, and the cost of that: the reasons of an estimate."""

from __future__ import annotations

from collections.abc import Container

from gz_onboard.estimator.signals import FIX_3D, Signals
from gz_onboard.events import OF_RIDING, ROLES, SPEEDS, Reason

# What is missing makes the consumption to come less certain; relative sd, from the errors on the rides without each.
LOSS_SD = {
    Reason.NO_SPEED: 0.10,
    Reason.NO_IMU: 0.03,
    Reason.NO_GPS: 0.03,
    Reason.NO_AMBIENT_TEMPERATURE: 0.04,
    Reason.NO_CELL_TEMPERATURE: 0.02,
    Reason.NO_PACK_CURRENT: 0.03,
    Reason.NO_PACK_VOLTAGE: 0.02,
    Reason.SENSOR_DISTRUSTED: 0.05,  # what was learned from it before it was found out
}
DEGRADING = ~(Reason.PRIOR_RIDING | Reason.FRAMES_DROPPED | Reason.FRAMES_LOST)  # reasons that degrade an estimate
POSITION = ("gps_speed", "latitude")
"""One of which shows that the GPS has a position."""
NEEDED = (
    (Reason.NO_PACK_VOLTAGE, ("pack_voltage",)),
    (Reason.NO_PACK_CURRENT, ("pack_current",)),
    (Reason.NO_INVERTER_CURRENT, ("inverter_current",)),
    (Reason.NO_CELL_TEMPERATURE, ("cell_temperature",)),
    (Reason.NO_AMBIENT_TEMPERATURE, ("ambient_temperature",)),
    (Reason.NO_IMU, ("rate_x",)),
    (Reason.NO_IMU, ("rate_z",)),
    (Reason.NO_IMU, ("accel_x",)),
    (Reason.NO_SPEED, SPEEDS),
    (Reason.NO_GPS, POSITION),
)
"""Roles of which one at least is needed, and the reason if there is none."""


def lacking(roles: Container[str]) -> Reason:
    """Reasons for sensors that a vehicle with these `roles` never had: no degradation, but the price is the same."""
    reasons = Reason(0)
    for reason, one_of in NEEDED:
        if not any(role in roles for role in one_of):
            reasons |= reason
    return reasons


class MissingSignals:
    """Which of the vehicle's signals are stale or not trusted; `lacking`: which it never had."""

    def __init__(self, signals: Signals) -> None:
        mapped = [role for role in ROLES if signals[role].stale_after]
        self.lacking = lacking(mapped)
        self._signals = signals
        with_altitude = (*NEEDED, (Reason.NO_GPS, ("gps_altitude",)))
        groups = ((reason, [signals[role] for role in one_of if role in mapped]) for reason, one_of in with_altitude)
        self._needed = [(reason, group) for reason, group in groups if group]
        self._with_gps = not self.lacking & Reason.NO_GPS

    def reasons(self, now: float, charged: bool = False) -> Reason:
        """The reasons for those that the vehicle has and that are missing at `now` [s], `charged` or not."""
        reasons = Reason(0)
        for reason, group in self._needed:
            if not any(signal.fresh(now) for signal in group):
                reasons |= reason
        if self._with_gps and self._signals.fix_below(now, FIX_3D):
            reasons |= Reason.NO_GPS
        return reasons & ~OF_RIDING if charged else reasons


def loss_variance(reasons: Reason) -> float:
    """The relative variance that these reasons add to the consumption."""
    return sum(sd * sd for reason, sd in LOSS_SD.items() if reason & reasons)
