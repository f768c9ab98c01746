"""Text logs as other tools write them: SavvyCAN, OVMS, candump on the screen, Vector and PEAK."""

from __future__ import annotations

import gzip
import logging
from pathlib import Path

import pytest

from gz_onboard.errors import InputError
from gz_onboard.events import EFF_FLAG, ERR_FLAG, RTR_FLAG, TRANSMITTED, Frame
from gz_onboard.recording.logs import read_frames
from gz_onboard.recording.readers.contents import LogDamage
from gz_onboard.recording.readers.text import read_candump

MS = 1_000_000
S = 1000 * MS


def frames_of(folder: Path, text: str, name: str = "ride.txt", damages: list[LogDamage] | None = None) -> list[Frame]:
    file = folder / name
    file.write_text(text, encoding="latin-1")
    found = [] if damages is None else damages
    frames = [frame for batch in read_frames(file, on_damage=found.append) for frame in batch]
    assert damages is not None or not found
    return frames


SAVVYCAN = "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n"


@pytest.mark.parametrize("name", ["ride.csv", "ride.txt", "ride.log"])
def test_savvycan_with_the_direction(tmp_path, name):
    text = f"{SAVVYCAN}1674224,0000015F,false,Rx,0,8,90,F8,00,7D,00,EE,00,7D,\n1674311,18FF50E5,true,Tx,1,2,F3,FF,\n"
    assert frames_of(tmp_path, text, name) == [
        (1674224_000, 0x15F, bytes.fromhex("90F8007D00EE007D"), 0),
        (1674311_000, 0x18FF50E5 | EFF_FLAG, b"\xf3\xff", 1 | TRANSMITTED),
    ]


@pytest.mark.parametrize(
    "text",
    [
        f"{SAVVYCAN}1700000000000000,120,false,Rx,0,1,90,\n",
        "(1700000000.0) can0 120#90\n",
        "base dec timestamps absolute\n 1700000000.0 1 288 Rx d 1 144\n",
    ],
)
def test_a_byte_order_mark_costs_no_line(tmp_path, text):
    ((time, identifier, data, _),) = frames_of(tmp_path, f"\xef\xbb\xbf{text}")
    assert (time, identifier, data) == (1_700_000_000 * S, 0x120, b"\x90")


def test_savvycan_lines_that_are_none_are_counted_and_the_first_named(tmp_path):
    bad = (
        "2000,15F,false,Rx,0,8,90,F8\n3000,15F,false,Rx,0,9,00,00,00,00,00,00,00,00,00,\nhello\n4000,15F,false,Rx,0,1,0"
    )
    damages: list[LogDamage] = []
    frames = frames_of(tmp_path, f"{SAVVYCAN}1000,15F,false,Rx,0,1,90,\n{bad}", "r.csv", damages)
    assert len(frames) == 1
    assert [(damage.count, damage.place) for damage in damages] == [(4, "line 3")]
    assert "2000,15F" in damages[0].reason


def test_candump_as_on_the_screen(tmp_path):
    text = (
        " (1436509052.249713)  can0  120   [4]  11 22 33 44   '.\"3D'\n"
        " (1436509052.250713)  can1  RX - -  18FF50E5   [2]  1122\n"
        " (1436509052.251713)  can0  TX B -  123  [12]  00 01 02 03 04 05 06 07 08 09 0A 0B\n"
        " (1436509052.252713)  can0  321   [3]  remote request\n"
        " (1436509052.253713)  can0  20000004   [8]  00 04 00 00 00 00 00 00   ERRORFRAME\n"
        "\tcontroller-problem{rx-overflow}\n"
        " (2015-07-10 06:17:32.254713)  can0  100   [0] \n"
    )
    at = 1436509052_249713_000
    assert frames_of(tmp_path, text) == [
        (at, 0x120, b"\x11\x22\x33\x44", 0),
        (at + MS, 0x18FF50E5 | EFF_FLAG, b"\x11\x22", 1),
        (at + 2 * MS, 0x123, bytes(range(12)), TRANSMITTED),
        (at + 3 * MS, 0x321 | RTR_FLAG, bytes(3), 0),
        (at + 4 * MS, 4 | ERR_FLAG, bytes.fromhex("0004000000000000"), 0),
        (at + 5 * MS, 0x100, b"", 0),
    ]


