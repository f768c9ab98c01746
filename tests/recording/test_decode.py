"""Decoding by columns gives what the live codec gives frame by frame: values, faults and everything else it counts."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gz_onboard.can.codec import CONFLICT, LONGEST_PAUSE_NS, TIME, Codec
from gz_onboard.can.layout import crc8_sae_j1850
from gz_onboard.can.mapping import BusMapping, read_mapping
from gz_onboard.events import EFF_FLAG, ERR_FLAG, RTR_FLAG, TRANSMITTED, Frame
from gz_onboard.recording.decode import decode_columns
from gz_onboard.recording.frames import FrameColumns
from gz_onboard.recording.logs import read_log
from gz_onboard.toml import Table
from gz_onboard.vehicle import read_vehicle
from tests.events import events_of
from tests.polled import STEADY, exchange, kona, request
from tests.support import EPOCH, LOGS, MS, S

DAY = 86_400 * S
COUNTED = ("faults", "lost", "unknown", "unknown_others", "copies", "error_frames", "received", "latest", "leaps")
LEFT = (*COUNTED, "wrong_lengths", "origin_ns", "last_ns")
"""What a codec is left with."""


def live(frames: Sequence[Frame], codec: Codec) -> dict[str, list[tuple[float, float]]]:
    """(time [s], value) by role, of the live codec; the columns' times never decrease."""
    found: dict[str, list[tuple[float, float]]] = {}
    for time, group, values in events_of(codec, frames):
        for role, value in zip(codec.groups[group].roles, values, strict=True):
            if value is not None:
                samples = found.setdefault(role, [])
                samples.append((max(time, samples[-1][0]) if samples else time, value))
    return found


def assert_alike(mapping: BusMapping, frames: Sequence[Frame]) -> Codec:
    """Decode `frames` both ways; return the codec that did it by columns."""
    one_by_one, together = Codec(mapping, LONGEST_PAUSE_NS), Codec(mapping, LONGEST_PAUSE_NS)
    expected = live(frames, one_by_one)
    columns = decode_columns(FrameColumns.of(frames), together)
    found = {role: list(zip(*(array.tolist() for array in column), strict=True)) for role, column in columns.items()}
    assert found == expected
    for name in LEFT:
        assert getattr(together, name) == getattr(one_by_one, name), name
    assert together.origins.conflicts == one_by_one.origins.conflicts
    for message in mapping.database.messages:
        assert sorted(together.heard(message.name)) == sorted(one_by_one.heard(message.name))
    return together


# --- any layout, any frames ---------------------------------------------------------------------------------------

ROLES = ("pack_voltage", "pack_current", "cell_temperature", "throttle", "motor_speed", "accel_x", "odometer", "rate_z")
UNITS = ("V", "A", "degC", "", "rad/s", "m/s^2", "m", "rad/s")


