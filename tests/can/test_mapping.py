from __future__ import annotations

import re
from pathlib import Path

import pytest

from gz_onboard.can.dbc import _VALUE_NAMES, find_dbc, load_database
from gz_onboard.can.mapping import BusMapping, read_mapping, to_si
from gz_onboard.errors import InputError
from gz_onboard.toml import Table

DBC = """\
VERSION "1"
NS_ :
BS_:
BU_: A
BO_ 256 Pack: 8 A
 SG_ Voltage : 0|16@1+ (0.01,0) [0|100] "V" A
 SG_ Current : 16|16@1- (0.1,0) [-300|300] "A" A
 SG_ State : 32|8@1+ (1,0) [0|255] "" A
 SG_ Counter : 48|4@1+ (1,0) [0|14] "" A
 SG_ Sum : 56|8@1+ (1,0) [0|255] "" A

BO_ 257 Motor: 4 A
 SG_ Speed : 0|16@1- (1,0) [-9000|9000] "rpm" A
 SG_ State : 16|8@1+ (1,0) [0|255] "" A
 SG_ Heat : 24|8@1+ (1,-40) [-40|214] "K" A

BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ 256 100;
"""


def mapping(folder: Path, roles: str = "", bus: str = "", dbc: str = DBC, names: str = '["v.dbc"]') -> BusMapping:
    (folder / "v.dbc").write_text(dbc, encoding="utf-8")
    (folder / "v.toml").write_text(f"dbc = {names}\n[bus]\n{bus}\n[roles]\n{roles}\n", encoding="utf-8")
    return read_mapping(Table.read(folder / "v.toml"))


def complaint(folder: Path, **parts: str) -> str:
    with pytest.raises(InputError) as caught:
        mapping(folder, **parts)
    return str(caught.value)


# --- what is right ---------------------------------------------------------------------------------------------


def test_sources_have_sign_scale_and_unit(tmp_path):
    roles = """
pack_voltage = "Voltage"
pack_current = { signal = "Current", scale = -1 }
motor_current = { message = "Pack", signal = "Current", scale = 2, offset = 0.5 }
motor_speed = { signal = "Speed", unit = "rev/s" }
motor_temperature = "Heat"
ambient_temperature = { signal = "Heat", scale = 2, offset = 1 }
"""
    got = {s.role: (s.message, s.signal, s.factor, s.offset) for s in mapping(tmp_path, roles).sources}
    assert got == {
        "pack_voltage": ("Pack", "Voltage", pytest.approx(0.01), 0.0),
        "pack_current": ("Pack", "Current", pytest.approx(-0.1), 0.0),
        "motor_current": ("Pack", "Current", pytest.approx(0.2), 0.5),
        "motor_speed": ("Motor", "Speed", pytest.approx(6.283185307), 0.0),
        "motor_temperature": ("Motor", "Heat", 1.0, pytest.approx(-313.15)),
        "ambient_temperature": ("Motor", "Heat", 2.0, pytest.approx(-625.3)),
    }


def test_instruments_are_read_like_roles_and_stay_off_the_estimators_bus(tmp_path):
    dbc = DBC.replace('"K" A', '"bar" A')
    found = mapping(tmp_path, 'pack_voltage = "Voltage"\n[instruments]\nbrake_pressure_front = "Heat"', dbc=dbc)
    assert [s.role for s in found.sources] == ["pack_voltage"]
    (pressure,) = found.instruments
    assert (pressure.role, pressure.message) == ("brake_pressure_front", "Motor")
    assert (pressure.factor, pressure.offset) == (1e5, -40e5)
    assert "did you mean 'roller_speed'" in complaint(tmp_path, roles='[instruments]\nroler_speed = "Speed"')
    said = complaint(tmp_path, roles='[instruments]\nroller_force = "Voltage"')
    assert "'Voltage' has unit 'V', from which roller_force [N] cannot be had" in said


@pytest.mark.parametrize("name", ["v.dbc", "folder/other.dbc", "vehicle.dbc"])
def test_a_dbc_is_found_beside_the_file_and_among_our_own(tmp_path, name):
    (tmp_path / "folder").mkdir()
    (tmp_path / "v.dbc").write_text(DBC)
    (tmp_path / "folder" / "other.dbc").write_text(DBC)
    assert find_dbc(name, tmp_path).is_file()


