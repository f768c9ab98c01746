"""The report of a discovery: a summary for the terminal, and one HTML page with its pictures inside."""

from __future__ import annotations

import html
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.discovery.channels import CHANNEL
from gz_onboard.discovery.judgement import (
    METRICS,
    VERDICTS,
    Discovery,
    Report,
    Unknown,
    fitted,
    readable,
    residual_sizes,
    with_unit,
)
from gz_onboard.discovery.mixed_model import LinearRide
from gz_onboard.discovery.parameters import Candidate
from gz_onboard.discovery.search import SEARCH
from gz_onboard.reports.page import drawn, html_table, tiles, write_page
from gz_onboard.reports.results import clock
from gz_onboard.reports.style import BLUE, GRID, INK, MUTED, ORANGE, headline, legend, new_figure, rule

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COVARIATES: dict[str, tuple[str, str]] = {
    "speed": ("speed", "m/s"),
    "acceleration": ("acceleration", "m/s²"),
    "lateral_acceleration": ("lateral acceleration, left positive", "m/s²"),
    "grade": ("grade", "1"),
    "heading": ("heading, clockwise from north", "rad"),
    "ambient_temperature": ("air", "degC"),
    "motor_temperature": ("motor", "degC"),
    "cell_temperature": ("cells", "degC"),
    "soc": ("state of charge", "1"),
    "pack_current": ("pack current", "A"),
    "motor_current": ("motor current", "A"),
    "time": ("time since the start", "s"),
    "since_braking": ("time since a brake was touched", "s"),
    "vibration": ("vibration: how rough the road is", "m/s²"),
}
"""Quantities that residuals are shown over: words and unit."""
WIDTH = 118  # characters of a line in the terminal
Stages = Mapping[str, Sequence[LinearRide]]  # the rides "before" the causes and, if there are any, "after" them


def before_and_after(found: Discovery) -> tuple[list[LinearRide], list[LinearRide]]:
    """The rides with what remains of each residual before and after the causes.

    A residual as measured includes sensor biases, wind and the like of each ride. All parameters are fitted together,
    those of the causes free; all but the causes are taken off for "before", the causes too for "after".
    """
    now = found.search
    index, post = fitted(now, [cause.name for cause in found.report.causes])
    before, after = [], []
    for line, own in zip(now.lines, post.own, strict=True):
        theta = post.mean + own
        rest = theta.copy()
        rest[index] = now.mixed.mean[index] + own[index]
        before.append(line.seen_from(-rest))
        after.append(line.seen_from(-theta))
    return before, after


def pooled(lines: Sequence[LinearRide], channel: str, name: str) -> tuple[Array, Array]:
    """(quantity, residual in the channel's unit) of all blocks that measured both, each (m,)."""
    xs, ys = [np.zeros(0)], [np.zeros(0)]
    for line in lines:
        table = line.tables.get(channel)
        if table is not None and name in line.ride.quantities and line.ride.shows(name):
            xs.append(table.over(line.ride.quantities[name]))
            ys.append(table.y * table.unit)
    return np.concatenate(xs), np.concatenate(ys)


def edges(x: Array, count: int = 12) -> Array:
    """Edges of `count` bins with equal numbers of `x`; fewer where many are alike, none narrower than 1/25."""
    at = np.quantile(x, np.linspace(0, 1, count + 1))
    least = (np.quantile(x, 0.98) - np.quantile(x, 0.02)) / 25
    kept = [at[0]]
    for edge in at[1:-1]:
        if edge - kept[-1] >= least and at[-1] - edge >= least:
            kept.append(edge)
    return np.array([*kept, at[-1]])


def binned(x: Array, y: Array, at: Array) -> Array:
    """Rows (mean of x, mean of y, its standard error, blocks) of the bins between `at` with more than 3 blocks."""
    place = np.clip(np.searchsorted(at, x, side="right") - 1, 0, max(len(at) - 2, 0))
    bins = [place == i for i in range(max(len(at) - 1, 1))]
    rows = [(x[b].mean(), y[b].mean(), y[b].std() / np.sqrt(b.sum()), b.sum()) for b in bins if b.sum() > 3]
    return np.array(rows).reshape(-1, 4)


