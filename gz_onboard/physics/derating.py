"""What a motor controller takes off its current: piecewise-linear shares over speed, temperature, voltage and charge.

Lord 2016 names the controller and does not give it (it is proprietary). What a vehicle file does not say takes nothing
off: a limit of one vehicle is not another's.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import pairwise
from typing import TYPE_CHECKING

from gz_onboard.physics.functions import Row, linear

if TYPE_CHECKING:
    from gz_onboard.toml import Table


@dataclass(frozen=True)
class DeratingCurve:
    """A share `share` (0..1) over a quantity `at`: linear between the points, constant beyond the ends."""

    at: Row
    share: Row

    def __call__(self, x: float) -> float:
        """The share at `x`."""
        return linear(self.at, self.share, x)


FULL = DeratingCurve((0.0,), (1.0,))


@dataclass(frozen=True)
class Derating:
    """Shares of the current limit while driving (``current_``) and while braking with the motor (``regeneration_``).

    Those that act at once multiply; temperatures act on both. `regeneration_gain`: share of the regeneration for each
    share of the brake's command; the most is all of it.
    """

    current_by_motor_speed: DeratingCurve = FULL
    current_by_cell_voltage: DeratingCurve = FULL
    current_by_soc: DeratingCurve = FULL
    current_by_motor_temperature: DeratingCurve = FULL
    current_by_inverter_temperature: DeratingCurve = FULL
    current_by_cell_temperature: DeratingCurve = FULL
    regeneration_by_motor_speed: DeratingCurve = FULL
    regeneration_by_soc: DeratingCurve = FULL
    regeneration_gain: float = 1.0

    @property
    def top_spin(self) -> float | None:
        """The motor speed [rad/s] from which on there is no current; None if that is not said."""
        curve = self.current_by_motor_speed
        return next((at for at, share in zip(curve.at, curve.share, strict=True) if not share and at > 0), None)


AXES: dict[str, tuple[str, float, float]] = {
    "motor_speed": ("rad/s", 0.0, 5000.0),
    "cell_voltage": ("V", 0.5, 5.0),
    "soc": ("1", -0.01, 1.01),
    "motor_temperature": ("degC", -60.0, 300.0),
    "inverter_temperature": ("degC", -60.0, 200.0),
    "cell_temperature": ("degC", -60.0, 150.0),
}
"""What a share may stand over: (unit, least, greatest)."""


def read_derating(vehicle: Table) -> Derating:
    """The table ``[controller]`` of a vehicle file; an entry that is not there takes nothing off.

    Raises InputError for unknown keys, a unit that is not the axis', an axis that does not increase or is out of its
    bounds, and shares outside 0 to 1.
    """
    table = vehicle.table("controller")
    known = [entry.name for entry in fields(Derating)]
    table.only(known)
    found: dict[str, DeratingCurve | float] = {}
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


def _curve(table: Table, unit: str, low: float, high: float) -> DeratingCurve:
    table.only(["at", "share", "unit", "status", "source"])
    table.text("unit", choices=[unit])
    at, share = table.numbers("at"), table.numbers("share")
    for a, b in pairwise(at):
        if not a < b:
            raise table.error(f"must increase, but {b:g} {unit} follows {a:g} {unit}", "at")
    for x in at:
        if not low <= x <= high:
            raise table.error(f"{x:g} {unit} is outside {low:g} to {high:g} {unit}", "at")
    for y in share:
        if not 0 <= y <= 1:
            raise table.error(f"{y:g} is outside 0 to 1", "share")
    if len(at) != len(share):
        raise table.error(f"has {len(share)} numbers for {len(at)} of at", "share")
    return DeratingCurve(at, share)
