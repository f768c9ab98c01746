"""Whether a voltage that is off its prediction is a glitch, an error of the model, or a wrong state of charge."""

from __future__ import annotations

from math import sqrt

ERROR_TIME = 600.0  # s: over so long the cell model errs the same way; its error does not average out faster
INNOVATION_TIME = 10.0  # s: low pass of the innovation that is shown
GATE = 5.0  # sd: a voltage further off is a glitch, unless it persists
GATE_COUNT = 20  # so many in a row are no glitch
CONTRADICTED = 60.0  # s: a filter whose voltage is off its gate for so long begins anew
LARGE = 0.08  # V of a cell, RMS: the cell model does not follow the voltage


class InnovationGate:
    """Follows the innovation of the filter [V of a cell]."""

    def __init__(self) -> None:
        self.innovation: float | None = None
        self.off = 0  # voltages in a row
        self._square = self._error_square = 0.0  # V², over `INNOVATION_TIME` and `ERROR_TIME`
        self._contradicted = 0.0  # s

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

    def blame_both(self) -> None:
        """The last error may be the cell model's as well: it is believed to no better than that."""
        self._error_square = (self.innovation or 0.0) ** 2
        self._contradicted = 0.0

    def update(self, dt: float, error: float, own: float, slow: float) -> float | None:
        """The variance [V²] with which a voltage is to be taken in, of which `error` [V] is off; None: not at all.

        dt: [s] that it represents; own: variance of the prediction by the state, slow: by everything else [V²].
        """
        self.innovation, square = error, error * error
        # A model with larger errors than in the vehicle file gets a larger variance (Mehra 1970: covariance matching).
        believed = max(slow, self._error_square)
        self._error_square += (square - self._error_square) * min(dt / ERROR_TIME, 1.0)
        self._square += (square - self._square) * min(dt / INNOVATION_TIME, 1.0)
        self._contradicted = self._contradicted + dt if square > GATE * GATE * (own + slow) else 0.0
        if self.refuted:
            return None
        self.off = self.off + 1 if square > GATE * GATE * (own + believed) else 0
        return None if 0 < self.off < GATE_COUNT else believed
