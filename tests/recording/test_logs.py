from __future__ import annotations

import contextlib
import struct
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import can
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.can.logfile import LogFile
from gz_onboard.errors import InputError
from gz_onboard.events import EFF_FLAG, RTR_FLAG, TRANSMITTED, Frame
from gz_onboard.recording.logs import json_channels, read_attachments, read_frames, read_metadata, read_samples
from gz_onboard.recording.readers.contents import LogDamage
from gz_onboard.recording.readers.python_can import frame_of
from gz_onboard.recording.readers.text import ChannelNumbers
from tests.support import write_log

START_S = 1_750_000_000


def read(path: Path) -> tuple[list[Frame], list[LogDamage]]:
    damages: list[LogDamage] = []
    return [frame for batch in read_frames(path, on_damage=damages.append) for frame in batch], damages


def whole(path: Path) -> list[Frame]:
    frames, damages = read(path)
    assert damages == []
    return frames


# --- against python-can's readers ------------------------------------------------------------------------------


@st.composite
def messages(draw: st.DrawFn, fd: bool, errors: bool = True) -> list[can.Message]:
    """Messages of all sorts in the order of their times, as a bus gives them."""
    count = draw(st.integers(1, 30))
    made = []
    time_us = START_S * 1_000_000
    for _ in range(count):
        time_us += draw(st.integers(0, 2_000_000))
        extended = draw(st.booleans())
        kind = draw(st.sampled_from(["data", "data", "data", "remote", *(["error"] * errors), *(["fd"] * fd)]))
        data = draw(st.binary(max_size=8))
        if kind == "fd":
            data = bytes(draw(st.sampled_from([12, 16, 20, 24, 32, 48, 64])))
        made.append(
            can.Message(
                timestamp=time_us * 1e-6,
                arbitration_id=draw(st.integers(0, 0x1FFF_FFFF if extended else 0x7FF)),
                is_extended_id=extended,
                is_remote_frame=kind == "remote",
                is_error_frame=kind == "error",
                is_fd=kind == "fd",
                is_rx=draw(st.booleans()),
                dlc=draw(st.integers(0, 8)) if kind == "remote" else len(data),
                data=None if kind == "remote" else data,
                channel=draw(st.integers(0, 3)),
            )
        )
    return made


def by_python_can(path: Path) -> list[Frame]:
    channels = ChannelNumbers()
    messages = list(can.LogReader(path))
    for message in messages:
        if path.suffix == ".trc":  # PCAN counts its buses from 1
            message.channel = int(str(message.channel)) - 1
    return [frame_of(message, channels) for message in messages]


def same(ours: list[Frame], theirs: list[Frame], within_ns: int) -> bool:
    return [f[1:] for f in ours] == [f[1:] for f in theirs] and all(
        abs(a[0] - b[0]) <= within_ns for a, b in zip(ours, theirs, strict=True)
    )


def check_against_python_can(suffix: str, sent: list[can.Message], within_ns: int) -> None:
    with TemporaryDirectory() as directory:
        path = Path(directory) / f"log{suffix}"
        with can.Logger(path) as writer:
            for message in sent:
                writer(message)
        ours = whole(path)
        assert len(ours) == len(sent)
        assert same(ours, by_python_can(path), within_ns)


@given(messages(fd=True))
@settings(deadline=None, max_examples=60)
def test_blf_is_read_as_by_python_can(sent: list[can.Message]) -> None:
    check_against_python_can(".blf", sent, 600)


@given(messages(fd=True, errors=False))
@settings(deadline=None, max_examples=60)
def test_candump_is_read_as_by_python_can(sent: list[can.Message]) -> None:
    check_against_python_can(".log", sent, 0)


