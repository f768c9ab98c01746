"""A baseline: learned from healthy rides, not believed against the file, kept in files."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gz_onboard.arrays import Array
from gz_onboard.discovery.baseline import (
    Learned,
    adopted,
    check_against_file,
    check_held_out,
    load,
    restore,
    rides_apart,
    write_baseline,
)
from gz_onboard.discovery.channels import CHANNEL
from gz_onboard.discovery.extend import write_model
from gz_onboard.discovery.grid import Ride
from gz_onboard.discovery.mixed_model import HealthyCurve, LinearChannel, LinearRide, MixedModel, Statistics
from gz_onboard.discovery.parameters import LOG_SCALED
from gz_onboard.errors import InputError
from gz_onboard.vehicle import find_vehicle, read_vehicle
from tests.discovery.material import cause, cornering, discovered

BLOCKS, RIDES = 40, 6
REFERENCE = find_vehicle("reference")


def at(mixed: MixedModel, name: str, value: float) -> Array:
    mean = mixed.mean.copy()
    (i,) = mixed.index([name])
    mean[i] += (value - mixed.values[name]) / float(mixed.scale[i])
    return mean


def ride(mixed: MixedModel, channel: str, name: str, value: float, called: str = "made up") -> LinearRide:
    """A ride whose `channel` asks for this value of `name`."""
    a = np.zeros((BLOCKS, len(mixed.names)))
    a[:, mixed.index([name])] = 5 * mixed.noise[channel].sd
    n = 4 * BLOCKS * 10
    made = Ride(called, np.linspace(0.0, n / 10, n), {}, {}, 0.25, None, {"speed": np.full(n, 8.0)}, 1e5)
    used, even = np.ones(BLOCKS, dtype=bool), np.ones(BLOCKS)
    y, time = a @ at(mixed, name, value), np.linspace(0.0, 4.0 * BLOCKS, BLOCKS)
    tables = {channel: LinearChannel(CHANNEL[channel], y, a, time, used, roughness=even)}
    return LinearRide(made, tables, Statistics.of(tables, mixed.noise))


def learned(mixed: MixedModel, channel: str, name: str, value: float, fold: float) -> Learned:
    """What rides that ask for `value` taught; without some of them it was `fold`."""
    after = replace(mixed, mean=at(mixed, name, value), prior=mixed.prior / 4)
    lines = [ride(mixed, channel, name, value) for _ in range(RIDES)]
    folds = [(replace(after, mean=at(mixed, name, fold)), [k, k + 1]) for k in range(0, RIDES, 2)]
    return Learned(mixed, after, lines, folds, mixed.scatter)


def test_a_radius_far_from_the_files_is_refused_with_the_channel_that_asks_for_it(mixed: MixedModel):
    radius = mixed.values["wheel_radius"]
    check_against_file(learned(mixed, "altitude", "wheel_radius", radius - 0.001, radius))
    with pytest.raises(InputError, match=r"wheel_radius is 0.2438 ± 0.0005 m \(measured\) by the file and 0.2") as said:
        check_against_file(learned(mixed, "altitude", "wheel_radius", radius - 0.03, radius))
    assert "altitude (accel_x, gps_altitude) pulls it there, without which it is 0.2438" in str(said.value)
    assert "Nothing is written" in str(said.value)


def test_a_payload_is_compared_with_the_entered_one_if_there_is_one(mixed: MixedModel):
    usual = mixed.vehicle.parameters.known["payload_mass"]
    rides = learned(mixed, "road_force", "payload_mass", usual.value - 70.0, usual.value)
    for entered, sd, origin in ((None, usual.sd, "(guess) by the file"), (usual.value + 5.0, 2.0, "as entered")):
        for line in rides.lines:
            line.ride.payload = entered
        with pytest.raises(InputError) as said:
            check_against_file(rides)
        row = re.search(r"is ([\d.]+) ± [\d.]+ kg (.*) and (-?[\d.]+) ± [\d.]+ kg by .*, (\d+) st", str(said.value))
        assert row is not None and row[2] == origin
        before = usual.value if entered is None else entered
        assert [float(row[1]), float(row[3])] == pytest.approx([before, before - 70.0])
        assert float(row[4]) == pytest.approx(70 / sd, abs=1.0)
    check_against_file(learned(mixed, "road_force", "payload_mass", usual.value - 1.5 * usual.sd, usual.value))


def test_a_guess_that_rides_say_nothing_of_stays_one(mixed: MixedModel):
    known = mixed.vehicle.parameters.known["payload_mass"]
    assert adopted(mixed.vehicle, mixed, mixed).parameters.known["payload_mass"] == known
    surer = adopted(mixed.vehicle, replace(mixed, prior=mixed.prior / 4), mixed)
    assert (known.status, surer.parameters.known["payload_mass"].status) == ("guess", "measured")


def test_a_baseline_that_predicts_rides_worse_than_the_file_is_refused(mixed: MixedModel):
    rolling = mixed.values["rolling_resistance_constant"]
    better = learned(mixed, "road_force", "rolling_resistance_constant", 1.05 * rolling, 1.05 * rolling)
    assert "missed by the file before, 0.00 by the baseline of the others (6 rides)" in check_held_out(better)
    assert "not checked on rides held out: 3 rides" in check_held_out(replace(better, lines=better.lines[:3]))
    worse = learned(mixed, "road_force", "rolling_resistance_constant", 1.05 * rolling, 1.4 * rolling)
    uneven = [(replace(m, mean=m.mean * (1 + 0.1 * k)), held) for k, (m, held) in enumerate(worse.folds)]
    with pytest.raises(InputError, match=r"Wh/km missed by the file before, .*worse. Nothing is written"):
        check_held_out(replace(worse, folds=uneven))


def test_a_ride_whose_sensor_lies_is_named(mixed: MixedModel):
    name = "rolling_resistance_constant"
    alike = learned(mixed, "road_force", name, mixed.values[name], mixed.values[name])
    assert rides_apart(alike) == []
    odd = ride(mixed, "road_force", name, 3 * mixed.values[name], "ride_7")
    (said,) = rides_apart(replace(alike, lines=[*alike.lines[1:], odd]))
    assert said.startswith(f"ride_7 is an outlier: {name} is ")


# --- files ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def taught(mixed: MixedModel) -> MixedModel:
    n, rng = len(mixed.names), np.random.default_rng(4)
    return replace(
        mixed,
        mean=rng.normal(size=n) * 0.1,
        prior=np.diag(rng.uniform(0.5, 1, n)),
        scatter=rng.uniform(0.5, 1, n),
        healthy=7,
        inflation={"headwind": 1.4},
        shapes={"road_force over speed": HealthyCurve(rng.normal(size=8), np.eye(8), 1.3)},
    )


@pytest.fixture
def base(taught: MixedModel, tmp_path: Path) -> Path:
    write_baseline(adopted(taught.vehicle, taught, taught), REFERENCE, tmp_path / "base.toml")
    return tmp_path / "base.toml"


def test_a_baseline_is_read_as_it_was_written(taught: MixedModel, base: Path):
    again = read_vehicle(str(base))
    assert again.healthy == base.with_suffix(".healthy.npz")
    for name, value in adopted(taught.vehicle, taught, taught).parameters.known.items():
        if not value.source.startswith("prior:"):  # it follows those that are in the file
            assert again.parameters[name] == pytest.approx(value.value, rel=1e-5)
    restored = restore(again)
    for field in ("names", "healthy", "noise", "inflation"):
        assert getattr(restored, field) == getattr(taught, field)
    for field in ("mean", "prior", "scatter", "scale"):
        assert getattr(restored, field) == pytest.approx(getattr(taught, field))
    assert {n: restored.values[n] for n in taught.names} == {n: taught.values[n] for n in taught.names}
    pair, before = (m.shapes["road_force over speed"] for m in (restored, taught))
    assert (pair.mean.tolist(), pair.inflation) == (before.mean.tolist(), 1.3)


def test_a_second_baseline_replaces_the_first(taught: MixedModel, base: Path, tmp_path: Path):
    again, second = read_vehicle(str(base)), tmp_path / "two.toml"
    write_baseline(adopted(again, replace(taught, vehicle=again, healthy=9), taught), base, second)
    assert tomllib.loads(second.read_text())["healthy"] == {"file": "two.healthy.npz", "rides": 9}
    assert [line for line in second.read_text().splitlines() if "Made by" in line] == [
        "# Made by: gz-onboard discover --baseline, from base.toml"
    ]


def test_an_extended_model_keeps_the_baseline_about_what_was_found(taught: MixedModel, base: Path, tmp_path: Path):
    """Also elsewhere: in a folder without the baseline's files."""
    out = tmp_path / "there" / "new.toml"
    out.parent.mkdir()
    growth = cause("resistance_growth", "cell_resistance_factor", 1.4, 0.2, 0.4)
    write_model(discovered(taught, [], cornering(), growth), read_vehicle(str(base)), out)
    before, after = restore(read_vehicle(str(base))), restore(read_vehicle(str(out)))
    assert after.healthy == 7 and after.inflation == before.inflation and after.noise == before.noise
    assert after.scatter == pytest.approx(before.scatter)
    now, sd = after.values_at(after.mean), np.sqrt(np.diag(after.prior)) * after.scale
    for found in (cornering(), growth):
        name, wide = found.parameter, (found.ci95[1] - found.ci95[0]) / 2 / taught.quantile
        (i,) = after.index([name])
        assert now[name] == pytest.approx(found.value) == pytest.approx(after.healthy_value(name))
        assert sd[i] * (found.value if name in LOG_SCALED else 1.0) == pytest.approx(wide)
        assert np.count_nonzero(after.prior[i]) == 1
    kept = [n for n in before.names if n not in ("cornering_compliance", "cell_resistance_factor")]
    assert after.mean[after.index(kept)] == pytest.approx(before.mean[before.index(kept)])


def test_statistics_that_cannot_be_read_are_refused(mixed: MixedModel, base: Path):
    beside = base.with_suffix(".healthy.npz")
    with pytest.raises(InputError, match="another model"):
        load(replace(mixed, names=mixed.names[:-3]), beside)
    whole = beside.read_bytes()
    for damaged in (b"", b"no zip", whole[: len(whole) // 2], whole[:200] + bytes(50) + whole[250:]):
        beside.write_bytes(damaged)
        with pytest.raises(InputError, match="cannot be read"):
            restore(read_vehicle(str(base)))
    beside.unlink()
    with pytest.raises(InputError, match="no file"):
        read_vehicle(str(base))
