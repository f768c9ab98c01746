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
from gz_onboard.vehicle_check.check import check_log, check_ride, check_text, on_board
from gz_onboard.vehicle_check.finding import Finding, Looks
from gz_onboard.vehicle_check.predictions import PackRide
from gz_onboard.vehicle_check.seconds import seconds_of, unit_of
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
    ("cell_temperature", "offset = 273.15", "its unit may be K"),
    ("pack_voltage", "scale = 1.2", "off the pack's"),
    ("inverter_current", "scale = -1", "the sign of one"),
    ("throttle", 'unit = "1"', "its unit may be %"),
    ("charge_plug", "scale = -1, offset = 1", "the other way round"),
    ("charge_plug", "offset = 3", "it goes to 3, and 1 is on; limits of [0|1] in the DBC file"),
    ("pack_voltage", "scale = 0.6", "V a cell of 14 in series, which have"),
    ("brake_switch", "scale = -1, offset = 1", "the other way round"),
    ("bms_state_of_charge", 'unit = "1"', "dropped"),
]


BY_WAYS, BY_FILE = "ways against each other", "wheel radius and gear ratio"


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five minutes of the tests' own scooter in town, nothing wrong with it."""
    way = replace(plan(40, "city", "B", 15.0, 0.7), duration=300.0)
    file: Path = tmp_path_factory.mktemp("plant") / "ride.blf"
    write_log(measure(ride([way], [scooter(3)], [Hidden()])[0], "ride"), file)
    return file


@pytest.fixture(scope="module")
def rides() -> list[Recording]:
    """In town with all speeds, and on an oval with motor and GPS speed only."""
    return [read_recording(LOGS / name, read_vehicle("reference")) for name in ("city_34C.blf", "turning/oval_2C.blf")]


def suspicions(log: Path, text: str, folder: Path) -> list[tuple[tuple[str, ...], str]]:
    (folder / "v.toml").write_text(text, encoding="utf-8")
    checked = check_log(log, read_vehicle(folder / "v.toml"), quick=True)
    return [(finding.roles, finding.text) for finding in checked.those(Looks.WRONG)]


def checked(ride: Recording, text: str = "", folder: Path = Path(), /, **changes: float) -> list[Finding]:
    """What a ride says where roles are `changes` times theirs (0: not there), by the vehicle file `text`."""
    columns = {role: (t, v * changes.get(role, 1.0)) for role, (t, v) in ride.columns.items() if changes.get(role, 1.0)}
    vehicle = read_vehicle("reference")
    if text:
        (folder / "v.toml").write_text(text, encoding="utf-8")
        vehicle = read_vehicle(folder / "v.toml")
    return check_ride(seconds_of(Recording("x", columns), vehicle), vehicle, ride.rider_mass)[0]


def wrong_of(findings: list[Finding]) -> list[Finding]:
    return [one for one in findings if one.looks is Looks.WRONG]


def changed(name: str, value: str) -> str:
    """The reference file with another value of a parameter, or number of cells."""
    text, count = re.subn(rf"^{name} = (\d+$|{{ value = [\d.]+)", f"{name} = {value}", REFERENCE, flags=re.M)
    assert count == 1
    return text


@pytest.mark.parametrize(("role", "options", "said"), MISTAKES, ids=lambda value: str(value)[:24])
def test_a_planted_mistake_is_named(log, tmp_path, role, options, said):
    wrong, count = re.subn(rf'^{role} = ("\w+")', rf"{role} = {{ signal = \1, {options} }}", REFERENCE, flags=re.M)
    assert count == 1
    assert any(role in roles and said in text for roles, text in suspicions(log, wrong, tmp_path))


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("accel_x", "accel_y"),
        ("accel_x", "accel_z"),
        ("latitude", "longitude"),
        ("cell_temperature", "motor_temperature"),
        ("ambient_temperature", "motor_temperature"),
    ],
)
def test_swapped_signals_are_named(log, tmp_path, one, other):
    found = {role: re.findall(rf'^{role} = "(\w+)"', REFERENCE, re.M)[0] for role in (one, other)}
    text = REFERENCE.replace(found[one], "SWAP").replace(found[other], found[one]).replace("SWAP", found[other])
    assert any(roles == (one, other) or "swapped" in said for roles, said in suspicions(log, text, tmp_path))


@pytest.mark.parametrize("name", RECORDED)
def test_nothing_is_suspected_on_recorded_rides(name):
    assert check_log(LOGS / name, read_vehicle("reference"), quick=True).those(Looks.WRONG) == []


