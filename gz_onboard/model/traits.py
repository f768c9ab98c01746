"""Traits of an effect that only offline tools read, from its file: see `model.effect` for their meaning."""

from __future__ import annotations

import inspect
from dataclasses import dataclass, fields
from functools import cache
from types import ModuleType

from gz_onboard.model.effect import Effect, Equation


@dataclass(frozen=True)
class Traits:
    """Traits of one effect."""

    shown_by: str = ""
    turning_loss: bool = False
    strengths: tuple[str, ...] = ()  # parameters that change where it is found; the first is reported first
    varies: bool = False  # from ride to ride by itself
    cause: tuple[str, str] | None = None  # name and equation of a change, for an effect of every model
    doc: str = ""
    variation: Equation | None = None


def traits(effect: Effect) -> Traits:
    """The traits in the file of `effect`."""
    return _traits(effect.module)


@cache
def _traits(module: ModuleType) -> Traits:
    first = tuple(parameter.name for parameter in module.PARAMETERS[:1])
    names = [entry.name for entry in fields(Traits)]
    given = {name: getattr(module, name.upper()) for name in names if hasattr(module, name.upper())}
    variation = Equation.of(module.variation) if hasattr(module, "variation") else None
    return Traits(**{"strengths": first, "doc": inspect.getdoc(module) or "", "variation": variation} | given)
