"""The extended vehicle file: read again as it was meant, and used by all that rides."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gz_onboard.cli import main
from gz_onboard.discovery.curves import CONSTANT, hat_functions
from gz_onboard.discovery.extend import MODELLED, curve_effect, write_model
from gz_onboard.discovery.judgement import ParameterEstimate, Unknown, energy_share
from gz_onboard.discovery.mixed_model import LinearRide, MixedModel, linearise_all
from gz_onboard.discovery.mixed_model import initial as known_from
from gz_onboard.estimator.forecast import Forecaster
from gz_onboard.model.effect import load_effect
from gz_onboard.model.model import Bound
from gz_onboard.recording.recording import read_recording
from gz_onboard.vehicle import find_vehicle, read_vehicle
from tests.discovery.material import CURVE, KNOTS, cause, cornering, discovered, rolling
from tests.support import LOGS

REFERENCE = find_vehicle("reference")


@pytest.fixture(scope="module")
def lines(mixed: MixedModel) -> list[LinearRide]:
    return linearise_all([mixed.ride(read_recording(LOGS / "coastdown.blf", mixed.vehicle))], mixed)


def test_causes_become_effects_and_parameters(mixed, lines, tmp_path: Path):
    out = tmp_path / "new.toml"
    wind = cause("headwind", "wind_north", 3.0, 1.0, 3.0, "m/s")
    wind.parameters["wind_east"] = ParameterEstimate(-1.0, (-2.0, 0.0), "m/s")
    often = replace(cause("auxiliary_load", "auxiliary_power", 90.0, 1.0, 40.0, "W"), varies=True)
    words = write_model(discovered(mixed, lines, cornering(), rolling(), wind, often), mixed.vehicle, out)
    assert words[0] == str(out)
    before, after = mixed.vehicle, read_vehicle(str(out))
    assert [e.name for e in after.model.effects][len(before.model.effects) :] == ["cornering_drag", "headwind"]
    expected = {
        "cornering_compliance": 0.25,
        "rolling_resistance_constant": 0.015,
        "wind_north": 3.0,
        "wind_east": -1.0,
    }
    assert {name: after.parameters[name] for name in expected} == expected
    # the interval is two-sided 95 % of Student's t with 4 degrees of freedom: 2.776 of these to either side
    assert after.parameters.sd("cornering_compliance") == pytest.approx(0.05 / 2.776, rel=1e-3)
    value = after.parameters.known["cornering_compliance"]
    assert value.status == "measured" and "cornering_drag" in value.source and "coastdown" in value.source
    assert any("cornering_compliance = 0.25" in word for word in words)
    for name in before.parameters.known.keys() - expected.keys():
        assert after.parameters.known[name] == before.parameters.known[name]


@pytest.mark.parametrize("healthy", [0, 5])
def test_an_effect_missing_in_the_file_leaves_the_forecast_factor(mixed, lines, tmp_path: Path, healthy: int):
    """factor / (1 + s·factor): measured energy stays, and the model now gives s of it more. Not after a baseline: the
    factor was measured on a vehicle that had not yet changed.
    """
    out = tmp_path / "new.toml"
    (place,) = mixed.index(["rolling_resistance_constant"])
    change = np.zeros(len(mixed.names))
    change[place] = 0.0033 / mixed.scale[place]
    share = energy_share(lines, change, MODELLED)
    write_model(discovered(replace(mixed, healthy=healthy), lines, rolling()), mixed.vehicle, out)
    before, after = mixed.vehicle.riding, read_vehicle(str(out)).riding
    if healthy:
        assert after == before
        return
    assert share > 0.01
    assert after == replace(before, factor=pytest.approx(before.factor / (1 + share * before.factor), rel=1e-5))
    source = tomllib.loads(out.read_text())["forecast"]["source"]
    assert f"{share:.1%}" in source and tomllib.loads(REFERENCE.read_text())["forecast"]["source"] in source


def test_a_sensors_error_is_no_energy(mixed, lines, tmp_path: Path):
    gain = cause("current_sensor_gain", "pack_current_gain", 1.03, 0.01, 0.02)
    write_model(discovered(mixed, lines, gain), mixed.vehicle, tmp_path / "new.toml")
    assert read_vehicle(str(tmp_path / "new.toml")).riding == mixed.vehicle.riding


@pytest.mark.parametrize("quantity", ["speed", "acceleration", "heading", "time", "lateral_acceleration", "vibration"])
def test_the_empirical_effect_is_the_curve(mixed, tmp_path: Path, quantity: str):
    top = 6.0 if quantity == "heading" else 12.0
    knots = tuple((at * top / 12, value, sd) for at, value, sd in KNOTS)
    written = curve_effect(replace(CURVE, quantity=quantity, curve=knots), mixed, 1)
    assert written is not None
    name, text = written
    (tmp_path / f"{name}.py").write_text(text)
    effect = load_effect(name, tmp_path)
    assert effect.port.name == "WHEEL_FORCE"
    x = np.linspace(0, 6.2 if quantity == "heading" else 15, 40)
    at, values, _ = np.array(knots).T
    expected = hat_functions(x, at, quantity == "heading") @ values
    speed = x if quantity == "speed" else np.full(len(x), 30.0)
    reads = {q: speed if q == "speed" else x for q in effect.term.quantities}
    fade = speed**2 / (speed**2 + 1)
    bound = Bound(effect, {f"{name}_scale": 1.0})
    assert bound(reads) == pytest.approx(expected * fade, abs=1e-4)
    assert bound({q: float(v[7]) for q, v in reads.items()}) == pytest.approx(expected[7] * fade[7], abs=1e-4)


def test_a_constant_is_called_one_and_can_be_modelled(mixed, tmp_path: Path):
    unknown = Unknown("pack_power", CONSTANT, False, "1", 80.0, 80.0, ((0.0, -129.1, 14.9),))
    assert str(unknown).startswith("a constant pack power, -129.1 ± 15 W")
    written = curve_effect(unknown, mixed, 2)
    assert written is not None
    (tmp_path / f"{written[0]}.py").write_text(written[1])
    effect, scale = load_effect(written[0], tmp_path), {f"{written[0]}_scale": 1.0}
    assert [effect.term.function(v, **scale) for v in (0.0, 0.5, 20.0)] == pytest.approx([-129.1] * 3)


def test_nothing_is_written_without_anything_to_add(mixed, lines, tmp_path: Path):
    unreadable = discovered(mixed, lines, unknown=replace(CURVE, quantity="current_change"))
    for found, words in ((unreadable, "no effect can read current_change"), (discovered(mixed, lines), "nothing to")):
        said = write_model(found, mixed.vehicle, tmp_path / "new.toml")
        assert words in " ".join(said)
        assert not list(tmp_path.iterdir())


def test_effects_of_the_users_own_go_along(mixed, lines, tmp_path: Path):
    own, there = tmp_path / "mine", tmp_path / "there"
    own.mkdir()
    there.mkdir()
    (own / "top_box.py").write_text(
        "from gz_onboard.model.effect import Parameter, Port\nPORT = Port.WHEEL_FORCE\n"
        'PARAMETERS = (Parameter("box_area", "m²", 0.04, 0.03, 0.0, 0.3, "a guess"),)\n'
        "def term(speed, air_density, *, box_area):\n    return air_density * box_area * speed * speed / 2\n"
    )
    known = known_from(mixed.vehicle, own)
    box = cause("top_box", "box_area", 0.06, 0.01, 0.06, "m²")
    found = discovered(known, linearise_all([line.ride for line in lines], known), box, unknown=CURVE)
    write_model(found, mixed.vehicle, there / "new.toml")
    (own / "top_box.py").unlink()  # what was written stands alone
    after = read_vehicle(str(there / "new.toml"))
    assert [e.name for e in after.model.effects][-2:] == ["top_box", "empirical_road_force_speed"]
    assert after.parameters["box_area"] == 0.06


def test_estimate_simulation_and_forecast_use_it(mixed, lines, tmp_path: Path, capsys):
    out = tmp_path / "new.toml"
    write_model(discovered(mixed, lines, cornering(), unknown=CURVE), mixed.vehicle, out)
    ride, quiet = str(LOGS / "coastdown.blf"), ["--vehicle", str(out), "--no-plot"]
    assert main(["estimate", ride, *quiet, "--output", str(tmp_path)]) == 0
    assert main(["simulate", "wmtc_part1", *quiet, "--no-series"]) == 0
    assert "empirical road force speed" in capsys.readouterr().out
    ranges = []
    for vehicle in (mixed.vehicle, read_vehicle(str(out))):
        riding = replace(vehicle.riding, factor=1.0)  # it was lowered for this
        ranges.append(Forecaster(vehicle.model, vehicle.pack, riding).forecast(0.8, 0.01, 20.0, 1.0, 20.0, 0.0).range)
    assert ranges[1] < 0.97 * ranges[0]
