"""Demands of a simulated ride on the battery that none can give: a voltage at the cut-off, or charge below none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gz_onboard.arrays import Array

LOADED = 0.1  # state of charge: an end with more left was one of the load


@dataclass(frozen=True)
class Beyond:
    """A pack with its `voltage` at the cut-off or below, or with no charge left; the state where it begins."""

    charge: bool  # no charge is left; else the load pulled the voltage down
    duration: float  # s, in all
    cutoff: float  # V of the pack
    time: float  # s
    distance: float  # m
    soc: float
    current: float  # A
    voltage: float  # V


def beyond_pack(series: Mapping[str, Array], cutoff: float) -> tuple[Beyond, ...]:
    """Where a load pulled the pack's voltage to `cutoff` [V] or below, and from where on it had no charge left.

    series: columns of `run.COLUMNS`.
    """
    time = series["time"]
    step = float(time[1] - time[0]) if len(time) > 1 else 0.0
    out = np.maximum.accumulate(series["soc"] <= 0.0)
    low = (series["pack_voltage"] <= cutoff) & ~out
    found = []
    for charge, there in ((False, low), (True, out)):
        if there.any():
            i = int(np.argmax(there))
            at = {name: float(series[name][i]) for name in ("time", "distance", "soc")}
            current, voltage = float(series["pack_current"][i]), float(series["pack_voltage"][i])
            seconds = float(there.sum()) * step
            found.append(Beyond(charge, seconds, cutoff, **at, current=current, voltage=voltage))
    return tuple(found)
