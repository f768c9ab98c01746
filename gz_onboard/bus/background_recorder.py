"""The recorder for a loop that may not wait for a disk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gz_onboard.background import Background
from gz_onboard.bus.recorder import Recorder
from gz_onboard.events import Frame

_STUCK = 10.0  # s: no disk takes as long


class BackgroundRecorder:
    """A `Recorder` on a thread of its own, for one that may not wait for a disk. Nothing else may use the recorder.

    limit: how many frames may wait for the disk (a value of a sample counts as one); what does not fit is left out,
    whole portions of it, and counted in `lost_frames`.
    """

    def __init__(self, recorder: Recorder, limit: int = 40_000) -> None:
        self._recorder = recorder
        self._thread = Background("log", limit, recorder.complete_one)
        self._left_out = 0
        self._full = False
        self._now_ns = 0
        self._syncing = False

    @property
    def failing(self) -> bool:
        """Whether frames are lost: errors, or a disk that is too slow or does not answer."""
        return self._recorder.failing or self._full or self._thread.stuck > _STUCK

    @property
    def last_error(self) -> str:
        """Why it is failing."""
        if self._recorder.failing:
            return self._recorder.last_error
        return "the disk is too slow" if self._full else "the disk does not answer"

    @property
    def lost_frames(self) -> int:
        """Frames not known to be in a file."""
        return self._recorder.lost_frames + self._left_out

    def channel(self, topic: str, json_schema: Mapping[str, Any], metadata: Mapping[str, str] | None = None) -> None:
        """As that of `Recorder`; to be called before anything is logged."""
        self._recorder.channel(topic, json_schema, metadata)

    def frames(self, batch: Sequence[Frame]) -> None:
        """As that of `Recorder`; `batch` may not be changed afterwards."""
        if batch and not self._thread.call(self._recorder.frames, batch, weight=len(batch)):
            self._left_out += len(batch)
            self._full = True

    def sample(self, topic: str, time_ns: int, values: Mapping[str, object], seen_ns: int | None = None) -> None:
        """As that of `Recorder`; `values` may not be changed afterwards."""
        if not self._thread.call(self._recorder.sample, topic, time_ns, values, seen_ns, weight=len(values)):
            self._full = True

    def sync(self, now_ns: int) -> None:
        """As that of `Recorder`."""
        self._now_ns = now_ns
        if self._full and self._thread.load < 0.5:
            self._full = False
        if not self._syncing:
            self._syncing = True  # before the call: it may be done, and have said so, before `call` returns
            if not self._thread.call(self._sync, weight=0):
                self._syncing = False

    def close(self, seconds: float) -> bool:
        """Write what waits and close the file; False if that takes longer than `seconds`: the rest is lost then."""
        self._thread.call(self._recorder.close, weight=0)
        return self._thread.close(seconds)

    def _sync(self) -> None:
        self._syncing = False
        self._recorder.sync(self._now_ns)
