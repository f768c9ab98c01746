"""The discovery's report: one HTML page with its pictures inside."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gz_onboard.lab.discover.breakdown import (
    QUANTITIES,
    QuantityReader,
    before_and_after,
    binned,
    edges,
    pooled,
    share_over,
)
from gz_onboard.lab.discover.channels import BY_NAME
from gz_onboard.lab.discover.detectability import amount, limits, size, words
from gz_onboard.lab.discover.energy import residual_sizes
from gz_onboard.lab.discover.linear import LinearRide
from gz_onboard.lab.discover.result import METRICS, VERDICTS, Report
from gz_onboard.lab.discover.unexplained import RIDES
from gz_onboard.simulation.style import BLUE, GRID, INK, MUTED, ORANGE, headline, legend, new_figure, rule
from gz_onboard.simulation.telling import clock

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BEFORE, AFTER = ORANGE, BLUE
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1f2933; max-width: 1150px; margin: 2rem auto; padding: 0 1.5rem }
h1 { font-size: 1.7rem; margin-bottom: .2rem } h2 { margin-top: 2.4rem; border-bottom: 1px solid #e4e7eb }
.verdict { font-size: 1.15rem; margin: .2rem 0 1rem } .muted { color: #7b8794 }
.cards { display: flex; flex-wrap: wrap; gap: 1rem; margin: 1rem 0 }
.card { background: #f5f7fa; border-radius: .5rem; padding: .7rem 1.1rem; min-width: 9rem }
.card b { display: block; font-size: 1.35rem }
table { border-collapse: collapse; margin: .6rem 0 }
td, th { padding: .25rem .7rem; text-align: right } td { white-space: nowrap }
td { border-top: 1px solid #e4e7eb } td:first-child, th:first-child { text-align: left }
th { color: #7b8794; font-weight: 600; vertical-align: bottom } img { width: 100%; display: block }
summary { cursor: pointer; font-weight: 600; margin: .6rem 0 }
"""


_GRADE = (
    '<p class="muted">Grade is made from the accelerometer, whose noise is in the road force too, with the other sign: '
    "a falling line over grade is that noise.</p>"
)


def write_report(report: Report, out: Path) -> None:
    """Write `report` to the HTML file `out`. Raises OSError."""
    out.write_text(page(report), encoding="utf-8")


def page(report: Report) -> str:
    """The report as HTML."""
    before, after = before_and_after(report)
    over = QuantityReader(report.mixed) if report.mixed else None
    assert over is not None
    channels = [name for name in BY_NAME if any(name in line.tables for line in report.lines)]
    parts = [
        _head(report),
        _causes(report),
        _next(report),
        "<h2>What the residuals are</h2>" + _residuals(report, before, after),
        "<h2>Where they live</h2>",
        f"<p>Share of each residual's variance that goes with a quantity, in percent: before{_named(report)}.</p>",
        _picture(overview(before, after, channels, over, bool(report.causes))),
    ]
    shown = _most(report, before, channels)
    for name in [*shown, *(c for c in channels if c not in shown)]:
        title = f"{words(name)} [{BY_NAME[name].unit}]"
        picture = _picture(panels(before, after, name, over, bool(report.causes)))
        note = _GRADE if name == "road_force" else ""
        parts.append(f"<details{' open' if name in shown else ''}><summary>{title}</summary>{picture}{note}</details>")
    parts += [
        "<h2>Which cause</h2>" + _picture(ranking(report)),
        "<h2>What it is worth: rides held out of the fit</h2>" + _gain(report),
    ]
    if report.unknown:
        parts.append("<h2>What has no name</h2>" + _picture(curve(report.unknown)))
    parts += [_constancy(report), _limits(report), _separable(report), _notes(report)]
    body = "\n".join(parts)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Discovery: {report.verdict}</title>'
        f"<style>{_STYLE}</style></head><body>\n{body}\n</body></html>\n"
    )


def _named(report: Report) -> str:
    if not report.causes:
        return "hand, each ride's own biases and wind taken off"
    names = ", ".join(words(cause.name) for cause in report.causes)
    return f" and after {html.escape(names)}; each ride's own biases and wind taken off"


