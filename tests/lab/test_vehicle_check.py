"""A log against a vehicle file: a planted mistake is named, and where there is none nothing is suspected."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gz_onboard import cli
from gz_onboard.arrays import Array
from gz_onboard.errors import FAILED, OK
from gz_onboard.estimator.plausibility.motion import GROUND
from gz_onboard.recording.recording import Recording, read_recording
from gz_onboard.vehicle import read_vehicle
from gz_onboard.vehicle_check.charge import check_charge
from gz_onboard.vehicle_check.check import check_log, check_text, checks_of
from gz_onboard.vehicle_check.electric import (
    BY_POWER,
    PackRide,
    check_road,
    check_sag,
    check_voltages,
    drawn,
    model_power,
    unless_contradicted,
)
from gz_onboard.vehicle_check.finding import Finding, Looks
from gz_onboard.vehicle_check.motion import check_distances, speeds_of
from gz_onboard.vehicle_check.on_board import on_board
from gz_onboard.vehicle_check.rolling import rolling_of
from gz_onboard.vehicle_check.seconds import Seconds, seconds_of, too_little, unit_of
from tests.plant.logs import write_log
from tests.plant.machine import scooter
from tests.plant.ride import Hidden, ride
from tests.plant.roads import plan
from tests.plant.sensors import measure
from tests.support import LOGS, ROOT
from tests.vehicles.test_scooter_to_van import BUILDS, Truth, drive, write

REFERENCE = (ROOT / "gz_onboard/vehicles/reference.toml").read_text(encoding="utf-8")
RECORDED = ["coastdown.blf", "city_14C.blf", "turning/oval_2C.blf", "calibration/dyno_02.blf"]
MISTAKES = [
    ("pack_current", "scale = -1", "its sign"),
    ("pack_current", "scale = 10", "scale"),
    ("motor_speed", 'unit = "rad/s"', "rpm taken for rad/s"),
    ("motor_speed", "scale = -1", "negative"),
    ("gps_speed", "scale = 3.6", "km/h taken for m/s"),
    ("odometer", "scale = 0.621", "odometer"),
    ("accel_x", "scale = -1", "its sign"),
    ("accel_z", "scale = -1", "its sign"),
    ("rate_z", 'unit = "rad/s"', "deg/s taken for rad/s"),
    ("cell_temperature", "scale = 1.8, offset = 32", "°F taken for °C"),
    ("cell_temperature", "offset = 273.15", "K taken for °C"),
    ("pack_voltage", "scale = 1.2", "off the pack's"),
    ("inverter_current", "scale = -1", "the sign of one"),
    ("throttle", 'unit = "1"', "may be %"),
    ("charge_plug", "scale = -1, offset = 1", "the other way round"),
    ("charge_plug", "offset = 3", "it goes to 3, and 1 is on; limits of [0|1] in the DBC file"),
    ("pack_voltage", "scale = 0.6", "V a cell of 14 in series, which have"),
    ("brake_switch", "scale = -1, offset = 1", "the other way round"),
    ("bms_state_of_charge", 'unit = "1"', "dropped"),
]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five minutes of the tests' own scooter in town, nothing wrong with it."""
    way = replace(plan(40, "city", "B", 15.0, 0.7), duration=300.0)
    file: Path = tmp_path_factory.mktemp("plant") / "ride.blf"
    write_log(measure(ride([way], [scooter(3)], [Hidden()])[0], "ride"), file)
    return file


def suspicions(log: Path, text: str, folder: Path) -> list[tuple[tuple[str, ...], str]]:
    (folder / "v.toml").write_text(text, encoding="utf-8")
    checked = check_log(log, read_vehicle(folder / "v.toml"), quick=True)
    return [(finding.roles, finding.text) for finding in checked.those(Looks.WRONG)]


@pytest.mark.parametrize(("role", "options", "said"), MISTAKES, ids=lambda value: str(value)[:24])
def test_a_planted_mistake_is_named(log, tmp_path, role, options, said):
    wrong, count = re.subn(rf'^{role} = ("\w+")', rf"{role} = {{ signal = \1, {options} }}", REFERENCE, flags=re.M)
    assert count == 1
    assert any(role in roles and said in text for roles, text in suspicions(log, wrong, tmp_path))


