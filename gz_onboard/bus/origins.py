"""Where each message comes from: one channel and one sender, so that two meanings of one identifier are never mixed."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from gz_onboard.bus.mapping import BusMapping, pgn
from gz_onboard.events import EFF_FLAG, RTR_FLAG, hexadecimal

if TYPE_CHECKING:
    from cantools.database.can import Message

Place = tuple[int, int]
"""Channel, and the sender's address of a J1939 message, else the identifier with its flag."""
RECENT = 8  # frames: a gateway's copy comes no later, and so many in a row must differ


class Origins:
    """Finds the message of a frame and takes each message from one place only.

    That is the place named by ``channel`` and ``sender`` in the vehicle file; else the sender in the DBC file, once it
    is heard; else the first place heard. Identical frames from elsewhere are copies, as a gateway makes them; they take
    over where the message's own place falls silent.
    """

    def __init__(self, mapping: BusMapping) -> None:
        self._wanted = mapping.origins
        self._exact: dict[int, Message] = {}
        self._groups: dict[int, Message] = {}
        self._places: dict[str, Place] = {}
        self.recent: dict[str, deque[bytes]] = {}  # a message's own data, once it is heard elsewhere as well
        self._sent: dict[str, int] = {}  # frames of the message's own place, by message, once it is heard elsewhere
        self._pending: dict[
            tuple[str, Place], tuple[int, bytes | None]
        ] = {}  # their number at a frame, and its data if new
        self._apart: dict[tuple[str, Place], int] = {}  # frames in a row
        self._copies: set[tuple[str, Place]] = set()  # places that sent the same while the message's own did
        self.conflicts: dict[str, str] = {}  # what differs and what to do, by message
        for message in mapping.database.messages:
            if mapping.j1939 and message.is_extended_frame:
                self._groups[pgn(message.frame_id)] = message
            else:
                self._exact[message.frame_id | (EFF_FLAG if message.is_extended_frame else 0)] = message

    def message(self, identifier: int) -> Message | None:
        """The message with this identifier or, in J1939, this parameter group."""
        if found := self._exact.get(identifier):
            return found
        grouped = identifier & EFF_FLAG and not identifier & RTR_FLAG
        return self._groups.get(pgn(identifier)) if grouped else None

    def claim(self, message: Message, channel: int, identifier: int) -> bool:
        """Whether `message` is taken from this channel and identifier."""
        place, now = self._place(message, channel, identifier), self._places.get(message.name)
        if self._may_be(message, place) and (now is None or (self._is_in_dbc(message, place) and place[1] != now[1])):
            self._places[message.name] = now = place
        return place == now

    def own(self, name: str, data: bytes) -> None:
        """Note a frame of the message of this name from its own place, to compare others with."""
        self.recent[name].append(data)
        self._sent[name] = self._sent.get(name, 0) + 1

    def take_over(self, message: Message, channel: int, identifier: int) -> bool:
        """Take `message` from here, if frames from here were copies of it; gives whether it is."""
        place = self._place(message, channel, identifier)
        if (message.name, place) in self._copies and message.name not in self.conflicts:
            self._places[message.name] = place
        return self._places.get(message.name) == place

    def differs(self, message: Message, channel: int, identifier: int, data: bytes, silent: bool = False) -> bool:
        """Whether frames from elsewhere contradict `message`; `data` is the last of them. silent: its own place is."""
        place, own = self._place(message, channel, identifier), self._places.get(message.name)
        if own is None or not self._may_be(message, place) or (self._is_in_dbc(message, own) and place[1] != own[1]):
            return False  # it is known which is meant
        at, recent = (message.name, place), self.recent.setdefault(message.name, deque(maxlen=RECENT))
        sent, pending = self._pending.get(at, (self._sent.get(message.name, 0), None))
        now = self._sent.get(message.name, 0)
        if silent:
            self._apart[at] = self._apart.get(at, 0) + 1
        elif data in recent:
            self._apart[at] = 0
            if now > sent:
                self._copies.add(at)
        elif pending is not None and now > sent:
            self._apart[at] = 0 if pending in recent else self._apart.get(at, 0) + 1
        self._pending[at] = now, None if data in recent else data
        if self._apart.get(at, 0) >= RECENT:
            self.conflicts[message.name] = _conflict(
                message, own, place, "one after the other" if silent else "with different data"
            )
        return message.name in self.conflicts

    def _place(self, message: Message, channel: int, identifier: int) -> Place:
        grouped = self._groups.get(pgn(identifier)) is message if identifier & EFF_FLAG else False
        return channel, identifier & 0xFF if grouped else identifier

    def _may_be(self, message: Message, place: Place) -> bool:
        """Whether the vehicle file allows `place`."""
        channel, sender = self._wanted.get(message.name, (None, None))
        return channel in (None, place[0]) and sender in (None, place[1])

    def _is_in_dbc(self, message: Message, place: Place) -> bool:
        """Whether the DBC file names the sender of `place`, and the vehicle file none."""
        return self._wanted.get(message.name, (None, None))[1] is None and place[1] == message.frame_id & 0xFF


def _conflict(message: Message, own: Place, other: Place, how: str) -> str:
    if own[0] != other[0]:
        identifier = message.frame_id | (EFF_FLAG if message.is_extended_frame else 0)
        said, key = f"{hexadecimal(identifier)} comes on channels {own[0]} and {other[0]}", f"channel = {own[0]}"
    else:
        said = f"parameter group {pgn(message.frame_id):#x} comes from senders {own[1]:#x} and {other[1]:#x}"
        key = f"sender = {own[1]:#x}"
    return f"{said} {how} ({message.name}): say which is meant, {key} under [bus.messages.{message.name}]"
