"""An effect: one physical cause, in one file of ``model/effects``.

An effect file has
- a docstring: the cause, its equation, its source;
- ``PORT``: where it acts (one of `Port`);
- ``PARAMETERS``: a tuple of `Parameter`;
- ``term(quantity, ..., *, parameter, ...)``: the equation. Its positional arguments are quantities (names from
  `QUANTITIES`). Its keyword arguments are its parameters, those of the vehicle (`VEHICLE_PARAMETERS`) or those of the
  package's other effects. It is pure and takes floats and numpy arrays alike: operators, ``abs``, and the elementary
  functions of `model.functions`;
- if it has memory, ``decay(dt, quantity, ..., *, parameter, ...)``: the factor, 0 to 1, by which its state decays over
  ``dt`` [s]. The value of the effect is then the state x, 0 at the start, which follows the term:
  x' = decay·x + (1 - decay)·term, exact for quantities that are constant over the step;
- optional traits: ``STORES_ENERGY = True`` (it returns the energy it took, and the accelerometer measures it);
  ``TURNING_LOSS = True`` (a chassis that turns includes the same loss);
- ``variation(quantity, ..., *, nuisance, ...)`` where healthy vehicles are known to differ from the equation: a factor
  on the term, 1 at nuisances of 0, which the discovery fits. It may also take parameters, and their values on the
  healthy vehicle with ``healthy_`` before the name;
- for a candidate of the discovery: ``SHOWN_BY``, the data that would show it and the ride that would tell it from its
  look-alikes; ``STRENGTHS``, the parameters that then change (the first by default); ``VARIES = True`` if it differs
  from ride to ride by itself; ``CAUSE``, for an effect of every model: the name of a change of it, and its equation.

Sign conventions
    speed, motor torque, motor current   positive forward, driving
    battery current                      positive discharging
    forces at the wheel                  positive against the vehicle's motion: the motor has to overcome them
    powers and losses                    positive consuming
    grade                                positive uphill
    headwind                             positive against the vehicle
    lean                                 positive to the right; yaw rate positive to the left (as the IMU)
"""

from __future__ import annotations

import importlib
import inspect
import os
import stat
import sys
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from gz_onboard.errors import InputError, nearest, shown

if TYPE_CHECKING:
    from gz_onboard.toml import Table

Values = Any
"""A quantity, a term or a decay: a float, or an array (n,) over the steps of a ride."""


class Port(Enum):
    """The place where an effect acts, with the unit of its term."""

    WHEEL_FORCE = "N"  # road load at the driven wheel's contact, against the motion
    TYRE = "N (tyres)"  # the same, as a moment on the wheels: rolling loss
    MOTOR_LOSS = "W"  # heat in the motor: between shaft and inverter
    INVERTER_LOSS = "W (inverter)"  # heat in the inverter: between motor and DC link
    DC_POWER = "W (DC link)"  # power drawn from the pack, not through the inverter
    CELL_VOLTAGE = "V"  # lost in a cell beyond R0 and the RC pair; positive lowers the terminal voltage


ROAD_LOAD = (Port.WHEEL_FORCE, Port.TYRE)

