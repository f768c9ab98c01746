"""The history as an SQLite file: one transaction for each log, or nothing of it.

Tables: `rides`, a row for each, whose columns are the fields of `KeptRide`; `logs`, the digests of the logs that were
read. The file says of itself what it is (application_id) and by which schema (user_version).
"""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self, get_args

from gz_onboard.errors import InputError, near_file
from gz_onboard.lab.history.ride import COLUMNS, SECOND_NS, KeptRide, contradicts, covers, overlap, same_ride
from gz_onboard.offline.results import FIRST_DATE_NS

APPLICATION = 0x677A6F62  # "gzob", as the header of the file has it
SCHEMA = 1
WAIT = 60.0  # s for another process to end its transaction, which takes milliseconds

_SELECT = f"SELECT id, {', '.join(COLUMNS)} FROM rides"
_NEAR_NS = 48 * 3600 * SECOND_NS  # no ride is longer, and no two zones of time are further apart
_LAST_NS = 2**63 - 1
_SQL = {str: "TEXT", int: "INTEGER", float: "REAL"}
_REFUSED = ("SQLITE_CANTOPEN", "SQLITE_READONLY", "SQLITE_PERM", "SQLITE_AUTH")
_BROKEN = ("SQLITE_CORRUPT", "SQLITE_ERROR", "SQLITE_MISMATCH")  # SQLITE_ERROR: a table or column is not there


@dataclass(frozen=True)
class Kept:
    """What became of the rides of a log.

    known: in the history already, or a part of one that is. replaced: rows that were shorter than their rides. clashes:
    (ride, the other that was at the same time), not added.
    """

    added: Sequence[KeptRide] = ()
    known: Sequence[tuple[KeptRide, KeptRide]] = ()
    replaced: int = 0
    clashes: Sequence[tuple[KeptRide, KeptRide]] = ()


@dataclass
class _FoundRides:
    """A `Kept` as it grows; obsolete: numbers of the rows to be deleted."""

    added: list[KeptRide] = field(default_factory=list)
    known: list[tuple[KeptRide, KeptRide]] = field(default_factory=list)
    clashes: list[tuple[KeptRide, KeptRide]] = field(default_factory=list)
    obsolete: set[int] = field(default_factory=set)


class Store:
    """An open history; a context manager. Raises InputError, or OSError for a full or broken disk."""

    def __init__(self, file: Path, *, begin: bool = False) -> None:
        """begin: make the file if it is not there."""
        self.file = file
        if not begin and not file.exists():
            raise InputError(
                f"{file}: there is no history yet; `gz-onboard history add LOG` begins one{near_file(file)}"
            )
        with _understood(file):
            if begin:
                file.parent.mkdir(parents=True, exist_ok=True)
            mode = "rwc" if begin else "rw"  # of a file that may not be written, SQLite makes ro
            address = f"{file.absolute().as_uri()}?mode={mode}"
            self._db = sqlite3.connect(address, WAIT, isolation_level=None, uri=True)
        try:
            with _understood(file):
                self._check(begin)
        except BaseException:
            self._db.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._db.close()

    def rides(self) -> list[tuple[int, KeptRide]]:
        """All rides with their numbers, by vehicle and start."""
        with _understood(self.file):
            rows = self._db.execute(f"{_SELECT} ORDER BY vehicle, start_ns, id")
            return [(row[0], KeptRide(*row[1:])) for row in rows]

    def known_logs(self) -> set[tuple[str, str]]:
        """(digest, vehicle if its name was given) of the logs that were read to their end."""
        with _understood(self.file):
            return {(digest, name) for digest, name in self._db.execute("SELECT digest, name FROM logs")}

    def add(self, digest: str, name: str, rides: Sequence[KeptRide], *, replace: bool = False) -> Kept:
        """Add the rides of a log, which is known by its digest (and `name`, given to its vehicle) from then on.

        All or nothing. A ride that is there already is left as it is, or written anew if it is to `replace`. A log of
        which a ride clashes is not noted as read.
        """
        with self._transaction():
            found = _FoundRides()
            for ride in rides:
                _sort(ride, self._near(ride), found, replace)
            self._db.executemany("DELETE FROM rides WHERE id = ?", [(number,) for number in sorted(found.obsolete)])
            marks = ", ".join("?" * len(COLUMNS))
            insert = f"INSERT INTO rides ({', '.join(COLUMNS)}) VALUES ({marks})"
            self._db.executemany(insert, [astuple(ride) for ride in found.added])
            if not found.clashes:
                self._db.execute("INSERT OR REPLACE INTO logs (digest, name) VALUES (?, ?)", (digest, name))
        return Kept(found.added, found.known, len(found.obsolete), found.clashes)

    def remove(self, numbers: Sequence[int]) -> list[KeptRide]:
        """Delete rides by their numbers; gives them. InputError for a number that is not there, and nothing is deleted.

        Their logs stay known: they come back only if these are read to `replace`.
        """
        with self._transaction():
            there = dict(self.rides())
            if missing := [number for number in numbers if number not in there]:
                raise InputError(
                    f"{self.file}: has no ride {missing[0]}; `gz-onboard history show --rides` numbers them"
                )
            self._db.executemany("DELETE FROM rides WHERE id = ?", [(number,) for number in numbers])
        return [there[number] for number in numbers]

    def _near(self, ride: KeptRide) -> dict[int, KeptRide]:
        """The rides of its vehicle, by number, that may be the same or at the same time."""
        begin, end = ride.start_ns - _NEAR_NS, ride.end_ns + _NEAR_NS
        if not ride.dated:
            begin, end = 0, _LAST_NS
        where = "vehicle = ? AND (start_ns < ? OR start_ns BETWEEN ? AND ?)"
        rows = self._db.execute(f"{_SELECT} WHERE {where} ORDER BY id", (ride.vehicle, FIRST_DATE_NS, begin, end))
        return {row[0]: KeptRide(*row[1:]) for row in rows}

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with _understood(self.file):
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._db.execute("COMMIT")
            except BaseException:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise

    def _check(self, begin: bool) -> None:
        if self._empty():
            if not begin:
                raise InputError(f"{self.file}: is empty; `gz-onboard history add LOG` begins a history in it")
            with self._transaction():
                if self._empty():  # another process may have been faster
                    self._create()
        application, schema = self._pragma("application_id"), self._pragma("user_version")
        if application != APPLICATION:
            raise InputError(f"{self.file}: is an SQLite file of something else; --file names the history")
        if schema != SCHEMA:
            older = "an earlier" if schema < SCHEMA else "a later"
            raise InputError(
                f"{self.file}: is by schema {schema}, of {older} gz-onboard; this one has {SCHEMA}. Nothing was "
                "changed; use that gz-onboard, or another --file"
            )
        if begin:
            with self._transaction():  # whether it can be written is said before the work
                pass

    def _empty(self) -> bool:
        tables = self._db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
        return not tables and not self._pragma("application_id") and not self._pragma("user_version")

    def _create(self) -> None:
        columns = ", ".join(f"{name} {_column(kind)}" for name, kind in COLUMNS.items())
        self._db.execute(f"CREATE TABLE rides (id INTEGER PRIMARY KEY AUTOINCREMENT, {columns})")
        self._db.execute("CREATE INDEX rides_by_start ON rides (vehicle, start_ns)")
        self._db.execute("CREATE TABLE logs (digest TEXT NOT NULL, name TEXT NOT NULL, PRIMARY KEY (digest, name))")
        self._db.execute(f"PRAGMA application_id = {APPLICATION}")
        self._db.execute(f"PRAGMA user_version = {SCHEMA}")

    def _pragma(self, name: str) -> int:
        return int(self._db.execute(f"PRAGMA {name}").fetchone()[0])


