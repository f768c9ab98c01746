"""What a newcomer gives by mistake: each command says what is wrong with what, and what to do, in a line or two."""

from __future__ import annotations

from pathlib import Path

import pytest

from gz_onboard import cli
from tests.short_logs import short_log

EMPTY = "is empty, a file of 0 bytes; copy or record it again"
MISSING = "cannot be read: No such file or directory (did you mean 'ride.blf'?)"
ANOTHER = "knows none of its 40 frames (identifiers 0x123, ...); give the vehicle that it is of, or begin"
NO_SUFFIX = "is not a log that can be read: it ends in '.txt', and it begins with 'hello'; logs are .mcap, .blf"
NO_FOLDER = "cannot be written: there is no folder nowhere; make it"
READING = {
    "report": ["report", "LOG"],
    "check": ["vehicle", "check", "reference", "LOG"],
    "export": ["export", "LOG", "out", "--vehicle", "reference"],
}
WRONG = [
    (["report", "ride.blf", "-o", "ride.pdf"], "ride.pdf: the report is a page in HTML; give it a name that ends in"),
    (["report", "ride.blf", "-o", "nowhere/ride.html"], NO_FOLDER),
    (["report", "ride.blf", "--route", "ride.gpx"], "ride.gpx: cannot be read: No such file or directory"),
    (["vehicle", "check", "ride.blf", "reference"], "ride.blf: is a log; the vehicle comes first, by name or file"),
    (["vehicle", "check", "reference", "ride.blf", "--quick", "--json", "nowhere/x.json"], NO_FOLDER),
    (["vehicle", "check", "none.toml", "ride.blf"], "gz-onboard vehicle check: none.toml: no such vehicle file"),
    (["export", "ride.blf", "x.csv", "--estimates"], "of which `gz-onboard estimate ride.blf` makes them"),
    (["export", "ride.blf", "x.mf4", "--signals", "--vehicle", "reference"], "ride.blf: its signals can be written to"),
    (["export", "ride.blf", "x.csv", "--signals", "--vehicle", "reference", "--columns", "x"], " more"),
    (
        ["learned", "--state", "none.json"],
        "none.json: no saved state; the daemon keeps one in its state folder; choose another",
    ),
    (["learned", "--state", "hello.txt"], "hello.txt: is not a saved state; choose another state file or vehicle"),
    (["learned", "--state", "folder"], "it is not a file; choose another state file or vehicle"),
]


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a log, and with what is none, or none of this vehicle's."""
    place = tmp_path_factory.mktemp("given")
    (place / "folder").mkdir()
    short_log(place / "ride.blf")
    short_log(place / "folder" / "ride.blf", 100)
    (place / "empty.blf").touch()
    (place / "hello.txt").write_text("hello\n")
    frames = (f"({i}.0) can0 123#00\n" for i in range(1_700_000_000, 1_700_000_040))
    (place / "another.log").write_text("".join(frames))
    return place


@pytest.fixture(autouse=True)
def _there(given: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(given)


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert cli.main(arguments) == 2
    said = capsys.readouterr().err.strip()
    assert len(said) < 600
    assert "Traceback" not in said
    return said


@pytest.mark.parametrize("arguments", READING.values(), ids=READING)
def test_a_log_that_is_none(arguments, capsys):
    logs = {"rid.blf": MISSING, "empty.blf": EMPTY, "hello.txt": NO_SUFFIX}
    if arguments[0] != "export":  # which read any vehicle's
        logs["another.log"] = ANOTHER
    for log, said in logs.items():
        assert f"{log}: " in (told := refused(capsys, *(log if x == "LOG" else x for x in arguments)))
        assert said in told


@pytest.mark.parametrize(("arguments", "said"), WRONG, ids=lambda x: " ".join(x)[:40] if isinstance(x, list) else "")
def test_what_does_not_fit(arguments, said, capsys):
    assert said in refused(capsys, *arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        ["estimate", "NAME"],
        ["estimate", "ride.blf", "--state", "NAME"],
        ["estimate", "ride.blf", "--json", "NAME"],
        ["estimate", "ride.blf", "--output", "NAME"],
        ["estimate", "ride.blf", "--route", "NAME"],
        ["estimate", "ride.blf", "--vehicle", "NAME"],
        ["report", "ride.blf", "--output", "NAME"],
        ["vehicle", "check", "NAME", "ride.blf"],
        ["learned", "--state", "NAME"],
        ["export", "ride.blf", "NAME.csv"],
        ["validate", "NAME"],
        ["calibrate", "all", "NAME"],
        ["discover", "ride.blf", "--effects", "NAME"],
        ["replay", "NAME"],
        ["route", "NAME"],
    ],
    ids=" ".join,
)
def test_a_name_that_no_file_can_have(arguments, capsys):
    assert "File name too long" in refused(capsys, *(x.replace("NAME", "n" * 300) for x in arguments))


def test_the_parts_of_a_command_are_named(capsys):
    with pytest.raises(SystemExit):
        cli.main(["vehicle"])
    assert "new|check" in capsys.readouterr().err
