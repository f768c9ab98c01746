"""The linear mixed model: rides on the grid, priors, normal equations, noise, curves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, f

from gz_onboard.discovery.channels import CHANNEL, ChannelNoise
from gz_onboard.discovery.curves import CONSTANT, KNOTS, columns_of, curve_form, curve_forms, supported_knots
from gz_onboard.discovery.grid import STEP, Ride, grade_by_altitude
from gz_onboard.discovery.mixed_model import (
    LinearChannel,
    LinearRide,
    MixedModel,
    Statistics,
    innovations,
    learn_noise,
    linearise_all,
    linearised_about,
    one_degree,
    whitened,
)
from gz_onboard.discovery.mixed_model import initial as known_from
from gz_onboard.discovery.parameters import candidates
from gz_onboard.discovery.residuals import cell_temperature, counted_soc
from gz_onboard.model.effect import load_effect, package_effects
from gz_onboard.model.model import standing_load
from gz_onboard.model.series import all_quantities, total
from gz_onboard.model.traits import traits
from gz_onboard.priors import USUAL_SIZES, sizes_of
from gz_onboard.recording.recording import Recording, read_recording
from gz_onboard.vehicle import Vehicle
from tests.support import LOGS, cell_voltage

NOISE = ChannelNoise(white=2.0, slow=1.5, time=30.0)
RIDE = Ride("made up", np.zeros(0), {}, {}, 0.25, None)


@pytest.fixture(scope="module")
def samples(scooter: Vehicle) -> Recording:
    return read_recording(LOGS / "city_14C.blf", scooter)


# --- the grid -------------------------------------------------------------------------------------------------------


def test_the_grade_by_altitude_is_that_of_the_hill():
    speed = np.full(4000, 10.0)
    way = np.cumsum(speed) * STEP
    grade = grade_by_altitude(20.0 * np.sin(way / 300.0), speed)
    assert grade[300:-300] == pytest.approx((20.0 / 300.0) * np.cos(way / 300.0)[300:-300], abs=0.003)
    assert not grade_by_altitude(way, np.zeros(4000)).any()


def test_a_message_may_state_how_old_its_values_are(scooter: Vehicle, samples: Recording):
    (message,) = {s.message for s in scooter.mapping.sources if s.role == "gps_speed"}
    late = replace(scooter, mapping=replace(scooter.mapping, delays={message: 0.9}))
    usual, later = (known_from(vehicle).ride(samples) for vehicle in (scooter, late))
    assert later.signals["gps_speed"][:-5] == pytest.approx(usual.signals["gps_speed"][5:], abs=1e-6)
    assert (later.signals["pack_voltage"] == usual.signals["pack_voltage"]).all()


def test_sensor_errors_of_the_file_are_corrected_in_start_charge_and_heat(scooter: Vehicle):
    """A steady ride on a cold and nearly empty pack, its lights on before, as its wrong sensors show it."""
    cold, amperes, soc, seconds = 5.0, 30.0, 0.15, 120
    wrong = {"pack_current_offset": 1.0, "pack_current_gain": 1.05, "pack_voltage_offset": 0.3}
    mixed = known_from(replace(scooter, parameters=scooter.parameters.replaced(**wrong)))
    battery, p = mixed.system.pack, mixed.vehicle.parameters
    cell = cell_voltage(battery, soc, 0.0, amperes / battery.cells_parallel, cold)
    load = standing_load(amperes, battery.pack_voltage(cell, amperes), p["auxiliary_power"]) / battery.cells_parallel
    settled = [e for e in mixed.system.cells if e.effect.name == "charge_transfer"]  # slower ones are left at rest
    cell -= total(settled, all_quantities(cell_current=load, cell_temperature=cold))
    volts = battery.pack_voltage(cell, amperes)
    shown = {
        "motor_speed": 30.0,
        "motor_current": 20.0,
        "ambient_temperature": cold,
        "cell_temperature": cold,
        "pack_voltage": volts + 0.3,
        "pack_current": amperes * 1.05 + 1.0,
    }
    time = np.arange(0.0, seconds, 0.05)
    ride = mixed.ride(Recording("made up", {role: (time, np.full(len(time), x)) for role, x in shown.items()}, {}))
    taken = amperes * STEP * len(ride.time) / (3600 * battery.pack_capacity(cold))
    assert ride.start_soc == pytest.approx(soc, abs=1e-3)
    assert counted_soc(ride, mixed.system)[-1] == pytest.approx(soc - taken, abs=1e-3)
    assert ride.energy == pytest.approx(volts * amperes * STEP * len(ride.time))
    healthy = cell_temperature(ride, mixed.values, mixed.system)
    more = cell_temperature(ride, mixed.values | {"pack_current_offset": 0.0}, mixed.system)  # more current, more heat
    assert more[-1] < healthy[-1]


# --- parameters -----------------------------------------------------------------------------------------------------


def test_scales_noise_and_knots_grow_with_the_vehicle(scooter: Vehicle):
    assert sizes_of(scooter) == USUAL_SIZES
    p = scooter.parameters
    heavy = scooter.changed(p.replaced(vehicle_mass=4 * p["vehicle_mass"], motor_current_limit=4 * 211.0))
    geared = scooter.changed(p.replaced(gear_ratio=p["gear_ratio"] / 4, cell_capacity=4 * p["cell_capacity"]))
    sizes = sizes_of(heavy)
    assert (sizes.power, sizes.current, sizes.voltage, sizes.speed) == pytest.approx((4.0, 4.0, 1.0, 1.0))
    assert (sizes_of(geared).spin, sizes_of(geared).resistance) == pytest.approx((4.0, 1 / 4))
    small, large, spun = map(known_from, (scooter, heavy, geared))
    for name, other, factor in (("loss_speed", large, 4.0), ("copper_speed", spun, 0.25)):
        (place,) = small.index([name])
        assert other.scale[place] == pytest.approx(factor * small.scale[place])
    assert large.noise["road_force"].white == pytest.approx(4 * small.noise["road_force"].white)
    form = curve_form("road_force", "motor_current", sizes=sizes)
    assert form.knots == pytest.approx(4 * np.array(KNOTS["motor_current"][0]))
    assert form.size == pytest.approx(4 * curve_form("road_force", "motor_current").size)


def test_effects_declare_how_a_cause_shows():
    found = {cause.name: cause for cause in candidates()}
    for effect in map(load_effect, package_effects()):
        known = traits(effect)
        assert set(known.strengths) <= {parameter.name for parameter in effect.parameters}
        name = known.cause[0] if known.cause else effect.name
        if name in found:
            assert found[name].names == known.strengths and known.shown_by
    assert found["headwind"].varies and found["headwind"].reads == ("drag_area",)


# --- statistics -----------------------------------------------------------------------------------------------------


def table(columns: np.ndarray, y: np.ndarray) -> LinearChannel:
    m = len(y)
    used = np.ones(m, dtype=bool)
    return LinearChannel(
        CHANNEL["road_force"], y, columns, np.linspace(0.0, 4.0 * (m - 1), m), used, roughness=np.ones(m)
    )


def test_statistics_are_those_of_generalised_least_squares():
    rng = np.random.default_rng(2)
    a, more, y = rng.normal(size=(80, 6)), rng.normal(size=(80, 2)), rng.normal(size=80)
    a[:, 4] = 0.0
    narrow, wide = table(a, y), table(np.column_stack([a, more]), y)
    apart = np.abs(np.subtract.outer(wide.time, wide.time))
    covariance = NOISE.white**2 * np.eye(80) + NOISE.slow**2 * np.exp(-apart / NOISE.time)
    inverse = np.linalg.inv(covariance)
    expected = Statistics(wide.a.T @ inverse @ wide.a, wide.a.T @ inverse @ y)
    of = {"road_force": NOISE}
    for found in (
        Statistics.of({"road_force": wide}, of),
        Statistics.of({"road_force": narrow}, of).padded(2).with_columns(narrow, NOISE, more),
    ):
        assert found.information == pytest.approx(expected.information)
        assert found.score == pytest.approx(expected.score)
    ratio, time = np.array([0.0, NOISE.slow / NOISE.white]), np.full(2, NOISE.time)
    innovation, variance = innovations(wide.time, y, ratio, time)
    assert np.sum(innovation**2 / variance, axis=0) == pytest.approx([y @ y, y @ inverse @ y * NOISE.white**2])
    determinant = np.linalg.slogdet(covariance / NOISE.white**2).logabsdet
    assert np.sum(np.log(variance), axis=0) == pytest.approx([0.0, determinant])
    white = whitened(wide, NOISE, np.column_stack([y, 2 * y]))
    assert white[:, 0] @ white[:, 1] == pytest.approx(2 * y @ inverse @ y)


def test_statistics_move_with_the_parameters_as_residuals_do(mixed: MixedModel, samples: Recording):
    (line,) = linearise_all([mixed.ride(samples)], mixed)
    offset = np.random.default_rng(0).normal(size=len(mixed.names))
    moved = line.seen_from(offset)
    again = moved.at_noise(mixed.noise).statistics
    assert moved.statistics.score == pytest.approx(again.score, rel=1e-6, abs=1e-6 * np.abs(again.score).max())
    assert moved.seen_from(-offset).tables["road_force"].y == pytest.approx(line.tables["road_force"].y)


def test_linearising_elsewhere_is_seen_from_the_same_place(mixed: MixedModel, samples: Recording):
    """Of a parameter that residuals are linear in, the residuals do not change."""
    offset = np.zeros(len(mixed.names))
    (i,) = mixed.index(["auxiliary_power"])
    offset[i] = 3.0
    rides = [mixed.ride(samples)]
    here, there = linearise_all(rides, mixed)[0], linearised_about(rides, mixed, offset)[0]
    assert there.tables["auxiliary"].y == pytest.approx(here.tables["auxiliary"].y, abs=1e-9)


def test_what_is_free_is_what_the_rides_say(mixed: MixedModel):
    p, (i,) = len(mixed.names), mixed.index(["payload_mass"])
    n, b = np.zeros((p, p)), np.zeros(p)
    n[i, i], b[i] = 4.0, 12.0
    held, wide, free = (m.fit([Statistics(n, b)] * 3).mean[i] for m in (mixed, mixed.widened(), mixed.freed([i])))
    assert 0 < held < wide < free == pytest.approx(3.0, rel=1e-4)


def test_noise_is_learned_as_it_was_made():
    rng = np.random.default_rng(5)
    slow, white = np.zeros(2000), rng.normal(size=2000)
    keeps = np.exp(-4.0 / 60.0)
    for k in range(1, 2000):
        slow[k] = keeps * slow[k - 1] + np.sqrt(1 - keeps**2) * rng.normal()
    made = table(np.zeros((2000, 1)), 3.0 * white + 3.0 * slow)
    line = LinearRide(RIDE, {"road_force": made}, Statistics(np.zeros((1, 1)), np.zeros(1)))
    found = learn_noise([line], np.zeros((1, 1)), {"road_force": NOISE})["road_force"]
    assert [*found] == pytest.approx([3.0, 3.0, 60.0], rel=0.1)


def test_an_outlier_is_trimmed_with_its_neighbours(mixed: MixedModel, samples: Recording):
    times, values = samples.columns["pack_voltage"]
    spoiled = np.where(np.abs(times - times[0] - 300.0) < 1.0, values + 5.0, values)
    ride = replace(samples, columns={**samples.columns, "pack_voltage": (times, spoiled)})
    whole, less = (linearise_all([mixed.ride(x)], mixed)[0].tables["cell_voltage"] for x in (samples, ride))
    gone = whole.used & ~less.used
    assert 3 <= gone.sum() <= 8 and abs(np.flatnonzero(gone).mean() * 2.0 - 300.0) < 6.0


def test_the_fewer_the_healthy_rides_the_less_a_curve_of_many_coefficients_says():
    for freedom in (8.0, 22.0, 200.0):
        assert one_degree(30.0, 1, freedom) == pytest.approx(30.0)  # F(1, n) is the square of Student's t
        scores = [one_degree(c, 8, freedom) for c in (0.0, 1.0, 10.0, 50.0, 500.0, 1e5, 1e8)]
        assert scores == sorted(scores) and np.isfinite(scores).all()
    assert one_degree(60.0, 8, 8.0) < one_degree(60.0, 8, 22.0) < one_degree(60.0, 8, 2000.0)
    # with the scatter as good as known it is the chi-squared that is as unlikely
    assert chi2.sf(one_degree(40.0, 8, 1e7), 1) == pytest.approx(f.sf(5.0, 8, 1e7), rel=1e-3)


# --- curves ---------------------------------------------------------------------------------------------------------


def poor(mixed: MixedModel, ride: Recording, **columns: tuple[np.ndarray, np.ndarray]) -> LinearRide:
    """`ride` as one shows it that measured no more than pack and speed, and `columns`."""
    known = {role: ride.columns[role] for role in ("pack_voltage", "pack_current", "motor_speed")}
    (line,) = linearise_all([mixed.ride(replace(ride, columns=known | columns))], mixed)
    return line


def test_no_curve_over_what_was_not_measured(mixed: MixedModel, samples: Recording):
    line = poor(mixed, samples)
    had = {form.quantity for form in curve_forms() if columns_of(line, form) is not None}
    assert had == {"speed", "acceleration", "time", "pack_current", "soc", CONSTANT}
    assert supported_knots(curve_form("pack_power", CONSTANT), [line, line]).tolist() == [[1.0]]
    whole = poor(mixed, samples, **samples.columns)
    had = {form.quantity for form in curve_forms() if columns_of(whole, form) is not None}
    assert {"heading", "lateral_acceleration", "grade", "motor_temperature", "current_change"} <= had


def test_no_curve_over_what_hardly_varies(mixed: MixedModel, samples: Recording):
    """Also between two knots, where both would count as visited."""
    times, course = samples.columns["gps_course"]
    form = curve_form("pack_power", "heading")
    turns = poor(mixed, samples, gps_course=(times, course))
    assert supported_knots(form, [turns, turns]).shape[1] > 2
    stuck = poor(mixed, samples, gps_course=(times, 0.45 + 0.01 * np.sin(times)))
    assert supported_knots(form, [stuck, stuck]).shape[1] == 0
    stuck.ride.quantities["vibration"] = np.ones_like(stuck.ride.time)
    straight = curve_form("pack_power", "vibration", straight=True)
    assert supported_knots(straight, [stuck, stuck]).shape[1] == 0


def test_a_knot_that_one_ride_alone_visits_bends_no_curve(mixed: MixedModel, samples: Recording):
    (line,) = linearise_all([mixed.ride(samples)], mixed)
    form = curve_form("road_force", "speed")
    free = supported_knots(form, [line, line])
    assert line.ride.quantities["speed"].max() < form.knots[-1]
    assert free[-1] == pytest.approx(free[-2])  # 15 m/s moves with 13
    assert free.sum(axis=1) == pytest.approx(1.0)  # a constant stays one
    whole = line.tables["road_force"]
    empty = replace(whole, used=np.zeros_like(whole.used), y=whole.y[:0], a=whole.a[:0], time=whole.time[:0])
    short = replace(line, tables={**line.tables, "road_force": empty})
    assert supported_knots(form, [line, short]).shape[1] == 0
