"""Where the pack of a simulated ride is empty before the ride compared with it ends, and what is compared then."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.lab.validate_score import NAMES, PackEmpty
from gz_onboard.model.functions import PiecewiseLinear
from gz_onboard.offline.series import curve_over
from gz_onboard.simulation.run import Run, ran_empty
from gz_onboard.vehicle import Vehicle

Load = tuple[float, float]
"""Mean power [W] and the square of the current's form factor."""


def pack_empty(vehicle: Vehicle, run: Run, load: Load | None) -> PackEmpty | None:
    """Where the pack of `run` was empty, for the `load` that was measured; the run's own if none was.

    A run whose pack is empty creeps: its own mean would take less than the ride that it is compared with.
    """
    row = ran_empty(vehicle, run, *(load or (run.mean_power, run.form_factor_squared)))
    if row is None:
        return None
    time, distance, soc = (float(run.series[name][row]) for name in ("time", "distance", "soc"))
    held = _held_back(vehicle.derating.current_by_soc, run.series["soc"][: row + 1])
    return PackEmpty(time, distance * 1e-3, soc, float(run.series["time"][held]))


def _held_back(share: PiecewiseLinear, soc: Array) -> int:
    """From which index of `soc` on the controller takes current off for want of charge; at most the last.

    Of a ride that begins so, the last: its vehicle was held back as well.
    """
    free = np.flatnonzero(curve_over(share, soc) >= 1.0)
    return min(int(free[-1]) + 1, len(soc) - 1) if len(free) else len(soc) - 1


def empty_text(form: str, end: PackEmpty, seconds: float) -> str:
    """What a simulated pack that is empty before the ride ends means for what is compared; seconds: of the ride."""
    until = "there" if end.compared_s == end.time_s else f"{end.compared_s:.0f} s, where the controller holds back"
    return (
        f"{NAMES[form]}: the simulated pack is empty at {end.time_s:.0f} s of {seconds:.0f}, after "
        f"{end.distance_km:.2f} km, with {100 * end.soc:.1f} % of its charge: energy and conditions are compared until "
        f"{until}, all else over the whole ride"
    )


def until_empty(series: Mapping[str, Array], end: PackEmpty | None) -> dict[str, Array]:
    """The whole seconds of `series` in which what the ride asks was not short of charge."""
    return {name: values[: int(end.compared_s)] if end else values for name, values in series.items()}
