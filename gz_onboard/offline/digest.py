"""Whether a file is the one that it was, or the same as another."""

from __future__ import annotations

import hashlib
import logging
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from gz_onboard.errors import unreadable
from gz_onboard.recording.logs import logs_among

_LOG = logging.getLogger(__name__)


def digest_of(file: Path) -> str:
    """The SHA-256 of what is in a file, hexadecimal. InputError if it cannot be read."""
    try:
        with file.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise unreadable(file, error) from None


def distinct_logs(paths: Iterable[Path]) -> list[Path]:
    """The logs of `logs_among`, each once, by what is in it; a warning tells of each that is there again."""
    logs = logs_among(paths)
    sizes = Counter(log.stat().st_size for log in dict.fromkeys(logs) if log.is_file())
    first: dict[object, Path] = {}
    for log in logs:
        again = log.is_file() and sizes[log.stat().st_size] > 1
        which = digest_of(log) if again else log
        if (kept := first.get(which)) is None:
            first[which] = log
        else:
            said = "is given twice" if kept == log else f"is the same log as {kept}"
            _LOG.warning("%s: %s; it counts once", log, said)
    return list(first.values())
