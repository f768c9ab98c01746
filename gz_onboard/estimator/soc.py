"""The state of charge: first wait for a voltage, then count charge and take in voltages; begin anew if refuted."""

from __future__ import annotations

from math import inf, sqrt
from typing import Protocol

from gz_onboard.constants import HOUR
from gz_onboard.estimator.ageing import Ageing
from gz_onboard.estimator.cell_effects import CellEffects
from gz_onboard.estimator.ekf import FilterMaker, Noise, SocFilter
from gz_onboard.estimator.gate import InnovationGate
from gz_onboard.estimator.initial import (
    DOUBT_WAIT,
    DROP_FACTOR,
    START_WAIT,
    STEADY_TIME,
    Situation,
    SteadyVoltage,
    first_filter,
)
from gz_onboard.estimator.plausibility.residual import ResponseGain
from gz_onboard.estimator.rest import RestUpdate
from gz_onboard.estimator.signals import TIMING, Signals
from gz_onboard.estimator.sources import CurrentSource, PackReading, PackState, Synchroniser
from gz_onboard.estimator.start import (
    BRIDGE,
    SOC_UNKNOWN_SD,
    Saved,
    bounded,
    limit_soc_variance,
    plausible,
    uncounted_sd,
)
from gz_onboard.estimator.uncertainty import CURRENT_ERRORS, INVERTER_VOLTAGE_SD, ChargeUncertainty, VoltageUncertainty
from gz_onboard.events import WINDOW
from gz_onboard.physics.battery import HALF_FULL, Battery
from gz_onboard.physics.model import STOOD, Model, standing_load

DOUBTED_START = 30.0  # s: a voltage that is doubted so soon has misled the first state of charge
RESTARTED_FOR = 600.0  # s: for so long it is reported
JOINED = 900.0  # s: how long ago a ride began that is joined under way, for all that is known
STEADY_NOISE = 1e-9  # variance of SOC from the first voltage to the end of the wait
ZERO_FOR = 60.0  # s: a current that reads exactly 0 for longer may be any small one
SHORTEST = 0.02  # s: a step, to divide by


class RidingModel(Protocol):
    """What of the vehicle beside its pack the state of charge depends on; times in s."""

    def power_of_prior(self, now: float) -> float:
        """Of the prior riding [W]."""

    def cell_inputs(self, now: float) -> dict[str, float]:
        """What effects in the cells read beside the cells' own."""


