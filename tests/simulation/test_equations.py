"""Test each equation of the thesis (Lord 2016) in the running scooter; docs/explanation/simulation.md lists them."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.constants import GRAVITY
from gz_onboard.model.cooling import InverterCooling, LumpedCooling, MotorCooling
from gz_onboard.model.model import air_density
from gz_onboard.simulation.parts import Driveline, FirstOrderPack, Rider, straight
from gz_onboard.simulation.scooter import Scooter
from gz_onboard.vehicle import read_vehicle

VEHICLE = read_vehicle("reference", 75.0)
P = VEHICLE.parameters
assert VEHICLE.battery
BATTERY = VEHICLE.battery
DT = 0.01


def parted(scooter, throttle, brake=0.0):
    """One step; what each entry of the ledger gained in it [W], and the mean speeds of vehicle and wheel."""
    before = dict(scooter.ledger)
    speed, wheel = scooter.speed, scooter.wheel_speed
    scooter.step(throttle, brake)
    watts = {name: (energy - before.get(name, 0.0)) / DT for name, energy in scooter.ledger.items()}
    return watts, (speed + scooter.speed) / 2, (wheel + scooter.wheel_speed) / 2


def motor_drag(motor_speed):
    """Torque [N·m] that iron loss takes from the motor's shaft, written out."""
    iron = P["motor_iron_linear"] * motor_speed + P["motor_iron_quadratic"] * motor_speed**2
    return iron * motor_speed / (motor_speed**2 + 0.01)


@pytest.fixture
def riding():
    """At a steady 9 m/s or so, in a wind, uphill."""
    scooter = Scooter(VEHICLE, straight(0.02, 3.0), soc=0.7, speed=9.0)
    for _ in range(50):
        scooter.step(0.35, 0.0)
    return scooter


def test_2_1_motor_current_is_its_command(riding):
    limit = P["motor_current_limit"]
    slow = Scooter(VEHICLE, soc=0.7)
    slow.step(0.4, 0.0)
    assert slow.motor_current == pytest.approx(0.4 * limit)


@pytest.mark.parametrize(("throttle", "brake"), [(0.5, 0.0), (0.0, 0.3)])
def test_2_2_to_2_6_direct_current_carries_mechanical_power_and_losses(riding, throttle, brake):
    for _ in range(3):
        start = riding.wheel_speed
        watts, _, wheel = parted(riding, throttle, brake)
    mechanical = (P["torque_constant"] * riding.motor_current - motor_drag(start)) * wheel
    assert (mechanical > 0) is (throttle > 0)
    losses = watts["motor_copper_loss"] + watts["motor_iron_loss"] + watts["inverter_loss"]
    assert watts["inverter_loss"] > 0
    terminal = mechanical + losses + watts["auxiliary_load"]
    assert riding.voltage * riding.current == pytest.approx(terminal, rel=1e-4)


def test_2_8_torque_constant_makes_the_force():
    scooter = Scooter(VEHICLE, soc=0.7)
    for _ in range(60):
        scooter.step(0.5, 0.0)
    torque = P["torque_constant"] * 0.5 * P["motor_current_limit"]
    inertia = VEHICLE.model.mass + (P["wheel_inertia_front"] + P["wheel_inertia_rear"]) / P["wheel_radius"] ** 2
    before = scooter.speed
    scooter.step(0.5, 0.0)
    rolling = P["rolling_resistance_constant"] * VEHICLE.model.mass * GRAVITY
    drag = 0.5 * air_density(20.0) * P["drag_area"] * before**2
    expected = (torque / P["wheel_radius"] - rolling - drag) / inertia
    assert (scooter.speed - before) / DT == pytest.approx(expected, rel=0.03)


