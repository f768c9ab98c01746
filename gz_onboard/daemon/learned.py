"""``gz-onboard learned``: what the daemon has learned of a vehicle and its riders, and keeps in its state file.

Shown as text or JSON; forgotten on request.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import sys
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from math import sqrt
from pathlib import Path
from typing import Any

from gz_onboard import state
from gz_onboard.daemon.keeper import state_file
from gz_onboard.errors import OK, InputError, not_an_input, writing
from gz_onboard.estimator.ageing import Ageing, Learned
from gz_onboard.estimator.consumption import Habits, Quantity
from gz_onboard.estimator.forecast import Forecaster
from gz_onboard.estimator.signals import DEFAULT_STALE, Signals
from gz_onboard.estimator.snapshot import part, unlike
from gz_onboard.estimator.weakest import Weakest
from gz_onboard.options import add_shared
from gz_onboard.vehicle import Vehicle, read_vehicle

VERSION = 4  # of the JSON keys
USUAL_FOLDER = Path("/var/lib/gz-onboard")
MEANING = {  # by name: what its factor is on
    "capacity": "of the pack, over cell_capacity in the vehicle file, as the pack's current sensor counts it",
    "resistance": "of the cells, over the vehicle file's R0, R1 and quick effects in the cells",
    "weak_charge": "of the weakest group of cells, over the mean cell's, when that is full",
    "weak_capacity": "of that group, over the mean cell's",
    "weak_resistance": "of that group, over the mean cell's",
    "price": "energy of a kilometre in motion, over the prior riding's in the vehicle file",
    "stops": "energy at stops, likewise",
    "pace": "time of a kilometre, likewise",
    "factor": "measured over modelled energy of the same motion",
}
LEARNED = "per cent learned: how much of what was uncertain before the first ride no longer is"
ANEW = "; to begin anew, give `gz-onboard estimate --state` a new name; the daemon does so by itself when it starts"
BY_RESISTANCE = "; what the resistance tells of it stays: `--reset battery` forgets both"
BATTERY, RIDING = ("capacity", "resistance", "weakest"), "riding"
FORGOTTEN = {  # by the word of --reset: what it forgets
    **{name: (name,) for name in BATTERY},
    "battery": BATTERY,
    RIDING: (RIDING,),
    "all": (*BATTERY, RIDING),
}
PARTS = {  # what --reset says of each
    "capacity": "capacity of the battery",
    "resistance": "resistance of the battery",
    "weakest": "weakest group of cells",
    RIDING: "riding of all riders",
}
LOWEST = "lowest_cell_voltage"  # the role without which nothing is known of the weakest group


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    add_shared(parser, "--vehicle", "--vehicle-id", "--json")
    parser.add_argument(
        "--state", type=Path, metavar="FILE", help=f"saved state (default: the vehicle's in {USUAL_FOLDER})"
    )
    parser.add_argument(
        "--reset",
        choices=tuple(FORGOTTEN),
        help="forget this, as `battery` after a new one, or `all` for a new owner; the daemon must not run",
    )


def run(arguments: argparse.Namespace) -> int:
    """Show, or forget. InputError if the state cannot be read, is another vehicle's, or is in use."""
    vehicle = read_vehicle(arguments.vehicle, vehicle_id=arguments.vehicle_id)
    file = arguments.state or state_file(USUAL_FOLDER, vehicle.name)
    not_an_input([arguments.json], [file, vehicle.file])
    try:
        snapshot, age = load(file, vehicle)
    except InputError as error:
        anew = ANEW if file.is_file() else ""
        raise InputError(f"{error}; choose another with --state FILE or --vehicle NAME|TOML{anew}") from error
    if arguments.reset:
        snapshot = _forget(file, snapshot, age, FORGOTTEN[arguments.reset], _fresh(vehicle))
        forgotten = ", ".join(PARTS[name] for name in FORGOTTEN[arguments.reset])
        forgotten += BY_RESISTANCE if arguments.reset == "capacity" else ""
        # with the JSON on standard output it would be no JSON
        print(f"reset in {file}: {forgotten}", file=sys.stderr if arguments.json == "-" else sys.stdout)
    with _or_forget(file, "battery"):
        learned = read_learned(vehicle, snapshot)
    with _or_forget(file, RIDING):
        riders = read_riders(vehicle, snapshot)
    if arguments.json:
        rows = {"learned": _rows(learned), "riders": {name: _rows(x) for name, x in riders.items()}}
        text = json.dumps({"version": VERSION, "vehicle": vehicle.key, "age_s": age, **rows}, indent=1)
        if arguments.json == "-":
            print(text)
            return OK
        with writing(arguments.json):
            Path(arguments.json).write_text(text + "\n", encoding="utf-8")
    print(learned_text(learned, riders))
    return OK


