"""What a check says: that a signal looks right, looks wrong, or that the ride cannot tell."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated


class Looks(StrEnum):
    """The verdict of a check."""

    RIGHT = "looks right"
    WRONG = "looks wrong"
    UNKNOWN = "cannot tell"


@dataclass(frozen=True)
class Finding:
    """What one check says of one or more roles."""

    check: Annotated[str, "what was compared"]
    looks: Annotated[Looks, "looks right, looks wrong, or cannot tell"]
    roles: Annotated[tuple[str, ...], "that it is about"]
    text: Annotated[str, "what was seen, in words"]


def right(check: str, roles: tuple[str, ...], text: str) -> Finding:
    """Nothing is wrong with it."""
    return Finding(check, Looks.RIGHT, roles, text)


def wrong(check: str, roles: tuple[str, ...], text: str) -> Finding:
    """A suspicion."""
    return Finding(check, Looks.WRONG, roles, text)


def unknown(check: str, roles: tuple[str, ...], text: str) -> Finding:
    """The ride does not show it."""
    return Finding(check, Looks.UNKNOWN, roles, text)
