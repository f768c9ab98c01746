"""What several tests need: frames of the reference scooter, a steady ride of it, recorded rides, and runs of them."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from math import isfinite, log
from pathlib import Path
from typing import Any

from cantools.database.can import Database, Message

from gz_onboard.can.dbc import find_dbc, load_database
from gz_onboard.can.layout import crc8_sae_j1850
from gz_onboard.can.logfile import LogFile
from gz_onboard.events import EFF_FLAG, ERR_FLAG, RTR_FLAG, TRANSMITTED, Estimate, Frame, Reason, State
from gz_onboard.export.logs import write_frames_as
from gz_onboard.model.battery import Battery
from gz_onboard.model.effect import Effect, Port
from gz_onboard.model.parameters import Parameters, Value
from gz_onboard.pipeline import TICK_NS, Pipeline
from gz_onboard.recording.decode import feed
from gz_onboard.recording.frames import FrameColumns
from gz_onboard.recording.logs import read_frames
from gz_onboard.vehicle import OWN, Vehicle, read_vehicle

ROOT = Path(__file__).resolve().parents[1]
LOGS = ROOT / "replay_logs"
MS = 1_000_000
S = 1_000_000_000
EPOCH = 1_700_000_000 * S
HEARS_CTRL_C = ("env", "--default-signal=INT")
"""Before a command: a shell that runs the tests in the background has them, and all that they start, ignore SIGINT."""


@cache
def reference() -> Vehicle:
    return read_vehicle("reference")


def wait_for(condition: Callable[[], Any], what: str, seconds: float = 60.0) -> Any:
    """What `condition` gives as soon as that is true; fails with `what` after `seconds`."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, f"not within {seconds:g} s: {what}"
        time.sleep(0.02)
    return found


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """The kernel refuses to let any file grow beyond this: like a full disk, an error in the middle of a write."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def cell_voltage(battery: Battery, soc: float, v1: float, current: float, temperature: float) -> float:
    """The voltage [V] of a cell at `current` [A] and `temperature` [degC]; v1 [V]: of its RC pair."""
    return battery.ocv(soc, temperature)[0] - battery.r0.at(soc, temperature)[0] * current - v1


def joined(parameters: Parameters, effects: Iterable[Effect]) -> Parameters:
    """The `parameters` with those of `effects` that are not among them, at their priors."""
    new = {p.name: p for effect in effects for p in effect.parameters if p.name not in parameters}
    values = {name: Value(p.prior, p.prior_sd, p.unit, "guess", f"prior: {p.source}") for name, p in new.items()}
    return Parameters(parameters.known | values, parameters.declared | new)


def write_log(file: Path, frames: Sequence[Frame]) -> Path:
    """A log of `frames` in the format of the file's name: MCAP and candump exactly, others by python-can."""
    if file.suffix == ".mcap":
        log = LogFile(file.open("wb"), frames[0][0])
        log.frames(frames)
        log.close()
    elif file.suffix == ".log":
        file.write_text("".join(map(_candump_line, frames)))
    else:
        write_frames_as(file, file.suffix, [list(frames)])
    return file


def _candump_line(frame: Frame) -> str:
    time_ns, identifier, data, channel = frame
    wide = identifier & (EFF_FLAG | ERR_FLAG)
    name = f"{identifier & (0x1FFF_FFFF | ERR_FLAG):0{8 if wide else 3}X}"
    content = f"R{len(data) or ''}" if identifier & RTR_FLAG else "#0" * (len(data) > 8) + data.hex()
    sent = " T" if channel & TRANSMITTED else ""
    return f"({time_ns / 1e9:.6f}) can{channel & ~TRANSMITTED} {name}#{content}{sent}\n"


def with_cell_voltages(folder: Path) -> Vehicle:
    """The reference scooter with a battery management that sends what its DBC has, its file in `folder`."""
    text = (OWN / "reference.toml").read_text(encoding="utf-8")
    text = text.replace("[roles]", '[roles]\nlowest_cell_voltage = "BMS_CellVoltageMin"')
    text = text.replace("[instruments]", '[instruments]\nhighest_cell_voltage = "BMS_CellVoltageMax"')
    (folder / "scooter.toml").write_text(text, encoding="utf-8")
    return read_vehicle(folder / "scooter.toml")


