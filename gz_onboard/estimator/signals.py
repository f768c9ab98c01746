"""The last value of each role, and its mean since the last step of the estimator."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from gz_onboard.events import ROLES

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
        return self.value if self.time > float("-inf") else None

    def mean(self, now: float) -> float | None:
        """Its mean since the last step; if nothing came, its last value; None if that is stale or not trusted."""
        return self.reported(now) if self.trusted else None

    def reported(self, now: float) -> float | None:
        """What `mean` gives, trusted or not."""
        if now - self.time > self.stale_after:
            return None
        return self.total / self.count if self.count else self.value


class Signals:
    """All roles as attributes by name; those that the vehicle does not have are always stale."""

    def __init__(self, stale_after: Iterable[tuple[str, float]]) -> None:
        self._all = {role: Signal() for role in ROLES}
        for role, seconds in stale_after:
            self._all[role].stale_after = seconds
        self.__dict__ |= self._all
        self.carried = False  # the receiver moves and the vehicle rests: what it shows is of a van
        self._mapped = [signal for signal in self._all.values() if signal.stale_after]

    if TYPE_CHECKING:

        def __getattr__(self, role: str) -> Signal: ...

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
