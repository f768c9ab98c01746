"""The physics over a whole ride in numpy arrays, and quantities that only offline tools need, such as the first SOC.

Lags, tables and effects give here the values (n,) that their scalar forms in ``physics`` give step by step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from types import FunctionType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gz_onboard.arrays import Array
from gz_onboard.model.battery import HALF_FULL, Battery, discharged, reversible_heat
from gz_onboard.model.effect import QUANTITIES, Equation, Port
from gz_onboard.model.functions import Mesh, PiecewiseLinear, asinh, cos, exp, sin, sqrt
from gz_onboard.model.model import STOOD, Bound, Model, Recall

OF_FLOATS = {exp: math.exp, sin: math.sin, cos: math.cos, sqrt: math.sqrt, asinh: math.asinh}
NEGLIGIBLE = 1e-20  # share of a value that is too small to change it in floating point
SOC_ROUNDS = 5  # of the search for a SOC under load: R0 depends on it


def all_quantities(**known: Any) -> dict[str, Any]:
    """All quantities that effects read, floats or arrays: `known`, the cosine of its ``grade``, and 0 for the rest."""
    cosine = sqrt(1 - known["grade"] * known["grade"]) if "grade" in known else 1.0
    return dict.fromkeys(QUANTITIES, 0.0) | {"grade_cosine": cosine} | known


def relaxation(targets: Array, decays: Array, start: float = 0.0, before: bool = False) -> Array:
    """The values (n,) of a first-order lag at the ends of all steps from `start` on; targets, decays: (n,).

    before: the values at the beginnings of the steps instead. The remainder of earlier steps is carried over 1, 2, 4,
    ... steps in whole arrays (Hillis & Steele 1986).
    """
    values, left, steps = (1 - decays) * targets, decays.copy(), 1
    values[:1] += decays[:1] * start
    while steps < len(values) and left[steps:].max() > NEGLIGIBLE:
        values[steps:] += left[steps:] * values[:-steps]
        left[steps:] *= left[:-steps]
        steps *= 2
    return np.concatenate(([start], values[:-1])) if before else values


def curve_over(curve: PiecewiseLinear, x: Array) -> Array:
    """The values of `curve` at `x` (m,)."""
    return np.asarray(np.interp(x, curve.x, curve.y))


def extended_over(xs: ArrayLike, ys: ArrayLike, x: Array) -> Array:
    """The values at `x` (m,): straight between the points (`xs`, `ys`), and along the last slope beyond the ends."""
    nodes, values = np.asarray(xs), np.asarray(ys)
    i = np.clip(np.searchsorted(nodes, x, side="right") - 1, 0, len(nodes) - 2)
    slope = (values[i + 1] - values[i]) / (nodes[i + 1] - nodes[i])
    return np.asarray(values[i] + slope * (x - nodes[i]))


def bilinear_over(xs: Array, ys: Array, table: Array, x: Array, y: Array, geometric: bool = False) -> Array:
    """`table` (len(ys), len(xs)) at `x` and `y`, both (m,); the edge beyond, as `Mesh.at`."""
    i = np.clip(np.searchsorted(xs, x, side="right") - 1, 0, len(xs) - 2)
    u = np.clip((x - xs[i]) / (xs[i + 1] - xs[i]), 0, 1)
    if len(ys) == 1:
        return np.asarray(table[0][i] * (1 - u) + table[0][i + 1] * u)
    j = np.clip(np.searchsorted(ys, y, side="right") - 1, 0, len(ys) - 2)
    w = np.clip((y - ys[j]) / (ys[j + 1] - ys[j]), 0, 1)
    of = np.log(table) if geometric else table
    left, right = (of[j, k] * (1 - w) + of[j + 1, k] * w for k in (i, i + 1))
    if geometric:
        left, right = np.exp(left), np.exp(right)
    return np.asarray(left * (1 - u) + right * u)


def mesh_over(mesh: Mesh, soc: Array, temperature: Array) -> Array:
    """The values of `mesh` at `soc` and `temperature` [degC], both (m,)."""
    nodes = np.array(mesh.soc), np.array(mesh.temperature), np.array(mesh.value)
    return bilinear_over(*nodes, soc, temperature, mesh.geometric)


def ocv_over(battery: Battery, soc: Array, temperature: Array) -> Array:
    """The open-circuit voltages [V] of a cell at `soc` and `temperature` [degC], both (m,)."""
    volts = extended_over(battery.ocv_curve.x, battery.ocv_curve.y, soc)
    return volts + curve_over(battery.rest_shift_curve, temperature) if battery.rest_shift_curve else volts


def reversible_heat_over(battery: Battery, current: Array, soc: Array, temperature: Array) -> Array:
    """`Battery.reversible_heat` [W] at the pack's `current` [A], `soc` and `temperature` [degC], all (n,)."""
    if battery.entropy is None:
        return np.zeros_like(current)
    return np.asarray(reversible_heat(battery.cells_series * curve_over(battery.entropy, soc), current, temperature))


def series(effect: Bound, dt: Any, quantities: Mapping[str, Any], before: bool = False) -> Any:
    """The values (n,) of `effect` at the ends of steps of `dt` [s], starting from 0.

    quantities: in each step, scalars or arrays (n,); n = 1 if all are scalars. before: at the beginnings instead.
    """
    target, decay = np.broadcast_arrays(
        np.asarray(effect(quantities), dtype=float), np.asarray(effect.decay(dt, quantities), dtype=float), np.ones(1)
    )[:2]
    if effect.effect.decay is None or not target.any():
        return target.copy()
    return relaxation(target, decay, before=before)


def over(dt: Any) -> Recall:
    """Recall effects with memory over consecutive steps of `dt` [s], starting from 0: see `series`."""
    return lambda effect, quantities: series(effect, dt, quantities)


