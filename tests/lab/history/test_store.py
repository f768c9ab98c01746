"""The file of a history: whole logs or nothing of them, and no file of anything else is touched."""

from __future__ import annotations

import multiprocessing
import os
import resource
import signal
import sqlite3
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from gz_onboard.cli import main
from gz_onboard.errors import InputError
from gz_onboard.lab.history.choice import default_file, period
from gz_onboard.lab.history.picture import draw_history
from gz_onboard.lab.history.store import APPLICATION, SCHEMA, Store
from gz_onboard.lab.history.totals import NumberedRide, overviews
from tests.lab.history.logs import ride, write_log
from tests.lab.history.test_log_rides import rides_in
from tests.lab.history.writer import add_many, on_other_days
from tests.support import S

LARGE = 40_000  # bytes of a history with some rides
SPAWN = multiprocessing.get_context("spawn")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("logs") / "a.mcap", [ride(200)])


@pytest.fixture
def file(tmp_path: Path, log: Path) -> Path:
    """A history with a ride."""
    file = tmp_path / "h.sqlite"
    with Store(file, begin=True) as store:
        store.add("digest", "", rides_in(log))
    return file


def run(part: str, file: Path, *arguments: object) -> int:
    return main(["history", part, *map(str, arguments), "--file", str(file)])


# --- what is drawn ----------------------------------------------------------------------------------------------------


def test_each_date_of_the_picture_says_its_month(log: Path):
    (one,) = rides_in(log)
    june = replace(one, start_ns=1_750_000_000 * S)  # 2025-06-15
    rides = [NumberedRide(day, ride) for day, ride in enumerate(on_other_days(june, range(20)))]
    figure = draw_history(overviews(rides))
    for axes in figure.axes[0], *figure.axes[2:]:
        figure.canvas.draw()
        dates = [text.get_text() for text in axes.get_xticklabels()]
        assert len(dates) > 3
        assert {date[-3:] for date in dates} == {"Jun", "Jul"}
        assert axes.xaxis.get_offset_text().get_text() == ""
    assert {figure.axes[0].get_xlabel(), figure.axes[-1].get_xlabel()} == {"2025"}


# --- files that are none, or of another gz-onboard --------------------------------------------------------------------


def text(file: Path) -> None:
    file.write_text("a text, and a long one, that is no file of SQLite\n" * 100)


def foreign(file: Path) -> None:
    file.unlink()
    with closing(sqlite3.connect(file)) as other:
        other.execute("CREATE TABLE rides (id INTEGER)")


def by_schema(schema: int) -> Callable[[Path], None]:
    def change(file: Path) -> None:
        with closing(sqlite3.connect(file)) as other:
            other.execute(f"PRAGMA user_version = {schema}")

    return change


def without_a_column(file: Path) -> None:
    with closing(sqlite3.connect(file)) as other:
        other.execute("ALTER TABLE rides DROP COLUMN energy_wh")


def cut_off(file: Path) -> None:
    os.truncate(file, file.stat().st_size // 2)


def folder(file: Path) -> None:
    file.unlink()
    file.mkdir()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (text, "is no history"),
        (foreign, "is an SQLite file of something else"),
        (by_schema(SCHEMA + 1), "of a later gz-onboard"),
        (by_schema(SCHEMA - 1), "of an earlier gz-onboard"),
        (without_a_column, "is damaged"),
        (cut_off, "is damaged"),
        (folder, ""),
    ],
)
def test_another_file_is_refused_and_left_as_it_is(capsys, log, file, change, said):
    change(file)
    before = file.read_bytes() if file.is_file() else None
    for part, arguments in ("show", []), ("add", [log, "--name", "other"]), ("remove", [1]):
        assert run(part, file, *arguments) == 2
        err = capsys.readouterr().err
        assert said in err
        assert "Traceback" not in err
    assert (file.read_bytes() if file.is_file() else None) == before


def test_there_is_none_yet(tmp_path, capsys):
    for part, arguments in ("show", []), ("remove", [1]):
        assert run(part, tmp_path / "h.sqlite", *arguments) == 2
        assert "there is no history yet" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_file_says_what_it_is(file):
    with closing(sqlite3.connect(file)) as other:
        assert other.execute("PRAGMA application_id").fetchone() == (APPLICATION,)
        assert other.execute("SELECT vehicle, round(distance_km) FROM rides").fetchall() == [("scooter", 2.0)]


