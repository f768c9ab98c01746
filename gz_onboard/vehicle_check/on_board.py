"""What the daemon's own checks of the sensors say of a log: the pipeline over it, and what was left out."""

from __future__ import annotations

from collections.abc import Iterator
from math import sqrt
from pathlib import Path

import numpy as np

from gz_onboard.errors import InputError
from gz_onboard.estimation.ride import RideOptions, open_estimate, run_ride
from gz_onboard.estimation.summary import POOR_FIT_V, summary_of
from gz_onboard.reports.results import clock
from gz_onboard.vehicle import Vehicle
from gz_onboard.vehicle_check.electric import PackRide
from gz_onboard.vehicle_check.finding import Finding, right, unknown, wrong

LEFT_OUT = 0.2  # of the time: a sensor that contradicts the others for as long is no passing fault
INNOVATION = 0.03  # V of a cell: what is more is no good table of a battery
BESIDE = 2.0  # K: so much colder than a table's first row it is still about right
SURE = 2.0  # sd
BY_LOAD = {"accel_x", "gps_altitude"}  # the daemon holds them against the grade by the power that is needed


def on_board(log: Path, vehicle: Vehicle, load: bool = True, of: PackRide | None = None) -> Iterator[Finding]:
    """What the daemon's own checks would leave out for long; load: whether the power needed is the model's.

    of: what the pack gives, if it was measured: a file that knows its cells roughly may miss by as much under load.
    """
    if vehicle.battery is None:
        return
    try:
        ride = open_estimate(log, vehicle)
        summary = summary_of(run_ride(ride, RideOptions()))
    except InputError as error:  # no battery, range frames that do not fit: `run` says it
        yield unknown("on board", (), str(error))
        return
    for role, seconds in summary.distrusted.items():
        if seconds > LEFT_OUT * summary.duration_s:
            text = f"the daemon would leave it out for {clock(seconds)}: it contradicts the others"
            if role in BY_LOAD and not load:
                text = text.replace("it", role, 1)
                yield wrong("on board", (), f"{text}, or the file's mass, drag area or losses are wrong")
            else:
                yield wrong("on board", (role,), text)
    if summary.innovation_rms_v is not None:
        text = f"voltage less its prediction: {1e3 * summary.innovation_rms_v:.0f} mV RMS of a cell"
        if summary.innovation_rms_v < INNOVATION:
            yield right("on board", ("pack_voltage",), f"{text}; the battery's tables are about right")
        elif summary.innovation_rms_v < POOR_FIT_V:
            yield unknown("on board", ("pack_voltage",), f"{text}; wrong tables?")
        elif of and (why := _unsure(of, summary.innovation_rms_v)):
            yield unknown("on board", ("pack_voltage",), f"{text}: {why}, or the cells' number or capacity")
        else:
            yield wrong("on board", ("pack_voltage",), f"{text}: the cells' number or capacity, or the tables")


def _unsure(of: PackRide, missed: float) -> str:
    """What of the file's own doubt explains that a cell's voltage is `missed` by so much [V]; empty if nothing does."""
    battery = of.battery
    coldest = min(battery.r0.temperature)
    if of.temperature < coldest - BESIDE:
        return f"the tables at {of.temperature:.0f} °C, as the file's begin at {coldest:.0f} °C"
    current = np.zeros(1) if of.current is None else of.current[np.isfinite(of.current)]
    load = sqrt(float(np.mean(current**2))) / battery.cells_parallel if len(current) else 0.0
    r0, r1, _ = battery.circuit(0.5, of.temperature)
    doubt = sqrt(battery.ocv_sd**2 + (battery.resistance_sd * (r0 + r1) * load) ** 2)
    if missed > SURE * doubt:
        return ""
    known = f"which the file knows to {1e3 * doubt:.0f} mV under this load"
    return f"the tables at {of.temperature:.0f} °C, {known}"
