"""The simulated scooter, forward-looking: force forward, speed back (Lord 2016, figs. 2.1 and 3.1).

Each step takes throttle and brake, finds the motor current that the controller allows, the torque at the wheel, the
tyre's force and from it the new speeds of wheel and vehicle; then, with the speeds at the middle of the step, every
watt from the battery to the road. A step only notes its powers; they are booked once a second, in columns.
"""

from __future__ import annotations

from collections.abc import Callable
from math import sqrt
from operator import mul
from typing import Any

from gz_onboard.constants import GRAVITY, MILD
from gz_onboard.model.cooling import PERIOD, InverterCooling, LumpedCooling, MotorCooling
from gz_onboard.model.effect import MOVING, QUANTITIES, Port
from gz_onboard.model.functions import direction
from gz_onboard.model.model import air_density, drag_torque
from gz_onboard.model.series import stepper
from gz_onboard.model.traits import traits
from gz_onboard.simulation.parts import (
    Controller,
    Driveline,
    Dynamometer,
    FirstOrderPack,
    Motor,
    PackModel,
    RoadProfile,
    straight,
)
from gz_onboard.simulation.turning import STRAIGHT_ON, Chassis
from gz_onboard.vehicle import Vehicle

STEP = 0.01  # s
WHEEL_ONLY = {"speed", "motor_speed", "time_moving"}
"""What a force may read to act on a dynamometer too: it is at the wheel, not of air, hill or bend."""
SURROUNDINGS = frozenset({"heading", "time_moving", "vibration"})
CELLS = frozenset({"soc", "cell_temperature", "cell_current"})
LEAST_LOAD = 0.05  # of the weight, on the rear axle
VOLTAGE_FILTER = 0.3  # s: the controller's own; without one, current and sag would chase each other each step
RARE = {"turning", "not_delivered"}  # in the ledger only if there was any


AlongRoad = Callable[[float], float]
"""A quantity at a distance [m]."""


