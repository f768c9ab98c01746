"""Effect of a turn on the scooter, by one of the turning models: a part that can be replaced.

`StraightChassis` ignores turns (Lord 2016, eqs. 3.1-3.7). `SteadyTurn` takes the planar or leaning model (ch. 4) as a
table of steady turns over speed and lateral acceleration, made once: a turn lasts much longer than the 0.2 s in which
lean and tyres settle, and following the lateral motion itself would make a ride ten times slower.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from math import atan
from typing import NamedTuple, Protocol

from gz_onboard.constants import GRAVITY
from gz_onboard.errors import InputError, nearest
from gz_onboard.simulation.turning.leaning import LEAN_TIME, Leaning
from gz_onboard.simulation.turning.machine import Machine, MachineState, RoadConditions
from gz_onboard.simulation.turning.planar import Planar

MODELS: dict[str, type[Planar] | None] = {"straight": None, "planar": Planar, "leaning": Leaning}
TIGHTEST = 2.0  # m: a scooter's smallest circle, and the one to which the table goes
HARDEST = 8.0  # m/s²: 39 degrees of a thin disc; beyond what a scooter's stand clears
_SPEEDS = (0.5, 1.0, 2.0, 3.0, 4.5, 6.0, 8.0, 10.0, 12.5, 16.0, 20.0, 27.0, 35.0)  # m/s
_SHARES = 40  # of the greatest lateral acceleration, evenly


class Turn(NamedTuple):
    """Changes by a turn, compared with riding straight on."""

    resistance: float  # force against the motion over the vehicle's weight, beyond drag and rolling when upright
    front_load: float  # load that it moves to the front axle, over the weight
    height: float  # of the centre of gravity over the road, upright 1
    radius: float  # of the wheels, upright 1
    lean: float  # rad, positive right


STRAIGHT_ON = Turn(0.0, 0.0, 1.0, 1.0, 0.0)


class Chassis(Protocol):
    """A chassis, as the scooter uses it."""

    name: str
    beyond: float  # s in which the road turned harder than the model goes; its edge was taken

    def turn(self, speed: float, curvature: float, dt: float) -> Turn:
        """The turn after `dt` [s] on a road of `curvature` [1/m, positive left] at `speed` [m/s]."""


class StraightChassis:
    """Knows no turn."""

    name = "straight"
    beyond = 0.0

    def turn(self, speed: float, curvature: float, dt: float) -> Turn:
        """See `Chassis`."""
        return STRAIGHT_ON


class SteadyTurn:
    """A turning model as its steady turns. Lateral acceleration follows the road within the model's `LEAN_TIME`."""

    def __init__(self, name: str, model: Planar) -> None:
        self.name = name
        self.beyond = 0.0
        self.lateral = 0.0  # m/s², positive left, as the machine has it
        machine = model.machine
        grip = 0.8 * min(machine.front.friction, machine.rear.friction) * GRAVITY
        self._limits = [min(HARDEST, grip, speed * speed / TIGHTEST) for speed in _SPEEDS]
        self._table = [_steady_turns(model, speed, limit) for speed, limit in zip(_SPEEDS, self._limits, strict=True)]

    def turn(self, speed: float, curvature: float, dt: float) -> Turn:
        """See `Chassis`."""
        wanted = speed * abs(speed) * curvature
        self.lateral += (wanted - self.lateral) * min(dt / LEAN_TIME, 1.0)
        hard = abs(self.lateral)
        if hard < 1e-6:
            return STRAIGHT_ON
        speed = min(max(abs(speed), _SPEEDS[0]), _SPEEDS[-1])
        i = max(bisect_left(_SPEEDS, speed), 1) - 1
        part = (speed - _SPEEDS[i]) / (_SPEEDS[i + 1] - _SPEEDS[i])
        slow, fast = hard / self._limits[i], hard / self._limits[i + 1]
        if slow > 1.0:
            part = 1.0  # the slower of the two cannot turn as tightly
            if fast > 1.0:
                self.beyond += dt
        slow, fast = _SHARES * min(slow, 1.0), _SHARES * min(fast, 1.0)
        k, m = min(int(slow), _SHARES - 1), min(int(fast), _SHARES - 1)
        b, d = (1.0 - part) * (slow - k), part * (fast - m)
        a, c = 1.0 - part - b, part - d
        one, two = self._table[i], self._table[i + 1]
        resistance, load, height, radius, lean = [
            a * w + b * x + c * y + d * z for w, x, y, z in zip(one[k], one[k + 1], two[m], two[m + 1], strict=True)
        ]
        return Turn(resistance, load, height, radius, -lean if self.lateral > 0 else lean)


