"""Inputs of the forward model for the present motion, collected from the parts that hold them."""

from __future__ import annotations

from gz_onboard.estimator.forecast import Forecaster
from gz_onboard.estimator.load_model import WARM_MOTOR, Conditions, EffectInputs
from gz_onboard.estimator.motion import Motion, VibrationMonitor
from gz_onboard.estimator.soc import StateOfCharge
from gz_onboard.estimator.temperatures import Temperatures
from gz_onboard.physics.battery import HALF_FULL


class ModelInputs:
    """Present inputs of the model, and the power that it gives. All methods take the time [s]."""

    def __init__(
        self,
        forecaster: Forecaster,
        motion: Motion,
        temperatures: Temperatures,
        soc: StateOfCharge,
        monitor: VibrationMonitor | None,
    ) -> None:
        """`monitor`: for a model that reads the vibration."""
        self._forecaster, self._load = forecaster, forecaster.load
        self._motion, self._temperatures, self._soc, self._monitor = motion, temperatures, soc, monitor

    def conditions(self, now: float, motor_temperature: float | None = None) -> Conditions:
        """Air and motor; `motor_temperature` in degC, if it is known."""
        motor = WARM_MOTOR if motor_temperature is None else motor_temperature
        return Conditions(self._temperatures.ambient(now), self._motion.altitude or 0.0, motor)

    def power(self, now: float) -> float:
        """Power that the pack gives [W]."""
        motion = self._motion
        return self.power_at(now, motion.speed or 0.0, motion.acceleration or 0.0, motion.grade or 0.0)

    def power_at(self, now: float, speed: float, acceleration: float, grade: float = 0.0) -> float:
        """Power that the pack would give [W] at this speed [m/s], acceleration [m/s²] and grade (sine)."""
        conditions = self.conditions(now)
        quantities = self._load.quantities(speed, acceleration, conditions)
        quantities["grade"] = grade
        if inputs := self.effect_inputs(now):
            self._load.extend(quantities, inputs, conditions.ambient, self._forecaster.riding.time_moving)
        return self._load.power(quantities)

    def power_of_prior(self, now: float) -> float:
        """Power of the riding before the first voltage [W]: the prior's, or, where it rides faster, at its speed."""
        conditions, speed = self.conditions(now), self._motion.speed or 0.0
        power, usual = self._load.prior_ride(conditions.ambient, conditions.altitude)
        return max(power, self.power_at(now, speed, 0.0)) if speed > usual else power

    def effect_inputs(self, now: float) -> EffectInputs | None:
        """What effects beyond the base's may read; None if the model has none."""
        if not self._load.extended:
            return None
        motion, filter_ = self._motion, self._soc.filter
        return EffectInputs(
            None if motion.yaw_rate is None or motion.speed is None else motion.speed * motion.yaw_rate,
            motion.heading,
            filter_.soc if filter_ else HALF_FULL,
            self._temperatures.cells_or_bench,
            self._soc.current or 0.0,
            self._monitor.value(now) if self._monitor else None,
        )

    def cell_inputs(self, now: float) -> dict[str, float]:
        """Inputs of effects in the cells, apart from those of the cells themselves."""
        inputs = {"time_moving": self._forecaster.riding.time_moving}
        return inputs | {"vibration": self.vibration(now)} if self._monitor else inputs

    def vibration(self, now: float) -> float:
        """What effects read as ``vibration`` [m/s²]: the typical value while it is not known."""
        value = self._monitor.value(now) if self._monitor else None
        return self._load.typical_vibration(self._motion.speed or 0.0) if value is None else value
