"""Result of a calibration procedure: values with their uncertainty, refusals, quality of fit."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.errors import InputError, brief


class LackingError(InputError):
    """No ride has the sensors that a procedure needs; the other procedures continue."""


@dataclass(frozen=True)
class Found:
    """A parameter as found; the names and units are those of `model.parameters`."""

    value: float
    sd: float
    unit: str
    source: str  # data, number of points, residual, conditions
    channel: str = ""  # the signals of a ride that tell it, by their roles; none: a bench


@dataclass(frozen=True)
class Curve:
    """A table of the vehicle file over one or two axes, such as ``battery.r0`` over soc and temperature.

    value: shape (len(axis),) or (len(second axis), len(first axis)); sd likewise, nan where data end.
    """

    axes: dict[str, Array]  # by the key of the vehicle file, the innermost first
    value: Array
    sd: Array
    unit: str
    source: str


@dataclass(frozen=True)
class Fit:
    """How well a model follows data: in sample, or on data held out of the fit."""

    what: str  # e.g. "motor loss"
    unit: str
    rms: float
    largest: float  # magnitude
    r2: float | None  # share of variance explained
    points: int
    held_out: bool
    data: str  # which


@dataclass(frozen=True)
class PlotLine:
    """A curve of a plot, in the units of its panel."""

    label: str
    x: Array
    y: Array
    style: str = "-"  # as of matplotlib: "-" model, "." data


@dataclass(frozen=True)
class Panel:
    """One set of axes: data and model, or a residual."""

    title: str
    x_label: str  # with unit
    y_label: str
    traces: tuple[PlotLine, ...]


def compared(
    title: str, x_label: str, y_label: str, x: Array, data: Array, model: Array, style: str = "-"
) -> list[Panel]:
    """Data and model over `x`, in the unit at the end of `y_label`, and the residual."""
    unit = y_label.rpartition("[")[2]
    order = np.argsort(x) if style == "-" else slice(None)
    lines = PlotLine("measured", x, data, "."), PlotLine("model", x[order], model[order], style)
    return [
        Panel(title, x_label, y_label, lines),
        Panel(f"{title}: residual", x_label, f"measured less model [{unit}", (PlotLine("", x, data - model, "."),)),
    ]


@dataclass
class Result:
    """What one procedure found.

    effects: by name, whether the data show it, where a procedure looked for it: the model then has it, or has it not.
    covariance: groups of parameters that are tied, each with its matrix in the parameters' units.
    refusals: parameters that the data could not show, one sentence each, with the number that says so.
    """

    procedure: str
    parameters: dict[str, Found] = field(default_factory=dict)
    curves: dict[str, Curve] = field(default_factory=dict)  # by the dotted name of the vehicle file's table
    covariance: list[tuple[tuple[str, ...], Array]] = field(default_factory=list)
    fits: list[Fit] = field(default_factory=list)
    refusals: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    panels: list[Panel] = field(default_factory=list)
    effects: dict[str, bool] = field(default_factory=dict)

    __repr__ = brief

    def add(self, other: Result) -> None:
        """Put what `other` found into this."""
        self.parameters |= other.parameters
        self.curves |= other.curves
        self.effects |= other.effects
        self.covariance += other.covariance
        self.fits += other.fits
        self.refusals += other.refusals
        self.notes += other.notes
        self.panels += other.panels
