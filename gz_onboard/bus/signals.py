"""All signals of recorded frames, in the units of the DBC, for tables and for an MCAP of signals."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from gz_onboard.bus.layout import identifier_of, raw_range, raw_values
from gz_onboard.events import Frame

if TYPE_CHECKING:
    from cantools.database.can import Database, Message
    from cantools.database.can.signal import Signal

Values = dict[str, "float | int | None"]
Decoded = tuple[int, str, Values]
"""(time [ns], message, value by column): one frame's signals."""


class MessageSignals:
    """All signals of one message. not_available: whether all ones stand for it."""

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
    """All signals of frames by a cantools database; what cannot be decoded is counted, never guessed."""

    def __init__(self, database: Database) -> None:
        self.unknown = 0
        self.undecodable = 0
        self.messages: dict[int, Message] = {identifier_of(message): message for message in database.messages}
        self._signals = {name: MessageSignals(message) for name, message in self.messages.items()}
        self.columns = {m.name: {column_name(s): s.unit or "" for s in m.signals} for m in database.messages}

    def decode(self, batches: Iterable[list[Frame]]) -> Iterator[Decoded]:
        """One item for each frame that the database knows."""
        for batch in batches:
            for time_ns, identifier, data, _ in batch:
                message = self.messages.get(identifier)
                if message is None:
                    self.unknown += 1
                elif (values := self._signals[identifier].values(data)) is None:
                    self.undecodable += 1
                else:
                    pairs = zip(self.columns[message.name], message.signals, strict=True)
                    yield time_ns, message.name, {column: values.get(s.name) for column, s in pairs}


def column_name(signal: Signal) -> str:
    """``name[unit]``, or the name alone for a signal without a unit."""
    return f"{signal.name}[{signal.unit}]" if signal.unit else signal.name
