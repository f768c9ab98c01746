"""The sag of the cells' voltage over what the current explains of it.

Both currents scaled alike: the cells' voltage sags by more (less) than they explain, and a kilometre consumes less
(more) than by the road load. The recorded rides show a sag of 0.6 to 1.3 of the predicted one, an aged pack's up to
twice; a frugal rider consumes 0.7 of the usual per kilometre, and 2.5 of it up a hill against the wind. Neither of the
two proves that a sensor is wrong; both together do.
"""

from __future__ import annotations

from gz_onboard.estimator.redundancy.checks import share_of_new

FAST, TIME, LEAST = 0.5, 30.0, 0.003  # s, s, V²·s of a cell
SAGS_MORE, TAKES_LESS, SAGS_LESS, TAKES_MORE = 1.45, 0.67, 0.5, 1.5
EXPLAINED = 0.55, 1.45  # a current that explains the sag so well is right, whatever the road load is,
EXPLAINED_SHARE = 0.6  # and so much of all that the voltage moves
AGREES_WITHIN = 1.3  # by no more than this factor: the currents explain the voltage again


class VoltageSag:
    """The drop of the cells' voltage from one moment to the next, over what a current explains of it."""

    def __init__(self) -> None:
        self._voltage: float | None = None  # V of a cell, low-passed
        self._drop = 0.0  # V, low-passed
        self._product = self._square = self._volts = 0.0  # V²·s

    def update(self, dt: float, voltage: float, drop: float) -> None:
        """A cell's voltage and the drop over its R0 by the current [V], after `dt` [s]."""
        if self._voltage is None or dt > FAST:  # what came between is not known
            self._voltage, self._drop = voltage, drop
            return
        fast = voltage - self._voltage, drop - self._drop
        share, keep = share_of_new(dt, FAST), 1 - share_of_new(dt, TIME)
        self._voltage += fast[0] * share
        self._drop += fast[1] * share
        self._product = keep * self._product - fast[0] * fast[1] * dt
        self._square = keep * self._square + fast[1] * fast[1] * dt
        self._volts = keep * self._volts + fast[0] * fast[0] * dt

    @property
    def explained(self) -> bool:
        """Whether the current is what moves the voltage, and by about as much as it should."""
        ratio = self.ratio
        if ratio is None or not EXPLAINED[0] < ratio < EXPLAINED[1]:
            return False
        return self._product * ratio > EXPLAINED_SHARE * self._volts

    @property
    def ratio(self) -> float | None:
        """Measured over predicted; None while the current has hardly changed."""
        return self._product / self._square if self._square > LEAST else None

    def scaled(self, consumption: float) -> bool:
        """Whether the currents are scaled; `consumption`: by them, over that of the model."""
        ratio = self.ratio
        if ratio is None:
            return False
        return (ratio > SAGS_MORE and consumption < TAKES_LESS) or (ratio < SAGS_LESS and consumption > TAKES_MORE)

    @property
    def agrees(self) -> bool:
        """Whether the currents explain the voltage."""
        return self.ratio is not None and 1 / AGREES_WITHIN < self.ratio < AGREES_WITHIN
