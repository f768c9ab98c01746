"""A recorded ride through the daemon, on a bus: what `make run` shows.

On a vcan the daemon, the replay and the dashboard are three processes that share nothing but the bus. On
python-can's `virtual` interface, which ends where the process ends, they are three threads of this one. A second
dashboard serves the page for a browser; where Chromium is, it is photographed. In a guest, whose network no browser
outside reaches, that is done inside.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can

from gz_onboard.bus.logs import read_frames
from gz_onboard.bus.publisher import Publisher
from gz_onboard.events import EFF_FLAG, TRANSMITTED
from gz_onboard.vehicle import read_vehicle

ROOT = Path(__file__).resolve().parents[1]
BIN = Path(sys.executable).parent
GUEST = Path("/run/vcan-guest")
READY_WITHIN = 30.0  # s
STOPPED_WITHIN = 15.0  # s
PORT = 8000  # of the page, if it is free


def main() -> int:
    """Play the ride, then show what it left behind."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ride", type=Path)
    parser.add_argument("--interface", default="socketcan", choices=["socketcan", "virtual"])
    parser.add_argument("--channel", default="vcan0")
    parser.add_argument("--vehicle", default="reference")
    parser.add_argument("--speed", type=float, default=1.0, help="of the replay; 1 is the ride's own timing")
    parser.add_argument("--seconds", type=float, default=60.0, help="end the replay after this long")
    parser.add_argument("--output", type=Path, help="the folder for what it leaves behind (default: one in runs/)")
    args = parser.parse_args()
    if not args.ride.is_file():
        parser.error(f"no such ride: {args.ride}")

    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)  # in the order of what the other processes write
    directory = args.output or ROOT / "runs" / time.strftime("%Y%m%dT%H%M%S")
    directory.mkdir(parents=True)
    bus = ["--interface", args.interface, "--channel", args.channel]
    own_directories = ["--log-dir", str(directory), "--state-dir", str(directory)]
    daemon = ["run", "--vehicle", args.vehicle, *bus, *own_directories]
    replay = ["replay", str(args.ride), *bus, "--speed", str(args.speed)]
    dbc = read_vehicle(args.vehicle).range_dbc
    dashboard = ["dashboard", *bus, "--vehicle", args.vehicle]
    listen = f"127.0.0.1:{free_port()}"
    page = [*dashboard, "--web", "--listen", listen]

    where = "in-process virtual bus" if args.interface == "virtual" else f"{args.channel} of Linux {os.uname().release}"
    print(f"=== {args.ride.name} on the {where}, for at most {args.seconds:g} s")
    print(f"=== The dashboard's page{' (inside the guest)' if GUEST.is_dir() else ''}: http://{listen}/")
    frames, picture = directory / "range.log", directory / "page.png"
    play = play_in_threads if args.interface == "virtual" else play_in_processes
    with (
        recording(args.interface, args.channel, frames, dbc),
        photographing(f"http://{listen}/", picture),
        listening_for_ready() as wait_until_ready,
    ):
        status = play(daemon, replay, dashboard, page, wait_until_ready, args.seconds)
    if status:
        print(f"demo: ended with status {status}", file=sys.stderr)
        return status

    (log,) = directory.glob("*.mcap")
    show_decoded(frames, log, dbc)
    overview = directory / "overview.png"
    subprocess.run([BIN / "gz-onboard", "plot", log, overview], check=True)
    print("\n=== What the ride left behind")
    for what, path in ("log", log), ("overview", overview), ("range frames", frames), ("page", picture):
        if path.exists():
            print(f"{what:13} {path.relative_to(ROOT) if path.is_relative_to(ROOT) else path}")
    if not picture.exists():
        print(f"{'page':13} was at http://{listen}/; no picture of it, which takes Chromium and some seconds")
    return 0


@contextlib.contextmanager
def recording(interface: str, channel: str, file: Path, dbc: Path) -> Iterator[None]:
    """Record the range frames, and nothing else, as candump does."""
    filters = [
        can.typechecking.CanFilter(can_id=i & ~EFF_FLAG, can_mask=0x1FFFFFFF, extended=bool(i & EFF_FLAG))
        for i in Publisher(dbc).identifiers
    ]
    with can.Bus(interface=interface, channel=channel, can_filters=filters) as bus:
        writer = can.CanutilsLogWriter(file, channel=channel)
        notifier = can.Notifier(bus, [writer])
        try:
            yield
        finally:
            notifier.stop()
            writer.stop()


