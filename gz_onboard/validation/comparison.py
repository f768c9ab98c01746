"""Compare measured with simulated quantities: errors, limits, and means by riding condition.

Both signals are first averaged over whole seconds, so a sensor delay of 0.1 s is not an error of the model. Error is
simulated less measured.

    rms, max       of the error, in the channel's unit
    percent        mean absolute error over mean absolute measured value. A mean of relative errors has no meaning where
                   a current or a torque passes through zero; a share of the greatest value would flatter. For a
                   temperature and for the state of charge: mean absolute error over the measured change (max less min,
                   at least 10 K or 5 points)
    of_spread      rms error over the standard deviation of the measured values: the figure to look at for a voltage,
                   whose percent is small by nature. 1 is no better than the mean
    energy         integral of the error over integral of the measured power. If the simulated pack is empty before the
                   ride ends: until the controller holds back for want of charge, like the errors by condition.
                   Percentages are always of the whole ride: a pack that ends too soon is an error of the model
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from gz_onboard.arrays import Array, Mask


@dataclass(frozen=True)
class ValidationConfig:
    """Limits of the comparison. Source of both gates: Lord 2016, ch. 3."""

    gate_percent: float = 20.0  # of a channel of a simulated ride
    component_gate_percent: float = 10.0
    least_rise_k: float = 10.0  # percent of a smaller change would be percent of noise
    least_charge_percent: float = 5.0  # likewise
    road_load_speed_m_s: float = 2.0  # slower, errors of speed and torque hide the road load
    least_seconds: int = 20  # of a condition, of riding, of an energy: fewer mean nothing
    shortest_s: int = 30  # ride
    standing_m_s: float = 0.3  # noise of a wheel that stands
    speed_average_s: float = 0.5  # the noise of a measured speed is nothing that a rider model should follow
    grade_error: float = 0.005  # sine, of the on-board filter in the first minutes
    last_s: int = 120  # of a ride, whose voltage tells the state of charge


CONFIG = ValidationConfig()


@dataclass(frozen=True)
class Quantity:
    """A quantity that is compared.

    least_change: percent is of the measured change, or of this if that is less; None: of the mean magnitude.
    """

    unit: str
    label: str
    least_change: float | None = None
    factor: float = 1.0  # from SI units

    @property
    def error_unit(self) -> str:
        """Unit of a difference."""
        return "K" if self.unit == "degC" else self.unit


CHANNELS = {
    "pack_current": Quantity("A", "battery current"),
    "pack_voltage": Quantity("V", "battery voltage"),
    "motor_torque": Quantity("N·m", "motor torque"),
    "motor_speed": Quantity("rad/s", "motor speed"),
    "motor_temperature": Quantity("degC", "motor temperature", CONFIG.least_rise_k),
    "inverter_temperature": Quantity("degC", "inverter temperature", CONFIG.least_rise_k),
    "cell_temperature": Quantity("degC", "cell temperature", CONFIG.least_rise_k),
    "soc": Quantity("%", "state of charge", CONFIG.least_charge_percent, 100.0),
    "throttle": Quantity("%", "throttle", factor=100.0),
}
"""Judged channels of a simulated ride. The thesis judges the first four; the same limit is used for the others."""
POWER = Quantity("W", "power at the pack")
FORMS = {"open_loop": "open loop", "predictive": "rider model", "components": "component alone"}
"""Forms of a comparison, by their names in JSON."""


def channel_words(name: str) -> str:
    """The name of a channel or component in text."""
    return "state of charge" if name == "soc" else name.replace("_", " ")


@dataclass(frozen=True)
class Comparison:
    """A quantity measured and modelled, one value a second, shape (n,); valid: where the two can be compared."""

    quantity: Quantity
    measured: Array
    modelled: Array
    valid: Mask

    @classmethod
    def of(cls, quantity: Quantity, measured: Array, modelled: Array, valid: Mask | None = None) -> Comparison:
        """Compare values in SI units, as long as there are both."""
        n = min(len(measured), len(modelled))
        mask = np.ones(n, dtype=bool) if valid is None else valid[:n]
        return cls(quantity, measured[:n] * quantity.factor, modelled[:n] * quantity.factor, mask)

    @property
    def error(self) -> Array:
        """Modelled less measured, shape (n,)."""
        return self.modelled - self.measured

    def until(self, seconds: float | None) -> Comparison:
        """The first whole `seconds`; None: all."""
        n = None if seconds is None else int(seconds)
        return Comparison(self.quantity, self.measured[:n], self.modelled[:n], self.valid[:n])

    def errors(self, limit: float) -> ChannelErrors:
        """The errors of the valid seconds, at least one; limit: in percent."""
        measured, error, least = self.measured[self.valid], self.error[self.valid], self.quantity.least_change
        base = float(np.abs(measured).mean() if least is None else max(np.ptp(measured), least))
        rms, spread = float(np.sqrt(np.mean(error**2))), float(measured.std())
        percent = 100 * float(np.abs(error).mean()) / base if base > 0 else None
        return ChannelErrors(
            unit=self.quantity.error_unit,
            rms=rms,
            max=float(np.abs(error).max()),
            mean_error=float(error.mean()),
            percent=percent,
            of_spread=rms / spread if spread > 0 else None,
            limit_percent=limit,
            passed=percent is not None and percent <= limit,
        )

    def split(self, form: str, channel: str, conditions: Conditions) -> list[Means]:
        """The means in each condition of enough seconds."""
        n = len(self.measured)
        found = []
        for sorting, masks in conditions.items():
            for condition, mask in masks.items():
                inside = mask[:n] & self.valid
                if inside.sum() >= CONFIG.least_seconds:
                    measured, error = self.measured[inside], self.error[inside]
                    means = (float(x.mean()) for x in (measured, error, np.abs(error), np.abs(measured)))
                    found.append(Means(form, channel, sorting, condition, len(error), *means))
        return found


# --- results ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ChannelErrors:
    """Errors of a simulated quantity, as the text of this module defines them."""

    unit: str
    rms: float
    max: float
    mean_error: float
    percent: float | None
    of_spread: float | None
    limit_percent: float
    passed: bool


@dataclass(frozen=True)
class Verdict:
    """Whether a simulation, or the components, are within the limits."""

    channels: Annotated[
        dict[str, ChannelErrors], "by name: unit, rms, max, mean_error, percent, of_spread, limit_percent, passed"
    ]
    passed: bool


@dataclass(frozen=True)
class PackEmpty:
    """When the simulated pack had no energy left for the ride's mean power."""

    time_s: float
    distance_km: float  # simulated
    soc: float  # 0 to 1
    compared_s: float  # end of the energy comparison: where the controller begins to hold back, or the pack is empty


