"""A ride that the battery cannot give says so, and two ranges of it are explained."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from gz_onboard import cli
from gz_onboard.errors import OK
from gz_onboard.simulation.scooter import Scooter
from gz_onboard.vehicle import read_vehicle

KICK = ["--kind", "kick-scooter", "--cells", "nmc", "--series", "7", "--capacity", "10", "--mass", "14"]
LIMITS = ("[controller.current_by_motor_speed]", "motor_current_limit = ")


@pytest.fixture
def kick(tmp_path: Path) -> Path:
    """A small scooter with limits of its kind."""
    file = tmp_path / "kick.toml"
    assert cli.main(["vehicle", "new", str(file), *KICK, "--wheel-radius", "0.105"]) == OK
    return file


def without_limits(file: Path) -> Path:
    """The same with the motor of another vehicle, by its mass."""
    lines = file.read_text(encoding="utf-8").splitlines()
    begin = lines.index(LIMITS[0])
    kept = [line for line in (*lines[:begin], *lines[lines.index("[forecast]") :]) if not line.startswith(LIMITS[1])]
    free = file.with_name("free.toml")
    free.write_text("\n".join(kept), encoding="utf-8")
    return free


def simulated(capsys, file: Path, *options: str) -> tuple[dict[str, Any], str]:
    """(JSON, text) of two minutes at the wide open throttle of a faster vehicle."""
    cycle, out = file.parent / "fast.csv", file.parent / "fast.json"
    rows = [f"{t},{min(50, 2 * t) if t < 120 else 0}" for t in range(0, 130, 10)]
    cycle.write_text("\n".join(["time_s,speed_kmh", *rows]), encoding="utf-8")
    how = ["--no-plot", "--no-series", "--quiet", "--output", str(file.parent / "out"), "--json", str(out)]
    capsys.readouterr()
    assert cli.main(["simulate", str(cycle), "--vehicle", str(file), *how, *options]) == OK
    return json.loads(out.read_text(encoding="utf-8")), " ".join(capsys.readouterr().out.split())


def test_a_load_that_ends_the_ride_with_charge_left_is_named(kick: Path, capsys):
    found, text = simulated(capsys, without_limits(kick), "--until-empty")
    (beyond,) = found["beyond_battery"]
    assert found["soc_end"] > 0.3 and found["range_by"] == "cut-off" and not beyond["charge"]
    assert beyond["voltage_v"] <= beyond["cutoff_v"] == 21.0 and beyond["current_a"] > 60
    assert found["range_by_energy_km"] > 1.1 * found["range_km"]
    assert f"beyond the battery from {beyond['time_s']:.0f} s, " in text
    assert "A pull the pack to 2" in text and f"its energy would do for {found['range_by_energy_km']:.1f} km" in text


def test_a_ride_without_charge_ends_where_it_had_none(kick: Path, capsys):
    found, text = simulated(capsys, kick, "--soc", "0.03")
    last = found["beyond_battery"][-1]
    assert found["soc_end"] < 0 and last["charge"]
    assert found["range_by"] == "charge" and found["range_km"] == last["distance_km"] < found["distance_km"]
    assert found["range_by_energy_km"] is None and "no charge is left" in text


def test_with_limits_of_its_kind_its_ranges_agree(kick: Path, capsys):
    """And neither power nor speed is beyond them: 800 W at the shaft, 25 km/h."""
    once, text = simulated(capsys, kick)
    assert once["beyond_battery"] == [] and "beyond the battery" not in text
    assert "km/h, once energy" in text
    assert once["speed_max_km_h"] == pytest.approx(25, rel=0.04)
    scooter, most = Scooter(read_vehicle(kick)), 0.0
    for _ in range(1500):
        scooter.step(1.0, 0.0)
        most = max(most, scooter.motor_torque * scooter.wheel_speed)
    assert most == pytest.approx(800, rel=0.05)
