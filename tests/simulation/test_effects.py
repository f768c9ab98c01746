"""Every effect and movable parameter acts in the simulation, and the balance of energy closes with all of them."""

from __future__ import annotations

import math
from typing import Any

import pytest

from gz_onboard.model.effect import Port, load_effect, package_effects
from gz_onboard.simulation.parts import Dynamometer, FirstOrderPack, straight
from gz_onboard.simulation.run import Run, drive
from gz_onboard.simulation.scooter import STEP, Scooter
from gz_onboard.simulation.sensors import SENSORS, latency
from gz_onboard.simulation.truth import Truth
from gz_onboard.vehicle import Vehicle, read_vehicle
from tests.support import joined, without_cell_effects

BASE = without_cell_effects(read_vehicle("reference"))
CANDIDATES = (
    "cornering_drag",
    "headwind",
    "dragging_brake",
    "tyre_warm_up",
    "drivetrain_drag",
    "regen_loss",
    "slow_relaxation",
    "ocv_hysteresis",
)


def extended(*names: str, **values: float) -> Vehicle:
    effects = [load_effect(name) for name in names]
    return BASE.changed(joined(BASE.parameters, effects).replaced(**values), (*BASE.model.effects, *effects))


def per_metre(run: Run) -> float:
    return run.energy / run.distance


def states(scooter: Scooter) -> dict[str, float]:
    assert isinstance(scooter.pack, FirstOrderPack)
    names = [bound.effect.name for bound in scooter.vehicle.model.at(Port.CELL_VOLTAGE)]
    return dict(zip(names, scooter.pack.effect_voltages, strict=True))


def bends(distance: float) -> tuple[float, float, float]:
    return 0.02 * math.sin(distance / 80), (0.02 if distance % 200 < 100 else -0.01), 0.0


def stop_and_go(scooter: Scooter) -> tuple[float, float, float]:
    """20 s at up to 10 m/s, braking, 4 s of standing, again."""
    t = scooter.time % 32
    return (0.5 if t < 20 and scooter.speed < 10 else 0.0), (0.4 if t > 22 else 0.0), math.nan


def ride(vehicle: Vehicle, seconds: float = 96.0, road: Any = bends, **options: Any) -> tuple[Run, Scooter]:
    scooter = Scooter(vehicle, road, soc=0.8, **options)
    return drive(scooter, stop_and_go, seconds), scooter


def test_the_candidates_are_all_effects_beyond_the_base():
    base = {effect.name for effect in BASE.model.effects}
    of_the_bench = {"charge_transfer"}  # pulses show it, rides do not
    assert set(package_effects()) == base | set(CANDIDATES) | of_the_bench


def test_the_balance_closes_with_all_effects_and_parameters():
    vehicle = extended(
        *CANDIDATES,
        wind_north=4.0,
        wind_east=-2.0,
        cell_resistance_factor=1.4,
        cooling_factor=0.3,
        speed_sensor_scale=1.02,
        pack_voltage_latency=0.2,
        cell_capacity=2.4,
        hysteresis_voltage=0.02,
        hysteresis_rate=100.0,
    )
    run, scooter = ride(vehicle, 300.0)
    assert abs(run.closure) < 1e-4
    assert set(CANDIDATES) - {"slow_relaxation", "ocv_hysteresis"} <= set(run.ledger)
    for name in set(CANDIDATES) & set(run.ledger) - {"headwind"}:
        assert run.ledger[name] > 0, name
    assert states(scooter)["slow_relaxation"] > 0
    plain, _ = ride(BASE, 300.0)
    assert per_metre(run) > 1.1 * per_metre(plain)


@pytest.mark.parametrize("name", [name for name in CANDIDATES if name != "headwind"])
def test_each_effect_alone_costs_and_closes(name):
    base, _ = ride(BASE, 64.0)
    strong = {"regen_loss": {"regeneration_loss_share": 0.5}, "ocv_hysteresis": {"hysteresis_rate": 500.0}}
    run, _ = ride(extended(name, **strong.get(name, {})), 64.0)
    assert abs(run.closure) < 1e-4
    assert run.chemical / run.distance > base.chemical / base.distance


