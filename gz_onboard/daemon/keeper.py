"""The saved state of the daemon's estimator: when it is written, and how it is taken up again."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gz_onboard import state
from gz_onboard.background import Background
from gz_onboard.estimator.snapshot import mended
from gz_onboard.pipeline import Pipeline

SAVE_PERIOD_NS, SAVE_AT_MOST_NS = 10_000_000_000, 1_000_000_000
SAVE_SOC = 0.001  # a change that is saved before the period is over: what a power cut may cost, and the next save
STATE_STUCK_S = 10.0

log = logging.getLogger("gz-onboard")


def state_file(directory: Path, vehicle: str) -> Path:
    """Where the state of the vehicle of this name is saved."""
    return directory / (re.sub(r"[^\w.+-]+", "-", vehicle) + ".json")


class StateKeeper:
    """Saves what the estimator knows, as often as it pays, on a thread of its own; restores it."""

    def __init__(self, file: Path, key: str) -> None:
        self.file = file
        self.key = key
        self._thread = Background("state")
        self._saved_ns: int | None = None
        self._saved_soc: float | None = None
        self._failing = self._stuck = False

    @property
    def failing(self) -> bool:
        """Whether the state cannot be saved: an error, or a disk that does not answer."""
        return self._failing or self._thread.stuck > STATE_STUCK_S

    def restore(self, pipeline: Pipeline, anew: Callable[[], Pipeline]) -> tuple[Pipeline, dict[str, Any] | None]:
        """(the pipeline to go on with, the latest saved state that could be used). Others are set aside.

        If none is whole, the sound parts of the latest that is the vehicle's are gone on from, and saved.
        Nothing is raised: after a state that may have been taken over in part the pipeline is made `anew`.
        """
        damaged: list[tuple[Path, Mapping[str, Any], float | None]] = []
        for copy in state.copies(self.file):
            found = None
            try:
                found = state.load(copy, time.time(), _uptime(), state.kept_time())
                if found is None:
                    continue
                snapshot, age = found
                pipeline.estimator.restore(snapshot, self.key, age)
            except Exception as error:  # whatever it holds: an estimate from nothing is better than none
                if not isinstance(error, ValueError):  # it may have been taken over in part
                    pipeline = anew()
                aside = state.set_aside(self.file, copy)
                kept = f", kept as {aside}" if aside else ""
                log.warning("saved state %s %s: not used%s", copy, str(error) or repr(error), kept)
                damaged += [(aside or copy, *found)] if found and isinstance(error, ValueError) else []
            else:
                when = "at an unknown time" if age is None else f"{age:.0f} s ago"
                log.info("going on from the state saved %s", when)
                return pipeline, dict(snapshot)
        for copy, saved, age in damaged:
            try:
                return pipeline, self._restore_mended(pipeline, copy, saved, age)
            except Exception:  # another vehicle's; why it is not used was said
                pipeline = anew()
        return pipeline, None

    def _restore_mended(
        self, pipeline: Pipeline, copy: Path, saved: Mapping[str, Any], age: float | None
    ) -> dict[str, Any]:
        """Go on from a saved state without its damaged parts, which is saved; it is given. Raises if it cannot be."""
        known = pipeline.estimator
        learning = known.soc.ageing, known.weakest
        snapshot, lost = mended(saved, self.key, known.soc.effects, learning, known.forecaster)
        known.restore(snapshot, self.key, age)
        text = state.encode(snapshot, 0.0 if age is None else time.time() - age)
        log.warning("going on from %s without its damaged parts, which begin anew: %s", copy, ", ".join(lost))
        self._write(text)
        return snapshot

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
        try:
            text = state.encode(snapshot, now_ns * 1e-9, _uptime())
        except (ValueError, TypeError) as error:
            self._thread.call(self._warn, error, weight=0)  # in its turn: what waits may still be saved
        else:
            self._thread.call(self._write, text, weight=0 if self._thread.load else 1)

    def report(self) -> None:
        """Log once that the disk does not answer."""
        stuck = self._thread.stuck > STATE_STUCK_S
        if stuck and not self._stuck:
            log.warning("cannot save the state: the disk does not answer")
        self._stuck = stuck

    def close(self, seconds: float) -> bool:
        """Wait until all is saved; False if it cannot be, or if that takes longer than `seconds`."""
        return self._thread.close(seconds) and not self._failing

    def _write(self, text: bytes) -> None:
        try:
            state.write(self.file, text)
        except OSError as error:
            self._warn(error)
        else:
            if self._failing:
                log.info("the state is saved again")
            self._failing = False

    def _warn(self, error: Exception) -> None:
        if not self._failing:
            log.warning("cannot save the state: %s", error)
        self._failing = True


def _uptime() -> float:
    """Time since the system was started, suspended or not [s]."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)
