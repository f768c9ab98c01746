"""The pack's state of charge and age over time: the battery filter with its memory, step by step.

One state exists from the start: that of any pack, or the saved one. The first voltage that holds still conditions it
(`battery_priors.first_state`); from then on each window predicts it with the charge counted and conditions it on the
voltage, or on the state of charge that a rest shows. After a long gap, and where a lasting contradiction makes
"start again from the voltage" far more likely than "as believed", it waits for such a first voltage again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import exp, inf, sqrt
from typing import Any

from gz_onboard.constants import BENCH_TEMPERATURE, HOUR
from gz_onboard.estimator import pack_age, weakest
from gz_onboard.estimator.battery_filter import Backend, FilterState, Noise, log_likelihood
from gz_onboard.estimator.battery_priors import (
    PRIOR,
    ChargeNoise,
    First,
    Past,
    VoltageNoise,
    bounded,
    first_state,
    soc_width,
    uncounted_sd,
)
from gz_onboard.estimator.cells import LARGEST, Cell, CellEffects
from gz_onboard.estimator.pack_age import AGE, LearnedFactor, PackAge
from gz_onboard.estimator.plausibility.electrical import CurrentSource, PackReading
from gz_onboard.estimator.plausibility.residual import ResponseGain
from gz_onboard.estimator.rest import RestDetector
from gz_onboard.estimator.saved_state import Each, Number
from gz_onboard.estimator.signals import TIMING, Signals
from gz_onboard.estimator.weakest import WeakestGroup
from gz_onboard.events import WINDOW
from gz_onboard.model.battery import HALF_FULL, Battery, Health
from gz_onboard.model.effect import MOVING
from gz_onboard.model.model import STOOD, Model, standing_load


@dataclass(frozen=True)
class PackConfig:
    """Constants of the pack's steps."""

    # The first voltage
    steady_s: float = 0.5  # for which it must hold still; that of an inverter being charged does not
    steady_share: float = 0.02  # of the span of the rest voltage: no unloaded cell moves by more meanwhile
    resettled_s: float = 10.0  # for which it must hold still once it was seen to move
    longest_wait_s: float = 60.0  # then the filter starts with whatever there is, knowing nothing
    steady_sd: float = 4.0  # of the movement: how much may be to come
    slow_signals_s: float = 1.5  # wait for signals that come once a second
    rejected_signals_s: float = 5.0  # wait for signals that come, but cannot be right yet
    possible: float = 0.5  # of the span of the rest voltage: no cell at work is further beyond full or empty
    drop_factor: float = 3.0  # of the drop by the tables: no cell has more, cold and aged ones included
    joined_s: float = 900.0  # how long ago a ride began that is joined under way
    doubted_start_s: float = 30.0  # a voltage that is doubted so soon has misled the first state
    # Steps
    zero_s: float = 60.0  # a current that reads exactly 0 for longer may be any small one
    near: float = 0.01  # of SOC: over so little the curve is straight
    turns: int = 5  # of the iterated update (Bell & Cathey 1993)
    # The innovation
    matching_s: float = 600.0  # over which the cell model's error is compared with its prior
    innovation_s: float = 10.0  # low pass of the published innovation
    glitch_sd: float = 5.0  # a voltage further off is a glitch, unless it persists
    glitch_count: int = 20  # so many in a row are no glitch
    contradicted_s: float = 60.0  # a contradiction that lasts for so long is believed
    contradicted_odds: float = 9.0  # logarithm of the likelihood ratio, "from the voltage" over "as believed": 5 sd
    misfit: float = 4.0  # mean square of errors over their variance: healthy packs had up to 3.5
    large_error: float = 0.08  # V of a cell, RMS: the cell model does not follow the voltage
    restarted_s: float = 600.0  # for which a restart is reported


