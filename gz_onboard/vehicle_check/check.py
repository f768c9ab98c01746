"""A log against a vehicle file: the signal of each role, likely mistakes, and missing roles."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import hypot, sqrt
from pathlib import Path
from typing import Annotated

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.can.codec import LONGEST_PAUSE_NS, RANGE, Codec
from gz_onboard.can.layout import identifier_of
from gz_onboard.can.mapping import UNITS, Source
from gz_onboard.can.requests import NEGATIVE
from gz_onboard.errors import InputError
from gz_onboard.estimation.ride import PAUSE_S, RideOptions, open_estimate, run_ride
from gz_onboard.estimation.summary import POOR_FIT_V, summary_of
from gz_onboard.estimator.signals import TIMING
from gz_onboard.events import STALE_PERIODS, hexadecimal, words
from gz_onboard.recording.frames import FrameColumns
from gz_onboard.recording.recording import Recording, facts_of, open_ride, read_roles, ride_name
from gz_onboard.reports.results import clock, leap_text
from gz_onboard.vehicle import Vehicle
from gz_onboard.vehicle_check.cells import check_cells
from gz_onboard.vehicle_check.finding import (
    NEEDS,
    Feature,
    Finding,
    Looks,
    accused,
    features_of,
    features_text,
    right,
    unknown,
    wrong,
)
from gz_onboard.vehicle_check.limits import check_limits
from gz_onboard.vehicle_check.predictions import LOAD, PackRide, check_predictions
from gz_onboard.vehicle_check.seconds import FEWEST, seconds_of
from gz_onboard.vehicle_check.ways import check_speeds

CHECK_VERSION = 1
RARE = 0.9  # of the time: a signal that is there for less is reported
MOST_DIGITS = 2  # hexadecimal, in which an identifier may differ from the one that was meant
DROPPED = 0.01  # of the values: as many outside the limits are wrong limits, or a wrong layout
LEFT_OUT = 0.2  # of the time: a sensor that the daemon leaves out for as long has no passing fault
INNOVATION_V = 0.03  # of a cell: less is a good table of a battery
BY_LOAD = {"accel_x", "gps_altitude"}  # the daemon holds them against the grade by the power that is needed
Columns = Mapping[str, tuple[Array, Array]]


@dataclass(frozen=True)
class RoleSeen:
    """The signal of a role in a log."""

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
    """A log that was checked."""

    file: Annotated[str, "the log"]
    duration_s: Annotated[float, "from the first to the last value, without pauses"]
    roles: Annotated[list[RoleSeen], "of the vehicle file"]
    findings: Annotated[list[Finding], "all checks"]
    features: Annotated[list[Feature], "and what is missing for each"]

    def those(self, looks: Looks) -> list[Finding]:
        """Return the findings with this verdict."""
        return [finding for finding in self.findings if finding.looks is looks]


def check_log(
    log: Path, vehicle: Vehicle, progress: Callable[[int], None] | None = None, quick: bool = False
) -> Checked:
    """Check one log; quick: without the daemon's pipeline. Raises InputError for a log that cannot be read."""
    mapping, frames = open_ride(log, vehicle)
    codec = Codec(mapping, LONGEST_PAUSE_NS)
    columns = read_roles(log, vehicle, codec, frames)
    if progress:
        progress(len(frames))
    samples, (duration, end) = Recording(ride_name(log), columns, facts_of(log)), _passed(columns)
    findings = [unknown("clock", (), leap_text(*leap)) for leap in codec.leaps]
    findings += [*_never_came(codec, columns, frames, duration), *_dropped(codec, columns)]
    findings += _unanswered(codec, columns)
    ride = seconds_of(samples, vehicle) if columns else {}
    if columns and duration < FEWEST:
        findings.append(unknown("length", (), f"{duration:.1f} s: most checks need {FEWEST} s and more"))
    if ride:
        of_ride, pack = check_ride(ride, vehicle, samples.rider_mass)
        findings += of_ride
        if not quick and any(one.looks is Looks.WRONG for one in findings):
            findings.append(unknown("on board", (), "not tried: what looks wrong would mislead it"))
        elif not quick:
            load_fits = all(one.looks is Looks.RIGHT for one in findings if one.check == LOAD)
            findings += on_board(log, vehicle, load_fits, pack)
    seen = [_seen(source, codec, columns, (duration, end), findings) for source in mapping.sources]
    return Checked(str(log), duration, seen, findings, features_of(columns))


