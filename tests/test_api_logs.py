"""Frames, signals and checks of a vehicle file out of Python: as of ``gz-onboard export`` and ``vehicle check``."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gz_onboard as gz
from gz_onboard import cli
from gz_onboard.reports.tables import Columns
from tests.support import LOGS, ROOT

COASTDOWN = LOGS / "coastdown.blf"
SECONDS = ["--from", "1", "--to", "3"]
OF_REFERENCE = ["--vehicle", "reference"]
anyhow: Any = gz  # for what a type checker would refuse


def exported(*arguments: object) -> Path:
    """What ``gz-onboard export`` writes."""
    assert cli.main(["export", *map(str, arguments)]) == 0
    return Path(str(arguments[1]))


def same(table: Columns, file: Path) -> None:
    """A table is that in a Parquet file."""
    import pyarrow.parquet

    other = pyarrow.parquet.read_table(file)
    assert list(table) == other.column_names
    for name, values in table.items():
        column = other[name].to_pylist() if name != "time" else other[name].cast("int64").to_pylist()
        if name == "time":
            assert values.astype("int64").tolist() == column
        elif values.dtype.kind in "fi":
            np.testing.assert_array_equal(values, np.array([np.nan if x is None else x for x in column]))
        else:
            assert values.tolist() == column


def test_frames_are_those_of_the_command(tmp_path, capsys):
    out = exported(COASTDOWN, tmp_path / "frames.parquet", "--frames", *SECONDS)
    capsys.readouterr()
    frames = gz.read_frames(COASTDOWN, start=1.0, end=3.0)
    assert capsys.readouterr() == ("", "")
    same(frames.to_table(), out)
    assert frames.to_arrow()["identifier"].type == "int64"
    assert not frames.damages
    assert len(repr(frames)) < 3000


@pytest.mark.parametrize("columns", [None, ["BMS_PackVoltage", "BMS_PackCurrent[A]", "INV_MotorSpeed"]])
def test_signals_are_those_of_the_command(columns, tmp_path):
    only = ["--columns", ",".join(columns)] if columns else []
    given = [*SECONDS, *OF_REFERENCE, *only]
    signals = gz.read_signals(COASTDOWN, "reference", columns=columns, start=1.0, end=3.0)
    same(signals.to_table(), exported(COASTDOWN, tmp_path / "signals.parquet", *given))
    folder = exported(COASTDOWN, tmp_path / "tables", *given)
    assert sorted(signals.messages) == sorted(file.stem for file in folder.iterdir())
    for name, message in signals.messages.items():
        same(message.to_table(), folder / f"{name}.parquet")
    assert len(repr(signals)) < 3000


def test_signals_are_decoded_by_dbc_files_or_as_they_stand_in_the_log(tmp_path, capsys):
    vehicle = gz.read_vehicle("reference")
    own = gz.read_signals(COASTDOWN, vehicle, end=2.0)
    by_files = gz.read_signals(COASTDOWN, dbc=[*vehicle.mapping.dbc_files, vehicle.range_dbc], end=2.0)
    assert by_files.to_table()["value"].tolist() == pytest.approx(own.to_table()["value"].tolist(), nan_ok=True)
    assert cli.main(["estimate", str(COASTDOWN), "--no-plot", "--signals", "--output", str(tmp_path)]) == 0
    log = tmp_path / "coastdown.estimate.mcap"
    logged = gz.read_signals(log)
    assert (logged.unknown, logged.undecodable) == (0, 0)
    same(logged.to_table(), exported(log, tmp_path / "logged.parquet", "--signals"))


def test_a_damaged_log_says_so(tmp_path):
    whole = COASTDOWN.read_bytes()
    (tmp_path / "cut.blf").write_bytes(whole[: len(whole) // 2])
    (damage,) = gz.read_frames(tmp_path / "cut.blf").damages
    assert damage.path == tmp_path / "cut.blf"
    assert gz.read_signals(tmp_path / "cut.blf", "reference", columns=["BMS_PackVoltage"]).damages == [damage]


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: gz.read_frames(COASTDOWN, start=-1), "start -1: must be 0 to"),
        (lambda: gz.read_frames(COASTDOWN, start=2, end=2), "end 2 s: must be after start 2 s"),
        (lambda: gz.read_frames(COASTDOWN, start=1e6), "no frames in the chosen part"),
        (lambda: gz.read_frames(COASTDOWN, start=1e300), "start 1e[+]300: must be 0 to 1000000000 s"),
        (lambda: gz.read_frames(COASTDOWN, start=math.inf), "start inf: must be 0 to 1000000000 s"),
        (lambda: gz.read_frames(COASTDOWN, start=math.nan), "start nan: must be 0 to"),
        (lambda: gz.read_frames(COASTDOWN, end=math.nan), "end nan s: must be after start 0 s"),
        (lambda: gz.read_frames("nowhere.blf"), "nowhere.blf: cannot be read"),
        (lambda: gz.read_signals(COASTDOWN), "no DBC file is attached to this log; give a vehicle or DBC files"),
        (lambda: gz.read_signals(COASTDOWN, "reference", columns=["BMS_PackVoltge"]), "did you mean 'BMS_PackVolt"),
        (lambda: gz.read_signals(COASTDOWN, "reference", columns=[]), "columns: names none"),
        (lambda: gz.read_signals(COASTDOWN, "reference", dbc=["x.dbc"]), "dbc: a vehicle has DBC files of its own"),
        (lambda: anyhow.read_signals(COASTDOWN, dbc="x.dbc"), r"dbc 'x.dbc': must be Sequence\[str"),
        (lambda: gz.check_vehicle("refernce"), "did you mean 'reference'"),
        (lambda: gz.check_vehicle("reference", "nowhere.blf"), "nowhere.blf"),
        (lambda: anyhow.check_vehicle("reference", 3), "logs 3: must be"),
    ],
)
def test_what_cannot_be_used_is_an_input_error_without_options(call, said):
    with pytest.raises(gz.InputError, match=said) as refused:
        call()
    assert "--" not in str(refused.value)


def test_a_check_is_that_of_the_command(tmp_path, capsys):
    text = (ROOT / "gz_onboard/vehicles/reference.toml").read_text(encoding="utf-8")
    turned, count = re.subn(r'^pack_current = ("\w+")', r"pack_current = { signal = \1, scale = -1 }", text, flags=re.M)
    assert count == 1
    (tmp_path / "turned.toml").write_text(turned, encoding="utf-8")
    wrong = gz.check_vehicle(tmp_path / "turned.toml", [COASTDOWN], quick=True).wrong
    assert any("pack_current" in finding.roles and "its sign" in finding.text for finding in wrong)
    given = ["vehicle", "check", "reference", str(COASTDOWN), "--quick", "--quiet"]
    assert cli.main(given) == 0
    said = capsys.readouterr().out
    found = gz.check_vehicle("reference", COASTDOWN, quick=True)
    assert capsys.readouterr() == ("", "")
    assert f"{found}\n" == said
    assert "pack_voltage" in found.to_table()["role"].tolist()
    assert found.wrong == []


def test_signals_of_a_vehicle_are_found_by_parameter_group(tmp_path):
    """Whatever the sender, as the daemon finds them; by DBC files alone identifiers are exact."""
    log = tmp_path / "truck.log"
    lines = [f"({1700000000 + i / 10:.3f}) can0 18FEF147#FF0028FFFFFFFFFF\n" for i in range(100)]
    log.write_text("".join(lines), encoding="utf-8")
    truck = Path(__file__).parent / "vehicles" / "truck"
    signals = gz.read_signals(log, truck / "truck.toml")
    assert signals.unknown == 0
    speeds = signals.messages["CCVS1"].columns["WheelBasedVehicleSpeed[km/h]"]
    assert speeds == [40.0] * 100
    exact = gz.read_signals(log, dbc=[truck / "truck.dbc"])
    assert exact.unknown + sum(len(of.times) for of in exact.messages.values()) == 100


def test_signals_of_two_buses_with_one_identifier_are_said(tmp_path, capsys):
    dbc = 'VERSION ""\nNS_ :\nBS_:\nBU_: A\nBO_ 256 Pack: 2 A\n SG_ Volts : 0|16@1+ (0.1,0) [0|1000] "V" A\n'
    (tmp_path / "pack.dbc").write_text(dbc, encoding="utf-8")
    log = tmp_path / "two.log"
    frames = [(i / 10 + c / 1000, c, (3600 if c else 120) + i) for i in range(100) for c in (0, 1)]
    lines = [f"({1700000000 + t:.3f}) can{c} 100#{value.to_bytes(2, 'little').hex()}\n" for t, c, value in frames]
    log.write_text("".join(lines), encoding="utf-8")
    signals = gz.read_signals(log, dbc=[tmp_path / "pack.dbc"])
    assert signals.messages["Pack"].columns["Volts[V]"] == pytest.approx([12 + i / 10 for i in range(100)])
    (said,) = signals.conflicts
    assert said.startswith("0x100 comes on channels 0 and 1 with different data (Pack)")
    assert (
        cli.main(["export", str(log), str(tmp_path / "out.csv"), "--dbc", str(tmp_path / "pack.dbc"), "--signals"]) == 0
    )
    assert said in capsys.readouterr().out
