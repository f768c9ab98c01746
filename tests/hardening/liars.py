"""Sensors that lie, on a recorded ride through town: each fault against the same ride unspoilt, second by second.

No lie can be known before there is evidence of it. So the promise is: the interval of the range holds the range of the
unspoilt ride at the same second, but for at most `GRACE` seconds in all, and at the end; likewise the range is gone for
no longer unless somebody is named; the state of charge is within 3 sd at every second; whoever spoils the range is
named, and nobody is accused in the liar's stead. A lie that spoils nothing may stay unnamed.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import chain

from gz_onboard.can.codec import Codec
from gz_onboard.events import Estimate, State
from gz_onboard.recording.logs import read_frames
from tests.events import Event, EventEstimator, events_of
from tests.hardening import Report
from tests.support import LOGS, reference

TITLE = "Sensors that lie"
COUNT = 5
FULL_COUNT = 1000  # all that there are
RIDE = "city_14C"
BEGIN = 120.0  # s: when the lie begins; the ride lasts 732 s

Lie = Callable[[float, float], float]
"""What a sensor says, of (seconds since the lie began, what it should say)."""
Fault = tuple[tuple[str, ...], str, Callable[[], Lie]]
"""(the roles that lie, how, what makes a new lie)."""


def _stuck() -> Lie:
    first: list[float] = []

    def lie(t: float, value: float) -> float:
        first.append(value)
        del first[1:]
        return first[0]

    return lie


def _late(seconds: float) -> Lie:
    said: list[tuple[float, float]] = []

    def lie(t: float, value: float) -> float:
        said.append((t, value))
        while len(said) > 1 and said[1][0] <= t - seconds:
            del said[0]
        return said[0][1]

    return lie


def _noise(size: float) -> Lie:
    rng = random.Random(1)
    return lambda t, value: value + rng.gauss(0, size)


def _spikes(size: float) -> Lie:
    rng = random.Random(1)
    return lambda t, value: value + (size if rng.random() < 0.02 else 0.0)


def _linear(factor: float = 1.0, offset: float = 0.0, rate: float = 0.0) -> Callable[[], Lie]:
    """A gain, an offset and a drift [1/s]."""
    return lambda: lambda t, value: factor * value + offset + rate * t


def _kinds(size: float, full_scale: float) -> dict[str, Callable[[], Lie]]:
    """The usual lies; `size`: an offset that matters, in the role's unit."""
    return {
        "stuck": _stuck,
        "zero": _linear(0.0),
        "full scale": _linear(0.0, full_scale),
        "doubled": _linear(2.0),
        "halved": _linear(0.5),
        "sign flipped": _linear(-1.0),
        "too high": _linear(offset=size),
        "too low": _linear(offset=-size),
        "drifting": _linear(rate=size / 120),
        "noise": lambda: _noise(size),
        "spikes": lambda: _spikes(10 * size),
        "2 s late": lambda: _late(2.0),
    }


SIZES = {  # an offset that matters, full scale
    "motor_speed": (40.0, 100.0),
    "wheel_speed_rear": (40.0, 370.0),
    "wheel_speed_front": (40.0, 370.0),
    "gps_speed": (8.0, 150.0),
    "accel_x": (2.0, 60.0),
    "gps_altitude": (30.0, 6000.0),
    "pack_current": (20.0, 300.0),
    "inverter_current": (20.0, 300.0),
    "pack_voltage": (3.0, 100.0),
    "inverter_voltage": (3.0, 100.0),
}
BOTH = "pack_current", "inverter_current"
BY_HAND: list[Fault] = [
    *((("gps_altitude",), f"climbing {rate:g} m/s", _linear(rate=rate)) for rate in (0.1, 0.3, 1.0, 3.0, -1.0)),
    *((("accel_x",), f"{size:+g} m/s²", _linear(offset=size)) for size in (0.5, -0.5, 1.0, 5.0)),
    (("pack_current",), "-300 A", _linear(0.0, -300.0)),
    (("pack_current",), "5 A too high", _linear(offset=5.0)),
    (("pack_current",), "5 A too low", _linear(offset=-5.0)),
    (BOTH, "-300 A", _linear(0.0, -300.0)),
    (BOTH, "zero", _linear(0.0)),
    (BOTH, "stuck", _stuck),
    (BOTH, "doubled", _linear(2.0)),
    (BOTH, "halved", _linear(0.5)),
    (BOTH, "sign flipped", _linear(-1.0)),
    (("auxiliary_current",), "20 A too high", _linear(offset=20.0)),
    (("cell_temperature",), "85 °C", _linear(0.0, 85.0)),
    (("cell_temperature",), "-40 °C", _linear(0.0, -40.0)),
    (("cell_temperature",), "20 K too high", _linear(offset=20.0)),
    (("ambient_temperature",), "25 K too low", _linear(offset=-25.0)),
    (("motor_temperature",), "214 °C", _linear(0.0, 214.0)),
    (("accel_z",), "zero", _linear(0.0)),
    (("accel_y",), "+20 m/s²", _linear(offset=20.0)),
    (("rate_x",), "+1 rad/s", _linear(offset=1.0)),
    (("rate_z",), "stuck", _stuck),
]
GRACE = 60.0  # s: time of detection, some 500 m of a ride through town


def faults() -> list[Fault]:
    """All of them."""
    usual = [((role,), kind, make) for role, sizes in SIZES.items() for kind, make in _kinds(*sizes).items()]
    return [*BY_HAND, *usual]


