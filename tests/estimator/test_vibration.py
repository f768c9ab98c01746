"""An effect that reads how rough the road is: what the estimator makes of the vertical accelerometer's samples."""

from __future__ import annotations

import math
from itertools import groupby
from math import floor

import numpy as np
import pytest

from gz_onboard.estimator.motion import MOTION, VibrationMonitor
from gz_onboard.estimator.signals import Signal
from gz_onboard.events import WINDOW, Group, RoleWindow
from gz_onboard.model.effect import load_effect
from gz_onboard.vehicle import Vehicle, read_vehicle
from tests.estimator.life import GROUPS, STEP, Scooter
from tests.events import EventEstimator
from tests.support import joined, without_cell_effects

BASE = without_cell_effects(read_vehicle("reference", 75.0))
NEWTONS = 8.0  # N per m/s²
ROUGH = f"""\"\"\"Drag of a rough road, in proportion to the vibration, made up for a test.\"\"\"
from gz_onboard.model.effect import Parameter, Port
PORT = Port.WHEEL_FORCE
PARAMETERS = (Parameter("rough_road", "1", {NEWTONS}, 1.0, 0.0, 50.0, "made up for a test"),)
def term(vibration, *, rough_road):
    return rough_road * vibration
"""
TICKING = [*GROUPS, Group("Brake", ("brake_switch",), 0.01)]  # without it windows would end with the samples of shaking
SHAKEN = [*TICKING, Group("Shaken", ("accel_z",), 0.01)]
AT = len(TICKING)


@pytest.fixture(scope="module")
def rough(tmp_path_factory) -> Vehicle:
    folder = tmp_path_factory.mktemp("rough")
    (folder / "rough_road.py").write_text(ROUGH)
    effect = load_effect("rough_road", folder)
    return BASE.changed(joined(BASE.parameters, [effect]), (*BASE.model.effects, effect))


# --- the samples --------------------------------------------------------------------------------------------------


def shaken(seconds, rms, *, step=0.01, begin=0.0, seed=1):
    """(time, accel_z) of white shaking that has this `rms` beyond `VIBRATION_PERIOD_S`."""
    keep = math.exp(-step / 0.1)
    noise = (
        rms / (keep * math.sqrt(2 / (1 + keep))) * np.random.default_rng(seed).standard_normal(round(seconds / step))
    )
    return [(begin + step * i, 9.81 + z) for i, z in enumerate(noise.tolist())]


def fed(samples, monitor=None):
    """The monitor after the windows of these samples."""
    monitor, signal = monitor or VibrationMonitor(), Signal()
    signal.stale_after = 0.2
    for _, those in groupby(samples, key=lambda sample: floor(sample[0] / WINDOW)):
        window = list(those)
        values = [z for _, z in window]
        square = sum(z * z for z in values) / len(values)
        signal.take(RoleWindow(window[-1][0], values[-1], len(values), sum(values) / len(values), square))
        signal.reported = signal.window_mean
        monitor.step(window[-1][0], signal)
    return monitor


def test_white_shaking_is_shown_as_it_is():
    samples = shaken(30, 1.7)
    assert fed(samples).value(samples[-1][0]) == pytest.approx(1.7, rel=0.15)


@pytest.mark.parametrize(
    ("samples", "known"),
    [
        ([], False),
        (shaken(MOTION.vibration_after - 1, 1.0), False),  # too small a number yet
        (shaken(MOTION.vibration_after + 1, 1.0), True),
        (shaken(MOTION.vibration_after + 1, 1.0, step=0.03), True),
        (shaken(30, 1.0, step=0.05), False),  # too slow to show it
        ([(0.01 * i, 9.81) for i in range(3000)], False),  # stuck
        ([(0.01 * i, 9.81 + 0.1 * (i % 90 < 45)) for i in range(3000)], True),  # coarse, but alive
        (shaken(20, 1.0) + shaken(5, 1.0, begin=21.2), False),  # a gap, just now
        (shaken(20, 1.0) + shaken(8, 1.0, begin=21.2), True),
        ([row for i, row in enumerate(shaken(30, 1.0)) if i % 10 > 1], True),  # every fifth lost
    ],
)
def test_known_or_not(samples, known):
    now = samples[-1][0] if samples else 0.0
    monitor = fed(samples)
    assert (monitor.value(now) is not None) == known
    assert monitor.value(now + 1.2) is None


# --- in the estimator ---------------------------------------------------------------------------------------------


def events(seconds, vibration):
    """The scooter's ride with shaking of `vibration` [m/s²] in accel_z, from the first second on."""
    both = [*Scooter(offset=0.0, period=0.1).live(seconds, 9.0)]
    both += [(STEP * i / 10 + 0.0002, AT - 1, (0.0,)) for i in range(10, round(seconds / STEP) * 10)]
    both += [(t + 0.0005, AT, (z,)) for t, z in shaken(seconds, vibration, begin=STEP)]
    return sorted(both, key=lambda event: event[0])


def test_the_road_load_is_that_of_the_shaking(rough):
    learners = []
    for vibration in (0.01, 1.0, 2.5):
        e = EventEstimator(SHAKEN, rough.pack, rough.model, rough.riding)
        for event in events(240, vibration):
            e.handle(event)
        assert e.load.vibration(240.0 - 0.01) == pytest.approx(vibration, rel=0.15)
        learners.append((vibration, e.forecaster.learner))
    (_, quiet), *others = learners
    before = quiet.state.sums
    for vibration, learner in others:
        sums = learner.state.sums
        assert sums.distance == before.distance
        # and what the motor loses for it
        more = (sums.modelled - before.modelled) / sums.distance
        assert NEWTONS * vibration * 0.95 < more < NEWTONS * vibration * 1.25
        assert learner.factor < quiet.factor  # what was measured is the same: less is left for the factor
