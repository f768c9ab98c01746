"""Figures of a simulated ride: time series, energy flows, measurement and simulation, sweeps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.constants import WH
from gz_onboard.events import words
from gz_onboard.model.effect import Effect, Port
from gz_onboard.reports.style import (
    BLUE,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    PURPLE,
    RED,
    ChartPanel,
    Line,
    chart,
    headline,
    new_figure,
    time_unit,
)
from gz_onboard.simulation.run import Run
from gz_onboard.simulation.summary import Variant
from gz_onboard.simulation.sweep import Sweep

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STAGES: dict[str, tuple[str, tuple[Port, ...], tuple[str, ...]]] = {
    "battery": ("#6b46c1", (Port.CELL_VOLTAGE,), ("battery_heat", "bms", "not_delivered")),
    "auxiliary": ("#7b8794", (Port.DC_POWER,), ()),
    "drive": ("#1667b7", (Port.INVERTER_LOSS, Port.MOTOR_LOSS), ("motor_map_loss", "gearing")),
    "road": ("#2f855a", (Port.TYRE, Port.WHEEL_FORCE), ("tyre_slip", "turning", "dynamometer")),
    "brakes": ("#c53030", (), ("brakes",)),
    "stored": ("#d9730d", (), ("kinetic_energy", "potential_energy")),
}
"""In the order in which energy passes them: colour, where effects act, and the ledger's other entries."""
_LEAST_SHARE = 5e-5  # of all energy: less cannot be seen


def overview(run: Run, title: str) -> Figure:
    """Draw speed, throttle and brake, pack, state of charge, temperatures and energy of a ride over time."""
    s = run.series
    wanted, short = s["wanted_speed"] * 3.6, np.zeros(len(s["time"]), dtype=bool)
    for stretch in run.shortfalls:
        short |= (s["time"] >= stretch.time) & (s["time"] <= stretch.time + stretch.duration)
    speed = [Line(s["speed"] * 3.6, BLUE, "ridden", 1.2)]
    if np.isfinite(wanted).any():
        speed.insert(0, Line(wanted, ORANGE, "wanted", 1.0))
    if short.any():
        speed.insert(0, Line(np.where(short, wanted, np.nan), RED, "shortfall", 3.0))
    rider = [Line(s["throttle"] * 100, GREEN, "throttle", 0.8), Line(s["brake"] * -100, RED, "brake (down)", 0.8)]
    pack = [
        Line(s["pack_voltage"], PURPLE, "pack voltage", 0.9),
        Line(s["pack_current"], ORANGE, "pack current", 0.7, right=True),
    ]
    warmth = [
        Line(s[f"{name.lower()}_temperature"], colour, name)
        for name, colour in (("motor", RED), ("inverter", ORANGE), ("cell", PURPLE), ("BMS", MUTED))
    ]
    energy, hilly = [Line(s["energy"] / WH, BLUE, "energy from the pack", 1.4)], bool(np.any(s["grade"]))
    if hilly:
        energy.append(Line(s["grade"] * 100, MUTED, "grade", 0.8, right=True))
    panels = [
        ChartPanel("speed [km/h]", speed, 1.7),
        ChartPanel("rider [%]", rider),
        ChartPanel("voltage [V]", pack, 1.3, PURPLE, "current [A]", ORANGE),
        ChartPanel("SOC [%]", [Line(s["soc"] * 100, GREEN, "state of charge", 1.4)]),
        ChartPanel("temperature [°C]", warmth),
        ChartPanel("energy [Wh]", energy, 1.2, BLUE, "grade [%]" if hilly else None),
    ]
    return _over_time(run, panels, title)


COMPARED = {
    "speed": ("speed [km/h]", 3.6),
    "soc": ("SOC [%]", 100.0),
    "pack_voltage": ("pack voltage [V]", 1.0),
    "pack_current": ("pack current [A]", 1.0),
    "motor_torque": ("motor torque [N·m]", 1.0),
    "throttle": ("throttle [%]", 100.0),
    "motor_temperature": ("motor [°C]", 1.0),
}
"""Columns of measurement and simulation that are compared: text and factor from SI units."""


def comparison(run: Run, measured: Mapping[str, Any], title: str) -> Figure:
    """Draw the columns `COMPARED` measured and simulated.

    measured: by the names of `run.COLUMNS`, of the length of the run's series; missing columns are not drawn.
    """
    panels = [
        ChartPanel(
            text,
            [
                Line(measured[name] * factor, INK, "measured", 1.0),
                Line(run.series[name] * factor, ORANGE, "simulated", 0.9),
            ],
            1.6 if name == "speed" else 1.0,
        )
        for name, (text, factor) in COMPARED.items()
        if name in measured
    ]
    return _over_time(run, panels, title)


def _over_time(run: Run, panels: Sequence[ChartPanel], title: str) -> Figure:
    unit, name = time_unit(run.duration)
    return chart([[panel] for panel in panels], run.series["time"] / unit, name, title)


Flow = tuple[str, float, str]
"""Name, energy [J] and colour."""


