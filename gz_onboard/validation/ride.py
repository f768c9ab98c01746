"""One ride against its simulation: open loop, with the rider model, and each component alone.

Grade and vibration are those of the place where the scooter really was at that time, so that an error of speed does not
also move the hills.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import hypot
from pathlib import Path

import numpy as np

from gz_onboard.arrays import Array, block_means, running_mean
from gz_onboard.constants import GRAVITY, MILD, WH
from gz_onboard.errors import InputError, writing
from gz_onboard.estimator.battery_priors import VoltageNoise
from gz_onboard.model.battery import discharged
from gz_onboard.model.series import curve_over
from gz_onboard.processes import Task
from gz_onboard.recording.recording import facts_of, ride_name, rider_mass
from gz_onboard.simulation.parts import Dynamometer, Place, RoadProfile
from gz_onboard.simulation.plan import ridden_road, route_file
from gz_onboard.simulation.recorded import Recorded, read_recorded, rest_soc, scooter_at_start
from gz_onboard.simulation.run import Command, Run, drive, follow, ran_empty, replay
from gz_onboard.simulation.scooter import STEP, Scooter
from gz_onboard.validation.comparison import (
    CHANNELS,
    CONFIG,
    FORMS,
    POWER,
    Comparison,
    PackEmpty,
    SimulationVerdict,
    SocReference,
    ValidatedRide,
    Verdict,
    riding_conditions,
)
from gz_onboard.validation.components import components, losses
from gz_onboard.validation.report import draw_ride
from gz_onboard.vehicle import Vehicle, read_vehicle

PICTURE = ".validation"


@dataclass(frozen=True)
class ComparedRide:
    """A validated ride with its comparisons, by form and channel or component."""

    result: ValidatedRide
    comparisons: dict[str, dict[str, Comparison]]


@dataclass(frozen=True)
class MeasuredRide:
    """A recorded ride to be simulated. seconds: see `per_second`, and the grade on a road; soc: at rest before it."""

    log: Path
    recorded: Recorded
    vehicle: Vehicle
    seconds: dict[str, Array]
    road: RoadProfile | Dynamometer
    soc: float | None

    @property
    def load(self) -> tuple[float, float] | None:
        """Mean power [W] and the square of the current's form factor; None if they were not measured."""
        if "pack_power" not in self.seconds:
            return None
        current = self.recorded.signals["pack_current"]
        mean = float(current.mean())
        return float(self.seconds["pack_power"].mean()), float(np.mean(current**2)) / mean**2 if mean else 1.0

    def simulate(self, command: Command) -> Run:
        """Ride from the measured start."""
        here: Place = (0.0, 0.0, 0.0)
        step, road, signals = 0, self.road, self.recorded.signals
        distance = signals["distance"].tolist()
        rough = signals["vibration"].tolist() if "vibration" in signals else None

        def at_measured_place(scooter: Scooter) -> tuple[float, float, float]:
            nonlocal here, step
            step = min(round(scooter.time / STEP), len(distance) - 1)
            if not isinstance(road, Dynamometer):
                here = road(distance[step])
            return command(scooter)

        scooter = scooter_at_start(
            self.recorded,
            self.vehicle,
            road if isinstance(road, Dynamometer) else lambda _: here,
            soc=0.5 if self.soc is None else self.soc,
            vibration=(lambda _: rough[step]) if rough else None,
        )
        return drive(scooter, at_measured_place, self.recorded.duration)


def validate_ride(task: Task) -> ValidatedRide:
    """Compare one ride with its simulation, and draw it. Raises InputError."""
    payload = task.payload if task.payload is not None else rider_mass(facts_of(task.path))
    compared = compare_ride(task.path, read_vehicle(task.vehicle, payload))
    picture = task.drawn(PICTURE)
    if not picture:
        return compared.result
    result = replace(compared.result, plot=str(picture))
    with writing(picture):
        draw_ride(picture, result, compared.comparisons)
    return result