def without_cell_effects(vehicle: Vehicle) -> Vehicle:
    """The vehicle with R0 and the RC pair only in its cells."""
    kept = tuple(effect for effect in vehicle.model.effects if effect.port is not Port.CELL_VOLTAGE)
    return vehicle.changed(vehicle.parameters, kept)


@cache
def range_database(file: Path | None = None) -> Database:
    """What decodes range frames: by the package's range.dbc, or by another file."""
    return load_database([file or find_dbc("range.dbc")])


def message(name: str) -> Message:
    """A message of the reference scooter."""
    return reference().mapping.database.get_message_by_name(name)


def identifier(name: str) -> int:
    return int(message(name).frame_id)


def sealed(data: bytes) -> bytes:
    """`data` with the checksum of the seven bytes before it."""
    return data[:-1] + bytes([crc8_sae_j1850(data[:-1])])


def changed(frame: Frame, **raw: int) -> Frame:
    """`frame` with other raw values of some of its signals, and with the right checksum if its message has one."""
    definition = reference().mapping.database.get_message_by_frame_id(frame[1])
    values: Any = definition.decode(frame[2], decode_choices=False, scaling=False)
    data = definition.encode(values | raw, scaling=False, strict=False)
    protection = reference().mapping.protection.get(definition.name)
    return frame[0], frame[1], sealed(data) if protection and protection.crc else data, frame[3]


def not_available(name: str) -> int:
    """The raw value by which the signal `name` says that it has none."""
    for definition in reference().mapping.database.messages:
        for signal in definition.signals:
            if signal.name == name:
                return int(-(2 ** (signal.length - 1)) if signal.is_signed else 2**signal.length - 1)
    raise KeyError(name)


class Scooter:
    """Frames of the reference scooter, each message with its own running counter and its checksum."""

    def __init__(self) -> None:
        self._counters: dict[str, int] = {}

    def frame(self, name: str, time_ns: int, channel: int = 0, **values: float) -> Frame:
        """One frame of the message `name` in the units of the DBC; signals not given are 0."""
        definition = message(name)
        complete = {signal.name: 0.0 for signal in definition.signals} | values
        protection = reference().mapping.protection.get(name)
        if protection and protection.counter:
            self._counters[name] = (self._counters.get(name, -1) + 1) % 15
            complete[protection.counter] = self._counters[name]
        data = definition.encode(complete, strict=False)
        return time_ns, int(definition.frame_id), sealed(data) if protection and protection.crc else data, channel

    def steady(
        self,
        seconds: float,
        begin_ns: int = EPOCH,
        speed: float = 10.0,
        current: float = 8.0,
        voltage: float = 52.0,
        ambient: float = 20.0,
        hbm: int = 0,
    ) -> list[Frame]:
        """A ride at constant speed [m/s], pack current [A] and voltage [V], on a level road to the north.

        Every mapped message in its period; those of the measuring system are on channel `hbm`.
        """
        turn = speed / reference().parameters["wheel_radius"]  # rad/s
        auxiliary = 45.0 / voltage
        north = 45.0
        frames: list[Frame] = []

        def every(period: int, phase: int, name: str, channel: int = 0, **values: float) -> None:
            for t in range(phase * MS, round(seconds * S), period * MS):
                frames.append(self.frame(name, begin_ns + t, channel, **values))

        every(10, 0, "INV_Motion", INV_MotorSpeed=turn * 9.5492966, INV_MotorCurrent=20, INV_MotorTorque=9)
        every(
            100,
            1,
            "INV_Power",
            INV_DcVoltage=voltage,
            INV_DcCurrent=current - auxiliary,
            INV_Temperature=30,
            INV_MotorTemperature=40,
            INV_CurrentLimit=150,
        )
        every(100, 2, "BMS_Pack", BMS_PackVoltage=voltage, BMS_PackCurrent=current, BMS_StateOfCharge=70)
        every(1000, 3, "BMS_Cells", BMS_CellTempMean=25, BMS_CellVoltageMin=3.7, BMS_CellVoltageMax=3.72)
        for phase, accel_z in ((4, 9.83), (14, 9.79), (24, 9.82)):  # one that never changes on the road is stuck
            every(30, phase, "IMU_Acceleration", hbm, IMU_AccelZ=accel_z)
        every(10, 4, "IMU_AngularRate", hbm)
        every(20, 5, "HBM_Wheels", hbm, HBM_WheelSpeedFront=turn / 6.2831853, HBM_WheelSpeedRear=turn / 6.2831853)
        every(100, 6, "HBM_Auxiliary", hbm, HBM_AuxCurrent=auxiliary)
        every(1000, 7, "TC_Ambient", hbm, TC_Ambient=ambient)
        for t in range(8 * MS, round(seconds * S), 200 * MS):
            here = north + speed * t / S / 111_200.0
            frames.append(self.frame("GPS_Position", begin_ns + t, hbm, GPS_Latitude=here, GPS_Longitude=9.0))
        every(200, 9, "GPS_Motion", hbm, GPS_Speed=speed, GPS_Altitude=200.0, GPS_Satellites=9, GPS_Fix=3)
        frames.sort(key=lambda frame: frame[0])
        return frames


