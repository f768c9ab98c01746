"""One ride against its simulation: open loop, with the rider model, and each component by itself.

The grade is that of the place where the scooter really was at that time, so that a speed that drifts does not also move
the hills; so is the vibration.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.constants import GRAVITY, MILD, WH
from gz_onboard.errors import InputError, writing
from gz_onboard.lab.validate_components import Component, components, losses
from gz_onboard.lab.validate_empty import Load, empty_text, pack_empty, until_empty
from gz_onboard.lab.validate_score import (
    CHANNELS,
    COMPONENT_GATE,
    GATE,
    GIVEN,
    LEAST_SECONDS,
    POWER,
    PackEmpty,
    SimulationVerdict,
    Splits,
    ValidatedRide,
    Verdict,
    conditions,
    errors,
    split,
)
from gz_onboard.lab.validate_soc import soc_reference
from gz_onboard.offline.arrays import block_means, running_mean
from gz_onboard.offline.processes import Task
from gz_onboard.offline.samples import facts_of, ride_name, rider_mass
from gz_onboard.progress import Progress
from gz_onboard.simulation.parts import Dynamometer, Place, RoadProfile
from gz_onboard.simulation.plan import ridden_road, route_file
from gz_onboard.simulation.recorded import Recorded, read_recorded, rest_soc, scooter_at_start
from gz_onboard.simulation.run import Command, Run, drive, follow, replay
from gz_onboard.simulation.scooter import STEP, Scooter
from gz_onboard.vehicle import Vehicle, read_vehicle

AVERAGED = 0.5  # s: over which the measured speed is averaged: its noise is no ride for a rider model to follow
STANDING = 0.3  # m/s: less is noise of a wheel that stands
SHORTEST = 30  # s
GRADE_ERROR = 0.005  # sine: of the on-board filter in the first minutes
FRAME_BYTES = 13.0  # of a compressed log
MOST_AT_ONCE = 1000  # steps between two reports of progress
PICTURE = ".validation"
_READ, _RIDE = 0.4, 0.3  # shares of the work


@dataclass(frozen=True)
class Measured:
    """A recorded ride as it is compared. soc: at rest before it, None if that is not known."""

    recorded: Recorded
    vehicle: Vehicle
    series: dict[str, Array]  # per second, see `per_second`; and the grade on a road
    road: RoadProfile | Dynamometer
    soc: float | None


def log_size(log: Path) -> int:
    """Of a log [bytes], as a measure of the work."""
    try:
        return log.stat().st_size
    except OSError:
        return 1


@dataclass(frozen=True)
class ComparedRide:
    """A validated ride with what was compared, per second and by role: measured, simulated by form, each component."""

    result: ValidatedRide
    measured: dict[str, Array]
    simulated: dict[str, dict[str, Array]]
    alone: dict[str, Component]


def validate_ride(task: Task, progress: Progress = lambda _: None) -> ValidatedRide:
    """Compare one ride with its simulation, and draw it; `progress` counts bytes of the log. Raises InputError."""
    payload = task.payload if task.payload is not None else rider_mass(facts_of(task.path))
    compared = compare_ride(task.path, read_vehicle(task.vehicle, payload), progress)
    picture = task.drawn(PICTURE)
    if not picture:
        return compared.result
    from gz_onboard.lab.validate_plot import draw_ride

    result = replace(compared.result, plot=str(picture))
    with writing(picture):
        draw_ride(picture, result, compared.measured, compared.simulated, compared.alone)
    return result


def compare_ride(log: Path, vehicle: Vehicle, progress: Progress = lambda _: None) -> ComparedRide:
    """Compare one ride of `vehicle`, payload included, with its simulation. Raises InputError."""
    size = log_size(log)
    ride = _measured(log, vehicle, size, progress)
    recorded, measured = ride.recorded, ride.series
    found, missing = conditions(measured)
    commands = _commands(recorded)
    missing += _not_judged(ride, log, commands)
    if "open_loop" not in commands:
        progress(_RIDE * size)
    runs = {
        form: _ride(ride, command, lambda share: progress(share * _RIDE * size)) for form, command in commands.items()
    }
    simulated = {form: _series(run) for form, run in runs.items()}
    ends = {form: pack_empty(vehicle, run, _load(ride)) if ride.soc is not None else None for form, run in runs.items()}
    verdicts = {
        form: _judge_ride(measured, series, GIVEN.get(form, set()), ends[form]) for form, series in simulated.items()
    }
    missing += [empty_text(form, end, recorded.duration) for form, end in ends.items() if end]
    roller = ride.road if isinstance(ride.road, Dynamometer) else None
    alone = components(vehicle, measured, ride.soc, recorded.first("ambient_temperature", MILD), roller)
    judged, by_circuit = _judge_components(alone), alone.get("battery_voltage")
    if not judged and not any(verdict.channels for verdict in verdicts.values()):
        channels = ", ".join(channel.label for channel in CHANNELS.values())
        raise InputError(f"{log}: nothing in it can be compared with its simulation: it has none of {channels}")
    kind = facts_of(log).get("kind")
    result = ValidatedRide(
        file=str(log),
        name=ride_name(log),
        kind=None if kind is None else str(kind),
        vehicle=vehicle.name,
        payload_kg=vehicle.parameters["payload_mass"],
        on_dynamometer=recorded.on_dynamometer,
        duration_s=recorded.duration,
        distance_km=recorded.distance * 1e-3,
        ambient_c=float(measured["ambient_temperature"].mean()) if "ambient_temperature" in measured else None,
        energy_wh=_energy(measured),
        open_loop=verdicts.get("open_loop"),
        predictive=verdicts["predictive"],
        components=judged,
        splits=_splits(measured, {form: until_empty(s, ends[form]) for form, s in simulated.items()}, alone, found),
        cells_series=vehicle.pack.cells_series,
        soc_reference=soc_reference(vehicle, measured, ride.soc, by_circuit.modelled if by_circuit else None),
        missing=missing,
        passed=all(verdict.passed for verdict in (*verdicts.values(), judged) if verdict),
        plot=None,
    )
    return ComparedRide(result, measured, simulated, alone)


def _splits(
    measured: Mapping[str, Array],
    simulated: Mapping[str, Mapping[str, Array]],
    alone: Mapping[str, Component],
    found: Mapping[str, Mapping[str, Mask]],
) -> dict[str, dict[str, Splits]]:
    """The means by form and channel in the conditions `found`."""
    splits: dict[str, dict[str, Splits]] = {
        form: {
            name: split(quantity.shown(measured[name]), quantity.shown(series[name]), found)
            for name, quantity in {**CHANNELS, "pack_power": POWER}.items()
            if name in measured and name in series and name not in GIVEN.get(form, set())
        }
        for form, series in simulated.items()
    }
    return splits | {"components": {name: split(c.measured, c.modelled, found, c.valid) for name, c in alone.items()}}


# --- what was measured --------------------------------------------------------------------------------------------


def _measured(log: Path, vehicle: Vehicle, size: int, progress: Progress) -> Measured:
    counted = 0.0

    def frames(count: int) -> None:
        nonlocal counted
        part = min(FRAME_BYTES * count, _READ * size - counted)
        counted += part
        progress(part)

    recorded = read_recorded(log, vehicle, frames)
    progress(_READ * size - counted)
    measured = per_second(recorded)
    if len(measured["speed"]) < SHORTEST:
        raise InputError(f"{log}: {len(measured['speed'])} s are too short a ride to judge; at least {SHORTEST} s")
    _check_riding(log, measured["speed"])
    road, grade = _road(recorded, log)
    if grade is not None:
        measured["grade"] = grade
    measured |= losses_per_second(recorded, vehicle)
    return Measured(recorded, vehicle, measured, road, rest_soc(recorded, vehicle))


def _check_riding(log: Path, speed: Array) -> None:
    """InputError if the vehicle hardly moves: percentages of what is measured at a halt are those of noise."""
    moving = int((np.abs(speed) > STANDING).sum())
    if moving < LEAST_SECONDS:
        length = len(speed)
        what = f"moves for only {moving} of its {length} s" if moving else f"only stands, for all of its {length} s"
        raise InputError(f"{log}: the vehicle {what}: there is no riding to judge; at least {LEAST_SECONDS} s of it")


def per_second(recorded: Recorded) -> dict[str, Array]:
    """What was measured, as means over seconds, by role; and acceleration, yaw_rate, braking, pack_power."""
    rate = round(1 / recorded.dt)
    measured = {role: block_means(values, rate) for role, values in recorded.signals.items()}
    smooth = _averaged_speed(recorded)
    n = len(measured["speed"])
    ends = np.minimum(np.arange(n + 1) * rate, len(smooth) - 1)
    measured["acceleration"] = np.diff(smooth[ends])  # over one second
    if "rate_z" in measured and not recorded.on_dynamometer:
        measured["yaw_rate"] = measured["rate_z"]
    if "brake" in measured:
        measured["braking"] = (measured["brake"] > 0).astype(float)
    if {"pack_current", "pack_voltage"} <= measured.keys():
        power = recorded.signals["pack_voltage"] * recorded.signals["pack_current"]
        measured["pack_power"] = block_means(power, rate)  # of bursts within a second too
    return measured


def losses_per_second(recorded: Recorded, vehicle: Vehicle) -> dict[str, Array]:
    """The motor_heat, idle_heat and inverter_heat [W] of `validate_components`, of bursts within a second too."""
    signals = recorded.signals
    inputs = [signals.get(role) for role in ("motor_current", "motor_speed", "motor_temperature")]
    if any(column is None for column in inputs):
        return {}
    copper, idle, inverter = losses(vehicle, *(column for column in inputs if column is not None))
    heats = {"motor_heat": copper + idle, "idle_heat": idle, "inverter_heat": inverter}
    return {name: block_means(watts, round(1 / recorded.dt)) for name, watts in heats.items()}


def _averaged_speed(recorded: Recorded) -> Array:
    """The measured speed [m/s], each sample the mean over `AVERAGED` about it."""
    return running_mean(recorded.signals["speed"], 2 * round(AVERAGED / recorded.dt / 2) + 1)


def _road(recorded: Recorded, log: Path) -> tuple[RoadProfile | Dynamometer, Array | None]:
    """(the road by place, or the roller; the grade of each second, None on a roller)."""
    road, _ = ridden_road(recorded, log)
    if isinstance(road, Dynamometer):
        return road, None
    distance = recorded.signals["distance"]
    at = block_means(distance, round(1 / recorded.dt))
    return road, np.array([road(place)[0] for place in at.tolist()])


def _commands(recorded: Recorded) -> dict[str, Command]:
    """How the ride is simulated, by form; not open loop without throttle and brake."""
    commands: dict[str, Command] = {}
    if {"throttle", "brake"} <= recorded.signals.keys():
        throttle, brake = (recorded.signals[name].tolist() for name in ("throttle", "brake"))
        commands["open_loop"] = replay(throttle, brake, STEP)
    profile = _averaged_speed(recorded)
    profile[profile < STANDING] = 0.0  # or the rider would hold a hill by throttle, not by brake
    commands["predictive"] = follow(profile.tolist(), STEP)
    return commands


def _not_judged(ride: Measured, log: Path, commands: Mapping[str, Command]) -> list[str]:
    """What the ride does not have, and what follows."""
    recorded = ride.recorded
    missing = [
        f"{channel.label} not judged: not measured" for name, channel in CHANNELS.items() if name not in ride.series
    ]
    if not recorded.on_dynamometer and not route_file(log).is_file():
        newtons = GRADE_ERROR * GRAVITY * ride.vehicle.model.mass
        missing.append(
            f"grade is the on-board filter's, by accelerometer and altitude: wrong by some {100 * GRADE_ERROR:g} % in "
            f"the first minutes, {newtons:.0f} N of road load; a {recorded.name}.route.csv beside the log would give it"
        )
    if "open_loop" not in commands:
        gone = [name for name in ("throttle", "brake") if name not in recorded.signals]
        missing.append(f"not simulated open loop: the ride has no {' and no '.join(gone)}")
    return missing


# --- its simulation -----------------------------------------------------------------------------------------------


def _ride(ride: Measured, command: Command, progress: Progress) -> Run:
    """The simulated ride; `progress` counts shares of it."""
    recorded, road = ride.recorded, ride.road
    here: Place = (0.0, 0.0, 0.0)
    distance = recorded.signals["distance"].tolist()
    rough = recorded.signals["vibration"].tolist() if "vibration" in recorded.signals else None
    counted = step = 0

    def where(scooter: Scooter) -> tuple[float, float, float]:
        nonlocal here, counted, step
        step = min(round(scooter.time / STEP), len(distance) - 1)
        if not isinstance(road, Dynamometer):
            here = road(distance[step])
        if step - counted >= MOST_AT_ONCE:
            progress((step - counted) / len(distance))
            counted = step
        return command(scooter)

    scooter = scooter_at_start(
        recorded,
        ride.vehicle,
        road if isinstance(road, Dynamometer) else lambda _: here,
        soc=0.5 if ride.soc is None else ride.soc,
        vibration=(lambda _: rough[step]) if rough else None,
    )
    run = drive(scooter, where, recorded.duration)
    progress((len(distance) - counted) / len(distance))
    return run


def _load(ride: Measured) -> Load | None:
    """The load that was measured; None if none was."""
    if "pack_power" not in ride.series:
        return None
    current = ride.recorded.signals["pack_current"]
    mean = float(current.mean())
    form_factor_squared = float(np.mean(current**2)) / mean**2 if mean else 1.0
    return float(ride.series["pack_power"].mean()), form_factor_squared


def _series(run: Run) -> dict[str, Array]:
    """A run as means over seconds."""
    rate = round(1 / float(run.series["time"][1] - run.series["time"][0]))
    series = {name: block_means(values, rate) for name, values in run.series.items()}
    series["pack_power"] = block_means(run.series["pack_voltage"] * run.series["pack_current"], rate)
    return series


# --- how far they are apart ---------------------------------------------------------------------------------------


def _judge_ride(
    measured: Mapping[str, Array], series: Mapping[str, Array], given: set[str], end: PackEmpty | None
) -> SimulationVerdict:
    """given: channels that are no result of the simulation; end: where its pack was empty."""
    channels = {
        name: errors(*_even(channel.shown(measured[name]), channel.shown(series[name])), channel, GATE)
        for name, channel in CHANNELS.items()
        if name in measured and name not in given
    }
    return SimulationVerdict(
        channels,
        all(channel.passed for channel in channels.values()),
        _energy_percent(measured, until_empty(series, end)),
        end,
    )


def _energy_percent(measured: Mapping[str, Array], series: Mapping[str, Array]) -> float | None:
    """Energy of `series` less that measured in the same seconds, in percent of it; None of too few, or of none."""
    if "pack_power" not in measured:
        return None
    real, simulated = (float(power.sum()) for power in _even(measured["pack_power"], series["pack_power"]))
    return 100 * simulated / real - 100 if real and len(series["pack_power"]) >= LEAST_SECONDS else None


def _judge_components(alone: Mapping[str, Component]) -> Verdict | None:
    channels = {
        name: errors(c.measured[c.valid], c.modelled[c.valid], c.quantity, COMPONENT_GATE)
        for name, c in alone.items()
        if c.valid.sum() >= LEAST_SECONDS
    }
    return Verdict(channels, all(c.passed for c in channels.values())) if channels else None


def _even(a: Array, b: Array) -> tuple[Array, Array]:
    n = min(len(a), len(b))
    return a[:n], b[:n]


def _energy(series: Mapping[str, Array]) -> float | None:
    """[Wh] at the pack's terminals."""
    return float(series["pack_power"].sum()) / WH if "pack_power" in series else None