@pytest.mark.parametrize("suffix", [".asc", ".trc", ".csv", ".asc.gz"])
@given(sent=messages(fd=False, errors=False))
@settings(deadline=None, max_examples=25)
def test_text_formats_are_read_as_by_python_can(suffix: str, sent: list[can.Message]) -> None:
    if suffix == ".trc":  # its writer has no remote frames and one channel
        sent = [message for message in sent if not message.is_remote_frame] or [can.Message(timestamp=START_S)]
        for message in sent:
            message.channel = 0
    check_against_python_can(suffix, sent, 0)


def test_a_blf_of_other_tools_is_read(tmp_path: Path) -> None:
    """Type 86 objects, version 2 headers, times in 10 µs, padding, an uncompressed container, unknown objects."""
    body = struct.pack("<HBBL8sLBBH", 2, 0, 3, 0x123, b"abc", 0, 0, 0, 0)
    first = struct.pack("<4sHHLLLHHQ", b"LOBJ", 32, 1, 32 + len(body), 86, 1, 0, 0, 150_000) + body
    body = struct.pack("<HBBL8s", 1, 1, 2, 0x8000_0456, b"de")
    second = struct.pack("<4sHHLLLBxHQ8x", b"LOBJ", 40, 2, 40 + len(body), 1, 2, 0, 0, 1_600_000_000) + body
    unknown = struct.pack("<4sHHLLLHHQ", b"LOBJ", 32, 1, 37, 65, 2, 0, 0, 0) + bytes(5) + bytes(1)
    content = first + unknown + second
    container = struct.pack("<4sHHLLH6xL4x", b"LOBJ", 16, 1, 32 + len(content), 10, 0, len(content)) + content
    times = (2025, 6, 0, 15, 15, 6, 40, 250) * 2
    header = struct.pack("<4sL8B2Q2L8H8H72x", b"LOGG", 144, *[0] * 8, 0, 0, 3, 0, *times)
    path = tmp_path / "a.blf"
    path.write_bytes(header + container + bytes(len(container) % 4))
    start = START_S * 10**9 + 250_000_000
    assert whole(path) == [
        (start + 1_500_000_000, 0x123, b"abc", 1),
        (start + 1_600_000_000, 0x456 | EFF_FLAG, b"de", 0 | TRANSMITTED),
    ]
    assert same(whole(path), by_python_can(path), 600)


# --- our own format, exact to the ns ---------------------------------------------------------------------------

ns_frames = st.lists(
    st.tuples(
        st.integers(START_S * 10**9, (START_S + 100) * 10**9),
        st.one_of(
            st.integers(0, 0x7FF), st.integers(0, 0x1FFF_FFFF).map(lambda i: i | EFF_FLAG), st.just(0x12 | RTR_FLAG)
        ),
        st.sampled_from([0, 1, 7, 8, 12, 64]).map(lambda n: bytes(range(n))),
        st.sampled_from([0, 1, TRANSMITTED, TRANSMITTED + 1]),
    ).map(lambda f: (f[0], f[1], bytes(len(f[2]) % 9) if f[1] & RTR_FLAG else f[2], f[3])),
    min_size=1,
    max_size=40,
)


@given(ns_frames)
def test_mcap_keeps_everything(frames: list[Frame]) -> None:
    with TemporaryDirectory() as directory:
        path = Path(directory) / "a.mcap"
        write_mcap(path, [frames])
        assert whole(path) == frames


def write_mcap(path: Path, batches: list[list[Frame]]) -> None:
    file = LogFile(path.open("wb"), batches[0][0][0])
    for batch in batches:
        file.frames(batch)
        file.flush()
    file.close()


# --- a part of a log -------------------------------------------------------------------------------------------


def ordinary(count: int) -> list[Frame]:
    """Frames whose times are whole µs and exact as a float of seconds: no format changes them."""
    return [(START_S * 10**9 + i * 15_625_000, 0x100 + i % 20, i.to_bytes(4, "little") * 2, 0) for i in range(count)]


def written(tmp_path: Path, frames: list[Frame], suffix: str) -> Path:
    path = tmp_path / f"log{suffix}"
    if suffix == ".mcap":
        write_mcap(path, [frames[i : i + 1000] for i in range(0, len(frames), 1000)])
    else:
        write_log(path, frames)
    return path


