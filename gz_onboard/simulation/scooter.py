"""The scooter of the thesis, forward-looking: force forward, speed back (Lord 2016, figs. 2.1 and 3.1).

Each step takes throttle and brake, finds the motor current that the controller allows, the torque at the wheel, the
tyre's force and from it the new speeds of wheel and vehicle; then, with the speeds at the middle of the step, every
watt from the battery to the road. Wheel, tyre and vehicle are solved together and implicitly, because the tyre's slip
is stiff: with the mean speeds of the step each force times its speed is exactly the change of kinetic energy, and the
ledger closes to rounding.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from math import atan, sqrt
from typing import Any

from gz_onboard.constants import GRAVITY
from gz_onboard.physics.cooling import PERIOD, InverterCooling, LumpedCooling, MotorCooling
from gz_onboard.physics.effect import MOVING, QUANTITIES, Effect, Port
from gz_onboard.physics.elementary import direction
from gz_onboard.physics.model import Bound, air_density, drag_torque, remembering
from gz_onboard.simulation.parts.battery import EffectPack, FirstOrderPack, Pack
from gz_onboard.simulation.parts.brakes import Brakes
from gz_onboard.simulation.parts.chassis import STRAIGHT_ON, Chassis, StraightChassis
from gz_onboard.simulation.parts.controller import Controller
from gz_onboard.simulation.parts.motor import Call, EffectMotor, Losses, Motor
from gz_onboard.simulation.parts.tyre import Tyre
from gz_onboard.vehicle import Vehicle

STEP = 0.01  # s
WHEEL_ONLY = {"speed", "motor_speed", "time_moving"}
"""What a force may read to act on a dynamometer too: it is at the wheel, not of air, hill or bend."""
BRAKE_PASSES = 4  # of front and rear brake in turn, where both hold; each leaves a twentieth of what they disagree by
VOLTAGE_FILTER = 0.3  # s: the controller's own; without one, current and sag would chase each other each step

Place = tuple[float, float, float]
"""(grade as the sine of the road's angle, curvature [1/m] positive to the left, headwind [m/s])."""
Road = Callable[[float], Place]
"""The road at a distance [m]."""


def straight(grade: float = 0.0, headwind: float = 0.0) -> Road:
    """A road without end or bend."""
    place = (grade, 0.0, headwind)
    return lambda distance: place


@dataclass(frozen=True)
class Dynamometer:
    """A chassis dynamometer: a roller of `inertia` [kg at its surface] that brakes with A + B·V + C·V² [N].

    On it there is no air, no grade and no front wheel; tyre and rear axle load are as on the road.
    """

    inertia: float
    a: float = 0.0  # N
    b: float = 0.0  # N·s/m
    c: float = 0.0  # N·s²/m²

    def absorbed(self, speed: Any) -> Any:
        """The force [N] at a surface speed [m/s]."""
        return self.a * direction(speed) + self.b * speed + self.c * speed * abs(speed)


@dataclass
class Ledger:
    """Energy [J] by where it went, since the start."""

    entries: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))

    def total(self) -> float:
        """The sum of all entries."""
        return sum(self.entries.values())