# --- units ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "role", "value", "si"),
    [
        ("V", "pack_voltage", 50.0, 50.0),
        ("mV", "pack_voltage", 50_000.0, 50.0),
        ("mA", "pack_current", -1500.0, -1.5),
        ("km/h", "vehicle_speed", 36.0, 10.0),
        ("kph", "gps_speed", 36.0, 10.0),
        ("mph", "vehicle_speed", 10.0, 4.4704),
        ("K", "cell_temperature", 300.0, 26.85),
        ("°C", "cell_temperature", 25.0, 25.0),
        ("degF", "ambient_temperature", 212.0, 100.0),
        ("°F", "cell_temperature", 14.0, -10.0),
        ("miles", "odometer", 2.0, 3218.688),
        ("ft", "gps_altitude", 1000.0, 304.8),
        ("r/min", "motor_speed", 60.0, 6.283185307179586),
        ("deg", "gps_course", 180.0, 3.141592653589793),
        ("deg", "latitude", 40.0, 40.0),
        ("deg/s", "rate_x", 90.0, 1.5707963267948966),
        ("g", "accel_z", 1.0, 9.80665),
        ("%", "bms_state_of_charge", 50.0, 0.5),
        ("km", "odometer", 1.0, 1000.0),
        ("", "throttle", 0.5, 0.5),
        ("Nm", "motor_torque", 3.0, 3.0),
    ],
)
def test_units(unit, role, value, si):
    found = to_si(unit, role)
    assert found is not None
    assert value * found[0] + found[1] == pytest.approx(si, rel=1e-12)


def test_units_that_are_not_of_the_role():
    for unit, role in [("V", "pack_current"), ("", "pack_voltage"), ("km/h", "motor_speed"), ("rad", "latitude")]:
        assert to_si(unit, role) is None


# --- errors of the vehicle file ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("roles", "parts"),
    [
        ('pack_volt = "Voltage"', [":5:", "roles.pack_volt", "unknown key", "did you mean 'pack_voltage'"]),
        ('pack_voltage = "Voltag"', [":5:", "roles.pack_voltage", "'Voltag'", "did you mean 'Voltage'"]),
        ("pack_voltage = 5", [":5:", "roles.pack_voltage", "must be a string", "5"]),
        ('pack_voltage = "Current"', [":5:", "roles.pack_voltage", "'Current'", "'A'", "pack_voltage [V]", "V, mV"]),
        ('throttle = "State"', [":5:", "roles.throttle", "several messages (Pack, Motor)", "message ="]),
        (
            'throttle = { message = "Pak", signal = "State" }',
            [":5:", "roles.throttle.message", "'Pak'", "did you mean 'Pack'"],
        ),
        (
            'throttle = { message = "Motor", signal = "Voltage" }',
            [":5:", "roles.throttle.signal", "message Motor has no signal 'Voltage'"],
        ),
        ('throttle = { message = "Pack" }', [":5:", "roles.throttle.signal", "is missing"]),
        (
            'motor_speed = { signal = "Speed", units = "rpm" }',
            [":5:", "roles.motor_speed.units", "unknown key", "did you mean 'unit'"],
        ),
        (
            'motor_speed = { signal = "Speed", unit = "rmp" }',
            [":5:", "roles.motor_speed", "'rmp'", "motor_speed [rad/s]", "rev/s", "did you mean 'rpm'"],
        ),
        (
            'motor_speed = { signal = "Speed", scale = "2" }',
            [":5:", "roles.motor_speed.scale", "must be a number", "'2'"],
        ),
        ('motor_speed = { signal = "Speed", scale = 0 }', [":5:", "roles.motor_speed.scale", "must not be 0"]),
        (
            'motor_speed = { signal = "Speed", scale = inf }',
            [":5:", "roles.motor_speed.scale", "must be a finite number, is inf"],
        ),
        (
            'motor_speed = { signal = "Speed", offset = nan }',
            [":5:", "roles.motor_speed.offset", "must be a finite number, is nan"],
        ),
        (
            'inverter_voltage = "Voltage"\npack_voltage = { message = "Pack", signal = "Voltage", scale = 2 }',
            [":6:", "roles.pack_voltage:", "'Voltage' of Pack is also inverter_voltage"],
        ),
        (
            'pack_current = "Current"\nauxiliary_current = "Current"',
            [":6:", "roles.auxiliary_current:", "'Current' of Pack is also pack_current"],
        ),
        (
            'motor_speed = "Speed"\nvehicle_speed = { signal = "Speed", unit = "km/h" }',
            [":6:", "roles.vehicle_speed:", "'Speed' of Motor is also motor_speed"],
        ),
    ],
)
def test_roles_that_do_not_fit(tmp_path, roles, parts):
    message = complaint(tmp_path, roles=roles)
    for part in [str(tmp_path / "v.toml"), *parts]:
        assert part in message


