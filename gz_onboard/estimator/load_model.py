"""Forward model of the load on board: its inputs, as far as they are known, and typical values for the others.

Effects of an extended model read more than speed, acceleration and grade. For the riding so far they get heading,
lateral acceleration, vibration and time moving as measured. For the riding to come

- the heading is unknown: the mean over all headings, so that a steady wind costs what it costs on a round trip;
- lateral acceleration and vibration are those of the same riding, or the prior's before anything is ridden;
- the time moving is half an hour more, as a range lasts an hour or so: tyres are warm then;
- effects with memory are settled. Those in the cells take their voltage at the mean current.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from functools import lru_cache
from math import pi
from typing import NamedTuple

from gz_onboard.constants import MILD
from gz_onboard.physics.battery import HALF_FULL, Battery
from gz_onboard.physics.effect import MOVING
from gz_onboard.physics.model import Model, air_density, stepping
from gz_onboard.physics.riding import PriorRiding

Quantities = dict[str, float]
"""Inputs of effects by name: see `physics.effect.QUANTITIES`."""
AHEAD = 1800.0  # s: half of what a range lasts
WARM_MOTOR = 40.0  # degC: a motor at work, where its temperature is not known
# rad: for a wind slower than the vehicle their mean equals that of all headings
HEADINGS = tuple(pi / 4 * i for i in range(8))
USUAL_AIR = MILD, 0.0  # degC, m: of the usual force
AMBIENT_DIGITS, ALTITUDE_DIGITS = 0, -2  # the prior riding is modelled for each degC and each 100 m
KEPT_AIRS = 8  # for which it is kept: a sensor at the edge of two goes to and fro
BASE = {
    "speed",
    "acceleration",
    "grade",
    "grade_cosine",
    "headwind",
    "mass",
    "air_density",
    "motor_temperature",
    "motor_speed",
    "motor_current",
    "torque",
}
"""Quantities that need nothing beyond speed, grade and air."""


class Conditions(NamedTuple):
    """Conditions that the consumption depends on besides the motion."""

    ambient: float  # degC
    altitude: float  # m
    motor_temperature: float = WARM_MOTOR  # degC


class EffectInputs(NamedTuple):
    """Inputs of effects beyond the base's at one time; None where unknown."""

    lateral_acceleration: float | None  # m/s²
    heading: float | None  # rad, clockwise from north
    soc: float
    cell_temperature: float  # degC
    current: float  # A of the pack
    vibration: float | None = None  # m/s²


@dataclass
class Ledger:
    """Where the energy of the riding went [J]: `measured`, and by effect as modelled."""

    measured: float = 0.0
    modelled: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))


class LoadModel:
    """Forward model of one vehicle with the inputs that are typical for it.

    extended: it reads `EffectInputs`; ledger: kept of the riding if there is one, which on board there is not; states:
    of effects with memory between road and pack.
    """

    def __init__(self, model: Model, battery: Battery, prior: PriorRiding) -> None:
        self.model = model
        self.prior = prior
        self.ledger: Ledger | None = None
        self.states: dict[str, float] = {}
        self.extended = not model.reads <= BASE or any(e.decay for e in model.effects)
        self._battery = battery
        self._by_heading = "heading" in model.reads
        self._prior_prices = lru_cache(KEPT_AIRS)(self._prior_prices_in)

    def quantities(self, speed: float, acceleration: float, conditions: Conditions) -> Quantities:
        """Inputs of the base model on a level road without wind; speed [m/s], acceleration [m/s²]."""
        return {
            "speed": speed,
            "acceleration": acceleration,
            "grade": 0.0,
            "grade_cosine": 1.0,
            "headwind": 0.0,
            "mass": self.model.mass,
            "air_density": air_density(conditions.ambient, conditions.altitude),
            "motor_temperature": conditions.motor_temperature,
            "lateral_acceleration": 0.0,
        }

    def extend(self, q: Quantities, inputs: EffectInputs, ambient: float, time_moving: float) -> None:
        """Add to `q` the inputs of an extended model; ambient in degC, time_moving in s."""
        lateral, typical = inputs.lateral_acceleration, self.prior.lateral_acceleration
        if lateral is None:
            lateral = typical if q["speed"] > MOVING else 0.0
        q |= {
            "lateral_acceleration": lateral,
            "vibration": self.typical_vibration(q["speed"]) if inputs.vibration is None else inputs.vibration,
            "heading": 0.0 if inputs.heading is None else inputs.heading,
            "time_moving": time_moving,
            "ambient_temperature": ambient,
            "soc": inputs.soc,
            "cell_temperature": inputs.cell_temperature,
            "cell_current": inputs.current / self._battery.cells_parallel,
            "cell_capacity": self._battery.cell_capacity(inputs.cell_temperature),
        }

    def typical_vibration(self, speed: float) -> float:
        """Vibration of the prior riding [m/s²] at `speed` [m/s], where it is unknown."""
        return self.prior.vibration if speed > MOVING else 0.0

    def power(self, q: Quantities) -> float:
        """Power at the pack [W] with all effects settled."""
        return float(sum(self.model.power(q).values()))

    def power_ridden(self, q: Quantities, inputs: EffectInputs | None, dt: float) -> tuple[float, float]:
        """(power [W] over the last `dt` [s], power of riding the same again); a step of effects with memory.

        inputs: that `q` was extended by, None for the base's quantities alone.
        """
        if inputs and self._by_heading and inputs.heading is None:
            ledgers = [self.model.power(q | {"heading": heading}) for heading in HEADINGS]
        else:
            ledgers = [self.model.power(q, stepping(self.states, dt) if inputs else None)]
        if self.ledger:
            for name in ledgers[0]:
                self.ledger.modelled[name] += sum(each[name] for each in ledgers) * dt / len(ledgers)
        power = float(sum(sum(each.values()) for each in ledgers)) / len(ledgers)
        return power, self.power_ahead(q | {"time_moving": q["time_moving"] + AHEAD}) if inputs else power

    def power_ahead(self, q: Quantities) -> float:
        """Power [W] with all effects settled, in the mean over all headings if the model reads the heading."""
        if not self._by_heading:
            return self.power(q)
        return sum(self.power(q | {"heading": heading}) for heading in HEADINGS) / len(HEADINGS)

    def prior_ride(self, ambient: float, altitude: float) -> tuple[float, float]:
        """(power [W], speed [m/s]) of the prior riding at `ambient` [degC] and `altitude` [m]."""
        return sum(self.prior_prices(ambient, altitude)) * self.prior.speed, self.prior.speed

    def prior_prices(self, ambient: float, altitude: float) -> tuple[float, float]:
        """Energy per metre of the prior riding [J/m], in motion and at its stops; see `prior_ride`."""
        return self._prior_prices(round(ambient, AMBIENT_DIGITS), round(altitude, ALTITUDE_DIGITS))

    def usual_force(self) -> float:
        """Mean force [N] of the prior riding: its energy at the pack over its distance."""
        return self.prior.factor * sum(self.prior_prices(*USUAL_AIR))

    def _prior_prices_in(self, ambient: float, altitude: float) -> tuple[float, float]:
        moving = standing = 0.0
        for share, speed, acceleration in self.prior.points:
            q = self.quantities(speed, acceleration, Conditions(ambient, altitude))
            if self.extended:
                self.extend(q, EffectInputs(None, None, HALF_FULL, ambient, 0.0), ambient, AHEAD)
            price = share * self.power_ahead(q) * self.prior.unevenness / self.prior.speed
            if speed > MOVING:
                moving += price
            else:
                standing += price
        return moving, standing