def _head(report: Report) -> str:
    mixed = report.mixed
    assert mixed is not None
    way, time, drawn = size(report)
    known = f"{mixed.healthy} healthy rides" if mixed.healthy else "the vehicle file alone"
    cards = [
        (f"{len(report.lines)}", "ride" if len(report.lines) == 1 else "rides"),
        (f"{way / 1e3:.1f} km", clock(time)),
    ]
    if drawn > 0:
        cards.append((f"{drawn / 3.6e6:.2f} kWh", "drawn"))
    share = sum(cause.energy_share for cause in report.causes)
    if report.causes:
        cards.append((f"{share:+.1%}", "of the energy named"))
    elif report.unknown:
        cards.append((f"{report.unknown['share']:+.1%}", "of the energy, without a name"))
    error = report.gain.get("range")
    if isinstance(error, dict):
        cards.append((f"{error['before']:.1%} → {error['after']:.1%}", "error of the range, held out"))
    boxes = "".join(f'<div class="card"><b>{value}</b>{text}</div>' for value, text in cards)
    rides = ", ".join(html.escape(line.ride.name) for line in report.lines)
    return (
        f"<h1>{html.escape(mixed.vehicle.name)}: {report.verdict}</h1>"
        f'<p class="verdict">{VERDICTS[report.verdict].capitalize()}.</p>'
        f'<p class="muted">{rides}; against the vehicle as known from {known}.</p><div class="cards">{boxes}</div>'
    )


def _causes(report: Report) -> str:
    text = ""
    rows = []
    for c in report.causes:
        rows.append(
            [
                words(c.name),
                c.parameter,
                amount(c.value, c.unit),
                f"{c.ci95[0]:.4g} to {c.ci95[1]:.4g}",
                f"{c.change:+.4g}",
                f"{c.energy_share:+.1%}",
                f"{c.evidence:.0f}",
            ]
        )
        rows += [["", name, f"{value:.4g}", f"{ci[0]:.4g} to {ci[1]:.4g}", "", "", ""] for name, value, ci in c.others]
    if rows:
        heads = ["cause", "parameter", "value", "95 % interval", "change", "of the energy", "score"]
        text += "<h2>Causes</h2>" + table(heads, rows)
        text += (
            '<p class="muted">Score: chi-squared of one degree of freedom that the rides lose without it; healthy '
            f"rides stay below {report.threshold:.1f}.</p>"
        )
    for c in report.causes:
        if c.varies:
            text += (
                f"<p>The {words(c.name)} differs from ride to ride: it is named, but no model is extended with it.</p>"
            )
    for group in report.ambiguous:
        text += f"<p><b>Not told apart by these rides:</b> {', '.join(words(name) for name in group)}.</p>"
    if report.unknown:
        u = report.unknown
        text += (
            f"<p><b>No candidate explains</b> what {words(u['channel'])} leaves over {words(u['quantity'])}: "
            f"{u['share']:+.1%} of the energy, score {u['score']:.0f}.</p>"
        )
        if u["denies"]:
            names = ", ".join(words(name) for name in u["denies"])
            text += f"<p><b>Denied:</b> {names}, which would not act alike everywhere.</p>"
    return text


def _next(report: Report) -> str:
    if not report.advice:
        return ""
    return "<h2>What to ride next</h2>" + "".join(f"<p>{html.escape(line)}</p>" for line in report.advice)


