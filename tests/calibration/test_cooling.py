from __future__ import annotations

from dataclasses import replace
from math import asinh

import numpy as np
import pytest

from gz_onboard.calibration import cooling
from gz_onboard.calibration.cooling import (
    CoolingRun,
    bench_run,
    bms_cooling,
    board_resistance,
    inverter_cooling,
    motor_cooling,
    pack_cooling,
    ride_run,
)
from gz_onboard.errors import InputError
from gz_onboard.estimator.cells import CellEffects
from gz_onboard.model.model import STOOD
from gz_onboard.model.parameters import declared_parameters
from gz_onboard.recording.recording import Recording
from gz_onboard.vehicle import read_vehicle
from tests.support import without_cell_effects

from .bench import changed, table, without

VEHICLE = read_vehicle("reference")
TRUTH = {
    "motor_stator_capacity": 2500.0,
    "motor_rotor_capacity": 3200.0,
    "motor_gap_conductance": 4.5,
    "motor_rotor_to_ambient": 1.8,
    "motor_rotor_per_speed": 0.3,
    "motor_iron_share": 0.6,
    "inverter_board_capacity": 300.0,
    "inverter_box_capacity": 1600.0,
    "inverter_board_to_box": 4.2,
    "inverter_box_to_ambient": 1.1,
    "inverter_box_per_speed": 0.15,
    "inverter_board_to_air": VEHICLE.parameters["inverter_board_to_air"],
    "inverter_box_to_air": VEHICLE.parameters["inverter_box_to_air"],
    "pack_heat_capacity": 11000.0,
    "pack_conductance": 3.0,
    "bms_resistance": 0.002,
    "bms_heat_capacity": 220.0,
    "bms_conductance": 0.5,
}
DISORDER = dict(zip(cooling.ENTROPY, (-5e-4, -4e-4, -1e-4, 1e-4, -1e-4, -2e-4, -2e-4), strict=True))
TRUTH |= DISORDER
NETWORKS = {
    "motor": cooling.motor_temperatures,
    "inverter": cooling.inverter_temperatures,
    "cell": cooling.pack_temperatures,
    "bms": cooling.bms_temperatures,
}


