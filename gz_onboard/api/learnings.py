"""What the daemon has learned of a vehicle and its riders."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from gz_onboard.api.given import PathLike, VehicleLike, vehicle_of
from gz_onboard.arguments import checked
from gz_onboard.daemon import learned as command
from gz_onboard.errors import brief
from gz_onboard.estimator.pack_age import LearnedFactor
from gz_onboard.reports.tables import Columns, Tabular, columns_of
from gz_onboard.state import state_file

_COLUMNS = ("part", "name", "factor", "sd", "percent_learned")


@dataclass(frozen=True)
class LearnedState(Tabular):
    """What a saved state holds, as factors on what the vehicle file says.

    age_s: age of the state by this machine's clock, if known; battery: by name; riders: by rider, then by name. The
    last rider comes first; "" stands for rides without a known rider.
    """

    vehicle: str
    age_s: float | None
    battery: Mapping[str, LearnedFactor]
    riders: Mapping[str, Mapping[str, LearnedFactor]]

    __repr__ = brief

    def __str__(self) -> str:
        return command.learned_text(self.battery, self.riders)

    def to_table(self) -> Columns:
        """One row per factor. part: ``battery``, or ``rider`` and the rider's name."""
        factors = [("battery", self.battery), *((f"rider {who}".strip(), of) for who, of in self.riders.items())]
        rows: list[dict[str, object]] = [
            {"part": part, "name": name, "factor": x.value, "sd": x.sd, "percent_learned": 100 * x.share}
            for part, found in factors
            for name, x in found.items()
        ]
        return columns_of(rows, {name: name for name in _COLUMNS})


@checked
def read_learned(file: PathLike | None = None, vehicle: VehicleLike = "reference") -> LearnedState:
    """What the daemon has learned of `vehicle`, out of the state that it saves.

    file: the state; where the service keeps the vehicle's if not given. Raises InputError if there is none, or it is
    another vehicle's or damaged.
    """
    known = vehicle_of(vehicle)
    path = state_file(command.STATE_FOLDER, known.name) if file is None else Path(file)
    estimator, age = command.read_state(path, known)
    return LearnedState(known.name, age, command.battery_learned(estimator), command.riders_learned(estimator))
