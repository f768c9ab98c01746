"""Measure the cost of gz-onboard against the obvious pipeline of the same libraries (docs/results/benchmarks.md).

All times are CPU time of the measured process alone, user and system together, read from its own CPU clock; medians
over windows or repeats. On a kernel with CAN the frames go over a vcan, elsewhere over stand_in.py's sockets.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
RIDES = ROOT / "replay_logs"
BEGIN, END = "<!-- figures: begin -->\n", "<!-- figures: end -->"  # around the table of the page
RIDE, RIDE_2, SHORT_RIDE = RIDES / "city_14C.blf", RIDES / "city_34C.blf", RIDES / "coastdown.blf"
SATURATED = 4000.0  # frames/s of 8 bytes and 11-bit identifiers at 500 kbit/s
FILLERS = (0x300, 0x400, 0x401, 0x410, 0x411, 0x412)  # the fast messages without a counter that is checked
WINDOW = 5.0  # s
WARM_UP = 3.0  # s
TIMEOUT = 60.0  # s
FRAME = struct.Struct("=IB3x8s")
Send = Sequence[tuple[float, bytes]]  # (time since the start [s], struct can_frame)


@dataclass
class Live:
    """A live pipeline, measured while frames arrive; of several runs together."""

    shares: list[float] = field(default_factory=list)  # CPU s per s, in each window
    rate: float = 0.0  # frames/s sent
    received: int = 0
    sent: int = 0
    memory: float = 0.0  # MB resident, the most at the end of a run
    log_bytes: int = 0  # of the first and longest run, with its frames
    log_frames: int = 0

    @property
    def share(self) -> float:
        """Part of one processor."""
        return median(self.shares)

    @property
    def micros(self) -> float:
        """µs per frame received."""
        return self.share / self.rate * 1e6 * self.sent / max(self.received, 1)

    @property
    def lost(self) -> float:
        """Frames sent and not received, %."""
        return 100 * (1 - self.received / self.sent)

    @property
    def log(self) -> float:
        """Bytes of log per frame."""
        return self.log_bytes / self.log_frames


# --- live ---------------------------------------------------------------------------------------------------------


def has_can() -> bool:
    """Whether this kernel has CAN sockets and a vcan0 that is up."""
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as sock:
            sock.bind(("vcan0",))
        return True
    except (OSError, AttributeError):
        return False


def recorded(seconds: float) -> Send:
    """The beginning of a recorded ride in its own timing."""
    from gz_onboard.recording.logs import read_frames

    frames: list[tuple[float, bytes]] = []
    start = None
    for batch in read_frames(RIDE):
        for time_ns, identifier, data, _ in batch:
            start = time_ns if start is None else start
            frames.append(((time_ns - start) * 1e-9, FRAME.pack(identifier, len(data), data)))
        if frames[-1][0] > seconds:
            break
    return [frame for frame in frames if frame[0] <= seconds]


def saturated(seconds: float) -> Send:
    """The same, each fast message without checked counter repeated so often that the bus is full."""
    ride = recorded(seconds)
    fillers = [f for f in ride if int.from_bytes(f[1][:4], "little") in FILLERS]
    copies = round((SATURATED * seconds - len(ride)) / len(fillers))
    period = seconds * len(FILLERS) / len(fillers)  # about that of one of them
    more = [(t + period * (i + 1) / (copies + 1), frame) for t, frame in fillers for i in range(copies)]
    return sorted([*ride, *more])


def cpu(pid: int) -> float:
    """CPU time of a process [s], all its threads, from its CPU clock (clock_getcpuclockid(3))."""
    return time.clock_gettime((~pid << 3) | 2)


def resident(pid: int) -> float:
    """Resident memory of a process [MB]."""
    text = Path(f"/proc/{pid}/status").read_text()
    return int(re.search(r"VmRSS:\s+(\d+)", text)[1]) * 1024 / 1e6  # type: ignore[index]


@contextlib.contextmanager
def bus() -> Iterator[tuple[list[str], socket.socket]]:
    """What to put before `MODULE ARGUMENT...` to run a program on the bus, and the socket to send on."""
    if has_can():
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as sender:
            sender.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")  # do not read the answers
            sender.bind(("vcan0",))
            yield [sys.executable, "-m"], sender
        return
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.bind(("127.0.0.1", 0))
            port = other.getsockname()[1]
        sender.bind(("127.0.0.1", 0))
        sender.connect(("127.0.0.1", port))
        yield [sys.executable, str(HERE / "stand_in.py"), str(port), str(sender.getsockname()[1])], sender


@contextlib.contextmanager
def started(
    which: str, directory: Path, root: Path = ROOT
) -> Iterator[tuple[subprocess.Popen[str], socket.socket, float]]:
    """One of the pipelines once it is ready: its process, the socket to send on, its CPU time [s] until then.

    root: of the checkout that ours is run from.
    """
    ours = ["gz_onboard", "run", "--channel", "vcan0", "--log-dir", str(directory), "--state-dir", str(directory)]
    plain = ["plain", "live", "vcan0", str(directory / "plain.mcap")]
    notify = directory / "notify"
    environment = _environment(root) | {"NOTIFY_SOCKET": str(notify)}
    with bus() as (prefix, sender), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ready:
        ready.bind(str(notify))
        ready.settimeout(TIMEOUT)
        process = subprocess.Popen(
            [*prefix, *(ours if which == "ours" else plain)],
            env=environment,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        try:
            assert process.stdout
            line = ready.recv(4096) if which == "ours" else process.stdout.readline().encode()
            if not line.lower().startswith(b"ready"):
                raise RuntimeError(f"{which} did not start: {line!r}")
            yield process, sender, cpu(process.pid)
        finally:
            process.kill()
            process.wait()


def run_live(which: str, frames: Send, live: Live, root: Path = ROOT) -> None:
    """Send `frames` in their timing to one of the pipelines and measure it meanwhile; adds to `live`."""
    with tempfile.TemporaryDirectory() as name, started(which, Path(name), root) as (process, sender, _):
        time.sleep(0.5)
        used: list[tuple[float, float]] = []
        begin = time.perf_counter()
        mark = WARM_UP
        for at, frame in frames:
            pause = at - (time.perf_counter() - begin)
            if pause > 0:
                time.sleep(pause)
            with contextlib.suppress(ConnectionError):
                sender.send(frame)
            if at >= mark:
                used.append((time.perf_counter(), cpu(process.pid)))
                mark += WINDOW
        live.shares += [(c1 - c0) / (t1 - t0) for (t0, c0), (t1, c1) in pairwise(used)]
        time.sleep(0.5)
        live.memory = max(live.memory, resident(process.pid))
        process.send_signal(signal.SIGTERM)
        output = process.communicate(timeout=TIMEOUT)[0]
        found = re.search(r"received (\d+) frames", output)
        if not found:
            raise RuntimeError(f"{which}: {output}")
        live.rate = len(frames) / frames[-1][0]
        live.received += int(found[1])
        live.sent += len(frames)
        if not live.log_frames:
            live.log_frames = int(found[1])
            live.log_bytes = sum(path.stat().st_size for path in Path(name).glob("*.mcap"))


def compare_live(
    traffic: Callable[[float], Send], durations: Sequence[float], older: Path | None
) -> tuple[Live, Live, Live | None]:
    """(ours, plain, older), run in turns: on a machine that does other things too, its speed changes with time."""
    ours, plain, before = Live(), Live(), Live()
    for seconds in durations:
        frames = traffic(seconds)
        run_live("ours", frames, ours)
        run_live("plain", frames, plain)
        if older:
            run_live("ours", frames, before, older)
    return ours, plain, before if older else None


def start_up(which: str, repeats: int, root: Path = ROOT) -> float:
    """CPU time [s] until ready, median."""
    values = []
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as name, started(which, Path(name), root) as (_process, _sender, used):
            values.append(used)
    return median(values)


# --- offline ------------------------------------------------------------------------------------------------------


def offline_ours(root: Path, rides: Sequence[Path], *options: str) -> tuple[float, float]:
    """CPU time [s] of the whole process and the length of the rides [s]."""
    with tempfile.TemporaryDirectory() as name:
        before = os.times()
        command = [
            sys.executable,
            "-m",
            "gz_onboard",
            "estimate",
            *map(str, rides),
            "--no-plot",
            "--jobs=1",
            "--json=-",
        ]
        command += [f"--output={name}", *options]
        text = subprocess.run(
            command, check=True, stdout=subprocess.PIPE, text=True, env=_environment(root), cwd=name
        ).stdout
        after = os.times()
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return used, sum(ride["duration_s"] for ride in json.loads(text)["rides"])


def hour_ours(root: Path, repeats: int, *options: str) -> float:
    """CPU time [s] for a recorded hour: of a short ride, start-up included, and for the rest as of two longer ones."""
    short = [offline_ours(root, [SHORT_RIDE], *options) for _ in range(repeats)]
    long = [offline_ours(root, [RIDE, RIDE_2], *options) for _ in range(repeats)]
    cpu_0, cpu_1 = median(c for c, _ in short), median(c for c, _ in long)
    seconds_0, seconds_1 = short[0][1], long[0][1]
    return cpu_0 + (cpu_1 - cpu_0) / (seconds_1 - seconds_0) * (3600 - seconds_0)


def hour_plain(repeats: int, seconds: float, *options: str) -> tuple[float, float]:
    """(CPU time [s] for a recorded hour, scaled from the first `seconds` of a ride, bytes of log per frame)."""
    rows = []
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as name:
            command = [sys.executable, "-m", "plain", "offline", str(RIDE), f"{name}/plain.mcap"]
            text = subprocess.run(
                [*command, "--seconds", str(seconds), *options],
                check=True,
                stdout=subprocess.PIPE,
                text=True,
                env=_environment(ROOT),
                cwd=HERE,
            ).stdout
        rows.append(json.loads(text))
    per_second = median(row["cpu"] / row["seconds"] for row in rows)
    return median(row["start"] for row in rows) + 3600 * per_second, rows[0]["bytes"] / rows[0]["frames"]


# --- log ----------------------------------------------------------------------------------------------------------


def log_of_ride(directory: Path) -> tuple[int, int, dict[str, float]]:
    """Write the daemon's log of a whole recorded ride: bytes, frames received, share of each topic.

    The daemon's own pipeline and recorder, called as its loop calls them, at the ride's times.
    """
    from gz_onboard.can.recorder import Recorder
    from gz_onboard.daemon.loop import TICK
    from gz_onboard.pipeline import Pipeline, dbc_texts
    from gz_onboard.recording.logs import read_frames
    from gz_onboard.vehicle import read_vehicle

    vehicle = read_vehicle("reference")
    recorder = Recorder(directory, vehicle.name, metadata={"vehicle_key": vehicle.key}, attachments=dbc_texts(vehicle))
    pipeline = Pipeline(vehicle, log=recorder)
    frames = [frame for batch in read_frames(RIDE) for frame in batch]
    tick = round(TICK * 1e9)
    done = 0
    now = frames[0][0]
    while done < len(frames):
        now += tick
        end = done
        while end < len(frames) and frames[end][0] <= now:
            end += 1
        pipeline.advance(frames[done:end], now)
        recorder.sync(now)
        done = end
    recorder.close()
    size = sum(path.stat().st_size for path in recorder.paths)
    return size, len(frames), contents(recorder.paths[0])


def contents(log: Path) -> dict[str, float]:
    """Return bytes of a log by topic. Chunks hold several topics: their bytes are shared in proportion to each
    topic's messages, compressed alone."""
    import zstandard
    from mcap.records import Attachment, Chunk, Message
    from mcap.stream_reader import StreamReader, breakup_chunk

    sizes: dict[str, float] = {"index, schemas, summary": 0.0, "attached DBC files": 0.0}
    with log.open("rb") as file:
        topics: dict[int, str] = {}
        record: Any
        message: Any
        for record in StreamReader(file, emit_chunks=True).records:
            if isinstance(record, Attachment):
                sizes["attached DBC files"] += len(record.data)
            elif hasattr(record, "topic"):
                topics[record.id] = record.topic
            elif isinstance(record, Chunk):
                of_topic: dict[str, bytes] = {}
                for message in breakup_chunk(record):
                    if hasattr(message, "topic"):
                        topics[message.id] = message.topic
                    elif isinstance(message, Message):
                        topic = topics[message.channel_id]
                        kind = topic if not topic.startswith("/can/") or topic == "/can/frames" else "/can/MESSAGE"
                        of_topic[kind] = of_topic.get(kind, b"") + message.data
                alone = {kind: len(zstandard.compress(data)) for kind, data in of_topic.items()}
                whole = len(record.data)
                for kind, size in alone.items():
                    sizes[kind] = sizes.get(kind, 0.0) + whole * size / sum(alone.values())
    sizes["index, schemas, summary"] = log.stat().st_size - sum(sizes.values())
    return sizes