def share_over(x: Array, y: Array) -> float:
    """The share of the variance of `y` that goes with `x`: correlation ratio of its bins, less that of chance."""
    if len(x) < 30 or np.ptp(x) == 0 or np.std(y) == 0:
        return 0.0
    rows = binned(x, y, edges(x))
    if len(rows) < 2:
        return 0.0
    mean = np.average(rows[:, 1], weights=rows[:, 3])
    between = float(np.average((rows[:, 1] - mean) ** 2, weights=rows[:, 3])) / float(np.var(y))
    return max(0.0, between - (len(rows) - 1) / len(x))


# --- in the terminal ------------------------------------------------------------------------------------------------


def listing(every: Sequence[Candidate]) -> str:
    """The candidates with equation, unit, prior and the signs by which they show."""
    entries = []
    for c in every:
        kind = f"effect at {c.effect.port.name}" if c.effect else "parameter of the vehicle file"
        lines = [f"{c.name}  ({kind})", f"    equation   {c.equation}"]
        for p in c.parameters:
            name = f"{p.name} [{p.unit}]"
            lines.append(f"    parameter  {name}, prior {p.prior:g} ± {p.prior_sd:g}, from {p.low:g} to {p.high:g}")
        shown_by = f"    shown by   {c.shown_by or 'its file does not say (SHOWN_BY)'}"
        entries.append("\n".join([*lines, *textwrap.wrap(shown_by, WIDTH, subsequent_indent=" " * 15)]))
    return "\n\n".join(entries)


def summary(found: Discovery, written: Sequence[str] = ()) -> str:
    """The result for the terminal. written: of the extended model."""
    report, known = found.report, _known(found)
    rides, distance, time, energy = _extent(found)
    named = {cause.name for cause in report.causes}.union(*report.ambiguous)
    best = (
        f"{row.name} {row.score:.1f}"
        + (" (rejected)" if row.score > report.threshold and row.name not in named else "")
        for row in report.ranking[:5]
    )
    largest = sorted(residual_sizes(before_and_after(found)[0]).items(), key=lambda row: -abs(row[1].energy_share))
    sizes = (
        f"{readable(name)} {r.mean:+.3g} ± {r.rms:.3g} {CHANNEL[name].unit} ({r.energy_share:+.1%} of the energy)"
        for name, r in largest[:3]
    )
    lines = [
        f"rides        {rides}, {distance} in {time}{f', {energy} drawn' if energy else ''}; against {known}",
        f"verdict      {report.verdict}: {VERDICTS[report.verdict]}",
        *_cause_lines(report),
        *(f"  {kind + ':':20} {text}" for kind, text in _findings(report)),
        f"scores       {', '.join(best)}; healthy rides stay below {report.threshold:.1f}",
        f"residuals    {'; '.join(sizes)}",
        *_gain_lines(report),
    ]
    shares = {name: limit.energy_share for name, limit in report.limits.items() if limit.energy_share}
    if shares:
        worst = ", ".join(f"{n} {shares[n]:.1%}" for n in sorted(shares, key=lambda n: -shares[n])[:3])
        lines.append(f"limits       the least that these rides show, of the energy: {worst}; others less")
    for head, texts in (("model", written), ("next", report.advice), ("note", report.notes)):
        lines += [f"{head:13}{text}" for text in texts]
    return "\n".join(
        part for line in lines for part in (textwrap.wrap(line, WIDTH, subsequent_indent=" " * 13) or [line])
    )


def _known(found: Discovery) -> str:
    mixed = found.search.mixed
    known = f"{mixed.healthy} healthy rides" if mixed.healthy else "the vehicle file alone"
    return f"{mixed.vehicle.name} as known from {known}"


def _extent(found: Discovery) -> tuple[str, str, str, str]:
    """(number of rides, distance, time, energy drawn if it is known), in words."""
    rides = [line.ride for line in found.search.lines]
    energy, distance = sum(ride.energy for ride in rides), sum(ride.distance for ride in rides)
    count, time = f"{len(rides)} ride{'s' if len(rides) > 1 else ''}", clock(sum(float(r.time[-1]) for r in rides))
    return count, f"{distance / 1e3:.1f} km", time, f"{energy / 3.6e6:.2f} kWh" if energy > 0 else ""


