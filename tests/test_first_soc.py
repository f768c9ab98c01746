"""A ride that begins under a standing load: every room has the same first state of charge, and it is the pack's."""

from __future__ import annotations

import numpy as np
import pytest

from gz_onboard.calibration.cooling import ride_run
from gz_onboard.discovery.mixed_model import initial
from gz_onboard.discovery.residuals import start_soc
from gz_onboard.events import Group
from gz_onboard.model.effect import Port
from gz_onboard.model.series import all_quantities, first_soc, total
from gz_onboard.recording.recording import Recording
from gz_onboard.simulation.recorded import Recorded, rest_soc
from gz_onboard.vehicle import read_vehicle
from tests.events import EventEstimator
from tests.support import cell_voltage

VEHICLE = read_vehicle("reference", 75.0)
PACK, P = VEHICLE.pack, VEHICLE.parameters
SOC, COLD, SECONDS = 0.5, -5.0, 400  # 1, degC, s
(REACTION,) = (e for e in VEHICLE.model.at(Port.CELL_VOLTAGE) if e.effect.name == "charge_transfer")
GROUPS = [
    Group("Pack", ("pack_voltage", "pack_current"), 0.1),
    Group("Motor", ("motor_speed",), 0.1),
    Group("Cells", ("cell_temperature", "ambient_temperature"), 1.0),
]
AMPERES = pytest.mark.parametrize("amperes", [-6.0, 2.0, 12.0], ids=["charger", "lights", "heater"])


def shown(amperes: float) -> float:
    """The pack's voltage [V] after a while at `amperes`: the reaction has settled, what is slower is left at rest."""
    cell = amperes / PACK.cells_parallel
    lost = total([REACTION], all_quantities(cell_current=cell, cell_temperature=COLD))
    return float(PACK.pack_voltage(cell_voltage(PACK, SOC, 0.0, cell, COLD) - lost, amperes))


def ride(amperes: float) -> Recording:
    time = np.arange(0.0, SECONDS, 0.05)
    values = {
        "motor_speed": 0.0,
        "motor_current": 0.0,
        "motor_temperature": COLD,
        "ambient_temperature": COLD,
        "cell_temperature": COLD,
        "pack_voltage": shown(amperes) + P["pack_voltage_offset"],
        "pack_current": amperes * P["pack_current_gain"] + P["pack_current_offset"],
    }
    return Recording("standing", {role: (time, np.full(len(time), value)) for role, value in values.items()}, {})


@AMPERES
def test_the_first_soc_has_the_reaction_settled(amperes: float) -> None:
    found = first_soc(VEHICLE.model.at(Port.CELL_VOLTAGE), PACK, (shown(amperes), amperes), COLD, amperes)
    assert found == pytest.approx(SOC, abs=4e-3)


@pytest.mark.parametrize("amperes", [-6.0, 1.2, 2.0, 12.0])
def test_on_board(amperes: float) -> None:
    """A usual load is believed; of a larger one the sensor may as well be wrong, and the interval says so."""
    e = EventEstimator(GROUPS, PACK, VEHICLE.model, VEHICLE.riding)
    for step in range(20):
        t = 0.1 * step
        if step % 10 == 0:
            e.handle((t, 2, (COLD, COLD)))
        e.handle((t, 1, (0.0,)))
        volts = shown(amperes) + P["pack_voltage_offset"] + 1e-3 * (step % 2)
        e.handle((t + 0.01, 0, (volts, amperes * P["pack_current_gain"] + P["pack_current_offset"])))
        if e.pack.is_started:
            break
    assert e.pack.is_started
    sd = e.pack.state.covariance[0] ** 0.5
    assert e.pack.state.soc == pytest.approx(SOC, abs=5e-3 if abs(amperes) < 1.5 else 1.5 * sd)
    assert sd < 0.08


@pytest.mark.parametrize("amperes", [1.2])
def test_in_discovery_simulation_and_calibration(amperes: float) -> None:
    """Of lights; a ride may begin with the throttle open, whose load has not flowed yet."""
    mixed = initial(VEHICLE)
    assert start_soc(mixed.ride(ride(amperes)), mixed.system) == pytest.approx(SOC, abs=4e-3)
    signals = {
        role: np.full(200, value) for role, value in (("pack_voltage", shown(amperes)), ("pack_current", amperes))
    }
    recorded = Recorded("standing", 0.01, signals | {"cell_temperature": np.full(200, COLD)}, np.zeros(1), np.zeros(1))
    assert rest_soc(recorded, VEHICLE) == pytest.approx(SOC, abs=4e-3)
    assert ride_run(ride(amperes), VEHICLE).soc[0] == pytest.approx(SOC, abs=4e-3)
