"""The four cooling networks (Lord 2016, eqs. 2.25-2.31). Conductances in W/K, heat capacities in J/K.

Each is a linear network, stepped with its mean heat over `PERIOD`: the fastest of its time constants is a minute.
"""

from __future__ import annotations

from dataclasses import dataclass

PERIOD = 1.0  # s


@dataclass
class InverterCooling:
    """Board and box with air between (eqs. 2.25-2.27; 2.27 printed without the sign of the first term)."""

    board_capacity: float
    box_capacity: float
    board_to_air: float
    box_to_air: float
    board_to_box: float
    box_to_ambient: float
    board: float  # degC
    box: float  # degC

    @property
    def temperature(self) -> float:
        """Of the board [degC]."""
        return self.board

    def step(self, dt: float, heat: float, ambient: float) -> None:
        """`heat` [W] into the board for `dt` [s]."""
        air = (self.board * self.board_to_air + self.box * self.box_to_air) / (self.board_to_air + self.box_to_air)
        across = self.board_to_box * (self.board - self.box)
        board = heat - self.board_to_air * (self.board - air) - across
        box = self.box_to_air * (air - self.box) + across - self.box_to_ambient * (self.box - ambient)
        self.board += dt * board / self.board_capacity
        self.box += dt * box / self.box_capacity


@dataclass
class MotorCooling:
    """Stator and rotor (eqs. 2.28, 2.29); `stator_share` is the thesis' alpha."""

    stator_capacity: float
    rotor_capacity: float
    gap: float
    rotor_to_ambient: float
    stator_share: float
    stator: float  # degC
    rotor: float  # degC

    @property
    def temperature(self) -> float:
        """Of the stator [degC]."""
        return self.stator

    def step(self, dt: float, heat: float, ambient: float) -> None:
        """`heat` [W] into the motor for `dt` [s]."""
        across = self.gap * (self.stator - self.rotor)
        stator = self.stator_share * heat - across
        rotor = (1 - self.stator_share) * heat + across - self.rotor_to_ambient * (self.rotor - ambient)
        self.stator += dt * stator / self.stator_capacity
        self.rotor += dt * rotor / self.rotor_capacity


@dataclass
class LumpedCooling:
    """One mass to its surroundings: the battery to the air (eq. 2.30), the BMS to the battery (eq. 2.31)."""

    capacity: float
    conductance: float
    temperature: float  # degC

    def step(self, dt: float, heat: float, ambient: float) -> None:
        """`heat` [W] into it for `dt` [s]."""
        self.temperature += dt * (heat - self.conductance * (self.temperature - ambient)) / self.capacity
