"""What a vehicle never had is its property and widens the interval; what it has and loses degrades the estimate."""

from __future__ import annotations

import re
from math import log
from pathlib import Path

from gz_onboard.estimator.estimator import LOSS_SD
from gz_onboard.events import Estimate, Reason, State
from gz_onboard.pipeline import lacking
from gz_onboard.recording.decode import feed
from gz_onboard.recording.frames import FrameColumns
from gz_onboard.vehicle import OWN, Vehicle, read_vehicle
from tests.support import Run, Scooter, reference

NEVER_HAD = r"rate_\w|accel_\w|gps_\w+|latitude|longitude|ambient_temperature"


def without(folder: Path, roles: str) -> Vehicle:
    """The reference scooter with none of the `roles`."""
    text = (OWN / "reference.toml").read_text(encoding="utf-8")
    (folder / "plain.toml").write_text(re.sub(rf"(?m)^({roles}) = .*\n", "", text), encoding="utf-8")
    return read_vehicle(folder / "plain.toml")


def last(vehicle: Vehicle) -> Estimate:
    run = Run(vehicle)
    feed(run.pipeline, FrameColumns.of(Scooter().steady(60.0, current=20.0)))
    return run.estimates[-1]


def spread(e: Estimate) -> float:
    """Relative standard deviation of the range."""
    assert e.range_p10 and e.range_p90
    return log(e.range_p90 / e.range_p10) / 2 / 1.2815


def test_what_it_never_had_is_no_degradation_and_widens_the_interval(tmp_path):
    vehicle = without(tmp_path, NEVER_HAD)
    assert lacking(vehicle) == ["NO_IMU", "NO_GPS", "NO_AMBIENT_TEMPERATURE"]
    assert lacking(reference()) == []
    plain, full = last(vehicle), last(reference())
    assert plain.state is full.state is State.VALID
    assert not plain.reasons & (Reason.NO_IMU | Reason.NO_GPS | Reason.NO_AMBIENT_TEMPERATURE)
    lost = sum(LOSS_SD[reason] ** 2 for reason in (Reason.NO_IMU, Reason.NO_GPS, Reason.NO_AMBIENT_TEMPERATURE))
    assert spread(plain) ** 2 > spread(full) ** 2 + 0.9 * lost


def test_of_a_sensor_that_it_has_in_part_the_rest_is_watched(tmp_path):
    """A car has no roll rate; it still tells when its accelerometer falls silent."""
    vehicle = without(tmp_path, "rate_x")
    assert lacking(vehicle) == ["NO_IMU"]
    run = Run(vehicle)
    silent = [
        f
        for f in Scooter().steady(30.0, current=20.0)
        if vehicle.mapping.database.get_message_by_frame_id(f[1]).name != "IMU_Acceleration"
    ]
    feed(run.pipeline, FrameColumns.of(silent))
    assert run.estimates[-1].reasons & Reason.NO_IMU
    assert run.estimates[-1].state is State.DEGRADED
