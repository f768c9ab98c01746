"""An effect that reads how rough the road is: what the estimator makes of the vertical accelerometer's samples."""

from __future__ import annotations

import json
import math
from itertools import groupby
from math import exp, floor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.estimator.motion import MOTION, VibrationMonitor
from gz_onboard.estimator.signals import Signal
from gz_onboard.events import WINDOW, Group, RoleWindow
from gz_onboard.model.effect import load_effect
from gz_onboard.model.sensors import VIBRATION_MEMORY_S, VIBRATION_PERIOD_S
from gz_onboard.vehicle import Vehicle, read_vehicle
from tests.estimator.life import GROUPS, STEP, Scooter
from tests.events import EventEstimator
from tests.support import joined, without_cell_effects

BASE = without_cell_effects(read_vehicle("reference", 75.0))
ROUGH = """\"\"\"Drag of a rough road, in proportion to the vibration, made up for a test.\"\"\"
from gz_onboard.model.effect import Parameter, Port
PORT = Port.{port}
PARAMETERS = (Parameter("rough_road", "1", {value}, 1.0, 0.0, 50.0, "made up for a test"),)
def term(vibration, *, rough_road):
    return rough_road * vibration
"""
NEWTONS = 8.0  # N per m/s²
TICKING = [*GROUPS, Group("Brake", ("brake_switch",), 0.01)]  # without it windows would end with the samples of shaking
SHAKEN = [*TICKING, Group("Shaken", ("accel_z",), 0.01)]
AT = len(TICKING)
TYPICAL = BASE.riding.vibration


class Vibration:
    """RMS [m/s²] of the vertical acceleration faster than `VIBRATION_PERIOD_S`, over about `VIBRATION_MEMORY_S`.

    For samples at 30 Hz or more. Two first-order filters, each exact for any time between samples. The definition of
    how rough a road is, against which estimator, discovery and simulated sensors are checked.
    """

    __slots__ = ("_mean", "_square", "_step", "_weights")

    def __init__(self) -> None:
        self._mean: float | None = None
        self._square = 0.0
        self._step = 0.0
        self._weights = (0.0, 0.0)

    def update(self, dt: float, accel_z: float) -> None:
        """Add a sample [m/s²], `dt` [s] after the last."""
        if self._mean is None:
            self._mean = accel_z
            return
        if abs(dt - self._step) > 1e-4:  # samples come evenly: the weights hold for most of them
            self._step, self._weights = dt, (1 - exp(-dt / VIBRATION_PERIOD_S), 1 - exp(-dt / VIBRATION_MEMORY_S))
        fast, slow = self._weights
        self._mean += fast * (accel_z - self._mean)
        self._square += slow * ((accel_z - self._mean) ** 2 - self._square)

    @property
    def value(self) -> float:
        """The RMS [m/s²]."""
        return float(self._square**0.5)


def vehicle_with(folder: Path, port: str = "WHEEL_FORCE", value: float = NEWTONS) -> Vehicle:
    (folder / "rough_road.py").write_text(ROUGH.format(port=port, value=value))
    effect = load_effect("rough_road", folder)
    return BASE.changed(joined(BASE.parameters, [effect]), (*BASE.model.effects, effect))


@pytest.fixture(scope="module")
def rough(tmp_path_factory) -> Vehicle:
    return vehicle_with(tmp_path_factory.mktemp("rough"))


# --- the samples --------------------------------------------------------------------------------------------------


def shaken(seconds, rms, *, step=0.01, begin=0.0, seed=1):
    """(time, accel_z) of white shaking that `Vibration` shows as `rms`."""
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


def test_it_is_what_the_lab_makes_of_the_same_samples():
    samples = shaken(30, 1.7)
    lab = Vibration()
    for (before, _), (time, z) in zip([samples[0], *samples], samples, strict=False):
        lab.update(time - before, z)
    assert fed(samples).value(samples[-1][0]) == pytest.approx(lab.value, rel=0.1)
    assert lab.value == pytest.approx(1.7, rel=0.15)


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


@given(st.lists(st.tuples(st.floats(0, 0.3), st.floats(-60, 60)), max_size=60), st.floats(0, 0.2))
def test_whatever_comes_it_is_none_or_a_possible_number(steps, after):
    samples, now = shaken(MOTION.vibration_after + 1, 1.0, begin=-8.0), 0.0
    for dt, z in steps:
        now += dt
        samples.append((now, z))
    value = fed(samples).value(now + after)
    assert value is None or 0 <= value <= 120


