"""A simulated ride as CAN frames: each message in its period, packed as its DBC file says, with the losses of a bus.

Time comes from an argument and chance from a seed: the same ride and seed give the same bytes. Each signal, each
message's phase and each kind of loss draws from its own stream, so losing frames changes no other frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gz_onboard.can.layout import raw_range, sae_j1850_tables
from gz_onboard.errors import InputError, nearest
from gz_onboard.events import EFF_FLAG, Frame
from gz_onboard.export.logs import out_suffix, write_frames_as
from gz_onboard.simulation.sensors import GPS_MESSAGES, ROLLER, SENSORS, TURNS, SimulatedSensor, latency, shaken, spread
from gz_onboard.simulation.truth import Truth
from gz_onboard.vehicle import Vehicle

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can.signal import Signal
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Words = NDArray[np.uint64]

START_NS = 1_700_000_000_000_000_000  # 2023-11-14: of a ride that says nothing else
FORMATS = (".blf", ".log", ".asc", ".trc", ".csv", ".mf4")
_BATCH = 10_000
_PHASE, _LOSS, _GAPS = 101, 102, 103  # streams of chance that belong to no signal


@dataclass(frozen=True)
class Dropouts:
    """Frames that the bus, and fixes that the GPS receiver, do not deliver."""

    frames: float = 1e-4  # share of the frames of each message
    gps_gap_every: float = 600.0  # s in the mean from one gap without fix to the next; 0 is never
    gps_gap: tuple[float, float] = (5.0, 20.0)  # s that a gap lasts, at least and at most


@dataclass(frozen=True)
class Stream:
    """All frames of one message: `words` are its eight bytes as little-endian numbers."""

    message: str
    identifier: int  # with flags
    times: NDArray[np.int64]  # ns
    words: Words
    dropped: int  # that were lost


def simulate_frames(vehicle: Vehicle, truth: Truth, seed: int = 0, dropouts: Dropouts = Dropouts()) -> list[Stream]:
    """The messages that the sensors of a ride send, from `START_NS` on. Raises InputError as `messages_sent` does."""
    sensors = {sensor.signal: sensor for sensor in (*SENSORS, *(ROLLER if truth.on_dynamometer else ()))}
    roller = {sensor.signal for sensor in (() if truth.on_dynamometer else ROLLER)}
    return [
        _send(vehicle, message, sensors, truth, seed, dropouts)
        for message in messages_sent(vehicle)
        if not roller & {signal.name for signal in message.signals}
    ]


def messages_sent(vehicle: Vehicle) -> list[Message]:
    """The messages of which frames can be simulated.

    InputError if the vehicle's DBC files have no signal of the sensors, or a message has no period or cannot be
    packed.
    """
    known, periods = {sensor.signal for sensor in (*SENSORS, *ROLLER)}, vehicle.mapping.periods
    messages = vehicle.mapping.database.messages
    found = [message for message in messages if known & {signal.name for signal in message.signals}]
    if not found:
        raise vehicle.error(
            "--frames simulates the reference scooter's sensors, and none of their signals (BMS_PackVoltage, "
            "INV_MotorSpeed, ...) is in its DBC files: how the sensors of another bus err is not known"
        )
    for message in found:
        if message.name not in periods:
            raise vehicle.error(
                f"message {message.name}: its DBC file gives no GenMsgCycleTime, the period of its frames"
            )
    sent = [message for message in messages if message.name in periods]
    for message in sent:
        if message.length != 8 or message.is_multiplexed() or not all(map(_can_be_packed, message.signals)):
            raise vehicle.error(
                f"message {message.name}: simulated frames have eight bytes and little-endian integers, not multiplexed"
            )
    return sent


def _can_be_packed(signal: Signal) -> bool:
    return signal.byte_order == "little_endian" and not signal.conversion.is_float


def batches(sent: list[Stream]) -> Iterator[list[Frame]]:
    """The frames in the order of their times, some thousands at once."""
    times = np.concatenate([s.times for s in sent])
    words = np.concatenate([s.words for s in sent])
    identifiers = np.concatenate([np.full(len(s.times), s.identifier, dtype=np.int64) for s in sent])
    order = np.lexsort((identifiers, times))
    for begin in range(0, len(order), _BATCH):
        part = order[begin : begin + _BATCH]
        data = words[part].astype("<u8").tobytes()
        yield [
            (time, identifier, data[8 * i : 8 * i + 8], 0)
            for i, (time, identifier) in enumerate(zip(times[part].tolist(), identifiers[part].tolist(), strict=True))
        ]


def check_output(out: Path) -> str:
    """The format of `out` by its suffix; InputError if frames cannot be written into it."""
    last = out.suffix.lower()
    suffix = out_suffix(out) if last in (".gz", *FORMATS) else last
    if suffix not in FORMATS:
        raise InputError(f"{out}: frames are written as {' '.join(FORMATS)}{nearest(suffix, FORMATS)}")
    return suffix


def write_frames(out: Path, sent: list[Stream]) -> int:
    """Write the frames in the format of the suffix of `out`; returns how many. InputError for an unknown suffix."""
    return write_frames_as(out, check_output(out), batches(sent))


def _send(
    vehicle: Vehicle, message: Message, sensors: dict[str, SimulatedSensor], truth: Truth, seed: int, dropouts: Dropouts
) -> Stream:
    period_ns = round(vehicle.mapping.periods[message.name] * 1e9)
    rng = np.random.default_rng([seed, message.frame_id, _PHASE])
    phase_us = int(rng.integers(0, period_ns // 1000))  # whole µs: candump has no more
    span_ns = round(truth.count * truth.dt * 1e9)
    offsets = np.arange(phase_us * 1000, span_ns, period_ns, dtype=np.int64)
    seconds: Floats = offsets.astype(float) * 1e-9
    no_fix = np.zeros(len(offsets), dtype=bool)
    if message.name in GPS_MESSAGES:
        for begin, end in _gps_gaps(truth, seed, dropouts):
            no_fix |= (seconds >= begin) & (seconds < end)
    protection = vehicle.mapping.protection.get(message.name)
    counter = protection.counter if protection else None
    crc = protection.crc if protection else None
    words = np.zeros(len(offsets), dtype=np.uint64)
    raw: NDArray[np.int64]
    used = 0
    for index, signal in enumerate(message.signals):
        mask = 2**signal.length - 1
        used |= mask << signal.start
        if signal.name == crc:
            continue
        if signal.name == counter:
            low, high = raw_range(signal, not_available=True)
            raw = np.arange(len(offsets), dtype=np.int64) % int(high - low + 1) + int(low)
        elif signal.name.startswith("IMU_") and signal.name.endswith("Counter"):
            # as the real one: never the code for no value
            raw = np.minimum(np.arange(len(offsets), dtype=np.int64) % 256, 254)
        else:
            rng = np.random.default_rng([seed, message.frame_id, index])
            values = _values(sensors.get(signal.name), truth, seconds, period_ns * 1e-9, rng)
            raw = _raw(signal, _without_fix(signal.name, values, no_fix))
        words |= (raw & mask).astype(np.uint64) << np.uint64(signal.start)
    words |= np.uint64((2**64 - 1) & ~used)  # bits without a signal are ones
    if crc:
        words = _seal(words)
    kept = np.random.default_rng([seed, message.frame_id, _LOSS]).random(len(offsets)) >= dropouts.frames
    identifier = message.frame_id | (EFF_FLAG if message.is_extended_frame else 0)
    return Stream(message.name, identifier, START_NS + offsets[kept], words[kept], int((~kept).sum()))


def _values(
    sensor: SimulatedSensor | None, truth: Truth, seconds: Floats, period: float, rng: np.random.Generator
) -> Floats:
    """The sensor's readings at `seconds`, in the unit of the DBC; NaN without a sensor."""
    if sensor is None:
        return np.full(len(seconds), np.nan)
    steps = np.clip(((seconds - latency(sensor, truth.parameters)) / truth.dt + 1e-6).astype(int), 0, truth.count - 1)
    values: Floats = sensor.read(truth)[steps]
    sd = spread(sensor, truth.parameters)
    if sd:
        noise = rng.standard_normal(len(seconds))
        if sensor.noise_time:
            keep = np.exp(-period / sensor.noise_time)  # a first-order process of constant variance
            fresh = np.sqrt(1 - keep * keep)
            for i in range(1, len(noise)):
                noise[i] = keep * noise[i - 1] + fresh * noise[i]
        rough = shaken(sensor, truth, period)
        values = values + (sd if rough is None else np.hypot(sd, rough[steps])) * noise
    turn = TURNS.get(sensor.signal)
    return values % turn if turn else values


