"""``gz-onboard export``: turns a log into other formats of frames, tables of what it holds, or an MCAP of signals.

The name of the output says what is written:
- .log .blf .asc .trc .csv .mf4: the frames, in the format of candump, Vector, PEAK, python-can or ASAM;
- .parquet or .jsonl, or .csv with --signals: one table of all signals, a row for each value (.jsonl: for each frame);
- a directory (a name without a suffix): a table for each message and of the estimates, a column for each signal;
- .mcap: everything that is in the log, and besides one JSON channel for each message at its full rate.

With --estimates, and of a log that holds no frames (that of ``gz-onboard estimate``), the estimates: .csv, .parquet,
.jsonl or a directory, a row for each estimate. With --frames the frames as a table, .parquet or .jsonl. Without an
output it says what the log holds.

Signals have the units of the DBC files, in their names: ``BMS_PackVoltage[V]``. What was not available, or is out of
the DBC's range, is null.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from gz_onboard.errors import BAD_INPUT, OK, InputError, not_an_input
from gz_onboard.export.contents import (
    ESTIMATES,
    FRAME,
    ExportSource,
    contents_text,
    frame_columns,
    write_estimates,
    write_signals,
)
from gz_onboard.export.decoder import DecoderError, decoder_of
from gz_onboard.export.logs import out_suffix, whole, write_frames_as, write_mcap
from gz_onboard.options import add_shared
from gz_onboard.recording import logs
from gz_onboard.reports.tables import write_table
from gz_onboard.vehicle import read_vehicle

_TABLES = (".csv", ".parquet", ".jsonl")
_OF_OUTPUT = {
    **{f"--{name}": name for name in ("estimates", "signals", "frames", "columns", "vehicle", "dbc")},
    "--table-format": "table_format",
    "--from": "start",
    "--to": "end",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``gz-onboard export``."""
    add_shared(parser, "log", help="log, or a folder of them: a folder of tables for each")
    out = (
        "frames: .log .blf .asc .trc .csv .mf4; signals: .parquet or .jsonl (one long table), .mcap (for Foxglove), or "
        "a name without suffix (a folder with a table per message and one of the estimates); without it: what LOG holds"
    )
    parser.add_argument("out", type=Path, metavar="OUT", nargs="?", help=out)
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--estimates", action="store_true", help="write the estimates, one row each")
    what.add_argument("--signals", action="store_true", help="write signals, also to .csv and of a log without frames")
    what.add_argument("--frames", action="store_true", help="write the frames, also to .parquet and .jsonl")
    names = "only these columns of estimates or signals, with or without their units"
    parser.add_argument("--columns", type=_names, metavar="NAME,...", help=names)
    kinds = "format of the tables in a folder (default: parquet)"
    parser.add_argument("--table-format", choices=[suffix[1:] for suffix in _TABLES], help=kinds)
    vehicle = "decode the signals by the DBC files of this vehicle (default: those attached to the log)"
    add_shared(parser, "--vehicle", default=None, help=vehicle)
    parser.add_argument("--dbc", type=Path, nargs="+", metavar="FILE", help="DBC files to decode the signals by")
    add_shared(parser, "--from", "--to")


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def run(arguments: argparse.Namespace) -> int:
    """Run ``gz-onboard export``: `BAD_INPUT` if one of several logs cannot be used; InputError if nothing can."""
    log, out = arguments.log, arguments.out
    if out is None:
        if unfit := [name for name, field in _OF_OUTPUT.items() if getattr(arguments, field)]:
            raise InputError(f"{unfit[0]}: chooses what is written to OUT, which is missing; name a file or folder")
        return _each(logs.logs_among([log], estimates=None), lambda log: print(contents_text(log)))
    suffix = out_suffix(out)
    if suffix and arguments.table_format:
        raise InputError(f"--table-format {arguments.table_format}: is for a folder of tables, and {out} is a file")
    if arguments.dbc and arguments.vehicle:
        raise InputError(f"--vehicle {arguments.vehicle}: has DBC files of its own; leave out --dbc")
    if not log.is_dir():
        _export(arguments, log, out, suffix)
        return OK
    if suffix:
        raise InputError(
            f"{out}: is one file, and {log} a folder of logs; give a name without a suffix: "
            "a folder in which each log has a folder of tables"
        )
    found = logs.logs_among([log], estimates=None)
    stems = Counter(map(logs.log_stem, found))
    names = {one: logs.log_stem(one) if stems[logs.log_stem(one)] == 1 else one.name for one in found}
    return _each(found, lambda one: _export(arguments, one, out / names[one], suffix))