@st.composite
def message(draw: st.DrawFn, number: int, roles: dict[str, str]) -> tuple[str, str, int]:
    """(DBC text, options, length) of a message, protected or not; `roles` gets the signals that play one."""
    length = draw(st.sampled_from([1, 2, 3, 5, 7, 8, 8, 8, 12, 64]))
    used: set[int] = set()
    lines: list[str] = []
    options: list[str] = []
    floats: list[str] = []
    if length > 2 and draw(st.booleans()):
        used.update(range(8 * length - 8, 8 * length))
        lines.append(f' SG_ Check{number} : {8 * length - 8}|8@1+ (1,0) [0|255] "" A')
        options.append(f'crc = "Check{number}"')
    if length > 2 and draw(st.booleans()):
        size = draw(st.integers(2, 8))
        used.update(range(size))
        lines.append(f' SG_ Count{number} : 0|{size}@1+ (1,0) [0|{draw(st.sampled_from([0, 2**size - 2]))}] "" A')
        options.append(f'counter = "Count{number}"')
    if draw(st.booleans()) and options:
        options.append("period = 0.1")
    pages = draw(st.booleans()) and length > 3
    if pages:
        used.update(range(8, 12))
        lines.append(f' SG_ Page{number} M : 8|4@1+ (1,0) [0|15] "" A')
    for i in range(draw(st.integers(1, 8))):
        is_float = draw(st.integers(0, 5)) == 0
        order, size = draw(st.integers(0, 1)), draw(st.sampled_from([32, 64]) if is_float else st.integers(1, 64))
        start = draw(st.integers(0, 8 * length - 1))
        first = start // 8 * 8 + 7 - start % 8
        counted = range(start, start + size) if order else range(first, first + size)
        bits = [*counted] if order else [b // 8 * 8 + 7 - b % 8 for b in counted]
        if max(bits) >= 8 * length or used.intersection(bits):
            continue
        used.update(bits)
        sign, name = "-" if is_float else draw(st.sampled_from("+-")), f"S{number}_{i}"
        page = f" m{draw(st.integers(0, 2))}" if pages and draw(st.booleans()) else ""
        scale, offset = draw(st.sampled_from([1, 0.5, 0.1, -0.01, 3, 1e-7])), draw(st.sampled_from([0, -40, 0.5]))
        low, high = draw(st.sampled_from([(0, 0), (0, 100), (-40, 214.5), (-1e6, 1e6)]))
        role = next((k for k, known in enumerate(ROLES) if known not in roles), None)
        unit = "" if role is None else UNITS[role]
        lines.append(f' SG_ {name}{page} : {start}|{size}@{order}{sign} ({scale},{offset}) [{low}|{high}] "{unit}" A')
        if is_float:
            floats.append(f"SIG_VALTYPE_ {256 + number} {name} : {size // 32};")
        if role is not None and draw(st.integers(0, 4)):
            roles[ROLES[role]] = name
    lines = lines or [f' SG_ Nothing{number} : 0|1@1+ (1,0) [0|1] "" A']
    text = "\n".join([f"BO_ {256 + number} M{number}: {length} A", *lines, ""])
    return text + "\n".join(floats), "\n".join(options), length


@st.composite
def buses(draw: st.DrawFn) -> tuple[str, str, list[int]]:
    """(DBC file, vehicle file, length of each message)."""
    roles: dict[str, str] = {}
    made = [draw(message(number, roles)) for number in range(draw(st.integers(1, 3)))]
    values = [line for text, _, _ in made for line in text.splitlines() if line.startswith("SIG_")]
    layouts = ["\n".join(x for x in text.splitlines() if not x.startswith("SIG_")) for text, _, _ in made]
    dbc = "\n\n".join(['VERSION "1"\nNS_ :\nBS_:\nBU_: A', *layouts, "\n".join(values), ""])
    options = [f"[bus.messages.M{number}]\n{text}" for number, (_, text, _) in enumerate(made) if text]
    codes = draw(st.sampled_from(["", 'not_available = "none"']))
    named = [f'{role} = "{name}"' for role, name in roles.items()]
    vehicle = "\n".join(['dbc = ["v.dbc"]', "[bus]", codes, *options, "[roles]", *named, ""])
    return dbc, vehicle, [length for _, _, length in made]


steps = st.one_of(
    st.integers(0, 200 * MS),
    st.integers(0, 2 * S),
    st.integers(-60 * MS, 0),
    st.integers(-40 * S, 40 * S),
    st.sampled_from([-DAY, 29 * S, 31 * S, 29 * DAY, 31 * DAY, 1000 * DAY]),
)


@st.composite
def recordings(draw: st.DrawFn, lengths: list[int]) -> list[Frame]:
    """Frames of these messages with what can be wrong with them."""
    counters = [0] * len(lengths)
    frames: list[Frame] = []
    for _ in range(draw(st.integers(0, 40))):
        number = draw(st.integers(0, len(lengths) - 1))
        n = lengths[number]
        data = bytearray(draw(st.one_of(st.binary(min_size=n, max_size=n), st.sampled_from([bytes(n), b"\xff" * n]))))
        counters[number] += draw(st.sampled_from([1, 1, 1, 1, 0, 2, 3, 9]))
        if n > 2 and draw(st.integers(0, 4)):
            data[0] = counters[number] % draw(st.sampled_from([3, 4, 15, 16, 255]))
        if n > 2 and draw(st.integers(0, 4)):
            data[-1] = crc8_sae_j1850(bytes(data[:-1]))
        if draw(st.integers(0, 9)) == 0:
            data = data[:-1]
        identifier = draw(
            st.sampled_from([256 + number] * 12 + [256 + number | EFF_FLAG, 256 | RTR_FLAG, 4 | ERR_FLAG, 0x7FF])
        )
        channel = draw(st.sampled_from([0] * 20 + [1, TRANSMITTED]))
        frames.append((0, identifier, bytes(data), channel))
    start = draw(st.sampled_from([0, EPOCH, 2**62]))
    times = accumulate(
        (draw(st.integers(0, 100 * MS) if draw(st.integers(0, 5)) else steps) for _ in frames), initial=start + 100 * MS
    )
    stamped = [(min(max(time, 0), 2**63 - 1), *frame[1:]) for time, frame in zip(times, frames, strict=False)]
    return [(start, 0x7FF, b"", 0), (start + 100 * MS, 0x7FF, b"", 0), *stamped]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("any")


@settings(deadline=None, max_examples=200, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(bus=buses(), data=st.data())
def test_any_frames_of_any_layout(folder: Path, bus: tuple[str, str, list[int]], data: st.DataObject) -> None:
    dbc, vehicle, lengths = bus
    (folder / "v.dbc").write_text(dbc)
    (folder / "v.toml").write_text(vehicle)
    assert_alike(read_mapping(Table.read(folder / "v.toml")), data.draw(recordings(lengths)))


# --- what is rare -------------------------------------------------------------------------------------------------

TWO_BUSES = """VERSION "1"
NS_ :
BS_:
BU_: A
BO_ 256 Pack: 8 A
 SG_ Volts : 0|16@1+ (0.1,0) [0|1000] "V" A
"""


def pack_at(time_ms: int, volts: int, channel: int) -> Frame:
    return EPOCH + time_ms * MS, 256, struct.pack("<Hxxxxxx", volts), channel


@pytest.mark.parametrize("other", [0, 3, 500])
def test_a_message_on_two_channels(tmp_path: Path, other: int) -> None:
    """other: by how much the second channel differs; the first falls silent after 5 s."""
    (tmp_path / "v.dbc").write_text(TWO_BUSES)
    (tmp_path / "v.toml").write_text('dbc = ["v.dbc"]\n[roles]\npack_voltage = "Volts"\n')
    mapping = read_mapping(Table.read(tmp_path / "v.toml"))
    frames = [pack_at(100 * i, 3600 + i, 0) for i in range(50)]
    frames += [pack_at(100 * i + 1, 3600 + i + other, 1) for i in range(150)]
    codec = assert_alike(mapping, sorted(frames))
    assert bool(codec.origins.conflicts) == (("Pack", CONFLICT) in codec.faults) == bool(other)
    assert codec.copies > 0


def test_answers_to_requests_of_another_tester() -> None:
    frames = [frame for i in range(30) for frame in exchange(request("Battery"), EPOCH + i * S, **STEADY)]
    frames.insert(20, (frames[20][0], *frames[22][1:]))
    codec = assert_alike(kona().mapping, frames)
    assert "Battery" in codec.latest


def test_a_babbling_node() -> None:
    mapping = read_vehicle("reference").mapping
    babble: list[Frame] = [(EPOCH + i * 1000, EFF_FLAG | i, b"", 0) for i in range(5000)]
    codec = assert_alike(mapping, [*babble, (EPOCH + 10 * MS, 1056, bytes(8), 0)])
    assert codec.unknown_others


@pytest.mark.parametrize("log", ["city_14C.blf", "full_discharge.mcap"])
def test_a_recorded_ride(log: str) -> None:
    frames = read_log(LOGS / log)[:100_000]
    codec = assert_alike(read_vehicle("reference").mapping, frames.tuples())
    assert codec.received == len(frames)


def test_a_clock_that_is_set_and_stamps_that_are_wrong() -> None:
    frames = read_log(LOGS / "city_14C.blf")[:30_000]
    times = frames.time_ns.copy()
    times[10_000:] -= 3 * DAY
    times[20_000:] += 40 * S
    times[5000:25_000:500] += 20 * DAY
    shifted = FrameColumns(times, *(getattr(frames, name) for name in ("identifier", "channel", "length", "data")))
    codec = assert_alike(read_vehicle("reference").mapping, shifted.tuples())
    assert len(codec.leaps) == 1 and codec.faults["", TIME] >= 40
