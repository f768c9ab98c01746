"""Priors and noise of the battery filter: all that is uncertain about the pack, in one place.

- the charge that is counted (offset and gain of the current sensor as consider parameters, samples, gaps);
- the voltage as a measurement of the state of charge;
- the charge that flowed uncounted in a gap, over a restart, or while the vehicle stood;
- the first state after any of these, from a voltage that may not be at rest.

Errors of currents are C-rates (1/h: A over the pack's A·h at the bench's temperature), as sensors and loads are sized
by the pack. Voltages, resistances and currents are a cell's unless they are said to be the pack's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from math import exp, hypot, sqrt
from typing import NamedTuple

from gz_onboard.constants import BENCH_TEMPERATURE, HOUR
from gz_onboard.estimator.battery_filter import FilterState, condition, with_soc
from gz_onboard.estimator.plausibility.electrical import CurrentSource
from gz_onboard.model.battery import HALF_FULL, Battery
from gz_onboard.model.parameters import Parameters


@dataclass(frozen=True)
class PriorConfig:
    """Constants of the priors and the noise."""

    # The state of charge
    unknown_soc_sd: float = 0.5  # whatever has flowed
    soc_bounds: tuple[float, float] = (-0.05, 1.05)  # that a linear update over a curved voltage may reach
    inverse_capacity_bounds: tuple[float, float] = (0.9, 2.0)  # of a pack at work
    resistance_bounds: tuple[float, float] = (0.5, 4.0)
    # The current: (sd [1/h] besides the sensor's own offset, s that such an error stays the same), by source
    current_error: dict[CurrentSource, tuple[float, float]] = field(
        default_factory=lambda: {
            CurrentSource.PACK: (0.0, HOUR),
            CurrentSource.INVERTER: (0.015, HOUR),  # the auxiliary load
            CurrentSource.DISPUTED: (0.18, HOUR),  # either of the two may be right
            CurrentSource.MODEL: (0.09, 600.0),  # wind and load, some of which stay for minutes
            CurrentSource.NONE: (0.46, 60.0),  # any riding
        }
    )
    unchecked_rate_sd: float = 0.006  # 1/h, while no second sensor confirms the first
    sampling_rate_sd: float = 0.15  # 1/h: of the mean current between two samples that are seconds apart
    # The voltage
    empty: tuple[float, float] = (0.05, 0.15)  # SOC of an empty cell, and from which the error grows towards it
    resistance_sd: float = 0.12  # relative: measured tables of R0 and R1, at this place on the curve and temperature
    resistance_sd_cold: float = 0.4  # the same while the cells' temperature is unknown
    history_s: float = HOUR  # that hysteresis, the place on the curve and a sensor's offset stay
    inverter_voltage_sd: float = 0.011  # V: the cable between pack and inverter
    # Charge that was not counted
    bridge_s: float = 60.0  # over so short a gap the currents before and after give the charge
    ridden_rate_sd: float = 0.5  # 1/h: mean current in a gap that may have been ridden or charged
    burst_rate_sd: float = 1.0  # 1/h: more during `bridge_s`; full power does not last longer
    charging_from_s: float = 120.0  # a shorter gap is too short to plug in, charge and leave
    distance_price_sd: float = 0.3  # relative: consumption over a distance that was not seen
    odometer_step_m: float = 100.0  # the coarsest count on a bus
    fastest_m_s: float = 70.0
    unknown_age_s: float = 86_400.0
    own_soc_sd: float = 0.015  # of a change of the vehicle's own SOC: its steps
    own_soc_gain_sd: float = 0.2  # relative, of the same: its window and its errors
    stuck_share: float = 0.3  # of a possible charge: remains though the vehicle's own SOC shows no change
    conflict_sd: float = 4.0  # two values further apart are not both right
    # The first voltage
    loaded_rate: float = 0.05  # 1/h: less is a standing vehicle with its key on, whose cells count as unloaded
    pulling_rate: float = 0.5  # 1/h: from which a vehicle that does not move yet has been under load already
    stopped_share: float = 0.5  # sd at standstill of a ride's overpotential: long parked or just stopped
    relaxed_s: float = 600.0  # after which nothing of an overpotential is known any more
    relaxation_s: float = 1000.0  # slow diffusion in lithium-ion cells takes a quarter of an hour or so
    trusted_soc_sd: float = 0.03  # besides the charge counted: from there the charge that passes tells the capacity
    table_ends: tuple[float, float] = (-0.02, 1.02)  # SOC between which a first voltage is read from the curve


PRIOR = PriorConfig()
ROUNDS = 5  # of the search for a SOC under load: R0 depends on it
FLAT_VARIANCE = 100.0  # of a SOC of which nothing is known


class ChargeNoise:
    """Variance of SOC that counting the charge adds. Remembers the part that errs one way."""

    def __init__(self, battery: Battery, parameters: Parameters) -> None:
        p = parameters
        self._rated = battery.pack_capacity(BENCH_TEMPERATURE)  # A·h
        self._offset_sd = p.sd("pack_current_offset")
        self._gain_sd = hypot(p.sd("cell_capacity") / p["cell_capacity"], p.sd("pack_current_gain"))
        self._uncounted_sd = 0.0  # of SOC

    def counted(
        self, dt: float, flowed: float, charge: float, source: CurrentSource, apart: float | None, period: float = 0.0
    ) -> float:
        """Variance after `dt` [s] in which a share `flowed` of the capacity `charge` [A·s] was counted.

        apart: a second sensor confirms the first, but for this mean difference [A]; None: there is no second one.
        period: of samples that are seconds apart [s]; 0 if they are not.
        """
        sd, time = PRIOR.current_error[source]
        checked = PRIOR.unchecked_rate_sd * self._rated if apart is None else apart
        variance = self._offset_sd**2 + checked**2 + (sd * self._rated) ** 2
        steady = 2 * time * dt * variance / charge**2 + self._gain_sd**2 * abs(flowed)
        return steady + (PRIOR.sampling_rate_sd / HOUR) ** 2 * dt * period

    def uncounted(self, more: float, soc_sd: float) -> float:
        """Variance after `more` of SOC may have flowed uncounted, as in a gap; soc_sd: the most that is known of it.

        The errors of successive gaps have the same sign: the rider continues as before, the load stays.
        """
        before = min(self._uncounted_sd, soc_sd)
        self._uncounted_sd = before + more
        return (2 * before + more) * more


class VoltageNoise:
    """Errors of a cell's voltage as a measurement of the state of charge [V]."""

    def __init__(self, battery: Battery, parameters: Parameters) -> None:
        p = parameters
        self._battery = battery
        self.model = p.sd("cell_voltage_error")
        self.rest = sqrt(p.sd("rest_voltage_error") ** 2 + battery.ocv_sd**2 + battery.rest_shift_sd**2)
        self.resistance = max(PRIOR.resistance_sd, p.sd("cell_resistance_factor"))  # relative
        self.history = p.sd("rest_voltage_error") ** 2 + battery.rest_shift_sd**2  # V²: hysteresis before all
        self._empty = p.sd("cell_voltage_error_empty")
        self._error_time = p["cell_voltage_error_time"]
        self._sensor = (p.sd("pack_voltage_offset") / battery.cells_series) ** 2  # V²
        self._capacity_scatter = p.sd("cell_capacity") / p["cell_capacity"]
        self._rated = battery.cell_capacity(BENCH_TEMPERATURE)

    def loaded(self, soc: float, temperature: float) -> float:
        """Standard deviation of the cell model under load: it errs more near empty, and in the cold."""
        model, (empty, begins) = self._battery.voltage_error(temperature, self.model), PRIOR.empty
        if soc >= begins or self._empty <= model:
            return model
        return model + min((begins - soc) / (begins - empty), 1.0) * (self._empty - model)

    def error_time(self, temperature: float) -> float:
        """Time [s] for which the circuit errs the same way: longer in the cold, where its missing part is slower."""
        return self._battery.voltage_error_time(temperature, self._error_time)

    def slow(self, soc: float, slope: float, temperature: float, soc_variance: float) -> tuple[float, float]:
        """(variance [V²], time constant [s]) of the slow model error e: circuit, place on the curve, sensor.

        While SOC is known poorly, the circuit's error is the one to wait for; the better it is known, the more of a
        voltage's deviation is the part that stays. slope: of the open-circuit voltage [V].
        """
        # The pack's cells are not the bench's: their place on the curve is known to the scatter of their capacity.
        place_sd = self._capacity_scatter * (1 - soc) * slope
        stays = place_sd * place_sd + self.history + self._sensor
        share = stays / (stays + slope * slope * soc_variance)
        circuit, sd = self.error_time(temperature), self.loaded(soc, temperature)
        return sd * sd + stays, circuit + share * max(PRIOR.history_s - circuit, 0.0)

    def fast(
        self, r0: float, drops: tuple[float, float], source: CurrentSource, resistance_sd: float, voltage_sd: float
    ) -> float:
        """Variance [V²] of the part that changes with the load; voltage_sd: of the measured voltage [V].

        drops: by R0 and the effects, and by the RC pair [V]; r0 in ohm; resistance_sd: relative.
        """
        current_sd = PRIOR.current_error[source][0] * self._rated
        by_resistance = resistance_sd * resistance_sd * (drops[0] * drops[0] + drops[1] * drops[1])
        return by_resistance + (r0 * current_sd) ** 2 + max(voltage_sd * voltage_sd - self._sensor, 0.0)


