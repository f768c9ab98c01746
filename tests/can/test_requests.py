"""Requests of a vehicle file: what is read, and what is refused with its place."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.can.codec import Codec
from gz_onboard.errors import InputError
from gz_onboard.events import EFF_FLAG
from gz_onboard.pipeline import range_publisher
from gz_onboard.vehicle import Vehicle, read_vehicle
from tests.events import events_of
from tests.polled import KONA, STEADY, carried, payload
from tests.support import EPOCH, MS

TEXT = KONA.read_text(encoding="utf-8")
LINES = TEXT.split("\n")


def changed(folder: Path, *changes: tuple[str, str]) -> Path:
    """The Kona's file, each text once replaced by another."""
    text = TEXT
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    file = folder / "kona.toml"
    file.write_text(text, encoding="utf-8")
    return file


def refusal(file: Path) -> str:
    with pytest.raises(InputError) as caught:
        range_publisher(read_vehicle(file))
    return str(caught.value)


def line(part: str, occurrence: int = 0) -> int:
    return [number for number, text in enumerate(LINES, 1) if part in text][occurrence]


@pytest.mark.parametrize("bus", ["", '[bus]\nidentifiers = "j1939"\n'])
def test_identifiers_of_29_bits_are_exact_whatever_the_bus(tmp_path: Path, bus: str):
    changes = [("0x7E4", "0x18DA10F1"), ("0x7EC", "0x18DAF110")] * 2
    vehicle = read_vehicle(changed(tmp_path, *changes, ("[roles]", f"{bus}[roles]")))
    battery, _ = vehicle.mapping.requests
    assert (battery.request, battery.response) == (0x18DA10F1 | EFF_FLAG, 0x18DAF110 | EFF_FLAG)
    for identifier, expected in ((0x18DAF110 | EFF_FLAG, 1), (0x18DAF111 | EFF_FLAG, 0), (0x110, 0)):
        parts = enumerate(carried(payload(battery, **STEADY)))
        assert (
            len(events_of(Codec(vehicle.mapping), [(EPOCH + i * MS, identifier, d, 0) for i, d in parts])) == expected
        )


def test_addresses_in_the_first_byte(tmp_path: Path):
    own = "request_address = 0x07\nresponse_address = 0xF1\nservice = 0x22"
    file = changed(
        tmp_path, ("service = 0x22", own), ("service = 0x22\ndata_identifier = 0x0105", f"{own}\ndata_identifier = 5")
    )
    vehicle = read_vehicle(file)
    battery, _ = vehicle.mapping.requests
    assert battery.addresses == (0x07, 0xF1)
    for address, expected in ((0xF1, 1), (0xF4, 0)):
        parts = enumerate(carried(payload(battery, **STEADY), address))
        assert len(events_of(Codec(vehicle.mapping), [(EPOCH + i * MS, 0x7EC, d, 0) for i, d in parts])) == expected
    other = refusal(changed(tmp_path, ("service = 0x22", own)))
    assert "0x7ec" not in other
    assert "response_identifier: is that of Battery too, which has another address" in other