@pytest.mark.parametrize(("one", "other"), [("accel_x", "accel_y"), ("accel_x", "accel_z"), ("latitude", "longitude")])
def test_swapped_signals_are_named(log, tmp_path, one, other):
    found = {role: re.findall(rf'^{role} = "(\w+)"', REFERENCE, re.M)[0] for role in (one, other)}
    text = REFERENCE.replace(f'{one} = "{found[one]}"', f'{one} = "{found[other]}"')
    text = text.replace(f'{other} = "{found[other]}"', f'{other} = "{found[one]}"')
    assert any(roles == (one, other) or "swapped" in said for roles, said in suspicions(log, text, tmp_path))


@pytest.mark.parametrize("role", ["cell_temperature", "ambient_temperature"])
def test_a_temperature_swapped_with_the_motors_is_named(log, tmp_path, role):
    found = {name: re.findall(rf'^{name} = "(\w+)"', REFERENCE, re.M)[0] for name in (role, "motor_temperature")}
    text = REFERENCE.replace(found[role], "SWAP").replace(found["motor_temperature"], found[role])
    text = text.replace("SWAP", found["motor_temperature"])
    assert (role, "motor_temperature") in dict(suspicions(log, text, tmp_path))


def test_one_cell_fewer_is_named(log, tmp_path):
    text = re.sub(r"cells_series = \d+", "cells_series = 13", REFERENCE)
    assert any("14 cells in series would fit, not 13" in said for _, said in suspicions(log, text, tmp_path))


@pytest.mark.parametrize("cells", ["cells_series = 20", "cells_parallel = 4"])
def test_a_wrong_number_of_cells_is_suspected(log, tmp_path, cells):
    text = re.sub(rf"{cells.split()[0]} = \d+", cells, REFERENCE)
    assert any("bms_state_of_charge" in roles for roles, _ in suspicions(log, text, tmp_path))


@pytest.mark.parametrize("name", RECORDED)
def test_nothing_is_suspected_on_recorded_rides(name):
    assert check_log(LOGS / name, read_vehicle("reference"), quick=True).those(Looks.WRONG) == []


@pytest.mark.parametrize(
    ("role", "ratio", "said"),
    [
        ("motor_speed", 1 / 6, "rpm taken for deg/s"),
        ("motor_speed", 0.166, "rpm taken for deg/s"),
        ("motor_speed", 0.159, "rev/s taken for rad/s"),
        ("motor_speed", 1 / 60, "rev/s taken for rpm"),
        ("motor_speed", 9.55, "rpm taken for rad/s"),
        ("rate_z", 58.5, "deg/s taken for rad/s"),
        ("pack_current", 1e-3, "A taken for mA"),
        ("pack_current", 1e3, "mA taken for A"),
        ("odometer", 0.622, "mi taken for km"),
        ("gps_speed", 3.6, "km/h taken for m/s"),
        ("gps_speed", 1.25, ""),
    ],
)
def test_the_nearest_units_are_named(role, ratio, said):
    assert unit_of(role, ratio) == (f": that is {said}" if said else "")


def test_on_a_bench_the_axle_that_stands_is_not_stuck(rides):
    vehicle = read_vehicle("reference")
    ground = {role: (t, v * 0.0) for role, (t, v) in rides[0].columns.items() if role in GROUND}
    for standing, stuck in (ground, []), ({"wheel_speed_front": ground["wheel_speed_front"]}, ["wheel_speed_front"]):
        ride_ = seconds_of(Recording("x", {**rides[0].columns, **standing}), vehicle)
        found = list(checks_of(ride_, vehicle, None))
        assert [one.roles[0] for one in found if one.check == "stuck"] == stuck
        assert any("a roller bench" in one.text for one in found) is not bool(stuck)


@pytest.mark.parametrize("factor", [-1.0, 1 / 6])
def test_a_speed_that_is_off_accuses_nothing_else(rides, factor):
    vehicle = read_vehicle("reference")
    for ride_ in rides:
        times, values = ride_.columns["motor_speed"]
        columns = {**ride_.columns, "motor_speed": (times, values * factor)}
        found = checks_of(seconds_of(Recording("x", columns), vehicle), vehicle, None)
        accused = [one for one in found if one.looks is Looks.WRONG]
        assert all("motor_speed" in one.roles for one in accused)
        assert len(accused) == 1 or factor > 0  # of another factor than 1 all other speeds have something to say