@pytest.mark.parametrize(
    ("role", "ratio", "said"),
    [
        ("motor_speed", 1 / 6, "rpm taken for deg/s"),
        ("motor_speed", 0.159, "rev/s taken for rad/s"),
        ("motor_speed", 1 / 60, "rev/s taken for rpm"),
        ("motor_speed", 9.55, "rpm taken for rad/s"),
        ("pack_current", 1e-3, "A taken for mA"),
        ("odometer", 0.622, "mi taken for km"),
        ("gps_speed", 3.6, "km/h taken for m/s"),
        ("gps_speed", 1.25, ""),
    ],
)
def test_the_nearest_units_are_named(role, ratio, said):
    assert unit_of(role, ratio) == (f": that is {said}" if said else "")


@pytest.mark.parametrize(
    ("role", "factor"),
    [
        ("motor_speed", -1.0),
        ("motor_speed", 1 / 6),
        ("gps_speed", 3.6),
        ("odometer", 0.62),
        ("pack_current", -1.0),
        ("pack_current", 10.0),
    ],
)
def test_a_mistake_is_reported_once_and_accuses_nothing_else(rides, role, factor):
    for recorded in rides:
        (said,) = wrong_of(checked(recorded, **{role: factor}))
        assert said.roles == (role,)


def test_a_current_without_its_sign_is_named():
    recorded = read_recording(LOGS / "calibration/ride_000.blf", read_vehicle("reference"))
    times, current = recorded.columns["pack_current"]
    (said,) = wrong_of(checked(replace(recorded, columns={**recorded.columns, "pack_current": (times, abs(current))})))
    assert (said.check, said.roles) == ("current while braking", ("pack_current",))


def test_on_a_bench_the_axle_that_stands_is_not_stuck(rides):
    standing = dict.fromkeys(GROUND, 1e-12)
    findings = checked(rides[0], **standing)
    assert any("a roller bench" in one.text for one in findings)
    assert not [one for one in findings if one.check == "stuck"]


@pytest.mark.parametrize(
    ("name", "roles", "value"),
    [
        ("motor_speed", ("motor_speed",), 0.0),
        ("wheel_speed_front", ("wheel_speed_front",), 0.0),
        ("gps_speed", ("gps_speed",), 0.0),
        ("odometer", ("odometer",), 0.0),
        ("odometer", ("odometer",), 40e6 / 3),
        ("positions", ("latitude", "longitude"), 0.0),
        ("positions", ("latitude", "longitude"), 40.3),
    ],
)
def test_a_source_that_stands_is_named_and_the_others_agree(rides, name, roles, value):
    columns = dict(rides[0].columns)
    for role in roles:
        times, values = columns[role]
        columns[role] = (times, np.full_like(values, value))
    findings = checked(replace(rides[0], columns=columns))
    those = [one for one in findings if one.check == BY_WAYS]
    assert [(one.looks, one.roles) for one in those[:1]] == [(Looks.WRONG, roles)]
    assert those[0].text == f"{name} stands while wheel_speed_rear moves"
    assert [one.looks for one in those[1:]] == [Looks.RIGHT]
    assert {role for one in wrong_of(findings) for role in one.roles} == set(roles)


@pytest.mark.parametrize("seconds", [0.05, 2, 4])
def test_a_log_of_moments_cannot_tell(tmp_path, seconds):
    cut = ["export", str(LOGS / "coastdown.blf"), str(tmp_path / "cut.blf"), "--from", "20", "--to", str(20 + seconds)]
    assert cli.main(cut) == OK
    found = check_log(tmp_path / "cut.blf", read_vehicle("reference"))
    assert found.those(Looks.WRONG) == []
    assert "most checks need" in check_text(found)


def test_it_says_what_is_right_and_what_it_cannot_tell(log, capsys):
    assert cli.main(["vehicle", "check", "reference", str(log), "--quiet"]) == OK
    out = capsys.readouterr().out
    assert out.splitlines()[0].endswith("looks right")
    assert "\ncannot tell:\n" in out
    assert "the battery's tables are about right" in out  # by the daemon's own pipeline
    assert "riders told apart        no: lacks rider" in out


def test_the_status_and_the_json_say_what_is_wrong(log, tmp_path, capsys):
    (tmp_path / "v.toml").write_text(
        REFERENCE.replace('"BMS_PackCurrent"', '{ signal = "BMS_PackCurrent", scale = -1 }'), encoding="utf-8"
    )
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