def chassis(name: str, parameters: Mapping[str, float]) -> Chassis:
    """The chassis of that name for a vehicle with these parameters; InputError if there is none."""
    if name not in MODELS:
        raise InputError(f"no chassis is called {name!r}; there are {', '.join(MODELS)}{nearest(name, MODELS)}")
    model = MODELS[name]
    return StraightChassis() if model is None else SteadyTurn(name, model(Machine.of(parameters)))


def _steady_turns(model: Planar, speed: float, limit: float) -> list[Turn]:
    """The steady turns at `speed` [m/s], held by the drive, from straight on to `limit` [m/s²], to the left."""
    m, road = model.machine, RoadConditions()
    weight = m.weight(road)
    drag, _ = m.resistance(speed, road)
    upright = m.rolling(speed) * weight
    turns = [STRAIGHT_ON]
    for k in range(1, _SHARES + 1):
        state, steer = steady_turn(model, speed, limit * k / _SHARES / speed)
        rates = model.rates(state, steer, None, road)
        posture = model.posture(state, steer)
        level = (weight * m.cg_to_rear - posture.cg_height * drag) / m.wheelbase
        turns.append(
            Turn(
                resistance=(rates.seen["drive"] - drag - upright) / weight,
                front_load=(rates.seen["load_front"] - level) / weight,
                height=posture.cg_height / m.cg_height,
                radius=posture.radius / m.wheel_radius,
                lean=abs(rates.seen["lean"]),
            )
        )
    return turns


def steady_turn(model: Planar, speed: float, rate: float) -> tuple[MachineState, float]:
    """(state, steer) of the steady turn at `speed` [m/s] and a yaw rate [rad/s].

    Newton's method on lateral speed and steer, from the turn of wheels that do not slip. Raises ArithmeticError where
    there is none: beyond the tyres' grip.
    """
    x = model.machine.cg_to_rear * rate
    lean = model.posture(model.settled(speed, x, rate, 0.0), 0.0).lean
    y = model.handlebar(atan(model.machine.wheelbase * rate / speed), lean)
    for _ in range(60):
        state = model.settled(speed, x, rate, y)
        off = _drift(model, state, y)
        if abs(off[0]) < 1e-10 and abs(off[1]) < 1e-10:
            return state, y
        h = 1e-6
        a = _drift(model, model.settled(speed, x + h, rate, y), y)
        b = _drift(model, model.settled(speed, x, rate, y + h), y + h)
        xx, xy, yx, yy = (a[0] - off[0]) / h, (b[0] - off[0]) / h, (a[1] - off[1]) / h, (b[1] - off[1]) / h
        det = xx * yy - xy * yx
        dx, dy = (off[1] * xy - off[0] * yy) / det, (off[0] * yx - off[1] * xx) / det
        scale = min(1.0, 0.2 / max(abs(dy), 1e-12), 0.3 * speed / max(abs(dx), 1e-12))
        x, y = x + scale * dx, y + scale * dy
    raise ArithmeticError(f"no steady turn at {speed:g} m/s and {rate:g} rad/s")


def _drift(model: Planar, state: MachineState, steer: float) -> tuple[float, float]:
    """Rates of lateral speed and yaw rate, whose zero is the steady turn."""
    change = model.rates(state, steer, None, RoadConditions()).change
    return change[1], change[2]
