"""Rides as tables of signals, in place of logs of frames."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gz_onboard import cli
from gz_onboard.can.codec import Codec
from gz_onboard.errors import InputError
from gz_onboard.recording.logs import read_frames
from gz_onboard.recording.recording import Recording, open_ride, read_recording
from gz_onboard.vehicle import Vehicle, read_vehicle
from tests.events import events_of
from tests.support import write_log

REFERENCE = read_vehicle("reference")
TLMOTO = Path(__file__).resolve().parents[1] / "vehicles" / "tlmoto"
RIDE = """time [s],pack_voltage [V],pack_current [mA],speed [km/h],cell_temperature (°C),charge_plug
10.0,52.5,3000,36,25,0
10.5,,3500,39.6,nan,0
11.0,52.25,4000,,26,0
"""


def samples_of(folder: Path, text: str, name: str = "ride.csv", vehicle: Vehicle = REFERENCE) -> Recording:
    (folder / name).write_text(text, encoding="utf-8")
    return read_recording(folder / name, vehicle)


def plain(samples: Recording) -> dict[str, tuple[list[float], list[float]]]:
    return {
        role: (times.tolist(), [round(value, 9) for value in values.tolist()])
        for role, (times, values) in samples.columns.items()
    }


EXPECTED = {
    "pack_voltage": ([0.0, 1.0], [52.5, 52.25]),
    "pack_current": ([0.0, 0.5, 1.0], [3.0, 3.5, 4.0]),
    "vehicle_speed": ([0.0, 0.5], [10.0, 11.0]),
    "cell_temperature": ([0.0, 1.0], [25.0, 26.0]),
    "charge_plug": ([0.0, 0.5, 1.0], [0.0, 0.0, 0.0]),
}


def test_columns_play_the_roles_of_their_names_in_si_and_empty_cells_are_missing(tmp_path):
    assert plain(samples_of(tmp_path, RIDE)) == EXPECTED


def test_semicolons_with_decimal_commas_and_other_encodings_and_packed(tmp_path):
    assert plain(samples_of(tmp_path, RIDE.replace(",", "\t"))) == EXPECTED
    text = RIDE.replace(",", ";").replace(".", ",")
    file = tmp_path / "ride.csv.gz"
    file.write_bytes(gzip.compress(text.encode("cp1252")))
    assert plain(read_recording(file, REFERENCE)) == EXPECTED


@pytest.mark.parametrize(
    ("head", "times"),
    [
        ("t (s)", ["10.0", "10.5", "11.0"]),
        ("Time [MS]", ["10000", "10500", "11000"]),
        ("t_ms", ["10000", "10500", "11000"]),
        ("Timestamp", ["2024-05-01T10:00:00Z", "2024-05-01T10:00:00.5Z", "2024-05-01 12:00:01+02:00"]),
        ("time [s]", ["-1", "-0.5", "0"]),
    ],
)
def test_times_in_s_or_ms_or_iso_8601(tmp_path, head, times):
    _, *rows = RIDE.splitlines()
    lines = [RIDE.splitlines()[0].replace("time [s]", head)]
    lines += [",".join([time, *row.split(",")[1:]]) for time, row in zip(times, rows, strict=True)]
    assert plain(samples_of(tmp_path, "\n".join(lines))) == EXPECTED
    _, frames = open_ride(tmp_path / "ride.csv", REFERENCE)
    since_1970 = 1714557600 * 10**9 if head == "Timestamp" else 0 if "-" in times[0] else 10 * 10**9
    assert frames.time_ns[0] == since_1970


def test_parquet(tmp_path):
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as pq

    columns = {
        "time": pa.array([10_000_000_001, 10_500_000_002, 11_000_000_003], pa.timestamp("ns", "UTC")),
        "pack_voltage[V]": [52.5, None, 52.25],
        "pack_current[mA]": [3000, 3500, 4000],
        "vehicle_speed[m/s]": [10.0, 11.0, float("nan")],
        "cell_temperature[K]": [298.15, None, 299.15],
        "charge_plug": [0, 0, 0],
    }
    file = tmp_path / "ride.parquet"
    pq.write_table(pa.table(columns), file)
    assert plain(read_recording(file, REFERENCE)) == EXPECTED
    with pytest.raises(InputError, match="a table of signals"):
        list(read_frames(file))
    for zone in ("Europe/Berlin", "Mars/Olympus"):  # a zone is how the time is written, not what it is
        columns["time"] = columns["time"].cast(pa.timestamp("us", zone), safe=False)
        pq.write_table(pa.table(columns), file)
        _, frames = open_ride(file, REFERENCE)
        assert frames.time_ns[0] == 10 * 10**9


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("pack_current [mA]", "pack_curent [mA]", [":1:", "'pack_curent' is no role", "did you mean 'pack_current'"]),
        ("pack_current [mA]", "battery_current [mA]", ["did you mean 'pack_current'"]),
        ("pack_current [mA]", "soc [%]", ["did you mean 'bms_state_of_charge'"]),
        ("speed [km/h]", "Speed [km/h]", ["did you mean 'speed'"]),
        ("pack_current [mA]", "pack_current [V]", [":1:", "'pack_current' has unit 'V'", "one of A, mA"]),
        ("pack_current [mA]", "pack_current", [":1:", "'pack_current' has no unit", "pack_current [A]"]),
        ("pack_current [mA]", "pack_voltage [V]", [":1:", "two columns are called 'pack_voltage'"]),
        ("pack_current [mA]", "vehicle_speed [m/s]", [":1:", "'vehicle_speed' and 'speed' are both vehicle_speed"]),
        ("11.0,", "10.4,", [":4: time [s]: '10.4' is before"]),
        ("11.0,", "soon,", [":4: time [s]: 'soon' is neither"]),
        ("10.5,", ",", [":3: time [s]: '' is neither"]),
        ("3500", "much", [":3: column 'pack_current' [mA]: 'much' is not a finite number"]),
        ("3500", "inf", [":3: column", "'inf' is not"]),
        ("3500,", "", [":3: 5 cells for 6 columns"]),
        (
            "11.0,",
            "1714557600000,",
            [":4: time [s]: '1714557600000' s is not a plausible", "call the column 'time [ms]'"],
        ),
        ("time [s]", "time", [":2: time: '10.0' has no unit", "'time [s]' or 'time [ms]'"]),
        ("time [s]", "times", [":1: neither a log of frames", "nor a table of signals", "[table] in a vehicle file"]),
        ("\n11.0,", "\n91.0,", ["usually 40.5 s", "call the column 'time [ms]'"]),
        ("10.5,,3500,39.6,nan,0\n11.0,", "10.0,", ["time [s]: all rows have the same time, '10.0'"]),
    ],
)
def test_what_is_wrong_is_said_with_its_line(tmp_path, old, new, parts):
    with pytest.raises(InputError) as caught:
        samples_of(tmp_path, RIDE.replace(old, new, 1))
    for part in [str(tmp_path / "ride.csv"), *parts]:
        assert part in str(caught.value)


# --- a vehicle without DBC files ----------------------------------------------------------------------------------

ROLES = """
vehicle_speed = { signal = "v_kmh", unit = "km/h" }
pack_voltage = "U"
pack_current = { signal = "i", unit = "A", scale = -1 }
"""
TRIP = "t_s,v_kmh,elev_m,U [V],i\n" + "".join(
    f"{0.5 * i},36,500,{110 - 0.01 * i:.2f},{-10 - i % 3}\n" for i in range(240)
)


@pytest.fixture
def without_dbc(tmp_path: Path) -> Path:
    text = (TLMOTO / "tlmoto.toml").read_text(encoding="utf-8").replace('dbc = ["tlmoto.dbc"]\n', "")
    before, _, rest = text.partition("[bus]")
    file = tmp_path / "mine.toml"
    file.write_text(f"{before}[roles]{ROLES}\n{rest[rest.index('[forecast]') :]}", encoding="utf-8")
    return file


def test_its_roles_name_the_columns_and_others_are_unused(tmp_path, without_dbc):
    found = plain(samples_of(tmp_path, TRIP.replace("500", "hill"), vehicle=read_vehicle(without_dbc)))
    assert set(found) == {"vehicle_speed", "pack_voltage", "pack_current"}
    assert found["vehicle_speed"][1][:2] == [10.0, 10.0]
    assert found["pack_current"][1][:3] == [10.0, 11.0, 12.0]
    with pytest.raises(InputError, match=r"ride\.csv.*mine\.toml:\d+: roles\.pack_voltage.*'U'"):
        samples_of(tmp_path, TRIP.replace("U [V]", "W [V]"), vehicle=read_vehicle(without_dbc))


def test_its_roles_are_checked(tmp_path, without_dbc):
    text = without_dbc.read_text(encoding="utf-8")
    without_dbc.write_text(text.replace("vehicle_speed =", "vehicle_sped ="), encoding="utf-8")
    with pytest.raises(InputError, match=r"vehicle_sped: unknown key .did you mean 'vehicle_speed'"):
        read_vehicle(without_dbc)
    without_dbc.write_text(f"{text}\n[bus]\nnot_available = 'none'\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"bus: describes frames, for which dbc is missing"):
        read_vehicle(without_dbc)


def test_frames_cannot_be_read_and_the_daemon_does_not_start(tmp_path, without_dbc):
    (tmp_path / "ride.log").write_text("(1.0) can0 123#00\n")
    with pytest.raises(InputError, match=r"mine\.toml: dbc is missing.*ride\.log"):
        read_recording(tmp_path / "ride.log", read_vehicle(without_dbc))
    assert cli.main(["run", "--vehicle", str(without_dbc), "--interface", "virtual", "--state-dir", ""]) == 2


def test_frames_without_times_are_no_ride(tmp_path):
    (tmp_path / "ride.log").write_text("  can0  120   [1]  11\n  can0  121   [1]  11\n")
    with pytest.raises(InputError, match=r"ride\.log: its frames have no times"):
        read_recording(tmp_path / "ride.log", REFERENCE)


# --- the commands -------------------------------------------------------------------------------------------------


def estimate(tmp_path: Path, *arguments: object) -> dict[str, float]:
    out = tmp_path / "result.json"
    given = ["estimate", "--no-plot", "--quiet", "--output", tmp_path, "--json", out, *arguments]
    assert cli.main([str(argument) for argument in given]) == 0
    (ride,) = json.loads(out.read_text())["rides"]
    return dict(ride)


def test_estimate_of_a_trip_of_a_vehicle_without_dbc(tmp_path, without_dbc, capsys):
    (tmp_path / "trip.csv").write_text(TRIP)
    ride = estimate(tmp_path, "--vehicle", without_dbc, tmp_path / "trip.csv")
    assert ride["distance_km"] == pytest.approx(1.19, abs=0.02)
    assert ride["energy_wh"] == pytest.approx(109 * 11 * 119.5 / 3600, rel=0.02)
    assert ride["frames"] == 3 * 240
    for option in "--frames", "--signals":
        arguments = ["estimate", "--vehicle", str(without_dbc), option, "--output", str(tmp_path)]
        assert cli.main([*arguments, str(tmp_path / "trip.csv")]) == 2
        assert f"{option} has nothing to log" in capsys.readouterr().err


def test_a_table_of_a_ride_gives_the_estimate_of_its_frames(tmp_path):
    log = Path(__file__).resolve().parents[2] / "replay_logs" / "coastdown.blf"
    head = [frame for _, batch in zip(range(25), read_frames(log), strict=False) for frame in batch]
    start, codec = head[0][0], Codec(REFERENCE.mapping)
    rows: dict[float, dict[str, float]] = {}
    for time, group, values in events_of(codec, head):
        named = zip(codec.groups[group].roles, values, strict=True)
        rows.setdefault(time, {}).update({role: value for role, value in named if value is not None})
    from gz_onboard.events import ROLES as UNITS

    roles = sorted({role for row in rows.values() for role in row})
    lines = ["time [s]," + ",".join(f"{role} [{UNITS[role]}]" for role in roles)]
    lines += [f"{start * 1e-9 + t:.6f}," + ",".join(str(row.get(r, "")) for r in roles) for t, row in rows.items()]
    (tmp_path / "table.csv").write_text("\n".join(lines))

    write_log(tmp_path / "frames.log", head)
    ours, theirs = (estimate(tmp_path, tmp_path / name) for name in ("table.csv", "frames.log"))
    for key in ("soc_end", "soc_end_sd", "distance_km", "energy_wh", "range_end_km", "innovation_rms_v"):
        assert ours[key] == pytest.approx(theirs[key], rel=2e-3), key
    assert np.isfinite(ours["range_end_km"])


@pytest.mark.parametrize("text", [RIDE.encode("utf-16").decode("latin-1"), f"0{RIDE}"])
def test_a_csv_that_is_neither_is_told_how_a_table_begins(tmp_path, text):
    (tmp_path / "ride.csv").write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match=r"ride\.csv:1: neither .* nor a table .*UTF-8.*'time \[s\]'.*begins with '"):
        open_ride(tmp_path / "ride.csv", REFERENCE)


def steady(tmp_path: Path, step: float, speed: float = 36.0) -> dict[str, Any]:
    """The estimate of ten minutes at one speed [km/h] with a row each `step` [s]."""
    rows = "".join(f"{step * i:g},52,14,{speed:g}\n" for i in range(round(600 / step) + 1))
    (tmp_path / "steady.csv").write_text(f"time [s],pack_voltage [V],pack_current [A],speed [km/h]\n{rows}")
    return estimate(tmp_path, tmp_path / "steady.csv")


@pytest.mark.parametrize("step", [6.0, 20.0])
def test_what_rows_too_far_apart_leave_out_is_said_and_no_number_is_made_of_it(tmp_path, step):
    ride = steady(tmp_path, step)
    assert ride["distance_km"] + ride["gaps_s"] / 100 == pytest.approx(6.0, rel=0.05)
    assert (ride["energy_wh"], ride["energy_recovered_wh"], ride["consumption_wh_km"]) == (None, None, None)
    assert (ride["range_end_km"], ride["energy_left_wh"]) == (None, None)


# --- tables of other tools ----------------------------------------------------------------------------------------

OTHERS = """Date/Time,Pack Volts,AC Power[kW],AC Power[Watts],Outside[DegC],epoch time,Odo(Km),v[KPH]
06/13/2017 7:47:00,385.3,1,1000,21,1497361620,50000,36
06/13/2017 7:47:05,385.2,1,1000,21,1497361625,50000,36
06/13/2017 7:47:10,385.1,1,1000,21,1497361630,50000,36
"""
OTHERS_ROLES = """
pack_voltage = { signal = "Pack Volts", unit = "V" }
ambient_temperature = "Outside"
odometer = "Odo"
vehicle_speed = "v"
"""


def other_vehicle(file: Path, roles: str, table: str = "") -> Vehicle:
    """The vehicle of `file` with other roles."""
    text = file.read_text(encoding="utf-8").replace(ROLES, f"{roles}\n{table}")
    file.with_name("other.toml").write_text(text, encoding="utf-8")
    return read_vehicle(file.with_name("other.toml"))


@pytest.mark.parametrize(
    "time", ['{ column = "epoch time", unit = "s" }', '{ column = "Date/Time", format = "%m/%d/%Y %H:%M:%S" }']
)
def test_the_vehicle_file_names_the_column_of_times(tmp_path, without_dbc, time):
    (tmp_path / "trip.csv").write_text(OTHERS)
    vehicle = other_vehicle(without_dbc, OTHERS_ROLES, f"[table]\ntime = {time}\n")
    found = read_recording(tmp_path / "trip.csv", vehicle).columns
    assert {role: (list(times - times[0]), values[0]) for role, (times, values) in found.items()} == {
        "pack_voltage": ([0, 5, 10], 385.3),
        "ambient_temperature": ([0, 5, 10], 21),
        "odometer": ([0, 5, 10], 50_000_000),
        "vehicle_speed": ([0, 5, 10], 10),
    }
    with pytest.raises(InputError, match=r"trip\.csv:2: epoch time: '1497361620' is no date of the format %d"):
        bad = other_vehicle(
            without_dbc, OTHERS_ROLES, '[table]\ntime = { column = "epoch time", format = "%d.%m.%Y" }\n'
        )
        read_recording(tmp_path / "trip.csv", bad)


@pytest.mark.parametrize(
    ("time", "said"),
    [
        ('{ column = "epoch tim", unit = "s" }', "no column 'epoch tim'.*did you mean 'epoch time'"),
        ('{ column = "epoch time" }', "table.time: needs either a unit"),
        ('{ column = "epoch time", unit = "min" }', "table.time.unit: 'min' is not one of"),
    ],
)
def test_a_column_of_times_that_is_not_there_or_has_no_unit_is_refused(tmp_path, without_dbc, time, said):
    (tmp_path / "trip.csv").write_text(OTHERS.replace("Date/Time", "time [s]"))
    with pytest.raises(InputError, match=said):
        read_recording(tmp_path / "trip.csv", other_vehicle(without_dbc, OTHERS_ROLES, f"[table]\ntime = {time}\n"))


def test_two_columns_of_one_name_matter_only_to_a_role_that_names_them(tmp_path, without_dbc):
    (tmp_path / "trip.csv").write_text(OTHERS.replace("epoch time", "time [s]"))
    assert len(read_recording(tmp_path / "trip.csv", other_vehicle(without_dbc, OTHERS_ROLES)).columns) == 4
    asked = f'{OTHERS_ROLES}air_conditioner_power = "AC Power"\n'
    with pytest.raises(InputError, match=r"trip\.csv:1: two columns are called 'AC Power'"):
        read_recording(tmp_path / "trip.csv", other_vehicle(without_dbc, asked))
