"""A cooling network fitted to runs, with what is not known well of it counted in its covariance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.lab.calibrate.cooling_network import Model, Values
from gz_onboard.lab.calibrate.cooling_run import CoolingRun
from gz_onboard.lab.calibrate.fit import Solution, nonlinear
from gz_onboard.physics.parameters import declared_parameters

BLOCK = 300.0  # s: what is left over is taken to depend on itself for that long
MANY = 6  # runs: whole runs are then the independent pieces
START_SD = 0.15  # K
BENCH_SD, RIDE_SD = 0.2, 0.5  # K: resolution and noise of the sensors


@dataclass(frozen=True)
class Job:
    """What is fitted: a network, its free parameters with start, those held, priors as (value, sd).

    outside: the conductance to the ambient, if a room has one of its own. doubted: (lower, upper) likely value of
    parameters that are held; further_sd: of parameters, what no sample shows.
    """

    model: Model
    start: dict[str, float]
    held: dict[str, float]
    prior: dict[str, tuple[float, float]]
    outside: str = ""
    doubted: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    further_sd: Mapping[str, float] = field(default_factory=dict)

    def of_outside(self, start: float, held: dict[str, float]) -> Job:
        """The job of finding `outside` with all else `held`."""
        return Job(self.model, {self.outside: start}, held, {}, self.outside)

    def error(self, values: Values, run: CoolingRun) -> Array:
        """Model less measured [K], all sensors of the run after one another."""
        modelled = self.model(values, run)
        return np.concatenate([modelled[name] - run.measured[name] for name in modelled if name in run.measured])

    def rms(self, values: Values, runs: Sequence[CoolingRun]) -> float:
        """[K], of all runs and sensors."""
        return float(np.sqrt(np.mean(np.concatenate([self.error(values, run) for run in runs]) ** 2)))

    def fit(self, runs: Sequence[CoolingRun], **more: float) -> tuple[Solution, dict[str, float]]:
        """(The solution, all values with it); `more`: further free parameters, with their starts."""
        start = {**self.start, **more}
        if self.outside in start:
            if any(run.still for run in runs):
                start["room"] = start[self.outside]
            if all(run.still for run in runs):
                del start[self.outside]
        prior = {name: known for name, known in self.prior.items() if name in start}
        least = {name: known.low for name, known in declared_parameters().items()}
        bounds = {name: (max(1e-4 * value, least.get(name, 0.0)), 1e3 * value) for name, value in start.items()}
        bounds |= {"per_speed": (-np.inf, np.inf), "iron_share": (0.0, 1.0)}
        if len(runs) < MANY:  # the noise of where a run starts lasts; of many runs the pieces are whole runs
            modelled = self.model({**self.held, **start}, runs[0])
            nodes = [f"start:{run.name}:{name}" for run in runs for name in modelled if name in run.measured]
            start |= dict.fromkeys(nodes, 0.0)
            prior |= dict.fromkeys(nodes, (0.0, START_SD))
            bounds |= dict.fromkeys(nodes, (-np.inf, np.inf))
        names = tuple(start)
        guess = {**self.held, **start}
        sd = np.concatenate([np.full(len(self.error(guess, run)), BENCH_SD if run.still else RIDE_SD) for run in runs])

        def residual(x: Array) -> Array:
            values = {**self.held, **dict(zip(names, x.tolist(), strict=True))}
            return np.asarray(np.concatenate([self.error(values, run) for run in runs]) / sd)

        found = nonlinear(residual, start, bounds=bounds, prior=prior, known_sd=True, groups=self._pieces(runs))
        return found, {**self.held, **dict(zip(names, found.value.tolist(), strict=True))}

    def _pieces(self, runs: Sequence[CoolingRun]) -> Array:
        """For each residual the piece it belongs to: its run if there are `MANY`, else its `BLOCK`."""
        labels, first = [], 0.0
        for run in runs:
            piece = np.zeros_like(run.time) if len(runs) >= MANY else np.floor((run.time - run.time[0]) / BLOCK)
            sensors = len(self.error({**self.held, **self.start}, run)) // len(run.time)
            labels += [first + piece] * sensors
            first += piece[-1] + 1
        return np.concatenate(labels)


@dataclass(frozen=True)
class Fitted:
    """What came out: of the closed room, if there was one, and of the rides; both are one without either."""

    still: Solution | None
    riding: Solution | None
    values: dict[str, float]

    def solution(self, name: str) -> Solution | None:
        """The fit that gave `name`."""
        return next((s for s in (self.riding, self.still) if s and name in s.names), None)


def fit_networks(job: Job, runs: Sequence[CoolingRun]) -> Fitted:
    """The closed room first, then the conductance to the ambient out of the rides; either by itself gives all."""
    still, rides = [run for run in runs if run.still], [run for run in runs if not run.still]
    if not job.outside or not (still and rides):
        found, values = job.fit(runs)
        return Fitted(found if still and job.outside else None, None if still and job.outside else found, values)
    first, values = job.fit(still)
    held = {key: value for key, value in values.items() if key != job.outside}
    second, values = job.of_outside(job.start[job.outside], held).fit(rides)
    return Fitted(first, _with_doubt(job, first, second, values, rides), values)


def _with_doubt(job: Job, first: Solution, second: Solution, values: Values, rides: Sequence[CoolingRun]) -> Solution:
    """`second`, its variance more by what the doubt of `first` about the inside of the network adds to it."""
    inner = [name for name in first.names if name in job.start]
    more = 0.0
    for shift in np.linalg.cholesky(first.part(inner)).T:  # each as likely as one sd, and independent
        moved = {**values, **{name: values[name] + d for name, d in zip(inner, shift.tolist(), strict=True)}}
        del moved[job.outside]
        again = job.of_outside(second[job.outside], moved).fit(rides)[0]
        more += (again[job.outside] - second[job.outside]) ** 2
    return replace(second, covariance=second.covariance + more)


def with_doubt_of_held(job: Job, fitted: Fitted, runs: Sequence[CoolingRun]) -> Fitted:
    """`fitted`, its covariances more by what holding a doubted parameter at its other likely values would change."""
    still, riding = fitted.still, fitted.riding
    for name, values in job.doubted.items():
        for value in values:
            other = fit_networks(replace(job, held={**job.held, name: value}), runs)
            still = _moved(still, fitted.still, other.still)
            riding = _moved(riding, fitted.riding, other.riding)
    return Fitted(still, riding, fitted.values)


def _moved(so_far: Solution | None, one: Solution | None, other: Solution | None) -> Solution | None:
    """`so_far` with half the square of `other` less `one` in its covariance: of two values as likely as each other."""
    if so_far is None or one is None or other is None:
        return so_far
    change = other.value - one.value
    return replace(so_far, covariance=so_far.covariance + 0.5 * np.outer(change, change))


def halves(runs: Sequence[CoolingRun]) -> tuple[list[CoolingRun], list[CoolingRun]]:
    """(to fit, held out): every second ride is held out, if there are two or more."""
    held = {run.name for run in [run for run in runs if not run.still][1::2]}
    return [run for run in runs if run.name not in held], [run for run in runs if run.name in held]
