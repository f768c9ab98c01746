"""Run every kind with its full count, one process per processor; rewrites docs/results/reliability.md."""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from os import cpu_count
from pathlib import Path

from tests.hardening import Report, config, cuts, flips, frames, liars

KINDS = {"config": config, "cuts": cuts, "flips": flips, "frames": frames, "liars": liars}
PAGE = Path(__file__).resolve().parents[2] / "docs" / "results" / "reliability.md"
BEGIN, END = "<!-- measured by make hardening: begin -->\n", "<!-- end -->\n"


def run_kind(name: str, share: float, seed: int) -> Report:
    """One kind, with this `share` of its full count."""
    kind = KINDS[name]
    report: Report = kind.run(max(round(kind.FULL_COUNT * share), 1), seed)
    return report


def table(name: str, report: Report) -> str:
    """The measured quantities of a kind in Markdown."""
    rows = {**report.rows, "cases that broke a promise": len(report.failures)}
    text = "".join(f"| {what} | {value} |\n" for what, value in rows.items())
    return f"\n## {KINDS[name].TITLE}\n\n| what | measured |\n| --- | --- |\n{text}"


def main() -> int:
    """Run, print, and write the page if all kinds have run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1000, help="of the cases (%(default)d; the tests use 1)")
    parser.add_argument("--share", type=float, default=1.0, help="of the full counts (%(default)g)")
    parser.add_argument("--kind", action="append", choices=KINDS, help="only this one, printed")
    arguments = parser.parse_args()
    text, failures = f"\nSeed {arguments.seed}, {arguments.share:.0%} of the full counts.\n", 0
    with ProcessPoolExecutor(cpu_count()) as pool:
        names = arguments.kind or list(KINDS)
        for name, job in [(name, pool.submit(run_kind, name, arguments.share, arguments.seed)) for name in names]:
            report = job.result()
            text += table(name, report)
            failures += len(report.failures)
            print(table(name, report), *(f"FAILED {failure}" for failure in report.failures[:20]), sep="\n")
    if not arguments.kind:
        before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
        PAGE.write_text(before + BEGIN + text + "\n" + END + rest.partition(END)[2], encoding="utf-8")
        print(f"written: {PAGE}")
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
