"""What discovery knows of a vehicle before it sees a ride: parameters, priors, scatter and noise of the healthy one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.stats import t as student

from gz_onboard.arrays import Array, Mask
from gz_onboard.discovery.blocks import depends
from gz_onboard.discovery.candidates import Candidate, candidates
from gz_onboard.discovery.channels import CHANNELS
from gz_onboard.discovery.grid import Ride, read_ride
from gz_onboard.discovery.linear import (
    LinearRide,
    Noise,
    Normal,
    Population,
    Posterior,
    fit_mixed,
    linearise,
    normal,
    spread_out,
    trimmed,
)
from gz_onboard.discovery.prior import (
    GIVEN_SCATTER,
    LOG_SCALED,
    NUISANCES,
    VEHICLE_PARAMETERS,
    prior_covariance,
    prior_of,
    stepped,
)
from gz_onboard.discovery.residuals import counted_soc
from gz_onboard.discovery.system import System
from gz_onboard.lab.sizes import Sizes, sizes_of
from gz_onboard.model.effect import Effect, Port
from gz_onboard.model.parameters import declared_parameters
from gz_onboard.offline.correlations import correlations
from gz_onboard.offline.processes import worker_pool
from gz_onboard.offline.samples import Samples
from gz_onboard.vehicle import Vehicle

FREED = 1e6  # variance in scales of what nothing is known of
WIDENED = 25.0  # variance in scales, five times a usual change
PRIOR_RIDES, LEAST_FREEDOM = 3, 4
"""What is known without healthy rides, worth so many of them; and no scatter is known worse than with so many."""


@dataclass(frozen=True)
class HealthyCurve:
    """What healthy rides leave over a quantity in a channel: coefficients (k,), covariance (k, k), inflation."""

    mean: Array
    covariance: Array
    inflation: float


@dataclass(frozen=True)
class MixedModel(Population):
    """The linear model's frame: names (p,), scale (p,), values where it is linearised, and what is known before, as
    differences from `values`.

    inflation: of a cause's score on healthy rides left out, 1 if right. shapes: what these show over quantities.
    checked: in words, how the energy of healthy rides held out is known.
    """

    vehicle: Vehicle
    system: System
    causes: tuple[Candidate, ...]
    names: tuple[str, ...]
    scale: Array
    values: dict[str, float]
    noise: Noise
    healthy: int  # rides that it was learned on
    free: Mask  # whose scatter between rides is learned, (p,)
    inflation: dict[str, float] = field(default_factory=dict)
    shapes: dict[str, HealthyCurve] = field(default_factory=dict)
    checked: str = ""

    @property
    def freedom(self) -> float:
        """Degrees of freedom that the scatter between rides is known with: of a search, two for each ride."""
        return float(max(2 * (self.healthy + PRIOR_RIDES), 2 * LEAST_FREEDOM))

    @property
    def quantile(self) -> float:
        """Of Student's t: half of a 95 % interval, in standard deviations."""
        return float(student.ppf(0.975, max(self.healthy + PRIOR_RIDES, LEAST_FREEDOM)))

    @property
    def sizes(self) -> Sizes:
        """How large the vehicle is."""
        return self.system.sizes

    @property
    def usable_causes(self) -> list[Candidate]:
        """The candidates whose parameters some channel depends on."""
        return [cause for cause in self.causes if set(cause.names) <= set(self.names)]

    @property
    def lacking(self) -> list[Candidate]:
        """The candidates whose effect the vehicle's model lacks."""
        return lacking(self.vehicle, self.causes)

    def healthy_value(self, name: str) -> float:
        """The healthy vehicle's value of a parameter: that of its file, 0 for an effect that its model lacks."""
        absent = any(name in cause.names for cause in self.lacking)
        return 0.0 if absent else float(self.vehicle.parameters[name])

    def index(self, names: Iterable[str]) -> list[int]:
        """Where `names` stand."""
        return [self.names.index(name) for name in names]

    def index_of(self, causes: Iterable[Candidate]) -> list[int]:
        """Where the parameters of `causes` stand."""
        return self.index(name for cause in causes for name in cause.names)

    def normals(self, lines: Iterable[LinearRide]) -> list[Normal]:
        """The normal equations of each ride at this noise."""
        return [normal(line, self.noise) for line in lines]

    def fit(self, rides: Sequence[Normal]) -> Posterior:
        """The common part and each ride's own as `rides` show them, the scatter as it is."""
        return fit_mixed(rides, self)

    def learned_scatter(self, rides: Sequence[Normal], weight: Array | float, rounds: int) -> Posterior:
        """The same with the scatter that `rides` show; see `linear.fit_mixed`."""
        return fit_mixed(rides, self, weight, self.free, rounds)

    def freed(self, index: Sequence[int]) -> MixedModel:
        """With nothing known of the common part at `index`."""
        prior = self.prior.copy()
        prior[index, index] += FREED
        return replace(self, prior=prior)

    def widened(self) -> MixedModel:
        """With a common part of which little is known, while scatter or noise of the very rides is sought."""
        return replace(self, prior=self.prior + WIDENED * np.eye(len(self.names)))

    def values_at(self, vector: Array) -> dict[str, float]:
        """`values` moved by `vector` (p,) in scales."""
        moved = dict(self.values)
        for name, x, scale in zip(self.names, vector, self.scale, strict=True):
            moved[name] = stepped(
                name, moved[name], float(np.clip(x * scale, -1, 1) if name in LOG_SCALED else x * scale)
            )
        return moved

    def ride(self, samples: Samples) -> Ride:
        """`samples` on the grid of this vehicle."""
        ride = read_ride(samples, self.vehicle)
        if self.system.battery is not None and {"pack_voltage", "pack_current"} <= ride.have:
            ride.quantities["soc"] = counted_soc(ride, self.system)
        return ride