def check_ride(
    ride: Mapping[str, Array], vehicle: Vehicle, payload: float | None
) -> tuple[list[Finding], PackRide | None]:
    """Return the findings of a ride about itself and the vehicle file, and its pack; payload [kg], if known."""
    ways = check_speeds(ride, vehicle)
    findings = [*ways.findings, *check_limits(ride, ways.best, ways.bench)]
    trusted = {role: values for role, values in ride.items() if role not in accused(findings)}
    by_others, pack = check_predictions(trusted, vehicle, ways.best if ways.sure else None, payload)
    by_cells = check_cells(ride, pack, accused(by_others)) if pack else []
    return [*findings, *by_others, *by_cells], pack


# --- frames and signals -----------------------------------------------------------------------------------------------


def _passed(columns: Columns) -> tuple[float, float]:
    """(time [s] that passed while values came, without pauses; when the last one came)."""
    if not columns:
        return 0.0, 0.0
    start = min(float(times[0]) for times, _ in columns.values())
    end = max(float(times[-1]) for times, _ in columns.values())
    steps = np.diff(np.unique(np.concatenate([np.floor(times) for times, _ in columns.values()])))
    return end - start - float(steps[steps > PAUSE_S].sum()), end


def _never_came(codec: Codec, columns: Collection[str], frames: object, duration: float) -> Iterator[Finding]:
    """Roles of the file that the range needs, and of which a log of that `duration` [s] has no value."""
    needed, wanted = NEEDS["range"]
    for group in (*needed, *wanted):
        silent = [source for source in codec.mapping.sources if source.role in group]
        late = min((_stale(codec, source) for source in silent), default=0.0)
        if silent and not set(group) & set(columns) and duration > late:
            without = "no range" if group in needed else "no energy"
            text = f"{words(silent[0].role)} never came: {without}{_likely_identifier(codec, silent[0], frames)}"
            yield wrong("never came", tuple(source.role for source in silent), text)


def _stale(codec: Codec, source: Source) -> float:
    """When the signal of `source` is stale [s]."""
    period = codec.mapping.periods.get(source.message)
    return STALE_PERIODS * period if period else TIMING.unknown_stale


def _likely_identifier(codec: Codec, source: Source, frames: object) -> str:
    """The unknown identifier that is most like that of a message which never came, if its frames are as long."""
    message = next((m for m in codec.mapping.database.messages if m.name == source.message), None)
    if message is None:
        return ""
    for channel, identifier in codec.heard(message.name):
        return f"; {message.name} came on channel {channel} as {hexadecimal(identifier)}: see [bus] of the vehicle file"
    wanted = hexadecimal(identifier_of(message))
    text = f"; {source.message} is {wanted} in the DBC file"
    lengths = {}
    if isinstance(frames, FrameColumns):
        lengths = dict(zip(frames.identifier.tolist(), frames.length.tolist(), strict=True))
    digits = {
        one: sum(a != b for a, b in zip(hexadecimal(one), wanted, strict=True))
        for one in codec.unknown
        if lengths.get(one) == message.length and len(hexadecimal(one)) == len(wanted)
    }
    best = min(digits, key=lambda one: digits[one], default=None)
    if best is None or digits[best] > MOST_DIGITS:
        return text
    came = f"has {message.length} bytes too and came {codec.unknown[best]} times"
    return f"{text}, and {hexadecimal(best)}, which no file knows, {came}"


def _dropped(codec: Codec, columns: Columns) -> Iterator[Finding]:
    """Signals with many values dropped, outside the limits of the DBC file or of any vehicle."""
    roles = {f"{source.message}.{source.signal}": source.role for source in codec.mapping.sources}
    for (name, reason), count in sorted(codec.faults.items()):
        role = roles.get(name)
        kept = len(columns[role][0]) if role and role in columns else 0
        if role and reason == RANGE and count > DROPPED * (count + kept):
            text = f"{count} of {count + kept} values were dropped: out of the DBC file's limits, or of a vehicle's"
            yield wrong("limits", (role,), text)


def _unanswered(codec: Codec, columns: Columns) -> Iterator[Finding]:
    """Requests with answers of an unexpected length, and requests that an ECU refused."""
    roles = {
        request.name: tuple(source.role for source in codec.mapping.sources if source.message == request.name)
        for request in codec.mapping.requests
    }
    for request in codec.mapping.requests:
        if length := codec.wrong_lengths.get(request.name):
            text = f"{request.name} has {length} bytes, the file says {request.message.length}"
            yield wrong("length of the answer", roles[request.name], text)
    for (place, reason), count in sorted(codec.faults.items()):
        if reason.startswith(NEGATIVE):
            silent = tuple(role for named in roles.values() for role in named if role not in columns)
            yield unknown("requests", silent, f"{count} times {reason} on {place}")


