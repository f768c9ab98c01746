"""The report of a validation: its page, pictures, Markdown, the text for a terminal, the comparison with the thesis."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.reports.page import Failed, Subheading, html_table, image, markdown_table, write_page
from gz_onboard.reports.results import number
from gz_onboard.reports.style import BLUE, GREEN, INK, ORANGE, ChartPanel, Line, chart, save, time_unit
from gz_onboard.validation import comparison as definitions
from gz_onboard.validation.comparison import (
    CHANNELS,
    CONFIG,
    FORMS,
    LABELS,
    ORDER,
    ChannelErrors,
    Comparison,
    PooledMeans,
    SimulationVerdict,
    ValidatedRide,
    Verdict,
    channel_words,
)

Table = tuple[list[str], list[list[str]]]
"""Heads and rows."""

COLUMNS = (
    ("predictive", "pack_power", "power, rider model, W"),
    ("components", "road_load", "road load alone, N"),
    ("components", "inverter_power", "inverter alone, W"),
    ("components", "battery_voltage", "battery voltage alone, V"),
    ("components", "motor_temperature", "motor temperature alone, K"),
)
"""Columns of the table of errors by condition: form, channel, head."""
MEANINGS = {
    "open_loop": "the same throttle gives another ride; small errors of force add up to another speed",
    "predictive": "the same speed takes another current or torque: road load, losses, or how the throttle is opened",
    "components": "with measured inputs this part is still off: its parameters or its equation",
}
"""Meaning of a form that does not pass."""


def write_report(file: Path, rides: Sequence[ValidatedRide], together: Sequence[PooledMeans]) -> None:
    """Write the page: errors against their limits, errors by condition, each ride's picture. Raises OSError."""
    limits = f"each channel within {CONFIG.gate_percent:g} %, each component within {CONFIG.component_gate_percent:g} %"
    parts = [f"<p>{sum(ride.passed for ride in rides)} of {len(rides)} rides pass: {limits}.</p>"]
    for title, (heads, rows) in _tables(rides).items():
        numbers = range(1, len(heads)) if heads != THESIS_HEADS else ()
        parts.append(f"<h2>{title}</h2>{html_table(heads, rows, numbers)}")
    parts.append("<h2>Where the model fails</h2>")
    for on_dynamometer in sorted({ride.on_dynamometer for ride in rides}):
        heads, rows = by_condition([means for means in together if means.on_dynamometer == on_dynamometer])
        where = "dynamometer" if on_dynamometer else "road"
        parts.append(f"<h3>On the {where}</h3>{html_table(heads, rows, range(1, len(heads)))}")
    parts.append("<h2>Not judged</h2><ul>")
    parts += [f"<li>{html.escape(r.name)}: {html.escape(text)}</li>" for r in rides for text in r.missing]
    parts.append(f"</ul><h2>Definitions</h2><pre>{html.escape(definitions.__doc__ or '')}</pre>")
    parts += [f"<h2>{html.escape(ride.name)}</h2>{image(Path(ride.plot))}" for ride in rides if ride.plot]
    write_page(file, f"Validation of {rides[0].vehicle}", parts)


def markdown(rides: Sequence[ValidatedRide]) -> str:
    """Return the summary and the comparison with the thesis as Markdown; values beyond their limit in bold."""
    tables = list(_tables(rides).items())[:2]
    return "\n\n".join(f"### {title}\n\n{markdown_table(*table)}" for title, table in tables) + "\n"


def _tables(rides: Sequence[ValidatedRide]) -> dict[str, Table]:
    """Tables by title: summary, thesis, each ride's percentages by form, the reference of the charge."""
    limits = dict.fromkeys(FORMS, CONFIG.gate_percent) | {"components": CONFIG.component_gate_percent}
    return {
        "Summary": _summary(rides),
        "Comparison with the thesis": (THESIS_HEADS, thesis_rows(rides)),
        **{f"{FORMS[form].capitalize()}, percent (limit {limits[form]:g} %)": _gate(rides, form) for form in FORMS},
        "Reference of the state of charge, percent": _charge(rides),
    }


def _channels(verdicts: Sequence[Verdict]) -> list[str]:
    return list(dict.fromkeys(name for verdict in verdicts for name in verdict.channels))


