from __future__ import annotations

import json
import os
import random
from pathlib import Path
from types import SimpleNamespace

import pytest
from mcap.reader import make_reader

from gz_onboard.can import logfile
from gz_onboard.can.logfile import LogFile, object_schema
from gz_onboard.can.recorder import LogLimits, Recorder, is_complete
from gz_onboard.events import Frame
from gz_onboard.recording import logs
from gz_onboard.recording.readers.contents import LogDamage
from gz_onboard.recording.readers.mcap import decode_block
from tests.support import files_of_at_most

START = 1_750_000_000_000_000_000  # 2025-06-15T15:06:40Z
SECOND = 1_000_000_000
SCHEMA = object_schema("Estimate", {"range": "km", "soc": "%"})


def ticks(seconds: float, start: int = START, per_tick: int = 10, tick_ns: int = 20_000_000) -> list[list[Frame]]:
    """Batches as a daemon drains them: a few frames each 20 ms."""
    return [
        [
            (start + tick * tick_ns + i * 1_500_123, 0x100 + i, tick.to_bytes(4, "little") + bytes([i] * 4), 0)
            for i in range(per_tick)
        ]
        for tick in range(round(seconds * SECOND / tick_ns))
    ]


def drive(log: Recorder, batches: list[list[Frame]]) -> None:
    for batch in batches:
        log.frames(batch)
        log.sync(batch[-1][0])


def read(path: Path) -> list[Frame]:
    return [frame for batch in logs.read_frames(path) for frame in batch]


def flat(batches: list[list[Frame]]) -> list[Frame]:
    return [frame for batch in batches for frame in batch]


def test_another_mcap_reader_finds_topics_schemas_and_json(tmp_path: Path) -> None:
    log = Recorder(tmp_path, "reference", attachments={"a.dbc": b"text"})
    log.channel("/estimate", SCHEMA)
    batches = ticks(3)
    for i, batch in enumerate(batches):
        log.frames(batch)
        if i % 50 == 0:
            log.sample("/estimate", batch[0][0], {"range": 12.5 + i, "soc": float("nan")})
        log.sync(batch[-1][0])
    log.close()
    with log.paths[0].open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        found = list(reader.iter_messages("/estimate"))
        assert [json.loads(message.data) for _, _, message in found] == [
            {"range": 12.5 + i, "soc": None} for i in (0, 50, 100)
        ]
        schema, channel, message = found[1]
        assert schema is not None
        assert (schema.name, schema.encoding, json.loads(schema.data)) == ("Estimate", "jsonschema", SCHEMA)
        assert channel.message_encoding == "json"
        assert message.log_time == batches[50][0][0]
        blocks = [message.data for _, _, message in reader.iter_messages(logfile.FRAMES_TOPIC)]
        assert [frame for block in blocks for frame in decode_block(block).tuples()] == flat(batches)
        assert [attachment.name for attachment in reader.iter_attachments()] == ["a.dbc"]
        late = list(reader.iter_messages("/estimate", starting_at=batches[60][0][0]))
        assert len(late) == 1


def test_no_block_holds_more_than_its_frames_or_a_second(tmp_path: Path) -> None:
    sizes: list[list[Frame]] = []
    stream = (tmp_path / "a.mcap").open("wb")
    file = LogFile(stream, START)
    sparse: list[Frame] = [(START + i * 300_000_000, 1, b"", 0) for i in range(20)]
    dense: list[Frame] = [(START + 10 * SECOND + i * 100_000, 1, b"", 0) for i in range(2000)]
    back: list[Frame] = [(START, 1, b"", 0)]
    for part in (sparse, dense, back, sparse):
        file.frames(part)
    file.close()
    with (tmp_path / "a.mcap").open("rb") as read_stream:
        for _, _, message in make_reader(read_stream).iter_messages(log_time_order=False):
            sizes.append(decode_block(message.data).tuples())
            assert message.log_time == sizes[-1][0][0]
    assert flat(sizes) == sparse + dense + back + sparse
    assert max(map(len, sizes)) <= logfile.BLOCK_FRAMES
    assert all(abs(block[-1][0] - block[0][0]) < SECOND for block in sizes)


@pytest.mark.parametrize("cut_at", [1.0, 4.93, 9.0])
def test_a_file_cut_off_at_any_time_is_readable_up_to_the_last_two_seconds(tmp_path: Path, cut_at: float) -> None:
    """The file as it lies on the disk at some moment, the recorder still running."""
    log = Recorder(tmp_path, "reference")
    batches = ticks(cut_at)
    drive(log, batches)
    assert log.path is not None
    copy = tmp_path / "copy" / "cut.mcap"
    copy.parent.mkdir()
    copy.write_bytes(log.path.read_bytes())
    damages: list[LogDamage] = []
    there = [frame for batch in logs.read_frames(copy, on_damage=damages.append) for frame in batch]
    assert there == flat(batches)[: len(there)]
    end = there[-1][0] if there else START
    assert flat(batches)[-1][0] - end < 2 * SECOND
    assert len(damages) == 1
    log.close()


