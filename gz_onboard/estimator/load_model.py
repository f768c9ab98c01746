"""Forward model of the load on board: from speed, acceleration, grade and conditions to power at the pack.

Effects of a vehicle file may read more than speed, acceleration and grade. For the riding so far they get heading,
lateral acceleration, vibration and time moving as measured. For the riding to come

- the heading is unknown: the mean over all headings, so that a steady wind costs as much as on a round trip;
- lateral acceleration and vibration are those of the same riding, or the prior's before anything is ridden;
- the time moving is half an hour more, as a range lasts an hour or so: tyres are warm then;
- effects with memory are settled. Those in the cells take their voltage at the mean current.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from functools import lru_cache
from math import pi
from typing import TYPE_CHECKING, NamedTuple

from gz_onboard.constants import MILD
from gz_onboard.model.battery import HALF_FULL, Battery, Overpotential
from gz_onboard.model.effect import MOVING, Port
from gz_onboard.model.model import Model, Recall, air_density, stepping
from gz_onboard.model.riding import PriorRiding

if TYPE_CHECKING:
    from gz_onboard.estimator.battery_pack import BatteryPack
    from gz_onboard.estimator.cells import Temperatures
    from gz_onboard.estimator.motion import Motion, VibrationMonitor
    from gz_onboard.estimator.signals import Signals

Quantities = dict[str, float]  # inputs of effects by name: see `model.effect.QUANTITIES`
AHEAD = 1800.0  # s: half of the time that a range lasts
WARM_MOTOR = 40.0  # degC: a motor at work, where its temperature is not known
# rad: for a wind slower than the vehicle their mean equals that of all headings
HEADINGS = tuple(pi / 4 * i for i in range(8))
USUAL_AIR = MILD, 0.0  # degC, m: of the usual force
AMBIENT_DIGITS, ALTITUDE_DIGITS = 0, -2  # the prior riding is modelled for each degC and each 100 m
KEPT_AIRS = 8  # for which it is kept: a sensor at the edge of two goes to and fro


class Conditions(NamedTuple):
    """Conditions that the load depends on besides speed, acceleration and grade; typical ones in place of None."""

    ambient: float  # degC
    altitude: float  # m
    motor_temperature: float = WARM_MOTOR  # degC
    lateral_acceleration: float | None = None  # m/s²
    heading: float | None = None  # rad, clockwise from north; None: the mean over all
    vibration: float | None = None  # m/s²
    soc: float = HALF_FULL
    cell_temperature: float | None = None  # degC; None: as the air
    current: float = 0.0  # A of the pack


@dataclass
class Ledger:
    """Where the energy of the riding went [J]: `measured`, and by effect as modelled."""

    measured: float = 0.0
    modelled: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))


class LoadModel:
    """Forward model of one vehicle with the inputs that are typical for it.

    ledger: kept of the riding if there is one, which on board there is not; states: of effects with memory between road
    and pack; time_moving: since the start or the last long standstill [s].
    """

    def __init__(self, model: Model, battery: Battery, prior: PriorRiding) -> None:
        self.model = model
        self.prior = prior
        self.ledger: Ledger | None = None
        self.states: dict[str, float] = {}
        self.time_moving = 0.0
        road = [effect for effect in model.effects if effect.port is not Port.CELL_VOLTAGE]
        reads = frozenset[str]().union(*(effect.reads for effect in road))
        memory = any(effect.decay for effect in road)
        self._repeats = not memory and not reads & {"heading", "time_moving"}  # riding it again takes the same
        self._by_heading = "heading" in reads
        self._battery = battery
        self._prices = lru_cache(KEPT_AIRS)(self._model_prior)

    def quantities(
        self, speed: float, acceleration: float, conditions: Conditions, grade: float = 0.0, time_moving: float = AHEAD
    ) -> Quantities:
        """Inputs of the model at `speed` [m/s], `acceleration` [m/s²], `grade` (sine), `time_moving` [s]."""
        c, prior = conditions, self.prior
        lateral, vibration = c.lateral_acceleration, c.vibration
        cells = c.ambient if c.cell_temperature is None else c.cell_temperature
        q = {
            "speed": speed,
            "acceleration": acceleration,
            "grade": grade,
            "grade_cosine": 1.0,
            "headwind": 0.0,
            "mass": self.model.mass,
            "air_density": air_density(c.ambient, c.altitude),
            "motor_temperature": c.motor_temperature,
            "lateral_acceleration": prior.lateral_acceleration * (speed > MOVING) if lateral is None else lateral,
            "vibration": prior.vibration * (speed > MOVING) if vibration is None else vibration,
            "time_moving": time_moving,
            "ambient_temperature": c.ambient,
            "soc": c.soc,
            "cell_temperature": cells,
            "cell_current": c.current / self._battery.cells_parallel,
            "cell_capacity": self._battery.cell_capacity(cells),
        }
        if c.heading is not None:
            q["heading"] = c.heading
        return q

    def powers(self, q: Quantities, recall: Recall | None = None) -> dict[str, float]:
        """Power at the pack [W] by effect; those with memory as `recall` gives them, or settled. See `Model.power`."""
        if self._by_heading and "heading" not in q:
            every = [self.model.power(q | {"heading": heading}) for heading in HEADINGS]
            return {name: sum(each[name] for each in every) / len(every) for name in every[0]}
        return self.model.power(q, recall)

    def power(self, q: Quantities) -> float:
        """Power at the pack [W] with all effects settled."""
        return float(sum(self.powers(q).values()))

    def power_ridden(self, q: Quantities, dt: float) -> tuple[float, float]:
        """(power [W] over the last `dt` [s], power of riding the same again); a step of effects with memory."""
        powers = self.powers(q, stepping(self.states, dt))
        if self.ledger:
            for name, watts in powers.items():
                self.ledger.modelled[name] += watts * dt
        power = float(sum(powers.values()))
        if self._repeats:
            return power, power
        again = q | {"time_moving": q["time_moving"] + AHEAD}
        again.pop("heading", None)
        return power, self.power(again)

    def overpotential(self, battery: Battery) -> Overpotential | None:
        """Voltage [V] that a cell of `battery` loses to effects on the way to come, see `Model.overpotential`."""
        return self.model.overpotential(battery, {"vibration": self.prior.vibration, "time_moving": AHEAD})

    def prior_prices(self, ambient: float, altitude: float, mass: float | None = None) -> tuple[float, float]:
        """Energy per metre of the prior riding [J/m], in motion and at its stops.

        ambient in degC, altitude in m; mass: with rider and luggage [kg], by default as entered.
        """
        return self._prices(round(ambient, AMBIENT_DIGITS), round(altitude, ALTITUDE_DIGITS), mass or self.model.mass)

    def _model_prior(self, ambient: float, altitude: float, mass: float) -> tuple[float, float]:
        moving = standing = 0.0
        for share, speed, acceleration in self.prior.points:
            q = self.quantities(speed, acceleration, Conditions(ambient, altitude)) | {"mass": mass}
            price = share * self.power(q) * self.prior.unevenness / self.prior.speed
            if speed > MOVING:
                moving += price
            else:
                standing += price
        return moving, standing


class PresentLoad:
    """Load of the vehicle as it moves now, by the forward model. All methods take the time [s]."""

    def __init__(
        self,
        load: LoadModel,
        motion: Motion,
        temperatures: Temperatures,
        pack: BatteryPack,
        monitor: VibrationMonitor | None,
        signals: Signals,
    ) -> None:
        """monitor: for a model that reads the vibration."""
        self._load, self._motion, self._temperatures = load, motion, temperatures
        self._pack, self._monitor, self._motor_temperature = pack, monitor, signals.motor_temperature

    def conditions(self, now: float) -> Conditions:
        """Conditions of the riding, as far as they are known."""
        motion, motor = self._motion, self._motor_temperature.get(now)
        turning = motion.yaw_rate is not None and motion.speed is not None
        return Conditions(
            self._temperatures.ambient(now),
            motion.altitude or 0.0,
            WARM_MOTOR if motor is None else motor,
            (motion.speed or 0.0) * (motion.yaw_rate or 0.0) if turning else None,
            motion.heading,
            self._monitor.value(now) if self._monitor else None,
            self._pack.state.soc,
            self._temperatures.cells_or_bench,
            self._pack.vehicle.current or 0.0,
        )

    def power(self, now: float) -> float:
        """Power that the pack gives [W]."""
        motion = self._motion
        return self.power_at(now, motion.speed or 0.0, motion.acceleration or 0.0, motion.grade or 0.0)

    def power_at(self, now: float, speed: float, acceleration: float, grade: float = 0.0) -> float:
        """Power that the pack would give [W] at this speed [m/s], acceleration [m/s²] and grade (sine)."""
        load = self._load
        return load.power(load.quantities(speed, acceleration, self.conditions(now), grade, load.time_moving))

    def power_of_prior(self, now: float) -> float:
        """Power of the riding before the first voltage [W]: the prior's, or, where it rides faster, at its speed."""
        conditions, speed, usual = self.conditions(now), self._motion.speed or 0.0, self._load.prior.speed
        power = sum(self._load.prior_prices(conditions.ambient, conditions.altitude)) * usual
        return max(power, self.power_at(now, speed, 0.0)) if speed > usual else power

    def cell_inputs(self, now: float) -> dict[str, float]:
        """Inputs of effects in the cells, apart from those of the cells themselves."""
        return {"time_moving": self._load.time_moving, "vibration": self.vibration(now)}

    def vibration(self, now: float) -> float:
        """Vibration that effects read [m/s²]: the typical value while it is not known."""
        value = self._monitor.value(now) if self._monitor else None
        return self._load.prior.vibration * ((self._motion.speed or 0.0) > MOVING) if value is None else value
