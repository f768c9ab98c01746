"""The four cooling networks (Lord 2016, eqs. 2.25-2.31). Conductances in W/K, heat capacities in J/K.

Each is a linear network, stepped with its mean heat; the fastest of its time constants is a minute. `air` in a step is
the factor on the conductance to the ambient: the airflow of riding, a fan.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import repeat
from typing import Protocol

PERIOD = 1.0  # s: what a simulation and a calibration step them by


class Network(Protocol):
    """A cooling network with its state."""

    @property
    def temperature(self) -> float:
        """Of the node that has the sensor [degC]."""

    def step(self, dt: float, heat: float, ambient: float, air: float = 1.0) -> None:
        """`heat` [W] into it for `dt` [s]; ambient: degC."""


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

    @classmethod
    def of(cls, p: Mapping[str, float], board: float, box: float | None = None) -> InverterCooling:
        """Of a vehicle's parameters, at these temperatures [degC]; the box is as warm as the board if not given."""
        names = ("board_capacity", "box_capacity", "board_to_air", "box_to_air", "board_to_box", "box_to_ambient")
        values = {name: p[f"inverter_{name}"] for name in names}
        return cls(**values, board=board, box=board if box is None else box)

    @property
    def temperature(self) -> float:
        """Of the board [degC]."""
        return self.board

    def step(self, dt: float, heat: float, ambient: float, air: float = 1.0) -> None:
        """See `Network`; the air between board and box stores no heat."""
        between = (self.board * self.board_to_air + self.box * self.box_to_air) / (self.board_to_air + self.box_to_air)
        across = self.board_to_box * (self.board - self.box)
        board = heat - self.board_to_air * (self.board - between) - across
        box = self.box_to_air * (between - self.box) + across - self.box_to_ambient * air * (self.box - ambient)
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

    @classmethod
    def of(cls, p: Mapping[str, float], stator: float, rotor: float | None = None) -> MotorCooling:
        """Of a vehicle's parameters, at these temperatures [degC]; the rotor is as warm as the stator if not given."""
        names = ("stator_capacity", "rotor_capacity", "rotor_to_ambient", "stator_share")
        values = {name: p[f"motor_{name}"] for name in names}
        gap = p["motor_gap_conductance"]
        return cls(**values, gap=gap, stator=stator, rotor=stator if rotor is None else rotor)

    @property
    def temperature(self) -> float:
        """Of the stator [degC]."""
        return self.stator

    def step(self, dt: float, heat: float, ambient: float, air: float = 1.0) -> None:
        """See `Network`."""
        across = self.gap * (self.stator - self.rotor)
        stator = self.stator_share * heat - across
        rotor = (1 - self.stator_share) * heat + across - self.rotor_to_ambient * air * (self.rotor - ambient)
        self.stator += dt * stator / self.stator_capacity
        self.rotor += dt * rotor / self.rotor_capacity


@dataclass
class LumpedCooling:
    """One mass to its surroundings: the battery to the air (eq. 2.30), the BMS to the battery (eq. 2.31)."""

    capacity: float
    conductance: float
    temperature: float  # degC

    @classmethod
    def of(cls, p: Mapping[str, float], part: str, temperature: float) -> LumpedCooling:
        """The `part` (``pack``, ``bms``) of a vehicle's parameters, at a temperature [degC]."""
        return cls(p[f"{part}_heat_capacity"], p[f"{part}_conductance"], temperature)

    def step(self, dt: float, heat: float, ambient: float, air: float = 1.0) -> None:
        """See `Network`."""
        self.temperature += dt * (heat - self.conductance * air * (self.temperature - ambient)) / self.capacity


def temperatures(
    network: Network, dt: float, heat: Iterable[float], ambient: Iterable[float], air: Iterable[float] | None = None
) -> list[float]:
    """Of the node that has the sensor [degC], at the beginnings of steps of `dt` [s] with `heat` [W] in them."""
    result = []
    for watts, outside, flow in zip(heat, ambient, repeat(1.0) if air is None else air, strict=air is not None):
        result.append(network.temperature)
        network.step(dt, watts, outside, flow)
    return result