@pytest.mark.parametrize("seconds", [0.05, 1, 2, 2.5, 3, 4])
def test_a_log_of_moments_cannot_tell(tmp_path, seconds):
    cut = ["export", str(LOGS / "coastdown.blf"), str(tmp_path / "cut.blf"), "--from", "20", "--to", str(20 + seconds)]
    assert cli.main(cut) == OK
    checked = check_log(tmp_path / "cut.blf", read_vehicle("reference"))
    assert checked.those(Looks.WRONG) == []
    assert "most checks need" in check_text(checked)


def test_it_says_what_is_right_and_what_it_cannot_tell(log, capsys):
    assert cli.main(["vehicle", "check", "reference", str(log), "--quiet"]) == OK
    out = capsys.readouterr().out
    assert out.splitlines()[0].endswith("looks right")
    assert "\ncannot tell:\n" in out
    assert "the battery's tables are about right" in out  # by the daemon's own pipeline
    assert "riders told apart        no: lacks rider" in out


def test_the_status_and_the_json_say_what_is_wrong(log, tmp_path, capsys):
    text = REFERENCE.replace(
        'pack_current = "BMS_PackCurrent"', 'pack_current = { signal = "BMS_PackCurrent", scale = -1 }'
    )
    (tmp_path / "v.toml").write_text(text, encoding="utf-8")
    assert cli.main(["vehicle", "check", str(tmp_path / "v.toml"), str(log), "--json", "-", "--quick"]) == FAILED
    document = json.loads(capsys.readouterr().out)
    looks = {role["role"]: role["looks"] for role in document["rides"][0]["roles"]}
    assert (looks["pack_current"], looks["odometer"]) == ("looks wrong", "looks right")
    assert document["failed"] == []


def test_a_pack_that_never_came_looks_wrong_and_the_identifier_that_came_is_named(log, tmp_path, capsys):
    dbc = (ROOT / "dbc" / "vehicle.dbc").read_text(encoding="utf-8").replace("BO_ 512 BMS_Pack", "BO_ 527 BMS_Pack")
    (tmp_path / "mine.dbc").write_text(dbc, encoding="utf-8")
    text = re.sub(r"^inverter_voltage = .*\n", "", REFERENCE.replace('"vehicle.dbc"', '"mine.dbc"'), flags=re.M)
    (tmp_path / "v.toml").write_text(text, encoding="utf-8")
    assert cli.main(["vehicle", "check", str(tmp_path / "v.toml"), str(log), "--quick"]) == FAILED
    said = capsys.readouterr().out
    assert re.search(
        r"never came \(pack_voltage\): pack voltage never came: no range; BMS_Pack is 0x20f in the DBC file, "
        r"and 0x200, which no file knows, has 8 bytes too and came \d+ times",
        said,
    )


def test_a_log_that_shows_nothing_right_does_not_look_right(tmp_path, capsys):
    assert cli.main(["export", str(LOGS / "coastdown.blf"), str(tmp_path / "cut.blf"), "--to", "1"]) == OK
    assert cli.main(["vehicle", "check", "reference", str(tmp_path / "cut.blf"), "--quick"]) == OK
    assert "cut.blf (0 min 01 s): cannot tell\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("off", "when", "looks"),
    [(0.0, 1, Looks.RIGHT), (0.17, 1, Looks.UNKNOWN), (0.25, 1, Looks.WRONG), (0.25, -1, Looks.UNKNOWN)],
)
def test_a_gauge_and_a_voltage_apart_by_more_than_both_are_known_do_not_look_right(rides, tmp_path, off, when, looks):
    ride_ = rides[0]
    times, shown = ride_.columns["bms_state_of_charge"]
    late = when * (times - times.mean()) > 0
    columns = {**ride_.columns, "bms_state_of_charge": (times, shown - off * late)}
    said = said_of_the_pack(replace(ride_, columns=columns), tmp_path, r"^name = .*", 'name = "mine"')
    finding = said["state of charge against the voltage"]
    assert finding.looks is looks, finding.text
    assert (
        off == 0
        or finding.text.endswith(f"at the {'end' if when > 0 else 'start'}")
        or "battery.window" in finding.text
    )


