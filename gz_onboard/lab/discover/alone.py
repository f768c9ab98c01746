"""What is known of a vehicle of which no healthy rides are: its file is taken at its word.

An effect that its model lacks is not there; noise and scatter between rides are those of the very rides that are
looked into, with everything free that could be a cause, so that no cause makes them look noisier than they are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.lab.discover.grid import Ride
from gz_onboard.lab.discover.linear import Linear, Noise, fit_mixed, learn_noise, normal
from gz_onboard.lab.discover.state import State
from gz_onboard.physics.effect import Port

FREE = 25.0  # variance in scales that is added to that of every parameter while noise and scatter are learned
ROUNDS = 2
SCATTER_FROM = 3  # rides
CIRCUIT_TIME = 300.0  # s: what one RC pair lacks relaxes over minutes
ABSENT = 1e-3  # sd in scales of an effect that the model lacks
LOSSES = (
    "motor_copper_resistance",
    "motor_iron_linear",
    "motor_iron_quadratic",
    "inverter_loss_constant",
    "inverter_loss_linear",
    "inverter_loss_quadratic",
)
UNTOLD = ("cell_resistance_factor", "cooling_factor")
"""Factors on what a bench told of one cell and one motor: as sure as they are declared, until a ride has told."""
MAKE = 0.05  # by which losses differ between motors and inverters of one make, sd as a share
NOTE = (
    "no healthy rides are known of this vehicle (--baseline): it is held against its file, whose model is taken at "
    "its word, and the rate of false alarms is not calibrated"
)


def alone(state: State, rides: Sequence[Ride], linearise: Callable[[Sequence[Ride], State], list[Linear]]) -> State:
    """`state` of a vehicle file, to judge `rides` with. linearise: rides at a state."""
    lines = linearise(rides, state)
    noise = state.noise
    free = state.prior + FREE * np.eye(len(state.names))
    for _ in range(ROUNDS):
        post = fit_mixed([normal(line, noise) for line in lines], state.mean, free, state.scatter, 1.0, state.free, 0)
        noise = learn_noise(lines, post.mean + post.own, noise)
    scatter = state.scatter
    if len(rides) >= SCATTER_FROM:
        normals = [normal(line, noise) for line in lines]
        scatter = fit_mixed(normals, state.mean, free, state.scatter, 1.0, state.free, 60).scatter
    noise = as_wrong_as_it_says(noise, state)
    return replace(state, noise=noise, scatter=scatter, prior=as_the_file_says(state))


def as_wrong_as_it_says(noise: Noise, state: State) -> Noise:
    """`noise` in which the circuit of a cell errs as the file says that it does (`cell_voltage_error`): slowly."""
    if "cell_voltage" not in noise or "cell_voltage_error" not in state.vehicle.parameters:
        return noise
    white, slow, time = noise["cell_voltage"]
    stated = state.vehicle.parameters.sd("cell_voltage_error")
    return {**noise, "cell_voltage": (white, max(slow, stated), max(time, CIRCUIT_TIME))}


def as_the_file_says(state: State) -> Array:
    """The prior of `state` in which an effect that the model lacks is not there, and what no ride has shown to be as it
    should is no surer than the file, or what is declared of every vehicle, says.
    """
    has = {effect.name for effect in state.vehicle.model.effects}
    known = state.vehicle.parameters
    prior = state.prior.copy()
    for name in set(LOSSES) & set(state.names):
        (i,) = state.index([name])
        prior[i, i] += (MAKE * known[name] / float(state.scale[i])) ** 2
    for name in set(UNTOLD) & set(state.names):
        (i,) = state.index([name])
        prior[i, i] = (known.sd(name) / float(state.scale[i])) ** 2
    for cause in state.causes:
        if cause.effect and cause.effect.name not in has:
            for parameter in (p for p in cause.parameters if p.name in state.names):
                i = state.names.index(parameter.name)
                prior[i, :] = prior[:, i] = 0.0
                prior[i, i] = ABSENT**2
                if cause.effect.port is Port.CELL_VOLTAGE:  # every cell has some, in the error that its circuit states
                    usual = float(np.hypot(parameter.prior, parameter.prior_sd))
                    prior[i, i] = (usual / float(state.scale[i])) ** 2
    return prior
