"""A dashboard's server in a thread, on python-can's in-process bus, and a daemon's frames on that bus."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from types import ModuleType

import pytest

from gz_onboard import cli
from gz_onboard.can.channel import CanChannel
from gz_onboard.can.dbc import find_dbc, load_database
from gz_onboard.can.layout import crc8_sae_j1850
from gz_onboard.can.publisher import Counts, Publisher
from gz_onboard.can.python_can import can
from gz_onboard.display import command
from gz_onboard.display.command import pictures
from gz_onboard.display.server import Feed, served
from gz_onboard.display.vehicle_frames import VehicleFrames
from gz_onboard.display.view import TREND_STEP, View, encoded
from gz_onboard.events import Activity, Cause, Estimate, Explanation, Frame, Reason, State
from gz_onboard.vehicle import read_vehicle

REASONS = Reason.NO_IMU | Reason.PRIOR_RIDING

ESTIMATE = Estimate(
    time=1.0,
    activity=Activity.RIDING,
    state=State.DEGRADED,
    reasons=REASONS,
    soc=0.624,
    soc_sd=0.012,
    range=34_210.0,
    range_p10=26_540.0,
    range_p90=44_340.0,
    energy_left=895 * 3600.0,
    consumption_recent=24.6 * 3.6,
    consumption_expected=26.2 * 3.6,
    why=Explanation(
        1.0, 57_600.0, 34_210.0, {Cause.CHARGE: -20_000.0, Cause.TEMPERATURE: -3_420.0, Cause.STOPS: 1_630.0}
    ),
)

COUNTS = Counts(dropped=7, implausible=3, lost=24, unknown=2)


def second(publisher: Publisher, estimate: Estimate = ESTIMATE) -> list[Frame]:
    """What the daemon sends in a second."""
    frames = publisher.range(estimate, COUNTS, 0)
    for _ in range(10):
        frames += publisher.status(estimate, 0)
    return frames


def seen(estimate: Estimate = ESTIMATE, now: float = 100.0) -> View:
    view = View()
    for frame in second(Publisher(), estimate):
        view.take(frame, now)
    return view


def send(bus: can.BusABC, frames: Iterable[Frame]) -> None:
    for _, identifier, data, _ in frames:
        bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))


VEHICLE = load_database([find_dbc("vehicle.dbc")])


@contextmanager
def dashboard(
    channel: str, listen: str = "127.0.0.1:0", vehicle: VehicleFrames | None = None, trend: Sequence[float] = ()
) -> Iterator[str]:
    """The address of a dashboard of the virtual bus `channel`, which has seen the ranges `trend` [m], 10 s apart."""
    view, stop, feed = View(vehicle=vehicle), threading.Event(), Feed()
    publisher, start = Publisher(), time.clock_gettime(time.CLOCK_BOOTTIME) - TREND_STEP * len(trend)
    for i, metres in enumerate(trend):
        past = replace(ESTIMATE, range=metres, range_p10=0.9 * metres, range_p90=1.1 * metres)
        for frame in publisher.range(past, COUNTS, 0):
            view.take(frame, start + TREND_STEP * i)
        view.picture(start + TREND_STEP * i, channel, "virtual", True)
    bus = CanChannel("virtual", channel, identifiers=view.identifiers)
    bus.open()

    def publish() -> None:
        for new in pictures(view, bus, stop.is_set):
            feed.publish(encoded(new))

    with served(feed, listen) as address:
        loop = threading.Thread(target=publish)
        loop.start()
        try:
            yield address
        finally:
            stop.set()
            loop.join()
            bus.close()


@contextmanager
def command_running(monkeypatch: pytest.MonkeyPatch, module: ModuleType, *arguments: str) -> Iterator[list[str]]:
    """The command of a module of `gz_onboard.display` on the virtual bus, in a thread; gives what it reports."""
    said: list[str] = []
    stop = threading.Event()
    monkeypatch.setattr(command, "until_signalled", lambda duration: nullcontext(stop.is_set))
    monkeypatch.setattr(module, "report", lambda _, text: said.append(text))
    words = [module.__name__.rpartition(".")[2], *arguments, "--interface", "virtual"]
    thread = threading.Thread(target=cli.main, args=(words,))
    thread.start()
    try:
        yield said
    finally:
        stop.set()
        thread.join()


Own = tuple[str, dict[str, float]]
"""A message of the reference scooter, and of its signals what is not 0."""


def own_frame(name: str, values: dict[str, float], time_ns: int = 1_750_000_000 * 10**9) -> Frame:
    """As the reference scooter sends it."""
    message = VEHICLE.get_message_by_name(name)
    data = message.encode({signal.name: values.get(signal.name, 0) for signal in message.signals}, strict=False)
    if f"{name}CRC" in message.signal_tree:
        data = data[:-1] + bytes([crc8_sae_j1850(data[:-1])])
    return time_ns, message.frame_id, data, 0


PACK: Own = "BMS_Pack", {"BMS_PackVoltage": 52.0}
"""It has a checksum: by it the vehicle is known."""


def cells(coldest: float, mean: float, hottest: float) -> Own:
    """How warm they are [degC]."""
    return "BMS_Cells", {"BMS_CellTempMin": coldest, "BMS_CellTempMean": mean, "BMS_CellTempMax": hottest}


def odometer(km: float) -> Own:
    """What it shows."""
    return "VCU_Odometer", {"VCU_Odometer": km}


def motion(km_h: float) -> Own:
    """What the motor turns at this speed."""
    return "INV_Motion", {"INV_MotorSpeed": km_h / 3.6 / 0.2438 * 60 / (2 * math.pi)}


def vehicle_frames(begin: float) -> VehicleFrames:
    """Of the reference scooter, whose odometer was at `begin` [km] when the day began."""
    made = VehicleFrames(read_vehicle("reference"))
    for own in PACK, odometer(begin):
        made.take(own_frame(*own, time.time_ns()), 0.0)
    return made


class Sender:
    """What a daemon sends, in its rhythm, of an estimate that can be changed meanwhile."""

    def __init__(self, channel: str, estimate: Estimate, own: Sequence[Own] = (), km_h: float | None = None) -> None:
        self.estimate = estimate
        self.own = own
        self.km_h = km_h
        self._channel = channel
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        publisher, number = Publisher(), 0
        with can.Bus(interface="virtual", channel=self._channel) as bus:
            while not self._stop.wait(0.1):
                if number % 10 == 0:
                    send(bus, publisher.range(self.estimate, COUNTS, 0))
                    send(bus, [own_frame(*own) for own in self.own])
                send(bus, publisher.status(self.estimate, 0))
                if self.km_h is not None:
                    send(bus, [own_frame(*motion(self.km_h))])
                number += 1

    def __enter__(self) -> Sender:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
