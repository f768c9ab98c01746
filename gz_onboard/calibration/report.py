"""The report of a calibration: one self-contained HTML page, and the same as JSON."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.calibration.fit import correlation
from gz_onboard.calibration.result import Curve, Fit, Panel, Result
from gz_onboard.reports.page import html_table, write_page
from gz_onboard.reports.style import MUTED, new_figure, rule, write

if TYPE_CHECKING:
    from matplotlib.axes import Axes

VERSION = 1
_COLOURS = ("#1f6feb", "#d1495b", "#2a9d8f", "#e9a03b", "#7b5ea7", "#52606d", "#8c564b", "#17a2b8")
_MOST_POINTS = 4000  # of a trace: more than a picture shows
_MOST_OPEN = 8  # panels of a procedure: more are behind a click
_MOST_TIED = 12  # parameters: a table of more correlations is not read


KEYS = {
    "vehicle": "vehicle file that the calibration started from",
    "out": "vehicle file written, or null",
    "thesis": "results of the thesis and of this calibration",
    "procedures": "one for each procedure:",
    "  procedure": "its name",
    "  parameters": "by name: value, sd, unit, source",
    "  curves": "tables of the vehicle file by name: axes, value, sd, unit, source",
    "  correlation": "of parameters found together: parameters, value (a matrix)",
    "  fits": "what, unit, rms, largest, r2, points, held_out, data",
    "  refusals": "what the data do not show, and why",
    "  notes": "what else was noticed",
}
"""What ``--json`` writes, see `document`."""


def document(results: Sequence[Result], vehicle: str, out: str | None) -> dict[str, object]:
    """The results as ``--json`` writes them, without pictures."""
    procedures = [
        {
            "procedure": result.procedure,
            "parameters": result.parameters,
            "curves": result.curves,
            "correlation": [{"parameters": names, "value": value} for names, value in _correlations(result)],
            "fits": result.fits,
            "refusals": result.refusals,
            "notes": result.notes,
        }
        for result in results
    ]
    thesis = [dict(zip(THESIS_HEAD, row, strict=True)) for row in compare_thesis(results)]
    return {"vehicle": vehicle, "out": out, "procedures": procedures, "thesis": thesis}


def _correlations(result: Result) -> list[tuple[tuple[str, ...], Array]]:
    return [(names, correlation(np.asarray(matrix))) for names, matrix in result.covariance]


# --- the thesis' own results --------------------------------------------------------------------------------------
# Ours are of data held out of the fit, except where the thesis gives the fit itself. Its R² of the inverter and motor
# maps are of efficiency, ours of watts; its meshes are surfaces through values found pulse by pulse.


class ThesisResult(NamedTuple):
    """One of the thesis' results, and which of our fits answers it.

    fits: (procedure, beginning of `Fit.what`, part of `Fit.data`, held out). limit: the greatest error in `unit`; the
    least R² where there is no unit.
    """

    what: str
    fits: tuple[str, str, str, bool]
    limit: float
    unit: str = ""


THESIS = (
    ThesisResult("back-EMF constant", ("motor", "back-EMF", "", True), 0.9993),
    ThesisResult("torque constant", ("motor", "shaft torque", "all currents", True), 0.9804),
    ThesisResult("inverter map", ("losses", "inverter loss", "all currents", True), 0.9949),
    ThesisResult("motor map", ("losses", "motor loss", "all currents", True), 0.8774),
    ThesisResult("R0 over (SOC, T)", ("pulse", "mesh of R0, SOC 0.2 to 0.9, half against half", "", True), 0.9976),
    ThesisResult("R1 over (SOC, T)", ("pulse", "mesh of R1, SOC 0.2 to 0.9, half against half", "", True), 0.9210),
    ThesisResult("C1 over (SOC, T)", ("pulse", "mesh of C1, SOC 0.2 to 0.9, half against half", "", True), 0.9600),
    ThesisResult("cell voltage, road profile, 25 °C", ("pulse", "cell voltage", "25C", True), 0.02, "V"),
    ThesisResult("cell voltage, road profile, 5 °C", ("pulse", "cell voltage", "_5C", True), 0.02, "V"),
    ThesisResult("motor temperature, calibration", ("cooling", "motor temperature, bench", "", False), 4, "°C"),
    ThesisResult("motor temperature, validation", ("cooling", "motor temperature, bench", "valid", True), 10, "°C"),
    ThesisResult("motor temperature, riding", ("cooling", "motor temperature, riding", "", True), 10, "°C"),
    ThesisResult("inverter temperature, calibration", ("cooling", "inverter temperature, bench", "", False), 1, "°C"),
    ThesisResult("inverter temperature, validation", ("cooling", "inverter temperature", "valid", True), 6, "°C"),
    ThesisResult("inverter temperature, riding", ("cooling", "inverter temperature, riding", "", True), 6, "°C"),
    ThesisResult("cell temperature", ("cooling", "cell temperature", "", True), 1, "°C"),
    ThesisResult("BMS temperature", ("cooling", "bms temperature", "", True), 4, "°C"),
    ThesisResult("coast-down speed, wind unknown", ("coastdown", "speed, no wind", "", True), 2, "m/s"),
)

THESIS_HEAD = ("what", "thesis", "ours", "rms", "on", "better")


def compare_thesis(results: Sequence[Result]) -> list[tuple[str, ...]]:
    """Rows of `THESIS_HEAD` for the calibrated procedures; the worst of several fits that answer one row."""
    rows = []
    for one in THESIS:
        procedure, what, data, held_out = one.fits
        every = [fit for result in results if result.procedure == procedure for fit in result.fits]
        fits = [f for f in every if f.what.startswith(what) and data in f.data and f.held_out == held_out]
        if fits:
            rows.append(_thesis_row(one, fits))
    return rows


def _thesis_row(one: ThesisResult, fits: Sequence[Fit]) -> tuple[str, ...]:
    on = "; ".join(dict.fromkeys(fit.data for fit in fits)) + ("" if one.fits[3] else " (fitted)")
    if not one.unit:
        r2 = min(fit.r2 or 0.0 for fit in fits)
        return one.what, f"R² {one.limit:.4f}", f"R² {r2:.4f}", "", on, "yes" if r2 >= one.limit else "no"
    largest, rms = max(fit.largest for fit in fits), max(fit.rms for fit in fits)
    better = "yes" if largest <= one.limit else "no"
    return one.what, f"±{one.limit:g} {one.unit}", f"±{largest:.2g} {one.unit}", f"{rms:.2g} {one.unit}", on, better


# --- text ---------------------------------------------------------------------------------------------------------


def plus_minus(value: float, sd: float) -> str:
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
    lines += [f"  {name} = {plus_minus(f.value, f.sd)} {f.unit}" for name, f in result.parameters.items()]
    lines += [f"  {name}: {shape(c)}" for name, c in result.curves.items()]
    for f in result.fits:
        held = ", held out" if f.held_out else ""
        r2 = f"R² {f.r2:.4f}, " if f.r2 is not None else ""
        lines.append(f"  fit of {f.what}: {r2}{f.rms:.3g} {f.unit} rms, {f.largest:.3g} at most ({f.data}{held})")
    lines += [f"  not identified: {refusal}" for refusal in result.refusals]
    lines += [f"  note: {note}" for note in result.notes]
    return "\n".join(lines)


def shape(curve: Curve) -> str:
    """The axes and range of a table."""
    over = " and ".join(f"{len(values)} of {axis}" for axis, values in curve.axes.items())
    return f"{curve.value.min():.4g} to {curve.value.max():.4g} {curve.unit} over {over}"


# --- page ---------------------------------------------------------------------------------------------------------


def write_report(file: Path, title: str, results: Sequence[Result], trouble: Exception | None = None) -> None:
    """Write the page: of each procedure its values, fits, refusals and a picture. Raises OSError.

    trouble: why there is no more, or no vehicle file.
    """
    names = [html.escape(result.procedure) for result in results]
    body = ["<nav>" + "".join(f'<a href="#{name}">{name}</a>' for name in names) + "</nav>"]
    body += [f'<p class="no">Not finished: {html.escape(str(trouble))}</p>'] if trouble else []
    body += [_section(result) for result in results]
    if rows := compare_thesis(results):
        body.append(f"<h2>Comparison with the thesis</h2>{html_table(THESIS_HEAD, rows, [1, 2, 3])}")
    write_page(file, title, body)


def _section(result: Result) -> str:
    parts = [f'<h2 id="{html.escape(result.procedure)}">{html.escape(result.procedure)}</h2>']
    parameters = [[name, plus_minus(f.value, f.sd), f.unit, f.source] for name, f in result.parameters.items()]
    curves = [[name, shape(c), c.source] for name, c in result.curves.items()]
    fits = []
    for f in result.fits:
        data, r2 = f"{f.data} ({'held out' if f.held_out else 'fitted'})", "" if f.r2 is None else f"{f.r2:.4f}"
        fits.append([f.what, data, str(f.points), r2, f"{f.rms:.3g}", f"{f.largest:.3g}", f.unit])
    tables = [
        (["parameter", "value ± sd", "unit", "source"], parameters, range(1, 2)),
        (["table", "values", "source"], curves, range(1)),
        (["fit", "data", "points", "R²", "rms", "largest", "unit"], fits, range(2, 6)),
    ]
    for names, matrix in _correlations(result):
        rows = [[a, *(f"{matrix[i, j]:+.2f}" for j in range(i + 1))] for i, a in enumerate(names)]
        tables.append((["correlation", *names], rows if len(names) <= _MOST_TIED else [], range(1, len(names) + 1)))
    parts += [html_table(heads, rows, numbers) for heads, rows, numbers in tables if rows]
    parts += [f'<p class="no">Not identified by these data: {html.escape(refusal)}</p>' for refusal in result.refusals]
    parts += [f"<p>{html.escape(note)}</p>" for note in result.notes]
    if result.panels:
        pictures, shown = "".join(map(picture, result.panels)), " open" if len(result.panels) <= _MOST_OPEN else ""
        summary = f"<summary>Pictures ({len(result.panels)})</summary>"
        parts.append(f'<details{shown}>{summary}<div class="panels">{pictures}</div></details>')
    return "\n".join(parts)


def picture(panel: Panel) -> str:
    """Draw a panel as an HTML figure, in few colours: as SVG, tens of panels of thousands of marks make megabytes."""
    from PIL import Image

    figure = new_figure(6.2, 3.4)
    figure.set_layout_engine("constrained")
    _draw(figure.add_subplot(), panel)
    png, webp = io.BytesIO(), io.BytesIO()
    write(figure, png, "png", dpi=72)
    few = Image.open(png).convert("RGB").quantize(20, dither=Image.Dither.NONE)
    few.save(webp, "webp", lossless=True, quality=100, method=6)
    title, data = html.escape(panel.title), base64.b64encode(webp.getvalue()).decode("ascii")
    shown = f'<img class="drawn" alt="{title}" src="data:image/webp;base64,{data}">'
    return f"<figure><figcaption><b>{title}</b></figcaption>{shown}</figure>"


def _draw(axis: Axes, panel: Panel) -> None:
    axis.set_xlabel(panel.x_label, fontsize=9, color=MUTED)
    axis.set_ylabel(panel.y_label, fontsize=9, color=MUTED)
    rule(axis)
    labels = 0
    for i, trace in enumerate(panel.traces):
        every = slice(None, None, max(1, len(trace.x) // _MOST_POINTS))
        points = trace.style in (".", ",", "o", "x", "+")
        axis.plot(
            trace.x[every],
            trace.y[every],
            trace.style,
            color=_COLOURS[i % len(_COLOURS)],
            label=trace.label or None,
            markersize=3 if points else 5,
            linewidth=1.3,
        )
        labels += bool(trace.label)
    if labels:
        axis.legend(fontsize=7.5, frameon=False, ncols=2 if labels > 5 else 1)
