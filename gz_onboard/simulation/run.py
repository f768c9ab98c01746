"""Rides of the simulated scooter: along a cycle, along a route, or with throttle and brake given.

`drive` is the loop; a `Command` gives the rider's throttle and brake in each step. Nothing here reads files or prints.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import cycle
from math import nan
from operator import attrgetter

import numpy as np

from gz_onboard.arrays import Array, stretches
from gz_onboard.errors import brief
from gz_onboard.model.drawable import drawable
from gz_onboard.progress import Progress
from gz_onboard.simulation.parts import Rider
from gz_onboard.simulation.scooter import Scooter
from gz_onboard.vehicle import Vehicle

COLUMNS = {
    "time": "s",
    "distance": "m",
    "speed": "m/s",
    "wanted_speed": "m/s",  # not a number where the ride is open loop
    "throttle": "1",
    "brake": "1",
    "grade": "1",
    "curvature": "1/m",  # of the road, positive left
    "climb": "m",
    "vibration": "m/s^2",  # 0 unless an effect reads it
    "wheel_speed": "rad/s",  # of the driven wheel
    "motor_speed": "rad/s",
    "motor_current": "A",
    "motor_torque": "N·m",
    "pack_current": "A",
    "pack_voltage": "V",
    "soc": "1",
    "energy": "J",  # delivered by the pack since the start, less what was recovered
    "cell_temperature": "degC",
    "motor_temperature": "degC",
    "inverter_temperature": "degC",
    "bms_temperature": "degC",
    "rear_load": "N",
    "front_load": "N",
    "tyre_force": "N",
    "lean": "rad",  # positive right; 0 with a chassis that does not lean
}
"""The time series of a run, with their units; signs as in `model.effect`, current positive discharging."""
_STATES = {name: name for name in COLUMNS if name not in ("wanted_speed", "energy")} | {
    "pack_current": "current",
    "pack_voltage": "voltage",
    "soc": "pack.soc",
    "cell_temperature": "pack_cooling.temperature",
    "motor_temperature": "motor_cooling.temperature",
    "inverter_temperature": "inverter_cooling.temperature",
    "bms_temperature": "bms_cooling.temperature",
    "tyre_force": "force",
}
"""By column: the attribute of the scooter that has it."""

SAMPLE = 0.1  # s: from row to row of the series
# How far from its speed a cycle may be ridden: 3.2 km/h from any speed within 1 s (UN GTR No. 2, par. 7.2; 40 CFR
# 1066.425).
TOLERANCE = 3.2 / 3.6  # m/s
TOLERANCE_TIME = 1.0  # s
OPEN = 0.95  # mean throttle of a vehicle that gives all it has
LOADED = 0.1  # state of charge: a ride that ended with more left was ended by the load

Command = Callable[[Scooter], tuple[float, float, float]]
"""(throttle 0..1, brake 0..1, wanted speed [m/s] or not a number) for the next step."""


@dataclass(frozen=True)
class Shortfall:
    """A stretch in which the ride was slower than the profile, beyond the tolerance; time and distance: its begin."""

    time_s: float
    distance_km: float
    duration_s: float
    missing_km_h: float  # at most
    wanted_km_h: float  # where most was missing
    beyond_vehicle: bool  # the throttle was open all along; else it is the rider's lag


@dataclass(frozen=True)
class BeyondBattery:
    """A pack at its cut-off voltage or below, or without charge; the state where that begins."""

    charge: bool  # no charge is left; else the load pulled the voltage down
    time_s: float
    distance_km: float
    duration_s: float  # in all
    soc: float
    current_a: float
    voltage_v: float
    cutoff_v: float  # of the pack


@dataclass
class Run:
    """Result of a ride. Energies in J."""

    series: dict[str, Array]  # by the names of `COLUMNS`, of one length
    steps: dict[str, Array] | None  # the same for every step, if they were kept
    ledger: dict[str, float]  # every loss by name, and kinetic and potential energy gained; its sum is `chemical`
    chemical: float  # that has left the cells' chemistry
    energy: float  # delivered at the pack's terminals, less what was recovered
    recovered: float  # charged into the pack
    distance: float  # m
    duration: float  # s
    soc_start: float
    soc_end: float
    form_factor_squared: float  # mean square of the pack current over the square of its mean
    empty: bool = False  # the ride ended because the pack was empty
    beyond: tuple[BeyondBattery, ...] = ()  # demands that the battery could not meet
    shortfalls: list[Shortfall] = field(default_factory=list)

    __repr__ = brief

    @property
    def mean_power(self) -> float:
        """At the terminals [W]."""
        return self.energy / self.duration if self.duration else 0.0

    @property
    def consumption(self) -> float | None:
        """Energy for the distance [J/m]; None below 100 m."""
        return self.energy / self.distance if self.distance >= 100 else None

    @property
    def closure(self) -> float:
        """Energy out of the cells that the ledger misses, as a share of all energy turned over."""
        turnover = sum(abs(energy) for energy in self.ledger.values())
        return (self.chemical - sum(self.ledger.values())) / turnover if turnover else 0.0


def drive(
    scooter: Scooter,
    command: Command,
    seconds: float,
    *,
    until_empty: bool = False,
    finish: float | None = None,
    progress: Progress | None = None,
    keep_steps: bool = False,
) -> Run:
    """Ride for `seconds`; a row of the series each `SAMPLE`, the first before the first step.

    until_empty: end where the cells reach the cut-off voltage or SOC 0. finish: end at this distance [m].
    """
    dt, step, states = scooter.dt, scooter.step, attrgetter(*_STATES.values())
    every = max(round(SAMPLE / dt), 1)
    row_every = 1 if keep_steps else every
    battery = scooter.vehicle.pack
    cutoff = battery.cutoff_voltage * battery.cells_series
    end = finish if finish is not None else float("inf")
    kinetic, soc_start = scooter.kinetic_energy(), scooter.pack.soc
    cells = array("d", (*states(scooter), nan))  # row by row
    currents, voltages = array("d", (0.0,)), array("d", (0.0,))  # of the pack in each step
    done, empty, wanted = 0, False, nan
    for done in range(1, round(seconds / dt) + 1):
        throttle, brake, wanted = command(scooter)
        step(throttle, brake)
        currents.append(scooter.current)
        voltages.append(scooter.voltage)
        if not done % row_every:
            cells.extend((*states(scooter), wanted))
            if progress and not done % (100 * every):
                progress(100 * every * dt)
        if scooter.distance >= end:
            break
        if until_empty and (scooter.voltage <= cutoff or scooter.pack.soc <= 0.0):
            empty = True
            break
    if done % row_every:
        cells.extend((*states(scooter), wanted))
    current, voltage = np.frombuffer(currents), np.frombuffer(voltages)
    energy = np.cumsum(current * voltage) * dt
    names = (*_STATES, "wanted_speed")
    rows = np.frombuffer(cells).reshape(-1, len(names))
    at = np.append(np.arange(0, done, row_every), done)
    columns = dict(zip(names, rows.T, strict=True), energy=energy[at])
    steps = {name: columns[name] for name in COLUMNS}
    series = steps
    if keep_steps:
        sampled = [*range(0, done, every), done]
        series = {name: column[sampled] for name, column in steps.items()}
    if len(rows) > 1 and not np.isnan(series["wanted_speed"][1]):
        series["wanted_speed"][0] = series["speed"][0]  # before the first step nothing else can be wanted
    gained = {"kinetic_energy": scooter.kinetic_energy() - kinetic, "potential_energy": scooter.potential_energy()}
    charge = float(current.sum())
    return Run(
        series=series,
        steps=steps if keep_steps else None,
        ledger={**scooter.ledger, **gained},
        chemical=scooter.pack.chemical_energy_drawn(),
        energy=float(energy[-1]),
        recovered=-float(np.minimum(current * voltage, 0.0).sum()) * dt,
        distance=scooter.distance,
        duration=done * dt,
        soc_start=soc_start,
        soc_end=scooter.pack.soc,
        form_factor_squared=max(float(current @ current) * done / charge**2, 1.0) if charge else 1.0,
        empty=empty,
        beyond=beyond_pack(series, cutoff),
        shortfalls=shortfalls(series),
    )


# --- commands -----------------------------------------------------------------------------------------------------


def follow(speeds: Sequence[float], dt: float, rider: Rider | None = None) -> Command:
    """A rider who follows `speeds` [m/s], one for each step of `dt` [s]; after the last it starts again."""
    rider, wanted_speeds = rider or Rider(), cycle(speeds)

    def command(scooter: Scooter) -> tuple[float, float, float]:
        wanted = next(wanted_speeds)
        throttle, brake = rider.step(wanted, scooter.speed, dt)
        return throttle, brake, wanted

    return command


def replay(throttle: Sequence[float], brake: Sequence[float], dt: float) -> Command:
    """Throttle and brake as given, one of each for each step of `dt` [s]; after them the last."""
    last = min(len(throttle), len(brake)) - 1

    def command(scooter: Scooter) -> tuple[float, float, float]:
        i = min(round(scooter.time / dt), last)
        return throttle[i], brake[i], nan

    return command


def along(metres: Sequence[float]) -> Command:
    """A rider who follows a speed for each metre [m/s], looking half a second ahead; at least at walking pace."""
    rider, last = Rider(), len(metres) - 1

    def command(scooter: Scooter) -> tuple[float, float, float]:
        ahead = scooter.distance + 0.5 * scooter.speed
        wanted = max(metres[min(max(int(ahead), 0), last)], 1.0)
        throttle, brake = rider.step(wanted, scooter.speed, scooter.dt)
        return throttle, brake, wanted

    return command


def at_steps(time: Sequence[float], speed: Sequence[float], dt: float) -> list[float]:
    """`speed` at each step of `dt` [s] within `time` [s], the end of the step counting: a rider looks ahead."""
    steps = round((time[-1] - time[0]) / dt)
    values: list[float] = np.interp(time[0] + dt * np.arange(1, steps + 1), time, speed).tolist()
    return values


# --- demands beyond the vehicle ---------------------------------------------------------------------------------------


def beyond_pack(series: Mapping[str, Array], cutoff: float) -> tuple[BeyondBattery, ...]:
    """Where a load pulled the pack's voltage to `cutoff` [V] or below, and from where on it had no charge left.

    series: by the names of `COLUMNS`.
    """
    time = series["time"]
    step = float(time[1] - time[0]) if len(time) > 1 else 0.0
    out = np.maximum.accumulate(series["soc"] <= 0.0)
    low = (series["pack_voltage"] <= cutoff) & ~out
    found = []
    for charge, there in ((False, low), (True, out)):
        if there.any():
            first = {name: float(column[np.argmax(there)]) for name, column in series.items()}
            found.append(
                BeyondBattery(
                    charge,
                    first["time"],
                    first["distance"] * 1e-3,
                    float(there.sum()) * step,
                    first["soc"],
                    first["pack_current"],
                    first["pack_voltage"],
                    cutoff,
                )
            )
    return tuple(found)


def shortfalls(series: Mapping[str, Array]) -> list[Shortfall]:
    """Where the speed stayed below all that was wanted within a second, by more than the tolerance; worst first."""
    from numpy.lib.stride_tricks import sliding_window_view

    time, wanted, speed = series["time"], series["wanted_speed"], series["speed"]
    if len(time) < 3 or np.isnan(wanted).all():
        return []
    reach = max(round(TOLERANCE_TIME / float(time[1] - time[0])), 1)
    padded = np.pad(np.nan_to_num(wanted, nan=0.0), reach, mode="edge")
    least = sliding_window_view(padded, 2 * reach + 1).min(axis=1)
    missing = least - TOLERANCE - speed
    found = []
    for begin, end in stretches(missing > 0):
        worst = begin + int(np.argmax(missing[begin:end]))
        found.append(
            Shortfall(
                float(time[begin]),
                float(series["distance"][begin]) * 1e-3,
                float(time[min(end, len(time) - 1)] - time[begin]),
                float(wanted[worst] - speed[worst]) * 3.6,
                float(wanted[worst]) * 3.6,
                float(series["throttle"][begin:end].mean()) > OPEN,
            )
        )
    return sorted(found, key=lambda one: -one.missing_km_h * one.duration_s)


# --- range --------------------------------------------------------------------------------------------------------


def energy_left(vehicle: Vehicle, soc: float, temperature: float, power: float, form_factor_squared: float) -> float:
    """Energy [J] that the pack still delivers down to the cut-off voltage, at `soc` and `temperature` [degC].

    power: the mean [W], above 0; form_factor_squared: of the current, as of a `Run`.
    """
    overpotential = vehicle.model.overpotential(vehicle.pack, {"vibration": vehicle.riding.vibration})
    return drawable(vehicle.pack, soc, temperature, power, form_factor_squared, overpotential).energy


def range_by_energy(scooter: Scooter, run: Run) -> float | None:
    """How far [m] the pack goes from the start of `run` at its consumption; None if that is not known.

    The distance ridden, and the distance that the energy left at the end allows, at the run's mean power and form
    factor of the current. So it is never less than the distance ridden. At the start, the same equation would take the
    mean temperature of the cells, and their voltage losses as settled, from the first metre.
    """
    without_charge = run.beyond and run.beyond[-1].charge and not run.empty
    if without_charge or run.consumption is None or run.consumption <= 0:
        return None
    warm = float(run.series["cell_temperature"][-1])
    left = energy_left(scooter.vehicle, run.soc_end, warm, run.mean_power, run.form_factor_squared)
    return run.distance + left / run.consumption


def ran_empty(vehicle: Vehicle, run: Run, power: float, form_factor_squared: float) -> int | None:
    """The row of the series from which on the pack has no energy left for a mean `power` [W]; None if it always has.

    Neither the cut-off voltage nor SOC 0 tells it: a controller that holds back as the cells empty keeps off both, and
    creeps. With more than `LOADED` of the charge it is not empty, whatever the load.
    """
    soc, warm = run.series["soc"], run.series["cell_temperature"]

    def empty(row: int) -> bool:
        charge = float(soc[row])
        if charge <= 0.0 or charge > LOADED or power <= 0.0:
            return charge <= 0.0
        return energy_left(vehicle, charge, float(warm[row]), power, form_factor_squared) <= 0.0

    last = len(soc) - 1
    return bisect_left(range(last), True, key=empty) if empty(last) else None
