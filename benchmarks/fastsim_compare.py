"""Compare the scooter with FASTSim 3 on the same drive cycles: python -m benchmarks.fastsim_compare

Needs a Python that has both the requirements of gz-onboard and PyPI's fastsim (3.1). Two comparisons:

same parts   the scooter with motor and pack replaced by FASTSim's own kind (efficiency over share of power, constant
             efficiency of the pack), FASTSim's air, and electric braking alone: the same physics by other code;
own losses   the scooter's own losses in watts over speed and current; FASTSim with the efficiency that they make at
             9 m/s.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import fastsim  # type: ignore[import-not-found, unused-ignore]
import numpy as np

from benchmarks.backward import RideConditions, backward
from gz_onboard.constants import KELVIN, WH
from gz_onboard.model.effect import BASE_EFFECTS
from gz_onboard.model.functions import PiecewiseLinear
from gz_onboard.simulation.cycles import cycle
from gz_onboard.simulation.run import at_steps, drive, follow
from gz_onboard.simulation.scooter import Scooter
from gz_onboard.vehicle import Vehicle, read_vehicle

AMBIENT = 23.5  # degC
ALTITUDE = 121.92  # m, FASTSim's; the two give the 1.173 kg/m³ that its drag comes out with
POWER = 5000.0  # W, of the motor
SHARES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0)
EFFICIENCY = (0.70, 0.72, 0.76, 0.82, 0.87, 0.89, 0.90, 0.89, 0.87, 0.85)
PACK_EFFICIENCY = 0.96


class EfficiencyMotor:
    """FASTSim's motor as a part of the scooter: efficiency over the share of the greatest mechanical power.

    When it brakes, FASTSim 3.1 takes the first efficiency of the table at any power, and so does this.
    """

    name = "motor"

    def __init__(self, torque_constant: float) -> None:
        self.torque_constant = torque_constant

    def loss(self, speed: float, current: float, temperature: float) -> float:
        power = self.torque_constant * current * speed
        share = min(max(power, 0.0) / POWER, 1.0)
        efficiency = PiecewiseLinear(SHARES, EFFICIENCY).at(share)
        return power / efficiency - power if power >= 0 else power * efficiency - power


class EfficiencyPack:
    """FASTSim's battery as a part of the scooter: a constant efficiency either way, a constant voltage."""

    def __init__(self, capacity: float, voltage: float) -> None:
        self.soc = 0.9
        self.capacity, self.voltage, self.drawn = capacity, voltage, 0.0

    def draw(self, power: float, dt: float, temperature: float) -> tuple[float, float, float, float]:
        chemical = power / PACK_EFFICIENCY if power >= 0 else power * PACK_EFFICIENCY
        self.drawn += chemical * dt
        self.soc -= chemical * dt / self.capacity
        return power / self.voltage, self.voltage, chemical - power, power

    def chemical_energy_drawn(self) -> float:
        return self.drawn


def cycles() -> dict[str, tuple[tuple[float, ...], tuple[float, ...]]]:
    udds, wmtc = cycle("udds"), cycle("wmtc_class1")
    factor = 45 / 3.6 / max(udds.speed)  # within the scooter's power on the level
    return {
        "UDDS scaled to 45 km/h": (udds.time, tuple(factor * v for v in udds.speed)),
        "WMTC class 1": (wmtc.time, wmtc.speed),
    }