@cache
def recorded(name: str, begin: float = 0.0, end: float = 1e6) -> tuple[Frame, ...]:
    """The frames of a recorded ride of the project, from and to a time [s] in it."""
    batches = list(read_frames(LOGS / f"{name}.blf"))
    first = batches[0][0][0]
    low, high = first + round(begin * S), first + round(end * S)
    return tuple(frame for batch in batches for frame in batch if low <= frame[0] < high)


class Run:
    """A pipeline, with everything that it makes of the frames that it is fed; it is the pipeline's log."""

    def __init__(self, vehicle: Vehicle | None = None) -> None:
        self.estimates: list[Estimate] = []
        self.logged: list[Frame] = []  # received and sent
        self.samples: list[tuple[str, int, Mapping[str, Any]]] = []
        self.pipeline = Pipeline(vehicle or reference(), log=self, observer=self.estimates.append)

    def channel(self, topic: str, json_schema: Mapping[str, Any]) -> None:
        """Every topic is taken."""

    def frames(self, batch: Sequence[Frame]) -> None:
        """Keep raw frames."""
        self.logged += batch

    def sample(self, topic: str, time_ns: int, values: Mapping[str, object], seen_ns: int | None = None) -> None:
        """Keep one JSON object."""
        self.samples.append((topic, time_ns, values))

    @property
    def sent(self) -> list[Frame]:
        """The frames that go onto the bus."""
        return [frame for frame in self.logged if frame[3] & TRANSMITTED]

    def at(self, time: float) -> Estimate:
        """The last estimate that is not after `time` [s from the first frame]."""
        return [e for e in self.estimates if e.time <= time + 1e-6][-1]

    def between(self, begin: float, end: float) -> list[Estimate]:
        """The estimates of a time [s from the first frame]."""
        return [e for e in self.estimates if begin - 1e-6 <= e.time <= end + 1e-6]

    @property
    def faults(self) -> dict[tuple[str, str], int]:
        """What was dropped, by message and reason."""
        return self.pipeline.codec.faults


def ridden(frames: Sequence[Frame], vehicle: Vehicle | None = None) -> Run:
    """The frames through a new pipeline as an offline estimate does it."""
    run = Run(vehicle)
    feed(run.pipeline, FrameColumns.of(frames))
    return run


def received(frames: Iterable[tuple[int, Frame]], vehicle: Vehicle | None = None) -> Run:
    """The frames through a new pipeline as the daemon does it, in rounds of a tick; each comes with when it arrives.

    The time of arrival [ns] is what the daemon's own clock shows, whatever time the frame bears.
    """
    run = Run(vehicle)
    waiting: list[Frame] = []
    due: int | None = None
    for arrival, frame in frames:
        due = arrival if due is None else due
        while arrival >= due:
            run.pipeline.advance(waiting, due)
            waiting = []
            due += TICK_NS
        waiting.append(frame)
    if due is not None:
        run.pipeline.advance(waiting, due)
    return run


