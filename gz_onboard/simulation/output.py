"""Files of ``gz-onboard simulate``: time series, pictures, an HTML page, CAN frames."""

from __future__ import annotations

import argparse
import html
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gz_onboard.arrays import Array
from gz_onboard.errors import writable, writing
from gz_onboard.reports.page import drawn, write_page
from gz_onboard.reports.style import save
from gz_onboard.simulation.frames import Dropouts, simulate_frames, write_frames
from gz_onboard.simulation.plan import Plan
from gz_onboard.simulation.run import COLUMNS, Run
from gz_onboard.simulation.scooter import Scooter
from gz_onboard.simulation.summary import SimulationSummary, measured_columns, summary_text
from gz_onboard.simulation.sweep import Sweep
from gz_onboard.simulation.truth import Truth
from gz_onboard.vehicle import Vehicle

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = ("parquet", "csv")
PICTURES = ("", ".ledger", ".measured", ".sweep")


def write(
    arguments: argparse.Namespace,
    vehicle: Vehicle,
    plan: Plan,
    result: Run,
    summary: SimulationSummary,
    sweeps: Sequence[Sweep],
) -> list[str]:
    """Write the time series and the pictures. Returns the names of the files. Raises InputError."""
    files: list[str] = []

    def file(ending: str) -> Path:
        name = output_file(arguments, plan, ending)
        files.append(str(name))
        return name

    with writing(arguments.output):
        arguments.output.mkdir(parents=True, exist_ok=True)
        if not arguments.no_series:
            metadata = {"vehicle": summary.vehicle, "source": summary.what}
            write_series(result, file(f".{arguments.format}"), metadata)
        if not arguments.no_plot:
            title = f"{plan.name}, {summary.kind} · {summary.vehicle}, payload {summary.payload_kg:g} kg"
            shown = [f"<pre>{html.escape(summary_text(summary))}</pre>"]
            for ending, figure in _pictures(title, vehicle, plan, result, summary, sweeps).items():
                save(figure, file(f"{ending}.{arguments.picture_format}"))
                shown.append(f"<figure>{drawn(figure, ending.lstrip('.'))}</figure>")
            write_page(file(".html"), title, shown)
    return files


def output_file(arguments: argparse.Namespace, plan: Plan, ending: str) -> Path:
    """The file of a simulation that ends so."""
    mode = ".predictive" if arguments.predictive else ""
    return Path(arguments.output / f"{plan.name}{mode}.simulation{ending}")


def write_ride(arguments: argparse.Namespace, vehicle: Vehicle, result: Run, scooter: Scooter) -> str:
    """Write the ride's frames. Returns the name of the file. Raises InputError."""
    dropouts = Dropouts() if arguments.frame_loss is None else Dropouts(frames=arguments.frame_loss)
    sent = simulate_frames(vehicle, Truth(result, scooter), arguments.seed, dropouts=dropouts)
    with writing(arguments.frames):
        arguments.frames.parent.mkdir(parents=True, exist_ok=True)
        write_frames(arguments.frames, sent)
    return str(arguments.frames)


def _pictures(
    title: str, vehicle: Vehicle, plan: Plan, result: Run, summary: SimulationSummary, sweeps: Sequence[Sweep]
) -> dict[str, Figure]:
    """The figures by the ending of their files."""
    from gz_onboard.simulation import figures

    energy = figures.ledger_bars(result.ledger, vehicle.model.effects, f"{title}: energy")
    pictures = {"": figures.overview(result, title), ".ledger": energy}
    if plan.recorded:
        pictures[".measured"] = figures.comparison(result, measured_columns(plan.recorded, result), title)
    if sweeps:
        if any(sweep.name == "payload_mass" for sweep in sweeps):
            title = title.partition(", payload")[0]
        pictures[".sweep"] = figures.sweep_lines(sweeps, summary.sweep or [], title)
    return pictures


def series_table(result: Run) -> dict[str, Array]:
    """The time series by column, ``name[unit]``."""
    return {f"{name}[{unit}]": result.series[name] for name, unit in COLUMNS.items()}


def write_series(result: Run, file: Path, metadata: dict[str, str]) -> None:
    """Write the time series as Parquet or CSV by the file's name; not a number becomes null."""
    import pyarrow as pa
    from pyarrow import csv, parquet

    table = pa.table({name: pa.array(column, from_pandas=True) for name, column in series_table(result).items()})
    with file.open("wb") as binary:  # pyarrow opens no name that is not UTF-8
        if file.suffix == ".csv":
            csv.write_csv(table, binary, csv.WriteOptions(quoting_style="none"))
        else:
            named = {key: writable(text) for key, text in metadata.items()}
            parquet.write_table(table.replace_schema_metadata(named), binary)
