"""Range: usable energy at the expected load and temperature over the price of the way ahead, with an interval.

The riding to expect comes from the learner (`consumption`), the energy from the pack's equations (`drawable`,
`warming`), the interval from the variances of both. The displayed range is smoothed here and only here. While the pack
is charged, the forecaster says when it will be full.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import ceil, exp, hypot, inf, log, sqrt
from typing import Any, NamedTuple

from gz_onboard.constants import DECILE, HOUR
from gz_onboard.estimator import consumption
from gz_onboard.estimator.battery_pack import BatteryPack
from gz_onboard.estimator.consumption import CONSUMPTION, ConsumptionLearner
from gz_onboard.estimator.load_model import Conditions
from gz_onboard.estimator.motion import MOTION
from gz_onboard.estimator.plausibility.electrical import PackReading
from gz_onboard.estimator.saved_state import Each, Number
from gz_onboard.events import Activity
from gz_onboard.model.battery import HALF_FULL, Battery
from gz_onboard.model.drawable import Drawable, cells_ahead, drawable, pack_constants
from gz_onboard.model.model import Model
from gz_onboard.model.riding import PriorRiding


@dataclass(frozen=True)
class ForecastConfig:
    """When and how ranges are computed and displayed, and how charges are followed."""

    period_s: float = 1.0  # between forecasts
    early_s: float = 0.05  # by which one may be made early, rather than a step late
    longest_s: float = 60.0  # of a pause that energy drawn is counted over
    soc_step: float = 0.05  # relative: no current changes the state of charge by more from one forecast to the next
    most_sd: float = 1.0  # of the logarithm of the range: beyond, nothing is known of it
    # Change of SOC, cells [degC], their sd, ambient [degC], logarithm of the power, form factor squared, capacity and
    # resistance from which a discharge is computed again; until then its energy moves along SOC and temperature. What
    # that leaves out, or each of the others, is worth about 0.05 % of the energy.
    discharge_step: tuple[float, ...] = (0.005, 0.5, 0.5, 0.5, 0.005, 0.02, 0.0005, 0.002)
    cells_stay: float = 0.65  # share of a change of the cells' temperature now that is in their mean on the way
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
    # Charging
    charger_cut_off: float = 0.05  # 1/h: current over capacity at which chargers of lithium-ion cells end
    slice: float = 0.01  # of SOC, over which the charging current counts as constant
    charger_settling_s: float = 20.0  # current is averaged over it: chargers ripple, and taper off in steps


FORECAST = ForecastConfig()
FIELDS = consumption.FIELDS | {  # of the saved state
    "shown": {"gap": Number(-1e6, 1e6), "forecast": Each(Number(0.0, 1e12), 2, optional=True)}  # m; m, J
}


def deciles(energy: float, down: float, up: float, variance: float) -> tuple[float, float]:
    """The energies [J] that would go as far as P10 and P90, at the consumption that is expected.

    energy: the median [J]; its sd downwards and upwards [J]; variance: of the logarithm of the consumption. The energy
    is normal, the consumption log-normal; deciles that each would give alone are added as sds are. So it is right for
    each alone, at any size, and nothing jumps where the energy becomes less than its own error.
    """
    if energy <= 0:
        return 0.0, DECILE * up
    spread, least = DECILE * sqrt(variance), 1 - DECILE * down / energy
    p10 = energy * exp(-hypot(spread, log(least))) if least > 0 else 0.0
    return p10, energy * exp(hypot(spread, log(1 + DECILE * up / energy)))


class Forecast(NamedTuple):
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
        """State to be kept over a restart; without the effect of a route, which is not kept."""
        if self._on_route or self._before is None:
            return {"gap": 0.0 if self._on_route else self.gap, "forecast": None}
        return {"gap": self.gap, "forecast": list(self._before)}

    @classmethod
    def restored(cls, saved: Mapping[str, Any]) -> RangeSmoother:
        """A smoother out of its `snapshot`, which was checked."""
        return cls(saved["gap"], tuple(saved["forecast"]) if saved["forecast"] else None)


def time_to_full(battery: Battery, soc: float, current: float, temperature: float) -> float | None:
    """Duration [s] of a charge from the cells' `soc`, at the charging `current` [A] now, positive into the pack.

    A charger holds its current until the cells reach the voltage of full ones, and then that voltage, at which the
    current falls (CC-CV). It ends where the vehicle shows 100 %, or at `charger_cut_off`. None if the current never
    fills the pack. temperature: of the cells [degC].
    """
    if current <= 0:
        return None
    full, capacity, width = battery.window.high, battery.pack_capacity(temperature), FORECAST.slice
    at_full, seconds = battery.ocv(1.0, temperature)[0], 0.0
    for k in range(int(soc / width), ceil(full / width)):  # the same slices from any SOC: no steps at the end
        low, high = max(soc, k * width), min((k + 1) * width, full)
        middle = (low + high) / 2
        r0, r1, _ = battery.circuit(middle, temperature)
        most = (at_full - battery.ocv(middle, temperature)[0]) / (r0 + r1) * battery.cells_parallel
        if most < FORECAST.charger_cut_off * capacity:
            break
        seconds += max(high - low, 0.0) * capacity * HOUR / min(current, most)
    return seconds


class _Discharge(NamedTuple):
    """A discharge and the inputs it was computed for, near which it holds."""

    inputs: tuple[float, ...]  # see `discharge_step`
    weakest: object  # group of cells
    cells: float  # degC
    left: Drawable
    lost_colder: float  # J less if the cells are colder by their sd


class Forecaster:
    """Forecasts the range of one vehicle."""

    def __init__(self, model: Model, battery: Battery, prior: PriorRiding, pack: BatteryPack | None = None) -> None:
        """pack: how it has aged; None: it is known to be as its file says, which is `battery`."""
        self.learner = ConsumptionLearner(model, battery, prior)
        self.load = self.learner.load
        self.new_battery, self._pack = battery, pack
        self.smoother = RangeSmoother()
        self.cooling = pack_constants(model.parameters)
        p = model.parameters
        self._cutoff_sd, self._empty_sd = p.sd("cell_cutoff_voltage"), p.sd("cell_voltage_error_empty")  # V
        self._discharge: _Discharge | None = None  # the last one
        self.latest: Forecast | None = None
        self._time, self._soc = -inf, 0.0  # of it
        self._factor = 1.0, 0.0  # consumption factor and its sd, as of it
        self._charge_power: float | None = None  # W into the pack; None unless charging
        self._charge_current = 0.0  # A into the pack
        self._to_full: float | None = None  # s
        self._full: Forecast | None = None  # while charging
        self._shown_at, self._rides = 0.0, 0  # distance [m] and rides of the learner at the last displayed forecast

    @property
    def battery(self) -> Battery:
        """The pack as it is believed to be now."""
        return self._pack.battery if self._pack else self.new_battery

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
        charge = soc * self.battery.pack_capacity(cell_temperature) * HOUR
        nominal = charge * self.battery.ocv(HALF_FULL)[0] * self.battery.cells_series  # J
        way = max(nominal / learner.prior_price, CONSUMPTION.segment_m)  # that it lasts, roughly
        expected = learner.expected(way, ambient, altitude)
        price = expected.consumption
        load = log(expected.power), expected.form_factor_squared
        discharge = self._discharged(soc, cell_temperature, temperature_sd, ambient, *load)
        left = discharge.left
        of_end = (
            (hypot(self.battery.window.sd, left.end_sd) * left.slope) ** 2
            + min(discharge.lost_colder, left.energy) ** 2
            # The cut-off at which vehicles were seen to give up includes the error of an empty cell's voltage.
            + (self._cutoff_sd**2 + max(self._empty_sd, left.end_drop_sd) ** 2) * left.by_cutoff**2
        )
        fresh = hypot(soc_sd * left.slope, self.battery.capacity_sd * left.energy)
        pack, of_pack = self._pack, (fresh, fresh)
        if pack:
            of_pack = pack.age.energy_sd(pack.state, left.energy, left.slope, soc_sd)
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
            recent=expected.recent,
            mostly_prior=expected.mostly_prior,
            power=exp(discharge.inputs[4]),  # that the energy was computed for
            form_factor_squared=discharge.inputs[5],
            cells=discharge.cells,
            known_from=learner.state.habits.price.known_from,
        )

    def _discharged(self, *now: float) -> _Discharge:
        """The discharge from these inputs, as in `discharge_step`: the last one, moved a little, or a new one."""
        health, last = self.battery.health, self._discharge
        inputs = *now, health.capacity, health.resistance
        if last and last.weakest == health.weakest and last.left.energy > last.left.slope * FORECAST.discharge_step[0]:
            moved = [x - before for x, before in zip(inputs, last.inputs, strict=True)]
            if all(abs(x) < step for x, step in zip(moved, FORECAST.discharge_step, strict=True)):
                energy = last.left.energy + last.left.slope * moved[0]
                if sd := last.inputs[2]:
                    energy += FORECAST.cells_stay * last.lost_colder / sd * moved[1]
                return last._replace(left=last.left._replace(energy=energy))
        soc, temperature, sd, ambient, log_power, form_factor_squared = now
        load, battery = (exp(log_power), form_factor_squared), self.battery
        lost = self.load.overpotential(battery)
        cells = cells_ahead(battery, self.cooling, (soc, temperature), ambient, load, lost)
        left, colder = (drawable(battery, soc, at, *load, lost) for at in (cells, cells - sd))
        self._discharge = _Discharge(inputs, health.weakest, cells, left, left.energy - colder.energy)
        return self._discharge

    def step(
        self,
        now: float,
        soc: tuple[float, float],
        cells: tuple[float, float],
        conditions: Conditions,
        loss_variance: float,
        reading: PackReading,
        activity: Activity,
        along: Callable[[Forecast], Forecast],
    ) -> Forecast:
        """Make the forecast of `now` [s] and keep it as `latest`; along: makes it one along a route.

        soc, cells: state of charge, and the cells' temperature [degC], each with its sd; loss_variance: see `forecast`.
        """
        elapsed, self._time = min(now - self._time, FORECAST.longest_s), now
        air = conditions.ambient, conditions.altitude
        free = self.forecast(*soc, *cells, *air, loss_variance)
        voltage, current, charging = reading.voltage, reading.current, activity is Activity.CHARGING
        if abs(soc[0] - self._soc) > FORECAST.soc_step * self._soc > 0:
            self.smoother.show_next()
        self._soc = soc[0]
        drawn = None if charging or voltage is None or current is None else voltage * current * elapsed
        self.latest = self.shown(along(free), drawn)
        self._factor = self.learner.consumption_factor, sqrt(self.learner.state.habits.factor.variance)
        if charging and voltage and current is not None:
            self._follow_charge(elapsed, soc[0], cells[0], voltage, current)
            self._full = self.forecast(self.battery.window.high, 0.0, *cells, *air)
        else:
            self._charge_power = self._to_full = self._full = None
        return self.latest

    @property
    def consumption(self) -> float | None:
        """Expected consumption [J/m]."""
        return self.latest.consumption if self.latest else None

    def due(self, now: float) -> bool:
        """Whether the next forecast is due at `now` [s]."""
        return now - self._time >= FORECAST.period_s - FORECAST.early_s

    def outdate(self) -> None:
        """Make the next forecast due at once: the last one's basis no longer holds."""
        self._time = -inf

    def _follow_charge(self, elapsed: float, soc: float, temperature: float, voltage: float, current: float) -> None:
        """Follow a charge for `elapsed` [s]; current [A] positive discharging, temperature [degC] of the cells."""
        share = 1.0 if self._charge_power is None else elapsed / (elapsed + FORECAST.charger_settling_s)
        self._charge_current += share * (-current - self._charge_current)
        self._charge_power = max(voltage * self._charge_current, 0.0)
        # While less flows, as in a pause, the time to full is unknown.
        flows = -current > MOTION.charging_rate * self.battery.pack_capacity(temperature)
        self._to_full = time_to_full(self.battery, soc, self._charge_current, temperature) if flows else None

    def report(self, charging: bool) -> dict[str, Any]:
        """Return the fields of an estimate that the latest forecast gives; charging: with those of a charge."""
        forecast = self.latest
        if forecast is None:
            return {}
        factor, factor_sd = self._factor
        of_charge = {
            "charge_power": self._charge_power,
            "time_to_full": self._to_full,
            "range_full": self.smoother.shown(self._full.range) if self._full else None,
        }
        return {
            "range": forecast.range,
            "range_p10": forecast.p10,
            "range_p90": forecast.p90,
            "energy_left": forecast.energy,
            "energy_left_sd": forecast.energy_sd,
            "consumption_expected": forecast.consumption,
            "consumption_expected_sd": forecast.consumption_sd,
            "consumption_recent": forecast.recent,
            "consumption_factor": factor,
            "consumption_factor_sd": factor_sd,
        } | (of_charge if charging else {})

    def shown(self, forecast: Forecast, drawn: float | None = None) -> Forecast:
        """`forecast` with the range to display; to be asked once for each. drawn: see `RangeSmoother.follow`.

        P10 and P90 are those of the newest forecast, as they must follow the latest learning. They also enclose
        the displayed range: where that falls towards P10, P10 stays below it.
        """
        learner = self.learner
        if self._rides != learner.rides:
            self._rides = learner.rides
            self.smoother.begin_ride()
        ridden, self._shown_at = learner.distance - self._shown_at, learner.distance
        way = self.smoother.follow(forecast.range, forecast.energy, forecast.known_from, ridden, drawn)
        below = sqrt(forecast.p10 / forecast.range) if forecast.range else 0.0
        return forecast._replace(range=way, p10=min(forecast.p10, way * below), p90=max(forecast.p90, way))

    def snapshot(self) -> dict[str, Any]:
        """State to be kept over a restart."""
        return self.learner.snapshot() | {"shown": self.smoother.snapshot()}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Take a `snapshot`, which was checked against `FIELDS`; ValueError for habits that no riding teaches."""
        self.learner.restore(saved)
        self.smoother = RangeSmoother.restored(saved["shown"])