def bounded(state: FilterState) -> FilterState:
    """The state within the bounds of its means and of the variance of SOC."""
    if state.covariance[0] > PRIOR.unknown_soc_sd**2:
        state = with_soc(state, state.soc, PRIOR.unknown_soc_sd**2)
    soc = min(max(state.soc, PRIOR.soc_bounds[0]), PRIOR.soc_bounds[1])
    inverse = min(max(state.inverse_capacity, PRIOR.inverse_capacity_bounds[0]), PRIOR.inverse_capacity_bounds[1])
    resistance = min(max(state.resistance, PRIOR.resistance_bounds[0]), PRIOR.resistance_bounds[1])
    if (soc, inverse, resistance) == (state.soc, state.inverse_capacity, state.resistance):
        return state
    return state._replace(soc=soc, inverse_capacity=inverse, resistance=resistance)


# --- charge that was not counted ------------------------------------------------------------------------------------


class Past(NamedTuple):
    """The vehicle when its pack was measured last; None where it has no such signal, or the value is unknown."""

    current: float | None = None  # A of the pack
    odometer: float | None = None  # m
    own_soc: float | None = None  # the vehicle's own state of charge
    consumption: float | None = None  # J/m that was expected


def uncounted_sd(gap: float) -> float:
    """Standard deviation of the SOC that flowed uncounted in `gap` [s], ridden or charged."""
    rate = PRIOR.ridden_rate_sd * gap + PRIOR.burst_rate_sd * min(gap, PRIOR.bridge_s)
    return min(rate / HOUR, PRIOR.unknown_soc_sd)


