"""Coast-downs as measured: how they are read, the part of each in which the vehicle rolls, and which are refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.calibration.table import Measurements
from gz_onboard.errors import InputError, nearest
from gz_onboard.recording.recording import Recording, read_facts
from gz_onboard.recording.sensors import speed_role, true_columns
from gz_onboard.vehicle import Vehicle

SPAN = 2.0  # s
SLOWEST = 1.0  # m/s: down to it the run is fitted
SHORTEST, LEAST_FALL = 10.0, 3.0  # s, m/s: less than this is of no use
DRIVING = 0.01  # of the motor's greatest current, beside its offset: mean of a span of coasting
RISING = 0.2  # m/s from one `RISE_TIME` to the next
RISE_TIME = 5.0  # s
CLOSED = 0.02  # of the throttle: below is noise

_MEASURED = (
    "vehicle_speed motor_speed wheel_speed_rear throttle brake_switch motor_current ambient_temperature gps_altitude "
    "gps_course"
)
_ROLES = {"speed": "vehicle_speed"} | dict.fromkeys(_MEASURED.split(), "")  # column -> role, where that is another


@dataclass(frozen=True)
class Coast:
    """The part of a run in which the vehicle rolls, in spans.

    time: ends of the spans [s], shape (n + 1,); speed: there [m/s]. direction: +1 or -1 along the track.
    """

    name: str
    time: Array
    speed: Array
    direction: int
    payload: float | None  # kg; None if only the total is known
    mass: float  # kg, all
    temperature: float  # degC
    altitude: float  # m

    @property
    def middle(self) -> Array:
        """Mean speed of the spans [m/s]."""
        return (self.speed[1:] + self.speed[:-1]) / 2

    @property
    def slowing(self) -> Array:
        """Deceleration over the spans [m/s²]."""
        return np.asarray(-np.diff(self.speed) / np.diff(self.time))


def samples(table: Measurements, facts: Mapping[str, object] | None = None) -> Recording:
    """The coast-down in `table`, of ``time`` and ``speed`` [m/s] (or ``motor_speed``) and, if it has them, more roles.

    facts: what was written down of it; None: in a ``rides.json`` beside the table. It needs ``direction`` (``up`` or
    ``down``, or any two words), ``rider_mass_kg`` or ``total_mass_kg``, and ``ambient_C`` if there is no column
    ambient_temperature. Raises InputError naming file, line and column.
    """
    time = table["time"]
    again = np.flatnonzero(np.diff(time) <= 0)
    if len(again):
        raise table.error(f"time: {time[again[0] + 1]:g} s does not increase", int(again[0]) + 1)
    if "motor_speed" not in table and "vehicle_speed" not in table:
        table["speed"]  # which is missing, or of no use
    name = table.file.name.removesuffix(".gz").rpartition(".")[0]
    notes = table.file.parent / "rides.json"
    known = dict(read_facts(notes).get(name, {}) if facts is None else facts)
    for keys in (("direction",), ("total_mass_kg", "rider_mass_kg")):
        if not known.keys() & set(keys):
            close = nearest(keys[0], [str(key) for key in known])
            raise table.error(f"{notes.name} beside it says no {' or '.join(keys)} of {name!r}{close}")
    if "ambient_temperature" not in table and "ambient_C" not in known:
        raise table.error(f"no column ambient_temperature, and {notes.name} beside it says no ambient_C of {name!r}")
    return Recording(name, {new or old: (time, table[old]) for old, new in _ROLES.items() if old in table}, known)


def coast(run: Recording, vehicle: Vehicle, direction: int) -> Coast:
    """The longest coasting of `run`: throttle closed, no brake, no current, down to `SLOWEST`.

    Raises InputError for a run that has no speed, is too short, in which the motor drives or the speed rises.
    """
    p = vehicle.parameters
    columns = true_columns(run.columns, p)
    role, factor = speed_role(run.name, columns, p)
    time, speed = columns[role][0], columns[role][1] * factor
    rolling = np.ones(len(time), dtype=bool)
    if "throttle" in run.columns:
        rolling &= np.interp(time, *run.columns["throttle"]) < CLOSED
    if "brake_switch" in run.columns:
        rolling &= np.interp(time, *run.columns["brake_switch"]) < 0.5
    switched = "throttle" in run.columns or "brake_switch" in run.columns
    first, last = _longest(rolling, time)
    settle = 0.5 if switched else 0.0  # s, until the current has died away
    keep = slice(int(np.searchsorted(time, time[first] + settle)), last)
    time, speed = time[keep], speed[keep]
    if not switched and len(speed):  # nothing but speed: from its greatest on
        time, speed = time[int(np.argmax(speed)) :], speed[int(np.argmax(speed)) :]
    slow = np.flatnonzero(speed < SLOWEST)
    until = int(slow[0]) if len(slow) else len(speed)
    time, speed = time[:until], speed[:until]
    lasts = float(time[-1] - time[0]) if len(time) > 1 else 0.0
    falls = float(speed[0] - speed[-1]) if len(speed) > 1 else 0.0
    if lasts < SHORTEST or -RISING < falls < LEAST_FALL:
        raise InputError(
            f"{run.name}: too short a coast-down: {lasts:.1f} s in which the speed falls by {falls:.1f} m/s; at least "
            f"{SHORTEST:g} s and {LEAST_FALL:g} m/s are needed (throttle below {CLOSED:.0%}, no brake)"
        )
    _check_current(run, time, DRIVING * p["motor_current_limit"])
    n = max(int(lasts / SPAN), 1)
    ends = time[0] + SPAN * np.arange(n + 1)
    at = _smooth(time, speed, ends)
    _check_falling(run, time, speed)
    total = run.facts.get("total_mass_kg")
    payload = run.rider_mass if run.rider_mass is not None else p["payload_mass"]
    mass = float(total) if isinstance(total, int | float) else p["vehicle_mass"] + payload
    altitude = float(np.median(run.columns["gps_altitude"][1])) if "gps_altitude" in run.columns else 0.0
    known = None if total is not None else payload
    return Coast(run.name, ends, at, direction, known, mass, _temperature(run), altitude)


def run_start(run: Recording) -> float:
    """The time of the first sample [s]."""
    return float(min(t[0] for t, _ in run.columns.values()))


def _temperature(run: Recording) -> float:
    if "ambient_temperature" in run.columns:
        return float(run.columns["ambient_temperature"][1].mean())
    noted = run.facts.get("ambient_C")
    if isinstance(noted, int | float):
        return float(noted)
    raise InputError(f"{run.name}: air temperature is neither measured nor noted (ambient_C): it gives the air density")


def _longest(rolling: Any, time: Array) -> tuple[int, int]:
    """The longest stretch of `rolling` as (first, end), blinks of a tenth of a second passed over."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], rolling, [False])).astype(int)))
    starts, ends = list(edges[::2]), list(edges[1::2])
    if not starts:
        return 0, 0
    merged = [[starts[0], ends[0]]]
    for a, b in zip(starts[1:], ends[1:], strict=True):
        if time[a] - time[merged[-1][1] - 1] < 0.1:
            merged[-1][1] = b
        else:
            merged.append([a, b])
    best = max(merged, key=lambda piece: time[piece[1] - 1] - time[piece[0]])
    return int(best[0]), int(best[1])


