"""``gz-onboard simulate``: what it tells and writes, and what it refuses."""

from __future__ import annotations

import csv
import json

import pyarrow.parquet as pq
import pytest

from gz_onboard.cli import main
from gz_onboard.simulation.run import COLUMNS
from gz_onboard.simulation.summary import KEYS, SUMMARY_VERSION
from gz_onboard.simulation.sweep import read_sweep
from gz_onboard.vehicle import read_vehicle
from tests.support import LOGS

PNG = b"\x89PNG"


def simulate(*arguments):
    return main(["simulate", *map(str, arguments)])


@pytest.fixture
def short(tmp_path):
    file = tmp_path / "short.csv"
    rows = [(0, 0), (1, 0), *((t, min(3.0 * (t - 1), 25.0)) for t in range(2, 40)), (40, 12), (41, 0), (42, 0)]
    file.write_text("time_s,speed_kmh\n" + "".join(f"{t},{v}\n" for t, v in rows))
    return file


def summary(capsys):
    return json.loads(capsys.readouterr().out)


def test_a_recorded_ride_has_the_rider_that_was_noted(capsys):
    ride = [LOGS / "coastdown.blf", "--no-plot", "--no-series"]
    assert simulate(*ride) == 0
    assert "payload 75 kg (by rides.json)" in capsys.readouterr().out
    assert simulate(*ride, "--payload", 60) == 0
    assert "payload 60 kg (by --payload)" in capsys.readouterr().out


def test_a_cycle_by_name(tmp_path, capsys):
    assert simulate("ece15", "--payload", 75, "--output", tmp_path) == 0
    text = capsys.readouterr().out
    for word in ("Wh/km", "ridden, and energy left at the end over the consumption", "aerodynamic drag", "closes to"):
        assert word in text
    for ending in (".png", ".ledger.png"):
        assert (tmp_path / f"ece15.simulation{ending}").read_bytes().startswith(PNG)
    page = (tmp_path / "ece15.simulation.html").read_text()
    assert (page.count("<svg"), page.count("src=")) == (2, 0)  # stands alone
    table = pq.read_table(tmp_path / "ece15.simulation.parquet")
    assert table.column_names == [f"{name}[{unit}]" for name, unit in COLUMNS.items()]
    assert table["distance[m]"][-1].as_py() == pytest.approx(990, rel=0.03)


def test_the_summary_has_its_keys_and_adds_up(short, tmp_path, capsys):
    assert simulate(short, "--json", "--no-plot", "--output", tmp_path) == 0
    found = summary(capsys)
    assert found.pop("version") == SUMMARY_VERSION
    assert set(found) == set(KEYS)
    assert (found["payload_kg"], found["payload_from"]) == (80, "the vehicle file")
    assert sum(found["ledger_wh"].values()) == pytest.approx(found["energy_cells_wh"], rel=1e-3)
    assert found["consumption_wh_km"] == pytest.approx(found["energy_wh"] / found["distance_km"])
    assert found["kind"] == "cycle"
    assert found["files"] == [str(tmp_path / "short.simulation.parquet")]