def planted(name, seed, bench, seconds=900, noise=0.2, truth=TRUTH, full=0.9):
    """A run with the temperatures of the planted networks: warmed for 40 %, then cooled in still air, or in bursts
    while riding from a charge `full` on."""
    rng = np.random.default_rng(seed)
    time = np.arange(float(seconds))
    if bench:
        load = (time < 0.4 * seconds).astype(float)
    else:
        load = np.repeat(rng.uniform(0.2, 1.2, seconds // 60), 60)
    run = CoolingRun(
        name,
        bench,
        time,
        np.full(seconds, 20.0),
        (0.0 if bench else 10.0) * load,
        280 * load,
        60 * load * rng.uniform(0.5, 1.5),
        70 * load,
        150 * load**2,
        900 * load**2,
        14 * 30 * load,
        full - 0.3 * np.cumsum(load) / seconds,
        {f"{sensor}_temperature": np.full(seconds, 20.0) for sensor in (*NETWORKS, "inverter_box")},
    )
    measured = dict(run.measured)
    for model in NETWORKS.values():
        for sensor, column in model(truth, replace(run, measured=dict(measured))).items():
            measured[sensor] = column
    return replace(run, measured={k: v + noise * rng.normal(size=seconds) for k, v in measured.items()})


def runs(seed, noise=0.2, truth=TRUTH):
    return [planted("room", seed, True, noise=noise, truth=truth)] + [
        planted(f"ride_{i}", 1000 * (i + 1) + seed, False, noise=noise, truth=truth, full=1.0 - 0.3 * i)
        for i in range(3)
    ]


# What a procedure takes as given, or what only its priors scale: no data tell it, so that its truth is drawn.
FROM_PRIORS = {
    motor_cooling: (),
    inverter_cooling: ("inverter_board_to_air", "inverter_box_to_air"),
    pack_cooling: (),
    bms_cooling: ("bms_resistance", "bms_heat_capacity", "bms_conductance"),
}


def drawn(procedure, seed):
    """The truth with what the data do not tell drawn from its prior, as far as that is physical."""
    rng, truth, p, limits = np.random.default_rng(10_000 + seed), dict(TRUTH), VEHICLE.parameters, declared_parameters()
    for name in FROM_PRIORS[procedure]:
        value = -np.inf
        while not limits[name].low <= value <= limits[name].high:
            value = rng.normal(*(board_resistance(VEHICLE) if name == "bms_resistance" else (p[name], p.sd(name))))
        truth[name] = value
    return truth


def away(procedure, seed):
    """How far the values found are from the truth, in their own sd, by parameter."""
    truth = drawn(procedure, seed)
    found = procedure(runs(seed, truth=truth), VEHICLE, halves=False).parameters
    return {name: (x.value - truth[name]) / x.sd for name, x in found.items()}


@pytest.mark.parametrize(
    ("procedure", "seeds"), [(pack_cooling, 40), (bms_cooling, 40), (inverter_cooling, 16), (motor_cooling, 16)]
)
def test_parameters_come_back_within_their_own_intervals(procedure, seeds):
    """Few seeds, so that what is counted is all parameters of a network; `benchmarks.recovery` counts each."""
    held = [abs(z) < 1.96 for seed in range(seeds) for z in away(procedure, seed).values()]
    assert len(held) >= 64
    assert 0.9 <= np.mean(held) <= 0.99


def test_moving_air_cools_the_more():
    result = motor_cooling(runs(1), VEHICLE)
    found = result.parameters["motor_rotor_per_speed"]
    assert abs(found.value - TRUTH["motor_rotor_per_speed"]) < 3 * found.sd < 0.3
    alone = motor_cooling([planted("room", 1, True, seconds=2400)], VEHICLE)
    assert alone.parameters["motor_rotor_to_ambient"].value == pytest.approx(1.8, rel=0.2)
    assert "motor_rotor_per_speed" not in alone.parameters
    assert any("no air moved in any of the runs" in refusal for refusal in alone.refusals)


def test_heat_of_the_reaction_is_told_from_the_losses_where_rides_go():
    curve = pack_cooling(runs(2, noise=1e-3), VEHICLE).curves["battery.entropy"]
    assert curve.value[1:] == pytest.approx([*DISORDER.values()][1:], abs=4e-5)
    high = [replace(run, soc=0.8 + 0 * run.soc) for run in runs(2)]  # no ride below: what is found there is held
    assert np.isnan(pack_cooling(high, VEHICLE).curves["battery.entropy"].sd[:3]).all()


def test_what_the_data_cannot_separate_is_said():
    everything = runs(2)
    unlike = [replace(run, iron=0.2 * run.motor_heat) for run in everything]  # always the same part of the heat
    assert any("motor_iron_share" in r and "leans on its prior" in r for r in motor_cooling(unlike, VEHICLE).refusals)
    blind = [replace(r, measured={k: v for k, v in r.measured.items() if "box" not in k}) for r in everything]
    refusals = " ".join(inverter_cooling(blind, VEHICLE, halves=False).refusals)
    assert "only board_to_box" in refusals and "no sensor on the box" in refusals
    bms = bms_cooling(everything, VEHICLE)
    ((names, covariance),) = bms.covariance
    assert names == ("bms_resistance", "bms_heat_capacity", "bms_conductance")
    sd = np.sqrt(np.diag(covariance))
    assert np.all((covariance / np.outer(sd, sd))[np.triu_indices(3, 1)] > 0.9)  # one scale for all three
    ratio = bms.parameters["bms_resistance"].value / bms.parameters["bms_conductance"].value
    assert ratio == pytest.approx(TRUTH["bms_resistance"] / TRUTH["bms_conductance"], rel=0.1)


def test_held_out_rides_are_not_in_their_fit():
    spoilt = runs(4)
    spoilt[2].measured["cell_temperature"][300:] += 5  # the second ride
    fits = {fit.held_out: fit for fit in pack_cooling(spoilt, VEHICLE).fits if "riding" in fit.what}
    assert fits[True].data == "ride_1" and fits[True].largest > 3


def test_runs_that_tell_nothing_are_left_out_or_refused():
    calm = planted("calm", 0, False)
    calm = replace(calm, measured={"motor_temperature": np.full(600, 20.0)})
    result = motor_cooling([planted("room", 0, True), calm], VEHICLE)
    assert any("calm: motor_temperature changes by 0.0 K only" in note for note in result.notes)
    with pytest.raises(InputError, match="no run tells anything of inverter_temperature"):
        inverter_cooling([calm], VEHICLE)


def bench(seconds=400):
    time = np.arange(float(seconds))
    on = np.ones(seconds)
    return table(
        time=time,
        motor_temperature=30 + 0.05 * time,
        inverter_temperature=30 + 0.05 * time,
        motor_current=100 * on,
        motor_speed=30 * on,
        ac_power=1600 * on,
        dc_power=1680 * on,
        shaft_torque=45 * on,
        ambient_temperature=25 * on,
    )


def test_bench_run_takes_the_measured_heat():
    run = bench_run(bench(), VEHICLE)
    assert (
        run.bench
        and not run.air.any()
        and np.allclose(run.motor_heat, 1600 - 45 * 30)
        and np.allclose(run.inverter_heat, 80)
    )


@pytest.mark.parametrize(
    ("spoilt", "message"),
    [
        (without(bench(), "dc_power"), "no column for 'dc_power'"),
        (bench(100), "99 s are too short"),
        (changed(bench(), dc_power=bench()["ac_power"], ac_power=bench()["dc_power"]), "is no heat"),
    ],
)
def test_bench_runs_without_heat_are_refused(spoilt, message):
    with pytest.raises(InputError, match=message):
        bench_run(spoilt, VEHICLE)


def test_ride_run_takes_the_heat_of_the_vehicles_own_losses():
    fast, slow = np.arange(0, 600, 0.05), np.arange(0, 600, 1.0)
    values = {"motor_speed": 40.0, "motor_current": 50.0, "pack_current": 24.0, "pack_voltage": 52.0}
    columns = {role: (fast, np.full(len(fast), value)) for role, value in values.items()}
    columns |= {role: (slow, np.full(len(slow), 25.0)) for role in ("motor_temperature", "ambient_temperature")}
    columns["cell_temperature"] = (slow, np.full(len(slow), 25.0))
    run = ride_run(Recording("steady", columns), VEHICLE)
    p = VEHICLE.parameters
    iron = p["motor_iron_linear"] * 40 + p["motor_iron_quadratic"] * 1600
    assert np.allclose(run.iron, iron) and not run.bench
    assert np.allclose(run.air, 40 * p["wheel_radius"])
    assert not ride_run(Recording("closed room", columns), VEHICLE, "none").air.any()
    assert np.allclose(ride_run(Recording("fan", columns), VEHICLE, 3.0).air, 3.0)
    copper = p["motor_copper_resistance"] * (1 + p["motor_copper_frequency"] * 40**2) * 2500
    assert np.allclose(run.motor_heat, iron + copper, rtol=1e-6)
    cell, battery = (24 - p["pack_current_offset"]) / p["pack_current_gain"] / 12, VEHICLE.pack
    reaction = 0.05138 * asinh(p["charge_transfer_resistance"] * cell / 0.05138)  # 2RT/F [V]
    bars, r0, r1 = p["pack_series_resistance"] * (12 * cell) ** 2, *(m.at(0.5, 25)[0] for m in (battery.r0, battery.r1))
    assert run.pack_heat[-1] == pytest.approx(bars + 168 * cell * (cell * (r0 + r1) + reaction), rel=0.2)
    with pytest.raises(InputError, match="steady: no motor_current"):
        ride_run(Recording("steady", {k: v for k, v in columns.items() if k != "motor_current"}), VEHICLE)


def test_bursts_heat_the_cells_by_what_their_reaction_has_built_up():
    """Two seconds in four, of a reaction that takes three: settled in each second it would heat by a third more."""
    time = np.arange(0, 600, 0.1)
    slow, amperes = time[::10], np.where(time % 4 < 2, 60.0, 0.0)
    p = VEHICLE.parameters
    values = {
        "pack_current": p["pack_current_gain"] * amperes + p["pack_current_offset"],
        "pack_voltage": 50 + 0 * time,
    }
    values |= dict.fromkeys(("motor_speed", "motor_current"), 0 * time)
    columns = {role: (time, value) for role, value in values.items()}
    steady = ("motor_temperature", "ambient_temperature", "cell_temperature")
    columns |= {role: (slow, np.full(len(slow), 15.0)) for role in steady}
    with_it, without_it = (
        ride_run(Recording("bursts", columns), vehicle) for vehicle in (VEHICLE, without_cell_effects(VEHICLE))
    )
    effects, joules = CellEffects(VEHICLE.model, VEHICLE.pack), 0.0
    effects.step(VEHICLE.pack, STOOD, 60.0 / 12, 0.5, 15.0)  # such runs are taken to begin under way
    for cell in (amperes / 12).tolist():
        effects.step(VEHICLE.pack, 0.1, cell, 0.5, 15.0)
        joules += 168 * cell * effects.overpotential * 0.1
    found = with_it.pack_heat.sum() - without_it.pack_heat.sum()
    assert found == pytest.approx(joules, rel=0.1)
