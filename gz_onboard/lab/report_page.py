"""The page of recorded rides as HTML: what each section of a ride shows."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from math import isfinite, nan
from pathlib import Path

from gz_onboard.events import TOLD, Activity, State, cause_words, words
from gz_onboard.lab.estimate import lacks_energy, summary_rows
from gz_onboard.lab.logged import Logged
from gz_onboard.lab.plot import column, spans, with_holes
from gz_onboard.lab.report_charts import Abscissa, ChartLine, bar, chart, key, strip
from gz_onboard.lab.report_ride import ReportedRide
from gz_onboard.lab.report_svg import axis_of, draw_map
from gz_onboard.lab.why import Why
from gz_onboard.reports.page import tiles
from gz_onboard.reports.results import FIRST_DATE_NS, clock, number
from gz_onboard.reports.style import time_unit

_STATE_COLOURS = {State.STARTING: "grey", State.VALID: "green", State.DEGRADED: "amber", State.INVALID: "red"}
_TEMPERATURE_COLOURS = {"motor_temperature": "red", "inverter_temperature": "purple", "ambient_temperature": "blue"}
_LEAST_WH = 0.05  # of the ledger: less is not shown
_MOST_CHANGES = 20
_TAUGHT = ("riding", "unexplained", "payload", "rolling", "drag")  # what sensors that are left out may have taught


def section(ride: ReportedRide, anchor: str) -> str:
    """The HTML of a ride; anchor: its id in the page."""
    rows = with_holes(ride.rows)
    parts = [
        f"<h2>{html.escape(ride.name)}</h2>",
        _about(ride),
        _tiles(ride),
        _map(ride),
        *(_charts(ride, rows) if rows else []),
        _ledger(ride),
        _why(ride.summary.why),
        _changes(ride.summary.changes),
        _strips(ride, rows) if rows else "",
        "<h3>Summary</h3>",
        _summary(ride),
    ]
    return f'<section class="ride" id="{anchor}">' + "\n".join(filter(None, parts)) + "</section>"


def contents(rides: Sequence[tuple[str, Sequence[str]]]) -> str:
    """A table of rides (anchor, cells) above their sections."""
    heads = ("ride", "start", "time", "km", "Wh/km", "SOC", "range left, km")
    lines = [
        f'<tr><td><a href="#{anchor}">{html.escape(name)}</a></td>' + "".join(f'<td class="n">{c}</td>' for c in cells)
        for anchor, (name, *cells) in rides
    ]
    head = "".join(f"<th{' class=n' if i else ''}>{text}</th>" for i, text in enumerate(heads))
    return f'<div class="scroll"><table><tr>{head}</tr>{"".join(lines)}</table></div>'


def cells(ride: ReportedRide) -> list[str]:
    """What `contents` says of a ride: its name, and the rest as HTML."""
    s = ride.summary
    numbers = [number(s.distance_km, ".2f"), number(s.consumption_wh_km, ".1f"), _soc(ride)]
    return [ride.name, _start(s.start_ns), clock(s.duration_s), *numbers, number(s.range_end_km, ".1f")]


# --- sections -----------------------------------------------------------------------------------------------------


def _start(start_ns: int) -> str:
    if start_ns < FIRST_DATE_NS:
        return "–"
    return datetime.fromtimestamp(start_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M UTC")


def _about(ride: ReportedRide) -> str:
    s = ride.summary
    # The page may be sent to somebody, whom our folders do not concern.
    damage = [f"damaged log: {s.damage.replace(s.file, '').lstrip(': ')}"] if s.damage else []
    said = " · ".join([s.vehicle, _start(s.start_ns), Path(s.file).name, *damage])
    return f'<p class="about">{html.escape(said)}</p>'


def _soc(ride: ReportedRide) -> str:
    s = ride.summary
    return f"{number(s.soc_start, '.1f', '', 100)} → {number(s.soc_end, '.1f', '%', 100)}"


def _tiles(ride: ReportedRide) -> str:
    s = ride.summary
    band = f"range left, {number(s.range_end_p10_km, '.1f')} to {number(s.range_end_p90_km, '.1f')} km"
    over = f"over {s.energy_distance_km:.2f} km: {lacks}" if (lacks := lacks_energy(s)) else "over the ride"
    values = [
        ("distance", number(s.distance_km, ".2f", "km"), f"in {clock(s.duration_s)}"),
        ("energy", number(s.energy_wh, ".0f", "Wh"), f"drawn, {number(s.energy_recovered_wh, '.0f', 'Wh')} recovered"),
        ("consumption", number(s.consumption_wh_km, ".1f", "Wh/km"), over),
        ("soc", _soc(ride), f"state of charge, ± {number(s.soc_end_sd, '.1f', '%', 100)}"),
        ("range", number(s.range_end_km, ".1f", "km"), band),
    ]
    return tiles(values)


def _map(ride: ReportedRide) -> str:
    if not ride.path:
        return ""
    drawn = draw_map(ride.path, "the path, north up")
    long = f"{drawn.bar / 1000:g} km" if drawn.bar >= 1000 else f"{drawn.bar:g} m"
    return (
        f"<figure><figcaption><b>Path</b> <span>by GPS, north up; the bar is {long}</span>"
        f"{key('start', 'green')}{key('end', 'red')}</figcaption>{drawn.svg}</figure>"
    )


def _charts(ride: ReportedRide, rows: Sequence[Logged]) -> list[str]:
    """Speed, power, state of charge, temperatures over time, and the range over what was ridden."""
    start, end = rows[0]["time"], rows[-1]["time"]
    seconds, unit = time_unit(end - start)
    time = [(row["time"] - start) / seconds for row in rows]
    below = Abscissa(axis_of(time, whole=False), unit)
    voltage, current = column(rows, "pack_voltage"), column(rows, "pack_current")
    power = [v * i * 1e-3 for v, i in zip(voltage, current, strict=True)]
    soc, sd = column(rows, "soc", 100), column(rows, "soc_sd", 100)
    band = [m - s for m, s in zip(soc, sd, strict=True)], [m + s for m, s in zip(soc, sd, strict=True)]
    others = [
        ChartLine(words(role).split()[0], [(t - start) / seconds for t in times], values, _TEMPERATURE_COLOURS[role])
        for role, (times, values) in ride.temperatures.items()
    ]
    cells = ChartLine("cells", time, column(rows, "cell_temperature"), "orange")
    return [
        chart("Speed", "km/h", [ChartLine("", time, column(rows, "speed", 3.6), "blue")], below),
        chart("Power of the pack", "kW", [ChartLine("", time, power, "orange")], below),
        chart("State of charge", "%", [ChartLine("with ± σ", time, soc, "green", band)], below, zero=False),
        _range(rows),
        chart("Temperatures", "°C", [cells, *others], below, zero=False),
    ]


def _range(rows: Sequence[Logged]) -> str:
    """The range over the distance, and against it what it came to: what was ridden then, and the range at the end."""
    ridden = column(rows, "distance", 1e-3)
    left, p10, p90 = (column(rows, name, 1e-3) for name in ("range", "range_p10", "range_p90"))
    known = [i for i, value in enumerate(left) if isfinite(value)]
    if not known:
        return ""
    curves = [ChartLine("forecast, P10 to P90", ridden, left, "blue", (p10, p90))]
    first, last = known[0], known[-1]
    text = _said("At first it said", left, p10, p90, first)
    if ridden[last] - ridden[first] > 0 and not any(row.get("activity") == Activity.CHARGING.name for row in rows):
        came = [left[last] + ridden[last] - x if i <= last else nan for i, x in enumerate(ridden)]
        curves.append(ChartLine("what it came to", ridden, came, "muted", dashed=True))
        text += f"; then {ridden[last] - ridden[first]:.2f} km were ridden"
    text += _said(", and at the end it said", left, p10, p90, last)
    figure = chart("Range over the distance", "km", curves, Abscissa(axis_of(ridden, whole=False), "km"))
    return f'{figure}<p class="note" data-of="forecast">{text}.</p>'


def _said(words_: str, left: Sequence[float], p10: Sequence[float], p90: Sequence[float], i: int) -> str:
    return f"{words_} {left[i]:.1f} km ({p10[i]:.1f} to {p90[i]:.1f})"


def _ledger(ride: ReportedRide) -> str:
    """Where the energy went, by the model; and what that leaves of what was measured."""
    drawn, distance = ride.summary.energy_wh, ride.ledger_km
    told = [(name, energy) for name, energy in ride.ledger_wh().items() if abs(energy) >= _LEAST_WH]
    if not told:
        return ""
    axis = axis_of([energy for _, energy in told], whole=False, zero=True)
    lines = [
        _row(html.escape(name), bar(0.0, energy, axis, "blue" if energy > 0 else "green"), energy, distance)
        for name, energy in told
    ]
    if drawn is not None:
        lines.append(_row("drawn from the pack", "<td></td>", drawn, distance))
    return (
        "<h3>Where the energy went</h3><p class=note>By the model, second by second. Beyond it is what was measured "
        "more than modelled; not modelled, what flowed while nothing was learned: charging, standing long, a sensor "
        "in doubt. Below zero: gained.</p>"
        f'<table class="{"" if drawn is None else "total"}" data-of="ledger">'
        f"<tr><th></th><th></th><th class=n>Wh</th><th class=n>Wh/km</th></tr>{''.join(lines)}</table>"
    )


def _row(name: str, drawn: str, energy: float, distance: float) -> str:
    per_km = f"{energy / distance:z.1f}" if distance >= 0.1 else "–"
    return f'<tr><td>{name}</td>{drawn}<td class="n">{energy:z.1f}</td><td class="n">{per_km}</td></tr>'


def _told(causes: dict[str, float]) -> list[tuple[str, float]]:
    """The causes [km] that are worth telling, the largest first."""
    return sorted(((n, km) for n, km in causes.items() if abs(km) * 1e3 >= TOLD), key=lambda cause: -abs(cause[1]))


def _why(why: Why | None) -> str:
    """From the rated range to that at the end, cause by cause."""
    if why is None:
        return ""
    steps, reached = [], why.reference_km
    for name, size in _told(why.causes_km):
        steps.append((name, reached, reached + size))
        reached += size
    axis = axis_of([0.0, why.reference_km, why.range_km, *(end for _, _, end in steps)], whole=False)
    whole = [("rated range", 0.0, why.reference_km, "grey", ""), ("range", 0.0, why.range_km, "blue", "")]
    middle = [(cause_words(name), b, e, "green" if e > b else "red", "+") for name, b, e in steps]
    lines = [
        f"<tr><td>{html.escape(name)}</td>{bar(begin, end, axis, colour)}<td class=n>{end - begin:{sign}.1f}</td></tr>"
        for name, begin, end, colour, sign in (whole[0], *middle, whole[1])
    ]
    return (
        f"<h3>Why the range is not the rated one</h3><p class=note>At {clock(why.time_s)}, in km; causes below "
        f'{TOLD:.0f} m are left out.</p><table data-of="why">{"".join(lines)}</table>'
    )


def _by_sensor(change: Why) -> dict[str, float]:
    """The causes of a change, in words: what is forgotten with a sensor that is left out is not the riding's."""
    causes = {cause_words(name): km for name, km in change.causes_km.items()}
    if change.forgotten:
        left_out = " and ".join(map(words, change.forgotten))
        taught = sum(causes.pop(cause_words(name), 0.0) for name in _TAUGHT)
        causes[f"{left_out} left out, what it taught forgotten"] = taught
    return causes


