"""The comparative study of Lord 2016, sec. 4.4: coast-downs at constant roll in three chassis models.

    python -m gz_onboard.simulation.turning.study --output DIR

The rider leans in at a held speed, then lets go; he steers so that the product of speed and yaw rate, and with it the
roll, stays the same while the speed falls: the turn tightens with the square of the speed. All models ride the turn of
the leaning machine, so they differ in forces, not in path.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from math import atan, cos, degrees, inf, pi, radians, tan
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gz_onboard.constants import GRAVITY
from gz_onboard.reports.page import markdown_table
from gz_onboard.reports.style import BLUE, GREEN, INK, MUTED, ORANGE, RED, new_figure, rule, save
from gz_onboard.simulation.turning.leaning import Leaning
from gz_onboard.simulation.turning.machine import Machine, MachineState, Rates, RoadConditions, step
from gz_onboard.simulation.turning.planar import Planar
from gz_onboard.simulation.turning.straight import Straight
from gz_onboard.simulation.turning.tyre import ideal_of
from gz_onboard.vehicle import read_vehicle

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ChassisModel = Straight | Planar | Leaning

ROLLS = (0.0, 5.0, 10.0, 20.0, 30.0)  # degrees
CHASSIS_MODELS: dict[str, type[Straight] | type[Planar] | type[Leaning]] = {
    "straight": Straight,
    "planar": Planar,
    "leaning": Leaning,
}
FAST, SLOW = 12.5, 5.0  # m/s: as in town; below 5 m/s a turn at 30 degrees has less than 4.5 m
LEAD_IN, LEAN_IN = 8.0, 3.0  # s: until the rider lets go; in which he leans
DISTANCE = 60.0  # m: over which energy is compared, for all models lose the same from one speed to another
LOOK_AT = 8.0  # m/s: speed at which loads, slip and radius are compared
STEP = 0.005  # s
STEER_GAIN, STEER_INTEGRAL = 0.05, 0.5  # s, 1: steer for an error of the yaw rate, and for its integral


@dataclass(frozen=True)
class CoastDown:
    """What was recorded from letting go on: times [s], distances [m], energy lost [J] by name and in all, the rest."""

    time: list[float]
    distance: list[float]
    lost: list[dict[str, float]]
    kinetic: list[float]
    states: list[MachineState]
    seen: list[dict[str, float]]

    def at_distance(self, distance: float, values: Sequence[float]) -> float:
        """`values` where `distance` [m] has been ridden; inf if it never was."""
        return _at(distance, self.distance, values)

    def at_speed(self, speed: float, name: str) -> float:
        """What was seen as `name` when the speed [m/s] fell to `speed`; inf if it never did."""
        return _at(-speed, [-seen["speed"] for seen in self.seen], [seen[name] for seen in self.seen])


def _at(x: float, xs: Sequence[float], ys: Sequence[float]) -> float:
    return float(np.interp(x, xs, ys, left=inf, right=inf))


class Steerer:
    """Steers `chassis` so that it turns as a machine that leans by `roll` [rad, positive right].

    A kinematic steer for the wanted yaw rate -g·tan φ_ideal/u, and feedback of the yaw rate with an integral. That
    integral and the time [s] are the last two entries of the state: the rider is integrated with the machine.
    """

    def __init__(self, chassis: ChassisModel, roll: float, road: RoadConditions) -> None:
        self.chassis, self.road = chassis, road
        machine = chassis.machine
        self.turn = -GRAVITY * tan(ideal_of(roll, machine.crown, machine.cg_height))  # m/s²
        self.let_go = False

    def start(self, speed: float) -> MachineState:
        """Straight ahead at `speed` [m/s]."""
        return *self.chassis.start(speed), 0.0, 0.0

    def rates(self, state: MachineState) -> Rates:
        """The rates of chassis and rider."""
        *body, integral, time = state
        speed = max(body[0], 1.0)
        wanted = self.turn / speed
        if time < LEAN_IN:
            wanted *= (1 - cos(pi * time / LEAN_IN)) / 2
        error = 0.0
        steer = atan(self.chassis.machine.wheelbase * wanted / speed)
        if not isinstance(self.chassis, Straight):
            error = wanted - body[2]
            steer += STEER_GAIN * error + integral
        lean = body[8] if isinstance(self.chassis, Leaning) else 0.0
        drive = 0.0 if self.let_go else None
        rates = self.chassis.rates(tuple(body), self.chassis.handlebar(steer, lean), drive, self.road)
        return replace(rates, change=(*rates.change, STEER_INTEGRAL * error, 1.0))


def coast_down(chassis: ChassisModel, roll: float, *, slow: float = SLOW, dt: float = STEP) -> CoastDown:
    """Lean to `roll` [rad] at `FAST`, let go, and record until `slow` [m/s] (at most 10 minutes)."""
    rider = Steerer(chassis, roll, RoadConditions())
    state = rider.start(FAST)
    for _ in range(round(LEAD_IN / dt)):
        state, _ = step(rider.rates, state, dt)
    rider.let_go = True
    record = CoastDown([], [], [], [], [], [])
    lost = dict.fromkeys(rider.rates(state).power, 0.0)
    distance = 0.0
    for i in range(round(600 / dt)):
        body = state[:-2]
        record.time.append(i * dt)
        record.distance.append(distance)
        record.lost.append(dict(lost))
        record.kinetic.append(chassis.energy(body))
        record.states.append(body)
        record.seen.append(rider.rates(state).seen)
        if state[0] <= slow:
            break
        after, energy = step(rider.rates, state, dt)
        distance += (state[0] + after[0]) / 2 * dt
        for name, value in energy.items():
            lost[name] += value
        state = after
    return record


@dataclass(frozen=True)
class StudyRow:
    """One coast-down at `roll` [degrees]: lengths in m, energies in J, forces in N, angles in degrees."""

    roll: float
    model: str
    distance: float
    time: float  # s
    lost: float  # over `DISTANCE`
    parts: dict[str, float]
    speed_after: float  # m/s
    lateral_acceleration: float  # m/s², as all that follow at `LOOK_AT`
    load_front: float
    load_rear: float
    plane_load_front: float
    plane_load_rear: float
    rolling_radius: float
    slip_front: float
    slip_rear: float


def row(model: str, roll: float, run: CoastDown) -> StudyRow:
    """The figures of `run`."""

    def over(name: str) -> float:
        return run.at_distance(DISTANCE, [lost[name] for lost in run.lost])

    parts = {name: over(name) for name in run.lost[0] if name not in ("grade", "drive")}
    lateral = run.at_speed(LOOK_AT, "lateral_acceleration")
    side = -1.0 if lateral < 0 else 1.0  # slip angles are told as positive into the turn
    seen = ("load_front", "load_rear", "plane_load_front", "plane_load_rear", "rolling_radius")
    return StudyRow(
        roll=roll,
        model=model,
        distance=run.distance[-1],
        time=run.time[-1],
        lost=sum(parts.values()),
        parts=parts,
        speed_after=run.at_distance(DISTANCE, [seen["speed"] for seen in run.seen]),
        lateral_acceleration=abs(lateral),
        slip_front=side * degrees(run.at_speed(LOOK_AT, "slip_front")),
        slip_rear=side * degrees(run.at_speed(LOOK_AT, "slip_rear")),
        **{name: run.at_speed(LOOK_AT, name) for name in seen},
    )


def markdown(rows: Sequence[StudyRow]) -> str:
    """The table of the study."""
    heads = ["roll", "model", f"lost in {DISTANCE:.0f} m", "air", "rolling", "sideslip", "twisting"]
    heads += [f"coasts to {SLOW:.0f} m/s in", "load front, rear", "in the wheel's plane", "rolling radius"]
    lines = [
        [
            f"{r.roll:.0f}°",
            r.model,
            f"{r.lost:.0f} J",
            *(f"{r.parts[name]:.0f}" for name in PARTS),
            f"{r.distance:.0f} m, {r.time:.1f} s",
            f"{r.load_front:.0f}, {r.load_rear:.0f} N",
            f"{r.plane_load_front:.0f}, {r.plane_load_rear:.0f} N",
            f"{1000 * r.rolling_radius:.1f} mm",
            f"{r.slip_front:.2f}°, {r.slip_rear:.2f}°",
        ]
        for r in rows
    ]
    return markdown_table([*heads, "slip front, rear"], lines)


COLOURS = dict(zip(ROLLS, (INK, BLUE, GREEN, ORANGE, RED), strict=True))
STYLES = {"straight": ":", "planar": "--", "leaning": "-"}
PARTS = {"aerodynamic drag": "#9fb3c8", "rolling": "#52606d", "sideslip": ORANGE, "twisting": RED}


def plot(runs: dict[tuple[str, float], CoastDown], output: Path) -> None:
    """Two pictures of the runs in the folder `output`."""
    for name, draw, panels, size in (
        ("turning_energy.png", _draw_energy, 3, (11.5, 3.8)),
        ("turning_tyres.png", _draw_tyres, 4, (13, 3.6)),
    ):
        figure = new_figure(*size)
        figure.set_layout_engine("constrained")
        grid = figure.subplots(1, panels)
        draw(runs, grid)
        for axes in grid:
            rule(axes)
        save(figure, output / name)


def _draw_energy(runs: dict[tuple[str, float], CoastDown], grid: Sequence[Axes]) -> None:
    _lines(runs, grid[0], lambda run: (run.time, [s["speed"] for s in run.seen]), "Speed")
    grid[0].set(xlabel="time [s]", ylabel="speed [m/s]")
    _legend(grid[0])
    turned = {key: run for key, run in runs.items() if key[1] and key[0] != "straight"}
    for (model, roll), run in turned.items():
        grid[1].plot([s[3] for s in run.states], [s[4] for s in run.states], STYLES[model], color=COLOURS[roll])
    grid[1].set_aspect("equal", adjustable="datalim")
    grid[1].set_title("Path of the coast-down", fontsize=10, loc="left")
    grid[1].set(xlabel="ahead [m]", ylabel="to the side [m]")
    keys = [(model, roll) for roll in ROLLS for model in CHASSIS_MODELS]
    rows = [row(model, roll, runs[model, roll]) for model, roll in keys]
    places = [i + i // len(CHASSIS_MODELS) for i in range(len(keys))]
    bottoms = np.zeros(len(keys))
    for name, shade in PARTS.items():
        heights = np.array([r.parts[name] / 1000 for r in rows])
        grid[2].bar(places, heights, bottom=bottoms, color=shade, label=name, width=0.85)
        bottoms += heights
    labels = [f"{model[0]}\n{roll:.0f}°" if model == "planar" else model[0] for model, roll in keys]
    grid[2].set_xticks(places, labels)
    grid[2].set_ylim(0, bottoms.max() * 1.3)
    grid[2].legend(fontsize=8, frameon=False, ncols=2)
    grid[2].set(xlabel="model and roll", ylabel="energy [kJ]")
    grid[2].set_title(f"Lost in {DISTANCE:.0f} m: straight, planar, leaning", fontsize=10, loc="left")


def _draw_tyres(runs: dict[tuple[str, float], CoastDown], grid: Sequence[Axes]) -> None:
    panels = (
        ("load_front", 1.0, "Front load [N]"),
        ("rolling_radius", 1000.0, "Rolling radius [mm]"),
        ("slip_front", -180 / pi, "Front slip into the turn [°]"),
        ("slip_rear", -180 / pi, "Rear slip into the turn [°]"),
    )
    for axes, (name, factor, title) in zip(grid, panels, strict=True):
        _lines(runs, axes, lambda run: ([s["speed"] for s in run.seen], [factor * s[name] for s in run.seen]), title)  # noqa: B023
        axes.set_xlabel("speed [m/s], falling as time passes")
        axes.invert_xaxis()
    _legend(grid[0])


def _lines(
    runs: dict[tuple[str, float], CoastDown],
    axes: Axes,
    value: Callable[[CoastDown], tuple[list[float], list[float]]],
    title: str,
) -> None:
    for (model, roll), run in runs.items():
        if model != "straight" or roll == 0:
            axes.plot(*value(run), STYLES[model], color=COLOURS[roll], linewidth=1.4)
    axes.set_title(title, fontsize=10, loc="left")


def _legend(axes: Axes) -> None:
    for roll in ROLLS:
        axes.plot([], [], color=COLOURS[roll], label=f"{roll:.0f}°")
    for model in CHASSIS_MODELS:
        axes.plot([], [], STYLES[model], color=MUTED, label=model)
    axes.legend(fontsize=8, frameon=False, ncols=2)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study and write turning.md, turning.json and the pictures."""
    parser = argparse.ArgumentParser(prog="python -m gz_onboard.simulation.turning.study", description=__doc__)
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder for the table and the plots")
    parser.add_argument("--vehicle", default="reference", help="vehicle file (default: the reference scooter)")
    arguments = parser.parse_args(argv)
    machine = Machine.of(read_vehicle(arguments.vehicle).parameters)
    runs = {
        (name, roll): coast_down(CHASSIS_MODELS[name](machine), radians(roll))
        for roll in ROLLS
        for name in CHASSIS_MODELS
    }
    rows = [row(model, roll, run) for (model, roll), run in runs.items()]
    arguments.output.mkdir(parents=True, exist_ok=True)
    table = markdown(rows)
    (arguments.output / "turning.md").write_text(table + "\n", encoding="utf-8")
    (arguments.output / "turning.json").write_text(
        json.dumps([asdict(r) for r in rows], indent=1) + "\n", encoding="utf-8"
    )
    plot(runs, arguments.output)
    print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
