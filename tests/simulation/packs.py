"""A pack and a motor of another make, to put in place of the project's own."""

from dataclasses import dataclass
from math import exp

from gz_onboard.model.battery import Battery
from gz_onboard.model.functions import Mesh
from gz_onboard.simulation.parts import FirstOrderPack


class SecondOrderPack(FirstOrderPack):
    """With a second, slow RC pair, written out without the project's equations."""

    def __init__(self, battery: Battery, soc: float, r2: float = 0.008, tau2: float = 1200.0) -> None:
        super().__init__(battery, soc)
        self.r2, self.tau2, self.v2 = r2, tau2, 0.0

    def draw(self, power: float, dt: float, temperature: float) -> tuple[float, float, float, float]:
        fast, self.v1 = self.v1, self.v1 + self.v2
        current, voltage, heat, delivered = super().draw(power, dt, temperature)
        cell = current / self.battery.cells_parallel
        self.v1 = self._decay * fast + self._gain * current
        slow = exp(-dt / self.tau2)
        self.v2 = slow * self.v2 + (1 - slow) * self.r2 * cell
        return current, voltage, heat, delivered


@dataclass
class MapMotor:
    """With a measured loss map [W] over current [A] and speed [rad/s]: the one of docs/explanation/simulation.md."""

    watts: Mesh
    name: str = "motor_map_loss"

    def loss(self, speed: float, current: float, temperature: float) -> float:
        return self.watts.at(current, abs(speed))[0]
