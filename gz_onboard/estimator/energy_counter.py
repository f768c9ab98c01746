"""Energy that a pack has delivered, as its sensors show."""

from __future__ import annotations

from gz_onboard.events import Activity, Estimate


class EnergyCounter:
    """Integrates power over time; voltage and current hold until the next, but for no longer than `longest` [s].

    net: delivered less recovered [J], None until a voltage and a current are known; recovered: by braking [J]; charged:
    by a charger [J], in no other sum; distance: ridden while both were known [m], which the energy belongs to; missing:
    time [s] in which something else was known, but not both.
    """

    def __init__(self, longest: float = 1.0) -> None:
        self.net: float | None = None
        self.recovered = self.charged = self.distance = self.missing = 0.0
        self._longest = longest
        self._before: tuple[float, float] | None = None  # s, m

    def add(self, e: Estimate) -> None:
        """Add the time up to an estimate; modelled currents do not count."""
        time, distance, voltage = e.time, e.distance, e.pack_voltage
        current = None if e.current_modelled else e.pack_current
        before, way = self._before or (time, distance)
        self._before = time, distance
        dt = time - before
        if not 0 <= dt <= self._longest:
            return
        if voltage is None or current is None:
            nothing = e.speed is None and voltage is None and e.pack_current is None
            self.missing += 0.0 if nothing else dt
            return
        energy, self.net = voltage * current * dt, self.net or 0.0
        if e.activity is Activity.CHARGING:
            self.charged -= energy
            return
        self.net += energy
        self.recovered -= min(energy, 0.0)
        self.distance += distance - way
