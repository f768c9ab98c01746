"""The latest forecast, on a route where one is given, and while the pack is charged, when it will be full."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, inf, sqrt
from typing import NamedTuple

from gz_onboard.constants import HOUR
from gz_onboard.estimator.forecast import Forecast, Forecaster
from gz_onboard.estimator.load_model import Conditions
from gz_onboard.estimator.motion import MOTION
from gz_onboard.estimator.route import RouteForecaster
from gz_onboard.estimator.sources import PackReading
from gz_onboard.events import Activity, Estimate, Reason
from gz_onboard.physics.battery import Battery


@dataclass(frozen=True)
class OutlookConfig:
    """When forecasts are made, and how charges are followed."""

    period_s: float = 1.0  # between forecasts
    early_s: float = 0.05  # by which one may be made early, rather than a step late
    longest_s: float = 60.0  # of a pause that energy drawn is counted over
    soc_step: float = 0.05  # relative: no current changes the state of charge by more from one forecast to the next
    charger_cut_off: float = 0.05  # 1/h: current over capacity at which chargers of lithium-ion cells end
    slice: float = 0.01  # of SOC, over which the charging current counts as constant
    charger_settling_s: float = 20.0  # current is averaged over it: chargers ripple, and taper off in steps


OUTLOOK = OutlookConfig()


def time_to_full(battery: Battery, soc: float, current: float, temperature: float) -> float | None:
    """Duration [s] of a charge from the cells' `soc`, at the charging `current` [A] now, positive into the pack.

    A charger holds its current until the cells reach the voltage of full ones, and then that voltage, at which the
    current falls (CC-CV). It ends where the vehicle shows 100 %, or at `charger_cut_off`. None if the current never
    fills the pack. temperature: of the cells [degC].
    """
    if current <= 0:
        return None
    full, capacity, width = battery.window.high, battery.pack_capacity(temperature), OUTLOOK.slice
    at_full, seconds = battery.ocv(1.0, temperature)[0], 0.0
    for k in range(int(soc / width), ceil(full / width)):  # the same slices from any SOC: no steps at the end
        low, high = max(soc, k * width), min((k + 1) * width, full)
        middle = (low + high) / 2
        r0, r1, _ = battery.circuit(middle, temperature)
        most = (at_full - battery.ocv(middle, temperature)[0]) / (r0 + r1) * battery.cells_parallel
        if most < OUTLOOK.charger_cut_off * capacity:
            break
        seconds += max(high - low, 0.0) * capacity * HOUR / min(current, most)
    return seconds


class Now(NamedTuple):
    """Inputs of a forecast."""

    time: float  # s
    soc: float
    soc_sd: float
    temperature: float  # degC, of the cells
    temperature_sd: float
    conditions: Conditions
    loss_variance: float  # see `Forecaster.forecast`
    reading: PackReading
    activity: Activity


class Outlook:
    """Makes a forecast each second and keeps it."""

    def __init__(self, forecaster: Forecaster, battery: Battery, route: RouteForecaster) -> None:
        self.forecast: Forecast | None = None
        self._forecaster, self._battery, self._route = forecaster, battery, route
        self._charge_power: float | None = None  # W into the pack; None unless charging
        self._charge_current = 0.0  # A into the pack
        self._to_full: float | None = None  # s
        self._full: Forecast | None = None  # while charging
        self._time, self._soc = -inf, 0.0  # of the last forecast
        self._factor = 1.0, 0.0  # consumption factor and its sd, as of the forecast

    def due(self, now: float) -> bool:
        """Whether the next forecast is due at `now` [s]."""
        return now - self._time >= OUTLOOK.period_s - OUTLOOK.early_s

    def outdate(self) -> None:
        """Make the next forecast due at once: the last one's basis no longer holds."""
        self._time = -inf

    @property
    def consumption(self) -> float | None:
        """Expected consumption [J/m]."""
        return self.forecast.consumption if self.forecast else None

    def step(self, now: Now) -> None:
        """Make the forecast of `now`."""
        elapsed, self._time = min(now.time - self._time, OUTLOOK.longest_s), now.time
        known = now.temperature, now.temperature_sd, now.conditions.ambient, now.conditions.altitude
        forecaster, learner = self._forecaster, self._forecaster.learner
        free = forecaster.forecast(now.soc, now.soc_sd, *known, now.loss_variance)
        voltage, current = now.reading.voltage, now.reading.current
        charging = now.activity is Activity.CHARGING
        if abs(now.soc - self._soc) > OUTLOOK.soc_step * self._soc > 0:
            forecaster.smoother.show_next()
        self._soc = now.soc
        drawn = None if charging or voltage is None or current is None else voltage * current * elapsed
        along = self._route.forecast(now.time, free, (now.soc, now.soc_sd), now.loss_variance, now.conditions)
        self.forecast = forecaster.shown(along, drawn)
        self._factor = learner.consumption_factor, sqrt(learner.habits.factor.variance)
        if charging and voltage and current is not None:
            self._charge(elapsed, now, voltage, current)
            self._full = forecaster.forecast(self._battery.window.high, 0.0, *known)
        else:
            self._charge_power = self._to_full = self._full = None

    def _charge(self, elapsed: float, now: Now, voltage: float, current: float) -> None:
        """Follow a charge for `elapsed` [s]; current [A] positive discharging."""
        share = 1.0 if self._charge_power is None else elapsed / (elapsed + OUTLOOK.charger_settling_s)
        self._charge_current += share * (-current - self._charge_current)
        self._charge_power = max(voltage * self._charge_current, 0.0)
        # While less flows, as in a pause, the time to full is unknown.
        flows = -current > MOTION.charging_rate * self._battery.pack_capacity(now.temperature)
        to_full = time_to_full(self._battery, now.soc, self._charge_current, now.temperature)
        self._to_full = to_full if flows else None

    def report(self, estimate: Estimate) -> None:
        """Write the forecast into `estimate`."""
        self._route.report(estimate)
        forecast = self.forecast
        if forecast is None:
            return
        estimate.range, estimate.range_p10, estimate.range_p90 = forecast.range, forecast.p10, forecast.p90
        estimate.energy_left, estimate.energy_left_sd = forecast.energy, forecast.energy_sd
        estimate.consumption_expected = forecast.consumption
        estimate.consumption_expected_sd = forecast.consumption_sd
        estimate.consumption_recent = forecast.recent
        estimate.consumption_factor, estimate.consumption_factor_sd = self._factor
        if forecast.mostly_prior:
            estimate.reasons |= Reason.PRIOR_RIDING
        if estimate.activity is Activity.CHARGING:  # not of a bus that fell silent
            estimate.charge_power, estimate.time_to_full = self._charge_power, self._to_full
            estimate.range_full = self._forecaster.smoother.shown(self._full.range) if self._full else None