@dataclass(frozen=True)
class SimulationVerdict(Verdict):
    """The verdict on a whole simulated ride."""

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
class SocReference:
    """The state of charge that a simulated one is compared with. All in percent of the charge; sd: standard deviation.

    It is counted from the voltage at rest before the ride, where the simulation begins too. So the charge drawn is
    compared, which errs by capacity and current sensor. Rides end without a rest; but the voltage of their last minutes
    gives a state of charge that does not depend on the capacity.
    """

    start: Annotated[float, "by the voltage at rest, where the simulation begins too"]
    start_sd: float
    drawn: Annotated[float, "counted"]
    drawn_sd: Annotated[float, "by the capacity and by gain and offset of the current sensor"]
    voltage_says: Annotated[float | None, "state of charge by the voltage of the last 2 min, less the counted one"]
    voltage_sd: Annotated[float | None, "of that: by the cells' circuit, their rest voltage and the sensor"]

    @property
    def cells(self) -> tuple[str, str, str]:
        """Start, charge drawn and difference by the voltage, as text."""
        says = "–" if self.voltage_says is None else f"{self.voltage_says:+.1f} ± {self.voltage_sd:.1f}"
        return f"{self.start:.1f} ± {self.start_sd:.1f}", f"{self.drawn:.1f} ± {self.drawn_sd:.1f}", says


@dataclass(frozen=True)
class Means:
    """A channel over the seconds of one riding condition; errors are simulated less measured."""

    form: str
    channel: str
    sorting: str
    condition: str
    seconds: int
    mean_measured: float
    mean_error: float
    mean_abs_error: float
    mean_abs_measured: float


@dataclass(frozen=True)
class PooledMeans(Means):
    """The same over several rides. percent: mean magnitude of the error, bias_percent: its mean, of the measured."""

    on_dynamometer: bool
    rides: int
    percent: float
    bias_percent: float


Conditions = Mapping[str, Mapping[str, Mask]]
"""The seconds of each condition, by sorting."""


@dataclass(frozen=True)
class ValidatedRide:
    """The result of one ride."""

    file: Annotated[str, "the log"]
    name: Annotated[str, "of the ride"]
    kind: Annotated[str | None, "as noted in rides.json in the folder of the log, or null"]
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
        list[Means],
        "of each form, channel, sorting and condition: seconds, mean_measured, mean_error, mean_abs_error, "
        "mean_abs_measured",
    ]
    cells_series: Annotated[int, "cells in series, whose voltages make the pack's"]
    soc_reference: Annotated[
        SocReference | None,
        "reference of the state of charge, in percent of the charge: start, start_sd, drawn, drawn_sd, "
        "voltage_says, voltage_sd; or null",
    ]
    missing: Annotated[list[str], "channels and conditions that could not be judged, or not as well, and why"]
    passed: Annotated[bool, "whether open loop, predictive and components passed"]
    plot: Annotated[str | None, "file, or null"]

    @property
    def verdicts(self) -> dict[str, Verdict]:
        """The verdicts that there are, by form."""
        every = {"open_loop": self.open_loop, "predictive": self.predictive, "components": self.components}
        return {form: verdict for form, verdict in every.items() if verdict}


