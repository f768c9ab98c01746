"""The beginning of a recorded ride, in any format."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gz_onboard.export.logs import write_frames_as
from gz_onboard.recording.logs import read_frames
from tests.support import LOGS

ENOUGH = 4000  # frames, of some seconds


def short_log(file: Path, frames: int = ENOUGH) -> Path:
    """Write about so many frames of a coast-down into `file`, in the format of its name."""
    begin: list[list[Any]] = []
    for batch in read_frames(LOGS / "coastdown.blf"):
        begin.append(batch)
        if sum(map(len, begin)) >= frames:
            break
    write_frames_as(file, file.suffix, iter(begin))
    return file
