"""``gz-onboard discover``: what rides show that the model of the vehicle does not, and why."""

from __future__ import annotations

import argparse
import os
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gz_onboard.bus.logs import log_suffix
from gz_onboard.errors import InputError, nearest
from gz_onboard.lab.discover.breakdown import before_and_after, outlying_rides
from gz_onboard.lab.discover.candidates import Candidate, candidates
from gz_onboard.lab.discover.channels import BY_NAME
from gz_onboard.lab.discover.detectability import (
    amount,
    implausible_rides,
    limits,
    missing_residuals,
    remaining_range_error,
    size,
    words,
)
from gz_onboard.lab.discover.discovery import baseline, discover
from gz_onboard.lab.discover.energy import residual_sizes
from gz_onboard.lab.discover.extension import write_baseline, write_model
from gz_onboard.lab.discover.result import METRICS, SCHEMA, VERDICTS, Report
from gz_onboard.lab.processes import Progress, over_rides
from gz_onboard.simulation.samples import Samples, read_samples
from gz_onboard.simulation.telling import clock, explain_keys, write_json
from gz_onboard.vehicle import Vehicle, find_vehicle, read_vehicle

KEYS = {
    "verdict": "cause, none, ambiguous or unknown",
    "causes": "name, parameter, value, unit, ci95, change (over the healthy value), energy_share, evidence "
    "(chi-squared of one degree of freedom), varies (from ride to ride: no model is extended with it), parameters (all "
    "of them: value, ci95)",
    "ambiguous": "sets of names that these rides cannot tell apart, the likeliest first",
    "unknown": "what has no name: channel, quantity, unit, straight (in proportion), share of the energy, curve "
    "[[at, value, sd], ...], denies (causes that it shows to be none); or null",
    "ranking": "name, score of every candidate beside the causes named",
    "residuals": "per channel: mean, rms, autocorrelation, blocks, energy_share, range_share",
    "gain": "on rides held out: holdout, and per metric before, control (present parameters refitted), after, "
    "ci95 (of control less after, over rides); apart: whether these rides had no part in the choice either",
    "extended_model": "the vehicle file written, or null",
    "advice": "what to ride next",
    "notes": "what could not be used, and what was left out",
    "isolability": "signatures: channels of each candidate; same_signature: groups that differ in form alone; "
    "look_alikes: pairs and the cosine of what they do to the residuals",
    "threshold": "score that one in twenty such searches of healthy rides exceeds",
    "constancy": "whether a cause acts alike everywhere: cause, quantity, ratio (half the difference of the halves "
    "of the quantity over the mean), chi2",
    "limits": "per candidate: parameter, change, unit, energy_share: the least that would be found half the time",
}
_STAGES = ("before", "control", "after")
_ROWS = 3  # residuals and limits told in the terminal


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument("rides", nargs="*", type=Path, metavar="RIDE", help="logs, or folders of logs")
    parser.add_argument("--vehicle", default="reference", metavar="V.toml", help="vehicle file or name (%(default)s)")
    parser.add_argument(
        "--baseline",
        type=Path,
        metavar="OUT.toml",
        help="the rides are healthy: write the vehicle as they show it, and what healthy rides look "
        "like beside it; give that file as --vehicle from then on",
    )
    parser.add_argument("--payload", type=float, metavar="KG", help="rider and luggage, of rides without a rides.json")
    parser.add_argument("--report", type=Path, metavar="OUT.html", help="write a report to read")
    parser.add_argument("--json", metavar="OUT", help="write the result as JSON; - for standard output")
    parser.add_argument("--write-model", type=Path, metavar="NEW.toml", help="write the extended vehicle file")
    parser.add_argument(
        "--holdout",
        metavar="RIDE,...",
        help="rides by name that the gain is measured on; each in turn if none is named",
    )
    parser.add_argument("--effects", type=Path, metavar="DIR", help="folder with effects of your own as candidates")
    parser.add_argument("--list", action="store_true", help="print the candidates and what would show them")
    parser.add_argument("--seed", type=int, default=0, help="of the resampling of rides (%(default)s)")
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1), help="processes (%(default)s)")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    explain_keys(parser, "the", SCHEMA, KEYS)


