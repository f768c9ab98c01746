"""Data that contradict what was known before them: said in the same words by calibration and discovery."""

from __future__ import annotations

from collections.abc import Sequence

from gz_onboard.errors import InputError
from gz_onboard.model.parameters import Value

ENTERED = "as entered"
"""The status of what is told with the rides, which counts before the file's."""
FAR = 4.0  # standard deviations of what was known and of the data together, beyond which they contradict it


def overrun(name: str, known: Value, found: tuple[float, float], far: float, pulled: str) -> str:
    """What is told of one parameter: `known` by the file, `found` (value, sd) by rides, `far` [sd] apart.

    pulled: which signals lead it there.
    """
    value, sd = found
    origin = known.status if known.status == ENTERED else f"({known.status}) by the file"
    return (
        f"{name} is {known.value:.4g} ± {known.sd:.2g} {known.unit} {origin} and {value:.4g} ± "
        f"{sd:.2g} {known.unit} by these rides, {far:.0f} standard deviations apart; {pulled}"
    )


def stop_at(overruns: Sequence[str]) -> None:
    """InputError with all of them; nothing without any."""
    if overruns:
        raise InputError(
            "; ".join(overruns) + ". Nothing is written. If these signals are poor, leave them out of [roles]; if the "
            "file only guesses, give it a larger sd"
        )
