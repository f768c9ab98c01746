from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.can import logfile
from gz_onboard.events import EFF_FLAG, ERR_FLAG, RTR_FLAG, Frame
from gz_onboard.recording.readers.mcap import decode_block

LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)

identifiers = st.one_of(
    st.integers(0, 0x7FF),
    st.integers(0, 0x7FF).map(lambda i: i | RTR_FLAG),
    st.integers(0, 0x1FFF_FFFF).map(lambda i: i | EFF_FLAG),
    st.integers(0, 0x1FFF_FFFF).map(lambda i: i | ERR_FLAG),
)
datas = st.sampled_from(LENGTHS).flatmap(lambda n: st.binary(min_size=n, max_size=n))
times = st.one_of(
    st.integers(1_700_000_000_000_000_000, 1_700_000_001_000_000_000),  # a clock in ns
    st.integers(1_700_000_000_000_000, 1_700_000_000_002_000).map(lambda t: t * 1000),  # in µs
    st.integers(0, 1 << 62),
)
frames = st.tuples(times, identifiers, datas, st.integers(0, 255))


@given(st.lists(frames, min_size=1, max_size=60))
def test_blocks_keep_every_frame_exactly(block: list[Frame]) -> None:
    assert decode_block(logfile.encode_block(block)).tuples() == block


@given(st.lists(frames, min_size=1, max_size=20), st.data())
def test_a_cut_block_is_refused(block: list[Frame], data: st.DataObject) -> None:
    encoded = logfile.encode_block(block)
    cut = data.draw(st.integers(0, len(encoded) - 1))
    with pytest.raises(ValueError, match="block"):
        decode_block(encoded[:cut]).tuples()


@given(st.binary(max_size=200))
def test_rubbish_is_refused_not_decoded(rubbish: bytes) -> None:
    try:
        decoded = decode_block(rubbish).tuples()
    except ValueError:
        return
    assert decode_block(logfile.encode_block(decoded)).tuples() == decoded