PACK = PackConfig()
FIELDS = {  # of the saved state
    "soc": Number(0.0, 1.0),
    "soc_variance": Number(1e-9, PRIOR.unknown_soc_sd**2),
    "error_variance": Number(1e-12, 1.0),  # V²
    "v1": Number(-1.0, 1.0),  # V of a cell
    "current": Number(-1e4, 1e4, optional=True),  # A
    "odometer": Number(-1e3, 1e10, optional=True),  # m
    "own_soc": Number(-0.1, 1.1, optional=True),
    "consumption": Number(-1e5, 1e5, optional=True),  # J/m
    "cell_effects": Each(Number(-LARGEST, LARGEST), 100),  # V of a cell
    "learned": {**pack_age.FIELDS, "weakest": weakest.FIELDS},
}


class Synchroniser:
    """Pairs voltages with the current of the same time. latency: of the voltage [s]; negative: of the current."""

    def __init__(self, latency: float) -> None:
        self.latency = latency
        self._recent: deque[tuple[float, float, float]] = deque()  # s, V, A of the pack

    def pair(self, now: float, voltage: float, current: float, pause: float) -> tuple[float, float] | None:
        """(voltage [V], current [A]) of one time; None if not yet, or over a gap longer than `pause` [s]."""
        recent, then = self._recent, now - abs(self.latency)
        recent.append((now, voltage, current))
        if recent[0][0] > then:
            return None
        while recent[1][0] <= then:
            recent.popleft()
        (t0, v0, i0), (t1, v1, i1) = recent[0], recent[1]
        if t1 - t0 > pause:
            return None
        share = (then - t0) / (t1 - t0)
        if self.latency > 0:
            return voltage, i0 + share * (i1 - i0)
        return v0 + share * (v1 - v0), current


class InnovationTest:
    """Decides whether an unexpected voltage is a glitch, an error of the cell model, or a wrong state of charge."""

    def __init__(self) -> None:
        self.innovation: float | None = None  # V of a cell
        self.off = 0  # voltages in a row
        self.square = 0.0  # V², mean of the innovation's
        self.misfit = 0.0  # mean of the innovation's square over its variance
        self.contradicted = 0.0  # s for which the voltage has contradicted the state of charge
        self._model_is_blamed = False  # and has not followed the voltage since

    @property
    def mismatch(self) -> bool:
        """Whether the cell model does not follow the voltage."""
        return bool(self.off) or self.square > PACK.large_error**2

    def blame_model(self, variance: float) -> None:
        """Believe the cell model no better than the last error shows; variance: known of it [V²].

        The state of charge is made uncertain by that same error, and explains no part of it.
        """
        self.misfit = (self.innovation or 0.0) ** 2 / variance
        self.contradicted, self._model_is_blamed = 0.0, True

    def noise(self, dt: float, error: float, own: float, slow: float, fast: float, restarted: float) -> float | None:
        """Variance [V²] of the noise of a voltage that is `error` [V] off its prediction; None: do not use it.

        dt: [s] that it represents; own: variance of the prediction by the state, slow: of the slow model error, fast:
        of the part that changes with the load, restarted: of the prediction by a state of which nothing is known [V²].
        """
        self.innovation, square, known = error, error * error, slow + fast
        # A model with larger errors than its prior gets a larger variance (covariance matching: Mehra 1970).
        believed = known * max(self.misfit, 1.0)
        expected = known if self._model_is_blamed else own + known
        self.misfit += (square / expected - self.misfit) * min(dt / PACK.matching_s, 1.0)
        self._model_is_blamed = self._model_is_blamed and self.misfit > 1
        self.square += (square - self.square) * min(dt / PACK.innovation_s, 1.0)
        odds = 0.0
        if square > own + known:  # otherwise a start again is no likelier
            odds = log_likelihood(error, restarted + known) - log_likelihood(error, own + known)
        self.contradicted = self.contradicted + dt if odds > PACK.contradicted_odds else 0.0
        self.off = self.off + 1 if square > PACK.glitch_sd**2 * (own + believed) else 0
        if self.off:  # a large error of the model is not to become a slow one
            return None if self.off < PACK.glitch_count else believed
        return believed - slow


