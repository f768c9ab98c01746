"""Events in, estimates out: the filter, the road, the forecast, and what to do when a sensor is missing.

No I/O and no clock: time arrives with the events, so the same events give the same estimates, to the last bit.
All state of the on-board software that matters lives here; `snapshot` and `restore` carry it over a restart.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import exp, hypot, inf, isinf, sqrt
from typing import Any

from gz_onboard.estimator.activity import Activities
from gz_onboard.estimator.ekf import FilterMaker, ScalarFilter, SocFilter
from gz_onboard.estimator.forecast import Forecast, Forecaster, Turn
from gz_onboard.estimator.redundancy import Electric, Redundancy, Speeds, lost
from gz_onboard.estimator.rest import RATE as REST_RATE
from gz_onboard.estimator.rest import Rest
from gz_onboard.estimator.road import MOST_BIAS, Road
from gz_onboard.estimator.shaking import Shaking
from gz_onboard.estimator.signals import DEFAULT_STALE, Signal, Signals
from gz_onboard.estimator.start import (
    BRIDGE,
    SOC_UNKNOWN_SD,
    Saved,
    flowed,
    from_voltage,
    parked,
    plausible,
    soc_width,
    take_in,
    unseen_sd,
)
from gz_onboard.events import STALE_PERIODS, Activity, Estimate, Event, Group, Reason, State
from gz_onboard.physics.battery import Battery
from gz_onboard.physics.effect import MOVING, QUANTITIES
from gz_onboard.physics.model import Model
from gz_onboard.physics.riding import PriorRiding

SNAPSHOT_VERSION = 3  # 2: the states of effects with memory; 3: what tells what flowed while nobody counted
PACE = ("pack_voltage", "inverter_voltage", "motor_speed")  # the message of the first that is mapped sets the pace
STEP_AT_LEAST = 0.25  # s: without the message that sets the pace, a step is made after so long
FORECAST_PERIOD = 1.0  # s
START_WAIT = 1.5  # s to wait for what comes once a second before the first estimate
STEADY_TIME = 0.5  # s over which the first voltage must hold still; an inverter that is being charged does not
PULLING_RATE = 0.5  # 1/h: current over capacity from which a vehicle that does not move yet has been under load already
STOPPED_SHARE = 0.5  # of a ride's polarisation: sd of what a vehicle that stands still has, long parked or just stopped
STEADY_SHARE = 0.02  # of the span of the rest voltage: by more no cell's voltage moves meanwhile without a load,
STEADY_DROP = 3.0  # and with one by no more than so many times the drop over R0, cold and aged cells included
STEADY_AFTER = 10.0  # s over which it must hold still after it has once been seen to move
STEADY_WAIT = 60.0  # s after which it is begun with whatever there is, knowing nothing
STEADY_SD = 4.0  # of the movement: how much may be still to come
SLOW_GAP = 0.5  # s: messages with longer gaps are watched for their real period
SLOWEST = 5.5  # s: pack current and voltage that come less often are not integrated: 5 s and what a clock is off
PAUSE = 1.0  # s: without messages of a longer period a longer gap is a pause, in which nobody knows what flowed
PAUSE_PERIODS = 2.5  # the same in real periods of the pack current
SLOW_STALE_PERIODS = 3.0  # a slow signal is stale after so many of its real periods
LONGEST_STALE = 300.0  # s, of temperatures; of everything else so many of the slowest period
FAST_COUNT = 20  # messages in a row without a long gap: the long ones are over
SAMPLING_RATE = 0.15  # 1/h: sd of the mean current over capacity between two samples that are seconds apart
CONTRADICTED = 60.0  # s: a filter whose voltage is off its gate for so long begins anew
DOUBTED_START = 30.0  # s: a voltage that is doubted so soon has misled the first state of charge
RESTARTED_FOR = 600.0  # s: for so long it is said
ERROR_TIME = 600.0  # s: over so long the cell model errs the same way; its error does not average out faster
EMPTY_BELOW, EMPTY_FROM = 0.15, 0.05  # SOC between which the model's error grows to that of an empty cell
SOC_BOUNDS = -0.05, 1.05  # what a linear update, over a curve that is not, may make of it
RELAXED = 600.0  # s: V1 is no less known than after so long
RESISTANCE_SD = 0.12  # relative: R0 of this pack at this place and temperature
RESISTANCE_SD_COLD = 0.4  # the same where the cell temperature is not known
GATE = 5.0  # sd: a voltage further off is a glitch, unless it persists
GATE_COUNT = 20  # so many in a row are no glitch
CONFLICT = 4.0  # sd between the saved SOC and that of the voltage: beyond, one of the two is wrong
REST_BETTER = 0.15  # of the sd that is known: a rest after a load is taken in only if its own is no more than this
REST_NEWS = 0.8  # a rest is taken in again when its variance fell below this share
CURRENT_SD = {
    "pack": 0.0,
    "inverter": 0.5,
    "disputed": 6.0,
    "model": 3.0,
    "none": 15.0,
}  # A, beside the sensor's own offset
CURRENT_TIME = {
    "pack": 3600.0,
    "inverter": 3600.0,
    "disputed": 3600.0,
    "model": 600.0,
    "none": 60.0,
}  # s that such an error stays the same
UNCHECKED_CURRENT_SD = 0.2  # A, beside the offset's, while no second sensor confirms the first
INVERTER_VOLTAGE_SD = 0.15  # V: the cable between pack and inverter
# What is missing makes the consumption to come less certain; relative sd, judged by what each is worth on the rides.
LOSS_SD = {
    Reason.NO_SPEED: 0.10,
    Reason.NO_IMU: 0.03,
    Reason.NO_GPS: 0.03,
    Reason.NO_AMBIENT_TEMPERATURE: 0.04,
    Reason.NO_CELL_TEMPERATURE: 0.02,
    Reason.NO_PACK_CURRENT: 0.03,
    Reason.NO_PACK_VOLTAGE: 0.02,
    Reason.SENSOR_DISTRUSTED: 0.05,  # what was learned from it before it was found out
}
LEARNED_FROM = {"motor_speed", "accel_x", "gps_altitude", "pack_current", "pack_voltage"}
UNLEARNED = 1500.0  # m: so far a sensor can have lied before it is found out
WEIGHTY = ~(Reason.PRIOR_RIDING | Reason.FRAMES_DROPPED | Reason.FRAMES_LOST)  # reasons that degrade an estimate
NO_PACK = Reason.NO_PACK_VOLTAGE | Reason.NO_PACK_CURRENT
SAVED_MOST = {"current": 1e4, "odometer": 1e10, "own_soc": 1.1, "consumption": 1e5}  # A, m, 1, J/m
MISMATCH = 3.0  # A between the two current sensors, over ten seconds or so


@dataclass(slots=True)
class First:
    """The pack as it was measured first."""

    time: float  # s
    voltage: float  # V
    current: float  # A
    moving: bool | None = None  # whether the vehicle moved then; None while no speed is known


class Estimator:
    """The estimator of one vehicle."""

    def __init__(
        self,
        groups: Sequence[Group],
        battery: Battery,
        model: Model,
        riding: PriorRiding,
        make: FilterMaker = ScalarFilter,
    ) -> None:
        self.battery = battery
        self.model = model
        self.road = Road()
        self.forecaster = Forecaster(model, battery, riding)
        self.filter: SocFilter | None = None
        self.signals = Signals(
            (role, STALE_PERIODS * group.period if group.period else DEFAULT_STALE)
            for group in groups
            for role in group.roles
        )
        self._make = make
        self._slots = [[self.signals[role] for role in group.roles] for group in groups]
        pace = [i for role in PACE for i, group in enumerate(groups) if role in group.roles]
        self._pace = pace[0] if pace else -1
        self._speeds = [i for role in Speeds.ROLES for i, group in enumerate(groups) if role in group.roles][:1]
        # Every sample of accel_z is looked at, but only for a model that reads what it tells.
        self._reads_vibration = "vibration" in model.reads
        shaken = [(i, group.roles.index("accel_z")) for i, group in enumerate(groups) if "accel_z" in group.roles]
        self._shaken, self._accel_z = shaken[0] if self._reads_vibration and shaken else (-1, 0)
        self._shaking = Shaking()
        self._time: float | None = None  # s, of the last step
        self._deadline = float("-inf")
        self._current: float | None = None  # A of the pack, at the last step
        self._first: First | None = None
        self._looked = -inf  # s: the last time
        self._unsteady = False  # a first voltage moved
        self._waited = inf  # s: since when a first voltage has been looked at
        self._unseen = 0.0  # of SOC: sd that the pauses left
        self._off_gate = 0
        self._contradicted = 0.0  # s
        self._restarted_at = -inf
        self._started = -inf  # s: when there was a first state of charge,
        self._started_from: tuple[Saved | None, float | None] = (None, None)  # and what it was made from, how old
        self._doubted = False  # a voltage
        self._rest = Rest()
        self._rest_variance = inf  # V² of a cell, of what was taken in of this rest
        self._activities = Activities()
        self._heard = [-inf] * len(groups)  # s, of each group's last message
        self._gaps = [0.0] * len(groups)  # s, between the two before that
        self._fast = [0] * len(groups)  # short gaps in a row since the last long one
        self._thermal = {i for i, group in enumerate(groups) if any("temperature" in role for role in group.roles)}
        self._periods = [group.period or 0.0 for group in groups]  # s, where slow: declared, then as they really are
        self._stale = [signals[0].stale_after if signals else 0.0 for signals in self._slots]
        self._integrated = [i for i, group in enumerate(groups) if {"pack_current", "pack_voltage"} & set(group.roles)]
        self._innovation: float | None = None
        self._innovation_square = self._error_square = 0.0
        self._mismatch = 0.0  # A, low-passed
        self._cell_temperature: float | None = None
        self._odometer: float | None = None  # m, at the last step
        self._own_soc: float | None = None  # the vehicle's own state of charge, at the last step
        self._voltage_heard: float | None = None  # s, of the message whose voltage was taken in last
        self._voltage_taken = -inf  # s: when
        self._pack: tuple[float | None, float | None, str] = (None, None, "none")
        self._said_current: float | None = None  # A of the pack, trusted or not
        self._forecast: Forecast | None = None
        self._forecast_time = float("-inf")
        self._saved: Saved | None = None
        self._saved_age: float | None = None
        p = model.parameters
        self._offset_sd = p.sd("pack_current_offset")
        self._offset = p["pack_current_offset"]
        self._gain = p["pack_current_gain"]
        gain_sd = p.sd("pack_current_gain")
        self._voltage_offset = p["pack_voltage_offset"]
        self._own_voltage_sd = self._voltage_sd = p.sd("pack_voltage_offset") / battery.cells_series
        self._model_sd = p.sd("cell_voltage_error")
        self._empty_sd = p.sd("cell_voltage_error_empty")
        self._rest_sd = sqrt(p.sd("rest_voltage_error") ** 2 + battery.ocv_sd**2 + battery.rest_shift_sd**2)
        self._cell_scatter = p.sd("cell_capacity") / p["cell_capacity"]
        self._usual_voltage = battery.ocv(0.5)[0] * battery.cells_series
        self._ocv_span = battery.ocv(1.0)[0] - battery.ocv(0.0)[0]
        self._charge_sd = sqrt(self._cell_scatter**2 + gain_sd**2)
        self._cable = p["cable_resistance"]
        self._radius, self._gear = p["wheel_radius"], p["gear_ratio"] / p["speed_sensor_scale"]
        self.redundancy = Redundancy(self._radius, self._gear, model.mass, self.forecaster.usual_force(), battery)
        self._distrusted: tuple[str, ...] = ()
        self._latency = p["pack_voltage_latency"]
        self._recent: deque[tuple[float, float, float]] = (
            deque()
        )  # s, V, A of the pack; kept if the two are not in step
        self._in_cells = [effect for _, effect in model.cell_voltage]
        self._cell_states = {effect.effect.name: 0.0 for effect in self._in_cells}  # V of a cell
        self._lacking = 0.0  # V, their sum
        self._cell_quantities = dict.fromkeys(QUANTITIES, 0.0)

    # --- events -----------------------------------------------------------------------------------------------

    def handle(self, event: Event) -> None:
        """Take in one event; the pace-setting message (pack voltage and current) also makes a step."""
        time, group, values = event
        gap = time - self._heard[group]
        self._heard[group] = time
        if gap > SLOW_GAP or self._gaps[group]:
            self._watch(group, gap)
            if gap > SLOW_GAP:
                for signal in self._slots[group]:  # no mean with what came before the gap
                    signal.total, signal.count = 0.0, 0
        for signal, value in zip(self._slots[group], values):  # noqa: B905 - hot, equal by construction
            if value is not None:
                signal.value = value
                signal.time = time
                signal.total += value
                signal.count += 1
        if group == self._shaken and (accel_z := values[self._accel_z]) is not None:
            self._shaking.sample(time, accel_z)
        if group == self._pace or time >= self._deadline:
            if self._time is None and group != self._pace and self._deadline < 0:
                self._deadline = time + STEP_AT_LEAST  # the first step too is for the message that sets the pace
                return
            self._step(time)

    def _watch(self, group: int, gap: float) -> None:
        """Learn the real period of a message that comes with long gaps: two alike are no coincidence."""
        before = self._gaps[group]
        if gap <= SLOW_GAP:
            self._fast[group] += 1
            if self._fast[group] < FAST_COUNT:  # it may come in bursts
                return
            self._gaps[group], self._periods[group], stale = 0.0, 0.0, self._stale[group]
        else:
            self._gaps[group], self._fast[group] = gap, 0
            if not before or not 0.5 < gap / before < 2 or gap > LONGEST_STALE:
                return
            self._periods[group] = max(gap, before)
            longest = LONGEST_STALE if group in self._thermal else SLOW_STALE_PERIODS * SLOWEST
            stale = max(self._stale[group], min(SLOW_STALE_PERIODS * self._periods[group], longest))
        for signal in self._slots[group]:
            signal.stale_after = stale

    @property
    def _sampled(self) -> float:
        """The longest real period of pack current and voltage [s]; 0 where they are not slow."""
        return max((self._periods[i] for i in self._integrated), default=0.0)

    @property
    def _pause(self) -> float:
        """A gap that is longer [s] is a pause, in which nobody knows what flowed."""
        period = self._sampled
        return max(PAUSE, PAUSE_PERIODS * period) if period <= SLOWEST else PAUSE

    def _step(self, now: float) -> None:
        dt = 0.0 if self._time is None else now - self._time
        if dt < 0.02 and self._time is not None:
            return
        self._time = now
        self._deadline = now + STEP_AT_LEAST
        signals = self.signals
        elapsed = min(dt, self._pause)
        self.redundancy.step(now, dt, elapsed, signals, self.road.speed)
        self.road.step(now, elapsed, signals, self._radius, self._gear)
        voltage, current, source = self._measured(now, elapsed)
        self._pack = voltage, current, source
        self._hear_slopes(now, elapsed)
        temperature = self._temperature(now, dt)
        self._battery_step(now, dt, voltage, current, source, temperature)
        self._act(now, dt, current, source)
        self._ride(now, dt, voltage, current)
        signals.next_step()
        if now - self._forecast_time >= FORECAST_PERIOD - 0.05:
            self._make_forecast(now, temperature)

    def _measured(self, now: float, dt: float) -> tuple[float | None, float | None, str]:
        """(pack voltage [V], pack current [A], where the current comes from), by the best sensors that work."""
        signals = self.signals
        voltage, inverter_voltage = signals.pack_voltage.told(now), signals.inverter_voltage.told(now)
        current, inverter = signals.pack_current.told(now), signals.inverter_current.told(now)
        any_voltage = voltage if voltage is not None else inverter_voltage
        usual = self.model.parameters["auxiliary_power"] / (any_voltage or self._usual_voltage)
        auxiliary = signals.auxiliary_current.told(now)
        if current is not None:
            current = (current - self._offset) / self._gain
        said = Electric(current, inverter, auxiliary, usual, voltage, inverter_voltage, self.road.speed)
        current, source = self._believed_current(now, dt, said)
        if voltage is not None:
            voltage -= self._voltage_offset
        if inverter_voltage is not None:
            inverter_voltage += self._cable * (current or 0.0)
        said = replace(said, pack_voltage=voltage, inverter_voltage=inverter_voltage)
        together = _together(signals.pack_voltage, signals.inverter_voltage)
        compared = said if together else replace(said, inverter_voltage=None)
        voltages = self.redundancy.voltages
        distrusted = voltages.step(dt, compared, current, self._cell_error)
        for role in voltages.ROLES:
            signals[role].trusted = role not in distrusted
        doubted = bool(voltages.apart or any(voltages.trials[role].guilty for role in voltages.ROLES))
        if doubted and not self._doubted and now - self._started < DOUBTED_START:
            self._saved, self._saved_age = self._started_from
            self._wait_again()
        self._doubted = doubted
        if voltages.apart and voltage is not None and inverter_voltage is not None:
            voltage = (voltage + inverter_voltage) / 2
        elif not signals.pack_voltage.trusted or voltage is None:
            voltage = inverter_voltage if signals.inverter_voltage.trusted else None
        self._voltage_sd = hypot(self._own_voltage_sd, voltages.apart, voltages.spread)
        if current is None and self.road.speed is not None and voltage:
            return voltage, self._model_power(now) / voltage, "model"
        return voltage, current, source

    def _believed_current(self, now: float, dt: float, said: Electric) -> tuple[float | None, str]:
        """(pack current [A], where it comes from): None if no sensor is to be believed."""
        signals, currents = self.signals, self.redundancy.currents
        voltage = said.pack_voltage or said.inverter_voltage

        def by_road() -> float | None:
            known = voltage and self.road.speed is not None and self._sampled <= SLOW_GAP
            return self._model_power(now) / voltage if voltage and known else None

        self._said_current = said.pack if said.pack is not None else said.around
        together = _together(signals.pack_current, signals.inverter_current)
        compared = said if together else replace(said, inverter=None)
        distrusted = currents.step(dt, compared, self._cell_error, by_road, sqrt(self._innovation_square))
        for role in currents.ROLES:
            signals[role].trusted = role not in distrusted
        if not signals.auxiliary_current.trusted:
            said = replace(said, auxiliary=None)
        pack, around = said.pack, said.around
        if pack is not None and around is not None and together and not said.charging:
            self._mismatch += 0.01 * (pack - around - self._mismatch)
        if pack is not None and around is not None and currents.disputed:
            return (pack + around) / 2, "disputed"
        if pack is not None and signals.pack_current.trusted:
            return pack, "pack"
        if around is not None and signals.inverter_current.trusted:
            return around, "inverter"
        return None, "none"

    def _cell_error(self, voltage: float, current: float) -> float | None:
        """Measured less predicted voltage of a cell [V]; None before there is a state of charge."""
        if self.filter is None:
            return None
        cell = self.battery.cell_voltage(voltage, current) + self._lacking
        return self.filter.innovation(cell, current / self.battery.cells_parallel, self._cells())[0]

    def _cells(self) -> float:
        """The cells' last temperature [degC], or that of the bench."""
        return 25.0 if self._cell_temperature is None else self._cell_temperature

    def _hear_slopes(self, now: float, dt: float) -> None:
        road, slopes = self.road, self.redundancy.slopes
        voltage, current, source = self._pack
        power = None if voltage is None or current is None or source == "model" else voltage * current
        before = slopes.guilty
        speeds = self.redundancy.speeds
        slopes.step(
            now,
            dt,
            self.signals,
            speeds,
            power,
            lambda speed, acceleration: self._power_at(now, speed, acceleration, 0.0),
        )
        if slopes.guilty != before:
            road.forget_slope(slopes.offset, self.signals.gps_altitude.fresh(now))
        distrusted = self.redundancy.distrusted
        if any(role in LEARNED_FROM and role not in self._distrusted for role in distrusted):
            self.forecaster.forget(UNLEARNED)
        self._distrusted = distrusted

    def _model_power(self, now: float) -> float:
        road = self.road
        return self._power_at(now, road.speed or 0.0, road.acceleration or 0.0, road.grade or 0.0)

    def _power_at(self, now: float, speed: float, acceleration: float, grade: float) -> float:
        ambient, altitude = self._ambient(now)[0], self.road.altitude or 0.0
        quantities = self.forecaster.quantities(speed, acceleration, ambient, altitude, 40.0)
        quantities["grade"] = grade
        if self.forecaster.extended:
            self.forecaster.add(quantities, self._turn(now), self._ambient(now)[0])
        return float(sum(self.model.power(quantities).values()))

    def _ambient(self, now: float) -> tuple[float, float]:
        """(ambient temperature, sd) [degC]."""
        ambient = self.signals.ambient_temperature.get(now)
        if ambient is not None:
            return ambient, 1.0
        if self._cell_temperature is not None and self.signals.cell_temperature.fresh(now):
            return self._cell_temperature - 3.0, 6.0
        return 20.0, 10.0

    def _temperature(self, now: float, dt: float) -> float:
        """The cells' temperature [degC]: measured; else the last one, drifting to the ambient; else the ambient."""
        measured = self.signals.cell_temperature.get(now)
        if measured is not None:
            self._cell_temperature = measured
            return measured
        ambient = self._ambient(now)[0]
        if self._cell_temperature is None:
            return ambient
        self._cell_temperature += (ambient - self._cell_temperature) * min(dt / 7200.0, 1.0)
        return self._cell_temperature

    # --- battery ----------------------------------------------------------------------------------------------

    def _pause_long(self, gap: float) -> None:
        """So long a silence [s] is a restart: the voltage and what was known before are weighed anew."""
        filter_ = self.filter
        if filter_ is None:
            return
        self._saved = Saved(
            filter_.soc,
            filter_.v1,
            filter_.covariance,
            self._current,
            self._odometer,
            self._own_soc,
            self._forecast.consumption if self._forecast else None,
        )
        self._saved_age = gap
        if self._in_cells:
            self._move_cells(gap, 0.0, filter_.soc, self._cells())
        self._wait_again()

    def _wait_again(self) -> None:
        """Wait for a first voltage once more."""
        self.filter = self._first = self._innovation = None
        self._rest, self._rest_variance = Rest(), inf

    def _battery_step(
        self, now: float, dt: float, voltage: float | None, current: float | None, source: str, temperature: float
    ) -> None:
        battery = self.battery
        if dt > BRIDGE:
            self._pause_long(dt)
        filter_ = self.filter
        if voltage is not None and not self._plausible(voltage, current or 0.0, temperature):
            voltage, self._off_gate = None, self._off_gate + 1
        if filter_ is None:
            if voltage is not None:
                self._await_steady(now, voltage, current or 0.0, temperature)
            self._current = current
            return
        if dt > 0:
            before = self._current if self._current is not None else current
            mean = ((before or 0.0) + (current or 0.0)) / 2
            charge = 3600 * battery.pack_capacity(temperature)
            unchecked = 0.0 if self.signals.inverter_current.fresh(now) else UNCHECKED_CURRENT_SD
            sampled = self._sampled
            counted = source if sampled <= SLOWEST else "none"  # beyond, most of what flows is not seen
            sd = sqrt(self._offset_sd**2 + CURRENT_SD[counted] ** 2 + unchecked**2)
            q = (sd / charge) ** 2 * 2 * CURRENT_TIME[counted] * min(dt, self._pause)
            q += self._charge_sd**2 * abs(mean * dt / charge)
            if sampled > SLOW_GAP:
                q += (SAMPLING_RATE / 3600) ** 2 * dt * sampled
            if dt > self._pause:  # nobody knows what flowed
                # What was taken for it errs the same way each time: the rider goes on as before.
                before_sd, more = min(self._unseen, sqrt(filter_.covariance[0])), unseen_sd(dt)
                q += (2 * before_sd + more) * more
                self._unseen = before_sd + more
                self._rest.interrupt()
                self._rest_variance = inf
            filter_.predict(dt, mean / battery.cells_parallel, temperature, (q, 1e-8 * min(dt, RELAXED)))
            p00, p01, p11 = filter_.covariance
            if p00 > SOC_UNKNOWN_SD**2:
                filter_.covariance = SOC_UNKNOWN_SD**2, p01 * SOC_UNKNOWN_SD / sqrt(p00), p11
            if self._in_cells:
                if self._reads_vibration:
                    self._cell_quantities["vibration"] = self.vibration(now)
                self._cell_quantities["time_moving"] = self.forecaster.riding.time_moving
                self._move_cells(dt, mean / battery.cells_parallel, filter_.soc, temperature)
            filter_.soc = min(max(filter_.soc, SOC_BOUNDS[0]), SOC_BOUNDS[1])
        self._current = current
        self._odometer, self._own_soc = _last(self.signals.odometer), _last(self.signals.bms_state_of_charge)
        if voltage is None or current is None:
            self._innovation = None
            return
        # What was held since the last message is taken in once, with all the time it stands for.
        pack = self.signals.pack_voltage
        heard = pack.time if pack.fresh(now) else self.signals.inverter_voltage.time
        if heard == self._voltage_heard:
            return
        dt = min(now - self._voltage_taken, self._pause) if self._voltage_taken > -inf else dt
        self._voltage_heard, self._voltage_taken = heard, now
        if self._latency and self.signals.pack_voltage.fresh(now):
            pair = self._paired(now, voltage, current)
            if pair is None:
                return
            voltage, current = pair
        # What effects in the cells take is known: the filter sees the voltage that there would be without them.
        cell_voltage = battery.cell_voltage(voltage, current) + self._lacking
        cell_current = current / battery.cells_parallel
        r0 = battery.r0.at(filter_.soc, temperature)[0]
        explaining = current if source in ("pack", "inverter") else self._said_current
        if explaining is not None:
            self.redundancy.currents.sag.hear(dt, cell_voltage, r0 * explaining / battery.cells_parallel)
        if self._rested(dt, cell_voltage, cell_current, temperature):
            return
        resistance_sd = RESISTANCE_SD if self.signals.cell_temperature.fresh(now) else RESISTANCE_SD_COLD
        by_inverter = not self.signals.pack_voltage.fresh(now)
        voltage_sd = INVERTER_VOLTAGE_SD / battery.cells_series if by_inverter else self._voltage_sd
        current_sd = CURRENT_SD[source] / battery.cells_parallel
        empty = min(max((EMPTY_BELOW - filter_.soc) / (EMPTY_BELOW - EMPTY_FROM), 0.0), 1.0)
        model_sd = self._model_sd + empty * (self._empty_sd - self._model_sd)
        # The pack's cells are not the bench's: where SOC lies on their curve is known to their capacity's scatter.
        axis_sd = self._cell_scatter * (1 - filter_.soc) * battery.ocv(filter_.soc)[1]
        resistance = (resistance_sd * r0 * cell_current) ** 2 + (r0 * current_sd) ** 2
        slow = own_slow = model_sd**2 + voltage_sd**2 + axis_sd**2 + resistance
        error, own = filter_.innovation(cell_voltage, cell_current, temperature)
        self._innovation = error
        # A model that errs more than its file says is believed less (Mehra 1970: covariance matching).
        slow = max(slow, self._error_square)
        self._error_square += (error * error - self._error_square) * min(dt / ERROR_TIME, 1.0)
        self._innovation_square += (error * error - self._innovation_square) * min(dt / 10.0, 1.0)
        if error * error > GATE * GATE * (own + own_slow):
            self._contradicted += dt
            if self._contradicted >= CONTRADICTED:
                self._begin_anew(now)
                return
        else:
            self._contradicted = 0.0
        if error * error > GATE * GATE * (own + slow):
            self._off_gate += 1
            if self._off_gate < GATE_COUNT:
                return
        else:
            self._off_gate = 0
        # What errs the same way for ERROR_TIME is worth one sample in that time, not one each step.
        filter_.update(cell_voltage, cell_current, temperature, slow * max(2 * ERROR_TIME / max(dt, 0.02), 1.0))
        filter_.soc = min(max(filter_.soc, SOC_BOUNDS[0]), SOC_BOUNDS[1])

    def _move_cells(self, dt: float, current: float, soc: float, temperature: float) -> None:
        """The effects in the cells, `dt` [s] on at a mean cell current [A]."""
        q, states = self._cell_quantities, self._cell_states
        q["cell_current"], q["soc"], q["cell_temperature"] = current, soc, temperature
        q["cell_capacity"] = self.battery.cell_capacity(temperature)
        for effect in self._in_cells:
            name = effect.effect.name
            states[name] = effect.step(states[name], dt, q)
        self._lacking = sum(states.values())

    def _paired(self, now: float, voltage: float, current: float) -> tuple[float, float] | None:
        """Voltage and current of one time, where the voltage comes later or earlier than the current; None if not yet.

        The one that comes first is kept, and is interpolated.
        """
        recent, then = self._recent, now - abs(self._latency)
        recent.append((now, voltage, current))
        if recent[0][0] > then:
            return None
        while recent[1][0] <= then:
            recent.popleft()
        (t0, v0, i0), (t1, v1, i1) = recent[0], recent[1]
        if t1 - t0 > self._pause:
            return None
        share = (then - t0) / (t1 - t0)
        if self._latency > 0:
            return voltage, i0 + share * (i1 - i0)
        return v0 + share * (v1 - v0), current

    def _plausible(self, voltage: float, current: float, temperature: float) -> bool:
        battery = self.battery
        r0 = battery.r0.at(self.filter.soc if self.filter else 0.5, temperature)[0]
        return plausible(battery, battery.cell_voltage(voltage, current) + r0 * current / battery.cells_parallel)

    def _rested(self, dt: float, voltage: float, current: float, temperature: float) -> bool:
        """Take in the voltage of a rest that is better proven than before; gives whether it did."""
        filter_, battery, rest = self.filter, self.battery, self._rest
        if filter_ is None or dt > self._pause:
            return False
        emf = voltage + battery.r0.at(filter_.soc, temperature)[0] * current
        fast = battery.r1.at(filter_.soc, temperature)[0] * battery.c1.at(filter_.soc, temperature)[0]
        rest.step(dt, voltage, emf, current / battery.cell_capacity(temperature), fast, self._model_sd)
        if rest.sd is None:
            self._rest_variance = inf
            return False
        variance = rest.sd**2 + self._rest_sd**2 + self._voltage_sd**2
        if not rest.fresh or variance > REST_NEWS * self._rest_variance:
            return False
        emf += rest.coming
        soc = battery.soc_at(emf, temperature)
        # Curve and relaxation err the same way at every rest: that does not average out.
        better = REST_BETTER if rest.loaded and self._rest_variance == inf else 1.0
        if better**2 * filter_.covariance[0] < (soc_width(battery, emf, sqrt(variance), temperature) / 2) ** 2:
            return False
        # The same rest again, only better known: what is new is the difference of what both tell.
        new = 1 / (1 / variance - (0.0 if self._rest_variance == inf else 1 / self._rest_variance))
        self._rest_variance = variance
        sd = sqrt(new)
        take_in(filter_, soc, (soc_width(battery, emf, sd, temperature) / 2) ** 2)
        filter_.soc = min(max(filter_.soc, SOC_BOUNDS[0]), SOC_BOUNDS[1])
        return True

    def _begin_anew(self, now: float) -> None:
        """The voltage has contradicted the state of charge for long: begin again from it."""
        self._wait_again()
        self._saved = None
        self._contradicted = self._error_square = self._innovation_square = 0.0
        self._off_gate = 0
        self._restarted_at = now

    def _await_steady(self, now: float, voltage: float, current: float, temperature: float) -> None:
        """Start from the first voltage that holds still, as soon as what comes once a second is known or overdue.

        Riders pull away within a second: the first voltage is the one at rest, what flows meanwhile is counted.
        """
        if self._first is None or now - self._looked > max(2 * START_WAIT, self._pause):  # a pause
            self._first = First(now, voltage, current)
        self._looked = now
        first = self._first
        if first.moving is None and self.road.speed is not None:
            first.moving = abs(self.road.speed) > MOVING
        battery, parallel = self.battery, self.battery.cells_parallel
        r0 = battery.r0.at(0.5, temperature)[0]
        drop = battery.cell_voltage(r0 * battery.cells_series / parallel, 1.0) * abs(current - first.current)
        moved = max(abs(voltage - first.voltage) / battery.cells_series - STEADY_DROP * drop, 0.0)  # by no load
        self._waited = min(self._waited, now)
        late = now - self._waited >= STEADY_WAIT
        if moved > STEADY_SHARE * self._ocv_span and not late:
            self._first, self._unsteady = First(now, voltage, current), True
            return
        awaited = [self.signals.cell_temperature]
        if self._saved:
            awaited += [self.signals.odometer, self.signals.bms_state_of_charge]
        missing = any(signal.stale_after and not signal.fresh(now) for signal in awaited)
        least = STEADY_AFTER if self._unsteady else START_WAIT if missing else STEADY_TIME
        if now - first.time < least and not late:
            return
        self._start(now, first, temperature, self._ocv_span if late else STEADY_SD * moved)
        self._waited, self._unsteady = inf, False
        if self.filter:
            mean = (first.current + current) / 2 / parallel
            self.filter.predict(now - first.time, mean, temperature, (1e-9, 1e-7))

    def _start(self, now: float, first: First, temperature: float, unsteady: float) -> None:
        """The first SOC: from the voltage, and from what was saved before, each with what is not known about it.

        unsteady: sd of a cell's voltage [V] from its movement meanwhile.
        """
        battery, voltage, current = self.battery, first.voltage, first.current
        cell_current = current / battery.cells_parallel
        cell_voltage = battery.cell_voltage(voltage, current) + self._lacking  # of before a restart
        soc, _ = from_voltage(battery, cell_voltage, cell_current, temperature, 0.0, 0.01, 0.01)
        r0, r1 = battery.r0.at(soc, temperature)[0], battery.r1.at(soc, temperature)[0]
        # The polarisation of a ride that was not seen: at once if the vehicle rides, perhaps if it stands.
        power, _ = self.forecaster.prior_ride(self._ambient(now)[0], self.road.altitude or 0.0)
        v1_sd = r1 * power / voltage / battery.cells_parallel
        capacity = battery.pack_capacity(temperature)
        loaded = abs(current) > (REST_RATE if first.moving is None else PULLING_RATE) * capacity or bool(first.moving)
        v1, v1_sd = (v1_sd, v1_sd) if loaded else (0.0, STOPPED_SHARE * v1_sd)
        drop_sd, model_sd = RESISTANCE_SD * r0 * cell_current, self._model_sd if loaded else 0.0
        voltage_sd = hypot(self._rest_sd, self._voltage_sd, drop_sd, model_sd, unsteady)
        saved, age = self._saved, self._saved_age
        self._saved, self._started, self._started_from = None, now, (saved, age)
        drawn = None
        if saved:
            own = self.signals.bms_state_of_charge.get(now), self.signals.odometer.get(now)
            drawn = flowed(saved, age, capacity, voltage, current, own[1], own[0])
            if not loaded:
                v1_sd *= 1 - parked(saved, age, own[1], own[0])
            if age is not None and age < RELAXED:
                decay = exp(-age / (r1 * battery.c1.at(soc, temperature)[0]))
                v1 += (saved.v1 - v1) * decay
                v1_sd = sqrt(saved.covariance[2] * decay**2 + v1_sd**2 * (1 - decay**2))
            # The cell model errs the same way for ERROR_TIME: after a shorter gap the voltage says nothing new.
            if age is not None:
                voltage_sd *= sqrt(max(2 * ERROR_TIME / max(age, 0.1), 1.0))
        soc, covariance = from_voltage(battery, cell_voltage, cell_current, temperature, v1, v1_sd, voltage_sd)
        filter_ = self._make(battery, soc, v1, covariance)
        if saved and drawn:
            before, variance = saved.soc - drawn[0], saved.covariance[0] + drawn[1] ** 2
            apart = (before - soc) ** 2
            if apart > CONFLICT**2 * (variance + covariance[0]):  # nobody knows which of the two is wrong
                variance += apart
                filter_.covariance = covariance[0] + apart, covariance[1], covariance[2]
            take_in(filter_, before, variance)
        filter_.soc = min(max(filter_.soc, SOC_BOUNDS[0]), SOC_BOUNDS[1])
        self.filter = filter_

    # --- riding and range -------------------------------------------------------------------------------------

    def _act(self, now: float, dt: float, current: float | None, source: str) -> None:
        """Follow what the vehicle does."""
        signals = self.signals
        known = current if source in ("pack", "inverter") else None
        rate = None if known is None else known / self.battery.pack_capacity(self._cells())
        inverter = (signals.inverter_current, signals.inverter_voltage, signals.motor_speed)
        mapped = [signal for signal in inverter if signal.stale_after]
        silent = bool(mapped) and not any(signal.fresh(now) for signal in mapped)
        self._activities.step(dt, self.road.speed, rate, signals.charge_plug.get(now), silent)

    def _ride(self, now: float, dt: float, voltage: float | None, current: float | None) -> None:
        speed = self.road.speed
        unsure = self._pack[2] in ("model", "disputed") or self.redundancy.speeds.unsettled
        known = 0 < dt <= self._pause and not unsure and self._activities.teaches
        if speed is None or voltage is None or current is None or not known:
            self.forecaster.pause()
            return
        motor = self.signals.motor_temperature.get(now)
        learned = self.forecaster.ride(
            dt,
            speed,
            self.road.grade,
            voltage * current,
            self._ambient(now)[0],
            self.road.altitude or 0.0,
            40.0 if motor is None else motor,
            self._turn(now) if self.forecaster.extended else None,
            max(self._periods[i] for i in self._speeds) if self._speeds else 0.0,
        )
        if learned and self.signals.cell_temperature.fresh(now):  # R0 is known only with it
            self.redundancy.currents.weigh(self.forecaster.recent_factor)

    def _turn(self, now: float) -> Turn:
        """What effects beyond the base's may read while riding."""
        road, filter_ = self.road, self.filter
        lateral = None if road.yaw_rate is None or road.speed is None else road.speed * road.yaw_rate
        cells = (filter_.soc if filter_ else 0.5, self._cells(), self._current or 0.0)
        return Turn(lateral, road.heading, *cells, self._shaking.value(now) if self._reads_vibration else None)

    def vibration(self, now: float) -> float:
        """What effects read as ``vibration`` [m/s²]: the typical value while it is not known."""
        value = self._shaking.value(now)
        return self.forecaster.typical_vibration(self.road.speed or 0.0) if value is None else value

    def _make_forecast(self, now: float, temperature: float) -> None:
        filter_ = self.filter
        if filter_ is None:
            return
        self._forecast_time = now
        reasons = self._reasons(now)
        soc_sd = sqrt(filter_.covariance[0])
        temperature_sd = 1.0 if self.signals.cell_temperature.fresh(now) else 8.0
        self._forecast = self.forecaster.forecast(
            filter_.soc,
            soc_sd,
            temperature,
            temperature_sd,
            self._ambient(now)[0],
            self.road.altitude or 0.0,
            sum(sd * sd for reason, sd in LOSS_SD.items() if reason & reasons),
        )

    # --- results ----------------------------------------------------------------------------------------------

    def estimate(self, now: float) -> Estimate:
        """What is known at `now` [s]; cheap, and changes nothing."""
        estimate = Estimate(time=now, reasons=self._reasons(now), distrusted=self._distrusted)
        road, filter_, forecast = self.road, self.filter, self._forecast
        estimate.distance = road.distance
        estimate.activity = Activity.UNKNOWN if self._time is None else self._activities.now
        silent = self._time is None or now - self._time > max(2.0, self._pause)
        if not silent:
            estimate.speed, estimate.acceleration, estimate.grade = road.speed, road.acceleration, road.grade
            estimate.lean, estimate.yaw_rate, estimate.heading = road.lean, road.yaw_rate, road.heading
            estimate.pack_voltage, estimate.pack_current = self._pack[0], self._pack[1]
            estimate.innovation = self._innovation
        estimate.cell_temperature = self._cell_temperature
        if filter_ is None:
            estimate.state = State.INVALID if now > 10 else State.STARTING
            return estimate
        estimate.soc = min(max(filter_.soc, 0.0), 1.0)
        estimate.soc_sd = sqrt(filter_.covariance[0])
        estimate.v1 = filter_.v1
        estimate.innovation_rms = sqrt(self._innovation_square)
        if estimate.soc_sd > 0.05:
            estimate.reasons |= Reason.SOC_UNCERTAIN
        if forecast:
            estimate.range, estimate.range_p10, estimate.range_p90 = forecast.range, forecast.p10, forecast.p90
            estimate.energy_left, estimate.energy_left_sd = forecast.energy, forecast.energy_sd
            estimate.consumption_expected, estimate.consumption_expected_sd = (
                forecast.consumption,
                forecast.consumption_sd,
            )
            estimate.consumption_recent = forecast.recent
            riding = self.forecaster.riding
            estimate.consumption_factor = riding.factor
            estimate.consumption_factor_sd = sqrt(riding.factor_variance)
            if forecast.mostly_prior:
                estimate.reasons |= Reason.PRIOR_RIDING
        estimate.state = State.DEGRADED if estimate.reasons & WEIGHTY else State.VALID
        if (silent and estimate.reasons & NO_PACK == NO_PACK) or estimate.reasons & Reason.SIGNALS_SLOW:
            estimate.state = State.INVALID
        return estimate

    def _reasons(self, now: float) -> Reason:
        s = self.signals
        reasons = Reason(0)
        if not s.pack_voltage.fresh(now):
            reasons |= Reason.NO_PACK_VOLTAGE
        if not s.pack_current.fresh(now):
            reasons |= Reason.NO_PACK_CURRENT
        if not s.inverter_current.fresh(now):
            reasons |= Reason.NO_INVERTER_CURRENT
        if not s.cell_temperature.fresh(now):
            reasons |= Reason.NO_CELL_TEMPERATURE
        if not s.ambient_temperature.fresh(now):
            reasons |= Reason.NO_AMBIENT_TEMPERATURE
        speeds = s.motor_speed, s.wheel_speed_rear, s.wheel_speed_front, s.vehicle_speed, s.gps_speed
        if not any(signal.fresh(now) for signal in speeds):
            reasons |= Reason.NO_SPEED
        if not (s.rate_x.fresh(now) and s.rate_z.fresh(now) and s.accel_x.fresh(now)):
            reasons |= Reason.NO_IMU
        if lost(now, s) or not (s.gps_speed.fresh(now) or s.latitude.fresh(now)):
            reasons |= Reason.NO_GPS
        if abs(self._mismatch) > MISMATCH:
            reasons |= Reason.CURRENT_MISMATCH
        differ = self.redundancy.voltages.apart or not (s.pack_voltage.trusted and s.inverter_voltage.trusted)
        if differ or self._off_gate or self._innovation_square > 0.08**2:
            reasons |= Reason.VOLTAGE_MISMATCH
        if self._sampled > SLOWEST:
            reasons |= Reason.SIGNALS_SLOW
        if now - self._restarted_at < RESTARTED_FOR:
            reasons |= Reason.SOC_RESTARTED
        if self._distrusted:
            reasons |= Reason.SENSOR_DISTRUSTED
        return reasons

    # --- saving -----------------------------------------------------------------------------------------------

    def snapshot(self, key: str) -> dict[str, Any] | None:
        """What is to be kept over a restart, for the vehicle `key`; None while there is nothing to keep."""
        if self.filter is None:
            return None
        return {
            "version": SNAPSHOT_VERSION,
            "key": key,
            "soc": self.filter.soc,
            "v1": self.filter.v1,
            "covariance": list(self.filter.covariance),
            "current": self._current,
            "odometer": _last(self.signals.odometer),
            "own_soc": _last(self.signals.bms_state_of_charge),
            "consumption": self._forecast.consumption if self._forecast else None,
            "cell_temperature": self._cell_temperature,
            "cell_effects": dict(self._cell_states),
            "gyro_bias": [self.road.bias_x, self.road.bias_z],
            "riding": self.forecaster.snapshot(),
        }

    def wait(self, seconds: float) -> None:
        """So much time has passed [s] in which no voltage came to go on with: what was restored is older by that."""
        if self._saved and self._saved_age is not None:
            self._saved_age += seconds

    def restore(self, saved: Mapping[str, Any], key: str, age: float | None) -> None:
        """Go on from a snapshot that is `age` [s] old (None: not known). ValueError if it does not fit, whole."""
        if age is not None and not 0 <= age < inf:
            age = None
        if not isinstance(saved, Mapping) or saved.get("version") != SNAPSHOT_VERSION:
            raise ValueError(f"is of version {saved.get('version') if isinstance(saved, Mapping) else saved!r}")
        if saved.get("key") != key:
            raise ValueError(f"is of {saved.get('key')!r}, this is {key!r}")
        try:
            soc, v1 = float(saved["soc"]), float(saved["v1"])
            p00, p01, p11 = (float(x) for x in saved["covariance"])
            bias_x, bias_z = (float(x) for x in saved["gyro_bias"])
            if not (
                abs(bias_x) < MOST_BIAS
                and abs(bias_z) < MOST_BIAS
                and -0.1 < soc < 1.1
                and abs(v1) < 1
                and 0 < p00 < 1
                and 0 < p11 < 1
                and p01 * p01 <= p00 * p11
            ):
                raise ValueError("holds implausible numbers")
            extra = {name: _optional(saved[name], most) for name, most in SAVED_MOST.items()}
            states = {name: float(saved["cell_effects"][name]) for name in self._cell_states}
            if not all(abs(x) < 1 for x in states.values()):
                raise ValueError("holds implausible voltages of effects in the cells")
            self.forecaster.restore(saved["riding"])
        except (KeyError, TypeError, AttributeError, OverflowError) as error:
            raise ValueError(f"is damaged: {error!r}") from error
        self.road.bias_x, self.road.bias_z = bias_x, bias_z
        cells = saved.get("cell_temperature")
        if isinstance(cells, int | float) and -50 < cells < 120 and age is not None and age < 3600:
            self._cell_temperature = float(cells)
        self._saved = Saved(soc, v1, (p00, p01, p11), **extra)
        self._saved_age = age
        if states:  # at rest meanwhile; for how long if that is not known: for long
            self._cell_states = states
            self._move_cells(1e9 if age is None else age, 0.0, soc, 20.0)


def _together(first: Signal, second: Signal) -> bool:
    """Whether two of which both speak do so at the same time; or one of them is silent."""
    return isinf(first.time + second.time) or abs(first.time - second.time) <= SLOW_GAP


def _last(signal: Signal) -> float | None:
    """The last value that ever came."""
    return signal.value if signal.time > -inf else None


def _optional(value: object, most: float) -> float | None:
    """A saved number, in size at most `most`, or None. ValueError, TypeError if it is neither."""
    if value is None:
        return None
    number = float(value)  # type: ignore[arg-type]
    if not abs(number) <= most:
        raise ValueError("holds implausible numbers")
    return number
