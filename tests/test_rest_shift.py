"""What depends on temperature beside resistance: `rest_shift`, `voltage_error` and its time."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.errors import InputError
from gz_onboard.estimator.battery_priors import VoltageNoise
from gz_onboard.events import Group
from gz_onboard.model.battery import Battery
from gz_onboard.model.functions import PiecewiseLinear
from gz_onboard.simulation.parts import FirstOrderPack
from gz_onboard.simulation.scooter import Scooter
from gz_onboard.vehicle import OWN, read_vehicle
from tests.events import EventEstimator

VEHICLE = read_vehicle("reference", 75.0)
PLAIN = VEHICLE.pack
COLD = replace(PLAIN, rest_shift_curve=PiecewiseLinear((-10.0, 10.0, 25.0), (-0.03, -0.01, 0.0)), rest_shift_sd=0.004)
TABLE = """
[battery.rest_shift]
temperature = [-10.0, 10.0, 25.0]
value = [-0.030, -0.010, 0.0]
unit = "V"
sd = 0.004
"""
temperatures = st.floats(-30, 50)


def read(folder: Path, table: str) -> Battery:
    """The pack of the reference scooter with `table` in place of its own."""
    file = folder / "vehicle.toml"
    header = table.split(maxsplit=1)[0]
    text = re.sub(rf"^{re.escape(header)}\n.*?(?=^\[)", "", (OWN / "reference.toml").read_text(), flags=re.M | re.S)
    file.write_text(text + table)
    return read_vehicle(str(file)).pack


def test_the_table_is_read(tmp_path):
    battery = read(tmp_path, TABLE)
    assert (battery.rest_shift_curve, battery.rest_shift_sd) == (COLD.rest_shift_curve, COLD.rest_shift_sd)
    assert battery.rest_shift(0.0) == pytest.approx(-0.02)
    assert (battery.rest_shift(-40.0), battery.rest_shift(60.0)) == (-0.03, 0.0)


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ('"V"', '"mV"', ["battery.rest_shift", "mV", "V"]),
        ("-0.010, 0.0", "-0.010", ["battery.rest_shift", "3 numbers", "one for each temperature"]),
        ("-0.030", "-30.0", ["battery.rest_shift", "outside -0.2 to 0.2"]),
        ("-10.0, 10.0", "10.0, -10.0", ["battery.rest_shift", "must increase"]),
        ("sd = 0.004", "sd = 4.0", ["battery.rest_shift", "sd", "0.2"]),
        ("unit", "units", ["battery.rest_shift", "did you mean 'unit'"]),
    ],
)
def test_bad_tables_are_refused(tmp_path, old, new, parts):
    with pytest.raises(InputError) as error:
        read(tmp_path, TABLE.replace(old, new, 1))
    for part in parts:
        assert part in str(error.value)


@given(st.floats(-0.05, 1.05), temperatures, st.floats(-500, 3000))
def test_without_the_table_the_same_bits(soc, temperature, power):
    assert PLAIN.ocv(soc, temperature) == PLAIN.ocv(soc)
    volts = PLAIN.ocv(soc)[0]
    assert PLAIN.soc_at(volts, temperature) == PLAIN.soc_at(volts)
    flat = replace(COLD, rest_shift_curve=PiecewiseLinear((-10.0, 25.0), (0.0, 0.0)))
    assert flat.settled_current(power, soc, temperature) == PLAIN.settled_current(power, soc, temperature)


def test_the_filter_reckons_with_it():
    """A cold cell that rests 20 mV lower: told so, the filter stays where it is right; not told, it is drawn away."""
    soc = {}
    groups = [Group("Cells", ("cell_temperature",), 1.0), Group("Pack", ("pack_voltage", "pack_current"), 1.0)]
    for battery in (COLD, PLAIN):
        estimator = EventEstimator(groups, battery, VEHICLE.model, VEHICLE.riding)
        offset = VEHICLE.parameters["pack_voltage_offset"], VEHICLE.parameters["pack_current_offset"]
        volts = 14 * COLD.ocv(0.6, 0.0)[0] + offset[0]
        for k in range(300):
            estimator.handle((float(k), 0, (0.0,)))
            estimator.handle((k + 0.1, 1, (volts, offset[1])))
        assert estimator.pack.is_started
        soc[battery is COLD] = estimator.pack.state.soc
    assert soc[True] == pytest.approx(0.6, abs=1e-6)
    assert soc[False] < 0.6 - 0.5 * 0.02 / COLD.ocv(0.6)[1]


def test_the_simulated_pack_rests_there_and_its_energy_closes():
    pack = FirstOrderPack(COLD, 0.6)
    assert pack.draw(0.0, 0.01, 0.0)[1] == pytest.approx(14 * COLD.ocv(0.6, 0.0)[0], abs=1e-6)
    delivered = heat = 0.0
    for k in range(60_000):
        temperature = -10 + 30 * k / 60_000  # the shift moves on the way
        _, _, warmth, power = pack.draw(900.0, 0.01, temperature)
        delivered, heat = delivered + 0.01 * power, heat + 0.01 * warmth
    assert pack.chemical_energy_drawn() == pytest.approx(delivered + heat, rel=2e-5)
    standing = Scooter(replace(VEHICLE, battery=COLD), soc=0.6, ambient=0.0)
    assert standing.voltage == pytest.approx(14 * COLD.ocv(0.6, 0.0)[0])


TIMES = """
[battery.voltage_error_time]
temperature = [-10.0, 25.0]
value = [1000.0, 160.0]
unit = "s"
sd_relative = 0.2
"""


def test_for_how_long_it_errs_the_same_way_is_read_over_temperature(tmp_path):
    battery = read(tmp_path, TIMES)
    usual = VEHICLE.parameters["cell_voltage_error_time"]
    over, plain = (VoltageNoise(b, VEHICLE.parameters) for b in (battery, PLAIN))
    assert [over.error_time(t) for t in (-20.0, 7.5, 40.0)] == pytest.approx([1000.0, 580.0, 160.0])
    assert plain.error_time(-20.0) == plain.error_time(40.0) == usual
    slope = battery.ocv(0.6)[1]
    cold, warm = (over.slow(0.6, slope, t, 0.2**2)[1] for t in (-10.0, 25.0))  # before anything is known of the charge
    assert cold == pytest.approx(1000.0, rel=0.01)
    assert 160.0 < warm < 0.2 * cold
    with pytest.raises(InputError, match=r"voltage_error_time.*outside 10 to 36000"):
        read(tmp_path, TIMES.replace("160.0", "1.0"))
    with pytest.raises(InputError, match=r"voltage_error_time.*min"):
        read(tmp_path, TIMES.replace('"s"', '"min"'))
