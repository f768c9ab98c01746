"""Whose code runs: an effect of a vehicle file's own is Python, so nobody else may be able to change it."""

from __future__ import annotations

import os
import stat
from collections.abc import Collection
from pathlib import Path

ROOT = 0


def trusted_users() -> frozenset[int]:
    """Whose files may be run as code: root's, and those of the user who runs us."""
    return frozenset((ROOT, os.geteuid()))


def changeable(file: Path, users: Collection[int]) -> str | None:
    """What lets others than `users` (their ids) change `file` or put another in its place; None if nothing does.

    Looked at are the file, wherever links lead, and every folder above it, as sshd does. OSError if there is none.
    """
    place = file.resolve(strict=True)
    for part in (place, *place.parents):
        status = part.stat()
        if status.st_uid not in users:
            return f"{part} belongs to {_user(status.st_uid)}"
        if _shared(status) and not (part != place and status.st_mode & stat.S_ISVTX):  # in /tmp each has but his own
            return f"{part} can be written by others (chmod go-w)"
    return None


def _shared(status: os.stat_result) -> bool:
    """Whether others than its owner may write it; the owner's own group, as Debian gives each user, is no other."""
    if status.st_mode & stat.S_IWOTH:
        return True
    return bool(status.st_mode & stat.S_IWGRP) and not _own_group(status.st_uid, status.st_gid)


def _own_group(user: int, group: int) -> bool:
    import grp
    import pwd

    try:
        entry = grp.getgrgid(group)
        return entry.gr_name == pwd.getpwuid(user).pw_name and not entry.gr_mem
    except KeyError:
        return False


def _user(number: int) -> str:
    import pwd

    try:
        return f"the user {pwd.getpwuid(number).pw_name}"
    except KeyError:
        return f"user {number}"
