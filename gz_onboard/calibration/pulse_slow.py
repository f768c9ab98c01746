"""The effect `slow_relaxation` out of pulse tests: what relaxes over tens of minutes, as one pair of two numbers.

It is what the slowest of the many pairs of `cell_fit` have, and changes little with temperature and, away from full and
empty, with the state of charge: diffusion in the particles. So one number each stands for its tables, the median, as
the resistance grows steeply where the open-circuit voltage is steep; what it leaves the fast pair takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gz_onboard.calibration.cell_fit import TIMES, VOLTAGE_SD, Branches, jackknife
from gz_onboard.calibration.result import Found, Result
from gz_onboard.model.effects import slow_relaxation as effect

EFFECT = effect.__name__.rpartition(".")[2]
RESISTANCE, TIME = effect.PARAMETERS
SLOW = 300.0  # s: a pair for a load like riding has a minute
MIDDLE = (0.15, 0.95)  # SOC between which the tables count
RATE = 1.0  # 1/h: the current over the capacity at which it must be more than the fit leaves
SURE = 3.0  # sd that the resistance is above zero

_SLOW = 1 + np.flatnonzero(np.array(TIMES) > SLOW)  # rows of `Branches.resistance`
_LOGS = np.log(np.array(TIMES))[_SLOW - 1]


@dataclass(frozen=True)
class SlowRelaxation:
    """The parameters of the effect [ohm, s], with their sds: how far the tables are off one number."""

    resistance: float
    time: float
    resistance_sd: float = 0.0
    time_sd: float = 0.0


def slow_relaxation(fitted: Sequence[Branches], capacity: float, result: Result) -> SlowRelaxation | None:
    """What the pairs of all temperatures show of it; None, with a note, if they do not.

    fitted: with parts left out; capacity [A·h].
    """
    tables, logs, doubts = [], [], []
    for f in fitted:
        counts = f.covered & (f.soc > MIDDLE[0]) & (f.soc < MIDDLE[1])
        if counts.any():
            pairs = f.resistance[_SLOW][:, counts]
            ohm, without = pairs.sum(axis=0), f.without[:, :, _SLOW][..., counts].sum(axis=2)
            tables.append(ohm)
            logs.append(_LOGS @ pairs / np.maximum(ohm, np.finfo(float).tiny))
            doubts.append(float(jackknife(np.median(ohm), np.median(without, axis=-1))))
    if not tables:
        return None
    ohm, log = np.concatenate(tables), np.concatenate(logs)
    value, doubt = float(np.median(ohm)), float(np.sqrt(np.sum(np.square(doubts)))) / len(doubts)
    if value < SURE * doubt or value * RATE * capacity < VOLTAGE_SD:
        result.notes.append(f"no slow relaxation is told from the rest: {1e3 * value:.2g} ± {1e3 * doubt:.2g} mΩ")
        return None
    seconds = float(np.exp(np.median(log[ohm > 0])))
    longest = " (the longest that is fitted)" if seconds > TIMES[-2] else ""
    result.notes.append(
        f"slow relaxation: {1e3 * value:.3g} ± {1e3 * doubt:.2g} mΩ, {seconds / 60:.0f} min{longest}; by temperature "
        f"{', '.join(f'{1e3 * np.median(x):.3g}' for x in tables)} mΩ"
    )
    spread = float(np.hypot(np.std(log[ohm > 0]), np.log(TIMES[-1] / TIMES[-2]) / 2))  # of ln: between two of TIMES
    return SlowRelaxation(value, seconds, float(np.hypot(ohm.std(), doubt)), seconds * spread)


def found(slow: SlowRelaxation | None, names: str, result: Result) -> None:
    """The effect and its parameters; without them if there is none: then the one pair has all that the pulses show."""
    result.effects[EFFECT] = slow is not None
    if slow:
        source = f"{names}: pairs slower than {SLOW:g} s, median over SOC and temperature"
        for parameter, value, sd in (
            (RESISTANCE, slow.resistance, slow.resistance_sd),
            (TIME, slow.time, slow.time_sd),
        ):
            result.parameters[parameter.name] = Found(value, sd, parameter.unit, source)
