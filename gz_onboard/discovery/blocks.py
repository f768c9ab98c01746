"""A channel over one ride: whether it can be had, where it holds, and its residual averaged over blocks of time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.discovery.channels import CHANNEL, Channel
from gz_onboard.discovery.grid import STEP, Ride
from gz_onboard.discovery.system import System, Values
from gz_onboard.model.effect import Effect
from gz_onboard.offline.arrays import block_means

WHOLE = 0.99  # of a block: rounding apart, all of it
STEADY = 0.2  # of the current, as if that much of it changed: gains err in proportion


def depends(channel: Channel, effects: Sequence[Effect]) -> set[str]:
    """The parameters that `channel` depends on."""
    names = set(channel.parameters)
    for effect in effects:
        if effect.port in channel.ports and not effect.stores_energy:
            names |= effect.takes
    return names


def usable(channel: Channel, ride: Ride, system: System) -> bool:
    """Whether the ride has what `channel` needs."""
    if not {*channel.roles, *channel.fed_by} <= ride.have or (channel.battery and system.battery is None):
        return False
    if slow(channel, ride):
        return False
    parts = [CHANNEL[name] for name in channel.unless if "motor_current" in ride.have]
    return not parts or not all(usable(part, ride, system) for part in parts)


def slow(channel: Channel, ride: Ride) -> bool:
    """Whether samples of what `channel` needs are too far apart to show it."""
    return any(ride.periods.get(role, 0.0) > channel.apart for role in channel.roles)


def support(channel: Channel, ride: Ride) -> Mask:
    """The blocks of `channel` in which everything was measured and the channel holds, shape (blocks,)."""
    good = channel.holds(ride) & ride.mask(*channel.roles)
    n = round(channel.block / STEP)
    if channel.name == "voltage_timing":
        good = good & np.roll(good, -1)
        good[-1] = False
    return np.asarray(block_means(good.astype(float), n) > WHOLE)


def blocks(channel: Channel, ride: Ride, p: Values, system: System) -> Array:
    """The residual of `channel` averaged over its blocks, shape (blocks,); masked ones too."""
    fine = channel.residual(ride, p, system)
    count = len(ride.time) // round(channel.block / STEP)
    result = block_means(fine, round(channel.block / STEP / channel.steps))
    return np.asarray(result[:count])


def roughness(channel: Channel, ride: Ride, system: System) -> Array:
    """By how much more a block's residual scatters, shape (blocks,): where the current changes within it, small errors
    of timing and of dynamics weigh more; on a rough road the accelerometer is noisy; a force's noise is power by speed.
    """
    doubling = channel.rough * system.sizes.current
    n = round(channel.block / STEP)
    shaken = np.ones(len(ride.time) // n)
    if channel.shaken > 0 and "vibration" in ride.quantities:
        shaken = shaken + block_means(ride.quantities["vibration"] ** 2, n) / channel.shaken**2
    if channel.fast > 0 and "motor_current" not in ride.have:
        shaken = shaken * (1 + block_means(ride.quantities["speed"] ** 2, n) / channel.fast**2)
    if doubling <= 0:
        return np.asarray(np.sqrt(shaken))
    amperes = ride.quantities["motor_current"]
    level = block_means(np.abs(amperes), n)
    swing = np.sqrt(np.maximum(block_means(amperes**2, n) - block_means(amperes, n) ** 2, 0.0))
    return np.asarray(np.sqrt(shaken * (1 + ((swing + STEADY * level) / doubling) ** 2)))


def over_blocks(channel: Channel, values: Array) -> Array:
    """A quantity on the grid, averaged over the blocks of `channel`."""
    return block_means(values, round(channel.block / STEP))
