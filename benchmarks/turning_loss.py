"""Draw the pictures of docs/how-to/find-losses.md: the loss in bends that the model misses, and the gain of adding it.

python -m benchmarks.turning_loss --output docs/images
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.cli import main as command
from gz_onboard.constants import GRAVITY
from gz_onboard.discovery.extend import write_model
from gz_onboard.discovery.judgement import METRICS, Discovery, Gain
from gz_onboard.discovery.report import before_and_after, binned, edges, pooled
from gz_onboard.discovery.run import discover
from gz_onboard.recording.recording import read_recording
from gz_onboard.reports.style import BLUE, GREEN, INK, MUTED, ORANGE, headline, legend, new_figure, ordinate, rule, save
from gz_onboard.simulation.recorded import read_recorded
from gz_onboard.vehicle import read_vehicle

RIDES = Path(__file__).parents[1] / "replay_logs"
TOWN = (RIDES / "city_14C.blf", RIDES / "city_34C.blf", RIDES / "turning" / "city_11C.mcap")
OVAL = RIDES / "turning" / "oval_2C.blf"


def main() -> None:
    """Draw them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("docs/images"), metavar="DIR")
    output: Path = parser.parse_args().output
    vehicle = read_vehicle("reference")
    rides = [read_recording(log, vehicle) for log in (*TOWN, OVAL)]
    every = discover(vehicle, rides, workers=2)
    residual(every, output / "turning_loss_residual.png")
    gain(every.report.gain, output / "turning_loss_gain.png")
    town = discover(vehicle, rides[:-1], workers=2)
    with tempfile.TemporaryDirectory() as folder:
        extended = Path(folder) / "turning.toml"
        write_model(town, vehicle, extended)
        runs = [simulated(name, Path(folder)) for name in ("reference", str(extended))]
    oval(runs, output / "turning_loss_oval.png")


def residual(found: Discovery, file: Path) -> None:
    """Road force over lateral acceleration, before and after, with the effect."""
    cause = next(c for c in found.report.causes if c.name == "cornering_drag")
    before, after = before_and_after(found)
    figure = new_figure(11, 4.3)
    mass = float(np.mean([line.ride.quantities["mass"][0] for line in found.search.lines]))
    axes: list[Any] = []
    for i, (lines, title) in enumerate(((before, "before"), (after, "after"))):
        axis = figure.add_axes((0.07 + 0.47 * i, 0.12, 0.44, 0.74), sharey=axes[0] if axes else None)
        axes.append(axis)
        rule(axis)
        x, y = pooled(lines, "road_force", "lateral_acceleration")
        axis.plot(x, y, ".", color=MUTED, markersize=2.5, alpha=0.5, label="means of 4 s")
        rows = binned(x, y, edges(x, 16))
        axis.errorbar(
            rows[:, 0],
            rows[:, 1],
            2 * rows[:, 2],
            fmt="o",
            color=ORANGE if i == 0 else BLUE,
            markersize=5,
            linewidth=1.5,
            label="means of bins, ± 2 standard errors",
        )
        if i == 0:
            a = np.linspace(float(x.min()), float(x.max()), 200)
            low, middle, high = (c * mass * a**2 / GRAVITY for c in (cause.ci95[0], cause.value, cause.ci95[1]))
            axis.fill_between(a, low, high, color=GREEN, alpha=0.2, linewidth=0)
            axis.plot(
                a, middle, color=GREEN, linewidth=1.6, label=f"c·m·a²/g, c = {cause.value:.3f} rad,\n95 % interval"
            )
            ordinate(axis, "road force, measured less model [N]")
            axis.set_ylim(-30, 50)
        else:
            axis.tick_params(labelleft=False)
        axis.axhline(0, color=INK, linewidth=0.7)
        axis.set_xlabel("lateral acceleration, to the left [m/s²]", fontsize=8.5, color=INK)
        headline(figure, 0.07 + 0.47 * i, 0.96, f"{title} cornering drag", 11)
        legend(axis)
    save(figure, file)