def _findings(report: Report) -> list[tuple[str, str]]:
    """(kind, sentence) on causes that vary, sets that cannot be told apart, and what no candidate explains."""
    found = []
    for cause in (cause for cause in report.causes if cause.varies):
        ratios = [split.ratio for split in report.constancy if split.cause == cause.name and split.of_ride]
        span = f" ({min(ratios):+.2f} to {max(ratios):+.2f} of its mean)" if ratios else ""
        found.append(("varies", f"{cause.name} differs from ride to ride{span}: no model is extended with it"))
    found += [("ambiguous", ", ".join(group)) for group in report.ambiguous]
    if u := report.unknown:
        found.append(("unexplained", f"{u}, {u.share:+.1%} of the energy, score {u.score:.0f}"))
        if u.denies:
            found.append(("rejected", f"{', '.join(u.denies)}, which would not act alike everywhere"))
    return found + [("implausible", str(row)) for row in report.implausible]


def cause_rows(report: Report) -> list[list[str]]:
    """Of each parameter of a cause: cause, parameter, value, 95 % interval; of the first change, energy and score."""
    rows = []
    for c in report.causes:
        for name, p in c.parameters.items():
            row = ["", name, with_unit(p.value, p.unit), f"{p.ci95[0]:.4g} to {p.ci95[1]:.4g}", "", "", ""]
            if name == c.parameter:
                row[0] = c.name
                row[4:] = with_unit(c.change, c.unit, "+.4g"), f"{c.energy_share:+.1%}", f"{c.evidence:.0f}"
            rows.append(row)
    return rows


def _cause_lines(report: Report) -> list[str]:
    lines = []
    for name, parameter, value, interval, change, share, score in cause_rows(report):
        changed = f"; change {change}" if change.removeprefix("+") not in ("", value) else ""
        more = f", {share} of the energy, score {score}" if name else ""
        lines.append(f"  {name:20} {parameter} = {value} (95 %: {interval}{changed}){more}")
    return lines


def _gain_rows(report: Report) -> list[tuple[str, str, list[float], str]]:
    """Of each metric (label, unit, errors before, control and after, interval of the gain)."""
    rows = []
    for metric, e in report.gain.errors.items():
        label, factor, unit = METRICS[metric]
        ci95 = "{:+.3g} to {:+.3g}".format(*(x * factor for x in e.ci95)) if e.ci95 else "one ride: no interval"
        rows.append((label, unit, [x * factor for x in (e.before, e.control, e.after)], ci95))
    return rows


def _gain_lines(report: Report) -> list[str]:
    rows = _gain_rows(report)
    if not rows:
        return [f"held out     {report.gain.note or 'nothing'}"]
    head = "errors on rides held out of the fit; refitted: with the parameters of the present model; gain over that"
    return [
        f"held out     {head}, 95 % over rides",
        *(
            f"  {label:18} {x[0]:6.3g} before, {x[1]:6.3g} refitted, {x[2]:6.3g} extended  {unit:6} (gain {ci95})"
            for label, unit, x, ci95 in rows
        ),
    ]


# --- the page -------------------------------------------------------------------------------------------------------


def write_report(found: Discovery, out: Path) -> None:
    """Write the report of `found` to the HTML file `out`. Raises OSError."""
    write_page(out, f"{found.search.mixed.vehicle.name}: {found.report.verdict}", [body(found)])


