from __future__ import annotations

import numpy as np
import pytest

from gz_onboard.calibration.sensors import RIDE, cable_resistance, cell_steps, pack_series_resistance
from gz_onboard.errors import InputError

from .bench import table
from .rides import CABLE, CELL_STEP, SERIES, VEHICLE, ride


def pulse(temperature, ohm, sign=1):
    """Pulses of a cell that is a resistance only, 0.1 s after a change, 2 s before."""
    time, current, now = [], [], 0.0
    for k in range(24):
        for dt in [0.1] * 20 + [2.0] * 10:
            time.append(now)
            current.append(sign * (5.0 if k % 2 else 0.0))
            now += dt
    amperes = np.array(current)
    return table(
        time=time, current=amperes, voltage=3.7 - ohm * amperes, cell_temperature=np.full(len(time), temperature)
    )


def test_cable_intervals_hold_voltage_sensors_of_their_class():
    """Over scooters whose two voltage sensors err in gain."""
    rng, held, count = np.random.default_rng(0), 0, 100
    for seed in range(count):
        gains = tuple(1 + RIDE.voltage_gain_sd * rng.normal(size=2))
        rides = [ride(3 * seed + k, seconds=200, voltage_gains=gains) for k in range(3)]
        found = cable_resistance(rides, VEHICLE).parameters["cable_resistance"]
        held += abs(found.value - CABLE) < 1.96 * found.sd
    assert 0.9 <= held / count <= 0.99, held


def test_cell_steps_are_the_resistance_at_once():
    temperature, logarithm = cell_steps([pulse(40.0, 0.03), pulse(10.0, 0.06)])
    assert np.allclose(temperature, [10, 40]) and np.allclose(np.exp(logarithm), [0.06, 0.03])
    with pytest.raises(InputError, match="0 steps of current"):
        cell_steps([table(time=[0, 1, 2], current=[1, 1, 1], voltage=[3, 3, 3], cell_temperature=[9, 9, 9])])


def test_series_resistance_is_what_the_cells_do_not_explain():
    pulses = [pulse(10.0, CELL_STEP), pulse(40.0, CELL_STEP)]
    # the vehicle's gain and offset of the current are not those of the planted sensor: within 1 %
    found = pack_series_resistance([ride(seed) for seed in range(4)], VEHICLE, pulses)
    series = found.parameters["pack_series_resistance"]
    assert abs(series.value - SERIES) < 1.96 * series.sd and "pulse tests" in series.source


def test_a_vehicle_of_small_currents_needs_small_steps():
    p = VEHICLE.parameters
    small = VEHICLE.changed(p.replaced(motor_current_limit=p["motor_current_limit"] / 8))
    rides = [ride(seed) for seed in range(4)]
    for columns in (one.columns for one in rides):
        columns |= {role: (t, x / 8) for role, (t, x) in columns.items() if role.endswith("current")}
    found = pack_series_resistance(rides, small, [pulse(10.0, 8 * CELL_STEP), pulse(40.0, 8 * CELL_STEP)])
    series = found.parameters["pack_series_resistance"]
    assert abs(series.value - 8 * SERIES) < 1.96 * series.sd and "above 1.875 A" in series.source
    cable = cable_resistance(rides, small).parameters["cable_resistance"]
    assert abs(cable.value - 8 * CABLE) < 1.96 * cable.sd


def test_series_intervals_hold_cells_that_differ():
    """Over packs whose cells are not those of the pulse test, by what cells scatter."""
    pulses, rng = [pulse(10.0, CELL_STEP), pulse(40.0, CELL_STEP)], np.random.default_rng(0)
    held, count = 0, 60
    for seed in range(count):
        cell = CELL_STEP * (1 + RIDE.cells_sd * rng.normal())
        rides = [ride(3 * seed + k, seconds=200, cell=cell, series=2 * SERIES) for k in range(3)]
        found = pack_series_resistance(rides, VEHICLE, pulses).parameters["pack_series_resistance"]
        held += abs(found.value - 2 * SERIES) < 1.96 * found.sd
    assert 0.9 <= held / count <= 0.99


def test_no_number_where_the_cells_own_doubt_is_greater():
    strong = [pulse(10.0, 0.046), pulse(40.0, 0.046)]
    result = pack_series_resistance([ride(seed) for seed in range(4)], VEHICLE, strong)
    assert not result.parameters and any("the value of the vehicle file stays" in r for r in result.refusals)


def test_bad_rides_are_refused():
    with pytest.raises(InputError, match="spans too little for a resistance"):
        cable_resistance([ride(0, calm=True)], VEHICLE)
    with pytest.raises(InputError, match="0 steps of more than 15 A"):
        pack_series_resistance([ride(0, temperature=5.0)], VEHICLE)
    with pytest.raises(InputError, match="no cell_temperature"):
        pack_series_resistance([ride(0, drop=["cell_temperature"])], VEHICLE)
    beyond = [pulse(40.0, CELL_STEP), pulse(30.0, CELL_STEP)]
    with pytest.raises(InputError, match="0 steps"):  # no extrapolation to colder cells than were tested
        pack_series_resistance([ride(0)], VEHICLE, beyond)
