"""``python -m benchmarks.recovery [--seeds N]``: how often the intervals of cells and cooling networks hold the truth.

The tests' own plants and draws (tests/lab/calibrate), over more seeds than a test has time for: for each parameter the
share within 1.96 of its stated standard deviations, as docs/calibration.md has it. 60 seeds take some ten minutes.
"""

from __future__ import annotations

import argparse

import numpy as np

from tests.lab.calibrate import test_cooling, test_pulse
from tests.lab.calibrate.cells import MANY

ONE = ((0.03, 30.0),)


def main() -> None:
    """Print a line for each parameter."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=60, metavar="N")
    count = parser.parse_args().seeds
    for procedure in test_cooling.UNTOLD:
        tell(procedure.__name__, [test_cooling.away(procedure, seed) for seed in range(count)])
    for what, method, pairs in (("one pair", "direct", ONE), ("one pair", "reduced", ONE), ("many", "reduced", MANY)):
        for scatter in (0.02, 0.05):
            found = [test_pulse.away(seed, method, pairs, scatter) for seed in range(max(count // 3, 1))]
            tell(f"{method}, {what}, scatter {scatter:.0%}", found)


def tell(what: str, found: list[dict[str, object]]) -> None:
    """A line for each of the names in `found`, how far from the truth in sd, of one seed each."""
    for name in found[0]:
        z = np.array([x[name] for x in found])
        within = np.abs(z) < 1.96
        print(f"{what:36s} {name:26s} {within.mean():6.1%} of {z.size}  (sd of z {z.std():.2f})", flush=True)


if __name__ == "__main__":
    main()
