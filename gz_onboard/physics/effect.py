"""What an effect is: one physical cause, in one file of ``physics/effects``.

An effect file has
- a docstring: what it is, its equation, its source;
- ``PORT``: where it acts (one of `Port`);
- ``PARAMETERS``: a tuple of `Parameter` (name, unit, prior, its sd, low, high, source);
- ``term(quantity, ..., *, parameter, ...)``: the equation. Its positional arguments are the quantities that it
  reads (names from `QUANTITIES`), its keyword arguments are its parameters, or
  those of the vehicle (`VEHICLE_PARAMETERS`), or those of the package's other effects. Pure; floats and numpy arrays
  alike, so it uses operators, ``abs``, and the functions of `physics.elementary` only;
- if it has memory, ``decay(dt, quantity, ..., *, parameter, ...)``: the factor, 0 to 1, that its state keeps over
  ``dt`` [s]. The effect's value then is not the term but the state x, 0 at the start, which goes to what the term
  says: x' = decay·x + (1 - decay)·term, exact for quantities that are constant over the step;
- what others need to know of it, if so: ``STORES_ENERGY = True`` (it gives back what it took, and the accelerometer
  measures it), ``TURNING_LOSS = True`` (a chassis that turns has the same loss);
- ``variation(quantity, ..., *, nuisance, ...)``, if healthy vehicles are known to differ from the equation: the factor
  on the term, 1 at nuisances of 0, which discovery fits. It may take parameters too, and what they are on the healthy
  vehicle as ``healthy_`` before the name;
- ``SHOWN_BY``, if it is a candidate of the discovery: the data that would show it, and the ride that would split it
  from its look-alikes; ``STRENGTHS``, the parameters that then change, the first if it is not given; ``VARIES = True``
  if it differs from ride to ride by itself; ``CAUSE``, if every model has the effect: what a change of it is called,
  and its equation.

Sign conventions
    speed, motor torque, motor current   positive forward, driving
    battery current                      positive discharging
    forces at the wheel                  positive against the vehicle's motion (what the motor has to overcome)
    powers and losses                    positive consuming
    grade                                positive uphill
    headwind                             positive against the vehicle
    lean                                 positive to the right; yaw rate positive to the left (as the IMU)
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import pkgutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from gz_onboard.errors import InputError, nearest, shown


class Port(Enum):
    """Where an effect acts, with the unit of its term."""

    WHEEL_FORCE = "N"  # road load at the driven wheel's contact, against the motion
    TYRE = "N (tyres)"  # the same, as a moment on the wheels: rolling loss
    MOTOR_LOSS = "W"  # heat in the motor: between shaft and inverter
    INVERTER_LOSS = "W (inverter)"  # heat in the inverter: between motor and DC link
    DC_POWER = "W (DC link)"  # power drawn from the pack beside the inverter
    CELL_VOLTAGE = "V"  # what a cell's terminals lack, beside OCV, R0 and the one RC pair; positive lowers them


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
MOVING = 0.5  # m/s: what counts for time_moving


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect: what it is and what it can be.

    low, high: of any road vehicle, from a kick scooter to a van of 3.5 t. The prior is that of a scooter; how it grows
    with another vehicle is in `physics.similarity`, and what nothing there tells is `required` of a file with a
    battery. ride_sd: by how much what rides show of it scatters from ride to ride [unit], at the prior. healthy_sd:
    within what a healthy vehicle may show of it where its model lacks the effect. bench: found on one at steady points.
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

    def __post_init__(self) -> None:
        if not self.low <= self.prior <= self.high:
            raise ValueError(f"{self.name}: prior {self.prior} is outside {self.low} to {self.high} {self.unit}")


VEHICLE_PARAMETERS = (
    Parameter("vehicle_mass", "kg", 105, 5, 5, 5000, "GenZe 2.0 data sheet", required=True),
    Parameter("payload_mass", "kg", 80, 12, 0, 3000, "rider and what he carries"),
    Parameter("wheel_radius", "m", 0.245, 0.005, 0.04, 0.6, "effective, of the driven wheel", required=True),
    Parameter("wheelbase", "m", 1.32, 0.02, 0.3, 6, "GenZe 2.0 data sheet"),
    Parameter("cg_to_rear", "m", 0.57, 0.08, 0.05, 4, "rear axle to centre of gravity"),
    Parameter("cg_height", "m", 0.63, 0.08, 0.1, 2, "centre of gravity over the road"),
    Parameter("wheel_inertia_front", "kg·m²", 0.11, 0.03, 0, 50, "wheel and tyre"),
    Parameter("wheel_inertia_rear", "kg·m²", 0.34, 0.08, 0, 50, "wheel, tyre and hub motor"),
    Parameter("gear_ratio", "1", 1.0, 0.01, 0.02, 5, "wheel speed over motor speed: 0.2 for a reduction of 5"),
    Parameter("torque_constant", "N·m/A", 0.47, 0.02, 0.01, 10, "Lord 2016, table 2.5"),
    Parameter("yaw_inertia", "kg·m²", 28, 6, 0.1, 20000, "Cossalter 2006, ch. 7: m·(0.39 m)² with rider"),
    Parameter("caster_angle", "rad", 0.46, 0.04, 0.1, 0.8, "26 degrees: Cossalter 2006, sec. 1.3, scooters 24 to 28"),
    Parameter("tyre_crown_radius", "m", 0.05, 0.008, 0.001, 0.15, "half the width of a 100 mm scooter tyre"),
    Parameter("cornering_stiffness_front", "1/rad", 16, 4, 2, 60, "per load: Pacejka 2012, ch. 11: 14 to 19"),
    Parameter("cornering_stiffness_rear", "1/rad", 15, 4, 2, 60, "per load: Pacejka 2012, ch. 11: 13 to 22"),
    Parameter("camber_stiffness_front", "1/rad", 0.85, 0.15, 0, 2, "per load: Pacejka 2012, ch. 11: 0.8"),
    Parameter("camber_stiffness_rear", "1/rad", 0.85, 0.15, 0, 2, "per load: Pacejka 2012, ch. 11: 0.8"),
    Parameter("side_friction", "1", 1.2, 0.15, 0.1, 2, "largest side force per load: Pacejka 2012, ch. 11"),
    Parameter("twisting_arm", "m/rad", 0.02, 0.015, 0, 0.2, "brush model, 20 per load, half width 25 mm: C_κ·w²/(3·r)"),
    Parameter("tyre_relaxation_length", "m", 0.15, 0.05, 0.02, 1, "sideways: Cossalter 2006, sec. 2.6, 0.1 to 0.3 m"),
    Parameter("speed_sensor_scale", "1", 1.0, 0.005, 0.5, 2, "what the motor's speed sensor shows over what is"),
    Parameter("regeneration_torque_limit", "N·m", 19, 3, 0, 5000, "most braking torque at the motor's shaft"),
)


@dataclass(frozen=True)
class Variation:
    """How a healthy vehicle may differ from an effect's equation: a factor on its term."""

    factor: Callable[..., Any]
    quantities: tuple[str, ...]
    keywords: tuple[str, ...]

    def of(self, quantities: Mapping[str, Any], values: Mapping[str, float]) -> Any:
        """The factor at these quantities and nuisances."""
        read = [quantities[name] for name in self.quantities]
        return self.factor(*read, **{name: values[name] for name in self.keywords})


