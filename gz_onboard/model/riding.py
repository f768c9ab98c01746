"""The riding to be expected before anything is ridden."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import hypot, log, sqrt
from typing import TYPE_CHECKING

from gz_onboard.constants import GRAVITY, MILD, WH_PER_KM
from gz_onboard.model.effect import QUANTITIES, Port, failed
from gz_onboard.model.model import air_density

if TYPE_CHECKING:
    from gz_onboard.model.model import Model
    from gz_onboard.toml import Table

TOWN_SPEED = 11.0  # m/s, the fastest of a scooter's usual riding
ANYWHERE = 0.2  # drift of a vehicle that is fast enough for any road


@dataclass(frozen=True)
class PriorRiding:
    """Expected riding, as operating points, and how well the model describes it.

    points: (share of time, speed [m/s], acceleration [m/s²]). unevenness: factor on the modelled energy for hills and
    for the riding between the points. factor, factor_sd: energy measured over modelled, and its scatter from ride to
    ride. drift: relative sd of the consumption per metre, from ride to ride, before it is learned; the default is that
    of the eight commissioning rides, which stay in town or on one road. lateral_acceleration, vibration: root mean
    square while moving [m/s²], for models that read them; the defaults are the means of those rides, whose own values
    are 0.26 (suburban) to 1.7 (oval), and 1.14 to 1.43.
    """

    points: tuple[tuple[float, float, float], ...] = (
        (0.18, 0.0, 0.0),
        (0.10, 4.0, 0.8),
        (0.08, 9.0, 0.6),
        (0.08, 4.0, -1.1),
        (0.06, 9.0, -1.0),
        (0.20, 7.0, 0.0),
        (0.30, TOWN_SPEED, 0.0),
    )
    unevenness: float = 1.1
    factor: float = 1.0
    factor_sd: float = 0.15
    drift: float = 0.055
    lateral_acceleration: float = 1.1
    vibration: float = 1.3

    @cached_property
    def speed(self) -> float:
        """Mean speed [m/s], stops included."""
        return sum(share * speed for share, speed, _ in self.points)


@dataclass(frozen=True)
class UsualRiding:
    """How a vehicle is ridden about which nothing else is known."""

    scooter_speed: float = 13.7  # m/s, top speed of the scooter that the priors describe
    scooter_mass: float = 105.0  # kg; from kick scooters to cars, the top speed grows with about the mass
    cruise: float = 0.8  # of the top speed: ridden for long
    motorway: float = 36.0  # m/s, at most ridden for long
    largest_sd: float = 0.75  # of the logarithm of the consumption: twice or half


def usual_riding(model: Model, top_speed: float | None, usual: UsualRiding = UsualRiding()) -> PriorRiding:
    """The riding of a vehicle of which only `model` and perhaps its `top_speed` [m/s] are known.

    A scooter rides in town as in the first part of the WMTC; a slower vehicle, slower. A faster one may ride in town or
    as fast as it can: the speed between, at which the road load is the geometric mean of both, with an uncertainty that
    covers either.
    """
    town, p = PriorRiding(), model.parameters
    heavier = p["vehicle_mass"] / usual.scooter_mass
    top = top_speed or usual.scooter_speed * max(heavier**0.5, heavier**1.5)
    fast = round(min(usual.cruise * top, usual.motorway))
    if fast <= TOWN_SPEED:
        slower = tuple((share, speed * fast / TOWN_SPEED, a) for share, speed, a in town.points)
        return replace(town, points=slower)
    rolling, drag = p["rolling_resistance_constant"] * model.mass * GRAVITY, air_density(MILD) / 2 * p["drag_area"]
    in_town, at_most = (rolling + drag * speed**2 for speed in (TOWN_SPEED, fast))
    ratio = sqrt((sqrt(in_town * at_most) - rolling) / drag) / TOWN_SPEED
    between = tuple((share, speed if a else speed * ratio, a) for share, speed, a in town.points)
    unknown = min(hypot(town.factor_sd, log(at_most / in_town) / 2), usual.largest_sd)
    return replace(town, points=between, factor_sd=unknown, drift=ANYWHERE)


def read_riding(vehicle: Table, model: Model, top_spin: float | None = None) -> PriorRiding:
    """The table ``[forecast]`` of a vehicle file; a missing value is that of `usual_riding`.

    ``riding`` has rows of share of time, speed [m/s], acceleration [m/s²]. top_spin: the motor's highest speed [rad/s].
    """
    table = vehicle.table("forecast")
    limits = {
        "unevenness": (1.0, 2.0),
        "factor": (0.1, 10.0),
        "factor_sd": (0.001, 1.0),
        "drift": (0.0, 1.0),
        "lateral_acceleration": (0.0, 9.0),
        "vibration": (0.0, 20.0),
    }
    table.only(["riding", *limits, "source"])
    given = "riding" in table.values
    top_speed = top_spin and top_spin * model.parameters["wheel_radius"] / model.parameters["gear_ratio"]
    riding = PriorRiding() if given else usual_riding(model, top_speed)
    points = _read_points(table) if given else riding.points
    numbers = {name: table.number(name, getattr(riding, name), *limit) for name, limit in limits.items()}
    riding = replace(riding, points=points, **numbers)
    _check_riding(vehicle, riding, model)
    return riding


def _read_points(table: Table) -> tuple[tuple[float, float, float], ...]:
    rows = table.rows("riding", 3, "share of time, speed in m/s, acceleration in m/s²", -100, 100)
    points = tuple((share, speed, acceleration) for share, speed, acceleration in rows)
    shares = sum(share for share, _, _ in points)
    if not (all(share >= 0 and speed >= 0 for share, speed, _ in points) and 0.98 < shares < 1.02):
        raise table.error(f"shares and speeds must not be negative, shares add up to 1 (now {shares:.3f})", "riding")
    if sum(share * speed for share, speed, _ in points) < 0.5:
        raise table.error("must move", "riding")
    return points


def _check_riding(vehicle: Table, riding: PriorRiding, model: Model) -> None:
    """InputError if `riding` costs no energy by `model`, on a level road in mild air: then there would be no range.

    Also if the code of an effect raises an error there.
    """
    ordinary = dict.fromkeys(QUANTITIES, 0.0) | {
        "grade_cosine": 1.0,
        "mass": model.mass,
        "air_density": air_density(MILD),
        "motor_temperature": MILD,
        "ambient_temperature": MILD,
        "cell_temperature": MILD,
        "cell_capacity": model.parameters["cell_capacity"],
        "soc": 0.5,
        "lateral_acceleration": riding.lateral_acceleration,
        "vibration": riding.vibration,
    }
    for bound, (_, speed, acceleration) in product(model.at(*Port), riding.points):
        try:
            float(bound(ordinary | {"speed": speed, "acceleration": acceleration}))
        except (Exception, SystemExit) as error:  # of a user's own: better here than on the road
            raise failed(bound.effect.file, error) from error
    power = sum(
        share * sum(model.power(ordinary | {"speed": speed, "acceleration": acceleration}).values())
        for share, speed, acceleration in riding.points
    )
    if power > 0:
        return
    acceleration = sum(share * acceleration for share, _, acceleration in riding.points)
    costs = power / riding.speed / WH_PER_KM
    raise vehicle.table("forecast").error(
        f"by the model this riding costs {costs:.3g} Wh/km on a level road: it must cost energy. "
        f"Its mean acceleration is {acceleration:.2g} m/s² (of a whole ride 0); see [parameters] too",
        "riding",
    )