class Scooter:
    """The assembled scooter; its state is the loop variable of a simulation.

    soc, ambient [degC], altitude [m], speed [m/s]: at the start; cell_temperature [degC]: the ambient if None. dt [s]:
    of a step. heading [rad clockwise from north]: where the road begins, then turning with it, or over distance.
    vibration [m/s²]: how rough the road is; if None as the vehicle's file expects, and a roller smooth. pack, motor,
    chassis: replace the vehicle's own; effects in the cells act in `FirstOrderPack` only. A chassis that turns is
    refused (InputError) together with an effect that is the same loss.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        road: RoadProfile | Dynamometer | None = None,
        *,
        soc: float = 1.0,
        ambient: float = MILD,
        cell_temperature: float | None = None,
        altitude: float = 0.0,
        speed: float = 0.0,
        dt: float = STEP,
        heading: float | AlongRoad = 0.0,
        vibration: float | AlongRoad | None = None,
        pack: PackModel | None = None,
        motor: Motor | None = None,
        chassis: Chassis | None = None,
    ) -> None:
        if vehicle.battery is None:
            raise vehicle.error("has no [battery], which a simulation needs")
        self.vehicle = vehicle
        self.dynamometer = road if isinstance(road, Dynamometer) else None
        self.road: RoadProfile = straight() if road is None or isinstance(road, Dynamometer) else road
        self.dt = dt
        self.ambient = ambient
        self.speed = speed  # m/s
        self.wheel_speed = self.speed / vehicle.parameters["wheel_radius"]  # rad/s
        self.distance = self.climb = 0.0  # m
        self.time = self.time_moving = 0.0  # s
        self.current = self.motor_current = 0.0  # A; of the pack, of the motor
        self.throttle = self.brake = 0.0
        self.force = self.rear_load = self.front_load = 0.0  # N; of the driven tyre, on the axles
        self._q: dict[str, float] = dict.fromkeys(QUANTITIES, 0.0)
        self._set_surroundings(altitude, heading, vibration)
        self._build_electric(soc, ambient if cell_temperature is None else cell_temperature, pack, motor)
        self._build_mechanic(chassis)
        self._names = [*self._force_names, *self._rolling_names, *self._loss_names]
        self._names += ["turning", "dynamometer", "tyre_slip", "brakes", "gearing"]
        self._names += ["bms", "battery_heat", "not_delivered", "idle", "charge"]
        self._noted: list[tuple[Any, ...]] = []  # of each step since the last booking, by `_names`
        self._booked: dict[str, float] = dict.fromkeys(self._names, 0.0)  # J since the start; charge in A·s
        self._cooled = dict(self._booked)  # the same at the last step of the cooling networks
        self._since_cooling = 0.0  # s
        self._watch()

    def _set_surroundings(self, altitude: float, heading: float | AlongRoad, rough: float | AlongRoad | None) -> None:
        """The surroundings that effects read."""
        self._heading_at = heading if callable(heading) else None
        self.start_heading = self.heading = heading(0.0) if callable(heading) else heading  # rad
        if rough is None:
            rough = 0.0 if self.dynamometer else self.vehicle.riding.vibration
        self._vibration_at = rough if callable(rough) else None
        self._rough = 0.0 if callable(rough) else rough
        self.vibration = 0.0  # m/s², if effects of the model read it
        model = self.vehicle.model
        outside = [effect.reads for effect in model.effects if effect.port is not Port.CELL_VOLTAGE]
        self._tracks = bool(model.reads & SURROUNDINGS or CELLS & frozenset().union(*outside))
        self._q |= {
            "mass": model.mass,
            "air_density": air_density(self.ambient, altitude),
            "grade_cosine": 1.0,
            "motor_temperature": self.ambient,
            "ambient_temperature": self.ambient,
            "heading": self.heading,
        }

    def _build_electric(self, soc: float, celsius: float, pack: PackModel | None, motor: Motor | None) -> None:
        """Pack, motor, inverter and what cools them; celsius: the cells' temperature."""
        vehicle, p, dt = self.vehicle, self.vehicle.parameters, self.dt
        model, battery = vehicle.model, vehicle.pack
        self.voltage = battery.cells_series * battery.ocv(soc, celsius)[0]
        self.sensed_voltage = self.voltage  # V, as the controller has it
        self._series = battery.cells_series
        self._voltage_gain = min(dt / VOLTAGE_FILTER, 1.0)
        self._q["cell_capacity"] = battery.cell_capacity(celsius)
        cells = model.at(Port.CELL_VOLTAGE)
        inside = stepper(cells, dt) if cells else None
        self.pack: PackModel = pack or FirstOrderPack(battery, soc, effects=inside, quantities=self._q)
        self.motor = motor
        of_motor, of_inverter = [] if self.motor else model.at(Port.MOTOR_LOSS), model.at(Port.INVERTER_LOSS)
        losses = [*of_motor, *of_inverter, *model.at(Port.DC_POWER)]
        turning_idly = self._q | {"motor_speed": 100.0, "motor_temperature": MILD}
        self._losses = stepper(losses, dt)
        self._idle = stepper([effect for effect in of_motor if effect(turning_idly)], None)  # those that cost then
        of_replaced = [self.motor.name] if self.motor else []
        self._loss_names = [*of_replaced, *(bound.effect.name for bound in losses)]
        self._heats = {
            "motor": [*of_replaced, *(bound.effect.name for bound in of_motor)],
            "inverter": [bound.effect.name for bound in of_inverter],
            "pack": ["battery_heat", "bms"],  # the board's too, which stands on it: so its network was calibrated
        }
        self._torque_constant = p["torque_constant"]
        regeneration = p["regeneration_torque_limit"] / p["torque_constant"]
        self.controller = Controller(p["motor_current_limit"], regeneration, vehicle.derating)
        self.inverter_cooling = InverterCooling(p, self.ambient, self.ambient)
        self.motor_cooling = MotorCooling(p, self.ambient, self.ambient)
        self.pack_cooling = LumpedCooling(p, "pack", celsius)
        self.bms_cooling = LumpedCooling(p, "bms", celsius)
        self._cooling_factor = p["cooling_factor"]
        self._bms_resistance = min(p["bms_resistance"], battery.series_resistance)  # its part of it

    def _build_mechanic(self, chassis: Chassis | None) -> None:
        """Chassis, tyre, brakes and the forces of the road."""
        model, p, roller = self.vehicle.model, self.vehicle.parameters, self.dynamometer
        self.chassis = chassis
        for effect in model.effects:
            if self.chassis and traits(effect).turning_loss:
                raise self.vehicle.error(
                    f"model.effects lists {effect.name}, and the {self.chassis.name} chassis has the same loss: "
                    "it would count twice; take one of them"
                )
        # Forces that read the acceleration are the dynamics that this simulation integrates itself.
        forces = [e for e in model.at(Port.WHEEL_FORCE) if "acceleration" not in e.effect.reads]
        if roller:
            forces = [e for e in forces if e.effect.reads <= WHEEL_ONLY]
        rolling = model.at(Port.TYRE)

        self._force_names, self._rolling_names = ([bound.effect.name for bound in part] for part in (forces, rolling))
        # Energy that effects store is booked as kinetic and potential energy.
        self._stored = {bound.effect.name for bound in (*forces, *rolling) if bound.effect.stores_energy}
        self._forces, self._rolling = stepper(forces, self.dt), stepper(rolling, self.dt)
        self._radius, self._gear, self._gear_efficiency = p["wheel_radius"], p["gear_ratio"], p["gear_efficiency"]
        self._weight = model.mass * GRAVITY
        self._turn = STRAIGHT_ON
        self._rear_share = 1 - p["cg_to_rear"] / p["wheelbase"]
        self._lever = p["cg_height"] / p["wheelbase"]
        rolls = p["wheel_inertia_front"] / self._radius**2  # the front wheel rolls without slip
        self.driveline = Driveline(
            tyre=(p["tyre_b"], p["tyre_c"], p["tyre_d"], p["tyre_e"]),
            brake_torque=p["brake_torque_limit"],
            front_share=p["front_brake_share"],
            moving_mass=roller.inertia if roller else model.mass + rolls,
            wheel_inertia=p["wheel_inertia_rear"],
            has_front_wheel=roller is None,
        )

    @property
    def lean(self) -> float:
        """[rad], positive right; 0 of a chassis that does not lean."""
        return self._turn.lean

    @property
    def grade(self) -> float:
        """Sine of the road's angle; 0 on a roller."""
        return 0.0 if self.dynamometer else self.road(self.distance)[0]

    @property
    def curvature(self) -> float:
        """Of the road [1/m], positive left; 0 on a roller."""
        return 0.0 if self.dynamometer else self.road(self.distance)[1]

    @property
    def motor_speed(self) -> float:
        """[rad/s]."""
        return self.wheel_speed / self._gear

    @property
    def motor_torque(self) -> float:
        """In the air gap [N·m]."""
        return self._torque_constant * self.motor_current

    @property
    def ledger(self) -> dict[str, float]:
        """Energy [J] by where it went, since the start."""
        self._book()
        left_out = {"idle", "charge", *self._stored, *(() if self.dynamometer else ("dynamometer",))}
        return {
            name: energy
            for name, energy in self._booked.items()
            if name not in left_out and (energy or name not in RARE)
        }

    def kinetic_energy(self) -> float:
        """Of vehicle and wheels [J]."""
        driven = self.driveline
        return 0.5 * (driven.moving_mass * self.speed**2 + driven.wheel_inertia * self.wheel_speed**2)

    def potential_energy(self) -> float:
        """Over the start [J]."""
        return 0.0 if self.dynamometer else self._weight * self.climb

    def step(self, throttle: float, brake: float) -> None:
        """One step with throttle and brake [0..1]."""
        dt, q, roller, gear = self.dt, self._q, self.dynamometer, self._gear
        v, w = self.speed, self.wheel_speed
        self.throttle, self.brake = throttle, brake
        normal, turning, radius = self._on_the_road()

        # --- what acts (eqs. 2.1, 2.8, 3.1, 3.2, 3.5-3.7, 3.9)
        self.sensed_voltage += (self.voltage - self.sensed_voltage) * self._voltage_gain
        current = self.controller.current(throttle, brake, w / gear, self.sensed_voltage / self._series)
        # The motor's current makes torque in the air gap; its loss without current is drag on the shaft.
        stator = self.motor_cooling.temperature
        if self.motor:
            idle = self.motor.loss(w / gear, 0.0, stator)
        else:
            q["motor_speed"], q["motor_temperature"], q["motor_current"], q["torque"] = w / gear, stator, 0.0, 0.0
            idle = sum(self._idle(q))
        torque = self._torque_constant * current
        shaft = torque - drag_torque(idle, w / gear)
        drive = shaft / gear * (self._gear_efficiency if shaft * w >= 0 else 1 / self._gear_efficiency)
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

        # --- every watt from the pack to the shaft (eqs. 2.2-2.6, 2.9, 2.10, 2.16-2.19)
        mechanical = shaft * w_mean / gear
        q["motor_speed"], q["motor_current"], q["torque"] = w_mean / gear, current, torque
        losses = self._losses(q)
        if self.motor:
            losses = (self.motor.loss(w_mean / gear, current, stator), *losses)
        power = mechanical + sum(losses)
        self.current, self.voltage, pack_heat, delivered = self.pack.draw(power, dt, self.pack_cooling.temperature)
        self.motor_current = current
        missing = power - delivered
        if missing <= 1e-6 * abs(power):
            missing = 0.0
        bms = self._bms_resistance * self.current * self.current  # in the pack's: the board lies in its current

        # --- and at the wheels
        turned = share * radius * w_mean + front_share * v_mean  # m/s, of the tyres
        self._noted.append(
            (
                v_mean,
                turned,
                forces,
                rolling,
                losses,
                turning * v_mean,
                absorbed * v_mean,
                force * (radius * w_mean - v_mean),
                braking * w_mean + front_braking * v_mean,
                mechanical - drive * w_mean,
                bms,
                pack_heat - bms,
                -missing,
                idle,
                self.current,
            )
        )
        self._since_cooling += dt
        if self._since_cooling >= PERIOD - 1e-9:
            self._cool(self._since_cooling)

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
        if self.chassis:
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

    def _book(self) -> None:
        """Book the steps since the last booking."""
        if not self._noted:
            return
        speed, turned, forces, rolling, losses, *others = zip(*self._noted, strict=True)
        columns = [
            *(map(mul, column, speed) for column in zip(*forces, strict=True)),
            *(map(mul, column, turned) for column in zip(*rolling, strict=True)),
            *zip(*losses, strict=True),
            *others,
        ]
        for name, powers in zip(self._names, columns, strict=True):
            self._booked[name] += sum(powers) * self.dt
        self._noted.clear()

    def _cool(self, dt: float) -> None:
        """The cooling networks, with the mean heat of the period (eqs. 2.25-2.31); a roller's fan follows it."""
        self._book()
        mean = {name: (energy - self._cooled[name]) / dt for name, energy in self._booked.items()}
        heat = {part: sum(mean[name] for name in names) for part, names in self._heats.items()}
        outside = self.ambient, abs(self.speed), self._cooling_factor
        self.inverter_cooling.step(dt, heat["inverter"], *outside)
        self.motor_cooling.step(dt, heat["motor"], *outside, mean["idle"])
        cells, battery = self.pack_cooling.temperature, self.vehicle.pack
        reversible = battery.reversible_heat(mean["charge"], self.pack.soc, cells)
        self.pack_cooling.step(dt, heat["pack"] + reversible, *outside)
        self.bms_cooling.step(dt, mean["bms"], self.pack_cooling.temperature)
        self._cooled = dict(self._booked)
        self._since_cooling = 0.0
        self._q["motor_temperature"] = self.motor_cooling.temperature
        self._watch()

    def _watch(self) -> None:
        motor, inverter = self.motor_cooling.temperature, self.inverter_cooling.temperature
        self.controller.watch(motor, inverter, self.pack_cooling.temperature, self.pack.soc)