def body(found: Discovery) -> str:
    """The report as HTML, below its title."""
    report = found.report
    before, after = before_and_after(found)
    stages = {"before": before, "after": after} if report.causes else {"before": before}
    channels = [name for name in CHANNEL if any(name in line.tables for line in found.search.lines)]
    shown = _open_channels(found, channels)
    named = ", ".join(readable(cause.name) for cause in report.causes)
    parts = [
        _head(found),
        _causes(report),
        *(["<h2>What to ride next</h2>"] if report.advice else []),
        *(f"<p>{html.escape(line)}</p>" for line in report.advice),
        "<h2>Residuals by channel</h2>",
        _residuals(report, before, after),
        "<h2>What residuals correlate with</h2>",
        "<p>Share of each residual's variance that goes with a quantity, in percent: before"
        f"{f' and after {html.escape(named)}' if named else ''}; each ride's own biases and wind taken off.</p>",
        drawn(overview(stages, channels), "overview"),
    ]
    for name in [*shown, *(channel for channel in channels if channel not in shown)]:
        title = f"{readable(name)} [{CHANNEL[name].unit}]"
        is_open = " open" if name in shown else ""
        parts.append(
            f"<details{is_open}><summary>{title}</summary>{drawn(panels(stages, name), readable(name))}</details>"
        )
    parts.append(_gain(report))
    if report.unknown:
        parts += ["<h2>Unexplained residual</h2>", drawn(curve(report.unknown), "unknown")]
    return "\n".join([*parts, *_details(report)])


def _head(found: Discovery) -> str:
    report = found.report
    rides, distance, time, energy = _extent(found)
    number, word = rides.split(" ")
    cards = [("rides", number, word), ("distance", distance, f"in {time}")]
    if energy:
        cards.append(("energy", energy, "drawn"))
    if report.causes:
        share = sum(cause.energy_share for cause in report.causes)
        cards.append(("share", f"{share:+.1%}", "of the energy named"))
    elif report.unknown:
        cards.append(("share", f"{report.unknown.share:+.1%}", "of the energy, without a name"))
    if (error := report.gain.range) is not None:
        cards.append(("error", f"{error.before:.1%} → {error.after:.1%}", "error of the range, held out"))
    names = ", ".join(html.escape(line.ride.name) for line in found.search.lines)
    named = f": {', '.join(readable(cause.name) for cause in report.causes)}" if report.causes else ""
    about = f"{names}; against {html.escape(_known(found))}"
    return f'<p>{VERDICTS[report.verdict]}{named}.</p><p class="about">{about}.</p>{tiles(cards)}'


def _causes(report: Report) -> str:
    text = ""
    if rows := [[readable(name), *row] for name, *row in cause_rows(report)]:
        heads = ["cause", "parameter", "value", "95 % interval", "change", "of the energy", "score"]
        text += (
            "<h2>Causes</h2>"
            + html_table(heads, rows, range(2, len(heads)))
            + "<p>Score: chi-squared of one degree of "
            f"freedom that the rides lose without it; healthy rides stay below {report.threshold:.1f}.</p>"
        )
    lines = (f"<p><b>{kind.capitalize()}:</b> {html.escape(said)}.</p>" for kind, said in _findings(report))
    return text + "".join(lines)


def _residuals(report: Report, before: Sequence[LinearRide], after: Sequence[LinearRide]) -> str:
    raw, first, last = report.residuals, residual_sizes(before), residual_sizes(after)
    rows = []
    for name in (name for name in CHANNEL if name in raw):
        r, b, a = raw[name], first[name], last[name]
        energy = any(abs(x.energy_share) > 0 for x in (b, a))
        row = [readable(name), CHANNEL[name].unit, f"{r.mean:+.2g}", f"{r.rms:.2g}"]
        for x in (b, a):
            row += [f"{x.rms:.2g}", f"{x.autocorrelation:.2f}", f"{x.energy_share:+.1%}" if energy else "–"]
        rows.append(row)
    stage = ["auto­correlation", "of the energy"]
    heads = ["measured minus model", "unit", "mean", "rms", "before: rms", *stage, "after: rms", *stage]
    return html_table(heads, rows, range(2, len(heads))) + (
        "<p>Mean and rms as measured, with each ride's sensor biases and wind; before and after with these taken off, "
        "without and with the causes named. Autocorrelation of neighbouring blocks: near 0 only noise is left.</p>"
    )