def lacking(vehicle: Vehicle, causes: Sequence[Candidate]) -> list[Candidate]:
    """Those of `causes` whose effect the model of `vehicle` lacks."""
    has = {effect.name for effect in vehicle.model.effects}
    return [cause for cause in causes if cause.effect and cause.effect.name not in has]


def initial(vehicle: Vehicle, folder: Path | None = None) -> MixedModel:
    """What is known of `vehicle` from its file alone. folder: with effects of the user's own."""
    causes = candidates(folder)
    absent = {name for cause in lacking(vehicle, causes) for name in cause.names}
    more = [cause.effect for cause in lacking(vehicle, causes) if cause.effect]
    effects: tuple[Effect, ...] = (*vehicle.model.effects, *more)
    p = vehicle.parameters
    sizes = sizes_of(vehicle)
    cells = tuple(vehicle.model.at(Port.CELL_VOLTAGE))
    system = System(effects, vehicle.battery, dict(p), cells, vehicle.riding.vibration, sizes)
    values = {name: x.prior for name, x in declared_parameters(effects).items()} | dict(p)
    values |= {nuisance.name: nuisance.value for nuisance in NUISANCES} | dict.fromkeys(absent, 0.0)
    names = _names(vehicle, causes, more, values)
    declared = declared_parameters(effects)
    priors = {name: prior_of(name, vehicle, declared, values[name], name in absent) for name in names}
    return MixedModel(
        vehicle=vehicle,
        system=system,
        causes=causes,
        names=tuple(names),
        scale=np.array([prior.scale for prior in priors.values()]),
        values=values,
        mean=np.zeros(len(names)),
        prior=prior_covariance(priors, correlations(vehicle)),
        scatter=np.array([prior.ride_sd for prior in priors.values()]) ** 2,
        noise={channel.name: channel.noise.scaled(sizes.of(channel.size)) for channel in CHANNELS},
        healthy=0,
        free=np.array([name not in GIVEN_SCATTER for name in names]),
    )


def _names(
    vehicle: Vehicle, causes: Sequence[Candidate], lacking: Sequence[Effect], values: Mapping[str, float]
) -> list[str]:
    """The parameters that are fitted: those that a channel depends on, but those that only shape a lacking effect."""
    effects = (*vehicle.model.effects, *lacking)
    needed = {name for channel in CHANNELS for name in depends(channel, effects)}
    strengths = {name for c in causes for name in c.names}
    of_effects = {x.name for e in vehicle.model.effects for x in e.parameters}
    shaping = {x.name for e in lacking for x in e.parameters} - strengths
    fitted = set(VEHICLE_PARAMETERS) | of_effects | strengths | {nuisance.name for nuisance in NUISANCES}
    return sorted(name for name in (needed & fitted) - shaping if name in values)


def _linearised(job: tuple[Ride, MixedModel]) -> LinearRide:
    ride, mixed = job
    line = linearise(ride, mixed.values, mixed.names, mixed.scale, mixed.system)
    wide = np.sqrt(np.diag(mixed.prior)) + 3 * np.sqrt(mixed.scatter)
    for parameter in [parameter for cause in mixed.usable_causes for parameter in cause.parameters]:
        (i,) = mixed.index([parameter.name])
        wide[i] += max(10 * float(np.sqrt(mixed.scatter[i])), 3 * parameter.prior_sd / float(mixed.scale[i]))
    line = trimmed(line, mixed.noise, mixed.mean, wide)
    return spread_out(line, mixed.noise, mixed.mean, wide) if mixed.healthy else line


def linearise_all(
    rides: Sequence[Ride], mixed: MixedModel | Sequence[MixedModel], workers: int = 1
) -> list[LinearRide]:
    """All rides at a model, or each at its own, in `workers` processes."""
    states = [mixed] * len(rides) if isinstance(mixed, MixedModel) else mixed
    jobs = list(zip(rides, states, strict=True))
    if workers < 2 or len(rides) < 2:
        return [_linearised(job) for job in jobs]
    with worker_pool(workers) as pool:
        return list(pool.map(_linearised, jobs))