def test_2_9_and_2_10_motor_heat_is_its_loss(riding):
    riding.motor_cooling.temperature = 70.0
    watts, _, wheel = parted(riding, 0.5)
    current = riding.motor_current
    resistance = P["motor_copper_resistance"] * (
        1 + P["motor_copper_temperature_coefficient"] * (riding.motor_cooling.temperature - 25)
    )
    resistance *= 1 + P["motor_copper_frequency"] * wheel**2
    assert watts["motor_copper_loss"] == pytest.approx(resistance * current**2, rel=1e-9)
    iron = P["motor_iron_linear"] * wheel + P["motor_iron_quadratic"] * wheel**2
    assert watts["motor_iron_loss"] == pytest.approx(iron, rel=1e-9)


@pytest.mark.parametrize(("throttle", "brake"), [(0.5, 0.0), (0.0, 0.3)])
def test_2_11_and_2_12_gearing(throttle, brake):
    """Half the speed, twice the torque, and what the gear takes whichever way the power flows."""
    geared = VEHICLE.parameters.replaced(gear_ratio=0.5, gear_efficiency=0.9)
    from dataclasses import replace

    from gz_onboard.model.model import Model

    vehicle = replace(VEHICLE, parameters=geared, model=Model(VEHICLE.model.effects, geared))
    scooter = Scooter(vehicle, soc=0.7, speed=6.0)
    watts, _, wheel = parted(scooter, throttle, brake)
    drag = motor_drag(6.0 / P["wheel_radius"] / 0.5)
    mechanical = (P["torque_constant"] * scooter.motor_current - drag) * wheel / 0.5
    share = 0.1 if throttle else 1 / 0.9 - 1
    assert watts["gearing"] == pytest.approx(share * abs(mechanical), rel=1e-6)


def test_2_13_brakes_share_their_torque_between_the_wheels():
    scooter = Scooter(VEHICLE, soc=0.7, speed=9.0)
    scooter.controller.regeneration_limit = 0.0
    watts, speed, wheel = parted(scooter, 0.0, 0.5)
    front = P["front_brake_share"]
    torque = 0.5 * P["brake_torque_limit"] * (front * speed / P["wheel_radius"] + (1 - front) * wheel)
    assert watts["brakes"] == pytest.approx(torque, rel=1e-9)


def test_2_16_and_2_17_bms(riding):
    watts, _, _ = parted(riding, 0.5)
    assert watts["bms"] == pytest.approx(P["bms_resistance"] * riding.current**2, rel=1e-9)


def test_2_17_and_2_23_the_board_is_a_part_of_the_packs_resistance(riding):
    """From the cells' source to the loads the voltage drops by what calibration measured, the board in it."""
    soc, lost = riding.pack.soc, riding.pack.v1 + sum(riding.pack.effect_voltages)
    celsius, start = riding.pack_cooling.temperature, riding.wheel_speed
    watts, _, wheel = parted(riding, 0.6)
    taken = (P["torque_constant"] * riding.motor_current - motor_drag(start)) * wheel
    taken += sum(watts[name] for name in ("motor_copper_loss", "motor_iron_loss", "inverter_loss", "auxiliary_load"))
    cells = BATTERY.cells_series * (BATTERY.ocv(soc, celsius)[0] - lost) - taken / riding.current
    r0 = BATTERY.circuit(soc, celsius)[0]
    measured = BATTERY.cells_series / BATTERY.cells_parallel * r0 + P["pack_series_resistance"]
    assert cells / riding.current == pytest.approx(measured, abs=2e-4)


def test_2_18_and_2_23_pack_voltage():
    pack = FirstOrderPack(BATTERY, 0.6, v1=0.03)
    current, voltage, _, _ = pack.draw(1500.0, DT, 25.0)
    cell = current / BATTERY.cells_parallel
    r0 = BATTERY.r0.at(0.6, 25.0)[0]
    source = BATTERY.ocv(0.6)[0] - r0 * cell - 0.03
    expected = BATTERY.cells_series * source - BATTERY.series_resistance * current
    assert voltage == pytest.approx(expected, rel=1e-5)
    assert voltage * current == pytest.approx(1500.0, rel=1e-4)


