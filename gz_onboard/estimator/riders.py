"""Whose riding is usual: what is learned of each rider is kept apart, where the rider is known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from gz_onboard.estimator.usual import LEVEL_SD, Habit, Unit, Usual, restored_usual

MOST_RIDERS = 50
LONGEST_NAME = 40  # letters
NOBODY = ""  # a rider who is not known


class Riders:
    """Who rides, and what was usual for the others."""

    def __init__(self) -> None:
        self.now = NOBODY
        self.others: dict[str, Usual] = {}

    def change(self, name: str, usual: Usual) -> Usual:
        """`name` rides from now on; `usual`: of who rode until now, after the ride. Gives that of the new one.

        Who never rode is taken to ride as the one before, but for how much riders differ. What the parameters have
        wrong is the vehicle's, whoever rides.
        """
        self.others[self.now] = usual
        known = self.others.pop(name, None)
        if known is None:
            known = replace(usual, price=_of_another(usual.price), pace=_of_another(usual.pace))
            while len(self.others) >= MOST_RIDERS:  # the one who was first known
                del self.others[next(iter(self.others))]
        self.now = name
        return replace(known, factor=usual.factor)

    def snapshot(self) -> dict[str, Any]:
        """What is to be kept over a restart."""
        return {"rider": self.now, "riders": {name: usual.snapshot() for name, usual in self.others.items()}}


def _of_another(habit: Habit) -> Habit:
    return replace(habit, usual_variance=habit.usual_variance + LEVEL_SD**2)


def restored_riders(saved: Mapping[str, Any], unit: Unit) -> Riders:
    """What `Riders.snapshot` gave; nobody where nothing was saved. KeyError, TypeError or ValueError if damaged.

    unit: see `restored_usual`.
    """
    riders = Riders()
    riders.now = _name(saved.get("rider", NOBODY))
    others = saved.get("riders", {})
    if len(others) > MOST_RIDERS or riders.now in others:
        raise ValueError("implausible riders")
    riders.others = {_name(name): restored_usual(usual, unit) for name, usual in others.items()}
    return riders


def _name(value: object) -> str:
    if not isinstance(value, str) or len(value) > LONGEST_NAME:
        raise ValueError("implausible rider")
    return value
