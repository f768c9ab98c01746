"""The view model: everything that the terminal, the page, MQTT and Foxglove show, as plain data.

``/api/latest`` and ``/api/stream`` give it as JSON, described in docs/dashboard.md. A number that is stale, not
available or never came is None. Units are in the names, as in the range frames.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field, replace

from gz_onboard.bus.publisher import sensor_signal
from gz_onboard.dashboard.vehicle_frames import CELLS, ODOMETER
from gz_onboard.dashboard.view import View
from gz_onboard.events import ROLES, Activity, Cause, Reason, RouteState

VERSION = 1
NEARLY_EMPTY, NO_LONGER_EMPTY = 15.0, 17.0  # %: state of charge at which the alert begins, and ends
CELL_HYSTERESIS = 2.0  # K: an alert about a cell ends so far within the limit

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
"""For the rider, the most urgent first."""


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
    """Temperatures of the coldest and the hottest cell."""

    coldest_degc: float
    hottest_degc: float


@dataclass(frozen=True, slots=True)
class Consumption:
    """Of the last kilometre, and expected ahead."""

    recent_wh_per_km: float | None
    expected_wh_per_km: float | None


@dataclass(frozen=True, slots=True)
class Charge:
    """Charging, while the pack is charged."""

    power_w: float | None
    time_to_full_min: float | None
    range_full_km: float | None


@dataclass(frozen=True, slots=True)
class Destination:
    """End of the route; the numbers are known only on it."""

    on_route: bool
    left_km: float | None
    arrival_soc_percent: float | None
    arrival_soc_p10_percent: float | None
    battery_ends_after_km: float | None


@dataclass(frozen=True, slots=True)
class CauseOfRange:
    """Contribution of one cause to the range; negative if it costs."""

    cause: str
    km: float


@dataclass(frozen=True, slots=True)
class FrameCounts:
    """Range frames received here."""

    received: int
    lost: int
    bad: int


@dataclass(frozen=True, slots=True)
class VehicleFrameCounts:
    """The vehicle's frames as the daemon counts them since its start."""

    dropped: float | None
    implausible: float | None
    lost: float | None
    unknown: float | None


@dataclass(frozen=True, slots=True)
class Picture:
    """All that is shown. Two compare equal if a reader would see no difference: age and counts do not matter."""

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
    lost: tuple[str, ...]  # reasons: sensors that worked before
    distrusted: tuple[str, ...]
    late: tuple[str, ...]  # messages, and roles of the vehicle's, of which a newer one should have come
    stale: tuple[str, ...]  # messages whose numbers are no longer given
    alerts: tuple[str, ...]
    age_s: float | None = field(compare=False)  # since the last good frame
    counts: FrameCounts = field(compare=False)
    vehicle_counts: VehicleFrameCounts = field(compare=False)

    def encoded(self) -> bytes:
        """Encode as one line of JSON."""
        return json.dumps({"version": VERSION, **asdict(self)}, separators=(",", ":"), allow_nan=False).encode()