def _summary(rides: Sequence[ValidatedRide]) -> Table:
    """The least and the greatest percent of each channel, and how many rides pass."""
    rows: list[list[str]] = []
    for form, title in FORMS.items():
        verdicts = [ride.verdicts[form] for ride in rides if form in ride.verdicts]
        rows += [[Subheading(title)]] if _channels(verdicts) else []
        for name in _channels(verdicts):
            found = [verdict.channels[name] for verdict in verdicts if name in verdict.channels]
            known = sorted(e.percent for e in found if e.percent is not None)
            passed = f"{sum(e.passed for e in found)} of {len(found)}"
            rows.append(
                [
                    channel_words(name),
                    f"{known[0]:.1f} to {known[-1]:.1f} %" if known else "–",
                    f"{max(e.rms for e in found):.3g} {found[0].unit}",
                    f"{found[0].limit_percent:g} %",
                    passed if all(e.passed for e in found) else Failed(passed),
                ]
            )
    return ["channel", "error", "RMS, worst ride", "limit", "rides within"], rows


def _gate(rides: Sequence[ValidatedRide], form: str) -> Table:
    """The percentages of each ride; of a simulation with the energy."""
    verdicts = {ride.name: ride.verdicts[form] for ride in rides if form in ride.verdicts}
    names = _channels(list(verdicts.values()))
    rows = []
    for ride, verdict in verdicts.items():
        rows.append([ride, *(_percent(verdict.channels.get(name)) for name in names)])
        if isinstance(verdict, SimulationVerdict):
            until = f" until {verdict.pack_empty.compared_s:.0f} s" if verdict.pack_empty else ""
            rows[-1].append(number(verdict.energy_percent, "+.1f") + until)
    return ["ride", *map(channel_words, names), *([] if form == "components" else ["energy"])], rows


def _percent(entry: ChannelErrors | None) -> str:
    if entry is None or entry.percent is None:
        return "–"
    text = f"{entry.percent:.1f}"
    return text if entry.passed else Failed(text)


def _charge(rides: Sequence[ValidatedRide]) -> Table:
    """The counted charge of each ride, and the greatest errors of the simulated one in points."""

    def most(ride: ValidatedRide, form: str) -> str:
        verdict = ride.verdicts.get(form)
        return f"{verdict.channels['soc'].max:.1f}" if verdict and "soc" in verdict.channels else "–"

    rows = [
        [ride.name, *ride.soc_reference.cells, most(ride, "open_loop"), most(ride, "predictive")]
        for ride in rides
        if ride.soc_reference
    ]
    heads = ["ride", "at rest before", "counted", "voltage at the end says", "open loop, most", "rider model, most"]
    return heads, rows


def by_condition(together: Sequence[PooledMeans]) -> Table:
    """Mean error of `COLUMNS` in each riding condition, and in percent of the mean magnitude."""
    means = {(m.form, m.channel, m.condition): m for m in together}
    rows: list[list[str]] = []
    for sorting, label in LABELS.items():
        kinds = {m.condition for m in together if m.sorting == sorting}
        rows += [[Subheading(label)]] if kinds else []
        for kind in sorted(kinds, key=ORDER.index):
            found = [means.get((form, channel, kind)) for form, channel, _ in COLUMNS]
            seconds = max((m.seconds for m in found if m), default=0)
            cells = [f"{m.mean_error:+.3g} ({m.bias_percent:+.1f} %)" if m else "–" for m in found]
            rows.append([kind, f"{seconds / 60:.0f}", *cells])
    return ["condition", "min", *(head for *_, head in COLUMNS)], rows


