"""Decode all signals of recorded frames, in the units of the DBC, for tables and for an MCAP of signals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from gz_onboard.can.codec import LENGTH
from gz_onboard.can.layout import MessageSignals, Values
from gz_onboard.can.mapping import BusMapping
from gz_onboard.can.origins import Origins
from gz_onboard.can.requests import NEGATIVE, answer_readers
from gz_onboard.events import Frame

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can.signal import Signal

Decoded = tuple[int, str, Values]
"""(time [ns], message, value by column): one frame's signals."""


class Decoder:
    """Decodes all signals of the frames of one bus, and of answers; counts the frames that it cannot decode."""

    def __init__(self, mapping: BusMapping) -> None:
        self.unknown = self.copies = 0
        self._faults: Counter[tuple[str, str]] = Counter()
        messages, requests = mapping.database.messages, mapping.requests
        self.origins = Origins(mapping, {message.name for message in messages})
        self.all_messages: list[Message] = [*messages, *(request.message for request in requests)]
        self.columns = {m.name: {column_name(s): s.unit or "" for s in m.signals} for m in self.all_messages}
        self._signals = {message.name: MessageSignals(message, mapping.not_available) for message in messages}
        self._signals |= {request.name: MessageSignals(request.message, not_available=False) for request in requests}
        self._answers = answer_readers(requests, self._faults)
        self._asked = {request.request for request in requests}

    def decode(self, batches: Iterable[list[Frame]]) -> Iterator[Decoded]:
        """One item for each frame that the bus knows, and for each answer."""
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
    def undecodable(self) -> int:
        """Frames of another length than their message, and answers that were dropped."""
        return sum(count for (_, reason), count in self._faults.items() if not reason.startswith(NEGATIVE))


def column_name(signal: Signal) -> str:
    """``name[unit]``, or the name alone for a signal without a unit."""
    return f"{signal.name}[{signal.unit}]" if signal.unit else signal.name
