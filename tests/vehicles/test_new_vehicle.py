"""`vehicle new`: the file that it writes reads, is commented key by key, and gives a range that holds."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from cantools.database.can import Database

from gz_onboard import cli
from gz_onboard.errors import BAD_INPUT, OK, InputError
from gz_onboard.events import ROLES, Frame, Reason, State
from gz_onboard.pipeline import Pipeline
from gz_onboard.vehicle import read_vehicle
from gz_onboard.vehicle_check.new import kinds
from tests.support import LOGS, ROOT
from tests.vehicles.test_scooter_to_van import BUILDS, Cell, Points, Truth, driven, encode

ARGUMENTS = ["--kind", "scooter", "--series", "14", "--capacity", "30", "--mass", "90", "--wheel-radius", "0.22"]
KEY = re.compile(r"^(\w+) = ", re.M)
REFERENCE = (ROOT / "gz_onboard/vehicles/reference.toml").read_text(encoding="utf-8")


M50: Points = ((0, 2.5), (0.02, 2.86), (0.05, 3.11), (0.1, 3.3), (0.2, 3.485), (0.3, 3.581), (0.4, 3.667), (0.6, 3.841))
M50 += ((0.7, 3.948), (0.8, 4.042), (0.9, 4.097), (0.95, 4.124), (1, 4.2))
P42A: Points = ((0, 2.506), (0.045, 3.146), (0.096, 3.323), (0.15, 3.422), (0.29, 3.574), (0.457, 3.702))
P42A += ((0.834, 4.064), (0.95, 4.101), (1, 4.193))
APR: Points = ((0, 2.01), (0.012, 2.74), (0.027, 2.93), (0.053, 3.087), (0.089, 3.194), (0.297, 3.277), (0.983, 3.351))
APR += ((0.995, 3.418), (1, 3.598))
# Cells as they were measured, of 30 A·h; not the mean of several that the written file has.
CELLS = {
    "nmc": Cell(M50, 0.05 / 30, 0.05 / 30, 30.0),
    "nca": Cell(P42A, 0.03 / 30, 0.02 / 30, 30.0),
    "lfp": Cell(APR, 0.025 / 30, 0.02 / 30, 30.0),
}
MOPED = replace(
    BUILDS["moped"], mass=90.0, payload=75.0, drag=0.5, series=14, parallel=1, capacity=30.0, auxiliary=30.0
)


def energy(cell: Cell, soc: float, cutoff: float) -> float:
    """Wh of 1 A·h that come out slowly from `soc` to the `cutoff` [V]."""
    step = soc / 500
    return step * sum(volts for i in range(500) if (volts := cell.rest(step * (i + 0.5))) > cutoff)


def written(folder: Path, chemistry: str, *others: str) -> Path:
    file = folder / f"{chemistry}.toml"
    assert cli.main(["vehicle", "new", str(file), "--cells", chemistry, *ARGUMENTS, *others]) == OK
    return file


def drive(chemistry: str, database: Database, truth: Truth, duration: float) -> Iterator[list[Frame]]:
    """The frames of a drive by the written DBC."""
    for ns, v, volts, current in driven(MOPED, truth, duration, CELLS[chemistry]):
        of = {"PackVoltage": volts, "PackCurrent": current, "CellTemperature": 25.0, "StateOfCharge": 100 * truth.soc}
        motion = {"Speed": 3.6 * v, "Odometer": 1000.0 + truth.distance / 1000, "OutsideTemperature": 20.0}
        frames = ((256, "Battery", of), (257, "Motion", motion))
        yield [(ns + k, key, encode(database, name, **values), 0) for k, (key, name, values) in enumerate(frames)]


@pytest.mark.parametrize(("chemistry", "soc"), [("nmc", 0.3), ("nca", 0.85), ("lfp", 0.85), ("lfp", 0.3)])
def test_it_drives_to_a_range_within_its_interval(tmp_path, chemistry, soc):
    vehicle, truth = read_vehicle(written(tmp_path, chemistry)), Truth(soc)
    pipeline = Pipeline(vehicle)
    for frames in drive(chemistry, vehicle.mapping.database, truth, 80.0):
        pipeline.advance(frames, frames[0][0])
    e = pipeline.last
    assert e is not None and e.soc is not None and e.soc_sd is not None and e.range_p10 and e.range_p90
    assert pipeline.counts().dropped == pipeline.counts().implausible == 0
    assert not e.reasons & (Reason.VOLTAGE_MISMATCH | Reason.CURRENT_MISMATCH | Reason.SENSOR_DISTRUSTED)
    left = energy(CELLS[chemistry], truth.soc, vehicle.pack.cutoff_voltage) * 14 * 30 * 3600
    assert e.range_p10 < left * truth.distance / truth.energy < e.range_p90
    assert abs(e.soc - truth.soc) < 2 * e.soc_sd
    on_the_flat = chemistry == "lfp" and soc > 0.5
    assert bool(e.reasons & Reason.SOC_UNCERTAIN) is on_the_flat
    assert e.state is (State.DEGRADED if on_the_flat else State.VALID)
    assert e.soc_sd > 0.1 if on_the_flat else e.soc_sd < 0.06


def test_its_typical_cells_do_on_a_recorded_ride(tmp_path, capsys):
    log = LOGS / "calibration" / "ride_005.blf"  # at 6 degC: the tables over temperature count
    new = written(tmp_path, "nmc", "--capacity", "36").read_text(encoding="utf-8")
    new = new[new.index("[parameters]") :]
    bus = REFERENCE[: REFERENCE.index("[model]")]  # the scooter's frames, and nothing else of what was measured of it
    (tmp_path / "guessed.toml").write_text(bus + new, encoding="utf-8")
    capsys.readouterr()
    how = ["--no-plot", "--quiet", "--json", "-", "--output", str(tmp_path / "out")]
    assert cli.main(["estimate", "--vehicle", str(tmp_path / "guessed.toml"), *how, str(log)]) == OK
    ride = json.loads(capsys.readouterr().out)["rides"][0]
    assert ride["range_end_p10_km"] < 32.7 < ride["range_end_p90_km"]  # by the measured vehicle file
    assert abs(ride["soc_end"] - 0.746) < 2 * ride["soc_end_sd"]  # likewise


def test_every_key_has_a_comment_and_is_one_that_the_reader_knows(tmp_path):
    file = written(tmp_path, "nmc")
    lines = file.read_text(encoding="utf-8").splitlines()
    keys = [i for i, line in enumerate(lines) if KEY.match(line)]
    assert len(keys) > 40
    for i in keys:
        assert lines[i - 1].startswith("# "), lines[i]
        mistyped = [*lines[:i], KEY.sub(r"\1x = ", lines[i]), *lines[i + 1 :]]
        file.write_text("\n".join(mistyped), encoding="utf-8")
        with pytest.raises(InputError):
            read_vehicle(file)
            pytest.fail(f"nobody reads {lines[i]}")


def test_roles_to_be_uncommented_are_roles(tmp_path):
    offered = re.findall(r'^# (\w+) = "', written(tmp_path, "nca").read_text(encoding="utf-8"), re.M)
    assert len(offered) > 4
    assert set(offered) <= set(ROLES)


@pytest.mark.parametrize("kind", kinds())
def test_each_kind_is_checked_and_sends_range_frames(tmp_path, kind, capsys):
    series, mass = {"car": ("96", "1600"), "van": ("110", "2600")}.get(kind, ("14", "60"))
    of = ["--kind", kind, "--cells", "LFP", "--series", series, "--capacity", "80", "--mass", mass]
    file = tmp_path / "mine" / f"{kind}.toml"
    assert cli.main(["vehicle", "new", str(file), *of, "--wheel-radius", "0.3"]) == OK
    assert cli.main(["vehicle", "check", str(file)]) == OK
    assert re.search(r"^  range +yes", capsys.readouterr().out, re.M)
    assert cli.main(["run", "--vehicle", str(file), "--write-dbc", str(tmp_path / "range.dbc")]) == OK


def test_power_and_top_speed_are_what_is_entered(tmp_path):
    vehicle = read_vehicle(written(tmp_path, "nmc", "--power", "600", "--top-speed", "20"))
    most, p = vehicle.derating.current_by_motor_speed, vehicle.parameters
    torque = p["motor_current_limit"] * p["torque_constant"]
    fastest = 20 / 3.6 / p["wheel_radius"]
    for share in (0.3, 0.5, 0.7, 0.9):
        power = torque * most.at(share * fastest) * share * fastest
        assert power < 1.04 * 600 and (share < 0.4 or power > 0.99 * 600)
    assert most.at(1.04 * fastest) == 0.0


@pytest.mark.parametrize("there", ["nmc.toml", "nmc.dbc"])
def test_it_writes_over_nothing(tmp_path, there, capsys):
    (tmp_path / there).write_text("mine", encoding="utf-8")
    assert cli.main(["vehicle", "new", str(tmp_path / "nmc.toml"), "--cells", "nmc", *ARGUMENTS]) == BAD_INPUT
    assert f"{there}: exists already" in capsys.readouterr().err
    assert [(file.name, file.read_text(encoding="utf-8")) for file in tmp_path.iterdir()] == [(there, "mine")]


@pytest.mark.parametrize(
    ("name", "options", "said"),
    [
        ("a.toml", ["--kind", "scooter"], "the following arguments are required: --cells, --series"),
        ("a.toml", ["--mass", "1"], "must be 5 to 5000 kg"),
        ("a.toml", ["--cells", "lpf"], "did you mean 'lfp'?"),
        ("a.txt", ["--cells", "nmc", *ARGUMENTS], "must end in .toml"),
        ("ä b.toml", ["--cells", "nmc", *ARGUMENTS], "name: must be"),
        ("a.toml", ["--cells", "nmc", *ARGUMENTS, "--series", "300", "--capacity", "1000"], "range_dbc"),
    ],
)
def test_bad_options_are_refused_and_nothing_is_written(tmp_path, name, options, said, capsys):
    status: object
    try:
        status = cli.main(["vehicle", "new", str(tmp_path / name), *options])
    except SystemExit as error:
        status = error.code
    assert status == BAD_INPUT
    assert said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