def stepper(effects: Sequence[Bound], dt: float | None) -> Callable[[Mapping[str, float]], tuple[float, ...]]:
    """Return a function from quantities to the values of `effects`, to be called once each step of `dt` [s].

    Effects with memory start from 0; without `dt` they are settled. The function is compiled from source, without loops
    and layers of calls: a simulation calls it a hundred times for each second ridden.
    """
    scope: dict[str, Any] = {"dt": dt}
    lines = []
    for i, bound in enumerate(effects):
        call = _call(bound.effect.term, bound.values, f"term{i}", scope)
        if not bound.effect.term.quantities:
            scope[f"constant{i}"] = bound({})
            call = f"constant{i}"
        if bound.effect.decay and dt is not None:
            scope[f"value{i}"], kept = 0.0, _call(bound.effect.decay, bound.values, f"decay{i}", scope)
            if bound.has_fixed_time:
                scope[f"kept{i}"], kept = bound.decay(dt, {}), f"kept{i}"
            lines += [f"global value{i}", f"k = {kept}", f"value{i} = k * value{i} + (1 - k) * {call}"]
            call = f"value{i}"
        lines.append(f"x{i} = {call}")
    values = "".join(f"x{i}, " for i in range(len(effects)))
    exec("\n    ".join(["def values(q):", *lines, f"return ({values})"]), scope)
    return scope["values"]  # type: ignore[no-any-return]


def _call(equation: Equation, values: Mapping[str, float], label: str, scope: dict[str, Any]) -> str:
    """Source of a call of `equation` as `label`, with quantities from ``q`` and with ``dt``; adds it to `scope`."""
    scope[label] = _with_values(equation, values)
    return f"{label}({', '.join(name if name == 'dt' else f'q[{name!r}]' for name in equation.quantities)})"


def _with_values(equation: Equation, values: Mapping[str, float]) -> Callable[..., Any]:
    """The function of `equation` with its parameters as defaults: the quickest call that Python has."""
    function, given = equation.function, [values[name] for name in equation.parameters]
    if not isinstance(function, FunctionType) or function.__defaults__:
        return partial(function, **dict(zip(equation.parameters, given, strict=True)))
    scope = {
        name: OF_FLOATS.get(value, value) if isinstance(value, FunctionType) else value
        for name, value in function.__globals__.items()
    }
    code = function.__code__  # in which arguments by keyword follow those by position
    code = code.replace(co_argcount=code.co_argcount + len(given), co_kwonlyargcount=0)
    return FunctionType(code, scope, function.__name__, tuple(given), function.__closure__)


def total(effects: Iterable[Bound], quantities: Mapping[str, Any], recall: Recall | None = None) -> Any:
    """The sum of the values of `effects`: see `Bound`."""
    return sum((effect(quantities, recall) for effect in effects), 0.0)


def terminal_voltage(rest: Any, r0: Any, current: Any, overpotential: Any) -> Any:
    """Voltage [V] under `current` [A]; overpotential [V]: of the RC pair and whatever else relaxes (eq. 2.23)."""
    return rest - r0 * current - overpotential


def heat(rest: Any, terminal: Any, current: Any) -> Any:
    """Heat [W]: power of the chemistry less that at the terminals (eq. 2.24; as printed it mixes cell and pack).

    Energy that the RC pair's capacitor stores for a minute counts as heat, as in the printed form.
    """
    return (rest - terminal) * current


def advanced(
    battery: Battery, dt: float, soc: float, v1: float, current: float, temperature: float
) -> tuple[float, float]:
    """(SOC, V1 [V]) of a cell after `dt` [s] at a constant `current` [A] and `temperature` [degC]: eqs. 2.21, 2.22."""
    _, r1, c1 = battery.circuit(soc, temperature)
    decay = exp(-dt / (r1 * c1))
    later = soc - discharged(current, dt, battery.cell_capacity(temperature))
    return later, decay * v1 + (1 - decay) * r1 * current


def idle_loss(model: Model, quantities: Mapping[str, Any]) -> Any:
    """Loss of the motor [W] turning without current: drag on the shaft, which the motor's current makes up for."""
    return total(model.at(Port.MOTOR_LOSS), {**quantities, "torque": 0.0, "motor_current": 0.0})


def soc_at_load(battery: Battery, voltage: float, current: float, temperature: float, v1: float = 0.0) -> float:
    """The SOC of a cell with this `voltage` [V] at a `current` [A] and `temperature` [degC]; v1 [V]: its RC pair's.

    It may be below 0 or above 1, where the open-circuit voltage continues.
    """
    soc = HALF_FULL
    for _ in range(SOC_ROUNDS):
        soc = battery.soc_at(voltage + battery.r0.at(soc, temperature)[0] * current + v1, temperature)
    return soc


def first_soc(
    effects: Iterable[Bound], battery: Battery, first: tuple[float, float], temperature: float, load: float
) -> float:
    """The SOC from the pack's first voltage [V] and current [A] of a ride.

    effects: in the cells. temperature: degC. load: the current [A] that has flowed for `STOOD`, from rest, see
    `standing_load`; the RC pair, slower than most effects, is taken to be at rest still. The SOC may be below 0 or
    above 1, see `soc_at_load`.
    """
    voltage, current = first
    cell, capacity = current / battery.cells_parallel, battery.cell_capacity(temperature)
    q = all_quantities(
        cell_current=load / battery.cells_parallel, soc=HALF_FULL, cell_temperature=temperature, cell_capacity=capacity
    )
    lost = float(sum(effect(q) * (1 - effect.decay(STOOD, q)) for effect in effects))
    return soc_at_load(battery, battery.cell_voltage(voltage, current) + lost, cell, temperature)
