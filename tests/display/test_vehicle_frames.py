"""What the page shows of the vehicle's own frames: the cells' temperature, and the day's distance by the odometer."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import pytest

from gz_onboard import cli
from gz_onboard.can.codec import CONFIRM
from gz_onboard.can.publisher import Publisher
from gz_onboard.display.command import view_of
from gz_onboard.display.vehicle_frames import RIDING_DEGC, VehicleFrames, cell_limits
from gz_onboard.display.view import Picture, View
from gz_onboard.estimator.signals import TIMING
from gz_onboard.events import Estimate
from gz_onboard.model.functions import PiecewiseLinear
from gz_onboard.model.tables import Derating
from gz_onboard.vehicle import read_vehicle
from tests.display.served import PACK, Own, cells, odometer, own_frame, second
from tests.display.test_picture import BUS, HEALTHY

REFERENCE = read_vehicle("reference")
DAY = 86_400 * 10**9
NOON = 1_750_000_000 * 10**9 // DAY * DAY + DAY // 2


def of(estimate: Estimate, *own: Own, after: float = 0.0) -> Picture:
    view = View(vehicle=VehicleFrames(REFERENCE))
    for frame in [*second(Publisher(), estimate), *(own_frame(*one) for one in (PACK, *own))]:
        view.take(frame, 100.0)
    return view.picture(100.0 + after, *BUS)


def test_cells_and_distance_are_those_of_the_frames():
    got = of(HEALTHY, odometer(1000.0), cells(21, 24, 27), odometer(1001.4))
    assert got["cells"] == {"coldest_degc": 21.0, "hottest_degc": 27.0}
    assert (got["odometer_km"], got["ridden_today_km"]) == (1001.4, 1.4)
    assert got["alerts"] == []


def test_on_another_vehicles_bus_nothing_is_taken_for_its_own():
    """Its frames may have the same identifiers; a checksum of the reference scooter's they have not."""
    frames = VehicleFrames(REFERENCE)
    wrong = (0, own_frame(*PACK)[1], bytes(8), 0)
    for frame in own_frame(*cells(21, 24, 155)), own_frame(*odometer(1000.0)), wrong, own_frame(*cells(21, 24, 155)):
        frames.take(frame, 1.0)
    assert frames.values(1.0)["cells"] is None
    assert frames.values(1.0)["odometer_km"] is None
    for own in PACK, cells(21, 24, 27):
        frames.take(own_frame(*own), 1.0)
    assert frames.values(1.0)["cells"] == {"coldest_degc": 21.0, "hottest_degc": 27.0}


def test_a_sensor_that_the_estimator_does_not_trust_is_not_shown():
    distrusted = replace(HEALTHY, distrusted=("cell_temperature", "odometer"))
    got = of(distrusted, odometer(1000.0), cells(21, 24, 55))
    assert (got["cells"], got["odometer_km"], got["ridden_today_km"]) == (None, None, None)
    assert "cell_too_hot" not in got["alerts"]


def test_limits_are_those_of_the_controller():
    assert cell_limits(REFERENCE.derating) == (-5.0, 50.0)
    assert cell_limits(Derating()) == RIDING_DEGC
    hot = PiecewiseLinear((0.0, 55.0, 60.0), (1.0, 1.0, 0.0))
    assert cell_limits(Derating(current_by_cell_temperature=hot)) == (RIDING_DEGC[0], 55.0)
    never = PiecewiseLinear((0.0, 55.0), (0.9, 0.5))
    assert cell_limits(Derating(current_by_cell_temperature=never)) == RIDING_DEGC


# --- the day ------------------------------------------------------------------------------------------------------


def ridden(kept: Path | None, *seen: tuple[float, int], lasts: float = TIMING.accepted_after) -> float | None:
    """Of odometers [km] at times [ns], each of which lasts so long [s]."""
    frames, now = VehicleFrames(REFERENCE, kept), 1.0
    frames.take(own_frame(*PACK, seen[0][1]), now)
    for km, stamp in seen:
        for i in range(CONFIRM + 1):  # of a leap in time
            frames.take(own_frame(*odometer(km), stamp + i), now + i / CONFIRM * lasts)
        now += lasts
    found: float | None = frames.values(now)["ridden_today_km"]
    return found


