"""The view as JSON: every number of the frames, none that is old, and the alerts."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.can.publisher import Publisher, sensor_signal
from gz_onboard.display.server import STATIC
from gz_onboard.display.view import ALERTS, NEARLY_EMPTY, NO_LONGER_EMPTY, NO_NEWS, Picture, View, encoded
from gz_onboard.events import NO_SENSOR, ROLES, Activity, Cause, Estimate, Reason, RouteState, State
from tests.display.served import COUNTS, ESTIMATE, second, seen

BUS = "vcan0", "socketcan", True
HEALTHY = replace(ESTIMATE, state=State.VALID, reasons=Reason(0))
ON_ROUTE = replace(
    HEALTHY, route_state=RouteState.ON, route_left=18_300.0, arrival_soc=0.31, arrival_soc_p10=0.22, route_along=0.0
)
CHARGING = replace(
    HEALTHY, activity=Activity.CHARGING, charge_power=620.0, time_to_full=7500.0, range_full=54_000.0, soc=0.1
)


def of(estimate: Estimate, now: float = 100.0) -> Picture:
    return seen(estimate).picture(now, *BUS)


def numbers(data: object) -> list[float]:
    """Every number in the JSON, but for the age, the counts and the version."""
    if isinstance(data, dict):
        return [n for key, value in data.items() if key not in (*NO_NEWS, "version") for n in numbers(value)]
    if isinstance(data, list):
        return [n for value in data for n in numbers(value)]
    return [data] if isinstance(data, int | float) and not isinstance(data, bool) else []


def test_every_number_of_the_frames():
    data = of(ESTIMATE)
    assert data == {
        "version": 1,
        "channel": "vcan0",
        "interface": "socketcan",
        "file": "range.dbc",
        "bus_up": True,
        "heard": True,
        "state": "degraded",
        "activity": "riding",
        "range": {"km": 34.21, "p10_km": 26.54, "p90_km": 44.34},
        "range_10min_km": [*[None] * 59, 34.21],
        "battery": {"soc_percent": 62.4, "soc_sigma_percent": 1.2, "energy_left_wh": 895.0},
        "cells": None,
        "speed_km_h": None,
        "odometer_km": None,
        "ridden_today_km": None,
        "consumption": {"recent_wh_per_km": 24.6, "expected_wh_per_km": 26.2},
        "charge": None,
        "route": None,
        "rated_km": 57.6,
        "causes": [{"cause": "temperature", "km": -3.4}, {"cause": "stops", "km": 1.6}],
        "reasons": ["no_imu", "prior_riding"],
        "lost": [],
        "distrusted": [],
        "stale": [],
        "alerts": [],
        "age_s": 0.0,
        "counts": {"received": 17, "lost": 0, "bad": 0},
        "vehicle_counts": {"dropped": 7.0, "implausible": 3.0, "lost": 24.0, "unknown": 2.0},
    }


def test_a_charge_and_a_route():
    data = of(CHARGING)
    assert data["charge"] == {"power_w": 620.0, "time_to_full_min": 125.0, "range_full_km": 54.0}
    data = of(ON_ROUTE)
    assert data["route"] == {
        "on_route": True,
        "left_km": 18.3,
        "arrival_soc_percent": 31.0,
        "arrival_soc_p10_percent": 22.0,
        "battery_ends_after_km": None,
    }
    off = of(replace(HEALTHY, route_state=RouteState.OFF))["route"]
    assert not off["on_route"]
    assert off["left_km"] is None


@pytest.mark.parametrize(
    ("after", "gone", "stay"),
    [(0.9, [], ["soc_percent", "range", "consumption"]), (1.1, ["soc_percent"], ["range"]), (10.1, ["everything"], [])],
)
def test_an_old_number_is_not_given(after, gone, stay):
    data = of(ESTIMATE, 100.0 + after)
    has = {
        "soc_percent": data["battery"]["soc_percent"] is not None,
        "range": None not in data["range"].values(),
        "consumption": None not in data["consumption"].values(),
        "everything": bool(numbers(data)),
    }
    assert not any(has[name] for name in gone)
    assert all(has[name] for name in stay)


@pytest.mark.parametrize(
    ("estimate", "alerts"),
    [
        (HEALTHY, ()),
        (replace(HEALTHY, reasons=Reason.PRIOR_RIDING), ()),
        (replace(HEALTHY, reasons=Reason.NO_GPS), ()),
        (replace(HEALTHY, reasons=Reason.SENSOR_DISTRUSTED, distrusted=("gps_altitude",)), ("sensor_lost",)),
        (replace(HEALTHY, state=State.INVALID), ("range_invalid",)),
        (replace(HEALTHY, soc=0.15), ("battery_nearly_empty",)),
        (replace(HEALTHY, soc=0.151), ()),
        (CHARGING, ()),
        (ON_ROUTE, ()),
        (replace(ON_ROUTE, arrival_soc_p10=0.0), ("destination_uncertain",)),
        (replace(ON_ROUTE, arrival_soc=0.0, arrival_soc_p10=0.0), ("destination_unreachable",)),
        (
            replace(ON_ROUTE, arrival_soc=0.0, arrival_soc_p10=0.0, battery_ends_after=9000.0, soc=0.05),
            ("destination_unreachable", "battery_nearly_empty"),
        ),
        (replace(ON_ROUTE, route_state=RouteState.OFF, arrival_soc=0.0), ()),
    ],
)
def test_alerts(estimate, alerts):
    assert of(estimate)["alerts"] == list(alerts)


STARTING = Estimate(time=0.0, reasons=NO_SENSOR)
NO_SCOOTER = replace(STARTING, state=State.INVALID)


def test_the_range_of_the_last_ten_minutes():
    view, publisher = View(), Publisher()
    for number in range(80):
        for frame in publisher.range(replace(HEALTHY, range=(40 - number / 10) * 1e3), COUNTS, 0):
            view.take(frame, 1000.0 + 10 * number)
        trend = view.picture(1000.0 + 10 * number, *BUS)["range_10min_km"]
    assert trend == pytest.approx([40 - number / 10 for number in range(20, 80)])
    assert view.picture(1805.0, *BUS)["range_10min_km"] == []  # nothing known now


def test_a_battery_at_the_limit_does_not_flicker():
    view, publisher, shown = View(), Publisher(), []
    for now, soc in enumerate((16.0, 15.0, 15.4, 15.0, 16.9, NO_LONGER_EMPTY + 0.1, NEARLY_EMPTY + 0.1)):
        for frame in second(publisher, replace(HEALTHY, soc=soc / 100)):
            view.take(frame, float(now))
        shown.append(bool(view.picture(float(now), *BUS)["alerts"]))
    assert shown == [False, True, True, True, True, False, False]


def test_age_and_counts_alone_are_no_news():
    view = seen(HEALTHY)
    first = view.picture(100.0, *BUS)
    for frame in second(Publisher(), HEALTHY)[:-1]:
        view.take(frame, 100.1)
    later, down = view.picture(100.1, *BUS), view.picture(100.1, *BUS[:2], False)
    assert {key for key in later if later[key] != first[key]} == {"counts"} <= set(NO_NEWS)
    assert down["bus_up"] != first["bus_up"]


@given(
    st.builds(
        lambda state, reasons, soc, metres, activity, route, arrival: replace(
            ESTIMATE,
            state=state,
            reasons=Reason(reasons),
            soc=soc,
            range=metres,
            range_p10=metres * 0.7,
            range_p90=metres * 1.4,
            activity=activity,
            route_state=route,
            arrival_soc=arrival,
        ),
        st.sampled_from(State),
        st.integers(0, 2**20 - 1),
        st.floats(-1, 2),
        st.floats(0, 1e6),
        st.sampled_from(Activity),
        st.sampled_from(RouteState),
        st.none() | st.floats(0, 1),
    ),
    st.floats(0, 20),
)
def test_any_estimate_is_json_and_of_its_time(estimate, after):
    got = of(estimate, 100.0 + after)
    data = json.loads(encoded(got))
    assert all(math.isfinite(n) for n in numbers(data))
    if estimate.state in (State.STARTING, State.INVALID) or after > 10:
        assert data["range"] == {"km": None, "p10_km": None, "p90_km": None}
        assert data["battery"]["soc_percent"] is None
    assert set(got["alerts"]) <= set(ALERTS)


# --- the words of the page ----------------------------------------------------------------------------------------


def words(language: str) -> dict[str, object]:
    text = (STATIC / f"{language}.js").read_text(encoding="utf-8")
    found: dict[str, object] = json.loads(re.sub(r"^export default |;\s*$", "", text))
    return found


def keys(data: object, before: str = "") -> set[str]:
    """The names of all texts, and in each what is filled into it."""
    if isinstance(data, dict):
        return {key for name, value in data.items() for key in keys(value, f"{before}.{name}")}
    places = sorted(re.findall(r"{(\w+)}", str(data)))
    return {f"{before} {places}"}


@pytest.mark.parametrize("language", ["en", "de"])
def test_there_is_a_word_for_everything(language):
    text = words(language)
    groups = {
        "states": [*(state.name.lower() for state in State), "none", "waiting"],
        "meanings": [*(state.name.lower() for state in State), "none", "waiting"],
        "activities": [activity.name.lower() for activity in Activity],
        "reasons": [str(reason.name).lower() for reason in Reason],
        "causes": [cause.name.lower() for cause in Cause if cause],
        "messages": [*View().messages],
        "sensors": [r for r in ROLES if sensor_signal(r) in Publisher().messages["RANGE_Sensors"].signal_tree],
    }
    for group, names in groups.items():
        assert set(names) == set(text[group]), group  # type: ignore[call-overload]
    assert set(ALERTS) <= set(text["alerts"])  # type: ignore[call-overload]


def test_every_text_that_the_page_asks_for_is_there():
    page = "".join(path.read_text(encoding="utf-8") for path in STATIC.iterdir())
    asked = set(re.findall(r'data-word="(\w+)"', page)) | set(re.findall(r"\bwords\(\)\.(\w+)", page))
    asked |= set(re.findall(r'\bword\("(\w+)"', page))
    assert len(asked) > 25
    assert asked <= set(words("en"))
