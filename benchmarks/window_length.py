"""Error and cost of the estimate by the length of its window: windows of 0.1 s are the reference.

    python -m benchmarks.window_length

Recorded rides, each with the real parts from its log to the estimates. Compared each 10 s of the ride.
"""

from __future__ import annotations

import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from gz_onboard.arrays import Array

LOGS = Path(__file__).resolve().parents[1] / "replay_logs"
RIDES = ("city_14C.blf", "city_34C.blf", "full_discharge.mcap")
LENGTHS = (0.1, 0.2, 0.5, 1.0)  # s
GRID_S = 10.0
LEAST_RANGE = 1000.0  # m: below, a percentage says nothing


def estimates(length: float, ride: str) -> tuple[Array, float]:
    """Return state of charge and range each 10 s of a `ride`, shape (2, n), and the CPU time [ms per s of ride]."""
    from gz_onboard import events

    events.WINDOW = length  # before the modules that read it are imported
    from gz_onboard.pipeline import Pipeline
    from gz_onboard.recording.decode import feed
    from gz_onboard.recording.logs import read_log
    from gz_onboard.vehicle import read_vehicle

    seen: list[tuple[float, float, float]] = []

    def observe(estimate: events.Estimate) -> None:
        if estimate.soc is not None and estimate.range is not None:
            seen.append((estimate.time, estimate.soc, estimate.range))

    pipeline, frames = Pipeline(read_vehicle("reference"), observer=observe), read_log(LOGS / ride)
    began = time.process_time()
    feed(pipeline, frames)
    used = time.process_time() - began
    at, soc, distance = np.array(seen).T
    grid = np.arange(2 * GRID_S, at[-1], GRID_S)
    return np.array([np.interp(grid, at, soc), np.interp(grid, at, distance)]), 1e3 * used / at[-1]


def main() -> None:
    print("| window, s | SOC against 0.1 s, points, at most | range, %, median and at most | CPU, ms per s of ride |")
    print("| --- | --- | --- | --- |")
    jobs = [(length, ride) for length in LENGTHS for ride in RIDES]
    with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as pool:
        found = dict(zip(jobs, pool.map(estimates, *zip(*jobs, strict=True)), strict=True))
    for length in LENGTHS:
        differences = [found[length, ride][0] - found[LENGTHS[0], ride][0] for ride in RIDES]
        soc = max(float(np.abs(x[0]).max()) for x in differences)
        reference = np.concatenate([found[LENGTHS[0], ride][0][1] for ride in RIDES])
        far = reference > LEAST_RANGE
        distance = 100 * np.abs(np.concatenate([x[1] for x in differences])[far] / reference[far])
        cost = np.mean([found[length, ride][1] for ride in RIDES])
        print(f"| {length:g} | {100 * soc:.2f} | {np.median(distance):.2f}, {distance.max():.2f} | {cost:.2f} |")


if __name__ == "__main__":
    main()
