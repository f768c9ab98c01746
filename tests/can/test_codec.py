from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from cantools.database.can import Database
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gz_onboard.can.codec import CONFLICT, COUNTER, CRC, LENGTH, LONGEST_PAUSE_NS, NOT_AVAILABLE, RANGE, TIME, Codec
from gz_onboard.can.layout import crc8_sae_j1850, identifiers_of
from gz_onboard.can.mapping import BusMapping, Source, read_mapping
from gz_onboard.events import EFF_FLAG, ERR_FLAG, PLAUSIBLE, ROLES, RTR_FLAG, Frame
from gz_onboard.export.decoder import Decoder
from gz_onboard.toml import Table
from gz_onboard.vehicle import read_vehicle
from tests.events import Event, events_of

MS = 1_000_000
S = 1_000_000_000
DAY = 86_400 * S
EPOCH = 1_700_000_000 * S


@pytest.fixture(autouse=True, scope="module")
def any_value() -> Iterator[None]:
    """Signals play roles of other kinds here: what is plausible for those says nothing (test_plausible.py has it)."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gz_onboard.can.layout.PLAUSIBLE", dict.fromkeys(PLAUSIBLE, (-math.inf, math.inf)))
        patch.setattr("gz_onboard.can.layout.PLAUSIBLE_OF", {})
        yield


@cache
def reference() -> BusMapping:
    return read_vehicle("reference").mapping


def mapping_of(folder: Path, dbc: str, roles: str, bus: str = "") -> BusMapping:
    (folder / "v.dbc").write_text(f'VERSION "1"\nNS_ :\nBS_:\nBU_: A\n{dbc}\n', encoding="utf-8")
    (folder / "v.toml").write_text(f'dbc = ["v.dbc"]\n[bus]\n{bus}\n[roles]\n{roles}\n', encoding="utf-8")
    return read_mapping(Table.read(folder / "v.toml"))


def protected(message: str, counter: int, **signals: float) -> bytes:
    """Data of a message of the reference scooter with its counter and checksum; other signals are 0."""
    definition = reference().database.get_message_by_name(message)
    values = {signal.name: 0.0 for signal in definition.signals} | signals
    values[f"{message}Counter"] = counter
    data = bytearray(definition.encode(values, strict=False))
    data[-1] = crc8_sae_j1850(bytes(data[:-1]))
    return bytes(data)


def pack(counter: int, time_ns: int, **signals: float) -> tuple[int, int, bytes, int]:
    return time_ns, 0x200, protected("BMS_Pack", counter, **signals), 0


def temperatures(time_ns: int, ambient: float = 20.0) -> tuple[int, int, bytes, int]:
    return time_ns, 1056, struct.pack("<hhhh", round(ambient * 10), 0, 0, 0), 0


def value_of(codec: Codec, event: Event, role: str):
    return dict(zip(codec.groups[event[1]].roles, event[2], strict=True))[role]


# --- layouts: the same as cantools ----------------------------------------------------------------------------


def mapping_of_all(database: Database, message_name: str) -> BusMapping:
    """Each signal of a message plays some role, in the unit of the DBC."""
    message = database.get_message_by_name(message_name)
    sources = tuple(
        Source(role, message_name, s.name, float(s.conversion.scale), float(s.conversion.offset))
        for role, s in zip(ROLES, message.signals, strict=False)
    )
    assert len(sources) == len(message.signals)
    return BusMapping(database, (), sources, {}, {})


def expected(message, signal, raw):
    """By the words of the documentation, in floating point and without the codec's tables of limits."""
    if signal.length >= 8 and raw == (-(2 ** (signal.length - 1)) if signal.is_signed else 2**signal.length - 1):
        return None
    value = raw * signal.scale + signal.offset
    if signal.minimum is not None and signal.maximum is not None and signal.minimum < signal.maximum:
        slack = 1e-3 * abs(signal.scale)
        if not signal.minimum - slack <= value <= signal.maximum + slack:
            return None
    return value


