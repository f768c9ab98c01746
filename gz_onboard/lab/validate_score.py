"""How far a simulation is from what was measured: errors, percent, pass or fail, and where they live.

Definitions, the same for every channel. Both signals are first averaged over whole seconds: delays of the sensors of
0.1 s are no error of the model. Error is simulated less measured.

    rms, max       of the error, in the channel's unit
    percent        mean absolute error over mean absolute measured. A mean of relative errors would be without meaning
                   where a current or a torque passes through zero, and a share of the greatest value would flatter
    of_spread      rms error over the standard deviation of the measured: for a voltage, whose percent is small by
                   nature, this is the figure to look at. 1 is no better than its mean
    of a temperature and of the state of charge percent is the mean absolute error over the change, max less min
                   measured, at least 10 K and 5 points
    energy         the integral of the error over the integral of the measured. If the simulated pack is empty before
                   the ride ends, until the controller holds back for want of charge: what comes after is what is left,
                   not what the ride asks. So are the conditions below; percentages are of the whole ride, because a
                   pack that ends too soon is an error of the model
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.lab.validate_soc import SocReference

GATE, COMPONENT_GATE = 20.0, 10.0  # percent: Lord 2016, ch. 3
LEAST_RISE = 10.0  # K
LEAST_DRAWN = 5.0  # % of charge
ROLLING = 2.0  # m/s: below, road load is lost in what speed and torque err by
LEAST_SECONDS = 20  # of a condition; fewer mean nothing


@dataclass(frozen=True)
class Quantity:
    """What is compared: its unit and name.

    least_change: percent is of the change measured, or of this if that is less; None: of the mean magnitude. factor:
    what is multiplied with a value in SI units.
    """

    unit: str
    label: str
    least_change: float | None = None
    factor: float = 1.0

    @property
    def error_unit(self) -> str:
        """Of a difference."""
        return "K" if self.unit == "degC" else self.unit

    def shown(self, values: Array) -> Array:
        """`values` in SI units, in `unit`."""
        return values * self.factor


CHANNELS = {
    "pack_current": Quantity("A", "battery current"),
    "pack_voltage": Quantity("V", "battery voltage"),
    "motor_torque": Quantity("N·m", "motor torque"),
    "motor_speed": Quantity("rad/s", "motor speed"),
    "motor_temperature": Quantity("degC", "motor temperature", LEAST_RISE),
    "inverter_temperature": Quantity("degC", "inverter temperature", LEAST_RISE),
    "cell_temperature": Quantity("degC", "cell temperature", LEAST_RISE),
    "soc": Quantity("%", "state of charge", LEAST_DRAWN, 100.0),
    "throttle": Quantity("%", "throttle", factor=100.0),
}
"""The thesis' gate is on the first four; the others are judged by the same percentage."""
POWER = Quantity("W", "power at the pack")
NAMES = {"open_loop": "open loop", "predictive": "rider model", "components": "component alone"}
"""What people call each form of a comparison."""
GIVEN = {"open_loop": {"throttle"}}
"""By form: channels that are an input of that simulation, not a result."""


def channel_words(name: str) -> str:
    """The name of a channel or component in text."""
    return "state of charge" if name == "soc" else name.replace("_", " ")


@dataclass(frozen=True)
class ChannelErrors:
    """How far a simulated quantity is from the measured one: see the module's text."""

    unit: str
    rms: float
    max: float
    mean_error: float
    percent: float | None
    of_spread: float | None
    limit_percent: float
    passed: bool


def errors(measured: Array, simulated: Array, quantity: Quantity, limit: float) -> ChannelErrors:
    """Compare two arrays of shape (n,), n > 0, in the quantity's unit; limit: in percent."""
    error = simulated - measured
    mae, rms = float(np.abs(error).mean()), float(np.sqrt(np.mean(error**2)))
    if quantity.least_change is None:
        base = float(np.abs(measured).mean())
    else:
        base = float(max(np.ptp(measured), quantity.least_change))
    percent = 100 * mae / base if base > 0 else None
    spread = float(measured.std())
    return ChannelErrors(
        unit=quantity.error_unit,
        rms=rms,
        max=float(np.abs(error).max()),
        mean_error=float(error.mean()),
        percent=percent,
        of_spread=rms / spread if spread > 0 else None,
        limit_percent=limit,
        passed=percent is not None and percent <= limit,
    )