def test_2_19_auxiliary_load_is_a_power(riding):
    watts, _, _ = parted(riding, 0.2)
    assert watts["auxiliary_load"] == pytest.approx(P["auxiliary_power"])


def test_2_20_and_2_21_charge_is_counted():
    pack = FirstOrderPack(BATTERY, 0.8)
    charge = sum(pack.draw(800.0, DT, 25.0)[0] * DT for _ in range(20_000))
    assert 0.8 - pack.soc == pytest.approx(charge / (3600 * BATTERY.cell_capacity(25.0) * BATTERY.cells_parallel))


def test_2_22_rc_pair_settles_exponentially():
    pack = FirstOrderPack(BATTERY, 0.6)
    current = 0.0
    r1, c1 = BATTERY.r1.at(0.6, 25.0)[0], BATTERY.c1.at(0.6, 25.0)[0]
    seconds = r1 * c1
    for _ in range(round(seconds / DT)):
        current = pack.draw(600.0, DT, 25.0)[0]
    settled = r1 * current / BATTERY.cells_parallel
    assert pack.v1 == pytest.approx(settled * (1 - math.exp(-1)), rel=0.02)


def test_2_24_heat_is_what_does_not_leave():
    pack = FirstOrderPack(BATTERY, 0.6, v1=0.03)
    before = pack.soc
    current, voltage, heat, delivered = pack.draw(2000.0, DT, 5.0)
    source = BATTERY.cells_series * BATTERY.ocv((before + pack.soc) / 2)[0]
    assert heat == pytest.approx((source - voltage) * current, rel=1e-6)
    assert delivered == pytest.approx(voltage * current)
    assert heat > 0


def test_2_25_to_2_27_inverter_cooling():
    names = ("board_capacity", "box_capacity", "board_to_air", "box_to_air", "board_to_box")
    sizes = dict(
        zip((*names, "box_to_ambient", "box_per_speed"), (600.0, 2200.0, 1.5, 3.0, 4.0, 2.0, 0.2), strict=True)
    )
    box = InverterCooling({f"inverter_{name}": size for name, size in sizes.items()}, 50.0, 30.0)
    box.step(1.0, 40.0, 20.0, 10.0)  # in 10 m/s of air
    air = (50.0 * 1.5 + 30.0 * 3.0) / 4.5
    assert box.temperature == pytest.approx(50.0 + (40.0 - 1.5 * (50.0 - air) - 4.0 * 20.0) / 600.0)
    assert box.box == pytest.approx(30.0 + (3.0 * (air - 30.0) + 4.0 * 20.0 - 4.0 * 10.0) / 2200.0)


def test_2_28_and_2_29_motor_cooling():
    names = (
        "stator_capacity",
        "rotor_capacity",
        "gap_conductance",
        "rotor_to_ambient",
        "rotor_per_speed",
        "iron_share",
    )
    sizes = dict(zip(names, (3000.0, 4000.0, 8.0, 4.0, 0.2, 0.6), strict=True))
    motor = MotorCooling({f"motor_{name}": size for name, size in sizes.items()}, 60.0, 40.0)
    motor.step(1.0, 100.0, 20.0, 10.0, idle=25.0)  # 10 of the 25 W in the rotor
    assert motor.temperature == pytest.approx(60.0 + (90.0 - 8.0 * 20.0) / 3000.0)
    assert motor.rotor == pytest.approx(40.0 + (10.0 + 8.0 * 20.0 - 6.0 * 20.0) / 4000.0)


def test_2_30_battery_cooling():
    lump = LumpedCooling({"pack_heat_capacity": 9000.0, "pack_conductance": 3.0}, "pack", 35.0)
    lump.step(1.0, 20.0, 25.0)
    assert lump.temperature == pytest.approx(35.0 + (20.0 - 30.0) / 9000.0)


