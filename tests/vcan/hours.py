"""Hours of a scooter's life on vcan0, in seconds: the scooter of tests/estimator/life.py, and a daemon in its time."""

from __future__ import annotations

import re
import shutil
import socket
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from math import pi
from pathlib import Path
from typing import Any

from cantools.database.can import Message
from cantools.database.can.signal import Signal

from gz_onboard import state
from gz_onboard.state import state_file
from gz_onboard.vehicle import OWN, read_vehicle
from tests.estimator.life import CELLS, INVERTER, MOTOR, OTHERS, PACK, PERIOD
from tests.estimator.life import Scooter as Ridden
from tests.events import Event
from tests.support import EPOCH, ROOT, S, Scooter, range_database
from tests.vcan.paced import LARGEST, WAITING, packet
from tests.vcan.support import Daemon, Running

FRAME = struct.Struct("=IB3x8s")
ROUND, LONG_ROUND = 1.0, 4.0  # s of the scooter's time in a round of the daemon; beyond 5 s it would be a pause
SETTLED = 0.05  # s after the pack's message all others have come
STARTED = 1000.0  # s that the machine has been on when the scooter begins to live
PATIENCE = 120.0  # s of the machine's time for a round
HEARD = (  # roles: what tests/estimator/life.py tells
    *("pack_voltage", "pack_current", "bms_state_of_charge", "motor_speed", "inverter_voltage", "inverter_current"),
    *("cell_temperature", "ambient_temperature", "odometer", "charge_plug"),
)
MESSAGES: dict[int, list[tuple[str, dict[str, tuple[int, float]]]]] = {  # of each group: signals, by place and unit
    PACK: [("BMS_Pack", {"BMS_PackVoltage": (0, 1), "BMS_PackCurrent": (1, 1), "BMS_StateOfCharge": (2, 100)})],
    MOTOR: [("INV_Motion", {"INV_MotorSpeed": (0, 30 / pi)})],
    INVERTER: [("INV_Power", {"INV_DcVoltage": (0, 1), "INV_DcCurrent": (1, 1)})],
    CELLS: [("BMS_Cells", {"BMS_CellTempMean": (0, 1)}), ("TC_Ambient", {"TC_Ambient": (1, 1)})],
    OTHERS: [("VCU_Odometer", {"VCU_Odometer": (0, 1e-3)}), ("VCU_Rider", {"VCU_ChargePlug": (1, 1)})],
}
PERIODS = {256: round(1000 * PERIOD), 768: 1000}  # ms, by identifier: slower than on the reference scooter


def vehicle_file(folder: Path) -> Path:
    """The reference scooter with those sensors only, and with messages as slow as they come here."""
    dbc = (ROOT / "dbc" / "vehicle.dbc").read_text()
    for identifier, period in PERIODS.items():
        dbc, count = re.subn(rf'("GenMsgCycleTime" BO_ {identifier}) \d+;', rf"\1 {period};", dbc)
        assert count == 1
    (folder / "life.dbc").write_text(dbc)
    shutil.copy(ROOT / "dbc" / "hbm.dbc", folder)
    text = (OWN / "reference.toml").read_text()
    before, roles, after = re.split(r"(?s)(\[roles\]\n.*?\n\n)", text, maxsplit=1)
    kept = [line for line in roles.splitlines() if line.split(" ")[0] in ("[roles]", *HEARD)]
    assert len(kept) == 1 + len(HEARD)
    file = folder / "life.toml"
    file.write_text(before.replace('"vehicle.dbc"', '"life.dbc"') + "\n".join([*kept, "", ""]) + after)
    return file


@cache
def definition(signal: str) -> tuple[Message, Signal]:
    """A signal of the range frames, and its message."""
    for message in range_database().messages:
        for found in message.signals:
            if found.name == signal:
                return message, found
    raise KeyError(signal)


@dataclass
class Told:
    """The range frames at the end of a round, and what is true then."""

    time: float  # s
    soc: float
    energy: float  # J drawn since the scooter began to live
    frames: dict[int, bytes]  # the last of each identifier

    def __getitem__(self, name: str) -> Any:
        """The value of a signal; None if it says that there is none."""
        message, signal = definition(name)
        data = self.frames[message.frame_id]
        raw: Any = message.decode(data, decode_choices=False, scaling=False)
        values: Any = message.decode(data, decode_choices=False)
        absent = -(2 ** (signal.length - 1)) if signal.is_signed else 2**signal.length - 1
        return None if signal.length >= 8 and raw[name] == absent else values[name]

    @property
    def error(self) -> float:
        """Of the state of charge, in its own sigma."""
        return float(abs(self["RANGE_StateOfCharge"] - 100 * self.soc) / self["RANGE_StateOfChargeSigma"])


