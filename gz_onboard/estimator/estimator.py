"""Windows in, estimates out: the order of one step, the values reported and those saved.

No I/O and no clock: time arrives with the windows, so the same windows give the same estimates, to the last bit.
All state lives here and in the parts owned here; `snapshot` and `restore` carry it over a restart. One step: check the
sensors and choose the pack's voltage and current (`plausibility`), follow the motion (`motion`), choose the
temperatures, step the battery filter (`battery_pack`), learn from the riding and forecast (`forecaster`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf, sqrt
from typing import Any

from gz_onboard.constants import BENCH_TEMPERATURE
from gz_onboard.estimator import battery_pack, forecast
from gz_onboard.estimator.battery_filter import SCALAR, Backend
from gz_onboard.estimator.battery_pack import BatteryPack
from gz_onboard.estimator.cells import Temperatures
from gz_onboard.estimator.explanation import RangeExplainer
from gz_onboard.estimator.forecast import Forecaster
from gz_onboard.estimator.load_model import PresentLoad
from gz_onboard.estimator.motion import MOTION, ActivityTracker, Motion, VibrationMonitor
from gz_onboard.estimator.plausibility.electrical import CurrentSource, PackReading, PackSensors
from gz_onboard.estimator.plausibility.motion import GradeCheck, SpeedCheck
from gz_onboard.estimator.plausibility.residual import LimitCheck
from gz_onboard.estimator.route import RouteForecaster
from gz_onboard.estimator.saved_state import VERSION, Each, Number, Text, check, check_vehicle
from gz_onboard.estimator.signals import TIMING, Signals
from gz_onboard.events import LOADS, NO_PACK, SPEEDS, WINDOW, Activity, Estimate, Group, MessageWindow, Reason, State
from gz_onboard.model.battery import Battery
from gz_onboard.model.effect import MOVING
from gz_onboard.model.model import Model
from gz_onboard.model.riding import PriorRiding

SILENT_AFTER = 2.0  # s without a step: what was measured is no longer reported
STARTING_FOR = 10.0  # s: without a state of charge by then, no range is to be expected soon
UNCERTAIN = 0.05  # of SOC: a larger sd is reported
LEARNED_FROM = {"motor_speed", "accel_x", "gps_altitude", "pack_current", "pack_voltage"}
AGED_FROM = {"pack_current", "pack_voltage", "cell_temperature"}
LEAP = 30.0  # s: the odometer shows whether a longer step of time was a gap, or the clock was set
ODOMETER_WITHIN = 3.0  # s to wait for the odometer after such a step
CELLS_KEEP = 3600.0  # s: saved cell temperatures that are older say nothing
NEW_DAY = 3 * 3600.0  # s without motion, where it is not known how long the vehicle stood
LOSS_SD = {  # relative, of the consumption to come for what is missing, from the errors on the rides without each
    Reason.NO_SPEED: 0.10,
    Reason.NO_IMU: 0.03,
    Reason.NO_GPS: 0.03,
    Reason.NO_AMBIENT_TEMPERATURE: 0.04,
    Reason.NO_CELL_TEMPERATURE: 0.02,
    Reason.NO_PACK_CURRENT: 0.03,
    Reason.NO_PACK_VOLTAGE: 0.02,
    Reason.SENSOR_DISTRUSTED: 0.05,  # what was learned from it before it was found out
}
# Plain integers, as operations on flags are slow: (bit, variance), and the reasons that degrade an estimate.
_LOSS_VARIANCES = [(int(reason), sd * sd) for reason, sd in LOSS_SD.items()]
_DEGRADING = ~int(Reason.PRIOR_RIDING | Reason.FRAMES_DROPPED | Reason.FRAMES_LOST)
_NO_PACK = int(NO_PACK)
UNLEARNED = 1500.0  # m: so far a sensor can have been faulty before it is found out
FIELDS = {  # of the saved state
    "version": Number(VERSION, VERSION),
    "key": Text(10_000),  # compared by `check_vehicle`
    **battery_pack.FIELDS,
    "cell_temperature": Number(-50.0, 120.0, optional=True),  # degC
    "gyro_bias": Each(Number(-MOTION.max_gyro_bias, MOTION.max_gyro_bias), 2),  # rad/s, of roll and yaw rate
    "riding": forecast.FIELDS,
}


class Estimator:
    """The estimator of one vehicle."""

    def __init__(
        self, groups: Sequence[Group], battery: Battery, model: Model, riding: PriorRiding, backend: Backend = SCALAR
    ) -> None:
        self.signals = Signals(groups, battery.window.of_cells)
        p = model.parameters
        radius, gear = p["wheel_radius"], p["gear_ratio"] / p["speed_sensor_scale"]
        self.motion = Motion(self.signals, radius, gear)
        inverter = [self.signals[role] for role in ("inverter_current", "inverter_voltage", "motor_speed")]
        self._inverter = [signal for signal in inverter if signal.stale_after]  # those that the vehicle has
        self._vibration = VibrationMonitor() if "vibration" in model.reads else None  # only where it is read
        self._time: float | None = None  # s, of the last step
        self.gap_time = 0.0  # s between steps that were too far apart: distance and charge lack what was ridden in it
        self._odometer: float | None = None  # m, at the last step
        self._odometer_step = 0.0  # m, the largest of its counts; 0: it has not counted yet
        self._clock_leap: float | None = None  # s: the first step after a gap that waits for the odometer
        self._activity, self._reading = ActivityTracker(), PackReading()
        self._distrusted: tuple[str, ...] = ()
        self.limits = LimitCheck(self.signals)
        self.speeds = SpeedCheck(self.signals, radius, gear, battery.pack_capacity(BENCH_TEMPERATURE))
        self.grades = GradeCheck(self.signals, self.speeds, self.limits.altitude, model.mass, self._level_power)
        self.electrical = PackSensors(self.signals, battery, p, self._cell_error, self._road_power)
        groups_checked = self.electrical.sensors, self.limits.sensors, self.speeds.sensors
        self._checked = [sensor for sensors in groups_checked for sensor in sensors.values()]
        self._checked.append(self.grades.accelerometer)
        self._temperatures = Temperatures(self.signals, p)
        self.pack = BatteryPack(battery, model, backend, self.signals, self.electrical.sag)
        self.forecaster = Forecaster(model, battery, riding, self.pack)
        self.explainer = RangeExplainer(self.forecaster)
        self.route = RouteForecaster(self.forecaster, self.motion, self.signals)
        self.load = PresentLoad(
            self.forecaster.load, self.motion, self._temperatures, self.pack, self._vibration, self.signals
        )

    # --- one step ---------------------------------------------------------------------------------------------

    def step(self, windows: Sequence[MessageWindow]) -> None:
        """Advance to the end of one window with the samples of each message; an empty window changes nothing."""
        if not windows:
            return
        now = max(self._time or 0.0, *(window.time for window in windows))
        signals, motion = self.signals, self.motion
        signals.take(windows, now)
        dt = self._time_passed(now)
        if dt is None:
            return
        self._time = now
        elapsed = min(dt, signals.pause)
        self.gap_time += dt - elapsed
        if self._vibration:
            self._vibration.step(now, signals.accel_z)
        self.limits.step(now, elapsed, motion.speed)
        self.speeds.step(now, elapsed, gap=elapsed < dt)
        motion.step(now, elapsed)
        self._reading = self._read_pack(now, elapsed)
        self._compare_grades(now, elapsed, gap=elapsed < dt)
        temperature = self._temperatures.step(now, dt, self.pack.heat if dt <= signals.pause else None)
        inputs, price = self.load.cell_inputs(now), self.forecaster.consumption
        self.pack.step(now, dt, self._reading, temperature, motion.speed, inputs, self.load.power_of_prior, price)
        self._follow_activity(now, dt)
        self._ride(now, dt)
        if not self.pack.is_started:
            self.forecaster.outdate()
        elif self.forecaster.due(now):
            self._look_ahead(now, temperature)

    def _time_passed(self, now: float) -> float | None:
        """Measure the time since the last step [s] without leaps of the clock; None while it cannot be told yet.

        A gap during which the odometer did not move, although the vehicle moved before and after it, is a leap of the
        clock. The step waits until the odometer has come. Also updates the motion to the speed behind the gap.
        """
        dt = 0.0 if self._time is None else now - self._time
        odometer, speed = self.signals.odometer, self.motion.speed or 0.0
        moved = 0.0 if self._odometer is None else odometer.value - self._odometer
        if dt > LEAP and self._odometer_step and speed > MOVING:
            self._clock_leap = self._clock_leap or now
            came = odometer.time >= self._clock_leap - WINDOW
            if not came and now - self._clock_leap < ODOMETER_WITHIN:
                return None
            self.motion.step(now, 0.0)  # how fast it is now
            least = min(speed, self.motion.speed or 0.0) * dt / 2
            if came and 0 <= moved + self._odometer_step < least:
                dt, moved = max(now - self._clock_leap, WINDOW), 0.0
        elif 0 < moved < UNLEARNED:
            self._odometer_step = max(self._odometer_step, moved)
        self._clock_leap, self._odometer = None, odometer.last
        return dt

    def _read_pack(self, now: float, dt: float) -> PackReading:
        """Read voltage and current of the pack by the sensors, else by the model."""
        reading = self.electrical.read(now, dt, self.motion.speed, sqrt(self.pack.test.square))
        speed = self.motion.speed
        # At standstill a pack of which nothing is measured may be charged; over a pause there is no acceleration.
        rides = speed is not None and abs(speed) > MOVING and dt < self.signals.pause
        if reading.current is None and speed is not None and (reading.voltage or rides):
            voltage = reading.voltage or self.pack.rest_voltage
            return reading._replace(current=self.load.power(now) / voltage, source=CurrentSource.MODEL)
        return reading

    def _cell_error(self, voltage: float, current: float, sensor: str) -> float:
        """Return the measured minus predicted cell voltage, for the sensor checks."""
        return self.pack.cell_error(self._time or 0.0, (voltage, current), sensor) or 0.0

    def _road_power(self) -> float | None:
        known = self.motion.speed is not None and self.signals.sampled <= TIMING.coarse
        return self.load.power(self._time or 0.0) if known else None

    def _level_power(self, speed: float, acceleration: float) -> float:
        return self.load.power_at(self._time or 0.0, speed, acceleration)

    def _compare_grades(self, now: float, dt: float, gap: bool) -> None:
        """Compare the sensors of the grade; forget everything learned from a sensor that is newly distrusted."""
        grades, reading = self.grades, self._reading
        voltage, current, modelled = reading.voltage, reading.current, reading.source is CurrentSource.MODEL
        towed = self.forecaster.learner.towed  # then no energy of the bus shows a grade
        power = None if voltage is None or current is None or modelled or towed else voltage * current
        grades.compare(now, dt, gap, power)
        left_out = self._distrusted
        self._distrusted = tuple([sensor.role for sensor in self._checked if sensor.faulty])
        if self._distrusted == left_out:
            return
        changed = set(self._distrusted).symmetric_difference(left_out)
        if changed & {"accel_x", "gps_altitude"}:
            self.motion.forget_grade(grades.offset, self.signals.gps_altitude.fresh(now))
        newly = changed.difference(left_out)
        learned = LEARNED_FROM if self.motion.speed is not None else LEARNED_FROM.union(SPEEDS)
        if forgotten := newly & learned:
            self.forecaster.forget(max(UNLEARNED, self.speeds.odometer.compared))
            self.explainer.forget(forgotten)
        if "auxiliary_current" in newly:
            self.forecaster.learner.auxiliaries.forget()
        if newly & AGED_FROM:
            self.pack.unlearn()

    # --- riding and range -------------------------------------------------------------------------------------

    def _follow_activity(self, now: float, dt: float) -> None:
        signals, current = self.signals, self._reading.current
        known = current if self._reading.source in (CurrentSource.PACK, CurrentSource.INVERTER) else None
        capacity = self.pack.battery.pack_capacity(self._temperatures.cells_or_bench)
        rate, drive = (None if x is None else x / capacity for x in (known, signals.inverter_current.get(now)))
        is_moving = abs(self.motion.speed or 0.0) > MOVING  # and so is switched on, whatever is silent
        silent = not is_moving and bool(self._inverter) and not any(signal.fresh(now) for signal in self._inverter)
        off = signals.key.get(now) == 0 or signals.contactor.get(now) == 0
        rider = signals.rider.get(now)
        if rider is not None and abs(self.motion.speed or 0.0) < MOTION.standstill:
            self.forecaster.ridden_by(f"{rider:g}")
        speed = 0.0 if signals.carried else self.motion.speed
        self._activity.step(dt, speed, rate, signals.charge_plug.get(now), silent, off, drive)
        auxiliary, voltage = signals.auxiliary_current.get(now), self._reading.voltage
        measured = None if auxiliary is None or voltage is None else voltage * auxiliary
        loads = [power for role in LOADS if (power := signals[role].get(now)) is not None]
        self.forecaster.learner.auxiliaries.step(min(dt, self.signals.pause), measured, sum(loads) if loads else None)

    def _ride(self, now: float, dt: float) -> None:
        """Learn from the ride while its consumption is known."""
        speed, reading = self.motion.speed, self._reading
        unsure = reading.source in (CurrentSource.MODEL, CurrentSource.DISPUTED) or self.speeds.disputed
        known = 0 < dt <= self.signals.pause and not unsure and self._activity.teaches
        if speed is None or reading.voltage is None or reading.current is None or not known:
            still = 0.0 if dt <= self.signals.pause and self._activity.now is Activity.RIDING else dt
            self.forecaster.learner.pause(still)
            return
        power = reading.voltage * reading.current
        self.route.ride(dt, speed, power)
        self.forecaster.learner.ride(
            dt,
            speed,
            self.motion.grade,
            power,
            self.load.conditions(now),
            next((self.signals[role].period for role in self.signals.mapped(SPEEDS)), 0.0),
            self._drive(now, reading.voltage, power),
        )

    def _drive(self, now: float, voltage: float, power: float) -> float:
        """Return the motor's part [W] of the `power` of the pack at `voltage` [V]."""
        signals = self.signals
        current, torque = signals.inverter_current.get(now), signals.motor_torque.get(now)
        if current is not None:
            return voltage * current
        if torque is not None and (turning := signals.motor_speed.get(now)) is not None:
            return torque * turning
        auxiliaries = self.forecaster.learner.auxiliaries
        return power - auxiliaries.modelled - auxiliaries.now

    def _look_ahead(self, now: float, temperature: float) -> None:
        cells = temperature, self._temperatures.cells_sd(now)
        missing = self._reasons(now) | int(self.signals.lacking)
        lost = sum([variance for reason, variance in _LOSS_VARIANCES if reason & missing])
        conditions = self.load.conditions(now)
        soc = self.pack.soc
        activity, way = self._activity.now, (self.motion.distance, self.route.hills)
        forecast = self.forecaster.step(
            *(now, soc, cells, conditions, lost, self._reading, activity),
            lambda free: self.route.forecast(now, free, soc, lost, conditions),
        )
        self.explainer.take(now, forecast, soc[0], conditions, *way, activity is Activity.CHARGING)

    # --- results ----------------------------------------------------------------------------------------------

    def estimate(self, now: float) -> Estimate:
        """Return the estimate at `now` [s]; cheap, and changes nothing."""
        pack, latest = self.pack, self.forecaster.latest
        silent = self._time is None or now - self._time > max(SILENT_AFTER, self.signals.pause)
        activity, reasons = self._activity.shown(silent, pack.joined), self._reasons(now)
        values: dict[str, Any] = {"distance": self.motion.distance, "cell_temperature": self._temperatures.cells}
        if not silent:
            values |= self._measured()
        if not pack.is_started:
            state = State.INVALID if now > STARTING_FOR else State.STARTING
            return Estimate(now, state, Reason(reasons), activity, self._distrusted, **values)
        soc, soc_sd = pack.battery.window.shown(*pack.soc)
        values |= {"soc": soc, "soc_sd": soc_sd, "v1": pack.state.v1, "innovation_rms": sqrt(pack.test.square)}
        values |= self.forecaster.report(activity is Activity.CHARGING) | self.route.report()
        if latest:
            values["why"] = self.explainer.latest
            reasons |= Reason.PRIOR_RIDING if latest.mostly_prior else 0
        if soc_sd > UNCERTAIN:
            reasons |= Reason.SOC_UNCERTAIN
        state = State.DEGRADED if reasons & _DEGRADING else State.VALID
        missing = reasons | int(self.signals.lacking)
        if (silent and missing & _NO_PACK == _NO_PACK) or reasons & Reason.SIGNALS_SLOW:
            state = State.INVALID
        return Estimate(now, state, Reason(reasons), activity, self._distrusted, **values)

    def _measured(self) -> dict[str, Any]:
        """Return the fields of an estimate that are as of the last step."""
        motion, reading = self.motion, self._reading
        return {
            "speed": motion.speed,
            "acceleration": motion.acceleration,
            "grade": motion.grade,
            "lean": motion.lean,
            "yaw_rate": motion.yaw_rate,
            "heading": motion.heading,
            "pack_voltage": reading.voltage,
            "pack_current": reading.current,
            "current_modelled": reading.source is CurrentSource.MODEL,
            "innovation": self.pack.test.innovation,
        }

    def _reasons(self, now: float) -> int:
        s = self.signals
        reasons = s.missing(now, self._activity.takes_charge or s.carried)
        if self.electrical.current_difference.contradicts:
            reasons |= Reason.CURRENT_MISMATCH
        differ = self.electrical.voltage_dispute or not (s.pack_voltage.trusted and s.inverter_voltage.trusted)
        if differ or self.pack.test.mismatch:
            reasons |= Reason.VOLTAGE_MISMATCH
        if self.signals.sampled > TIMING.slowest:
            reasons |= Reason.SIGNALS_SLOW
        if self.pack.restarted(now):
            reasons |= Reason.SOC_RESTARTED
        if self._distrusted:
            reasons |= Reason.SENSOR_DISTRUSTED
        return reasons

    # --- saving -----------------------------------------------------------------------------------------------

    def snapshot(self, key: str) -> dict[str, Any] | None:
        """Return the state to save for the vehicle `key`; None before there is any."""
        if not self.pack.is_started:
            return None
        return self.pack.snapshot() | {
            "version": VERSION,
            "key": key,
            "consumption": self.forecaster.consumption,
            "cell_temperature": self._temperatures.cells,
            "gyro_bias": list(self.motion.gyro_bias),
            "riding": self.forecaster.snapshot(),
        }

    def restore(self, saved: Mapping[str, Any], key: str, age: float | None) -> None:
        """Continue from a snapshot that is `age` [s] old (None: not known).

        ValueError if it does not fit this vehicle; then parts may have been restored: discard this estimator.
        """
        check_vehicle(saved, key)
        check(FIELDS, saved)
        age = age if age is not None and 0 <= age < inf else None  # a clock that was set tells no age
        self.forecaster.restore(saved["riding"])
        bias_x, bias_z = saved["gyro_bias"]
        self.motion.gyro_bias = bias_x, bias_z
        if saved["cell_temperature"] is not None and age is not None and age < CELLS_KEEP:
            self._temperatures.cells = saved["cell_temperature"]
        self.pack.restore(saved, age)
        self.forecaster.learner.pause(NEW_DAY if age is None else age)
