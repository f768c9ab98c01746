"""Decode all signals of recorded frames, in the units of the DBC files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from gz_onboard.can.codec import LENGTH
from gz_onboard.can.dbc import database_of, load_database
from gz_onboard.can.layout import MessageSignals, Values
from gz_onboard.can.mapping import BusMapping
from gz_onboard.can.origins import Origins
from gz_onboard.can.requests import NEGATIVE, answer_readers
from gz_onboard.errors import InputError
from gz_onboard.events import Frame
from gz_onboard.recording import logs
from gz_onboard.vehicle import OWN, Vehicle, read_vehicle

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can.signal import Signal

Decoded = tuple[int, str, Values]
"""Time [ns], message and values by column of one frame."""


class DecoderError(InputError):
    """A log that does not say what decodes it."""


class Decoder:
    """Decodes the frames of one bus, and the answers to requests, and counts those that it cannot decode."""

    def __init__(self, mapping: BusMapping) -> None:
        self.unknown = self.copies = 0
        self._faults: Counter[tuple[str, str]] = Counter()
        messages, requests = mapping.database.messages, mapping.requests
        self.origins = Origins(mapping, {message.name for message in messages})
        self.all_messages: list[Message] = [*messages, *(request.message for request in requests)]
        self.columns = {m.name: [column_name(s) for s in m.signals] for m in self.all_messages}
        self._signals = {message.name: MessageSignals(message, mapping.not_available) for message in messages}
        self._signals |= {request.name: MessageSignals(request.message, not_available=False) for request in requests}
        self._answers = answer_readers(requests, self._faults)
        self._asked = {request.request for request in requests}

    def decode(self, batches: Iterable[list[Frame]]) -> Iterator[Decoded]:
        """Yield one item for each frame that the bus knows, and for each answer."""
        for batch in batches:
            for time_ns, identifier, data, channel in batch:
                if answers := self._answers.get(identifier):
                    for request, answer in answers.take(time_ns * 1e-9, data):
                        yield from self._decoded(time_ns, request.message, answer)
                elif (origin := self.origins.find(identifier)) is None:
                    self.unknown += identifier not in self._asked
                elif origin.takes(time_ns, channel, identifier, data):
                    yield from self._decoded(time_ns, origin.message, data)
                else:
                    self.copies += 1

    def _decoded(self, time_ns: int, message: Message, data: bytes) -> Iterator[Decoded]:
        if (values := self._signals[message.name].values(data)) is None:
            self._faults[message.name, LENGTH] += 1
        else:
            pairs = zip(self.columns[message.name], message.signals, strict=True)
            yield time_ns, message.name, {column: values.get(signal.name) for column, signal in pairs}

    @property
    def conflicts(self) -> Sequence[str]:
        """Messages that come from two channels or senders with different data, in words."""
        return list(self.origins.conflicts.values())

    @property
    def undecodable(self) -> int:
        """Frames of another length than their message, and answers that were dropped."""
        return sum(count for (_, reason), count in self._faults.items() if not reason.startswith(NEGATIVE))


def column_name(signal: Signal) -> str:
    """Return ``name[unit]``, or the name alone for a signal without a unit."""
    return f"{signal.name}[{signal.unit}]" if signal.unit else signal.name


def decoder_of(log: Path, files: Sequence[Path], vehicle: Vehicle | None) -> Decoder:
    """Return the decoder of `log`.

    It decodes by DBC `files`; else by those of a vehicle; else by those attached to the log; else by those of the
    package's own vehicle that the log names. `DecoderError` if there are none of these.
    """
    if files:
        return Decoder(BusMapping(load_database(list(files), {}), tuple(files), (), {}, {}))
    attached = {name: data for name, data in logs.read_attachments(log).items() if name.lower().endswith(".dbc")}
    if not vehicle and not attached:
        named = logs.read_metadata(log).get("vehicle", "")
        own = (read_vehicle(file.stem) for file in sorted(OWN.glob("*.toml")) if named)
        vehicle = next((one for one in own if named in (one.name, one.file.stem)), None)
    if vehicle:
        if not vehicle.mapping.reads_frames:
            raise vehicle.error("dbc is missing: without it no frame can be decoded")
        database = load_database([*vehicle.mapping.dbc_files, vehicle.range_dbc], {})  # range frames are its own
        return Decoder(replace(vehicle.mapping, database=database))
    if not attached:
        raise DecoderError(f"{log}: no DBC file is attached to this log; give a vehicle or DBC files")
    texts = [(Path(f"{log}, attached {name}"), data.decode("utf-8", "replace")) for name, data in attached.items()]
    try:
        return Decoder(BusMapping(database_of(texts, {}), (), (), {}, {}))
    except InputError as error:
        raise DecoderError(f"{error}; give a vehicle or DBC files") from error
