"""The last value of each role, and its mean over the last window."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from math import inf
from typing import TYPE_CHECKING

from gz_onboard.constants import HOUR
from gz_onboard.events import ROLES, RoleWindow

STEP_LIMITS = {  # most rise and fall from one message to the next, and more per second in between
    "bms_state_of_charge": (0.15, 0.15, 6 / HOUR),
    "odometer": (2000.0, 0.0, 70.0),  # m
}
ACCEPTED_AFTER = 600.0  # s: a jump that persists for so long is real, such as an odometer that was set
DEFAULT_STALE = 2.0  # s, for messages of unknown period
FIX_2D, FIX_3D = 2, 3  # of `gps_fix`: a position, an altitude


class Signal:
    """One role."""

    __slots__ = ("_mean", "count", "mean_square", "stale_after", "time", "trusted", "value")

    def __init__(self) -> None:
        self.value = self._mean = 0.0
        self.time = -inf  # s, of the last value
        self.count = 0  # samples in the last window
        self.mean_square: float | None = None  # of the last window, of `SQUARED` roles
        self.stale_after = 0.0  # s; 0: the vehicle has no such signal
        self.trusted = True  # False: other sensors contradict it, and it is taken as missing

    def take(self, window: RoleWindow) -> None:
        """Take the samples of a window."""
        self.time, self.value, self.count, self._mean, self.mean_square = window

    def fresh(self, now: float) -> bool:
        """Whether it has a value that is not stale at `now` [s] and is trusted."""
        return self.trusted and now - self.time <= self.stale_after

    def get(self, now: float) -> float | None:
        """Its last value, or None if that is stale or not trusted."""
        return self.value if self.trusted and now - self.time <= self.stale_after else None

    @property
    def last(self) -> float | None:
        """The last value that ever came."""
        return self.value if self.time > -inf else None

    def mean(self, now: float) -> float | None:
        """Its mean over the last window; if nothing came, its last value; None if that is stale or not trusted."""
        return self.reported(now) if self.trusted else None

    def reported(self, now: float) -> float | None:
        """What `mean` gives, trusted or not."""
        if now - self.time > self.stale_after:
            return None
        return self._mean if self.count else self.value


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
            self.time, self.value, self.count, self._mean = window.time, value, 1, value

    def accepts(self, value: float, now: float) -> bool:
        """Whether the `value` that came at `now` [s] is plausible."""
        self.restarted = False
        if not self._follows(self.accepted, value, now):
            since = self.rejected[2] if self.rejected and self._follows(self.rejected[:2], value, now) else now
            self.rejected = value, now, since
            self.restarted = value != self.zero and now - since >= ACCEPTED_AFTER
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


class Signals:
    """All roles as attributes by name; those that the vehicle does not have are always stale."""

    def __init__(self, stale_after: Iterable[tuple[str, float]], of_cells: Callable[[float], float] = float) -> None:
        """stale_after: seconds by role. of_cells: from the charge that the vehicle shows to that of its cells."""
        self.self_reported = {
            "bms_state_of_charge": SelfReported("bms_state_of_charge", of_cells),
            "odometer": SelfReported("odometer"),
        }
        self._all = {role: self.self_reported.get(role) or Signal() for role in ROLES}
        for role, seconds in stale_after:
            self._all[role].stale_after = seconds
        self.__dict__ |= self._all
        self.carried = False  # only the GPS receiver moves: the vehicle is in a van
        self._mapped = [signal for signal in self._all.values() if signal.stale_after]

    if TYPE_CHECKING:

        def __getattr__(self, role: str) -> Signal: ...

    @property
    def has_rejected(self) -> bool:
        """Whether the last self-reported value of any role was rejected."""
        return any(signal.accepted and signal.rejected for signal in self.self_reported.values())

    def resume(self, values: Mapping[str, float | None]) -> None:
        """Continue from the values that the vehicle reported before, by role."""
        for role, value in values.items():
            self.self_reported[role].accepted = None if value is None else (value, -inf)

    def mapped(self, roles: Iterable[str]) -> tuple[str, ...]:
        """Those of `roles` that the vehicle has."""
        return tuple(role for role in roles if self._all[role].stale_after)

    def __getitem__(self, role: str) -> Signal:
        return self._all[role]

    def fix_below(self, now: float, least: int) -> bool:
        """Whether the GPS reports a fix worse than `least` (`FIX_2D`, `FIX_3D`), or one that is not of the vehicle."""
        return self.carried or (self.gps_fix.fresh(now) and self.gps_fix.value < least)

    def next_window(self) -> None:
        """Forget the samples of the window before."""
        for signal in self._mapped:
            signal.count = 0