def _residuals(report: Report, before: Sequence[LinearRide], after: Sequence[LinearRide]) -> str:
    raw, first, last = report.residuals, residual_sizes(before), residual_sizes(after)
    rows = []
    for name in BY_NAME:
        if name not in raw:
            continue
        r, b, a = raw[name], first.get(name, raw[name]), last.get(name, raw[name])
        energy = any(abs(x["energy_share"]) > 0 for x in (b, a))
        shares = [f"{x:+.1%}" if energy else "–" for x in (b["energy_share"], b["range_share"], a["energy_share"])]
        rows.append(
            [
                words(name),
                BY_NAME[name].unit,
                f"{r['mean']:+.2g}",
                f"{r['rms']:.2g}",
                f"{b['rms']:.2g}",
                f"{b['autocorrelation']:.2f}",
                *shares[:2],
                f"{a['rms']:.2g}",
                f"{a['autocorrelation']:.2f}",
                shares[2],
            ]
        )
    heads = [
        "measured less model",
        "unit",
        "mean",
        "rms",
        "before: rms",
        "auto­correlation",
        "of the energy",
        "of the range",
        "after: rms",
        "auto­correlation",
        "of the energy",
    ]
    blocks = ", ".join(f"{words(n)} {BY_NAME[n].block:g} s" for n in ("road_force", "inverter_power", "cell_voltage"))
    return table(heads, rows) + (
        '<p class="muted">Mean and rms as measured, with the bias of each ride\'s sensors and its wind; before and '
        "after with these taken off, without and with the causes named. Autocorrelation: of neighbouring blocks "
        f"({blocks}); near 0 nothing is left but noise.</p>"
    )


def _most(report: Report, before: Sequence[LinearRide], channels: Sequence[str]) -> list[str]:
    """The channels whose pictures are open: those that the causes change most, else the road's and the cells'."""
    mixed = report.mixed
    if mixed is None or not report.causes:
        wanted = [report.unknown["channel"]] if report.unknown else []
        return [c for c in (*wanted, "road_force", "cell_voltage") if c in channels][:2]
    found = []
    for cause in report.causes:
        index = mixed.index(next(c for c in mixed.causes if c.name == cause.name).names)
        weight = {}
        for name in channels:
            tables = [line.tables[name] for line in before if name in line.tables]
            size_ = sum(float(np.sum(t.a[:, index] ** 2)) for t in tables)
            noise = sum(float(np.sum(t.y**2)) for t in tables)
            weight[name] = size_ / noise if noise > 0 else 0.0
        best = max(weight, key=lambda n: weight[n])
        if best not in found:
            found.append(best)
    return found


def _gain(report: Report) -> str:
    rows = []
    for metric, (label, factor, unit) in METRICS.items():
        g = report.gain.get(metric)
        if isinstance(g, dict):
            low, high = (x * factor for x in g["ci95"])
            rows.append(
                [
                    f"{label} [{unit}]",
                    *(f"{g[key] * factor:.3g}" for key in ("before", "control", "after")),
                    f"{low:+.3g} to {high:+.3g}",
                ]
            )
    if not rows:
        return f"<p>{html.escape(str(report.gain.get('note', 'nothing was held out')))}</p>"
    heads = ["error", "before", "control", "after", "gain over control, 95 % over rides"]
    held = ", ".join(map(html.escape, report.gain.get("holdout", [])))
    text = "In no choice and no fit" if report.gain.get("apart") else "Each in turn was held out of the fit"
    return table(heads, rows) + (
        f'<p class="muted">{text}: {held}. Control: the parameters that the model has already, refitted on the other '
        "rides. After: the causes as well.</p>"
    )


def _constancy(report: Report) -> str:
    splits = report.constancy
    if not splits:
        return ""
    rows = [[words(s.cause), words(s.quantity), f"{s.ratio:+.2f}", f"{s.chi2:.1f}"] for s in splits]
    return (
        "<h2>Whether a cause acts alike everywhere</h2><p>Half the difference of left and right bends, or of the upper "
        "and lower half of a quantity, over the mean: 0 for the cause itself, ±1 for what acts in one half only.</p>"
        + table(["cause", "over", "ratio", "chi-squared"], rows)
    )


def _limits(report: Report) -> str:
    rows = []
    for limit in limits(report):
        if limit.change < float("inf"):
            share = f"{limit.share:.1%}" if limit.share > 1e-5 else "–"
            rows.append([words(limit.name), limit.parameter, amount(limit.change, limit.unit, ".3g"), share])
        else:
            rows.append([words(limit.name), limit.parameter, "not by these rides", "–"])
    return (
        "<h2>What these rides could show</h2><p>The least change that would be found half the time, were it alone.</p>"
        f"<details><summary>Every candidate</summary>{table(['cause', 'parameter', 'change', 'of the energy'], rows)}"
        "</details>"
    )


