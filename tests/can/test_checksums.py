from __future__ import annotations

import pytest

from gz_onboard.can.layout import crc8_sae_j1850


@pytest.mark.parametrize(
    ("data", "crc"),
    [
        (b"123456789", 0x4B),  # the published check value
        (bytes(4), 0x59),  # these: AUTOSAR_SWS_CRCLibrary, 7.2.1.1
        (bytes.fromhex("F20183"), 0x37),
        (bytes.fromhex("332255AABBCCDDEEFF"), 0xCB),
        (bytes.fromhex("FFFFFFFF"), 0x74),
    ],
)
def test_published_examples_of_crc8_sae_j1850(data, crc):
    assert crc8_sae_j1850(data) == crc
