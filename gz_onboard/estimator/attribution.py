"""Why the range is what it is: its difference to another range, split among causes, so that they add up to it.

The range is E/c, the energy that can be drawn over the consumption expected. Each is a function of causes that the
forward model already is (`physics.drawable`, `composition`), evaluated with some causes as they are and the others as
they were. A cause counts with what it changes in an order of the causes and in the reverse order, in the mean. That is
its Shapley value as far as causes act alone or in pairs, and adds up to the difference whatever they do.

The rated range, which the present one is compared with: the vehicle file's prior riding in mild air, without hills and
wind, with its payload, its consumption factor, and a full battery as new, at the same temperature.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from math import exp
from typing import NamedTuple

from gz_onboard.constants import MILD
from gz_onboard.estimator.composition import PARTS, Composition, Parts
from gz_onboard.estimator.consumption import CONSUMPTION
from gz_onboard.estimator.forecast import Forecast, Forecaster
from gz_onboard.estimator.load_model import AHEAD, ALTITUDE_DIGITS, AMBIENT_DIGITS, USUAL_AIR, Conditions
from gz_onboard.estimator.pattern import Point
from gz_onboard.estimator.signals import Signals
from gz_onboard.events import LOADS, Cause, Explanation
from gz_onboard.physics.battery import Battery, Overpotential
from gz_onboard.physics.drawable import drawable
from gz_onboard.physics.warming import cells_ahead

EVERY = 180.0  # s: a split takes as long as four forecasts, and all are to take a hundredth of the whole
LEAST_MOVED = 100.0  # m: nothing new is to be said of a range that has not moved
MOVED = 1000.0  # m: so much more or less than the distance ridden, and a change is explained
SETTLED = 60.0  # s: what goes back within is no change
MOST_CHANGES = 100
STOOD = 10.0  # m: on less way a charge goes on, and is one change
SHOWN_OVER = 1000.0  # m: on less way than this, what was ridden is more chance than a pattern
BESIDE = Cause.TEMPERATURE, Cause.PAYLOAD
"""What the modelled consumption depends on apart from the riding: the air and the mass."""


class Moment(NamedTuple):
    """What a range is explained from."""

    time: float  # s
    forecast: Forecast
    soc: float
    air: Conditions
    ridden: float  # m, since the start
    hills: tuple[float, float] = 0.0, 0.0  # of a route ahead: see `Answer`


class Draw(NamedTuple):
    """What the energy that can be drawn follows from; cells in degC, power in W."""

    soc: float
    cells: float
    battery: Battery
    power: float
    form_factor_squared: float


@dataclass(frozen=True)
class State:
    """One range, and all that it follows from; SI units, temperatures in degC."""

    time: float
    ridden: float  # m, since the start
    range: float
    energy: float
    consumption: float
    draw: Draw
    air: Conditions
    mass: float  # kg, with rider and luggage
    factor: float  # measured over modelled consumption
    auxiliaries: float  # of the factor, what auxiliaries beyond the model's make
    points: tuple[Point, ...]  # lately ridden
    hills: float = 0.0  # J/m: how much more those of a route ahead take than hills like those ridden
    known: float = 0.0  # how much of the price expected is theirs, and not the prior riding's: 0 to 1
    rated: bool = False  # the prior riding without hills and wind, nothing ridden
    parts: dict[tuple[Conditions, float], Parts] = field(default_factory=dict)  # as far as they were asked for


class Attribution:
    """Explains the range of one vehicle. `latest`: against the rated range; `changes`: what moved it, the last few.

    A charge is one change, of which `news` tells each step.
    """

    def __init__(self, forecaster: Forecaster, signals: Signals) -> None:
        self._forecaster, self._signals, load = forecaster, signals, forecaster.load
        self._more = self._known = 0.0  # W in the factor learned, weighted by the way; sum of the weights
        self._ridden = 0.0  # m
        self._composition = Composition(load)
        self._new = forecaster.battery.own()
        self._rated: State | None = None
        self._since: State | None = None
        self._forgotten: set[str] = set()  # roles, since then
        self.latest: Explanation | None = None
        self.changes: deque[Explanation] = deque(maxlen=MOST_CHANGES)
        self._news: deque[tuple[bool, Explanation]] = deque(maxlen=MOST_CHANGES)

    def take(self, moment: Moment) -> None:
        """A new forecast."""
        now, forecast, ridden = moment.time, moment.forecast, moment.ridden
        self._measure_auxiliaries(now, ridden)
        last, since = self.latest, self._since
        due = last is None or (now - last.time >= EVERY and abs(forecast.range - last.range) > LEAST_MOVED)
        moved = since and abs(forecast.range + ridden - since.range - since.ridden) > MOVED
        if since and moved and now - since.time >= SETTLED:
            self._since = self._state(moment)
            change = replace(self.explained(since, self._since), forgotten=tuple(sorted(self._forgotten)))
            self._forgotten.clear()
            self._news.append((True, change))
            if self.changes and ridden - since.ridden < STOOD and _charged(self.changes[-1]) and _charged(change):
                change = _joined(self.changes.pop(), change)
            self.changes.append(change)
        if due:
            state = self._state(moment)
            self._since = self._since or state
            self.latest = self.explained(self.rated, state)
            self._news.append((False, self.latest))

    def forget(self, roles: Iterable[str]) -> None:
        """What was learned of these sensors is forgotten, as they are found faulty."""
        self._forgotten.update(roles)

    def news(self) -> list[tuple[bool, Explanation]]:
        """What was explained since it was last asked for: (whether it is a change, explanation)."""
        news = list(self._news)
        self._news.clear()
        return news

    def _state(self, moment: Moment) -> State:
        now, forecast, soc, air, ridden, (energy, way) = moment
        learner = self._forecaster.learner
        known = forecast.range > 0 and forecast.energy > 0
        state = State(
            time=now,
            ridden=ridden,
            range=forecast.range,
            energy=forecast.energy,
            consumption=forecast.energy / forecast.range if known else forecast.consumption,
            draw=Draw(soc, forecast.cells, self._pack(), forecast.power, forecast.form_factor_squared),
            air=Conditions(round(air.ambient, AMBIENT_DIGITS), round(air.altitude, ALTITUDE_DIGITS)),
            mass=self._forecaster.load.model.mass,
            factor=learner.consumption_factor,
            auxiliaries=self._auxiliaries(forecast.power),
            points=learner.pattern.points(),
            known=learner.price_known,
        )
        like_ridden = way * state.factor * self._parts(state, state.air, state.mass)[Cause.CLIMB]
        return replace(state, hills=(energy - like_ridden) / state.range if known else 0.0)

    def _measure_auxiliaries(self, now: float, ridden: float) -> None:
        """What they take beyond the model's and their own sensor's, in the mean over the way lately ridden."""
        way, self._ridden = ridden - self._ridden, ridden
        beside = [self._signals[role].get(now) for role in LOADS]
        known = [power for power in beside if power is not None]
        if way > 0 and known:
            fade = exp(-way / CONSUMPTION.memory_m)
            self._more = fade * self._more + (1 - fade) * sum(known)
            self._known = fade * self._known + 1 - fade

    def _auxiliaries(self, power: float) -> float:
        """The part of the consumption factor that they make, as far as it is in it; `power` [W]: expected."""
        learner = self._forecaster.learner
        by_sensor = learner.auxiliary_factor
        if not self._known or power <= 0:
            return by_sensor
        return by_sensor + learner.factor_known * learner.factor * self._more / self._known / power

    @property
    def rated(self) -> State:
        """What the range is compared with: see above."""
        if self._rated is None:
            load = self._forecaster.load
            parameters = load.model.parameters
            mass = parameters["vehicle_mass"] + parameters.filed("payload_mass")
            air, prior = Conditions(*USUAL_AIR), load.prior
            calm = _without_hills_and_wind(self._composition.prior(air, mass))
            consumption = prior.factor * sum(calm.values())
            full, power = self._new.window.of_cells(1.0), consumption * prior.speed
            load_ahead = power, CONSUMPTION.form_factor_squared
            lost = self._overpotential(self._new)
            cells = cells_ahead(self._new, self._forecaster.cooling, (full, MILD), MILD, load_ahead, lost)
            draw = Draw(full, cells, self._new, *load_ahead)
            energy = self._energy(draw)
            self._rated = State(
                time=0.0,
                ridden=0.0,
                range=energy / consumption,
                energy=energy,
                consumption=consumption,
                draw=draw,
                air=air,
                mass=mass,
                factor=prior.factor,
                auxiliaries=0.0,
                points=(),
                rated=True,
            )
        return self._rated

    # --- splitting --------------------------------------------------------------------------------------------

    def explained(self, a: State, b: State) -> Explanation:
        """The range of `b` against that of `a`; if not `a` is the rated one, the distance ridden between is added."""
        energy = self._energy(a.draw._replace(soc=b.draw.soc))
        ridden = 0.0 if a.rated else b.ridden - a.ridden
        causes = dict.fromkeys((cause for cause in Cause if cause), 0.0)
        causes[Cause.CHARGE] = (energy - a.energy) / a.consumption + ridden
        costs = self._costs(a, b)
        for cause, change in self._energies(a, b, energy, costs).items():
            causes[cause] += change * (1 / a.consumption + 1 / b.consumption) / 2
        for cause, cost in costs.items():
            causes[cause] -= cost * (energy + b.energy) / 2 / (a.consumption * b.consumption)
        return Explanation(b.time, a.range, b.range + ridden, causes)

    def _costs(self, a: State, b: State) -> Parts:
        """The difference of the consumptions [J/m]: factor times what is left open times the model's, and hills."""
        modelled = self._modelled(a, b)
        f0, m0, f1, m1 = a.factor, self._total(a, a.air, a.mass), b.factor, self._total(b, b.air, b.mass)
        g0, g1 = (a.consumption - a.hills) / (f0 * m0), (b.consumption - b.hills) / (f1 * m1)
        of_model, of_factor = _worth(f0, g0, f1, g1), _worth(g0, m0, g1, m1)
        costs = {cause: of_model * part for cause, part in modelled.items()}
        costs[Cause.CLIMB] += b.hills - a.hills
        auxiliaries = b.auxiliaries - a.auxiliaries
        return costs | {
            Cause.AUXILIARIES: of_factor * auxiliaries,
            Cause.UNEXPLAINED: of_factor * (f1 - f0 - auxiliaries),
            Cause.RIDING: _worth(f0, m0, f1, m1) * (g1 - g0),
        }

    def _modelled(self, a: State, b: State) -> Parts:
        """The difference of the modelled consumptions [J/m]."""
        parts: Parts = dict.fromkeys((*PARTS, *BESIDE), 0.0)
        for at in (a, b):
            before, after = self._parts(a, at.air, at.mass), self._parts(b, at.air, at.mass)
            for part in PARTS:
                parts[part] += (after[part] - before[part]) / 2
        # Air, then mass, with the riding as it is; mass, then air, with the riding as it was.
        for riding, causes in ((b, BESIDE), (a, BESIDE[::-1])):
            air, mass = a.air, a.mass
            before_it = self._total(riding, air, mass)
            for cause in causes:
                air, mass = (b.air, mass) if cause is Cause.TEMPERATURE else (air, b.mass)
                after_it = self._total(riding, air, mass)
                parts[cause] += (after_it - before_it) / 2
                before_it = after_it
        return parts

    def _total(self, state: State, air: Conditions, mass: float) -> float:
        return sum(self._parts(state, air, mass).values())

    def _parts(self, state: State, air: Conditions, mass: float) -> Parts:
        """The modelled consumption [J/m] of the riding of `state` in other air, with another mass [kg]."""
        at = air, mass
        if at not in state.parts:
            prior = self._composition.prior(air, mass)
            distance = sum(p.distance for p in state.points)
            if state.rated:
                state.parts[at] = _without_hills_and_wind(prior)
            elif not distance:
                state.parts[at] = prior
            else:
                ridden = self._composition.of(state.points, air, mass)
                share = state.known * distance / (distance + SHOWN_OVER)
                state.parts[at] = {part: share * ridden[part] + (1 - share) * prior[part] for part in PARTS}
        return state.parts[at]

    def _energies(self, a: State, b: State, energy: float, costs: Parts) -> Parts:
        """The difference of the energies [J] beside that of the charge; `energy`: of `a` with the charge of `b`."""
        names = "cells", "battery", "power", "form_factor_squared"
        steps = dict.fromkeys(names, 0.0)
        for order in (names, names[::-1]):
            draw, before = a.draw._replace(soc=b.draw.soc), energy
            for name in order:
                changed = draw._replace(**{name: getattr(b.draw, name)})
                after = b.energy if changed == b.draw else before if changed == draw else self._energy(changed)
                steps[name] += (after - before) / 2
                draw, before = changed, after
        energies = {Cause.TEMPERATURE: steps["cells"], Cause.AGE: steps["battery"], Cause.SPEED: steps["power"]}
        energies[Cause.STOPS] = steps["form_factor_squared"]
        # The power is consumption times mean speed: each cause of the one has its share, the other is the speed's.
        speed = (a.draw.power / a.consumption + b.draw.power / b.consumption) / 2
        more = b.draw.power - a.draw.power
        for cause, cost in costs.items():
            share = steps["power"] * speed * cost / more if more else 0.0
            energies[cause] = energies.get(cause, 0.0) + share
            energies[Cause.SPEED] -= share
        return energies

    def _pack(self) -> Battery:
        """The battery as it is now: what is learned of it later is another state's."""
        pack, health = self._new.own(), self._forecaster.battery.health
        pack.age(health.capacity, health.resistance)
        pack.weaken(health.weakest)
        return pack

    def _energy(self, draw: Draw) -> float:
        lost = self._overpotential(draw.battery)
        return drawable(draw.battery, draw.soc, draw.cells, draw.power, draw.form_factor_squared, lost).energy

    def _overpotential(self, battery: Battery) -> Overpotential | None:
        load = self._forecaster.load
        return load.model.overpotential(battery, {"vibration": load.prior.vibration, "time_moving": AHEAD})


def _charged(change: Explanation) -> bool:
    """Whether a change of the range is, most of all, charge that was gained."""
    gained = change.causes[Cause.CHARGE]
    return gained > 0 and gained >= max(map(abs, change.causes.values()))


def _joined(one: Explanation, other: Explanation) -> Explanation:
    """Two changes, of which the other came next, as one: with the distance ridden in both, and the causes of both."""
    causes = {cause: size + other.causes[cause] for cause, size in one.causes.items()}
    forgotten = tuple(sorted({*one.forgotten, *other.forgotten}))
    range_ = one.range + other.range - other.reference
    return Explanation(other.time, one.reference, range_, causes, forgotten)


def _without_hills_and_wind(parts: Parts) -> Parts:
    return parts | {Cause.CLIMB: 0.0, Cause.WIND: 0.0}


def _worth(x0: float, y0: float, x1: float, y1: float) -> float:
    """What the change of a factor is worth beside two others, x and y: its Shapley value per change."""
    return (x0 * y0 + x1 * y1) / 3 + (x0 * y1 + x1 * y0) / 6
