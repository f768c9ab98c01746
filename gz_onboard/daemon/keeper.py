"""Saving and restoring the estimator's state in the daemon."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gz_onboard import state
from gz_onboard.background import Background
from gz_onboard.pipeline import Pipeline

SAVE_PERIOD_NS, SAVE_AT_MOST_NS = 10_000_000_000, 1_000_000_000
SAVE_SOC = 0.001  # a change of the state of charge that is saved before the period is over
STATE_STUCK_S = 10.0

log = logging.getLogger("gz-onboard")


def state_file(directory: Path, vehicle: str) -> Path:
    """Return the path of the saved state of the vehicle with this name."""
    return directory / (re.sub(r"[^\w.+-]+", "-", vehicle) + ".json")


class StateKeeper:
    """Restores the estimator's state at start, and saves it on a separate thread."""

    def __init__(self, file: Path, key: str) -> None:
        self.file = file
        self.key = key
        self._thread = Background("state")
        self._saved_ns: int | None = None
        self._saved_soc: float | None = None
        self._failing = False

    @property
    def stuck(self) -> bool:
        """Whether the disk does not answer."""
        return self._thread.stuck > STATE_STUCK_S

    @property
    def failing(self) -> bool:
        """Whether the state cannot be saved: an error, or a disk that does not answer."""
        return self._failing or self.stuck

    def restore(self, pipeline: Pipeline, make: Callable[[], Pipeline]) -> tuple[Pipeline, Mapping[str, Any] | None]:
        """Restore the newest copy that can be used into `pipeline`; return the pipeline to use, and the snapshot.

        Never raises: without a usable copy the pipeline starts fresh. Copies that cannot be used are renamed, and the
        pipeline, into which parts of one may have been restored, is replaced by a new one from `make`.
        """
        refused = False
        for copy in state.copies(self.file):
            try:
                found = state.load(copy, time.time(), _uptime(), state.kept_time())
                if found is None:
                    continue
                snapshot, age = found
                pipeline.estimator.restore(snapshot, self.key, age)
            except Exception as error:  # whatever the file holds: an estimate from nothing is better than none
                refused, pipeline = True, make()
                log.warning("saved state %s %s: not used%s", copy, str(error) or repr(error), _set_aside(copy))
            else:
                when = "at an unknown time" if age is None else f"{age:.0f} s ago"
                log.info("continuing from the state saved %s", when)
                return pipeline, snapshot
        if refused:
            log.warning("no saved state can be used: starting fresh")
        return pipeline, None

    def save_if_due(self, pipeline: Pipeline, now_ns: int) -> None:
        """Save once in the period, or when the state of charge has moved; not while the last save is under way."""
        if self._thread.load:
            return
        soc = pipeline.last.soc if pipeline.last else None
        if self._saved_ns is not None:
            since = abs(now_ns - self._saved_ns)  # the clock may be set back
            before = self._saved_soc
            moved = soc is not None and (before is None or abs(soc - before) >= SAVE_SOC)
            if since < (SAVE_AT_MOST_NS if moved else SAVE_PERIOD_NS):
                return
        elif soc is None:
            return
        self.save(pipeline, now_ns)

    def save(self, pipeline: Pipeline, now_ns: int) -> None:
        """Save now."""
        snapshot = pipeline.estimator.snapshot(self.key)
        if snapshot is None:
            return
        self._saved_ns, self._saved_soc = now_ns, pipeline.last.soc if pipeline.last else None
        uptime = _uptime()
        self._thread.call(self._write, snapshot, now_ns * 1e-9, uptime, weight=0 if self._thread.load else 1)

    def close(self, seconds: float) -> bool:
        """Wait until all is saved; False if it cannot be, or if that takes longer than `seconds`."""
        return self._thread.close(seconds) and not self._failing

    def _write(self, snapshot: Mapping[str, Any], saved_at: float, uptime: float) -> None:
        try:
            state.write(self.file, state.encode(snapshot, saved_at, uptime))
        except (OSError, ValueError, TypeError) as error:
            if not self._failing:
                log.warning("cannot save the state: %s", error)
            self._failing = True
        else:
            if self._failing:
                log.info("the state is saved again")
            self._failing = False


def _set_aside(copy: Path) -> str:
    """Rename a copy that cannot be used; return the end of the message."""
    refused = copy.with_name(f"{copy.name}.refused")
    try:
        copy.replace(refused)
    except OSError:
        return ""
    return f", kept as {refused}"


def _uptime() -> float:
    """Time since the system was started, suspended or not [s]."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)
