"""Run every kind with its full count, one process per processor; rewrites docs/results/reliability.md."""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from os import cpu_count
from pathlib import Path

from tests.hardening.kinds import kinds
from tests.hardening.report import Report

PAGE = Path(__file__).resolve().parents[2] / "docs" / "results" / "reliability.md"
BEGIN, END = "<!-- measured by make hardening: begin -->\n", "<!-- end -->\n"


def run_kind(name: str, share: float, seed: int) -> tuple[str, Report, float]:
    """One kind, with this `share` of its full count."""
    began = time.monotonic()
    kind = kinds()[name]
    report = kind.run(max(round(kind.FULL_COUNT * share), 1), seed)
    return name, report, time.monotonic() - began


def tables(reports: dict[str, Report], seed: int, share: float) -> str:
    """The tables in Markdown."""
    text = f"\nSeed {seed}, {share:.0%} of the full counts.\n"
    return text + "".join(table(name, report) for name, report in reports.items()) + "\n"


def table(name: str, report: Report) -> str:
    """One of them."""
    text = f"\n## {kinds()[name].TITLE}\n\n| what | measured |\n| --- | --- |\n"
    text += "".join(f"| {what} | {value} |\n" for what, value in report.rows.items())
    return text + f"| cases that broke a promise | {len(report.failures)} |\n"


def replaced(page: str, name: str, report: Report) -> str:
    """The page with this kind's table as it is now."""
    before, title, rest = page.partition(f"\n## {kinds()[name].TITLE}\n")
    end = min((at for at in (rest.find("\n## "), rest.find("\n" + END)) if at >= 0), default=len(rest))
    return before + table(name, report) + rest[end:] if title else page


def main() -> int:
    """Run, print, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1000, help="of the cases (%(default)d; the tests use 1)")
    parser.add_argument("--share", type=float, default=1.0, help="of the full counts (%(default)g)")
    parser.add_argument(
        "--kind", action="append", choices=sorted(kinds()), help="only this one, and its table of the page"
    )
    arguments = parser.parse_args()
    names = arguments.kind or sorted(kinds())
    reports: dict[str, Report] = {}
    with ProcessPoolExecutor(cpu_count()) as pool:
        for job in [pool.submit(run_kind, name, arguments.share, arguments.seed) for name in names]:
            name, report, seconds = job.result()
            reports[name] = report
            print(f"\n{kinds()[name].TITLE} ({seconds:.0f} s)")
            for what, value in report.rows.items():
                print(f"  {what}: {value}")
            for failure in report.failures[:20]:
                print(f"  FAILED {failure}")
    if PAGE.exists():
        page = PAGE.read_text(encoding="utf-8")
        if arguments.kind:
            for name, report in reports.items():
                page = replaced(page, name, report)
        else:
            before, _, rest = page.partition(BEGIN)
            page = before + BEGIN + tables(reports, arguments.seed, arguments.share) + END + rest.partition(END)[2]
        PAGE.write_text(page, encoding="utf-8")
        print(f"\nwritten: {PAGE}")
    return any(report.failures for report in reports.values())


if __name__ == "__main__":
    sys.exit(main())