QUANTITIES: dict[str, str] = {
    "speed": "m/s",
    "acceleration": "m/s^2",
    "grade": "sine of the road's angle",
    "grade_cosine": "cosine of the road's angle",
    "mass": "kg, vehicle and payload",
    "air_density": "kg/m^3",
    "headwind": "m/s",
    "lateral_acceleration": "m/s^2, horizontal, positive to the left: speed times yaw rate",
    "vibration": "m/s^2, RMS of the vertical acceleration faster than 0.1 s, over about 2 s",
    "motor_speed": "rad/s",
    "motor_current": "A, RMS, as torque over torque constant",
    "motor_temperature": "degC",
    "torque": "N·m, in the motor's air gap: torque constant times motor_current",
    "heading": "rad, clockwise from north",
    "time_moving": "s, faster than 0.5 m/s since the start",
    "ambient_temperature": "degC",
    "cell_current": "A, of one cell",
    "cell_temperature": "degC",
    "cell_capacity": "A·h, of one cell at its temperature",
    "soc": "1, state of charge",
}
PACKAGE_EFFECTS = Path(__file__).resolve().parent / "effects"
MOVING = 0.5  # m/s: slower does not count as time_moving


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect or of the vehicle.

    low, high: bounds for any road vehicle, from a kick scooter to a van of 3.5 t. The prior describes a scooter;
    grows_with: how it grows with another vehicle, as powers of that vehicle's sizes, such as "mass wheel_radius^2".
    required: no prior fits, so a file with a battery must give it. ride_sd: scatter of the value that rides show, from
    ride to ride, at the prior [unit]. healthy_sd: how much of it a healthy vehicle may show whose model does not
    include the effect. bench: it is found on a bench, at steady points.
    """

    name: str
    unit: str
    prior: float
    prior_sd: float
    low: float
    high: float
    source: str
    ride_sd: float | None = None
    healthy_sd: float | None = None
    bench: bool = False
    required: bool = False
    grows_with: str = ""

    def __post_init__(self) -> None:
        if not self.low <= self.prior <= self.high:
            raise ValueError(f"{self.name}: prior {self.prior} is outside {self.low} to {self.high} {self.unit}")


# How priors grow from the scooter to another vehicle: powers of its parameters, of "mass" (with payload) and of the
# numbers of cells. Losses, loads and limits are the same share of the power at the same acceleration and speed in any
# vehicle; noises and offsets of sensors are the same share of the pack's size, its other resistances of its cells'.
MASS = "vehicle_mass"
ELECTRONICS = "vehicle_mass^0.8"  # lights and control: a car's are not fifteen times a scooter's
ROTATION = "vehicle_mass wheel_radius^2"
TORQUE = "mass wheel_radius gear_ratio"
MOTOR_CURRENT = "mass wheel_radius gear_ratio torque_constant^-1"
MOTOR_RESISTANCE = "mass^-1 wheel_radius^-2 gear_ratio^-2 torque_constant^2"
CELLS = "cells_parallel cell_capacity cells_series"
PACK_CURRENT = "cells_parallel cell_capacity"
PACK_RESISTANCE = "cells_series cells_parallel^-1 cell_capacity^-1"

VEHICLE_PARAMETERS = (
    Parameter("vehicle_mass", "kg", 105, 5, 5, 5000, "GenZe 2.0 data sheet", required=True),
    Parameter("payload_mass", "kg", 80, 12, 0, 3000, "rider and what he carries"),
    Parameter("wheel_radius", "m", 0.245, 0.005, 0.04, 0.6, "effective, of the driven wheel", required=True),
    Parameter("wheelbase", "m", 1.32, 0.02, 0.3, 6, "GenZe 2.0 data sheet", grows_with="vehicle_mass^0.25"),
    Parameter("cg_to_rear", "m", 0.57, 0.08, 0.05, 4, "rear axle to centre of gravity", grows_with="wheelbase"),
    Parameter("cg_height", "m", 0.63, 0.08, 0.1, 2, "centre of gravity over the road"),
    Parameter("wheel_inertia_front", "kg·m²", 0.11, 0.03, 0, 50, "wheel and tyre", grows_with=ROTATION),
    Parameter("wheel_inertia_rear", "kg·m²", 0.34, 0.08, 0, 50, "wheel, tyre and hub motor", grows_with=ROTATION),
    Parameter("gear_ratio", "1", 1.0, 0.01, 0.02, 5, "wheel speed over motor speed: 0.2 for a reduction of 5"),
    Parameter("torque_constant", "N·m/A", 0.47, 0.02, 0.01, 10, "Lord 2016, table 2.5"),
    Parameter("caster_angle", "rad", 0.46, 0.04, 0.1, 0.8, "26 degrees: Cossalter 2006, sec. 1.3, scooters 24 to 28"),
    Parameter("tyre_crown_radius", "m", 0.05, 0.008, 0.001, 0.15, "half the width of a 100 mm scooter tyre"),
    Parameter("cornering_stiffness_front", "1/rad", 16, 4, 2, 60, "per load: Pacejka 2012, ch. 11: 14 to 19"),
    Parameter("cornering_stiffness_rear", "1/rad", 15, 4, 2, 60, "per load: Pacejka 2012, ch. 11: 13 to 22"),
    Parameter("camber_stiffness_front", "1/rad", 0.85, 0.15, 0, 2, "per load: Pacejka 2012, ch. 11: 0.8"),
    Parameter("camber_stiffness_rear", "1/rad", 0.85, 0.15, 0, 2, "per load: Pacejka 2012, ch. 11: 0.8"),
    Parameter("side_friction", "1", 1.2, 0.15, 0.1, 2, "largest side force per load: Pacejka 2012, ch. 11"),
    Parameter("twisting_arm", "m/rad", 0.02, 0.015, 0, 0.2, "brush model, 20 per load, half width 25 mm: C_κ·w²/(3·r)"),
    Parameter("speed_sensor_scale", "1", 1.0, 0.005, 0.5, 2, "reading of the motor's speed sensor over the speed"),
    Parameter(
        "regeneration_torque_limit",
        "N·m",
        prior=19,
        prior_sd=3,
        low=0,
        high=5000,
        source="most braking torque at the motor's shaft",
        grows_with=TORQUE,
    ),
)


@dataclass(frozen=True)
class Equation:
    """A function of an effect's file, with the names of its arguments."""

    function: Callable[..., Any]
    quantities: tuple[str, ...]  # positional, in order; of a decay ``dt`` is the first
    parameters: tuple[str, ...]  # by keyword

    @classmethod
    def of(cls, function: Callable[..., Any]) -> Equation:
        """Read the names from the signature."""
        arguments = inspect.signature(function).parameters.values()
        keywords = tuple(a.name for a in arguments if a.kind is a.KEYWORD_ONLY)
        return cls(function, tuple(a.name for a in arguments if a.kind is not a.KEYWORD_ONLY), keywords)

    def bound(self, values: Mapping[str, float]) -> Callable[..., Any]:
        """The equation with these `values` of its parameters: a function of quantities by name, and of ``dt`` [s]."""
        return _binder(self)(*[values[name] for name in self.parameters])


