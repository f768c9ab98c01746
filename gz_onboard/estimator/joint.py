"""A Kalman filter of several quantities with their whole covariance, in plain floats: on board there is no numpy."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, sqrt

ROUNDING = 1e-6  # relative: by which a saved covariance may not be one


class Joint:
    """Means and covariance (n × n, as rows). Quantities are told by their number."""

    def __init__(self, means: Sequence[float], variances: Sequence[float]) -> None:
        """Quantities that are not tied yet."""
        self.means = list(means)
        self.rows = [[v if i == j else 0.0 for j in range(len(variances))] for i, v in enumerate(variances)]

    def copy(self) -> Joint:
        """Another of its own."""
        new = Joint((), ())
        new.means, new.rows = self.means.copy(), [row.copy() for row in self.rows]
        return new

    def variance(self, i: int) -> float:
        """Of one quantity."""
        return self.rows[i][i]

    def widen(self, i: int, variance: float, most: float) -> None:
        """One quantity has changed by what has a `variance`; it is never less known than by `most`."""
        own = self.rows[i][i]
        self.rows[i][i] = max(min(own + variance, most), own)

    def update(self, slopes: Sequence[float], residual: float, noise: float, most: float) -> float:
        """Take in a measurement that is off by `residual`, of which at most `most` sd are believed.

        slopes: of it over each quantity; noise: its variance. Gives the square of the residual over its variance.
        """
        gains = [sum(p * h for p, h in zip(row, slopes, strict=True) if h) for row in self.rows]
        total = noise + sum(g * h for g, h in zip(gains, slopes, strict=True))
        taken = min(max(residual, -most * sqrt(total)), most * sqrt(total))
        for i, row in enumerate(self.rows):
            share = gains[i] / total
            if share:
                self.means[i] += share * taken
                self.rows[i] = [p - share * g for p, g in zip(row, gains, strict=True)]
        return residual * residual / total

    def snapshot(self) -> dict[str, list[float]]:
        """Means, and the covariance up to its diagonal, row by row."""
        return {"means": self.means.copy(), "rows": [x for i, row in enumerate(self.rows) for x in row[: i + 1]]}

    def restored(self, means: Sequence[float], rows: Sequence[float]) -> Joint:
        """As many quantities from a snapshot; TypeError or ValueError if it is none."""
        n, new = len(self.means), self.copy()
        given, lower = [float(x) for x in means], [float(x) for x in rows]
        if len(given) != n or len(lower) != n * (n + 1) // 2 or not all(map(isfinite, (*given, *lower))):
            raise ValueError("holds a covariance of another form")
        new.means, place = given, 0
        for i in range(n):
            for j in range(i + 1):
                new.rows[i][j] = new.rows[j][i] = lower[place]
                place += 1
        for i in range(n):
            for j in range(i + 1):
                if new.rows[i][j] ** 2 > new.rows[i][i] * new.rows[j][j] * (1 + ROUNDING) or new.rows[i][i] < 0:
                    raise ValueError("holds an impossible covariance")
        return new
