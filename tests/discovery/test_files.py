"""The vehicle files that discovery writes: read again as they were meant, and used by all that rides."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gz_onboard.calibration.vehicle_file import write_vehicle
from gz_onboard.cli import main
from gz_onboard.discovery.baseline import adopted
from gz_onboard.discovery.baseline_file import load, restore, write_baseline
from gz_onboard.discovery.curve_forms import hat_functions
from gz_onboard.discovery.energy import energy_share
from gz_onboard.discovery.extension import MODELLED, curve_text, write_model
from gz_onboard.discovery.linear import LinearRide
from gz_onboard.discovery.mixed_model import HealthyCurve, MixedModel, initial, linearise_all
from gz_onboard.discovery.prior import LOG_SCALED
from gz_onboard.discovery.result import FoundCause, Gain, Isolability, ParameterEstimate, Report, Unknown
from gz_onboard.discovery.verdict import Discovery
from gz_onboard.errors import InputError
from gz_onboard.estimator.forecast import Forecaster
from gz_onboard.model.effect import load_effect
from gz_onboard.model.model import Bound
from gz_onboard.offline.samples import read_samples
from gz_onboard.vehicle import find_vehicle, read_vehicle
from tests.support import LOGS

REFERENCE = find_vehicle("reference")
KNOTS = ((0.0, -4.0, 1.0), (4.0, 1.0, 1.0), (8.0, 6.0, 2.0), (12.0, 2.0, 1.0))
CURVE = Unknown("road_force", "speed", False, "m/s", 40.0, 40.0, KNOTS, share=0.03)


@pytest.fixture(scope="module")
def mixed() -> MixedModel:
    return initial(read_vehicle("reference"))


@pytest.fixture(scope="module")
def lines(mixed: MixedModel) -> list[LinearRide]:
    return linearise_all([mixed.ride(read_samples(LOGS / "coastdown.blf", mixed.vehicle))], mixed)


def report(
    mixed: MixedModel, lines: list[LinearRide], *causes: FoundCause, unknown: Unknown | None = None
) -> Discovery:
    verdict = "unknown" if unknown else "cause"
    isolability = Isolability({}, [], [])
    plain = Report(verdict, list(causes), [], unknown, [], {}, Gain(), [], [], isolability, 15.0)
    return Discovery(plain, mixed, np.zeros(len(mixed.names)), lines, [])


def cornering(share: float = 0.04) -> FoundCause:
    return FoundCause("cornering_drag", "cornering_compliance", 0.25, "rad", (0.2, 0.3), 0.25, share, 70.0)


def rolling() -> FoundCause:
    return FoundCause(
        "rolling_resistance", "rolling_resistance_constant", 0.015, "1", (0.014, 0.016), 0.0033, 0.1, 50.0
    )


def wind() -> FoundCause:
    others = {"wind_east": ParameterEstimate(-1.0, (-2.0, 0.0))}
    return FoundCause("headwind", "wind_north", 3.0, "m/s", (2.0, 4.0), 3.0, 0.01, 30.0, parameters=others)


def test_causes_become_effects_and_parameters(mixed, lines, tmp_path: Path):
    out = tmp_path / "new.toml"
    found = report(mixed, lines, cornering(), rolling(), wind())
    words = write_model(found, mixed.vehicle, REFERENCE, out)
    assert found.report.extended_model == str(out)
    before, after = mixed.vehicle, read_vehicle(str(out))
    added = [e.name for e in after.model.effects][len(before.model.effects) :]
    assert added == ["cornering_drag", "headwind"]
    assert after.parameters["cornering_compliance"] == 0.25
    assert after.parameters["rolling_resistance_constant"] == 0.015
    assert (after.parameters["wind_north"], after.parameters["wind_east"]) == (3.0, -1.0)
    # the interval is two-sided 95 % of Student's t with 4 degrees of freedom: 2.776 of these to either side
    assert after.parameters.sd("cornering_compliance") == pytest.approx(0.05 / 2.776, rel=1e-3)
    value = after.parameters.known["cornering_compliance"]
    assert value.status == "measured"
    assert "cornering_drag" in value.source and "coastdown" in value.source
    assert any("cornering_compliance = 0.25" in word for word in words)
    untouched = {
        n
        for n in before.parameters.known
        if n not in {"cornering_compliance", "rolling_resistance_constant", "wind_north", "wind_east"}
    }
    assert all(after.parameters.known[name] == before.parameters.known[name] for name in untouched)


def test_what_the_model_lacked_leaves_the_forecast_factor(mixed, lines, tmp_path: Path):
    """factor / (1 + s·factor): measured energy stays what it is while the model now gives s of it more."""
    out = tmp_path / "new.toml"
    found = report(mixed, lines, rolling())
    change = np.zeros(len(mixed.names))
    place = mixed.names.index("rolling_resistance_constant")
    change[place] = 0.0033 / mixed.scale[place]
    share = energy_share(found.lines, change, MODELLED)
    assert share > 0.01
    write_model(found, mixed.vehicle, REFERENCE, out)
    before, after = mixed.vehicle.riding, read_vehicle(str(out)).riding
    assert after == replace(before, factor=pytest.approx(before.factor / (1 + share * before.factor), rel=1e-5))
    source = tomllib.loads(out.read_text())["forecast"]["source"]
    assert f"{share:.1%}" in source and f"{before.factor:g}" in source
    assert tomllib.loads(REFERENCE.read_text())["forecast"]["source"] in source


def test_what_came_on_top_of_healthy_rides_does_not(mixed, lines, tmp_path: Path):
    """The factor was measured on a vehicle that had not yet changed."""
    out = tmp_path / "new.toml"
    write_model(report(replace(mixed, healthy=5), lines, rolling()), mixed.vehicle, REFERENCE, out)
    assert read_vehicle(str(out)).riding == mixed.vehicle.riding


def test_a_sensors_error_is_no_energy(mixed, lines, tmp_path: Path):
    out = tmp_path / "new.toml"
    gain = FoundCause("current_sensor_gain", "pack_current_gain", 1.03, "1", (1.02, 1.04), 0.02, 0.02, 50.0)
    write_model(report(mixed, lines, gain), mixed.vehicle, REFERENCE, out)
    assert read_vehicle(str(out)).riding == mixed.vehicle.riding


def test_a_value_beyond_its_bounds_is_written_at_the_bound(mixed, lines, tmp_path: Path):
    out = tmp_path / "new.toml"
    write_model(report(mixed, lines, replace(cornering(), value=0.9)), mixed.vehicle, REFERENCE, out)
    assert read_vehicle(str(out)).parameters["cornering_compliance"] == 0.5


@pytest.mark.parametrize("quantity", ["speed", "acceleration", "heading", "time", "lateral_acceleration", "vibration"])
def test_the_empirical_effect_is_the_curve(mixed, lines, tmp_path: Path, quantity: str):
    top = 6.0 if quantity == "heading" else 12.0
    knots = tuple((at * top / 12, value, sd) for at, value, sd in KNOTS)
    written = curve_text(report(mixed, lines, unknown=replace(CURVE, quantity=quantity, curve=knots)))
    assert written is not None
    name, text = written
    (tmp_path / f"{name}.py").write_text(text)
    effect = load_effect(name, tmp_path)
    assert effect.port.name == "WHEEL_FORCE"
    scale = {f"{name}_scale": 1.0}
    x = np.linspace(0, 6.2 if quantity == "heading" else 15, 40)
    at, values, _ = np.array(knots).T
    expected = hat_functions(x, at, quantity == "heading") @ values
    fast = {"speed": x if quantity == "speed" else np.full(len(x), 30.0)}
    reads = {q: fast["speed"] if q == "speed" else x for q in effect.term.quantities}
    fade = fast["speed"] ** 2 / (fast["speed"] ** 2 + 1)
    assert Bound(effect, scale)(reads) == pytest.approx(expected * fade, abs=1e-4)
    one = {q: float(v[7]) for q, v in reads.items()}  # on board: floats
    assert Bound(effect, scale)(one) == pytest.approx(expected[7] * fade[7], abs=1e-4)


def test_a_curve_that_no_effect_can_read_is_not_written(mixed, lines, tmp_path: Path):
    found = report(mixed, lines, unknown=replace(CURVE, quantity="current_change"))
    words = write_model(found, mixed.vehicle, REFERENCE, tmp_path / "new.toml")
    assert found.report.extended_model is None
    assert "no effect can read current_change" in words[0]
    assert not list(tmp_path.iterdir())


def test_effects_of_the_users_own_go_along(mixed, lines, tmp_path: Path):
    own = tmp_path / "mine"
    own.mkdir()
    (own / "top_box.py").write_text(
        "from gz_onboard.model.effect import Parameter, Port\nPORT = Port.WHEEL_FORCE\n"
        'PARAMETERS = (Parameter("box_area", "m²", 0.04, 0.03, 0.0, 0.3, "a guess"),)\n'
        "def term(speed, air_density, *, box_area):\n    return air_density * box_area * speed * speed / 2\n"
    )
    there = tmp_path / "there"
    there.mkdir()
    known = initial(mixed.vehicle, own)
    box = FoundCause("top_box", "box_area", 0.06, "m²", (0.05, 0.07), 0.06, 0.03, 30.0)
    found = report(known, linearise_all([line.ride for line in lines], known), box, unknown=CURVE)
    write_model(found, mixed.vehicle, REFERENCE, there / "new.toml")
    (own / "top_box.py").unlink()  # what was written stands alone
    after = read_vehicle(str(there / "new.toml"))
    assert [e.name for e in after.model.effects][-2:] == ["top_box", "empirical_road_force_speed"]
    assert after.parameters["box_area"] == 0.06


@pytest.fixture(scope="module")
def extended(mixed, lines, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("extended") / "new.toml"
    write_model(report(mixed, lines, cornering(), unknown=CURVE), mixed.vehicle, REFERENCE, out)
    return out


def test_estimate_uses_it_unchanged(extended: Path, tmp_path: Path, capsys):
    out = str(tmp_path)
    assert (
        main(["estimate", str(LOGS / "coastdown.blf"), "--vehicle", str(extended), "--no-plot", "--output", out]) == 0
    )


def test_simulate_has_it_in_the_ledger(extended: Path, capsys):
    assert main(["simulate", "wmtc_part1", "--vehicle", str(extended), "--no-series", "--no-plot"]) == 0
    assert "empirical road force speed" in capsys.readouterr().out


def test_the_forecast_on_board_knows_it(extended: Path):
    ranges = []
    for vehicle in (read_vehicle("reference"), read_vehicle(str(extended))):
        # the factor apart, which was lowered for this
        riding = replace(vehicle.riding, factor=1.0)
        ranges.append(Forecaster(vehicle.model, vehicle.pack, riding).forecast(0.8, 0.01, 20.0, 1.0, 20.0, 0.0).range)
    assert ranges[1] < 0.97 * ranges[0]


# --- baseline -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def learned(mixed: MixedModel) -> MixedModel:
    n = len(mixed.names)
    rng = np.random.default_rng(4)
    shape = HealthyCurve(rng.normal(size=8), np.eye(8), 1.3)
    return replace(
        mixed,
        mean=rng.normal(size=n) * 0.1,
        prior=np.diag(rng.uniform(0.5, 1, n)),
        scatter=rng.uniform(0.5, 1, n),
        healthy=7,
        inflation={"headwind": 1.4},
        shapes={"road_force over speed": shape},
    )


def test_a_baseline_is_read_as_it_was_written(learned: MixedModel, tmp_path: Path):
    out = tmp_path / "base.toml"
    vehicle = adopted(learned.vehicle, learned, learned)
    write_baseline(vehicle, REFERENCE, out)
    again = read_vehicle(str(out))
    assert again.healthy == tmp_path / "base.healthy.npz"
    for name, value in vehicle.parameters.known.items():
        if value.source.startswith("prior:"):  # it follows those that are in the file
            continue
        assert again.parameters[name] == pytest.approx(value.value, rel=1e-5)
    restored = restore(again)
    assert restored.names == learned.names
    assert restored.healthy == 7
    assert restored.noise == learned.noise
    assert restored.inflation == learned.inflation
    for field in ("mean", "prior", "scatter", "scale"):
        assert getattr(restored, field) == pytest.approx(getattr(learned, field))
    assert {n: restored.values[n] for n in learned.names} == {n: learned.values[n] for n in learned.names}
    pair = restored.shapes["road_force over speed"]
    assert (pair.mean.tolist(), pair.inflation) == (learned.shapes["road_force over speed"].mean.tolist(), 1.3)


def test_once_more_gives_one_healthy_table(learned: MixedModel, tmp_path: Path):
    first, second = tmp_path / "one.toml", tmp_path / "two.toml"
    write_baseline(adopted(learned.vehicle, learned, learned), REFERENCE, first)
    again = read_vehicle(str(first))
    write_baseline(adopted(again, replace(learned, vehicle=again, healthy=9), learned), first, second)
    assert tomllib.loads(second.read_text())["healthy"] == {"file": "two.healthy.npz", "rides": 9}


def test_the_extended_model_is_calibrated_about_what_was_found(learned: MixedModel, lines, tmp_path: Path):
    """Also elsewhere: in a folder without the baseline's files."""
    base, out = tmp_path / "base.toml", tmp_path / "there" / "new.toml"
    out.parent.mkdir()
    write_baseline(adopted(learned.vehicle, learned, learned), REFERENCE, base)
    growth = FoundCause("resistance_growth", "cell_resistance_factor", 1.4, "1", (1.2, 1.6), 0.4, 0.0, 70.0)
    write_model(report(learned, lines, cornering(), growth), read_vehicle(str(base)), base, out)
    before, after = restore(read_vehicle(str(base))), restore(read_vehicle(str(out)))
    assert after.healthy == 7 and after.inflation == before.inflation and after.noise == before.noise
    assert after.scatter == pytest.approx(before.scatter)
    now = after.values_at(after.mean)
    sd = np.sqrt(np.diag(after.prior)) * after.scale
    for cause in (cornering(), growth):
        name = cause.parameter
        (i,) = after.index([name])
        assert now[name] == pytest.approx(cause.value) == pytest.approx(after.healthy_value(name))
        wide = (cause.ci95[1] - cause.ci95[0]) / 2 / learned.quantile
        assert sd[i] * (cause.value if name in LOG_SCALED else 1.0) == pytest.approx(wide)
        assert np.count_nonzero(after.prior[i]) == 1
    kept = [n for n in before.names if n not in ("cornering_compliance", "cell_resistance_factor")]
    assert after.mean[after.index(kept)] == pytest.approx(before.mean[before.index(kept)])


