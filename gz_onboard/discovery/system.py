"""What residuals are predicted with: the effects, bound to parameters, over what a ride measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gz_onboard.errors import InputError
from gz_onboard.lab.sizes import USUAL_SIZES, Sizes
from gz_onboard.model.battery import Battery
from gz_onboard.model.effect import MOVING, Effect, Port
from gz_onboard.model.model import Bound
from gz_onboard.model.riding import PriorRiding
from gz_onboard.offline.series import series
from gz_onboard.offline.traits import traits

Values = Mapping[str, float]
"""Parameters and nuisances by name."""


@dataclass(frozen=True)
class System:
    """What the channels are predicted with: the effects (of the model and the candidates) and the battery."""

    effects: tuple[Effect, ...]
    battery: Battery | None
    healthy: Values  # parameters of the vehicle file
    cells: tuple[Bound, ...] = ()  # the effects in its cells by the vehicle file
    vibration: float = (
        PriorRiding.vibration
    )  # m/s², of the vehicle file's prior riding: for rides that did not measure it
    sizes: Sizes = USUAL_SIZES

    @property
    def pack(self) -> Battery:
        """The battery of a system that has one."""
        assert self.battery is not None
        return self.battery

    def terms(self, q: Mapping[str, Any], p: Values, dt: float, *ports: Port) -> list[tuple[Effect, Any]]:
        """The effects at these ports and their values over time, the mean of the ends of steps of `dt` [s]; but for
        those that store energy: the accelerometer measures them."""
        steps = np.full(len(next(iter(q.values()))), dt)

        def recall(effect: Bound, quantities: Mapping[str, Any]) -> Any:
            return (series(effect, steps, quantities, before=True) + series(effect, steps, quantities)) / 2

        found = []
        for effect in self.effects:
            if effect.port not in ports or effect.stores_energy:
                continue
            known = self._known(q, effect)
            value = Bound(effect, p)(known, recall)
            if variation := traits(effect).variation:
                healthy = {f"healthy_{name}": x for name, x in self.healthy.items()}
                value = value * variation.bound({**p, **healthy})(known)
            found.append((effect, value))
        return found

    def _known(self, q: Mapping[str, Any], effect: Effect) -> Mapping[str, Any]:
        """`q`, and what stands in for what the ride did not measure; InputError if nothing does."""
        for name in effect.reads - q.keys():
            if name != "vibration":
                raise InputError(f"no ride measures {name}, which an effect reads")
            q = {**q, name: np.where(np.abs(q["speed"]) > MOVING, self.vibration, 0.0)}
        return q


def summed(terms: list[tuple[Effect, Any]]) -> Any:
    """The sum of the terms; 0 without any."""
    return sum((term for _, term in terms), 0.0)