def spread(estimate: Estimate) -> float:
    """How wide the range's interval is: the logarithm of P90 over P10."""
    assert estimate.range_p10 is not None
    assert estimate.range_p90 is not None
    return log(estimate.range_p90 / estimate.range_p10)


NUMBERS = (
    "soc",
    "soc_sd",
    "v1",
    "innovation",
    "innovation_rms",
    "pack_voltage",
    "pack_current",
    "cell_temperature",
    "speed",
    "acceleration",
    "grade",
    "lean",
    "yaw_rate",
    "heading",
    "distance",
    "range",
    "range_p10",
    "range_p90",
    "energy_left",
    "energy_left_sd",
    "consumption_recent",
    "consumption_expected",
    "consumption_expected_sd",
    "consumption_factor",
    "consumption_factor_sd",
)


def check_sound(run: Run) -> None:
    """What holds whatever was on the bus: finite numbers in their order, frames that every receiver takes."""
    for estimate in run.estimates:
        check_estimate(estimate)
    check_frames(run.sent, run.pipeline.vehicle.range_dbc)


def check_estimate(e: Estimate) -> None:
    """Its numbers are finite, in their bounds and their order."""
    for name in NUMBERS:
        value = getattr(e, name)
        assert value is None or isfinite(value), f"{name} is {value} at {e.time:.1f} s"
    assert e.soc is None or 0 <= e.soc <= 1
    assert e.soc_sd is None or e.soc_sd > 0
    if e.range is not None:
        assert e.range_p10 is not None
        assert e.range_p90 is not None
        assert 0 <= e.range_p10 <= e.range <= e.range_p90


def check_frames(frames: Sequence[Frame], file: Path | None = None) -> dict[str, list[dict[str, float]]]:
    """Decode range frames by cantools: right checksums, counters that run, values within their limits or absent.

    Never valid without range, P10 and P90 in their order.
    """
    database = range_database(file)
    decoded: dict[str, list[dict[str, float]]] = {}
    for _, can_id, data, _ in frames:
        definition = database.get_message_by_frame_id(can_id & ~EFF_FLAG)
        assert data == sealed(data), f"{definition.name}: wrong checksum in {data.hex()}"
        raw: Any = definition.decode(data, decode_choices=False, scaling=False)
        values: Any = definition.decode(data, decode_choices=False)
        for signal in definition.signals:
            absent = -(2 ** (signal.length - 1)) if signal.is_signed else 2**signal.length - 1
            if signal.length < 8 or raw[signal.name] != absent:
                assert signal.minimum is not None
                assert signal.maximum is not None
                slack = 1e-6 * signal.scale  # of decimal fractions
                low, high = float(signal.minimum) - slack, float(signal.maximum) + slack
                assert low <= values[signal.name] <= high, signal.name
        decoded.setdefault(definition.name, []).append(values)
    for row in decoded.get("RANGE_Estimate", []):
        if row["RANGE_EstimateState"] == State.VALID:
            most = database.get_message_by_name("RANGE_Estimate").get_signal_by_name("RANGE_Remaining").maximum
            assert most is not None
            assert 0 <= row["RANGE_RemainingP10"] <= row["RANGE_Remaining"] <= row["RANGE_RemainingP90"] <= most + 1e-6
    for name, rows in decoded.items():
        counter = f"{name}Counter" if f"{name}Counter" in rows[0] else next(k for k in rows[0] if k.endswith("Counter"))
        assert all(b[counter] == (a[counter] + 1) % 15 for a, b in pairwise(rows)), f"{name}: the counter jumps"
    return decoded


def reasons_in(estimates: Iterable[Estimate]) -> Reason:
    """Every reason that was given at some time."""
    found = Reason(0)
    for estimate in estimates:
        found |= estimate.reasons
    return found
