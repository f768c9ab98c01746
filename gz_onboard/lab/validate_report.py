"""Pictures and the page of a validation: per ride measured, simulated and error; in all, where the model fails."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.lab.validate_components import Component
from gz_onboard.lab.validate_score import CHANNELS, LABELS, ORDER

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_INK, _MUTED, _GRID = "#1f2933", "#7b8794", "#e4e7eb"
_COLOURS = {"open_loop": "#d9730d", "predictive": "#1667b7", "components": "#2f855a"}
_NAMES = {"open_loop": "open loop", "predictive": "rider model", "components": "component alone"}
_ALONE = {
    "battery_voltage": "pack_voltage",
    "motor_torque": "motor_torque",
    "motor_temperature": "motor_temperature",
    "inverter_temperature": "inverter_temperature",
    "cell_temperature": "cell_temperature",
}
"""Components that are drawn beside the channel that they give."""


def draw_ride(
    file: Path,
    entry: Mapping[str, Any],
    measured: Mapping[str, Array],
    simulated: Mapping[str, Mapping[str, Array]],
    alone: Mapping[str, Component],
) -> None:
    """A PNG: each channel measured and simulated on the left, the errors on the right. Raises OSError."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows: list[tuple[str, str, Array, dict[str, Array]]] = []
    for name, channel in CHANNELS.items():
        if name in measured:
            lines = {form: series[name] for form, series in simulated.items()}
            for component, of in _ALONE.items():
                if of == name and component in alone:
                    lines["components"] = alone[component].modelled
            rows.append((channel.label, channel.unit.replace("degC", "°C"), measured[name], lines))
    for name in ("inverter_power", "road_load"):
        if name in alone:
            c = alone[name]
            hide = np.where(c.valid, 1.0, np.nan)
            rows.append((c.channel.label, c.channel.unit, c.measured * hide, {"components": c.modelled * hide}))
    height = 1.0 + 1.45 * len(rows)
    figure = Figure(figsize=(15, height), facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(
        len(rows), 2, left=0.055, right=0.99, top=1 - 0.75 / height, bottom=0.45 / height, hspace=0.35, wspace=0.11
    )
    minutes = 60.0 if entry["duration_s"] >= 300 else 1.0
    first: Axes | None = None
    for i, (label, unit, truth, lines) in enumerate(rows):
        left = figure.add_subplot(grid[i, 0], sharex=first)
        first = first or left
        right = figure.add_subplot(grid[i, 1], sharex=first)
        time = np.arange(len(truth)) / minutes
        left.plot(time, truth, color=_INK, linewidth=1.1, label="measured")
        right.axhline(0, color=_MUTED, linewidth=0.8)
        for form, values in lines.items():
            n = min(len(truth), len(values))
            left.plot(time[:n], values[:n], color=_COLOURS[form], linewidth=0.9, alpha=0.85, label=_NAMES[form])
            error = values[:n] - truth[:n]
            right.plot(time[:n], error, color=_COLOURS[form], linewidth=0.35 if n > 60 else 1.0, alpha=0.45)
            wide = min(30, max(n // 4, 1))  # s: what is left of it when gears and gusts are averaged out
            known = np.isfinite(error)
            weight = np.convolve(known, np.ones(wide), "same")
            mean = np.convolve(np.where(known, error, 0.0), np.ones(wide), "same") / np.maximum(weight, 1)
            right.plot(
                time[:n],
                np.where(weight > wide / 4, mean, np.nan),
                color=_COLOURS[form],
                linewidth=1.5,
                label=_NAMES[form],
            )
        left.set_ylabel(f"{label}\n[{unit}]", fontsize=8, color=_INK)
        for axis in (left, right):
            axis.grid(True, color=_GRID, linewidth=0.8)
            axis.set_axisbelow(True)
            axis.tick_params(colors=_MUTED, labelsize=7.5, length=0, labelbottom=i == len(rows) - 1)
            for side in axis.spines.values():
                side.set_color(_GRID)
        if not i:
            left.set_title("measured and simulated", fontsize=9, loc="left", color=_INK)
            right.set_title(
                "simulated less measured: each second, and the mean of 30 s", fontsize=9, loc="left", color=_INK
            )
        if i == len(rows) - 1:
            for axis in (left, right):
                axis.set_xlabel(f"time [{'min' if minutes > 1 else 's'}]", fontsize=8.5, loc="left", color=_INK)
    assert first
    named = {label: line for axis in figure.axes for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    order = [label for label in ("measured", *_NAMES.values()) if label in named]
    figure.legend(
        handles=[named[label] for label in order],
        labels=order,
        loc="upper right",
        ncols=4,
        frameon=False,
        fontsize=9,
        bbox_to_anchor=(0.99, 1.0),
    )
    first.set_xlim(0, max(entry["duration_s"] / minutes, 1e-3))
    air = "" if entry["ambient_c"] is None else f", air {entry['ambient_c']:.0f} °C"
    title = f"{entry['name']} · {entry['vehicle']}, {entry['payload_kg']:g} kg{air}, {entry['distance_km']:.1f} km"
    figure.text(0.055, 1 - 0.3 / height, title, fontsize=12, fontweight="bold", color=_INK, va="center")
    figure.savefig(file, format="png", dpi=90, metadata={"Software": "gz-onboard"})


def write_page(file: Path, rides: Sequence[Mapping[str, Any]], together: Mapping[str, Any]) -> None:
    """An HTML page that stands alone: the gate's tables, where the model fails, each ride's picture. Raises OSError."""
    from gz_onboard.lab import validate_score

    parts = [f"<h1>Validation of {html.escape(rides[0]['vehicle'])}</h1>"]
    passed = sum(ride["passed"] for ride in rides)
    parts.append(f"<p>{passed} of {len(rides)} rides pass: each channel within 20 %, each component within 10 %.</p>")
    for form in ("open_loop", "predictive", "components"):
        parts.append(f"<h2>{_NAMES[form].capitalize()}: percent of each channel</h2>{_gate(rides, form)}")
    parts.append("<h2>Where the model fails</h2>")
    for where, forms in together.items():
        parts.append(f"<h3>On the {where}</h3>{_failures(forms)}")
    parts.append("<h2>What could not be judged</h2><ul>")
    parts += [f"<li>{html.escape(r['name'])}: {html.escape(text)}</li>" for r in rides for text in r["missing"]]
    parts.append(f"</ul><h2>Definitions</h2><pre>{html.escape(validate_score.__doc__ or '')}</pre>")
    for ride in rides:
        if ride["plot"]:
            data = base64.b64encode(Path(ride["plot"]).read_bytes()).decode("ascii")
            parts.append(f"<h2>{html.escape(ride['name'])}</h2><img alt='' src='data:image/png;base64,{data}'>")
    file.write_text(
        f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>Validation</title><style>
body {{ font-family: system-ui, sans-serif; color: {_INK}; max-width: 80rem; margin: 2rem auto; padding: 0 1rem; }}
table {{ border-collapse: collapse; margin: 0.5rem 0 1.5rem; font-size: 0.9rem; font-variant-numeric: tabular-nums; }}
td, th {{ padding: 0.2rem 0.6rem; border-bottom: 1px solid {_GRID}; text-align: right; }}
th {{ font-weight: 600; vertical-align: bottom; }}
td:first-child, th:first-child {{ text-align: left; }} .bad {{ background: #fde8e8; color: #9b1c1c; font-weight: 600; }}
img {{ width: 100%; }} pre {{ background: #f5f7fa; padding: 1rem; overflow-x: auto; }}
</style></head><body>
{chr(10).join(parts)}
</body></html>
""",
        encoding="utf-8",
    )


def _gate(rides: Sequence[Mapping[str, Any]], form: str) -> str:
    names = list(dict.fromkeys(name for ride in rides if ride[form] for name in ride[form]["channels"]))
    energy = form != "components"
    head = "".join(f"<th>{name.replace('_', ' ')}</th>" for name in [*names, *(["energy"] if energy else [])])
    rows = []
    for ride in rides:
        entry = ride[form]
        if not entry:
            continue
        cells = []
        for name in names:
            e = entry["channels"].get(name)
            if e is None or e["percent"] is None:
                cells.append("<td>–</td>")
            else:
                cells.append(f"<td{'' if e['passed'] else ' class=bad'}>{e['percent']:.1f}</td>")
        if energy:
            percent = entry["energy_percent"]
            cells.append("<td>–</td>" if percent is None else f"<td>{percent:+.1f}</td>")
        rows.append(f"<tr><td>{html.escape(ride['name'])}</td>{''.join(cells)}</tr>")
    return f"<table><tr><th>ride</th>{head}</tr>{''.join(rows)}</table>"


COLUMNS = (
    ("predictive", "pack_power", "W", "power, rider model"),
    ("components", "road_load", "N", "road load alone"),
    ("components", "inverter_power", "W", "inverter alone"),
    ("components", "battery_voltage", "V", "battery voltage alone"),
    ("components", "motor_temperature", "K", "motor temperature alone"),
)
"""What the table of failures shows: form, channel, unit, head."""


def failures(forms: Mapping[str, Any]) -> list[tuple[str, str, float, list[tuple[float, float] | None]]]:
    """Rows (sorting, condition, seconds, (mean error, in percent of the mean magnitude) per column of `COLUMNS`)."""
    rows = []
    for by in LABELS:
        kinds = dict.fromkeys(
            kind for form, channel, *_ in COLUMNS for kind in forms.get(form, {}).get(channel, {}).get(by, {})
        )
        for kind in sorted(kinds, key=ORDER.index):
            cells: list[tuple[float, float] | None] = []
            time = 0.0
            for form, channel, *_ in COLUMNS:
                row = forms.get(form, {}).get(channel, {}).get(by, {}).get(kind)
                time = max(time, row["seconds"] if row else 0.0)
                cells.append((row["mean_error"], row["bias_percent"]) if row else None)
            rows.append((by, kind, time, cells))
    return rows


def _failures(forms: Mapping[str, Any]) -> str:
    head = "".join(f"<th>{title}<br>mean error [{unit}]</th><th>%</th>" for *_, unit, title in COLUMNS)
    rows, before = [], ""
    for by, kind, time, means in failures(forms):
        if by != before:
            rows.append(f"<tr><th colspan={3 + 2 * len(COLUMNS)}>{html.escape(LABELS[by])}</th></tr>")
            before = by
        values = "".join(
            "<td>–</td><td>–</td>" if cell is None else f"<td>{cell[0]:+.3g}</td><td>{cell[1]:+.1f}</td>"
            for cell in means
        )
        rows.append(f"<tr><td>{kind}</td><td>{time / 60:.1f}</td>{values}</tr>")
    return f"<table><tr><th>condition</th><th>min</th>{head}</tr>{''.join(rows)}</table>"


# --- Markdown -----------------------------------------------------------------------------------------------------


def markdown(rides: Sequence[Mapping[str, Any]], together: Mapping[str, Any]) -> str:
    """The tables of the page as Markdown; what is beyond its limit in bold."""
    parts = []
    for form in ("open_loop", "predictive", "components"):
        names = list(dict.fromkeys(name for ride in rides if ride[form] for name in ride[form]["channels"]))
        energy = form != "components"
        heads = ["ride", *(name.replace("_", " ") for name in names), *(["energy"] if energy else [])]
        rows = []
        for ride in rides:
            if not ride[form]:
                continue
            cells = [_bold(ride[form]["channels"].get(name)) for name in names]
            if energy:
                percent = ride[form]["energy_percent"]
                cells.append("–" if percent is None else f"{percent:+.1f}")
            rows.append([ride["name"], *cells])
        parts.append(f"### {_NAMES[form].capitalize()}, percent\n\n{_table(heads, rows)}")
    for where, forms in together.items():
        heads = ["condition", "min", *(f"{title}, {unit}" for *_, unit, title in COLUMNS)]
        rows, before = [], ""
        for by, kind, time, means in failures(forms):
            if by != before:
                rows.append([f"*{LABELS[by]}*", "", *([""] * len(COLUMNS))])
                before = by
            values = ["–" if cell is None else f"{cell[0]:+.3g} ({cell[1]:+.1f} %)" for cell in means]
            rows.append([kind, f"{time / 60:.0f}", *values])
        parts.append(f"### Mean error by condition, {where}\n\n{_table(heads, rows)}")
    return "\n\n".join(parts) + "\n"


def _bold(entry: Mapping[str, Any] | None) -> str:
    if entry is None or entry["percent"] is None:
        return "–"
    return f"{entry['percent']:.1f}" if entry["passed"] else f"**{entry['percent']:.1f}**"


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
