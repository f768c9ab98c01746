"""``gz-onboard learned``: show or reset the daemon's knowledge of a vehicle and its riders."""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from math import sqrt
from pathlib import Path
from typing import Any

from gz_onboard import state
from gz_onboard.errors import OK, InputError, not_an_input, writing
from gz_onboard.estimator.consumption import Habits
from gz_onboard.estimator.estimator import Estimator
from gz_onboard.estimator.pack_age import LearnedFactor
from gz_onboard.estimator.saved_state import check_vehicle
from gz_onboard.options import add_shared
from gz_onboard.pipeline import Pipeline
from gz_onboard.vehicle import Vehicle, read_vehicle

JSON_VERSION = 4
STATE_FOLDER = Path("/var/lib/gz-onboard")
MEANING = {  # by name: what its factor is relative to
    "capacity": "capacity of the pack, relative to cell_capacity in the vehicle file",
    "resistance": "resistance of the cells, relative to R0 and R1 in the vehicle file",
    "weak_charge": "charge of the weakest group of cells when full, relative to the mean cell",
    "weak_capacity": "capacity of the weakest group, relative to the mean cell",
    "weak_resistance": "resistance of the weakest group, relative to the mean cell",
    "price": "energy per kilometre in motion, relative to the prior in the vehicle file",
    "stops": "energy at stops, relative to the prior",
    "pace": "time per kilometre, relative to the prior",
    "factor": "measured over modelled energy of the same motion",
}
RESETS = {"battery": ("learned",), "riding": ("riding",), "all": ("learned", "riding")}  # parts of the saved state


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    add_shared(parser, "--vehicle", "--vehicle-id", "--json")
    parser.add_argument(
        "--state", type=Path, metavar="FILE", help=f"saved state (default: the vehicle's in {STATE_FOLDER})"
    )
    parser.add_argument(
        "--reset",
        choices=tuple(RESETS),
        help="forget this: `battery` after the pack was replaced, `all` for a new owner; stop the daemon first",
    )


def run(arguments: argparse.Namespace) -> int:
    """Reset parts of a state, if asked for, and show it. InputError for a state that cannot be used."""
    vehicle = read_vehicle(arguments.vehicle, vehicle_id=arguments.vehicle_id)
    file = arguments.state or state.state_file(STATE_FOLDER, vehicle.name)
    not_an_input([arguments.json], [file, vehicle.file])
    if arguments.reset:
        reset(file, vehicle, arguments.reset)
        # not among the JSON on standard output
        print(f"reset in {file}: {arguments.reset}", file=sys.stderr if arguments.json == "-" else sys.stdout)
    estimator, age = read_state(file, vehicle)
    battery, riders = battery_learned(estimator), riders_learned(estimator)
    if arguments.json:
        rows = {"learned": _rows(battery), "riders": {name: _rows(found) for name, found in riders.items()}}
        text = json.dumps({"version": JSON_VERSION, "vehicle": vehicle.key, "age_s": age, **rows}, indent=1)
        if arguments.json == "-":
            print(text)
            return OK
        with writing(arguments.json):
            Path(arguments.json).write_text(text + "\n", encoding="utf-8")
    print(learned_text(battery, riders))
    return OK


@contextmanager
def _loaded(file: Path) -> Iterator[tuple[Mapping[str, Any], float | None]]:
    """Load a saved state to (snapshot, age [s]). InputError, with a remedy, if it cannot be used, also within."""
    try:
        found = state.load(file, time.time())
        if found is None:
            raise ValueError("no saved state; the daemon keeps one in its state folder")
        yield found
    except ValueError as error:
        raise InputError(f"{file}: {error}; choose another state file or vehicle") from error


def read_state(file: Path, vehicle: Vehicle) -> tuple[Estimator, float | None]:
    """Restore an estimator from a saved state; also its age by the clock [s], if known. InputError if it cannot be."""
    estimator = Pipeline(vehicle).estimator
    with _loaded(file) as (snapshot, age):
        estimator.restore(snapshot, vehicle.key, age)
    return estimator, age


def reset(file: Path, vehicle: Vehicle, what: str) -> None:
    """Replace parts of a saved state, one of `RESETS`, by those of a new estimator; the state gets no younger."""
    new = Pipeline(vehicle).estimator
    with _loaded(file) as (snapshot, age):
        check_vehicle(snapshot, vehicle.key)
    fresh = {"learned": new.pack.learned_snapshot(), "riding": new.forecaster.snapshot()}
    changed = {**snapshot, **{part: fresh[part] for part in RESETS[what]}}
    with ExitStack() as held, writing(file):
        folder = os.open(state.copies(file)[0].parent, os.O_RDONLY | os.O_DIRECTORY)
        held.callback(os.close, folder)
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(f"{file}: the running daemon would overwrite it; stop it first") from error
        state.write(file, state.encode(changed, 0.0 if age is None else time.time() - age))


def battery_learned(estimator: Estimator) -> dict[str, LearnedFactor]:
    """Return the learned battery, by name; the weakest group only if its voltage is on the bus."""
    pack = estimator.pack
    return pack.learned() | (pack.weakest.learned() if pack.weakest.mapped else {})


def riders_learned(estimator: Estimator) -> dict[str, dict[str, LearnedFactor]]:
    """Return the learned habits by rider and name; the last rider comes first."""
    learner = estimator.forecaster.learner
    riders = {learner.rider: learner.state.habits, **learner.other_riders}
    return {
        rider: {
            name: LearnedFactor(
                now.level / prior.level,
                sqrt(now.level_variance) / prior.level,
                max(1 - sqrt(now.level_variance / prior.level_variance), 0.0),
            )
            for name, now, prior in zip(Habits._fields, habits, learner.prior, strict=True)
        }
        for rider, habits in riders.items()
    }


def learned_text(battery: Mapping[str, LearnedFactor], riders: Mapping[str, Mapping[str, LearnedFactor]]) -> str:
    """Describe the learned battery and riders for a terminal; an unnamed rider only if something is known."""
    lines = ["per cent learned: share of the initial uncertainty that is gone"]
    lines += [_line(name, x) for name, x in battery.items()]
    for rider, habits in riders.items():
        if len(riders) == 1 or rider or any(x.share for x in habits.values()):
            heading = f"rider {rider}:" if rider else "rides without a known rider:"
            lines += [heading] * (len(riders) > 1) + [_line(name, x) for name, x in habits.items()]
    return "\n".join(lines)


def _line(name: str, x: LearnedFactor) -> str:
    share = f"{100 * x.share:3.0f} % learned" if x.share else "nothing learned"
    return f"{name:15} {x.value:5.3f} ± {x.sd:5.3f}  {share}: {MEANING[name]}"


def _rows(learned: Mapping[str, LearnedFactor]) -> dict[str, dict[str, object]]:
    return {
        name: {"factor": x.value, "sd": x.sd, "percent_learned": round(100 * x.share), "of": MEANING[name]}
        for name, x in learned.items()
    }
