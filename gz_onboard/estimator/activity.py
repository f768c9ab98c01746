"""What the vehicle does: riding, standing, parked, charging, asleep. Only riding teaches what a kilometre costs.

A stop is short until it has lasted `STOP_TIME`, or the key is turned off or the contactor opens: then it is parked. So
it is with a charge plug in, and charging from the first charging current until none has flowed for `UNCHARGED_FOR`, or
as long as no current is known. Without a plug signal, or with one that is out, a charging current that lasts means
charging too, where it cannot be a brake's: at standstill, or while the inverter is silent.
"""

from __future__ import annotations

from math import inf

from gz_onboard.events import Activity
from gz_onboard.physics.effect import MOVING

STOP_TIME = 120.0  # s: a stop of up to this belongs to the ride, as at a traffic light; beyond, it is parked
STANDING_AFTER = 2.0  # s without motion
MOVING_AFTER = 1.0  # s of motion: a single sample of a noisy sensor is none
CHARGING_RATE = 0.02  # 1/h: a charging current of a fiftieth of the capacity; current sensors' offsets are smaller
CHARGING_AFTER = 3.0  # s of it at standstill: the last of a regenerative brake is over
SILENT_CHARGING_AFTER = 30.0  # s of it with no speed known and a silent inverter
UNCHARGED_FOR = 60.0  # s without that current: a charger that is dead, or done, though it is plugged in
DRAWING_RATE = 0.2  # 1/h: a drive draws more at standstill only if the speed is wrong
DRAWING_AFTER, DRAWING_MOST = 10.0, 30.0  # s of it at speed 0, less those without: the speed is wrong; most that counts
PLUGGED_IN = 0.5  # of a signal that is 0 or 1


class Activities:
    """Follows the activity from step to step."""

    def __init__(self) -> None:
        self.now = Activity.UNKNOWN
        self._still = inf  # s since the last motion; none yet
        self._followed = 0.0  # s since the first step
        self._moving = 0.0  # s of motion
        self._charging = 0.0  # s of a charging current without motion
        self._uncharged = inf  # s since the last such current that lasted
        self._drawing = 0.0  # s of a drive's current without motion, less those without it

    def step(
        self,
        dt: float,
        speed: float | None,
        c_rate: float | None,
        plug: float | None,
        inverter_silent: bool,
        off: bool = False,
        drive: float | None = None,
    ) -> None:
        """Go `dt` [s] on.

        speed: [m/s]. c_rate: current over capacity [1/h], positive discharging. plug: whether the charge plug is in.
        Each None where it is not known. inverter_silent: the vehicle has signals of its inverter and none comes. off:
        the key is off, or the contactor is open. drive: c_rate of the inverter alone, if that is known: a heater draws
        from the pack as much as a drive that creeps.
        """
        moving = speed is not None and abs(speed) > MOVING
        self._moving = self._moving + dt if moving else 0.0
        self._still = 0.0 if self._moving >= MOVING_AFTER else self._still + dt
        self._followed += dt
        drawn = c_rate if drive is None else drive
        drawing = drawn is not None and drawn > DRAWING_RATE
        self._drawing = 0.0 if moving else min(max(self._drawing + (dt if drawing else -dt), 0.0), DRAWING_MOST)
        if self._drawing >= DRAWING_AFTER:
            speed = None
        charged = c_rate is not None and c_rate < -CHARGING_RATE and not moving
        self._charging = self._charging + dt if charged else 0.0
        self._uncharged = 0.0 if self._charging >= CHARGING_AFTER else self._uncharged + dt
        plugged = plug is not None and plug > PLUGGED_IN and not moving
        flows = c_rate is None or self._uncharged < UNCHARGED_FOR
        enough = CHARGING_AFTER if speed is not None else SILENT_CHARGING_AFTER if inverter_silent else inf
        if (plugged and flows) or self._charging >= enough:
            self.now = Activity.CHARGING
        elif plugged and self._drawing < DRAWING_AFTER:
            self.now = Activity.PARKED
        elif speed is None:
            self.now = Activity.UNKNOWN
        elif moving or self._still < STANDING_AFTER:
            self.now = Activity.RIDING
        else:
            parked = off or min(self._still, self._followed) > STOP_TIME
            self.now = Activity.PARKED if parked else Activity.STANDING

    def shown(self, silent: bool, joined: bool) -> Activity:
        """The activity; silent: nothing comes from the bus; joined: no rest has shown the state of charge yet."""
        if silent:
            return Activity.UNKNOWN if self.now in (Activity.UNKNOWN, Activity.RIDING) else Activity.ASLEEP
        return Activity.JOINED if joined and self.now is Activity.RIDING else self.now

    @property
    def takes_charge(self) -> bool:
        """Whether the pack is charged, or could be: nothing drives."""
        return self.now is Activity.CHARGING and self._drawing == 0

    @property
    def teaches(self) -> bool:
        """Whether what flows now is part of a ride: motion, or a short stop."""
        known = self.now is not Activity.CHARGING and self._drawing < DRAWING_AFTER
        return known and self._charging == 0 and self._still <= STOP_TIME