def assert_like_cantools(codec: Codec, message, data: bytes, time_ns: int) -> None:
    (event,) = events_of(codec, [(time_ns, message.frame_id, data, 0)])
    raw = message.decode(data, decode_choices=False, scaling=False)
    assert len(event[2]) == len(message.signals)
    for signal, value in zip(message.signals, event[2], strict=True):
        want = expected(message, signal, raw[signal.name])
        if want is None:
            assert value is None, (signal, raw[signal.name])
        else:
            assert value == pytest.approx(want, rel=1e-12, abs=1e-12), (signal, raw[signal.name])


@st.composite
def layouts(draw: st.DrawFn) -> str:
    """The DBC of a message of up to ten signals anywhere in it."""
    length = draw(st.sampled_from([1, 2, 3, 5, 7, 8, 8, 8, 12, 64]))
    used: set[int] = set()
    lines = []
    one_order = draw(st.sampled_from([0, 1, None]))
    for i in range(draw(st.integers(1, 10))):
        order = draw(st.integers(0, 1)) if one_order is None else one_order
        size = draw(st.one_of(st.sampled_from([8, 16, 32]), st.integers(1, 64)))
        start = draw(st.integers(0, 8 * length - 1))
        if order:  # little-endian: bits count up
            bits = [*range(start, start + size)]
        else:  # big-endian: down within the byte, then on to the next byte
            first = start // 8 * 8 + 7 - start % 8
            bits = [b // 8 * 8 + 7 - b % 8 for b in range(first, first + size)]
        if max(bits) >= 8 * length or used.intersection(bits):
            continue
        used.update(bits)
        sign = draw(st.sampled_from("+-"))
        scale = draw(st.sampled_from([1, 0.5, 0.1, 0.001, -0.01, 3, 1e-7]))
        offset = draw(st.sampled_from([0, -40, 0.5, 1000]))
        low, high = draw(st.sampled_from([(0, 0), (0, 100), (-40, 214.5), (-1e6, 1e6), (200, 100)]))
        lines.append(f' SG_ S{i} : {start}|{size}@{order}{sign} ({scale},{offset}) [{low}|{high}] "" A')
    lines = lines or [' SG_ S : 0|1@1+ (1,0) [0|1] "" A']
    return "\n".join(['VERSION "1"', "NS_ :", "BS_:", "BU_: A", f"BO_ 256 M: {length} A", *lines, ""])


@settings(deadline=None, max_examples=200, suppress_health_check=[HealthCheck.too_slow])
@given(layouts(), st.data())
def test_any_layout_is_decoded_as_by_cantools(dbc, data):
    database = Database()
    database.add_dbc_string(dbc)
    message = database.get_message_by_name("M")
    codec = Codec(mapping_of_all(database, "M"))
    n = message.length
    frames = data.draw(st.lists(st.binary(min_size=n, max_size=n), min_size=1, max_size=5))
    for i, frame in enumerate([*frames, bytes(n), b"\xff" * n, b"\x80" + bytes(n - 1), bytes(n - 1) + b"\x80"]):
        assert_like_cantools(codec, message, frame, i * MS)


# --- not available --------------------------------------------------------------------------------------------


DBC_SHORT = """BO_ 256 M: 8 A
 SG_ Byte : 0|8@1+ (1,-40) [0|0] "degC" A
 SG_ Bits : 8|7@1+ (1,0) [0|0] "" A
 SG_ Word : 16|16@1- (0.1,0) [0|0] "A" A
"""
ROLES_SHORT = 'cell_temperature = "Byte"\nthrottle = "Bits"\npack_current = "Word"'


def test_without_such_codes_all_ones_are_a_number(tmp_path):
    data = b"\xff\x7f\x00\x80\x00\x00\x00\x00"
    with_codes = Codec(mapping_of(tmp_path, DBC_SHORT, ROLES_SHORT))
    without = Codec(mapping_of(tmp_path, DBC_SHORT, ROLES_SHORT, 'not_available = "none"'))
    assert events_of(with_codes, [(0, 256, data, 0)])[0][2] == (None, 127.0, None)  # 7 bits are too few for a code
    assert events_of(without, [(0, 256, data, 0)])[0][2] == pytest.approx((215.0, 127.0, -3276.8))


# --- protection -----------------------------------------------------------------------------------------------


@given(st.integers(0, 55), st.integers(0, 14), st.integers(0, 65000))
def test_a_flipped_bit_drops_the_frame(bit, counter, raw):
    codec = Codec(reference())
    data = bytearray(protected("BMS_Pack", counter, BMS_PackVoltage=raw / 1000))
    data[bit // 8] ^= 1 << bit % 8
    assert events_of(codec, [(EPOCH, 0x200, bytes(data), 0)]) == []
    assert codec.faults == {("BMS_Pack", CRC): 1}
    assert codec.latest == {}


def test_after_a_pause_any_counter_is_good_but_not_one_that_cannot_be():
    codec = Codec(reference())
    frames = [pack(5, EPOCH), pack(5, EPOCH + 1100 * MS), pack(15, EPOCH + 2300 * MS), pack(6, EPOCH + 2400 * MS)]
    assert len(events_of(codec, frames)) == 3
    assert codec.faults == {("BMS_Pack", COUNTER): 1}
    assert not codec.lost


@given(st.lists(st.integers(0, 15), min_size=1, max_size=60))
def test_counters_by_their_rule(counters):
    codec = Codec(reference())
    last: int | None = None
    lost = wrong = 0
    for i, c in enumerate(counters):
        events = events_of(codec, [pack(c, EPOCH + i * 100 * MS)])
        step = 1 if last is None else (c - last) % 15
        good = c <= 14 and 1 <= step <= 7
        if c <= 14:
            last = c
        assert len(events) == good
        lost += step - 1 if good else 0
        wrong += not good
    if counters.count(15) < 9:  # ten periods of nothing good are a pause
        assert codec.lost.get("BMS_Pack", 0) == lost
        assert codec.faults.get(("BMS_Pack", COUNTER), 0) == wrong


# --- lengths, remote and error frames, unknown identifiers -----------------------------------------------------


@pytest.mark.parametrize("length", [0, 7, 9, 64])
def test_a_wrong_length_drops_the_frame(length):
    codec = Codec(reference())
    for identifier in (0x101, 0x200, 0x411):  # plain, protected, without a role
        assert events_of(codec, [(EPOCH, identifier, bytes(length), 0)]) == []
    assert codec.faults == {("INV_Power", LENGTH): 1, ("BMS_Pack", LENGTH): 1, ("HBM_Chassis", LENGTH): 1}
    assert codec.latest == {}


def test_remote_and_error_frames_and_other_identifiers_are_no_data():
    codec = Codec(reference())
    others = [0x101 | RTR_FLAG, 0x101 | EFF_FLAG]  # 29 bits are another identifier than 11
    frames = [(EPOCH, identifier, bytes(8), 0) for identifier in (*others, 0x4 | ERR_FLAG)]
    assert events_of(codec, frames * 3) == []
    assert codec.error_frames == 3
    assert codec.unknown == dict.fromkeys(others, 3)
    assert not codec.faults


def test_a_babbling_node_does_not_fill_the_memory():
    codec = Codec(reference())
    count = 20_000
    frames = [(EPOCH, EFF_FLAG | i, b"", 0) for i in range(count)]
    assert events_of(codec, frames) == []
    assert events_of(codec, [temperatures(EPOCH + MS)])
    assert len(codec.unknown) < 5000
    assert sum(codec.unknown.values()) + codec.unknown_others == count
    assert sum(map(len, codec._inboxes.values())) < 5000
    assert len(codec.latest) == 1


# --- time -----------------------------------------------------------------------------------------------------


def test_two_channels_may_overtake_each_other_a_little():
    codec = Codec(reference())
    offsets = [0, 30, 10, 40, 20, 60, 15]
    events = events_of(codec, [temperatures(EPOCH + ms * MS) for ms in offsets])
    assert [round(time * 1e3) for time, _, _ in events] == offsets
    assert not codec.faults


@pytest.mark.parametrize("odd", [-EPOCH, -S, 31 * S, 2**62])
def test_single_odd_stamps_are_dropped_however_many(odd):
    codec = Codec(reference())
    frames = []
    for i in range(50):
        frames.append(temperatures(EPOCH + i * 100 * MS))
        if i % 5 == 2:
            frames.append(temperatures(EPOCH + i * 100 * MS + odd))
    events = events_of(codec, frames)
    assert [time for time, _, _ in events] == pytest.approx([i * 0.1 for i in range(50)])
    assert codec.faults == {("", TIME): 10}


def test_a_clock_set_back_does_not_turn_the_timeline_back():
    codec = Codec(reference())
    frames = [temperatures(EPOCH + i * 100 * MS) for i in range(10)]
    frames += [temperatures(EPOCH - 3600 * S + i * 100 * MS) for i in range(10)]
    times = [time for time, _, _ in events_of(codec, frames)]
    assert len(times) == 18  # two to make sure
    assert times == sorted(times)
    assert times[-1] == pytest.approx(0.9 + 0.7)
    assert codec.faults == {("", TIME): 2}


@pytest.mark.parametrize("days", [31, 20_000, -20_000])
def test_in_a_log_a_leap_of_a_month_is_a_clock_that_was_set(days):
    frames = [temperatures(EPOCH + 20_000 * DAY + i * 100 * MS) for i in range(10)]
    frames += [temperatures(EPOCH + (20_000 + days) * DAY + i * 100 * MS) for i in range(10)]
    codec = Codec(reference(), LONGEST_PAUSE_NS)
    times = [time for time, _, _ in events_of(codec, frames)]
    assert times == sorted(times)
    assert times[-1] == pytest.approx(0.9 + 0.7)
    ((when, leap),) = codec.leaps
    assert when == pytest.approx(0.9)
    assert leap == pytest.approx(days * 86_400.0, abs=1.0)
    live = Codec(reference())  # where a pause may be of any length
    assert max(time for time, _, _ in events_of(live, frames)) == pytest.approx(max(days, 0) * 86_400.0, abs=2.0)


# --- SAE J1939 -------------------------------------------------------------------------------------------------

J1939 = f"""BO_ {0x0CF00400 | 1 << 31} EEC1: 8 A
 SG_ EngineSpeed : 24|16@1+ (0.125,0) [0|8031.875] "rpm" A

BO_ {0x18EA0000 | 1 << 31} Request: 3 A
 SG_ Group : 0|24@1+ (1,0) [0|0] "" A

BO_ 256 Plain: 8 A
 SG_ Volts : 0|16@1+ (0.1,0) [0|1000] "V" A
"""


def test_j1939_goes_by_the_parameter_group(tmp_path):
    roles = 'motor_speed = "EngineSpeed"\nthrottle = "Group"\npack_voltage = "Volts"'
    mapping = mapping_of(tmp_path, J1939, roles, 'identifiers = "j1939"')
    codec = Codec(mapping)
    speed = bytes([0xFF, 0xFF, 0xFF, 0x40, 0x1F, 0xFF, 0xFF, 0xFF])  # 8000 * 0.125 = 1000 rpm
    for identifier in (0x0CF00431, 0x0CF00400, 0x18F00400):  # another sender until its own is heard; another priority
        (event,) = events_of(codec, [(0, identifier | EFF_FLAG, speed, 0)])
        assert value_of(codec, event, "motor_speed") == pytest.approx(1000 * 2 * math.pi / 60)
        assert codec.latest["EEC1"] == (0, identifier | EFF_FLAG, speed, 0)
    assert codec.values("EEC1", speed) == {"EngineSpeed": 1000.0}
    assert events_of(codec, [(0, 0x0CF00431 | EFF_FLAG, speed, 0)]) == []
    assert codec.copies == 1
    for identifier in (0x18EA0021, 0x18EAFF21):  # PDU1: the destination is no part of the group
        (event,) = events_of(codec, [(0, identifier | EFF_FLAG, b"\x05\x00\x00", 0)])
        assert value_of(codec, event, "throttle") == 5.0
    (event,) = events_of(codec, [(0, 256, b"\x64\x00" + bytes(6), 0)])
    assert value_of(codec, event, "pack_voltage") == pytest.approx(10.0)
    for identifier in (0x0CF00500 | EFF_FLAG, 0x0CF00400 | EFF_FLAG | RTR_FLAG, 0x400):
        assert events_of(codec, [(0, identifier, speed, 0)]) == []
    assert len(codec.unknown) == 3
    assert identifiers_of(mapping) is None


TWO_BUSES = """BU_: A
BO_ 256 Pack: 8 A
 SG_ Volts : 0|16@1+ (0.1,0) [0|1000] "V" A
"""


def on_two_buses(pairs: list[tuple[int, int]]) -> list[Frame]:
    """A frame on channel 0 and, a millisecond later, one on channel 1, ten times a second."""
    frames: list[Frame] = []
    for i, values in enumerate(pairs):
        frames += [
            (i * 100 * MS + c * MS, 256, value.to_bytes(2, "little") + bytes(6), c) for c, value in enumerate(values)
        ]
    return frames


@pytest.mark.parametrize("late", [0, 1, 3])
def test_copies_from_a_gateway_are_taken_once(tmp_path, late):
    """late: by so many frames."""
    codec = Codec(mapping_of(tmp_path, TWO_BUSES, 'pack_voltage = "Volts"'))
    volts = [3600 + i for i in range(50)]
    events = events_of(codec, on_two_buses(list(zip(volts[late:], volts, strict=False))))
    assert [event[2][0] for event in events] == [pytest.approx(v / 10) for v in volts[late:]]
    assert not codec.origins.conflicts and not codec.faults
    assert codec.copies == 50 - late


def test_one_identifier_with_two_meanings_is_dropped_and_named(tmp_path):
    codec = Codec(mapping_of(tmp_path, TWO_BUSES, 'pack_voltage = "Volts"'))
    frames = on_two_buses([(3600 + i, 120 + i) for i in range(50)])
    events = events_of(codec, frames)
    assert len(events) <= 10
    assert codec.faults[("Pack", CONFLICT)] + codec.copies + len(events) == len(frames)
    said = codec.origins.conflicts["Pack"]
    assert said.startswith(
        "0x100 comes on channels 0 and 1 with different data (Pack): say which is meant, channel = 0"
    )


@pytest.mark.parametrize("key", ["channel = 1\n", "\n[bus.messages.Pack]\nchannel = 1\n"])
def test_the_vehicle_file_says_on_which_channel_a_message_is(tmp_path, key):
    codec = Codec(mapping_of(tmp_path, TWO_BUSES, 'pack_voltage = "Volts"', key))
    events = events_of(codec, on_two_buses([(120 + i, 3600 + i) for i in range(50)]))
    assert [event[2][0] for event in events] == [pytest.approx((3600 + i) / 10) for i in range(50)]
    assert not codec.origins.conflicts and not codec.faults


def two_senders(first: int, second: int) -> list[Frame]:
    frames: list[Frame] = []
    for i in range(50):
        for sender, value in ((first, i), (second, 100 + i)):
            frames.append((i * 100 * MS, 0x18EA0000 | EFF_FLAG | sender, bytes([value, 0, 0]), 0))
    return frames


@pytest.mark.parametrize(
    ("senders", "key", "expected"),
    [
        ((0x00, 0xF3), "", 0),  # the DBC file has 0x00
        ((0xF3, 0x00), "", 100),
        ((0xF2, 0xF3), "\n[bus.messages.Request]\nsender = 0xF3\n", 100),
    ],
)
def test_a_parameter_group_is_that_of_one_sender(tmp_path, senders, key, expected):
    codec = Codec(mapping_of(tmp_path, J1939, 'throttle = "Group"', 'identifiers = "j1939"\n' + key))
    values = [event[2][0] for event in events_of(codec, two_senders(*senders))]
    assert values[-49:] == [expected + i for i in range(1, 50)]
    assert not codec.origins.conflicts


def test_two_senders_that_nobody_names_are_a_contradiction(tmp_path):
    codec = Codec(mapping_of(tmp_path, J1939, 'throttle = "Group"', 'identifiers = "j1939"'))
    assert len(events_of(codec, two_senders(0xF2, 0xF3))) <= 10
    assert "group 0xea00 comes from senders 0xf2 and 0xf3 with different data" in codec.origins.conflicts["Request"]


# --- multiplexed and floating-point signals, which cantools decodes ----------------------------------------------

FLOATS = """BO_ 256 Floats: 8 A
 SG_ Single : 0|32@1- (0.5,1) [-100|100] "V" A
 SG_ Bare : 32|32@1- (1,0) [0|0] "A" A

BO_ 257 Double: 8 A
 SG_ Twice : 7|64@0- (1,0) [0|0] "degC" A

SIG_VALTYPE_ 256 Single : 1;
SIG_VALTYPE_ 256 Bare : 1;
SIG_VALTYPE_ 257 Twice : 2;
"""
FLOAT_ROLES = 'pack_voltage = "Single"\npack_current = "Bare"\ncell_temperature = "Twice"'


def test_a_limit_of_hundreds_of_digits_bounds_nothing(tmp_path):
    dbc = f'BO_ 256 M: 2 A\n SG_ V : 0|16@1+ (0.1,0) [-{"9" * 400}|{"9" * 400}] "V" A\n'
    codec = Codec(mapping_of(tmp_path, dbc, 'pack_voltage = "V"'))
    (event,) = events_of(codec, [(0, 256, bytes((0x20, 3)), 0)])
    assert event[2] == (80.0,)


def test_floats(tmp_path):
    codec = Codec(mapping_of(tmp_path, FLOATS, FLOAT_ROLES))
    cases = [
        (10.0, -2.5, (6.0, -2.5)),
        (math.nan, 1.0, (None, 1.0)),
        (198.0, 2.0**100, (100.0, 2.0**100)),
        (199.0, math.inf, (None, None)),
        (-math.inf, math.nan, (None, None)),
    ]
    for single, bare, want in cases:
        data = struct.pack("<ff", single, bare)
        (event,) = events_of(codec, [(0, 256, data, 0)])
        assert event[2] == want
        assert all(v is None or math.isfinite(v) for v in codec.values("Floats", data).values())
    assert codec.faults == {
        ("Floats.Single", NOT_AVAILABLE): 1,
        ("Floats.Single", RANGE): 2,
        ("Floats.Bare", RANGE): 1,
        ("Floats.Bare", NOT_AVAILABLE): 1,
    }
    assert events_of(codec, [(0, 257, struct.pack(">d", 25.25), 0)])[0][2] == (25.25,)
    assert events_of(codec, [(0, 257, struct.pack(">d", math.nan), 0)])[0][2] == (None,)
    assert events_of(codec, [(0, 257, struct.pack(">d", 1.7e308), 0)])[0][2] == (None,)
    assert events_of(codec, [(0, 256, b"1234567", 0)]) == []


MULTIPLEXED = """BO_ 256 Mux: 8 A
 SG_ Page M : 0|4@1+ (1,0) [0|15] "" A
 SG_ Volts m0 : 8|16@1+ (0.01,0) [0|100] "V" A
 SG_ Amps m0 : 24|16@1- (0.1,0) [-300|300] "A" A
 SG_ Celsius m1 : 8|8@1+ (1,-40) [-40|214] "degC" A
 SG_ Count : 48|4@1+ (1,0) [0|14] "" A
 SG_ Check : 56|8@1+ (1,0) [0|255] "" A
"""
MUX_ROLES = 'pack_voltage = "Volts"\npack_current = "Amps"\ncell_temperature = "Celsius"'
MUX_BUS = '[bus.messages.Mux]\ncrc = "Check"\ncounter = "Count"\nperiod = 0.1'


def mux(page: int, counter: int, words: bytes) -> bytes:
    data = bytes([page]) + words.ljust(5, b"\0") + bytes([counter])
    return data + bytes([crc8_sae_j1850(data)])


def test_multiplexed_signals(tmp_path):
    codec = Codec(mapping_of(tmp_path, MULTIPLEXED, MUX_ROLES, MUX_BUS))
    decode = lambda i, data: events_of(codec, [(i * 100 * MS, 256, data, 0)])  # noqa: E731
    assert decode(0, mux(0, 0, struct.pack("<Hh", 5000, -123)))[0][2] == pytest.approx((50.0, -12.3, None))
    assert decode(1, mux(1, 1, b"\x41"))[0][2] == (None, None, 25.0)
    assert decode(2, mux(0, 2, struct.pack("<Hh", 65535, 5000)))[0][2] == (None, None, None)
    assert codec.faults == {("Mux.Volts", NOT_AVAILABLE): 1, ("Mux.Amps", RANGE): 1}
    codec.faults.clear()
    assert decode(3, mux(7, 3, b"")) == []  # a page that the DBC does not have
    assert codec.faults == {}


def test_a_page_that_the_dbc_does_not_list_keeps_the_signals_of_every_page(tmp_path):
    dbc = """BO_ 256 Pack: 8 A
 SG_ Page M : 0|8@1+ (1,0) [0|255] "" A
 SG_ Cell m0 : 8|16@1+ (0.001,0) [0|5] "V" A
 SG_ Volts : 24|16@1+ (0.1,0) [0|1000] "V" A
 SG_ Amps : 47|16@0- (0.1,0) [-500|500] "A" A
"""
    roles = 'pack_voltage = "Volts"\npack_current = "Amps"\nlowest_cell_voltage = "Cell"'
    mapping = mapping_of(tmp_path, dbc, roles)
    codec = Codec(mapping)
    pages = [struct.pack("<BHH", page, 3700, 3600) + struct.pack(">h", -240) + b"\0" for page in range(20)]
    frames: list[Frame] = [(i * 100 * MS, 256, data, 0) for i, data in enumerate(pages)]
    values = [event[2] for event in events_of(codec, frames)]
    assert values[0] == pytest.approx((360.0, -24.0, 3.7))
    assert all(value == pytest.approx((360.0, -24.0, None)) for value in values[1:])
    assert not codec.faults
    rows = [row for _, _, row in Decoder(mapping).decode([frames])]
    assert [row["Cell[V]"] for row in rows] == [pytest.approx(3.7)] + [None] * 19
    assert all(row["Amps[A]"] == pytest.approx(-24.0) for row in rows)


def test_the_mean_square_of_a_window_is_that_of_its_values(tmp_path):
    dbc = 'BO_ 256 Imu: 2 A\n SG_ Up : 0|16@1- (0.01,-5) [0|0] "m/s^2" A\n'
    codec = Codec(mapping_of(tmp_path, dbc, 'accel_z = "Up"'))
    raw = [1500, 1400, 1475]
    codec.decode([(i * MS, 256, struct.pack("<h", value), 0) for i, value in enumerate(raw)])
    ((role,),) = [window.roles for window in codec.windows()]
    values = [0.01 * value - 5 for value in raw]
    assert role is not None
    assert role.mean == pytest.approx(sum(values) / 3)
    assert role.mean_square == pytest.approx(sum(value * value for value in values) / 3)
