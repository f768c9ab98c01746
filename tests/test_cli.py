"""A wrong command line or file: status 2, the place and the nearest right name, never a traceback."""

from __future__ import annotations

import argparse
import errno
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from gz_onboard.cli import COMMANDS, command_line, main
from tests.support import LOGS, ROOT
from tests.test_vehicle import with_effect

RIDE = str(LOGS / "coastdown.blf")


def _still_running(*_: object) -> None:
    pytest.fail("the command was taken and runs")


def status(*arguments: str) -> int:
    signal.signal(signal.SIGALRM, _still_running)
    signal.alarm(20)
    try:
        return main(arguments)
    except SystemExit as exit_:
        assert isinstance(exit_.code, int)
        return exit_.code
    finally:
        signal.alarm(0)


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """What is written to stderr by a command that must be refused."""
    assert status(*arguments) == 2
    out, err = capsys.readouterr()
    assert "Traceback" not in err
    assert out == ""
    return err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "COMMAND"),
        (["rnu"], "did you mean 'run'"),
        (["replai", RIDE], "did you mean 'replay'"),
        (["run", "--chanel", "can0"], "did you mean '--channel'"),
        (["run", "--chanel=can0"], "did you mean '--channel'"),
        (["run", "--chan", "can0"], "did you mean '--channel'"),  # no abbreviations: they break when options are added
        (["run", "--filter", "filterpi"], "did you mean 'filterpy'"),
        (["run", "--filter", "plt"], "choose from"),
        (["run", "--payload", "much"], "--payload: invalid float value: 'much'"),
        (["run", "--payload", "nan"], "payload"),
        (["run", "--payload", "-20"], "payload"),
        (["run", "--vehicle", "refrence"], "did you mean 'reference'"),
        (["run", "--vehicle", f"{'x' * 5000}.toml"], "cannot be read: File name too long"),
        (["dashboard", "--dbc", "x" * 5000], "cannot be read: File name too long"),
        (["run", "--interface", "sockectan"], "did you mean 'socketcan'"),
        (["run", "--interface", "virtual", "--channel", "a", "--channel", "a"], "--channel a: given twice"),
        (["run", "--interface", "virtual", "--log-dir", "/tmp/x", "--log-total-mb", "0"], "--log-total-mb 0"),
        (["run", "--interface", "virtual", "--log-dir", "/tmp/x", "--log-total-mb", "inf"], "--log-total-mb inf"),
        (["replay"], "LOG"),
        (["replay", "nowhere.blf", "--interface", "virtual"], "nowhere.blf"),
        (["replay", RIDE + "x"], "did you mean '.blf'"),
        (["replay", RIDE, "--speed", "-1"], "--speed -1"),
        (["replay", RIDE, "--from", "-1"], "--from -1"),
        (["replay", RIDE, "--from", "inf"], "--from inf"),
        (["replay", RIDE, "--from", "1e300"], "--from 1e+300"),
        (["replay", RIDE, "--from", "1", "--to", "inf"], "--to inf"),
        (["replay", RIDE, "--from", "1", "--to", "nan"], "--to nan"),
        (["replay", RIDE, "--speed", "1e-300"], "--speed 1e-300"),
        (["replay", RIDE, "--speed", "nan"], "--speed nan"),
        (["export", RIDE, "x.log", "--to", "inf", "--from", "1"], "--to inf"),
        (["calibrate", "motor", RIDE, "--set", "largest_current=nan"], "largest_current=nan"),
        (["replay", RIDE, "--from", "20", "--to", "10"], "--to 10 s"),
        (["replay", RIDE, "--interface", "virtul"], "did you mean 'virtual'"),
        (["estimate"], "LOG"),
        (["estimate", RIDE, RIDE, "--jobs", "100000"], "--jobs 100000: must be 1 to 256 processes"),
        (["validate", RIDE, "--jobs", "0"], "--jobs 0: must be 1 to 256 processes"),
        (["discover", RIDE, "--jobs", "100000"], "--jobs 100000: must be 1 to 256 processes"),
        (["estimate", str(ROOT / "dbc")], "dbc: this folder holds no log"),
        (["estimate", RIDE, "--vehicle", "referenz"], "did you mean 'reference'"),
        (["export", "nowhere.blf", "x.log"], "nowhere.blf"),
        (["export", RIDE, "x.csv", "--table-format", "csv"], "is for a folder of tables, and x.csv is a file"),
        (["export", RIDE, "--columns", "range"], "--columns: chooses what is written to OUT, which is missing"),
        (["export", RIDE, "--to", "5"], "--to: chooses what is written to OUT, which is missing"),
        (["report", "nowhere.mcap"], "nowhere.mcap"),
        (["estimate", RIDE, "--no-plot", RIDE], "; files go before the options"),
        (["replay", "nowhere.blf", "--channel", "a"], "nowhere.blf"),
        (["run", "--vehicle", f"{LOGS}/"], "is a folder; give a vehicle file, which ends in .toml"),
        (["dashboard", "--interface", "virtul"], "virtul"),
    ],
    ids=lambda value: " ".join(value).replace(RIDE, "RIDE")[:60] if isinstance(value, list) else "",
)
def test_command_line(capsys: pytest.CaptureFixture[str], arguments: list[str], said: str):
    assert said in refused(capsys, *arguments)