# --- in the estimator ---------------------------------------------------------------------------------------------


def events(seconds, vibration, lost=lambda t: False):
    """The scooter's ride with shaking of `vibration` [m/s²] in accel_z, from the first second on."""
    both = [*Scooter(offset=0.0, period=0.1).live(seconds, 9.0)]
    both += [(STEP * i / 10 + 0.0002, AT - 1, (0.0,)) for i in range(10, round(seconds / STEP) * 10)]
    both += [(t + 0.0005, AT, (None if lost(t) else z,)) for t, z in shaken(seconds, vibration, begin=STEP)]
    return sorted(both, key=lambda event: event[0])


def estimated(vehicle, rows, groups=SHAKEN):
    e = EventEstimator(groups, vehicle.pack, vehicle.model, vehicle.riding)
    for event in rows:
        e.handle(event)
    return e


def modelled(e):
    """(energy [J], way [m]) of the riding, older riding weighted down."""
    sums = e.forecaster.learner.state.sums
    return sums.modelled, sums.distance


@pytest.fixture(scope="module")
def quiet(rough):
    return estimated(rough, events(240, 0.01))


def test_the_road_load_is_that_of_the_shaking(rough, quiet):
    for vibration in (1.0, 2.5):
        e = estimated(rough, events(240, vibration))
        assert e.load.vibration(240.0 - 0.01) == pytest.approx(vibration, rel=0.15)
        (energy, way), (base, same) = modelled(e), modelled(quiet)
        assert way == same
        # and what the motor loses for it
        assert NEWTONS * vibration * 0.95 < (energy - base) / way < NEWTONS * vibration * 1.25
        # what was measured is the same: less of it is left for the factor
        assert e.forecaster.learner.factor < quiet.forecaster.learner.factor


def test_missing_or_implausible_it_is_the_typical(rough, quiet):
    base, way = modelled(quiet)
    found = []
    for rows, groups in (
        ([row for row in events(240, 2.5) if row[1] != AT], TICKING),  # a vehicle without
        ([row for row in events(240, 2.5) if row[1] != AT], SHAKEN),  # nothing came
        (events(240, 2.5, lambda t: True), SHAKEN),  # implausible or dropped, all of it
        ([row for row in events(240, 2.5) if row[1] != AT or round(row[0], 2) * 10 % 1 < 0.05], SHAKEN),  # at 10 Hz
    ):
        e = estimated(rough, rows, groups)
        energy, ridden = modelled(e)
        assert e.load.vibration(240.0) == TYPICAL
        found.append(energy / ridden)
        assert found[-1] - base / way == pytest.approx(NEWTONS * TYPICAL, rel=0.15)
    assert max(found) < 1.001 * min(found)


def test_lost_midway_it_goes_over_to_the_typical_and_back(rough):
    e, seen = estimated(rough, []), {}
    for event in events(120, 2.5, lambda t: 50 < t < 70):
        e.handle(event)
        seen[round(event[0])] = e.load.vibration(event[0])
    assert seen[49] == pytest.approx(2.5, rel=0.2)
    assert seen[60] in (TYPICAL, 0.0)
    assert seen[74] in (TYPICAL, 0.0)
    assert seen[90] == pytest.approx(2.5, rel=0.2)


def test_slow_motion_is_no_vibration():
    hills = [(0.01 * i, 9.81 + 2.0 * math.sin(0.01 * i)) for i in range(2000)]
    assert fed(hills).value(19.99) < 0.3


def test_what_was_learned_outlives_a_restart(rough):
    first = estimated(rough, events(240, 2.5))
    saved = json.loads(json.dumps(first.snapshot(rough.key)))
    second = estimated(rough, [])
    second.restore(saved, rough.key, 5.0)
    assert second.snapshot(rough.key) is None  # it waits for a voltage
    waited = {"still": first.forecaster.learner.still + 5.0}
    assert second.forecaster.snapshot() == first.forecaster.snapshot() | waited
    assert second.load.vibration(240.0) == 0.0  # standing, and nothing is known of the road
    at = (0.6, 0.01, 20.0, 1.0, 20.0, 0.0)
    mended = first.forecaster
    mended.learner._segment = mended.learner._segment.__class__()  # a restart drops the open segment
    first.pack.age.apply(first.pack.state)  # and uses at once what else is only used now and then
    assert second.forecaster.forecast(*at) == mended.forecast(*at)
    with pytest.raises(ValueError, match="rough_road"):
        estimated(BASE, []).restore(saved, BASE.key, 5.0)