def _changes(changes: Sequence[Why]) -> str:
    """When the range changed by other than what was ridden, and why."""
    if not changes:
        return ""
    lines = []
    for change in changes[-_MOST_CHANGES:]:
        causes = ", ".join(f"{name} {km:+.1f}" for name, km in _told(_by_sensor(change)))
        size = change.range_km - change.reference_km
        lines.append(f"<tr><td class=at>{clock(change.time_s)}</td><td class=n>{size:+.1f}</td><td>{causes}</td></tr>")
    more = f"; the last {_MOST_CHANGES} of {len(changes)}" if len(changes) > _MOST_CHANGES else ""
    return (
        f"<h3>Changes of the range, in km, beyond what was ridden{more}</h3>"
        f'<table data-of="changes"><tr><th>at</th><th class=n>by</th><th>why</th></tr>{"".join(lines)}</table>'
    )


def _strips(ride: ReportedRide, rows: Sequence[Logged]) -> str:
    """State, reasons and sensors left out, over time."""
    s = ride.summary
    time = [row["time"] - rows[0]["time"] for row in rows]
    axis = axis_of(time, whole=False)

    def where(true: Iterable[bool]) -> list[tuple[float, float]]:
        return spans(time, list(true))

    states = [(colour, where(row["state"] == state.name for row in rows)) for state, colour in _STATE_COLOURS.items()]
    keys = "".join(
        key(f"{state.name.lower()} {s.states[state.name]:.1f} s", colour)
        for state, colour in _STATE_COLOURS.items()
        if state.name in s.states
    )
    lines = [strip(f"state{keys}", states, axis)]
    for what, durations, colour in (("reasons", s.reasons, "amber"), ("distrusted", s.distrusted, "red")):
        for name, seconds in durations.items():
            found = where(name in (row.get(what) or "").split() for row in rows)
            text = html.escape(f"{words(name)}{' left out' if what == 'distrusted' else ''} {seconds:.1f} s")
            lines.append(strip(text, [(colour, found)], axis))
    return "<h3>State, reasons, faulty sensors over time</h3>" + "".join(lines)


def _summary(ride: ReportedRide) -> str:
    lines = [
        f"<tr><td>{html.escape(n)}</td><td>{html.escape(text)}</td></tr>" for n, text in summary_rows(ride.summary)
    ]
    return f'<table class="summary">{"".join(lines)}</table>'
