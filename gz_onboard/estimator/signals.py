"""The signals of the vehicle: last value, mean over the last window, age and real period; and which are missing."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING

from gz_onboard.constants import HOUR
from gz_onboard.events import OF_RIDING, ROLES, SPEEDS, STALE_PERIODS, Group, MessageWindow, Reason, RoleWindow


@dataclass(frozen=True, slots=True)
class TimingConfig:
    """When messages come; times in s."""

    unknown_stale: float = 2.0  # a signal of unknown period is stale after this
    slow_gap: float = 0.4  # messages with longer gaps are watched for their real period; no usual one is near that
    coarse: float = 0.55  # pack current and voltage that come less often are not compared second by second
    slowest: float = 5.5  # pack current and voltage that come less often are not integrated: 5 s and clock error
    pause: float = 1.0  # a longer gap is a pause, in which charge is not counted, or
    pause_periods: float = 2.5  # so many real periods of the pack current
    slow_stale_periods: float = 3.0  # a slow signal is stale after so many of its real periods
    longest_stale: float = 300.0  # of temperatures; of everything else so many of the slowest period
    fast_count: int = 20  # messages in a row without a long gap: the long gaps are over
    alike: float = 2.0  # two gaps that differ by less than this factor are the period
    accepted_after: float = 600.0  # a jump that persists for so long is real, such as an odometer that was set


TIMING = TimingConfig()
STEP_LIMITS = {  # most rise and fall from one message to the next, and more per second in between
    "bms_state_of_charge": (0.15, 0.15, 6 / HOUR),
    "odometer": (2000.0, 0.0, 70.0),  # m
}
FIX_2D, FIX_3D = 2, 3  # of `gps_fix`: a position, an altitude
POSITION = ("gps_speed", "latitude")  # one of which shows that the GPS has a position
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


class Signal:
    """One role. `reported` and `mean` are of the end of the last window, `get` and `fresh` of any time."""

    __slots__ = ("count", "mean_square", "period", "reported", "stale_after", "time", "trusted", "value", "window_mean")

    def __init__(self) -> None:
        self.value = self.window_mean = 0.0
        self.time = -inf  # s, of the last value
        self.count = 0  # samples in the last window
        self.mean_square: float | None = None  # of the last window, of `SQUARED` roles
        self.stale_after = 0.0  # s; 0: the vehicle has no such signal
        self.period = 0.0  # s: as declared; where that is slow or unknown, as it really is; 0 for short unknown ones
        self.trusted = True  # False: other sensors contradict it, and it is taken as missing
        self.reported: float | None = None  # mean of the last window, else the last value; None if that is stale

    def take(self, window: RoleWindow) -> None:
        """Take the samples of a window."""
        self.time, self.value, self.count, self.window_mean, self.mean_square = window

    @property
    def last(self) -> float | None:
        """The last value that ever came."""
        return self.value if self.time > -inf else None

    @property
    def mean(self) -> float | None:
        """`reported`; None if it is not trusted."""
        return self.reported if self.trusted else None

    def fresh(self, now: float) -> bool:
        """Whether it has a value that is not stale at `now` [s] and is trusted."""
        return self.trusted and now - self.time <= self.stale_after

    def get(self, now: float) -> float | None:
        """Its last value, or None if that is stale or not trusted."""
        return self.value if self.trusted and now - self.time <= self.stale_after else None


class SelfReported(Signal):
    """A value that the vehicle computes itself: accepted while it continues from the value before.

    An ECU may send 0, or anything, until it has read its memory after waking, and while it falls asleep.
    """

    __slots__ = ("accepted", "convert", "rejected", "restarted", "role", "zero")

    def __init__(self, role: str, convert: Callable[[float], float] = float) -> None:
        super().__init__()
        self.role, self.convert = role, convert
        self.zero = convert(0.0)  # a placeholder, unless the value was near it before
        self.accepted: tuple[float, float] | None = None  # value and its time [s]
        self.rejected: tuple[float, float, float] | None = None  # value, its time, since when [s]
        self.restarted = False  # the last value jumped, and the jump has persisted

    def take(self, window: RoleWindow) -> None:
        """Take the last value of a window, if it is plausible."""
        value = self.convert(window.value)
        if self.accepts(value, window.time):
            self.time, self.value, self.count, self.window_mean = window.time, value, 1, value

    def accepts(self, value: float, now: float) -> bool:
        """Whether the `value` that came at `now` [s] is plausible."""
        self.restarted = False
        if not self._follows(self.accepted, value, now):
            since = self.rejected[2] if self.rejected and self._follows(self.rejected[:2], value, now) else now
            self.rejected = value, now, since
            self.restarted = value != self.zero and now - since >= TIMING.accepted_after
            if not self.restarted:
                return False
        self.accepted, self.rejected = (value, now), None
        return True

    def _follows(self, before: tuple[float, float] | None, value: float, now: float) -> bool:
        if before is None:
            return value != self.zero
        rise, fall, rate = STEP_LIMITS[self.role]
        more = rate * (now - before[1]) if value != self.zero else 0.0
        return -(fall + more if fall else 0.0) <= value - before[0] <= rise + more


class SlowMessage:
    """The signals of one message, and its real period where it comes slowly."""

    def __init__(self, group: Group, signals: Sequence[Signal]) -> None:
        self.signals = signals
        self._last = -inf  # s, of the last message
        self._gap = 0.0  # s, between the two before that; 0 where gaps are short
        self._short = 0  # short gaps in a row since the last long one
        self._stale = STALE_PERIODS * group.period if group.period else TIMING.unknown_stale  # s
        thermal = any("temperature" in role for role in group.roles)
        self._longest_stale = TIMING.longest_stale if thermal else TIMING.slow_stale_periods * TIMING.slowest
        self._period = group.period or 0.0  # s: as declared, then as it really is; 0 where gaps are short
        for signal in signals:
            signal.period, signal.stale_after = self._period, self._stale

    def learn_period(self, window: MessageWindow) -> bool:
        """Learn the real period of a message that comes with long gaps; whether it has changed.

        Two gaps alike are no coincidence, and a few messages in quick succession may be a burst.
        """
        gap, before = (window.time - self._last) / window.frames, self._gap
        self._last = window.time
        if gap > TIMING.slow_gap:
            self._gap, self._short = gap, 0
            alike = before and 1 / TIMING.alike < gap / before < TIMING.alike
            period = max(gap, before) if alike and gap <= TIMING.longest_stale else self._period
        elif before:
            self._short += window.frames
            long_gaps_are_over = self._short >= TIMING.fast_count
            period, self._gap = (0.0, 0.0) if long_gaps_are_over else (self._period, before)
        else:
            return False
        if period == self._period:
            return False
        self._period = period
        for signal in self.signals:
            signal.period = period
            signal.stale_after = max(self._stale, min(TIMING.slow_stale_periods * period, self._longest_stale))
        return True


class Signals:
    """All roles as attributes by name; those that the vehicle does not have are always stale.

    sampled: the longest real period of pack current and voltage [s], 0 where they are not slow. pause: a gap that is
    longer [s] is a pause, in which charge is not counted.
    """

    def __init__(self, groups: Sequence[Group], of_cells: Callable[[float], float] = float) -> None:
        """of_cells: from the charge that the vehicle shows to that of its cells."""
        self.self_reported = {
            "bms_state_of_charge": SelfReported("bms_state_of_charge", of_cells),
            "odometer": SelfReported("odometer"),
        }
        self._all = {role: self.self_reported.get(role) or Signal() for role in ROLES}
        self.__dict__ |= self._all
        self._messages = [SlowMessage(group, [self._all[role] for role in group.roles]) for group in groups]
        self._mapped = {role: signal for role, signal in self._all.items() if signal.stale_after}
        self.carried = False  # only the GPS receiver moves: the vehicle is in a van
        self.lacking = lacking(self._mapped)
        needed = (*NEEDED, (Reason.NO_GPS, ("gps_altitude",)))
        groups_needed = ((int(reason), [self[role] for role in self.mapped(one_of)]) for reason, one_of in needed)
        self._needed = [(reason, signals) for reason, signals in groups_needed if signals]
        self._set_pause()

    if TYPE_CHECKING:

        def __getattr__(self, role: str) -> Signal: ...

    def __getitem__(self, role: str) -> Signal:
        return self._all[role]

    def mapped(self, roles: Iterable[str]) -> tuple[str, ...]:
        """Those of `roles` that the vehicle has."""
        return tuple(role for role in roles if role in self._mapped)

    def take(self, windows: Iterable[MessageWindow], now: float) -> None:
        """Take the messages of the window that ends at `now` [s]."""
        for signal in self._mapped.values():
            signal.count = 0
        for window in windows:
            message = self._messages[window.group]
            if message.learn_period(window):
                self._set_pause()
            for signal, samples in zip(message.signals, window.roles, strict=True):
                if samples is not None:
                    signal.take(samples)
        for signal in self._mapped.values():
            if now - signal.time > signal.stale_after:
                signal.reported = None
            else:
                signal.reported = signal.window_mean if signal.count else signal.value

    def _set_pause(self) -> None:
        self.sampled = max(self.pack_current.period, self.pack_voltage.period)
        self.pause = TIMING.pause
        if self.sampled <= TIMING.slowest:
            self.pause = max(TIMING.pause, TIMING.pause_periods * self.sampled)

    @property
    def has_rejected(self) -> bool:
        """Whether the last self-reported value of any role was rejected."""
        return any(signal.accepted and signal.rejected for signal in self.self_reported.values())

    def resume(self, values: Mapping[str, float | None]) -> None:
        """Continue from the values that the vehicle reported before, by role."""
        for role, value in values.items():
            self.self_reported[role].accepted = None if value is None else (value, -inf)

    def fix_below(self, now: float, least: int) -> bool:
        """Whether the GPS reports a fix worse than `least` (`FIX_2D`, `FIX_3D`), or one that is not of the vehicle."""
        return self.carried or (self.gps_fix.fresh(now) and self.gps_fix.value < least)

    def missing(self, now: float, charged: bool = False) -> int:
        """`Reason` bits of the signals that the vehicle has and that are stale or not trusted at `now` [s].

        charged: signals that sleep while the vehicle is charged are not missed.
        """
        reasons = 0
        for reason, signals in self._needed:
            for signal in signals:
                if signal.trusted and now - signal.time <= signal.stale_after:
                    break
            else:
                reasons |= reason
        if not self.lacking & Reason.NO_GPS and self.fix_below(now, FIX_3D):
            reasons |= Reason.NO_GPS
        return reasons & ~OF_RIDING if charged else reasons


def lacking(roles: Container[str]) -> Reason:
    """Reasons for sensors that a vehicle with these `roles` never had: no degradation, but the price is the same."""
    reasons = Reason(0)
    for reason, one_of in NEEDED:
        if not any(role in roles for role in one_of):
            reasons |= reason
    return reasons
