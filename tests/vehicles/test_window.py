"""A vehicle that uses a part of its cells' charge: what it shows is 0 to 1 within it, and its range ends there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from gz_onboard.errors import InputError
from gz_onboard.pipeline import Pipeline
from gz_onboard.vehicle import Vehicle, read_vehicle
from tests.vehicles.test_scooter_to_van import BUILDS, Build, Truth, drive, write

LOW, HIGH = 0.1, 0.85
WINDOW = f'[battery.window]\nlow = {LOW}\nhigh = {HIGH}\nsd = 0.01\nsource = "its own display"\n[battery.ocv]'
PACKS = {"7 cells": BUILDS["kick-scooter"], "200 cells": replace(BUILDS["van"], series=200)}


def vehicle_of(folder: Path, build: Build, window: str = WINDOW) -> Vehicle:
    file = write(folder, build)
    file.write_text(file.read_text(encoding="utf-8").replace("[battery.ocv]", window), encoding="utf-8")
    return read_vehicle(str(file))


@pytest.mark.parametrize("pack", PACKS)
def test_what_is_shown_and_the_range_end_where_the_window_ends(pack, tmp_path):
    build = PACKS[pack]
    vehicle, whole = vehicle_of(tmp_path, build), vehicle_of(tmp_path, build, "[battery.ocv]")
    pipelines = [Pipeline(v) for v in (vehicle, whole)]
    truth = Truth(0.5)
    for frames in drive(build, vehicle.mapping.database, truth, 60.0):
        for pipeline in pipelines:
            pipeline.advance(frames, frames[0][0])
    within, beyond = (pipeline.last for pipeline in pipelines)
    assert within and beyond and within.soc and beyond.soc and within.soc_sd and beyond.soc_sd
    assert within.soc == pytest.approx((truth.soc - LOW) / (HIGH - LOW), abs=0.03)
    assert within.soc_sd > beyond.soc_sd / (HIGH - LOW)
    assert within.energy_left and beyond.energy_left and within.range and beyond.range
    assert within.energy_left == pytest.approx(build.energy(truth.soc) - build.energy(LOW), rel=0.2)  # less the loss
    assert within.range < 0.99 * beyond.range


@pytest.mark.parametrize("pack", PACKS)
def test_below_the_window_there_is_no_range(pack, tmp_path):
    vehicle = vehicle_of(tmp_path, PACKS[pack])
    pipeline = Pipeline(vehicle)
    for frames in drive(PACKS[pack], vehicle.mapping.database, Truth(0.09), 30.0):
        pipeline.advance(frames, frames[0][0])
    assert pipeline.last
    assert pipeline.last.soc == pipeline.last.range == 0.0


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("low = 0.6\nhigh = 0.85", "low: 0.6 is outside 0 to 0.5"),
        ("low = 0.1\nhigh = 85", "high: 85 is outside 0.5 to 1"),
        ("low = 0.1\nhigh = 0.85\nmiddle = 0.5", "unknown key"),
        ("low = 0.1", "high: is missing"),
        ("low = 0.5\nhigh = 0.5", "high: must be 0.1 or more above low, is 0.5 over 0.5"),
    ],
)
def test_a_window_that_is_none_is_refused(wrong, message, tmp_path):
    with pytest.raises(InputError, match=message):
        vehicle_of(tmp_path, PACKS["7 cells"], f"[battery.window]\n{wrong}\n[battery.ocv]")
