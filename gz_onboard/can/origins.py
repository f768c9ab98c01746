"""Take each message from one channel and one sender, so that two meanings of one identifier are never mixed."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING

from gz_onboard.can.layout import identifier_of
from gz_onboard.can.mapping import BusMapping, pgn
from gz_onboard.events import EFF_FLAG, RTR_FLAG, STALE_PERIODS, TRANSMITTED, Frame, hexadecimal

if TYPE_CHECKING:
    from cantools.database.can import Message

Place = tuple[int, int]
"""Channel, and the sender's address of a J1939 message, else the identifier with its flag."""
RECENT = 8  # frames: a gateway's copy comes no later, and this many in a row must differ
SILENT_S = 2.0  # a place that sends nothing for this long, and ten periods, has fallen silent


class Origin:
    """Chooses the place that the frames of one message are taken from.

    The vehicle file may name it by ``channel`` and ``sender``; otherwise it is the sender in the DBC file once that is
    heard, else the first place heard. Frames from other places are left out. Where nothing says which is meant, they
    are compared: a place that sends the same data is a copy, as a gateway makes it, and takes over when the own place
    falls silent; `RECENT` frames in a row with other data than the own place sent are a `conflict`.
    """

    def __init__(self, message: Message, mapping: BusMapping, has_address: bool, is_compared: bool) -> None:
        self.message = message
        self.conflict = ""  # the contradiction and its remedy
        self.last: tuple[Frame, int] | None = None
        """The last frame, and where the timeline began [ns], while `hear` returned True: `takes` was not called."""
        self._has_address, self._is_compared = has_address, is_compared
        self._channel, self._wanted = mapping.origins.get(message.name, (None, None))
        self._sender = message.frame_id & 0xFF if self._wanted is None else self._wanted
        self._stale_ns = 1e9 * max(SILENT_S, STALE_PERIODS * mapping.periods.get(message.name, 0.0))
        self._places: set[Place] = set()  # heard
        self._own: Place | None = None
        self._own_ns = 0
        self._turn = 0  # frames of the own place
        self._turns: dict[Place, int] = {}  # the own place's at the last frame from elsewhere
        self._recent: dict[Place, deque[bytes]] = defaultdict(lambda: deque(maxlen=RECENT))
        # Data of the own place, and of each other those that the own place has not sent.
        self._copies: set[Place] = set()

    def hear(self, channel: int, identifier: int) -> bool:
        """Note a place; True while all frames come from one place that they may come from."""
        self._places.add(self._place(channel, identifier))
        return len(self._places) == 1 and self._is_allowed(*self._places)

    def takes(self, time_ns: int, channel: int, identifier: int, data: bytes) -> bool:
        """Whether the frame comes from the message's own place. time_ns: on a timeline without leaps."""
        if self.last:
            (last_ns, last_identifier, last_data, last_channel), origin_ns = self.last
            self.last = None
            self.takes(last_ns - origin_ns, last_channel, last_identifier, last_data)
        place = self._place(channel, identifier)
        if not self._is_allowed(place):
            return False
        is_named = self._has_address and place[1] == self._sender
        own = self._own or place
        is_silent = time_ns - self._own_ns > self._stale_ns
        if is_named and own[1] != self._sender:
            own, self.conflict = place, ""
        elif is_silent and place in self._copies and not self.conflict:
            own = place
        if own != self._own:
            self._own = own
            self._recent.clear()
        if place == own:
            if len(self._recent) < 2:  # nothing to compare
                self._recent.clear()
            self._own_ns, self._turn = time_ns, self._turn + 1
            self._recent[place].append(data)
        elif self._is_compared and (is_named or not self._has_address or own[1] != self._sender):
            self._compare(place, own, data, is_silent)
        return place == own

    def _compare(self, place: Place, own: Place, data: bytes, is_silent: bool) -> None:
        """Compare a frame from elsewhere. What comes while the own place pauses has nothing to be compared with."""
        unmatched, recent = self._recent[place], self._recent[own]
        if is_silent or self._turns.get(place) != self._turn:
            self._turns[place] = self._turn
            is_late, is_early = data in recent, bool(unmatched) and unmatched[-1] == recent[-1]
            if (is_late or is_early) and not is_silent:
                self._copies.add(place)
                unmatched.clear()
            if is_silent or not is_late:
                unmatched.append(data)
            if len(unmatched) == RECENT and not self.conflict:
                how = "one after the other" if is_silent else "with different data"
                self.conflict = self._contradiction(own, place, how)

    def _place(self, channel: int, identifier: int) -> Place:
        return channel & ~TRANSMITTED, identifier & 0xFF if self._has_address else identifier

    def _is_allowed(self, place: Place) -> bool:
        """Whether the vehicle file allows `place`."""
        return self._channel in (None, place[0]) and self._wanted in (None, place[1])

    def _contradiction(self, own: Place, place: Place, how: str) -> str:
        if own[0] != place[0]:
            said, key = (
                f"{hexadecimal(identifier_of(self.message))} comes on channels {own[0]} and {place[0]}",
                f"channel = {own[0]}",
            )
        else:
            said = f"parameter group {pgn(self.message.frame_id):#x} comes from senders {own[1]:#x} and {place[1]:#x}"
            key = f"sender = {own[1]:#x}"
        return f"{said} {how} ({self.message.name}): say which is meant, {key} under [bus.messages.{self.message.name}]"


class Origins:
    """The `Origin` of each message of a database, found by the identifiers of frames.

    compared: the messages of which different data are a conflict.
    """

    def __init__(self, mapping: BusMapping, compared: Collection[str]) -> None:
        self._origins: dict[int, Origin] = {}  # by identifier; below zero by parameter group
        for message in mapping.database.messages:
            is_group = mapping.j1939 and message.is_extended_frame
            key = ~pgn(message.frame_id) if is_group else identifier_of(message)
            self._origins[key] = Origin(message, mapping, is_group, message.name in compared)

    def __iter__(self) -> Iterator[Origin]:
        """In the order of the database."""
        return iter(self._origins.values())

    def find(self, identifier: int) -> Origin | None:
        """The origin of the message with this identifier or, in J1939, this parameter group."""
        is_extended = identifier & EFF_FLAG and not identifier & RTR_FLAG
        return self._origins.get(identifier) or (self._origins.get(~pgn(identifier)) if is_extended else None)

    @property
    def conflicts(self) -> dict[str, str]:
        """The contradiction and its remedy, by message."""
        return {origin.message.name: origin.conflict for origin in self if origin.conflict}