@pytest.mark.parametrize("suffix", [".mcap", ".blf", ".log"])
def test_a_part_by_time_is_from_its_start_to_before_its_end(tmp_path: Path, suffix: str) -> None:
    frames = ordinary(10_000)
    path = written(tmp_path, frames, suffix)
    start, end = frames[1234][0], frames[6789][0]
    assert [f for batch in read_frames(path, start, end) for f in batch] == frames[1234:6789]
    assert [f for batch in read_frames(path, start) for f in batch] == frames[1234:]
    assert [f for batch in read_frames(path, None, end) for f in batch] == frames[:6789]


# --- damage ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".mcap", ".blf", ".log"])
@given(st.floats(0.05, 0.999))
@settings(deadline=None, max_examples=30)
def test_a_cut_log_is_read_up_to_the_cut(suffix: str, share: float) -> None:
    with TemporaryDirectory() as directory:
        frames = ordinary(8000)
        path = written(Path(directory), frames, suffix)
        data = path.read_bytes()
        path.write_bytes(data[: int(len(data) * share)])
        there, damages = read(path)
        assert there == frames[: len(there)]
        assert len(there) > 8000 * share - 3000
        # A cut between two lines, or into the summary of an MCAP whose frames are all there, is not noticed.
        assert damages or len(there) == 8000 or suffix == ".log"