@dataclass(frozen=True)
class Verdict:
    """Whether a simulation, or the components, are within the limits."""

    channels: Annotated[
        dict[str, ChannelErrors], "by name: unit, rms, max, mean_error, percent, of_spread, limit_percent, passed"
    ]
    passed: bool


@dataclass(frozen=True)
class PackEmpty:
    """Where in a ride the simulated pack had no energy left for the ride's mean power."""

    time_s: float
    distance_km: float  # simulated
    soc: float  # 0 to 1
    compared_s: float  # until when energy is compared: where the controller begins to hold back, or the pack is empty


@dataclass(frozen=True)
class SimulationVerdict(Verdict):
    """The same of a whole ride."""

    energy_percent: Annotated[
        float | None,
        "energy at the pack's terminals, simulated less measured, in percent of measured; until compared_s of "
        "pack_empty, if there is one",
    ]
    pack_empty: Annotated[
        PackEmpty | None,
        "where the simulated pack had no energy left for the ride's mean power: time_s, distance_km, soc (0 to 1), and "
        "compared_s, until when energy_percent and splits are compared; or null",
    ] = None


@dataclass(frozen=True)
class Means:
    """A quantity over the seconds of one condition; errors are simulated less measured."""

    seconds: int
    mean_measured: float
    mean_error: float
    mean_abs_error: float
    mean_abs_measured: float


@dataclass(frozen=True)
class PooledMeans(Means):
    """The same over several rides. percent: mean magnitude of the error, bias_percent: its mean, of the measured."""

    rides: int
    percent: float
    bias_percent: float


Splits = dict[str, dict[str, Means]]
"""By what the seconds are sorted by, and by condition."""


@dataclass(frozen=True)
class ValidatedRide:
    """What was found of a ride."""

    file: Annotated[str, "the log"]
    name: Annotated[str, "of the ride"]
    kind: Annotated[str | None, "as noted in rides.json beside the log, or null"]
    vehicle: Annotated[str, "name of the vehicle"]
    payload_kg: Annotated[
        float, "mass of rider and luggage: --payload, or as noted in rides.json, or of the vehicle file"
    ]
    on_dynamometer: Annotated[bool, "whether a roller was under the wheel"]
    duration_s: Annotated[float, "of the ride"]
    distance_km: Annotated[float, "of the ride"]
    ambient_c: Annotated[float | None, "air, mean"]
    energy_wh: Annotated[float | None, "measured at the pack's terminals, sensors' known gain and offsets taken off"]
    open_loop: Annotated[
        SimulationVerdict | None,
        "simulated with the measured throttle and brake, or null: channels, energy_percent, passed",
    ]
    predictive: Annotated[SimulationVerdict, "simulated with the rider model following the measured speed: the same"]
    components: Annotated[Verdict | None, "each by itself, with measured inputs: channels, passed; or null"]
    splits: Annotated[
        dict[str, dict[str, Splits]],
        "by form, channel, sorting and condition: seconds, mean_measured, mean_error, mean_abs_error, "
        "mean_abs_measured",
    ]
    cells_series: Annotated[int, "cells in series, whose voltages make the pack's"]
    soc_reference: Annotated[
        SocReference | None,
        "what the state of charge is compared with, in percent of the charge: start, start_sd, drawn, drawn_sd, "
        "voltage_says, voltage_sd; or null",
    ]
    missing: Annotated[list[str], "what could not be judged, or not as well, and why"]
    passed: Annotated[bool, "whether open loop, predictive and components passed"]
    plot: Annotated[str | None, "file, or null"]

    @property
    def verdicts(self) -> dict[str, Verdict]:
        """Those that there are, by form."""
        every = {"open_loop": self.open_loop, "predictive": self.predictive, "components": self.components}
        return {form: verdict for form, verdict in every.items() if verdict}


class Sorting(NamedTuple):
    """Conditions by a value, one on each side of every edge, in the order of the edges; `label` has these in it."""

    label: str
    conditions: tuple[str, ...]
    edges: tuple[float, ...]

    def of(self, values: Array, among: Mask) -> dict[str, Mask]:
        """The seconds of each condition, of those `among` which there are any."""
        found = np.digitize(values, self.edges)
        return {name: among & (found == i) for i, name in enumerate(self.conditions)}


