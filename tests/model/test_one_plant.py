"""Who simulates, estimates, calibrates, validates and discovers rides the same plant: one ride through each of them."""

from dataclasses import replace
from math import asinh, exp
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.arrays import block_means
from gz_onboard.calibration.circuit import Circuit, Reaction, voltage
from gz_onboard.calibration.coastdown import Coast, RoadLoad
from gz_onboard.discovery import residuals
from gz_onboard.discovery.grid import Ride
from gz_onboard.discovery.mixed_model import initial
from gz_onboard.estimator.cells import Cell
from gz_onboard.model.effect import QUANTITIES, ROAD_LOAD, Port
from gz_onboard.model.functions import Mesh, PiecewiseLinear
from gz_onboard.model.model import air_density
from gz_onboard.model.series import bilinear_over, curve_over, extended_over, idle_loss, mesh_over, stepper
from gz_onboard.recording.recording import read_recording
from gz_onboard.simulation.parts import FirstOrderPack, Rider
from gz_onboard.simulation.scooter import STEP, Scooter
from gz_onboard.validation.components import components, losses, road_load
from gz_onboard.vehicle import read_vehicle

LOG = Path(__file__).resolve().parents[2] / "replay_logs" / "city_14C.blf"
VEHICLE = read_vehicle("reference", 75.0)
PACK, P = VEHICLE.pack, VEHICLE.parameters
SOC, AMBIENT = 0.8, 20.0
MILLIVOLT = 1e-3


