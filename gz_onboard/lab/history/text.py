"""A history for a terminal. Times are those of the zone that the machine has, or ``TZ``."""

from __future__ import annotations

from collections.abc import Sequence

from gz_onboard.events import words
from gz_onboard.lab.history.ride import KeptRide
from gz_onboard.lab.history.totals import LEARNED, LearnedAt, NumberedRide, Overview, Totals, local
from gz_onboard.offline.results import clock, number

HISTORY_VERSION = 1  # of the keys in JSON
LATEST = 10  # rides that are listed if not all are asked for
_DOUBTFUL = 60.0  # s of a ride without a whole estimate: less is not told
_METERED = 0.99  # of the distance: less is told
_TO_THE_LEFT = ("", "month", "air", "start", "rider")  # columns


def ride_text(ride: KeptRide) -> str:
    """A ride in half a line."""
    drawn = number(ride.energy_wh, ".0f", "Wh")
    return f"{_start(ride)}, {ride.distance_km:.2f} km in {clock(ride.duration_s)}, {drawn}"


def lacks_energy(ride: KeptRide) -> bool:
    """Whether the energy of a part of it is not known."""
    return ride.energy_wh is not None and ride.metered_km < _METERED * ride.distance_km


def overview_text(overview: Overview, every: bool) -> str:
    """All that is known of a vehicle; every: all its rides are listed, else the latest."""
    parts = [overview.vehicle, _totals("month", [*overview.months, overview.total])]
    if len(overview.temperatures) > 1:
        parts.append(_totals("air", overview.temperatures))
    parts += [line for name in LEARNED if (line := _learned(name, overview.learned))]
    rides = overview.rides if every else overview.rides[-LATEST:]
    parts.append(_rides(rides))
    if left := len(overview.rides) - len(rides):
        parts.append(f"  {left} before these: --rides lists all")
    return "\n\n".join(parts)


def _totals(kind: str, totals: Sequence[Totals]) -> str:
    head = (kind, "rides", "km", "h", "kWh", "recovered", "Wh/km", "at °C")
    lines = [
        (
            t.of.replace("degC", "°C"),
            f"{t.rides}",
            f"{t.distance_km:.1f}",
            f"{t.duration_s / 3600:.1f}",
            number(t.energy_wh, ".2f", factor=1e-3),
            number(t.energy_recovered_wh, ".2f", factor=1e-3),
            number(t.consumption_wh_km, ".1f"),
            number(t.ambient_C, ".0f"),
        )
        for t in totals
    ]
    return _table(head, lines)


def _learned(name: str, found: Sequence[LearnedAt]) -> str:
    """The latest of a kind, and the first."""
    of = [one for one in found if one.name == name]
    if not of:
        return ""
    said = [f"{x.value:.3f} ± {x.sd:.3f} on {local(x.start_ns):%Y-%m-%d}" for x in (of[-1], of[0])]
    return f"  {name} over the vehicle file's: {'; first '.join(dict.fromkeys(said))}"


def _rides(rides: Sequence[NumberedRide]) -> str:
    head = ("", "start", "min", "km", "Wh", "Wh/km", "SOC %", "range km", "°C", "rider", "")
    lines = []
    for one in rides:
        r = one.ride
        doubts = [f"{r.degraded_s + r.invalid_s:.0f} s degraded"] if r.degraded_s + r.invalid_s >= _DOUBTFUL else []
        doubts += [f"energy of {r.metered_km:.1f} km only"] if lacks_energy(r) else []
        doubts += [f"{', '.join(map(words, r.distrusted.split()))} left out"] if r.distrusted else []
        lines.append(
            (
                f"{one.number}",
                _start(r),
                f"{r.duration_s / 60:.0f}",
                f"{r.distance_km:.1f}",
                number(r.energy_wh, ".0f"),
                number(r.consumption_wh_km, ".1f"),
                f"{number(r.soc_start, '.0f', factor=100)} → {number(r.soc_end, '.0f', factor=100)}",
                f"{number(r.range_start_km, '.1f')} → {number(r.range_end_km, '.1f')}",
                number(r.ambient_C, ".0f"),
                r.rider or "",
                "; ".join(doubts),
            )
        )
    return _table(head, lines)


def _start(ride: KeptRide) -> str:
    return f"{local(ride.start_ns):%Y-%m-%d %H:%M}" if ride.dated else "without a date"


def _table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Columns: texts to the left, numbers to the right."""
    widths = [max(len(row[i]) for row in (head, *lines)) for i in range(len(head))]
    return "\n".join(_row(row, head, widths) for row in (head, *lines))


def _row(row: Sequence[str], head: Sequence[str], widths: Sequence[int]) -> str:
    cells = zip(row, head, widths, strict=True)
    return "  ".join(["", *(x.ljust(w) if name in _TO_THE_LEFT else x.rjust(w) for x, name, w in cells)]).rstrip()
