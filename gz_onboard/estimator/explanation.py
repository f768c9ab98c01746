"""Why the range is what it is: its difference from another range, split among causes that add up to it.

The range is E/c, the energy that can be drawn over the consumption expected. Both are evaluated with some causes as
they are now and the others as they were. A cause counts with what it changes in one order of the causes and in the
reverse order, on average. That is its Shapley value as far as causes act alone or in pairs, and it always adds up.

The consumption is modelled in parts, all in J/m of the distance, stops included:

    SPEED     keeping the speeds ridden, on a level and straight road without wind
    STOPS     accelerating, braking and standing, in addition to that
    CLIMB     hills like those ridden, up and down again; and those of a route ahead
    TURNING   bends
    WIND      a steady wind over the land, averaged over all headings, if the model knows one

Energy stored in height and speed is given back and is no cost. The rated range, which the present one is compared with,
is that of the vehicle file's prior riding in mild air, without hills and wind, with its payload and its consumption
factor, and of a full battery as new, at the same temperature.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import exp, sqrt

from gz_onboard.constants import MILD
from gz_onboard.estimator.consumption import CONSUMPTION
from gz_onboard.estimator.forecast import Forecast, Forecaster
from gz_onboard.estimator.load_model import (
    AHEAD,
    ALTITUDE_DIGITS,
    AMBIENT_DIGITS,
    HEADINGS,
    USUAL_AIR,
    Conditions,
    EffectInputs,
)
from gz_onboard.estimator.pattern import Point
from gz_onboard.estimator.signals import Signals
from gz_onboard.events import LOADS, Cause, Explanation
from gz_onboard.physics.battery import HALF_FULL, Battery
from gz_onboard.physics.drawable import cells_ahead, drawable
from gz_onboard.physics.model import Model


@dataclass(frozen=True)
class ExplanationConfig:
    """Constants of the explanation."""

    interval_s: float = 180.0  # between explanations: one takes as long as a few forecasts
    min_change_m: float = 100.0  # a range that has changed by less is not explained again
    change_m: float = 1000.0  # so much more or less than the distance ridden is a change of the range
    settling_s: float = 60.0  # what goes back within is no change
    max_changes: int = 100  # that are kept
    pattern_m: float = 1000.0  # of riding that counts as much as the prior riding


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
    air: Conditions
    mass: float  # kg, with rider and luggage
    factor: float  # measured over modelled consumption, with `auxiliaries`
    auxiliaries: float  # what auxiliaries beyond the model's make of the factor
    points: tuple[Point, ...] = ()  # lately ridden
    points_share: float = 0.0  # of the price expected that follows from them, and not from the prior riding: 0 to 1
    hills: float = 0.0  # J/m: how much more those of a route ahead take than hills like those ridden
    rated: bool = False  # the prior riding without hills and wind
    parts: dict[tuple[Conditions, float], Parts] = field(default_factory=dict)  # as far as they were asked for


class RangeExplainer:
    """Explains the range of one vehicle. `latest`: against the rated range; `changes`: what moved it, the last few."""

    def __init__(self, forecaster: Forecaster, signals: Signals) -> None:
        self._forecaster, self._load = forecaster, forecaster.load
        self._heaters = [signals[role] for role in LOADS]
        self._heating, self._ridden = 0.0, 0.0  # W, mean over the way lately ridden; m
        self._new = forecaster.battery.own()
        self._since: RangeState | None = None
        self._forgotten: set[str] = set()  # roles, since then
        self._news: deque[tuple[bool, Explanation]] = deque(maxlen=CONFIG.max_changes)
        self.latest: Explanation | None = None
        self.changes: deque[Explanation] = deque(maxlen=CONFIG.max_changes)
        model, prior = self._load.model, self._load.prior
        calm = tuple(effect for effect in model.effects if "heading" not in effect.reads)  # only a wind reads it
        self._calm = model if calm == model.effects else Model(calm, model.parameters)
        self._stores = {effect.name for effect in model.effects if effect.stores_energy}
        self._usual = tuple(
            Point(share, share * speed, speed, acceleration, returns=False)
            for share, speed, acceleration in prior.points
        )

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
        self._follow_heaters(now, ridden)
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

    # --- states -----------------------------------------------------------------------------------------------

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
        forecaster, pack = self._forecaster, self._new.own()
        learner, health = forecaster.learner, forecaster.battery.health
        pack.age(health.capacity, health.resistance)
        pack.weaken(health.weakest)
        known = forecast.range > 0 and forecast.energy > 0
        points = learner.pattern.points()
        distance = sum(p.distance for p in points)
        learned = learner.price_known
        heating = learner.factor * self._heating / forecast.power if forecast.power > 0 else 0.0
        state = RangeState(
            time=now,
            ridden=ridden,
            range=forecast.range,
            consumption=forecast.energy / forecast.range if known else forecast.consumption,
            power=forecast.power,
            form_factor_squared=forecast.form_factor_squared,
            soc=soc,
            cells=forecast.cells,
            battery=pack,
            air=Conditions(round(air.ambient, AMBIENT_DIGITS), round(air.altitude, ALTITUDE_DIGITS)),
            mass=self._load.model.mass,
            factor=learner.consumption_factor,
            auxiliaries=learner.auxiliary_factor + heating,
            points=points,
            points_share=learned * distance / (distance + CONFIG.pattern_m),
        )
        like_ridden = hills[1] * state.factor * self._parts(state, state.air, state.mass)[Cause.CLIMB]
        return replace(state, hills=(hills[0] - like_ridden) / state.range) if known else state

    @cached_property
    def rated(self) -> RangeState:
        """The range to compare with: see above."""
        load, battery = self._load, self._new
        parameters, prior = load.model.parameters, load.prior
        state = RangeState(
            time=0.0,
            ridden=0.0,
            range=0.0,
            consumption=0.0,
            power=0.0,
            form_factor_squared=CONSUMPTION.form_factor_squared,
            soc=battery.window.of_cells(1.0),
            cells=MILD,
            battery=battery,
            air=Conditions(*USUAL_AIR),
            mass=parameters["vehicle_mass"] + parameters.filed("payload_mass"),
            factor=prior.factor,
            auxiliaries=0.0,
            rated=True,
        )
        consumption = prior.factor * sum(self._parts(state, state.air, state.mass).values())
        expected = consumption * prior.speed, CONSUMPTION.form_factor_squared
        lost = load.model.overpotential(battery, {"vibration": prior.vibration, "time_moving": AHEAD})
        cells = cells_ahead(battery, self._forecaster.cooling, (state.soc, MILD), MILD, expected, lost)
        state = replace(state, consumption=consumption, power=expected[0], cells=cells)
        return replace(state, range=self._energy(state, state) / consumption)

    # --- splitting --------------------------------------------------------------------------------------------

    def explain(self, a: RangeState, b: RangeState) -> Explanation:
        """The range of `b` against that of `a`; unless `a` is the rated one, the distance ridden between is added."""
        charged = replace(a, soc=b.soc)
        start, energy = self._energy(a, a), self._energy(charged, charged)
        ridden = 0.0 if a.rated else b.ridden - a.ridden
        costs = _split(OF_COST, lambda changed: self._cost(a, b, changed))
        energies = _split(OF_ENERGY, lambda changed: self._energy(charged, b, changed))
        end = energy + sum(energies.values())
        # The power is consumption times mean speed: each cause of the one has its share, the other is the speed's.
        more, speed = b.power - a.power, (a.power / a.consumption + b.power / b.consumption) / 2
        by_cost = energies[Cause.SPEED] * speed / more if more else 0.0
        causes = dict.fromkeys((cause for cause in Cause if cause), 0.0)
        causes[Cause.CHARGE] = (energy - start) / a.consumption + ridden
        for cause, change in energies.items():
            causes[cause] += change * (1 / a.consumption + 1 / b.consumption) / 2
        for cause, cost in costs.items():
            by_power = by_cost * cost * (1 / a.consumption + 1 / b.consumption) / 2
            causes[cause] += by_power - cost * (energy + end) / 2 / (a.consumption * b.consumption)
            causes[Cause.SPEED] -= by_power
        return Explanation(b.time, a.range, b.range + ridden, causes)

    def _energy(self, a: RangeState, b: RangeState, changed: Collection[Cause] = ()) -> float:
        """Energy that can be drawn [J] at the charge of `a`; causes in `changed` as in `b`, the others as in `a`."""
        load, battery = self._load, (b if Cause.AGE in changed else a).battery
        lost = load.model.overpotential(battery, {"vibration": load.prior.vibration, "time_moving": AHEAD})
        cells = (b if Cause.TEMPERATURE in changed else a).cells
        power = (b if Cause.SPEED in changed else a).power
        form_factor_squared = (b if Cause.STOPS in changed else a).form_factor_squared
        return drawable(battery, a.soc, cells, power, form_factor_squared, lost).energy

    def _cost(self, a: RangeState, b: RangeState, changed: Collection[Cause]) -> float:
        """Consumption [J/m]; of each cause in `changed` as in `b`, of the others as in `a`.

        It is the modelled one, times the factor, times how the riding to come differs from that; and hills ahead.
        """

        def of(cause: Cause) -> RangeState:
            return b if cause in changed else a

        air, mass = of(Cause.TEMPERATURE).air, of(Cause.PAYLOAD).mass
        modelled = sum(self._parts(of(part), air, mass)[part] for part in MODELLED)
        factor = of(Cause.UNEXPLAINED).factor - of(Cause.UNEXPLAINED).auxiliaries + of(Cause.AUXILIARIES).auxiliaries
        to_come = of(Cause.RIDING)
        usual = to_come.factor * sum(self._parts(to_come, to_come.air, to_come.mass).values())
        return (to_come.consumption - to_come.hills) / usual * factor * modelled + of(Cause.CLIMB).hills

    # --- modelled consumption ---------------------------------------------------------------------------------

    def _parts(self, state: RangeState, air: Conditions, mass: float) -> Parts:
        """The modelled consumption [J/m] of the riding of `state` in this `air` with this `mass` [kg], in parts."""
        at = air, mass
        if at not in state.parts:
            parts, share = self._modelled(self._usual, air, mass), state.points_share
            parts[Cause.CLIMB] = (self._load.prior.unevenness - 1) * sum(parts.values())  # the file's one number
            if state.rated:
                parts |= {Cause.CLIMB: 0.0, Cause.WIND: 0.0}
            elif share:
                ridden = self._modelled(state.points, air, mass)
                parts = {part: share * ridden[part] + (1 - share) * parts[part] for part in MODELLED}
            state.parts[at] = parts
        return state.parts[at]

    def _modelled(self, points: Sequence[Point], air: Conditions, mass: float) -> Parts:
        """The parts of riding these `points`."""
        distance, cruises = sum(p.distance for p in points), [p for p in points if p.speed]
        model = self._load.model
        parts = dict.fromkeys(MODELLED, 0.0)
        parts[Cause.SPEED] = steady = sum(self._drawn(p, Cause.SPEED, air, mass) for p in cruises) / distance
        for part, ridden, counts in (
            (Cause.STOPS, points, True),
            (Cause.CLIMB, cruises, any(p.grade for p in cruises)),
            (Cause.TURNING, cruises, "lateral_acceleration" in model.reads),
            (Cause.WIND, cruises, self._calm is not model),
        ):
            if counts:
                parts[part] = sum(self._drawn(p, part, air, mass) for p in ridden) / distance - steady
        return parts

    def _drawn(self, p: Point, part: Cause, air: Conditions, mass: float) -> float:
        """Energy [J] to ride a point at a steady speed, with the motion that belongs to `part`."""
        q = self._load.quantities(p.speed, p.acceleration if part is Cause.STOPS else 0.0, air)
        q["mass"] = mass
        if self._load.extended:
            lateral = p.lateral if part is Cause.TURNING else 0.0
            self._load.extend(q, EffectInputs(lateral, None, HALF_FULL, air.ambient, 0.0), air.ambient, AHEAD)
        if part is Cause.WIND:
            every = [sum(self._load.model.power(q | {"heading": heading}).values()) for heading in HEADINGS]
            return p.time * float(sum(every)) / len(every)
        grades = (p.grade, -p.grade) if part is Cause.CLIMB else (p.slope,) if part is Cause.STOPS else (0.0,)
        given_back = self._stores if p.returns else ()
        power = 0.0
        for grade in grades:
            ledger = self._calm.power(q | {"grade": grade, "grade_cosine": sqrt(1 - grade * grade)})
            power += sum(watts for name, watts in ledger.items() if name not in given_back) / len(grades)
        return p.time * power

    def _follow_heaters(self, now: float, ridden: float) -> None:
        """Follow what heaters take, on average over the way lately ridden: so much of it the factor has learned."""
        way, self._ridden = ridden - self._ridden, ridden
        known = [power for heater in self._heaters if (power := heater.get(now)) is not None]
        if way > 0 and known:
            self._heating += (1 - exp(-way / CONSUMPTION.memory_m)) * (sum(known) - self._heating)


def _split(causes: Sequence[Cause], value: Callable[[Collection[Cause]], float]) -> Parts:
    """Split the difference between the value with all causes changed and without any among them."""
    shares = dict.fromkeys(causes, 0.0)
    for order in (causes, causes[::-1]):
        changed: set[Cause] = set()
        before = value(changed)
        for cause in order:
            changed.add(cause)
            after = value(changed)
            shares[cause] += (after - before) / 2
            before = after
    return shares
