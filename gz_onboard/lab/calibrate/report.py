"""The report of a calibration: one HTML page that needs nothing else, and the same as JSON."""

from __future__ import annotations

import html
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.lab.calibrate import thesis
from gz_onboard.lab.calibrate.fit import correlation
from gz_onboard.lab.calibrate.result import Curve, Fit, Panel, Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes

VERSION = 1
_INK, _MUTED, _GRID = "#1f2933", "#52606d", "#d9e2ec"
_COLOURS = ("#1f6feb", "#d1495b", "#2a9d8f", "#e9a03b", "#7b5ea7", "#52606d", "#8c564b", "#17a2b8")
_MOST_POINTS = 4000  # of a trace: more than a picture shows


def document(results: Sequence[Result], vehicle: str, out: str | None) -> dict[str, Any]:
    """What ``--json`` writes: {"version", "vehicle", "out", "procedures": [...], "thesis": [...]}; nan as null."""
    return {
        "version": VERSION,
        "vehicle": vehicle,
        "out": out,
        "procedures": [_procedure(result) for result in results],
        "thesis": [dict(zip(thesis.HEAD, row, strict=True)) for row in thesis.compare(results)],
    }


def _procedure(result: Result) -> dict[str, Any]:
    return {
        "procedure": result.procedure,
        "parameters": {
            name: {"value": f.value, "sd": _finite(f.sd), "unit": f.unit, "source": f.source}
            for name, f in result.parameters.items()
        },
        "curves": {
            name: {
                "axes": {axis: values.tolist() for axis, values in c.axes.items()},
                "value": c.value.tolist(),
                "sd": _nulls(c.sd),
                "unit": c.unit,
                "source": c.source,
            }
            for name, c in result.curves.items()
        },
        "correlation": [
            {"parameters": list(names), "value": correlation(np.asarray(covariance)).tolist()}
            for names, covariance in result.covariance
        ],
        "fits": [
            {
                "what": f.what,
                "unit": f.unit,
                "rms": f.rms,
                "largest": f.largest,
                "r2": f.r2,
                "points": f.points,
                "held_out": f.held_out,
                "data": f.data,
            }
            for f in result.fits
        ],
        "refusals": result.refusals,
        "notes": result.notes,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _nulls(values: Array) -> Any:
    return [_nulls(row) for row in values] if values.ndim > 1 else [_finite(float(v)) for v in values]


# --- text ---------------------------------------------------------------------------------------------------------


def told(value: float, sd: float) -> str:
    """``value ± sd`` with as many digits as the sd allows."""
    if not math.isfinite(sd) or sd <= 0:
        return f"{value:.4g}"
    digits = max(0, 1 - math.floor(math.log10(sd)))
    if digits > 6 or abs(value) >= 1e5:
        return f"{value:.4g} ± {sd:.2g}"
    return f"{value:.{digits}f} ± {sd:.{digits}f}"


def text(result: Result) -> str:
    """A result in a terminal."""
    lines = [result.procedure]
    lines += [f"  {name} = {told(f.value, f.sd)} {f.unit}" for name, f in result.parameters.items()]
    lines += [f"  {name}: {shape(c)}" for name, c in result.curves.items()]
    for f in result.fits:
        held = ", held out" if f.held_out else ""
        r2 = f"R² {f.r2:.4f}, " if f.r2 is not None else ""
        lines.append(f"  fit of {f.what}: {r2}{f.rms:.3g} {f.unit} rms, {f.largest:.3g} at most ({f.data}{held})")
    lines += [f"  not told: {refusal}" for refusal in result.refusals]
    lines += [f"  note: {note}" for note in result.notes]
    return "\n".join(lines)


def shape(curve: Curve) -> str:
    """What a table is over and where it lies."""
    over = " and ".join(f"{len(values)} of {axis}" for axis, values in curve.axes.items())
    return f"{curve.value.min():.4g} to {curve.value.max():.4g} {curve.unit} over {over}"


# --- page ---------------------------------------------------------------------------------------------------------


def write_report(file: Path, title: str, results: Sequence[Result]) -> None:
    """Write the page: of each procedure its values, fits, refusals and a picture. Raises OSError."""
    body = "\n".join(_section(result) for result in results)
    if rows := thesis.compare(results):
        body += f"<h2>The thesis and ours</h2>{_table(thesis.HEAD, rows, [1, 2, 3])}"
    contents = ", ".join(f'<a href="#{_escaped(r.procedure)}">{_escaped(r.procedure)}</a>' for r in results)
    file.write_text(
        f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{_escaped(title)}</title><style>
body {{ font-family: system-ui, sans-serif; color: {_INK}; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; }}
table {{ border-collapse: collapse; margin: 1rem 0; font-size: 0.9rem; }}
th, td {{ text-align: left; padding: 0.25rem 0.7rem; border-bottom: 1px solid {_GRID}; vertical-align: top; }}
td.n {{ white-space: nowrap; font-variant-numeric: tabular-nums; }}
.no {{ background: #fdf1e3; padding: 0.5rem 1rem; border-left: 4px solid #e9a03b; }}
figure {{ margin: 1.5rem 0; }} svg {{ width: 100%; height: auto; }}
</style></head><body><h1>{_escaped(title)}</h1><p>{contents}</p>
{body}
</body></html>
""",
        encoding="utf-8",
    )


def _escaped(value: str) -> str:
    return html.escape(value)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int]) -> str:
    def cell(i: int, value: str) -> str:
        return f"<td{' class=n' if i in numbers else ''}>{_escaped(value)}</td>"

    header = "".join(f"<th>{_escaped(name)}</th>" for name in head)
    lines = "\n".join(f"<tr>{''.join(cell(i, v) for i, v in enumerate(row))}</tr>" for row in rows)
    return f"<table><tr>{header}</tr>\n{lines}</table>"


def _section(result: Result) -> str:
    parts = [f'<h2 id="{_escaped(result.procedure)}">{_escaped(result.procedure)}</h2>']
    if result.parameters:
        rows = [[name, told(f.value, f.sd), f.unit, f.source] for name, f in result.parameters.items()]
        parts.append(_table(["parameter", "value ± sd", "unit", "source"], rows, [0, 1, 2]))
    if result.curves:
        rows = [[name, shape(c), c.source] for name, c in result.curves.items()]
        parts.append(_table(["table", "values", "source"], rows, [0]))
    if result.fits:
        parts.append(
            _table(
                ["fit", "data", "points", "R²", "rms", "largest", "unit"],
                [fit_row(f) for f in result.fits],
                [2, 3, 4, 5],
            )
        )
    for names, covariance in result.covariance:
        matrix = correlation(np.asarray(covariance))
        rows = [[a, *(f"{matrix[i, j]:+.2f}" for j in range(i + 1))] for i, a in enumerate(names)]
        if len(names) <= 12:
            parts.append(_table(["correlation", *names], rows, range(1, len(names) + 1)))
    parts += [f'<p class="no">Not told by these data: {_escaped(refusal)}</p>' for refusal in result.refusals]
    parts += [f"<p>{_escaped(note)}</p>" for note in result.notes]
    if result.panels:
        parts.append(f"<figure>{picture(result.panels)}</figure>")
    return "\n".join(parts)


def fit_row(fit: Fit) -> list[str]:
    """A row of the table of fits."""
    return [
        fit.what,
        fit.data + (" (held out)" if fit.held_out else " (fitted)"),
        str(fit.points),
        "" if fit.r2 is None else f"{fit.r2:.4f}",
        f"{fit.rms:.3g}",
        f"{fit.largest:.3g}",
        fit.unit,
    ]


def picture(panels: Sequence[Panel]) -> str:
    """The panels of a procedure as one SVG, two beside each other; points as pixels, so that it stays small."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = math.ceil(len(panels) / 2)
    columns = min(len(panels), 2)
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "gz-onboard", "font.family": "sans-serif"}):
        figure = Figure(figsize=(6.2 * columns, 3.6 * rows), facecolor="white", dpi=110, layout="constrained")
        FigureCanvasAgg(figure)
        for i, panel in enumerate(panels):
            _draw(figure.add_subplot(rows, columns, i + 1), panel)
        stream = io.StringIO()
        figure.savefig(stream, format="svg", metadata={"Date": None})
    return "<svg" + stream.getvalue().partition("<svg")[2]


def _draw(axis: Axes, panel: Panel) -> None:
    axis.set_title(panel.title, fontsize=10, color=_INK, loc="left")
    axis.set_xlabel(panel.x_label, fontsize=9, color=_MUTED)
    axis.set_ylabel(panel.y_label, fontsize=9, color=_MUTED)
    axis.grid(True, color=_GRID, linewidth=0.8)
    axis.set_axisbelow(True)
    axis.tick_params(colors=_MUTED, labelsize=8, length=0)
    for side in axis.spines.values():
        side.set_color(_GRID)
    labels = 0
    for i, trace in enumerate(panel.traces):
        x, y = thinned(trace.x), thinned(trace.y)
        points = trace.style in (".", ",", "o", "x", "+")
        axis.plot(
            x,
            y,
            trace.style,
            color=_COLOURS[i % len(_COLOURS)],
            label=trace.label or None,
            markersize=3 if points else 5,
            linewidth=1.3,
            rasterized=points and len(x) > 200,
        )
        labels += bool(trace.label)
    if labels:
        axis.legend(fontsize=7.5, frameon=False, ncols=2 if labels > 5 else 1)


def thinned(values: Array) -> Array:
    """`values`, every n-th of them where there are more than a picture shows."""
    return values[:: max(1, len(values) // _MOST_POINTS)]
