"""Checksums of CAN messages."""

from __future__ import annotations

import functools


def _crc8_tables(polynomial: int, size: int) -> list[list[int]]:
    """For each position from the end, the CRC of a single byte followed by that many zero bytes."""
    table = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc << 1 ^ polynomial if crc & 0x80 else crc << 1) & 0xFF
        table.append(crc)
    tables = [table]
    for _ in range(size - 1):
        tables.append([table[crc] for crc in tables[-1]])
    return tables[:size]


@functools.cache
def sae_j1850_tables(size: int) -> tuple[int, list[list[int]]]:
    """(constant, tables) such that the CRC of `size` bytes is constant ^ tables[0][b0] ^ tables[1][b1] ...

    A CRC is linear: that of a message is the XOR of what each of its bytes contributes by itself.
    """
    start = 0xFF
    table = _crc8_tables(0x1D, 1)[0]
    for _ in range(size):
        start = table[start]
    return start ^ 0xFF, _crc8_tables(0x1D, size)[::-1]


def crc8_sae_j1850(data: bytes) -> int:
    """CRC-8 SAE J1850: polynomial 0x1D, initial value 0xFF, final XOR 0xFF (as in AUTOSAR E2E profile 1)."""
    crc, tables = sae_j1850_tables(len(data))
    for table, byte in zip(tables, data, strict=True):
        crc ^= table[byte]
    return crc
