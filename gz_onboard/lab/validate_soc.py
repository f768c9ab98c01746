"""How well the state of charge is known that a simulated one is compared with.

It is the charge that was counted, from the voltage at rest before the ride. A simulation begins at the same state of
charge, so an error of that beginning is in both: what is compared is the charge drawn, which errs by capacity and
current sensor. Rides end without a rest; but what the voltage of their last minutes says by the cells' circuit, which
knows nothing of the capacity, is an independent word on the count.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import hypot
from typing import Annotated

from gz_onboard.arrays import Array
from gz_onboard.constants import MILD
from gz_onboard.estimator.battery_priors import VoltageNoise
from gz_onboard.model.battery import discharged
from gz_onboard.vehicle import Vehicle

LAST = 120  # s of a ride, whose voltage is asked
_POINTS = 100.0  # percent


@dataclass(frozen=True)
class SocReference:
    """All in percent of the charge; sd: standard deviation."""

    start: Annotated[float, "by the voltage at rest, where the simulation begins too"]
    start_sd: float
    drawn: Annotated[float, "counted"]
    drawn_sd: Annotated[float, "by the capacity and by gain and offset of the current sensor"]
    voltage_says: Annotated[float | None, "state of charge by the voltage of the last 2 min, less the counted one"]
    voltage_sd: Annotated[float | None, "of that: by the cells' circuit, their rest voltage and the sensor"]


def soc_reference(
    vehicle: Vehicle, measured: Mapping[str, Array], start: float | None, modelled: Array | None
) -> SocReference | None:
    """Of a ride that begins at `start`, or None where no charge was counted.

    measured: per second, with ``soc`` and ``pack_voltage`` [V]. modelled: pack voltage [V] by the cells' circuit, from
    the measured current and the counted charge.
    """
    if start is None or "soc" not in measured:
        return None
    battery, p, counted = vehicle.pack, vehicle.parameters, measured["soc"]
    celsius = measured.get("cell_temperature")
    first, last = (None, None) if celsius is None else (float(celsius[0]), float(celsius[-1]))
    voltage = VoltageNoise(battery, p)
    sensor = p.sd("pack_voltage_offset") / battery.cells_series
    drawn = start - float(counted[-1])
    relative = hypot(p.sd("cell_capacity") / p["cell_capacity"], p.sd("pack_current_gain"))
    capacity = battery.pack_capacity(MILD if first is None else first)
    offset = discharged(p.sd("pack_current_offset"), len(counted), capacity)
    says = says_sd = None
    if modelled is not None and last is not None and len(counted) > LAST:
        level = float(counted[-LAST:].mean())
        slope = battery.ocv(level)[1]
        missing = float((measured["pack_voltage"] - modelled)[-LAST:].mean()) / battery.cells_series
        says, says_sd = missing / slope, hypot(voltage.loaded(level, last), voltage.rest, sensor) / slope
    return SocReference(
        start=_POINTS * start,
        start_sd=_POINTS * hypot(voltage.rest, sensor) / battery.ocv(start)[1],
        drawn=_POINTS * drawn,
        drawn_sd=_POINTS * hypot(relative * drawn, offset),
        voltage_says=None if says is None else _POINTS * says,
        voltage_sd=None if says_sd is None else _POINTS * says_sd,
    )


def soc_text(soc: SocReference) -> str:
    """In words."""
    text = (
        f"{soc.start:.1f} ± {soc.start_sd:.1f} % by the voltage at rest, then {soc.drawn:.1f} ± {soc.drawn_sd:.1f} % "
        "counted"
    )
    if soc.voltage_says is None or soc.voltage_sd is None:
        return text
    return f"{text}; the voltage of the last {LAST // 60} min says {soc.voltage_says:+.1f} ± {soc.voltage_sd:.1f} %"
