"""What ``gz-onboard simulate`` writes: time series, pictures, an HTML page, CAN frames."""

from __future__ import annotations

import argparse
import csv
import html
import math
from collections.abc import Callable, Sequence
from pathlib import Path

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
from gz_onboard.simulation.trace import Trace
from gz_onboard.vehicle import Vehicle

FORMATS = ("mcap", "parquet", "csv")
PICTURES = ("", ".ledger", ".measured", ".sweep")
_TOPIC = "simulation"


def write(
    arguments: argparse.Namespace,
    vehicle: Vehicle,
    plan: Plan,
    result: Run,
    summary: SimulationSummary,
    sweeps: Sequence[Sweep],
) -> list[str]:
    """The time series and the pictures; gives their names. Raises InputError if they cannot be written."""
    files: list[Path] = []

    def file(ending: str) -> Path:
        files.append(output_file(arguments, plan, ending))
        return files[-1]

    with writing(arguments.output):
        arguments.output.mkdir(parents=True, exist_ok=True)
        if not arguments.no_series:
            metadata = {"vehicle": summary.vehicle, "source": summary.what}
            write_series(result, file(f".{arguments.format}"), metadata)
        if not arguments.no_plot:
            _draw(file, arguments.picture_format, vehicle, plan, result, summary, sweeps)
    return [str(file) for file in files]


def output_file(arguments: argparse.Namespace, plan: Plan, ending: str) -> Path:
    """The file of a simulation that ends so."""
    mode = ".predictive" if arguments.predictive else ""
    return Path(arguments.output / f"{plan.name}{mode}.simulation{ending}")


def write_trace(arguments: argparse.Namespace, vehicle: Vehicle, trace: Trace, scooter: Scooter) -> str:
    """Write the ride's frames; gives the file's name. InputError if it cannot be written."""
    dropouts = Dropouts() if arguments.frame_loss is None else Dropouts(frames=arguments.frame_loss)
    sent = simulate_frames(vehicle, trace.truth(scooter), arguments.seed, dropouts=dropouts)
    with writing(arguments.frames):
        arguments.frames.parent.mkdir(parents=True, exist_ok=True)
        write_frames(arguments.frames, sent)
    return str(arguments.frames)


def _draw(
    file: Callable[[str], Path],
    picture_format: str,
    vehicle: Vehicle,
    plan: Plan,
    result: Run,
    summary: SimulationSummary,
    sweeps: Sequence[Sweep],
) -> None:
    from gz_onboard.simulation import figures

    title = f"{plan.name}, {summary.kind} · {summary.vehicle}, payload {summary.payload_kg:g} kg"
    energy = figures.sankey(result.ledger, vehicle.model.effects, f"{title}: energy")
    pictures = [("", figures.overview(result, title)), (".ledger", energy)]
    if plan.recorded:
        columns = measured_columns(plan.recorded, result)
        pictures.append((".measured", figures.comparison(result, columns, title)))
    variants = summary.sweep or []
    swept = f"{plan.name}, {summary.kind} · {summary.vehicle}"
    if all(sweep.name != "payload_mass" for sweep in sweeps):
        swept += f", payload {summary.payload_kg:g} kg"
    if len(sweeps) == 1:
        pictures.append((".sweep", figures.sweep_lines(sweeps[0].label, sweeps[0].values, variants, swept)))
    elif sweeps:
        one, two = sweeps
        names, values = (one.label, two.label), (one.values, two.values)
        pictures.append((".sweep", figures.sweep_map(names, values, variants, swept)))
    for ending, figure in pictures:
        save(figure, file(f"{ending}.{picture_format}"))
    text = f"<pre>{html.escape(summary_text(summary))}</pre>"
    shown = [f"<figure>{drawn(figure, ending.lstrip('.'))}</figure>" for ending, figure in pictures]
    write_page(file(".html"), title, [text, *shown])


def series_table(result: Run) -> dict[str, Array]:
    """The time series by column, ``name[unit]``."""
    return {f"{name}[{unit}]": result.series[name] for name, unit in COLUMNS.items()}


def write_series(result: Run, file: Path, metadata: dict[str, str]) -> None:
    """The time series as MCAP, Parquet or CSV by the file's name; columns as ``name[unit]``, not a number as null."""
    table = series_table(result)
    names = list(table)
    if file.suffix == ".parquet":
        import pyarrow as pa
        import pyarrow.parquet as pq

        columns = [pa.array(column, from_pandas=True) for column in table.values()]
        arrow = pa.table(columns, names=names)
        named = {key: writable(text) for key, text in metadata.items()}
        with file.open("wb") as binary:  # pyarrow opens no name that is not UTF-8
            pq.write_table(arrow.replace_schema_metadata(named), binary)
        return
    rows = zip(*(column.tolist() for column in table.values()), strict=True)
    if file.suffix == ".csv":
        with file.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(names)
            writer.writerows(["" if math.isnan(value) else f"{value:.9g}" for value in row] for row in rows)
        return
    from gz_onboard.can.logfile import LogFile

    log = LogFile(file.open("wb"), 0, metadata)
    try:
        properties = {name: {"type": ["number", "null"], "description": unit} for name, unit in COLUMNS.items()}
        log.channel(_TOPIC, {"title": "Simulation", "type": "object", "properties": properties})
        for row in rows:
            log.sample(_TOPIC, round(row[0] * 1e9), dict(zip(COLUMNS, row, strict=True)))
        log.close()
    finally:
        log.abandon()
