"""Extended Kalman filter of one battery cell: two pure functions on a small immutable state, in plain floats.

The state is x = (state of charge z, slow model error e [V], inverse capacity ψ, resistance factor ρ). Capacity and
resistance are factors on the vehicle file's values (joint estimation: Plett 2004, part 3). Over a step in which a
share q of the file's capacity flows (Lord 2016, eq. 2.21),

    z' = z - ψ·q        e' = b·e        ψ' = ψ        ρ' = ρ

so that ψ learns from each later voltage by its covariance with z. The overpotential V1 of the RC pair follows the
current alone (eq. 2.22) and is carried along. e is a Gauss-Markov process (Gelb 1974, sec. 3.8): the first voltage
tells as much as the circuit is good for, the next ones only as much as e can have changed since.

Three scalar measurements condition the state, each with its own slopes h over (z, e, ρ): a voltage, a state of charge
known from a rest or from before, and a quick change of the voltage, which shows the resistance. Constant errors of the
sensors (current offset and gain, voltage offset) are not states but considered in the noise (`battery_priors`).

`filterpy_reference` is the same filter by filterpy.
"""

from __future__ import annotations

from collections.abc import Callable
from math import log, pi, sqrt
from typing import NamedTuple

Covariance = tuple[float, float, float, float, float, float, float, float, float, float]
"""Upper triangle of the symmetric 4x4 matrix, row by row: zz, ze, zψ, zρ, ee, eψ, eρ, ψψ, ψρ, ρρ; e in V."""


class FilterState(NamedTuple):
    """Mean and covariance of a cell's state, and the overpotential that goes with it."""

    soc: float
    error: float  # V: slow error of the cell model, predicted minus true voltage
    inverse_capacity: float  # capacity in the vehicle file over the pack's
    resistance: float  # resistance of the pack over that in the vehicle file
    covariance: Covariance
    v1: float = 0.0  # V: overpotential of the RC pair


class Noise(NamedTuple):
    """Process noise of one step."""

    soc: float  # variance that counting the charge adds
    error: float  # V²: stationary variance of the model error
    error_decay: float  # factor by which the model error decays over the step
    capacity: float = 0.0  # variance that the inverse capacity gains
    resistance: float = 0.0  # variance that the resistance factor gains


def predict(state: FilterState, charge: float, v1: float, noise: Noise) -> FilterState:
    """Predict the state after a `charge` (share of the file's capacity) has flowed; v1: the new overpotential [V]."""
    zz, ze, zc, zr, ee, ec, er, cc, cr, rr = state.covariance
    b = noise.error_decay
    covariance = (
        zz - 2 * charge * zc + charge * charge * cc + noise.soc,
        b * (ze - charge * ec),
        zc - charge * cc,
        zr - charge * cr,
        noise.error + b * b * (ee - noise.error),
        b * ec,
        b * er,
        cc + noise.capacity,
        cr,
        rr + noise.resistance,
    )
    soc = state.soc - state.inverse_capacity * charge
    return FilterState(soc, b * state.error, state.inverse_capacity, state.resistance, covariance, v1)


def condition(
    state: FilterState,
    slopes: tuple[float, float, float],
    residual: float,
    variance: float,
    min_capacity_variance: float,
) -> FilterState:
    """Condition the state on a scalar measurement.

    slopes: derivatives of the measurement over (soc, error, resistance); residual: measured minus predicted; variance:
    of the measurement's noise. The variance of the inverse capacity stays at `min_capacity_variance` or more, and its
    gain is reduced to match (a partial update: Brink 2017); infinity leaves the capacity as it is.
    """
    hz, he, hr = slopes
    zz, ze, zc, zr, ee, ec, er, cc, cr, rr = state.covariance
    z, e = hz * zz + he * ze + hr * zr, hz * ze + he * ee + hr * er  # covariances of state and measurement
    c, r = hz * zc + he * ec + hr * cr, hz * zr + he * er + hr * rr
    total = hz * z + he * e + hr * r + variance
    kz, ke, kc, kr = z / total, e / total, c / total, r / total
    reduction = kc * c  # of the variance of the inverse capacity
    share = min(max(cc - min_capacity_variance, 0.0) / reduction, 1.0) if reduction > 0 else 0.0
    covariance = (
        zz - kz * z,
        ze - kz * e,
        zc - kz * c,
        zr - kz * r,
        ee - ke * e,
        ec - ke * c,
        er - ke * r,
        cc - share * reduction,
        cr - kc * r,
        rr - kr * r,
    )
    inverse = state.inverse_capacity + share * kc * residual
    soc, error, resistance = state.soc + kz * residual, state.error + ke * residual, state.resistance + kr * residual
    return FilterState(soc, error, inverse, resistance, covariance, state.v1)


class Backend(NamedTuple):
    """The two functions of a filter: `predict` and `condition`, or the reference's."""

    predict: Callable[[FilterState, float, float, Noise], FilterState]
    condition: Callable[[FilterState, tuple[float, float, float], float, float, float], FilterState]


SCALAR = Backend(predict, condition)


def log_likelihood(residual: float, variance: float) -> float:
    """Logarithm of the normal density of a `residual` with this `variance`."""
    return -(residual * residual / variance + log(2 * pi * variance)) / 2


def with_soc(state: FilterState, soc: float, variance: float) -> FilterState:
    """Replace the state of charge and its variance; its error is no longer that of the charge counted so far."""
    zz, ze, _, _, ee, _, er, cc, cr, rr = state.covariance
    ze *= sqrt(variance / zz)
    return state._replace(soc=soc, covariance=(variance, ze, 0.0, 0.0, ee, 0.0, er, cc, cr, rr))


def with_wider_capacity(state: FilterState, variance: float) -> FilterState:
    """Add `variance` to the inverse capacity, as if it had been there while the charge was counted."""
    zz, ze, zc, zr, ee, ec, er, cc, cr, rr = state.covariance
    counted = zc / cc
    wider = (zz + counted * counted * variance, ze, zc + counted * variance, zr, ee, ec, er, cc + variance, cr, rr)
    return state._replace(covariance=wider)
