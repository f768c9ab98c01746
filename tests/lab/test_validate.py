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

from gz_onboard.cli import main
from gz_onboard.lab.validate import KEYS, pool
from gz_onboard.lab.validate_components import components
from gz_onboard.lab.validate_report import COLUMNS, failures
from gz_onboard.lab.validate_ride import per_second
from gz_onboard.lab.validate_score import CHANNELS, LABELS, ORDER, conditions, errors, pooled, split
from gz_onboard.lab.validate_soc import soc_reference
from gz_onboard.model.model import Model
from gz_onboard.model.parameters import Parameters
from gz_onboard.offline.arrays import block_means
from gz_onboard.offline.samples import read_samples
from gz_onboard.reports.page import mark_of, write_below
from gz_onboard.simulation.recorded import read_recorded, rest_soc
from gz_onboard.vehicle import OWN, read_vehicle

LOGS = Path(__file__).parents[2] / "replay_logs"

# --- definitions --------------------------------------------------------------------------------------------------


def test_percent_is_of_the_mean_magnitude():
    measured, simulated = np.array([10.0, -10.0, 0.0, 20.0]), np.array([11.0, -12.0, 1.0, 20.0])
    found = errors(measured, simulated, CHANNELS["pack_current"], 10.0)
    assert found.percent == pytest.approx(100 * 4 / 40)
    assert found.rms == pytest.approx(np.sqrt(6 / 4))
    assert found.max == 2
    assert found.mean_error == 0
    assert found.passed
    assert not errors(measured, simulated, CHANNELS["pack_current"], 9.9).passed


@pytest.mark.parametrize(("rise", "base"), [(40.0, 40.0), (3.0, 10.0)])
def test_a_temperature_is_judged_by_its_rise(rise, base):
    measured = 20 + rise * np.linspace(0, 1, 50)
    found = errors(measured, measured + 2, CHANNELS["motor_temperature"], 20.0)
    assert found.percent == pytest.approx(100 * 2 / base)
    assert found.unit == "K"


def test_nothing_measured_is_no_pass():
    found = errors(np.zeros(9), np.ones(9), CHANNELS["motor_torque"], 20.0)
    assert found.percent is None
    assert not found.passed


@given(st.integers(1, 40), st.integers(1, 20), st.integers(0, 19))
def test_seconds_keep_the_mean(count, rate, rest):
    values = np.random.default_rng(count).normal(size=count * rate + min(rest, rate - 1))
    means = block_means(values, rate)
    assert len(means) == count
    assert means.mean() == pytest.approx(values[: count * rate].mean())


