"""What is known of a vehicle without healthy rides: what its file says, taken as true.

An effect that its model lacks is not there; noise and scatter between rides are those of the very rides that are
looked into, with everything free that could be a cause, so that no cause makes them look noisier than they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.discovery.channels import ChannelNoise
from gz_onboard.discovery.grid import Ride
from gz_onboard.discovery.linear import Noise, learn_noise
from gz_onboard.discovery.mixed_model import MixedModel, linearise_all
from gz_onboard.model.effect import Port

ROUNDS = 2  # of parameters and noise in turn
SCATTER_ROUNDS = 60  # of expectation and maximisation
SCATTER_FROM = 3  # rides
CIRCUIT_TIME = 300.0  # s: what one RC pair lacks relaxes over minutes
ABSENT = 1e-3  # sd in scales of an effect that the model lacks
BENCH_FACTORS = ("cell_resistance_factor", "cooling_factor")
"""Factors on what a bench measured of one cell and one motor: as sure as they are declared, without a ride."""
MAKE_SPREAD = 0.05  # by which losses differ between motors and inverters of one make, sd as a share
NOTE = (
    "no healthy rides are known of this vehicle (--baseline): it is held against its file, whose model is taken at "
    "its word, and the rate of false alarms is not calibrated"
)


def without_baseline(mixed: MixedModel, rides: Sequence[Ride], workers: int = 1) -> MixedModel:
    """`mixed` of a vehicle file, to judge `rides` with."""
    lines = linearise_all(rides, mixed, workers)
    wide = mixed.widened()
    for _ in range(ROUNDS):
        post = wide.fit(wide.normals(lines))
        wide = replace(wide, noise=learn_noise(lines, post.mean + post.own, wide.noise))
    scatter = mixed.scatter
    if len(rides) >= SCATTER_FROM:
        scatter = wide.learned_scatter(wide.normals(lines), 1.0, SCATTER_ROUNDS).scatter
    return replace(mixed, noise=noise_of_file(wide.noise, mixed), scatter=scatter, prior=prior_of_file(mixed))


def noise_of_file(noise: Noise, mixed: MixedModel) -> Noise:
    """`noise` in which the circuit of a cell errs as the file says that it does (`cell_voltage_error`): slowly."""
    if "cell_voltage" not in noise or "cell_voltage_error" not in mixed.vehicle.parameters:
        return noise
    white, slow, time = noise["cell_voltage"]
    stated = mixed.vehicle.parameters.sd("cell_voltage_error")
    return {**noise, "cell_voltage": ChannelNoise(white, max(slow, stated), max(time, CIRCUIT_TIME))}


def prior_of_file(mixed: MixedModel) -> Array:
    """The prior of `mixed` in which an effect that the model lacks is not there, and what no ride has shown to be as it
    should is no surer than the file, or what is declared of every vehicle, says.
    """
    known = mixed.vehicle.parameters
    prior = mixed.prior.copy()
    for effect in mixed.vehicle.model.effects:
        for parameter in (p for p in effect.parameters if p.bench and p.name in mixed.names):
            (i,) = mixed.index([parameter.name])
            # losses are alike within a make; how a cell's reaction slows is its own, and its bench had another cell
            reaction = effect.port is Port.CELL_VOLTAGE
            own = parameter.prior_sd if reaction else MAKE_SPREAD * known[parameter.name]
            prior[i, i] += (own / float(mixed.scale[i])) ** 2
    for name in set(BENCH_FACTORS) & set(mixed.names):
        (i,) = mixed.index([name])
        prior[i, i] = (known.sd(name) / float(mixed.scale[i])) ** 2
    for cause in mixed.lacking:
        for parameter in (p for p in cause.parameters if p.name in mixed.names):
            i = mixed.names.index(parameter.name)
            prior[i, :] = prior[:, i] = 0.0
            prior[i, i] = ABSENT**2
            if cause.effect and cause.effect.port is Port.CELL_VOLTAGE:  # every cell has some, as its circuit's error
                usual = float(np.hypot(parameter.prior, parameter.prior_sd))
                prior[i, i] = (usual / float(mixed.scale[i])) ** 2
    return prior
