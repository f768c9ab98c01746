"""What is kept over a restart, and whether what was kept can be gone on from."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from math import inf
from typing import Any

from gz_onboard.errors import shown
from gz_onboard.estimator.ageing import Ageing
from gz_onboard.estimator.bounds import within
from gz_onboard.estimator.cell_effects import CellEffects
from gz_onboard.estimator.forecast import Forecaster
from gz_onboard.estimator.start import SOC_UNKNOWN_SD, Saved
from gz_onboard.estimator.weakest import WeakestGroup

VERSION = (
    3  # 2: the states of effects with memory; 3: odometer, own SOC and consumption, for the charge that flows uncounted
)
CELLS = -50.0, 120.0  # degC
OPTIONAL = "current", "odometer", "own_soc", "consumption"  # where the vehicle does not tell it
NAMED = 3  # effects in a message
CELLS_KEEP = 3600.0  # s: for so long the cells' temperature is known


@dataclass(frozen=True)
class Restored:
    """The contents of a snapshot, checked."""

    battery: Saved | None  # None: what was saved of it was damaged, see `mended`
    age: float | None  # s; None: not known
    gyro_bias: tuple[float, float]  # rad/s, of roll and yaw rate
    cell_effects: dict[str, float]  # V of a cell, by name
    cell_temperature: float | None  # degC; None if it is too old


@contextmanager
def part(name: str) -> Iterator[None]:
    """ValueError, in words, for what a part of a saved state holds and cannot be."""
    try:
        yield
    except KeyError as error:
        raise ValueError(f"is damaged: its {name} lacks {error.args[0]}") from error
    except (TypeError, AttributeError, IndexError) as error:
        raise ValueError(f"is damaged: its {name} is not as it was saved") from error
    except (ValueError, OverflowError) as error:
        raise ValueError(f"is damaged: its {name} holds implausible numbers") from error


def read(
    saved: Mapping[str, Any],
    key: str,
    age: float | None,
    effects: CellEffects,
    learning: tuple[Ageing, WeakestGroup],
    restore_riding: Callable[[Mapping[str, Any]], None],
) -> Restored:
    """The snapshot `saved`, `age` [s] old, of the vehicle `key`; the riding, and what was learned of the
    pack's age, are restored if the rest fits.

    ValueError if it does not fit, whole.
    """
    if age is not None and not 0 <= age < inf:
        age = None
    _check_head(saved, key)
    battery, states = _charge(saved, effects)
    bias_x, bias_z = _biases(saved)
    learned = saved.get("learned", {})  # states from before there was any have none
    ageing, weakest = learning
    with part("capacity or resistance"):
        ageing.read(learned)
    with part("weakest"):
        of_group = weakest.read(learned.get("weakest"))
    with part("riding"):
        restore_riding(saved["riding"])
        ageing.restore(learned)
        weakest.take_on(of_group)
    cells = saved.get("cell_temperature")
    if not isinstance(cells, int | float) or not CELLS[0] < cells < CELLS[1] or age is None or age >= CELLS_KEEP:
        cells = None
    return Restored(battery, age, (bias_x, bias_z), states, None if cells is None else float(cells))


def mended(
    saved: Mapping[str, Any],
    key: str,
    effects: CellEffects,
    learning: tuple[Ageing, WeakestGroup],
    forecaster: Forecaster,
) -> tuple[dict[str, Any], list[str]]:
    """`saved` without its parts that are damaged, and their names; of estimators that have taken up no state.

    A part goes as a whole, and what was learned of one thing says nothing of another. But the capacity's covariance is
    with the state of charge that was saved: without that there is none. ValueError if it is of another vehicle `key`.
    """
    _check_head(saved, key)
    ageing, weakest = learning
    reads: dict[str, Callable[[Any], object]] = {
        "capacity": lambda x: ageing.read({"capacity": x}),
        "resistance": lambda x: ageing.read({"resistance": x}),
        "weakest": weakest.read,
    }
    learned, damaged = saved.get("learned", {}), []
    if not isinstance(learned, Mapping):
        learned, damaged = {}, ["learned"]
    kept: dict[str, Any] = {}
    for name, read_it in reads.items():
        if name not in learned:
            continue
        if _fits(name, functools.partial(read_it, learned[name])):
            kept[name] = learned[name]
        else:
            damaged.append(name)
    whole: dict[str, Any] = {**saved, "learned": kept}
    anew: dict[str, tuple[Callable[[], object], dict[str, Any]]] = {
        "riding": (lambda: forecaster.restore(saved["riding"]), {"riding": forecaster.snapshot()}),
        "gyro bias": (lambda: _biases(saved), {"gyro_bias": [0.0, 0.0]}),
        "charge": (lambda: _charge(saved, effects), {"soc": None, "covariance": None}),
    }
    for name, (check, begun) in anew.items():
        if not _fits(name, check):
            whole |= begun
            damaged.append(name)
    if whole["soc"] is None and kept.get("capacity"):
        kept["capacity"] = {**kept["capacity"], "with_soc": 0.0}
    return whole, damaged


def _check_head(saved: Mapping[str, Any], key: str) -> None:
    if not isinstance(saved, Mapping) or saved.get("version") != VERSION:
        version = saved.get("version") if isinstance(saved, Mapping) else saved
        raise ValueError(f"is of version {shown(version)}, not {VERSION}")
    if saved.get("key") != key:
        raise ValueError(unlike(saved.get("key"), key))


def unlike(saved: object, key: str) -> str:
    """How the vehicle `saved` with a state differs from that of `key`: by its name, its cells, or else its effects."""
    if not isinstance(saved, str) or not saved:
        return f"is of {shown(saved)}, this is {key.partition('|')[0]!r}"
    (name, cells, effects), (our_name, our_cells, ours) = _parts(saved), _parts(key)
    if name != our_name:
        return f"is of {shown(name)}, this is {our_name!r}"
    if cells != our_cells:
        return f"is of {name!r} with {shown(cells)}, this vehicle file has {our_cells!r}"
    lacks, has = [x for x in ours if x not in effects], [x for x in effects if x not in ours]
    said = [f"without {_names(lacks)}, which this one has"] if lacks else []
    said += [f"with {_names(has)}, which this one has not"] if has else []
    return f"is of a vehicle file of {name!r} {'; and '.join(said) or 'with its effects in another order'}"


def _parts(key: str) -> tuple[str, str, list[str]]:
    """The vehicle's name, its cells and its effects, as in `Vehicle.key`."""
    name, _, rest = key.partition("|")
    cells, *effects = rest.split("|")
    return name, cells, effects


