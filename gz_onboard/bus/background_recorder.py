"""The recorder for a loop that may not wait for a disk."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from gz_onboard.background import Background
from gz_onboard.bus.recorder import Recorder
from gz_onboard.events import Frame

_STUCK_S = 10.0  # no disk takes as long


class BackgroundRecorder:
    """Runs a `Recorder` on its own thread, so that the caller never waits for the disk.

    Entries are handed over at `sync`, all at once: the thread wakes once a tick, not for each sample. limit: how many
    frames may wait for the disk (each value of a sample counts as one frame). Beyond it a whole portion is dropped, and
    its frames are counted in `lost_frames`. Nobody else may use the recorder.
    """

    def __init__(self, recorder: Recorder, limit: int = 40_000) -> None:
        self._recorder = recorder
        self._thread = Background("log", limit)
        self._dropped_frames = 0
        self._full = False
        self._portion: list[tuple[Callable[..., None], tuple[Any, ...]]] = []  # since the last `sync`
        self._frames = self._values = 0  # in it

    @property
    def failing(self) -> bool:
        """Whether frames are lost: errors, or a disk that is too slow or does not answer."""
        return self._recorder.failing or self._full or self._thread.stuck > _STUCK_S

    @property
    def last_error(self) -> str:
        """Why it is failing."""
        if self._recorder.failing:
            return self._recorder.last_error
        return "the disk is too slow" if self._full else "the disk does not answer"

    @property
    def lost_frames(self) -> int:
        """Frames not known to be in a file."""
        return self._recorder.lost_frames + self._dropped_frames

    def channel(self, topic: str, json_schema: Mapping[str, Any], metadata: Mapping[str, str] | None = None) -> None:
        """As `Recorder.channel`; call it before anything is logged."""
        self._recorder.channel(topic, json_schema, metadata)

    def frames(self, batch: Sequence[Frame]) -> None:
        """As `Recorder.frames`, at the next `sync`; `batch` may not be changed afterwards."""
        if batch:
            self._portion.append((self._recorder.frames, (batch,)))
            self._frames += len(batch)

    def sample(self, topic: str, time_ns: int, values: Mapping[str, object], seen_ns: int | None = None) -> None:
        """As `Recorder.sample`, at the next `sync`; `values` may not be changed afterwards."""
        self._portion.append((self._recorder.sample, (topic, time_ns, values, seen_ns)))
        self._values += len(values)

    def sync(self, now_ns: int) -> None:
        """Hand over what was logged since the last time, then sync as `Recorder.sync`."""
        if self._full and self._thread.load < 0.5:
            self._full = False
        self._portion.append((self._recorder.sync, (now_ns,)))
        self._hand_over()

    def close(self, seconds: float) -> bool:
        """Write what waits and close the file; False if that takes longer than `seconds`: the rest is lost then."""
        self._hand_over()
        self._thread.call(self._recorder.close, weight=0)
        return self._thread.close(seconds)

    def _hand_over(self) -> None:
        portion, frames, weight = self._portion, self._frames, self._frames + self._values
        self._portion, self._frames, self._values = [], 0, 0
        # A mere sync has a weight, too: else they would pile up behind a disk that does not answer.
        if not self._thread.call(_call_all, portion, weight=max(weight, 1)) and weight:
            self._dropped_frames += frames
            self._full = True


def _call_all(portion: Sequence[tuple[Callable[..., None], tuple[Any, ...]]]) -> None:
    for function, arguments in portion:
        function(*arguments)
