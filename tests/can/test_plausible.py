"""What a DBC without limits lets through, and no road vehicle can have."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from gz_onboard.can.codec import RANGE, Codec
from gz_onboard.can.mapping import read_mapping
from gz_onboard.events import PLAUSIBLE, ROLES
from gz_onboard.toml import Table
from tests.events import events_of

DBC = """VERSION "1"
NS_ :
BS_:
BU_: A
BO_ 256 M: 8 A
 SG_ Ambient : 0|16@1- (0.1,0) [0|0] "degC" A
 SG_ Speed : 16|16@1- (0.1,0) [0|0] "km/h" A
 SG_ Volts : 32|32@1- (1,0) [0|0] "V" A
SIG_VALTYPE_ 256 Volts : 1;
"""
ROLES_OF_IT = """dbc = ["v.dbc"]
[bus]
not_available = "none"
[roles]
ambient_temperature = "Ambient"
vehicle_speed = "Speed"
pack_voltage = "Volts"
"""


def codec(folder: Path, dbc: str = DBC, roles: str = ROLES_OF_IT) -> Codec:
    (folder / "v.dbc").write_text(dbc)
    (folder / "v.toml").write_text(roles)
    return Codec(read_mapping(Table.read(folder / "v.toml")))


def test_every_role_has_a_unit_of_which_it_is_said_what_is_plausible():
    assert set(ROLES.values()) == set(PLAUSIBLE)
    assert all(low <= 0 < high for low, high in PLAUSIBLE.values())


@pytest.mark.parametrize(
    ("raw", "signal"),
    [
        ((-2750, 300, 52.0), "Ambient"),  # below absolute zero
        ((200, 32767, 52.0), "Speed"),  # 3277 km/h
        ((200, -360, 52.0), "Speed"),  # backwards
        ((200, 300, -1.0), "Volts"),
        ((200, 300, 3e38), "Volts"),
        ((200, 300, float("nan")), "Volts"),
    ],
)
def test_what_is_beyond_is_left_out_and_counted(tmp_path: Path, raw: tuple[int, int, float], signal: str):
    it = codec(tmp_path)
    good = struct.pack("<hhf", 200, 300, 52.0)
    events = events_of(it, [(10**18, 256, good, 0), (10**18 + 10**8, 256, struct.pack("<hhf", *raw), 0)])
    (_, group, before), (_, _, after) = events
    roles = it.groups[group].roles
    assert dict(zip(roles, before, strict=True)) == pytest.approx(
        {"ambient_temperature": 20.0, "vehicle_speed": 30 / 3.6, "pack_voltage": 52.0}
    )
    absent = {"Ambient": "ambient_temperature", "Speed": "vehicle_speed", "Volts": "pack_voltage"}[signal]
    assert [role for role, value in zip(roles, after, strict=True) if value is None] == [absent]
    assert it.faults == {(f"M.{signal}", RANGE): 1}
