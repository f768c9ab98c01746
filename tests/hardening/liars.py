"""Sensors that lie, on a recorded ride through town: each fault against the same ride unspoilt."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from itertools import chain

from gz_onboard.bus.codec import Codec
from gz_onboard.bus.logs import read_frames
from gz_onboard.estimator.estimator import Estimator
from gz_onboard.events import Estimate, Event
from tests.hardening.report import Report
from tests.support import LOGS, reference

TITLE = "Sensors that lie"
COUNT = 8
FULL_COUNT = 1000  # all that there are
RIDE = "city_14C"
BEGIN = 120.0  # s: when the lie begins; the ride lasts 732 s

Lie = Callable[[float, float], float | None]
"""What a sensor says, of (seconds since the lie began, what it should say)."""
Fault = tuple[tuple[str, ...], str, Callable[[], Lie]]
"""(the roles that lie, how, what makes the lie anew)."""


def _stuck() -> Lie:
    first: list[float] = []

    def lie(t: float, value: float) -> float:
        first.append(value)
        del first[1:]
        return first[0]

    return lie


def _noise(size: float) -> Lie:
    rng = random.Random(1)
    return lambda t, value: value + rng.gauss(0, size)


def _spikes(size: float) -> Lie:
    rng = random.Random(1)
    return lambda t, value: value + (10 * size if rng.random() < 0.02 else 0.0)


def _late(seconds: float) -> Lie:
    said: list[tuple[float, float]] = []

    def lie(t: float, value: float) -> float:
        said.append((t, value))
        while len(said) > 1 and said[1][0] <= t - seconds:
            del said[0]
        return said[0][1]

    return lie


def _plain(lie: Lie) -> Callable[[], Lie]:
    return lambda: lie


def _climbing(rate: float) -> Callable[[], Lie]:
    return lambda: lambda t, value: value + rate * t


def _off(size: float) -> Callable[[], Lie]:
    return lambda: lambda t, value: value + size


def _kinds(size: float, full_scale: float) -> dict[str, Callable[[], Lie]]:
    """The usual lies; `size`: an offset that matters, in the role's unit."""
    return {
        "stuck": _stuck,
        "zero": _plain(lambda t, v: 0.0),
        "full scale": _plain(lambda t, v: full_scale),
        "doubled": _plain(lambda t, v: 2 * v),
        "halved": _plain(lambda t, v: v / 2),
        "sign flipped": _plain(lambda t, v: -v),
        "too high": _plain(lambda t, v: v + size),
        "too low": _plain(lambda t, v: v - size),
        "drifting": _plain(lambda t, v: v + size * t / 120),
        "noise": lambda: _noise(size),
        "spikes": lambda: _spikes(size),
        "2 s late": lambda: _late(2.0),
    }


SIZES = {  # an offset that matters, full scale
    "motor_speed": (40.0, 100.0), "wheel_speed_rear": (40.0, 370.0), "wheel_speed_front": (40.0, 370.0),
    "gps_speed": (8.0, 150.0), "accel_x": (2.0, 60.0), "gps_altitude": (30.0, 6000.0), "pack_current": (20.0, 300.0),
    "inverter_current": (20.0, 300.0), "pack_voltage": (3.0, 100.0), "inverter_voltage": (3.0, 100.0),
}  # fmt: skip
BOTH = "pack_current", "inverter_current"
BY_HAND: list[Fault] = [
    *((("gps_altitude",), f"climbing {rate:g} m/s", _climbing(rate)) for rate in
      (0.1, 0.3, 1.0, 3.0, -1.0)),
    *((("accel_x",), f"{size:+g} m/s²", _off(size)) for size in (0.5, -0.5, 1.0, 5.0)),
    (("pack_current",), "-300 A", _plain(lambda t, v: -300.0)),
    (("pack_current",), "5 A too high", _plain(lambda t, v: v + 5.0)),
    (("pack_current",), "5 A too low", _plain(lambda t, v: v - 5.0)),
    (BOTH, "-300 A", _plain(lambda t, v: -300.0)),
    (BOTH, "zero", _plain(lambda t, v: 0.0)),
    (BOTH, "stuck", _stuck),
    (BOTH, "doubled", _plain(lambda t, v: 2 * v)),
    (BOTH, "halved", _plain(lambda t, v: v / 2)),
    (BOTH, "sign flipped", _plain(lambda t, v: -v)),
    (("auxiliary_current",), "20 A too high", _plain(lambda t, v: v + 20.0)),
    (("cell_temperature",), "85 °C", _plain(lambda t, v: 85.0)),
    (("cell_temperature",), "-40 °C", _plain(lambda t, v: -40.0)),
    (("cell_temperature",), "20 K too high", _plain(lambda t, v: v + 20.0)),
    (("ambient_temperature",), "25 K too low", _plain(lambda t, v: v - 25.0)),
    (("motor_temperature",), "214 °C", _plain(lambda t, v: 214.0)),
    (("accel_z",), "zero", _plain(lambda t, v: 0.0)),
    (("accel_y",), "+20 m/s²", _plain(lambda t, v: v + 20.0)),
    (("rate_x",), "+1 rad/s", _plain(lambda t, v: v + 1.0)),
    (("rate_z",), "stuck", _stuck),
]  # fmt: skip
UNSEEN = {  # known limits, told in the table and promised nowhere
    (("gps_altitude",), "climbing 0.1 m/s"): "less than a receiver wanders and an accelerometer is tilted",
    (BOTH, "halved"): "a frugal rider looks the same",
    (("motor_speed",), "2 s late"): "the accelerometer is named in its stead",
}


