"""The forward model on board: its inputs, from what is known, and their typical values.

Effects of an extended model read more than speed, acceleration and grade, which is all that is known of the road to
come. What is modelled of the ride so far has the heading, the lateral acceleration and the vibration (the root mean
square over each second) and the time moving as they were. What is expected of the rest of it has
- of the heading nothing: the mean over all of them, so that a steady wind costs what it costs on a round trip;
- the lateral acceleration and the vibration that the same segment had; before anything is ridden, or without IMU,
  the prior's;
- the time moving of half an hour on, as a range lasts an hour or so: tyres are warm then;
- of memory nothing: effects are settled. Those in the cells take their voltage at the mean current.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import pi
from typing import NamedTuple

from gz_onboard.constants import MILD
from gz_onboard.physics.battery import HALF_FULL, Battery
from gz_onboard.physics.effect import MOVING
from gz_onboard.physics.model import Model, air_density, stepping
from gz_onboard.physics.riding import PriorRiding

Quantities = dict[str, float]
"""By name what effects read: see `physics.effect.QUANTITIES`."""
AHEAD = 1800.0  # s: half of what a range lasts
WARM_MOTOR = 40.0  # degC: a motor at work, where its temperature is not known
# rad: of a wind slower than the vehicle their mean is that of all, exactly
HEADINGS = tuple(pi / 4 * i for i in range(8))
USUAL_AIR = MILD, 0.0  # degC, m: of the usual force
AMBIENT_DIGITS, ALTITUDE_DIGITS = 0, -2  # the prior riding is modelled anew for each degC and each 100 m
KEPT_AIRS = 8  # and kept: a sensor at the edge of two goes to and fro
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
    """What the consumption depends on beside the motion."""

    ambient: float  # degC
    altitude: float  # m
    motor_temperature: float = WARM_MOTOR  # degC


class EffectInputs(NamedTuple):
    """What effects beyond the base's may read at one time; None where it is not known."""

    lateral_acceleration: float | None  # m/s²
    heading: float | None  # rad, clockwise from north
    soc: float
    cell_temperature: float  # degC
    current: float  # A of the pack
    vibration: float | None = None  # m/s²


@dataclass
class Ledger:
    """Where the energy of the riding went [J]: what was `measured`, and by effect what the model gives for it."""

    measured: float = 0.0
    modelled: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))