@cache
def _events() -> tuple[Codec, tuple[Event, ...]]:
    codec = Codec(reference().mapping)
    return codec, tuple(chain.from_iterable(events_of(codec, batch) for batch in read_frames(LOGS / f"{RIDE}.blf")))


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
    estimator = EventEstimator(codec.groups, vehicle.pack, vehicle.model, vehicle.riding)
    made: list[Estimate] = []
    for event in _spoilt(events, lies):
        while event[0] >= len(made) + 1:
            made.append(estimator.estimate(len(made) + 1.0))
        estimator.handle(event)
    return made


@dataclass(frozen=True, slots=True)
class Judgement:
    """What a lie made of the estimates after it had begun."""

    named: dict[str, float]  # role that was distrusted -> after how many seconds, the first of them first
    gone: float  # s without a range that the unspoilt ride has
    outside: float  # s in which P10 to P90 do not hold the range of the unspoilt ride
    outside_valid: float  # s of these in which the estimate was said to be valid
    worst: float  # range over that of the unspoilt ride, where it is furthest off of these
    soc_off: float  # sd, at worst
    end: tuple[float, float, float] | None  # P10, range and P90 over the range of the unspoilt ride, in the last second

    @property
    def holds_at_end(self) -> bool:
        """Whether the interval of the last second, if any, holds the range of the unspoilt ride."""
        return self.end is None or self.end[0] <= 1 <= self.end[2]

    def broken(self, liars: Sequence[str]) -> list[str]:
        """The promises that were broken."""
        broken = []
        if not self.holds_at_end:
            broken.append("the interval fails at the end")
        if self.outside > GRACE:
            broken.append(f"the interval fails for {self.outside:.0f} s")
        if self.gone > GRACE and not self.named:
            broken.append(f"no range for {self.gone:.0f} s and nobody named")
        if self.soc_off > 3:
            broken.append(f"SOC off by {self.soc_off:.1f} sd")
        if self.named and not set(self.named) & set(liars):
            broken.append(f"{', '.join(self.named)} accused")
        if self.outside and not set(self.named) & set(liars):
            broken.append("not named though it spoils the range")
        return broken

    def told(self) -> str:
        """As a row of the table."""
        named = ", ".join(f"{role} after {seconds:.0f} s" for role, seconds in self.named.items())
        text = f"named: {named or 'nobody'}; "
        if self.end is None:
            text += "no range at the end"
        else:
            p10, range_, p90 = self.end
            text += f"range at the end {range_ - 1:+.0%} ({p10:.2f} to {p90:.2f})"
        if self.gone:
            text += f"; no range for {self.gone:.0f} s"
        if self.outside:
            text += f"; **outside for {self.outside:.0f} s** (of which valid {self.outside_valid:.0f} s), "
            text += f"worst ratio {self.worst:.2f}"
        return f"{text}; SOC {self.soc_off:.1f} σ"


def judged(made: Sequence[Estimate], true: Sequence[Estimate]) -> Judgement:
    """Hold the estimates of a spoilt ride, one each second, against those of the unspoilt one."""
    named: dict[str, float] = {}
    outside: list[tuple[float, State]] = []  # range over the true one
    gone, soc_off = 0, 0.0
    end: tuple[float, float, float] | None = None
    for e, expected in zip(made, true, strict=True):
        if e.time < BEGIN:
            continue
        for role in e.distrusted:
            named.setdefault(role, e.time - BEGIN)
        if e.soc is not None and e.soc_sd is not None and expected.soc is not None:
            soc_off = max(soc_off, abs(e.soc - expected.soc) / e.soc_sd)
        if expected.range is None or expected.state is State.INVALID:
            continue
        end = _relative(e, expected.range)
        if end is None:
            gone += 1
        elif not end[0] <= 1 <= end[2]:
            outside.append((end[1], e.state))
    return Judgement(
        named=named,
        gone=gone,
        outside=len(outside),
        outside_valid=sum(state is State.VALID for _, state in outside),
        worst=max((ratio for ratio, _ in outside), key=lambda ratio: abs(ratio - 1), default=1.0),
        soc_off=soc_off,
        end=end,
    )


def _relative(e: Estimate, true: float) -> tuple[float, float, float] | None:
    """(P10, range, P90) over the true range; None where none is published."""
    if e.state is State.INVALID or e.range is None or e.range_p10 is None or e.range_p90 is None:
        return None
    return e.range_p10 / true, e.range / true, e.range_p90 / true


def run(count: int, seed: int) -> Report:
    """`count` of the faults, or all that there are."""
    every = faults()
    chosen = every if count >= len(every) else random.Random(seed).sample(every, count)
    true = ridden(None)
    report = Report()
    if any(e.distrusted for e in true):
        report.failures.append("a healthy sensor is accused")
    always = ended = named = slow = others = 0
    for fault in chosen:
        roles, kind, _ = fault
        name = f"{' and '.join(roles)}: {kind}"
        found = judged(ridden(fault), true)
        broken = found.broken(roles)
        always += not found.outside
        ended += found.holds_at_end
        named += bool(set(found.named) & set(roles))
        others += bool(set(found.named) - set(roles))
        slow += bool(found.named) and max(found.named.values()) > GRACE
        if broken or not found.named:  # all others: in the counts below
            report.rows[name] = found.told()
        if broken:
            report.failures.append(f"{name}: {'; '.join(broken)}")
    of = f"of {len(chosen)}"
    report.rows["all: interval holds the true range at every second"] = f"{always} {of}"
    report.rows["all: interval holds the true range at the end"] = f"{ended} {of}"
    report.rows["all: faulty sensor named"] = f"{named} {of}"
    report.rows[f"all: named later than {GRACE:.0f} s"] = f"{slow} {of}"
    report.rows["all: a healthy sensor named as well"] = f"{others} {of}"
    return report
