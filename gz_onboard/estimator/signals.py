"""The last value of each role, and its mean since the last step of the estimator."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import inf
from typing import TYPE_CHECKING

from gz_onboard.constants import HOUR
from gz_onboard.events import ROLES

LEAPS = {  # by how much a value may rise and fall from one message to the next, and beyond that in a second
    "bms_state_of_charge": (0.15, 0.15, 6 / HOUR),
    "odometer": (2000.0, 0.0, 70.0),  # m
}
DOUBTED = 600.0  # s: a value that leaped is believed after so long: it was set
DEFAULT_STALE = 2.0  # s, for messages of unknown period
FIX_2D, FIX_3D = 2, 3  # of `gps_fix`: a position, an altitude


class Signal:
    """One role."""

    __slots__ = ("count", "stale_after", "time", "total", "trusted", "value")

    def __init__(self) -> None:
        self.value = 0.0
        self.time = float("-inf")  # s, of the last value
        self.total = 0.0
        self.count = 0
        self.stale_after = 0.0  # s; 0: the vehicle has no such signal
        self.trusted = True  # False: other sensors contradict it, and it is taken as missing

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
        """Its mean since the last step; if nothing came, its last value; None if that is stale or not trusted."""
        if not self.trusted or now - self.time > self.stale_after:  # `reported`, without the call
            return None
        return self.total / self.count if self.count else self.value

    def reported(self, now: float) -> float | None:
        """What `mean` gives, trusted or not."""
        if now - self.time > self.stale_after:
            return None
        return self.total / self.count if self.count else self.value


class Told(Signal):
    """What a vehicle says of itself: believed while it goes on from what it said before.

    An ECU may say 0, or anything, until it has found what it kept, and while it falls asleep.
    """

    __slots__ = ("anew", "doubt", "nothing", "role", "said")

    def __init__(self, role: str) -> None:
        super().__init__()
        self.role, self.nothing = role, 0.0  # what stands for 0: only what was small before becomes that
        self.said: tuple[float, float] | None = None  # the last that was believed, and when [s]
        self.doubt: tuple[float, float, float] | None = None  # the last that was not, when, and since when [s]
        self.anew = False  # the last leaped, and has persisted

    def believes(self, value: float, now: float) -> bool:
        """Whether `value`, of `now` [s], is to be taken."""
        self.anew = False
        if not self._follows(self.said, value, now):
            since = self.doubt[2] if self.doubt and self._follows(self.doubt[:2], value, now) else now
            self.doubt = value, now, since
            self.anew = value != self.nothing and now - since >= DOUBTED
            if not self.anew:
                return False
        self.said, self.doubt = (value, now), None
        return True

    def _follows(self, before: tuple[float, float] | None, value: float, now: float) -> bool:
        if before is None:
            return value != self.nothing
        rise, fall, rate = LEAPS[self.role]
        more = rate * (now - before[1]) if value != self.nothing else 0.0
        return -(fall + more if fall else 0.0) <= value - before[0] <= rise + more


class Signals:
    """All roles as attributes by name; those that the vehicle does not have are always stale."""

    def __init__(self, stale_after: Iterable[tuple[str, float]]) -> None:
        self.told = {role: Told(role) for role in LEAPS}
        self._all = {role: self.told.get(role) or Signal() for role in ROLES}
        for role, seconds in stale_after:
            self._all[role].stale_after = seconds
        self.__dict__ |= self._all
        self.carried = False  # the receiver moves and the vehicle rests: what it shows is of a van
        self._mapped = [signal for signal in self._all.values() if signal.stale_after]

    if TYPE_CHECKING:

        def __getattr__(self, role: str) -> Signal: ...

    @property
    def doubted(self) -> bool:
        """Whether the vehicle says something of itself that does not go on from what it said."""
        return any(told.said and told.doubt for told in self.told.values())

    def resume(self, said: Mapping[str, float | None]) -> None:
        """Go on from what the vehicle said before, by role."""
        for role, value in said.items():
            self.told[role].said = None if value is None else (value, -inf)

    def __getitem__(self, role: str) -> Signal:
        return self._all[role]

    def fix_below(self, now: float, least: int) -> bool:
        """Whether the GPS reports a fix worse than `least` (`FIX_2D`, `FIX_3D`), or one that is not of the vehicle."""
        return self.carried or (self.gps_fix.fresh(now) and self.gps_fix.value < least)

    def next_step(self) -> None:
        """Start new means."""
        for signal in self._mapped:
            signal.total = 0.0
            signal.count = 0