def picture(view: View, now: float, source: tuple[str, str], up: bool, before: tuple[str, ...] = ()) -> Picture:
    """Return the picture at `now` [s, on the clock of the view's frames].

    source: (channel, interface); up: whether that bus is; before: the alerts of the last picture.
    """

    def value(name: str) -> float | None:
        found = view.value(f"RANGE_{name}", now)
        return None if found is None else round(found, 3)  # no signal is finer

    # The range's own state lives ten times as long as the status; once the status is gone it says too much.
    state = None if view.messages["RANGE_Status"].stale(now) else view.state(now)
    activity, reasons, lost, waiting = view.activity(now), view.reasons(now), view.lost(now), view.waiting(now)
    age = now - max(entry.time for entry in view.messages.values())
    sensors = view.messages["RANGE_Sensors"].limits
    distrusted = tuple(
        role for role in ROLES if sensor_signal(role) in sensors and view.value(sensor_signal(role), now)
    )
    route_state, route = value("RouteState"), None
    if route_state in (RouteState.ON, RouteState.OFF):
        names = "RouteLeft", "ArrivalStateOfCharge", "ArrivalStateOfChargeP10", "BatteryEndsAfter"
        route = Destination(route_state == RouteState.ON, *map(value, names))
    charge = Charge(*map(value, ("ChargePower", "TimeToFull", "RemainingFull")))
    causes = [(value(f"WhyCause{i}"), value(f"WhyDistance{i}")) for i in (1, 2)]
    vehicle = view.vehicle
    cells = vehicle.cells(now) if vehicle and CELLS not in distrusted else None
    odometer, ridden = vehicle.odometer(now) if vehicle and ODOMETER not in distrusted else (None, None)
    made = Picture(
        channel=source[0],
        interface=source[1],
        file=view.file.name,
        bus_up=up,
        heard=not math.isinf(age),
        state=None if state is None else state.name.lower(),
        activity=None if activity is None else activity.name.lower(),
        range=Range(*map(value, ("Remaining", "RemainingP10", "RemainingP90"))),
        range_10min_km=tuple(None if km is None else round(km, 3) for km in view.trend(now)),
        battery=BatteryLevel(*map(value, ("StateOfCharge", "StateOfChargeSigma", "EnergyLeft"))),
        cells=Cells(*(round(value, 1) for value in cells)) if cells else None,
        speed_km_h=vehicle.speed(now, distrusted) if vehicle else None,
        odometer_km=None if odometer is None else round(odometer, 1),
        ridden_today_km=None if ridden is None else round(ridden, 1),
        consumption=Consumption(*map(value, ("ConsumptionRecent", "ConsumptionExpected"))),
        charge=None if charge == Charge(None, None, None) else charge,
        route=route,
        rated_km=value("WhyRated"),
        causes=tuple(
            CauseOfRange(Cause(int(cause)).name.lower(), km)
            for cause, km in causes
            if cause and cause in tuple(Cause) and km
        ),
        reasons=_names(reasons),
        lost=_names(lost),
        distrusted=distrusted,
        late=(
            *(name for name, entry in view.messages.items() if entry.late(now)),
            *(vehicle.late(now) if vehicle else ()),
        ),
        stale=tuple(name for name, entry in view.messages.items() if entry.stale(now)),
        alerts=(),
        age_s=None if math.isinf(age) else round(age, 3),
        counts=FrameCounts(
            *(sum(getattr(entry, name) for entry in view.messages.values()) for name in ("received", "lost", "bad"))
        ),
        vehicle_counts=VehicleFrameCounts(
            *map(value, ("CountDropped", "CountImplausible", "CountLost", "CountUnknown"))
        ),
    )
    limits = vehicle.limits(activity is Activity.CHARGING) if vehicle else None
    return replace(made, alerts=_alerts(made, view, waiting, limits, before))


def _alerts(
    shown: Picture, view: View, waiting: bool, limits: tuple[float, float] | None, before: tuple[str, ...]
) -> tuple[str, ...]:
    """Return those of `ALERTS` that hold; `before`: the last ones, so that none flickers at its limit."""
    soc, route = shown.battery.soc_percent, shown.route
    empty_at = NO_LONGER_EMPTY if "battery_nearly_empty" in before else NEARLY_EMPTY
    too_hot = too_cold = unreachable = uncertain = False
    if shown.cells and limits:
        too_cold = shown.cells.coldest_degc < limits[0] + CELL_HYSTERESIS * ("cell_too_cold" in before)
        too_hot = shown.cells.hottest_degc > limits[1] - CELL_HYSTERESIS * ("cell_too_hot" in before)
    if route and route.on_route:
        unreachable = route.battery_ends_after_km is not None or route.arrival_soc_percent == 0
        uncertain = not unreachable and route.arrival_soc_p10_percent == 0
    silent = len(shown.stale) == len(view.messages)
    holds = {
        "bus_down": not shown.bus_up,
        "silent": silent,
        # Not for a message that never came: the first frames may have only just begun.
        "partly_silent": not silent and any(view.messages[name].received for name in shown.stale),
        "waiting": waiting,
        "range_invalid": shown.state == "invalid" and not waiting,
        "cell_too_hot": too_hot,
        "destination_unreachable": unreachable,
        "battery_nearly_empty": shown.activity != "charging" and soc is not None and soc <= empty_at,
        "cell_too_cold": too_cold,
        "destination_uncertain": uncertain,
        "sensor_lost": "sensor_distrusted" in shown.reasons or (bool(shown.lost) and not waiting),
    }
    return tuple(alert for alert in ALERTS if holds[alert])


def _names(reasons: Reason) -> tuple[str, ...]:
    return tuple(str(reason.name).lower() for reason in Reason if reason & reasons)