def _open_channels(found: Discovery, channels: Sequence[str]) -> list[str]:
    """The channels whose pictures are open: those with most of a cause's signal, else the road's and the cells'."""
    report = found.report
    shares = [found.search.shares.get(cause.name) for cause in report.causes]
    wanted = [max(share, key=lambda name: share[name]) for share in shares if share]
    if not wanted:
        wanted = [*([report.unknown.channel] if report.unknown else []), "road_force", "cell_voltage"][:2]
    return [name for name in channels if name in wanted]


def _gain(report: Report) -> str:
    rows = [[f"{label} [{unit}]", *(f"{x:.3g}" for x in xs), ci] for label, unit, xs, ci in _gain_rows(report)]
    if not rows:
        return f"<h2>Errors on held-out rides</h2><p>{html.escape(report.gain.note or 'nothing was held out')}</p>"
    heads = ["error", "before", "control", "after", "gain over control, 95 % over rides"]
    held = ", ".join(map(html.escape, report.gain.holdout))
    text = "In no choice and no fit" if report.gain.apart else "Each in turn was held out of the fit"
    return (
        "<h2>Errors on held-out rides</h2>"
        + html_table(heads, rows, range(1, len(heads)))
        + (
            f"<p>{text}: {held}. Control: the parameters of the present model, refitted on the other rides. After: the "
            "causes as well.</p>"
        )
    )


def _details(report: Report) -> list[str]:
    """Constancy, detection limits, look-alikes and notes."""
    parts = []
    if report.constancy:
        rows = []
        for s in report.constancy:
            judged = "differs" if s.unequal else "alike" if abs(s.ratio) <= SEARCH.ratio else "cannot tell"
            rows.append([readable(s.cause), readable(s.quantity), f"{s.ratio:+.2f}", f"{s.chi2:.1f}", judged])
        parts.append(
            "<h2>Constancy of the causes</h2><p>Half the difference of left and right bends, of the upper and lower "
            "half of a quantity, or of a ride and the others, over the mean: 0 for the cause itself, ±1 for one that "
            "acts in one half only.</p>" + html_table(["cause", "over", "ratio", "chi-squared", "judged"], rows, (2, 3))
        )
    rows, scores = [], {row.name: row.score for row in report.ranking}
    for name, x in report.limits.items():
        share = f"{x.energy_share:.1%}" if x.energy_share is not None and x.energy_share > 1e-5 else "–"
        change = "not by these rides" if x.change is None else with_unit(x.change, x.unit, ".3g")
        rows.append([readable(name), f"{scores[name]:.1f}" if name in scores else "–", x.parameter, change, share])
    table = html_table(["cause", "score", "parameter", "least change", "of the energy"], rows, (1, 3, 4))
    parts.append(
        "<h2>Candidates</h2><p>Score in addition to the causes named, of which healthy rides stay below "
        f"{report.threshold:.1f}, and the least change that would be found half the time, were it alone.</p>{table}"
    )
    if look := report.isolability.look_alikes:
        rows = [[readable(a), readable(b), f"{c:+.2f}"] for a, b, c in look[:20]]
        parts.append(
            "<p>Causes that look alike to these rides: cosine of their effects on the residuals once biases and "
            "scatter are out. At ±1 no statistics can tell them apart.</p>"
            + html_table(["cause", "cause", "cosine"], rows, (2,))
        )
    if report.notes:
        notes = "".join(f"<li>{html.escape(note)}</li>" for note in report.notes)
        parts.append(f"<h2>Notes</h2><ul>{notes}</ul>")
    return parts


# --- pictures -------------------------------------------------------------------------------------------------------