@cache
def _binder(equation: Equation) -> Callable[..., Callable[..., Any]]:
    """Compile `Equation.bound` from source: loops over names take three times as long, and it runs in each step."""
    arguments = [name if name == "dt" else f"q[{name!r}]" for name in equation.quantities]
    values = [f"value{i}" for i in range(len(equation.parameters))]
    arguments += [f"{name}={value}" for name, value in zip(equation.parameters, values, strict=True)]
    source = f"lambda {', '.join(values)}: lambda q, dt=0.0: equation({', '.join(arguments)})"
    return eval(source, {"equation": equation.function})  # type: ignore[no-any-return]


@dataclass(frozen=True)
class Effect:
    """An effect as loaded from its file."""

    name: str
    port: Port
    parameters: tuple[Parameter, ...]
    term: Equation
    decay: Equation | None
    stores_energy: bool
    module: ModuleType = field(repr=False)  # with the traits that only offline tools read: see `model.traits`

    @property
    def reads(self) -> frozenset[str]:
        """The quantities that term and decay need."""
        return frozenset((*self.term.quantities, *(self.decay.quantities[1:] if self.decay else ())))

    @property
    def takes(self) -> frozenset[str]:
        """The parameters that term and decay need."""
        return frozenset((*self.term.parameters, *(self.decay.parameters if self.decay else ())))

    @property
    def file(self) -> Path:
        """The Python file from which it was loaded."""
        return Path(inspect.getfile(self.term.function))

    def __reduce__(self) -> tuple[Callable[..., Effect], tuple[str, Path]]:
        """Pickle the file: another process does not know the modules of a user's folder."""
        return load_effect, (self.name, self.file.parent)


