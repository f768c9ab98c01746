"""What lies ahead: the range, on a route where one is given, and while the pack is charged, when it is full."""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

from gz_onboard.estimator.charging import Charging
from gz_onboard.estimator.forecast import Forecast, Forecaster
from gz_onboard.estimator.load_model import Conditions
from gz_onboard.estimator.route import RouteForecaster
from gz_onboard.estimator.sources import PackReading
from gz_onboard.events import Activity, Estimate, Reason
from gz_onboard.physics.battery import Battery

PERIOD = 1.0  # s
EARLY = 0.05  # s: by so much a forecast may be made early, rather than a step late
LONGEST = 60.0  # s: more is not taken in of a pause
BEGUN_ANEW = 0.05  # of the state of charge: by so much nothing drawn changes it from one forecast to the next


class Now(NamedTuple):
    """What a forecast is made from."""

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
    """Makes a forecast each second, and keeps it."""

    def __init__(self, forecaster: Forecaster, battery: Battery, route: RouteForecaster) -> None:
        self.forecast: Forecast | None = None
        self._forecaster, self._battery, self._route = forecaster, battery, route
        self._charging = Charging()
        self._full: Forecast | None = None  # while it is charged
        self._time, self._soc = -inf, 0.0  # of the last forecast
        self._factor = 1.0, 0.0  # consumption factor and its sd, as of the forecast

    def due(self, now: float) -> bool:
        """Whether the next forecast is to be made at `now` [s]."""
        return now - self._time >= PERIOD - EARLY

    def outdate(self) -> None:
        """The next forecast is due at once: what the last one was made from is no longer so."""
        self._time = -inf

    @property
    def consumption(self) -> float | None:
        """That is to be expected [J/m]."""
        return self.forecast.consumption if self.forecast else None

    def step(self, now: Now) -> None:
        """Make the forecast of `now`."""
        elapsed, self._time = min(now.time - self._time, LONGEST), now.time
        known = now.temperature, now.temperature_sd, now.conditions.ambient, now.conditions.altitude
        free = self._forecaster.forecast(now.soc, now.soc_sd, *known, now.loss_variance)
        voltage, current = now.reading.voltage, now.reading.current
        charging = now.activity is Activity.CHARGING
        if abs(now.soc - self._soc) > BEGUN_ANEW * self._soc > 0:
            self._forecaster.calm.show_next()
        self._soc = now.soc
        drawn = None if charging or voltage is None or current is None else voltage * current * elapsed
        along = self._route.forecast(now.time, free, (now.soc, now.soc_sd), now.loss_variance, now.conditions)
        self.forecast = self._forecaster.shown(along, drawn)
        self._factor = self._forecaster.factor, sqrt(self._forecaster.riding.factor_variance)
        if charging and voltage and current is not None:
            self._charging.step(elapsed, self._battery, (voltage, current), now.soc, now.temperature)
            self._full = self._forecaster.forecast(self._battery.window.high, 0.0, *known)
        else:
            self._charging.end()
            self._full = None

    def report(self, estimate: Estimate) -> None:
        """Write into `estimate` what was forecast."""
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
            estimate.charge_power, estimate.time_to_full = self._charging.power, self._charging.to_full
            estimate.range_full = self._forecaster.calm.shown(self._full.range) if self._full else None