def test_2_31_the_bms_stands_on_the_battery():
    scooter = Scooter(VEHICLE, soc=0.7, ambient=0.0, cell_temperature=30.0)
    for _ in range(3 * 100):
        scooter.step(0.0, 0.0)
    assert scooter.bms_cooling.temperature > 29.9  # in the cold air it would be below
    scooter.bms_cooling.temperature = 0.0
    for _ in range(100):
        scooter.step(0.0, 0.0)
    warmed = P["bms_conductance"] * 30.0 / P["bms_heat_capacity"]
    assert scooter.bms_cooling.temperature == pytest.approx(warmed, rel=0.01)


def reaction_heat(scooter, celsius):
    """[J], of what was drawn from a charge of 0.7 on."""
    charge = 3600 * BATTERY.pack_capacity(celsius) * (0.7 - scooter.pack.soc)  # A·s
    assert BATTERY.entropy
    return -14 * charge * (celsius + 273.15) * BATTERY.entropy.at(0.7)


def test_2_24_to_2_31_each_network_takes_its_own_heat():
    """In the first period all stand at the air's temperature and lose nothing: they gain what the ledger says."""
    scooter = Scooter(VEHICLE, soc=0.7, ambient=20.0)
    for _ in range(100):
        scooter.step(0.5, 0.0)
    e, motor, box = scooter.ledger, scooter.motor_cooling, scooter.inverter_cooling
    gained = P["motor_stator_capacity"] * (motor.temperature - 20) + P["motor_rotor_capacity"] * (motor.rotor - 20)
    assert gained == pytest.approx(e["motor_copper_loss"] + e["motor_iron_loss"], rel=1e-9)
    gained = P["inverter_board_capacity"] * (box.temperature - 20) + P["inverter_box_capacity"] * (box.box - 20)
    assert gained == pytest.approx(e["inverter_loss"], rel=1e-9)
    warmed = P["pack_heat_capacity"] * (scooter.pack_cooling.temperature - 20)
    assert warmed == pytest.approx(e["battery_heat"] + e["bms"] + reaction_heat(scooter, 20.0), rel=1e-3)
    from_pack = P["bms_conductance"] * (scooter.pack_cooling.temperature - 20)  # which is warmed before
    assert P["bms_heat_capacity"] * (scooter.bms_cooling.temperature - 20) == pytest.approx(e["bms"] + from_pack)
    assert min(e[name] for name in ("motor_copper_loss", "inverter_loss", "battery_heat", "bms")) > 0.1


@pytest.mark.parametrize("wind", [-15.0, 0.0, 4.0])
def test_3_1_drag_keeps_its_sign_in_a_tailwind(wind):
    scooter = Scooter(VEHICLE, straight(0.0, wind), soc=0.7, speed=9.0)
    watts, speed, _ = parted(scooter, 0.0)
    flow = 9.0 + wind
    force = 0.5 * air_density(20.0) * P["drag_area"] * flow * abs(flow)
    assert watts["aerodynamic_drag"] == pytest.approx(force * speed, rel=1e-6)


def test_3_2_grade(riding):
    climb = riding.climb
    _, speed, _ = parted(riding, 0.3)
    assert riding.climb - climb == pytest.approx(0.02 * speed * DT, rel=1e-9)
    assert riding.potential_energy() == pytest.approx(VEHICLE.model.mass * GRAVITY * riding.climb)


def test_3_3_forces_accelerate_the_mass(riding):
    before = riding.speed
    watts, speed, _ = parted(riding, 0.5)
    rolling_front = riding.front_load / (riding.front_load + riding.rear_load) * watts["rolling_resistance"] / speed
    against = watts["aerodynamic_drag"] / speed + VEHICLE.model.mass * GRAVITY * 0.02 + rolling_front
    mass = VEHICLE.model.mass + P["wheel_inertia_front"] / P["wheel_radius"] ** 2
    assert (riding.speed - before) / DT == pytest.approx((riding.force - against) / mass, rel=2e-3)