def test_a_day_begins_at_midnight_and_goes_on_over_a_restart(tmp_path):
    file = tmp_path / "day.json"
    assert ridden(file, (1000.0, NOON), (1008.0, NOON + 10**12)) == pytest.approx(8.0)
    assert ridden(file, (1010.0, NOON + 2 * 10**12)) == pytest.approx(10.0)
    assert ridden(file, (1010.0, NOON), (1011.0, NOON + DAY)) == pytest.approx(1.0)  # since the last of yesterday
    assert ridden(file, (1015.0, NOON + DAY)) == pytest.approx(5.0)
    assert ridden(file, (1020.0, NOON + 5 * DAY)) == 0.0
    assert ridden(None, (1020.0, NOON + 5 * DAY)) == 0.0


IMPOSSIBLE = "NaN", "Infinity", "-Infinity", "-5000", "1" + 400 * "0", '"x"'


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        '{"date": 1}',
        "\xff",
        9999 * "[",
        *(f'{{"vehicle": "reference-scooter", "date": "2025-06-15", "odometer_km": {x}}}' for x in IMPOSSIBLE),
    ],
)
def test_a_damaged_file_is_begun_anew(tmp_path, text):
    file = tmp_path / "day.json"
    file.write_text(text, encoding="latin-1")
    assert ridden(file, (1000.0, NOON), (1003.0, NOON)) == pytest.approx(3.0)
    assert json.loads(file.read_text())["odometer_km"] == 1000.0


@pytest.mark.parametrize("wrong", [0.0, 900.0, 1050.0, 4e6])
def test_an_odometer_that_leaps_is_not_shown(wrong):
    """Nor sent to a broker, where a total that begins at 0 would count the whole life as ridden today."""
    frames = VehicleFrames(REFERENCE)
    shown = []
    for i, km in enumerate([0.0] * 3 + [1000.0] * 3 + [wrong] * 60 + [1000.1]):
        for one in PACK, odometer(km):
            frames.take(own_frame(*one, NOON + i * 10**9), float(i))
        shown.append(frames.values(float(i))["odometer_km"])
    assert shown[:3] == [None] * 3
    assert {km for km in shown[3:] if km is not None} == {1000.0, 1000.1}
    assert shown[-2:] == [None, 1000.1]


# --- the command --------------------------------------------------------------------------------------------------

WEB = ["dashboard", "--web", "--interface", "virtual", "--channel", "own", "--listen", "127.0.0.1:0"]


@pytest.mark.parametrize("own_frames", [True, False])
def test_a_vehicle_whose_range_frames_have_identifiers_of_its_own(tmp_path, own_frames):
    """As `vehicle new` writes them: nobody need write a DBC file for the dashboard."""
    file = tmp_path / "v.toml"
    new = ["--kind", "scooter", "--cells", "nmc", "--series", "14", "--capacity", "30", "--mass", "110"]
    assert cli.main(["vehicle", "new", str(file), *new, "--wheel-radius", "0.22"]) == 0
    view = view_of(argparse.Namespace(vehicle=str(file), dbc=None), own_frames=own_frames)
    frames = second(read_vehicle(file).publisher(), HEALTHY)
    assert min(frame[1] for frame in frames) == 0x6A0
    assert {frame[1] for frame in frames} <= set(view.identifiers or [])
    for frame in frames:
        view.take(frame, 100.0)
    assert view.picture(100.0, *BUS)["range"]["km"] == 34.21


@pytest.mark.parametrize(
    ("name", "said"), [(".", ".: is a folder"), ("", ".: is a folder"), ("v.toml", "would overwrite the input")]
)
def test_a_day_that_cannot_be_kept_is_refused_at_the_start(tmp_path, monkeypatch, capsys, name, said):
    monkeypatch.chdir(tmp_path)
    new = ["--kind", "scooter", "--cells", "nmc", "--series", "14", "--capacity", "30", "--mass", "110"]
    assert cli.main(["vehicle", "new", "v.toml", *new, "--wheel-radius", "0.22"]) == 0
    assert cli.main([*WEB, "--duration", "0.1", "--vehicle", "v.toml", "--day", name]) == 2
    assert said in capsys.readouterr().err
