"""A cooling network fitted to runs on a bench and to rides, all together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.calibration.cooling_network import ENTROPY, Model, Values
from gz_onboard.calibration.cooling_run import CoolingRun
from gz_onboard.calibration.fit import Solution, nonlinear
from gz_onboard.model.parameters import declared_parameters

BLOCK = 300.0  # s: what is left over is taken to depend on itself for that long
MANY = 6  # runs: whole runs are then the independent pieces
START_SD = 0.15  # K
FINE_SD, COARSE_SD = 0.2, 0.5  # K: of sensors that resolve tenths of a kelvin, of those in whole degrees
FREE = (-np.inf, np.inf)


@dataclass(frozen=True)
class Job:
    """What is fitted: a network, its free parameters with start, those held, priors as (value, sd).

    per_speed: what moving air adds to the conductance to the ambient; held where no air moves in any run.
    further_sd: of parameters, what no sample shows.
    """

    model: Model
    start: dict[str, float]
    held: dict[str, float]
    prior: dict[str, tuple[float, float]]
    per_speed: str = ""
    further_sd: Mapping[str, float] = field(default_factory=dict)

    def error(self, values: Values, run: CoolingRun) -> Array:
        """Model less measured [K], all sensors of the run after one another."""
        modelled = self.model(values, run)
        return np.concatenate([modelled[name] - run.measured[name] for name in modelled if name in run.measured])

    def rms(self, values: Values, runs: Sequence[CoolingRun]) -> float:
        """[K], of all runs and sensors."""
        return float(np.sqrt(np.mean(np.concatenate([self.error(values, run) for run in runs]) ** 2)))

    def fit(self, runs: Sequence[CoolingRun]) -> tuple[Solution, dict[str, float]]:
        """(The solution, all values with it)."""
        start, held = dict(self.start), dict(self.held)
        if self.per_speed and not any(run.air.any() for run in runs):
            held[self.per_speed] = start.pop(self.per_speed)
        prior = {name: known for name, known in self.prior.items() if name in start}
        bounds = {name: FREE if name in ENTROPY else _bounds(name, value) for name, value in start.items()}
        if len(runs) < MANY:  # the noise of where a run starts lasts; of many runs the pieces are whole runs
            sensors = self.model({**held, **start}, runs[0])
            nodes = [f"start:{run.name}:{name}" for run in runs for name in sensors if name in run.measured]
            start |= dict.fromkeys(nodes, 0.0)
            prior |= dict.fromkeys(nodes, (0.0, START_SD))
            bounds |= dict.fromkeys(nodes, FREE)
        names = tuple(start)
        guess = {**held, **start}
        sd = np.concatenate(
            [_sd(run.measured[name]) for run in runs for name in self.model(guess, run) if name in run.measured]
        )

        def residual(x: Array) -> Array:
            values = {**held, **dict(zip(names, x.tolist(), strict=True))}
            return np.asarray(np.concatenate([self.error(values, run) for run in runs]) / sd)

        found = nonlinear(residual, start, bounds=bounds, prior=prior, known_sd=True, groups=self._pieces(runs))
        return found, {**held, **dict(zip(names, found.value.tolist(), strict=True))}

    def _pieces(self, runs: Sequence[CoolingRun]) -> Array:
        """For each residual the piece it belongs to: its run if there are `MANY`, else its `BLOCK`."""
        labels, first = [], 0.0
        for run in runs:
            piece = np.zeros_like(run.time) if len(runs) >= MANY else np.floor((run.time - run.time[0]) / BLOCK)
            sensors = len(self.error({**self.held, **self.start}, run)) // len(run.time)
            labels += [first + piece] * sensors
            first += piece[-1] + 1
        return np.concatenate(labels)


def _sd(measured: Array) -> Array:
    """Of each sample [K]; a sensor in whole degrees shows others only between two messages."""
    whole = np.mean(np.abs(measured - np.round(measured)) < 1e-3) > 0.5
    return np.full(len(measured), COARSE_SD if whole else FINE_SD)


def _bounds(name: str, value: float) -> tuple[float, float]:
    declared = declared_parameters()[name]
    return max(1e-4 * value, declared.low), min(1e3 * value, declared.high)


def halves(runs: Sequence[CoolingRun]) -> tuple[list[CoolingRun], list[CoolingRun]]:
    """(to fit, held out): every second ride is held out, if there are two or more."""
    held = {run.name for run in [run for run in runs if not run.bench][1::2]}
    return [run for run in runs if run.name not in held], [run for run in runs if run.name in held]
