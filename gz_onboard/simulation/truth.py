"""The true states of a simulated ride at each step, and what follows from them."""

from __future__ import annotations

import numpy as np

from gz_onboard.arrays import Array, running_mean
from gz_onboard.constants import GRAVITY
from gz_onboard.model.effect import MOVING, Port
from gz_onboard.model.model import Bound
from gz_onboard.model.series import all_quantities, over, total
from gz_onboard.simulation.run import Run
from gz_onboard.simulation.scooter import Scooter
from gz_onboard.simulation.turning import lean_of

LEAN_TIME = 1.0  # s that a rider takes into a bend: the road's pieces change their curvature at once


class Truth:
    """Everything that the sensors read, as arrays over the steps; SI units, temperatures in degC, angles in rad.

    Columns of a `Run` that kept its steps (ValueError if it did not), each before its step, and ``acceleration`` and
    ``way`` (of the body over the ground: none on a dynamometer), ``yaw_rate`` (left), ``lean`` (right; of a leaning
    chassis its own, else `lean_of`), ``lean_rate``, ``pitch_rate`` (nose down), ``heading`` (from north), ``north`` and
    ``east`` [m], ``auxiliary_power`` (of all effects at the DC link), ``auxiliary_current``. ``vibration`` is 0 unless
    the model reads it.
    """

    def __init__(self, run: Run, scooter: Scooter) -> None:
        if run.steps is None:
            raise ValueError("the run has not kept its steps")
        self.parameters = scooter.vehicle.parameters
        self.ambient = scooter.ambient
        self.on_dynamometer = scooter.dynamometer is not None
        self.dt = dt = scooter.dt
        self.columns = c = {name: column[:-1] for name, column in run.steps.items()}
        self.count = len(c["time"])
        moving = 0.0 if self.on_dynamometer else 1.0
        c["way"] = moving * c["speed"]
        c["acceleration"] = np.gradient(c["way"], dt)
        width = min(2 * round(LEAN_TIME / dt / 2) + 1, self.count)
        curvature = running_mean(c["curvature"], width)
        c["yaw_rate"] = c["way"] * curvature
        if scooter.chassis and scooter.chassis.leans:
            c["lean"] = running_mean(c["lean"], width)
        else:
            # Nobody leans on a chassis without lean; its sensors are those of one that does.
            crown, height = self.parameters["tyre_crown_radius"], self.parameters["cg_height"]
            ideal = -np.arctan(c["way"] ** 2 * curvature / GRAVITY)
            c["lean"] = np.array([lean_of(x, crown, height) for x in ideal.tolist()])
        c["lean_rate"] = np.gradient(c["lean"], dt)
        c["slope"] = np.arcsin(running_mean(c["grade"], width))
        c["pitch_rate"] = -np.gradient(c["slope"], dt)
        c["heading"] = scooter.start_heading - np.cumsum(c["yaw_rate"]) * dt
        c["north"] = np.cumsum(c["way"] * np.cos(c["heading"])) * dt
        c["east"] = np.cumsum(c["way"] * np.sin(c["heading"])) * dt
        c["auxiliary_power"] = self._auxiliary(scooter)
        c["auxiliary_current"] = c["auxiliary_power"] / c["pack_voltage"]

    def _auxiliary(self, scooter: Scooter) -> Array:
        """Power of all effects at the DC link except the inverter [W]."""
        c = self.columns
        q = all_quantities(
            speed=c["way"],
            acceleration=c["acceleration"],
            grade=c["grade"],
            soc=c["soc"],
            lateral_acceleration=c["way"] * c["yaw_rate"],
            heading=c["heading"],
            motor_current=c["motor_current"],
            motor_temperature=c["motor_temperature"],
            cell_temperature=c["cell_temperature"],
            time_moving=np.cumsum(c["way"] > MOVING) * self.dt,
            ambient_temperature=self.ambient,
            vibration=c["vibration"],
        )
        effects = [Bound(effect, self.parameters) for effect in scooter.vehicle.model.effects]
        drawn = total([e for e in effects if e.effect.port is Port.DC_POWER], q, over(self.dt))
        return np.asarray(np.zeros(self.count) + drawn)

    def __getitem__(self, name: str) -> Array:
        return self.columns[name]

    def constant(self, value: float) -> Array:
        """`value` at every step."""
        return np.full(self.count, value)