@pytest.mark.parametrize(
    ("bus", "parts"),
    [
        ('not_available = "all-one"', [":3:", "bus.not_available", "'all-one'", "did you mean 'all-ones'"]),
        ('identifiers = "J1939"', [":3:", "bus.identifiers", "'J1939'", "did you mean 'j1939'"]),
        ("baudrate = 500", [":3:", "bus.baudrate", "unknown key"]),
        ("[bus.messages.Pak]\nperiod = 1", [":3:", "bus.messages.Pak", "did you mean 'Pack'"]),
        ("[bus.messages.Pack]\nperod = 1", [":4:", "bus.messages.Pack.perod", "did you mean 'period'"]),
        ("[bus.messages.Pack]\nperiod = 0", [":4:", "bus.messages.Pack.period", "0 is outside"]),
        ('[bus.messages.Pack]\nperiod = "1 s"', [":4:", "bus.messages.Pack.period", "must be a number", "'1 s'"]),
        ('[bus.messages.Pack]\ncrc = "Sume"', [":4:", "bus.messages.Pack.crc", "'Sume'", "did you mean 'Sum'"]),
        ('[bus.messages.Pack]\ncrc = "State"', [":4:", "bus.messages.Pack.crc", "'State'", "last byte of Pack"]),
        (
            '[bus.messages.Pack]\ncounter = "Count"',
            [":4:", "bus.messages.Pack.counter", "'Count'", "did you mean 'Counter'"],
        ),
        (
            '[bus.messages.Pack]\ncounter = "Current"',
            [":4:", "bus.messages.Pack.counter", "'Current'", "unsigned integer"],
        ),
        (
            '[bus.messages.Pack]\ncrc = "Sum"\ncounter = "Sum"',
            [":5:", "bus.messages.Pack.counter", "'Sum' is the crc of Pack"],
        ),
        ("messages = 3", [":3:", "bus.messages", "must be a table"]),
        ("[bus.messages]\nPack = 3", [":4:", "bus.messages.Pack", "must be a table"]),
    ],
)
def test_bus_tables_that_do_not_fit(tmp_path, bus, parts):
    message = complaint(tmp_path, bus=bus)
    for part in [str(tmp_path / "v.toml"), *parts]:
        assert part in message


@pytest.mark.parametrize(
    ("names", "parts"),
    [
        ('["w.dbc"]', [":1: dbc:", "w.dbc", "no such DBC file", "did you mean 'v.dbc'"]),
        ('["vehicel.dbc"]', [":1: dbc:", "vehicel.dbc", "did you mean 'vehicle.dbc'"]),
        ('"v.dbc"', [":1: dbc:", "list of DBC file names"]),
        ("[]", [":1: dbc:", "list of DBC file names"]),
        ("[1]", [":1: dbc:", "list of DBC file names"]),
        ('["v.dbc\\u0000"]', [":1: dbc:", "cannot be the name of a file"]),
        ('["v.dbc", "v.dbc"]', ["v.dbc:5", "name 'Pack'", "also that of Pack"]),
    ],
)
def test_dbc_files_that_cannot_be_had(tmp_path, names, parts):
    message = complaint(tmp_path, names=names)
    for part in parts:
        assert part in message


