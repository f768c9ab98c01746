from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.can.layout import crc8_sae_j1850


def test_the_published_check_value():
    assert crc8_sae_j1850(b"123456789") == 0x4B


# AUTOSAR_SWS_CRCLibrary, 7.2.1.1: the examples of CRC-8 SAE J1850
def test_the_examples_of_autosar():
    assert crc8_sae_j1850(bytes(4)) == 0x59
    assert crc8_sae_j1850(bytes.fromhex("F20183")) == 0x37
    assert crc8_sae_j1850(bytes.fromhex("0FAA0055")) == 0x79
    assert crc8_sae_j1850(bytes.fromhex("00FF5511")) == 0xB8
    assert crc8_sae_j1850(bytes.fromhex("332255AABBCCDDEEFF")) == 0xCB
    assert crc8_sae_j1850(bytes.fromhex("926B55")) == 0x8C
    assert crc8_sae_j1850(bytes.fromhex("FFFFFFFF")) == 0x74


@given(st.binary(min_size=1, max_size=7), st.integers(0, 2**56), st.integers(1, 255))
def test_every_burst_of_up_to_eight_bits_is_seen(data, place, burst):
    bits = 8 * len(data)
    error = (burst << place % bits) & (1 << bits) - 1  # what is shifted out leaves a shorter burst
    wrong = (int.from_bytes(data, "big") ^ error).to_bytes(len(data), "big")
    assert (crc8_sae_j1850(wrong) == crc8_sae_j1850(data)) == (error == 0)
