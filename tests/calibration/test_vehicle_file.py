"""Vehicle files that calibration writes."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.calibration.fit import correlation
from gz_onboard.calibration.result import Curve, Found, Result
from gz_onboard.calibration.vehicle_file import merged, write_vehicle
from gz_onboard.errors import InputError
from gz_onboard.model.parameters import declared_parameters
from gz_onboard.priors import correlations
from gz_onboard.vehicle import OWN, read_vehicle
from tests.test_vehicle import with_effect

REFERENCE = OWN / "reference.toml"
DECLARED = declared_parameters()


def found(name: str, value: float, sd: float = 0.1, source: str = "a test") -> Found:
    return Found(value, sd, DECLARED[name].unit, source)


@st.composite
def results(draw: st.DrawFn) -> Result:
    """Any parameters within their bounds, correlated in any way, and a battery table."""
    rng = np.random.default_rng(draw(st.integers(0, 1000)))
    plain = sorted(set(DECLARED) - {"cell_resistance_factor"})  # which scales the tables as they are read
    names = tuple(rng.choice(plain, rng.integers(1, 9), replace=False).tolist())
    parameters = {}
    for name in names:
        low, high = DECLARED[name].low, DECLARED[name].high
        value = min(max(float(f"{rng.uniform(low, high):.6g}"), low), high)
        parameters[name] = found(name, value, rng.uniform(0, 1e3), draw(st.text(max_size=30)))
    factors = rng.uniform(-2, 2, (len(names), len(names)))
    axes = {"soc": np.sort(rng.choice(100, 6, replace=False)) / 100, "temperature": np.array([-10.0, 25.0])}
    ohms = rng.uniform(1e-4, 1, (2, 6))
    sd = np.where(rng.uniform(size=ohms.shape) < 0.1, np.nan, ohms)
    curve = Curve(axes, ohms, sd, "ohm", draw(st.text(max_size=9)))
    return Result("test", parameters, {"battery.r0": curve}, [(names, factors @ factors.T)])


@settings(max_examples=20, deadline=None)
@given(results())
def test_what_is_written_is_read_again(tmp_path_factory, result):
    out = tmp_path_factory.mktemp("v") / "new.toml"
    write_vehicle(REFERENCE, [result], out)
    before, after = read_vehicle("reference"), read_vehicle(str(out))
    for name, value in after.parameters.known.items():
        if name in result.parameters:
            expected = result.parameters[name]
            assert value.value == pytest.approx(expected.value, rel=1e-5)
            assert value.sd == pytest.approx(expected.sd, rel=1e-5)
            assert (value.unit, value.source, value.status) == (expected.unit, expected.source, "measured")
        elif not value.source.startswith("prior"):  # which follows from what was found
            assert value == before.parameters.known[name]
    names, covariance = result.covariance[0]
    matrix, tied = correlation(covariance), correlations(after)
    for i, a in enumerate(names):
        for j, b in enumerate(names[:i]):
            assert tied[frozenset((a, b))] == pytest.approx(matrix[i, j], rel=1e-5)
    assert after.battery is not None
    assert before.battery is not None
    curve = result.curves["battery.r0"]
    assert np.allclose(after.battery.r0.value, curve.value, rtol=1e-5)
    assert after.battery.r1.value == before.battery.r1.value
    assert after.battery.ocv_curve == before.battery.ocv_curve
    assert (after.riding, after.name) == (before.riding, before.name)
    assert after.mapping.sources == before.mapping.sources
    text = out.read_text()
    assert merged(text, [result], out, out) == text  # once more changes nothing
    assert all(line in text for line in REFERENCE.read_text().splitlines() if line.startswith("#"))


@pytest.mark.parametrize("style", ["inline", "table", "dotted", "none"])
def test_parameters_in_any_style(style):
    value = 'value = 0.5, unit = "m²", sd = 0.1, status = "guess", source = "x"'
    base = {
        "inline": f"# a\n[parameters]\ndrag_area = {{ {value} }} # why\n# b\n",
        "table": "# a\n[parameters.drag_area]\n" + value.replace(", ", "\n") + "\n# b\n",
        "dotted": "# a\n[parameters]\n" + "".join(f"drag_area.{part}\n" for part in value.split(", ")) + "# b\n",
        "none": "# a\n# b\n",
    }[style]
    base += 'wheelbase = { value = 1.3 }\n[x]\ny = """\n# no comment\n[parameters]\n"""\n'
    text = merged(base, [Result("t", {"drag_area": found("drag_area", 0.6)})], Path("a"), Path("a"))
    document = tomllib.loads(text)
    assert document["parameters"]["drag_area"]["value"] == 0.6
    assert document["x"] == {"y": "# no comment\n[parameters]\n"}
    assert (text.count("drag_area") == 1) == (style != "dotted")
    assert "# a\n" in text
    assert "# b\n" in text


