"""The charts of a ride's page: HTML around the pictures of `report_svg`."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite

from gz_onboard.lab.report_svg import GRAIN, Axis, axis_of, band, line, picture, stretches

Values = Sequence[float]


@dataclass(frozen=True)
class ChartLine:
    """A line in a chart with its own abscissae. colour: a class of the page; band: its lower and upper end."""

    name: str
    x: Values
    y: Values
    colour: str
    band: tuple[Values, Values] | None = None
    dashed: bool = False
    scales: bool = True  # whether the ordinate has to hold it


@dataclass(frozen=True)
class Abscissa:
    """The axis below a chart and its unit."""

    axis: Axis
    unit: str


def chart(title: str, unit: str, curves: Sequence[ChartLine], below: Abscissa, *, zero: bool = True) -> str:
    """A figure with `curves` over `below`; zero: whether 0 is on the ordinate. Nothing without a known value."""
    curves = [curve for curve in curves if any(map(isfinite, curve.y))]
    if not curves:
        return ""
    shown = [column for curve in curves if curve.scales for column in (curve.y, *(curve.band or ()))]
    up = axis_of((value for column in shown for value in column), zero=zero)
    paths = [("grid", _grid(up))]
    for curve in curves:
        if curve.band:
            paths.append((f"band {curve.colour}", band(curve.x, *curve.band, below.axis, up)))
    for curve in curves:
        classes = "dashed" if curve.dashed else f"line {curve.colour}"
        paths.append((classes, line(curve.x, curve.y, below.axis, up)))
    heights = "".join(
        f'<span class="y" style="top:{100 - 100 * up.at(tick) / GRAIN:.4g}%">{up.text(tick)}</span>'
        for tick in up.ticks
    )
    # One line of its own title needs no key.
    keys = "" if len(curves) == 1 and not curves[0].name else "".join(map(_key, curves))
    return (
        f'<figure><figcaption><b>{html.escape(title)}</b> <span class="unit">{html.escape(unit)}</span>{keys}'
        f'</figcaption><div class="plot">{picture(title, *paths)}{heights}{_feet(below)}</div></figure>'
    )


def strip(name: str, boxes: Sequence[tuple[str, Sequence[tuple[float, float]]]], below: Axis) -> str:
    """A line of boxes over time, of spans (begin, length) by colour; name: HTML."""
    paths = [(f"box {colour}", stretches(spans, below)) for colour, spans in boxes]
    return f'<div class="strip">{name}<div>{picture("over the ride", *paths)}</div></div>'


def bar(begin: float, end: float, axis: Axis, colour: str) -> str:
    """A cell of a table with a bar from `begin` to `end`."""
    low, high = min(begin, end), max(begin, end)
    return f'<td class="bar">{picture("", (f"box {colour}", stretches([(low, high - low)], axis)))}</td>'


def key(text: str, colour: str) -> str:
    """What a colour stands for."""
    return f'<span class="key"><i class="{colour}"></i>{html.escape(text)}</span>'


def _key(curve: ChartLine) -> str:
    colour = "muted" if curve.dashed else curve.colour
    return key(curve.name, colour)


def _grid(up: Axis) -> str:
    return "".join(f"M0 {GRAIN - round(up.at(tick))}h{GRAIN}" for tick in up.ticks)


def _feet(below: Abscissa) -> str:
    """What is written below a chart; the unit stands beside the last number that leaves it room."""
    axis = below.axis
    texts = [axis.text(tick) for tick in axis.ticks]
    if texts:
        texts[-1] += f" {below.unit}"
    return "".join(
        f'<span class="x" style="left:{100 * axis.at(tick) / GRAIN:.4g}%">{html.escape(text)}</span>'
        for tick, text in zip(axis.ticks, texts, strict=True)
    )