# --- errors of the DBC ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (('(0.01,0) [0|100] "V"', '(0.01,0 [0|100] "V"'), [":6:", "line 6, column 32", "[0|100]"]),
        (("BO_ 257 Motor", "BO_ 3221225473 Motor"), [":12:", "Motor", "more than 29 bits"]),
        (("BO_ 257 Motor", "BO_ 256 Motor"), [":12:", "identifier 0x100 of message Motor", "Pack in", "v.dbc:5"]),
        (("BO_ 257 Motor: 4", "BO_ 257 Motor: 3"), [":12:", "Heat", "does not fit", "Motor"]),
        (("16|16@1- (0.1", "8|16@1- (0.1"), [":5:", "Current", "overlapping", "Pack"]),
        (("16|16@1- (0.1,0)", "16|16@1- (0,0)"), [":5:", "Current", "scale of 0", "Pack"]),
        ((DBC, ""), [":1:", "not a valid DBC file"]),
        ((DBC, "\x00\x01"), [":1:", "not a valid DBC file"]),
        ((DBC, 'VERSION "1"\n'), [":1:", "it has no message"]),
        (("Motor: 4", "Motor: 1000000"), [":12:", "Motor at line 12 goes beyond the longest frame, of 64 bytes"]),
        (("0|16@1- (1", "100000|16@1- (1"), [":13:", "Speed", "beyond the longest frame, of 64 bytes"]),
        (("0|16@1- (1", "0|100000@1- (1"), [":13:", "Speed", "beyond the longest frame, of 64 bytes"]),
        (("0|16@1- (1", "-1|16@1- (1"), [":12:", "Speed has 16 bits from bit -1 on"]),
        (("(1,-40)", "(1,1e400)"), [":12:", "Heat has an offset of inf"]),
        (("(1,-40)", f"(1,{'9' * 400})"), [":12:", "Heat has an offset of 999"]),
        (("(1,-40)", "(1e-300,-40)"), [":12:", "Heat has a scale of 1e-300"]),
        (("[-40|214]", "[214|-40]"), [":12:", "Heat has the limits 214 to -40"]),
        (("[-40|214]", "[-40|1e400]"), [":12:", "Heat has the limits -40 to inf"]),
        (("BO_ 256 100;", "BO_ 256 1e400;"), [":5:", "the cycle time is 1000"]),
        (("BO_ 256 100;", "BO_ 256 -5;"), [":5:", "the cycle time is -5 ms"]),
        (("BO_ 256 100;\n", "BO_ 256 100"), [":19:", "ends within a statement", "BO_ 256 100'. Is the file whole?"]),
        (
            ("BO_ 256 100;\n", 'BO_ 256 100;\n\nCM_ "a'),
            [":21:", "ends within a statement", "'CM_ \"a'. Is the file whole?"],
        ),
    ],
)
def test_a_broken_dbc(tmp_path, change, parts):
    old, new = change
    assert old in DBC
    file = tmp_path / "v.dbc"
    file.write_text(DBC.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        load_database([file])
    for part in [str(file), *parts]:
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("change", "lost", "why"),
    [
        (('(0.01,0) [0|100] "V"', '(0.01,0 [0|100] "V"'), {"Pack.Voltage"}, "line 6: Invalid syntax"),
        (("16|16@1- (0.1", "8|16@1- (0.1"), {"Pack.Voltage", "Pack.Current"}, "line 5: The signals .* overlapping"),
        (("24|8@1+ (1,-40)", "28|8@1+ (1,-40)"), {"Motor.Heat"}, "line 12: The signal Heat does not fit"),
        (("16|16@1- (0.1,0)", "16|16@1- (0,0)"), {"Pack.Current"}, "line 5: signal Current has a scale of 0"),
        (
            ("BA_DEF_ BO_", "SIG_VALTYPE_ 256 Current : 2;\nBA_DEF_ BO_"),
            {"Pack.Current"},
            "line 5: signal Current is a float of 16",
        ),
        (("BO_ 256 Pack", "BO_ 256 2Pack"), {"2Pack.*"}, "line 5: Invalid syntax"),
    ],
)
def test_what_cantools_refuses_is_left_out_and_said_once(tmp_path, caplog, change, lost, why):
    old, new = change
    text = DBC.replace(old, new, 1)
    assert text != DBC
    dropped = {name for name in lost if not name.endswith("*")}
    whole = {name[:-2] for name in lost - dropped}
    there = {f"{m}.{s}" for m, signals in SIGNALS.items() for s in signals if not {m, f"2{m}"} & whole}
    for _ in range(2):
        got = mapping(tmp_path, dbc=text).database
    assert {f"{m.name}.{s.name}" for m in got.messages for s in m.signals} == there - dropped
    (record,) = caplog.records
    assert re.search(f"v.dbc: what cannot be read of it is left out: {why}", record.getMessage())


