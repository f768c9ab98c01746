"""``gz-onboard learned``: what the daemon has learned of a vehicle and keeps in its state file; forget it on request.

The state holds it under ``learned``, by name. Whoever learns more adds a name there and to `read_learned`.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import time
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from gz_onboard import state
from gz_onboard.daemon.keeper import state_file
from gz_onboard.errors import OK, InputError, writing
from gz_onboard.estimator.ageing import Ageing, Learned
from gz_onboard.options import add_shared
from gz_onboard.vehicle import Vehicle, read_vehicle

VERSION = 1  # of the JSON keys
USUAL_FOLDER = Path("/var/lib/gz-onboard")
MEANING = {  # by name: what its factor is on
    "capacity": "of the pack, over cell_capacity in the vehicle file, as the pack's current sensor counts it",
    "resistance": "of the cells, over the vehicle file's R0, R1 and effects in the cells",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    add_shared(parser, "--vehicle", "--json")
    parser.add_argument(
        "--state", type=Path, metavar="FILE", help=f"saved state (default: the vehicle's in {USUAL_FOLDER})"
    )
    parser.add_argument(
        "--reset", choices=(*MEANING, "all"), help="forget this, as after a new battery; the daemon must not run"
    )


def run(arguments: argparse.Namespace) -> int:
    """Show, or forget. InputError if the state cannot be read, is another vehicle's, or is in use."""
    vehicle = read_vehicle(arguments.vehicle)
    file = arguments.state or state_file(USUAL_FOLDER, vehicle.name)
    snapshot, age = _load(file, vehicle)
    if arguments.reset:
        names = tuple(MEANING) if arguments.reset == "all" else (arguments.reset,)
        snapshot = _forget(file, snapshot, age, names)
    learned = read_learned(vehicle, snapshot)
    if arguments.json:
        document = {
            "version": VERSION,
            "vehicle": vehicle.key,
            "age_s": age,
            "learned": {
                name: {"factor": x.value, "sd": x.sd, "percent_learned": round(100 * x.share), "of": MEANING[name]}
                for name, x in learned.items()
            },
        }
        text = json.dumps(document, indent=1)
        if arguments.json == "-":
            print(text)
            return OK
        with writing(arguments.json):
            Path(arguments.json).write_text(text + "\n", encoding="utf-8")
    for name, x in learned.items():
        known = f"{100 * x.share:3.0f} % learned" if x.share else "nothing learned"
        print(f"{name:12} {x.value:5.3f} ± {x.sd:5.3f}  {known}: {MEANING[name]}")
    return OK


def read_learned(vehicle: Vehicle, snapshot: Mapping[str, Any]) -> dict[str, Learned]:
    """What a saved state holds, by name. InputError if it cannot be."""
    ageing = Ageing(vehicle.pack.own())
    try:
        ageing.restore(snapshot.get("learned", {}))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"the saved state is damaged: {error!r}") from error
    return ageing.learned()


def _load(file: Path, vehicle: Vehicle) -> tuple[Mapping[str, Any], float | None]:
    """(snapshot, its age by the clock [s] if known)."""
    try:
        found = state.load(file, time.time())
    except ValueError as error:
        raise InputError(f"{file}: {error}") from error
    if found is None:
        raise InputError(f"{file}: no saved state; --state FILE names it, in the daemon's --state-dir")
    if (key := found[0].get("key")) != vehicle.key:
        raise InputError(f"{file}: is of {key!r}, this is {vehicle.key!r}; --vehicle names it")
    return found


def _forget(file: Path, snapshot: Mapping[str, Any], age: float | None, names: Collection[str]) -> Mapping[str, Any]:
    """The state without what was learned under `names`, as it is saved from now on, no younger than it was."""
    kept = {name: x for name, x in snapshot.get("learned", {}).items() if name not in names}
    changed = {**snapshot, "learned": kept}
    text = state.encode(changed, 0.0 if age is None else time.time() - age)
    with writing(file):
        descriptor = os.open(file.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            state.write(file, text)
        except BlockingIOError as error:
            raise InputError(f"{file}: gz-onboard run uses it and would save it anew; stop it first") from error
        finally:
            os.close(descriptor)
    return changed
