"""Validation: its definitions, a recorded ride against models right and wrong, bad input, the command."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.arrays import block_means
from gz_onboard.cli import main
from gz_onboard.model.model import Model
from gz_onboard.recording.recording import read_recording
from gz_onboard.reports.page import mark_of, write_below
from gz_onboard.validation.command import KEYS
from gz_onboard.validation.comparison import CHANNELS, LABELS, ORDER, Comparison, pool, pooled, riding_conditions
from gz_onboard.validation.components import components
from gz_onboard.validation.report import by_condition
from gz_onboard.validation.ride import measure, per_second, soc_reference
from gz_onboard.vehicle import OWN, read_vehicle
from tests.support import LOGS


def errors(channel, measured, simulated, limit=20.0):
    return Comparison.of(CHANNELS[channel], np.asarray(measured), np.asarray(simulated)).errors(limit)


# --- definitions --------------------------------------------------------------------------------------------------


def test_percent_is_of_the_mean_magnitude():
    measured, simulated = [10.0, -10.0, 0.0, 20.0], [11.0, -12.0, 1.0, 20.0]
    found = errors("pack_current", measured, simulated, 10.0)
    assert (found.percent, found.max, found.mean_error, found.passed) == (pytest.approx(100 * 4 / 40), 2, 0, True)
    assert found.rms == pytest.approx(np.sqrt(6 / 4))
    assert not errors("pack_current", measured, simulated, 9.9).passed


@pytest.mark.parametrize(
    ("channel", "change", "error", "base"),
    [
        ("motor_temperature", 40, 2, 40),
        ("motor_temperature", 3, 2, 10),
        ("soc", 0.2, 0.02, 0.2),
        ("soc", 0.01, 1, 5e-2),
    ],
)
def test_temperature_and_charge_are_judged_by_their_change(channel, change, error, base):
    measured = 0.5 + change * np.linspace(0, 1, 50)
    assert errors(channel, measured, measured + error).percent == pytest.approx(100 * error / base)


def test_a_channel_without_magnitude_does_not_pass():
    found = errors("motor_torque", np.zeros(9), np.ones(9))
    assert found.percent is None
    assert not found.passed


def ride(n):
    second = np.arange(n)
    return {
        "speed": np.where(second < n // 4, 0.0, 8.0),
        "acceleration": np.where(second % 50 < 10, 1.5, 0.0),
        "yaw_rate": np.where(second % 90 < 30, 0.3, 0.0),
        "grade": np.random.default_rng(0).choice([-0.03, 0.0, 0.03], n),
        "ambient_temperature": np.full(n, 5.0),
        "braking": np.zeros(n),
    }


def test_each_second_has_one_condition_of_a_sorting():
    measured = ride(400)
    found, missing = riding_conditions(measured)
    assert not missing
    assert [kind for by in LABELS for kind in found[by]] == list(ORDER)
    moving = measured["speed"] > 2
    for by in ("turning", "grade", "pace", "speed"):
        assert (np.sum(list(found[by].values()), axis=0) == (moving if by != "speed" else 1)).all(), by
    assert found["turning"]["turning"].sum() == (moving & (measured["yaw_rate"] > 0.1)).sum()
    assert (found["temperature"]["cold"] == found["turning"]["straight"]).all()
    del measured["yaw_rate"], measured["ambient_temperature"]
    found, missing = riding_conditions(measured)
    assert not {"turning", "temperature"} & set(found)
    assert [("yaw rate" in text, "cold and warm" in text) for text in missing] == [(True, False), (False, True)]


@given(st.integers(0, 1000))
def test_pooled_rides_are_as_one(seed):
    rng = np.random.default_rng(seed)
    measured, simulated = rng.normal(20, 30, (2, 300))
    cut = int(rng.integers(30, 270))

    def means(part):
        one = Comparison.of(CHANNELS["pack_current"], measured[part], simulated[part])
        return one.split("predictive", "pack_current", {"all": {"all": np.ones(300, dtype=bool)}})

    whole, parts = pooled(means(slice(None))), pooled(means(slice(cut)) + means(slice(cut, None)))
    assert asdict(parts) == pytest.approx(asdict(whole) | {"rides": 2})


def test_a_bias_in_turns_is_found_there():
    conditions, _ = riding_conditions(ride(900))
    power = np.full(900, 500.0)
    short = Comparison.of(CHANNELS["pack_current"], power, power - 100 * conditions["turning"]["turning"])
    entry: Any = SimpleNamespace(on_dynamometer=False, splits=short.split("predictive", "pack_power", conditions))
    _, rows = by_condition(pool([entry]))
    table = {row[0]: row[2] for row in rows if len(row) > 1}
    assert table["turning"] == "-100 (-20.0 %)"
    assert table["straight"] == "+0 (+0.0 %)"


# --- a recorded ride ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def city():
    return measure(LOGS / "city_34C.blf", read_vehicle("reference", 75.0))


def alone(city, name, vehicle=None):
    return components(vehicle or city.vehicle, city.seconds, city.soc, 30.0, None)[name]


def test_components_of_the_right_model(city):
    voltage = alone(city, "battery_voltage").errors(10.0)
    assert voltage.percent < 1
    assert voltage.of_spread < 0.5
    assert alone(city, "inverter_power").errors(10.0).percent < 5
    assert alone(city, "motor_torque").errors(10.0).passed
    assert alone(city, "cell_temperature").errors(10.0).max < 3


@pytest.mark.parametrize(
    ("component", "change"),
    [
        ("inverter_power", {"motor_copper_resistance": 0.06}),
        ("inverter_power", {"inverter_loss_constant": 80.0}),
        ("motor_torque", {"torque_constant": 0.38}),
        ("road_load", {"drag_area": 1.1}),
        ("road_load", {"vehicle_mass": 165.0}),
        ("cell_temperature", {"pack_heat_capacity": 3000.0}),
    ],
)
def test_a_wrong_parameter_shows_in_its_component(city, component, change):
    parameters = city.vehicle.parameters.replaced(**change)
    wrong = replace(city.vehicle, parameters=parameters, model=Model(city.vehicle.model.effects, parameters))
    assert alone(city, component, wrong).errors(10.0).rms > 1.2 * alone(city, component).errors(10.0).rms


def test_measured_current_is_corrected_for_the_sensor(city):
    recorded, p = city.recorded, city.vehicle.parameters
    columns = read_recording(LOGS / "city_34C.blf", city.vehicle).columns
    grid = np.arange(columns["motor_speed"][0][0], columns["motor_speed"][0][-1], recorded.dt)
    raw = block_means(np.interp(grid, *columns["pack_current"]), 100)
    flows = per_second(recorded)["pack_current"]
    assert flows * p["pack_current_gain"] + p["pack_current_offset"] == pytest.approx(raw)


def test_the_reference_of_the_charge(city):
    """The charge counted, and the state of charge that the voltage of the last minutes gives."""
    vehicle, measured = city.vehicle, city.seconds
    modelled = alone(city, "battery_voltage").modelled

    def reference(**others: Any) -> Any:
        return soc_reference(vehicle, measured | others, city.soc, modelled)

    found = reference()
    assert found.start == pytest.approx(100 * city.soc)
    assert found.start - found.drawn == pytest.approx(100 * measured["soc"][-1])
    assert 0.005 < found.drawn_sd / found.drawn < 0.02  # a current sensor and a capacity known to a percent
    assert abs(found.voltage_says) < 2 * found.voltage_sd
    slope = vehicle.battery.ocv(float(measured["soc"][-120:].mean()))[1]
    higher = reference(pack_voltage=measured["pack_voltage"] + 0.03 * slope * vehicle.battery.cells_series)
    assert higher.voltage_says - found.voltage_says == pytest.approx(3.0)
    without = {name: values for name, values in measured.items() if name != "soc"}
    assert soc_reference(vehicle, without, city.soc, modelled) is None


# --- the command --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """(folder, summary, text) of the coast-down twice, in two processes."""
    folder = tmp_path_factory.mktemp("validate")
    other = folder / "other"
    other.mkdir()
    shutil.copy(LOGS / "coastdown.blf", other / "coastdown.blf")
    (other / "rides.json").write_text('[{"name": "coastdown", "kind": "roll", "rider_mass_kg": 75.0}]')
    logs = [str(LOGS / "coastdown.blf"), str(other / "coastdown.blf")]
    files = ["--json", str(folder / "v.json"), "--markdown", str(folder / "v.md"), "--output", str(folder / "out")]
    with contextlib.redirect_stdout(io.StringIO()) as text:
        assert main(["validate", *logs, *files, "--jobs", "2"]) == 0
    return folder, json.loads((folder / "v.json").read_text()), text.getvalue()


def test_json(two):
    _, summary, _ = two
    assert summary["version"] == 2
    assert summary["failed"] == []
    first, second = summary["rides"]
    assert set(first) == set(KEYS) - {"channels", "energy_percent", "pack_empty"}
    assert set(first["open_loop"]["channels"]) == set(CHANNELS) - {"throttle"}
    assert set(first["predictive"]["channels"]) == set(CHANNELS)
    assert (second["kind"], second["payload_kg"]) == ("roll", 75.0)
    assert first["passed"] == all(first[form]["passed"] for form in ("open_loop", "predictive", "components"))


def test_page_and_pictures(two):
    folder, summary, _ = two
    for entry in summary["rides"]:
        assert Path(entry["plot"]).stat().st_size > 50_000
    page = (folder / "out" / "validation.html").read_text()
    assert page.count("data:image/png;base64,") == 2
    assert "://" not in page
    assert "Where the model fails" in page
    assert "class=bad" in page


def test_what_fails_is_printed_with_its_limit_and_meaning(two):
    text = two[2].partition(two[1]["rides"][1]["file"])[0].splitlines()
    (load,) = [line for line in text if "FAIL (" in line and "road load" in line]
    assert "FAIL (limit 10 %) rms" in load
    failing = [form for form in ("open_loop", "predictive", "components") if not two[1]["rides"][0][form]["passed"]]
    assert len([line for line in text if line.startswith("    FAIL:")]) == len(failing) >= 1
    assert any("docs/results/validation.md" in line for line in text)


def test_markdown_has_the_limits_and_the_thesis(two):
    folder, summary, _ = two
    text = (folder / "v.md").read_text()
    channels = [ride["components"]["channels"] for ride in summary["rides"]]
    rows = {cells[1]: cells for cells in (re.split(r" *\| *", line) for line in text.splitlines()) if len(cells) > 3}
    assert rows["road load"][5] == "**0 of 2**"
    worst = max(one["motor_temperature"]["max"] for one in channels)
    table = text.partition("### Comparison with the thesis")[2]
    rows = {cells[1]: cells for cells in (re.split(r" *\| *", line) for line in table.splitlines()) if len(cells) > 6}
    assert rows["motor temperature"][2:5] == ["±10 K", "fig. 2.25, bench, p. 44", f"{worst:.2g} K"]
    cell = max(one["battery_voltage"]["max"] for one in channels) / 14
    assert rows["voltage of a cell"][4:7:2] == [f"{cell:.2g} V", "yes" if cell <= 0.02 else "**no**"]
    assert not any("dynamometer" in what for what in rows)  # neither ride was on one


def test_tables_are_written_below_their_mark(tmp_path):
    page = tmp_path / "page.md"
    write_below(page, "a", "first\n")
    assert page.read_text() == "first\n"
    page.write_text(f"by hand\n\n{mark_of('a')}\nold\n")
    write_below(page, "a", "new\n")
    assert page.read_text() == f"by hand\n\n{mark_of('a')}\n\nnew\n"
    write_below(page, "b", "all of it\n")
    assert page.read_text() == "all of it\n"


def test_a_repeated_run_is_the_same_and_the_gate_is_the_status(two, capsys):
    status = main(["validate", str(LOGS / "coastdown.blf"), "--payload", "75", "--json", "--no-plot", "--gate"])
    found = json.loads(capsys.readouterr().out)["rides"][0]
    assert status == (0 if found["passed"] else 1)
    for form in ("open_loop", "predictive", "components"):
        assert found[form] == two[1]["rides"][1][form]


@pytest.fixture(scope="module")
def smaller(tmp_path_factory):
    """(ride, text) of a simulated ride against its own vehicle file, and against a seventh of its charge."""
    folder = tmp_path_factory.mktemp("smaller")
    rows = [f"{t},{min(max(2 * t - 20, 0), 40)}" for t in range(0, 250, 10)]
    (folder / "hold.csv").write_text("\n".join(["time_s,speed_kmh", *rows]))
    log, out = folder / "hold.blf", ["--quiet", "--no-plot", "--output", str(folder)]
    assert main(["simulate", str(folder / "hold.csv"), "--soc", "0.2", "--frames", str(log), "--no-series", *out]) == 0
    own = (OWN / "reference.toml").read_text()
    assert "cell_capacity = { value = 2.73361," in own
    seventh = own.replace("cell_capacity = { value = 2.73361,", "cell_capacity = { value = 0.4,")
    (folder / "seventh.toml").write_text(seventh)
    found = []
    for name in ("reference", str(folder / "seventh.toml")):
        files = ["--vehicle", name, "--payload", "80", "--json", str(folder / "v.json"), *out]
        with contextlib.redirect_stdout(io.StringIO()) as text:
            assert main(["validate", str(log), *files]) == 0
        ride = json.loads((folder / "v.json").read_text())["rides"][0]
        found.append((ride, " ".join(text.getvalue().split())))
    return found


@pytest.mark.parametrize(("form", "name"), [("open_loop", "open loop"), ("predictive", "rider model")])
def test_energy_is_compared_until_the_simulated_pack_is_empty(smaller, form, name):
    (whole, _), (part, text) = smaller
    end = part[form]["pack_empty"]
    assert whole[form]["pack_empty"] is None
    assert 60 < end["compared_s"] < end["time_s"] < 220 < part["duration_s"]
    assert 0.3 < end["distance_km"] < 0.0112 * end["time_s"]
    assert -0.01 < end["soc"] < 0.08  # below which the controller of this vehicle holds back
    assert abs(whole[form]["energy_percent"]) < 3
    assert part[form]["energy_percent"] == pytest.approx(whole[form]["energy_percent"], abs=5)
    wanted = {"form": form, "channel": "pack_power", "sorting": "speed"}
    power = [row["seconds"] for row in part["splits"] if row.items() >= wanted.items()]
    assert 0 < sum(power) <= end["compared_s"]
    assert not part["passed"]  # the pack that ends too soon is an error of the model all the same
    seconds, until = f"{end['time_s']:.0f} s", f"{end['compared_s']:.0f} s"
    energy = f"{part[form]['energy_percent']:+.1f}"
    assert f"{name} energy {energy} % until {until}; the simulated pack is empty at {seconds}" in text
    assert any(f"{name}: the simulated pack is empty at {seconds}" in missing for missing in part["missing"])


def test_a_ride_without_throttle_and_yaw_rate_is_judged_by_the_rest(tmp_path, capsys):
    text = (OWN / "reference.toml").read_text().splitlines()
    text = [line for line in text if not line.startswith(("throttle =", "rate_z ="))]
    (tmp_path / "blind.toml").write_text("\n".join(text))
    arguments = ["--vehicle", str(tmp_path / "blind.toml"), "--json", "--format", "svg", "--output", str(tmp_path)]
    assert main(["validate", str(LOGS / "coastdown.blf"), *arguments]) == 0
    assert "component alone" in (tmp_path / "coastdown.validation.svg").read_text()
    assert "data:image/svg+xml;base64," in (tmp_path / "validation.html").read_text()
    found = json.loads(capsys.readouterr().out)["rides"][0]
    assert found["open_loop"] is None
    assert found["predictive"]["channels"]["motor_speed"]["passed"]
    assert {row["sorting"] for row in found["splits"]} == set(LABELS) - {"turning"}
    for part in ("no throttle", "yaw rate"):
        assert any(part in text for text in found["missing"])


def table(header, row, seconds=40):
    return "\n".join([header, *(row.format(t=t) for t in range(seconds))])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            table("time [s],speed [m/s]", "{t},5"),
            "nothing in it can be compared with its simulation: it needs one of battery current",
        ),
        (
            table("time [s],speed [m/s],pack_voltage [V]", "{t},0.1,50"),
            "the vehicle only stands, for all of its 39 s: there is no riding to judge; at least 20 s of it",
        ),
        (table("time [s],speed [m/s]", "{t},5", 20), "19 s are too short a ride to judge; at least 30 s"),
    ],
)
def test_a_ride_that_cannot_be_judged(tmp_path, capsys, text, message):
    (tmp_path / "ride.csv").write_text(text)
    assert main(["validate", str(tmp_path / "ride.csv"), "--output", str(tmp_path), "--no-plot"]) == 2
    out = capsys.readouterr()
    assert f"ride.csv: {message}" in out.err
    assert "passed" not in out.out


def test_bad_input(tmp_path, capsys):
    other = tmp_path / "other.log"
    other.write_text("(1.000000) can0 7AB#0011223344556677\n(1.010000) can0 7AB#0011223344556677\n")
    none = tmp_path / "none.blf"
    assert main(["validate", str(other), str(none), "--jobs", "1", "--no-plot", "--output", str(tmp_path)]) == 2
    errors = capsys.readouterr().err
    assert "knows none" in errors
    assert "none.blf" in errors
    assert main(["validate", "--vehicle", "refrence", str(other)]) == 2
    assert "did you mean 'reference'" in capsys.readouterr().err
    assert main(["validate", str(other), "--json", "ride.blf"]) == 2
    assert "name of a log" in capsys.readouterr().err
