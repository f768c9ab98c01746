"""Which signals are missing, or never were there, and what that costs: the reasons of an estimate."""

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
NEEDED = {
    Reason.NO_PACK_VOLTAGE: ("pack_voltage",),
    Reason.NO_PACK_CURRENT: ("pack_current",),
    Reason.NO_INVERTER_CURRENT: ("inverter_current",),
    Reason.NO_CELL_TEMPERATURE: ("cell_temperature",),
    Reason.NO_AMBIENT_TEMPERATURE: ("ambient_temperature",),
    Reason.NO_IMU: ("rate_x", "rate_z", "accel_x"),
}
"""The roles of which none may be missing."""


POSITION = ("gps_speed", "latitude")
"""One of which shows that the GPS has a position."""


def lacking(roles: Container[str]) -> Reason:
    """What a vehicle with sensors for `roles` never had: no degradation, but the price is the same."""
    reasons = Reason(0)
    for reason, needed in NEEDED.items():
        if not all(role in roles for role in needed):
            reasons |= reason
    for reason, one_of in ((Reason.NO_SPEED, SPEEDS), (Reason.NO_GPS, POSITION)):
        if not any(role in roles for role in one_of):
            reasons |= reason
    return reasons


class MissingSignals:
    """Which of the vehicle's signals are stale or not trusted; `lacking`: what it never had."""

    def __init__(self, signals: Signals) -> None:
        mapped = [role for role in ROLES if signals[role].stale_after]
        self.lacking = lacking(mapped)
        self._signals = signals
        self._needed = [(reason, signals[role]) for reason, roles in NEEDED.items() for role in roles if role in mapped]
        self._speeds = [signals[role] for role in SPEEDS]
        self._with_speed, self._with_gps = (not self.lacking & r for r in (Reason.NO_SPEED, Reason.NO_GPS))

    def reasons(self, now: float, charged: bool = False) -> Reason:
        """The reasons for those that the vehicle has and that are missing at `now` [s], `charged` or not."""
        signals, reasons = self._signals, Reason(0)
        for reason, signal in self._needed:
            if not signal.fresh(now):
                reasons |= reason
        if self._with_speed and not any(signal.fresh(now) for signal in self._speeds):
            reasons |= Reason.NO_SPEED
        position = signals.gps_speed.fresh(now) or signals.latitude.fresh(now)
        altitude = signals.gps_altitude.fresh(now) or not signals.gps_altitude.stale_after
        if self._with_gps and (signals.fix_below(now, FIX_3D) or not position or not altitude):
            reasons |= Reason.NO_GPS
        return reasons & ~OF_RIDING if charged else reasons


def loss_variance(reasons: Reason) -> float:
    """The relative variance that these reasons add to the consumption."""
    return sum(sd * sd for reason, sd in LOSS_SD.items() if reason & reasons)
