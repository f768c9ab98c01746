"""What auxiliaries take beyond the vehicle file's by their own current sensor: lights, heaters, a thermostat's share.

Only that: at standstill a drive that holds the vehicle on a hill, or a speed sensor that has died, looks like a heater.
What no sensor shows is learned as a price of the metre.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any

from gz_onboard.physics.model import Model

MEAN_TIME = 180.0  # s: thermostats go on and off within
MOST = 1e5  # W, of a saved mean


class Auxiliaries:
    """Follows them. Beyond the file's, `now` and in the mean of `MEAN_TIME`, as is to be expected [W]; 0 if unknown."""

    def __init__(self, model: Model) -> None:
        modelled = any(p.name == "auxiliary_power" for effect in model.effects for p in effect.parameters)
        self._filed = model.parameters["auxiliary_power"] if modelled else 0.0  # W
        self.now = self.mean = 0.0
        self._seen = 0.0  # s that the mean is of

    def step(self, dt: float, measured: float | None) -> None:
        """Go `dt` [s] on with what is measured [W]; None: nothing, for now."""
        if measured is None:
            self.now = self.mean
            return
        self.now = measured - self._filed
        self._seen = min(self._seen + dt, MEAN_TIME)
        if self._seen > 0:
            self.mean += min(dt / self._seen, 1.0) * (self.now - self.mean)

    @property
    def total(self) -> float:
        """What all of them draw now [W]."""
        return self._filed + self.now

    @property
    def known(self) -> bool:
        """Whether their sensor has shown them, on this ride or the one before."""
        return self._seen > 0 or self.mean != 0

    def forget(self) -> None:
        """A sensor that it was learned from is faulty."""
        self.now = self.mean = self._seen = 0.0

    def snapshot(self) -> dict[str, float]:
        """What is to be kept over a restart."""
        return {"mean": self.mean, "filed": self._filed}

    def restore(self, saved: Mapping[str, Any] | None) -> None:
        """Take what `snapshot` gave, until something is measured; nothing of an older version or another file."""
        self.forget()
        try:
            mean, filed = float((saved or {})["mean"]), float((saved or {})["filed"])
        except (KeyError, TypeError, ValueError, OverflowError):
            return
        if filed == self._filed and isfinite(mean) and abs(mean) < MOST:
            self.now = self.mean = mean
