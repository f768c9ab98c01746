from __future__ import annotations

import json
import os
import random
import resource
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from mcap.reader import make_reader

from gz_onboard.bus import framelog, logs, recorder
from gz_onboard.bus.recorder import LogFile, Recorder, object_schema
from gz_onboard.errors import InputError
from gz_onboard.events import Frame

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
        blocks = [message.data for _, _, message in reader.iter_messages(framelog.TOPIC)]
        assert [frame for block in blocks for frame in framelog.decode_block(block)] == flat(batches)
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
            sizes.append(framelog.decode_block(message.data))
            assert message.log_time == sizes[-1][0][0]
    assert flat(sizes) == sparse + dense + back + sparse
    assert max(map(len, sizes)) <= recorder.BLOCK_FRAMES
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
    damages: list[logs.LogDamage] = []
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
    log = Recorder(tmp_path, "reference", sync_s=1.0)
    drive(log, ticks(10))
    assert 8 <= len(synced) <= 10
    log.close()


def test_files_are_rotated_by_size_and_the_oldest_of_ours_deleted(tmp_path: Path) -> None:
    foreign = [tmp_path / "19990101T000000Z_notes.txt", tmp_path / "measurement.mcap", tmp_path / "sub.mcap"]
    foreign[0].write_text("mine")
    foreign[1].write_bytes(bytes(5000))
    foreign[2].mkdir()
    log = Recorder(tmp_path, "ref", sync_s=0.5, max_file_bytes=20_000, max_total_bytes=60_000)
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
    log = Recorder(tmp_path, "ref", attachments={"a.dbc": b"text"}, max_age_s=10)
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
    log = Recorder(tmp_path, "ref", retry_s=5, sync_s=1)
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
    log = Recorder(tmp_path / "file" / "logs", "ref", retry_s=5)
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
        Recorder(tmp_path, "ref", max_file_bytes=2000, max_total_bytes=1000)


def test_the_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    written = []
    for name in ("a", "b"):
        log = Recorder(tmp_path / name, "ref", {"k": "v"}, {"a.dbc": b"x"})
        log.channel("/estimate", SCHEMA)
        drive(log, ticks(4))
        log.close()
        written.append(log.paths[0].read_bytes())
    assert written[0] == written[1]
