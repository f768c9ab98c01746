"""Range: usable energy at the expected load and temperature over the price of the way ahead, with an interval.

The riding to expect comes from the learner (`consumption`), the energy from the pack's equations (`drawable`,
`warming`), the interval from the variances of both (`interval`). The displayed range is smoothed here and only here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import exp, hypot, log, sqrt
from typing import Any

from gz_onboard.constants import HOUR
from gz_onboard.estimator import consumption
from gz_onboard.estimator.ageing import Ageing
from gz_onboard.estimator.consumption import CONSUMPTION, ConsumptionLearner
from gz_onboard.estimator.interval import DECILE, deciles
from gz_onboard.estimator.load_model import AHEAD
from gz_onboard.estimator.saved_fields import Each, Number
from gz_onboard.physics.battery import HALF_FULL, Battery
from gz_onboard.physics.drawable import Drawable, cells_ahead, drawable, pack_constants
from gz_onboard.physics.model import Model
from gz_onboard.physics.riding import PriorRiding


@dataclass(frozen=True)
class ForecastConfig:
    """How ranges are computed and displayed."""

    most_sd: float = 1.0  # of the logarithm of the range: beyond, nothing is known of it
    # Change of SOC, cells [degC], their sd, ambient [degC], logarithm of the power and form factor squared from which a
    # discharge is computed again: each is worth about 0.05 % of the energy
    discharge_step: tuple[float, ...] = (0.002, 0.1, 0.2, 0.5, 0.005, 0.02)
    # Smoothing of the displayed range
    length_m: float = 6000.0  # the errors of forecasts so near to each other are nearly the same error
    near_empty: float = 3.0  # the gap closes over the range over this: the error shrinks as the range does
    at_first: float = 2.0  # the gap closes over the riding that the forecast is known from over this
    first_m: float = 250.0  # over which it closes at first
    settled_m: float = 1500.0  # of a ride, and of the riding known: from there on the display is limited
    most_change: float = 0.85  # of the distance ridden: it neither rises while riding nor falls twice as fast
    most_change_range_m: float = 80_000.0  # the same for ranges above 68 km: a share of the range per metre
    large_gap: float = 0.45  # of the forecast: a rider must be warned in time
    still_m: float = 0.1  # from one forecast to the next: noise of a speed sensor at standstill
    held: float = 0.05  # of the range: changes of the forecast at standstill that wait for riding
    most_ratio: float = 2.0  # displayed over forecast, or forecast over displayed


FORECAST = ForecastConfig()
FIELDS = consumption.FIELDS | {
    "shown": {"gap": Number(-1e6, 1e6), "forecast": Each(Number(0.0, 1e12), 2, optional=True)}  # m; m, J
}
"""Of the saved state: what was learned of the riding."""


@dataclass(frozen=True)
class Forecast:
    """Range and the quantities it follows from; SI units."""

    range: float
    p10: float
    p90: float
    left: Drawable
    energy_sd: float  # downwards
    energy_sd_up: float
    consumption: float  # J/m
    consumption_sd: float
    recent: float | None  # J/m, measured over about the last kilometre
    mostly_prior: bool
    power: float  # W, mean of the riding expected
    form_factor_squared: float
    cells: float  # degC, their mean on the way that is left
    known_from: float  # m: riding that would tell as much of the way to come

    @property
    def energy(self) -> float:
        """Usable energy [J]."""
        return self.left.energy


class RangeSmoother:
    """Displayed range: falls with the distance ridden and closes its gap to the forecast over some riding.

    The errors of successive forecasts are nearly the same error, so each metre closes a share of the gap: the Kalman
    filter of a constant, ridden plus remaining, seen through an error that fades over 6 km. It closes faster at first,
    while the forecast itself follows each kilometre, and near empty. Once a ride and the forecast have settled, the
    displayed range never rises while riding, unless the gap is large.

    At standstill there is no riding to close a gap: the display falls by the energy drawn. Other changes of the
    forecast, such as a rest that shows the state of charge, wait for riding, up to a twentieth of the range. While the
    pack is charged the gap stays as it is, in metres. A restart is a standstill whose drawn energy is the difference.
    """

    def __init__(self, gap: float = 0.0, before: tuple[float, float] | None = None) -> None:
        """gap: displayed range minus forecast [m]; before: the last forecast's range [m] and energy [J]."""
        self.gap = gap
        self._before = before
        self._restarted = before is not None
        self._settled = self._on_route = False
        self._way = 0.0  # m of this ride

    def begin_ride(self) -> None:
        """Begin another ride: a gap left by the last one closes in its first kilometres."""
        self._settled, self._way = False, 0.0

    def show_next(self, *, on_route: bool = False) -> None:
        """Display the next forecast as it is: it has another basis, such as a route or a new state of charge."""
        self._before, self.gap, self._on_route = None, 0.0, on_route

    def shown(self, raw: float) -> float:
        """Range to display [m] with the present gap, for a forecast of `raw` [m]."""
        return min(max(raw + self.gap, raw / FORECAST.most_ratio), raw * FORECAST.most_ratio)

    def follow(self, raw: float, energy: float, known: float, ridden: float, drawn: float | None = None) -> float:
        """Range to display [m] for a forecast of `raw` [m] with `energy` [J].

        known: riding that the forecast is known from [m]; ridden: since the last one [m]; drawn: from the pack since
        then [J], None if unknown or while charging.
        """
        c, before, restarted = FORECAST, self._before, self._restarted
        self._before, self._restarted = (raw, energy), False
        if before is None or min(raw, energy, *before) <= 0:
            return self.shown(raw)
        if restarted:
            self.gap *= min(energy / before[1], 1.0)  # it belonged to a longer way
            drawn = before[1] - energy
            if abs(drawn) > c.held * before[1]:  # charged, or used by another
                return self.shown(raw)
        displayed = self.shown(before[0])
        if ridden < c.still_m:
            if drawn is not None and drawn < before[1]:
                most = max(abs(self.gap), c.held * raw)
                self.gap = min(max(displayed * (1 - drawn / before[1]) - raw, -most), most)
            return self.shown(raw)
        gap = displayed - ridden - raw
        length = max(min(known / c.at_first, c.length_m, raw / c.near_empty), c.first_m)
        closed = gap * (1 - exp(-ridden / length))
        self._way += ridden
        self._settled |= min(known, self._way) >= c.settled_m
        if self._settled and gap <= c.large_gap * raw:
            most = ridden * max(c.most_change, raw / c.most_change_range_m)
            closed = min(max(closed, -most), most)
        self.gap = gap - closed
        return self.shown(raw)

    def snapshot(self) -> dict[str, object]:
        """State to be kept over a restart; without what a route has made of it, as that is not kept."""
        if self._on_route or self._before is None:
            return {"gap": 0.0 if self._on_route else self.gap, "forecast": None}
        return {"gap": self.gap, "forecast": list(self._before)}

    @classmethod
    def restored(cls, saved: Mapping[str, Any]) -> RangeSmoother:
        """A smoother out of its `snapshot`, which was checked."""
        return cls(saved["gap"], tuple(saved["forecast"]) if saved["forecast"] else None)


