"""Residuals and changes as power at the pack's terminals, and as a share of the energy drawn."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.discovery.blocks import over_blocks
from gz_onboard.discovery.channels import ROLLING
from gz_onboard.discovery.curve_forms import CurveForm, columns_of
from gz_onboard.discovery.grid import STEP
from gz_onboard.discovery.linear import LinearRide
from gz_onboard.discovery.result import ResidualSize


def pack_power(table_name: str, line: LinearRide, values: Array) -> Array | None:
    """A residual of a channel as power at the pack's terminals [W], over its blocks; None if it is no power."""
    table = line.tables[table_name]
    real = values * table.unit
    if table_name == "road_force":
        return np.asarray(real * over_blocks(table.channel, line.ride.quantities["speed"])[table.used])
    if table_name in ("inverter_power", "pack_power", "auxiliary"):
        return np.asarray(real)
    if table_name == "pack_balance" and "pack_voltage" in line.ride.signals:
        return np.asarray(real * over_blocks(table.channel, line.ride.signals["pack_voltage"])[table.used])
    return None


def channel_energy(name: str, line: LinearRide, values: Array) -> float:
    """A residual of a channel as energy at the pack's terminals [J] over the ride; 0 if it is no power."""
    power = pack_power(name, line, values)
    return 0.0 if power is None or not len(power) else float(np.mean(power)) * channel_time(line, name)


def energy_share(lines: Sequence[LinearRide], change: Array, channels: Collection[str] | None = None) -> float:
    """The part of the energy drawn that `change` (p,) of the parameters makes over these rides, in some channels."""
    every = ((name, line, table) for line in lines for name, table in line.tables.items())
    parts = ((name, line, table.a @ change) for name, line, table in every if channels is None or name in channels)
    return _share(lines, parts)


def _share(lines: Sequence[LinearRide], residuals: Iterable[tuple[str, LinearRide, Array]]) -> float:
    """The part of the energy drawn over `lines` that residuals make, each (channel, ride, values)."""
    drawn = sum(line.ride.energy for line in lines)
    return sum(channel_energy(*residual) for residual in residuals) / drawn if drawn else 0.0


def channel_time(line: LinearRide, channel: str) -> float:
    """The time [s] for which a channel's mean holds: the ride, or that part of it in which it rolls."""
    whole = len(line.ride.time) * STEP
    if channel == "road_force":
        return float(np.mean(np.abs(line.ride.quantities["speed"]) > ROLLING)) * whole
    return whole


def curve_energy_share(lines: Sequence[LinearRide], form: CurveForm, values: Array) -> float:
    """The part of the energy drawn that the curve of `values` (knots,) takes."""
    name, every = form.channel, ((line, columns_of(line, form)) for line in lines)
    parts = ((name, line, knots @ values / line.tables[name].unit) for line, knots in every if knots is not None)
    return _share(lines, parts)


def residual_sizes(lines: Sequence[LinearRide]) -> dict[str, ResidualSize]:
    """Of each channel's residual."""
    result = {}
    for name in sorted({name for line in lines for name in line.tables}):
        tables = [(line, line.tables[name]) for line in lines if name in line.tables]
        y = np.concatenate([table.y for _, table in tables])
        pairs = [(table.y[1:], table.y[:-1]) for _, table in tables]
        late, early = (np.concatenate(side) for side in zip(*pairs, strict=True))
        correlation = float(np.corrcoef(late, early)[0, 1]) if np.std(late) > 0 and np.std(early) > 0 else 0.0
        share = _share(lines, ((name, line, table.y) for line, table in tables))
        size = float(np.sqrt(np.mean(y**2)))
        of_range = -share / (1 + share) if share > -1 else 0.0
        result[name] = ResidualSize(float(y.mean()), size, correlation, len(y), share, of_range)
    return result
