"""A log against a vehicle file: what fills each role, what looks right and what wrong, what is missing for what."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Annotated

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.can.codec import LONGEST_PAUSE_NS, RANGE, Codec
from gz_onboard.can.layout import identifier_of
from gz_onboard.can.mapping import UNITS, BusMapping, Source
from gz_onboard.can.requests import NEGATIVE
from gz_onboard.estimation.ride import PAUSE_S
from gz_onboard.estimator.signals import TIMING
from gz_onboard.events import STALE_PERIODS, Group, hexadecimal, words
from gz_onboard.recording.frames import FrameColumns
from gz_onboard.recording.recording import Recording, facts_of, open_ride, read_roles, ride_name
from gz_onboard.reports.results import clock, leap_text
from gz_onboard.vehicle import Vehicle
from gz_onboard.vehicle_check import charge, electric, motion, others
from gz_onboard.vehicle_check.features import NEEDS, Feature, features_of, features_text
from gz_onboard.vehicle_check.finding import Finding, Looks, unknown, wrong
from gz_onboard.vehicle_check.on_board import on_board
from gz_onboard.vehicle_check.rolling import MOTOR, rolling_of
from gz_onboard.vehicle_check.seconds import FEWEST, Seconds, seconds_of

CHECK_VERSION = 1
RARE = 0.9  # of the time: a signal that is there for less is told
MOST_DIGITS = 2  # hexadecimal, in which an identifier may differ from the one that was meant
DROPPED = 0.01  # of the values: as many out of the limits are wrong limits, or a wrong layout
_LATER = unknown("on board", (), "not tried: what looks wrong would mislead it")


@dataclass(frozen=True)
class RoleSeen:
    """What a log has of a role."""

    role: Annotated[str, "its name"]
    signal: Annotated[str, "its signal in the DBC file"]
    looks: Annotated[Looks, "looks right, looks wrong, or cannot tell"]
    unit: Annotated[str, "of low and high"]
    rate_hz: Annotated[float | None, "how often it comes; null if it came less than twice"]
    low: Annotated[float | None, "least value"]
    high: Annotated[float | None, "greatest value"]
    share: Annotated[float, "of the log's time in which it is valid, 0 to 1"]


@dataclass(frozen=True)
class Checked:
    """A log."""

    file: Annotated[str, "the log"]
    duration_s: Annotated[float, "from the first to the last value, without pauses"]
    roles: Annotated[list[RoleSeen], "of the vehicle file"]
    findings: Annotated[list[Finding], "all checks"]
    features: Annotated[list[Feature], "and what is missing for each"]

    def those(self, looks: Looks) -> list[Finding]:
        """The findings with this verdict."""
        return [finding for finding in self.findings if finding.looks is looks]


def check_log(
    log: Path, vehicle: Vehicle, progress: Callable[[int], None] | None = None, quick: bool = False
) -> Checked:
    """Check one log; quick: without `on_board`. Raises InputError for one that cannot be read."""
    mapping, frames = open_ride(log, vehicle)
    codec = Codec(mapping, LONGEST_PAUSE_NS)
    columns = read_roles(log, vehicle, codec, frames)
    if progress:
        progress(len(frames))
    lengths = _last_lengths(frames) if isinstance(frames, FrameColumns) else {}
    samples = Recording(ride_name(log), columns, facts_of(log))
    findings = [unknown("clock", (), leap_text(*leap)) for leap in codec.leaps]
    findings += _never_came(codec, columns, lengths, _passed(columns)[0])
    findings += [*_dropped(codec, columns), *_unanswered(codec, columns)]
    ride = seconds_of(samples, vehicle) if columns else None
    if ride:
        if len(ride.time) < FEWEST:
            findings.append(unknown("length", (), f"{_passed(columns)[0]:.1f} s: most checks need {FEWEST} s and more"))
        checks = checks_of(ride, vehicle, samples.rider_mass)
        findings += electric.unless_contradicted(checks)
    if ride and not quick:
        suspected = any(finding.looks is Looks.WRONG for finding in findings)
        load = all(one.looks is Looks.RIGHT for one in findings if one.check == electric.BY_POWER)
        findings += [_LATER] if suspected else on_board(log, vehicle, load, electric.drawn(ride, vehicle))
    duration, end = _passed(columns)
    seen = _roles(mapping, codec.groups, samples, (duration, end), findings)
    return Checked(str(log), duration, seen, findings, features_of(columns))


def _passed(columns: Mapping[str, tuple[Array, Array]]) -> tuple[float, float]:
    """(time [s] that passed while values came, without pauses; when the last one came)."""
    if not columns:
        return 0.0, 0.0
    start = min(float(times[0]) for times, _ in columns.values())
    end = max(float(times[-1]) for times, _ in columns.values())
    steps = np.diff(np.unique(np.concatenate([np.floor(times) for times, _ in columns.values()])))
    return end - start - float(steps[steps > PAUSE_S].sum()), end


def _last_lengths(frames: FrameColumns) -> dict[int, int]:
    """Bytes of the last frame of each identifier."""
    backwards = frames[::-1]
    identifiers, last = np.unique(backwards.identifier, return_index=True)
    return dict(zip(identifiers.tolist(), backwards.length[last].tolist(), strict=True))


def _never_came(
    codec: Codec, columns: Collection[str], lengths: Mapping[int, int], duration: float
) -> Iterator[Finding]:
    """Roles of the file that the range needs, and of which a log of that `duration` [s] has no value."""
    needed, wanted = NEEDS["range"]
    for group in (*needed, *wanted):
        silent = [source for source in codec.mapping.sources if source.role in group]
        late = min((_stale(codec.mapping.periods.get(source.message)) for source in silent), default=0.0)
        if silent and not set(group) & set(columns) and duration > late:
            roles = tuple(source.role for source in silent)
            without = "no range" if group in needed else "no energy"
            text = f"{words(roles[0])} never came: {without}{_likely_identifier(codec, silent[0], lengths)}"
            yield wrong("never came", roles, text)


def _stale(period: float | None) -> float:
    """When a signal of this `period` [s] is stale [s]."""
    return STALE_PERIODS * period if period else TIMING.unknown_stale


def _likely_identifier(codec: Codec, source: Source, lengths: Mapping[int, int]) -> str:
    """The unknown identifier that is most like that of a message which never came, if its frames are as long."""
    message = next((m for m in codec.mapping.database.messages if m.name == source.message), None)
    if message is None:
        return ""
    for channel, identifier in codec.heard(message.name):
        return f"; {message.name} came on channel {channel} as {hexadecimal(identifier)}: see [bus] of the vehicle file"
    wanted = hexadecimal(identifier_of(message))
    digits = {one: sum(a != b for a, b in zip(hexadecimal(one), wanted, strict=False)) for one in codec.unknown}
    found = [one for one in digits if lengths.get(one) == message.length and len(hexadecimal(one)) == len(wanted)]
    best = min(found, key=lambda one: digits[one], default=None)
    if best is None or digits[best] > MOST_DIGITS:
        return f"; {source.message} is {wanted} in the DBC file"
    return (
        f"; {source.message} is {wanted} in the DBC file, and {hexadecimal(best)}, which no file knows, has "
        f"{message.length} bytes too and came {codec.unknown[best]} times"
    )


def _dropped(codec: Codec, columns: Mapping[str, tuple[Array, Array]]) -> Iterator[Finding]:
    """Signals whose values were dropped, out of the limits of the DBC file or of any vehicle."""
    roles = {f"{source.message}.{source.signal}": source.role for source in codec.mapping.sources}
    for (name, reason), count in sorted(codec.faults.items()):
        role = roles.get(name)
        kept = len(columns[role][0]) if role and role in columns else 0
        if role and reason == RANGE and count > DROPPED * (count + kept):
            text = f"{count} of {count + kept} values were dropped: out of the DBC file's limits, or of a vehicle's"
            yield wrong("limits", (role,), text)


def _unanswered(codec: Codec, columns: Mapping[str, tuple[Array, Array]]) -> Iterator[Finding]:
    """Requests whose answers have another length than the file says, and those that an ECU refused."""
    roles: dict[str, tuple[str, ...]] = {}
    for source in codec.mapping.sources:
        roles[source.message] = (*roles.get(source.message, ()), source.role)
    for request in codec.mapping.requests:
        named = roles.get(request.name, ())
        if request.name in codec.wrong_lengths:
            text = (
                f"{request.name} has {codec.wrong_lengths[request.name]} bytes, the file says {request.message.length}"
            )
            yield wrong("length of the answer", named, text)
    for (place, reason), count in sorted(codec.faults.items()):
        if reason.startswith(NEGATIVE):
            silent = tuple(
                role for of in codec.mapping.requests for role in roles.get(of.name, ()) if role not in columns
            )
            yield unknown("requests", silent, f"{count} times {reason} on {place}")


def checks_of(ride: Seconds, vehicle: Vehicle, payload: float | None) -> Iterator[Finding]:
    """All that a ride says of itself and the vehicle file; payload [kg], if known."""
    rolling = rolling_of(ride, motion.speeds_of(ride, vehicle), vehicle)
    speeds = rolling.speeds
    by_speed = list(motion.check_speeds(ride, speeds))
    doubted = frozenset(role for finding in by_speed if finding.looks is Looks.WRONG for role in finding.roles)
    turned = frozenset(role for finding in by_speed if finding.check == motion.SIGN for role in finding.roles)
    sized = frozenset(one for f in by_speed if f.looks is Looks.WRONG and f.check != motion.SIGN for one in f.roles)
    # what only follows from a sign that is already named is no other's mistake
    right_way = replace(ride, columns={**ride.columns, **{role: -ride[role] for role in turned}})
    forward = {role: -speed if role in turned else speed for role, speed in speeds.items()}
    best = next((role for role in forward if role not in doubted), next(iter(forward), None))
    speed = forward[best] if best else None
    motor_off = MOTOR in sized.union(*(finding.roles for finding in rolling.findings))
    of = electric.drawn(ride, vehicle)
    return chain(
        rolling.findings,
        rolling.by_what_fits(by_speed),
        rolling.by_what_fits(motion.check_distances(ride, speeds, doubted, vehicle.parameters["wheel_radius"])),
        motion.check_accelerations(ride, speeds, doubted),
        motion.check_turning(ride, speeds),
        electric.check_voltages(ride, vehicle.battery, of.current if of else None) if vehicle.battery else (),
        electric.check_sag(of) if of else (),
        _unless_at_a_wrong_speed(
            best in sized, electric.check_road(ride, of, speed, electric.model_power(ride, vehicle, speed, payload))
        )
        if of and speed is not None
        else (),
        electric.check_currents(ride),
        _unless_at_a_wrong_speed(motor_off, electric.check_motor(right_way, of)),
        charge.check_charge(ride, of, vehicle),
        others.check_temperatures(ride, speed),
        others.check_switches(ride, speed),
        others.check_throttle(ride, of.current if of else None),
        others.check_stuck(ride, speed, any(motion.BENCH in finding.text for finding in by_speed)),
    )


def _unless_at_a_wrong_speed(off: bool, findings: Iterable[Finding]) -> list[Finding]:
    """What follows from the size of a speed accuses nobody if that is `off`; a sign does not follow from it."""
    text = "; the speed that it is by is wrong"
    return [
        unknown(one.check, one.roles, one.text + text)
        if off and one.looks is Looks.WRONG and "sign" not in one.text
        else one
        for one in findings
    ]


def _roles(
    mapping: BusMapping,
    groups: Sequence[Group],
    samples: Recording,
    span: tuple[float, float],
    findings: Sequence[Finding],
) -> list[RoleSeen]:
    """span: as of `_passed`."""
    periods = {group.message: group.period for group in groups}
    found = []
    for source in mapping.sources:
        said = {finding.looks for finding in findings if source.role in finding.roles}
        looks = next((verdict for verdict in (Looks.WRONG, Looks.RIGHT) if verdict in said), Looks.UNKNOWN)
        rate = low = high = None
        share = 0.0
        if source.role in samples.columns:
            times, values = samples.columns[source.role]
            stale = _stale(periods.get(source.message))
            rate = 1 / max(float(np.median(np.diff(times))), 1e-6) if len(times) > 1 else None
            low, high = float(values.min()), float(values.max())
            held = float(np.minimum(np.diff(times, append=span[1]), stale).sum())
            share = min(held / max(span[0], 1e-9), 1.0)
        found.append(RoleSeen(source.role, source.signal, looks, UNITS[source.role], rate, low, high, share))
    return found


def check_text(checked: Checked) -> str:
    """For a terminal."""
    said, count = "looks right" if checked.those(Looks.RIGHT) else "cannot tell", len(checked.those(Looks.WRONG))
    if count:
        often = Counter(role for finding in checked.those(Looks.WRONG) for role in finding.roles).most_common(2)
        clear = len(often) == 1 or (len(often) == 2 and often[0][1] > often[1][1])
        above_all = f", above all {often[0][0]}" if clear else ""
        said = "one thing looks wrong" if count == 1 else f"{count} things look wrong{above_all}"
    lines = [f"{checked.file} ({clock(checked.duration_s)}): {said}"]
    lines += [f"  {seen.role:21} {_seen_text(seen)}" for seen in checked.roles]
    for looks in (Looks.WRONG, Looks.RIGHT, Looks.UNKNOWN):
        if those := checked.those(looks):
            lines += [f"{looks}:", *(f"  {f.check}{_about(f.roles)}: {f.text}" for f in those)]
    return "\n".join([*lines, features_text(checked.features)])


def _about(roles: Sequence[str]) -> str:
    return f" ({', '.join(roles)})" if roles else ""


def _seen_text(seen: RoleSeen) -> str:
    if seen.low is None or seen.high is None:
        return f"never came ({seen.signal})"
    unit = "" if seen.unit == "1" else f" {seen.unit}"
    share = "" if seen.share > RARE else f", only {seen.share:.0%} of the time"
    often = "once" if seen.rate_hz is None else f"{seen.rate_hz:.3g} Hz"
    return f"{often}, {seen.low:.4g} to {seen.high:.4g}{unit}{share}: {seen.looks}"
