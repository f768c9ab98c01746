"""Figures of a simulated ride: time series, energy by where it went, measurement and simulation, sweeps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

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
    rule,
    time_unit,
)
from gz_onboard.simulation.run import Run
from gz_onboard.simulation.summary import Variant
from gz_onboard.simulation.sweep import Sweep

if TYPE_CHECKING:
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
_LEAST_SHARE = 5e-4  # of all energy: less cannot be seen


def overview(run: Run, title: str) -> Figure:
    """Draw speed, throttle and brake, pack, state of charge, temperatures and energy of a ride over time."""
    s = run.series
    wanted, short = s["wanted_speed"] * 3.6, np.zeros(len(s["time"]), dtype=bool)
    for stretch in run.shortfalls:
        short |= (s["time"] >= stretch.time_s) & (s["time"] <= stretch.time_s + stretch.duration_s)
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


def ledger_bars(ledger: Mapping[str, float], effects: Sequence[Effect], title: str) -> Figure:
    """Draw the energy that left the cells, by where it went, from the battery to the road; sources are negative.

    ledger: J by name, of `effects` and other entries.
    """
    stage_of = {name: stage for stage, (_, _, others) in STAGES.items() for name in others}
    stage_of |= {effect.name: stage for effect in effects for stage in STAGES if effect.port in STAGES[stage][1]}
    order = list(STAGES)
    names = [name for name, energy in ledger.items() if abs(energy) > _LEAST_SHARE * sum(map(abs, ledger.values()))]
    names.sort(key=lambda name: (order.index(stage_of[name]), -ledger[name]), reverse=True)
    figure = new_figure(11, 1.2 + 0.36 * len(names))
    height = figure.get_figheight()
    axis = figure.add_axes((0.2, 0.5 / height, 0.75, 1 - 1.2 / height))
    rule(axis)
    total = sum(ledger.values()) or 1.0
    bars = axis.barh(
        [words(name) for name in names],
        [ledger[name] / WH for name in names],
        color=[STAGES[stage_of[name]][0] for name in names],
    )
    shares = [f"{ledger[name] / WH:.2f} Wh, {100 * ledger[name] / total:.1f} %" for name in names]
    axis.bar_label(bars, shares, padding=4, fontsize=9, color=INK)
    axis.margins(x=0.2)
    axis.set_xlabel("energy [Wh]", color=INK, fontsize=9, loc="left")
    headline(figure, 0.03, 1 - 0.35 / height, title)
    return figure


def sweep_lines(sweeps: Sequence[Sweep], variants: Sequence[Variant], title: str) -> Figure:
    """Draw range and consumption against the last parameter, a line for each value of another one before it."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    *others, last = sweeps
    names = [f"{others[0].label} {value:g}" for value in others[0].values] if others else [""]
    shades = [to_hex(colour) for colour in colormaps["viridis"](np.linspace(0.0, 0.85, len(names)))]
    names[1:-1] = ["_"] * len(names[1:-1])  # the legend shows the ends
    panels = []
    for key, quantity in (("range_km", "range [km]"), ("consumption_wh_km", "consumption [Wh/km]")):
        values = np.array([getattr(variant, key) for variant in variants], dtype=float)
        rows = zip(values.reshape(len(names), -1), shades, names, strict=True)
        panels.append(
            [ChartPanel(quantity, [Line(y, shade, name or quantity, 1.6, "o-") for y, shade, name in rows], 2.0)]
        )
    return chart(panels, np.array(last.values), last.label, title)