def gain(found: Gain, file: Path) -> None:
    """Errors on rides held out: before, control, after."""
    figure = new_figure(11, 2.6)
    for i, (name, errors) in enumerate(found.errors.items()):
        label, factor, unit = METRICS[name]
        axis = figure.add_axes((0.08 + 0.235 * i, 0.12, 0.17, 0.66))
        rule(axis)
        axis.grid(False, axis="y")
        values = [x * factor for x in (errors.after, errors.control, errors.before)]
        axis.barh(
            ["after", "control", "before"] if i == 0 else ["", " ", "  "],
            values,
            height=0.65,
            color=[BLUE, MUTED, ORANGE],
        )
        for place, value in enumerate(values):
            axis.text(value, place, f" {value:.3g}", va="center", fontsize=8.5, color=INK)
        axis.set_xlim(0, 1.25 * max(values))
        axis.locator_params(axis="x", nbins=4)
        headline(figure, 0.08 + 0.235 * i, 0.87, f"{label} [{unit}]", 9)
    save(figure, file)


def simulated(vehicle: str, folder: Path) -> tuple[Array, Array, dict[str, Any]]:
    """The oval by simulation of `vehicle`, the rider following the speed: way [m], energy drawn [J], summary."""
    import pyarrow.parquet as parquet

    out = folder / Path(vehicle).stem
    out.mkdir()
    summary = out / "summary.json"
    with contextlib.redirect_stdout(io.StringIO()):
        options = [f"--vehicle={vehicle}", "--payload=84", "--predictive", "--no-plot"]
        command(["simulate", str(OVAL), *options, f"--output={out}", f"--json={summary}"])
    table = parquet.read_table(next(out.glob("*.parquet")))
    way, energy = (np.array(table[name]) for name in ("distance[m]", "energy[J]"))
    return way, energy, json.loads(summary.read_text())


def oval(runs: list[tuple[Array, Array, dict[str, Any]]], file: Path) -> None:
    """Energy drawn over the way around the oval, measured and simulated, and where the extended model says it went."""
    recorded = read_recorded(OVAL, read_vehicle("reference", 84.0))
    s = recorded.signals
    step = recorded.duration / (len(s["pack_current"]) - 1)
    way = np.cumsum(s["speed"]) * step
    drawn = np.cumsum(s["pack_voltage"] * s["pack_current"]) * step
    figure = new_figure(11, 4.4)
    axis = figure.add_axes((0.07, 0.12, 0.44, 0.76))
    rule(axis)
    for (x, e, _), colour, label in zip(runs, (ORANGE, BLUE), ("simulated, before", "simulated, after"), strict=True):
        axis.plot(x / 1e3, e / 3600, color=colour, linewidth=1.6, label=label)
    axis.plot(way / 1e3, drawn / 3600, color=INK, linewidth=1.6, label="measured")
    axis.set_xlabel("distance [km]", fontsize=8.5, color=INK)
    ordinate(axis, "drawn from the pack [Wh]")
    legend(axis)
    headline(figure, 0.07, 0.97, "The oval, which was in no fit", 11)
    ledger = {k: v for k, v in runs[1][2]["ledger_wh"].items() if abs(v) > 0.6}
    names = sorted(ledger, key=lambda name: ledger[name])
    axis = figure.add_axes((0.67, 0.12, 0.3, 0.76))
    rule(axis)
    axis.grid(False, axis="y")
    colours = [BLUE if name == "cornering_drag" else "#cbd2d9" for name in names]
    axis.barh([name.replace("_", " ") for name in names], [ledger[n] for n in names], color=colours, height=0.7)
    axis.tick_params(axis="y", colors=INK)
    axis.set_xlabel("Wh", fontsize=8.5, color=INK)
    headline(figure, 0.67, 0.97, "Where it goes, after", 11)
    save(figure, file)


if __name__ == "__main__":
    main()
