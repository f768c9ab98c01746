"""The benchmark on a real car's trips, which are not part of the project."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from benchmarks.car_trips import VEHICLE, judge, main
from gz_onboard.vehicle import read_vehicle

TRIPS = Path(os.environ.get("GZ_ONBOARD_DATA", "")) / "real" / "ev_bmw_i3_trips"


def test_without_the_trips_it_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["car_trips", str(tmp_path)])
    with pytest.raises(SystemExit, match=r"no TripA\*_2hz.csv.gz there; docs/results/real-car.md says"):
        main()


def test_its_vehicle_file_is_read():
    vehicle = read_vehicle(VEHICLE)
    assert vehicle.pack.window.given
    assert not vehicle.mapping.dbc_files


@pytest.mark.skipif("GZ_ONBOARD_DATA" not in os.environ, reason="needs the trips, in $GZ_ONBOARD_DATA")
def test_a_trip_that_was_held_out():
    trip = judge(TRIPS / "TripA14_2hz.csv.gz", VEHICLE)
    assert trip.soc_rms < 0.02
    assert trip.distrusted == ()
    assert trip.low < 1 < trip.high
