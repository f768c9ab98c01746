"""The four cooling networks (Lord 2016, eqs. 2.25-2.31).

Each is linear and stepped with its mean heat; the fastest of its time constants is a minute. Motor and inverter give
more heat to the ambient the faster the air passes them: the speed of the vehicle, that of a fan before a roller, 0 in a
closed room. In all steps: heat in W, ambient in degC, air in m/s, and a factor on the conductance to the ambient.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gz_onboard.arrays import Array

PERIOD = 1.0  # s: step of simulation and calibration


@dataclass
class InverterCooling:
    """Board and box with air between them (eqs. 2.25-2.27; 2.27 is printed without the sign of its first term)."""

    parameters: Mapping[str, float]
    temperature: float  # degC, of the board, which has the sensor
    box: float  # degC

    def step(self, dt: float, heat: float, ambient: float, air: float = 0.0, factor: float = 1.0) -> None:
        """Advance by `dt` [s]. The air between board and box stores no heat."""
        p = self.parameters
        board_to_air, box_to_air = p["inverter_board_to_air"], p["inverter_box_to_air"]
        outside = factor * (p["inverter_box_to_ambient"] + p["inverter_box_per_speed"] * air)
        between = (self.temperature * board_to_air + self.box * box_to_air) / (board_to_air + box_to_air)
        across = p["inverter_board_to_box"] * (self.temperature - self.box)
        board = heat - board_to_air * (self.temperature - between) - across
        box = box_to_air * (between - self.box) + across - outside * (self.box - ambient)
        self.temperature += dt * board / p["inverter_board_capacity"]
        self.box += dt * box / p["inverter_box_capacity"]


@dataclass
class MotorCooling:
    """Stator and rotor (eqs. 2.28, 2.29).

    The thesis divides all heat by one share alpha. Here copper loss heats the stator, and the share divides the loss of
    turning without current: iron in both, magnets and bearings.
    """

    parameters: Mapping[str, float]
    temperature: float  # degC, of the stator, which has the sensor
    rotor: float  # degC

    def step(
        self, dt: float, heat: float, ambient: float, air: float = 0.0, factor: float = 1.0, idle: float = 0.0
    ) -> None:
        """Advance by `dt` [s]; idle: the part of `heat` [W] that is lost without current."""
        p = self.parameters
        across = p["motor_gap_conductance"] * (self.temperature - self.rotor)
        of_rotor = (1 - p["motor_iron_share"]) * idle
        outside = factor * (p["motor_rotor_to_ambient"] + p["motor_rotor_per_speed"] * air)
        rotor = of_rotor + across - outside * (self.rotor - ambient)
        self.temperature += dt * (heat - of_rotor - across) / p["motor_stator_capacity"]
        self.rotor += dt * rotor / p["motor_rotor_capacity"]


@dataclass
class LumpedCooling:
    """One mass: the battery in the air (eq. 2.30), the BMS on the battery (eq. 2.31).

    Both are inside, where moving air does not reach them.
    """

    parameters: Mapping[str, float]
    part: str  # pack, bms
    temperature: float  # degC

    def step(self, dt: float, heat: float, ambient: float, air: float = 0.0, factor: float = 1.0) -> None:
        """Advance by `dt` [s], whatever `air` is."""
        conductance = self.parameters[f"{self.part}_conductance"]
        stored = heat - conductance * factor * (self.temperature - ambient)
        self.temperature += dt * stored / self.parameters[f"{self.part}_heat_capacity"]


Network = InverterCooling | MotorCooling | LumpedCooling


def temperatures(network: Network, dt: float, *columns: Array) -> list[float]:
    """Temperature of the node that has the sensor [degC], at the beginnings of steps of `dt` [s].

    columns: the arguments of the network's step after `dt`, in order, each (n,): heat, ambient, air, factor, idle.
    """
    result = []
    for row in zip(*(column.tolist() for column in columns), strict=True):
        result.append(network.temperature)
        network.step(dt, *row)
    return result
