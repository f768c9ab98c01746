"""The obvious pipeline of the same libraries, which the benchmark compares with.

    python -m plain live CHANNEL LOG.mcap           # from SocketCAN until SIGTERM
    python -m plain offline RIDE.blf LOG.mcap       # as fast as it goes

Each frame: python-can's `recv` (or `LogReader`), cantools' `decode_message`, a JSON message in an MCAP file. Each
frame of the pack: a step of filterpy's EKF over the same equations and tables as gz-onboard's, in numpy. Ten times a
second the status and once a second the range, encoded by cantools and sent. The range itself is the simplest there
is, energy left over the mean consumption so far: no forward model, no road state, no checks of CRC and counters, no
flushing of the log, which gz-onboard all does. asammdf is hidden from python-can as gz-onboard does it, which spares
this pipeline 86 MB and 0.9 s where asammdf is installed.
"""

from __future__ import annotations

import argparse
import json
import signal
import time
from itertools import count
from pathlib import Path
from typing import Any

import cantools
import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from mcap.writer import Writer

from gz_onboard.can.layout import crc8_sae_j1850
from gz_onboard.can.python_can import can
from gz_onboard.vehicle import read_vehicle

DBC = Path(__file__).resolve().parents[1] / "dbc"


class Filter:
    """State of charge and V1 of one cell, by filterpy."""

    def __init__(self) -> None:
        vehicle = read_vehicle("reference")
        assert vehicle.battery
        self.battery = battery = vehicle.battery
        self.wheel_radius = vehicle.model.parameters["wheel_radius"]
        self.soc_axis, self.ocv = np.array(battery.ocv_curve.x), np.array(battery.ocv_curve.y)
        self.tables = {
            name: (np.array(mesh.temperature), np.array(mesh.soc), np.array(mesh.value))
            for name, mesh in (("r0", battery.r0), ("r1", battery.r1), ("c1", battery.c1))
        }
        self.ekf: Any = None
        self.time = 0.0

    def at(self, name: str, soc: float, temperature: float) -> float:
        """A table's value: bilinear."""
        ts, xs, values = self.tables[name]
        j = min(max(int(np.searchsorted(ts, temperature)) - 1, 0), len(ts) - 2)
        w = min(max((temperature - ts[j]) / (ts[j + 1] - ts[j]), 0.0), 1.0)
        return float(np.interp(soc, xs, values[j] + w * (values[j + 1] - values[j])))

    def voltage(self, x: Any, current: float, temperature: float) -> Any:
        """The measurement."""
        soc = x[0, 0]
        ocv = np.interp(soc, self.soc_axis, self.ocv)
        return np.array([[ocv - self.at("r0", soc, temperature) * current - x[1, 0]]])

    def jacobian(self, x: Any, _current: float, _temperature: float) -> Any:
        """Its derivative."""
        soc = x[0, 0]
        i = min(max(int(np.searchsorted(self.soc_axis, soc)) - 1, 0), len(self.ocv) - 2)
        slope = (self.ocv[i + 1] - self.ocv[i]) / (self.soc_axis[i + 1] - self.soc_axis[i])
        return np.array([[slope, -1.0]])

    def step(self, now: float, pack_voltage: float, pack_current: float, temperature: float) -> None:
        """Predict to `now` [s] and take in the voltage."""
        battery = self.battery
        current = pack_current / battery.cells_parallel
        voltage = (pack_voltage + battery.series_resistance * pack_current) / battery.cells_series
        if self.ekf is None:
            ekf = self.ekf = ExtendedKalmanFilter(dim_x=2, dim_z=1, dim_u=1)
            ekf.x = np.array([[float(np.interp(voltage, self.ocv, self.soc_axis))], [0.0]])
            ekf.P = np.diag([1e-3, 1e-4])
            ekf.Q = np.diag([1e-10, 1e-9])
            ekf.R = np.array([[0.15]])
        ekf, dt = self.ekf, now - self.time if self.time else 0.0
        self.time = now
        soc = ekf.x[0, 0]
        r1 = self.at("r1", soc, temperature)
        a = np.exp(-dt / (r1 * self.at("c1", soc, temperature)))
        ekf.F = np.array([[1.0, 0.0], [0.0, a]])
        ekf.B = np.array([[-dt / (3600 * battery.cell_capacity(temperature))], [r1 * (1 - a)]])
        ekf.predict(u=np.array([[current]]))
        arguments = (current, temperature)
        ekf.update(np.array([[voltage]]), self.jacobian, self.voltage, args=arguments, hx_args=arguments)


