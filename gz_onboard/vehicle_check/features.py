"""What each feature needs of a vehicle's roles, and what is missing for it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Annotated

from gz_onboard.estimator.signals import POSITION
from gz_onboard.events import SPEEDS, words

SPEED = tuple(role for role in SPEEDS if role != "gps_speed")
NEEDS: dict[str, tuple[tuple[tuple[str, ...], ...], tuple[tuple[str, ...], ...]]] = {
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
    """A feature and what it lacks; of each group in `missing` and `better` one role would do."""

    name: Annotated[str, "what the vehicle is to have"]
    works: Annotated[bool, "whether what it needs is there"]
    missing: Annotated[list[list[str]], "what it needs and is not there: one of each"]
    better: Annotated[list[list[str]], "what would make it better, likewise"]


def features_of(roles: Collection[str]) -> list[Feature]:
    """Every feature, for a vehicle with these `roles`."""
    found = []
    for name, (needed, wanted) in NEEDS.items():
        missing = [list(group) for group in needed if not set(group) & set(roles)]
        better = [list(group) for group in wanted if not set(group) & set(roles) and list(group) not in missing]
        found.append(Feature(name, not missing, missing, better))
    return found


def feature_text(feature: Feature) -> str:
    """In words."""

    def one_of(groups: list[list[str]]) -> str:
        return "; ".join(" or ".join(words(role) for role in group) for group in groups)

    if not feature.works:
        return f"no: lacks {one_of(feature.missing)}"
    return f"yes; better with {one_of(feature.better)}" if feature.better else "yes"


def features_text(features: Sequence[Feature]) -> str:
    """What works and what lacks what, for a terminal."""
    return "\n".join(["features:", *(f"  {feature.name:24} {feature_text(feature)}" for feature in features)])
