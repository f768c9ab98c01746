from __future__ import annotations

import argparse
import csv
import gzip
import json
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cantools
import pyarrow.parquet
import pytest
from mcap.reader import make_reader

import gz_onboard as gz
from gz_onboard import cli
from gz_onboard.can.codec import Codec
from gz_onboard.can.logfile import LogFile, object_schema
from gz_onboard.errors import InputError
from gz_onboard.events import EFF_FLAG, TRANSMITTED, Frame
from gz_onboard.export import command
from gz_onboard.export.contents import ExportSource
from gz_onboard.export.decoder import Decoder, column_name
from gz_onboard.recording.frames import FrameColumns
from gz_onboard.recording.logs import read_frames, read_samples
from gz_onboard.vehicle import read_vehicle
from tests.support import LOGS, write_log

START = 1_750_000_000_000_000_000

DBC = """VERSION ""

BU_: BMS

BO_ 256 Pack: 8 BMS
 SG_ Voltage : 0|16@1+ (0.01,0) [0|600] "V" BMS
 SG_ Current : 16|16@1- (0.05,0) [-1600|1600] "A" BMS
 SG_ Mode : 32|3@1+ (1,0) [0|7] "" BMS
 SG_ Temperature : 40|8@1+ (1,-40) [-40|210] "degC" BMS

BO_ 2147484160 Muxed: 3 BMS
 SG_ Page M : 0|8@1+ (1,0) [0|1] "" BMS
 SG_ First m0 : 8|8@1+ (1,0) [0|255] "V" BMS
 SG_ Second m1 : 8|16@1+ (1,0) [0|65535] "V" BMS

BO_ 300 Never: 1 BMS
 SG_ Silent : 0|8@1+ (1,0) [0|255] "" BMS

CM_ SG_ 256 Voltage "at the contactor";
"""
MUXED = 512 | EFF_FLAG


