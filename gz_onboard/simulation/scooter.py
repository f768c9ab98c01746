"""The scooter of the thesis, forward-looking: force forward, speed back (Lord 2016, figs. 2.1 and 3.1).

Each step takes throttle and brake, finds the motor current that the controller allows, the torque at the wheel, the
tyre's force and from it the new speeds of wheel and vehicle; then, with the speeds at the middle of the step, every
watt from the battery to the road. Wheel, tyre and vehicle are solved together and implicitly, because the tyre's slip
is stiff: with the mean speeds of the step each force times its speed is exactly the change of kinetic energy, and the
ledger closes to rounding.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from math import sqrt
from typing import TypedDict, Unpack

from gz_onboard.constants import GRAVITY, MILD
from gz_onboard.model.effect import MOVING, QUANTITIES, Port
from gz_onboard.model.functions import direction
from gz_onboard.model.model import air_density, drag_torque
from gz_onboard.offline.cooling import PERIOD, InverterCooling, LumpedCooling, MotorCooling
from gz_onboard.offline.series import stepper
from gz_onboard.offline.traits import traits
from gz_onboard.simulation.parts.battery import FirstOrderPack, PackModel
from gz_onboard.simulation.parts.brakes import Brakes
from gz_onboard.simulation.parts.chassis import STRAIGHT_ON, Chassis, StraightChassis
from gz_onboard.simulation.parts.controller import Controller
from gz_onboard.simulation.parts.driveline import Driveline
from gz_onboard.simulation.parts.motor import EffectMotor, Motor
from gz_onboard.simulation.parts.road import Dynamometer, RoadProfile, straight
from gz_onboard.simulation.parts.tyre import Tyre
from gz_onboard.vehicle import Vehicle

STEP = 0.01  # s
WHEEL_ONLY = {"speed", "motor_speed", "time_moving"}
"""What a force may read to act on a dynamometer too: it is at the wheel, not of air, hill or bend."""
SURROUNDINGS = frozenset({"heading", "time_moving", "vibration"})
CELLS = frozenset({"soc", "cell_temperature", "cell_current"})
LEAST_LOAD = 0.05  # of the weight, on the rear axle
VOLTAGE_FILTER = 0.3  # s: the controller's own; without one, current and sag would chase each other each step


class Options(TypedDict, total=False):
    """Start of a simulation, and parts that replace the vehicle's own."""

    soc: float  # 1 if not given
    ambient: float  # degC; 20
    cell_temperature: float | None  # degC; the ambient
    altitude: float  # m; 0
    speed: float  # m/s; 0
    dt: float  # s; STEP
    heading: float | Callable[[float], float]  # rad clockwise from north: where the road begins, or over distance [m]
    vibration: float | Callable[[float], float] | None  # m/s²: how rough the road is, or over distance [m]
    pack: PackModel | None
    motor: Motor | None
    chassis: Chassis | None
    tyre_form: str  # transient; or steady, as the thesis prints it, see `Tyre`
    brake_form: str  # friction; or viscous, as the thesis prints it, see `Brakes`


