"""How a motor controller limits its current: piecewise-linear shares over speed, temperature, voltage and charge.

Lord 2016 names the controller and does not give it (it is proprietary). A share that the vehicle file does not give is
1: a limit of one vehicle is not another's.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

from gz_onboard.physics.functions import PiecewiseLinear

if TYPE_CHECKING:
    from gz_onboard.toml import Table


FULL = PiecewiseLinear((0.0,), (1.0,))


@dataclass(frozen=True)
class Derating:
    """Shares of the current limit while driving (``current_``) and while braking with the motor (``regeneration_``).

    Shares that act together multiply; temperatures act on driving and braking. regeneration_gain: share of the
    regeneration for each share of the brake's command, up to all of it.
    """

    current_by_motor_speed: PiecewiseLinear = FULL
    current_by_cell_voltage: PiecewiseLinear = FULL
    current_by_soc: PiecewiseLinear = FULL
    current_by_motor_temperature: PiecewiseLinear = FULL
    current_by_inverter_temperature: PiecewiseLinear = FULL
    current_by_cell_temperature: PiecewiseLinear = FULL
    regeneration_by_motor_speed: PiecewiseLinear = FULL
    regeneration_by_soc: PiecewiseLinear = FULL
    regeneration_gain: float = 1.0

    @property
    def top_spin(self) -> float | None:
        """The motor speed [rad/s] from which there is no current; None if the file does not say."""
        curve = self.current_by_motor_speed
        return next((at for at, share in zip(curve.x, curve.y, strict=True) if not share and at > 0), None)


AXES: dict[str, tuple[str, float, float]] = {
    "motor_speed": ("rad/s", 0.0, 5000.0),
    "cell_voltage": ("V", 0.5, 5.0),
    "soc": ("1", -0.01, 1.01),
    "motor_temperature": ("degC", -60.0, 300.0),
    "inverter_temperature": ("degC", -60.0, 200.0),
    "cell_temperature": ("degC", -60.0, 150.0),
}
"""The axes of shares: (unit, least, greatest)."""


def read_derating(vehicle: Table) -> Derating:
    """The table ``[controller]`` of a vehicle file; a missing entry limits nothing.

    Raises InputError for unknown keys, a unit that is not the axis', an axis that does not increase or is out of its
    bounds, and shares outside 0 to 1.
    """
    table = vehicle.table("controller")
    known = [entry.name for entry in fields(Derating)]
    table.only(known)
    found: dict[str, PiecewiseLinear | float] = {}
    for name in known:
        if name not in table.values:
            continue
        entry = table.table(name)
        if name == "regeneration_gain":
            entry.only(["value", "unit", "status", "source"])
            entry.text("unit", choices=["1"])
            found[name] = entry.number("value", low=0.01, high=1e6)
        else:
            found[name] = _curve(entry, *AXES[name.partition("_by_")[2]])
    return Derating(**found)  # type: ignore[arg-type]


def _curve(table: Table, unit: str, low: float, high: float) -> PiecewiseLinear:
    table.only(["at", "share", "unit", "status", "source"])
    table.text("unit", choices=[unit])
    at, share = table.increasing("at", low, high, unit), table.numbers("share", 0.0, 1.0)
    if len(at) != len(share):
        raise table.error(f"has {len(share)} numbers for {len(at)} of at", "share")
    return PiecewiseLinear(at, share)
