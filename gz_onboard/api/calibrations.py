"""Calibrations."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from gz_onboard.api.given import PathLike, file_of
from gz_onboard.arguments import checked
from gz_onboard.calibration import command as calibration
from gz_onboard.calibration import report
from gz_onboard.calibration.result import Result
from gz_onboard.calibration.vehicle_file import vehicle_output, write_vehicle
from gz_onboard.errors import InputError, not_an_input, writing
from gz_onboard.reports.tables import Columns, Tabular, columns_of
from gz_onboard.vehicle import Vehicle, find_vehicle, read_vehicle


@dataclass(frozen=True)
class Calibration(Tabular):
    """What procedures found. base: the vehicle file that they started from."""

    base: Path
    results: Sequence[Result] = field(repr=False)
    read: Sequence[Path] = field(repr=False, default=())  # files, which are not written over

    def __str__(self) -> str:
        return "\n".join(map(report.text, self.results))

    def to_table(self) -> Columns:
        """A row for each parameter: procedure, parameter, value, sd, unit, source."""
        rows = [
            {"procedure": result.procedure, "parameter": name, **asdict(found)}
            for result in self.results
            for name, found in result.parameters.items()
        ]
        names = ("procedure", "parameter", "value", "sd", "unit", "source")
        return columns_of(rows, {name: name for name in names})

    @checked
    def write(self, file: PathLike) -> Vehicle:
        """Write the vehicle file with what was found, and give the vehicle in it. Raises InputError."""
        vehicle_output(Path(file), [self.base, *self.read])
        with writing(file):
            return write_vehicle(self.base, calibration.for_file(self.results, read_vehicle(self.base)), Path(file))

    @checked
    def write_report(self, file: PathLike) -> None:
        """Write the report as an HTML page. Raises InputError."""
        not_an_input([Path(file)], [self.base, *self.read])
        with writing(file):
            report.write_report(Path(file), f"Calibration of {read_vehicle(self.base).name}", self.results)


@checked
def calibrate(
    data: PathLike | Iterable[PathLike] | Mapping[str, Sequence[PathLike]],
    vehicle: PathLike | None = None,
    *,
    procedure: str = "all",
    options: Mapping[str, float | str] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Calibration:
    """Determine parameters from measurements.

    data: a folder with a manifest, for the procedure ``all``; else the files of the procedure, or a mapping of its
    slots, such as ``{"data": [...], "held_out": [...]}``. vehicle: name or file to start from, ``reference`` or that
    of the manifest if None. progress: takes each part of the work that begins. Raises InputError.
    """
    calibration.known_procedure(procedure)
    if isinstance(data, Mapping):
        files = {slot: [Path(file) for file in group] for slot, group in data.items()}
    else:
        files = {"data": [Path(data)] if isinstance(data, str | os.PathLike) else [Path(file) for file in data]}
    start = None if vehicle is None else file_of(vehicle)
    if procedure == "all":
        if options:
            raise InputError("the procedure all takes its options from the manifest")
        base, steps = calibration.asked_of_manifest(files.get("data", []), start)
    else:
        base = find_vehicle("reference" if start is None else start)
        texts = [f"{name}={value}" for name, value in (options or {}).items()]
        steps = [calibration.step_of(procedure, files, calibration.options_of(texts, procedure))]
    found = calibration.calibrate(steps, base, progress or (lambda _: None))
    return Calibration(base, [result for result, _ in found], calibration.files_of(steps, files.get("data", [])))