def run(arguments: argparse.Namespace) -> int:
    """Run the command; 0 if it could answer, whatever the answer."""
    if arguments.effects and not arguments.effects.is_dir():
        raise InputError(f"--effects {arguments.effects}: no such folder")
    if arguments.list:
        print(listing(candidates(arguments.effects)))
        return 0
    logs = find_logs(arguments.rides)
    vehicle = read_vehicle(arguments.vehicle, effects_folder=arguments.effects)
    _check(arguments, logs)
    rides, refused = read_rides(logs, arguments)
    if arguments.baseline:
        return run_baseline(arguments, vehicle, rides, refused)
    refused += [f"{ride.name}: is a ride on a roller; left out" for ride in rides if "roller_speed" in ride.columns]
    rides = [ride for ride in rides if "roller_speed" not in ride.columns]
    if not rides:
        raise InputError("; ".join(refused))
    holdout = [name.strip() for name in arguments.holdout.split(",")] if arguments.holdout else None
    with _Bar(arguments.quiet) as bar:
        report = discover(vehicle, rides, arguments.seed, arguments.effects, bar.say, arguments.workers, holdout)
    report.notes[:0] = refused
    report.notes += [
        *remaining_range_error(report),
        *outlying_rides(report),
        *implausible_rides(report),
        *missing_residuals(report),
    ]
    told = write_extended(report, vehicle, arguments) if arguments.write_model else []
    if arguments.json:
        write_json(arguments.json, document(report))
    if arguments.report:
        from gz_onboard.lab.discover.page import write_report

        try:
            write_report(report, arguments.report)
        except OSError as error:
            raise InputError(f"--report {arguments.report}: cannot be written: {error.strerror}") from error
    if arguments.json != "-":
        print(summary(report, vehicle, told))
        if arguments.report:
            print(f"report       {arguments.report}")
    return 0


def run_baseline(arguments: argparse.Namespace, vehicle: Vehicle, rides: list[Samples], refused: list[str]) -> int:
    """Learn from healthy rides and write the vehicle file; 0."""
    healthy = [ride for ride in rides if on_road(ride)]
    left = [ride.name for ride in rides if not on_road(ride)]
    with _Bar(arguments.quiet) as bar:
        found = baseline(vehicle, healthy, arguments.effects, bar.say, arguments.workers)
    write_baseline(found, find_vehicle(arguments.vehicle), arguments.baseline)
    print(
        f"{arguments.baseline}: {vehicle.name} as {len(healthy)} healthy rides show it; what healthy rides look like "
        f"is in {arguments.baseline.with_suffix('.healthy.npz').name} beside it"
    )
    if left:
        print(f"left out, as no rides on a road: {', '.join(left)}")
    for text in refused:
        print(f"note: {text}")
    return 0


def _check(arguments: argparse.Namespace, logs: Sequence[Path]) -> None:
    """InputError for what cannot be, before anything takes long."""
    own = find_vehicle(arguments.vehicle).resolve()
    for option in ("baseline", "write_model"):
        out: Path | None = getattr(arguments, option)
        if out is None:
            continue
        shown = f"--{option.replace('_', '-')} {out}"
        if out.resolve() == own:
            raise InputError(f"{shown}: is the vehicle file itself; give another name")
        if out.suffix != ".toml":
            raise InputError(f"{shown}: a vehicle file is a .toml")
    for option in ("baseline", "write_model", "report", "json"):
        file = getattr(arguments, option)
        if file and str(file) != "-" and not Path(file).resolve().parent.is_dir():
            raise InputError(f"--{option.replace('_', '-')} {file}: no folder {Path(file).parent}")
    names = [stem(log) for log in logs]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(f"two rides are called {twice[0]}: rides are told apart by their names; rename one")
    for name in filter(None, (part.strip() for part in (arguments.holdout or "").split(","))):
        if name not in names:
            raise InputError(f"--holdout: no ride is called {name!r}{nearest(name, names)}")
    if arguments.holdout and len(logs) < 2:
        raise InputError("--holdout: one ride alone cannot be held out of the fit")
    if arguments.payload is not None and not 0 <= arguments.payload <= 300:
        raise InputError(f"--payload {arguments.payload:g}: must be 0 to 300 kg")