@dataclass(frozen=True)
class Effect:
    """An effect as loaded from its file."""

    name: str
    port: Port
    parameters: tuple[Parameter, ...]
    quantities: tuple[str, ...]
    keywords: tuple[str, ...]  # parameters that the term takes: its own and the vehicle's
    term: Callable[..., Any]
    doc: str
    decay: Callable[..., Any] | None = None
    decay_quantities: tuple[str, ...] = ()
    decay_keywords: tuple[str, ...] = ()
    shown_by: str = ""
    variation: Variation | None = None
    stores_energy: bool = False
    turning_loss: bool = False
    strengths: tuple[str, ...] = ()  # parameters that change where it is found, the one that is reported first
    varies: bool = False  # from ride to ride by itself
    cause: tuple[str, str] | None = None  # name and equation of a change, of an effect that every model has

    @property
    def reads(self) -> frozenset[str]:
        """The quantities that it needs, for its term and its decay."""
        return frozenset((*self.quantities, *self.decay_quantities))

    @property
    def file(self) -> Path:
        """The Python file that it was loaded from."""
        return Path(inspect.getfile(self.term))

    def __reduce__(self) -> tuple[Callable[..., Effect], tuple[str, str]]:
        """Pickled as its file: another process does not know the modules of a user's own."""
        return _again, (self.name, str(self.file))


def _again(name: str, file: str) -> Effect:
    """The effect `name` of a Python file, as another process knew it."""
    return load_effect(name, Path(file).parent)


@cache
def known_effects() -> tuple[str, ...]:
    """The names of the effects that come with the package."""
    from gz_onboard.physics import effects

    return tuple(sorted(module.name for module in pkgutil.iter_modules(effects.__path__)))


