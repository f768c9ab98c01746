"""The discovery's report: one HTML page with its pictures inside."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gz_onboard.lab.discover.channels import BY_NAME, over_blocks
from gz_onboard.lab.discover.grid import Array
from gz_onboard.lab.discover.linear import Linear
from gz_onboard.lab.discover.result import Report
from gz_onboard.lab.discover.shapes import QUANTITIES, quantity

OVER = (
    "speed", "acceleration", "lateral_acceleration", "grade", "heading", "motor_temperature", "ambient_temperature",
    "cell_temperature", "motor_current", "current_change", "time",
)  # fmt: skip
LABELS = {name: unit for name, (_, unit) in QUANTITIES.items()} | {
    "ambient_temperature": "degC", "cell_temperature": "degC",
}  # fmt: skip
SHOWN = ("road_force", "inverter_power", "cell_voltage", "pack_balance", "auxiliary", "motor_temperature",
         "inverter_temperature", "cell_temperature", "gps_speed")  # fmt: skip


def write_report(report: Report, out: Path) -> None:
    """Write `report` to the HTML file `out`."""
    parts = [
        f"<h1>Discovery: {html.escape(report.verdict)}</h1>",
        _causes(report),
        "<h2>Ranking</h2>",
        _ranking(report),
    ]
    parts.append("<h2>Gain on rides held out</h2>" + _gain(report))
    parts.append("<h2>Residuals</h2>" + _residuals(report))
    for name in SHOWN:
        if any(name in line.tables for line in report.lines):
            parts.append(f"<h3>{name} [{BY_NAME[name].unit}]</h3>" + _picture(binned(report.lines, name)))
    if report.unknown:
        parts.append("<h2>What has no name</h2>" + _picture(curve(report.unknown)))
    look = report.isolability.get("look_alikes", [])
    rows = [f"<tr><td>{a}</td><td>{b}</td><td>{c:+.2f}</td></tr>" for a, b, c in look[:20]]
    parts.append(
        "<h2>What these rides can hardly separate</h2><p>Cosine of the columns once nuisances are out; 1 cannot be "
        "told apart.</p><table><tr><th>cause</th><th>cause</th><th>cosine</th></tr>" + "".join(rows) + "</table>"
    )
    parts += [f"<p>{html.escape(line)}</p>" for line in (*report.advice, *report.notes)]
    style = "body{font:15px sans-serif;max-width:70em;margin:2em auto}img{width:100%}"
    style += "td,th{padding:.2em .8em;text-align:right}"
    page = f'<!doctype html><meta charset="utf-8"><title>Discovery</title><style>{style}</style>' + "\n".join(parts)
    out.write_text(page, encoding="utf-8")


def _causes(report: Report) -> str:
    rows = [
        f"<tr><td>{c.name}</td><td>{c.parameter}</td><td>{c.value:.5g} {html.escape(c.unit)}</td>"
        f"<td>{c.ci95[0]:.5g} to {c.ci95[1]:.5g}</td><td>{c.energy_share:+.1%}</td><td>{c.evidence:.0f}</td></tr>"
        for c in report.causes
    ]
    text = (
        "<table><tr><th>cause</th><th>parameter</th><th>value</th><th>95 %</th><th>energy</th><th>evidence</th></tr>"
        + "".join(rows)
        + "</table>"
        if rows
        else "<p>No cause is named.</p>"
    )
    for group in report.ambiguous:
        text += f"<p>These rides cannot tell apart: {', '.join(group)}.</p>"
    if report.unknown:
        u = report.unknown
        text += f"<p>Unknown: {u['channel']} over {u['quantity']}, {u['share']:+.1%} of the energy.</p>"
    return text + f"<p>Threshold of evidence: {report.threshold:.1f}.</p>"


def _gain(report: Report) -> str:
    rows = [
        f"<tr><td>{name}</td><td>{g['before']:.4g}</td><td>{g['control']:.4g}</td><td>{g['after']:.4g}</td>"
        f"<td>{g['ci95'][0]:.3g} to {g['ci95'][1]:.3g}</td></tr>"
        for name, g in report.gain.items()
        if isinstance(g, dict)
    ]
    head = "<tr><th></th><th>before</th><th>refitted</th><th>extended</th><th>saved over refitted, 95 %</th></tr>"
    return f"<table>{head}{''.join(rows)}</table>"


def _residuals(report: Report) -> str:
    rows = [
        f"<tr><td>{name}</td><td>{r['mean']:.4g}</td><td>{r['rms']:.4g} {BY_NAME[name].unit}</td>"
        f"<td>{r['autocorrelation']:.2f}</td><td>{r['energy_share']:+.1%}</td><td>{r['range_share']:+.1%}</td></tr>"
        for name, r in report.residuals.items()
    ]
    head = "<tr><th>channel</th><th>mean</th><th>rms</th><th>autocorrelation</th><th>energy</th><th>range</th></tr>"
    return f"<table>{head}{''.join(rows)}</table>"


def _ranking(report: Report) -> str:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 0.24 * len(report.ranking) + 0.8))
    axes = figure.subplots()
    names = [name for name, _ in report.ranking][::-1]
    scores = [max(score, 0.05) for _, score in report.ranking][::-1]
    chosen = {c.name for c in report.causes}
    axes.barh(names, scores, color=["tab:red" if name in chosen else "tab:gray" for name in names])
    axes.axvline(report.threshold, color="black", linestyle="--", linewidth=1)
    axes.set_xscale("symlog", linthresh=1)
    axes.set_xlabel("chi-squared of one degree of freedom that the cause explains beside those named (red)")
    return _picture(figure)


def binned(lines: Sequence[Linear], channel: str) -> Any:
    """The residual's mean over each quantity, in twelve bins of as many blocks, one standard error as bars."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 6.4), layout="constrained")
    for axes, name in zip(figure.subplots(3, 4, sharey=True).flat, OVER, strict=False):
        xs, ys = [], []
        for line in lines:
            table = line.tables.get(channel)
            if table is None:
                continue
            x = _over(line, name, channel)
            if x is not None:
                xs.append(x)
                ys.append(table.y * table.unit)
        if not xs:
            axes.set_axis_off()
            continue
        x, y = np.concatenate(xs), np.concatenate(ys)
        edges = np.unique(np.quantile(x, np.linspace(0, 1, 13)))
        at = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, max(len(edges) - 2, 0))
        rows = [(x[at == i].mean(), y[at == i].mean(), y[at == i].std() / np.sqrt((at == i).sum()))
                for i in range(len(edges) - 1) if (at == i).sum() > 3]  # fmt: skip
        if rows:
            middle, mean, error = np.array(rows).T
            axes.errorbar(middle, mean, error, fmt="o-", markersize=3)
        axes.axhline(0, color="black", linewidth=0.6)
        axes.set_xlabel(f"{name} [{LABELS.get(name, '1')}]", fontsize=8)
        axes.tick_params(labelsize=7)
    for axes in figure.axes[len(OVER) :]:
        axes.set_axis_off()
    figure.supylabel(f"measured less model [{BY_NAME[channel].unit}]", fontsize=9)
    return figure


def _over(line: Linear, name: str, channel: str) -> Array | None:
    table = line.tables[channel]
    if name in ("ambient_temperature", "cell_temperature"):
        return over_blocks(table.channel, line.ride.quantities[name])[table.used]
    return quantity(line.ride, name, table)


def curve(unknown: dict[str, Any]) -> Any:
    """The curve of an unknown cause."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3.2), layout="constrained")
    axes = figure.subplots()
    x, y, sd = np.array(unknown["curve"]).T
    axes.errorbar(x, y, 2 * sd, fmt="o-")
    axes.axhline(0, color="black", linewidth=0.6)
    axes.set_xlabel(f"{unknown['quantity']} [{unknown['unit']}]")
    axes.set_ylabel(f"{unknown['channel']} [{BY_NAME[unknown['channel']].unit}]")
    return figure


def _picture(figure: Any) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=90, bbox_inches="tight")
    return f'<img src="data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}">'
