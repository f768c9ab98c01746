"""The riding to be expected before anything is ridden."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import hypot, log, sqrt
from typing import TYPE_CHECKING

from gz_onboard.constants import GRAVITY, MILD, WH_PER_KM
from gz_onboard.physics.effect import QUANTITIES, failed
from gz_onboard.physics.model import Bound, air_density

if TYPE_CHECKING:
    from gz_onboard.physics.model import Model
    from gz_onboard.toml import Table


LATERAL = 1.1  # m/s², of the eight commissioning rides; each alone 0.26 (suburban) to 1.7 (oval)
DRIFT = 0.055  # of the eight commissioning rides, which stay in town or on one road
ANYWHERE = 0.2  # drift of what is fast enough for any road
TOWN_SPEED = 11.0  # m/s, the fastest of a scooter's usual riding
CRUISE, MOTORWAY = 0.8, 36.0  # what is ridden for long: of the top speed, and at most [m/s]
SCOOTER = 13.7, 105.0  # top speed [m/s] and mass [kg]; of kick scooters to cars it goes with the mass, about so
MOST_UNKNOWN = 0.75  # sd of the logarithm of the consumption: twice or half
VIBRATION = 1.3  # m/s², RMS while moving, of the median of the eight commissioning rides; each alone 1.14 to 1.43


@dataclass(frozen=True)
class PriorRiding:
    """A riding as operating points, and what the model makes of it.

    points: (share of time, speed [m/s], acceleration [m/s²]). unevenness: what hills and what lies between the
    points add to the energy modelled. factor, factor_sd: energy measured over modelled, and how that differs from
    ride to ride. drift: relative sd of what rides consume per metre, from ride to ride, before that is learned.
    lateral_acceleration, vibration: the root mean square while moving [m/s²]; only a model that reads it asks.
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
    drift: float = DRIFT
    lateral_acceleration: float = LATERAL
    vibration: float = VIBRATION

    @cached_property
    def speed(self) -> float:
        """Mean speed [m/s], stops included."""
        return sum(share * speed for share, speed, _ in self.points)


def usual_riding(model: Model, top_speed: float | None) -> PriorRiding:
    """The riding of a vehicle of which no more is known than `model` and its `top_speed` [m/s], if that.

    A scooter rides in town as in the first part of the WMTC; what is slower, slower. What is faster may ride in town or
    as fast as it can: the speed between at which the road load is the geometric mean of both, and not known by more
    than what either is from that.
    """
    town, p = PriorRiding(), model.parameters
    heavier = p["vehicle_mass"] / SCOOTER[1]
    top = top_speed or SCOOTER[0] * max(heavier**0.5, heavier**1.5)
    fast = round(min(CRUISE * top, MOTORWAY))
    if fast <= TOWN_SPEED:
        slower = tuple((share, speed * fast / TOWN_SPEED, a) for share, speed, a in town.points)
        return replace(town, points=slower)
    rolling, drag = p["rolling_resistance_constant"] * model.mass * GRAVITY, air_density(MILD) / 2 * p["drag_area"]
    in_town, at_most = (rolling + drag * speed**2 for speed in (TOWN_SPEED, fast))
    ratio = sqrt((sqrt(in_town * at_most) - rolling) / drag) / TOWN_SPEED
    between = tuple((share, speed if a else speed * ratio, a) for share, speed, a in town.points)
    unknown = min(hypot(town.factor_sd, log(at_most / in_town) / 2), MOST_UNKNOWN)
    return replace(town, points=between, factor_sd=unknown, drift=ANYWHERE)


def read_riding(vehicle: Table, model: Model, top_speed: float | None = None) -> PriorRiding:
    """The table ``[forecast]`` of a vehicle file; what it does not say is as in `usual_riding`.

    ``riding`` has rows of share of time, speed [m/s], acceleration [m/s²].
    """
    table = vehicle.table("forecast")
    table.only(["riding", "unevenness", "factor", "factor_sd", "drift", "lateral_acceleration", "vibration", "source"])
    town = PriorRiding() if "riding" in table.values else usual_riding(model, top_speed)
    if "riding" not in table.values:
        points = town.points
    else:
        rows = table.rows("riding", 3, "share of time, speed in m/s, acceleration in m/s²", -100, 100)
        points = tuple((share, speed, acceleration) for share, speed, acceleration in rows)
        shares = sum(share for share, _, _ in points)
        if not (all(share >= 0 and speed >= 0 for share, speed, _ in points) and 0.98 < shares < 1.02):
            raise table.error(
                f"shares and speeds must not be negative, shares add up to 1 (now {shares:.3f})", "riding"
            )
        if sum(share * speed for share, speed, _ in points) < 0.5:
            raise table.error("must move", "riding")
    return PriorRiding(
        points,
        table.number("unevenness", town.unevenness, 1.0, 2.0),
        table.number("factor", town.factor, 0.1, 10.0),
        table.number("factor_sd", town.factor_sd, 0.001, 1.0),
        table.number("drift", town.drift, 0.0, 1.0),
        table.number("lateral_acceleration", town.lateral_acceleration, 0.0, 9.0),
        table.number("vibration", town.vibration, 0.0, 20.0),
    )


def check_riding(vehicle: Table, riding: PriorRiding, model: Model) -> None:
    """InputError if `riding` costs no energy by `model`, on a level road in mild air: then there would be no range.

    Also if the code of an effect raises at it.
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
    for effect, (_, speed, acceleration) in product(model.effects, riding.points):
        try:
            float(Bound(effect, model.parameters)(ordinary | {"speed": speed, "acceleration": acceleration}))
        except (Exception, SystemExit) as error:  # of a user's own: better here than on the road
            raise failed(effect.file, error) from error
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
