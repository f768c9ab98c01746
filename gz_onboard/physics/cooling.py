"""The four cooling networks (Lord 2016, eqs. 2.25-2.31). Conductances in W/K, heat capacities in J/K.

Each is a linear network, stepped with its mean heat; the fastest of its time constants is a minute. What motor and
inverter give to the ambient grows with the speed of the air that passes them: that of the vehicle, of a fan before a
roller, none in a closed room.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from gz_onboard.arrays import Array

PERIOD = 1.0  # s: what a simulation and a calibration step them by


class Network(Protocol):
    """A cooling network with its state."""

    @property
    def temperature(self) -> float:
        """Of the node that has the sensor [degC]."""

    def step(self, dt: float, heat: float, ambient: float, air: float = 0.0, factor: float = 1.0) -> None:
        """`heat` [W] into it for `dt` [s]; ambient: degC; air: m/s; factor: on what it gives to the ambient."""


def to_ambient(still: float, per_speed: float, air: float) -> float:
    """Conductance to the ambient [W/K] in moving `air` [m/s]; still: without [W/K], per_speed: W/K per m/s."""
    return still + per_speed * air


@dataclass
class InverterCooling:
    """Board and box with air between (eqs. 2.25-2.27; 2.27 printed without the sign of the first term)."""

    board_capacity: float
    box_capacity: float
    board_to_air: float
    box_to_air: float
    board_to_box: float
    box_to_ambient: float
    box_per_speed: float
    board: float  # degC
    box: float  # degC

    @classmethod
    def of(cls, p: Mapping[str, float], board: float, box: float | None = None) -> InverterCooling:
        """Of a vehicle's parameters, at these temperatures [degC]; the box is as warm as the board if not given."""
        names = ("board_capacity", "box_capacity", "board_to_air", "box_to_air", "board_to_box")
        values = {name: p[f"inverter_{name}"] for name in (*names, "box_to_ambient", "box_per_speed")}
        return cls(**values, board=board, box=board if box is None else box)

    @property
    def temperature(self) -> float:
        """Of the board [degC]."""
        return self.board

    def step(self, dt: float, heat: float, ambient: float, air: float = 0.0, factor: float = 1.0) -> None:
        """See `Network`; the air between board and box stores no heat."""
        outside = factor * to_ambient(self.box_to_ambient, self.box_per_speed, air)
        between = (self.board * self.board_to_air + self.box * self.box_to_air) / (self.board_to_air + self.box_to_air)
        across = self.board_to_box * (self.board - self.box)
        board = heat - self.board_to_air * (self.board - between) - across
        box = self.box_to_air * (between - self.box) + across - outside * (self.box - ambient)
        self.board += dt * board / self.board_capacity
        self.box += dt * box / self.box_capacity


@dataclass
class MotorCooling:
    """Stator and rotor (eqs. 2.28, 2.29).

    The thesis splits all heat by one share alpha. Here copper loss is the stator's, whose it is, and the share is that
    of what turning costs without current: iron in both, magnets and bearings.
    """

    stator_capacity: float
    rotor_capacity: float
    gap: float
    rotor_to_ambient: float
    rotor_per_speed: float
    iron_share: float
    stator: float  # degC
    rotor: float  # degC

    @classmethod
    def of(cls, p: Mapping[str, float], stator: float, rotor: float | None = None) -> MotorCooling:
        """Of a vehicle's parameters, at these temperatures [degC]; the rotor is as warm as the stator if not given."""
        names = ("stator_capacity", "rotor_capacity", "rotor_to_ambient", "rotor_per_speed", "iron_share")
        values = {name: p[f"motor_{name}"] for name in names}
        gap = p["motor_gap_conductance"]
        return cls(**values, gap=gap, stator=stator, rotor=stator if rotor is None else rotor)

    @property
    def temperature(self) -> float:
        """Of the stator [degC]."""
        return self.stator

    def step(
        self, dt: float, heat: float, ambient: float, air: float = 0.0, factor: float = 1.0, idle: float = 0.0
    ) -> None:
        """See `Network`; idle: the part of `heat` [W] that turning costs without current."""
        across = self.gap * (self.stator - self.rotor)
        of_rotor = (1 - self.iron_share) * idle
        stator = heat - of_rotor - across
        outside = factor * to_ambient(self.rotor_to_ambient, self.rotor_per_speed, air)
        rotor = of_rotor + across - outside * (self.rotor - ambient)
        self.stator += dt * stator / self.stator_capacity
        self.rotor += dt * rotor / self.rotor_capacity


@dataclass
class LumpedCooling:
    """One mass to its surroundings: the battery to the air (eq. 2.30), the BMS to the battery (eq. 2.31).

    Both are inside, where moving air does not reach them.
    """

    capacity: float
    conductance: float
    temperature: float  # degC

    @classmethod
    def of(cls, p: Mapping[str, float], part: str, temperature: float) -> LumpedCooling:
        """The `part` (``pack``, ``bms``) of a vehicle's parameters, at a temperature [degC]."""
        return cls(p[f"{part}_heat_capacity"], p[f"{part}_conductance"], temperature)

    def step(self, dt: float, heat: float, ambient: float, air: float = 0.0, factor: float = 1.0) -> None:
        """See `Network`; whatever `air` is."""
        self.temperature += dt * (heat - self.conductance * factor * (self.temperature - ambient)) / self.capacity


def pack_constants(p: Mapping[str, float]) -> tuple[float, float]:
    """Of a pack in the ambient air (eq. 2.30): (conductance [W/K], time constant [s])."""
    conductance = p["pack_conductance"] * p["cooling_factor"]
    return conductance, p["pack_heat_capacity"] / conductance


def temperatures(network: Network, dt: float, *columns: Array) -> list[float]:
    """Of the node that has the sensor [degC], at the beginnings of steps of `dt` [s].

    columns: what the network's step takes after `dt`, in its order, each (n,): heat, ambient, air, factor, idle.
    """
    result = []
    for row in zip(*(column.tolist() for column in columns), strict=True):
        result.append(network.temperature)
        network.step(dt, *row)
    return result