def test_a_vehicle_that_moves_is_not_said_to_stand():
    assert "too seldom there together" in too_little(np.full(60, 34.4), "speeds")
    assert too_little(np.array([34.4] * 20 + [np.nan] * 40), "speeds") == (
        "the vehicle moves for 20 s in this log, and 30 s are needed"
    )


def test_without_a_log_it_says_what_the_roles_are_enough_for(capsys):
    assert cli.main(["vehicle", "check", str(ROOT / "tests/vehicles/i3/i3.toml")]) == OK
    out = capsys.readouterr().out
    assert re.search(r"^  range +yes", out, re.M)
    assert re.search(r"^  wind by heading +no: lacks GPS course", out, re.M)


@pytest.mark.parametrize("name", ["kick-scooter", "van"])
def test_other_vehicles_with_and_without_a_mistake(tmp_path, name):
    file = write(tmp_path, BUILDS[name])
    right, database, log = (
        file.read_text(encoding="utf-8"),
        read_vehicle(str(file)).mapping.database,
        tmp_path / "r.log",
    )
    driven = [frame for frames in drive(BUILDS[name], database, Truth(0.8), 300.0) for frame in frames]
    lines = [f"({1.7e9 + ns / 1e9:.6f}) can0 {identifier:03X}#{data.hex()}\n" for ns, identifier, data, _ in driven]
    log.write_text("".join(lines), encoding="utf-8")
    assert suspicions(log, right, tmp_path) == []
    for role, was, now in (
        ("pack_current", '"Current"', '{ signal = "Current", scale = -1 }'),
        ("vehicle_speed", '"Speed"', '{ signal = "Speed", unit = "m/s" }'),
        ("cell_temperature", '"Cells"', '{ signal = "Cells", scale = 1.8, offset = 32 }'),
    ):
        assert any(role in roles for roles, _ in suspicions(log, right.replace(was, now), tmp_path))


# --- positions ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rides() -> list[Recording]:
    return [read_recording(LOGS / name, read_vehicle("reference")) for name in ("city_34C.blf", "turning/oval_2C.blf")]


def elsewhere(ride: Recording, latitude: float, longitude: float) -> dict[str, tuple[Array, Array]]:
    """The columns of `ride` as if it had been ridden at another place [deg], as long to the north and the east."""
    north, east = ride.columns["latitude"], ride.columns["longitude"]
    wider = np.cos(np.radians(north[1].mean())) / np.cos(np.radians(latitude))
    return {
        **ride.columns,
        "latitude": (north[0], latitude + north[1] - north[1].mean()),
        "longitude": (east[0], longitude + (east[1] - east[1].mean()) * wider),
    }


def said_of_positions(columns: dict[str, tuple[Array, Array]], scale: float) -> list[Finding]:
    """By what checks say of them where the speed is off by a factor; nothing but speed and positions is there."""
    vehicle = read_vehicle("reference")
    kept = {role: columns[role] for role in ("motor_speed", "latitude", "longitude")}
    kept["motor_speed"] = kept["motor_speed"][0], kept["motor_speed"][1] * scale
    ride = seconds_of(Recording("x", kept), vehicle)
    found = check_distances(ride, speeds_of(ride, vehicle), frozenset())
    return [one for one in found if {"latitude", "longitude"} <= set(one.roles)]


PLACES = [(40.3, -83.5), (48.0, 11.0), (35.7, 139.7), (-33.9, 151.2), (0.2, 36.8)]


@pytest.mark.parametrize("place", PLACES, ids=str)
@pytest.mark.parametrize("scale", [0.92, 1.08])
def test_swapped_positions_are_named_wherever_the_ride_was(rides, place, scale):
    for recorded in rides:
        there = elsewhere(recorded, *place)
        (said,) = said_of_positions(there, scale)
        assert said.looks is Looks.RIGHT, said
        swapped = {**there, "latitude": there["longitude"], "longitude": there["latitude"]}
        (said,) = said_of_positions(swapped, scale)
        if recorded is rides[0] or place == PLACES[0]:  # on an oval all ways are alike, and near the equator lengths
            assert said.looks is Looks.WRONG
            assert "swapped" in said.text


