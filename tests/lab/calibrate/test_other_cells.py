"""Cells unlike the reference scooter's: what is written can be read, and what is odd is said."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from gz_onboard.cli import main
from gz_onboard.lab.calibrate import ocv, pulse
from gz_onboard.lab.calibrate.command import for_file
from gz_onboard.lab.calibrate.result import Curve, Found, Result
from gz_onboard.lab.calibrate.table import Measurements
from gz_onboard.lab.calibrate.vehicle_file import write_vehicle
from gz_onboard.vehicle import OWN, read_vehicle
from tests.lab.calibrate.cells import Plant, pulse_test, slow_test

REFERENCE = OWN / "reference.toml"


class Flat(Plant):
    """An iron phosphate cell: a plateau, and a knee so steep that its rest after discharge is far up the knee."""

    def ocv(self, soc):
        return 3.3 + 0.02 * soc - 0.9 * np.exp(-soc / 0.02) + 0.15 * np.exp(-(1 - soc) / 0.01)


def flat_test(hours=20, cell=None):
    cell = cell or Flat(hysteresis=0.02)
    current, seconds = cell.capacity / hours, hours * 3600
    return cell.run(
        [(0, 600, 60), (current, seconds, 60), (0, 3600, 60), (-current, seconds, 60), (0, 600, 60)], name="flat.csv"
    )


def written(folder, *results):
    file = folder / "v.toml"
    write_vehicle(REFERENCE, for_file(results, read_vehicle(REFERENCE)), file)
    return read_vehicle(file)


def as_csv(table: Measurements, file):
    names = ["time_s", "current_A", "voltage_V", "cell_temperature_degC"]
    columns = np.column_stack(list(table.columns.values()))
    np.savetxt(file, columns, delimiter=",", header=",".join(names), comments="")
    return str(file)


@pytest.mark.parametrize("knee", [0.0, 0.4, 0.6])
def test_a_flat_curve_still_increases_when_rounded(tmp_path, knee):
    table = flat_test()
    rest = len(table) - 1 - int(np.argmax(table["current"][::-1] > 0)) + 1
    table["voltage"][rest : rest + 61] += knee  # the cell rests far above the lowest voltages of its discharge
    battery = written(tmp_path, ocv.calibrate(table)).pack
    assert np.all(np.diff(battery.ocv_value) >= 1e-5)


def test_branches_that_lie_upon_each_other_are_known_within_what_a_file_holds(tmp_path):
    result = ocv.calibrate(slow_test(r0=1e-4, noise=1e-5, pairs=())[0])
    assert written(tmp_path, result).pack.ocv_sd >= 5e-4


def test_one_pulse_test_of_a_cell_without_relaxation(tmp_path):
    slow = ocv.calibrate(slow_test()[0])
    table, _ = pulse_test(25.0, 5, pairs=(), noise=1e-5)
    found = pulse.calibrate([table], slow.curves["battery.ocv"], slow.parameters["cell_capacity"])
    battery = written(tmp_path, slow, found).pack
    assert battery.cell_capacity(-20) == battery.cell_capacity(25)


def test_a_shift_of_another_cell_goes_with_its_curve(tmp_path):
    shift = Curve({"temperature": np.array([0.0, 25.0])}, np.array([-0.02, 0.0]), np.full(2, 0.005), "V", "old cell")
    base = tmp_path / "base.toml"
    write_vehicle(REFERENCE, [Result("t", curves={"battery.rest_shift": shift})], base)
    assert read_vehicle(base).pack.rest_shift_value
    write_vehicle(base, for_file([ocv.calibrate(slow_test()[0])], read_vehicle(base)), base)
    assert not read_vehicle(base).pack.rest_shift_value


FALLING = Curve({"soc": np.linspace(0, 1, 3)}, np.array([3.0, 3.14196, 3.141961]), np.full(3, 0.01), "V", "x")


def test_a_file_that_could_not_be_read_leaves_the_old_one_and_a_report(tmp_path, monkeypatch, capsys):
    out, page = tmp_path / "v.toml", tmp_path / "r.html"
    out.write_text("the old one")
    good = ocv.calibrate
    monkeypatch.setattr(ocv, "calibrate", lambda table: replace(good(table), curves={"battery.ocv": FALLING}))
    file = as_csv(slow_test()[0], tmp_path / "ocv.csv")
    assert main(["calibrate", "ocv", file, "--output", str(out), "--report", str(page), "--quiet"]) == 2
    said = capsys.readouterr()
    assert re.search(
        r"v.toml:[0-9]+: battery.ocv.value: must increase, but 3.14196 follows 3.14196; that was found", said.err
    )
    assert "battery.ocv.value: must increase" in page.read_text()
    assert f"{page} written" in said.out
    assert f"{out} written" not in said.out
    assert out.read_text() == "the old one"
    assert {f.name for f in tmp_path.iterdir()} == {"v.toml", "r.html", "ocv.csv"}


def test_a_step_that_fails_leaves_the_report_of_those_before(tmp_path, capsys):
    as_csv(slow_test()[0], tmp_path / "ocv.csv")
    (tmp_path / "calibration.toml").write_text('schema = 1\n[ocv]\ndata = "ocv.csv"\n[pulse]\ndata = "ocv.csv"\n')
    out, page = tmp_path / "v.toml", tmp_path / "r.html"
    assert main(["calibrate", "all", str(tmp_path), "--output", str(out), "--report", str(page), "--quiet"]) == 2
    said = capsys.readouterr()
    assert "pulse: " in said.err
    assert "cell_capacity" in said.out
    assert "at least 6 are needed" in page.read_text()
    assert not out.exists()


def test_a_value_out_of_bounds_is_named(tmp_path, monkeypatch, capsys):
    good = ocv.calibrate

    def tiny(table):
        result = good(table)
        result.parameters["cell_capacity"] = Found(0.05, 0.001, "A·h", "coin")
        return result

    monkeypatch.setattr(ocv, "calibrate", tiny)
    file, page = as_csv(slow_test()[0], tmp_path / "ocv.csv"), tmp_path / "r.html"
    assert main(["calibrate", "ocv", file, "--output", str(tmp_path / "v.toml"), "--report", str(page)]) == 2
    assert "cell_capacity: 0.05 A·h was found, outside 0.1 to 500 A·h" in capsys.readouterr().err
    assert page.exists()
