"""Takes the voltage of a proven rest into the state of charge."""

from __future__ import annotations

from math import inf, sqrt

from gz_onboard.estimator.ekf import SocFilter
from gz_onboard.estimator.rest import RestMonitor
from gz_onboard.estimator.start import bounded, soc_width, take_in
from gz_onboard.estimator.uncertainty import VoltageUncertainty
from gz_onboard.physics.battery import Battery

REST_BETTER = 0.15  # of the sd that is known: a rest after a load is taken in only if its own is no more than this
REST_NEWS = 0.8  # a rest is taken in again when its variance fell below this share


class RestUpdate:
    """Follows the rests of a pack, and what of the present one was taken in."""

    def __init__(self, battery: Battery, uncertainty: VoltageUncertainty) -> None:
        self._battery, self._uncertainty = battery, uncertainty
        self._rest = RestMonitor()
        self._taken = inf  # V² of a cell: variance of what was taken in of this rest

    def interrupt(self) -> None:
        """A pause in the data."""
        self._rest.interrupt()
        self._taken = inf

    def step(
        self, filter_: SocFilter, dt: float, voltage: float, current: float, temperature: float, voltage_sd: float
    ) -> bool:
        """Take in the `voltage` [V] of a rest that is better proven than before; gives whether it did.

        voltage, current [A] and voltage_sd [V]: of a cell, over `dt` [s] at `temperature` [degC].
        """
        battery, rest = self._battery, self._rest
        emf = voltage + battery.r0.at(filter_.soc, temperature)[0] * current
        fast = battery.r1.at(filter_.soc, temperature)[0] * battery.c1.at(filter_.soc, temperature)[0]
        rest.step(dt, voltage, emf, current / battery.cell_capacity(temperature), fast, self._uncertainty.model)
        if rest.sd is None:
            self._taken = inf
            return False
        variance = rest.sd**2 + self._uncertainty.rest**2 + voltage_sd**2
        if not rest.fresh or variance > REST_NEWS * self._taken:
            return False
        emf += rest.coming
        # Curve and relaxation err the same way at every rest: that does not average out.
        better = REST_BETTER if rest.loaded and self._taken == inf else 1.0
        if better**2 * filter_.covariance[0] < (soc_width(battery, emf, sqrt(variance), temperature) / 2) ** 2:
            return False
        # The same rest again, only better known: what is new is the difference of what both say.
        new = 1 / (1 / variance - (0.0 if self._taken == inf else 1 / self._taken))
        self._taken = variance
        take_in(filter_, battery.soc_at(emf, temperature), (soc_width(battery, emf, sqrt(new), temperature) / 2) ** 2)
        filter_.soc = bounded(filter_.soc)
        return True