def _check_current(run: Recording, time: Array, driving: float) -> None:
    """Refuse a run with a current beyond `driving` [A] over its median, the sensor's offset: the motor works."""
    if "motor_current" not in run.columns:
        return
    t, current = run.columns["motor_current"]
    inside = (t >= time[0]) & (t <= time[-1])
    if inside.sum() < 10:
        return
    offset = float(np.median(current[inside]))
    count = max(int((time[-1] - time[0]) / SPAN), 1)
    means = np.array([part.mean() for part in np.array_split(current[inside], count)])
    worst = int(np.argmax(np.abs(means)))
    if abs(offset) > driving or abs(means[worst]) > driving:
        raise InputError(
            f"{run.name}: the motor {'drives' if means[worst] > 0 else 'brakes'} while it should coast: "
            f"{means[worst]:.1f} A in mean over {SPAN:g} s, {offset:.1f} A in all; at most {driving:.2g} A"
        )


def _check_falling(run: Recording, time: Array, speed: Array) -> None:
    """Refuse a run whose mean speed rises from one `RISE_TIME` to the next by more than its noise explains."""
    count = max(int((time[-1] - time[0]) / RISE_TIME), 1)
    means, sds = [], []
    for begin in time[0] + RISE_TIME * np.arange(count):
        inside = (time >= begin) & (time < begin + RISE_TIME)
        x, y = time[inside], speed[inside]
        left = y - np.polyval(np.polyfit(x - begin, y, 1), x - begin) if len(x) > 2 else np.zeros(1)
        means.append(float(y.mean()) if len(y) else float("nan"))
        sds.append(float(np.sqrt(left @ left) / max(len(x) - 2, 1)))
    rises = np.diff(means) - 3 * np.hypot(sds[1:], sds[:-1])
    if len(rises) and np.nanmax(rises) > RISING:
        i = int(np.nanargmax(rises))
        begin = time[0] + i * RISE_TIME - run_start(run)
        raise InputError(
            f"{run.name}: the speed rises from {means[i]:.2f} to {means[i + 1]:.2f} m/s between {begin:.0f} and "
            f"{begin + 2 * RISE_TIME:.0f} s: the motor drives, or the track falls too steeply"
        )


def _smooth(time: Array, speed: Array, ends: Array) -> Array:
    """The speed at `ends`: a straight line through the samples within half a second around each."""
    result = np.empty(len(ends))
    for i, at in enumerate(ends):
        a, b = np.searchsorted(time, [at - 0.25, at + 0.25])
        if b - a < 4:
            result[i] = np.interp(at, time, speed)
        else:
            x, y = time[a:b] - at, speed[a:b]
            spread = x - x.mean()
            result[i] = y.mean() - x.mean() * float(spread @ y) / float(spread @ spread)
    return result


def directions(runs: Sequence[Recording]) -> list[int]:
    """+1 or -1 for each run: as noted (``direction``; the first alphabetically but ``up`` is +1), else by GPS course.

    Raises InputError if there is neither.
    """
    noted = [run.facts.get("direction") for run in runs]
    if all(isinstance(word, str) for word in noted):
        words = sorted({str(word) for word in noted}, key=lambda word: (word != "up", word))
        if len(words) > 2:
            raise InputError(f"coast-downs in {len(words)} directions: {', '.join(words)}; a track has two")
        return [1 if word == words[0] else -1 for word in noted]
    courses = []
    for run in runs:
        if "gps_course" not in run.columns:
            raise InputError(f"{run.name}: its direction is neither noted (direction) nor told by a gps_course")
        course = run.columns["gps_course"][1]
        courses.append(complex(np.cos(course).mean(), np.sin(course).mean()))
    return [1 if (c * courses[0].conjugate()).real > 0 else -1 for c in courses]
