"""The discovery's report: one HTML page with its pictures inside."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gz_onboard.discovery.breakdown import before_and_after
from gz_onboard.discovery.channels import CHANNEL
from gz_onboard.discovery.constancy import likeness, varying
from gz_onboard.discovery.detectability import extent
from gz_onboard.discovery.energy import residual_sizes
from gz_onboard.discovery.linear import LinearRide
from gz_onboard.discovery.plots import curve, overview, panels, ranking
from gz_onboard.discovery.result import METRICS, NO_INTERVAL, VERDICTS, Report
from gz_onboard.discovery.strain import in_words as strain_words
from gz_onboard.discovery.unexplained import in_words
from gz_onboard.discovery.verdict import Discovery
from gz_onboard.discovery.wording import readable, with_unit
from gz_onboard.reports.page import drawn, html_table, tiles, write_page
from gz_onboard.reports.results import clock
from gz_onboard.reports.style import save

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Picture = Callable[["Figure", str], str]

_GRADE = (
    "<p>Grade is made from the accelerometer, whose noise is in the road force too, with the other sign: "
    "a falling line over grade is that noise.</p>"
)


def write_report(found: Discovery, out: Path, picture_format: str | None = None) -> None:
    """Write the report of `found` to the HTML file `out`. Raises OSError.

    picture_format: each picture is also written beside it, as ``OUT.NAME.svg``.
    """

    def kept(figure: Figure, name: str) -> str:
        if picture_format:
            save(figure, out.with_name(f"{out.stem}.{name}.{picture_format}"))
        return f'<div class="scroll">{drawn(figure, readable(name))}</div>'

    write_page(out, f"{found.mixed.vehicle.name}: {found.report.verdict}", [body(found, kept)])


def body(found: Discovery, picture: Picture) -> str:
    """The report as HTML, below its title; picture: gives that of a figure with a name."""
    report = found.report
    before, after = before_and_after(found)
    stages = {"before": before, "after": after} if report.causes else {"before": before}
    channels = [name for name in CHANNEL if any(name in line.tables for line in found.lines)]
    parts = [
        _head(found),
        _causes(report),
        _next(report),
        "<h2>Residuals by channel</h2>" + _residuals(report, before, after),
        "<h2>What residuals correlate with</h2>",
        f"<p>Share of each residual's variance that goes with a quantity, in percent: before{_named(report)}.</p>",
        picture(overview(stages, channels), "overview"),
    ]
    shown = _most(found, before, channels)
    for name in [*shown, *(c for c in channels if c not in shown)]:
        title = f"{readable(name)} [{CHANNEL[name].unit}]"
        image = picture(panels(stages, name), name)
        note = _GRADE if name == "road_force" else ""
        parts.append(f"<details{' open' if name in shown else ''}><summary>{title}</summary>{image}{note}</details>")
    parts += [
        "<h2>Candidates by score</h2>" + picture(ranking(report), "ranking"),
        "<h2>Errors on held-out rides</h2>" + _gain(report),
    ]
    if report.unknown:
        parts.append("<h2>Unexplained residual</h2>" + picture(curve(report.unknown), "unknown"))
    parts += [_constancy(report), _limits(report), _separable(report), _notes(report)]
    return "\n".join(parts)


def _named(report: Report) -> str:
    if not report.causes:
        return "hand, each ride's own biases and wind taken off"
    names = ", ".join(readable(cause.name) for cause in report.causes)
    return f" and after {html.escape(names)}; each ride's own biases and wind taken off"


def _head(found: Discovery) -> str:
    report, mixed = found.report, found.mixed
    ridden = extent(found.lines)
    known = f"{mixed.healthy} healthy rides" if mixed.healthy else "the vehicle file alone"
    cards = [
        ("rides", f"{len(found.lines)}", "ride" if len(found.lines) == 1 else "rides"),
        ("distance", f"{ridden.distance / 1e3:.1f} km", f"in {clock(ridden.time)}"),
    ]
    if ridden.energy > 0:
        cards.append(("energy", f"{ridden.energy / 3.6e6:.2f} kWh", "drawn"))
    share = sum(cause.energy_share for cause in report.causes)
    if report.causes:
        cards.append(("share", f"{share:+.1%}", "of the energy named"))
    elif report.unknown:
        cards.append(("share", f"{report.unknown.share:+.1%}", "of the energy, without a name"))
    if (error := report.gain.range) is not None:
        cards.append(("error", f"{error.before:.1%} → {error.after:.1%}", "error of the range, held out"))
    rides = ", ".join(html.escape(line.ride.name) for line in found.lines)
    named = f": {', '.join(readable(cause.name) for cause in report.causes)}" if report.causes else ""
    return (
        f"<p>{VERDICTS[report.verdict]}{named}.</p>"
        f'<p class="about">{rides}; against the vehicle as known from {known}.</p>{tiles(cards)}'
    )


def _causes(report: Report) -> str:
    text = ""
    rows = []
    for c in report.causes:
        rows.append(
            [
                readable(c.name),
                c.parameter,
                with_unit(c.value, c.unit),
                f"{c.ci95[0]:.4g} to {c.ci95[1]:.4g}",
                with_unit(c.change, c.unit, "+.4g"),
                f"{c.energy_share:+.1%}",
                f"{c.evidence:.0f}",
            ]
        )
        for name, other in c.others.items():
            low, high = other.ci95
            value = with_unit(other.value, other.unit)
            rows.append(["", name, value, f"{low:.4g} to {high:.4g}", "", "", ""])
    if rows:
        heads = ["cause", "parameter", "value", "95 % interval", "change", "of the energy", "score"]
        text += "<h2>Causes</h2>" + html_table(heads, rows, range(2, len(heads)))
        text += (
            "<p>Score: chi-squared of one degree of freedom that the rides lose without it; healthy "
            f"rides stay below {report.threshold:.1f}.</p>"
        )
    for c in report.causes:
        if c.varies:
            text += f"<p>The {readable(c.name)} {varying(report.constancy, c.name)}: no model is extended with it.</p>"
    for group in report.ambiguous:
        text += f"<p><b>Ambiguous:</b> {', '.join(readable(name) for name in group)}.</p>"
    if report.unknown:
        u = report.unknown
        text += f"<p><b>No candidate explains</b> {in_words(u)}: {u.share:+.1%} of the energy, score {u.score:.0f}.</p>"
        if u.denies:
            names = ", ".join(readable(name) for name in u.denies)
            text += f"<p><b>Rejected:</b> {names}, which would not act alike everywhere.</p>"
    for sentence in strain_words(report.strain) if report.strain else ():
        text += f"<p><b>Implausible:</b> {html.escape(sentence)}.</p>"
    return text


def _next(report: Report) -> str:
    if not report.advice:
        return ""
    return "<h2>What to ride next</h2>" + "".join(f"<p>{html.escape(line)}</p>" for line in report.advice)


def _residuals(report: Report, before: Sequence[LinearRide], after: Sequence[LinearRide]) -> str:
    raw, first, last = report.residuals, residual_sizes(before), residual_sizes(after)
    rows = []
    for name in CHANNEL:
        if name not in raw:
            continue
        r, b, a = raw[name], first.get(name, raw[name]), last.get(name, raw[name])
        energy = any(abs(x.energy_share) > 0 for x in (b, a))
        shares = [f"{x:+.1%}" if energy else "–" for x in (b.energy_share, b.range_share, a.energy_share)]
        rows.append(
            [
                ("measured less model", readable(name)),
                ("unit", CHANNEL[name].unit),
                ("mean", f"{r.mean:+.2g}"),
                ("rms", f"{r.rms:.2g}"),
                ("before: rms", f"{b.rms:.2g}"),
                ("auto­correlation", f"{b.autocorrelation:.2f}"),
                ("of the energy", shares[0]),
                ("of the range", shares[1]),
                ("after: rms", f"{a.rms:.2g}"),
                ("auto­correlation", f"{a.autocorrelation:.2f}"),
                ("of the energy", shares[2]),
            ]
        )
    heads = [head for head, _ in next(iter(rows), [])]
    blocks = ", ".join(
        f"{readable(n)} {CHANNEL[n].block:g} s" for n in ("road_force", "inverter_power", "cell_voltage")
    )
    return html_table(heads, [[cell for _, cell in row] for row in rows], range(2, len(heads))) + (
        "<p>Mean and rms as measured, with the bias of each ride's sensors and its wind; before and "
        "after with these taken off, without and with the causes named. Autocorrelation: of neighbouring blocks "
        f"({blocks}); near 0 nothing is left but noise.</p>"
    )


def _most(found: Discovery, before: Sequence[LinearRide], channels: Sequence[str]) -> list[str]:
    """The channels whose pictures are open: those that the causes change most, else the road's and the cells'."""
    report, mixed = found.report, found.mixed
    if not report.causes:
        wanted = [report.unknown.channel] if report.unknown else []
        return [c for c in (*wanted, "road_force", "cell_voltage") if c in channels][:2]
    most: list[str] = []
    for cause in report.causes:
        index = mixed.index(list(cause.parameters))
        weight = {}
        for name in channels:
            tables = [line.tables[name] for line in before if name in line.tables]
            size_ = sum(float(np.sum(t.a[:, index] ** 2)) for t in tables)
            noise = sum(float(np.sum(t.y**2)) for t in tables)
            weight[name] = size_ / noise if noise > 0 else 0.0
        best = max(weight, key=lambda n: weight[n])
        if best not in most:
            most.append(best)
    return most


def _gain(report: Report) -> str:
    rows = []
    for metric, errors in report.gain.errors.items():
        label, factor, unit = METRICS[metric]
        ci95 = NO_INTERVAL if errors.ci95 is None else "{:+.3g} to {:+.3g}".format(*(x * factor for x in errors.ci95))
        values = [f"{x * factor:.3g}" for x in (errors.before, errors.control, errors.after)]
        rows.append([f"{label} [{unit}]", *values, ci95])
    if not rows:
        return f"<p>{html.escape(report.gain.note or 'nothing was held out')}</p>"
    heads = ["error", "before", "control", "after", "gain over control, 95 % over rides"]
    held = ", ".join(map(html.escape, report.gain.holdout))
    text = "In no choice and no fit" if report.gain.apart else "Each in turn was held out of the fit"
    return html_table(heads, rows, range(1, len(heads))) + (
        f"<p>{text}: {held}. Control: the parameters that the model has already, refitted on the other "
        "rides. After: the causes as well.</p>"
    )


def _constancy(report: Report) -> str:
    splits = report.constancy
    if not splits:
        return ""
    rows = [[readable(s.cause), readable(s.quantity), f"{s.ratio:+.2f}", f"{s.chi2:.1f}", likeness(s)] for s in splits]
    return (
        "<h2>Constancy of the causes</h2><p>Half the difference of left and right bends, or of the upper "
        "and lower half of a quantity, or of a ride and the others, over the mean: 0 for the cause itself, ±1 for what "
        "acts in one half only.</p>" + html_table(["cause", "over", "ratio", "chi-squared", "judged"], rows, (2, 3))
    )


def _limits(report: Report) -> str:
    rows = []
    for name, limit in report.limits.items():
        if limit.change is None or limit.energy_share is None:
            rows.append([readable(name), limit.parameter, "not by these rides", "–"])
        else:
            share = f"{limit.energy_share:.1%}" if limit.energy_share > 1e-5 else "–"
            rows.append([readable(name), limit.parameter, with_unit(limit.change, limit.unit, ".3g"), share])
    heads = ["cause", "parameter", "change", "of the energy"]
    return (
        "<h2>Detection limits</h2><p>The least change that would be found half the time, were it alone.</p>"
        f"<details><summary>Every candidate</summary>{html_table(heads, rows, (2, 3))}"
        "</details>"
    )


def _separable(report: Report) -> str:
    look = report.isolability.look_alikes
    if not look:
        return "<p>No two candidates look alike to these rides (cosine above 0.8).</p>"
    rows = [[readable(a), readable(b), f"{c:+.2f}"] for a, b, c in look[:20]]
    return (
        "<p>Causes that look alike to these rides: cosine of what they do to the residuals once biases and scatter are "
        "out. At ±1 no statistics can tell them apart.</p>" + html_table(["cause", "cause", "cosine"], rows, (2,))
    )


def _notes(report: Report) -> str:
    if not report.notes:
        return ""
    return "<h2>Notes</h2><ul>" + "".join(f"<li>{html.escape(note)}</li>" for note in report.notes) + "</ul>"
