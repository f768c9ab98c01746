"""Findings of a check, and the features that a vehicle's roles are enough for."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import Annotated

from gz_onboard.estimator.signals import POSITION
from gz_onboard.events import SPEEDS, words

Roles = tuple[str, ...]


class Looks(StrEnum):
    """The verdict of a check."""

    RIGHT = "looks right"
    WRONG = "looks wrong"
    UNKNOWN = "cannot tell"


@dataclass(frozen=True)
class Finding:
    """The result of one check, about one or more roles."""

    looks: Annotated[Looks, "looks right, looks wrong, or cannot tell"]
    check: Annotated[str, "what was compared"]
    roles: Annotated[Roles, "that it is about"]
    text: Annotated[str, "what was seen, in words"]


right, wrong, unknown = (partial(Finding, looks) for looks in Looks)


def accused(findings: Iterable[Finding]) -> set[str]:
    """Return the roles that look wrong."""
    return {role for one in findings if one.looks is Looks.WRONG for role in one.roles}


# --- features ---------------------------------------------------------------------------------------------------------

SPEED = tuple(role for role in SPEEDS if role != "gps_speed")
NEEDS: dict[str, tuple[tuple[Roles, ...], tuple[Roles, ...]]] = {
    "range": ((("pack_voltage", "inverter_voltage"), SPEEDS), (("pack_current", "inverter_current"),)),
    "temperature in the range": ((("cell_temperature",),), (("ambient_temperature",),)),
    "hills behind": ((("accel_x", "gps_altitude"),), (("accel_x",), ("gps_altitude",), ("rate_x",), ("rate_z",))),
    "route ahead": ((("latitude",), ("longitude",)), (("gps_fix",),)),
    "wind by heading": ((("gps_course",),), (("rate_z",),)),
    "ageing": ((("pack_voltage",), ("pack_current",)), (("cell_temperature",), ("inverter_current",))),
    "weakest group of cells": ((("lowest_cell_voltage",), ("pack_voltage",), ("pack_current",)), ()),
    "restart after a break": ((("odometer", "bms_state_of_charge"),), (("odometer",), ("bms_state_of_charge",))),
    "charging": ((("charge_plug",),), (("pack_current",),)),
    "parked or riding": ((("key", "contactor"),), ()),
    "riders told apart": ((("rider",),), ()),
    "sensors checked": (
        (("inverter_voltage", "inverter_current", *SPEEDS[1:]),),
        (("inverter_voltage",), ("inverter_current",), ("gps_speed", "wheel_speed_front"), ("accel_x",)),
    ),
    "discovery": (
        (SPEED, ("motor_current", "motor_torque", "pack_current"), ("pack_voltage",)),
        (("motor_current",), ("inverter_current",), ("accel_x",), POSITION),
    ),
}
"""By feature: what it needs, and what makes it better; of each group one role."""


@dataclass(frozen=True)
class Feature:
    """A feature and its missing roles; of each group in `missing` and `better` one role would do."""

    name: Annotated[str, "name of the feature"]
    works: Annotated[bool, "whether what it needs is there"]
    missing: Annotated[list[list[str]], "what it needs and is not there: one of each"]
    better: Annotated[list[list[str]], "what would make it better, likewise"]


def features_of(roles: Collection[str]) -> list[Feature]:
    """Return every feature, for a vehicle with these `roles`."""
    found = []
    for name, (needed, wanted) in NEEDS.items():
        missing = [list(group) for group in needed if not set(group) & set(roles)]
        better = [list(group) for group in wanted if not set(group) & set(roles) and list(group) not in missing]
        found.append(Feature(name, not missing, missing, better))
    return found


def features_text(features: Sequence[Feature]) -> str:
    """List the features and their missing roles, for a terminal."""

    def one_of(groups: list[list[str]]) -> str:
        return "; ".join(" or ".join(words(role) for role in group) for group in groups)

    lines = ["features:"]
    for feature in features:
        better = f"; better with {one_of(feature.better)}" if feature.better else ""
        text = f"yes{better}" if feature.works else f"no: lacks {one_of(feature.missing)}"
        lines.append(f"  {feature.name:24} {text}")
    return "\n".join(lines)
