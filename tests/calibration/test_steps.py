"""Steps of a calibration: the manifest that names their files, and rides that contradict the vehicle file."""

from __future__ import annotations

from pathlib import Path

import pytest

from gz_onboard.calibration.result import Found, Result
from gz_onboard.calibration.sensors import auxiliary_power, cable_resistance, offsets, wheel_radius
from gz_onboard.calibration.steps import Step, check_against_file, read_manifest, requested
from gz_onboard.calibration.table import Named
from gz_onboard.errors import InputError
from gz_onboard.vehicle import OWN

from .rides import VEHICLE, gps_ride, ride

GOOD = """schema = 1
[cooling]
data = ["b.blf", "c.blf"]
airflow = { "b.blf" = "none", "c.blf" = 3 }
[losses]
data = "a.csv"
columns = { time = "t_s", current = { column = "i_A", scale = -1 } }
largest_current = 60
[coastdown]
data = ["b.blf", "c.blf"]
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("a.csv", "b.blf", "c.blf", "scooter.toml"):
        (tmp_path / name).write_text("")
    return tmp_path


def read(folder: Path, text: str) -> tuple[Path, list[Step]]:
    (folder / "calibration.toml").write_text(text)
    return read_manifest([folder])


def test_steps_come_in_the_order_of_the_procedures(folder):
    vehicle, steps = read(folder, GOOD)
    assert vehicle == OWN / "reference.toml"
    columns: dict[str, Named] = {"time": Named("t_s"), "current": Named("i_A", None, -1.0)}
    rides: dict[str, tuple[Path, ...]] = {"data": (folder / "b.blf", folder / "c.blf")}
    assert steps == [
        Step("losses", {"data": (folder / "a.csv",)}, {"data": columns}, {"largest_current": 60.0}),
        Step("cooling", rides, {}, {"airflow": {"b.blf": "none", "c.blf": 3.0}}),
        Step("coastdown", rides),
    ]
    assert read_manifest([folder / "calibration.toml"])[1] == steps
    assert read(folder, 'vehicle = "scooter.toml"\n' + GOOD)[0] == folder / "scooter.toml"


@pytest.mark.parametrize(("said", "meant"), [("none", "none"), ("6", 6.0)])
def test_one_airflow_for_all_runs_can_be_said_on_the_command_line_too(folder, said, meant):
    _, (step,) = requested("cooling", {"data": [folder / "b.blf"]}, [f"airflow={said}"], None)
    assert step.options == {"airflow": meant}
    quoted = f'"{said}"' if isinstance(meant, str) else said
    assert read(folder, f'schema = 1\n[cooling]\ndata = "b.blf"\nairflow = {quoted}\n')[1][0].options == step.options


def test_all_takes_its_data_from_the_manifest_alone(folder):
    with pytest.raises(InputError, match="all takes its data and options from the manifest"):
        requested("all", {"data": [folder], "held_out": [folder / "b.blf"]}, [], None)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("[losses]", "[loses]", r"calibration.toml:5: loses: unknown key \(did you mean 'losses'\?\)"),
        ('data = "a.csv"', 'dta = "a.csv"', r"calibration.toml:6: losses.dta: unknown key \(did you mean 'data'\?\)"),
        ("a.csv", "aa.csv", r"calibration.toml:6: losses.data: no file .*aa.csv \(did you mean 'a.csv'\?\)"),
        ('"b.blf", "c.blf"', '"b.blf", "b.blf"', r"calibration.toml:3: cooling.data: names b.blf twice"),
        (
            "airflow",
            'held_out = "./b.blf"\nairflow',
            r"cooling.held_out: names b.blf, .* cannot be both fitted and held out",
        ),
        ('[coastdown]\ndata = ["b.blf", ', "[coastdown]\ndata = [", r"coastdown needs .*2 or more\), has 1"),
        ('"a.csv"', '["a.csv", "b.blf"]', r"losses.data: losses takes 1 for data \(steady points.*\), has 2"),
        ('"a.csv"', "3", "must be the name of a file, or a list of them"),
        ('data = "a.csv"\n', "", r"calibration.toml:5: losses: losses needs steady points"),
        ("= 60", '= "x"', r"calibration.toml:8: losses.largest_current: must be a number from 1e-06 to 1e"),
        ("= 3 ", '= "fan" ', r"cooling.airflow.c.blf: must be a number .* or one of none, wheel, is 'fan'"),
        ("= 3 ", "= 400 ", r"cooling.airflow.c.blf: must be a number from 0 to 100 .* is 400"),
        ('"c.blf" = 3', '"d.blf" = 3', r"calibration.toml:4: cooling.airflow.d.blf: unknown key"),
        ("schema = 1", "schema = 2", "calibration.toml:1: schema: is 2"),
        ("schema = 1", 'schema = 1\nvehicle = "none.toml"', "toml:2: vehicle: .*none.toml: no such vehicle"),
        (GOOD, "schema = 1\n", "names no procedure; there are wheel, motor"),
        (GOOD, "schema = \n", "not valid TOML"),
    ],
)
def test_what_is_wrong_in_a_manifest_is_named_with_its_line(folder, before, after, message):
    assert before in GOOD
    with pytest.raises(InputError, match=message):
        read(folder, GOOD.replace(before, after))


def test_rides_of_this_vehicle_agree_with_its_file():
    rides = [ride(seed) for seed in range(3)]
    for result in (offsets(rides, VEHICLE), auxiliary_power(rides, VEHICLE), cable_resistance(rides, VEHICLE)):
        check_against_file(result, VEHICLE)


def test_rides_that_contradict_the_file_are_refused_with_both_values_and_the_signals():
    radius = r"wheel_radius is 0\.2438 ± 0\.0005 m \(measured\) by the file and 0\.2999 ± .* m by these rides, \d+ sta"
    with pytest.raises(InputError, match=radius + r".*; gps_speed over motor_speed pulls it there"):
        check_against_file(wheel_radius([gps_ride(0.30, 0, minutes=3)], VEHICLE), VEHICLE)
    gain = r"pack_current_gain is .* pack_current over inverter_current .*pulls it there"
    with pytest.raises(InputError, match=gain):
        check_against_file(offsets([ride(seed, inverter_gain=0.5) for seed in range(3)], VEHICLE), VEHICLE)


def test_unsure_values_and_those_of_a_bench_are_not_judged_against_the_file():
    p = VEHICLE.parameters
    far = p["wheel_radius"] + 5 * p.sd("wheel_radius")
    for found in (Found(far, 5e-3, "m", "unsure", "gps_speed"), Found(far, 1e-5, "m", "bench")):
        check_against_file(Result("wheel", {"wheel_radius": found}), VEHICLE)