def test_the_first_line_names_what_made_the_file(learned: MixedModel, lines, tmp_path: Path):
    base, out, last = (tmp_path / f"{name}.toml" for name in ("base", "new", "last"))
    write_baseline(adopted(learned.vehicle, learned, learned), REFERENCE, base)
    write_model(report(learned, lines, cornering()), read_vehicle(str(base)), base, out)
    write_vehicle(out, [], last)
    for file, maker in ((base, "discover --baseline"), (out, "discover --write-model"), (last, "calibrate")):
        lines_of = file.read_text().splitlines()
        assert lines_of[0].startswith(f"# Made by: gz-onboard {maker}")
        assert sum("Made by" in line for line in lines_of) == 1


def test_statistics_that_cannot_be_read_are_refused(learned: MixedModel, mixed: MixedModel, tmp_path: Path):
    base = tmp_path / "base.toml"
    write_baseline(adopted(learned.vehicle, learned, learned), REFERENCE, base)
    beside = tmp_path / "base.healthy.npz"
    fewer = replace(mixed, names=mixed.names[:-3])
    with pytest.raises(InputError, match="another model"):
        load(fewer, beside)
    whole = beside.read_bytes()
    for damaged in (b"", b"no zip", whole[: len(whole) // 2], whole[:200] + bytes(50) + whole[250:]):
        beside.write_bytes(damaged)
        with pytest.raises(InputError, match="cannot be read"):
            restore(read_vehicle(str(base)))
    beside.unlink()
    with pytest.raises(InputError, match="no file"):
        read_vehicle(str(base))
