"""Tables of frames, signals or estimates, as CSV, Parquet and JSON lines: a row for each frame, or for each value."""

from __future__ import annotations

import csv
import gzip
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, repeat
from pathlib import Path
from typing import IO, Any, cast

from gz_onboard.events import EFF_FLAG, ERR_FLAG, MOST_EXTENDED, RTR_FLAG, TRANSMITTED
from gz_onboard.offline.decode_signals import Decoded
from gz_onboard.recording.frames import FrameColumns


@dataclass(frozen=True)
class MessageRows:
    """The signals of one message. times: [ns since the epoch]; columns: by name and unit, as long."""

    times: list[int] = field(default_factory=list)
    columns: dict[str, list[Any]] = field(default_factory=dict)


def by_message(decoded: Iterable[Decoded]) -> dict[str, MessageRows]:
    """Collect the signals of each message, in their order."""
    found: dict[str, MessageRows] = {}
    for time_ns, message, values in decoded:
        if (rows := found.get(message)) is None:
            rows = found[message] = MessageRows(columns={name: [] for name in values})
        rows.times.append(time_ns)
        for column, value in zip(rows.columns.values(), values.values(), strict=True):
            column.append(value)
    return found


def write_long(out: Path, messages: Mapping[str, MessageRows]) -> None:
    """Write one table of all signals, message by message: a row for each value, in .jsonl one for each frame."""
    if _suffix(out) == ".jsonl":
        with open_text(out) as stream:
            for message, rows in messages.items():
                for time_ns, *values in zip(rows.times, *rows.columns.values(), strict=True):
                    named = dict(zip(rows.columns, values, strict=True))
                    stream.write(_json_line(time_ns, {"message": message, **named}))
        return
    columns: dict[str, list[Any]] = {"message": [], "signal": [], "value": []}
    times: list[int] = []
    for message, rows in messages.items():
        names, count = list(rows.columns), len(rows.times)
        times += chain.from_iterable(repeat(time_ns, len(names)) for time_ns in rows.times)
        columns["message"] += [message] * (count * len(names))
        columns["signal"] += names * count
        columns["value"] += chain.from_iterable(zip(*rows.columns.values(), strict=True))
    write_table(out, columns, times, {"message": str, "signal": str, "value": float})


FRAME = {"channel": int, "identifier": int, "extended": bool, "remote": bool, "error": bool, "sent": bool, "data": str}
"""What a table of frames has beside the time. identifier: without its flags, which are columns; sent: by ourselves;
data: hexadecimal.
"""


def frame_columns(frames: FrameColumns) -> dict[str, list[Any]]:
    """The columns of `FRAME`."""
    columns = (
        frames.bus,
        frames.identifier & MOST_EXTENDED,
        *(frames.identifier & flag != 0 for flag in (EFF_FLAG, RTR_FLAG, ERR_FLAG)),
        frames.channel & TRANSMITTED != 0,
    )
    data = [data.hex() for _, _, data, _ in frames.tuples()]
    return dict(zip(FRAME, [*(column.tolist() for column in columns), data], strict=True))


def write_table(
    out: Path,
    columns: Mapping[str, Sequence[object]],
    times: Sequence[int] | None = None,
    kinds: Mapping[str, type] | None = None,
) -> None:
    """Write a table to a .csv, .parquet or .jsonl file, its first column the `times` [ns], if there are any.

    With times, numbers have the 15 digits that a float has for sure: 28 times 0.1 is 2.8, not 2.8000000000000003.
    kinds: str, int, bool or float of a column in Parquet; of others str if it has a text, else float.
    """
    if _suffix(out) == ".parquet":
        import pyarrow.parquet as pq

        pq.write_table(_arrow_table(times, columns, kinds or {}), out)
        return
    rows = zip(*columns.values(), strict=True)
    with open_text(out) as stream:
        if _suffix(out) == ".jsonl":
            named = (dict(zip(columns, row, strict=True)) for row in rows)
            stamps = repeat(None) if times is None else times
            stream.writelines(map(_json_line, stamps, named))
            return
        writer = csv.writer(stream)
        writer.writerow(columns if times is None else ["time[s]", *columns])
        if times is None:
            writer.writerows(rows)
        else:
            writer.writerows([_seconds(t), *map(_decimal, row)] for t, row in zip(times, rows, strict=True))


def _suffix(out: Path) -> str:
    """The suffix that says the format, without the .gz of a packed file."""
    return (out.with_suffix("") if out.suffix.lower() == ".gz" else out).suffix.lower()


def open_text(out: Path) -> IO[str]:
    """`out` to be written as text, packed if its name ends in .gz."""
    if out.suffix.lower() == ".gz":
        return cast("IO[str]", gzip.open(out, "wt", newline=""))
    return out.open("w", newline="")


def _arrow_table(
    times: Sequence[int] | None, columns: Mapping[str, Sequence[object]], kinds: Mapping[str, type]
) -> Any:
    """A pyarrow table of `columns` over ``time``; None stays null. kinds: as of `write_table`."""
    import pyarrow as pa

    arrays = {} if times is None else {"time": pa.array(times, pa.timestamp("ns", "UTC"))}
    for name, values in columns.items():
        kind = kinds.get(name) or (str if any(isinstance(value, str) for value in values) else float)
        if kind in (int, bool):
            arrays[name] = pa.array(values, pa.int64() if kind is int else pa.bool_())
        elif kind is str:
            arrays[name] = pa.array([None if value is None else str(value) for value in values], pa.string())
        else:
            arrays[name] = pa.array([_number(value) for value in values], pa.float64())
    return pa.table(arrays)


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None


def _json_line(time_ns: int | None, row: Mapping[str, object]) -> str:
    """A line of JSON, the time in seconds to the nanosecond, which no float has."""
    if time_ns is None:
        return json.dumps(row, ensure_ascii=False) + "\n"
    text = json.dumps({name: _decimal(value) for name, value in row.items()}, ensure_ascii=False)
    return f'{{"time[s]": {_seconds(time_ns)}{", " if row else ""}{text[1:]}\n'


def _decimal(value: object) -> object:
    """`value`, a float to the 15 digits that it has for sure."""
    return float(f"{value:.15g}") if isinstance(value, float) else value


def _seconds(time_ns: int) -> str:
    seconds, rest = divmod(time_ns, 1_000_000_000)
    return f"{seconds}.{rest:09d}"