def test_a_kernel_without_can(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    def none(**_: object) -> None:
        raise OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")

    monkeypatch.setattr("can.Bus", none)
    for arguments in ["run"], ["replay", RIDE]:
        said = refused(capsys, *arguments, "--channel", "a")
        assert "this kernel has no CAN sockets" in said
        assert "sudo modprobe can_raw" in said
        assert "--interface udp_multicast --channel 239.74.163.2" in said


VEHICLE = (ROOT / "gz_onboard" / "vehicles" / "reference.toml").read_text(encoding="utf-8")
DRAG = re.findall(r"drag_area = \{ value = [\d.]+", VEHICLE)[0]


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        (
            'pack_voltage = "BMS_PackVoltage"',
            'pack_voltage = "BMS_PackVoltge"',
            ("BMS_PackVoltge", "'BMS_PackVoltage'"),
        ),
        ('pack_voltage = "BMS', 'pack_volltage = "BMS', ("pack_volltage", "'pack_voltage'")),
        ('"vehicle.dbc"', '"vehicel.dbc"', ("vehicel.dbc", "'vehicle.dbc'")),
        ("[bus.messages.INV_Motion]", "[bus.messages.INV_Moton]", ("INV_Moton", "'INV_Motion'")),
        ("[battery]", "[batery]", ("batery", "'battery'")),
        ("schema = 1", "schema = 2", ("schema", "2")),
        ("schema = 1", "schema == 1", ("line 3",)),
        ('"aerodynamic_drag"', '"aerodynamic_darg"', ("aerodynamic_darg", "'aerodynamic_drag'")),
        (DRAG + ', unit = "m²"', DRAG + ', unit = "m"', ("drag_area", "m²")),
        (DRAG, 'drag_area = { value = "large"', ("drag_area", "large")),
        (DRAG, "drag_area = { value = nan", ("drag_area", "nan")),
        ("cells_series = 14", "cells_series = 0", ("cells_series", "0")),
    ],
)
def test_vehicle_file(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, right: str, wrong: str, said: tuple[str, ...]
):
    assert VEHICLE.count(right) >= 1
    file = tmp_path / "mine.toml"
    file.write_text(VEHICLE.replace(right, wrong, 1), encoding="utf-8")
    err = refused(capsys, "run", "--interface", "virtual", "--channel", "a", "--vehicle", str(file))
    assert "mine.toml" in err
    for words in said:
        assert words in err


def test_the_daemon_runs_no_effects_but_roots(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    file = with_effect(tmp_path)
    monkeypatch.setattr("gz_onboard.daemon.command.ROOT", 12345)  # root may run the tests, and the file be root's
    arguments = ["run", "--interface", "none", "--vehicle", str(file)]
    assert "horn.py next to the file is code, and not run" in refused(capsys, *arguments)
    assert not list(tmp_path.rglob("*.ran"))
    assert "--interface none" in refused(capsys, *arguments, "--effects", str(file.parent / "effects"))
    assert list(tmp_path.rglob("*.ran"))
    assert "no such folder" in refused(capsys, *arguments, "--effects", str(tmp_path / "none"))


@pytest.mark.parametrize("name", ["none.blf", "empty.blf", "noise.blf", "noise.mcap", "noise.log.gz", "noise.log"])
@pytest.mark.parametrize("command", ["replay", "estimate", "validate", "export", "simulate", "discover"])
def test_log(capsys: pytest.CaptureFixture[str], tmp_path: Path, command: str, name: str):
    file = tmp_path / name
    if name != "none.blf":
        file.write_bytes(b"" if name.startswith("empty") else b"\x07noise\xff\n" * 100)
    options = {
        "replay": ["--interface", "virtual", "--channel", "a"],
        "estimate": ["--output", str(tmp_path / "out")],
        "validate": ["--output", str(tmp_path / "out")],
        "export": [str(tmp_path / "out.asc")],
    }
    assert name in refused(capsys, command, str(file), *options.get(command, []))


def test_a_disk_that_is_full():
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "gz_onboard", "discover", "--list"]
        run = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert run.returncode
    assert "gz-onboard discover: [Errno 28] No space left on device" in run.stderr
    assert "Traceback" not in run.stderr


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EIO])
def test_a_disk_that_fails_is_no_bad_input(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
):
    def failing(out: Path, *_: object) -> int:
        out.write_text("half")
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("gz_onboard.export.command.write_frames_as", failing)
    assert status("export", RIDE, str(tmp_path / "x.log")) == 1
    assert f"x.log: cannot be written: {os.strerror(number)}" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """It and all its subcommands'."""
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for child in action.choices.values():
                yield from parsers(child)


HELP = {parser.prog: parser.format_help for parser in parsers(command_line(COMMANDS))}


@pytest.mark.parametrize("command", HELP)
def test_every_page_of_help_is_one_screen(command: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "100")
    page = HELP[command]()
    assert len(page.splitlines()) <= 40
    assert page.startswith(f"usage: {command} ")
    assert "%%" not in page
    assert "%(" not in page


@pytest.mark.parametrize("command", ["estimate", "vehicle check", "learned"])
def test_a_wrong_option_shows_the_usage_of_its_command(capsys: pytest.CaptureFixture[str], command: str):
    with pytest.raises(SystemExit) as ended:
        main([*command.split(), "--nonsense", RIDE, RIDE])
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith(f"usage: gz-onboard {command} [OPTION ...]")
    assert f"\ngz-onboard {command}: error: unrecognized arguments: --nonsense" in said
