"""``gz-onboard validate``: measured rides against their simulation, by the thesis' gate (Lord 2016, ch. 3).

Each ride is simulated twice from its measured start: open loop, with the measured throttle and brake, and with the
rider model following the measured speed. Each component is also simulated by itself, with its measured inputs. Battery
current and voltage, motor torque and speed must be within 20 % (temperatures too), components within 10 %;
`validate_score` says of what.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from gz_onboard.errors import BAD_INPUT, FAILED, OK, not_an_input, writing
from gz_onboard.lab.validate_ride import PICTURE, log_size, validate_ride
from gz_onboard.lab.validate_score import Means, PooledMeans, SimulationVerdict, ValidatedRide, channel_words, pooled
from gz_onboard.lab.validate_soc import soc_text
from gz_onboard.lab.validate_thesis import of_component
from gz_onboard.offline.processes import Task, collect, over_rides, tasks_of
from gz_onboard.options import add_shared
from gz_onboard.progress import progress_bar
from gz_onboard.reports.page import mark_of, write_below
from gz_onboard.reports.results import descriptions, write_json
from gz_onboard.vehicle import find_vehicle, read_vehicle

SUMMARY_VERSION = 1
PAGE = "validation.html"
MAKER = "gz-onboard validate"
KEYS = descriptions(SimulationVerdict) | descriptions(ValidatedRide)
"""What ``--json`` holds of a ride: {"version", "rides", "pooled": splits of all rides, "failed": [{file, error}]}."""

FORMS = {
    "open_loop": ("open loop", "the same throttle gives another ride; small errors of force add up to another speed"),
    "predictive": (
        "rider model",
        "the same speed takes another current or torque: road load, losses, or how the throttle is opened",
    ),
    "components": ("components", "with measured inputs this part is still off: its parameters or its equation"),
}
"""By entry of a ride: what people call it, and what it means if it does not pass."""

Pooled = dict[str, dict[str, dict[str, dict[str, dict[str, PooledMeans]]]]]
"""On the road or the dynamometer: by form, channel, sorting and condition."""


def pool(rides: Sequence[ValidatedRide]) -> Pooled:
    """The splits of all rides as one, apart for road and dynamometer."""
    result: Pooled = {}
    for where in ("road", "dynamometer"):
        parts: dict[tuple[str, str, str, str], list[Means]] = {}
        for ride in rides:
            if ride.on_dynamometer != (where == "dynamometer"):
                continue
            for form, channels in ride.splits.items():
                for channel, sortings in channels.items():
                    for by, kinds in sortings.items():
                        for kind, means in kinds.items():
                            parts.setdefault((form, channel, by, kind), []).append(means)
        for (form, channel, by, kind), found in parts.items():
            place = result.setdefault(where, {}).setdefault(form, {}).setdefault(channel, {}).setdefault(by, {})
            place[kind] = pooled(found)
    return result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard validate``."""
    add_shared(parser, "logs", "--vehicle", "--payload", "--output", "--json")
    parser.add_argument(
        "--markdown",
        type=Path,
        metavar="FILE",
        help=f"write the tables of the page as Markdown; in a file that has the line {mark_of(MAKER)}, below it",
    )
    add_shared(parser, "--format")
    add_shared(parser, "--no-plot", help="draw nothing and write no page")
    parser.add_argument("--gate", action="store_true", help="exit with status 1 if a ride does not pass")
    add_shared(parser, "--jobs", "--quiet")


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard validate``: `OK`; `BAD_INPUT` if a ride cannot be judged; `FAILED` if with --gate one fails."""
    tasks = tasks_of(arguments, Task, PICTURE)
    written = [arguments.json, arguments.markdown, arguments.output / PAGE]
    written += [task.drawn(PICTURE) for task in tasks]
    not_an_input(written, [*(task.path for task in tasks), find_vehicle(arguments.vehicle)])
    read_vehicle(arguments.vehicle, arguments.payload)  # its errors are none of a log's
    with writing(arguments.output):
        arguments.output.mkdir(parents=True, exist_ok=True)
    with progress_bar(lambda: sum(log_size(task.path) for task in tasks), quiet=arguments.quiet) as display:
        results = over_rides(validate_ride, tasks, arguments.jobs, display.update)
        rides, failed = collect("validate", results, display, None if arguments.json == "-" else ride_text)
    together = pool(rides)
    if rides:
        _write_tables(arguments, rides, together)
    write_json(arguments.json, SUMMARY_VERSION, {"rides": rides, "pooled": together, "failed": failed})
    if failed:
        return BAD_INPUT
    return FAILED if arguments.gate and not all(ride.passed for ride in rides) else OK


def _write_tables(arguments: argparse.Namespace, rides: list[ValidatedRide], together: Pooled) -> None:
    from gz_onboard.lab.validate_report import markdown, write_report

    written = []
    with writing(arguments.output):
        if not arguments.no_plot:
            written.append(arguments.output / PAGE)
            write_report(written[-1], rides, together)
        if arguments.markdown:
            written.append(arguments.markdown)
            write_below(arguments.markdown, MAKER, markdown(rides))
    if arguments.json != "-" and written:
        print(f"written: {', '.join(map(str, written))}")


def _energy_text(verdict: SimulationVerdict) -> str:
    """The energy of a simulated ride, and where its pack was empty."""
    energy, end = verdict.energy_percent, verdict.pack_empty
    known = "" if energy is None else f"energy {energy:+.1f} %"
    if not end:
        return known
    return f"{known} until {end.compared_s:.0f} s; the simulated pack is empty at {end.time_s:.0f} s".strip()


def ride_text(ride: ValidatedRide) -> str:
    """A ride's entry for a terminal."""
    where = "dynamometer" if ride.on_dynamometer else "road"
    air = "" if ride.ambient_c is None else f", {ride.ambient_c:.0f} degC"
    lines = [
        f"{ride.file}: {'passed' if ride.passed else 'not passed'}",
        f"  {where}, {ride.kind or 'kind not noted'}, {ride.distance_km:.2f} km, {ride.duration_s:.0f} s, "
        f"{ride.payload_kg:g} kg{air}",
    ]
    for form, (name, meaning) in FORMS.items():
        verdict = ride.verdicts.get(form)
        if not verdict:
            continue
        lines.append(f"  {name:12} {_energy_text(verdict) if isinstance(verdict, SimulationVerdict) else ''}")
        for channel, e in verdict.channels.items():
            percent = "–" if e.percent is None else f"{e.percent:5.1f} %"
            spread = "" if e.of_spread is None else f", {e.of_spread:.2f} of its spread"
            outcome = f"{'ok' if e.passed else 'FAIL'} (limit {e.limit_percent:g} %)"
            thesis = of_component(channel) if form == "components" else ""
            lines.append(
                f"    {channel_words(channel):21} {percent} {outcome:17} "
                f"rms {e.rms:7.2f}, max {e.max:7.2f}, mean {e.mean_error:+7.2f} {e.unit}{spread}"
                f"{f'; {thesis}' if thesis else ''}"
            )
        if not verdict.passed:
            lines.append(f"    FAIL: {meaning}")
    if ride.soc_reference:
        lines.append(f"  state of charge: {soc_text(ride.soc_reference)}")
    if not ride.passed:
        lines.append("  what each percentage is of, and where the model is known to fail: docs/results/validation.md")
    return "\n".join([*lines, *(f"  {text}" for text in ride.missing)])