def _without_fix(signal: str, values: Floats, no_fix: NDArray[np.bool_]) -> Floats:
    if not no_fix.any():
        return values
    return np.where(no_fix, 0.0 if signal in ("GPS_Fix", "GPS_Satellites") else np.nan, values)


def _raw(signal: Signal, values: Floats) -> NDArray[np.int64]:
    """The nearest raw values within the limits; the code for not available in place of NaN."""
    low, high = raw_range(signal, not_available=True)
    absent = -(2 ** (signal.length - 1)) if signal.is_signed else 2**signal.length - 1
    scale, offset = float(signal.conversion.scale), float(signal.conversion.offset)
    raw = np.clip(np.round((values - offset) / scale), low, high)
    return np.where(np.isnan(values), absent, raw).astype(np.int64)


def _seal(words: Words) -> Words:
    """`words` with the CRC-8 SAE J1850 of their first seven bytes as the last."""
    constant, tables = sae_j1850_tables(7)
    crc = np.full(len(words), constant, dtype=np.uint64)
    for i, table in enumerate(tables):
        crc ^= np.frombuffer(table, np.uint8).astype(np.uint64)[(words >> np.uint64(8 * i)) & np.uint64(0xFF)]
    return (words & np.uint64(2**56 - 1)) | crc << np.uint64(56)


def _gps_gaps(truth: Truth, seed: int, dropouts: Dropouts) -> Any:
    """(begin, end) [s] of each time without a fix; on a dynamometer, indoors, all of the ride."""
    duration = truth.count * truth.dt
    if truth.on_dynamometer:
        return np.array([(0.0, duration)])
    rng = np.random.default_rng([seed, _GAPS])
    gaps = []
    at = 0.0
    while dropouts.gps_gap_every > 0:
        at += rng.exponential(dropouts.gps_gap_every)
        if at >= duration:
            break
        end = at + rng.uniform(*dropouts.gps_gap)
        gaps.append((at, end))
        at = end
    return np.array(gaps).reshape(-1, 2)
