"""Malformed vehicle files, DBC files and manifests: either they read and make sense, or they are refused by name."""

from __future__ import annotations

import copy
import random
import re
import time
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, astuple
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from gz_onboard.calibration.steps import read_manifest
from gz_onboard.errors import InputError
from gz_onboard.events import EFF_FLAG, Frame
from gz_onboard.model.battery import Battery
from gz_onboard.pipeline import Pipeline
from gz_onboard.vehicle import OWN, Vehicle, read_vehicle
from tests.hardening import Report
from tests.hardening.flips import damaged
from tests.support import LOGS, ROOT

TITLE = "Malformed vehicle files, DBC files and manifests of a calibration"
COUNT = 300
FULL_COUNT = 6000
LONGEST = 2.0  # s of CPU; a sound vehicle file takes 0.02

VEHICLE = (OWN / "reference.toml").read_text(encoding="utf-8")
MANIFEST = (LOGS / "calibration" / "calibration.toml").read_text(encoding="utf-8")
DBC = {name: (ROOT / "dbc" / name).read_text(encoding="utf-8") for name in ("vehicle.dbc", "hbm.dbc")}
LARGE = 10**400  # no float can hold it


class Raw(str):
    """TOML as it is to stand in the file."""


VALUES: tuple[Any, ...] = (
    True,
    "",
    "x",
    "\0",
    "../..",
    "a/b",
    "é",
    "\n",
    "x" * 100_000,
    0,
    -1,
    1,
    3,
    1.5,
    -0.0,
    5e-324,
    1e-300,
    1e-9,
    1e9,
    1e300,
    -1e300,
    2**63,
    LARGE,
    -LARGE,
    float("inf"),
    -float("inf"),
    float("nan"),
    [],
    [[]],
    {},
    [1],
    [1, 2],
    ["x"],
    [float("nan")],
    [float("inf"), 1],
    [LARGE],
    [True, False],
    {"x": 1},
    {"": {}},
    [{}],
    datetime(2020, 1, 1, tzinfo=UTC),
    [0.0] * 100_000,
    Raw("[" * 60 + "]" * 60),
    Raw("[" * 5000 + "]" * 5000),
    Raw("{ a = " * 200 + "1" + " }" * 200),
    Raw("1e400"),
    Raw("-1e400"),
    Raw("9" * 5000),
    Raw("a"),
    Raw("1 2"),
    Raw('"'),
    Raw("'''"),
    Raw(""),
)
NUMBERS = (
    "0",
    "-1",
    "1",
    "2",
    "3.5",
    "64",
    "65",
    "255",
    "1e6",
    "1000000",
    "99999999999999999999",
    "-99999999999999999999",
    "1e-400",
    "1e400",
    "-1e400",
    "1e308",
    "1e-300",
    "-0",
    "0.5",
    "nan",
    "inf",
    "",
    "1e",
    "0x10",
    "2147483648",
    "9" * 400,
)
NAMES = ("", "1x", "x-y", "é", "x" * 5000, "__import__", "SG_", "BO_", "A B", "\0", '"', "'", "\\", "{}", "None")


# --- making them --------------------------------------------------------------------------------------------------


def toml(value: Any) -> str:
    """A value in TOML, on one line."""
    if isinstance(value, Raw):
        return value
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + "".join(c if c >= " " and c != "\x7f" else f"\\u{ord(c):04x}" for c in escaped) + '"'
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{toml(key)} = {toml(inner)}" for key, inner in value.items()) + " }"
    if isinstance(value, int) and abs(value) >= 10**300:
        return ("-" if value < 0 else "") + "1" + "0" * 400  # Python refuses to write more than 4300 digits at all
    return value.isoformat() if isinstance(value, datetime) else repr(value)