def in_fastsim(
    vehicle: Vehicle, t: Any, v: Any, efficiency: Any, pack: float, power: float, shares: Any = SHARES
) -> dict[str, float]:
    """The ride in FASTSim [J]; `power` [W] is the motor's, the reference of its efficiency."""
    p = vehicle.parameters
    car = fastsim.Vehicle.from_resource("2022_Renault_Zoe_ZE50_R135.yaml").to_dict()
    car["name"] = vehicle.name
    car["mass_kilograms"] = vehicle.model.mass
    car["pwr_aux_base_watts"] = p["auxiliary_power"]
    chassis = car["chassis"]
    chassis |= {
        "drag_coef": p["drag_area"],
        "frontal_area_square_meters": 1.0,
        "num_wheels": 2,
        "wheel_rr_coef": p["rolling_resistance_constant"],
        "wheel_radius_meters": p["wheel_radius"],
        "wheel_inertia_kilogram_square_meters": (p["wheel_inertia_front"] + p["wheel_inertia_rear"]) / 2,
        "glider_mass_kilograms": None,
        "cargo_mass_kilograms": None,
        "drive_type": "RWD",
        "cg_height_meters": -p["cg_height"],
        "wheel_base_meters": p["wheelbase"],
        "drive_axle_weight_frac": 1 - p["cg_to_rear"] / p["wheelbase"],
        "wheel_fric_coef": 1.0,
    }
    electric = car["pt_type"]["BEV"]
    electric["transmission"]["eff_interp"] = 1.0
    res, em = electric["res"], electric["em"]
    res["energy_capacity_joules"] = capacity(vehicle)
    res["eff_interp"] = {"Constant": pack}
    res["pwr_out_max_watts"] = 20_000.0
    em["pwr_out_max_watts"] = power
    data = em["eff_interp_achieved"]["data"]
    data["grid"] = [{"v": 1, "dim": [len(shares)], "data": list(shares)}]
    data["values"] = {"v": 1, "dim": [len(shares)], "data": list(efficiency)}
    em["eff_interp_at_max_input"] = None
    n = len(t)
    ride = {
        "init_elev_meters": 121.92,
        "time_seconds": list(t),
        "speed_meters_per_second": list(v),
        "dist_meters": [],
        "grade": [0.0] * n,
        "elev_meters": [],
        "pwr_max_chrg_watts": [0.0] * n,
        "temp_amb_air_kelvin": [AMBIENT + KELVIN] * n,
        "pwr_solar_load_watts": [0.0] * n,
    }
    simulation = fastsim.SimDrive(fastsim.Vehicle.from_dict(car), fastsim.Cycle.from_dict(ride))
    begin = time.perf_counter()
    simulation.walk()
    wall = time.perf_counter() - begin
    out = simulation.to_dict()["veh"]
    state, battery = out["state"], out["pt_type"]["BEV"]["res"]["state"]
    vehicles = {"drag": "drag", "rolling": "rr", "brakes": "brake", "auxiliary": "aux"}
    return {name: state[f"energy_{theirs}_joules"] for name, theirs in vehicles.items()} | {
        "distance": state["dist_meters"],
        "motor": out["pt_type"]["BEV"]["em"]["state"]["energy_loss_joules"],
        "terminals": battery["energy_out_electrical_joules"],
        "cells": battery["energy_out_chemical_joules"],
        "met": float(state["cyc_met_overall"]),
        "wall": wall,
    }


def capacity(vehicle: Vehicle) -> float:
    return vehicle.pack.pack_capacity(AMBIENT) * 3600 * vehicle.pack.cells_series * 3.7


def forward(scooter: Scooter, t: Any, v: Any) -> dict[str, float]:
    speeds = at_steps(t, v, scooter.dt)
    begin = time.perf_counter()
    run = drive(scooter, follow(speeds, scooter.dt), t[-1])
    wall = time.perf_counter() - begin
    ledger = run.ledger
    motor = sum(ledger.get(n, 0.0) for n in ("motor", "motor_copper_loss", "motor_iron_loss", "inverter_loss"))
    return {
        "distance": run.distance,
        "drag": ledger["aerodynamic_drag"],
        "rolling": ledger["rolling_resistance"],
        "slip": ledger["tyre_slip"],
        "brakes": ledger["brakes"],
        "motor": motor,
        "auxiliary": ledger["auxiliary_load"],
        "terminals": run.energy,
        "cells": run.chemical,
        "wall": wall,
        "peak": float(np.max(run.series["motor_torque"] * run.series["motor_speed"])),
    }


def electric_braking(vehicle: Vehicle, **values: float) -> Vehicle:
    """The vehicle with a motor that can do all the braking, as FASTSim has it, and all the driving."""
    all_of_it = {"brake_torque_limit": 1.0, "regeneration_torque_limit": 300.0, "motor_current_limit": 600.0}
    return vehicle.changed(vehicle.parameters.replaced(**all_of_it, **values))


def unlimited(scooter: Scooter) -> Scooter:
    scooter.controller.derating = replace(
        scooter.controller.derating,
        current_by_motor_speed=PiecewiseLinear((0.0,), (1.0,)),
        regeneration_by_motor_speed=PiecewiseLinear((0.0, 0.5), (0.0, 1.0)),
        regeneration_by_soc=PiecewiseLinear((0.0,), (1.0,)),
        regeneration_gain=1.0,
    )
    return scooter


