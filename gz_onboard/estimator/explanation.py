"""Explanation of the range: its difference from another range, split among causes that add up to it.

The range is E/c, the energy that can be drawn over the consumption expected. It is evaluated with some causes as they
are now and the others as they were. A cause counts with its effect in one order of the causes and in the reverse
order, on average. That is its Shapley value as far as causes act alone or in pairs, and it always adds up.

The consumption is that of the prior riding in the same air, times the parts of the present riding in that unit:

    SPEED     keeping the speeds ridden, on a level and straight road without wind
    CLIMB     hills like those ridden, up and down again; and those of a route ahead
    TURNING   bends
    WIND      a steady wind over the land, averaged over all headings, if the model knows one
    STOPS     what else the learner has modelled and measured: accelerating, braking and standing

The first four are modelled at the mean squares of speed, grade and lateral acceleration of the last kilometres. Energy
stored in height and speed is given back and costs nothing. The rated range, which the present one is compared with, is
that of the vehicle file's prior riding in mild air, without hills and wind, with its payload and its consumption
factor, and of a full battery as new, at the same temperature.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import sqrt

from gz_onboard.constants import MILD
from gz_onboard.estimator.consumption import CONSUMPTION
from gz_onboard.estimator.forecast import Forecast, Forecaster
from gz_onboard.estimator.load_model import USUAL_AIR, Conditions, LoadModel
from gz_onboard.events import Cause, Explanation
from gz_onboard.model.battery import Battery
from gz_onboard.model.drawable import cells_ahead, drawable
from gz_onboard.model.model import Model


@dataclass(frozen=True)
class ExplanationConfig:
    """When the range is explained, and from how much riding."""

    interval_s: float = 180.0  # between explanations: one takes as long as a few forecasts
    min_change_m: float = 100.0  # a range that has changed by less is not explained again
    change_m: float = 1000.0  # so much more or less than the distance ridden is a change of the range
    settling_s: float = 60.0  # a change that is undone within does not count
    max_changes: int = 100  # that are kept
    riding_m: float = 1000.0  # of riding that counts as much as the prior riding


CONFIG = ExplanationConfig()
Parts = dict[Cause, float]
MODELLED = Cause.SPEED, Cause.STOPS, Cause.CLIMB, Cause.TURNING, Cause.WIND
OF_COST = (Cause.TEMPERATURE, Cause.PAYLOAD, *MODELLED, Cause.AUXILIARIES, Cause.UNEXPLAINED, Cause.RIDING)
OF_ENERGY = Cause.TEMPERATURE, Cause.AGE, Cause.SPEED, Cause.STOPS


@dataclass(frozen=True)
class RangeState:
    """One range, and all that it follows from; SI units, temperatures in degC."""

    time: float
    ridden: float  # m, since the start
    range: float
    consumption: float
    power: float  # W, mean of the riding expected
    form_factor_squared: float
    soc: float
    cells: float  # their temperature
    battery: Battery
    unit: float  # J/m, of the prior riding in this air with the payload entered
    payload: float  # prior riding with this payload over that with the one entered
    parts: Parts  # of the riding, modelled, in that unit
    factor: float  # measured over modelled consumption, with `auxiliaries`
    auxiliaries: float  # what auxiliaries beyond the model's make of the factor
    hills: float  # J/m: how much more those of a route ahead take than hills like those ridden
    to_come: float  # consumption expected, without those hills, over that of the riding by factor and parts


class RangeExplainer:
    """Explains the range of one vehicle. `latest`: against the rated range; `changes`: what moved it, the last few."""

    def __init__(self, forecaster: Forecaster) -> None:
        self._forecaster, self._load = forecaster, forecaster.load
        self._new = forecaster.new_battery
        self._since: RangeState | None = None
        self._forgotten: set[str] = set()  # roles, since then
        self._news: deque[tuple[bool, Explanation]] = deque(maxlen=CONFIG.max_changes)
        self.latest: Explanation | None = None
        self.changes: deque[Explanation] = deque(maxlen=CONFIG.max_changes)
        model = self._load.model
        calm = Model(tuple(x for x in model.effects if "heading" not in x.reads), model.parameters)
        self._calm = LoadModel(calm, self._new, self._load.prior)

    def take(
        self,
        now: float,
        forecast: Forecast,
        soc: float,
        air: Conditions,
        ridden: float,
        hills: tuple[float, float] = (0.0, 0.0),
        charging: bool = False,
    ) -> None:
        """Take in the forecast of `now` [s], and explain it if that is due.

        ridden: [m], since the start. hills: of a route ahead, see `RouteForecaster`. charging: a charge is one change,
        explained when it is over.
        """
        last, since = self.latest, self._since
        moved = since and abs(forecast.range + ridden - since.range - since.ridden) > CONFIG.change_m
        if since and moved and not charging and now - since.time >= CONFIG.settling_s:
            self._since = self.state(now, forecast, soc, air, ridden, hills)
            change = replace(self.explain(since, self._since), forgotten=tuple(sorted(self._forgotten)))
            self._forgotten.clear()
            self._news.append((True, change))
            self.changes.append(change)
        if last is None or (
            now - last.time >= CONFIG.interval_s and abs(forecast.range - last.range) > CONFIG.min_change_m
        ):
            state = self.state(now, forecast, soc, air, ridden, hills)
            self._since = self._since or state
            self.latest = self.explain(self.rated, state)
            self._news.append((False, self.latest))

    def forget(self, roles: Iterable[str]) -> None:
        """Name these roles with the next change: they are found faulty, and the learning from them is forgotten."""
        self._forgotten.update(roles)

    def news(self) -> list[tuple[bool, Explanation]]:
        """Explanations since the last call: (whether it is a change, explanation)."""
        news = list(self._news)
        self._news.clear()
        return news

    def state(
        self,
        now: float,
        forecast: Forecast,
        soc: float,
        air: Conditions,
        ridden: float,
        hills: tuple[float, float] = (0.0, 0.0),
    ) -> RangeState:
        """The state that the range of a `forecast` follows from; see `take`."""
        learner = self._forecaster.learner
        known = forecast.range > 0 and forecast.energy > 0
        consumption = forecast.energy / forecast.range if known else forecast.consumption
        unit, parts = sum(self._load.prior_prices(air.ambient, air.altitude)), self._parts()
        riding = unit * learner.consumption_factor
        ahead = (hills[0] - hills[1] * riding * parts[Cause.CLIMB]) / forecast.range if known else 0.0
        return RangeState(
            time=now,
            ridden=ridden,
            range=forecast.range,
            consumption=consumption,
            power=forecast.power,
            form_factor_squared=forecast.form_factor_squared,
            soc=soc,
            cells=forecast.cells,
            battery=self._forecaster.battery,
            unit=unit,
            payload=1.0,
            parts=parts,
            factor=learner.consumption_factor,
            auxiliaries=learner.auxiliary_factor,
            hills=ahead,
            to_come=(consumption - ahead) / (riding * sum(parts.values())),
        )

    @cached_property
    def rated(self) -> RangeState:
        """The range to compare with: see above."""
        load, battery = self._load, self._new
        p, prior, parts = load.model.parameters, load.prior, self._prior_parts | {Cause.CLIMB: 0.0, Cause.WIND: 0.0}
        unit = sum(load.prior_prices(*USUAL_AIR))
        filed = sum(load.prior_prices(*USUAL_AIR, p["vehicle_mass"] + p.filed("payload_mass"))) / unit
        soc, form_factor_squared = battery.window.of_cells(1.0), CONSUMPTION.form_factor_squared
        consumption = unit * filed * prior.factor * sum(parts.values())
        power = consumption * prior.speed
        cooling, lost = self._forecaster.cooling, self._load.overpotential(battery)
        cells = cells_ahead(battery, cooling, (soc, MILD), MILD, (power, form_factor_squared), lost)
        state = RangeState(
            time=0.0,
            ridden=0.0,
            range=0.0,
            consumption=consumption,
            power=power,
            form_factor_squared=form_factor_squared,
            soc=soc,
            cells=cells,
            battery=battery,
            unit=unit,
            payload=filed,
            parts=parts,
            factor=prior.factor,
            auxiliaries=0.0,
            hills=0.0,
            to_come=1.0,
        )
        return replace(state, range=self._energy(state, state) / consumption)

    def explain(self, a: RangeState, b: RangeState) -> Explanation:
        """The range of `b` against that of `a`; unless `a` is the rated one, the distance ridden between is added."""
        ridden = 0.0 if a is self.rated else b.ridden - a.ridden
        causes = dict.fromkeys((cause for cause in Cause if cause), 0.0)
        start, end = self._energy(a, b), self._energy(a, b, OF_ENERGY)
        # The change of E/c is a sum over changes of E and of c, each times a mean of the divisor.
        per_energy = (1 / a.consumption + 1 / b.consumption) / 2
        per_cost = -(start + end) / 2 / (a.consumption * b.consumption)
        self._split(causes, OF_ENERGY, per_energy, lambda changed: self._energy(a, b, changed))
        # The power is consumption times mean speed: each cause of the one has its share, the other is the speed's.
        more, speed = b.power - a.power, (a.power / a.consumption + b.power / b.consumption) / 2
        by_cost = causes[Cause.SPEED] * speed / more if more else 0.0
        causes[Cause.SPEED] -= by_cost * (b.consumption - a.consumption)
        self._split(causes, OF_COST, per_cost + by_cost, lambda changed: self._cost(a, b, changed))
        causes[Cause.CHARGE] = b.range + ridden - a.range - sum(causes.values())
        return Explanation(b.time, a.range, b.range + ridden, causes)

    @staticmethod
    def _split(
        causes: Parts, among: Sequence[Cause], weight: float, value: Callable[[Collection[Cause]], float]
    ) -> None:
        """Add to `causes`, times `weight`, how the value with all of `among` changed differs from that with none."""
        for order in (among, among[::-1]):
            values = [value(order[:n]) for n in range(len(order) + 1)]
            for cause, before, after in zip(order, values, values[1:], strict=False):
                causes[cause] += weight * (after - before) / 2

    def _energy(self, a: RangeState, b: RangeState, changed: Collection[Cause] = ()) -> float:
        """Energy [J] that can be drawn at the charge of `b`; causes in `changed` as in `b`, the others as in `a`."""
        battery, cells = (b if Cause.AGE in changed else a).battery, (b if Cause.TEMPERATURE in changed else a).cells
        power = (b if Cause.SPEED in changed else a).power
        form_factor_squared = (b if Cause.STOPS in changed else a).form_factor_squared
        return drawable(battery, b.soc, cells, power, form_factor_squared, self._load.overpotential(battery)).energy

    def _cost(self, a: RangeState, b: RangeState, changed: Collection[Cause]) -> float:
        """Consumption [J/m]; causes in `changed` as in `b`, the others as in `a`."""

        def of(cause: Cause) -> RangeState:
            return b if cause in changed else a

        modelled = of(Cause.TEMPERATURE).unit * of(Cause.PAYLOAD).payload * sum(of(x).parts[x] for x in MODELLED)
        factor = of(Cause.UNEXPLAINED).factor - of(Cause.UNEXPLAINED).auxiliaries + of(Cause.AUXILIARIES).auxiliaries
        return modelled * factor * of(Cause.RIDING).to_come + of(Cause.CLIMB).hills

    # --- modelled consumption ---------------------------------------------------------------------------------

    def _parts(self) -> Parts:
        """Parts of the riding lately ridden, and of the prior riding as far as that is still expected."""
        learner, unit = self._forecaster.learner, sum(self._load.prior_prices(*USUAL_AIR))
        sums = learner.state.sums
        learned = min(max(1 - learner.state.habits.price.variance / learner.prior.price.variance, 0.0), 1.0)
        share = learned * sums.distance / (sums.distance + CONFIG.riding_m)
        if not (share and sums.prior and sums.speed_squares):
            return self._prior_parts
        speed, grade, lateral = (
            sqrt(squares / sums.distance) for squares in (sums.speed_squares, sums.grade_squares, sums.lateral_squares)
        )
        ridden = {part: price / unit for part, price in self._steady([(1.0, speed)], lateral, grade).items()}
        ridden[Cause.STOPS] = (sums.level + sums.stops) / sums.prior - sum(ridden.values())
        return {part: share * ridden[part] + (1 - share) * self._prior_parts[part] for part in MODELLED}

    @cached_property
    def _prior_parts(self) -> Parts:
        """Parts of the prior riding: they add up to 1."""
        prior = self._load.prior
        unit, calm = (sum(load.prior_prices(*USUAL_AIR)) for load in (self._load, self._calm))
        cruises = [(share * speed / prior.speed, speed) for share, speed, _ in prior.points if speed]
        parts = self._steady(cruises, prior.lateral_acceleration, 0.0)
        parts[Cause.CLIMB] = calm - calm / prior.unevenness  # the file's one number
        parts[Cause.STOPS] = calm / prior.unevenness - parts[Cause.SPEED] - parts[Cause.TURNING]
        parts[Cause.WIND] = unit - calm
        return {part: price / unit for part, price in parts.items()}

    def _steady(self, ways: Sequence[tuple[float, float]], lateral: float, grade: float) -> Parts:
        """Consumption [J/m] at steady speeds, on `ways` of (share of the distance, speed [m/s]), in parts.

        lateral: acceleration [m/s²]; grade: sine, up and down again.
        """
        parts, straight = dict.fromkeys(MODELLED, 0.0), Conditions(*USUAL_AIR, lateral_acceleration=0.0)
        for share, speed in ways:
            time = share / speed  # s for each metre of the whole way
            q = self._load.quantities(speed, 0.0, straight)
            level, bend = self._calm.power(q), self._calm.power(q | {"lateral_acceleration": lateral})
            up, down = self._calm.power(q | {"grade": grade}), self._calm.power(q | {"grade": -grade})
            parts[Cause.SPEED] += time * level
            parts[Cause.TURNING] += time * (bend - level)
            parts[Cause.CLIMB] += time * ((up + down) / 2 - level)
            parts[Cause.WIND] += time * (self._load.power(q) - level)
        return parts