@pytest.mark.parametrize(
    ("old", "new", "key", "occurrence", "said"),
    [
        (
            "service = 0x22",
            "service = 0x2E",
            "service",
            0,
            r"request.service: is 0x2e; the answers of services 0x01, 0x21, 0x22 are read",
        ),
        ("service = 0x22", "service = 0x10", "service", 0, r"request.service: is 0x10; the answers"),
        ("service = 0x22", 'service = "22"', "service", 0, r"request.service: must be a .*number, is .22."),
        ("period = 10", "perod = 10", "period = 10", 0, r"request.perod: unknown key \(did you mean 'period'\?\)"),
        ("period = 10\n", "\n", "[[request]]", 1, r"request.period: is missing"),
        ("period = 0.2", "period = 0.05", "period = 0.2", 0, r"request.period: 0.05 is outside 0.1 to 3600"),
        ("period = 0.2", "period = nan", "period = 0.2", 0, r"request.period: must be a finite number, is nan"),
        ("identifier = 0x0105", "identifier = 0x1_0105", "0x0105", 0, r"data_identifier: 65797 is outside 0 to 65535"),
        ("identifier = 0x0105", "identifier = 0x0101", "0x0105", 0, r"data_identifier: Battery asks for it too"),
        (
            "request_identifier = 0x7E4",
            "request_address = 7\nrequest_identifier = 0x7E4",
            "[[request]]",
            0,
            "is missing",
        ),
        ("length = 43", "length = 31", "BatteryCharge =", 0, r"signals.BatteryCharge.byte: reaches to byte 31"),
        ("length = 43", "length = 4093", "length = 43", 0, r"length: 4093 is outside 1 to 4092"),
        ('byte = "AF"', 'byte = "A1"', "BatteryCharge =", 0, r"byte: must be a number from 0, or A to Z, AA, AB"),
        ('byte = "AF"', "byt = 31", "BatteryCharge =", 0, r"byt: unknown key \(did you mean 'byte'\?\)"),
        ('byte = "AF", factor = 0.5', 'byte = "AF", factor = 0', "BatteryCharge =", 0, r"factor: must not be 0"),
        ("limits = [0, 100]", "limits = [100, 0]", "BatteryCharge =", 0, r"limits: must be the least and the greatest"),
        ('unit = "%"', 'unit = "bar"', "bms_state_of_charge =", 0, r"'BatteryCharge' has unit 'bar', from which"),
        ('"BatteryCharge"', '"BatteryCharg"', "bms_state_of_charge =", 0, r"did you mean 'BatteryCharge'\?"),
        ('name = "BatteryShown"', 'name = "Battery"', 'name = "BatteryShown"', 0, r"two requests are called Battery"),
        ('name = "BatteryShown"', 'name = "Battery Shown"', 'name = "BatteryShown"', 0, r"letters, digits and _"),
        ("signed = true", "signed = 1", "BatteryCurrent =", 0, r"signed: must be true or false, is 1"),
    ],
)
def test_a_mistake_is_named_with_its_place(tmp_path, old, new, key, occurrence, said):
    message = refusal(changed(tmp_path, (old, new)))
    assert re.search(said, message), message
    place = re.search(r"kona\.toml:(\d+): ", message)
    assert place, message
    lines = (tmp_path / "kona.toml").read_text().split("\n")
    assert abs(int(place[1]) - line(key, occurrence)) <= new.count("\n"), (lines[int(place[1]) - 1], message)


def test_identifiers_that_someone_has(tmp_path):
    (tmp_path / "own.dbc").write_text('VERSION ""\nBU_: A\nBO_ 2028 Old: 8 A\n SG_ x : 0|8@1+ (1,0) [0|0] "" A\n')
    message = refusal(changed(tmp_path, ("schema = 1", 'schema = 1\ndbc = ["own.dbc"]')))
    assert "0x7ec is that of message Old of the DBC files" in message
    message = refusal(changed(tmp_path, ("0x6A0", "0x7E2")))
    assert "take the identifiers of our own range frames" in message
    assert "0x7e4" in message


@settings(max_examples=60)
@given(
    st.integers(0, 12),
    st.integers(0, 7),
    st.integers(1, 64),
    st.sampled_from(["big", "little"]),
    st.booleans(),
    st.binary(min_size=24, max_size=24),
)
def test_bits_are_taken_as_a_shift_and_a_mask_take_them(tmp_path_factory, byte, bit, bits, order, signed, data):
    """Against arithmetic on the bytes of the signal as one number."""
    size = (bit + bits + 7) // 8
    whole = int.from_bytes(data[byte : byte + size], "big" if order == "big" else "little")
    expected = whole >> bit & (1 << bits) - 1
    if signed and expected >> (bits - 1):
        expected -= 1 << bits
    text = f'x = {{ byte = {byte}, bit = {bit}, bits = {bits}, order = "{order}", signed = {str(signed).lower()} }}\n'
    vehicle = with_signal(tmp_path_factory.mktemp("v"), text)
    message = vehicle.mapping.requests[0].message
    assert message.decode_simple(data, decode_choices=False, scaling=False)["x"] == expected


def with_signal(folder: Path, signal: str) -> Vehicle:
    changes = (
        ("length = 59", "length = 24"),
        (TEXT[TEXT.index("BatteryCurrent =") : TEXT.index("[[request]]", TEXT.index("[[request]]") + 5)], signal),
        (TEXT[TEXT.index("[roles]") : TEXT.index("[parameters]")], ""),
    )
    return read_vehicle(changed(folder, *changes))
