"""State of charge of a cell with a flat curve and hysteresis: an A123 26650 (LFP), -15 to 45 degC.

    OMP_NUM_THREADS=1 python -m benchmarks.lfp_cell DATA_FOLDER [--write docs/results/lfp-cell.md]

Data: G. Plett, Battery Management Systems, vol. 1 (2015), as CSV of github.com/batterysim/esctoolbox-python. The files
are brought into the package's tables; then `gz-onboard calibrate all` puts the open-circuit voltage and the capacity at
25 degC into benchmarks/a123.toml, and the estimator runs over the dynamic tests. They are used for nothing else.
"""

from __future__ import annotations

import argparse
import tempfile
from concurrent.futures import ProcessPoolExecutor
from math import sqrt
from pathlib import Path

import numpy as np

from benchmarks.real_cell import INTERVAL, MARK, NEAR, RIGHT_SD, WRONG
from gz_onboard.arrays import Array
from gz_onboard.cli import main as gz_onboard
from gz_onboard.estimator.battery_filter import with_soc
from gz_onboard.events import Group
from gz_onboard.vehicle import read_vehicle
from tests.events import EventEstimator

BASE = Path(__file__).with_name("a123.toml")
TESTS = {"N15": -15.0, "P05": 5.0, "P25": 25.0, "P45": 45.0}  # degC, by the names of the files
PAUSE = 3600.0  # s put between the discharge and the charge, which are in two files
STARTS = {0.0: "right", WRONG: "20 % too low"}
PARTS = {"above 80 %": (0.8, 1.1), "20 to 80 %": (0.2, 0.8), "below 20 %": (-0.1, 0.2)}


def script(folder: Path, kind: str, test: str, number: int) -> Array:
    """(m, 4): time [s], current [A, discharging positive], voltage [V], drawn [A·h] of one of the tester's scripts."""
    rows = np.genfromtxt(folder / f"{kind}_{test}_script{number}.csv.gz", delimiter=",", skip_header=1)
    sign = -1.0 if kind == "ocv" else 1.0
    return np.column_stack([rows[:, 0], sign * rows[:, 2], rows[:, 3], rows[:, 5] - rows[:, 4]])


def write_slow_test(folder: Path, out: Path) -> None:
    """The slow discharge and charge at 25 degC as one table and the manifest that names it, into `out`."""
    down, up = script(folder, "ocv", "P25", 1), script(folder, "ocv", "P25", 3)
    up[:, 0] += down[-1, 0] + PAUSE - up[0, 0]
    up[:, 3] += down[-1, 3]
    rows = np.column_stack([np.vstack([down, up]), np.full(len(down) + len(up), 25.0)])
    head = "time_s,current_A,voltage_V,charge_Ah,cell_temperature_degC"
    np.savetxt(out / "ocv.csv", rows, "%.6g", ",", header=head, comments="")
    (out / "calibration.toml").write_text(
        f'schema = 1\nvehicle = "{BASE}"\n\n[ocv]\ndata = ["ocv.csv"]\n', encoding="utf-8"
    )


def errors(work: tuple[Path, Path, str, float]) -> tuple[Array, Array, Array]:
    """(error, the filter's sd, true state of charge) of the estimator on the dynamic test, told a start once."""
    vehicle_file, folder, test, wrong = work
    rows = script(folder, "dyn", test, 1)
    # Full at the beginning; the second script takes the rest, at 25 degC.
    capacity = rows[-1, 3] + max(script(folder, "dyn", test, 2)[:, 3])
    truth = 1 - rows[:, 3] / capacity
    vehicle = read_vehicle(vehicle_file)
    groups = [Group("Cells", ("cell_temperature",), 1.0), Group("Pack", ("pack_voltage", "pack_current"), 1.0)]
    estimator = EventEstimator(groups, vehicle.pack, vehicle.model, vehicle.riding)
    estimator.forecaster._time = float("inf")  # no range is asked for
    found = np.full((2, len(rows)), np.nan)
    told = False
    for k, (time, current, volts, _) in enumerate(rows.tolist()):
        estimator.handle((time, 0, (TESTS[test],)))
        estimator.handle((time, 1, (volts, current)))
        if not estimator.pack.is_started:
            continue
        f = estimator.pack.state
        if not told:
            told = True
            f = with_soc(f, float(truth[k]) + wrong, max(abs(wrong), RIGHT_SD) ** 2)._replace(v1=0.0, error=0.0)
            estimator.pack.state = f
        found[:, k] = f.soc - truth[k], sqrt(f.covariance[0])
    known = np.isfinite(found[0])
    return found[0][known], found[1][known], truth[known]


def report(folder: Path) -> list[str]:
    """The tables of docs/results/lfp-cell.md, as lines of Markdown."""
    with tempfile.TemporaryDirectory() as name:
        out = Path(name)
        write_slow_test(folder, out)
        vehicle = out / "a123.toml"
        if gz_onboard(["calibrate", "all", name, "--output", str(vehicle), "--quiet"]):
            raise SystemExit("the calibration failed")
        runs = [(vehicle, folder, test, wrong) for test in TESTS for wrong in STARTS]
        with ProcessPoolExecutor(2) as pool:
            results = list(pool.map(errors, runs))
        battery = read_vehicle(vehicle).pack
    lines = [f"Capacity {battery.capacity:.3f} A·h; sd of the open-circuit voltage {1e3 * battery.ocv_sd:.0f} mV.", ""]
    lines += [
        "| °C | start | RMS, % | largest | " + " | ".join(f"RMS {part}" for part in PARTS) + " | σ, % | within 95 % "
        "| NEES | to within 3 %, at SOC |",
        "|---" * (8 + len(PARTS)) + "|",
    ]
    for (_, _, test, wrong), (error, sd, truth) in zip(runs, results, strict=True):
        near = np.flatnonzero(np.abs(error) < NEAR)
        within = f"{near[0]} s, {100 * truth[near[0]]:.0f} %" if len(near) else "never"
        begun = slice(near[0] if len(near) else 0, None)
        left, level = error[begun], truth[begun]
        parts = [np.sqrt(np.mean(left[(level >= low) & (level < high)] ** 2)) for low, high in PARTS.values()]
        numbers = [np.sqrt(np.mean(left**2)), np.abs(left).max(), *parts, sd.mean()]
        own = np.abs(error) / sd
        lines.append(
            f"| {TESTS[test]:.0f} | {STARTS[wrong]} | {' | '.join(f'{100 * x:.1f}' for x in numbers)} | "
            f"{100 * np.mean(own < INTERVAL):.0f} | {np.mean(own**2):.2f} | {within} |"
        )
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("data", type=Path, help="folder of the cell's files")
    parser.add_argument("--write", type=Path, help="replace everything after the mark in this file")
    arguments = parser.parse_args()
    lines = report(arguments.data)
    if arguments.write:
        mark = MARK.replace("real_cell", "lfp_cell")
        head = arguments.write.read_text(encoding="utf-8").partition(mark)[0]
        arguments.write.write_text("\n".join([head + mark, "", *lines]) + "\n", encoding="utf-8")
    else:
        print(*lines, sep="\n")


if __name__ == "__main__":
    main()
