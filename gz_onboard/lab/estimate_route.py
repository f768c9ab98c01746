"""What the summary of a ride says of the route that it was given."""

from __future__ import annotations

from dataclasses import dataclass

from gz_onboard.constants import WH
from gz_onboard.events import Estimate, RouteState
from gz_onboard.reports.results import number, times

MOSTLY = 0.5  # of the ridden way on the route: where it was less, that is said


@dataclass(frozen=True)
class RouteSummary:
    """Of the last estimate on the route, but for `state`, which is of the last of all, and what was ridden on the
    route; null for what is not known.
    """

    state: str  # of `RouteState`
    ridden_km: float
    grade_known: bool
    along_km: float | None
    left_km: float | None
    energy_wh: float | None  # to the end of the route
    energy_sd_wh: float | None
    arrival_soc: float | None  # 0 to 1; 0 if the battery ends before
    arrival_soc_p10: float | None
    arrival_soc_p90: float | None
    battery_ends_km: float | None  # from the start of the route
    battery_ends_latitude_deg: float | None
    battery_ends_longitude_deg: float | None


def route_summary(last: Estimate, on_route: Estimate, way: float, grade_known: bool) -> RouteSummary:
    """Of the last estimate, and the last on the route; way: ridden on it [m]."""
    e = on_route
    ends = None if e.battery_ends_after is None or e.route_along is None else e.route_along + e.battery_ends_after
    return RouteSummary(
        last.route_state.name,
        way * 1e-3,
        grade_known,
        times(e.route_along, 1e-3),
        times(e.route_left, 1e-3),
        times(e.route_energy, 1 / WH),
        times(e.route_energy_sd, 1 / WH),
        e.arrival_soc,
        e.arrival_soc_p10,
        e.arrival_soc_p90,
        times(ends, 1e-3),
        e.battery_ends_latitude,
        e.battery_ends_longitude,
    )


def route_text(route: RouteSummary) -> str:
    """For a terminal."""
    if route.left_km is None:
        return "the ride was never on it"
    low, high = (number(soc, ".0f", "", 100) for soc in (route.arrival_soc_p10, route.arrival_soc_p90))
    text = "" if route.state == RouteState.ON.name else "when last on it, "
    text += f"{route.left_km:.1f} km and {number(route.energy_wh, '.0f', 'Wh')} to its end; "
    if route.battery_ends_km is None:
        text += f"{number(route.arrival_soc, '.0f', '%', 100)} of charge there ({low} to {high}, 80 % interval)"
    else:
        text += f"battery empty at km {route.battery_ends_km:.1f}"
        if route.battery_ends_latitude_deg is not None:
            text += f" ({route.battery_ends_latitude_deg:.5f}, {route.battery_ends_longitude_deg:.5f})"
    return text if route.grade_known else f"{text}; its grades are not known"


def off_text(route: RouteSummary, distance_km: float) -> str:
    """That less than half of a ride of `distance_km` was on it; empty if it was more, or none, which is told."""
    if route.left_km is None or route.ridden_km >= MOSTLY * distance_km:
        return ""
    return f"only {route.ridden_km:.2f} of the {distance_km:.2f} km ridden were on the route"
