"""The saved state of the daemon, resumed by a recorded ride and saved after it.

A daemon that cannot use a state sets it aside and begins anew: nobody is there. Here it is refused, and left as it is.
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
from gz_onboard.offline.digest import digest_of
from gz_onboard.pipeline import Pipeline

SUFFIX = ".json"
OVERTAKEN = 2e-9 * BACK_NS  # s: of a log that was cut in two, the second may begin so much before the first ends
_LATE = 1e11  # s since the epoch: after any state


@dataclass(frozen=True)
class StateAt:
    """A saved state, and the ride that goes on from it. begin_ns: when that begins [ns since the epoch]; rider: who
    rides, if that is known.
    """

    file: Path
    begin_ns: int
    rider: str = ""


@dataclass(frozen=True)
class WentOn:
    """How a ride began: whether there was a saved state to go on from, and its age [s] if that is known.

    digest: of the state's file.
    """

    found: bool
    age: float | None = None
    digest: str = ""


def go_on(pipeline: Pipeline, at: StateAt, ride: Path) -> WentOn:
    """Restore what was saved, as the daemon does when it starts. ride: what errors call it.

    InputError for a state that is damaged, of another vehicle or version, or saved after the ride began.
    """
    began, begin = WentOn(False), at.begin_ns * 1e-9
    if copy := latest(at.file):
        try:
            found = state.load(copy, begin)
            if found is None:
                raise ValueError("is gone")
            snapshot, age = found
            if age is None:
                age = _age_after(copy, begin, ride)
            pipeline.estimator.restore(snapshot, pipeline.vehicle.key, age)
        except ValueError as error:
            raise _refused(at.file, copy, error) from error
        began = WentOn(True, age, digest_of(copy))
    if at.rider:
        pipeline.estimator.forecaster.ridden_by(at.rider)
    return began


def _refused(file: Path, copy: Path, error: Exception) -> InputError:
    _, before = state.copies(file)
    older = f"; the one before it is {before}" if copy != before and before.exists() else ""
    return InputError(
        f"{copy}: {error}; give the state of this vehicle; to begin anew, give a new name, of no file yet{older}"
    )


def latest(file: Path) -> Path | None:
    """Where the latest state is, of the copies of `file`; None if there is none."""
    return next((copy for copy in state.copies(file) if copy.exists()), None)


def _age_after(copy: Path, begin: float, ride: Path) -> float | None:
    """The age of a state that is of after `begin` [s since the epoch] by no more than frames may overtake each other.

    None for one of no known time, which may be of any. InputError for one that is of later.
    """
    found = state.load(copy, _LATE)
    if found is None or found[1] is None:
        return None
    saved = _LATE - found[1]
    if saved - begin > OVERTAKEN:
        raise InputError(
            f"{ride}: began at {when(begin)}, before the state {copy} was saved at {when(saved)}; "
            "give the rides that came after it; to begin anew, give the state a new name, of no file yet"
        )
    return 0.0


def text_of(pipeline: Pipeline) -> bytes | None:
    """The text of the state file after a ride; None while nothing is known. InputError if it cannot be saved."""
    snapshot = pipeline.estimator.snapshot(pipeline.vehicle.key)
    if snapshot is None:
        return None
    try:
        return state.encode(snapshot, pipeline.codec.last_ns * 1e-9)
    except (ValueError, TypeError) as error:
        raise InputError(f"the state after the ride cannot be saved: {error}") from error


@contextmanager
def held(file: Path) -> Iterator[None]:
    """Keep the daemon, and others who write states, from the folder of the state `file`, which is made if need be.

    InputError if one of them has it, or if it cannot be.
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
    """A time [s since the epoch] as it is written."""
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