def document(values: dict[str, Any]) -> str:
    return "".join(f"{toml(key)} = {toml(value)}\n" for key, value in values.items())


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path to every key, and to the first few elements of every list."""
    inner = value.items() if isinstance(value, dict) else enumerate(value[:3]) if isinstance(value, list) else ()
    for key, below in inner:
        yield (*path, key)
        yield from places(below, (*path, key))


def keys(text: str, rng: random.Random) -> tuple[str, set[str]]:
    """The file with one to three of its values replaced, deleted or renamed; the keys on the way to them."""
    values = tomllib.loads(text)
    named: set[str] = set()
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        where = rng.choice(list(places(values)))
        named |= {key for key in where if isinstance(key, str)}
        inside = values
        for key in where[:-1]:
            inside = inside[key]
        old = inside[where[-1]]
        what = rng.random()
        if what < 0.12:
            del inside[where[-1]]
        elif what < 0.18 and isinstance(inside, dict):
            inside[rng.choice(NAMES)] = inside.pop(where[-1])
        elif what < 0.45 and isinstance(old, int | float) and not isinstance(old, bool):
            inside[where[-1]] = old * rng.choice((-1, 1e-12, 1e-3, 0.5, 1.7, 1e3, 1e12)) + rng.choice((0, 0, 1e-3, 50))
        elif what < 0.55 and isinstance(old, list):
            inside[where[-1]] = rng.choice((old[::-1], old[:1], old[1:], old + old, old + old[-1:], [old], old[0]))
        else:
            inside[where[-1]] = copy.deepcopy(rng.choice(VALUES))
    return document(values), named


def lines(text: str, rng: random.Random) -> str:
    """The text with some of its lines cut, doubled, left out, moved or merged."""
    rows = text.splitlines(keepends=True)
    for _ in range(rng.choice((1, 1, 2, 5))):
        at, other = rng.randrange(len(rows)), rng.randrange(len(rows))
        row = rows[at]
        rows[at] = rng.choice((row[: rng.randrange(len(row) + 1)] + "\n", "", row.rstrip("\n"), 3 * row, 300 * row))
        if rng.random() < 0.3:
            rows.insert(other, row)
    return "".join(rows)


LAYOUTS = tuple(
    f"{start}|{length}@{order}"
    for start in (0, 1, 7, 8, 63, 64, 511, 100_000)
    for length in (0, 1, 2, 8, 33, 64, 65, 100_000)
    for order in ("0+", "0-", "1+", "1-")
)
IN_DBC: dict[str, tuple[str, Sequence[str]]] = {
    "dbc numbers": (r"(?<![\w.])-?\d+(?:\.\d+)?", NUMBERS),
    "dbc names": (
        r"\b[A-Za-z]\w+\b|[@+|:;\[\](),-]",
        (*NAMES, *re.findall(r"(?:SG|BO)_ (?:\d+ )?(\w+)", DBC["vehicle.dbc"])),
    ),
    "dbc layout": (r"\d+\|\d+@[01][+-]", LAYOUTS),
}
"""What is replaced in a DBC file, and by what."""


def replaced(text: str, rng: random.Random, kind: str) -> str:
    """The DBC with one to three of its numbers, names or places of signals replaced."""
    pattern, values = IN_DBC[kind]
    for _ in range(rng.choice((1, 1, 2, 3))):
        found = rng.choice(list(re.finditer(pattern, text)))
        text = text[: found.start()] + rng.choice(values) + text[found.end() :]
    return text


# --- what a sound one is ------------------------------------------------------------------------------------------


def numbers_in(value: Any) -> Iterator[float]:
    if isinstance(value, int | float):
        yield value
    elif isinstance(value, tuple | list):
        for inner in value:
            yield from numbers_in(inner)


def problems(vehicle: Vehicle) -> Iterator[str]:
    """What of a vehicle that was read makes no sense."""
    if not re.fullmatch(r"[A-Za-z0-9][\w.-]*", vehicle.name, re.ASCII):
        yield f"name {vehicle.name!r}"
    parameters = vehicle.parameters
    for name, known in parameters.known.items():
        bounds = parameters.declared[name]
        if not (bounds.low <= known.value <= bounds.high and 0 <= known.sd <= 1e9):
            yield f"{name} {known.value} ± {known.sd}"
    for source in vehicle.mapping.sources:
        if not (isfinite(source.factor) and source.factor and isfinite(source.offset)):
            yield f"{source.role} = raw · {source.factor} + {source.offset}"
    for message, period in vehicle.mapping.periods.items():
        if not 1e-4 <= period <= 3600:
            yield f"period of {message} {period} s"
    if vehicle.battery is not None:
        yield from pack_problems(vehicle.battery)
    if not all(map(isfinite, numbers_in(astuple(vehicle.riding)))):
        yield "riding"


def pack_problems(battery: Battery) -> Iterator[str]:
    """What of a pack makes no sense, on a grid of charge and temperature."""
    if not (type(battery.cells_series) is type(battery.cells_parallel) is int):
        yield "cells that are no whole number"
    for temperature in (-30.0, 0.0, 25.0, 60.0):
        if not 0.01 <= battery.cell_capacity(temperature) <= 1000:
            yield f"{battery.cell_capacity(temperature)} A·h at {temperature} degC"
        for soc in (0.0, 0.3, 1.0):
            volts, slope = battery.ocv(soc, temperature)
            r0, r1, c1 = (mesh.at(soc, temperature)[0] for mesh in (battery.r0, battery.r1, battery.c1))
            if not (0 < volts < 6 and 0 < slope < 1e7 and 0 < r0 < 100 and 0 < r1 < 100 and 1e-9 < r1 * c1 < 1e9):
                yield f"at {soc} and {temperature} degC: {volts} V, {slope} V, {r0} ohm, {r1} ohm, {c1} F"


def ridden(vehicle: Vehicle, rng: random.Random) -> None:
    """Two seconds of random and of zero frames of all its messages through the pipeline. AssertionError."""
    start = 1_700_000_000_000_000_000
    frames: list[Frame] = []
    for message in vehicle.mapping.database.messages:
        identifier = message.frame_id | (EFF_FLAG if message.is_extended_frame else 0)
        for i in range(4):
            data = rng.randbytes(message.length) if i % 2 else bytes(message.length)
            frames.append((start + 500_000_000 * i, identifier, data, 0))
    pipeline = Pipeline(vehicle)
    pipeline.advance(sorted(frames), start + 2_000_000_000)
    last = pipeline.last
    assert last
    for name, value in asdict(last).items():
        assert not isinstance(value, float) or isfinite(value), f"{name} is {value}"
    assert last.soc is None or -0.1 < last.soc < 1.1, f"soc {last.soc}"
    assert last.range is None or 0 <= last.range < 1e7, f"range {last.range}"


# --- running them -------------------------------------------------------------------------------------------------


def read_it(folder: Path, kind: str, rng: random.Random) -> tuple[Path, set[str], Callable[[], None]]:
    """A malformed file in `folder`; the keys of which a complaint should name one; what reads it."""
    named: set[str] = set()
    texts: dict[str, str | bytes] = {"v.toml": VEHICLE, **DBC, "calibration.toml": MANIFEST}
    if kind == "manifest":
        name = "calibration.toml"
        for data in (LOGS / "calibration").iterdir():
            (folder / data.name).touch()
        (folder / "scooter.toml").write_text(VEHICLE, encoding="utf-8")
    else:
        name = "v.toml" if kind in ("values", "lines", "bytes") else rng.choice(sorted(DBC))
    text = texts[name]
    assert isinstance(text, str)
    if kind in ("values", "manifest"):
        texts[name], named = keys(text, rng)
    elif kind in ("bytes", "dbc bytes"):
        texts[name] = damaged(text.encode(), rng)
    elif kind in IN_DBC:
        texts[name] = replaced(text, rng, kind)
    else:
        texts[name] = lines(text, rng)
    for file, content in texts.items():
        (folder / file).write_bytes(content if isinstance(content, bytes) else content.encode())

    def read() -> None:
        if kind == "manifest":
            read_manifest([folder])
            return
        vehicle = read_vehicle(folder / "v.toml")
        for problem in problems(vehicle):
            raise AssertionError(problem)
        if vehicle.battery:
            ridden(vehicle, rng)

    return folder / name, named, read


KINDS = (
    "values",
    "values",
    "lines",
    "bytes",
    "dbc numbers",
    "dbc names",
    "dbc layout",
    "dbc lines",
    "dbc bytes",
    "manifest",
)


def case(number: int, seed: int) -> tuple[str, str, str, float]:
    """(kind, what came of it, what is wrong with that or nothing, CPU [s]) of one file."""
    rng = random.Random(f"{seed}/{number}")
    kind = KINDS[number % len(KINDS)]
    with TemporaryDirectory() as name:
        folder = Path(name)
        file, named, read = read_it(folder, kind, rng)
        outcome, wrong = "read", ""
        began = time.process_time()
        try:
            read()
        except InputError as error:
            outcome, said = "refused", str(error)
            if file.name not in said and not (kind.startswith("dbc") and "v.toml" in said):
                wrong = f"does not name {file.name}: {said[:200]}"
            elif kind == "values" and not any(key.lower() in said.lower() for key in (*named, "not valid TOML", "dbc")):
                wrong = f"names none of {sorted(named)}: {said[:200]}"
            elif len(said) > 1000:
                wrong = f"a message of {len(said)} letters: {said[:200]}"
        except BaseException as error:  # a promise was broken, whatever this is
            outcome, wrong = "failed", f"{type(error).__name__}: {str(error)[:200]}"
        seconds = time.process_time() - began
    if seconds > LONGEST:
        wrong = wrong or f"took {seconds:.1f} s of CPU"
    return kind, outcome, wrong, seconds


def run(count: int, seed: int) -> Report:
    """`count` files drawn from `seed`."""
    report = Report()
    outcomes: Counter[str] = Counter()
    longest = 0.0
    for number in range(count):
        kind, outcome, wrong, seconds = case(number, seed)
        outcomes[outcome] += 1
        longest = max(longest, seconds)
        if wrong:
            report.failures.append(f"case({number}, {seed}), {kind}: {outcome}, {wrong}")
    report.rows = {
        "files": f"{count}: vehicle files, DBC files, manifests",
        "refused with file and key": str(outcomes["refused"]),
        "read, with sane numbers": str(outcomes["read"]),
        "other exceptions": str(outcomes["failed"]),
        "longest": f"{longest:.2f} s of CPU",
    }
    return report