# --- finding and loading ------------------------------------------------------------------------------------------


def effects_in(folder: Path) -> tuple[str, ...]:
    """The names of the effects in `folder`; files that begin with _ do not count. InputError if it does not exist."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of effects")
    return tuple(sorted(file.stem for file in folder.glob("*.py") if not file.stem.startswith("_")))


@cache
def package_effects() -> dict[str, ModuleType]:
    """The modules of the package's effects, by name."""
    names = effects_in(PACKAGE_EFFECTS)
    return {name: importlib.import_module(f"gz_onboard.model.effects.{name}") for name in names}


def effect_file(name: str, folder: Path | None) -> Path | None:
    """The file of the effect `name` in `folder` itself; None if there is none."""
    file = folder and folder / f"{name}.py"
    return file if file and file.name == f"{name}.py" and file.is_file() else None


def load_effect(name: str, folder: Path | None = None) -> Effect:
    """The effect `name`: from `folder` if it has a file of that name, else from the package."""
    if file := effect_file(name, folder):
        try:
            return _effect(name, _import_file(name, file))
        except (InputError, KeyboardInterrupt):
            raise
        except BaseException as error:  # SystemExit too: a user's code does not end ours without a word
            raise failed(file, error) from error
    if name not in package_effects():
        known = [*package_effects(), *(effects_in(folder) if folder else ())]
        raise InputError(f"no effect is called {shown(name)}{nearest(name, known)}")
    return _effect(name, package_effects()[name])


def failed(file: Path, error: BaseException) -> InputError:
    """The error to raise about an effect's file whose code raised `error`."""
    return InputError(f"{file}: {type(error).__name__}: {error}")


def _import_file(name: str, file: Path) -> ModuleType:
    module = sys.modules[f"gz_onboard_user_effects.{name}"] = ModuleType(f"gz_onboard_user_effects.{name}")
    module.__file__ = str(file)
    # Not by an import, which would take bytecode from a folder next to the file that may be anybody's.
    exec(compile(file.read_bytes(), file, "exec", dont_inherit=True), module.__dict__)
    return module


def _effect(name: str, module: ModuleType) -> Effect:
    """The effect of a module, checked."""
    file = module.__file__
    for attribute in ("PORT", "PARAMETERS", "term"):
        if not hasattr(module, attribute):
            raise InputError(f"{file}: an effect needs {attribute}")
    declared = tuple(parameter.name for parameter in module.PARAMETERS)
    effect = Effect(
        name=name,
        port=module.PORT,
        parameters=tuple(module.PARAMETERS),
        term=Equation.of(module.term),
        decay=Equation.of(module.decay) if hasattr(module, "decay") else None,
        stores_energy=getattr(module, "STORES_ENERGY", False),
        module=module,
    )
    if effect.decay and effect.decay.quantities[:1] != ("dt",):
        raise InputError(f"{file}: the first argument of decay must be dt")
    for quantity in effect.reads - QUANTITIES.keys():
        raise InputError(f"{file}: no quantity is called {quantity!r}{nearest(quantity, QUANTITIES)}")
    of_others = effect.takes.difference(declared)
    if not effect.takes.issuperset(declared) or of_others - (of_others and _package_parameters()):
        raise InputError(f"{file}: PARAMETERS declares {list(declared)}, term and decay take {sorted(effect.takes)}")
    if not isinstance(module.PORT, Port):
        raise InputError(f"{file}: PORT must be one of {', '.join(f'Port.{port.name}' for port in Port)}")
    return effect


def _package_parameters() -> frozenset[str]:
    """The names of the parameters of the vehicle and of the package's effects."""
    declared = (VEHICLE_PARAMETERS, *(module.PARAMETERS for module in package_effects().values()))
    return frozenset(parameter.name for parameters in declared for parameter in parameters)


# --- the effects of a vehicle file, whose code runs only if nobody else can change it ---------------------------------

