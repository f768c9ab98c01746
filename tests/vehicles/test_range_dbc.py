"""A vehicle that names its range frames: a van with a large battery, from its file to the bus and the log."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from gz_onboard.can.dbc import find_dbc, load_database
from gz_onboard.can.publisher import Counts, Publisher
from gz_onboard.cli import main
from gz_onboard.daemon.command import summary
from gz_onboard.errors import InputError
from gz_onboard.events import EFF_FLAG
from gz_onboard.pipeline import Pipeline, dbc_texts
from gz_onboard.recording.decode import feed
from gz_onboard.recording.frames import FrameColumns
from gz_onboard.vehicle import OWN, Vehicle, read_vehicle
from tests.support import Run, Scooter, check_sound

REFERENCE = (OWN / "reference.toml").read_text(encoding="utf-8")
LARGE = 'range_dbc = "range_large.dbc"'


def van(folder: Path, line: str, dbc: str = "", parallel: int = 400) -> Vehicle:
    """The reference scooter with many more cells, of 55 kWh."""
    assert "cells_parallel = 12" in REFERENCE
    text = REFERENCE.replace("cells_parallel = 12", f"cells_parallel = {parallel}")
    (folder / "van.toml").write_text(f"{line}\n{text}", encoding="utf-8")
    if dbc:
        (folder / "mine.dbc").write_text(dbc, encoding="utf-8")
    return read_vehicle(str(folder / "van.toml"))


def test_a_battery_too_large_for_its_range_frames_is_refused(tmp_path):
    told = r"van\.toml: the battery holds \d{5} Wh, .*EnergyLeft of .*range\.dbc says at most 6553\.4 Wh.*range_large"
    with pytest.raises(InputError, match=told):
        Pipeline(van(tmp_path, ""))


def test_a_range_too_long_for_its_range_frames_is_refused(tmp_path):
    """Of a battery that they can tell: full, such a vehicle would show no range at all."""
    dbc = (
        find_dbc("range.dbc")
        .read_text(encoding="utf-8")
        .replace("0|16@1+ (0.01,0) [0|655.34]", "0|16@1+ (0.01,0) [0|40]")
    )
    with pytest.raises(
        InputError, match=r"van\.toml: .*range from full is 5\d km, .*RANGE_Remaining .*mine\.dbc .*40 km"
    ):
        Pipeline(van(tmp_path, 'range_dbc = "mine.dbc"', dbc, parallel=12))


def test_the_large_frames_all_the_way(tmp_path):
    vehicle = van(tmp_path, LARGE)
    run = Run(vehicle)
    feed(run.pipeline, FrameColumns.of(Scooter().steady(20.0, current=80.0)))
    check_sound(run)
    database = load_database([find_dbc("range_large.dbc")])
    last = {identifier: data for _, identifier, data, _ in run.sent}
    assert sorted(last) == list(range(0x610, 0x618))
    estimate = run.estimates[-1]
    assert estimate.energy_left is not None
    assert estimate.energy_left > 20e3 * 3600
    energy = database.decode_message(0x611, last[0x611])
    assert energy["RANGE_EnergyLeft"] == pytest.approx(estimate.energy_left / 3600, rel=0.02)  # type: ignore[call-overload]
    assert dbc_texts(vehicle)["range_large.dbc"] == find_dbc("range_large.dbc").read_bytes()


@pytest.mark.parametrize(
    ("line", "dbc", "told"),
    [
        ('range_dbc = "range_larg.dbc"', "", r"van\.toml:1: range_dbc: .*no such DBC file.*mean 'range_large\.dbc'"),
        ('range_dbc = "."', "", r"van\.toml:1: range_dbc: \.: is a folder; give the DBC file in it"),
        ('range_dbc = ""', "", r"van\.toml:1: range_dbc: '' cannot be the name of a file"),
        (f'range_dbc = "{"x" * 5000}"', "", r"van\.toml:1: range_dbc: 'xxx.{0,100}' cannot be the name of a file"),
        (f'range_dbc = "{"ä" * 200}"', "", r"van\.toml:1: range_dbc: '.*ää.*': cannot be read: File name too long"),
        ("range_dbc = 3", "", r"van\.toml:1: range_dbc: must be a string"),
        (
            'range_dbc = "vehicle.dbc"',
            "",
            r"van\.toml: range_dbc: .*vehicle\.dbc: has no message RANGE_Estimate, which",
        ),
        ('range_dbc = "mine.dbc"', "1552 512", r"van\.toml: .*take the identifiers .*mine\.dbc\): 0x200"),
    ],
)
def test_a_file_that_does_not_do_is_refused(line, dbc, told, tmp_path):
    if dbc:
        dbc = find_dbc("range_large.dbc").read_text(encoding="utf-8").replace(*dbc.split())
    with pytest.raises(InputError, match=told):
        Pipeline(van(tmp_path, line, dbc))


def test_by_parameter_group_an_own_frame_may_not_be_the_vehicles(tmp_path):
    """A J1939 vehicle takes any sender and priority of a group: also ours."""
    (tmp_path / "truck.dbc").write_bytes((Path(__file__).parent / "truck" / "truck.dbc").read_bytes())
    own = find_dbc("range.dbc").read_text(encoding="utf-8").replace("1536", str(0x18F00477 | EFF_FLAG))
    roles = 'dbc = ["truck.dbc"]\n[bus]\nidentifiers = "j1939"\n[roles]\nmotor_speed = "EngineSpeed"\n'
    bus = REFERENCE[REFERENCE.index("dbc = ") : REFERENCE.index("[model]")]
    (tmp_path / "mine.dbc").write_text(own, encoding="utf-8")
    file = tmp_path / "van.toml"
    file.write_text(f'range_dbc = "mine.dbc"\n{REFERENCE.replace(bus, roles)}', encoding="utf-8")
    with pytest.raises(InputError, match=r"take the identifiers of our own range frames .*0x18f00477"):
        Pipeline(read_vehicle(str(file)))


# --- identifiers of one's own -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("number", "identifiers"),
    [("0x6A0", range(0x6A0, 0x6A8)), ("0x18FF6000", range(0x18FF6000 | EFF_FLAG, 0x18FF6008 | EFF_FLAG))],
)
def test_identifiers_of_ones_own(number, identifiers, tmp_path):
    """What is sent, what is said to be sent, and the DBC file that is written and logged agree."""
    vehicle = van(tmp_path, f"{LARGE}\nrange_identifier = {number}")
    run = Run(vehicle)
    feed(run.pipeline, FrameColumns.of(Scooter().steady(5.0, current=80.0)))
    assert {frame[1] for frame in run.sent} == run.pipeline.publisher.identifiers == set(identifiers)
    assert main(["run", "--vehicle", str(vehicle.file), "--write-dbc", str(tmp_path / "written.dbc")]) == 0
    assert (tmp_path / "written.dbc").read_bytes() == dbc_texts(vehicle)["range_large.dbc"]
    written = Publisher(tmp_path / "written.dbc")
    assert written.identifiers == set(identifiers)
    estimate = run.estimates[-1]
    assert [frame[1:3] for frame in written.range(estimate, Counts(), 0)] == [
        frame[1:3] for frame in Publisher(vehicle.range_dbc, identifiers[0] & ~EFF_FLAG).range(estimate, Counts(), 0)
    ]
    database = load_database([tmp_path / "written.dbc"])
    assert {message.cycle_time for message in database.messages} == {100, 1000}
    assert any(signal.choices for message in database.messages for signal in message.signals)
    energy = database.decode_message(
        identifiers[1] & ~EFF_FLAG, next(f[2] for f in reversed(run.sent) if f[1] == identifiers[1])
    )
    assert energy["RANGE_EnergyLeft"] == pytest.approx(estimate.energy_left / 3600, rel=0.02)  # type: ignore[call-overload, operator]


@pytest.mark.parametrize("number", ["-1", "0x7FC", "0x7FF", "0x1FFFFFFD", "1.5", '"0x600"'])
def test_an_identifier_that_cannot_be_is_refused(number, tmp_path):
    with pytest.raises(InputError, match=r"van\.toml:1: range_identifier: "):
        van(tmp_path, f"range_identifier = {number}")


def test_one_that_the_vehicle_takes_is_refused_with_one_that_is_free(tmp_path):
    with pytest.raises(
        InputError, match=r"take the identifiers .*: 0x200, 0x201, 0x202; .*range_identifier = (0x6\d0), .* free"
    ) as told:
        Pipeline(van(tmp_path, f"{LARGE}\nrange_identifier = 0x1FF"))
    free = re.search(r"range_identifier = (0x6\d0)", str(told.value))
    assert free
    Pipeline(van(tmp_path, f"{LARGE}\nrange_identifier = {free[1]}"))


def test_someone_else_who_sends_on_ours_is_counted(tmp_path):
    """A Nissan Leaf sends 0x601 and 0x603."""
    run = Run(van(tmp_path, LARGE))
    frames = Scooter().steady(3.0, current=80.0)
    others = [(frame[0], 0x611, bytes(8), 0) for frame in frames[::100]]
    feed(run.pipeline, FrameColumns.of(sorted(frames + others)))
    assert run.pipeline.foreign == {"0x611": len(others)}
    assert run.pipeline.status()["foreign"] == {"0x611": len(others)}
    assert any("0x611" in line and "someone else" in line for line in summary(run.pipeline))
    ours = run.pipeline.publisher.range(run.estimates[-1], Counts(), 0)
    assert all(run.pipeline.publisher.may_have_sent(frame) for frame in ours)
    assert not any(run.pipeline.publisher.may_have_sent(frame) for frame in others)