def test_a_latitude_beyond_the_poles_needs_no_ride(rides):
    there = elsewhere(rides[0], 35.7, 139.7)
    standing = {role: (times, values * 0 + values[0]) for role, (times, values) in there.items()}
    swapped = {**standing, "latitude": standing["longitude"], "longitude": standing["latitude"]}
    (said,) = said_of_positions(swapped, 0.0)
    assert "reaches 139.7°, beyond the poles: swapped with the longitude" in said.text
    wild = {**standing, "latitude": standing["longitude"]}
    assert "beyond the poles: a wrong scale" in said_of_positions(wild, 0.0)[0].text


# --- wheel radius and gear ratio ----------------------------------------------------------------------------------


def by_another(ride: Recording, folder: Path, times: dict[str, float], **scales: float) -> list[Finding]:
    """What is said of radius and gear ratio where the file has those parameters `times` theirs, and sensors `scales`.

    A sensor of scale 0 is not there.
    """
    text = REFERENCE
    for name, factor in times.items():
        was = read_vehicle("reference").parameters[name]
        text, count = re.subn(rf"^{name} = {{ value = [\d.]+", f"{name} = {{ value = {was * factor}", text, flags=re.M)
        assert count == 1
    (folder / "v.toml").write_text(text, encoding="utf-8")
    vehicle = read_vehicle(folder / "v.toml")
    kept = {role: (t, v * scales.get(role, 1.0)) for role, (t, v) in ride.columns.items() if scales.get(role, 1.0)}
    seconds = seconds_of(Recording("x", kept), vehicle)
    return rolling_of(seconds, speeds_of(seconds, vehicle), vehicle).findings


UNSEEN = {"latitude": 0.0, "longitude": 0.0, "odometer": 0.0}


@pytest.mark.parametrize("times", [0.95, 1.05, 1.2, 2.0])
def test_a_wrong_radius_is_told_of_the_file_and_of_no_sensor(rides, tmp_path, times):
    (said,) = by_another(rides[0], tmp_path, {"wheel_radius": times})
    assert said.roles == ()
    assert f"wheel_speed_rear is {times:.3g} times gps_speed; 0.243" in said.text.replace("0.951", "0.95")
    assert "m would fit, by positions and odometer too" in said.text


def test_what_cannot_be_told_apart_is_not(rides, tmp_path):
    (said,) = by_another(rides[1], tmp_path, {"wheel_radius": 1.1})  # no wheel speed beside the motor's
    assert said.roles == ("motor_speed",)
    assert "wheel_radius times gear_ratio 0.2681 m" in said.text
    assert "or the scale of motor_speed is wrong" in said.text
    (said,) = by_another(rides[0], tmp_path, {"gear_ratio": 0.25})
    assert "gear_ratio 0.25 motor_speed is 0.25 times wheel_speed_rear; 1 would fit, or" in said.text
    (said,) = by_another(rides[0], tmp_path, {"wheel_radius": 0.9}, **UNSEEN)
    assert said.roles == ("wheel_speed_rear", "gps_speed")
    assert "or the scale of gps_speed is wrong: nothing else has seen the way" in said.text


@pytest.mark.parametrize(("times", "looks"), [(1.0, Looks.RIGHT), (1.03, Looks.RIGHT), (1.1, Looks.UNKNOWN)])
def test_a_radius_that_only_the_odometer_doubts_cannot_be_told(rides, times, looks):
    vehicle = read_vehicle("reference")
    radius = vehicle.parameters["wheel_radius"]
    seen = {role: values for role, values in rides[0].columns.items() if not role.startswith(("gps", "lat", "long"))}
    ride_ = seconds_of(Recording("x", seen), vehicle)
    speeds = {role: speed * times for role, speed in speeds_of(ride_, vehicle).items()}
    (said,) = check_distances(ride_, speeds, frozenset(), radius * times)
    assert said.looks is looks, said
    assert looks is Looks.RIGHT or f"would fit in place of {radius * times:.4g} m; or gear_ratio" in said.text
    fits = re.findall(r"wheel_radius ([\d.]+) m would fit", said.text)
    assert [float(fit) for fit in fits] == [pytest.approx(radius, rel=0.03)] * len(fits)


