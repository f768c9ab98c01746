"""Events, the samples of one message at one time, for tests that say what came when."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TypeAlias

from gz_onboard.can.codec import Codec
from gz_onboard.estimator.estimator import Estimator
from gz_onboard.estimator.plausibility.residual import Sensor
from gz_onboard.estimator.signals import Signals
from gz_onboard.events import STALE_PERIODS, WINDOW, Estimate, Frame, Group, MessageWindow, RoleWindow

Event: TypeAlias = tuple[float, int, tuple[float | None, ...]]
"""(time [s], group, values in SI units)"""


def events_of(codec: Codec, frames: Iterable[Frame]) -> list[Event]:
    """The samples of `frames`, one by one."""
    found: list[Event] = []
    for frame in frames:
        codec.decode((frame,))
        for window in codec.windows():
            values = tuple(None if role is None else role.value for role in window.roles)
            found.append((window.time, window.group, values))
    return found


class EventEstimator(Estimator):
    """Makes windows of events. An estimate is of all that came until then."""

    _open: dict[int, list[Event]]
    _end = float("-inf")

    def handle(self, event: Event) -> None:
        """Take an event, and make the step of the window before it."""
        if event[0] > self._end:
            self.close()
            self._end = event[0] + WINDOW - 1e-3
        self._open.setdefault(event[1], []).append(event)

    def close(self) -> None:
        """Make a step with what came since the last."""
        windows = [self._window(group, events) for group, events in getattr(self, "_open", {}).items()]
        self._open = {}
        self.step(windows)

    def estimate(self, now: float) -> Estimate:
        """See `Estimator`."""
        if getattr(self, "_open", None):
            self._end = min(now, self._end)
            self.close()
        return super().estimate(now)

    @staticmethod
    def _window(group: int, events: list[Event]) -> MessageWindow:
        roles = []
        for column in zip(*(values for _, _, values in events), strict=True):
            seen = [(event[0], value) for event, value in zip(events, column, strict=True) if value is not None]
            values = [value for _, value in seen]
            n = len(seen)
            roles.append(RoleWindow(*seen[-1], n, sum(values) / n, sum(v * v for v in values) / n) if seen else None)
        return MessageWindow(group, events[-1][0], len(events), tuple(roles))


class ShownSignals(Signals):
    """Signals of one message for each role, stale after `stale` [s]."""

    def __init__(self, *roles: str, stale: float = 2.0) -> None:
        super().__init__([Group(role, (role,), stale / STALE_PERIODS) for role in roles])
        self._roles = roles

    def show(self, now: float, values: Mapping[str, float | None]) -> None:
        """Take one sample of each of these roles at `now` [s]; None: nothing comes."""
        shown = [(self._roles.index(role), value) for role, value in values.items() if value is not None]
        self.take([MessageWindow(i, now, 1, (RoleWindow(now, value, 1, value),)) for i, value in shown], now)


def faulty(sensors: Mapping[str, Sensor]) -> frozenset[str]:
    """Roles whose sensors are faulty."""
    return frozenset(role for role, sensor in sensors.items() if sensor.faulty)