def sankey(ledger: Mapping[str, float], effects: Sequence[Effect], title: str) -> Figure:
    """Draw energy flows: sources on the left, consumers on the right, each as thick as its energy.

    ledger: J by name, of `effects` and other entries; negative entries gave energy and are on the left with the cells.
    """
    from matplotlib.patches import Rectangle

    figure = new_figure(11, 7.2)
    axis = figure.add_axes((0.02, 0.02, 0.96, 0.86), xlim=(0, 1), ylim=(-0.02, 1.02))
    axis.set_axis_off()
    sources, sinks, total = _flows(ledger, effects)
    gap, left, right = 0.028, 0.17, 0.62
    height = 1.0 - gap * max(len(sinks) - 1, 1)
    y = trunk = 0.5 + height / 2
    for name, energy, colour in sources:
        thick = energy / total * height
        y -= thick
        axis.add_patch(Rectangle((left - 0.025, y), 0.025, thick, color=colour, linewidth=0))
        text = f"{words(name)}\n{energy / WH:.1f} Wh"
        axis.text(left - 0.035, y + thick / 2, text, ha="right", va="center", fontsize=10, color=INK)
    y, low = trunk, 1.0
    for name, energy, colour in sinks:
        thick = energy / total * height
        low -= thick
        _band(axis, (left, y), (right, low + thick), thick, colour)
        axis.add_patch(Rectangle((right, low), 0.02, thick, color=colour, linewidth=0))
        text = f"{words(name)}   {energy / WH:.2f} Wh   {100 * energy / total:.1f} %"
        axis.text(right + 0.03, low + thick / 2, text, va="center", fontsize=10, color=INK)
        y -= thick
        low -= gap
    headline(figure, 0.03, 0.94, title)
    return figure


def _flows(ledger: Mapping[str, float], effects: Sequence[Effect]) -> tuple[list[Flow], list[Flow], float]:
    """(sources, consumers, sum of the consumers [J]), without entries too small to be seen."""
    order = []
    for colour, ports, others in STAGES.values():
        own = [effect.name for port in ports for effect in effects if effect.port is port]
        order += [(name, colour) for name in (*own, *others)]
    order += [(name, MUTED) for name in ledger if name not in {n for n, _ in order}]
    sinks = [(name, ledger[name], colour) for name, colour in order if ledger.get(name, 0.0) > 0]
    gives = [(name, -ledger[name], colour) for name, colour in order if ledger.get(name, 0.0) < 0]
    total = sum(energy for _, energy, _ in sinks) or 1.0
    cells = total - sum(energy for _, energy, _ in gives)
    least = _LEAST_SHARE * total
    sources = [("cells", cells, INK), *(give for give in gives if give[1] >= least)]
    return sources, [sink for sink in sinks if sink[1] >= least], total


def _band(axis: Axes, start: tuple[float, float], end: tuple[float, float], thick: float, colour: str) -> None:
    """A band of a thickness whose upper edge goes from `start` to `end`, both (x, y)."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    (left, y), (right, top) = start, end
    middle = (left + right) / 2
    points = [
        *((left, y), (middle, y), (middle, top), (right, top)),
        *((right, top - thick), (middle, top - thick), (middle, y - thick), (left, y - thick), (left, y)),
    ]
    codes = [Path.MOVETO, *[Path.CURVE4] * 3, Path.LINETO, *[Path.CURVE4] * 3, Path.CLOSEPOLY]
    axis.add_patch(PathPatch(Path(points, codes), facecolor=colour, alpha=0.38, linewidth=0))


def sweep_lines(sweeps: Sequence[Sweep], variants: Sequence[Variant], title: str) -> Figure:
    """Draw range and consumption against one parameter."""
    shown = ("range_km", "range", "km", BLUE), ("consumption_wh_km", "consumption", "Wh/km", ORANGE)
    rows = [
        [ChartPanel(f"{name} [{unit}]", [Line(_column(variants, key), colour, name, 1.6, "o-")], 1.3, colour)]
        for key, name, unit, colour in shown
    ]
    return chart(rows, np.array(sweeps[0].values), sweeps[0].label, title)


def sweep_map(sweeps: Sequence[Sweep], variants: Sequence[Variant], title: str) -> Figure:
    """Draw range and consumption over two parameters, `variants` with the second changing fastest."""
    figure = new_figure(12, 5.4)
    y, x = sweeps
    for i, (key, text, colours) in enumerate(
        (("range_km", "range [km]", "Blues"), ("consumption_wh_km", "consumption [Wh/km]", "Oranges"))
    ):
        axis = figure.add_axes((0.07 + 0.49 * i, 0.13, 0.36, 0.68))
        table = _column(variants, key).reshape(len(y.values), len(x.values))
        mesh = axis.pcolormesh(x.values, y.values, table, cmap=colours, shading="nearest", alpha=0.85)
        if min(table.shape) > 1 and np.nanmax(table) > np.nanmin(table):
            axis.clabel(axis.contour(x.values, y.values, table, colors=INK, linewidths=0.8), fontsize=8, fmt="%.4g")
        figure.colorbar(mesh, ax=axis, fraction=0.05).ax.tick_params(colors=MUTED, labelsize=8, length=0)
        axis.set_xlabel(x.label, fontsize=9, color=INK)
        axis.set_ylabel(y.label, fontsize=9, color=INK)
        axis.set_title(text, fontsize=10, color=INK, loc="left")
        axis.tick_params(colors=MUTED, labelsize=8)
    headline(figure, 0.03, 0.94, title)
    return figure


def _column(variants: Sequence[Variant], key: str) -> Array:
    """A value of each variant, not a number where it is unknown; shape (n,)."""
    return np.array([getattr(variant, key) for variant in variants], dtype=float)
