"""All signals of recorded frames, in the units of the DBC, for tables and for an MCAP of signals."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from gz_onboard.bus.layout import identifier_of, is_not_available, raw_values
from gz_onboard.events import Frame

if TYPE_CHECKING:
    from cantools.database.can import Database, Message
    from cantools.database.can.signal import Signal

Values = dict[str, "float | int | None"]
Decoded = tuple[int, str, Values]
"""(time [ns], message, value by column): one frame's signals."""


class Decoder:
    """All signals of frames by a cantools database; what cannot be decoded is counted, never guessed."""

    def __init__(self, database: Database) -> None:
        self.unknown = 0
        self.undecodable = 0
        self.messages: dict[int, Message] = {identifier_of(message): message for message in database.messages}
        self.columns = {m.name: {column_name(s): s.unit or "" for s in m.signals} for m in database.messages}

    def decode(self, batches: Iterable[list[Frame]]) -> Iterator[Decoded]:
        """One item for each frame that the database knows."""
        for batch in batches:
            for time_ns, identifier, data, _ in batch:
                message = self.messages.get(identifier)
                if message is None:
                    self.unknown += 1
                elif (raw := raw_values(message, data)) is None:
                    self.undecodable += 1
                else:
                    pairs = zip(self.columns[message.name], message.signals, strict=True)
                    yield time_ns, message.name, {column: _value(s, raw.get(s.name)) for column, s in pairs}


def column_name(signal: Signal) -> str:
    """``name[unit]``, or the name alone for a signal without a unit."""
    return f"{signal.name}[{signal.unit}]" if signal.unit else signal.name


def _value(signal: Signal, raw: float | None) -> float | int | None:
    """In the unit of the DBC; None where not available, or in another branch of the multiplexer."""
    if raw is None or is_not_available(signal, raw):
        return None
    return signal.conversion.raw_to_scaled(raw, decode_choices=False)  # type: ignore[return-value]  # a number