# --- the thesis ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ThesisRow:
    """A number of the thesis (Lord 2016), which has none for its pictures of whole rides (figs. 3.8 to 3.20).

    form, channels: what answers it. limit: in percent of the mean magnitude, or in `unit` that the greatest error may
    have. says: of a limit in percent. on_dynamometer: None is anywhere. per_cell: of a cell, where a pack was measured.
    """

    what: str
    place: str  # in the thesis, by its own page numbers
    form: str
    channels: tuple[str, ...]
    limit: float
    unit: str = "%"
    on_dynamometer: bool | None = None
    says: str = "met"
    per_cell: bool = False

    def error(self, channel: ChannelErrors, cells_series: int) -> float | None:
        """The error of a channel that is compared."""
        if self.unit == "%":
            return channel.percent
        return channel.max / cells_series if self.per_cell else channel.max

    def cells(self, rides: Sequence[ValidatedRide]) -> list[str]:
        """The row of the table: the worst of all rides that answer it; empty if there is none."""
        found: list[tuple[float, str, str]] = []
        for ride in rides:
            verdict = ride.verdicts.get(self.form)
            if verdict and self.on_dynamometer in (None, ride.on_dynamometer):
                for name in self.channels:
                    error = self.error(verdict.channels[name], ride.cells_series) if name in verdict.channels else None
                    found += [] if error is None else [(error, channel_words(name), ride.name)]
        if not found:
            return []
        worst, channel, name = max(found)
        of_percent = self.unit == "%"
        thesis = f"{self.says} (limit {self.limit:g} %)" if of_percent else f"±{self.limit:g} {self.unit}"
        ours = f"{worst:.1f} %" if of_percent else f"{worst:.2g} {self.unit}"
        ours += f", {channel}" if len(self.channels) > 1 else ""
        count = len({ride for *_, ride in found})
        better = "yes" if worst <= self.limit else Failed("no")
        return [self.what, thesis, self.place, ours, f"{name}, of {count}", better]


_SIGNALS = ("pack_current", "pack_voltage", "motor_torque", "motor_speed")
_PARTS = ("battery_voltage", "inverter_power", "motor_torque")
THESIS = (
    *(
        ThesisRow(
            f"four signals, {FORMS[form]}, {'dynamometer' if roller else 'road'}",
            "p. iii",
            form,
            _SIGNALS,
            CONFIG.gate_percent,
            on_dynamometer=roller,
            says="met" if roller else "errors in turning",
        )
        for roller in (True, False)
        for form in ("open_loop", "predictive")
    ),
    ThesisRow("components of the powertrain", "sec. 2.4, p. 48", "components", _PARTS, CONFIG.component_gate_percent),
    ThesisRow("voltage of a cell", "fig. 2.22, bench, p. 40", "components", _PARTS[:1], 0.02, "V", per_cell=True),
    ThesisRow("motor temperature", "fig. 2.25, bench, p. 44", "components", ("motor_temperature",), 10.0, "K"),
    ThesisRow("inverter temperature", "fig. 2.26, bench, p. 45", "components", ("inverter_temperature",), 6.0, "K"),
    ThesisRow("cell temperature", "fig. 2.27, its fit, p. 47", "components", ("cell_temperature",), 1.0, "K"),
)
THESIS_HEADS = ["what", "thesis", "where", "ours, worst", "on", "better or as good"]


def thesis_rows(rides: Sequence[ValidatedRide]) -> list[list[str]]:
    """Rows of `THESIS_HEADS`, one for each number of the thesis that a ride answers."""
    return [cells for row in THESIS if (cells := row.cells(rides))]


# --- text ---------------------------------------------------------------------------------------------------------


def ride_text(ride: ValidatedRide) -> str:
    """A ride's entry for a terminal."""
    where = "dynamometer" if ride.on_dynamometer else "road"
    air = "" if ride.ambient_c is None else f", {ride.ambient_c:.0f} degC"
    lines = [
        f"{ride.file}: {'passed' if ride.passed else 'not passed'}",
        f"  {where}, {ride.kind or 'kind not noted'}, {ride.distance_km:.2f} km, {ride.duration_s:.0f} s, "
        f"{ride.payload_kg:g} kg{air}",
    ]
    for form, verdict in ride.verdicts.items():
        lines.append(f"  {FORMS[form]:16} {_energy_text(verdict)}".rstrip())
        for channel, e in verdict.channels.items():
            percent = "–" if e.percent is None else f"{e.percent:5.1f} %"
            spread = "" if e.of_spread is None else f", {e.of_spread:.2f} of its spread"
            outcome = f"{'ok' if e.passed else 'FAIL'} (limit {e.limit_percent:g} %)"
            lines.append(
                f"    {channel_words(channel):21} {percent} {outcome:17} "
                f"rms {e.rms:7.2f}, max {e.max:7.2f}, mean {e.mean_error:+7.2f} {e.unit}{spread}"
            )
        if not verdict.passed:
            lines.append(f"    FAIL: {MEANINGS[form]}")
    if ride.soc_reference:
        start, drawn, says = ride.soc_reference.cells
        text = f"{start} % by the voltage at rest, then {drawn} % counted; the voltage of the last 2 min says {says} %"
        lines.append(f"  state of charge: {text}")
    if not ride.passed:
        lines.append("  definition of percent, and where the model is known to fail: docs/results/validation.md")
    return "\n".join([*lines, *(f"  {text}" for text in ride.missing)])


