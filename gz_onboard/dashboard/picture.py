"""The view as plain data: what ``/api/latest`` and ``/api/stream`` say, described in docs/dashboard.md.

A number that is stale, not available or never came is None. Units are in the names, as in the range frames.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from functools import partial

from gz_onboard.dashboard.vehicle_frames import CELLS, ODOMETER
from gz_onboard.dashboard.view import NEARLY_EMPTY, View
from gz_onboard.events import Activity, Reason, RouteState, State

VERSION = 1
NO_LONGER_EMPTY = NEARLY_EMPTY + 2.0  # %: an alert that stands goes only here, not at each wobble
NO_LONGER = 2.0  # K, of a cell that was too hot or too cold: likewise

ALERTS = (
    "bus_down",
    "silent",
    "partly_silent",
    "waiting",
    "range_invalid",
    "cell_too_hot",
    "destination_unreachable",
    "battery_nearly_empty",
    "cell_too_cold",
    "destination_uncertain",
    "sensor_lost",
)
"""What the rider is told, the most urgent first."""


@dataclass(frozen=True, slots=True)
class Range:
    """The distance that can still be ridden."""

    km: float | None
    p10_km: float | None
    p90_km: float | None


@dataclass(frozen=True, slots=True)
class BatteryLevel:
    """State of charge and remaining energy."""

    soc_percent: float | None
    soc_sigma_percent: float | None
    energy_left_wh: float | None


@dataclass(frozen=True, slots=True)
class Cells:
    """How warm they are."""

    coldest_degc: float
    hottest_degc: float


@dataclass(frozen=True, slots=True)
class Consumption:
    """Of the last kilometre, and what is expected of those to come."""

    recent_wh_per_km: float | None
    expected_wh_per_km: float | None


@dataclass(frozen=True, slots=True)
class Charge:
    """While the pack is charged."""

    power_w: float | None
    time_to_full_min: float | None
    range_full_km: float | None


@dataclass(frozen=True, slots=True)
class Destination:
    """The end of the route; the numbers are there only on it."""

    on_route: bool
    left_km: float | None
    arrival_soc_percent: float | None
    arrival_soc_p10_percent: float | None
    battery_ends_after_km: float | None


@dataclass(frozen=True, slots=True)
class CauseOfRange:
    """What one cause makes of the range; negative if it costs."""

    cause: str
    km: float


@dataclass(frozen=True, slots=True)
class FrameCounts:
    """Of the range frames as they were received here."""

    received: int
    lost: int
    bad: int


@dataclass(frozen=True, slots=True)
class Picture:
    """All that is shown. Two are equal if a reader would see no difference: age and counts do not matter."""

    channel: str
    interface: str
    file: str
    bus_up: bool
    heard: bool  # whether any range frame ever came
    state: str | None
    activity: str | None
    range: Range
    range_10min_km: tuple[float | None, ...]  # one each 10 s, the oldest first
    battery: BatteryLevel
    cells: Cells | None
    speed_km_h: float | None
    odometer_km: float | None
    ridden_today_km: float | None
    consumption: Consumption
    charge: Charge | None
    route: Destination | None
    rated_km: float | None
    causes: tuple[CauseOfRange, ...]
    reasons: tuple[str, ...]
    lost: tuple[str, ...]  # of the reasons: sensors that came before
    distrusted: tuple[str, ...]
    late: tuple[str, ...]  # messages, and roles of the vehicle's, of which a newer one should have come
    stale: tuple[str, ...]  # messages whose numbers are no longer given
    alerts: tuple[str, ...]
    age_s: float | None = field(compare=False)  # since the last good frame
    counts: FrameCounts = field(compare=False)

    def encoded(self) -> bytes:
        """As one line of JSON."""
        return json.dumps({"version": VERSION, **asdict(self)}, separators=(",", ":"), allow_nan=False).encode()


def picture(view: View, now: float, source: tuple[str, str], up: bool, before: tuple[str, ...] = ()) -> Picture:
    """What is known at `now` [s, on the clock of the view's frames].

    source: (channel, interface); up: whether that bus is; before: the alerts of the last picture.
    """
    value = partial(view.value, now=now)
    # The range's own state lives ten times as long as the status: of a status that is gone it says too much.
    state = None if view.messages["RANGE_Status"].stale(now) else view.state(now)
    activity, age = _activity(view, now), view.age(now)
    battery = BatteryLevel(
        *(_rounded(value(f"RANGE_{name}")) for name in ("StateOfCharge", "StateOfChargeSigma", "EnergyLeft"))
    )
    route, reasons, lost, waiting = _route(view, now), view.reasons(now), view.lost(now), view.waiting(now)
    stale = tuple(view.stale(now))
    charging = activity is Activity.CHARGING
    distrusted, vehicle = tuple(view.distrusted(now)), view.vehicle
    cells = vehicle.cells(now) if vehicle and CELLS not in distrusted else None
    odometer, ridden = vehicle.odometer(now) if vehicle and ODOMETER not in distrusted else (None, None)
    said = {
        "bus_down": not up,
        "silent": len(stale) == len(view.messages),
        # Not of one that never came: the first frames may have only just begun.
        "partly_silent": len(stale) < len(view.messages) and any(view.messages[name].received for name in stale),
        "waiting": waiting,
        "range_invalid": state is State.INVALID and not waiting,
        "battery_nearly_empty": not charging and _low(battery.soc_percent, "battery_nearly_empty" in before),
        "sensor_lost": Reason.SENSOR_DISTRUSTED in reasons or (bool(lost) and not waiting),
        **_of_cells(cells, vehicle.limits(charging) if vehicle else None, before),
        **_of_destination(route),
    }
    return Picture(
        channel=source[0],
        interface=source[1],
        file=view.file.name,
        bus_up=up,
        heard=not math.isinf(age),
        state=_name(state),
        activity=_name(activity),
        range=Range(*(_rounded(value(f"RANGE_Remaining{part}")) for part in ("", "P10", "P90"))),
        range_10min_km=tuple(map(_rounded, view.trend(now))),
        battery=battery,
        cells=Cells(*(round(value, 1) for value in cells)) if cells else None,
        speed_km_h=vehicle.speed(now, distrusted) if vehicle else None,
        odometer_km=None if odometer is None else round(odometer, 1),
        ridden_today_km=None if ridden is None else round(ridden, 1),
        consumption=Consumption(
            _rounded(value("RANGE_ConsumptionRecent")), _rounded(value("RANGE_ConsumptionExpected"))
        ),
        charge=_charge(view, now),
        route=route,
        rated_km=_rounded(value("RANGE_WhyRated")),
        causes=tuple(CauseOfRange(cause.name.lower(), round(km, 3)) for cause, km in view.why(now)),
        reasons=tuple(str(reason.name).lower() for reason in reasons),
        lost=tuple(str(reason.name).lower() for reason in lost),
        distrusted=distrusted,
        late=(
            *(name for name, entry in view.messages.items() if entry.late(now)),
            *(vehicle.late(now) if vehicle else ()),
        ),
        stale=stale,
        alerts=tuple(alert for alert in ALERTS if said[alert]),
        age_s=None if math.isinf(age) else round(age, 3),
        counts=FrameCounts(
            sum(entry.received for entry in view.messages.values()),
            sum(entry.lost for entry in view.messages.values()),
            view.bad(),
        ),
    )


def _activity(view: View, now: float) -> Activity | None:
    word = view.activity(now)
    return Activity[word.upper()] if word else None


def _name(member: State | Activity | None) -> str | None:
    return None if member is None else member.name.lower()


def _rounded(value: float | None) -> float | None:
    """Without the digits that only the arithmetic has; no signal is finer."""
    return None if value is None else round(value, 3)


def _charge(view: View, now: float) -> Charge | None:
    names = "RANGE_ChargePower", "RANGE_TimeToFull", "RANGE_RemainingFull"
    values = [_rounded(view.value(name, now)) for name in names]
    return None if values == [None] * len(values) else Charge(*values)


def _route(view: View, now: float) -> Destination | None:
    """Nothing if none was given, or nothing says so."""
    state = view.value("RANGE_RouteState", now)
    if state not in (RouteState.ON, RouteState.OFF):
        return None
    left, soc, p10, end = (
        _rounded(view.value(f"RANGE_{name}", now))
        for name in ("RouteLeft", "ArrivalStateOfCharge", "ArrivalStateOfChargeP10", "BatteryEndsAfter")
    )
    return Destination(state == RouteState.ON, left, soc, p10, end)


def _of_destination(route: Destination | None) -> dict[str, bool]:
    """Whether it cannot be reached, or not surely."""
    if route is None or not route.on_route:
        return {"destination_unreachable": False, "destination_uncertain": False}
    unreachable = route.battery_ends_after_km is not None or route.arrival_soc_percent == 0
    return {
        "destination_unreachable": unreachable,
        "destination_uncertain": not unreachable and route.arrival_soc_p10_percent == 0,
    }


def _of_cells(
    cells: tuple[float, float] | None, limits: tuple[float, float] | None, before: tuple[str, ...]
) -> dict[str, bool]:
    """Whether one is hotter or colder [degC] than the limits; an alert that stands goes only some way from them."""
    if cells is None or limits is None:
        return {"cell_too_hot": False, "cell_too_cold": False}
    (coldest, hottest), (low, high) = cells, limits
    hot = hottest > high - (NO_LONGER * ("cell_too_hot" in before))
    return {"cell_too_hot": hot, "cell_too_cold": coldest < low + (NO_LONGER * ("cell_too_cold" in before))}


def _low(soc: float | None, stands: bool) -> bool:
    return soc is not None and soc <= (NO_LONGER_EMPTY if stands else NEARLY_EMPTY)