_SPEEDS = ("standing", "below 4 m/s", "4 to 8 m/s", "8 to 11 m/s", "above 11 m/s")
_PACE = "acceleration above {0:g}, {1:g} to {0:g}, within {1:g}, below −{1:g} m/s² without brake; with brake"
_PACES = ("hard acceleration", "acceleration", "steady", "coasting", "braking")
_TURNING = "lateral acceleration below {0:g}, {0:g} to {1:g}, above {1:g} m/s²"
_AIR = "air below {0:g}, {0:g} to {1:g}, above {1:g} °C, straight on where the yaw rate is known"
_TIMES = ("first 3 min", "3 to 10 min", "later")
_SORTINGS = {
    "turning": Sorting(_TURNING, ("straight", "slightly", "turning"), (0.5, 1.5)),
    "grade": Sorting("above {0:.0%}, within, below −{0:.0%}", ("uphill", "level", "downhill"), (0.01, -0.01)),
    "temperature": Sorting(_AIR, ("cold", "mild", "warm"), (12.0, 20.0)),
    "since start": Sorting("time ridden since the start, likewise", _TIMES, (180.0, 600.0)),
    "speed": Sorting("speed", _SPEEDS, (0.5, 4.0, 8.0, 11.0)),
    "pace": Sorting(_PACE, _PACES, (1.0, 0.3, -0.3)),
}
LABELS = {by: sorting.label.format(*sorting.edges).replace("%", " %") for by, sorting in _SORTINGS.items()}
"""What the seconds are sorted by."""
ORDER = tuple(kind for sorting in _SORTINGS.values() for kind in sorting.conditions)
"""The conditions as tables list them."""


def conditions(measured: Mapping[str, Array]) -> tuple[dict[str, dict[str, Mask]], list[str]]:
    """(the seconds of each condition, by what they are sorted by; what could not be sorted by, and why).

    measured: per second: ``speed`` [m/s]; if known ``acceleration`` [m/s²], ``yaw_rate`` [rad/s], ``grade`` (sine),
    ``ambient_temperature`` [degC], ``braking`` (share of the second).
    """
    speed = measured["speed"]
    moving = straight = speed > ROLLING
    missing = []
    sorted_by: dict[str, tuple[Array, Mask]] = {}
    if "yaw_rate" in measured:
        sorted_by["turning"] = np.abs(speed * measured["yaw_rate"]), moving
        straight = _SORTINGS["turning"].of(*sorted_by["turning"])["straight"]
    else:
        missing.append("not split into straight and turning: the ride has no yaw rate (rate_z), or is on a roller")
    if "grade" in measured:
        sorted_by["grade"] = measured["grade"], moving
    if "ambient_temperature" in measured:
        sorted_by["temperature"] = measured["ambient_temperature"], straight
    else:
        missing.append("not split into cold and warm: the ride has no ambient_temperature")
    sorted_by["since start"] = np.cumsum(moving, dtype=float) - 1, straight
    sorted_by["speed"] = speed, np.ones(len(speed), dtype=bool)
    braking = measured.get("braking", np.zeros(len(speed))) > 0
    sorted_by["pace"] = measured["acceleration"], moving & ~braking
    found = {by: _SORTINGS[by].of(*values) for by, values in sorted_by.items()}
    found["pace"]["braking"] = moving & braking
    return found, missing


def split(
    measured: Array, simulated: Array, found: Mapping[str, Mapping[str, Mask]], valid: Mask | None = None
) -> Splits:
    """The means of each condition of at least `LEAST_SECONDS`."""
    n = min(len(measured), len(simulated))
    result: Splits = {}
    for by, masks in found.items():
        for name, mask in masks.items():
            inside = mask[:n] if valid is None else mask[:n] & valid[:n]
            count = int(inside.sum())
            if count < LEAST_SECONDS:
                continue
            m, e = measured[:n][inside], (simulated[:n] - measured[:n])[inside]
            result.setdefault(by, {})[name] = Means(
                count, float(m.mean()), float(e.mean()), float(np.abs(e).mean()), float(np.abs(m).mean())
            )
    return result


def pooled(parts: Sequence[Means]) -> PooledMeans:
    """The means of several rides as those of one, every second alike."""
    total = sum(part.seconds for part in parts)

    def mean(name: str) -> float:
        return float(sum(getattr(part, name) * part.seconds for part in parts) / total)

    error, size, base = mean("mean_error"), mean("mean_abs_error"), mean("mean_abs_measured")
    return PooledMeans(
        seconds=total,
        mean_measured=mean("mean_measured"),
        mean_error=error,
        mean_abs_error=size,
        mean_abs_measured=base,
        rides=len(parts),
        percent=100 * size / base if base else 0.0,
        bias_percent=100 * error / base if base else 0.0,
    )
