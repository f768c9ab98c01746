"""How the project's pictures look, drawn without a screen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from gz_onboard.arrays import Array
from gz_onboard.errors import InputError, writable
from gz_onboard.options import PICTURE_FORMATS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, MUTED, GRID = "#1f2933", "#7b8794", "#e4e7eb"
BLUE, ORANGE, GREEN, RED, PURPLE = "#1667b7", "#d9730d", "#2f855a", "#c53030", "#6b46c1"
_LONG = 300.0  # s: from here on an abscissa is in minutes
_SIDES = ("top", "right", "left", "bottom")


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of width and height [inch]."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), facecolor="white")
    FigureCanvasAgg(figure)
    return figure


_METADATA: dict[str, dict[str, Any]] = {
    "png": {"Software": "gz-onboard"},
    "svg": {"Creator": "gz-onboard", "Date": None},
    "pdf": {"Creator": "gz-onboard", "CreationDate": None},
}
_TEXT_AS_TEXT: Any = {
    "path.simplify_threshold": 0.5,
    "svg.fonttype": "none",
    "svg.hashsalt": "gz-onboard",
    "pdf.fonttype": 42,
    "font.family": "sans-serif",
}


def save(figure: Figure, file: Path, dpi: float = 110) -> None:
    """Write a picture of the format that the name of `file` ends in. Raises OSError."""
    write(figure, file, picture_format(file), dpi)


def write(figure: Figure, to: Path | IO[bytes], kind: str, dpi: float = 110) -> None:
    """Write a picture, one of `PICTURE_FORMATS`: the same bytes for the same figure. Raises OSError."""
    import matplotlib as mpl

    with mpl.rc_context(_TEXT_AS_TEXT if kind != "png" else {}):
        figure.savefig(to, format=kind, dpi=dpi, metadata=_METADATA[kind])


def picture_format(file: Path) -> str:
    """The format that the name of a picture ends in; InputError if it is none."""
    kind = file.suffix.lower().removeprefix(".")
    if kind not in PICTURE_FORMATS:
        known = ", ".join(f".{known}" for known in PICTURE_FORMATS)
        raise InputError(f"{file}: the picture's name has to end in one of {known}")
    return kind


def rule(axis: Axes) -> None:
    """Grid, ticks and frame of a panel."""
    axis.grid(True, color=GRID, linewidth=0.8)
    axis.set_axisbelow(True)
    axis.tick_params(colors=MUTED, labelsize=8, length=0)
    for side in _SIDES:
        axis.spines[side].set_color(GRID)


def ordinate(axis: Axes, text: str, colour: str = INK) -> None:
    """Name the ordinate."""
    axis.set_ylabel(text, color=colour, fontsize=8.5)


def legend(axis: Axes, *others: Axes) -> None:
    """A legend of all the axes, above the panel, where it hides nothing."""
    handles, labels = axis.get_legend_handles_labels()
    for other in others:
        more, names = other.get_legend_handles_labels()
        handles, labels = handles + more, labels + names
    axis.legend(
        handles=handles,
        labels=labels,
        loc="lower right",
        bbox_to_anchor=(1, 1),
        borderaxespad=0.15,
        fontsize=7.5,
        ncols=len(labels),
        frameon=False,
        borderpad=0,
        handlelength=1.6,
        columnspacing=1.2,
        labelcolor=MUTED,
    )


def headline(figure: Figure, x: float, y: float, text: str, size: float = 13) -> None:
    """The title, left, at a place in shares of the figure."""
    figure.text(x, y, writable(text), fontsize=size, fontweight="bold", color=INK, va="center")


# --- charts over a common abscissa --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Line:
    """A line of a panel. y: values over the chart's abscissa, or over `x`; band: lower and upper edge about it."""

    y: Array
    colour: str
    label: str
    width: float = 1.1
    style: str = "-"
    band: tuple[Array, Array] | None = None
    band_label: str = "± σ"
    x: Array | None = None
    right: bool = False  # belongs to the ordinate on the right


@dataclass(frozen=True)
class ChartPanel:
    """One ordinate of a chart, or two. name, right: with unit; zero: whether a line is drawn there."""

    name: str
    lines: Sequence[Line] = ()
    height: float = 1.0  # relative to other panels
    colour: str = INK
    right: str | None = None
    right_colour: str = MUTED
    zero: bool = False
    limits: tuple[float, float] | None = None

    def draw(self, axis: Axes, x: Array) -> None:
        """Draw the lines over `x`, with a legend."""
        others = [_right_ordinate(axis, self.right, self.right_colour)] if self.right else []
        for line in self.lines:
            on, over = others[0] if line.right else axis, x if line.x is None else line.x
            if line.band:
                on.fill_between(over, *line.band, color=line.colour, alpha=0.2, linewidth=0, label=line.band_label)
            on.plot(over, line.y, line.style, markersize=4, color=line.colour, linewidth=line.width, label=line.label)
        for each in (axis, *others) if self.zero else ():
            each.axhline(0, color=MUTED, linewidth=0.6, zorder=1)
        if self.limits:
            axis.set_ylim(*self.limits)
        ordinate(axis, self.name, self.colour)
        if self.lines:
            legend(axis, *others)


def _right_ordinate(axis: Axes, name: str, colour: str) -> Axes:
    """Another ordinate, drawn behind `axis`."""
    other = axis.twinx()
    other.tick_params(colors=MUTED, labelsize=8, length=0)
    for side in _SIDES:
        other.spines[side].set_visible(False)
    ordinate(other, name, colour)
    axis.set_zorder(other.get_zorder() + 1)
    axis.patch.set_visible(False)
    return other


def chart(
    rows: Sequence[Sequence[ChartPanel]], x: Array, x_name: str, title: str = "", about: str = "", left: float = 0.08
) -> Figure:
    """Panels one above the other, in one column or more, over the common abscissa `x` of shape (n,).

    about: a line below the title. left: margin, as a share of the width.
    """
    columns, heights = len(rows[0]), [row[0].height for row in rows]
    top = (0.95 if about else 0.8) if title else 0.35
    height = top + 0.65 + 1.15 * sum(heights)
    figure = new_figure(12 if columns == 1 else 15, height)
    grid = figure.add_gridspec(
        len(rows),
        columns,
        height_ratios=heights,
        left=left,
        right=0.93 if columns == 1 else 0.99,
        hspace=0.3,
        wspace=0.11,
        top=1 - top / height,
        bottom=0.5 / height,
    )
    axes: list[Axes] = []
    for i in range(len(rows) * columns):
        axes.append(figure.add_subplot(grid[i // columns, i % columns], sharex=axes[0] if axes else None))
        rule(axes[-1])
        if i < (len(rows) - 1) * columns:
            axes[-1].tick_params(labelbottom=False)
        else:
            axes[-1].set_xlabel(x_name, color=INK, fontsize=9, loc="left")
    for axis, panel in zip(axes, (panel for row in rows for panel in row), strict=True):
        panel.draw(axis, x)
    axes[0].set_xlim(float(x[0]), max(float(x[-1]), float(x[0]) + 1e-3))
    if title:
        headline(figure, left, 1 - 0.32 / height, title)
        figure.text(left, 1 - 0.60 / height, writable(about), fontsize=9.5, color=MUTED, va="center")
    return figure


def time_unit(duration: float) -> tuple[float, str]:
    """The unit of an abscissa over a ride of `duration` [s]: its length [s], and the name of the abscissa."""
    return (60.0, "time [min]") if duration >= _LONG else (1.0, "time [s]")