def test_what_is_removed_stays_removed(capsys, log, file):
    assert run("remove", file, 2) == 2
    assert "has no ride 2" in capsys.readouterr().err
    assert run("add", file, log, "--replace") == 0
    assert run("remove", file, 2) == 0
    assert run("add", file, log) == 0
    with Store(file) as store:
        assert store.rides() == []


# --- crashes, full disks, other processes -----------------------------------------------------------------------------


def test_a_disk_that_takes_no_more(capsys, tmp_path, file, log):
    """Nothing of a log is kept of which something cannot be written; what was there stays."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with Store(file) as store:
        (one,) = (ride for _, ride in store.rides())
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (file.stat().st_size, limits[1]))
            with pytest.raises(OSError, match=r"h\.sqlite"):
                store.add("many", "", on_other_days(one, range(1, 200)))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert len(store.rides()) == 1
        assert len(store.add("many", "", on_other_days(one, range(1, 200))).added) == 199


def test_two_processes_write_at_once(tmp_path, log):
    file, (one,) = tmp_path / "new.sqlite", rides_in(log)
    together = SPAWN.Barrier(2)
    writers = [SPAWN.Process(target=add_many, args=(file, one, name, 40, together)) for name in "ab"]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join(200)
        assert writer.exitcode == 0
    with Store(file) as store:
        assert sorted(one.vehicle for _, one in store.rides()) == ["a"] * 120 + ["b"] * 120


def test_one_waits_while_another_writes(file, log):
    """And does not look before it may write: the other could not end, and what was seen would be of before."""
    (one,) = rides_in(log)
    with closing(sqlite3.connect(file, 1, isolation_level=None)) as other, ThreadPoolExecutor(1) as thread:
        other.execute("BEGIN IMMEDIATE")
        other.execute("DELETE FROM rides")
        waiting = thread.submit(add_many, file, one, "scooter", 1)
        assert not wait([waiting], 0.3).done  # it looks, if it is going to
        other.execute("COMMIT")
        waiting.result(200)
    with Store(file) as store:
        assert len(store.rides()) == 3


def test_a_process_that_is_killed_leaves_whole_logs(tmp_path, log):
    file, (one,) = tmp_path / "new.sqlite", rides_in(log)
    writer = SPAWN.Process(target=add_many, args=(file, one, "a", 100_000))
    writer.start()
    until = time.monotonic() + 200
    while (not file.exists() or file.stat().st_size < LARGE) and time.monotonic() < until:
        time.sleep(0.01)
    assert writer.pid
    os.kill(writer.pid, signal.SIGKILL)
    writer.join(100)
    with Store(file) as store:
        rides = len(store.rides())
        assert rides > 10
        assert rides % 3 == 0
        assert len(store.known_logs()) == rides // 3
        assert store._db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    add_many(file, one, "a", 2)
    add_many(file, one, "b", 2)
    with Store(file) as store:
        assert len(store.rides()) == rides + 6


# --- places and dates -------------------------------------------------------------------------------------------------


def test_where_the_history_is(monkeypatch):
    for name in ("STATE_DIRECTORY", "XDG_DATA_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", "/home/rider")
    assert default_file() == Path("/home/rider/.local/share/gz-onboard/history.sqlite")
    monkeypatch.setenv("XDG_DATA_HOME", "relative")
    assert default_file() == Path("/home/rider/.local/share/gz-onboard/history.sqlite")
    monkeypatch.setenv("XDG_DATA_HOME", "/data")
    assert default_file() == Path("/data/gz-onboard/history.sqlite")
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/gz-onboard:/var/lib/other")
    assert default_file() == Path("/var/lib/gz-onboard/history.sqlite")


@pytest.mark.parametrize(
    ("said", "days"), [("2024", 366), ("2023-02", 28), ("2024-12", 31), ("2024-06-15", 1), ("2024-6-5", 1)]
)
def test_a_date_is_a_period(said, days):
    of = period(said, "--since")
    assert (of.end - of.begin) / (24 * 3600 * S) == pytest.approx(days, abs=0.05)  # the clocks may be changed in it


@pytest.mark.parametrize(
    "said", ["", "yesterday", "2024-13", "2024-02-30", "0000", "99999", "2024-06-15T25:00", "20240"]
)
def test_no_date(said):
    with pytest.raises(InputError, match=r"--since .*: must be a date such as"):
        period(said, "--since")