class BatteryPack:
    """State of charge, capacity and resistance of one pack.

    state: of the battery filter; a belief from before while it is not started, until the first voltage. battery: the
    pack as it is believed to have aged; a new one whenever that changes.
    """

    def __init__(self, battery: Battery, model: Model, backend: Backend, signals: Signals, sag: ResponseGain) -> None:
        p = model.parameters
        self._filed = self.battery = battery
        self._backend, self._signals = backend, signals
        self._sag = sag
        self.age, self.weakest = PackAge(battery, backend), WeakestGroup(battery, signals, p)
        self._follow_age()
        self.effects = CellEffects(model, battery)
        self.voltage_noise = VoltageNoise(battery, p)
        self._charge_noise = ChargeNoise(battery, p)
        self.synchroniser = Synchroniser(p["pack_voltage_latency"])
        self._auxiliary_power = p["auxiliary_power"]
        empty, full = battery.ocv(0.0)[0], battery.ocv(1.0)[0]
        self._span = full - empty
        self._possible = empty - PACK.possible * self._span, full + PACK.possible * self._span  # V
        self.state = self.age.unknown
        self.is_started = False
        self.past: Past | None = None  # the vehicle when the state was believed last, while waiting
        self.past_age: float | None = None  # s; None: unknown
        self.vehicle = Past()  # at the last step
        self._unseen = STOOD  # s: for so long, and no longer, the load was not seen
        self._cell = Cell.of(battery, HALF_FULL, BENCH_TEMPERATURE)  # at the last step
        self._v1_lag = 0.0  # V: mean of V1 over the last window less V1 at its end, as voltages are means
        self._slow = 0.0, 1.0  # V², s: variance and time constant of the model error at the last step
        self._zero_time = 0.0  # s for which the current has read 0
        self._first: First | None = None
        self._looked = -inf  # s: when a first voltage was looked at last,
        self._waiting_since = inf  # s: and at first
        self._was_unsteady = False
        self._started = -inf  # s
        self._started_from: tuple[FilterState, Past | None, float | None] = self.state, None, None
        self._joined = self._was_doubted = False
        self._restarted_at = -inf  # s
        self._gap: tuple[float, FilterState, Past] | None = None  # when the pack was measured last, and the state then
        self._voltage_time: float | None = None  # s, of the message whose voltage was used last
        self._voltage_used = -inf  # s: when
        self.test = InnovationTest()
        self._rest = RestDetector()

    # --- what others ask --------------------------------------------------------------------------------------

    @property
    def soc(self) -> tuple[float, float]:
        """(state of charge of the cells, its standard deviation), with the belief of the capacity."""
        return self.age.published(self.state)

    @property
    def rest_voltage(self) -> float:
        """Voltage of the pack without a load [V] at this state of charge."""
        return self.battery.ocv(self.state.soc)[0] * self.battery.cells_series

    @property
    def joined(self) -> bool:
        """Whether the filter started on the move, from nothing saved, and no rest has shown the SOC yet."""
        return self._joined and not self._rest.has_shown

    def restarted(self, now: float) -> bool:
        """Whether the filter started again from the voltage a short while ago."""
        return now - self._restarted_at < PACK.restarted_s

    def learned(self) -> dict[str, LearnedFactor]:
        """Capacity and resistance, by name."""
        return self.age.learned(self.state)

    def unlearn(self) -> None:
        """Return to the proven resistance, as a sensor was found faulty."""
        self.state = self.age.unlearn(self.state)

    def cell_error(self, now: float, shown: tuple[float, float], sensor: str) -> float | None:
        """Measured minus predicted voltage of a cell [V] for those of the pack; None before the first voltage.

        shown: voltage [V] and current [A] of the pack; sensor: the source of the current, see `CellEffects.supposed`.
        """
        if not self.is_started:
            return None
        current = shown[1] / self.battery.cells_parallel
        volts = self.battery.cell_voltage(*shown) + self.effects.supposed(sensor, now, current)
        return volts - (self._cell.ocv - self._cell.r0 * current - self.state.v1)

    def heat(self, temperature: float) -> float:
        """Heat of the pack [W] at the last step's current and `temperature` [degC]; 0 before the first voltage."""
        current = self.vehicle.current
        if not self.is_started or not current:
            return 0.0
        overpotential = self.state.v1 + self.effects.overpotential
        lost = self._cell.r0 * current / self.battery.cells_parallel + overpotential
        watts = self.battery.cells_series * lost * current + self.battery.series_resistance * current**2
        return watts + float(self.battery.reversible_heat(current, self.state.soc, temperature))

    # --- step by step -----------------------------------------------------------------------------------------

    def step(
        self,
        now: float,
        dt: float,
        reading: PackReading,
        temperature: float,
        speed: float | None,
        inputs: Mapping[str, float],
        prior_power: Callable[[float], float],
        price: float | None,
    ) -> None:
        """Advance by `dt` [s] to `now` [s].

        temperature: of the cells [degC]; speed in m/s; inputs: of effects in the cells, apart from those of the cells
        themselves; prior_power: of the prior riding [W] at a time [s]; price: the consumption expected [J/m].
        """
        if reading.voltage_doubted and not self._was_doubted and now - self._started < PACK.doubted_start_s:
            self.state, past, age = self._started_from  # the voltage has misled the filter
            self._wait(past, age)
        self._was_doubted = reading.voltage_doubted
        self._follow_gap(now, dt, reading, temperature, price)
        voltage, current = reading.voltage, reading.current
        if voltage is not None:
            drop = self._cell.r0 * (current or 0.0) / self.battery.cells_parallel + self.effects.overpotential
            # An inverter that is not yet charged shows a few volts, which no cells can have.
            if not self._possible[0] < self.battery.cell_voltage(voltage, current or 0.0) + drop < self._possible[1]:
                voltage, reading = None, reading._replace(voltage=None)
                self.test.off += 1
        if self.is_started:
            if dt > 0:
                self._predict(now, dt, reading, temperature, inputs)
            self._follow_vehicle(now, dt, current, speed)
            self._measure(now, dt, reading, temperature)
            if self.weakest.mapped:
                overpotential = self.effects.overpotential + self.state.v1
                self.weakest.step(now, reading, temperature, self.battery, self.soc, overpotential)
        else:
            if voltage is not None:
                self._await_first(now, voltage, reading, temperature, speed, prior_power)
            self.vehicle = self.vehicle._replace(current=current)
        self._follow_age()

    def _follow_age(self) -> None:
        """Replace `battery` when the belief of its age has changed."""
        health = Health(self.age.health.capacity, self.age.health.resistance, self.weakest.group)
        if health != self.battery.health:
            self.battery = self._filed.aged(health)

    def _measure(self, now: float, dt: float, reading: PackReading, temperature: float) -> None:
        """Condition the state on a voltage that came since the last step of `dt` [s], for all the time since."""
        voltage, current, pack_voltage = reading.voltage, reading.current, self._signals.pack_voltage
        if voltage is None or current is None:
            self.test.innovation = None
            return
        is_pack = pack_voltage.fresh(now)
        received = pack_voltage.time if is_pack else self._signals.inverter_voltage.time
        if received == self._voltage_time:
            return
        pause = self._signals.pause
        dt = min(now - self._voltage_used, pause) if self._voltage_used > -inf else dt
        self._voltage_time, self._voltage_used = received, now
        if self.synchroniser.latency and is_pack:
            pair = self.synchroniser.pair(now, voltage, current, pause)
            if pair is None:
                return
            voltage, current = pair
        self._update(now, dt, (voltage, current), reading, temperature)

    def _follow_vehicle(self, now: float, dt: float, current: float | None, speed: float | None) -> None:
        """Keep the odometer and the vehicle's own SOC; between two values they continue."""
        own_soc, odometer = self._signals.bms_state_of_charge, self._signals.odometer
        own, way = self.vehicle.own_soc, self.vehicle.odometer
        if odometer.fresh(now):
            way = odometer.value
        elif way is not None:
            way += abs(speed or 0.0) * dt
        self.vehicle = Past(current, way, own_soc.value if own_soc.fresh(now) else own)

    def _predict(
        self, now: float, dt: float, reading: PackReading, temperature: float, inputs: Mapping[str, float]
    ) -> None:
        """Count the charge of `dt` [s] up to `now` [s]."""
        battery, state, signals = self.battery, self.state, self._signals
        mean = reading.current or 0.0  # over the window
        if dt > signals.pause:  # of the current meanwhile only the ends are known
            mean = (mean + (mean if self.vehicle.current is None else self.vehicle.current)) / 2
            self._cell = Cell.of(battery, state.soc, temperature)
        charge = HOUR * battery.pack_capacity(temperature)
        flowed = mean * dt / charge
        # Of samples that come too seldom most of the charge is not seen.
        source = reading.source if signals.sampled <= TIMING.slowest else CurrentSource.NONE
        period = signals.sampled if signals.sampled > TIMING.coarse else 0.0
        variance = self._charge_noise.counted(
            min(dt, signals.pause), flowed, charge, source, reading.current_difference, period
        )
        zz = state.covariance[0]
        if dt > signals.pause or (source is CurrentSource.NONE and reading.unmeasured):
            variance += self._charge_noise.uncounted(uncounted_sd(dt), sqrt(zz))
            self._rest.interrupt()
        else:
            reads_zero = reading.source is CurrentSource.PACK and signals.pack_current.value == 0.0
            self._zero_time = self._zero_time + dt if reads_zero and signals.contactor.get(now) != 0 else 0.0
            if self._zero_time > PACK.zero_s:  # many sensors show small currents so
                unseen = self._auxiliary_power / (reading.voltage or self.rest_voltage)
                variance += self._charge_noise.uncounted(unseen * dt / charge, sqrt(zz))
        if self.vehicle.own_soc is not None:
            self.vehicle = self.vehicle._replace(own_soc=self.vehicle.own_soc - flowed)
        v1 = state.v1
        self._advance(dt, mean, variance, temperature)
        self._v1_lag = (v1 - self.state.v1) / 2 if dt <= 2 * WINDOW else 0.0
        self.effects.step(battery, dt, mean / battery.cells_parallel, self.state.soc, temperature, inputs)

    def _advance(self, dt: float, current: float, variance: float, temperature: float) -> None:
        """Predict the state over `dt` [s] at a mean pack `current` [A]; variance: of SOC, by counting."""
        battery, state, cell = self.battery, self.state, self._cell
        decay = exp(-dt / cell.time)
        v1 = decay * state.v1 + (1 - decay) * (cell.r1 * current / battery.cells_parallel)
        error, time = self._slow = self.voltage_noise.slow(state.soc, cell.slope, temperature, state.covariance[0])
        # An error beyond the model's own is an overpotential of before, and decays as that does.
        error_decay = decay if state.covariance[4] > error else exp(-dt / time)
        fresh = HOUR * battery.pack_capacity(temperature) / battery.health.capacity
        share = min(max(current * dt / fresh, -1.0), 1.0)  # a gap of years is no charge
        walks = AGE.capacity_walk * abs(share), AGE.resistance_walk * abs(share)
        state = self._backend.predict(state, share, v1, Noise(variance, error, error_decay, *walks))
        self.state = state = bounded(state)
        self._cell = Cell.of(battery, state.soc, temperature)

    def _update(
        self, now: float, dt: float, measured: tuple[float, float], reading: PackReading, temperature: float
    ) -> None:
        """Condition the state on a voltage [V] at a current [A], both of the pack, that represents `dt` [s]."""
        battery, cell, effects, noise, test = self.battery, self._cell, self.effects, self.voltage_noise, self.test
        voltage, pack_current = measured
        shown, current = battery.cell_voltage(voltage, pack_current), pack_current / battery.cells_parallel
        drop = cell.r0 * current + effects.overpotential
        self._follow_sag(now, dt, voltage, pack_current, reading)
        self.state = state = self.age.allow_learning(now, reading, self._signals, self.state)
        if replaced := self.age.replaced_pack(state):
            self.state = state = replaced
            self.weakest.forget()
        if dt <= self._signals.pause and self._take_rest(dt, shown, current, reading, temperature):
            return
        state = self.state
        # The voltage without the effects in the cells, which are known.
        emf = shown + effects.mean_overpotential + self._v1_lag + state.v1
        error = emf - cell.ocv + cell.r0 * current
        zz, ze, _, _, ee, _, _, _, _, _ = state.covariance
        h = cell.slope - current * cell.r0_slope
        belief, (slow, time) = self.age.belief, self._slow
        own = max(h * h * zz - 2 * h * ze + ee + cell.slope**2 * belief.soc_variance, 0.0)
        is_known = self._signals.cell_temperature.fresh(now)
        resistance_sd = max(noise.resistance, self.age.resistance_sd, 0.0 if is_known else PRIOR.resistance_sd_cold)
        voltage_sd = reading.voltage_sd if self._signals.pack_voltage.fresh(now) else PRIOR.inverter_voltage_sd
        fast = noise.fast(cell.r0, (drop, state.v1), reading.source, resistance_sd, voltage_sd)
        restarted = (cell.slope * PRIOR.unknown_soc_sd) ** 2
        variance = test.noise(dt, error - cell.slope * belief.soc_shift, own, slow, fast, restarted)
        if test.contradicted >= PACK.contradicted_s:
            self._refute(now, error, drop + state.v1, slow + fast)
            return
        if variance is not None and cell.slope**2 * zz > noise.history:  # history does not average out
            # An error that stays for a time counts as one sample in that time, not one each step.
            variance *= max(2 * time / max(dt, 0.02), 1.0)
            self._take_voltage(emf, current, temperature, variance)
        if test.misfit > PACK.misfit and not test.off and (doubted := self.age.doubted(self.state)):
            self.state, test.misfit = doubted, 1.0
        if not test.off:
            self.state = self.age.load(self.state, min(dt, self._signals.pause), drop + state.v1, error)
        self.age.follow(self.state, dt)

    def _follow_sag(self, now: float, dt: float, voltage: float, current: float, reading: PackReading) -> None:
        """Compare the changes of the voltage with those that a measured current explains, for the sensor checks."""
        battery, overpotential, explaining = self.battery, self.effects.overpotential, current
        if reading.source not in (CurrentSource.PACK, CurrentSource.INVERTER):
            if reading.reported_current is None:
                return
            explaining = reading.reported_current
            overpotential = self.effects.supposed("reported", now, explaining / battery.cells_parallel)
        # Both with the resistance outside the cells: of a pack of which little is known, r0 may include it.
        resistance = self._cell.r0 / battery.cells_parallel + battery.series_resistance / battery.cells_series
        self._sag.update(dt, resistance * explaining + overpotential, -voltage / battery.cells_series)

    def _take_rest(self, dt: float, volts: float, current: float, reading: PackReading, temperature: float) -> bool:
        """Condition the state on a rest that is better proven than before; returns whether it did."""
        battery, cell, state, noise = self.battery, self._cell, self.state, self.voltage_noise
        emf = volts + cell.r0 * current + self.effects.overpotential
        found = self._rest.step(dt, volts, current / battery.capacity, emf, cell.time, noise.model)
        if found is None:
            return False
        emf += found[0]
        variance = found[1] ** 2 + noise.rest**2 + reading.voltage_sd**2
        width = soc_width(battery, emf, sqrt(variance), temperature) / 2
        new = self._rest.news(variance, state.covariance[0], width)
        if new is None:
            return False
        residual = battery.soc_at(emf, temperature) - state.soc
        soc_variance = (soc_width(battery, emf, sqrt(new), temperature) / 2) ** 2
        least = self.age.min_capacity_variance(state, state.soc, cell.slope)
        state = self._backend.condition(state, (1.0, 0.0, 0.0), residual, soc_variance, least)
        self.state = state = bounded(state)
        self._cell = Cell.of(battery, state.soc, temperature)
        return True

    def _take_voltage(self, emf: float, current: float, temperature: float, variance: float) -> None:
        """Condition the state on a cell's voltage without its overpotential [V].

        Where that moves the state of charge far, the slope is taken at its new place.
        """
        state, cell = self.state, self._cell
        at = state.soc
        least = self.age.min_capacity_variance(state, at, cell.slope)
        for _ in range(PACK.turns):
            h = cell.slope - current * cell.r0_slope
            residual = emf - cell.ocv + cell.r0 * current - h * (state.soc - at) + state.error
            after = self._backend.condition(state, (h, -1.0, 0.0), residual, variance, least)
            before, at = at, after.soc
            if abs(at - before) < PACK.near:
                break
            cell = Cell.of(self.battery, at, temperature)
        self.state, self._cell = bounded(after), cell

    # --- starts -----------------------------------------------------------------------------------------------

    def _refute(self, now: float, error: float, drop: float, known: float) -> None:
        """A cell's voltage has been `error` [V] off for long, at a predicted `drop` by its load [V].

        Where tables that are wrong for these cells explain it, as in the cold, a loaded voltage proves nothing: the
        state of charge is as uncertain as it is contradicted until a rest. Otherwise the filter starts again.
        """
        state = self.state
        if abs(error) < PACK.drop_factor * abs(drop):
            apart = self.battery.soc_at(self.battery.ocv(state.soc)[0] + error) - state.soc
            wider = state.covariance[0] + apart * apart, *state.covariance[1:]
            self.state = bounded(state._replace(covariance=wider))
            self.test.blame_model(known)
            return
        self._wait(None, None)
        self.test, self._restarted_at = InnovationTest(), now

    def _wait(self, past: Past | None, age: float | None) -> None:
        """Wait for a first voltage; past: of the vehicle `age` [s] ago when the state was believed, None: it is not."""
        self.is_started, self.test.innovation, self._first = False, None, None
        self.past, self.past_age, self._unseen = past, age, STOOD
        self._rest = RestDetector()
        if not past:
            self.age.reset_voltage_span()

    def _follow_gap(self, now: float, dt: float, reading: PackReading, temperature: float, price: float | None) -> None:
        """Start from the state before a gap if it was as long as a restart's: the pack may have been charged meanwhile.

        A gap of all messages, or of the pack's.
        """
        is_blind, is_gap = reading.unmeasured, dt > PRIOR.bridge_s
        if not self.is_started:
            self._gap = None
            return
        if self._gap is None and (is_blind or is_gap):
            self._gap = now - dt, self.state, self.vehicle._replace(consumption=price)
        if self._gap is None or (is_blind and not is_gap):
            return
        (began, state, past), self._gap = self._gap, None
        if now - began > PRIOR.bridge_s:
            if is_gap:
                self.effects.step(self.battery, dt, 0.0, state.soc, temperature)
            self.state = state
            self._wait(past, now - began)

    def wait(self, seconds: float) -> None:
        """Let time pass [s] in which no voltage came: the saved state is older by that."""
        if self.past and self.past_age is not None:
            self.past_age += seconds
            self._unseen = min(self._unseen + seconds, STOOD)
            self.effects.rest(self.battery, seconds, self.state.soc)

    def _await_first(
        self,
        now: float,
        voltage: float,
        reading: PackReading,
        temperature: float,
        speed: float | None,
        prior_power: Callable[[float], float],
    ) -> None:
        """Start from the first pack `voltage` [V] that holds still, once all that comes once a second is known.

        Riders pull away within a second: the first voltage is the one at rest, the charge since is counted.
        """
        battery, signals, current = self.battery, self._signals, reading.current or 0.0
        first, pause = self._first, max(2 * PACK.slow_signals_s, self._signals.pause)
        if first is None or now - self._looked > pause:
            first = First(now, voltage, current, None)
        if first.moving is None and speed is not None:
            first = first._replace(moving=abs(speed) > MOVING)
        self._first, self._looked, self._waiting_since = first, now, min(self._waiting_since, now)
        is_late = now - self._waiting_since >= PACK.longest_wait_s
        r0 = battery.r0.at(HALF_FULL, temperature)[0] * battery.cells_series / battery.cells_parallel
        drop = battery.cell_voltage(r0, 1.0) * abs(current - first.current)
        moved = max(abs(voltage - first.voltage) / battery.cells_series - PACK.drop_factor * drop, 0.0)
        if moved > PACK.steady_share * self._span and not is_late:
            self._first, self._was_unsteady = First(now, voltage, current, None), True
            return
        awaited = [signals.cell_temperature]
        if self.past:
            awaited += [signals.odometer, signals.bms_state_of_charge]
        missing = any(signal.stale_after and not signal.fresh(now) for signal in awaited)
        least = PACK.slow_signals_s if missing else PACK.steady_s
        if self.past and signals.has_rejected:
            least = PACK.rejected_signals_s
        if now - first.time < (PACK.resettled_s if self._was_unsteady else least) and not is_late:
            return
        self._waiting_since, self._was_unsteady = inf, False
        unsteady_sd = self._span if is_late else PACK.steady_sd * moved
        self._start(now, first._replace(unsteady_sd=unsteady_sd), reading, temperature, prior_power(now))

    def _start(self, now: float, first: First, reading: PackReading, temperature: float, power: float) -> None:
        """Start from the `first` voltage and the state that was believed; power: of the prior riding [W]."""
        battery, effects, past = self.battery, self.effects, self.past
        self._started, self._started_from = now, (self.state, past, self.past_age)
        self._joined = bool(first.moving) and not past
        if self._unseen:
            drawn = first.current
            if self._joined:
                before = power / first.voltage / battery.cells_parallel
                effects.step(battery, PACK.joined_s, before, HALF_FULL, temperature)
            elif not first.moving:
                drawn = standing_load(drawn, first.voltage, self._auxiliary_power)
            effects.step(battery, self._unseen, drawn / battery.cells_parallel, HALF_FULL, temperature)
            self._unseen = 0.0
        first = first._replace(
            temperature=temperature,
            overpotential=effects.overpotential,
            riding_power=power,
            voltage_sd=reading.voltage_sd,
        )
        vehicle = Past(first.current, self._signals.odometer.get(now), self._signals.bms_state_of_charge.get(now))

        self.age.is_learning = True
        state = first_state(
            battery,
            self.voltage_noise,
            self.state,
            first,
            past,
            self.past_age,
            vehicle,
            lambda soc: self.age.min_capacity_variance(self.state, soc, battery.ocv(soc)[1]),
        )
        self.state, self.is_started, self.past, self.past_age = state, True, None, None
        self.age.apply(state)
        self._follow_age()
        self._cell = Cell.of(self.battery, state.soc, temperature)
        self._advance(now - first.time, (first.current + (reading.current or 0.0)) / 2, 1e-9, temperature)

    # --- saving -----------------------------------------------------------------------------------------------

    def snapshot(self) -> dict[str, Any]:
        """The state, the vehicle and the learned factors, to be kept over a restart."""
        state = self.state
        return {
            "soc": min(max(state.soc, 0.0), 1.0),
            "soc_variance": state.covariance[0],
            "error_variance": state.covariance[4],
            "v1": state.v1,
            "current": self.vehicle.current,
            "odometer": self.vehicle.odometer,
            "own_soc": self.vehicle.own_soc,
            "cell_effects": dict(self.effects.states),
            "learned": self.learned_snapshot(),
        }

    def learned_snapshot(self) -> dict[str, Any]:
        """Capacity, resistance and weakest group, to be kept over a restart."""
        return {**self.age.snapshot(self.state), "weakest": self.weakest.snapshot()}

    def restore(self, saved: Mapping[str, Any], age: float | None) -> None:
        """Continue from a saved state, which was checked and is `age` [s] old (None: unknown).

        ValueError if it holds a state that no filter has, or if it is of other effects.
        """
        self.weakest.restore(saved["learned"]["weakest"])
        self.state = self.age.restored(saved)
        self._follow_age()
        self.effects.restore(self.battery, saved["cell_effects"], age, saved["soc"])
        self.past = Past(*(saved[name] for name in Past._fields))
        self.past_age, self._unseen = age, STOOD if age is None else min(age, STOOD)
        self._signals.resume({"odometer": saved["odometer"], "bms_state_of_charge": saved["own_soc"]})
