"""What crosses the borders between the packages: frames, events and estimates.

Frames and events are plain tuples, because hundreds of them pass each second: building a tuple costs a
fifth of building a dataclass.
"""

from __future__ import annotations

from typing import TypeAlias

Frame: TypeAlias = tuple[int, int, bytes, int]
"""(time [ns since the epoch], identifier, data, channel).

The identifier has the flags of Linux' ``struct can_frame``: EFF_FLAG for 29-bit identifiers, RTR_FLAG,
ERR_FLAG. The channel is the index of the configured channel; TRANSMITTED is added to frames we sent."""

EFF_FLAG = 0x8000_0000
RTR_FLAG = 0x4000_0000
ERR_FLAG = 0x2000_0000
TRANSMITTED = 0x80

Event: TypeAlias = tuple[float, int, tuple[float | None, ...]]
"""(time [s, on the codec's monotonic timeline], group, values in SI units).

A group is one mapped message: ``Codec.groups[group]`` names the roles that the values belong to, in order.
None stands for a value that was not available, implausible or dropped."""
