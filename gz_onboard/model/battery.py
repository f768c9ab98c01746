"""The battery as a first-order equivalent circuit (Lord 2016, eqs. 2.20-2.24), one representative cell.

    dSOC/dt = -I/(3600·Ah)      dV1/dt = -V1/(R1·C1) + I/C1      V = V_oc(SOC, T) - R0·I - V1

with I the cell's current, positive when discharging. R0, R1 and C1 are tables over SOC and temperature. V_oc continues
beyond full and empty along its last slope, so that an estimate that strays there still finds its way back. A cold cell
rests lower: with `rest_shift` V_oc(SOC, T) = V_oc(SOC) + shift(T). Its heat is its loss (eq. 2.24) and, with `entropy`
over SOC, the reversible heat of the reaction.

Simulation, estimator, calibration, validation and discovery all call these equations, for floats and numpy arrays
alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import sqrt
from typing import Any, TypeVar

from gz_onboard.constants import HOUR, KELVIN
from gz_onboard.model.functions import Mesh, PiecewiseLinear

T = TypeVar("T")
Overpotential = Callable[[float, float, float, float], float]
"""Mean voltage [V] that a cell loses beyond R0 and the RC pair: a function of its mean current [A], SOC, temperature
[degC] and form factor squared, see `Battery.settled_current`."""
HALF_FULL = 0.5  # SOC that is taken where it is not known
MOST_SOC_SD = 0.3  # a SOC of which nothing is known lies between 0 and 1: that is 0.29
QUICK = 60.0  # s: of a cell's voltage, changes that are slower may be the charge's


def discharged(current: Any, dt: Any, capacity: Any) -> Any:
    """The share of SOC that `current` [A] takes in `dt` [s] out of `capacity` [A·h] (eq. 2.21)."""
    return current * dt / (HOUR * capacity)


def current_of(power: float, source: float, resistance: float) -> float | None:
    """Current [A] that delivers `power` [W] from a `source` [V] behind `resistance` [ohm]; None if none can."""
    root = source * source - 4 * resistance * power
    return None if root < 0 else 2 * power / (source + sqrt(root))


def reversible_heat(entropy: Any, current: Any, temperature: Any) -> Any:
    """Heat [W] of the change of order in the electrodes, -I·T·dU/dT (Bernardi 1985); cold if it is negative.

    entropy: dU/dT of the open-circuit voltage [V/K]; temperature in degC. Its sign changes with the current's. It does
    not show in the voltage: the cell exchanges this heat with its surroundings.
    """
    return -entropy * current * (temperature + KELVIN)


@dataclass(frozen=True)
class Window:
    """The cells' states of charge at which the vehicle shows empty and full: it keeps the rest for itself.

    sd: of each. given: the vehicle file says it; else the cells are used until their cut-off voltage.
    """

    low: float = 0.0
    high: float = 1.0
    sd: float = 0.0
    given: bool = False

    def shown(self, soc: float, sd: float) -> tuple[float, float]:
        """(state of charge as the vehicle shows it, its sd) for that of the cells."""
        width = self.high - self.low
        return min(max((soc - self.low) / width, 0.0), 1.0), min(sqrt(sd * sd + self.sd**2) / width, MOST_SOC_SD)

    def of_cells(self, shown: float) -> float:
        """The cells' state of charge for the vehicle's."""
        return self.low + shown * (self.high - self.low)


@dataclass(frozen=True, slots=True)
class WeakGroup:
    """How the weakest of the groups in series differs from the mean cell."""

    charge: float  # of SOC: how much less it holds when the mean cell is full
    capacity: float  # relative: how much less it holds, and so how much faster its SOC falls
    resistance: float  # relative: how much higher it is
    sd: float = 0.0  # of the mean cell's SOC at which it ends

    def soc(self, mean: float) -> float:
        """Of the group, where the mean cell's is `mean`."""
        return mean - self.charge - self.capacity * (1 - mean)