def uncounted(past: Past, age: float | None, now: Past, charge: float, voltage: float) -> tuple[float, float]:
    """(SOC that was drawn uncounted since `past`, its standard deviation).

    age: of `past` [s], None if unknown; now: as the vehicle shows it; charge: of the pack [A·h], at its `voltage` [V].
    """
    p, gap = PRIOR, PRIOR.unknown_age_s if age is None else age
    distance = None if now.odometer is None or past.odometer is None else now.odometer - past.odometer
    if distance is not None and distance > p.fastest_m_s * gap + p.odometer_step_m:
        gap = p.unknown_age_s  # it is longer than the clock says, or the odometer was reset
    farthest = p.fastest_m_s * gap + p.odometer_step_m
    mean, sd = 0.0, uncounted_sd(gap)
    if distance is not None and past.consumption is not None:
        price = past.consumption / (HOUR * charge * voltage)  # SOC per metre
        if -p.odometer_step_m <= distance <= farthest and distance * price < 1:  # otherwise charged as well
            mean = max(distance, 0.0) * price
            charged = p.ridden_rate_sd * max(gap - p.charging_from_s, 0.0) / HOUR
            step = min(p.odometer_step_m, p.fastest_m_s * gap) * price
            sd = min(hypot(p.distance_price_sd * mean, charged, step), sd)
    elif gap <= p.bridge_s and past.current is not None and now.current is not None:
        mean = (past.current + now.current) / 2 * gap / (HOUR * charge)
    if now.own_soc is not None and past.own_soc is not None:
        own = past.own_soc - now.own_soc
        own_sd, apart = p.own_soc_sd + p.own_soc_gain_sd * abs(own), abs(own - mean)
        if apart > p.conflict_sd * hypot(sd, own_sd):  # one of the two is wrong
            sd = hypot(sd, apart)
        elif apart <= own_sd:  # confirmed, to no better than its steps; but it may be stuck
            sd = min(sd, hypot(own_sd, p.stuck_share * sd))
        else:
            share = sd * sd / (sd * sd + own_sd * own_sd)
            mean, sd = mean + share * (own - mean), sd * sqrt(1 - share)
    return mean, min(sd, p.unknown_soc_sd)


# --- the first state ------------------------------------------------------------------------------------------------


class First(NamedTuple):
    """The pack's first voltage that holds still, and the situation it is measured in."""

    time: float  # s
    voltage: float  # V of the pack
    current: float  # A of the pack
    moving: bool | None  # None while no speed is known
    unsteady_sd: float = 0.0  # V of a cell, by its movement since
    temperature: float = BENCH_TEMPERATURE  # degC
    overpotential: float = 0.0  # V of a cell, by the effects in it
    riding_power: float = 0.0  # W of the prior riding
    voltage_sd: float = 0.0  # V of a cell, of the sensor


def soc_width(battery: Battery, emf: float, sd: float, temperature: float) -> float:
    """Difference of the states of charge at the rest voltages `emf` ± `sd` [V]."""
    return battery.soc_at(emf + sd, temperature) - battery.soc_at(emf - sd, temperature)


