"""The saved state of the estimator: one JSON file, written whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def save(file: Path, snapshot: Mapping[str, Any], time: float) -> None:
    """Write `snapshot`, taken at `time` [s since the epoch], so that a power cut leaves the old file or the new one.

    The directory is made if it is not there. OSError if it cannot be written.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    temporary = file.with_suffix(".new")
    with temporary.open("w", encoding="ascii") as stream:
        json.dump({"saved_at": time, "estimator": snapshot}, stream)
        stream.flush()
        os.fsync(stream.fileno())
    temporary.replace(file)
    folder = os.open(file.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def load(file: Path, time: float) -> tuple[Mapping[str, Any], float | None] | None:
    """(snapshot, its age [s] if the clock can be believed); None if there is none. ValueError if it is damaged."""
    try:
        document = json.loads(file.read_text(encoding="ascii"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:  # not there, no text, no JSON, or JSON without end
        raise ValueError(f"cannot be read: {error}") from error
    if not isinstance(document, dict) or "estimator" not in document:
        raise ValueError("is not a saved state")
    saved_at = document.get("saved_at")
    age = time - saved_at if isinstance(saved_at, int | float) and saved_at > 1e9 and time >= saved_at else None
    return document["estimator"], age