# --- rides --------------------------------------------------------------------------------------------------------


def find_logs(paths: Sequence[Path]) -> list[Path]:
    """The logs among `paths`, those of folders in the order of their names. InputError for none."""
    logs: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = sorted(p for p in path.iterdir() if p.is_file() and _is_log(p))
            if not inside:
                raise InputError(f"{path}: this folder holds no log")
            logs += inside
        elif path.is_file():
            log_suffix(path)
            logs.append(path)
        else:
            raise InputError(f"{path}: no such log")
    if not logs:
        raise InputError("no ride is given; gz-onboard discover --list prints what could be found in one")
    return logs


def _is_log(path: Path) -> bool:
    try:
        return log_suffix(path) not in ("", ".csv")  # a folder of rides has tables of their routes, too
    except InputError:
        return False


def stem(log: Path) -> str:
    """The name of the ride in a log."""
    return Path(log.name.removesuffix(".gz")).stem


@dataclass(frozen=True)
class _Reading:
    """A log to be read."""

    path: Path
    vehicle: str
    payload: float | None  # kg, where none is noted
    effects: Path | None  # folder of the user's own


def _read(task: _Reading, _: Progress) -> Samples:
    samples = read_samples(task.path, read_vehicle(task.vehicle, effects_folder=task.effects))
    if task.payload is not None and samples.rider_mass is None:
        samples = replace(samples, facts={**samples.facts, "rider_mass_kg": task.payload})
    return samples


def read_rides(logs: Sequence[Path], arguments: argparse.Namespace) -> tuple[list[Samples], list[str]]:
    """The rides, and why a log is none. InputError if no log is one."""
    from tqdm import tqdm

    tasks = [_Reading(log, arguments.vehicle, arguments.payload, arguments.effects) for log in logs]
    rides: list[Samples] = []
    refused: list[str] = []
    with tqdm(total=len(tasks), desc="reading", unit=" rides", leave=False, disable=arguments.quiet or None) as bar:
        for _, result in over_rides(_read, tasks, max(arguments.workers, 1), option="--workers"):
            if isinstance(result, InputError):
                refused.append(str(result))
            else:
                rides.append(result)
            bar.update()
    if not rides:
        raise InputError("; ".join(refused))
    return rides, refused


def on_road(ride: Samples) -> bool:
    """Whether the ride is one on the road, not on a roller and no coast-down, as far as is written down."""
    return "roller_speed" not in ride.columns and ride.facts.get("kind") != "coastdown"


class _Bar:
    """The steps of a discovery, counted and named on a terminal."""

    def __init__(self, quiet: bool) -> None:
        from tqdm import tqdm

        form = "{desc} {elapsed} {postfix}"
        self._bar = tqdm(desc="discover", bar_format=form, leave=False, disable=quiet or None, file=sys.stderr)

    def __enter__(self) -> _Bar:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def say(self, text: str) -> None:
        """Name the step that begins."""
        self._bar.set_postfix_str(text)
        self._bar.refresh()


# --- what came out ------------------------------------------------------------------------------------------------


def write_extended(report: Report, vehicle: Vehicle, arguments: argparse.Namespace) -> list[str]:
    """Write the extended model if there is anything to extend it with; what was done, in words."""
    if all(cause.varies for cause in report.causes) and report.unknown is None:
        return ["not written: there is nothing to extend it with"]
    try:
        added = write_model(report, vehicle, find_vehicle(arguments.vehicle), arguments.write_model)
    except OSError as error:
        raise InputError(f"--write-model {arguments.write_model}: cannot be written: {error.strerror}") from error
    told = [str(arguments.write_model), *added] if report.extended_model else ["not written", *added]
    if report.ambiguous:
        told.append(
            "of causes that cannot be told apart it has the likeliest: right for these rides, perhaps not for others"
        )
    return told


def document(report: Report) -> dict[str, object]:
    """The JSON: that of the report, and the limits."""
    rows = {}
    for limit in limits(report):
        known = limit.change < float("inf")
        rows[limit.name] = {
            "parameter": limit.parameter,
            "unit": limit.unit,
            "change": limit.change if known else None,
            "energy_share": limit.share if known else None,
        }
    return {**report.to_json(), "limits": rows}


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
            118,
            initial_indent="    ",
            subsequent_indent=" " * 15,
        )
        entries.append("\n".join(lines))
    return "\n\n".join(entries)


