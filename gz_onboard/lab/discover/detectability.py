"""What a set of rides could show at all: the smallest change of each cause, and the residuals they cannot form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gz_onboard.lab.discover.channels import CHANNELS
from gz_onboard.lab.discover.energy import energy, energy_share
from gz_onboard.lab.discover.linear import normal
from gz_onboard.lab.discover.prior import LOG
from gz_onboard.lab.discover.result import Report
from gz_onboard.lab.discover.search import evidence
from gz_onboard.lab.discover.verdict import own_value

RIDING = 5.0  # m/s
MISSED = 0.05  # of the range
FAR = 1.1  # no tyre changes its radius by as much


@dataclass(frozen=True)
class Limit:
    """The smallest change of a cause that these rides would show, half the time, were it alone.

    change: of its first parameter [unit]; inf if the rides say nothing of it. share: of the energy, as a magnitude;
    0 for one that takes none.
    """

    name: str
    parameter: str
    change: float
    unit: str
    share: float


def limits(report: Report) -> list[Limit]:
    """Of every candidate, in the order of the ranking, those that the rides say nothing of last."""
    mixed = report.mixed
    if mixed is None:
        return []
    found = evidence(mixed, report.normals or [normal(line, mixed.noise) for line in report.lines])
    order = {name: i for i, (name, _) in enumerate(report.ranking)}
    result = []
    for cause in sorted(mixed.causes, key=lambda c: order.get(c.name, len(order))):
        parameter = cause.parameters[0]
        place = mixed.names.index(parameter.name) if parameter.name in mixed.names else None
        information = float(found.information[place, place]) if place is not None else 0.0
        if place is None or cause.name not in order or information <= 0:
            result.append(Limit(cause.name, parameter.name, float("inf"), parameter.unit, float("inf")))
            continue
        steps = float(np.sqrt(report.threshold * mixed.inflation.get(cause.name, 1.0) / information))
        change = np.zeros(len(mixed.mean))
        change[place] = steps
        step = float(mixed.scale[place]) * (own_value(mixed, parameter.name) if parameter.name in LOG else 1.0)
        share = abs(energy_share(mixed, report.lines, change))
        result.append(Limit(cause.name, parameter.name, steps * step, parameter.unit, share))
    return result


def missing_residuals(report: Report) -> list[str]:
    """What measurements the rides lack, and which residuals and candidates that costs, one sentence for each set."""
    mixed = report.mixed
    if mixed is None:
        return []
    lost: dict[tuple[str, ...], list[str]] = {}
    for channel in CHANNELS:
        if channel.battery and mixed.system.battery is None:
            continue
        for line in report.lines:
            lacking = tuple(role for role in channel.roles if role not in line.ride.have)
            if lacking and channel.name not in lost.setdefault(lacking, []):
                lost[lacking].append(channel.name)
    for role, name in (("rate_z", "residual over lateral acceleration"), ("gps_course", "anything over heading")):
        if any(role not in line.ride.have for line in report.lines):
            lost.setdefault((role,), []).append(name)
    sentences = []
    for roles, names in lost.items():
        without = [line.ride.name for line in report.lines if not set(roles) <= line.ride.have]
        rides = "no ride has" if len(without) == len(report.lines) else f"{', '.join(without)}: without"
        sentences.append(f"{rides} {' and '.join(roles)}: no {', no '.join(words(name) for name in names)} there")
    return sentences


def implausible_rides(report: Report) -> list[str]:
    """Rides whose GPS speed does not go with the motor's at all: perhaps they are another vehicle's."""
    found = []
    for line in report.lines:
        s, speed = line.ride.signals, np.abs(line.ride.quantities["speed"])
        if "gps_speed" not in s or not np.any(moving := speed > RIDING):
            continue
        ratio = float(np.median(s["gps_speed"][moving] / speed[moving]))
        if not 1 / FAR < ratio < FAR:
            found.append(
                f"{line.ride.name}: GPS speed is {ratio:.2f} times what motor speed and wheel radius make; is this "
                "a ride of this vehicle?"
            )
    return found


def remaining_range_error(report: Report) -> list[str]:
    """That the model, whatever was named, still misses much of the range of rides held out of the fit."""
    error = report.gain.get("range")
    if not isinstance(error, dict) or not error["after"] > MISSED:
        return []
    return [
        f"{error['after']:.0%} of the range is missed on rides held out: by what differs from ride to ride, as wind "
        "does, or is too little alike for a name"
    ]


def size(report: Report) -> tuple[float, float, float]:
    """(way [m], time [s], energy drawn [J]) of the rides that were used."""
    way = sum(line.ride.distance for line in report.lines)
    time = sum(float(line.ride.time[-1] - line.ride.time[0]) for line in report.lines)
    return way, time, sum(energy(line) for line in report.lines)


def amount(value: float, unit: str, form: str = ".4g") -> str:
    """A value with its unit; that of a pure number is not said."""
    return f"{value:{form}}" if unit == "1" else f"{value:{form}} {unit}"


def words(name: str) -> str:
    """A name of the code in words."""
    return name.replace("_", " ").replace("gps", "GPS")


__all__ = [
    "Limit",
    "amount",
    "implausible_rides",
    "limits",
    "missing_residuals",
    "remaining_range_error",
    "size",
    "words",
]
