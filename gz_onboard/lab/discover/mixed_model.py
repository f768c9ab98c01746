"""What discovery knows of a vehicle before it sees a ride: parameters, priors, scatter and noise of the healthy one."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.stats import t as student

from gz_onboard.arrays import Array, Mask
from gz_onboard.lab.discover.candidates import Candidate, candidates
from gz_onboard.lab.discover.channels import CHANNELS, System, counted_soc, depends
from gz_onboard.lab.discover.grid import Ride, read_ride
from gz_onboard.lab.discover.linear import LinearRide, Noise, linearise, spread_out, trimmed
from gz_onboard.lab.discover.prior import BASE, FIXED, LOG, NUISANCES, RIDE_SD, RIDE_SD_SHARE, stepped
from gz_onboard.physics.effect import Effect
from gz_onboard.physics.parameters import declared_parameters
from gz_onboard.simulation.samples import Samples
from gz_onboard.vehicle import Vehicle

MEAN_SD = {
    "cornering_compliance": 0.1,
    "wind_north": 0.4,
    "wind_east": 0.4,
    "brake_drag_force": 1.5,
    "drivetrain_drag_torque": 0.01,
    "warm_up_share": 0.2,
    "regeneration_loss_share": 0.03,
    "slow_resistance": 0.01,
    "hysteresis_voltage": 0.005,
    "cell_resistance_factor": 0.005,
    "cooling_factor": 0.01,
    "speed_sensor_scale": 0.001,
    "pack_voltage_latency": 0.02,
    "payload_mass": 2.0,
}
"""Of what a healthy vehicle may show of a candidate that its model lacks: standard deviation about none."""
TRANSFER = (
    "motor_copper_resistance",
    "motor_iron_linear",
    "motor_iron_quadratic",
    "inverter_loss_constant",
    "inverter_loss_linear",
    "inverter_loss_quadratic",
    "torque_constant",
    "cable_resistance",
)
TRANSFERRED = 3.0
"""Found on a bench at steady points: on the road they hold within so many times their standard deviation."""
PRIOR_RIDES, LEAST_FREEDOM = 3, 4
"""What is known without healthy rides, worth so many of them; and no scatter is known worse than with so many."""


@dataclass(frozen=True)
class HealthyCurve:
    """What healthy rides leave over a quantity in a channel: coefficients (k,), covariance (k, k), inflation."""

    mean: Array
    covariance: Array
    inflation: float


@dataclass
class MixedModel:
    """The linear model's frame: names (p,), scale (p,), values where it is linearised, and what is known before.

    mean, prior: of the common part less `values`, in scales, (p,), (p, p). scatter: variances between rides, (p,).
    """

    vehicle: Vehicle
    system: System
    causes: tuple[Candidate, ...]
    names: tuple[str, ...]
    scale: Array
    values: dict[str, float]
    mean: Array
    prior: Array
    scatter: Array
    noise: Noise
    healthy: int  # rides that it was learned on
    free: Mask  # whose scatter between rides is learned, (p,)
    inflation: dict[str, float] = field(
        default_factory=dict
    )  # of a cause's score on healthy rides left out, 1 if right
    shapes: dict[str, HealthyCurve] = field(default_factory=dict)  # what healthy rides show over quantities, by name

    @property
    def freedom(self) -> float:
        """Degrees of freedom that the scatter between rides is known with: of a search, two for each ride."""
        return float(max(2 * (self.healthy + PRIOR_RIDES), 2 * LEAST_FREEDOM))

    @property
    def quantile(self) -> float:
        """Of Student's t: half of a 95 % interval, in standard deviations."""
        return float(student.ppf(0.975, max(self.healthy + PRIOR_RIDES, LEAST_FREEDOM)))

    @property
    def usable_causes(self) -> list[Candidate]:
        """The candidates whose parameters some channel depends on."""
        return [cause for cause in self.causes if set(cause.names) <= set(self.names)]

    def healthy_value(self, name: str) -> float:
        """The healthy vehicle's value of a parameter: that of its file, 0 for an effect that its model lacks."""
        has = {effect.name for effect in self.vehicle.model.effects}
        lacking = {n for c in self.causes if c.effect and c.effect.name not in has for n in c.names}
        return 0.0 if name in lacking else float(self.vehicle.parameters[name])

    def index(self, names: Sequence[str]) -> list[int]:
        """Where `names` stand."""
        return [self.names.index(name) for name in names]

    def unit_value(self, vector: Array) -> dict[str, float]:
        """`values` moved by `vector` (p,) in scales."""
        moved = dict(self.values)
        for name, x, scale in zip(self.names, vector, self.scale, strict=True):
            moved[name] = stepped(name, moved[name], float(np.clip(x * scale, -1, 1) if name in LOG else x * scale))
        return moved

    def ride(self, samples: Samples) -> Ride:
        """`samples` on the grid of this vehicle."""
        p = self.vehicle.parameters
        payload = samples.rider_mass if samples.rider_mass is not None else p["payload_mass"]
        ride = read_ride(
            samples, p["wheel_radius"] * p["gear_ratio"], p["vehicle_mass"] + payload, p["torque_constant"]
        )
        if self.system.battery is not None and {"pack_voltage", "pack_current"} <= ride.have:
            ride.quantities["soc"] = counted_soc(ride, self.system)
        return ride


