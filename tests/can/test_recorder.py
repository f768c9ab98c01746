from __future__ import annotations

import json
import os
import random
import resource
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from mcap.reader import make_reader

from gz_onboard.background import Background
from gz_onboard.can import logfile
from gz_onboard.can.logfile import LogFile, object_schema
from gz_onboard.can.recorder import BackgroundRecorder, LogLimits, Recorder, is_complete
from gz_onboard.errors import InputError
from gz_onboard.events import Frame
from gz_onboard.recording import logs
from gz_onboard.recording.readers.contents import LogDamage
from gz_onboard.recording.readers.mcap import decode_block

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


def test_what_is_recorded_is_read_back(tmp_path: Path) -> None:
    log = Recorder(tmp_path, "reference", {"mass": "180"}, {"dbc/vehicle.dbc": b'VERSION ""\n'})
    batches = ticks(5)
    drive(log, batches)
    log.close()
    (path,) = tmp_path.iterdir()
    assert path.name == "20250615T150640Z_reference.mcap"
    assert log.paths == [path]
    assert read(path) == flat(batches)
    assert logs.read_attachments(path) == {"dbc/vehicle.dbc": b'VERSION ""\n'}
    assert logs.read_metadata(path)["vehicle"] == "reference"
    assert logs.read_metadata(path)["mass"] == "180"
    assert log.errors == 0


def test_another_mcap_reader_finds_topics_schemas_and_json(tmp_path: Path) -> None:
    log = Recorder(tmp_path, "reference", attachments={"a.dbc": b"text"})
    log.channel("/estimate", SCHEMA, {"rate": "1 Hz"})
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
        assert (channel.message_encoding, channel.metadata) == ("json", {"rate": "1 Hz"})
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


