"""The Python API: ``import gz_onboard as gz``. Each function does what the command of its name does, without printing.

Results are dataclasses; those with a table have ``to_table()`` (a dict of numpy arrays), ``to_arrow()`` and
``to_pandas()``. A mistake of the user raises `InputError`. Examples: docs/how-to/python.md.
"""

from gz_onboard.api.calibrations import Calibration, calibrate
from gz_onboard.api.checks import CheckedVehicle, check_vehicle
from gz_onboard.api.discoveries import Baseline, Discovered, baseline, discover
from gz_onboard.api.estimates import EstimatedRide, LoggedEstimates, estimate, read_estimates, summary_table
from gz_onboard.api.exports import LoggedFrames, LoggedMessage, LoggedSignals, read_frames, read_signals
from gz_onboard.api.given import read_ride, read_vehicle
from gz_onboard.api.learnings import LearnedState, read_learned
from gz_onboard.api.reports import Reported, report
from gz_onboard.api.simulations import SimulatedRide, Swept, simulate, sweep
from gz_onboard.api.validations import Validated, validate
from gz_onboard.discovery.command import DiscoveryOptions
from gz_onboard.errors import InputError
from gz_onboard.recording.recording import Recording
from gz_onboard.simulation.plan import SimulationOptions
from gz_onboard.vehicle import Vehicle

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
