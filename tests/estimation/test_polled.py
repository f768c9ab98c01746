"""A log of what another tool has asked: every command reads the answers in it by the requests of the vehicle file."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from gz_onboard.cli import main
from tests.polled import CHARGE, KONA, polled_ride
from tests.support import write_log

SECONDS = 30


@pytest.fixture(scope="module")
def ride(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("polled") / "ride.log"
    write_log(file, polled_ride(SECONDS))
    return file


def test_estimate(ride, tmp_path, capsys):
    arguments = ["--vehicle", str(KONA), "--no-plot", "--json", "-", "--output", str(tmp_path)]
    assert main(["estimate", *arguments, str(ride)]) == 0
    (told,) = json.loads(capsys.readouterr().out)["rides"]
    assert told["dropped"] == 0
    assert told["unknown"] == 0
    assert told["distance_km"] == pytest.approx(13.0 * SECONDS / 1000, rel=0.05)  # 3000 rpm
    assert told["range_end_km"] > 100


def test_signals_as_a_table(ride, tmp_path, capsys):
    out = tmp_path / "tables"
    assert main(["export", str(ride), str(out), "--vehicle", str(KONA), "--table-format", "csv"]) == 0
    assert "0 frames are in no DBC file, 0 do not fit theirs" in capsys.readouterr().out
    rows = list(csv.DictReader((out / "Battery.csv").open()))
    assert len(rows) == 5 * SECONDS
    assert {row["BatteryVoltage[V]"] for row in rows} == {"365.0"}
    shown = list(csv.DictReader((out / "BatteryShown.csv").open()))
    assert {float(row["BatteryCharge[%]"]) for row in shown} == {CHARGE}


def test_the_check_says_what_length_an_answer_has(ride, tmp_path, capsys):
    assert main(["vehicle", "check", str(KONA), str(ride), "--quick"]) == 0
    assert "pack_voltage          5 Hz, 365 to 365 V: looks right" in capsys.readouterr().out
    wrong = tmp_path / "kona.toml"
    wrong.write_text(KONA.read_text(encoding="utf-8").replace("length = 59", "length = 61"), encoding="utf-8")
    assert main(["vehicle", "check", str(wrong), str(ride), "--quick"]) == 1
    out = capsys.readouterr().out
    assert "pack_voltage          never came (BatteryVoltage)" in out
    assert "Battery has 59 bytes, the file says 61" in out