def summary(report: Report, vehicle: Vehicle, told: Sequence[str] = ()) -> str:
    """The result in the terminal. told: of the extended model."""
    way, time, drawn = size(report)
    mixed = report.mixed
    known = f"{mixed.healthy} healthy rides" if mixed and mixed.healthy else "the vehicle file alone"
    energy = f", {drawn / 3.6e6:.2f} kWh drawn" if drawn > 0 else ""
    rides = f"{len(report.lines)} ride{'s' if len(report.lines) > 1 else ''}, {way / 1e3:.1f} km in {clock(time)}"
    lines = [
        f"rides        {rides}{energy}; against {vehicle.name} as known from {known}",
        f"verdict      {report.verdict}: {VERDICTS[report.verdict]}",
    ]
    for c in report.causes:
        lines.append(
            f"  {c.name:20} {c.parameter} = {amount(c.value, c.unit)} "
            f"(95 %: {c.ci95[0]:.4g} to {c.ci95[1]:.4g}), "
            f"{c.energy_share:+.1%} of the energy, score {c.evidence:.0f}"
        )
        lines += [f"  {'':20} {name} = {value:.4g} (95 %: {ci[0]:.4g} to {ci[1]:.4g})" for name, value, ci in c.others]
        if c.varies:
            lines.append(f"  {'':20} differs from ride to ride: named, but no model is extended with it")
    for group in report.ambiguous:
        lines.append(f"  not told apart:      {', '.join(group)}")
    if report.unknown:
        u = report.unknown
        lines.append(
            f"  no name:             {words(u['channel'])} over {words(u['quantity'])}, "
            f"{u['share']:+.1%} of the energy, score {u['score']:.0f}"
        )
        if u["denies"]:
            lines.append(f"  denied:              {', '.join(u['denies'])}, which would not act alike everywhere")
    best = ", ".join(f"{name} {score:.0f}" for name, score in report.ranking[:5])
    lines.append(f"scores       {best}; healthy rides stay below {report.threshold:.0f}")
    left = residual_sizes(before_and_after(report)[0])
    largest = sorted(left.items(), key=lambda row: -abs(row[1]["energy_share"]))[:_ROWS]
    text = "; ".join(
        f"{words(name)} {r['mean']:+.3g} ± {r['rms']:.3g} {BY_NAME[name].unit} ({r['energy_share']:+.1%} of the energy)"
        for name, r in largest
    )
    lines.append(f"residuals    {text}")
    lines += _gain(report)
    seen = [limit for limit in limits(report) if 0 < limit.share < float("inf")]
    worst = sorted(seen, key=lambda limit: -limit.share)[:_ROWS]
    if worst:
        rows = ", ".join(f"{limit.name} {limit.share:.1%}" for limit in worst)
        lines.append(f"limits       the least that these rides show, of the energy: {rows}; others less")
    lines += [f"model        {word}" for word in told]
    lines += [f"next         {line}" for line in report.advice]
    lines += [f"note         {note}" for note in report.notes]
    return "\n".join(
        part for line in lines for part in (textwrap.wrap(line, 118, subsequent_indent=" " * 13) or [line])
    )


def _gain(report: Report) -> list[str]:
    lines = []
    for metric, (label, factor, unit) in METRICS.items():
        g = report.gain.get(metric)
        if isinstance(g, dict):
            before, control, after, low, high = (x * factor for x in (*(g[k] for k in _STAGES), *g["ci95"]))
            lines.append(
                f"{label:18} {before:6.3g} before, {control:6.3g} refitted, {after:6.3g} extended  {unit:6} "
                f"(gain {low:+.2g} to {high:+.2g})"
            )
    if not lines:
        return [f"held out     {report.gain.get('note', 'nothing')}"]
    head = (
        "errors on rides held out of the fit; refitted: with the parameters that the model has already; "
        "gain over that, 95 % over rides"
    )
    return [f"held out     {head}", *(f"  {line}" for line in lines)]
