"""Saving and restoring the estimator's state in the daemon."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from math import inf
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
        self._saved_ns, self._saved_soc = 0, inf
        self._failed = False

    @property
    def stuck(self) -> bool:
        """Whether the disk does not answer."""
        return self._thread.stuck > STATE_STUCK_S

    @property
    def failing(self) -> bool:
        """Whether the state cannot be saved: an error, or a disk that does not answer."""
        return self._failed or self.stuck

    def restore(self, pipeline: Pipeline, make: Callable[[], Pipeline]) -> tuple[Pipeline, Mapping[str, Any] | None]:
        """Restore the newest copy that can be used into `pipeline`; return the pipeline to use, and the snapshot.

        Never raises: without a usable copy the pipeline starts fresh. A copy that cannot be used is renamed to end in
        ``.refused``, and the pipeline, into which parts of it may have been restored, is replaced by one from `make`.
        """
        refused = False
        for copy in state.copies(self.file):
            try:
                found = state.load(copy, time.time(), time.clock_gettime(time.CLOCK_BOOTTIME), state.kept_time())
                if found is None:
                    continue
                snapshot, age = found
                pipeline.estimator.restore(snapshot, self.key, age)
            except Exception as error:  # whatever the file holds: an estimate from nothing is better than none
                refused, pipeline, kept = True, make(), copy
                with suppress(OSError):
                    kept = copy.replace(copy.with_name(f"{copy.name}.refused"))
                log.warning("saved state not used, kept as %s: %s", kept, str(error) or repr(error))
            else:
                when = "at an unknown time" if age is None else f"{age:.0f} s ago"
                log.info("continuing from the state saved %s", when)
                return pipeline, snapshot
        if refused:
            log.warning("no saved state can be used: starting fresh")
        return pipeline, None

    def save_if_due(self, pipeline: Pipeline, now_ns: int) -> None:
        """Save once in the period, or when the state of charge has moved; not while the last save is under way."""
        soc = pipeline.last.soc if pipeline.last else None
        moved = soc is not None and abs(soc - self._saved_soc) >= SAVE_SOC
        since = abs(now_ns - self._saved_ns)  # the clock may be set back
        if since >= (SAVE_AT_MOST_NS if moved else SAVE_PERIOD_NS) and not self._thread.load:
            self.save(pipeline, now_ns)

    def save(self, pipeline: Pipeline, now_ns: int) -> None:
        """Save now, if there is something to save."""
        snapshot = pipeline.estimator.snapshot(self.key)
        if snapshot is None:
            return
        if pipeline.last and pipeline.last.soc is not None:
            self._saved_soc = pipeline.last.soc
        self._saved_ns = now_ns
        uptime = time.clock_gettime(time.CLOCK_BOOTTIME)
        self._thread.call(self._write, snapshot, now_ns * 1e-9, uptime, weight=0 if self._thread.load else 1)

    def close(self, seconds: float) -> bool:
        """Wait until all is saved; False if it cannot be, or if that takes longer than `seconds`."""
        return self._thread.close(seconds) and not self._failed

    def _write(self, snapshot: Mapping[str, Any], saved_at: float, uptime: float) -> None:
        try:
            state.write(self.file, state.encode(snapshot, saved_at, uptime))
        except (OSError, ValueError, TypeError) as error:
            if not self._failed:
                log.warning("cannot save the state: %s", error)
            self._failed = True
        else:
            if self._failed:
                log.info("the state is saved again")
            self._failed = False
