"""The page of a validation, and its tables as Markdown: the gate for each ride, and where the model fails."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path

from gz_onboard.lab import validate_score
from gz_onboard.lab.validate_score import (
    COMPONENT_GATE,
    GATE,
    LABELS,
    NAMES,
    ORDER,
    ChannelErrors,
    PooledMeans,
    SimulationVerdict,
    ValidatedRide,
    Verdict,
    channel_words,
)
from gz_onboard.lab.validate_thesis import HEAD, beside_thesis
from gz_onboard.reports.page import Failed, Subheading, html_table, image, markdown_table, write_page
from gz_onboard.reports.results import number

Forms = Mapping[str, Mapping[str, Mapping[str, Mapping[str, PooledMeans]]]]
"""Pooled means by form, channel, sorting and condition."""
HeadedRows = tuple[list[str], list[list[str]]]
"""Heads and rows."""

COLUMNS = (
    ("predictive", "pack_power", "W", "power, rider model"),
    ("components", "road_load", "N", "road load alone"),
    ("components", "inverter_power", "W", "inverter alone"),
    ("components", "battery_voltage", "V", "battery voltage alone"),
    ("components", "motor_temperature", "K", "motor temperature alone"),
)
"""What the table of failures shows: form, channel, unit, head."""


def write_report(file: Path, rides: Sequence[ValidatedRide], together: Mapping[str, Forms]) -> None:
    """The page: the gate's tables, where the model fails, each ride's picture. Raises OSError."""
    passed = sum(ride.passed for ride in rides)
    limits = f"each channel within {GATE:g} %, each component within {COMPONENT_GATE:g} %"
    parts = [f"<p>{passed} of {len(rides)} rides pass: {limits}.</p>"]
    for title, table in _tables(rides):
        numbers = () if table[0] == list(HEAD) else range(1, len(table[0]))
        parts.append(f"<h2>{title}</h2>{html_table(*table, numbers)}")
    parts.append("<h2>Where the model fails</h2>")
    for where, forms in together.items():
        heads, rows = _failures(forms)
        parts.append(f"<h3>On the {where}</h3>{html_table(heads, rows, range(1, len(heads)))}")
    parts.append("<h2>What could not be judged</h2><ul>")
    parts += [f"<li>{html.escape(r.name)}: {html.escape(text)}</li>" for r in rides for text in r.missing]
    parts.append(f"</ul><h2>Definitions</h2><pre>{html.escape(validate_score.__doc__ or '')}</pre>")
    parts += [f"<h2>{html.escape(ride.name)}</h2>{image(Path(ride.plot))}" for ride in rides if ride.plot]
    write_page(file, f"Validation of {rides[0].vehicle}", parts)


def markdown(rides: Sequence[ValidatedRide]) -> str:
    """Return the summary and the comparison with the thesis as Markdown; values beyond their limit in bold."""
    return "\n\n".join(f"### {title}\n\n{markdown_table(*table)}" for title, table in _tables(rides)[:2]) + "\n"


def _tables(rides: Sequence[ValidatedRide]) -> list[tuple[str, HeadedRows]]:
    """With their titles: rides and channels against their limits, the thesis, the reference of the charge."""
    limits = {"components": COMPONENT_GATE}
    gates = [
        (f"{NAMES[form].capitalize()}, percent (limit {limits.get(form, GATE):g} %)", _gate(rides, form))
        for form in NAMES
    ]
    return [
        ("In short", _in_short(rides)),
        ("Beside the thesis", (list(HEAD), beside_thesis(rides))),
        *gates,
        ("What the state of charge is compared with, percent", _charge(rides)),
    ]


def _in_short(rides: Sequence[ValidatedRide]) -> HeadedRows:
    """Of each channel the least and the greatest percent, and how many rides pass."""
    rows: list[list[str]] = []
    for form, title in NAMES.items():
        verdicts = [ride.verdicts[form] for ride in rides if form in ride.verdicts]
        names = list(dict.fromkeys(name for verdict in verdicts for name in verdict.channels))
        if names:
            rows.append([Subheading(title)])
        for name in names:
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


def _charge(rides: Sequence[ValidatedRide]) -> HeadedRows:
    rows = []
    for ride in rides:
        soc = ride.soc_reference
        if not soc:
            continue
        says = "–" if soc.voltage_says is None else f"{soc.voltage_says:+.1f} ± {soc.voltage_sd:.1f}"
        cells = [f"{soc.start:.1f} ± {soc.start_sd:.1f}", f"{soc.drawn:.1f} ± {soc.drawn_sd:.1f}", says]
        rows.append([ride.name, *cells, *(_at_most(ride.verdicts.get(form)) for form in ("open_loop", "predictive"))])
    heads = ["ride", "at rest before", "counted", "voltage at the end says", "open loop, most", "rider model, most"]
    return heads, rows


def _at_most(verdict: Verdict | None) -> str:
    """The greatest error of the charge in points."""
    return f"{verdict.channels['soc'].max:.1f}" if verdict and "soc" in verdict.channels else "–"


def _gate(rides: Sequence[ValidatedRide], form: str) -> HeadedRows:
    verdicts = [(ride.name, ride.verdicts[form]) for ride in rides if form in ride.verdicts]
    names = list(dict.fromkeys(name for _, verdict in verdicts for name in verdict.channels))
    energy = ["energy"] if form != "components" else []
    rows = []
    for ride, verdict in verdicts:
        cells = [_percent(verdict.channels.get(name)) for name in names]
        if isinstance(verdict, SimulationVerdict):
            end = verdict.pack_empty
            cells.append(number(verdict.energy_percent, "+.1f") + (f" until {end.compared_s:.0f} s" if end else ""))
        rows.append([ride, *cells])
    return ["ride", *map(channel_words, names), *energy], rows


def _percent(entry: ChannelErrors | None) -> str:
    if entry is None or entry.percent is None:
        return "–"
    text = f"{entry.percent:.1f}"
    return text if entry.passed else Failed(text)


def failures(forms: Forms) -> list[tuple[str, str, float, list[tuple[float, float] | None]]]:
    """Rows (sorting, condition, seconds, (mean error, in percent of the mean magnitude) per column of `COLUMNS`)."""
    rows = []
    for by in LABELS:
        columns = [forms.get(form, {}).get(channel, {}).get(by, {}) for form, channel, *_ in COLUMNS]
        for kind in sorted({kind for column in columns for kind in column}, key=ORDER.index):
            found = [column.get(kind) for column in columns]
            time = max(float(means.seconds) for means in found if means)
            rows.append((by, kind, time, [(m.mean_error, m.bias_percent) if m else None for m in found]))
    return rows


def _failures(forms: Forms) -> HeadedRows:
    heads = ["condition", "min", *(f"{title}, {unit}" for *_, unit, title in COLUMNS)]
    rows: list[list[str]] = []
    before = ""
    for by, kind, time, means in failures(forms):
        if by != before:
            rows.append([Subheading(LABELS[by])])
            before = by
        values = ["–" if cell is None else f"{cell[0]:+.3g} ({cell[1]:+.1f} %)" for cell in means]
        rows.append([kind, f"{time / 60:.0f}", *values])
    return heads, rows
