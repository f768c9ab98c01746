"""``python -m tests.replay.regenerate [NAME...]``: make today's results the golden ones, and tell what moved.

NAME is that of a ride in replay_logs/, without .blf; without any, all of them. With --check nothing is written.
Run it after a wanted change of the estimator or of the reference scooter's parameters, read what it prints, and
commit the files in tests/replay/golden/ with the change.
"""

from __future__ import annotations

import argparse
import sys

from gz_onboard.errors import nearest
from tests.replay import golden


def main(argv: list[str] | None = None) -> int:
    """Give 0 if nothing moved beyond its tolerance, else 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--check", action="store_true", help="only tell")
    arguments = parser.parse_args(argv)
    logs = {log.stem: log for log in golden.logs()}
    for name in arguments.names:
        if name not in logs:
            parser.error(f"no ride {name} in {golden.LOGS}{nearest(name, logs)}")
    moved = False
    for name in arguments.names or logs:
        file = golden.golden_file(logs[name])
        before, now = golden.read(file), golden.run(logs[name])
        found = golden.differences(before, now, golden.TOLERANCE)
        moved |= bool(found)
        if not before:
            print(f"=== {name}: {len(now)} rows, none before")
        else:
            print(f"=== {name}: {golden.told(found, len(now)) if found else 'as before'}")
        if not arguments.check:
            golden.write(file, now)
    return int(moved)


if __name__ == "__main__":
    sys.exit(main())
