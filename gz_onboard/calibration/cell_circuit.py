"""A cell's equivalent circuit over arrays: filters of the current, tables over SOC and temperature, voltage.

    V = V_oc(SOC) + shift(T) - R0·I - η - Σ R_k·x_k,    dx_k/dt = (I - x_k)/τ_k

V_k = R_k·x_k (Lord 2016, eqs. 2.22 and 2.23); shift is zero unless the rests show one, and so is η
(the effect `charge_transfer`) unless pulses of several currents do.

I is the cell's current [A], positive when discharging. With the time constants and η given, V is linear in every table.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.model.effects import charge_transfer
from gz_onboard.offline.series import bilinear_over, extended_over, relaxation, terminal_voltage

*FOUND, REACTIONS = charge_transfer.PARAMETERS
"""Those that pulses show, and the number of reactions. Pulses alone would take more of them, and road profiles held out
of the fit then err more, not less: it stays as declared.
"""


@dataclass(frozen=True)
class Reaction:
    """The parameters of the effect `charge_transfer`: resistance [ohm], activation [K] and time [s], with their sds."""

    resistance: float = 0.0
    activation: float = 0.0
    time: float = 1.0
    sd: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def overpotential(self, flowed: Array, dt: Array, temperature: Array) -> Array:
        """What it takes from the voltage (m,) [V], of a cell that has rested.

        flowed: the mean current [A] over the `dt` [s] before each sample, temperature [degC]; all (m,).
        """
        settled = charge_transfer.term(
            flowed,
            temperature,
            charge_transfer_resistance=self.resistance,
            charge_transfer_activation=self.activation,
            charge_transfer_reactions=REACTIONS.prior,
        )
        return follow(settled, dt, self.time)


NO_REACTION = Reaction()


@dataclass(frozen=True)
class Circuit:
    """Tables of one cell: R0, one fast RC pair and, if `slow_resistance` is given, a slow one.

    ocv: (n,) [V] over ocv_soc. r0, r1 [ohm], c1 [F], slow_resistance [ohm], slow_time [s]: (temperatures, soc).
    capacity: (temperatures,) [A·h]. rest_shift: (temperatures,) [V], how much higher the cell rests than `ocv`.
    """

    ocv_soc: Array
    ocv: Array
    soc: Array
    temperature: Array
    capacity: Array
    r0: Array
    r1: Array
    c1: Array
    slow_resistance: Array | None = None
    slow_time: Array | None = None
    rest_shift: Array | None = None
    reaction: Reaction = NO_REACTION

    def ocv_shift(self, temperature: Array) -> Array:
        """What the open-circuit voltage (m,) [V] is above `ocv` at `temperature` (m,) [degC]."""
        if self.rest_shift is None:
            return np.zeros(np.shape(temperature))
        return np.asarray(np.interp(temperature, self.temperature, self.rest_shift))


def hats(nodes: Array, x: Array) -> Array:
    """(len(x), len(nodes)): the weights of linear interpolation between `nodes`, constant beyond them."""
    x = np.clip(x, nodes[0], nodes[-1])
    i = np.clip(np.searchsorted(nodes, x, side="right") - 1, 0, len(nodes) - 2)
    w = (x - nodes[i]) / (nodes[i + 1] - nodes[i])
    result = np.zeros((len(x), len(nodes)))
    rows = np.arange(len(x))
    result[rows, i] = 1 - w
    result[rows, i + 1] = w
    return result


def follow(target: Array, dt: Array, tau: float | Array) -> Array:
    """x (m,) that follows `target` (m,), which holds for the `dt` (m,) [s] before each sample, with `tau` [s].

    A target of R·I gives the voltage of an RC pair, exact for a current constant over each step (eq. 2.22).
    """
    return relaxation(target, np.exp(-dt / tau * np.ones(len(target))))


def follow_slope(current: Array, dt: Array, tau: Array) -> tuple[Array, Array]:
    """(x, its derivative over ln τ) for a time constant (m,) [s] that changes along the way."""
    decay = np.exp(-dt / tau)
    x, y, xs, ys = 0.0, 0.0, [], []
    for a, d, i in zip(decay.tolist(), (decay * dt / tau).tolist(), current.tolist(), strict=True):
        y = a * y + d * (x - i)
        x = a * x + (1 - a) * i
        xs.append(x)
        ys.append(y)
    return np.array(xs), np.array(ys)


def voltage(cell: Circuit, flowed: Array, current: Array, dt: Array, soc: Array, temperature: Array) -> Array:
    """The cell's voltage (m,) [V] as the on-board model steps it.

    flowed: the mean current over the `dt` before each sample; current: at the sample. The cell has rested: all
    RC pairs start at zero.
    """
    tables, over = (cell.r0, cell.r1, cell.c1), (cell.soc, cell.temperature)
    r0, r1, c1 = (bilinear_over(*over, t, soc, temperature, geometric=True) for t in tables)
    pairs = follow(r1 * flowed, dt, r1 * c1)
    if cell.slow_resistance is not None and cell.slow_time is not None:
        slow = (cell.slow_resistance, cell.slow_time)
        r2, tau = (bilinear_over(*over, t, soc, temperature, geometric=True) for t in slow)
        pairs = pairs + follow(r2 * flowed, dt, tau)
    pairs = pairs + cell.reaction.overpotential(flowed, dt, temperature)
    rest = extended_over(cell.ocv_soc, cell.ocv, soc) + cell.ocv_shift(temperature)
    return np.asarray(terminal_voltage(rest, r0, current, pairs))


def riding_current(duration: int = 1200, seed: int = 1) -> Array:
    """A current (duration,) [any unit, each for 1 s] such as a scooter in town draws, after a minute's rest.

    Pulling away, cruising, braking with recuperation, waiting, with shares of time and of current as in
    urban riding (mean over RMS about 0.6). Only its shape counts: what is reduced over it is linear.
    """
    rng = np.random.default_rng(seed)
    parts = [np.zeros(60)]
    while sum(map(len, parts)) < duration:
        parts.append(np.full(rng.integers(5, 13), rng.uniform(3.0, 5.0)))
        for _ in range(rng.integers(1, 5)):
            parts.append(np.full(rng.integers(5, 25), rng.uniform(0.4, 2.2)))
        parts.append(np.full(rng.integers(3, 8), rng.uniform(-0.9, -0.2)))
        parts.append(np.full(rng.integers(2, 30), 0.0))
    return np.concatenate(parts)[:duration]