def overview(stages: Stages, channels: Sequence[str]) -> Figure:
    """Channels by quantities: the share of variance that goes with each."""
    height = 1.5 + 0.3 * len(channels)
    figure = new_figure(12.5, height)
    for i, (title, lines) in enumerate(stages.items()):
        grid = np.array([[100 * share_over(*pooled(lines, c, name)) for name in COVARIATES] for c in channels])
        axis = figure.add_axes((0.12 + 0.43 * i, 0.02, 0.385, 1 - 1.35 / height))
        axis.imshow(grid, cmap="Oranges" if i == 0 else "Blues", vmin=0, vmax=60, aspect="auto")
        for (r, c), value in np.ndenumerate(grid):
            if value >= 1:
                colour = "white" if value > 40 else INK
                axis.text(c, r, f"{value:.0f}", ha="center", va="center", fontsize=7.5, color=colour)
        axis.set_xticks(range(len(COVARIATES)), map(readable, COVARIATES), rotation=38, ha="left", fontsize=8)
        axis.xaxis.tick_top()
        axis.set_yticks(range(len(channels)), map(readable, channels) if i == 0 else [], fontsize=8)
        axis.tick_params(length=0, colors=MUTED)
        for side in axis.spines.values():
            side.set_color(GRID)
        if len(stages) > 1:
            headline(figure, 0.13 + 0.44 * i, 1 - 0.12 / height, title, 10)
    return figure


def panels(stages: Stages, channel: str) -> Figure:
    """The residual's mean over each quantity, in bins of as many blocks, one standard error as a band."""
    data = {name: [pooled(lines, channel, name) for lines in stages.values()] for name in COVARIATES}
    data = {name: both for name, both in data.items() if len(x := both[0][0]) > 20 and np.ptp(x) > 0}
    columns = min(4, max(len(data), 1))
    rows = max(1, -(-len(data) // columns))
    height = 0.55 + 2.15 * rows
    figure = new_figure(12.5, height)
    top, bottom = 1 - 0.3 / height, 0.48 / height
    grid = figure.add_gridspec(rows, columns, left=0.075, right=0.985, wspace=0.13, hspace=0.42, top=top, bottom=bottom)
    axes: list[Any] = []
    for i, (name, both) in enumerate(data.items()):
        axis = figure.add_subplot(grid[i // columns, i % columns], sharey=axes[0] if axes else None)
        axes.append(axis)
        rule(axis)
        axis.locator_params(nbins=5)
        for sample, stage, colour in zip(both, stages, (ORANGE, BLUE), strict=False):
            x, y, error, _ = binned(*sample, edges(both[0][0])).T
            axis.fill_between(x, y - error, y + error, color=colour, alpha=0.2, linewidth=0)
            label = stage if len(stages) > 1 else "residual"
            axis.plot(x, y, "o-", color=colour, markersize=3, linewidth=1.3, label=label)
        axis.axhline(0, color=INK, linewidth=0.6)
        label, unit = COVARIATES[name]
        axis.set_xlabel(label if unit == "1" else f"{label} [{unit}]", fontsize=8, color=INK, labelpad=2)
        axis.tick_params(labelleft=i % columns == 0)
    if axes:
        legend(axes[min(columns, len(axes)) - 1])
        text = f"measured minus model [{CHANNEL[channel].unit}]"
        figure.text(0.012, 0.5, text, rotation=90, va="center", fontsize=8.5, color=INK)
    return figure


def curve(unknown: Unknown) -> Figure:
    """The curve of a difference without a name, with two standard deviations."""
    figure = new_figure(8, 3.4)
    axis = figure.add_axes((0.1, 0.16, 0.86, 0.78))
    rule(axis)
    x, y, sd = np.array(unknown.curve, dtype=float).T
    axis.fill_between(x, y - 2 * sd, y + 2 * sd, color=ORANGE, alpha=0.2, linewidth=0)
    axis.plot(x, y, "o-", color=ORANGE, linewidth=1.6, markersize=4)
    known = sd < 5 * float(np.median(sd)) + 1e-12  # a knot without data does not set the scale
    low, high = float(np.min((y - 2 * sd)[known])), float(np.max((y + 2 * sd)[known]))
    axis.set_ylim(min(low, 0.0) * 1.1, max(high, 0.0) * 1.1 + 1e-9)
    axis.axhline(0, color=INK, linewidth=0.6)
    axis.set_xlabel(f"{readable(unknown.quantity)} [{unknown.unit}]", fontsize=9, color=INK)
    axis.set_ylabel(f"{readable(unknown.channel)} [{CHANNEL[unknown.channel].unit}]", fontsize=9, color=INK)
    return figure