def simulated():
    """By role, the means of each second (n,) of a simulated ride in town."""
    scooter, rider, rows = Scooter(VEHICLE, soc=SOC, ambient=AMBIENT), Rider(), []
    for second in range(300):
        wanted, steps = (0.0, 6.0, 12.0, 9.0, 3.0)[second // 20 % 5], []
        for _ in range(100):
            scooter.step(*rider.step(wanted, scooter.speed, scooter.dt))
            steps.append((scooter.speed, scooter.current, scooter.motor_current, scooter.voltage))
        rows.append((*np.mean(steps, axis=0), scooter.motor_cooling.temperature, scooter.pack_cooling.temperature))
    names = ("speed", "pack_current", "motor_current", "pack_voltage", "motor_temperature", "cell_temperature")
    return dict(zip(names, np.array(rows).T, strict=True))


def recorded():
    """The same of a recorded one."""
    ride = initial(VEHICLE).ride(read_recording(LOG, VEHICLE))
    names = ("pack_current", "motor_current", "pack_voltage", "motor_temperature")
    found = {name: block_means(ride.signals[name], 10) for name in names}
    return found | {name: block_means(ride.quantities[name], 10) for name in ("speed", "cell_temperature")}


@pytest.fixture(scope="module", params=[simulated, recorded])
def ride(request):
    found = request.param()
    n = len(found["speed"])
    found["speed"] = np.abs(found["speed"])
    found["motor_speed"] = found["speed"] / (P["wheel_radius"] * P["gear_ratio"])
    found["acceleration"] = np.gradient(found["speed"])
    return found | {"ambient_temperature": np.full(n, AMBIENT), "grade": np.zeros(n)}


def on_grid(ride):
    """The seconds as the discovery has them, ten steps to each."""
    signals = {name: np.repeat(values, 10) for name, values in ride.items()}
    n = len(signals["speed"])
    quantities = {name: np.zeros(n) for name in QUANTITIES if name != "vibration"} | {
        name: signals[name] for name in QUANTITIES if name in signals
    }
    quantities |= {"grade_cosine": np.ones(n), "air_density": np.full(n, air_density(AMBIENT))}
    quantities["mass"] = np.full(n, VEHICLE.model.mass)
    radius = P["wheel_radius"] * P["gear_ratio"]
    made = Ride("ride", np.linspace(0.0, (n - 1) * 0.1, n), signals, {}, radius, P["payload_mass"], quantities)
    made.start_soc = residuals.start_soc(made, healthy()[1])
    return made


def healthy():
    """(the discovery's parameters with no cause and no nuisance, its system)."""
    state = initial(VEHICLE)
    return state.values, state.system


def written_out(ride, reaction=P["charge_transfer_resistance"]):
    """(voltage of a cell [V], heat of the pack [W]) in the middle of each second, without the project's equations.

    reaction [ohm]: of charge transfer at 25 degC.
    """
    soc, v1, volts, heat = SOC, 0.0, [], []
    eta, settles = 0.0, P["charge_transfer_time"]
    v2, slow, keep = 0.0, 1.0 if reaction else 0.0, exp(-0.5 / P["slow_time"])
    for amperes, celsius in zip(ride["pack_current"], ride["cell_temperature"], strict=True):
        i = amperes / PACK.cells_parallel
        r0, r1, c1 = (mesh.at(soc, celsius)[0] for mesh in (PACK.r0, PACK.r1, PACK.c1))
        middle = v1 * exp(-0.5 / (r1 * c1)) + r1 * i * (1 - exp(-0.5 / (r1 * c1)))
        soc -= 0.5 * i / (3600 * PACK.cell_capacity(celsius))
        kelvin = celsius + 273.15
        cold = reaction * exp(P["charge_transfer_activation"] * (1 / kelvin - 1 / 298.15))
        thermal = 2 * 8.314463 * kelvin / 96485.33
        goal = thermal * asinh(cold * i / thermal)
        half = goal + (eta - goal) * exp(-0.5 / settles)
        eta = goal + (eta - goal) * exp(-1 / settles)
        late = v2 * keep + slow * P["slow_resistance"] * i * (1 - keep)
        volts.append(PACK.ocv(soc, celsius)[0] - r0 * i - middle - half - late)
        heat.append((r0 * i + middle + half + late) * amperes * PACK.cells_series)
        v2 = late * keep + slow * P["slow_resistance"] * i * (1 - keep)
        soc -= 0.5 * i / (3600 * PACK.cell_capacity(celsius))
        v1 = v1 * exp(-1 / (r1 * c1)) + r1 * i * (1 - exp(-1 / (r1 * c1)))
    return np.array(volts), np.array(heat)


def test_the_estimator_predicts_the_voltage_of_a_cell(ride):
    """The cell of the battery filter: half a step, the voltage, half a step."""
    soc, v1, predicted = SOC, 0.0, []
    for amperes, celsius in zip(ride["pack_current"], ride["cell_temperature"], strict=True):
        i = amperes / PACK.cells_parallel
        for half in range(2):
            cell = Cell.of(PACK, soc, celsius)
            v1 = v1 * exp(-0.5 / cell.time) + cell.r1 * i * (1 - exp(-0.5 / cell.time))
            soc -= 0.5 * i / (3600 * PACK.cell_capacity(celsius))
            if not half:
                now = Cell.of(PACK, soc, celsius)
                predicted.append(now.ocv - now.r0 * i - v1)
    assert predicted == pytest.approx(written_out(ride, reaction=0.0)[0], abs=0.1 * MILLIVOLT)


def test_discovery_has_the_same_voltage_of_a_cell(ride):
    values, system = healthy()
    grid = on_grid(ride)
    start = SOC - residuals.start_soc(grid, system)
    exact = values | {"soc_start": start, "pack_current_offset": 0.0, "pack_current_gain": 1.0}
    volts = residuals.cell_circuit(grid, exact, system).voltage
    assert block_means(volts, 2) == pytest.approx(written_out(ride)[0], abs=MILLIVOLT)  # of two half seconds


def test_calibration_has_the_same_voltage_of_a_cell(ride):
    i, celsius = (np.repeat(ride[name], 2) for name in ("pack_current", "cell_temperature"))  # halves of seconds
    i, dt = i / PACK.cells_parallel, np.full(len(i), 0.5)
    temperatures = np.array(PACK.r0.temperature)
    r0, r1, c1 = (np.array(mesh.value) for mesh in (PACK.r0, PACK.r1, PACK.c1))
    capacity = np.array([PACK.cell_capacity(t) for t in temperatures])
    shift = np.array([PACK.rest_shift(t) for t in temperatures])
    cell = Circuit(
        np.array(PACK.ocv_curve.x),
        np.array(PACK.ocv_curve.y),
        np.array(PACK.r0.soc),
        temperatures,
        capacity,
        r0,
        r1,
        c1,
        slow=(P["slow_resistance"], P["slow_time"]),
        rest_shift=shift,
        reaction=Reaction(P["charge_transfer_resistance"], P["charge_transfer_activation"], P["charge_transfer_time"]),
    )
    each = PACK.capacity * curve_over(PACK.capacity_share, celsius)
    soc = SOC - np.cumsum(i * dt / (3600 * each))
    ends = voltage(cell, i, i, dt, soc, celsius)
    assert ends[::2] == pytest.approx(written_out(ride)[0], abs=0.2 * MILLIVOLT)


def test_the_simulation_draws_the_same_current_and_heat(ride):
    volts, heat = written_out(ride)
    quantities = dict.fromkeys(QUANTITIES, 0.0)
    effects = stepper(VEHICLE.model.at(Port.CELL_VOLTAGE), 0.1)
    pack, drawn = FirstOrderPack(PACK, SOC, effects=effects, quantities=quantities), []
    for k, celsius in enumerate(ride["cell_temperature"]):
        watts = PACK.pack_voltage(volts[k], ride["pack_current"][k]) * ride["pack_current"][k]
        steps = [pack.draw(watts, 0.1, celsius) for _ in range(10)]
        drawn.append((np.mean([x[0] for x in steps]), np.mean([x[2] for x in steps])))
    currents, heats = np.array(drawn).T
    series = PACK.series_resistance * ride["pack_current"] ** 2  # its heat is the pack's here
    assert currents == pytest.approx(ride["pack_current"], abs=0.3, rel=0.01)
    assert heats.mean() == pytest.approx((heat + series).mean(), rel=0.02)


def test_everyone_books_the_same_losses_of_motor_and_inverter(ride):
    with_current, idle, inverter = losses(
        VEHICLE, ride["motor_current"], ride["motor_speed"], ride["motor_temperature"]
    )
    model = VEHICLE.model
    q = dict.fromkeys(QUANTITIES, 0.0) | {name: ride[name] for name in ride if name in QUANTITIES}
    q["torque"] = P["torque_constant"] * ride["motor_current"]
    by_model = sum(effect(q) for effect in model.at(Port.MOTOR_LOSS))
    assert with_current + idle == pytest.approx(by_model)
    values, system = healthy()
    grid = on_grid(ride)
    fed, drags = residuals.motor_losses(grid, residuals.moving(grid, values, system), values, system)
    assert block_means(fed + drags, 10) == pytest.approx(by_model, rel=1e-6, abs=1e-6)
    by_discovery = system.sum(grid.quantities, values, 0.1, Port.INVERTER_LOSS)
    assert block_means(by_discovery, 10) == pytest.approx(inverter, rel=1e-6, abs=1e-6)
    simulated = stepper(model.at(Port.MOTOR_LOSS), STEP)
    names = [name for name in q if np.ndim(q[name])]
    rows = zip(*(q[name] for name in names), strict=True)
    booked = [sum(simulated(q | dict(zip(names, map(float, row), strict=True)))) for row in rows]
    assert booked == pytest.approx(by_model, rel=1e-6, abs=1e-6)


NO_NUISANCE = {
    "inverter_start": 0.0,
    "box_start": 0.0,
    "inverter_airflow": 0.0,
    "cells_start": 0.0,
    "pack_airflow": 0.0,
}
"""Of the discovery, which so begins and cools as the vehicle file says."""


def test_validation_discovery_and_simulation_warm_the_inverter_alike(ride):
    values, system = healthy()
    ride["inverter_temperature"] = np.full(len(ride["speed"]), AMBIENT)
    grid = on_grid(ride)
    left = residuals.inverter_temperature(grid, values | NO_NUISANCE, system)
    by_discovery = AMBIENT - left
    by_validation = components(VEHICLE, ride, SOC, AMBIENT, None)["inverter_temperature"].modelled
    assert by_discovery == pytest.approx(by_validation, abs=1e-6)
    cooling = Scooter(VEHICLE, soc=SOC, ambient=AMBIENT).inverter_cooling
    heat = losses(VEHICLE, ride["motor_current"], ride["motor_speed"], ride["motor_temperature"])[2]
    for watts, speed in zip(heat[:-1], ride["speed"][:-1], strict=True):
        cooling.step(1.0, watts, AMBIENT, speed, P["cooling_factor"])
    assert cooling.temperature == pytest.approx(by_validation[-1], abs=1e-6)


def test_everyone_has_the_same_heat_of_the_reaction(ride):
    """What the cells are warmer by with the file's entropy than with one that is 1 mV/K lower: I·T·1 mV/K."""
    values, system = healthy()
    assert PACK.entropy
    lower = replace(PACK, entropy=PiecewiseLinear(PACK.entropy.x, tuple(x - 1e-3 for x in PACK.entropy.y)))
    kelvin = ride["cell_temperature"] + 273.15
    expected = 1e-3 * PACK.cells_series * np.cumsum(ride["pack_current"] * kelvin) / P["pack_heat_capacity"]
    grid, other = on_grid(ride), replace(VEHICLE, battery=lower)
    by_validation = [components(v, ride, SOC, AMBIENT, None)["cell_temperature"].modelled for v in (VEHICLE, other)]
    without, with_less = (
        residuals.cell_temperature(grid, values | NO_NUISANCE, s) for s in (system, replace(system, battery=lower))
    )
    tolerance = 0.08 * np.abs(expected).max() + 1e-3  # what is warmer cools more
    assert (by_validation[1] - by_validation[0])[1:] == pytest.approx(expected[:-1], abs=tolerance)
    assert (without - with_less)[1:] == pytest.approx(expected[:-1], abs=tolerance)


def test_everyone_has_the_same_road_load(ride):
    by_validation = road_load(VEHICLE, ride, AMBIENT, None)
    n = len(ride["speed"])
    q = dict.fromkeys(QUANTITIES, 0.0) | {name: ride[name] for name in ride if name in QUANTITIES}
    q |= {"grade_cosine": 1.0, "mass": VEHICLE.model.mass, "air_density": air_density(AMBIENT)}
    ledger = VEHICLE.model.power(q)
    moving = ride["speed"] > 0.5
    on_road = {effect.effect.name for effect in VEHICLE.model.at(*ROAD_LOAD)}
    by_model = sum((np.broadcast_to(ledger[name], n) for name in on_road), np.zeros(n))[moving] / ride["speed"][moving]
    assert by_validation[moving] == pytest.approx(by_model)
    values, system = healthy()
    stored = {e.effect.name for e in VEHICLE.model.at(*ROAD_LOAD) if e.effect.stores_energy}
    held = (
        sum((np.broadcast_to(ledger[name], n) for name in on_road - stored), np.zeros(n))[moving]
        / ride["speed"][moving]
    )
    force = system.sum(on_grid(ride).quantities, values, 0.1, *ROAD_LOAD)
    by_discovery = block_means(np.broadcast_to(force, 10 * n), 10)[moving]
    assert by_discovery == pytest.approx(held, rel=1e-6)


@given(st.floats(2.0, 20.0), st.floats(-0.05, 0.05))
def test_a_coast_down_is_held_back_as_the_model_says(speed, slope):
    """The road load of calibration, with the motor turning along, is what the light model drives against."""
    ends = np.array([0.0, 1.0])
    run = Coast("run", ends, ends, 1, VEHICLE.model.mass, AMBIENT, 0.0)
    force = RoadLoad(VEHICLE)(speed, run, slope, 0.0)
    q = dict.fromkeys(QUANTITIES, 0.0) | {"speed": speed, "grade": slope, "grade_cosine": (1 - slope**2) ** 0.5}
    q |= {"mass": VEHICLE.model.mass, "air_density": air_density(AMBIENT), "motor_temperature": AMBIENT}
    q |= {"ambient_temperature": AMBIENT, "vibration": VEHICLE.riding.vibration}
    q |= {"motor_speed": speed / (P["wheel_radius"] * P["gear_ratio"])}
    model = VEHICLE.model
    expected = sum(effect(q) for effect in model.at(*ROAD_LOAD)) + idle_loss(model, q) / speed
    assert force == pytest.approx(expected)


AXIS = st.lists(st.floats(-1, 2), min_size=2, max_size=6, unique_by=lambda x: round(x, 2)).map(sorted)


@given(st.data(), AXIS, AXIS)
def test_a_table_is_read_alike_one_value_or_many_at_a_time(data, xs, ys):
    row = st.lists(st.floats(-10, 10), min_size=len(xs), max_size=len(xs)).map(tuple)
    table = tuple(data.draw(row) for _ in ys)
    points = data.draw(st.lists(st.tuples(st.floats(-2, 3), st.floats(-2, 3)), min_size=1, max_size=5))
    x, y = np.array(points).T
    mesh = Mesh(tuple(xs), tuple(ys), table)
    assert mesh_over(mesh, x, y) == pytest.approx([mesh.at(*point)[0] for point in points], rel=1e-9, abs=1e-9)
    assert bilinear_over(np.array(xs), np.array(ys), np.array(table), x, y) == pytest.approx(mesh_over(mesh, x, y))
    positive = tuple(tuple(np.exp(0.3 * v) for v in values) for values in table)
    falling = Mesh(tuple(xs), tuple(ys), positive, geometric=True)
    assert mesh_over(falling, x, y) == pytest.approx([falling.at(*point)[0] for point in points], rel=1e-9)
    curve = PiecewiseLinear(mesh.soc, table[0])
    assert extended_over(mesh.soc, table[0], x) == pytest.approx([curve.extended(a)[0] for a in x], rel=1e-9, abs=1e-9)
    assert np.interp(x, xs, table[0]) == pytest.approx([curve.at(a) for a in x], rel=1e-9, abs=1e-9)
