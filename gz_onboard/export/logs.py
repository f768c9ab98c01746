"""Write frames and signals of a log in other formats, for ``gz-onboard export`` and ``simulate``."""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from gz_onboard.can.logfile import LogFile, object_schema
from gz_onboard.errors import InputError, nearest, writing
from gz_onboard.events import Frame
from gz_onboard.export.decoder import Decoder, column_name
from gz_onboard.recording import logs

_TEXT_FORMATS = (".log", ".asc", ".trc", ".csv", ".jsonl")
_FORMATS = (*_TEXT_FORMATS, ".blf", ".mf4", ".parquet", ".mcap")


def out_suffix(out: Path) -> str:
    """The format of `out` as a lower-case suffix, without the .gz of a packed file; InputError if it is unknown."""
    suffixes = [suffix.lower() for suffix in out.suffixes]
    packed = suffixes[-1:] == [".gz"]
    suffix = "".join(suffixes[-2:-1] if packed else suffixes[-1:])
    if packed and suffix not in _TEXT_FORMATS:
        raise InputError(f"{out}: only {' '.join(_TEXT_FORMATS)} can be written with .gz")
    if suffix and suffix not in _FORMATS:
        raise InputError(
            f"{out}: unknown format {suffix!r}{nearest(suffix, _FORMATS)}; known are {' '.join(_FORMATS)},"
            " and a name without a suffix for a directory of tables"
        )
    return suffix


@contextmanager
def whole(out: Path, suffix: str) -> Iterator[Path]:
    """A name to write a file to, which is renamed to `out` once it is complete; a folder of tables is written in place.

    Errors are as of `writing`.
    """
    if not suffix:
        with writing(out):
            yield out
        return
    packed = ".gz" if out.suffix.lower() == ".gz" else ""  # python-can takes a name with one dot more for no format
    part = out.with_name(f".part-{out.name.replace('.', '-')}{suffix}{packed}")
    with writing(out):
        try:
            yield part
            part.replace(out)
        except OSError as error:
            error.filename = None  # `out` is the name that the user knows
            raise
        finally:
            with suppress(OSError):  # there is none
                part.unlink()


# --- frames ----------------------------------------------------------------------------------------------------


def write_frames_as(out: Path, suffix: str, batches: Iterable[list[Frame]]) -> int:
    """Write the frames to `out` by python-can, in the format of `suffix`; returns their number."""
    from gz_onboard.can.python_can import can
    from gz_onboard.recording.readers.python_can import message_of, with_asammdf

    if suffix == ".mf4":
        with_asammdf(out)
        writer: Any = can.io.mf4.MF4Writer(out)
    else:
        writer = can.Logger(out)
    count = 0
    with writer:
        for batch in batches:
            for frame in batch:
                writer.on_message_received(message_of(frame))
            count += len(batch)
    return count


# --- MCAP ------------------------------------------------------------------------------------------------------


def write_mcap(log: Path, out: Path, decoder: Decoder, batches: Iterator[list[Frame]], section: Any) -> int:
    """Write the whole log, and the signals of each message on a topic ``/can/MESSAGE``, by time; count its samples."""
    first = next(batches, None)
    if first is None:
        raise InputError(f"{log}: no frames in the chosen part")
    metadata = {**logs.read_metadata(log), "expanded_from": log.name}
    with out.open("wb") as stream:
        file = LogFile(stream, first[0][0], metadata, logs.read_attachments(log))
        recorded, topics = logs.json_channels(log), {m.name: f"/can/{m.name}" for m in decoder.all_messages}
        for topic, (schema, of_channel) in recorded.items():
            file.channel(topic, json.loads(schema), of_channel)
        for message in decoder.all_messages:
            if topics[message.name] not in recorded:
                texts = {column_name(s): ", ".join(filter(None, (s.unit or "", s.comment))) for s in message.signals}
                file.channel(topics[message.name], object_schema(message.name, texts))

        def logged() -> Iterator[list[Frame]]:
            file.frames(first)
            yield first
            for batch in batches:
                file.frames(batch)
                yield batch

        samples = ((time_ns, topic, values) for topic, time_ns, values in logs.read_samples(log, *section))
        signals = ((time_ns, topics[name], values) for time_ns, name, values in decoder.decode(logged()))
        count = 0
        for time_ns, topic, values in heapq.merge(signals, samples, key=lambda item: item[0]):
            file.sample(topic, time_ns, values)
            count += 1
        file.close()
    return count
