"""The thesis' own results beside ours, row by row (Lord 2016, sections 2.3 and 3.2).

Ours are of data held out of the fit, except where the thesis gives the fit itself. Its R² of the inverter and motor
maps are of efficiency, ours of watts; its meshes are surfaces through values found pulse by pulse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gz_onboard.calibration.result import Fit, Result


@dataclass(frozen=True)
class Row:
    """One of the thesis' results: what it reached, and which of our fits answers it.

    fits: (procedure, beginning of `Fit.what`, part of `Fit.data`, held out). measure: "r2" (at least `limit`), or
    "largest" (at most `limit`, in `unit`).
    """

    what: str
    fits: tuple[str, str, str, bool]
    measure: str
    limit: float
    unit: str = ""

    @property
    def thesis(self) -> str:
        """What the thesis says."""
        return f"R² {self.limit:.4f}" if self.measure == "r2" else f"±{self.limit:g} {self.unit}"


ROWS = (
    Row("back-EMF constant", ("motor", "back-EMF", "", True), "r2", 0.9993),
    Row("torque constant", ("motor", "shaft torque", "all currents", True), "r2", 0.9804),
    Row("inverter map", ("losses", "inverter loss", "all currents", True), "r2", 0.9949),
    Row("motor map", ("losses", "motor loss", "all currents", True), "r2", 0.8774),
    Row("R0 over (SOC, T)", ("pulse", "mesh of R0, SOC 0.2 to 0.9, half against half", "", True), "r2", 0.9976),
    Row("R1 over (SOC, T)", ("pulse", "mesh of R1, SOC 0.2 to 0.9, half against half", "", True), "r2", 0.9210),
    Row("C1 over (SOC, T)", ("pulse", "mesh of C1, SOC 0.2 to 0.9, half against half", "", True), "r2", 0.9600),
    Row("cell voltage, road profile, 25 °C", ("pulse", "cell voltage", "25C", True), "largest", 0.02, "V"),
    Row("cell voltage, road profile, 5 °C", ("pulse", "cell voltage", "_5C", True), "largest", 0.02, "V"),
    Row("motor temperature, calibration", ("cooling", "motor temperature, bench", "", False), "largest", 4, "°C"),
    Row("motor temperature, validation", ("cooling", "motor temperature, bench", "valid", True), "largest", 10, "°C"),
    Row("motor temperature, riding", ("cooling", "motor temperature, riding", "", True), "largest", 10, "°C"),
    Row("inverter temperature, calibration", ("cooling", "inverter temperature, bench", "", False), "largest", 1, "°C"),
    Row("inverter temperature, validation", ("cooling", "inverter temperature", "valid", True), "largest", 6, "°C"),
    Row("inverter temperature, riding", ("cooling", "inverter temperature, riding", "", True), "largest", 6, "°C"),
    Row("cell temperature", ("cooling", "cell temperature", "", True), "largest", 1, "°C"),
    Row("BMS temperature", ("cooling", "bms temperature", "", True), "largest", 4, "°C"),
    Row("coast-down speed, wind unknown", ("coastdown", "speed, no wind", "", True), "largest", 2, "m/s"),
)

WORDS = ("no", "yes")
HEAD = ("what", "thesis", "ours", "rms", "on", "better")


def compare(results: Sequence[Result]) -> list[tuple[str, ...]]:
    """Rows of `HEAD` for what was calibrated; the worst of several fits that answer one row."""
    rows = []
    for row in ROWS:
        procedure, what, data, held_out = row.fits
        fits = [
            fit
            for result in results
            if result.procedure == procedure
            for fit in result.fits
            if fit.what.startswith(what) and data in fit.data and fit.held_out == held_out
        ]
        if fits:
            rows.append(_row(row, fits))
    return rows


def _row(row: Row, fits: Sequence[Fit]) -> tuple[str, ...]:
    on = "; ".join(dict.fromkeys(fit.data for fit in fits)) + ("" if row.fits[3] else " (fitted)")
    if row.measure == "r2":
        r2 = min(fit.r2 if fit.r2 is not None else 0.0 for fit in fits)
        return row.what, row.thesis, f"R² {r2:.4f}", "", on, WORDS[r2 >= row.limit]
    worst = max(fits, key=lambda fit: fit.largest)
    ours, rms = (f"{x:.2g} {row.unit}" for x in (worst.largest, max(fit.rms for fit in fits)))
    return row.what, row.thesis, f"±{ours}", rms, on, WORDS[worst.largest <= row.limit]