def _seen(
    source: Source, codec: Codec, columns: Columns, span: tuple[float, float], findings: Sequence[Finding]
) -> RoleSeen:
    """span: as of `_passed`."""
    verdicts = {finding.looks for finding in findings if source.role in finding.roles}
    looks = next((one for one in (Looks.WRONG, Looks.RIGHT) if one in verdicts), Looks.UNKNOWN)
    if source.role not in columns:
        return RoleSeen(source.role, source.signal, looks, UNITS[source.role], None, None, None, 0.0)
    times, values = columns[source.role]
    rate = 1 / max(float(np.median(np.diff(times))), 1e-6) if len(times) > 1 else None
    held = float(np.minimum(np.diff(times, append=span[1]), _stale(codec, source)).sum())
    share = min(held / max(span[0], 1e-9), 1.0)
    limits = float(values.min()), float(values.max())
    return RoleSeen(source.role, source.signal, looks, UNITS[source.role], rate, *limits, share)


# --- the daemon's own checks ------------------------------------------------------------------------------------------


def on_board(log: Path, vehicle: Vehicle, load_fits: bool, of: PackRide | None) -> Iterator[Finding]:
    """Run the daemon's pipeline over the log: sensors that it leaves out, and the error of the voltage.

    load_fits: whether the power needed is the model's. of: voltage and current of the pack.
    """
    if vehicle.battery is None:
        return
    try:
        summary = summary_of(run_ride(open_estimate(log, vehicle), RideOptions()))
    except InputError as error:  # no battery, range frames that do not fit: `run` reports it
        yield unknown("on board", (), str(error))
        return
    for role, seconds in summary.distrusted.items():
        if seconds > LEFT_OUT * summary.duration_s:
            text = f"the daemon would leave {role} out for {clock(seconds)}: it contradicts the others"
            of_file = role in BY_LOAD and not load_fits
            hint = ", or the file's mass, drag area or losses are wrong" if of_file else ""
            yield wrong("on board", () if of_file else (role,), text + hint)
    missed = summary.innovation_rms_v
    if missed is None:
        return
    text = f"voltage less its prediction: {1e3 * missed:.0f} mV RMS of a cell"
    if missed < INNOVATION_V:
        yield right("on board", ("pack_voltage",), f"{text}; the battery's tables are about right")
    elif missed < POOR_FIT_V or (of and missed < _doubt(of)):
        yield unknown("on board", ("pack_voltage",), f"{text}; wrong tables, or the cells' number or capacity?")
    else:
        yield wrong("on board", ("pack_voltage",), f"{text}: the cells' number or capacity, or the tables")


def _doubt(of: PackRide) -> float:
    """By how much [V] a cell's voltage may miss its prediction for all that the file knows; inf in unmeasured cold."""
    battery = of.battery
    if of.temperature < min(battery.r0.temperature) - 2.0:
        return float("inf")
    current = np.zeros(1) if of.current is None else of.current[np.isfinite(of.current)]
    load = sqrt(float(np.mean(current**2))) / battery.cells_parallel if len(current) else 0.0
    r0, r1, _ = battery.circuit(0.5, of.temperature)
    return 2.0 * hypot(battery.ocv_sd, battery.resistance_sd * (r0 + r1) * load)


# --- text -------------------------------------------------------------------------------------------------------------


def check_text(checked: Checked) -> str:
    """Return the result for a terminal."""
    head, count = "looks right" if checked.those(Looks.RIGHT) else "cannot tell", len(checked.those(Looks.WRONG))
    if count:
        head = "one thing looks wrong" if count == 1 else f"{count} things look wrong"
    lines = [f"{checked.file} ({clock(checked.duration_s)}): {head}"]
    lines += [f"  {seen.role:21} {_seen_text(seen)}" for seen in checked.roles]
    for looks in (Looks.WRONG, Looks.RIGHT, Looks.UNKNOWN):
        lines += [f"{looks}:"] if checked.those(looks) else []
        for one in checked.those(looks):
            roles = f" ({', '.join(one.roles)})" if one.roles else ""
            lines.append(f"  {one.check}{roles}: {one.text}")
    return "\n".join([*lines, features_text(checked.features)])


def _seen_text(seen: RoleSeen) -> str:
    if seen.low is None or seen.high is None:
        return f"never came ({seen.signal})"
    unit = "" if seen.unit == "1" else f" {seen.unit}"
    share = "" if seen.share > RARE else f", only {seen.share:.0%} of the time"
    often = "once" if seen.rate_hz is None else f"{seen.rate_hz:.3g} Hz"
    return f"{often}, {seen.low:.4g} to {seen.high:.4g}{unit}{share}: {seen.looks}"