def test_a_last_line_without_an_end_is_used_only_if_no_data_can_be_missing(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    path.write_text("(1.000000) can0 123#0011223344556677\n(1.100000) can0 123#0011223344556677")
    assert len(whole(path)) == 2
    path.write_text("(1.000000) can0 123#0011223344556677\n(1.100000) can0 123#00112233445566")
    there, damages = read(path)
    assert len(there) == 1
    assert damages[0].place == "line 2"


@pytest.mark.parametrize("suffix", [".asc", ".trc", ".csv"])
def test_a_line_cut_short_is_no_frame(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    with can.Logger(path) as writer:
        for i in range(9):
            writer(can.Message(timestamp=START_S + i, arbitration_id=i, data=bytes(8), is_extended_id=False, channel=0))
    text = path.read_text().rstrip().removesuffix("End TriggerBlock").rstrip()
    for cut in range(1, 8):
        path.write_text(text[:-cut])
        assert all(len(frame[2]) == 8 for frame in read(path)[0])


@pytest.mark.parametrize("suffix", [".mcap", ".blf"])
@given(st.integers(0, 10**9), st.binary(min_size=1, max_size=300))
@settings(deadline=None, max_examples=30)
def test_rubbish_in_the_middle_loses_what_it_hits_and_is_told(suffix: str, place: int, rubbish: bytes) -> None:
    with TemporaryDirectory() as directory:
        frames = ordinary(20_000)
        path = written(Path(directory), frames, suffix)
        data = bytearray(path.read_bytes())
        body = 2000 if suffix == ".mcap" else 144  # behind the header, attachments and the first chunk's beginning
        at = body + place % (len(data) - body - 2000)
        before = bytes(data[at : at + len(rubbish)])
        data[at : at + len(rubbish)] = rubbish
        path.write_bytes(data)
        there, damages = read(path)
        if there != frames:
            assert damages or rubbish == before
        assert set(frames).issuperset(there)
        assert len(there) >= 13_000  # two chunks at most


def blf_of(path: Path, *contents: bytes) -> Path:
    """Write a BLF file with a container for each of the contents, not packed."""
    path.write_bytes(struct.pack("<4sL8B2Q2L8H8H72x", b"LOGG", 144, *[0] * 28))
    with path.open("ab") as file:
        for content in contents:
            file.write(struct.pack("<4sHHLLH6xL4x", b"LOBJ", 16, 1, 32 + len(content), 10, 0, len(content)))
            file.write(content + bytes(len(content) % 4))
    return path


def blf_object(number: int, data: bytes = bytes(8)) -> bytes:
    return struct.pack("<4sHHLLLHHQHBBL8s", b"LOBJ", 32, 1, 48, 1, 2, 0, 0, number, 1, 0, 8, number, data)


def identifiers(path: Path) -> tuple[list[int], list[tuple[int, str]]]:
    frames, damages = read(path)
    return [frame[1] for frame in frames], [(damage.count, damage.reason) for damage in damages]


_NO_OBJECT = "no object where one should begin in this container"


def test_what_is_next_to_damage_in_a_blf_is_read(tmp_path: Path) -> None:
    made = [blf_object(i) for i in range(100)]
    path = blf_of(tmp_path / "a.blf", b"".join([*made[:50], b"JUNK" + made[50][4:], *made[51:]]))
    assert identifiers(path) == ([i for i in range(100) if i != 50], [(1, _NO_OBJECT)])
    path = blf_of(tmp_path / "b.blf", b"".join(made) + bytes(20))
    assert identifiers(path) == (list(range(100)), [(1, _NO_OBJECT)])


@pytest.mark.parametrize("cut", range(1, 48))
def test_a_blf_object_may_be_split_anywhere_also_if_data_spell_its_signature(tmp_path: Path, cut: int) -> None:
    made = b"".join(blf_object(i, b"LOBJ\x20\0\1\0") + bytes(3) for i in range(4))
    at = 2 * (48 + 3) - 3 + cut
    assert identifiers(blf_of(tmp_path / "a.blf", made[:at], made[at:])) == ([0, 1, 2, 3], [])


def test_broken_lines_are_skipped_counted_and_the_first_one_named(tmp_path: Path) -> None:
    frames = ordinary(3000)
    path = written(tmp_path, frames, ".log")
    lines = path.read_text().splitlines()
    lines[1499] = lines[1499][:20]
    lines[1999] = lines[1999].replace("#", "#F")
    lines[2499] = "(1.0) can0 123#0011223344556677889"
    lines.insert(2600, "")
    path.write_text("\n".join(lines))
    there, damages = read(path)
    assert there == [f for i, f in enumerate(frames) if i not in (1499, 1999, 2499)]
    assert [(d.count, d.place) for d in damages] == [(3, "line 1500")]
    assert "line 1500" in str(damages[0])


# --- not what it says it is ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.log", b"hello\n1,2\n", "line 1"),
        ("a.log", b"time,speed\n1,2\n", "a table of signals"),
        ("a.csv", b"time,speed\n1,2\n3,4\n", "a table of signals"),
        ("a.csv", b"moment,speed\n1,2\n3,4\n", ":1: neither.*SavvyCAN"),
        ("a.txt", b"hello\nworld\n", "'hello'"),
        ("a.trc", b"hello\n", "line 1"),
        ("a.asc", b"hello\nworld\n", "line 1"),
        ("a.blf", b"hello\n" * 50, "not a BLF"),
        ("a.mcap", b"GLOG" + bytes(500), "not an MCAP"),
        ("a.log.gz", b"(1.0) can0 123#00\n", "not a gzip"),
    ],
)
def test_a_file_of_another_format_is_refused(tmp_path: Path, name: str, content: bytes, said: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=said) as error:
        list(read_frames(path))
    assert name in str(error.value)


def test_an_mcap_of_other_things_is_refused(tmp_path: Path) -> None:
    from mcap.writer import Writer

    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/camera", "json", 0)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    with pytest.raises(InputError, match="/camera"):
        list(read_frames(path))