def test_same_series_in_each_format(short, tmp_path):
    for form in ("csv", "parquet"):
        assert simulate(short, "--format", form, "--no-plot", "--output", tmp_path) == 0
    table = pq.read_table(tmp_path / "short.simulation.parquet").to_pydict()
    with (tmp_path / "short.simulation.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == list(table)
    assert len(rows) == len(table["time[s]"]) == 421
    for i in (0, 100, 420):
        assert float(rows[i]["soc[1]"]) == table["soc[1]"][i]


def test_ridden_until_empty(short, tmp_path, capsys):
    options = ("--json", "--no-plot", "--no-series", "--output", tmp_path, "--soc", 0.12)
    assert simulate(short, "--until-empty", *options) == 0
    ridden = summary(capsys)
    assert ridden["range_by"] == "repetition"
    assert ridden["range_km"] == ridden["distance_km"] <= ridden["range_by_energy_km"]
    assert ridden["repetitions"] > 5
    assert simulate(short, *options) == 0
    assert summary(capsys)["range_km"] == pytest.approx(ridden["range_km"], rel=0.3)


@pytest.mark.parametrize(
    ("option", "more"), [(("--grade", 4), True), (("--payload", 140), True), (("--wind", -4), False)]
)
def test_what_makes_it_harder_takes_more(short, tmp_path, capsys, option, more):
    consumption = []
    for options in ((), option):
        assert simulate(short, *options, "--json", "--no-plot", "--no-series", "--output", tmp_path) == 0
        consumption.append(summary(capsys)["consumption_wh_km"])
    assert (consumption[1] > consumption[0]) is more


def test_a_route(tmp_path, capsys):
    file = tmp_path / "hill.route.csv"
    rows = [f"{20 * i},{100 + 0.6 * i},8.0\n" for i in range(40)]
    file.write_text("distance_m,altitude_m,speed_limit_mps\n" + "".join(rows))
    assert simulate(file, "--json", "--output", tmp_path) == 0
    found = summary(capsys)
    assert found["kind"] == "route"
    assert found["distance_km"] == pytest.approx(0.78, abs=0.01)
    assert found["speed_max_km_h"] < 30.5
    lifted = (105 + 80) * 9.80665 * 0.03 * 780 / 3600
    assert found["ledger_wh"]["potential_energy"] == pytest.approx(lifted, rel=0.03)


def test_sweep_of_one_parameter(short, tmp_path, capsys):
    sweep = ("--sweep", "drag_area=0.3..0.8:3")
    assert simulate(short, *sweep, "--json", "--no-series", "--output", tmp_path) == 0
    found = summary(capsys)
    assert [v["values"]["drag_area"] for v in found["sweep"]] == pytest.approx([0.3, 0.55, 0.8])
    ranges = [v["range_km"] for v in found["sweep"]]
    assert ranges[0] > ranges[1] > ranges[2]
    assert (tmp_path / "short.simulation.sweep.png").read_bytes().startswith(PNG)


@pytest.mark.parametrize("bounds", ["0.4..1.", "0.4 .. 1", ".4..1e0", "4e-1..+1.0", " 0.4..1:5"])
def test_bounds_of_a_sweep_are_numbers_of_any_form(bounds):
    sweep = read_sweep(f"drag_area={bounds}", read_vehicle("reference"))
    assert sweep.values == pytest.approx((0.4, 0.55, 0.7, 0.85, 1.0))


def test_sweep_of_two(short, tmp_path, capsys):
    sweeps = ("--sweep", "battery.parallel=10..12", "--sweep", "payload_mass=60..120:2")
    assert simulate(short, *sweeps, "--format", "svg", "--format", "csv", "--output", tmp_path) == 0
    lines = capsys.readouterr().out.splitlines()
    head = next(i for i, line in enumerate(lines) if "battery.cells_parallel" in line)
    table = [[float(cell) for cell in line.split()] for line in lines[head + 1 :]]
    assert [row[:2] for row in table] == [[n, m] for n in (10, 11, 12) for m in (60, 120)]
    assert table[0][3] < table[4][3]  # two strings more go further
    assert table[0][2] < table[1][2]  # who is heavier takes more
    assert (tmp_path / "short.simulation.sweep.svg").read_text().startswith("<?xml")
    assert (tmp_path / "short.simulation.csv").exists()
    assert not list(tmp_path.glob("*.png"))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["wmtc_clas1"], ["wmtc_class1"]),
        (["ece15", "--sweep", "drag_aera=0.4..0.6"], ["drag_aera", "did you mean 'drag_area'"]),
        *(
            (["ece15", "--sweep", f"{said}=8..16"], [repr(said), f"did you mean {meant!r}"])
            for said, meant in (
                ("battery.paralel", "battery.cells_parallel"),
                ("series", "battery.cells_series"),
                ("battery.capacity", "cell_capacity"),
            )
        ),
        (["ece15", "--sweep", "drag_area=0.4..9"], ["9 m²", "0.05 to 8 m²"]),
        (["ece15", "--sweep", "drag_area=0.6..0.4"], ["0.6", "below"]),
        (["ece15", "--sweep", "drag_area"], ["NAME=LOW..HIGH"]),
        (["ece15", "--sweep", "drag_area=a..b"], ["must be NAME=LOW..HIGH"]),
        (["ece15", "--sweep", "drag_area=0.4..0.6:few"], ["must be NAME=LOW..HIGH"]),
        (["ece15", "--sweep", "drag_area=0.4..nan"], ["nan", "0.05 to 8 m²"]),
        (["ece15", "--sweep", "drag_area=0.4..0.6:0"], ["0 steps"]),
        (["ece15", "--sweep", "battery.cells_parallel=1.5..4"], ["whole number"]),
        (["ece15", "--sweep", "drag_area=0.4..0.6:999"], ["999 steps"]),
        (["ece15", *(["--sweep", "drag_area=0.4..0.6"] * 2)], ["twice"]),
        (
            ["ece15", "--sweep", "drag_area=.4...6", "--sweep", "payload_mass=60..70", "--sweep", "cell_mass=.1...2"],
            ["at most two"],
        ),
        (["ece15", "--soc", "80"], ["--soc 80", "0 to 1"]),
        (["ece15", "--ambient", "200"], ["200 degC"]),
        (["ece15", "--payload", "-5"], ["-5 kg"]),
        (["ece15", "--dyno", "heavy"], ["--dyno heavy", "KG,A,B,C"]),
        (["ece15", "--dyno", "180,5"], ["--dyno 180,5", "KG,A,B,C"]),
        (["ece15", "--dyno", ""], ["--dyno : must be"]),
        (["ece15", "--dyno", "180", "--grade", "3"], ["--grade 3", "a roller has none"]),
        (["ece15", "--dyno", "180", "--wind", "3"], ["--wind 3", "on a roller"]),
        (["ece15", "--repeat", "0"], ["--repeat 0"]),
        (["ece15", "--predictive"], ["recorded"]),
        (["ece15", "--vehicle", "referense"], ["reference"]),
        (["nowhere.blf"], ["nowhere.blf"]),
    ],
)
def test_what_cannot_be_is_refused_by_name(tmp_path, capsys, arguments, words):
    assert simulate(*arguments, "--output", tmp_path) == 2
    message = capsys.readouterr().err
    for word in words:
        assert word in message
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time_s,speed_kmh\n0,0\n1,5\n2,-3\n", [":4:", "speed_kmh", "-3 kmh"]),
        ("time_s,speed_kmh\n0,0\n1,5\n2,6\n9,6\n10,6\n", [":5:", "gap"]),
        ("time_s,sped_kmh\n0,0\n1,5\n", ["sped_kmh", "speed_kmh"]),
        ("hello,world\n1,2\n", ["hello", "time_s"]),
        (f"<gpx>{'<trkpt/>' * 9999}\n", ["<gpx>", "..."]),
        (f"time_s,{'x' * 9999}\n", ["unknown column 'xxx", "..."]),
        ("distance_m,altitude_m\n0,1\n50,2\n40,3\n", [":4:", "distance_m"]),
    ],
)
def test_bad_files_are_refused_by_line(tmp_path, capsys, text, words):
    file = tmp_path / "bad.csv"
    file.write_text(text)
    assert simulate(file, "--output", tmp_path / "out") == 2
    message = capsys.readouterr().err
    assert len(message) < 600 + len(str(file))
    for word in words:
        assert word in message
