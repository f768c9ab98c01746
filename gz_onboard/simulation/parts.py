"""Parts of the simulated scooter: road, rider, controller, driven wheel with tyre and brakes, battery pack.

Equations are those of Lord 2016, with the errata of docs/explanation/simulation.md.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import atan, cos, exp, sin, sqrt
from typing import Any, Protocol

from gz_onboard.constants import HOUR
from gz_onboard.model.battery import Battery
from gz_onboard.model.functions import direction
from gz_onboard.model.tables import Derating

Place = tuple[float, float, float]
"""(grade as the sine of the road's angle, curvature [1/m] positive to the left, headwind [m/s])."""
RoadProfile = Callable[[float], Place]
"""The road at a distance [m]."""

# --- road -------------------------------------------------------------------------------------------------------------


def straight(grade: float = 0.0, headwind: float = 0.0) -> RoadProfile:
    """Return an endless road without bends."""
    place = (grade, 0.0, headwind)
    return lambda distance: place


def road_table(
    distance: Sequence[float], grade: Sequence[float], curvature: Sequence[float] | None = None, headwind: float = 0.0
) -> RoadProfile:
    """Return a road in pieces: from each `distance` [m] on, a constant sine of grade and curvature [1/m]."""
    bends = curvature or [0.0] * len(grade)
    places = [(g, c, headwind) for g, c in zip(grade, bends, strict=True)]
    starts = list(distance)
    last = len(starts) - 1
    here = 0

    def road(at: float) -> Place:
        nonlocal here  # the piece does not change for many steps
        if starts[here] <= at and (here == last or at < starts[here + 1]):
            return places[here]
        here = min(max(bisect_right(starts, at) - 1, 0), last)
        return places[here]

    return road


@dataclass(frozen=True)
class Dynamometer:
    """A chassis dynamometer: a roller of `inertia` [kg at its surface] that brakes with A + B·V + C·V² [N].

    On it there is no air, grade or front wheel; tyre and rear axle load are as on the road.
    """

    inertia: float
    a: float = 0.0  # N
    b: float = 0.0  # N·s/m
    c: float = 0.0  # N·s²/m²

    def absorbed(self, speed: Any) -> Any:
        """Return the force [N] at a surface speed [m/s]."""
        return self.a * direction(speed) + self.b * speed + self.c * speed * abs(speed)


# --- rider and controller ---------------------------------------------------------------------------------------------


@dataclass
class Rider:
    """PI control of speed by throttle and brake (eqs. 3.13-3.16), with anti-windup. Gains in 1/(m/s) and 1/m.

    A rider who rolls back pulls the brake; on a hill that full throttle does not climb he stays, with both.
    """

    proportional: float = 1.5
    integral: float = 0.3
    sum: float = 0.0
    holds: bool = False  # rolled back while standing
    beaten: bool = False  # rolled back with the throttle open

    def step(self, wanted: float, speed: float, dt: float) -> tuple[float, float]:
        """Return (throttle, brake), each 0..1, for speeds in m/s.

        The integral stops where the command is at its limit (Åström 2006, sec. 3.5).
        """
        error = wanted - speed
        command = self.proportional * error + self.sum
        if -1 < command < 1 or error * command < 0:
            total = self.sum + self.integral * error * dt
            self.sum = -1.0 if total < -1.0 else 1.0 if total > 1.0 else total
        if wanted <= 0 and speed < 0.3:  # stands: holds the brake
            self.sum = min(self.sum, 0.0)
            self.holds, self.beaten = self.holds or speed < -0.05, False
            return 0.0, 1.0 if self.holds else min(max(-command, 0.3), 1.0)
        self.holds = False
        if self.beaten or (speed < -1.0 and command >= 1.0):  # more than a start uphill rolls back
            self.beaten = True
            return 1.0, 1.0
        if command >= 0:
            return (command if command < 1.0 else 1.0), 0.0
        return 0.0, (-command if command > -1.0 else 1.0)


@dataclass
class Controller:
    """Motor current by throttle, limited by speed, temperatures, voltage and SOC.

    The thesis names the controller and does not give it; the derating tables of the vehicle file replace it.
    """

    current_limit: float  # A
    regeneration_limit: float  # A
    derating: Derating = field(default_factory=Derating)
    _slow: float = field(default=1.0, init=False)
    _slow_regeneration: float = field(default=1.0, init=False)

    def watch(self, motor: float, inverter: float, cell: float, soc: float) -> None:
        """Take the temperatures [degC] and the SOC, about once a second."""
        d = self.derating
        temperatures = d.current_by_motor_temperature.at(motor) * d.current_by_inverter_temperature.at(inverter)
        self._slow = temperatures * d.current_by_cell_temperature.at(cell) * d.current_by_soc.at(soc)
        self._slow_regeneration = temperatures * d.regeneration_by_soc.at(soc)

    def current(self, throttle: float, brake: float, motor_speed: float, cell_voltage: float) -> float:
        """Return the motor current [A]: by the throttle; negative while braking. Rolling backwards does not brake."""
        d = self.derating
        if throttle > 0 and brake <= 0:
            share = d.current_by_motor_speed.at(motor_speed) * d.current_by_cell_voltage.at(cell_voltage)
            return throttle * self.current_limit * self._slow * share
        if brake > 0 and motor_speed > 0:
            share = self._slow_regeneration * d.regeneration_by_motor_speed.at(motor_speed)
            return -min(brake * d.regeneration_gain, 1.0) * self.regeneration_limit * share
        return 0.0


# --- driven wheel -----------------------------------------------------------------------------------------------------

RELAXATION_LENGTH_M = 0.12  # of the driven tyre, longitudinal
BRAKE_PASSES = 4  # of front and rear brake in turn, where both hold; each leaves a twentieth of their difference
FREELY_M_S = 0.5  # above it the front brake does all it can, for it stops nothing within a step


@dataclass
class Driveline:
    """Vehicle and driven wheel, coupled by the tyre, with the brakes (eqs. 2.11-2.14, 3.3, 3.8, 3.10-3.12).

    The tyre is the magic formula over longitudinal slip, which the carcass takes up over its relaxation length,
    σ·dκ/dt = V_t - V - |V|·κ (Pacejka 2012, eq. 7.9): at speed that is the printed slip, at standstill a spring, so
    that a braked scooter holds on a hill. The slip is stiff, so wheel, tyre and vehicle are solved at once; with the
    mean speeds of the step each force times its speed is exactly the change of kinetic energy. A brake gives a torque
    proportional to its command, and at standstill holds up to that; the front's share acts on the vehicle.
    """

    tyre: tuple[float, float, float, float]  # B, C, D, E of the magic formula
    brake_torque: float  # N·m of both brakes at full command
    front_share: float  # of it
    moving_mass: float  # kg
    wheel_inertia: float  # kg·m²
    has_front_wheel: bool
    slip: float = 0.0

    def friction(self, slip: float) -> tuple[float, float]:
        """Return (µ, dµ/dκ) of the tyre (eq. 3.12)."""
        b, c, d, e = self.tyre
        x = b * slip
        t = atan(x)
        y = x - e * (x - t)
        angle = c * atan(y)
        inner = 1 - e * (1 - 1 / (1 + x * x))
        return d * sin(angle), d * cos(angle) * c / (1 + y * y) * inner * b

    def step(
        self,
        v: float,
        w: float,
        torque: float,
        against: float,
        rolling: float,
        load: float,
        r: float,
        brake: float,
        dt: float,
    ) -> tuple[float, float, float, float, float]:
        """Advance by `dt` [s].

        v: speed of the vehicle [m/s]. w: of the driven wheel [rad/s]. torque: drives the wheel [N·m]. against, rolling:
        forces [N] against the vehicle and against the driven wheel. load: on the driven tyre [N]. r: radius of the
        wheel [m]. brake: command, 0..1. Returns the change of both speeds, the force of the driven tyre [N], the
        torque of the rear brake [N·m] and the force of the front brake [N].
        """
        # Slip at the end of the step is base + gain·(rim speed - vehicle speed).
        decay = 1 / (1 + dt * abs(v) / RELAXATION_LENGTH_M)
        base, gain = self.slip * decay, dt / RELAXATION_LENGTH_M * decay
        mu, slope = self.friction(base + gain * (r * w - v))
        grip, stiffness = load * mu, load * (slope if slope > 0.0 else 0.0) * gain
        m, j = self.moving_mass / dt, self.wheel_inertia / dt
        det = m * j + stiffness * (m * r * r + j)
        f1 = grip - against
        f2 = torque - r * (grip + rolling)
        braking = front_braking = 0.0
        if brake > 0.0:
            # How much each slows its own side and the other side of the tyre.
            by_torque, by_force, across = (m + stiffness) / det, (j + r * r * stiffness) / det, r * stiffness / det
            front = brake * self.front_share * self.brake_torque / r
            rear = brake * (1 - self.front_share) * self.brake_torque
            for _ in range(BRAKE_PASSES):
                if self.has_front_wheel:
                    to_stop = (v + by_force * f1 + across * (f2 - braking)) / by_force
                    front_braking = -front if to_stop < -front else front if to_stop > front else to_stop
                to_stop = (w + by_torque * f2 + across * (f1 - front_braking)) / by_torque
                braking = -rear if to_stop < -rear else rear if to_stop > rear else to_stop
                if v > FREELY_M_S:
                    break
            f1 -= front_braking
            f2 -= braking
        dw = ((m + stiffness) * f2 + r * stiffness * f1) / det
        dv = ((j + r * r * stiffness) * f1 + r * stiffness * f2) / det
        self.slip = base + gain * (r * (w + dw) - v - dv)
        return dv, dw, grip + stiffness * (r * dw - dv), braking, front_braking


# --- motor and pack ---------------------------------------------------------------------------------------------------


class Motor(Protocol):
    """A motor that replaces the effects of the vehicle's model."""

    name: str  # of its loss in the ledger

    def loss(self, speed: float, current: float, temperature: float) -> float:
        """Return the loss [W] at a shaft speed [rad/s], current [A] and stator temperature [degC].

        That without current is drag, which slows the shaft.
        """


class PackModel(Protocol):
    """A battery pack, as the scooter uses it."""

    soc: float

    def draw(self, power: float, dt: float, temperature: float) -> tuple[float, float, float, float]:
        """Deliver `power` [W] for `dt` [s] at a cell temperature [degC].

        Returns (pack current [A], terminal voltage [V], heat [W], power delivered [W]).
        """

    def chemical_energy_drawn(self) -> float:
        """Return the energy [J] that has left the cells' chemistry since the start."""


TABLE_PERIOD = 1.0  # s: R0, R1 and C1 follow SOC and temperature this often; both move slowly


class FirstOrderPack:
    """Equivalent circuit of one cell, R0 and one RC pair over SOC and temperature (eqs. 2.20-2.24).

    effects: their voltages [V] after one step, by `model.series.stepper` with the `dt` of `draw`; they act in the
    next step. quantities: read by the effects; the pack keeps those of the cells up to date. Voltage lost to effects
    is heat, and so is the energy that the RC pair's capacitor stores for a minute: heat = S·P·(V_oc - V_cell)·I_cell.
    """

    def __init__(
        self,
        battery: Battery,
        soc: float = 1.0,
        v1: float = 0.0,
        effects: Callable[[Mapping[str, float]], tuple[float, ...]] | None = None,
        quantities: dict[str, float] | None = None,
    ) -> None:
        self.battery = battery
        self._effects, self._q = effects, {} if quantities is None else quantities
        self.effect_voltages: tuple[float, ...] = ()  # V of a cell, in the order of the effects
        self._lost = 0.0  # V of a cell: their sum
        self.soc = soc
        self.v1 = v1  # V of a cell
        self._steps_left = 0  # until the tables are looked up again
        self._dt = 0.0
        self._resistance = 0.0  # ohm of the pack
        self._decay = self._gain = 0.0  # of the RC pair in a step; V for each A of the pack
        self._capacity = 1.0  # A·h of the pack
        self._soc_per_current = 0.0  # 1/A in a step
        self._shift = 0.0  # V of a cell
        self._drawn = 0.0  # J, up to the last look-up
        self._soc_before = soc  # at the last look-up

    def _look_up(self, temperature: float, dt: float) -> None:
        battery, soc = self.battery, self.soc
        self._drawn += self._between(self._soc_before, soc)
        self._soc_before = soc
        n, m = battery.cells_series, battery.cells_parallel
        r0, r1, c1 = battery.circuit(soc, temperature)
        self._q["cell_temperature"], self._q["cell_capacity"] = temperature, battery.cell_capacity(temperature)
        self._resistance = n * r0 / m + battery.series_resistance
        self._decay = exp(-dt / (r1 * c1))
        self._gain = (1 - self._decay) * r1 / m
        self._capacity = battery.pack_capacity(temperature)
        self._soc_per_current = dt / (HOUR * self._capacity)
        self._shift = battery.rest_shift(temperature)
        self._steps_left, self._dt = round(TABLE_PERIOD / dt), dt

    def draw(self, power: float, dt: float, temperature: float) -> tuple[float, float, float, float]:
        """See `PackModel`. The current is the root of V·I = P; where there is none, the current of greatest power."""
        if self._steps_left <= 0 or dt != self._dt:
            self._look_up(temperature, dt)
        self._steps_left -= 1
        battery, resistance = self.battery, self._resistance
        n = battery.cells_series
        ocv, slope = battery.ocv_curve.extended(self.soc)
        ocv += self._shift
        relaxing = n * (self.v1 + self._lost)
        source = n * ocv - relaxing
        root = source * source - 4 * resistance * power
        current = 2 * power / (source + sqrt(root)) if root >= 0 else source / (2 * resistance)
        used = current * self._soc_per_current
        # V_oc at the middle of the step, so that charge times voltage is the energy between the two SOCs.
        middle = n * (ocv - slope * used / 2)
        voltage = middle - resistance * current - relaxing
        self.soc -= used
        self.v1 = self._decay * self.v1 + self._gain * current
        if self._effects:
            q = self._q
            q["cell_current"], q["soc"] = current / battery.cells_parallel, self.soc
            self.effect_voltages = self._effects(q)
            self._lost = sum(self.effect_voltages)
        return current, voltage, (middle - voltage) * current, voltage * current

    def chemical_energy_drawn(self) -> float:
        """Return the integral of V_oc over the charge from the first SOC to the present one [J].

        It follows from the SOC alone, not from the energy delivered: the check of the energy balance relies on it.
        """
        return self._drawn + self._between(self._soc_before, self.soc)

    def _between(self, high: float, low: float) -> float:
        """The integral of V_oc over charge from SOC `low` to `high` [J], exact for its straight pieces."""
        ocv = self.battery.ocv
        sign = 1.0 if high >= low else -1.0
        a, b = (low, high) if high >= low else (high, low)
        knots = [a, *(x for x in self.battery.ocv_curve.x[1:-1] if a < x < b), b]
        total = sum((y - x) * (ocv(x)[0] + ocv(y)[0]) / 2 for x, y in pairwise(knots))
        total += (b - a) * self._shift
        return sign * total * self.battery.cells_series * HOUR * self._capacity
