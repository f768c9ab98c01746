"""Cells unlike the reference scooter's: what is written can be read, and what is odd is said."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from gz_onboard.calibration import cell as bench
from gz_onboard.calibration import pulse
from gz_onboard.calibration.result import Curve, Result
from gz_onboard.calibration.steps import write_calibration
from gz_onboard.calibration.table import Measurements
from gz_onboard.cli import main
from gz_onboard.errors import InputError
from gz_onboard.vehicle import OWN, read_vehicle
from tests.calibration.cells import Plant, pulse_pieces, pulse_test, slow_curve, slow_test

REFERENCE = OWN / "reference.toml"


class Flat(Plant):
    """An iron phosphate cell: a plateau, and a knee so steep that its rest after discharge is far up the knee."""

    def ocv(self, soc):
        return 3.3 + 0.02 * soc - 0.9 * np.exp(-soc / 0.02) + 0.15 * np.exp(-(1 - soc) / 0.01)


def flat_test():
    steps = [(0, 600, 60), (0.125, 72000, 60), (0, 3600, 60), (-0.125, 72000, 60), (0, 600, 60)]
    return Flat(hysteresis=0.02).run(steps, name="flat.csv")


def written(folder, *results):
    file = folder / "v.toml"
    write_calibration(REFERENCE, results, file)
    return read_vehicle(file)


def as_csv(table: Measurements, file):
    names = ["time_s", "current_A", "voltage_V", "cell_temperature_degC"]
    columns = np.column_stack(list(table.columns.values()))
    np.savetxt(file, columns, delimiter=",", header=",".join(names), comments="")
    return str(file)


def test_a_flat_curve_still_increases_when_rounded(tmp_path):
    table = flat_test()
    rest = len(table) - 1 - int(np.argmax(table["current"][::-1] > 0)) + 1
    table["voltage"][rest : rest + 61] += 0.4  # the cell rests far above the lowest voltages of its discharge
    result = bench.open_circuit(table)
    assert np.all(np.diff(written(tmp_path, result).pack.ocv_curve.y) >= 1e-5)
    notes = " ".join(result.notes)
    assert "(585 mΩ within minutes) would make 146" in notes
    assert "all of the gap counts as hysteresis" in notes
    assert re.search(r"is flat .* SOC 0.1.*, 0.9: .* rest_voltage_error, .* be 30 mV or more", notes)


def test_a_shift_of_another_cell_goes_with_its_curve(tmp_path):
    shift = Curve({"temperature": np.array([0.0, 25.0])}, np.array([-0.02, 0.0]), np.full(2, 0.005), "V", "old cell")
    base = tmp_path / "base.toml"
    write_calibration(REFERENCE, [Result("t", curves={"battery.rest_shift": shift})], base)
    assert read_vehicle(base).pack.rest_shift_curve
    write_calibration(base, [bench.open_circuit(slow_test()[0])], base)
    assert not read_vehicle(base).pack.rest_shift_curve


def test_a_file_that_could_not_be_read_leaves_the_old_one_and_a_report(tmp_path, monkeypatch, capsys):
    out, page = tmp_path / "v.toml", tmp_path / "r.html"
    out.write_text("the old one")
    soc, volts = np.linspace(0, 1, 3), np.array([3.0, 3.14196, 3.141961])
    falling = {"battery.ocv": Curve({"soc": soc}, volts, np.full(3, 0.01), "V", "x")}
    good = bench.open_circuit
    monkeypatch.setattr(bench, "open_circuit", lambda *given: replace(good(*given), curves=falling))
    file = as_csv(slow_test()[0], tmp_path / "ocv.csv")
    assert main(["calibrate", "ocv", file, "--output", str(out), "--report", str(page), "--quiet"]) == 2
    why = "battery.ocv.value: must increase, but 3.14196 follows 3.14196"
    assert f"{why}; this value was found" in capsys.readouterr().err
    assert why in page.read_text()
    assert out.read_text() == "the old one"


def test_a_discharge_that_ends_far_above_the_cut_off_is_told(tmp_path, capsys):
    table, _ = slow_test(charge=0)
    half = np.arange(len(table)) < 620  # a little over half of it
    cut = replace(table, columns={name: values[half] for name, values in table.columns.items()})
    for some, told in ((cut, True), (table, False)):
        arguments = ["calibrate", "ocv", as_csv(some, tmp_path / "ocv.csv"), "--output", str(tmp_path / "v.toml")]
        assert main([*arguments, "--quiet"]) == 0
        said = "above cell_cutoff_voltage (2.8 V)" in capsys.readouterr().out
        assert said == told


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


def test_pulses_on_a_flat_curve_take_the_capacity_of_the_slow_test(tmp_path):
    flat = bench.open_circuit(flat_test())
    table = Flat(hysteresis=0.02).run(pulse_pieces(levels=6), name="flat.csv")
    found = pulse.calibrate_cell([table], flat.curves["battery.ocv"], flat.parameters["cell_capacity"])
    assert "do not tell the capacity" in " ".join(found.refusals)
    assert found.curves["battery.capacity"].value[0] == pytest.approx(2.5, rel=0.02)
    assert found.curves["battery.capacity"].sd[0] > 0.1
    battery = written(tmp_path, flat, found).pack
    assert abs(battery.ocv(0.5)[0] - 3.31) < 0.035
    assert found.parameters["cell_voltage_error"].sd < 0.03


def test_pulses_of_another_capacity_than_the_slow_test_are_told():
    curve, capacity = slow_curve()
    found = pulse.calibrate_cell([pulse_test(25.0, 6)[0]], curve, replace(capacity, value=2.7))
    assert re.search(r"pulse_25C.csv: .* 2.5\d+ A·h at 25 degC, cell_capacity is 2.700", " ".join(found.notes))
    assert "cell_capacity" not in " ".join(pulse.calibrate_cell([pulse_test(25.0, 6)[0]], *slow_curve()).notes)


@pytest.mark.parametrize(
    ("column", "factor", "more", "words"),
    [
        ("voltage", 1000, 0, r"cell.csv:1: voltage is 4\d+.* V, not 0.2 to 6 V as of one cell"),
        ("voltage", 14, 0, "not 0.2 to 6 V as of one cell"),
        ("cell_temperature", 1, 273.15, "cell_temperature is 298.* degC, not -60 to 100 degC"),
        ("current", 1000, 0, "draws 2.* of 2.500 A·h: more than the cell holds"),
        ("time", 1 / 3600, 0, "is 6.14 s long; .* Is time in s"),
    ],
)
def test_a_wrong_unit_is_named(column, factor, more, words):
    table, _ = pulse_test(25.0, 6)
    table = replace(table, file=table.file.with_name("cell.csv"))
    table.columns[column] = table.columns[column] * factor + more
    with pytest.raises(InputError, match=words):
        pulse.calibrate_cell([table], *slow_curve())
