"""``python -m benchmarks.recovery``: how often the intervals of cells and cooling networks hold the truth.

The tests' own plants and draws (tests/calibration), over more seeds than a test has time for: for each parameter the
share within 1.96 of its stated standard deviations (docs/results/calibration.md). The seeds of the tests begin at 0.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any

import numpy as np

from tests.calibration import test_cooling, test_pulse
from tests.calibration.cells import MANY, SLOW

CELLS = {"one pair": ((0.03, 30.0),), "four pairs": MANY, "strong slow pair": SLOW}
SCATTER = 0.03


def main() -> None:
    """Print a line for each parameter."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=1000, metavar="SEED")
    parser.add_argument("--cells", type=int, default=20, metavar="N", help="sets of pulse tests of each cell")
    parser.add_argument("--networks", type=int, default=60, metavar="N", help="sets of runs of each cooling network")
    given = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with ProcessPoolExecutor() as pool:

        def counted(what: str, away: Callable[[int], dict[str, Any]], count: int) -> None:
            tell(what, list(pool.map(away, range(given.first, given.first + count))))

        for what, pairs in CELLS.items():
            counted(what, partial(test_pulse.away, pairs=pairs, scatter=SCATTER), given.cells)
        for procedure in test_cooling.FROM_PRIORS:
            counted(procedure.__name__, partial(test_cooling.away, procedure), given.networks)


def tell(what: str, found: list[dict[str, Any]]) -> None:
    """A line for each of the names in `found`, how far from the truth in sd, of one seed each."""
    if not found:
        return
    for name in found[0]:
        z = np.array([x[name] for x in found])
        within = np.abs(z) < 1.96
        print(
            f"{what:28s} {name:26s} {within.mean():6.1%} of {z.size:4d}   z {z.mean():+.2f} ± {z.std():.2f}", flush=True
        )


if __name__ == "__main__":
    main()
