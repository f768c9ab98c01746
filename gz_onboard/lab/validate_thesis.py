"""The thesis' figures beside those of rides (Lord 2016): only where it has a number, with the place of it.

Of its pictures of whole rides (figs. 3.8 to 3.20, pp. 65 to 76: speed, voltage, state of charge, throttle) the abstract
gives the outcome, without a number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gz_onboard.lab.validate_score import COMPONENT_GATE, GATE, ChannelErrors, ValidatedRide, channel_words
from gz_onboard.reports.page import Failed

SIMULATED = ("pack_current", "pack_voltage", "motor_torque", "motor_speed")
"""The four signals of the thesis' gate."""
HEAD = ("what", "thesis", "where", "ours, worst", "on", "better or as good")


@dataclass(frozen=True)
class ThesisRow:
    """One of the thesis' figures. form: whose channels answer it, on the road or on the dynamometer (None: on both).

    limit: in percent, or in `unit` that the greatest error may have. says: of a limit in percent. cell: of a cell,
    while a pack was measured.
    """

    what: str
    place: str
    form: str
    channels: tuple[str, ...]
    limit: float
    unit: str = "%"
    on_dynamometer: bool | None = None
    says: str = "met"
    cell: bool = False

    @property
    def thesis(self) -> str:
        """What the thesis says."""
        if self.unit == "%":
            return f"{self.says} (limit {self.limit:g} %)"
        return f"±{self.limit:g} {self.unit}"

    def error(self, channel: ChannelErrors, cells_series: int) -> float | None:
        """What of a channel's errors is to be compared."""
        if self.unit == "%":
            return channel.percent
        return channel.max / cells_series if self.cell else channel.max


_ALONE = ("battery_voltage", "inverter_power", "motor_torque")
_TURNING = "errors in turning"
ROWS = (
    ThesisRow("four signals, open loop, dynamometer", "p. iii", "open_loop", SIMULATED, GATE, on_dynamometer=True),
    ThesisRow("four signals, rider model, dynamometer", "p. iii", "predictive", SIMULATED, GATE, on_dynamometer=True),
    ThesisRow(
        "four signals, open loop, road", "p. iii", "open_loop", SIMULATED, GATE, on_dynamometer=False, says=_TURNING
    ),
    ThesisRow(
        "four signals, rider model, road", "p. iii", "predictive", SIMULATED, GATE, on_dynamometer=False, says=_TURNING
    ),
    ThesisRow("components of the powertrain", "sec. 2.4, p. 48", "components", _ALONE, COMPONENT_GATE),
    ThesisRow("voltage of a cell", "fig. 2.22, bench, p. 40", "components", _ALONE[:1], 0.02, "V", cell=True),
    ThesisRow("motor temperature", "fig. 2.25, bench, p. 44", "components", ("motor_temperature",), 10.0, "K"),
    ThesisRow("inverter temperature", "fig. 2.26, bench, p. 45", "components", ("inverter_temperature",), 6.0, "K"),
    ThesisRow("cell temperature", "fig. 2.27, its fit, p. 47", "components", ("cell_temperature",), 1.0, "K"),
)
"""The page numbers are the thesis' own."""


def of_component(channel: str) -> str:
    """What the thesis reached with this component alone, or nothing."""
    found = [row for row in ROWS if row.form == "components" and row.channels == (channel,)]
    return f"thesis {found[0].thesis}{' a cell' if found[0].cell else ''}" if found else ""


def beside_thesis(rides: Sequence[ValidatedRide]) -> list[list[str]]:
    """Rows of `HEAD`: the worst of all rides that answer one of `ROWS`."""
    rows = []
    for row in ROWS:
        found: list[tuple[float, str, str]] = []
        count = 0
        for ride in rides:
            verdict = ride.verdicts.get(row.form)
            if not verdict or row.on_dynamometer not in (None, ride.on_dynamometer):
                continue
            errors = {name: verdict.channels[name] for name in row.channels if name in verdict.channels}
            count += bool(errors)
            for name, channel in errors.items():
                error = row.error(channel, ride.cells_series)
                if error is not None:
                    found.append((error, channel_words(name), ride.name))
        if found:
            worst, channel_name, where = max(found)
            told = f"{worst:.1f} %" if row.unit == "%" else f"{worst:.2g} {row.unit}"
            several = f", {channel_name}" if len(row.channels) > 1 else ""
            better = "yes" if worst <= row.limit else Failed("no")
            rows.append([row.what, row.thesis, row.place, f"{told}{several}", f"{where}, of {count}", better])
    return rows