class LoadModel:
    """The model of one vehicle with what is usual for it.

    `extended`: it reads `EffectInputs`. `ledger`: is kept of what is ridden if there is one; on board there is none.
    """

    def __init__(self, model: Model, battery: Battery, prior: PriorRiding) -> None:
        self.model = model
        self.prior = prior
        self.ledger: Ledger | None = None
        self.states: dict[str, float] = {}  # of effects with memory between road and pack
        self.extended = not model.reads <= BASE or any(e.decay for e in model.effects)
        self._battery = battery
        self._by_heading = "heading" in model.reads
        self._prior_in: dict[tuple[float, float], tuple[float, float]] = {}  # by the air, the last few

    def quantities(self, speed: float, acceleration: float, conditions: Conditions) -> Quantities:
        """What the base model reads, on a level road without wind; speed [m/s], acceleration [m/s²]."""
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
        """Add to `q` what an extended model may read beside; `ambient` in degC, `time_moving` in s."""
        lateral = inputs.lateral_acceleration
        q["lateral_acceleration"] = self._typical_lateral(q["speed"]) if lateral is None else lateral
        q["vibration"] = self.typical_vibration(q["speed"]) if inputs.vibration is None else inputs.vibration
        q["heading"] = 0.0 if inputs.heading is None else inputs.heading
        q["time_moving"] = time_moving
        self._add_cells(q, inputs.soc, inputs.cell_temperature, inputs.current, ambient)

    def typical_vibration(self, speed: float) -> float:
        """The prior riding's [m/s²] at `speed` [m/s]: what is taken where it is not known."""
        return self.prior.vibration if speed > MOVING else 0.0

    def _typical_lateral(self, speed: float) -> float:
        return self.prior.lateral_acceleration if speed > MOVING else 0.0

    def _add_cells(self, q: Quantities, soc: float, temperature: float, current: float, ambient: float) -> None:
        q |= {
            "ambient_temperature": ambient,
            "soc": soc,
            "cell_temperature": temperature,
            "cell_current": current / self._battery.cells_parallel,
            "cell_capacity": self._battery.cell_capacity(temperature),
        }

    def power(self, q: Quantities) -> float:
        """The power at the pack [W] with all effects settled."""
        return float(sum(self.model.power(q).values()))

    def power_ridden(self, q: Quantities, dt: float) -> float:
        """The power [W] over the last `dt` [s] with all effects settled."""
        return self._entered([self.model.power(q)], dt)

    def _entered(self, ledgers: Sequence[Mapping[str, float]], dt: float) -> float:
        """The mean power [W] of `ledgers` over the last `dt` [s], which `ledger` takes in."""
        if self.ledger:
            for ledger in ledgers:
                for name, power in ledger.items():
                    self.ledger.modelled[name] += power * dt / len(ledgers)
        return float(sum(sum(ledger.values()) for ledger in ledgers)) / len(ledgers)

    def power_with_memory(self, q: Quantities, heading_known: bool, dt: float) -> tuple[float, float]:
        """The power [W] as it was, over the last `dt` [s], and as it is to be expected of riding the same again."""
        to_come = self._over_headings(q | {"time_moving": q["time_moving"] + AHEAD})
        if self._by_heading and not heading_known:
            return self._entered(self._by_headings(q), dt), to_come
        return self._entered([self.model.power(q, stepping(self.states, dt))], dt), to_come

    def _by_headings(self, q: Quantities) -> list[dict[str, float]]:
        """The ledger [W] with all settled, for each of `HEADINGS`."""
        return [self.model.power(q | {"heading": heading}) for heading in HEADINGS]

    def _over_headings(self, q: Quantities) -> float:
        """The power [W] with all settled, in the mean over the headings if the model reads them."""
        if not self._by_heading:
            return self.power(q)
        return float(sum(sum(ledger.values()) for ledger in self._by_headings(q))) / len(HEADINGS)

    def prior_ride(self, ambient: float, altitude: float) -> tuple[float, float]:
        """(power [W], speed [m/s]) of the prior riding at `ambient` [degC] and `altitude` [m]."""
        return sum(self._prior(ambient, altitude)), self.prior.speed

    def prior_prices(self, ambient: float, altitude: float) -> tuple[float, float]:
        """What a metre of the prior riding costs in motion and by its stops [J/m]; see `prior_ride`."""
        moving, standing = self._prior(ambient, altitude)
        return moving / self.prior.speed, standing / self.prior.speed

    def usual_force(self) -> float:
        """Mean force [N] of the prior riding: its energy at the pack over its distance."""
        return self.prior.factor * sum(self._prior(*USUAL_AIR)) / self.prior.speed

    def _prior(self, ambient: float, altitude: float) -> tuple[float, float]:
        """The mean power [W] of its motion and of its stops."""
        at = round(ambient, AMBIENT_DIGITS), round(altitude, ALTITUDE_DIGITS)
        found = self._prior_in.get(at)
        if found is None:
            powers = [0.0, 0.0]
            for share, speed, acceleration in self.prior.points:
                q = self.quantities(speed, acceleration, Conditions(*at))
                if self.extended:
                    settled = EffectInputs(None, None, HALF_FULL, at[0], 0.0)
                    self.extend(q, settled, at[0], AHEAD)
                    power = self._over_headings(q)
                else:
                    power = self.power(q)
                powers[speed <= MOVING] += share * power * self.prior.unevenness
            if len(self._prior_in) >= KEPT_AIRS:
                self._prior_in.clear()
            found = self._prior_in[at] = powers[0], powers[1]
        return found