def soc_from_voltage(
    battery: Battery, voltage: float, current: float, temperature: float, v1: float, sd: float
) -> tuple[float, float]:
    """(SOC of a cell with this voltage [V] at this current [A], its standard deviation) for `sd` [V] of the voltage.

    The standard deviation is the chord of the rest voltage: near empty a tangent would promise far too much.
    """
    soc, (low, high) = HALF_FULL, PRIOR.table_ends
    for _ in range(ROUNDS):
        emf = voltage + battery.r0.at(soc, temperature)[0] * current + v1
        soc = min(max(battery.soc_at(emf, temperature), low), high)
    return soc, min(soc_width(battery, emf, sd, temperature) / 2, PRIOR.unknown_soc_sd)


def first_state(
    battery: Battery,
    noise: VoltageNoise,
    believed: FilterState,
    first: First,
    past: Past | None,
    age: float | None,
    now: Past,
    min_capacity_variance: Callable[[float], float],
) -> FilterState:
    """The first state, from a voltage and from the state that was `believed` before.

    past: the vehicle `age` [s] ago, when the state was believed; None: nothing is believed of the SOC. now: the vehicle
    at present. min_capacity_variance: of the inverse capacity, over SOC, see `condition`.
    """
    temperature, current = first.temperature, first.current / battery.cells_parallel
    voltage = battery.cell_voltage(first.voltage, first.current) + first.overpotential
    rough, _ = soc_from_voltage(battery, voltage, current, temperature, 0.0, noise.rest)
    r0, r1, c1 = battery.circuit(rough, temperature)
    capacity = battery.pack_capacity(temperature)
    rate = PRIOR.loaded_rate if first.moving is None else PRIOR.pulling_rate
    loaded = abs(first.current) > rate * capacity or bool(first.moving)
    # The overpotential of a ride that was not seen: certain if the vehicle rides, possible at standstill.
    ridden = r1 * first.riding_power / first.voltage / battery.cells_parallel
    room = battery.ocv(1.0, temperature)[0] - voltage - r0 * current  # V: no cell is more than full
    if ridden > room > 0:  # the middle of the possible: a table beyond its data promises any overpotential
        ridden = room / 2
    v1, v1_sd = (ridden, ridden) if loaded else (0.0, PRIOR.stopped_share * ridden)
    slow_sd = hypot(noise.rest, first.voltage_sd, noise.loaded(rough, temperature) if loaded else 0.0)
    once_sd = hypot(noise.resistance * (r0 * current + first.overpotential), first.unsteady_sd)
    if past and age is not None:
        if not loaded and past.odometer is not None and past.own_soc is not None and now.own_soc is not None:
            is_charged = abs(now.own_soc - past.own_soc) > PRIOR.own_soc_sd
            if past.odometer == now.odometer and not is_charged:  # the vehicle was not used
                v1_sd *= exp(-age / PRIOR.relaxation_s)
        if age < PRIOR.relaxed_s:
            decay = exp(-age / (r1 * c1))
            v1 += (believed.v1 - v1) * decay
            v1_sd = sqrt(believed.covariance[4] * decay**2 + v1_sd**2 * (1 - decay**2))
        # The cell model errs the same way for a time: after a shorter gap the voltage adds no information.
        factor = sqrt(max(2 * noise.error_time(temperature) / max(age, 0.1), 1.0))
        slow_sd, once_sd = factor * slow_sd, factor * once_sd
    error_sd = hypot(v1_sd, slow_sd)
    sd = hypot(error_sd, once_sd)
    shown, shown_sd = soc_from_voltage(battery, voltage, current, temperature, v1, sd)
    soc, variance, doubt = shown, FLAT_VARIANCE, 0.0
    _, _, zc, _, _, _, _, cc, _, rr = believed.covariance
    if past:
        drawn, drawn_sd = uncounted(past, age, now, capacity, first.voltage)
        soc, variance = believed.soc - drawn, believed.covariance[0] + drawn_sd**2
        if (soc - shown) ** 2 > PRIOR.conflict_sd**2 * (variance + shown_sd**2):  # either may be wrong
            doubt = (soc - shown) ** 2
    if not past or doubt or variance - zc * zc / cc > PRIOR.trusted_soc_sd**2:
        zc = 0.0  # the charge counted before is not the error of this SOC
    prior = (variance + doubt, 0.0, zc, 0.0, error_sd**2, 0.0, 0.0, cc, 0.0, rr)
    state = FilterState(soc, 0.0, believed.inverse_capacity, believed.resistance, prior, v1)
    chord = shown_sd / sd  # SOC per volt
    slopes, seen_variance = (1.0, -chord, 0.0), (chord * once_sd) ** 2 + doubt
    return bounded(condition(state, slopes, shown - soc, seen_variance, min_capacity_variance(shown)))
