"""What is left of each residual before and after the causes: sensors' biases, wind and the like of each ride taken off.

A residual as measured holds what is no error of the vehicle's model: the accelerometer's mounting angle alone makes
some newtons of road force. So all parameters are fitted together, those of the causes free; then everything but the
causes is taken off for "before", and the causes too for "after".
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.discovery.blocks import over_blocks
from gz_onboard.discovery.linear import LinearChannel, LinearRide, Posterior
from gz_onboard.discovery.verdict import Discovery
from gz_onboard.discovery.wording import readable

FINEST = 25  # bins of the least width that are the span of a quantity
OUTSTANDING = 3.5  # standard deviations of what differs between healthy rides
STILL = 0.99  # of a block
LOADED = 2.0  # standard deviations of the auxiliary power of the file, beyond which its median is another

COVARIATES: dict[str, tuple[str, str]] = {
    "speed": ("speed", "m/s"),
    "acceleration": ("acceleration", "m/s²"),
    "lateral_acceleration": ("lateral acceleration, left positive", "m/s²"),
    "grade": ("grade", "1"),
    "heading": ("heading, clockwise from north", "rad"),
    "ambient_temperature": ("air", "degC"),
    "motor_temperature": ("motor", "degC"),
    "cell_temperature": ("cells", "degC"),
    "soc": ("state of charge", "1"),
    "pack_current": ("pack current", "A"),
    "motor_current": ("motor current", "A"),
    "time": ("time since the start", "s"),
    "since_change": ("time since the current changed", "s"),
    "since_braking": ("time since a brake was touched", "s"),
    "suspension_speed": ("speed of the suspension", "m/s"),
    "vibration": ("vibration: how rough the road is", "m/s²"),
}
"""What residuals are looked at over: words and unit."""


def before_and_after(found: Discovery) -> tuple[list[LinearRide], list[LinearRide]]:
    """The rides of `found` with residuals before and after its causes."""
    index, post = fitted(found)
    before, after = [], []
    for line, own in zip(found.lines, post.own, strict=True):
        theta = post.mean + own
        rest = theta.copy()
        rest[index] = found.mixed.mean[index] + own[index]
        before.append(line.seen_from(-rest))
        after.append(line.seen_from(-theta))
    return before, after


def fitted(found: Discovery) -> tuple[list[int], Posterior]:
    """Where the parameters of the causes are, and all parameters as the rides show them with these free."""
    index = found.mixed.index(name for cause in found.report.causes for name in cause.parameters)
    return index, found.mixed.freed(index).fit(found.normals)


def outlying_rides(found: Discovery) -> list[str]:
    """What differs in single rides by more than `OUTSTANDING` of what healthy rides scatter by, a sentence for each.

    No cause is common to them; it may be the day, such as wind, or the ride.
    """
    mixed = found.mixed
    index, post = fitted(found)
    sentences = []
    for line, own in zip(found.lines, post.own, strict=True):
        beyond = own / np.sqrt(mixed.scatter)
        beyond[index] = 0.0
        rows = [(abs(z), name, z) for name, z in zip(mixed.names, beyond, strict=True) if abs(z) > OUTSTANDING]
        if rows:
            most = ", ".join(f"{readable(name)} {z:+.1f}" for _, name, z in sorted(rows, reverse=True)[:3])
            sentences.append(f"{line.ride.name} is an outlier: {most} standard deviations")
    return sentences


def loads_by_ride(found: Discovery) -> list[str]:
    """What the pack gives at standstill, of rides that show loads by its power only, where most give other than the
    file says: a heater or an air conditioner that differs from ride to ride is no cause, but it is there.
    """
    known, rows = found.mixed.vehicle.parameters.known["auxiliary_power"], []
    for line in found.lines:
        if (table := line.tables.get("pack_power")) is None:
            continue
        still = over_blocks(table.channel, line.ride.standing.astype(float))[table.used] > STILL
        if still.any() and "auxiliary_current" not in line.ride.have:
            rows.append(known.value + float(np.mean((table.y * table.unit)[still])))
    if not rows or abs(float(np.median(rows)) - known.value) < LOADED * known.sd:
        return []
    return [
        f"at standstill these rides take {np.median(rows):.0f} W, {min(rows):.0f} to {max(rows):.0f} W from ride to "
        f"ride; the file has {known.value:.0f} ± {known.sd:.0f} W of auxiliary power. A heater or an air conditioner "
        "would do that; with its power in [roles] it is taken off"
    ]


def over(line: LinearRide, name: str, table: LinearChannel) -> Array | None:
    """The quantity `name` of `COVARIATES` over the blocks in `table`, (m,); None if the ride has it not."""
    values = line.ride.quantities.get(name) if line.ride.shows(name) else None
    return None if values is None else over_blocks(table.channel, values)[table.used]


def pooled(lines: Sequence[LinearRide], channel: str, name: str) -> tuple[Array, Array]:
    """(quantity, residual in the channel's unit) of all blocks, each (m,)."""
    xs, ys = [np.zeros(0)], [np.zeros(0)]
    for line in lines:
        table = line.tables.get(channel)
        x = over(line, name, table) if table is not None else None
        if table is not None and x is not None:
            xs.append(x)
            ys.append(table.y * table.unit)
    return np.concatenate(xs), np.concatenate(ys)


def edges(x: Array, count: int = 12) -> Array:
    """Edges of `count` bins of as many of `x`, fewer where many are alike: none is narrower than a 25th of the span."""
    at = np.quantile(x, np.linspace(0, 1, count + 1))
    least = (np.quantile(x, 0.98) - np.quantile(x, 0.02)) / FINEST
    kept = [at[0]]
    for edge in at[1:-1]:
        if edge - kept[-1] >= least and at[-1] - edge >= least:
            kept.append(edge)
    return np.array([*kept, at[-1]])


def binned(x: Array, y: Array, at: Array) -> Array:
    """Rows (mean of x, mean of y, its standard error, blocks) of the bins between `at` that hold more than 3 blocks."""
    place = np.clip(np.searchsorted(at, x, side="right") - 1, 0, max(len(at) - 2, 0))
    rows = []
    for i in range(max(len(at) - 1, 1)):
        inside = place == i
        if (count := int(inside.sum())) > 3:
            rows.append((x[inside].mean(), y[inside].mean(), y[inside].std() / np.sqrt(count), count))
    return np.array(rows).reshape(-1, 4)


def share_over(x: Array, y: Array) -> float:
    """The share of the variance of `y` that goes with `x`: correlation ratio of its bins, less what chance gives."""
    if len(x) < 30 or np.ptp(x) == 0 or np.std(y) == 0:
        return 0.0
    rows = binned(x, y, edges(x))
    if len(rows) < 2:
        return 0.0
    mean = np.average(rows[:, 1], weights=rows[:, 3])
    between = float(np.average((rows[:, 1] - mean) ** 2, weights=rows[:, 3])) / float(np.var(y))
    return max(0.0, between - (len(rows) - 1) / len(x))