@dataclass(frozen=True, slots=True)
class Health:
    """How a pack has aged, as factors on what its file says; every equation of `Battery` has them in it."""

    capacity: float = 1.0
    resistance: float = 1.0  # of R0, R1 and what effects in the cells take, as far as they show within `QUICK`
    weakest: WeakGroup | None = None  # None: all groups are taken to be alike

    def carried(self, current: float, ages: float) -> float:
        """The current [A] by which an effect that ages less makes the loss of the aged cell at `current` [A].

        ages: the share of the effect that grows with the resistance.
        """
        return (1 + (self.resistance - 1) * ages) * current


@dataclass(frozen=True)
class Battery:
    """A pack of `cells_series` by `cells_parallel` cells."""

    cells_series: int
    cells_parallel: int
    capacity: float  # A·h of a cell at 25 degC
    capacity_share: PiecewiseLinear  # of the capacity at 25 degC, over degC
    cutoff_voltage: float  # V of a cell
    series_resistance: float  # ohm, of the pack without its cells
    ocv_curve: PiecewiseLinear  # V of a cell over SOC, both increasing
    ocv_sd: float  # V
    r0: Mesh  # ohm
    r1: Mesh  # ohm
    c1: Mesh  # F
    resistance_factor: float = 1.0  # that is in r0, r1 and c1
    resistance_sd: float = 0.0  # relative, of that factor
    rest_shift_curve: PiecewiseLinear | None = None  # V of a cell over degC; None: V_oc does not depend on temperature
    rest_shift_sd: float = 0.0  # V
    window: Window = field(default_factory=Window)
    entropy: PiecewiseLinear | None = None  # V/K of a cell over SOC; None: no reversible heat
    voltage_error_curve: PiecewiseLinear | None = None  # V of a cell, sd, over degC; None: the same at all temperatures
    voltage_error_time_curve: PiecewiseLinear | None = None  # s, over degC; None: the same at all temperatures
    as_new: float = 0.5  # probability that the pack is as its file says, before anything is learned of its age
    capacity_sd: float = 0.01  # relative: how closely a pack that is as new holds `capacity`
    health: Health = Health()  # see `aged`

    @cached_property
    def _soc_of_ocv(self) -> PiecewiseLinear:
        return PiecewiseLinear(self.ocv_curve.y, self.ocv_curve.x)

    def cell_capacity(self, temperature: float) -> float:
        """Capacity of a cell [A·h] at `temperature` [degC]: the charge between SOC 0 and 1."""
        fresh = self.capacity * self.capacity_share.at(temperature)
        return self.health.capacity * fresh

    def pack_capacity(self, temperature: float) -> float:
        """Capacity of the pack [A·h] at `temperature` [degC]."""
        return self.cell_capacity(temperature) * self.cells_parallel

    def rest_shift(self, temperature: float) -> float:
        """How much higher [V] a cell rests at `temperature` [degC] than `ocv_curve` says."""
        return self.rest_shift_curve.at(temperature) if self.rest_shift_curve else 0.0

    def voltage_error(self, temperature: float, usual: float) -> float:
        """Error [V, sd] of the circuit at `temperature` [degC]; `usual` [V] if the file does not say."""
        return self.voltage_error_curve.at(temperature) if self.voltage_error_curve else usual

    def voltage_error_time(self, temperature: float, usual: float) -> float:
        """Correlation time [s] of that error at `temperature` [degC]; `usual` [s] if the file does not say."""
        return self.voltage_error_time_curve.at(temperature) if self.voltage_error_time_curve else usual

    def ocv(self, soc: float, temperature: float | None = None) -> tuple[float, float]:
        """(open-circuit voltage of a cell [V], its slope [V]) at `temperature` [degC]; None: as tabulated over SOC."""
        volts, slope = self.ocv_curve.extended(soc)
        if temperature is not None and self.rest_shift_curve:
            volts += self.rest_shift_curve.at(temperature)
        return volts, slope

    def reversible_heat(self, current: float, soc: float, temperature: float) -> float:
        """`reversible_heat` of the pack [W] at its `current` [A] and `temperature` [degC]."""
        if self.entropy is None:
            return 0.0
        return float(reversible_heat(self.cells_series * self.entropy.at(soc), current, temperature))

    def soc_at(self, ocv: float, temperature: float | None = None) -> float:
        """The SOC at which the open-circuit voltage of a cell is `ocv` [V]; `temperature` as for `ocv`."""
        if temperature is not None:
            ocv -= self.rest_shift(temperature)
        return self._soc_of_ocv.extended(ocv)[0]

    def circuit(self, soc: float, temperature: float) -> tuple[float, float, float]:
        """(R0 [ohm], R1 [ohm], C1 [F]) of a cell at `temperature` [degC]."""
        return self.r0.at(soc, temperature)[0], self.r1.at(soc, temperature)[0], self.c1.at(soc, temperature)[0]

    def cell_voltage(self, pack_voltage: T, pack_current: T) -> T:
        """Voltage of the mean cell [V] out of pack voltage [V] and current [A]."""
        return (pack_voltage + self.series_resistance * pack_current) / self.cells_series  # type: ignore[operator,return-value]

    def pack_voltage(self, cell_voltage: Any, pack_current: Any) -> Any:
        """Voltage at the pack's terminals [V] out of that of the mean cell [V] and pack current [A] (eq. 2.18)."""
        return self.cells_series * cell_voltage - self.series_resistance * pack_current

    def with_parameters(self, parameters: Mapping[str, float]) -> Battery:
        """The battery as its file has it, with capacity, cut-off and resistances of a vehicle's `parameters`."""
        factor = parameters["cell_resistance_factor"]
        more = factor / self.resistance_factor
        return replace(
            self,
            capacity=parameters["cell_capacity"],
            cutoff_voltage=parameters["cell_cutoff_voltage"],
            series_resistance=parameters["pack_series_resistance"],
            r0=self.r0.scaled(more),
            r1=self.r1.scaled(more),
            c1=self.c1.scaled(1 / more),  # the time constant stays
            resistance_factor=factor,
        )

    def aged(self, health: Health) -> Battery:
        """Return the pack aged to `health`."""
        r = health.resistance / self.health.resistance
        r0, r1, c1 = self.r0.scaled(r), self.r1.scaled(r), self.c1.scaled(1 / r)  # the time constant stays
        return replace(self, r0=r0, r1=r1, c1=c1, health=health)

    def settled_current(
        self,
        power: float,
        soc: float,
        temperature: float,
        form_factor_squared: float = 1.0,
        overpotential: Overpotential | None = None,
        guess: float | None = None,
    ) -> float | None:
        """Mean pack current [A] that delivers a mean `power` [W] once the RC pair has settled; None if none can.

        form_factor_squared: the mean square of the current over the square of its mean: in traffic the current comes
        in bursts, which heat R0 more than a steady one; the RC pair smooths them. overpotential: voltage that a cell
        loses beyond R0 and the RC pair. guess: a current [A] within some per cent, which saves an iteration.
        """
        n, m = self.cells_series, self.cells_parallel
        source = n * self.ocv(soc, temperature)[0]
        cell = form_factor_squared * self.r0.at(soc, temperature)[0] + self.r1.at(soc, temperature)[0]
        resistance = n * cell / m + form_factor_squared * self.series_resistance
        if overpotential is None:
            return current_of(power, source, resistance)
        current = current_of(power, source, resistance) if guess is None else guess
        for _ in range(2 if guess is None else 1):  # it moves the current by a percent, and that moves it by a percent
            if current is not None:
                lost = overpotential(current / m, soc, temperature, form_factor_squared)
                current = current_of(power, source - n * lost, resistance)
        return current
