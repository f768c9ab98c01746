"""The energy that a pack has given, as its sensors say."""

from __future__ import annotations


class Drawn:
    """Sums over time; voltage and current hold from the time before to theirs, but for no longer than `most` [s]."""

    def __init__(self, most: float = 1.0) -> None:
        self.net: float | None = None  # J, less what was recovered; None until a voltage and a current are known
        self.recovered = 0.0  # J
        self._most = most
        self._before: float | None = None

    def add(self, time: float, voltage: float | None, current: float | None) -> None:
        """Go on to `time` [s], with voltage [V] and current [A, positive discharging] where they are known."""
        dt = 0.0 if self._before is None else time - self._before
        self._before = time
        if voltage is not None and current is not None and 0 <= dt <= self._most:
            energy = voltage * current * dt
            self.net = (self.net or 0.0) + energy
            self.recovered -= min(energy, 0.0)