def test_files_are_rotated_by_size_and_the_oldest_of_ours_deleted(tmp_path: Path) -> None:
    foreign = [tmp_path / "19990101T000000Z_notes.txt", tmp_path / "measurement.mcap", tmp_path / "sub.mcap"]
    foreign[0].write_text("mine")
    foreign[1].write_bytes(bytes(5000))
    foreign[2].mkdir()
    log = Recorder(tmp_path, "ref", limits=LogLimits(sync_s=0.5, max_file_bytes=20_000, max_total_bytes=60_000))
    noise = random.Random(1)
    batches = [[(t, i, noise.randbytes(8), c) for t, i, _, c in batch] for batch in ticks(60)]
    for batch in batches:
        drive(log, [batch])
        assert log.path is None or log.path.exists()
        ours = [p.stat().st_size for p in tmp_path.glob("2025*_ref*.mcap")]
        assert sum(ours) <= 60_000 + 20_000
    log.close()
    assert len(log.paths) > 5
    left = sorted(tmp_path.glob("2025*_ref*.mcap"))
    assert left == sorted(log.paths[-len(left) :])
    assert sum(path.stat().st_size for path in left) <= 60_000
    assert all(path.exists() for path in foreign)
    assert flat([read(path) for path in left]) == flat(batches)[-sum(len(read(path)) for path in left) :]
    assert log.errors == 0


def test_a_write_error_is_counted_and_recording_resumes_with_a_new_file(tmp_path: Path) -> None:
    log = Recorder(tmp_path, "ref", limits=LogLimits(retry_s=5, sync_s=1))
    log.channel("/estimate", SCHEMA)
    batches = ticks(40)

    def record(part: list[list[Frame]]) -> None:
        for batch in part:
            log.frames(batch)
            log.sample("/estimate", batch[0][0], {"range": 1.0, "soc": 1.0})
            log.sync(batch[-1][0])

    with files_of_at_most(5_000):  # room for a few chunks
        record(batches[:300])
        assert log.errors == 1
    with files_of_at_most(50):  # not even for the header
        record(batches[300:700])
        assert log.errors >= 2
    record(batches[700:])
    log.close()
    assert "too large" in log.last_error
    assert len(log.paths) == 2
    kept = flat([read(path) for path in log.paths])
    # Of the last portion before an error more may have reached the file than was confirmed.
    assert len(flat(batches)) <= len(kept) + log.lost_frames <= len(flat(batches)) + 500
    assert kept[:500] == flat(batches)[:500]
    assert kept[-1] == flat(batches)[-1]
    assert sorted(tmp_path.iterdir()) == sorted(log.paths)  # the attempts leave no empty files behind


def test_a_clock_that_is_set_begins_a_new_file_with_the_right_name(tmp_path: Path) -> None:
    log = Recorder(tmp_path, "ref")
    drive(log, ticks(3, start=1_000 * SECOND))
    drive(log, ticks(3))
    log.close()
    assert [path.name[:9] for path in log.paths] == ["19700101T", "20250615T"]


# --- what happens to a disk ------------------------------------------------------------------------------------


def test_a_log_that_another_writes_is_not_deleted(tmp_path: Path) -> None:
    other = Recorder(tmp_path, "other")
    drive(other, ticks(3))
    assert other.path is not None
    log = Recorder(tmp_path, "ref", limits=LogLimits(max_file_bytes=5000, max_total_bytes=5000))
    drive(log, ticks(1))
    log.close()
    assert other.path.exists()
    other.close()
    assert read(other.path) == flat(ticks(3))


class Disk:
    """A small file system, of which the kernel tells what this says."""

    def __init__(self, size: int, folder: Path) -> None:
        self.size = size
        self.others = 0
        self.folder = folder

    def statvfs(self, _: object) -> SimpleNamespace:
        ours = sum(path.stat().st_size for path in self.folder.iterdir())
        free = self.size - self.others - ours
        return SimpleNamespace(f_blocks=self.size, f_bavail=free, f_frsize=1)


def test_on_a_disk_smaller_than_their_limit_logs_leave_room_for_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = Disk(400_000, tmp_path)
    monkeypatch.setattr(os, "statvfs", disk.statvfs)
    log = Recorder(tmp_path, "ref", limits=LogLimits(sync_s=0.5, retry_s=1))
    noise = random.Random(1)
    least = disk.size
    failing = []
    for number, batch in enumerate(ticks(240)):
        disk.others = 0 if number < 6000 else 200_000 if number < 8000 else 380_000 if number < 10_000 else 0
        drive(log, [[(t, i, noise.randbytes(8), c) for t, i, _, c in batch]])
        failing.append(log.failing)
        if number % 100 == 99 and number // 100 not in (60, 80):  # what others take is noticed at the next sync
            least = min(least, disk.statvfs(None).f_bavail if number < 8000 else least)
    log.close()
    assert least > 90_000  # a quarter of so small a disk, less what is written between two looks
    assert not any(failing[:8000])
    assert all(failing[8100:10_000])  # nothing of ours is left that could be deleted
    assert not any(failing[10_100:])
    assert "are free" in log.last_error or "full" in log.last_error
    left = [path for path in log.paths if path.exists()]
    assert left == log.paths[-len(left) :]
    assert all(is_complete(path) for path in left)


# --- in the background -----------------------------------------------------------------------------------------