BASE_EFFECTS = (
    "aerodynamic_drag",
    "rolling_resistance",
    "grade_force",
    "inertia",
    "motor_copper_loss",
    "motor_iron_loss",
    "inverter_loss",
    "auxiliary_load",
)
"""The effects of every vehicle: the model of a file that lists none."""
ROOT = 0


def read_effects(
    vehicle: Table, folder: Path | None = None, users: Collection[int] | None = None
) -> tuple[Effect, ...]:
    """The effects that the vehicle file lists, or `BASE_EFFECTS`.

    An effect is looked for in `folder`, in the file's own ``effects_folder``, then in the package. Effects of the
    file's folder are code that came with data: they run only if nobody but `users` (their ids; by default root and the
    present user) can change the file or the effect. InputError otherwise.
    """
    if folder and not folder.is_dir():
        raise InputError(f"{folder}: no such folder of effects")
    table = vehicle.table("model")
    table.only(["effects", "effects_folder"])
    own = _own_folder(table)
    names = table.texts("effects", "names of effects") if "effects" in table.values else BASE_EFFECTS
    effects: dict[str, Effect] = {}
    for name in names:
        if name in effects:
            raise table.error(f"{shown(name)} is there twice", "effects")
        table.check_path("effects", name)
        try:
            file = None if effect_file(name, folder) else effect_file(name, own)
            if file:
                _check_trust(vehicle.file, file, trusted_users() if users is None else users)
            effects[name] = load_effect(name, own if file else folder or own)
        except Exception as error:
            raise table.error(str(error), "effects") from error
    return tuple(effects.values())


def _own_folder(model: Table) -> Path | None:
    """The file's ``effects_folder``, which must lie in the file's folder."""
    if "effects_folder" not in model.values:
        return None
    folder = model.file.parent / model.check_path("effects_folder", model.text("effects_folder"))
    if not folder.resolve().is_relative_to(model.file.parent.resolve()):
        raise model.error(f"{shown(str(folder))} is not below the vehicle file's own folder", "effects_folder")
    if not folder.is_dir():
        raise model.error(f"no folder {folder}", "effects_folder")
    return folder


def _check_trust(vehicle: Path, effect: Path, users: Collection[int]) -> None:
    """InputError if `effect` leaves the vehicle file's folder by a link, or others can change it or the file."""
    if not effect.resolve().is_relative_to(vehicle.parent.resolve()):
        raise InputError(f"{effect} is a link that leads out of the vehicle file's folder")
    if reason := changeable(vehicle, users) or changeable(effect, users):
        raise InputError(
            f"{effect.name} next to the file is code, and not run: {reason}; "
            "`run` and `discover` take a folder that you trust by --effects"
        )


def trusted_users() -> frozenset[int]:
    """The users whose files may run as code: root and the present user."""
    return frozenset((ROOT, os.geteuid()))


def changeable(file: Path, users: Collection[int]) -> str | None:
    """Why others than `users` (their ids) can change `file` or replace it; None if they cannot.

    Like sshd, it checks the file, after following links, and every folder above it. OSError if there is no file.
    """
    place = file.resolve(strict=True)
    for part in (place, *place.parents):
        status = part.stat()
        if status.st_uid not in users:
            return f"{part} belongs to user {status.st_uid}"
        sticky = part != place and status.st_mode & stat.S_ISVTX  # in /tmp, users can replace only their own files
        by_group = status.st_mode & stat.S_IWGRP and not _is_private_group(status.st_uid, status.st_gid)
        if (status.st_mode & stat.S_IWOTH or by_group) and not sticky:
            return f"{part} can be written by others (chmod go-w)"
    return None


def _is_private_group(user: int, group: int) -> bool:
    """Whether the group is the user's own, without other members, as Debian gives each user."""
    import grp
    import pwd

    try:
        entry = grp.getgrgid(group)
        return entry.gr_name == pwd.getpwuid(user).pw_name and not entry.gr_mem
    except KeyError:
        return False
