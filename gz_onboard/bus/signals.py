"""Decode all signals of recorded frames, in the units of the DBC, for tables and for an MCAP of signals."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from gz_onboard.bus.answers import NEGATIVE, AnswerReader, Take, by_response
from gz_onboard.bus.layout import raw_range, raw_values
from gz_onboard.bus.mapping import BusMapping
from gz_onboard.bus.origins import Origins
from gz_onboard.events import TRANSMITTED, Frame

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can.signal import Signal

Values = dict[str, "float | int | None"]
Decoded = tuple[int, str, Values]
"""(time [ns], message, value by column): one frame's signals."""


class MessageSignals:
    """Decodes all signals of one message. not_available: whether all ones mean that."""

    def __init__(self, message: Message, not_available: bool = True) -> None:
        self.message = message
        self._limits = [(s.name, s.conversion, *raw_range(s, not_available)) for s in message.signals]

    def values(self, data: bytes) -> Values | None:
        """The value of each signal in the unit of the DBC: None where not available or out of the DBC's range.

        Without those of other branches of the multiplexer; None if the data do not fit the message.
        """
        if (raw := raw_values(self.message, data)) is None:
            return None
        values: Values = {}
        for name, conversion, low, high in self._limits:
            if (value := raw.get(name)) is not None:  # NaN is not between any limits
                values[name] = conversion.raw_to_scaled(value, False) if low <= value <= high else None  # type: ignore[assignment]  # a number
        return values


class Decoder:
    """Decodes all signals of the frames of one bus, and of answers; counts the frames that it cannot decode."""

    def __init__(self, mapping: BusMapping) -> None:
        self.unknown = self.undecodable = self.copies = 0
        self.origins = Origins(mapping)
        self.all_messages: list[Message] = [
            *mapping.database.messages,
            *(request.message for request in mapping.requests),
        ]
        self.columns = {m.name: {column_name(s): s.unit or "" for s in m.signals} for m in self.all_messages}
        self._signals = {m.name: MessageSignals(m, mapping.not_available) for m in mapping.database.messages}
        self._whole: list[tuple[str, Values]] = []  # answers, of the frame that completed them
        self._answers = {
            response: AnswerReader(those, [self._taker(request.message) for request in those], self._dropped)
            for response, those in by_response(mapping.requests).items()
        }
        self._asked = {request.request for request in mapping.requests}

    def decode(self, batches: Iterable[list[Frame]]) -> Iterator[Decoded]:
        """One item for each frame that the bus knows, and for each answer."""
        for batch in batches:
            for time_ns, identifier, data, channel in batch:
                message = self.origins.message(identifier)
                if answers := self._answers.get(identifier):
                    answers.take(time_ns * 1e-9, data)
                    yield from ((time_ns, name, values) for name, values in self._whole)
                    self._whole.clear()
                elif message is None:
                    self.unknown += identifier not in self._asked
                elif not self._takes(message, channel & ~TRANSMITTED, identifier, data):
                    self.copies += 1
                elif (values := self._signals[message.name].values(data)) is None:
                    self.undecodable += 1
                else:
                    yield time_ns, message.name, self._row(message, values)

    def _takes(self, message: Message, channel: int, identifier: int, data: bytes) -> bool:
        if not self.origins.claim(message, channel, identifier):
            self.origins.differs(message, channel, identifier, data)
            return False
        if message.name in self.origins.recent:
            self.origins.own(message.name, data)
        return True

    def _row(self, message: Message, values: Values) -> Values:
        pairs = zip(self.columns[message.name], message.signals, strict=True)
        return {column: values.get(s.name) for column, s in pairs}

    def _taker(self, message: Message) -> Take:
        signals = MessageSignals(message, not_available=False)

        def take(_time: float, data: bytes) -> None:
            if (values := signals.values(data)) is None:
                self.undecodable += 1
            else:
                self._whole.append((message.name, self._row(message, values)))

        return take

    def _dropped(self, _message: str, reason: str) -> None:
        self.undecodable += not reason.startswith(NEGATIVE)


def column_name(signal: Signal) -> str:
    """``name[unit]``, or the name alone for a signal without a unit."""
    return f"{signal.name}[{signal.unit}]" if signal.unit else signal.name