class StateOfCharge:
    """The filter of one pack, and what it is begun from."""

    def __init__(self, battery: Battery, model: Model, make: FilterMaker, signals: Signals, sag: ResponseGain) -> None:
        self.filter: SocFilter | None = None
        self.gate = InnovationGate()
        self.ageing = Ageing(battery)
        self.effects = CellEffects(model, battery)
        self.uncertainty = VoltageUncertainty(battery, model.parameters)
        self.synchroniser = Synchroniser(model.parameters["pack_voltage_latency"])
        self.saved: Saved | None = None
        self.saved_age: float | None = None  # s
        self.current: float | None = None  # A of the pack, at the last step
        self._unseen = STOOD  # s: for so long, and not longer, its load was not seen
        self._battery, self._make, self._signals = battery, make, signals
        self._sag = sag
        self._resistance_sd = self.uncertainty.resistance
        self._charge = ChargeUncertainty(battery, model.parameters)
        self._auxiliary_power = model.parameters["auxiliary_power"]
        self._steady = SteadyVoltage(battery)
        self._rest = RestUpdate(battery, self.uncertainty, self.effects)
        # At the last step, with what was ridden and drawn since it came last:
        self._odometer: float | None = None  # m
        self._own_soc: float | None = None  # the vehicle's own state of charge
        self._started = -inf  # s: when there was a first state of charge,
        self._started_from: tuple[Saved | None, float | None] = (None, None)  # and what it was made from, how old
        self._doubted = False  # a voltage
        self._restarted_at, self._joined = -inf, False  # s
        self._step_noise: Noise | None = None  # of the last step
        self._gap: tuple[float, Saved] | None = None  # when the pack was last measured [s], and what was known then
        self._voltage_time: float | None = None  # s, of the message whose voltage was taken in last
        self._voltage_taken = -inf  # s: when
        self._zero_time = 0.0  # s for which the current has read 0
        self._v1_lag = 0.0  # V: mean of V1 over the last window less V1 at its end, as voltages are means
        self.another_pack = False  # whether this step has shown it to be another than it was

    # --- what others ask --------------------------------------------------------------------------------------

    @property
    def rest_voltage(self) -> float:
        """Of the pack at this state of charge [V]."""
        soc = self.filter.soc if self.filter else HALF_FULL
        return self._battery.ocv(soc)[0] * self._battery.cells_series

    def cell_error(self, now: float, shown: tuple[float, float], sensor: str, temperature: float) -> float | None:
        """Measured less predicted voltage of a cell [V] for those of the pack; None before there is a filter.

        shown: voltage [V] and current [A] of the pack; sensor: whose current it is, see `CellEffects.supposed`.
        """
        if self.filter is None:
            return None
        voltage, current = shown
        cell_current = current / self._battery.cells_parallel
        cell = self._battery.cell_voltage(voltage, current)
        if self.effects:
            cell += self.effects.supposed(sensor, now, cell_current)
        return self.filter.innovation(cell, cell_current, temperature)[0]

    def heat(self, temperature: float) -> float:
        """Of the pack [W] at the last step's current and `temperature` [degC]; 0 before there is a filter."""
        filter_ = self.filter
        if filter_ is None or not self.current:
            return 0.0
        return self._battery.pack_heat(self.current, filter_.soc, temperature, filter_.v1 + self.effects.overpotential)

    @property
    def joined(self) -> bool:
        """Whether it was begun on the move, from nothing saved, and no rest has shown it yet."""
        return self._joined and not self._rest.shown

    def restarted(self, now: float) -> bool:
        """Whether it was begun anew a short while ago."""
        return now - self._restarted_at < RESTARTED_FOR

    def doubt(self, now: float, doubted: bool) -> None:
        """A voltage that is doubted for the first time, and soon after the start, has misled it: begin again."""
        if doubted and not self._doubted and now - self._started < DOUBTED_START:
            self.saved, self.saved_age = self._started_from
            self._wait_again()
            self.ageing.part()
        self._doubted = doubted

    def follow_gap(self, now: float, dt: float, reading: PackReading, temperature: float, price: float | None) -> None:
        """After a gap as long as a restart's the voltage and what was known before it are weighed anew.

        A gap of all messages, or of the pack's: it may have been charged meanwhile. dt: of this step [s]; temperature:
        of the cells [degC]; price: the consumption that is expected [J/m].
        """
        filter_, blind = self.filter, reading.unmeasured
        if filter_ is None:
            self._gap = None
            return
        if self._gap is None and (blind or dt > BRIDGE):
            known = self.current, self._odometer, self._own_soc, price
            self._gap = now - dt, Saved(filter_.soc, filter_.v1, filter_.covariance, *known)
        if self._gap is None or (blind and dt <= BRIDGE):
            return
        began, saved = self._gap
        self._gap = None
        if now - began > BRIDGE:
            self.saved, self.saved_age, self._unseen = saved, now - began, STOOD
            if self.effects and dt > BRIDGE:
                self.effects.step(dt, 0.0, filter_.soc, temperature)
            self._wait_again()

    def _wait_again(self) -> None:
        self.filter = self.gate.innovation = None
        self._steady.forget()
        self._rest = RestUpdate(self._battery, self.uncertainty, self.effects)

    def wait(self, seconds: float) -> None:
        """So much time has passed [s] in which no voltage came: what was restored is older by that."""
        if self.saved and self.saved_age is not None:
            self.saved_age += seconds
            self._unseen = min(self._unseen + seconds, STOOD)
            self.effects.rest(seconds, self.saved.soc)

    def snapshot(self, filter_: SocFilter) -> dict[str, object]:
        """What is to be kept over a restart."""
        return {
            "soc": min(max(filter_.soc, 0.0), 1.0),
            "v1": filter_.v1,
            "covariance": list(filter_.covariance),
            "current": self.current,
            "odometer": self._odometer,
            "own_soc": self._own_soc,
            "cell_effects": dict(self.effects.states),
        }

    def restore(self, saved: Saved | None, age: float | None, effects: dict[str, float]) -> None:
        """Go on from what is `age` [s] old, if anything; effects: their states [V of a cell]."""
        self.saved, self.saved_age = saved, age
        if saved:
            self._signals.resume({"odometer": saved.odometer, "bms_state_of_charge": saved.own_soc})
        self._unseen = STOOD if saved is None or age is None else min(age, STOOD)
        self.effects.restore(effects, age, saved.soc if saved else 0.0)

    # --- step by step -----------------------------------------------------------------------------------------

    def step(self, now: float, dt: float, pack: PackState, riding: RidingModel) -> None:
        """Go `dt` [s] ahead to `now` [s]."""
        self.another_pack = False
        reading, filter_ = pack.reading, self.filter
        voltage, current = reading.voltage, reading.current
        if voltage is not None and not self._plausible(voltage, current or 0.0, pack.temperature):
            voltage = None
            self.gate.off += 1
        if filter_ is None:
            if voltage is not None:
                self._await_steady(now, voltage, current or 0.0, pack, riding)
            self.current = current
            return
        if dt > 0:
            self._predict(filter_, now, dt, pack, riding)
        self.current = current
        self._track_self_reported(now, dt, pack.speed)
        if voltage is None or current is None:
            self.gate.innovation = None
            return
        # What was held since the last message is used once, for all the time since.
        shown = self._signals.pack_voltage
        received = shown.time if shown.fresh(now) else self._signals.inverter_voltage.time
        if received == self._voltage_time:
            return
        pause = self._signals.pause
        dt = min(now - self._voltage_taken, pause) if self._voltage_taken > -inf else dt
        self._voltage_time, self._voltage_taken = received, now
        if self.synchroniser.latency and shown.fresh(now):
            pair = self.synchroniser.pair(now, voltage, current, pause)
            if pair is None:
                return
            voltage, current = pair
        self._update(filter_, now, dt, (voltage, current), pack)

    def _track_self_reported(self, now: float, dt: float, speed: float | None) -> None:
        own_soc, odometer = self._signals.bms_state_of_charge, self._signals.odometer
        if own_soc.fresh(now):
            self._own_soc = own_soc.value
        if odometer.fresh(now):
            self._odometer = odometer.value
        elif self._odometer is not None:
            self._odometer += abs(speed or 0.0) * dt

    def _predict(self, filter_: SocFilter, now: float, dt: float, pack: PackState, riding: RidingModel) -> None:
        """Count the charge of `dt` [s] up to `now` [s]."""
        battery, temperature, current = self._battery, pack.temperature, pack.reading.current
        mean = current or 0.0  # over the window
        if dt > self._signals.pause:  # of what flowed meanwhile only the ends are known
            mean = (mean + (self.current if self.current is not None else mean)) / 2
        charge = HOUR * battery.pack_capacity(temperature)
        sampled, pause = self._signals.sampled, self._signals.pause
        # Beyond, most that flows is not seen.
        counted = pack.reading.source if sampled <= TIMING.slowest else CurrentSource.NONE
        error, apart = CURRENT_ERRORS[counted], pack.reading.current_apart
        q = self._charge.counted(min(dt, pause), mean * dt / charge, charge, error, apart)
        q += self._charge.between_samples(dt, sampled)
        if dt > pause or (counted is CurrentSource.NONE and pack.reading.unmeasured):
            q += self._charge.uncounted(uncounted_sd(dt), sqrt(filter_.covariance[0]))
            self._rest.interrupt()
        elif self._reads_zero(now, dt, pack.reading):
            load = self._auxiliary_power / (pack.reading.voltage or self.rest_voltage)
            q += self._charge.uncounted(load * dt / charge, sqrt(filter_.covariance[0]))
        if self._own_soc is not None:
            self._own_soc -= mean * dt / charge
        before, v1 = filter_.covariance, filter_.v1
        filter_.predict(dt, mean / battery.cells_parallel, temperature, self._noise(q, filter_, temperature))
        self._v1_lag = (v1 - filter_.v1) / 2 if dt <= 2 * WINDOW else 0.0
        self.ageing.count(filter_, before, mean * dt / charge)
        if filter_.covariance[0] > SOC_UNKNOWN_SD**2:
            filter_.covariance = limit_soc_variance(filter_.covariance)
        if self.effects:
            self.effects.step(dt, mean / battery.cells_parallel, filter_.soc, temperature, riding.cell_inputs(now))
        filter_.soc = bounded(filter_.soc)

    def _reads_zero(self, now: float, dt: float, reading: PackReading) -> bool:
        """Whether the current has read exactly 0 for long: many sensors show small currents, as of what is on, so."""
        nothing = reading.source is CurrentSource.PACK and self._signals.pack_current.value == 0.0
        self._zero_time = self._zero_time + dt if nothing and self._signals.contactor.get(now) != 0 else 0.0
        return self._zero_time > ZERO_FOR

    def _noise(self, counted: float, filter_: SocFilter, temperature: float) -> Noise:
        """`counted`: variance of SOC."""
        self._step_noise = Noise(counted, *self.uncertainty.slow(filter_.soc, temperature, filter_.covariance[0]))
        return self._step_noise

    def _update(self, filter_: SocFilter, now: float, dt: float, measured: tuple[float, float], at: PackState) -> None:
        """Update with the voltage [V] at a current [A], both of the pack, that represents `dt` [s]."""
        battery, reading, temperature = self._battery, at.reading, at.temperature
        voltage, current = measured
        # What effects in the cells take is known: the filter sees the voltage that there would be without them.
        shown = battery.cell_voltage(voltage, current)
        cell_voltage = shown + self.effects.mean_overpotential + self._v1_lag
        cell_current = current / battery.cells_parallel
        r0 = battery.r0.at(filter_.soc, temperature)[0]
        drop = r0 * cell_current + self.effects.overpotential
        explaining: float | None = current
        lost = self.effects.overpotential
        if reading.source not in (CurrentSource.PACK, CurrentSource.INVERTER):
            explaining = reading.reported_current
            if explaining is not None and self.effects:
                lost = self.effects.supposed("reported", now, explaining / battery.cells_parallel)
        if explaining is not None:
            # Both with what lies beside the cells: of a pack of which little is known, r0 may hold it already.
            cell, beside = explaining / battery.cells_parallel, battery.series_resistance / battery.cells_series
            self._sag.update(dt, r0 * cell + beside * explaining + lost, -voltage / battery.cells_series)
        before = filter_.soc, filter_.error, filter_.covariance
        self.another_pack = self.ageing.permit(now, reading, self._signals, filter_)
        if dt <= self._signals.pause and self._rest.step(
            filter_, dt, shown, cell_current, temperature, reading.voltage_sd
        ):
            self.ageing.corrected(filter_, before)
            return
        by_inverter = not self._signals.pack_voltage.fresh(now)
        voltage_sd = INVERTER_VOLTAGE_SD if by_inverter else reading.voltage_sd
        known = self._signals.cell_temperature.fresh(now)
        noise = self._step_noise or self._noise(0.0, filter_, temperature)
        load = self.uncertainty.load(r0, (drop, filter_.v1), reading.source, known, voltage_sd)
        error, own = filter_.innovation(cell_voltage, cell_current, temperature)
        slope = battery.ocv(filter_.soc, temperature)[1]
        variance = self.gate.update(dt, *self.ageing.as_believed(error, own, slope), noise.error, load)
        if self.gate.refuted:
            self._refute(now, filter_, error, drop + filter_.v1)
        elif variance is not None and self.uncertainty.tells_more(filter_.soc, filter_.covariance[0]):
            # What errs the same way for a time counts as one sample in that time, not one each step.
            variance *= max(2 * noise.time / max(dt, SHORTEST), 1.0)
            filter_.update(cell_voltage, cell_current, temperature, variance)
            filter_.soc = bounded(filter_.soc)
            self.ageing.corrected(filter_, before)
        if self.filter and self.gate.contradicted and not self.gate.off and self.ageing.doubt(filter_):
            self.gate.settle()
        if not self.gate.off:
            self.ageing.load(min(dt, self._signals.pause), drop + filter_.v1, error)
        if self.ageing.apply(dt):
            self.uncertainty.resistance = max(self._resistance_sd, self.ageing.resistance.sd)

    def _plausible(self, voltage: float, current: float, temperature: float) -> bool:
        battery = self._battery
        r0 = battery.r0.at(self.filter.soc if self.filter else HALF_FULL, temperature)[0]
        drop = r0 * current / battery.cells_parallel + self.effects.overpotential
        return plausible(battery, battery.cell_voltage(voltage, current) + drop)

    def _refute(self, now: float, filter_: SocFilter, error: float, drop: float) -> None:
        """The voltage of a cell has been off by `error` [V] for long, at a predicted `drop` by its load [V].

        Where tables that are wrong for these cells explain it, as in the cold, a loaded voltage proves nothing: the
        state of charge is as uncertain as it is contradicted until a rest. Else it is begun from the voltage.
        """
        if abs(error) < DROP_FACTOR * abs(drop):
            emf = self._battery.ocv(filter_.soc)[0]
            apart = self._battery.soc_at(emf + error) - filter_.soc
            p00, p01, p11 = filter_.covariance
            filter_.covariance = min(p00 + apart**2, SOC_UNKNOWN_SD**2), p01, p11
            self.gate.blame_both()
            return
        self._wait_again()
        self.ageing.part()
        self.gate = InnovationGate()
        self.saved = None
        self._restarted_at = now

    def _await_steady(self, now: float, voltage: float, current: float, pack: PackState, riding: RidingModel) -> None:
        """Start from the first voltage [V] that holds still, at a current [A]."""
        awaited = [self._signals.cell_temperature]
        if self.saved:
            awaited += [self._signals.odometer, self._signals.bms_state_of_charge]
        missing = any(signal.stale_after and not signal.fresh(now) for signal in awaited)
        least = DOUBT_WAIT if self.saved and self._signals.has_rejected else START_WAIT if missing else STEADY_TIME
        battery = self._battery
        found = self._steady.step(now, voltage, current, pack.temperature, pack.speed, self._signals.pause, least)
        if found is None:
            return
        first, unsteady_sd = found
        if self.effects and self._unseen:
            load = first.current
            if first.moving and not self.saved:
                ridden = riding.power_of_prior(now) / first.voltage / battery.cells_parallel
                self.effects.step(JOINED, ridden, HALF_FULL, pack.temperature)
            elif not first.moving:
                load = standing_load(load, first.voltage, self._auxiliary_power)
            self.effects.step(self._unseen, load / battery.cells_parallel, HALF_FULL, pack.temperature)
            self._unseen = 0.0
        at = Situation(
            now,
            pack.temperature,
            self.effects.overpotential,
            riding.power_of_prior(now),
            pack.reading.voltage_sd,
            unsteady_sd,
        )
        restored = self.saved, self.saved_age
        self._joined = bool(first.moving) and not self.saved
        self.saved, self._started, self._started_from = None, now, restored
        self.filter, counted = first_filter(battery, self._make, self.uncertainty, first, at, self._signals, restored)
        self.ageing.resume(self.filter, counted)
        mean = (first.current + current) / 2 / battery.cells_parallel
        noise = self._noise(STEADY_NOISE, self.filter, pack.temperature)
        self.filter.predict(now - first.time, mean, pack.temperature, noise)
