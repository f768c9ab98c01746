"""What a channel may leave over a quantity: which pairs, and the functions that curves over them are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.discovery.blocks import over_blocks
from gz_onboard.discovery.channels import CHANNEL
from gz_onboard.discovery.grid import STEP, Ride, smooth
from gz_onboard.discovery.linear import LinearChannel, LinearRide
from gz_onboard.discovery.result import CONSTANT
from gz_onboard.lab.sizes import USUAL_SIZES, Sizes

# knots of the hat functions, of a vehicle of size 1 (see `KNOT_SIZES`); unit
KNOTS: dict[str, tuple[tuple[float, ...], str]] = {
    "speed": ((2.0, 4.5, 6.5, 8.5, 10.0, 11.5, 13.0, 15.0), "m/s"),
    "acceleration": ((-2.0, -1.0, -0.3, 0.0, 0.3, 1.0, 2.0), "m/s²"),
    "lateral_acceleration": ((-4.0, -2.0, -0.7, 0.0, 0.7, 2.0, 4.0), "m/s²"),
    "grade": ((-0.08, -0.04, -0.015, 0.0, 0.015, 0.04, 0.08), "1"),
    "heading": ((0.0, 0.9, 1.8, 2.7, 3.6, 4.5, 5.4), "rad"),
    "motor_temperature": ((0.0, 15.0, 30.0, 40.0, 50.0, 65.0, 80.0), "degC"),
    "time": ((0.0, 120.0, 240.0, 400.0, 600.0, 800.0, 1200.0), "s"),
    "motor_current": ((-40.0, 0.0, 20.0, 50.0, 90.0, 140.0, 200.0), "A"),
    "current_change": ((0.0, 5.0, 15.0, 30.0, 60.0, 100.0), "A"),
    "pack_current": ((-15.0, 0.0, 8.0, 20.0, 40.0, 60.0, 90.0), "A"),
    "soc": ((0.2, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0), "1"),
    "steering": ((-0.5, -0.2, -0.06, 0.0, 0.06, 0.2, 0.5), "rad"),
    "vibration": ((0.3, 0.7, 1.0, 1.4, 1.9, 2.5, 3.3), "m/s²"),
    "suspension_speed": ((0.02, 0.06, 0.1, 0.14, 0.19, 0.25, 0.35), "m/s"),
    "since_braking": ((0.0, 4.0, 8.0, 15.0, 30.0, 60.0), "s"),
    CONSTANT: ((0.0,), "1"),
}
PAIRS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("road_force", tuple(name for name in KNOTS if name not in ("pack_current", "soc", CONSTANT))),
    ("inverter_power", ("speed", "motor_current", "motor_temperature", "time", "current_change")),
    (
        "pack_power",
        ("speed", "acceleration", "lateral_acceleration", "grade", "heading", "time", "vibration", CONSTANT),
    ),
    ("auxiliary", ("speed", "motor_temperature", "time", "pack_current", "vibration")),
    ("pack_balance", ("speed", "pack_current", "motor_temperature", "time")),
    ("cell_voltage", ("pack_current", "soc", "time", "current_change", "vibration")),
)


UNITS = {
    "road_force": 5.0,
    "inverter_power": 10.0,
    "pack_power": 40.0,
    "auxiliary": 2.0,
    "pack_balance": 0.1,
    "cell_voltage": 0.005,
}
"""Of a curve's coefficients, in the channel's, of a vehicle of size 1; they grow as the channel's noise does, and
`SCATTER` of them is taken to differ between rides."""
SCATTER = 0.3
SCATTERS = {"cell_voltage": 1.0}  # whose model lacks more
KNOT_SIZES = {"speed": "speed", "motor_current": "current", "current_change": "current", "pack_current": "current"}
"""The size of the vehicle that the knots of a quantity grow with; those of others are of roads and riders."""
SMOOTH, SLOW = 8.0, 2.0  # s, m/s: of a grade by GPS altitude
ROUND = ("heading",)
IN_PROPORTION = ("time", "current_change", "steering", "vibration", "suspension_speed")
"""Quantities that something may be in proportion to and that no candidate is: each is a try of its own."""


@dataclass(frozen=True)
class CurveForm:
    """What a channel may leave over a quantity: a curve, or what is in proportion, which needs less to be seen."""

    channel: str
    quantity: str
    straight: bool = False
    sizes: Sizes = USUAL_SIZES

    @property
    def name(self) -> str:
        """``channel over quantity`` of a curve."""
        return f"{self.channel} {'along' if self.straight else 'over'} {self.quantity}"

    @property
    def size(self) -> float:
        """Unit of its coefficients, in the channel's."""
        return UNITS[self.channel] * self.sizes.of(CHANNEL[self.channel].size)

    @property
    def scatter(self) -> float:
        """By how much its coefficients differ between rides, in `size`."""
        return SCATTERS.get(self.channel, SCATTER)

    @property
    def basis(self) -> Array:
        """Its values at the knots for coefficients of one, (knots, k); what is in proportion has one."""
        knots = self.knots
        if not self.straight:
            return np.eye(len(knots))
        return np.asarray(knots[:, None] / np.abs(knots).max())

    @property
    def knots(self) -> Array:
        """Where its pieces meet, in the quantity's unit, (knots,)."""
        return np.array(KNOTS[self.quantity][0]) * self.sizes.of(KNOT_SIZES.get(self.quantity, ""))

    @property
    def unit(self) -> str:
        """Of the quantity."""
        return KNOTS[self.quantity][1]


