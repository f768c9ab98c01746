"""CRC-8 SAE J1850 of CAN messages: polynomial 0x1D, initial value 0xFF, final XOR 0xFF, as in AUTOSAR E2E profile 1."""

from __future__ import annotations

import functools


@functools.cache
def sae_j1850_tables(size: int) -> tuple[int, list[bytes]]:
    """(constant, tables) such that the CRC of `size` bytes is constant ^ tables[0][b0] ^ tables[1][b1] ...

    A CRC is linear: that of a message is the XOR of what each of its bytes contributes by itself.
    """
    following = bytearray()  # of a single byte
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x1D if crc & 0x80 else crc << 1) & 0xFF
        following.append(crc)
    constant, tables = 0xFF, [bytes(following)]
    for _ in range(size):
        constant = following[constant]
        tables.insert(0, tables[0].translate(bytes(following)))
    return constant ^ 0xFF, tables[1:]


def crc8_sae_j1850(data: bytes) -> int:
    """The CRC of `data`."""
    crc, tables = sae_j1850_tables(len(data))
    for table, byte in zip(tables, data, strict=True):
        crc ^= table[byte]
    return crc


def crc_differences(data: bytes, length: int) -> bytes:
    """For each frame of `length` bytes in `data`, its CRC of all bytes but the last, XOR the last: 0 where it is right.

    All frames at once: one look-up and one XOR of whole columns of bytes for each position.
    """
    constant, tables = sae_j1850_tables(length - 1)
    count = len(data) // length
    differences = int.from_bytes(bytes([constant]) * count, "big") ^ int.from_bytes(data[length - 1 :: length], "big")
    for i, table in enumerate(tables):
        differences ^= int.from_bytes(data[i::length].translate(table), "big")
    return differences.to_bytes(count, "big")