def test_a_gps_that_the_positions_contradict_is_named(rides, tmp_path):
    (said,) = by_another(rides[0], tmp_path, {}, gps_speed=1.1)
    assert said.roles == ("gps_speed",)
    assert "the positions agree with wheel_speed_rear" in said.text
    for recorded in rides:
        assert by_another(recorded, tmp_path, {}) == by_another(recorded, tmp_path, {"wheel_radius": 1.02}) == []


def test_with_a_radius_that_fits_the_rest_of_the_check_is_as_it_was(log, tmp_path):
    wrong = re.sub(r"^wheel_radius = { value = [\d.]+", "wheel_radius = { value = 0.3", REFERENCE, flags=re.M)
    ((roles, said),) = suspicions(log, wrong, tmp_path)
    assert roles == ()
    assert "0.3 m" in said
    checked = check_log(log, read_vehicle(tmp_path / "v.toml"), quick=True)
    assert check_text(checked).splitlines()[0].endswith("one thing looks wrong")
    assert "by wheel radius and gear ratio as the log has them" in check_text(checked)


# --- the pack -----------------------------------------------------------------------------------------------------


def said_of_the_pack(ride: Recording, folder: Path, was: str, now: str) -> dict[str, Finding]:
    """The last finding of each check of voltage, current and charge, with one line of the file changed."""
    text = re.sub(was, now, REFERENCE, flags=re.M)
    assert text != REFERENCE
    (folder / "v.toml").write_text(text, encoding="utf-8")
    vehicle = read_vehicle(folder / "v.toml")
    seconds = seconds_of(ride, vehicle)
    of, speed = drawn(seconds, vehicle), speeds_of(seconds, vehicle)["motor_speed"]
    assert of is not None
    assert vehicle.battery is not None
    found = [*check_voltages(seconds, vehicle.battery, of.current), *check_sag(of), *check_charge(seconds, of, vehicle)]
    found += check_road(seconds, of, speed, model_power(seconds, vehicle, speed, ride.rider_mass))
    return {one.check: one for one in unless_contradicted(found)}


def test_cells_that_give_current_above_their_full_voltage_are_too_few(rides, tmp_path):
    said = said_of_the_pack(rides[1], tmp_path, r"cells_series = \d+", "cells_series = 12")
    assert said["voltage against the cells"].looks is Looks.WRONG
    assert "no more while they give current: 13 to 18 in series would fit" in said["voltage against the cells"].text
    assert said["state of charge against the voltage"].looks is Looks.UNKNOWN  # full by it, as if 12 were right


def test_a_number_of_cells_is_not_said_right_by_one_check_and_wrong_by_another(rides, tmp_path):
    said = said_of_the_pack(rides[0], tmp_path, r"cells_series = \d+", "cells_series = 15")
    assert "14 cells in series would fit, not 15" in said["state of charge against the voltage"].text
    assert said["voltage against the cells"].looks is Looks.UNKNOWN
    for ride_ in rides:
        said = said_of_the_pack(ride_, tmp_path, r"cells_parallel = \d+", "cells_parallel = 24")
        assert (
            "A·h would fit: the cell's capacity, cells in parallel" in said["state of charge against the charge"].text
        )
        assert said["current against the voltage's drop"].looks is Looks.UNKNOWN
        assert said["state of charge against the voltage"].looks is Looks.RIGHT  # by seconds of little load