def compare_ride(log: Path, vehicle: Vehicle) -> ComparedRide:
    """Compare one ride of `vehicle`, payload included, with its simulation. Raises InputError."""
    ride = measure(log, vehicle)
    recorded, measured = ride.recorded, ride.seconds
    commands = _commands(ride)
    comparisons: dict[str, dict[str, Comparison]] = {}
    ends: dict[str, PackEmpty | None] = {}
    for form, command in commands.items():
        run = ride.simulate(command)
        comparisons[form] = _compare(measured, run, {"throttle"} if form == "open_loop" else set())
        ends[form] = _pack_empty(ride, run)
    roller = ride.road if isinstance(ride.road, Dynamometer) else None
    alone = components(vehicle, measured, ride.soc, recorded.first("ambient_temperature", MILD), roller)
    verdicts = {form: _verdict(comparisons[form], ends[form]) for form in commands}
    judged = {name: c.errors(CONFIG.component_gate_percent) for name, c in alone.items() if _enough(c)}
    if not judged and not any(verdict.channels for verdict in verdicts.values()):
        channels = ", ".join(channel.label for channel in CHANNELS.values())
        raise InputError(f"{log}: nothing in it can be compared with its simulation: it needs one of {channels}")
    components_passed = all(errors.passed for errors in judged.values())
    conditions, missing = riding_conditions(measured)
    missing += _not_judged(ride, commands)
    missing += [_empty_text(form, end, recorded.duration) for form, end in ends.items() if end]
    comparisons["components"] = alone
    splits = []
    for form, compared in comparisons.items():
        end = ends.get(form)
        for channel, comparison in compared.items():
            splits += comparison.until(end.compared_s if end else None).split(form, channel, conditions)
    voltage, kind = alone.get("battery_voltage"), facts_of(log).get("kind")
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
        energy_wh=float(measured["pack_power"].sum()) / WH if "pack_power" in measured else None,
        open_loop=verdicts.get("open_loop"),
        predictive=verdicts["predictive"],
        components=Verdict(judged, components_passed) if judged else None,
        splits=splits,
        cells_series=vehicle.pack.cells_series,
        soc_reference=soc_reference(vehicle, measured, ride.soc, voltage.modelled if voltage else None),
        missing=missing,
        passed=components_passed and all(verdict.passed for verdict in verdicts.values()),
        plot=None,
    )
    return ComparedRide(result, comparisons)


# --- measurements -------------------------------------------------------------------------------------------------


def measure(log: Path, vehicle: Vehicle) -> MeasuredRide:
    """Read a ride that is long enough to judge. Raises InputError."""
    recorded = read_recorded(log, vehicle)
    seconds = per_second(recorded) | losses_per_second(recorded, vehicle)
    length = len(seconds["speed"])
    if length < CONFIG.shortest_s:
        raise InputError(f"{log}: {length} s are too short a ride to judge; at least {CONFIG.shortest_s} s")
    moving = int((np.abs(seconds["speed"]) > CONFIG.standing_m_s).sum())
    if moving < CONFIG.least_seconds:  # percentages at a halt are those of noise
        what = f"moves for only {moving} of its {length} s" if moving else f"only stands, for all of its {length} s"
        least = f"at least {CONFIG.least_seconds} s of it"
        raise InputError(f"{log}: the vehicle {what}: there is no riding to judge; {least}")
    road, _ = ridden_road(recorded, log)
    if not isinstance(road, Dynamometer):
        places = block_means(recorded.signals["distance"], round(1 / recorded.dt))
        seconds["grade"] = np.array([road(place)[0] for place in places.tolist()])
    return MeasuredRide(log, recorded, vehicle, seconds, road, rest_soc(recorded, vehicle))


def _without_noise(recorded: Recorded) -> Array:
    """The measured speed [m/s] per step, averaged about each."""
    return running_mean(recorded.signals["speed"], 2 * round(CONFIG.speed_average_s / recorded.dt / 2) + 1)


