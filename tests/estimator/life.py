"""Hours in the life of a scooter as events: riding, standing, charging, away from the daemon.

Another physics than ours: two RC pairs, the slow one of twenty minutes, other resistances and another capacity than the
vehicle file says, a current sensor with an offset, an odometer in steps of 100 m and a state of charge of its own in
steps of half a percent.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from math import exp, sqrt
from typing import Any

import numpy as np

from gz_onboard.estimator.battery_filter import with_soc
from gz_onboard.events import Group
from gz_onboard.vehicle import Vehicle, read_vehicle
from tests.events import Event, EventEstimator
from tests.support import ROOT

VEHICLE = read_vehicle("reference", 75.0)
LFP = read_vehicle(str(ROOT / "tests/vehicles/lfp.toml"), 75.0)  # whose voltage tells next to nothing from 0.2 to 0.95
BATTERY = VEHICLE.pack
PERIOD = 0.2  # s, of the messages that come often
GROUPS = [
    Group("Pack", ("pack_voltage", "pack_current", "bms_state_of_charge"), PERIOD),
    Group("Motor", ("motor_speed",), PERIOD),
    Group("Inverter", ("inverter_voltage", "inverter_current"), PERIOD),
    Group("Cells", ("cell_temperature", "ambient_temperature"), 1.0),
    Group("Vehicle", ("odometer", "charge_plug"), 1.0),
]
PACK, MOTOR, INVERTER, CELLS, OTHERS = range(5)
STEP = 0.1  # s


@dataclass
class Scooter:
    """The truth, and the time."""

    soc: float = 0.8
    vehicle: Vehicle = VEHICLE
    temperature: float = 20.0
    offset: float = 0.05  # A
    capacity: float = 32.5  # A·h
    seed: int = 0
    period: float = PERIOD  # s, of every message
    plug: float | None = 0.0  # None: no such signal comes
    auxiliary: float = 45.0  # W
    time: float = 0.0
    distance: float = 3_210_000.0  # m
    energy: float = 0.0  # J at the terminals
    resistance: float = 1.0  # of the cells, over that of the vehicle file
    fast: float = 0.0  # V
    slow: float = 0.0  # V
    speed: float = 0.0
    rng: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)

    def live(self, seconds: float, target: float = 0.0, charge: float = 0.0) -> Iterator[Event]:
        """Ride at about `target` [m/s], or stand at 0, or charge with `charge` [A]; yields what the bus says of it."""
        steps, every = round(seconds / STEP), max(round(self.period / STEP), 1)
        for step in range(steps):
            wish = target * (1.0 if step % 500 < 430 else 0.0)  # now and then a red light
            a = float(np.clip(0.6 * (wish - self.speed), -1.5, 1.0))
            self.speed = max(self.speed + a * STEP, 0.0)
            force = 190 * a * 1.05 + 26 + 0.36 * self.speed**2
            power = self.auxiliary + self.speed * force * (1.15 if a > -0.3 else 0.3)
            current, voltage = self._draw(power, charge)
            self.time += STEP
            if step % every == 0:
                yield from self._told(current, voltage, charge, step // every)

    def _draw(self, power: float, charge: float) -> tuple[float, float]:
        resistance, pack = 0.066 * self.resistance, self.vehicle.pack
        rest = pack.ocv_curve.at(self.soc)
        source = pack.cells_series * (rest - self.fast - self.slow)
        current = (source - sqrt(max(source**2 - 4 * resistance * power, 0))) / (2 * resistance) - charge
        voltage = source - resistance * current
        cell = current / 12
        self.fast = exp(-STEP / 25) * self.fast + 0.018 * self.resistance * (1 - exp(-STEP / 25)) * cell
        self.slow = exp(-STEP / 1200) * self.slow + 0.008 * (1 - exp(-STEP / 1200)) * cell
        self.soc -= current * STEP / 3600 / self.capacity
        self.distance += self.speed * STEP
        self.energy += voltage * current * STEP
        return current, voltage

    def _told(self, current: float, voltage: float, charge: float, count: int) -> Iterator[Event]:
        t, noise = self.time, self.rng.standard_normal
        own = round(200 * min(self.soc + 0.02, 1.0)) / 200
        measured = current + self.offset + 0.06 * noise()
        yield t, PACK, (round(voltage + 0.01 * noise(), 2), round(measured, 2), own)
        yield t + 0.01, MOTOR, (self.speed / 0.2438,)
        yield t + 0.02, INVERTER, (voltage - 0.009 * current, current + charge - 0.85 * self.auxiliary / 45)
        if count % max(round(1 / self.period), 1) == 0:
            yield t + 0.03, CELLS, (self.temperature, self.temperature - 2)
            plug = None if self.plug is None else float(charge > 0)
            yield t + 0.04, OTHERS, (100.0 * (self.distance // 100), plug)

    def away(self, seconds: float, target: float = 0.0, charge: float = 0.0) -> None:
        """The same while nobody listens."""
        for _ in self.live(seconds, target, charge):
            pass


def flat_pack(**made: Any) -> Scooter:
    """A scooter of `LFP`."""
    return Scooter(vehicle=LFP, capacity=39.0, resistance=0.4, **made)


def estimator(groups: list[Group] | None = None, vehicle: Vehicle = VEHICLE) -> Any:  # tests know what is not None
    return EventEstimator(groups or GROUPS, vehicle.pack, vehicle.model, vehicle.riding)


def follow(e: Any, events: Iterable[Event], scooter: Scooter) -> list[tuple[float, Any]]:
    """(true SOC, estimate) once a second."""
    rows: list[tuple[float, Any]] = []
    for event in events:
        e.handle(event)
        if not rows or event[0] - rows[-1][1].time >= 1.0:
            rows.append((scooter.soc, e.estimate(event[0])))
    return rows


def set_soc(e: Any, soc: float, variance: float, error_variance: float) -> None:
    """Set the state of charge and the variances of it and of the model error [V²]."""
    state = with_soc(e.pack.state, soc, variance)
    covariance = (variance, 0.0, 0.0, 0.0, error_variance, 0.0, 0.0, *state.covariance[7:])
    e.pack.state = state._replace(covariance=covariance)
    e.pack.age.apply(e.pack.state)


def knows(e: Any, scooter: Scooter) -> None:
    """Tell it the true state of charge and capacity: what it says from then on is by what it has counted."""
    set_soc(e, scooter.soc, 1e-8, 1e-8)
    state = e.pack.state
    covariance = (*state.covariance[:7], 1e-6, *state.covariance[8:])
    e.pack.state = state._replace(inverse_capacity=1.0, covariance=covariance)
    e.pack.age.apply(e.pack.state)


def worst(rows: list[tuple[float, Any]]) -> float:
    """The largest error of SOC, in its own sd."""
    return float(max(abs(e.soc - true) / e.soc_sd for true, e in rows if e.soc is not None))
