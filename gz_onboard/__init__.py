"""Real-time remaining range, with its uncertainty, on an electric scooter's CAN bus.

The names of the Python API (`gz_onboard.api`) are here too, imported when first asked for: the daemon loads none.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gz_onboard.api import (
        Baseline,
        Calibration,
        CheckedVehicle,
        Discovered,
        DiscoveryOptions,
        EstimatedRide,
        InputError,
        LearnedState,
        LoggedEstimates,
        LoggedFrames,
        LoggedMessage,
        LoggedSignals,
        Recording,
        Reported,
        SimulatedRide,
        SimulationOptions,
        Swept,
        Validated,
        Vehicle,
        baseline,
        calibrate,
        check_vehicle,
        discover,
        estimate,
        read_estimates,
        read_frames,
        read_learned,
        read_ride,
        read_signals,
        read_vehicle,
        report,
        simulate,
        summary_table,
        sweep,
        validate,
    )

__version__ = "0.1.0"
__all__ = [
    "Baseline",
    "Calibration",
    "CheckedVehicle",
    "Discovered",
    "DiscoveryOptions",
    "EstimatedRide",
    "InputError",
    "LearnedState",
    "LoggedEstimates",
    "LoggedFrames",
    "LoggedMessage",
    "LoggedSignals",
    "Recording",
    "Reported",
    "SimulatedRide",
    "SimulationOptions",
    "Swept",
    "Validated",
    "Vehicle",
    "__version__",
    "baseline",
    "calibrate",
    "check_vehicle",
    "discover",
    "estimate",
    "read_estimates",
    "read_frames",
    "read_learned",
    "read_ride",
    "read_signals",
    "read_vehicle",
    "report",
    "simulate",
    "summary_table",
    "sweep",
    "validate",
]


if not TYPE_CHECKING:  # which reports misspelt names

    def __getattr__(name: str) -> object:
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        try:
            from gz_onboard import api
        except ModuleNotFoundError as error:
            from gz_onboard.imports import missing_extra

            if not (missing := missing_extra(error)):
                raise
            raise ImportError(f"gz_onboard.{name} {missing}", name=error.name) from error

        value: object = getattr(api, name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