def per_second(recorded: Recorded) -> dict[str, Array]:
    """Measurements as means over seconds, by role; and acceleration, yaw_rate, braking, pack_power."""
    rate = round(1 / recorded.dt)
    measured = {role: block_means(values, rate) for role, values in recorded.signals.items()}
    smooth = _without_noise(recorded)
    n = len(measured["speed"])
    ends = np.minimum(np.arange(n + 1) * rate, len(smooth) - 1)
    measured["acceleration"] = np.diff(smooth[ends])  # over one second
    if "rate_z" in measured and not recorded.on_dynamometer:
        measured["yaw_rate"] = measured["rate_z"]
    if "brake" in measured:
        measured["braking"] = (measured["brake"] > 0).astype(float)
    if {"pack_current", "pack_voltage"} <= measured.keys():
        power = recorded.signals["pack_voltage"] * recorded.signals["pack_current"]
        measured["pack_power"] = block_means(power, rate)  # includes bursts within a second
    return measured


def losses_per_second(recorded: Recorded, vehicle: Vehicle) -> dict[str, Array]:
    """The motor_heat, idle_heat and inverter_heat [W] for `components`, bursts within a second included."""
    signals, roles = recorded.signals, ("motor_current", "motor_speed", "motor_temperature")
    if not signals.keys() >= set(roles):
        return {}
    copper, idle, inverter = losses(vehicle, *(signals[role] for role in roles))
    heats = {"motor_heat": copper + idle, "idle_heat": idle, "inverter_heat": inverter}
    return {name: block_means(watts, round(1 / recorded.dt)) for name, watts in heats.items()}


def soc_reference(
    vehicle: Vehicle, measured: Mapping[str, Array], start: float | None, modelled: Array | None
) -> SocReference | None:
    """The reference of the charge of a ride that begins at `start`, or None where no charge was counted.

    measured: per second, with ``soc`` and ``pack_voltage`` [V]. modelled: pack voltage [V] by the cells' circuit, from
    the measured current and the counted charge.
    """
    if start is None or "soc" not in measured:
        return None
    battery, p, counted = vehicle.pack, vehicle.parameters, measured["soc"]
    celsius = measured.get("cell_temperature")
    first = MILD if celsius is None else float(celsius[0])
    voltage = VoltageNoise(battery, p)
    sensor = p.sd("pack_voltage_offset") / battery.cells_series
    drawn = start - float(counted[-1])
    relative = hypot(p.sd("cell_capacity") / p["cell_capacity"], p.sd("pack_current_gain"))
    offset = discharged(p.sd("pack_current_offset"), len(counted), battery.pack_capacity(first))
    says = says_sd = None
    if modelled is not None and celsius is not None and len(counted) > CONFIG.last_s:
        last = slice(-CONFIG.last_s, None)
        level = float(counted[last].mean())
        slope = battery.ocv(level)[1]
        missing = float((measured["pack_voltage"] - modelled)[last].mean()) / battery.cells_series
        says = 100 * missing / slope
        says_sd = 100 * hypot(voltage.loaded(level, float(celsius[-1])), voltage.rest, sensor) / slope
    return SocReference(
        start=100 * start,
        start_sd=100 * hypot(voltage.rest, sensor) / battery.ocv(start)[1],
        drawn=100 * drawn,
        drawn_sd=100 * hypot(relative * drawn, offset),
        voltage_says=says,
        voltage_sd=says_sd,
    )


# --- its simulation -----------------------------------------------------------------------------------------------


def _commands(ride: MeasuredRide) -> dict[str, Command]:
    """How the ride is simulated, by form; not open loop without throttle and brake."""
    signals, commands = ride.recorded.signals, dict[str, Command]()
    if {"throttle", "brake"} <= signals.keys():
        commands["open_loop"] = replay(signals["throttle"].tolist(), signals["brake"].tolist(), STEP)
    profile = _without_noise(ride.recorded)
    profile[profile < CONFIG.standing_m_s] = 0.0  # or the rider would hold a hill by throttle, not by brake
    commands["predictive"] = follow(profile.tolist(), STEP)
    return commands