def _separable(report: Report) -> str:
    look = report.isolability.get("look_alikes", [])
    if not look:
        return "<p>No two candidates look alike to these rides (cosine above 0.8).</p>"
    rows = [[words(a), words(b), f"{c:+.2f}"] for a, b, c in look[:20]]
    return (
        "<p>Causes that look alike to these rides: cosine of what they do to the residuals once biases and scatter are "
        "out. At ±1 no statistics can tell them apart.</p>" + table(["cause", "cause", "cosine"], rows)
    )


def _notes(report: Report) -> str:
    if not report.notes:
        return ""
    return "<h2>Notes</h2><ul>" + "".join(f"<li>{html.escape(note)}</li>" for note in report.notes) + "</ul>"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """An HTML table of texts."""
    head = "".join(f"<th>{html.escape(text)}</th>" for text in heads)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


# --- pictures -----------------------------------------------------------------------------------------------------


def overview(
    before: Sequence[LinearRide],
    after: Sequence[LinearRide],
    channels: Sequence[str],
    over: QuantityReader,
    named: bool,
) -> Figure:
    """Channels by quantities: the share of variance that goes with each, before and after."""
    quantities = list(QUANTITIES)
    grids = []
    for lines in (before, after) if named else (before,):
        rows = []
        for channel in channels:
            rows.append([100 * share_over(*pooled(lines, channel, name, over)[:2]) for name in quantities])
        grids.append(np.array(rows))
    width, height = 12.5, 1.5 + 0.3 * len(channels)
    figure = new_figure(width, height)
    for i, (grid, title) in enumerate(zip(grids, ("before", "after"), strict=False)):
        axis = figure.add_axes((0.12 + 0.43 * i, 0.02, 0.385, 1 - 1.35 / height))
        axis.imshow(grid, cmap="Oranges" if i == 0 else "Blues", vmin=0, vmax=60, aspect="auto")
        for r in range(len(channels)):
            for c in range(len(quantities)):
                value = grid[r, c]
                if value >= 1:
                    axis.text(
                        c,
                        r,
                        f"{value:.0f}",
                        ha="center",
                        va="center",
                        fontsize=7.5,
                        color="white" if value > 40 else INK,
                    )
        axis.set_xticks(
            range(len(quantities)), [words(name) for name in quantities], rotation=38, ha="left", fontsize=8
        )
        axis.xaxis.tick_top()
        axis.set_yticks(range(len(channels)), [words(name) for name in channels] if i == 0 else [], fontsize=8)
        axis.tick_params(length=0, colors=MUTED)
        for side in axis.spines.values():
            side.set_color(GRID)
        if named:
            headline(figure, 0.13 + 0.44 * i, 1 - 0.12 / height, title, 10)
    return figure