class Scooter:
    """The assembled scooter; its state is the loop variable of a simulation.

    `pack`, `motor`, `chassis` may be any objects with the methods of `PackModel`, `Motor`, `Chassis`. A chassis that
    turns is refused (InputError) together with an effect that is the same loss. Effects of the model in the cells act
    in `FirstOrderPack` only. Without `vibration` a road is as rough as the vehicle's file expects, and a roller smooth.
    `heading` by a number turns with the road.
    """

    def __init__(
        self, vehicle: Vehicle, road: RoadProfile | Dynamometer | None = None, **options: Unpack[Options]
    ) -> None:
        if vehicle.battery is None:
            raise vehicle.error("has no [battery], which a simulation needs")
        self.vehicle = vehicle
        self.dynamometer = road if isinstance(road, Dynamometer) else None
        self.road: RoadProfile = straight() if road is None or isinstance(road, Dynamometer) else road
        self.dt = options.get("dt", STEP)
        self.ambient = options.get("ambient", MILD)
        self.speed = options.get("speed", 0.0)  # m/s
        self.wheel_speed = self.speed / vehicle.parameters["wheel_radius"]  # rad/s
        self.distance = self.climb = 0.0  # m
        self.time = self.time_moving = 0.0  # s
        self.current = self.motor_current = 0.0  # A; of the pack, of the motor
        self.throttle = self.brake = 0.0
        self.force = self.rear_load = self.front_load = 0.0  # N; of the driven tyre, on the axles
        self.ledger = defaultdict[str, float](float)  # J by where it went, since the start
        self._q: dict[str, float] = dict.fromkeys(QUANTITIES, 0.0)
        self._begin(options)
        cells = options.get("cell_temperature")
        self._build_electric(options, self.ambient if cells is None else cells)
        self._build_mechanic(options)
        self._watch()

    def _begin(self, options: Options) -> None:
        """The surroundings that effects read."""
        heading, rough = options.get("heading", 0.0), options.get("vibration")
        self._heading_at = heading if callable(heading) else None
        self.start_heading = self.heading = heading(0.0) if callable(heading) else heading  # rad
        if rough is None:
            rough = 0.0 if self.dynamometer else self.vehicle.riding.vibration
        self._vibration_at = rough if callable(rough) else None
        self._rough = 0.0 if callable(rough) else rough
        self.vibration = 0.0  # m/s², of a vehicle whose effects read it
        model = self.vehicle.model
        outside = [effect.reads for effect in model.effects if effect.port is not Port.CELL_VOLTAGE]
        self._tracks = bool(model.reads & SURROUNDINGS or CELLS & frozenset().union(*outside))
        self._q |= {
            "mass": model.mass,
            "air_density": air_density(self.ambient, options.get("altitude", 0.0)),
            "grade_cosine": 1.0,
            "motor_temperature": self.ambient,
            "ambient_temperature": self.ambient,
            "heading": self.heading,
        }

    def _build_electric(self, options: Options, celsius: float) -> None:
        """Pack, motor, inverter and what cools them; celsius: the cells' temperature."""
        vehicle, p, dt = self.vehicle, self.vehicle.parameters, self.dt
        model, battery, soc = vehicle.model, vehicle.pack, options.get("soc", 1.0)
        self.voltage = battery.cells_series * battery.ocv(soc, celsius)[0]
        self.sensed_voltage = self.voltage  # V, as the controller has it
        self._series = battery.cells_series
        self._voltage_gain = min(dt / VOLTAGE_FILTER, 1.0)
        self._q["cell_capacity"] = battery.cell_capacity(celsius)
        cells = model.at(Port.CELL_VOLTAGE)
        inside = stepper(cells, dt) if cells else None
        self.pack: PackModel = options.get("pack") or FirstOrderPack(battery, soc, effects=inside, quantities=self._q)
        self._inverter = stepper(model.at(Port.INVERTER_LOSS), dt, booked=True)
        self._dc = stepper(model.at(Port.DC_POWER), dt, booked=True)
        constants = p["torque_constant"], p["voltage_constant"]
        self.motor: Motor = options.get("motor") or EffectMotor(model.at(Port.MOTOR_LOSS), dt, *constants, self._q)
        regeneration = p["regeneration_torque_limit"] / p["torque_constant"]
        self.controller = Controller(p["motor_current_limit"], regeneration, vehicle.derating)
        self.inverter_cooling = InverterCooling(p, self.ambient, self.ambient)
        self.motor_cooling = MotorCooling(p, self.ambient, self.ambient)
        self.pack_cooling = LumpedCooling(p, "pack", celsius)
        self.bms_cooling = LumpedCooling(p, "bms", celsius)
        self._cooling_factor = p["cooling_factor"]
        self._bms_resistance = min(p["bms_resistance"], battery.series_resistance)  # its part of it
        # J in the current cooling period; idle: the motor's part that comes without current
        self._heat = {"inverter": 0.0, "motor": 0.0, "idle": 0.0, "pack": 0.0, "bms": 0.0}
        self._charge = 0.0  # A·s out of the pack in that period
        self._since_cooling = 0.0

    def _build_mechanic(self, options: Options) -> None:
        """Chassis, tyre, brakes and the forces of the road."""
        model, p, roller = self.vehicle.model, self.vehicle.parameters, self.dynamometer
        self.chassis: Chassis = options.get("chassis") or StraightChassis()
        for effect in model.effects if self.chassis.name != "straight" else ():
            if traits(effect).turning_loss:
                raise self.vehicle.error(
                    f"model.effects lists {effect.name}, and the {self.chassis.name} chassis has the same loss: "
                    "it would count twice; take one of them"
                )
        tyre = Tyre(p["tyre_b"], p["tyre_c"], p["tyre_d"], p["tyre_e"], form=options.get("tyre_form", "transient"))
        disc = p["brake_torque_limit"], p["brake_viscous_constant"], p["brake_disc_radius"]
        brakes = Brakes(*disc, p["front_brake_share"], options.get("brake_form", "friction"))
        # Forces that read the acceleration are the dynamics that this simulation integrates itself.
        forces = [e for e in model.at(Port.WHEEL_FORCE) if "acceleration" not in e.effect.reads]
        if roller:
            forces = [e for e in forces if e.effect.reads <= WHEEL_ONLY]
        rolling = model.at(Port.TYRE)
        # The energy of effects that store it is booked as kinetic and potential energy.
        self._force_names, self._rolling_names = (
            [(i, x.effect.name) for i, x in enumerate(effects) if not x.effect.stores_energy]
            for effects in (forces, rolling)
        )
        self._forces, self._rolling = stepper(forces, self.dt), stepper(rolling, self.dt)
        self._radius, self._gear, self._gear_efficiency = p["wheel_radius"], p["gear_ratio"], p["gear_efficiency"]
        self._weight = model.mass * GRAVITY
        self._turns = self.chassis.name != "straight" and not roller
        self._turn = STRAIGHT_ON
        self._rear_share = 1 - p["cg_to_rear"] / p["wheelbase"]
        self._lever = p["cg_height"] / p["wheelbase"]
        rolls = p["wheel_inertia_front"] / self._radius**2  # the front wheel rolls without slip
        mass = roller.inertia if roller else model.mass + rolls
        self.driveline = Driveline(tyre, brakes, mass, p["wheel_inertia_rear"], roller is None)

    @property
    def lean(self) -> float:
        """[rad], positive right; 0 of a chassis that does not lean."""
        return self._turn.lean

    def kinetic_energy(self) -> float:
        """Of vehicle and wheels [J]."""
        return self.driveline.kinetic_energy(self.speed, self.wheel_speed)

    def potential_energy(self) -> float:
        """Over the start [J]."""
        return 0.0 if self.dynamometer else self._weight * self.climb

    def step(self, throttle: float, brake: float) -> None:
        """One step with throttle and brake [0..1]."""
        dt, q, entries, roller = self.dt, self._q, self.ledger, self.dynamometer
        v, w, gear = self.speed, self.wheel_speed, self._gear
        self.throttle, self.brake = throttle, brake
        normal, turning, radius = self._on_the_road()

        # --- what acts (eqs. 2.1, 2.8, 3.1, 3.2, 3.5-3.7, 3.9)
        self.sensed_voltage += (self.voltage - self.sensed_voltage) * self._voltage_gain
        current = self.controller.current(throttle, brake, w / gear, self.sensed_voltage / self._series)
        # The motor's current makes torque in the air gap; what turning costs without current is drag on the shaft.
        idle = self.motor.idle(w / gear, self.motor_cooling.stator)
        torque = self.motor.torque_constant * current - drag_torque(idle, w / gear)
        drive = torque / gear * (self._gear_efficiency if torque * w >= 0 else 1 / self._gear_efficiency)
        forces, rolling = self._forces(q), self._rolling(q)
        share = self.rear_load / normal
        front_share = 0.0 if roller else 1 - share
        total = sum(rolling)
        absorbed = roller.absorbed(v) if roller else 0.0
        against = sum(forces) + front_share * total + turning + absorbed

        dv, dw, force, braking, front_braking = self.driveline.step(
            v, w, drive, against, share * total, self.rear_load, radius, brake, dt
        )
        v_mean, w_mean = v + dv / 2, w + dw / 2
        self.speed, self.wheel_speed, self.force = v + dv, w + dw, force
        self.distance += v_mean * dt
        self.climb += q["grade"] * v_mean * dt
        self.time += dt

        # --- every watt at the wheels
        way = v_mean * dt
        for i, name in self._force_names:
            entries[name] += forces[i] * way
        if turning:
            entries["turning"] += turning * v_mean * dt
        if roller:
            entries["dynamometer"] += absorbed * v_mean * dt
        turned = (share * radius * w_mean + front_share * v_mean) * dt
        for i, name in self._rolling_names:
            entries[name] += rolling[i] * turned
        entries["tyre_slip"] += force * (radius * w_mean - v_mean) * dt
        entries["brakes"] += (braking * w_mean + front_braking * v_mean) * dt
        mechanical = torque * w_mean / gear
        entries["gearing"] += (mechanical - drive * w_mean) * dt
        self._heat["idle"] += idle * dt
        self._draw(mechanical, w_mean / gear, current)

    def _on_the_road(self) -> tuple[float, float, float]:
        """(load of both axles [N], force of turning [N], rolling radius [m]); sets quantities and axle loads."""
        q, v, radius, turning = self._q, self.speed, self._radius, 0.0
        grade, curvature, headwind = self.road(self.distance)
        cosine = sqrt(1 - grade * grade) if grade else 1.0
        q["speed"], q["grade"], q["grade_cosine"], q["headwind"] = v, grade, cosine, headwind
        q["lateral_acceleration"] = v * v * curvature
        if self._tracks:
            self._track(curvature)
        normal = self._weight * cosine
        if self._turns:
            turn = self._turn = self.chassis.turn(v, curvature, self.dt)
            turning = turn.resistance * normal * direction(v)
            radius *= turn.radius
            # The tyres hold back at the ground: what of their force moves load is what pushes the machine.
            shift = (self.force - turning) * self._lever * turn.height - turn.front_load * normal
        else:
            shift = self.force * self._lever
        rear = normal * self._rear_share + shift
        least = LEAST_LOAD * normal
        self.rear_load = rear = least if rear < least else normal if rear > normal else rear
        self.front_load = normal - rear
        return normal, turning, radius

    def _draw(self, mechanical: float, motor_speed: float, current: float) -> None:
        """Every watt from the pack to the shaft (eqs. 2.2-2.6, 2.9, 2.10, 2.16-2.19), and its heat."""
        dt, q, entries, heat = self.dt, self._q, self.ledger, self._heat
        q["motor_speed"], q["motor_current"], q["torque"] = motor_speed, current, self.motor.torque_constant * current
        motor_heat = self.motor.heat(motor_speed, current, self.motor_cooling.stator, dt, entries)
        inverter_heat = self._inverter(q, entries)
        power = mechanical + motor_heat + inverter_heat + self._dc(q, entries)
        self.current, self.voltage, pack_heat, delivered = self.pack.draw(power, dt, self.pack_cooling.temperature)
        bms_heat = self._bms_resistance * self.current * self.current  # in the pack's: the board lies in its current
        entries["bms"] += bms_heat * dt
        entries["battery_heat"] += (pack_heat - bms_heat) * dt
        if power - delivered > 1e-6 * abs(power):
            entries["not_delivered"] -= (power - delivered) * dt
        self.motor_current = current
        heat["motor"] += motor_heat * dt
        heat["inverter"] += inverter_heat * dt
        heat["pack"] += pack_heat * dt  # the board's too, which stands on it: so its network was calibrated
        heat["bms"] += bms_heat * dt
        self._charge += self.current * dt
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
        """The cooling networks, with the mean heat of the period (eqs. 2.25-2.31); a roller's fan follows it."""
        heat, outside = self._heat, (self.ambient, abs(self.speed), self._cooling_factor)
        self.inverter_cooling.step(dt, heat["inverter"] / dt, *outside)
        self.motor_cooling.step(dt, heat["motor"] / dt, *outside, heat["idle"] / dt)
        cells, battery = self.pack_cooling.temperature, self.vehicle.pack
        reversible = battery.reversible_heat(self._charge / dt, self.pack.soc, cells)
        self.pack_cooling.step(dt, heat["pack"] / dt + reversible, *outside)
        self.bms_cooling.step(dt, heat["bms"] / dt, self.pack_cooling.temperature)
        for name in heat:
            heat[name] = 0.0
        self._since_cooling = self._charge = 0.0
        self._q["motor_temperature"] = self.motor_cooling.stator
        self._watch()

    def _watch(self) -> None:
        motor, inverter = self.motor_cooling.stator, self.inverter_cooling.board
        self.controller.watch(motor, inverter, self.pack_cooling.temperature, self.pack.soc)