def test_syncing_brings_the_file_to_the_disk_at_most_once_in_its_interval(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[int] = []
    real = os.fdatasync

    def counted(descriptor: int) -> None:
        synced.append(descriptor)
        real(descriptor)

    monkeypatch.setattr(os, "fdatasync", counted)
    log = Recorder(tmp_path, "reference", limits=LogLimits(sync_s=1.0))
    drive(log, ticks(10))
    assert 8 <= len(synced) <= 10
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


def test_files_are_rotated_by_age_and_each_stands_for_itself(tmp_path: Path) -> None:
    log = Recorder(tmp_path, "ref", attachments={"a.dbc": b"text"}, limits=LogLimits(max_age_s=10))
    log.channel("/estimate", SCHEMA)
    batches = ticks(25)
    for batch in batches:
        log.frames(batch)
        log.sample("/estimate", batch[0][0], {"range": 1.0, "soc": 2.0})
        log.sync(batch[-1][0])
    log.close()
    assert len(log.paths) == 3
    assert flat([read(path) for path in log.paths]) == flat(batches)
    for path in log.paths:
        assert logs.read_attachments(path) == {"a.dbc": b"text"}
        assert {topic for topic, _, _ in logs.read_samples(path)} == {"/estimate"}


def test_a_name_that_is_taken_gets_a_number(tmp_path: Path) -> None:
    for _ in range(3):
        log = Recorder(tmp_path, "my/scooter 1")
        log.frames(ticks(0.1)[0])
        log.close()
    names = sorted(path.name for path in tmp_path.iterdir())
    stem = "20250615T150640Z_my-scooter-1"
    assert names == sorted([f"{stem}.mcap", f"{stem}~2.mcap", f"{stem}~3.mcap"])


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """The kernel refuses to let any file grow beyond this: like a full disk, an error in the middle of a write."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


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


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_log_file_itself_lets_the_error_through() -> None:
    stream = Path("/dev/full").open("wb")  # noqa: SIM115  # closing it fails as well
    with pytest.raises(OSError, match="No space"):
        LogFile(stream, START)
    with suppress(OSError):
        stream.close()


def test_a_directory_that_cannot_be_made_is_counted_not_raised(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    log = Recorder(tmp_path / "file" / "logs", "ref", limits=LogLimits(retry_s=5))
    drive(log, ticks(11))
    log.close()
    assert log.errors == 3  # at once, after 5 s and after 10 s
    assert log.lost_frames == 11 * 500
    assert log.paths == []


def test_a_clock_that_is_set_begins_a_new_file_with_the_right_name(tmp_path: Path) -> None:
    log = Recorder(tmp_path, "ref")
    drive(log, ticks(3, start=1_000 * SECOND))
    drive(log, ticks(3))
    log.close()
    assert [path.name[:9] for path in log.paths] == ["19700101T", "20250615T"]


def test_an_undeclared_topic_is_a_mistake(tmp_path: Path) -> None:
    with pytest.raises(KeyError):
        Recorder(tmp_path, "ref").sample("/nothing", START, {})


def test_limits_that_cannot_be_kept_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not fit"):
        Recorder(tmp_path, "ref", limits=LogLimits(max_file_bytes=2000, max_total_bytes=1000))


def test_the_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    written = []
    for name in ("a", "b"):
        log = Recorder(tmp_path / name, "ref", {"k": "v"}, {"a.dbc": b"x"})
        log.channel("/estimate", SCHEMA)
        drive(log, ticks(4))
        log.close()
        written.append(log.paths[0].read_bytes())
    assert written[0] == written[1]


# --- what happens to a disk ------------------------------------------------------------------------------------

YEAR = 365 * 86400 * SECOND


def test_with_the_clock_set_back_the_oldest_go_first_and_never_the_one_being_written(tmp_path: Path) -> None:
    log = Recorder(tmp_path, "ref", limits=LogLimits(sync_s=0.5, max_file_bytes=20_000, max_total_bytes=60_000))
    noise = random.Random(1)
    batches = [[(t, i, noise.randbytes(8), c) for t, i, _, c in batch] for batch in ticks(90)]
    for number, batch in enumerate(batches):
        back = YEAR if number > len(batches) // 2 else 0
        drive(log, [[(t - back, i, data, c) for t, i, data, c in batch]])
        assert log.path is None or log.path.exists()
    log.close()
    left = [path for path in log.paths if path.exists()]
    assert left == log.paths[-len(left) :]
    assert {path.name[:4] for path in log.paths} == {"2024", "2025"}
    assert sum(path.stat().st_size for path in left) > 40_000


def test_the_running_number_goes_on_after_a_restart(tmp_path: Path) -> None:
    (tmp_path / "20250101T000000Z_other~41.mcap").write_bytes(b"x")
    for year in (1, 0):
        log = Recorder(tmp_path, "ref")
        drive(log, ticks(0.1, START - year * YEAR))
        log.close()
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names[0] == "20240615T150640Z_ref~42.mcap"
    assert names[2] == "20250615T150640Z_ref~43.mcap"


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


@pytest.mark.parametrize("moved", [False, True])
def test_a_directory_that_is_taken_away_is_noticed_and_made_again(tmp_path: Path, moved: bool) -> None:
    folder, elsewhere = tmp_path / "logs", tmp_path / "elsewhere"
    log = Recorder(folder, "ref", limits=LogLimits(sync_s=1))
    drive(log, ticks(3))
    if moved:
        folder.rename(elsewhere)
    else:
        shutil.rmtree(folder)
    later = ticks(5, START + 3 * SECOND)
    drive(log, later)
    log.close()
    assert log.errors == 1
    assert "deleted or moved" in log.last_error
    assert not log.failing
    (path,) = folder.iterdir()
    assert read(path)[-1] == later[-1][-1]
    assert read(path)[0][0] < later[0][0][0] + 2 * SECOND
    if moved:
        (old,) = elsewhere.iterdir()
        assert is_complete(old)
        assert read(old) + read(path) == flat(ticks(3)) + flat(later)


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


# --- power cuts ------------------------------------------------------------------------------------------------


def test_a_log_cut_off_anywhere_is_read_as_far_as_it_was_synced(tmp_path: Path) -> None:
    """The file as a power cut leaves it: synced up to some byte, perhaps with rubbish from the disk behind it."""
    log = Recorder(tmp_path / "whole", "ref", {"k": "v"}, {"a.dbc": b"text"}, limits=LogLimits(sync_s=1))
    log.channel("/estimate", SCHEMA, {"rate": "1 Hz"})
    batches = ticks(8)
    for number, batch in enumerate(batches):
        log.frames(batch)
        if number % 25 == 0:
            log.sample("/estimate", batch[0][0], {"range": number, "soc": None})
        log.sync(batch[-1][0])
    assert log.path is not None
    there = log.path.stat().st_size
    log.close()
    data, sent = log.path.read_bytes(), flat(batches)
    path = tmp_path / "cut.mcap"
    source = random.Random(2)
    for number, length in enumerate([there, there - 1, *(source.randrange(2000, there) for _ in range(60))]):
        path.write_bytes(data[:length] + (b"", bytes(3000), source.randbytes(3000))[number % 3])
        damages: list[LogDamage] = []
        found = [frame for batch in logs.read_frames(path, on_damage=damages.append) for frame in batch]
        assert found == sent[: len(found)]
        assert len(damages) == 1
        assert not is_complete(path)
        assert logs.read_metadata(path)["k"] == "v"
        assert logs.read_attachments(path) == {"a.dbc": b"text"}
        samples = [(topic, values["range"]) for topic, _, values in logs.read_samples(path)]
        assert samples == [("/estimate", 25 * i) for i in range(len(samples))]
    path.write_bytes(data[:there])
    assert sent[-1][0] - read(path)[-1][0] < 2 * SECOND


def test_a_log_without_a_byte_goes_when_the_next_one_begins(tmp_path: Path) -> None:
    empty = tmp_path / "20250615T150740Z_ref~2.mcap"
    empty.write_bytes(b"")
    others = [tmp_path / "ride.mcap", tmp_path / "20250615T150640Z_ref~4.mcap"]
    for other in others:
        other.write_bytes(b"no log, but not empty")
    log = Recorder(tmp_path, "ref")
    drive(log, ticks(1))
    log.close()
    assert not empty.exists()
    assert all(other.read_bytes() == b"no log, but not empty" for other in others)


# --- in the background -----------------------------------------------------------------------------------------


def test_in_the_background_it_writes_the_same(tmp_path: Path) -> None:
    plain = Recorder(tmp_path / "a", "ref")
    drive(plain, ticks(4))
    plain.close()
    behind = BackgroundRecorder(Recorder(tmp_path / "b", "ref"), limit=10**9)
    for batch in ticks(4):
        behind.frames(batch)
        behind.sync(batch[-1][0])
    assert behind.close(30)
    (path,) = (tmp_path / "b").iterdir()
    assert read(path) == read(plain.paths[0])
    assert behind.lost_frames == 0


def test_the_thread_is_woken_twice_a_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = 0

    class Counting(Background):
        def call(self, function: Callable[..., object], *arguments: Any, weight: int = 1) -> bool:
            nonlocal calls
            calls += 1
            return super().call(function, *arguments, weight=weight)

    monkeypatch.setattr("gz_onboard.can.recorder.Background", Counting)
    behind = BackgroundRecorder(Recorder(tmp_path, "ref"), limit=10**9)
    behind.channel("/estimate", SCHEMA)
    batches = ticks(4)
    for batch in batches:
        behind.frames(batch)
        behind.sample("/estimate", batch[-1][0], {"range": 1.0})
        behind.sync(batch[-1][0])
    assert calls == 9  # in 4 s, the first at once
    behind.frames(batches[0])
    assert behind.close(30)  # with what came since
    (path,) = tmp_path.iterdir()
    assert len(read(path)) == len(flat(batches)) + len(batches[0])


class Prompt(Background):
    """Has made each call before the caller goes on, as a thread has that gets its turn at once."""

    def call(self, function: Callable[..., object], *arguments: Any, weight: int = 1) -> bool:
        taken = super().call(function, *arguments, weight=weight)
        assert self.wait(60)
        return taken


def test_it_goes_on_syncing_though_a_sync_is_done_before_its_caller_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gz_onboard.can.recorder.Background", Prompt)
    synced: list[int] = []
    monkeypatch.setattr(os, "fdatasync", synced.append)
    behind = BackgroundRecorder(Recorder(tmp_path, "ref", limits=LogLimits(sync_s=0.5)), limit=10**9)
    for batch in ticks(4, tick_ns=100_000_000):
        behind.frames(batch)
        behind.sync(batch[-1][0])
    assert len(synced) == 7  # one in each half second, but the first
    assert behind.close(60)


def test_a_disk_that_does_not_answer_holds_up_nobody_and_what_is_lost_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, answer = threading.Event(), threading.Event()
    real = os.fdatasync

    def late(descriptor: int) -> None:
        asked.set()
        answer.wait(60)
        real(descriptor)

    monkeypatch.setattr(os, "fdatasync", late)
    log = Recorder(tmp_path, "ref", limits=LogLimits(sync_s=0.5))
    behind = BackgroundRecorder(log, limit=2000)
    batches = ticks(20)  # 10000 frames; were it to wait with the disk, it would be for a minute at each sync
    for batch in batches:
        behind.frames(batch)
        behind.sync(batch[-1][0])
        while not asked.is_set() and not behind._thread.wait(0.01):
            pass
    assert "slow" in behind.error
    lost = behind.lost_frames
    assert 0 < lost < 10_000
    assert not behind.close(0.2)
    answer.set()
    assert behind.close(30)
    behind.sync(batches[-1][-1][0] + SECOND)
    assert not behind.error
    there = read(log.paths[0])
    assert len(there) + lost == len(flat(batches))
    assert set(there) <= set(flat(batches))
