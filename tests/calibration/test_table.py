"""Tables of measurements: units, names, and what is wrong in them."""

from __future__ import annotations

import gzip
import math
import re
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest

from gz_onboard.calibration.table import Named, read_columns, read_table
from gz_onboard.errors import InputError
from gz_onboard.toml import Table as Toml


def write(folder: Path, text: str, name: str = "x.csv") -> Path:
    file = folder / name
    file.write_text(text, encoding="utf-8")
    return file


def test_units_are_in_the_names(tmp_path):
    file = write(
        tmp_path,
        "time_min,current_mA,voltage[mV],cell_temperature_K,motor_speed_rpm,speed (km/h),soc_pct,note\n"
        "0,1000,4100,298.15,60,36,50,start\n1,-500,4000,273.15,-60,72,40,\n",
    )
    table = read_table(file)
    expected = {
        "time": [0, 60],
        "current": [1, -0.5],
        "voltage": [4.1, 4.0],
        "cell_temperature": [25, 0],
        "motor_speed": [2 * math.pi, -2 * math.pi],
        "speed": [10, 20],
        "soc": [0.5, 0.4],
    }
    for quantity, values in expected.items():
        assert table[quantity] == pytest.approx(values)
    assert len(table) == 2
    assert table.line(1) == 3
    with pytest.raises(InputError, match="no unit"):
        table["note"]


def test_compressed_and_parquet_are_the_same(tmp_path):
    text = "time_s,voltage_V\n0,4.1\n0.5,4.0\n"
    plain = read_table(write(tmp_path, text))
    zipped = tmp_path / "x.csv.gz"
    zipped.write_bytes(gzip.compress(text.encode()))
    parquet = tmp_path / "x.parquet"
    pyarrow.parquet.write_table(pyarrow.table({"time_s": [0.0, 0.5], "voltage_V": [4.1, 4.0]}), parquet)
    for file in (zipped, parquet):
        table = read_table(file)
        assert all(np.array_equal(table[name], plain[name]) for name in ("time", "voltage"))


def test_names_of_other_people(tmp_path):
    file = write(tmp_path, "t,v_V,i_A,junk\n0,4.1,-1,x\n1,4.0,-2,y\n")
    columns = {"time": Named("t", "s"), "voltage": Named("v_V"), "current": Named("i_A", scale=-1)}
    table = read_table(file, columns)
    assert list(table.columns) == ["time", "voltage", "current"]
    assert table["current"].tolist() == [1, 2]
    with pytest.raises(InputError, match=r"x.csv: no column 'i_mA' for current \(did you mean 'i_A'\?\)"):
        read_table(file, {"current": Named("i_mA")})
    with pytest.raises(InputError, match="'t' has no unit"):
        read_table(file, {"time": Named("t")})


def test_the_mapping_of_a_manifest(tmp_path):
    text = '[columns]\ntime = "t_s"\ncurrent = { column = "i", unit = "mA", scale = -1 }\n'
    stated = text + 'cell_temperature = { value = 298.15, unit = "K" }\n'
    columns = read_columns(Toml.read(write(tmp_path, stated, "m.toml")).table("columns"))
    assert (columns["time"], columns["current"]) == (Named("t_s"), Named("i", "mA", -1.0))
    table = read_table(write(tmp_path, "t_s,i\n0,500\n"), columns)
    assert (table["current"].tolist(), table["cell_temperature"].tolist()) == ([-0.5], [25.0])
    wrong = write(tmp_path, text.replace("mA", "mAA"), "n.toml")
    with pytest.raises(InputError, match=r"n.toml:3: .*unknown unit 'mAA' \(did you mean 'mA'\?\)"):
        read_columns(Toml.read(wrong).table("columns"))


@pytest.mark.parametrize(
    ("text", "needed", "message"),
    [
        ("", (), "is empty"),
        ("time_s,current_A\n", (), "has no rows"),
        ("0,1\n1,2\n", (), "are numbers, not names"),
        ("time_s,current_A\n0,1\n1\n", (), "x.csv:3: 1 values for 2 columns"),
        ("time_s,curent_A\n0,1\n", ["current"], r"no column for 'current', in A \(did you mean 'curent'\?\)"),
        ("time_s,current\n0,1\n", ["current"], "'current' has no unit in its name, such as current_A"),
        ("time_s,current_X\n0,1\n", ["current"], "unknown unit 'X'; known are A, mA, Arms"),
        ("time_s,current_V\n0,1\n", ["current"], "current cannot be in V"),
        ("time_s,motor_speed_kmph\n0,1\n", ["motor_speed"], "motor_speed cannot be in kmph"),
        ("time_s,current_A\n0,1\n1,one\n", ["current"], "line 3, column 'current_A': 'one' is not a finite number"),
        ("time_s,current_A\n0,nan\n1,\n", ["current"], "line 2, .*'nan' is not a finite number, and 1 more"),
        ("time_s,current_A\n0,inf\n", ["current"], "'inf' is not a finite number"),
        ("time_s,current_A\n0,1\n2,1\n1,1\n", (), r"x.csv:4: time must not go back, but 1 s follows 2 s"),
        ("time_s,current_A\n0,1\n,1\n", (), "line 3, column 'time_s': '' is not a finite number"),
        ("current_A,current_mA\n0,1\n", ["current"], "'current_A' and 'current_mA' are both 'current'"),
        ("time_s,Loop,time_ms,Loop\n0,1,0,2\n", (), "'time_s' and 'time_ms' are both 'time'"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, text, needed, message):
    with pytest.raises(InputError, match=message) as error:
        table = read_table(write(tmp_path, text))
        for quantity in needed:
            table[quantity]
    assert "x.csv" in str(error.value)


def test_two_columns_of_one_name_may_be_there_if_none_asks_for_them(tmp_path):
    file = write(tmp_path, "time_s,Loop,Loop,voltage_V\n0,1,2,4.1\n")
    assert read_table(file)["voltage"].tolist() == [4.1]
    assert read_table(file, {"time": Named("time_s"), "voltage": Named("voltage_V")})["voltage"].tolist() == [4.1]
    with pytest.raises(InputError, match="2 columns are called 'Loop' for charge"):
        read_table(file, {"charge": Named("Loop", "Ah")})


@pytest.mark.parametrize("name", ["none.csv", "bad.csv.gz", "bad.parquet", "binary.csv"])
def test_a_file_that_cannot_be_read(tmp_path, name):
    if name != "none.csv":
        (tmp_path / name).write_bytes(b"\xff\xfe\x00rubbish")
    with pytest.raises(InputError, match=re.escape(str(tmp_path / name))):
        read_table(tmp_path / name)
