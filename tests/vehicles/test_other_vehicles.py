"""Other vehicles than the reference scooter: a DBC and a TOML each, no code; on frames made here."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable
from pathlib import Path

import pytest

from gz_onboard.can.codec import LENGTH, NOT_AVAILABLE, RANGE, Codec
from gz_onboard.events import EFF_FLAG, Frame, Reason, State
from gz_onboard.pipeline import Pipeline
from gz_onboard.vehicle import Vehicle, read_vehicle
from tests.events import Event, events_of

HERE = Path(__file__).parent
MS = 1_000_000
RPM = 2 * math.pi / 60


def vehicle(name: str) -> Vehicle:
    return read_vehicle(str(HERE / name / f"{name}.toml"))


def values(codec: Codec, events: Iterable[Event]) -> dict[str, list[tuple[float, float | None]]]:
    """(time [s], value) by role."""
    found: dict[str, list[tuple[float, float | None]]] = {}
    for time, group, numbers in events:
        for role, value in zip(codec.groups[group].roles, numbers, strict=True):
            found.setdefault(role, []).append((time, value))
    return found


# --- an electric race motorcycle ------------------------------------------------------------------------------------


def tlmoto_frames(time_ns: int, rpm: float, volts: float, amps: float) -> list[Frame]:
    """What its controller sends every 200 ms, with CANopen's SYNC in between."""
    torque = volts * amps * 0.9 / (rpm * RPM) if rpm else 0.0
    data = [
        (13, struct.pack("<HHhh", 100, 649, 60, round(volts * 16))),
        (14, struct.pack("<HbhhB", round(volts * 16), 45, round(amps * 16), round(torque * 16), 0)),
        (128, b"\xff\xff\xff\xff\x7f\x00\x00\x00"),
        (15, struct.pack("<iHH", round(rpm), 500, 16384)),
    ]
    return [(time_ns + i * MS, identifier, payload, 0) for i, (identifier, payload) in enumerate(data)]


def name_of(codec: Codec, identifier: int) -> str:
    origin = codec.origins.find(identifier)
    assert origin
    return origin.message.name


def test_tlmoto_frames_of_its_layout():
    codec = Codec(vehicle("tlmoto").mapping)
    found = values(codec, events_of(codec, tlmoto_frames(1_049 * MS, 1200, 115.625, 41.25)))
    assert {role: row[0][1] for role, row in found.items()} == {
        "pack_voltage": 115.625,
        "motor_temperature": 60.0,
        "inverter_voltage": 115.625,
        "inverter_temperature": 45.0,
        "pack_current": 41.25,
        "motor_torque": pytest.approx(34.16, abs=1 / 32),
        "motor_speed": pytest.approx(1200 * RPM),
        "throttle": pytest.approx(0.5, abs=1e-4),
    }
    assert codec.unknown == {128: 1}


def test_tlmoto_cells_are_in_its_dbc():
    codec = Codec(vehicle("tlmoto").mapping)
    data = bytes([0, 0xCA, 0xD1, 0xD1, 0xD0, 0xD1, 0, 0])
    assert events_of(codec, [(0, 51, data, 0)]) == []  # cell voltages play no role yet, but stand in the log
    cells = list(codec.values(name_of(codec, 51), data).values())
    assert cells[0] is None  # not read by the BMS: 2.00 V is no voltage of a cell in use
    assert cells[1:] == pytest.approx([4.02, 4.09, 4.09, 4.08, 4.09])


def test_tlmoto_goes_the_whole_way():
    pipeline = Pipeline(vehicle("tlmoto"))
    sent = []
    for i in range(600):
        amps = 20.0 if i > 50 else 0.0
        frames = tlmoto_frames(i * 200 * MS, 2500 if i > 50 else 0, 116.0 - 0.033 * amps, amps)
        sent += pipeline.advance(frames, frames[-1][0])
    estimate = pipeline.last
    assert estimate is not None and estimate.state is State.DEGRADED
    assert not estimate.reasons & (Reason.NO_IMU | Reason.NO_GPS | Reason.NO_PACK_CURRENT)  # what it never had is none
    assert estimate.soc is not None and 0.5 < estimate.soc < 0.9
    assert estimate.range is not None and estimate.range_p10 is not None and estimate.range_p90 is not None
    assert 0 < estimate.range_p10 < estimate.range < estimate.range_p90
    assert estimate.speed == pytest.approx(2500 * 0.0203 / 3.6, rel=0.02)  # GPS speed over motor speed
    assert {identifier for _, identifier, _, _ in sent} == set(range(0x600, 0x608))
    assert pipeline.counts().dropped == pipeline.counts().implausible == 0


# --- a car's satellite receiver with valid bits -------------------------------------------------------------------


def test_car_frames_of_its_layout():
    codec = Codec(vehicle("car").mapping)
    speed = 1 | 12_345 << 1
    frames = [
        (0, 7, speed.to_bytes(5, "little"), 0),
        (0, 7, (speed - 1).to_bytes(5, "little"), 0),  # the same number, not valid
        (0, 1, bytes([3 | 9 << 3]), 0),
        (0, 1, bytes([5 | 9 << 3]), 0),  # a fix of the time only
        (0, 3, (1 | 138_000_000 << 1 | 190_000_000 << 29).to_bytes(8, "little"), 0),
        (0, 4, (1 | 60_500 << 1).to_bytes(4, "little"), 0),
        (0, 9, (1 | 590 << 1 | 1028 << 31).to_bytes(8, "little"), 0),
    ]
    found = values(codec, events_of(codec, frames))
    assert {role: [value for _, value in row] for role, row in found.items()} == {
        "gps_speed": [pytest.approx(12.345)],
        "gps_fix": [3.0, None],
        "latitude": [pytest.approx(48.0)],
        "longitude": [pytest.approx(10.0)],
        "gps_altitude": [pytest.approx(50.0)],
        "accel_z": [pytest.approx(9.75)],
        "rate_z": [pytest.approx(math.radians(1.0))],
    }
    assert codec.faults == {("Status.FixType", RANGE): 1}


# --- trucks: SAE J1939, by parameter group -------------------------------------------------------------------------


def test_truck_frames_of_its_layout():
    codec = Codec(vehicle("truck").mapping)
    frames = [
        (0, 0x0CF00400 | EFF_FLAG, bytes.fromhex("607D84481400F084"), 0),
        (0, 0x18F00400 | EFF_FLAG, bytes.fromhex("607D84FFFF00F084"), 0),  # not available, at another priority
        (0, 0x0CF00400 | EFF_FLAG, bytes.fromhex("607D8400FE00F084"), 0),  # the code for an error
        (0, 0x18FEF100 | EFF_FLAG, bytes.fromhex("F7005AFFFFFFFFFF"), 0),
        (0, 0x18FEF100 | EFF_FLAG, bytes.fromhex("F7005A"), 0),
        (0, 0x18F00E00 | EFF_FLAG, bytes.fromhex("821639C4FFFFFFFF"), 0),
    ]
    found = values(codec, events_of(codec, frames))
    assert [value for _, value in found["motor_speed"]] == [pytest.approx(0x1448 / 8 * RPM), None, None]
    assert [value for _, value in found["vehicle_speed"]] == [pytest.approx(90 / 3.6)]
    assert codec.faults == {
        ("EEC1.EngineSpeed", NOT_AVAILABLE): 1,
        ("EEC1.EngineSpeed", RANGE): 1,
        ("CCVS1", LENGTH): 1,
    }
    assert codec.unknown == {0x18F00E00 | EFF_FLAG: 1}
