"""What residuals and changes are worth: as power at the pack's terminals, as a share of the energy drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.lab.discover.channels import over_blocks
from gz_onboard.lab.discover.curves import columns
from gz_onboard.lab.discover.linear import LinearRide
from gz_onboard.lab.discover.mixed_model import MixedModel


def pack_power(table_name: str, line: LinearRide, values: Array) -> Array | None:
    """What a residual of a channel is worth at the pack's terminals [W], over its blocks."""
    table = line.tables[table_name]
    real = values * table.unit
    if table_name == "road_force":
        return np.asarray(real * over_blocks(table.channel, line.ride.quantities["speed"])[table.used])
    if table_name in ("inverter_power", "auxiliary"):
        return np.asarray(real)
    if table_name == "pack_balance" and "pack_voltage" in line.ride.signals:
        return np.asarray(real * over_blocks(table.channel, line.ride.signals["pack_voltage"])[table.used])
    return None


def energy_share(mixed: MixedModel, lines: Sequence[LinearRide], change: Array) -> float:
    """The part of the energy drawn that `change` (p,) of the parameters makes, over these rides."""
    more = drawn = 0.0
    for line in lines:
        drawn += energy(line)
        for name in line.tables:
            power = pack_power(name, line, -(line.tables[name].a @ change) * -1.0)
            if power is not None and len(power):
                more += float(np.mean(power)) * share_of_time(line, name)
    return more / drawn if drawn else 0.0


def energy(line: LinearRide) -> float:
    """What the pack gave over the ride [J]."""
    s = line.ride.signals
    volts, amperes = (
        ("pack_voltage", "pack_current") if "pack_current" in s else ("inverter_voltage", "inverter_current")
    )
    if amperes not in s or volts not in s:
        return float(np.sum(np.abs(s["motor_current"] * line.ride.quantities["motor_speed"]))) * 0.045
    return float(np.sum(s[volts] * s[amperes])) * 0.1


def share_of_time(line: LinearRide, channel: str) -> float:
    """The time [s] for which a channel's mean holds: the ride, or that part of it in which it moves."""
    whole = len(line.ride.time) * 0.1
    if channel == "road_force":
        return float(np.mean(np.abs(line.ride.quantities["speed"]) > 2.0)) * whole
    return whole


def curve_energy_share(lines: Sequence[LinearRide], shape: dict[str, Any]) -> float:
    """The part of the energy drawn that the curve takes."""

    more = drawn = 0.0
    values = np.array([row[1] for row in shape["curve"]])
    for line in lines:
        drawn += energy(line)
        table = line.tables.get(shape["channel"])
        if table is None:
            continue
        c = columns(line.ride, shape["quantity"], table)
        if c is None:
            continue
        power = pack_power(shape["channel"], line, c @ values / table.unit)
        if power is not None and len(power):
            more += float(np.mean(power)) * share_of_time(line, shape["channel"])
    return more / drawn if drawn else 0.0


def residual_sizes(lines: Sequence[LinearRide]) -> dict[str, dict[str, float]]:
    """Of each channel's residual: mean, rms, correlation of neighbours, share of the energy."""
    result: dict[str, dict[str, float]] = {}
    drawn = sum(energy(line) for line in lines)
    for name in sorted({name for line in lines for name in line.tables}):
        tables = [(line, line.tables[name]) for line in lines if name in line.tables]
        y = np.concatenate([table.y for _, table in tables])
        pairs = [(table.y[1:], table.y[:-1]) for _, table in tables]
        late, early = (np.concatenate(side) for side in zip(*pairs, strict=True))
        correlation = float(np.corrcoef(late, early)[0, 1]) if np.std(late) > 0 and np.std(early) > 0 else 0.0
        powers = [pack_power(name, line, table.y) for line, table in tables]
        more = sum(
            float(np.mean(w)) * share_of_time(line, name)
            for w, (line, _) in zip(powers, tables, strict=True)
            if w is not None and len(w)
        )
        share = more / drawn if drawn else 0.0
        result[name] = {
            "mean": float(y.mean()),
            "rms": float(np.sqrt(np.mean(y**2))),
            "autocorrelation": correlation,
            "blocks": len(y),
            "energy_share": share,
            "range_share": -share / (1 + share) if share > -1 else 0.0,
        }
    return result
