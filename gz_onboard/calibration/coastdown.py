"""Coast-downs: rolling resistance and drag area out of rolling to rest (Lord 2016, sec. 3.2; SAE J1263, J2263).

Runs in both directions of one track: its slope changes sign with the direction, the rest does not. Each run has a
constant headwind of its own, unknown but for a prior. Force over spans of two seconds is fitted: the equation of motion
is in `road_load`, the fit in `coastdown_fit`, what makes a run usable in `coastdown_run`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from math import sqrt

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.calibration.coastdown_fit import RoadFit, covariance_with_inputs, fit_road
from gz_onboard.calibration.coastdown_run import SLOWEST, SPAN, Coast, coast, directions
from gz_onboard.calibration.fit import correlation, score
from gz_onboard.calibration.result import Fit, Found, Panel, PlotLine, Result
from gz_onboard.calibration.road_load import NAMES, RoadLoad, own_wind, roll
from gz_onboard.constants import GRAVITY
from gz_onboard.errors import InputError
from gz_onboard.recording.recording import Recording
from gz_onboard.vehicle import Vehicle

WIND_SD = 1.0  # m/s: a constant wind along the track on a day that was chosen for coast-downs
SLOPE_SD = 0.01  # sine: a track that was chosen for coast-downs


def calibrate(
    runs: Sequence[Recording],
    vehicle: Vehicle,
    *,
    wind_sd: float = WIND_SD,
    slope_sd: float = SLOPE_SD,
    hold_out: bool = True,
) -> Result:
    """Rolling resistance and drag area of `vehicle` from coast-downs.

    runs: with ``motor_speed``, a wheel's or the vehicle's speed, and if at hand ``throttle``, ``brake_switch``,
    ``motor_current``, ``ambient_temperature``, ``gps_altitude``; facts ``rider_mass_kg`` or ``total_mass_kg``,
    ``direction``, ``ambient_C``. wind_sd [m/s]: of the constant wind of a run; slope_sd: of the track's slope (sine).
    hold_out: also fit without one pair of runs at a time and say how well these are followed.

    Raises InputError for a run that is too short, driven, or speeds up, for less than two runs or a run given twice.
    """
    if len(runs) < 2:
        raise InputError(f"{len(runs)} coast-down; at least 2 are needed, in both directions of one track")
    twice = {run.name for run in runs if [r.name for r in runs].count(run.name) > 1}
    if twice:
        raise InputError(f"coast-down {sorted(twice)[0]} is given twice")
    signs = directions(runs)
    coasts = [coast(run, vehicle, sign) for run, sign in zip(runs, signs, strict=True)]
    result = Result("coastdown")
    both = len(set(signs)) == 2
    best, covariance, shares = _fitted(coasts, vehicle, wind_sd, slope_sd, result)
    if not both:
        together = best.value(NAMES[0]) + signs[0] * best.solution["slope"]
        result.refusals.append(
            f"rolling_resistance_constant: all runs go one way ({runs[0].facts.get('direction', 'by GPS course')}), so "
            f"that the track's slope and rolling resistance are not separable: together {together:.4f}, apart known to "
            f"± {sqrt(covariance[0, 0]):.4f} only (the slope's prior, ± {slope_sd:g}); coast down the other way too"
        )
    _report(result, best, coasts, vehicle, NAMES if both else NAMES[1:], covariance, wind_sd)
    largest = sorted(shares.items(), key=lambda item: -abs(item[1]))[:4]
    result.notes.append(
        f"part of the sd of drag_area from what was taken as given: "
        f"{', '.join(f'{name} {abs(share):.4f}' for name, share in largest)} m²"
    )
    _correlation_note(result, covariance)
    if "motor_current" in runs[0].columns:
        offset = np.mean([_coasting_current(run, c) for run, c in zip(runs, coasts, strict=True)])
        result.notes.append(f"motor current while coasting reads {offset:.2f} A in mean, taken as its sensor's offset")
    if hold_out and len(coasts) > 2:
        result.fits += _held_out(coasts, vehicle, best.held, wind_sd, slope_sd)
    return result


def _fitted(
    coasts: Sequence[Coast], vehicle: Vehicle, wind_sd: float, slope_sd: float, result: Result
) -> tuple[RoadFit, Array, dict[str, float]]:
    """(the fit, covariance of `NAMES`, shares of what was taken as given in the sd of drag area).

    Rolling resistance is held independent of speed, with a refusal, where that cannot be separated from drag.
    """
    free = fit_road(coasts, vehicle, {}, wind_sd, slope_sd)
    covariance, shares = covariance_with_inputs(free, free, coasts, vehicle, NAMES)
    if free.value(NAMES[1]) >= 2 * sqrt(covariance[1, 1]) and free.value(NAMES[2]) > 0:
        return free, covariance, shares
    best = fit_road(coasts, vehicle, {NAMES[1]: 0.0}, wind_sd, slope_sd, free.noise)
    wide = fit_road(coasts, vehicle, {}, wind_sd, slope_sd, free.noise, best)
    covariance, shares = covariance_with_inputs(wide, best, coasts, vehicle, NAMES)
    speed_term, speed_sd = wide.value(NAMES[1]), sqrt(covariance[1, 1])
    tie = covariance[:, 1] / covariance[1, 1]
    # About the value that is held, not about the most likely one: its distance counts as an error too.
    covariance = covariance + np.outer(tie, tie) * speed_term**2
    why = "zero (less than 2 sd)"
    if free.value(NAMES[2]) <= 0:
        why = f"drag, whose area would be {free.value(NAMES[2]):.2f} m² beside it"
    result.refusals.append(
        f"rolling_resistance_speed: ({1e5 * speed_term:.1f} ± {1e5 * speed_sd:.1f})·10⁻⁵ s/m is indistinguishable from "
        f"{why}; held at 0 ± {1e5 * sqrt(covariance[1, 1]):.1f}·10⁻⁵, which the other two carry"
    )
    return best, covariance, shares


def _coasting_current(run: Recording, c: Coast) -> float:
    t, current = run.columns["motor_current"]
    inside = (t >= c.time[0]) & (t <= c.time[-1])
    return float(current[inside].mean()) if inside.any() else 0.0


def _correlation_note(result: Result, covariance: Array) -> None:
    r = correlation(covariance)
    pairs = [f"{NAMES[i]} and {NAMES[j]} {r[i, j]:+.2f}" for i, j in combinations(range(len(NAMES)), 2)]
    result.notes.append(f"correlations: {', '.join(pairs)}")


def _report(
    result: Result,
    road: RoadFit,
    runs: Sequence[Coast],
    vehicle: Vehicle,
    names: Sequence[str],
    covariance: Array,
    wind_sd: float,
) -> None:
    """Parameters, notes and plots of `road` into `result`; `covariance` is over all `NAMES`."""
    solution = road.solution
    force = road.force(vehicle)
    speeds = [roll(force, run, solution["slope"], solution[f"wind {run.name}"], run.time) for run in runs]
    data, model = np.concatenate([run.speed for run in runs]), np.concatenate(speeds)
    fit = score("speed, coasting, own wind", "m/s", data, model, held_out=False, source=_names(runs))
    result.fits.append(fit)
    cold, warm = min(run.temperature for run in runs), max(run.temperature for run in runs)
    ups = sum(run.direction > 0 for run in runs)
    points = sum(len(run.middle) for run in runs)
    source = (
        f"{len(runs)} coast-downs ({ups} one way, {len(runs) - ups} the other), {points} spans of {SPAN:g} s, "
        f"{cold:.0f} to {warm:.0f} degC, {data.min():.1f} to {data.max():.1f} m/s, "
        f"own wind of {wind_sd:g} m/s sd; speed follows within {fit.rms:.2f} m/s rms"
    )
    units = {NAMES[0]: "1", NAMES[1]: "s/m", NAMES[2]: "m²"}
    index = [NAMES.index(name) for name in names]
    for name, i in zip(names, index, strict=True):
        how = "held at zero: not distinguishable from it; " if name in road.held else ""
        result.parameters[name] = Found(road.value(name), float(np.sqrt(covariance[i, i])), units[name], how + source)
    result.covariance.append((tuple(names), covariance[np.ix_(index, index)]))
    up = next((run.name for run in runs if run.direction > 0), "none")
    slope, slope_sd = 100 * solution["slope"], 100 * solution.sd("slope")
    result.notes.append(f"slope of the track {slope:.3f} ± {slope_sd:.3f} %, uphill in the direction of {up}")
    winds = ", ".join(f"{run.name} {solution[f'wind {run.name}']:+.1f}" for run in runs)
    sd = float(np.mean([solution.sd(f"wind {run.name}") for run in runs]))
    result.notes.append(f"headwind of each run, m/s, ± {sd:.1f}: {winds}")
    noise = road.noise
    result.notes.append(
        f"left over: gusts of {noise.gust:.2f} m/s lasting {noise.lasting:.0f} s, speed noise of {noise.speed:.4f} m/s"
    )
    result.panels += _panels(force, road, runs, speeds)


def _names(runs: Sequence[Coast]) -> str:
    return ", ".join(run.name for run in runs)


def _panels(force: RoadLoad, road: RoadFit, runs: Sequence[Coast], speeds: Sequence[Array]) -> list[Panel]:
    slope = road.solution["slope"]
    lines, errors, loads = [], [], []
    for run, model in zip(runs, speeds, strict=True):
        time = run.time - run.time[0]
        lines += [PlotLine(run.name, time, run.speed, "."), PlotLine("", time, model, "-")]
        errors.append(PlotLine(run.name, time, run.speed - model, "-"))
        level = run.slowing * (run.mass + force.rotating) - run.direction * slope * run.mass * GRAVITY
        loads.append(PlotLine(run.name, run.middle, level, "."))
    v = np.linspace(SLOWEST, max(float(run.speed.max()) for run in runs), 50)
    mass, temperature = (
        float(np.mean(column)) for column in zip(*((r.mass, r.temperature) for r in runs), strict=True)
    )
    still = Coast("", v, v, 1, None, mass, temperature, 0.0)
    loads.append(PlotLine("model, still air, motor included", v, force(v, still, 0.0, 0.0), "-"))
    return [
        Panel("Coast-downs", "time [s]", "speed [m/s]", tuple(lines)),
        Panel("Coast-downs: residual", "time [s]", "measured less model [m/s]", tuple(errors)),
        Panel("Road load, slope taken off", "speed [m/s]", "force [N]", tuple(loads)),
    ]


def _held_out(
    runs: Sequence[Coast], vehicle: Vehicle, held: Mapping[str, float], wind_sd: float, slope_sd: float
) -> list[Fit]:
    """Each pair of runs, one each way, followed by a fit of the others: with its own wind free, and at no wind."""
    by_direction = [[run for run in runs if run.direction == sign] for sign in (1, -1)]
    both = all(by_direction)
    pairs = list(zip(*by_direction, strict=False)) if both else [(run,) for run in runs]
    data: list[Array] = []
    free: list[Array] = []
    still: list[Array] = []
    for pair in pairs:
        rest = [run for run in runs if run.name not in [other.name for other in pair]]
        if not rest or (both and len({run.direction for run in rest}) < 2):
            continue
        road = fit_road(rest, vehicle, held, wind_sd, slope_sd)
        force, slope = road.force(vehicle), road.solution["slope"]
        for run in pair:
            data.append(run.speed)
            still.append(roll(force, run, slope, 0.0, run.time))
            free.append(roll(force, run, slope, own_wind(force, run, slope), run.time))
    if not data:
        return []
    source = f"one {'pair' if both else 'run'} at a time left out of {_names(runs)}"
    measured = np.concatenate(data)
    return [
        score("speed, own wind free", "m/s", measured, np.concatenate(free), held_out=True, source=source),
        score("speed, no wind", "m/s", measured, np.concatenate(still), held_out=True, source=source),
    ]
