"""Whether a file is the one that it was."""

from __future__ import annotations

import hashlib
from pathlib import Path

from gz_onboard.errors import unreadable


def digest_of(file: Path) -> str:
    """The SHA-256 of what is in a file, hexadecimal. InputError if it cannot be read."""
    try:
        with file.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise unreadable(file, error) from None