def test_mf4_is_read_where_asammdf_is_installed_and_else_says_so(tmp_path: Path) -> None:
    code = """
import sys
from gz_onboard.can.python_can import can
heavy = [name for name in ("pandas", "asammdf", "numpy") if name in sys.modules]
assert not heavy, heavy
from gz_onboard.recording.logs import read_frames
from gz_onboard.errors import InputError
try:
    import importlib.util
    there = importlib.util.find_spec("asammdf") is not None
    list(read_frames(sys.argv[1]))
except InputError as error:
    assert ("gz-onboard[mf4]" in str(error)) != there, error
else:
    raise AssertionError("a broken file was read")
"""
    path = tmp_path / "a.mf4"
    path.write_bytes(b"MDF     4.10    " + bytes(100))
    subprocess.run([sys.executable, "-c", code, str(path)], check=True)


# --- hostile ---------------------------------------------------------------------------------------------------


def chunk_at(data: bytes | bytearray, number: int) -> int:
    """Where the content of a chunk record begins, by the name of its compression."""
    at = -1
    for _ in range(number + 1):
        at = data.index(b"\x04\0\0\0zstd", at + 1)
    return at - 28


def three_chunks(path: Path) -> list[Frame]:
    frames = ordinary(1500)
    write_mcap(path, [frames[:500], frames[500:1000], frames[1000:]])
    return frames


def test_a_damaged_first_chunk_loses_only_its_own_frames(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    frames = three_chunks(path)
    data = bytearray(path.read_bytes())
    first = chunk_at(data, 0)
    data[first + 60] ^= 0x01
    path.write_bytes(data)
    there, damages = read(path)
    assert there == frames[500:]
    assert (damages[0].count, damages[0].place) == (1, f"byte {first}")


BOMB = """
import resource, sys
resource.setrlimit(resource.RLIMIT_AS, (2 << 30, 2 << 30))
from gz_onboard.recording.logs import read_frames, read_samples
from gz_onboard.errors import InputError
frames = [f for batch in read_frames(sys.argv[1], on_damage=print) for f in batch]
list(read_samples(sys.argv[1]))
print(len(frames))
"""


@pytest.mark.parametrize("told", [True, False])
def test_a_bomb_does_not_go_off(tmp_path: Path, told: bool) -> None:
    """A chunk of some kB that unpacks to 3 GiB, in a process that has 2: the others are read."""
    path = tmp_path / "a.mcap"
    three_chunks(path)
    data = path.read_bytes()
    at = chunk_at(data, 1)
    length = int.from_bytes(data[at - 8 : at], "little")
    packer = zstandard.ZstdCompressor(level=1).compressobj(size=3 << 30 if told else -1)
    packed = b"".join(packer.compress(bytes(1 << 24)) for _ in range(192)) + packer.flush()
    chunk = data[at : at + 16] + (3 << 30 if told else 1 << 20).to_bytes(8, "little") + data[at + 24 : at + 36]
    chunk += len(packed).to_bytes(8, "little") + packed
    path.write_bytes(data[: at - 8] + len(chunk).to_bytes(8, "little") + chunk + data[at + length :])
    out = subprocess.run([sys.executable, "-c", BOMB, path], capture_output=True, text=True, check=False)
    assert not out.stderr
    assert out.stdout.split()[-1] == "1000"
    assert "a chunk is broken" in out.stdout


@given(st.integers(0, 10**9), st.binary(min_size=1, max_size=20))
@settings(deadline=None, max_examples=150)
def test_rubbish_anywhere_ends_in_no_traceback(place: int, rubbish: bytes) -> None:
    with TemporaryDirectory() as directory:
        path = Path(directory) / "a.mcap"
        file = LogFile(path.open("wb"), START_S * 10**9, {"a": "b"}, {"a.dbc": b"text"})
        file.channel("/estimate", {"type": "object"})
        file.frames(ordinary(600))
        file.sample("/estimate", START_S * 10**9, {"a": 0})
        file.close()
        data = bytearray(path.read_bytes())
        at = 8 + place % (len(data) - 28)
        data[at : at + len(rubbish)] = rubbish
        path.write_bytes(data)
        with contextlib.suppress(InputError):
            read(path)
        for get in (read_attachments, read_metadata, json_channels, lambda path: list(read_samples(path))):
            get(path)