# --- parts --------------------------------------------------------------------------------------------------------


def cost(what: str, root: Path) -> dict[str, float]:
    """Figures of `cost.py` by name, of the checkout in `root`."""
    command = [sys.executable, str(HERE / "cost.py"), what]
    text = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=_environment(root)).stdout
    return {str(name): float(value) for name, value in json.loads(text).items()}


def _environment(root: Path) -> dict[str, str]:
    """The environment in which `root` is the package that Python imports, whatever is installed."""
    # With bytecode, as an installed package and the libraries have it.
    return os.environ | {"PYTHONPATH": f"{root}{os.pathsep}{HERE}", "PYTHONDONTWRITEBYTECODE": ""}


@contextlib.contextmanager
def checked_out(commit: str | None) -> Iterator[Path | None]:
    """A checkout of an older commit in a temporary folder; None without one."""
    if commit is None:
        yield None
        return
    git = ["git", "-C", str(ROOT), "worktree"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "older"
        subprocess.run([*git, "add", "--quiet", "--detach", str(folder), commit], check=True)
        try:
            yield folder
        finally:
            subprocess.run([*git, "remove", "--force", str(folder)], check=True)


# --- all ----------------------------------------------------------------------------------------------------------


@dataclass
class Table:
    """Rows of figures, printed as they come."""

    against: str | None
    rows: list[dict[str, Any]] = field(default_factory=list)

    def begin(self) -> None:
        """Print the head."""
        older = f"{self.against:>10}" if self.against else ""
        print(f"{'':52} {'unit':8} {'ours':>9} {'plain':>9} {'plain/ours':>10} {older}  aim")

    def row(
        self,
        what: str,
        unit: str,
        ours: float | None,
        plain: float | None = None,
        older: float | None = None,
        aim: str = "",
    ) -> None:
        """Add a row; None: not measured, or that checkout has no such part."""
        ratio = plain / ours if plain and ours and unit not in ("1", "%") else None
        self.rows.append({"what": what, "unit": unit, "ours": ours, "plain": plain, "older": older, "aim": aim})
        cells = [_cell(ours, 9), _cell(plain, 9), _cell(ratio, 10, 1), *([_cell(older, 10)] if self.against else [])]
        print(f"{what:52} {unit:8} {' '.join(cells)}  {aim}", flush=True)

    def markdown(self) -> list[str]:
        """The table of docs/results/benchmarks.md."""
        head = ["", "unit", "ours", "plain", "plain / ours", *([f"at {self.against}"] if self.against else []), "aim"]
        lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
        for row in self.rows:
            ours, plain = row["ours"], row["plain"]
            ratio = f"{plain / ours:.1f}" if plain and ours and row["unit"] not in ("1", "%") else ""
            cells = [row["what"].replace("  ", "– "), row["unit"], _cell(ours).strip(), _cell(plain).strip(), ratio]
            cells += [_cell(row["older"]).strip()] if self.against else []
            lines.append(f"| {' | '.join([*cells, row['aim']])} |")
        return lines


def _cell(value: float | None, width: int = 0, digits: int = 2) -> str:
    return f"{'' if value is None else f'{value:.{digits}f}':>{width}}"


def measure(table: Table, seconds: float, repeats: int, older: Path | None) -> None:
    """All rows."""

    def both(figure: Callable[[Path], float]) -> tuple[float, float | None]:
        return figure(ROOT), figure(older) if older else None

    for traffic, name, most, aim in (
        (recorded, "as recorded", seconds, "ratio ≥ 5"),
        (saturated, "saturated", 18.5, "ratio ≥ 7"),
    ):
        ours, plain, before = compare_live(
            traffic, [min(seconds, most), *[min(seconds, 23.5, most)] * (repeats - 1)], older
        )
        figures: list[tuple[str, str, Callable[[Live], float], str]] = [
            (f"live, {ours.rate:.0f} frames/s, {name}, with log", "µs/frame", lambda x: x.micros, aim),
            ("  CPU of one processor", "%", lambda x: 100 * x.share, ""),
            ("  frames lost", "%", lambda x: x.lost, ""),
            ("  resident memory at the end", "MB", lambda x: x.memory, "< 40"),
        ]
        for what, unit, figure, aimed in figures:
            table.row(what, unit, figure(ours), figure(plain), figure(before) if before else None, aimed)
    now, then = both(lambda root: start_up("ours", repeats, root))
    table.row("start-up until ready", "CPU s", now, start_up("plain", repeats), then, "< 0.25")

    plain_hour, plain_bytes = hour_plain(repeats, 120.0)
    now, then = both(lambda root: hour_ours(root, repeats))
    table.row("estimate of a recorded hour", "CPU s", now, plain_hour, then, "ratio ≥ 10")
    now, then = both(lambda root: hour_ours(root, repeats, "--frames", "--signals"))
    table.row("  with the raw frames and signals logged", "CPU s", now, plain_hour, then)

    for what, unit in (("pipeline", "µs/frame"), ("parts", "µs"), ("simulation", "CPU s")):
        found, found_before = cost(what, ROOT), cost(what, older) if older else {}
        for name in dict.fromkeys([*found, *found_before]):
            table.row(name, unit, found.get(name), None, found_before.get(name))

    with tempfile.TemporaryDirectory() as folder:
        size, frames, shares = log_of_ride(Path(folder))
    table.row("log of a whole recorded ride, all in", "B/frame", size / frames, plain_bytes, aim="≤ 13")
    for part, held in sorted(shares.items(), key=lambda item: -item[1]):
        table.row(f"  {part}", "B/frame", held / frames)


def main() -> None:
    """Measure all, print a table and write it into docs/results/benchmarks.md."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures as JSON too")
    parser.add_argument("--seconds", type=float, default=63.0, help="of the longest live run (%(default)g)")
    parser.add_argument("--repeats", type=int, default=3, help="of each measurement (%(default)s)")
    parser.add_argument("--against", metavar="COMMIT", help="measure an older commit in the same run, too")
    parser.add_argument(
        "--page", type=Path, metavar="FILE", help="write the table into this page, such as docs/results/benchmarks.md"
    )
    arguments = parser.parse_args()
    os.environ["PYTHONPATH"] = f"{ROOT}{os.pathsep}{HERE}"  # this checkout, whatever is installed
    seconds, repeats = max(arguments.seconds, WARM_UP + 2 * WINDOW + 1), arguments.repeats

    where = "vcan0" if has_can() else "UDP sockets instead of CAN sockets, for both pipelines (benchmarks/stand_in.py)"
    machine = f"Python {sys.version.split()[0]}, {os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}"
    print(f"{machine}\nlive frames over {where}\n")
    table = Table(arguments.against)
    table.begin()
    with checked_out(arguments.against) as older:
        measure(table, seconds, repeats, older)
    if arguments.json:
        document = {"python": sys.version, "transport": where, "load": os.getloadavg(), "rows": table.rows}
        arguments.json.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    if arguments.page:
        text = arguments.page.read_text(encoding="utf-8")
        before, _, rest = text.partition(BEGIN)
        _, _, after = rest.partition(END)
        git = ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"]
        commit = subprocess.run(git, check=True, capture_output=True, text=True).stdout.strip()
        made = f"Measured on commit {commit}. {machine}. Live frames over {where}."
        lines = [BEGIN, made, "", *table.markdown(), "", END]
        arguments.page.write_text(before + "\n".join(lines) + after, encoding="utf-8")


if __name__ == "__main__":
    main()
