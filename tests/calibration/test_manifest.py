"""The manifest of a calibration."""

from __future__ import annotations

from pathlib import Path

import pytest

from gz_onboard.calibration.manifest import Option, Slot, Step, read_manifest
from gz_onboard.calibration.table import Named
from gz_onboard.errors import InputError
from gz_onboard.vehicle import OWN

SLOTS = {
    "one": {"data": Slot("table", "a table", 1, 1), "held_out": Slot("table", "another")},
    "two": {"data": Slot("ride", "rides", 2)},
}
OPTIONS: dict[str, dict[str, Option]] = {"two": {"limit": 3.0, "method": "a", "airflow": {}}}
GOOD = """schema = 1
[two]
data = ["b.blf", "c.blf"]
limit = 4
method = "b"
[one]
data = "a.csv"
columns = { time = "t_s", current = { column = "i_A", scale = -1 } }
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("a.csv", "b.blf", "c.blf", "scooter.toml"):
        (tmp_path / name).write_text("")
    return tmp_path


def read(folder: Path, text: str) -> tuple[Path, list[Step]]:
    (folder / "calibration.toml").write_text(text)
    return read_manifest(folder, SLOTS, OPTIONS)


def test_steps_come_in_the_order_of_the_procedures(folder):
    vehicle, steps = read(folder, GOOD)
    assert vehicle == OWN / "reference.toml"
    assert steps == [
        Step(
            "one",
            {"data": (folder / "a.csv",)},
            {"data": {"time": Named("t_s"), "current": Named("i_A", None, -1.0)}},
            {},
        ),
        Step("two", {"data": (folder / "b.blf", folder / "c.blf")}, {}, {"limit": 4.0, "method": "b"}),
    ]
    assert read_manifest(folder / "calibration.toml", SLOTS, OPTIONS)[1] == steps
    assert read(folder, 'vehicle = "scooter.toml"\n' + GOOD)[0] == folder / "scooter.toml"


def test_the_airflow_is_stated_by_file(folder):
    text = GOOD.replace("limit = 4", 'airflow = { "b.blf" = "none", "c.blf" = 3 }')
    assert read(folder, text)[1][1].options["airflow"] == {"b.blf": "none", "c.blf": 3.0}


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("[one]", "[onne]", r"calibration.toml:6: onne: unknown key \(did you mean 'one'\?\)"),
        ('data = "a.csv"', 'dta = "a.csv"', r"calibration.toml:7: one.dta: unknown key \(did you mean 'data'\?\)"),
        ("a.csv", "aa.csv", r"calibration.toml:7: one.data: no file .*aa.csv \(did you mean 'a.csv'\?\)"),
        ('"c.blf"', '"b.blf"', r"calibration.toml:3: two.data: names b.blf twice"),
        (
            'data = "a.csv"',
            'data = "a.csv"\nheld_out = ["./a.csv"]',
            r"calibration.toml:8: one.held_out: names a.csv, which is in data too: what was fitted is not held out",
        ),
        (', "c.blf"', "", r"calibration.toml:3: two.data: two needs rides \(data: 2 or more\), has 1"),
        ('"a.csv"', '["a.csv", "b.blf"]', r"one.data: one takes 1 for data \(a table\), has 2"),
        ('"a.csv"', "3", "must be the name of a file, or a list of them"),
        ('data = "a.csv"\n', "", r"calibration.toml:6: one: one needs a table"),
        ("limit = 4", 'limit = "x"', r"calibration.toml:4: two.limit: must be a number"),
        ("limit = 4", 'airflow = { "b.blf" = "fan" }', r"two.airflow.b.blf: 'fan' is not one of none, wheel"),
        ("limit = 4", 'airflow = { "b.blf" = 400 }', r"two.airflow.b.blf: 400 is outside 0 to 100"),
        ("limit = 4", 'airflow = { "d.blf" = "none" }', r"calibration.toml:4: two.airflow.d.blf: unknown key"),
        ("schema = 1", "schema = 2", "calibration.toml:1: schema: is 2.0|calibration.toml:1: schema: is 2"),
        (
            "schema = 1",
            'schema = 1\nvehicle = "none.toml"',
            "calibration.toml:2: vehicle: .*none.toml: no such vehicle",
        ),
        (GOOD, "schema = 1\n", "names no procedure; there are one, two"),
        (GOOD, "schema = \n", "not valid TOML"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(folder, before, after, message):
    with pytest.raises(InputError, match=message):
        read(folder, GOOD.replace(before, after))


def test_a_folder_without_manifest(tmp_path):
    with pytest.raises(InputError, match=r"takes a folder with a manifest calibration.toml"):
        read_manifest(tmp_path, SLOTS, OPTIONS)