def _energy_text(verdict: Verdict) -> str:
    """The energy of a simulated ride, and where its pack was empty."""
    if not isinstance(verdict, SimulationVerdict):
        return ""
    known = "" if verdict.energy_percent is None else f"energy {verdict.energy_percent:+.1f} %"
    if end := verdict.pack_empty:
        known += f" until {end.compared_s:.0f} s; the simulated pack is empty at {end.time_s:.0f} s"
    return known.strip()


# --- the picture of a ride ---------------------------------------------------------------------------------------

COLOURS = {"open_loop": ORANGE, "predictive": BLUE, "components": GREEN}
AVERAGED_S = 30
"""Averages gears and gusts out of an error."""
_DPI = 90  # of a wide picture


def draw_ride(file: Path, ride: ValidatedRide, comparisons: Mapping[str, Mapping[str, Comparison]]) -> None:
    """Draw each quantity measured and simulated on the left, the errors on the right. Raises OSError."""
    found: dict[str, dict[str, Comparison]] = {channel.label: {} for channel in CHANNELS.values()}
    for form, by_name in comparisons.items():
        for name, comparison in by_name.items():
            if name != "pack_power":
                found.setdefault(comparison.quantity.label, {})[form] = comparison
    unit, x_name = time_unit(ride.duration_s)
    rows = [_row(forms, unit) for forms in found.values() if forms]
    x = np.array([0.0, ride.duration_s / unit])
    air = "" if ride.ambient_c is None else f", air {ride.ambient_c:.0f} °C"
    title = f"{ride.name} · {ride.vehicle}, {ride.payload_kg:g} kg{air}, {ride.distance_km:.1f} km"
    about = f"left: measured and simulated; right: simulated less measured, each second and the mean of {AVERAGED_S} s"
    save(chart(rows, x, x_name, title, about, left=0.055), file, _DPI)


def _row(forms: Mapping[str, Comparison], unit: float) -> tuple[ChartPanel, ChartPanel]:
    """Values and errors of one quantity, over time in `unit` [s]."""
    values: list[Line] = []
    errors: list[Line] = []
    for form, comparison in forms.items():
        time, colour, name = np.arange(len(comparison.valid)) / unit, COLOURS[form], FORMS[form]
        measured, modelled, error = (
            np.where(comparison.valid, y, np.nan) for y in (comparison.measured, comparison.modelled, comparison.error)
        )
        values += [] if values else [Line(measured, INK, "measured", x=time)]
        values.append(Line(modelled, colour, name, 0.9, x=time))
        errors.append(Line(error, colour, f"_{name}", 0.2, x=time))
        errors.append(Line(_mean(comparison), colour, name, 1.5, x=time))
    quantity = next(iter(forms.values())).quantity
    name = f"{quantity.label}\n[{quantity.unit.replace('degC', '°C')}]"
    return ChartPanel(name, values, 1.25), ChartPanel("", errors, 1.25, zero=True)


def _mean(comparison: Comparison) -> Array:
    """The error, averaged over `AVERAGED_S` where most of it is known."""
    n = len(comparison.valid)
    wide = np.ones(min(AVERAGED_S, max(n // 4, 1)))
    count = np.convolve(comparison.valid, wide, "same")
    total = np.convolve(np.where(comparison.valid, comparison.error, 0.0), wide, "same")
    return np.where(count > len(wide) / 4, total / np.maximum(count, 1), np.nan)