def test_groups_of_correlation():
    base = (
        "[correlation.old]\nparameters = ['drag_area', 'wheelbase', 'cg_height']\n"
        "value = [[1, 0.5, 0.1], [0.5, 1, 0.2], [0.1, 0.2, 1]]\n"
    )
    names = ("drag_area", "rolling_resistance_constant")
    one = Result(
        "coastdown",
        {n: found(n, 0.4 if n == "drag_area" else 0.02) for n in names},
        {},
        [(names, np.array([[4.0, -1], [-1, 1]]))],
    )
    groups = tomllib.loads(merged(base, [one], Path("a"), Path("a")))["correlation"]
    assert groups["old"]["parameters"] == ["wheelbase", "cg_height"]
    assert groups["old"]["value"] == [[1, 0.2], [0.2, 1]]
    assert groups["coastdown"]["value"] == [[1, -0.5], [-0.5, 1]]
    later = Result("other", {"drag_area": found("drag_area", 0.3)})
    document = tomllib.loads(merged(base, [one, later], Path("a"), Path("a")))
    assert document["parameters"]["drag_area"]["value"] == 0.3
    assert "coastdown" not in document["correlation"]  # the tie was with another value


def test_where_data_end_is_said():
    curve = Curve(
        {"soc": np.array([0, 0.5, 1]), "temperature": np.array([0.0, 25])},
        np.ones((2, 3)),
        np.array([[np.nan, np.nan, 0.1], [0.1, 0.1, 0.3]]),
        "ohm",
        "pulses",
    )
    text = merged("", [Result("pulse", curves={"battery.r0": curve})], Path("a"), Path("a"))
    assert "sd_relative = 0.1\n" in text
    assert 'source = "pulses; not measured but extrapolated: soc 0 to 0.5 at temperature 0"' in text


def test_files_beside_the_base_are_found_from_the_new_place(tmp_path):
    (tmp_path / "base").mkdir()
    (tmp_path / "new").mkdir()
    base, out = tmp_path / "base" / "v.toml", tmp_path / "new" / "v.toml"
    (tmp_path / "base" / "my.dbc").write_text((Path(__file__).parents[2] / "dbc" / "vehicle.dbc").read_text())
    base.write_text(REFERENCE.read_text().replace('"vehicle.dbc"', '"my.dbc"'))
    write_vehicle(base, [Result("t", {"drag_area": found("drag_area", 0.6)})], out)
    assert tomllib.loads(out.read_text())["dbc"] == ["../base/my.dbc", "hbm.dbc"]
    assert read_vehicle(str(out)).parameters["drag_area"] == 0.6


def test_effects_of_ones_own_go_along(tmp_path):
    (tmp_path / "new").mkdir()
    base = with_effect(tmp_path / "base")
    for out in (tmp_path / "new" / "v2.toml", tmp_path / "base" / "v2.toml"):
        write_vehicle(base, [Result("t", {"drag_area": found("drag_area", 0.6)})], out)
        assert "horn" in read_vehicle(out).key
    assert {file.name for file in (tmp_path / "new").iterdir()} == {"v2_effects", "v2.toml"}
    assert not (tmp_path / "base" / "v2_effects").exists()  # there they are already


@pytest.mark.parametrize(
    ("result", "message"),
    [
        (Result("t", {"drag_area": Found(9.0, 0.1, "m²", "x")}), r"v.toml:\d+: .*value: 9 m² is outside 0.05 to 8 m²"),
        (Result("t", {"drag_area": Found(0.5, 0.1, "m", "x")}), "drag_area.unit: unit 'm' is wrong"),
        (Result("t", {"drag_area": Found(0.5, np.nan, "m²", "x")}), "drag_area.sd: must be a finite number"),
        (
            Result("t", curves={"battery.r0": Curve({"soc": np.ones(2)}, np.ones(3), np.ones(3), "ohm", "x")}),
            "battery.r0.soc: must increase",
        ),
        (Result("t", covariance=[(("drag_area",), np.ones((1, 1)))]), "covariance of drag_area, which was not found"),
    ],
)
def test_nothing_is_written_that_could_not_be_read(tmp_path, result, message):
    out = tmp_path / "v.toml"
    with pytest.raises(InputError, match=message):
        write_vehicle(REFERENCE, [result], out)
    assert not out.exists()
