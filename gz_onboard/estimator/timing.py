"""When messages come: how often each really does, when it is stale, and from when on a gap is a pause."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

from gz_onboard.estimator.signals import Signal
from gz_onboard.events import Group, MessageWindow

SLOW_GAP = 0.4  # s: messages with longer gaps are watched for their real period; no usual one is near that
COARSE = 0.55  # s: pack current and voltage that come less often are too coarse for a comparison second by second
SLOWEST = 5.5  # s: pack current and voltage that come less often are not integrated: 5 s and what a clock is off
PAUSE = 1.0  # s: without messages of a longer period a longer gap is a pause, in which charge is not counted
PAUSE_PERIODS = 2.5  # the same in real periods of the pack current
SLOW_STALE_PERIODS = 3.0  # a slow signal is stale after so many of its real periods
LONGEST_STALE = 300.0  # s, of temperatures; of everything else so many of the slowest period
FAST_COUNT = 20  # messages in a row without a long gap: the long ones are over
ALIKE = 0.5, 2.0  # of two gaps, the one over the other: within, they are the period
INTEGRATED = {"pack_current", "pack_voltage"}


class MessageTiming:
    """Learns the real periods of messages.

    sampled: the longest real period of pack current and voltage [s], 0 where they are not slow. pause: a gap that is
    longer [s] is a pause, in which charge is not counted.
    """

    def __init__(self, groups: Sequence[Group], slots: Sequence[Sequence[Signal]]) -> None:
        self._last = [-inf] * len(groups)  # s, of each group's last message
        self._gaps = [0.0] * len(groups)  # s, between the two before that; 0 where they are short
        self.periods = [group.period or 0.0 for group in groups]  # s, where slow: declared, then as they really are
        self._slots = slots
        self._fast = [0] * len(groups)  # short gaps in a row since the last long one
        self._thermal = {i for i, group in enumerate(groups) if any("temperature" in role for role in group.roles)}
        self._stale = [signals[0].stale_after if signals else 0.0 for signals in slots]
        self._integrated = [i for i, group in enumerate(groups) if INTEGRATED & set(group.roles)]
        self._summarise()

    def take(self, window: MessageWindow) -> None:
        """Learn the real period of a message that comes with long gaps: two alike are no coincidence."""
        group, count = window.group, window.frames
        gap, before = (window.time - self._last[group]) / count, self._gaps[group]
        self._last[group] = window.time
        if gap <= SLOW_GAP:
            if not before:
                return
            self._fast[group] += count
            if self._fast[group] < FAST_COUNT:  # it may come in bursts
                return
            self._gaps[group], self.periods[group], stale = 0.0, 0.0, self._stale[group]
        else:
            self._gaps[group], self._fast[group] = gap, 0
            if not before or not ALIKE[0] < gap / before < ALIKE[1] or gap > LONGEST_STALE:
                return
            self.periods[group] = max(gap, before)
            longest = LONGEST_STALE if group in self._thermal else SLOW_STALE_PERIODS * SLOWEST
            stale = max(self._stale[group], min(SLOW_STALE_PERIODS * self.periods[group], longest))
        self._summarise()
        for signal in self._slots[group]:
            signal.stale_after = stale

    def _summarise(self) -> None:
        """What follows from the periods; kept, as it is read at every step and changes hardly ever."""
        self.sampled = max((self.periods[i] for i in self._integrated), default=0.0)
        self.pause = max(PAUSE, PAUSE_PERIODS * self.sampled) if self.sampled <= SLOWEST else PAUSE
