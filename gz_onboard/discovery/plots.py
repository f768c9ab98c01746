"""The pictures of a discovery's report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.discovery.breakdown import COVARIATES, binned, edges, pooled, share_over
from gz_onboard.discovery.channels import CHANNEL
from gz_onboard.discovery.linear import LinearRide
from gz_onboard.discovery.result import RIDE_TO_RIDE, Report, Unknown
from gz_onboard.discovery.wording import readable
from gz_onboard.reports.style import BLUE, GRID, INK, MUTED, ORANGE, headline, legend, new_figure, rule

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = {"before": ORANGE, "after": BLUE}
Stages = Mapping[str, Sequence[LinearRide]]  # the rides "before" the causes and, if there are any, "after" them
CHOSEN, NEAR, OTHER = BLUE, "#8fb8de", "#cbd2d9"


def overview(stages: Stages, channels: Sequence[str]) -> Figure:
    """Channels by quantities: the share of variance that goes with each."""
    quantities = list(COVARIATES)
    grids = [
        np.array([[100 * share_over(*pooled(lines, c, name)) for name in quantities] for c in channels])
        for lines in stages.values()
    ]
    width, height = 12.5, 1.5 + 0.3 * len(channels)
    figure = new_figure(width, height)
    for i, (grid, title) in enumerate(zip(grids, stages, strict=True)):
        axis = figure.add_axes((0.12 + 0.43 * i, 0.02, 0.385, 1 - 1.35 / height))
        axis.imshow(grid, cmap="Oranges" if i == 0 else "Blues", vmin=0, vmax=60, aspect="auto")
        for r in range(len(channels)):
            for c in range(len(quantities)):
                value = grid[r, c]
                if value >= 1:
                    colour = "white" if value > 40 else INK
                    axis.text(c, r, f"{value:.0f}", ha="center", va="center", fontsize=7.5, color=colour)
        axis.set_xticks(
            range(len(quantities)), [readable(name) for name in quantities], rotation=38, ha="left", fontsize=8
        )
        axis.xaxis.tick_top()
        axis.set_yticks(range(len(channels)), [readable(name) for name in channels] if i == 0 else [], fontsize=8)
        axis.tick_params(length=0, colors=MUTED)
        for side in axis.spines.values():
            side.set_color(GRID)
        if len(stages) > 1:
            headline(figure, 0.13 + 0.44 * i, 1 - 0.12 / height, title, 10)
    return figure


def panels(stages: Stages, channel: str) -> Figure:
    """The residual's mean over each quantity, in bins of as many blocks, one standard error as a band."""
    drawn = []
    for name in COVARIATES:
        samples = [pooled(lines, channel, name) for lines in stages.values()]
        x = samples[0][0]
        if len(x) > 20 and np.ptp(x) > 0:
            drawn.append((name, [binned(*sample, edges(x)) for sample in samples]))
    columns = min(4, max(len(drawn), 1))
    rows = max(1, -(-len(drawn) // columns))
    height = 0.55 + 2.15 * rows
    figure = new_figure(12.5, height)
    if not drawn:
        return figure
    grid = figure.add_gridspec(
        rows, columns, left=0.075, right=0.985, wspace=0.13, hspace=0.42, top=1 - 0.3 / height, bottom=0.48 / height
    )
    axes: list[Any] = []
    for i, (name, curves) in enumerate(drawn):
        axis = figure.add_subplot(grid[i // columns, i % columns], sharey=axes[0] if axes else None)
        axes.append(axis)
        rule(axis)
        axis.locator_params(nbins=5)
        for (x, y, error, _), stage in zip((rows_.T for rows_ in curves), stages, strict=True):
            colour, label = COLOURS[stage], stage if len(stages) > 1 else "residual"
            axis.fill_between(x, y - error, y + error, color=colour, alpha=0.2, linewidth=0)
            axis.plot(x, y, "o-", color=colour, markersize=3, linewidth=1.3, label=label)
        axis.axhline(0, color=INK, linewidth=0.6)
        label, unit = COVARIATES[name]
        axis.set_xlabel(label if unit == "1" else f"{label} [{unit}]", fontsize=8, color=INK, labelpad=2)
        if i % columns:
            axis.tick_params(labelleft=False)
    legend(axes[min(columns, len(axes)) - 1])
    figure.text(
        0.012, 0.5, f"measured less model [{CHANNEL[channel].unit}]", rotation=90, va="center", fontsize=8.5, color=INK
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
    colours = [CHOSEN if row.name in chosen else NEAR if row.name in near else OTHER for row in rows]
    axis.barh([readable(row.name) for row in rows], [max(row.score, 0.0) for row in rows], color=colours, height=0.7)
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
    axis.set_xlim(0, max(2 * report.threshold, 1.3 * max((row.score for row in rows), default=1)))
    axis.set_xlabel("score beside the causes named (blue), linear up to 10", fontsize=8.5, color=INK)
    axis.tick_params(axis="y", colors=INK)
    axis.margins(y=0.01)
    return figure


def curve(unknown: Unknown) -> Figure:
    """The curve of what has no name, with two standard deviations."""
    figure = new_figure(8, 3.4)
    axis = figure.add_axes((0.1, 0.16, 0.86, 0.78))
    rule(axis)
    x, y, sd = np.array(unknown.curve, dtype=float).T
    axis.fill_between(x, y - 2 * sd, y + 2 * sd, color=ORANGE, alpha=0.2, linewidth=0)
    axis.plot(x, y, "o-", color=ORANGE, linewidth=1.6, markersize=4)
    axis.set_ylim(*_limits_of(y, sd))
    axis.axhline(0, color=INK, linewidth=0.6)
    axis.set_xlabel(f"{readable(unknown.quantity)} [{unknown.unit}]", fontsize=9, color=INK)
    left = f"{readable(unknown.channel)} [{CHANNEL[unknown.channel].unit}]"
    if unknown.quantity == RIDE_TO_RIDE:
        left = f"{readable(unknown.denies[0])}, over its mean [1]"
    axis.set_ylabel(left, fontsize=9, color=INK)
    return figure


def _limits_of(y: Array, sd: Array) -> tuple[float, float]:
    """Of the ordinate: the curve where it is known; a knot without data does not set the scale."""
    known = sd < 5 * float(np.median(sd)) + 1e-12
    low, high = float(np.min((y - 2 * sd)[known])), float(np.max((y + 2 * sd)[known]))
    return min(low, 0.0) * 1.1, max(high, 0.0) * 1.1 + 1e-9