def learned_text(learned: Mapping[str, Learned], riders: Mapping[str, Mapping[str, Learned]]) -> str:
    """For a terminal; an unknown rider is left out if nothing is known of his riding."""
    lines = [LEARNED, *(_line(name, x) for name, x in learned.items())]
    for rider, habits in riders.items():
        if len(riders) > 1:
            if not rider and not any(x.share for x in habits.values()):
                continue
            lines.append(f"rider {rider}:" if rider else "rides of which nobody said who rode:")
        lines += [_line(name, x) for name, x in habits.items()]
    return "\n".join(lines)


def read_learned(vehicle: Vehicle, snapshot: Mapping[str, Any]) -> dict[str, Learned]:
    """What a saved state holds of the battery, by name. ValueError if it cannot be."""
    ageing = Ageing(vehicle.pack.own())
    with part("capacity or resistance"):
        ageing.restore(snapshot.get("learned", {}))
    return ageing.learned() | _of_weakest(vehicle, snapshot)


def _of_weakest(vehicle: Vehicle, snapshot: Mapping[str, Any]) -> dict[str, Learned]:
    if all(source.role != LOWEST for source in vehicle.mapping.sources):
        return {}
    weakest = Weakest(vehicle.pack.own(), Signals([(LOWEST, DEFAULT_STALE)]), vehicle.parameters)
    with part("weakest"):
        weakest.take_on(weakest.read(snapshot.get("learned", {}).get("weakest")))
    return weakest.learned()


def read_riders(vehicle: Vehicle, snapshot: Mapping[str, Any]) -> dict[str, dict[str, Learned]]:
    """What a saved state holds of the riding, by rider and name; who rode last comes first. ValueError likewise."""
    forecaster = _fresh(vehicle)
    learner = forecaster.learner
    with part(RIDING):
        forecaster.restore(snapshot["riding"])
    riders = {learner.rider: learner.habits, **learner.other_riders}
    return {name: _of_habits(habits, learner.prior) for name, habits in riders.items()}


def _of_habits(habits: Habits, prior: Habits) -> dict[str, Learned]:
    names = [field.name for field in fields(Habits)]
    return {name: _of_quantity(getattr(habits, name), getattr(prior, name)) for name in names}


def _of_quantity(quantity: Quantity, prior: Quantity) -> Learned:
    sd, unknown = sqrt(quantity.level_variance), sqrt(prior.level_variance)
    return Learned(quantity.level / prior.level, sd / prior.level, max(1 - sd / unknown, 0.0))


def _fresh(vehicle: Vehicle) -> Forecaster:
    """That has learned nothing."""
    return Forecaster(vehicle.model, vehicle.pack, vehicle.riding)


@contextmanager
def sound(file: Path) -> Iterator[None]:
    """InputError, which names the `file`, for a saved state that holds what cannot be."""
    try:
        yield
    except ValueError as error:
        raise InputError(f"{file}: {error}") from error


@contextmanager
def _or_forget(file: Path, word: str) -> Iterator[None]:
    """As `sound`, of the part that --reset forgets by `word`: how that is begun anew."""
    try:
        with sound(file):
            yield
    except InputError as error:
        raise InputError(f"{error}; --reset {word} begins that anew, --reset all everything") from error


def _rows(learned: Mapping[str, Learned]) -> dict[str, dict[str, object]]:
    return {
        name: {"factor": x.value, "sd": x.sd, "percent_learned": round(100 * x.share), "of": MEANING[name]}
        for name, x in learned.items()
    }


def _line(name: str, x: Learned) -> str:
    known = f"{100 * x.share:3.0f} % learned" if x.share else "nothing learned"
    return f"{name:12} {x.value:5.3f} ± {x.sd:5.3f}  {known}: {MEANING[name]}"


def load(file: Path, vehicle: Vehicle) -> tuple[Mapping[str, Any], float | None]:
    """(snapshot, its age by the clock [s] if known). InputError for a state that is missing, or another vehicle's."""
    with sound(file):
        found = state.load(file, time.time())
    if found is None:
        raise InputError(f"{file}: no saved state; the daemon keeps one in its state folder")
    with sound(file), part("state"):
        key = found[0].get("key")
    if key != vehicle.key:
        raise InputError(f"{file}: {unlike(key, vehicle.key)}")
    return found


def _forget(
    file: Path, snapshot: Mapping[str, Any], age: float | None, names: Collection[str], fresh: Forecaster
) -> Mapping[str, Any]:
    """The state without what was learned under `names`, as it is saved from now on, no younger than it was."""
    learned = snapshot.get("learned")
    kept = {name: x for name, x in learned.items() if name not in names} if isinstance(learned, Mapping) else {}
    changed = {**snapshot, "learned": kept}
    if RIDING in names:
        changed["riding"] = fresh.snapshot()
    with sound(file):
        text = state.encode(changed, 0.0 if age is None else time.time() - age)
    with writing(file):
        descriptor = os.open(state.target(file).parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            state.write(file, text)
        except BlockingIOError as error:
            raise InputError(f"{file}: the running daemon would overwrite it; stop it first") from error
        finally:
            os.close(descriptor)
    return changed
