"""The saved state of the estimator: which vehicle and version it is of, and the fields of all parts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gz_onboard.errors import shown
from gz_onboard.estimator import battery_pack, forecast, pack_age, weakest
from gz_onboard.estimator.motion import MOTION
from gz_onboard.estimator.saved_fields import Each, Number, check

VERSION = 7
"""Raised with every change of a field; a state of another version is not read."""

FIELDS: Mapping[str, Any] = {
    **battery_pack.FIELDS,
    "cell_temperature": Number(-50.0, 120.0, optional=True),  # degC
    "gyro_bias": Each(Number(-MOTION.max_gyro_bias, MOTION.max_gyro_bias), 2),  # rad/s, of roll and yaw rate
    "riding": forecast.FIELDS,
    "learned": {**pack_age.FIELDS, "weakest": weakest.FIELDS},
}


def check_snapshot(saved: Mapping[str, Any], key: str) -> None:
    """Compare a snapshot with `FIELDS`. ValueError if it is damaged, of another version or vehicle (`Vehicle.key`)."""
    check_vehicle(saved, key)
    check(FIELDS, {name: value for name, value in saved.items() if name not in ("version", "key")})


def check_vehicle(saved: object, key: str) -> None:
    """ValueError for a snapshot of another version, or of another vehicle than that of `key` (`Vehicle.key`)."""
    version = saved.get("version") if isinstance(saved, Mapping) else saved
    if version != VERSION or not isinstance(saved, Mapping):
        raise ValueError(f"is of version {shown(version)}, not {VERSION}")
    if saved.get("key") != key:
        theirs, ours = str(saved.get("key")).split("|"), key.split("|")
        differs = [
            f"{shown([part for part in these if part not in others])} {whose}"
            for these, others, whose in ((theirs, ours, "saved"), (ours, theirs, "in this vehicle file"))
        ]
        raise ValueError(f"is of another vehicle, battery or list of effects: {', '.join(differs)}")