def load_effect(name: str, folder: Path | None = None) -> Effect:
    """The effect `name`, from `folder` if it has one of that name, else the package's own."""
    if folder and (file := effect_file(name, folder)):
        try:
            return _effect(name, _import_file(name, file))
        except (InputError, KeyboardInterrupt):
            raise
        except BaseException as error:  # SystemExit too: a user's code does not end ours without a word
            raise failed(file, error) from error
    if name not in known_effects():
        known = [*known_effects(), *effects_in(folder)] if folder else known_effects()
        raise InputError(f"no effect is called {shown(name)}{nearest(name, known)}")
    return _effect(name, importlib.import_module(f"gz_onboard.physics.effects.{name}"))


def effect_file(name: str, folder: Path) -> Path | None:
    """The file of the effect `name` in `folder` itself; None if there is none."""
    file = folder / f"{name}.py"
    return file if file.name == f"{name}.py" and file.is_file() else None


def effects_in(folder: Path) -> tuple[str, ...]:
    """The names of the effects in a user's folder (files that begin with _ are none). InputError if there is none."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of effects")
    return tuple(sorted(file.stem for file in folder.glob("*.py") if not file.stem.startswith("_")))


@cache
def _others_parameters() -> frozenset[str]:
    """The names of the parameters that the package's effects declare."""
    modules = (importlib.import_module(f"gz_onboard.physics.effects.{name}") for name in known_effects())
    return frozenset(parameter.name for module in modules for parameter in module.PARAMETERS)


def _import_file(name: str, file: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"gz_onboard_user_effects.{name}", file)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    # Not `exec_module`, which would take bytecode from a folder beside the file that may be anybody's.
    exec(compile(file.read_bytes(), file, "exec", dont_inherit=True), module.__dict__)
    return module


def failed(file: Path, error: BaseException) -> InputError:
    """The error to raise about an effect's file whose code raised `error`."""
    return InputError(f"{file}: {type(error).__name__}: {error}")


def _effect(name: str, module: ModuleType) -> Effect:
    file = module.__file__
    for attribute in ("PORT", "PARAMETERS", "term"):
        if not hasattr(module, attribute):
            raise InputError(f"{file}: an effect needs {attribute}")
    quantities, parameters = _arguments(module.term)
    decay = getattr(module, "decay", None)
    decay_quantities: tuple[str, ...] = ()
    decay_parameters: tuple[str, ...] = ()
    if decay is not None:
        decay_quantities, decay_parameters = _arguments(decay)
        if decay_quantities[:1] != ("dt",):
            raise InputError(f"{file}: the first argument of decay must be dt")
        decay_quantities = decay_quantities[1:]
    for quantity in (*quantities, *decay_quantities):
        if quantity not in QUANTITIES:
            raise InputError(f"{file}: no quantity is called {quantity!r}{nearest(quantity, QUANTITIES)}")
    declared = [parameter.name for parameter in module.PARAMETERS]
    taken = {*parameters, *decay_parameters}
    foreign = taken - {*declared, *(parameter.name for parameter in VEHICLE_PARAMETERS)}
    if set(declared) - taken or (foreign and foreign - _others_parameters()):
        raise InputError(f"{file}: PARAMETERS declares {declared}, term and decay take {sorted(taken)}")
    if not isinstance(module.PORT, Port):
        raise InputError(f"{file}: PORT must be one of {', '.join(f'Port.{port.name}' for port in Port)}")
    return Effect(
        name=name,
        port=module.PORT,
        parameters=tuple(module.PARAMETERS),
        quantities=quantities,
        keywords=parameters,
        term=module.term,
        doc=inspect.getdoc(module) or "",
        decay=decay,
        decay_quantities=decay_quantities,
        decay_keywords=decay_parameters,
        shown_by=getattr(module, "SHOWN_BY", ""),
        variation=Variation(vary, *_arguments(vary)) if (vary := getattr(module, "variation", None)) else None,
        stores_energy=getattr(module, "STORES_ENERGY", False),
        turning_loss=getattr(module, "TURNING_LOSS", False),
        strengths=getattr(module, "STRENGTHS", tuple(declared[:1])),
        varies=getattr(module, "VARIES", False),
        cause=getattr(module, "CAUSE", None),
    )


def _arguments(function: Callable[..., Any]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The names of the (positional, keyword-only) arguments."""
    arguments = inspect.signature(function).parameters.values()
    keywords = tuple(a.name for a in arguments if a.kind is a.KEYWORD_ONLY)
    return tuple(a.name for a in arguments if a.kind is not a.KEYWORD_ONLY), keywords
