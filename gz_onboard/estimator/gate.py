"""Whether a voltage that is off its prediction is a glitch, an error of the model, or a wrong state of charge."""

from __future__ import annotations

from math import sqrt

MATCHING_TIME = 600.0  # s over which it is seen whether the cell model errs by more than is known of it
INNOVATION_TIME = 10.0  # s: low pass of the innovation that is shown
GATE = 5.0  # sd: a voltage further off is a glitch, unless it persists
GATE_COUNT = 20  # so many in a row are no glitch
CONTRADICTED = 60.0  # s: a filter whose voltage is off its gate for so long begins anew
CONTRADICTING = 4.0  # of the mean square of errors over what is expected of it: three packs of the plant had up to 3.5
LARGE = 0.08  # V of a cell, RMS: the cell model does not follow the voltage


class InnovationGate:
    """Follows the innovation of the filter [V of a cell]."""

    def __init__(self) -> None:
        self.innovation: float | None = None
        self.off = 0  # voltages in a row
        self._square = 0.0  # V², over `INNOVATION_TIME`
        self._ratio = 0.0  # of the error's square over its variance, over `MATCHING_TIME`
        self._contradicted = 0.0  # s
        self._known = 1.0  # V²: variance of the last error by what is known of the cell model
        self._blamed = False  # the cell model as well, and it has not followed the voltage since

    @property
    def rms(self) -> float:
        """Of the innovation, over the last `INNOVATION_TIME` [V]."""
        return sqrt(self._square)

    @property
    def mismatch(self) -> bool:
        """Whether the cell model does not follow the voltage."""
        return bool(self.off) or self._square > LARGE**2

    @property
    def refuted(self) -> bool:
        """Whether the voltage has contradicted the state of charge for long."""
        return self._contradicted >= CONTRADICTED

    @property
    def contradicted(self) -> bool:
        """Whether the error of the last ten minutes is larger than anything that is known explains."""
        return self._ratio > CONTRADICTING

    def settle(self) -> None:
        """The error was explained: what follows is judged anew."""
        self._ratio = 1.0

    def blame_both(self) -> None:
        """The last error may be the cell model's as well: it is believed to no better than that.

        What the state of charge is uncertain by from here on is that same error, and explains nothing of it.
        """
        self._ratio = (self.innovation or 0.0) ** 2 / self._known
        self._contradicted, self._blamed = 0.0, True

    def update(self, dt: float, error: float, own: float, slow: float, load: float) -> float | None:
        """The variance [V²] of what in a voltage that is `error` [V] off is not the slow error; None: take in none.

        dt: [s] that it represents; own: variance of the prediction by the state, slow: by what stays for minutes,
        load: by what changes with the load [V²].
        """
        self.innovation, square, known = error, error * error, slow + load
        # A model with larger errors than in the vehicle file gets a larger variance (Mehra 1970: covariance matching).
        believed = known * max(self._ratio, 1.0)
        expected = known if self._blamed else own + known
        self._ratio += (square / expected - self._ratio) * min(dt / MATCHING_TIME, 1.0)
        self._blamed = self._blamed and self._ratio > 1
        self._known = known
        self._square += (square - self._square) * min(dt / INNOVATION_TIME, 1.0)
        self._contradicted = self._contradicted + dt if square > GATE * GATE * (own + known) else 0.0
        if self.refuted:
            return None
        self.off = self.off + 1 if square > GATE * GATE * (own + believed) else 0
        if self.off:  # what is no slow error of the model is not to become one
            return None if self.off < GATE_COUNT else believed
        return believed - slow
