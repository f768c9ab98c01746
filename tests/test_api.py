"""The Python API does what the commands do, of any table, and its documentation runs."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import gz_onboard as gz
from gz_onboard import api, cli
from tests.support import LOGS, ROOT
from tests.test_learned import CAPACITY, saved

__all__ = ["saved"]  # a fixture

PAGE = ROOT / "docs/how-to/python.md"
COASTDOWN = LOGS / "coastdown.blf"
anyhow: Any = gz  # for what a type checker would refuse
BLOCK = re.compile(r"^```python\n(.*?)^```(?:\n\n```text\n(.*?)^```)?", re.M | re.S)


def signals() -> dict[str, Any]:
    """Five minutes at 36 km/h."""
    seconds = np.arange(0, 300, 0.5)
    steady = np.ones(len(seconds))
    return {
        "speed [km/h]": 36 * steady,
        "time [s]": seconds,
        "pack_voltage [V]": 52 * steady,
        "pack_current [A]": 14 + np.sin(seconds),
    }


def test_a_result_prints_as_its_command_and_is_short_otherwise(tmp_path, capsys):
    assert cli.main(["estimate", str(COASTDOWN), "--no-plot", "--output", str(tmp_path)]) == 0
    told = capsys.readouterr().out.splitlines()
    ride = gz.estimate(COASTDOWN)
    own = [line for line in str(ride).splitlines() if not line.startswith("  computed")]
    assert own == [line for line in told if not line.startswith(("  computed", "  written"))]
    assert len(repr(ride)) < 5000
    simulated = gz.simulate("ece15")
    assert "rolling resistance" in str(simulated)
    assert len(repr(simulated)) < 5000


def test_the_names_are_those_of_the_api():
    assert sorted(set(gz.__all__) - {"__version__"}) == sorted(api.__all__)
    assert set(gz.__all__) <= set(dir(gz))
    for name in api.__all__:
        assert getattr(gz, name) is getattr(api, name)
    with pytest.raises(AttributeError, match="no attribute 'estimat'"):
        gz.estimat  # type: ignore[attr-defined]  # noqa: B018


def test_every_page_of_the_documentation_runs(tmp_path, monkeypatch):
    (tmp_path / "replay_logs").symlink_to(LOGS)
    monkeypatch.chdir(tmp_path)
    blocks = BLOCK.findall(PAGE.read_text(encoding="utf-8"))
    assert len(blocks) > 5
    shown = 0
    names: dict[str, Any] = {}
    for code, said in blocks:
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            exec(compile(code, str(PAGE), "exec"), names)
        assert out.getvalue() == said
        shown += bool(said)
    assert shown > 4
    assert (tmp_path / "new.toml").is_file()


# --- estimate -----------------------------------------------------------------------------------------------------


def test_an_estimate_is_that_of_the_command(tmp_path, capsys):
    assert cli.main(["estimate", str(COASTDOWN), "--no-plot", "--output", str(tmp_path), "--json"]) == 0
    (told,) = json.loads(capsys.readouterr().out)["rides"]
    ride = gz.estimate(COASTDOWN)
    assert capsys.readouterr() == ("", "")
    differ = {"log", "cpu_s", "real_time_factor"}
    assert {key: getattr(ride.summary, key) for key in told.keys() - differ - {"why", "changes"}} == {
        key: value for key, value in told.items() if key not in differ | {"why", "changes"}
    }


def test_estimates_in_a_log_are_those_that_were_made(tmp_path):
    assert cli.main(["estimate", str(COASTDOWN), "--no-plot", "--output", str(tmp_path)]) == 0
    logged = gz.read_estimates(tmp_path / "coastdown.estimate.mcap").to_table()
    made = gz.estimate(COASTDOWN).to_table()
    assert list(logged) == list(made)
    for name, values in made.items():
        np.testing.assert_array_equal(logged[name], values, name)
    with pytest.raises(gz.InputError, match=r"holds no estimates.*gz-onboard estimate coastdown\.blf"):
        gz.read_estimates(COASTDOWN)


def test_a_table_of_many_rides_has_a_row_each():
    rides = [gz.estimate(COASTDOWN), gz.estimate(signals())]
    table = gz.summary_table(rides)
    assert table["file"].tolist() == [str(COASTDOWN), "table"]
    assert table["distance_km"].tolist() == [ride.summary.distance_km for ride in rides]
    assert {len(column) for column in table.values()} == {2}


# --- validate -----------------------------------------------------------------------------------------------------


def test_a_validation_is_that_of_the_command(capsys):
    assert cli.main(["validate", str(COASTDOWN), "--no-plot", "--json"]) == 0
    (told,) = json.loads(capsys.readouterr().out)["rides"]
    found = gz.validate(COASTDOWN)
    assert capsys.readouterr() == ("", "")
    table = found.to_table()
    assert found.passed == told["passed"]
    assert len(table["ride"]) == sum(len(told[f]["channels"]) for f in ("open_loop", "predictive", "components"))
    assert "coastdown.blf: not passed" in str(found)
    assert found.markdown().startswith("### Summary")
    with pytest.raises(gz.InputError, match="no ride is given"):
        gz.validate([])


def test_a_data_frame_is_the_same_ride_with_its_time_as_a_column_or_as_the_index():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(signals())
    same = gz.estimate(signals()).to_table()["range[m]"]
    indexed = frame.set_index(pandas.to_datetime(frame.pop("time [s]"), unit="s").rename("time"))
    for one in (pandas.DataFrame(signals()), indexed):
        ride = gz.estimate(one)
        np.testing.assert_array_equal(ride.to_table()["range[m]"], same)
    assert list(ride.to_pandas().columns) == list(ride.to_table()) == ride.to_arrow().column_names
    assert ride.to_arrow()["arrival_soc"].null_count == len(same)


# --- the others ---------------------------------------------------------------------------------------------------


def test_a_simulation_is_that_of_the_command(tmp_path, capsys):
    arguments = ["simulate", "ece15", "--soc", "0.8", "--grade", "2", "--no-plot", "--output", str(tmp_path), "--json"]
    assert cli.main(arguments) == 0
    told = json.loads(capsys.readouterr().out)
    ride = gz.simulate("ece15", options=gz.SimulationOptions(soc=0.8, grade=2.0))
    assert capsys.readouterr() == ("", "")
    for key in ("consumption_wh_km", "range_km", "soc_end", "ledger_wh", "payload_kg", "payload_from"):
        assert getattr(ride.summary, key) == told[key], key
    assert len(ride.to_table()["soc[1]"]) == len(ride.to_table()["time[s]"]) > 100


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"soc": 1.2}, "soc 1.2: must be 0 to 1"),
        ({"soc": float("nan")}, "soc nan"),
        ({"ambient": 300.0}, "ambient 300: must be -40 to 60 degC"),
        ({"repeat": 0}, "repeat 0: must be 1 to 1000"),
        ({"repeat": 2.5}, "repeat 2.5: must be a whole number"),
        ({"until_empty": "no"}, "until_empty 'no': must be True or False"),
        ({"until_empty": True, "repeat": 2}, "repeat 2: it is repeated until_empty"),
        ({"dyno": 180}, r"dyno 180: must be str \| None"),
        ({"dyno": "180,5"}, "--dyno 180,5: must be KG or KG,A,B,C"),
        ({"chassis": "plannar"}, "did you mean 'planar'"),
    ],
)
def test_options_of_a_simulation_are_checked(options, said):
    with pytest.raises(gz.InputError, match=said):
        gz.SimulationOptions(**options)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"seed": -1}, "seed -1: must be 0 to 4294967295"),
        ({"seed": "1"}, "seed '1': must be a whole number"),
        ({"jobs": True}, "jobs True: must be a whole number"),
        ({"effects": "nowhere"}, "effects nowhere: no such folder"),
        ({"holdout": "city_14C"}, r"holdout 'city_14C': must be .*Sequence\[str\] \| None"),
    ],
)
def test_options_of_a_discovery_are_checked(options, said):
    with pytest.raises(gz.InputError, match=said):
        gz.DiscoveryOptions(**options)


def test_numbers_of_numpy_are_numbers():
    assert repr(anyhow.SimulationOptions(soc=np.float32(0.5), repeat=np.int64(2))) == repr(
        gz.SimulationOptions(soc=0.5, repeat=2)
    )
    for mass in (np.float32(80), np.int64(80), 80):
        found = gz.read_ride(COASTDOWN, facts={"rider_mass_kg": mass}).rider_mass
        assert (found, type(found)) == (80.0, float)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: anyhow.estimate(COASTDOWN, filter_name="scaler"), "filter_name 'scaler'.*did you mean 'scalar'"),
        (lambda: anyhow.estimate(COASTDOWN, None), r"vehicle None: must be .*Vehicle \| str"),
        (lambda: anyhow.estimate(COASTDOWN, route=3), "route 3: must be"),
        (lambda: anyhow.estimate(COASTDOWN, progress=3), "progress 3: must be .*Callable"),
        (lambda: anyhow.read_vehicle("reference", -1.0), "payload -1: must be 0 to 3000 kg"),
        (lambda: anyhow.read_vehicle(["reference"]), r"name \['reference'\]: must be str \| PathLike"),
        (lambda: anyhow.simulate("ece15", options={"soc": 1}), "options {'soc': 1}: must be SimulationOptions"),
        (lambda: anyhow.calibrate({"data": "x.csv"}), r"data {'data': 'x.csv'}: must be .*Mapping"),
        (lambda: anyhow.calibrate(None), "data None: must be"),
        (lambda: anyhow.calibrate({"dta": []}, procedure="motor"), "did you mean 'data'"),
        (lambda: anyhow.discover(None), "NoneType is no table of signals"),
        (lambda: anyhow.summary_table([3]), r"rides \[3\]: must be .*Iterable\[.*EstimatedRide\]"),
        (lambda: anyhow.read_estimates(3), r"log 3: must be str \| PathLike"),
        (
            lambda: anyhow.Recording("x", {"vehicle_speed": (np.arange(2), np.arange(3))}),
            "x: vehicle_speed: .* one length",
        ),
        (lambda: anyhow.Recording("x", {"vehicle_sped": (np.arange(2), np.arange(2))}), "did you mean 'vehicle_speed'"),
        (lambda: anyhow.Recording("x", {"vehicle_speed": (np.array([1, 0]), np.arange(2))}), "times decrease"),
        (lambda: anyhow.Recording("x", None), "columns None: must be .*Mapping"),
        (lambda: anyhow.Recording("x", {}, {"rider_mass": 80.0}), "no fact of a ride .did you mean 'rider_mass_kg'"),
        (
            lambda: anyhow.read_ride(COASTDOWN, facts={"rider_mass_kg": -80.0}),
            "rider_mass_kg -80: must be 0 to 3000 kg",
        ),
    ],
)
def test_what_is_not_of_its_type_is_an_input_error_with_its_name(call, said):
    with pytest.raises(gz.InputError, match=said):
        call()


def test_a_calibration_is_that_of_the_command(tmp_path, capsys):
    folder = LOGS / "calibration"
    dyno, ramp = folder / "motor_dyno.csv.gz", folder / "motor_emf_ramp.csv.gz"
    out = tmp_path / "told.toml"
    arguments = ["calibrate", "motor", str(dyno), "--with", f"emf={ramp}", "--output", str(out), "--json"]
    assert cli.main(arguments) == 0
    (told,) = json.loads(capsys.readouterr().out)["procedures"]
    found = gz.calibrate({"data": [dyno], "emf": [ramp]}, procedure="motor")
    table = found.to_table()
    assert dict(zip(table["parameter"], table["value"], strict=True)) == {
        name: one["value"] for name, one in told["parameters"].items()
    }
    vehicle = found.write(tmp_path / "own.toml")
    assert (tmp_path / "own.toml").read_text() == out.read_text()
    assert vehicle.parameters["torque_constant"] == pytest.approx(found.results[0].parameters["torque_constant"].value)


@pytest.mark.parametrize(
    ("data", "options", "said"),
    [
        ("x.csv", {"procedure": "motr"}, "did you mean 'motor'"),
        ("nowhere", {}, "nowhere"),
        (["a", "b"], {}, "one folder"),
        ({"dta": ["x.csv"]}, {"procedure": "motor"}, "no data 'dta'.*did you mean 'data'"),
        (["x.csv"], {"procedure": "motor"}, "x.csv: no such file"),
        (["x.csv"], {"procedure": "motor", "options": {"nothing": 1}}, "no option 'nothing'"),
    ],
)
def test_a_calibration_says_what_it_lacks(data, options, said):
    with pytest.raises(gz.InputError, match=said):
        gz.calibrate(data, **options)


def test_a_discovery_is_that_of_the_command(tmp_path, capsys):
    log = LOGS / "city_34C.blf"
    assert cli.main(["discover", str(log), "--jobs", "1", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    found = gz.discover(log)
    assert capsys.readouterr() == ("", "")
    assert found.report.verdict == told["verdict"]
    assert found.to_table()["value"].tolist() == [cause["value"] for cause in told["causes"]]
    assert found.report.notes == told["notes"]
    assert told["verdict"].upper() in str(found).upper()
    found.write_model(tmp_path / "extended.toml")
    assert (tmp_path / "extended.toml").is_file() == bool(told["causes"])


def test_facts_of_a_ride_are_those_given_or_noted():
    assert gz.read_ride(COASTDOWN).rider_mass == 75.0
    ride = gz.read_ride(COASTDOWN, name="first", facts={"rider_mass_kg": 80.0})
    assert (ride.name, ride.rider_mass, ride.facts["ambient_C"]) == ("first", 80.0, 12.5)
    table = gz.read_ride(signals(), name="mine")
    assert table.name == "mine"
    assert set(table.columns) == {"vehicle_speed", "pack_voltage", "pack_current"}


def test_a_sweep_is_that_of_the_command(tmp_path, capsys):
    swept = ["--sweep", "drag_area=0.4..0.6:2", "--sweep", "battery.parallel=4..5"]
    options = ["--soc", "0.9", "--no-plot", "--no-series", "--output", str(tmp_path), "--json"]
    (tmp_path / "short.csv").write_text("time_s,speed_kmh\n0,0\n10,30\n20,30\n30,0\n")
    assert cli.main(["simulate", str(tmp_path / "short.csv"), *swept, *options]) == 0
    told = json.loads(capsys.readouterr().out)["sweep"]
    parameters: dict[str, Any] = {"drag_area": np.array([0.4, 0.6]), "battery.parallel": [4, 5]}
    found = gz.sweep(tmp_path / "short.csv", parameters, options=gz.SimulationOptions(soc=0.9))
    table = found.to_table()
    assert list(table)[:2] == ["drag_area[m²]", "battery.cells_parallel"]
    assert table["consumption[Wh/km]"].tolist() == [one["consumption_wh_km"] for one in told]
    assert table["range[km]"].tolist() == [one["range_km"] for one in told]
    assert table["drag_area[m²]"].tolist() == [0.4, 0.4, 0.6, 0.6]


def test_a_report_has_what_its_page_shows(tmp_path, capsys):
    assert cli.main(["report", str(COASTDOWN), "-o", str(tmp_path / "told.html")]) == 0
    found = gz.report(COASTDOWN)
    found.write(tmp_path / "own.html")
    told = (tmp_path / "told.html").read_text()
    assert (tmp_path / "own.html").read_text() == told
    (ride,) = found.rides
    assert len(ride.path) == 1
    table = found.to_table()
    assert sum(table["energy[Wh]"]) == pytest.approx(ride.summary.energy_wh)
    assert table["ride"].tolist() == ["coastdown"] * len(table["where"])
    with pytest.raises(gz.InputError, match="would overwrite the input"):
        found.write(COASTDOWN)
    with pytest.raises(gz.InputError, match=r"give it a name that ends in \.html"):
        found.write(tmp_path / "page.pdf")


def test_what_was_learned_is_that_of_the_command(saved, capsys):
    assert cli.main(["learned", "--state", str(saved), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    found = gz.read_learned(saved)
    assert {name: x.value for name, x in found.battery.items()} == {n: x["factor"] for n, x in told["learned"].items()}
    assert found.age_s == pytest.approx(told["age_s"], abs=60)
    table = found.to_table()
    assert table["factor"][table["name"].tolist().index("capacity")] == pytest.approx(CAPACITY, abs=0.01)
    assert set(table["part"]) == {"battery", "rider"}
    assert cli.main(["learned", "--state", str(saved)]) == 0
    assert capsys.readouterr().out == f"{found}\n"
    saved.write_bytes(saved.read_bytes()[:-9])
    with pytest.raises(gz.InputError, match=f"{saved}: .*its checksum is wrong"):
        gz.read_learned(saved)


def test_a_baseline_is_written_and_compared_with(tmp_path):
    ride = gz.read_ride(LOGS / "city_34C.blf")

    def part(start: float) -> gz.Recording:
        held = {role: (times >= start) & (times < start + 90) for role, (times, _) in ride.columns.items()}
        columns = {role: (times[held[role]], values[held[role]]) for role, (times, values) in ride.columns.items()}
        return replace(ride, name=f"from {start:g} s", columns=columns)

    roller = replace(part(0.0), name="roller", facts={"kind": "coastdown"})
    found = gz.baseline([*(part(90.0 * i) for i in range(3)), roller])
    assert str(found).endswith("left out, as no rides on a road: roller")
    table = found.to_table()
    known = found.before.parameters.known
    at = table["parameter"].tolist().index("wheel_radius")
    assert table["value_before"][at] == known["wheel_radius"].value
    assert table["value"][at] == pytest.approx(known["wheel_radius"].value, rel=0.01)
    assert 0 < table["sd"][at] <= table["sd_before"][at] * 1.5
    vehicle = found.write(tmp_path / "healthy.toml")
    assert vehicle.parameters["wheel_radius"] == pytest.approx(table["value"][at], rel=1e-4)
    assert vehicle.healthy == tmp_path / "healthy.healthy.npz"
    with pytest.raises(gz.InputError, match="would overwrite the input"):
        found.write(found.before.file)


def test_a_baseline_is_of_healthy_rides_on_a_road():
    with pytest.raises(gz.InputError, match=r"0 healthy rides: three are the least .*; left out, .*: coastdown"):
        gz.baseline(COASTDOWN)


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({}, "parameters: name at least one"),
        ({"drag_area": []}, "each with at least one value"),
        ({"drag_area": 0.4}, r"must be .*Mapping\[str, .*Iterable\[float\]\]"),
        ({"dragarea": [0.4]}, r"parameters\['dragarea'\]: no parameter is .*did you mean 'drag_area'"),
        ({"drag_area": [0.4, 40]}, "drag_area of 40 m² is outside 0.05 to 8 m²"),
        ({"battery.series": [14.5]}, "counts cells; 14.5 is not a whole number"),
        ({"battery.parallel": [4], "battery.cells_parallel": [5]}, "two of them are the same"),
    ],
)
def test_parameters_of_a_sweep_are_checked(parameters, said):
    with pytest.raises(gz.InputError, match=said):
        gz.sweep("ece15", parameters)


# --- types --------------------------------------------------------------------------------------------------------


def test_a_type_checker_knows_the_api(tmp_path):
    assert (ROOT / "gz_onboard/py.typed").is_file()
    (tmp_path / "use.py").write_text(
        "import gz_onboard as gz\n"
        "ride = gz.estimate('x.blf', gz.read_vehicle('reference'))\n"
        "reveal_type(ride.summary.range_end_km)\n"
        "gz.estimate(7)\n",
        encoding="utf-8",
    )
    run = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(tmp_path), "use.py"],
        cwd=tmp_path,
        env={**os.environ, "MYPYPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert 'Revealed type is "float | None"' in run.stdout.replace("Union[float, None]", "float | None"), run.stdout
    assert re.search(r"use\.py:4: error: Argument 1 to \"estimate\" has incompatible type \"int\"", run.stdout)