def faults() -> list[Fault]:
    """All of them."""
    usual = [((role,), kind, make) for role, sizes in SIZES.items() for kind, make in _kinds(*sizes).items()]
    return [*BY_HAND, *usual]


@cache
def _events() -> tuple[Codec, tuple[Event, ...]]:
    codec = Codec(reference().mapping)
    return codec, tuple(chain.from_iterable(codec.decode(batch) for batch in read_frames(LOGS / f"{RIDE}.blf")))


def _spoilt(events: Sequence[Event], lies: Mapping[int, Sequence[tuple[int, Lie]]]) -> Iterator[Event]:
    for time, group, values in events:
        changed = list(values)
        for place, lie in lies.get(group, ()) if time >= BEGIN else ():
            value = changed[place]
            changed[place] = None if value is None else lie(time - BEGIN, value)
        yield time, group, tuple(changed)


def ridden(fault: Fault | None) -> list[Estimate]:
    """An estimate each second of the ride with a fault, or none."""
    codec, events = _events()
    roles, _, make = fault or ((), "", _stuck)
    lies = {
        group: [(own.roles.index(role), make()) for role in roles if role in own.roles]
        for group, own in enumerate(codec.groups)
        if any(role in own.roles for role in roles)
    }
    vehicle = reference()
    estimator = Estimator(codec.groups, vehicle.pack, vehicle.model, vehicle.riding)
    made: list[Estimate] = []
    for event in _spoilt(events, lies):
        while event[0] >= len(made) + 1:
            made.append(estimator.estimate(len(made) + 1.0))
        estimator.handle(event)
    return made


def run(count: int, seed: int) -> Report:
    """`count` of the faults, or all that there are: what was published at the end of the ride."""
    every = faults()
    chosen = every if count >= len(every) else random.Random(seed).sample(every, count)
    true = ridden(None)
    report = Report()
    if any(e.distrusted for e in true):
        report.failures.append("a healthy sensor is accused")
    held = named = others = 0
    for fault in chosen:
        row, failure, tallies = _judged(fault, true)
        roles, kind, _ = fault
        held, named, others = held + tallies[0], named + tallies[1], others + tallies[2]
        report.rows[f"{' and '.join(roles)}: {kind}"] = row
        if failure and (roles, kind) not in UNSEEN:
            report.failures.append(f"{' and '.join(roles)}: {kind}: {failure}")
    report.rows["all: interval holds the true range"] = f"{held} of {len(chosen)}"
    report.rows["all: liar named"] = f"{named} of {len(chosen)}"
    report.rows["all: a healthy sensor named beside"] = f"{others} of {len(chosen)}"
    return report


def _judged(fault: Fault, true: Sequence[Estimate]) -> tuple[str, str, tuple[bool, bool, bool]]:
    """(row of the table, what promise was broken, (interval holds, liar named, a healthy sensor named))."""
    roles, _, _ = fault
    made = ridden(fault)
    last, expected = made[-1], true[-1]
    numbers = last.range, last.range_p10, last.range_p90, last.soc, last.soc_sd
    first = next((e for e in made if e.distrusted), None)
    seen = sorted({role for e in made for role in e.distrusted})
    told = f"{', '.join(seen)} named after {first.time - BEGIN:.0f} s" if first else "nobody named"
    if None in numbers or expected.range is None or expected.soc is None:
        return (
            f"{told}; no range",
            "" if first else "nothing published and nobody named",
            (True, bool(first), bool(set(seen) - set(roles))),
        )
    range_, p10, p90, soc, soc_sd = (float(x or 0.0) for x in numbers)
    holds, off = p10 <= expected.range <= p90, (soc - expected.soc) / soc_sd
    row = f"{told}; range {range_ / expected.range - 1:+.0%} ({p10 / expected.range:.2f} to {p90 / expected.range:.2f})"
    row += f"; SOC {off:+.1f} σ{'' if holds else '; **interval fails**'}"
    reason = UNSEEN.get((roles, fault[1]))
    row += f"; not seen: {reason}" if reason and not first else ""
    broken = []
    if not holds:
        broken.append(f"true range {expected.range:.0f} m outside {p10:.0f} to {p90:.0f} m")
    if abs(off) > 3:
        broken.append(f"SOC off by {off:.1f} sd")
    if first and not set(seen) & set(roles):
        broken.append(f"{', '.join(seen)} accused")
    return row, "; ".join(broken), (holds, bool(set(seen) & set(roles)), bool(set(seen) - set(roles)))
