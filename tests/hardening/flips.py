"""A saved state that is damaged: on the card, or whole and with other values than an estimator would save."""

from __future__ import annotations

import json
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

from gz_onboard import state
from gz_onboard.can.codec import Codec
from gz_onboard.daemon.loop import Daemon
from gz_onboard.events import Group
from tests.events import Event, EventEstimator, events_of
from tests.hardening import Report, quiet
from tests.support import S, Scooter, check_estimate, reference

TITLE = "A damaged saved state"
COUNT = 1500
FULL_COUNT = 28_000

ODD: tuple[Any, ...] = (None, True, -1, 0, 1e308, 2**70, "", "a", [], [None], {}, {"a": {}}, [[[]]], -0.5, -1e300)
ODOMETER = 3210.0  # km


def damaged(text: bytes, source: Random) -> bytes:
    """The bytes of a file with some of them changed, cut off, left out, doubled or moved."""
    data = bytearray(text)
    at = source.randrange(len(data))
    match source.randrange(7):
        case 0 | 1:
            for _ in range(source.randrange(1, 5)):
                data[source.randrange(len(data))] ^= 1 << source.randrange(8)
        case 2:
            data[at] = source.randrange(256)
        case 3:
            del data[at : at + source.choice((1, 16, 4096))]
        case 4:
            length = source.choice((1, 16, 512, 4096))
            data[at : at + length] = bytes(min(length, len(data) - at))
        case 5:
            data[at:at] = data[source.randrange(len(data)) :][: source.choice((1, 20, 1000))]
        case 6:
            digits = [i for i, byte in enumerate(data) if chr(byte).isdigit()]
            data[source.choice(digits)] = ord(source.choice("0123456789"))
    return bytes(data)


def with_odd_values(snapshot: dict[str, Any], source: Random) -> dict[str, Any]:
    """A snapshot with an odd value somewhere in it, or something missing."""
    changed: dict[str, Any] = json.loads(json.dumps(snapshot))
    part: Any = changed
    while True:
        key = source.choice(list(part) if isinstance(part, dict) else range(len(part)))
        inner = part[key]
        if not (isinstance(inner, dict | list) and inner and source.random() < 0.7):
            break
        part = inner
    if source.random() < 0.2:
        del part[key]
    else:
        part[key] = source.choice(ODD)
    return changed


def _difference(a: Any, b: Any) -> str:
    """What of a snapshot was changed."""
    if isinstance(a, dict) and isinstance(b, dict):
        return ", ".join(f"{k} {_difference(a[k], b.get(k, 'is missing'))}" for k in a if a[k] != b.get(k))
    return f"{a!r:.60} -> {b!r:.60}"


@cache
def _ride(seconds: float, odometer: float) -> tuple[Event, ...]:
    """A ride that begins where the odometer shows so much [km]."""
    scooter = Scooter()
    frames = scooter.steady(seconds)
    for second in range(round(seconds)):
        way = odometer + 0.01 * second
        frames.append(scooter.frame("VCU_Odometer", frames[0][0] + second * S, VCU_Odometer=way))
    return tuple(events_of(Codec(reference().mapping), sorted(frames)))


@cache
def _groups() -> Sequence[Group]:
    return Codec(reference().mapping).groups


def _estimator() -> EventEstimator:
    vehicle = reference()
    return EventEstimator(_groups(), vehicle.pack, vehicle.model, vehicle.riding)


def ride_on(snapshot: Mapping[str, Any], source: Random) -> None:
    """Go on from a snapshot that was taken for sound, ride for ten seconds and save. Raises what goes wrong."""
    estimator, key = _estimator(), reference().key
    estimator.restore(snapshot, key, source.choice((None, 0.0, 5.0, 3600.0, 1e7)))
    told = 0
    for event in _ride(10.0, source.choice((0.0, ODOMETER, ODOMETER + 1.5))):
        estimator.handle(event)
        if event[0] >= told + 1:
            told += 1
            check_estimate(estimator.estimate(event[0]))
    after = estimator.snapshot(key)
    assert told >= 9
    assert after is not None
    state.encode(after, time.time())


def run(count: int, seed: int) -> Report:
    """`count` cases: three of four have damaged bytes, one has odd values under a right checksum."""
    source = Random(seed)
    estimator = _estimator()
    for event in _ride(70.0, ODOMETER):  # long enough for a piece of way
        estimator.handle(event)
    snapshot = json.loads(json.dumps(estimator.snapshot(reference().key)))
    previous = {**snapshot, "soc": 0.123}
    outcomes: Counter[str] = Counter()
    failures = []
    with quiet(), tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scooter.json"
        for number in range(count):
            damage = odd_values if number % 4 == 3 else damaged_bytes
            try:
                outcomes[damage(file, snapshot, previous, source)] += 1
            except Exception as error:
                failures.append(f"seed {seed}, case {number}: {type(error).__name__}: {error}")
    rows = {
        "cases": f"{count:,}",
        "damaged bytes, refused": f"{outcomes['refused']:,}",
        "damaged bytes, went on from the state before": f"{outcomes['state before']:,}",
        "odd values under a right checksum: plausible, ridden on with": f"{outcomes['odd']:,} of {count // 4:,}",
        "altered values used, exceptions": str(len(failures)),
    }
    return Report(rows, failures)


def damaged_bytes(file: Path, snapshot: dict[str, Any], previous: dict[str, Any], source: Random) -> str:
    """What came of a state with damaged bytes, half of the times with a sound one before it."""
    latest, before = state.copies(file)
    text, text_before = (state.encode(values, time.time()) for values in (snapshot, previous))
    there = damaged(text, source)
    latest.write_bytes(there)
    before.unlink(missing_ok=True)
    keep = source.random() < 0.5
    if keep:
        before.write_bytes(text_before)
    if source.random() < 0.3:
        file.with_suffix(".new").write_bytes(text[: source.randrange(len(text))])
    found = Daemon(reference(), [], None, file).restore()
    if there == text:
        return "unharmed"
    assert found == (previous if keep else None), "not the state before"
    return "state before" if keep else "refused"


def odd_values(file: Path, snapshot: dict[str, Any], previous: dict[str, Any], source: Random) -> str:
    """What came of a state with an odd value and a right checksum, a sound one before it."""
    latest, before = state.copies(file)
    latest.write_bytes(state.encode(with_odd_values(snapshot, source), time.time()))
    before.write_bytes(state.encode(previous, time.time()))
    found = Daemon(reference(), [], None, file).restore()
    if found == previous:
        return "state before"
    assert found is not None
    try:
        ride_on(found, source)
    except Exception as error:
        raise AssertionError(f"{error!r}: {_difference(snapshot, found)}") from error
    return "odd"
