"""``gz-onboard vehicle new``: a vehicle file to begin with, and a DBC skeleton for it."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from string import Template
from tempfile import TemporaryDirectory
from textwrap import fill
from typing import Any, TextIO

from gz_onboard.errors import OK, InputError
from gz_onboard.model.parameters import MOST_CELLS, declared_parameters
from gz_onboard.options import number
from gz_onboard.pipeline import Pipeline
from gz_onboard.vehicle import Vehicle, read_vehicle
from gz_onboard.vehicle_check.cells import (
    CHEMISTRIES,
    COLD,
    ERROR_SD,
    RELAXATION,
    RESISTANCE_SD,
    SOC,
    TEMPERATURES,
    Chemistry,
)
from gz_onboard.vehicle_check.features import features_of, features_text
from gz_onboard.vehicle_check.kinds import KINDS, LARGE
from gz_onboard.vehicle_check.power import RatedMotor

MASS_SD, RADIUS_SD, CAPACITY_SD = 0.03, 0.02, 0.03  # relative: of what a data sheet says
PULL_SD = 0.3  # relative: of how hard a kind of vehicle pulls off
WIRES = 0.1  # of the cells' R0
MARGIN = (0.7, 1.1)  # of the empty and the full pack's voltage: beyond them a value is no voltage of it
FASTEST_DISCHARGE = 10.0  # capacities per hour
FINE_ENERGY = 5000.0  # Wh, with some to spare below what the fine scale of the range frames can say
MOST_AMPERES, FINE = 1600.0, 600.0  # A that 16 bits hold in steps of 0.05; V below which they hold steps of 0.01
Parser = Callable[[str], Any]


@dataclass(frozen=True)
class NewVehicleAnswers:
    """What the owner says."""

    kind: str
    cells: str
    series: int
    capacity: float  # A·h of a cell
    mass: float  # kg
    wheel_radius: float  # m
    parallel: int
    gear_ratio: float
    power: float | None = None  # W, peak; None: as usual for the kind
    top_speed: float | None = None  # km/h; likewise


@dataclass(frozen=True)
class Question:
    """An option, and how to ask for it where it is missing; `default`: it need not be given."""

    option: str
    metavar: str
    text: str
    parse: Parser
    default: float | None = None
    of_kind: bool = False  # it need not be given: as usual for the kind

    @property
    def key(self) -> str:
        """The name of the value."""
        return self.option.removeprefix("--").replace("-", "_")


def _bounded(option: str, name: str) -> Parser:
    """A type for argparse: what the parameter `name` of a vehicle may be."""
    parameter = declared_parameters()[name]
    return number(option, parameter.low, parameter.high, parameter.unit)


def _one_of(option: str, choices: Mapping[str, object]) -> Parser:
    def parse(text: str) -> str:
        if text.lower() not in choices:
            raise InputError(f"{option} {text}: must be one of {', '.join(choices)}")
        return text.lower()

    return parse


def questions() -> tuple[Question, ...]:
    """All that is asked for."""

    def count(option: str) -> Parser:
        return number(option, 1, MOST_CELLS, kind=int, counted="cells")

    usual = "; as usual for the kind if left out"
    peak, fastest = number("--power", 50.0, 1e6, "W"), number("--top-speed", 5.0, 400.0, "km/h")
    full = "the full pack's voltage over 4.2 V, of LFP over 3.5 V"
    return (
        Question("--kind", "KIND", f"what it is: {', '.join(KINDS)}", _one_of("--kind", KINDS)),
        Question("--cells", "NAME", f"its cells: {', '.join(CHEMISTRIES)}", _one_of("--cells", CHEMISTRIES)),
        Question("--series", "N", f"cells in series: {full}", count("--series")),
        Question(
            "--capacity", "AH", "A·h of a cell: the pack's over --parallel", _bounded("--capacity", "cell_capacity")
        ),
        Question("--mass", "KG", "kg of the vehicle without its rider", _bounded("--mass", "vehicle_mass")),
        Question("--wheel-radius", "M", "m, of the driven wheel", _bounded("--wheel-radius", "wheel_radius")),
        Question("--parallel", "N", "cells in parallel; 1 with --capacity of the pack will do", count("--parallel"), 1),
        Question("--gear-ratio", "RATIO", "wheel speed over motor speed", _bounded("--gear-ratio", "gear_ratio"), 1.0),
        Question("--power", "W", f"W of the motor at its peak, twice its rated or so{usual}", peak, of_kind=True),
        Question("--top-speed", "KM/H", f"km/h that it goes at most{usual}", fastest, of_kind=True),
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard vehicle new``."""
    text = "vehicle file to write; its DBC file gets the same name"
    parser.add_argument("file", metavar="TOML", type=Path, help=text)
    for question in questions():
        usual = "" if question.default is None else f" (default: {question.default:g})"
        parser.add_argument(question.option, type=question.parse, metavar=question.metavar, help=question.text + usual)


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard vehicle new``: writes the two files, or none."""
    file: Path = arguments.file
    if file.suffix != ".toml":
        raise InputError(f"{file}: the name of a vehicle file must end in .toml")
    files = (file, file.with_suffix(".dbc"))
    for each in files:
        if os.path.lexists(each):
            raise InputError(f"{each}: exists already and is not overwritten")
    answers = completed(vars(arguments), sys.stdin if sys.stdin.isatty() and sys.stdout.isatty() else None)
    texts = (vehicle_text(file.stem, answers), dbc_text(answers))
    vehicle = tried(files, texts)
    write_new(files, texts)
    print(f"wrote {files[0]} and {files[1]}")
    print(features_text(features_of({source.role for source in vehicle.mapping.sources})))
    print(f"next: your identifiers and bits into {files[1]}, then gz-onboard vehicle check {file} LOG")
    return OK


def completed(given: Mapping[str, Any], terminal: TextIO | None) -> NewVehicleAnswers:
    """Every answer: as given, as asked for on a `terminal`, or the default. InputError for what is missing."""
    answers: dict[str, Any] = {question.key: given.get(question.key) for question in questions()}
    needed = [question for question in questions() if question.default is None and not question.of_kind]
    missing = [question for question in needed if answers[question.key] is None]
    if missing and terminal is None:
        wanted = "; ".join(f"{question.option} {question.metavar} ({question.text})" for question in missing)
        raise InputError(f"give {wanted}")
    for question in missing:
        assert terminal is not None
        answers[question.key] = asked(question, terminal)
    for question in questions():
        if answers[question.key] is None:
            answers[question.key] = question.default
    return NewVehicleAnswers(**answers)


def asked(question: Question, terminal: TextIO) -> Any:
    """The answer to `question` from the `terminal`, asked for until it can be used. InputError at its end."""
    while True:
        print(f"{question.text}: ", end="", flush=True)
        line = terminal.readline()
        if not line:
            raise InputError(f"give {question.option} {question.metavar} ({question.text})")
        try:
            return question.parse(line.strip())
        except InputError as error:
            print(error)
        except ValueError:
            print(f"{line.strip()}: is no number")


def tried(files: Sequence[Path], texts: Sequence[str]) -> Vehicle:
    """The vehicle as it would read and run; InputError if it would not."""
    with TemporaryDirectory() as folder:
        for file, text in zip(files, texts, strict=True):
            (Path(folder) / file.name).write_text(text, encoding="utf-8")
        try:
            vehicle = read_vehicle(Path(folder) / files[0].name)
            Pipeline(vehicle)
        except InputError as error:
            raise InputError(str(error).replace(folder, str(files[0].parent))) from error
    return vehicle


def write_new(files: Sequence[Path], texts: Sequence[str]) -> None:
    """Write each text to its file, none of which may be there; all of them or none. InputError."""
    written: list[Path] = []
    try:
        files[0].parent.mkdir(parents=True, exist_ok=True)
        for file, text in zip(files, texts, strict=True):
            with file.open("x", encoding="utf-8") as stream:
                written.append(file)
                stream.write(text)
    except OSError as error:
        for file in written:
            file.unlink(missing_ok=True)
        raise InputError(f"{error.filename or files[0]}: cannot be written: {error.strerror}") from error


def dbc_text(answers: NewVehicleAnswers) -> str:
    """The DBC skeleton: its limits are what the pack can have."""
    chemistry = CHEMISTRIES[answers.cells]
    low, high = MARGIN[0] * chemistry.cutoff[0] * answers.series, MARGIN[1] * chemistry.ocv[-1] * answers.series
    amperes = min(FASTEST_DISCHARGE * answers.capacity * answers.parallel, MOST_AMPERES)
    return _template("new.dbc").substitute(
        volt_step="0.01" if high < FINE else "0.1",
        volt_low=f"{low:.0f}",
        volt_high=f"{high:.0f}",
        amperes=f"{max(amperes, 1):.0f}",
        series=answers.series,
    )


def vehicle_text(name: str, answers: NewVehicleAnswers) -> str:
    """The vehicle file `name`."""
    kind, chemistry = KINDS[answers.kind], CHEMISTRIES[answers.cells]
    charge = answers.capacity * answers.parallel
    energy = fmean(chemistry.ocv) * answers.series * charge
    of_cells = chemistry.r0 * answers.series / charge
    numbers: dict[str, float] = {
        "drift": kind.drift,
        "mass": answers.mass,
        "mass_sd": MASS_SD * answers.mass,
        "payload": kind.payload[0],
        "payload_sd": kind.payload[1],
        "radius": answers.wheel_radius,
        "radius_sd": RADIUS_SD * answers.wheel_radius,
        "gear": answers.gear_ratio,
        "drag": kind.drag_area[0],
        "drag_sd": kind.drag_area[1],
        "rolling": kind.rolling[0],
        "rolling_sd": kind.rolling[1],
        "capacity": answers.capacity,
        "capacity_sd": CAPACITY_SD * answers.capacity,
        "cutoff": chemistry.cutoff[0],
        "cutoff_sd": chemistry.cutoff[1],
        "resistance_sd": RESISTANCE_SD,
        "wires": WIRES * of_cells,
        "error_sd": ERROR_SD,
        "rest_sd": chemistry.rest_sd,
        "full": chemistry.ocv[-1],
        "ocv_sd": chemistry.ocv_sd,
        "capacities_sd": chemistry.capacity_sd,
    }
    return _template("new.toml").substitute(
        {key: f"{value:.4g}" for key, value in numbers.items()},
        **motor_keys(answers),
        name=name,
        dbc=f"{name}.dbc",
        kind=answers.kind,
        chemistry=chemistry.name,
        range_dbc=kind.range_dbc if energy < FINE_ENERGY else LARGE,
        series=answers.series,
        parallel=answers.parallel,
        rest_source=chemistry.rest_source,
        curve=fill(f"This curve {chemistry.curve}.", 118, initial_indent="# ", subsequent_indent="# "),
        soc=_row(SOC),
        ocv=_row(chemistry.ocv),
        ocv_source=chemistry.ocv_source,
        temperatures=_row(TEMPERATURES),
        capacities=_row(answers.capacity * share for share in chemistry.capacity),
        capacity_source=chemistry.capacity_source,
        circuit=circuit_text(chemistry, answers.capacity),
    )


def motor_keys(answers: NewVehicleAnswers) -> dict[str, str]:
    """What the motor gives at most, for the template: as answered, else as usual for the kind."""
    kind, usual = KINDS[answers.kind], f"usual for a {answers.kind}"
    motor = RatedMotor(
        answers.power or kind.power,
        answers.top_speed or kind.top_speed,
        answers.mass + kind.payload[0],
        kind.pull,
        answers.wheel_radius,
        answers.gear_ratio,
        declared_parameters()["torque_constant"].prior,
    )
    speeds, shares = motor.shares()
    return {
        "current_limit": f"{motor.current_limit:.4g}",
        "current_limit_sd": f"{PULL_SD * motor.current_limit:.4g}",
        "pull": f"{motor.pull:g}",
        "power": f"{motor.power:g}",
        "power_from": "as entered" if answers.power else usual,
        "top_speed": f"{motor.top_speed:g}",
        "top_speed_from": "as entered" if answers.top_speed else usual,
        "motor_speeds": _row(speeds),
        "motor_shares": _row(shares),
        "motor_status": "data sheet" if answers.power and answers.top_speed else "guess",
    }


def circuit_text(chemistry: Chemistry, capacity: float) -> str:
    """The tables r0, r1 and c1 of a cell of this `capacity` [A·h]."""
    r0, r1 = (chemistry.resistance(times, capacity) for times in (chemistry.r0, chemistry.r1))
    tables = (
        ("r0", "ohm", r0, "Series resistance: what the voltage drops by at once, over the current."),
        ("r1", "ohm", r1, "Resistance of the RC pair: what it drops by in the minute after, over the current."),
        ("c1", "F", [RELAXATION / r for r in r1], f"Capacitance of the RC pair: {RELAXATION:g} s over r1."),
    )
    source = f"literature: {chemistry.r_source}; {COLD}"
    template = _template("circuit.toml")
    return "".join(
        template.substitute(
            about=about,
            name=name,
            temperatures=_row(TEMPERATURES),
            rows="[" + ", ".join(_row([value, value]) for value in values) + "]",
            unit=unit,
            sd=RESISTANCE_SD,
            source=source,
        )
        for name, unit, values, about in tables
    )


def _template(name: str) -> Template:
    return Template((Path(__file__).parent / f"{name}.template").read_text(encoding="utf-8"))


def _row(values: Iterable[float]) -> str:
    return "[" + ", ".join(f"{value:.4g}" for value in values) + "]"