def panels(
    before: Sequence[LinearRide],
    after: Sequence[LinearRide],
    channel: str,
    over: QuantityReader,
    named: bool,
    names: Sequence[str] = tuple(QUANTITIES),
) -> Figure:
    """The residual's mean over each quantity, in bins of as many blocks, one standard error as a band."""
    drawn = []
    for name in names:
        x, y, _ = pooled(before, channel, name, over)
        if len(x) > 20 and np.ptp(x) > 0:
            at = edges(x)
            drawn.append((name, binned(x, y, at), binned(*pooled(after, channel, name, over)[:2], at)))
    columns = min(4, max(len(drawn), 1))
    rows = max(1, -(-len(drawn) // columns))
    height = 0.55 + 2.15 * rows
    figure = new_figure(12.5, height)
    if not drawn:
        return figure
    grid = figure.add_gridspec(
        rows, columns, left=0.06, right=0.985, wspace=0.13, hspace=0.42, top=1 - 0.3 / height, bottom=0.48 / height
    )
    axes: list[Any] = []
    for i, (name, first, last) in enumerate(drawn):
        axis = figure.add_subplot(grid[i // columns, i % columns], sharey=axes[0] if axes else None)
        axes.append(axis)
        rule(axis)
        axis.locator_params(nbins=5)
        for rows_, colour, label in ((first, BEFORE, "before"), (last, AFTER, "after")):
            if label == "after" and not named:
                continue
            x, y, error = rows_[:, 0], rows_[:, 1], rows_[:, 2]
            axis.fill_between(x, y - error, y + error, color=colour, alpha=0.2, linewidth=0)
            axis.plot(x, y, "o-", color=colour, markersize=3, linewidth=1.3, label=label if named else "residual")
        axis.axhline(0, color=INK, linewidth=0.6)
        label, unit = QUANTITIES[name]
        axis.set_xlabel(label if unit == "1" else f"{label} [{unit}]", fontsize=8, color=INK, labelpad=2)
        if i % columns:
            axis.tick_params(labelleft=False)
    legend(axes[min(columns, len(axes)) - 1])
    figure.text(
        0.012, 0.5, f"measured less model [{BY_NAME[channel].unit}]", rotation=90, va="center", fontsize=8.5, color=INK
    )
    return figure


def ranking(report: Report) -> Figure:
    """The score of every candidate, with the threshold."""
    rows = report.ranking[::-1]
    height = 0.9 + 0.21 * len(rows)
    figure = new_figure(9, height)
    axis = figure.add_axes((0.2, 0.55 / height, 0.76, 1 - 0.75 / height))
    rule(axis)
    chosen = {c.name for c in report.causes}
    near = {name for group in report.ambiguous for name in group} - chosen
    colours = [BLUE if name in chosen else "#8fb8de" if name in near else "#cbd2d9" for name, _ in rows]
    axis.barh([words(name) for name, _ in rows], [max(score, 0.0) for _, score in rows], color=colours, height=0.7)
    axis.axvline(report.threshold, color=INK, linewidth=1, linestyle=(0, (4, 2)))
    axis.annotate(
        "threshold",
        (report.threshold, 0),
        (4, 3),
        xycoords=("data", "axes fraction"),
        textcoords="offset points",
        fontsize=8,
        color=MUTED,
        va="bottom",
    )
    axis.set_xscale("symlog", linthresh=10)
    axis.set_xlim(0, max(2 * report.threshold, 1.3 * max((score for _, score in rows), default=1)))
    axis.set_xlabel("score beside the causes named (blue), linear up to 10", fontsize=8.5, color=INK)
    axis.tick_params(axis="y", colors=INK)
    axis.margins(y=0.01)
    return figure


def curve(unknown: dict[str, Any]) -> Figure:
    """The curve of what has no name, with two standard deviations."""
    figure = new_figure(8, 3.4)
    axis = figure.add_axes((0.1, 0.16, 0.86, 0.78))
    rule(axis)
    x, y, sd = np.array(unknown["curve"], dtype=float).T
    axis.fill_between(x, y - 2 * sd, y + 2 * sd, color=BEFORE, alpha=0.2, linewidth=0)
    axis.plot(x, y, "o-", color=BEFORE, linewidth=1.6, markersize=4)
    axis.set_ylim(*_limits_of(y, sd))
    axis.axhline(0, color=INK, linewidth=0.6)
    axis.set_xlabel(f"{words(unknown['quantity'])} [{unknown['unit']}]", fontsize=9, color=INK)
    left = f"{words(unknown['channel'])} [{BY_NAME[unknown['channel']].unit}]"
    if unknown["quantity"] == RIDES:
        left = f"{words(unknown['denies'][0])}, over its mean [1]"
    axis.set_ylabel(left, fontsize=9, color=INK)
    return figure


def _limits_of(y: np.ndarray[Any, Any], sd: np.ndarray[Any, Any]) -> tuple[float, float]:
    """Of the ordinate: the curve where it is known; a knot without data does not set the scale."""
    known = sd < 5 * float(np.median(sd)) + 1e-12
    low, high = float(np.min((y - 2 * sd)[known])), float(np.max((y + 2 * sd)[known]))
    return min(low, 0.0) * 1.1, max(high, 0.0) * 1.1 + 1e-9


def _picture(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100, metadata={"Software": "gz-onboard"})
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}">'
