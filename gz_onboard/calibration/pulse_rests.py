"""Where a cell rests in pulse tests, against its open-circuit voltage and over temperature."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from gz_onboard.arrays import Array
from gz_onboard.calibration.cell_fit import Branches, jackknife
from gz_onboard.calibration.ocv import increasing
from gz_onboard.calibration.pulse_test import FULL_WITHIN, Tested, nearest_to_bench
from gz_onboard.calibration.result import Curve, Result

SURE = 0.99  # how surely the rests must show that temperature moves them, before the vehicle file says so


def rest_shift(fitted: list[Branches], tests: list[Tested], nodes: Array, ocv: Curve) -> tuple[Array, Array]:
    """(shift, sd) (len(nodes),) [V] from the OCV to where the cell rests after discharging, near 25 degC."""
    nearest = nearest_to_bench(tests)
    shift = np.interp(nodes, fitted[nearest].soc, fitted[nearest].shift)
    scatter = np.std([np.interp(nodes, f.soc, f.shift) for f in fitted], axis=0) if len(fitted) > 1 else np.abs(shift)
    shift[nodes == 1] = 0.0 if abs(tests[nearest].test.voltage[0] - ocv.value[-1]) < FULL_WITHIN else shift[-1]
    shift = increasing(nodes, ocv.value + shift) - ocv.value
    return shift, np.hypot(np.minimum(ocv.sd, np.abs(shift) + 0.003), scatter)


def rests_over_soc(fitted: list[Branches], tests: list[Tested], names: str) -> Curve:
    """How much higher the cell rests at each temperature and SOC than near 25 degC."""
    shifts = np.array([f.shift for f in fitted])
    sd = np.array([np.hypot(jackknife(f.shift, f.without[:, :, -1]), f.shift_prior) for f in fitted])
    axes = {"soc": fitted[0].soc, "temperature": np.array([t.temperature for t in tests])}
    covered = np.array([f.covered for f in fitted])
    return Curve(
        axes,
        shifts - shifts[nearest_to_bench(tests)],
        np.where(covered, sd, np.nan),
        "V",
        f"{names}: rest voltage against that near 25 degC",
    )


def shift_of_rests(rests: Curve, tests: list[Tested], names: str, result: Result) -> None:
    """The shift (temperatures,) [V] of the open-circuit voltage, as ``battery.rest_shift``, if it is sure.

    The mean over 15 to 95 % SOC; its sd holds how it varies there, since one number is to stand for all of it.
    """
    reference = nearest_to_bench(tests)
    soc = rests.axes["soc"]
    middle = (soc > 0.15) & (soc < 0.95)
    known = [row[middle & np.isfinite(sd)] for row, sd in zip(rests.value, rests.sd, strict=True)]
    within = [sd[middle & np.isfinite(sd)] for sd in rests.sd]
    if len(tests) < 2 or not all(map(len, known)):
        return
    mean = np.array([row.mean() for row in known])
    sd = np.array([np.hypot(row.std(), s.mean()) for row, s in zip(known, within, strict=True)])
    others = np.arange(len(tests)) != reference
    chance = float(chi2.sf(np.sum((mean[others] / np.maximum(sd[others], 1e-3)) ** 2), len(tests) - 1))
    moves = ", ".join(
        f"{1e3 * m:+.1f} ± {1e3 * s:.1f} mV at {t.temperature:g} degC"
        for t, m, s, other in zip(tests, mean, sd, others, strict=True)
        if other
    )
    if chance > 1 - SURE:
        result.notes.append(
            f"rests do not move with temperature beyond how they scatter over the state of charge: {moves}; "
            "the open-circuit voltage is one for all temperatures"
        )
        return
    result.notes.append(f"the cell rests {moves} against {tests[reference].temperature:g} degC")
    result.curves["battery.rest_shift"] = Curve(
        {"temperature": rests.axes["temperature"]},
        mean,
        sd,
        "V",
        f"{names}: mean over 15 to 95 % SOC of the rests against those near 25 degC",
    )