def test_without_a_log_it_says_what_the_roles_are_enough_for(capsys):
    assert cli.main(["vehicle", "check", str(ROOT / "tests/vehicles/i3/i3.toml")]) == OK
    out = capsys.readouterr().out
    assert re.search(r"^  range +yes", out, re.M)
    assert re.search(r"^  wind by heading +no: lacks GPS course", out, re.M)


@pytest.mark.parametrize("name", ["kick-scooter", "van"])
def test_other_vehicles_with_and_without_a_mistake(tmp_path, name):
    file = write(tmp_path, BUILDS[name])
    right, log = file.read_text(encoding="utf-8"), tmp_path / "r.log"
    database = read_vehicle(str(file)).mapping.database
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


# --- positions, wheel radius and gear ratio ---------------------------------------------------------------------------


def elsewhere(ride: Recording, latitude: float, longitude: float) -> dict[str, tuple[Array, Array]]:
    """The columns of `ride` as if it had been ridden at another place [deg], as long to the north and the east."""
    north, east = ride.columns["latitude"], ride.columns["longitude"]
    wider = np.cos(np.radians(north[1].mean())) / np.cos(np.radians(latitude))
    return {
        **ride.columns,
        "latitude": (north[0], latitude + north[1] - north[1].mean()),
        "longitude": (east[0], longitude + (east[1] - east[1].mean()) * wider),
    }


def said_of_positions(columns: dict[str, tuple[Array, Array]]) -> list[Finding]:
    findings = checked(Recording("x", {role: columns[role] for role in ("motor_speed", "latitude", "longitude")}))
    return [one for one in findings if "latitude" in one.roles and one.check != "stuck"]


@pytest.mark.parametrize("place", [(40.3, -83.5), (48.0, 11.0), (35.7, 139.7), (-33.9, 151.2), (0.2, 36.8)], ids=str)
def test_swapped_positions_are_named_wherever_the_ride_was(rides, place):
    there = elsewhere(rides[0], *place)
    (said,) = said_of_positions(there)
    assert said.looks is Looks.RIGHT, said
    (said,) = said_of_positions({**there, "latitude": there["longitude"], "longitude": there["latitude"]})
    assert said.looks is Looks.WRONG
    assert "swapped" in said.text


def test_a_latitude_beyond_the_poles_needs_no_ride(rides):
    there = elsewhere(rides[0], 35.7, 139.7)
    standing = {role: (times, values * 0 + values[0]) for role, (times, values) in there.items()}
    (said,) = said_of_positions({**standing, "latitude": standing["longitude"], "longitude": standing["latitude"]})
    assert "139.7 deg, expected is -90 to 90: swapped with the longitude" in said.text


UNSEEN = {"latitude": 0.0, "longitude": 0.0, "odometer": 0.0}


@pytest.mark.parametrize("times", [0.95, 1.05, 1.2, 2.0])
def test_a_wrong_radius_is_told_of_the_file_and_of_no_sensor(rides, tmp_path, times):
    text = changed("wheel_radius", f"{{ value = {read_vehicle('reference').parameters['wheel_radius'] * times}")
    findings = checked(rides[0], text, tmp_path)
    (said,) = wrong_of(findings)
    assert (said.check, said.roles) == (BY_FILE, ())
    assert re.search(r"wheel_speed_rear is [\d.]+ times gps_speed and odometer and positions; 0\.24\d* m", said.text)
    assert any(one.check.startswith("power") and one.looks is Looks.RIGHT for one in findings)  # by the right radius


def test_the_gear_ratio_or_a_scale_is_named_where_the_wheel_tells(rides, tmp_path):
    (said,) = wrong_of(checked(rides[0], changed("gear_ratio", "{ value = 0.25"), tmp_path))
    assert said.roles == ("motor_speed",)
    assert re.search(r"gear_ratio 0.25 motor_speed is 0\.25\d? times", said.text)
    assert re.search(r"; (1|0\.99\d*) would fit, or the scale of motor_speed", said.text)
    (said,) = wrong_of(checked(rides[1], changed("wheel_radius", "{ value = 0.268"), tmp_path))  # no wheel speed
    assert said.roles == ("motor_speed",)
    assert "wheel_radius times gear_ratio 0.268 m" in said.text
    assert "or the scale of motor_speed is wrong" in said.text


def test_without_a_third_way_none_decides(rides, tmp_path):
    (said,) = wrong_of(checked(rides[0], changed("wheel_radius", "{ value = 0.2195"), tmp_path, **UNSEEN))
    assert {"wheel_speed_rear", "gps_speed"} <= set(said.roles)
    assert "none decides" in said.text
    assert re.search(r"wheel_radius 0\.24\d* m would fit", said.text)


