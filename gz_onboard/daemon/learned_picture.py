"""What was learned, as a picture: each as a factor on what the vehicle file says, by what it is of."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from gz_onboard.estimator.ageing import Learned

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SOME = 0.05  # of what can be learned: less is drawn as unknown
WIDEST = (0.0, 2.0)  # of the axis, unless a factor itself is beyond: what is next to unknown would squeeze the rest
ROOM = 0.05  # beside a factor that is beyond
KNOWN, UNKNOWN, FAINT = "#0072b2", "#999999", 0.3
CALLED = {  # by name, which stands before it
    "capacity": "of the pack",
    "resistance": "of the cells",
    "weak_charge": "weakest group, when the mean cell is full",
    "weak_capacity": "weakest group",
    "weak_resistance": "weakest group",
    "payload": "mass of rider and luggage",
    "rolling": "resistance over weight",
    "drag": "area",
    "auxiliaries": "power, lights and all",
    "price": "energy of a km in motion",
    "standing": "energy at stops",
    "pace": "time of a km",
    "factor": "measured over modelled energy",
    "terrain": "height that roads climb or fall for good",
}
Row = tuple[str, Learned | None]  # None: a heading


def draw_learned(
    file: Path,
    vehicle: str,
    battery: Mapping[str, Learned],
    road: Mapping[str, Learned],
    riders: Mapping[str, Mapping[str, Learned]],
) -> None:
    """Write the picture: each factor with two standard deviations. Raises OSError."""
    from matplotlib.figure import Figure

    rows = list(rows_of(battery, road, riders))
    figure = Figure(figsize=(9, 1 + 0.36 * len(rows)), layout="constrained")
    axes = figure.subplots()
    low, high = limits(x for _, x in rows if x)
    for place, (_, x) in enumerate(rows):
        if x:
            _draw(axes, place, x, (low, high))
    axes.axvline(1.0, color="black", linewidth=0.8)
    axes.set_yticks(range(len(rows)), [text for text, _ in rows])
    for tick, (_, x) in zip(axes.yaxis.get_major_ticks(), rows, strict=True):
        if x is None:
            tick.label1.set_fontweight("bold")
            tick.tick1line.set_visible(False)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xlim(low, high)
    axes.set(title=f"What was learned of {vehicle}")
    axes.set_xlabel(
        "over what the vehicle file says, or the payload entered\nbars: ± 2 sd; arrows: wider than the picture"
    )
    axes.grid(axis="x", alpha=FAINT)
    figure.savefig(file, dpi=120)


def rows_of(
    battery: Mapping[str, Learned], road: Mapping[str, Learned], riders: Mapping[str, Mapping[str, Learned]]
) -> Iterator[Row]:
    """Labels, in groups below headings, and what is drawn beside them. Terrain is of the roads, whoever rides."""
    roads = {name: x for found in riders.values() for name, x in found.items() if name == "terrain"}
    riding = {
        f"riding, {rider or 'rider not known'}" if len(riders) > 1 else "riding": {
            name: x for name, x in found.items() if name not in roads
        }
        for rider, found in riders.items()
    }
    for heading, group in {"battery": battery, "road load": road, **riding, "roads, whoever rides": roads}.items():
        if group:
            yield heading, None
            yield from ((f"{name.replace('_', ' ')}: {CALLED[name]}", x) for name, x in group.items())


def limits(factors: Iterable[Learned]) -> tuple[float, float]:
    """Of the axis: all factors are within."""
    values = [x.value for x in factors]
    return min(WIDEST[0], min(values, default=1.0) - ROOM), max(WIDEST[1], max(values, default=1.0) + ROOM)


def _draw(axes: Axes, place: int, x: Learned, within: tuple[float, float]) -> None:
    colour = KNOWN if x.share > SOME else UNKNOWN
    axes.errorbar(x.value, place, xerr=2 * x.sd, fmt="o", color=colour, capsize=3)
    for end, beyond, arrow in (
        (within[0], x.value - 2 * x.sd < within[0], "<"),
        (within[1], x.value + 2 * x.sd > within[1], ">"),
    ):
        if beyond:
            axes.plot(end, place, arrow, color=colour, clip_on=False)
    axes.annotate(
        f"{100 * x.share:.0f} % learned" if x.share else "nothing learned",
        (1.0, place),
        (8, 0),
        xycoords=("axes fraction", "data"),
        textcoords="offset points",
        va="center",
        fontsize=8,
    )