class Pipeline:
    """Frames in; a log, and messages to be sent, out."""

    def __init__(self, log: Path, log_frames: bool = True, send: bool = True) -> None:
        self.database: Any = cantools.database.Database()
        self.database.add_dbc_file(DBC / "vehicle.dbc")
        self.database.add_dbc_file(DBC / "hbm.dbc")
        self.range_database: Any = cantools.database.load_file(DBC / "range.dbc")
        self.filter = Filter()
        self.log_frames = log_frames
        self.send = send
        self.file = log.open("wb")
        self.writer: Any = Writer(self.file)
        self.writer.start()
        self.channels: dict[str, int] = {}
        self.counter = count()
        self.frames = 0
        self.temperature, self.speed = 25.0, 0.0
        self.energy = self.distance = 0.0
        self.next_status = self.next_range = 0.0

    def log(self, topic: str, seconds: float, values: dict[str, Any]) -> None:
        """Write one JSON message."""
        if topic not in self.channels:
            schema = self.writer.register_schema(topic, "jsonschema", b'{"type": "object"}')
            self.channels[topic] = self.writer.register_channel(topic, "json", schema)
        nanoseconds = int(seconds * 1e9)
        self.writer.add_message(self.channels[topic], nanoseconds, json.dumps(values).encode(), nanoseconds)

    def take(self, message: can.Message) -> list[can.Message]:
        """Decode, log and use one frame; return the frames to send."""
        self.frames += 1
        try:
            definition = self.database.get_message_by_frame_id(message.arbitration_id)
            values = self.database.decode_message(message.arbitration_id, message.data, decode_choices=False)
        except (KeyError, cantools.database.DecodeError):
            return []
        name, now = definition.name, message.timestamp
        if self.log_frames:
            self.log(f"/can/{name}", now, values)
        if name == "INV_Motion":
            self.speed = values["INV_MotorSpeed"] * (2 * np.pi / 60) * self.filter.wheel_radius
        elif name == "BMS_Cells":
            self.temperature = values["BMS_CellTempMean"]
        elif name == "BMS_Pack":
            voltage, current = values["BMS_PackVoltage"], values["BMS_PackCurrent"]
            dt = min(now - self.filter.time, 1.0)
            self.filter.step(now, voltage, current, self.temperature)
            self.energy += voltage * current * dt
            self.distance += self.speed * dt
        return self.publish(now) if self.filter.ekf else []

    def publish(self, now: float) -> list[can.Message]:
        """The messages that are due."""
        if now < self.next_status:
            return []
        self.next_status = now + 0.1
        ekf = self.filter.ekf
        soc, sigma = float(ekf.x[0, 0]), float(np.sqrt(ekf.P[0, 0]))
        status = {"RANGE_StateOfCharge": 100 * soc, "RANGE_StateOfChargeSigma": 100 * sigma, "RANGE_StatusState": 1}
        messages = [self.encode("RANGE_Status", status)] if self.send else []
        if now < self.next_range:
            return messages
        self.next_range = now + 1.0
        consumption = self.energy / self.distance if self.distance > 500 and self.energy > 0 else 160.0  # J/m
        battery = self.filter.battery
        left = soc * battery.pack_capacity(self.temperature) * 3600 * 3.7 * battery.cells_series  # J
        way = left / consumption / 1000
        self.log("/estimate", now, {"soc": soc, "soc_sd": sigma, "v1": float(ekf.x[1, 0]), "range": way * 1000})
        if not self.send:
            return messages
        estimate = {"Remaining": way, "RemainingP10": 0.8 * way, "RemainingP90": 1.2 * way, "EstimateState": 1}
        energy = {
            "EnergyLeft": left / 3600,
            "ConsumptionRecent": consumption / 3.6,
            "ConsumptionExpected": consumption / 3.6,
        }
        for part, values in ("Estimate", estimate), ("Energy", energy), ("Diagnosis", {}):
            messages.append(self.encode(f"RANGE_{part}", {f"RANGE_{key}": value for key, value in values.items()}))
        return messages

    def encode(self, name: str, values: dict[str, float]) -> can.Message:
        """A message with counter and CRC; missing signals are zero."""
        definition = self.range_database.get_message_by_name(name)
        part = name.removeprefix("RANGE_")
        complete: dict[str, float] = {signal.name: 0 for signal in definition.signals}
        complete |= values | {f"RANGE_{part}Counter": next(self.counter) % 15}
        data = bytearray(definition.encode(complete, strict=False))
        data[-1] = crc8_sae_j1850(bytes(data[:-1]))
        return can.Message(arbitration_id=definition.frame_id, data=data, is_extended_id=False)

    def close(self) -> None:
        """Finish the log."""
        self.writer.finish()
        self.file.close()


def live(channel: str, log: Path) -> None:
    """Run until SIGTERM; report readiness and the frames received on standard output."""
    stopping = False

    def stop(*_: object) -> None:
        nonlocal stopping
        stopping = True

    signal.signal(signal.SIGTERM, stop)
    pipeline = Pipeline(log)
    with can.Bus(channel=channel, interface="socketcan") as bus:
        print("ready", flush=True)
        while not stopping:
            message = bus.recv(0.2)
            if message is not None:
                for answer in pipeline.take(message):
                    bus.send(answer)
    pipeline.close()
    print(f"received {pipeline.frames} frames")


def offline(ride: Path, log: Path, seconds: float, log_frames: bool) -> None:
    """The first `seconds` of a ride; prints CPU time [s] until it began, CPU time of the work, seconds, frames."""
    start = time.process_time()
    pipeline = Pipeline(log, log_frames, send=False)
    first = last = 0.0
    with can.LogReader(ride) as reader:
        for message in reader:
            last = message.timestamp
            first = first or last
            if last - first > seconds:
                break
            pipeline.take(message)
    pipeline.close()
    print(
        json.dumps(
            {
                "start": start,
                "cpu": time.process_time() - start,
                "seconds": last - first,
                "frames": pipeline.frames,
                "bytes": log.stat().st_size,
            }
        )
    )


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mode", choices=["live", "offline"])
    parser.add_argument("source", help="channel or ride")
    parser.add_argument("log", type=Path)
    parser.add_argument("--seconds", type=float, default=1e9, help="of the ride")
    parser.add_argument("--no-frames", action="store_true", help="log the estimates only")
    arguments = parser.parse_args()
    if arguments.mode == "live":
        live(arguments.source, arguments.log)
    else:
        offline(Path(arguments.source), arguments.log, arguments.seconds, not arguments.no_frames)


if __name__ == "__main__":
    main()