def _names(effects: Sequence[str]) -> str:
    named = ", ".join(shown(name).strip("'") for name in effects[:NAMED])
    more = f" and {len(effects) - NAMED} more" if len(effects) > NAMED else ""
    return f"the effect{'s' if len(effects) > 1 else ''} {named}{more}"


def _fits(name: str, check: Callable[[], object]) -> bool:
    try:
        with part(name):
            check()
    except ValueError:
        return False
    return True


def of_learned(ageing: Ageing, weakest: WeakestGroup) -> dict[str, Any]:
    """What was learned of the vehicle, by name; of the weakest group only where its voltage is on the bus."""
    of_group = {"weakest": weakest.snapshot()} if weakest.mapped else {}
    return {**ageing.snapshot(), **of_group}


def _charge(saved: Mapping[str, Any], effects: CellEffects) -> tuple[Saved | None, dict[str, float]]:
    """The state of charge, and the states of the effects in the cells, which go with it."""
    with part("charge"):
        if saved["soc"] is None and saved["covariance"] is None:  # `mended`
            return None, {}
        optional = {name: None if saved[name] is None else float(saved[name]) for name in OPTIONAL}
        p00, p01, p11 = (float(x) for x in saved["covariance"])
        known = Saved(float(saved["soc"]), float(saved["v1"]), (p00, p01, p11), **optional)
        within("charge", asdict(known))
        if not (0 < p00 <= SOC_UNKNOWN_SD**2 and 0 < p11 < 1 and p01 * p01 <= p00 * p11):
            raise ValueError("a covariance that cannot be")
        return known, effects.read(saved["cell_effects"])


def _biases(saved: Mapping[str, Any]) -> tuple[float, float]:
    with part("gyro bias"):
        within("gyro_bias", saved["gyro_bias"])
        bias_x, bias_z = (float(x) for x in saved["gyro_bias"])
    return bias_x, bias_z
