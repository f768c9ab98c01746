"""Typical tables of cells by their chemistry, out of open literature: to begin with, until a cell is measured.

Rest voltages are at 25 degC, read at common points from published curves and averaged; their sd holds how far the cells
of one chemistry lie apart, and their hysteresis. Resistances are given times the capacity (ohm·A·h), which is about the
same for large and small cells of one build, and over that at 25 degC.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

Row = tuple[float, ...]

SOC: Row = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0)
TEMPERATURES: Row = (-20.0, -10.0, 0.0, 10.0, 25.0, 40.0)  # degC
RESISTANCE_OVER_TEMPERATURE: Row = (6.0, 3.6, 2.2, 1.5, 1.0, 0.78)  # of that at 25 degC
COLD = (
    "over temperature as the 18650 cell of the reference scooter, measured from -10 to 40 degC: an activation energy "
    "of 25 kJ/mol, where cell models have 18 to 35 (Kim 2011, Chen 2020)"
)
RELAXATION = 40.0  # s, of the RC pair: 20 to 70 in the cells that were compared
RESISTANCE_SD = 0.4  # relative: from a cell for power to one for energy
ERROR_SD = 0.03  # V: what tables of other cells miss under load


@dataclass(frozen=True)
class Chemistry:
    """What cells of one kind have in common."""

    name: str  # as cells are sold
    cutoff: tuple[float, float]  # V and its sd, where vehicles give up
    ocv: Row  # V over `SOC`
    ocv_sd: float  # V
    ocv_source: str
    rest_sd: float  # V, by which a rest misses the open-circuit voltage: relaxation, hysteresis
    rest_source: str
    r0: float  # ohm·A·h at 25 degC
    r1: float  # ohm·A·h, likewise
    r_source: str
    capacity: Row  # over `TEMPERATURES`, of that at 25 degC
    capacity_sd: float  # relative, when cold
    capacity_source: str
    curve: str  # what its rest voltage tells

    def resistance(self, times_capacity: float, capacity: float) -> list[float]:
        """ohm at each of `TEMPERATURES`, of a cell of this `capacity` [A·h]."""
        return [times_capacity / capacity * factor for factor in RESISTANCE_OVER_TEMPERATURE]


_HIGH_NICKEL = partial(
    Chemistry,
    cutoff=(3.0, 0.1),
    capacity=(0.9, 0.945, 0.965, 0.98, 1.0, 1.0),
    capacity_sd=0.04,
    capacity_source="slow discharge: cell of the reference scooter -10 degC 0.94, 0 degC 0.96; Huria 2012, 5 degC "
    "1.01; -20 degC a guess. What data sheets show at high current (Samsung 15L: 0.80 at 0 degC) is mostly resistance",
    rest_sd=0.01,
    rest_source="relaxation and hysteresis of a few mV",
)
NMC = _HIGH_NICKEL(
    name="NMC",
    ocv=(2.5, 2.95, 3.18, 3.355, 3.508, 3.59, 3.662, 3.72, 3.81, 3.905, 3.998, 4.082, 4.124, 4.162, 4.195),
    ocv_sd=0.035,
    ocv_source="mean of LG M50 (Chen 2020, its electrodes), Kokam 28 A·h (Huria 2012) and the 18650 cell of the "
    "reference scooter, whose curve is one of NMC: within 0.07 V of each other; below 0.3 of the first and the "
    "last, up to 0.17 V apart",
    r0=0.080,
    r1=0.050,
    r_source="R0 and R1 at 25 degC together 0.13 ohm·A·h: BMW i3 0.10, 18650 of the reference scooter 0.16, Kokam "
    "28 A·h (Huria 2012) 0.29",
    curve="rises by some 9 mV for each percent above 50 %, by 6 below it: a rest tells the charge to 3 to 5 %",
)
NCA = _HIGH_NICKEL(
    name="NCA",
    ocv=(2.5, 2.95, 3.19, 3.34, 3.48, 3.585, 3.658, 3.741, 3.838, 3.934, 4.03, 4.088, 4.108, 4.155, 4.197),
    ocv_sd=0.025,
    ocv_source="mean of Samsung 40T (C/20) and Molicel P42A (C/32), mean of charge and discharge (Sunil 2025): within "
    "0.02 V of each other from 0.05 on; cells of other makers, with silicon in the anode, differ more",
    r0=0.055,
    r1=0.035,
    r_source="R0 and R1 at 25 degC together 0.09 ohm·A·h: by pulses of 20 s Molicel P28A 0.05, Samsung 50S 0.07 "
    "(tayvoy.com), which are cells for power; twice that in cells for energy",
    curve="rises by some 9 mV for each percent in the middle and half of that above 80 %: a rest tells the charge "
    "to 3 to 5 %",
)
LFP = Chemistry(
    name="LFP",
    cutoff=(2.6, 0.15),
    ocv=(2.5, 2.94, 3.12, 3.205, 3.246, 3.281, 3.286, 3.294, 3.31, 3.324, 3.33, 3.335, 3.338, 3.36, 3.49),
    ocv_sd=0.015,
    ocv_source="mean of Lithium Werks APR18650M1B (C/32, Sunil 2025) and a published table of an unnamed cell: "
    "within 0.02 V of each other from 0.1 to 0.95",
    rest_sd=0.015,
    rest_source="hysteresis: after charging it rests up to 0.03 V higher than after discharging",
    r0=0.040,
    r1=0.030,
    r_source="R0 and R1 at 25 degC together 0.07 ohm·A·h: three times the 0.02 that EVE LF105 has at 1 kHz by its data "
    "sheet (0.20 mohm), and of the size of NMC's; a guess",
    capacity=(0.55, 0.68, 0.8, 0.91, 1.0, 1.03),
    capacity_sd=0.1,
    capacity_source="data sheets at C/3 or so: Victron LFP Smart 0.80 at 0 degC, 0.50 at -20; U-Power 0.80 and 0.70; "
    "other cells 0.80 and 0.44, -10 degC 0.66; some of it is resistance",
    curve="is flat: 60 mV from 30 to 95 %, some 1 mV for each percent, so that a rest tells nothing there but 'not "
    "empty, not full'. The state of charge comes from counting, and until a charge to the top the interval is wide",
)
CHEMISTRIES = {chemistry.name.lower(): chemistry for chemistry in (NMC, NCA, LFP)}
