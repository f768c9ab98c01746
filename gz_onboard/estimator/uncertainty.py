"""How uncertain what enters the SOC filter is: counted charge, the cell model, the voltage."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

from gz_onboard.constants import BENCH_TEMPERATURE, HOUR
from gz_onboard.estimator.signals import TIMING
from gz_onboard.estimator.sources import CurrentSource
from gz_onboard.physics.battery import Battery
from gz_onboard.physics.parameters import Parameters

SAMPLING_RATE = 0.15  # 1/h: sd of the mean current over capacity between two samples that are seconds apart
# Errors of currents are C-rates (1/h: A over the pack's A·h at the bench's temperature), as sensors and loads are sized
# by the pack (of 32.8 A·h, where they were found); those of voltages are a cell's (of 14).
UNCHECKED_SD = 0.2 / 32.8  # 1/h, beside the offset's, while no second sensor confirms the first
EMPTY_BELOW, EMPTY_FROM = 0.15, 0.05  # SOC between which the model's error grows to that of an empty cell
RESISTANCE_SD = 0.12  # relative: measured tables of R0 and R1, for this pack at this place and temperature
RESISTANCE_SD_COLD = 0.4  # the same where the cell temperature is not known
HISTORY_TIME = HOUR  # s that stays what depends on the cell's history, on its place on the curve and on the sensor
INVERTER_VOLTAGE_SD = 0.15 / 14  # V of a cell: the cable between pack and inverter


class CurrentError(NamedTuple):
    """Of a pack current, beside the sensor's own offset."""

    sd: float  # 1/h
    time: float  # s that such an error stays the same


class SlowError(NamedTuple):
    """Of a cell's voltage by the model, what stays the same for long."""

    variance: float  # V²
    time: float  # s that it stays


CURRENT_ERRORS = {
    CurrentSource.PACK: CurrentError(0.0, HOUR),
    CurrentSource.INVERTER: CurrentError(0.5 / 32.8, HOUR),  # the auxiliary load
    CurrentSource.DISPUTED: CurrentError(6 / 32.8, HOUR),  # the one that is right may be either
    CurrentSource.MODEL: CurrentError(3 / 32.8, 600.0),  # wind and load, of which some stay for minutes
    CurrentSource.NONE: CurrentError(15 / 32.8, 60.0),  # any riding
}


class ChargeUncertainty:
    """The variance of SOC that counting charge adds. Remembers what errs one way."""

    def __init__(self, battery: Battery, parameters: Parameters) -> None:
        p = parameters
        self._rated = battery.pack_capacity(BENCH_TEMPERATURE)  # A·h
        self._offset_sd = p.sd("pack_current_offset")
        self._charge_sd = sqrt((p.sd("cell_capacity") / p["cell_capacity"]) ** 2 + p.sd("pack_current_gain") ** 2)
        self._unseen = 0.0  # of SOC: sd of what errs one way

    def counted(self, dt: float, flowed: float, charge: float, error: CurrentError, apart: float | None) -> float:
        """Variance after `dt` [s] in which a share `flowed` of the capacity `charge` [A·s] was counted.

        apart: a second sensor confirms the first, but for what they differ in the mean [A]; None: there is none.
        """
        checked = UNCHECKED_SD * self._rated if apart is None else apart
        sd = sqrt(self._offset_sd**2 + checked**2 + (error.sd * self._rated) ** 2)
        return (sd / charge) ** 2 * 2 * error.time * dt + self._charge_sd**2 * abs(flowed)

    @staticmethod
    def between_samples(dt: float, period: float) -> float:
        """Variance after `dt` [s] of samples that are a long `period` [s] apart."""
        return (SAMPLING_RATE / HOUR) ** 2 * dt * period if period > TIMING.coarse else 0.0

    def uncounted(self, more: float, soc_sd: float) -> float:
        """Variance after `more` of SOC may have flowed that was not counted, as in a pause.

        What was taken for it errs the same way each time: the rider goes on as before, the load stays. soc_sd: what is
        known at most.
        """
        before = min(self._unseen, soc_sd)
        self._unseen = before + more
        return (2 * before + more) * more


class VoltageUncertainty:
    """Standard deviations [V of a cell] of a voltage as a measurement of the state of charge."""

    def __init__(self, battery: Battery, parameters: Parameters) -> None:
        p = parameters
        self._battery = battery
        self.model = p.sd("cell_voltage_error")
        self.rest = sqrt(p.sd("rest_voltage_error") ** 2 + battery.ocv_sd**2 + battery.rest_shift_sd**2)
        self.resistance = max(RESISTANCE_SD, p.sd("cell_resistance_factor"))  # relative
        self._empty = p.sd("cell_voltage_error_empty")
        self._error_time = p["cell_voltage_error_time"]
        self._sensor = (p.sd("pack_voltage_offset") / battery.cells_series) ** 2  # V²
        # What depends on the cell's history, hysteresis before all.
        self._history = p.sd("rest_voltage_error") ** 2 + battery.rest_shift_sd**2  # V²
        self._capacity_scatter = p.sd("cell_capacity") / p["cell_capacity"]

    def loaded(self, soc: float, temperature: float) -> float:
        """Sd of the cell model under load [V]: it errs more near empty, and in the cold."""
        model, empty = self._battery.voltage_error(temperature, self.model), self._empty
        share = min(max((EMPTY_BELOW - soc) / (EMPTY_BELOW - EMPTY_FROM), 0.0), 1.0)
        return model + share * max(empty - model, 0.0)

    def error_time(self, temperature: float) -> float:
        """For how long [s] the circuit errs the same way: in the cold for longer, as what it lacks is slower there."""
        return self._battery.voltage_error_time(temperature, self._error_time)

    def slow(self, soc: float, temperature: float, soc_variance: float) -> SlowError:
        """What errs the same way for a time: the circuit, the tables' place, the sensor.

        While the state of charge is known to a large `soc_variance` only, the circuit's error is the one to wait for;
        the better it is known, the more of what a voltage is off by is what stays.
        """
        # The pack's cells are not the bench's: where SOC lies on their curve is known to their capacity's scatter.
        slope = self._battery.ocv(soc)[1]
        axis_sd = self._capacity_scatter * (1 - soc) * slope
        stays = axis_sd**2 + self._history + self._sensor
        share = stays / (stays + slope**2 * soc_variance)
        circuit = self.error_time(temperature)
        time = circuit + share * max(HISTORY_TIME - circuit, 0.0)
        return SlowError(self.loaded(soc, temperature) ** 2 + stays, time)

    def tells_more(self, soc: float, variance: float) -> bool:
        """Whether a voltage can tell more than a state of charge that is known to `variance`.

        What stays for hours does not average out, however many voltages there are: so little do they tell on a flat
        curve with hysteresis.
        """
        return bool(self._battery.ocv(soc)[1] ** 2 * variance > self._history)

    def load(
        self, r0: float, drops: tuple[float, float], source: CurrentSource, temperature_known: bool, voltage_sd: float
    ) -> float:
        """Variance [V²] of what changes with the load, of a voltage measured with `voltage_sd` [V].

        drops: by R0 and the effects, and by the RC pair [V]; r0: [ohm]; of a cell, as all of them.
        """
        resistance_sd = self.resistance if temperature_known else max(self.resistance, RESISTANCE_SD_COLD)
        current_sd = CURRENT_ERRORS[source].sd * self._battery.cell_capacity(BENCH_TEMPERATURE)
        doubted = max(voltage_sd**2 - self._sensor, 0.0)
        return resistance_sd**2 * (drops[0] ** 2 + drops[1] ** 2) + (r0 * current_sd) ** 2 + doubted