# --- riding conditions --------------------------------------------------------------------------------------------


class Sorting(NamedTuple):
    """Conditions by a value, one on each side of every edge, in the order of the edges; `label` has these in it."""

    label: str
    conditions: tuple[str, ...]
    edges: tuple[float, ...]

    def of(self, values: Array, among: Mask) -> dict[str, Mask]:
        """The seconds of each condition, only those `among` which there are any."""
        found = np.digitize(values, self.edges)
        return {name: among & (found == i) for i, name in enumerate(self.conditions)}


_PACE = "acceleration above {0:g}, {1:g} to {0:g}, within {1:g}, below −{1:g} m/s² without brake; with brake"
_SORTINGS = {
    "turning": Sorting(
        "lateral acceleration below {0:g}, {0:g} to {1:g}, above {1:g} m/s²",
        ("straight", "slightly", "turning"),
        (0.5, 1.5),
    ),
    "grade": Sorting("above {0:.0%}, within, below −{0:.0%}", ("uphill", "level", "downhill"), (0.01, -0.01)),
    "temperature": Sorting(
        "air below {0:g}, {0:g} to {1:g}, above {1:g} °C, straight on where the yaw rate is known",
        ("cold", "mild", "warm"),
        (12.0, 20.0),
    ),
    "since start": Sorting(
        "time ridden since the start, likewise", ("first 3 min", "3 to 10 min", "later"), (180.0, 600.0)
    ),
    "speed": Sorting(
        "speed", ("standing", "below 4 m/s", "4 to 8 m/s", "8 to 11 m/s", "above 11 m/s"), (0.5, 4.0, 8.0, 11.0)
    ),
    "pace": Sorting(_PACE, ("hard acceleration", "acceleration", "steady", "coasting", "braking"), (1.0, 0.3, -0.3)),
}
LABELS = {by: sorting.label.format(*sorting.edges).replace("%", " %") for by, sorting in _SORTINGS.items()}
"""Descriptions of the sortings."""
ORDER = tuple(kind for sorting in _SORTINGS.values() for kind in sorting.conditions)
"""The conditions as tables list them."""


def riding_conditions(measured: Mapping[str, Array]) -> tuple[dict[str, dict[str, Mask]], list[str]]:
    """Sort the seconds of a ride: (seconds of each condition by sorting; sortings that are missing, and why).

    measured: per second: ``speed`` [m/s], ``acceleration`` [m/s²]; if known ``yaw_rate`` [rad/s], ``grade`` (sine),
    ``ambient_temperature`` [degC], ``braking`` (share of the second).
    """
    speed = measured["speed"]
    moving = straight = speed > CONFIG.road_load_speed_m_s
    braking = measured.get("braking", np.zeros(len(speed))) > 0
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
    sorted_by["pace"] = measured["acceleration"], moving & ~braking
    found = {by: _SORTINGS[by].of(*values) for by, values in sorted_by.items()}
    found["pace"]["braking"] = moving & braking
    return found, missing


def pooled(parts: Sequence[Means], on_dynamometer: bool = False) -> PooledMeans:
    """The means of several rides in one condition as those of one, every second alike."""
    seconds = [part.seconds for part in parts]
    names = ("mean_measured", "mean_error", "mean_abs_error", "mean_abs_measured")
    means = {name: float(np.average([getattr(part, name) for part in parts], weights=seconds)) for name in names}
    scale = 100 / means["mean_abs_measured"] if means["mean_abs_measured"] else 0.0
    return PooledMeans(
        **{**vars(parts[0]), **means, "seconds": sum(seconds)},
        on_dynamometer=on_dynamometer,
        rides=len(parts),
        percent=scale * means["mean_abs_error"],
        bias_percent=scale * means["mean_error"],
    )


def pool(rides: Sequence[ValidatedRide]) -> list[PooledMeans]:
    """The splits of all rides as one, those on the road first, those on a dynamometer apart."""
    parts: dict[tuple[bool, str, str, str, str], list[Means]] = {}
    for ride in sorted(rides, key=lambda ride: ride.on_dynamometer):
        for means in ride.splits:
            key = ride.on_dynamometer, means.form, means.channel, means.sorting, means.condition
            parts.setdefault(key, []).append(means)
    return [pooled(found, on_dynamometer) for (on_dynamometer, *_), found in parts.items()]