def initial(vehicle: Vehicle, folder: Path | None = None) -> MixedModel:
    """What is known of `vehicle` from its file alone."""
    causes = candidates(folder)
    lacking = [c.effect for c in causes if c.effect and c.name not in {e.name for e in vehicle.model.effects}]
    effects: tuple[Effect, ...] = (*vehicle.model.effects, *lacking)
    p = vehicle.parameters
    copper = p.get("motor_copper_resistance", 0.0)
    system = System(effects, vehicle.battery, p["payload_mass"], copper, vehicle.riding.vibration)
    declared = declared_parameters(effects)
    known = vehicle.parameters
    values = {name: p.prior for name, p in declared.items()} | {name: known[name] for name in known}
    values |= {nuisance.name: nuisance.value for nuisance in NUISANCES}
    absent = {name for c in causes if c.effect in lacking for name in c.names}
    for name in absent:
        values[name] = 0.0
    needed: set[str] = set()
    for channel in CHANNELS:
        needed |= depends(channel, effects)
    nuisances = {nuisance.name: nuisance for nuisance in NUISANCES}
    strengths = {name for c in causes for name in c.names}
    held = {p.name for e in lacking for p in e.parameters} - strengths
    of_effects = {p.name for e in vehicle.model.effects for p in e.parameters}
    names = sorted((needed & (set(BASE) | of_effects | strengths | set(nuisances))) - held)
    names = [name for name in names if name in nuisances or name in values]
    scale, sd, ride_sd, bench = [], [], [], []
    for name in names:
        if name in nuisances:
            scatter, spread = nuisances[name].ride_sd, nuisances[name].sd
        else:
            spread = known.sd(name) if name in known and name not in absent else declared[name].prior_sd
            if (
                name in MEAN_SD and (name in absent or name not in vehicle_file_names(vehicle))
            ) or name == "payload_mass":
                spread = MEAN_SD[name]
            scatter = RIDE_SD.get(name, RIDE_SD_SHARE * declared[name].prior_sd)
        if name in LOG:
            spread = min(spread / values[name], 0.5)
            scatter = 0.1 if name != "pack_heat_capacity" else 0.05
        wide = spread * (TRANSFERRED if name in TRANSFER else 1.0)
        step = max(scatter, 0.05 * wide)
        scale.append(step)
        sd.append(max(wide / step, 1e-3))
        bench.append(spread / step)
        ride_sd.append(max(scatter / step, 1e-3))
    prior = np.diag(np.array(sd) ** 2)
    place = {name: i for i, name in enumerate(names)}
    for pair, r in known.correlations.items():
        a, b = tuple(pair)
        if a in place and b in place:
            # what the bench leaves open goes together; by how much the road differs from the bench does not
            prior[place[a], place[b]] = prior[place[b], place[a]] = r * bench[place[a]] * bench[place[b]]
    noise = {channel.name: channel.noise for channel in CHANNELS}
    free = np.array([name not in FIXED for name in names])
    return MixedModel(
        vehicle,
        system,
        causes,
        tuple(names),
        np.array(scale),
        values,
        np.zeros(len(names)),
        prior,
        np.array(ride_sd) ** 2,
        noise,
        0,
        free,
    )


def vehicle_file_names(vehicle: Vehicle) -> set[str]:
    """The parameters that the vehicle file itself sets."""
    return {name for name, value in vehicle.parameters.known.items() if not value.source.startswith("prior:")}


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
    with ProcessPoolExecutor(workers) as pool:
        return list(pool.map(_linearised, jobs))
