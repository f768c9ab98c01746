"""Parameters of a vehicle: read from its file with value, unit, standard deviation, status and source.

    [parameters]
    drag_area = { value = 0.52, unit = "m²", sd = 0.03, status = "measured", source = "coast-downs, 8 runs" }

``status`` is measured, data sheet or guess. A parameter that the file leaves out takes its prior, as a guess: that of a
scooter, scaled to this vehicle (`Parameter.grows_with`). Parameters without a usable prior are required of a file with
a battery. The correlations of parameters that were found together are for offline tools, see `priors`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from gz_onboard.errors import InputError, shown
from gz_onboard.model.effect import (
    CELLS,
    MASS,
    MOTOR_CURRENT,
    PACK_CURRENT,
    PACK_RESISTANCE,
    VEHICLE_PARAMETERS,
    Effect,
    Parameter,
    load_effect,
    package_effects,
)

if TYPE_CHECKING:
    from gz_onboard.toml import Table

STATUS = ("measured", "data sheet", "guess")

BATTERY_PARAMETERS = (
    Parameter("cell_capacity", "A·h", 2.8, 0.05, 0.1, 1000, "18650 cell, Lord 2016, sec. 2.2", required=True),
    Parameter(
        "cell_resistance_factor",
        "1",
        prior=1.0,
        prior_sd=0.1,
        low=0.2,
        high=10,
        source="R0 and R1 over their tables': a bench cell's to the pack's",
    ),
    Parameter("cell_cutoff_voltage", "V", 2.8, 0.05, 1.0, 4.0, "where the vehicle gives up", required=True),
    Parameter(
        "pack_series_resistance",
        "ohm",
        prior=0.01,
        prior_sd=0.005,
        low=0,
        high=2,
        source="bus bars, fuse and BMS, in series with the cells",
        grows_with=PACK_RESISTANCE,
    ),
    Parameter(
        "cable_resistance",
        "ohm",
        prior=0.005,
        prior_sd=0.005,
        low=0,
        high=2,
        source="pack to inverter, beyond where the BMS measures",
        grows_with=PACK_RESISTANCE,
    ),
    Parameter(
        "pack_current_offset",
        "A",
        prior=0.0,
        prior_sd=0.3,
        low=-50,
        high=50,
        source="reading of the current sensor at no current",
        grows_with=PACK_CURRENT,
    ),
    Parameter("pack_current_gain", "1", 1.0, 0.01, 0.5, 2, "reading of the current sensor over the current"),
    Parameter("pack_current_noise", "A", 0.1, 0.05, 0, 100, "sd of a sample", grows_with=PACK_CURRENT),
    Parameter("pack_voltage_noise", "V", 0.02, 0.01, 0, 20, "sd of a sample", grows_with="cells_series"),
    Parameter(
        "pack_voltage_offset",
        "V",
        prior=0.0,
        prior_sd=0.1,
        low=-50,
        high=50,
        source="error of the voltage sensor",
        grows_with="cells_series",
    ),
    Parameter(
        "pack_voltage_latency",
        "s",
        prior=0.0,
        prior_sd=0.05,
        low=-2,
        high=2,
        source="how far the pack's voltage lags its current; leads if negative",
    ),
    Parameter("cell_voltage_error", "V", 0.0, 0.012, 0, 0, "sd: what one RC pair cannot follow, slow as minutes"),
    Parameter("cell_voltage_error_empty", "V", 0.0, 0.06, 0, 0, "sd: the same at 5 % SOC and below"),
    Parameter("cell_voltage_error_time", "s", 600.0, 300.0, 10, 36000, "correlation time of that error"),
    Parameter("rest_voltage_error", "V", 0.0, 0.008, 0, 0, "sd: rest voltage against OCV: relaxation, hysteresis"),
    Parameter(
        "pack_heat_capacity",
        "J/K",
        prior=9000,
        prior_sd=3000,
        low=100,
        high=1e6,
        source="168 cells of 47 g at 0.95 J/(g·K), and the case",
        grows_with=CELLS,
    ),
    Parameter("pack_conductance", "W/K", 3.0, 1.5, 0.01, 10000, "still air to a closed pack", grows_with=CELLS),
)

# Only the simulation reads these.
SIMULATION_PARAMETERS = (
    Parameter(
        "voltage_constant",
        "V·s/rad",
        prior=0.544,
        prior_sd=0.01,
        low=0.001,
        high=20,
        source="Lord 2016, fig. 2.12: 0.057 V per r/min",
        grows_with="torque_constant",
    ),
    Parameter(
        "motor_current_limit",
        "A",
        prior=211,
        prior_sd=3,
        low=1,
        high=5000,
        source="the greatest current of the recorded rides",
        grows_with=MOTOR_CURRENT,
    ),
    Parameter(
        "cell_mass",
        "kg",
        prior=0.047,
        prior_sd=0.002,
        low=0.001,
        high=20,
        source="18650 cell: what one more adds to the vehicle",
        grows_with="cell_capacity",
    ),
    Parameter("gear_efficiency", "1", 1.0, 0.01, 0.5, 1.0, "a hub motor has no gear"),
    Parameter(
        "brake_force_per_pressure",
        "N/Pa",
        prior=20e-5,
        prior_sd=2e-5,
        low=1e-7,
        high=1.0,
        source="8 road rides: both brakes, pressures added",
        grows_with="mass",
    ),
    Parameter(
        "brake_torque_limit",
        "N·m",
        prior=280,
        prior_sd=60,
        low=1,
        high=50000,
        source="both wheels: 0.6 g with rider",
        grows_with="mass wheel_radius",
    ),
    Parameter("front_brake_share", "1", 0.65, 0.1, 0, 1, "of the braking torque; the rear wheel is unloaded"),
    Parameter("tyre_b", "1", 10.0, 3.0, 1, 40, "Pacejka 2012, ch. 4: with c and d a slip stiffness of 16 per load"),
    Parameter("tyre_c", "1", 1.65, 0.1, 1, 2.5, "Pacejka 2012, ch. 4: longitudinal"),
    Parameter("tyre_d", "1", 1.0, 0.15, 0.1, 2, "dry asphalt"),
    Parameter("tyre_e", "1", 0.3, 0.3, -5, 1, "Pacejka 2012, ch. 4"),
    Parameter(
        "bms_resistance",
        "ohm",
        prior=0.002,
        prior_sd=0.001,
        low=0,
        high=0.5,
        source="transistors of a 48 V BMS; its part of the series resistance",
        grows_with=PACK_RESISTANCE,
    ),
    Parameter("bms_heat_capacity", "J/K", 250, 100, 1, 1e5, "board and heat sink of 0.3 kg", grows_with=CELLS),
    Parameter("bms_conductance", "W/K", 0.6, 0.3, 0.001, 100, "to the battery it sits on", grows_with=CELLS),
    Parameter("inverter_board_capacity", "J/K", 600, 200, 1, 1e6, "board and sink of 0.7 kg", grows_with=MASS),
    Parameter("inverter_box_capacity", "J/K", 2200, 700, 1, 1e6, "aluminium box of 2.4 kg", grows_with=MASS),
    Parameter("inverter_board_to_air", "W/K", 1.5, 0.8, 0.001, 5000, "still air in the box", grows_with=MASS),
    Parameter("inverter_box_to_air", "W/K", 3.0, 1.5, 0.001, 5000, "still air in the box", grows_with=MASS),
    Parameter("inverter_board_to_box", "W/K", 4.0, 2.0, 0.001, 5000, "through its mounting", grows_with=MASS),
    Parameter("inverter_box_to_ambient", "W/K", 4.0, 2.0, 0.001, 5000, "box in moving air", grows_with=MASS),
    Parameter(
        "inverter_box_per_speed",
        "W·s/(K·m)",
        prior=0.0,
        prior_sd=0.2,
        low=0,
        high=500,
        source="what moving air adds to the one before",
        grows_with=MASS,
    ),
    Parameter("motor_stator_capacity", "J/K", 3000, 1000, 1, 1e6, "copper and iron of 7 kg", grows_with=MASS),
    Parameter("motor_rotor_capacity", "J/K", 4000, 1500, 1, 1e6, "rim and magnets of 8 kg", grows_with=MASS),
    Parameter(
        "motor_gap_conductance",
        "W/K",
        prior=5.0,
        prior_sd=2.0,
        low=0.001,
        high=5000,
        source="air gap and bearings of a hub motor",
        grows_with=MASS,
    ),
    Parameter("motor_rotor_to_ambient", "W/K", 6.0, 3.0, 0.001, 5000, "rim in moving air", grows_with=MASS),
    Parameter(
        "motor_rotor_per_speed",
        "W·s/(K·m)",
        prior=0.0,
        prior_sd=0.3,
        low=0,
        high=500,
        source="what moving air adds to the one before",
        grows_with=MASS,
    ),
    Parameter("cooling_factor", "1", 1.0, 0.1, 0.02, 5, "on what motor, inverter and pack give to the ambient air"),
    Parameter(
        "motor_iron_share", "1", 0.7, 0.2, 0, 1, "of iron and drag, in the stator; the rest in magnets and bearings"
    ),
)


REMOVED = {"brake_viscous_constant", "brake_disc_radius", "yaw_inertia", "tyre_relaxation_length"}
"""Parameters of earlier vehicle files that nothing reads."""
MOST_CELLS = 1000  # in series, or in parallel
USUAL_CELLS = {"cells_series": 14, "cells_parallel": 12}  # in the pack of the scooter that the priors describe


@dataclass(frozen=True)
class Value:
    """Knowledge of a parameter."""

    value: float
    sd: float
    unit: str
    status: str
    source: str


class Parameters(dict[str, float]):
    """The values by name; they do not change. known: each with its unit, standard deviation and source."""

    def __init__(
        self,
        known: Mapping[str, Value],
        declared: Mapping[str, Parameter] | None = None,
        filed: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__({name: value.value for name, value in known.items()})
        self.known = dict(known)
        self.declared = dict(declared or declared_parameters())  # with those of the user's own effects
        self._filed = dict(filed or {})  # values of the file that others have replaced

    def sd(self, name: str) -> float:
        """The standard deviation of `name`, in its unit."""
        return self.known[name].sd

    def filed(self, name: str) -> float:
        """The value of `name` in the vehicle file, before another was entered."""
        return self._filed.get(name, self[name])

    def replaced(self, **values: float) -> Parameters:
        """The same with other values, which whoever enters them is taken to know well: a tenth of the sd.

        InputError for a value outside the parameter's bounds.
        """
        known, filed = dict(self.known), dict(self._filed)
        for name, value in values.items():
            p = self.declared[name]
            if not p.low <= value <= p.high:
                raise InputError(f"{name}: {value:g} {p.unit} is outside {p.low:g} to {p.high:g} {p.unit}")
            filed.setdefault(name, self[name])
            known[name] = Value(value, 0.1 * self.sd(name), p.unit, "data sheet", "as entered")
        return Parameters(known, self.declared, filed)


def declared_parameters(effects: Iterable[Effect] = ()) -> dict[str, Parameter]:
    """Every parameter that a vehicle file may set: the vehicle's, the battery's, and those of all effects."""
    own = [load_effect(name) for name in package_effects()]
    of_effects = [p for effect in (*own, *effects) for p in effect.parameters]
    return {p.name: p for p in (*VEHICLE_PARAMETERS, *BATTERY_PARAMETERS, *SIMULATION_PARAMETERS, *of_effects)}


def read_parameters(vehicle: Table, effects: Iterable[Effect] = ()) -> Parameters:
    """The parameters in the vehicle file, or their priors. InputError naming line and value."""
    declared = declared_parameters(effects)
    table = vehicle.table("parameters")
    for name in sorted(REMOVED.intersection(table.values)):
        raise table.error("nothing reads this parameter any more: delete the line", name)
    table.only(declared)
    given = {name: _given(table, declared[name]) for name in table.values}
    if "battery" in vehicle.values:
        _check_required(vehicle, given, effects)
    pack = vehicle.table("battery")
    usual = USUAL_CELLS | {name: parameter.prior for name, parameter in declared.items()}
    sizes: dict[str, float] = {n: pack.integer(n, 1, MOST_CELLS) if n in pack.values else usual[n] for n in USUAL_CELLS}
    # The sizes of an effect that the model does not have are for the discovery to say.
    of_models = [p for effect in effects for p in effect.parameters]
    grows = {p.name for p in (*VEHICLE_PARAMETERS, *BATTERY_PARAMETERS, *SIMULATION_PARAMETERS, *of_models)}
    known: dict[str, Value] = {}
    for name, parameter in declared.items():
        size = relative_size(parameter.grows_with, sizes, usual) if name in grows else 1.0
        known[name] = given.get(name) or _prior(parameter, size)
        sizes[name] = known[name].value
    return Parameters(known, declared)


def relative_size(law: str, sizes: Mapping[str, float], usual: Mapping[str, float]) -> float:
    """How many times larger than the scooter's a quantity is that grows with `law`, see `Parameter.grows_with`.

    sizes, usual: parameters and numbers of cells of the vehicle and of the scooter.
    """
    size = 1.0
    for factor in law.split():
        name, _, power = factor.partition("^")
        names = ("vehicle_mass", "payload_mass") if name == "mass" else (name,)
        size *= (sum(sizes[n] for n in names) / sum(usual[n] for n in names)) ** float(power or 1)
    return size


def _prior(parameter: Parameter, size: float = 1.0) -> Value:
    """The guess of `parameter` on a vehicle of this relative `size`."""
    value = min(max(size * parameter.prior, parameter.low), parameter.high)
    return Value(value, size * parameter.prior_sd, parameter.unit, "guess", f"prior: {parameter.source}")


def _given(parameters: Table, parameter: Parameter) -> Value:
    """`parameter` as given in the file's table of `parameters`."""
    name, entry = parameter.name, parameters.table(parameter.name)
    entry.only(["value", "unit", "sd", "status", "source"])
    unit = entry.text("unit")
    if _plain(unit) != _plain(parameter.unit):
        raise entry.error(f"unit {shown(unit)} is wrong: {name} is in {parameter.unit!r}", "unit")
    value = entry.number("value")
    if not parameter.low <= value <= parameter.high:
        raise entry.error(f"{value:g} {unit} is outside {parameter.low:g} to {parameter.high:g} {unit}", "value")
    sd = entry.number("sd", low=0, high=1e9)
    return Value(value, sd, parameter.unit, entry.text("status", choices=STATUS), entry.text("source"))


def _plain(unit: str) -> str:
    """A unit without signs that are not on every keyboard: Ah, A*h and A·h are one, as are m2, m^2 and m²."""
    return unit.replace("²", "2").replace("Ω", "ohm").translate(str.maketrans("", "", "·*^ "))


def _check_required(vehicle: Table, given: Collection[str], effects: Iterable[Effect]) -> None:
    """InputError for a missing parameter that the vehicle's range needs and that has no usable prior."""
    of_effects = (p for effect in effects for p in effect.parameters)
    needed = [p for p in (*VEHICLE_PARAMETERS, *BATTERY_PARAMETERS, *of_effects) if p.required]
    if "motor_speed" in vehicle.table("roles").values:
        needed += [p for p in VEHICLE_PARAMETERS if p.name == "gear_ratio"]
    if missing := [p for p in needed if p.name not in given]:
        names = ", ".join(f"{p.name} [{p.unit}]" for p in missing)
        raise vehicle.table("parameters").error(
            f'must have {names}: no guess fits every vehicle. Give your own, with status = "guess" and an honest sd'
        )