@pytest.mark.parametrize(
    ("parallel", "fell", "looks", "said"),
    [
        (12, 0.95, Looks.RIGHT, "it falls by 95.0%"),
        (10, 0.95, Looks.WRONG, "; 32.8 A·h would fit: the cell's capacity"),
        (16, 0.95, Looks.UNKNOWN, "; 32.8 A·h would fit: aged cells, their capacity"),
        (24, 0.95, Looks.WRONG, "; 32.8 A·h would fit: the cell's capacity"),
        (10, 0.1, Looks.RIGHT, "it falls by 10.0%"),  # which a gauge cannot tell
    ],
)
def test_more_charge_than_the_cells_have_looks_wrong_and_less_may_be_of_age(tmp_path, parallel, fell, looks, said):
    (tmp_path / "v.toml").write_text(REFERENCE.replace("cells_parallel = 12", f"cells_parallel = {parallel}"))
    vehicle, seconds = read_vehicle(tmp_path / "v.toml"), np.arange(3601.0)
    right = read_vehicle("reference").battery
    assert right is not None
    current = np.full(len(seconds), right.pack_capacity(25.0) * fell)
    shown = 0.98 - fell * seconds / seconds[-1]
    ride_ = Seconds(seconds, {"pack_voltage": seconds * 0 + 50, "pack_current": current, "bms_state_of_charge": shown})
    (found,) = [one for one in check_charge(ride_, drawn(ride_, vehicle), vehicle) if "the charge" in one.check]
    assert (found.looks, said in found.text) == (looks, True), found.text


@pytest.mark.parametrize(
    ("role", "scale", "offset"),
    [("pack_current", 0.001, 0.0), ("bms_state_of_charge", -1.0, 1.0), ("pack_voltage", 1.05, 0.0)],
)
def test_no_number_of_cells_fits_a_sensor_that_is_off(rides, role, scale, offset):
    vehicle = read_vehicle("reference")
    for ride_ in rides:
        times, values = ride_.columns[role]
        columns = {**ride_.columns, role: (times, values * scale + offset)}
        found = unless_contradicted(checks_of(seconds_of(Recording("x", columns), vehicle), vehicle, None))
        assert any(one.looks is Looks.WRONG and role in one.roles for one in found)
        assert [one.text for one in found if "in series would fit" in one.text] == []


def test_a_load_that_is_far_from_the_models_does_not_look_right(rides, tmp_path):
    area = read_vehicle("reference").parameters["drag_area"]
    for ride_ in rides:
        was, now = r"^drag_area = { value = [\d.]+", "drag_area = { value = {}"
        assert said_of_the_pack(ride_, tmp_path, was, now.replace("{}", str(3 * area)))[BY_POWER].looks is Looks.UNKNOWN
        assert (
            said_of_the_pack(ride_, tmp_path, was, now.replace("{}", str(area * 1.01)))[BY_POWER].looks is Looks.RIGHT
        )


def test_what_the_daemon_cannot_predict_is_told_of_the_pack(tmp_path):
    for cells, looks in (13, Looks.WRONG), (14, Looks.RIGHT):
        text = re.sub(r"cells_series = \d+", f"cells_series = {cells}", REFERENCE)
        (tmp_path / "v.toml").write_text(text, encoding="utf-8")
        (said,) = on_board(LOGS / "coastdown.blf", read_vehicle(tmp_path / "v.toml"))
        assert (said.looks, said.roles) == (looks, ("pack_voltage",))


@pytest.mark.parametrize(
    ("ocv_sd", "temperature", "looks", "said"),
    [
        (0.004, 15.0, Looks.WRONG, ": the cells' number or capacity, or the tables"),
        (0.5, 15.0, Looks.UNKNOWN, ": the tables at 15 °C, which the file knows to 500 mV under this load"),
        (0.004, -30.0, Looks.UNKNOWN, ": the tables at -30 °C, as the file's begin at -10 °C"),
    ],
)
def test_a_file_that_knows_its_cells_roughly_cannot_tell(tmp_path, ocv_sd, temperature, looks, said):
    (tmp_path / "v.toml").write_text(re.sub(r"cells_series = \d+", "cells_series = 13", REFERENCE), encoding="utf-8")
    vehicle = read_vehicle(tmp_path / "v.toml")
    assert vehicle.battery is not None
    of = PackRide(np.full(60, 50.0), np.full(60, 5.0), replace(vehicle.battery, ocv_sd=ocv_sd), temperature)
    (found,) = on_board(LOGS / "coastdown.blf", vehicle, of=of)
    assert (found.looks, said in found.text) == (looks, True), found.text