@dataclass(frozen=True, slots=True)
class _Discharge:
    """A discharge and the inputs it was computed for, near which it holds."""

    inputs: tuple[float, ...]  # see `discharge_step`
    health: tuple[object, ...]
    cells: float  # degC
    left: Drawable
    lost_colder: float  # J less if the cells are colder by their sd


class Forecaster:
    """Forecasts the range of one vehicle."""

    def __init__(self, model: Model, battery: Battery, prior: PriorRiding) -> None:
        self.learner = ConsumptionLearner(model, battery, prior)
        self.load = self.learner.load
        self.battery = battery
        self.smoother = RangeSmoother()
        self.ageing: Ageing | None = None  # None: the pack is known to be as its file says
        self.cooling = pack_constants(model.parameters)
        self._overpotential = model.overpotential(battery, {"vibration": prior.vibration, "time_moving": AHEAD})
        p = model.parameters
        self._cutoff_sd, self._empty_sd = p.sd("cell_cutoff_voltage"), p.sd("cell_voltage_error_empty")  # V
        self._discharge: _Discharge | None = None  # the last one
        self._shown_at, self._rides = 0.0, 0  # distance [m] and rides of the learner at the last displayed forecast

    def forget(self, distance: float) -> None:
        """Unlearn the last `distance` [m]: a sensor that it was learned, and the display computed, from is faulty."""
        self.learner.forget(distance)
        self.smoother = RangeSmoother()

    def ridden_by(self, rider: str) -> None:
        """Have `rider` ride from now on."""
        if rider != self.learner.rider:
            self.learner.ridden_by(rider)
            self.smoother = RangeSmoother()

    def forecast(
        self,
        soc: float,
        soc_sd: float,
        cell_temperature: float,
        temperature_sd: float,
        ambient: float,
        altitude: float,
        loss_variance: float = 0.0,
    ) -> Forecast:
        """The range from this state of the battery, with the riding known so far.

        Temperatures and their sd in degC, altitude in m; loss_variance: relative variance that missing sensors add to
        the consumption.
        """
        learner = self.learner
        expected = learner.expected(self._rough_way(soc, cell_temperature), ambient, altitude)
        price = expected.consumption
        load = log(expected.power), expected.form_factor_squared
        discharge = self._discharged((soc, cell_temperature, temperature_sd, ambient, *load))
        left = discharge.left
        of_end = (
            (hypot(self.battery.window.sd, left.end_sd) * left.slope) ** 2
            + min(discharge.lost_colder, left.energy) ** 2
            # The cut-off at which vehicles were seen to give up includes the error of an empty cell's voltage.
            + (self._cutoff_sd**2 + max(self._empty_sd, left.end_drop_sd) ** 2) * left.by_cutoff**2
        )
        fresh = hypot(soc_sd * left.slope, self.battery.capacity_sd * left.energy)
        of_pack = self.ageing.energy_sd(left.energy, left.slope, soc_sd) if self.ageing else (fresh, fresh)
        down, up = (sqrt(of_end + sd * sd) for sd in of_pack)
        variance = min(loss_variance + expected.variance, FORECAST.most_sd**2)
        p10, p90 = deciles(left.energy, down, up, variance)
        return Forecast(
            range=left.energy / price,
            p10=p10 / price,
            p90=min(p90 / price, (left.energy + DECILE * up) / expected.least),
            left=left,
            energy_sd=down,
            energy_sd_up=up,
            consumption=price,
            consumption_sd=price * sqrt(variance),
            recent=learner.recent_consumption,
            mostly_prior=learner.mostly_prior,
            power=exp(discharge.inputs[4]),  # that the energy was computed for
            form_factor_squared=discharge.inputs[5],
            cells=discharge.cells,
            known_from=learner.habits.price.known_from,
        )

    def _discharged(self, inputs: tuple[float, ...]) -> _Discharge:
        """The discharge from `inputs`, as in `discharge_step`: the last one, moved along SOC, or a new one."""
        health, last = self.battery.health, self._discharge
        aged = health.capacity, health.resistance, health.weakest
        if last and last.health == aged and last.left.energy > last.left.slope * FORECAST.discharge_step[0]:
            moved = zip(inputs, last.inputs, FORECAST.discharge_step, strict=True)
            if all(abs(x - before) < step for x, before, step in moved):
                energy = last.left.energy + last.left.slope * (inputs[0] - last.inputs[0])
                return replace(last, left=replace(last.left, energy=energy))
        soc, temperature, sd, ambient, log_power, form_factor_squared = inputs
        load = exp(log_power), form_factor_squared
        cells = cells_ahead(self.battery, self.cooling, (soc, temperature), ambient, load, self._overpotential)
        left, colder = (drawable(self.battery, soc, at, *load, self._overpotential) for at in (cells, cells - sd))
        self._discharge = _Discharge(inputs, aged, cells, left, left.energy - colder.energy)
        return self._discharge

    def _rough_way(self, soc: float, temperature: float) -> float:
        """Distance that the charge lasts [m], roughly: by the battery's nominal energy and the prior's price."""
        charge = soc * self.battery.pack_capacity(temperature) * HOUR
        energy = charge * self.battery.ocv(HALF_FULL)[0] * self.battery.cells_series
        return max(energy / self.learner.prior_price, CONSUMPTION.segment_m)

    def shown(self, forecast: Forecast, drawn: float | None = None) -> Forecast:
        """`forecast` with the range to display; to be asked once for each. drawn: see `RangeSmoother.follow`.

        P10 and P90 are those of the newest forecast, as they must follow what it has just learned. They also enclose
        the displayed range: where that falls towards P10, P10 stays below it.
        """
        learner = self.learner
        if self._rides != learner.rides:
            self._rides = learner.rides
            self.smoother.begin_ride()
        ridden, self._shown_at = learner.distance - self._shown_at, learner.distance
        way = self.smoother.follow(forecast.range, forecast.energy, forecast.known_from, ridden, drawn)
        below = sqrt(forecast.p10 / forecast.range) if forecast.range else 0.0
        return replace(forecast, range=way, p10=min(forecast.p10, way * below), p90=max(forecast.p90, way))

    def snapshot(self) -> dict[str, Any]:
        """State to be kept over a restart."""
        return self.learner.snapshot() | {"shown": self.smoother.snapshot()}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Take a `snapshot`, which was checked against `FIELDS`; ValueError for habits that no riding teaches."""
        self.learner.restore(saved)
        self.smoother = RangeSmoother.restored(saved["shown"])