def ride(n, seed=0):
    rng = np.random.default_rng(seed)
    speed = np.where(np.arange(n) < n // 4, 0.0, 8.0)
    return {
        "speed": speed,
        "acceleration": np.where(np.arange(n) % 50 < 10, 1.5, 0.0),
        "yaw_rate": np.where(np.arange(n) % 90 < 30, 0.3, 0.0),
        "grade": rng.choice([-0.03, 0.0, 0.03], n),
        "ambient_temperature": np.full(n, 5.0),
        "braking": np.zeros(n),
    }


def test_each_second_has_one_condition_of_a_sorting():
    measured = ride(400)
    found, missing = conditions(measured)
    assert set(found) == set(LABELS)
    assert not missing
    moving = measured["speed"] > 2
    for by in ("turning", "grade", "pace"):
        assert (np.sum(list(found[by].values()), axis=0) == moving).all(), by
    assert (np.sum(list(found["speed"].values()), axis=0) == 1).all()
    assert found["turning"]["turning"].sum() == (moving & (measured["yaw_rate"] > 0.1)).sum()
    assert (found["temperature"]["cold"] == found["turning"]["straight"]).all()


def test_without_yaw_rate_turning_is_said_to_be_missing():
    measured = {name: values for name, values in ride(100).items() if name not in ("yaw_rate", "ambient_temperature")}
    found, missing = conditions(measured)
    assert "turning" not in found
    assert "temperature" not in found
    assert any("yaw rate" in text for text in missing)
    assert any("cold and warm" in text for text in missing)


@given(st.integers(0, 1000))
def test_pooled_rides_are_as_one(seed):
    rng = np.random.default_rng(seed)
    every = {"all": {"all": np.ones(300, dtype=bool)}}
    measured, simulated = rng.normal(20, 30, (2, 300))
    cut = int(rng.integers(30, 270))
    parts = [
        split(m, s, {"all": {"all": np.ones(len(m), dtype=bool)}})["all"]["all"]
        for m, s in ((measured[:cut], simulated[:cut]), (measured[cut:], simulated[cut:]))
    ]
    whole = pooled([split(measured, simulated, every)["all"]["all"]])
    assert asdict(pooled(parts)) == pytest.approx(asdict(whole) | {"rides": 2})


def test_a_bias_in_turns_is_found_there():
    measured = ride(900)
    found, _ = conditions(measured)
    power = np.full(900, 500.0)
    short = power - 100 * found["turning"]["turning"]
    splits = {"predictive": {"pack_power": split(power, short, found)}}
    entry: Any = SimpleNamespace(on_dynamometer=False, splits=splits)
    table = {(by, kind): cells[0] for by, kind, _, cells in failures(pool([entry])["road"])}
    assert COLUMNS[0][:2] == ("predictive", "pack_power")
    assert table["turning", "turning"] == pytest.approx((-100, -20))
    assert table["turning", "straight"] == pytest.approx((0, 0))


# --- a recorded ride ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def city():
    vehicle = read_vehicle("reference", 75.0)
    recorded = read_recorded(LOGS / "city_34C.blf", vehicle)
    road = recorded.road()
    measured = per_second(recorded)
    place = block_means(recorded.signals["distance"], 100)
    return vehicle, measured | {"grade": np.array([road(at)[0] for at in place])}, rest_soc(recorded, vehicle)


def changed(vehicle, **values):
    parameters = vehicle.parameters.replaced(**values)
    return replace(vehicle, parameters=parameters, model=Model(vehicle.model.effects, parameters))


def alone(city, name, **values):
    vehicle, measured, soc = city
    c = components(changed(vehicle, **values), measured, soc, 30.0, None)[name]
    return errors(c.measured[c.valid], c.modelled[c.valid], c.quantity, 10.0)


def test_components_of_the_right_model(city):
    assert alone(city, "battery_voltage").percent < 1
    assert alone(city, "battery_voltage").of_spread < 0.5
    assert alone(city, "inverter_power").percent < 5
    assert alone(city, "motor_torque").passed
    assert alone(city, "cell_temperature").max < 3


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
    right, wrong = alone(city, component), alone(city, component, **change)
    assert wrong.rms > 1.2 * right.rms
    if component in ("inverter_power", "motor_torque"):
        assert wrong.percent > right.percent + 3


def test_current_is_that_which_flows(city):
    vehicle, *_ = city
    log = LOGS / "coastdown.blf"
    recorded = read_recorded(log, vehicle)
    columns = read_samples(log, vehicle).columns
    grid = np.arange(columns["motor_speed"][0][0], columns["motor_speed"][0][-1], recorded.dt)
    raw = block_means(np.interp(grid, *columns["pack_current"]), 100)
    p = vehicle.parameters
    flows = per_second(recorded)["pack_current"]
    assert flows * p["pack_current_gain"] + p["pack_current_offset"] == pytest.approx(raw)


def test_effects_in_the_cells_count(city):
    """A second RC pair takes off its resistance times the mean current, once it has settled."""
    vehicle, measured, soc = city
    known = dict(vehicle.parameters.known)
    known["slow_resistance"] = replace(known["slow_resistance"], value=0.01)
    known["slow_time"] = replace(known["slow_time"], value=1.0)
    parameters = Parameters(known)
    whole = replace(vehicle, parameters=parameters, model=Model(vehicle.model.effects, parameters))
    effects = tuple(effect for effect in vehicle.model.effects if effect.name != "slow_relaxation")
    without = replace(vehicle, parameters=parameters, model=Model(effects, parameters))
    first, second = (
        components(v, measured, soc, 30.0, None)["battery_voltage"].modelled.mean() for v in (without, whole)
    )
    cells = vehicle.battery.cells_series * measured["pack_current"].mean() / vehicle.battery.cells_parallel
    assert first - second == pytest.approx(0.01 * cells, rel=0.02)


def reference(city, **values):
    vehicle, measured, soc = city
    modelled = components(vehicle, measured, soc, 30.0, None)["battery_voltage"].modelled
    return soc_reference(vehicle, measured | values, soc, modelled)


def test_what_the_state_of_charge_is_compared_with(city):
    vehicle, measured, soc = city
    found = reference(city)
    assert found.start == pytest.approx(100 * soc)
    assert found.start - found.drawn == pytest.approx(100 * measured["soc"][-1])
    charge = measured["pack_current"].sum() / 3600
    assert found.drawn == pytest.approx(100 * charge / vehicle.battery.pack_capacity(34.0), rel=0.02)
    assert 0.005 < found.drawn_sd / found.drawn < 0.02  # of a current sensor and a capacity known to a percent
    assert abs(found.voltage_says) < 2 * found.voltage_sd
    assert reference((vehicle, {k: v for k, v in measured.items() if k != "soc"}, soc)) is None


def test_a_voltage_that_is_off_speaks_against_the_count(city):
    vehicle, measured, _ = city
    slope = vehicle.battery.ocv(float(measured["soc"][-120:].mean()))[1]
    more = measured["pack_voltage"] + 0.03 * slope * vehicle.battery.cells_series
    assert reference(city, pack_voltage=more).voltage_says - reference(city).voltage_says == pytest.approx(3.0)


def test_charge_is_judged_by_what_was_drawn():
    counted = CHANNELS["soc"].shown(np.linspace(0.8, 0.6, 50))
    assert errors(counted, counted + 2, CHANNELS["soc"], 20.0).percent == pytest.approx(10.0)
    little = CHANNELS["soc"].shown(np.linspace(0.8, 0.79, 50))
    assert errors(little, little + 2, CHANNELS["soc"], 20.0).percent == pytest.approx(40.0)


# --- the command --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """(folder, summary, text) of the coast-down twice, in two processes."""
    folder = tmp_path_factory.mktemp("validate")
    other = folder / "other"
    other.mkdir()
    shutil.copy(LOGS / "coastdown.blf", other / "coastdown.blf")
    (other / "rides.json").write_text('[{"name": "coastdown", "kind": "roll", "rider_mass_kg": 75.0}]')
    out = folder / "out"
    logs = [str(LOGS / "coastdown.blf"), str(other / "coastdown.blf")]
    files = ["--json", str(folder / "v.json"), "--markdown", str(folder / "v.md"), "--output", str(out)]
    with contextlib.redirect_stdout(io.StringIO()) as text:
        assert main(["validate", *logs, *files, "--jobs", "2"]) == 0
    return out, json.loads((folder / "v.json").read_text()), text.getvalue()


def test_the_summary_has_its_keys(two):
    _, summary, _ = two
    assert summary["version"] == 1
    assert summary["failed"] == []
    first, second = summary["rides"]
    assert set(first) == set(KEYS) - {"channels", "energy_percent", "pack_empty"}
    assert set(first["open_loop"]) == {"channels", "energy_percent", "pack_empty", "passed"}
    assert first["open_loop"]["pack_empty"] is None
    assert set(first["open_loop"]["channels"]) == set(CHANNELS) - {"throttle"}
    assert set(first["predictive"]["channels"]) == set(CHANNELS)
    assert second["kind"] == "roll"
    assert second["payload_kg"] == 75.0
    assert {e["limit_percent"] for e in first["components"]["channels"].values()} == {10.0}
    assert {e["limit_percent"] for e in first["predictive"]["channels"].values()} == {20.0}
    assert first["passed"] == all(first[form]["passed"] for form in ("open_loop", "predictive", "components"))
    assert first["energy_wh"] == pytest.approx(second["energy_wh"])


@pytest.fixture(scope="module")
def smaller(tmp_path_factory):
    """(summary, text, tables) of a simulated ride against its own file, and against a seventh of its charge."""
    folder = tmp_path_factory.mktemp("smaller")
    rows = [f"{t},{min(max(2 * t - 20, 0), 40)}" for t in range(0, 250, 10)]
    (folder / "hold.csv").write_text("\n".join(["time_s,speed_kmh", *rows]))
    log, out = folder / "hold.blf", ["--quiet", "--no-plot", "--output", str(folder)]
    assert main(["simulate", str(folder / "hold.csv"), "--soc", "0.2", "--frames", str(log), "--no-series", *out]) == 0
    own = (OWN / "reference.toml").read_text()
    assert "cell_capacity = { value = 2.73361," in own
    (folder / "seventh.toml").write_text(
        own.replace("cell_capacity = { value = 2.73361,", "cell_capacity = { value = 0.4,")
    )
    found = {}
    for name in ("reference", str(folder / "seventh.toml")):
        files = ["--json", str(folder / "v.json"), "--markdown", str(folder / "v.md")]
        with contextlib.redirect_stdout(io.StringIO()) as text:
            assert main(["validate", str(log), "--vehicle", name, "--payload", "80", *files, *out]) == 0
        ride = json.loads((folder / "v.json").read_text())["rides"][0]
        found[Path(name).stem] = ride, " ".join(text.getvalue().split()), (folder / "v.md").read_text()
    return found


@pytest.mark.parametrize("form", ["open_loop", "predictive"])
def test_energy_is_compared_until_the_simulated_pack_is_empty(smaller, form):
    """That the ride went on without it is told, and is no error of the energy."""
    whole, part = smaller["reference"][0], smaller["seventh"][0]
    end = part[form]["pack_empty"]
    assert whole[form]["pack_empty"] is None
    assert 60 < end["compared_s"] < end["time_s"] < 220 < part["duration_s"]
    assert 0.3 < end["distance_km"] < 0.0112 * end["time_s"]
    assert -0.01 < end["soc"] < 0.08  # below which the controller of this vehicle holds back
    assert abs(whole[form]["energy_percent"]) < 3
    assert part[form]["energy_percent"] == pytest.approx(whole[form]["energy_percent"], abs=5)
    assert sum(kind["seconds"] for kind in part["splits"][form]["pack_power"]["speed"].values()) <= end["compared_s"]
    assert not part["passed"]  # the pack that ends too soon is an error of the model all the same


def test_where_the_simulated_pack_is_empty_is_told(smaller):
    assert "simulated pack is empty" not in smaller["reference"][1]
    ride, text, _ = smaller["seventh"]
    for form, name in (("open_loop", "open loop"), ("predictive", "rider model")):
        end = ride[form]["pack_empty"]
        seconds, until = f"{end['time_s']:.0f} s", f"{end['compared_s']:.0f} s"
        energy = f"{ride[form]['energy_percent']:+.1f}"
        assert f"{name} energy {energy} % until {until}; the simulated pack is empty at {seconds}" in text
        assert f"{name}: the simulated pack is empty at {seconds} of {ride['duration_s']:.0f}" in text
        assert any(found.startswith(f"{name}: the simulated pack is empty") for found in ride["missing"])
        assert f"are compared until {until}, where the controller holds back" in text


def test_pictures_and_page(two):
    out, summary, _ = two
    for entry in summary["rides"]:
        assert Path(entry["plot"]).stat().st_size > 50_000
    page = (out / "validation.html").read_text()
    assert page.count("data:image/png;base64,") == 2
    assert "://" not in page
    assert "Where the model fails" in page
    assert "class=bad" in page


def test_what_fails_is_told_with_its_limit_and_meaning(two):
    text = two[2].partition(two[1]["rides"][1]["file"])[0].splitlines()
    (load,) = [line for line in text if "FAIL (" in line and "road load" in line]
    assert "FAIL (limit 10 %) rms" in load
    forms = [form["channels"] for form in two[1]["rides"][0].values() if isinstance(form, dict) and "channels" in form]
    failing = sum(any(not channel["passed"] for channel in channels.values()) for channels in forms)
    assert [line.split(":")[0] for line in text if "FAIL:" in line] == ["    FAIL"] * failing
    assert failing >= 1
    assert any("docs/results/validation.md" in line for line in text)


def test_tables_as_markdown(two):
    out, summary, _ = two
    text = (out.parent / "v.md").read_text()
    channels = [ride["components"]["channels"] for ride in summary["rides"]]
    passed = sum(one["road_load"]["passed"] for one in channels)
    row = next(line for line in text.splitlines() if line.startswith("| road load |"))
    assert (f"**{passed} of {len(channels)}**" if passed < len(channels) else f"{passed} of {len(channels)}") in row
    assert "### Beside the thesis" in text


def test_the_thesis_stands_beside_it(two):
    out, summary, text = two
    rides = summary["rides"]
    table = (out.parent / "v.md").read_text().partition("### Beside the thesis")[2].partition("###")[0]
    rows = {cells[1]: cells for cells in (re.split(r" *\| *", line) for line in table.splitlines()) if len(cells) > 6}
    worst = max(ride["components"]["channels"]["motor_temperature"]["max"] for ride in rides)
    assert rows["motor temperature"][2:5] == ["±10 K", "fig. 2.25, bench, p. 44", f"{worst:.2g} K"]
    cell = max(ride["components"]["channels"]["battery_voltage"]["max"] for ride in rides) / 14
    assert rows["voltage of a cell"][4] == f"{cell:.2g} V"
    assert rows["voltage of a cell"][6] == ("yes" if cell <= 0.02 else "**no**")
    assert not any("dynamometer" in what for what in rows)  # of none was one
    lines = [line for line in text.splitlines() if "thesis ±0.02 V a cell" in line]
    assert len(lines) == len(rides)
    assert all("(limit 10 %)" in line for line in lines)


def test_what_stands_above_the_mark_stays(tmp_path):
    page = tmp_path / "page.md"
    write_below(page, "a", "first\n")
    assert page.read_text() == "first\n"
    page.write_text(f"by hand\n\n{mark_of('a')}\nold\n")
    write_below(page, "a", "new\n")
    assert page.read_text() == f"by hand\n\n{mark_of('a')}\n\nnew\n"
    write_below(page, "b", "all of it\n")
    assert page.read_text() == "all of it\n"


def test_each_condition_has_its_place_in_tables():
    found, _ = conditions(ride(400))
    assert [kind for by in LABELS for kind in found[by]] == list(ORDER)


def test_a_repeated_run_is_the_same(two, capsys):
    _, summary, _ = two
    arguments = ["validate", str(LOGS / "coastdown.blf"), "--payload", "75", "--json", "--no-plot", "--gate"]
    status = main(arguments)
    found = json.loads(capsys.readouterr().out)["rides"][0]
    assert status == (0 if found["passed"] else 1)
    twin = summary["rides"][1]
    for form in ("open_loop", "predictive", "components"):
        assert found[form] == twin[form]


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
    assert "turning" not in found["splits"]["predictive"]["pack_power"]
    assert any("no throttle" in text for text in found["missing"])
    assert any("yaw rate" in text for text in found["missing"])


@pytest.mark.parametrize("plot", [[], ["--no-plot"]])
def test_a_ride_of_which_nothing_can_be_compared_has_not_passed(tmp_path, capsys, plot):
    (tmp_path / "ride.csv").write_text("time [s],speed [m/s]\n" + "".join(f"{t},5\n" for t in range(40)))
    assert main(["validate", str(tmp_path / "ride.csv"), "--output", str(tmp_path), *plot]) == 2
    out = capsys.readouterr()
    assert "ride.csv: nothing in it can be compared with its simulation: it has none of battery current" in out.err
    assert "passed" not in out.out


@pytest.mark.parametrize(
    ("moving", "said"), [(0, "only stands, for all of its 39 s"), (9, "moves for only 10 of its 39 s")]
)
def test_a_log_without_riding_is_not_judged(tmp_path, capsys, moving, said):
    rows = "".join(f"{t},{5 if 10 < t <= 10 + moving else 0.1},50\n" for t in range(40))
    (tmp_path / "halt.csv").write_text(f"time [s],speed [m/s],pack_voltage [V]\n{rows}")
    assert main(["validate", str(tmp_path / "halt.csv"), "--output", str(tmp_path), "--no-plot"]) == 2
    out = capsys.readouterr()
    assert f"halt.csv: the vehicle {said}: there is no riding to judge; at least 20 s of it\n" in out.err
    assert "passed" not in out.out


def test_bad_input(tmp_path, capsys):
    other = tmp_path / "other.log"
    other.write_text("(1.000000) can0 7AB#0011223344556677\n(1.010000) can0 7AB#0011223344556677\n")
    none = tmp_path / "none.blf"
    assert main(["validate", str(other), str(none), "--jobs", "1", "--no-plot", "--output", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "knows none" in said
    assert "none.blf" in said
    assert main(["validate", str(other), "--jobs", "0"]) == 2
    assert main(["validate", "--vehicle", "refrence", str(other)]) == 2
    assert "did you mean 'reference'" in capsys.readouterr().err
    assert main(["validate", str(other), "--json", "ride.blf"]) == 2
    assert "name of a log" in capsys.readouterr().err
