"""What a discovery says in the terminal."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence

from gz_onboard.discovery.breakdown import before_and_after
from gz_onboard.discovery.candidates import Candidate
from gz_onboard.discovery.channels import CHANNEL
from gz_onboard.discovery.constancy import varying
from gz_onboard.discovery.detectability import extent
from gz_onboard.discovery.energy import residual_sizes
from gz_onboard.discovery.result import METRICS, NO_INTERVAL, VERDICTS, Gain, Limit, Report
from gz_onboard.discovery.strain import in_words as strain_words
from gz_onboard.discovery.unexplained import in_words
from gz_onboard.discovery.verdict import Discovery
from gz_onboard.discovery.wording import readable, with_unit
from gz_onboard.reports.results import clock

WIDTH = 118  # characters of a line
ROWS = 3  # residuals and limits that are printed


def listing(every: Sequence[Candidate]) -> str:
    """The candidates with equation, unit, prior and what would show them."""
    entries = []
    for c in every:
        kind = f"effect at {c.effect.port.name}" if c.effect else "parameter of the vehicle file"
        lines = [f"{c.name}  ({kind})", f"    equation   {c.equation}"]
        for p in c.parameters:
            name = f"{p.name} [{p.unit}]"
            lines.append(f"    parameter  {name}, prior {p.prior:g} ± {p.prior_sd:g}, from {p.low:g} to {p.high:g}")
        lines += textwrap.wrap(
            f"shown by   {c.shown_by or 'its file does not say (SHOWN_BY)'}",
            WIDTH,
            initial_indent="    ",
            subsequent_indent=" " * 15,
        )
        entries.append("\n".join(lines))
    return "\n\n".join(entries)


def summary(found: Discovery, written: Sequence[str] = ()) -> str:
    """The result in the terminal. written: of the extended model."""
    report = found.report
    lines = [
        *_header(found),
        *_causes(report),
        *_scores(found),
        *_gain(report.gain),
        *_limits(report.limits),
        *(f"model        {text}" for text in written),
        *(f"next         {text}" for text in report.advice),
        *(f"note         {text}" for text in report.notes),
    ]
    return "\n".join(
        part for line in lines for part in (textwrap.wrap(line, WIDTH, subsequent_indent=" " * 13) or [line])
    )


def _header(found: Discovery) -> list[str]:
    verdict, ridden, count, healthy = found.report.verdict, extent(found.lines), len(found.lines), found.mixed.healthy
    known = f"{healthy} healthy rides" if healthy else "the vehicle file alone"
    energy = f", {ridden.energy / 3.6e6:.2f} kWh drawn" if ridden.energy > 0 else ""
    rides = f"{count} ride{'s' if count > 1 else ''}, {ridden.distance / 1e3:.1f} km in {clock(ridden.time)}"
    return [
        f"rides        {rides}{energy}; against {found.mixed.vehicle.name} as known from {known}",
        f"verdict      {verdict}: {VERDICTS[verdict]}",
    ]


def _causes(report: Report) -> list[str]:
    lines = []
    for c in report.causes:
        change = "" if c.change == c.value else f"; change {with_unit(c.change, c.unit, '+.4g')}"
        lines.append(
            f"  {c.name:20} {c.parameter} = {with_unit(c.value, c.unit)} "
            f"(95 %: {c.ci95[0]:.4g} to {c.ci95[1]:.4g}{change}), "
            f"{c.energy_share:+.1%} of the energy, score {c.evidence:.0f}"
        )
        for name, other in c.others.items():
            low, high = other.ci95
            lines.append(f"  {'':20} {name} = {with_unit(other.value, other.unit)} (95 %: {low:.4g} to {high:.4g})")
        if c.varies:
            lines.append(f"  {'':20} {varying(report.constancy, c.name)}: no model is extended with it")
    for group in report.ambiguous:
        lines.append(f"  ambiguous:           {', '.join(group)}")
    if report.unknown:
        u = report.unknown
        lines.append(f"  unexplained:         {in_words(u)}, {u.share:+.1%} of the energy, score {u.score:.0f}")
        if u.denies:
            lines.append(f"  rejected:            {', '.join(u.denies)}, which would not act alike everywhere")
    return [
        *lines,
        *(f"  implausible:         {text}" for text in (strain_words(report.strain) if report.strain else ())),
    ]


def _scores(found: Discovery) -> list[str]:
    report = found.report
    named = {cause.name for cause in report.causes}.union(*report.ambiguous)
    refused = (row.name for row in report.ranking if row.score > report.threshold and row.name not in named)
    said = dict.fromkeys(refused, " (rejected)")
    best = ", ".join(f"{row.name} {row.score:.1f}{said.get(row.name, '')}" for row in report.ranking[:5])
    left = residual_sizes(before_and_after(found)[0])
    largest = sorted(left.items(), key=lambda row: -abs(row[1].energy_share))[:ROWS]
    text = "; ".join(
        f"{readable(name)} {r.mean:+.3g} ± {r.rms:.3g} {CHANNEL[name].unit} ({r.energy_share:+.1%} of the energy)"
        for name, r in largest
    )
    return [f"scores       {best}; healthy rides stay below {report.threshold:.1f}", f"residuals    {text}"]


def _limits(limits: Mapping[str, Limit]) -> list[str]:
    shares = {name: limit.energy_share for name, limit in limits.items() if limit.energy_share}
    worst = sorted(shares.items(), key=lambda row: -row[1])[:ROWS]
    if not worst:
        return []
    rows = ", ".join(f"{name} {share:.1%}" for name, share in worst)
    return [f"limits       the least that these rides show, of the energy: {rows}; others less"]


def _gain(gain: Gain) -> list[str]:
    lines = []
    for metric, errors in gain.errors.items():
        label, factor, unit = METRICS[metric]
        before, control, after = (x * factor for x in (errors.before, errors.control, errors.after))
        ci95 = "gain {:+.2g} to {:+.2g}".format(*(x * factor for x in errors.ci95)) if errors.ci95 else NO_INTERVAL
        lines.append(
            f"{label:18} {before:6.3g} before, {control:6.3g} refitted, {after:6.3g} extended  {unit:6} ({ci95})"
        )
    if not lines:
        return [f"held out     {gain.note or 'nothing'}"]
    head = (
        "errors on rides held out of the fit; refitted: with the parameters that the model has already; "
        "gain over that, 95 % over rides"
    )
    return [f"held out     {head}", *(f"  {line}" for line in lines)]
