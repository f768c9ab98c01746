"""Write calibrate's data and the keys of each JSON result at the end of docs/reference/commands.md.

python docs/reference.py    # writes them anew
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from gz_onboard.calibration import report
from gz_onboard.calibration.command import plain_options
from gz_onboard.calibration.procedures import PROCEDURES
from gz_onboard.discovery.result import VERSION as DISCOVER_VERSION
from gz_onboard.discovery.result import Report
from gz_onboard.lab import estimate, validate
from gz_onboard.offline.schema import descriptions
from gz_onboard.simulation import summary as simulated
from gz_onboard.vehicle_check.check import CHECK_VERSION, Checked

PAGE = Path(__file__).parent / "reference" / "commands.md"
MARK = "<!-- made by docs/reference.py from here on -->"
RESULTS: tuple[tuple[str, int, Mapping[str, str]], ...] = (
    ("estimate: a ride", estimate.SUMMARY_VERSION, estimate.KEYS),
    ("simulate", simulated.SUMMARY_VERSION, simulated.KEYS),
    ("validate: a ride", validate.SUMMARY_VERSION, validate.KEYS),
    ("calibrate", report.VERSION, report.KEYS),
    ("discover", DISCOVER_VERSION, descriptions(Report)),
    ("vehicle check: a log", CHECK_VERSION, descriptions(Checked)),
)


def tables() -> Iterator[str]:
    """The lines behind the mark."""
    yield "\n## Data of calibrate\n"
    for name, procedure in PROCEDURES.items():
        yield f"- `{name}`: {procedure.what}"
        for slot, data in procedure.slots.items():
            key = "`DATA`" if slot == "data" else f"`--with {slot}=FILE`"
            yield f"  - {key}: {data.what}{'' if data.least else ' (may be left out)'}"
        yield from (f"  - `--set {option}={value}`" for option, value in plain_options(procedure).items())
    yield "\n## Keys of JSON results"
    for of, version, keys in RESULTS:
        yield f"\n### {of}\n\nVersion {version}.\n\n| key | meaning |\n| --- | --- |"
        yield from (f"| `{key.strip()}` | {escaped(text)} |" for key, text in keys.items())


def escaped(text: str) -> str:
    """A text as a cell of a table holds it."""
    return text.replace("|", "\\|").replace("<", "&lt;")


def page() -> str:
    """The page with what is behind the mark made anew."""
    head, mark, _ = PAGE.read_text(encoding="utf-8").partition(MARK)
    return "\n".join([head + mark, *tables(), ""])


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