class Hours:
    """One scooter on vcan0, and one daemon after the other there."""

    def __init__(self, running: Running, folder: Path, scooter: Ridden) -> None:
        self.scooter = scooter
        self.file = vehicle_file(folder)
        self.vehicle = read_vehicle(str(self.file), 75.0)
        self._running = running
        self._packer = Scooter()
        self._pace: socket.socket | None = None
        self._bus = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        wanted = b"".join(struct.pack("=II", m.frame_id, socket.CAN_SFF_MASK) for m in range_database().messages)
        self._bus.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, wanted)
        self._bus.bind(("vcan0",))
        self._bus.setblocking(False)
        self._heard: dict[int, bytes] = {}

    def close(self) -> None:
        """Leave the bus."""
        self._bus.close()
        if self._pace:
            self._pace.close()

    def start(self, *options: str, name: str = "a") -> Daemon:
        """A daemon that waits for its first round."""
        self._pace, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._pace.settimeout(PATIENCE)
        self._pace.send(packet(stamp(self.scooter.time), ()))
        with other:
            own = "--vehicle", str(self.file), "--payload", "75"
            program = "tests.vcan.paced", str(other.fileno())
            daemon = self._running.daemon(*own, *options, name=name, program=program, files=[other.fileno()])
        self._await()
        return daemon

    def save(self, snapshot: Mapping[str, Any] | None, name: str = "a", age: float = 0.0) -> Path:
        """Have the next daemon find `snapshot` as the state that was saved `age` [s] ago; gives its file."""
        assert snapshot
        file = state_file(self._running.folder(name), self.vehicle.name)
        at = self.scooter.time - age
        state.write(file, state.encode(snapshot, stamp(at) / S, STARTED + at))
        return file

    def stop(self, daemon: Daemon) -> str:
        """End the daemon as systemd does; gives its summary."""
        daemon.process.terminate()
        if self._pace:
            self._pace.close()
        return daemon.stop(PATIENCE)

    def kill(self, daemon: Daemon) -> None:
        """End the daemon as a power cut does."""
        daemon.process.kill()
        daemon.process.wait()
        if self._pace:
            self._pace.close()

    def live(self, events: Iterable[Event], every: float = ROUND) -> list[Told]:
        """Have the scooter live, with the daemon beside it in rounds of `every` [s]; what is told after each."""
        rows: list[Told] = []
        frames: list[tuple[float, bytes]] = []
        due = self.scooter.time + every
        for time, group, values in events:
            if time > due + SETTLED:
                rows.append(self._round(frames, due + SETTLED))
                frames = []
                due += every
            frames += [(time, frame) for frame in self._packed(group, values)]
        rows.append(self._round(frames, self.scooter.time + SETTLED))
        return rows

    def _round(self, frames: Sequence[tuple[float, bytes]], until: float) -> Told:
        """What came up to a time [s] goes onto the bus, and the daemon through a round."""
        assert self._pace
        for _, frame in frames:
            self._bus.send(frame)
        self._pace.send(packet(stamp(until), [stamp(time) for time, _ in frames]))
        self._await()
        with suppress(BlockingIOError):
            while True:
                identifier, length, data = FRAME.unpack(self._bus.recv(FRAME.size))
                self._heard[identifier] = data[:length]
        return Told(until, self.scooter.soc, self.scooter.energy, dict(self._heard))

    def _packed(self, group: int, values: Sequence[float | None]) -> Iterator[bytes]:
        """The frames of an event."""
        for name, signals in MESSAGES[group]:
            told = {signal: unit * (values[i] or 0.0) for signal, (i, unit) in signals.items()}
            _, identifier, data, _ = self._packer.frame(name, 0, 0, **told)
            yield FRAME.pack(identifier, len(data), data)

    def _await(self) -> None:
        assert self._pace
        assert self._pace.recv(LARGEST) == WAITING, "the daemon has ended"


def stamp(time: float) -> int:
    """When that is on the bus [ns since the epoch], by the scooter's time [s]."""
    return EPOCH + round((STARTED + time) * S)