def test_junk_behind_a_long_text_without_frames_is_no_empty_log():
    text = b"\texplains an error frame\n" * 10_000 + b"junk\n"
    with pytest.raises(InputError, match=r"ride, line 10001: cannot be read as a candump log"):
        read_candump(text, LogDamage(Path("ride")))


def test_candump_times_since_the_start_and_since_the_frame_before(tmp_path, caplog):
    caplog.set_level(logging.WARNING)
    zero = "".join(f" (000.{i}00000)  can0  120   [1]  0{i}\n" for i in range(9))
    assert [frame[0] for frame in frames_of(tmp_path, zero)] == [100 * MS * i for i in range(9)]
    assert "unknown start" in caplog.text
    steps = [0, 100, 5, 200, 5, 100, 5, 200]
    delta = "".join(f"(000.{step:03}000) can0 120#00\n" for step in steps)
    assert [frame[0] // MS for frame in frames_of(tmp_path, delta)] == [sum(steps[: i + 1]) for i in range(len(steps))]
    assert "added up" in caplog.text


ASC = "0.100000 1  64              Rx   d 2 64 0A\n   0.200000 2  1Fx             Tx   d 1 10\n"


def test_asc_without_a_header_loses_no_frame(tmp_path):
    expected = [(100 * MS, 0x64, b"\x64\x0a", 0), (200 * MS, 0x1F | EFF_FLAG, b"\x10", 1 | TRANSMITTED)]
    for name in ("ride.asc", "ride.txt"):
        assert frames_of(tmp_path, ASC, name) == expected


def test_asc_fd_remote_and_error_frames_and_a_length_code_beyond_eight(tmp_path):
    text = (
        "date Tue May 27 04:09:35.000 pm 2014\nbase hex  timestamps absolute\ninternal events logged\n"
        "  1.0 CANFD   1 Rx        300                                   1 0 9 12 "
        "00 01 02 03 04 05 06 07 08 09 0A 0B 102203 130 303000 0 0 0 0 0\n"
        "  1.1 2  321             Rx   r 4\n  1.2 1  ErrorFrame\n"
        "  1.3 1  3FF             Tx   d D 55 AA 01 02 03 04 05 06  Length = 232016 BitCount = 119 ID = 1023\n"
        "  1.4 CAN 1 Status:chip status error active\n"
    )
    frames = frames_of(tmp_path, text, "ride.asc")
    assert [(frame[1], frame[2]) for frame in frames] == [
        (0x300, bytes(range(12))),
        (0x321 | RTR_FLAG, bytes(4)),
        (ERR_FLAG | EFF_FLAG, b""),
        (0x3FF, bytes.fromhex("55AA010203040506")),
    ]
    damages: list[LogDamage] = []
    frames_of(tmp_path, f"{text}this is no line\n", "ride.asc", damages)
    assert [(damage.count, damage.place) for damage in damages] == [(1, "line 9")]


PCAN_1_2 = (
    ";$FILEVERSION=1.2\n;$STARTTIME=45000.5\n;\n;---+-- ------+------ +- --+-- ---+---- + -+ -- --\n"
    "     1)        12.345 1  Rx        0100 2  10 0E \n"
    "     2)       512.345 1  Tx    18FF50E5 1  90 \n"
)


def test_pcan_traces_of_version_1_2_are_read(tmp_path):
    noon_ns = 1_678_881_600 * S  # 2023-03-15 12:00 UTC
    assert frames_of(tmp_path, PCAN_1_2, "ride.trc") == [
        (noon_ns + 12_345_000, 0x100, b"\x10\x0e", 0),
        (noon_ns + 512_345_000, 0x18FF50E5 | EFF_FLAG, b"\x90", TRANSMITTED),
    ]


def test_the_content_tells_the_format_also_of_a_packed_log_and_against_its_name(tmp_path):
    file = tmp_path / "ride.blf.gz"
    file.write_bytes(gzip.compress(f"{SAVVYCAN}1000,15F,false,Rx,0,1,90,\n".encode()))
    assert [len(batch) for batch in read_frames(file)] == [1]