def _not_judged(ride: MeasuredRide, commands: Mapping[str, Command]) -> list[str]:
    """Measurements that are missing, and their consequence."""
    recorded = ride.recorded
    missing = [
        f"{channel.label} not judged: not measured" for name, channel in CHANNELS.items() if name not in ride.seconds
    ]
    if not recorded.on_dynamometer and not route_file(ride.log).is_file():
        newtons = CONFIG.grade_error * GRAVITY * ride.vehicle.model.mass
        missing.append(
            "grade is the on-board filter's, by accelerometer and altitude: wrong by some "
            f"{100 * CONFIG.grade_error:g} % in the first minutes, {newtons:.0f} N of road load; a "
            f"{recorded.name}.route.csv next to the log would give it"
        )
    if "open_loop" not in commands:
        gone = [name for name in ("throttle", "brake") if name not in recorded.signals]
        missing.append(f"not simulated open loop: the ride has no {' and no '.join(gone)}")
    return missing


def _compare(measured: Mapping[str, Array], run: Run, given: set[str]) -> dict[str, Comparison]:
    """Measured and simulated channels, and the power; given: inputs of that simulation, which are no result."""
    rate = round(1 / float(run.series["time"][1] - run.series["time"][0]))
    simulated = run.series | {"pack_power": run.series["pack_voltage"] * run.series["pack_current"]}
    return {
        name: Comparison.of(quantity, measured[name], block_means(simulated[name], rate))
        for name, quantity in {**CHANNELS, "pack_power": POWER}.items()
        if name in measured and name not in given
    }


def _verdict(comparisons: Mapping[str, Comparison], end: PackEmpty | None) -> SimulationVerdict:
    """Judge the channels, and compare the energy until the simulated pack was empty."""
    channels = {name: c.errors(CONFIG.gate_percent) for name, c in comparisons.items() if name in CHANNELS}
    energy = None
    if power := comparisons.get("pack_power"):
        power = power.until(end.compared_s if end else None)
        drawn = float(power.measured.sum())
        energy = 100 * float(power.modelled.sum()) / drawn - 100 if drawn and _enough(power) else None
    return SimulationVerdict(channels, all(errors.passed for errors in channels.values()), energy, end)


def _enough(comparison: Comparison) -> bool:
    return bool(comparison.valid.sum() >= CONFIG.least_seconds)


def _pack_empty(ride: MeasuredRide, run: Run) -> PackEmpty | None:
    """When the pack of `run` was empty for the load that was measured, else for its own.

    A run whose pack is empty creeps: its own mean would take less than the ride that it is compared with.
    """
    if ride.soc is None:
        return None
    row = ran_empty(ride.vehicle, run, *(ride.load or (run.mean_power, run.form_factor_squared)))
    if row is None:
        return None
    time, distance, soc = (float(run.series[name][row]) for name in ("time", "distance", "soc"))
    # A ride that begins with a controller that holds back is compared to the end: the vehicle was held back as well.
    free = np.flatnonzero(curve_over(ride.vehicle.derating.current_by_soc, run.series["soc"][: row + 1]) >= 1.0)
    held = min(int(free[-1]) + 1, row) if len(free) else row
    return PackEmpty(time, distance * 1e-3, soc, float(run.series["time"][held]))


def _empty_text(form: str, end: PackEmpty, seconds: float) -> str:
    """The consequence of a simulated pack that is empty before the ride of `seconds` ends."""
    until = "there" if end.compared_s == end.time_s else f"{end.compared_s:.0f} s, where the controller holds back"
    return (
        f"{FORMS[form]}: the simulated pack is empty at {end.time_s:.0f} s of {seconds:.0f}, after "
        f"{end.distance_km:.2f} km, with {100 * end.soc:.1f} % of its charge: energy and conditions are compared until "
        f"{until}, all else over the whole ride"
    )
