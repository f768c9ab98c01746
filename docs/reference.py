"""Write the reference pages that the code defines: commands, parameters, range frames.

python docs/reference.py [FOLDER]    # default: docs/generated, as `make docs` does
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import cantools
from cantools.database.can import Message

from gz_onboard.calibration import report
from gz_onboard.calibration.cooling import AIRFLOWS
from gz_onboard.calibration.procedures import PROCEDURES
from gz_onboard.cli import COMMANDS, command_line
from gz_onboard.discovery.judgement import VERSION as DISCOVER_VERSION
from gz_onboard.discovery.judgement import Report
from gz_onboard.estimation.summary import KEYS, SUMMARY_VERSION
from gz_onboard.model.effect import QUANTITIES, VEHICLE_PARAMETERS, Parameter, package_effects
from gz_onboard.model.parameters import BATTERY_PARAMETERS, SIMULATION_PARAMETERS
from gz_onboard.reports.results import descriptions
from gz_onboard.simulation import summary as simulated
from gz_onboard.validation import command as validation
from gz_onboard.vehicle_check.check import CHECK_VERSION, Checked

ROOT = Path(__file__).resolve().parents[1]
RESULTS: tuple[tuple[str, int, Mapping[str, str]], ...] = (
    ("estimate: a ride", SUMMARY_VERSION, KEYS),
    ("simulate", simulated.SUMMARY_VERSION, simulated.KEYS),
    ("validate: a ride", validation.SUMMARY_VERSION, validation.KEYS),
    ("calibrate", report.VERSION, report.KEYS),
    ("discover", DISCOVER_VERSION, descriptions(Report)),
    ("vehicle check: a log", CHECK_VERSION, descriptions(Checked)),
)


def commands() -> Iterator[str]:
    """Help of each command, data of calibrate, keys of JSON results."""
    os.environ["COLUMNS"] = "110"  # argparse breaks its lines there
    yield "# Commands\n\nEvery command with its options, as `gz-onboard COMMAND --help` prints it."
    parser = command_line(COMMANDS)
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, command in action.choices.items():
                yield f"\n## {name}\n\n```text\n{command.format_help().strip()}\n```"
    yield f"\n## Exit status\n\n```text\n{parser.epilog}\n```\n\n## Data of calibrate\n"
    for name, procedure in PROCEDURES.items():
        yield f"- `{name}`: {procedure.what}"
        for slot, data in procedure.slots.items():
            key = "`DATA`" if slot == "data" else f"`--with {slot}=FILE`"
            yield f"  - {key}: {data.what}{'' if data.min_files else ' (optional)'}"
        for option, value in procedure.options.items():
            yield f"  - `--set {option}={value or '|'.join((*AIRFLOWS, 'M/S'))}`"
    yield "\n## Keys of JSON results"
    for of, version, keys in RESULTS:
        yield f"\n### {of}\n\nVersion {version}.\n"
        yield from table(["key", "meaning"], [(f"`{key.strip()}`", text) for key, text in keys.items()])


def vehicle() -> Iterator[str]:
    """Parameters with unit, prior, bounds and source; quantities that an effect may read."""
    yield "# Parameters and effects\n\nEvery parameter of a vehicle file: prior for a scooter, bounds for any vehicle."
    yield "\n## Vehicle\n"
    yield from parameters(VEHICLE_PARAMETERS)
    yield "\n## Battery\n"
    yield from parameters(BATTERY_PARAMETERS)
    yield "\n## Simulation\n"
    yield from parameters(SIMULATION_PARAMETERS)
    for name, module in package_effects().items():
        yield f"\n## {name}\n\n{(module.__doc__ or '').strip()}\n"
        yield from parameters(module.PARAMETERS)
    yield "\n## Quantities\n\nArguments that the `term` of an effect may have.\n"
    yield from table(["quantity", "unit and meaning"], [(f"`{name}`", text) for name, text in QUANTITIES.items()])


def parameters(some: Iterable[Parameter]) -> Iterator[str]:
    """A table with a row for each parameter."""
    rows = [
        (
            f"`{p.name}`{' (required)' if p.required else ''}",
            p.unit,
            f"{p.prior:g} ± {p.prior_sd:g}",
            f"{p.low:g} to {p.high:g}",
            p.source,
        )
        for p in some
    ]
    yield from table(["parameter", "unit", "prior", "bounds", "source"], rows)


def range_frames() -> Iterator[str]:
    """Messages and signals of dbc/range.dbc."""
    database = cantools.database.load_file(ROOT / "dbc" / "range.dbc")
    yield "# Signals of the range frames\n\nEvery message and signal of `dbc/range.dbc`."
    for message in database.messages:
        assert isinstance(message, Message)
        yield f"\n## {message.name}\n\n0x{message.frame_id:X}, {message.length} bytes. {message.comment or ''}\n"
        rows = [
            (
                f"`{signal.name}`",
                f"{signal.start}, {signal.length}",
                f"{signal.scale:g}, {signal.offset:g}",
                signal.unit or "",
                signal.comment or ", ".join(f"{number} {name}" for number, name in (signal.choices or {}).items()),
            )
            for signal in message.signals
        ]
        yield from table(["signal", "first bit, bits", "factor, offset", "unit", "meaning"], rows)


def table(head: list[str], rows: Iterable[tuple[str, ...]]) -> Iterator[str]:
    """A Markdown table."""
    for row in (head, ["---"] * len(head), *rows):
        yield "| " + " | ".join(" ".join(cell.split()).replace("|", "\\|").replace("<", "&lt;") for cell in row) + " |"


def write_pages(folder: Path) -> None:
    """Write all pages into the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, lines in {"commands": commands(), "vehicle": vehicle(), "range-frames": range_frames()}.items():
        (folder / f"{name}.md").write_text("\n".join([*lines, ""]), encoding="utf-8")


if __name__ == "__main__":
    write_pages(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "generated")