SIGNALS = {"Pack": ["Voltage", "Current", "State", "Counter", "Sum"], "Motor": ["Speed", "State", "Heat"]}


@pytest.mark.parametrize(
    "names",
    [
        ' 256 Charge 0 "a; b" 1 "b" ;',
        ' 256 Charge 0 "a"\n 1 "b" ;',
        r' 256 Charge 0 "\"a\"" ;',
        '\t256 Charge 0 "a\nb";',
    ],
)
def test_names_of_values_of_a_signal_that_is_not_there_do_no_harm(tmp_path, caplog, names):
    text = DBC.replace("BA_DEF_ BO_", f"VAL_{names}\nBA_DEF_ BO_", 1)
    assert len(mapping(tmp_path, dbc=text).database.messages) == 2
    assert not caplog.records


@pytest.mark.parametrize("names", ['VAL_ 256 State 0 "a"', 'VAL_ 256 State 0 "a ;'])
def test_names_of_values_without_an_end_take_no_message_along(names):
    assert not _VALUE_NAMES.search(f'{names}\n\nBO_ 300 Late: 1 X\n SG_ Last : 0|8@1+ (1,0) [0|1] "V" X\n\nCM_ "c" ;\n')


def test_a_dbc_without_its_bs_line_is_read(tmp_path, caplog):
    bare = 'VERSION ""\n\nNS_ :\n  NS_DESC_\n\nBO_ 256 Pack: 2 BMS\n SG_ Voltage : 0|16@1+ (0.1,0) [0|500] "V" X\n'
    for text in (bare, bare.replace("BO_", "BU_: BMS\nBO_", 1), bare.replace("\nBO_", "BO_", 1)):
        (message,) = mapping(tmp_path, dbc=text).database.messages
        assert message.decode(b"\x10\x0e") == {"Voltage": 360.0}
    assert not caplog.records
    with pytest.raises(InputError, match=r"v.dbc:7: "):  # no line has moved
        (tmp_path / "v.dbc").write_text(bare.replace("16@1+ (", "16@1+ "))
        load_database([tmp_path / "v.dbc"])


def test_wide_identifiers_without_bit_31_are_read_as_29_bits_and_said(tmp_path, caplog):
    text = DBC.replace("BO_ 257 Motor", "BO_ 380196006 Motor").replace(
        "BA_DEF_ BO_", 'CM_ SG_ 380196006 Heat "of 380196006";\nVAL_ 380196006 State 1 "on" ;\nBA_DEF_ BO_', 1
    )
    motor = mapping(tmp_path, dbc=text).database.get_message_by_name("Motor")
    assert (motor.frame_id, motor.is_extended_frame) == (380196006, True)
    assert motor.get_signal_by_name("Heat").comment == "of 380196006"
    (record,) = caplog.records
    assert "v.dbc: identifiers above 0x7ff are read as 29 bits, though bit 31 is not set: 0x16a954a6" in record.message


def test_a_dbc_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match=r"none\.dbc: cannot be read: No such file"):
        load_database([tmp_path / "none.dbc"])


def test_parameter_groups_must_be_told_apart(tmp_path):
    dbc = DBC.replace("BO_ 256", f"BO_ {0x8CF00400}").replace("BO_ 257", f"BO_ {0x98F00431}")
    assert len(mapping(tmp_path, dbc=dbc).database.messages) == 2
    message = complaint(tmp_path, dbc=dbc, bus='identifiers = "j1939"')
    for part in ("v.toml:3:", "Pack and Motor", "61444", 'identifiers = "exact"'):
        assert part in message
