"""A ride of the plant as a real log: CAN frames in BLF, laid out by the scooter's DBC files, packed here."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import can
import cantools
import numpy as np
from cantools.database.can import Message
from cantools.database.can.signal import Signal
from numpy.typing import NDArray

from gz_onboard.recording.recording import Recording

DBC = Path(__file__).parents[2] / "dbc"
DEGREE, REVOLUTION, BAR = np.pi / 180, 2 * np.pi, 1e5
# Role of each signal, and the SI value of one unit of the database.
SIGNALS = {
    "INV_MotorSpeed": ("motor_speed", REVOLUTION / 60),
    "INV_MotorCurrent": ("motor_current", 1),
    "INV_MotorTorque": ("motor_torque", 1),
    "INV_DcVoltage": ("inverter_voltage", 1),
    "INV_DcCurrent": ("inverter_current", 1),
    "INV_Temperature": ("inverter_temperature", 1),
    "INV_MotorTemperature": ("motor_temperature", 1),
    "BMS_PackVoltage": ("pack_voltage", 1),
    "BMS_PackCurrent": ("pack_current", 1),
    "BMS_StateOfCharge": ("bms_state_of_charge", 0.01),
    "BMS_Contactor": ("contactor", 1),
    "BMS_CellVoltageMin": ("lowest_cell_voltage", 1),
    "BMS_CellVoltageMax": ("highest_cell_voltage", 1),
    "BMS_CellTempMean": ("cell_temperature", 1),
    "VCU_Throttle": ("throttle", 0.01),
    "VCU_BrakeSwitch": ("brake_switch", 1),
    "VCU_ChargePlug": ("charge_plug", 1),
    "VCU_Odometer": ("odometer", 1000),
    "IMU_AccelX": ("accel_x", 1),
    "IMU_AccelY": ("accel_y", 1),
    "IMU_AccelZ": ("accel_z", 1),
    "IMU_RateX": ("rate_x", DEGREE),
    "IMU_RateY": ("rate_y", DEGREE),
    "IMU_RateZ": ("rate_z", DEGREE),
    "HBM_WheelSpeedFront": ("wheel_speed_front", REVOLUTION),
    "HBM_WheelSpeedRear": ("wheel_speed_rear", REVOLUTION),
    "HBM_BrakePressureFront": ("brake_pressure_front", BAR),
    "HBM_BrakePressureRear": ("brake_pressure_rear", BAR),
    "HBM_AuxCurrent": ("auxiliary_current", 1),
    "TC_Ambient": ("ambient_temperature", 1),
    "GPS_Latitude": ("latitude", 1),
    "GPS_Longitude": ("longitude", 1),
    "GPS_Speed": ("gps_speed", 1),
    "GPS_Course": ("gps_course", DEGREE),
    "GPS_Altitude": ("gps_altitude", 1),
    "GPS_Fix": ("gps_fix", 1),
}
EPOCH = 1_750_000_000.0

Words = NDArray[np.uint64]


def _crc_table() -> NDArray[np.uint8]:
    """CRC-8 SAE J1850, polynomial 0x1D."""
    table = np.arange(256)
    for _ in range(8):
        table = np.where(table & 0x80, (table << 1) ^ 0x1D, table << 1) & 0xFF
    return table.astype(np.uint8)


def _raw(signal: Signal, values: NDArray[np.float64], unit: float) -> Words:
    scale, offset = float(signal.conversion.scale), float(signal.conversion.offset)
    raw = np.round((values / unit - offset) / scale).astype(np.int64)
    return (raw & ((1 << signal.length) - 1)).astype(np.uint64) << np.uint64(signal.start)


def _frames(message: Message, ride: Recording) -> tuple[NDArray[np.float64], NDArray[np.uint8]] | None:
    """Times and data (a row for each frame) of one message; None if the ride has none of its signals."""
    ours = [s for s in message.signals if s.name in SIGNALS and SIGNALS[s.name][0] in ride.columns]
    if not ours:
        return None
    times = ride.columns[SIGNALS[ours[0].name][0]][0]
    words = np.zeros(len(times), np.uint64)
    for signal in message.signals:
        if signal in ours:
            role, unit = SIGNALS[signal.name]
            words |= _raw(signal, ride.columns[role][1], unit)
        elif signal.name.endswith("Counter"):
            words |= (np.arange(len(times)) % 15).astype(np.uint64) << np.uint64(signal.start)
        elif not signal.name.endswith("CRC"):  # not available: all ones, or the most negative
            code = 1 << (signal.length - 1) if signal.is_signed else (1 << signal.length) - 1
            words |= np.uint64((code if signal.length >= 8 else 0) << signal.start)
    data = words.view(np.uint8).reshape(-1, 8).copy()
    if any(signal.name.endswith("CRC") for signal in message.signals):
        table, crc = _crc_table(), np.full(len(data), 0xFF, np.uint8)
        for i in range(7):
            crc = table[crc ^ data[:, i]]
        data[:, 7] = crc ^ 0xFF
    return times, data[:, : message.length]


def write_log(ride: Recording, file: Path) -> None:
    """Write `ride` as frames to `file` (any format of python-can by its suffix)."""
    sent = []
    for name in ("vehicle.dbc", "hbm.dbc"):
        database = cantools.database.load_file(DBC / name)
        assert isinstance(database, cantools.database.Database)
        for message in database.messages:
            found = _frames(message, ride)
            if found:
                sent += [(t, message.frame_id, row.tobytes()) for t, row in zip(*found, strict=True)]
    with can.Logger(file) as log:
        for time, identifier, data in sorted(sent):
            log.on_message_received(
                can.Message(timestamp=EPOCH + time, arbitration_id=identifier, data=data, is_extended_id=False)
            )


def write_logs(rides: Sequence[Recording], folder: Path) -> list[Path]:
    """Write `rides` as NAME.blf into `folder`, and what is noted about them into rides.json."""
    files = []
    for ride in rides:
        files.append(folder / f"{ride.name}.blf")
        write_log(ride, files[-1])
    facts = [{"name": ride.name, **ride.facts} for ride in rides]
    (folder / "rides.json").write_text(json.dumps(facts, indent=1), encoding="utf-8")
    return files
