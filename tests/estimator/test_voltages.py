"""Two voltages of one pack, of which a guessed cell model knows neither: who is left out, and who is not.

A pack whose resistance is not the vehicle file's, driven hard: full throttle and none, each for a second or so. Both
voltages come five times a second, in messages of their own, as on an electric motorcycle from the race track.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from random import Random

import pytest

from gz_onboard.events import Estimate, Group, Reason
from gz_onboard.vehicle import read_vehicle
from tests.events import Event, EventEstimator

VEHICLE = read_vehicle("reference", 75.0)
BATTERY = VEHICLE.pack
SERIES = BATTERY.cells_series
OFFSET, GAIN = VEHICLE.parameters["pack_current_offset"], VEHICLE.parameters["pack_current_gain"]
PERIOD = 0.2  # s, of every message
RESISTANCE = 0.066  # ohm of the pack by the vehicle file, roughly: R0 and a part of R1
HARD = 45.0  # A
GROUPS = [
    Group("Pack", ("pack_voltage",), PERIOD),
    Group("Inverter", ("inverter_voltage", "pack_current"), PERIOD),
    Group("Motor", ("motor_speed",), PERIOD),
    Group("Cells", ("cell_temperature",), 1.0),
]
PACK, INVERTER, MOTOR, CELLS = range(4)
VOLTAGES = "pack_voltage", "inverter_voltage"
Lie = Callable[[float], float]


def honest(value: float) -> float:
    return value


def events(seconds: float, factor: float, lies: dict[str, Lie], begin: float) -> Iterator[Event]:
    """What the bus says; factor: of the resistance over the file's; lies: from `begin` [s] on."""
    rng, soc, current, until = Random(1), 0.8, 0.0, 40.0
    for step in range(round(seconds / PERIOD)):
        t = step * PERIOD
        if t >= until:
            current, until = (HARD if current < 1 else 0.2), t + rng.uniform(0.4, 2.5)
        soc -= current * PERIOD / 3600 / 32.8
        voltage = SERIES * BATTERY.ocv(soc)[0] - factor * RESISTANCE * current
        pack, inverter = (lies.get(role, honest) if t >= begin else honest for role in VOLTAGES)
        # The step is made with the pack's message: the inverter's values are of the step before.
        yield t, PACK, (round(pack(voltage), 2),)
        yield t + 0.001, INVERTER, (round(inverter(voltage), 2), OFFSET + GAIN * current)
        yield t + 0.002, MOTOR, (40.0 if t > 40 else 0.0,)
        if step % 5 == 0:
            yield t + 0.003, CELLS, (20.0,)


def ridden(seconds: float, factor: float, begin: float = 0.0, **lies: Lie) -> list[Estimate]:
    """An estimate each second."""
    estimator = EventEstimator(GROUPS, BATTERY, VEHICLE.model, VEHICLE.riding)
    made: list[Estimate] = []
    for event in events(seconds, factor, lies, begin):
        while event[0] >= len(made) + 1:
            made.append(estimator.estimate(len(made) + 1.0))
        estimator.handle(event)
    return made


@pytest.mark.parametrize("factor", [0.4, 1.0, 2.0, 3.0])
def test_two_that_agree_are_both_believed_whatever_the_model_says(factor: float):
    made = ridden(250.0, factor)
    left_out = {role for e in made for role in e.distrusted}
    assert not left_out.intersection(VOLTAGES)
    assert all(e.pack_voltage is not None for e in made[5:])
    if factor >= 3:
        assert any(e.reasons & Reason.VOLTAGE_MISMATCH for e in made), "that the model is wrong is not told"


@pytest.mark.parametrize("factor", [1.0, 3.0])
@pytest.mark.parametrize("liar", VOLTAGES)
@pytest.mark.parametrize("off", [-4.0, 4.0])
def test_of_two_that_differ_the_healthy_one_is_never_left_out_alone(factor: float, liar: str, off: float):
    """A model that is wrong decides nothing: where it is asked who is right, both are doubted."""
    made = ridden(150.0, factor, 100.0, **{liar: lambda v: v + off})
    healthy = next(role for role in VOLTAGES if role != liar)
    blamed = [e.time for e in made if healthy in e.distrusted and liar not in e.distrusted]
    assert not blamed
    assert liar in made[-1].distrusted