def _sort(ride: KeptRide, there: dict[int, KeptRide], found: _FoundRides, replace: bool) -> None:
    """Say what `ride` is beside those that are `there`, of which it takes the place of some."""
    together = {number: other for number, other in there.items() if overlap(other, ride)}
    for number, other in list(together.items()):
        if (covers(ride, other) and contradicts(ride, other)) or (covers(other, ride) and contradicts(other, ride)):
            del together[number]  # another ride, with a clock that was wrong
    parts = {number for number, other in together.items() if covers(ride, other)}
    wholes = {number for number, other in together.items() if covers(other, ride)}
    same = {number for number, other in there.items() if same_ride(other, ride)} | (parts & wholes)
    if known := (wholes - same if replace else wholes | same):
        found.known.append((ride, there[min(known)]))
    elif clash := together.keys() - parts - same:
        found.clashes.append((ride, there[min(clash)]))
    else:
        found.added.append(ride)
        found.obsolete |= parts | same


def _column(kind: Any) -> str:
    optional = type(None) in get_args(kind)
    plain = next(one for one in (get_args(kind) or (kind,)) if one is not type(None))
    return _SQL[plain] if optional else f"{_SQL[plain]} NOT NULL"


@contextmanager
def _understood(file: Path) -> Iterator[None]:
    """Errors of SQLite, said as those of other files."""
    try:
        yield
    except sqlite3.Error as error:
        name = str(getattr(error, "sqlite_errorname", ""))
        if name.startswith("SQLITE_FULL"):
            raise OSError(errno.ENOSPC, f"{file}: cannot be written: the disk is full; nothing was lost") from error
        if name.startswith("SQLITE_IOERR"):
            raise OSError(errno.EIO, f"{file}: the disk failed: {error}") from error
        if name.startswith("SQLITE_NOTADB"):
            raise InputError(f"{file}: is no history: not an SQLite file") from error
        if name.startswith(_REFUSED):
            raise InputError(f"{file}: cannot be opened or written: {error}") from error
        if name.startswith(("SQLITE_BUSY", "SQLITE_LOCKED")):
            raise InputError(
                f"{file}: another process writes it since {WAIT:.0f} s; nothing was lost, try again"
            ) from error
        if name.startswith(_BROKEN):
            raise InputError(
                f"{file}: is damaged ({error}); `sqlite3 {file.name} .recover` may save what is left"
            ) from error
        raise InputError(f"{file}: {error}") from error
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EIO):
            raise
        raise InputError(f"{file}: cannot be written: {error.strerror or error}") from error
