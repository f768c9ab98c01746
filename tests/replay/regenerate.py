"""``python -m tests.replay.regenerate``: make today's results the golden ones, and tell what moved.

With --check nothing is written. Run it after a wanted change of the estimator or of the reference scooter's
parameters, read what it prints, and commit the files in tests/replay/golden/ with the change.
"""

from __future__ import annotations

import argparse
import sys

from tests.replay import golden


def main(argv: list[str] | None = None) -> int:
    """Give 0 if nothing moved beyond its tolerance, else 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="only tell")
    arguments = parser.parse_args(argv)
    moved = False
    for log in golden.logs():
        file = golden.golden_file(log)
        before, now = golden.read(file), golden.run(log)
        found = golden.differences(before, now, golden.TOLERANCE)
        moved |= bool(found)
        print(f"=== {log.stem}: {golden.told(found, len(now)) if found else 'as before'}")
        if not arguments.check:
            golden.write(file, now)
    return int(moved)


if __name__ == "__main__":
    sys.exit(main())