class Scooter:
    """The assembled scooter; its state is the loop variable of a simulation.

    `pack`, `motor`, `chassis` may be replaced by any object with the methods of `Pack`, `Motor`, `Chassis`; a chassis
    that turns is refused (InputError) beside the effect `cornering_drag`, which is the same loss. The other parts are
    attributes, to be set before the first step; effects of the model in the cells act in the own pack only.
    `vibration` [m/s²], a number or over distance [m], is how rough the road is wherever the scooter moves; if not given
    what the vehicle's file expects, on a roller 0. Temperatures in degC; `heading`, in rad clockwise from north, is
    that over distance [m], or that where the road begins and its curvature turns.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        road: Road | Dynamometer | None = None,
        *,
        soc: float = 1.0,
        ambient: float = 20.0,
        cell_temperature: float | None = None,
        altitude: float = 0.0,
        speed: float = 0.0,
        dt: float = STEP,
        pack: Pack | None = None,
        motor: Motor | None = None,
        tyre_form: str = "transient",
        brake_form: str = "friction",
        heading: float | Callable[[float], float] = 0.0,
        vibration: float | Callable[[float], float] | None = None,
        chassis: Chassis | None = None,
    ) -> None:
        if vehicle.battery is None:
            raise vehicle.error("has no [battery], which a simulation needs")
        p = vehicle.parameters
        self.chassis: Chassis = chassis or StraightChassis()
        for effect in vehicle.model.effects if self.chassis.name != "straight" else ():
            if effect.turning_loss:
                raise vehicle.error(
                    f"model.effects lists {effect.name}, and the {self.chassis.name} chassis has the same loss: "
                    "it would count twice; take one of them"
                )
        self.dt = dt
        self.vehicle = vehicle
        self.dynamometer = road if isinstance(road, Dynamometer) else None
        self.road: Road = straight() if road is None or isinstance(road, Dynamometer) else road
        self.ambient = ambient
        self.speed = speed  # m/s
        self.wheel_speed = speed / p["wheel_radius"]  # rad/s
        self.distance = 0.0  # m
        self.climb = 0.0  # m
        self.time = 0.0  # s
        self.current = 0.0  # A of the pack
        cells = ambient if cell_temperature is None else cell_temperature
        self.voltage = vehicle.battery.cells_series * vehicle.battery.ocv(soc, cells)[0]
        self.sensed_voltage = self.voltage  # V, as the controller has it
        self._series = vehicle.battery.cells_series
        self._voltage_gain = min(dt / VOLTAGE_FILTER, 1.0)
        self.motor_current = 0.0  # A
        self.throttle = self.brake = 0.0
        self.force = 0.0  # N, of the driven tyre
        self.rear_load = self.front_load = 0.0  # N
        self.ledger = Ledger()
        self._heading_at = heading if callable(heading) else None
        self.start_heading = self.heading = heading(0.0) if callable(heading) else heading  # rad
        self.time_moving = 0.0  # s
        if vibration is None:
            vibration = 0.0 if self.dynamometer else vehicle.riding.vibration
        self._vibration_at = vibration if callable(vibration) else None
        self._rough = 0.0 if callable(vibration) else vibration
        self.vibration = 0.0  # m/s², of a vehicle whose effects read it
        self._q: dict[str, float] = dict.fromkeys((*QUANTITIES, "yaw_rate", "lean"), 0.0)
        model = vehicle.model
        own: Pack
        if model.cell_voltage:
            own = EffectPack(vehicle.battery, soc, [effect for _, effect in model.cell_voltage], self._q)
        else:
            own = FirstOrderPack(vehicle.battery, soc)
        self.pack: Pack = pack or own
        effects = model.effects
        at = {port: [e for e in effects if e.port is port] for port in Port}
        self._tracks = bool(
            model.reads & {"heading", "time_moving", "soc", "cell_temperature", "cell_current", "vibration"}
        )
        # Forces that read the acceleration are the dynamics that this simulation integrates itself.
        forces = [e for e in at[Port.WHEEL_FORCE] if "acceleration" not in e.quantities]
        if self.dynamometer:
            forces = [e for e in forces if e.reads <= WHEEL_ONLY]
        self._forces = _calls(forces, p, dt)
        self._stores = {e.name for e in forces if e.stores_energy}
        self._rolling = _calls(at[Port.TYRE], p, dt)
        self._inverter = Losses(_calls(at[Port.INVERTER_LOSS], p, dt), dt)
        self._dc = Losses(_calls(at[Port.DC_POWER], p, dt), dt)
        constants = p["torque_constant"], p["voltage_constant"]
        losses = [Bound(effect, p) for effect in at[Port.MOTOR_LOSS]]
        booked = Losses([(e.effect.name, remembering(e, dt)) for e in losses], dt)
        self.motor: Motor = motor or EffectMotor(booked, losses, *constants, self._q)
        self.tyre = Tyre(p["tyre_b"], p["tyre_c"], p["tyre_d"], p["tyre_e"], form=tyre_form)
        self.brakes = Brakes(
            p["brake_torque_limit"],
            p["brake_viscous_constant"],
            p["brake_disc_radius"],
            p["front_brake_share"],
            form=brake_form,
        )
        regeneration = p["regeneration_torque_limit"] / p["torque_constant"]
        self.controller = Controller(p["motor_current_limit"], regeneration, vehicle.derating)
        self.inverter_cooling = InverterCooling.of(p, ambient)
        self.motor_cooling = MotorCooling.of(p, ambient)
        self.pack_cooling = LumpedCooling.of(p, "pack", cells)
        self.bms_cooling = LumpedCooling.of(p, "bms", cells)
        self._air = p["cooling_factor"]
        self._radius = p["wheel_radius"]
        self._gear = p["gear_ratio"]
        self._gear_efficiency = p["gear_efficiency"]
        self._bms_resistance = p["bms_resistance"]
        self._mass = self.dynamometer.inertia if self.dynamometer else vehicle.model.mass
        self._weight = vehicle.model.mass * GRAVITY
        self._turns = self.chassis.name != "straight" and not self.dynamometer
        self._turn = STRAIGHT_ON
        self._rear_share = 1 - p["cg_to_rear"] / p["wheelbase"]
        self._lever = p["cg_height"] / p["wheelbase"]
        front = 0.0 if self.dynamometer else p["wheel_inertia_front"] / self._radius**2
        self._moving_mass = self._mass + front  # the front wheel rolls without slip
        self._inertia = p["wheel_inertia_rear"]
        density = air_density(ambient, altitude)
        self._q.update(mass=model.mass, air_density=density, grade_cosine=1.0, motor_temperature=ambient)
        self._q.update(ambient_temperature=ambient, heading=self.heading)
        self._q["cell_capacity"] = vehicle.battery.cell_capacity(cells)
        self._heat = {"inverter": 0.0, "motor": 0.0, "pack": 0.0, "bms": 0.0}  # J in the current cooling period
        self._since_cooling = 0.0
        self._watch()

    @property
    def lean(self) -> float:
        """[rad], positive right; 0 of a chassis that does not lean."""
        return self._turn.lean

    def kinetic_energy(self) -> float:
        """Of vehicle and wheels [J]."""
        return 0.5 * (self._moving_mass * self.speed**2 + self._inertia * self.wheel_speed**2)

    def potential_energy(self) -> float:
        """Over the start [J]."""
        return 0.0 if self.dynamometer else self._weight * self.climb

    def step(self, throttle: float, brake: float) -> None:
        """One step with throttle and brake [0..1]."""
        dt, q, entries, dynamometer = self.dt, self._q, self.ledger.entries, self.dynamometer
        v, w, r, gear = self.speed, self.wheel_speed, self._radius, self._gear
        self.throttle, self.brake = throttle, brake

        # --- what acts (eqs. 2.1, 2.8, 3.1, 3.2, 3.5-3.7, 3.9)
        grade, curvature, headwind = self.road(self.distance)
        cosine = sqrt(1 - grade * grade) if grade else 1.0
        q["speed"], q["grade"], q["grade_cosine"], q["headwind"] = v, grade, cosine, headwind
        if curvature:
            lateral = v * v * curvature
            q["yaw_rate"], q["lateral_acceleration"], q["lean"] = v * curvature, lateral, -atan(lateral / GRAVITY)
        elif q["yaw_rate"]:
            q["yaw_rate"] = q["lateral_acceleration"] = q["lean"] = 0.0
        if self._tracks:
            self._track(curvature)
        normal = self._weight * cosine
        turning = 0.0
        if self._turns:
            turn = self._turn = self.chassis.turn(v, curvature, dt)
            turning = turn.resistance * normal * direction(v)
            q["lean"] = turn.lean
            r *= turn.radius
            # The tyres hold back at the ground: what of their force moves load is what pushes the machine.
            shift = (self.force - turning) * self._lever * turn.height - turn.front_load * normal
        else:
            shift = self.force * self._lever
        rear = normal * self._rear_share + shift
        if rear < 0.05 * normal:
            rear = 0.05 * normal
        elif rear > normal:
            rear = normal
        self.rear_load, self.front_load = rear, normal - rear
        self.sensed_voltage += (self.voltage - self.sensed_voltage) * self._voltage_gain
        current = self.controller.current(throttle, brake, w / gear, self.sensed_voltage / self._series)
        # The motor's current makes torque in the air gap; what turning costs without current is drag on the shaft.
        idle = self.motor.idle(w / gear, self.motor_cooling.stator)
        torque = self.motor.torque_constant * current - drag_torque(idle, w / gear)
        drive = torque / gear * (self._gear_efficiency if torque * w >= 0 else 1 / self._gear_efficiency)

        against = 0.0
        forces = [term(q) for _, term in self._forces]
        for newton in forces:
            against += newton
        rolling = [term(q) for _, term in self._rolling]
        rear_rolling = front_rolling = 0.0
        share = rear / normal
        front_share = 0.0 if dynamometer else 1 - share
        for newton in rolling:
            rear_rolling += share * newton
            front_rolling += front_share * newton
        against += front_rolling + turning
        absorbed = 0.0
        if d := dynamometer:
            absorbed = d.absorbed(v)
            against += absorbed

        # --- wheel, tyre and vehicle together, implicit in the slip (eqs. 2.11, 3.3, 3.8, 3.10-3.12)
        base, gain, _ = self.tyre.linear(r * w, v, dt)
        slip = base + gain * (r * w - v)
        mu, slope = self.tyre.friction(slip)
        grip, stiffness = rear * mu, rear * (slope if slope > 0.0 else 0.0) * gain
        m, j = self._moving_mass / dt, self._inertia / dt
        det = m * j + stiffness * (m * r * r + j)
        f1 = grip - against
        f2 = drive - r * (grip + rear_rolling)
        braking = front_braking = 0.0
        if brake > 0.0:
            # How much each slows what it is on and what is on the other side of the tyre.
            by_torque, by_force, across = (m + stiffness) / det, (j + r * r * stiffness) / det, r * stiffness / det
            for _ in range(BRAKE_PASSES):
                if not dynamometer:
                    to_stop = (v + by_force * f1 + across * (f2 - braking)) / by_force
                    front_braking = self.brakes.front_force(brake, v, r, to_stop)
                to_stop = (w + by_torque * f2 + across * (f1 - front_braking)) / by_torque
                braking = self.brakes.torque(brake, w, to_stop)
                if v > 0.5:  # the front brake does all it can: it stops nothing within a step
                    break
            f1 -= front_braking
            f2 -= braking
        dw = ((m + stiffness) * f2 + r * stiffness * f1) / det
        dv = ((j + r * r * stiffness) * f1 + r * stiffness * f2) / det
        force = grip + stiffness * (r * dw - dv)
        self.tyre.slip = base + gain * (r * (w + dw) - v - dv)
        self.force = force
        v_mean, w_mean = v + dv / 2, w + dw / 2
        self.speed, self.wheel_speed = v + dv, w + dw
        self.distance += v_mean * dt
        self.climb += grade * v_mean * dt
        self.time += dt

        # --- every watt (eqs. 2.2-2.6, 2.9, 2.10, 2.16-2.19)
        for (name, _), newton in zip(self._forces, forces, strict=True):
            if name not in self._stores:  # what stores energy is in the kinetic and potential energy
                entries[name] += newton * v_mean * dt
        if turning:
            entries["turning"] += turning * v_mean * dt
        if dynamometer:
            entries["dynamometer"] += absorbed * v_mean * dt
        turned = share * r * w_mean + front_share * v_mean
        for (name, _), newton in zip(self._rolling, rolling, strict=True):
            entries[name] += newton * turned * dt
        entries["tyre_slip"] += force * (r * w_mean - v_mean) * dt
        entries["brakes"] += (braking * w_mean + front_braking * v_mean) * dt
        motor_speed = w_mean / gear
        mechanical = torque * motor_speed
        entries["gearing"] += (mechanical - drive * w_mean) * dt
        q["torque"] = self.motor.torque_constant * current
        motor_heat = self.motor.heat(motor_speed, current, self.motor_cooling.stator, dt, entries)
        q["motor_speed"], q["motor_current"] = motor_speed, current
        inverter_heat = self._inverter.total(q, entries)
        power = mechanical + motor_heat + inverter_heat + self._dc.total(q, entries)
        bms_heat = self._bms_resistance * self.current * self.current
        entries["bms"] += bms_heat * dt
        power += bms_heat
        self.current, self.voltage, pack_heat, delivered = self.pack.draw(power, dt, self.pack_cooling.temperature)
        entries["battery_heat"] += pack_heat * dt
        if power - delivered > 1e-6 * abs(power):
            entries["not_delivered"] -= (power - delivered) * dt
        self.motor_current = current

        heat = self._heat
        heat["motor"] += motor_heat * dt
        heat["inverter"] += inverter_heat * dt
        heat["pack"] += pack_heat * dt
        heat["bms"] += bms_heat * dt
        self._since_cooling += dt
        if self._since_cooling >= PERIOD - 1e-9:
            self._cool(self._since_cooling)

    def _track(self, curvature: float) -> None:
        """What effects read beyond speed and road, up to date before the step."""
        q = self._q
        if self._heading_at:
            self.heading = self._heading_at(self.distance)
        else:
            self.heading -= self.speed * curvature * self.dt
        if self.speed > MOVING:
            self.time_moving += self.dt
            self.vibration = self._vibration_at(self.distance) if self._vibration_at else self._rough
        else:
            self.vibration = 0.0
        q["vibration"] = self.vibration
        q["heading"], q["time_moving"] = self.heading, self.time_moving
        q["soc"], q["cell_temperature"] = self.pack.soc, self.pack_cooling.temperature
        q["cell_current"] = self.current / self.vehicle.pack.cells_parallel

    def _cool(self, dt: float) -> None:
        """The cooling networks, with the mean heat of the period (eqs. 2.25-2.31)."""
        heat = self._heat
        self.inverter_cooling.step(dt, heat["inverter"] / dt, self.ambient, self._air)
        self.motor_cooling.step(dt, heat["motor"] / dt, self.ambient, self._air)
        self.pack_cooling.step(dt, heat["pack"] / dt, self.ambient, self._air)
        self.bms_cooling.step(dt, heat["bms"] / dt, self.pack_cooling.temperature)
        for name in heat:
            heat[name] = 0.0
        self._since_cooling = 0.0
        self._q["motor_temperature"] = self.motor_cooling.stator
        self._watch()

    def _watch(self) -> None:
        motor, inverter = self.motor_cooling.stator, self.inverter_cooling.board
        self.controller.watch(motor, inverter, self.pack_cooling.temperature, self.pack.soc)


def _calls(effects: Iterable[Effect], parameters: Mapping[str, float], dt: float) -> list[Call]:
    return [(effect.name, remembering(Bound(effect, parameters), dt)) for effect in effects]