def test_wind_costs_against_and_gives_along_by_the_heading():
    calm = extended("headwind")
    windy = extended("headwind", wind_north=4.0)
    cost = {}
    for heading in (0.0, math.pi):
        for key, vehicle in (("calm", calm), ("windy", windy)):
            cost[heading, key] = per_metre(ride(vehicle, 64.0, straight(), heading=heading)[0])
    assert cost[0.0, "calm"] == cost[math.pi, "calm"]
    assert cost[math.pi, "windy"] < cost[0.0, "calm"] < cost[0.0, "windy"]
    by_place = ride(BASE, 64.0, straight(headwind=4.0))[0]
    assert cost[0.0, "windy"] == pytest.approx(per_metre(by_place), rel=1e-6)


BEARING = """
from gz_onboard.model.effect import Parameter, Port
PORT = Port.MOTOR_LOSS
PARAMETERS = (Parameter("bearing_loss", "W", 40.0, 5.0, 0.0, 200.0, "made up"),)
def term(motor_speed, *, bearing_loss):
    return bearing_loss * motor_speed / (motor_speed + 1)
def decay(dt, motor_speed):
    return 0.99
"""


def test_a_motor_loss_with_memory_goes_on_once_each_step(tmp_path):
    (tmp_path / "bearing.py").write_text('"""Made up."""\n' + BEARING)
    effect = load_effect("bearing", tmp_path)
    vehicle = BASE.changed(joined(BASE.parameters, [effect]), (*BASE.model.effects, effect))
    scooter = Scooter(vehicle, straight(), soc=0.8, speed=8.0)
    value, energy = 0.0, 0.0
    for _ in range(50):
        before = scooter.wheel_speed
        scooter.step(0.3, 0.0)
        speed = (before + scooter.wheel_speed) / 2
        value = 0.99 * value + 0.01 * 40.0 * speed / (speed + 1)
        energy += value * STEP
    assert scooter.ledger["bearing"] == pytest.approx(energy, rel=1e-9)


def test_hysteresis_stays_at_rest_and_relaxation_does_not():
    vehicle = extended("slow_relaxation", "ocv_hysteresis", hysteresis_rate=500.0, slow_time=120.0)
    scooter = Scooter(vehicle, straight(), soc=0.8)
    drive(scooter, stop_and_go, 64.0)
    for _ in range(200_000):
        scooter.pack.draw(0.0, STEP, 20.0)
    assert abs(states(scooter)["slow_relaxation"]) < 1e-6
    assert states(scooter)["ocv_hysteresis"] > 0.004


def test_on_a_dynamometer_what_is_at_the_wheel_acts_and_air_and_bends_do_not():
    vehicle = extended(
        "dragging_brake", "drivetrain_drag", "cornering_drag", "headwind", "tyre_warm_up", wind_north=5.0
    )
    run, _ = ride(vehicle, 32.0, Dynamometer(185.0, 20.0, 0.0, 0.3))
    assert {"dragging_brake", "drivetrain_drag", "tyre_warm_up"} <= set(run.ledger)
    assert not {"cornering_drag", "headwind", "aerodynamic_drag"} & set(run.ledger)
    assert abs(run.closure) < 1e-4


def test_what_the_sensors_show_of_it():
    def signals(vehicle):
        scooter = Scooter(vehicle, straight(), soc=0.8)
        truth = Truth(drive(scooter, stop_and_go, 20.0, keep_steps=True), scooter)
        return {sensor.signal: sensor.read(truth) for sensor in SENSORS}

    true = signals(BASE)
    false = signals(
        extended(speed_sensor_scale=1.05, pack_current_offset=0.5, pack_current_gain=1.1, pack_voltage_offset=-0.3)
    )
    moving = true["HBM_WheelSpeedRear"] > 1
    assert false["INV_MotorSpeed"][moving] == pytest.approx(1.05 * true["INV_MotorSpeed"][moving])
    for other in ("HBM_WheelSpeedRear", "HBM_WheelSpeedFront", "GPS_Speed", "INV_DcVoltage", "VCU_Odometer"):
        assert false[other] == pytest.approx(true[other], rel=1e-12)
    assert false["BMS_PackVoltage"] == pytest.approx(true["BMS_PackVoltage"] - 0.3)
    p = BASE.parameters
    current = (true["BMS_PackCurrent"] - p["pack_current_offset"]) / p["pack_current_gain"]
    assert false["BMS_PackCurrent"] == pytest.approx(1.1 * current + 0.5)
    late = {s.signal: latency(s, extended(pack_voltage_latency=0.3).parameters) - s.delay for s in SENSORS}
    assert {name: delay for name, delay in late.items() if delay} == {"BMS_PackVoltage": pytest.approx(0.3)}
