"""How the project's pictures look, drawn without a screen."""

from __future__ import annotations

from collections.abc import Sequence
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


def stack(
    figure: Figure, heights: Sequence[float], *, left: float, hspace: float, top: float, bottom: float
) -> list[Axes]:
    """Panels one above the other, of one abscissa; `top` and `bottom` are margins [inch]."""
    height = figure.get_figheight()
    grid = figure.add_gridspec(
        len(heights),
        1,
        height_ratios=heights,
        left=left,
        right=0.93,
        hspace=hspace,
        top=1 - top / height,
        bottom=bottom / height,
    )
    axes: list[Axes] = []
    for i in range(len(heights)):
        axes.append(figure.add_subplot(grid[i], sharex=axes[0] if axes else None))
        rule(axes[-1])
    return axes


def rule(axis: Axes) -> None:
    """Grid, ticks and frame of a panel."""
    axis.grid(True, color=GRID, linewidth=0.8)
    axis.set_axisbelow(True)
    axis.tick_params(colors=MUTED, labelsize=8, length=0)
    for side in _SIDES:
        axis.spines[side].set_color(GRID)


def second(axis: Axes, text: str, colour: str) -> Axes:
    """Another ordinate, on the right, drawn behind `axis`."""
    other = axis.twinx()
    other.tick_params(colors=MUTED, labelsize=8, length=0)
    for side in _SIDES:
        other.spines[side].set_visible(False)
    ordinate(other, text, colour)
    axis.set_zorder(other.get_zorder() + 1)
    axis.patch.set_visible(False)
    return other


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


def close(axes: Sequence[Axes], x: Sequence[float] | Array, text: str) -> None:
    """The abscissa `x` of a stack: named and numbered below the last panel only, from end to end."""
    for axis in axes[:-1]:
        axis.tick_params(labelbottom=False)
    axes[-1].set_xlabel(text, color=INK, fontsize=9, loc="left")
    axes[0].set_xlim(float(x[0]), max(float(x[-1]), float(x[0]) + 1e-3))


def time_unit(duration: float) -> tuple[float, str]:
    """The unit of an abscissa over a ride of `duration` [s]: its length [s] and name."""
    return (60.0, "min") if duration >= _LONG else (1.0, "s")


def headline(figure: Figure, x: float, y: float, text: str, size: float = 13) -> None:
    """The title, left, at a place in shares of the figure."""
    figure.text(x, y, writable(text), fontsize=size, fontweight="bold", color=INK, va="center")
