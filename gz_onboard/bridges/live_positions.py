"""Positions of the vehicle, from its own frames on the bus: the range frames have none."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from gz_onboard.bus.codec import Codec
from gz_onboard.bus.layout import identifiers_of
from gz_onboard.estimator.signals import Signals
from gz_onboard.events import Frame
from gz_onboard.log_rows import Positions
from gz_onboard.vehicle import Vehicle

NEEDED = "latitude", "longitude"
ROLES = *NEEDED, "gps_altitude", "gps_fix"


class LivePositions:
    """Reads the positions in a vehicle's frames."""

    def __init__(self, vehicle: Vehicle) -> None:
        mapping = vehicle.mapping
        mapped = {source.role: source.message for source in mapping.sources if source.role in ROLES}
        self.identifiers = identifiers_of(mapping, set(mapped.values()))
        self._codec = Codec(mapping)
        self._signals = Signals(self._codec.groups)
        self._positions = Positions()

    @staticmethod
    def lacking(vehicle: Vehicle) -> list[str]:
        """Return the roles that the vehicle file would need to map."""
        mapped = {source.role for source in vehicle.mapping.sources}
        return [role for role in NEEDED if role not in mapped]

    def take(self, frames: Sequence[Frame]) -> Iterator[dict[str, Any]]:
        """Take in frames, in the order of their times; yield each new position as a row."""
        codec, signals = self._codec, self._signals
        for frame in frames:
            codec.decode([frame])
            now = codec.seconds(frame[0])
            signals.take(codec.windows(), now)
            if found := self._positions.new(signals, now, frame[0]):
                yield found[1]
