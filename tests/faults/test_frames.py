"""Frames that are not as they should be: unknown, damaged, of the wrong length, repeated, lost."""

from __future__ import annotations

import pytest

from gz_onboard.can.codec import COUNTER, CRC, LENGTH
from gz_onboard.events import EFF_FLAG, RTR_FLAG, Frame, Reason, State
from tests.faults.support import BEGIN, END, RIDE, Spoil, check_all, of, ride, shortened, spoilt, unspoilt
from tests.support import S, check_frames, identifier, reasons_in, ridden


def test_unknown_identifiers_are_skipped_and_counted():
    first = ride()[0][0]
    strangers = [
        (first + round(t * S), can_id, bytes(range(length)), 0)
        for t in range(40, 80)
        for can_id, length in ((0x7FF, 8), (0x12345 | EFF_FLAG, 3), (0x200 | EFF_FLAG, 8), (0x200 | RTR_FLAG, 0))
    ]
    run = ridden(sorted([*ride(), *strangers], key=lambda frame: frame[0]))
    check_all(run, soc=0.0, range_=0.0)
    assert run.pipeline.codec.unknown == {frame[1]: 40 for frame in strangers[:4]}
    assert run.pipeline.counts().unknown == 4
    assert run.pipeline.counts().dropped == 0
    diagnosis = check_frames(run.sent)["RANGE_Diagnosis"]
    assert diagnosis[0]["RANGE_CountUnknown"] == 0
    assert diagnosis[-1]["RANGE_CountUnknown"] == 4


def bad_crc(frame: Frame) -> Frame:
    return frame[0], frame[1], frame[2][:-1] + bytes([frame[2][-1] ^ 0x01]), frame[3]


def flipped(frame: Frame) -> Frame:
    """A bit of the payload is wrong, the checksum is that of the right one."""
    return frame[0], frame[1], bytes([frame[2][0] ^ 0x80]) + frame[2][1:], frame[3]


def emptied(frame: Frame) -> Frame:
    return frame[0], frame[1], b"", frame[3]


def lengthened(frame: Frame) -> Frame:
    return frame[0], frame[1], frame[2] + bytes(56), frame[3]


@pytest.mark.parametrize(
    ("spoil", "reason"), [(bad_crc, CRC), (flipped, CRC), (shortened, LENGTH), (emptied, LENGTH), (lengthened, LENGTH)]
)
@pytest.mark.parametrize("every", [5, 1])
def test_frames_that_fail_a_check_are_dropped_counted_and_told(spoil: Spoil, reason: str, every: int):
    chosen = {frame: i % every == 0 for i, frame in enumerate(f for f in ride() if f[1] == identifier("BMS_Pack"))}
    run = ridden(spoilt(of("BMS_Pack", lambda frame: spoil(frame) if chosen[frame] else frame)))
    # The inverter's current stands in where all are lost; a fifth missing is within the sensors' own error.
    check_all(run, soc=0.003, range_=0.03)
    count = run.faults["BMS_Pack", reason]
    expected = sum(hit for f, hit in chosen.items() if BEGIN * S <= f[0] - ride()[0][0] < END * S)
    assert count == expected == run.pipeline.counts().dropped
    during = run.between(BEGIN + 1.5, END)
    assert all(e.reasons & Reason.FRAMES_DROPPED for e in during)
    assert not reasons_in(run.between(0, BEGIN) + run.between(END + 1.1, RIDE)) & Reason.FRAMES_DROPPED
    lost = Reason.NO_PACK_CURRENT | Reason.NO_PACK_VOLTAGE
    assert {e.reasons & lost for e in during} == {lost if every == 1 else Reason(0)}
    status = check_frames(run.sent)["RANGE_Status"]
    assert sum(row["RANGE_FramesDropped"] for row in status) == pytest.approx(2 * (END - BEGIN), abs=2)  # per estimate
    assert check_frames(run.sent)["RANGE_Diagnosis"][-1]["RANGE_CountDropped"] == count


def test_a_repeated_counter_is_dropped():
    held: list[bytes] = []

    def stuck(frame: Frame) -> Frame:
        held.append(frame[2])
        return frame[0], frame[1], held[0], frame[3]

    run = ridden(spoilt(of("BMS_Pack", stuck)))
    check_all(run, soc=0.003, range_=0.03)
    # The sender hangs: what it repeats is no measurement, so after ten periods it counts as missing.
    lost = Reason.NO_PACK_CURRENT | Reason.NO_PACK_VOLTAGE
    assert all(e.reasons & lost == lost for e in run.between(BEGIN + 1.5, END))
    assert run.faults["BMS_Pack", COUNTER] > 0.85 * 10 * (END - BEGIN)


@pytest.mark.parametrize("missing", [1, 3, 6])
def test_a_counter_that_jumps_tells_of_lost_frames(missing: int):
    numbered = iter(range(10**6))
    run = ridden(spoilt(of("INV_Motion", lambda f: None if next(numbered) % 100 < missing else f)))
    check_all(run)
    gone = missing * round(END - BEGIN)  # a hundred frames a second
    before = unspoilt().pipeline.codec.lost.get("INV_Motion", 0)
    assert run.pipeline.codec.lost["INV_Motion"] - before == pytest.approx(gone, abs=missing)
    assert all(e.reasons & Reason.FRAMES_LOST for e in run.between(BEGIN + 2, END))
    assert {e.state for e in run.between(5.0, RIDE)} == {State.VALID}
    assert check_frames(run.sent)["RANGE_Diagnosis"][-1]["RANGE_CountLost"] == run.pipeline.counts().lost