def _each(found: Sequence[Path], work: Callable[[Path], None]) -> int:
    """Process each log; one that cannot be used does not stop the others."""
    status = OK
    for log in found:
        try:
            work(log)
        except InputError as error:
            print(f"gz-onboard export: {error}", file=sys.stderr)
            status = BAD_INPUT
    return status


def _export(arguments: argparse.Namespace, log: Path, out: Path, suffix: str) -> None:
    """Write what is asked for of one log, and say it."""
    not_an_input([out] if suffix else [], [log, *(arguments.dbc or [])])
    source = ExportSource(log, arguments.start, arguments.end, arguments.columns)
    with whole(out, suffix) as part:
        text = _write(arguments, source, part, suffix)
    for damage in dict.fromkeys(map(str, source.damages)):
        print(f"damaged log: {damage}")
    print(f"wrote {out}: {text}")


def _write(arguments: argparse.Namespace, source: ExportSource, part: Path, suffix: str) -> str:
    """Write what is asked for to `part`, in the format of `suffix`, none for a folder; return what it was."""
    kind = suffix or f"/.{arguments.table_format or 'parquet'}"
    tables = ["estimate"] if arguments.estimates else [name for name, t in ESTIMATES.items() if t in source.topics]
    if arguments.estimates or (tables and not (source.has_frames or arguments.signals or arguments.frames)):
        return _estimates(arguments, source, part, kind, tables)
    if arguments.frames or not (arguments.signals or suffix in (".parquet", ".jsonl", ".mcap", "")):
        return _frames(source, part, suffix)
    try:
        texts = [_signals(arguments, source, part, kind)]
    except DecoderError as error:
        raise InputError(f"{error}: --vehicle NAME|TOML, or --dbc FILE") from error
    if not suffix and not arguments.signals and tables:
        texts.append(_estimates(arguments, source, part, kind, tables))
    return "; ".join(texts)


def _estimates(arguments: argparse.Namespace, source: ExportSource, part: Path, kind: str, names: Sequence[str]) -> str:
    """Write the tables `names` of `ESTIMATES` into a folder, or the estimates into a file."""
    if kind.startswith("/"):
        part.mkdir(parents=True, exist_ok=True)
        files = {ESTIMATES[name]: part / f"{name}{kind[1:]}" for name in names}
    elif kind in _TABLES:
        files = {ESTIMATES["estimate"]: part}
    else:
        raise InputError(f"{arguments.out}: estimates can be written to {', '.join(_TABLES)} or a directory")
    return f"{write_estimates(source, files)} estimates"


def _frames(source: ExportSource, part: Path, suffix: str) -> str:
    if source.columns is not None:
        raise InputError("--columns: applies to estimates or signals, with --estimates or --signals")
    frames = source.frames()
    if suffix in ("", ".mcap"):
        raise InputError("--frames: can be written to .log .blf .asc .trc .csv .mf4 .parquet .jsonl")
    if suffix in (".parquet", ".jsonl"):
        write_table(part, frame_columns(frames), frames.time_ns.tolist(), FRAME)
    else:
        write_frames_as(part, suffix, frames.batches())
    return f"{len(frames)} frames"


def _signals(arguments: argparse.Namespace, source: ExportSource, part: Path, kind: str) -> str:
    vehicle = read_vehicle(arguments.vehicle) if arguments.vehicle else None
    files = arguments.dbc or ()
    if kind == ".mcap" and source.has_frames:
        frames, decoder = source.frames(), decoder_of(source.log, files, vehicle)
        if source.columns is not None:
            raise InputError("--columns: an .mcap has all that is in the log")
        text = f"{write_mcap(source.log, part, decoder, frames.batches(), source.section)} samples"
        unknown, undecodable, conflicts = decoder.unknown, decoder.undecodable, decoder.conflicts
    elif not kind.startswith("/") and kind not in _TABLES:
        raise InputError(f"{source.log}: its signals can be written to .csv, .parquet, .jsonl, .mcap or a directory")
    else:
        found = source.signals(files, vehicle)
        count = write_signals(found, part, kind)
        if not found.is_decoded:
            return f"{count} rows of signals, as they were logged once a second"
        text, unknown, undecodable, conflicts = f"{count} frames", found.unknown, found.undecodable, found.conflicts
    counts = f"{unknown} frames are in no DBC file, {undecodable} do not fit theirs"
    return "; ".join([text, counts, *(f"only the first is written: {conflict}" for conflict in conflicts)])