def free_port() -> int:
    """`PORT`, or another one if it is taken."""
    for port in PORT, 0:
        with contextlib.suppress(OSError), socket.socket() as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind(("127.0.0.1", port))
            return int(trial.getsockname()[1])
    raise OSError("no free port on 127.0.0.1")


@contextlib.contextmanager
def photographing(address: str, picture: Path) -> Iterator[None]:
    """Meanwhile have a browser make a picture of the page as soon as it shows a range, if there is one."""
    if not shutil.which("chromium"):
        yield
        return
    camera = [sys.executable, "-m", "tests.browser.photograph", address, str(picture.resolve())]
    with subprocess.Popen(camera, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            yield
        finally:
            process.terminate()


@contextlib.contextmanager
def listening_for_ready() -> Iterator[Callable[[], bool]]:
    """What systemd does for a service: hear the daemon say that it is ready. Yields the function that waits for it."""
    with tempfile.TemporaryDirectory() as directory, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        os.environ["NOTIFY_SOCKET"] = f"{directory}/notify"
        server.bind(os.environ["NOTIFY_SOCKET"])
        server.settimeout(READY_WITHIN)

        def wait() -> bool:
            with contextlib.suppress(TimeoutError):
                return server.recv(4096).startswith(b"READY=1")
            return False

        yield wait
        del os.environ["NOTIFY_SOCKET"]


def play_in_processes(
    daemon: list[str],
    replay: list[str],
    dashboard: list[str],
    page: list[str],
    wait_until_ready: Callable[[], bool],
    seconds: float,
) -> int:
    """Run the commands as processes; the daemon's exit status."""
    command = str(BIN / "gz-onboard")
    with contextlib.ExitStack() as stack:
        daemon_process = stack.enter_context(subprocess.Popen([command, *daemon]))
        stack.callback(daemon_process.terminate)
        if not wait_until_ready():
            return daemon_process.poll() or 1
        stack.callback(stack.enter_context(subprocess.Popen([command, *page])).terminate)
        dashboard_process = stack.enter_context(subprocess.Popen([command, *dashboard]))
        stack.callback(dashboard_process.terminate)
        with contextlib.suppress(subprocess.TimeoutExpired):  # a ride may be longer than the demonstration
            subprocess.run([command, *replay], timeout=seconds, check=True)
        if dashboard_process.poll() is not None:
            print("demo: the dashboard ended before the ride did", file=sys.stderr)
            return 1
        dashboard_process.terminate()
        dashboard_process.wait(STOPPED_WITHIN)
        daemon_process.terminate()
        return daemon_process.wait(STOPPED_WITHIN)


def play_in_threads(
    daemon: list[str],
    replay: list[str],
    dashboard: list[str],
    page: list[str],
    wait_until_ready: Callable[[], bool],
    seconds: float,
) -> int:
    """Run the commands in this process, the daemon in the main thread, where signals arrive."""
    from gz_onboard import cli

    def the_rest() -> None:
        if wait_until_ready():
            for command in [page, replay]:
                threading.Thread(target=cli.main, args=(command,), daemon=True).start()
            cli.main([*dashboard, "--duration", str(seconds)])  # no signal can end it in a thread
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=the_rest, daemon=True).start()
    return cli.main(daemon)


def show_decoded(frames: Path, log: Path, dbc: Path) -> None:
    """Print the last frame of each kind while the vehicle still sent, decoded by the cantools command."""
    ended = max(frame[0] for batch in read_frames(log) for frame in batch if not frame[3] & TRANSMITTED) * 1e-9
    lines = [line for line in frames.read_text().splitlines() if float(line[1 : line.index(")")]) <= ended]
    last = {line.split()[2].partition("#")[0]: line for line in lines}
    print(
        "\n=== The ride has ended. Of a bus that falls silent the daemon says degraded, and soon that nothing is known."
    )
    print(f"=== The last range frames of the ride: cantools decode {dbc.name} <{frames.name}")
    decode = [str(BIN / "cantools"), "decode", str(dbc)]
    text = subprocess.run(decode, input="\n".join(last.values()), check=True, capture_output=True, text=True).stdout
    print(re.sub(r"\d+\.\d{9,}", lambda number: f"{float(number[0]):.9g}", text.strip()))  # not 2.8000000000000003


if __name__ == "__main__":
    sys.exit(main())
