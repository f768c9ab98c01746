"""Whether rides contradict the vehicle file: a parameter far from what was known stops a calibration."""

from __future__ import annotations

from math import hypot

from gz_onboard.calibration.result import Result
from gz_onboard.priors import FAR, overrun, stop_at
from gz_onboard.vehicle import Vehicle


def check_against_file(result: Result, vehicle: Vehicle) -> None:
    """InputError if a ride led a parameter beyond `FAR` joint standard deviations from that of `vehicle`.

    It names the signals that it comes from, as `Found.channel` has them; what a bench measured is not judged.
    """
    rows = []
    for name, found in result.parameters.items():
        known = vehicle.parameters.known.get(name)
        if not found.channel or known is None:
            continue
        far = abs(found.value - known.value) / max(hypot(found.sd, known.sd), 1e-300)
        if far > FAR:
            rows.append(overrun(name, known, (found.value, found.sd), far, f"{found.channel} pulls it there"))
    stop_at(rows)
