"""The first state of charge: which voltage it is made from, and the filter that goes on from it."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, hypot, inf, sqrt

from gz_onboard.estimator.ekf import FilterMaker, SocFilter
from gz_onboard.estimator.rest import REST_RATE
from gz_onboard.estimator.signals import Signals
from gz_onboard.estimator.start import Saved, bounded, from_voltage, limit_soc_variance, parked, uncounted, update_soc
from gz_onboard.estimator.uncertainty import VoltageUncertainty
from gz_onboard.physics.battery import HALF_FULL, Battery
from gz_onboard.physics.effect import MOVING

START_WAIT = 1.5  # s to wait for what comes once a second before the first estimate
STEADY_TIME = 0.5  # s over which the first voltage must hold still; an inverter that is being charged does not
STEADY_SHARE = 0.02  # of the span of the rest voltage: by more no cell's voltage moves meanwhile without a load
DROP_FACTOR = 3.0  # of the drop by a load that the tables give: no cell has more, cold and aged ones included
STEADY_AFTER = 10.0  # s over which it must hold still after it has once been seen to move
DOUBT_WAIT = 5.0  # s to wait for what comes, but cannot be right yet
STEADY_WAIT = 60.0  # s after which it is begun with whatever there is, knowing nothing
STEADY_SD = 4.0  # of the movement: how much may be still to come
PULLING_RATE = 0.5  # 1/h: current over capacity from which a vehicle that does not move yet has been under load already
STOPPED_SHARE = 0.5  # of a ride's polarisation: sd at standstill, long parked or just stopped
RELAXED = 600.0  # s: V1 is no less known than after so long
CONFLICT = 4.0  # sd between the saved SOC and that of the voltage: beyond, one of the two is wrong
ROUGH_SD = 0.01  # V: any, for a state of charge of which only the mean is used
SHORTEST_AGE = 0.1  # s, to divide by


@dataclass(slots=True)
class First:
    """The pack as it was measured first."""

    time: float  # s
    voltage: float  # V
    current: float  # A
    moving: bool | None = None  # whether the vehicle moved then; None while no speed is known


class SteadyVoltage:
    """Waits for the first voltage that holds still, until what comes once a second is known or overdue.

    Riders pull away within a second: the first voltage is the one at rest, what flows meanwhile is counted.
    """

    def __init__(self, battery: Battery) -> None:
        self._battery = battery
        self._span = battery.ocv(1.0)[0] - battery.ocv(0.0)[0]
        self._first: First | None = None
        self._looked = -inf  # s: the last time
        self._unsteady = False  # a first voltage moved
        self._waited = inf  # s: since when a first voltage has been looked at

    def forget(self) -> None:
        """Wait for a first voltage once more."""
        self._first = None

    def step(
        self,
        now: float,
        voltage: float,
        current: float,
        temperature: float,
        speed: float | None,
        pause: float,
        least: float,
    ) -> tuple[First, float] | None:
        """(the first of the voltages that hold still, sd of a cell's from its movement [V]); None while too short.

        voltage [V], current [A]: of the pack; temperature: of the cells [degC]; pause: a gap that is longer [s] begins
        anew; least: for so long [s] it must hold still.
        """
        if self._first is None or now - self._looked > max(2 * START_WAIT, pause):
            self._first = First(now, voltage, current)
        self._looked = now
        first = self._first
        if first.moving is None and speed is not None:
            first.moving = abs(speed) > MOVING
        self._waited = min(self._waited, now)
        late = now - self._waited >= STEADY_WAIT
        moved = self._moved(first, voltage, current, temperature)
        if moved > STEADY_SHARE * self._span and not late:
            self._first, self._unsteady = First(now, voltage, current), True
            return None
        if now - first.time < (STEADY_AFTER if self._unsteady else least) and not late:
            return None
        self._waited, self._unsteady = inf, False
        return first, self._span if late else STEADY_SD * moved

    def _moved(self, first: First, voltage: float, current: float, temperature: float) -> float:
        """By how much a cell's voltage moved [V] that is due to no load."""
        battery = self._battery
        r0 = battery.r0.at(HALF_FULL, temperature)[0] * battery.cells_series / battery.cells_parallel
        drop = battery.cell_voltage(r0, 1.0) * abs(current - first.current)
        return max(abs(voltage - first.voltage) / battery.cells_series - DROP_FACTOR * drop, 0.0)


@dataclass(frozen=True, slots=True)
class Situation:
    """What is known when the first state of charge is made."""

    now: float  # s
    temperature: float  # degC, of the cells
    overpotential: float  # V of a cell, by the effects in it
    riding_power: float  # W of the prior riding
    voltage_sd: float  # V of a cell, of the sensor
    unsteady_sd: float  # V of a cell, from its movement meanwhile


def first_filter(
    battery: Battery,
    make: FilterMaker,
    uncertainty: VoltageUncertainty,
    first: First,
    at: Situation,
    signals: Signals,
    restored: tuple[Saved | None, float | None],
) -> tuple[SocFilter, tuple[float, float] | None]:
    """The first SOC: from the voltage, and from what was saved before, each with what is not known about it.

    restored: what was saved, and how long before [s]. Gives also (SOC, its variance) of the latter, if the two agree.
    """
    temperature, (saved, age) = at.temperature, restored
    cell_current = first.current / battery.cells_parallel
    cell_voltage = battery.cell_voltage(first.voltage, first.current) + at.overpotential
    soc, _ = from_voltage(battery, cell_voltage, cell_current, temperature, 0.0, ROUGH_SD, ROUGH_SD)
    capacity = battery.pack_capacity(temperature)
    rate = REST_RATE if first.moving is None else PULLING_RATE
    loaded = abs(first.current) > rate * capacity or bool(first.moving)
    # The polarisation of a ride that was not seen: certain if the vehicle rides, possible at standstill.
    r0, r1 = battery.r0.at(soc, temperature)[0], battery.r1.at(soc, temperature)[0]
    ridden = r1 * at.riding_power / first.voltage / battery.cells_parallel
    room = battery.ocv(1.0, temperature)[0] - cell_voltage - r0 * cell_current  # V: no cell is more than full
    if ridden > room > 0:  # at the middle of what can be: a table beyond its data promises any polarisation
        ridden = room / 2
    v1, v1_sd = (ridden, ridden) if loaded else (0.0, STOPPED_SHARE * ridden)
    model_sd = uncertainty.loaded(soc, temperature) if loaded else 0.0
    slow_sd = hypot(uncertainty.rest, at.voltage_sd, model_sd)
    once_sd = hypot(uncertainty.resistance * (r0 * cell_current + at.overpotential), at.unsteady_sd)
    drawn = None
    if saved:
        own_soc, odometer = signals.bms_state_of_charge.get(at.now), signals.odometer.get(at.now)
        drawn = uncounted(saved, age, capacity, first.voltage, first.current, odometer, own_soc)
        if not loaded:
            v1_sd *= 1 - parked(saved, age, odometer, own_soc)
        if age is not None and age < RELAXED:
            decay = exp(-age / (r1 * battery.c1.at(soc, temperature)[0]))
            v1 += (saved.v1 - v1) * decay
            v1_sd = sqrt(saved.covariance[2] * decay**2 + v1_sd**2 * (1 - decay**2))
        # The cell model errs the same way for a time: after a shorter gap the voltage adds no information.
        if age is not None:
            factor = sqrt(max(2 * uncertainty.error_time(temperature) / max(age, SHORTEST_AGE), 1.0))
            slow_sd, once_sd = factor * slow_sd, factor * once_sd
    error_sd = hypot(v1_sd, slow_sd)
    soc, covariance = from_voltage(battery, cell_voltage, cell_current, temperature, v1, error_sd, once_sd)
    filter_ = make(battery, soc, v1, covariance)
    counted = None
    if saved and drawn:
        before, variance = saved.soc - drawn[0], saved.covariance[0] + drawn[1] ** 2
        apart = (before - soc) ** 2
        if apart > CONFLICT**2 * (variance + covariance[0]):  # either may be wrong
            variance += apart
            filter_.covariance = covariance[0] + apart, covariance[1], covariance[2]
        else:
            counted = before, variance
        update_soc(filter_, before, variance)
        filter_.covariance = limit_soc_variance(filter_.covariance)
    filter_.soc = bounded(filter_.soc)
    return filter_, counted
