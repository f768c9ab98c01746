"""The energy that a pack has given, as its sensors say."""

from __future__ import annotations

from gz_onboard.events import Activity, Estimate


class Drawn:
    """Sums over time; voltage and current hold from the time before to theirs, but for no longer than `most` [s]."""

    def __init__(self, most: float = 1.0) -> None:
        self.net: float | None = None  # J, less what was recovered; None until a voltage and a current are known
        self.recovered = 0.0  # J
        self.charged = 0.0  # J out of a charger, in no other sum
        self.distance = 0.0  # m, ridden while they were known: what the energy is of
        self.missing = 0.0  # s in which something else was known, and not both of them: what the energy lacks
        self._most = most
        self._before: tuple[float, float] | None = None  # s, m

    def take(self, e: Estimate) -> None:
        """Go on to an estimate. A current that no sensor showed is none."""
        current = None if e.current_modelled else e.pack_current
        seen = not (e.speed is None and e.pack_voltage is None and e.pack_current is None)
        self.add(e.time, e.pack_voltage, current, e.distance, seen=seen, charging=e.activity is Activity.CHARGING)

    def add(
        self,
        time: float,
        voltage: float | None,
        current: float | None,
        distance: float = 0.0,
        *,
        seen: bool = True,
        charging: bool = False,
    ) -> None:
        """Go on to `time` [s], with voltage [V] and current [A, positive discharging] where they are known.

        distance: ridden since the start [m]; seen: whether anything of the vehicle was known; charging: by a
        charger.
        """
        before, way = self._before or (time, distance)
        self._before = time, distance
        dt = time - before
        if not 0 <= dt <= self._most:
            return
        if voltage is not None and current is not None:
            energy = voltage * current * dt
            self.net = self.net or 0.0
            if charging:
                self.charged -= energy
                return
            self.net += energy
            self.recovered -= min(energy, 0.0)
            self.distance += distance - way
        elif seen:
            self.missing += dt
