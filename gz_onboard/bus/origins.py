"""Take each message from one channel and one sender, so that two meanings of one identifier are never mixed."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from gz_onboard.bus.mapping import BusMapping, pgn
from gz_onboard.events import EFF_FLAG, RTR_FLAG, hexadecimal

if TYPE_CHECKING:
    from cantools.database.can import Message

Place = tuple[int, int]
"""Channel, and the sender's address of a J1939 message, else the identifier with its flag."""
RECENT = 8  # frames: a gateway's copy comes no later, and so many in a row must differ


@dataclass(slots=True)
class _Elsewhere:
    """Frames of a message from another place than its own."""

    own_frames: int  # of the message's own place, when the last of these came
    unmatched: bytes | None = None  # the data of the last, if the own place has not sent the same
    differing: int = 0  # in a row
    is_copy: bool = False  # it sent the same while the own place did


class Origins:
    """Finds the message of a frame and takes each message from one place only.

    The place is named by ``channel`` and ``sender`` in the vehicle file; else it is the sender in the DBC file, once
    heard; else the first place heard. Identical frames from elsewhere are copies, as a gateway makes them; they take
    over when the own place falls silent.
    """

    def __init__(self, mapping: BusMapping) -> None:
        self._wanted = mapping.origins
        self._exact: dict[int, Message] = {}
        self._groups: dict[int, Message] = {}
        self._places: dict[str, Place] = {}
        self.recent: dict[str, deque[bytes]] = {}  # a message's own data, once it is heard elsewhere as well
        self._sent: Counter[str] = Counter()  # frames of its own place, by message, once it is heard elsewhere
        self._elsewhere: dict[tuple[str, Place], _Elsewhere] = {}
        self.conflicts: dict[str, str] = {}  # the contradiction and its remedy, by message
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
        self._sent[name] += 1

    def take_over(self, message: Message, channel: int, identifier: int) -> bool:
        """Take `message` from here if frames from here were copies of it; returns whether it is taken from here now."""
        place = self._place(message, channel, identifier)
        elsewhere = self._elsewhere.get((message.name, place))
        if elsewhere and elsewhere.is_copy and message.name not in self.conflicts:
            self._places[message.name] = place
        return self._places.get(message.name) == place

    def differs(self, message: Message, channel: int, identifier: int, data: bytes, silent: bool = False) -> bool:
        """Whether frames from elsewhere contradict `message`; `data` is the last of them. silent: its own place is."""
        place, own = self._place(message, channel, identifier), self._places.get(message.name)
        if own is None or not self._may_be(message, place) or (self._is_in_dbc(message, own) and place[1] != own[1]):
            return False  # it is known which is meant
        recent = self.recent.setdefault(message.name, deque(maxlen=RECENT))
        sent = self._sent[message.name]
        known = self._elsewhere.setdefault((message.name, place), _Elsewhere(sent))
        if silent:
            known.differing += 1
        elif data in recent:
            known.differing = 0
            known.is_copy |= sent > known.own_frames
        elif known.unmatched is not None and sent > known.own_frames:
            known.differing = 0 if known.unmatched in recent else known.differing + 1
        known.own_frames, known.unmatched = sent, None if data in recent else data
        if known.differing >= RECENT:
            how = "one after the other" if silent else "with different data"
            self.conflicts[message.name] = _conflict(message, own, place, how)
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
