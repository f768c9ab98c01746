"""What healthy rides taught, as files: the vehicle file that they refitted, and the statistics beside it."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.calibration.result import Found, Result
from gz_onboard.calibration.toml_text import KeyPath, string, with_keys
from gz_onboard.calibration.vehicle_file import copied_effects, merged, write_whole
from gz_onboard.discovery.channels import ChannelNoise
from gz_onboard.discovery.mixed_model import HealthyCurve, MixedModel, initial
from gz_onboard.discovery.prior import LOG_SCALED
from gz_onboard.errors import InputError
from gz_onboard.vehicle import Vehicle


def restore(vehicle: Vehicle, folder: Path | None = None) -> MixedModel:
    """What healthy rides taught of `vehicle`, or its file alone. folder: with effects of the user's own."""
    if isinstance(vehicle.healthy, MixedModel):
        return vehicle.healthy
    mixed = initial(vehicle, folder)
    return load(mixed, vehicle.healthy) if isinstance(vehicle.healthy, Path) else mixed


def write_baseline(vehicle: Vehicle, base: Path, out: Path) -> None:
    """Write `vehicle`, as `baseline.baseline` gave it, to `out` after the file `base`, its statistics beside it."""
    mixed = vehicle.healthy
    assert isinstance(mixed, MixedModel)
    found = {
        name: Found(value.value, value.sd, value.unit, value.source)
        for name, value in vehicle.parameters.known.items()
        if "refitted on" in value.source
    }
    text = merged(base.read_text(encoding="utf-8"), [Result("baseline", parameters=found)], base, out)
    keys = copied_effects(vehicle.model.effects, out) | saved_beside(mixed, out)
    write_whole(out, with_keys(text, keys, out), f"gz-onboard discover --baseline, from {base.name}")


def saved_beside(mixed: MixedModel, out: Path) -> dict[KeyPath, str]:
    """Write what healthy rides taught beside the vehicle file `out`, and give the keys of it that name this."""
    beside = out.with_suffix(".healthy.npz")
    save(mixed, beside)
    return {("healthy", "file"): string(beside.name), ("healthy", "rides"): str(mixed.healthy)}


def accepted(mixed: MixedModel, found: Mapping[str, Found]) -> MixedModel:
    """`mixed` of the vehicle after what was `found` of it: parameters that are known by their sd from there on."""
    mean, prior = mixed.mean.copy(), mixed.prior.copy()
    for name in set(found) & set(mixed.names):
        (i,) = mixed.index([name])
        value = found[name]
        mean[i] = prior[i, :] = prior[:, i] = 0.0
        prior[i, i] = (value.sd / (float(mixed.scale[i]) * (value.value if name in LOG_SCALED else 1.0))) ** 2
    return replace(mixed, mean=mean, prior=prior, values=mixed.values | {n: f.value for n, f in found.items()})


def save(mixed: MixedModel, file: Path) -> None:
    """Write what healthy rides taught to an npz file."""
    shapes = {
        f"shape_{i}_{key}": getattr(shape, key)
        for i, shape in enumerate(mixed.shapes.values())
        for key in ("mean", "covariance", "inflation")
    }
    arrays = {name: getattr(mixed, name) for name in ("names", "scale", "mean", "prior", "scatter", "healthy")}
    for key, names in (("values", "value_names"), ("noise", "noise_names"), ("inflation", "inflation_names")):
        table = getattr(mixed, key)
        arrays |= {names: np.array(list(table)), key: np.array(list(table.values()))}
    with file.open("wb") as stream:
        np.savez_compressed(stream, shape_names=np.array(list(mixed.shapes)), **arrays, **shapes)


def load(mixed: MixedModel, file: Path) -> MixedModel:
    """`mixed` of a vehicle with what the npz `file` holds; InputError for one of another model."""
    try:
        with np.load(file) as data:
            names = [str(name) for name in data["names"]]
            if not set(names) <= set(mixed.names):
                raise InputError(f"{file}: was learned for another model list; run discover --baseline again")
            # candidates that came after it, such as a user's own, keep what is known before any ride
            at = mixed.index(names)
            mean, scatter, scale = mixed.mean.copy(), mixed.scatter.copy(), mixed.scale.copy()
            mean[at], scatter[at], scale[at] = data["mean"], data["scatter"], data["scale"]
            prior = mixed.prior.copy()
            prior[at, :] = 0.0
            prior[:, at] = 0.0
            prior[np.ix_(at, at)] = data["prior"]
            noise = (ChannelNoise(*row) for row in data["noise"].tolist())
            shapes = (
                HealthyCurve(
                    data[f"shape_{i}_mean"], data[f"shape_{i}_covariance"], float(data[f"shape_{i}_inflation"])
                )
                for i in range(len(data["shape_names"]))
            )
            return replace(
                mixed,
                mean=mean,
                prior=prior,
                scatter=scatter,
                scale=scale,
                healthy=int(data["healthy"]),
                values=mixed.values | _mapping(data["value_names"], data["values"]),
                noise=mixed.noise | dict(zip(data["noise_names"].tolist(), noise, strict=True)),
                inflation=_mapping(data["inflation_names"], data["inflation"]),
                shapes=dict(zip(data["shape_names"].tolist(), shapes, strict=True)),
            )
    except (OSError, ValueError, KeyError, EOFError, BadZipFile, zlib.error) as error:
        raise InputError(f"{file}: cannot be read as what healthy rides taught: {error}") from error


def _mapping(names: Array, values: Array) -> dict[str, float]:
    return dict(zip(names.tolist(), values.tolist(), strict=True))