def test_3_4_distance(riding):
    before = riding.distance
    _, speed, _ = parted(riding, 0.5)
    assert riding.distance - before == pytest.approx(speed * DT, rel=1e-12)


def test_3_5_to_3_7_axle_loads(riding):
    force = riding.force
    riding.step(0.3, 0.0)
    normal = VEHICLE.model.mass * GRAVITY * math.sqrt(1 - 0.02**2)
    rear = normal * (P["wheelbase"] - P["cg_to_rear"]) / P["wheelbase"] + force * P["cg_height"] / P["wheelbase"]
    assert riding.rear_load == pytest.approx(rear, rel=1e-9)
    assert riding.front_load == pytest.approx(normal - rear, rel=1e-9)


def test_3_8_wheel_torque(riding):
    """Motor torque goes into tyre force, rolling of the rear wheel and its inertia."""
    wheel = riding.wheel_speed
    watts, speed, mean = parted(riding, 0.4)
    share = riding.rear_load / (riding.rear_load + riding.front_load)
    term = watts["rolling_resistance"] / (share * P["wheel_radius"] * mean + (1 - share) * speed)
    tyre = P["wheel_radius"] * (riding.force + share * term)
    torque = P["torque_constant"] * riding.motor_current - motor_drag(wheel)
    assert torque - tyre == pytest.approx(
        P["wheel_inertia_rear"] * (riding.wheel_speed - wheel) / DT, rel=1e-6, abs=1e-6
    )


def test_3_9_rolling_resistance(riding):
    riding.speed = 9.0
    watts, speed, _ = parted(riding, 0.3)
    cosine = math.sqrt(1 - 0.02**2)
    force = (
        VEHICLE.model.mass * GRAVITY * cosine * (P["rolling_resistance_constant"] + P["rolling_resistance_speed"] * 9.0)
    )
    assert watts["rolling_resistance"] == pytest.approx(force * speed, rel=0.01)


def test_3_11_slip_settles_at_that_of_the_thesis(riding):
    for _ in range(200):
        riding.step(0.35, 0.0)
    rim = P["wheel_radius"] * riding.wheel_speed
    assert riding.driveline.slip == pytest.approx((rim - riding.speed) / riding.speed, rel=1e-3)


def test_3_10_force_is_friction_times_rear_load(riding):
    riding.step(0.4, 0.0)
    riding.step(0.4, 0.0)
    mu, _ = riding.driveline.friction(riding.driveline.slip)
    assert riding.force == pytest.approx(mu * riding.rear_load, rel=1e-3)


@given(slip=st.floats(-1.5, 1.5))
def test_3_12_magic_formula_and_its_slope(slip):
    b, c, d, e = 10.0, 1.65, 1.0, 0.3
    friction = Driveline((b, c, d, e), 280.0, 0.25, 180.0, 0.1, True).friction
    mu, slope = friction(slip)
    assert mu == pytest.approx(d * math.sin(c * math.atan(b * slip - e * (b * slip - math.atan(b * slip)))))
    h = 1e-6
    rise = friction(slip + h)[0] - friction(slip - h)[0]
    assert slope == pytest.approx(rise / (2 * h), abs=1e-5)


@given(wanted=st.floats(0.5, 30), speed=st.floats(0, 30))
def test_3_13_to_3_16_rider(wanted, speed):
    rider = Rider(0.4, 0.1, sum=0.2)
    throttle, brake = rider.step(wanted, speed, DT)
    command = 0.4 * (wanted - speed) + 0.2
    assert throttle == pytest.approx(min(max(command, 0.0), 1.0))
    assert brake == pytest.approx(min(max(-command, 0.0), 1.0))
    if abs(command) < 1:
        assert rider.sum == pytest.approx(0.2 + 0.1 * (wanted - speed) * DT)