def same_parts(vehicle: Vehicle) -> Scooter:
    """The scooter with FASTSim's motor and pack, its motor doing all the braking."""
    bare = electric_braking(
        vehicle, inverter_loss_constant=0.0, inverter_loss_linear=0.0, inverter_loss_quadratic=0.0, bms_resistance=0.0
    )
    motor = EfficiencyMotor(vehicle.parameters["torque_constant"])
    pack = EfficiencyPack(capacity(vehicle), 51.8)
    return unlimited(Scooter(bare, ambient=AMBIENT, altitude=ALTITUDE, soc=0.9, motor=motor, pack=pack))


def row(name: str, ours: float, theirs: float) -> str:
    return f"| {name} | {ours / WH:.2f} | {theirs / WH:.2f} | {100 * (ours / theirs - 1):+.1f} % |"


def main() -> None:
    vehicle = read_vehicle("reference", 80.0)
    vehicle = vehicle.changed(vehicle.parameters, [e for e in vehicle.model.effects if e.name in BASE_EFFECTS])
    for name, (t, v) in cycles().items():
        print(f"\n### {name}\n\n| same parts, Wh | gz-onboard | FASTSim | difference |\n| --- | --- | --- | --- |")
        ours = forward(same_parts(vehicle), t, v)
        theirs = in_fastsim(vehicle, t, v, EFFICIENCY, PACK_EFFICIENCY, POWER)
        for key in ("drag", "rolling", "motor", "auxiliary", "terminals", "cells"):
            print(row(key, ours[key], theirs[key]))
        print(
            f"\nslip {ours['slip'] / WH:.2f} Wh, brakes {ours['brakes'] / WH:.2f} and {theirs['brakes'] / WH:.2f} Wh;"
            f" distance {ours['distance']:.0f} and {theirs['distance']:.0f} m; met {theirs['met']:.0f};"
            f" greatest power {ours['peak']:.0f} W; {ours['wall']:.2f} and {theirs['wall']:.3f} s"
        )

        print("\n| own losses, Wh | gz-onboard | FASTSim | difference |\n| --- | --- | --- | --- |")
        electric = electric_braking(vehicle)
        ours = forward(unlimited(Scooter(electric, ambient=AMBIENT, altitude=ALTITUDE, soc=0.9)), t, v)
        fine = at_steps(t, v, 0.1)
        energy = backward(
            electric,
            [0.1 * i for i in range(len(fine))],
            fine,
            RideConditions(ambient=AMBIENT, altitude=ALTITUDE, motor_temperature=30.0),
            smoothing=0.0,
        )
        shares, efficiency = mean_efficiency(vehicle)
        pack = 1 - (ours["cells"] - ours["terminals"]) / ours["cells"]
        theirs = in_fastsim(vehicle, t, v, efficiency, pack, POWER, shares)
        for key in ("drag", "rolling", "motor", "auxiliary", "terminals", "cells"):
            print(row(key, ours[key], theirs[key]))
        print(row("terminals, energy-only form", energy.total, theirs["terminals"]))
        braked = forward(Scooter(vehicle, ambient=AMBIENT, altitude=ALTITUDE, soc=0.9), t, v)
        print(row("terminals, with the scooter's friction brakes", braked["terminals"], theirs["terminals"]))
        print(f"\nbrakes {braked['brakes'] / WH:.2f} Wh; {braked['wall']:.2f} s and {theirs['wall']:.3f} s")


def mean_efficiency(vehicle: Vehicle) -> tuple[list[float], list[float]]:
    """Motor and inverter at 9 m/s: (share of power, efficiency)."""
    p = vehicle.parameters
    speed = 9.0 / p["wheel_radius"]
    shares, efficiency = list(SHARES), []
    iron = p["motor_iron_linear"] * speed + p["motor_iron_quadratic"] * speed**2
    for share in shares:
        shaft = max(share, 0.004) * POWER
        current = (shaft + iron) / speed / p["torque_constant"]  # iron loss is drag on the shaft
        copper = p["motor_copper_resistance"] * 1.02 * current**2
        inverter = p["inverter_loss_linear"] * current + p["inverter_loss_quadratic"] * current**2
        losses = copper + iron + inverter + p["inverter_loss_constant"]
        efficiency.append(max(shaft / (shaft + losses), 0.05))
    efficiency[0] = 0.82  # of braking: 19 N·m at 6 m/s
    return shares, efficiency


if __name__ == "__main__":
    main()
