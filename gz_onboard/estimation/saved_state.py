"""Carry the daemon's saved state from one recorded ride to the next, in the order of their times.

A daemon sets a state aside that it cannot use, because nobody is there to ask. Here it is refused and left unchanged.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from gz_onboard import state
from gz_onboard.can.codec import BACK_NS
from gz_onboard.errors import InputError, writing
from gz_onboard.pipeline import Pipeline

SUFFIX = ".json"
MAX_OVERLAP_S = 2e-9 * BACK_NS  # of the two parts of a log that was cut
_FAR_FUTURE_S = 1e11  # since the epoch


@dataclass(frozen=True)
class RideState:
    """The file of a saved state, and the ride that continues from it.

    begin_ns, end_ns: of the ride [ns since the epoch]; rider: empty if unknown.
    """

    file: Path
    begin_ns: int
    end_ns: int
    rider: str = ""


@dataclass(frozen=True)
class Resumed:
    """How a ride began. found: whether there was a state; age_s: its age, None if unknown."""

    found: bool
    age_s: float | None = None


def resume(pipeline: Pipeline, at: RideState, ride: Path) -> Resumed:
    """Restore the saved state, as the daemon does when it starts; `ride` is named in errors.

    InputError for a state that is damaged, of another vehicle or version, or saved after the ride began.
    """
    resumed, begin = Resumed(False), at.begin_ns * 1e-9
    if copy := latest(at.file):
        try:
            found = state.load(copy, begin)
            if found is None:
                raise ValueError("was removed")
            snapshot, age = found
            if age is None and (saved := saved_at(copy)) is not None:
                if saved - begin > MAX_OVERLAP_S:
                    raise InputError(
                        f"{ride}: began at {when(begin)}, before the state {copy} was saved at {when(saved)}; give "
                        "the rides that came after it; to begin anew, give the state a new name, of no file yet"
                    )
                age = 0.0
            pipeline.estimator.restore(snapshot, pipeline.vehicle.key, age)
        except ValueError as error:
            previous = state.copies(at.file)[1]
            older = f"; the one before it is {previous}" if copy != previous and previous.exists() else ""
            raise InputError(
                f"{ride}: {copy}: {error}; give the state of this vehicle; to begin anew, give a new name, of no file "
                f"yet{older}"
            ) from error
        resumed = Resumed(True, age)
    if at.rider:
        pipeline.estimator.forecaster.ridden_by(at.rider)
    return resumed


def latest(file: Path) -> Path | None:
    """Return the latest copy of the state `file`; None if there is none."""
    return next((copy for copy in state.copies(file) if copy.exists()), None)


def saved_at(copy: Path) -> float | None:
    """Return when a state was saved [s since the epoch]; None if that is unknown. ValueError if it is damaged."""
    found = state.load(copy, _FAR_FUTURE_S)
    return None if found is None or found[1] is None else _FAR_FUTURE_S - found[1]


def save_state(file: Path, pipeline: Pipeline) -> None:
    """Save the state after a ride, if anything is known. InputError if the file cannot be written."""
    if snapshot := pipeline.estimator.snapshot(pipeline.vehicle.key):
        with writing(file):
            state.write(file, state.encode(snapshot, pipeline.codec.last_ns * 1e-9))


@contextmanager
def locked(file: Path) -> Iterator[None]:
    """Lock the folder of the state `file` against the daemon and other writers; make the folder if there is none.

    InputError if another process holds it, or if it cannot be made.
    """
    if file.suffix != SUFFIX:
        raise InputError(f"state {file}: give it a name that ends in {SUFFIX}")
    folder = state.copies(file)[0].parent
    with writing(file):
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(
                f"state {file}: another gz-onboard (run, estimate) saves states in its folder; "
                "wait for it or stop it, or take a copy to another folder"
            ) from error
        except OSError:  # a file system without locks
            pass
        yield
    finally:
        os.close(descriptor)


def when(seconds: float) -> str:
    """Write a time [s since the epoch] for a person."""
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
