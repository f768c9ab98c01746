"""Cost of single parts of the program, as JSON, of whichever checkout PYTHONPATH names: `bench.py` runs it.

    python benchmarks/cost.py pipeline | parts | simulation

A part that a checkout does not have is left out.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

RIDE = Path(__file__).resolve().parents[1] / "replay_logs" / "city_14C.blf"
REPEATS = 3
PARTS = {
    "battery filter, a step": ("gz_onboard.estimator.battery_pack", "BatteryPack.step"),
    "speed checks, a step": ("gz_onboard.estimator.plausibility.motion", "SpeedCheck.step"),
    "limit checks, a step": ("gz_onboard.estimator.plausibility.residual", "LimitCheck.step"),
    "electrical checks, a step": ("gz_onboard.estimator.plausibility.electrical", "PackSensors.read"),
    "grade checks, a step": ("gz_onboard.estimator.plausibility.motion", "GradeCheck.compare"),
    "forecast": ("gz_onboard.estimator.forecast", "Forecaster.forecast"),
}
"""Where each part is: a module and a method."""


def pipeline() -> dict[str, float]:
    """µs a frame of a recorded ride: from decoder to range frames in portions of 0.1 s; from log to columns."""
    from gz_onboard.pipeline import Pipeline
    from gz_onboard.vehicle import read_vehicle

    vehicle = read_vehicle("reference")
    portions = list(_portions(_frames()))
    number = sum(len(frames) for frames, _ in portions)

    def ride() -> None:
        run = Pipeline(vehicle)
        for frames, until in portions:
            run.advance(frames, until)

    found = {"pipeline, live path": 1e6 * _best(ride) / number}
    with contextlib.suppress(ImportError):
        from gz_onboard.recording.recording import read_recording

        found["log to columns of signals"] = 1e6 * _best(lambda: read_recording(RIDE, vehicle)) / number
    return found


def _frames() -> list[Any]:
    """The frames of the recorded ride."""
    for module in ("gz_onboard.recording.logs", "gz_onboard.can.logs"):  # the latter in older commits
        with contextlib.suppress(ImportError):
            return [frame for batch in importlib.import_module(module).read_frames(RIDE) for frame in batch]
    raise ImportError("this checkout has no reader of logs")


def parts() -> dict[str, float]:
    """µs a call of each of `PARTS` during a ride, the clock's own time taken off."""
    spent: dict[str, list[float]] = {}
    for name, (module, method) in PARTS.items():
        with contextlib.suppress(ImportError, AttributeError):
            _time_calls(importlib.import_module(module), method, spent.setdefault(name, []))
    pipeline()
    clock: list[float] = []
    for _ in range(1000):
        begin = time.perf_counter()
        clock.append(time.perf_counter() - begin)
    own = sorted(clock)[500]
    return {name: 1e6 * (sorted(times)[len(times) // 2] - own) for name, times in spent.items() if times}


def simulation() -> dict[str, float]:
    """CPU s of 20 minutes at 100 Hz: the whole scooter on WMTC class 1."""
    from gz_onboard.simulation.cycles import cycle
    from gz_onboard.simulation.run import at_steps, drive, follow
    from gz_onboard.simulation.scooter import STEP, Scooter
    from gz_onboard.vehicle import read_vehicle

    vehicle, ridden = read_vehicle("reference"), cycle("wmtc_class1")

    def run() -> None:
        speeds = at_steps(ridden.time, ridden.speed, STEP)
        drive(Scooter(vehicle, soc=0.95), follow(speeds, STEP), ridden.time[-1])

    return {"simulation": _best(run)}


def _portions(frames: list[Any]) -> Iterator[tuple[list[Any], int]]:
    done, until = 0, frames[0][0]
    while done < len(frames):
        until += 100_000_000
        end = done
        while end < len(frames) and frames[end][0] < until:
            end += 1
        yield frames[done:end], until
        done = end


def _best(what: Callable[[], object]) -> float:
    """The least CPU time [s] of some runs."""
    least = float("inf")
    for _ in range(REPEATS):
        begin = time.process_time()
        what()
        least = min(least, time.process_time() - begin)
    return least


def _time_calls(module: Any, method: str, times: list[float]) -> None:
    owner, name = method.split(".")
    kind = getattr(module, owner)
    original = getattr(kind, name)

    def timed(*args: Any, **options: Any) -> Any:
        begin = time.perf_counter()
        try:
            return original(*args, **options)
        finally:
            times.append(time.perf_counter() - begin)

    setattr(kind, name, timed)


if __name__ == "__main__":
    print(json.dumps({"pipeline": pipeline, "parts": parts, "simulation": simulation}[sys.argv[1]]()))