@pytest.mark.parametrize(("times", "looks"), [(1.0, Looks.RIGHT), (1.03, Looks.RIGHT), (1.1, Looks.UNKNOWN)])
def test_a_radius_that_only_the_odometer_doubts_cannot_be_told(rides, tmp_path, times, looks):
    text = changed("wheel_radius", f"{{ value = {read_vehicle('reference').parameters['wheel_radius'] * times}")
    findings = checked(rides[0], text, tmp_path, gps_speed=0.0, latitude=0.0, longitude=0.0)
    (said,) = [one for one in findings if one.check == BY_WAYS]
    assert said.looks is looks, said


# --- the pack ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cells", "check", "said"),
    [
        ("cells_series = 13", "state of charge against the voltage", "14 cells in series would fit, not 13"),
        ("cells_series = 15", "state of charge against the voltage", "14 cells in series would fit, not 15"),
        ("cells_series = 20", "state of charge against the voltage", "cells in series"),
        ("cells_parallel = 4", "state of charge against the charge", "cells in parallel"),
        ("cells_parallel = 24", "state of charge against the charge", "cells in parallel"),
    ],
)
def test_a_wrong_number_of_cells_is_suspected(rides, tmp_path, cells, check, said):
    findings = checked(rides[0], changed(*cells.split(" = ")), tmp_path)
    assert any(one.check == check and said in one.text for one in wrong_of(findings))
    if "series" in cells:  # not said right by one check and wrong by another
        assert not [one for one in findings if one.check == "voltage against the cells" and one.looks is Looks.RIGHT]


def test_cells_that_give_current_above_their_full_voltage_are_too_few(rides, tmp_path):
    (said,) = wrong_of(checked(rides[1], changed("cells_series", "12"), tmp_path, inverter_voltage=0.0))
    assert said.check == "voltage against the cells"
    assert "no more while they give current: 13 to 18 in series would fit" in said.text


@pytest.mark.parametrize(
    ("parallel", "fell", "looks", "said"),
    [
        (12, 0.95, Looks.RIGHT, "it falls by 95.0%"),
        (10, 0.95, Looks.WRONG, "; 32.4 A·h would fit: the cell's capacity"),
        (16, 0.95, Looks.UNKNOWN, "; 32.4 A·h would fit: aged cells, their capacity"),
        (10, 0.1, Looks.RIGHT, "it falls by 10.0%"),  # which a gauge cannot tell
    ],
)
def test_more_charge_than_the_cells_have_looks_wrong_and_less_may_be_of_age(tmp_path, parallel, fell, looks, said):
    seconds, right = np.arange(3603.0), read_vehicle("reference").pack
    current = np.full(len(seconds), right.pack_capacity(25.0) * fell)
    shown = 0.98 - fell * (seconds - 1) / 3600
    columns = {"pack_voltage": seconds * 0 + 50, "pack_current": current, "bms_state_of_charge": shown}
    ride_ = Recording("x", {role: (seconds, values) for role, values in columns.items()})
    findings = checked(ride_, changed("cells_parallel", str(parallel)), tmp_path)
    (found,) = [one for one in findings if "the charge" in one.check]
    assert (found.looks, said in found.text) == (looks, True), found.text


@pytest.mark.parametrize(("role", "scale"), [("pack_current", 0.001), ("pack_voltage", 1.05)])
def test_no_number_of_cells_fits_a_sensor_that_is_off(rides, role, scale):
    for recorded in rides:
        findings = checked(recorded, **{role: scale})
        assert any(role in one.roles for one in wrong_of(findings))
        assert [one.text for one in findings if "in series would fit" in one.text] == []


@pytest.mark.parametrize(
    ("ocv_sd", "temperature", "looks"),
    [(0.004, 15.0, Looks.WRONG), (0.5, 15.0, Looks.UNKNOWN), (0.004, -30.0, Looks.UNKNOWN)],
)
def test_a_file_that_knows_its_cells_roughly_cannot_tell(tmp_path, ocv_sd, temperature, looks):
    (tmp_path / "v.toml").write_text(changed("cells_series", "13"), encoding="utf-8")
    vehicle = read_vehicle(tmp_path / "v.toml")
    of = PackRide(np.full(60, 50.0), np.full(60, 5.0), replace(vehicle.pack, ocv_sd=ocv_sd), temperature)
    (found,) = on_board(LOGS / "coastdown.blf", vehicle, True, of)
    assert found.looks is looks