def curve_forms(sizes: Sizes = USUAL_SIZES) -> list[CurveForm]:
    """A curve for every pair of channel and quantity, and what is in proportion to some; of a vehicle of `sizes`."""
    every = [CurveForm(channel, quantity, sizes=sizes) for channel, quantities in PAIRS for quantity in quantities]
    return [*every, *(replace(form, straight=True) for form in every if form.quantity in IN_PROPORTION)]


def quantity(ride: Ride, name: str, table: LinearChannel) -> Array | None:
    """The quantity over the blocks of `table`, (m,); None if the ride has it not, or did not measure it."""
    channel = table.channel
    if not ride.shows(name):
        return None
    if name == CONSTANT:
        return np.zeros(len(table.y))
    values = ride.quantities.get(name)
    if name == "current_change":
        n = round(channel.block / STEP)
        mean = over_blocks(channel, ride.signals["motor_current"])
        square = over_blocks(channel, ride.signals["motor_current"] ** 2)
        return np.asarray(np.sqrt(np.maximum(square - mean**2, 0))[table.used]) if n > 1 else None
    if name == "grade" and "gps_altitude" in ride.signals:  # not of the accelerometer, whose noise is in the channel
        rise = np.gradient(smooth(ride.signals["gps_altitude"], SMOOTH), STEP)
        values = smooth(rise, SMOOTH) / np.maximum(smooth(np.abs(ride.quantities["speed"]), SMOOTH), SLOW)
    return None if values is None else over_blocks(channel, values)[table.used]


def hat_functions(x: Array, knots: Sequence[float], periodic: bool = False) -> Array:
    """Linear hat functions over `knots`, (m, k); periodic: of an angle [rad], the last goes over into the first."""
    at = [*knots, 2 * np.pi] if periodic else knots
    inside = np.mod(x, 2 * np.pi) if periodic else x
    full: Array = np.array([np.interp(inside, at, hat) for hat in np.eye(len(at))]).T
    if periodic:
        full[:, 0] += full[:, -1]
        full = full[:, :-1]
    return full


def columns_of(line: LinearRide, form: CurveForm) -> Array | None:
    """The curve's columns over the blocks of its channel, (m, knots); None if the ride has not what they are over."""
    table = line.tables.get(form.channel)
    x = quantity(line.ride, form.quantity, table) if table is not None else None
    return None if x is None else hat_functions(x, form.knots.tolist(), form.quantity in ROUND)
