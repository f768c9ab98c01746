"""Parameters, batteries and models of vehicle files: what is read, and what is refused and how."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from gz_onboard.errors import InputError
from gz_onboard.model.parameters import USUAL_CELLS, declared_parameters
from gz_onboard.vehicle import OWN, read_vehicle

REFERENCE = (OWN / "reference.toml").read_text()


def vehicle(tmp_path: Path, old: str, new: str):
    assert re.search(old, REFERENCE, re.M)
    file = tmp_path / "changed.toml"
    file.write_text(re.sub(old, new, REFERENCE, count=1, flags=re.M))
    return read_vehicle(str(file))


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        (r"^drag_area = \{ value = [\d.]+", "drag_area = { value = 99.0", ["drag_area", "99", "m²", "0.05 to 8"]),
        (r'^(drag_area = .*unit = )"m²"', r'\1"cm²"', ["drag_area", "cm²", "m²"]),
        (r"^drag_area", "drag_aera", ["drag_aera", "did you mean 'drag_area'"]),
        (r"^drag_area", "yaw_inertia", ["yaw_inertia", "nothing reads this parameter", "delete the line"]),
        (r'^(drag_area = .*status = )"\w+"', r'\1"measuerd"', ["measuerd", "did you mean 'measured'"]),
        (r"^(drag_area = .*), sd = [\d.]+", r"\1", ["drag_area", "sd", "missing"]),
        (r"^soc = \[0\.0, 0\.005", "soc = [0.005, 0.0", ["battery.ocv", "must increase", "0"]),
        (r"^cells_series = 14", "cells_series = 0", ["cells_series", "0 is outside 1"]),
        (r'"aerodynamic_drag"', '"aerodynamic_darg"', ["aerodynamic_darg", "did you mean 'aerodynamic_drag'"]),
        (r"^schema = 1", "schema = 7", ["schema", "7", "reads 1"]),
        (r"^\[forecast\]", "[forcast]", ["forcast", "did you mean 'forecast'"]),
        (r"\[0.200, 0.0, 0.0\]", "[0.972, 0.0, 0.0]", ["riding", "add up to 1"]),
        (r"\[0.200, 0.0, 0.0\]", "[0.200, 0.0]", ["riding", "share of time"]),
    ],
)
def test_refused_with_place_and_reason(tmp_path, old, new, parts):
    with pytest.raises(InputError) as error:
        vehicle(tmp_path, old, new)
    message = str(error.value)
    assert re.search(r"changed\.toml(:\d+)?: ", message)
    for part in parts:
        assert part in message, message


def test_the_line_is_the_one_of_the_mistake(tmp_path):
    line = 1 + REFERENCE[: REFERENCE.index("\ndrag_area") + 1].count("\n")
    with pytest.raises(InputError, match=rf"changed\.toml:{line}: "):
        vehicle(tmp_path, r"^drag_area = \{ value = [\d.]+", "drag_area = { value = 99.0")


def test_what_the_file_leaves_out_is_the_prior_and_a_guess(tmp_path):
    changed = vehicle(tmp_path, r"^motor_copper_resistance = .*\n", "")
    known = changed.parameters.known["motor_copper_resistance"]
    assert known.status == "guess"
    assert known.source.startswith("prior")
    assert changed.model.parameters["motor_copper_resistance"] == known.value


@pytest.mark.parametrize("name", ["vehicle_mass", "wheel_radius", "gear_ratio", "drag_area", "cell_capacity"])
def test_what_no_guess_fits_is_asked_for(tmp_path, name):
    with pytest.raises(InputError, match=rf"changed\.toml:\d+: parameters: must have {name} \["):
        vehicle(tmp_path, rf"^{name} = .*\n", "")


def test_priors_grow_with_the_vehicle(tmp_path):
    """Twice the reference scooter with its rider, with a gear: the same share of the power is lost."""
    left_out = ["motor_copper_resistance", "motor_iron_quadratic", "pack_current_noise", "regeneration_torque_limit"]
    left_out.append("charge_transfer_resistance")
    text = re.sub(rf"(?m)^({'|'.join(left_out)}) = .*\n", "", REFERENCE)
    for name, value in (("vehicle_mass", 290.0), ("gear_ratio", 0.1), ("cell_capacity", 28.0)):
        text = re.sub(rf"(?m)^{name} = {{ value = [\d.]+", f"{name} = {{ value = {value}", text)
    (tmp_path / "big.toml").write_text(
        re.sub(r"(?m)^wheel_radius = { value = [\d.]+", "wheel_radius = { value = 0.245", text)
    )
    big, usual = read_vehicle(str(tmp_path / "big.toml")).parameters, declared_parameters()
    torque = read_vehicle("reference").parameters["torque_constant"] / usual["torque_constant"].prior
    expected = {"motor_copper_resistance": torque**2 / 2 / 0.1**2, "motor_iron_quadratic": 2 * 0.1**2}
    expected |= {"pack_current_noise": 10.0, "regeneration_torque_limit": 2 * 0.1, "charge_transfer_resistance": 0.1}
    for name, size in expected.items():
        assert big[name] == pytest.approx(size * usual[name].prior), name
        assert big.sd(name) == pytest.approx(size * usual[name].prior_sd), name


def test_the_payload_that_is_entered_counts():
    light, heavy = read_vehicle("reference", 50.0), read_vehicle("reference", 110.0)
    assert heavy.model.mass - light.model.mass == pytest.approx(60.0)
    assert heavy.parameters.sd("payload_mass") < read_vehicle("reference").parameters.sd("payload_mass")


def test_key_tells_vehicles_and_models_apart(tmp_path):
    key = read_vehicle("reference").key
    assert vehicle(tmp_path, r'    "grade_force",\n', "").key != key
    assert vehicle(tmp_path, r"^cells_parallel = 12", "cells_parallel = 11").key != key


def test_laws_are_of_parameters_and_follow_from_those_before():
    order = ["mass", *USUAL_CELLS, *declared_parameters()]
    for name, parameter in declared_parameters().items():
        others = [factor.partition("^")[0] for factor in parameter.grows_with.split()]
        assert all(order.index(other) < order.index(name) for other in others), name
