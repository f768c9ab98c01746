"""The benchmark on a real car's trips, which are not part of the project."""

from __future__ import annotations

import sys

import pytest

from benchmarks.car_trips import VEHICLE, main
from gz_onboard.vehicle import read_vehicle


def test_without_the_trips_it_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["car_trips", str(tmp_path)])
    with pytest.raises(SystemExit, match=r"no TripA\*_2hz.csv.gz there; docs/results/real-car.md says"):
        main()


def test_its_vehicle_file_is_read():
    vehicle = read_vehicle(VEHICLE)
    assert vehicle.pack.window.given
    assert not vehicle.mapping.dbc_files
