"""What a set of rides could show at all: the smallest change of each cause, and the residuals they cannot form."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gz_onboard.discovery.blocks import slow
from gz_onboard.discovery.channels import CHANNELS
from gz_onboard.discovery.energy import energy_share
from gz_onboard.discovery.linear import LinearRide
from gz_onboard.discovery.prior import LOG_SCALED
from gz_onboard.discovery.result import Limit, Report
from gz_onboard.discovery.search import evidence
from gz_onboard.discovery.verdict import Discovery, needs
from gz_onboard.discovery.wording import readable

RIDING = 5.0  # m/s
MISSED = 0.05  # of the range or the energy
HEALTHY_MOST = 0.08  # of it: of 40 healthy sets of the plant none misses more than 5.4 %, against its file alone 7.1 %
INSTEAD = (
    "instead, the pack's power (voltage times current) is held against the drive and the auxiliaries, as measured or "
    "by their models: what acts alike in it is told apart by how it goes with speed, acceleration and grade alone"
)
FAR = 1.1  # no tyre changes its radius by as much


def limits(found: Discovery) -> dict[str, Limit]:
    """Of every candidate, in the order of the ranking, those that are not identifiable last."""
    mixed, report = found.mixed, found.report
    information = np.diag(evidence(mixed, found.normals).information)
    order = {row.name: i for i, row in enumerate(report.ranking)}
    result = {}
    for cause in sorted(mixed.causes, key=lambda c: order.get(c.name, len(order))):
        parameter = cause.parameters[0]
        place = mixed.names.index(parameter.name) if parameter.name in mixed.names else None
        if place is None or cause.name not in order or information[place] <= 0:
            result[cause.name] = Limit(parameter.name, parameter.unit, None, None, needs(mixed, cause))
            continue
        steps = float(np.sqrt(report.threshold * mixed.inflation.get(cause.name, 1.0) / float(information[place])))
        change = np.zeros(len(mixed.mean))
        change[place] = steps
        step = float(mixed.scale[place]) * (
            mixed.healthy_value(parameter.name) if parameter.name in LOG_SCALED else 1.0
        )
        share = abs(energy_share(found.lines, change))
        result[cause.name] = Limit(parameter.name, parameter.unit, steps * step, share, needs(mixed, cause))
    return result


def missing_residuals(found: Discovery) -> list[str]:
    """What measurements the rides lack, and which residuals and candidates that costs, one sentence for each set."""
    lost: dict[tuple[str, ...], list[str]] = {}
    for channel in CHANNELS:
        if channel.battery and found.mixed.system.battery is None:
            continue
        for line in found.lines:
            lacking = tuple(role for role in channel.roles if role not in line.ride.have)
            if lacking and channel.name not in lost.setdefault(lacking, []):
                lost[lacking].append(channel.name)
    for role, name in (("rate_z", "residual over lateral acceleration"), ("gps_course", "anything over heading")):
        if any(role not in line.ride.have for line in found.lines):
            lost.setdefault((role,), []).append(name)
    sentences = []
    for roles, names in lost.items():
        without = [line.ride.name for line in found.lines if not set(roles) <= line.ride.have]
        rides = "no ride has" if len(without) == len(found.lines) else f"{', '.join(without)}: without"
        sentences.append(f"{rides} {' and '.join(roles)}: no {', no '.join(readable(name) for name in names)} there")
    sentences += dict.fromkeys(words for line in found.lines for words in line.ride.stand_ins)
    for channel in (c for c in CHANNELS if c.apart < math.inf):
        if any(set(channel.roles) <= line.ride.have and slow(channel, line.ride) for line in found.lines):
            sentences.append(
                f"samples of {' and '.join(channel.roles)} are further apart than {channel.apart:g} s: no "
                f"{readable(channel.name)} there"
            )
    if any("pack_power" in line.tables for line in found.lines):
        sentences.append(INSTEAD)
    return sentences


def implausible_rides(lines: Sequence[LinearRide]) -> list[str]:
    """Rides whose GPS speed does not go with the motor's at all: perhaps they are another vehicle's."""
    found = []
    for line in lines:
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


def remaining_error(report: Report, drawn: Extent) -> tuple[str, float] | None:
    """(of what, the share) that is still missed on rides held out, whatever was named: the range, or the energy where
    no one knows what the whole pack delivered. None if neither was measured.
    """
    gain = report.gain
    if gain.range is not None:
        return "range", gain.range.after
    if gain.consumption is not None and drawn.energy > 0:
        return "energy", gain.consumption.after * drawn.distance / drawn.energy
    return None


def judge_remaining_error(found: Discovery) -> None:
    """Make no fault found *inconclusive* where rides held out are missed by more than healthy ones, and say so of an
    error that remains beside what was found.
    """
    report = found.report
    what, share = remaining_error(report, extent(found.lines)) or ("", 0.0)
    if report.verdict == "none" and share > HEALTHY_MOST:
        report.verdict = "inconclusive"
        report.advice.append(
            "Ride one way there and back, on a calm day and on others: what differs from ride to ride, as wind does, "
            "or is too little alike for a name, shows in rides that have all else in common."
        )
    if share > MISSED:
        report.notes.append(
            f"{share:.0%} of the {what} is missed on rides held out (healthy rides: up to {HEALTHY_MOST:.0%})"
        )


@dataclass(frozen=True)
class Extent:
    """Of the rides that were used: distance [m], time [s], energy drawn from the pack [J]."""

    distance: float
    time: float
    energy: float


def extent(lines: Sequence[LinearRide]) -> Extent:
    """How much was ridden in all."""
    distance = sum(line.ride.distance for line in lines)
    time = sum(float(line.ride.time[-1] - line.ride.time[0]) for line in lines)
    return Extent(distance, time, sum(line.ride.energy for line in lines))