def recorded() -> list[Frame]:
    """Frames that decode, some with codes for not available, one of a wrong length, some unknown."""
    frames: list[Frame] = []
    for i in range(200):
        t = START + i * 10_000_001
        temperature = 255 if i % 10 == 0 else 60
        current = -32768 if i % 20 == 0 else -i
        data = (5000 + i).to_bytes(2, "little") + current.to_bytes(2, "little", signed=True)
        frames.append((t, 256, data + bytes([3, temperature, 0, 0]), 0))
        if i % 2:
            frames.append((t + 1_000_000, MUXED, bytes([i % 4 // 2, i, 0]), 0))
        if i % 50 == 0:
            frames.append((t + 2_000_000, 0x7FF, b"?", 1))
    frames.append((START + 3 * 10**9, 256, b"short", 0))
    frames.append((START + 3 * 10**9 + 1, 256, bytes(8), TRANSMITTED))
    return frames


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "ride.mcap"
    file = LogFile(path.open("wb"), START, {"vehicle": "ref"}, {"dbc/a.dbc": DBC.encode()})
    file.channel("/estimate", object_schema("Estimate", {"range": "km"}), {"k": "v"})
    frames = recorded()
    for i in range(0, len(frames), 25):
        file.frames(frames[i : i + 25])
        file.sample("/estimate", frames[i][0], {"range": float(i)})
    file.close()
    return path


def run(*arguments: str | Path) -> int:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command.run(parser.parse_args([str(argument) for argument in arguments]))


def read(path: Path) -> list[Frame]:
    return [frame for batch in read_frames(path) for frame in batch]


def expected() -> dict[str, list[tuple[int, dict[str, Any]]]]:
    """What cantools itself makes of the frames, the codes for not available taken out by hand."""
    database: Any = cantools.database.load_string(DBC)
    found: dict[str, list[tuple[int, dict[str, Any]]]] = {"Pack": [], "Muxed": []}
    for t, identifier, data, _ in recorded():
        if identifier == 256 and len(data) == 8:
            values: Any = database.decode_message("Pack", data)
            if values["Temperature"] == 215:
                values["Temperature"] = None
            if values["Current"] == pytest.approx(-1638.4):
                values["Current"] = None
            row = {"Voltage[V]": values["Voltage"], "Current[A]": values["Current"]}
            found["Pack"].append((t, {**row, "Mode": values["Mode"], "Temperature[degC]": values["Temperature"]}))
        elif identifier == MUXED:
            values = database.decode_message("Muxed", data)
            row = {"Page": values["Page"], "First[V]": values.get("First"), "Second[V]": values.get("Second")}
            found["Muxed"].append((t, row))
    return found


@pytest.mark.parametrize("suffix", [".blf", ".log", ".log.gz", ".asc", ".trc", ".csv", ".mf4"])
def test_frames_come_back_at_the_resolution_of_the_format(tmp_path: Path, log: Path, suffix: str) -> None:
    if suffix == ".mf4":
        pytest.importorskip("asammdf")
    out = tmp_path / f"out{suffix}"
    assert run(log, out) == 0
    there = read(out)
    assert [(i, d) for _, i, d, _ in there] == [(i, d) for _, i, d, _ in recorded()]
    steps = [(a[0] - there[0][0]) - (b[0] - START) for a, b in zip(there, recorded(), strict=True)]
    assert max(map(abs, steps)) <= 2_000


def test_tables_have_a_row_for_each_frame_and_null_for_what_was_not_available(tmp_path: Path, log: Path) -> None:
    import pyarrow.parquet as pq

    assert run(log, tmp_path / "tables") == 0
    for message, rows in expected().items():
        table = pq.read_table(tmp_path / "tables" / f"{message}.parquet")
        assert table.column("time").cast("int64").to_pylist() == [t for t, _ in rows]
        for name in rows[0][1]:
            assert table.column(name).to_pylist() == [values[name] for _, values in rows]
    assert sorted(p.name for p in (tmp_path / "tables").iterdir()) == [
        "Muxed.parquet",
        "Pack.parquet",
        "estimate.parquet",
    ]


def test_what_is_beyond_the_range_of_the_dbc_is_null_as_on_board(tmp_path: Path) -> None:
    """On board such a value is dropped and counted: a table that gives the number would be believed."""
    codec = Codec(read_vehicle("reference").mapping)
    message = next(m for m in codec.mapping.database.messages if m.name == "BMS_Pack")
    raw = message.encode(
        {s.name: 120.0 if s.name == "BMS_StateOfCharge" else 0.0 for s in message.signals}, strict=False
    )
    decoder = Decoder(codec.mapping)
    ((_, name, values),) = decoder.decode([[(START, message.frame_id, raw, 0)]])
    on_board = codec.values(message.name, raw)
    assert name == "BMS_Pack"
    assert on_board["BMS_StateOfCharge"] is None
    assert values == {column_name(s): on_board[s.name] for s in message.signals}


def _near(value: float | None) -> Any:
    """Equal but for the noise of binary fractions, which a text leaves out."""
    return None if value is None else pytest.approx(value, rel=1e-14)


def test_an_mcap_has_a_channel_for_each_message_and_all_that_was_there(tmp_path: Path, log: Path) -> None:
    out = tmp_path / "out.mcap"
    assert run(log, out) == 0
    with out.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        found: dict[str, list[tuple[int, Any]]] = {}
        for schema, channel, message in reader.iter_messages():
            if channel.message_encoding == "json":
                assert schema is not None
                assert schema.encoding == "jsonschema"
                properties = json.loads(schema.data)["properties"]
                values = json.loads(message.data)
                assert set(values) <= set(properties)
                found.setdefault(channel.topic, []).append((message.log_time, values))
    assert found["/can/Pack"] == expected()["Pack"]
    assert found["/can/Muxed"] == expected()["Muxed"]
    assert found["/estimate"] == [(t, v) for topic, t, v in read_samples(log) if topic == "/estimate"]
    assert read(out) == recorded()
    assert Counter(topic for topic, _, _ in read_samples(out))["/can/Pack"] == 201


def test_damage_is_told(tmp_path: Path, log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = LogFile(log.open("wb"), START)
    for frame in recorded():
        file.frames([frame])
    file.flush()
    whole = log.stat().st_size
    file.frames(recorded())
    file.close()
    log.write_bytes(log.read_bytes()[: whole + 200])
    assert run(log, tmp_path / "out.blf") == 0
    assert "damaged log" in capsys.readouterr().out
    assert read(tmp_path / "out.blf")
    log.write_bytes(log.read_bytes()[:500])
    with pytest.raises(InputError, match=r"no frames in this log; damaged at byte \d+"):
        run(log, tmp_path / "none.blf")
    assert not (tmp_path / "none.blf").exists()


@pytest.fixture
def estimated(tmp_path: Path) -> Path:
    """A log as ``gz-onboard estimate`` writes it: no frames."""
    path = tmp_path / "ride.estimate.mcap"
    file = LogFile(path.open("wb"), START, {"vehicle": "ref"}, {"dbc/a.dbc": DBC.encode()})
    properties = {
        "time": {"type": ["number", "null"], "description": "s since the first frame"},
        "soc": {"type": ["number", "null"], "description": "1"},
        "range": {"type": ["number", "null"], "description": "m"},
        "state": {"type": "string"},
    }
    file.channel("/estimate", {"title": "e", "type": "object", "properties": properties})
    file.channel("/status", {"title": "s", "type": "object"})
    for i in range(10):
        row = {"time": float(i), "soc": 0.5, "range": None if i == 3 else 1000.0 - i, "state": "VALID"}
        file.sample("/estimate", START + i * 10**9, row)
        file.sample("/status", START + i * 10**9, {"received": i})
    file.close()
    return path


COLUMNS = ["elapsed[s]", "soc", "range[m]", "state"]


@pytest.mark.parametrize(("name", "more"), [("out.csv", []), ("out.csv.gz", []), ("tables", ["--table-format", "csv"])])
def test_a_log_of_estimates_gives_their_table(tmp_path: Path, estimated: Path, name: str, more: list[str]) -> None:
    assert run(estimated, tmp_path / name, *more) == 0
    out = tmp_path / "tables" / "estimate.csv" if name == "tables" else tmp_path / name
    with gzip.open(out, "rt") if name.endswith("gz") else out.open() as stream:
        rows = list(csv.reader(stream))
    assert rows[0] == ["time[s]", *COLUMNS]
    assert rows[3] == [f"{START // 10**9 + 2}.000000000", "2.0", "0.5", "998.0", "VALID"]
    assert rows[4][3] == ""
    assert len(rows) == 11


def test_a_log_without_dbc_files_asks_for_them(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    write_log(path, recorded())
    with pytest.raises(InputError, match="--dbc"):
        run(path, tmp_path / "out.parquet")
    (tmp_path / "a.dbc").write_text(DBC)
    assert run(path, tmp_path / "out.parquet", "--dbc", tmp_path / "a.dbc") == 0


@pytest.mark.parametrize(
    ("out", "said"),
    [
        ("out.bfl", "did you mean '.blf'"),
        ("out.blf.gz", "only .* can be written with .gz"),
        ("ride.mcap", "overwrite the input"),
    ],
)
def test_outputs_that_cannot_be_written_are_named(tmp_path: Path, log: Path, out: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        run(log, tmp_path / out)


@pytest.mark.parametrize("name", ["out.log", "out.log.gz", "out.blf", "out.parquet", "out.mcap"])
def test_nothing_half_written_has_the_name(
    tmp_path: Path, log: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / name).write_text("before")

    def interrupted(frames: FrameColumns) -> Iterator[list[Frame]]:
        yield frames[:2000].tuples()
        raise KeyboardInterrupt

    monkeypatch.setattr(FrameColumns, "batches", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(log, tmp_path / name)
    assert (tmp_path / name).read_text() == "before"
    assert {file.name for file in tmp_path.iterdir()} == {"ride.mcap", name}


# --- what a log holds ------------------------------------------------------------------------------------------


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text_of(path).splitlines()]


def text_of(path: Path) -> str:
    data = path.read_bytes()
    return (gzip.decompress(data) if path.suffix == ".gz" else data).decode()


@pytest.mark.parametrize("name", ["out.jsonl", "out.jsonl.gz"])
def test_signals_as_lines_of_json(tmp_path: Path, log: Path, name: str) -> None:
    assert run(log, tmp_path / name) == 0
    there = lines(tmp_path / name)
    for message, rows in expected().items():
        mine = [{k: v for k, v in line.items() if k != "message"} for line in there if line["message"] == message]
        assert [line.pop("time[s]") for line in mine] == [_near(t / 1e9) for t, _ in rows]
        assert mine == [{name: _near(value) for name, value in values.items()} for _, values in rows]
    assert f'{{"time[s]": {START // 10**9}.000000000, ' in text_of(
        tmp_path / name
    )  # to the nanosecond, which no float has


def test_a_signal_called_time_takes_no_place_of_the_times(tmp_path: Path) -> None:
    path = tmp_path / "ride.mcap"
    file = LogFile(path.open("wb"), START, {}, {"dbc/a.dbc": DBC.replace("Mode", "time").encode()})
    file.frames([(START + i, 256, bytes([0, 0, 0, 0, i, 60, 0, 0]), 0) for i in range(3)])
    file.close()
    signals = gz.read_signals(path)
    table = signals.messages["Pack"].to_table()
    assert table["time"].astype("int64").tolist() == [START, START + 1, START + 2]
    assert table["time_signal"].tolist() == [0, 1, 2]
    assert run(path, tmp_path / "tables", "--table-format", "parquet") == 0
    written = pyarrow.parquet.read_table(tmp_path / "tables" / "Pack.parquet")
    assert written.column_names == list(table)
    assert written["time_signal"].to_pylist() == [0, 1, 2]
    rows = signals.to_table()
    assert rows["value"][rows["signal"] == "time"].tolist() == [0, 1, 2]
    assert rows["time"].astype("int64").tolist() == [START + i // 4 for i in range(12)]


def test_damage_of_a_log_of_estimates_is_told_once(estimated: Path) -> None:
    estimated.write_bytes(estimated.read_bytes()[:-40])
    source = ExportSource(estimated)
    assert not source.has_frames
    assert source.samples
    assert len(source.damages) == 1


def test_frames_as_a_table(tmp_path: Path, log: Path) -> None:
    assert run(log, tmp_path / "out.jsonl", "--frames") == 0
    rows = lines(tmp_path / "out.jsonl")
    assert [row.pop("time[s]") for row in rows] == [_near(frame[0] / 1e9) for frame in recorded()]
    assert [
        (row["identifier"] | (EFF_FLAG if row["extended"] else 0), bytes.fromhex(row["data"]), row["channel"])
        for row in rows
    ] == [(i, d, c & ~TRANSMITTED) for _, i, d, c in recorded()]
    assert [row["sent"] for row in rows] == [bool(c & TRANSMITTED) for *_, c in recorded()]
    assert not any(row["error"] or row["remote"] for row in rows)


def test_columns_are_chosen_by_name_with_or_without_unit(tmp_path: Path, estimated: Path, log: Path) -> None:
    assert run(estimated, tmp_path / "out.csv", "--columns", "range,soc") == 0
    assert (tmp_path / "out.csv").read_text().splitlines()[0] == "time[s],soc,range[m]"
    assert run(log, tmp_path / "out.jsonl", "--columns", "Voltage[V],Second") == 0
    assert {frozenset(line) - {"time[s]", "message"} for line in lines(tmp_path / "out.jsonl")} == {
        frozenset({"Voltage[V]"}),
        frozenset({"Second[V]"}),
    }


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["out.csv", "--estimates", "--columns", "rnge"],
            r"has no column 'rnge' \(did you mean 'range'\?\); there are",
        ),
        (["out.parquet", "--columns", ""], "columns: names none; there are"),
        (["out.csv", "--estimates", "--columns", " ,"], "columns: names none; there are"),
        (["out.parquet", "--columns", "Voltag"], r"has no column 'Voltag' \(did you mean 'Voltage'\?\); there are"),
        (["out.blf", "--columns", "Voltage"], "--columns: applies to estimates or signals"),
        (["out.mcap", "--columns", "Voltage"], "--columns: an .mcap has all"),
        (["tables", "--frames"], "--frames: can be written to"),
        (["out.blf", "--estimates"], "estimates can be written to .csv"),
        (["out.blf", "--signals"], "signals can be written to .csv"),
        (["out.csv", "--estimates", "--from", "1e6"], "no estimates in the chosen part"),
    ],
)
def test_what_cannot_be_had_is_said(tmp_path: Path, log: Path, arguments: list[str], said: str) -> None:
    with pytest.raises(InputError, match=said):
        run(log, tmp_path / arguments[0], *arguments[1:])
    assert not (tmp_path / arguments[0]).is_file()


def test_the_vehicle_that_a_log_names_decodes_it(tmp_path: Path) -> None:
    path = tmp_path / "ride.mcap"
    file = LogFile(path.open("wb"), START, {"vehicle": read_vehicle("reference").name})
    for batch in read_frames(LOGS / "coastdown.blf"):
        file.frames(batch)
    file.close()
    assert run(path, tmp_path / "out.jsonl", "--to", "2", "--columns", "BMS_PackVoltage") == 0
    assert len(lines(tmp_path / "out.jsonl")) == 20


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What ``gz-onboard estimate --signals`` makes of a recorded ride."""
    folder = tmp_path_factory.mktemp("own")
    ride = ["estimate", str(LOGS / "coastdown.blf"), "--signals", "--no-plot", "--output", str(folder)]
    assert cli.main(ride) == 0
    return folder / "coastdown.estimate.mcap"


@pytest.mark.parametrize("form", ["csv", "parquet", "jsonl"])
def test_a_folder_has_all_that_the_log_holds(tmp_path: Path, own: Path, form: str) -> None:
    assert run(own, tmp_path / "all", "--table-format", form) == 0
    assert {file.name for file in (tmp_path / "all").iterdir()} == {f"estimate.{form}", f"why.{form}"}
    assert run(own, tmp_path / "signals", "--table-format", form, "--signals") == 0
    there = {file.stem for file in (tmp_path / "signals").iterdir()}
    assert {"BMS_Pack", "INV_Motion"} <= there
    assert not {"estimate", "why"} & there


def test_without_an_output_it_says_what_the_log_holds(log: Path, own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(log) == 0
    told = capsys.readouterr().out
    assert f"frames            {len(recorded())}" in told
    assert "estimate" in told
    assert "a.dbc" in told
    assert run(own) == 0
    told = capsys.readouterr().out
    assert re.search(r"vehicle +reference-scooter\n", told)
    assert re.search(r"frames +none\n +estimate +61 rows\n", told)
    assert "BMS_Pack" in told
