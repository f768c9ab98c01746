"""The saved state: whole or not at all, and never half-used."""

from __future__ import annotations

import zlib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard import state

NOW = 1_700_000_100.0
SNAPSHOT = {"version": 1, "soc": 0.5}

JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)


@given(st.dictionaries(st.text(), JSON, max_size=6))
@settings(deadline=None)
def test_what_is_saved_is_loaded(tmp_path_factory: pytest.TempPathFactory, snapshot: dict[str, object]):
    file = tmp_path_factory.mktemp("state") / "scooter.json"
    state.write(file, state.encode(snapshot, NOW - 30))
    assert state.load(file, NOW) == (snapshot, 30.0)


@pytest.mark.parametrize(
    ("saved_at", "age"),
    [
        (NOW - 5.0, 5.0),
        (NOW + 5.0, None),  # saved in the future: the clock was wrong then or is wrong now
        (12.0, None),  # saved before the clock was set
    ],
)
def test_age(tmp_path: Path, saved_at: float, age: float | None):
    file = tmp_path / "scooter.json"
    state.write(file, state.encode(SNAPSHOT, saved_at))
    assert state.load(file, NOW) == (SNAPSHOT, age)


def sealed(text: bytes) -> bytes:
    """As `state` writes it, whatever it is."""
    return b'{"crc32": "%08x", %s\n' % (zlib.crc32(text), text)


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"{",
        b"[]",
        b"null",
        b"\x00" * 4096,  # what a power cut leaves of a file that was not synced
        b"\xff\xfe{",
        b'{"saved_at": 1.7e9, "estimator": {}}',  # without a checksum
        sealed(b'"saved_at": 1.7e9}'),
        sealed(b'"estimator": {}}'),
        sealed(b'"saved_at": 1.7e9, "estimator": {"name": "\xfc"}}'),
        sealed(b'"a": ' + b"[" * 100_000 + b"}"),
        sealed(b'"saved_at": ' + b"9" * 5000 + b', "estimator": {}}'),
        sealed(b'"saved_at": 1.7e9, "estimator": {}}')[:-1],
        sealed(b'"saved_at": 1.7e9, "estimator": {}}') + b"}",
        sealed(b'"saved_at": 1.7e9, "estimator": "' + b" " * (1 << 20) + b'"}'),
    ],
)
def test_damaged(tmp_path: Path, text: bytes):
    file = tmp_path / "scooter.json"
    file.write_bytes(text)
    with pytest.raises(ValueError, match=r"is empty|is not a saved state|is damaged"):
        state.load(file, NOW)


def test_cut_off_at_any_byte_or_with_any_bit_turned_it_is_refused(tmp_path: Path):
    file = tmp_path / "scooter.json"
    state.write(file, state.encode(SNAPSHOT, NOW))
    whole = file.read_bytes()
    for length in range(len(whole)):
        with pytest.raises(ValueError, match="is "):
            state.decode(whole[:length], NOW)
    for bit in range(8 * len(whole)):
        turned = bytearray(whole)
        turned[bit // 8] ^= 1 << bit % 8
        with pytest.raises(ValueError, match="is "):
            state.decode(bytes(turned), NOW)


def test_the_one_before_is_kept(tmp_path: Path):
    file = tmp_path / "scooter.json"
    for n in range(3):
        state.write(file, state.encode({"n": n}, NOW))
    latest, before = state.copies(file)
    assert state.load(latest, NOW) == ({"n": 2}, 0.0)
    assert state.load(before, NOW) == ({"n": 1}, 0.0)
    assert sorted(tmp_path.iterdir()) == sorted([latest, before])


def test_not_a_number_is_not_saved(tmp_path: Path):
    with pytest.raises(ValueError, match="JSON"):
        state.write(tmp_path / "scooter.json", state.encode({"soc": float("nan")}, NOW))
    assert list(tmp_path.iterdir()) == []
